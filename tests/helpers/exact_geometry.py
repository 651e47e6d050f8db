"""Distances, sides and winding numbers, exactly: nothing is rounded.

Every float64 is a whole number over a power of two; over one that they share, coordinates are whole
numbers, which Python multiplies far faster than fractions.
"""

from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

#: A place in whole numbers, over a denominator that is said beside it.
Vector = tuple[int, int, int]


def whole(points: NDArray[np.float64]) -> tuple[list[Vector], int]:
    """Return points (N, 3) in whole numbers, and the denominator that they share."""
    ratios = [[value.as_integer_ratio() for value in point] for point in points.tolist()]
    shared = max((over for point in ratios for _, over in point), default=1)
    scaled = [[number * (shared // over) for number, over in point] for point in ratios]
    return [(x, y, z) for x, y, z in scaled], shared


def minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def dot(a: Vector, b: Vector) -> int:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def times(a: Vector, factor: int) -> Vector:
    return a[0] * factor, a[1] * factor, a[2] * factor


def sign(value: int) -> int:
    return (value > 0) - (value < 0)


def _squared_to_segment(p: Vector, a: Vector, b: Vector) -> Fraction:
    way, to_p = minus(b, a), minus(p, a)
    squared, along = dot(way, way), dot(to_p, way)
    if along <= 0:  # so it is where both ends are one point
        return Fraction(dot(to_p, to_p))
    if along >= squared:
        beyond = minus(p, b)
        return Fraction(dot(beyond, beyond))
    return Fraction(dot(to_p, to_p) * squared - along**2, squared)


def squared_to_triangle(point: NDArray[np.float64], corners: NDArray[np.float64]) -> Fraction:
    """Return the squared distance of a point (3,) from a triangle (3, 3), even without area.

    The nearest point lies on an edge, or over the inside of a triangle that has area.
    """
    (p, a, b, c), over = whole(np.concatenate([point[None], corners]))
    normal = cross(minus(b, a), minus(c, a))
    area = dot(normal, normal)
    edges = ((a, b), (b, c), (c, a))
    if area > 0 and all(
        dot(cross(minus(stop, start), minus(p, start)), normal) >= 0 for start, stop in edges
    ):
        squared = Fraction(dot(minus(p, a), normal) ** 2, area)
    else:
        squared = min(_squared_to_segment(p, start, stop) for start, stop in edges)
    return squared / over**2


def is_within(distance_m: float, squared: Fraction, error_m: float) -> bool:
    """Tell whether a distance is the root of `squared` to `error_m`."""
    low = max(Fraction(distance_m) - Fraction(error_m), Fraction(0))
    high = Fraction(distance_m) + Fraction(error_m)
    return low**2 <= squared <= high**2


def side_of_plane(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], p: NDArray[np.float64]
) -> int:
    """Return the sign of (a - p) . ((b - p) x (c - p))."""
    (origin, *corners), _ = whole(np.stack([p, a, b, c]))
    to_a, to_b, to_c = (minus(corner, origin) for corner in corners)
    return sign(dot(to_a, cross(to_b, to_c)))


def side_of_line(a: NDArray[np.float64], b: NDArray[np.float64], p: NDArray[np.float64]) -> int:
    """Return 1 where points (2,) of a plane a, b, p turn left, -1 where right, 0 on a line."""
    in_plane = np.zeros((3, 3))
    in_plane[:, :2] = a, b, p
    ((a_x, a_y, _), (b_x, b_y, _), (x, y, _)), _ = whole(in_plane)
    return sign((a_x - x) * (b_y - y) - (a_y - y) * (b_x - x))


class ExactSolid:
    """A closed surface whose winding number is counted along a ray in a random direction.

    Parameters
    ----------
    corners : (T, 3, 3) float64
        Of its triangles.
    rng : numpy.random.Generator
        Of the direction: a direction for which a triangle is met at its rim is drawn anew.
    """

    def __init__(self, corners: NDArray[np.float64], rng: np.random.Generator) -> None:
        self._corners, self._over = whole(corners.reshape(-1, 3))
        self._rng = rng

    def winding(self, point: NDArray[np.float64]) -> int:
        """Return how often the surface goes round a point (3,) that is not on it."""
        (p,), over = whole(point[None])
        shared = max(over, self._over)
        p, more = times(p, shared // over), shared // self._over
        seen = [minus(times(corner, more), p) for corner in self._corners]
        while True:
            (ray,), _ = whole(self._rng.normal(size=(1, 3)))  # only its direction counts
            found = _winding_along(ray, seen)
            if found is not None:
                return found


def _winding_along(ray: Vector, corners: list[Vector]) -> int | None:
    """Return the winding number about the origin; None where the ray meets a triangle's rim."""
    winding = 0
    for a, b, c in zip(corners[::3], corners[1::3], corners[2::3], strict=True):
        # The ray meets the triangle where it passes all edges on the same side.
        turns = {sign(dot(ray, cross(*edge))) for edge in ((a, b), (b, c), (c, a))}
        if 1 in turns and -1 in turns:
            continue
        normal = cross(minus(b, a), minus(c, a))
        if not any(normal):
            continue
        if 0 in turns:
            return None
        leaves = sign(dot(ray, normal))
        if sign(dot(a, normal)) == leaves:  # the plane is met on the way, not before
            winding += leaves
    return winding
