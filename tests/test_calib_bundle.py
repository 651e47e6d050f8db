"""The joint adjustment: exact on exact points, and no worse than COLMAP's own."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.boards import LENSES
from helpers.bundles import back_to_back, make_bundle, perturbed

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import img_from_cam
from hybridve.calib.pose import angle_between, compose, moved_pose
from hybridve.calib.solving.bundle import (
    Bundle,
    adjust,
    lens_derivatives,
    view_residuals,
)

#: Noise-free points determine poses to this, metres and radians; rounding alone gives 1e-13.
EXACT = 1e-8


def assert_same_cameras(found: Bundle, truth: Bundle, tolerance: float = EXACT) -> None:
    for one, other in zip(found.cameras, truth.cameras, strict=True):
        assert angle_between(one.cam_from_world, other.cam_from_world) < tolerance
        assert np.abs(one.center_world - other.center_world).max() < tolerance


@pytest.mark.parametrize("model", LENSES)
def test_points_without_noise_give_back_the_rig(model: str) -> None:
    truth = make_bundle([model] * 3, n_stills=10)

    result = adjust(perturbed(truth, seed=1))

    assert_same_cameras(result.bundle, truth)
    assert max(np.nanmax(np.abs(missed)) for missed in result.residuals_px) < 1e-6


def test_the_robust_loss_has_the_same_answer_on_points_without_noise() -> None:
    truth = make_bundle(["OPENCV"] * 2, n_stills=8)

    assert_same_cameras(adjust(perturbed(truth, seed=2), loss_px=1.0).bundle, truth)


def test_the_answer_is_a_minimum() -> None:
    """No parameter moved by a hundredth of its standard deviation makes the squares smaller."""
    noisy = make_bundle(["OPENCV", "RADIAL"], n_stills=8, noise_px=0.4)
    result = adjust(noisy)

    def squares(bundle: Bundle) -> float:
        return float(sum((missed**2).sum() for missed in view_residuals(bundle)))

    least = squares(result.bundle)
    steps = 0.01 / np.sqrt(np.diag(result.information))
    for camera in range(2):
        for column in range(6):
            for sign in (-1.0, 1.0):
                change = np.zeros(6)
                change[column] = sign * steps[result.layout.of_camera[camera]][column]
                cameras = list(result.bundle.cameras)
                cameras[camera] = replace(
                    cameras[camera],
                    cam_from_world=moved_pose(cameras[camera].cam_from_world, change),
                )
                assert squares(replace(result.bundle, cameras=tuple(cameras))) > least
        for column, step in enumerate(steps[result.layout.of_lens[camera]]):
            for sign in (-1.0, 1.0):
                params = result.bundle.cameras[camera].params.copy()
                params[column] += sign * step
                cameras = list(result.bundle.cameras)
                cameras[camera] = replace(cameras[camera], params=params)
                assert squares(replace(result.bundle, cameras=tuple(cameras))) > least


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE", "EUCM"])
def test_lens_derivatives_predict_small_steps(model: str) -> None:
    camera = Camera("c", model, 640, 480, np.array(LENSES[model]), np.eye(3, 4))
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (50, 2)), np.ones(50)]) * rng.uniform(
        0.5, 5.0, (50, 1)
    )
    by_point, by_parameter = lens_derivatives(camera, points)

    step = 1e-4 * rng.normal(size=3)
    moved = img_from_cam(camera, points + step) - img_from_cam(camera, points - step)
    np.testing.assert_allclose(2.0 * by_point @ step, moved, atol=1e-5)  # the third order, px
    change = 1e-4 * rng.normal(size=len(camera.params))
    ahead, behind = (replace(camera, params=camera.params + s * change) for s in (1.0, -1.0))
    moved = img_from_cam(ahead, points) - img_from_cam(behind, points)
    np.testing.assert_allclose(2.0 * by_parameter @ change, moved, atol=1e-5)


def test_noisier_views_weigh_less_as_their_variance_says() -> None:
    """Weighing all views by s scales the information by 1 / s^2; noisy ones alone move nothing."""
    noisy = make_bundle(["PINHOLE", "PINHOLE"], n_stills=6, noise_px=0.3)
    even = adjust(noisy)
    weighed = [replace(view, sigma_px=0.5) for view in noisy.views]

    found = adjust(replace(noisy, views=tuple(weighed)))

    np.testing.assert_allclose(found.information, even.information / 0.25, rtol=1e-6)
    assert_same_cameras(found.bundle, even.bundle)
    clean = make_bundle(["PINHOLE", "PINHOLE"], n_stills=12)
    spoilt = [
        replace(view, pixels=view.pixels + 2.0, sigma_px=1e4) if index % 5 == 2 else view
        for index, view in enumerate(clean.views)
    ]
    assert_same_cameras(adjust(replace(clean, views=tuple(spoilt))).bundle, clean, 1e-6)


def test_a_lens_that_is_shared_is_one_lens() -> None:
    truth = make_bundle(["OPENCV"] * 3, n_stills=6, noise_px=0.3)
    shared = replace(truth, lens_of=(0, 0, 1))

    result = adjust(shared)

    first, second, third = (camera.params for camera in result.bundle.cameras)
    np.testing.assert_array_equal(first, second)
    assert (first != third).all()
    assert set(result.layout.of_lens) == {0, 1}


def test_a_lens_that_is_given_stays() -> None:
    truth = make_bundle(["OPENCV"] * 2, n_stills=6, noise_px=0.3)

    result = adjust(replace(truth, fixed_lenses=frozenset({1})))

    np.testing.assert_array_equal(result.bundle.cameras[1].params, truth.cameras[1].params)
    assert (result.bundle.cameras[0].params != truth.cameras[0].params).any()


def test_boards_back_to_back_give_the_rig_but_for_what_no_board_tells() -> None:
    """One camera sees the first board, one the second: the boards' place on their body is told."""
    truth = back_to_back()

    result = adjust(perturbed(truth, seed=5, by=0.003))

    assert max(np.nanmax(np.abs(missed)) for missed in result.residuals_px) < 1e-6
    # Where the second board sits is known as far as the body turned about all axes.
    found, expected = result.bundle.body_from_board[1], truth.body_from_board[1]
    assert angle_between(found, expected) < EXACT
    assert np.abs(found[:, 3] - expected[:, 3]).max() < EXACT
    assert_same_cameras(result.bundle, truth)


def test_points_that_were_not_seen_do_not_count() -> None:
    truth = make_bundle(["OPENCV"] * 2, n_stills=8)
    rng = np.random.default_rng(6)
    views = []
    for view in truth.views:
        pixels = view.pixels.copy()
        pixels[rng.permutation(len(pixels))[:20]] = np.nan
        views.append(replace(view, pixels=pixels))
    partial = replace(truth, views=tuple(views))

    result = adjust(perturbed(partial, seed=7))

    assert_same_cameras(result.bundle, truth)
    for view, missed in zip(views, result.residuals_px, strict=True):
        np.testing.assert_array_equal(np.isnan(missed), np.isnan(view.pixels))


def test_a_wrong_start_that_sees_nothing_is_named() -> None:
    truth = make_bundle(["OPENCV"] * 2, n_stills=4)
    about = np.column_stack([np.diag([1.0, -1.0, -1.0]), np.zeros(3)])
    away = tuple(
        replace(camera, cam_from_world=compose(about, camera.cam_from_world))
        for camera in truth.cameras
    )

    with pytest.raises(CalibrationError, match="cannot start"):
        adjust(replace(truth, cameras=away))
