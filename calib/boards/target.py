"""Calibration boards, and where their corners lie in an image.

A chessboard lies in the plane z = 0 of the board frame: x runs along its columns, y along its
rows, and z points at whoever looks at its printed side. Corners are therefore listed so that in
an image columns turn *counterclockwise* into rows, whichever way the board is held. (OpenCV lists
them clockwise, which lets z point into the floor.)

A board may look the same after a turn in its plane: by 180 degrees if the numbers of its inner
corners are both even or both odd, by 90 degrees too if they are equal and even. No image of the
board alone tells those turns apart; `Chessboard.looks` lists them. Nor does it tell whether the
image is mirrored: the mirror image of a chessboard is a chessboard.

This work is based on: Geiger, Moosmann, Car and Schuster, *Automatic camera and range sensor
calibration using a single shot*, ICRA 2012 (corners refined by the orthogonality of gradients);
Datta, Kim and Kanade, *Accurate camera calibration using iterative refinement of control points*,
ICCV workshops 2009 (refinement in the frontal view of the board).
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.beyond import lines_beyond
from hybridve.calib.boards.board import Detection as Detection
from hybridve.calib.boards.board import Effort
from hybridve.calib.boards.symmetry import SYMMETRY_BLUR_PX, move_to_symmetry
from hybridve.calib.errors import CalibrationError
from hybridve.calib.pose import Pose

#: The longer side in pixels to which large images are reduced for the first search.
_SEARCH_SIZE_PX = 1000

#: How a board is searched: (stretch in x, stretch in y, method), quick ways first; by how much
#: effort is worth it. The classic method takes 10 ms where there is a board and 50 ms where there
#: is none, the sector method 200 ms. A board on the floor seen at a low angle has squares of a few
#: rows only: stretching the image upright separates them, where enlarging it alike in x and y
#: does not.
_WAYS = {
    "quick": ((1.0, 1.0, "classic"),),
    "usual": (
        (1.0, 1.0, "classic"),
        (1.0, 1.0, "sector"),
        (2.0, 2.0, "classic"),
    ),
    "thorough": (
        (1.0, 1.0, "classic"),
        (1.0, 3.0, "classic"),
        (1.0, 1.0, "sector"),
        (2.0, 2.0, "classic"),
        (1.5, 4.5, "classic"),
        (3.0, 1.0, "classic"),
        (1.0, 3.0, "sector"),
        (1.5, 4.5, "sector"),
        (2.0, 2.0, "sector"),
        (3.0, 1.0, "sector"),
        (3.0, 9.0, "sector"),
    ),
}

#: A square is refined at this many pixels a side, so that one pixel of the image is never spread
#: over less than a pixel of the frontal view (and small squares are not refined on a few pixels).
_CELL_PX = (20.0, 100.0)

#: A corner further than this off the smooth grid through all corners, in squares, is no corner.
_ROUGH_TOLERANCE = 0.25

#: Corners further than this off a plane grid (root mean square, in squares) are listed in another
#: order than the board's; a lens bends a board that fills the image by a third of this.
_BENT_TOLERANCE = 1.0

#: Neighbouring squares differ at least by this many grey levels.
_CONTRAST_GREY = 12.0


@dataclass(frozen=True, slots=True)
class Chessboard:
    """A flat chessboard, counted by the corners inside it.

    Attributes
    ----------
    columns, rows : int
        Inner corners along x and y (a board of 9 by 7 squares has 8 by 6).
    square_m : float
        The side of a square in metres; along x, where the two differ.
    square_y_m : float, optional
        The side along y in metres, of squares that were measured and are not square.
    name : str
        Which of several boards it is.
    body : str, optional
        The rigid body that it is fixed to; boards of one body move as one.

    Raises
    ------
    CalibrationError
        If there are fewer than 3 corners a side, the square has no size, or nothing tells which of
        two different sides runs along x.
    """

    columns: int
    rows: int
    square_m: float
    square_y_m: float | None = None
    name: str = "board"
    body: str | None = None

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise CalibrationError(
                f"a chessboard of {self.columns}x{self.rows} inner corners is too small; at least "
                "3x3 are needed (count the corners inside the board, not the squares)"
            )
        for side_m in self.sides_m:
            if not (np.isfinite(side_m) and side_m > 0):
                raise CalibrationError(f"the chessboard's square is {side_m} m; give its side")
        if self.columns == self.rows and self.columns % 2 == 0 and not self._is_square:
            raise CalibrationError(
                f"squares of {self}: on a board of as many columns as rows, both even, nothing "
                "tells x from y; give one side, their mean"
            )

    @property
    def sides_m(self) -> tuple[float, float]:
        """The sides of a square along x and y, in metres."""
        return self.square_m, self.square_m if self.square_y_m is None else self.square_y_m

    @property
    def _is_square(self) -> bool:
        return self.sides_m[0] == self.sides_m[1]

    @property
    def points_board(self) -> NDArray[np.float64]:
        """The corners, (N, 3) metres, row-major from (0, 0, 0)."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        corners = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
        return np.asarray(corners * (*self.sides_m, 0.0), np.float64)

    @property
    def center_board(self) -> NDArray[np.float64]:
        """The middle of the board: (3,) metres."""
        return np.array([(self.columns - 1) / 2, (self.rows - 1) / 2, 0.0]) * (*self.sides_m, 0.0)

    @property
    def looks(self) -> NDArray[np.intp]:
        """The listings of the corners that no image can tell apart: (L, N) indices.

        ``corners[looks[k]]`` is as good a listing as ``corners``; it belongs to a board turned by
        ``k / L`` of a full turn about its middle. The first is the identity.
        """
        grid = np.arange(self.columns * self.rows).reshape(self.rows, self.columns)
        quarter_turns: tuple[int, ...] = (0,)
        if (self.columns + self.rows) % 2 == 0:
            quarter_turns = (0, 2)
            if self.columns == self.rows and self.columns % 2 == 0:
                quarter_turns = (0, 1, 2, 3)
        return np.array([np.rot90(grid, turns).ravel() for turns in quarter_turns], dtype=np.intp)

    def board_from_turned(self, look: int) -> Pose:
        """Return the motion (3, 4) that maps ``points_board`` onto ``points_board[looks[look]]``.

        Where ``corners`` place the board at ``cam_from_board``, ``corners[looks[look]]`` place it
        at ``cam_from_board`` after this motion.
        """
        angle = 2.0 * np.pi * look / len(self.looks)
        cosine, sine = np.round(np.cos(angle)), np.round(np.sin(angle))
        rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        return np.column_stack([rotation, self.center_board - rotation @ self.center_board])

    def detect(self, image: NDArray[Any], effort: Effort = "thorough") -> Detection:
        """Find the board, all of it, in an image; see `detect_corners`."""
        return detect_corners(image, self, effort)

    def __str__(self) -> str:
        sides = f"{self.sides_m[0] * 1000:g}"
        if not self._is_square:
            sides += f" by {self.sides_m[1] * 1000:g}"
        return f"{self.columns}x{self.rows} inner corners, {sides} mm squares"


