"""The volume query on the CPU: compiled loops that reject before they sample.

Clusters of triangles are asked first what the rectangle around their projection proves (see
`hybridve.hull.query.rectangles`), then the triangles of the clusters that stay open. Of the rest,
the sample grid is halved again and again, down to tiles of 8 x 8 samples, each asked the same
question, and only tiles that stay open are sampled, in the cameras that left them open. A tile's
samples are the bits of one word. All in double precision, so the samples returned do not depend on
what was rejected beforehand.

The tree of clusters is made when a mesh is asked about for the second time: a mesh that moves in
every frame would pay for it and never use it.

The work is dealt out to plain Python threads, which sleep between queries. numba's own thread
pools are not used: they spin while they wait and slow down whatever else runs (OpenCV, Open3D).
"""

import itertools
import os
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from types import TracebackType
from typing import Any, NamedTuple, Self

import numba
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import compiled, inlined
from hybridve.hull.query.bounds import ROUNDOFF_FLOAT64, rectangle_pads
from hybridve.hull.query.clusters import NO_TREE, make_tree
from hybridve.hull.query.engine import Hits, Triangles
from hybridve.hull.query.rectangles import (
    ACCEPTS,
    BATCH,
    BRANCH,
    CLUSTER,
    REJECTS,
    UNDECIDED,
    Frame,
    Surface,
    Tree,
    batch_verdicts,
    node_verdict,
    rectangle_vote,
)
from hybridve.hull.query.silhouettes import Hull, Views

#: Shares of the work for each thread: the last one to finish should not be waited for long.
_SHARES = 8
#: Triangles of a share at least: a call costs some microseconds.
_SHARE_TRIANGLES = 2048
#: Meshes of fewer triangles are asked one triangle after the other: clusters do not pay.
_TREE_TRIANGLES = 2048

#: Edge in samples of the blocks that the sample grid is cut into before it is halved.
_BLOCK = 64
#: Halvings of a block down to a tile of 8 x 8 samples, the bits of a word.
_TILE_LEVEL = 3
#: A tile of fewer samples is sampled at once: the rectangle test costs about as much.
_MIN_TESTED = 16

#: The samples of a tile with di + dj <= m, for m = 0..14: bit 8 dj + di.
_TILE_BITS = np.array(
    [sum(1 << 8 * j + i for j in range(8) for i in range(8) if i + j <= m) for m in range(15)],
    dtype=np.uint64,
)


class _Grid(NamedTuple):
    """Where the samples of a mesh are, and how they are numbered."""

    viewports: NDArray[np.int32]
    samples_before: NDArray[np.int64]
    reject: bool


class _Room(NamedTuple):
    """What a thread works in."""

    corners: NDArray[np.float64]  # (9, BATCH)
    rectangles: NDArray[np.int32]  # (4, BATCH)
    triangle: NDArray[np.int64]  # (BATCH,)
    accepted: NDArray[np.int64]  # (BATCH,)
    is_open: NDArray[np.bool_]  # (BATCH, C)
    steps: NDArray[np.float64]  # (C, 9)
    cameras: NDArray[np.int64]  # (levels, C): the cameras that leave a node's parent open
    n_open: NDArray[np.int64]  # (levels,) how many these are
    n_accept: NDArray[np.int64]  # (levels,) how many others see nothing but object pixels
    stack: NDArray[np.int64]  # (nodes, 3)
    n_seen: NDArray[np.int64]  # (64,)


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


@compiled
def _make_room(n_cameras: int) -> _Room:
    return _Room(
        np.zeros((9, BATCH)),
        np.zeros((4, BATCH), np.int32),
        np.zeros(BATCH, np.int64),
        np.zeros(BATCH, np.int64),
        np.zeros((BATCH, n_cameras), np.bool_),
        np.zeros((n_cameras, 9)),
        np.zeros((32, n_cameras), np.int64),
        np.zeros(32, np.int64),
        np.zeros(32, np.int64),
        np.zeros((128, 3), np.int64),
        np.zeros(64, np.int64),
    )


