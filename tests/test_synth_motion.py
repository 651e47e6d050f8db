"""When contacts begin and how much room a task needs, against closed forms."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridve.calib.pose import Pose
from hybridve.hull.synth.closest import TOLERANCE_M, closest_on_surface
from hybridve.hull.synth.cones import RESOLUTION_M, TrueHull
from hybridve.hull.synth.entries import Entry, Motion
from hybridve.hull.synth.meshes import box_mesh
from hybridve.hull.synth.presets import PRESETS, ball, payload
from hybridve.hull.synth.presets.hands import SKIN
from hybridve.hull.synth.shapes import Ball, Box
from hybridve.hull.synth.spacing import (
    SHORTFALL_M,
    Needed,
    needed_for_hulls,
    needed_for_shapes,
)
from hybridve.hull.synth.stage import Actor, CadPart, RealShape, Stage, pose_at

BOXES = PRESETS["boxes"].make_stage()

#: A cube of 20 cm about the origin of the world: its face towards a thing at x > 0 lies at 0.1.
CUBE = CadPart("cube", box_mesh((200.0, 200.0, 200.0), 50.0), (0.0, 0.0, 0.0))

RADIUS_M = 0.03

#: The payload's moments at which the room is decided: the pipe above the shaft, the tip of the cord
#: above the pipe, and some in which there is room enough.
DECISIVE = (0.31, 0.66, 0.68, 0.78)


def moving_ball(x_at: Callable[[float], float]) -> Stage:
    """A ball that moves along x, which it does in front of the cube's face."""
    shape = RealShape("ball", Ball(RADIUS_M), pose_at((0.0, 0.0, 0.0)), SKIN)
    actor = Actor((shape,), lambda moment: pose_at((x_at(moment), 0.01, 0.02)))
    return replace(BOXES, actors=(actor,), parts=(CUBE,))


def entries_of(stage: Stage, n_frames: int) -> list[Entry]:
    triangles = stage.parts[0].triangles_world
    shapes = [real.shape for real in stage.shapes]
    at_frames = [
        closest_on_surface(triangles, shapes, stage.poses(moment))
        for moment in np.linspace(0.0, 1.0, n_frames)
    ]
    return Motion(stage, n_frames).entries(triangles, at_frames)


@pytest.mark.parametrize("n_frames", [2, 7, 48])
def test_a_ball_that_moves_evenly_touches_when_the_way_is_used_up(n_frames: int) -> None:
    start_m, speed_m = 0.35, 0.4

    (entry,) = entries_of(moving_ball(lambda moment: start_m - speed_m * moment), n_frames)

    expected = (start_m - RADIUS_M - 0.1) / speed_m
    assert entry.moment == pytest.approx(expected, abs=1e-7)
    np.testing.assert_allclose(entry.point_world, [0.1, 0.01, 0.02], atol=1e-4)


def test_each_entry_is_found_and_leaving_is_none() -> None:
    # In and out four times between two frames; it rests inside at neither.
    def x_at(moment: float) -> float:
        return float(0.1 + RADIUS_M + 0.02 * np.cos(8.0 * np.pi * moment) + 0.01)

    entries = entries_of(moving_ball(x_at), 2)

    # cos passes -1/2, going down, at 1/3 and again each turn; a turn takes a quarter.
    expected = [(k + 1 / 3) / 4 for k in range(4)]
    np.testing.assert_allclose([entry.moment for entry in entries], expected, atol=1e-6)


def test_what_touches_from_the_beginning_or_never_has_no_entry() -> None:
    assert entries_of(moving_ball(lambda moment: 0.1 + 0.01 * moment), 5) == []
    assert entries_of(moving_ball(lambda moment: 0.2 + 0.3 * moment), 5) == []
    assert entries_of(moving_ball(lambda moment: 0.2 - 0.15 * moment), 1) == []


def test_a_thing_far_away_may_move_as_it_likes() -> None:
    def poses(moment: float) -> Pose:
        return pose_at((3.0 * np.cos(90.0 * moment), 3.0 * np.sin(90.0 * moment), 2.0))

    stage = moving_ball(lambda moment: 0.35 - 0.4 * moment)
    shape = RealShape("box", Box(0.1, 0.1, 0.1), pose_at((0.0, 0.0, 0.0)), SKIN)

    (entry,) = entries_of(replace(stage, actors=(*stage.actors, Actor((shape,), poses))), 4)

    assert entry.moment == pytest.approx((0.35 - RADIUS_M - 0.1) / 0.4, abs=1e-7)


