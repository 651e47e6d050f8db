"""What the others say that a camera sees: balls in closed form, and rays that are followed."""

import numpy as np
import pytest
from helpers.agreement import random_views, shifted
from helpers.hulls import ball_hull, ball_masks, ring_views
from helpers.thorough import asked
from helpers.view_scene import cone_intersections
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.hull.agreement.others import differences, in_view_of_others, meets_others
from hybridve.hull.query.silhouettes import Views, hull_of, make_hull
from hybridve.hull.query.walk import spans_of_rays

BALL_WORLD, RADIUS_M = np.array([0.1, -0.05, 0.0]), 0.3
SHIFT_PX = 20


def small_ring(n_cameras: int = 4) -> Views:
    return ring_views(n_cameras, 240, 162, 233.0)


def rays_of(views: Views, camera: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where a camera stands, (3,), and the rays (H, W, 3) through its pixels' centres."""
    width, height = views.sizes_px[camera].tolist()
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    matrix = views.img_from_local[camera, :, :3]
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(matrix).T
    return views.centers_local()[camera] + views.origin_world, rays


def around(area: NDArray[np.bool_], pixels: int = 1) -> NDArray[np.bool_]:
    """Return an area with all pixels that are within so many rows and columns of it."""
    padded = np.pad(area, pixels)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * pixels + 1,) * 2)
    return np.asarray(windows.any(axis=(2, 3)))


@pytest.mark.parametrize("n_cameras", [2, 4, 7])
def test_the_others_say_what_their_tangent_cones_have_in_common(n_cameras: int) -> None:
    views = small_ring(n_cameras)
    centers = views.centers_local() + views.origin_world
    half_angles = np.arcsin(RADIUS_M / np.linalg.norm(BALL_WORLD - centers, axis=1))
    eye, rays = rays_of(views, 1)
    others = np.arange(n_cameras) != 1

    enter, leave = cone_intersections(
        eye, rays.reshape(-1, 3), centers[others], BALL_WORLD, half_angles[others]
    )
    true = (np.minimum(leave, 6.0) > np.maximum(enter, 0.0)).reshape(rays.shape[:2])
    found = meets_others(ball_hull(views, BALL_WORLD, RADIUS_M), 1)

    # A pixel of another camera's outline is up to 1.5 as large in this one's image.
    assert not (found & ~around(true, 2)).any()
    assert not (true & ~around(found, 2)).any()
    assert true.sum() > 1000


@pytest.mark.parametrize("n_cameras", [3, 4, 10])
def test_what_is_real_is_inside_of_what_the_others_say(n_cameras: int) -> None:
    views = small_ring(n_cameras)
    hull = ball_hull(views, BALL_WORLD, RADIUS_M)

    for camera in range(n_cameras):
        sees_alone, _ = differences(hull.mask(camera) > 0, meets_others(hull, camera), 1)
        assert not sees_alone.any()


@pytest.mark.parametrize("error_px", [0, 5])
def test_a_silhouette_that_was_shifted_sticks_out_on_one_side_by_as_much(error_px: int) -> None:
    views = small_ring(12)
    masks = ball_masks(views, BALL_WORLD, RADIUS_M)
    masks[3] = shifted(masks[3], SHIFT_PX, 0)
    hull = make_hull(views, masks)

    sees_alone, misses = differences(masks[3] > 0, meets_others(hull, 3), error_px)

    rows, columns = np.nonzero(masks[3])
    row = round(rows.mean())
    assert abs(sees_alone[row].sum() - SHIFT_PX) <= 2
    assert (np.flatnonzero(sees_alone[row]) > columns.mean()).all()
    assert abs(misses[row].sum() - SHIFT_PX) <= 4  # a hull bulges
    assert (np.flatnonzero(misses[row]) < columns.mean()).all()


def test_what_outlines_may_err_by_is_no_difference() -> None:
    mask = np.zeros((60, 80), np.bool_)
    mask[20:40, 20:50] = True
    wider = np.zeros_like(mask)
    wider[20:40, 20:56] = True

    for first, second in ((mask, wider), (wider, mask)):
        assert not any(area.any() for area in differences(first, second, 6))
    sees_alone, misses = differences(wider, mask, 5)
    np.testing.assert_array_equal(sees_alone, wider & ~mask)
    assert not misses.any()


def test_the_own_silhouette_plays_no_part() -> None:
    views = small_ring()
    masks = ball_masks(views, BALL_WORLD, RADIUS_M)
    blind = [np.zeros_like(mask) if k == 2 else mask for k, mask in enumerate(masks)]

    np.testing.assert_array_equal(
        meets_others(make_hull(views, masks), 2), meets_others(make_hull(views, blind), 2)
    )


def test_one_that_saw_nothing_leaves_the_others_nothing() -> None:
    views = small_ring()
    masks = ball_masks(views, BALL_WORLD, RADIUS_M)
    masks[0][:] = 0

    assert not meets_others(make_hull(views, masks), 2).any()
    assert meets_others(make_hull(views, masks), 0).any()


def test_a_single_camera_has_no_others() -> None:
    views = small_ring(1)
    with pytest.raises(ValueError, match="no other camera"):
        meets_others(ball_hull(views, BALL_WORLD, RADIUS_M), 0)


@pytest.mark.slow
@settings(max_examples=asked(15))
@given(seed=st.integers(0, 2**32 - 1), unseen=st.sampled_from(["carve", "keep"]))
def test_rays_that_are_followed_say_the_same(seed: int, unseen: str) -> None:
    rng = np.random.default_rng(seed)
    n_cameras = int(rng.integers(2, 6))
    views = random_views(rng, n_cameras, "keep" if unseen == "keep" else "carve", spread_m=0.3)
    hull = ball_hull(views, rng.uniform(-0.2, 0.2, 3), float(rng.uniform(0.1, 0.4)))
    camera = int(rng.integers(n_cameras))
    rest = np.flatnonzero(np.arange(n_cameras) != camera)
    whole = make_hull(views, [np.ones((h, w), np.uint8) for w, h in views.sizes_px.tolist()])

    for all_of_them, found in (
        (hull, meets_others(hull, camera)),
        (whole, in_view_of_others(views, camera)),
    ):
        eye, rays = rays_of(views, camera)
        rays = rays.reshape(-1, 3)
        some = rng.choice(len(rays), 300, replace=False)
        spans = spans_of_rays(hull_of(all_of_them, rest), np.tile(eye, (300, 1)), rays[some], 900.0)
        meets = np.array([len(span) > 0 for span in spans])
        # What is said not to meet is proved; what is said to meet may do so beside the centre.
        assert not (meets & ~found.ravel()[some]).any()
        border = np.pad(np.zeros(np.subtract(found.shape, 2), np.bool_), 1, constant_values=True)
        inner = ~around(~found | border, 4).ravel()[some]
        assert meets[inner].mean() > 0.98 if inner.any() else True
