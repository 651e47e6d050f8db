"""The joint adjustment of a rig: lenses, cameras, boards and their bodies, all at once.

A board point goes through four frames: board, body (boards that are mounted together), rig (the
frame in which one body pose is held), camera; then through the lens::

    pixel = lens_c( cam_from_rig_c  rig_from_body_p  body_from_board_b  point )

The lens models are COLMAP's. The poses of the bodies, of which there are hundreds, are eliminated
(`hybridve.calib.solving.least_squares`), so that each step solves for the cameras alone; what is
left of the normal matrix is the information that the pictures hold about the cameras, from which
their covariance follows (`hybridve.calib.solving.covariance`). COLMAP's own adjustment has no
boards mounted together, no lens common to several cameras of a rig, and gives no covariance of a
rig.

A pose T is adjusted as exp(xi) T with xi = (omega, v) in the frame it leads to:
``x_true = x + omega x x + v``, radians and metres.

This work is based on: Triggs, McLauchlan, Hartley and Fitzgibbon, *Bundle adjustment: a modern
synthesis*, 2000; Barfoot, *State estimation for robotics*, 2017, chapter 7 (poses).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import img_by_params, img_from_cam
from hybridve.calib.pose import Pose, moved_pose, transform
from hybridve.calib.solving.least_squares import (
    FLOOR_PX,
    Limits,
    NormalEquations,
    Step,
    minimized,
    soft_l1,
    soft_l1_weights,
)

#: Parameters of a pose.
POSE = 6

#: Steps of central differences: of coordinates by depth, and of lens parameters by their size (and
#: at least by one). Rounding, about 1e-13 px, and curvature both stay below 1e-8 of a derivative.
_COORDINATE_STEP = 1e-6
_PARAMETER_STEP = 1e-6

#: When the adjustment has converged: what is left to gain is rounding.
_COST_SHARE = 1e-12
_MAX_STEPS = 100


@dataclass(frozen=True, slots=True, eq=False)
class BundleView:
    """One board in one image.

    Attributes
    ----------
    camera : int
        Which camera took it.
    pose : int
        Which pose the board's body had then: views of one pose saw it in one place.
    board : int
        Which board it is.
    pixels : (N, 2) float64
        Its points in pixels, pixel centre at 0.5; NaN where not seen.
    image : str
        For messages.
    sigma_px : float
        Standard deviation of a coordinate by which its points are weighed.
    """

    camera: int
    pose: int
    board: int
    pixels: NDArray[np.float64]
    image: str
    sigma_px: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """What is to be adjusted, with start values; or what has been.

    Attributes
    ----------
    points_board : tuple of (N, 3) float64
        The points of each board in its own frame, metres; they stay.
    cameras : tuple of Camera
        Their "world" is the rig's frame.
    rig_from_body : tuple of (3, 4) float64
        One for each pose that a body had.
    body_from_board : tuple of (3, 4) float64
        Where each board sits on its body.
    views : tuple of BundleView
        What was seen.
    held_pose : int
        The pose that stays, and so defines the rig's frame.
    lens_of : tuple of int
        By camera the number of its lens; cameras with the same number share one.
    fixed_lenses : frozenset of int
        Lenses that stay.
    held_boards : frozenset of int
        Boards that stay on their bodies: one of each body at least.
    """

    points_board: tuple[NDArray[np.float64], ...]
    cameras: tuple[Camera, ...]
    rig_from_body: tuple[Pose, ...]
    body_from_board: tuple[Pose, ...]
    views: tuple[BundleView, ...]
    held_pose: int
    lens_of: tuple[int, ...]
    fixed_lenses: frozenset[int]
    held_boards: frozenset[int]


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """A bundle after its adjustment.

    Attributes
    ----------
    bundle : Bundle
        With the adjusted cameras, boards and poses.
    residuals_px : tuple of (N, 2) float64
        Observed minus projected points of each view; NaN where not seen.
    information : (A, A) float64
        Of the adjusted parameters of cameras, lenses and boards, for points as noisy as their views
        say (`BundleView.sigma_px`): the normal matrix without the bodies' poses, in the columns of
        `layout`.
    layout : Layout
        Which column is what.
    n_steps : int
        Steps that it took.
    """

    bundle: Bundle
    residuals_px: tuple[NDArray[np.float64], ...]
    information: NDArray[np.float64]
    layout: "Layout"
    n_steps: int


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """The columns of the parameters that are adjusted together.

    Attributes
    ----------
    of_camera : tuple of slice
        The pose of each camera, 6 columns.
    of_lens : dict of int to slice
        The parameters of each lens that is adjusted.
    of_board : dict of int to slice
        The place on its body of each board that is adjusted, 6 columns.
    size : int
        How many columns there are.
    """

    of_camera: tuple[slice, ...]
    of_lens: dict[int, slice]
    of_board: dict[int, slice]
    size: int


def make_layout(bundle: Bundle) -> Layout:
    """Return the columns of a bundle's parameters: cameras, then lenses, then boards."""
    position = 0

    def take(count: int) -> slice:
        nonlocal position
        position += count
        return slice(position - count, position)

    of_camera = tuple(take(POSE) for _ in bundle.cameras)
    of_lens: dict[int, slice] = {}
    for camera, lens in zip(bundle.cameras, bundle.lens_of, strict=True):
        if lens not in of_lens and lens not in bundle.fixed_lenses:
            of_lens[lens] = take(len(camera.params))
    of_board = {
        board: take(POSE)
        for board in range(len(bundle.points_board))
        if board not in bundle.held_boards
    }
    return Layout(of_camera, of_lens, of_board, position)


