"""The visual hull of true shapes, from silhouettes without pixels.

A camera sees a shape along a ray if the ray meets it; the hull of the true shapes is all points
that every camera sees in its image and whose rays, from every camera, meet some shape. Nothing is
sampled: a ray is met in closed form, and the lens only decides what lies within the image.

How near the hull comes to a surface is found by cells of space that are halved where they can
matter. About a ray with direction d from a camera, all rays through a cell of radius r at distance
D lie within t r / D at distance t. The signed distance of a convex shape along the ray less t r / D
is a convex function of t; Newton's method from the near side finds its first root or proves that
there is none, and then no ray through the cell meets the shape.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.lens import img_from_cam
from hybridve.calib.pose import Pose, invert, transform
from hybridve.hull.synth.shapes import Shape, lengths_and_units

Floats = NDArray[np.float64]

#: How far a distance to the hull may lie above the true one.
RESOLUTION_M = 0.00025

#: Newton's steps along a ray; a ray that is undecided after them is taken to meet the shape.
_MAX_STEPS = 24

#: So near to a shape a ray counts as meeting it in the test of cells, which errs on that side.
_TOUCHES_M = 1e-9

#: More than rounding adds to an angle near zero, where the cosine is flat.
_ROUNDING_RAD = 1e-6

#: A lens moves a pixel by at most this many focal lengths when the ray's slope changes by one. For
#: barrel distortion it is 1, and decentring adds less than one percent.
_STEEPEST_LENS = 1.1

#: Roots of the search along the longest side of the region.
_ROOTS = 6

#: A triangle of which two sides enclose an angle with a lesser sine is measured as its three sides:
#: it lies within this of them, as a share of its size, and its normal may be wrong by that much.
_SINE_OF_A_LINE = 1e-8

#: Nothing so near to the plane through a camera's centre, as a share of its distance, is in sight.
_IN_SIGHT = 1e-9

#: The eight parts of a cell.
_PARTS = np.stack(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5]), axis=-1).reshape(-1, 3)


class Surface:
    """Triangles that can be asked how near they are.

    Parameters
    ----------
    triangles_world : (T, 3, 3) float64
        Corners in metres. Those without area are the lines or points that they are.
    """

    def __init__(self, triangles_world: Floats) -> None:
        self.triangles_world = triangles_world
        self._middle = triangles_world.mean(axis=1)
        self._reach = np.linalg.norm(triangles_world - self._middle[:, None], axis=2).max(axis=1)
        self._edges = np.roll(triangles_world, -1, axis=1) - triangles_world  # (T, 3, 3)
        self._lengths2 = (self._edges**2).sum(axis=2)
        # Directions first: the product of two edges may be less than a float can say.
        _, along = lengths_and_units(self._edges.reshape(-1, 3))
        along = along.reshape(-1, 3, 3)
        across, self._normal = lengths_and_units(np.cross(along[:, 0], along[:, 1]))
        self._is_line = across < _SINE_OF_A_LINE
        self._outwards = np.cross(along, self._normal[:, None])  # in the plane, (T, 3, 3)

    def shifted(self, by_world: Floats) -> "Surface":
        """Return the surface moved by (3,) metres."""
        return Surface(self.triangles_world + by_world)

    def candidates(self, points: Floats, slack_m: float) -> tuple[NDArray[np.int64], ...]:
        """Return pairs (P,), (P,) of points and triangles.

        They hold, for every place within half the slack of a point, the triangle nearest to it.
        """
        apart = np.linalg.norm(points[:, None] - self._middle, axis=2)  # (N, T)
        farthest = (apart + self._reach).min(axis=1)
        return np.nonzero(apart - self._reach <= farthest[:, None] + slack_m)

    def closest(self, points: Floats, triangles: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """Return the distance (P,) of each point (P, 3) to its triangle and the place (P, 3)."""
        offsets = points[:, None] - self.triangles_world[triangles]  # (P, 3 corners, 3)
        edges, normal = self._edges[triangles], self._normal[triangles]
        height = np.einsum("pi,pi->p", offsets[:, 0], normal)
        beyond = np.einsum("pki,pki->pk", offsets, self._outwards[triangles]) > 0
        place = points - height[:, None] * normal
        off = np.flatnonzero(beyond.any(axis=1) | self._is_line[triangles])
        lengths2 = self._lengths2[triangles[off]]
        along = np.einsum("pki,pki->pk", offsets[off], edges[off])
        along /= np.where(lengths2 > 0, lengths2, 1.0)
        rest = offsets[off] - np.clip(along, 0.0, 1.0)[..., None] * edges[off]  # (P', 3, 3)
        nearest = (rest**2).sum(axis=2).argmin(axis=1)
        place[off] = points[off] - rest[np.arange(len(off)), nearest]
        return np.linalg.norm(points - place, axis=1), place

    def distance(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the distance (N,) of points (N, 3) to the surface and the nearest place (N, 3)."""
        rows, triangles = self.candidates(points, 0.0)
        distances, places = self.closest(points[rows], triangles)
        order = np.lexsort((distances, rows))
        first = order[np.flatnonzero(np.diff(rows[order], prepend=-1))]
        return distances[first], places[first]


