"""Recordings that cannot give a rig, or only seem to: what is said of each, from corners on.

Each runs the whole of `solve_rig` and of `certify`. What cannot be calibrated is refused in one
line that names the camera, the cause and what to record; what contradicts itself gives a rig whose
certificate doubts it; what is odd but sound gives the right rig.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.boards import board_poses, look_at, make_camera, observe_exactly, project, ring
from helpers.recorded_boards import held_up, record, row_of_cameras, see
from helpers.records import record_of
from helpers.thorough import some_of
from numpy.typing import NDArray

from hybridve.calib.boards.board import Observations, Sighting
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.calibrate import solve_rig
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats.rig_json import rig_to_dict
from hybridve.calib.judging.account import Calibration
from hybridve.calib.judging.certificate import Certificate, certify, working_volume
from hybridve.calib.lens import img_from_cam
from hybridve.calib.placing.settings import CalibrationSettings, LensRequest
from hybridve.calib.pose import (
    Pose,
    angle_between,
    compose,
    rotation_about_axes,
    transform,
)
from hybridve.calib.rig import Rig

NOISE_PX = 0.1

DEFAULTS = CalibrationSettings()

#: A rig is wrong though nothing was said if a camera is further off than so many times its stated
#: standard deviation of place, or of turning (1 in 10^10 for a normal error).
_CONFIDENTLY_WRONG = 8.0

LYING = Chessboard(7, 6, 0.1)  # its colours tell its ends apart
CARRIED = Chessboard(7, 6, 0.08)
SYMMETRIC = Chessboard(8, 6, 0.1)


def calibrated(
    boards: Sequence[Chessboard],
    observations: Sequence[Observations],
    settings: CalibrationSettings = DEFAULTS,
    requests: Mapping[str, LensRequest] | None = None,
) -> tuple[Calibration, Certificate]:
    """Return a calibration and its certificate, both of which are plain JSON."""
    calibration = solve_rig(boards, observations, settings, requests=requests)
    rig = calibration.rig
    certificate = certify(rig, calibration.record, calibration.seen, working_volume(rig))
    json.dumps([certificate.to_dict(), rig_to_dict(rig)], allow_nan=False)
    return calibration, certificate


def assert_refused(
    named: str, boards: Sequence[Chessboard], observations: Sequence[Observations], **how: Any
) -> None:
    """Assert that a recording is refused in one line that matches."""
    with pytest.raises(CalibrationError, match=named) as refused:
        calibrated(boards, observations, **how)
    assert "\n" not in str(refused.value)


def assert_doubted(named: str, certificate: Certificate) -> None:
    """Assert that a verdict trusts a rig no further than a doubt that holds all of some words."""
    assert certificate.verdict.startswith("not to be trusted: ")
    assert set(certificate.doubts) <= set(certificate.warnings)
    assert any(all(word in doubt for word in named.split("|")) for doubt in certificate.doubts)


def worst_sigmas(
    calibration: Calibration, certificate: Certificate, true: Sequence[Camera]
) -> float:
    """Return the largest error of a camera's place or turn, by its stated standard deviation."""
    stated = {told.name: told for told in certificate.cameras}
    worst = 0.0
    for camera in true:
        found, told = calibration.rig[camera.name], stated[camera.name]
        off_m = float(np.linalg.norm(found.center_world - camera.center_world))
        off_rad = angle_between(found.cam_from_world, camera.cam_from_world)
        worst = max(worst, off_m / told.place_std_m, off_rad / told.turn_std_rad)
    return worst


# --- A board that lies still, and stills of each camera alone -------------------------------


def around() -> list[Camera]:
    return ring(LYING, ["SIMPLE_RADIAL"] * 3)


def lying(cameras: Sequence[Camera] | None = None, board: Chessboard = LYING) -> list[Observations]:
    return observe_exactly(board, list(cameras or around()), noise_px=NOISE_PX)


def stills_of(seen: Observations) -> tuple[Sighting, ...]:
    return tuple(sighting for sighting in seen.sightings if sighting.instant is None)


