"""The volume query on the CPU: compiled loops that reject before they sample.

Each triangle is asked first what the rectangle around its projection proves (see
`hybridve.hull.query.bounds`); most are proved free by the first camera. Of the rest, the sample
grid is halved again and again, down to tiles of 8 x 8 samples, each asked the same question, and
only tiles that stay open are sampled, in the cameras that left them open. A tile's samples are the
bits of one word. All in double precision, so the samples returned do not depend on what was
rejected beforehand.

Triangles are dealt out to plain Python threads, which sleep between queries. numba's own thread
pools are not used: they spin while they wait and slow down whatever else runs (OpenCV, Open3D).
"""

import itertools
import os
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import numba
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import compiled
from hybridve.hull.query.bounds import ROUNDOFF_FLOAT64, rectangle_pads
from hybridve.hull.query.engine import Hits, Triangles
from hybridve.hull.query.silhouettes import Hull, Views

#: Triangles that a thread takes at a time, at most, and samples that these may have together.
_SHARE_TRIANGLES, _SHARE_SAMPLES = 8192, 1 << 20

#: Triangles whose rectangles are computed together: their corners stay in the first cache.
_BATCH = 256

#: Edge in samples of the blocks that the sample grid is cut into before it is halved.
_BLOCK = 64
#: Halvings of a block down to a tile of 8 x 8 samples, the bits of a word.
_TILE_LEVEL = 3
#: A tile of fewer samples is sampled at once: the rectangle test costs about as much.
_MIN_TESTED = 16

#: What one camera's rectangle proves: no sample inside, all on object pixels, none seen, nothing.
_REJECTS, _ACCEPTS, _ABSTAINS, _UNDECIDED = 0, 1, 2, 3

#: The samples of a tile with di + dj <= m, for m = 0..14: bit 8 dj + di.
_TILE_BITS = np.array(
    [sum(1 << 8 * j + i for j in range(8) for i in range(8) if i + j <= m) for m in range(15)],
    dtype=np.uint64,
)


@compiled
def _rectangle_vote(
    first_x: int,
    last_x: int,
    first_y: int,
    last_y: int,
    camera: int,
    sizes: NDArray[np.int64],
    integrals: NDArray[np.int32],
    integral_offset: NDArray[np.int64],
    keep: bool,
) -> int:
    """Return what a rectangle of pixels, clamped to -1..size, proves in one camera."""
    width, height, first = sizes[camera, 0], sizes[camera, 1], integral_offset[camera]
    x0, x1 = max(first_x, 0), min(last_x + 1, width)
    y0, y1 = max(first_y, 0), min(last_y + 1, height)
    if x1 <= x0 or y1 <= y0:
        return _ABSTAINS if keep else _REJECTS
    wholly_seen = first_x >= 0 and first_y >= 0 and last_x < width and last_y < height
    stride = width + 1
    count = (
        integrals[first + y1 * stride + x1]
        - integrals[first + y0 * stride + x1]
        - integrals[first + y1 * stride + x0]
        + integrals[first + y0 * stride + x0]
    )
    if count == 0 and (wholly_seen or not keep):
        return _REJECTS
    if wholly_seen and count == (x1 - x0) * (y1 - y0):
        return _ACCEPTS
    return _UNDECIDED


