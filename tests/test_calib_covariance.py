"""What a rig's covariance claims is what happens, over many calibrations of known rigs."""

from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import pytest
from helpers.boards import observe_exactly, ring
from helpers.bundles import BOARD, make_bundle
from helpers.theory import placed
from numpy.typing import NDArray

from hybridve.calib.calibrate import solve_rig
from hybridve.calib.camera import Camera
from hybridve.calib.lens import cam_from_img, project_points
from hybridve.calib.placing.marks import Mark
from hybridve.calib.placing.settings import CalibrationSettings
from hybridve.calib.pose import Pose, compose, invert, moved_pose
from hybridve.calib.rig import Rig
from hybridve.calib.solving.bundle import Adjusted, adjust
from hybridve.calib.solving.covariance import rig_covariance
from hybridve.calib.solving.errors_in_space import (
    parameter_slices,
    pixel_covariance,
    point_errors,
    point_gains,
    radius95,
    undistorted_covariance,
)
from hybridve.calib.solving.noise import measure_noise

NOISE_PX = 0.3
N_SEEDS = 25

MODELS = ["OPENCV", "RADIAL", "SIMPLE_RADIAL"]


@lru_cache(maxsize=1)
def calibrations() -> list[tuple[Adjusted, Rig]]:
    """Calibrations of one rig, from boards whose noise differs."""
    found = []
    for seed in range(N_SEEDS):
        adjusted = adjust(make_bundle(MODELS, n_stills=8, noise_px=NOISE_PX, seed=seed))
        sigma_px = measure_noise(adjusted).smooth_px
        rig = Rig(adjusted.bundle.cameras, covariance=rig_covariance(adjusted, sigma_px))
        found.append((adjusted, rig))
    return found


def truth() -> Rig:
    return Rig(make_bundle(MODELS, n_stills=0).cameras)


def pose_error(true: Pose, found: Pose) -> NDArray[np.float64]:
    """Return (omega, v) that leads from a pose to the true one, to first order."""
    change = compose(true, invert(found))
    rotation = change[:, :3]
    omega = 0.5 * np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    return np.concatenate([omega, change[:, 3]])


def parameter_errors(rig: Rig) -> NDArray[np.float64]:
    return np.concatenate(
        [
            np.concatenate(
                [
                    pose_error(true.cam_from_world, found.cam_from_world),
                    true.params - found.params,
                ]
            )
            for true, found in zip(truth().cameras, rig.cameras, strict=True)
        ]
    )


@pytest.mark.slow
def test_errors_are_as_large_as_the_covariance_says_in_every_direction() -> None:
    """The mean squared error in units of the covariance is one a parameter (chi-squared)."""
    squares = []
    for _, rig in calibrations():
        assert rig.covariance is not None
        errors = parameter_errors(rig)
        scale = np.sqrt(np.diag(rig.covariance.matrix))
        scaled = rig.covariance.matrix / np.outer(scale, scale)
        squares.append((errors / scale) @ np.linalg.solve(scaled, errors / scale))
    count = N_SEEDS * len(errors)
    # Four standard deviations of a chi-squared mean; sigma is itself told to a few percent.
    assert np.sum(squares) / count == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / count) + 0.04)


def test_points_are_placed_as_wrong_as_is_said() -> None:
    middle = BOARD.center_board
    points = middle + np.array([[0.0, 0.0, 0.1], [0.3, 0.1, 0.3], [-0.2, 0.2, 0.5]])
    ratios = []
    for _, rig in calibrations():
        told = point_errors(rig, points)
        assert (told.n_seeing == 3).all()
        errors = placed(rig, truth(), points) - points
        ratios.append((errors**2).sum(axis=1) / np.trace(told.covariance_m2, axis1=1, axis2=2))
    # Three axes of unlike size: at most as scattered as one degree of freedom.
    assert np.mean(ratios) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / N_SEEDS) / np.sqrt(2))


def test_gains_predict_how_a_point_moves_with_each_parameter() -> None:
    rig = truth()
    point = BOARD.center_board[None] + [[0.1, -0.05, 0.2]]
    gains, n_seeing = point_gains(rig, point)
    assert n_seeing == [3]
    for index, span in enumerate(parameter_slices(rig.cameras)):
        camera = rig.cameras[index]
        scales = np.concatenate([np.full(6, 1e-5), 1e-5 * np.abs(camera.params)])
        for column, step in enumerate(scales):
            cameras = list(rig.cameras)
            cameras[index] = changed(camera, column, step)
            shift = placed(rig, Rig(tuple(cameras)), point) - point
            np.testing.assert_allclose(gains[0, :, span.start + column] * step, shift[0], atol=2e-8)


