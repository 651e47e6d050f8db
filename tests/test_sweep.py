"""The experiment of ``hybridve sweep``: truth, distances, missed triangles, order, cost model."""

import json
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np
import pytest
from helpers.sessions import BALL_RADIUS_M, SIZE_PX, ball_mask, ring_matrix
from helpers.sweeps import COLLIDING, FREE, OPEN, BruteCertificates, certify_by_samples
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from hybridve.calib.errors import DeviceError, ReportError
from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.query import stencil
from hybridve.hull.query.engine import Engine, Hits, Triangles
from hybridve.hull.query.reference import Reference, contains_points
from hybridve.hull.query.silhouettes import Hull, make_hull, make_views
from hybridve.hull.report import sweep_file
from hybridve.hull.report.machine import Run
from hybridve.hull.report.sweep_data import Sweep
from hybridve.hull.report.sweep_file import held, read_sweep, sweep_as_dict, write_sweep
from hybridve.hull.sweep.cost import fit_cost, window_px_read
from hybridve.hull.sweep.experiment import Outcome, run_sweep
from hybridve.hull.sweep.frames import HullFrame, near_bodies, spread_frames
from hybridve.hull.sweep.front import pareto_front
from hybridve.hull.sweep.judgement import make_rows, samples_asked
from hybridve.hull.sweep.room import EngineRoom
from hybridve.hull.sweep.truth import (
    BodyTruth,
    affordable_spacing,
    dense_mesh,
    dense_viewports,
    sample_body,
)

#: Reported points are stored in single precision.
SINGLE_M = 1e-6

N_CAMERAS = 5

NO_POINT = np.zeros((0, 3))


def ball_hull(center: tuple[float, float, float]) -> Hull:
    matrices = [ring_matrix(camera, N_CAMERAS) for camera in range(N_CAMERAS)]
    views = make_views(
        tuple(f"cam{camera}" for camera in range(N_CAMERAS)),
        np.array([SIZE_PX] * N_CAMERAS),
        np.array(matrices),
    )
    masks = [(ball_mask(matrix, np.array(center)) > 0).astype(np.uint8) for matrix in matrices]
    return make_hull(views, masks)


def thing(vertices_m: object, faces: object = ((0, 1, 2),)) -> SceneObject:
    return SceneObject(
        "thing", Path("thing.obj"), np.array(vertices_m, float), np.array(faces, np.int32), 0.0,
        np.zeros(3), None,
    )  # fmt: skip


def box(half_m: float) -> SceneObject:
    """A box whose 12 triangles have legs of twice `half_m`."""
    corners = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)]) * 2.0 - 1.0
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return thing(half_m * corners, faces)


def frames_of(objects: list[SceneObject], hulls: list[Hull]) -> list[HullFrame]:
    bodies = make_rows(objects, (2,), 1.0)[0].bodies
    return [
        HullFrame(index, hull, near_bodies(hull, bodies), 0.0, 0.0, 0.0, 0.0)
        for index, hull in enumerate(hulls)
    ]


def sweep_of(
    objects: list[SceneObject],
    hulls: list[Hull],
    viewports: tuple[int, ...],
    *,
    engines: tuple[Callable[[], Engine], ...] = (Reference,),
    accuracy_m: float = 0.1,
    repeats: int = 1,
    **others: Any,
) -> Outcome:
    with ExitStack() as stack:
        rooms = [stack.enter_context(EngineRoom(engine)) for engine in engines]
        truth_room = stack.enter_context(EngineRoom(Reference))
        return run_sweep(
            frames_of(objects, hulls),
            make_rows(objects, viewports, accuracy_m),
            rooms,
            open_at_m=0.01,
            truth_room=truth_room,
            repeats=repeats,
            **{"certify": certify_by_samples, **others},
        )


LARGE = thing([(-1.5, -1.0, 0.0), (1.5, -1.0, 0.0), (0.0, 1.5, 0.0)])


