"""Rigs around symmetric boards with a floor to recognise, and the same with cameras turned."""

import functools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from helpers.boards import floor_of_noise, look_at, make_camera, project, render_board
from hybridve.calib.boards.board import Observations, Sighting
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.pose import compose
from hybridve.calib.rig import Rig

SIZE_PX = (320, 240)

#: Looks the same after 1/2, 1/2, 1/2 and 1/4 of a turn.
BOARDS = (
    Chessboard(8, 6, 0.1),
    Chessboard(7, 7, 0.1),
    Chessboard(7, 5, 0.1),
    Chessboard(6, 6, 0.1),
)


@functools.lru_cache(maxsize=64)
def around(
    board: Chessboard, seed: int, count: int, is_textured: bool
) -> tuple[tuple[Camera, ...], tuple[Observations, ...]]:
    """Return cameras anywhere around a board, and what they see: corners with noise, a picture.

    Each lists the corners in a look of its own, as detections do.
    """
    rng = np.random.default_rng(seed)
    x, y, _ = board.center_board
    first = rng.uniform(0.0, 2.0 * np.pi)
    floor = floor_of_noise(seed) if is_textured else None
    cameras, seen = [], []
    for index in range(count):
        # Within a right angle of the next: cameras that look at each other recognise nothing.
        angle = first + index * rng.uniform(0.4, 1.0)
        radius_m, height_m = rng.uniform(1.2, 1.7), rng.uniform(1.0, 1.5)
        center = (x + radius_m * np.cos(angle), y + radius_m * np.sin(angle), height_m)
        pose = look_at(center, (x, y, 0.0), rng.uniform(-10.0, 10.0))
        camera = make_camera(f"cam{index + 1}", "PINHOLE", pose, SIZE_PX)
        corners = project(camera, pose, board) + rng.normal(
            0.0, 0.1, (board.columns * board.rows, 2)
        )
        corners = corners[board.looks[rng.integers(len(board.looks))]]
        picture = render_board(camera, board, floor=floor, samples=1, noise_grey=1.0)
        cameras.append(camera)
        seen.append(
            Observations(
                camera.name,
                camera.model,
                SIZE_PX,
                (Sighting("board clip", 0, 0, corners),),
                is_still=True,
                picture=picture.astype(np.float32),
            )
        )
    return tuple(cameras), tuple(seen)


def turned(cameras: Sequence[Camera], board: Chessboard, looks: Sequence[int]) -> Rig:
    """Return a rig of these cameras, each turned about the board by one of its looks."""
    return Rig(
        tuple(
            replace(
                camera,
                cam_from_world=compose(camera.cam_from_world, board.board_from_turned(look)),
            )
            for camera, look in zip(cameras, looks, strict=True)
        )
    )
