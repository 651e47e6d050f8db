"""What pictures show where a board was not found: another one than was described.

Markers say which they are, and where their middles lie says how the board is laid out, whatever
their size; plain boards are tried by the mistakes that people make in counting. What comes of it is
believed where that board is then found, by the search that any board is found by.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board
from hybridve.calib.boards.marker_search import dictionary_of
from hybridve.calib.boards.markers import DICTIONARIES, AprilGrid, Charuco
from hybridve.calib.boards.target import Chessboard, fit_homography, grey_of
from hybridve.calib.errors import CalibrationError

_Known = Chessboard | Charuco | AprilGrid

#: Pictures are looked at in at most this many pixels along the longer side.
_SIZE_PX = 1200

#: Markers of one family in one picture that are no accident.
_LEAST_MARKERS = 5

#: Places so near the edge of a picture, in its sides, may be outside of it.
_MARGIN = 0.05

#: Dictionaries of so many markers are looked through, where a family has a smaller one.
_COMMON = 250

#: Corners of a board of unknown size that are no accident.
_LEAST_CORNERS = 12

#: Most squares or tags along a side that are thought of.
_MOST_COLUMNS = 40

#: Markers lie as on a board if their middles do to within this, of their sides (a lens bends it),
#: and if so many of them do.
_OFF = 0.35
_SHARE = 0.8

#: So few trials find one that most markers fit; where there is none, more are in vain.
_TRIALS = 60

#: Lengths that differ by less than this share are the same.
_SAME_LENGTH = 0.04


@dataclass(frozen=True, slots=True, eq=False)
class _Read:
    """The markers of one family in one picture: numbers (M,), corners (M, 4, 2) in pixels."""

    ids: NDArray[np.intp]
    quads_px: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class _Layout:
    """How markers lie: on a ChArUco board or a grid, in how many columns, of which size.

    `side` is the marker's by the distance from column to column; `is_offset` tells whether the
    first square of a ChArUco board has no marker.
    """

    is_charuco: bool
    columns: int
    first_id: int
    is_offset: bool
    side: float
    count: int


def what_is_seen(board: Board, pictures: Sequence[NDArray[Any]]) -> str | None:
    """Return what pictures show in place of a board that none of them shows, and what to say.

    Parameters
    ----------
    board : Board
        The board as it was described.
    pictures : sequence of (H, W) or (H, W, 3) uint8 or float32
        A few of those in which it was looked for, grey or BGR, 0 to 255.

    Returns
    -------
    str or None
        One sentence without a full stop; None where no other board is seen either.
    """
    if not isinstance(board, Chessboard | Charuco | AprilGrid):
        return None
    greys = [_small(picture) for picture in pictures]
    attempts: list[tuple[Callable[[_Known, NDArray[np.uint8]], _Known | None], NDArray[np.uint8]]]
    chessboards = [(_seen_chessboard, grey) for grey in greys]
    markers = [(_seen_markers, grey) for grey in greys]
    if isinstance(board, Chessboard):
        attempts = [*chessboards, *markers]
    else:
        # In a negative, and from its back: the search for the board itself knows both.
        turned = [
            (_seen_markers, other)
            for grey in greys[:1]
            for other in (np.asarray(255 - grey, np.uint8), np.ascontiguousarray(np.fliplr(grey)))
        ]
        attempts = [*markers, *turned, *chessboards]
    for search, grey in attempts:
        seen = search(board, grey)
        if seen is not None and _changed(board, seen):
            return _told(board, seen)
    return None


def _seen_markers(board: _Known, grey: NDArray[np.uint8]) -> Charuco | AprilGrid | None:
    """Return the board of markers that a picture shows, measured; None if it shows none."""
    for seen in _marker_boards(board, grey):
        corners = seen.detect(grey, "usual").corners
        if corners is not None:
            return _measured(board, seen, grey, corners)
    return None


def _small(picture: NDArray[Any]) -> NDArray[np.uint8]:
    grey = np.clip(np.round(grey_of(picture)), 0, 255).astype(np.uint8)
    scale = _SIZE_PX / max(grey.shape)
    if scale >= 1.0:
        return grey
    return np.asarray(
        cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8
    )


# --- Boards of markers ------------------------------------------------------------------------


def _marker_boards(board: _Known, grey: NDArray[np.uint8]) -> Iterator[Charuco | AprilGrid]:
    """Yield the boards that the markers in a picture may belong to, likely ones first."""
    said = _family_of(getattr(board, "dictionary", ""))
    for dictionary in sorted(_families(), key=lambda name: _family_of(name) != said):
        for border_bits in (2, 1) if "APRILTAG" in dictionary else (1,):
            read = _read(grey, dictionary, border_bits)
            layout = _layout(board, read) if len(read.ids) >= _LEAST_MARKERS else None
            if layout is None:
                continue
            rows_tried = _rows(board, layout, int(read.ids.max()) - layout.first_id + 1)
            if layout.columns != board.columns:  # rows as described may be covered
                rows_tried = _not_ended(layout, read, rows_tried, grey.shape)
            for rows in rows_tried:
                made = _made(board, layout, dictionary, rows)
                if made is not None:
                    yield made


@lru_cache(maxsize=1)
def _families() -> tuple[str, ...]:
    """Return a dictionary of each family, small ones first: others are its beginnings or go on."""
    chosen: dict[str, str] = {}
    for name in sorted(DICTIONARIES, key=_size_of):
        # Comparing with a thousand markers takes most of the time, and few boards have as many.
        if _family_of(name) not in chosen or _size_of(name) <= _COMMON:
            chosen[_family_of(name)] = name
    return tuple(sorted(chosen.values(), key=lambda name: (_size_of(name), name)))


def _family_of(dictionary: str) -> str:
    """Return what dictionaries of the same markers share: 36h11 and 36H11 are one."""
    stem, _, last = dictionary.lower().rpartition("_")
    return stem if last.isdigit() else dictionary.lower()


def _size_of(dictionary: str) -> int:
    return len(dictionary_of(dictionary).bytesList)


def _read(grey: NDArray[np.uint8], dictionary: str, border_bits: int) -> _Read:
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    detector = cv2.aruco.ArucoDetector(dictionary_of(dictionary), parameters)
    found: tuple[Any, ...] = detector.detectMarkers(grey)
    corners, ids, _ = found
    if ids is None or len(ids) == 0:
        return _Read(np.zeros(0, np.intp), np.zeros((0, 4, 2)))
    numbers, once = np.unique(np.asarray(ids, np.intp).ravel(), return_index=True)
    return _Read(numbers, np.asarray(corners, np.float64).reshape(-1, 4, 2)[once] + 0.5)


def _first_id(board: _Known, lowest: int, highest: int) -> int:
    """Return the number of the first marker: as described, if those seen allow it."""
    if isinstance(board, Charuco):
        count = board.columns * board.rows // 2
    elif isinstance(board, AprilGrid):
        count = board.columns * board.rows
    else:
        return 0 if lowest < _MOST_COLUMNS else lowest
    if board.first_id <= lowest and highest < board.first_id + count:
        return board.first_id
    return lowest


def _layout(board: _Known, read: _Read) -> _Layout | None:
    """Return the layout that the middles of markers fit best; None where they fit none."""
    first_id = _first_id(board, int(read.ids.min()), int(read.ids.max()))
    numbers = read.ids - first_id
    middles_px = _middles(read.quads_px)
    sides_px = np.linalg.norm(read.quads_px - np.roll(read.quads_px, 1, axis=1), axis=-1)
    allowed_px = _OFF * float(np.median(sides_px))
    best: _Layout | None = None
    for is_charuco in (True, False):
        for columns in range(3 if is_charuco else 1, _MOST_COLUMNS):
            for is_offset in (True, False) if is_charuco else (False,):
                plane = _places(numbers, is_charuco, columns, is_offset)
                if np.linalg.matrix_rank(plane - plane.mean(axis=0), tol=0.5) < 2:
                    continue
                matrix, mask = cv2.findHomography(
                    plane, middles_px, cv2.RANSAC, allowed_px, maxIters=_TRIALS
                )
                if matrix is None:
                    continue
                fits = mask.ravel() > 0
                if fits.sum() < max(_LEAST_MARKERS, _SHARE * len(fits)):
                    continue
                side = _side(np.asarray(matrix, np.float64), read.quads_px[fits], is_charuco)
                if side is None or (best is not None and fits.sum() <= best.count):
                    continue
                best = _Layout(is_charuco, columns, first_id, is_offset, side, int(fits.sum()))
    return best


def _middles(quads: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where the diagonals of quads (M, 4, 2) cross: the middles, in any perspective."""
    across, other = quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]
    between = quads[:, 1] - quads[:, 0]
    turned = across[:, 0] * other[:, 1] - across[:, 1] * other[:, 0]
    share = (between[:, 0] * other[:, 1] - between[:, 1] * other[:, 0]) / turned
    return np.asarray(quads[:, 0] + share[:, None] * across)


