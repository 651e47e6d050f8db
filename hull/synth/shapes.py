"""Convex shapes in closed form: how far away a point is, and where a ray meets them.

Each shape lies in a frame of its own, centred on the origin, in metres. The signed distance of a
convex shape is a convex function of the point, negative inside, and changes by at most one metre a
metre; `closest.py` rests on both. A size may be zero, and a coordinate or a direction as small as a
float can be.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]

#: Points on the unit sphere whose hull stands for a ball's outline; it falls short by 0.5 %.
_SPHERE_POINTS = 400

#: Points on each rim of a cylinder; the polygon falls short by 0.05 % of the radius.
_RIM_POINTS = 100

#: Below this length the squares of a vector's coordinates lose digits, or vanish.
_SQUARES_LOSE_DIGITS = 1e-140

#: Directions shorter than this are brought to length 1 before they are compared with 1e-12.
_SHORT = 0.1

#: A ray that leaves an axis by less than the root of this in a length runs along it: it would take
#: 1e140 lengths to leave any shape, and the square of less has lost its digits.
_ALONG_AXIS2 = 1e-280


@dataclass(frozen=True, slots=True)
class Ball:
    """A ball.

    Attributes
    ----------
    radius_m : float
        Its radius.
    """

    radius_m: float

    @property
    def sizes_m(self) -> tuple[float, ...]:
        """The numbers that make the shape, in the order of its attributes."""
        return (self.radius_m,)

    @property
    def reach_m(self) -> float:
        """Distance of its farthest point from the origin."""
        return self.radius_m

    def signed_distance(self, points: Points) -> tuple[NDArray[np.float64], Points]:
        """Return the distances (N,) of points (N, 3) and the directions (N, 3) they grow in."""
        return _distance_from(points, self.radius_m)

    def hit(self, origin: Points, directions: Points) -> NDArray[np.float64]:
        """Return where rays enter, (N,) in lengths of `directions`; inf where they miss."""
        return _first_entry(self._enter, origin, directions)

    def _enter(self, origin: Points, directions: Points) -> NDArray[np.float64]:
        return _enter_ball(origin, directions, self.radius_m)

    def outline(self) -> Points:
        """Return points (M, 3) whose convex hull is nearly the shape."""
        return self.radius_m * sphere_points()


@dataclass(frozen=True, slots=True)
class Capsule:
    """All points within a radius of a segment on the z axis.

    Attributes
    ----------
    half_length_m : float
        The segment runs from minus to plus this.
    radius_m : float
        The radius.
    """

    half_length_m: float
    radius_m: float

    @property
    def sizes_m(self) -> tuple[float, ...]:
        """The numbers that make the shape, in the order of its attributes."""
        return (self.half_length_m, self.radius_m)

    @property
    def reach_m(self) -> float:
        """Distance of its farthest point from the origin."""
        return self.half_length_m + self.radius_m

    def signed_distance(self, points: Points) -> tuple[NDArray[np.float64], Points]:
        """Return the distances (N,) of points (N, 3) and the directions (N, 3) they grow in."""
        from_segment = points.copy()
        from_segment[:, 2] -= np.clip(points[:, 2], -self.half_length_m, self.half_length_m)
        return _distance_from(from_segment, self.radius_m)

    def hit(self, origin: Points, directions: Points) -> NDArray[np.float64]:
        """Return where rays enter, (N,) in lengths of `directions`; inf where they miss."""
        return _first_entry(self._enter, origin, directions)

    def _enter(self, origin: Points, directions: Points) -> NDArray[np.float64]:
        # The shape is a cylinder and two balls: the first of the three entries is the entry.
        a = (directions[:, :2] ** 2).sum(axis=1)
        b = directions[:, :2] @ origin[:2]
        c = origin[:2] @ origin[:2] - self.radius_m**2
        root = b * b - a * c
        meets = (root >= 0) & (a > _ALONG_AXIS2)
        along = np.full(len(directions), np.inf)
        along[meets] = (-b[meets] - np.sqrt(root[meets])) / a[meets]
        height = np.full(len(directions), np.inf)
        height[meets] = origin[2] + along[meets] * directions[meets, 2]
        along[(np.abs(height) > self.half_length_m) | (along <= 0)] = np.inf
        for end in (-self.half_length_m, self.half_length_m):
            cap = _enter_ball(origin - np.array([0.0, 0.0, end]), directions, self.radius_m)
            along = np.minimum(along, cap)
        return along

    def outline(self) -> Points:
        """Return points (M, 3) whose convex hull is nearly the shape."""
        ends = self.half_length_m * np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
        return np.concatenate([end + self.radius_m * sphere_points() for end in ends])


@dataclass(frozen=True, slots=True)
class Box:
    """A box with its faces across the axes.

    Attributes
    ----------
    half_x_m, half_y_m, half_z_m : float
        Half of its extent along each axis.
    """

    half_x_m: float
    half_y_m: float
    half_z_m: float

    @property
    def sizes_m(self) -> tuple[float, ...]:
        """The numbers that make the shape, in the order of its attributes."""
        return (self.half_x_m, self.half_y_m, self.half_z_m)

    @property
    def reach_m(self) -> float:
        """Distance of its farthest point from the origin."""
        return float(np.linalg.norm(self.sizes_m))

    def signed_distance(self, points: Points) -> tuple[NDArray[np.float64], Points]:
        """Return the distances (N,) of points (N, 3) and the directions (N, 3) they grow in.

        Inside, the distance is that to the nearest face.
        """
        signs = np.where(points < 0, -1.0, 1.0)
        beyond = np.abs(points) - np.array(self.sizes_m)  # (N, 3) past each pair of faces
        outside = np.maximum(beyond, 0.0)
        distance, away = lengths_and_units(outside)
        face = beyond.argmax(axis=1)
        slope = np.zeros_like(points)
        rows = np.arange(len(points))
        slope[rows, face] = signs[rows, face]
        is_outside = distance > 0
        slope[is_outside] = signs[is_outside] * away[is_outside]
        return np.where(is_outside, distance, beyond[rows, face]), slope

    def hit(self, origin: Points, directions: Points) -> NDArray[np.float64]:
        """Return where rays enter, (N,) in lengths of `directions`; inf where they miss."""
        return _first_entry(self._enter, origin, directions)

    def _enter(self, origin: Points, directions: Points) -> NDArray[np.float64]:
        # A direction across a pair of faces never meets them; a tiny slope says so without a case.
        steep = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        half = np.array(self.sizes_m)
        first, second = (-half - origin) / steep, (half - origin) / steep
        enters = np.minimum(first, second).max(axis=1)
        leaves = np.maximum(first, second).min(axis=1)
        return np.where((enters <= leaves) & (enters > 0), enters, np.inf)

    def outline(self) -> Points:
        """Return points (M, 3) whose convex hull is the shape."""
        corners = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), axis=-1)
        return np.asarray(corners.reshape(-1, 3) * np.array(self.sizes_m))


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A cylinder about the z axis with flat ends.

    Attributes
    ----------
    half_length_m : float
        It runs from minus to plus this along z.
    radius_m : float
        The radius.
    """

    half_length_m: float
    radius_m: float

    @property
    def sizes_m(self) -> tuple[float, ...]:
        """The numbers that make the shape, in the order of its attributes."""
        return (self.half_length_m, self.radius_m)

    @property
    def reach_m(self) -> float:
        """Distance of its farthest point from the origin."""
        return float(np.hypot(self.half_length_m, self.radius_m))

    def signed_distance(self, points: Points) -> tuple[NDArray[np.float64], Points]:
        """Return the distances (N,) of points (N, 3) and the directions (N, 3) they grow in.

        Inside, the distance is that to the nearer of the mantle and the ends.
        """
        across, outwards = lengths_and_units(points[:, :2])  # on the axis none: a subgradient
        past_mantle = across - self.radius_m
        past_end = np.abs(points[:, 2]) - self.half_length_m
        mantle, end = np.maximum(past_mantle, 0.0), np.maximum(past_end, 0.0)
        outside, away = lengths_and_units(np.column_stack([mantle, end]))
        is_outside = outside > 0
        to_mantle = past_mantle > past_end
        slope = np.zeros_like(points)
        slope[:, :2] = np.where(is_outside, away[:, 0], to_mantle)[:, None] * outwards
        slope[:, 2] = np.where(is_outside, away[:, 1], ~to_mantle) * np.where(
            points[:, 2] < 0, -1.0, 1.0
        )
        return np.where(is_outside, outside, np.maximum(past_mantle, past_end)), slope

    def hit(self, origin: Points, directions: Points) -> NDArray[np.float64]:
        """Return where rays enter, (N,) in lengths of `directions`; inf where they miss."""
        return _first_entry(self._enter, origin, directions)

    def _enter(self, origin: Points, directions: Points) -> NDArray[np.float64]:
        # A ray is in the shape while it is both within the endless mantle and between the ends.
        a = (directions[:, :2] ** 2).sum(axis=1)
        b = directions[:, :2] @ origin[:2]
        c = origin[:2] @ origin[:2] - self.radius_m**2
        enters = np.full(len(directions), -np.inf if c <= 0 else np.inf)  # along the axis
        leaves = np.full(len(directions), np.inf)
        slanted = a > _ALONG_AXIS2
        root = b * b - a * c
        meets = slanted & (root >= 0)
        half = np.sqrt(root[meets])
        enters[slanted] = np.inf
        enters[meets], leaves[meets] = (-b[meets] - half) / a[meets], (-b[meets] + half) / a[meets]
        # A direction across the axis never meets an end; a tiny slope says so without a case.
        steep = np.where(np.abs(directions[:, 2]) < 1e-12, 1e-12, directions[:, 2])
        first = (-self.half_length_m - origin[2]) / steep
        second = (self.half_length_m - origin[2]) / steep
        enters = np.maximum(enters, np.minimum(first, second))
        leaves = np.minimum(leaves, np.maximum(first, second))
        return np.where((enters <= leaves) & (enters > 0), enters, np.inf)

    def outline(self) -> Points:
        """Return points (M, 3) whose convex hull is nearly the shape."""
        turn = 2.0 * np.pi * np.arange(_RIM_POINTS) / _RIM_POINTS
        rim = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(_RIM_POINTS)])
        ends = self.half_length_m * np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
        return np.concatenate([end + self.radius_m * rim for end in ends])


