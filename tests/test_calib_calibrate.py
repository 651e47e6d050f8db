"""From pictures to a rig: stills and clips on disk, which way round a board lies, bad input."""

import itertools
import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.boards import (
    board_poses,
    floor_of_noise,
    look_at,
    make_camera,
    observe_exactly,
    project,
    render_board,
    ring,
)
from helpers.records import record_of
from numpy.typing import NDArray

from hybridve.calib.boards.board import Observations, Sighting
from hybridve.calib.boards.target import Chessboard, find_corners
from hybridve.calib.calibrate import calibrate_rig, solve_rig
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats.rig_json import rig_to_dict
from hybridve.calib.image_io import open_source
from hybridve.calib.placing.settings import CalibrationSettings
from hybridve.calib.provenance import provenance_from_plain
from hybridve.calib.rig import Rig
from hybridve.calib.seeing.inputs import CameraInput, ObserveSettings

#: Rendered boards of 4 stills place cameras to this, by their distance from the board.
PLACED = 0.01

#: Images searched at once; the tests share the machine.
SETTINGS = CalibrationSettings(observe=ObserveSettings(threads=2))

BOARD = Chessboard(7, 6, 0.1)
SYMMETRIC = Chessboard(8, 6, 0.1)
SIZE_PX = (480, 360)


def write_images(folder: Path, images: list[NDArray[np.uint8]]) -> None:
    folder.mkdir(parents=True)
    for number, image in enumerate(images):
        assert cv2.imwrite(str(folder / f"{number}.png"), image)


def two_cameras() -> list[Camera]:
    x, y, _ = BOARD.center_board
    return [
        make_camera("left", "PINHOLE", look_at((x - 0.9, y - 0.7, 1.0), (x, y, 0.0)), SIZE_PX),
        make_camera("right", "PINHOLE", look_at((x + 0.8, y - 0.7, 1.1), (x, y, 0.0)), SIZE_PX),
    ]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two cameras: six stills each (one shows no board), and a clip of five frames."""
    root = tmp_path_factory.mktemp("board")
    rng = np.random.default_rng(0)
    for index, camera in enumerate(two_cameras()):
        stills = [
            render_board(camera, BOARD, pose, samples=2) for pose in board_poses(BOARD, 5, index)
        ]
        stills.insert(3, np.full((SIZE_PX[1], SIZE_PX[0]), 90, np.uint8))
        write_images(root / camera.name / "stills", stills)
        still = render_board(camera, BOARD, samples=3).astype(float)
        clip = []
        for frame in range(5):
            image = still + rng.normal(0.0, 3.0, still.shape)
            if frame == 2:
                image[:, 100:380] = 60.0  # somebody walks through
            clip.append(np.clip(np.round(image), 0, 255).astype(np.uint8))
        write_images(root / camera.name / "clip", clip)
    return root


def inputs(root: Path, **changes: Any) -> list[CameraInput]:
    return [
        replace(
            CameraInput(
                name,
                "PINHOLE",
                open_source(root, f"{name}/stills/*.png"),
                open_source(root, f"{name}/clip/*.png"),
                None,
            ),
            **changes,
        )
        for name in ("left", "right")
    ]


@pytest.fixture(scope="module")
def rig(recorded: Path) -> Rig:
    return calibrate_rig([BOARD], inputs(recorded), SETTINGS).rig


@pytest.mark.slow
def test_pictures_give_the_rig(rig: Rig) -> None:
    for camera in two_cameras():
        distance_m = np.linalg.norm(rig[camera.name].center_world - camera.center_world)
        assert distance_m < PLACED * np.linalg.norm(camera.center_world)


@pytest.mark.slow
def test_the_provenance_is_plain_json_and_says_what_was_used(rig: Rig) -> None:
    told = json.loads(json.dumps(rig_to_dict(rig), allow_nan=False))["provenance"]

    assert provenance_from_plain(told) == rig.provenance
    left = told["cameras"]["left"]
    assert left["intrinsics"]["views_used"] == 5
    assert left["intrinsics"]["views_without_board"] == {"3.png": "no board found"}
    assert left["extrinsics"]["views_used"] == 1
    assert left["extrinsics"]["how"].startswith("detected")
    assert 0 < left["extrinsics"]["spread_over_clip_px"] < 1.0
    assert told["labelling"] == {"looks": 1, "decided_by": "the board's colours or markers"}


# --- Corners by hand --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hidden_row(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The clip of the left camera with the margin of the board hidden, so that none is found."""
    root = tmp_path_factory.mktemp("hidden")
    camera = two_cameras()[0]
    image = render_board(camera, BOARD, samples=3)
    corners = project(camera, camera.cam_from_world, BOARD)
    for corner in corners[[0, 6, 35, 41]]:  # a finger on each end of the board
        x, y = np.round(corner).astype(int)
        cv2.circle(image, (int(x), int(y)), 13, 60, -1)
    write_images(root / "clip", [image])
    assert find_corners(image, BOARD) is None
    return root


def write_marks(path: Path, corners: NDArray[np.float64]) -> None:
    lines = [f"{x},{y}" for x, y in np.round(corners - 0.5)]
    path.write_text("x,y\n" + "\n".join(lines) + "\n")