@pytest.mark.slow
def test_the_pushed_block_meets_the_virtual_ball_when_its_eased_way_says() -> None:
    stage = PRESETS["ball"].make_stage()

    entries = entries_of(stage, 5)

    # It has gone 1 - push / way of its way, eased by half a cosine.
    gone = 1.0 - ball._PUSH_M / ball._WAY_M
    expected = ball._START + (ball._DEEPEST - ball._START) * np.arccos(1 - 2 * gone) / np.pi
    assert entries[0].moment == pytest.approx(expected, abs=1e-6)
    x, y, z = ball._CENTER
    np.testing.assert_allclose(entries[0].point_world, [x, y - ball._RADIUS_M, z], atol=1e-4)
    assert len(entries) == 2  # and the block set down on it from above
    assert entries[1].point_world[2] > z + 0.9 * ball._RADIUS_M


def needed(
    heights_m: tuple[float, ...], along: tuple[float, float, float], required_m: float
) -> Needed:
    """The room that balls at these heights above the middle of the cube need."""
    direction = np.array(along) / np.linalg.norm(along)
    return needed_for_shapes(
        CUBE.triangles_world,
        direction,
        (0.0, 0.5),
        required_m,
        [Ball(RADIUS_M)],
        [[pose_at((0.0, 0.0, height_m))] for height_m in heights_m],
    )


def test_a_face_gives_way_by_what_is_lacking() -> None:
    # The gaps to the ball are 0.05, 0.01 and -0.02; 0.025 are required.
    found = needed((0.18, 0.14, 0.11), (0.0, 0.0, -1.0), 0.025)

    np.testing.assert_allclose(found.by_frame_m, [0.0, 0.015, 0.045], atol=SHORTFALL_M)
    assert found.shift_m == pytest.approx(0.045, abs=SHORTFALL_M)
    assert found.frame == 2


def test_aslant_it_takes_longer_by_the_cosine() -> None:
    found = needed((0.14,), (0.6, 0.0, -0.8), 0.025)

    assert found.shift_m == pytest.approx(0.015 / 0.8, abs=5 * SHORTFALL_M)


def test_a_frame_that_clashes_only_farther_away_is_asked_again() -> None:
    # Moving down from the first ball, the cube runs into the second, and must go past it.
    found = needed((0.12, -0.14), (0.0, 0.0, -1.0), 0.005)

    # On the way that ball is wholly inside the cube, far from its surface: that is no room.
    np.testing.assert_allclose(found.by_frame_m, [0.015, 0.0], atol=SHORTFALL_M)
    assert found.frame == 1
    assert found.shift_m == pytest.approx(0.14 + 0.1 + RADIUS_M + 0.005, abs=2 * SHORTFALL_M)


def test_a_range_without_room_is_said_to_be_one() -> None:
    crowded = needed_for_shapes(
        CUBE.triangles_world,
        np.array([0.0, 0.0, -1.0]),
        (0.0, 0.01),
        0.025,
        [Ball(RADIUS_M)],
        [[pose_at((0.0, 0.0, 0.14))]],
    )
    assert crowded.shift_m == np.inf


def payload_room(participant: int, gap_mm: float = 150.0) -> tuple[Stage, Needed, Needed]:
    stage = PRESETS["payload"].make_stage(participant=participant, gap_mm=gap_mm)
    (asked,) = stage.spacings
    part = next(part for part in stage.parts if part.name == asked.part)
    frames = [stage.poses(moment) for moment in DECISIVE]
    shapes = [real.shape for real in stage.shapes]
    question = (
        part.triangles_world,
        np.array(asked.along),
        asked.range_m,
        part.required_clearance_mm / 1000.0,
    )
    by_shapes = needed_for_shapes(*question, shapes, frames)
    hulls = [TrueHull(stage.cameras, shapes, poses) for poses in frames]
    return stage, by_shapes, needed_for_hulls(*question, hulls, by_shapes)


@pytest.fixture(scope="module")
def rooms() -> dict[int, tuple[Stage, Needed, Needed]]:
    return {participant: payload_room(participant) for participant in (1, 2, 3, 4)}


@pytest.mark.slow
def test_the_room_is_that_of_the_pipe_and_with_a_tool_that_of_the_tongs_on_end(
    rooms: dict[int, tuple[Stage, Needed, Needed]],
) -> None:
    for participant, (stage, by_shapes, _) in rooms.items():
        pipe_air_m, lift_m, _ = payload._PARTICIPANTS[participant]
        highest_m = payload._TOP_M + pipe_air_m + payload._PIPE_M
        if participant > 1:
            tongs = payload._TONGS_M + payload._HINGE_RADIUS_M
            highest_m = max(highest_m, payload._RIM_M + lift_m + tongs)
        gap_m = stage.spacings[0].gap_m + by_shapes.shift_m
        assert gap_m == pytest.approx(highest_m + 0.005 - payload._TOP_M, abs=2 * SHORTFALL_M)
        assert DECISIVE[by_shapes.frame] == (0.31 if participant == 1 else 0.68)


