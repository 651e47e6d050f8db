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
from helpers.records import record_of
from helpers.thorough import some_of
from numpy.typing import NDArray

from hybridve.calib.boards.board import Observations, Sighting
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.calibrate import solve_rig
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import cam_from_img, img_from_cam
from hybridve.calib.placing.settings import CalibrationSettings, LensRequest
from hybridve.calib.pose import angle_between, compose, invert
from hybridve.calib.record import BoardRecord
from hybridve.calib.rig import Rig
from hybridve.calib.solving.lens_fit import LensSettings

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


@pytest.mark.parametrize("model", some_of(LENSES))
def test_noise_free_corners_give_back_the_rig(model: str) -> None:
    cameras = ring(BOARD, [model, model])

    rig = solve_rig([BOARD], observe_exactly(BOARD, cameras)).rig

    assert_same_rig(rig, cameras)
    assert record_of(rig).rms_px < EXACT_PX


@pytest.mark.slow
def test_models_may_be_mixed_in_one_rig() -> None:
    cameras = ring(BOARD, ["OPENCV", "OPENCV_FISHEYE", "PINHOLE", "DIVISION"])

    rig = solve_rig([BOARD], observe_exactly(BOARD, cameras)).rig

    assert [camera.model for camera in rig.cameras] == [camera.model for camera in cameras]
    assert_same_rig(rig, cameras)


@pytest.mark.slow
def test_the_order_of_cameras_does_not_matter() -> None:
    cameras = ring(BOARD, ["OPENCV", "RADIAL", "OPENCV"])
    observations = observe_exactly(BOARD, cameras, noise_px=0.3)

    rig = solve_rig([BOARD], observations).rig
    turned = solve_rig([BOARD], observations[::-1]).rig

    assert [camera.name for camera in turned.cameras] == ["cam3", "cam2", "cam1"]
    for camera in rig.cameras:
        np.testing.assert_array_equal(turned[camera.name].params, camera.params)
        np.testing.assert_array_equal(turned[camera.name].cam_from_world, camera.cam_from_world)


@pytest.mark.slow
def test_the_same_corners_give_the_same_rig_to_the_bit() -> None:
    observations = observe_exactly(BOARD, ring(BOARD, ["OPENCV", "OPENCV"]), noise_px=0.3)

    first, second = (solve_rig([BOARD], observations).rig for _ in range(2))

    for a, b in zip(first.cameras, second.cameras, strict=True):
        np.testing.assert_array_equal(a.params, b.params)
        np.testing.assert_array_equal(a.cam_from_world, b.cam_from_world)
    assert first.provenance == second.provenance


@pytest.mark.slow
def test_the_error_that_is_told_is_the_noise_that_was_there() -> None:
    noise_px = 0.2
    cameras = ring(BOARD, ["OPENCV", "OPENCV"])

    rig = solve_rig([BOARD], observe_exactly(BOARD, cameras, n_stills=30, noise_px=noise_px)).rig

    # Length of a two-dimensional error; parameters take up a few percent.
    assert record_of(rig).rms_px == pytest.approx(noise_px * np.sqrt(2), rel=0.06)
    for told in record_of(rig).cameras.values():
        assert told.intrinsics.rms_px == pytest.approx(noise_px * np.sqrt(2), rel=0.1)
        assert told.intrinsics.views_used == 30


def test_the_world_has_z_up_and_cameras_above_the_floor() -> None:
    cameras = ring(BOARD, ["PINHOLE", "PINHOLE"])

    rig = solve_rig([BOARD], observe_exactly(BOARD, cameras)).rig

    np.testing.assert_allclose(rig.centers_world[:, 2], [1.0, 1.15], atol=EXACT)


def with_stills(seen: Observations, stills: dict[str, NDArray[np.float64]]) -> Observations:
    """Return observations with other stills than they had."""
    clip = tuple(sighting for sighting in seen.sightings if sighting.instant is not None)
    made = tuple(Sighting(name, None, 0, pixels) for name, pixels in stills.items())
    return replace(seen, sightings=(*made, *clip))


