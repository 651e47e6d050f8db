"""Recordings against layouts, into reports: one, or every session with every scene."""

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

from hybridve.calib.errors import HybridveError, ReportError, ask_all
from hybridve.hull.about import (
    about_objects,
    about_rig,
    computed_parts,
    local_origin_m,
    placements,
    resolved_settings,
    stored_meshes,
)
from hybridve.hull.cad.scene import Scene, load_scene
from hybridve.hull.capture.inspection import opened_session
from hybridve.hull.capture.session import Session
from hybridve.hull.chain import Chain, EvaluateSettings, count_frames, make_chain
from hybridve.hull.evaluate import evaluate
from hybridve.hull.query.choose import open_engine
from hybridve.hull.query.engine import EngineName
from hybridve.hull.report.compare import Pair, report_name
from hybridve.hull.report.machine import Run
from hybridve.hull.report.read import read_report
from hybridve.hull.report.result_file import refuse_other
from hybridve.hull.report.schema import ReportHeader
from hybridve.hull.report.summarize import summarize
from hybridve.hull.report.write import ReportWriter, refuse_existing, refuse_result
from hybridve.hull.trust import judge_cameras
from hybridve.hull.watcher import Watcher

_Loaded = TypeVar("_Loaded")


@dataclass(frozen=True, slots=True)
class DetectSettings:
    """What is the same for all sessions and layouts.

    Attributes
    ----------
    evaluation : EvaluateSettings
        How each recording is evaluated.
    engine : str
        What answers the volume query; "auto" for the fastest of this machine.
    points : "sample" or "all"
        Whether collision points are spelt out for programs that cannot make them from runs.
    resume : bool
        Whether reports that were cut off are taken up.
    overwrite : bool
        Whether what stands under a report's name is replaced.
    command : str
        What was called, for the report.
    """

    evaluation: EvaluateSettings
    engine: EngineName = "auto"
    points: Literal["sample", "all"] = "sample"
    resume: bool = False
    overwrite: bool = False
    command: str = ""


def detect_one(
    session: Path, scene: Path, output: Path, settings: DetectSettings, watcher: Watcher
) -> None:
    """Evaluate a recording against a layout into a report."""
    _, loaded, opened = ask_all(
        lambda: refuse_result(output, resume=settings.resume, overwrite=settings.overwrite),
        lambda: load_scene(scene),
        lambda: opened_session(session, settings.evaluation.drop_cameras),
    )
    _say_not_simulated(loaded, watcher)
    chain = make_chain(opened, loaded, settings.evaluation, watcher.stage)
    if _is_finished(chain, output, settings):
        watcher.say(f"{output}: stands already, finished with these settings")
    else:
        write_report(chain, output, settings, watcher)


def _say_not_simulated(scene: Scene, watcher: Watcher) -> None:
    """Say that effects are left alone, where a scene names some."""
    if scene.effects:
        kinds = ", ".join(str(effect["kind"]) for effect in scene.effects)
        watcher.say(
            f"{scene.path}: names effects ({kinds}), which detect leaves alone; "
            "`hybridve simulate` simulates them"
        )


def write_report(chain: Chain, output: Path, settings: DetectSettings, watcher: Watcher) -> None:
    """Evaluate a chain into a report; where one was cut off and is taken up, what is missing."""
    with open_engine(settings.engine) as engine:
        header = ReportHeader(
            run=Run.now(settings.command),
            objects=about_objects(chain),
            settings=resolved_settings(chain),
            rig=about_rig(chain),
            engine=engine.name,
            renderer=engine.renderer,
            parts=computed_parts(chain.settings),
            cameras=chain.views.names,
            local_origin_m=local_origin_m(chain),
            meshes=stored_meshes(chain),
            placements=placements(chain),
            points=settings.points,
        )
        with ReportWriter(
            output, header, resume=settings.resume, overwrite=settings.overwrite
        ) as writer:
            evaluation = evaluate(
                chain,
                engine,
                skip=writer.n_done,
                write_s=writer.take_write_s,
                progress=watcher.stage,
            )
            with (
                closing(evaluation) as results,
                watcher.steps("detect", count_frames(chain), done=writer.n_done) as advance,
            ):
                for result in results:
                    writer.append(result)
                    advance()
            watcher.say(f"writing {output}")
            writer.finish(
                judge_cameras(
                    chain.session,
                    chain.views,
                    writer.outlines(),
                    chain.room,
                    lenses=chain.undistortions,
                    is_still=not chain.tracks,
                )
            )