def find_corners(image: NDArray[Any], board: Chessboard) -> NDArray[np.float64] | None:
    """Return the board's inner corners in an image, or None.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) uint8 or float32
        Grey or BGR, 0 to 255.
    board : Chessboard
        The board to look for; all of it must be in view.

    Returns
    -------
    corners : (N, 2) float64, or None
        Pixels, pixel centre at 0.5, in the order of ``board.points_board``: seen from the printed
        side, columns turn counterclockwise into rows. Where colours tell the ends of the board
        apart, the square before the first corner is black; where they do not, columns run as far
        to the right as they can.
    """
    return detect_corners(image, board).corners


def detect_corners(
    image: NDArray[Any],
    board: Chessboard,
    effort: Effort = "thorough",
) -> Detection:
    """Find the board's inner corners, and say how; see `find_corners`.

    A thorough search also stretches the image, which finds small boards seen at a low angle, and
    takes a second or two where there is none; the usual one takes a third of a second.
    """
    grey = grey_of(image)
    eight_bit = np.clip(np.round(grey), 0, 255).astype(np.uint8)
    reduction = min(1.0, _SEARCH_SIZE_PX / max(grey.shape))
    tried = []
    for stretch_x, stretch_y, method in _WAYS[effort]:
        scale_x, scale_y = reduction * stretch_x, reduction * stretch_y
        if (scale_x, scale_y) == (1.0, 1.0):
            search = eight_bit
        else:
            interpolation = cv2.INTER_AREA if max(scale_x, scale_y) < 1 else cv2.INTER_CUBIC
            search = np.asarray(
                cv2.resize(eight_bit, None, fx=scale_x, fy=scale_y, interpolation=interpolation),
                np.uint8,
            )
        way = f"{method} at {scale_x:.3g}x{scale_y:.3g}"
        tried.append(way)
        found = _search(search, board, method)
        if found is None:
            continue
        # Pixel centres at 0.5 scale without an offset, whatever the stretch.
        exact = np.array([search.shape[1] / grey.shape[1], search.shape[0] / grey.shape[0]])
        corners = refine_corners(grey, board, (found + 0.5) / exact)
        if corners is not None:
            grid = corners.reshape(board.rows, board.columns, 2)
            return Detection(corners, way, beyond=lines_beyond(grey, grid))
    return Detection(None, "tried " + ", ".join(tried))