def clip_of(seen: Observations) -> tuple[Sighting, ...]:
    return tuple(sighting for sighting in seen.sightings if sighting.instant is not None)


def instead(observations: Sequence[Observations], index: int, **other: Any) -> list[Observations]:
    """Return observations in which those of one camera are changed."""
    changed = list(observations)
    changed[index] = replace(changed[index], **other)
    return changed


def with_stills(
    observations: Sequence[Observations], index: int, stills: Sequence[NDArray[np.float64]]
) -> list[Observations]:
    """Return observations in which one camera has other stills."""
    made = [Sighting(f"{number}.png", None, 0, pixels) for number, pixels in enumerate(stills)]
    return instead(observations, index, sightings=(*made, *clip_of(observations[index])))


def with_clip(
    observations: Sequence[Observations], index: int, pixels: NDArray[np.float64]
) -> list[Observations]:
    """Return observations in which one camera has another clip."""
    seen = observations[index]
    clip = Sighting("board clip", 0, 0, pixels)
    return instead(observations, index, sightings=(*stills_of(seen), clip))


def pictures(
    poses: Sequence[Pose], seed: int = 0, noise_px: float = NOISE_PX
) -> list[NDArray[np.float64]]:
    """Return what the second camera would see of the board at poses."""
    rng = np.random.default_rng(seed)
    camera = around()[1]
    return [project(camera, pose, LYING) + rng.normal(0.0, noise_px, (42, 2)) for pose in poses]


def parallel_poses() -> list[Pose]:
    rng = np.random.default_rng(0)
    poses = []
    for _ in range(12):
        rotation = rotation_about_axes((180.0, 0.0, rng.uniform(-30, 30)))
        middle = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), rng.uniform(1.2, 2.0)])
        poses.append(np.column_stack([rotation, middle - rotation @ LYING.center_board]))
    return poses


def zoomed(factor: float) -> list[Observations]:
    """Return observations in which the second camera zoomed in between its stills and its clip."""
    seen, camera = lying(), around()[1]
    middle = camera.params[1:3]
    return with_clip(seen, 1, (clip_of(seen[1])[0].pixels - middle) * factor + middle)


def stretched(factors: Sequence[float]) -> list[Observations]:
    """Return observations in which the second camera's clip shows a board of another shape."""
    camera = around()[1]
    points = transform(camera.cam_from_world, LYING.points_board * factors)
    return with_clip(lying(), 1, img_from_cam(camera, points))


NOISE = np.random.default_rng(5)

