"""Distances to a CAD object at the corners of cubes, and what they prove of all points between.

Let d(x) be the distance of x from a surface S. Then, for any point c,

    F(x) = d(x)^2 - |x - c|^2 = min over s in S of ( |s - c|^2 - 2 (x - c) . (s - c) )

is the smallest of linear functions of x, so it is concave, whatever the surface looks like. Hence

* from below: within a cube F is at least what trilinear interpolation makes of its values at the
  eight corners, since the weights are those of a convex combination. With c the centre of a cell in
  the cube, d^2 is at least the smallest of the eight interpolated values at the cell's corners;
* from above: d(x) <= |x - y_i| for the points y_i of the surface that are nearest to the corners,
  and d(x)^2 <= (|x - y_i|^2 + |x - y_j|^2) / 2 for each pair, which is convex in x and so largest
  at a corner of a cell. A pair across the middle of a plate, or of a rod, bounds the depth there.

A rounded distance may be off by some e, and d^2 by e (2 d + e): that, and the rounding of the sums,
is taken off before the root is drawn, as near the surface little d^2 is much d.

Both are off by no more than some H^2 / d for a cube with edge 2 H, where bounds from a metre a
metre are off by H: once a cube's corners are known, cells far smaller need no distance of their
own. A cube that the surface does not meet lies on one side of it, that of its corners. It is not
met if all corners are farther from the surface than from the cube's centre: a point in the cube,
and any up to 2 H from the centre, is nearer to some corner than that.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.distance import Surface, SurfaceDistance, signed_distances
from hybridve.hull.jit import ZERO, compiled
from hybridve.hull.query.cells import CellFrame
from hybridve.hull.query.points import EDGE_PX, is_inside

#: Corners that are remembered at most, some 50 MB; then all are forgotten, which changes no result.
_MOST_CORNERS = 1 << 20

#: Halvings of the root down to the smallest cubes with corners of their own: 21 bits an axis.
FINEST_LEVEL = 20

#: An odd number that spreads keys over a table (2^64 over the golden ratio, as a signed one).
_SPREAD = -7046029254386353131

#: What rounding may add to an interpolated F, in the largest d^2 and |x - c|^2 of the corners: a
#: dozen sums and products that each keep 2^-53 of it.
_SUM_ERROR = 2.0**-48

#: On which side of a closed surface a cube lies: inside, either or both, outside. An open surface
#: has an outside alone.
_INSIDE, _ACROSS, _OUTSIDE = -1, 0, 1

#: The tries that a centre in the hull makes towards the surface, in halves of its cube's edge.
_TRIES = (1.0, 0.5, 0.25)


class Cubes(NamedTuple):
    """Cubes with known corners.

    Attributes
    ----------
    center : (M, 3) float64
        Metres, in the frame of the surface.
    half_m : (M,) float64
        Half of an edge.
    corner : (M, 8) int64
        Numbers of the corners in the lattice: x changes first, then y, then z.
    side : (M,) int8
        `_INSIDE`, `_ACROSS` or `_OUTSIDE`.
    is_fine : (M,) bool
        Whether the bounds at the centre are close enough: cells within take them from here.
    """

    center: NDArray[np.float64]
    half_m: NDArray[np.float64]
    corner: NDArray[np.int64]
    side: NDArray[np.int8]
    is_fine: NDArray[np.bool_]


class Corners(NamedTuple):
    """What is known of distances at corners, as compiled loops take it.

    Arrays have room for more, and are written to; what returns another one has moved to larger
    ones, and the first is of no use any more.

    Attributes
    ----------
    key, number : (K,) int64
        A table of places and the numbers of their corners, K a power of two; -1 for a free key.
    distance_m : (V,) float64
        Signed distance of a corner.
    nearest : (V, 3) float64
        The point of the surface that is nearest to it.
    n : int
        How many corners there are.
    """

    key: NDArray[np.int64]
    number: NDArray[np.int64]
    distance_m: NDArray[np.float64]
    nearest: NDArray[np.float64]
    n: int


class DistanceLattice:
    """Signed distances at corners of cubes about the origin, computed when first asked for.

    What is kept depends on the surface alone, so it serves in every frame, wherever it is moved to.

    Parameters
    ----------
    surface : SurfaceDistance
        Whose frame is the lattice's.
    root_half_m : float
        Half of the root's edge; a power of two, so that all corners are exact.

    Attributes
    ----------
    corners : Corners
        Those that are known. Compiled loops that learn more return what takes its place.
    """

    def __init__(self, surface: SurfaceDistance, root_half_m: float) -> None:
        self._surface = surface.surface
        self._root_half_m = root_half_m
        self.forget()

    def forget(self) -> None:
        """Start again without a corner."""
        self.corners = Corners(
            np.full(1 << 12, -1, np.int64),
            np.zeros(1 << 12, np.int64),
            np.zeros(1 << 11),
            np.zeros((1 << 11, 3)),
            0,
        )

    @property
    def is_large(self) -> bool:
        """Whether it is time to forget."""
        return self.corners.n > _MOST_CORNERS

    def cubes(self, center: NDArray[np.float64], half_m: float, fine_m: float) -> Cubes:
        """Return cubes with their corners; as `known_cubes`."""
        cubes, self.corners = known_cubes(
            center, half_m, self._root_half_m, fine_m, self._surface, self.corners
        )
        return cubes


@compiled
def known_cubes(
    center: NDArray[np.float64],
    half_m: float,
    root_half_m: float,
    fine_m: float,
    surface: Surface,
    corners: Corners,
) -> tuple[Cubes, Corners]:
    """Return cubes with their corners, and all corners known by then.

    Parameters
    ----------
    center : (M, 3) float64
        Metres.
    half_m : float
        Half of an edge of each, at most `FINEST_LEVEL` halvings below the root's.
    root_half_m : float
        Half of an edge of the root.
    fine_m : float
        How far apart bounds may be for `Cubes.is_fine`.
    surface : Surface
        Whose distances are known.
    corners : Corners
        Those that are known; not to be used again.
    """
    key, number, distance_m, nearest = _with_room(corners, 8 * len(center))
    step_m = 2.0 * root_half_m / 2.0**FINEST_LEVEL
    corner, n = _corner_numbers(center, half_m, root_half_m, step_m, key, number, corners.n)
    if n > corners.n:
        points = _corner_points(center, half_m, corner, corners.n, n - corners.n)
        found_m, found = signed_distances(points, surface)
        distance_m[corners.n : n] = found_m
        nearest[corners.n : n] = found
    side, is_fine = _judge(
        center, half_m, corner, distance_m, nearest, surface.is_closed, surface.apart_m, fine_m
    )
    cubes = Cubes(center, np.full(len(center), half_m), corner, side, is_fine)
    return cubes, Corners(key, number, distance_m, nearest, n)


@compiled
def _with_room(
    corners: Corners, n_more: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the arrays of corners with room for so many more."""
    key, number = corners.key, corners.number
    distance_m, nearest = corners.distance_m, corners.nearest
    needed = corners.n + n_more
    size = len(key)
    while 2 * needed > size:
        size *= 2
    if size > len(key):
        grown, new_number = np.full(size, -1, np.int64), np.zeros(size, np.int64)
        _rehash(key, number, grown, new_number)
        key, number = grown, new_number
    if needed > len(distance_m):
        size = max(needed, 2 * len(distance_m))
        grown_m, grown_nearest = np.zeros(size), np.zeros((size, 3))
        grown_m[: corners.n] = distance_m[: corners.n]
        grown_nearest[: corners.n] = nearest[: corners.n]
        distance_m, nearest = grown_m, grown_nearest
    return key, number, distance_m, nearest


