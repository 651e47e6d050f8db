"""Where the samples of a triangle are.

A triangle with vertices a, b, c is laid into half of its u x u viewport with its vertices on the
centres of three corner pixels. Its samples are the u(u+1)/2 positions::

    a + (b - a) i / (u - 1) + (c - a) j / (u - 1),    i, j >= 0,  i + j <= u - 1

(the centroid for u = 1), the same for every engine. Vertices and edges are always sampled, and a
sliver loses nothing, since no triangle is ever seen on edge. The spacing along an edge is
edge / (u - 1), the accuracy of section 4.4.3 of the paper; u - 1 doubled contains all samples of
u - 1.

Samples are numbered row by row, j = 0 first: sample (i, j) is number ``j u - j (j - 1) / 2 + i``.
An engine returns numbers; positions come from here alone.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import ZERO, compiled

#: More samples an edge than a 16-bit image is wide serve nobody, and their count stays below 2^31.
MAX_VIEWPORT = 65_535


def n_samples(viewport: int) -> int:
    """Return how many samples a viewport of `viewport` pixels a side takes of a triangle."""
    return viewport * (viewport + 1) // 2


def samples_before(viewports: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return how many samples the triangles before each of T triangles have: (T + 1,)."""
    counts = viewports.astype(np.int64)
    counts *= counts + 1
    counts >>= 1
    before = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])
    before.flags.writeable = False
    return before


