"""How near convex shapes come to a surface of triangles, to a tolerance that is proved.

For a convex shape the signed distance d is a convex function, so that about any point c with slope
g it lies above its tangent, d(x) >= d(c) + g.(x - c), and the tangent's smallest value over a
triangle stands at one of the vertices. That is a lower bound for the whole triangle, good to second
order in its size; triangles that cannot hold the minimum are dropped, the others halved.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import Pose, invert, transform
from hybridve.hull.synth.shapes import Shape

#: The distance returned is above the true minimum by at most this.
TOLERANCE_M = 1e-6

#: Two or three cuts halve the longest edge: metres become nanometres, so the search always ends.
_MAX_DEPTH = 96


@dataclass(frozen=True, slots=True, eq=False)
class Closest:
    """Where a surface is nearest to, or deepest in, a set of shapes.

    Attributes
    ----------
    distance_m : float
        The smallest signed distance of a point of the surface from the nearest shape: the
        clearance where it is positive; minus the penetration, the depth of the deepest point of
        the surface in any one shape, where it is negative.
    shape : int
        Which shape.
    point_world : (3,) float64
        The point of the surface.
    """

    distance_m: float
    shape: int
    point_world: NDArray[np.float64]


def closest_on_surface(
    triangles_world: NDArray[np.float64],
    shapes: Sequence[Shape],
    world_from_shape: Sequence[Pose],
    tolerance_m: float = TOLERANCE_M,
) -> Closest:
    """Return where a surface comes nearest to, or lies deepest in, any of the shapes.

    Parameters
    ----------
    triangles_world : (T, 3, 3) float64
        Corners in metres.
    shapes : sequence of Shape
        At least one.
    world_from_shape : sequence of (3, 4) float64
        Where each stands.
    tolerance_m : float
        How far the result may lie above the true minimum.
    """
    all_corners = triangles_world.reshape(-1, 3)
    waiting = {
        index: transform(invert(world_from_shape[index]), all_corners).reshape(-1, 3, 3)
        for index in np.flatnonzero(_near_enough(all_corners, shapes, world_from_shape)).tolist()
    }
    best = Closest(np.inf, 0, np.zeros(3))
    for _ in range(_MAX_DEPTH):
        bounds = {}
        for index, corners in waiting.items():
            shape = shapes[index]
            centers = corners.mean(axis=1)
            at_center, slope = shape.signed_distance(centers)
            rises = np.einsum("nij,nj->ni", corners - centers[:, None], slope)  # (N, 3)
            lowest = rises.argmin(axis=1)
            rows = np.arange(len(corners))
            bounds[index] = at_center + rises[rows, lowest]
            tried = np.concatenate([centers, corners[rows, lowest]])
            distance = np.concatenate([at_center, shape.signed_distance(tried[len(rows) :])[0]])
            if distance.min() < best.distance_m:
                winner = int(distance.argmin())
                point = transform(world_from_shape[index], tried[winner : winner + 1])[0]
                best = Closest(float(distance[winner]), index, point)
        open_ = {index: bound < best.distance_m - tolerance_m for index, bound in bounds.items()}
        waiting = {
            index: _halve(corners[open_[index]])
            for index, corners in waiting.items()
            if open_[index].any()
        }
        if not waiting:
            break
    return best


def _near_enough(
    corners_world: NDArray[np.float64], shapes: Sequence[Shape], world_from_shape: Sequence[Pose]
) -> NDArray[np.bool_]:
    """Return which shapes (S,) can be the nearest, by their distance to the surface's box."""
    middles = np.array([pose[:, 3] for pose in world_from_shape])
    low, high = corners_world.min(axis=0), corners_world.max(axis=0)
    to_box = np.linalg.norm(np.maximum(np.maximum(low - middles, middles - high), 0.0), axis=1)
    # The middle of a shape lies in it, so no shape is farther than its middle from a corner.
    at_most = np.linalg.norm(corners_world[None, ::3] - middles[:, None], axis=2).min()
    reach = np.array([shape.reach_m for shape in shapes])
    return np.asarray(to_box - reach <= at_most)


def _halve(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return two triangles for each of (N, 3, 3), cut across the longest edge.

    So even a sliver falls into short pieces, and a triangle without area does not multiply.
    """
    edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    order = (edges.argmax(axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(corners, order[:, :, None], axis=1), 1, 0)
    middle = (a + b) / 2
    halves = [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
    return np.concatenate(halves)
