"""A simulation made again and again, with another step or viewport: time against accuracy."""

from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError, SessionError
from hybridve.calib.pose import placed
from hybridve.hull.cad.scene import Scene
from hybridve.hull.capture.session import Session
from hybridve.hull.chain import Chain, EvaluateSettings, FrameHull, count_frames, hulls, make_chain
from hybridve.hull.effects.effect import Drawn
from hybridve.hull.query.choose import open_engine
from hybridve.hull.query.engine import Engine
from hybridve.hull.report.machine import Run
from hybridve.hull.report.simulation_data import SimulatedFrame
from hybridve.hull.report.simulation_sweep import SimulationSweep
from hybridve.hull.simulate import SimulateSettings, Simulation
from hybridve.hull.sweep.front import pareto_front
from hybridve.hull.watcher import Watcher

Over = Literal["step", "viewport"]

#: Bytes that the hulls may take: they stay in memory, to be gone through again and again.
_MOST_BYTES = 2 << 30


@dataclass(frozen=True, slots=True)
class SimulationSweepRequest:
    """What is measured.

    Attributes
    ----------
    over : "step" or "viewport"
        What is changed.
    values : tuple of float
        Seconds a step, or samples along an edge, at least two, all different.
    settings : SimulateSettings
        All else; its own step or viewport is the one that is marked.
    repeats : int
        How often each value is gone through.
    """

    over: Over
    values: tuple[float, ...]
    settings: SimulateSettings
    repeats: int


@dataclass(frozen=True, slots=True, eq=False)
class _Outcome:
    """What one run with one value found."""

    time_s: float
    penetration_m: float
    excess_j: float
    most_j: float
    places: list[NDArray[np.float64]]


def sweep_simulation(
    session: Session,
    scene: Scene,
    asked: SimulationSweepRequest,
    command: str,
    watcher: Watcher,
) -> SimulationSweep:
    """Return what each step, or viewport, costs a simulation, and what it is off by.

    The finest value is what the others are compared with: the shortest step, the largest viewport.

    Raises
    ------
    HybridveError
        If recording, rig and scene do not fit together, the scene names no effect, or a simulation
        was stopped.
    """
    if not scene.effects:
        raise SceneError(f"{scene.path}: names no effect to sweep; add an [[effect]] table")
    chain = make_chain(session, scene, asked.settings.evaluation, watcher.stage)
    frames = _read(chain, watcher)
    outcomes: list[list[_Outcome]] = [[] for _ in asked.values]
    total = len(asked.values) * asked.repeats
    with (
        open_engine(asked.settings.engine) as engine,
        watcher.steps("sweep", total, unit="run") as advance,
    ):
        for _ in range(asked.repeats):  # in turn: what else the machine does falls on all alike
            for number, value in enumerate(asked.values):
                outcomes[number].append(_run(chain, engine, frames, asked, value))
                advance()
    values = np.array(asked.values)
    finest = int(values.argmin() if asked.over == "step" else values.argmax())
    best = outcomes[finest][0].places
    # One run is like another but for its time.
    firsts = [of_value[0] for of_value in outcomes]
    distances_m = [_distances(one.places, best) for one in firsts]
    time_s = np.array([[one.time_s for one in of_value] for of_value in outcomes])
    distance_max_m = np.array([float(one.max(initial=0.0)) for one in distances_m])
    excess_j = np.array([one.excess_j for one in firsts])
    most_j = np.array([one.most_j for one in firsts])
    settings = asked.settings
    chosen = settings.step_s if asked.over == "step" else settings.evaluation.viewport
    return SimulationSweep(
        run=Run.now(command),
        settings={
            "over": asked.over,
            "chosen": chosen,
            "finest": float(values[finest]),
            "session": str(session.path),
            "session_sha256": session.checksum,
            "scene": str(scene.path),
            "scene_sha256": scene.checksum,
            "frames": str(settings.evaluation.frames),
            "n_frames": len(frames),
            "step_s": settings.step_s,
            "viewport": settings.evaluation.viewport,
            "hull": settings.hull,
            "seed": settings.seed,
            "effects": [str(effect["kind"]) for effect in scene.effects],
            "repeats": asked.repeats,
        },
        value=values,
        time_s=time_s,
        penetration_m=np.array([one.penetration_m for one in firsts]),
        excess_j=excess_j,
        excess_share=np.divide(excess_j, most_j, out=np.zeros_like(excess_j), where=most_j > 0),
        distance_median_m=np.array(
            [float(np.median(one)) if len(one) else 0.0 for one in distances_m]
        ),
        distance_max_m=distance_max_m,
        on_front=pareto_front(np.stack([np.median(time_s, axis=1), distance_max_m], axis=1)),
    )


