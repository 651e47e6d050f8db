"""A lens in another lens model, as near as it comes, where a format does not have the lens's own.

The largest error over the image is found on rays beside those of the fit, and is to be told.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import N_PARAMS, Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import cam_from_img, img_from_cam

#: Rays per side of the image: of the fit, and, between those, of the error.
_FIT_STEPS = 20
_CHECK_STEPS = 55

#: A lens that shows fewer rays of the grid than this shows nothing: they would not fix another.
_LEAST_RAYS = 8

#: A pixel shows a ray only if that ray leads back to the pixel, this near.
_FOLD_TOLERANCE_PX = 1e-3

#: Further off than this, or not a number, a lens does not serve.
_FAR_PX = 1e6


def approximate(camera: Camera, models: Sequence[tuple[str, int]]) -> tuple[Camera, float]:
    """Return a camera with the nearest lens of some models, and its largest error.

    Parameters
    ----------
    camera : Camera
        Name, size and pose stay.
    models : sequence of (str, int)
        COLMAP models whose parameters start fx, fy, cx, cy, each with how many of its first
        parameters may differ from 0.

    Returns
    -------
    approximation : Camera
        Of the model that comes nearest.
    error_px : float
        The largest distance between the images of a ray, over all that the image shows.

    Raises
    ------
    CalibrationError
        If the image shows no ray at all, or no model comes near.
    """
    rays, pixels = _shown(camera, _FIT_STEPS)
    check_rays, check_pixels = _shown(camera, _CHECK_STEPS)
    best: tuple[Camera, float] | None = None
    for model, n_free in models:
        candidate = _fit(camera, model, n_free, rays, pixels)
        errors = img_from_cam(candidate, check_rays) - check_pixels
        error_px = float("inf")
        if (np.abs(errors) < _FAR_PX).all():
            error_px = float(np.linalg.norm(errors, axis=1).max())
        if best is None or error_px < best[1]:
            best = candidate, error_px
    if best is None:
        raise ValueError("approximate needs at least one model")
    if not np.isfinite(best[1]):
        raise CalibrationError(f"camera {camera.name!r}: no other lens comes near its own")
    return best


def _shown(camera: Camera, steps: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rays (N, 3) in front of the camera and the pixels (N, 2) of a grid that shows them."""
    xs = np.linspace(0.0, camera.width_px, steps)
    ys = np.linspace(0.0, camera.height_px, steps)
    grid = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    rays = np.column_stack([cam_from_img(camera, grid), np.ones(len(grid))])
    exists = np.isfinite(rays).all(axis=1)
    again = np.full_like(grid, np.inf)
    again[exists] = img_from_cam(camera, rays[exists])
    exists &= (np.abs(again - grid) < _FOLD_TOLERANCE_PX).all(axis=1)  # NaN is not
    if np.count_nonzero(exists) < _LEAST_RAYS:
        raise CalibrationError(f"camera {camera.name!r}: its lens shows nothing anywhere")
    return rays[exists], grid[exists]


def _fit(
    camera: Camera,
    model: str,
    n_free: int,
    rays: NDArray[np.float64],
    pixels: NDArray[np.float64],
) -> Camera:
    """Return the camera with the lens of a model that images rays nearest to their pixels."""
    matrix = camera.pinhole

    def with_free(free: NDArray[np.float64]) -> Camera:
        params = np.zeros(N_PARAMS[model])
        params[:n_free] = free
        return replace(camera, model=model, params=params, skew_px=0.0)

    def residuals(free: NDArray[np.float64]) -> NDArray[np.float64]:
        found = np.nan_to_num(img_from_cam(with_free(free), rays) - pixels, nan=_FAR_PX)
        return np.clip(found, -_FAR_PX, _FAR_PX).ravel()

    # Late: most rigs need no other lens, and their readers need not wait for SciPy's optimisers.
    from scipy.optimize import least_squares

    start = np.zeros(n_free)
    start[:4] = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    # Scaled by the derivatives: pixels and coefficients differ by many orders of magnitude.
    return with_free(least_squares(residuals, start, method="lm", x_scale="jac").x)