REFUSED: dict[str, tuple[Callable[[], list[Observations]], str]] = {
    "all boards parallel": (
        lambda: with_stills(lying(), 1, pictures(parallel_poses())),
        r"'cam2': all 12 boards are parallel.*record the board tilted",
    ),
    "all stills the same": (
        lambda: with_stills(lying(), 1, pictures(board_poses(LYING, 1, 0) * 12)),
        r"'cam2': all 12 boards are parallel \(within 0\.. degrees\).*record the board tilted",
    ),
    "all stills one file": (
        lambda: with_stills(lying(), 1, pictures(board_poses(LYING, 1, 0) * 12, noise_px=0.0)),
        r"'cam2': all 12 boards are parallel",
    ),
    "too small": (
        lambda: with_stills(
            lying(),
            1,
            pictures(
                [np.column_stack([p[:, :3], 16 * p[:, 3]]) for p in board_poses(LYING, 12, 0)]
            ),
        ),
        r"'cam2': .*the board is too small in the image.*record it closer, or .*larger board",
    ),
    "one view": (
        lambda: with_stills(lying(), 1, pictures(board_poses(LYING, 1, 0))),
        r"'cam2': .* in 1 of 1 pictures, expected 3 views or more.*take more pictures",
    ),
    "no still": (
        lambda: with_stills(lying(), 1, []),
        r"'cam2': .* only lying still in the clip.*take more pictures of it \(`intrinsics`\)",
    ),
    "noise in the stills": (
        lambda: with_stills(lying(), 1, [NOISE.uniform(0, 480, (42, 2)) for _ in range(8)]),
        r"'cam2': only 0 of 8 views of the board fit model SIMPLE_RADIAL.*check columns and rows",
    ),
    "noise in the clip": (
        lambda: with_clip(lying(), 1, NOISE.uniform(0, 480, (42, 2))),
        r"'cam2': the board clip misses its lens by \d+\.\d px|'cam2' sees no board in the clip",
    ),
    "only a row of it in the clip": (
        lambda: with_clip(
            lying(),
            1,
            np.where(np.arange(42)[:, None] < 7, lying()[1].sightings[-1].pixels, np.nan),
        ),
        r"'cam2' sees no board in the clip.*or too little of one; record the board where",
    ),
    "no board in the clip": (
        lambda: instead(lying(), 1, sightings=stills_of(lying()[1])),
        r"'cam2' never sees the board at the same time as 'cam1' or 'cam3'",
    ),
    "nothing seen": (
        lambda: instead(lying(), 1, sightings=()),
        r"'cam2': .* in 0 of 0 pictures, expected 3",
    ),
    "hidden but for a few corners": (
        lambda: with_stills(
            lying(),
            1,
            [
                np.where(np.arange(42)[:, None] % 10 == 0, one, np.nan)
                for one in pictures(board_poses(LYING, 12, 0))
            ],
        ),
        r"'cam2': .* in 0 of 12 pictures \(12 others show too little of it\)",
    ),
    "listed twice": (
        lambda: [*lying(), replace(lying()[0], name="cam9")],
        "'cam1' and 'cam9' show the same pictures.*list each camera once",
    ),
    "one name twice": (
        lambda: instead(lying(), 1, name="cam1"),
        "'cam1' is listed 2 times",
    ),
    "another image size": (
        lambda: instead(lying(), 1, size_px=(320, 240)),
        r"'cam2': \d+ of 546 points lie outside its images of 320x240.*same mode",
    ),
    "another board's points": (
        lambda: with_clip(lying(), 1, np.zeros((48, 2))),
        "'cam2': board clip has 48 points, expected the 42 of 7x6",
    ),
    "an unknown model": (
        lambda: instead(lying(), 1, model="PINHOLES"),
        "'cam2': unknown camera model 'PINHOLES'; one of auto, SIMPLE_PINHOLE",
    ),
    "no camera": (list, "there is no camera to calibrate"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_recording_that_gives_no_rig_is_refused_for_what_it_is(case: str) -> None:
    make, named = REFUSED[case]

    assert_refused(named, [LYING], make())


def test_exchanged_clips_of_different_lenses_are_named() -> None:
    cameras = around()
    cameras[1] = replace(cameras[1], params=cameras[1].params * [1.2, 1.0, 1.0, 1.0])
    seen = lying(cameras)
    one, other = clip_of(seen[0])[0].pixels, clip_of(seen[1])[0].pixels
    exchanged = with_clip(with_clip(seen, 0, other), 1, one)

    assert_refused("clips of 'cam1' and 'cam2' seem to be exchanged", [LYING], exchanged)


DOUBTED: dict[str, tuple[Callable[[], list[Observations]], str]] = {
    "zoomed": (lambda: zoomed(1.08), "'cam2'|board clip misses its lens|same zoom"),
    "a board of another shape": (
        lambda: stretched((1.0, 0.8, 1.0)),
        "'cam2'|board clip misses its lens|is the board the same",
    ),
    "listed twice, encoded anew": (
        lambda: [
            *lying(),
            replace(
                lying()[0],
                name="cam9",
                sightings=tuple(
                    replace(s, pixels=s.pixels + NOISE.normal(0.0, 0.05, s.pixels.shape))
                    for s in lying()[0].sightings
                ),
            ),
        ],
        "'cam1' and 'cam9' are alike|listed twice",
    ),
}


def test_cameras_in_exactly_one_place_place_no_point() -> None:
    calibration, _ = calibrated([LYING], lying(around()[:2]))
    camera = calibration.rig.cameras[0]
    assert calibration.rig.covariance is not None
    labels = calibration.rig.covariance.labels
    named = tuple(label.replace("cam2", "twin") for label in labels)
    covariance = replace(calibration.rig.covariance, labels=named)
    twice = Rig((camera, replace(camera, name="twin")), covariance=covariance)

    certificate = certify(twice, calibration.record, {}, working_volume(twice))

    assert np.isnan(certificate.error95_m)
    assert "no error in mm can be stated" in certificate.verdict


@pytest.mark.slow
@pytest.mark.parametrize("case", DOUBTED)
def test_a_recording_that_contradicts_itself_gives_a_rig_that_is_doubted(case: str) -> None:
    make, named = DOUBTED[case]

    assert_doubted(named, calibrated([LYING], make())[1])


@pytest.mark.slow
def test_a_symmetric_board_that_nothing_turns_is_doubted() -> None:
    cameras = ring(SYMMETRIC, ["SIMPLE_RADIAL"] * 2)

    _, certificate = calibrated([SYMMETRIC], lying(cameras, SYMMETRIC))

    assert_doubted("looks the same when turned|odd sum of columns and rows", certificate)


@pytest.mark.slow
def test_a_lens_that_is_not_the_cameras_is_refused() -> None:
    params = (300.0, 320.0, 240.0, 0.0)

    assert_refused(
        r"'cam2': the lens that was given \(`params`\) fits only 0 of 12 views",
        [LYING],
        lying(),
        requests={"cam2": LensRequest(params=params)},
    )


def test_clocks_cannot_be_compared_by_a_board_that_lies_still() -> None:
    assert_refused(
        "boards lie still in the clip; record a board that is moved",
        [LYING],
        lying(),
        settings=CalibrationSettings(sync="estimate"),
    )


def assert_honest(
    calibration: Calibration, certificate: Certificate, true: Sequence[Camera]
) -> None:
    """Assert that a rig is as right as it says, and that nothing casts doubt on it."""
    assert not certificate.doubts
    assert worst_sigmas(calibration, certificate, true) < _CONFIDENTLY_WRONG


@pytest.mark.slow
def test_a_camera_upside_down_is_as_good_as_any() -> None:
    cameras = around()
    x, y, _ = LYING.center_board
    upright = cameras[1]
    turned = look_at(tuple(upright.center_world), (x, y, 0.0), 183.0)
    cameras[1] = replace(upright, cam_from_world=turned)
    assert upright.cam_from_world[1] @ turned[1] < 0

    calibration, certificate = calibrated([LYING], lying(cameras))

    assert_honest(calibration, certificate, cameras)
    # Not by a covariance that allows for anything.
    assert max(told.place_std_m for told in certificate.cameras) < 0.005


def test_one_camera_alone_is_placed_and_no_error_in_mm_is_stated() -> None:
    cameras = around()[:1]

    calibration, certificate = calibrated([LYING], lying(cameras))

    assert_honest(calibration, certificate, cameras)
    assert np.isnan(certificate.error95_m)
    assert "no error in mm can be stated" in certificate.verdict
    assert any("one camera alone" in warning for warning in certificate.warnings)


@pytest.mark.slow
def test_three_views_make_a_lens_that_is_as_unsure_as_it_says() -> None:
    calibration, certificate = calibrated(
        [LYING], with_stills(lying(), 1, pictures(board_poses(LYING, 3, 5)))
    )

    assert_honest(calibration, certificate, around())
    one, two, _ = certificate.cameras
    assert two.place_std_m > 1.2 * one.place_std_m


@pytest.mark.slow
def test_a_board_in_a_corner_of_the_image_leaves_the_rest_unsure() -> None:
    camera = around()[1]
    poses = []
    for pose in board_poses(LYING, 60, 3):
        rotation = pose[:, :3]
        z = 2.0 * (pose @ np.append(LYING.center_board, 1.0))[2]
        shift = np.array([-0.4 * z, -0.28 * z, z]) - rotation @ LYING.center_board
        moved = np.column_stack([rotation, shift])
        pixels = project(camera, moved, LYING)
        if (pixels > 0).all() and (pixels < 260).all():
            poses.append(moved)

    calibration, certificate = calibrated([LYING], with_stills(lying(), 1, pictures(poses[:12])))

    assert_honest(calibration, certificate, around())
    one, two, _ = certificate.cameras
    assert two.coverage < one.coverage
    assert two.edge_error95_px > 1.5 * one.edge_error95_px
    (told,) = calibration.record.cameras["cam2"].warnings
    assert "% of the image" in told


@pytest.mark.slow
def test_boards_half_hidden_everywhere_give_a_rig_that_is_as_unsure_as_it_says() -> None:
    rng = np.random.default_rng(1)
    hidden = [
        replace(
            seen,
            sightings=tuple(
                replace(s, pixels=np.where(rng.random((42, 1)) < 0.75, np.nan, s.pixels))
                for s in seen.sightings
            ),
        )
        for seen in lying()
    ]

    assert_honest(*calibrated([LYING], hidden), around())


def test_a_still_clip_alone_serves_where_lenses_are_known() -> None:
    cameras = around()
    known = {
        camera.name: LensRequest(params=tuple(float(value) for value in camera.params))
        for camera in cameras
    }
    seen = [replace(one, sightings=clip_of(one)) for one in lying()]

    assert_honest(*calibrated([LYING], seen, requests=known), cameras)


@pytest.mark.slow
def test_a_board_that_nobody_shows_changes_nothing() -> None:
    alone = solve_rig([LYING], lying()).rig
    beside = solve_rig([LYING, Chessboard(9, 6, 0.05, name="another")], lying()).rig

    assert_same_to_the_bit(alone, beside)


# --- A board in hand ------------------------------------------------------------------------


def carried_poses(frames: int = 14) -> dict[int, dict[int, Pose]]:
    rng = np.random.default_rng(1)
    return {
        5 * frame: {
            0: held_up(
                rng,
                CARRIED,
                (0.25 + rng.uniform(-0.25, 0.25), rng.uniform(-0.3, 0.1), rng.uniform(-0.2, 0.2)),
            )
        }
        for frame in range(frames)
    }


def carried() -> list[Observations]:
    """Return what three cameras side by side see of a board in hand."""
    cameras = row_of_cameras(3, 0.25, "SIMPLE_PINHOLE")
    return record([CARRIED], cameras, carried_poses(), noise_px=NOISE_PX).observations


def mirrored(seen: Observations, are_points_named: bool = False) -> Observations:
    """Return what is found in mirrored pictures, listed as of a board that faces the camera.

    Or, if its points are named by markers, listed as they are.
    """
    order = np.arange(42) if are_points_named else np.arange(42).reshape(6, 7)[:, ::-1].ravel()
    width_px = seen.size_px[0]
    return replace(
        seen,
        sightings=tuple(
            replace(s, pixels=(s.pixels * [-1.0, 1.0] + [width_px, 0.0])[order])
            for s in seen.sightings
        ),
    )


@pytest.mark.parametrize("are_points_named", [False, True], ids=["plain", "markers"])
def test_a_mirrored_picture_is_named(are_points_named: bool) -> None:
    seen = carried()
    seen[1] = mirrored(seen[1], are_points_named)

    assert_refused(
        "'cam2': its picture seems to be mirrored.*record it unmirrored", [CARRIED], seen
    )


def test_of_two_cameras_the_mirrored_one_cannot_be_told() -> None:
    one, other = carried()[:2]

    assert_refused("'cam2' or of 'cam1' seems to be mirrored", [CARRIED], [one, mirrored(other)])


@pytest.mark.slow
def test_a_mirrored_board_of_markers_on_the_floor_puts_its_camera_below() -> None:
    seen = lying()
    seen[1] = mirrored(seen[1], are_points_named=True)

    assert_refused("'cam2' .*came out under the floor: is its picture mirrored", [LYING], seen)


@pytest.mark.slow
def test_a_camera_that_saw_another_board_is_doubted() -> None:
    camera = row_of_cameras(3, 0.25, "SIMPLE_PINHOLE")[1]
    seen = [replace(one, sightings=one.sightings[:6]) for one in carried()]
    smaller = []
    for sighting in seen[1].sightings:
        assert sighting.instant is not None
        pose = compose(camera.cam_from_world, carried_poses()[sighting.instant][0])
        pixels = img_from_cam(camera, transform(pose, CARRIED.points_board * 0.7))
        smaller.append(replace(sighting, pixels=pixels))

    _, certificate = calibrated([CARRIED], instead(seen, 1, sightings=tuple(smaller)))

    assert_doubted(
        "'cam2' does not agree with the others|of a board as it is described", certificate
    )


@pytest.mark.slow
def test_the_same_sightings_twice_count_once() -> None:
    seen = carried()
    twice = [replace(one, sightings=one.sightings * 2) for one in seen]

    once, again = solve_rig([CARRIED], seen).rig, solve_rig([CARRIED], twice).rig

    adjusted = [record_of(rig).adjustment for rig in (once, again)]
    views = [one.views for one in adjusted if one is not None]
    assert len(views) == 2
    assert views[0] == views[1]
    for camera in once.cameras:
        off_m = np.linalg.norm(camera.center_world - again[camera.name].center_world)
        assert off_m < 0.01


@pytest.mark.slow
def test_groups_that_never_meet_are_named_with_the_nearest_edge() -> None:
    near = row_of_cameras(2, 0.25, "SIMPLE_PINHOLE")
    away = [
        replace(
            camera,
            name=f"far{index}",
            cam_from_world=compose(
                camera.cam_from_world, np.column_stack([np.eye(3), [-10.0, 0.0, 0.0]])
            ),
        )
        for index, camera in enumerate(near, start=1)
    ]
    poses = carried_poses()
    there = {
        100 + instant: {0: compose(np.column_stack([np.eye(3), [10.0, 0.0, 0.0]]), bodies[0])}
        for instant, bodies in poses.items()
    }
    seen = record([CARRIED], [*near, *away], {**poses, **there}, noise_px=NOISE_PX).observations

    assert_refused(
        "'far1', 'far2' never sees the board at the same time as 'cam1' or 'cam2'.*"
        r"record the board where 'far\d' and 'cam\d' \(its nearest in time: \d+ frames",
        [CARRIED],
        seen,
    )


def facing() -> tuple[list[Chessboard], list[Observations], dict[int, Pose], list[Camera]]:
    """Two cameras that face each other, and a panel with a board on both sides between them."""
    front = Chessboard(7, 6, 0.08, name="front", body="panel")
    back = Chessboard(8, 5, 0.08, name="rear", body="panel")
    cameras = [
        make_camera("south", "SIMPLE_PINHOLE", look_at((0.0, -2.0, 0.1), (0.0, 0.0, 0.0))),
        make_camera("north", "SIMPLE_PINHOLE", look_at((0.3, 2.0, 0.0), (0.0, 0.0, 0.0))),
    ]
    rng = np.random.default_rng(4)
    panel = {frame: held_up(rng, front, rng.uniform(-0.2, 0.2, 3).tolist()) for frame in range(16)}
    on_its_back = np.column_stack([np.diag([-1.0, 1.0, -1.0]), [0.5, 0.02, -0.01]])
    seen = record(
        [front, back],
        cameras,
        {frame: {0: pose, 1: pose} for frame, pose in panel.items()},
        body_from_board=[np.eye(3, 4), on_its_back],
        noise_px=NOISE_PX,
    ).observations
    assert [{s.board for s in one.sightings} for one in seen] == [{0}, {1}]
    return [front, back], seen, panel, cameras


def test_boards_back_to_back_link_cameras_that_face_each_other() -> None:
    boards, seen, panel, cameras = facing()

    calibration, certificate = calibrated(boards, seen)

    assert calibration.record.world is not None
    instant = calibration.record.world.instant
    assert isinstance(instant, int)
    true = [
        replace(camera, cam_from_world=compose(camera.cam_from_world, panel[instant]))
        for camera in cameras
    ]
    assert_honest(calibration, certificate, true)


@pytest.mark.slow
def test_the_order_of_boards_and_cameras_changes_no_bit() -> None:
    boards, seen, _, _ = facing()
    swapped = [
        replace(one, sightings=tuple(replace(s, board=1 - s.board) for s in one.sightings[::-1]))
        for one in seen[::-1]
    ]

    found, again = solve_rig(boards, seen), solve_rig(boards[::-1], swapped)

    assert again.record == found.record
    for camera in found.rig.cameras:
        np.testing.assert_array_equal(again.rig[camera.name].params, camera.params)
        np.testing.assert_array_equal(again.rig[camera.name].cam_from_world, camera.cam_from_world)


def test_boards_back_to_back_that_are_no_body_link_nothing_and_that_is_said() -> None:
    boards, seen, _, _ = facing()

    assert_refused(
        "mounted on one body these would link them", [replace(b, body=None) for b in boards], seen
    )


# --- Clocks ---------------------------------------------------------------------------------


def late_by(frames_late: float) -> list[Observations]:
    """Return what three cameras see of a board that moves steadily; the second is late."""
    rng = np.random.default_rng(0)
    knots = np.linspace(-20.0, 80.0, 12)
    places = rng.uniform(-1.0, 1.0, (12, 6)) * [0.25, 0.2, 0.15, 0.5, 0.5, 0.4]
    facing_cameras = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])

    def world_from_board(frame: float) -> Pose:
        before = int(np.searchsorted(knots, frame)) - 1
        share = (1.0 - np.cos(np.pi * (frame - knots[before]) / (knots[1] - knots[0]))) / 2.0
        place = places[before] * (1.0 - share) + places[before + 1] * share
        rotation = cv2.Rodrigues(place[3:])[0] @ facing_cameras
        middle = np.array([0.25, 0.0, 0.0]) + place[:3]
        return np.column_stack([rotation, middle - rotation @ CARRIED.center_board])

    observations = []
    for index, camera in enumerate(row_of_cameras(3, 0.25, "SIMPLE_PINHOLE")):
        sightings = []
        for frame in range(60):
            pixels = see(camera, world_from_board(frame - frames_late * (index == 1)), CARRIED)
            if pixels is not None:
                pixels = pixels + rng.normal(0.0, NOISE_PX, pixels.shape)
                sightings.append(Sighting(f"board clip, frame {frame}", frame, 0, pixels))
        observations.append(
            Observations(camera.name, camera.model, (640, 480), tuple(sightings), False)
        )
    return observations


