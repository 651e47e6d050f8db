"""The world from a board, from named points, from the floor; and what is refused."""

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from helpers.boards import look_at, make_camera, ring
from helpers.recorded_boards import random_pose
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import project_points
from hybridve.calib.placing.marks import Mark, triangulate
from hybridve.calib.placing.moments import Body, Moment, PoseKey
from hybridve.calib.placing.world import (
    Placed,
    SeenBoards,
    place_by_board,
    place_by_points,
    place_on_floor,
    place_world,
)
from hybridve.calib.plain import to_plain
from hybridve.calib.pose import Pose, compose, invert, rotation_about_axes, transform
from hybridve.calib.solving.bundle import BundleView

EXACT_M = 1e-8

BOARD = Chessboard(7, 6, 0.1)
TRUE_POINTS = np.array(
    [[0.0, 0.0, 0.0], [0.6, 0.0, 0.0], [0.6, 0.5, 0.0], [0.0, 0.5, 0.0], [0.2, 0.3, 0.4]]
)


def in_rig(rig_from_world: Pose, n_cameras: int = 3) -> list[Camera]:
    """Cameras around a board that is the world, told in another frame."""
    return [
        replace(camera, cam_from_world=compose(camera.cam_from_world, invert(rig_from_world)))
        for camera in ring(BOARD, ["OPENCV"] * n_cameras)
    ]


def clicked(
    cameras: Sequence[Camera],
    rig_from_world: Pose,
    points: NDArray[np.float64],
    said: NDArray[np.float64] | None = None,
    is_floor: bool = False,
) -> list[Mark]:
    seen = [project_points(camera, transform(rig_from_world, points))[0] for camera in cameras]
    return [
        Mark(
            f"p{index}",
            {
                camera.name: (float(pixels[index, 0]), float(pixels[index, 1]))
                for camera, pixels in zip(cameras, seen, strict=True)
            },
            None if is_floor else (points if said is None else said)[index],
            is_floor,
        )
        for index in range(len(points))
    ]


def lying(
    rig_from_boards: Sequence[Pose], instants: Sequence[int | str], seeing: Sequence[Sequence[int]]
) -> SeenBoards:
    """One board, in several places, and which cameras see it there."""
    pixels = np.zeros((len(BOARD.points_board), 2))
    views = [
        BundleView(camera=camera, pose=pose, board=0, pixels=pixels, image=f"{instants[pose]}")
        for pose, cameras in enumerate(seeing)
        for camera in cameras
    ]
    moments = [
        Moment.of_clip(one) if isinstance(one, int) else Moment.of_still(0, one) for one in instants
    ]
    keys = [PoseKey(moment, Body(False, "board")) for moment in moments]
    return SeenBoards([BOARD], [np.eye(3, 4)], rig_from_boards, keys, views)


def assert_same(placed: Placed, world_from_rig: Pose) -> None:
    np.testing.assert_allclose(placed.world_from_rig, world_from_rig, atol=EXACT_M)
    told = to_plain(placed.told)
    assert json.loads(json.dumps(told)) == told


