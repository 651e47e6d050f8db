"""Boards: how they look the same when turned, and where their corners are found."""

from pathlib import Path

import numpy as np
import pytest
from helpers.boards import look_at, make_camera, project, render_board
from numpy.typing import NDArray

from hybridve.calib.boards.corner_files import read_corners
from hybridve.calib.boards.target import (
    Chessboard,
    detect_corners,
    find_corners,
    list_corners,
    refine_corners,
)
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.pose import transform
from hybridve.calib.solving.locate import locate_board

#: What 16 rays a pixel and 256 grey levels leave of a corner's place; half a pixel is far more.
RENDERED_RMS_PX = 0.03
RENDERED_BIAS_PX = 0.01

#: Squares of 10 by 3 pixels.
OBLIQUE_RMS_PX = 0.06

#: Two starts end at one place.
SAME_CORNER_PX = 1e-2

BOARD = Chessboard(8, 6, 0.1)


def camera_at(center: tuple[float, float, float], size_px: tuple[int, int] = (480, 360)) -> Camera:
    x, y, _ = BOARD.center_board
    return make_camera("cam", "PINHOLE", look_at(center, (x, y, 0.0)), size_px)


@pytest.fixture(scope="module")
def near() -> tuple[Camera, NDArray[np.uint8]]:
    camera = camera_at((0.6, -0.5, 1.0))
    return camera, render_board(camera, BOARD)


def by_any_look(board: Chessboard, corners: NDArray[np.float64]) -> NDArray[np.float64]:
    return corners[board.looks]  # (L, N, 2)


def test_points_lie_row_by_row_in_the_plane() -> None:
    points = Chessboard(4, 3, 0.5).points_board

    np.testing.assert_array_equal(points[[0, 1, 4]], [[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]])
    np.testing.assert_array_equal(points[-1], [1.5, 1.0, 0.0])


@pytest.mark.parametrize(("columns", "rows"), [(2, 6), (6, 2)])
def test_a_board_of_two_corners_a_side_is_refused(columns: int, rows: int) -> None:
    with pytest.raises(CalibrationError, match="count the corners inside the board"):
        Chessboard(columns, rows, 0.1)


@pytest.mark.parametrize("square_m", [0.0, -1.0, np.nan])
def test_a_square_without_size_is_refused(square_m: float) -> None:
    with pytest.raises(CalibrationError, match="give its side"):
        Chessboard(8, 6, square_m)


@pytest.mark.parametrize(
    ("columns", "rows", "count"), [(8, 6, 2), (9, 6, 1), (7, 5, 2), (7, 7, 2), (6, 6, 4)]
)
def test_a_board_looks_the_same_as_often_as_its_colours_allow(
    columns: int, rows: int, count: int
) -> None:
    board = Chessboard(columns, rows, 0.1)
    # Squares inside and around the corners, by the corners that enclose them.
    x, y = np.meshgrid(np.arange(-1, columns), np.arange(-1, rows))
    middles = np.column_stack([x.ravel() + 0.5, y.ravel() + 0.5, np.zeros(x.size)]) * 0.1
    colours = ((x + y) % 2).ravel()

    looks = board.looks

    assert len(looks) == count
    for look in range(count):
        turned = transform(board.board_from_turned(look), middles)
        nearest = np.argmin(np.linalg.norm(turned[:, None] - middles[None], axis=-1), axis=1)
        np.testing.assert_allclose(middles[nearest], turned, atol=1e-12)
        np.testing.assert_array_equal(colours[nearest], colours)


@pytest.mark.parametrize("board", [Chessboard(8, 6, 0.1), Chessboard(6, 6, 0.2)])
def test_a_turned_listing_belongs_to_a_turned_board(board: Chessboard) -> None:
    for look, listing in enumerate(board.looks):
        np.testing.assert_allclose(
            transform(board.board_from_turned(look), board.points_board),
            board.points_board[listing],
            atol=1e-12,
        )


@pytest.mark.slow
def test_corners_are_found_where_they_are_with_pixel_centres_at_a_half(
    near: tuple[Camera, NDArray[np.uint8]],
) -> None:
    camera, image = near
    expected = project(camera, camera.cam_from_world, BOARD)

    corners = find_corners(image, BOARD)

    assert corners is not None
    errors = min((look - expected for look in by_any_look(BOARD, corners)), key=np.linalg.norm)
    assert np.sqrt((errors**2).sum(axis=1).mean()) < RENDERED_RMS_PX
    assert np.abs(errors.mean(axis=0)).max() < RENDERED_BIAS_PX