@pytest.mark.slow
def test_a_clock_that_is_late_contradicts_the_others_and_the_way_out_is_said() -> None:
    assert_refused(
        r"'cam2' contradicts 'cam1', 'cam3'.*sync = \"estimate\" if some are late",
        [CARRIED],
        late_by(5.0),
    )


@pytest.mark.slow
def test_a_clock_that_is_a_little_late_is_doubted_and_the_way_out_is_said() -> None:
    _, certificate = calibrated([CARRIED], late_by(0.6))

    assert_doubted("'cam2' does not agree with the others|sync = \"estimate\"", certificate)


@pytest.mark.slow
def test_a_clock_that_is_late_is_found_out_where_it_is_asked_for() -> None:
    settings = CalibrationSettings(sync="estimate")

    calibration, certificate = calibrated([CARRIED], late_by(5.0), settings)

    assert calibration.record.clocks is not None
    offsets = calibration.record.clocks.offset_frames
    assert offsets["cam2"] is not None
    assert abs(offsets["cam2"]) == pytest.approx(5.0, abs=0.02)
    assert offsets["cam3"] == pytest.approx(0.0, abs=0.02)
    assert not certificate.doubts
    centers = calibration.rig.centers_world
    true = [camera.center_world for camera in row_of_cameras(3, 0.25)]
    for one, other in ((0, 1), (0, 2), (1, 2)):
        distance_m = np.linalg.norm(centers[one] - centers[other])
        assert distance_m == pytest.approx(np.linalg.norm(true[one] - true[other]), abs=0.005)