def test_a_ball_between_the_samples_is_missed_and_said_to_be() -> None:
    outcome = sweep_of([LARGE], [ball_hull((0.0, 0.0, 0.0))], (2, 3, 33))

    (engine,) = outcome.engines
    assert outcome.frames.triangles_colliding.tolist() == [1]
    assert outcome.frames.objects_colliding.tolist() == [1]
    # Viewports 2 and 3 sample corners and middles of edges, 0.75 m and more from the ball.
    assert engine.triangles_missed.tolist()[:3] == [1, 1, 0]
    assert engine.objects_missed.tolist()[:3] == [1, 1, 0]
    assert np.isnan(engine.distance_max_m[:2]).all()
    assert 0 < engine.distance_max_m[2] <= outcome.rows.predicted_near_m[2]
    assert [held(engine, row) for row in range(3)] == [False, False, True]
    assert not engine.on_front[:2].any()
    assert engine.points[0] == 0
    assert engine.points[2] > 0


def test_inside_the_hull_the_largest_distance_is_half_the_one_predicted() -> None:
    # A right-angled triangle with legs L inside the ball: every sample is reported, L / (u - 1)
    # apart, and the middle of their squares is the farthest, L / (u - 1) / sqrt(2).
    leg_m = 0.0625
    small = thing([(0.0, 0.0, 0.0), (leg_m, 0.0, 0.0), (0.0, leg_m, 0.0)])

    outcome = sweep_of([small], [ball_hull((0.0, 0.0, 0.0))], (2, 3, 5, 9))

    (engine,) = outcome.engines
    steps = np.array([1, 2, 4, 8])
    np.testing.assert_allclose(engine.distance_max_m[:4], leg_m / steps / np.sqrt(2), atol=SINGLE_M)
    np.testing.assert_allclose(outcome.rows.predicted_m[:4], leg_m * np.sqrt(2) / steps)
    np.testing.assert_array_equal(outcome.rows.predicted_m, outcome.rows.predicted_near_m)
    assert engine.within_predicted.tolist() == [1.0] * 5
    assert engine.points[:4].tolist() == [3, 6, 15, 45]
    finest_m = outcome.rows.predicted_m.min()
    assert outcome.truth.spacing_m == outcome.truth.spacing_wanted_m == finest_m / 4


@pytest.mark.parametrize("viewport", [3, 6])
def test_distances_are_those_of_brute_force(viewport: int) -> None:
    half_m, hulls = 0.1, [ball_hull((0.22, 0.0, 0.03)), ball_hull((0.0, 0.13, 0.14))]
    one = box(half_m)

    outcome = sweep_of([one], hulls, (viewport,), accuracy_m=0.2)

    corners = one.vertices_world[one.faces]
    (body,) = make_rows([one], (2,), 1.0)[0].bodies
    longest_m = np.sqrt(2) * 2 * half_m
    u = int(np.ceil(longest_m / outcome.truth.spacing_m) + 1)
    of_witnesses: list[NDArray[np.float64]] = []
    of_samples: list[NDArray[np.float64]] = []
    missed = 0
    for hull in hulls:
        certificates = certify_by_samples(hull, body.triangles, 0.01)
        witnesses = certificates.witness_world[certificates.verdict == COLLIDING]
        truth: list[NDArray[np.float64]] = []
        reported: list[NDArray[np.float64]] = []
        for triangle in corners:
            for viewports, found in ((u, truth), (viewport, reported)):
                grid = [(i, j) for j in range(viewports) for i in range(viewports - j)]
                i, j = np.array(grid).T[:, :, None] / (viewports - 1.0)
                a, b, c = triangle
                places = a + (b - a) * i + (c - a) * j
                found.append(places[contains_points(hull, places)])
            missed += len(truth[-1]) > 0 and len(reported[-1]) == 0
        for true_world, distances in (
            (witnesses, of_witnesses),
            (np.concatenate(truth), of_samples),
        ):
            gaps = true_world[:, None] - np.concatenate(reported)[None]
            distances.append(np.linalg.norm(gaps, axis=2).min(axis=1))
    sampled = np.concatenate(of_samples)
    expected = np.concatenate([*of_witnesses, sampled])
    (engine,) = outcome.engines
    assert outcome.frames.truth_points.sum() == len(expected) > 100
    assert engine.distance_max_m[0] == pytest.approx(expected.max(), abs=SINGLE_M)
    assert engine.distance_median_m[0] == pytest.approx(np.median(sampled), abs=SINGLE_M)
    assert engine.distance_p99_m[0] == pytest.approx(np.percentile(sampled, 99), abs=SINGLE_M)
    within = np.mean(expected <= longest_m / (viewport - 1) + SINGLE_M)
    assert engine.within_predicted[0] == pytest.approx(within)
    assert engine.triangles_missed[0] == missed