@pytest.mark.slow
def test_a_small_board_at_a_low_angle_is_found() -> None:
    camera = camera_at((3.3, -2.6, 1.4), (644, 486))
    expected = project(camera, camera.cam_from_world, BOARD)
    rows = expected.reshape(6, 8, 2)
    assert np.abs(rows[1:] - rows[:-1])[..., 1].max() < 4.0, "the board is not seen obliquely"
    image = render_board(camera, BOARD, samples=4, noise_grey=1.0)

    detection = detect_corners(image, BOARD)

    assert detection.corners is not None, detection.how
    errors = min(
        (look - expected for look in by_any_look(BOARD, detection.corners)), key=np.linalg.norm
    )
    assert np.sqrt((errors**2).sum(axis=1).mean()) < OBLIQUE_RMS_PX


def test_a_camera_over_the_printed_side_sees_the_board_from_above(
    near: tuple[Camera, NDArray[np.uint8]],
) -> None:
    camera, image = near
    corners = find_corners(image, BOARD)
    assert corners is not None

    located = locate_board(camera, BOARD.points_board, corners)

    assert located is not None
    center_board = -located[0][:, :3].T @ located[0][:, 3]
    assert center_board[2] > 0


@pytest.mark.slow
@pytest.mark.parametrize("starts_black", [True, False])
def test_colours_tell_the_ends_of_an_odd_board_apart(starts_black: bool) -> None:
    board = Chessboard(7, 6, 0.1)
    camera = camera_at((0.5, -0.4, 1.0))
    expected = project(camera, camera.cam_from_world, board)
    if not starts_black:
        expected = expected[::-1]  # then the square at the other end is the black one

    corners = find_corners(render_board(camera, board, starts_black=starts_black), board)

    assert corners is not None
    assert np.abs(corners - expected).max() < 5 * RENDERED_RMS_PX


def test_a_board_upside_down_is_listed_as_it_runs_to_the_right() -> None:
    camera = camera_at((0.35, 1.3, 1.0))  # from behind the board: its rows run downwards
    corners = find_corners(render_board(camera, BOARD, samples=2), BOARD)

    assert corners is not None
    grid = corners.reshape(6, 8, 2)
    assert (grid[:, -1, 0] > grid[:, 0, 0]).all()
    assert (grid[-1, :, 1] < grid[0, :, 1]).all()


def test_roughly_marked_corners_end_where_found_ones_do(
    near: tuple[Camera, NDArray[np.uint8]],
) -> None:
    _, image = near
    found = find_corners(image, BOARD)
    assert found is not None
    side_px = np.linalg.norm(found[1] - found[0])
    clicked = found + np.random.default_rng(0).uniform(-0.15, 0.15, found.shape) * side_px

    refined = refine_corners(image, BOARD, np.round(clicked))

    assert refined is not None
    assert np.abs(refined - found).max() < SAME_CORNER_PX


def test_corners_marked_beside_the_board_are_refused(
    near: tuple[Camera, NDArray[np.uint8]],
) -> None:
    camera, image = near
    expected = project(camera, camera.cam_from_world, BOARD)

    assert refine_corners(image, BOARD, expected + np.array([0.0, 150.0])) is None
    assert refine_corners(image, BOARD, expected * 0.5) is None


def test_glare_on_one_corner_moves_no_other(near: tuple[Camera, NDArray[np.uint8]]) -> None:
    camera, image = near
    expected = project(camera, camera.cam_from_world, BOARD)
    column, row = expected[20].astype(int)
    spoilt = image.copy()
    spoilt[row : row + 6, column : column + 6] = 255

    corners = refine_corners(spoilt, BOARD, expected)

    assert corners is not None
    errors = min((look - expected for look in by_any_look(BOARD, corners)), key=np.linalg.norm)
    others = np.arange(len(errors)) != 20
    assert np.sqrt((errors[others] ** 2).sum(axis=1).mean()) < RENDERED_RMS_PX


def test_every_way_of_marking_gives_the_same_listing() -> None:
    grid = np.stack(np.meshgrid(np.arange(8.0), np.arange(6.0)), axis=-1) * 10 + 50
    clockwise = grid.reshape(-1, 2)
    counterclockwise = grid[::-1].reshape(-1, 2)

    for marked in (clockwise, counterclockwise, grid.transpose(1, 0, 2).reshape(-1, 2)):
        listed = list_corners(BOARD, marked)

        assert listed is not None
        rows = listed.reshape(6, 8, 2)
        along, across = rows[0, 1] - rows[0, 0], rows[1, 0] - rows[0, 0]
        assert along[0] * across[1] - along[1] * across[0] < 0
        assert sorted(map(tuple, listed)) == sorted(map(tuple, clockwise))
        assert np.abs(along).max() == 10.0, "a row holds neighbours"


def test_points_in_no_order_are_no_board() -> None:
    grid = np.stack(np.meshgrid(np.arange(8.0), np.arange(6.0)), axis=-1).reshape(-1, 2)

    assert list_corners(BOARD, np.random.default_rng(1).permutation(grid) * 10) is None
    assert list_corners(BOARD, grid[:-1]) is None
    assert list_corners(BOARD, np.full_like(grid, np.nan)) is None


