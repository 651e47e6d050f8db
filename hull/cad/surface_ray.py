"""Where segments first meet triangles: compiled, for loops that ask it themselves.

The tree is that of `hybridve.hull.cad.surface_tree`. A triangle counts as a little larger than it
is, lest a segment pass between two neighbours by rounding.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.surface_tree import SurfaceTree, make_tree
from hybridve.hull.jit import compiled

#: Room for the nodes that wait to be looked at: the tree's depth and one.
WAITING = 65

#: By how much a triangle is larger than it is, as a share of it.
_OUTSET = 1e-9


def tree_of(corners: NDArray[np.float64]) -> SurfaceTree:
    """Return the tree of triangles (T, 3, 3), metres; of none, one that no segment meets."""
    if len(corners) == 0:
        corners = np.zeros((1, 3, 3))  # a point has no area
    return make_tree(corners, corners)


def joined(trees: Sequence[SurfaceTree]) -> tuple[SurfaceTree, NDArray[np.int64]]:
    """Return trees as one that holds them all, and where the root of each is in it."""
    nodes = np.cumsum([0] + [len(tree.child) for tree in trees])
    triangles = np.cumsum([0] + [len(tree.solid) for tree in trees])
    parts = [
        tree._replace(
            child=np.where(tree.child < 0, -1, tree.child + node),
            first=tree.first + triangle,
            number=tree.number + triangle,
        )
        for tree, node, triangle in zip(trees, nodes, triangles, strict=False)
    ]
    whole = SurfaceTree(
        box=np.concatenate([part.box for part in parts]),
        child=np.concatenate([part.child for part in parts]),
        first=np.concatenate([part.first for part in parts]),
        n_triangles=np.concatenate([part.n_triangles for part in parts]),
        number=np.concatenate([part.number for part in parts]),
        frame=np.concatenate([part.frame for part in parts]),
        solid=np.concatenate([part.solid for part in parts]),
        longest_m=max(part.longest_m for part in parts),
    )
    return whole, nodes[:-1]


@compiled
def _meets_box(
    start: NDArray[np.float64],
    way: NDArray[np.float64],
    until: float,
    box: NDArray[np.float64],
    node: int,
) -> bool:
    """Tell whether a segment up to a share of its way may meet a node's box."""
    first, last = 0.0, until
    for axis in range(3):
        low, high = box[node, axis] - start[axis], box[node, 3 + axis] - start[axis]
        if way[axis] == 0.0:
            if low > 0.0 or high < 0.0:
                return False
            continue
        one, other = low / way[axis], high / way[axis]
        first = max(first, min(one, other) * (1.0 - _OUTSET))
        last = min(last, max(one, other) * (1.0 + _OUTSET))
    return first <= last


@compiled
def _meets(
    start: NDArray[np.float64],
    way: NDArray[np.float64],
    solid: NDArray[np.float64],
    t: int,
) -> float:
    """Return where a segment meets a triangle, as a share of its way; infinite if nowhere.

    References
    ----------
    T. Moeller, B. Trumbore, Fast, minimum storage ray/triangle intersection, 1997.
    """
    ax, ay, az = solid[t, 0], solid[t, 1], solid[t, 2]
    ux, uy, uz = solid[t, 3] - ax, solid[t, 4] - ay, solid[t, 5] - az
    vx, vy, vz = solid[t, 6] - ax, solid[t, 7] - ay, solid[t, 8] - az
    px, py, pz = (
        way[1] * vz - way[2] * vy,
        way[2] * vx - way[0] * vz,
        way[0] * vy - way[1] * vx,
    )
    det = ux * px + uy * py + uz * pz
    if det == 0.0:
        return np.inf
    sx, sy, sz = start[0] - ax, start[1] - ay, start[2] - az
    first = (sx * px + sy * py + sz * pz) / det
    if not -_OUTSET <= first <= 1.0 + _OUTSET:
        return np.inf
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    second = (way[0] * qx + way[1] * qy + way[2] * qz) / det
    if not (second >= -_OUTSET and first + second <= 1.0 + _OUTSET):
        return np.inf
    at = (vx * qx + vy * qy + vz * qz) / det
    return at if 0.0 <= at <= 1.0 else np.inf


@compiled
def first_triangle(
    start: NDArray[np.float64],
    way: NDArray[np.float64],
    until: float,
    tree: SurfaceTree,
    waiting: NDArray[np.int64],
    root: int,
) -> tuple[float, int]:
    """Return where a segment first meets a triangle, and which of ``tree.solid`` that is.

    Parameters
    ----------
    start, way : (3,) float64
        Metres.
    until : float
        Up to which share of the way.
    tree : SurfaceTree
        The triangles.
    waiting : (`WAITING`,) int64
        Room for a stack.
    root : int
        The node below which they are: `ZERO` for all.

    Returns
    -------
    at : float
        The share of the way, at most `until`; infinite if it meets none.
    triangle : int
        In the tree's order; -1 if it meets none.
    """
    nearest, found = until, -1
    waiting[0] = root
    n_waiting = 1
    while n_waiting > 0:
        n_waiting -= 1
        node = waiting[n_waiting]
        if not _meets_box(start, way, nearest, tree.box, node):
            continue
        if tree.child[node] >= 0:
            waiting[n_waiting], waiting[n_waiting + 1] = tree.child[node], tree.child[node] + 1
            n_waiting += 2
            continue
        for t in range(tree.first[node], tree.first[node] + tree.n_triangles[node]):
            at = _meets(start, way, tree.solid, t)
            # Of triangles met at one place the first in the tree, whatever the order of nodes.
            if at < nearest or (at == nearest and (found < 0 or t < found)):
                nearest, found = at, t
    return (nearest, found) if found >= 0 else (np.inf, -1)