def test_where_nothing_collides_only_time_is_measured() -> None:
    objects = [thing(LARGE.vertices_world + np.array([0.0, 0.0, 2 * BALL_RADIUS_M]))]

    outcome = sweep_of(objects, [ball_hull((0.0, 0.0, -0.3))], (2, 4, 8))

    (engine,) = outcome.engines
    assert not outcome.frames.triangles_colliding.any()
    assert not outcome.frames.truth_points.any()
    for name in ("distance_max_m", "distance_p99_m", "distance_median_m", "within_predicted"):
        assert np.isnan(getattr(engine, name)).all()
    assert not engine.on_front.any()
    assert not engine.triangles_missed.any()
    assert (engine.query_s > 0).all()
    assert held(engine, 0) is None


def test_objects_that_are_proved_far_are_not_asked() -> None:
    far = thing(LARGE.vertices_world + np.array([0.0, 0.0, 900.0]), [(0, 1, 2), (0, 2, 1)])
    hull = ball_hull((0.0, 0.0, 0.0))

    outcome = sweep_of([LARGE, far], [hull], (2, 4, 8))

    assert outcome.frames.triangles_asked.tolist() == [1]
    assert outcome.engines[0].cost is not None
    assert outcome.engines[0].cost.fill_px[2] == N_CAMERAS * 1 * 8 * 8 / 2
    rows = make_rows([LARGE, far], (2,), 1.0)[:1]
    assert samples_asked(frames_of([LARGE, far], [hull]), rows) == 3


class Logged:
    """An engine whose cost is made up and told to a clock, and which writes down what it was asked.

    `answer` gives what it says in place of the truth.
    """

    renderer = "none"
    any_thread = True

    def __init__(self, name: str, log: list[Any], clock: "Clock", answer: str = "") -> None:
        self.name = name
        self._log = log
        self._clock = clock
        self._answer = answer

    def query(self, hull: Hull, meshes: list[Triangles]) -> list[Hits]:
        viewport = int(meshes[0].viewports[0])
        self._log.append((self.name, viewport, hull, threading.get_ident()))
        fill_px = sum(N_CAMERAS * 0.5 * float((mesh.viewports**2.0).sum()) for mesh in meshes)
        self._clock.now_s += 0.004 + 3e-9 * fill_px
        if self._answer == "everything":
            return [
                Hits(mesh.topology, np.zeros(1, np.int64), mesh.topology.samples_before[-1:])
                for mesh in meshes
            ]
        return Reference().query(hull, meshes)

    def close(self) -> None:
        self._log.append((self.name, 0, None, threading.get_ident()))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_engines_and_viewports_take_turns_in_every_repeat() -> None:
    log: list[Any] = []
    clock = Clock()
    engines = tuple((lambda name=name: Logged(name, log, clock)) for name in ("a", "b"))
    hulls = [ball_hull((0.0, 0.0, 0.0)), ball_hull((0.1, 0.0, 0.0))]

    sweep_of([LARGE], hulls, (2, 4, 8), engines=engines, repeats=3, accuracy_m=1.0, clock=clock)

    asked = [(name, viewport) for name, viewport, hull, _ in log if hull is not None]
    pairs = {(name, viewport) for name in ("a", "b") for viewport in (2, 4, 8)}
    in_a_round = 2 * 4 * len(hulls)  # the row of the accuracy has the viewport 4 too
    assert len(asked) == (1 + 3) * in_a_round
    for start in range(0, len(asked), in_a_round):
        round_ = asked[start : start + in_a_round]
        assert set(round_) == pairs
        assert all(
            round_.count((name, viewport)) == len(hulls) * (1 + (viewport == 4))
            for name, viewport in pairs
        )
        names = [name for name, _ in round_]
        assert names != sorted(names), "one engine after the other"
    begins = [asked[start][0] for start in range(in_a_round, len(asked), in_a_round)]
    assert begins == ["a", "b", "a"], "the same engine is always first"