@pytest.mark.parametrize("shape", [(1, 1), (20, 30), (240, 320, 3)])
def test_a_picture_without_a_board_gives_none_and_says_what_was_tried(
    shape: tuple[int, ...],
) -> None:
    image = np.random.default_rng(2).integers(0, 255, shape, dtype=np.uint8)

    detection = detect_corners(image, BOARD, "usual")

    assert detection.corners is None
    assert detection.how.startswith("tried classic")


@pytest.mark.slow
def test_another_board_is_not_taken_for_this_one(near: tuple[Camera, NDArray[np.uint8]]) -> None:
    _, image = near

    assert find_corners(image, Chessboard(8, 9, 0.1)) is None


@pytest.mark.recording
def test_corners_marked_by_hand_are_read_in_both_spellings(recordings: Path) -> None:
    folder = recordings / "horseman" / "cam1"

    first = read_corners(folder / "board_corners_a.xml")
    second = read_corners(folder / "board_corners_b.xml")

    assert first.shape == second.shape == (48, 2)
    np.testing.assert_array_equal(first[0], [313.5, 317.5])  # written as (313, 317)
    np.testing.assert_array_equal(second[0], [357.5, 302.5])
    listed = list_corners(BOARD, second)
    assert listed is not None
    assert np.abs(first - listed).max() < 4.0  # two people, the same board


@pytest.mark.parametrize(
    "text", ["x,y\n1.5,2\n3,4\n", "1.5,2\n3,4\n", "# marked\nname,y,x\n0,2,1.5\n0,4,3\n"]
)
def test_corners_are_read_from_csv(tmp_path: Path, text: str) -> None:
    (tmp_path / "corners.csv").write_text(text)

    corners = read_corners(tmp_path / "corners.csv")

    np.testing.assert_array_equal(corners, [[2.0, 2.5], [3.5, 4.5]])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("corners.csv", "a,b\n1,2\n"),
        ("corners.csv", ""),
        ("corners.xml", "not xml"),
        ("corners.xml", '<?xml version="1.0"?><opencv_storage><other>1</other></opencv_storage>'),
    ],
)
def test_a_file_without_corners_is_named(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)

    with pytest.raises(CalibrationError, match=rf"{name}: no corners found"):
        read_corners(tmp_path / name)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("x,y\n1\n", "line 2: 1 cells, expected 2: x, y"),
        ("x,y\n1,2\n\n3,four\n", "line 4: x = '3', y = 'four' is no place"),
        ("x,y\n1,nan\n", "line 2: x = '1', y = 'nan' is no place"),
        ("0,1.5,2\n1,3,4\n", "line 1: 3 cells, expected 2: x, y"),  # the first is no x
        ("x;y\n1,5;2,5\n", "line 1: 'x;y' has no comma; separate columns by commas"),
        ("id,x,y\n0,1,2\n", "a column 'id', which would be passed over; call it 'corner'"),
        ("filename,x,y\na.png,1,2\n", "a column 'filename'.* call it 'image'"),
        ("x,y,x\n1,2,3\n", "has the columns x, y, x; expected x and y"),
    ],
)
def test_a_csv_that_would_be_misread_is_refused_with_its_place(
    tmp_path: Path, text: str, found: str
) -> None:
    (tmp_path / "corners.csv").write_text(text)

    with pytest.raises(CalibrationError, match=rf"corners\.csv[:,] .*{found}"):
        read_corners(tmp_path / "corners.csv")


def test_a_csv_as_spreadsheets_write_it_is_read(tmp_path: Path) -> None:
    (tmp_path / "corners.csv").write_bytes("\ufeffX, Y\r\n1.5, 2\r\n3, 4\r\n,\r\n".encode())

    np.testing.assert_array_equal(read_corners(tmp_path / "corners.csv"), [[2.0, 2.5], [3.5, 4.5]])


def test_a_missing_corners_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="no such corners file"):
        read_corners(tmp_path / "corners.xml")


def test_measured_sides_of_squares_place_the_corners() -> None:
    board = Chessboard(8, 6, 0.115, 0.1146)

    np.testing.assert_allclose(board.points_board[[1, 8]], [[0.115, 0, 0], [0, 0.1146, 0]])
    assert str(board) == "8x6 inner corners, 115 by 114.6 mm squares"
    for look, listing in enumerate(board.looks):
        np.testing.assert_allclose(
            transform(board.board_from_turned(look), board.points_board),
            board.points_board[listing],
            atol=1e-12,
        )


def test_a_board_whose_two_sides_nothing_tells_apart_is_refused() -> None:
    assert len(Chessboard(7, 7, 0.1, 0.11).looks) == 2
    with pytest.raises(CalibrationError, match="nothing tells x from y"):
        Chessboard(6, 6, 0.1, 0.11)
