"""Cameras around boards, with their truth: projected exactly, or rendered."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Observations, Sighting
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.lens import cam_from_img, img_from_cam
from hybridve.calib.pose import Pose, compose, invert, rotation_about_axes, transform

WIDTH_PX, HEIGHT_PX = 640, 480

#: A plausible lens of each model, for images of 640x480; principal points off the middle.
LENSES: dict[str, tuple[float, ...]] = {
    "SIMPLE_PINHOLE": (510.0, 326.0, 233.0),
    "PINHOLE": (510.0, 514.0, 326.0, 233.0),
    "SIMPLE_RADIAL": (510.0, 326.0, 233.0, -0.1),
    "RADIAL": (510.0, 326.0, 233.0, -0.2, 0.05),
    "OPENCV": (510.0, 514.0, 326.0, 233.0, -0.25, 0.08, 0.001, -0.0005),
    "OPENCV_FISHEYE": (410.0, 414.0, 326.0, 233.0, -0.03, 0.01, -0.004, 0.001),
    "FULL_OPENCV": (510.0, 514.0, 326.0, 233.0, -0.2, 0.1, 0.001, -0.0005, 0.05, 0.1, 0.2, 0.1),
    "FOV": (510.0, 514.0, 326.0, 233.0, 0.7),
    "SIMPLE_RADIAL_FISHEYE": (410.0, 326.0, 233.0, -0.03),
    "RADIAL_FISHEYE": (410.0, 326.0, 233.0, -0.03, 0.01),
    "SIMPLE_DIVISION": (510.0, 326.0, 233.0, -0.2),
    "DIVISION": (510.0, 514.0, 326.0, 233.0, -0.2),
    "SIMPLE_FISHEYE": (410.0, 326.0, 233.0),
    "FISHEYE": (410.0, 414.0, 326.0, 233.0),
    "THIN_PRISM_FISHEYE": (
        *(410.0, 414.0, 326.0, 233.0, -0.03, 0.01, 0.001, -0.0005, -0.004, 0.001),
        *(0.002, -0.001),
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *(410.0, 414.0, 326.0, 233.0, -0.03, 0.01, -0.004, 0.001, 0.0, 0.0),
        *(0.001, -0.0005, 0.002, -0.001, 0.0, 0.0),
    ),
    "EUCM": (410.0, 414.0, 326.0, 233.0, 0.6, 1.1),
}


def look_at(
    center: tuple[float, float, float], target: tuple[float, float, float], roll_deg: float = 0.0
) -> Pose:
    """Return the pose of a camera at `center` that has `target` on its axis, upright at roll 0."""
    forward = np.subtract(target, center)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    rotation = rotation_about_axes((0.0, 0.0, roll_deg)) @ np.stack([right, down, forward])
    return np.column_stack([rotation, -rotation @ np.asarray(center)])


def make_camera(
    name: str, model: str, cam_from_world: Pose, size_px: tuple[int, int] = (WIDTH_PX, HEIGHT_PX)
) -> Camera:
    """Return a camera with the lens of `LENSES`, scaled to the image's width."""
    params = np.array(LENSES[model])
    n_pixels = 3 if len(params) == 3 or model.startswith("SIMPLE") or "RADIAL" in model else 4
    params[:n_pixels] *= size_px[0] / WIDTH_PX
    return Camera(name, model, *size_px, params, cam_from_world)


def ring(board: Chessboard, models: list[str], radius_m: float = 1.6) -> list[Camera]:
    """Return cameras around a board on the floor, at different heights, looking at its middle."""
    x, y, _ = board.center_board
    cameras = []
    for index, model in enumerate(models):
        angle = 2.0 * np.pi * (index + 0.3) / len(models)
        center = (
            x + radius_m * np.cos(angle),
            y + radius_m * np.sin(angle),
            1.0 + 0.15 * (index % 3),
        )
        pose = look_at(center, (x, y, 0.0), 3.0 * index)
        cameras.append(make_camera(f"cam{index + 1}", model, pose))
    return cameras


def board_poses(board: Chessboard, count: int, seed: int) -> list[Pose]:
    """Return cam_from_board of a board in hand: all of it in view, tilted, near and far."""
    rng = np.random.default_rng(seed)
    poses = []
    for _ in range(count):
        tilt = rotation_about_axes(
            (180.0 + rng.uniform(-40, 40), rng.uniform(-40, 40), rng.uniform(-20, 20))
        )
        middle = np.array([rng.uniform(-0.15, 0.15), rng.uniform(-0.1, 0.1), 1.0])
        middle *= rng.uniform(0.9, 1.6) * 2.2 * np.linalg.norm(board.center_board)
        poses.append(np.column_stack([tilt, middle - tilt @ board.center_board]))
    return poses


def project(camera: Camera, cam_from_board: Pose, board: Chessboard) -> NDArray[np.float64]:
    """Return where a camera sees the corners: (N, 2) pixels, exactly."""
    return img_from_cam(camera, transform(cam_from_board, board.points_board))