@compiled
def _project_steps(
    corners: NDArray[np.float64],
    place: int,
    viewport: int,
    frame: Frame,
    steps: NDArray[np.float64],
) -> None:
    """Write the projection of sample (0, 0) and of one step in i and in j: (C, 9)."""
    per_edge = 1.0 / max(viewport - 1, 1)
    for camera in range(len(frame.matrices)):
        for row in range(3):
            at_a, along_b, along_c = frame.matrices[camera, 4 * row + 3], 0.0, 0.0
            for k in range(3):
                entry = frame.matrices[camera, 4 * row + k]
                a, b, c = corners[k, place], corners[3 + k, place], corners[6 + k, place]
                if viewport == 1:  # the centroid alone
                    at_a += entry * ((a + b + c) / 3.0)
                else:
                    at_a += entry * a
                    along_b += entry * (b - a)
                    along_c += entry * (c - a)
            steps[camera, row] = at_a
            steps[camera, 3 + row] = along_b * per_edge
            steps[camera, 6 + row] = along_c * per_edge


@compiled
def _tile_vote(
    i0: int,
    j0: int,
    size: int,
    last: int,
    steps: NDArray[np.float64],
    pads: NDArray[np.float64],
    width_px: int,
    height_px: int,
    first: int,
    integrals: NDArray[np.int32],
    keep: bool,
) -> int:
    """Return what one camera proves of samples i0 <= i < i0 + size, likewise j, i + j <= last."""
    reach = size - 1
    rest = last - i0 - j0  # steps from the tile's first sample to the diagonal
    low_x, high_x, low_y, high_y = np.inf, -np.inf, np.inf, -np.inf
    depth_min_m, depth_max_m = np.inf, -np.inf
    n_corners = 5 if reach < rest < 2 * reach else 4
    for k in range(n_corners):
        if k == 0:
            di, dj = 0, 0
        elif k == 1:
            di, dj = min(reach, rest), 0
        elif k == 2:
            di, dj = 0, min(reach, rest)
        elif k == 3:  # where the diagonal cuts the tile's last column, or the far corner
            di = min(reach, rest)
            dj = min(reach, rest - di)
        else:  # where it cuts the last row
            dj = min(reach, rest)
            di = min(reach, rest - dj)
        i, j = float(i0 + di), float(j0 + dj)
        depth_m = steps[2] + i * steps[5] + j * steps[8]
        per_depth = 1.0 / depth_m
        pixel_x = (steps[0] + i * steps[3] + j * steps[6]) * per_depth
        pixel_y = (steps[1] + i * steps[4] + j * steps[7]) * per_depth
        low_x, high_x = min(low_x, pixel_x), max(high_x, pixel_x)
        low_y, high_y = min(low_y, pixel_y), max(high_y, pixel_y)
        depth_min_m, depth_max_m = min(depth_min_m, depth_m), max(depth_max_m, depth_m)
    width, height = float(width_px), float(height_px)
    near_m = pads[2]
    if depth_min_m >= near_m:
        pad_x, pad_y = pads[0] / depth_min_m, pads[1] / depth_min_m
        low_x, high_x = low_x - pad_x, high_x + pad_x
        low_y, high_y = low_y - pad_y, high_y + pad_y
    else:
        low_x, high_x = -1.0, -1.0 if depth_max_m <= -near_m else width
        low_y, high_y = -1.0, height
    return rectangle_vote(
        int(np.floor(min(max(low_x, -1.0), width))),
        int(np.floor(min(max(high_x, -1.0), width))),
        int(np.floor(min(max(low_y, -1.0), height))),
        int(np.floor(min(max(high_y, -1.0), height))),
        width_px,
        height_px,
        first,
        integrals,
        keep,
    )


