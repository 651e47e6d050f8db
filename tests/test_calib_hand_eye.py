"""A camera's place on its tracker: found exactly without noise, honestly with it, or refused."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.boards import look_at, make_camera, project
from helpers.thorough import asked, some_of
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.boards.board import Sighting
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.errors import CalibrationError
from hybridve.calib.placing.hand_eye import PARAMETERS, mount_camera
from hybridve.calib.placing.mount_fit import solve_hand_eye
from hybridve.calib.pose import Pose, angle_between, compose, invert
from hybridve.calib.record import MountRecord
from hybridve.calib.rig import Mount

BOARD = Chessboard(8, 5, 0.1)
CAMERA = make_camera("head", "OPENCV", np.eye(3, 4))


def turn(vector: Any) -> NDArray[np.float64]:
    return np.asarray(cv2.Rodrigues(np.asarray(vector, np.float64))[0], np.float64)


def some_pose(rng: np.random.Generator, reach_m: float) -> Pose:
    return np.column_stack([turn(rng.uniform(-1.5, 1.5, 3)), rng.uniform(-reach_m, reach_m, 3)])


class Walk:
    """A tracked camera that looked at a board on the floor from many places, and its truth."""

    def __init__(
        self,
        seed: int,
        n_instants: int = 25,
        *,
        noise_px: float = 0.0,
        tracker_rad: float = 0.0,
        tracker_m: float = 0.0,
        looks: int = 0,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.mount = Mount(some_pose(rng, 0.1), some_pose(rng, 2.0))
        self.cam_from_world: list[Pose] = []
        self.tracked: dict[int, Pose] = {}
        self.sightings: list[Sighting] = []
        for instant in range(n_instants):
            middle = np.add(BOARD.center_board, (*rng.uniform(-0.1, 0.1, 2), 0.0))
            center = np.add(BOARD.center_board, (*rng.uniform(-0.7, 0.7, 2), rng.uniform(1, 1.6)))
            pose = look_at(tuple(center), tuple(middle), rng.uniform(-40, 40))
            pixels = project(CAMERA, pose, BOARD)
            pixels = pixels + rng.normal(0.0, noise_px, pixels.shape) if noise_px else pixels
            if instant < looks:
                pixels = pixels[BOARD.looks[1]]
            shake = np.column_stack(
                [turn(rng.normal(size=3) * tracker_rad), rng.normal(size=3) * tracker_m]
            )
            self.cam_from_world.append(pose)
            self.tracked[instant] = compose(self.tracker_of(pose), shake)
            self.sightings.append(Sighting(f"{instant}.png", instant, 0, pixels))

    def tracker_of(self, cam_from_world: Pose) -> Pose:
        """Return tracking_from_tracker while the camera is there."""
        tracking_from_world = invert(self.mount.world_from_tracking)
        world_from_tracker = compose(invert(cam_from_world), self.mount.cam_from_tracker)
        return compose(tracking_from_world, world_from_tracker)

    def solved(self, **changes: Any) -> tuple[Mount, MountRecord]:
        said: dict[str, Any] = {"sightings": self.sightings, "tracked": self.tracked, **changes}
        return mount_camera(CAMERA, [BOARD], said["sightings"], said["tracked"])

    def errors(self, mount: Mount) -> NDArray[np.float64]:
        """Return true minus found, (12,), in the order of the covariance."""
        parts = []
        for true, found in (
            (self.mount.cam_from_tracker, mount.cam_from_tracker),
            (self.mount.world_from_tracking, mount.world_from_tracking),
        ):
            parts.append(cv2.Rodrigues(true[:, :3] @ found[:, :3].T)[0].ravel())
            parts.append(true[:, 3] - found[:, 3])
        return np.concatenate(parts)


def apart(first: Mount, second: Mount) -> float:
    """Return the largest angle (rad) or distance (m) between two mounts."""
    pairs = [
        (first.cam_from_tracker, second.cam_from_tracker),
        (first.world_from_tracking, second.world_from_tracking),
    ]
    return max(max(angle_between(a, b), float(np.linalg.norm(a[:, 3] - b[:, 3]))) for a, b in pairs)


@settings(max_examples=asked(40))
@given(seed=st.integers(0, 2**32 - 1), n_instants=st.integers(5, 30))
def test_random_motions_give_the_mount_back_in_closed_form(seed: int, n_instants: int) -> None:
    rng = np.random.default_rng(seed)
    mount = Mount(some_pose(rng, 0.2), some_pose(rng, 3.0))
    trackers = [some_pose(rng, 2.0) for _ in range(n_instants)]
    cameras = [mount.cam_from_world(pose) for pose in trackers]
    millimetres = [pose * [1.0, 1.0, 1.0, 1000.0] for pose in trackers]

    found = solve_hand_eye(cameras, trackers)
    scaled = solve_hand_eye(cameras, millimetres, free_scale=True)

    assert apart(found.mount, mount) < 1e-8
    assert found.scale == 1.0
    assert scaled.scale == pytest.approx(1e-3, rel=1e-9)
    assert apart(scaled.mount, mount) < 1e-8


def test_fewer_than_three_pairs_are_a_mistake() -> None:
    with pytest.raises(ValueError, match="3 or more"):
        solve_hand_eye([np.eye(3, 4)] * 2, [np.eye(3, 4)] * 2)


@pytest.mark.parametrize("seed", range(4))
def test_boards_seen_without_noise_give_the_mount_back(seed: int) -> None:
    walk = Walk(seed)

    mount, about = walk.solved()

    assert apart(mount, walk.mount) < 1e-9
    assert about.views == about.instants == 25
    assert about.middle_instant == 12
    assert about.rms_px < 1e-8
    assert about.tracker_scale == pytest.approx(1.0, abs=1e-9)
    assert np.abs(about.covariance).max() < 1e-18


def test_a_board_elsewhere_moves_the_trackers_world_and_not_the_offset() -> None:
    walk = Walk(0)
    world_from_board = some_pose(np.random.default_rng(5), 1.0)

    mount, _ = mount_camera(CAMERA, [BOARD], walk.sightings, walk.tracked, {0: world_from_board})

    moved = compose(world_from_board, walk.mount.world_from_tracking)
    assert apart(mount, Mount(walk.mount.cam_from_tracker, moved)) < 1e-9


def test_two_boards_in_one_world_are_used_together_and_a_third_unknown_one_is_not() -> None:
    walk = Walk(1, 12)
    rng = np.random.default_rng(2)
    places = {0: np.eye(3, 4), 1: np.column_stack([turn([0.2, 0.1, 0.4]), [0.3, -0.2, 0.1]])}
    sightings = [
        Sighting(
            f"{instant}.png",
            instant,
            instant % 2,
            project(CAMERA, compose(pose, places[instant % 2]), BOARD),
        )
        for instant, pose in enumerate(walk.cam_from_world)
    ]
    lost = Sighting("lost.png", 0, 2, rng.uniform(0, 400, (len(BOARD.points_board), 2)))

    mount, about = mount_camera(CAMERA, [BOARD] * 3, [*sightings, lost], walk.tracked, places)

    assert apart(mount, walk.mount) < 1e-9
    assert about.views == 12


def test_the_order_of_pictures_does_not_matter() -> None:
    walk = Walk(3, noise_px=0.3, tracker_rad=0.002, tracker_m=0.001)
    order = np.random.default_rng(0).permutation(len(walk.sightings))

    first, about = walk.solved()
    second, again = walk.solved(
        sightings=[walk.sightings[k] for k in order],
        tracked={int(k): walk.tracked[int(k)] for k in order},
    )

    assert apart(first, second) == 0.0
    assert about == again


@pytest.mark.slow
@pytest.mark.parametrize(
    "noise",
    some_of(
        [
            pytest.param({"noise_px": 0.3}, id="corners"),
            pytest.param({"tracker_rad": 0.003, "tracker_m": 0.002, "noise_px": 0.1}, id="tracker"),
        ]
    ),
)
def test_errors_are_as_large_as_the_covariance_says(noise: dict[str, Any]) -> None:
    squares, pose_squares = [], []
    for seed in range(16):
        walk = Walk(seed, **noise)

        mount, about = walk.solved()

        assert about.parameters == PARAMETERS
        squares.append(walk.errors(mount) ** 2 / np.diag(about.covariance))
        for instant, true in enumerate(walk.cam_from_world):
            found = mount.cam_from_world(walk.tracked[instant])
            error = np.append(
                cv2.Rodrigues(true[:, :3] @ found[:, :3].T)[0], true[:, 3] - found[:, 3]
            )
            pose_squares.append(error**2 / np.diag(about.pose_covariance))
    # 16 runs of 12 numbers that hang together: a mean square of 1 within about a half.
    assert 0.5 < float(np.mean(squares)) < 1.6
    # What corners add to a frame's own pose is subtracted, but not below zero.
    assert 0.15 < float(np.mean(pose_squares)) < 1.4


def test_wrong_poses_and_turned_over_boards_are_dropped_and_told() -> None:
    walk = Walk(4, noise_px=0.2)
    wrong = {**walk.tracked}
    for instant in (3, 11, 17, 18):
        wrong[instant] = compose(wrong[instant], some_pose(np.random.default_rng(instant), 0.5))
    without = [one for one in walk.sightings if one.instant not in (3, 11, 17, 18)]

    mount, about = walk.solved(tracked=wrong)
    expected, _ = walk.solved(sightings=without)

    assert sorted(about.dropped) == ["11.png", "17.png", "18.png", "3.png"]
    assert apart(mount, expected) < 1e-9


def test_corners_that_were_not_seen_do_not_count() -> None:
    walk = Walk(5)
    seen = []
    for number, one in enumerate(walk.sightings):
        pixels = one.pixels.copy()
        pixels[number % 3 :: 3] = np.nan
        seen.append(replace(one, pixels=pixels))
    seen[0].pixels[3:] = np.nan

    mount, about = walk.solved(sightings=seen)

    assert apart(mount, walk.mount) < 1e-9
    assert about.dropped == {"0.png": "the board cannot be located"}


def test_a_board_listed_the_other_way_round_is_listed_as_most_are() -> None:
    symmetric = Chessboard(8, 6, 0.1)
    assert len(symmetric.looks) == 2
    walk = Walk(6)
    sightings = [
        Sighting(
            one.image,
            one.instant,
            0,
            project(CAMERA, pose, symmetric)[symmetric.looks[int(number % 3 == 1)]],
        )
        for number, (one, pose) in enumerate(zip(walk.sightings, walk.cam_from_world, strict=True))
    ]

    mount, about = mount_camera(CAMERA, [symmetric], sightings, walk.tracked)

    assert about.looks_turned == 8
    assert about.dropped == {}
    assert apart(mount, walk.mount) < 1e-9


def refused(walk: Walk, **changes: Any) -> str:
    with pytest.raises(CalibrationError) as error:
        walk.solved(**changes)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith("camera 'head': ")
    return str(error.value)


def test_too_few_instants_are_refused() -> None:
    walk = Walk(0)

    said = refused(walk, tracked={k: walk.tracked[k] for k in (0, 1)})

    assert "2 instants with both a board and a tracked pose (23 more without" in said
    assert "0 instants" in refused(walk, tracked={})


def moved(walk: Walk, trackers: list[Pose]) -> dict[str, Any]:
    """Return what the camera sees from where it is when its tracker is there."""
    sightings, tracked = [], {}
    for instant, pose in enumerate(trackers):
        cam_from_world = walk.mount.cam_from_world(pose)
        pixels = project(CAMERA, cam_from_world, BOARD)
        sightings.append(Sighting(f"{instant}.png", instant, 0, pixels))
        tracked[instant] = pose
    return {"sightings": sightings, "tracked": tracked}


def test_a_tracker_that_only_moves_straight_is_refused() -> None:
    walk = Walk(0)
    start = walk.tracked[0]
    rng = np.random.default_rng(0)
    trackers = [
        np.column_stack([start[:, :3], start[:, 3] + rng.uniform(-0.1, 0.1, 3)]) for _ in range(20)
    ]

    assert "its tracker only moved straight (0.0 degrees" in refused(walk, **moved(walk, trackers))
    assert "its tracker stood still" in refused(walk, **moved(walk, [start] * 20))


def test_a_tracker_that_turns_about_one_axis_is_refused_and_the_axis_named() -> None:
    walk = Walk(0)
    axis = np.array([0.0, 0.6, 0.8])
    rng = np.random.default_rng(0)
    trackers = [
        np.column_stack(
            [
                walk.tracked[0][:, :3] @ turn(angle * axis),
                walk.tracked[0][:, 3] + rng.uniform(-0.05, 0.05, 3),
            ]
        )
        for angle in np.linspace(-0.3, 0.3, 20)
    ]

    said = refused(walk, **moved(walk, trackers))

    assert "turned about one axis only, (0.00, 0.60, 0.80) of its own frame" in said
    assert "offset along that axis cannot be found" in said


def test_a_stuck_tracker_is_refused_and_a_stuck_spell_left_out() -> None:
    walk = Walk(0)
    spell = {k: walk.tracked[min(k, 10) if k < 15 else k] for k in walk.tracked}

    mount, about = walk.solved(tracked=spell)

    assert "its tracker is stuck" in refused(
        walk, tracked=dict.fromkeys(walk.tracked, walk.tracked[0])
    )
    assert apart(mount, walk.mount) < 1e-9
    assert about.dropped == {
        f"{k}.png": "the tracker reports the pose of instant 10 again" for k in (11, 12, 13, 14)
    }


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (1000.0, "they look like millimetres"),
        (100.0, "centimetres"),
        (39.3701, "inches"),
        (1.1, "by 0.9"),
    ],
)
def test_a_tracker_in_another_unit_is_refused_and_the_unit_named(factor: float, said: str) -> None:
    walk = Walk(0, noise_px=0.3, tracker_m=0.001)
    tracked = {k: pose * [1.0, 1.0, 1.0, factor] for k, pose in walk.tracked.items()}

    assert said in refused(walk, tracked=tracked)


@pytest.mark.slow
def test_inverted_poses_and_those_of_other_instants_are_refused() -> None:
    walk = Walk(0, noise_px=0.3)
    inverted = {k: invert(pose) for k, pose in walk.tracked.items()}
    late = {k: walk.tracked[(k + 1) % 25] for k in walk.tracked}

    assert "its poses are inverted" in refused(walk, tracked=inverted)
    assert "do not belong together" in refused(walk, tracked=late)
