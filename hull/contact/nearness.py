"""How near the hull came to each place of an object's surface, over frames: a map of its clearance.

Space near the object is cut into cubes (`ClearanceMeter.near_cells`): every point of the hull that
is within reach is in one of them, and the middles of some are in the hull. So a place is at least
as far from the hull as from the nearest cube's middle, less half a diagonal, and at most as far as
from the nearest middle that is in the hull: bounds, as wide as the cubes are large.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hybridve.calib.pose import Pose, placed
from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.query.points import are_inside
from hybridve.hull.query.silhouettes import Hull

#: Cubes of a frame at most; larger ones serve where there were more.
_MOST_CELLS = 60_000

#: What is nearer than this share of the reach is looked at more closely.
_NEAR = 0.25

#: Triangles of a map at most; where finer ones would be more, larger ones serve.
_MOST_TRIANGLES = 200_000


def refined(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], longest_m: float
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int64]]:
    """Return a mesh of the same surface whose edges are not longer than asked, if it can be.

    Parameters
    ----------
    vertices : (V, 3) float64
        Metres.
    faces : (T, 3) int32
        Vertex numbers.
    longest_m : float
        The longest edge.

    Returns
    -------
    vertices : (W, 3) float64
        A triangle's own, shared with no other.
    faces : (U, 3) int32
    parent : (U,) int64
        Which triangle each is a part of.
    """
    corners, parent = vertices[faces], np.arange(len(faces))
    done, parents, n_done = [np.zeros((0, 3, 3))], [np.zeros(0, np.int64)], 0
    while len(corners):
        edges_m = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        long = edges_m.max(axis=1) > longest_m
        if n_done + len(corners) + 3 * int(long.sum()) > _MOST_TRIANGLES:
            long[:] = False
        done.append(corners[~long])
        parents.append(parent[~long])
        n_done += int((~long).sum())
        # Halved across the longest edge, whatever the shape.
        corners, parent, edges_m = corners[long], parent[long], edges_m[long]
        turn = (edges_m.argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = (corners[np.arange(len(corners)), turn[:, k]] for k in range(3))
        middle = (a + b) / 2
        corners = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
        parent = np.concatenate([parent, parent])
    whole = np.concatenate(done)
    numbers = np.arange(3 * len(whole), dtype=np.int32).reshape(-1, 3)
    return whole.reshape(-1, 3), numbers, np.concatenate(parents)


class Nearness:
    """The least distance of each place of an object from the hulls that were looked at.

    Parameters
    ----------
    vertices_world : (V, 3) float64
        The object at rest, metres.
    faces : (T, 3) int32
        Vertex numbers.
    is_closed : bool
        Whether the surface bounds a solid.
    solid_faces : (T, 3) int32, optional
        As of `ClearanceMeter`.
    reach_m : float
        How far is looked; beyond, all is alike.

    Attributes
    ----------
    vertices : (W, 3) float64
        Places of the surface at rest: corners of `faces`.
    faces : (U, 3) int32
        Triangles that are small beside the reach.
    parent : (U,) int64
        Of which triangle of the object each is a part.
    bounds_m : (W, 2) float64
        Lower and upper bound of the least distance; the reach or more above where nothing was near.
    """

    def __init__(
        self,
        vertices_world: NDArray[np.float64],
        faces: NDArray[np.int32],
        *,
        is_closed: bool,
        solid_faces: NDArray[np.int32] | None = None,
        reach_m: float,
    ) -> None:
        self.reach_m = reach_m
        self._meter = ClearanceMeter(
            vertices_world,
            faces,
            is_closed=is_closed,
            tolerance_m=0.05 * reach_m,
            solid_faces=solid_faces,
        )
        self.vertices, self.faces, self.parent = refined(vertices_world, faces, reach_m / 6)
        # Corners that meet are asked once.
        self._places, self._number = np.unique(self.vertices, axis=0, return_inverse=True)
        self._bounds_m = np.full((len(self._places), 2), np.inf)

    @property
    def bounds_m(self) -> NDArray[np.float64]:
        """See above."""
        return np.asarray(self._bounds_m[self._number.ravel()])

    @property
    def distance_m(self) -> NDArray[np.float64]:
        """Half way between the bounds (W,), the reach at most."""
        return np.asarray(np.minimum(self.bounds_m, self.reach_m).mean(axis=1))

    @property
    def off_m(self) -> float:
        """How far `distance_m` may be off where it is less than a quarter of the reach."""
        lower_m, upper_m = np.minimum(self._bounds_m, self.reach_m).T
        near = lower_m + upper_m < 2 * _NEAR * self.reach_m
        return float((upper_m - lower_m)[near].max(initial=0.0)) / 2

    def look(self, hull: Hull, world_from_rest: Pose | None = None) -> None:
        """Take in a frame, in which the object stands moved from where it rests."""
        meter, places = self._meter, self._places
        if world_from_rest is not None:
            meter, places = meter.at(world_from_rest), placed(places, world_from_rest)
        lowest_m = np.full(len(places), self.reach_m)
        looked_m = 0.0
        # Near the object cubes are small; farther out larger ones serve, which count only there.
        for within_m, cell_m in (
            (_NEAR * self.reach_m, self.reach_m / 96),
            (self.reach_m, self.reach_m / 32),
        ):
            cells = meter.near_cells(hull, within_m, cell_m, _MOST_CELLS)
            center = np.ascontiguousarray(cells.center_world)
            if len(center):
                nearest_m, _ = cKDTree(center).query(places)
                nearest_m -= np.sqrt(3.0) * cells.half_m
                lowest_m = np.minimum(lowest_m, np.maximum(nearest_m, looked_m))
                inside = center[are_inside(center, -hull.views.origin_world, hull.frame)]
                if len(inside):
                    nearest_m, _ = cKDTree(inside).query(places)
                    self._bounds_m[:, 1] = np.minimum(self._bounds_m[:, 1], nearest_m)
            looked_m = within_m
        self._bounds_m[:, 0] = np.minimum(self._bounds_m[:, 0], np.maximum(lowest_m, 0.0))
