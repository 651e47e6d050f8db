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
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations, is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import natural_order
from hybridve.calib.lens import cam_from_img, img_from_cam
from hybridve.calib.pose import Pose, angle_between, transform, turned_pose
from hybridve.calib.record import LensChoice
from hybridve.calib.solving.bundle import POSE, lens_derivatives
from hybridve.calib.solving.least_squares import (
    FLOOR_PX,
    Limits,
    NormalEquations,
    Step,
    minimized,
    soft_l1,
    soft_l1_rows,
)

logger = logging.getLogger(__name__)

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

#: A pixel sees a ray if the ray leads back to it, to this many pixels.
_ROUND_TRIP_PX = 1e-3

#: COLMAP's lenses end at 90 degrees off the axis; rays this close (their cosine) are left out.
_GRAZING = 1e-3

#: A ray this far off the middle of a view's bundle (its cosine) cannot be located with it.
_LEAST_COSINE = 0.05

#: Fewer corners than this fix neither a pose nor a lens, nor do corners on a line: the spread
#: across it must be at least this share of the spread along it.
_MIN_CORNERS = 6
_LINE = 1e-6
_NEARLY_LINE = 0.05

#: Image width for which the limits of `LensSettings` are meant.
_USUAL_WIDTH_PX = 640

#: A corner that misses by more than both is an outlier, if not more than a share of its view are.
_OUTLIER_SIGMA = 6.0
_OUTLIER_PX = 3.0
_OUTLIER_SHARE = 0.1

#: A view of which the lens does not see more than this share of corners is not located.
_LOST_SHARE = 0.2

#: Turns of fitting and dropping; a handful is usual.
_MAX_TURNS = 50

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

#: When a fit has converged, as a share of the cost that a step still gains; and where only a start
#: is wanted.
_COST_SHARE = 1e-15
_ROUGH = 1e-3
_MAX_STEPS = 200

#: A direction that is told by less than this share of what is told best is not known: of a lens of
#: many coefficients, views tell some combinations 1e-14 as well as others.
_ROUNDING = 3e-15


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
    ahead = _ahead(points_cam)
    if ahead.any():
        projected[ahead] = img_from_cam(camera, points_cam[ahead])
    return np.asarray(pixels - projected, np.float64)


def _ahead(points_cam: NDArray[np.float64]) -> NDArray[np.bool_]:
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
    located = _rank(camera, points, pixels, _plane_poses(points, rays, refine))
    if not located:
        return None
    return located[0][1], located[0][0], located[-1][0] if len(located) > 1 else np.inf


