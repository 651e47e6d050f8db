"""Distances to the surface of a CAD object, in double precision.

Distances come from libigl's tree of boxes (`igl.AABB`), which computes in double precision.
Open3D's `RaycastingScene` computes in single precision and names, on meshes with slivers, triangles
that are up to hundredths of a millimetre farther than the nearest, with no bound that one could
add. On which side of a closed surface a point lies is asked of Open3D all the same, by the parity
of three rays: that is no matter of hundredths. Both work in the thread that asks; their pools would
fight ours.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Rays that vote on the side; an odd number, three for one that meets an edge.
_N_RAYS = 3

#: Within this share of the object's size rays in single precision cannot tell the side.
_SIDE_PRECISION = 1e-6


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
    """

    def __init__(
        self, vertices: NDArray[np.float64], faces: NDArray[np.int32], *, is_closed: bool
    ) -> None:
        import igl  # late: the import takes a fifth of a second

        self.is_closed = is_closed
        self._vertices = np.ascontiguousarray(vertices, np.float64)
        self._faces = np.ascontiguousarray(faces, np.int64)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)
        used = self._vertices[self._faces.ravel()]
        self._lower, self._upper = used.min(axis=0), used.max(axis=0)
        self._size_m = float(np.abs(used).max())
        self._rays: Any = None

    def closest(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Return the distances (N,) of points (N, 3), the nearest points (N, 3), their triangles.

        The distances are not negative, and correct to rounding in double precision.
        """
        if len(points) == 0:
            return np.zeros(0), np.zeros((0, 3)), np.zeros(0, np.int64)
        squared, triangle, nearest = self._tree.squared_distance(
            self._vertices, self._faces, np.ascontiguousarray(points, np.float64)
        )
        return (
            np.sqrt(squared).reshape(-1),
            nearest.reshape(-1, 3),
            np.asarray(triangle, np.int64).reshape(-1),
        )

    def signed(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the signed distances (N,) of points (N, 3), and the nearest points (N, 3).

        Of a surface that is not closed they are not negative. A point within a millionth of the
        object's size of the surface counts as outside.
        """
        distance_m, nearest, _ = self.closest(points)
        if self.is_closed:
            doubtful = (
                ((points > self._lower) & (points < self._upper)).all(axis=1)
                & (distance_m > _SIDE_PRECISION * self._size_m)
            )  # fmt: skip
            within = np.flatnonzero(doubtful)
            within = within[self._is_within(points[within])]
            distance_m[within] *= -1.0
        return distance_m, nearest

    def _is_within(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        if len(points) == 0:
            return np.zeros(0, np.bool_)
        import open3d  # late: the import alone takes up to a second

        if self._rays is None:
            self._rays = open3d.t.geometry.RaycastingScene(nthreads=1)
            self._rays.add_triangles(
                open3d.core.Tensor.from_numpy(self._vertices.astype(np.float32)),
                open3d.core.Tensor.from_numpy(self._faces.astype(np.uint32)),
            )
        occupied = self._rays.compute_occupancy(
            open3d.core.Tensor.from_numpy(points.astype(np.float32)), nthreads=1, nsamples=_N_RAYS
        )
        return np.asarray(occupied.numpy() > 0.5)
