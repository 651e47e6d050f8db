"""Blocked shifts against measuring at every shift, over random hulls, objects and directions."""

import numpy as np
import pytest
from helpers.hulls import MASK_KINDS, random_masks, random_views
from helpers.polytopes import depth_in_box, distance_between, rectangle_hull
from helpers.thorough import some_of
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.pose import rotation_about_axes
from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.contact.spacing import (
    METER_SHARE,
    Move,
    MovedObject,
    blocked_shifts,
    covers,
    union,
    without,
)
from hybridve.hull.query.silhouettes import Hull, make_hull
from hybridve.hull.synth.meshes import box_mesh

#: What solvers and rounding may be off by.
ROUNDING_M = 1e-8

#: Noise takes long to measure: no cube of space is all hull or none.
_KINDS = [kind for kind in MASK_KINDS if kind != "noise"]


class Box:
    """A box somewhere, of which a face may be missing."""

    def __init__(self, rng: np.random.Generator, *, is_closed: bool) -> None:
        self.half = rng.uniform(0.01, 0.2, 3)
        self.rotation = rotation_about_axes(tuple(rng.uniform(-180, 180, 3)))
        self.center = 0.15 * rng.normal(size=3)
        mesh = box_mesh(tuple(2000 * self.half), 500.0)
        self.vertices = mesh.vertices_mm / 1000 @ self.rotation.T + self.center
        self.faces = mesh.faces.astype(np.int32)[0 if is_closed else 2 :]
        self.is_closed = is_closed
        self.corners = (
            np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * self.half
        ) @ self.rotation.T + self.center

    def moved(self, origin: NDArray[np.float64], clearance_m: float, move: Move) -> MovedObject:
        meter = ClearanceMeter(
            self.vertices + origin,
            self.faces,
            is_closed=self.is_closed,
            tolerance_m=METER_SHARE * move.tolerance_m,
        )
        return MovedObject(meter, clearance_m)


def random_move(rng: np.random.Generator) -> Move:
    direction = rng.normal(size=3)
    start_m = rng.uniform(-0.6, 0.0)
    return Move(
        direction / np.linalg.norm(direction),
        start_m,
        start_m + rng.uniform(0.05, 1.0),
        10.0 ** rng.uniform(-2.5, -2.0),
    )


def random_clearance(rng: np.random.Generator) -> float:
    return float(rng.choice([0.0, rng.uniform(0.001, 0.1)]))


def random_hull(rng: np.random.Generator) -> Hull:
    n_cameras = int(rng.integers(3, 6))
    views = random_views(rng, n_cameras, origin_world=rng.normal(size=3) * 100)
    return make_hull(views, random_masks(rng, views, list(rng.choice(_KINDS, n_cameras))))


@pytest.mark.slow
@pytest.mark.parametrize("seed", some_of(range(6)))
def test_every_shift_is_what_measuring_there_says(seed: int) -> None:
    """Blobs, holes, half images; closed objects and open ones."""
    rng = np.random.default_rng([8, seed])
    n_violated = n_free = 0
    for number in range(6):
        hull, box = random_hull(rng), Box(rng, is_closed=number % 2 == 0)
        move, clearance_m = random_move(rng), random_clearance(rng)
        one = box.moved(hull.views.origin_world, clearance_m, move)

        blocked = blocked_shifts(hull, [one], move)

        shifts = rng.uniform(move.start_m, move.stop_m, 25)
        edges = np.concatenate([blocked.violated_m.ravel(), blocked.undecided_m.ravel()])
        shifts = np.concatenate([shifts, np.clip(edges[:20], move.start_m, move.stop_m)])
        violated, undecided = (
            covers(blocked.violated_m, shifts),
            covers(blocked.undecided_m, shifts),
        )
        for shift, is_violated, is_undecided in zip(shifts, violated, undecided, strict=True):
            # Of a surface that bounds nothing, how deep it is in the hull is not to be known.
            least = -np.inf if box.is_closed else one.meter.tolerance_m
            found = one.meter.measure(hull, shift * move.direction, stop_below_m=least)
            low, high = found.signed_m
            if is_violated:
                assert low <= clearance_m + ROUNDING_M
                n_violated += 1
            elif not is_undecided:
                assert high >= clearance_m - ROUNDING_M
                assert high > 0
                n_free += 1
            else:  # as long as it is not near, it has to be known
                assert low <= clearance_m + move.tolerance_m / 2
                assert high >= clearance_m - move.tolerance_m / 2 or not box.is_closed
    assert min(n_violated, n_free) > 0


