"""What is to be printed of a board: black rectangles on a white sheet, to scale.

The sheet lies as the board does seen from its printed side: x runs to the right and y up.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board
from hybridve.calib.boards.marker_search import dictionary_of
from hybridve.calib.boards.markers import AprilGrid, Charuco
from hybridve.calib.boards.target import Chessboard

#: Kalibr's tags have a black border of two bits, OpenCV's markers one of one.
_APRIL_BORDER_BITS, _BORDER_BITS = 2, 1


@dataclass(frozen=True, slots=True, eq=False)
class PrintedBoard:
    """A board as it is printed; all lengths in metres, about the board's frame.

    Attributes
    ----------
    low_board, high_board : (2,) float64
        The lower left and the upper right corner of what is printed.
    dark_board : (N, 4) float64
        The black rectangles: x and y of the lower left corner, width and height.
    """

    low_board: NDArray[np.float64]
    high_board: NDArray[np.float64]
    dark_board: NDArray[np.float64]


def printed_board(board: Board) -> PrintedBoard:
    """Return what is to be printed of a board.

    A ChArUco board whose session leaves open which of OpenCV's patterns it has gets the new one.

    Raises
    ------
    TypeError
        If it is of no kind that can be printed.
    """
    if isinstance(board, Chessboard):
        return _chessboard(board)
    if isinstance(board, Charuco):
        return _charuco(board)
    if isinstance(board, AprilGrid):
        return _april_grid(board)
    raise TypeError(f"{board} cannot be printed")


def _chessboard(board: Chessboard) -> PrintedBoard:
    """Return squares, the one before the first corner black."""
    sides = np.array(board.sides_m)
    count = np.array([board.columns + 1, board.rows + 1])
    cells = [(i, j) for j in range(count[1]) for i in range(count[0]) if (i + j) % 2 == 0]
    return _of_cells(cells, [], sides, count)


def _charuco(board: Charuco) -> PrintedBoard:
    sides = np.array(board.sides_m)
    columns, rows = board.columns, board.rows
    white = 0 if board.legacy and rows % 2 == 0 else 1
    # Counted from the top left, as OpenCV numbers the markers.
    squares = [(column, row) for row in range(rows) for column in range(columns)]
    black = [(c, rows - 1 - r) for c, r in squares if (c + r) % 2 != white]
    markers = []
    margin = (sides - board.marker_m * sides / board.square_m) / 2
    for number, (column, row) in enumerate(one for one in squares if sum(one) % 2 == white):
        bits = _bits(board.dictionary, board.first_id + number, _BORDER_BITS)
        corner = np.array([column, rows - 1 - row]) * sides - sides + margin
        markers.append(_rectangles(bits, corner, sides - 2 * margin))
    return _of_cells(black, markers, sides, np.array([columns, rows]))


def _of_cells(
    cells: list[tuple[int, int]],
    more: list[NDArray[np.float64]],
    sides: NDArray[np.float64],
    count: NDArray[np.int64],
) -> PrintedBoard:
    """Return a board of squares whose first inner corner is (0, 0)."""
    corners = np.array(cells) * sides - sides
    dark = np.column_stack([corners, np.broadcast_to(sides, corners.shape)])
    return PrintedBoard(-sides, (count - 1) * sides, np.concatenate([dark, *more]))


def _april_grid(board: AprilGrid) -> PrintedBoard:
    pitch, gap = board.tag_m + board.gap_m, board.gap_m
    dark = []
    for number in range(board.columns * board.rows):
        row, column = divmod(number, board.columns)
        # OpenCV's markers are Kalibr's upside down.
        bits = np.rot90(_bits(board.dictionary, board.first_id + number, _APRIL_BORDER_BITS), 2)
        corner = np.array([column, row]) * pitch
        dark.append(_rectangles(bits, corner, np.full(2, board.tag_m)))
    for row in range(board.rows + 1):
        for column in range(board.columns + 1):
            dark.append(np.array([[column * pitch - gap, row * pitch - gap, gap, gap]]))
    high = np.array([board.columns, board.rows]) * pitch
    return PrintedBoard(np.full(2, -gap), high, np.concatenate(dark))


def _bits(dictionary: str, number: int, border_bits: int) -> NDArray[np.bool_]:
    """Return where a marker is black, the first row at the top."""
    family = dictionary_of(dictionary)
    side = family.markerSize + 2 * border_bits
    drawn = cv2.aruco.generateImageMarker(family, number, side, borderBits=border_bits)
    return np.asarray(drawn == 0)


def _rectangles(
    bits: NDArray[np.bool_], corner: NDArray[np.float64], size: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a rectangle for each black bit of a marker."""
    row, column = np.nonzero(bits)
    n_rows, n_columns = bits.shape
    cell = size / (n_columns, n_rows)
    places = corner + np.column_stack([column, n_rows - 1 - row]) * cell
    return np.column_stack([places, np.broadcast_to(cell, places.shape)])
