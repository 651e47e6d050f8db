"""Distances, sides and winding numbers in rational numbers: nothing is rounded."""

from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

Vector = tuple[Fraction, Fraction, Fraction]


def vector(point: NDArray[np.float64]) -> Vector:
    """Return the coordinates (3,) as they are."""
    x, y, z = (Fraction(value) for value in point.tolist())
    return x, y, z


def minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def dot(a: Vector, b: Vector) -> Fraction:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def sign(value: Fraction) -> int:
    return (value > 0) - (value < 0)


def _squared_to_segment(p: Vector, a: Vector, b: Vector) -> Fraction:
    way, to_p = minus(b, a), minus(p, a)
    squared = dot(way, way)
    along = Fraction(0)
    if squared > 0:
        along = min(max(dot(to_p, way) / squared, Fraction(0)), Fraction(1))
    rest = minus(to_p, (along * way[0], along * way[1], along * way[2]))
    return dot(rest, rest)


def squared_to_triangle(point: NDArray[np.float64], corners: NDArray[np.float64]) -> Fraction:
    """Return the squared distance of a point (3,) from a triangle (3, 3), even without area."""
    p = vector(point)
    a, b, c = (vector(corner) for corner in corners)
    normal = cross(minus(b, a), minus(c, a))
    area = dot(normal, normal)
    edges = ((a, b), (b, c), (c, a))
    if area > 0 and all(
        dot(cross(minus(stop, start), minus(p, start)), normal) >= 0 for start, stop in edges
    ):
        return dot(minus(p, a), normal) ** 2 / area
    return min(_squared_to_segment(p, start, stop) for start, stop in edges)


def is_within(distance_m: float, squared: Fraction, error_m: float) -> bool:
    """Tell whether a distance is the root of `squared` to `error_m`."""
    low = max(Fraction(distance_m) - Fraction(error_m), Fraction(0))
    high = Fraction(distance_m) + Fraction(error_m)
    return low**2 <= squared <= high**2


def side_of_plane(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], p: NDArray[np.float64]
) -> int:
    """Return the sign of (a - p) . ((b - p) x (c - p))."""
    origin = vector(p)
    to_a, to_b, to_c = (minus(vector(corner), origin) for corner in (a, b, c))
    return sign(dot(to_a, cross(to_b, to_c)))


def side_of_line(a: NDArray[np.float64], b: NDArray[np.float64], p: NDArray[np.float64]) -> int:
    """Return 1 where points (2,) of a plane a, b, p turn left, -1 where right, 0 on a line."""
    (a_x, a_y), (b_x, b_y), (x, y) = ([Fraction(v) for v in q.tolist()] for q in (a, b, p))
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
        self._triangles = [tuple(vector(corner) for corner in triangle) for triangle in corners]
        self._rng = rng

    def winding(self, point: NDArray[np.float64]) -> int:
        """Return how often the surface goes round a point (3,) that is not on it."""
        p = vector(point)
        while True:
            found = self._along(p, vector(self._rng.normal(size=3)))
            if found is not None:
                return found

    def _along(self, p: Vector, ray: Vector) -> int | None:
        winding = 0
        for triangle in self._triangles:
            a, b, c = (minus(corner, p) for corner in triangle)
            # The ray meets the triangle where it passes all edges on the same side.
            turns = {sign(dot(ray, cross(*edge))) for edge in ((a, b), (b, c), (c, a))}
            if 1 in turns and -1 in turns:
                continue
            normal = cross(minus(b, a), minus(c, a))
            if normal == (0, 0, 0):
                continue
            if 0 in turns:
                return None
            leaves = sign(dot(ray, normal))
            if sign(dot(a, normal)) == leaves:  # the plane is met on the way, not before
                winding += leaves
        return winding
