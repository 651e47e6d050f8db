"""Cameras hang together by what they saw at once; what does not is named."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.recorded_boards import (
    Recording,
    held_up,
    random_pose,
    record,
    reordered,
    row_of_cameras,
)
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import img_from_cam
from hybridve.calib.placing.link import Linked, link_cameras
from hybridve.calib.placing.moments import Body, Moment, PoseKey
from hybridve.calib.placing.never_met import solve_joint
from hybridve.calib.pose import Pose, angle_between, compose, invert, transform
from hybridve.calib.solving.locate import locate_board

#: Noise-free views chain to this: metres and radians.
EXACT = 1e-7

BOARD = Chessboard(7, 6, 0.05)  # its colours tell its ends apart
SYMMETRIC = Chessboard(8, 6, 0.05)


def link(recording: Recording, is_labelled: bool = True) -> Linked:
    return link_cameras(recording.boards, recording.lenses, recording.observations, is_labelled)


def assert_linked(linked: Linked, recording: Recording, tolerance: float = EXACT) -> None:
    """Cameras stand to one another as in truth, and every view is where its pose says."""
    first = min(range(len(recording.cameras)), key=lambda i: recording.cameras[i].name)
    world_from_rig = invert(recording.cameras[first].cam_from_world)
    for found, camera in zip(linked.cam_from_rig, recording.cameras, strict=True):
        true = compose(camera.cam_from_world, world_from_rig)
        assert angle_between(found, true) < tolerance
        assert np.linalg.norm(invert(found)[:, 3] - invert(true)[:, 3]) < tolerance
    for view in linked.views:
        cam_from_board = compose(
            linked.cam_from_rig[view.camera],
            compose(linked.rig_from_body[view.pose], linked.body_from_board[view.board]),
        )
        points = transform(cam_from_board, recording.boards[view.board].points_board)
        projected = img_from_cam(recording.lenses[view.camera].camera, points)
        assert np.nanmax(np.abs(projected - view.pixels)) < 2000 * tolerance


def passing_by(n_cameras: int, per_camera: int = 4, seed: int = 0, **how: Any) -> Recording:
    """A board carried along a row of cameras: each sees it together with its neighbours only."""
    rng = np.random.default_rng(seed)
    cameras = row_of_cameras(n_cameras, spacing_m=1.3)
    board = how.pop("board", BOARD)
    places = np.linspace(-0.3, 1.3 * (n_cameras - 1) + 0.3, per_camera * (2 * n_cameras - 1) + 1)
    poses = {
        5 * number: {0: held_up(rng, board, (x, rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2)))}
        for number, x in enumerate(places)
    }
    return record([board], cameras, poses, **how)


def seen_together(recording: Recording, one: int, other: int) -> int:
    instants = [{s.instant for s in recording.observations[i].sightings} for i in (one, other)]
    return len((instants[0] & instants[1]) - {None})


def test_a_chain_of_cameras_that_see_a_board_with_the_next_only() -> None:
    recording = passing_by(5, per_camera=6)
    assert seen_together(recording, 0, 1) >= 1
    assert seen_together(recording, 0, 2) == 0, "the chain would be short-cut"

    linked = link(recording)

    assert_linked(linked, recording)
    assert not linked.left_out
    assert not linked.warnings


@settings(max_examples=asked(10))
@given(seed=st.integers(0, 1000))
def test_the_order_of_views_changes_no_bit(seed: int) -> None:
    """That of cameras and boards is set before (`solve_rig`)."""
    recording = passing_by(4, seed=seed, noise_px=0.3, stills=2)
    turned = reordered(recording, range(4))

    linked, again = link(recording), link(turned)

    np.testing.assert_array_equal(again.cam_from_rig, linked.cam_from_rig)
    np.testing.assert_array_equal(again.rig_from_body, linked.rig_from_body)
    assert again.pose_keys == linked.pose_keys
    assert len(again.views) == len(linked.views)
    for view, other in zip(linked.views, again.views, strict=True):
        assert (view.pose, view.image, view.board) == (other.pose, other.image, other.board)
        assert other.camera == view.camera
        np.testing.assert_array_equal(view.pixels, other.pixels)


def test_noise_moves_the_chain_by_little() -> None:
    recording = passing_by(4, per_camera=8, noise_px=0.2)

    assert_linked(link(recording), recording, tolerance=0.05)


def test_views_that_the_lens_dropped_are_not_used_and_others_are_located() -> None:
    recording = passing_by(3, per_camera=8)
    lens = recording.lenses[1]
    dropped, unknown = sorted(lens.views)[3:5]
    lens.views.pop(dropped)
    lens.views.pop(unknown)
    lens.dropped[dropped[0]] = "blurred"

    linked = link(recording)

    assert_linked(linked, recording)
    images = {view.image for view in linked.views if view.camera == 1}
    assert dropped[0] not in images
    assert unknown[0] in images


def test_two_cameras_are_linked_by_one_view() -> None:
    pose = held_up(np.random.default_rng(3), BOARD, (0.1, 0.0, 0.0))
    recording = record([BOARD], row_of_cameras(2, 0.2), {17: {0: pose}})

    linked = link(recording)

    assert_linked(linked, recording)
    assert linked.pose_keys == (PoseKey(Moment.of_clip(17), Body(False, "board")),)


def test_one_camera_alone_is_a_rig() -> None:
    recording = passing_by(1, stills=3)

    linked = link(recording)

    assert_linked(linked, recording)
    stills = {key.moment.image for key in linked.pose_keys if not key.moment.is_clip}
    assert stills == {"0.png", "1.png", "2.png"}


def test_a_camera_upside_down_is_no_matter() -> None:
    recording = passing_by(3)
    flipped = np.diag([-1.0, -1.0, 1.0])
    cameras = list(recording.cameras)
    cameras[1] = replace(cameras[1], cam_from_world=flipped @ cameras[1].cam_from_world)
    rng = np.random.default_rng(0)
    poses = {
        n: {0: held_up(rng, BOARD, (x, 0.0, 0.0))} for n, x in enumerate(np.linspace(0, 2.6, 20))
    }
    recording = record([BOARD], cameras, poses)

    linked = link(recording)

    assert_linked(linked, recording)
    assert not linked.warnings


def test_a_still_board_needs_one_instant() -> None:
    cameras = row_of_cameras(3, 0.3)
    pose = held_up(np.random.default_rng(4), BOARD, (0.3, 0.0, 0.0))
    recording = record([BOARD], cameras, {0: {0: pose}}, stills=4, is_still=True)

    linked = link(recording)

    assert_linked(linked, recording)
    assert sum(view.image.startswith("board clip") for view in linked.views) == 3
    assert len(linked.views) == 3 + 3 * 4


# --- Several boards --------------------------------------------------------------------------

BACK_TO_BACK = [
    Chessboard(7, 6, 0.05, name="front", body="panel"),
    Chessboard(8, 5, 0.05, name="rear", body="panel"),
]
#: The rear board looks the other way, 2 cm behind the front one, a little askew.
FRONT_FROM_REAR = np.column_stack(
    [
        np.diag([-1.0, 1.0, -1.0]) @ random_pose(np.random.default_rng(1), 0.05, 0.0)[:, :3],
        [0.32, 0.01, -0.02],
    ]
)


def facing(n_near: int, n_far: int) -> list[Camera]:
    """Cameras before a panel and cameras behind it, all 2 m away, 0.2 m apart."""
    near = row_of_cameras(n_near, 0.2)
    turn = np.diag([-1.0, -1.0, 1.0])
    far = [
        replace(
            camera,
            name=f"far{index + 1}",
            cam_from_world=np.column_stack(
                [camera.cam_from_world[:, :3] @ turn, camera.cam_from_world[:, 3]]
            ),
        )
        for index, camera in enumerate(row_of_cameras(n_far, 0.2))
    ]
    return near + far


def panel_recording(cameras: list[Camera], n: int = 12, **how: Any) -> Recording:
    rng = np.random.default_rng(8)
    front = BACK_TO_BACK[0]
    poses = {k: held_up(rng, front, (0.1, 0.0, 0.0)) for k in range(n)}
    return record(
        BACK_TO_BACK,
        cameras,
        {k: {0: pose, 1: pose} for k, pose in poses.items()},
        [np.eye(3, 4), FRONT_FROM_REAR],
        **how,
    )


def test_cameras_on_both_sides_of_a_panel_are_linked_through_it() -> None:
    recording = panel_recording(facing(2, 2))
    for number, seen in enumerate(recording.observations):
        assert {s.board for s in seen.sightings} == {int(number >= 2)}, "no camera may see both"

    linked = link(recording)

    assert_linked(linked, recording)
    front_from_rear = compose(invert(linked.body_from_board[0]), linked.body_from_board[1])
    np.testing.assert_allclose(front_from_rear, FRONT_FROM_REAR, atol=1e-6)


def test_a_camera_that_sees_both_boards_of_a_body_ties_them() -> None:
    boards = [BACK_TO_BACK[0], replace(BACK_TO_BACK[1], name="side")]
    beside = random_pose(np.random.default_rng(3), 0.3, 0.0)
    beside[:, 3] = [0.5, 0.02, 0.0]
    rng = np.random.default_rng(5)
    cameras = row_of_cameras(3, 0.6)
    poses = {k: held_up(rng, boards[0], (rng.uniform(0.0, 0.9), 0.0, 0.0)) for k in range(10)}
    recording = record(
        boards, cameras, {k: {0: p, 1: p} for k, p in poses.items()}, [np.eye(3, 4), beside]
    )

    linked = link(recording)

    assert_linked(linked, recording)
    relative = compose(invert(linked.body_from_board[0]), linked.body_from_board[1])
    np.testing.assert_allclose(relative, beside, atol=1e-6)
    assert len({view.pose for view in linked.views}) == 10, "one pose of the body an instant"


def test_still_boards_of_different_bodies_link_a_chain() -> None:
    boards = [replace(BOARD, name=name) for name in ("a", "b")]
    rng = np.random.default_rng(2)
    cameras = row_of_cameras(3, 1.1)
    poses = {n: held_up(rng, boards[n], (0.55 + 1.1 * n, 0.0, 0.1 * n)) for n in range(2)}
    recording = record(boards, cameras, {0: poses}, is_still=True)
    assert [len(seen.sightings) for seen in recording.observations] == [1, 2, 1]

    assert_linked(link(recording), recording)


def test_boards_of_one_body_never_seen_together_are_named() -> None:
    cameras = row_of_cameras(2, 0.2)
    rng = np.random.default_rng(1)
    poses = {k: {k % 2: held_up(rng, BOARD, (0.1, 0.0, 0.0))} for k in range(8)}
    recording = record(BACK_TO_BACK, cameras, poses)

    with pytest.raises(CalibrationError, match=r"'front' and board 'rear' of body 'panel'.*never"):
        link(recording)


@settings(max_examples=asked(20))
@given(seed=st.integers(0, 10_000))
def test_two_unknown_poses_are_found_together(seed: int) -> None:
    rng = np.random.default_rng(seed)
    second_from_first, far_from_near = random_pose(rng, 3.0, 2.0), random_pose(rng, 3.0, 0.5)
    first_from_near = [random_pose(rng, 2.5, 1.0) for _ in range(8)]
    second_from_far = [
        compose(compose(second_from_first, pose), invert(far_from_near)) for pose in first_from_near
    ]

    found = solve_joint(np.array(first_from_near), np.array(second_from_far), 1.0)

    assert found is not None
    np.testing.assert_allclose(found[0], second_from_first, atol=1e-8)
    np.testing.assert_allclose(found[1], far_from_near, atol=1e-8)


def test_a_body_turned_about_one_axis_tells_too_little() -> None:
    rng = np.random.default_rng(0)
    second_from_first, far_from_near = random_pose(rng, 3.0, 2.0), random_pose(rng, 3.0, 0.5)
    upright: list[Pose] = []
    for angle in np.linspace(0.0, 2.0, 10):
        cosine, sine = np.cos(angle), np.sin(angle)
        rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        upright.append(np.column_stack([rotation, rng.uniform(-1.0, 1.0, 3)]))
    far = [compose(compose(second_from_first, p), invert(far_from_near)) for p in upright]

    assert solve_joint(np.array(upright), np.array(far), 1.0) is None


# --- Symmetric boards ------------------------------------------------------------------------


@settings(max_examples=asked(8))
@given(seed=st.integers(0, 1000))
def test_frames_tell_which_way_round_a_symmetric_board_was_seen(seed: int) -> None:
    turns = np.random.default_rng(seed).integers(0, 2, (3, 200))
    recording = passing_by(
        3, per_camera=7, seed=seed % 5, board=SYMMETRIC, turns=lambda c, k: int(turns[c, k])
    )
    assert turns.any()

    assert_linked(link(recording, is_labelled=False), recording)


def test_frames_that_do_not_tell_which_way_round_are_refused() -> None:
    pose = held_up(np.random.default_rng(0), SYMMETRIC, (0.1, 0.0, 0.0))
    recording = record([SYMMETRIC], row_of_cameras(2, 0.2), {0: {0: pose}, 1: {0: pose}})

    with pytest.raises(CalibrationError, match=r"'cam1' and 'cam2'.* not tell which way round"):
        link(recording, is_labelled=False)


# --- What cannot be linked, and what is wrong ------------------------------------------------


def test_a_camera_that_cannot_be_linked_is_named_with_what_to_record() -> None:
    rng = np.random.default_rng(0)
    cameras = row_of_cameras(4, 1.3)
    # From camera 1 to 3, and then, 20 frames later, before camera 4 alone.
    places = [*np.linspace(0.0, 2.6, 15), 3.9, 3.9]
    instants = [*range(15), 35, 36]
    poses = {
        k: {0: held_up(rng, BOARD, (x, 0.0, 0.0))} for k, x in zip(instants, places, strict=True)
    }
    recording = record([BOARD], cameras, poses)

    with pytest.raises(CalibrationError) as refused:
        link(recording)

    said = str(refused.value)
    assert "'cam4' never sees the board at the same time as 'cam1' or 'cam2' or 'cam3'" in said
    assert "'cam1', 'cam2', 'cam3'; 'cam4'" in said
    assert "'cam4' and 'cam3'" in said
    assert "21 frames" in said


def test_a_camera_that_sees_nothing_in_the_clip_is_named() -> None:
    recording = passing_by(2)
    blind = replace(recording.observations[1], name="cam9", sightings=())
    lens = replace(recording.lenses[1], views={}, pixels={})
    recording = Recording(
        recording.boards,
        [*recording.lenses, replace(lens, camera=replace(lens.camera, name="cam9"))],
        [*recording.observations, blind],
        recording.cameras,
    )

    with pytest.raises(CalibrationError, match="'cam9' sees no board in the clip"):
        link(recording)


def test_a_view_that_disagrees_is_left_out_and_named() -> None:
    recording = passing_by(3, per_camera=8)
    seen = recording.observations[1]
    image = seen.sightings[3].image
    shift = np.column_stack([np.eye(3), [0.4, 0.0, 0.3]])
    lens = recording.lenses[1]
    pose = compose(shift, lens.views[image, 0])
    pixels = img_from_cam(lens.camera, transform(pose, BOARD.points_board))
    sightings = tuple(replace(s, pixels=pixels) if s.image == image else s for s in seen.sightings)
    spoilt = Recording(
        recording.boards,
        [
            recording.lenses[0],
            replace(
                lens,
                views=lens.views | {(image, 0): pose},
                pixels=lens.pixels | {(image, 0): pixels},
            ),
            recording.lenses[2],
        ],
        [recording.observations[0], replace(seen, sightings=sightings), recording.observations[2]],
        recording.cameras,
    )

    linked = link(spoilt)

    (name,) = linked.left_out
    assert image in name
    assert "px" in linked.left_out[name]


@pytest.mark.parametrize("wrong", [0, 1])
def test_a_tilt_taken_for_the_other_is_put_right_by_the_other_camera(wrong: int) -> None:
    recording = passing_by(2, per_camera=8)
    lens = recording.lenses[wrong]
    shared = {s.image for s in recording.observations[1 - wrong].sightings}
    image = next(image for image, _ in sorted(lens.views) if image in shared)
    pose = lens.views[image, 0]
    # Mirror the board's normal at the ray through its middle: nearly the same image.
    middle = transform(pose, BOARD.center_board[None])[0]
    axis = middle / np.linalg.norm(middle)
    normal = 2.0 * (axis @ pose[:, 2]) * axis - pose[:, 2]
    x = pose[:, 0] - (pose[:, 0] @ normal) * normal
    x /= np.linalg.norm(x)
    rotation = np.column_stack([x, np.cross(normal, x), normal])
    lens.views[image, 0] = np.column_stack([rotation, middle - rotation @ BOARD.center_board])
    assert angle_between(lens.views[image, 0], pose) > 0.2

    linked = link(recording)

    assert_linked(linked, recording)
    assert not linked.left_out


def test_the_same_pictures_under_two_names_are_refused() -> None:
    recording = passing_by(2)
    twin = replace(recording.observations[0], name="cam7")
    lens = replace(recording.lenses[0], camera=replace(recording.lenses[0].camera, name="cam7"))
    doubled = Recording(
        recording.boards,
        [*recording.lenses, lens],
        [*recording.observations, twin],
        [*recording.cameras, recording.cameras[0]],
    )

    with pytest.raises(CalibrationError, match="'cam1' and 'cam7' show the same pictures"):
        link(doubled)


def test_two_cameras_in_one_place_are_a_warning() -> None:
    cameras = row_of_cameras(2, 0.2)
    cameras.append(replace(cameras[0], name="cam7"))
    rng = np.random.default_rng(0)
    poses = {k: {0: held_up(rng, BOARD, (0.1, 0.0, 0.0))} for k in range(10)}
    recording = record([BOARD], cameras, poses, noise_px=0.02)

    linked = link(recording)

    alike, coincide = linked.warnings
    assert "'cam1' and 'cam7' are alike" in alike
    assert "'cam1' and 'cam7' stand in one place" in coincide


@pytest.mark.parametrize("is_still", [True, False])
def test_exchanged_clips_are_named(is_still: bool) -> None:
    cameras = row_of_cameras(3, 0.2)
    lens = np.array([540.0, 318.0, 241.0, -0.25])
    cameras[1] = replace(cameras[1], model="SIMPLE_RADIAL", params=lens)
    rng = np.random.default_rng(0)
    poses = {k: {0: held_up(rng, BOARD, (0.1, -1.2, 0.1))} for k in range(1 if is_still else 8)}
    recording = record([BOARD], cameras, poses, stills=5, is_still=is_still, noise_px=0.05)
    stills = [[s for s in o.sightings if s.instant is None] for o in recording.observations]
    clips = [[s for s in o.sightings if s.instant is not None] for o in recording.observations]
    clips[0], clips[1] = clips[1], clips[0]
    exchanged = Recording(
        recording.boards,
        recording.lenses,
        [
            replace(seen, sightings=(*own, *clip))
            for seen, own, clip in zip(recording.observations, stills, clips, strict=True)
        ],
        recording.cameras,
    )

    with pytest.raises(CalibrationError, match="clips of 'cam1' and 'cam2' seem to be exchanged"):
        link(exchanged)


@pytest.mark.parametrize("board", [BOARD, SYMMETRIC], ids=["odd", "even"])
def test_a_mirrored_picture_is_named(board: Chessboard) -> None:
    recording = passing_by(3, per_camera=8, board=board)
    camera = recording.cameras[2]
    seen, lens = recording.observations[2], recording.lenses[2]
    params = camera.params.copy()
    params[2] = camera.width_px - params[2]
    grid = np.arange(board.columns * board.rows).reshape(board.rows, board.columns)
    listed = grid[:, ::-1].ravel()  # found as a board that faces the camera, as any is

    bare = replace(lens.camera, params=params)
    sightings, views, pixels = [], {}, {}
    for sighting in seen.sightings:
        flipped = (sighting.pixels * [-1.0, 1.0] + [camera.width_px, 0.0])[listed]
        located = locate_board(bare, board.points_board, flipped)
        assert located is not None
        assert located[1] < 1e-6
        sightings.append(replace(sighting, pixels=flipped))
        views[sighting.image, 0], pixels[sighting.image, 0] = located[0], flipped
    mirrored = Recording(
        recording.boards,
        [*recording.lenses[:2], replace(lens, camera=bare, views=views, pixels=pixels)],
        [*recording.observations[:2], replace(seen, sightings=tuple(sightings))],
        recording.cameras,
    )

    with pytest.raises(CalibrationError, match="camera 'cam3': its picture seems to be mirrored"):
        link(mirrored, is_labelled=board is BOARD)


def test_clips_of_different_times_contradict_each_other() -> None:
    recording = passing_by(3, per_camera=8)
    other = passing_by(3, per_camera=8, seed=99)
    mixed = Recording(
        recording.boards,
        [*recording.lenses[:2], other.lenses[2]],
        [*recording.observations[:2], other.observations[2]],
        recording.cameras,
    )

    with pytest.raises(CalibrationError, match="'cam3' contradicts 'cam1', 'cam2'"):
        link(mixed)