def _search(image: NDArray[np.uint8], board: Chessboard, method: str) -> NDArray[np.float64] | None:
    """Return corners (N, 2) in OpenCV's convention, in no particular sense of order, or None."""
    size = (board.columns, board.rows)
    if min(image.shape) < 4 * max(size):  # OpenCV asserts on images of a few pixels
        return None
    if method == "classic":
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(image, size, flags=flags)
    else:
        found, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_EXHAUSTIVE)
    if not found:
        return None
    return np.asarray(corners, dtype=np.float64).reshape(-1, 2)


def grey_of(image: NDArray[Any]) -> NDArray[np.float32]:
    """Return an image as (H, W) float32 grey levels."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    return np.asarray(grey, dtype=np.float32)


def refine_corners(
    image: NDArray[Any], board: Chessboard, corners: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Move roughly known corners onto the image, and list them in the board's order.

    The board is warped to its frontal view, where squares are squares, and each corner is refined
    there: in an oblique image no square window fits between neighbouring corners.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) uint8 or float32
        Grey or BGR, 0 to 255.
    board : Chessboard
        The board.
    corners : (N, 2) float64
        Corners within a third of a square of the truth, pixel centre at 0.5, row by row or column
        by column from any end.

    Returns
    -------
    corners : (N, 2) float64, or None
        In the order of `find_corners`; None if there is no chessboard at this place.
    """
    grey = grey_of(image)
    listed = list_corners(board, corners)
    if listed is None:
        return None
    refined = _refine(grey, board, listed)
    if refined is None:
        return None
    return _list_by_colour(grey, board, refined)


def list_corners(board: Chessboard, corners: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return corners row by row, counterclockwise; None if they are not a grid of this board.

    Column-major and clockwise listings are turned into row-major ones. Which end the list starts
    from is kept as far as the sense allows: rows of a clockwise listing are reversed.
    """
    columns, rows = board.columns, board.rows
    if corners.shape != (columns * rows, 2) or not np.isfinite(corners).all():
        return None
    by_row = corners.reshape(rows, columns, 2)
    by_column = corners.reshape(columns, rows, 2).transpose(1, 0, 2)
    grid = min(by_row, by_column, key=lambda listed: _grid_error(board, listed.reshape(-1, 2)))
    if not _grid_error(board, grid.reshape(-1, 2)) < _BENT_TOLERANCE:
        return None
    along_columns = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0)
    along_rows = grid[-1].mean(axis=0) - grid[0].mean(axis=0)
    if along_columns[0] * along_rows[1] - along_columns[1] * along_rows[0] > 0:
        grid = grid[::-1]  # clockwise in an image, whose y runs down: OpenCV's sense
    return np.ascontiguousarray(grid.reshape(-1, 2))


def _ideal(board: Chessboard) -> NDArray[np.float64]:
    """Return the corners on a grid of unit squares, (N, 2)."""
    return board.points_board[:, :2] / board.sides_m


def _grid_error(board: Chessboard, corners: NDArray[np.float64]) -> float:
    """Return how far corners are from a plane grid, in squares (root mean square; inf: none)."""
    squares = _in_squares(board, corners)
    if squares is None:
        return np.inf
    return float(np.sqrt(((squares - _ideal(board)) ** 2).sum(axis=1).mean()))


def _roughness(board: Chessboard, corners: NDArray[np.float64]) -> float:
    """Return how far the worst corner is from a smooth grid, in squares; inf if there is none."""
    squares = _in_squares(board, corners)
    if squares is None or not _grid_error(board, corners) < _BENT_TOLERANCE:
        return np.inf
    return float(np.linalg.norm(squares - _smooth(board, squares), axis=1).max())


def fit_homography(
    source: NDArray[np.float64], target: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return the homography (3, 3) that maps points (N, 2) best; None if there is none."""
    try:
        found, _ = cv2.findHomography(source, target)
    except cv2.error:
        return None
    matrix = np.asarray(found, np.float64)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or not np.linalg.det(matrix):
        return None
    return matrix


def _in_squares(board: Chessboard, corners: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Map corners to the board's plane by the best homography, in squares."""
    matrix = fit_homography(corners, _ideal(board))
    if matrix is None:
        return None
    depths = corners @ matrix[2, :2] + matrix[2, 2]
    if (depths == 0).any() or np.ptp(np.sign(depths)):
        return None  # a vanishing line between the corners
    return _mapped(matrix, corners)


def _mapped(matrix: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Map points (N, 2) by a homography (3, 3)."""
    mapped = points @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:], np.float64)


def _smooth(board: Chessboard, squares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cubic grid through corners: bent as a lens bends a board, without noise.

    Boards of three corners a side allow a quadratic grid only.
    """
    x, y = _ideal(board).T
    degree = 3 if min(board.columns, board.rows) > 3 else 2
    basis = np.column_stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)])
    coefficients, *_ = np.linalg.lstsq(basis, squares, rcond=None)
    return np.asarray(basis @ coefficients)