def _places(
    numbers: NDArray[np.intp], is_charuco: bool, columns: int, is_offset: bool
) -> NDArray[np.float64]:
    """Return the middles (M, 2) of markers on a board, in columns; y runs down."""
    if not is_charuco:  # tags are counted from the bottom
        return np.column_stack([numbers % columns, -(numbers // columns)]).astype(np.float64)
    # Two rows of a ChArUco board have as many markers as one has squares.
    pair, within = np.divmod(numbers, columns)
    in_first = columns // 2 if is_offset else (columns + 1) // 2
    is_second = within >= in_first
    start = np.where(is_second != is_offset, 1, 0)
    x = start + 2 * np.where(is_second, within - in_first, within)
    return np.column_stack([x, 2 * pair + is_second]).astype(np.float64)


def _side(
    matrix: NDArray[np.float64], quads_px: NDArray[np.float64], is_charuco: bool
) -> float | None:
    """Return the side of markers in columns; None if they do not stand upright on the board."""
    try:
        inverse = np.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        return None
    flat = quads_px.reshape(-1, 2) @ inverse[:, :2].T + inverse[:, 2]
    quads = (flat[:, :2] / flat[:, 2:]).reshape(-1, 4, 2)
    # OpenCV lists a marker from its top left clockwise; Kalibr prints tags upside down.
    upright = 1.0 if is_charuco else -1.0
    right = upright * (quads[:, 1] - quads[:, 0] + quads[:, 2] - quads[:, 3]) / 2
    down = upright * (quads[:, 3] - quads[:, 0] + quads[:, 2] - quads[:, 1]) / 2
    side = float(np.median(np.concatenate([right[:, 0], down[:, 1]])))
    skew = float(np.median(np.abs(np.concatenate([right[:, 1], down[:, 0]]))))
    return side if 0.1 < side < 1.0 and skew < 0.2 * side else None


def _rows(board: _Known, layout: _Layout, count: int) -> list[int]:
    """Return the numbers of rows that a board of so many markers or more may have, likely first."""
    per_row = layout.columns / 2 if layout.is_charuco else layout.columns
    least = int(np.ceil(count / per_row - 1e-9))
    while layout.is_charuco and layout.columns * least // 2 < count:
        least += 1
    likely = []
    if layout.columns == board.columns:
        likely.append(board.rows)
    if layout.columns == board.rows:
        likely.append(board.columns)
    rows = [number for number in likely if number >= least]  # the rest may be out of view
    return list(dict.fromkeys([*rows, least, least + 1]))


def _not_ended(
    layout: _Layout, read: _Read, rows_tried: list[int], size: tuple[int, ...]
) -> list[int]:
    """Return numbers of rows without those of which the picture shows that they are too many.

    Markers of further rows would be in the picture, and none of them is read.
    """
    numbers = read.ids - layout.first_id
    places = _places(numbers, layout.is_charuco, layout.columns, layout.is_offset)
    matrix, _ = cv2.findHomography(places, _middles(read.quads_px), cv2.RANSAC, 5.0)
    if matrix is None:
        return rows_tried
    left = []
    for rows in rows_tried:
        count = layout.columns * rows // (2 if layout.is_charuco else 1)
        further = np.arange(int(numbers.max()) + 1, count, dtype=np.intp)
        flat = _places(further, layout.is_charuco, layout.columns, layout.is_offset)
        mapped = flat @ matrix[:, :2].T + matrix[:, 2]
        ahead = mapped[:, 2] > 0
        at = mapped[ahead, :2] / mapped[ahead, 2:]
        margin = _MARGIN * np.array(size[1::-1])
        in_picture = ((at > margin) & (at < np.array(size[1::-1]) - margin)).all(axis=1)
        if in_picture.sum() < _LEAST_MARKERS - 1:
            left.append(rows)
    return left or rows_tried


def _made(board: _Known, layout: _Layout, family: str, rows: int) -> Charuco | AprilGrid | None:
    """Return the board of a layout, with the lengths of the one described."""
    count = layout.columns * rows // (2 if layout.is_charuco else 1)
    dictionary = _dictionary(board, family, layout.first_id + count)
    if dictionary is None:
        return None
    try:
        if layout.is_charuco:
            square_m = (
                board.square_m / layout.side if isinstance(board, AprilGrid) else (board.square_m)
            )
            marker_m = _round_length(layout.side * square_m)
            if isinstance(board, Charuco) and _is_same(marker_m, board.marker_m):
                marker_m = board.marker_m
            return Charuco(
                layout.columns,
                rows,
                _round_length(square_m) if isinstance(board, AprilGrid) else square_m,
                marker_m,
                dictionary,
                None,
                layout.first_id,
            )
        # Where a grid was taken for another kind, what was measured is taken for the tag.
        tag_m = board.marker_m if isinstance(board, Charuco) else board.square_m
        gap_m = _round_length(tag_m * (1.0 / layout.side - 1.0))
        if isinstance(board, AprilGrid) and abs(gap_m - board.gap_m) < _SAME_LENGTH * tag_m:
            gap_m = board.gap_m
        return AprilGrid(layout.columns, rows, tag_m, gap_m, dictionary, layout.first_id)
    except CalibrationError:
        return None  # no such board can be printed


def _dictionary(board: _Known, family: str, count: int) -> str | None:
    """Return the smallest dictionary of a family that has so many markers; as described, if so."""
    said = getattr(board, "dictionary", "")
    names = [name for name in DICTIONARIES if _family_of(name) == _family_of(family)]
    large_enough = [name for name in names if _size_of(name) >= count]
    if said in large_enough:
        return str(said)
    # Of two names of one, the one in small letters, as its authors write it.
    return min(large_enough, key=lambda name: (_size_of(name), name.swapcase()), default=None)


def _is_same(one_m: float, other_m: float) -> bool:
    return abs(one_m - other_m) <= _SAME_LENGTH * max(one_m, other_m)


def _round_length(length_m: float) -> float:
    """Return a measured length as a person would have chosen it, to within what is measured."""
    for digits in (1, 2, 3):
        rounded = float(f"{length_m:.{digits}g}")
        if abs(rounded - length_m) < 0.01 * length_m:
            return rounded
    return length_m


def _measured(
    board: _Known,
    seen: Charuco | AprilGrid,
    grey: NDArray[np.uint8],
    corners: NDArray[np.float64],
) -> Charuco | AprilGrid:
    """Return a board with the size of its markers measured by the corners that were found.

    The outline of a marker, as it is read, is small by a pixel or so.
    """
    if isinstance(seen, AprilGrid):
        gap_m = _gap_m(seen, corners)
        # Corners of tags are found a little off where the gap is not the true one.
        closer = replace(seen, gap_m=gap_m).detect(grey, "usual").corners
        if closer is not None:
            gap_m = _gap_m(replace(seen, gap_m=gap_m), closer)
        if isinstance(board, AprilGrid) and _is_same(seen.tag_m + gap_m, board.tag_m + board.gap_m):
            gap_m = board.gap_m
        return replace(seen, gap_m=_round_length(gap_m))
    known = np.isfinite(corners[:, 0])
    img_from_board = fit_homography(
        seen.points_board[known][:, :2] / seen.sides_m, corners[known] - 0.5
    )
    if img_from_board is None:
        return seen
    margin = _margin(seen, grey, img_from_board)
    if margin is None:
        return seen
    if isinstance(board, AprilGrid):  # its markers were measured, its squares were not
        square_m = _round_length(board.tag_m / (1.0 - 2.0 * margin))
        return replace(seen, square_m=square_m, marker_m=board.tag_m)
    marker_m = (1.0 - 2.0 * margin) * seen.square_m
    if isinstance(board, Charuco) and _is_same(marker_m, board.marker_m):
        return replace(seen, marker_m=board.marker_m)
    return replace(seen, marker_m=_round_length(marker_m))


def _gap_m(board: AprilGrid, corners: NDArray[np.float64]) -> float:
    """Return the gap between tags that fits corners best, which were found without knowing it."""
    known = np.isfinite(corners[:, 0])
    misses: dict[float, float] = {}
    for gap_m in board.gap_m * np.geomspace(0.5, 1.5, 111):
        if gap_m > board.tag_m:
            break
        points = replace(board, gap_m=float(gap_m)).points_board[known][:, :2]
        img_from_board = fit_homography(points, corners[known])
        if img_from_board is not None:
            mapped = points @ img_from_board[:, :2].T + img_from_board[:, 2]
            off_px = mapped[:, :2] / mapped[:, 2:] - corners[known]
            misses[float(gap_m)] = float((off_px**2).sum())
    return min(misses, key=misses.__getitem__, default=board.gap_m)


def _margin(
    board: Charuco, grey: NDArray[np.uint8], img_from_board: NDArray[np.float64]
) -> float | None:
    """Return how far markers are from the edges of their squares, in squares; None if unknown.

    Squares are looked at along lines from each edge towards the middle: white turns to black where
    the marker begins.
    """
    inward, beside = np.linspace(0.02, 0.45, 44), np.linspace(0.35, 0.65, 16)
    near, far = np.meshgrid(inward, beside)
    lines = []
    for column in range(-1, board.columns - 1):
        for row in range(-1, board.rows - 1):
            for x, y in ((near, far), (1 - near, far), (far, near), (far, 1 - near)):
                places = np.stack([x + column, y + row, np.ones_like(x)], axis=-1)
                at = places @ img_from_board.T
                at = (at[..., :2] / at[..., 2:]).astype(np.float32)
                if (at >= 0).all() and (at <= np.subtract(grey.shape[::-1], 1)).all():
                    sampled = cv2.remap(
                        grey, at[..., 0].copy(), at[..., 1].copy(), cv2.INTER_LINEAR
                    )
                    lines.append(sampled.mean(axis=0))
    if not lines:
        return None
    outer = len(inward) // 2
    has_edge = np.ptp(np.array(lines)[:, :outer], axis=1) > 0.5 * np.ptp(lines)
    if not has_edge.any():
        return None  # black squares only
    line = np.array(lines)[has_edge].mean(axis=0)
    top = int(line[:outer].argmax())
    middle = (line[top] + line[top:outer].min()) / 2
    below = top + int(np.argmax(line[top:outer] < middle))
    if below == top:
        return None
    share = (line[below - 1] - middle) / (line[below - 1] - line[below])
    return float(inward[below - 1] + share * (inward[below] - inward[below - 1]))


# --- Plain boards -----------------------------------------------------------------------------


def _seen_chessboard(board: _Known, grey: NDArray[np.uint8]) -> Chessboard | None:
    """Return the chessboard that a picture shows, by how many corners it has; None if it has none.

    OpenCV's search for boards of any size finds some in part, and what goes on beyond is added. It
    misses some that a search for the right size finds: the usual mistakes are tried.
    """
    tried = []
    if min(grey.shape) > 40:
        found, _, meta = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), cv2.CALIB_CB_LARGER)
        if found and meta.size >= _LEAST_CORNERS:
            tried.append(meta.shape[::-1])
    if not isinstance(board, Chessboard):
        tried.append((board.columns, board.rows))
    tried += [
        (board.columns + columns, board.rows + rows)
        for columns, rows in ((-1, -1), (1, 1), (-1, 0), (0, -1), (1, 0), (0, 1))
    ]
    for columns, rows in tried:
        if min(columns, rows) < 3:
            continue
        other = Chessboard(columns, rows, board.square_m)
        corners = other.detect(grey, "quick")
        if corners.corners is None:
            continue
        count = columns + corners.beyond[0], rows + corners.beyond[1]
        # A chessboard is found whichever way it lies; columns are told as they were.
        if (count[0] < count[1]) != (board.columns < board.rows):
            count = count[::-1]
        if not isinstance(board, Chessboard) or count != (board.columns, board.rows):
            return Chessboard(*count, board.square_m)
    return None


# --- Said -------------------------------------------------------------------------------------


def _told(board: Board, seen: Board) -> str:
    """Return what board is seen, and what to change in the description of another."""
    said, changed = _keys(board), _changed(board, seen)
    if isinstance(seen, Chessboard):
        hint = ""
        if isinstance(board, Chessboard) and (
            (board.columns - seen.columns, board.rows - seen.rows) == (1, 1)
        ):
            hint = " (columns and rows count the corners inside the board, not its squares)"
        return (
            f"a chessboard of {seen.columns}x{seen.rows} inner corners is seen{hint}: say "
            f"{_listed(changed)}" + (" if it has no markers" if isinstance(board, Charuco) else "")
        )
    if len(changed) == 1 and "dictionary" in changed:
        what = f"markers of {changed['dictionary']} are seen"
    else:
        what = f"{seen} is seen"
        if isinstance(seen, Charuco | AprilGrid) and said.get("dictionary") != seen.dictionary:
            what = f"{seen}, of {seen.dictionary}, is seen"
    told = f"{what}: say {_listed(changed)}"
    if isinstance(seen, AprilGrid) and "gap_mm" in changed:
        told += f" (or tag_spacing = {seen.gap_m / seen.tag_m:.3g} in place of gap_mm)"
    return told


def _changed(board: Board, seen: Board) -> dict[str, str | int | float]:
    """Return what a session says of a board that is seen and does not say of the other."""
    said = _keys(board)
    return {key: value for key, value in _keys(seen).items() if said.get(key) != value}


def _keys(board: Board) -> dict[str, str | int | float]:
    """Return what a session says of a board; lengths in mm."""
    if isinstance(board, Chessboard):
        return {"kind": "chessboard", "columns": board.columns, "rows": board.rows}
    if isinstance(board, Charuco):
        return {
            "kind": "charuco",
            "columns": board.columns,
            "rows": board.rows,
            "square_mm": _mm(board.square_m),
            "marker_mm": _mm(board.marker_m),
            "dictionary": board.dictionary,
            "first_id": board.first_id,
        }
    assert isinstance(board, AprilGrid)
    return {
        "kind": "aprilgrid",
        "columns": board.columns,
        "rows": board.rows,
        "tag_mm": _mm(board.tag_m),
        "gap_mm": _mm(board.gap_m),
        "dictionary": board.dictionary,
        "first_id": board.first_id,
    }


def _mm(length_m: float) -> float:
    return round(1000.0 * length_m, 4)


def _listed(keys: dict[str, str | int | float]) -> str:
    return ", ".join(
        f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value:g}"
        for key, value in keys.items()
    )