# --- Any recording --------------------------------------------------------------------------


def assert_same_to_the_bit(one: Rig, other: Rig) -> None:
    for camera in one.cameras:
        np.testing.assert_array_equal(camera.params, other[camera.name].params)
        np.testing.assert_array_equal(camera.cam_from_world, other[camera.name].cam_from_world)


@pytest.mark.slow
def test_the_order_of_cameras_sightings_and_boards_changes_no_bit() -> None:
    boards = [CARRIED, Chessboard(8, 5, 0.07, name="another")]
    poses = carried_poses()
    beside = np.column_stack([rotation_about_axes((5.0, -10.0, 20.0)), [0.1, 0.05, 0.1]])
    for instant in (5, 10, 20, 30):  # the world is the first board, which is there from the start
        poses[instant][1] = compose(poses[instant][0], beside)
    cameras = row_of_cameras(3, 0.25, "SIMPLE_PINHOLE")
    seen = record(boards, cameras, poses, noise_px=NOISE_PX, stills=2).observations
    assert {s.board for one in seen for s in one.sightings} == {0, 1}
    rng = np.random.default_rng(6)
    turned = [
        replace(
            seen[index],
            sightings=tuple(
                replace(seen[index].sightings[k], board=1 - seen[index].sightings[k].board)
                for k in rng.permutation(len(seen[index].sightings))
            ),
        )
        for index in (2, 0, 1)
    ]

    rig, again = solve_rig(boards, seen).rig, solve_rig(boards[::-1], turned).rig

    assert_same_to_the_bit(rig, again)
    assert rig.covariance is not None
    assert again.covariance is not None
    order = [again.covariance.labels.index(label) for label in rig.covariance.labels]
    np.testing.assert_array_equal(
        rig.covariance.matrix, again.covariance.matrix[np.ix_(order, order)]
    )


