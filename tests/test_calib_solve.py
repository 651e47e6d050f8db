"""From corners to a rig: closed forms, and what must not matter."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.boards import (
    LENSES,
    board_poses,
    look_at,
    make_camera,
    observe_exactly,
    project,
    relative_error,
    ring,
)
from numpy.typing import NDArray

from hybridve.calib.calibrate import CalibrationSettings, Clip, Observations, Stills, solve_rig
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import cam_from_img, img_from_cam
from hybridve.calib.pose import angle_between, compose, invert
from hybridve.calib.rig import Rig
from hybridve.calib.solve import link_cameras, locate_board, seed_camera
from hybridve.calib.target import Chessboard

#: Noise-free corners determine a rig to this, by the size of the rig and in radians.
EXACT = 1e-6

#: The same for where a lens images rays, in pixels: coefficients themselves need not be unique
#: (a ratio of polynomials), what they do is.
EXACT_PX = 1e-5

BOARD = Chessboard(7, 6, 0.1)  # its colours tell its ends apart


def assert_same_rig(rig: Rig, cameras: list[Camera]) -> None:
    true_centers = np.array([camera.center_world for camera in cameras])
    centers = np.array([rig[camera.name].center_world for camera in cameras])
    assert relative_error(centers, true_centers) < EXACT
    for camera in cameras:
        found = rig[camera.name]
        assert angle_between(found.cam_from_world, camera.cam_from_world) < EXACT
        # Rays inside the part of the image that boards were seen in.
        pixels = np.stack(np.meshgrid([200.0, 320.0, 440.0], [150.0, 240.0, 330.0]), axis=-1)
        rays = cam_from_img(camera, pixels.reshape(-1, 2))
        again = img_from_cam(found, np.column_stack([rays, np.ones(len(rays))]))
        assert np.abs(again - pixels.reshape(-1, 2)).max() < EXACT_PX


@pytest.mark.parametrize("model", LENSES)
def test_noise_free_corners_give_back_the_rig(model: str) -> None:
    cameras = ring(BOARD, [model, model])

    rig = solve_rig(BOARD, observe_exactly(BOARD, cameras))

    assert_same_rig(rig, cameras)
    assert rig.provenance["rms_px"] < EXACT_PX


def test_models_may_be_mixed_in_one_rig() -> None:
    cameras = ring(BOARD, ["OPENCV", "OPENCV_FISHEYE", "PINHOLE", "DIVISION"])

    rig = solve_rig(BOARD, observe_exactly(BOARD, cameras))

    assert [camera.model for camera in rig.cameras] == [camera.model for camera in cameras]
    assert_same_rig(rig, cameras)


def test_the_order_of_cameras_does_not_matter() -> None:
    cameras = ring(BOARD, ["OPENCV", "RADIAL", "OPENCV"])
    observations = observe_exactly(BOARD, cameras, noise_px=0.3)

    rig = solve_rig(BOARD, observations)
    turned = solve_rig(BOARD, observations[::-1])

    assert [camera.name for camera in turned.cameras] == ["cam3", "cam2", "cam1"]
    for camera in rig.cameras:
        np.testing.assert_array_equal(turned[camera.name].params, camera.params)
        np.testing.assert_array_equal(turned[camera.name].cam_from_world, camera.cam_from_world)


def test_the_same_corners_give_the_same_rig_to_the_bit() -> None:
    observations = observe_exactly(BOARD, ring(BOARD, ["OPENCV", "OPENCV"]), noise_px=0.3)

    first, second = (solve_rig(BOARD, observations) for _ in range(2))

    for a, b in zip(first.cameras, second.cameras, strict=True):
        np.testing.assert_array_equal(a.params, b.params)
        np.testing.assert_array_equal(a.cam_from_world, b.cam_from_world)
    assert first.provenance == second.provenance


def test_the_error_that_is_told_is_the_noise_that_was_there() -> None:
    noise_px = 0.2
    cameras = ring(BOARD, ["OPENCV", "OPENCV"])

    rig = solve_rig(BOARD, observe_exactly(BOARD, cameras, n_stills=30, noise_px=noise_px))

    # Length of a two-dimensional error; parameters take up a few percent.
    assert rig.provenance["rms_px"] == pytest.approx(noise_px * np.sqrt(2), rel=0.06)
    for told in rig.provenance["cameras"].values():
        assert told["intrinsics"]["rms_px"] == pytest.approx(noise_px * np.sqrt(2), rel=0.1)
        assert told["intrinsics"]["views_used"] == 30


def test_the_world_has_z_up_and_cameras_above_the_floor() -> None:
    cameras = ring(BOARD, ["PINHOLE", "PINHOLE"])

    rig = solve_rig(BOARD, observe_exactly(BOARD, cameras))

    np.testing.assert_allclose(rig.centers_world[:, 2], [1.0, 1.15], atol=EXACT)


def test_blurred_and_wrong_views_are_dropped_and_named() -> None:
    cameras = ring(BOARD, ["OPENCV"])
    (seen,) = observe_exactly(BOARD, cameras, n_stills=14, noise_px=0.1)
    rng = np.random.default_rng(3)
    corners = dict(seen.stills.corners)
    corners["blurred"] = corners["3.png"] + rng.normal(0.0, 3.0, (42, 2))
    corners["bent"] = corners["5.png"] * [1.0, 1.08]
    corners["another board"] = corners["7.png"][::-1] + np.linspace(0, 60, 84).reshape(42, 2)
    spoilt = replace(seen, stills=replace(seen.stills, corners=corners))

    rig = solve_rig(BOARD, [spoilt])

    told = rig.provenance["cameras"]["cam1"]["intrinsics"]
    assert set(told["views_dropped"]) == {"blurred", "bent", "another board"}
    assert all("px" in reason for reason in told["views_dropped"].values())
    assert told["views_used"] == 14
    # As good as without them: 14 views with 0.1 px of noise give the centre to a few mm.
    assert np.linalg.norm(rig.cameras[0].center_world - cameras[0].center_world) < 0.005


def test_too_few_views_are_named_with_what_was_expected() -> None:
    (seen,) = observe_exactly(BOARD, ring(BOARD, ["OPENCV"]), n_stills=2)

    with pytest.raises(CalibrationError, match=r"'cam1'.*in 2 of 2 stills, expected 3"):
        solve_rig(BOARD, [seen])


def test_views_that_fit_no_lens_are_named() -> None:
    (seen,) = observe_exactly(BOARD, ring(BOARD, ["OPENCV"]), n_stills=4)
    rng = np.random.default_rng(5)
    grid = seen.stills.corners["0.png"]
    corners = {f"{number}": grid + rng.normal(0, 20.0, grid.shape) for number in range(4)}
    wrong = replace(seen, stills=replace(seen.stills, corners=corners))

    with pytest.raises(CalibrationError, match=r"'cam1'.*views of the board"):
        solve_rig(BOARD, [wrong])


def test_a_still_board_alone_fits_no_lens() -> None:
    (seen,) = observe_exactly(BOARD, ring(BOARD, ["OPENCV"]))
    bare = replace(seen, stills=Stills(None, {}, {}))

    with pytest.raises(CalibrationError, match=r"'cam1'.*lying still.*`intrinsics`"):
        solve_rig(BOARD, [bare])


def test_stills_of_another_size_than_the_clip_are_refused() -> None:
    (seen,) = observe_exactly(BOARD, ring(BOARD, ["OPENCV"]))
    small = replace(seen, stills=replace(seen.stills, size_px=(320, 240)))

    with pytest.raises(CalibrationError, match="320x240 pixels, extrinsics 640x480"):
        solve_rig(BOARD, [small])


def test_a_clip_from_another_lens_is_refused() -> None:
    cameras = ring(BOARD, ["PINHOLE", "PINHOLE"])
    observations = observe_exactly(BOARD, cameras)
    clip = observations[1].clip
    middle = clip.corners[0].mean(axis=0)
    bowed = clip.corners[0] + 2e-3 * (clip.corners[0] - middle) ** 2
    observations[1] = replace(observations[1], clip=replace(clip, corners={0: bowed}))

    with pytest.raises(CalibrationError, match=r"'cam2'.*board clip misses its lens"):
        solve_rig(BOARD, observations)


# --- A board that is moved before all cameras ------------------------------------------------


def moving(
    board: Chessboard, cameras: list[Camera], n_frames: int = 12
) -> tuple[list[Observations], list[NDArray[np.float64]]]:
    """Return observations of a board in hand, seen by all cameras, and world_from_board."""
    world_from_board = [
        compose(invert(cameras[0].cam_from_world), pose) for pose in board_poses(board, n_frames, 1)
    ]
    observations = []
    for camera in cameras:
        corners = {
            5 * number: project(camera, compose(camera.cam_from_world, pose), board)
            for number, pose in enumerate(world_from_board)
        }
        clip = Clip((camera.width_px, camera.height_px), corners, False)
        observations.append(Observations(camera.name, camera.model, Stills(None, {}, {}), clip))
    return observations, world_from_board


def side_by_side(model: str) -> list[Camera]:
    return [
        make_camera(f"cam{index}", model, look_at((0.12 * index, -1.0, 1.0), (0.1, 0.0, 0.8)))
        for index in range(3)
    ]


def test_a_moving_board_ties_cameras_together() -> None:
    cameras = side_by_side("OPENCV")
    observations, world_from_board = moving(BOARD, cameras)

    rig = solve_rig(BOARD, observations)

    # The world is the board in the first frame.
    expected = [
        replace(camera, cam_from_world=compose(camera.cam_from_world, world_from_board[0]))
        for camera in cameras
    ]
    assert_same_rig(rig, expected)


def test_frames_tell_which_way_round_a_symmetric_board_was_seen() -> None:
    board = Chessboard(8, 6, 0.1)
    cameras = side_by_side("PINHOLE")
    observations, _ = moving(board, cameras)
    rng = np.random.default_rng(2)
    for index, seen in enumerate(observations):
        corners = {
            frame: pixels[board.looks[rng.integers(2)]]
            for frame, pixels in seen.clip.corners.items()
        }
        observations[index] = replace(seen, clip=replace(seen.clip, corners=corners))

    rig = solve_rig(board, observations)

    distances = np.linalg.norm(np.diff(rig.centers_world, axis=0), axis=1)
    np.testing.assert_allclose(distances, 0.12, rtol=EXACT)


def test_frames_that_do_not_tell_which_way_round_are_refused() -> None:
    board = Chessboard(8, 6, 0.1)
    cameras = side_by_side("PINHOLE")
    observations, _ = moving(board, cameras)
    corners = [{0: seen.clip.corners[0], 1: seen.clip.corners[0]} for seen in observations]

    with pytest.raises(CalibrationError, match=r"'cam0' and .* do not tell which way round"):
        link_cameras(board, cameras, corners, is_labelled=False)


def test_cameras_are_linked_through_others() -> None:
    cameras = side_by_side("PINHOLE")
    observations, _ = moving(BOARD, cameras)
    frames = sorted(observations[0].clip.corners)
    shown = [set(frames[:7]), set(frames[5:]), set(frames[:7])]  # cam1 links the other two
    shown[1] |= {frames[0]}
    observations = [
        replace(
            seen,
            clip=replace(
                seen.clip,
                corners={f: c for f, c in seen.clip.corners.items() if f in these},
            ),
        )
        for seen, these in zip(observations, shown, strict=True)
    ]

    rig = solve_rig(BOARD, observations)

    distances = np.linalg.norm(np.diff(rig.centers_world, axis=0), axis=1)
    np.testing.assert_allclose(distances, 0.12, rtol=EXACT)


def test_a_camera_that_cannot_be_linked_is_named() -> None:
    cameras = side_by_side("PINHOLE")
    observations, _ = moving(BOARD, cameras)
    corners = [seen.clip.corners for seen in observations]
    frames = sorted(corners[0])
    corners[0] = {frame: corners[0][frame] for frame in frames[:6]}
    corners[1] = {frame: corners[1][frame] for frame in frames[:6]}
    corners[2] = {frame: corners[2][frame] for frame in frames[6:]}

    with pytest.raises(CalibrationError, match="camera 'cam2' never sees the board at the same"):
        link_cameras(BOARD, cameras, corners, is_labelled=False)


# --- Parts -----------------------------------------------------------------------------------


def test_a_board_is_located_and_its_other_tilt_told() -> None:
    camera = make_camera("cam", "OPENCV", look_at((0.9, -0.8, 0.9), (0.3, 0.25, 0.0)))
    corners = project(camera, camera.cam_from_world, BOARD)

    located = locate_board(camera, BOARD.points_board, corners)

    assert located is not None
    assert angle_between(located[0], camera.cam_from_world) < EXACT
    assert np.abs(located[0][:, 3] - camera.cam_from_world[:, 3]).max() < EXACT
    assert located[1] < EXACT_PX < located[2]


@pytest.mark.parametrize("share", [0.4, 1.0, 3.0])
def test_the_seed_finds_any_focal_length(share: float) -> None:
    camera = Camera(
        "cam", "PINHOLE", 640, 480, np.array([share * 640, share * 640, 320, 240]), np.eye(3, 4)
    )
    poses = board_poses(BOARD, 6, 0)
    for pose in poses:
        pose[2, 3] *= share
    views = [project(camera, pose, BOARD) for pose in poses]

    seed = seed_camera("cam", "PINHOLE", (640, 480), BOARD.points_board, views)

    assert seed.params[0] == pytest.approx(share * 640, rel=0.07)  # neighbours are 13 % apart


def test_settings_reach_the_provenance() -> None:
    observations = observe_exactly(BOARD, ring(BOARD, ["PINHOLE"]))

    rig = solve_rig(BOARD, observations, CalibrationSettings(loss_px=0.5))

    assert rig.provenance["settings"]["loss_px"] == 0.5
    assert rig.provenance["board"] == {"columns": 7, "rows": 6, "square_m": 0.1}