@settings(max_examples=asked(15))
@given(seed=st.integers(0, 1000))
def test_all_ways_find_the_same_world(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig_from_world = random_pose(rng, 3.0, 2.0)
    cameras = in_rig(rig_from_world)
    seen = lying([rig_from_world], [0], [[0, 1, 2]])
    world_from_rig = invert(rig_from_world)

    assert_same(place_world("board", cameras, seen), world_from_rig)

    marks = clicked(cameras, rig_from_world, TRUE_POINTS)
    by_points = place_world("points", cameras, seen, marks)
    assert_same(by_points, world_from_rig)
    assert by_points.told.residuals_mm is not None
    assert max(by_points.told.residuals_mm.values()) < 1e-3
    assert by_points.told.scale == pytest.approx(1.0, abs=1e-5)
    assert not by_points.told.warnings

    # The floor's origin is the foot of the board's middle, its x that of the board.
    about_middle = np.column_stack([np.eye(3), -BOARD.center_board])
    for floor in (clicked(cameras, rig_from_world, TRUE_POINTS[:4], is_floor=True), []):
        placed = place_world("floor", cameras, seen, floor)
        assert_same(placed, compose(about_middle, world_from_rig))


# --- The board -------------------------------------------------------------------------------


def test_the_board_is_that_of_the_first_instant_that_most_cameras_see() -> None:
    cameras = in_rig(np.eye(3, 4))
    raised = [np.column_stack([np.eye(3), [0.0, 0.0, 0.01 * k]]) for k in range(5)]
    seen = lying(raised, ["a.png", 10, 20, 30, 40], [[0, 1, 2], [0], [1, 2], [0, 2], [1]])

    placed = place_by_board(cameras, seen)

    assert_same(placed, invert(raised[2]))
    assert placed.told.instant == 20
    assert placed.told.text == "the board in frame 20"
    assert placed.told.cameras == ("cam2", "cam3")


def test_a_camera_that_sees_the_board_from_below_is_named() -> None:
    cameras = in_rig(np.eye(3, 4))
    down = replace(cameras[1], cam_from_world=compose(cameras[1].cam_from_world, _flip(z=True)))
    cameras[1] = down

    with pytest.raises(
        CalibrationError, match=r"camera 'cam2' \(1.15 m\) came out under the floor"
    ):
        place_by_board(cameras, lying([np.eye(3, 4)], [0], [[0, 1, 2]]))


def test_a_camera_behind_a_board_that_others_see_is_a_warning() -> None:
    cameras = in_rig(np.eye(3, 4))
    cameras[1] = replace(
        cameras[1], cam_from_world=compose(cameras[1].cam_from_world, _flip(z=True))
    )

    placed = place_by_board(cameras, lying([np.eye(3, 4)], [0], [[0, 2]]))

    (warning,) = placed.told.warnings
    assert "'cam2' stands 1.15 m behind" in warning


def _on_both_sides() -> list[Camera]:
    """Two cameras before a board and one that looks at its back."""
    cameras = in_rig(np.eye(3, 4))
    behind = cameras[1].center_world * [1.0, 1.0, -1.0]
    cameras[1] = replace(
        cameras[1], cam_from_world=look_at((behind[0], behind[1], behind[2]), ORIGIN)
    )
    return cameras


ORIGIN = (0.0, 0.0, 0.0)
TILTED = [rotation_about_axes((12.0 * k, -9.0 * k, 0.0)) for k in range(3)]


def test_cameras_on_both_sides_of_a_sheet_that_is_moved_are_where_they_are() -> None:
    poses = [np.column_stack([turn, [0.1 * k, 0.0, 0.0]]) for k, turn in enumerate(TILTED)]

    placed = place_by_board(_on_both_sides(), lying(poses, [0, 1, 2], [[0, 1, 2]] * 3))

    assert_same(placed, np.eye(3, 4))
    assert not placed.told.warnings


def test_a_sheet_that_is_slid_in_its_plane_tells_no_back_from_a_mirrored_picture() -> None:
    poses = [np.column_stack([np.eye(3), [0.1 * k, 0.0, 0.0]]) for k in range(3)]

    with pytest.raises(CalibrationError, match=r"'cam2'.*move and tilt the board"):
        place_by_board(_on_both_sides(), lying(poses, [0, 1, 2], [[0, 1, 2]] * 3))


def test_what_one_camera_alone_saw_of_a_chessboard_tells_no_side() -> None:
    alone = [np.column_stack([turn, [0.0, 0.0, 0.0]]) for turn in TILTED[1:]]

    with pytest.raises(CalibrationError, match=r"'cam2'.*under the floor"):
        place_by_board(
            _on_both_sides(),
            lying([np.eye(3, 4), *alone], [0, "a.png", "b.png"], [[0, 1, 2], [1], [1]]),
        )


def test_cameras_a_finger_from_the_board_are_doubted() -> None:
    """Lengths told in metres, or in centimetres, where millimetres are asked for."""
    small = Chessboard(7, 6, 0.002)
    near = ring(small, ["OPENCV"] * 3, 0.03)
    near = [
        replace(
            camera,
            cam_from_world=look_at((camera.center_world[0], camera.center_world[1], 0.02), ORIGIN),
        )
        for camera in near
    ]
    seen = replace(lying([np.eye(3, 4)], [0], [[0, 1, 2]]), boards=[small])

    (warning,) = place_world("board", near, seen).told.warnings

    assert "within 36 mm of the board" in warning
    assert "20" in warning
    far = in_rig(np.eye(3, 4))
    assert not place_world("board", far, lying([np.eye(3, 4)], [0], [[0, 1, 2]])).told.warnings


def _flip(z: bool) -> Pose:
    """Return a half turn about x: y and z change sign."""
    return np.column_stack([np.diag([1.0, -1.0, -1.0 if z else 1.0]), np.zeros(3)])


# --- Named points ----------------------------------------------------------------------------


def test_noise_of_clicks_is_told_in_mm() -> None:
    cameras = in_rig(np.eye(3, 4))
    marks = clicked(cameras, np.eye(3, 4), TRUE_POINTS)
    (x, y) = marks[4].pixels["cam1"]
    marks[4] = replace(marks[4], pixels={**marks[4].pixels, "cam1": (x + 15.0, y)})

    told = place_by_points(cameras, marks).told

    missed_mm = told.residuals_mm
    assert missed_mm is not None
    assert max(missed_mm, key=lambda name: missed_mm[name]) == "p4"
    assert 1.0 < missed_mm["p4"] < 50.0
    (warning,) = told.warnings
    assert "point 'p4'" in warning


def test_a_scale_that_disagrees_is_named() -> None:
    cameras = in_rig(np.eye(3, 4))

    placed = place_by_points(
        cameras, clicked(cameras, np.eye(3, 4), TRUE_POINTS, TRUE_POINTS / 1.05)
    )
    (warning,) = placed.told.warnings
    assert "1.050 times as far apart" in warning

    within = place_by_points(
        cameras, clicked(cameras, np.eye(3, 4), TRUE_POINTS, TRUE_POINTS / 1.01)
    )
    assert not within.told.warnings

    with pytest.raises(CalibrationError, match=r"10\.000 times as far apart.*millimetres"):
        place_by_points(cameras, clicked(cameras, np.eye(3, 4), TRUE_POINTS, TRUE_POINTS / 10.0))


def test_no_scale_is_fitted() -> None:
    cameras = in_rig(np.eye(3, 4))

    placed = place_by_points(
        cameras, clicked(cameras, np.eye(3, 4), TRUE_POINTS, TRUE_POINTS * 1.01)
    )

    rotation = placed.world_from_rig[:, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=EXACT_M)


def test_mirrored_points_are_named() -> None:
    cameras = in_rig(np.eye(3, 4))
    mirrored = TRUE_POINTS * [1.0, -1.0, 1.0]

    with pytest.raises(CalibrationError, match="mirror image"):
        place_by_points(cameras, clicked(cameras, np.eye(3, 4), TRUE_POINTS, mirrored))


def test_points_of_the_floor_that_are_listed_mirrored_put_all_cameras_below_it() -> None:
    cameras = in_rig(np.eye(3, 4))
    flat = TRUE_POINTS[:4]

    with pytest.raises(CalibrationError, match=r"'cam1'.*'cam3'.*under the floor.*mirrored"):
        place_by_points(cameras, clicked(cameras, np.eye(3, 4), flat, flat * [1.0, -1.0, 1.0]))


def test_exchanged_names_are_told() -> None:
    cameras = in_rig(np.eye(3, 4))
    said = TRUE_POINTS[[0, 2, 1, 3, 4]]

    with pytest.raises(CalibrationError, match="'p1' and 'p2' seem to be exchanged"):
        place_by_points(cameras, clicked(cameras, np.eye(3, 4), TRUE_POINTS, said))


def test_too_few_points_and_points_on_a_line_are_refused() -> None:
    cameras = in_rig(np.eye(3, 4))
    marks = clicked(cameras, np.eye(3, 4), TRUE_POINTS)
    on_line = np.array([[0.1, 0.1, 0.0], [0.2, 0.2, 0.0], [0.4, 0.4, 0.0]])

    with pytest.raises(CalibrationError, match="3 named points or more, found 2: p0, p1"):
        place_by_points(cameras, marks[:2])
    with pytest.raises(CalibrationError, match="on a line"):
        place_by_points(cameras, clicked(cameras, np.eye(3, 4), on_line))
    with pytest.raises(CalibrationError, match="point 'p0' is seen by 1 camera"):
        place_by_points(cameras[:1], marks)


# --- The floor -------------------------------------------------------------------------------


def test_the_board_need_not_lie_on_the_floor() -> None:
    cameras = in_rig(np.eye(3, 4))
    tilt = random_pose(np.random.default_rng(0), 0.5, 0.0)[:, :3]
    raised = np.column_stack([tilt, [0.1, 0.2, 0.3]])
    marks = clicked(cameras, np.eye(3, 4), TRUE_POINTS[:4], is_floor=True)

    placed = place_on_floor(cameras, lying([raised], [0], [[0, 1, 2]]), marks)

    world_from_rig = placed.world_from_rig
    np.testing.assert_allclose(world_from_rig[:, 2], [0.0, 0.0, 1.0], atol=EXACT_M)
    middle = transform(compose(world_from_rig, raised), BOARD.center_board[None])[0]
    np.testing.assert_allclose(middle[:2], 0.0, atol=EXACT_M)
    along = (world_from_rig[:, :3] @ tilt)[:, 0]
    assert abs(along[1]) < EXACT_M < along[0]
    assert placed.told.residuals_mm is not None
    assert max(map(abs, placed.told.residuals_mm.values())) < 1e-3


def test_a_point_off_the_floor_shows() -> None:
    cameras = in_rig(np.eye(3, 4))
    points = np.vstack([TRUE_POINTS[:4], [[0.3, 0.25, 0.02]]])
    marks = clicked(cameras, np.eye(3, 4), points, is_floor=True)

    told = place_on_floor(cameras, lying([np.eye(3, 4)], [0], [[0, 1]]), marks).told

    assert told.residuals_mm is not None
    assert told.residuals_mm["p4"] == pytest.approx(16.0, abs=0.5)  # 20 mm, less the mean


def test_a_camera_under_the_floor_is_named() -> None:
    cameras = in_rig(np.eye(3, 4))
    marks = clicked(cameras, np.eye(3, 4), TRUE_POINTS[:4], is_floor=True)
    below = make_camera("cam9", "PINHOLE", np.column_stack([np.eye(3), [0.0, 0.0, 0.5]]))

    with pytest.raises(CalibrationError, match=r"camera 'cam9' \(0.50 m\) came out under"):
        place_on_floor([*cameras, below], lying([np.eye(3, 4)], [0], [[0, 1]]), marks)


def test_a_board_in_hand_is_no_floor() -> None:
    cameras = in_rig(np.eye(3, 4))

    with pytest.raises(CalibrationError, match="floor cannot be told"):
        place_on_floor(cameras, lying([np.eye(3, 4)] * 2, [0, 1], [[0, 1], [0]]))


def test_a_floor_on_a_line_is_refused() -> None:
    cameras = in_rig(np.eye(3, 4))
    on_line = np.array([[0.1, 0.1, 0.0], [0.2, 0.2, 0.0], [0.4, 0.4, 0.0]])
    marks = clicked(cameras, np.eye(3, 4), on_line, is_floor=True)

    with pytest.raises(CalibrationError, match="on a line"):
        place_on_floor(cameras, lying([np.eye(3, 4)], [0], [[0, 1]]), marks)


# --- Triangulation ---------------------------------------------------------------------------


def test_parallel_rays_and_points_behind_are_nowhere() -> None:
    first = make_camera("a", "PINHOLE", np.eye(3, 4))
    second = make_camera("b", "PINHOLE", np.column_stack([np.eye(3), [-1.0, 0.0, 0.0]]))
    middle, right = np.array([326.0, 233.0]), np.array([100.0, 0.0])

    parallel, _ = triangulate([first, second], np.stack([middle, middle]))
    behind, _ = triangulate([first, second], np.stack([middle, middle + right]))
    before, missed_px = triangulate([first, second], np.stack([middle, middle - right]))

    assert np.isnan(parallel).all()
    assert np.isnan(behind).all()
    np.testing.assert_allclose(before, [0.0, 0.0, 5.1], atol=EXACT_M)
    assert missed_px.max() < EXACT_M
