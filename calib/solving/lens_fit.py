"""One lens from views of boards: seeds that hold for any model, then least squares over all views.

A lens belongs to one camera, or to several that share it; every view of a board has a pose of its
own. The views' poses are eliminated (Schur complement), so that a step costs as much as one
evaluation of the lens. Boards are located on bearing vectors turned into a frontal virtual camera:
rays far off the axis, which a plane at depth 1 stretches without end, are as good as others there.

COLMAP's models image nothing at or beyond 90 degrees off the axis: corners there are set aside.

This work is based on: Zhang, *A flexible new technique for camera calibration*, IEEE Trans. PAMI
22(11), 2000; Collins and Bartoli, *Infinitesimal plane-based pose estimation*, IJCV 109(3), 2014;
Triggs, McLauchlan, Hartley and Fitzgibbon, *Bundle adjustment: a modern synthesis*, 2000.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations, Sighting, is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import natural_order
from hybridve.calib.pose import Pose
from hybridve.calib.record import LensChoice
from hybridve.calib.solving.lens_adjust import (
    COST_SHARE,
    ROUGH,
    Batch,
    adjust_lens,
    batch_residuals,
    principal_indices,
)
from hybridve.calib.solving.lens_judge import (
    Fit,
    refuse_degenerate,
    sigmas_of,
    view_label,
    warnings_of,
    who,
)
from hybridve.calib.solving.lens_seed import locate_views, seed_lens
from hybridve.calib.solving.locate import MIN_CORNERS, NEARLY_LINE, are_finite, rms, thinness

logger = logging.getLogger(__name__)

#: Image width for which the limits of `LensSettings` are meant.
_USUAL_WIDTH_PX = 640

#: A corner that misses by more than both is an outlier, if not more than a share of its view are.
_OUTLIER_SIGMA = 6.0
_OUTLIER_PX = 3.0
_OUTLIER_SHARE = 0.1

#: Turns of fitting and dropping; a handful is usual.
_MAX_TURNS = 50


@dataclass(frozen=True, slots=True)
class LensSettings:
    """How a lens is fitted; the defaults serve.

    Attributes
    ----------
    max_view_px : float
        A view whose corners miss by more than this, root mean square, is dropped; in images wider
        than 640 pixels in proportion.
    max_view_medians : float
        So is one that misses by this many times the median of its camera's views, ...
    always_good_px : float
        ... unless it misses by no more than this.
    min_views : int
        Views a lens is fitted to at least.
    loss_px : float
        Corners that miss by more than this weigh less than squared.
    """

    max_view_px: float = 1.0
    max_view_medians: float = 3.0
    always_good_px: float = 0.5
    min_views: int = 3
    loss_px: float = 1.0

    def limit_px(self, errors_px: NDArray[np.float64], width_px: int) -> float:
        """Return the largest error of a view that is accepted, from those of all (V,)."""
        most = self.max_view_px * max(1.0, width_px / _USUAL_WIDTH_PX)
        if not len(errors_px):
            return most
        relative = self.max_view_medians * float(np.median(errors_px))
        return min(most, max(relative, self.always_good_px))


_DEFAULTS = LensSettings()


@dataclass(frozen=True, slots=True, eq=False)
class FittedLens:
    """A camera's lens and the views it was fitted to.

    Attributes
    ----------
    camera : Camera
        The lens; its pose is the identity.
    views : dict of (str, int) to (3, 4) float64
        By image and board cam_from_board of the views that were used, in natural order.
    pixels : dict of (str, int) to (N, 2) float64
        Their points in pixels; NaN where one was not seen, or is an outlier.
    dropped : dict of str to str
        Views that do not fit, and why; by image, and board if there are several.
    outliers : tuple of (str, int, int, float)
        Corners that were set aside in views that were used: image, board, which corner, and by how
        many pixels it misses (infinite: the lens sees nothing there).
    warnings : tuple of str
        What the views leave open.
    noise_px : float
        Standard deviation of a coordinate of a corner, robust (from the median residual).
    rms_px : float
        Root mean square length of the residuals of the corners that were used.
    sigmas : (P,) float64
        Standard deviation of each parameter for that noise; 0 where it was given.
    choice : LensChoice or None
        Why this model, if it was chosen.
    """

    camera: Camera
    views: dict[tuple[str, int], Pose]
    pixels: dict[tuple[str, int], NDArray[np.float64]]
    dropped: dict[str, str]
    outliers: tuple[tuple[str, int, int, float], ...]
    warnings: tuple[str, ...]
    noise_px: float
    rms_px: float
    sigmas: NDArray[np.float64]
    choice: LensChoice | None = None


def fit_lens(
    boards: Sequence[Board],
    seen: Observations,
    settings: LensSettings = _DEFAULTS,
    fixed_params: NDArray[np.float64] | None = None,
) -> FittedLens:
    """Fit one camera's lens to views of boards, and drop views and corners by their own error.

    Parameters
    ----------
    boards : sequence of Board
        The boards; sightings name them by number.
    seen : Observations
        Of the camera: its stills, and the frames of its clip unless boards lie still there.
    settings : LensSettings
        How it is done.
    fixed_params : (P,) float64, optional
        The parameters of the lens, if they are known: views are only located then.

    Raises
    ------
    CalibrationError
        Naming the camera, if too few views fit, or if they cannot tell the focal length: all boards
        parallel, too small in the image, or tilted too little.
    """
    return fit_shared_lens(boards, [seen], settings, fixed_params)[0]


def fit_shared_lens(
    boards: Sequence[Board],
    seen: Sequence[Observations],
    settings: LensSettings = _DEFAULTS,
    fixed_params: NDArray[np.float64] | None = None,
) -> list[FittedLens]:
    """Fit one lens to the views of several cameras of one kind: one `FittedLens` a camera.

    Parameters and errors are those of `fit_lens`; neither the order of cameras nor that of
    sightings matters.
    """
    views, unusable = collect_views(boards, seen, settings, is_free=fixed_params is None)
    if fixed_params is not None and not views:
        return [_given_lens(camera, fixed_params) for camera in seen]
    batch = make_batch(boards, views)
    fit = fit_batch(seen, batch, settings, fixed_params)
    if fixed_params is None:
        refuse_degenerate(seen, batch, fit)
    elif 2 * fit.kept.sum() < len(views):
        raise CalibrationError(
            f"{who(seen)}: the lens that was given (`params`) fits only {fit.kept.sum()} of "
            f"{len(views)} views of the board; are they this camera's, for this image size, in the "
            f"order of COLMAP's {seen[0].model}, and is the board as described?"
        )
    return share_out(boards, seen, views, unusable, batch, fit, fixed_params is None)


def _given_lens(seen: Observations, params: NDArray[np.float64]) -> FittedLens:
    """Return a lens that is known, and that no view was fitted to."""
    camera = Camera(seen.name, seen.model, *seen.size_px, params, np.eye(3, 4))
    return FittedLens(camera, {}, {}, {}, (), (), 0.0, 0.0, np.zeros(len(camera.params)))


def collect_views(
    boards: Sequence[Board], seen: Sequence[Observations], settings: LensSettings, is_free: bool
) -> tuple[list[tuple[int, Sighting]], dict[tuple[int, str], str]]:
    """Return the views that can be used, in natural order, and why others cannot.

    Of each the number of its camera among those that share the lens is told.

    Raises
    ------
    CalibrationError
        If cameras that share a lens differ in model or size, or there are too few views.
    """
    first = seen[0]
    for other in seen[1:]:
        if (other.model, other.size_px) != (first.model, first.size_px):
            raise CalibrationError(
                f"cameras {first.name!r} and {other.name!r} share a lens, but are {first.model} of "
                "{}x{} pixels and {} of {}x{}; expected the same".format(
                    *first.size_px, other.model, *other.size_px
                )
            )
    views: list[tuple[int, Sighting]] = []
    unusable: dict[tuple[int, str], str] = {}
    for owner, camera in enumerate(seen):
        for sighting in camera.sightings:
            if sighting.instant is not None and camera.is_still:
                continue
            points = boards[sighting.board].points_board[is_seen(sighting.pixels)]
            label = view_label(boards, sighting.image, sighting.board)
            if len(points) < MIN_CORNERS:
                unusable[owner, label] = (
                    f"only {len(points)} corners seen, expected {MIN_CORNERS} or more"
                )
            elif thinness(points) < NEARLY_LINE:
                unusable[owner, label] = f"its {len(points)} corners lie on a line"
            else:
                views.append((owner, sighting))
    views.sort(key=lambda own: (seen[own[0]].name, natural_order(own[1].image), own[1].board))
    if is_free and len(views) < settings.min_views:
        n_missed = len(unusable) + sum(len(camera.missed) for camera in seen)
        found = f"in {len(views)} of {len(views) + n_missed} pictures"
        if unusable:
            found += f" ({len(unusable)} others show too little of it)"
        if not views and not n_missed and any(camera.sightings for camera in seen):
            found = "only lying still in the clip that all cameras see"
        raise CalibrationError(
            f"{who(seen)}: {boards[0]} was found {found}, expected {settings.min_views} views or "
            "more to fit a lens; check columns and rows, or take more pictures of it (`intrinsics`)"
        )
    return views, unusable


def make_batch(boards: Sequence[Board], views: Sequence[tuple[int, Sighting]]) -> Batch:
    """Return the views of `collect_views` padded to the longest board."""
    longest = max((len(boards[view.board].points_board) for _, view in views), default=0)
    points = np.zeros((len(views), longest, 3))
    pixels = np.full((len(views), longest, 2), np.nan)
    for index, (_, view) in enumerate(views):
        n_points = len(boards[view.board].points_board)
        points[index, :n_points] = boards[view.board].points_board
        seen = is_seen(view.pixels)
        pixels[index, :n_points][seen] = view.pixels[seen]
    return Batch(points, pixels)


def fit_batch(
    seen: Sequence[Observations],
    batch: Batch,
    settings: LensSettings,
    fixed_params: NDArray[np.float64] | None = None,
) -> Fit:
    """Fit a lens to a batch, and drop views and corners by their own error.

    The worst views go first, a fifth at a time, since a wrong view spoils the error of the
    others; after each turn all are asked again, also those that had gone. A corner goes by itself
    if nearly all others of its view fit.

    Raises
    ------
    CalibrationError
        If fewer views fit than a lens needs.
    """
    name, model, size_px = seen[0].name, seen[0].model, seen[0].size_px
    n_views = len(batch.pixels)
    is_corner = are_finite(batch.pixels)
    if fixed_params is None:
        lens = seed_lens(name, model, size_px, batch)
    else:
        lens = Camera(name, model, *size_px, np.asarray(fixed_params), np.eye(3, 4))
    every = np.full(len(lens.params), fixed_params is None)
    rough = every.copy()
    rough[principal_indices(model)] = False
    is_rough = fixed_params is None  # the seed is: first leave the principal point in the middle
    kept, mask = np.ones(n_views, np.bool_), is_corner.copy()
    poses = np.full((n_views, 3, 4), np.nan)
    reasons: dict[int, str] = {}
    for _ in range(_MAX_TURNS):
        lost = np.flatnonzero(kept & ~np.isfinite(poses).all(axis=(1, 2)))
        poses[lost] = locate_views(lens, batch.only(mask).of(lost), refine=False)[0]
        used = np.flatnonzero(kept & np.isfinite(poses).all(axis=(1, 2)))
        if fixed_params is None and len(used) < settings.min_views:
            raise CalibrationError(
                f"{who(seen)}: only {len(used)} of {n_views} views of the board fit model "
                f"{model}, expected {settings.min_views} or more; check columns and rows, take "
                "sharper pictures, or choose another model"
            )
        part = batch.only(mask).of(used)
        free, tolerance = (rough, ROUGH) if is_rough else (every, COST_SHARE)
        adjusted = adjust_lens(lens, poses[used], part, settings.loss_px, free, tolerance=tolerance)
        lens = adjusted.camera
        poses[used] = adjusted.poses
        if is_rough:
            is_rough = False
            continue
        noise_px = noise_of(batch_residuals(lens, adjusted.poses, part), int(every.sum()))
        others = np.setdiff1d(np.arange(n_views), used)
        located = _locate_robustly(lens, batch.of(others), noise_px)
        poses[others] = np.where(np.isfinite(located), located, poses[others])
        misses_px = np.linalg.norm(batch_residuals(lens, poses, batch), axis=2)
        misses_px[is_corner & ~np.isfinite(misses_px)] = np.inf
        new_mask = _fitting_corners(is_corner, misses_px, noise_px)
        errors_px = np.array(
            [np.sqrt((m[k] ** 2).mean()) for m, k in zip(misses_px, new_mask, strict=True)]
        )
        limit_px = settings.limit_px(errors_px[used], size_px[0])
        bad = used[errors_px[used] > limit_px]
        bad = bad[np.argsort(-errors_px[bad], kind="stable")][: max(1, len(used) // 5)]
        good = errors_px <= limit_px
        good[used] = True
        good[bad] = False
        reasons = {
            int(index): f"{errors_px[index]:.2f} px rms, limit {limit_px:.2f} px"
            if np.isfinite(errors_px[index])
            else "the lens sees no ray at some corner"
            for index in np.flatnonzero(~good)
        }
        is_same = np.array_equal(np.flatnonzero(good), used)
        if is_same and (new_mask[used] == mask[used]).all():
            break
        kept, mask = good, new_mask
    kept = np.zeros(n_views, np.bool_)
    kept[used] = True
    return Fit(replace(adjusted, poses=poses), kept, mask, misses_px, reasons, noise_px)


def _fitting_corners(
    is_corner: NDArray[np.bool_], misses_px: NDArray[np.float64], noise_px: float
) -> NDArray[np.bool_]:
    """Return the corners (V, N) without outliers; a view with many has none, but is wrong."""
    limit_px = max(_OUTLIER_SIGMA * noise_px, _OUTLIER_PX)
    with np.errstate(invalid="ignore"):
        fits = is_corner & (misses_px <= limit_px)
    n_corners, n_fitting = is_corner.sum(axis=1), fits.sum(axis=1)
    allowed = np.maximum(1, _OUTLIER_SHARE * n_corners)
    is_few = (n_corners - n_fitting <= allowed) & (n_fitting >= MIN_CORNERS)
    return np.where(is_few[:, None], fits, is_corner)


def _locate_robustly(lens: Camera, batch: Batch, noise_px: float) -> NDArray[np.float64]:
    """Return the poses (V, 3, 4) of views, each without its outliers; NaN where there is none."""
    poses = locate_views(lens, batch)[0]
    is_corner = are_finite(batch.pixels)
    misses_px = np.linalg.norm(batch_residuals(lens, poses, batch), axis=2)
    misses_px[is_corner & ~np.isfinite(misses_px)] = np.inf
    # Least squares spread one wrong corner over its view: the worst is taken out, then asked again.
    worst = np.argmax(np.where(is_corner, misses_px, -1.0), axis=1)
    suspect = is_corner.copy()
    suspect[np.arange(len(worst)), worst] = False
    again, _ = locate_views(lens, batch.only(suspect))
    fits = _fitting_corners(
        suspect, np.linalg.norm(batch_residuals(lens, again, batch), axis=2), noise_px
    )
    better = np.isfinite(again).all(axis=(1, 2)) & (fits == suspect).all(axis=1)
    return np.where(better[:, None, None], again, poses)


def noise_of(residuals: NDArray[np.float64], n_params: int) -> float:
    """Return the standard deviation of a coordinate from residuals (V, N, 2), robustly."""
    values = residuals[np.isfinite(residuals)]
    if not len(values):
        return 0.0
    freedom = len(values) - 6 * len(residuals) - n_params
    # 1.4826 times the median absolute value estimates a normal standard deviation.
    spread = 1.4826 * float(np.median(np.abs(values)))
    return spread * float(np.sqrt(len(values) / max(freedom, 1)))


def share_out(
    boards: Sequence[Board],
    seen: Sequence[Observations],
    views: Sequence[tuple[int, Sighting]],
    unusable: dict[tuple[int, str], str],
    batch: Batch,
    fit: Fit,
    is_free: bool,
) -> list[FittedLens]:
    """Return what each camera gets of a fit."""
    sigmas = sigmas_of(fit) if is_free else np.zeros(len(fit.lens.camera.params))
    residuals = batch_residuals(fit.lens.camera, fit.lens.poses, batch.only(fit.mask))
    fitted = []
    for owner, camera in enumerate(seen):
        dropped = {label: why for (whose, label), why in unusable.items() if whose == owner}
        poses, pixels, outliers = {}, {}, []
        mine = [index for index, (whose, _) in enumerate(views) if whose == owner]
        for index in mine:
            _, view = views[index]
            if not fit.kept[index]:
                dropped[view_label(boards, view.image, view.board)] = fit.reasons.get(
                    index, "the lens sees no ray at some corner"
                )
                continue
            mask = fit.mask[index, : len(view.pixels)]
            poses[view.image, view.board] = fit.lens.poses[index]
            pixels[view.image, view.board] = np.where(mask[:, None], view.pixels, np.nan)
            for corner in np.flatnonzero(is_seen(view.pixels) & ~mask):
                miss_px = float(fit.misses_px[index, corner])
                outliers.append((view.image, view.board, int(corner), miss_px))
        used = [index for index in mine if fit.kept[index]]
        for label, why in dropped.items():
            logger.info("camera %s: %s dropped: %s", camera.name, label, why)
        fitted.append(
            FittedLens(
                replace(fit.lens.camera, name=camera.name),
                poses,
                pixels,
                dropped,
                tuple(outliers),
                warnings_of(fit, batch, sigmas) if is_free else (),
                fit.noise_px,
                rms(residuals[used]),
                sigmas,
            )
        )
    return fitted