def adjust(bundle: Bundle, loss_px: float = np.inf) -> Adjusted:
    """Adjust a bundle to the least squares of its residuals.

    Parameters
    ----------
    bundle : Bundle
        Start values; every pose should be seen by some view.
    loss_px : float
        Points that miss by more than this many pixels count less than squared (soft L1); infinite
        for plain least squares.

    Raises
    ------
    CalibrationError
        If the start values project points to nowhere.
    """
    layout = make_layout(bundle)
    groups = _groups(bundle)
    start = _Projected(bundle, _residuals(bundle, groups))
    problem = _Adjustment(layout, groups, loss_px)
    if not np.isfinite(problem.cost(start)):
        every = _by_view(bundle, groups, start.residuals)
        lost = next(
            view.image
            for view, missed in zip(bundle.views, every, strict=True)
            if not np.isfinite(missed[is_seen(view.pixels)]).all()
        )
        raise CalibrationError(
            f"the joint adjustment cannot start: its lens does not see the board in {lost}"
        )
    floor = sum(map(len, start.residuals)) * FLOOR_PX**2
    found = minimized(problem, start, Limits(_MAX_STEPS, _COST_SHARE, floor))
    adjusted = found.state
    return Adjusted(
        adjusted.bundle,
        _by_view(adjusted.bundle, groups, adjusted.residuals),
        problem.normal_equations(adjusted).reduced().information,
        layout,
        found.n_steps,
    )


def view_residuals(bundle: Bundle) -> tuple[NDArray[np.float64], ...]:
    """Return observed minus projected points (N, 2) of each view, pixels; NaN where not seen."""
    groups = _groups(bundle)
    return _by_view(bundle, groups, _residuals(bundle, groups))


def total_cost(bundle: Bundle, loss_px: float = np.inf) -> float:
    """Return the robust sum of squares of all residuals alike; NaN where a seen point is unseen."""
    residuals = np.concatenate(_residuals(bundle, _groups(bundle)))
    return float(soft_l1((residuals**2).sum(axis=1), loss_px).sum())


