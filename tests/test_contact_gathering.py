"""Which patches are of one thing, and which thing of one run is which of another."""

from itertools import permutations

import numpy as np
import pytest
from helpers.plates import balls, found_in, looking_down, plate
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from hybridve.calib.pose import rotation_about_axes
from hybridve.hull.contact.gathering import (
    LINK_M,
    MATCH_M,
    MOST_MOVED_M,
    SPEED_M_S,
    Boxes,
    boxes_on_part,
    gathered,
    matched,
)
from hybridve.hull.contact.patches import contact_patches


def cubes(centers: object, edge_m: float = 0.02) -> Boxes:
    middle = np.asarray(centers, np.float64).reshape(-1, 3)
    return Boxes(middle - edge_m / 2, middle + edge_m / 2)


def of_frames(*frames: list[tuple[float, float, float]]) -> tuple[Boxes, NDArray[np.int64]]:
    """Return cubes of 2 cm frame by frame, and the frame of each."""
    step = np.repeat(np.arange(len(frames)), [len(one) for one in frames])
    return cubes([place for one in frames for place in one]), step


def seconds(step: NDArray[np.int64], step_s: float) -> NDArray[np.float64]:
    return np.asarray(step_s * step, np.float64)


def label_of(*frames: list[tuple[float, float, float]], step_s: float = 0.1) -> list[int]:
    boxes, step = of_frames(*frames)
    label: list[int] = gathered(boxes, step, seconds(step, step_s)).tolist()
    return label


def test_two_things_three_centimetres_apart_stay_two_though_their_places_waver() -> None:
    rng = np.random.default_rng(0)
    frames = 60
    # Cubes of 2 cm, 3 cm of room between them; each wavers by 2 mm, its ends, too.
    center = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]]) + rng.normal(0, 0.002, (frames, 2, 3))
    step = np.repeat(np.arange(frames), 2)

    label = gathered(cubes(center), step, seconds(step, 0.02))

    assert label.tolist() == [0, 1] * frames


@pytest.mark.slow
def test_two_balls_at_a_plate_with_three_centimetres_between_them_stay_two() -> None:
    """Their outlines err, another way in each frame, by up to a pixel (3.5 mm)."""
    rng = np.random.default_rng(2)
    views, part, radius_m = looking_down(), plate(0.0), 0.03
    centers = np.array([[-0.045, 0.0, 0.0], [0.045, 0.0, 0.0]])
    lower, upper, frame = [], [], []
    for number in range(3):
        hull = balls(views, (radius_m + rng.uniform(-0.0035, 0.0035, 2)).tolist(), centers)
        meter, contact = found_in(hull, part)
        reference = part.reference_point_world
        for patch in contact_patches(
            hull, meter, contact, required_m=0.0, reference_point_world=reference
        ):
            lower.append(patch.lower_world)
            upper.append(patch.upper_world)
            frame.append(number)

    boxes, step = Boxes(np.array(lower), np.array(upper)), np.array(frame)
    label = gathered(boxes, step, seconds(step, 0.1))

    assert len(label) == 6
    assert set(label.tolist()) == {0, 1}
    for thing in (0, 1):
        left = boxes[label == thing].center[:, 0] < 0.0
        assert left.all() or not left.any()


def test_one_of_two_that_leaves_is_not_taken_for_the_other() -> None:
    both, left = [(0.0, 0.0, 0.0), (0.05, 0.0, 0.0)], [(0.05, 0.0, 0.0)]

    assert label_of(both, both, left, left) == [0, 1, 0, 1, 1, 1]