@compiled
def _corner_numbers(
    center: NDArray[np.float64],
    half_m: float,
    root_half_m: float,
    step_m: float,
    key: NDArray[np.int64],
    number: NDArray[np.int64],
    n_corners: int,
) -> tuple[NDArray[np.int64], int]:
    """Return the numbers (M, 8) of the cubes' corners, entered into the table where they are new.

    The table has a power of two of places, -1 for a free one; it is searched from the place that a
    key is spread to on.
    """
    corner = np.zeros((len(center), 8), np.int64)
    last = len(key) - 1
    for i in range(len(center)):
        for octant in range(8):
            x = int((center[i, 0] + (half_m if octant & 1 else -half_m) + root_half_m) / step_m)
            y = int((center[i, 1] + (half_m if octant & 2 else -half_m) + root_half_m) / step_m)
            z = int((center[i, 2] + (half_m if octant & 4 else -half_m) + root_half_m) / step_m)
            wanted = x | (y << 21) | (z << 42)
            place = ((wanted * _SPREAD) >> 24) & last
            while key[place] != wanted and key[place] >= 0:
                place = (place + 1) & last
            if key[place] < 0:
                key[place], number[place] = wanted, n_corners
                n_corners += 1
            corner[i, octant] = number[place]
    return corner, n_corners