@pytest.mark.slow
def test_participants_with_the_tool_need_more_room_as_in_the_papers_table(
    rooms: dict[int, tuple[Stage, Needed, Needed]],
) -> None:
    gaps_cm = {
        participant: 100 * (stage.spacings[0].gap_m + by_shapes.shift_m)
        for participant, (stage, by_shapes, _) in rooms.items()
    }
    paper = {1: 15.0, 2: 22.5, 3: 22.3, 4: 23.0}  # table 1, "actual space required"
    assert gaps_cm == pytest.approx(paper, abs=0.01)


@pytest.mark.slow
def test_the_hull_needs_more_room_than_the_shapes_but_level_cameras_keep_it_near(
    rooms: dict[int, tuple[Stage, Needed, Needed]],
) -> None:
    for _, by_shapes, by_hull in rooms.values():
        assert (by_hull.by_frame_m >= by_shapes.by_frame_m).all()
        assert by_shapes.shift_m <= by_hull.shift_m < by_shapes.shift_m + 0.006


@pytest.mark.slow
def test_at_the_room_needed_all_keeps_its_distance_and_with_less_it_does_not() -> None:
    stage, by_shapes, by_hull = payload_room(2, gap_mm=180.0)
    part = stage.parts[1]
    shapes = [real.shape for real in stage.shapes]
    required_m = part.required_clearance_mm / 1000.0

    def nearest_m(shift_m: float) -> list[float]:
        moved = part.triangles_world + shift_m * np.eye(3)[2]
        return [
            closest_on_surface(moved, shapes, stage.poses(moment)).distance_m for moment in DECISIVE
        ]

    enough, short = nearest_m(by_shapes.shift_m), nearest_m(by_shapes.shift_m - 1e-4)

    assert min(enough) >= required_m - SHORTFALL_M - TOLERANCE_M
    assert short[by_shapes.frame] < required_m - 5e-5
    hull = TrueHull(stage.cameras, shapes, stage.poses(DECISIVE[by_hull.frame]))
    surfaces = [points_of(part, by_hull.shift_m - less_m) for less_m in (-RESOLUTION_M, 5e-4)]
    is_short = [hull.contains(near).any() for near in surfaces]
    assert is_short == [False, True]


def points_of(part: CadPart, shift_m: float) -> NDArray[np.float64]:
    """Points just within the required clearance below the part's lower face."""
    x, y = np.meshgrid(np.linspace(-0.12, 0.12, 241), np.linspace(-0.1, 0.1, 201))
    place = np.array(part.translate_mm) / 1000.0
    lower_m = place[2] - 0.08 + shift_m
    height_m = lower_m - part.required_clearance_mm / 1000.0
    return np.column_stack([x.ravel() + place[0], y.ravel() + place[1], np.full(x.size, height_m)])


#: What belongs together, by the beginning of its name, in the presets with hands.
THINGS = {"green": "left", "yellow": "right", "tongs": "right", "plug": "right"}


@pytest.mark.parametrize(
    ("preset", "options", "held"),
    [
        ("ball", {}, []),
        # The cord goes down the pipe, with the fingers above it or in the tongs, which enter too.
        (
            "payload",
            {"participant": 1, "gap_mm": 150.0},
            [{"cord", "pipe"}, {"cord", "right"}],
        ),
        (
            "payload",
            {"participant": 4, "gap_mm": 150.0},
            [{"cord", "pipe"}, {"cord", "right"}, {"pipe", "right"}],
        ),
    ],
)
def test_hands_do_not_run_through_what_they_do_not_hold(
    preset: str, options: dict[str, float], held: list[set[str]]
) -> None:
    stage = PRESETS[preset].make_stage(**options)
    give_m = 0.004  # fingers about the pipe
    for moment in np.linspace(0.0, 1.0, 25):
        poses = stage.poses(float(moment))
        for real, pose in zip(stage.shapes, poses, strict=True):
            outline = real.shape.outline() @ pose[:, :3].T + pose[:, 3]
            for other, other_pose in zip(stage.shapes, poses, strict=True):
                first, second = (
                    THINGS.get(name.split("_")[0], name.split("_")[0])
                    for name in (real.name, other.name)
                )
                apart_m = np.linalg.norm(pose[:, 3] - other_pose[:, 3])
                if first == second or apart_m > real.shape.reach_m + other.shape.reach_m:
                    continue
                if {first, second} in held:
                    continue
                local = (outline - other_pose[:, 3]) @ other_pose[:, :3]
                depth_m = -other.shape.signed_distance(local)[0].min()
                assert depth_m < give_m, (moment, real.name, other.name)
