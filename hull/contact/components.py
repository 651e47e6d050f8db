"""The connected volumes of a hull, and which of them must hold something real.

A visual hull holds all that could be there: where rays of different things cross, volumes arise
that hold nothing (phantom volumes). What can be proved is the contrary. Let the silhouettes be
right: an object pixel's ray meets something real, and whatever is real lies in the hull (so it
stands where as many cameras see it as the hull asks for). Then an object pixel whose ray meets one
volume of the hull and no other proves that this volume holds something real. A volume of which
every pixel has another volume behind or before it may be a phantom; it need not be one.

Silhouettes are sampled at the centres of pixels, so a real thing can stick out of their hull by a
part of a pixel. Everything here is therefore asked of the hull whose silhouettes are grown by one
pixel (`grown`). That holds whatever is real, if it is not thinner than a pixel.

Volumes are connected cells: space is cut into cubes, coarse to fine, and a cube is kept unless it
is proved free (`hybridve.hull.query.cells`). What is connected in the hull
is connected in cells, so volumes that are told apart are apart; two that come nearer to each other
than some two cells may be told as one.

What "real" says, and what not
------------------------------
The proof is of a volume as a whole: somewhere in it is something real. Where in it is not told. A
phantom that a thin neck joins to a person, be it of the hull itself, of the pixel that silhouettes
are grown by, or of a cell, is of one volume with the person, and that is proved real, rightly; a
contact with the phantom is then no contact with the person, and phantoms of litres were seen to be
joined so. For a contact "real" is therefore an estimate, and only "unsure" is a warning. How far
from a contact something real may be at most is bounded elsewhere (`hybridve.hull.contact.bulge`).

References
----------
Miller and Hilton, *Safe hulls*, 4th European Conference on Visual Media Production, 2007.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hybridve.hull.query.bounds import FREE, FULL
from hybridve.hull.query.cells import cube_bounds, cube_verdicts, make_cell_frame
from hybridve.hull.query.silhouettes import Hull, Views, beside, make_hull
from hybridve.hull.query.walk import contains_few, spans_in_hull

#: By how much silhouettes are grown: a thing's outline is within a pixel of its sampled one.
GROWN_PX = 1

#: Side of the cells that volumes are made of.
CELL_M = 0.02

#: Cells are looked for as far as so many times the farthest camera's distance from the middle.
_REACH = 2.0

#: Twice as many cells along each side from level to level; the coarsest are 2^7 cells wide.
_LEVELS = 7

#: Cubes of one level, and cells of the box around all volumes, at most.
_MOST_OPEN, _MOST_CELLS = 1 << 18, 1 << 22

#: A cube nearer than this to a camera's plane is not projected.
_NEAR_M = 1e-3

#: Coverage is drawn in blocks of so many pixels a side.
_BLOCK_PX = 4

#: To prove one volume, points are sought in at most so many of its cells, as many along each edge
#: of a cell, and so many rays of a camera are walked: in right silhouettes the first ray does.
_MOST_CELLS_TRIED, _CELL_POINTS, _MOST_RAYS = 32, 4, 4

#: As far as a ray is walked.
FAR_M = 1e3

#: What holds a point, where no volume does.
NOWHERE = -1


def grown(hull: Hull, by_px: int = GROWN_PX) -> Hull:
    """Return the hull of silhouettes that are larger by some pixels all round (and diagonally)."""
    return make_hull(hull.views, _grown_masks(hull, by_px))


def grown_beside(hull: Hull) -> tuple[Hull, Hull]:
    """Return the hull of silhouettes grown by `GROWN_PX`, and the first with the images of both.

    See `hybridve.hull.query.silhouettes.beside`.
    """
    return beside(hull, _grown_masks(hull, GROWN_PX))


def _grown_masks(hull: Hull, by_px: int) -> list[NDArray[np.uint8]]:
    around = np.ones((2 * by_px + 1, 2 * by_px + 1), np.uint8)
    return [
        np.asarray(cv2.dilate(hull.mask(camera), around), np.uint8)
        for camera in range(len(hull.views))
    ]


def pixel_rays(
    views: Views, camera: int, pixels: list[tuple[int, int]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the rays of pixels' centres: where they begin (3,), metres, and unit vectors (N, 3).

    World frame; pixels are columns and rows.
    """
    matrix = views.img_from_local[camera]
    inverse = np.linalg.inv(matrix[:, :3])
    column, row = np.array(pixels, np.float64).reshape(-1, 2).T[:, :, None] + 0.5
    # Sums written out: a product of matrices is rounded as its size makes it.
    directions = inverse[:, 0] * column + inverse[:, 1] * row + inverse[:, 2]
    directions /= np.sqrt((directions**2).sum(axis=1))[:, None]
    return views.origin_world - inverse @ matrix[:, 3], directions