def stills_of(seen: Observations) -> dict[str, NDArray[np.float64]]:
    return {
        sighting.image: sighting.pixels for sighting in seen.sightings if sighting.instant is None
    }


def test_blurred_and_wrong_views_are_dropped_and_named() -> None:
    cameras = ring(BOARD, ["OPENCV"])
    (seen,) = observe_exactly(BOARD, cameras, n_stills=14, noise_px=0.1)
    rng = np.random.default_rng(3)
    corners = stills_of(seen)
    corners["blurred"] = corners["3.png"] + rng.normal(0.0, 3.0, (42, 2))
    corners["bent"] = corners["5.png"] * [1.0, 1.08]
    corners["another board"] = corners["7.png"][::-1] + np.linspace(0, 60, 84).reshape(42, 2)

    rig = solve_rig([BOARD], [with_stills(seen, corners)]).rig

    told = record_of(rig).cameras["cam1"].intrinsics
    assert set(told.views_dropped) == {"blurred", "bent", "another board"}
    assert all("px" in reason for reason in told.views_dropped.values())
    assert told.views_used == 14
    # As good as without them: 14 views with 0.1 px of noise give the centre to a few mm.
    assert np.linalg.norm(rig.cameras[0].center_world - cameras[0].center_world) < 0.005


def test_a_corner_that_misses_by_far_is_left_out_and_listed() -> None:
    cameras = ring(BOARD, ["OPENCV", "OPENCV"])
    observations = observe_exactly(BOARD, cameras, n_stills=14, noise_px=0.2)
    corners = stills_of(observations[0])
    spoilt = {name: pixels.copy() for name, pixels in corners.items()}
    spoilt["4.png"][17] += [2.5, 0.0]
    observations[0] = with_stills(observations[0], spoilt)

    told = solve_rig([BOARD], observations).record.adjustment

    assert told is not None
    assert told.outliers == 1
    (outlier,) = told.worst_outliers
    assert (outlier.camera, outlier.image, outlier.point) == ("cam1", "4.png", 17)
    assert outlier.missed_px == pytest.approx(2.5, abs=1.0)


def test_too_few_views_are_named_with_what_was_expected() -> None:
    (seen,) = observe_exactly(BOARD, ring(BOARD, ["OPENCV"]), n_stills=2)

    with pytest.raises(CalibrationError, match=r"'cam1'.*in 2 of 2 pictures, expected 3"):
        solve_rig([BOARD], [seen])


def test_a_clip_from_another_lens_is_refused() -> None:
    cameras = ring(BOARD, ["PINHOLE", "PINHOLE"])
    observations = observe_exactly(BOARD, cameras)
    seen = observations[1]
    clip = seen.sightings[-1]
    middle = clip.pixels.mean(axis=0)
    bowed = clip.pixels + 2e-3 * (clip.pixels - middle) ** 2
    observations[1] = replace(seen, sightings=(*seen.sightings[:-1], replace(clip, pixels=bowed)))

    with pytest.raises(CalibrationError, match="'cam2'"):
        solve_rig([BOARD], observations)


# --- What is asked of lenses ------------------------------------------------------------------


def test_cameras_of_one_group_share_a_lens() -> None:
    cameras = ring(BOARD, ["OPENCV"] * 3)
    observations = observe_exactly(BOARD, cameras, noise_px=0.3)
    requests = {"cam1": LensRequest(group="wide"), "cam3": LensRequest(group="wide")}

    rig = solve_rig([BOARD], observations, requests=requests).rig

    np.testing.assert_array_equal(rig["cam1"].params, rig["cam3"].params)
    assert (rig["cam1"].params != rig["cam2"].params).all()
    assert rig.covariance is not None
    of_lens = [index for index, label in enumerate(rig.covariance.labels) if label.endswith(" fx")]
    variances = rig.covariance.matrix[np.ix_(of_lens, of_lens)]
    assert variances[0, 2] == pytest.approx(variances[0, 0])