def _rank(
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


def _plane_poses(
    points_board: NDArray[np.float64], rays: NDArray[np.float64], refine: bool
) -> list[Pose]:
    """Return the up to two poses under which a plane's points (N, 3) lie on rays (N, 3)."""
    if len(rays) < 4 or _thinness(points_board) < _LINE:
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


def _thinness(points_board: NDArray[np.float64]) -> float:
    """Return the spread of points (N, 3) across their line, as a share of that along it."""
    if len(points_board) < 3:
        return 0.0
    spreads = np.linalg.svd(points_board - points_board.mean(axis=0), compute_uv=False)
    return float(spreads[1] / spreads[0]) if spreads[0] > 0 else 0.0


# --- Least squares over all views of one lens -------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Views of one lens, padded to one length.

    Attributes
    ----------
    points : (V, N, 3) float64
        The points of each view's board, metres.
    pixels : (V, N, 2) float64
        Where they were seen, pixels; NaN where not.
    """

    points: NDArray[np.float64]
    pixels: NDArray[np.float64]

    def of(self, views: NDArray[np.intp]) -> "Batch":
        """Return some of the views."""
        return Batch(self.points[views], self.pixels[views])

    def only(self, mask: NDArray[np.bool_]) -> "Batch":
        """Return the batch with the corners outside a mask (V, N) unseen."""
        return Batch(self.points, np.where(mask[..., None], self.pixels, np.nan))


@dataclass(frozen=True, slots=True, eq=False)
class LensAdjustment:
    """A lens and its views after least squares.

    Attributes
    ----------
    camera : Camera
        The lens.
    poses : (V, 3, 4) float64
        cam_from_board of each view.
    cost : float
        The robust sum of squares, pixels squared.
    information : (P, P) float64
        Of the lens for noise of one pixel, the poses being unknown; zero where it was held.
    scores : (V, P) float64
        What each view pulls at the lens: they add up to zero.
    """

    camera: Camera
    poses: NDArray[np.float64]
    cost: float
    information: NDArray[np.float64]
    scores: NDArray[np.float64]


def adjust_lens(
    camera: Camera,
    poses: NDArray[np.float64],
    batch: Batch,
    loss_px: float,
    free: NDArray[np.bool_],
    move_poses: bool = True,
    max_steps: int = _MAX_STEPS,
    tolerance: float = _COST_SHARE,
) -> LensAdjustment:
    """Adjust a lens and the poses of its views to the robust least squares (soft L1).

    Parameters
    ----------
    camera : Camera
        Start value of the lens.
    poses : (V, 3, 4) float64
        Start values of cam_from_board. Corners that the start does not see are left out.
    batch : Batch
        The views.
    loss_px : float
        Corners that miss by more than this count less than squared; infinite: plain least squares.
    free : (P,) bool
        Which parameters of the lens move.
    move_poses : bool
        Whether the poses do.
    max_steps : int
        After so many steps the result stands as it is.
    tolerance : float
        A step that lowers the cost by less than this share is the last.
    """
    mask = are_finite(batch_residuals(camera, poses, batch))
    problem = _LensProblem(batch.only(mask), mask, loss_px, free, move_poses)
    limits = Limits(max_steps, tolerance, max(1, mask.sum()) * FLOOR_PX**2, _ROUNDING)
    found = minimized(problem, problem.projected(camera, poses), limits)
    normal = problem.normal_equations(found.state)
    reduced = normal.reduced()
    yielded = np.einsum("vip,vi->vp", reduced.back, normal.blocks_right)
    return LensAdjustment(
        found.state.camera,
        found.state.poses,
        found.cost,
        reduced.information,
        normal.pulls - yielded,
    )


def batch_residuals(
    camera: Camera, poses: NDArray[np.float64], batch: Batch
) -> NDArray[np.float64]:
    """Return observed minus projected points (V, N, 2), pixels; NaN where unseen or invisible."""
    points_cam = _points_cam(poses, batch)
    wanted = are_finite(batch.pixels) & _ahead(points_cam)
    residuals = np.full(batch.pixels.shape, np.nan)
    if wanted.any():
        residuals[wanted] = batch.pixels[wanted] - img_from_cam(camera, points_cam[wanted])
    return residuals


def _points_cam(poses: NDArray[np.float64], batch: Batch) -> NDArray[np.float64]:
    turned = batch.points @ poses[:, :, :3].transpose(0, 2, 1)
    return np.asarray(turned + poses[:, None, :, 3])


@dataclass(frozen=True, slots=True, eq=False)
class _Projected:
    """A lens and its views' poses, and by what (S, 2) they miss the corners of the mask."""

    camera: Camera
    poses: NDArray[np.float64]
    residuals: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class _LensEquations(NormalEquations):
    """Also what each view pulls at the lens (V, P), its pose being held."""

    pulls: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class _LensProblem:
    """What least squares need: the lens's parameters are shared, blocks are the views' poses."""

    batch: Batch
    mask: NDArray[np.bool_]
    loss_px: float
    free: NDArray[np.bool_]
    move_poses: bool

    def projected(self, camera: Camera, poses: NDArray[np.float64]) -> _Projected:
        return _Projected(camera, poses, batch_residuals(camera, poses, self.batch)[self.mask])

    def cost(self, state: _Projected) -> float:
        return float(soft_l1((state.residuals**2).sum(axis=1), self.loss_px).sum())

    def moved(self, state: _Projected, step: Step) -> _Projected | None:
        params = state.camera.params + step.shared
        if not np.isfinite(params).all() or params[_focal_indices(state.camera.model)].min() <= 0:
            return None
        camera = replace(state.camera, params=params)
        return self.projected(camera, turned_pose(state.poses, step.blocks))

    def normal_equations(self, state: _Projected) -> _LensEquations:
        gram = self._grams(state)
        of_poses, of_lens = slice(0, POSE), slice(POSE, -1)
        normal = _LensEquations(
            gram[:, of_lens, of_lens].sum(axis=0),
            gram[:, of_lens, -1].sum(axis=0),
            gram[:, of_poses, of_poses],
            gram[:, of_poses, -1],
            gram[:, of_poses, of_lens],
            gram[:, of_lens, -1],
        )
        if not self.move_poses:
            for part in (normal.blocks, normal.blocks_right, normal.mixed):
                part[:] = 0.0
        return normal

    def _grams(self, state: _Projected) -> NDArray[np.float64]:
        """Return products (V, 6 + P + 1, 6 + P + 1) of columns by pose, lens, and residuals."""
        points_cam = _points_cam(state.poses, self.batch)[self.mask]  # (S, 3)
        by_point, by_parameter = lens_derivatives(state.camera, points_cam)
        turned = points_cam - state.poses[np.nonzero(self.mask)[0], :, 3]
        # d(omega x X) = -[X] omega, and rows of by_point times -[X] are X cross row.
        by_turn = np.cross(turned[:, None, :], by_point)
        rows, residuals = soft_l1_rows(
            np.concatenate([by_turn, by_point, by_parameter * self.free], axis=2),
            state.residuals,
            self.loss_px,
        )
        rows = np.concatenate([rows, residuals[..., None]], axis=2)
        jacobian = np.zeros((*self.mask.shape, *rows.shape[1:]))
        jacobian[self.mask] = rows
        jacobian = jacobian.reshape(len(self.mask), 2 * self.mask.shape[1], rows.shape[2])
        return np.asarray(jacobian.transpose(0, 2, 1) @ jacobian)


# --- Seeds ------------------------------------------------------------------------------------


def _colmap(model: str, focal_px: float, size_px: tuple[int, int]) -> pycolmap.Camera:
    return pycolmap.Camera.create_from_model_name(1, model, focal_px, *size_px)


def _focal_indices(model: str) -> list[int]:
    return list(_colmap(model, 1.0, (1, 1)).focal_length_idxs())


def _principal_indices(model: str) -> list[int]:
    return list(_colmap(model, 1.0, (1, 1)).principal_point_idxs())


def _shape_indices(model: str) -> list[int]:
    return list(_colmap(model, 1.0, (1, 1)).extra_params_idxs())


def make_start(name: str, model: str, focal_px: float, size_px: tuple[int, int]) -> Camera:
    """Return a camera at the origin with a focal length and no distortion, or next to none."""
    params = np.array(_colmap(model, focal_px, size_px).params)
    if model in _FIRST_SHAPE:
        params[_shape_indices(model)] = _FIRST_SHAPE[model]
    return Camera(name, model, *size_px, params, np.eye(3, 4))


def imitate(camera: Camera, model: str, pixels: NDArray[np.float64]) -> Camera:
    """Return a lens of another model that does about the same at some pixels (S, 2).

    The focal length and up to two coefficients of its shape are fitted to the rays; the others
    stay zero.
    """
    focal_px = float(camera.params[0])
    start = make_start(camera.name, model, focal_px, (camera.width_px, camera.height_px))
    params = start.params.copy()
    params[_principal_indices(model)] = camera.params[_principal_indices(camera.model)]
    start = replace(start, params=params)
    free = np.zeros(len(params), np.bool_)
    free[[*_focal_indices(model), *_shape_indices(model)[:2]]] = True
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
            _plane_poses(batch.points[index, use], rays[index, use], refine)
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
                params[_shape_indices(generic)] = shape
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
        free[_principal_indices(model)] = False
        free[_shape_indices(model)[2:]] = False
        fitted = adjust_lens(start, poses[use], some.of(use), 1.0, free, tolerance=_ROUGH)
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


# --- Fitting and dropping ---------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class LensView:
    """One board in one image of one of the cameras that share a lens."""

    owner: int
    image: str
    board: int
    pixels: NDArray[np.float64] = field(repr=False)


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
) -> tuple[list[LensView], dict[tuple[int, str], str]]:
    """Return the views that can be used, in natural order, and why others cannot.

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
    views, unusable = [], {}
    for owner, camera in enumerate(seen):
        for sighting in camera.sightings:
            if sighting.instant is not None and camera.is_still:
                continue
            points = boards[sighting.board].points_board[is_seen(sighting.pixels)]
            label = view_label(boards, sighting.image, sighting.board)
            if len(points) < _MIN_CORNERS:
                unusable[owner, label] = (
                    f"only {len(points)} corners seen, expected {_MIN_CORNERS} or more"
                )
            elif _thinness(points) < _NEARLY_LINE:
                unusable[owner, label] = f"its {len(points)} corners lie on a line"
            else:
                views.append(LensView(owner, sighting.image, sighting.board, sighting.pixels))
    views.sort(key=lambda view: (seen[view.owner].name, natural_order(view.image), view.board))
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


def view_label(boards: Sequence[Board], image: str, board: int) -> str:
    """Return a view's name for messages: its image, and which board if there are several."""
    return image if len(boards) == 1 else f"{image}, {boards[board].name}"


