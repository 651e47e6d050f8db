"""One lens and the poses of many boards adjusted together."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.colmap_library import pycolmap
from hybridve.calib.lens import img_from_cam
from hybridve.calib.pose import turned_pose
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
from hybridve.calib.solving.locate import are_ahead, are_finite

#: When a fit has converged, as a share of the cost that a step still gains; and where only a start
#: is wanted.
COST_SHARE = 1e-15
ROUGH = 1e-3
_MAX_STEPS = 200

#: A direction that is told by less than this share of what is told best is not known: of a lens of
#: many coefficients, views tell some combinations 1e-14 as well as others.
_ROUNDING = 3e-15


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
    tolerance: float = COST_SHARE,
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
    wanted = are_finite(batch.pixels) & are_ahead(points_cam)
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
        if not np.isfinite(params).all() or params[focal_indices(state.camera.model)].min() <= 0:
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


def colmap_camera(model: str, focal_px: float, size_px: tuple[int, int]) -> pycolmap.Camera:
    """Return COLMAP's camera of a model, as it begins."""
    return pycolmap.Camera.create_from_model_name(1, model, focal_px, *size_px)


def focal_indices(model: str) -> list[int]:
    """Return which parameters of a model are focal lengths."""
    return list(colmap_camera(model, 1.0, (1, 1)).focal_length_idxs())


def principal_indices(model: str) -> list[int]:
    """Return which parameters of a model are the principal point."""
    return list(colmap_camera(model, 1.0, (1, 1)).principal_point_idxs())


def shape_indices(model: str) -> list[int]:
    """Return which parameters of a model bend rays."""
    return list(colmap_camera(model, 1.0, (1, 1)).extra_params_idxs())
