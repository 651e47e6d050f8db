"""Blocked shifts in closed form: a ball's hull, boxes moved along the normals of their faces."""

import numpy as np
import pytest
from helpers.hulls import ball_hull, ring_views
from numpy.typing import NDArray

from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.contact.spacing import (
    METER_SHARE,
    Move,
    MovedObject,
    blocked_shifts,
    covers,
    tightest_at,
    verdict_at,
)
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, Views
from hybridve.hull.synth.meshes import box_mesh

RADIUS_M = 0.2

#: A pixel where the ball is: some 3.2 m away, with a focal length of 2100 px.
PIXEL_M = 3.3 / 2100.0


@pytest.fixture(scope="module")
def views() -> Views:
    return ring_views(6, 1800, 1200, 2100.0)


@pytest.fixture(scope="module")
def ball(views: Views) -> Hull:
    return ball_hull(views, np.zeros(3), RADIUS_M)


@pytest.fixture(scope="module")
def side(views: Views) -> NDArray[np.float64]:
    """A horizontal direction in which the hull ends where the ball does.

    The plane that touches the ball there goes through a camera, whose silhouette cuts along it.
    """
    matrix = views.img_from_local[0]
    camera = views.origin_world - np.linalg.solve(matrix[:, :3], matrix[:, 3])
    angle = np.arctan2(camera[1], camera[0]) - np.arccos(RADIUS_M / np.hypot(*camera[:2]))
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def slab(
    normal: NDArray[np.float64],
    begin_m: float,
    thick_m: float,
    clearance_m: float,
    move: Move,
    *,
    is_closed: bool = True,
) -> MovedObject:
    """A large box with faces across a horizontal normal, from `begin_m` on along it."""
    mesh = box_mesh((1000 * thick_m, 2000.0, 2000.0), 2000.0)
    rotation = np.column_stack([normal, np.cross([0, 0, 1.0], normal), [0, 0, 1.0]])
    vertices = (mesh.vertices_mm / 1000 + [begin_m + thick_m / 2, 0, 0]) @ rotation.T
    tolerance_m = METER_SHARE * move.tolerance_m
    faces = mesh.faces.astype(np.int32)
    meter = ClearanceMeter(vertices, faces, is_closed=is_closed, tolerance_m=tolerance_m)
    return MovedObject(meter, clearance_m)


@pytest.mark.slow
@pytest.mark.parametrize("clearance_m", [0.0, 0.005, 0.1])
@pytest.mark.parametrize("is_closed", [True, False])
@pytest.mark.parametrize("begin_m", [0.0, -0.07])
def test_a_wall_must_go_as_far_as_the_ball_reaches_and_the_clearance(
    ball: Hull, side: NDArray[np.float64], clearance_m: float, begin_m: float, is_closed: bool
) -> None:
    move = Move(side, -0.1, 0.6, 1e-3)
    wall = slab(side, begin_m, 2.0, clearance_m, move, is_closed=is_closed)

    blocked = blocked_shifts(ball, [wall], move)

    needed_m = RADIUS_M + clearance_m - begin_m
    ((begins, ends),) = blocked.violated_m
    assert begins == move.start_m
    assert ends == pytest.approx(needed_m, abs=PIXEL_M)
    assert np.ptp(blocked.undecided_m, axis=1).sum() <= 0.5e-3
    assert not covers(blocked.undecided_m, np.array([needed_m + PIXEL_M + 0.5e-3])).any()


@pytest.mark.slow
def test_a_thin_plate_blocks_all_the_way_through_the_ball_after_few_measurements(
    ball: Hull, side: NDArray[np.float64]
) -> None:
    """Two millimetres thick, so that no point of the hull is deeper in it than one."""
    move = Move(side, -0.5, 0.5, 1e-3)

    blocked = blocked_shifts(ball, [slab(side, 0.0, 0.002, 0.0, move)], move)

    ((begins, ends),) = blocked.violated_m
    assert ends == pytest.approx(RADIUS_M, abs=PIXEL_M)
    assert -0.3 < begins < -RADIUS_M + PIXEL_M - 0.002
    assert blocked.n_measured < 40


def test_what_is_wholly_inside_an_object_violates_it_though_nothing_crosses_the_surface(
    ball: Hull, side: NDArray[np.float64]
) -> None:
    move = Move(side, -0.2, 0.2, 1e-3)
    solid = slab(side, -0.6, 1.2, 0.0, move)
    shell = slab(side, -0.6, 1.2, 0.0, move, is_closed=False)

    assert blocked_shifts(ball, [solid], move).violated_m.tolist() == [[-0.2, 0.2]]
    assert len(blocked_shifts(ball, [shell], move).violated_m) == 0
    assert verdict_at(ball, solid, move, 0.0) == "violates"
    assert verdict_at(ball, shell, move, 0.0) == "keeps"


@pytest.mark.slow
def test_nothing_is_blocked_far_away_or_where_nothing_is_real(
    ball: Hull, views: Views, side: NDArray[np.float64]
) -> None:
    move = Move(side, 0.0, 1.0, 1e-3)
    nobody = ball_hull(views, np.array([50.0, 0, 0]), 0.1)

    for hull, begin_m in ((ball, 2.0), (nobody, 0.0)):
        blocked = blocked_shifts(hull, [slab(side, begin_m, 0.1, 0.01, move)], move)
        assert len(blocked.violated_m) == len(blocked.undecided_m) == 0
        assert blocked.n_measured == 1


def test_of_a_group_the_one_that_must_go_farthest_decides(
    ball: Hull, side: NDArray[np.float64]
) -> None:
    move = Move(side, 0.0, 0.6, 1e-3)
    near, far = (slab(side, begin_m, 1.0, 0.01, move) for begin_m in (0.0, 0.1))

    ((_, ends),) = blocked_shifts(ball, [far, near], move).violated_m

    assert ends == pytest.approx(RADIUS_M + 0.01, abs=PIXEL_M)
    number, clearance = tightest_at(ball, [far, near], move, 0.4)
    assert number == 1
    assert clearance.lower_m <= 0.2 + PIXEL_M
    assert clearance.upper_m >= 0.2 - PIXEL_M
    assert contains_points(ball, clearance.on_hull_world[None])[0]
    assert clearance.on_object_world @ side == pytest.approx(0.4)


@pytest.mark.parametrize("shift_m", [0.1, 0.19, 0.22, 0.5])
def test_a_verdict_is_that_of_the_stretches(
    ball: Hull, side: NDArray[np.float64], shift_m: float
) -> None:
    move = Move(side, 0.0, 0.6, 1e-3)
    wall = slab(side, 0.0, 1.0, 0.0, move)

    verdict = verdict_at(ball, wall, move, shift_m)

    assert verdict == ("violates" if shift_m < RADIUS_M else "keeps")


@pytest.mark.parametrize(
    ("start_m", "stop_m", "tolerance_m", "message"),
    [
        (0.1, 0.1, 1e-3, "holds no shift"),
        (0.2, 0.1, 1e-3, "holds no shift"),
        (0.0, np.inf, 1e-3, "holds no shift"),
        (0.0, 1.0, 0.0, "expected more than 0"),
    ],
)
def test_a_range_without_shifts_is_refused(
    start_m: float, stop_m: float, tolerance_m: float, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Move(np.array([1.0, 0, 0]), start_m, stop_m, tolerance_m)
