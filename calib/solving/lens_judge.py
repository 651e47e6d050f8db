"""Whether views can tell a lens: parallel boards, small ones, tilts that fit as well."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations, is_seen
from hybridve.calib.errors import CalibrationError
from hybridve.calib.pose import angle_between
from hybridve.calib.solving.lens_adjust import Batch, LensAdjustment, focal_indices
from hybridve.calib.solving.locate import (
    are_finite,
    board_residuals,
    plane_poses,
    ranked,
    rays_of,
    rms,
)

#: Noise that corners have at least, for what the views can tell: noise-free data tell all.
_LEAST_NOISE_PX = 0.05

#: A focal length known to less than this (one standard deviation) is refused, or warned of.
_FOCAL_REFUSED = 0.05
_FOCAL_WARNED = 0.01

#: Boards whose normals stay within this of their mean are parallel; and within the second they are
#: if the focal length is not known.
_PARALLEL_DEG = 3.0
_TILTED_DEG = 10.0

#: A board that spans less than this share of the image is small.
_SMALL = 0.15

#: Two tilts further apart than this, that fit within so many standard deviations of each other,
#: are ambiguous.
_OTHER_TILT_DEG = 10.0
_TILT_SIGMA = 3.0
_CLEAR_SIGMA = 10.0

#: Corners that leave more than this share of the image unvisited leave the lens unknown there.
_LEAST_COVER = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A lens, the views that fit it and those that do not; what `FittedLens` is made of.

    Attributes
    ----------
    lens : LensAdjustment
        The lens with the poses of all views (V, 3, 4).
    kept : (V,) bool
        Which views were used.
    mask : (V, N) bool
        Which of their corners.
    misses_px : (V, N) float64
        How far each seen corner misses; NaN where it was not seen, infinite where the lens sees
        nothing.
    reasons : dict of int to str
        Why a view was not used.
    noise_px : float
        Standard deviation of a coordinate, robust, for the parameters that were fitted.
    """

    lens: LensAdjustment
    kept: NDArray[np.bool_]
    mask: NDArray[np.bool_]
    misses_px: NDArray[np.float64]
    reasons: dict[int, str]
    noise_px: float


def view_label(boards: Sequence[Board], image: str, board: int) -> str:
    """Return a view's name for messages: its image, and which board if there are several."""
    return image if len(boards) == 1 else f"{image}, {boards[board].name}"


def who(seen: Sequence[Observations]) -> str:
    """Return the name of a camera, or of the cameras that share a lens, for messages."""
    names = ", ".join(repr(camera.name) for camera in seen)
    return f"camera {names}" if len(seen) == 1 else f"cameras {names} (one lens)"


def sigmas_of(fit: Fit) -> NDArray[np.float64]:
    """Return the standard deviations (P,) of a fit's parameters; infinite where nothing tells."""
    information, camera = fit.lens.information, fit.lens.camera
    diagonal = np.maximum(np.diag(information), 0.0)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    # Below the error of the derivatives a direction is not known at all.
    values = np.maximum(values, 1e-14)
    variances = ((vectors / scale[:, None]) ** 2 / values).sum(axis=1)
    sigma_px = max(fit.noise_px, _LEAST_NOISE_PX)
    return np.asarray(sigma_px * np.sqrt(variances)).reshape(len(camera.params))


def focal_share(fit: Fit) -> float:
    """Return the largest standard deviation of a focal length, as a share of it."""
    focal = focal_indices(fit.lens.camera.model)
    return float((sigmas_of(fit)[focal] / fit.lens.camera.params[focal]).max())


