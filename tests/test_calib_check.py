"""A rig against a board: its scale, its odd camera, and evidence by votes."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.boards import look_at, make_camera, project, ring

from hybridve.calib.board import Sighting
from hybridve.calib.camera import Camera
from hybridve.calib.check import SCALE_TOLERANCE, check_rig
from hybridve.calib.errors import CalibrationError
from hybridve.calib.pose import compose, rotation_about_axes
from hybridve.calib.rig import Rig
from hybridve.calib.target import Chessboard

#: Noise-free corners determine the scale to this, and reprojections in pixels.
EXACT = 1e-6

BOARD = Chessboard(8, 6, 0.1)


def corners_of(cameras: list[Camera], board: Chessboard = BOARD) -> dict[str, list[Sighting]]:
    """Return corners as pictures would give them: any camera may have them the other way round."""
    seen = {}
    for index, camera in enumerate(cameras):
        corners = project(camera, camera.cam_from_world, board)
        corners = corners[board.looks[index % len(board.looks)]]
        seen[camera.name] = [Sighting("board clip", 0, 0, corners)]
    return seen


def scaled(camera: Camera, factor: float) -> Camera:
    pose = camera.cam_from_world.copy()
    pose[:, 3] *= factor
    return replace(camera, cam_from_world=pose)


@pytest.mark.parametrize("board", [BOARD, Chessboard(7, 6, 0.1), Chessboard(6, 6, 0.1)])
def test_a_true_rig_agrees_with_its_board(board: Chessboard) -> None:
    cameras = ring(board, ["OPENCV", "PINHOLE", "RADIAL"])

    check = check_rig(Rig(tuple(cameras)), [board], corners_of(cameras, board))

    assert check.is_trustworthy
    assert check.scale == pytest.approx(1.0, abs=EXACT)
    assert max(check.rms_px.values()) < EXACT
    assert check.odd_camera is None
    assert "agrees" in check.message


def test_the_rig_may_stand_anywhere_in_its_world() -> None:
    cameras = ring(BOARD, ["PINHOLE", "PINHOLE"])
    elsewhere = np.column_stack([rotation_about_axes((20.0, 70.0, 100.0)), [3.0, -2.0, 5.0]])
    moved = [
        replace(camera, cam_from_world=compose(camera.cam_from_world, elsewhere))
        for camera in cameras
    ]

    check = check_rig(Rig(tuple(moved)), [BOARD], corners_of(cameras))

    assert check.is_trustworthy
    assert check.scale == pytest.approx(1.0, abs=EXACT)


@pytest.mark.parametrize("factor", [0.001, 0.5, 1.3, 25.4])
def test_a_wrong_scale_is_found_and_told(factor: float) -> None:
    cameras = ring(BOARD, ["PINHOLE", "OPENCV", "PINHOLE"])
    rig = Rig(tuple(scaled(camera, factor) for camera in cameras))

    check = check_rig(rig, [BOARD], corners_of(cameras))

    assert not check.is_trustworthy
    assert check.scale == pytest.approx(factor, rel=EXACT)
    assert check.pair_scales["cam1 cam3"] == pytest.approx(factor, rel=EXACT)
    assert f"scale {factor:.3f}" in check.message
    assert "unit" in check.message


def test_a_scale_within_tolerance_is_told_but_trusted() -> None:
    cameras = ring(BOARD, ["PINHOLE", "PINHOLE"])
    rig = Rig(tuple(scaled(camera, 1 + SCALE_TOLERANCE / 2) for camera in cameras))

    check = check_rig(rig, [BOARD], corners_of(cameras))

    assert check.is_trustworthy
    assert "scale 1.025" in check.message


def test_a_camera_that_was_bumped_is_named() -> None:
    cameras = ring(BOARD, ["PINHOLE"] * 4)
    bump = np.column_stack([rotation_about_axes((0.0, 4.0, 0.0)), [0.05, 0.0, 0.0]])
    bumped = [*cameras]
    bumped[2] = replace(cameras[2], cam_from_world=compose(bump, cameras[2].cam_from_world))

    check = check_rig(Rig(tuple(bumped)), [BOARD], corners_of(cameras))

    assert check.odd_camera == "cam3"
    assert not check.is_trustworthy
    assert "'cam3' stands elsewhere" in check.message


def test_two_cameras_that_disagree_are_told_without_blaming_one() -> None:
    cameras = ring(BOARD, ["PINHOLE", "PINHOLE"])
    bump = np.column_stack([rotation_about_axes((0.0, 5.0, 0.0)), np.zeros(3)])
    bumped = [
        cameras[0],
        replace(cameras[1], cam_from_world=compose(bump, cameras[1].cam_from_world)),
    ]

    check = check_rig(Rig(tuple(bumped)), [BOARD], corners_of(cameras))

    assert not check.is_trustworthy
    assert check.odd_camera is None


def test_one_camera_cannot_check_a_rig() -> None:
    cameras = ring(BOARD, ["PINHOLE", "PINHOLE"])
    corners = corners_of(cameras)
    del corners["cam2"]

    with pytest.raises(CalibrationError, match="1 of its cameras see the board, expected two"):
        check_rig(Rig(tuple(cameras)), [BOARD], corners)


def test_cameras_that_saw_no_board_are_left_out() -> None:
    cameras = ring(BOARD, ["PINHOLE", "PINHOLE"])
    idle = make_camera("idle", "PINHOLE", look_at((0.0, 0.0, 5.0), (9.0, 0.0, 0.0)))

    check = check_rig(Rig((*cameras, idle)), [BOARD], corners_of(cameras))

    assert check.is_trustworthy
    assert set(check.rms_px) == {"cam1", "cam2"}
