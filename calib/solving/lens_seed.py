"""A lens that is about right, to begin with."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.solving.lens_adjust import (
    ROUGH,
    Batch,
    adjust_lens,
    batch_residuals,
    colmap_camera,
    focal_indices,
    principal_indices,
    shape_indices,
)
from hybridve.calib.solving.locate import are_finite, plane_poses, rays_of, rms

#: Generic lenses that seeds are searched among (a model, its parameters beyond the focal length
#: and the principal point): straight lines kept, angles kept, and between them (stereographic).
_GENERIC: tuple[tuple[str, tuple[float, ...]], ...] = (
    ("SIMPLE_PINHOLE", ()),
    ("SIMPLE_FISHEYE", ()),
    ("EUCM", (0.5, 1.0)),
)

#: Focal lengths tried, as shares of the longer image side: what images 190 degrees in the shorter
#: one, to 5 degrees of view. Neighbours are 40 % apart, which least squares bridges.
_FOCAL_SHARES = np.geomspace(0.15, 12.0, 14)

#: Views from which a lens is seeded: more do not change it.
_SEED_VIEWS = 12
_SEARCH_VIEWS = 6

#: A generic lens is tried in full unless the best one is better by a factor and pixels.
_MUCH_WORSE = 3.0
_MUCH_WORSE_PX = 1.0

#: Views that fit this well need no other seed.
_GOOD_SEED_PX = 0.5

#: Where a model's own shape starts, if zero is not a lens.
_FIRST_SHAPE = {"FOV": (0.5,), "EUCM": (0.5, 1.0)}

#: A view of which the lens does not see more than this share of corners is not located.
_LOST_SHARE = 0.2


def make_start(name: str, model: str, focal_px: float, size_px: tuple[int, int]) -> Camera:
    """Return a camera at the origin with a focal length and no distortion, or next to none."""
    params = np.array(colmap_camera(model, focal_px, size_px).params)
    if model in _FIRST_SHAPE:
        params[shape_indices(model)] = _FIRST_SHAPE[model]
    return Camera(name, model, *size_px, params, np.eye(3, 4))


def imitate(camera: Camera, model: str, pixels: NDArray[np.float64]) -> Camera:
    """Return a lens of another model that does about the same at some pixels (S, 2).

    The focal length and up to two coefficients of its shape are fitted to the rays; the others
    stay zero.
    """
    focal_px = float(camera.params[0])
    start = make_start(camera.name, model, focal_px, (camera.width_px, camera.height_px))
    params = start.params.copy()
    params[principal_indices(model)] = camera.params[principal_indices(camera.model)]
    start = replace(start, params=params)
    free = np.zeros(len(params), np.bool_)
    free[[*focal_indices(model), *shape_indices(model)[:2]]] = True
    rays = rays_of(camera, pixels)
    known = are_finite(rays)
    batch = Batch(rays[known][None], pixels[known][None])
    identity = np.eye(3, 4)[None]
    return adjust_lens(start, identity, batch, np.inf, free, move_poses=False).camera


def _spread_out(count: int, wanted: int) -> NDArray[np.intp]:
    return np.linspace(0, count - 1, min(count, wanted)).round().astype(np.intp)


def locate_views(
    camera: Camera, batch: Batch, refine: bool = True
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Locate every view through a lens.

    Corners at which the lens sees nothing are left out, up to a share of a view.

    Returns
    -------
    poses : (V, 3, 4) float64
        cam_from_board; NaN where a view cannot be located.
    errors_px : (V,) float64
        Root mean square reprojection errors; infinite there.
    """
    n_views, n_points = batch.pixels.shape[:2]
    rays = rays_of(camera, batch.pixels.reshape(-1, 2)).reshape(n_views, n_points, 3)
    has_ray = are_finite(rays)
    n_seen = are_finite(batch.pixels).sum(axis=1)
    both = np.full((2, n_views, 3, 4), np.nan)
    for index in np.flatnonzero(has_ray.sum(axis=1) >= (1.0 - _LOST_SHARE) * n_seen):
        use = has_ray[index]
        for rank, pose in enumerate(
            plane_poses(batch.points[index, use], rays[index, use], refine)
        ):
            both[rank, index] = pose
    # Both poses of all views at once: one call of the lens.
    twice = Batch(np.concatenate([batch.points] * 2), np.concatenate([batch.pixels] * 2))
    residuals = batch_residuals(camera, both.reshape(-1, 3, 4), twice)
    squares = (residuals**2).sum(axis=2).reshape(2, n_views, n_points)
    squares = np.where(has_ray, squares, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        errors_px = np.sqrt(squares.sum(axis=2) / has_ray.sum(axis=1))
    errors_px[~np.isfinite(errors_px)] = np.inf
    better, every = errors_px.argmin(axis=0), np.arange(n_views)
    poses, errors_px = both[better, every], errors_px[better, every]
    poses[~np.isfinite(errors_px)] = np.nan
    return poses, errors_px


def seed_lens(name: str, model: str, size_px: tuple[int, int], batch: Batch) -> Camera:
    """Return a lens that is about right, from views of boards.

    Zhang's closed form fails on views that are nearly parallel and knows no fisheye. One unknown
    can be searched: the focal length under which the boards are seen best, through generic lenses;
    the model then imitates the generic lens, and the one that serves best is taken.

    Raises
    ------
    CalibrationError
        If the views fit no lens of this model.
    """
    few = batch.of(_spread_out(len(batch.pixels), _SEARCH_VIEWS))
    found: list[tuple[float, Camera]] = []
    for generic, shape in _GENERIC:
        best, best_px = None, np.inf
        for share in _FOCAL_SHARES:
            camera = make_start(name, generic, share * max(size_px), size_px)
            if shape:
                params = camera.params.copy()
                params[shape_indices(generic)] = shape
                camera = replace(camera, params=params)
            # The median: blurred and wrong views have not been dropped yet.
            error_px = float(np.median(locate_views(camera, few, refine=False)[1]))
            if error_px < best_px:
                best, best_px = camera, error_px
        if best is not None:
            found.append((best_px, best))
    limit_px = _MUCH_WORSE * min((error for error, _ in found), default=0.0) + _MUCH_WORSE_PX
    some = batch.of(_spread_out(len(batch.pixels), _SEED_VIEWS))
    corners = some.pixels[are_finite(some.pixels)]
    best, best_px = None, np.inf
    for error_px, generic_lens in sorted(found, key=lambda item: item[0]):
        if error_px > limit_px:
            continue
        start = imitate(generic_lens, model, corners)
        poses, errors_px = locate_views(start, some, refine=False)
        use = np.flatnonzero(np.isfinite(errors_px))
        if 2 * len(use) < len(errors_px):
            continue
        free = np.ones(len(start.params), np.bool_)
        free[principal_indices(model)] = False
        free[shape_indices(model)[2:]] = False
        fitted = adjust_lens(start, poses[use], some.of(use), 1.0, free, tolerance=ROUGH)
        residuals = batch_residuals(fitted.camera, fitted.poses, some.of(use))
        error = float(np.median([rms(each) for each in residuals]))
        if error < best_px:
            best, best_px = fitted.camera, error
        if best_px < _GOOD_SEED_PX:
            break
    if best is None:
        raise CalibrationError(
            f"camera {name!r}: model {model} fits none of its {len(batch.pixels)} views of the "
            "board; check the board's columns and rows, or choose another model"
        )
    return best
