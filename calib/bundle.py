"""The joint adjustment of a rig: lenses, cameras, boards and their bodies, all at once.

A board point goes through four frames: board, body (boards that are mounted together), rig (the
frame in which one body pose is held), camera; then through the lens::

    pixel = lens_c( cam_from_rig_c  rig_from_body_p  body_from_board_b  point )

The lens models are COLMAP's. The poses of the bodies, of which there are hundreds, are eliminated
(Schur complement), so that each step solves for the cameras alone; what is left of the normal
matrix is the information that the pictures hold about the cameras, from which their covariance
follows (`hybridve.calib.uncertainty`). COLMAP's own adjustment has no boards mounted together, no
lens common to several cameras of a rig, and gives no covariance of a rig.

A pose T is adjusted as exp(xi) T with xi = (omega, v) in the frame it leads to:
``x_true = x + omega x x + v``, radians and metres.

This work is based on: Triggs, McLauchlan, Hartley and Fitzgibbon, *Bundle adjustment: a modern
synthesis*, 2000; Nocedal and Wright, *Numerical optimization*, 2nd ed., 2006, chapter 10
(Levenberg and Marquardt); Barfoot, *State estimation for robotics*, 2017, chapter 7 (poses).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.board import is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import img_from_cam
from hybridve.calib.pose import Pose, compose, transform

#: Parameters of a pose.
POSE = 6

#: Steps of central differences: of coordinates by depth, and of lens parameters by their size (and
#: at least by one). Rounding, about 1e-13 px, and curvature both stay below 1e-8 of a derivative.
_COORDINATE_STEP = 1e-6
_PARAMETER_STEP = 1e-6

#: The adjustment has converged when a step changes no parameter by more than this share of its
#: own uncertainty for one pixel of noise, or the cost by less than rounding.
_STEP_TOLERANCE = 1e-9
_COST_TOLERANCE = 1e-12
_COST_FLOOR_PX = 1e-9
_MAX_STEPS = 100

_FIRST_DAMPING = 1e-4
_LEAST_DAMPING = 1e-13
_MOST_DAMPING = 1e12


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
    seen = [is_seen(view.pixels) for view in bundle.views]
    residuals = _residuals(bundle, seen)
    n_seen = sum(map(len, residuals))
    cost = _cost(bundle, residuals, loss_px)
    if not np.isfinite(cost):
        lost = next(
            view.image
            for view, missed in zip(bundle.views, residuals, strict=True)
            if not np.isfinite(missed).all()
        )
        raise CalibrationError(
            f"the joint adjustment cannot start: its lens does not see the board in {lost}"
        )
    damping = _FIRST_DAMPING
    normal = _normal_equations(bundle, layout, seen, residuals, loss_px)
    n_steps = 0
    while n_steps < _MAX_STEPS and damping < _MOST_DAMPING:
        n_steps += 1
        step = _solve(normal, damping)
        moved = _moved(bundle, layout, step)
        moved_residuals = _residuals(moved, seen)
        moved_cost = _cost(bundle, moved_residuals, loss_px)
        is_small = _largest(step, normal) < _STEP_TOLERANCE
        if moved_cost <= cost:  # False for NaN
            gain = cost - moved_cost
            bundle, residuals, cost = moved, moved_residuals, moved_cost
            damping = max(damping / 10.0, _LEAST_DAMPING)
            normal = _normal_equations(bundle, layout, seen, residuals, loss_px)
            if is_small or gain <= _COST_TOLERANCE * cost + n_seen * _COST_FLOOR_PX**2:
                break
        elif is_small:
            break  # as good as rounding allows
        else:
            damping *= 10.0
    return Adjusted(
        bundle,
        tuple(_spread(missed, where) for missed, where in zip(residuals, seen, strict=True)),
        _reduced(normal, 0.0)[0],
        layout,
        n_steps,
    )


def view_residuals(bundle: Bundle) -> tuple[NDArray[np.float64], ...]:
    """Return observed minus projected points (N, 2) of each view, pixels; NaN where not seen."""
    seen = [is_seen(view.pixels) for view in bundle.views]
    return tuple(
        _spread(missed, where) for missed, where in zip(_residuals(bundle, seen), seen, strict=True)
    )


def _spread(rows: NDArray[np.float64], seen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return rows (S, 2) of what was seen at their places (N, 2), NaN elsewhere."""
    every = np.full((len(seen), 2), np.nan)
    every[seen] = rows
    return every