def spoilt(rng: np.random.Generator) -> tuple[list[Chessboard], list[Observations], list[Camera]]:
    """Return what is left of a recording after an accident, and the true cameras."""
    n_cameras = int(rng.integers(1, 4))
    columns, rows = rng.choice([3, 4, 7], 2)
    board = Chessboard(
        int(columns), int(rows) + (columns + rows + 1) % 2, float(rng.choice([0.02, 0.1]))
    )
    cameras = row_of_cameras(n_cameras, 0.25, "SIMPLE_PINHOLE")
    poses = {
        frame: {0: held_up(rng, board, rng.uniform(-0.2, 0.2, 3).tolist())}
        for frame in range(int(rng.integers(1, 9)))
    }
    is_still = bool(rng.random() < 0.3)
    if is_still:
        poses = {0: poses[0]}
    stills = int(rng.integers(0, 7))
    seen = record(
        [board], cameras, poses, noise_px=0.0, stills=stills, is_still=is_still
    ).observations
    share_hidden, share_lost = rng.choice([0.0, 0.3, 0.8], 2, p=[0.5, 0.3, 0.2])
    noise_px = float(rng.choice([0.0, 0.1, 2.0], p=[0.2, 0.6, 0.2]))
    spoilt_seen = []
    for one in seen:
        sightings = []
        for s in one.sightings:
            if rng.random() < share_lost:
                continue
            pixels = s.pixels + noise_px * rng.normal(size=s.pixels.shape)
            pixels[rng.random(len(pixels)) < share_hidden] = np.nan
            sightings += [replace(s, pixels=pixels)] * int(rng.choice([1, 2], p=[0.9, 0.1]))
        spoilt_seen.append(replace(one, sightings=tuple(sightings)))
    true = [
        replace(camera, cam_from_world=compose(camera.cam_from_world, poses[frame][0]))
        for frame in poses
        for camera in cameras
    ]
    return [board], spoilt_seen, true


@pytest.mark.parametrize("seed", some_of(range(24)))
def test_what_is_left_of_a_recording_gives_an_honest_rig_or_a_reason(seed: int) -> None:
    boards, seen, true = spoilt(np.random.default_rng(seed))

    try:
        calibration, certificate = calibrated(boards, seen)
    except CalibrationError:
        return

    assert calibration.record.world is not None
    instant = calibration.record.world.instant
    if certificate.doubts or not isinstance(instant, int):
        return
    count = len(seen)
    assert worst_sigmas(calibration, certificate, true[instant * count : (instant + 1) * count]) < (
        _CONFIDENTLY_WRONG
    )