def _frontal(
    grey: NDArray[np.float32], board: Chessboard, corners: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float64], float] | None:
    """Warp the board to its frontal view, two squares around the corners.

    Returns the view, continued outside the image, the homography img_from_view (both with pixel
    centres at 0, for OpenCV), and the side of a square in pixels of the view.
    """
    grid = corners.reshape(board.rows, board.columns, 2)
    sides = np.concatenate(
        [
            np.linalg.norm(np.diff(grid, axis=0), axis=-1).ravel(),
            np.linalg.norm(np.diff(grid, axis=1), axis=-1).ravel(),
        ]
    )
    cell = float(np.clip(np.ceil(1.2 * sides.max()), *_CELL_PX))
    view = (_ideal(board) + 2.0) * cell
    img_from_view = fit_homography(view, corners - 0.5)
    if img_from_view is None:
        return None
    size = (int((board.columns + 3) * cell), int((board.rows + 3) * cell))
    warped = cv2.warpPerspective(
        grey,
        img_from_view,
        size,
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(warped, np.float32), img_from_view, cell


def _refine(
    grey: NDArray[np.float32], board: Chessboard, corners: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    # Corners that were clicked or found on the wrong pixel are first drawn onto the smooth grid
    # through all of them, so that each starts nearer to its place than to the middle of a square,
    # which has the same symmetry. At first blur widens the slopes that show the way.
    for may_be_rough, blur in ((True, 0.15), (True, 0.0), (False, 0.0)):
        frontal = _frontal(grey, board, corners)
        if frontal is None:
            return None
        view, img_from_view, cell = frontal
        view_from_img = np.asarray(np.linalg.inv(img_from_view), np.float64)
        start = _mapped(view_from_img, corners - 0.5)
        if may_be_rough:
            start = _smooth(board, start / cell) * cell
        height, width = view.shape
        if (start < 2).any() or (start > (width - 3, height - 3)).any():
            return None
        moved = move_to_symmetry(view, start, cell, max(blur * cell, SYMMETRY_BLUR_PX))
        corners = _mapped(img_from_view, moved) + 0.5
    return corners if _roughness(board, corners) < _ROUGH_TOLERANCE else None


def _list_by_colour(
    grey: NDArray[np.float32], board: Chessboard, corners: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Choose where the list starts; None where black and white squares do not alternate."""
    frontal = _frontal(grey, board, corners)
    if frontal is None:
        return None
    view, _, cell = frontal
    reach = max(1, int(0.2 * cell))  # the mean over the middle of each square between corners
    means = cv2.blur(view, (2 * reach + 1, 2 * reach + 1))
    columns = np.round((np.arange(board.columns - 1) + 2.5) * cell).astype(int)
    rows = np.round((np.arange(board.rows - 1) + 2.5) * cell).astype(int)
    squares = means[np.ix_(rows, columns)].astype(np.float64)
    # Neighbours are compared, not all squares: light may change over the board.
    sign = np.where(np.indices(squares.shape).sum(axis=0) % 2 == 0, 1.0, -1.0)
    steps = sign[:, :-1] * (squares[:, :-1] - squares[:, 1:])  # positive: white first
    step = float(np.median(steps))
    if abs(step) < _CONTRAST_GREY or (steps * np.sign(step) < 0.2 * abs(step)).any():
        return None

    colours_decide = len(board.looks) < (4 if board.columns == board.rows else 2)
    candidates = []
    for turn in (0, 1, 2, 3) if board.columns == board.rows else (0, 2):
        turned = np.rot90(corners.reshape(board.rows, board.columns, 2), turn)
        starts_black = bool(np.rot90(sign, turn)[0, 0] * step < 0)
        rightwards = turned[:, -1].mean(axis=0) - turned[:, 0].mean(axis=0)
        candidates.append((starts_black and colours_decide, rightwards[0], -turn, turned))
    best = max(candidates, key=lambda candidate: candidate[:3])[3]
    return np.ascontiguousarray(best.reshape(-1, 2))
