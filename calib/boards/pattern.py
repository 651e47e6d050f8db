"""What a pattern of markers is, and where its points are in a picture that shows some of them."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.symmetry import (
    SYMMETRY_BLUR_PX,
    SYMMETRY_REACH,
    move_to_symmetry,
    symmetry_offsets,
)
from hybridve.calib.boards.target import fit_homography

#: Points are predicted from this many known ones, the nearest; corners of markers, which may be off
#: by many pixels, only decide what refined points leave open.
_ANCHORS = 12
_MARKER_WEIGHT = 1e-4

#: A cell of the frontal view has this many pixels, those of the image at most twice as many: it is
#: reduced, and blurred by so many of its pixels as a pixel of the view covers.
CELL_PX = (20.0, 50.0)
COVER_BLUR = 0.4

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
LEAST_POINTS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Pattern:
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
    ids_beyond, quads_beyond : (B,) intp, (B, 4, 2) float64
        The same of the rows that would come before the first and after the last, if there were
        more: where they are seen, the board is larger, or counted from another number.
    doubt : str
        What may be the matter where markers are read and no points are found at them.
    steady : (N, 2 K) bool, optional
        Which of these places are printed as the point is: those in markers are not, which may be
        off from it by the rounding of a printed picture. None: all.
    """

    label: str
    points: NDArray[np.float64]
    ids: NDArray[np.intp]
    quads: NDArray[np.float64]
    reach: float
    signs: NDArray[np.float64]
    border_bits: int
    ids_beyond: NDArray[np.intp]
    quads_beyond: NDArray[np.float64]
    doubt: str = ""
    steady: NDArray[np.bool_] | None = None


def around(
    points: NDArray[np.float64], sign_at: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return what is printed around points: (N, 2 K) of ``sign_at`` of places (P, 2) in cells."""
    offsets = symmetry_offsets(1.0)
    places = points[:, None] + np.concatenate([offsets, -offsets])
    return sign_at(places.reshape(-1, 2)).reshape(places.shape[:2])


@dataclass(frozen=True, slots=True, eq=False)
class Linked:
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

    def scaled(self, scale: NDArray[np.float64]) -> "Linked":
        """Return the same in an image that is `scale` (2,) times as wide and high."""
        return Linked(self.plane, self.pixels * scale, self.cell_px * float(scale.mean()))


def homographies(
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


def mapped(matrices: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Map points (B, K, 2) by homographies (B, 3, 3); behind the horizon, to infinity."""
    mapped = points @ matrices[:, :, :2].transpose(0, 2, 1) + matrices[:, None, :, 2]
    depth = np.where(mapped[..., 2:] > 1e-9, mapped[..., 2:], np.nan)
    return np.asarray(np.nan_to_num(mapped[..., :2] / depth, nan=np.inf))


def find_points_in(
    grey: NDArray[np.float32], pattern: Pattern, linked: Linked
) -> tuple[NDArray[np.float64] | None, bool]:
    """Return the points that are found (N, 2), NaN where none is, and whether some were dropped."""
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
    if len(points) < LEAST_POINTS:
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
    pattern: Pattern,
    linked: Linked,
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
    left_px = pixels if flat is None else pixels - mapped(flat[None], plane[None])[0]
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


def _predict_from_markers(linked: Linked, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return quadratic maps (P, 6, 2) near the homographies that the nearest markers give.

    Corners of markers are off by many pixels where black squares touch them; a quadratic map has
    too much freedom for them.
    """
    apart = np.linalg.norm(points[:, None] - linked.plane, axis=-1)
    nearest = np.argsort(apart, axis=1, kind="stable")[:, :_ANCHORS]
    matrices = homographies(linked.plane[nearest], linked.pixels[nearest])
    ticks = np.linspace(-1.0, 1.0, 5)
    around = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    at = mapped(matrices, points[:, None] + around)
    at = np.clip(at, -1e5, 1e5)  # places behind the horizon are far outside the image
    return np.asarray(np.linalg.pinv(_terms(around)) @ at)


def _drop_rough(pattern: Pattern, linked: Linked, found: NDArray[np.float64]) -> None:
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
    pattern: Pattern,
    linked: Linked,
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
    cell = float(np.clip(np.ceil(1.2 * linked.cell_px), *CELL_PX))
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
    counts = (ahead != 0) & (behind != 0)
    if pattern.steady is not None:
        counts &= np.logical_and(*np.split(pattern.steady[wanted], 2, axis=1))
    weights = counts.astype(np.float64)

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