def test_every_hull_is_new_to_the_engine_and_every_engine_has_its_thread() -> None:
    log: list[Any] = []
    clock = Clock()
    engines = tuple((lambda name=name: Logged(name, log, clock)) for name in ("a", "b"))

    sweep_of([LARGE], [ball_hull((0.0, 0.0, 0.0))], (2, 4), engines=engines, repeats=2, clock=clock)

    hulls = [hull for _, _, hull, _ in log if hull is not None]
    assert len({id(hull) for hull in hulls}) == len(hulls) == 3 * 3 * 2
    threads = {name: {one for who, _, _, one in log if who == name} for name in ("a", "b")}
    assert len(threads["a"]) == len(threads["b"]) == 1, "closed in another thread than opened"
    assert threads["a"] != threads["b"]
    assert threading.get_ident() not in threads["a"] | threads["b"]


def test_times_are_means_over_frames_and_the_model_finds_what_made_them() -> None:
    log: list[Any] = []
    clock = Clock()
    hulls = [ball_hull((0.0, 0.0, 0.0)), ball_hull((0.1, 0.0, 0.0))]

    outcome = sweep_of(
        [LARGE],
        hulls,
        (2, 4, 8, 16, 32),
        engines=(lambda: Logged("made up", log, clock),),
        repeats=2,
        clock=clock,
    )

    (engine,) = outcome.engines
    viewports = outcome.rows.viewport[:5].astype(float)
    expected_s = 0.004 + 3e-9 * N_CAMERAS * viewports**2 / 2
    np.testing.assert_allclose(engine.query_s[:5], np.stack([expected_s] * 2, axis=1))
    assert not engine.place_s.any()
    np.testing.assert_allclose(engine.time_median_s[:5], expected_s)
    np.testing.assert_allclose(engine.time_iqr_s, 0.0, atol=1e-12)
    assert engine.cost is not None
    assert engine.cost.fixed_s == pytest.approx(0.004)
    assert engine.cost.transform_most_s == pytest.approx(0.004 / N_CAMERAS)
    assert engine.cost.fill_s_per_px == pytest.approx(3e-9, rel=1e-4)
    assert engine.cost.residual_most < 1e-9
    assert engine.cost.fitted.tolist() == [True] * 5 + [False]
    assert abs(engine.cost.residual[5]) < 1e-9, "the row that was not fitted is foretold"


class Broken(Logged):
    """An engine that opens, and whose device fails at the second viewport."""

    def query(self, hull: Hull, meshes: list[Triangles]) -> list[Hits]:
        if meshes[0].viewports[0] == 4:
            raise DeviceError("out of memory")
        return super().query(hull, meshes)


def test_an_engine_whose_device_fails_is_left_out_if_that_is_allowed() -> None:
    log: list[Any] = []
    told: list[tuple[str, str]] = []
    hulls = [ball_hull((0.0, 0.0, 0.0))]

    def broken() -> Engine:
        return Broken("broken", log, Clock())

    outcome = sweep_of(
        [LARGE],
        hulls,
        (2, 4, 8),
        engines=(broken, Reference),
        repeats=2,
        leave_out=lambda name, error: told.append((name, str(error))),
    )

    assert told == [("broken", "out of memory")]
    (left,) = outcome.engines
    assert left.name == "reference"
    assert left.points[2] == sweep_of([LARGE], hulls, (2, 4, 8)).engines[0].points[2] > 0
    with pytest.raises(DeviceError, match="out of memory"):
        sweep_of([LARGE], hulls, (2, 4), engines=(broken, Reference))
    with pytest.raises(DeviceError, match="out of memory"):
        sweep_of([LARGE], hulls, (2, 4), engines=(broken,), leave_out=lambda *_: None)