Shape = Ball | Capsule | Cylinder | Box

#: The shapes by the name under which truth.h5 keeps them.
SHAPES: dict[str, type[Ball] | type[Capsule] | type[Cylinder] | type[Box]] = {
    "ball": Ball,
    "capsule": Capsule,
    "cylinder": Cylinder,
    "box": Box,
}


def sphere_points(count: int = _SPHERE_POINTS) -> Points:
    """Return points (count, 3) spread evenly over the unit sphere."""
    index = np.arange(count) + 0.5
    height = 1.0 - 2.0 * index / count
    turn = np.pi * (1.0 + np.sqrt(5.0)) * index
    across = np.sqrt(1.0 - height**2)
    return np.column_stack([across * np.cos(turn), across * np.sin(turn), height])


def _distance_from(offsets: Points, radius_m: float) -> tuple[NDArray[np.float64], Points]:
    """Return the distances to a ball about the origin of `offsets`, and their slopes."""
    length, slope = lengths_and_units(offsets)  # at the centre none: zero is a subgradient there
    return length - radius_m, slope


def lengths_and_units(vectors: Points) -> tuple[NDArray[np.float64], Points]:
    """Return the lengths (N,) of vectors (N, K) and the unit vectors (N, K) along them.

    Both are right to rounding however short a vector is; that along no vector at all is zero.
    """
    lengths = np.linalg.norm(vectors, axis=1)
    units = np.zeros_like(vectors)
    plain = lengths > _SQUARES_LOSE_DIGITS
    units[plain] = vectors[plain] / lengths[plain, None]
    if not plain.all():
        tiny = np.flatnonzero(~plain & vectors.any(axis=1))
        longest = np.abs(vectors[tiny]).max(axis=1)
        scaled = vectors[tiny] / longest[:, None]
        of_scaled = np.linalg.norm(scaled, axis=1)
        lengths[tiny] = of_scaled * longest
        units[tiny] = scaled / of_scaled[:, None]
    return lengths, units


