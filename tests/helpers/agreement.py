"""Silhouettes that agree, and what makes them disagree."""

import numpy as np
from numpy.typing import NDArray

from helpers.hulls import ball_masks, look_at, projection
from hybridve.hull.query.silhouettes import Unseen, Views, make_views

Masks = list[NDArray[np.uint8]]


def random_views(
    rng: np.random.Generator,
    n_cameras: int,
    unseen: Unseen = "carve",
    min_cameras: int = 1,
    spread_m: float = 0.0,
) -> Views:
    """Return small cameras anywhere around the origin, each turned about its axis at will.

    They look at points within `spread_m` of the origin.
    """
    matrices, sizes = [], []
    for _ in range(n_cameras):
        direction = rng.normal(size=3)
        center = rng.uniform(1.5, 4.0) * direction / np.linalg.norm(direction)
        target = rng.uniform(-spread_m, spread_m, 3)
        width, height = rng.integers(60, 200, 2).tolist()
        focal_px = rng.uniform(0.7, 1.6) * max(width, height)
        roll_rad = rng.uniform(-np.pi, np.pi)
        matrices.append(projection(look_at(center, target, roll_rad), focal_px, width, height))
        sizes.append((width, height))
    names = tuple(f"cam{camera}" for camera in range(n_cameras))
    return make_views(names, np.array(sizes), np.array(matrices), unseen, min_cameras)


def balls(views: Views, *things: tuple[NDArray[np.float64], float]) -> Masks:
    """Return the silhouettes of balls (centre, radius), seen at once."""
    seen = [ball_masks(views, center, radius_m) for center, radius_m in things]
    return [np.maximum.reduce(of_camera) for of_camera in zip(*seen, strict=True)]


def shifted(mask: NDArray[np.uint8], right_px: int, down_px: int) -> NDArray[np.uint8]:
    """Return a silhouette moved by whole pixels; what enters is background."""
    height, width = mask.shape
    result = np.zeros_like(mask)
    x0, x1 = max(right_px, 0), min(width + right_px, width)
    y0, y1 = max(down_px, 0), min(height + down_px, height)
    if x1 > x0 and y1 > y0:
        result[y0:y1, x0:x1] = mask[y0 - down_px : y1 - down_px, x0 - right_px : x1 - right_px]
    return result