def test_an_engine_that_contradicts_a_proof_is_found_out() -> None:
    log: list[Any] = []
    clock = Clock()
    aside = thing(
        [*LARGE.vertices_world, (1.5, 1.5, 0.0), (1.6, 1.5, 0.0), (1.5, 1.6, 0.0)],
        [(0, 1, 2), (3, 4, 5)],
    )

    outcome = sweep_of(
        [aside],
        [ball_hull((0.0, 0.0, 0.0))],
        (2,),
        engines=(Reference, lambda: Logged("liar", log, clock, "everything")),
    )

    reference, liar = outcome.engines
    assert reference.triangles_against_proof.tolist() == [0, 0]
    assert liar.triangles_against_proof.tolist() == [1, 1]
    assert liar.triangles_missed.tolist() == [0, 0]


def test_a_dense_sample_is_a_witness_of_a_triangle_left_open() -> None:
    hull = ball_hull((0.0, 0.0, 0.0))
    (body,) = make_rows([LARGE], (2,), 1.0)[0].bodies
    left_open = BodyTruth(np.array([OPEN], np.int8), NO_POINT, NO_POINT, 0.1)
    proved = BodyTruth(np.array([FREE], np.int8), NO_POINT, NO_POINT, 0.0)
    dense = dense_mesh(body.triangles, np.array([True]), 0.05)

    found = sample_body(hull, left_open, dense, Reference(), 100)

    assert found.collides
    assert len(found.witnesses_world) == 1
    assert 50 < len(found.dense_world) <= 100
    assert contains_points(hull, found.witnesses_world).all()
    assert contains_points(hull, found.dense_world).all()
    assert not sample_body(hull, proved, dense, Reference(), 100).collides


def test_every_triangle_that_a_dense_sample_convicts_keeps_a_point() -> None:
    hull = ball_hull((0.0, 0.0, 0.0))
    (body,) = make_rows([box(0.05)], (2,), 1.0)[0].bodies  # wholly inside the ball
    left_open = BodyTruth(np.full(12, OPEN, np.int8), NO_POINT, NO_POINT, 0.1)
    dense = dense_mesh(body.triangles, np.ones(12, np.bool_), 0.05)

    found = sample_body(hull, left_open, dense, Reference(), 1)

    assert (found.verdict == COLLIDING).all()
    assert len(found.witnesses_world) == 12
    assert len(found.dense_world) == 1


def test_without_certificates_the_dense_samples_alone_make_the_truth() -> None:
    def certify_nothing(hull: Hull, mesh: Triangles, open_at_m: float) -> BruteCertificates:
        n = len(mesh)
        unknown = np.full((n, 3), np.nan)
        return BruteCertificates(np.full(n, OPEN, np.int8), unknown, np.full(n, np.inf))

    objects, hulls = [box(0.1)], [ball_hull((0.22, 0.0, 0.03))]

    blind = sweep_of(objects, hulls, (2, 9), certify=certify_nothing)
    seeing = sweep_of(objects, hulls, (2, 9))

    np.testing.assert_array_equal(
        blind.frames.triangles_colliding, seeing.frames.triangles_colliding
    )
    assert 0 < blind.frames.triangles_colliding[0] < 12
    assert blind.frames.triangles_open[0] == 12 - blind.frames.triangles_colliding[0]
    assert blind.truth.open_most_m == np.inf
    assert seeing.truth.open_most_m < np.inf
    np.testing.assert_array_equal(
        blind.engines[0].triangles_missed, seeing.engines[0].triangles_missed
    )
    found = (blind.rows, blind.frames, blind.truth, blind.engines)
    json.dumps(sweep_as_dict(Sweep(Run("", "", {}, ""), {}, N_CAMERAS, *found)), allow_nan=False)