def changed(camera: Camera, column: int, step: float) -> Camera:
    if column < 6:
        change = np.zeros(6)
        change[column] = step
        return replace(camera, cam_from_world=moved_pose(camera.cam_from_world, change))
    params = camera.params.copy()
    params[column - 6] += step
    return replace(camera, params=params)


def images_of_disturbed_rigs(
    rig: Rig, point: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """Return where a point is seen by rigs drawn from a rig's covariance: (count, C, 2) pixels."""
    assert rig.covariance is not None
    factor = np.linalg.cholesky(
        rig.covariance.matrix + 1e-30 * np.diag(np.diag(rig.covariance.matrix))
    )
    rng = np.random.default_rng(0)
    images = []
    for _ in range(count):
        change = factor @ rng.normal(size=len(factor))
        pixels = []
        for camera, span in zip(rig.cameras, parameter_slices(rig.cameras), strict=True):
            other = replace(
                camera,
                cam_from_world=moved_pose(camera.cam_from_world, change[span][:6]),
                params=camera.params + change[span][6:],
            )
            pixels.append(project_points(other, point)[0][0])
        images.append(pixels)
    return np.array(images)


def assert_covariance(found: NDArray[np.float64], told: NDArray[np.float64], count: int) -> None:
    scale = np.sqrt(np.outer(np.diag(told), np.diag(told)))
    np.testing.assert_allclose(found / scale, told / scale, atol=5.0 / np.sqrt(count))


@pytest.mark.slow
def test_the_pixel_covariance_is_that_of_the_images_of_disturbed_rigs() -> None:
    _, rig = calibrations()[0]
    point = BOARD.center_board[None] + [[0.1, 0.1, 0.3]]

    told = pixel_covariance(rig, point)[0].reshape(6, 6)

    images = images_of_disturbed_rigs(rig, point, 3000)
    assert_covariance(np.cov(images.reshape(3000, 6).T), told, 3000)


@pytest.mark.slow
def test_the_same_holds_in_images_freed_of_distortion() -> None:
    _, rig = calibrations()[0]
    point = BOARD.center_board + np.array([0.6, 0.35, 0.2])  # where the lenses bend

    told = undistorted_covariance(rig, point).reshape(6, 6)

    images = images_of_disturbed_rigs(rig, point[None], 3000)
    flat = np.stack(
        [
            cam_from_img(camera, images[:, index]) @ camera.pinhole[:2, :2].T
            for index, camera in enumerate(rig.cameras)
        ],
        axis=1,
    )
    assert_covariance(np.cov(flat.reshape(3000, 6).T), told, 3000)
    bent = pixel_covariance(rig, point[None])[0].reshape(6, 6)
    assert np.abs(np.diag(told) / np.diag(bent) - 1.0).max() > 0.05  # it does make a difference


def test_the_noise_of_points_is_found_out() -> None:
    noises = [measure_noise(adjusted) for adjusted, _ in calibrations()]

    assert np.mean([noise.rough_px for noise in noises]) == pytest.approx(NOISE_PX, rel=0.01)
    assert np.mean([noise.smooth_px for noise in noises]) == pytest.approx(NOISE_PX, rel=0.04)
    assert np.mean([noise.share_explained for noise in noises]) > 0.97


def test_a_lens_model_that_does_not_fit_is_not_taken_for_noise() -> None:
    """With a lens that cannot bend as the true one, errors are larger than points are noisy."""
    noisy = make_bundle(["OPENCV"] * 3, n_stills=10, noise_px=0.1)
    stiff = tuple(
        replace(camera, model="PINHOLE", params=camera.params[:4]) for camera in noisy.cameras
    )

    noise = measure_noise(adjust(replace(noisy, cameras=stiff)))

    assert noise.rough_px < 0.3
    assert noise.smooth_px > 3.0 * noise.rough_px
    assert noise.share_explained < 0.3


def test_a_shared_lens_is_fully_correlated_and_a_given_one_is_certain() -> None:
    noisy = make_bundle(["SIMPLE_RADIAL"] * 3, n_stills=6, noise_px=0.3)
    adjusted = adjust(replace(noisy, lens_of=(0, 0, 1), fixed_lenses=frozenset({1})))

    covariance = rig_covariance(adjusted, 0.3)

    assert covariance.labels[6:10] == ("cam1 f", "cam1 cx", "cam1 cy", "cam1 k")
    first, second, third = (slice(start + 6, start + 10) for start in (0, 10, 20))
    np.testing.assert_array_equal(covariance.matrix[first, first], covariance.matrix[first, second])
    assert (np.diag(covariance.matrix)[first] > 0).all()
    assert not covariance.matrix[third].any()


def test_what_no_picture_tells_stays_unknown_and_finite() -> None:
    """Every board parallel to the image: focal length and distance cannot be told apart."""
    bundle = make_bundle(["SIMPLE_PINHOLE"], n_stills=0)
    flat = np.column_stack([np.diag([1.0, -1.0, -1.0]), [-0.3, 0.2, 1.5]])
    camera = replace(bundle.cameras[0], cam_from_world=flat)
    pixels = project_points(camera, bundle.points_board[0])[0]
    view = replace(bundle.views[0], pixels=pixels)
    adjusted = adjust(replace(bundle, cameras=(camera,), views=(view,)))

    covariance = rig_covariance(adjusted, 0.1)

    deviations = dict(zip(covariance.labels, np.sqrt(np.diag(covariance.matrix)), strict=True))
    assert np.isfinite(covariance.matrix).all()
    assert deviations["cam1 f"] > 0.3 * camera.params[0]
    assert deviations["cam1 tz"] > 0.3 * 1.5


def test_the_95_percent_radius_is_that_of_closed_forms() -> None:
    """Chi-squared with three, two and one degrees of freedom, and a mixture by sampling."""
    mixture = np.diag([1.0, 0.5, 0.01])
    radii = radius95(np.array([np.eye(3), np.diag([1.0, 0, 1.0]), np.diag([0, 4.0, 0]), mixture]))

    np.testing.assert_allclose(radii[:3] ** 2, [7.8147, 5.9915, 4 * 3.8415], rtol=1e-3)
    rng = np.random.default_rng(0)
    squares = (rng.normal(size=(400_000, 3)) ** 2) @ np.diag(mixture)
    assert radii[3] ** 2 == pytest.approx(np.quantile(squares, 0.95), rel=0.01)
    np.testing.assert_allclose(radius95(np.eye(2)[None]) ** 2, 5.9915, rtol=1e-3)
    assert np.isnan(radius95(np.full((1, 3, 3), np.nan))).all()


def test_a_point_that_one_camera_sees_has_no_place() -> None:
    _, rig = calibrations()[0]
    behind_two = rig.cameras[0].center_world + 0.05 * rig.cameras[0].cam_from_world[2, :3]

    told = point_errors(rig, behind_two[None])

    assert told.n_seeing[0] < 2
    assert np.isnan(told.radius95_m[0])


@pytest.mark.slow
@pytest.mark.thorough
def test_a_world_found_by_the_cameras_shares_their_errors() -> None:
    """Points whose places are known define the world: errors of poses in it, over many seeds."""
    true = ring(BOARD, ["PINHOLE"] * 3)
    places = np.array([[0.0, 0.0, 0.0], [0.9, 0.1, 0.0], [0.1, 0.8, 0.05], [0.5, 0.4, 0.4]])
    settings_of = partial(CalibrationSettings, world="points")
    squares, count = 0.0, 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        marks = tuple(
            Mark(
                f"p{number}",
                {
                    camera.name: tuple(
                        project_points(camera, place[None])[0][0] + rng.normal(0.0, 0.5, 2)
                    )
                    for camera in true
                },
                place,
            )
            for number, place in enumerate(places)
        )
        seen = [
            replace(
                observed,
                sightings=tuple(
                    replace(
                        sighting,
                        pixels=sighting.pixels + rng.normal(0.0, 0.3, sighting.pixels.shape),
                    )
                    for sighting in observed.sightings
                ),
            )
            for observed in observe_exactly(BOARD, true, n_stills=8)
        ]
        rig = solve_rig([BOARD], seen, settings_of(marks=marks)).rig
        assert rig.covariance is not None
        spans = parameter_slices(rig.cameras)
        columns = np.concatenate([np.arange(span.start, span.start + 6) for span in spans])
        matrix = rig.covariance.matrix[np.ix_(columns, columns)]
        errors = np.concatenate(
            [
                pose_error(camera.cam_from_world, found.cam_from_world)
                for camera, found in zip(true, rig.cameras, strict=True)
            ]
        )
        scale = np.sqrt(np.diag(matrix))
        scaled = np.linalg.inv(matrix / np.outer(scale, scale))
        squares += float((errors / scale) @ scaled @ (errors / scale))
        count += len(errors)

    assert squares / count == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / count) + 0.05)