def observe_exactly(
    board: Chessboard, cameras: list[Camera], n_stills: int = 12, noise_px: float = 0.0
) -> list[Observations]:
    """Return what cameras around a still board would observe, without a picture."""
    rng = np.random.default_rng(7)

    def seen(camera: Camera, pose: Pose) -> NDArray[np.float64]:
        corners = project(camera, pose, board)
        return corners + rng.normal(0.0, noise_px, corners.shape) if noise_px else corners

    observations = []
    for index, camera in enumerate(cameras):
        stills = [
            Sighting(f"{number}.png", None, 0, seen(camera, pose))
            for number, pose in enumerate(board_poses(board, n_stills, index))
        ]
        clip = Sighting("board clip", 0, 0, seen(camera, camera.cam_from_world))
        size_px = (camera.width_px, camera.height_px)
        observations.append(
            Observations(camera.name, camera.model, size_px, (*stills, clip), is_still=True)
        )
    return observations


def floor_of_noise(seed: int) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return a floor with spots of all sizes: grey levels (N,) of points (N, 2) in metres."""
    rng = np.random.default_rng(seed)
    layers = [(spacing_m, rng.uniform(-1.0, 1.0, (64, 64))) for spacing_m in (0.4, 0.13, 0.05)]

    def grey(points: NDArray[np.float64]) -> NDArray[np.float64]:
        total = np.full(len(points), 120.0)
        for spacing_m, values in layers:
            cells = points / spacing_m
            low = np.floor(cells).astype(int)
            share = cells - low
            i, j = low[:, 0] % 64, low[:, 1] % 64
            u, v = share.T
            total += 30.0 * (
                values[i, j] * (1 - u) * (1 - v)
                + values[(i + 1) % 64, j] * u * (1 - v)
                + values[i, (j + 1) % 64] * (1 - u) * v
                + values[(i + 1) % 64, (j + 1) % 64] * u * v
            )
        return total

    return grey


def render_board(
    camera: Camera,
    board: Chessboard,
    cam_from_board: Pose | None = None,
    floor: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
    noise_grey: float = 0.0,
    samples: int = 4,
    starts_black: bool = True,
) -> NDArray[np.uint8]:
    """Render a board with a white margin of one square, lying on a floor without end.

    Each pixel is the mean of ``samples`` squared rays, at places that differ from pixel to pixel:
    on a regular grid, edges along rows or columns would jump.

    Parameters
    ----------
    camera : Camera
        The camera; its pose holds unless `cam_from_board` is given.
    board : Chessboard
        The board, in the plane z = 0.
    cam_from_board : (3, 4) float64, optional
        Where the camera is.
    floor : callable, optional
        Grey levels of the plane around the board, (N,) for points (N, 2); default: even.
    noise_grey : float
        Standard deviation of the noise.
    samples : int
        Rays a pixel side.
    starts_black : bool
        Whether the square before the first inner corner is black.
    """
    pose = camera.cam_from_world if cam_from_board is None else cam_from_board
    rng = np.random.default_rng(11)
    width_px, height_px = camera.width_px, camera.height_px
    total = np.zeros((height_px, width_px))
    columns, rows = np.meshgrid(np.arange(width_px), np.arange(height_px))
    center = invert(pose)[:, 3]
    for sub_row in range(samples):
        for sub_column in range(samples):
            x = columns + (sub_column + rng.uniform(size=columns.shape)) / samples
            y = rows + (sub_row + rng.uniform(size=rows.shape)) / samples
            rays = cam_from_img(camera, np.column_stack([x.ravel(), y.ravel()]))
            directions = np.column_stack([rays, np.ones(len(rays))]) @ pose[:, :3]
            ahead = directions[:, 2] * center[2] < 0
            grey = np.full(len(rays), 180.0)  # the sky
            reach = -center[2] / directions[ahead, 2]
            points = (center + reach[:, None] * directions[ahead])[:, :2]
            plane = np.full(len(points), 120.0) if floor is None else floor(points)
            squares = points / board.square_m + 1.0
            size = (board.columns + 1, board.rows + 1)
            near = ((squares > -1) & (squares < np.add(size, 1))).all(axis=1)
            plane[near] = 215.0
            on = ((squares >= 0) & (squares < size)).all(axis=1)
            odd = np.floor(squares[on]).sum(axis=1) % 2 == 1
            plane[on] = np.where(odd == starts_black, 215.0, 30.0)
            grey[ahead] = plane
            total += grey.reshape(total.shape)
    image = total / samples**2
    if noise_grey:
        image = image + rng.normal(0.0, noise_grey, image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def relative_error(rig_centers: NDArray[np.float64], true_centers: NDArray[np.float64]) -> float:
    """Return the largest error of camera positions, by the size of the rig."""
    size_m = np.linalg.norm(true_centers - true_centers.mean(axis=0), axis=1).max()
    return float(np.linalg.norm(rig_centers - true_centers, axis=1).max() / max(size_m, 1.0))


def turned_about(board: Chessboard, camera: Camera, look: int) -> Camera:
    """Return a camera as it stands if the board is turned under it by a look."""
    pose = compose(camera.cam_from_world, board.board_from_turned(look))
    return Camera(camera.name, camera.model, camera.width_px, camera.height_px, camera.params, pose)