def _residuals(bundle: Bundle, seen: Sequence[NDArray[np.bool_]]) -> list[NDArray[np.float64]]:
    """Return observed minus projected points (S, 2) of what was seen in each view, pixels."""
    points_cam = _points_cam(bundle, seen)
    residuals = [view.pixels[where] for view, where in zip(bundle.views, seen, strict=True)]
    for camera, own, ends in _by_camera(bundle, points_cam):
        projected = img_from_cam(camera, np.concatenate([points_cam[number] for number in own]))
        for number, pixels in zip(own, np.split(projected, ends), strict=True):
            residuals[number] = residuals[number] - pixels
    return residuals


def _cam_from_board(bundle: Bundle, view: BundleView) -> Pose:
    rig_from_board = compose(bundle.rig_from_body[view.pose], bundle.body_from_board[view.board])
    return compose(bundle.cameras[view.camera].cam_from_world, rig_from_board)


def _cost(bundle: Bundle, residuals: Sequence[NDArray[np.float64]], loss_px: float) -> float:
    """Return the robust sum of squares, weighed; NaN where a seen point has no image."""
    squares = (np.concatenate(residuals) ** 2).sum(axis=1)
    if np.isfinite(loss_px):
        squares = 2.0 * loss_px**2 * (np.sqrt(1.0 + squares / loss_px**2) - 1.0)
    weights = np.repeat(
        [view.sigma_px**-2 for view in bundle.views], [len(missed) for missed in residuals]
    )
    return float(weights @ squares)


# --- One step ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """The normal equations: cameras, lenses and boards (A columns), and poses (F of 6)."""

    rest: NDArray[np.float64]  # (A, A)
    rest_gradient: NDArray[np.float64]  # (A,)
    poses: NDArray[np.float64]  # (F, 6, 6)
    poses_gradient: NDArray[np.float64]  # (F, 6)
    mixed: NDArray[np.float64]  # (F, 6, A)


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    rest: NDArray[np.float64]  # (A,)
    poses: NDArray[np.float64]  # (F, 6)


