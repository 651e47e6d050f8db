"""The model that the pictures call for is found, or a simpler one that does as well."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.boards import LENSES, board_poses, make_camera, project
from helpers.thorough import some_of
from numpy.typing import NDArray

from hybridve.calib.boards.board import Observations, Sighting
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import N_PARAMS, Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import img_from_cam
from hybridve.calib.plain import read_strictly, to_plain
from hybridve.calib.pose import rotation_about_axes, transform
from hybridve.calib.record import LensChoice
from hybridve.calib.solving.lens_choice import CANDIDATES, choose_lens, choose_shared_lens
from hybridve.calib.solving.lens_fit import fit_lens

BOARD = Chessboard(7, 6, 0.1)
SIZE_PX = (640, 480)


def noisy(camera: Camera, n_views: int, noise_px: float, seed: int = 0) -> Observations:
    rng = np.random.default_rng(seed)
    views = [
        project(camera, pose, BOARD) + rng.normal(0.0, noise_px, (42, 2))
        for pose in board_poses(BOARD, n_views, seed)
    ]
    return observe(camera, views)


def observe(camera: Camera, views: list[NDArray[np.float64]]) -> Observations:
    sightings = tuple(
        Sighting(f"{number}.png", None, 0, pixels) for number, pixels in enumerate(views)
    )
    return Observations(camera.name, "auto", SIZE_PX, sightings, True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "noise_px"), some_of((m, (0.1, 0.3)[i % 2]) for i, m in enumerate(CANDIDATES))
)
def test_the_true_model_is_found_or_a_simpler_one_that_predicts_as_well(
    model: str, noise_px: float
) -> None:
    camera = make_camera("cam", model, np.eye(3, 4))
    seen = noisy(camera, 10, noise_px, 1)

    chosen = choose_lens([BOARD], seen)

    true = fit_lens([BOARD], replace(seen, model=model))
    assert N_PARAMS[chosen.camera.model] <= N_PARAMS[model]
    # Within what the parameters that were saved would take up of pure noise, four times over.
    saved = N_PARAMS[model] - N_PARAMS[chosen.camera.model]
    assert chosen.rms_px**2 <= true.rms_px**2 * (1.0 + (10.0 + 8.0 * saved) / (2 * 10 * 42))


@pytest.mark.slow
@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "PINHOLE", "OPENCV"])
def test_models_that_differ_beyond_the_noise_are_told_apart(model: str) -> None:
    chosen = choose_lens([BOARD], noisy(make_camera("cam", model, np.eye(3, 4)), 12, 0.1, 2))

    assert chosen.camera.model == model
    assert chosen.choice is not None
    assert chosen.choice.model == model
    assert chosen.choice.candidates[model].bic <= 2.0
    assert chosen.choice.reason.startswith(f"{model}: ")


def test_a_wide_fisheye_is_recognised() -> None:
    params = (215.0, 217.0, 326.0, 233.0, -0.02, 0.004, -0.002, 0.0003)
    camera = Camera("cam", "OPENCV_FISHEYE", *SIZE_PX, np.array(params), np.eye(3, 4))
    rng = np.random.default_rng(0)
    views = []
    for direction_deg in range(0, 360, 18):
        tilt = (180.0 + rng.uniform(-40, 40), rng.uniform(-40, 40), 0.0)
        facing = rotation_about_axes((0.0, rng.uniform(20, 60), direction_deg))
        turn = facing @ rotation_about_axes(tilt)
        middle = facing @ [0.0, 0.0, rng.uniform(0.5, 0.8)]
        pose = np.column_stack([turn, middle - turn @ BOARD.center_board])
        points = transform(pose, BOARD.points_board)
        pixels = np.full((42, 2), np.nan)
        ahead = points[:, 2] > 0.05 * np.linalg.norm(points, axis=1)
        pixels[ahead] = img_from_cam(camera, points[ahead])
        views.append(pixels + rng.normal(0.0, 0.1, pixels.shape))

    chosen = choose_lens([BOARD], observe(camera, views))

    assert chosen.camera.model in {"OPENCV_FISHEYE", "RADIAL_FISHEYE", "EUCM"}
    assert chosen.rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
    assert chosen.choice is not None
    assert "PINHOLE" not in chosen.choice.candidates  # straight lines end long before


@pytest.mark.slow
def test_the_choice_can_be_stored_and_says_what_is_told_apart() -> None:
    chosen = choose_lens([BOARD], noisy(make_camera("cam", "OPENCV", np.eye(3, 4)), 25, 0.1))

    assert chosen.choice is not None
    told = json.loads(json.dumps(to_plain(chosen.choice), allow_nan=False))
    assert read_strictly(LensChoice, told, "choice") == chosen.choice
    assert "k1, k2, p1, p2 are told apart from zero" in chosen.choice.reason


@pytest.mark.slow
def test_what_hangs_together_in_a_view_counts_less() -> None:
    camera = make_camera("cam", "PINHOLE", np.eye(3, 4))
    rng = np.random.default_rng(1)
    x, y = BOARD.points_board[:, :2].T - BOARD.center_board[:2, None]
    views = []
    for pose in board_poses(BOARD, 20, 1):
        bow = np.column_stack([x * x, y * y]) / 0.1  # another bend of the board in every picture
        bent = project(camera, pose, BOARD) + bow * rng.normal(0.0, 0.6, 2)
        views.append(bent + rng.normal(0.0, 0.1, bent.shape))

    bent_choice = choose_lens([BOARD], observe(camera, views)).choice
    flat_choice = choose_lens([BOARD], noisy(camera, 20, 0.1, 1)).choice

    assert bent_choice is not None
    assert flat_choice is not None
    assert flat_choice.inflation < 1.6
    assert bent_choice.inflation > 2.0
    assert bent_choice.n_effective < 20 * 42


@pytest.mark.slow
def test_the_choice_does_not_depend_on_the_order_of_sightings() -> None:
    seen = noisy(make_camera("cam", "RADIAL", np.eye(3, 4)), 12, 0.2)

    first = choose_lens([BOARD], seen)
    turned = choose_lens([BOARD], replace(seen, sightings=seen.sightings[::-1]))

    assert first.choice == turned.choice
    np.testing.assert_array_equal(first.camera.params, turned.camera.params)


@pytest.mark.slow
def test_cameras_that_share_a_lens_choose_together() -> None:
    camera = make_camera("a", "OPENCV", np.eye(3, 4))
    seen = [noisy(camera, 12, 0.1, 1), noisy(replace(camera, name="b"), 12, 0.1, 2)]

    first, second = choose_shared_lens([BOARD], seen)

    assert (first.camera.name, second.camera.name) == ("a", "b")
    assert first.camera.model == second.camera.model == "OPENCV"
    np.testing.assert_array_equal(first.camera.params, second.camera.params)


@pytest.mark.slow
def test_parallel_boards_choose_nothing() -> None:
    camera = make_camera("cam", "OPENCV", np.eye(3, 4))
    rng = np.random.default_rng(4)
    views = []
    for _ in range(10):
        turn = rotation_about_axes((200.0, 10.0, 0.0))
        middle = np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2), rng.uniform(0.9, 1.6)])
        pose = np.column_stack([turn, middle - turn @ BOARD.center_board])
        views.append(project(camera, pose, BOARD) + rng.normal(0.0, 0.1, (42, 2)))

    with pytest.raises(CalibrationError, match=r"'cam'.* parallel "):
        choose_lens([BOARD], observe(camera, views))


def test_every_candidate_is_a_lens_that_the_tests_know() -> None:
    assert set(CANDIDATES) <= set(LENSES)
    assert [N_PARAMS[model] for model in CANDIDATES] == sorted(
        N_PARAMS[model] for model in CANDIDATES
    )
