"""What the rectangle test proves, and that it proves enough."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.hulls import (
    EMPTYING_MASK_KINDS,
    MASK_KINDS,
    TRIANGLE_KINDS,
    UNSEEN,
    assert_same_samples,
    ball_hull,
    random_corners,
    random_masks,
    random_views,
    ring_views,
    soup,
)
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridve.hull.query.bounds import FREE, FULL, OPEN, boxes_are_free, verdicts
from hybridve.hull.query.native import Native
from hybridve.hull.query.reference import Reference, contains_points
from hybridve.hull.query.silhouettes import Hull, Unseen, make_hull, make_seen


@st.composite
def hulls(draw: st.DrawFn) -> Hull:
    n_cameras = draw(st.integers(1, 6))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    unseen = draw(st.sampled_from(UNSEEN))
    views = random_views(rng, n_cameras, unseen, draw(st.integers(1, n_cameras)))
    kinds = rng.choice(MASK_KINDS + EMPTYING_MASK_KINDS, n_cameras).tolist()
    return make_hull(views, random_masks(rng, views, kinds))


@settings(max_examples=asked(150))
@given(hull=hulls(), seed=st.integers(0, 2**32 - 1))
def test_a_verdict_holds_for_every_sample(hull: Hull, seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = np.array([random_corners(rng, hull.views, kind) for kind in TRIANGLE_KINDS])
    mesh = soup(hull.views, corners, np.full(len(corners), 20, np.int32))

    verdict = verdicts(hull, mesh.corners_world - hull.views.origin_world)

    (hits,) = Reference().query(hull, [mesh])
    n_inside = np.bincount(hits.samples()[0], minlength=len(mesh))
    assert (n_inside[verdict == FREE] == 0).all()
    assert (n_inside[verdict == FULL] == 210).all()


@settings(max_examples=asked(150))
@given(
    hull=hulls(), seed=st.integers(0, 2**32 - 1), reach_m=st.sampled_from([0.01, 0.1, 1.0, 10.0])
)
def test_a_free_box_holds_no_point_of_the_hull(hull: Hull, seed: int, reach_m: float) -> None:
    rng = np.random.default_rng(seed)
    ends = (
        rng.normal(size=(10, 1, 3)) * rng.choice([0.1, 3.0]) + rng.normal(size=(10, 2, 3)) * reach_m
    )
    lower, upper = ends.min(axis=1), ends.max(axis=1)

    free = boxes_are_free(hull, lower, upper)

    points = lower[:, None] + (upper - lower)[:, None] * rng.random((10, 200, 3))
    inside = contains_points(hull, points.reshape(-1, 3)).reshape(10, 200).any(axis=1)
    assert not (free & inside).any()


@pytest.mark.parametrize("unseen", ["carve", "keep"])
def test_boxes_around_a_ball_are_proved_free_up_to_the_pixels(unseen: Unseen) -> None:
    """A proof that never succeeds would pass every other test here."""
    views = ring_views(6, unseen=unseen)
    hull = ball_hull(views, np.zeros(3), 0.2)
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions[:, 2] *= 0.3  # the cameras stand around, so that is where the hull is tight
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    half_m = 0.005

    beside = 0.26 * directions
    inside = 0.19 * directions

    assert boxes_are_free(hull, beside - half_m, beside + half_m).all()
    assert not boxes_are_free(hull, inside - half_m, inside + half_m).any()


def test_a_camera_that_may_abstain_rejects_only_what_it_sees_whole() -> None:
    """The box sticks out of the image: there, the camera says nothing."""
    masks = [np.zeros((486, 720), np.uint8), *[np.ones((486, 720), np.uint8)] * 3]
    carve, keep = (make_hull(ring_views(4, unseen=rule), masks) for rule in ("carve", "keep"))
    small = np.full((1, 3), 0.1)
    large = np.full((1, 3), 2.0)

    assert boxes_are_free(carve, -small, small).all()
    assert boxes_are_free(carve, -large, large).all()
    assert boxes_are_free(keep, -small, small).all()
    assert not boxes_are_free(keep, -large, large).any()
    # Where all must see an object pixel, that it sees none is enough.
    all_four = make_hull(ring_views(4, unseen="keep", min_cameras=4), masks)
    assert boxes_are_free(all_four, -large, large).all()


def test_a_box_that_a_camera_recorded_in_part_is_neither_rejected_nor_full() -> None:
    empty, full = np.zeros((486, 720), np.uint8), np.ones((486, 720), np.uint8)
    left_half = full.copy()
    left_half[:, 360:] = 0
    views = ring_views(4, unseen="keep", min_cameras=3)
    views = replace(views, seen=make_seen(views.names, views.sizes_px, [left_half, *[None] * 3]))
    hulls = [make_hull(views, [mask, full, full, full]) for mask in (empty, full)]
    matrix = views.img_from_local[0]
    across = np.linalg.solve(matrix[:, :3], np.array([1.0, 0.0, 0.0]))  # to the right of its image
    across *= 0.2 / np.linalg.norm(across)
    small = 0.01 * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    boxes = np.stack([small - across, small, small + across])  # seen by it, in part, and not

    found = [verdicts(hull, boxes - views.origin_world).tolist() for hull in hulls]

    assert found == [[FREE, OPEN, FULL], [FULL, OPEN, FULL]]


def test_what_too_few_cameras_can_see_is_free() -> None:
    far_side = np.array([[0.0, 0.0, 30.0]])  # above all cameras, outside their images
    masks = [np.ones((486, 720), np.uint8)] * 4
    hull = make_hull(ring_views(4, unseen="keep", min_cameras=1), masks)

    assert boxes_are_free(hull, far_side - 1, far_side + 1).all()


def test_a_set_on_object_pixels_of_every_camera_is_full() -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)
    corners = np.array(
        [[[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], [[0.1, 0, 0], [0, 0.4, 0], [0, 0, 0]]]
    )

    assert verdicts(hull, corners - hull.views.origin_world).tolist() == [FULL, OPEN]


def test_no_boxes_are_no_answers() -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)

    assert boxes_are_free(hull, np.zeros((0, 3)), np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize("column", [9, 10])
def test_rounding_at_a_pixel_edge_does_not_reject(column: int) -> None:
    """Triangles whose samples all project onto the edge of columns 9 and 10, rounded to either."""
    rng = np.random.default_rng(3)
    views = random_views(rng, 1, largest_px=160)
    width, height = views.sizes_px[0]
    assert width > 20
    mask = np.zeros((height, width), np.uint8)
    mask[:, column] = 1
    hull = make_hull(views, [mask])
    n_triangles = 2000
    pixels = np.stack(
        [
            np.full((n_triangles, 3), 10.0),
            rng.uniform(1, height - 1, (n_triangles, 3)),
            np.ones((n_triangles, 3)),
        ],
        axis=-1,
    )
    matrix = views.img_from_local[0]
    depths_m = rng.uniform(1.0, 8.0, (n_triangles, 3, 1))
    corners = (pixels * depths_m - matrix[:, 3]) @ np.linalg.inv(matrix[:, :3]).T
    mesh = soup(views, corners, np.full(n_triangles, 10, np.int32))

    (with_rejection,) = Native(1).query(hull, [mesh])
    (without,) = Native(1, reject=False).query(hull, [mesh])

    assert 0.1 < len(without) / (n_triangles * 55) < 0.9  # rounding goes both ways
    assert_same_samples(with_rejection, without)
    (reference,) = Reference().query(hull, [mesh])
    free = verdicts(hull, mesh.corners_world - views.origin_world) == FREE
    assert not free[reference.samples()[0]].any()
