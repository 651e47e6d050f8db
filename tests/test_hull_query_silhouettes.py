"""Cameras and silhouettes as the engines take them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.hulls import look_at, projection, ring_views

from hybridve.hull.query.silhouettes import (
    BACKGROUND,
    OBJECT,
    UNSEEN,
    Hull,
    Unseen,
    beside,
    interpolated_views,
    make_hull,
    make_seen,
    make_views,
)


def ring_matrices(n_cameras: int, target: np.ndarray, distance_m: float = 3.0) -> np.ndarray:
    angles = 2 * np.pi * np.arange(n_cameras) / n_cameras
    around = np.stack([np.cos(angles), np.sin(angles), np.full(n_cameras, 0.4)], axis=-1)
    return np.array(
        [
            projection(look_at(target + distance_m * offset, target), 500.0, 640, 480)
            for offset in around
        ]
    )


SIZES = np.array([[640, 480]] * 3)
NAMES = ("a", "b", "c")


def test_the_local_origin_is_where_the_optical_axes_meet() -> None:
    target = np.array([1234.0, -56.0, 7.0])

    views = make_views(NAMES, SIZES, ring_matrices(3, target))

    # Rounded to centimetres.
    np.testing.assert_allclose(views.origin_world, target, atol=0.005)


def test_parallel_axes_have_a_local_origin_among_the_cameras() -> None:
    target = np.array([100.0, 200.0, 0.0])
    matrices = np.array(
        [
            projection(
                look_at(target + np.array([x, 0, 5.0]), target + np.array([x, 0, 0])),
                500.0,
                640,
                480,
            )
            for x in (-1.0, 0.0, 1.0)
        ]
    )

    views = make_views(NAMES, SIZES, matrices)

    np.testing.assert_allclose(views.origin_world, target + np.array([0, 0, 5.0]), atol=0.005)


def test_one_camera_has_a_local_origin() -> None:
    target = np.array([100.0, 200.0, 0.0])

    views = make_views(("a",), SIZES[:1], ring_matrices(1, target))

    assert np.linalg.norm(views.origin_world - target) < 5.0  # metres: at the camera


def test_points_project_alike_in_the_world_and_locally() -> None:
    matrices = ring_matrices(3, np.array([1.0, 2.0, 3.0]))
    points_world = np.random.default_rng(0).normal(size=(20, 3)) + np.array([1.0, 2.0, 3.0])
    scales = np.array([0.01, 1.0, 100.0])[:, None, None]

    views = make_views(NAMES, SIZES, matrices * scales)

    world = np.einsum("cij,nj->cni", matrices[:, :, :3], points_world) + matrices[:, None, :, 3]
    local = (
        np.einsum("cij,nj->cni", views.img_from_local[:, :, :3], points_world - views.origin_world)
        + views.img_from_local[:, None, :, 3]
    )
    np.testing.assert_allclose(local[..., :2] / local[..., 2:], world[..., :2] / world[..., 2:])
    # The third coordinate is the depth in metres, whatever the scale of the matrix.
    np.testing.assert_allclose(local[..., 2], world[..., 2])


@pytest.mark.parametrize("min_cameras", [0, 4])
def test_more_cameras_than_there_are_cannot_be_needed(min_cameras: int) -> None:
    with pytest.raises(ValueError, match=rf"min_cameras is {min_cameras}, expected 1\.\.3"):
        make_views(NAMES, SIZES, ring_matrices(3, np.zeros(3)), "keep", min_cameras)


def test_a_camera_without_an_optical_axis_is_named() -> None:
    matrices = ring_matrices(3, np.zeros(3))
    matrices[1, 2, :3] = 0.0

    with pytest.raises(ValueError, match="camera b: the projection matrix is singular"):
        make_views(NAMES, SIZES, matrices)


@pytest.mark.parametrize(
    ("value", "name"), [(np.nan, "not finite"), (np.inf, "not finite"), (0.0, "singular")]
)
@pytest.mark.parametrize("row", [0, 1, 2])
def test_a_projection_that_is_none_is_named(row: int, value: float, name: str) -> None:
    matrices = ring_matrices(3, np.zeros(3))
    matrices[2, row, :3] = value

    with pytest.raises(ValueError, match=f"camera c: the projection matrix is {name}"):
        make_views(NAMES, SIZES, matrices)


def test_integral_images_count_the_object_pixels_of_rectangles() -> None:
    rng = np.random.default_rng(0)
    views = make_views(NAMES, np.array([[7, 5], [3, 9], [1, 1]]), ring_matrices(3, np.zeros(3)))
    masks = [rng.integers(0, 2, (h, w)).astype(np.uint8) * 255 for w, h in views.sizes_px]

    hull = make_hull(views, masks)

    for camera, mask in enumerate(masks):
        np.testing.assert_array_equal(hull.mask(camera), mask > 0)
        for _ in range(20):
            y0, y1 = np.sort(rng.integers(0, mask.shape[0] + 1, 2))
            x0, x1 = np.sort(rng.integers(0, mask.shape[1] + 1, 2))
            integral = hull.integral(camera).astype(int)
            count = integral[y1, x1] - integral[y0, x1] - integral[y1, x0] + integral[y0, x0]
            assert count == (mask[y0:y1, x0:x1] > 0).sum()


def test_masks_that_are_not_of_the_cameras_are_refused() -> None:
    views = ring_views(2)
    mask = np.zeros((486, 720), np.uint8)

    with pytest.raises(ValueError, match="1 masks for 2 cameras"):
        make_hull(views, [mask])
    with pytest.raises(
        ValueError, match=r"camera cam1 has shape \(720, 486\), expected \(486, 720\)"
    ):
        make_hull(views, [mask, mask.T])


def test_what_was_recorded_is_kept_of_the_cameras_that_have_gaps_only() -> None:
    sizes = np.array([[3, 2], [2, 2], [4, 1]])
    second, third = np.array([[1, 0], [1, 1]]), np.array([[0, 0, 255, 7]])

    seen = make_seen(NAMES, sizes, [None, second.astype(np.uint8), third.astype(np.uint8)])

    assert seen is not None
    assert seen.masks_flat.tolist() == [1, 0, 1, 1, 0, 0, 1, 1]
    assert seen.mask_offset.tolist() == [-1, 0, 4]
    views = make_views(NAMES, sizes, ring_matrices(3, np.zeros(3)), "keep", seen=seen)
    assert views.seen_mask(0) is None
    assert views.seen_integral(0) is None
    integral = views.seen_integral(2)
    assert integral is not None
    assert integral.tolist() == [[0, 0, 0, 0, 0], [0, 0, 0, 1, 2]]
    # Of fewer cameras, in another order: the same images.
    fewer = replace(
        views,
        names=("c", "a"),
        sizes_px=sizes[[2, 0]],
        img_from_local=views.img_from_local[[2, 0]],
        seen=seen.of(np.array([2, 0])),
    )
    mask = fewer.seen_mask(0)
    assert mask is not None
    assert mask.tolist() == [[0, 0, 1, 1]]
    assert fewer.seen_mask(1) is None


def test_cameras_without_gaps_have_nothing_to_remember() -> None:
    full = [np.ones((480, 640), np.bool_), None, np.ones((480, 640), np.bool_)]

    assert make_seen(NAMES, SIZES, full) is None


def test_what_was_recorded_must_fit_the_cameras() -> None:
    with pytest.raises(ValueError, match="2 masks of what was seen for 3 cameras"):
        make_seen(NAMES, SIZES, [None, None])
    with pytest.raises(ValueError, match=r"camera b saw has shape \(2, 2\), expected \(480, 640\)"):
        make_seen(NAMES, SIZES, [None, np.ones((2, 2), np.bool_), None])


def test_cameras_that_carve_have_no_gaps() -> None:
    seen = make_seen(NAMES, SIZES, [np.zeros((480, 640), np.bool_), None, None])
    views = make_views(NAMES, SIZES, ring_matrices(3, np.zeros(3)), "keep", seen=seen)

    assert make_views(NAMES, SIZES, ring_matrices(3, np.zeros(3)), "carve", seen=seen).seen is None
    with pytest.raises(ValueError, match="carve"):
        replace(views, unseen="carve")


def test_a_pixel_that_was_not_recorded_is_neither_object_nor_background() -> None:
    sizes = np.array([[3, 1]] * 3)
    recorded = np.array([[1, 1, 0]], np.bool_)
    seen = make_seen(NAMES, sizes, [recorded, None, None])
    views = make_views(NAMES, sizes, ring_matrices(3, np.zeros(3)), "keep", seen=seen)

    hull = make_hull(views, [np.array([[0, 9, 9]], np.uint8)] * 3)

    assert hull.answers(0).tolist() == [[BACKGROUND, OBJECT, UNSEEN]]
    assert hull.mask(0).tolist() == [[0, 1, 0]]
    assert hull.integral(0)[-1].tolist() == [0, 0, 1, 1]
    assert hull.answers(1).tolist() == [[BACKGROUND, OBJECT, OBJECT]]


def test_views_between_two_frames_are_of_cameras_that_recorded_the_same() -> None:
    gaps = np.ones((480, 640), np.bool_)
    gaps[:9] = False
    matrices = ring_matrices(3, np.zeros(3))
    some, same = (make_seen(NAMES, SIZES, [gaps, None, None]) for _ in range(2))
    other = make_seen(NAMES, SIZES, [~gaps, None, None])
    before = make_views(NAMES, SIZES, matrices, "keep", seen=some)

    assert interpolated_views(before, replace(before, seen=same), 0.5).seen is some
    for different in (other, None):
        with pytest.raises(ValueError, match="not of the same"):
            interpolated_views(before, replace(before, seen=different), 0.5)


@pytest.mark.parametrize("unseen", ["carve", "keep"])
def test_images_beside_those_of_a_hull_are_those_of_their_own_hull(unseen: Unseen) -> None:
    """Whether there was room for them, as the first time, or not."""
    rng = np.random.default_rng(7)
    seen = make_seen(NAMES, SIZES, [rng.random((480, 640)) < 0.9, None, None])
    views = make_views(NAMES, SIZES, ring_matrices(3, np.zeros(3)), unseen, seen=seen)
    masks, others = (
        [(rng.random((480, 640)) < 0.5).astype(np.uint8) for _ in NAMES] for _ in range(2)
    )
    hull, expected = make_hull(views, masks), make_hull(views, others)
    own = hull.masks_flat.copy(), hull.answers_flat.copy(), hull.integrals_flat.copy()
    for _ in range(2):
        other, both = beside(hull, others)
        for name, first in zip(("masks_flat", "answers_flat", "integrals_flat"), own, strict=True):
            second = getattr(expected, name)
            np.testing.assert_array_equal(getattr(other, name), second)
            np.testing.assert_array_equal(getattr(both, name), np.concatenate([first, second]))
            np.testing.assert_array_equal(getattr(hull, name), first)
            assert not getattr(both, name).flags.writeable


def test_memory_of_images_is_used_again_once_no_part_of_it_is_held() -> None:
    views = make_views(NAMES, SIZES, ring_matrices(3, np.zeros(3)))

    def address(hull: Hull) -> int:
        return int(hull.masks_flat.__array_interface__["data"][0])

    masks = [np.ones((480, 640), np.uint8)] * 3
    first = make_hull(views, masks)
    held, begin = first.mask(1)[100:], address(first)
    del first
    others = [make_hull(views, [np.zeros_like(mask) for mask in masks]) for _ in range(3)]
    assert begin not in [address(hull) for hull in others]
    assert held.all()

    del held
    again = make_hull(views, [np.zeros_like(mask) for mask in masks])
    assert address(again) == begin
    assert not again.masks_flat.any()
    assert not again.integrals_flat.any()