def test_a_lens_that_is_known_stays_as_it_is() -> None:
    cameras = ring(BOARD, ["OPENCV"] * 2)
    observations = observe_exactly(BOARD, cameras, noise_px=0.3)
    params = tuple(float(value) for value in cameras[1].params)

    rig = solve_rig([BOARD], observations, requests={"cam2": LensRequest(params=params)}).rig

    np.testing.assert_array_equal(rig["cam2"].params, cameras[1].params)
    assert rig.covariance is not None
    for label, variance in zip(rig.covariance.labels, np.diag(rig.covariance.matrix), strict=True):
        is_given = label.startswith("cam2") and label.split()[1][0] in "fckp"
        assert (variance == 0) == is_given, label


def test_a_known_lens_needs_no_stills() -> None:
    cameras = ring(BOARD, ["OPENCV"] * 2)
    observations = [with_stills(seen, {}) for seen in observe_exactly(BOARD, cameras)]
    requests = {
        camera.name: LensRequest(params=tuple(float(value) for value in camera.params))
        for camera in cameras
    }

    assert_same_rig(solve_rig([BOARD], observations, requests=requests).rig, cameras)


def test_a_still_board_alone_fits_no_lens() -> None:
    (seen,) = observe_exactly(BOARD, ring(BOARD, ["OPENCV"]))

    with pytest.raises(CalibrationError, match=r"'cam1'.*lying still.*`intrinsics`"):
        solve_rig([BOARD], [with_stills(seen, {})])


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
        sightings = tuple(
            Sighting(
                f"board clip, frame {5 * number}",
                5 * number,
                0,
                project(camera, compose(camera.cam_from_world, pose), board),
            )
            for number, pose in enumerate(world_from_board)
        )
        size_px = (camera.width_px, camera.height_px)
        observations.append(Observations(camera.name, camera.model, size_px, sightings, False))
    return observations, world_from_board


def side_by_side(model: str) -> list[Camera]:
    return [
        make_camera(f"cam{index}", model, look_at((0.12 * index, -1.0, 1.0), (0.1, 0.0, 0.8)))
        for index in range(3)
    ]


@pytest.mark.slow
def test_a_moving_board_ties_cameras_together() -> None:
    cameras = side_by_side("OPENCV")
    observations, world_from_board = moving(BOARD, cameras)

    rig = solve_rig([BOARD], observations).rig

    # The world is the board in the first frame.
    expected = [
        replace(camera, cam_from_world=compose(camera.cam_from_world, world_from_board[0]))
        for camera in cameras
    ]
    assert_same_rig(rig, expected)


@pytest.mark.slow
def test_frames_tell_which_way_round_a_symmetric_board_was_seen() -> None:
    board = Chessboard(8, 6, 0.1)
    cameras = side_by_side("PINHOLE")
    observations, _ = moving(board, cameras)
    rng = np.random.default_rng(2)
    turned = [
        replace(
            seen,
            sightings=tuple(
                replace(sighting, pixels=sighting.pixels[board.looks[rng.integers(2)]])
                for sighting in seen.sightings
            ),
        )
        for seen in observations
    ]

    rig = solve_rig([board], turned).rig

    distances = np.linalg.norm(np.diff(rig.centers_world, axis=0), axis=1)
    np.testing.assert_allclose(distances, 0.12, rtol=EXACT)


def test_cameras_are_linked_through_others() -> None:
    cameras = side_by_side("PINHOLE")
    observations, _ = moving(BOARD, cameras)
    shown = [range(7), (0, *range(5, 12)), range(7)]  # cam1 links the other two
    partly = [
        replace(seen, sightings=tuple(seen.sightings[index] for index in these))
        for seen, these in zip(observations, shown, strict=True)
    ]

    rig = solve_rig([BOARD], partly).rig

    distances = np.linalg.norm(np.diff(rig.centers_world, axis=0), axis=1)
    np.testing.assert_allclose(distances, 0.12, rtol=EXACT)


def test_settings_reach_the_provenance() -> None:
    observations = observe_exactly(BOARD, ring(BOARD, ["PINHOLE"]))
    settings = CalibrationSettings(lens=LensSettings(loss_px=0.5))

    rig = solve_rig([BOARD], observations, settings).rig

    assert record_of(rig).settings["lens"]["loss_px"] == 0.5
    assert record_of(rig).boards == (BoardRecord("board", None, str(BOARD)),)
