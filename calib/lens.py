"""Lens models: pixels from rays, rays from pixels, and images freed of distortion.

COLMAP's models, evaluated by pycolmap, so that the hull and the solver can never disagree.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.cache import cache_key, find_arrays, keep_arrays
from hybridve.calib.camera import Camera
from hybridve.calib.colmap_library import pycolmap

#: An undistorted image reaches at most this far off the axis, in degrees: a pinhole image of a
#: wider lens has no finite size. What a fisheye sees beyond is cut off and counts as not seen.
MAX_HALF_ANGLE_DEG = 70.0

#: A ray is imaged at a pixel only if that pixel leads back to the ray. Polynomial distortion
#: folds over far outside the image, and a folded ray would borrow somebody else's silhouette.
_FOLD_TOLERANCE = 1e-4

#: Rays per side from which the extent of an undistorted image is found.
_EXTENT_STEPS = 65

_KIND = "lenses"

#: Part of the key of what is kept: count it up when `undistortion` computes something else.
_VERSION = 2


def as_colmap(camera: Camera, number: int = 1) -> pycolmap.Camera:
    """Return a camera's lens as COLMAP's, which is called by a number; it holds no skew."""
    return pycolmap.Camera(
        camera_id=number,
        model=camera.model,
        width=camera.width_px,
        height=camera.height_px,
        params=camera.params,
    )


def parameter_names(model: str) -> tuple[str, ...]:
    """Return the names of a model's parameters in COLMAP's order: fx, fy, cx, cy, k1, ..."""
    camera = pycolmap.Camera.create_from_model_name(1, model, 1.0, 1, 1)
    return tuple(name.strip() for name in camera.params_info.split(","))


def project_points(
    camera: Camera, points_world: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Project world points through the lens into the image as it was recorded.

    Parameters
    ----------
    camera : Camera
        The camera to look through.
    points_world : (N, 3) float64
        Points in metres.

    Returns
    -------
    pixels : (N, 2) float64
        Image coordinates in pixels, pixel centre at 0.5; NaN where `depth_m` is not positive.
    depth_m : (N,) float64
        Distance along the optical axis; negative behind the camera.
    """
    points_cam = points_world @ camera.cam_from_world[:, :3].T + camera.cam_from_world[:, 3]
    depth_m = points_cam[:, 2]
    pixels = np.full((len(points_world), 2), np.nan)
    visible = depth_m > 0
    if visible.any():
        pixels[visible] = img_from_cam(camera, points_cam[visible])
    return pixels, depth_m