def _normal_equations(
    bundle: Bundle,
    layout: Layout,
    seen: Sequence[NDArray[np.bool_]],
    residuals: Sequence[NDArray[np.float64]],
    loss_px: float,
) -> _Normal:
    n_poses = len(bundle.rig_from_body)
    normal = _Normal(
        np.zeros((layout.size, layout.size)),
        np.zeros(layout.size),
        np.zeros((n_poses, POSE, POSE)),
        np.zeros((n_poses, POSE)),
        np.zeros((n_poses, POSE, layout.size)),
    )
    derivatives = _view_derivatives(bundle, seen)
    for view, where, missed, (points_cam, by_point, by_parameter) in zip(
        bundle.views, seen, residuals, derivatives, strict=True
    ):
        camera = bundle.cameras[view.camera]
        points = bundle.points_board[view.board][where]
        blocks = [_by_pose(by_point, points_cam)]
        columns = [layout.of_camera[view.camera]]
        lens = layout.of_lens.get(bundle.lens_of[view.camera])
        if lens is not None:
            blocks.append(by_parameter)
            columns.append(lens)
        points_body = transform(bundle.body_from_board[view.board], points)
        cam_from_body = compose(camera.cam_from_world, bundle.rig_from_body[view.pose])
        board = layout.of_board.get(view.board)
        if board is not None:
            blocks.append(_by_pose(by_point @ cam_from_body[:, :3], points_body))
            columns.append(board)
        points_rig = transform(bundle.rig_from_body[view.pose], points_body)
        pose = _by_pose(by_point @ camera.cam_from_world[:, :3], points_rig)
        jacobian = np.concatenate([*blocks, pose, missed[:, :, None]], axis=2) / view.sigma_px
        if np.isfinite(loss_px):  # the weights of the soft L1
            weights = (1.0 + (missed**2).sum(axis=1) / loss_px**2) ** -0.25
            jacobian = jacobian * weights[:, None, None]
        jacobian = jacobian.reshape(-1, jacobian.shape[2])
        gram = jacobian.T @ jacobian
        index = np.concatenate([np.arange(span.start, span.stop) for span in columns])
        n = len(index)
        normal.rest[np.ix_(index, index)] += gram[:n, :n]
        normal.rest_gradient[index] += gram[:n, -1]
        if view.pose != bundle.held_pose:
            normal.poses[view.pose] += gram[n:-1, n:-1]
            normal.poses_gradient[view.pose] += gram[n:-1, -1]
            normal.mixed[view.pose][:, index] += gram[n:-1, :n]
    normal.poses[bundle.held_pose] = np.eye(POSE)
    return normal


def _view_derivatives(
    bundle: Bundle, seen: Sequence[NDArray[np.bool_]]
) -> list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
    """Return for each view its points (S, 3), camera frame, and `lens_derivatives` there."""
    points_cam = _points_cam(bundle, seen)
    found: list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]] = [
        (points, np.zeros((0, 2, 3)), np.zeros((0, 2, 0))) for points in points_cam
    ]
    for camera, own, ends in _by_camera(bundle, points_cam):
        by_point, by_parameter = lens_derivatives(
            camera, np.concatenate([points_cam[number] for number in own])
        )
        pieces = zip(np.split(by_point, ends), np.split(by_parameter, ends), strict=True)
        for number, (of_points, of_parameters) in zip(own, pieces, strict=True):
            found[number] = (points_cam[number], of_points, of_parameters)
    return found


def _by_camera(
    bundle: Bundle, points_cam: Sequence[NDArray[np.float64]]
) -> Iterator[tuple[Camera, list[int], NDArray[np.intp]]]:
    """Go through cameras with their views, and where to split what is computed for all at once."""
    for index, camera in enumerate(bundle.cameras):
        own = [number for number, view in enumerate(bundle.views) if view.camera == index]
        if own:
            yield camera, own, np.cumsum([len(points_cam[number]) for number in own])[:-1]


def _points_cam(bundle: Bundle, seen: Sequence[NDArray[np.bool_]]) -> list[NDArray[np.float64]]:
    """Return the points (S, 3) seen in each view, camera frame."""
    return [
        transform(_cam_from_board(bundle, view), bundle.points_board[view.board][where])
        for view, where in zip(bundle.views, seen, strict=True)
    ]


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
    by_point = np.zeros((len(points_cam), 2, 3))
    steps = _COORDINATE_STEP * np.linalg.norm(points_cam, axis=1)
    for axis in range(3):
        shift = np.zeros_like(points_cam)
        shift[:, axis] = steps
        difference = img_from_cam(camera, points_cam + shift) - img_from_cam(
            camera, points_cam - shift
        )
        by_point[:, :, axis] = difference / (2.0 * steps[:, None])
    by_parameter = np.zeros((len(points_cam), 2, len(camera.params)))
    for index, value in enumerate(camera.params):
        step = _PARAMETER_STEP * max(1.0, abs(float(value)))
        ahead, behind = camera.params.copy(), camera.params.copy()
        ahead[index] += step
        behind[index] -= step
        difference = img_from_cam(replace(camera, params=ahead), points_cam) - img_from_cam(
            replace(camera, params=behind), points_cam
        )
        by_parameter[:, :, index] = difference / (ahead[index] - behind[index])
    return by_point, by_parameter


