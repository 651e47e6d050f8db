"""``hybridve detect``: contacts of recordings with CAD, frame by frame, into reports."""

import json
import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from hybridve.cli import options
from hybridve.cli.progress import StageProgress, progress_bar
from hybridve.hull.contact.verdict import VERDICTS

if TYPE_CHECKING:
    from hybridve.hull.cad.scene import Scene
    from hybridve.hull.capture.recording import FrameRange
    from hybridve.hull.capture.session import Session
    from hybridve.hull.evaluate import Chain, EvaluateSettings

#: The table of several sessions or layouts, in the folder of their reports.
COMPARISON = "COMPARISON.csv"


@click.command(cls=options.GroupedCommand, short_help="Find what recordings touched, into reports.")
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
    from hybridve.hull.cad.scene import load_scene
    from hybridve.hull.capture.session import load_session
    from hybridve.hull.evaluate import make_chain
    from hybridve.hull.report.read import read_report
    from hybridve.hull.report.summarize import failing, summarize
    from hybridve.hull.report.write import refuse_existing

    # Cameras run side by side in threads of their own; threads inside each would fight them.
    cv2.setNumThreads(1)
    settings = options.evaluation_of(
        frames=frames,
        viewport=None if accuracy_mm is not None else viewport or 10,
        accuracy_m=None if accuracy_mm is None else accuracy_mm / 1000.0,
        open_at_m=open_at_mm / 1000.0 or None,
        **response,
    )
    how = _How(settings, engine, resume, overwrite, progress, points)
    if len(sessions) > 1 or len(scenes) > 1:
        clashes = _detect_all(sessions, scenes, output, how, let_pass, as_json=as_json)
    else:
        refuse_existing(output, overwrite=overwrite)
        told = StageProgress(enabled=progress)
        chain = make_chain(load_session(sessions[0]), load_scene(scenes[0]), settings, told)
        _write_report(chain, output, how)
        report = read_report(output)
        numbers = summarize(report)
        clashes = bool(failing(numbers, let_pass))
        if as_json:
            click.echo(json.dumps(numbers))
        else:
            print_summary(report)
    if fail_on_clash and clashes:
        sys.exit(3)


@dataclass(frozen=True, slots=True)
class _How:
    """What is the same for all sessions and layouts."""

    settings: "EvaluateSettings"
    engine: options.EngineName
    resume: bool
    overwrite: bool
    progress: bool
    points: Literal["sample", "all"]


def _write_report(chain: "Chain", output: Path, how: _How) -> None:
    """Evaluate one recording against one scene into a report."""
    from hybridve.hull.evaluate import (
        about_objects,
        about_rig,
        computed_parts,
        count_frames,
        evaluate,
        local_origin_m,
        resolved_settings,
        stored_meshes,
    )
    from hybridve.hull.query.choose import open_engine
    from hybridve.hull.report.machine import Run
    from hybridve.hull.report.schema import ReportHeader
    from hybridve.hull.report.write import ReportWriter

    with open_engine(how.engine) as query:
        header = ReportHeader(
            run=Run.this(),
            objects=about_objects(chain),
            settings=resolved_settings(chain),
            rig=about_rig(chain),
            engine=query.name,
            renderer=query.renderer,
            parts=computed_parts(chain.settings),
            cameras=chain.views.names,
            local_origin_m=local_origin_m(chain),
            meshes=stored_meshes(chain),
            points=how.points,
        )
        with ReportWriter(output, header, resume=how.resume, overwrite=how.overwrite) as writer:
            total = count_frames(chain)
            evaluation = evaluate(
                chain,
                query,
                skip=writer.n_done,
                write_s=writer.take_write_s,
                progress=StageProgress(enabled=how.progress),
            )
            with (
                closing(evaluation) as results,
                progress_bar("detect", total, done=writer.n_done, enabled=how.progress) as advance,
            ):
                for result in results:
                    writer.append(result)
                    advance()
            if how.progress:
                click.echo(f"writing {output}", err=True)
            writer.finish()