def detect_every(
    sessions: Mapping[str, Path],
    scenes: Mapping[str, Path],
    folder: Path,
    table: Path,
    settings: DetectSettings,
    watcher: Watcher,
) -> list[Pair]:
    """Test every session against every layout, a report each; those that fail are told and left.

    Parameters
    ----------
    sessions, scenes : mapping of str to Path
        Which, by the names that their reports take.
    folder : Path
        Where the reports go; it is made if it is not there.
    table : Path
        What the caller writes beside them; it is not replaced unless that is allowed.
    settings : DetectSettings
        How.
    watcher : Watcher
        Told what goes on, and what failed.

    Raises
    ------
    ReportError
        If something stands where a report is to be, before anything is done.
    """
    _make_folder(folder)
    if not settings.resume:
        refuse_existing(table, overwrite=settings.overwrite)
        for path in (folder / report_name(one, other) for one in sessions for other in scenes):
            refuse_result(path, resume=False, overwrite=settings.overwrite)
    dropped = settings.evaluation.drop_cameras

    def opened(path: Path) -> Session:
        return opened_session(path, dropped)

    loaded = {name: _load(opened, path, watcher) for name, path in sessions.items()}
    layouts = {name: _load(load_scene, path, watcher) for name, path in scenes.items()}
    for scene in layouts.values():
        if isinstance(scene, Scene):
            _say_not_simulated(scene, watcher)
    pairs: list[Pair] = []
    for name, session in loaded.items():
        for layout, scene in layouts.items():
            if isinstance(session, HybridveError) or isinstance(scene, HybridveError):
                lost = session if isinstance(session, HybridveError) else scene
                pairs.append(Pair(name, layout, None, str(lost)))
                continue
            count = len(sessions) * len(scenes)
            watcher.say(f"{name}, {layout} ({len(pairs) + 1} of {count})")
            path = folder / report_name(name, layout)
            try:
                found = _made_or_finished(session, scene, path, settings, watcher)
                pairs.append(Pair(name, layout, found))
            except HybridveError as error:
                for line in error.lines:
                    watcher.warn(f"error: {name}, {layout}: {line}")
                pairs.append(Pair(name, layout, None, str(error)))
    return pairs


def _load(
    loader: Callable[[Path], _Loaded], path: Path, watcher: Watcher
) -> _Loaded | HybridveError:
    """Return what a file holds, or why it cannot be read."""
    try:
        return loader(path)
    except HybridveError as error:
        for line in error.lines:
            watcher.warn(f"error: {line}")
        return error


def _make_folder(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise ReportError(
            f"{folder}: is a file; several sessions or layouts need a folder for their reports"
        )
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise ReportError(f"{folder}: cannot be made: {error.strerror}") from error


def _made_or_finished(
    session: Session, scene: Scene, path: Path, settings: DetectSettings, watcher: Watcher
) -> dict[str, Any]:
    """Return the summary of one report; one that is finished is not made again when resuming."""
    chain = make_chain(session, scene, settings.evaluation, watcher.stage)
    if not _is_finished(chain, path, settings):
        write_report(chain, path, settings, watcher)
    return summarize(read_report(path))


def _is_finished(chain: Chain, path: Path, settings: DetectSettings) -> bool:
    """Tell whether a run that is taken up has its report already: it was cut off behind its end.

    Raises
    ------
    ReportError
        If the report is of something else, or damaged.
    """
    if not settings.resume or settings.overwrite or not path.exists():
        return False
    found = read_report(path)
    refuse_other(path, [found.settings, found.rig], [resolved_settings(chain), about_rig(chain)])
    return True
