"""Triangles in a tree of boxes: a surface's nearest point, and how often it goes round a point.

**Distance.** Textbook formulas solve for a triangle's nearest point with its Gram matrix, or along
its normal; of a sliver both are lost in rounding, and the answer is some other point of it, farther
away by up to the triangle's length. Here a triangle is kept as its first corner a on the longest
edge, two unit vectors at right angles, u along that edge and m across it, and in these coordinates
the corners (0, 0), (l, 0), (x, h). The frame is made orthogonal twice, so it is, whatever the
triangle's shape. What is lost is where m points if the triangle is thin: by some 2^-53 l / h; but
then the third corner, h away along m, is off by 2^-53 l only. All that follows is done in the
orthonormal frame, where nothing is divided but by the length of an edge, and is as exact as the
coordinates. So what is measured is the distance of a triangle whose corners are off by less than
64 2^-53 l, measured to within 32 2^-53 of the lengths that take part (the distance and l): together
less than `DISTANCE_ERROR` of distance and l. Triangles that are lines or points are no exception.

**Winding number.** How often a closed surface goes round a point p is the number of its triangles
that a ray from p leaves through, less those it enters through. The ray runs along x, towards the
nearer end of the surface. Whether a triangle is met is asked of its projection along the ray, with
the signs of exact determinants (`hybridve.hull.cad.predicates`). The ray is taken as starting
at p + (0, e, e^2) with e smaller than any number: so it meets no edge and no corner, and the two
triangles at an edge are met by one rule (simulation of simplicity). The sum is that integer, not
near it, for any point off the surface, however near.

References
----------
H. Edelsbrunner, E. P. Mucke, Simulation of simplicity, ACM Transactions on Graphics 9(1), 1990.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.predicates import side_of_line, side_of_plane
from hybridve.hull.jit import ZERO, compiled, inlined

#: Triangles in a leaf at most.
_LEAF = 4

#: Halvings at most: each halves the number of triangles.
_MOST_DEPTH = 64

#: What a distance may be off by, in shares of it and the triangle's longest edge together.
DISTANCE_ERROR = 2.0**-46

#: A direction across an edge is kept if this much of it is left when made orthogonal once more.
_STEADY = 0.5


class SurfaceTree(NamedTuple):
    """Triangles, in the order of the leaves that hold them.

    Attributes
    ----------
    box : (N, 6) float64
        Lower and upper corner of all that is below a node, metres.
    child : (N,) int64
        The first of its two children, which stand side by side; -1 for a leaf.
    first, n_triangles : (N,) int64
        The triangles of a leaf.
    number : (T,) int64
        Which triangle of the mesh each is.
    frame : (T, 12) float64
        The first corner, the unit vectors along and across the longest edge, its length, and the
        third corner in these coordinates; metres.
    solid : (T, 9) float64
        The corners that decide about inside and outside, metres; the same point thrice where a
        triangle does not.
    longest_m : float
        The longest edge.
    """

    box: NDArray[np.float64]
    child: NDArray[np.int64]
    first: NDArray[np.int64]
    n_triangles: NDArray[np.int64]
    number: NDArray[np.int64]
    frame: NDArray[np.float64]
    solid: NDArray[np.float64]
    longest_m: float


def make_tree(corners: NDArray[np.float64], solid: NDArray[np.float64]) -> SurfaceTree:
    """Return the tree of some triangles.

    Parameters
    ----------
    corners : (T, 3, 3) float64
        Of the triangles that distances are measured to, at least one; metres.
    solid : (T, 3, 3) float64
        Of the same triangles with corners that meet; see `SurfaceTree.solid`.
    """
    both = np.concatenate([corners, solid], axis=1)
    lower, upper = both.min(axis=1), both.max(axis=1)
    box, child, first, count, number, n_nodes = _build(lower, upper)
    frame = _frames(corners[number])
    return SurfaceTree(
        box[:n_nodes].copy(),
        child[:n_nodes].copy(),
        first[:n_nodes].copy(),
        count[:n_nodes].copy(),
        number,
        frame,
        np.ascontiguousarray(solid[number]).reshape(-1, 9),
        float(frame[:, 9].max()),
    )


@compiled
def _select(
    key: NDArray[np.float64], order: NDArray[np.int64], begin: int, end: int, middle: int
) -> None:
    """Sort keys, and what they belong to, from `begin` to `end` so far that `middle` is in place.

    None before it is larger, none behind it smaller (Hoare's FIND).
    """
    low, high = begin, end - 1
    while low < high:
        pivot = key[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while key[i] < pivot:
                i += 1
            while key[j] > pivot:
                j -= 1
            if i <= j:
                key[i], key[j] = key[j], key[i]
                order[i], order[j] = order[j], order[i]
                i, j = i + 1, j - 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return


@compiled
def _build(
    lower: NDArray[np.float64], upper: NDArray[np.float64]
) -> tuple[
    NDArray[np.float64],
    NDArray[np.int64],
    NDArray[np.int64],
    NDArray[np.int64],
    NDArray[np.int64],
    int,
]:
    """Return nodes' boxes, first children, first triangles, how many; the triangles' order.

    And the number of nodes: there is room for more.

    A node is cut in half along the axis in which the middles of its triangles are spread farthest.
    """
    n = len(lower)
    order, key = np.arange(n), np.zeros(n)
    most = max(2 * n, 1)
    box = np.zeros((most, 6))
    child, first, count = np.full(most, -1), np.zeros(most, np.int64), np.zeros(most, np.int64)
    first[0], count[0] = 0, n
    n_nodes = 1
    node = 0
    while node < n_nodes:
        begin, end = first[node], first[node] + count[node]
        for axis in range(3):
            box[node, axis], box[node, 3 + axis] = np.inf, -np.inf
            for k in range(begin, end):
                box[node, axis] = min(box[node, axis], lower[order[k], axis])
                box[node, 3 + axis] = max(box[node, 3 + axis], upper[order[k], axis])
        if count[node] > _LEAF:
            widest, spread = 0, -1.0
            for axis in range(3):
                low, high = np.inf, -np.inf
                for k in range(begin, end):
                    middle = lower[order[k], axis] + upper[order[k], axis]
                    low, high = min(low, middle), max(high, middle)
                if high - low > spread:
                    widest, spread = axis, high - low
            for k in range(begin, end):
                key[k] = lower[order[k], widest] + upper[order[k], widest]
            half = count[node] // 2
            _select(key, order, begin, end, begin + half)
            child[node] = n_nodes
            first[n_nodes], count[n_nodes] = begin, half
            first[n_nodes + 1], count[n_nodes + 1] = begin + half, count[node] - half
            n_nodes += 2
        node += 1
    return box, child, first, count, order, n_nodes


def _frames(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the frames (T, 12) of triangles (T, 3, 3)."""
    rows = np.arange(len(corners))
    edges = np.roll(corners, -1, axis=1) - corners
    lengths = np.linalg.norm(edges, axis=2)
    start = lengths.argmax(axis=1)
    length = lengths[rows, start]
    first = corners[rows, start]
    third = corners[rows, (start + 2) % 3] - first
    along = np.where(length[:, None] > 0, edges[rows, start], np.eye(3)[0])
    along /= np.where(length > 0, length, 1.0)[:, None]
    apex = np.einsum("ij,ij->i", third, along)
    across, height = _across(third - apex[:, None] * along, along)
    # Of a triangle as thin as rounding, any direction across does.
    is_lost = ~(height > 0)
    axis = np.eye(3)[np.abs(along[is_lost]).argmin(axis=1)]
    across[is_lost] = _across(axis, along[is_lost])[0]
    across, _ = _across(across, along)
    height = np.maximum(np.einsum("ij,ij->i", third, across), 0.0)
    return np.column_stack([first, along, across, length, apex, height])


def _across(
    vectors: NDArray[np.float64], along: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return vectors (T, 3) made unit vectors at right angles to others, and how long they were.

    0 where less than half of one was at right angles, so that rounding may be what is left.
    """
    length = np.linalg.norm(vectors, axis=1)
    units = vectors / np.where(length > 0, length, 1.0)[:, None]
    units -= np.einsum("ij,ij->i", units, along)[:, None] * along
    kept = np.linalg.norm(units, axis=1)
    units /= np.where(kept > 0, kept, 1.0)[:, None]
    return units, np.where(kept >= _STEADY, length, 0.0)


@inlined
def _on_edge(x: float, y: float, edge_x: float, edge_y: float) -> float:
    """Return how far along an edge from the origin its point nearest to (x, y) is, 0 to 1."""
    squared = edge_x * edge_x + edge_y * edge_y
    if not squared > 0.0:
        return 0.0
    return min(max((x * edge_x + y * edge_y) / squared, 0.0), 1.0)


@inlined
def _in_triangle(
    x: float, y: float, length: float, apex_x: float, apex_y: float
) -> tuple[float, float]:
    """Return the point of the triangle (0, 0), (length, 0), (apex) that is nearest to (x, y).

    The first edge is the longest, so the angles at its ends are acute.
    """
    if y <= 0.0:
        return min(max(x, 0.0), length), 0.0
    back_x = apex_x - length
    # On a line counts as beyond it: of a triangle that is a line or a point, all is.
    is_left = apex_x * y - apex_y * x >= 0.0
    is_right = back_x * y - apex_y * (x - length) <= 0.0
    if is_left:
        along = _on_edge(x, y, apex_x, apex_y)
        left_x, left_y = along * apex_x, along * apex_y
        if not is_right:
            return left_x, left_y
    if is_right:
        along = _on_edge(x - length, y, back_x, apex_y)
        right_x, right_y = length + along * back_x, along * apex_y
        if not is_left:
            return right_x, right_y
        left = (x - left_x) * (x - left_x) + (y - left_y) * (y - left_y)
        right = (x - right_x) * (x - right_x) + (y - right_y) * (y - right_y)
        return (left_x, left_y) if left <= right else (right_x, right_y)
    return x, y


@inlined
def _squared_to_triangle(
    p_x: float, p_y: float, p_z: float, frame: NDArray[np.float64], t: int
) -> tuple[float, float, float]:
    """Return the squared distance of a point from a triangle, and its nearest point's x and y."""
    q_x, q_y, q_z = p_x - frame[t, 0], p_y - frame[t, 1], p_z - frame[t, 2]
    x, y = _in_triangle(
        q_x * frame[t, 3] + q_y * frame[t, 4] + q_z * frame[t, 5],
        q_x * frame[t, 6] + q_y * frame[t, 7] + q_z * frame[t, 8],
        frame[t, 9],
        frame[t, 10],
        frame[t, 11],
    )
    q_x -= x * frame[t, 3] + y * frame[t, 6]
    q_y -= x * frame[t, 4] + y * frame[t, 7]
    q_z -= x * frame[t, 5] + y * frame[t, 8]
    return q_x * q_x + q_y * q_y + q_z * q_z, x, y


@inlined
def _squared_to_box(
    p_x: float, p_y: float, p_z: float, box: NDArray[np.float64], node: int
) -> float:
    x = max(box[node, 0] - p_x, 0.0, p_x - box[node, 3])
    y = max(box[node, 1] - p_y, 0.0, p_y - box[node, 4])
    z = max(box[node, 2] - p_z, 0.0, p_z - box[node, 5])
    squared: float = x * x + y * y + z * z
    return squared


@inlined
def _reach(squared: float, longest_m: float) -> float:
    """Return the squared distance of boxes up to which a triangle may still be found as near."""
    distance_m: float = np.sqrt(squared)
    distance_m += 2.0 * DISTANCE_ERROR * (distance_m + longest_m)
    return distance_m * distance_m


@compiled
def closest_on_surface(
    points: NDArray[np.float64], tree: SurfaceTree
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Return the distances (N,) of points (N, 3), the nearest points (N, 3), their triangles (N,).

    Of triangles that are found to be equally near, the one with the lowest number is taken: the
    answer for a point does not depend on the others.
    """
    n = len(points)
    distance_m, nearest, triangle = np.zeros(n), np.zeros((n, 3)), np.zeros(n, np.int64)
    waiting, waiting_squared = np.zeros(_MOST_DEPTH, np.int64), np.zeros(_MOST_DEPTH)
    box, child, first, count = tree.box, tree.child, tree.first, tree.n_triangles
    number, frame, longest_m = tree.number, tree.frame, tree.longest_m
    best = ZERO
    for i in range(n):
        p_x, p_y, p_z = points[i, 0], points[i, 1], points[i, 2]
        # Points come in order: the triangle of the last one is a good first guess.
        squared, best_x, best_y = _squared_to_triangle(p_x, p_y, p_z, frame, best)
        reach = _reach(squared, longest_m)
        waiting[0], waiting_squared[0] = 0, _squared_to_box(p_x, p_y, p_z, box, ZERO)
        n_waiting = 1
        while n_waiting > 0:
            n_waiting -= 1
            if waiting_squared[n_waiting] > reach:
                continue
            node = waiting[n_waiting]
            while child[node] >= 0:
                near, far = child[node], child[node] + 1
                to_near = _squared_to_box(p_x, p_y, p_z, box, near)
                to_far = _squared_to_box(p_x, p_y, p_z, box, far)
                if to_far < to_near:
                    near, far, to_near, to_far = far, near, to_far, to_near
                if to_far <= reach:
                    waiting[n_waiting], waiting_squared[n_waiting] = far, to_far
                    n_waiting += 1
                if to_near > reach:
                    break
                node = near
            if child[node] >= 0:
                continue
            for t in range(first[node], first[node] + count[node]):
                found, x, y = _squared_to_triangle(p_x, p_y, p_z, frame, t)
                if found < squared or (found == squared and number[t] < number[best]):
                    if found < squared:
                        reach = _reach(found, longest_m)
                    squared, best, best_x, best_y = found, t, x, y
        distance_m[i], triangle[i] = np.sqrt(squared), number[best]
        for axis in range(3):
            nearest[i, axis] = frame[best, axis] + (
                best_x * frame[best, 3 + axis] + best_y * frame[best, 6 + axis]
            )
    return distance_m, nearest, triangle


@compiled
def _turn(a: NDArray[np.float64], b: NDArray[np.float64], p: NDArray[np.float64]) -> int:
    """Return on which side of the way from a to b, seen along x, p + (0, e, e^2) lies.

    0 where a and b are seen at one place. The turns of a, b and of b, a are opposite.
    """
    side = side_of_line(a[1], a[2], b[1], b[2], p[1], p[2])
    if side == 0:  # the first derivative that is not 0 decides
        if a[2] != b[2]:
            side = 1 if a[2] > b[2] else -1
        elif a[1] != b[1]:
            side = 1 if b[1] > a[1] else -1
    return side


@inlined
def _times_crossed(p: NDArray[np.float64], solid: NDArray[np.float64], t: int, towards: int) -> int:
    """Return 1 if a ray from p along x, up or down, leaves through a triangle, -1 if it enters."""
    a, b, c = solid[t, 0:3], solid[t, 3:6], solid[t, 6:9]
    if max(a[1], b[1], c[1]) < p[1] or min(a[1], b[1], c[1]) > p[1]:
        return 0
    if max(a[2], b[2], c[2]) < p[2] or min(a[2], b[2], c[2]) > p[2]:
        return 0
    if towards > 0:
        if max(a[0], b[0], c[0]) < p[0]:
            return 0
        is_beyond = min(a[0], b[0], c[0]) > p[0]
    else:
        if min(a[0], b[0], c[0]) > p[0]:
            return 0
        is_beyond = max(a[0], b[0], c[0]) < p[0]
    turn = _turn(a, b, p)
    if turn == 0 or _turn(b, c, p) != turn or _turn(c, a, p) != turn:
        return 0
    # (a - p) . ((b - p) x (c - p)) has the sign of the way to the triangle, times the turn.
    if is_beyond or side_of_plane(a, b, c, p) * turn == towards:
        return turn * towards
    return 0


@compiled
def _winding(p: NDArray[np.float64], tree: SurfaceTree, waiting: NDArray[np.int64]) -> int:
    """Return how often the solid's surface goes round a point; `waiting` is room for a stack."""
    box, child, first, count = tree.box, tree.child, tree.first, tree.n_triangles
    for axis in range(3):
        if p[axis] < box[0, axis] or p[axis] > box[0, 3 + axis]:
            return 0
    towards = 1 if box[0, 3] - p[0] <= p[0] - box[0, 0] else -1
    winding = 0
    waiting[0] = 0
    n_waiting = 1
    while n_waiting > 0:
        n_waiting -= 1
        node = waiting[n_waiting]
        if (
            p[1] < box[node, 1] or p[1] > box[node, 4] or p[2] < box[node, 2] or p[2] > box[node, 5]
        ) or (p[0] > box[node, 3] if towards > 0 else p[0] < box[node, 0]):
            continue
        if child[node] >= 0:
            waiting[n_waiting], waiting[n_waiting + 1] = child[node], child[node] + 1
            n_waiting += 2
            continue
        for t in range(first[node], first[node] + count[node]):
            winding += _times_crossed(p, tree.solid, t, towards)
    return winding


@compiled
def winding_numbers(points: NDArray[np.float64], tree: SurfaceTree) -> NDArray[np.int64]:
    """Return how often the closed surface of a solid goes round points (N, 3), counted (N,).

    Exact for every point that is not on it; on it, one of the numbers on either side.
    """
    winding, waiting = np.zeros(len(points), np.int64), np.zeros(_MOST_DEPTH + 1, np.int64)
    for i in range(len(points)):
        winding[i] = _winding(points[i], tree, waiting)
    return winding


@compiled
def are_in_solid(
    points: NDArray[np.float64],
    distance_m: NDArray[np.float64],
    apart_m: float,
    tree: SurfaceTree,
) -> NDArray[np.bool_]:
    """Return which points (N, 3) a solid's surface goes round.

    Where no surface is between a point and the one before, which its distance or theirs may tell,
    both are on one side, and no ray is followed.

    Parameters
    ----------
    points : (N, 3) float64
        Metres.
    distance_m : (N,) float64
        From the surface that is measured.
    apart_m : float
        How far the solid's surface may be from that one.
    tree : SurfaceTree
        Of both.
    """
    inside, waiting = np.zeros(len(points), np.bool_), np.zeros(_MOST_DEPTH + 1, np.int64)
    for i in range(len(points)):
        if i > 0:
            way = 0.0
            for axis in range(3):
                way += (points[i, axis] - points[i - 1, axis]) ** 2
            free_m = max(distance_m[i], distance_m[i - 1])
            free_m -= 2.0 * DISTANCE_ERROR * (free_m + tree.longest_m) + apart_m
            if np.sqrt(way) < free_m:
                inside[i] = inside[i - 1]
                continue
        inside[i] = _winding(points[i], tree, waiting) != 0
    return inside
