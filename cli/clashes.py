"""``hybridve clashes``: the contacts of a report as a list of clashes, and what was decided."""

import json
import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridve.calib.bounded import has_control, printable
from hybridve.cli import options
from hybridve.hull.report.wording import (
    at_95_text,
    counted_clashes,
    sentence,
    worst_text,
)

if TYPE_CHECKING:
    from hybridve.hull.report.clashes import Clashes
    from hybridve.hull.report.ledger import Decision, Ledger, Listed
    from hybridve.hull.report.read import Report

#: Ids that are named at once; --json has all.
_MOST_NAMES = 8

_logger = logging.getLogger(__name__)


def _decision(status: str, name: str, what: str) -> Callable[[options.FC], options.FC]:
    return click.option(f"--{name}", f"as_{status}", metavar="ID", multiple=True, help=what)


def _files(values: dict[str, Any]) -> options.Files:
    from hybridve.hull.report.ledger import ledger_path

    report = values["report"]
    ledger = values["ledger_file"] or ledger_path(report)
    return options.Files(options.given(report, values["scene"]), held=[ledger])


@click.command(
    cls=options.Command,
    files=_files,
    short_help="List what clashes, and keep what was decided about it.",
)
@options.report_arg
@_decision("approved", "approve", "The clash is as it may be; may be given several times.")
@_decision("reviewed", "review", "Somebody looked at it; may be given several times.")
@_decision("resolved", "resolve", "It is dealt with: found in another run it is new again.")
@_decision("active", "reopen", "It is to be looked at again; may be given several times.")
@click.option("--comment", help="Why; kept with the clashes that are decided about.")
@click.option("--who", help="Who decides. Default: your user name.")
@click.option(
    "--ledger",
    "ledger_file",
    type=click.Path(path_type=Path),
    help="Where ids and decisions are kept; one file may serve several reports. Default: "
    "clashes.toml beside the report if it is there, else REPORT.clashes.toml.",
)
@click.option(
    "--scene",
    type=click.Path(path_type=Path),
    help="Take the rules ([[rule]]) of this scene.toml, not those that the report was made with.",
)
@click.option(
    "--fail-on-clash",
    is_flag=True,
    help="Leave with status 3 unless every clash is approved or resolved.",
)
@options.json_option
def clashes(
    report: Path,
    comment: str | None,
    who: str | None,
    ledger_file: Path | None,
    scene: Path | None,
    fail_on_clash: bool,
    as_json: bool,
    **decisions: tuple[str, ...],
) -> None:
    r"""List the clashes of REPORT, one for each thing worth a word, the worst first.

    Contacts of single frames are gathered over time and place on the part. Each clash has an id
    that it keeps in other runs, and a status: new, active, reviewed, approved or resolved. Both
    stand in a text file beside the report, made to be edited and put under version control.

    \b
    Example:
      hybridve clashes report.h5
      hybridve clashes report.h5 --approve lid-k3f7 --comment "only the sleeve touches"
      hybridve clashes p1.h5 --ledger task.clashes.toml
    """
    from hybridve.hull.report.clashes import gather_clashes
    from hybridve.hull.report.ledger import (
        decided,
        ledger_path,
        look_up,
        read_ledger,
        write_ledger,
    )
    from hybridve.hull.report.read import read_report

    wanted = _decisions(decisions, who, comment)
    loaded = read_report(report)
    rules = None
    if scene is not None:
        from hybridve.hull.cad.scene import load_scene

        rules = load_scene(scene).rules
    found = gather_clashes(loaded, rules)
    before = read_ledger(ledger_file or ledger_path(report))
    ledger, listed = look_up(before, found.clashes, loaded)
    ledger = decided(ledger, wanted)
    listed = tuple(one.by(ledger) for one in listed)
    if ledger != before:
        keep_ledger(ledger, write_ledger, must_be=bool(wanted))
    gone = _gone(before, ledger)
    if as_json:
        options.tell(json.dumps(_told(loaded, ledger, found, listed, gone)))
    else:
        _print(loaded, ledger, found, listed, gone)
    if fail_on_clash and not (
        loaded.agreement.is_trusted
        and all(one.entry.status in ("approved", "resolved") for one in listed)
    ):
        sys.exit(3)


def _decisions(
    given: dict[str, tuple[str, ...]], who: str | None, comment: str | None
) -> "list[Decision]":
    """Return what options say was decided."""
    from hybridve.hull.report.ledger import STATUSES, Decision
    from hybridve.hull.report.machine import utc_now

    for option, text in (("--comment", comment), ("--who", who)):
        if text is not None and has_control(text):  # what is kept must be read back
            raise click.UsageError(f"{option} holds a control character, in '{printable(text)}'")
    who = _user() if who is None else who
    found = [
        Decision(name, status, who, utc_now(), comment)
        for status in STATUSES
        for name in given.get(f"as_{status}", ())
    ]
    if comment is not None and not found:
        raise click.UsageError("--comment says why; say what with --approve ID or the like")
    names = [one.id for one in found]
    for name in names:
        if names.count(name) > 1:
            raise click.UsageError(f"{name} is decided about twice")
    return found


def _user() -> str:
    """Return the user's name; empty where nobody knows it."""
    import getpass

    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return ""


def keep_ledger(ledger: "Ledger", write: Any, *, must_be: bool) -> None:
    """Write the ledger; where only a look was taken, and it cannot be, say so and go on."""
    from hybridve.calib.errors import ReportError

    try:
        write(ledger)
    except ReportError as error:
        if must_be:
            raise
        _logger.warning("%s; ids may be others next time", error)