def sample_steps(
    viewports: NDArray[np.int32], samples: NDArray[np.uint32]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the steps i, j of numbered samples.

    Parameters
    ----------
    viewports : (N,) int32
        The viewport of each sample's triangle.
    samples : (N,) uint32
        Numbers of samples in their viewports.

    Examples
    --------
    The six samples of a 3 x 3 viewport:

    >>> i, j = sample_steps(np.full(6, 3, np.int32), np.arange(6, dtype=np.uint32))
    >>> list(zip(i.tolist(), j.tolist()))
    [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (0, 2)]
    """
    u = viewports.astype(np.int64)
    number = samples.astype(np.int64)
    # Rows above row j hold j u - j (j - 1) / 2 samples; solve for j. Nothing to mend: at the first
    # sample of a row the discriminant is a square, whose root is exact, and elsewhere the root is
    # more than 1e-5 away from the next whole number, since u is at most `MAX_VIEWPORT`.
    j = np.floor((2 * u + 1 - np.sqrt((2.0 * u + 1) ** 2 - 8.0 * number)) / 2).astype(np.int64)
    i = number - (j * u - j * (j - 1) // 2)
    return i, j


def sample_positions(
    corners: NDArray[np.float64],
    viewports: NDArray[np.int32],
    samples: NDArray[np.uint32],
) -> NDArray[np.float64]:
    """Return where numbered samples lie.

    Parameters
    ----------
    corners : (N, 3, 3) float64
        Vertices a, b, c of each sample's triangle, in any frame.
    viewports : (N,) int32
        The viewport of each sample's triangle.
    samples : (N,) uint32
        Numbers of samples in their viewports.

    Returns
    -------
    (N, 3) float64
        Positions in the frame of the corners.
    """
    i, j = sample_steps(viewports, samples)
    steps = np.maximum(viewports.astype(np.float64) - 1.0, 1.0)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    positions = a + (b - a) * (i / steps)[:, None] + (c - a) * (j / steps)[:, None]
    single = viewports == 1
    positions[single] = corners[single].mean(axis=1)
    return positions


def viewports_for_accuracy(corners: NDArray[np.float64], accuracy_m: float) -> NDArray[np.int32]:
    """Return for each triangle the smallest viewport that samples its edges `accuracy_m` apart.

    Parameters
    ----------
    corners : (T, 3, 3) float64
        Vertices in metres.
    accuracy_m : float
        The largest spacing of samples along an edge, in metres.

    Raises
    ------
    ValueError
        If a triangle would need more than `MAX_VIEWPORT`.
    """
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)  # (T, 3)
    needed = np.ceil(edges.max(axis=1, initial=0.0) / accuracy_m) + 1
    if (needed > MAX_VIEWPORT).any():
        raise ValueError(
            f"an edge of {edges.max():.3g} m sampled every {accuracy_m:.3g} m needs a viewport of "
            f"{needed.max():.0f}, more than {MAX_VIEWPORT}"
        )
    return np.asarray(np.maximum(needed, 2), dtype=np.int32)


@compiled
def expand_runs(
    start: NDArray[np.int64],
    stop: NDArray[np.int64],
    before: NDArray[np.int64],
    triangle: NDArray[np.uint32],
    sample: NDArray[np.uint32],
) -> None:
    """Write triangle and number in its viewport of the samples of runs, as many as there is room.

    Parameters
    ----------
    start, stop : (R,) int64
        Runs of samples, numbered through the mesh, ascending.
    before : (T + 1,) int64
        Samples of the triangles before each; see `samples_before`.
    triangle, sample : (P,) uint32
        What is written.
    """
    n, t = ZERO, ZERO
    for run in range(len(start)):
        number = start[run]
        if number >= before[t + 1]:
            t = _triangle_of(number, before, t + 1)
        while number < stop[run]:
            end = min(stop[run], before[t + 1])
            first = before[t]
            for k in range(min(end - number, len(triangle) - n)):
                triangle[n] = t
                sample[n] = number - first + k
                n += 1
            if n == len(triangle):
                return
            number = end
            if number == before[t + 1]:
                t += 1


def place_runs(
    start: NDArray[np.int64],
    stop: NDArray[np.int64],
    before: NDArray[np.int64],
    vertices: NDArray[np.float64],
    faces: NDArray[np.int32],
    viewports: NDArray[np.int32],
) -> tuple[NDArray[np.uint32], NDArray[np.float64]]:
    """Return triangles (P,) and positions (P, 3) of the samples of runs.

    The positions are those of `sample_positions`.

    Parameters
    ----------
    start, stop : (R,) int64
        Runs of samples, numbered through the mesh, ascending.
    before : (T + 1,) int64
        Samples of the triangles before each; see `samples_before`.
    vertices : (V, 3) float64
        In any frame.
    faces : (T, 3) int32
        Vertex numbers.
    viewports : (T,) int32
        The viewport of each triangle.
    """
    count = int((stop - start).sum())
    triangle, positions = np.zeros(count, np.uint32), np.zeros((count, 3))
    _place_runs(
        read_only(start),
        read_only(stop),
        read_only(before),
        read_only(vertices),
        read_only(faces),
        read_only(viewports),
        triangle,
        positions,
    )
    return triangle, positions


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Return a view that cannot be written to, which is a type to the compiler; one is enough."""
    view = array.view()
    view.flags.writeable = False
    return view


def thinned_samples(
    start: NDArray[np.int64], stop: NDArray[np.int64], most: int
) -> NDArray[np.int64]:
    """Return every k-th of the samples of runs (R,), at most so many, numbered as the runs are.

    Examples
    --------
    >>> thinned_samples(np.array([0, 10]), np.array([4, 13]), 4).tolist()
    [0, 2, 10, 12]
    """
    lengths = stop - start
    ends = np.cumsum(lengths)
    total = int(ends[-1]) if len(ends) else 0
    pick = np.arange(0, total, max(1, -(-total // most)))
    run = np.searchsorted(ends, pick, side="right")
    return np.asarray(start[run] + pick - (ends[run] - lengths[run]))


@compiled
def run_ends(
    start: NDArray[np.int64],
    stop: NDArray[np.int64],
    before: NDArray[np.int64],
    viewports: NDArray[np.int32],
) -> NDArray[np.int64]:
    """Return the samples at the ends of what runs hold, among which is the farthest from any point.

    Of a triangle that a run holds wholly these are its three vertices, else the ends of each row
    of its viewport: samples between two others are on a straight line, and the distance to a point
    is convex along it.

    Parameters
    ----------
    start, stop : (R,) int64
        Runs of samples, numbered through the mesh, ascending.
    before : (T + 1,) int64
        Samples of the triangles before each; see `samples_before`.
    viewports : (T,) int32
        The viewport of each triangle.

    Returns
    -------
    (E,) int64
        Numbers through the mesh, ascending but for repetitions.
    """
    ends = np.zeros(64, np.int64)
    n, t = ZERO, ZERO
    for run in range(len(start)):
        number = start[run]
        if number >= before[t + 1]:
            t = _triangle_of(number, before, t + 1)
        while number < stop[run]:
            end = min(stop[run], before[t + 1])
            u = np.int64(viewports[t])
            if n + 2 * u + 3 > len(ends):
                more = np.zeros(2 * len(ends) + 2 * u + 3, np.int64)
                more[:n] = ends[:n]
                ends = more
            if number == before[t] and end == before[t + 1]:
                ends[n], ends[n + 1], ends[n + 2] = number, number + u - 1, end - 1
                n += 3
            else:
                j, row = ZERO, before[t]
                while number >= row + u - j:  # the row that the run begins in
                    row += u - j
                    j += 1
                while number < end:
                    ends[n], ends[n + 1] = number, min(end, row + u - j) - 1
                    n += 2
                    number = ends[n - 1] + 1
                    row += u - j
                    j += 1
            number = end
            if number == before[t + 1]:
                t += 1
    return ends[:n]


@compiled
def _triangle_of(number: int, before: NDArray[np.int64], low: int) -> int:
    """Return the triangle of a sample, which is `low` or a later one, by bisection."""
    high = len(before) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if before[middle] <= number:
            low = middle
        else:
            high = middle
    return low


@compiled
def _place_runs(
    start: NDArray[np.int64],
    stop: NDArray[np.int64],
    before: NDArray[np.int64],
    vertices: NDArray[np.float64],
    faces: NDArray[np.int32],
    viewports: NDArray[np.int32],
    triangle: NDArray[np.uint32],
    positions: NDArray[np.float64],
) -> None:
    n, t = ZERO, ZERO
    shares = np.zeros(1)  # i / (u - 1) for all i, of the last viewport
    for run in range(len(start)):
        number = start[run]
        if number >= before[t + 1]:
            t = _triangle_of(number, before, t + 1)
        while number < stop[run]:
            end = min(stop[run], before[t + 1])
            u = np.int64(viewports[t])
            a, b, c = faces[t, 0], faces[t, 1], faces[t, 2]
            a_x, a_y, a_z = vertices[a, 0], vertices[a, 1], vertices[a, 2]
            b_x, b_y, b_z = vertices[b, 0], vertices[b, 1], vertices[b, 2]
            c_x, c_y, c_z = vertices[c, 0], vertices[c, 1], vertices[c, 2]
            if u == 1:
                triangle[n] = t
                positions[n, 0] = (a_x + b_x + c_x) / 3.0
                positions[n, 1] = (a_y + b_y + c_y) / 3.0
                positions[n, 2] = (a_z + b_z + c_z) / 3.0
                n += 1
            else:
                if len(shares) != u:
                    shares = np.arange(u) / (u - 1.0)
                j, row = ZERO, before[t]
                while number >= row + u - j:  # the row that the run begins in
                    row += u - j
                    j += 1
                while number < end:
                    length = min(end, row + u - j) - number
                    i, up = number - row, shares[j]
                    up_x, up_y, up_z = (c_x - a_x) * up, (c_y - a_y) * up, (c_z - a_z) * up
                    for k in range(length):
                        along = shares[i + k]
                        triangle[n + k] = t
                        positions[n + k, 0] = a_x + (b_x - a_x) * along + up_x
                        positions[n + k, 1] = a_y + (b_y - a_y) * along + up_y
                        positions[n + k, 2] = a_z + (b_z - a_z) * along + up_z
                    n += length
                    number += length
                    row += u - j
                    j += 1
            number = end
            if number == before[t + 1]:
                t += 1
