"""What fixed cameras saw of one or several boards, still or moving, with the truth."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from helpers.boards import look_at, make_camera
from hybridve.calib.boards.board import Observations, Sighting
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.lens import img_from_cam
from hybridve.calib.pose import Pose, compose, invert, transform
from hybridve.calib.solving.locate import locate_board


@dataclass(frozen=True, slots=True, eq=False)
class ExactLens:
    """A lens as it is, and the views located as they were."""

    camera: Camera
    views: dict[tuple[str, int], Pose]
    pixels: dict[tuple[str, int], NDArray[np.float64]]
    dropped: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Boards, lenses as if fitted, what was seen, and what is true."""

    boards: list[Chessboard]
    lenses: list[ExactLens]
    observations: list[Observations]
    cameras: list[Camera]


def random_pose(rng: np.random.Generator, turn_rad: float, shift_m: float) -> Pose:
    """Return a pose turned and shifted by up to so much."""
    axis = rng.normal(size=3)
    axis *= rng.uniform(0.2, 1.0) * turn_rad / np.linalg.norm(axis)
    return np.column_stack([cv2.Rodrigues(axis)[0], rng.uniform(-shift_m, shift_m, 3)])


def row_of_cameras(count: int, spacing_m: float = 0.5, model: str = "PINHOLE") -> list[Camera]:
    """Return cameras side by side along x, 2 m before what they look at."""
    return [
        make_camera(
            f"cam{index + 1}",
            model,
            look_at((spacing_m * index, -2.0, 0.2 * (index % 2)), (spacing_m * index, 0.0, 0.0)),
        )
        for index in range(count)
    ]


def held_up(rng: np.random.Generator, board: Chessboard, middle_world: Sequence[float]) -> Pose:
    """Return world_from_board of a board that faces -y, tilted at random, its middle at a place."""
    facing = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    rotation = random_pose(rng, 0.6, 0.0)[:, :3] @ facing
    return np.column_stack([rotation, np.asarray(middle_world) - rotation @ board.center_board])


def see(camera: Camera, world_from_board: Pose, board: Chessboard) -> NDArray[np.float64] | None:
    """Return the corners (N, 2) a camera sees; None unless all are in its image, from before."""
    cam_from_board = compose(camera.cam_from_world, world_from_board)
    points_cam = transform(cam_from_board, board.points_board)
    if (points_cam[:, 2] < 0.1).any() or invert(cam_from_board)[2, 3] <= 0:
        return None
    pixels = img_from_cam(camera, points_cam)
    inside = (pixels > 0).all() and (pixels < (camera.width_px, camera.height_px)).all()
    return pixels if inside else None


def record(
    boards: Sequence[Chessboard],
    cameras: Sequence[Camera],
    world_from_body: Mapping[int, Mapping[int, Pose]],
    body_from_board: Sequence[Pose] | None = None,
    noise_px: float = 0.0,
    stills: int = 0,
    is_still: bool = False,
    turns: Callable[[int, int], int] | None = None,
    seed: int = 0,
) -> Recording:
    """Return what cameras record of boards.

    Parameters
    ----------
    boards, cameras : sequence
        What there is.
    world_from_body : mapping
        By instant, by board, where the board's body is.
    body_from_board : sequence of (3, 4) float64, optional
        Where each board sits on its body; default: the board is the body.
    noise_px : float
        Standard deviation of a coordinate; poses of views are located from noisy corners.
    stills : int
        Stills of each camera alone, of the first board.
    is_still : bool
        Whether the clip is one of boards that lie still.
    turns : callable, optional
        By camera and instant the look in which a symmetric board is listed.
    seed : int
        Of the noise.
    """
    rng = np.random.default_rng(seed)
    from_board = body_from_board or [np.eye(3, 4) for _ in boards]
    lenses, observations = [], []
    for number, camera in enumerate(cameras):
        world_from_cam = invert(camera.cam_from_world)
        wanted: list[tuple[str, int | None, int, Pose]] = []
        for still in range(stills):
            middle = transform(world_from_cam, np.array([[0.0, 0.0, 1.8]]))[0]
            turn = np.diag([1.0, -1.0, -1.0]) @ random_pose(rng, 0.6, 0.0)[:, :3]
            rotation = world_from_cam[:, :3] @ turn
            pose = np.column_stack([rotation, middle - rotation @ boards[0].center_board])
            wanted.append((f"{still}.png", None, 0, pose))
        for instant, bodies in sorted(world_from_body.items()):
            wanted += [
                (f"board clip, frame {instant}", instant, b, compose(world, from_board[b]))
                for b, world in sorted(bodies.items())
            ]
        sightings: list[Sighting] = []
        views: dict[tuple[str, int], Pose] = {}
        pixels_of: dict[tuple[str, int], NDArray[np.float64]] = {}
        for image, moment, b, world_from_board in wanted:
            pixels = see(camera, world_from_board, boards[b])
            if pixels is None:
                continue
            look = turns(number, moment) if turns and moment is not None else 0
            noise = rng.normal(0.0, 1.0, pixels.shape) * noise_px
            pixels = (pixels + noise)[boards[b].looks[look]]
            sightings.append(Sighting(image, moment, b, pixels))
            if is_still and moment is not None:
                continue  # a lens is not fitted to a board that lies still
            pose = compose(camera.cam_from_world, world_from_board)
            pose = compose(pose, boards[b].board_from_turned(look))
            if noise_px:
                located = locate_board(camera, boards[b].points_board, pixels)
                assert located is not None
                pose = located[0]
            views[image, b], pixels_of[image, b] = pose, pixels
        bare = replace(camera, cam_from_world=np.eye(3, 4))
        lenses.append(ExactLens(bare, views, pixels_of))
        size_px = (camera.width_px, camera.height_px)
        observations.append(
            Observations(camera.name, camera.model, size_px, tuple(sightings), is_still)
        )
    return Recording(list(boards), lenses, observations, list(cameras))


def reordered(recording: Recording, order: Sequence[int]) -> Recording:
    """Return the same recording with its cameras listed in another order, sightings backwards."""
    return Recording(
        recording.boards,
        [recording.lenses[index] for index in order],
        [
            replace(
                recording.observations[index],
                sightings=recording.observations[index].sightings[::-1],
            )
            for index in order
        ],
        [recording.cameras[index] for index in order],
    )
