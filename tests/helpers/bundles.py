"""Boards seen by a ring of cameras, as bundles with known truth."""

from dataclasses import replace

import numpy as np

from helpers.boards import board_poses, project, ring
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.pose import compose, invert, moved_pose, rotation_about_axes
from hybridve.calib.solving.bundle import Bundle, BundleView, view_residuals

BOARD = Chessboard(7, 6, 0.1)


def make_bundle(
    models: list[str],
    n_stills: int,
    noise_px: float = 0.0,
    seed: int = 0,
    board: Chessboard = BOARD,
) -> Bundle:
    """Return cameras around a still board, with stills of their own; its values are the truth."""
    rng = np.random.default_rng(seed)
    cameras = ring(board, models)
    views, poses = [], [np.eye(3, 4)]
    for index, camera in enumerate(cameras):
        pixels = project(camera, camera.cam_from_world, board)
        views.append(BundleView(index, 0, 0, pixels, "board clip"))
        for number, cam_from_board in enumerate(board_poses(board, n_stills, index)):
            poses.append(compose(invert(camera.cam_from_world), cam_from_board))
            pixels = project(camera, cam_from_board, board)
            views.append(BundleView(index, len(poses) - 1, 0, pixels, f"{number}.png"))
    if noise_px:
        views = [
            replace(view, pixels=view.pixels + rng.normal(0.0, noise_px, view.pixels.shape))
            for view in views
        ]
    return Bundle(
        points_board=(board.points_board,),
        cameras=tuple(cameras),
        rig_from_body=tuple(poses),
        body_from_board=(np.eye(3, 4),),
        views=tuple(views),
        held_pose=0,
        lens_of=tuple(range(len(cameras))),
        fixed_lenses=frozenset(),
        held_boards=frozenset({0}),
    )


def perturbed(bundle: Bundle, seed: int, by: float = 0.01) -> Bundle:
    """Return a bundle with all that may be adjusted moved by about a hundredth."""
    rng = np.random.default_rng(seed)
    return replace(
        bundle,
        cameras=tuple(
            replace(
                camera,
                params=camera.params * (1.0 + rng.normal(0.0, by, camera.params.shape)),
                cam_from_world=moved_pose(camera.cam_from_world, rng.normal(0.0, by, 6)),
            )
            for camera in bundle.cameras
        ),
        rig_from_body=tuple(
            pose if index == bundle.held_pose else moved_pose(pose, rng.normal(0.0, by, 6))
            for index, pose in enumerate(bundle.rig_from_body)
        ),
        body_from_board=tuple(
            pose if board in bundle.held_boards else moved_pose(pose, rng.normal(0.0, by, 6))
            for board, pose in enumerate(bundle.body_from_board)
        ),
    )


def back_to_back(noise_px: float = 0.0) -> Bundle:
    """Two boards on one body; the first camera sees only one of them, the second the other."""
    truth = make_bundle(["PINHOLE", "PINHOLE"], n_stills=0)
    turn = rotation_about_axes((0.0, 180.0, 0.0))
    body_from_second = np.column_stack([turn, [0.7, 0.02, -0.03]])
    rng = np.random.default_rng(4)
    poses = [np.eye(3, 4)]
    for _ in range(14):
        tilt = rotation_about_axes(tuple(rng.uniform(-25, 25, 3)))
        poses.append(np.column_stack([tilt, rng.uniform(-0.1, 0.1, 3)]))
    opposite = np.column_stack(
        [rotation_about_axes((0.0, 180.0, 0.0)), [0.7, 0.0, 0.0]]
    )  # the second camera looks at the body from behind
    cameras = (
        truth.cameras[0],
        replace(
            truth.cameras[1], cam_from_world=compose(truth.cameras[1].cam_from_world, opposite)
        ),
    )
    bundle = replace(
        truth,
        points_board=(truth.points_board[0], truth.points_board[0]),
        cameras=cameras,
        rig_from_body=tuple(poses),
        body_from_board=(np.eye(3, 4), body_from_second),
        held_boards=frozenset({0}),
        views=tuple(
            BundleView(camera, pose, camera, np.zeros_like(truth.views[0].pixels), f"{pose}")
            for pose in range(len(poses))
            for camera in (0, 1)
        ),
    )
    views = [
        replace(view, pixels=rng.normal(0.0, noise_px, missed.shape) - missed)
        for view, missed in zip(bundle.views, view_residuals(bundle), strict=True)
    ]
    return replace(bundle, views=tuple(views))