def _read(chain: Chain, watcher: Watcher) -> list[FrameHull]:
    """Return the chosen frames with their hulls, to be gone through again and again."""
    kept: list[FrameHull] = []
    n_bytes = 0
    with (
        closing(hulls(chain, progress=watcher.stage)) as frames,
        watcher.steps("silhouettes", count_frames(chain)) as advance,
    ):
        for frame in frames:
            kept.append(frame)
            if frame.hull is not None:
                n_bytes += frame.hull.masks_flat.nbytes + frame.hull.integrals_flat.nbytes
            if n_bytes > _MOST_BYTES:
                raise SessionError(
                    f"{chain.session.path}: the hulls of {len(kept)} frames fill "
                    f"{_MOST_BYTES >> 30} GiB of memory; take fewer with --frames START:STOP"
                )
            advance()
    return kept


def _run(
    chain: Chain,
    engine: Engine,
    frames: Sequence[FrameHull],
    asked: SimulationSweepRequest,
    value: float,
) -> _Outcome:
    settings = asked.settings
    if asked.over == "step":
        settings = replace(settings, step_s=value)
    else:
        evaluation: EvaluateSettings = replace(settings.evaluation, viewport=int(value))
        settings = replace(settings, evaluation=evaluation)
        chain = replace(chain, settings=evaluation)
    simulation = Simulation.of(chain, engine, settings)

    def again() -> Generator[FrameHull]:
        yield from frames

    found = list(simulation.run(frames=again()))
    if found[-1].blew_up:
        raise SessionError(
            f"{chain.session.path}: with {asked.over} {value:g} the simulation was stopped: "
            f"{found[-1].blew_up}"
        )
    drawn = {
        name: told.drawn for effect, _ in simulation.effects for name, told in effect.told.items()
    }
    energy_j = _sums(found, "kinetic_j") + _sums(found, "potential_j")
    given_j = energy_j[0] + _sums(found, "hull_work_j") + _sums(found, "cad_work_j")
    seconds = [
        one.stage_s["between"]
        + sum(float(one.values[names[0]]["step_s"]) for _, names in simulation.effects)
        for one in found
    ]
    return _Outcome(
        time_s=float(np.mean(seconds)),
        penetration_m=max(
            float(np.nanmax([values["penetration_m"], 0.0]))
            for one in found
            for values in one.values.values()
        ),
        excess_j=max(0.0, float((energy_j - given_j).max())),
        most_j=float(np.ptp(energy_j)) or float(np.abs(energy_j).max()),
        places=[_places(one, drawn) for one in found],
    )


def _sums(frames: Sequence[SimulatedFrame], name: str) -> NDArray[np.float64]:
    """Return the sum over all effects that tell it of one of their numbers, frame by frame."""
    return np.array(
        [sum(float(values.get(name, 0.0)) for values in frame.values.values()) for frame in frames]
    )


def _places(frame: SimulatedFrame, drawn: dict[str, Drawn | None]) -> NDArray[np.float64]:
    """Return where all that moves is shown, (P, 3) metres."""
    parts: list[Any] = [np.zeros((0, 3))]
    for name, how in drawn.items():
        if how is None or not how.column:
            continue
        column = frame.values[name][how.column]
        parts.append(column if how.vertices is None else placed(how.vertices, column))
    return np.concatenate(parts).astype(np.float64)


def _distances(
    places: list[NDArray[np.float64]], best: list[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return how far each point is from where the best run has it, in all frames."""
    apart = np.linalg.norm(np.concatenate(places) - np.concatenate(best), axis=1)
    found: NDArray[np.float64] = apart[np.isfinite(apart)]
    return found
