"""Rigs with known truth and noise, and the least error that theory allows their calibration."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from helpers.boards import board_poses, project, ring
from hybridve.calib.boards.board import Observations, Sighting
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.lens import img_from_cam, project_points
from hybridve.calib.pose import Pose, compose, invert, rotation_about_axes, transform
from hybridve.calib.rig import Rig
from hybridve.calib.solving.bundle import Bundle, BundleView
from hybridve.calib.solving.covariance import image_derivatives

BOARD = Chessboard(9, 6, 0.1)

#: A board is found where all of it is this far inside the image, and is seen at less than this
#: angle off its normal.
_MARGIN_PX = 5.0
_MOST_SLANT_DEG = 65.0

#: Central differences: steps of poses (radians, metres), and of lens parameters by their size.
_STEP = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Cameras, and where boards were when they saw them; the truth.

    Attributes
    ----------
    cameras : tuple of Camera
        In the world that a calibration defines: the board at the first instant.
    world_from_board : tuple of (3, 4) float64
        Where the board was, instant by instant and still by still.
    views : tuple of (int, int, str, int or None)
        Camera, index of `world_from_board`, image, and its instant (None: a still).
    is_still : bool
        Whether the board lies still in the clip.
    """

    cameras: tuple[Camera, ...]
    world_from_board: tuple[Pose, ...]
    views: tuple[tuple[int, int, str, int | None], ...]
    is_still: bool

    @property
    def rig(self) -> Rig:
        """The true cameras."""
        return Rig(self.cameras)

    def exact(self, view: tuple[int, int, str, int | None]) -> NDArray[np.float64]:
        """Return where a view has the points of the board, (N, 2) pixels."""
        camera = self.cameras[view[0]]
        return project(
            camera, compose(camera.cam_from_world, self.world_from_board[view[1]]), BOARD
        )


def still_scene(n_cameras: int, n_stills: int, model: str = "OPENCV") -> Scene:
    """Return cameras around a board that lies still, each with stills of its own."""
    cameras = ring(BOARD, [model] * n_cameras)
    poses: list[Pose] = [np.eye(3, 4)]
    views: list[tuple[int, int, str, int | None]] = []
    for index, camera in enumerate(cameras):
        for number, cam_from_board in enumerate(board_poses(BOARD, n_stills, index)):
            poses.append(compose(invert(camera.cam_from_world), cam_from_board))
            views.append((index, len(poses) - 1, f"{number}.png", None))
        views.append((index, 0, "board clip", 0))
    return Scene(tuple(cameras), tuple(poses), tuple(views), True)


def moving_scene(n_cameras: int, n_frames: int, model: str = "OPENCV") -> Scene:
    """Return cameras around a board that is moved about, linked by its frames alone: no stills."""
    cameras = ring(BOARD, [model] * n_cameras)
    rng = np.random.default_rng(n_cameras)
    poses: list[Pose] = [np.eye(3, 4)]
    while len(poses) < n_frames:
        tilt = rotation_about_axes(
            (rng.uniform(-40, 40), rng.uniform(-40, 40), rng.uniform(-180, 180))
        )
        middle = BOARD.center_board + rng.uniform((-0.35, -0.35, 0.0), (0.35, 0.35, 0.3))
        poses.append(np.column_stack([tilt, middle - tilt @ BOARD.center_board]))
    views = [
        (index, instant, f"board clip, frame {instant}", instant)
        for index, camera in enumerate(cameras)
        for instant, pose in enumerate(poses)
        if _finds(camera, pose)
    ]
    seen = {pose for _, pose, _, _ in views}
    if seen != set(range(n_frames)) or sum(pose == 0 for _, pose, _, _ in views) < n_cameras:
        raise ValueError("some camera misses the first frame, or all cameras miss another")
    return Scene(tuple(cameras), tuple(poses), tuple(views), False)


def _finds(camera: Camera, world_from_board: Pose) -> bool:
    cam_from_board = compose(camera.cam_from_world, world_from_board)
    pixels = project(camera, cam_from_board, BOARD)
    inside = (pixels > _MARGIN_PX) & (
        pixels < np.subtract((camera.width_px, camera.height_px), _MARGIN_PX)
    )
    middle = transform(cam_from_board, BOARD.center_board[None])[0]
    slant = -cam_from_board[:, 2] @ middle / np.linalg.norm(middle)
    return bool(inside.all() and slant > np.cos(np.deg2rad(_MOST_SLANT_DEG)))


def observed(scene: Scene, noise_px: float, seed: int) -> list[Observations]:
    """Return what the cameras see, with normal noise."""
    rng = np.random.default_rng(seed)
    sightings: list[list[Sighting]] = [[] for _ in scene.cameras]
    for view in scene.views:
        pixels = scene.exact(view)
        noisy = pixels + rng.normal(0.0, noise_px, pixels.shape)
        sightings[view[0]].append(Sighting(view[2], view[3], 0, noisy))
    return [
        Observations(
            camera.name,
            camera.model,
            (camera.width_px, camera.height_px),
            tuple(own),
            is_still=scene.is_still,
        )
        for camera, own in zip(scene.cameras, sightings, strict=True)
    ]


