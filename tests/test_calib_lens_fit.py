"""One lens: recovered exactly from what theory says suffices, refused where it does not."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.boards import LENSES, board_poses, make_camera, project
from numpy.typing import NDArray

from hybridve.calib.boards.board import Observations, Sighting
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import img_from_cam
from hybridve.calib.pose import Pose, angle_between, rotation_about_axes, transform
from hybridve.calib.solving.lens_fit import LensSettings, fit_lens, fit_shared_lens
from hybridve.calib.solving.locate import locate_board, rays_of

#: Noise-free corners determine poses to this (metres, radians) ...
EXACT = 1e-6

#: ... and where a lens images rays to this: coefficients need not be unique, what they do is.
EXACT_PX = 1e-5

BOARD = Chessboard(7, 6, 0.1)
SMALL_BOARD = Chessboard(5, 4, 0.08)
SIZE_PX = (640, 480)

#: Lenses that see 150 degrees and more in an image of 640x480.
WIDE: dict[str, tuple[float, ...]] = {
    "OPENCV_FISHEYE": (215.0, 217.0, 326.0, 233.0, -0.02, 0.004, -0.002, 0.0003),
    "RADIAL_FISHEYE": (215.0, 326.0, 233.0, -0.02, 0.004),
    "SIMPLE_FISHEYE": (215.0, 326.0, 233.0),
    "FISHEYE": (215.0, 217.0, 326.0, 233.0),
    "EUCM": (220.0, 222.0, 326.0, 233.0, 0.62, 1.1),
    "DIVISION": (210.0, 212.0, 326.0, 233.0, -0.25),
    "FOV": (190.0, 192.0, 326.0, 233.0, 0.95),
}

#: Lenses that see 10 degrees.
LONG: dict[str, tuple[float, ...]] = {
    "SIMPLE_PINHOLE": (3650.0, 326.0, 233.0),
    "RADIAL": (3650.0, 326.0, 233.0, -0.2, 0.5),
    "OPENCV": (3650.0, 3660.0, 326.0, 233.0, -0.25, 0.8, 0.001, -0.0005),
    "OPENCV_FISHEYE": (3650.0, 3660.0, 326.0, 233.0, -0.25, 0.8, 0.001, -0.0005),
}


def observe(
    camera: Camera, views: list[NDArray[np.float64]], board: int = 0, model: str | None = None
) -> Observations:
    sightings = tuple(
        Sighting(f"{number}.png", None, board, pixels) for number, pixels in enumerate(views)
    )
    return Observations(camera.name, model or camera.model, SIZE_PX, sightings, True)


def seen_partly(
    camera: Camera, half_angle_deg: float, distance_m: float, count: int
) -> tuple[list[Pose], list[NDArray[np.float64]]]:
    """Return boards all over what a lens sees; corners outside the image are not seen."""
    rng = np.random.default_rng(count)
    poses: list[Pose] = []
    views: list[NDArray[np.float64]] = []
    while len(poses) < count:
        off = np.deg2rad(half_angle_deg) * np.sqrt(rng.uniform())
        around = rng.uniform(0.0, 2.0 * np.pi)
        forward = np.array(
            [np.sin(off) * np.cos(around), np.sin(off) * np.sin(around), np.cos(off)]
        )
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        facing = np.column_stack([right, np.cross(forward, right), forward])
        tilt = rotation_about_axes(
            (180.0 + rng.uniform(-40, 40), rng.uniform(-40, 40), rng.uniform(-30, 30))
        )
        middle = forward * distance_m * rng.uniform(0.8, 1.6)
        pose = np.column_stack([facing @ tilt, middle - facing @ tilt @ BOARD.center_board])
        points = transform(pose, BOARD.points_board)
        ahead = points[:, 2] > np.cos(np.deg2rad(87)) * np.linalg.norm(points, axis=1)
        pixels = np.full((len(points), 2), np.nan)
        if ahead.any():
            pixels[ahead] = img_from_cam(camera, points[ahead])
        pixels[~((np.nan_to_num(pixels, nan=-1.0) >= 0) & (pixels < SIZE_PX)).all(axis=1)] = np.nan
        if np.isfinite(pixels).all(axis=1).sum() >= 12:
            poses.append(pose)
            views.append(pixels)
    return poses, views


def assert_exact(
    camera: Camera, poses: list[Pose], views: list[NDArray[np.float64]], exact: float = EXACT
) -> None:
    found = fit_lens([BOARD], observe(camera, views))

    assert not found.dropped
    assert not found.outliers
    for number, pose in enumerate(poses):
        located = found.views[f"{number}.png", 0]
        assert angle_between(located, pose) < exact
        assert np.abs(located[:, 3] - pose[:, 3]).max() < exact * np.linalg.norm(pose[:, 3])
    pixels = np.concatenate(views)
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    again = img_from_cam(found.camera, rays_of(camera, pixels))
    assert np.abs(again - pixels).max() < EXACT_PX


@pytest.mark.parametrize("n_views", [3, 10])
@pytest.mark.parametrize("model", LENSES)
def test_every_lens_is_recovered_from_noise_free_corners(model: str, n_views: int) -> None:
    camera = make_camera("cam", model, np.eye(3, 4))
    poses = board_poses(BOARD, n_views, 0)

    assert_exact(camera, poses, [project(camera, pose, BOARD) for pose in poses])


@pytest.mark.parametrize("n_views", [3, 16])
@pytest.mark.parametrize("model", WIDE)
def test_wide_lenses_are_recovered_from_boards_at_their_edge(model: str, n_views: int) -> None:
    camera = Camera("cam", model, *SIZE_PX, np.array(WIDE[model]), np.eye(3, 4))
    poses, views = seen_partly(camera, 75.0, 0.55, n_views)
    rays = rays_of(camera, np.concatenate(views))
    assert n_views == 3 or np.rad2deg(np.arccos(np.nanmin(rays[:, 2]))) > 75.0
    assert n_views == 3 or any(np.isnan(pixels).any() for pixels in views)

    assert_exact(camera, poses, views)


@pytest.mark.parametrize("n_views", [3, 10])
@pytest.mark.parametrize("model", LONG)
def test_long_lenses_are_recovered(model: str, n_views: int) -> None:
    camera = Camera("cam", model, *SIZE_PX, np.array(LONG[model]), np.eye(3, 4))

    assert_exact(camera, *seen_partly(camera, 3.0, 6.0, n_views))


def test_a_board_is_located_from_some_of_its_corners_far_off_the_axis() -> None:
    camera = Camera("cam", "FISHEYE", *SIZE_PX, np.array(WIDE["FISHEYE"]), np.eye(3, 4))
    poses, views = seen_partly(camera, 80.0, 0.55, 12)

    for pose, pixels in zip(poses, views, strict=True):
        located = locate_board(camera, BOARD.points_board, pixels)

        assert located is not None
        assert angle_between(located[0], pose) < EXACT
        assert located[1] < EXACT_PX


def test_corners_on_a_line_or_fewer_than_four_locate_nothing() -> None:
    camera = make_camera("cam", "OPENCV", np.eye(3, 4))
    pixels = project(camera, board_poses(BOARD, 1, 0)[0], BOARD)
    row, three = np.full_like(pixels, np.nan), np.full_like(pixels, np.nan)
    row[:7] = pixels[:7]
    three[[0, 1, 7]] = pixels[[0, 1, 7]]

    assert locate_board(camera, BOARD.points_board, row) is None
    assert locate_board(camera, BOARD.points_board, three) is None


# --- Noise, wrong views and wrong corners -----------------------------------------------------


def noisy(
    camera: Camera, n_views: int, noise_px: float, seed: int = 0, board: Chessboard = BOARD
) -> list[NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    return [
        project(camera, pose, board) + rng.normal(0.0, noise_px, (len(board.points_board), 2))
        for pose in board_poses(board, n_views, seed)
    ]


@pytest.mark.slow
def test_noise_and_parameters_are_as_far_off_as_is_told() -> None:
    camera = make_camera("cam", "OPENCV", np.eye(3, 4))
    off = []
    for seed in range(10):
        found = fit_lens([BOARD], observe(camera, noisy(camera, 15, 0.2, seed)))
        assert found.noise_px == pytest.approx(0.2, rel=0.1)
        off.append((found.camera.params - camera.params) / found.sigmas)

    # Of 80 standard normal deviates, by chance outside once in a thousand runs.
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.25)


def test_the_order_of_sightings_does_not_matter_to_the_bit() -> None:
    camera = make_camera("cam", "OPENCV", np.eye(3, 4))
    seen = observe(camera, noisy(camera, 12, 0.3))
    turned = replace(seen, sightings=seen.sightings[::-1])

    first, again, other = (fit_lens([BOARD], each) for each in (seen, seen, turned))

    for found in (again, other):
        np.testing.assert_array_equal(found.camera.params, first.camera.params)
        assert list(found.views) == list(first.views)
        for key, pose in first.views.items():
            np.testing.assert_array_equal(found.views[key], pose)


def test_blurred_and_wrong_views_are_dropped_and_named() -> None:
    camera = make_camera("cam", "OPENCV", np.eye(3, 4))
    views = noisy(camera, 14, 0.1)
    rng = np.random.default_rng(3)
    few = np.full_like(views[0], np.nan)
    few[:5] = views[0][:5]
    row = np.full_like(views[0], np.nan)
    row[:7] = views[0][:7]
    spoilt = [
        views[3] + rng.normal(0.0, 3.0, (42, 2)),
        views[5] * [1.0, 1.08],
        views[7][::-1] + np.linspace(0, 60, 84).reshape(42, 2),
        few,
        row,
    ]

    found = fit_lens([BOARD], observe(camera, views + spoilt))

    assert set(found.dropped) == {f"{number}.png" for number in range(14, 19)}
    assert "px rms, limit" in found.dropped["14.png"]
    assert found.dropped["17.png"] == "only 5 corners seen, expected 6 or more"
    assert found.dropped["18.png"] == "its 7 corners lie on a line"
    assert len(found.views) == 14
    assert np.abs((found.camera.params - camera.params) / found.sigmas).max() < 5.0


def test_single_wrong_corners_are_set_aside_and_listed() -> None:
    camera = make_camera("cam", "OPENCV", np.eye(3, 4))
    views = noisy(camera, 12, 0.1)
    clean = fit_lens([BOARD], observe(camera, views))
    wrong = [pixels.copy() for pixels in views]
    wrong[2][10] += (40.0, 9.0)
    wrong[5][41] += (0.0, -5.0)

    found = fit_lens([BOARD], observe(camera, wrong))

    assert not found.dropped
    told = {(image, board, corner): miss for image, board, corner, miss in found.outliers}
    assert set(told) == {("2.png", 0, 10), ("5.png", 0, 41)}
    assert told["2.png", 0, 10] == pytest.approx(41.0, abs=1.0)
    assert told["5.png", 0, 41] == pytest.approx(5.0, abs=0.5)
    assert np.isnan(found.pixels["2.png", 0][10]).all()
    # Two corners of 504 less: nearly the same lens as from the views without the mistakes.
    assert np.abs((found.camera.params - clean.camera.params) / clean.sigmas).max() < 0.5


def test_several_boards_may_be_in_one_image() -> None:
    camera = make_camera("cam", "OPENCV", np.eye(3, 4))
    boards = [BOARD, SMALL_BOARD]
    poses = [board_poses(board, 6, index) for index, board in enumerate(boards)]
    sightings = tuple(
        Sighting(f"{number}.png", None, index, project(camera, poses[index][number], board))
        for index, board in enumerate(boards)
        for number in range(6)
    )
    seen = Observations("cam", "OPENCV", SIZE_PX, sightings, True)

    found = fit_lens(boards, seen)

    assert len(found.views) == 12
    for (image, index), pose in found.views.items():
        true_pose = poses[index][int(image.removesuffix(".png"))]
        assert angle_between(pose, true_pose) < EXACT
        assert np.abs(pose[:, 3] - true_pose[:, 3]).max() < EXACT


def test_frames_of_a_moving_clip_count_and_those_of_a_still_one_do_not() -> None:
    camera = make_camera("cam", "OPENCV", np.eye(3, 4))
    views = noisy(camera, 8, 0.1)
    sightings = tuple(
        Sighting(f"board clip, frame {number}", number, 0, pixels)
        for number, pixels in enumerate(views)
    )

    moving = fit_lens([BOARD], Observations("cam", "OPENCV", SIZE_PX, sightings, False))

    assert len(moving.views) == 8
    with pytest.raises(CalibrationError, match=r"'cam'.*only lying still.*expected 3 views"):
        fit_lens([BOARD], Observations("cam", "OPENCV", SIZE_PX, sightings, True))


def test_cameras_that_share_a_lens_get_one_and_their_own_views() -> None:
    first = make_camera("a", "OPENCV", np.eye(3, 4))
    second = replace(first, name="b")
    seen = [observe(first, noisy(first, 6, 0.1, 1)), observe(second, noisy(second, 9, 0.1, 2))]

    shared = fit_shared_lens([BOARD], seen)
    turned = fit_shared_lens([BOARD], seen[::-1])

    assert [lens.camera.name for lens in shared] == ["a", "b"]
    assert [len(lens.views) for lens in shared] == [6, 9]
    np.testing.assert_array_equal(shared[0].camera.params, shared[1].camera.params)
    np.testing.assert_array_equal(shared[0].camera.params, turned[0].camera.params)
    alone = fit_lens([BOARD], seen[0])
    assert (shared[0].sigmas < alone.sigmas).all()


def test_cameras_of_different_models_share_no_lens() -> None:
    camera = make_camera("a", "OPENCV", np.eye(3, 4))
    seen = observe(camera, noisy(camera, 4, 0.1))

    with pytest.raises(CalibrationError, match=r"'a' and 'b' share a lens.*expected the same"):
        fit_shared_lens([BOARD], [seen, replace(seen, name="b", model="RADIAL")])


def test_given_parameters_stay_and_views_are_located() -> None:
    camera = make_camera("cam", "OPENCV", np.eye(3, 4))
    poses = board_poses(BOARD, 2, 0)  # fewer than a lens needs
    views = [project(camera, pose, BOARD) for pose in poses]

    found = fit_lens([BOARD], observe(camera, views), fixed_params=camera.params)

    np.testing.assert_array_equal(found.camera.params, camera.params)
    np.testing.assert_array_equal(found.sigmas, np.zeros(8))
    for number, pose in enumerate(poses):
        assert angle_between(found.views[f"{number}.png", 0], pose) < EXACT


# --- What cannot be told ----------------------------------------------------------------------


def placed(rotate_deg: tuple[float, float, float], middle: tuple[float, float, float]) -> Pose:
    turn = rotation_about_axes(rotate_deg)
    return np.column_stack([turn, np.array(middle) - turn @ BOARD.center_board])


def parallel_boards(tilt_deg: float) -> list[Pose]:
    rng = np.random.default_rng(4)
    return [
        placed(
            (180.0 + tilt_deg, 0.6 * tilt_deg, 0.0),
            (rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2), rng.uniform(0.9, 1.6)),
        )
        for _ in range(10)
    ]


@pytest.mark.parametrize("noise_px", [0.0, 0.2])
@pytest.mark.parametrize(
    ("model", "tilt_deg"),
    [("PINHOLE", 0.0), ("OPENCV", 0.0), ("OPENCV", 30.0), ("OPENCV_FISHEYE", 30.0)],
)
def test_parallel_boards_are_refused(model: str, tilt_deg: float, noise_px: float) -> None:
    camera = make_camera("cam", model, np.eye(3, 4))
    rng = np.random.default_rng(0)
    views = [
        project(camera, pose, BOARD) + rng.normal(0.0, noise_px, (42, 2))
        for pose in parallel_boards(tilt_deg)
    ]

    with pytest.raises(CalibrationError, match=r"'cam'.* parallel .*record the board tilted"):
        fit_lens([BOARD], observe(camera, views))

    given = fit_lens([BOARD], observe(camera, views), fixed_params=camera.params)
    assert len(given.views) == 10


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV"])
def test_a_board_too_small_in_the_image_is_refused(model: str) -> None:
    camera = make_camera("cam", model, np.eye(3, 4))
    rng = np.random.default_rng(0)
    views = []
    for pose in board_poses(BOARD, 12, 0):
        far = pose.copy()
        far[:, 3] += (*rng.uniform(-2.0, 2.0, 2), 12.0)
        views.append(project(camera, far, BOARD) + rng.normal(0.0, 0.2, (42, 2)))

    with pytest.raises(CalibrationError, match=r"'cam'.*too small in the image.*closer"):
        fit_lens([BOARD], observe(camera, views))


def test_too_few_views_are_named_with_what_was_expected() -> None:
    camera = make_camera("cam", "OPENCV", np.eye(3, 4))
    seen = replace(observe(camera, noisy(camera, 2, 0.1)), missed={"9.png": "no board"})

    with pytest.raises(CalibrationError, match=r"'cam'.*in 2 of 3 pictures, expected 3 views"):
        fit_lens([BOARD], seen)
    with pytest.raises(CalibrationError, match="in 2 of 3 pictures, expected 7 views"):
        fit_lens([BOARD], seen, LensSettings(min_views=7))


def test_views_that_fit_no_lens_are_named() -> None:
    camera = make_camera("cam", "OPENCV", np.eye(3, 4))
    rng = np.random.default_rng(5)
    grid = project(camera, board_poses(BOARD, 1, 0)[0], BOARD)

    with pytest.raises(CalibrationError, match=r"'cam'.*views of the board"):
        fit_lens([BOARD], observe(camera, [grid + rng.normal(0, 20.0, (42, 2)) for _ in range(4)]))


def test_boards_in_one_part_of_the_image_are_warned_of() -> None:
    camera = make_camera("cam", "PINHOLE", np.eye(3, 4))
    far = board_poses(BOARD, 12, 0)
    for pose in far:
        pose[2, 3] *= 2.5

    warned = fit_lens([BOARD], observe(camera, [project(camera, pose, BOARD) for pose in far]))
    near = fit_lens([BOARD], observe(camera, noisy(camera, 12, 0.1)))

    assert any("% of the image, expected 40 % or more" in text for text in warned.warnings)
    assert not near.warnings