@compiled
def _corner_points(
    center: NDArray[np.float64],
    half_m: float,
    corner: NDArray[np.int64],
    first: int,
    n_points: int,
) -> NDArray[np.float64]:
    """Return where the corners with numbers from `first` on are, (n_points, 3) metres."""
    points = np.zeros((n_points, 3))
    for i in range(len(center)):
        for octant in range(8):
            place = corner[i, octant] - first
            if place >= 0:
                points[place, 0] = center[i, 0] + (half_m if octant & 1 else -half_m)
                points[place, 1] = center[i, 1] + (half_m if octant & 2 else -half_m)
                points[place, 2] = center[i, 2] + (half_m if octant & 4 else -half_m)
    return points


@compiled
def _rehash(
    key: NDArray[np.int64],
    number: NDArray[np.int64],
    new_key: NDArray[np.int64],
    new_number: NDArray[np.int64],
) -> None:
    """Enter all keys of a table into a larger one."""
    last = len(new_key) - 1
    for i in range(len(key)):
        if key[i] >= 0:
            place = ((key[i] * _SPREAD) >> 24) & last
            while new_key[place] >= 0:
                place = (place + 1) & last
            new_key[place], new_number[place] = key[i], number[i]


@compiled
def _judge(
    center: NDArray[np.float64],
    half_m: float,
    corner: NDArray[np.int64],
    distance_m: NDArray[np.float64],
    nearest: NDArray[np.float64],
    is_closed: bool,
    apart_m: float,
    fine_m: float,
) -> tuple[NDArray[np.int8], NDArray[np.bool_]]:
    """Return on which side of the surface cubes lie, and which have bounds that are close.

    The solid's surface, whose side is asked for, may be `apart_m` from that of the distances.
    """
    side, is_fine = np.zeros(len(center), np.int8), np.zeros(len(center), np.bool_)
    for i in range(len(center)):
        smallest, mean, largest_m, above = np.inf, 0.0, 0.0, np.inf
        for k in range(8):
            signed_m = distance_m[corner[i, k]]
            if abs(signed_m) > abs(largest_m):
                largest_m = signed_m
            smallest = min(smallest, signed_m * signed_m)
            mean += signed_m * signed_m / 8.0
            squared = 0.0
            for axis in range(3):
                squared += (center[i, axis] - nearest[corner[i, k], axis]) ** 2
            above = min(above, squared)
        diagonal = 3.0 * half_m * half_m
        unmet_m = np.sqrt(diagonal) + apart_m
        if not is_closed:
            side[i] = _OUTSIDE
        elif smallest > unmet_m * unmet_m:  # the surface does not meet the cube
            side[i] = _OUTSIDE if largest_m > 0 else _INSIDE
        else:
            side[i] = _ACROSS
        gap_m = np.sqrt(above) - np.sqrt(max(mean - diagonal, 0.0))
        is_fine[i] = side[i] != _ACROSS and gap_m <= fine_m
    return side, is_fine


