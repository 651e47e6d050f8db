"""How much of a part the cameras can see at all, whatever stands in the way.

Of a point that too few cameras see nothing is ever in the hull: "free" says nothing about real
things there. Each triangle is therefore told to be seen, seen in part, or not seen, and the part by
how much of its surface is seen. A camera's image is a convex cone in space, four planes through
its centre, so that triangles are cut at these planes:

* all three corners within the cones of as many cameras as are needed: the triangle is *seen*;
* what the planes of a camera leave of a triangle is empty: the camera sees nothing of it. Fewer
  cameras are left than are needed, or the cones of all, where all are needed, leave nothing: the
  triangle is *not seen*;
* else it is seen *in part*: exactly how much where all cameras are needed, else estimated at the
  middles of 256 equal parts.

The first two are proofs: the planes are moved inward for the first, outward for the second, by a
thousand times the rounding of a corner's distance to them.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import ZERO, compiled
from hybridve.hull.query.silhouettes import Views

#: What is told of a triangle.
NOT_SEEN, IN_PART, SEEN = 0, 1, 2

#: By how much planes are moved, in sums of the sizes of the terms of a distance.
_PAD = 1000.0 * 2.0**-53

#: A triangle is cut at four planes of each camera; each adds a corner at most.
_MORE_CORNERS = 4

#: Parts of a triangle's edge, where a share is estimated: 16 * 16 equal triangles.
_PARTS = 16


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """How much of a part the cameras can see.

    Attributes
    ----------
    triangles : (T,) int8
        `NOT_SEEN` and `SEEN` are proved; else `IN_PART`.
    shares : (T,) float64
        The seen share of each triangle's area; 0 where it has none and is not seen.
    share : float
        The seen share of the whole surface; of its triangles, if it has no area.
    is_exact : bool
        Whether shares are exact, but for rounding; else estimates.
    blind : tuple of str
        The cameras that are proved to see no point of the surface.
    """

    triangles: NDArray[np.int8]
    shares: NDArray[np.float64]
    share: float
    is_exact: bool
    blind: tuple[str, ...]

    @property
    def is_not_seen(self) -> bool:
        """Whether it is proved that no point of the surface is seen by cameras enough."""
        return not self.triangles.any()

    @property
    def is_seen(self) -> bool:
        """Whether it is proved that every point of the surface is."""
        return bool((self.triangles == SEEN).all())


def sight_of(views: Views, vertices_world: NDArray[np.float64], faces: NDArray[np.int32]) -> Sight:
    """Tell how much of a part the cameras can see.

    It is about the surface. Where none of it is seen, the solid that it bounds may still hold all
    that the cameras see: a room around them.

    Parameters
    ----------
    views : Views
        C cameras.
    vertices_world : (V, 3) float64
        Metres.
    faces : (T, 3) int32
        Vertex numbers.
    """
    needed = len(views) if views.unseen == "carve" else views.min_cameras
    planes = view_planes(views)
    corners_local = (vertices_world - views.origin_world)[faces]
    triangles, shares, sees = _see_triangles(planes, corners_local, needed)
    sides = corners_local[:, 1:] - corners_local[:, :1]
    areas = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    weights = areas if areas.sum() > 0 else np.ones(len(faces))
    share = float(weights @ shares / weights.sum()) if len(faces) else 0.0
    return Sight(
        triangles,
        shares,
        min(share, 1.0),
        needed == len(views),
        tuple(views.names[camera] for camera in np.flatnonzero(~sees)),
    )


def view_planes(views: Views) -> NDArray[np.float64]:
    """Return the left, right, upper and lower plane of each image, (C, 4, 2, 4), local frame.

    A point x lies in the image where ``plane[0] @ (x, 1) >= 0`` for all four, which puts it in
    front of the camera, too; ``plane[1] @ (abs(x), 1)`` is the sum of the sizes of all terms.
    """
    matrices = views.img_from_local
    width, height = views.sizes_px[:, 0, None], views.sizes_px[:, 1, None]
    x, y, z = matrices[:, 0], matrices[:, 1], matrices[:, 2]
    planes = np.stack([x, width * z - x, y, height * z - y], axis=1)
    x, y, z = np.abs(x), np.abs(y), np.abs(z)
    sizes = np.stack([x, width * z + x, y, height * z + y], axis=1)
    return np.ascontiguousarray(np.stack([planes, sizes], axis=2))


@compiled
def _distance(plane: NDArray[np.float64], x: float, y: float, z: float) -> tuple[float, float]:
    """Return a point's distance to a plane, of any scale, and the sum of the sizes of its terms."""
    distance = plane[0, 0] * x + plane[0, 1] * y + plane[0, 2] * z + plane[0, 3]
    size = plane[1, 0] * abs(x) + plane[1, 1] * abs(y) + plane[1, 2] * abs(z) + plane[1, 3]
    return distance, size