def who(seen: Sequence[Observations]) -> str:
    """Return the name of a camera, or of the cameras that share a lens, for messages."""
    names = ", ".join(repr(camera.name) for camera in seen)
    return f"camera {names}" if len(seen) == 1 else f"cameras {names} (one lens)"


def make_batch(boards: Sequence[Board], views: Sequence[LensView]) -> Batch:
    """Return views padded to the longest board."""
    longest = max((len(boards[view.board].points_board) for view in views), default=0)
    points = np.zeros((len(views), longest, 3))
    pixels = np.full((len(views), longest, 2), np.nan)
    for index, view in enumerate(views):
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
    rough[_principal_indices(model)] = False
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
        free, tolerance = (rough, _ROUGH) if is_rough else (every, _COST_SHARE)
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
    is_few = (n_corners - n_fitting <= allowed) & (n_fitting >= _MIN_CORNERS)
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
    views: Sequence[LensView],
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
        mine = [index for index, view in enumerate(views) if view.owner == owner]
        for index in mine:
            view = views[index]
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
                _warnings(fit, batch, sigmas) if is_free else (),
                fit.noise_px,
                rms(residuals[used]),
                sigmas,
            )
        )
    return fitted


# --- What the views cannot tell ---------------------------------------------------------------


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
    focal = _focal_indices(fit.lens.camera.model)
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
                for error_px, pose in _rank(
                    camera, points, pixels, _plane_poses(points, rays, refine)
                )
                if np.rad2deg(angle_between(pose, fit.lens.poses[index])) > _OTHER_TILT_DEG
            ]
            evidence = len(pixels) * (min(others, default=np.inf) ** 2 - best_px**2) / sigma_px**2
            if evidence > is_clear**2:
                break
        else:
            count += 1
    return count


def _warnings(fit: Fit, batch: Batch, sigmas: NDArray[np.float64]) -> tuple[str, ...]:
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
    focal = _focal_indices(camera.model)
    share = float((sigmas[focal] / camera.params[focal]).max())
    if share > _FOCAL_WARNED:
        warnings.append(
            f"the focal length is known to {100 * share:.1f} % only; tilt the board more, to "
            "different sides"
        )
    return tuple(warnings)
