"""A sweep over one recording, from the files to what was measured."""

from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from typing import get_args

from hybridve.calib.errors import DeviceError
from hybridve.hull.about import about_objects, resolved_settings
from hybridve.hull.cad.scene import Scene
from hybridve.hull.capture.recording import FrameRange
from hybridve.hull.capture.session import Session
from hybridve.hull.chain import Chain, EvaluateSettings, count_frames, make_chain
from hybridve.hull.contact.detect import make_body
from hybridve.hull.query import choose
from hybridve.hull.query.certify import certify_triangles
from hybridve.hull.query.engine import EngineName
from hybridve.hull.report.machine import Run
from hybridve.hull.report.sweep_data import Sweep
from hybridve.hull.sweep.experiment import run_sweep
from hybridve.hull.sweep.frames import read_hulls, spread_frames
from hybridve.hull.sweep.judgement import make_rows, samples_asked
from hybridve.hull.sweep.room import EngineRoom
from hybridve.hull.watcher import Watcher

#: Looks of a sample into a camera that `reference` is given without being asked for: some minutes.
_MOST_REFERENCE_LOOKS = 10**9

#: All that can answer.
ENGINES: tuple[EngineName, ...] = tuple(name for name in get_args(EngineName) if name != "auto")


@dataclass(frozen=True, slots=True)
class SweepRequest:
    """What is measured.

    Attributes
    ----------
    viewports : tuple of int
        Samples along every triangle's edge, ascending.
    engines : tuple of str
        Which; none for all that this machine can open, and `reference` where it does not take long.
    frames : FrameRange or None
        Which; None for a few, spread over the recording.
    repeats : int
        How often each engine answers each viewport with the clock running.
    open_at_m : float
        The truth may lack collisions smaller than a disc of this diameter.
    accuracy_m : float or None
        How far apart the samples of the adaptive row are at most; None for what the middle viewport
        predicts.
    """

    viewports: tuple[int, ...]
    engines: tuple[EngineName, ...]
    frames: FrameRange | None
    repeats: int
    open_at_m: float
    accuracy_m: float | None


def sweep_session(
    session: Session, scene: Scene, asked: SweepRequest, command: str, watcher: Watcher
) -> Sweep:
    """Return what each viewport and engine costs on a recording, and what it misses.

    Raises
    ------
    HybridveError
        If recording, rig and scene do not fit together, or an engine that was named cannot be had.
    """
    chain, accuracy_m = _chain_of(session, scene, asked)
    rows = make_rows(scene.objects, asked.viewports, accuracy_m)
    with ExitStack() as stack:
        rooms = _open_rooms(asked.engines, stack, watcher)
        with watcher.steps("silhouettes", count_frames(chain)) as advance:
            hulls = read_hulls(chain, watcher.stage, advance)
        looks = samples_asked(hulls, rows) * len(chain.views) * (asked.repeats + 1)
        if not asked.engines and looks > _MOST_REFERENCE_LOOKS:
            rooms = [room for room in rooms if room.engine.name != "reference"]
            watcher.warn(
                f"reference is left out: {looks:.1e} looks of samples into cameras take it about "
                f"{looks / 1e7 / 60:.0f} minutes; name it with --engine to have it"
            )
        truth_room = next((room for room in rooms if room.engine.name == "native"), None)
        if truth_room is None:
            truth_room = stack.enter_context(EngineRoom(partial(choose.open_engine, "native")))

        def leave_out(name: str, error: Exception) -> None:
            watcher.warn(f"{name} is left out: {error}")

        steps = len(hulls) + len(rows) * len(rooms) * (asked.repeats + 1)
        with watcher.steps("sweep", steps, unit="step") as advance:
            outcome = run_sweep(
                hulls,
                rows,
                rooms,
                certify=certify_triangles,
                open_at_m=asked.open_at_m,
                truth_room=truth_room,
                repeats=asked.repeats,
                advance=advance,
                leave_out=None if asked.engines else leave_out,
            )
    return Sweep(
        run=Run.now(command),
        settings={
            **resolved_settings(chain),
            "viewports": list(asked.viewports),
            "engines": [engine.name for engine in outcome.engines],
            "repeats": asked.repeats,
            "open_at_m": asked.open_at_m,
            "objects": list(about_objects(chain)),
        },
        cameras=len(chain.views),
        rows=outcome.rows,
        frames=outcome.frames,
        truth=outcome.truth,
        engines=outcome.engines,
    )


def _chain_of(session: Session, scene: Scene, asked: SweepRequest) -> tuple[Chain, float]:
    """Return the recording made ready, and the accuracy of the adaptive row in metres."""
    accuracy_m = asked.accuracy_m
    if accuracy_m is None:
        middle = asked.viewports[len(asked.viewports) // 2]
        accuracy_m = max(make_body(one, viewport=middle).spacing_m for one in scene.objects)
    settings = EvaluateSettings(viewport=None, accuracy_m=accuracy_m)
    if asked.frames is not None:
        return make_chain(session, scene, replace(settings, frames=asked.frames)), accuracy_m
    chain = make_chain(session, scene, settings)
    spread = spread_frames(count_frames(chain))
    return replace(chain, settings=replace(settings, frames=spread)), accuracy_m


def _open_rooms(
    engines: tuple[EngineName, ...], stack: ExitStack, watcher: Watcher
) -> list[EngineRoom]:
    """Return the engines that were named, or else all that can be opened."""
    rooms = []
    for name in engines or ENGINES:
        try:
            rooms.append(stack.enter_context(EngineRoom(partial(choose.open_engine, name))))
        except (DeviceError, ImportError) as error:  # ImportError: moderngl without its libraries
            if engines:
                raise DeviceError(f"engine {name}: {error}") from error
            watcher.warn(f"{name} is left out: {error}")
    return rooms