def refuse_degenerate(seen: Sequence[Observations], batch: Batch, fit: Fit) -> None:
    """Refuse a lens whose views cannot tell its focal length from the boards' distance.

    Raises
    ------
    CalibrationError
        Saying what was found: boards too small in the image, all parallel, or tilted too little.
    """
    used = np.flatnonzero(fit.kept)
    normals = fit.lens.poses[used, :, 2]
    mean = normals.mean(axis=0)
    mean /= np.linalg.norm(mean)
    spread_deg = float(np.rad2deg(np.arccos(np.clip(normals @ mean, -1.0, 1.0))).max())
    share = focal_share(fit)
    part = batch.only(fit.mask).of(used)
    extents_px = np.nanmax(part.pixels, axis=1) - np.nanmin(part.pixels, axis=1)
    size_px = float(np.median(np.linalg.norm(extents_px, axis=1)))
    n_ambiguous = _count_ambiguous(fit, part, used)
    camera = fit.lens.camera
    longest_px = max(seen[0].size_px)
    is_hidden = 2 * n_ambiguous > len(used)
    if is_hidden and size_px < _SMALL * longest_px:
        raise CalibrationError(
            f"{who(seen)}: the board is too small in the image to tell its tilt in {n_ambiguous} "
            f"of {len(used)} views (it spans {size_px:.0f} of {longest_px} px in the "
            "median), expected in less than half; record it closer, or with a larger board"
        )
    found = f"within {spread_deg:.1f} degrees"
    if is_hidden and share > _FOCAL_REFUSED:
        found = f"no tilt shows in {n_ambiguous} of {len(used)} views"
        spread_deg = 0.0
    if spread_deg < (_PARALLEL_DEG if share <= _FOCAL_REFUSED else _TILTED_DEG):
        raise CalibrationError(
            f"{who(seen)}: all {len(used)} boards are parallel ({found}), "
            "so that focal length and distance cannot be told apart; record the board tilted by 20 "
            "to 40 degrees to different sides, or give the lens (`params`)"
        )
    if share > _FOCAL_REFUSED:
        remedy = "record the board tilted by 20 to 40 degrees to different sides"
        if size_px < _SMALL * longest_px:
            remedy = "the board is too small in the image: record it closer, or a larger board"
        raise CalibrationError(
            f"{who(seen)}: the {len(used)} views tell the focal length only to {100 * share:.0f} % "
            f"(model {camera.model}; boards tilted within {spread_deg:.0f} degrees, spanning "
            f"{size_px:.0f} of {longest_px} px in the median), expected "
            f"{100 * _FOCAL_REFUSED:.0f} % or better; {remedy}, choose a simpler model, or give "
            "the lens (`params`)"
        )


def _count_ambiguous(fit: Fit, part: Batch, used: NDArray[np.intp]) -> int:
    """Return in how many of the views another tilt fits as well, within the noise."""
    sigma_px = max(fit.noise_px, _LEAST_NOISE_PX)
    camera = fit.lens.camera
    count = 0
    for index, points, pixels in zip(used, part.points, part.pixels, strict=True):
        seen = is_seen(pixels)
        points, pixels = points[seen], pixels[seen]
        rays = rays_of(camera, pixels)
        best_px = rms(board_residuals(camera, fit.lens.poses[index], points, pixels))
        # The closed form tells most views; least squares are needed for the doubtful ones only.
        for refine, is_clear in ((False, _CLEAR_SIGMA), (True, _TILT_SIGMA)):
            others = [
                error_px
                for error_px, pose in ranked(
                    camera, points, pixels, plane_poses(points, rays, refine)
                )
                if np.rad2deg(angle_between(pose, fit.lens.poses[index])) > _OTHER_TILT_DEG
            ]
            evidence = len(pixels) * (min(others, default=np.inf) ** 2 - best_px**2) / sigma_px**2
            if evidence > is_clear**2:
                break
        else:
            count += 1
    return count


def warnings_of(fit: Fit, batch: Batch, sigmas: NDArray[np.float64]) -> tuple[str, ...]:
    """Return what is to be said of a lens that is not refused."""
    camera = fit.lens.camera
    used = np.flatnonzero(fit.kept)
    corners = batch.only(fit.mask).of(used).pixels
    corners = corners[are_finite(corners)].astype(np.float32)
    area = cv2.contourArea(cv2.convexHull(corners)) / (camera.width_px * camera.height_px)
    warnings = []
    if area < _LEAST_COVER:
        warnings.append(
            f"the boards cover {100 * area:.0f} % of the image, expected {100 * _LEAST_COVER:.0f} "
            "% or more: beyond them the lens is extrapolated; show the board near the image's edges"
        )
    focal = focal_indices(camera.model)
    share = float((sigmas[focal] / camera.params[focal]).max())
    if share > _FOCAL_WARNED:
        warnings.append(
            f"the focal length is known to {100 * share:.1f} % only; tilt the board more, to "
            "different sides"
        )
    return tuple(warnings)
