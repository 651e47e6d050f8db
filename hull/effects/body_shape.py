"""What a body's mesh says of its mass and of the shape that others collide with.

Mass lies in the volume of a closed mesh, exactly, and evenly on the area of an open one. Convex
parts of a mesh collide as they are. The hollows of others stay hollow: each of their triangles
collides as a prism, which reaches inwards from a closed surface and to both sides of an open one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

#: A part is convex if its vertices lie no farther inside their convex hull, as a share of its size.
_CONVEX = 1e-4

#: And if it encloses what the hull does, to this share.
_SAME_VOLUME = 1e-3

#: Thickness of the prisms that stand for triangles: a share of the part's size, within bounds.
_PRISM_SHARE, _PRISM_LEAST_M, _PRISM_MOST_M = 0.02, 5e-4, 5e-3

#: Triangles with a smaller height stand for nothing, and are no prisms.
_LEAST_HEIGHT_M = 1e-6


def cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cross products of vectors (..., 3): NumPy's takes ten times as long for few."""
    product = np.zeros(np.broadcast_shapes(a.shape, b.shape))
    product[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    product[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    product[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product


@dataclass(frozen=True, slots=True, eq=False)
class MassShare:
    """How mass is spread over a mesh, for a mass of 1 kg.

    Attributes
    ----------
    volume_m3 : float
        What a closed mesh encloses, negative if it is inside out; NaN for an open one.
    area_m2 : float
        Of the surface.
    center : (3,) float64
        Centre of mass, metres, in the frame of the vertices.
    axes : (3, 3) float64
        Principal axes, the columns of a rotation.
    inertia_m2 : (3,) float64
        Moments of inertia about them, per kilogram.
    """

    volume_m3: float
    area_m2: float
    center: NDArray[np.float64]
    axes: NDArray[np.float64]
    inertia_m2: NDArray[np.float64]


def mass_share(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], *, is_closed: bool
) -> MassShare:
    """Return how mass is spread over a mesh: in its volume if it is closed, else on its area.

    Second moments of a simplex with corners p are its measure / (n (n + 1)) times the sum of
    p p^T and of s s^T, s the sum of the corners, n their number.

    Parameters
    ----------
    vertices : (V, 3) float64
        Metres.
    faces : (T, 3) int32
        Vertex numbers; of a closed mesh all outwards, or all inwards.
    is_closed : bool
        Whether it closes off a volume.

    Raises
    ------
    ValueError
        If there is no volume, or no area, for the mass to lie in.
    """
    # About a corner of its own: far from the origin the terms would cancel to noise.
    origin = vertices[faces[0, 0]]
    corners = vertices[faces] - origin  # (T, 3, 3)
    a, b, c = np.moveaxis(corners, 1, 0)
    across = cross(b - a, c - a)
    areas = np.linalg.norm(across, axis=1) / 2.0
    size_m = float(np.ptp(vertices[faces.ravel()], axis=0).max())
    measure = np.einsum("ij,ij->i", a, cross(b, c)) / 6.0 if is_closed else areas
    n_corners = 4.0 if is_closed else 3.0  # of a tetrahedron, the fourth lies at the origin
    total = float(measure.sum())
    if not abs(total) > 1e-12 * size_m ** (3 if is_closed else 2):
        raise ValueError("volume" if is_closed else "area")
    sums = corners.sum(axis=1)
    center = measure @ sums / (n_corners * total)
    moments = np.einsum("t,tki,tkj->ij", measure, corners, corners)
    moments += np.einsum("t,ti,tj->ij", measure, sums, sums)
    moments /= n_corners * (n_corners + 1.0) * total
    moments -= np.outer(center, center)
    spread, axes = np.linalg.eigh(moments)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    spread = np.maximum(spread, 0.0)
    inertia_m2 = spread.sum() - spread
    # A thing without thickness turns about its length all the same.
    inertia_m2 += 1e-9 * inertia_m2.max()
    volume_m3 = total if is_closed else np.nan
    return MassShare(volume_m3, float(areas.sum()), center + origin, axes, inertia_m2)


@dataclass(frozen=True, slots=True, eq=False)
class CollisionShape:
    """What collides in place of a mesh.

    Attributes
    ----------
    pieces : tuple of (P, 3) float64
        Corners of convex pieces, metres, in the frame of the mesh.
    n_convex, n_prisms : int
        How many of them are parts of the mesh, and how many stand for a triangle.
    outside_m : float
        How far they reach beyond the mesh at most.
    prism_m : float
        How thick the prisms are at most; 0 if there are none.
    """

    pieces: tuple[NDArray[np.float64], ...]
    n_convex: int
    n_prisms: int
    outside_m: float
    prism_m: float


def collision_shape(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], *, is_closed: bool
) -> CollisionShape:
    """Return the convex pieces that collide in place of a mesh; see `mass_share` for parameters."""
    pieces: list[NDArray[np.float64]] = []
    n_convex, outside_m, prism_m = 0, 0.0, 0.0
    for part in _connected_parts(vertices, faces):
        corners, numbers = np.unique(faces[part], return_inverse=True)
        points = vertices[corners]
        off_m = _off_convex(points, numbers.reshape(-1, 3)) if is_closed else np.inf
        if off_m <= _CONVEX * np.linalg.norm(np.ptp(points, axis=0)):
            pieces.append(points)
            n_convex += 1
            outside_m = max(outside_m, off_m)
            continue
        size_m = float(np.linalg.norm(np.ptp(points, axis=0)))
        thick_m = float(np.clip(_PRISM_SHARE * size_m, _PRISM_LEAST_M, _PRISM_MOST_M))
        pieces.extend(_prisms(vertices[faces[part]], thick_m, is_closed=is_closed))
        prism_m = max(prism_m, thick_m)
        outside_m = max(outside_m, 0.0 if is_closed else thick_m / 2.0)
    return CollisionShape(tuple(pieces), n_convex, len(pieces) - n_convex, outside_m, prism_m)


def _connected_parts(
    vertices: NDArray[np.float64], faces: NDArray[np.int32]
) -> list[NDArray[np.int64]]:
    """Return the triangles of each connected part; corners at one place are one."""
    _, place = np.unique(vertices, axis=0, return_inverse=True)
    corners = place.ravel()[faces]
    tails, heads = corners[:, :2].ravel(), corners[:, 1:].ravel()
    n_places = int(corners.max()) + 1
    graph = coo_array((np.ones(len(tails)), (tails, heads)), shape=(n_places, n_places))
    n_parts, label = connected_components(graph, directed=False)
    of_face = label[corners[:, 0]]
    parts = [np.flatnonzero(of_face == number) for number in range(n_parts)]
    return [part for part in parts if len(part)]


def _off_convex(points: NDArray[np.float64], faces: NDArray[np.int64]) -> float:
    """Return how far a closed surface lies inside of its convex hull at most.

    At its vertices, the middles of its edges and of its triangles; infinite if it encloses less
    than the hull does, as what is hollowed out between all of these, or if the hull is flat.
    """
    try:
        hull = ConvexHull(points)
    except QhullError:
        return np.inf
    corners = points[faces]
    a, b, c = np.moveaxis(corners - points[0], 1, 0)
    volume = abs(float(np.einsum("ij,ij->", a, cross(b, c)))) / 6.0
    if abs(volume - hull.volume) > _SAME_VOLUME * hull.volume:
        return np.inf
    middles = [(corners + np.roll(corners, 1, axis=1)).reshape(-1, 3) / 2.0, corners.mean(axis=1)]
    on_surface = np.concatenate([points, *middles])
    planes = np.unique(hull.equations.round(12), axis=0)
    inside = np.full(len(on_surface), -np.inf)
    for plane in planes:
        np.maximum(inside, on_surface @ plane[:3] + plane[3], out=inside)
    return float(-inside.min())


def _prisms(
    corners: NDArray[np.float64], thick_m: float, *, is_closed: bool
) -> list[NDArray[np.float64]]:
    """Return for each triangle (T, 3, 3) that has an area the corners (6, 3) of a prism."""
    along = np.roll(corners, -1, axis=1) - corners
    across = cross(along[:, 0], along[:, 1])
    double = np.linalg.norm(across, axis=1)
    has_area = double > _LEAST_HEIGHT_M * np.linalg.norm(along, axis=2).max(axis=1)
    corners, normals = corners[has_area], across[has_area] / double[has_area, None]
    if is_closed:
        a, b, c = np.moveaxis(corners - corners[0, 0], 1, 0)
        inwards = -np.sign(np.einsum("ij,ij->", a, cross(b, c)))
        begin, end = np.zeros_like(normals), inwards * thick_m * normals
    else:
        begin, end = -thick_m / 2.0 * normals, thick_m / 2.0 * normals
    return list(np.concatenate([corners + begin[:, None], corners + end[:, None]], axis=1))