def even_information(bundle: Bundle) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what tells how an adjustment errs in which all points count alike.

    Returns
    -------
    information : (A, A) float64
        Its normal matrix without the bodies' poses, for points with a noise of one pixel, in the
        columns of `make_layout`.
    spread : (A, A) float64
        The covariance of its gradient, for points as noisy as their views say
        (`BundleView.sigma_px`): equal to `information` where they say one pixel. The parameters'
        covariance is ``inv(information) @ spread @ inv(information)``.
    """
    layout = make_layout(bundle)

    def normal(power: int) -> NormalEquations:
        views = tuple(replace(view, sigma_px=view.sigma_px**power) for view in bundle.views)
        groups = _groups(replace(bundle, views=views))
        start = _Projected(bundle, _residuals(bundle, groups))
        return _Adjustment(layout, groups, np.inf).normal_equations(start)

    even, noisy = normal(0), normal(-1)  # a view counts by the inverse of what it says
    reduced = even.reduced()
    information, back = reduced.information, reduced.back
    crossed = np.einsum("fia,fib->ab", back, noisy.mixed, optimize=True)
    of_poses = np.einsum("fia,fij,fjb->ab", back, noisy.blocks, back, optimize=True)
    spread = noisy.shared - crossed - crossed.T + of_poses
    return information, (spread + spread.T) / 2.0


# --- Points, many at once ---------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """All that one camera saw of one board: S points of V views."""

    camera: int
    board: int
    poses: NDArray[np.intp]  # (V,) in the bundle
    view: NDArray[np.intp]  # (S,) of each point its view in the bundle, ...
    member: NDArray[np.intp]  # (S,) ... and in this group
    point: NDArray[np.intp]  # (S,) of the board
    pixels: NDArray[np.float64]  # (S, 2)
    sigma_px: NDArray[np.float64]  # (S,)


def _groups(bundle: Bundle) -> list[_Group]:
    members: dict[tuple[int, int], list[int]] = {}
    for number, view in enumerate(bundle.views):
        members.setdefault((view.camera, view.board), []).append(number)
    groups = []
    for (camera, board), numbers in sorted(members.items()):
        pixels = np.array([bundle.views[number].pixels for number in numbers])  # (V, N, 2)
        member, point = np.nonzero(np.isfinite(pixels).all(axis=2))
        groups.append(
            _Group(
                camera,
                board,
                np.array([bundle.views[number].pose for number in numbers]),
                np.array(numbers)[member],
                member,
                point,
                pixels[member, point],
                np.array([bundle.views[number].sigma_px for number in numbers])[member],
            )
        )
    return groups


def _by_view(
    bundle: Bundle, groups: Sequence[_Group], rows: Sequence[NDArray[np.float64]]
) -> tuple[NDArray[np.float64], ...]:
    """Return rows (S, 2) of what was seen in each group by view (N, 2), NaN elsewhere."""
    every = tuple(np.full(view.pixels.shape, np.nan) for view in bundle.views)
    for group, own in zip(groups, rows, strict=True):
        ends = np.flatnonzero(np.diff(group.member)) + 1
        for view, point, row in zip(
            np.split(group.view, ends),
            np.split(group.point, ends),
            np.split(own, ends),
            strict=True,
        ):
            if len(view):
                every[view[0]][point] = row
    return every


def _points_of(
    bundle: Bundle, group: _Group
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return a group's points (S, 3) in the frames of body, rig and camera."""
    points_board = bundle.points_board[group.board]
    points_body = transform(bundle.body_from_board[group.board], points_board)[group.point]
    rig_from_body = np.array([bundle.rig_from_body[pose] for pose in group.poses])[group.member]
    points_rig = (rig_from_body[:, :, :3] @ points_body[:, :, None])[..., 0] + rig_from_body[..., 3]
    return (
        points_body,
        points_rig,
        transform(bundle.cameras[group.camera].cam_from_world, points_rig),
    )


def _residuals(bundle: Bundle, groups: Sequence[_Group]) -> list[NDArray[np.float64]]:
    """Return observed minus projected points (S, 2) of each group, pixels."""
    return [
        group.pixels - img_from_cam(bundle.cameras[group.camera], _points_of(bundle, group)[2])
        for group in groups
    ]


# --- One step ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Projected:
    """A bundle, and by what (S, 2) it misses the points of each group."""

    bundle: Bundle
    residuals: list[NDArray[np.float64]]


@dataclass(frozen=True, slots=True, eq=False)
class _Adjustment:
    """What least squares need: shared are the columns of the layout, blocks are the poses."""

    layout: Layout
    groups: Sequence[_Group]
    loss_px: float

    def cost(self, state: _Projected) -> float:
        """Return the robust sum of squares, weighed; NaN where a seen point has no image."""
        squares = (np.concatenate(state.residuals) ** 2).sum(axis=1)
        weights = np.concatenate([group.sigma_px**-2.0 for group in self.groups])
        return float(weights @ soft_l1(squares, self.loss_px))

    def normal_equations(self, state: _Projected) -> NormalEquations:
        bundle, layout = state.bundle, self.layout
        normal = NormalEquations.zeros(layout.size, len(bundle.rig_from_body), POSE)
        for group, missed in zip(self.groups, state.residuals, strict=True):
            jacobian, columns = _jacobian(bundle, layout, group)
            weights = soft_l1_weights((missed**2).sum(axis=1), self.loss_px) / group.sigma_px
            rows = np.concatenate([jacobian, missed[:, :, None]], axis=2) * weights[:, None, None]
            gram = _grams(rows, group)  # (V, n + 6 + 1, n + 6 + 1)
            n = len(columns)
            of_all = gram.sum(axis=0)
            normal.shared[np.ix_(columns, columns)] += of_all[:n, :n]
            normal.shared_right[columns] += of_all[:n, -1]
            for pose, own in zip(group.poses, gram, strict=True):
                normal.blocks[pose] += own[n:-1, n:-1]
                normal.blocks_right[pose] += own[n:-1, -1]
                normal.mixed[pose][:, columns] += own[n:-1, :n]
        for part in (normal.blocks, normal.blocks_right, normal.mixed):
            part[bundle.held_pose] = 0.0
        return normal

    def moved(self, state: _Projected, step: Step) -> _Projected:
        bundle, layout = state.bundle, self.layout
        cameras = []
        for index, camera in enumerate(bundle.cameras):
            lens = layout.of_lens.get(bundle.lens_of[index])
            pose = moved_pose(camera.cam_from_world, step.shared[layout.of_camera[index]])
            params = camera.params if lens is None else camera.params + step.shared[lens]
            cameras.append(replace(camera, params=params, cam_from_world=pose))
        poses = list(moved_pose(np.array(bundle.rig_from_body), step.blocks))
        poses[bundle.held_pose] = bundle.rig_from_body[bundle.held_pose]
        boards = list(bundle.body_from_board)
        for board, span in layout.of_board.items():
            boards[board] = moved_pose(boards[board], step.shared[span])
        moved = replace(
            bundle,
            cameras=tuple(cameras),
            rig_from_body=tuple(poses),
            body_from_board=tuple(boards),
        )
        return _Projected(moved, _residuals(moved, self.groups))