def bundle_of(scene: Scene, clip_px: float, stills_px: float, seed: int) -> Bundle:
    """Return the truth as a bundle; its views have the noise of clip or stills, and say so."""
    rng = np.random.default_rng(seed)
    views = []
    for view in scene.views:
        sigma_px = stills_px if view[3] is None else clip_px
        pixels = scene.exact(view)
        noisy = pixels + rng.normal(0.0, sigma_px, pixels.shape)
        views.append(BundleView(view[0], view[1], 0, noisy, view[2], sigma_px))
    return Bundle(
        points_board=(BOARD.points_board,),
        cameras=scene.cameras,
        rig_from_body=scene.world_from_board,
        body_from_board=(np.eye(3, 4),),
        views=tuple(views),
        held_pose=0,
        lens_of=tuple(range(len(scene.cameras))),
        fixed_lenses=frozenset(),
        held_boards=frozenset({0}),
    )


# --- What theory allows -----------------------------------------------------------------------


def least_covariance(scene: Scene, noise_px: float) -> NDArray[np.float64]:
    """Return the Cramer-Rao bound of the cameras' parameters: (P, P), as `RigCovariance` has them.

    The whole matrix of information is built from differences of projected points and inverted,
    boards and all: nothing here is shared with the adjustment but the lens itself.
    """
    sizes = [6 + len(camera.params) for camera in scene.cameras]
    starts = np.cumsum([0, *sizes])
    n_cameras = int(starts[-1])
    # The board at the first instant is the world, and stays.
    information = np.zeros((n_cameras + 6 * (len(scene.world_from_board) - 1),) * 2)
    for view in scene.views:
        camera, pose = scene.cameras[view[0]], view[1]
        by_camera, by_board = _view_derivatives(camera, scene.world_from_board[pose])
        columns = [np.arange(starts[view[0]], starts[view[0] + 1])]
        blocks = [by_camera]
        if pose:
            columns.append(n_cameras + 6 * (pose - 1) + np.arange(6))
            blocks.append(by_board)
        jacobian, index = np.concatenate(blocks, axis=1), np.concatenate(columns)
        information[np.ix_(index, index)] += jacobian.T @ jacobian / noise_px**2
    scale = np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray(covariance[:n_cameras, :n_cameras])


def _view_derivatives(
    camera: Camera, world_from_board: Pose
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how a view's pixels change with pose and lens (2N, 6 + P), and the board (2N, 6)."""

    def pixels(
        of_camera: NDArray[np.float64], of_board: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        points_world = transform(_moved(world_from_board, of_board), BOARD.points_board)
        cam_from_world = _moved(camera.cam_from_world, of_camera[:6])
        lens = Camera(
            camera.name,
            camera.model,
            camera.width_px,
            camera.height_px,
            camera.params + of_camera[6:],
            cam_from_world,
        )
        return img_from_cam(lens, transform(cam_from_world, points_world)).ravel()

    steps = _STEP * np.concatenate([np.ones(6), np.maximum(1.0, np.abs(camera.params)), np.ones(6)])
    columns = []
    for column, step in enumerate(steps):
        change = np.zeros(len(steps))
        change[column] = step
        ahead, behind = (pixels(sign * change[:-6], sign * change[-6:]) for sign in (1.0, -1.0))
        columns.append((ahead - behind) / (2.0 * step))
    jacobian = np.column_stack(columns)
    return jacobian[:, :-6], jacobian[:, -6:]


def _moved(pose: Pose, change: NDArray[np.float64]) -> Pose:
    """Return a pose moved by (omega, v) in the frame it leads to."""
    turn = Rotation.from_rotvec(change[:3]).as_matrix()
    return np.column_stack([turn @ pose[:, :3], turn @ pose[:, 3] + change[3:]])


# --- What a calibration gave ------------------------------------------------------------------


def parameter_errors(rig: Rig, true: Rig) -> NDArray[np.float64]:
    """Return true minus found parameters (P,), as `RigCovariance` has them."""
    errors = []
    for truth, found in zip(true.cameras, rig.cameras, strict=True):
        change = compose(truth.cam_from_world, invert(found.cam_from_world))
        omega = Rotation.from_matrix(change[:, :3]).as_rotvec()
        errors += [omega, change[:, 3], truth.params - found.params]
    return np.concatenate(errors)


def squared_in_units(
    errors: NDArray[np.float64], covariance: NDArray[np.float64]
) -> tuple[float, int]:
    """Return the sum of squared errors (P,) in units of a covariance, and how many they are."""
    scale = np.sqrt(np.diag(covariance))
    whitened = np.linalg.solve(covariance / np.outer(scale, scale), errors / scale)
    return float(errors / scale @ whitened), len(errors)


def placed(rig: Rig, true: Rig, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where a rig places points that the true rig sees: least squares in its images."""
    found = points.copy()
    seen = [project_points(camera, points)[0] for camera in true.cameras]
    for _ in range(4):
        information, moment = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for camera, pixels in zip(rig.cameras, seen, strict=True):
            missed = pixels - project_points(camera, found)[0]
            by_point = image_derivatives(camera, found)[0]
            information += by_point.transpose(0, 2, 1) @ by_point
            moment += np.einsum("nij,ni->nj", by_point, missed)
        found = found + np.linalg.solve(information, moment[..., None])[..., 0]
    return found
