"""Engines and viewports on the same frames: what each costs, and what it misses.

Every engine is asked every row (a viewport for all triangles, or the viewports of an accuracy) of
all frames: once to warm up, when the answers are judged by the truth, and then several times with
the clock running. Within each of these repeats rows and engines take turns, so that a machine that
grows slower meanwhile is slower for all alike. A hull is a new one each time it is asked, as in a
recording, so that its upload counts.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import DeviceError
from hybridve.hull.contact.detect import Body, collision_points
from hybridve.hull.query.engine import Engine
from hybridve.hull.report.sweep_data import EngineSweep, SweepFrames, SweepRows, TruthSettings
from hybridve.hull.sweep.cost import fit_cost, window_px_read
from hybridve.hull.sweep.frames import HullFrame
from hybridve.hull.sweep.front import pareto_front
from hybridve.hull.sweep.judgement import (
    Judgement,
    Row,
    Truth,
    answer_of,
    find_truth,
    judge_all,
    largest,
    predicted_m,
)
from hybridve.hull.sweep.room import EngineRoom
from hybridve.hull.sweep.truth import (
    COLLIDING,
    OPEN,
    Certify,
)

#: By how much a distance may exceed the accuracy predicted: reported points are stored in single
#: precision, 1e-7 of some metres.
_ROUNDING_M = 1e-6

#: Tells the time in seconds.
Clock = Callable[[], float]


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What a sweep found: the parts of a `Sweep` that were measured."""

    rows: SweepRows
    frames: SweepFrames
    truth: TruthSettings
    engines: tuple[EngineSweep, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Work:
    """What the cost model counts, a frame: n m; per row n m u^2 / 2 and the stencil's windows."""

    transforms: float
    fill_px: NDArray[np.float64]
    window_px: NDArray[np.float64]
    is_uniform: NDArray[np.bool_]


def run_sweep(
    frames: Sequence[HullFrame],
    rows: Sequence[Row],
    rooms: Sequence[EngineRoom],
    *,
    certify: Certify,
    open_at_m: float,
    truth_room: EngineRoom,
    repeats: int,
    clock: Clock = time.perf_counter,
    advance: Callable[[], object] = lambda: None,
    leave_out: Callable[[str, DeviceError], object] | None = None,
) -> Outcome:
    """Return what every engine costs and misses in every row.

    Parameters
    ----------
    frames : sequence of HullFrame
        F > 0 frames.
    rows : sequence of Row
        U > 0 ways to lay the same bodies into viewports.
    rooms : sequence of EngineRoom
        The engines to compare.
    certify, open_at_m
        What certifies triangles, and up to what a collision may go unnoticed.
    truth_room : EngineRoom
        An engine in double precision, to sample the truth.
    repeats : int
        R > 0.
    clock : callable
        Tells the time in seconds.
    advance : callable
        Told after each frame of truth, and each time an engine has answered a row:
        F + U (R + 1) times the number of engines.
    leave_out : callable, optional
        Told ``(name, error)`` of an engine whose device fails when it warms up, which the others
        then do without. By default the error ends the sweep, as it does if no engine is left.

    Raises
    ------
    DeviceError
        If the device of an engine fails.
    """
    truth = find_truth(frames, rows, certify, open_at_m, truth_room, advance)
    rooms, judged = judge_all(frames, rows, rooms, truth, advance, leave_out)
    query_s = np.zeros((len(rooms), len(rows), repeats))
    place_s = np.zeros_like(query_s)
    for repeat in range(repeats):
        for number, row in enumerate(rows):
            for turn in range(len(rooms)):
                engine = (turn + repeat) % len(rooms)  # none always comes after the same other
                at = (engine, number, repeat)
                query_s[at], place_s[at] = rooms[engine].call(
                    _answer_in_time, rooms[engine], frames, row, clock
                )
                advance()

    largest_m = np.array([[largest(one.distances_m) for one in row] for row in judged])  # (E, U)
    costs = np.column_stack(
        [
            np.median(query_s + place_s, axis=2).ravel(),
            largest_m.ravel(),
            [one.objects_missed for row in judged for one in row],
        ]
    )
    on_front = pareto_front(costs).reshape(len(rooms), len(rows))
    work = _count_work(frames, rows, [room.engine.name for room in rooms])
    columns = _row_columns(rows, truth.near_triangles)
    return Outcome(
        columns,
        _frame_columns(frames, rows[0].bodies, truth),
        truth.settings,
        tuple(
            _engine_sweep(
                room.engine,
                len(frames),
                work,
                columns.predicted_near_m,
                judged[engine],
                query_s[engine],
                place_s[engine],
                on_front[engine],
            )
            for engine, room in enumerate(rooms)
        ),
    )


def _answer_in_time(
    room: EngineRoom, frames: Sequence[HullFrame], row: Row, clock: Clock
) -> tuple[float, float]:
    """Return seconds a frame from hull to samples, and from samples to points."""
    query_s = place_s = 0.0
    for frame in frames:
        started = clock()
        answers = answer_of(room, frame, row)
        answered = clock()
        for index, hits in answers.items():
            collision_points(frame.body(index, row.bodies[index]), hits)
        query_s += answered - started
        place_s += clock() - answered
    return query_s / len(frames), place_s / len(frames)


def _count_work(frames: Sequence[HullFrame], rows: Sequence[Row], engines: list[str]) -> _Work:
    n_cameras = len(frames[0].hull.views)
    share = np.mean([frame.near for frame in frames], axis=0)  # (B,) of the frames ask the body
    viewports = [[body.triangles.viewports for body in row.bodies] for row in rows]
    fill_px = np.array(
        [[0.5 * (one.astype(np.float64) ** 2).sum() for one in row] for row in viewports]
    )
    window_px = np.zeros_like(fill_px)
    if "stencil" in engines:
        from hybridve.hull.query.stencil import WINDOW_PX  # late: it loads OpenGL

        window_px[:] = [[window_px_read(one, WINDOW_PX) for one in row] for row in viewports]
    return _Work(
        transforms=n_cameras * float(share @ [len(one) for one in viewports[0]]),
        fill_px=n_cameras * fill_px @ share,
        window_px=window_px @ share,
        is_uniform=np.array([row.viewport > 0 for row in rows]),
    )


def _row_columns(rows: Sequence[Row], near_triangles: list[NDArray[np.bool_]]) -> SweepRows:
    meshes = [[body.triangles for body in row.bodies] for row in rows]
    return SweepRows(
        viewport=np.array([row.viewport for row in rows], np.uint32),
        accuracy_m=np.array([row.accuracy_m for row in rows]),
        viewport_most=np.array(
            [max(int(mesh.viewports.max()) for mesh in row) for row in meshes], np.uint32
        ),
        samples=np.array(
            [sum(int(mesh.topology.samples_before[-1]) for mesh in row) for row in meshes],
            np.uint64,
        ),
        predicted_m=np.array([max(body.spacing_m for body in row.bodies) for row in rows]),
        predicted_near_m=np.array([predicted_m(row, near_triangles) for row in rows]),
    )


def _percentile(values: NDArray[np.float64], percent: float) -> float:
    return float(np.percentile(values, percent)) if len(values) else float("nan")


def _frame_columns(frames: Sequence[HullFrame], bodies: list[Body], truth: Truth) -> SweepFrames:
    lengths = np.array([len(body.triangles) for body in bodies])

    def counts(verdict: int) -> NDArray[np.uint32]:
        return np.array(
            [
                sum(int((one.verdict == verdict).sum()) for one in frame.values())
                for frame in truth.frames
            ],
            np.uint32,
        )

    return SweepFrames(
        index=np.array([frame.index for frame in frames], np.uint32),
        decode_s=np.array([frame.decode_s for frame in frames]),
        segment_s=np.array([frame.segment_s for frame in frames]),
        hull_s=np.array([frame.hull_s for frame in frames]),
        boxes_s=np.array([frame.boxes_s for frame in frames]),
        certify_s=truth.certify_s,
        sample_s=truth.sample_s,
        triangles_asked=np.array([lengths[frame.near].sum() for frame in frames], np.uint32),
        triangles_colliding=counts(COLLIDING),
        triangles_open=counts(OPEN),
        objects_colliding=np.array(
            [sum(one.collides for one in frame.values()) for frame in truth.frames], np.uint32
        ),
        truth_points=np.array(
            [
                sum(len(one.witnesses_world) + len(one.dense_world) for one in frame.values())
                for frame in truth.frames
            ],
            np.uint64,
        ),
    )


def _engine_sweep(
    engine: Engine,
    n_frames: int,
    work: _Work,
    predicted_near_m: NDArray[np.float64],
    judged: list[Judgement],
    query_s: NDArray[np.float64],
    place_s: NDArray[np.float64],
    on_front: NDArray[np.bool_],
) -> EngineSweep:
    points = np.array([one.n_points / n_frames for one in judged])
    # Where a window is read back it is so wholly; elsewhere what was found is.
    reads_window = engine.name == "stencil"
    cost = fit_cost(
        np.median(query_s + place_s, axis=1),
        transforms=work.transforms,
        fill_px=work.fill_px,
        read_back_px=work.window_px if reads_window else points,
        read_back="window pixel" if reads_window else "sample inside",
        fitted=work.is_uniform,
    )
    return EngineSweep(
        name=engine.name,
        renderer=engine.renderer,
        query_s=query_s,
        place_s=place_s,
        points=points,
        triangles_missed=np.array([one.triangles_missed for one in judged], np.uint32),
        objects_missed=np.array([one.objects_missed for one in judged], np.uint32),
        triangles_against_proof=np.array(
            [one.triangles_against_proof for one in judged], np.uint32
        ),
        distance_max_m=np.array([largest(one.distances_m) for one in judged]),
        distance_p99_m=np.array([_percentile(one.dense_m, 99) for one in judged]),
        distance_median_m=np.array([_percentile(one.dense_m, 50) for one in judged]),
        within_predicted=np.array(
            [
                float(np.mean(one.distances_m <= predicted_m + _ROUNDING_M))
                if len(one.distances_m)
                else np.nan
                for one, predicted_m in zip(judged, predicted_near_m, strict=True)
            ]
        ),
        on_front=on_front,
        cost=cost,
    )
