"""``hybridve detect``: contacts of recordings with CAD, frame by frame, into reports."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from hybridve.cli import options
from hybridve.cli.progress import Terminal
from hybridve.hull.contact.verdict import VERDICTS

if TYPE_CHECKING:
    from hybridve.hull.capture.recording import FrameRange
    from hybridve.hull.report.compare import Pair

#: The table of several sessions or layouts, in the folder of their reports.
COMPARISON = "COMPARISON.csv"


def _files(values: dict[str, Any]) -> options.Files:
    sessions, scenes, output = values["sessions"], values["scenes"], values["output"]
    is_one = len(sessions) == len(scenes) == 1
    return options.Files(
        reads=options.given(sessions, scenes), writes=[output if is_one else output / COMPARISON]
    )


@click.command(
    cls=options.GroupedCommand,
    files=_files,
    short_help="Find what recordings touched, into reports.",
)
@options.sessions_arg
@options.scenes_option
@options.output_option(
    "The report to write, REPORT.h5; of several sessions or layouts, a folder for their reports."
)
@click.option(
    "--viewport",
    type=click.IntRange(1, 65_535),
    help="Samples along every triangle's edge; more find smaller contacts and take longer. "
    "Default: 10, as in the paper.",
)
@click.option(
    "--accuracy-mm",
    type=click.FloatRange(0, min_open=True),
    help="Instead of --viewport: sample every edge at most this far apart.",
)
@click.option(
    "--open-at-mm",
    type=click.FloatRange(0),
    default=0.1,
    show_default=True,
    help="Certify every verdict, down to contacts this wide at their widest; 0: samples only.",
)
@options.engine_option
@options.frames_option
@options.drop_camera_option
@options.response_options
@click.option(
    "--points",
    type=click.Choice(["sample", "all"]),
    default="sample",
    show_default=True,
    help="all: spell every collision point out, for programs that cannot make them from runs; "
    "sample: runs, and some points to look at.",
)
@click.option("--resume", is_flag=True, help="Take up a run that was cut off.")
@options.overwrite_option
@click.option(
    "--fail-on-clash",
    is_flag=True,
    help="Leave with status 3 unless every object is proved to keep its distance in every frame.",
)
@click.option(
    "--let-pass",
    type=click.Choice([one for one in VERDICTS if one != "kept"]),
    multiple=True,
    help="A verdict besides 'kept' that --fail-on-clash lets pass; may be given several times.",
)
@options.fail_on_doubt_option
@options.json_option
@options.quiet_progress
def detect(
    sessions: tuple[Path, ...],
    scenes: tuple[Path, ...],
    output: Path,
    viewport: int | None,
    accuracy_mm: float | None,
    open_at_mm: float,
    engine: options.EngineName,
    frames: "FrameRange",
    resume: bool,
    overwrite: bool,
    fail_on_clash: bool,
    let_pass: tuple[str, ...],
    fail_on_doubt: bool,
    drop_cameras: tuple[str, ...],
    points: Literal["sample", "all"],
    as_json: bool,
    progress: bool,
    **response: Any,
) -> None:
    r"""Find for each frame of SESSION what the real things touched or came near, and where.

    The report takes, of every object and frame: the collision points, how sure the verdict is, the
    clearance between two bounds, which way the object must give, when contact began, and how far
    all this can be trusted.

    With several SESSIONs, or several --scene, every session is tested against every layout: -o is
    a folder that takes a report each, SESSION__SCENE.h5, and a table of them all, COMPARISON.csv.
    Run `hybridve segment` first where there are many layouts: each takes the silhouettes as stored.

    What the cameras say about each other comes first: a session whose silhouettes, rig and clock do
    not belong together is not to be trusted, and nothing in it is certified.

    \b
    Example:
      hybridve detect data/horseman --scene data/horseman/scene.toml -o report.h5
      hybridve detect my_session --scene scene.toml -o report.h5 --accuracy-mm 2
      hybridve detect p1 p2 p3 --scene narrow.toml --scene wide.toml -o reports
    """
    if viewport is not None and accuracy_mm is not None:
        raise click.UsageError("give either --viewport or --accuracy-mm, not both")
    import cv2

    from hybridve.cli.summary import print_summary
    from hybridve.hull.batch import DetectSettings, detect_every, detect_one
    from hybridve.hull.report.read import read_report
    from hybridve.hull.report.summarize import failing, summarize

    # Cameras run side by side in threads of their own; threads inside each would fight them.
    cv2.setNumThreads(1)
    settings = DetectSettings(
        options.evaluation_of(
            frames=frames,
            viewport=None if accuracy_mm is not None else viewport or 10,
            accuracy_m=None if accuracy_mm is None else accuracy_mm / 1000.0,
            open_at_m=open_at_mm / 1000.0 or None,
            drop_cameras=drop_cameras,
            **response,
        ),
        engine=engine,
        points=points,
        resume=resume,
        overwrite=overwrite,
        command=options.command_line(),
    )
    terminal = Terminal(enabled=progress)
    if len(sessions) > 1 or len(scenes) > 1:
        table = output / COMPARISON
        named = _named(sessions, "session.toml"), _named(scenes, "scene.toml")
        pairs = detect_every(*named, output, table, settings, terminal)
        _tell_all(table, pairs, as_json=as_json)
        found = [pair.summary for pair in pairs if pair.summary is not None]
    else:
        detect_one(sessions[0], scenes[0], output, settings, terminal)
        report = read_report(output)
        found = [summarize(report)]
        if as_json:
            options.tell(json.dumps(found[0]))
        else:
            print_summary(report)
    if fail_on_doubt and not all(numbers["trusted"] for numbers in found):
        sys.exit(5)
    if fail_on_clash and any(failing(numbers, let_pass) for numbers in found):
        sys.exit(3)


def _named(paths: tuple[Path, ...], default: str) -> dict[str, Path]:
    """Return files by a short name for each."""
    from hybridve.hull.report.compare import distinct_names

    try:
        return dict(zip(distinct_names(paths, default), paths, strict=True))
    except ValueError as error:
        raise click.UsageError(str(error)) from None


def _tell_all(table: Path, pairs: "list[Pair]", *, as_json: bool) -> None:
    """Write the table of several reports, and print it; then say so if some are missing."""
    from hybridve.calib.errors import ReportError
    from hybridve.hull.report.compare import compare, write_comparison

    comparison = compare(pairs)
    write_comparison(table, comparison)
    if as_json:
        options.tell(json.dumps({"comparison": str(table), **comparison}))
    else:
        print_comparison(table, comparison)
    if comparison["failed"]:
        raise ReportError(
            f"{table.parent}: {len(comparison['failed'])} of {len(pairs)} reports could not be "
            "made, as told above; the others stand there, and the same call with --resume makes "
            "the rest"
        )


def print_comparison(table: Path, comparison: dict[str, Any]) -> None:
    """Print sessions in columns; layouts and objects in rows."""
    sessions = comparison["sessions"]
    rows = [("layout", "object", *sessions)]
    for row in comparison["rows"]:
        cells = (_cell_text(row["sessions"].get(name)) for name in sessions)
        rows.append((row["layout"], row["object"], *cells))
    layouts = options.counted(len(comparison["layouts"]), "layout")
    options.tell(f"{table}: {options.counted(len(sessions), 'session')}, {layouts}")
    options.print_table(rows)


def _cell_text(cell: dict[str, Any] | None) -> str:
    """Return a verdict in a few words: with the clearance, or how deep and how often."""
    if cell is None:
        return "no report"
    parts = [cell["verdict"] if cell["trusted"] else f"not to be trusted ({cell['verdict']})"]
    if clashing := cell["frames_colliding"] + cell["frames_inside"]:
        parts.append(f"{clashing} of {cell['frames']} frames")
        if cell["depth_upper_m"] is not None:
            parts.append(f"{1e3 * cell['depth_upper_m']:.1f} mm deep")
    elif cell["clearance_lower_m"] is not None:
        parts.append(f"{1e3 * cell['clearance_lower_m']:.1f} mm")
    if cell["required_clearance_m"] and cell["frames_below_required"]:
        below = f"{1e3 * cell['required_clearance_m']:g} mm"
        parts.append(f"{options.counted(cell['frames_below_required'], 'frame')} below {below}")
    if cell["verdict"] == "kept" and cell["kept_rests_on"]:
        parts.append(f"rests on {cell['kept_rests_on']}")
    return ", ".join(parts)
