"""Convex hulls of known shape: silhouettes that are rectangles, and distances between polytopes.

With rectangles of pixels as silhouettes the visual hull is the intersection of half-spaces through
the cameras and the edges of pixels: a polytope whose distance from another has an exact answer.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog, nnls
from scipy.spatial import HalfspaceIntersection

from hybridve.hull.query.silhouettes import Hull, Views, make_hull


@dataclass(frozen=True, slots=True, eq=False)
class Polytope:
    """The points x with ``normals @ x <= offsets``, and its corners; world frame, metres."""

    normals: NDArray[np.float64]
    offsets: NDArray[np.float64]
    corners: NDArray[np.float64]


def rectangle_hull(
    rng: np.random.Generator, views: Views, about_world: NDArray[np.float64]
) -> tuple[Hull, Polytope] | None:
    """Return the hull of random rectangles that hold the projection of a point, and its shape.

    None where a camera does not see the point, or the hull is not bounded or all but flat.
    """
    masks, normals, offsets = [], [], []
    for camera, (width, height) in enumerate(views.sizes_px.tolist()):
        matrix = views.img_from_local[camera].copy()
        matrix[:, 3] -= matrix[:, :3] @ views.origin_world
        projected = matrix[:, :3] @ about_world + matrix[:, 3]
        column, row = np.floor(projected[:2] / projected[2]).astype(int)
        if projected[2] <= 0 or not (0 <= column < width and 0 <= row < height):
            return None
        left, right = rng.integers(0, column + 1), rng.integers(column, width) + 1
        top, bottom = rng.integers(0, row + 1), rng.integers(row, height) + 1
        mask = np.zeros((height, width), np.uint8)
        mask[top:bottom, left:right] = 1
        masks.append(mask)
        for plane in (
            left * matrix[2] - matrix[0],
            matrix[0] - right * matrix[2],
            top * matrix[2] - matrix[1],
            matrix[1] - bottom * matrix[2],
        ):
            length = np.linalg.norm(plane[:3])
            normals.append(plane[:3] / length)
            offsets.append(-plane[3] / length)
    shape = _polytope(np.array(normals), np.array(offsets))
    return None if shape is None else (make_hull(views, masks), shape)


def _polytope(normals: NDArray[np.float64], offsets: NDArray[np.float64]) -> Polytope | None:
    # The centre of the largest ball inside, by linear programming.
    found = linprog(
        [0, 0, 0, -1],
        A_ub=np.column_stack([normals, np.ones(len(normals))]),
        b_ub=offsets,
        bounds=[(-20, 20)] * 3 + [(0, None)],
    )
    if found.status != 0 or found.x[3] < 1e-3:
        return None
    corners = HalfspaceIntersection(np.column_stack([normals, -offsets]), found.x[:3]).intersections
    if not np.isfinite(corners).all() or np.abs(corners).max() > 12.0:
        return None
    return Polytope(normals, offsets, corners)


def distance_between(
    first: NDArray[np.float64], second: NDArray[np.float64]
) -> tuple[float, float]:
    """Return bounds of the distance between the convex hulls of two sets of corners, (N, 3) each.

    The nearest pair of points by non-negative least squares gives the upper bound; the plane
    across it that separates the two gives the lower one, whatever the solver did.
    """
    weight = 1e3
    system = np.zeros((5, len(first) + len(second)))
    system[:3, : len(first)] = first.T
    system[:3, len(first) :] = -second.T
    system[3, : len(first)] = weight
    system[4, len(first) :] = weight
    share, _ = nnls(system, np.array([0, 0, 0, weight, weight]), maxiter=10_000)
    a, b = share[: len(first)], share[len(first) :]
    between = (a / a.sum()) @ first - (b / b.sum()) @ second
    upper = float(np.linalg.norm(between))
    if upper < 1e-9:
        return 0.0, upper
    across = between / upper
    return max(0.0, float((first @ across).min() - (second @ across).max())), upper


def depth_in_box(
    shape: Polytope,
    rotation: NDArray[np.float64],
    center: NDArray[np.float64],
    half: NDArray[np.float64],
) -> float:
    """Return how deep the deepest point of a polytope lies in a turned box; 0 where none is in it.

    The depth in a box is the distance to its nearest face: a linear programme.
    """
    faces = np.concatenate([rotation.T, -rotation.T])
    limits = np.concatenate([half, half]) + faces @ center
    found = linprog(
        [0, 0, 0, -1],
        A_ub=np.block(
            [
                [shape.normals, np.zeros((len(shape.normals), 1))],
                [faces, np.ones((6, 1))],
            ]
        ),
        b_ub=np.concatenate([shape.offsets, limits]),
        bounds=[(None, None)] * 3 + [(0, None)],
    )
    return float(found.x[3]) if found.status == 0 else 0.0
