"""Where a board stands before a camera whose lens is known."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.lens import cam_from_img, img_from_cam
from hybridve.calib.pose import Pose, transform

#: A pixel sees a ray if the ray leads back to it, to this many pixels.
_ROUND_TRIP_PX = 1e-3

#: COLMAP's lenses end at 90 degrees off the axis; rays this close (their cosine) are left out.
_GRAZING = 1e-3

#: A ray this far off the middle of a view's bundle (its cosine) cannot be located with it.
_LEAST_COSINE = 0.05

#: Fewer corners than this fix neither a pose nor a lens, nor do corners on a line: the spread
#: across it must be at least this share of the spread along it.
MIN_CORNERS = 6
_LINE = 1e-6
NEARLY_LINE = 0.05


def are_finite(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return where the last axis of an array (..., K) is all finite: (...) bool."""
    return np.asarray(np.isfinite(values).all(axis=-1), np.bool_)


def rms(residuals_px: NDArray[np.float64]) -> float:
    """Return the root mean square length of residuals (..., 2), pixels; NaN rows do not count."""
    squares = (residuals_px**2).sum(axis=-1)
    squares = squares[np.isfinite(squares)]
    return float(np.sqrt(squares.mean())) if len(squares) else np.nan


def board_residuals(
    camera: Camera,
    cam_from_board: Pose,
    points_board: NDArray[np.float64],
    pixels: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return observed minus projected corners (N, 2), pixels; NaN where a corner is not seen."""
    points_cam = transform(cam_from_board, points_board)
    projected = np.full((len(points_cam), 2), np.nan)
    ahead = are_ahead(points_cam)
    if ahead.any():
        projected[ahead] = img_from_cam(camera, points_cam[ahead])
    return np.asarray(pixels - projected, np.float64)


def are_ahead(points_cam: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which points (..., 3) are in front of a camera, and not seen at a grazing angle."""
    with np.errstate(invalid="ignore"):
        ahead = points_cam[..., 2] > _GRAZING * np.linalg.norm(points_cam, axis=-1)
    return np.asarray(ahead)


def rays_of(camera: Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit rays (N, 3) that pixels (N, 2) see, camera frame; NaN where there is none."""
    rays = np.full((len(pixels), 3), np.nan)
    seen = is_seen(pixels)
    if not seen.any():
        return rays
    flat = cam_from_img(camera, pixels[seen])
    found = np.column_stack([flat, np.ones(len(flat))])
    # A model may return rays where it sees nothing: beyond 90 degrees, or where it folds.
    back = img_from_cam(camera, found)
    with np.errstate(invalid="ignore"):
        off_px = np.linalg.norm(back - pixels[seen], axis=1)
        found /= np.linalg.norm(found, axis=1)[:, None]
        found[~((off_px < _ROUND_TRIP_PX) & (found[:, 2] > _GRAZING))] = np.nan
    rays[seen] = found
    return rays


def locate_board(
    camera: Camera,
    points_board: NDArray[np.float64],
    pixels: NDArray[np.float64],
    refine: bool = True,
) -> tuple[Pose, float, float] | None:
    """Return where a flat board lies as one camera sees it.

    COLMAP's robust pose is as exact, but of small or far boards it takes the wrong one of the two
    poses two to three times as often (noise of 1 px and 0.3 px: 2.0 % for 0.7 %, 11 % for 3.7 % of
    300 each), and does not tell how well the other one fits.

    Parameters
    ----------
    camera : Camera
        Its lens is used, its pose is not.
    points_board : (N, 3) float64
        Corners in metres, z = 0.
    pixels : (N, 2) float64
        The same corners in the image; NaN where one is not seen.
    refine : bool
        Least squares after the closed form, on rays.

    Returns
    -------
    cam_from_board : (3, 4) float64
        The better of the two poses that a plane allows.
    error_px, other_error_px : float
        Root mean square reprojection error of this pose and of the other one: where they are
        nearly equal the board is too small or too flat to tell its tilt. None is returned where
        the lens sees no ray at a corner, and for fewer than 4 corners or corners on a line.
    """
    seen = is_seen(pixels)
    points, pixels = points_board[seen], pixels[seen]
    rays = rays_of(camera, pixels)
    if len(pixels) < 4 or not np.isfinite(rays).all():
        return None
    located = ranked(camera, points, pixels, plane_poses(points, rays, refine))
    if not located:
        return None
    return located[0][1], located[0][0], located[-1][0] if len(located) > 1 else np.inf


def ranked(
    camera: Camera,
    points_board: NDArray[np.float64],
    pixels: NDArray[np.float64],
    poses: Sequence[Pose],
) -> list[tuple[float, Pose]]:
    """Return errors, pixels, and poses that see the whole board, the better first."""
    found = []
    for pose in poses:
        residuals = board_residuals(camera, pose, points_board, pixels)
        if np.isfinite(residuals).all():
            found.append((rms(residuals), pose))
    return sorted(found, key=lambda item: item[0])


def plane_poses(
    points_board: NDArray[np.float64], rays: NDArray[np.float64], refine: bool
) -> list[Pose]:
    """Return the up to two poses under which a plane's points (N, 3) lie on rays (N, 3)."""
    if len(rays) < 4 or thinness(points_board) < _LINE:
        return []
    virtual_from_cam = _frontal(rays.mean(axis=0))
    rays = rays @ virtual_from_cam.T
    if rays[:, 2].min() < _LEAST_COSINE:
        return []
    flat = np.ascontiguousarray(rays[:, :2] / rays[:, 2:])
    center = points_board.mean(axis=0)
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            points_board - center, flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return []
    poses = []
    for rotation, translation in zip(rotations, translations, strict=True):
        if refine:
            rotation, translation = cv2.solvePnPRefineLM(
                points_board - center, flat, np.eye(3), None, rotation, translation
            )
        matrix = virtual_from_cam.T @ cv2.Rodrigues(rotation)[0]
        shift = virtual_from_cam.T @ translation.ravel()
        pose = np.column_stack([matrix, shift - matrix @ center])
        if np.isfinite(pose).all():
            poses.append(pose)
    return poses


def _frontal(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the shortest rotation (3, 3) that takes a direction onto the z axis."""
    z = direction / np.linalg.norm(direction)
    # Rodrigues' formula for the turn from z to (0, 0, 1); z[2] > 0 always.
    x, y, c = z
    return np.array(
        [
            [1.0 - x * x / (1.0 + c), -x * y / (1.0 + c), -x],
            [-x * y / (1.0 + c), 1.0 - y * y / (1.0 + c), -y],
            [x, y, c],
        ]
    )


def thinness(points_board: NDArray[np.float64]) -> float:
    """Return the spread of points (N, 3) across their line, as a share of that along it."""
    if len(points_board) < 3:
        return 0.0
    spreads = np.linalg.svd(points_board - points_board.mean(axis=0), compute_uv=False)
    return float(spreads[1] / spreads[0]) if spreads[0] > 0 else 0.0
