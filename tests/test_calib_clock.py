"""Cameras that are a little out of time: by how much, and how well that is known."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from helpers.boards import make_camera
from helpers.recorded_boards import Recording, row_of_cameras, see
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.boards.board import Observations, Sighting
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.calibrate import solve_rig
from hybridve.calib.placing.clock import Clocks, estimate_offsets, resampled
from hybridve.calib.placing.settings import CalibrationSettings
from hybridve.calib.pose import Pose, rotation_about_axes

BOARD = Chessboard(7, 6, 0.05)
SYMMETRIC = Chessboard(8, 6, 0.05)
LATE = {"cam1": 0.0, "cam2": 2.37, "cam3": -1.6}

#: Cubics through four frames follow the test's motion to this: frames, pixels.
EXACT_FRAMES = 0.02
EXACT_PX = 0.01

#: By how much views that jump are displaced, pixels.
JUMP_PX = 15.0


def waved(time: float, board: Chessboard = BOARD, amount: float = 1.0) -> Pose:
    """Return world_from_board of a board in hand at a time in frames."""
    facing = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    turn = rotation_about_axes(
        (
            amount * 25.0 * np.sin(time / 11.0),
            amount * 12.0 * np.cos(time / 14.0),
            amount * 20.0 * np.sin(time / 17.0 + 1.0),
        )
    )
    rotation = turn @ facing
    middle = np.array([0.2, 0.0, 0.0]) + amount * np.array(
        [0.2 * np.sin(time / 9.0), 0.2 * np.cos(time / 13.0), 0.1 * np.sin(time / 10.0 + 2.0)]
    )
    return np.column_stack([rotation, middle - rotation @ board.center_board])


def out_of_time(
    late: Mapping[str, float],
    n_frames: int = 80,
    noise_px: float = 0.0,
    seed: int = 0,
    board: Chessboard = BOARD,
    amount: float = 1.0,
    model: str = "OPENCV",
) -> Recording:
    """What cameras record of a board in hand; those that are late record the future."""
    rng = np.random.default_rng(seed)
    cameras = [
        replace(make_camera(name, model, camera.cam_from_world), name=name)
        for name, camera in zip(sorted(late), row_of_cameras(len(late), 0.2), strict=True)
    ]
    observations = []
    for camera in cameras:
        sightings = []
        for frame in range(n_frames):
            pixels = see(camera, waved(frame + late[camera.name], board, amount), board)
            if pixels is not None:
                noise = rng.normal(0.0, 1.0, pixels.shape) * noise_px
                turn = board.looks[rng.integers(len(board.looks))]
                image = f"board clip, frame {frame}"
                sightings.append(Sighting(image, frame, 0, (pixels + noise)[turn]))
        observations.append(Observations(camera.name, model, (640, 480), tuple(sightings), False))
    return Recording([board], [], observations, cameras)


def estimate(recording: Recording) -> Clocks:
    return estimate_offsets(recording.boards, recording.cameras, recording.observations)


@pytest.mark.slow
def test_offsets_are_found_to_a_fraction_of_a_frame() -> None:
    clocks = estimate(out_of_time(LATE))

    assert clocks.reference == "cam1"
    assert clocks.offset_frames == pytest.approx(LATE, abs=EXACT_FRAMES)
    assert all(clocks.is_known.values())
    assert not clocks.notes


@pytest.mark.slow
@settings(max_examples=4)
@given(late=st.floats(-12.0, 12.0), other=st.floats(-12.0, 12.0))
def test_any_offset_is_found(late: float, other: float) -> None:
    true = {"cam1": 0.0, "cam2": late, "cam3": other}

    assert estimate(out_of_time(true, 50)).offset_frames == pytest.approx(true, abs=EXACT_FRAMES)


@pytest.mark.slow
def test_the_stated_error_is_the_error() -> None:
    shares = []
    for seed in range(10):
        clocks = estimate(out_of_time(LATE, 50, noise_px=0.4, seed=seed))
        for name in ("cam2", "cam3"):
            assert 0.0 < clocks.std_frames[name] < 0.05
            error = clocks.offset_frames[name] - LATE[name]
            shares.append(error / clocks.std_frames[name])

    # Chi-squared with 20 degrees of freedom, root of the mean: 0.69 to 1.31 in 95 of 100 cases.
    assert 0.69 < np.sqrt(np.mean(np.square(shares))) < 1.31
    assert abs(np.mean(shares)) < 2.0 / np.sqrt(len(shares))


def with_jumps(recording: Recording, share: float, missing: float, seed: int) -> Recording:
    """Shift a share of whole views by 15 px, and take corners away."""
    rng = np.random.default_rng(seed)
    observations = []
    for seen in recording.observations:
        sightings = []
        for sighting in seen.sightings:
            pixels = sighting.pixels.copy()
            if rng.random() < share:
                direction = rng.uniform(0.0, 2.0 * np.pi)
                pixels += JUMP_PX * np.array([np.cos(direction), np.sin(direction)])
            pixels[rng.random(len(pixels)) < missing] = np.nan
            sightings.append(replace(sighting, pixels=pixels))
        observations.append(replace(seen, sightings=tuple(sightings)))
    return replace(recording, observations=observations)


@pytest.mark.slow
@pytest.mark.parametrize(("share", "seed"), [(0.03, 100), (0.1, 101)])
def test_views_that_jump_are_left_out(share: float, seed: int) -> None:
    recording = with_jumps(out_of_time(LATE, noise_px=0.2, seed=seed), share, 0.1, seed)

    clocks = estimate(recording)

    for name, late in LATE.items():
        error = abs(clocks.offset_frames[name] - late)
        assert np.isnan(error) or error < EXACT_FRAMES
        assert np.isnan(error) or error <= 4.0 * clocks.std_frames[name]
    assert clocks.rms_px < 0.3
    in_time = out_of_time(dict.fromkeys(LATE, 0.0))
    moved = resampled(recording.observations, LATE)
    for seen, true in zip(moved[1:], in_time.observations[1:], strict=True):
        expected = by_instant(true)
        misses = [
            np.nanmedian(np.abs(pixels - expected[instant]))
            for instant, pixels in by_instant(seen).items()
        ]
        assert len(misses) > 30
        assert np.max(misses) < 0.5


@pytest.mark.slow
def test_the_views_that_jump_are_told() -> None:
    recording = out_of_time({"cam1": 0.0, "cam2": 0.5})
    seen = recording.observations[1]
    jumped = tuple(
        replace(s, pixels=s.pixels + JUMP_PX) if s.instant in {1, 30, 32, 60} else s
        for s in seen.sightings
    )

    clocks = estimate(
        replace(
            recording, observations=[recording.observations[0], replace(seen, sightings=jumped)]
        )
    )

    assert clocks.left_out == {"cam1": (), "cam2": (1, 30, 32, 60)}
    assert clocks.offset_frames["cam2"] == pytest.approx(0.5, abs=EXACT_FRAMES)


def test_a_board_that_is_shaken_is_no_view_that_jumps() -> None:
    # To and fro within 12 frames, and still before and after: slow frames tell nothing of fast.
    def shaken(time: float) -> float:
        return float(10.0 * np.sin(time / 2.0) * np.exp(-(((time - 30.0) / 8.0) ** 2)))

    def swung(late: float) -> tuple[Sighting, ...]:
        corners = np.stack(np.meshgrid(np.arange(7.0), np.arange(6.0)), axis=2).reshape(-1, 2)
        return tuple(
            Sighting(f"board clip, frame {f}", f, 0, 300.0 + 20.0 * corners + shaken(f + late))
            for f in range(60)
        )

    seen = [
        Observations(name, "PINHOLE", (640, 480), swung(late), False)
        for name, late in {"cam1": 0.0, "cam2": 0.5}.items()
    ]

    moved = resampled(seen, {"cam1": 0.0, "cam2": 0.5})

    assert len(moved[1].sightings) == len(seen[1].sightings) - 3


@pytest.mark.slow
def test_a_symmetric_board_tells_them_too() -> None:
    clocks = estimate(out_of_time(LATE, board=SYMMETRIC))

    assert clocks.offset_frames == pytest.approx(LATE, abs=EXACT_FRAMES)


@pytest.mark.slow
@pytest.mark.thorough
def test_the_order_of_cameras_changes_no_bit() -> None:
    recording = out_of_time(LATE, 40, noise_px=0.2)
    late = CalibrationSettings(sync="estimate")

    found = solve_rig(recording.boards, recording.observations, late)
    turned = solve_rig(recording.boards, recording.observations[::-1], late)

    assert turned.record == found.record
    for camera in found.rig.cameras:
        np.testing.assert_array_equal(turned.rig[camera.name].cam_from_world, camera.cam_from_world)


@pytest.mark.slow
@pytest.mark.parametrize("noise_px", [0.0, 0.2])
def test_a_board_that_does_not_move_tells_nothing(noise_px: float) -> None:
    clocks = estimate(out_of_time(LATE, amount=0.0, noise_px=noise_px))

    assert np.isnan([clocks.offset_frames["cam2"], clocks.offset_frames["cam3"]]).all()
    assert clocks.is_known == {"cam1": True, "cam2": False, "cam3": False}
    assert len(clocks.notes) == 2
    assert "'cam2'" in clocks.notes[0]
    assert "hardly moves" in clocks.notes[0]


def test_a_still_clip_tells_nothing() -> None:
    recording = out_of_time({"cam1": 0.0, "cam2": 1.0})
    still = [replace(seen, is_still=True) for seen in recording.observations]

    clocks = estimate_offsets(recording.boards, recording.cameras, still)

    assert not clocks.is_known["cam2"]
    assert "lie still" in clocks.notes[0]


def test_clips_without_common_frames_tell_nothing() -> None:
    recording = out_of_time({"cam1": 0.0, "cam2": 1.0})
    seen = recording.observations[1]
    later = tuple(replace(s, instant=(s.instant or 0) + 500) for s in seen.sightings)

    clocks = estimate_offsets(
        recording.boards,
        recording.cameras,
        [recording.observations[0], replace(seen, sightings=later)],
    )

    assert not clocks.is_known["cam2"]
    assert "shares no run of frames" in clocks.notes[0]


def by_instant(seen: Observations) -> dict[int, NDArray[np.float64]]:
    return {s.instant: s.pixels for s in seen.sightings if s.instant is not None}


@pytest.mark.parametrize("board", [BOARD, SYMMETRIC], ids=["odd", "even"])
def test_resampled_corners_are_those_of_a_clock_that_is_right(board: Chessboard) -> None:
    recording = out_of_time(LATE, board=board)
    in_time = out_of_time(dict.fromkeys(LATE, 0.0), board=board)

    moved = resampled(recording.observations, LATE, recording.boards)

    assert moved[0] is recording.observations[0], "the reference stays as it is"
    for seen, true in zip(moved, in_time.observations, strict=True):
        expected = by_instant(true)
        assert len(by_instant(seen)) > 60
        for instant, pixels in by_instant(seen).items():
            misses = [np.abs(pixels[look] - expected[instant]).max() for look in board.looks]
            assert min(misses) < EXACT_PX


def test_unknown_offsets_leave_cameras_as_they_are() -> None:
    recording = out_of_time({"cam1": 0.0, "cam2": 1.0})

    moved = resampled(recording.observations, {"cam2": float("nan")})

    assert moved == recording.observations


def test_corners_are_interpolated_only_between_neighbours() -> None:
    recording = out_of_time({"cam1": 0.0, "cam2": 0.5})
    seen = recording.observations[1]
    gap = tuple(s for s in seen.sightings if s.instant != 30)

    moved = resampled(
        [recording.observations[0], replace(seen, sightings=gap)], {"cam1": 0.0, "cam2": 0.5}
    )

    # Instant k lies between frames k - 1 and k; the cubic reaches from k - 2 to k + 1.
    instants = by_instant(moved[1]).keys()
    assert {29, 30, 31, 32}.isdisjoint(instants)
    assert {28, 33} <= instants


@pytest.mark.slow
def test_a_rig_of_late_cameras_is_solved_with_the_noise_of_frames() -> None:
    late = {"cam1": 0.0, "cam2": 2.5}
    recording = out_of_time(late, 40, noise_px=0.2)

    calibration = solve_rig(
        recording.boards, recording.observations, CalibrationSettings(sync="estimate")
    )

    told = calibration.record
    assert told.clocks is not None
    assert told.clocks.advice is not None
    assert told.noise_by_group is not None
    assert told.clocks.offset_frames == pytest.approx(late, abs=0.05)
    assert "cam2 +2.5" in told.clocks.advice or "cam2 +2.4" in told.clocks.advice
    assert "offset_s" in told.clocks.advice
    # Half of all points are interpolated half-way, and so less noisy; their errors are not.
    assert told.noise.smooth_px < 0.19
    assert 0.18 < told.noise_by_group["board clip"].smooth_px < 0.22