def _reduced(
    normal: _Normal, damping: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the normal equations without the poses, and what gives the poses back.

    Each diagonal is raised by a share, `damping`.
    """
    n_poses, size = len(normal.poses), len(normal.rest)
    poses = normal.poses + damping * normal.poses * np.eye(POSE)
    inverse = np.linalg.inv(poses)  # (F, 6, 6)
    back = inverse @ normal.mixed  # (F, 6, A)
    rest = normal.rest + damping * np.diag(np.diag(normal.rest))
    flat_mixed = normal.mixed.reshape(n_poses * POSE, size)
    rest = rest - flat_mixed.T @ back.reshape(n_poses * POSE, size)
    own = np.einsum("fij,fj->fi", inverse, normal.poses_gradient)
    gradient = normal.rest_gradient - flat_mixed.T @ own.reshape(-1)
    return (rest + rest.T) / 2.0, gradient, back, own


def _solve(normal: _Normal, damping: float) -> _Step:
    information, gradient, back, own = _reduced(normal, damping)
    scale = np.sqrt(np.diag(normal.rest))
    scale[scale == 0] = 1.0  # a parameter without effect stays where it is
    scaled = information / np.outer(scale, scale)
    scaled[np.diag_indices_from(scaled)] += np.where(np.diag(normal.rest) == 0, 1.0, 0.0)
    values, vectors = np.linalg.eigh(scaled)
    # What rounding leaves of a direction that the data do not tell is not walked along.
    known = values > _LEAST_DAMPING * values[-1]
    rest = vectors[:, known] @ ((vectors[:, known].T @ (gradient / scale)) / values[known]) / scale
    return _Step(rest, own - back @ rest)


def _largest(step: _Step, normal: _Normal) -> float:
    """Return the largest entry of a step, by its effect on the root of the sum of squares (px)."""
    of_rest = np.abs(step.rest) * np.sqrt(np.diag(normal.rest))
    of_poses = np.abs(step.poses) * np.sqrt(np.einsum("fii->fi", normal.poses))
    return float(max(of_rest.max(initial=0.0), of_poses.max(initial=0.0)))


def _moved(bundle: Bundle, layout: Layout, step: _Step) -> Bundle:
    cameras = []
    for index, camera in enumerate(bundle.cameras):
        lens = layout.of_lens.get(bundle.lens_of[index])
        cameras.append(
            replace(
                camera,
                params=camera.params if lens is None else camera.params + step.rest[lens],
                cam_from_world=moved_pose(
                    camera.cam_from_world, step.rest[layout.of_camera[index]]
                ),
            )
        )
    return replace(
        bundle,
        cameras=tuple(cameras),
        rig_from_body=tuple(
            pose if index == bundle.held_pose else moved_pose(pose, change)
            for index, (pose, change) in enumerate(
                zip(bundle.rig_from_body, step.poses, strict=True)
            )
        ),
        body_from_board=tuple(
            moved_pose(pose, step.rest[layout.of_board[board]])
            if board in layout.of_board
            else pose
            for board, pose in enumerate(bundle.body_from_board)
        ),
    )


def moved_pose(pose: Pose, change: NDArray[np.float64]) -> Pose:
    """Return a pose (3, 4) moved by (omega, v), (6,), in the frame it leads to.

    To first order ``x + omega x x + v``; the rotation is exact, and freed of rounding.
    """
    omega, v = change[:3], change[3:]
    angle = float(np.linalg.norm(omega))
    axis = omega / angle if angle > 0 else omega
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    rotation = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    u, _, vt = np.linalg.svd(rotation @ pose[:, :3])
    return np.column_stack([u @ vt, rotation @ pose[:, 3] + v])
