"""Boards of coded markers: ChArUco boards and Kalibr's AprilGrids, which may be seen in part.

The frame of such a board is that of a chessboard: seen from the printed side x runs to the right, y
runs up, and z points at the viewer; points are listed from the bottom left.

Markers are read by OpenCV, and believed where neighbours lie as on the board: a misread one does
not. They only say roughly where the points are. Each point is then refined in its own frontal
view, as the corners of a chessboard are, from as much of the pattern around it as is symmetric;
points whose markers could not be read follow from their neighbours. A point counts if its
surroundings look as printed and it fits its neighbours.

This work is based on: Garrido-Jurado, Muñoz-Salinas, Madrid-Cuevas and Marín-Jiménez, *Automatic
generation and detection of highly reliable fiducial markers under occlusion*, Pattern Recognition
2014; Maye, Furgale and Siegwart, *Self-supervised calibration for robotic systems*, IV 2013
(Kalibr, the AprilGrid).
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Detection, Effort
from hybridve.calib.boards.marker_search import detect_pattern, dictionary_of
from hybridve.calib.boards.pattern import Pattern, around
from hybridve.calib.boards.symmetry import SYMMETRY_REACH
from hybridve.calib.errors import CalibrationError
from hybridve.calib.pose import Pose

#: Rows of markers that are looked for above the first and below the last.
_ROWS_BEYOND = 2

#: The dictionaries of markers, by OpenCV's names.
DICTIONARIES = tuple(
    sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_") and not name.endswith("H"))
)


#: Of a ChArUco board only what is farther than this from a marker says where a corner is, in
#: squares: markers are printed off by half a pixel of the printed picture here and there, and blur
#: brings that nearer. What is on the lines between squares says it always.
_MARKER_BLUR, _ON_THE_LINE = 0.08, 0.02


@dataclass(frozen=True, slots=True)
class Charuco:
    """A chessboard with a marker in each white square; its points are the inner corners.

    Points are listed row by row from the bottom left, with marker 0 at the top. (OpenCV lists them
    from the top left, and lets y run down and z away from the viewer.)

    Attributes
    ----------
    columns, rows : int
        Squares along x and y.
    square_m, marker_m : float
        Their sides in metres, and those of the markers.
    dictionary : str
        The markers' dictionary, by OpenCV's name.
    legacy : bool, optional
        Whether the pattern is the one of OpenCV before 4.6, which starts with a marker in the
        corner if the rows are even; None: found out.
    first_id : int
        The number of the first marker; boards of one dictionary are told apart by it.
    square_y_m : float, optional
        The side of a square along y, of boards that were measured and are not square.
    name : str
        Which of several boards it is.
    body : str, optional
        The rigid body that it is fixed to; boards of one body move as one.

    Raises
    ------
    CalibrationError
        If the board cannot be printed so; the message says why not.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str = "DICT_4X4_1000"
    legacy: bool | None = None
    first_id: int = 0
    square_y_m: float | None = None
    name: str = "board"
    body: str | None = None

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise CalibrationError(
                f"a ChArUco board of {self.columns}x{self.rows} squares is too small; at least 3x3 "
                "are needed (count the squares, not the corners inside)"
            )
        _check_length("square", self.square_m)
        _check_length("square's side along y", self.sides_m[1])
        _check_length("marker", self.marker_m)
        if self.marker_m >= self.square_m:
            raise CalibrationError(
                f"a marker of {self.marker_m * 1000:g} mm does not fit into a square of "
                f"{self.square_m * 1000:g} mm"
            )
        _check_ids(self.dictionary, self.first_id, self.columns * self.rows // 2)

    @property
    def sides_m(self) -> tuple[float, float]:
        """The sides of a square along x and y, in metres."""
        return self.square_m, self.square_m if self.square_y_m is None else self.square_y_m

    @property
    def points_board(self) -> NDArray[np.float64]:
        """The inner corners, (N, 3) metres, row-major from (0, 0, 0) at the bottom left."""
        return _in_plane(_grid(self.columns - 1, self.rows - 1) * self.sides_m)

    @property
    def center_board(self) -> NDArray[np.float64]:
        """The middle of the board: (3,) metres."""
        return np.array([(self.columns - 2) / 2, (self.rows - 2) / 2, 0.0]) * (*self.sides_m, 0.0)

    @property
    def looks(self) -> NDArray[np.intp]:
        """The only listing of the points: markers tell all turns apart."""
        return np.arange((self.columns - 1) * (self.rows - 1), dtype=np.intp)[None]

    def board_from_turned(self, look: int) -> Pose:
        """Return the motion (3, 4) of a look, of which there is one: none."""
        return _only_look(look)

    def detect(self, image: NDArray[Any], effort: Effort = "thorough") -> Detection:
        """Find the board, or what is seen of it, in an image (H, W) or (H, W, 3), 0 to 255.

        Boards printed white on black, and those seen from the back through a transparent sheet,
        are found too, and `Detection.notes` says so.
        """
        # Both patterns are one where the rows are odd.
        legacies = (False,) if self.rows % 2 else (False, True)
        if self.legacy is not None and self.rows % 2 == 0:
            legacies = (self.legacy,)
        patterns = [_charuco_pattern(self, legacy) for legacy in legacies]
        return detect_pattern(image, patterns, self.dictionary, effort)

    def __str__(self) -> str:
        return (
            f"ChArUco of {self.columns}x{self.rows} squares, {_lengths_mm(self.sides_m)} mm "
            f"squares, {self.marker_m * 1000:g} mm markers"
        )


@dataclass(frozen=True, slots=True)
class AprilGrid:
    """Tags in a grid with black squares between their corners, as Kalibr prints it.

    Tag 0 is at the bottom left, numbers run to the right and then up. Points are listed tag by tag
    in the order of the numbers, and the four of a tag are bottom left, bottom right, top right, top
    left. (That is the order of Kalibr's detections; its table of grid points runs along the rows of
    corners instead.) Grids without the black squares, as OpenCV prints them, are refused: a lone
    corner of a tag moves with blur and exposure.

    Attributes
    ----------
    columns, rows : int
        Tags along x and y.
    tag_m, gap_m : float
        The side of a tag, from outer edge to outer edge, and the gap between tags, in metres.
        Kalibr writes the gap as a share of the tag, ``tagSpacing``.
    dictionary : str
        The tags' family, by OpenCV's name of the dictionary.
    first_id : int
        The number of the first tag; boards of one dictionary are told apart by it.
    name : str
        Which of several boards it is.
    body : str, optional
        The rigid body that it is fixed to; boards of one body move as one.

    Raises
    ------
    CalibrationError
        If the board cannot be printed so; the message says why not.
    """

    columns: int
    rows: int
    tag_m: float
    gap_m: float
    dictionary: str = "DICT_APRILTAG_36h11"
    first_id: int = 0
    name: str = "board"
    body: str | None = None

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 1 or self.columns * self.rows < 2:
            raise CalibrationError(
                f"an AprilGrid of {self.columns}x{self.rows} tags is too small; at least 2 are "
                "needed"
            )
        _check_length("tag", self.tag_m)
        _check_length("gap between tags", self.gap_m)
        if self.gap_m > self.tag_m:
            raise CalibrationError(
                f"a gap of {self.gap_m * 1000:g} mm between tags of {self.tag_m * 1000:g} mm is "
                "too wide; give the gap, not the distance from tag to tag"
            )
        _check_ids(self.dictionary, self.first_id, self.columns * self.rows)

    @property
    def points_board(self) -> NDArray[np.float64]:
        """The tags' corners, (N, 3) metres; tag 0's bottom left corner is (0, 0, 0)."""
        corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * self.tag_m
        first = _grid(self.columns, self.rows) * (self.tag_m + self.gap_m)
        return _in_plane((first[:, None] + corner).reshape(-1, 2))

    @property
    def center_board(self) -> NDArray[np.float64]:
        """The middle of the board: (3,) metres."""
        return np.asarray(self.points_board[-2] / 2.0)  # the top right corner of the last tag

    @property
    def square_m(self) -> float:
        """The side of a tag in metres."""
        return self.tag_m

    @property
    def looks(self) -> NDArray[np.intp]:
        """The only listing of the points: tags tell all turns apart."""
        return np.arange(4 * self.columns * self.rows, dtype=np.intp)[None]

    def board_from_turned(self, look: int) -> Pose:
        """Return the motion (3, 4) of a look, of which there is one: none."""
        return _only_look(look)

    def detect(self, image: NDArray[Any], effort: Effort = "thorough") -> Detection:
        """Find the board, or what is seen of it, in an image (H, W) or (H, W, 3), 0 to 255.

        Boards printed white on black, and those seen from the back through a transparent sheet,
        are found too, and `Detection.notes` says so.
        """
        # Kalibr prints a border of two bits; a search for one finds the tags of other printers.
        patterns = [_april_pattern(self, border_bits) for border_bits in (2, 1)]
        return detect_pattern(image, patterns, self.dictionary, effort)

    def __str__(self) -> str:
        return (
            f"AprilGrid of {self.columns}x{self.rows} tags, {self.tag_m * 1000:g} mm tags, "
            f"{self.gap_m * 1000:g} mm gaps"
        )


def _check_length(what: str, length_m: float) -> None:
    if not (np.isfinite(length_m) and length_m > 0):
        raise CalibrationError(f"the {what} is {length_m} m; give its side")


def _check_ids(dictionary: str, first_id: int, count: int) -> None:
    if dictionary not in DICTIONARIES:
        raise CalibrationError(
            f"there is no dictionary {dictionary!r}; there are {', '.join(DICTIONARIES)}"
        )
    size = len(dictionary_of(dictionary).bytesList)
    if first_id < 0 or first_id + count > size:
        raise CalibrationError(
            f"the board has markers {first_id} to {first_id + count - 1}, but {dictionary} has "
            f"markers 0 to {size - 1}"
        )


def _lengths_mm(sides_m: tuple[float, float]) -> str:
    return " by ".join(f"{side_m * 1000:g}" for side_m in dict.fromkeys(sides_m))


def _grid(columns: int, rows: int) -> NDArray[np.float64]:
    """Return whole numbers (columns * rows, 2), row by row."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float64)


def _in_plane(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack([points, np.zeros(len(points))])


def _only_look(look: int) -> Pose:
    if look != 0:
        raise IndexError(f"look {look} of a board that has one")
    return np.eye(3, 4)


@lru_cache(maxsize=16)
def _charuco_pattern(board: Charuco, legacy: bool) -> Pattern:
    """Return a ChArUco board, in squares."""
    columns, rows = board.columns, board.rows
    white = 0 if legacy and rows % 2 == 0 else 1
    bits = dictionary_of(board.dictionary).markerSize
    side = board.marker_m / board.square_m
    margin, ring = (1.0 - side) / 2, side / (bits + 2)

    def sign_at(places: NDArray[np.float64]) -> NDArray[np.float64]:
        lower = np.floor(places)
        # Squares are counted from the top left, as OpenCV numbers the markers.
        square = np.column_stack([lower[:, 0] + 1, rows - 2 - lower[:, 1]])
        depth = np.minimum(places - lower, 1.0 - (places - lower)).min(axis=1) - margin
        in_white = square.sum(axis=1) % 2 == white
        sign = np.where(in_white & (depth < 0), 1.0, -1.0)
        sign[in_white & (depth >= ring)] = 0.0
        return np.where(((square >= 0) & (square < (columns, rows))).all(axis=1), sign, 0.0)

    def steady_at(places: NDArray[np.float64]) -> NDArray[np.float64]:
        lower = np.floor(places)
        square = np.column_stack([lower[:, 0] + 1, rows - 2 - lower[:, 1]])
        depth = np.minimum(places - lower, 1.0 - (places - lower)).min(axis=1)
        in_black = square.sum(axis=1) % 2 != white
        steady = in_black | (depth < max(margin - _MARKER_BLUR, _ON_THE_LINE))
        return np.asarray(steady, np.float64)

    squares = _grid(columns, rows + 2 * _ROWS_BEYOND) - (0, _ROWS_BEYOND)
    squares = squares[squares.sum(axis=1) % 2 == white]
    on_board = (squares[:, 1] >= 0) & (squares[:, 1] < rows)
    ids = board.first_id + np.arange(len(squares)) - int(np.argmax(on_board))
    top_left = np.column_stack([squares[:, 0] - 1.0, rows - 1.0 - squares[:, 1]])
    corners = np.array([[0, 0], [1, 0], [1, -1], [0, -1]]) * side + (margin, -margin)
    quads = top_left[:, None] + corners
    beyond = ~on_board & _exist(ids, board.dictionary)
    points = _grid(columns - 1, rows - 1)
    return Pattern(
        label="" if rows % 2 else ("old pattern" if legacy else "new pattern"),
        points=points,
        ids=ids[on_board],
        quads=quads[on_board],
        reach=3.0,
        signs=around(points, sign_at),
        steady=around(points, steady_at) > 0,
        border_bits=1,
        ids_beyond=ids[beyond],
        quads_beyond=quads[beyond],
    )


def _exist(ids: NDArray[np.intp], dictionary: str) -> NDArray[np.bool_]:
    """Return which numbers a dictionary has."""
    return np.asarray((ids >= 0) & (ids < len(dictionary_of(dictionary).bytesList)))


@lru_cache(maxsize=16)
def _april_pattern(board: AprilGrid, border_bits: int) -> Pattern:
    """Return an AprilGrid, in cells that let symmetry reach almost to the end of a gap."""
    cell_m = 0.9 * board.gap_m / SYMMETRY_REACH
    tag, gap = board.tag_m / cell_m, board.gap_m / cell_m
    pitch = tag + gap
    ring = border_bits * tag / (dictionary_of(board.dictionary).markerSize + 2 * border_bits)

    def sign_at(places: NDArray[np.float64]) -> NDArray[np.float64]:
        within = places - np.floor(places / pitch) * pitch
        in_gap = within > tag
        depth = np.minimum(within, tag - within).min(axis=1)  # below the edge of the tag
        sign = np.where(in_gap.all(axis=1), -1.0, 1.0)
        sign[~in_gap.any(axis=1)] = -1.0
        sign[depth >= ring] = 0.0
        return sign

    points = board.points_board[:, :2] / cell_m
    # OpenCV's markers are Kalibr's upside down.
    quads = points.reshape(-1, 4, 2)[:, [1, 0, 3, 2]]
    places = _grid(board.columns, board.rows + 2 * _ROWS_BEYOND) - (0, _ROWS_BEYOND)
    ids = board.first_id + (places @ (1, board.columns)).astype(np.intp)
    outside = (places[:, 1] < 0) | (places[:, 1] >= board.rows)
    beyond = outside & _exist(ids, board.dictionary)
    return Pattern(
        label=f"borders of {border_bits}",
        points=points,
        ids=board.first_id + np.arange(len(quads)),
        quads=quads,
        reach=2.3 * pitch,
        signs=around(points, sign_at),
        border_bits=border_bits,
        ids_beyond=ids[beyond],
        quads_beyond=quads[0] + pitch * places[beyond][:, None],
        doubt=": are there no black squares between the tags' corners?",
    )
