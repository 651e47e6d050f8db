"""The search for the hull's nearest point, in cells that are cut into eight, compiled.

Level after level the parts of cells that may hold a point nearer than the best one are kept; see
`hybridve.hull.contact.clearance`, which says what is asked, and `hybridve.hull.contact.lattice`,
which bounds the distances in a cell. All levels are one call: between two of them there is
little to do, and Python would take longer for it than the loops do.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.distance import Surface, signed_distances
from hybridve.hull.contact.lattice import (
    FINEST_LEVEL,
    Best,
    Corners,
    Cubes,
    bound_cells,
    known_cubes,
)
from hybridve.hull.jit import ZERO, compiled, fused
from hybridve.hull.query.cells import CellFrame, split_cells
from hybridve.hull.query.points import are_inside

#: Cubes with a half diagonal below this share of the tolerance are not cut any further. Where cones
#: cross at a glancing angle the hull ends in a blade, which only cubes as thin as it is can tell
#: from nothing.
_SMALLEST_CELL = 2.0**-12

#: Cubes of one level at most. More are not cut; the bounds are then farther apart than asked. Fewer
#: once the hull is certain to reach into the solid: depth is the same all along the middle of a
#: plate, which may take as many cubes as it is wide and long.
_MOST_CELLS, _MOST_DEEP_CELLS = 1 << 17, 1 << 14

#: How far apart the bounds at the centre of a cube may be, in tolerances, for the cells within it
#: to take theirs from its corners.
_FINE = 1.0 / 8.0

#: Points that look for a deeper one, and how often they move closer together around the deepest.
_LOOK_POINTS, _LOOKS = 17, 2

#: Cells that are sooner cut than spared by a deeper point.
_FEW_CELLS = 100

#: Halvings of the root at most; cubes are never as small before they are small enough.
_MOST_LEVELS = 64


class Level(NamedTuple):
    """Cells of one size, and the cubes that tell their distances.

    Attributes
    ----------
    center : (N, 3) float64
        Metres, in the object's frame.
    half_m : float
        Half of an edge.
    cube : (N,) int64
        The cube that holds each.
    cubes : Cubes
        With known corners.
    """

    center: NDArray[np.float64]
    half_m: float
    cube: NDArray[np.int64]
    cubes: Cubes

    def only(self, kept: NDArray[np.bool_]) -> "Level":
        """Return some of the cells."""
        return self._replace(center=self.center[kept], cube=self.cube[kept])


class Space(NamedTuple):
    """The space about one object, as it is cut into cells.

    Attributes
    ----------
    surface : Surface
        Of the object.
    root_half_m : float
        Half of the largest root's edge, which the lattice of corners begins at.
    rounding_m : float
        What a distance may be off by.
    tolerance_m : float
        How far apart bounds may be.
    """

    surface: Surface
    root_half_m: float
    rounding_m: float
    tolerance_m: float


@compiled
def root_level(root_m: float, space: Space, corners: Corners) -> tuple[Level, Corners]:
    """Return the one cell about the origin with a half edge of `root_m`, and the corners known."""
    center = np.zeros((1, 3))
    cubes, corners = known_cubes(
        center, root_m, space.root_half_m, _FINE * space.tolerance_m, space.surface, corners
    )
    return Level(center, root_m, np.zeros(1, np.int64), cubes), corners


@compiled
def _joined(first: Cubes, second: Cubes) -> Cubes:
    """Return the cubes of both, in order."""
    return Cubes(
        np.concatenate((first.center, second.center)),
        np.concatenate((first.half_m, second.half_m)),
        np.concatenate((first.corner, second.corner)),
        np.concatenate((first.side, second.side)),
        np.concatenate((first.is_fine, second.is_fine)),
    )


@compiled
def _bound_singly(
    center: NDArray[np.float64],
    half_m: float,
    cube: NDArray[np.int64],
    is_fine: NDArray[np.bool_],
    asked: CellFrame,
    surface: Surface,
    lower_m: NDArray[np.float64],
    best: Best,
) -> None:
    """Raise bounds of cells that no cube of the lattice bounds well, by their own distances.

    The smallest cubes are a share of the root. An object far larger than the room about the
    hull has a root to match, and one far smaller than a metre a root of metres: cells are then
    cut on below the smallest cubes.
    """
    coarse = np.flatnonzero(~is_fine[cube])
    if len(coarse) == 0:
        return
    signed_m, _ = signed_distances(center[coarse], surface)
    inside = are_inside(center[coarse], asked.offset_local, asked.frame)
    nearest, nearest_m = ZERO, np.inf
    for i in range(len(coarse)):
        lower_m[coarse[i]] = max(lower_m[coarse[i]], signed_m[i] - np.sqrt(3.0) * half_m)
        if inside[i] and signed_m[i] < nearest_m:
            nearest, nearest_m = coarse[i], signed_m[i]
    if nearest_m < best.distance_m[0]:
        best.distance_m[0] = nearest_m
        best.point[:] = center[nearest]


@compiled
def split_level(
    level: Level, asked: CellFrame, best: Best, space: Space, corners: Corners
) -> tuple[Level, NDArray[np.float64], int, Corners]:
    """Return the parts of cells that are not free, their bounds, and the deepest of them.

    And the corners known by then; `best` is written.
    """
    half_m, cubes = level.half_m / 2.0, level.cubes
    whole, center = split_cells(level.center, half_m, asked)
    cube = level.cube[whole]
    is_finest = half_m < space.root_half_m / 2.0**FINEST_LEVEL
    if not is_finest:
        own = np.flatnonzero(~cubes.is_fine[cube])
        if len(own) > 0:
            for i in range(len(own)):
                cube[own[i]] = len(cubes.half_m) + i
            more, corners = known_cubes(
                center[own],
                half_m,
                space.root_half_m,
                _FINE * space.tolerance_m,
                space.surface,
                corners,
            )
            cubes = _joined(cubes, more)
    lower_m, deepest = bound_cells(
        center,
        half_m,
        cube,
        cubes,
        corners.distance_m,
        corners.nearest,
        space.rounding_m,
        asked,
        best,
    )
    if is_finest:
        _bound_singly(center, half_m, cube, cubes.is_fine, asked, space.surface, lower_m, best)
    return Level(center, half_m, cube, cubes), lower_m, deepest, corners


@compiled
def _look_deeper(
    best: Best,
    point: NDArray[np.float64],
    half_m: float,
    asked: CellFrame,
    n_looks: int,
    surface: Surface,
) -> None:
    """Look at a point (3,) of the hull, at the surface beside it, and behind that.

    On the way from the surface through the point into the solid, the depth grows by a metre a
    metre until another side of the solid is as near. What is found is taken if it betters the
    best point; its distance is exact.
    """
    signed_m, nearest = signed_distances(point.reshape((1, 3)), surface)
    if signed_m[0] > 0 and are_inside(nearest, asked.offset_local, asked.frame)[0]:
        if best.distance_m[0] > 0:
            best.distance_m[0] = 0.0
            best.point[:] = nearest[0]
    elif signed_m[0] < best.distance_m[0]:
        best.distance_m[0] = signed_m[0]
        best.point[:] = point
    away = point - nearest[0]
    # As most processors sum products; so the direction is the same on all of them.
    length_m = np.sqrt(fused(away[2], away[2], fused(away[1], away[1], away[0] * away[0])))
    if length_m == 0:
        return
    away *= np.copysign(1.0, -signed_m[0]) / length_m
    begin_m, reach_m = 0.0, 2.0 * half_m
    along_m, points = np.zeros(_LOOK_POINTS), np.zeros((_LOOK_POINTS, 3))
    for _ in range(n_looks):
        for k in range(_LOOK_POINTS):
            along_m[k] = begin_m + reach_m * (k / (_LOOK_POINTS - 1))
            for axis in range(3):
                points[k, axis] = point[axis] + along_m[k] * away[axis]
        inside = are_inside(points, asked.offset_local, asked.frame)
        if not inside.any():
            return
        signed_m, _ = signed_distances(points, surface)
        deepest, deepest_m = ZERO, np.inf
        for k in range(_LOOK_POINTS):
            if inside[k] and signed_m[k] < deepest_m:
                deepest, deepest_m = ZERO + k, signed_m[k]
        if deepest_m < best.distance_m[0]:
            best.distance_m[0] = deepest_m
            best.point[:] = points[deepest]
        reach_m *= 2.0 / (_LOOK_POINTS - 1)
        begin_m = max(along_m[deepest] - reach_m / 2.0, 0.0)


@compiled
def refine(
    level: Level,
    best: Best,
    asked: CellFrame,
    space: Space,
    corners: Corners,
    stop_above_m: float,
    stop_below_m: float,
) -> tuple[float, Corners]:
    """Look for the hull's nearest point in cells, better than `best`, which is written.

    Returns a lower bound of the signed distance of any point of the hull in them, unless that is
    the distance of `best` itself, infinite if they hold none; and the corners known by then.
    """
    tolerance_m = space.tolerance_m
    dropped_m, lowest_m = np.inf, -np.inf
    for _ in range(_MOST_LEVELS):
        level, lower_m, deepest, corners = split_level(level, asked, best, space, corners)
        half_m = level.half_m
        if deepest >= 0:
            n_looks = _LOOKS if len(lower_m) > _FEW_CELLS else 0
            _look_deeper(best, level.center[deepest].copy(), half_m, asked, n_looks, space.surface)
        below_m = best.distance_m[0] - tolerance_m
        n, lowest_m = ZERO, np.inf
        for i in range(len(lower_m)):
            if lower_m[i] < below_m:
                for axis in range(3):
                    level.center[n, axis] = level.center[i, axis]
                level.cube[n] = level.cube[i]
                lowest_m = min(lowest_m, lower_m[i])
                n += 1
            else:
                dropped_m = min(dropped_m, lower_m[i])
        level = Level(level.center[:n], half_m, level.cube[:n], level.cubes)
        if (
            n == 0
            or np.sqrt(3.0) * half_m < _SMALLEST_CELL * tolerance_m
            or n > (_MOST_CELLS if best.distance_m[0] >= 0 else _MOST_DEEP_CELLS)
            or min(lowest_m, dropped_m, best.distance_m[0]) > stop_above_m
            or best.distance_m[0] < stop_below_m
        ):
            break
    return min(dropped_m, lowest_m), corners


@compiled
def near_level(
    level: Level,
    within_m: float,
    cell_m: float,
    most: int,
    asked: CellFrame,
    space: Space,
    corners: Corners,
) -> tuple[Level, Corners]:
    """Return the cells in which a point of the hull may be nearer to the object than `within_m`.

    They are cut until an edge is `cell_m` or less, or there are more than so many; and the corners
    known by then.
    """
    best = Best(np.full(1, np.inf), np.full(3, np.nan))
    while 2.0 * level.half_m > cell_m:
        level, lower_m, _, corners = split_level(level, asked, best, space, corners)
        kept = lower_m <= within_m
        level = Level(level.center[kept], level.half_m, level.cube[kept], level.cubes)
        if len(level.cube) > most:
            break
    return level, corners