def _jacobian(
    bundle: Bundle, layout: Layout, group: _Group
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return the derivatives of a group's pixels by what is adjusted.

    Returns
    -------
    jacobian : (S, 2, n + 6) float64
        By the parameters that all views share, then by the pose of the body in each.
    columns : (n,) int
        Which parameters the former are.
    """
    camera = bundle.cameras[group.camera]
    points_body, points_rig, points_cam = _points_of(bundle, group)
    by_point, by_parameter = lens_derivatives(camera, points_cam)
    blocks = [_by_pose(by_point, points_cam)]
    spans = [layout.of_camera[group.camera]]
    lens = layout.of_lens.get(bundle.lens_of[group.camera])
    if lens is not None:
        blocks.append(by_parameter)
        spans.append(lens)
    by_point_rig = by_point @ camera.cam_from_world[:, :3]
    board = layout.of_board.get(group.board)
    if board is not None:
        rig_from_body = np.array([bundle.rig_from_body[pose][:, :3] for pose in group.poses])
        blocks.append(_by_pose(by_point_rig @ rig_from_body[group.member], points_body))
        spans.append(board)
    blocks.append(_by_pose(by_point_rig, points_rig))
    columns = np.concatenate([np.arange(span.start, span.stop) for span in spans])
    return np.concatenate(blocks, axis=2), columns


def _grams(rows: NDArray[np.float64], group: _Group) -> NDArray[np.float64]:
    """Return for each view of a group the sum of products (V, n, n) of its rows (S, 2, n)."""
    # Views of fewer points are filled up with rows of zeros: one product for all.
    n_points = int(group.point.max(initial=0)) + 1
    filled = np.zeros((len(group.poses), n_points, *rows.shape[1:]))
    filled[group.member, group.point] = rows
    filled = filled.reshape(len(filled), -1, rows.shape[2])
    return np.asarray(filled.transpose(0, 2, 1) @ filled)


def _by_pose(by_point: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivatives (S, 2, 6) by omega and v of the pose that led to the points (S, 3)."""
    # d(omega x X) = -[X] omega, and rows of by_point times -[X] are X cross row.
    return np.concatenate([np.cross(points[:, None, :], by_point), by_point], axis=2)


def lens_derivatives(
    camera: Camera, points_cam: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the derivatives of a lens by the point and by its parameters.

    Parameters
    ----------
    camera : Camera
        The lens.
    points_cam : (S, 3) float64
        Points in front of it, metres.

    Returns
    -------
    by_point : (S, 2, 3) float64
        Pixels a metre.
    by_parameter : (S, 2, P) float64
        Pixels a unit of each parameter. Both by central differences, relative error about 1e-9.
    """
    steps = _COORDINATE_STEP * np.linalg.norm(points_cam, axis=1)
    shifts = np.eye(3)[:, None, :] * steps[:, None]  # (3, S, 3)
    shifted = np.concatenate([points_cam + shifts, points_cam - shifts])  # (6, S, 3)
    images = img_from_cam(camera, shifted.reshape(-1, 3)).reshape(2, 3, len(points_cam), 2)
    by_point = ((images[0] - images[1]) / (2.0 * steps[:, None])).transpose(1, 2, 0)
    sizes = _PARAMETER_STEP * np.maximum(1.0, np.abs(camera.params))
    ahead, behind = camera.params + np.diag(sizes), camera.params - np.diag(sizes)
    images = img_by_params(camera, np.concatenate([ahead, behind]), points_cam)
    images = images.reshape(2, len(sizes), len(points_cam), 2)
    widths = np.diag(ahead - behind)  # as rounded
    by_parameter = ((images[0] - images[1]) / widths[:, None, None]).transpose(1, 2, 0)
    return by_point, by_parameter
