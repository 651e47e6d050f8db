"""The shift that suffices at 95 %: what it says of a frame, and how often it does suffice."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.erring_task import ErringTask, erring_task, views_of
from helpers.hulls import ball_hull
from numpy.typing import NDArray
from scipy.stats import binom

from hybridve.hull.contact.outline_errors import OutlineErrors
from hybridve.hull.contact.spacing import (
    NOTHING,
    Move,
    blocked_by,
    blocked_shifts,
    covers,
    free_of,
    union,
)
from hybridve.hull.contact.spacing_doubt import UnsureShifts, unsure_shifts
from hybridve.hull.contact.uncertainty import ONE_SIDED_95, Doubter
from hybridve.hull.query.silhouettes import Hull, make_hull


def errors_of(hull: Hull, segmentation_px: float) -> OutlineErrors:
    n_cameras = len(hull.views)
    return OutlineErrors(
        np.zeros(n_cameras), np.ones(n_cameras, np.bool_), segmentation_px, np.zeros(n_cameras)
    )


@pytest.fixture(scope="module")
def task() -> ErringTask:
    return erring_task(np.random.default_rng(3), 1, is_tied=False)


@pytest.fixture(scope="module")
def hull(task: ErringTask) -> Hull:
    return ball_hull(views_of(task.cameras), task.centers_world[0], task.radius_m)


def unsure(task: ErringTask, hull: Hull, segmentation_px: float = 1.2) -> UnsureShifts:
    doubts = Doubter(errors_of(hull, segmentation_px)).frame(hull)
    wall = [task.wall()]
    return unsure_shifts(doubts, wall, task.move, blocked_shifts(hull, wall, task.move))


def test_at_the_shift_a_report_would_say_that_the_clearance_is_at_least_what_is_required(
    task: ErringTask, hull: Hull
) -> None:
    found = unsure(task, hull)
    wall, move = task.wall(), task.move
    ((at_95_m, _),) = free_of(move, found.unsure_m)
    doubts = Doubter(errors_of(hull, 1.2)).frame(hull)

    def at_least_m(shift_m: float) -> float:
        shift_world = shift_m * move.direction
        clearance = wall.meter.measure(hull, shift_world)
        return (
            clearance.lower_m - doubts.deviation(wall.meter, clearance, shift_world).too_large_95_m
        )

    # The tolerance of the answer, and the meter's an eighth of it.
    assert at_least_m(at_95_m) >= task.required_m - move.tolerance_m / 8.0
    below_m = at_95_m - 0.02 * found.too_large_95_m - 2.0 * move.tolerance_m
    assert at_least_m(below_m) < task.required_m


@pytest.mark.slow
def test_a_wall_that_moves_away_at_a_slant_must_go_as_much_farther(task: ErringTask) -> None:
    views, center = views_of(task.cameras), task.centers_world[0]
    hull = ball_hull(views, center, task.radius_m)
    aslant = np.cross(task.normal, [0.3, -0.5, 0.8])
    aslant /= np.linalg.norm(aslant)
    added_m, move_tolerance_m = [], 1e-3
    for cosine in (1.0, 0.5):
        direction = cosine * task.normal + np.sqrt(1.0 - cosine**2) * aslant
        slanted = replace(task, move=Move(direction, 0.0, 1.5, move_tolerance_m))
        mine = blocked_shifts(hull, [slanted.wall()], slanted.move)
        first_m = free_of(slanted.move, union(mine.violated_m, mine.undecided_m))[0, 0]
        found = unsure(slanted, hull)
        added_m.append(free_of(slanted.move, found.unsure_m)[0, 0] - first_m)
        assert found.too_large_95_m >= ONE_SIDED_95 * found.std_m - move_tolerance_m
        expected_m = found.too_large_95_m / cosine
        assert added_m[-1] == pytest.approx(expected_m, abs=2 * move_tolerance_m)
    assert added_m[1] > 1.5 * added_m[0]


@pytest.mark.parametrize("segmentation_px", [0.0, 0.7, 3.0])
def test_what_violates_or_is_undecided_is_never_sure(
    task: ErringTask, hull: Hull, segmentation_px: float
) -> None:
    wall = task.wall()
    blocked = blocked_shifts(hull, [wall], task.move)

    found = unsure(task, hull, segmentation_px)

    both = union(blocked.violated_m, blocked.undecided_m)
    assert covers(found.unsure_m, both.ravel()).all()
    assert covers(found.unsure_m, both.mean(axis=1)).all()
    # Rounding to pixels alone leaves something.
    assert found.unsure_m[-1, 1] > both[-1, 1] + 0.5 * ONE_SIDED_95 * found.std_m
    assert found.std_m > 0


@pytest.mark.slow
def test_larger_errors_need_more_room(task: ErringTask, hull: Hull) -> None:
    ends_m = [unsure(task, hull, px).unsure_m[-1, 1] for px in (0.0, 0.5, 1.0, 2.0)]

    assert (np.diff(ends_m) > 0).all()


@pytest.mark.slow
def test_of_several_objects_each_is_kept_with_its_own_deviation(
    task: ErringTask, hull: Hull
) -> None:
    near = task.wall()
    far = replace(near, clearance_m=near.clearance_m + 0.05)
    doubts = Doubter(errors_of(hull, 1.2)).frame(hull)

    def of(*objects: object) -> NDArray[np.float64]:
        blocked = blocked_shifts(hull, objects, task.move)  # type: ignore[arg-type]
        return unsure_shifts(doubts, objects, task.move, blocked).unsure_m  # type: ignore[arg-type]

    tolerance_m = task.move.tolerance_m
    for together in (of(near, far), of(far, near)):
        # Where it is just kept, slivers of shifts far below the tolerance may be told apart.
        ends = [together[0, 0], together[-1, 1]]
        alone = of(far)
        np.testing.assert_allclose(ends, [alone[0, 0], alone[-1, 1]], atol=tolerance_m)
        assert together[-1, 1] > of(near)[-1, 1] + 0.04


def test_a_frame_that_stays_away_or_holds_nothing_is_sure(task: ErringTask, hull: Hull) -> None:
    nobody = make_hull(hull.views, [np.zeros_like(hull.mask(k)) for k in range(len(hull.views))])
    beyond = replace(task, move=replace(task.move, start_m=2.0, stop_m=3.0))
    for seen, asked in ((nobody, task), (hull, beyond)):
        found = unsure(asked, seen)
        assert len(found.unsure_m) == 0
        assert np.isnan(found.std_m)


def test_where_the_clearance_is_just_kept_everywhere_it_is_not_sure(
    task: ErringTask, hull: Hull
) -> None:
    """A range that begins a little beyond the shift that is needed: nothing violates, and yet."""
    needed_m = float(task.needed_by_frame_m()[0])
    beyond = replace(task, move=replace(task.move, start_m=needed_m + 0.012))
    wall = [beyond.wall()]
    assert len(blocked_shifts(hull, wall, beyond.move).violated_m) == 0

    found = unsure(beyond, hull, 2.0)

    ((begins_m, ends_m),) = found.unsure_m
    assert begins_m == beyond.move.start_m
    assert ends_m == pytest.approx(unsure(task, hull, 2.0).unsure_m[-1, 1], abs=3e-3)


def test_known_shifts_are_not_asked_for_again(task: ErringTask, hull: Hull) -> None:
    wall, move = task.wall(), task.move
    violated_m, undecided_m, n_measured = blocked_by(hull, wall, move)
    free_m = free_of(move, union(violated_m, undecided_m))

    again_m, left_m, n_again = blocked_by(hull, wall, move, violated_m, free_m)

    np.testing.assert_array_equal(again_m, violated_m)
    assert n_again < n_measured
    assert np.ptp(left_m, axis=1).sum() <= np.ptp(undecided_m, axis=1).sum()
    everything = np.array([[move.start_m, move.stop_m]])
    assert blocked_by(hull, wall, move, NOTHING, everything)[2] == 0
    assert blocked_by(hull, wall, move, everything)[2] == 0


@pytest.mark.slow
def test_the_shift_at_95_percent_suffices_in_95_percent_of_recordings() -> None:
    """Two frames, the first decides. 200 repeats and more: tests/benchmarks/bench_spacing_doubt."""
    rng = np.random.default_rng(11)
    enough, as_found, pulls = [], [], []
    for _ in range(6):
        task = erring_task(rng, 2, is_tied=False)
        needed_m, wall = float(task.needed_by_frame_m().max()), task.wall()
        for _ in range(8):
            found_m, at_95_m, std_m = task.repeat(rng, wall)
            enough.append(needed_m <= at_95_m)
            as_found.append(needed_m <= found_m)
            pulls.append((found_m - needed_m) * float(task.normal @ task.move.direction) / std_m)

    # Of a rule that is right in exactly 95 % of the cases, 999 of 1000 such tests pass.
    assert sum(enough) >= binom.ppf(0.001, len(enough), 0.95)
    assert sum(as_found) < binom.ppf(0.001, len(enough), 0.95)
    # Nor is there more to spare than there need be: 48 draws tell a deviation to 10 %.
    assert 0.65 < np.std(pulls) < 1.35
    assert abs(np.mean(pulls)) < 0.6
