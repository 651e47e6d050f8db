"""``hybridve export``: a report as a page, as tables, as meshes, for other programs."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridve.cli import options

if TYPE_CHECKING:
    from hybridve.hull.report.clashes import Clashes
    from hybridve.hull.report.ledger import Listed
    from hybridve.hull.report.read import Report

#: What a report can be exported as: the option, what it is, and what it needs besides.
_TARGETS = (
    ("--html PAGE.html", "one page: the answer, clashes with pictures, all frames in 3D", ""),
)

_path = click.Path(path_type=Path)


@click.command(short_help="Write a report as a page, or for other programs.")
@click.argument("report", type=_path, required=False)
@click.option(
    "--html",
    type=_path,
    help="One page that needs nothing else, for any browser: the answer, the clashes with "
    "pictures, clearance over time, and the scene in 3D frame by frame.",
)
@click.option(
    "--session",
    type=_path,
    help="The session that the report was made from: pictures of its cameras, and the hull.",
)
@click.option(
    "--ledger",
    "ledger_file",
    type=_path,
    help="Where ids of clashes and decisions are kept; as of `hybridve clashes`.",
)
@click.option("--list", "as_list", is_flag=True, help="Tell what a report can be exported as.")
@options.overwrite_option
@options.quiet_progress
def export(
    report: Path | None,
    html: Path | None,
    session: Path | None,
    ledger_file: Path | None,
    as_list: bool,
    overwrite: bool,
    progress: bool,
) -> None:
    r"""Write REPORT as a page, or for other programs.

    \b
    Example:
      hybridve export report.h5 --html report.html --session my_session
      hybridve export --list
    """
    if as_list:
        rows = [("option", "what it is", "needs")]
        options.print_table([*rows, *_TARGETS])
        return
    if report is None:
        raise click.UsageError("name the report to export")
    if html is None:
        raise click.UsageError("say as what: " + ", ".join(one[0] for one in _TARGETS))
    from hybridve.hull.report.read import read_report
    from hybridve.hull.report.write import refuse_existing

    if html.suffix.lower() not in (".html", ".htm"):
        raise click.UsageError(f"{html}: pages are .html")
    refuse_existing(html, overwrite=overwrite)
    loaded = read_report(report)
    found, listed = _clashes(loaded, ledger_file)
    _write_page(html, loaded, found, listed, session, progress=progress)


def _clashes(report: "Report", ledger_file: Path | None) -> "tuple[Clashes, tuple[Listed, ...]]":
    """Return the clashes of a report, and what the ledger calls them; new ones are kept there."""
    from hybridve.cli.clashes import keep_ledger
    from hybridve.hull.report.clashes import gather_clashes
    from hybridve.hull.report.ledger import ledger_path, look_up, read_ledger, write_ledger

    found = gather_clashes(report)
    before = read_ledger(ledger_file or ledger_path(report.path))
    ledger, listed = look_up(before, found.clashes, report)
    if ledger != before:
        keep_ledger(ledger, write_ledger, must_be=False)
    return found, listed


def _write_page(
    html: Path,
    report: "Report",
    found: "Clashes",
    listed: "tuple[Listed, ...]",
    session: Path | None,
    *,
    progress: bool,
) -> None:
    import cv2

    from hybridve.cli.progress import Terminal
    from hybridve.hull.page import write_page
    from hybridve.hull.recorded import open_recorded

    cv2.setNumThreads(1)
    terminal = Terminal(enabled=progress)
    recorded, missing = None, []
    if session is not None:
        recorded, doubt = open_recorded(report, session)
        if doubt:
            missing.append(doubt)
            terminal.warn(doubt)
    size = write_page(
        html,
        report,
        found,
        listed,
        recorded=recorded,
        missing=missing,
        progress=terminal.stage,
    )
    click.echo(f"{html}: {size / 1e6:.1f} MB, {options.counted(len(report.index), 'frame')}")
