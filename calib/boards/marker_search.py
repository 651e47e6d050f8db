"""Markers looked for in a picture, and joined to patterns."""

from collections.abc import Iterator
from functools import lru_cache
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Detection, Effort
from hybridve.calib.boards.pattern import (
    CELL_PX,
    COVER_BLUR,
    LEAST_POINTS,
    Linked,
    Pattern,
    find_points_in,
    homographies,
    mapped,
)
from hybridve.calib.boards.target import fit_homography, grey_of

_Grey = TypeVar("_Grey", np.uint8, np.float32)

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


#: A group of markers that others contradict is the board if it has this share of those read: every
#: other row of a board whose markers are counted from a wrong number lies as described.
_LEAST_SHARE = 0.6


#: So many markers are no accident: in the rows that would come before the first or after the last,
#: or together in another place than the rest of the board.
_NO_ACCIDENT = 3

#: They lie where such rows would if they are this near, of their sides.
_BEYOND_TOLERANCE = 0.35

#: Places beyond the board are predicted from this many corners of its markers, the nearest.
_NEAREST = 24


@lru_cache(maxsize=8)
def dictionary_of(name: str) -> Any:
    """Return one of the families of markers that OpenCV knows."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def detect_pattern(
    image: NDArray[Any], patterns: list[Pattern], dictionary: str, effort: Effort
) -> Detection:
    """Return the points of the pattern that is best seen of some that a board may show."""
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
            tried[-1] = f"{way} ({said}, fewer than {LEAST_POINTS} points at them{pattern.doubt})"
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


def _read(
    image: NDArray[np.uint8],
    exact: NDArray[np.float64],
    patterns: list[Pattern],
    dictionary: str,
) -> tuple[Pattern | None, Linked | None, str]:
    """Return the pattern that the markers of an image fit, those that do, and what there was."""
    best: tuple[int, Pattern, NDArray[np.intp], NDArray[np.float64]] | None = None
    most, border_bits = 0, 0
    for pattern in patterns:
        if pattern.border_bits != border_bits:
            if best is not None:
                break
            border_bits = pattern.border_bits
            members, quads_px, ids_beyond, beyond_px = _read_markers(image, dictionary, pattern)
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
    further = _go_on(pattern, members, found_px, ids_beyond, beyond_px)
    if len(further) >= _NO_ACCIDENT:
        return (
            None,
            None,
            f"{said}, which go on beyond it (marker {further[0]} is seen in the next row)",
        )
    quads, quads_px = pattern.quads[members], (found_px + 0.5) / exact
    plane, pixels = quads.reshape(-1, 2), quads_px.reshape(-1, 2)
    sides, sides_px = (
        np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
        for corners in (quads, quads_px)
    )
    cell_px = float((sides_px / sides).max())
    return pattern, Linked(plane, pixels, cell_px), said


@lru_cache(maxsize=16)
def _own_dictionary(name: str, first_id: int, count: int) -> Any:
    # Comparing with all markers of a large dictionary takes longer than all other steps. Those of
    # other boards differ from each of these by more bits than are corrected.
    whole = dictionary_of(name)
    own = np.ascontiguousarray(whole.bytesList[first_id : first_id + count])
    return cv2.aruco.Dictionary(own, whole.markerSize, whole.maxCorrectionBits)


def _read_markers(
    image: NDArray[np.uint8], dictionary: str, pattern: Pattern
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.intp], NDArray[np.float64]]:
    """Return the board's markers in an image: indices (M,), corners (M, 4, 2), centres at 0.

    And of those beyond it numbers (B,) and corners (B, 4, 2).
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = pattern.border_bits
    parameters.detectInvertedMarker = True
    parameters.minMarkerPerimeterRate = min(0.03, 4 * _MARKER_PX / max(image.shape))
    none = np.zeros(0, np.intp), np.zeros((0, 4, 2))
    if min(image.shape) < 4 * _MARKER_PX:
        return *none, *none
    looked_for = np.concatenate([pattern.ids, pattern.ids_beyond])
    first = int(looked_for.min())
    own = _own_dictionary(dictionary, first, int(looked_for.max()) - first + 1)
    detector = cv2.aruco.ArucoDetector(own, parameters)
    found: tuple[Any, ...] = detector.detectMarkers(image)
    corners, indices, _ = found
    if indices is None or len(indices) == 0:
        return *none, *none
    ids = np.asarray(indices, np.intp).ravel() + first
    quads_px = np.asarray(corners, np.float64).reshape(-1, 4, 2)
    members = ids - int(pattern.ids[0])
    inside = (members >= 0) & (members < len(pattern.ids))
    return members[inside], quads_px[inside], ids[~inside], quads_px[~inside]