@compiled
def _sample_tile(
    i0: int,
    j0: int,
    last: int,
    cameras: NDArray[np.int64],
    n_cameras: int,
    n_accept: int,
    steps: NDArray[np.float64],
    sizes: NDArray[np.int64],
    masks: NDArray[np.uint8],
    mask_offset: NDArray[np.int64],
    keep: bool,
    min_cameras: int,
    n_seen: NDArray[np.int64],
) -> np.uint64:
    """Return which of the 8 x 8 samples from (i0, j0) on are inside, asked of some cameras."""
    one = np.uint64(1)
    rest = min(last - i0 - j0, 14)
    word: np.uint64 = _TILE_BITS[rest]
    if keep:
        for place in range(64):
            n_seen[place] = n_accept
    for number in range(n_cameras):
        camera = cameras[number]
        width = sizes[camera, 0]
        right, bottom = float(width), float(sizes[camera, 1])
        first = mask_offset[camera]
        for dj in range(min(rest, 7) + 1):
            j = float(j0 + dj)
            x0, y0, z0 = (
                steps[camera, 0] + j * steps[camera, 6],
                steps[camera, 1] + j * steps[camera, 7],
                steps[camera, 2] + j * steps[camera, 8],
            )
            for di in range(min(rest - dj, 7) + 1):
                bit = np.uint64(8 * dj + di)
                if not (word >> bit) & one:
                    continue
                i = float(i0 + di)
                depth_m = z0 + i * steps[camera, 5]
                per_depth = 1.0 / depth_m
                pixel_x, pixel_y = (
                    (x0 + i * steps[camera, 3]) * per_depth,
                    (y0 + i * steps[camera, 4]) * per_depth,
                )
                seen = depth_m > 0 and 0 <= pixel_x < right and 0 <= pixel_y < bottom
                if seen:
                    if keep:
                        n_seen[8 * dj + di] += 1
                    if not masks[first + int(pixel_y) * width + int(pixel_x)]:
                        word &= ~(one << bit)
                elif not keep:
                    word &= ~(one << bit)
        if word == 0:
            return word
    if keep:
        for place in range(64):
            if n_seen[place] < min_cameras:
                word &= ~(one << np.uint64(place))
    return word