@compiled
def _triangle_rectangles(
    n_triangles: int,
    corners: NDArray[np.float64],
    camera: int,
    matrices: NDArray[np.float64],
    sizes: NDArray[np.int64],
    pads: NDArray[np.float64],
    rectangles: NDArray[np.int32],
) -> None:
    """Write the pixels first_x, last_x, first_y, last_y that triangles project into: (4, n).

    Free of branches, and corners (9, n) lie coordinate after coordinate, so that the compiler
    takes several triangles in one instruction.
    """
    m = matrices
    m0, m1, m2, m3 = m[camera, 0], m[camera, 1], m[camera, 2], m[camera, 3]
    m4, m5, m6, m7 = m[camera, 4], m[camera, 5], m[camera, 6], m[camera, 7]
    m8, m9, m10, m11 = m[camera, 8], m[camera, 9], m[camera, 10], m[camera, 11]
    pad_x, pad_y, near_m = pads[camera, 0], pads[camera, 1], pads[camera, 2]
    width, height = float(sizes[camera, 0]), float(sizes[camera, 1])
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
def _triangle_verdicts(
    start: int,
    n_triangles: int,
    vertices_local: NDArray[np.float64],
    faces: NDArray[np.int32],
    matrices: NDArray[np.float64],
    sizes: NDArray[np.int64],
    pads: NDArray[np.float64],
    integrals: NDArray[np.int32],
    integral_offset: NDArray[np.int64],
    keep: bool,
    min_cameras: int,
    corners: NDArray[np.float64],
    rectangles: NDArray[np.int32],
    numbers: NDArray[np.int64],
    votes: NDArray[np.int64],
) -> int:
    """Reject a batch of triangles camera after camera; return how many are not proved free.

    Their numbers are left in `numbers`, in order; row 0 of `votes` says how many cameras see
    nothing but object pixels, row 1 how many see nothing at all.
    """
    n_left = n_triangles
    for i in range(n_triangles):
        for k in range(3):
            vertex = faces[start + i, k]
            corners[3 * k, i] = vertices_local[vertex, 0]
            corners[3 * k + 1, i] = vertices_local[vertex, 1]
            corners[3 * k + 2, i] = vertices_local[vertex, 2]
        numbers[i], votes[0, i], votes[1, i] = start + i, 0, 0
    n_cameras = len(matrices)
    for camera in range(n_cameras):
        _triangle_rectangles(n_left, corners, camera, matrices, sizes, pads, rectangles)
        n_kept = 0
        for i in range(n_left):
            vote = _rectangle_vote(
                rectangles[0, i],
                rectangles[1, i],
                rectangles[2, i],
                rectangles[3, i],
                camera,
                sizes,
                integrals,
                integral_offset,
                keep,
            )
            if vote == _REJECTS:
                continue
            n_abstain = votes[1, i] + (vote == _ABSTAINS)
            if keep and n_cameras - n_abstain < min_cameras:
                continue
            numbers[n_kept] = numbers[i]
            votes[0, n_kept] = votes[0, i] + (vote == _ACCEPTS)
            votes[1, n_kept] = n_abstain
            for k in range(9):
                corners[k, n_kept] = corners[k, i]
            n_kept += 1
        n_left = n_kept
    return n_left


