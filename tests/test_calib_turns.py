"""What tells that a camera is turned about a board that looks the same when turned."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.boards import project
from helpers.turned_rigs import BOARDS, SIZE_PX, around, turned

from hybridve.calib.boards.board import Observations, Sighting
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.judging.check import check_rig
from hybridve.calib.pose import compose, moved_pose
from hybridve.calib.verdict import RigCheck

SYMMETRIC, QUARTERS = BOARDS[0], BOARDS[3]


def at_instants(
    cameras: tuple[Camera, ...],
    boards: list[Chessboard],
    poses: list[tuple[int, int, np.ndarray]],
    is_still: bool,
) -> list[Observations]:
    """Return what cameras see of boards (instant, board, world_from_board), without pictures."""
    rng = np.random.default_rng(3)
    found = []
    for camera in cameras:
        sightings = []
        for instant, number, pose in poses:
            board = boards[number]
            pixels = project(camera, compose(camera.cam_from_world, pose), board)
            pixels = pixels[board.looks[rng.integers(len(board.looks))]]
            sightings.append(Sighting("board clip", instant, number, pixels))
        found.append(Observations(camera.name, "PINHOLE", SIZE_PX, tuple(sightings), is_still))
    return found


def moved(by_m: float) -> np.ndarray:
    return moved_pose(np.eye(3, 4), np.array([0.0, 0.0, 0.2 * by_m, by_m, 0.0, 0.0]))


def state(check: RigCheck) -> str:
    if check.is_trustworthy:
        return "agrees"
    return "refuted" if check.is_refuted else "open"


@pytest.mark.parametrize("board", BOARDS, ids=str)
def test_a_board_that_was_seen_in_two_places_tells(board: Chessboard) -> None:
    cameras, _ = around(board, 0, 3, False)
    seen = at_instants(cameras, [board], [(0, 0, moved(0.0)), (7, 0, moved(0.4))], False)

    right = check_rig(turned(cameras, board, (0, 0, 0)), [board], seen)
    wrong = check_rig(turned(cameras, board, (0, 1, 0)), [board], seen)

    assert (state(right), state(wrong)) == ("agrees", "refuted")
    assert wrong.odd_camera == "cam2"


def test_a_board_that_hardly_moved_tells_nothing() -> None:
    """What is less than a camera may miss excludes no turn: it is said, and not passed."""
    cameras, _ = around(SYMMETRIC, 0, 3, False)
    seen = at_instants(cameras, [SYMMETRIC], [(0, 0, moved(0.0)), (7, 0, moved(0.002))], False)

    for looks in ((0, 0, 0), (0, 1, 0)):
        check = check_rig(turned(cameras, SYMMETRIC, looks), [SYMMETRIC], seen)

        assert state(check) == "open"


@pytest.mark.slow
@pytest.mark.parametrize("second", [Chessboard(7, 6, 0.05), Chessboard(9, 5, 0.05)], ids=str)
def test_a_second_board_tells_whether_it_is_symmetric_or_not(second: Chessboard) -> None:
    boards = [SYMMETRIC, second]
    cameras, _ = around(SYMMETRIC, 0, 3, False)
    seen = at_instants(cameras, boards, [(0, 0, moved(0.0)), (0, 1, moved(-0.4))], True)

    right = check_rig(turned(cameras, SYMMETRIC, (1, 1, 1)), boards, seen)
    wrong = check_rig(turned(cameras, SYMMETRIC, (0, 0, 1)), boards, seen)

    assert (state(right), state(wrong)) == ("agrees", "refuted")


@pytest.mark.slow
def test_the_distance_that_is_told_is_that_of_the_two_places() -> None:
    cameras, seen = around(QUARTERS, 1, 3, True)

    for look, angle_deg in ((1, 90.0), (2, 180.0), (3, 90.0)):
        rig = turned(cameras, QUARTERS, (0, look, 0))
        check = check_rig(rig, [QUARTERS], seen)

        assert check.turned_sides == (("cam2",),)
        told = check.turned["cam2"]
        off_m = np.linalg.norm(rig["cam2"].center_world - cameras[1].center_world)
        assert told.turn_deg == pytest.approx(angle_deg)
        assert told.shift_m == pytest.approx(off_m, abs=0.01)
        assert f"{told.shift_m:.2f} m" in check.message


def test_of_two_cameras_either_is_named() -> None:
    cameras, seen = around(SYMMETRIC, 1, 2, True)

    check = check_rig(turned(cameras, SYMMETRIC, (0, 1)), [SYMMETRIC], seen)

    assert check.turned_sides == (("cam1",), ("cam2",))
    assert "either 'cam1' or 'cam2' stand elsewhere" in check.message


@pytest.mark.slow
def test_corners_that_were_given_by_hand_in_one_order_tell() -> None:
    cameras, seen = around(SYMMETRIC, 0, 4, False)
    by_hand = []
    for camera, one in zip(cameras, seen, strict=True):
        exact = project(camera, camera.cam_from_world, SYMMETRIC)
        (sighting,) = one.sightings
        misses = [np.abs(sighting.pixels[look] - exact).max() for look in SYMMETRIC.looks]
        by_hand.append(replace(one, hand_look=int(np.argmin(misses))))

    states = {}
    for looks in ((0, 0, 0, 0), (0, 0, 1, 0)):
        check = check_rig(turned(cameras, SYMMETRIC, looks), [SYMMETRIC], by_hand)
        states[looks] = (state(check), tuple(check.turned))

    assert states[0, 0, 0, 0] == ("agrees", ())
    assert states[0, 0, 1, 0] == ("refuted", ("cam3",))


@pytest.mark.slow
def test_a_camera_that_alone_sees_no_scene_is_open_and_the_others_are_told() -> None:
    cameras, seen = around(SYMMETRIC, 2, 4, True)
    blind = [replace(one, picture=None) if one.name == "cam4" else one for one in seen]

    good = check_rig(turned(cameras, SYMMETRIC, (0, 0, 0, 0)), [SYMMETRIC], blind)
    bad = check_rig(turned(cameras, SYMMETRIC, (1, 0, 0, 0)), [SYMMETRIC], blind)

    assert (state(good), good.undecided) == ("open", ("cam4",))
    assert "whether 'cam4' stands as the rig says" in good.message
    assert (state(bad), tuple(bad.turned), bad.undecided) == ("refuted", ("cam1",), ("cam4",))