@compiled
def _sample_block(
    block_i: int,
    block_j: int,
    viewport: int,
    words: NDArray[np.uint64],
    frame: Frame,
    pads: NDArray[np.float64],
    reject: bool,
    level: int,
    room: _Room,
) -> None:
    """Write the words of a block of samples, halving it as long as the rectangles leave it open.

    Row `level` of `room.cameras` holds the cameras that leave the block's triangle open, row
    l > `level` those that leave the parent of the nodes at level l open. Nodes are taken from the
    stack deepest first, so a row is overwritten only after all nodes below its writer are done.
    """
    last = viewport - 1
    tiles_per_edge = (viewport + 7) // 8
    stack, cameras, steps = room.stack, room.cameras, room.steps
    sizes, integrals, keep = frame.sizes, frame.integrals, frame.keep
    top = level
    stack[0, 0], stack[0, 1], stack[0, 2] = block_i, block_j, level
    depth = 1
    while depth > 0:
        depth -= 1
        i0, j0, level = stack[depth, 0], stack[depth, 1], stack[depth, 2]
        size = _BLOCK >> level
        rest = last - i0 - j0
        edge = min(rest, size - 1) + 1
        accepted, n_left = room.n_accept[level], np.int64(0)
        is_free = False
        # The block that holds the whole triangle was asked with it.
        is_known = level == top and viewport <= size
        is_tested = reject and not is_known and (edge * (edge + 1) // 2 >= _MIN_TESTED)
        for number in range(room.n_open[level]):
            camera = cameras[level, number]
            vote = UNDECIDED
            if is_tested:
                vote = _tile_vote(
                    i0,
                    j0,
                    size,
                    last,
                    steps[camera],
                    pads[camera],
                    sizes[camera, 0],
                    sizes[camera, 1],
                    frame.integral_offset[camera],
                    integrals,
                    keep,
                )
            if vote == REJECTS:
                is_free = True
                break
            if vote == ACCEPTS:
                accepted += 1
            elif vote == UNDECIDED:
                cameras[level + 1, n_left] = camera
                n_left += 1
        if is_free or (frame.keep and accepted + n_left < frame.min_cameras):
            continue
        if n_left == 0:
            for tile_j in range(j0 // 8, (j0 + size) // 8):
                for tile_i in range(i0 // 8, (i0 + size) // 8):
                    if tile_i + tile_j < tiles_per_edge:
                        word = tile_j * tiles_per_edge - tile_j * (tile_j - 1) // 2 + tile_i
                        words[word] = _TILE_BITS[min(last - 8 * (tile_i + tile_j), 14)]
        elif level == _TILE_LEVEL:
            tile_i, tile_j = i0 // 8, j0 // 8
            word = tile_j * tiles_per_edge - tile_j * (tile_j - 1) // 2 + tile_i
            words[word] = _sample_tile(
                i0,
                j0,
                last,
                cameras[level + 1],
                n_left,
                accepted,
                steps,
                sizes,
                frame.masks,
                frame.mask_offset,
                keep,
                frame.min_cameras,
                room.n_seen,
            )
        else:
            room.n_open[level + 1], room.n_accept[level + 1] = n_left, accepted
            half = size // 2
            for child in range(4):
                i, j = i0 + half * (child & 1), j0 + half * (child >> 1)
                if i + j <= last:
                    stack[depth, 0], stack[depth, 1], stack[depth, 2] = i, j, level + 1
                    depth += 1


@inlined
def _appended(
    start: int, stop: int, runs: NDArray[np.int64], n_runs: int
) -> tuple[NDArray[np.int64], int]:
    """Return runs (R, 2) and their number with one more, joined to the last where that ends."""
    if n_runs > 0 and runs[n_runs - 1, 1] == start:
        runs[n_runs - 1, 1] = stop
        return runs, n_runs
    if n_runs == len(runs):
        longer = np.zeros((2 * n_runs, 2), np.int64)
        for run in range(n_runs):
            longer[run, 0], longer[run, 1] = runs[run, 0], runs[run, 1]
        runs = longer
    runs[n_runs, 0], runs[n_runs, 1] = start, stop
    return runs, n_runs + 1


@compiled
def _sample_batch(
    n_left: int,
    surface: Surface,
    frame: Frame,
    grid: _Grid,
    room: _Room,
    words: NDArray[np.uint64],
    runs: NDArray[np.int64],
    n_runs: int,
) -> tuple[NDArray[np.uint64], NDArray[np.int64], int]:
    """Append the runs of samples inside of the triangles that `batch_verdicts` left."""
    n_cameras = len(frame.matrices)
    for left in range(n_left):
        triangle = room.triangle[left]
        before = grid.samples_before[triangle]
        viewport = int(grid.viewports[triangle])
        # A small triangle starts with the smallest block around it.
        top = 0
        while top < _TILE_LEVEL and viewport <= _BLOCK >> top + 1:
            top += 1
        n_open = 0
        for camera in range(n_cameras):
            if room.is_open[left, camera]:
                room.cameras[top, n_open] = camera
                n_open += 1
        if n_open == 0:  # enough cameras see it, or it would have been dropped
            runs, n_runs = _appended(before, grid.samples_before[triangle + 1], runs, n_runs)
            continue

        room.n_open[top], room.n_accept[top] = n_open, room.accepted[left]
        tiles_per_edge = (viewport + 7) // 8
        n_words = tiles_per_edge * (tiles_per_edge + 1) // 2
        if n_words > len(words):
            words = np.zeros(2 * n_words, np.uint64)
        for word in range(n_words):
            words[word] = 0
        _project_steps(room.corners, left, viewport, frame, room.steps)
        for block_j in range(0, viewport, _BLOCK):
            for block_i in range(0, viewport - block_j, _BLOCK):
                _sample_block(
                    block_i, block_j, viewport, words, frame, surface.pads, grid.reject, top, room
                )
        row_start = before
        for j in range(viewport):
            tile_j = j // 8
            shift = np.uint64(8 * (j % 8))
            first_word = tile_j * tiles_per_edge - tile_j * (tile_j - 1) // 2
            for tile_i in range(tiles_per_edge - tile_j):
                bits = (words[first_word + tile_i] >> shift) & np.uint64(255)
                number = row_start + 8 * tile_i
                while bits:
                    if bits & np.uint64(1):
                        runs, n_runs = _appended(number, number + 1, runs, n_runs)
                    bits >>= np.uint64(1)
                    number += 1
            row_start += viewport - j
    return words, runs, n_runs


@compiled
def _open_nodes(level: int, tree: Tree, frame: Frame) -> NDArray[np.int64]:
    """Return the nodes of a level that are not proved free, counted within it, ascending."""
    n_cameras = len(frame.matrices)
    cameras, left = np.arange(n_cameras), np.zeros(n_cameras, np.int64)
    top = len(tree.level_start) - 2
    nodes = np.arange(tree.level_start[top], tree.level_start[top + 1])
    for depth in range(top, level - 1, -1):
        n_kept = 0
        for number in range(len(nodes)):
            _, _, is_free = node_verdict(
                tree.rectangles[nodes[number]],
                tree.order,
                frame.sizes,
                frame.integrals,
                frame.integral_offset,
                frame.keep,
                frame.min_cameras,
                cameras,
                n_cameras,
                np.int64(0),
                left,
            )
            if not is_free:
                nodes[n_kept] = nodes[number]
                n_kept += 1
        nodes = nodes[:n_kept]
        if depth > level:
            below = np.zeros(BRANCH * n_kept, np.int64)
            n_below = 0
            for number in range(n_kept):
                first = BRANCH * (nodes[number] - tree.level_start[depth])
                size = tree.level_start[depth] - tree.level_start[depth - 1]
                for child in range(first, min(first + BRANCH, size)):
                    below[n_below] = tree.level_start[depth - 1] + child
                    n_below += 1
            nodes = below[:n_below]
    return nodes - tree.level_start[level]


@compiled
def _query(
    nodes: NDArray[np.int64], level: int, tree: Tree, surface: Surface, frame: Frame, grid: _Grid
) -> NDArray[np.int64]:
    """Return the runs (R, 2) of samples inside of some nodes of a level of the tree, ascending.

    Without a tree (no levels), `nodes` are batches of triangles, asked one by one.
    """
    n_cameras = len(frame.matrices)
    n_triangles = len(surface.faces)
    has_tree = len(tree.level_start) > 0
    rectangles, order = tree.rectangles, tree.order
    sizes, integrals, integral_offset = frame.sizes, frame.integrals, frame.integral_offset
    room = _make_room(n_cameras)
    # Like `room.cameras` and its fellows, which sampling overwrites, for the levels of the tree.
    cameras = np.zeros((level + 2, n_cameras), np.int64)
    n_open, n_accept = np.zeros(level + 2, np.int64), np.zeros(level + 2, np.int64)
    for row in range(level + 2):
        for camera in range(n_cameras):
            cameras[row, camera] = camera
    n_open[level + 1] = n_cameras
    stack = np.zeros(((level + 1) * BRANCH + 1, 2), np.int64)  # node within its level, level
    words = np.zeros(4, np.uint64)
    runs, n_runs = np.zeros((256, 2), np.int64), np.int64(0)
    for number in range(len(nodes)):
        stack[0, 0], stack[0, 1] = nodes[number], level
        depth = 1
        while depth > 0:
            depth -= 1
            place, height = stack[depth, 0], stack[depth, 1]
            size, n_left, accepted = BATCH, n_cameras if grid.reject else 0, 0
            if has_tree:
                n_left, accepted, is_free = node_verdict(
                    rectangles[tree.level_start[height] + place],
                    order,
                    sizes,
                    integrals,
                    integral_offset,
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
            if has_tree and n_left == 0:
                runs, n_runs = _appended(
                    grid.samples_before[first], grid.samples_before[last], runs, n_runs
                )
            elif height == 0:
                n_kept = batch_verdicts(
                    first,
                    last - first,
                    surface,
                    frame,
                    cameras[0],
                    n_left,
                    accepted,
                    room.corners,
                    room.rectangles,
                    room.triangle,
                    room.accepted,
                    room.is_open,
                )
                if not grid.reject:
                    for kept in range(n_kept):
                        for camera in range(n_cameras):
                            room.is_open[kept, camera] = True
                words, runs, n_runs = _sample_batch(
                    n_kept, surface, frame, grid, room, words, runs, n_runs
                )
            else:
                n_open[height], n_accept[height] = n_left, accepted
                below = tree.level_start[height] - tree.level_start[height - 1]
                for child in range(min((place + 1) * BRANCH, below) - 1, place * BRANCH - 1, -1):
                    stack[depth, 0], stack[depth, 1] = child, height - 1
                    depth += 1
    return runs[:n_runs]


@dataclass(slots=True, eq=False)
class _Prepared:
    """What is derived from a mesh as long as it and the cameras stay the same."""

    views: Views
    surface: Surface
    tree: Tree | None  # from the second query on


class Native:
    """The volume query in compiled loops on the CPU.

    Parameters
    ----------
    n_threads : int, optional
        Threads that share the triangles; by default as many as the process may run on.
    reject : bool
        Whether rectangles decide before samples are taken. The result is the same without.
    """

    name = "native"

    def __init__(self, n_threads: int | None = None, *, reject: bool = True) -> None:
        self._n_threads = n_threads or _usable_cpus()
        self._reject = reject
        self._executor: ThreadPoolExecutor | None = None
        self._prepared: weakref.WeakKeyDictionary[Triangles, _Prepared] = (
            weakref.WeakKeyDictionary()
        )
        self.renderer = f"numba {numba.__version__}, {self._n_threads} threads, double precision"

    def query(self, hull: Hull, meshes: list[Triangles]) -> list[Hits]:
        """Return for each mesh its samples inside the hull of this frame."""
        frame, order = make_frame(hull)
        calls: list[tuple[Callable[..., NDArray[np.int64]], tuple[Any, ...]]] = []
        ends = [0]
        for mesh in meshes:
            calls += self._shares(hull.views, frame, order, mesh)
            ends.append(len(calls))
        runs = self._run(calls)
        return [
            _joined(mesh, runs[start:stop])
            for mesh, (start, stop) in zip(meshes, itertools.pairwise(ends), strict=True)
        ]

    def close(self) -> None:
        """End the threads; a later query starts them again."""
        if self._executor is not None:
            self._executor.shutdown()
            self._executor = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _shares(
        self, views: Views, frame: Frame, order: NDArray[np.int64], mesh: Triangles
    ) -> list[tuple[Callable[..., NDArray[np.int64]], tuple[Any, ...]]]:
        """Return calls that together answer for a mesh, in the order of its triangles."""
        if len(mesh) == 0:
            return []
        prepared = self._prepare(views, mesh)
        surface = prepared.surface._replace(pads=prepared.surface.pads[order])
        grid = _Grid(mesh.viewports, mesh.topology.samples_before, self._reject)
        n_shares = _SHARES * self._n_threads
        if prepared.tree is None:
            n_batches = -(-len(mesh) // BATCH)
            share = max(_SHARE_TRIANGLES // BATCH, -(-n_batches // n_shares))
            return [
                (
                    _query,
                    (
                        np.arange(start, min(start + share, n_batches)),
                        0,
                        NO_TREE,
                        surface,
                        frame,
                        grid,
                    ),
                )
                for start in range(0, n_batches, share)
            ]
        tree = prepared.tree._replace(order=order)
        level = len(tree.level_start) - 2
        while level > 0 and CLUSTER * BRANCH**level > _SHARE_TRIANGLES:
            level -= 1
        nodes = _open_nodes(level, tree, frame)
        cuts = np.linspace(0, len(nodes), min(len(nodes), n_shares) + 1).astype(np.int64)
        return [
            (_query, (nodes[start:stop], level, tree, surface, frame, grid))
            for start, stop in itertools.pairwise(cuts.tolist())
        ]

    def _prepare(self, views: Views, mesh: Triangles) -> _Prepared:
        prepared = self._prepared.get(mesh)
        if prepared is None or prepared.views is not views:
            vertices_local, reach_m = _localized(mesh.vertices_world, views.origin_world)
            pads = rectangle_pads(views, reach_m, ROUNDOFF_FLOAT64)
            prepared = _Prepared(views, Surface(vertices_local, mesh.faces, pads), None)
            self._prepared[mesh] = prepared
        elif prepared.tree is None and self._reject and len(mesh) >= _TREE_TRIANGLES:
            prepared.tree = make_tree(views, prepared.surface, self._run_with)
        return prepared

    def _run_with(self, function: Callable[..., None], shares: list[tuple[Any, ...]]) -> None:
        self._run([(function, arguments) for arguments in shares])

    def _run(self, calls: list[tuple[Callable[..., Any], tuple[Any, ...]]]) -> list[Any]:
        """Work off all calls; whichever thread is free takes the next one."""
        results: list[Any] = [None] * len(calls)
        numbers = itertools.count()  # next() is atomic

        def work() -> None:
            while (number := next(numbers)) < len(calls):
                function, arguments = calls[number]
                results[number] = function(*arguments)

        n_helpers = min(self._n_threads, len(calls)) - 1
        if n_helpers > 0 and self._executor is None:
            self._executor = ThreadPoolExecutor(self._n_threads - 1, "volume-query")
        helpers = [
            self._executor.submit(work) for _ in range(n_helpers) if self._executor is not None
        ]
        work()
        for helper in helpers:
            helper.result()
        return results


def make_frame(hull: Hull) -> tuple[Frame, NDArray[np.int64]]:
    """Return a hull as compiled loops take it, and the order (C,) in which cameras are asked.

    The camera that sees the smallest silhouette rejects most: it is asked first.
    """
    views = hull.views
    ends = hull.integral_offset + (views.sizes_px + 1).prod(axis=1) - 1
    order = np.argsort(hull.integrals_flat[ends] / views.sizes_px.prod(axis=1), kind="stable")
    frame = Frame(
        views.img_from_local.reshape(-1, 12)[order],
        views.sizes_px[order],
        _read_only(hull.masks_flat),
        hull.mask_offset[order],
        _read_only(hull.integrals_flat),
        hull.integral_offset[order],
        views.unseen == "keep",
        views.min_cameras,
    )
    return frame, order


def _usable_cpus() -> int:
    """Return how many processors this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Return a view that cannot be written to, so that one compiled version takes every array."""
    view = array.view()
    view.flags.writeable = False
    return view


def _joined(mesh: Triangles, parts: list[NDArray[np.int64]]) -> Hits:
    runs = np.concatenate([np.zeros((0, 2), np.int64), *parts])
    start, stop = runs[:, 0], runs[:, 1]
    is_joined = start[1:] == stop[:-1]  # one share ends where the next begins
    return Hits(
        mesh.topology,
        start[np.concatenate([[True], ~is_joined])[: len(start)]],
        stop[np.concatenate([~is_joined, [True]])[: len(stop)]],
    )