@compiled
def _cut(
    planes: NDArray[np.float64],
    corners: NDArray[np.float64],
    n_corners: int,
    other: NDArray[np.float64],
) -> int:
    """Leave of a convex polygon what lies within four planes, moved outward; return its corners.

    A cut lies where the distance is below zero for certain, so that nothing seen is cut away.
    """
    for side in range(len(planes)):
        n_left = 0
        for i in range(n_corners):
            j = (i + 1) % n_corners
            here, size = _distance(planes[side], corners[i, 0], corners[i, 1], corners[i, 2])
            here += _PAD * size
            there, size = _distance(planes[side], corners[j, 0], corners[j, 1], corners[j, 2])
            there += _PAD * size
            if here >= 0.0:
                other[n_left] = corners[i]
                n_left += 1
            if (here < 0.0) != (there < 0.0):
                at = here / (here - there)
                for k in range(3):
                    other[n_left, k] = corners[i, k] + at * (corners[j, k] - corners[i, k])
                n_left += 1
        n_corners = n_left
        corners[:n_corners] = other[:n_corners]
        if n_corners == 0:
            return 0
    return n_corners


@compiled
def _area(corners: NDArray[np.float64], n_corners: int) -> float:
    """Return the area of a convex polygon."""
    x, y, z = 0.0, 0.0, 0.0
    for i in range(1, n_corners - 1):
        a, b = corners[i] - corners[0], corners[i + 1] - corners[0]
        x += a[1] * b[2] - a[2] * b[1]
        y += a[2] * b[0] - a[0] * b[2]
        z += a[0] * b[1] - a[1] * b[0]
    return 0.5 * float(np.sqrt(x * x + y * y + z * z))


@compiled
def _see_triangles(
    planes: NDArray[np.float64], triangles: NDArray[np.float64], needed: int
) -> tuple[NDArray[np.int8], NDArray[np.float64], NDArray[np.bool_]]:
    """Return what is told of triangles (T, 3, 3), their seen shares, and which cameras see any."""
    n_cameras = len(planes)
    told = np.zeros(len(triangles), np.int8)
    shares = np.zeros(len(triangles))
    sees = np.zeros(n_cameras, np.bool_)
    corners = np.zeros((3 + _MORE_CORNERS * n_cameras, 3))
    other = np.zeros_like(corners)
    may_see = np.zeros(n_cameras, np.bool_)
    three = ZERO + 3
    for number in range(len(triangles)):
        triangle = triangles[number]
        n_whole, n_may = 0, 0
        for camera in range(n_cameras):
            is_within, is_beside = True, False
            for side in range(4):
                n_beside = 0
                for i in range(3):
                    distance, size = _distance(
                        planes[camera, side], triangle[i, 0], triangle[i, 1], triangle[i, 2]
                    )
                    is_within = is_within and distance > _PAD * size
                    n_beside += distance < -_PAD * size
                is_beside = is_beside or n_beside == 3
            may_see[camera] = False
            if is_within:
                n_whole += 1
                may_see[camera] = True
            elif not is_beside:
                corners[:3] = triangle
                may_see[camera] = _cut(planes[camera], corners, three, other) > 0
            if may_see[camera]:
                n_may += 1
                sees[camera] = True
        if n_whole >= needed:
            told[number], shares[number] = SEEN, 1.0
            continue
        if n_may < needed:
            continue
        if needed == n_cameras:
            corners[:3] = triangle
            n_corners = three
            for camera in range(n_cameras):
                n_corners = _cut(planes[camera], corners, n_corners, other)
                if n_corners == 0:
                    break
            if n_corners == 0:
                continue
            told[number] = IN_PART
            whole = _area(triangle, three)
            if whole > 0.0:
                shares[number] = min(1.0, _area(corners, n_corners) / whole)
        else:
            told[number] = IN_PART
            shares[number] = _sampled_share(planes, triangle, may_see, needed)
    return told, shares, sees


@compiled
def _sampled_share(
    planes: NDArray[np.float64],
    triangle: NDArray[np.float64],
    may_see: NDArray[np.bool_],
    needed: int,
) -> float:
    """Return the share of equal parts of a triangle whose middles enough cameras see."""
    n_seen = 0
    for i in range(_PARTS):
        for j in range(_PARTS - i):
            for up in range(2):
                if up and j == _PARTS - i - 1:
                    continue
                s = (i + (2.0 if up else 1.0) / 3.0) / _PARTS
                t = (j + (2.0 if up else 1.0) / 3.0) / _PARTS
                point = (
                    triangle[0] + s * (triangle[1] - triangle[0]) + t * (triangle[2] - triangle[0])
                )
                n_cameras = 0
                for camera in range(len(planes)):
                    if not may_see[camera]:
                        continue
                    is_within = True
                    for side in range(4):
                        distance, _ = _distance(planes[camera, side], point[0], point[1], point[2])
                        is_within = is_within and distance >= 0.0
                    n_cameras += is_within
                n_seen += n_cameras >= needed
    return n_seen / _PARTS**2
