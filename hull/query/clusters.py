"""Clusters of triangles, and groups of clusters: what a frame asks instead of every triangle.

A cluster is a run of consecutive triangles, so a mesh is put into an order in which neighbours in
space are neighbours in number (`spatial_order`), once, when it is loaded. A tree (`make_tree`) then
holds for every cluster and group of clusters the rectangle it projects into, in every camera.
Nothing in it depends on the silhouettes: it serves as long as mesh and cameras stand still.
"""

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import compiled
from hybridve.hull.query.bounds import ROUNDOFF_FLOAT64, rectangle_pads
from hybridve.hull.query.engine import Triangles
from hybridve.hull.query.frame import Frame
from hybridve.hull.query.rectangles import (
    BATCH,
    BRANCH,
    CLUSTER,
    PreparedMesh,
    Surface,
    Tree,
    cluster_rectangles,
    open_nodes,
)
from hybridve.hull.query.silhouettes import Hull, Views
from hybridve.hull.query.threads import Threads

#: Bits per axis of a place on the space-filling curve: three times 21 fill an integer.
_CURVE_BITS = 21

#: What stands for the tree of a mesh that has none.
NO_TREE = Tree(np.zeros((0, 0, 4), np.int32), np.zeros(0, np.int64))

#: Triangles of a share at least: a call costs some microseconds.
_SHARE_TRIANGLES = 2048

#: Meshes of fewer triangles are asked one triangle after the other: clusters do not pay.
_TREE_TRIANGLES = 2048

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
    centroids = vertices[faces].mean(axis=1)
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


class Share(NamedTuple):
    """A part of a mesh for one call of compiled code; see `rectangles.survivors`."""

    nodes: NDArray[np.int64]
    level: int
    tree: Tree
    surface: Surface


def make_shares(
    hull: Hull, frame: Frame, mesh: Triangles, threads: Threads, *, reject: bool = True
) -> list[Share]:
    """Return shares of the work that together cover a mesh, in the order of its triangles.

    The tree of clusters is made when a second frame asks about a mesh: one that moves in every
    frame would pay for it and never use it.

    Parameters
    ----------
    hull, frame
        The frame.
    mesh : Triangles
        The mesh.
    threads : Threads
        Who will do the work, and makes the tree.
    reject : bool
        Whether rectangles may prove anything.
    """
    if len(mesh) == 0:
        return []
    prepared = mesh.prepared
    if prepared is None or prepared.views is not hull.views:
        vertices_local, reach_m = _localized(mesh.vertices_world, hull.views.origin_world)
        pads = rectangle_pads(hull.views, reach_m, ROUNDOFF_FLOAT64)
        surface = Surface(vertices_local, mesh.faces, pads)
        prepared = PreparedMesh(hull.views, surface, None, hull)
        mesh.hold(prepared)
    is_static = prepared.first_hull is not hull
    if prepared.tree is None and is_static and reject and len(mesh) >= _TREE_TRIANGLES:
        prepared.tree = _make_tree(prepared.views, prepared.surface, threads)
        prepared.first_hull = None
    pads = prepared.surface.pads[frame.order]
    # Rectangles that are widened without end prove nothing.
    surface = prepared.surface._replace(pads=pads if reject else np.full_like(pads, np.inf))
    if prepared.tree is None or not reject:
        tree, level = NO_TREE, 0
        nodes = np.arange(-(-len(mesh) // BATCH))
        n_shares = min(threads.n_shares, -(-len(mesh) // _SHARE_TRIANGLES))
    else:
        tree = prepared.tree
        level = len(tree.level_start) - 2
        while level > 0 and CLUSTER * BRANCH**level > _SHARE_TRIANGLES:
            level -= 1
        nodes = open_nodes(level, tree, frame)
        n_shares = min(threads.n_shares, len(nodes))
    cuts = np.linspace(0, len(nodes), n_shares + 1).astype(np.int64).tolist()
    return [Share(nodes[a:b], level, tree, surface) for a, b in itertools.pairwise(cuts)]


@compiled
def _localized(
    vertices_world: NDArray[np.float64], origin_world: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return vertices (V, 3) about an origin, and their largest absolute coordinates (3,)."""
    vertices_local, reach_m = np.zeros_like(vertices_world), np.zeros(3)
    for vertex in range(len(vertices_world)):
        for axis in range(3):
            coordinate = vertices_world[vertex, axis] - origin_world[axis]
            vertices_local[vertex, axis] = coordinate
            reach_m[axis] = max(reach_m[axis], abs(coordinate))
    return vertices_local, reach_m


def _make_tree(views: Views, surface: Surface, threads: Threads) -> Tree:
    """Return the clusters of a mesh as these cameras see them; pads in the order of the views."""
    n_cameras = len(views)
    n_clusters = -(-len(surface.faces) // CLUSTER)
    clusters = np.zeros((n_clusters, n_cameras, 4), np.int32)
    matrices = views.img_from_local.reshape(-1, 12)
    cuts = np.linspace(0, n_clusters, min(threads.n_shares, n_clusters) + 1).astype(np.int64)
    threads.run(
        [
            (cluster_rectangles, (a, b, surface, matrices, views.sizes_px, clusters))
            for a, b in itertools.pairwise(cuts.tolist())
        ]
    )
    levels = [clusters]
    while len(levels[-1]) > _TOP_NODES:
        below = levels[-1]
        starts = np.arange(0, len(below), BRANCH)
        above = np.maximum.reduceat(below, starts, axis=0)
        above[..., 0::2] = np.minimum.reduceat(below[..., 0::2], starts, axis=0)
        levels.append(above)
    return Tree(np.concatenate(levels), np.cumsum([0, *map(len, levels)]).astype(np.int64))