@pytest.mark.parametrize("seed", some_of(range(10)))
def test_every_shift_is_what_exact_distances_of_convex_hulls_say(seed: int) -> None:
    rng = np.random.default_rng([9, seed])
    n_violated = n_free = 0
    while n_violated < 20 or n_free < 20:
        views = random_views(rng, int(rng.integers(3, 6)))
        made = rectangle_hull(rng, views, 0.2 * rng.normal(size=3))
        if made is None:
            continue
        hull, shape = made
        box, move, clearance_m = Box(rng, is_closed=True), random_move(rng), random_clearance(rng)

        blocked = blocked_shifts(hull, [box.moved(np.zeros(3), clearance_m, move)], move)

        shifts = np.linspace(move.start_m, move.stop_m, 12)
        if len(blocked.violated_m):  # convex things meet at one stretch of shifts
            near = blocked.violated_m[0] + 2 * move.tolerance_m * np.array([-1, 1])
            inside = blocked.violated_m[0] + ROUNDING_M * np.array([1, -1])
            shifts = np.concatenate([shifts, near, inside, blocked.undecided_m.mean(axis=1)])
            shifts = np.clip(shifts, move.start_m, move.stop_m)
        violated = covers(blocked.violated_m, shifts)
        undecided = covers(blocked.undecided_m, shifts)
        for shift, is_violated, is_undecided in zip(shifts, violated, undecided, strict=True):
            by = shift * move.direction
            lower, upper = distance_between(shape.corners, box.corners + by)
            depth = depth_in_box(shape, box.rotation, box.center + by, box.half)
            if is_violated:
                assert lower < clearance_m or depth > 0
                n_violated += 1
            elif not is_undecided:
                assert upper >= clearance_m - ROUNDING_M
                assert depth <= ROUNDING_M
                n_free += 1
            else:  # what is not near is known
                assert abs(upper - depth - clearance_m) < move.tolerance_m / 2


@pytest.mark.parametrize("seed", some_of(range(5)))
def test_a_larger_clearance_never_needs_less_and_a_group_needs_what_its_parts_need(
    seed: int,
) -> None:
    rng = np.random.default_rng([10, seed])
    for _ in range(6):
        hull, move = random_hull(rng), random_move(rng)
        origin = hull.views.origin_world
        boxes = [Box(rng, is_closed=bool(rng.integers(2))) for _ in range(2)]
        small_m = random_clearance(rng)
        few, many = (
            blocked_shifts(hull, [boxes[0].moved(origin, clearance_m, move)], move)
            for clearance_m in (small_m, small_m + 0.02)
        )
        whole = np.array([[move.start_m, move.stop_m]])
        free_of_many = without(whole, union(many.violated_m, many.undecided_m))
        assert np.array_equal(without(free_of_many, few.violated_m), free_of_many)

        parts = [one.moved(origin, small_m, move) for one in boxes]
        alone = [blocked_shifts(hull, [part], move) for part in parts]
        together = blocked_shifts(hull, parts, move)
        shifts = rng.uniform(move.start_m, move.stop_m, 500)
        certain = covers(together.violated_m, shifts)
        maybe = certain | covers(together.undecided_m, shifts)
        for one in alone:
            assert not (covers(one.violated_m, shifts) & ~maybe).any()
        free_of_both = np.ones(500, np.bool_)
        for one in alone:
            free_of_both &= ~covers(union(one.violated_m, one.undecided_m), shifts)
        assert not (free_of_both & certain).any()


stretches = st.lists(
    st.tuples(st.integers(-20, 20), st.integers(0, 9)).map(lambda one: (one[0], one[0] + one[1])),
    max_size=6,
).map(lambda found: np.array(found, np.float64).reshape(-1, 2))


@given(first=stretches, second=stretches)
def test_sets_of_stretches_are_what_their_points_are(
    first: NDArray[np.float64], second: NDArray[np.float64]
) -> None:
    points = np.arange(-25.0, 35.0) + 0.5  # no end is among them

    def holds(some: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(((some[:, :1] <= points) & (points <= some[:, 1:])).any(axis=0))

    one, other = union(first), union(second)

    np.testing.assert_array_equal(holds(union(first, second)), holds(first) | holds(second))
    np.testing.assert_array_equal(holds(without(one, other)), holds(one) & ~holds(other))
    np.testing.assert_array_equal(covers(one, points), holds(first))
    for found in (one, union(first, second), without(one, other)):
        assert (found[1:, 0] >= found[:-1, 1]).all()