def img_from_cam(camera: Camera, points_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project points in front of the camera, (N, 3) camera frame, to pixels (N, 2)."""
    if not camera.has_distortion:
        homogeneous = points_cam @ camera.pinhole.T
        return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])
    return np.asarray(as_colmap(camera).img_from_cam(np.ascontiguousarray(points_cam)))


def img_by_params(
    camera: Camera, params: NDArray[np.float64], points_cam: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the images (K, N, 2) of points (N, 3) for K sets of a lens's parameters, (K, P)."""
    lens = as_colmap(camera)
    points = np.ascontiguousarray(points_cam)
    images = np.zeros((len(params), len(points), 2))
    for index, values in enumerate(params):
        lens.params = values
        images[index] = lens.img_from_cam(points)
    return images


def cam_from_img(camera: Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rays (N, 2) at depth 1 that pixels (N, 2) see; NaN where there is none."""
    if not camera.has_distortion:
        rays = np.linalg.solve(camera.pinhole, np.column_stack([pixels, np.ones(len(pixels))]).T).T
        return np.asarray(rays[:, :2])
    return np.asarray(as_colmap(camera).cam_from_img(np.ascontiguousarray(pixels)))


@dataclass(frozen=True, slots=True, eq=False)
class Undistortion:
    """How a camera's recorded image becomes a pinhole image that shows all of it.

    Attributes
    ----------
    width_px, height_px : int
        Size of the pinhole image; larger than the recorded one where the lens bends inwards.
    img_from_cam : (3, 3) float64
        The pinhole matrix of that image, pixel centre at 0.5.
    map_x, map_y : (height_px, width_px) float32, or None
        For each pixel its place in the recorded image in OpenCV's convention (pixel centre at 0,
        ready for ``cv2.remap``), -1 where the recorded image has nothing. None without distortion.
    """

    width_px: int
    height_px: int
    img_from_cam: NDArray[np.float64]
    map_x: NDArray[np.float32] | None
    map_y: NDArray[np.float32] | None

    @property
    def seen(self) -> NDArray[np.bool_] | None:
        """Which pixels (height_px, width_px) were recorded; None for all of them."""
        return None if self.map_x is None else self.map_x != -1


def undistortion(camera: Camera) -> Undistortion:
    """Return the pinhole image that contains all that the camera sees, up to 70 degrees off axis.

    The focal lengths stay those of the lens, so that the middle of the image keeps its resolution.
    Where the lens distorts, it is computed once and kept (see `hybridve.calib.cache`).
    """
    if not camera.has_distortion:
        return Undistortion(camera.width_px, camera.height_px, camera.pinhole, None, None)
    key = cache_key(
        *(_VERSION, pycolmap.__version__, np.__version__),
        *(MAX_HALF_ANGLE_DEG, _FOLD_TOLERANCE, _EXTENT_STEPS),
        *(camera.model, camera.width_px, camera.height_px, camera.params.tobytes()),
    )
    kept = find_arrays(_KIND, key, ("img_from_cam", "map_x", "map_y"))
    if kept is None or not _is_undistortion(*kept):
        matrix, map_x, map_y = _undistort(camera)
        keep_arrays(_KIND, key, img_from_cam=matrix, map_x=map_x, map_y=map_y)
    else:
        matrix, map_x, map_y = kept
    return Undistortion(map_x.shape[1], map_x.shape[0], matrix, map_x, map_y)


def _is_undistortion(matrix: NDArray[Any], map_x: NDArray[Any], map_y: NDArray[Any]) -> bool:
    return (
        (matrix.shape == (3, 3) and matrix.dtype == np.float64)
        and (map_x.ndim == 2 and map_x.shape == map_y.shape)
        and map_x.dtype == map_y.dtype == np.float32
    )


def _undistort(
    camera: Camera,
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Return pinhole matrix and maps of the undistortion of a lens that distorts."""
    pinhole = camera.pinhole

    # All that the image shows, as rays. A pixel without a ray of its own (outside the circle of a
    # fisheye, or beyond the radius where a fitted polynomial turns back) shows nothing.
    xs = np.linspace(0.0, camera.width_px, _EXTENT_STEPS)
    ys = np.linspace(0.0, camera.height_px, _EXTENT_STEPS)
    grid = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    rays = cam_from_img(camera, grid)  # (N, 2)
    exists = np.isfinite(rays).all(axis=1)
    again = np.full_like(grid, np.nan)
    again[exists] = img_from_cam(camera, np.column_stack([rays[exists], np.ones(exists.sum())]))
    with np.errstate(invalid="ignore"):
        exists &= np.linalg.norm(again - grid, axis=1) < _FOLD_TOLERANCE * camera.width_px
    limit = np.tan(np.deg2rad(MAX_HALF_ANGLE_DEG))
    pixels = np.clip(rays[exists], -limit, limit) @ pinhole[:2, :2].T + pinhole[:2, 2]
    low = np.floor(pixels.min(axis=0))
    high = np.ceil(pixels.max(axis=0))
    width_px, height_px = (int(extent) for extent in high - low)
    matrix = pinhole.copy()
    matrix[:2, 2] -= low  # a shift by whole pixels

    columns, rows = np.meshgrid(np.arange(width_px) + 0.5, np.arange(height_px) + 0.5)
    targets = np.column_stack([columns.ravel(), rows.ravel(), np.ones(columns.size)])
    rays_wanted = np.linalg.solve(matrix, targets.T).T  # (N, 3), depth 1
    sources = img_from_cam(camera, rays_wanted)
    inside = (
        np.isfinite(sources).all(axis=1)
        & (sources >= 0).all(axis=1)
        & (sources < (camera.width_px, camera.height_px)).all(axis=1)
    )
    # Keep a ray only if its pixel leads back to it (see _FOLD_TOLERANCE).
    back = np.full((len(sources), 2), np.nan)
    back[inside] = cam_from_img(camera, sources[inside])
    inside &= np.linalg.norm(back - rays_wanted[:, :2], axis=1) < _FOLD_TOLERANCE * (
        1.0 + np.linalg.norm(rays_wanted[:, :2], axis=1)
    )
    maps = np.where(inside[:, None], sources - 0.5, -1.0).astype(np.float32)
    # Rounded to single precision, a place at the far border of the image must stay before it.
    last = np.array([camera.width_px, camera.height_px], np.float32) - np.float32(0.5)
    maps = np.minimum(maps, np.nextafter(last, np.float32(0.0)))
    maps = maps.reshape(height_px, width_px, 2)
    return matrix, np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])
