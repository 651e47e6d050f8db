"""Pieces of silhouettes that no other camera confirms are dropped, and the hull stays the same."""

import numpy as np
from helpers.hulls import with_gaps
from helpers.sessions import SIZE_PX, ball_mask, ring_matrix
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.lens import Undistortion
from hybridve.hull.agreement.pieces import drop_unconfirmed
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Views, make_hull, make_views

N_CAMERAS = 4
MATRICES = np.array([ring_matrix(camera, N_CAMERAS) for camera in range(N_CAMERAS)])
SIZES_PX = np.array([SIZE_PX] * N_CAMERAS)
NO_LENSES = [Undistortion(*SIZE_PX, np.eye(3), None, None)] * N_CAMERAS


def views(unseen: str = "carve") -> Views:
    names = tuple(f"cam{camera}" for camera in range(N_CAMERAS))
    if unseen == "keep":
        return make_views(names, SIZES_PX, MATRICES, "keep", 2)
    return make_views(names, SIZES_PX, MATRICES)


def balls(*centers: NDArray[np.float64]) -> list[NDArray[np.uint8]]:
    return [
        np.max([ball_mask(matrix, center) for center in centers], axis=0) for matrix in MATRICES
    ]


def test_a_thing_that_all_cameras_see_stays_and_one_that_one_camera_sees_goes() -> None:
    clean = balls(np.zeros(3))
    masks = [mask.copy() for mask in clean]
    masks[2][2:12, 3:20] = 255

    result = drop_unconfirmed(views(), NO_LENSES, masks)

    for mask, expected in zip(result, clean, strict=True):
        np.testing.assert_array_equal(mask, expected > 0)


def test_two_things_apart_both_stay() -> None:
    masks = balls(np.array([0.5, 0.0, 0.1]), np.array([-0.5, 0.1, 0.0]))

    result = drop_unconfirmed(views(), NO_LENSES, masks)

    for mask, expected in zip(result, masks, strict=True):
        np.testing.assert_array_equal(mask, expected > 0)


def test_a_thing_smaller_than_the_witness_rays_are_apart_is_not_lost() -> None:
    # One pixel in each camera: the projections of one point.
    point = np.array([0.21, -0.13, 0.05, 1.0])
    masks = [np.zeros(SIZE_PX[::-1], np.uint8) for _ in MATRICES]
    for mask, matrix in zip(masks, MATRICES, strict=True):
        x, y, depth = matrix @ point
        mask[int(y / depth), int(x / depth)] = 1

    result = drop_unconfirmed(views(), NO_LENSES, masks)

    assert [int(mask.sum()) for mask in result] == [1] * N_CAMERAS


@settings(max_examples=asked(25))
@given(seed=st.integers(0, 2**32 - 1), unseen=st.sampled_from(["carve", "keep", "gaps"]))
def test_the_hull_is_the_same_at_every_point(seed: int, unseen: str) -> None:
    rng = np.random.default_rng(seed)
    masks = balls(rng.uniform(-0.5, 0.5, 3))
    for mask in masks:
        for _ in range(rng.integers(0, 5)):
            row, column = rng.integers(0, SIZE_PX[1]), rng.integers(0, SIZE_PX[0])
            height, width = rng.integers(1, 30, 2)
            mask[row : row + height, column : column + width] = 255
    all_views = with_gaps(rng, views("keep")) if unseen == "gaps" else views(unseen)

    result = drop_unconfirmed(all_views, NO_LENSES, masks)

    points = rng.uniform(-1.5, 1.5, (20_000, 3))
    before = contains_points(make_hull(all_views, masks), points)
    after = contains_points(make_hull(all_views, result), points)
    np.testing.assert_array_equal(after, before)
    for mask, cleaned in zip(masks, result, strict=True):
        assert not (cleaned.astype(bool) & (mask == 0)).any()
