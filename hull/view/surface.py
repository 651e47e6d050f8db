"""The hull of a frame as a closed surface: triangles where silhouettes end, to a cell of a grid.

At each node of a grid it is asked in every camera how far the silhouette's outline is from where
the node projects, in pixels and so at its depth in metres, above 0 inside of the silhouette. The
hull is where the least of these is above 0; its surface is where that passes through 0
(marching cubes, by scikit-image: its tables leave no holes where corners of a cell are ambiguous).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.silhouettes import UNSEEN, Hull
from hybridve.hull.view.cells import hull_cells

#: Nodes of a grid at most: 16 million take half a gigabyte.
MOST_NODES = 16_000_000

#: Nodes that are asked at once.
_SLAB_NODES = 1_000_000

#: A field is never nearer to 0 than this, so that no triangle is without an area.
_LEAST_M = 1e-7

#: How far inside of everything is what a camera says that cannot see a node and abstains.
_ABSTAINS_M = 1e3

#: OpenCV looks pictures up in rows of so many places.
_ROW = 4096


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A closed surface, its triangles counter-clockwise seen from outside.

    Attributes
    ----------
    vertices_world : (V, 3) float64
        Metres; V = 0 for an empty hull.
    faces : (T, 3) int32
        Vertex numbers.
    cell_m : float
        Edge of the grid's cells: what is thinner may be lost.
    """

    vertices_world: NDArray[np.float64]
    faces: NDArray[np.int32]
    cell_m: float


def hull_surface(
    hull: Hull,
    *,
    cell_m: float | None = None,
    split: int = 128,
    points_world: NDArray[np.float64] | None = None,
) -> Surface:
    """Return the surface of a hull.

    What few cameras bound reaches far; it is closed where `hull_cells` looks no further.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame; it may be empty.
    cell_m : float, optional
        Edge of the grid's cells.
    split : int
        Or, instead, how many of them there are along the longest side of the hull's box.
    points_world : (P, 3) float64, optional
        What else the scene holds; how far is looked.

    Raises
    ------
    ValueError
        If there would be more than `MOST_NODES` nodes; it says for which cells there are fewer.
    """
    cells = hull_cells(hull, points_world)
    low, high = cells.box_local()
    size_m = high - low
    if cell_m is None:
        cell_m = float(size_m.max()) / split
    if len(cells) == 0:
        return Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int32), cell_m)
    counts = np.ceil(size_m / cell_m).astype(np.int64) + 3  # a node outside on either side
    if counts.prod() > MOST_NODES:
        least_mm = 1e3 * cell_m * float(counts.prod() / MOST_NODES) ** (1 / 3)
        raise ValueError(
            f"the hull's box of {' x '.join(f'{one:.2f}' for one in size_m)} m has "
            f"{counts.prod()} cells of {1e3 * cell_m:g} mm, expected {MOST_NODES} at most; "
            f"take {np.ceil(least_mm):g} mm"
        )
    middle = 0.5 * (low + high)
    axes = [
        at + cell_m * (np.arange(count) - 0.5 * (count - 1))
        for at, count in zip(middle, counts.tolist(), strict=True)
    ]
    field = _field(hull, axes)
    # Closed at the border of the box, whatever is there.
    for axis in range(3):
        for end in (0, -1):
            side = [slice(None)] * 3
            side[axis] = slice(end, None) if end else slice(0, 1)
            np.minimum(field[tuple(side)], -_LEAST_M, out=field[tuple(side)])
    if not (field > 0).any():
        return Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int32), cell_m)
    from skimage.measure import marching_cubes  # late: it takes a quarter of a second

    # Its winding is clockwise seen from where the field is below 0.
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(cell_m,) * 3)
    faces = faces[:, ::-1]
    start = np.array([axis[0] for axis in axes]) + hull.views.origin_world
    return Surface(vertices.astype(np.float64) + start, faces.astype(np.int32), cell_m)


