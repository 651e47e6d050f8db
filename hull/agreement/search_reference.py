"""The specification of `hybridve.hull.agreement.search`: which points count, in float64 NumPy.

Plain rather than fast: silhouettes are grown as images, and points asked one by one.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.agreement.search import Rule
from hybridve.hull.query.silhouettes import Hull


def points_count(hull: Hull, points_world: NDArray[np.float64], rule: Rule) -> NDArray[np.bool_]:
    """Tell which points count by a rule.

    A camera that is asked sees a point on an object pixel of its grown silhouette, which may reach
    beyond its image; or on background, where the true pixel is background that was recorded within
    its image however the outline is off; or not at all, which rules the point out unless the camera
    abstains. A point counts that no camera rules out and as many as are needed see on an object
    pixel.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    points_world : (N, 3) float64
        Points in metres.
    rule : Rule
        Which points count.

    Returns
    -------
    (N,) bool
    """
    views = hull.views
    n_seen = np.zeros(len(points_world), np.int64)
    is_out = np.zeros(len(points_world), np.bool_)
    for camera in np.flatnonzero(rule.is_asked).tolist():
        grown_px = int(rule.tolerance_px[camera])
        width, height = views.sizes_px[camera].tolist()
        border = 2 * grown_px
        padded = cv2.copyMakeBorder(
            hull.mask(camera), border, border, border, border, cv2.BORDER_CONSTANT, value=0
        )
        grown = cv2.dilate(padded, np.ones((2 * grown_px + 1, 2 * grown_px + 1), np.uint8))
        projected = (points_world - views.origin_world) @ views.img_from_local[camera, :, :3].T
        projected = projected + views.img_from_local[camera, :, 3]
        in_front = projected[:, 2] > 0
        with np.errstate(over="ignore"):
            pixels = projected[:, :2] / np.where(in_front, projected[:, 2], 1.0)[:, None]
        is_near = in_front & (pixels >= -grown_px).all(axis=1)
        is_near &= (pixels < np.add([width, height], grown_px)).all(axis=1)
        column, row = np.floor(np.where(is_near[:, None], pixels, 0.0)).astype(np.int64).T
        on_object = is_near & (grown[row + border, column + border] > 0)
        is_certain = is_near & (column >= grown_px) & (row >= grown_px)
        is_certain &= (column + grown_px < width) & (row + grown_px < height)
        recorded = views.seen_mask(camera)
        if recorded is not None:
            gaps = cv2.dilate(
                (recorded == 0).astype(np.uint8),
                np.ones((2 * grown_px + 1, 2 * grown_px + 1), np.uint8),
            )
            inside = is_certain.copy()
            is_certain[inside] &= gaps[row[inside], column[inside]] == 0
        n_seen += on_object
        is_out |= ~on_object & (is_certain | ~rule.abstains[camera])
    return np.asarray(~is_out & (n_seen >= rule.needed))
