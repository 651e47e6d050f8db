"""Cameras at one place with one view are told apart from those that are only near."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.boards import make_camera, ring
from hypothesis import given
from hypothesis import strategies as st

from hybridve.calib.boards.target import Chessboard
from hybridve.calib.judging.twins import find_twins, twins_text
from hybridve.calib.pose import moved_pose
from hybridve.calib.rig import Mount, Rig

BOARD = Chessboard(7, 6, 0.1)
RING = ring(BOARD, ["OPENCV", "PINHOLE", "OPENCV_FISHEYE", "SIMPLE_RADIAL"])


def test_cameras_that_see_different_things_are_no_twins() -> None:
    assert find_twins(Rig(tuple(RING))) == ()
    assert find_twins(Rig((RING[0],))) == ()
    assert twins_text(()) == ""


@given(
    groups=st.lists(st.integers(0, 3), min_size=1, max_size=7),
    scale=st.floats(1e-3, 1e3),
)
def test_all_that_are_one_camera_under_several_names_are_found_at_any_scale(
    groups: list[int], scale: float
) -> None:
    cameras = []
    for number, group in enumerate(groups):
        pose = RING[group].cam_from_world * [1.0, 1.0, 1.0, scale]
        cameras.append(replace(RING[group], name=f"c{number}", cam_from_world=pose))

    found = find_twins(Rig(tuple(cameras)))

    expected = {
        tuple(f"c{number}" for number, other in enumerate(groups) if other == group)
        for group in set(groups)
        if groups.count(group) > 1
    }
    assert set(found) == expected
    assert all(repr(name) in twins_text(found) for names in found for name in names)


@pytest.mark.parametrize("turn_rad", [0.01, 0.3])
def test_another_view_from_the_same_place_is_no_twin(turn_rad: float) -> None:
    turned = moved_pose(RING[0].cam_from_world, np.array([0.0, turn_rad, 0.0, 0.0, 0.0, 0.0]))
    other = replace(RING[0], name="other", cam_from_world=turned)

    assert find_twins(Rig((*RING, other))) == ()


def test_what_moves_nothing_by_a_pixel_makes_no_difference() -> None:
    """Half a pixel is 2 mm here: a focal length of 510 pixels, 1.6 m away."""
    for shift_m, is_twin in ((0.0002, True), (0.02, False)):
        shifted = moved_pose(RING[0].cam_from_world, np.array([0.0, 0.0, 0.0, shift_m, 0.0, 0.0]))
        rig = Rig((*RING, replace(RING[0], name="other", cam_from_world=shifted)))

        assert find_twins(rig) == ((("cam1", "other"),) if is_twin else ())


def test_the_same_view_in_more_pixels_is_a_twin_and_another_zoom_is_none() -> None:
    pose = RING[1].cam_from_world
    fine = make_camera("fine", "PINHOLE", pose, (1280, 960))
    zoomed = replace(RING[1], name="zoomed", params=RING[1].params * [1.1, 1.1, 1.0, 1.0])

    assert find_twins(Rig((RING[1], fine, zoomed))) == (("cam2", "fine"),)


def test_cameras_that_move_are_left_out() -> None:
    still = np.eye(3, 4)
    other = replace(RING[0], name="other")

    assert find_twins(Rig((RING[0], other), mounts={"other": Mount(still, still)})) == ()
