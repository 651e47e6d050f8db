"""The volume query on the CPU: compiled loops that reject before they sample.

Clusters of triangles are asked first what the rectangle around their projection proves (see
`hybridve.hull.query.rectangles`), then the triangles of the clusters that stay open. Of the rest,
the sample grid is halved again and again, down to tiles of 8 x 8 samples, each asked the same
question, and only tiles that stay open are sampled, in the cameras that left them open. A tile's
samples are the bits of one word. All in double precision, so the samples returned do not depend on
what was rejected beforehand.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import ZERO, compiled, inlined
from hybridve.hull.query.boxes import (
    ABSTAINS,
    ACCEPTS,
    REJECTS,
    UNDECIDED,
    WITHHOLDS,
    pixel_range,
    rectangle_vote,
)
from hybridve.hull.query.clusters import make_shares
from hybridve.hull.query.engine import Closing, Hits, Triangles
from hybridve.hull.query.frame import Frame
from hybridve.hull.query.points import pixel_of
from hybridve.hull.query.rectangles import Surface, Tree, load_corners, survivors
from hybridve.hull.query.silhouettes import BACKGROUND, OBJECT, Hull
from hybridve.hull.query.threads import Threads
from hybridve.hull.query.viewport import n_samples, sample_steps

#: Edge in samples of the blocks that the sample grid is cut into before it is halved.
_BLOCK = 64
#: Halvings of a block down to a tile of 8 x 8 samples, the bits of a word.
_TILE_LEVEL = 3
#: A tile of fewer samples is sampled at once: the rectangle test costs about as much.
_MIN_TESTED = 16

#: Viewports up to this are sampled without more rectangles: the first of a few tiles would hold
#: most of their samples anyway.
_SMALL_VIEWPORT = 16

#: Steps i, j of the samples of small viewports: (viewport, 2, sample).
_SMALL_GRIDS = np.zeros((_SMALL_VIEWPORT + 1, 2, n_samples(_SMALL_VIEWPORT)))
for _viewport in range(1, _SMALL_VIEWPORT + 1):
    _samples = np.arange(n_samples(_viewport), dtype=np.uint32)
    _SMALL_GRIDS[_viewport, :, : len(_samples)] = sample_steps(
        np.full(len(_samples), _viewport, np.int32), _samples
    )

#: Added to the cameras that see a sample when one denies it: more than there are cameras.
_NEVER = -(1 << 32)

#: The samples of a tile with di + dj <= m, for m = 0..14: bit 8 dj + di.
_TILE_BITS = np.array(
    [sum(1 << 8 * j + i for j in range(8) for i in range(8) if i + j <= m) for m in range(15)],
    dtype=np.uint64,
)


class _Grid(NamedTuple):
    """Where the samples of a mesh are, and how they are numbered."""

    viewports: NDArray[np.int32]
    samples_before: NDArray[np.int64]


class _Room(NamedTuple):
    """What a thread works in."""

    corners: NDArray[np.float64]  # (9, 1)
    steps: NDArray[np.float64]  # (C, 9)
    cameras: NDArray[np.int64]  # (levels, C): the cameras that leave a node's parent open
    n_open: NDArray[np.int64]  # (levels,) how many these are
    n_accept: NDArray[np.int64]  # (levels,) how many others see nothing but object pixels
    stack: NDArray[np.int64]  # (nodes, 3)
    n_seen: NDArray[np.int64]  # (64,)


@compiled
def _project_steps(
    corners: NDArray[np.float64],
    viewport: int,
    matrices: NDArray[np.float64],
    cameras: NDArray[np.int64],
    n_cameras: int,
    steps: NDArray[np.float64],
) -> None:
    """Write the projection of sample (0, 0) and of one step in i and in j in some cameras: (C, 9).

    The triangle's corners are (9, 1).
    """
    per_edge = 1.0 / max(viewport - 1, 1)
    for number in range(n_cameras):
        camera = cameras[number]
        for row in range(3):
            at_a, along_b, along_c = matrices[camera, 4 * row + 3], 0.0, 0.0
            for k in range(3):
                entry = matrices[camera, 4 * row + k]
                a, b, c = corners[k, 0], corners[3 + k, 0], corners[6 + k, 0]
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
    camera: int,
    recorded: NDArray[np.int64] | None,
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
    first_x, last_x = pixel_range(low_x, high_x, width_px, ZERO)
    first_y, last_y = pixel_range(low_y, high_y, height_px, ZERO)
    return rectangle_vote(
        first_x,
        last_x,
        first_y,
        last_y,
        width_px,
        height_px,
        first,
        integrals,
        keep,
        camera,
        recorded,
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
    answers: NDArray[np.uint8],
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
        width, height, first = sizes[camera, 0], sizes[camera, 1], mask_offset[camera]
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
                pixel = pixel_of(depth_m, pixel_x, pixel_y, width, height, first)
                if pixel >= 0:
                    answer = answers[pixel]
                    if keep:
                        n_seen[8 * dj + di] += answer == OBJECT
                    if answer == BACKGROUND:
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
        accepted, n_left, n_withheld = room.n_accept[level], ZERO, ZERO
        is_free = False
        # The block that holds the whole triangle was asked with it.
        is_known = level == top and viewport <= size
        is_tested = not is_known and (edge * (edge + 1) // 2 >= _MIN_TESTED)
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
                    camera,
                    frame.recorded,
                )
            if vote == REJECTS:
                is_free = True
                break
            if vote == ACCEPTS:
                accepted += 1
            elif vote != ABSTAINS:
                cameras[level + 1, n_left] = camera
                n_left += 1
                n_withheld += vote == WITHHOLDS
        if is_free or (keep and accepted + n_left - n_withheld < frame.min_cameras):
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
                frame.answers,
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
def _sample_all(
    viewport: int,
    before: int,
    cameras: NDArray[np.int64],
    n_cameras: int,
    n_accept: int,
    steps: NDArray[np.float64],
    sizes: NDArray[np.int64],
    answers: NDArray[np.uint8],
    mask_offset: NDArray[np.int64],
    keep: bool,
    min_cameras: int,
    pixels: NDArray[np.int64],
    n_seen: NDArray[np.int64],
    runs: NDArray[np.int64],
    n_runs: int,
) -> tuple[NDArray[np.int64], int]:
    """Append the samples inside of a small viewport, asked of some cameras, to the runs."""
    n_samples = viewport * (viewport + 1) // 2
    for sample in range(n_samples):
        n_seen[sample] = n_accept
    for number in range(n_cameras):
        camera = cameras[number]
        width, height, first = sizes[camera, 0], sizes[camera, 1], mask_offset[camera]
        a_x, a_y, a_z = steps[camera, 0], steps[camera, 1], steps[camera, 2]
        b_x, b_y, b_z = steps[camera, 3], steps[camera, 4], steps[camera, 5]
        c_x, c_y, c_z = steps[camera, 6], steps[camera, 7], steps[camera, 8]
        for sample in range(n_samples):  # free of branches: several in one instruction
            i, j = _SMALL_GRIDS[viewport, 0, sample], _SMALL_GRIDS[viewport, 1, sample]
            depth_m = a_z + j * c_z + i * b_z
            per_depth = 1.0 / depth_m
            pixel_x = (a_x + j * c_x + i * b_x) * per_depth
            pixel_y = (a_y + j * c_y + i * b_y) * per_depth
            pixels[sample] = pixel_of(depth_m, pixel_x, pixel_y, width, height, first)
        for sample in range(n_samples):
            pixel = pixels[sample]
            if pixel >= 0:
                answer = answers[pixel]
                n_seen[sample] += _NEVER if answer == BACKGROUND else answer == OBJECT
            elif not keep:
                n_seen[sample] += _NEVER
    needed = min_cameras if keep else n_accept + n_cameras
    start = ZERO - 1
    for sample in range(n_samples):
        if n_seen[sample] >= needed:
            if start < 0:
                start = sample
        elif start >= 0:
            runs, n_runs = _appended(before + start, before + sample, runs, n_runs)
            start = ZERO - 1
    if start >= 0:
        runs, n_runs = _appended(before + start, before + n_samples, runs, n_runs)
    return runs, n_runs


@compiled
def _query(
    nodes: NDArray[np.int64], level: int, tree: Tree, surface: Surface, frame: Frame, grid: _Grid
) -> NDArray[np.int64]:
    """Return the runs (R, 2) of samples inside of some nodes of a mesh, ascending.

    See `hybridve.hull.query.rectangles.survivors` for what the nodes are.
    """
    n_cameras = len(frame.matrices)
    room = _Room(
        np.zeros((9, 1)),
        np.zeros((n_cameras, 9)),
        np.zeros((_TILE_LEVEL + 2, n_cameras), np.int64),
        np.zeros(_TILE_LEVEL + 2, np.int64),
        np.zeros(_TILE_LEVEL + 2, np.int64),
        np.zeros((3 * _TILE_LEVEL + 2, 3), np.int64),
        np.zeros(64, np.int64),
    )
    words = np.zeros(4, np.uint64)
    runs, n_runs = np.zeros((256, 2), np.int64), ZERO
    left = survivors(nodes, level, tree, surface, frame)
    vertices, faces, matrices = surface.vertices_local, surface.faces, frame.matrices
    sizes, answers, mask_offset = frame.sizes, frame.answers, frame.mask_offset
    steps = room.steps
    pixels, n_seen = np.zeros((2, len(_SMALL_GRIDS[0, 0])), np.int64)
    for k in range(len(left.start)):
        triangle = left.start[k]
        before = grid.samples_before[triangle]
        viewport = int(grid.viewports[triangle])
        # A small triangle starts with the smallest block around it.
        top = 0
        while top < _TILE_LEVEL and viewport <= _BLOCK >> top + 1:
            top += 1
        n_open = ZERO
        for camera in range(n_cameras):
            if left.is_open[k, camera]:
                room.cameras[top, n_open] = camera
                n_open += 1
        if n_open == 0:  # enough cameras see it, or it would have been dropped
            runs, n_runs = _appended(before, grid.samples_before[left.stop[k]], runs, n_runs)
            continue

        load_corners(triangle, ZERO + 1, vertices, faces, room.corners)
        _project_steps(room.corners, viewport, matrices, room.cameras[top], n_open, room.steps)
        if viewport <= _SMALL_VIEWPORT:
            runs, n_runs = _sample_all(
                viewport,
                before,
                room.cameras[top],
                n_open,
                left.n_accept[k],
                steps,
                sizes,
                answers,
                mask_offset,
                frame.keep,
                frame.min_cameras,
                pixels,
                n_seen,
                runs,
                n_runs,
            )
            continue

        room.n_open[top], room.n_accept[top] = n_open, left.n_accept[k]
        tiles_per_edge = (viewport + 7) // 8
        n_words = tiles_per_edge * (tiles_per_edge + 1) // 2
        if n_words > len(words):
            words = np.zeros(2 * n_words, np.uint64)
        for word in range(n_words):
            words[word] = 0
        for block_j in range(0, viewport, _BLOCK):
            for block_i in range(0, viewport - block_j, _BLOCK):
                _sample_block(block_i, block_j, viewport, words, frame, surface.pads, top, room)
        row_start = before
        for j in range(viewport):
            tile_j = j // 8
            shift = np.uint64(8 * (j % 8))
            first_word = tile_j * tiles_per_edge - tile_j * (tile_j - 1) // 2
            for tile_i in range(tiles_per_edge - tile_j):
                bits = (words[first_word + tile_i] >> shift) & np.uint64(255)
                number = row_start + 8 * tile_i
                if bits == np.uint64(255):
                    runs, n_runs = _appended(number, number + 8, runs, n_runs)
                    continue
                while bits:
                    if bits & np.uint64(1):
                        runs, n_runs = _appended(number, number + 1, runs, n_runs)
                    bits >>= np.uint64(1)
                    number += 1
            row_start += viewport - j
    return runs[:n_runs]


class Native(Closing):
    """The volume query in compiled loops on the CPU.

    Parameters
    ----------
    n_threads : int, optional
        Threads that share the triangles; by default as many as the process may run on.
    reject : bool
        Whether rectangles decide before samples are taken. The result is the same without.
    """

    name = "native"
    any_thread = True

    def __init__(self, n_threads: int | None = None, *, reject: bool = True) -> None:
        self._threads = Threads(n_threads)
        self._reject = reject
        self.renderer = (
            f"numba {numba.__version__}, {self._threads.number} threads, double precision"
        )

    def query(self, hull: Hull, meshes: list[Triangles]) -> list[Hits]:
        """Return for each mesh its samples inside the hull of this frame."""
        frame = hull.frame
        calls: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        ends = [0]
        for mesh in meshes:
            grid = _Grid(mesh.viewports, mesh.topology.samples_before)
            shares = make_shares(hull, frame, mesh, self._threads, reject=self._reject)
            calls += [(_query, (*share, frame, grid)) for share in shares]
            ends.append(len(calls))
        runs = self._threads.run(calls)
        return [
            _joined(mesh, runs[start:stop])
            for mesh, (start, stop) in zip(meshes, itertools.pairwise(ends), strict=True)
        ]

    def close(self) -> None:
        """End the threads; a later query starts them again."""
        self._threads.close()


def _joined(mesh: Triangles, parts: list[NDArray[np.int64]]) -> Hits:
    runs = np.concatenate([np.zeros((0, 2), np.int64), *parts])
    start, stop = runs[:, 0], runs[:, 1]
    is_joined = start[1:] == stop[:-1]  # one share ends where the next begins
    return Hits(
        mesh.topology,
        start[np.concatenate([[True], ~is_joined])[: len(start)]],
        stop[np.concatenate([~is_joined, [True]])[: len(stop)]],
    )
