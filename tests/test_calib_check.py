"""A rig against boards: its scale, and which of its cameras was moved, zoomed or exchanged."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import lru_cache

import numpy as np
import pytest
from helpers.boards import HEIGHT_PX, WIDTH_PX, look_at, make_camera, project, ring
from helpers.bundles import BOARD as CALIBRATED
from helpers.bundles import make_bundle

from hybridve.calib.boards.board import Board, Observations, Sighting
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.judging.case import SIGNIFICANCE
from hybridve.calib.judging.check import check_rig
from hybridve.calib.judging.comparison import chance_of
from hybridve.calib.judging.wording import SCALE_TOLERANCE
from hybridve.calib.pose import compose, moved_pose, rotation_about_axes
from hybridve.calib.rig import Rig
from hybridve.calib.solving.bundle import adjust
from hybridve.calib.solving.covariance import rig_covariance
from hybridve.calib.solving.noise import measure_noise
from hybridve.calib.solving.placement import zoomed
from hybridve.calib.verdict import RigCheck

#: Noise-free corners determine the scale to this, and reprojections in pixels.
EXACT = 1e-6

BOARD = Chessboard(8, 7, 0.1)


def corners_of(cameras: list[Camera], board: Chessboard = BOARD) -> dict[str, list[Sighting]]:
    """Return corners as pictures would give them: any camera may have them the other way round."""
    seen = {}
    for index, camera in enumerate(cameras):
        corners = project(camera, camera.cam_from_world, board)
        corners = corners[board.looks[index % len(board.looks)]]
        seen[camera.name] = [Sighting("board clip", 0, 0, corners)]
    return seen


def examine(rig: Rig, boards: Sequence[Board], seen: Mapping[str, Sequence[Sighting]]) -> RigCheck:
    """Check a rig by corners alone: there is no picture of what is around the boards."""
    size_px = (WIDTH_PX, HEIGHT_PX)
    is_still = all(one.instant == 0 for sightings in seen.values() for one in sightings)
    return check_rig(
        rig,
        boards,
        [
            Observations(name, "PINHOLE", size_px, tuple(sightings), is_still)
            for name, sightings in seen.items()
        ],
    )


def scaled(camera: Camera, factor: float) -> Camera:
    pose = camera.cam_from_world.copy()
    pose[:, 3] *= factor
    return replace(camera, cam_from_world=pose)


@pytest.mark.parametrize(
    "board", [BOARD, Chessboard(8, 6, 0.1), Chessboard(7, 7, 0.1), Chessboard(6, 6, 0.1)]
)
def test_a_true_rig_agrees_with_its_board(board: Chessboard) -> None:
    cameras = ring(board, ["OPENCV", "PINHOLE", "RADIAL"])

    check = examine(Rig(tuple(cameras)), [board], corners_of(cameras, board))

    assert not check.is_refuted
    # No corner tells whether a camera stands turned about a board that looks the same then.
    is_told = len(board.looks) == 1
    assert check.is_trustworthy == is_told
    assert check.undecided == (() if is_told else ("cam1", "cam2", "cam3"))
    assert ("cannot be told" in check.message) == (not is_told)
    assert check.scale == pytest.approx(1.0, abs=EXACT)
    assert max(check.rms_px.values()) < EXACT
    assert check.odd_camera is None
    assert "agrees" in check.message


def test_the_rig_may_stand_anywhere_in_its_world() -> None:
    cameras = ring(BOARD, ["PINHOLE", "PINHOLE"])
    elsewhere = np.column_stack([rotation_about_axes((20.0, 70.0, 100.0)), [3.0, -2.0, 5.0]])
    moved = [
        replace(camera, cam_from_world=compose(camera.cam_from_world, elsewhere))
        for camera in cameras
    ]

    check = examine(Rig(tuple(moved)), [BOARD], corners_of(cameras))

    assert check.is_trustworthy
    assert check.scale == pytest.approx(1.0, abs=EXACT)


@pytest.mark.parametrize("factor", [0.001, 0.5, 1.3, 25.4])
def test_a_wrong_scale_is_found_and_told(factor: float) -> None:
    cameras = ring(BOARD, ["PINHOLE", "OPENCV", "PINHOLE"])
    rig = Rig(tuple(scaled(camera, factor) for camera in cameras))

    check = examine(rig, [BOARD], corners_of(cameras))

    assert not check.is_trustworthy
    assert check.scale == pytest.approx(factor, rel=EXACT)
    assert check.pair_scales["cam1 cam3"] == pytest.approx(factor, rel=EXACT)
    assert f"scale {factor:.3f}" in check.message
    assert "unit" in check.message


def test_a_scale_within_tolerance_is_told_but_trusted() -> None:
    cameras = ring(BOARD, ["PINHOLE", "PINHOLE"])
    rig = Rig(tuple(scaled(camera, 1 + SCALE_TOLERANCE / 2) for camera in cameras))

    check = examine(rig, [BOARD], corners_of(cameras))

    assert check.is_trustworthy
    assert "scale 1.025" in check.message


def test_a_camera_that_was_bumped_is_named() -> None:
    cameras = ring(BOARD, ["PINHOLE"] * 4)
    bump = np.column_stack([rotation_about_axes((0.0, 4.0, 0.0)), [0.05, 0.0, 0.0]])
    bumped = [*cameras]
    bumped[2] = replace(cameras[2], cam_from_world=compose(bump, cameras[2].cam_from_world))

    check = examine(Rig(tuple(bumped)), [BOARD], corners_of(cameras))

    assert check.odd_camera == "cam3"
    assert not check.is_trustworthy
    assert "'cam3' stands elsewhere" in check.message


def test_two_cameras_that_disagree_are_told_without_blaming_one() -> None:
    cameras = ring(BOARD, ["PINHOLE", "PINHOLE"])
    bump = np.column_stack([rotation_about_axes((0.0, 5.0, 0.0)), np.zeros(3)])
    bumped = [
        cameras[0],
        replace(cameras[1], cam_from_world=compose(bump, cameras[1].cam_from_world)),
    ]

    check = examine(Rig(tuple(bumped)), [BOARD], corners_of(cameras))

    assert not check.is_trustworthy
    assert check.odd_camera is None
    assert check.suspects == ("cam1", "cam2")
    assert "one of 'cam1' and 'cam2'" in check.message


def test_cameras_in_one_place_tell_no_scale() -> None:
    first = ring(BOARD, ["PINHOLE"] * 3)[0]
    turned = moved_pose(first.cam_from_world, np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0]))
    cameras = [first, replace(first, name="cam2", cam_from_world=turned)]

    check = examine(Rig(tuple(cameras)), [BOARD], corners_of(cameras))

    assert check.is_trustworthy
    assert check.pair_scales == {}
    assert "cannot be told" in check.message


def test_one_camera_cannot_check_a_rig() -> None:
    cameras = ring(BOARD, ["PINHOLE", "PINHOLE"])
    corners = corners_of(cameras)
    del corners["cam2"]

    with pytest.raises(CalibrationError, match="1 of its cameras see the board, expected two"):
        examine(Rig(tuple(cameras)), [BOARD], corners)


def test_cameras_that_saw_no_board_are_left_out() -> None:
    cameras = ring(BOARD, ["PINHOLE", "PINHOLE"])
    idle = make_camera("idle", "PINHOLE", look_at((0.0, 0.0, 5.0), (9.0, 0.0, 0.0)))

    check = examine(Rig((*cameras, idle)), [BOARD], corners_of(cameras))

    assert check.is_trustworthy
    assert set(check.rms_px) == {"cam1", "cam2"}
    assert check.untested == ("idle",)
    assert "not tested: idle" in check.message


# --- Many boards, many moments, and a rig that knows its own errors ---------------------------

NOISE_PX = 0.3
MODELS = ("SIMPLE_RADIAL", "OPENCV", "RADIAL", "PINHOLE")
N_SEEDS = 15

#: What was to be noticed: 5 mm and 0.3 degrees, of cameras 1.9 m from the board.
BUMP_MM, BUMP_DEG = 5.0, 0.3


@lru_cache(maxsize=64)
def calibrated(seed: int, models: tuple[str, ...] = MODELS) -> Rig:
    """A rig from noisy boards, with the covariance that it then has; cameras as in `truth`."""
    adjusted = adjust(make_bundle(list(models), n_stills=12, noise_px=NOISE_PX, seed=seed))
    sigma_px = measure_noise(adjusted).smooth_px
    return Rig(adjusted.bundle.cameras, covariance=rig_covariance(adjusted, sigma_px))


def truth(models: tuple[str, ...] = MODELS) -> list[Camera]:
    return list(make_bundle(list(models), n_stills=0).cameras)


def seen_by(
    cameras: Sequence[Camera],
    boards: Sequence[Chessboard] = (CALIBRATED,),
    n_moments: int = 1,
    seed: int = 0,
    noise_px: float = NOISE_PX,
) -> dict[str, list[Sighting]]:
    """Return what cameras see of boards about the floor; corners outside an image are not seen."""
    rng = np.random.default_rng(seed)
    seen: dict[str, list[Sighting]] = {camera.name: [] for camera in cameras}
    for moment in range(n_moments):
        for number, board in enumerate(boards):
            spread = 0.0 if n_moments * len(boards) == 1 else 0.12
            world_from_board = moved_pose(np.eye(3, 4), rng.normal(0.0, spread, 6))
            for camera in cameras:
                pixels = project(camera, compose(camera.cam_from_world, world_from_board), board)
                pixels += rng.normal(0.0, noise_px, pixels.shape)
                outside = ((pixels < 0) | (pixels > (WIDTH_PX, HEIGHT_PX))).any(axis=1)
                pixels[outside] = np.nan
                seen[camera.name].append(Sighting(f"frame {moment}", moment, number, pixels))
    return seen


def bumped(
    camera: Camera, seed: int, shift_mm: float = BUMP_MM, turn_deg: float = BUMP_DEG
) -> Camera:
    """Return a camera moved and turned by so much, in directions that the seed gives."""
    rng = np.random.default_rng(seed)
    axis, way = rng.normal(size=3), rng.normal(size=3)
    turn = np.concatenate([axis / np.linalg.norm(axis) * np.deg2rad(turn_deg), np.zeros(3)])
    rotation = moved_pose(camera.cam_from_world, turn)[:, :3]
    center = camera.center_world + way / np.linalg.norm(way) * shift_mm / 1000.0
    return replace(camera, cam_from_world=np.column_stack([rotation, -rotation @ center]))


def with_one(cameras: Sequence[Camera], index: int, changed: Camera) -> list[Camera]:
    return [changed if number == index else camera for number, camera in enumerate(cameras)]


def exchanged(
    seen: Mapping[str, list[Sighting]], first: str, second: str
) -> dict[str, list[Sighting]]:
    return {**seen, first: seen[second], second: seen[first]}


@pytest.mark.slow
def test_an_untouched_rig_is_accused_as_rarely_as_is_said() -> None:
    """At most SIGNIFICANCE of the rigs: of 15, one is accused once in 600 such tests."""
    checks = [
        examine(calibrated(seed), [CALIBRATED], seen_by(truth(), seed=1000 + seed))
        for seed in range(N_SEEDS)
    ]

    assert all(check.is_trustworthy for check in checks)
    # The probabilities are not all near one either: some of 15 should be below a half.
    values = [check.p_value for check in checks if check.p_value is not None]
    assert len(values) == N_SEEDS
    assert 0.001 < min(values) < 0.5


@pytest.mark.slow
def test_a_camera_bumped_by_5_mm_and_a_third_of_a_degree_is_named() -> None:
    """In nearly all directions: what looks like an error that the rig states is not accused."""
    named, shifts_mm, turns_deg = 0, [], []
    for seed in range(N_SEEDS):
        index = seed % len(MODELS)
        now = with_one(truth(), index, bumped(truth()[index], seed))
        seen = seen_by(now, n_moments=4, seed=2000 + seed)
        check = examine(calibrated(seed), [CALIBRATED], seen)
        if check.odd_camera == now[index].name:
            named += 1
            told = check.moved[check.odd_camera]
            assert told.p_value is not None
            assert told.p_value < SIGNIFICANCE
            assert f"{told.shift_mm:.1f} mm" in check.message
            shifts_mm.append(told.shift_mm)
            turns_deg.append(told.turn_deg)
        assert not set(check.moved) - {now[index].name}  # never another one

    assert named >= N_SEEDS - 1
    # The rig's own errors, of 1 to 2 mm a coordinate, are part of what is told.
    assert np.median(shifts_mm) == pytest.approx(BUMP_MM, abs=3.0)
    assert np.median(turns_deg) == pytest.approx(BUMP_DEG, abs=0.1)


def test_a_rig_is_not_accused_of_errors_that_it_states_itself() -> None:
    """The same rig, shaken: with a covariance that allows for it, and with one that does not."""
    rig = calibrated(0)
    rng = np.random.default_rng(5)
    cameras, matrix = [], np.zeros_like(rig.covariance.matrix)  # type: ignore[union-attr]
    start = 0
    for camera in rig.cameras:
        sigma = np.array([0.01] * 3 + [0.02] * 3)
        span = range(start, start + 6)
        matrix[span, span] = sigma**2
        pose = moved_pose(camera.cam_from_world, rng.normal(0.0, sigma))
        cameras.append(replace(camera, cam_from_world=pose))
        start += 6 + len(camera.params)
    assert rig.covariance is not None
    seen = seen_by(truth(), n_moments=3)

    modest = Rig(tuple(cameras), covariance=replace(rig.covariance, matrix=matrix))
    proud = Rig(tuple(cameras), covariance=rig.covariance)

    assert examine(modest, [CALIBRATED], seen).is_trustworthy
    assert not examine(proud, [CALIBRATED], seen).is_trustworthy


@pytest.mark.slow
def test_several_bumped_cameras_are_named_with_how_far_they_moved() -> None:
    models = (*MODELS, "OPENCV")
    cameras = truth(models)
    cameras[1] = bumped(cameras[1], 1, 80.0, 5.0)
    cameras[3] = bumped(cameras[3], 2, 50.0, 3.0)

    check = examine(calibrated(0, models), [CALIBRATED], seen_by(cameras, n_moments=3))

    assert set(check.moved) == {"cam2", "cam4"}
    assert check.odd_camera is None
    assert check.moved["cam2"].shift_mm == pytest.approx(80.0, abs=8.0)
    assert check.moved["cam2"].turn_deg == pytest.approx(5.0, abs=0.3)
    assert check.moved["cam4"].shift_mm == pytest.approx(50.0, abs=8.0)
    assert check.moved["cam4"].what == "pose"


@pytest.mark.slow
@pytest.mark.parametrize("knows_its_errors", [True, False])
@pytest.mark.parametrize("pair", [("cam1", "cam2"), ("cam1", "cam3"), ("cam3", "cam4")])
def test_exchanged_cameras_are_named(pair: tuple[str, str], knows_its_errors: bool) -> None:
    rig = calibrated(1)
    if not knows_its_errors:
        rig = Rig(rig.cameras)

    check = examine(rig, [CALIBRATED], exchanged(seen_by(truth()), *pair))

    assert check.exchanged == pair
    assert not check.is_trustworthy
    assert f"'{pair[0]}' and '{pair[1]}' are exchanged" in check.message


def test_two_exchanged_cameras_alone_are_named() -> None:
    rig = calibrated(1).only(["cam1", "cam2"])

    check = examine(rig, [CALIBRATED], exchanged(seen_by(truth()[:2]), "cam1", "cam2"))

    assert check.exchanged == ("cam1", "cam2")


@pytest.mark.parametrize("n_cameras", [2, 4])
@pytest.mark.parametrize("knows_its_errors", [True, False])
@pytest.mark.parametrize("factor", [0.85, 1.15])
def test_a_zoom_is_told_from_a_move(n_cameras: int, knows_its_errors: bool, factor: float) -> None:
    rig = calibrated(2).only([f"cam{number + 1}" for number in range(n_cameras)])
    if not knows_its_errors:
        rig = Rig(rig.cameras)
    cameras = truth()[:n_cameras]

    now = with_one(cameras, 1, zoomed(cameras[1], factor))
    check = examine(rig, [CALIBRATED], seen_by(now, n_moments=3))

    assert check.odd_camera == "cam2"
    assert check.moved["cam2"].what == "lens"
    assert check.moved["cam2"].focal_factor == pytest.approx(factor, rel=0.02)
    assert "another lens or zoom" in check.message


def test_a_scale_beyond_the_stated_errors_is_told() -> None:
    rig = calibrated(3)
    assert rig.covariance is not None
    lengths = np.ones(len(rig.covariance.labels))
    lengths[[label.endswith((" tx", " ty", " tz")) for label in rig.covariance.labels]] = 1.02
    matrix = rig.covariance.matrix * np.outer(lengths, lengths)
    larger = Rig(
        tuple(scaled(camera, 1.02) for camera in rig.cameras),
        covariance=replace(rig.covariance, matrix=matrix),
    )
    seen = seen_by(truth())

    known = examine(larger, [CALIBRATED], seen)
    unknown = examine(Rig(larger.cameras), [CALIBRATED], seen)

    assert not known.is_trustworthy
    assert not known.moved
    assert known.scale_sigma is not None
    assert abs(known.scale - 1.02) < 4.0 * known.scale_sigma
    assert unknown.is_trustworthy  # 5 % are allowed where errors are not known


def test_the_order_of_cameras_and_sightings_does_not_matter() -> None:
    rig = calibrated(4)
    now = with_one(truth(), 2, bumped(truth()[2], 4, 20.0, 1.0))
    seen = seen_by(now, n_moments=3)

    forth = examine(rig, [CALIBRATED], seen)
    back = examine(
        rig.only([camera.name for camera in reversed(rig.cameras)]),
        [CALIBRATED],
        {name: sightings[::-1] for name, sightings in reversed(seen.items())},
    )

    assert forth.odd_camera == "cam3"
    assert plain(back) == plain(forth)


def plain(check: RigCheck) -> dict[str, object]:
    """Return a check as JSON has it."""
    found = json.loads(json.dumps(asdict(check), allow_nan=False))
    assert isinstance(found, dict)
    return found


def test_boards_of_several_kinds_are_used_also_where_they_are_seen_in_part() -> None:
    """Two boards, one of which looks the same turned, near enough to leave the images."""
    boards = [CALIBRATED, Chessboard(8, 6, 0.3)]
    seen = seen_by(truth(), boards, n_moments=3, noise_px=0.0)
    for sightings in seen.values():
        assert any(np.isnan(sighting.pixels).any() for sighting in sightings)

    check = examine(Rig(tuple(truth())), boards, seen)

    assert check.is_trustworthy
    assert check.n_placements == 6
    assert check.scale == pytest.approx(1.0, abs=EXACT)
    assert max(check.rms_px.values()) < 1e-5


def test_wild_corners_accuse_nobody() -> None:
    seen = seen_by(truth(), n_moments=4)
    for name, sightings in seen.items():
        sightings[1].pixels[3] += (40.0, -25.0) if name == "cam1" else (0.0, 60.0)

    check = examine(calibrated(5), [CALIBRATED], seen)

    assert check.is_trustworthy, check.message


def test_moments_that_cameras_do_not_share_tell_nothing() -> None:
    seen = seen_by(truth()[:2])
    seen["cam2"] = [replace(sighting, instant=7) for sighting in seen["cam2"]]

    with pytest.raises(CalibrationError, match="no two of its cameras see the board at the same"):
        examine(Rig(tuple(truth()[:2])), [CALIBRATED], seen)


def test_the_chance_of_a_statistic_is_that_of_tables() -> None:
    table = {(1, 6.635): 0.01, (2, 5.991): 0.05, (5, 15.086): 0.01, (17, 27.587): 0.05}
    for (freedom, value), chance in table.items():
        assert chance_of(value, freedom) == pytest.approx(chance, rel=2e-3)
    assert chance_of(0.0, 4) == 1.0
    assert chance_of(3.0, 0) == 1.0