@compiled
def _least_squared(
    x: float,
    y: float,
    z: float,
    half_m: float,
    cube_center: NDArray[np.float64],
    cube_half_m: float,
    corner: NDArray[np.int64],
    distance_m: NDArray[np.float64],
    error_m: float,
    value: NDArray[np.float64],
) -> float:
    """Return a lower bound of the squared distance in a cell of a cube; `value` (8,) is room."""
    farthest_m, away = 0.0, 0.0
    low_x = 0.5 + (x - half_m - cube_center[0]) / (2.0 * cube_half_m)
    low_y = 0.5 + (y - half_m - cube_center[1]) / (2.0 * cube_half_m)
    low_z = 0.5 + (z - half_m - cube_center[2]) / (2.0 * cube_half_m)
    step = half_m / cube_half_m
    for k in range(8):
        off_x = cube_center[0] + (cube_half_m if k & 1 else -cube_half_m) - x
        off_y = cube_center[1] + (cube_half_m if k & 2 else -cube_half_m) - y
        off_z = cube_center[2] + (cube_half_m if k & 4 else -cube_half_m) - z
        off = off_x * off_x + off_y * off_y + off_z * off_z
        value[k] = distance_m[corner[k]] ** 2 - off
        farthest_m, away = max(farthest_m, abs(distance_m[corner[k]])), max(away, off)
    least = np.inf
    for across in range(2):
        share_x = low_x + across * step
        a = value[0] + share_x * (value[1] - value[0])
        b = value[2] + share_x * (value[3] - value[2])
        c = value[4] + share_x * (value[5] - value[4])
        d = value[6] + share_x * (value[7] - value[6])
        for along in range(2):
            share_y = low_y + along * step
            low = a + share_y * (b - a)
            high = c + share_y * (d - c)
            least = min(least, low + low_z * (high - low))
            least = min(least, low + (low_z + step) * (high - low))
    rounding = error_m * (2.0 * farthest_m + error_m)
    return least - rounding - _SUM_ERROR * (farthest_m * farthest_m + away)


@compiled
def _most_squared(
    x: float,
    y: float,
    z: float,
    half_m: float,
    corner: NDArray[np.int64],
    nearest: NDArray[np.float64],
) -> float:
    """Return an upper bound of the squared distance in a cell."""
    most = np.inf
    for i in range(8):
        for j in range(i, 8):
            apart, squared = 0.0, 0.0
            for axis in range(3):
                first, second = nearest[corner[i], axis], nearest[corner[j], axis]
                place = x if axis == 0 else (y if axis == 1 else z)
                apart += (first - second) ** 2
                squared += (abs(place - 0.5 * (first + second)) + half_m) ** 2
            most = min(most, squared + 0.25 * apart)
    return most


class Best(NamedTuple):
    """The hull's point nearest to the surface that was found so far, in the surface's frame.

    Attributes
    ----------
    distance_m : (1,) float64
        An upper bound of its signed distance; inf before there is one.
    point : (3,) float64
        The point.
    """

    distance_m: NDArray[np.float64]
    point: NDArray[np.float64]


