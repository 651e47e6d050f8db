"""What the cameras of a rig see in common, and who looks away."""

import numpy as np
import pytest
from helpers.agreement import random_views
from helpers.hulls import look_at, projection, ring_views
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.hull.agreement.common_view import common_view, facing_away
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, Unseen, Views, make_hull, make_views

WIDTH, HEIGHT = 640, 480


def views_of(
    poses: list[NDArray[np.float64]], unseen: Unseen = "carve", min_cameras: int = 1
) -> Views:
    matrices = np.array([projection(pose, 600.0, WIDTH, HEIGHT) for pose in poses])
    names = tuple(f"cam{number}" for number in range(len(poses)))
    return make_views(
        names, np.array([[WIDTH, HEIGHT]] * len(poses)), matrices, unseen, min_cameras
    )


def ring_poses(n_cameras: int = 4) -> list[NDArray[np.float64]]:
    angles = 2 * np.pi * np.arange(n_cameras) / n_cameras
    return [look_at(np.array([3 * np.cos(a), 3 * np.sin(a), 1.0]), np.zeros(3)) for a in angles]


def turned(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pose of a camera that stands where it stood and looks the other way."""
    return np.diag([-1.0, 1.0, -1.0]) @ pose


def full(views: Views) -> Hull:
    return make_hull(
        views, [np.ones((height, width), np.uint8) for width, height in views.sizes_px]
    )


def test_a_ring_that_looks_inward_has_a_common_view() -> None:
    views = ring_views()
    told = common_view(views)
    assert (told.kind, told.needed, told.facing_away, told.reason) == ("common", 4, (), "")
    assert contains_points(full(views), told.point_world[None]).all()


@pytest.mark.parametrize("guilty", [[0], [1, 3], [0, 1, 2, 3]])
def test_cameras_that_look_away_are_named(guilty: list[int]) -> None:
    poses = ring_poses()
    views = views_of([turned(pose) if k in guilty else pose for k, pose in enumerate(poses)])

    told = common_view(views)

    assert told.kind == "none"
    assert told.facing_away == tuple(f"cam{camera}" for camera in guilty)
    assert "no point of space within 1000 m is seen by 4 cameras: cam" in told.reason
    assert "away from where all optical axes come together" in told.reason


def test_a_pair_that_sees_nothing_in_common_is_named() -> None:
    # Side by side, each turned outward by 60 degrees: the cones, 56 degrees wide, never meet.
    poses = []
    for side in (-1.0, 1.0):
        center = np.array([0.5 * side, 0.0, 0.0])
        outward = np.array([np.sin(np.deg2rad(60)) * side, np.cos(np.deg2rad(60)), 0.0])
        poses.append(look_at(center, center + outward))
    middle = look_at(np.zeros(3), np.array([0.0, 1.0, 0.0]))

    told = common_view(views_of([*poses, middle]))

    assert told.kind == "none"
    assert ("cam0", "cam1") in told.apart


def test_one_camera_sees_something() -> None:
    assert common_view(views_of(ring_poses(1))).kind == "common"


def test_where_enough_others_see_a_camera_may_look_away() -> None:
    poses = ring_poses()
    poses[2] = turned(poses[2])
    assert common_view(views_of(poses, "keep", 3)).kind == "common"
    assert common_view(views_of(poses, "keep", 4)).kind == "none"


def test_parallel_cameras_come_together_nowhere() -> None:
    poses = [look_at(np.array([x, 0.0, 0.0]), np.array([x, 5.0, 0.0])) for x in (0.0, 0.1, 0.2)]
    assert facing_away(views_of(poses)) == ()
    assert common_view(views_of(poses)).kind == "common"


@given(
    seed=st.integers(0, 2**32 - 1),
    n_cameras=st.integers(1, 5),
    unseen=st.sampled_from(["carve", "keep"]),
    spread_m=st.sampled_from([0.0, 2.0, 5.0]),
)
@settings(max_examples=asked(100))
def test_a_common_view_is_found_or_there_is_none(
    seed: int, n_cameras: int, unseen: Unseen, spread_m: float
) -> None:
    rng = np.random.default_rng(seed)
    min_cameras = int(rng.integers(1, n_cameras + 1))
    views = random_views(rng, n_cameras, unseen, min_cameras, spread_m)

    told = common_view(views)

    hull = full(views)
    if told.kind == "common":
        assert contains_points(hull, told.point_world[None]).all()
    else:
        scales_m = rng.choice([1.0, 5.0, 50.0], (20_000, 1))
        assert (
            told.kind == "open"
            or not contains_points(hull, scales_m * rng.uniform(-1.0, 1.0, (20_000, 3))).any()
        )
