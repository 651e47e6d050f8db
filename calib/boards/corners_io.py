"""Points of boards that were found by something else, read from files.

A CSV with a header may say of each point in which image it lies: ``image`` (a file's name, with
as much of its folders as makes it unique; "frame 3" of stills that are a video) or ``frame`` (of
the extrinsic clip, from 0); to which ``board`` it belongs, by name; and which ``corner`` of that
board it is, from 0, in the order of `Board.points_board`. Corners that are not named were not
seen. Those of a ChArUco board may be numbered as OpenCV does, from the top left. Without
``corner``, all of a board's points are expected in their order. Files of OpenCV, and CSV files that
name no image, hold the points of one board in the extrinsic clip, see `read_corners`.

All of them are understood as OpenCV counts: the centre of the top-left pixel is at (0, 0).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board
from hybridve.calib.boards.corner_files import columns_of, csv_lines, read_corners
from hybridve.calib.boards.markers import Charuco
from hybridve.calib.boards.target import Chessboard, fit_homography, list_corners
from hybridve.calib.errors import CalibrationError


@dataclass(frozen=True, slots=True, eq=False)
class GivenCorners:
    """The points of one board in one image, as a file gives them.

    Attributes
    ----------
    image : str, int or None
        A file's name, a frame of the extrinsic clip, or None: the clip as a whole.
    board : int
        Which of the boards.
    pixels : (N, 2) float64
        Its points in pixels, pixel centre at 0.5, NaN where one is not given.
    """

    image: str | int | None
    board: int
    pixels: NDArray[np.float64]


def read_given(path: Path, boards: Sequence[Board]) -> list[GivenCorners]:
    """Return the points that a file gives.

    Raises
    ------
    CalibrationError
        Naming the file, and the line where there is one: no such file, no points in it, another
        number of points than the board has, an unknown board, a corner that is given twice or
        does not exist, or no grid where a chessboard's corners are not numbered.
    """
    names = [getattr(board, "name", "board") for board in boards]
    rows = _rows_of_table(path)
    if rows is None:
        corners = read_corners(path)
        fitting = [i for i, board in enumerate(boards) if len(board.points_board) == len(corners)]
        if len(fitting) != 1:
            raise CalibrationError(
                f"{path}: {len(corners)} corners, expected {_counts(boards)}"
                f"{_likely(boards, len(corners))}"
            )
        return [GivenCorners(None, fitting[0], _in_order(boards[fitting[0]], corners, str(path)))]

    groups: dict[tuple[str | int | None, int], list[tuple[int | None, float, float]]] = {}
    for line, row in rows:
        place = f"{path}, line {line}"
        image: str | int | None = row.get("image") or None
        if row.get("frame"):
            if image is not None:
                raise CalibrationError(f"{place}: names an image and a frame; name one of them")
            image = _whole(row["frame"], "frame", place)
        index = 0
        if row.get("board"):
            if row["board"] not in names:
                raise CalibrationError(
                    f"{place}: there is no board {row['board']!r}; one of {', '.join(names)}"
                )
            index = names.index(row["board"])
        elif len(boards) > 1:
            raise CalibrationError(
                f"{place}: which of the boards is it? give a column board with one of "
                f"{', '.join(names)}"
            )
        corner = _whole(row["corner"], "corner", place) if row.get("corner") else None
        try:
            x, y = float(row["x"]), float(row["y"])
        except ValueError:
            x = y = np.nan
        if not np.isfinite([x, y]).all():
            raise CalibrationError(f"{place}: x = {row['x']!r}, y = {row['y']!r} is no place")
        groups.setdefault((image, index), []).append((corner, x, y))
    if not groups:
        raise CalibrationError(f"{path}: no corners found; expected lines below the header")
    return [
        GivenCorners(image, index, _assemble(boards[index], found, _place(path, image)))
        for (image, index), found in groups.items()
    ]


def _place(path: Path, image: str | int | None) -> str:
    return f"{path}" if image is None else f"{path}: image {image}"


def _rows_of_table(path: Path) -> list[tuple[int, dict[str, str]]] | None:
    """Return lines with their numbers; None if the file says no more than x and y."""
    if path.suffix.lower() not in {".csv", ".txt"} or not path.is_file():
        return None
    lines = csv_lines(path)
    header = [cell.lower() for cell in lines[0][1]] if lines else []
    if not {"image", "frame", "board", "corner"} & set(header):
        return None
    columns_of(path, header)
    for number, line in lines[1:]:
        if len(line) != len(header):
            raise CalibrationError(
                f"{path}, line {number}: {len(line)} cells, the header has {len(header)}"
            )
    return [(number, dict(zip(header, line, strict=True))) for number, line in lines[1:]]


def _whole(text: str, column: str, place: str) -> int:
    if not text.isdecimal():
        raise CalibrationError(f"{place}: {column} {text!r}; expected a whole number from 0")
    return int(text)


def _counts(boards: Sequence[Board]) -> str:
    return " or ".join(f"{len(board.points_board)} ({board})" for board in boards)


def _likely(boards: Sequence[Board], count: int) -> str:
    """Return which board of about the described size has so many corners; nothing if unclear."""
    if len(boards) != 1 or not isinstance(boards[0], Chessboard):
        return ""
    board = boards[0]
    fitting = [
        (columns, rows)
        for columns in range(board.columns - 1, board.columns + 2)
        for rows in range(board.rows - 1, board.rows + 2)
        if columns * rows == count
    ]
    if len(fitting) != 1:
        return ""
    columns, rows = fitting[0]
    return f"; a board of {columns} x {rows} inner corners has {count}: check columns and rows"


def _assemble(
    board: Board, found: list[tuple[int | None, float, float]], place: str
) -> NDArray[np.float64]:
    """Put points where they belong; NaN for those that are not given."""
    count = len(board.points_board)
    corners = [corner for corner, _, _ in found]
    points = np.array([(x, y) for _, x, y in found]) + 0.5
    if None in corners:
        if any(corner is not None for corner in corners):
            raise CalibrationError(f"{place}: some corners are numbered and some are not")
        if len(points) != count:
            raise CalibrationError(f"{place}: {len(points)} corners, expected {_counts([board])}")
        return _in_order(board, points, place)
    pixels = np.full((count, 2), np.nan)
    for corner, point in zip(corners, points, strict=True):
        if corner is None or corner >= count:
            raise CalibrationError(f"{place}: corner {corner}; {board} has 0 to {count - 1}")
        if np.isfinite(pixels[corner]).all():
            raise CalibrationError(f"{place}: corner {corner} is given twice")
        pixels[corner] = point
    return _from_bottom_left(board, pixels) if isinstance(board, Charuco) else pixels


def _in_order(board: Board, corners: NDArray[np.float64], place: str) -> NDArray[np.float64]:
    if isinstance(board, Charuco):
        return _from_bottom_left(board, corners)
    if not isinstance(board, Chessboard):
        return corners
    listed = list_corners(board, corners)
    if listed is None:
        raise CalibrationError(
            f"{place}: the corners do not form the board's grid; expected row by row, "
            f"{board.columns} a row"
        )
    return listed


def _from_bottom_left(board: Charuco, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return corners (N, 2) as we number them, of those numbered so or as OpenCV does.

    From the bottom left columns turn counterclockwise into rows in a picture, from OpenCV's top
    left clockwise. (So they do, numbered as ours, on a sheet that is seen from its back; the search
    finds such sheets, and files of them are not known.)
    """
    seen = np.isfinite(pixels[:, 0])
    if seen.sum() < 4:
        return pixels
    points = board.points_board[seen][:, :2] / board.sides_m
    img_from_board = fit_homography(points, pixels[seen])
    if img_from_board is None:
        return pixels
    # How the map turns near the middle: its derivative's determinant has this sign.
    depth = float(img_from_board[2] @ np.append(points.mean(axis=0), 1.0))
    if float(np.linalg.det(img_from_board)) * depth < 0:
        return pixels  # y runs down in a picture: counterclockwise
    rows = pixels.reshape(board.rows - 1, board.columns - 1, 2)
    return np.ascontiguousarray(rows[::-1].reshape(-1, 2))