@compiled
def bound_cells(
    center: NDArray[np.float64],
    half_m: float,
    cube: NDArray[np.int64],
    cubes: Cubes,
    distance_m: NDArray[np.float64],
    nearest: NDArray[np.float64],
    error_m: float,
    asked: CellFrame,
    best: Best,
) -> tuple[NDArray[np.float64], int]:
    """Return lower bounds of the signed distance in cells, and take note of the hull's points.

    Parameters
    ----------
    center : (N, 3) float64
        The cells' centres, metres, in the surface's frame.
    half_m : float
        Half of an edge of the cells.
    cube : (N,) int64
        The cube that holds each.
    cubes, distance_m, nearest
        The cubes, and the lattice of their corners.
    error_m : float
        What each of these distances may be off by.
    asked : CellFrame
        The hull.
    best : Best
        Written.

    Returns
    -------
    lower_m : (N,) float64
        Right but for `error_m`.
    deepest : int
        The cell with the lowest bound of those whose centre is in the hull and may lie in the
        solid, else the one nearest to the surface of those that this may cross; -1 if there is
        none. Its exact distance may better the best one.
    """
    frame = asked.frame
    offset_x, offset_y, offset_z = asked.offset_local
    matrices, sizes, answers, mask_offset = (
        frame.matrices,
        frame.sizes,
        frame.answers,
        frame.mask_offset,
    )
    keep, min_cameras, every = frame.keep, frame.min_cameras, frame.every
    lower_m, value = np.zeros(len(center)), np.zeros(8)
    deepest, key, smallest_m = ZERO - 1, np.inf, best.distance_m[0]
    for i in range(len(center)):
        x, y, z = center[i, 0], center[i, 1], center[i, 2]
        k = cube[i]
        side, corner = cubes.side[k], cubes.corner[k]
        if side == _OUTSIDE:
            least = _least_squared(
                x,
                y,
                z,
                half_m,
                cubes.center[k],
                cubes.half_m[k],
                corner,
                distance_m,
                error_m,
                value,
            )
            lower_m[i] = np.sqrt(max(least, 0.0))
        elif side == _INSIDE:
            lower_m[i] = -np.sqrt(_most_squared(x, y, z, half_m, corner, nearest))
        else:  # a metre a metre
            lower_m[i] = -np.inf
            for octant in range(8):
                big = cubes.half_m[k]
                off_x = abs(x - cubes.center[k, 0] - (big if octant & 1 else -big)) + half_m
                off_y = abs(y - cubes.center[k, 1] - (big if octant & 2 else -big)) + half_m
                off_z = abs(z - cubes.center[k, 2] - (big if octant & 4 else -big)) + half_m
                away_m = np.sqrt(off_x * off_x + off_y * off_y + off_z * off_z)
                lower_m[i] = max(lower_m[i], distance_m[corner[octant]] - away_m)
        if lower_m[i] >= smallest_m or not is_inside(
            x + offset_x,
            y + offset_y,
            z + offset_z,
            every,
            len(every),
            ZERO,
            matrices,
            sizes,
            answers,
            mask_offset,
            keep,
            min_cameras,
            EDGE_PX,
        ):
            continue
        if side != _OUTSIDE:
            if lower_m[i] < key:
                deepest, key = i, lower_m[i]
            continue
        closest, squared = 0, np.inf
        for octant in range(8):
            to_x = nearest[corner[octant], 0] - x
            to_y = nearest[corner[octant], 1] - y
            to_z = nearest[corner[octant], 2] - z
            if to_x * to_x + to_y * to_y + to_z * to_z < squared:
                closest, squared = octant, to_x * to_x + to_y * to_y + to_z * to_z
        upper_m = np.sqrt(squared)
        if lower_m[i] <= 0 and upper_m < key:
            deepest, key = i, upper_m
        if upper_m - half_m >= smallest_m:
            continue
        to_x = nearest[corner[closest], 0] - x
        to_y = nearest[corner[closest], 1] - y
        to_z = nearest[corner[closest], 2] - z
        way = 0.0
        if upper_m > 0:  # on the way to a point of the surface, each metre brings a metre
            for share in _TRIES:
                along = min(share * half_m / upper_m, 1.0)
                if is_inside(
                    x + along * to_x + offset_x,
                    y + along * to_y + offset_y,
                    z + along * to_z + offset_z,
                    every,
                    len(every),
                    ZERO,
                    matrices,
                    sizes,
                    answers,
                    mask_offset,
                    keep,
                    min_cameras,
                    EDGE_PX,
                ):
                    way = along
                    break
        if upper_m - way * upper_m < smallest_m:
            smallest_m = upper_m - way * upper_m
            best.point[0] = x + way * to_x
            best.point[1] = y + way * to_y
            best.point[2] = z + way * to_z
    best.distance_m[0] = smallest_m
    return lower_m, deepest