def _first_entry(
    enter: Callable[[Points, Points], NDArray[np.float64]], origin: Points, directions: Points
) -> NDArray[np.float64]:
    """Return where rays enter, found by a function that takes no short directions.

    A ray without a direction enters nothing.
    """
    short = np.flatnonzero((directions**2).sum(axis=1) < _SHORT**2)
    if not len(short):
        return enter(origin, directions)
    lengths, units = lengths_and_units(directions[short])
    units[lengths == 0] = [0.0, 0.0, 1.0]
    longer = directions.copy()
    longer[short] = units
    along = enter(origin, longer)
    with np.errstate(over="ignore", divide="ignore"):
        in_lengths = along[short] / lengths
    # Farther than a float can say is still not a miss.
    met = np.isfinite(along[short]) & (lengths > 0)
    along[short] = np.where(met, np.minimum(in_lengths, np.finfo(np.float64).max), np.inf)
    return along


def _enter_ball(origin: Points, directions: Points, radius_m: float) -> NDArray[np.float64]:
    a = (directions**2).sum(axis=1)
    b = directions @ origin
    c = origin @ origin - radius_m**2
    root = b * b - a * c
    along = np.full(len(directions), np.inf)
    meets = root >= 0
    along[meets] = (-b[meets] - np.sqrt(root[meets])) / a[meets]
    along[along <= 0] = np.inf
    return along
