"""Balls seen by cameras, as cones in closed form, and simple things beside them."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from helpers.hulls import ball_masks, look_at, projection
from hybridve.hull.query.silhouettes import Hull, Views, make_hull, make_views

#: Of `box_vertices`.
BOX_FACES = np.array(
    [
        [0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4],
        [2, 6, 7], [2, 7, 3], [0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5],
    ],
    np.int32,
)  # fmt: skip


def box_vertices(center_world: NDArray[np.float64], half_m: float) -> NDArray[np.float64]:
    """Return the corners (8, 3) of a cube along the axes."""
    signs = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)]) * 2.0 - 1.0
    return np.asarray(center_world + half_m * signs)


def plate(
    center_world: NDArray[np.float64], normal: NDArray[np.float64], half_m: float = 2.0
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return vertices and faces of a square across a unit normal."""
    a, b = half_m * np.linalg.svd(normal[None])[2][1:]
    corners = center_world + np.array([a + b, a - b, -a - b, b - a])
    return corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def views_from(
    centers_world: list[NDArray[np.float64]],
    width: int = 640,
    height: int = 480,
    focal_px: float | None = None,
) -> Views:
    """Return cameras that face the origin; by default some 6 mm a pixel there."""
    matrices = [
        projection(
            look_at(center, np.zeros(3)),
            focal_px or 0.25 * width * float(np.linalg.norm(center)),
            width,
            height,
        )
        for center in centers_world
    ]
    names = tuple(f"cam{k}" for k in range(len(centers_world)))
    return make_views(names, np.array([[width, height]] * len(names)), np.array(matrices))


def hull_of_balls(views: Views, balls: list[tuple[NDArray[np.float64], float]]) -> Hull:
    """Return the hull of balls (centre, radius), seen at once."""
    masks = [ball_masks(views, center, radius_m) for center, radius_m in balls]
    return make_hull(
        views, [np.maximum.reduce(of_camera) for of_camera in zip(*masks, strict=True)]
    )


def ball_extent(
    views: Views,
    center_world: NDArray[np.float64],
    radius_m: float,
    normal: NDArray[np.float64],
    opening_rad: NDArray[np.float64],
) -> float:
    """Return how far the hull of a ball reaches along a normal from the ball's centre, metres.

    The hull is the intersection of the tangent cones, each opened by an angle (C,): a convex set.
    """
    matrices = views.img_from_local
    cameras = views.origin_world - np.linalg.solve(matrices[:, :, :3], matrices[:, :, 3:])[..., 0]
    to_ball = center_world - cameras
    distances_m = np.linalg.norm(to_ball, axis=1)
    axes = to_ball / distances_m[:, None]
    angles = np.arcsin(radius_m / distances_m) + opening_rad

    def inside(radii: NDArray[np.float64]) -> NDArray[np.float64]:
        to_point = to_ball + radius_m * radii
        along = (to_point * axes).sum(axis=1)
        across = np.linalg.norm(to_point - along[:, None] * axes, axis=1)
        return np.asarray((np.tan(angles) * along - across) / radius_m)

    best = minimize(
        lambda radii: -float(normal @ radii),
        0.5 * normal,
        jac=lambda radii: -normal,
        constraints={"type": "ineq", "fun": inside},
        method="SLSQP",
        options={"ftol": 1e-10, "maxiter": 500},
    )
    assert best.success, best.message
    return float(-best.fun) * radius_m