def _detect_all(
    sessions: tuple[Path, ...],
    scenes: tuple[Path, ...],
    folder: Path,
    how: _How,
    let_pass: tuple[str, ...],
    *,
    as_json: bool,
) -> bool:
    """Test every session against every layout; tell whether a distance is not kept.

    One that fails is told and left out, and the others go on.
    """
    from hybridve.calib.errors import HybridveError, ReportError
    from hybridve.hull.cad.scene import load_scene
    from hybridve.hull.capture.session import load_session
    from hybridve.hull.report.compare import (
        Pair,
        compare,
        distinct_names,
        report_name,
        write_comparison,
    )
    from hybridve.hull.report.summarize import failing
    from hybridve.hull.report.write import refuse_existing

    try:
        session_names = distinct_names(sessions, "session.toml")
        scene_names = distinct_names(scenes, "scene.toml")
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    table = folder / COMPARISON
    _make_folder(folder)
    if not how.resume:
        for path in [
            *(folder / report_name(one, other) for one in session_names for other in scene_names),
            table,
        ]:
            refuse_existing(path, overwrite=how.overwrite)

    def load(loader: Any, path: Path) -> Any:
        try:
            return loader(path)
        except HybridveError as error:
            click.echo(f"error: {error}", err=True)
            return error

    loaded_sessions = [load(load_session, path) for path in sessions]
    loaded_scenes = [load(load_scene, path) for path in scenes]
    pairs: list[Pair] = []
    for name, session in zip(session_names, loaded_sessions, strict=True):
        for layout, scene in zip(scene_names, loaded_scenes, strict=True):
            lost = next((one for one in (session, scene) if isinstance(one, HybridveError)), None)
            if lost is not None:
                pairs.append(Pair(name, layout, None, str(lost)))
                continue
            if how.progress:
                count = len(sessions) * len(scenes)
                click.echo(f"{name}, {layout} ({len(pairs) + 1} of {count})", err=True)
            path = folder / report_name(name, layout)
            try:
                pairs.append(Pair(name, layout, _detect_one(session, scene, path, how)))
            except HybridveError as error:
                click.echo(f"error: {name}, {layout}: {error}", err=True)
                pairs.append(Pair(name, layout, None, str(error)))

    comparison = compare(pairs)
    write_comparison(table, comparison)
    if as_json:
        click.echo(json.dumps({"comparison": str(table), **comparison}))
    else:
        _print_comparison(table, comparison)
    if comparison["failed"]:
        raise ReportError(
            f"{folder}: {len(comparison['failed'])} of {len(pairs)} reports could not be made, as "
            "told above; the others stand there, and the same call with --resume makes the rest"
        )
    return any(failing(pair.summary, let_pass) for pair in pairs if pair.summary is not None)


def _make_folder(folder: Path) -> None:
    from hybridve.calib.errors import ReportError

    if folder.exists() and not folder.is_dir():
        raise ReportError(
            f"{folder}: is a file; several sessions or layouts need a folder for their reports"
        )
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise ReportError(f"{folder}: cannot be made: {error.strerror}") from error


def _detect_one(session: "Session", scene: "Scene", path: Path, how: _How) -> dict[str, Any]:
    """Return the summary of one report; one that is finished is not made again when resuming."""
    from hybridve.calib.errors import ReportError
    from hybridve.hull.evaluate import about_rig, make_chain, resolved_settings
    from hybridve.hull.report.read import read_report
    from hybridve.hull.report.summarize import summarize

    chain = make_chain(session, scene, how.settings, StageProgress(enabled=how.progress))
    if how.resume and path.exists() and not how.overwrite:
        found = read_report(path)
        wanted = json.loads(json.dumps([resolved_settings(chain), about_rig(chain)]))
        if [found.settings, found.rig] != wanted:
            raise ReportError(
                f"{path}: was finished with other settings, another recording or another scene; "
                "give the same again, or start anew with --overwrite"
            )
        return summarize(found)
    _write_report(chain, path, how)
    return summarize(read_report(path))


def _print_comparison(table: Path, comparison: dict[str, Any]) -> None:
    """Print sessions in columns; layouts and objects in rows."""
    sessions = comparison["sessions"]
    rows = [("layout", "object", *sessions)]
    for row in comparison["rows"]:
        cells = (_cell_text(row["sessions"].get(name)) for name in sessions)
        rows.append((row["layout"], row["object"], *cells))
    layouts = options.counted(len(comparison["layouts"]), "layout")
    click.echo(f"{table}: {options.counted(len(sessions), 'session')}, {layouts}")
    options.print_table(rows)


def _cell_text(cell: dict[str, Any] | None) -> str:
    """Return a verdict in a few words: with the clearance, or how deep and how often."""
    if cell is None:
        return "no report"
    parts = [cell["verdict"]]
    if clashing := cell["frames_colliding"] + cell["frames_inside"]:
        parts.append(f"{clashing} of {cell['frames']} frames")
        if cell["depth_upper_m"] is not None:
            parts.append(f"{1e3 * cell['depth_upper_m']:.1f} mm deep")
    elif cell["clearance_lower_m"] is not None:
        parts.append(f"{1e3 * cell['clearance_lower_m']:.1f} mm")
    if cell["required_clearance_m"] and cell["frames_below_required"]:
        below = f"{1e3 * cell['required_clearance_m']:g} mm"
        parts.append(f"{options.counted(cell['frames_below_required'], 'frame')} below {below}")
    return ", ".join(parts)
