"""Distances to the surface of a CAD object, and on which side of it a point is.

Both are our own (`hybridve.hull.cad.surface_tree`): distances in double precision with a bound
of what rounding does to them, whatever the shape of the triangles, sides without any rounding.

**Inside** is where the surface's winding number is not 0: where it goes round a point, as often as
it may, in whatever direction.

* A part modelled inside out has -1 inside: its inside is its inside all the same.
* A cavity modelled as a shell that faces inwards has 1 - 1 = 0: outside.
* Where two closed shells overlap, or one lies in the other and faces the same way, it is 2: inside.
  Distance and depth are those of the nearest surface, which may be the other shell's.
* Of a surface that is not closed the winding number is no integer, so nothing is inside of it. What
  closed means is told in `hybridve.hull.cad.topology`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.predicates import LEAST, within_range
from hybridve.hull.cad.surface_tree import (
    DISTANCE_ERROR,
    SurfaceTree,
    are_in_solid,
    closest_on_surface,
    make_tree,
    winding_numbers,
)
from hybridve.hull.cad.topology import meeting_faces
from hybridve.hull.jit import compiled


class Surface(NamedTuple):
    """A surface as compiled loops take it; `SurfaceDistance` has one.

    Attributes
    ----------
    tree : SurfaceTree
        Its triangles.
    is_closed : bool
        Whether it bounds a solid.
    apart_m : float
        As of `SurfaceDistance`.
    """

    tree: SurfaceTree
    is_closed: bool
    apart_m: float


@compiled
def signed_distances(
    points: NDArray[np.float64], surface: Surface
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what `SurfaceDistance.signed` does, of points (N, 3) with coordinates below 2^300."""
    distance_m, nearest, _ = closest_on_surface(points, surface.tree)
    if surface.is_closed:
        in_range = points.copy()
        for i in range(len(points)):
            for axis in range(3):
                if abs(points[i, axis]) < LEAST:
                    in_range[i, axis] = 0.0
        inside = are_in_solid(in_range, distance_m, surface.apart_m, surface.tree)
        for i in range(len(points)):
            if inside[i]:
                distance_m[i] = -distance_m[i]
    return distance_m, nearest


class SurfaceDistance:
    """How far points are from a surface of triangles, in the frame that its vertices are in.

    Parameters
    ----------
    vertices : (V, 3) float64
        Metres, about an origin near the surface.
    faces : (T, 3) int32
        Vertex numbers; at least one triangle.
    is_closed : bool
        Whether the surface bounds a solid: distances are negative inside.
    solid_faces : (T, 3) int32, optional
        Of a closed surface: the same triangles in numbers that are equal where corners meet
        (`hybridve.hull.cad.topology.meeting_faces`), as its file has them. By default found
        here, which serves unless what meets in the file was moved apart by rounding since.

    Attributes
    ----------
    is_closed : bool
        As given.
    surface : Surface
        The same for compiled loops.
    apart_m : float
        How far the corners that meet in `solid_faces` are apart: the solid that decides what is
        inside has its surface no farther from the triangles. 0 but for noise.

    Raises
    ------
    ValueError
        If a surface that is said to be closed is not.
    """

    def __init__(
        self,
        vertices: NDArray[np.float64],
        faces: NDArray[np.int32],
        *,
        is_closed: bool,
        solid_faces: NDArray[np.int32] | None = None,
    ) -> None:
        self.is_closed = is_closed
        self.apart_m = 0.0
        corners = np.asarray(vertices[faces], np.float64)  # (T, 3, 3)
        solid = within_range(corners)
        if is_closed:
            if solid_faces is None:
                solid_faces = meeting_faces(vertices, faces)
            if solid_faces is None:
                raise ValueError("the surface is said to be closed, but its edges do not meet")
            solid = within_range(vertices[solid_faces])
            counts = (solid_faces != solid_faces[:, :1]).any(axis=1)
            self.apart_m = float(
                np.linalg.norm(solid[counts] - corners[counts], axis=2).max(initial=0.0)
            )
        self._tree = make_tree(corners, solid)
        self.surface = Surface(self._tree, is_closed, self.apart_m)

    def closest(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Return the distances (N,) of points (N, 3), the nearest points (N, 3), their triangles.

        The distances are not negative, and right to `error_m`. Of triangles that are equally near
        the first is named.
        """
        return closest_on_surface(np.ascontiguousarray(points, np.float64), self._tree)

    def error_m(self, distance_m: float) -> float:
        """Return what a distance up to `distance_m` may be off by, by rounding."""
        # Squares of what is below 2^-300 m may underflow.
        return DISTANCE_ERROR * (distance_m + self._tree.longest_m) + LEAST

    def signed(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the signed distances (N,) of points (N, 3), and the nearest points (N, 3).

        Of a surface that is not closed they are not negative. The sign is exact for every point
        off the surface (of the solid, see `apart_m`); on it, distances are 0 to `error_m`.
        """
        points = np.ascontiguousarray(points, np.float64)
        if self.is_closed:
            within_range(points)
        return signed_distances(points, self.surface)

    def winding(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return how often a closed surface goes round points (N, 3): an integer each, exactly.

        Raises
        ------
        ValueError
            If the surface is not closed: there is no such number.
        """
        if not self.is_closed:
            raise ValueError("the surface is not closed, so that it goes round nothing")
        return winding_numbers(within_range(np.ascontiguousarray(points, np.float64)), self._tree)
