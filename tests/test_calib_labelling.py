"""A mirrored picture of a chessboard that lies still shows by the scene around the board alone."""

import functools
import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.boards import (
    floor_of_noise,
    make_camera,
    observe_exactly,
    render_board,
    ring,
)

from hybridve.calib.boards.board import Observations, Sighting
from hybridve.calib.boards.target import Chessboard, find_corners
from hybridve.calib.calibrate import solve_rig
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.placing import labelling
from hybridve.calib.placing.labelling import label_still_boards
from hybridve.calib.placing.scene_votes import unmirrored
from hybridve.calib.placing.surroundings import LooksByVote, describe_scene, with_floor
from hybridve.calib.pose import compose
from hybridve.calib.record import Labelling
from hybridve.calib.solving.locate import locate_board

SIZE_PX = (320, 240)

#: Colours tell the ends of the first; the others look the same after 1/2 or 1/4 of a turn, and
#: the mirror image of the last has its colours exchanged.
BOARDS = {
    "7x6": Chessboard(7, 6, 0.1),
    "6x7": Chessboard(6, 7, 0.1),
    "8x6": Chessboard(8, 6, 0.1),
    "6x6": Chessboard(6, 6, 0.1),
    "7x7": Chessboard(7, 7, 0.1),
    "7x5": Chessboard(7, 5, 0.1),
}


def lens_mirrored(camera: Camera) -> Camera:
    """Return the lens that fits what a camera of model PINHOLE or OPENCV sees, once flipped."""
    params = camera.params.copy()
    params[2] = camera.width_px - params[2]
    if camera.model == "OPENCV":
        params[7] *= -1.0
    return replace(camera, params=params)


@functools.cache
def seen_around(
    name: str, is_textured: bool, count: int
) -> tuple[tuple[Camera, ...], tuple[Observations, ...]]:
    """Return cameras around a board, and what they see as it is, then what they see mirrored."""
    board = BOARDS[name]
    cameras = [
        make_camera(camera.name, "PINHOLE", camera.cam_from_world, SIZE_PX)
        for camera in ring(board, ["PINHOLE"] * count)
    ]
    floor = floor_of_noise(4) if is_textured else None
    seen = []
    for observed, camera in zip(observe_exactly(board, cameras), cameras, strict=True):
        image = render_board(camera, board, floor=floor, samples=1)
        seen.append(in_picture(observed, board, image))
    grid = np.arange(board.columns * board.rows).reshape(board.rows, board.columns)
    for observed in seen[:count]:
        stills = [
            replace(
                still,
                pixels=(still.pixels * [-1.0, 1.0] + [SIZE_PX[0], 0.0])[grid[:, ::-1].ravel()],
            )
            for still in observed.sightings[:-1]
        ]
        assert observed.picture is not None
        image = np.ascontiguousarray(observed.picture[:, ::-1])
        last = observed.sightings[-1]  # of the clip, in whose place the mirrored one is put
        seen.append(in_picture(replace(observed, sightings=(*stills, last)), board, image))
    return (*cameras, *map(lens_mirrored, cameras)), tuple(seen)


def in_picture(seen: Observations, board: Chessboard, image: np.ndarray) -> Observations:
    """Return what was seen with a clip of one picture, its corners as they are found there."""
    corners = find_corners(image, board)
    assert corners is not None
    clip = Sighting("board clip", 0, 0, corners)
    return replace(seen, sightings=(*seen.sightings[:-1], clip), picture=image.astype(np.float32))


def label(
    name: str, is_mirrored: tuple[bool, ...], is_textured: bool = True
) -> tuple[list[Observations], Labelling]:
    count = len(is_mirrored)
    cameras, seen = seen_around(name, is_textured, max(count, 3))
    picked = [index + max(count, 3) * flip for index, flip in enumerate(is_mirrored)]
    return label_still_boards(
        [BOARDS[name]], [cameras[i] for i in picked], [seen[i] for i in picked]
    )


def refusal(name: str, is_mirrored: tuple[bool, ...]) -> str:
    with pytest.raises(CalibrationError) as caught:
        label(name, is_mirrored)
    return str(caught.value)


@pytest.mark.parametrize("name", BOARDS)
def test_the_pose_behind_a_mirrored_picture_is_the_cameras_in_some_look(name: str) -> None:
    board = BOARDS[name]
    camera = make_camera("cam", "PINHOLE", ring(board, ["PINHOLE"] * 3)[1].cam_from_world, SIZE_PX)
    corners = find_corners(render_board(camera, board, samples=1)[:, ::-1], board)
    assert corners is not None
    located = locate_board(lens_mirrored(camera), board.points_board, corners)
    assert located is not None

    pose = unmirrored(located[0], board)

    misses = [
        np.abs(pose - compose(camera.cam_from_world, board.board_from_turned(look))).max()
        for look in range(len(board.looks))
    ]
    assert min(misses) < 0.02
    assert np.linalg.det(pose[:, :3]) == pytest.approx(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["7x6", "6x6"])