@dataclass(frozen=True, slots=True)
class HullDistance:
    """How near the hull comes to a surface.

    Attributes
    ----------
    distance_m : float
        Their distance, at most the resolution above the exact one; 0 where a point of the surface
        lies in the hull, inf where the hull is farther away than was asked for.
    collides : bool
        Whether a point of the surface was found in the hull.
    """

    distance_m: float
    collides: bool


class TrueHull:
    """The hull of shapes at rest, as true cameras see it.

    Parameters
    ----------
    cameras : sequence of Camera
        At least one; none of them in a shape.
    shapes : sequence of Shape
        The real things; none is flat, for a hull without an inside is never found.
    world_from_shape : sequence of (3, 4) float64
        Where each stands.
    """

    def __init__(
        self, cameras: Sequence[Camera], shapes: Sequence[Shape], world_from_shape: Sequence[Pose]
    ) -> None:
        self._cameras = cameras
        self._shapes = shapes
        self._shape_from_world = [invert(pose) for pose in world_from_shape]
        self._reach_m = np.array([shape.reach_m for shape in shapes])

    def contains(self, points_world: Floats) -> NDArray[np.bool_]:
        """Tell which points (N, 3) lie in the hull, exactly."""
        return self._contains(points_world, self._may_meet_by_reach(points_world, 0.0))

    def distance(
        self,
        surface: Surface,
        *,
        within_m: float,
        witnesses_world: Floats | None = None,
        resolution_m: float = RESOLUTION_M,
    ) -> HullDistance:
        """Return how near the hull comes to a surface.

        Parameters
        ----------
        surface : Surface
            What it comes near to.
        within_m : float
            How far to look; beyond that the answer is inf.
        witnesses_world : (N, 3) float64, optional
            Points that may lie in the hull: a good guess saves time.
        resolution_m : float
            How far the answer may lie above the exact one.
        """
        best_m = within_m
        if witnesses_world is not None and len(witnesses_world):
            found = witnesses_world[self.contains(witnesses_world)]
            if len(found):
                distances, places = surface.distance(found)
                if self.contains(places).any():
                    return HullDistance(0.0, True)
                best_m = min(best_m, float(distances.min()))
        for cells, inside in _Levels(self, surface, best_m):
            if inside.any():
                distances, places = cells.distances_m[inside], cells.places[inside]
                if self.contains(places[distances < 2 * cells.radius_m]).any():
                    return HullDistance(0.0, True)
                best_m = min(best_m, float(distances.min()))
            cells.drop_beyond(best_m - resolution_m)
        return HullDistance(best_m if best_m < within_m else np.inf, False)

    def points_within(
        self, surface: Surface, within_m: float, resolution_m: float = RESOLUTION_M
    ) -> Floats:
        """Return points (N, 3) of the hull that are nearer to a surface than `within_m`.

        Not all, but some if there are any; the hull may reach in by the resolution unnoticed.
        """
        for cells, inside in _Levels(self, surface, within_m):
            close = inside & (cells.distances_m < within_m)
            if close.any():
                return cells.centers[close]
            cells.drop_beyond(within_m - resolution_m)
        return np.zeros((0, 3))

    def _contains(self, points_world: Floats, may: list[NDArray[np.bool_]]) -> NDArray[np.bool_]:
        """Tell which points lie in the hull; `may` (C of (N, S)) says which shapes can be met."""
        inside = np.ones(len(points_world), np.bool_)
        for camera, shapes in zip(self._cameras, may, strict=True):
            inside &= _in_image(camera, points_world, 0.0)
            rays = points_world - camera.center_world
            meets = np.zeros(len(points_world), np.bool_)
            for number, shape in enumerate(self._shapes):
                rows = np.flatnonzero(inside & ~meets & shapes[:, number])
                if len(rows):
                    pose = self._shape_from_world[number]
                    origin = transform(pose, camera.center_world[None])[0]
                    meets[rows] = np.isfinite(shape.hit(origin, rays[rows] @ pose[:, :3].T))
            inside &= meets
        return inside

    def _may_meet_by_reach(self, centers_world: Floats, radius_m: float) -> list[NDArray[np.bool_]]:
        """Tell which shapes rays through cells may meet, by the balls about them: C of (N, S)."""
        middles = np.array([invert(pose)[:, 3] for pose in self._shape_from_world])
        may = []
        for camera in self._cameras:
            rays = centers_world - camera.center_world
            away, directions = lengths_and_units(rays)
            toward = middles - camera.center_world
            depth = directions @ toward.T  # (N, S)
            far, _ = lengths_and_units(toward)
            angle = np.arctan2(np.sqrt(np.maximum(far**2 - depth**2, 0.0)), depth)
            # Half the angles that the ball and the cell take up; all for a camera that is in them.
            ball = np.arcsin(_share(self._reach_m, far))
            cell = np.arcsin(_share(radius_m, away))
            close = angle <= ball + cell[:, None] + _ROUNDING_RAD
            may.append(close | (away <= radius_m)[:, None] | (far <= self._reach_m))
        return may

    def _may_hold(
        self, centers_world: Floats, radius_m: float, may: list[NDArray[np.bool_]]
    ) -> NDArray[np.bool_]:
        """Tell which cells may hold a point of the hull, and strike from `may` what they miss."""
        keep = np.ones(len(centers_world), np.bool_)
        for camera, shapes in zip(self._cameras, may, strict=True):
            keep &= _in_image(camera, centers_world, radius_m)
            rays = centers_world - camera.center_world
            away, directions = lengths_and_units(rays)
            # One shape that may be met is enough to keep a cell: those that most may meet first.
            # Rays through a cell that holds the camera go anywhere.
            undecided = keep & (away > radius_m)
            for number in np.argsort(-shapes[keep].sum(axis=0), kind="stable"):
                rows = np.flatnonzero(undecided & shapes[:, number])
                if len(rows):
                    pose = self._shape_from_world[number]
                    origin = transform(pose, camera.center_world[None])[0]
                    local = directions[rows] @ pose[:, :3].T
                    slack = radius_m / away[rows]
                    meets = _may_meet(self._shapes[number], origin, local, slack)
                    shapes[rows[~meets], number] = False
                    undecided[rows[meets]] = False
            keep &= ~undecided
        return keep