@pytest.mark.parametrize("step", [1, 2])
def test_what_slides_along_a_part_is_one_thing_at_half_the_frames_as_well(step: int) -> None:
    # 0.4 m/s at 10 frames a second: cubes of 2 cm that are 4 cm apart, or 8.
    slide = [[(0.04 * frame, 0.0, 0.0)] for frame in range(0, 12, step)]

    assert label_of(*slide, step_s=0.1 * step) == [0] * (12 // step)


def test_what_is_faster_than_a_hand_is_another_thing() -> None:
    far_m = 0.02 + LINK_M + SPEED_M_S * 0.1

    assert label_of([(0.0, 0.0, 0.0)], [(far_m - 1e-6, 0.0, 0.0)]) == [0, 0]
    assert label_of([(0.0, 0.0, 0.0)], [(far_m + 1e-6, 0.0, 0.0)]) == [0, 1]
    beyond_m = 0.02 + MOST_MOVED_M + 1e-6
    assert label_of([(0.0, 0.0, 0.0)], [(beyond_m, 0.0, 0.0)], step_s=5.0) == [0, 1]


def test_what_comes_back_to_its_place_is_the_same_thing() -> None:
    here, there = [(0.0, 0.0, 0.0)], [(0.3, 0.0, 0.0)]

    assert label_of(here, [], there, [], here, [], there) == [0, 1, 0, 1]


def test_two_that_run_into_one_are_one() -> None:
    apart = [(0.0, 0.0, 0.0), (0.06, 0.0, 0.0)]

    across = [(0.0, 0.0, 0.0), (0.02, 0.0, 0.0), (0.04, 0.0, 0.0)]

    assert label_of(apart, apart) == [0, 1, 0, 1]
    assert label_of(apart, across, apart) == [0] * 7


def by_definition(
    boxes: Boxes, step: NDArray[np.int64], time_s: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Join all pairs that are one thing by what the module says, with another library."""
    gaps_m = np.zeros((len(boxes), len(boxes)))
    for i in range(len(boxes)):
        for j in range(len(boxes)):
            apart = np.maximum(boxes.lower[j] - boxes.upper[i], boxes.lower[i] - boxes.upper[j])
            gaps_m[i, j] = np.sqrt((np.maximum(apart, 0.0) ** 2).sum())
    pairs = gaps_m <= LINK_M
    away = np.linalg.norm(boxes.center[:, None] - boxes.center[None], axis=2)
    for i in range(len(boxes)):
        for j in range(len(boxes)):
            if step[j] != step[i] + 1:
                continue
            reach_m = min(LINK_M + SPEED_M_S * (time_s[j] - time_s[i]), MOST_MOVED_M)
            may_be = gaps_m <= reach_m
            forward = (step == step[j]) & may_be[i]
            backward = (step == step[i]) & may_be[:, j]
            if may_be[i, j]:
                nearest = away[i, j] <= away[i, forward].min()
                pairs[i, j] |= nearest and away[i, j] <= away[backward, j].min()
    return np.asarray(connected_components(coo_array(pairs), directed=False)[1], np.int64)


@given(seed=st.integers(0, 2**32 - 1))
def test_things_are_the_chains_of_all_pairs_that_are_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 25))
    step = np.sort(rng.integers(0, 8, count))
    lower = rng.uniform(0.0, 0.25, (count, 3)) * [1.0, 0.4, 0.1]
    boxes = Boxes(lower, lower + rng.uniform(0.0, 0.03, (count, 3)))

    label = gathered(boxes, step, seconds(step, 0.05))

    expected = by_definition(boxes, step, seconds(step, 0.05))
    same = label[:, None] == label[None]
    np.testing.assert_array_equal(same, expected[:, None] == expected[None])
    assert label[np.unique(label, return_index=True)[1]].tolist() == list(range(label.max() + 1))


def test_a_ball_on_a_part_is_as_large_however_the_part_is_turned() -> None:
    rotation = rotation_about_axes((30.0, -50.0, 110.0))
    pose = np.column_stack([rotation, [1.0, 2.0, 3.0]])[None]
    center_part = np.array([0.1, -0.2, 0.05])
    center_world = rotation @ center_part + pose[0, :, 3]

    found = boxes_on_part(cubes(center_world, 0.08), pose)

    np.testing.assert_allclose(found.center, [center_part], atol=1e-12)
    np.testing.assert_allclose(found.upper - found.lower, 0.08, atol=1e-12)


def test_what_is_beside_a_part_counts_as_where_it_is_nearest() -> None:
    part = Boxes(np.full((1, 3), -0.1), np.full((1, 3), 0.1))

    found = boxes_on_part(cubes([0.0, 0.0, 0.2], 0.04), np.eye(3, 4)[None], part)

    np.testing.assert_allclose(found.lower, [[-0.02, -0.02, 0.1]])
    np.testing.assert_allclose(found.upper, [[0.02, 0.02, 0.1]])


@given(seed=st.integers(0, 2**32 - 1))
def test_things_are_matched_one_to_one_as_many_and_as_near_as_can_be(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n_first, n_second = rng.integers(0, 5, 2).tolist()
    first, second = (cubes(rng.uniform(0.0, 0.08, (n, 3))) for n in (n_first, n_second))

    pairs = matched(first, second).pairs

    gaps_m = second.gaps_m(first)
    away_m = np.linalg.norm(second.lower[:, None] - first.lower[None], axis=2)  # cubes are alike
    assert len(set(pairs.values())) == len(pairs)
    assert all(gaps_m[i, j] <= MATCH_M for i, j in pairs.items())
    best = (0, 0.0)
    slots = [*range(n_first), *[-1] * n_second]
    for choice in set(permutations(slots, n_second)):
        chosen = [(i, j) for i, j in enumerate(choice) if j >= 0 and gaps_m[i, j] <= MATCH_M]
        best = min(best, (-len(chosen), float(sum(away_m[i, j] for i, j in chosen))))
    found = (-len(pairs), float(sum(away_m[i, j] for i, j in pairs.items())))
    assert found[0] == best[0]
    assert found[1] == pytest.approx(best[1])


def test_a_tie_is_told_and_what_lies_three_centimetres_away_is_none() -> None:
    first = cubes([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]])
    between = cubes([[0.024, 0.0, 0.0]], 0.01)

    clear = matched(first, cubes([[0.004, 0.0, 0.0], [0.047, 0.0, 0.0]]))
    tied = matched(first, between)

    assert clear.pairs == {0: 0, 1: 1}
    assert clear.ties == {}
    assert tied.pairs == {0: 0}
    assert tied.ties == {0: (1,)}