@dataclass(frozen=True, slots=True, eq=False)
class Volumes:
    """The connected volumes of one frame's hull.

    Attributes
    ----------
    hull : Hull
        The hull that was cut into cells, with silhouettes already grown.
    cell_m : float
        Side of a cell, metres.
    first : (3,) int64
        Which cell ``number[0, 0, 0]`` is: cell i spans i * cell_m to (i + 1) * cell_m along each
        axis of the local frame of the views.
    number : (X, Y, Z) int32
        Which volume each cell belongs to, 1 for the first; 0 where nothing is.
    """

    hull: Hull
    cell_m: float
    first: NDArray[np.int64]
    number: NDArray[np.int32]

    def __len__(self) -> int:
        return int(self.number.max(initial=0))

    def at(self, points_world: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the volumes that hold points, (N, 3) metres to (N,), from 0; else `NOWHERE`."""
        local = (points_world - self.hull.views.origin_world) / self.cell_m
        limit = 2.0**40  # beyond any cell, and still a number that an index can be
        cell = np.floor(np.clip(np.nan_to_num(local, nan=limit), -limit, limit)).astype(np.int64)
        cell -= self.first
        is_within = np.asarray(((cell >= 0) & (cell < self.number.shape)).all(axis=1))
        x, y, z = np.where(is_within[:, None], cell, 0).T
        found = np.full(len(points_world), NOWHERE, np.int64)
        if self.number.size:
            found = np.where(is_within, self.number[x, y, z].astype(np.int64) - 1, NOWHERE)
        return found

    def surface_local(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the cells that have an empty neighbour: centres (N, 3) and their volumes (N,).

        Metres, local frame. Whatever ray meets a volume from outside meets one of these.
        """
        taken = np.pad(np.asarray(self.number > 0), 1)
        middle = slice(1, -1)
        within = np.asarray(self.number > 0)
        for side in (slice(None, -2), slice(2, None)):
            within &= taken[side, middle, middle] & taken[middle, side, middle]
            within &= taken[middle, middle, side]
        index = np.argwhere((self.number > 0) & ~within)
        centers = np.ascontiguousarray((index + self.first + 0.5) * self.cell_m)
        return centers, self.number[tuple(index.T)].astype(np.int64) - 1


def connected_volumes(grown_hull: Hull, cell_m: float = CELL_M) -> Volumes:
    """Return the connected volumes of a hull, in cells that touch at a face, an edge or a corner.

    Parameters
    ----------
    grown_hull : Hull
        As `grown` returns it.
    cell_m : float
        Side of a cell, metres. Cells are twice, four times, .. as wide where there would be too
        many of them: around a hull that fills a hall.

    Raises
    ------
    ValueError
        If the cells have no size.
    """
    if not cell_m > 0:
        raise ValueError(f"cell_m is {cell_m}, expected a positive length")
    blocks = [(cells, side) for cells, side in _occupied(grown_hull, cell_m) if len(cells)]
    if not blocks:
        nothing = np.zeros((0, 0, 0), np.int32)
        return Volumes(grown_hull, cell_m, np.zeros(3, np.int64), nothing)
    first = np.min([cells.min(axis=0) for cells, _ in blocks], axis=0)
    last = np.max([(cells + side).max(axis=0) for cells, side in blocks], axis=0)
    unit = 1
    while np.prod(-(-last // unit) - first // unit, dtype=np.float64) > _MOST_CELLS:
        unit *= 2
    first, last = first // unit, -(-last // unit)
    is_taken = np.zeros(last - first, np.bool_)
    for cells, side in blocks:
        width = max(1, side // unit)  # both are powers of two, and blocks begin at multiples
        offsets = np.indices((width, width, width)).reshape(3, -1)
        x, y, z = ((cells // unit - first)[:, :, None] + offsets).transpose(1, 0, 2).reshape(3, -1)
        is_taken[x, y, z] = True
    number, _ = ndimage.label(is_taken, structure=np.ones((3, 3, 3)))
    return Volumes(grown_hull, cell_m * unit, first, np.asarray(number, np.int32))


def _occupied(hull: Hull, cell_m: float) -> list[tuple[NDArray[np.int64], int]]:
    """Return cubes that are not proved free: first cells (N, 3), and how many cells wide."""
    centers_local = hull.views.centers_local()
    reach_m = _REACH * float(np.linalg.norm(centers_local, axis=1).max())
    side = 1 << _LEVELS
    most = max(1, int(np.ceil(reach_m / (side * cell_m))))
    index = np.indices((2 * most, 2 * most, 2 * most)).reshape(3, -1).T
    cells = (index - most) * side
    octants = np.indices((2, 2, 2)).reshape(3, -1).T
    asked = make_cell_frame(hull, hull.views.origin_world, most * side * cell_m, _NEAR_M)
    blocks = []
    while True:
        centers = np.ascontiguousarray((cells + 0.5 * side) * cell_m)
        verdicts = cube_verdicts(centers, 0.5 * side * cell_m, asked)
        is_free, is_full = verdicts == FREE, verdicts == FULL
        if side == 1:
            blocks.append((cells[~is_free], 1))
            return blocks
        blocks.append((cells[is_full], side))
        is_open = ~(is_free | is_full)
        if 8 * np.count_nonzero(is_open) > _MOST_OPEN:
            blocks.append((cells[is_open], side))
            return blocks
        side //= 2
        cells = (cells[is_open, None] + octants * side).reshape(-1, 3)


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """Which volume alone can explain what a camera sees, in blocks of `_BLOCK_PX` pixels a side.

    Attributes
    ----------
    sole : list of C (H', W') int64
        The volume, from 0; `NOWHERE` where there is none or more than one.
    """

    sole: list[NDArray[np.int64]]


def cover(volumes: Volumes) -> Coverage:
    """Return which blocks of each image are covered by the cells of one volume only.

    A cell covers the rectangle around its projection. Three sums over the cells that cover a
    block, of 1, of their volumes' numbers l and of l^2, tell whether all numbers are the same:
    just then is n sum l^2 = (sum l)^2 (Cauchy and Schwarz). Sums over rectangles are cumulated
    from their corners.
    """
    if len(volumes) == 1:
        sizes = -(-volumes.hull.views.sizes_px // _BLOCK_PX)
        return Coverage([np.zeros((height, width), np.int64) for width, height in sizes])
    centers_local, volume = volumes.surface_local()
    views = volumes.hull.views
    half_m = 0.5 * volumes.cell_m
    reach_m = float(np.abs(centers_local).max(initial=0.0)) + half_m
    asked = make_cell_frame(volumes.hull, views.origin_world, reach_m, _NEAR_M)
    sole = []
    for camera, (width, height) in enumerate(views.sizes_px.tolist()):
        place = int(np.flatnonzero(asked.frame.order == camera)[0])
        bounds_px = cube_bounds(centers_local, half_m, place, asked)
        columns, rows = -(-width // _BLOCK_PX), -(-height // _BLOCK_PX)
        x0, x1 = _blocks(bounds_px[:, :2], columns)
        y0, y1 = _blocks(bounds_px[:, 2:], rows)
        stride = columns + 1
        corners = np.concatenate(
            [y0 * stride + x0, y1 * stride + x1, y0 * stride + x1, y1 * stride + x0]
        )
        signs = np.repeat([1.0, 1.0, -1.0, -1.0], len(volume))
        sums = []
        for power in range(3):
            # Integers below 2^53, and so exact: fewer than 2^20 cells of 2^15 volumes over a block.
            weights = signs * np.tile((volume + 1.0) ** power, 4)
            flat = np.bincount(corners, weights, (rows + 1) * stride)
            image = flat.reshape(rows + 1, stride).cumsum(axis=0).cumsum(axis=1)
            sums.append(np.round(image[:rows, :columns]))
        n, first, second = sums
        is_sole = (n > 0) & (n * second == first * first)
        sole.append(np.where(is_sole, first / np.maximum(n, 1.0) - 1.0, NOWHERE).astype(np.int64))
    return Coverage(sole)


def _blocks(
    range_px: NDArray[np.float64], count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first block that each range (N, 2) touches, and the one after its last.

    They are one where a range is empty, as that of a cell behind the camera is.
    """
    first = np.clip(np.floor(range_px[:, 0] / _BLOCK_PX), 0, count)
    last = np.clip(np.floor(range_px[:, 1] / _BLOCK_PX) + 1, 0, count)
    return first.astype(np.int64), np.maximum(first, last).astype(np.int64)


def is_real_at(hull: Hull, grown_hull: Hull, point_world: NDArray[np.float64]) -> bool:
    """Tell whether right silhouettes prove that what a point is part of holds something real.

    Somewhere: not that the point itself is near it (see this file's head).

    Few of the proofs of `is_real`, but without volumes: the ray of a pixel that the point projects
    to must be in the hull in one stretch, and the way from the point to the ray in the hull, too.

    Parameters
    ----------
    hull, grown_hull : Hull
        Of one frame; see `grown`.
    point_world : (3,) float64
        A point, metres.
    """
    for camera in range(len(hull.views)):
        pixels = _object_pixels(hull, camera, point_world[None])
        if len(pixels) == 0:
            continue
        row, column = pixels[0].tolist()
        origin_world, (direction,) = pixel_rays(hull.views, camera, [(column, row)])
        spans_m = spans_in_hull(grown_hull, origin_world, direction, FAR_M)
        if len(spans_m) != 1:
            continue
        along_m = np.clip((point_world - origin_world) @ direction, *spans_m[0])
        way_world = origin_world + along_m * direction - point_world
        length_m = float(np.linalg.norm(way_world))
        if length_m == 0.0:
            return True
        way_m = spans_in_hull(grown_hull, point_world, way_world, length_m)
        if np.array_equal(way_m, [[0.0, length_m]]):
            return True
    return False


def is_real(hull: Hull, volumes: Volumes, coverage: Coverage, volume: int) -> bool:
    """Tell whether right silhouettes prove that a volume holds something real, somewhere in it.

    Points of the volume are projected. Where one falls on an object pixel in a block that no other
    volume covers, the pixel's ray is walked: it must be in the hull, and only in this volume.

    Parameters
    ----------
    hull : Hull
        The hull of the frame, silhouettes as they are: its object pixels are asked.
    volumes, coverage
        Those of the same frame.
    volume : int
        The one asked about, from 0.
    """
    points_world = _points_within(volumes, volume)
    for camera in range(len(hull.views)):
        tried = _object_pixels(hull, camera, points_world)
        row, column = tried.T
        tried = tried[coverage.sole[camera][row // _BLOCK_PX, column // _BLOCK_PX] == volume]
        for row, column in _evenly(tried, _MOST_RAYS).tolist():
            if _is_all_in(volumes, camera, column, row, volume):
                return True
    return False


def _points_within(volumes: Volumes, volume: int) -> NDArray[np.float64]:
    """Return points of a volume that are in the hull, (N, 3) metres, world frame."""
    cells = _evenly(np.argwhere(volumes.number == volume + 1), _MOST_CELLS_TRIED) + volumes.first
    inner = (np.indices((_CELL_POINTS,) * 3).reshape(3, -1).T + 0.5) / _CELL_POINTS
    points_local = (cells[:, None] + inner).reshape(-1, 3) * volumes.cell_m
    points_world = np.asarray(points_local + volumes.hull.views.origin_world)
    return points_world[contains_few(volumes.hull, points_world)]


def _object_pixels(hull: Hull, camera: int, points_world: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the object pixels (N, 2) that points (P, 3) project to: rows, columns, ascending."""
    mask = hull.mask(camera)
    h = hull.views.project(points_world, camera)
    h = h[h[:, 2] > 0]
    with np.errstate(over="ignore"):
        pixels = np.clip(h[:, 1::-1] / h[:, 2:], -1, mask.shape)
    pixels = np.floor(pixels).astype(np.int64)
    row, column = pixels[((pixels >= 0) & (pixels < mask.shape)).all(axis=1)].T
    at = np.unique(row * mask.shape[1] + column)
    return np.stack(np.divmod(at[mask.ravel()[at] > 0], mask.shape[1]), axis=1)


def _evenly(rows: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Return at most so many rows of an array, evenly chosen."""
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.int64)]


def _is_all_in(volumes: Volumes, camera: int, column: int, row: int, volume: int) -> bool:
    """Tell whether the ray of a pixel's centre is in the hull, and there in one volume only."""
    origin_world, (direction,) = pixel_rays(volumes.hull.views, camera, [(column, row)])
    spans_m = spans_in_hull(volumes.hull, origin_world, direction, FAR_M)
    # A stretch in the hull is connected: its middle tells for all of it.
    middles_world = origin_world + spans_m.mean(axis=1)[:, None] * direction
    return len(spans_m) > 0 and bool((volumes.at(middles_world) == volume).all())
