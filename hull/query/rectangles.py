"""What rectangles prove, compiled: of triangles in batches, and of clusters of triangles.

The argument is that of `hybridve.hull.query.bounds`. Here it is asked of a whole mesh. Triangles
that stand next to each other in the mesh form clusters of `CLUSTER`, clusters groups of `BRANCH`,
and so on up. What a cluster projects into is kept for each camera as long as neither mesh nor
cameras move, so that in each new frame four look-ups tell what a camera proves of all its
triangles. `hybridve.hull.query.clusters` makes them, and puts neighbours next to each other.

Named tuples carry what many loops need. Reading an array from one counts a reference, some
nanoseconds: the innermost functions take the arrays themselves.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import ZERO, compiled
from hybridve.hull.query.boxes import (
    ABSTAINS,
    ACCEPTS,
    REJECTS,
    UNDECIDED,
    WITHHOLDS,
    rectangle_vote,
)
from hybridve.hull.query.frame import Frame
from hybridve.hull.query.silhouettes import Hull, Views

#: Triangles whose rectangles are computed together: their corners stay in the first cache.
BATCH = 256

#: Triangles of a cluster, and clusters (or groups) of a group.
CLUSTER, BRANCH = 16, 4


class Surface(NamedTuple):
    """A mesh as compiled loops take it.

    Attributes
    ----------
    vertices_local : (V, 3) float64
        Metres.
    faces : (T, 3) int32
        Vertex numbers.
    pads : (C, 3) float64
        See `hybridve.hull.query.bounds.rectangle_pads`; cameras as in the frame.
    """

    vertices_local: NDArray[np.float64]
    faces: NDArray[np.int32]
    pads: NDArray[np.float64]


class Tree(NamedTuple):
    """The clusters of a mesh, groups of them, groups of groups.

    Attributes
    ----------
    rectangles : (N, C, 4) int32
        The pixels first_x, last_x, first_y, last_y that each node projects into, clamped to
        -1..size; cameras in the order of the views. Level after level, clusters first.
    level_start : (L + 1,) int64
        Where each level starts in `rectangles`.
    """

    rectangles: NDArray[np.int32]
    level_start: NDArray[np.int64]


@dataclass(slots=True, eq=False)
class PreparedMesh:
    """What is derived from a mesh as long as it and the cameras stay the same.

    The mesh holds it (`hybridve.hull.query.engine.Triangles`), so that all who ask share it.

    Attributes
    ----------
    views : Views
        The cameras.
    surface : Surface
        The mesh about their local origin; pads in the order of the views.
    tree : Tree or None
        Its clusters; made when a second frame asks.
    first_hull : Hull or None
        The hull that was asked about it first; None once there is a tree.
    """

    views: Views
    surface: Surface
    tree: Tree | None
    first_hull: Hull | None


@compiled
def triangle_rectangles(
    n_triangles: int,
    corners: NDArray[np.float64],
    m: NDArray[np.float64],
    width_px: int,
    height_px: int,
    pads: NDArray[np.float64],
    rectangles: NDArray[np.int32],
) -> None:
    """Write the pixels first_x, last_x, first_y, last_y that triangles project into: (4, n).

    One camera: its projection m (12,), its pads (3,).

    Free of branches, and corners (9, n) lie coordinate after coordinate, so that the compiler
    takes several triangles in one instruction.
    """
    m0, m1, m2, m3, m4, m5 = m[0], m[1], m[2], m[3], m[4], m[5]
    m6, m7, m8, m9, m10, m11 = m[6], m[7], m[8], m[9], m[10], m[11]
    pad_x, pad_y, near_m = pads[0], pads[1], pads[2]
    width, height = float(width_px), float(height_px)
    for i in range(n_triangles):
        x, y, z = corners[0, i], corners[1, i], corners[2, i]
        depth_a = m8 * x + m9 * y + m10 * z + m11
        x_a = (m0 * x + m1 * y + m2 * z + m3) / depth_a
        y_a = (m4 * x + m5 * y + m6 * z + m7) / depth_a
        x, y, z = corners[3, i], corners[4, i], corners[5, i]
        depth_b = m8 * x + m9 * y + m10 * z + m11
        x_b = (m0 * x + m1 * y + m2 * z + m3) / depth_b
        y_b = (m4 * x + m5 * y + m6 * z + m7) / depth_b
        x, y, z = corners[6, i], corners[7, i], corners[8, i]
        depth_c = m8 * x + m9 * y + m10 * z + m11
        x_c = (m0 * x + m1 * y + m2 * z + m3) / depth_c
        y_c = (m4 * x + m5 * y + m6 * z + m7) / depth_c

        depth_min_m = min(depth_a, min(depth_b, depth_c))
        depth_max_m = max(depth_a, max(depth_b, depth_c))
        in_front, behind = depth_min_m >= near_m, depth_max_m <= -near_m
        # Where a corner is not in front its pixel means nothing: the whole image, or none of it.
        low_x = min(x_a, min(x_b, x_c)) - pad_x / depth_min_m if in_front else -1.0
        high_x = max(x_a, max(x_b, x_c)) + pad_x / depth_min_m if in_front else width
        low_y = min(y_a, min(y_b, y_c)) - pad_y / depth_min_m if in_front else -1.0
        high_y = max(y_a, max(y_b, y_c)) + pad_y / depth_min_m if in_front else height
        high_x = -1.0 if behind else high_x
        rectangles[0, i] = np.int32(np.floor(min(max(low_x, -1.0), width)))
        rectangles[1, i] = np.int32(np.floor(min(max(high_x, -1.0), width)))
        rectangles[2, i] = np.int32(np.floor(min(max(low_y, -1.0), height)))
        rectangles[3, i] = np.int32(np.floor(min(max(high_y, -1.0), height)))


@compiled
def load_corners(
    start: int,
    n_triangles: int,
    vertices: NDArray[np.float64],
    faces: NDArray[np.int32],
    corners: NDArray[np.float64],
) -> None:
    """Write the corners of consecutive triangles, coordinate after coordinate: (9, n)."""
    for i in range(n_triangles):
        for k in range(3):
            vertex = faces[start + i, k]
            corners[3 * k, i] = vertices[vertex, 0]
            corners[3 * k + 1, i] = vertices[vertex, 1]
            corners[3 * k + 2, i] = vertices[vertex, 2]


@compiled
def cluster_rectangles(
    first: int,
    last: int,
    surface: Surface,
    matrices: NDArray[np.float64],
    sizes: NDArray[np.int64],
    rectangles: NDArray[np.int32],
) -> None:
    """Write the rectangles (clusters, C, 4) of clusters first..last: the union of their triangles'.

    A union proves what its parts prove together: where a part's rectangle is the whole plane, so
    is the union; a part behind the camera has none, and only makes the union look cut off by the
    border.
    """
    corners = np.zeros((9, CLUSTER))
    parts = np.zeros((4, CLUSTER), np.int32)
    for cluster in range(first, last):
        start = cluster * CLUSTER
        n_triangles = min(CLUSTER, len(surface.faces) - start)
        load_corners(start, n_triangles, surface.vertices_local, surface.faces, corners)
        for camera in range(len(matrices)):
            triangle_rectangles(
                n_triangles,
                corners,
                matrices[camera],
                sizes[camera, 0],
                sizes[camera, 1],
                surface.pads[camera],
                parts,
            )
            x0, x1, y0, y1 = parts[0, 0], parts[1, 0], parts[2, 0], parts[3, 0]
            for i in range(1, n_triangles):
                x0, x1 = min(x0, parts[0, i]), max(x1, parts[1, i])
                y0, y1 = min(y0, parts[2, i]), max(y1, parts[3, i])
            rectangles[cluster, camera, 0] = x0
            rectangles[cluster, camera, 1] = x1
            rectangles[cluster, camera, 2] = y0
            rectangles[cluster, camera, 3] = y1


class Survivors(NamedTuple):
    """The triangles that are not proved free, in ranges, ascending.

    Attributes
    ----------
    start, stop : (K,) int64
        Triangles; several only where all their points are inside the hull.
    n_accept : (K,) int64
        How many cameras see nothing but object pixels of them.
    is_open : (K, C) bool
        Which cameras, in the frame's order, are undecided. None: all their points are inside.
    """

    start: NDArray[np.int64]
    stop: NDArray[np.int64]
    n_accept: NDArray[np.int64]
    is_open: NDArray[np.bool_]


@compiled
def _node_verdict(
    rectangles: NDArray[np.int32],
    order: NDArray[np.int64],
    sizes: NDArray[np.int64],
    integrals: NDArray[np.int32],
    integral_offset: NDArray[np.int64],
    recorded: NDArray[np.int64] | None,
    keep: bool,
    min_cameras: int,
    cameras: NDArray[np.int64],
    n_cameras: int,
    n_accept: int,
    left: NDArray[np.int64],
) -> tuple[int, int, bool]:
    """Ask some cameras about a node of a tree, whose rectangles are (C, 4) in the tree's order.

    Returns
    -------
    n_left : int
        How many cameras stay undecided; they are left in `left`, in order.
    n_accept : int
        How many, with those before, see nothing but object pixels.
    is_free : bool
        Whether no sample of the node can be inside.
    """
    n_left, n_withheld = ZERO, ZERO
    for number in range(n_cameras):
        camera = cameras[number]
        place = order[camera]
        vote = rectangle_vote(
            np.int64(rectangles[place, 0]),
            np.int64(rectangles[place, 1]),
            np.int64(rectangles[place, 2]),
            np.int64(rectangles[place, 3]),
            sizes[camera, 0],
            sizes[camera, 1],
            integral_offset[camera],
            integrals,
            keep,
            camera,
            recorded,
        )
        if vote == REJECTS:
            return n_left, n_accept, True
        if vote == ACCEPTS:
            n_accept += 1
        elif vote != ABSTAINS:
            left[n_left] = camera
            n_left += 1
            n_withheld += vote == WITHHOLDS
    return n_left, n_accept, keep and n_accept + n_left - n_withheld < min_cameras


@compiled
def open_nodes(level: int, tree: Tree, frame: Frame) -> NDArray[np.int64]:
    """Return the nodes of a level that are not proved free, counted within it, ascending."""
    n_cameras = len(frame.matrices)
    left = np.zeros(n_cameras, np.int64)
    top = len(tree.level_start) - 2
    nodes = np.zeros(tree.level_start[top + 1] - tree.level_start[top], np.int64)
    for number in range(len(nodes)):
        nodes[number] = tree.level_start[top] + number
    for height in range(top, level - 1, -1):
        n_kept = 0
        for number in range(len(nodes)):
            _, _, is_free = _node_verdict(
                tree.rectangles[nodes[number]],
                frame.order,
                frame.sizes,
                frame.integrals,
                frame.integral_offset,
                frame.recorded,
                frame.keep,
                frame.min_cameras,
                frame.every,
                n_cameras,
                ZERO,
                left,
            )
            if not is_free:
                nodes[n_kept] = nodes[number]
                n_kept += 1
        nodes = nodes[:n_kept]
        if height > level:
            below = np.zeros(BRANCH * n_kept, np.int64)
            n_below = 0
            for number in range(n_kept):
                first = BRANCH * (nodes[number] - tree.level_start[height])
                size = tree.level_start[height] - tree.level_start[height - 1]
                for child in range(first, min(first + BRANCH, size)):
                    below[n_below] = tree.level_start[height - 1] + child
                    n_below += 1
            nodes = below[:n_below]
    for number in range(len(nodes)):
        nodes[number] -= tree.level_start[level]
    return nodes


@compiled
def _batch_verdicts(
    start: int,
    n_triangles: int,
    surface: Surface,
    frame: Frame,
    cameras: NDArray[np.int64],
    n_cameras: int,
    n_accept: int,
    corners: NDArray[np.float64],
    rectangles: NDArray[np.int32],
    triangle: NDArray[np.int64],
    accepted: NDArray[np.int64],
    supported: NDArray[np.int64],
    is_open: NDArray[np.bool_],
) -> int:
    """Ask some cameras, one after the other, about consecutive triangles; return how many are left.

    Parameters
    ----------
    cameras, n_cameras, n_accept
        Whom to ask, and how many others see nothing but object pixels.
    corners, rectangles
        Room to work in, (9, n) and (4, n).
    triangle : (n,) int64
        Written: the triangles that are not proved free, ascending.
    accepted : (n,) int64
        Written: how many cameras see nothing but object pixels of each.
    supported : (n,) int64
        Written, where cameras may abstain: how many may see an object pixel of each.
    is_open : (n, C) bool
        Written: which cameras are undecided about it.
    """
    load_corners(start, n_triangles, surface.vertices_local, surface.faces, corners)
    integrals, keep = frame.integrals, frame.keep
    all_cameras = len(frame.matrices)
    for i in range(n_triangles):
        triangle[i], accepted[i], supported[i] = start + i, n_accept, n_accept
    n_left = n_triangles
    for number in range(n_cameras):
        camera = cameras[number]
        width, height = frame.sizes[camera, 0], frame.sizes[camera, 1]
        first = frame.integral_offset[camera]
        triangle_rectangles(
            n_left, corners, frame.matrices[camera], width, height, surface.pads[camera], rectangles
        )
        n_kept = 0
        n_later = n_cameras - number - 1
        for i in range(n_left):
            vote = rectangle_vote(
                np.int64(rectangles[0, i]),
                np.int64(rectangles[1, i]),
                np.int64(rectangles[2, i]),
                np.int64(rectangles[3, i]),
                width,
                height,
                first,
                integrals,
                keep,
                camera,
                frame.recorded,
            )
            if vote == REJECTS:
                continue
            n_accepted = accepted[i] + (vote == ACCEPTS)
            if keep:
                n_supported = supported[i] + (vote in (ACCEPTS, UNDECIDED))
                if n_supported + n_later < frame.min_cameras:
                    continue
                supported[n_kept] = n_supported
            for other in range(all_cameras):
                is_open[n_kept, other] = number > 0 and is_open[i, other]
            is_open[n_kept, camera] = vote in (UNDECIDED, WITHHOLDS)
            triangle[n_kept], accepted[n_kept] = triangle[i], n_accepted
            for k in range(9):
                corners[k, n_kept] = corners[k, i]
            n_kept += 1
        n_left = n_kept
    return n_left


@compiled
def survivors(
    nodes: NDArray[np.int64], level: int, tree: Tree, surface: Surface, frame: Frame
) -> Survivors:
    """Return the triangles of some nodes of a level of the tree that are not proved free.

    Without a tree (no levels), `nodes` are batches of triangles, asked one by one.
    """
    n_cameras, n_triangles = len(frame.matrices), len(surface.faces)
    has_tree = len(tree.level_start) > 0
    rectangles, order = tree.rectangles, frame.order
    sizes, integrals, integral_offset = frame.sizes, frame.integrals, frame.integral_offset
    # Row h + 1: the cameras that leave a node of level h's parent open, and how many others accept.
    cameras = np.zeros((level + 2, n_cameras), np.int64)
    for row in range(level + 2):
        for camera in range(n_cameras):
            cameras[row, camera] = camera
    n_open, n_accept = np.zeros(level + 2, np.int64), np.zeros(level + 2, np.int64)
    n_open[level + 1] = n_cameras
    stack = np.zeros(((level + 1) * BRANCH + 1, 2), np.int64)  # node within its level, level
    corners, parts = np.zeros((9, BATCH)), np.zeros((4, BATCH), np.int32)
    triangle, accepted = np.zeros(BATCH, np.int64), np.zeros(BATCH, np.int64)
    supported = np.zeros(BATCH, np.int64)
    is_open = np.zeros((BATCH, n_cameras), np.bool_)

    capacity = 4 * BATCH
    found = Survivors(
        np.zeros(capacity, np.int64),
        np.zeros(capacity, np.int64),
        np.zeros(capacity, np.int64),
        np.zeros((capacity, n_cameras), np.bool_),
    )
    n = ZERO
    for number in range(len(nodes)):
        stack[0, 0], stack[0, 1] = nodes[number], level
        depth = 1
        while depth > 0:
            depth -= 1
            place, height = stack[depth, 0], stack[depth, 1]
            size, n_left, n_accepted = BATCH, n_cameras, ZERO
            if has_tree:
                n_left, n_accepted, is_free = _node_verdict(
                    rectangles[tree.level_start[height] + place],
                    order,
                    sizes,
                    integrals,
                    integral_offset,
                    frame.recorded,
                    frame.keep,
                    frame.min_cameras,
                    cameras[height + 1],
                    n_open[height + 1],
                    n_accept[height + 1],
                    cameras[height],
                )
                if is_free:
                    continue
                size = CLUSTER * BRANCH**height
            first = place * size
            last = min(first + size, n_triangles)
            if n + BATCH > len(found.start):
                found = _longer(found, n)
            if n_left == 0:
                found.start[n], found.stop[n], found.n_accept[n] = first, last, n_accepted
                for camera in range(n_cameras):
                    found.is_open[n, camera] = False
                n += 1
            elif height == 0:
                n_kept = _batch_verdicts(
                    first,
                    last - first,
                    surface,
                    frame,
                    cameras[0],
                    n_left,
                    n_accepted,
                    corners,
                    parts,
                    triangle,
                    accepted,
                    supported,
                    is_open,
                )
                for kept in range(n_kept):
                    found.start[n], found.stop[n] = triangle[kept], triangle[kept] + 1
                    found.n_accept[n] = accepted[kept]
                    for camera in range(n_cameras):
                        found.is_open[n, camera] = is_open[kept, camera]
                    n += 1
            else:
                n_open[height], n_accept[height] = n_left, n_accepted
                below = tree.level_start[height] - tree.level_start[height - 1]
                for child in range(min((place + 1) * BRANCH, below) - 1, place * BRANCH - 1, -1):
                    stack[depth, 0], stack[depth, 1] = child, height - 1
                    depth += 1
    return Survivors(found.start[:n], found.stop[:n], found.n_accept[:n], found.is_open[:n])


@compiled
def _longer(found: Survivors, n: int) -> Survivors:
    """Return twice the room that begins as `found` does."""
    capacity, n_cameras = 2 * len(found.start), found.is_open.shape[1]
    longer = Survivors(
        np.zeros(capacity, np.int64),
        np.zeros(capacity, np.int64),
        np.zeros(capacity, np.int64),
        np.zeros((capacity, n_cameras), np.bool_),
    )
    for k in range(n):
        longer.start[k], longer.stop[k] = found.start[k], found.stop[k]
        longer.n_accept[k] = found.n_accept[k]
        for camera in range(n_cameras):
            longer.is_open[k, camera] = found.is_open[k, camera]
    return longer