def _field(hull: Hull, axes: Sequence[NDArray[np.float64]]) -> NDArray[np.float32]:
    """Return how far inside of the hull (X, Y, Z) nodes are, metres; below 0 outside."""
    x, y, z = axes
    distances_px = [_distance_px(hull, camera) for camera in range(len(hull.views))]
    field = np.zeros((len(x), len(y), len(z)), np.float32)
    across = np.stack(np.meshgrid(y, z, indexing="ij"), axis=-1).reshape(-1, 2)
    step = max(1, _SLAB_NODES // len(across))
    for first in range(0, len(x), step):
        some = x[first : first + step]
        nodes = np.column_stack([np.repeat(some, len(across)), np.tile(across, (len(some), 1))])
        field[first : first + step] = _inside_m(hull, distances_px, nodes).reshape(
            len(some), len(y), len(z)
        )
    field[np.abs(field) < _LEAST_M] = -_LEAST_M
    return field


def _distance_px(hull: Hull, camera: int) -> NDArray[np.float32]:
    """Return how far inside of its silhouette each pixel (H, W) of a camera is; below 0 outside."""
    mask = hull.answers(camera)
    if hull.views.unseen == "carve":  # beyond its picture nothing is object
        mask = np.pad(mask, 1)
    is_object = (mask > 0).astype(np.uint8)
    inside = cv2.distanceTransform(is_object, cv2.DIST_L2, cv2.DIST_MASK_5)
    outside = cv2.distanceTransform(1 - is_object, cv2.DIST_L2, cv2.DIST_MASK_5)
    # Without any pixel to be away from, OpenCV says something very large.
    distance = np.where(is_object > 0, inside - 0.5, 0.5 - outside).astype(np.float32)
    distance = np.clip(distance, -1e4, 1e4)
    if hull.views.unseen == "carve":
        return np.ascontiguousarray(distance[1:-1, 1:-1])
    distance[mask == UNSEEN] = np.nan
    return distance


def _inside_m(
    hull: Hull, distances_px: Sequence[NDArray[np.float32]], nodes_local: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return how far inside of the hull nodes (N, 3) are, metres."""
    views = hull.views
    least_m = np.full(len(nodes_local), _ABSTAINS_M, np.float32)
    n_seeing = np.zeros(len(nodes_local), np.int16)
    for camera, distance_px in enumerate(distances_px):
        matrix = views.img_from_local[camera]
        projected = nodes_local @ matrix[:, :3].T + matrix[:, 3]
        depth_m = projected[:, 2]
        ahead = depth_m > 1e-6
        pixels = projected[:, :2] / np.where(ahead, depth_m, 1.0)[:, None]
        width, height = (float(size) for size in views.sizes_px[camera])
        inner = np.clip(pixels, 0.5, [width - 0.5, height - 0.5])
        beyond_px = np.linalg.norm(pixels - inner, axis=1)
        value_px = _looked_up(distance_px, inner)
        focal_px = float(np.linalg.norm(np.cross(matrix[0, :3], matrix[2, :3])))
        if views.unseen == "carve":
            # Half a pixel beyond the outermost centres the picture ends, and the object with it.
            value_px = np.where(beyond_px > 0, np.minimum(value_px, 0.5) - beyond_px, value_px)
            value_px[~ahead] = -1e4
            sees = np.ones(len(nodes_local), np.bool_)
        else:
            sees = ahead & (beyond_px <= 0.75) & np.isfinite(value_px)
        n_seeing += sees
        value_m = (value_px * np.where(ahead, depth_m, 1.0) / focal_px).astype(np.float32)
        least_m = np.where(sees, np.minimum(least_m, value_m), least_m)
    if views.unseen == "keep":
        least_m[n_seeing < views.min_cameras] = -_ABSTAINS_M
    return least_m


def _looked_up(image: NDArray[np.float32], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an image at pixels (N, 2), centres at 0.5, linear between."""
    count = len(pixels)
    rows = -(-count // _ROW)
    places = np.zeros((rows * _ROW, 2), np.float32)
    places[:count] = pixels - 0.5
    x, y = (places[:, axis].reshape(rows, _ROW) for axis in (0, 1))
    found = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found.ravel()[:count], np.float64)
