"""The outlines that end a hull at a point: how far it moves with each, and how surely."""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from hybridve.hull.query.silhouettes import BACKGROUND, UNSEEN, Hull, Views
from hybridve.hull.query.walk import silhouette_normal

#: A camera ends the hull at a point if background lies this near to the point's projection. The
#: nearest point is a corner of the hull's pixel stairs, up to 1.4 pixels beside each outline.
_NEAR_PX = 1.5

#: Sets of cones end the hull where the combination of their normals is by no more than this farther
#: from the direction than the best (about 11 degrees). An outline that errs by e moves the nearest
#: point of a thing of radius r sideways, to where its normal is turned by sqrt(2 e / r) radians:
#: 0.2 for a millimetre and a forearm of 5 cm. Less would leave out cameras that end the hull just
#: as well; more would count some that do not, and ask for more room than need be.
_AS_GOOD = 0.2

#: Draws from which the 95 % of several sets of cones together are found, to about 2 %.
_DRAWS = 1 << 14


def outline_sensitivity(
    hull: Hull, point_world: NDArray[np.float64], direction: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """Return how far the hull's extreme point moves as outlines do, and how well that is explained.

    Parameters
    ----------
    hull : Hull
        The hull of one frame.
    point_world : (3,) float64
        The point of the hull that lies farthest along the direction, metres.
    direction : (3,) float64
        Unit vector in the world's frame.

    Returns
    -------
    m_per_px : (C,) float64
        By how many metres the hull reaches farther when a camera's outline moves outward by a
        pixel: ``lambda_k s_k`` of this file's head.
    residual : float
        How far the combination of normals is from the direction; 1 where no camera ends the hull.
    normals_px : (C, 2) float64
        The outlines' outward normals in the images, unit vectors; NaN where a camera does not end
        the hull there.
    """
    cones = _cones_at(hull, point_world)
    m_per_px = np.zeros(len(hull.views))
    if len(cones.cameras) == 0:
        return m_per_px, 1.0, cones.normals_px
    multipliers, residual = nnls(cones.normals_world.T, direction)
    m_per_px[cones.cameras] = multipliers * cones.m_per_px
    return m_per_px, float(residual), cones.normals_px


def outline_ways(
    hull: Hull, point_world: NDArray[np.float64], direction: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return in which ways the hull's extreme point is held: each set of cones that ends it there.

    Parameters are those of `outline_sensitivity`.

    Returns
    -------
    ways_m : (V, C) float64
        For each set the metres per pixel of its cameras, 0 for the others. With errors e (C,) of
        the outlines in pixels the hull reaches farther by the smallest of ``ways_m @ e``.
    normals_px : (C, 2) float64
        As of `outline_sensitivity`.
    """
    cones = _cones_at(hull, point_world)
    found, residuals = [], []
    for size in (1, 2, 3):  # three cones hold a point whatever the direction; more are no vertex
        for chosen in combinations(range(len(cones.cameras)), size):
            which = list(chosen)
            multipliers, residual = nnls(cones.normals_world[which].T, direction)
            if (multipliers > 0).all():
                way = np.zeros(len(hull.views))
                way[cones.cameras[which]] = multipliers * cones.m_per_px[which]
                found.append(way)
                residuals.append(float(residual))
    as_good = min([*residuals, np.inf]) + _AS_GOOD
    ways = [way for way, residual in zip(found, residuals, strict=True) if residual <= as_good]
    return np.array(ways).reshape(-1, len(hull.views)), cones.normals_px


@dataclass(frozen=True, slots=True, eq=False)
class _Cones:
    """The K cones, of C, that end the hull at a point, or nearly.

    Attributes
    ----------
    cameras : (K,) int64
        Whose they are.
    normals_world : (K, 3) float64
        Their outward normals.
    m_per_px : (K,) float64
        How far each moves along it as its outline moves by a pixel.
    normals_px : (C, 2) float64
        The outlines' outward normals in the images; NaN for all other cameras.
    """

    cameras: NDArray[np.int64]
    normals_world: NDArray[np.float64]
    m_per_px: NDArray[np.float64]
    normals_px: NDArray[np.float64]


def _cones_at(hull: Hull, point_world: NDArray[np.float64]) -> _Cones:
    views = hull.views
    normals_px = np.full((len(views), 2), np.nan)
    cameras, normals, moves_m = [], [], []
    for camera in range(len(views)):
        if is_near_background(hull, camera, point_world):
            normal = silhouette_normal(hull, camera, point_world)
            if np.isfinite(normal).all():
                metres, normals_px[camera] = metres_per_pixel(views, camera, point_world, normal)
                cameras.append(camera)
                normals.append(normal)
                moves_m.append(metres)
    return _Cones(
        np.array(cameras, np.int64),
        np.array(normals).reshape(-1, 3),
        np.array(moves_m),
        normals_px,
    )


def metres_per_pixel(
    views: Views, camera: int, point_world: NDArray[np.float64], normal: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64]]:
    """Return how far a silhouette cone moves as its outline moves by a pixel, and that way.

    Parameters
    ----------
    views : Views
        The cameras.
    camera : int
        The one whose outline moves.
    point_world : (3,) float64
        A point on its cone, in front of it, metres.
    normal : (3,) float64
        The cone's normal there: a unit vector across the ray.

    Returns
    -------
    metres : float
        Along the normal.
    normal_px : (2,) float64
        The outline's normal in the image, a unit vector.
    """
    matrix = views.img_from_local[camera]
    projected = views.project(point_world, camera)
    pixel = projected[:2] / projected[2]
    derivatives = (matrix[:2, :3] - pixel[:, None] * matrix[2, :3]) / projected[2]  # (2, 3)
    line, *_ = np.linalg.lstsq(derivatives.T, normal, rcond=None)
    metres = float(np.linalg.norm(line))
    return metres, np.asarray(line / metres if metres > 0 else np.full(2, np.nan))


def is_near_background(hull: Hull, camera: int, point_world: NDArray[np.float64]) -> bool:
    """Tell whether a camera sees background within `_NEAR_PX` of a point that it sees."""
    views = hull.views
    projected = views.project(point_world, camera)
    if not projected[2] > 0:
        return False
    x, y = projected[:2] / projected[2]
    answers = hull.answers(camera)
    height, width = answers.shape
    if not (0 <= x < width and 0 <= y < height):
        return False
    most = int(_NEAR_PX) + 1
    column, row = int(x), int(y)
    if answers[row, column] == UNSEEN:
        return False
    if most <= column < width - most and most <= row < height - most:
        around = answers[row - most : row + most + 1, column - most : column + most + 1]
        if around.all():  # most often
            return False
    reach = np.arange(-most, most + 1)
    columns, rows = column + reach, row + reach
    # To the nearest point of each pixel's square.
    away_x = np.maximum(np.maximum(columns - x, x - columns - 1), 0.0)
    away_y = np.maximum(np.maximum(rows - y, y - rows - 1), 0.0)
    is_near = away_x**2 + away_y[:, None] ** 2 <= _NEAR_PX**2
    is_within = (columns >= 0) & (columns < width) & ((rows >= 0) & (rows < height))[:, None]
    value = answers[np.clip(rows, 0, height - 1)[:, None], np.clip(columns, 0, width - 1)]
    beyond_ends = views.unseen == "carve"
    is_background = np.where(is_within, value == BACKGROUND, beyond_ends)
    return bool((is_near & is_background).any())


def any_beyond(ways_m: NDArray[np.float64], covariance_px2: NDArray[np.float64]) -> float:
    """Return what the largest of ``ways_m @ e`` exceeds in 5 % of the cases, metres.

    e (C,) is normal with mean 0.
    """
    matters = ways_m.any(axis=0)  # what other cameras do changes nothing, not even the draws
    ways_m, covariance_px2 = ways_m[:, matters], covariance_px2[np.ix_(matters, matters)]
    spread, axes = np.linalg.eigh(covariance_px2)
    across_m = ways_m @ (axes * np.sqrt(np.maximum(spread, 0.0)))  # (V, C)
    return float(np.quantile((_draws(len(spread)) @ across_m.T).max(axis=1), 0.95))


@lru_cache(maxsize=4)
def _draws(n_numbers: int) -> NDArray[np.float64]:
    """Return independent standard normal numbers (N, n), always the same."""
    return np.random.default_rng(0).normal(size=(_DRAWS, n_numbers))