def test_a_mirrored_picture_is_named(name: str) -> None:
    told = refusal(name, (False, True, False))

    assert told.startswith("camera 'cam2': its picture seems to be mirrored: ")
    assert told.endswith("record it unmirrored")
    flipped, plain = map(int, re.findall(r"\d+(?= matches)|\d+(?= if not)", told))
    assert flipped > 5 * plain


@pytest.mark.parametrize("name", ["7x6", "8x6"])
def test_pictures_that_agree_are_not_accused(name: str) -> None:
    labelled, evidence = label(name, (False, False, False))

    assert not evidence.is_weak
    if len(BOARDS[name].looks) == 1:
        given = seen_around(name, True, 3)[1]
        for one, other in zip(labelled, given[:3], strict=True):
            np.testing.assert_array_equal(one.sightings[-1].pixels, other.sightings[-1].pixels)


def test_pictures_that_are_all_mirrored_show_a_world_that_there_might_be() -> None:
    _, evidence = label("7x6", (True, True, True))

    assert not evidence.is_weak


@pytest.mark.slow
@pytest.mark.parametrize("name", ["7x6", "8x6"])
def test_where_nothing_is_around_the_board_nobody_is_accused(name: str) -> None:
    _, evidence = label(name, (False, True), is_textured=False)

    # Of the one, nothing was to be decided.
    assert evidence.is_weak is {"7x6": None, "8x6": True}[name]


@pytest.mark.slow
@pytest.mark.parametrize("sigmas", [(1.0, 9.0), (9.0, 1.0)])
def test_of_two_boards_the_one_that_is_told_worse_is_doubted(
    monkeypatch: pytest.MonkeyPatch, sigmas: tuple[float, float]
) -> None:
    board, (cameras, seen) = BOARDS["8x6"], seen_around("8x6", True, 3)
    twice = [
        replace(one, sightings=(*one.sightings, replace(one.sightings[-1], board=1)))
        for one in seen[:2]
    ]
    found = iter(LooksByVote((0, 0), (sigma, sigma), sigma, ()) for sigma in sigmas)
    monkeypatch.setattr(labelling, "choose_looks", lambda votes: next(found))

    _, evidence = label_still_boards([board, board], cameras[:2], twice)

    assert evidence.is_weak
    assert evidence.weakest_sigma == 1.0


def test_of_two_cameras_either_may_be_mirrored() -> None:
    told = refusal("8x6", (False, True))

    assert told.startswith("the picture of camera 'cam1' or of 'cam2' seems to be mirrored: ")


@pytest.mark.slow
def test_of_two_kinds_of_pictures_the_fewer_are_the_suspects() -> None:
    told = refusal("7x6", (True, False, True, True, False))

    assert told.startswith("cameras 'cam2', 'cam5': their pictures seem to be mirrored: ")
    assert told.endswith("record them unmirrored")


@pytest.mark.slow
def test_no_rig_is_made_of_a_mirrored_picture() -> None:
    _, seen = seen_around("8x6", True, 3)

    with pytest.raises(CalibrationError, match="'cam3': its picture seems to be mirrored"):
        solve_rig([BOARDS["8x6"]], [seen[0], seen[1], seen[5]])


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV"])
def test_a_mirrored_picture_flipped_is_described_as_the_picture(model: str) -> None:
    board = BOARDS["7x6"]
    camera = make_camera("cam", model, ring(board, ["PINHOLE"])[0].cam_from_world, SIZE_PX)
    image = render_board(camera, board, floor=floor_of_noise(4), samples=1)
    pose = camera.cam_from_world

    scenes = [
        with_floor(describe_scene(*about), *about)
        for about in (
            (camera, pose, image, board, False),
            (lens_mirrored(camera), pose, image[:, ::-1], board, True),
        )
    ]

    assert len(scenes[0].rays) > 100
    assert len(scenes[0].floor_points) > 20
    np.testing.assert_allclose(scenes[1].rays, scenes[0].rays, atol=1e-9)
    np.testing.assert_array_equal(scenes[1].descriptors, scenes[0].descriptors)
    # Places of pixels are rounded to 1/32 when the view from above is drawn.
    np.testing.assert_allclose(scenes[1].floor_points, scenes[0].floor_points, atol=1e-3)