def test_frames_with_the_same_answer_are_each_measured_by_their_own_truth() -> None:
    # Both balls swallow the one sample at the corner, the second reaches farther from it.
    corner = thing([(0.0, 0.0, 0.0), (1.5, 0.0, 0.0), (0.0, 1.5, 0.0)])
    near, far = ball_hull((0.0, 0.0, 0.0)), ball_hull((0.08, 0.08, 0.0))

    alone = [sweep_of([corner], [hull], (2,), accuracy_m=1.0).engines[0] for hull in (near, far)]
    together = sweep_of([corner], [near, far], (2,), accuracy_m=1.0).engines[0]

    assert [engine.points[0] for engine in alone] == [1, 1]
    assert alone[1].distance_max_m[0] > alone[0].distance_max_m[0] + 0.05
    assert together.distance_max_m[0] == alone[1].distance_max_m[0]


@given(
    viewports=st.lists(st.integers(1, 5), min_size=1, max_size=8),
    seed=st.integers(0, 2**32 - 1),
    share=st.floats(0.0, 1.0),
    most=st.integers(1, 40),
)
def test_samples_are_counted_and_thinned_without_writing_them_out(
    viewports: list[int], seed: int, share: float, most: int
) -> None:
    n = len(viewports)
    mesh = Triangles(
        np.zeros((3, 3)),
        np.tile(np.arange(3, dtype=np.int32), (n, 1)),
        np.array(viewports, np.int32),
    )
    topology = mesh.topology
    inside = np.random.default_rng(seed).random(topology.samples_before[-1]) < share
    number = np.flatnonzero(inside)
    triangle = np.searchsorted(topology.samples_before, number, side="right") - 1
    sample = number - topology.samples_before[triangle]
    hits = Hits.from_samples(topology, triangle.astype(np.uint32), sample.astype(np.uint32))

    touched, first = hits.touched()
    thin_triangle, thin_sample = hits.thinned(most)

    expected, at = np.unique(triangle, return_index=True)
    np.testing.assert_array_equal(touched, expected)
    np.testing.assert_array_equal(first, sample[at])
    step = max(1, -(-len(number) // most))
    np.testing.assert_array_equal(thin_triangle, triangle[::step])
    np.testing.assert_array_equal(thin_sample, sample[::step])
    assert len(thin_sample) <= most


def test_the_truth_is_sampled_as_finely_as_is_affordable() -> None:
    edges_m = np.array([0.1, 0.02])

    assert affordable_spacing(edges_m, 1e-3) == 1e-3
    assert dense_viewports(edges_m, 1e-3).tolist() == [101, 21]
    spacing_m = affordable_spacing(edges_m, 1e-7)
    assert 1e-7 < spacing_m < 1e-4
    assert (0.5 * dense_viewports(edges_m, spacing_m) ** 2.0).sum() < 2**27


costs = arrays(
    np.float64,
    st.tuples(st.integers(0, 12), st.integers(1, 3)),
    elements=st.integers(0, 5).map(float),
)


def dominates(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    return bool((a <= b).all() and (a < b).any())


@given(costs=costs)
def test_on_the_front_is_what_nothing_beats_and_the_rest_is_beaten_by_it(
    costs: NDArray[np.float64],
) -> None:
    front = pareto_front(costs)

    for choice in range(len(costs)):
        assert front[choice] != any(dominates(other, costs[choice]) for other in costs)
        if not front[choice]:
            assert any(dominates(other, costs[choice]) for other in costs[front])


@given(costs=costs, seed=st.integers(0, 2**32 - 1))
def test_what_was_not_measured_is_on_no_front_and_beats_nothing(
    costs: NDArray[np.float64], seed: int
) -> None:
    known = np.random.default_rng(seed).random(len(costs)) < 0.5
    partly = np.where(known[:, None], costs, np.nan)

    front = pareto_front(partly)

    assert not front[~known].any()
    np.testing.assert_array_equal(front[known], pareto_front(costs[known]))


coefficient = st.floats(1e-9, 1e-6)


@given(fixed_s=st.floats(1e-5, 1e-1), fill_s=coefficient, read_s=coefficient)
def test_the_cost_model_recovers_what_made_the_times(
    fixed_s: float, fill_s: float, read_s: float
) -> None:
    viewport = np.array([2.0, 4.0, 8.0, 16.0, 32.0, 20.0])
    fill_px = 4 * 300 * viewport**2 / 2
    read_back_px = np.array([10.0, 5000.0, 900.0, 70_000.0, 50_000.0, 8.0])
    time_s = fixed_s + fill_s * fill_px + read_s * read_back_px
    measured_s = time_s * np.array([1, 1, 1, 1, 1, 2])  # the last follows another law

    model = fit_cost(
        measured_s,
        transforms=1200.0,
        fill_px=fill_px,
        read_back_px=read_back_px,
        read_back="window pixel",
        fitted=np.array([True] * 5 + [False]),
    )

    assert model is not None
    # What a term adds to no time worth mentioning cannot be told more exactly than the times.
    for found, true, count in (
        (model.fixed_s, fixed_s, np.ones(5)),
        (model.fill_s_per_px, fill_s, fill_px[:5]),
        (model.read_back_s_per_px, read_s, read_back_px[:5]),
    ):
        assert abs(found - true) * (count / time_s[:5]).max() < 1e-8
    assert model.transform_most_s == model.fixed_s / 1200.0
    assert model.residual_most < 1e-8
    assert model.residual_rms < 1e-8
    np.testing.assert_allclose(model.predicted_s, time_s, rtol=1e-7)
    assert model.residual[5] == pytest.approx(-0.5)
    assert model.freedom == 2
    assert model.holds


def test_times_that_follow_no_pixel_leave_a_residual_and_no_negative_cost() -> None:
    fill_px = np.array([8.0, 32.0, 128.0, 512.0])

    model = fit_cost(
        np.array([4.0, 3.0, 2.0, 1.0]),
        transforms=1.0,
        fill_px=fill_px,
        read_back_px=2 * fill_px,
        read_back="sample inside",
        fitted=np.ones(4, np.bool_),
    )

    assert model is not None
    assert min(model.fixed_s, model.fill_s_per_px, model.read_back_s_per_px) >= 0
    assert model.residual_most > 0.3
    assert model.holds is False
    assert replace(model, freedom=0).holds is False
    assert replace(model, freedom=0, residual_most=0.0).holds is None
    assert model.condition > 100, "fill and read-back grow alike"


@pytest.mark.parametrize(("n_fitted", "transforms"), [(2, 10.0), (4, 0.0)])
def test_too_little_to_fit_is_no_model(n_fitted: int, transforms: float) -> None:
    ones = np.ones(4)

    model = fit_cost(
        ones,
        transforms=transforms,
        fill_px=ones,
        read_back_px=ones,
        read_back="sample inside",
        fitted=np.arange(4) < n_fitted,
    )

    assert model is None


@given(viewports=st.lists(st.integers(1, 300), min_size=1, max_size=30))
def test_the_pixels_read_back_are_those_of_the_windows_of_the_stencil_engine(
    viewports: list[int],
) -> None:
    sizes = np.array(viewports, np.int32)

    pixels = window_px_read(sizes, window_px=128)

    assert pixels == 128 * sum(piece.n_rows for piece in stencil._lay_out(sizes, 128).pieces)


def test_few_frames_are_spread_over_the_recording() -> None:
    for n_frames in (1, 7, 20, 21, 39, 426):
        frames = spread_frames(n_frames)
        assert 1 <= len(range(frames.start, n_frames, frames.step)) <= 20
    assert spread_frames(20).step == 1


def test_an_engine_that_does_not_open_leaves_no_thread() -> None:
    before = threading.active_count()

    def fail() -> Engine:
        raise ReportError("no such engine")

    with pytest.raises(ReportError, match="no such engine"):
        EngineRoom(fail)
    assert threading.active_count() == before


def test_work_in_a_room_ends_when_whoever_asked_is_interrupted() -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    told = []

    def work(room: EngineRoom) -> None:
        # Not before: a machine may take any time to open a room.
        signal.setitimer(signal.ITIMER_REAL, 0.1)
        try:
            for _ in range(60_000):  # a minute, if nobody tells it
                room.raise_if_left()
                time.sleep(0.001)
        except CancelledError:
            told.append(True)
            raise

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        with pytest.raises(KeyboardInterrupt), EngineRoom(Reference) as room:
            room.call(work, room)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)

    assert told == [True]


@pytest.fixture(scope="module")
def some_sweep() -> Sweep:
    outcome = sweep_of(
        [box(0.1)], [ball_hull((0.22, 0.0, 0.0))], (2, 4, 8), engines=(Reference, Reference)
    )
    first, second = outcome.engines
    return Sweep(
        run=Run("hybridve sweep", "a machine", {"python": "3"}, "2026-01-01T00:00:00+00:00"),
        settings={"frames": "0:1:1", "objects": [{"name": "thing", "triangles": 12}]},
        cameras=N_CAMERAS,
        rows=outcome.rows,
        frames=outcome.frames,
        truth=outcome.truth,
        engines=(first, replace(second, name="without a model", cost=None)),
    )


def test_the_median_and_the_spread_are_those_of_the_repeats(some_sweep: Sweep) -> None:
    query_s = np.array([[5.0, 1.0, 4.0, 2.0, 3.0]])
    engine = replace(some_sweep.engines[0], query_s=query_s, place_s=np.full((1, 5), 10.0))

    assert engine.time_s.tolist() == (query_s + 10.0).tolist()
    assert engine.time_median_s.tolist() == [13.0]
    assert engine.time_iqr_s.tolist() == [2.0]


def test_what_is_written_is_read_back(tmp_path: Path, some_sweep: Sweep) -> None:
    path = tmp_path / "sweep.h5"

    write_sweep(path, some_sweep)

    back = read_sweep(path)
    assert sweep_as_dict(back) == sweep_as_dict(some_sweep)
    assert back.settings == some_sweep.settings
    assert back.run == some_sweep.run
    np.testing.assert_array_equal(back.engines[0].query_s, some_sweep.engines[0].query_s)
    assert [engine.name for engine in back.engines] == ["reference", "without a model"]
    assert back.engines[1].cost is None
    assert list(tmp_path.iterdir()) == [path]


def test_every_dataset_has_unit_description_and_checksum(tmp_path: Path, some_sweep: Sweep) -> None:
    path = tmp_path / "sweep.h5"
    write_sweep(path, some_sweep)
    names: list[str] = []

    with h5py.File(path) as file:
        file.visit(names.append)
        datasets = [file[name] for name in names if isinstance(file[name], h5py.Dataset)]

        assert len(datasets) > 30
        for dataset in datasets:
            assert dataset.attrs["unit"]
            assert dataset.attrs["description"]
            assert dataset.shape == () or (dataset.fletcher32 and dataset.shuffle)
        engine = file["engines/reference"]
        np.testing.assert_array_equal(engine["viewport"], file["rows/viewport"])
        np.testing.assert_array_equal(engine["time_median_s"], some_sweep.engines[0].time_median_s)


def test_a_sweep_cut_off_leaves_nothing(
    tmp_path: Path, some_sweep: Sweep, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(file: h5py.File, sweep: Sweep) -> None:
        file.attrs["format"] = "half"
        raise KeyboardInterrupt

    monkeypatch.setattr(sweep_file, "_write", interrupt)

    with pytest.raises(KeyboardInterrupt):
        write_sweep(tmp_path / "sweep.h5", some_sweep)

    assert list(tmp_path.iterdir()) == []


def test_files_that_are_no_sweep_are_told_so(tmp_path: Path, some_sweep: Sweep) -> None:
    path = tmp_path / "sweep.h5"
    with pytest.raises(ReportError, match="there is no such sweep"):
        read_sweep(path)
    path.write_text("no HDF5", encoding="utf-8")
    with pytest.raises(ReportError, match="not a readable sweep"):
        read_sweep(path)
    write_sweep(path, some_sweep)
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = 2
    with pytest.raises(ReportError, match="sweep version 2, this hybridve reads 1"):
        read_sweep(path)
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = "hybridve-report"
    with pytest.raises(ReportError, match="holds hybridve-report, expected hybridve-sweep"):
        read_sweep(path)
