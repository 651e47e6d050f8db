"""How far the hull is from a CAD object, between two bounds that are certain.

The hull is given by its silhouettes alone, so no surface of it is built. Space around the object is
cut into cubes, level after level (see `hybridve.hull.query.cells`). A cube is dropped once a
camera proves that no point of the hull is in it, or once it cannot hold a point nearer to the CAD
surface than the best one found, less the tolerance:

* upper bound: a point of the hull, and the point of the surface nearest to it (both are returned);
* lower bound: every point of the hull is in a cube that was dropped for its distance, and how near
  to the surface a point of a cube can be follows from the cube's corners
  (`hybridve.hull.contact.lattice`).

Of a closed object the distance is negative inside, so that the same search finds the deepest point
of the hull beneath the surface. That depth is *not* the way that separates the two: a thin rod
through the middle of a box is as deep as half the box is thick.

Distances at corners of cubes depend on the object alone. They are kept from frame to frame, in the
object's frame, and serve wherever it is moved to: of one that moves (`ClearanceMeter.at`) the hull
is asked in that frame, as cameras see it that move the other way. What is found depends on the
hull, the object and its place only, never on what was asked before.
"""

import copy
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import Pose, invert, placed
from hybridve.hull.cad.distance import SurfaceDistance
from hybridve.hull.contact.lattice import (
    FINEST_LEVEL,
    Best,
    Cubes,
    DistanceLattice,
    bound_cells,
)
from hybridve.hull.query.cells import CellFrame, make_cell_frame, split_cells
from hybridve.hull.query.engine import checked_vertices
from hybridve.hull.query.points import are_inside
from hybridve.hull.query.silhouettes import Hull, seen_from

#: Half of the first root's edge at least, metres, and in sizes of the object. Farther than 16 times
#: that is not looked.
_NEAR_M, _REACH_SIZES = 1.0, 2.0

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

#: What rounding takes from a bound besides the error of the distances: of a root's cubes, and of
#: points on the way to the world's frame, in lengths of the root and of the way to its origin.
_ROUNDOFF = 64.0 * 2.0**-53

#: No corner of a root is farther from the object than so many of its half edges.
_FARTHEST = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Clearance:
    """How far the hull of one frame is from one object.

    Attributes
    ----------
    lower_m, upper_m : float
        Bounds of the distance between the hull and the surface, or the solid it bounds: both 0
        where a point of the hull lies on or in it (on it as far as rounding can tell, which is
        some 1e-12 m); the upper one inf where no hull was found, and the lower one how far was
        looked.
    on_object_world, on_hull_world : (3,) float64
        The two points that the upper bound was measured between, metres; of a hull that reaches
        into a closed object its deepest point, and the point of the surface nearest to that. NaN
        if no hull was found.
    depth_lower_m, depth_upper_m : float
        Bounds of the depth of the hull's deepest point beneath the surface of a closed object;
        both 0 where none is beneath it, NaN for an object that is not closed. It is no distance
        that separates them.
    """

    lower_m: float
    upper_m: float
    on_object_world: NDArray[np.float64]
    on_hull_world: NDArray[np.float64]
    depth_lower_m: float
    depth_upper_m: float

    @property
    def signed_m(self) -> tuple[float, float]:
        """Bounds of the clearance less the depth."""
        depth_lower_m, depth_upper_m = (
            0.0 if np.isnan(depth) else depth for depth in (self.depth_lower_m, self.depth_upper_m)
        )
        return self.lower_m - depth_upper_m, self.upper_m - depth_lower_m


@dataclass(frozen=True, slots=True, eq=False)
class _Level:
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

    def only(self, kept: NDArray[np.bool_]) -> "_Level":
        """Return some of the cells."""
        return _Level(self.center[kept], self.half_m, self.cube[kept], self.cubes)