class _Levels:
    """Cells about a surface, coarse to fine: an iterator over levels that may drop cells."""

    def __init__(self, hull: TrueHull, surface: Surface, within_m: float) -> None:
        self._hull, self._surface = hull, surface
        corners = surface.triangles_world.reshape(-1, 3)
        low, high = corners.min(axis=0) - within_m, corners.max(axis=0) + within_m
        self._half_m = float((high - low).max()) / _ROOTS / 2
        counts = np.maximum(1, np.ceil((high - low) / (2 * self._half_m) - 1e-9).astype(int))
        steps = np.indices(counts).reshape(3, -1).T
        self.centers: Floats = low + (2 * steps + 1) * self._half_m
        self.distances_m: Floats = np.zeros(0)
        self.places: Floats = np.zeros((0, 3))
        self._may = hull._may_meet_by_reach(self.centers, self.radius_m)
        self._within_m = within_m
        self._is_first = True

    @property
    def radius_m(self) -> float:
        """Distance of a cell's corners from its centre."""
        return float(np.sqrt(3.0) * self._half_m)

    def __iter__(self) -> "_Levels":
        return self

    def __next__(self) -> tuple["_Levels", NDArray[np.bool_]]:
        """Return the cells that may hold a point of the hull, and which hold it in the middle."""
        parents = None
        if not self._is_first:
            parents = np.repeat(np.arange(len(self.centers)), 8)
            self._half_m /= 2
            self.centers = (self.centers[:, None] + 2 * self._half_m * _PARTS).reshape(-1, 3)
            self._may = [np.repeat(shapes, 8, axis=0) for shapes in self._may]
        # The cones first: they are cheaper to ask than the triangles, and drop more.
        keep = self._hull._may_hold(self.centers, self.radius_m, self._may)
        self.centers = self.centers[keep]
        self._may = [shapes[keep] for shapes in self._may]
        if not len(self.centers):
            raise StopIteration
        if parents is None:
            self._rows, self._triangles = self._surface.candidates(self.centers, 2 * self.radius_m)
        else:
            self._inherit(parents[keep])
        self._measure()
        if self._is_first:
            self._is_first = False
            self.drop_beyond(self._within_m)
        return self, self._hull._contains(self.centers, self._may)

    def drop_beyond(self, distance_m: float) -> None:
        """Drop cells all of which is at least so far from the surface."""
        keep = self.distances_m - self.radius_m < distance_m
        numbers = np.cumsum(keep) - 1
        of_kept = keep[self._rows]
        self._rows = numbers[self._rows[of_kept]]
        self._triangles = self._triangles[of_kept]
        self._may = [shapes[keep] for shapes in self._may]
        self.centers, self.distances_m, self.places = (
            self.centers[keep],
            self.distances_m[keep],
            self.places[keep],
        )

    def _inherit(self, parents: NDArray[np.int64]) -> None:
        """Give each cell the triangles of its parent; pairs stay in the order of their cells."""
        per_parent = np.bincount(self._rows, minlength=parents.max() + 1)
        starts = np.cumsum(per_parent) - per_parent
        sizes = per_parent[parents]
        self._rows = np.repeat(np.arange(len(parents)), sizes)
        within = np.arange(len(self._rows)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        self._triangles = self._triangles[np.repeat(starts[parents], sizes) + within]

    def _measure(self) -> None:
        """Find each cell's distance to the surface and leave it the triangles that can be near."""
        distances, places = self._surface.closest(self.centers[self._rows], self._triangles)
        starts = np.flatnonzero(np.diff(self._rows, prepend=-1))
        self.distances_m = np.minimum.reduceat(distances, starts)
        nearest = distances == self.distances_m[self._rows]
        _, first = np.unique(self._rows[nearest], return_index=True)
        self.places = places[nearest][first]
        near = distances <= self.distances_m[self._rows] + 2 * self.radius_m
        self._rows, self._triangles = self._rows[near], self._triangles[near]


def _may_meet(shape: Shape, origin: Floats, directions: Floats, slack: Floats) -> NDArray[np.bool_]:
    """Tell which rays, or any that spread from them by `slack` a metre, may meet a shape."""
    meets = np.ones(len(directions), np.bool_)
    waiting = np.arange(len(directions))
    # The shape lies within its reach, so that nothing is met before this.
    along = np.maximum(0.0, np.linalg.norm(origin) - shape.reach_m) / (1.0 + slack)
    for _ in range(_MAX_STEPS):
        distance, slope = shape.signed_distance(origin + along[:, None] * directions[waiting])
        free = distance - slack * along
        rate = (slope * directions[waiting]).sum(axis=1) - slack
        ahead = free > _TOUCHES_M
        misses = ahead & (rate >= 0)  # convex: it has passed the nearest place
        meets[waiting[misses]] = False
        on = ahead & ~misses
        if not on.any():
            break
        waiting, slack = waiting[on], slack[on]
        along = along[on] - free[on] / rate[on]
    return meets


def _in_image(camera: Camera, points_world: Floats, radius_m: float) -> NDArray[np.bool_]:
    """Tell which balls (N) about points (N, 3) may show in a camera's image."""
    points_cam = transform(camera.cam_from_world, points_world)
    away, _ = lengths_and_units(points_cam)
    ahead = points_cam[:, 2] - radius_m > _IN_SIGHT * away
    pixels = img_from_cam(camera, np.where(ahead[:, None], points_cam, [0.0, 0.0, 1.0]))
    # A point within the radius changes x / z by at most this.
    nearest_m = np.where(ahead, points_cam[:, 2] - radius_m, 1.0)
    steep = away / np.where(ahead, points_cam[:, 2], 1.0)
    slack_px = _STEEPEST_LENS * camera.params[:2].max() * steep * radius_m / nearest_m
    size = np.array([camera.width_px, camera.height_px])
    in_image = ((pixels >= -slack_px[:, None]) & (pixels < size + slack_px[:, None])).all(axis=1)
    behind = points_cam[:, 2] <= -radius_m if radius_m else ~ahead
    return np.where(ahead, in_image, ~behind)


def _share(radius_m: Floats | float, away_m: Floats) -> Floats:
    """Return the sine of half the angle that balls take up; 1 for those that hold the camera."""
    apart = away_m > radius_m
    return np.asarray(np.where(apart, radius_m / np.where(apart, away_m, 1.0), 1.0))
