"""Boards of markers: where their points are found, and what is said of unusual ones."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.marker_boards import (
    BLACK,
    WHITE,
    Sheet,
    april_sheet,
    charuco_sheet,
    project_board,
    render_sheets,
)
from numpy.typing import NDArray

from hybridve.calib.boards.markers import AprilGrid, Charuco
from hybridve.calib.boards.named import make_board
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.pose import Pose

#: What 9 rays a pixel and noise leave of a point's place.
RENDERED_RMS_PX = 0.03

#: The other board's points are hundreds of pixels away.
TOLD_APART_PX = 0.05

CHARUCO = Charuco(8, 6, 0.1, 0.075, "DICT_5X5_100")
APRIL = AprilGrid(3, 2, 0.1, 0.03)
SIZE_PX = (480, 360)


def facing(board: Charuco | AprilGrid, distance_m: float, shift_m: float = 0.0) -> Pose:
    """A camera before the printed side, x to the right and y up, tilted a little."""
    tilt = cv2.Rodrigues(np.array([0.25, 0.2, 0.1]))[0] @ np.diag([1.0, -1.0, -1.0])
    return np.column_stack([tilt, [shift_m, 0.0, distance_m] - tilt @ board.center_board])


@pytest.fixture(scope="module")
def camera() -> Camera:
    return Camera("cam", "PINHOLE", *SIZE_PX, np.array([390.0, 390, 242, 178]), np.eye(3, 4))


def errors_px(
    camera: Camera, pose: Pose, board: Charuco | AprilGrid, found: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(found - project_board(camera, pose, board), axis=1))


def rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


@pytest.mark.slow
@pytest.mark.parametrize("legacy", [False, True])
def test_charuco_corners_are_found_and_the_pattern_is_named(camera: Camera, legacy: bool) -> None:
    pose = facing(CHARUCO, 0.9)
    image = render_sheets(camera, [(charuco_sheet(CHARUCO, legacy, 112), pose)], 2.0, 3)

    detection = CHARUCO.detect(image)

    assert detection.corners is not None, detection.how
    errors = errors_px(camera, pose, CHARUCO, detection.corners)
    assert np.isfinite(errors).all()
    assert rms(errors) < RENDERED_RMS_PX
    assert ("old pattern" if legacy else "new pattern") in detection.how
    assert detection.notes == ()


def test_a_board_seen_in_part_has_nan_where_it_is_not_seen(camera: Camera) -> None:
    pose = facing(CHARUCO, 0.9, 0.35)
    image = render_sheets(camera, [(charuco_sheet(CHARUCO, dots=112), pose)], 2.0, 3)
    truth = project_board(camera, pose, CHARUCO)
    in_view = ((truth > 0) & (truth < SIZE_PX)).all(axis=1)
    assert 10 < in_view.sum() < 30, "the board is not seen in part"

    corners = CHARUCO.detect(image).corners

    assert corners is not None
    seen = np.isfinite(corners[:, 0])
    assert not (seen & ~in_view).any()
    assert seen.sum() > 0.8 * in_view.sum()
    assert rms(errors_px(camera, pose, CHARUCO, corners)) < RENDERED_RMS_PX


@pytest.mark.slow
@pytest.mark.parametrize("board", [CHARUCO, APRIL])
def test_inverted_and_mirrored_boards_are_found_and_said(
    camera: Camera, board: Charuco | AprilGrid
) -> None:
    pose = facing(board, 0.9 if board is CHARUCO else 0.5)
    sheet = charuco_sheet(board, dots=112) if isinstance(board, Charuco) else april()
    image = render_sheets(camera, [(sheet, pose)], 2.0, 3)

    inverted = board.detect(WHITE + BLACK - image, "usual")
    mirrored = board.detect(np.ascontiguousarray(image[:, ::-1]), "usual")

    assert inverted.notes == ("inverted",)
    assert mirrored.notes == ("mirrored: seen from the back",)
    assert inverted.corners is not None
    assert mirrored.corners is not None
    turned = mirrored.corners * (-1, 1) + (SIZE_PX[0], 0)
    for corners in (inverted.corners, turned):
        assert rms(errors_px(camera, pose, board, corners)) < RENDERED_RMS_PX


def april() -> Sheet:
    return april_sheet(3, 2, 0.1, 0.03)


def test_kalibrs_tags_run_from_the_bottom_left_and_their_corners_counterclockwise(
    camera: Camera,
) -> None:
    pose = facing(APRIL, 0.5)
    image = render_sheets(camera, [(april(), pose)], 2.0, 3)

    np.testing.assert_allclose(
        APRIL.points_board[[0, 1, 2, 3, 4, 12]],
        np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0], [0.13, 0, 0], [0, 0.13, 0]]),
        atol=1e-12,
    )
    corners = APRIL.detect(image).corners
    assert corners is not None
    assert np.isfinite(corners).all()
    assert rms(errors_px(camera, pose, APRIL, corners)) < RENDERED_RMS_PX


def test_two_boards_in_one_image_are_told_apart_by_their_first_marker(camera: Camera) -> None:
    left, right = (Charuco(5, 4, 0.05, 0.0375, "DICT_4X4_100", False, n) for n in (0, 77))
    at = [(board, facing(board, 0.6, x)) for board, x in ((left, -0.16), (right, 0.16))]
    image = render_sheets(camera, [(charuco_sheet(b, dots=80), pose) for b, pose in at], 2.0, 3)

    for board, pose in at:
        corners = board.detect(image).corners
        assert corners is not None
        assert rms(errors_px(camera, pose, board, corners)) < TOLD_APART_PX


@pytest.mark.slow
def test_corners_of_squares_that_are_not_square_are_where_they_were_measured(
    camera: Camera,
) -> None:
    board = Charuco(8, 6, 0.1, 0.075, "DICT_5X5_100", square_y_m=0.093)
    pose = facing(board, 0.9)
    image = render_sheets(camera, [(charuco_sheet(board, dots=112), pose)], 2.0, 3)

    corners = board.detect(image).corners

    assert corners is not None
    assert np.isfinite(corners).all()
    assert rms(errors_px(camera, pose, board, corners)) < RENDERED_RMS_PX
    np.testing.assert_allclose(board.points_board[-1], [0.6, 0.372, 0.0], atol=1e-12)


@pytest.mark.slow
def test_in_a_large_image_points_are_as_exact() -> None:
    camera = Camera("cam", "PINHOLE", 2401, 1603, np.array([1900.0, 1900, 1210, 790]), np.eye(3, 4))
    board = Charuco(5, 4, 0.05, 0.0375, "DICT_4X4_100", first_id=30)
    pose = facing(board, 0.9, 0.4)
    image = render_sheets(camera, [(charuco_sheet(board, dots=112), pose)], 2.0, 2)

    detection = board.detect(image)

    assert detection.corners is not None
    assert detection.how.startswith("markers at 0.666x"), "the image was not reduced"
    assert np.isfinite(detection.corners).all()
    assert rms(errors_px(camera, pose, board, detection.corners)) < RENDERED_RMS_PX


def test_a_grid_of_tags_without_black_squares_between_them_is_refused(camera: Camera) -> None:
    sheet = april_sheet(3, 2, 0.1, 0.03, squares=False)
    image = render_sheets(camera, [(sheet, facing(APRIL, 0.5))], 2.0, 3)

    detection = APRIL.detect(image, "usual")

    assert detection.corners is None
    assert "no black squares" in detection.how


def test_noise_and_other_boards_are_no_board(camera: Camera) -> None:
    noise = np.random.default_rng(3).integers(0, 255, (240, 320), dtype=np.uint8)
    image = render_sheets(
        camera, [(charuco_sheet(CHARUCO, dots=112), facing(CHARUCO, 0.9))], 2.0, 2
    )

    assert CHARUCO.detect(noise).corners is None
    for other in (Charuco(9, 6, 0.1, 0.075, "DICT_5X5_100"), APRIL):
        detection = other.detect(image, "usual")
        assert detection.corners is None
        assert detection.how.startswith("tried markers")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"columns": 1, "rows": 1}, "at least 2 are needed"),
        ({"gap_mm": 130}, "give the gap, not the distance from tag to tag"),
        ({"gap_mm": -1}, "the gap between tags is -0.001 m"),
        ({"dictionary": "DICT_NO"}, "there are .*DICT_4X4_50"),
        ({"first_id": 585}, "markers 0 to 586"),
    ],
)
def test_an_aprilgrid_that_cannot_be_is_refused(change: dict[str, Any], message: str) -> None:
    table = {"kind": "aprilgrid", "columns": 3, "rows": 2, "tag_mm": 100, "gap_mm": 30}

    with pytest.raises(CalibrationError, match=rf"^\[target\] .*{message}"):
        make_board(table | change)


def test_a_session_describes_each_kind_of_board() -> None:
    size = {"columns": 8, "rows": 6}
    assert make_board({"kind": "chessboard", **size, "square_mm": (115, 114.6)}) == Chessboard(
        8, 6, 0.115, 0.1146
    )
    assert make_board(
        {"kind": "charuco", **size, "square_mm": 100, "marker_mm": 75, "legacy": True}
    ) == Charuco(8, 6, 0.1, 0.075, legacy=True)
    assert make_board(
        {"kind": "aprilgrid", **size, "tag_mm": 88, "gap_mm": 22, "name": "a", "body": "cube"}
    ) == AprilGrid(8, 6, 0.088, 0.022, name="a", body="cube")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"columns": 2}, "at least 3x3 are needed"),
        ({"square_mm": (100, 0)}, "square's side along y is 0.0 m"),
        ({"marker_mm": 100}, "does not fit into a square"),
        ({"dictionary": "DICT_NO"}, "there are .*DICT_4X4_50"),
        ({"dictionary": "DICT_4X4_50", "first_id": 30}, "markers 0 to 49"),
    ],
)
def test_a_charuco_that_cannot_be_is_refused(change: dict[str, Any], message: str) -> None:
    table = {"kind": "charuco", "columns": 8, "rows": 6, "square_mm": 100, "marker_mm": 75}

    with pytest.raises(CalibrationError, match=rf"^\[target\] .*{message}"):
        make_board(table | change)


@pytest.mark.recording
@pytest.mark.parametrize(("name", "least"), [("1/cal1", 86), ("3/cal20", 150)])
def test_a_real_charuco_is_found_in_part(recordings: Path, name: str, least: int) -> None:
    image = cv2.imread(str(recordings / "pycamset" / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE)
    assert image is not None

    detection = Charuco(20, 20, 0.004, 0.0032, "DICT_4X4_1000").detect(image)

    assert detection.corners is not None, detection.how
    assert np.isfinite(detection.corners[:, 0]).sum() >= least  # OpenCV alone finds 86 in the first
    assert "new pattern" in detection.how


@pytest.mark.parametrize(("side_px", "marker_share"), [(60, 0.75), (50, 0.7), (70, 0.5)])
def test_corners_are_where_squares_meet_though_markers_are_printed_off(
    side_px: int, marker_share: float
) -> None:
    board = Charuco(8, 6, 0.08, 0.08 * marker_share, "DICT_4X4_250")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    printed = cv2.aruco.CharucoBoard((8, 6), 0.08, 0.08 * marker_share, dictionary)
    # OpenCV rounds where a marker begins: towards the middle of the board, half a pixel at most.
    sheet = printed.generateImage((8 * side_px, 6 * side_px))
    picture = cv2.GaussianBlur(np.pad(sheet, 100, constant_values=90), (0, 0), 0.7)

    corners = board.detect(picture).corners

    assert corners is not None
    x, y = np.meshgrid(np.arange(1, 8), np.arange(5, 0, -1))
    expected = 100.0 + side_px * np.column_stack([x.ravel(), y.ravel()])
    np.testing.assert_allclose(corners, expected, atol=0.01)
