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

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Detection, Effort
from hybridve.calib.boards.target import (
    SYMMETRY_BLUR_PX,
    SYMMETRY_REACH,
    fit_homography,
    grey_of,
    move_to_symmetry,
    symmetry_offsets,
)
from hybridve.calib.errors import CalibrationError
from hybridve.calib.pose import Pose

_Grey = TypeVar("_Grey", np.uint8, np.float32)

#: The dictionaries of markers, by OpenCV's names.
DICTIONARIES = tuple(
    sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_") and not name.endswith("H"))
)

#: The longer side in pixels to which large images are reduced for the first search.
_SEARCH_SIZE_PX = 1600

#: The smallest marker side that is looked for; its bits are about a pixel.
_MARKER_PX = 8.0

#: What is tried, quick ways first: (size, mirrored, negative), where the size is relative to the
#: reduced image; None is the image itself. (OpenCV finds some markers printed white on black in the
#: image as it is, but not those whose corners touch.)
_WAYS: dict[Effort, tuple[tuple[float | None, bool, bool], ...]] = {
    "quick": ((1.0, False, False),),
    "usual": (
        (1.0, False, False),
        (None, False, False),
        (1.0, False, True),
        (1.0, True, False),
    ),
    "thorough": (
        (1.0, False, False),
        (None, False, False),
        (1.0, False, True),
        (1.0, True, False),
        (1.0, True, True),
        (2.0, False, False),
        (None, False, True),
        (None, True, False),
    ),
}

#: Two markers lie as on the board if one homography maps both to within this, of their sides.
_LINK_TOLERANCE = 0.15
_LINK_TOLERANCE_PX = 1.5

#: Points are predicted from this many known ones, the nearest; corners of markers, which may be off
#: by many pixels, only decide what refined points leave open.
_ANCHORS = 12
_MARKER_WEIGHT = 1e-4

#: A cell of the frontal view has this many pixels, those of the image at most twice as many: it is
#: reduced, and blurred by so many of its pixels as a pixel of the view covers.
_CELL_PX = (20.0, 50.0)
_COVER_BLUR = 0.4

#: A point moves at most this far from where it was predicted, in cells.
_TRAVEL = 0.3

#: How well a point's surroundings correlate with what is printed there.
_LIKENESS = 0.65

#: A point further than this from where its neighbours have it is none, in cells: by how far points
#: are usually off, within bounds. Judged is a point with so many neighbours.
_ROUGH_FACTOR = 8.0
_ROUGH_TOLERANCE = (0.04, 0.15)
_ROUGH_NEIGHBOURS = 7

#: From the pixel centres of this project to those of OpenCV, as a quadratic map.
_HALF_PIXEL = np.array([[0.5]] + 5 * [[0.0]])

#: Fewer points do not make a view.
_LEAST_POINTS = 6


@dataclass(frozen=True, slots=True, eq=False)
class _Pattern:
    """What is printed, in a plane whose unit is a cell: a length that suits the refinement.

    Attributes
    ----------
    label : str
        What to say of it, beside the board.
    points : (N, 2) float64
        The points.
    ids : (M,) intp
        The markers' numbers in the dictionary.
    quads : (M, 4, 2) float64
        The markers' corners, in the order in which OpenCV gives them.
    reach : float
        Markers up to this far from each other are compared.
    signs : (N, 2 K) float64
        What is printed around each point, at `symmetry_offsets` and opposite of them: 1 white,
        -1 black, 0 unknown.
    border_bits : int
        How thick the markers' black border is.
    doubt : str
        What may be the matter where markers are read and no points are found at them.
    """

    label: str
    points: NDArray[np.float64]
    ids: NDArray[np.intp]
    quads: NDArray[np.float64]
    reach: float
    signs: NDArray[np.float64]
    border_bits: int
    doubt: str = ""


