"""Boards placed before cameras: by least squares over poses, a common scale and focal lengths.

Board points are multiplied by one scale, placed in the world once a moment, and seen by cameras of
which some may be let move or zoom. The placements are eliminated
(`hybridve.calib.solving.least_squares`); all views are evaluated at once, since a check tries many
alternatives.

Poses T are adjusted as exp(xi) T with xi = (omega, v) in the frame they lead to; those of boards
turn about the board's own origin, so that a world far from its boards loses nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.lens import img_from_cam, parameter_names
from hybridve.calib.pose import moved_pose, turned_pose
from hybridve.calib.solving.bundle import POSE, lens_derivatives
from hybridve.calib.solving.least_squares import (
    FLOOR_PX,
    Limits,
    NormalEquations,
    Step,
    minimized,
    soft_l1,
    soft_l1_weights,
)

#: Step of the central differences of a lens by its rays, relative.
_RAY_STEP = 1e-6

#: A point behind its camera misses by so many image widths.
_BEHIND_WIDTHS = 10.0

_COST_SHARE = 1e-7
_MAX_STEPS = 60

#: A step changes the logarithm of a scale or focal length by this at most.
_LARGEST_CHANGE = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """What cameras saw of boards, padded to one length.

    Attributes
    ----------
    camera, place : (V,) int
        Which camera, and which placement of a board, each view is of.
    points : (V, N, 3) float64
        The board's points in its own frame, metres.
    pixels : (V, N, 2) float64
        Where they were seen; NaN where not.
    """

    camera: NDArray[np.intp]
    place: NDArray[np.intp]
    points: NDArray[np.float64]
    pixels: NDArray[np.float64]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which points (V, N) were seen."""
        return np.asarray(np.isfinite(self.pixels).all(axis=2))

    def of(self, chosen: NDArray[np.bool_]) -> "Views":
        """Return some of the views."""
        return Views(
            self.camera[chosen], self.place[chosen], self.points[chosen], self.pixels[chosen]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Cameras and boards in one world.

    Attributes
    ----------
    cameras : tuple of Camera
        Where they stand, and their lenses.
    boards : (F, 3, 4) float64
        world_from_board of each placement, for points that are multiplied by `scale`.
    scale : float
        How many times larger than in truth the boards are in this world.
    """

    cameras: tuple[Camera, ...]
    boards: NDArray[np.float64]
    scale: float

    @property
    def poses(self) -> NDArray[np.float64]:
        """Return cam_from_world of the cameras: (C, 3, 4)."""
        return np.array([camera.cam_from_world for camera in self.cameras])


def residuals_of(views: Views, placed: Placed) -> NDArray[np.float64]:
    """Return observed minus projected points (V, N, 2), pixels; NaN where not seen.

    A point behind its camera misses by more than the image.
    """
    points_cam = _points(views, placed)[1]
    residuals = np.full(views.pixels.shape, np.nan)
    seen = views.seen
    for index, camera in enumerate(placed.cameras):
        own = seen & (views.camera == index)[:, None]
        if own.any():
            residuals[own] = views.pixels[own] - imaged(camera, points_cam[own])
    return residuals


def _points(views: Views, placed: Placed) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points (V, N, 3) relative to their board's origin, world axes, and in cameras."""
    boards = placed.boards[views.place]
    arms = placed.scale * views.points @ boards[:, :, :3].transpose(0, 2, 1)
    poses = placed.poses[views.camera]
    world = arms + boards[:, None, :, 3]
    return arms, world @ poses[:, :, :3].transpose(0, 2, 1) + poses[:, None, :, 3]


def imaged(camera: Camera, points_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where a camera sees points (N, 3) of its own frame: (N, 2) pixels.

    Points behind it, or that its lens sees nowhere, are told far outside the image.
    """
    pixels = np.full((len(points_cam), 2), -_BEHIND_WIDTHS * camera.width_px)
    ahead = points_cam[:, 2] > 0
    if ahead.any():
        found = img_from_cam(camera, points_cam[ahead])
        pixels[ahead] = np.where(np.isfinite(found), found, -_BEHIND_WIDTHS * camera.width_px)
    return pixels


def _by_point(camera: Camera, points_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how the image (S, 2, 3) of points changes, pixels a metre; zero behind the camera."""
    found = np.zeros((len(points_cam), 2, 3))
    ahead = points_cam[:, 2] > 0
    if not ahead.any():
        return found
    depth = points_cam[ahead, 2:]
    rays = np.column_stack([points_cam[ahead, :2] / depth, np.ones(len(depth))])
    steps = _RAY_STEP * (1.0 + np.abs(rays[:, :2]))
    by_ray = np.zeros((len(rays), 2, 2))
    for axis in range(2):
        shift = np.zeros_like(rays)
        shift[:, axis] = steps[:, axis]
        difference = img_from_cam(camera, rays + shift) - img_from_cam(camera, rays - shift)
        by_ray[:, :, axis] = difference / (2.0 * steps[:, axis, None])
    by_ray = np.nan_to_num(by_ray / depth[:, None])
    # A lens images directions: along the ray nothing changes.
    along = -(by_ray @ rays[:, :2, None])
    found[ahead] = np.concatenate([by_ray, along], axis=2)
    return found


def place_boards(
    views: Views,
    start: Placed,
    moving: Sequence[int] = (),
    zooming: Sequence[int] = (),
    *,
    scaled: bool = True,
    loss_px: float = np.inf,
) -> Placed:
    """Place boards so that their points are reprojected best.

    Parameters
    ----------
    views : Views
        What was seen; placements that no view is of stay.
    start : Placed
        Start values.
    moving, zooming : sequence of int
        Cameras whose poses, and whose focal lengths (by one factor each), are adjusted too.
    scaled : bool
        Whether the scale is.
    loss_px : float
        Points that miss by more count less than squared (soft L1).
    """
    problem = _Placement(views, tuple(moving), tuple(zooming), scaled, loss_px)
    limits = Limits(_MAX_STEPS, _COST_SHARE, views.pixels.size * FLOOR_PX**2)
    return minimized(problem, problem.projected(start), limits).state.placed


@dataclass(frozen=True, slots=True, eq=False)
class _Projected:
    """Cameras and boards, and by what (V, N, 2) they miss what was seen."""

    placed: Placed
    residuals: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class _Placement:
    """What least squares need: cameras, focal lengths and scale are shared, blocks are placements.

    All is computed for every view at once: columns of a view are its camera's pose, the board's,
    the focal length's and the scale's logarithm, and last its residuals.
    """

    views: Views
    moving: tuple[int, ...]
    zooming: tuple[int, ...]
    scaled: bool
    loss_px: float

    def projected(self, placed: Placed) -> _Projected:
        return _Projected(placed, residuals_of(self.views, placed))

    def cost(self, state: _Projected) -> float:
        squares = np.nansum(state.residuals**2, axis=2)
        return float(soft_l1(squares, self.loss_px).sum())

    def normal_equations(self, state: _Projected) -> NormalEquations:
        views = self.views
        jacobian = _jacobian(views, state.placed, state.residuals, self.loss_px)
        gram = jacobian.transpose(0, 2, 1) @ jacobian  # (V, 15, 15)
        n_shared = POSE * len(self.moving) + len(self.zooming) + self.scaled
        normal = NormalEquations.zeros(n_shared, len(state.placed.boards), POSE)
        board = slice(POSE, 2 * POSE)
        np.add.at(normal.blocks, views.place, gram[:, board, board])
        np.add.at(normal.blocks_right, views.place, gram[:, board, -1])
        for index in np.unique(views.camera):
            taken, columns = self._columns(int(index))
            if not taken:
                continue
            own = views.camera == index
            mine = gram[own]
            normal.shared[np.ix_(columns, columns)] += mine[:, taken][:, :, taken].sum(axis=0)
            normal.shared_right[columns] += mine[:, taken, -1].sum(axis=0)
            mixed = np.zeros((len(mine), POSE, n_shared))
            mixed[:, :, columns] = mine[:, board][:, :, taken]
            np.add.at(normal.mixed, views.place[own], mixed)
        return normal

    def _columns(self, camera: int) -> tuple[list[int], list[int]]:
        """Return a camera's columns among those of its views, and among the shared unknowns."""
        taken: list[int] = []
        columns: list[int] = []
        n_moving = POSE * len(self.moving)
        if camera in self.moving:
            first = POSE * self.moving.index(camera)
            taken += range(POSE)
            columns += range(first, first + POSE)
        if camera in self.zooming:
            taken.append(2 * POSE)
            columns.append(n_moving + self.zooming.index(camera))
        if self.scaled:
            taken.append(2 * POSE + 1)
            columns.append(n_moving + len(self.zooming))
        return taken, columns

    def moved(self, state: _Projected, step: Step) -> _Projected:
        cameras = list(state.placed.cameras)
        for number, index in enumerate(self.moving):
            change = step.shared[POSE * number : POSE * (number + 1)]
            pose = moved_pose(cameras[index].cam_from_world, change)
            cameras[index] = replace(cameras[index], cam_from_world=pose)
        factors = np.exp(np.clip(step.shared, -_LARGEST_CHANGE, _LARGEST_CHANGE))
        first = POSE * len(self.moving)
        for number, index in enumerate(self.zooming):
            cameras[index] = zoomed(cameras[index], float(factors[first + number]))
        scale = state.placed.scale * (float(factors[-1]) if self.scaled else 1.0)
        boards = turned_pose(state.placed.boards, step.blocks)
        return self.projected(Placed(tuple(cameras), boards, scale))


def zoomed(camera: Camera, factor: float) -> Camera:
    """Return a camera with its focal lengths multiplied by a factor."""
    params = camera.params.copy()
    for index, name in enumerate(parameter_names(camera.model)):
        if name in ("f", "fx", "fy"):
            params[index] *= factor
    return replace(camera, params=params)


def _jacobian(
    views: Views, placed: Placed, residuals: NDArray[np.float64], loss_px: float
) -> NDArray[np.float64]:
    """Return the derivatives (V, 2 N, 15) of the images in the columns of `_Placement`."""
    arms, points_cam = _points(views, placed)
    rotations = placed.poses[views.camera][:, :, :3]
    seen = views.seen
    by_point = np.zeros((*seen.shape, 2, 3))
    by_focal = np.zeros((*seen.shape, 2))
    for index, camera in enumerate(placed.cameras):
        own = seen & (views.camera == index)[:, None]
        if own.any():
            by_point[own] = _by_point(camera, points_cam[own])
            by_focal[own] = views.pixels[own] - residuals[own] - camera.pinhole[:2, 2]
    by_world = by_point @ rotations[:, None]
    columns = [
        np.cross(points_cam[:, :, None, :], by_point),
        by_point,
        np.cross(arms[:, :, None, :], by_world),
        by_world,
        by_focal[..., None],
        by_world @ arms[..., None],
        np.nan_to_num(residuals)[..., None],
    ]
    jacobian = np.concatenate(columns, axis=3)
    jacobian[~seen] = 0.0
    squares = np.nan_to_num(residuals**2).sum(axis=2)
    jacobian *= soft_l1_weights(squares, loss_px)[..., None, None]
    return np.asarray(jacobian.reshape(len(jacobian), -1, jacobian.shape[3]))


def solve_scaled(
    matrix: NDArray[np.float64], right: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return x of ``matrix @ x = right`` and the inverse, without directions that nothing tells.

    Parameters
    ----------
    matrix : (A, A) float64
        Symmetric, positive semidefinite; its unknowns may be of any unit.
    right : (A,) float64
        The right side.
    """
    size = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    size[size == 0] = 1.0
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    known = values > 1e-12 * max(float(values.max(initial=0.0)), 1e-300)
    half = vectors[:, known] / np.sqrt(values[known])
    inverse = half @ half.T / np.outer(size, size)
    return inverse @ right, inverse


def information_of(
    views: Views, placed: Placed
) -> tuple[NDArray[np.float64], NDArray[np.float64], list[slice]]:
    """Return what views tell of all parameters of their cameras, wherever the boards are.

    Returns
    -------
    information : (P, P) float64
        For noise of one pixel: camera by camera the pose's (omega, v), then the lens's parameters
        in COLMAP's order.
    gradient : (P,) float64
        Half the derivative of the sum of squared residuals by these.
    of_camera : list of slice
        The columns of each camera.
    """
    residuals = np.nan_to_num(residuals_of(views, placed))
    arms, points_cam = _points(views, placed)
    ends = np.cumsum([0, *(POSE + len(camera.params) for camera in placed.cameras)])
    of_camera = [slice(int(a), int(b)) for a, b in pairwise(ends)]
    normal = NormalEquations.zeros(int(ends[-1]), len(placed.boards), POSE)
    seen = views.seen
    for index, (camera, span) in enumerate(zip(placed.cameras, of_camera, strict=True)):
        mine = views.camera == index
        own = seen[mine]
        if not own.any():
            continue
        points = points_cam[mine][own]
        by_point, by_lens = lens_derivatives(camera, points)
        by_world = by_point @ camera.cam_from_world[:, :3]
        columns = np.concatenate(
            [
                *(np.cross(points[:, None, :], by_point), by_point, by_lens),
                *(np.cross(arms[mine][own][:, None, :], by_world), by_world),
                residuals[mine][own][..., None],
            ],
            axis=2,
        )
        jacobian = np.zeros((*own.shape, 2, columns.shape[2]))
        jacobian[own] = np.nan_to_num(columns)
        jacobian = jacobian.reshape(len(own), -1, columns.shape[2])
        gram = jacobian.transpose(0, 2, 1) @ jacobian
        n_own, places = span.stop - span.start, views.place[mine]
        board = slice(n_own, n_own + POSE)
        normal.shared[span, span] += gram[:, :n_own, :n_own].sum(axis=0)
        normal.shared_right[span] += gram[:, :n_own, -1].sum(axis=0)
        np.add.at(normal.blocks, places, gram[:, board, board])
        np.add.at(normal.blocks_right, places, gram[:, board, -1])
        np.add.at(normal.mixed[:, :, span], places, gram[:, board, :n_own])
    reduced = normal.reduced()
    return reduced.information, -reduced.right, of_camera
