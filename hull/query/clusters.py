"""Clusters of triangles, and groups of clusters: what a frame asks instead of every triangle.

A cluster is a run of consecutive triangles, so a mesh is put into an order in which neighbours in
space are neighbours in number (`spatial_order`), once, when it is loaded. A tree (`make_tree`) then
holds for every cluster and group of clusters the rectangle it projects into, in every camera.
Nothing in it depends on the silhouettes: it serves as long as mesh and cameras stand still.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.rectangles import BRANCH, CLUSTER, Frame, Surface, Tree, cluster_rectangles
from hybridve.hull.query.silhouettes import Views

#: Bits per axis of a place on the space-filling curve: three times 21 fill an integer.
_CURVE_BITS = 21

#: What stands for the tree of a mesh that has none.
NO_TREE = Tree(np.zeros((0, 0, 4), np.int32), np.zeros(0, np.int64), np.zeros(0, np.int64))

#: Levels end where this few nodes are left.
_TOP_NODES = 8


def spatial_order(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return an order of triangles in which neighbours in space stand close together.

    Their centroids are sorted along the Z-order curve (Morton 1966) through the cube around the
    mesh.

    Parameters
    ----------
    vertices : (V, 3) float64
        In any unit.
    faces : (T, 3) int32
        Vertex numbers.

    Returns
    -------
    (T,) int64
        Numbers of triangles.

    Examples
    --------
    Two triangles at each end of a bar, given in turn:

    >>> ends = np.array([[0.0, 0, 0], [9, 0, 0], [0, 1, 0], [9, 1, 0]])
    >>> vertices = (ends[:, None] + 0.1 * np.eye(3)).reshape(-1, 3)
    >>> spatial_order(vertices, np.arange(12, dtype=np.int32).reshape(4, 3)).tolist()
    [0, 2, 1, 3]
    """
    if len(faces) == 0:
        return np.zeros(0, np.int64)
    centroids = sum(vertices[faces[:, corner]] for corner in range(3)) / 3.0
    lower = centroids.min(axis=0)
    edge = float((centroids.max(axis=0) - lower).max())
    cells = 2**_CURVE_BITS - 1
    steps = ((centroids - lower) * (cells / edge if edge > 0 else 0.0)).astype(np.uint64)
    key = np.zeros(len(faces), np.uint64)
    for axis in range(3):
        key |= _spread(steps[:, axis]) << np.uint64(axis)
    return np.argsort(key, kind="stable")


def _spread(number: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return numbers of 21 bits with two zero bits before each."""
    for shift, mask in (
        (32, 0x001F00000000FFFF),
        (16, 0x001F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        number = (number | number << np.uint64(shift)) & np.uint64(mask)
    return number


def make_tree(
    views: Views,
    surface: Surface,
    run: Callable[[Callable[..., None], list[tuple[Any, ...]]], None],
) -> Tree:
    """Return the clusters of a mesh as these cameras see them.

    Parameters
    ----------
    views : Views
        C cameras.
    surface : Surface
        The mesh, pads in the order of the views.
    run : callable
        Runs a function with each of some arguments, in whatever threads there are.
    """
    n_cameras = len(views)
    nothing = np.zeros(0, np.int64)
    frame = Frame(
        views.img_from_local.reshape(-1, 12),
        views.sizes_px,
        np.zeros(0, np.uint8),
        nothing,
        np.zeros(0, np.int32),
        nothing,
        views.unseen == "keep",
        views.min_cameras,
    )
    n_clusters = -(-len(surface.faces) // CLUSTER)
    clusters = np.zeros((n_clusters, n_cameras, 4), np.int32)
    share = max(64, n_clusters // 16)
    run(
        cluster_rectangles,
        [
            (start, min(start + share, n_clusters), surface, frame, clusters)
            for start in range(0, n_clusters, share)
        ],
    )
    levels = [clusters]
    while len(levels[-1]) > _TOP_NODES:
        below = levels[-1]
        starts = np.arange(0, len(below), BRANCH)
        above = np.maximum.reduceat(below, starts, axis=0)
        above[..., 0::2] = np.minimum.reduceat(below[..., 0::2], starts, axis=0)
        levels.append(above)
    level_start = np.cumsum([0, *map(len, levels)]).astype(np.int64)
    return Tree(np.concatenate(levels), level_start, np.arange(n_cameras))
