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
hull, the object and its place only, never on what was asked before. Several threads may ask one
meter: they take turns.
"""

import copy
import threading
import weakref
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import Pose, invert, placed
from hybridve.hull.cad.distance import SurfaceDistance
from hybridve.hull.contact.lattice import Best, DistanceLattice
from hybridve.hull.contact.refinement import Level, Space, near_level, refine, root_level
from hybridve.hull.query.cells import CellFrame, make_cell_frame
from hybridve.hull.query.engine import checked_vertices
from hybridve.hull.query.silhouettes import Hull, seen_from

#: Half of the first root's edge at least, metres, and in sizes of the object. Farther than 16 times
#: that is not looked.
_NEAR_M, _REACH_SIZES = 1.0, 2.0

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


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class NearCells:
    """Cubes in which a point of one frame's hull may be nearer to an object than was asked.

    All points of the hull that are so near lie in them.
    """

    _meter: "ClearanceMeter"
    _asked: CellFrame
    _level: Level

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
        with self._meter._turn:
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
        self._turn = threading.Lock()
        # While there are some, the corners of their cubes are not forgotten.
        self._near: weakref.WeakSet[NearCells] = weakref.WeakSet()
        rounding_m = self._surface.error_m(_FARTHEST * self._roots_m[-1])
        self._space = Space(
            self._surface.surface, self._roots_m[-1], rounding_m, float(tolerance_m)
        )
        # Distances are to the triangles; the surface that decides about inside may be `apart_m`
        # from them.
        self.error_m = self._error_at_rest_m = (
            self._surface.apart_m
            + rounding_m
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
        best = Best(np.full(1, np.inf), np.full(3, np.nan))
        with self._turn:
            if self._lattice.is_large and not self._near:
                self._lattice.forget()
            # Most of the hull is near: space is looked through in ever larger cubes about the
            # object, until what may be beyond them does not matter.
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
        level, self._lattice.corners = root_level(root_m, self._space, self._lattice.corners)
        return self._refine(level, best, asked, stop_above_m, stop_below_m)

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
        lattice, space = self._lattice, self._space
        with self._turn:
            level, lattice.corners = root_level(root_m, space, lattice.corners)
            level, lattice.corners = near_level(
                level, float(within_m), float(cell_m), most, asked, space, lattice.corners
            )
            found = NearCells(self, asked, level)
            self._near.add(found)
        return found

    def _refine(
        self,
        level: Level,
        best: Best,
        asked: CellFrame,
        stop_above_m: float = np.inf,
        stop_below_m: float = -np.inf,
    ) -> float:
        """Look for the hull's nearest point in cells, better than `best`; as `_search`."""
        lowest_m, self._lattice.corners = refine(
            level,
            best,
            asked,
            self._space,
            self._lattice.corners,
            float(stop_above_m),
            float(stop_below_m),
        )
        return float(lowest_m)