@dataclass(frozen=True, slots=True, eq=False)
class NearCells:
    """Cubes in which a point of one frame's hull may be nearer to an object than was asked.

    All points of the hull that are so near lie in them.
    """

    _meter: "ClearanceMeter"
    _asked: CellFrame
    _level: _Level

    @property
    def center_world(self) -> NDArray[np.float64]:
        """The centres (N, 3), metres."""
        return self._meter._in_world(self._level.center)

    @property
    def half_m(self) -> float:
        """Half of an edge."""
        return self._level.half_m

    @property
    def reach_world(self) -> NDArray[np.float64]:
        """How far a cube reaches from its centre along each axis of the world, (3,) metres."""
        world_from_rest = self._meter.world_from_rest
        if world_from_rest is None:
            return np.full(3, self.half_m)
        return np.asarray(self.half_m * np.abs(world_from_rest[:, :3]).sum(axis=1))

    def places(self, points_world: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return which place of their lattice points (M, 3) lie in: three whole numbers each."""
        local = self._meter._local(points_world)
        return np.asarray(np.floor(local / (2.0 * self.half_m)), np.int64)

    def measure(self, kept: NDArray[np.bool_]) -> Clearance:
        """Return how far the hull within some of the cubes is from the object.

        Its lower bound holds for what of the hull lies in these cubes.
        """
        best = Best(np.full(1, np.inf), np.full(3, np.nan))
        lowest_m = self._meter._refine(self._level.only(kept), best, self._asked)
        return self._meter._found(best, lowest_m, np.zeros(3))


class ClearanceMeter:
    """Measures how far hulls are from one object, and remembers distances between frames.

    Parameters
    ----------
    vertices_world : (V, 3) float64
        Metres.
    faces : (T, 3) int32
        Vertex numbers; at least one triangle.
    is_closed : bool
        Whether the surface bounds a solid.
    tolerance_m : float
        How far apart the two bounds may be, above 0.
    solid_faces : (T, 3) int32, optional
        What meets in a closed surface; see `hybridve.hull.cad.distance.SurfaceDistance`.

    Raises
    ------
    ValueError
        If the tolerance is not above 0, there is no triangle, a coordinate is not finite, or a
        surface that is said to be closed is not.

    Attributes
    ----------
    is_closed, tolerance_m
        As given.
    error_m : float
        What a distance within reach may be off by, metres: rounding, some 1e-12, and how far
        corners that meet are apart, if they are. The bounds of `measure` allow for it.
    world_from_rest : (3, 4) float64 or None
        Where the object stands, seen from the vertices given; None if they are where it stands.
    """

    def __init__(
        self,
        vertices_world: NDArray[np.float64],
        faces: NDArray[np.int32],
        *,
        is_closed: bool,
        tolerance_m: float = 1e-4,
        solid_faces: NDArray[np.int32] | None = None,
    ) -> None:
        if not tolerance_m > 0:
            raise ValueError(f"the tolerance is {tolerance_m} m, expected more than 0")
        if len(faces) == 0:
            raise ValueError("the object has no triangle to measure from")
        vertices_world = checked_vertices(vertices_world)
        used = vertices_world[faces.ravel()]
        # Of the local frame, in which distances are known, at rest.
        self._origin = (used.min(axis=0) + used.max(axis=0)) / 2.0
        self.world_from_rest: Pose | None = None
        size_m = float((used.max(axis=0) - used.min(axis=0)).max()) / 2.0
        self.is_closed = is_closed
        self.tolerance_m = tolerance_m
        self._surface = SurfaceDistance(
            vertices_world - self._origin,
            faces,
            is_closed=is_closed,
            solid_faces=solid_faces,
        )
        self._size_m = size_m
        exponent = int(np.ceil(np.log2(max(_NEAR_M, _REACH_SIZES * size_m))))
        self._roots_m = [2.0 ** (exponent + more) for more in (0, 2, 4)]
        self._lattice = DistanceLattice(self._surface, self._roots_m[-1])
        self._rounding_m = self._surface.error_m(_FARTHEST * self._roots_m[-1])
        # Distances are to the triangles; the surface that decides about inside may be `apart_m`
        # from them.
        self.error_m = self._error_at_rest_m = (
            self._surface.apart_m
            + self._rounding_m
            + _ROUNDOFF * (self._roots_m[-1] + float(np.abs(self._origin).max()))
        )

    def at(self, world_from_rest: Pose) -> Self:
        """Return the meter of the object moved rigidly; what is known of distances is shared.

        Parameters
        ----------
        world_from_rest : (3, 4) float64
            Where it stands, seen from the vertices that the meter of the object at rest was given,
            metres.
        """
        moved = copy.copy(self)
        moved.world_from_rest = world_from_rest
        # Turned and shifted, points and projections lose some tens of u of a root's edge, for
        # which `_ROUNDOFF` has room, and as much of the way to where the object stands.
        moved.error_m = self._error_at_rest_m + _ROUNDOFF * float(
            np.abs(world_from_rest[:, 3]).max()
        )
        return moved

    def _local(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points (N, 3) in the local frame, metres."""
        if self.world_from_rest is not None:
            points_world = placed(points_world, invert(self.world_from_rest))
        return np.asarray(points_world - self._origin)

    def _in_world(
        self, points_local: NDArray[np.float64], shift_rest: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return points (N, 3) of the local frame in the world, that frame shifted if it is."""
        origin = self._origin if shift_rest is None else self._origin + shift_rest
        points_rest = np.asarray(points_local + origin)
        if self.world_from_rest is None:
            return points_rest
        return placed(points_rest, self.world_from_rest)

    def _asked(self, hull: Hull, shift_rest: NDArray[np.float64] | None = None) -> CellFrame:
        """Return a hull as cells of the local frame ask it."""
        if self.world_from_rest is not None:
            hull = seen_from(hull, self.world_from_rest)
        origin = self._origin if shift_rest is None else self._origin + shift_rest
        return make_cell_frame(hull, origin, self._roots_m[-1])

    def closest(
        self, points_world: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Return the distances (N,) of points, the surface's nearest points (N, 3), triangles (N,).

        All in metres, world frame; distances are not negative.
        """
        distance_m, nearest, triangle = self._surface.closest(self._local(points_world))
        return distance_m, self._in_world(nearest), triangle

    def signed_distance(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distances (N,) of points (N, 3), metres, negative inside a closed object.

        Within reach they are right to `error_m`.
        """
        return self._surface.signed(self._local(points_world))[0]

    def measure(
        self,
        hull: Hull,
        shift_world: NDArray[np.float64] | None = None,
        *,
        stop_above_m: float = np.inf,
        stop_below_m: float = -np.inf,
    ) -> Clearance:
        """Return how far the hull of a frame is from the object, moved by `shift_world` (3,).

        Parameters
        ----------
        hull : Hull
            The hull of one frame.
        shift_world : (3,) float64, optional
            Metres; the witnesses are those of the object in its moved place.
        stop_above_m, stop_below_m : float
            Stop early, with bounds farther apart than the tolerance, once the signed distance
            (`Clearance.signed_m`) is certainly above the one or below the other.
        """
        shift_rest = np.zeros(3) if shift_world is None else shift_world
        if self.world_from_rest is not None:
            shift_rest = self.world_from_rest[:, :3].T @ shift_rest
        asked = self._asked(hull, shift_rest)
        if self._lattice.is_large:
            self._lattice.forget()
        best = Best(np.full(1, np.inf), np.full(3, np.nan))
        # Most of the hull is near: space is looked through in ever larger cubes about the object,
        # until what may be beyond them does not matter.
        for root_m in self._roots_m:
            beyond_m = root_m - self._size_m
            lowest_m = self._search(root_m, best, asked, stop_above_m, stop_below_m)
            if best.distance_m[0] <= beyond_m or min(lowest_m, beyond_m) > stop_above_m:
                break
        return self._found(best, min(lowest_m, beyond_m), shift_rest)

    def _found(self, best: Best, lowest_m: float, shift_rest: NDArray[np.float64]) -> Clearance:
        """Return what a search found: the best point, and a bound of all others."""
        upper_m: float = np.inf
        on_object = best.point
        if best.distance_m[0] < np.inf:  # the exact distance of the best point
            signed_m, nearest = self._surface.signed(best.point[None])
            upper_m, on_object = float(signed_m[0]), nearest[0]
        error_m = self.error_m + _ROUNDOFF * float(np.abs(shift_rest).max())
        least_m = min(lowest_m, upper_m) - error_m
        if upper_m > error_m:
            upper_m += error_m
        else:  # nearer than rounding can tell is on the surface
            upper_m = min(upper_m + error_m, 0.0)
        return Clearance(
            lower_m=max(least_m, 0.0),
            upper_m=max(upper_m, 0.0),
            on_object_world=self._in_world(on_object[None], shift_rest)[0],
            on_hull_world=self._in_world(best.point[None], shift_rest)[0],
            depth_lower_m=max(-upper_m, 0.0) if self.is_closed else np.nan,
            depth_upper_m=max(-least_m, 0.0) if self.is_closed else np.nan,
        )

    def _search(
        self,
        root_m: float,
        best: Best,
        asked: CellFrame,
        stop_above_m: float,
        stop_below_m: float,
    ) -> float:
        """Look for the hull's nearest point in a cube of half edge `root_m`, better than `best`.

        Returns a lower bound of the signed distance of any point of the hull in it, unless that is
        the distance of `best` itself; inf if it holds none.
        """
        return self._refine(self._root(root_m), best, asked, stop_above_m, stop_below_m)

    def near_cells(self, hull: Hull, within_m: float, cell_m: float, most: int) -> "NearCells":
        """Return the cubes in which a point of the hull may be nearer to the object than asked.

        Parameters
        ----------
        hull : Hull
            The hull of one frame.
        within_m : float
            How near, not negative; points on a closed object's inside are near.
        cell_m : float
            The largest edge of a cube.
        most : int
            Larger cubes are returned where there were more than so many.
        """
        asked = self._asked(hull)
        root_m = next(
            (root for root in self._roots_m if root - self._size_m > within_m), self._roots_m[-1]
        )
        level, best = self._root(root_m), Best(np.full(1, np.inf), np.full(3, np.nan))
        while 2.0 * level.half_m > cell_m:
            level, lower_m, _ = self._split(level, asked, best)
            level = level.only(lower_m <= within_m)
            if len(level.center) > most:
                break
        return NearCells(self, asked, level)

    def _root(self, root_m: float) -> "_Level":
        center = np.zeros((1, 3))
        cubes = self._lattice.cubes(center, root_m, _FINE * self.tolerance_m)
        return _Level(center, root_m, np.zeros(1, np.int64), cubes)

    def _split(
        self, level: "_Level", asked: CellFrame, best: Best
    ) -> tuple["_Level", NDArray[np.float64], int]:
        """Return the parts of cells that are not free, their bounds, and the deepest of them."""
        half_m, cubes = level.half_m / 2.0, level.cubes
        whole, center, inside = split_cells(level.center, half_m, asked)
        cube = level.cube[whole]
        is_finest = half_m < self._roots_m[-1] / 2.0**FINEST_LEVEL
        if not is_finest:
            own = ~cubes.is_fine[cube]
            cube[own] = len(cubes.half_m) + np.arange(int(own.sum()))
            more = self._lattice.cubes(center[own], half_m, _FINE * self.tolerance_m)
            cubes = _joined(cubes, more)
        lower_m, deepest = bound_cells(
            center,
            inside,
            half_m,
            cube,
            cubes,
            self._lattice.distance_m,
            self._lattice.nearest,
            self._rounding_m,
            asked,
            best,
        )
        if is_finest:
            self._bound_singly(center, inside, half_m, ~cubes.is_fine[cube], lower_m, best)
        return _Level(center, half_m, cube, cubes), lower_m, deepest

    def _refine(
        self,
        level: "_Level",
        best: Best,
        asked: CellFrame,
        stop_above_m: float = np.inf,
        stop_below_m: float = -np.inf,
    ) -> float:
        """Look for the hull's nearest point in cells, better than `best`; as `_search`."""
        dropped_m, lowest_m = np.inf, -np.inf
        for _ in range(_MOST_LEVELS):
            level, lower_m, deepest = self._split(level, asked, best)
            center, half_m = level.center, level.half_m
            if deepest >= 0:
                n_looks = _LOOKS if len(center) > _FEW_CELLS else 0
                self._look_deeper(best, center[deepest], half_m, asked, n_looks)
            kept = lower_m < best.distance_m[0] - self.tolerance_m
            dropped_m = min(dropped_m, lower_m[~kept].min(initial=np.inf))
            lowest_m = lower_m[kept].min(initial=np.inf)
            level = level.only(kept)
            center = level.center
            if (
                len(center) == 0
                or np.sqrt(3.0) * half_m < _SMALLEST_CELL * self.tolerance_m
                or len(level.center)
                > (_MOST_CELLS if best.distance_m[0] >= 0 else _MOST_DEEP_CELLS)
                or min(lowest_m, dropped_m, best.distance_m[0]) > stop_above_m
                or best.distance_m[0] < stop_below_m
            ):
                break
        return float(min(dropped_m, lowest_m))

    def _bound_singly(
        self,
        center: NDArray[np.float64],
        inside: NDArray[np.bool_],
        half_m: float,
        is_coarse: NDArray[np.bool_],
        lower_m: NDArray[np.float64],
        best: Best,
    ) -> None:
        """Raise bounds of cells that no cube of the lattice bounds well, by their own distances.

        The smallest cubes are a share of the root. An object far larger than the room about the
        hull has a root to match, and one far smaller than a metre a root of metres: cells are then
        cut on below the smallest cubes.
        """
        coarse = np.flatnonzero(is_coarse)
        signed_m, _ = self._surface.signed(center[coarse])
        lower_m[coarse] = np.maximum(lower_m[coarse], signed_m - np.sqrt(3.0) * half_m)
        signed_m[~inside[coarse]] = np.inf
        nearest = int(signed_m.argmin()) if len(coarse) else -1
        if nearest >= 0 and signed_m[nearest] < best.distance_m[0]:
            best.distance_m[0], best.point[:] = signed_m[nearest], center[coarse[nearest]]

    def _look_deeper(
        self,
        best: Best,
        point: NDArray[np.float64],
        half_m: float,
        asked: CellFrame,
        n_looks: int,
    ) -> None:
        """Look at a point (3,) of the hull, at the surface beside it, and behind that.

        On the way from the surface through the point into the solid, the depth grows by a metre a
        metre until another side of the solid is as near. What is found is taken if it betters the
        best point; its distance is exact.
        """
        signed_m, nearest = self._surface.signed(point[None])
        if signed_m[0] > 0 and are_inside(nearest, asked.offset_local, asked.frame)[0]:
            if best.distance_m[0] > 0:
                best.distance_m[0], best.point[:] = 0.0, nearest[0]
        elif signed_m[0] < best.distance_m[0]:
            best.distance_m[0], best.point[:] = signed_m[0], point
        away = point - nearest[0]
        length_m = float(np.linalg.norm(away))
        if length_m == 0:
            return
        away *= np.copysign(1.0, -signed_m[0]) / length_m
        begin_m, reach_m = 0.0, 2.0 * half_m
        for _ in range(n_looks):
            along_m = begin_m + reach_m * np.linspace(0.0, 1.0, _LOOK_POINTS)
            points = point + along_m[:, None] * away
            inside = are_inside(points, asked.offset_local, asked.frame)
            if not inside.any():
                return
            signed_m, _ = self._surface.signed(points)
            signed_m[~inside] = np.inf
            deepest = int(signed_m.argmin())
            if signed_m[deepest] < best.distance_m[0]:
                best.distance_m[0], best.point[:] = signed_m[deepest], points[deepest]
            reach_m *= 2.0 / (_LOOK_POINTS - 1)
            begin_m = max(along_m[deepest] - reach_m / 2.0, 0.0)


def _joined(first: Cubes, second: Cubes) -> Cubes:
    """Return the cubes of both, in order."""
    if len(second.half_m) == 0:
        return first
    return Cubes(*(np.concatenate([a, b]) for a, b in zip(first, second, strict=True)))