def _around(
    points: NDArray[np.float64], sign_at: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return what is printed around points: (N, 2 K) of ``sign_at`` of places (P, 2) in cells."""
    offsets = symmetry_offsets(1.0)
    places = points[:, None] + np.concatenate([offsets, -offsets])
    return sign_at(places.reshape(-1, 2)).reshape(places.shape[:2])


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
        return _detect(image, patterns, self.dictionary, effort)

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
        return _detect(image, patterns, self.dictionary, effort)

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
    size = len(_dictionary(dictionary).bytesList)
    if first_id < 0 or first_id + count > size:
        raise CalibrationError(
            f"the board has markers {first_id} to {first_id + count - 1}, but {dictionary} has "
            f"markers 0 to {size - 1}"
        )


@lru_cache(maxsize=8)
def _dictionary(name: str) -> Any:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


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
def _charuco_pattern(board: Charuco, legacy: bool) -> _Pattern:
    """Return a ChArUco board, in squares."""
    columns, rows = board.columns, board.rows
    white = 0 if legacy and rows % 2 == 0 else 1
    bits = _dictionary(board.dictionary).markerSize
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

    squares = _grid(columns, rows)
    squares = squares[squares.sum(axis=1) % 2 == white]
    top_left = np.column_stack([squares[:, 0] - 1.0, rows - 1.0 - squares[:, 1]])
    corners = np.array([[0, 0], [1, 0], [1, -1], [0, -1]]) * side + (margin, -margin)
    points = _grid(columns - 1, rows - 1)
    return _Pattern(
        label="" if rows % 2 else ("old pattern" if legacy else "new pattern"),
        points=points,
        ids=board.first_id + np.arange(len(squares)),
        quads=top_left[:, None] + corners,
        reach=3.0,
        signs=_around(points, sign_at),
        border_bits=1,
    )


@lru_cache(maxsize=16)
def _april_pattern(board: AprilGrid, border_bits: int) -> _Pattern:
    """Return an AprilGrid, in cells that let symmetry reach almost to the end of a gap."""
    cell_m = 0.9 * board.gap_m / SYMMETRY_REACH
    tag, gap = board.tag_m / cell_m, board.gap_m / cell_m
    pitch = tag + gap
    ring = border_bits * tag / (_dictionary(board.dictionary).markerSize + 2 * border_bits)

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
    return _Pattern(
        label=f"borders of {border_bits}",
        points=points,
        ids=board.first_id + np.arange(len(quads)),
        quads=quads,
        reach=2.3 * pitch,
        signs=_around(points, sign_at),
        border_bits=border_bits,
        doubt=": are there no black squares between the tags' corners?",
    )


def _detect(
    image: NDArray[Any], patterns: list[_Pattern], dictionary: str, effort: Effort
) -> Detection:
    grey = grey_of(image)
    eight_bit = np.clip(np.round(grey), 0, 255).astype(np.uint8)
    tried = []
    for scale, mirrored, negative in _scales(max(grey.shape), effort):
        searched, here = _scaled(eight_bit, scale), grey
        if negative:
            searched = 255 - searched
        if mirrored:
            searched, here = np.fliplr(searched).copy(), np.fliplr(grey).copy()
        exact = np.array(searched.shape[::-1]) / grey.shape[::-1]
        way = f"markers at {scale:.3g}x" + ", mirrored" * mirrored + ", negative" * negative
        pattern, linked, said = _read(searched, exact, patterns, dictionary)
        tried.append(f"{way} ({said})")
        if pattern is None or linked is None:
            continue
        corners, inverted = _find_points(here, pattern, linked)
        if corners is None:
            tried[-1] = f"{way} ({said}, fewer than {_LEAST_POINTS} points at them{pattern.doubt})"
            continue
        if mirrored:
            corners[:, 0] = grey.shape[1] - corners[:, 0]
        notes = ("mirrored: seen from the back",) * mirrored + ("inverted",) * inverted
        return Detection(corners, ", ".join(filter(None, [way, pattern.label])), notes)
    return Detection(None, "tried " + ", ".join(tried))


def _scales(size_px: int, effort: Effort) -> Iterator[tuple[float, bool, bool]]:
    """Yield the ways, each once: the scale of the image, whether mirrored, whether negative."""
    reduction = min(1.0, _SEARCH_SIZE_PX / size_px)
    ways = [
        (1.0 if relative is None else reduction * relative, mirrored, negative)
        for relative, mirrored, negative in _WAYS[effort]
    ]
    yield from dict.fromkeys(ways)


def _scaled(image: NDArray[_Grey], scale: float) -> NDArray[_Grey]:
    if scale == 1.0:
        return image
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    # OpenCV's fx and fy would not be the ratio of the sizes, which are whole numbers.
    size = [max(1, round(side * scale)) for side in image.shape[::-1]]
    return np.asarray(cv2.resize(image, size, interpolation=interpolation), image.dtype)


@dataclass(frozen=True, slots=True, eq=False)
class _Linked:
    """Markers that lie as on the board.

    Attributes
    ----------
    plane, pixels : (A, 2) float64
        Their corners in cells, and in pixels of the image, pixel centre at 0.5.
    cell_px : float
        The largest side of a cell in the image.
    """

    plane: NDArray[np.float64]
    pixels: NDArray[np.float64]
    cell_px: float

    def scaled(self, scale: NDArray[np.float64]) -> "_Linked":
        """Return the same in an image that is `scale` (2,) times as wide and high."""
        return _Linked(self.plane, self.pixels * scale, self.cell_px * float(scale.mean()))


def _read(
    image: NDArray[np.uint8],
    exact: NDArray[np.float64],
    patterns: list[_Pattern],
    dictionary: str,
) -> tuple[_Pattern | None, _Linked | None, str]:
    """Return the pattern that the markers of an image fit, those that do, and what there was."""
    best: tuple[int, _Pattern, NDArray[np.intp], NDArray[np.float64]] | None = None
    most, border_bits = 0, 0
    for pattern in patterns:
        if pattern.border_bits != border_bits:
            if best is not None:
                break
            border_bits = pattern.border_bits
            members, quads_px = _read_markers(image, dictionary, pattern)
        most = max(most, len(members))
        chosen, fitting = _link(pattern, members, quads_px)
        if len(chosen) >= 2 and (best is None or fitting > best[0]):
            best = fitting, pattern, members[chosen], quads_px[chosen]
    said = f"{most} markers of the board"
    if best is None:
        if most > 1:
            said += ", which do not lie as on it"
        return None, None, said
    _, pattern, members, found_px = best
    quads, quads_px = pattern.quads[members], (found_px + 0.5) / exact
    plane, pixels = quads.reshape(-1, 2), quads_px.reshape(-1, 2)
    sides, sides_px = (
        np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
        for corners in (quads, quads_px)
    )
    cell_px = float((sides_px / sides).max())
    return pattern, _Linked(plane, pixels, cell_px), said


@lru_cache(maxsize=16)
def _own_dictionary(name: str, first_id: int, count: int) -> Any:
    # Comparing with all markers of a large dictionary takes longer than all other steps. Those of
    # other boards differ from each of these by more bits than are corrected.
    whole = _dictionary(name)
    own = np.ascontiguousarray(whole.bytesList[first_id : first_id + count])
    return cv2.aruco.Dictionary(own, whole.markerSize, whole.maxCorrectionBits)


def _read_markers(
    image: NDArray[np.uint8], dictionary: str, pattern: _Pattern
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the board's markers in an image: indices (M,), corners (M, 4, 2), centres at 0."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = pattern.border_bits
    parameters.detectInvertedMarker = True
    parameters.minMarkerPerimeterRate = min(0.03, 4 * _MARKER_PX / max(image.shape))
    none = np.zeros(0, np.intp), np.zeros((0, 4, 2))
    if min(image.shape) < 4 * _MARKER_PX:
        return none
    own = _own_dictionary(dictionary, int(pattern.ids[0]), len(pattern.ids))
    detector = cv2.aruco.ArucoDetector(own, parameters)
    found: tuple[Any, ...] = detector.detectMarkers(image)
    corners, ids, _ = found
    if ids is None or len(ids) == 0:
        return none
    return np.asarray(ids, np.intp).ravel(), np.asarray(corners, np.float64).reshape(-1, 4, 2)


def _link(
    pattern: _Pattern, members: NDArray[np.intp], quads_px: NDArray[np.float64]
) -> tuple[NDArray[np.intp], int]:
    """Return the largest group of markers that lie to each other as on the board.

    Compared are markers that are neighbours on the board, where no lens bends it. Returns the
    indices into `members`, and how many pairs agree; none if more markers contradict the group
    than belong to it, as on another board of the same dictionary.
    """
    nobody = np.zeros(0, np.intp), 0
    if len(members) < 2:
        return nobody
    middles = pattern.quads.mean(axis=1)[members]
    apart = np.linalg.norm(middles[:, None] - middles, axis=-1)
    first, second = np.nonzero(np.triu((apart < pattern.reach) & (apart > 0), 1))
    if len(first) == 0:
        return nobody
    plane = np.concatenate([pattern.quads[members[first]], pattern.quads[members[second]]], axis=1)
    pixels = np.concatenate([quads_px[first], quads_px[second]], axis=1)
    off_px = np.linalg.norm(_mapped(_homographies(plane, pixels), plane) - pixels, axis=-1)
    sides_px = np.linalg.norm(quads_px - np.roll(quads_px, 1, axis=1), axis=-1).mean(axis=1)
    allowed_px = np.maximum(
        _LINK_TOLERANCE * np.minimum(sides_px[first], sides_px[second]), _LINK_TOLERANCE_PX
    )
    agree = off_px.max(axis=1) < allowed_px
    group = np.arange(len(members))
    for _ in range(len(members)):
        lowest = group.copy()
        np.minimum.at(lowest, first[agree], group[second[agree]])
        np.minimum.at(lowest, second[agree], group[first[agree]])
        if (lowest == group).all():
            break
        group = lowest
    largest = np.bincount(group).argmax()
    inside = group == largest
    against = np.zeros(len(members), bool)
    against[second[~agree & inside[first]]] = True
    against[first[~agree & inside[second]]] = True
    if (against & ~inside).sum() > inside.sum():
        return nobody
    # A number that was read twice is taken where more neighbours agree.
    votes = np.bincount(np.concatenate([first[agree], second[agree]]), minlength=len(members))
    order = np.argsort(-votes * inside, kind="stable")
    _, once = np.unique(members[order], return_index=True)
    chosen = np.sort(order[once])
    return chosen[inside[chosen]], int((agree & inside[first]).sum())


def _homographies(
    source: NDArray[np.float64],
    target: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return homographies (B, 3, 3) that map (B, K, 2) to (B, K, 2), each its least squares."""
    batch, count = source.shape[:2]
    normal = []
    for points in (source, target):
        middle = points.mean(axis=1, keepdims=True)
        spread = np.linalg.norm(points - middle, axis=-1).mean(axis=1)[:, None, None] + 1e-12
        normal.append((middle, spread, (points - middle) / spread))
    (from_middle, from_spread, a), (to_middle, to_spread, b) = normal
    design = np.zeros((batch, count, 2, 8))
    design[..., 0, 0:2], design[..., 1, 3:5] = a, a
    design[..., 0, 2] = design[..., 1, 5] = 1.0
    design[..., 6:8] = -b[..., :, None] * a[..., None, :]
    left = np.einsum("bkci,bkcj->bij", design, design) + 1e-10 * np.eye(8)
    right = np.einsum("bkci,bkc->bi", design, b)
    solved = np.linalg.solve(left, right[..., None])[..., 0]
    matrix = np.concatenate([solved, np.ones((batch, 1))], axis=1).reshape(batch, 3, 3)
    to_normal, from_normal = np.zeros((2, batch, 3, 3))
    to_normal[:, [0, 1], [0, 1]] = 1.0 / from_spread[:, 0]
    to_normal[:, :2, 2] = -(from_middle / from_spread)[:, 0]
    from_normal[:, [0, 1], [0, 1]] = to_spread[:, 0]
    from_normal[:, :2, 2] = to_middle[:, 0]
    to_normal[:, 2, 2] = from_normal[:, 2, 2] = 1.0
    return np.asarray(from_normal @ matrix @ to_normal)


def _mapped(matrices: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Map points (B, K, 2) by homographies (B, 3, 3); behind the horizon, to infinity."""
    mapped = points @ matrices[:, :, :2].transpose(0, 2, 1) + matrices[:, None, :, 2]
    depth = np.where(mapped[..., 2:] > 1e-9, mapped[..., 2:], np.nan)
    return np.asarray(np.nan_to_num(mapped[..., :2] / depth, nan=np.inf))


def _find_points(
    grey: NDArray[np.float32], pattern: _Pattern, linked: _Linked
) -> tuple[NDArray[np.float64] | None, bool]:
    """Return points (N, 2), NaN where not seen, and whether black and white are exchanged."""
    reduced = _scaled(grey, 1.0 / max(1, int(1.2 * linked.cell_px / _CELL_PX[1])))
    exact = np.array(reduced.shape[::-1]) / grey.shape[::-1]
    linked = linked.scaled(exact)
    coarser = linked.cell_px / _CELL_PX[1]
    if coarser > 1.0:
        reduced = np.asarray(cv2.GaussianBlur(reduced, (0, 0), _COVER_BLUR * coarser), np.float32)
    found, inverted = _find_points_in(reduced, pattern, linked)
    return (None if found is None else found / exact), inverted


def _find_points_in(
    grey: NDArray[np.float32], pattern: _Pattern, linked: _Linked
) -> tuple[NDArray[np.float64] | None, bool]:
    count = len(pattern.points)
    found = np.full((count, 2), np.nan)
    inverted: bool | None = None
    nearest = np.linalg.norm(pattern.points[:, None] - linked.plane, axis=-1).min(axis=1)
    wanted = nearest < 0.5
    tried = np.zeros(count, bool)
    while wanted.any():
        tried |= wanted
        moved, likeness = _refine(grey, pattern, linked, found, wanted)
        if inverted is None:
            inverted = bool(np.median(likeness) < 0)
        good = (-likeness if inverted else likeness) > _LIKENESS
        found[np.flatnonzero(wanted)[good]] = moved[good]
        _drop_rough(pattern, linked, found)
        known = pattern.points[np.isfinite(found[:, 0])]
        if len(known) == 0:
            break
        beside = (
            np.linalg.norm(pattern.points[:, None] - known, axis=-1).min(axis=1) < pattern.reach / 2
        )
        wanted = beside & ~tried
    seen = np.isfinite(found[:, 0])
    if seen.any():
        moved, likeness = _refine(grey, pattern, linked, found, seen)
        good = (-likeness if inverted else likeness) > _LIKENESS
        found[seen] = np.where(good[:, None], moved, np.nan)
        _drop_rough(pattern, linked, found)
    if not _spans_plane(pattern.points[np.isfinite(found[:, 0])]):
        return None, False
    return found, bool(inverted)


def _spans_plane(points: NDArray[np.float64]) -> bool:
    """Tell whether points (N, 2) are enough, and no line holds all of them but one."""
    if len(points) < _LEAST_POINTS:
        return False
    for index in range(len(points)):
        rest = np.delete(points, index, axis=0)
        if np.linalg.svd(rest - rest.mean(axis=0), compute_uv=False)[1] < 1e-6:
            return False
    return True


def _terms(offsets: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the terms (..., 6) of a quadratic map at offsets (..., 2)."""
    x, y = offsets[..., 0], offsets[..., 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def _predict(
    pattern: _Pattern,
    linked: _Linked,
    found: NDArray[np.float64],
    points: NDArray[np.float64],
    itself: bool,
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return quadratic maps (P, 6, 2) from offsets around points (P, 2), in cells, to pixels.

    Perspective and lens bend a board; nearby, a quadratic map has both (a homography leaves 2.5 px
    of a fisheye's bend in squares of 90 px). With ``itself`` a known point counts for its own place
    too. Also returned is on how many refined points (P,) each map rests.
    """
    seen = np.isfinite(found[:, 0])
    if not seen.any():
        return _predict_from_markers(linked, points), np.zeros(len(points), np.intp)
    plane, pixels = pattern.points[seen], found[seen]
    if len(plane) <= _ANCHORS:
        plane = np.concatenate([plane, linked.plane])
        pixels = np.concatenate([pixels, linked.pixels])
    is_refined = np.arange(len(plane)) < seen.sum()
    apart = np.linalg.norm(points[:, None] - plane, axis=-1)
    if not itself:
        apart[apart < 1e-9] = np.inf  # the tags' corners, where they are the points, go too
    # Refined points go before markers, however near those are.
    after = apart + np.where(is_refined, 0.0, np.ptp(pattern.points, axis=0).sum() + pattern.reach)
    nearest = np.argsort(after, axis=1, kind="stable")[:, : min(_ANCHORS, len(plane))]
    usable = np.isfinite(np.take_along_axis(apart, nearest, axis=1))
    weights = np.where(is_refined[nearest], 1.0, _MARKER_WEIGHT) * usable
    weights /= np.maximum(weights.max(axis=1, keepdims=True), _MARKER_WEIGHT)
    offsets = plane[nearest] - points[:, None]
    # Perspective first, which a quadratic map has but in part; it leaves what lenses bend.
    flat = fit_homography(plane[is_refined], pixels[is_refined]) if seen.sum() >= 8 else None
    if flat is not None and not (np.concatenate([points, plane]) @ flat[2, :2] + 1.0 > 0.1).all():
        flat = None  # its horizon is too near
    left_px = pixels if flat is None else pixels - _mapped(flat[None], plane[None])[0]
    size = np.linalg.norm(offsets, axis=-1).max(axis=1)[:, None]
    terms = _terms(offsets / size[..., None])
    weighted = (terms * weights[..., None]).transpose(0, 2, 1)
    # What points in a row or two leave open stays flat.
    ridge = np.diag([1e-9, 1e-9, 1e-9, 1e-4, 1e-4, 1e-4])
    maps = np.linalg.solve(weighted @ terms + ridge, weighted @ left_px[nearest])
    maps /= (size ** np.array([0, 1, 1, 2, 2, 2]))[..., None]
    if flat is not None:
        maps += _expanded(flat, points)
    return maps, (is_refined[nearest] & usable).sum(axis=1)


def _expanded(matrix: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a homography (3, 3) around points (P, 2), to second order: (P, 6, 2)."""
    at = points @ matrix[:, :2].T + matrix[:, 2]
    value = at[:, :2] / at[:, 2:]
    tilt = matrix[2, :2] / at[:, 2:]  # (P, 2)
    slope = matrix[:2, :2].T / at[:, 2, None, None] - tilt[:, :, None] * value[:, None]
    x, y = tilt[:, :1], tilt[:, 1:]
    bend = [-x * slope[:, 0], -x * slope[:, 1] - y * slope[:, 0], -y * slope[:, 1]]
    return np.stack([value, slope[:, 0], slope[:, 1], *bend], axis=1)


def _predict_from_markers(linked: _Linked, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return quadratic maps (P, 6, 2) near the homographies that the nearest markers give.

    Corners of markers are off by many pixels where black squares touch them; a quadratic map has
    too much freedom for them.
    """
    apart = np.linalg.norm(points[:, None] - linked.plane, axis=-1)
    nearest = np.argsort(apart, axis=1, kind="stable")[:, :_ANCHORS]
    matrices = _homographies(linked.plane[nearest], linked.pixels[nearest])
    ticks = np.linspace(-1.0, 1.0, 5)
    around = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    at = _mapped(matrices, points[:, None] + around)
    at = np.clip(at, -1e5, 1e5)  # places behind the horizon are far outside the image
    return np.asarray(np.linalg.pinv(_terms(around)) @ at)


def _drop_rough(pattern: _Pattern, linked: _Linked, found: NDArray[np.float64]) -> None:
    """Forget, in place, points that are not where their neighbours have them; worst first."""
    while True:
        seen = np.flatnonzero(np.isfinite(found[:, 0]))
        if len(seen) == 0:
            return
        maps, neighbours = _predict(pattern, linked, found, pattern.points[seen], itself=False)
        off = np.linalg.norm(maps[:, 0] - found[seen], axis=1)
        off /= np.linalg.norm(maps[:, 1:3], axis=-1).max(axis=1)
        off[neighbours < _ROUGH_NEIGHBOURS] = 0.0
        allowed = np.clip(_ROUGH_FACTOR * np.median(off), *_ROUGH_TOLERANCE)
        if not off.max() > allowed:
            return
        found[seen[off.argmax()]] = np.nan


def _refine(
    grey: NDArray[np.float32],
    pattern: _Pattern,
    linked: _Linked,
    found: NDArray[np.float64],
    wanted: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where wanted points are, (P, 2) pixels, and how they look like what is printed.

    The likeness (P,) is a correlation: -1 where black and white are exchanged, 0 where the search
    left the image or went astray.
    """
    points, signs = pattern.points[wanted], pattern.signs[wanted]
    maps, _ = _predict(pattern, linked, found, points, itself=True)
    known = np.isfinite(found[wanted, 0])
    maps[known, 0] = found[wanted][known]
    cell = float(np.clip(np.ceil(1.2 * linked.cell_px), *_CELL_PX))
    half = int(np.ceil((SYMMETRY_REACH + _TRAVEL) * cell)) + 3
    size = 2 * half + 1
    across = int(np.ceil(np.sqrt(len(points))))
    down = -(-len(points) // across)
    # All views lie side by side in one picture.
    ticks = np.arange(-half, half + 1) / cell
    terms = _terms(np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)).astype(np.float32)
    sheet = np.full((down * across, size, size, 2), -1.0, np.float32)
    sheet[: len(points)] = (terms @ (maps - _HALF_PIXEL).astype(np.float32)).reshape(
        -1, size, size, 2
    )
    sheet = sheet.reshape(down, across, size, size, 2).transpose(0, 2, 1, 3, 4)
    x, y = np.ascontiguousarray(
        np.moveaxis(sheet.reshape(down * size, across * size, 2), -1, 0), np.float32
    )
    view = np.asarray(
        cv2.remap(grey, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.float32
    )
    index = np.arange(len(points))
    middles = (np.column_stack([index % across, index // across]) * size + half).astype(np.float64)

    both = np.concatenate([symmetry_offsets(cell), -symmetry_offsets(cell)])
    reached = _terms(both / cell) @ maps
    inside = ((reached > 0) & (reached < grey.shape[::-1])).all(axis=-1)
    signs = np.where(inside, signs, 0.0)
    ahead, behind = np.split(signs, 2, axis=1)
    weights = ((ahead != 0) & (behind != 0)).astype(np.float64)

    moved = middles
    for blur in (0.15, 0.0):
        blur_px = max(blur * cell, SYMMETRY_BLUR_PX)
        moved = move_to_symmetry(view, moved, cell, blur_px, weights)
        moved = middles + np.clip(moved - middles, -_TRAVEL * cell, _TRAVEL * cell)
    sampled = _sample(view, moved[:, None] + both)
    # A point that was found stays; one that a better view moves was none.
    travelled = np.abs(moved - middles).max(axis=1) >= np.where(known, 0.05, _TRAVEL) * cell
    beside_edges = (np.abs(both) > 0.05 * cell).all(axis=1)
    likeness = np.where(travelled, 0.0, _likeness(sampled, signs * beside_edges))
    pixels = (_terms((moved - middles) / cell)[:, None] @ maps)[:, 0]
    outside = ((pixels < 2) | (pixels > np.subtract(grey.shape[::-1], 2))).any(axis=1)
    likeness[outside] = 0.0
    return pixels, likeness


def _sample(view: NDArray[np.float32], places: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y = (np.ascontiguousarray(places[..., axis], dtype=np.float32) for axis in (0, 1))
    return np.asarray(cv2.remap(view, x, y, cv2.INTER_LINEAR), np.float64)


def _likeness(sampled: NDArray[np.float64], signs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how grey levels (P, K) correlate with what is printed (P, K); 0 for too little."""
    known = signs != 0
    count = np.maximum(known.sum(axis=1), 1)
    centred = []
    for values in (sampled, signs):
        mean = (values * known).sum(axis=1) / count
        centred.append((values - mean[:, None]) * known)
    grey, sign = centred
    size = np.sqrt((grey**2).sum(axis=1) * (sign**2).sum(axis=1))
    correlation = (grey * sign).sum(axis=1) / np.maximum(size, 1e-9)
    return np.where(known.mean(axis=1) > 0.2, correlation, 0.0)