def _go_on(
    pattern: Pattern,
    members: NDArray[np.intp],
    quads_px: NDArray[np.float64],
    ids: NDArray[np.intp],
    ids_px: NDArray[np.float64],
) -> list[int]:
    """Return which markers lie in the rows that would come before the first or after the last."""
    plane = pattern.quads[members].reshape(-1, 2)
    pixels = quads_px.reshape(-1, 2)
    places = dict(zip(pattern.ids_beyond.tolist(), pattern.quads_beyond, strict=True))
    further = []
    for number, quad_px in zip(ids.tolist(), ids_px, strict=True):
        quad = places.get(number)
        if quad is None:
            continue
        nearest = np.argsort(np.linalg.norm(plane - quad.mean(axis=0), axis=1))[:_NEAREST]
        img_from_plane = fit_homography(plane[nearest], pixels[nearest])
        if img_from_plane is None:
            continue
        side_px = float(np.linalg.norm(quad_px - np.roll(quad_px, 1, axis=0), axis=1).mean())
        off_px = np.linalg.norm(mapped(img_from_plane[None], quad[None])[0] - quad_px, axis=1)
        if off_px.mean() < _BEYOND_TOLERANCE * side_px:
            further.append(number)
    return sorted(set(further))


def _link(
    pattern: Pattern, members: NDArray[np.intp], quads_px: NDArray[np.float64]
) -> tuple[NDArray[np.intp], int]:
    """Return the largest group of markers that lie to each other as on the board.

    Compared are markers that are neighbours on the board, where no lens bends it. Returns the
    indices into `members`, and how many pairs agree; none if too many markers contradict the group,
    as on another board of the same dictionary, or on one that is counted from another number.
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
    off_px = np.linalg.norm(mapped(homographies(plane, pixels), plane) - pixels, axis=-1)
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
    elsewhere = against & ~inside
    contrary = int(elsewhere.sum())
    if contrary and np.bincount(group[elsewhere]).max() >= _NO_ACCIDENT:
        return nobody  # together in another place: the rows begin with another number
    is_most = inside.sum() >= _LEAST_SHARE * len(np.unique(members))
    if contrary > inside.sum() or (contrary and not is_most):
        return nobody
    # A number that was read twice is taken where more neighbours agree.
    votes = np.bincount(np.concatenate([first[agree], second[agree]]), minlength=len(members))
    order = np.argsort(-votes * inside, kind="stable")
    _, once = np.unique(members[order], return_index=True)
    chosen = np.sort(order[once])
    return chosen[inside[chosen]], int((agree & inside[first]).sum())


def _find_points(
    grey: NDArray[np.float32], pattern: Pattern, linked: Linked
) -> tuple[NDArray[np.float64] | None, bool]:
    """Return points (N, 2), NaN where not seen, and whether black and white are exchanged."""
    reduced = _scaled(grey, 1.0 / max(1, int(1.2 * linked.cell_px / CELL_PX[1])))
    exact = np.array(reduced.shape[::-1]) / grey.shape[::-1]
    linked = linked.scaled(exact)
    coarser = linked.cell_px / CELL_PX[1]
    if coarser > 1.0:
        reduced = np.asarray(cv2.GaussianBlur(reduced, (0, 0), COVER_BLUR * coarser), np.float32)
    found, inverted = find_points_in(reduced, pattern, linked)
    return (None if found is None else found / exact), inverted