@compiled
def _project_steps(
    corners: NDArray[np.float64],
    viewport: int,
    matrices: NDArray[np.float64],
    steps: NDArray[np.float64],
) -> None:
    """Write the projection of sample (0, 0) and of one step in i and in j: (C, 9)."""
    per_edge = 1.0 / max(viewport - 1, 1)
    for camera in range(len(matrices)):
        for row in range(3):
            at_a, along_b, along_c = matrices[camera, 4 * row + 3], 0.0, 0.0
            for k in range(3):
                entry = matrices[camera, 4 * row + k]
                a, b, c = corners[0, k], corners[1, k], corners[2, k]
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
    camera: int,
    steps: NDArray[np.float64],
    sizes: NDArray[np.int64],
    pads: NDArray[np.float64],
    integrals: NDArray[np.int32],
    integral_offset: NDArray[np.int64],
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
        depth_m = steps[camera, 2] + i * steps[camera, 5] + j * steps[camera, 8]
        per_depth = 1.0 / depth_m
        pixel_x = (steps[camera, 0] + i * steps[camera, 3] + j * steps[camera, 6]) * per_depth
        pixel_y = (steps[camera, 1] + i * steps[camera, 4] + j * steps[camera, 7]) * per_depth
        low_x, high_x = min(low_x, pixel_x), max(high_x, pixel_x)
        low_y, high_y = min(low_y, pixel_y), max(high_y, pixel_y)
        depth_min_m, depth_max_m = min(depth_min_m, depth_m), max(depth_max_m, depth_m)
    width, height = float(sizes[camera, 0]), float(sizes[camera, 1])
    near_m = pads[camera, 2]
    if depth_min_m >= near_m:
        pad_x, pad_y = pads[camera, 0] / depth_min_m, pads[camera, 1] / depth_min_m
        low_x, high_x = low_x - pad_x, high_x + pad_x
        low_y, high_y = low_y - pad_y, high_y + pad_y
    else:
        low_x, high_x = -1.0, -1.0 if depth_max_m <= -near_m else width
        low_y, high_y = -1.0, height
    return _rectangle_vote(
        int(np.floor(min(max(low_x, -1.0), width))),
        int(np.floor(min(max(high_x, -1.0), width))),
        int(np.floor(min(max(low_y, -1.0), height))),
        int(np.floor(min(max(high_y, -1.0), height))),
        camera,
        sizes,
        integrals,
        integral_offset,
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
        n_seen[:] = n_accept
    for number in range(n_cameras):
        camera = cameras[number]
        width, height = sizes[camera, 0], sizes[camera, 1]
        right, bottom = float(width), float(height)
        first = mask_offset[camera]
        for dj in range(min(rest, 7) + 1):
            j = float(j0 + dj)
            x0, y0, z0 = (
                steps[camera, 0] + j * steps[camera, 6],
                steps[camera, 1] + j * steps[camera, 7],
                steps[camera, 2] + j * steps[camera, 8],
            )
            for di in range(min(rest - dj, 7) + 1):
                bit = 8 * dj + di
                if not (word >> np.uint64(bit)) & one:
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
                        n_seen[bit] += 1
                    if not masks[first + int(pixel_y) * width + int(pixel_x)]:
                        word &= ~(one << np.uint64(bit))
                elif not keep:
                    word &= ~(one << np.uint64(bit))
        if word == 0:
            return word
    if keep:
        for bit in range(64):
            if n_seen[bit] < min_cameras:
                word &= ~(one << np.uint64(bit))
    return word


@compiled
def _sample_block(
    block_i: int,
    block_j: int,
    viewport: int,
    words: NDArray[np.uint64],
    steps: NDArray[np.float64],
    open_cameras: NDArray[np.int64],
    n_seen: NDArray[np.int64],
    sizes: NDArray[np.int64],
    pads: NDArray[np.float64],
    masks: NDArray[np.uint8],
    mask_offset: NDArray[np.int64],
    integrals: NDArray[np.int32],
    integral_offset: NDArray[np.int64],
    keep: bool,
    min_cameras: int,
    reject: bool,
) -> None:
    """Write the words of a block of samples, halving it as long as the rectangles leave it open.

    Row l of `open_cameras` (_TILE_LEVEL + 2, C) holds the cameras that leave the parent of the
    nodes at level l open. Nodes are taken from the stack deepest first, so a row is overwritten
    only after all nodes below its writer are done.
    """
    last = viewport - 1
    tiles_per_edge = (viewport + 7) // 8
    n_cameras = len(steps)
    n_open = np.zeros(_TILE_LEVEL + 2, np.int64)
    n_accept = np.zeros(_TILE_LEVEL + 2, np.int64)
    stack = np.zeros((3 * _TILE_LEVEL + 2, 3), np.int64)  # i0, j0, level

    level = 0
    while level < _TILE_LEVEL and last - block_i - block_j < _BLOCK >> level + 1:
        level += 1  # a small triangle starts with the smallest block around it
    for camera in range(n_cameras):
        open_cameras[level, camera] = camera
    n_open[level] = n_cameras
    stack[0, 0], stack[0, 1], stack[0, 2] = block_i, block_j, level
    depth = 1
    while depth > 0:
        depth -= 1
        i0, j0, level = stack[depth, 0], stack[depth, 1], stack[depth, 2]
        size = _BLOCK >> level
        rest = last - i0 - j0
        edge = min(rest, size - 1) + 1
        accepted, remaining = n_accept[level], 0
        is_free = False
        is_tested = reject and (edge * (edge + 1) // 2 >= _MIN_TESTED)
        for number in range(n_open[level]):
            camera = open_cameras[level, number]
            vote = _UNDECIDED
            if is_tested:
                vote = _tile_vote(
                    i0,
                    j0,
                    size,
                    last,
                    camera,
                    steps,
                    sizes,
                    pads,
                    integrals,
                    integral_offset,
                    keep,
                )
            if vote == _REJECTS:
                is_free = True
                break
            if vote == _ACCEPTS:
                accepted += 1
            elif vote == _UNDECIDED:
                open_cameras[level + 1, remaining] = camera
                remaining += 1
        if is_free or (keep and accepted + remaining < min_cameras):
            continue
        if remaining == 0:
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
                open_cameras[level + 1],
                remaining,
                accepted,
                steps,
                sizes,
                masks,
                mask_offset,
                keep,
                min_cameras,
                n_seen,
            )
        else:
            n_open[level + 1], n_accept[level + 1] = remaining, accepted
            half = size // 2
            for child in range(4):
                i, j = i0 + half * (child & 1), j0 + half * (child >> 1)
                if i + j <= last:
                    stack[depth, 0], stack[depth, 1], stack[depth, 2] = i, j, level + 1
                    depth += 1


@compiled
def _grown(array: NDArray[np.uint32], used: int, needed: int) -> NDArray[np.uint32]:
    """Return an array with room for `needed` numbers that begins as `array` does."""
    larger = np.zeros(max(needed, 2 * len(array)), np.uint32)
    larger[:used] = array[:used]
    return larger


@compiled
def _query_range(
    start: int,
    stop: int,
    vertices_local: NDArray[np.float64],
    faces: NDArray[np.int32],
    viewports: NDArray[np.int32],
    matrices: NDArray[np.float64],
    sizes: NDArray[np.int64],
    pads: NDArray[np.float64],
    masks: NDArray[np.uint8],
    mask_offset: NDArray[np.int64],
    integrals: NDArray[np.int32],
    integral_offset: NDArray[np.int64],
    keep: bool,
    min_cameras: int,
    reject: bool,
) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return triangle and number of the samples inside the hull, of triangles start..stop."""
    n_cameras = len(matrices)
    batch_corners = np.zeros((9, _BATCH))
    rectangles = np.zeros((4, _BATCH), np.int32)
    numbers = np.zeros(_BATCH, np.int64)
    votes = np.zeros((2, _BATCH), np.int64)
    corners = np.zeros((3, 3))
    steps = np.zeros((n_cameras, 9))
    open_cameras = np.zeros((_TILE_LEVEL + 2, n_cameras), np.int64)
    n_seen = np.zeros(64, np.int64)
    words = np.zeros(4, np.uint64)
    hit_triangle, hit_sample = np.zeros(256, np.uint32), np.zeros(256, np.uint32)
    n_hits = 0
    for batch_start in range(start, stop, _BATCH):
        n_left = min(_BATCH, stop - batch_start)
        if reject:
            n_left = _triangle_verdicts(
                batch_start,
                n_left,
                vertices_local,
                faces,
                matrices,
                sizes,
                pads,
                integrals,
                integral_offset,
                keep,
                min_cameras,
                batch_corners,
                rectangles,
                numbers,
                votes,
            )
        for left in range(n_left):
            triangle = numbers[left] if reject else batch_start + left
            viewport = int(viewports[triangle])
            n_samples = viewport * (viewport + 1) // 2
            n_accept, n_abstain = votes[0, left], votes[1, left]
            # Enough cameras see it, or it would have been dropped.
            if reject and n_accept + n_abstain == n_cameras:
                if n_hits + n_samples > len(hit_triangle):
                    hit_triangle = _grown(hit_triangle, n_hits, n_hits + n_samples)
                    hit_sample = _grown(hit_sample, n_hits, n_hits + n_samples)
                for sample in range(n_samples):
                    hit_triangle[n_hits + sample] = triangle
                    hit_sample[n_hits + sample] = sample
                n_hits += n_samples
                continue

            for k in range(3):
                for axis in range(3):
                    corners[k, axis] = vertices_local[faces[triangle, k], axis]
            tiles_per_edge = (viewport + 7) // 8
            n_words = tiles_per_edge * (tiles_per_edge + 1) // 2
            if n_words > len(words):
                words = np.zeros(n_words, np.uint64)
            words[:n_words] = 0
            _project_steps(corners, viewport, matrices, steps)
            for block_j in range(0, viewport, _BLOCK):
                for block_i in range(0, viewport - block_j, _BLOCK):
                    _sample_block(
                        block_i,
                        block_j,
                        viewport,
                        words,
                        steps,
                        open_cameras,
                        n_seen,
                        sizes,
                        pads,
                        masks,
                        mask_offset,
                        integrals,
                        integral_offset,
                        keep,
                        min_cameras,
                        reject,
                    )
            row_start = 0
            for j in range(viewport):
                tile_j = j // 8
                shift = np.uint64(8 * (j % 8))
                first_word = tile_j * tiles_per_edge - tile_j * (tile_j - 1) // 2
                if n_hits + viewport > len(hit_triangle):
                    hit_triangle = _grown(hit_triangle, n_hits, n_hits + viewport)
                    hit_sample = _grown(hit_sample, n_hits, n_hits + viewport)
                for tile_i in range(tiles_per_edge - tile_j):
                    bits = (words[first_word + tile_i] >> shift) & np.uint64(255)
                    sample = row_start + 8 * tile_i
                    while bits:
                        if bits & np.uint64(1):
                            hit_triangle[n_hits] = triangle
                            hit_sample[n_hits] = sample
                            n_hits += 1
                        bits >>= np.uint64(1)
                        sample += 1
                row_start += viewport - j
    return hit_triangle[:n_hits], hit_sample[:n_hits]


@dataclass(frozen=True, slots=True, eq=False)
class _Prepared:
    """What is derived from a mesh as long as it and the cameras stay the same."""

    views: Views
    vertices_local: NDArray[np.float64]
    pads: NDArray[np.float64]
    share: int  # triangles that a thread takes at a time


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
        # The camera that sees the smallest silhouette rejects most: ask it first.
        ends = hull.integral_offset + (hull.views.sizes_px + 1).prod(axis=1) - 1
        order = np.argsort(hull.integrals_flat[ends] / hull.views.sizes_px.prod(axis=1))
        cameras = (
            hull.views.img_from_local.reshape(-1, 12)[order],
            hull.views.sizes_px[order],
        )
        images = (
            _read_only(hull.masks_flat),
            hull.mask_offset[order],
            _read_only(hull.integrals_flat),
            hull.integral_offset[order],
            hull.views.unseen == "keep",
            hull.views.min_cameras,
            self._reject,
        )
        shares: list[tuple[int, tuple[Any, ...]]] = []
        for number, mesh in enumerate(meshes):
            prepared = self._prepare(hull.views, mesh)
            arguments = (
                prepared.vertices_local,
                mesh.faces,
                mesh.viewports,
                *cameras,
                prepared.pads[order],
                *images,
            )
            shares += [
                (number, (start, min(start + prepared.share, len(mesh)), *arguments))
                for start in range(0, len(mesh), prepared.share)
            ]
        parts = self._run([arguments for _, arguments in shares])
        result: list[list[tuple[NDArray[np.uint32], NDArray[np.uint32]]]] = [[] for _ in meshes]
        for (number, _), part in zip(shares, parts, strict=True):
            result[number].append(part)
        return [
            _joined(mesh, parts_of_mesh) for mesh, parts_of_mesh in zip(meshes, result, strict=True)
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

    def _prepare(self, views: Views, mesh: Triangles) -> _Prepared:
        prepared = self._prepared.get(mesh)
        if prepared is None or prepared.views is not views:
            vertices_local = mesh.vertices_world - views.origin_world
            reach_m = np.abs(vertices_local).max(axis=0, initial=0.0)
            pads = rectangle_pads(views, reach_m, ROUNDOFF_FLOAT64)
            viewports = mesh.viewports.astype(np.float64)
            n_samples = (
                max(1.0, float((viewports * (viewports + 1) / 2).mean())) if len(mesh) else 1
            )
            share = max(1, min(_SHARE_TRIANGLES, int(_SHARE_SAMPLES / n_samples)))
            prepared = _Prepared(views, vertices_local, pads, share)
            self._prepared[mesh] = prepared
        return prepared

    def _run(
        self, shares: list[tuple[Any, ...]]
    ) -> list[tuple[NDArray[np.uint32], NDArray[np.uint32]]]:
        """Work off all shares; whichever thread is free takes the next one."""
        results: list[Any] = [None] * len(shares)
        numbers = itertools.count()  # next() is atomic

        def work() -> None:
            while (number := next(numbers)) < len(shares):
                results[number] = _query_range(*shares[number])

        n_helpers = min(self._n_threads, len(shares)) - 1
        if n_helpers > 0 and self._executor is None:
            self._executor = ThreadPoolExecutor(self._n_threads - 1, "volume-query")
        helpers = [
            self._executor.submit(work) for _ in range(n_helpers) if self._executor is not None
        ]
        work()
        for helper in helpers:
            helper.result()
        return results


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


def _joined(mesh: Triangles, parts: list[tuple[NDArray[np.uint32], NDArray[np.uint32]]]) -> Hits:
    none = np.zeros(0, np.uint32)
    triangles, samples = zip((none, none), *parts, strict=True)
    return Hits.from_samples(mesh.topology, np.concatenate(triangles), np.concatenate(samples))