@pytest.mark.slow
def test_corners_marked_by_hand_serve_where_none_are_found(
    recorded: Path, hidden_row: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    camera = two_cameras()[0]
    write_marks(tmp_path / "marks.csv", project(camera, camera.cam_from_world, BOARD))
    left = replace(
        inputs(recorded)[0],
        extrinsics=open_source(hidden_row, "clip/0.png"),
        corners=tmp_path / "marks.csv",
    )

    rig = calibrate_rig([BOARD], [left], SETTINGS).rig

    assert "marked by hand" in record_of(rig).cameras["left"].extrinsics.how
    assert any("no board found" in record.message for record in caplog.records)
    distance_m = np.linalg.norm(rig["left"].center_world - camera.center_world)
    assert distance_m < 3 * PLACED * np.linalg.norm(camera.center_world)


@pytest.mark.slow
def test_a_camera_without_board_or_marks_is_named_with_what_was_tried(
    recorded: Path, hidden_row: Path
) -> None:
    left = replace(inputs(recorded)[0], extrinsics=open_source(hidden_row, "clip/0.png"))

    with pytest.raises(
        CalibrationError, match=r"'left': no board of 7x6 .* tried classic at .*sector at .*by hand"
    ):
        calibrate_rig([BOARD], [left], SETTINGS)


# --- Which way round a symmetric board was seen ------------------------------------------------


def seen_on_a_floor(board: Chessboard, cameras: list[Camera], textured: bool) -> list[Observations]:
    """Return observations of a symmetric board, each listed as its own picture suggests."""
    observations = []
    for seen, camera in zip(observe_exactly(board, cameras), cameras, strict=True):
        image = render_board(
            camera, board, floor=floor_of_noise(4) if textured else None, samples=2
        )
        corners = find_corners(image, board)
        assert corners is not None
        clip = Sighting("board clip", 0, 0, corners)
        observations.append(
            replace(
                seen,
                sightings=(*seen.sightings[:-1], clip),
                picture=image.astype(np.float32),
            )
        )
    return observations


def distances(cameras: tuple[Camera, ...] | list[Camera]) -> NDArray[np.float64]:
    pairs = itertools.combinations(cameras, 2)
    return np.array([np.linalg.norm(a.center_world - b.center_world) for a, b in pairs])


def around(board: Chessboard) -> list[Camera]:
    """Three cameras around a board; canonical listings differ between them."""
    return [
        make_camera(camera.name, "PINHOLE", camera.cam_from_world, SIZE_PX)
        for camera in ring(board, ["PINHOLE"] * 3)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("board", [SYMMETRIC, Chessboard(6, 6, 0.1)])
def test_the_floor_around_it_tells_which_way_round_a_board_was_seen(board: Chessboard) -> None:
    cameras = around(board)
    observations = seen_on_a_floor(board, cameras, textured=True)

    rig = solve_rig([board], observations).rig

    np.testing.assert_allclose(distances(rig.cameras), distances(cameras), rtol=PLACED)
    evidence = record_of(rig).labelling
    assert evidence is not None
    assert not evidence.is_weak
    assert evidence.weakest_sigma is not None
    assert evidence.weakest_sigma > 5.0
    assert evidence.matches_by_look is not None
    assert len(evidence.matches_by_look["cam1 cam2"]) == len(board.looks)


@pytest.mark.slow
def test_without_anything_around_it_the_doubt_is_said(caplog: pytest.LogCaptureFixture) -> None:
    cameras = around(SYMMETRIC)
    observations = seen_on_a_floor(SYMMETRIC, cameras, textured=False)

    with caplog.at_level(logging.WARNING):
        rig = solve_rig([SYMMETRIC], observations).rig

    evidence = record_of(rig).labelling
    assert evidence is not None
    assert evidence.is_weak
    assert any("uncertain" in record.message for record in caplog.records)


@pytest.mark.slow
def test_marks_in_one_order_decide_where_the_scene_is_bare() -> None:
    cameras = around(SYMMETRIC)
    observations = seen_on_a_floor(SYMMETRIC, cameras, textured=False)
    for index, (seen, camera) in enumerate(zip(observations, cameras, strict=True)):
        truth = project(camera, camera.cam_from_world, SYMMETRIC)
        corners = seen.sightings[-1].pixels
        misses = [np.abs(corners[look] - truth).max() for look in SYMMETRIC.looks]
        observations[index] = replace(seen, hand_look=int(np.argmin(misses)))

    rig = solve_rig([SYMMETRIC], observations).rig

    # Not only the distances: the marks' first corner is the world's origin.
    for camera in cameras:
        off_m = np.linalg.norm(rig[camera.name].center_world - camera.center_world)
        assert off_m < PLACED * np.linalg.norm(camera.center_world)


# --- Bad input --------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_unknown_camera_model_is_named(recorded: Path) -> None:
    with pytest.raises(
        CalibrationError, match=r"'left': unknown camera model 'GOPRO'; one of .*OP"
    ):
        calibrate_rig([BOARD], inputs(recorded, model="GOPRO"))


@pytest.mark.slow
def test_a_camera_named_twice_is_refused(recorded: Path) -> None:
    with pytest.raises(CalibrationError, match="'same' is listed 2 times"):
        calibrate_rig([BOARD], inputs(recorded, name="same"))


def test_no_camera_is_refused() -> None:
    with pytest.raises(CalibrationError, match="no camera"):
        calibrate_rig([BOARD], [])


@pytest.mark.slow
def test_a_camera_without_a_common_clip_is_named(recorded: Path) -> None:
    with pytest.raises(CalibrationError, match="'left': no clip"):
        calibrate_rig([BOARD], inputs(recorded, extrinsics=None))


@pytest.mark.slow
def test_stills_without_the_board_are_counted(recorded: Path) -> None:
    only_bare = replace(inputs(recorded)[0], intrinsics=open_source(recorded, "left/stills/3.png"))

    with pytest.raises(CalibrationError, match="in 0 of 1 pictures, expected 3"):
        calibrate_rig([BOARD], [only_bare], SETTINGS)