def _gone(before: "Ledger", after: "Ledger") -> list[str]:
    """Return the ids of clashes that were there before and are resolved now."""
    was = {entry.id: entry.status for entry in before.entries}
    return [
        entry.id
        for entry in after.entries
        if entry.status == "resolved" and was.get(entry.id, "resolved") != "resolved"
    ]


def _counts(listed: "tuple[Listed, ...]") -> dict[str, int]:
    from hybridve.hull.report.ledger import STATUSES

    every = [one.entry.status for one in listed]
    return {status: every.count(status) for status in STATUSES if status in every}


def _told(
    report: "Report",
    ledger: "Ledger",
    found: "Clashes",
    listed: "tuple[Listed, ...]",
    gone: list[str],
) -> dict[str, Any]:
    from hybridve.hull.report.ledger import to_list

    return {
        "report": str(report.path),
        "ledger": str(ledger.path),
        "trusted": report.agreement.is_trusted,
        "frames": len(report.index),
        "contacts": found.n_patches,
        "counts": _counts(listed),
        "clashes": to_list(listed),
        "resolved": gone,
        "left_out": [
            {
                "rule": one.number,
                "what": one.rule.text,
                "clashes": one.clashes,
                "frames": one.frames,
            }
            for one in found.left_out
        ],
        "frames_undecided": found.frames_undecided,
    }


def _print(
    report: "Report",
    ledger: "Ledger",
    found: "Clashes",
    listed: "tuple[Listed, ...]",
    gone: list[str],
) -> None:
    options.tell(_first_line(report, listed))
    gathered = options.counted(found.n_patches, "contact")
    options.tell(
        f"{report.path}: {options.counted(len(report.index), 'frame')}; {gathered} of single "
        f"frames gathered into {counted_clashes(len(found.clashes))}"
    )
    if listed:
        options.print_table(_rows(listed))
        options.print_table(_places(listed))
    for one in listed:
        if one.entry.comment:
            by = f", {one.entry.who}" if one.entry.who else ""
            options.tell(f"  {one.entry.id}: {one.entry.comment}{by}")
        if one.ties:
            names = " or ".join(one.ties[:_MOST_NAMES])
            options.tell(f"  {one.entry.id}: lies beside {names}, and could be taken for it")
    for left in found.left_out:
        options.tell(
            f"  rule {left.number} left out {counted_clashes(left.clashes)} in "
            f"{options.counted(left.frames, 'frame')}: {left.rule.text}"
        )
    if gone:
        more = ", ..." if len(gone) > _MOST_NAMES else ""
        options.tell(f"  no longer found, so resolved: {', '.join(gone[:_MOST_NAMES])}{more}")
    if found.frames_undecided:
        counts = ", ".join(f"{n} {verdict}" for verdict, n in found.frames_undecided.items())
        options.tell(
            f"  not decided, frames of all objects together: {counts}; see `hybridve summary`"
        )
    options.tell(f"  ids and decisions: {ledger.path}")


def _first_line(report: "Report", listed: "tuple[Listed, ...]") -> str:
    """Return the answer in one sentence."""
    if not listed:
        answer = "no clashes: nothing was found that touches a part or is nearer than it requires"
    else:
        counts = ", ".join(f"{count} {status}" for status, count in _counts(listed).items())
        undone = [one for one in listed if one.entry.status not in ("approved", "resolved")]
        answer = f"{counted_clashes(len(listed))} ({counts})"
        if undone:
            answer += f"; look first at {undone[0].entry.id}: {sentence(undone[0].clash)}"
        else:
            answer += "; nothing is left to be looked at"
    if not report.agreement.is_trusted:
        return f"not to be trusted, the cameras contradict each other: {answer}"
    return answer


def _rows(listed: "tuple[Listed, ...]") -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [
        (
            "id",
            "status",
            "kind",
            "object",
            "at worst, mm (bounds)",
            "at 95 % (estimate)",
            "when",
            "for, s",
            "times",
            "worst frame",
            "how sure",
        )
    ]
    for one in listed:
        clash = one.clash
        rows.append(
            (
                one.entry.id,
                one.entry.status,
                clash.kind,
                clash.name,
                worst_text(clash),
                at_95_text(clash),
                f"{clash.first_s:.2f}-{clash.last_s:.2f} s",
                f"{clash.dwell_s:.2f}",
                f"{clash.n_episodes}",
                f"{clash.worst.frame}",
                "sure" if clash.is_sure else ", ".join(clash.doubts),
            )
        )
    return rows


def _places(listed: "tuple[Listed, ...]") -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [
        (
            "id",
            "on the object, m",
            "on what is real, m",
            "on the part, mm",
            "cameras that decide it",
        )
    ]
    for one in listed:
        clash, worst = one.clash, one.clash.worst
        cameras = ", ".join(worst.ends_at) or "-"
        if worst.n_seeing:
            cameras += f" (of {worst.n_seeing} that see it)"
        rows.append(
            (
                one.entry.id,
                _point(worst.on_object_world.tolist(), 3),
                _point(worst.on_hull_world.tolist(), 3),
                _point((1e3 * clash.place.center[0]).tolist(), 0),
                cameras,
            )
        )
    return rows


def _point(values: list[float], digits: int) -> str:
    return f"({', '.join(f'{round(value, digits) + 0.0:.{digits}f}' for value in values)})"
