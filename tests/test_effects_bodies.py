"""Rigid and hinged bodies against closed forms, and where it is hard."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers.effect_bodies import (
    BOX_FACES,
    STEP_S,
    Stage,
    ball,
    box,
    box_hull,
    empty_hull,
    far_views,
    joined_hull,
    level_views,
    scene_object,
    stage,
)
from helpers.hulls import sphere_mesh
from helpers.response import angle_deg, ball_exits, ball_silhouettes
from helpers.thorough import THOROUGH
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError
from hybridve.hull.effects.body_shape import collision_shape, mass_share
from hybridve.hull.effects.body_solver import SLOP_M
from hybridve.hull.effects.effect import GRAVITY_M_S2, UnstableError
from hybridve.hull.effects.hull_contacts import (
    Arc,
    Patch,
    contact_of,
    find_patches,
    followed,
)
from hybridve.hull.query.engine import Triangles
from hybridve.hull.query.native import Native
from hybridve.hull.query.silhouettes import Hull, Views, make_hull

#: Half a pixel of `far_views`, and what perspective adds within 0.1 m of their middle.
PIXEL_M = 0.00025 + 0.00007


@cache
def far() -> Views:
    return far_views()


@cache
def floor() -> Hull:
    """A block below z = 0."""
    return box_hull(far(), [0.15, 0.15, 0.08], [0, 0, -0.08])


@cache
def nothing() -> Hull:
    return empty_hull(far())


def rigid(name: str, mass_kg: float = 0.2, **keys: Any) -> dict[str, Any]:
    return {"kind": "rigid", "object": name, "mass_kg": mass_kg, **keys}


def assert_no_energy_but_the_hulls(played: Stage, lost_share: float = 0.005) -> None:
    """The bound of every case: energy at most what was there, and what the hull put in, + 0.5 %."""
    made_j = played.energy_j() - played.hull_work_j()
    moving_j = sum(played.column(name, "kinetic_j") for name in played.told[0])
    scale_j = max(np.max(moving_j), np.abs(played.hull_work_j()).max(), 1e-12)
    assert (made_j - made_j[0]).max() <= lost_share * scale_j


# Closed forms


@pytest.mark.parametrize("step_s", [0.002, 0.01])
def test_free_fall_is_exact_at_any_step(step_s: float) -> None:
    played = stage(far(), [ball("ball", [0, 0, 0.3])], [rigid("ball", velocity_m_s=[1, 0, 2])])
    played.hold(nothing(), round(0.2 / step_s), step_s)
    time_s = step_s * np.arange(1, len(played.told) + 1)
    height_m = 0.3 + 2 * time_s - GRAVITY_M_S2 * time_s**2 / 2
    # The midpoint rule is exact where the force is constant: rounding is left.
    np.testing.assert_allclose(played.column("ball", "position_m")[:, 2], height_m, atol=1e-12)
    np.testing.assert_allclose(played.column("ball", "position_m")[:, 0], time_s, atol=1e-12)
    assert np.ptp(played.energy_j()) < 1e-12


@pytest.mark.slow
def test_a_tumbling_box_keeps_its_energy() -> None:
    """About the middle axis, where turning is unstable and explicit steps gain energy."""
    keys: dict[str, Any] = {"angular_velocity_deg_s": [20, 1500, 20], "gravity": False}
    played = stage(far(), [box("box", [0.02, 0.05, 0.1], [0, 0, 0])], [rigid("box", **keys)])
    kinetic_j = played.effect.values(None)["box"]["kinetic_j"]
    played.hold(nothing(), 1000, each=20)
    upright = played.column("box", "world_from_mesh")[:, 1, 1]
    assert upright.min() < -0.9, "it turns over, else this would prove too little"
    # The rule conserves it; what is left is of repetition, 1e-14 a step.
    np.testing.assert_allclose(played.column("box", "kinetic_j"), kinetic_j, rtol=1e-9)


@pytest.mark.parametrize("restitution", [1.0, 0.5])
def test_a_ball_bounces_off_a_plane(restitution: float) -> None:
    """The top of a block that is seen along it: exact."""
    views = level_views()
    block = box_hull(views, [0.3, 0.3, 0.2], [0, 0, -0.2])
    keys: dict[str, Any] = {"restitution": restitution, "friction": 0.0}
    played = stage(views, [ball("ball", [0, 0, 0.45])], [rigid("ball", **keys)])
    played.hold(block, 450 if restitution == 1.0 else 300)
    hits = np.flatnonzero(played.column("ball", "n_contacts") > 0)
    height_m = played.column("ball", "position_m")[:, 2]
    fall_m = 0.45 - 0.05
    # To the step: it touches down within the one in which it is there.
    assert hits[0] == np.floor(np.sqrt(2 * fall_m / GRAVITY_M_S2) / STEP_S)
    speed = played.column("ball", "velocity_m_s")[hits[0], 2]
    assert speed == pytest.approx(restitution * np.sqrt(2 * GRAVITY_M_S2 * fall_m), rel=0.01)
    apex_m = height_m[hits[0] : hits[1]].max()
    assert apex_m == pytest.approx(0.05 + restitution**2 * fall_m, rel=0.001)
    if restitution == 1.0:
        assert len(hits) >= 2
        assert np.ptp(played.energy_j()) < 0.005 * 0.2 * GRAVITY_M_S2 * fall_m
    np.testing.assert_allclose(played.column("ball", "position_m")[:, :2], 0.0, atol=1e-6)
    assert played.column("ball", "penetration_m").max() < 1.01 * SLOP_M
    assert_no_energy_but_the_hulls(played)


def test_a_ball_bounces_off_the_hull_of_a_sphere() -> None:
    """The hull of these cameras is no sphere: its normal is that of the cone that ends it."""
    views = level_views(-0.2, 8)
    center, radius_m = np.array([0.0, 0.0, -0.2]), 0.2
    sphere = make_hull(views, ball_silhouettes(views, center, radius_m))
    keys: dict[str, Any] = {"restitution": 1.0, "friction": 0.0, "velocity_m_s": [-3.0, 0.2, 0.0]}
    played = stage(
        views, [ball("ball", [0.6, 0.02, -0.17], n_triangles=1280)], [rigid("ball", **keys)]
    )
    played.hold(sphere, 150)
    (hit,) = np.flatnonzero(played.column("ball", "n_contacts") > 0)
    normal = played.column("ball", "n_hull")[hit]
    cp_hull = played.column("ball", "cp_hull_m")[hit]
    inside = cp_hull - 0.02 * normal
    true = ball_exits(views, center, radius_m, inside, normal)[0]
    # A staircase of pixels of 4 mm, under a footprint of some 2 cm.
    assert angle_deg(normal, true.normal) < 4.0
    assert abs(true.distance_m - 0.02) < 0.003, "CP_hull is off by less than a pixel"
    before = np.array([-3.0, 0.2, -GRAVITY_M_S2 * STEP_S * (hit + 1)])
    after = played.column("ball", "velocity_m_s")[hit]
    mirrored = before - 2 * (before @ normal) * normal
    # Within a step of weight, 0.02 m/s.
    np.testing.assert_allclose(after, mirrored, atol=0.04)
    assert np.ptp(played.energy_j()) < 0.005 * played.column("ball", "kinetic_j")[0]


@pytest.mark.parametrize("n_steps", [4, 10])
def test_a_paddle_hands_on_twice_its_speed(n_steps: int) -> None:
    """Whether the hull is known every 8 ms or every 20 ms."""
    keys: dict[str, Any] = {"restitution": 1.0, "gravity": False}
    played = stage(far(), [ball("ball", [0, 0, -0.05])], [rigid("ball", **keys)])
    for k in range(240 // n_steps):
        at_m = -0.16 + 1.0 * STEP_S * n_steps * k
        played.step(box_hull(far(), [0.08, 0.06, 0.06], [at_m, 0, -0.05]), n_steps)
        if played.told[-1]["ball"]["n_contacts"]:
            break
    # A pixel of 0.5 mm on a way of 8 mm, halved by rounding both ends: 3 %; less where they cancel.
    assert played.column("ball", "velocity_m_s")[-1, 0] == pytest.approx(2.0, rel=0.03)
    assert_no_energy_but_the_hulls(played)
    assert played.hull_work_j()[-1] == pytest.approx(0.2 * 2.0**2 / 2, rel=0.06)


def test_a_ball_that_a_hull_speeds_up_once_is_not_pushed_again() -> None:
    """The hull jumps 20 mm, by whole frames; the ball is out of it and in front of it after."""
    keys: dict[str, Any] = {"restitution": 0.0, "gravity": False}
    played = stage(far(), [ball("ball", [0, 0, -0.05])], [rigid("ball", **keys)])
    for k in range(8):
        played.step(box_hull(far(), [0.08, 0.06, 0.06], [-0.16 + 0.02 * k, 0, -0.05]), 10)
    # It goes with the hand: its speed, and never deeper in than what is left.
    assert played.column("ball", "velocity_m_s")[-1, 0] == pytest.approx(1.0, rel=0.03)
    assert played.column("ball", "penetration_m").max() < 1.5 * SLOP_M


@cache
def door_angles(step_s: float) -> NDArray[np.float64]:
    door = box("door", [0.02, 0.02, 0.1], [0, 0, -0.1])
    keys = {"axis": [0, 1, 0], "anchor_mm": [0, 0, 0], "angle_deg": 10, "mass_kg": 2.0}
    played = stage(far(), [door], [{"kind": "hinge", "object": "door", **keys}])
    played.hold(nothing(), round(2.0 / step_s), step_s)
    energy_j = 2.0 * GRAVITY_M_S2 * 0.1 * (1 - np.cos(np.radians(10)))
    assert np.ptp(played.energy_j()) < 0.005 * energy_j
    angles: NDArray[np.float64] = played.column("door", "angle_rad")
    return angles


@pytest.mark.slow
def test_a_pendulum_swings_in_its_period() -> None:
    angles = door_angles(STEP_S)
    crossings = np.flatnonzero(np.diff(np.sign(angles)) != 0)
    at = crossings + angles[crossings] / (angles[crossings] - angles[crossings + 1])
    inertia = 2.0 * ((0.2**2 + 0.04**2) / 12 + 0.1**2)
    amplitude = np.radians(10)
    period_s = 2 * np.pi * np.sqrt(inertia / (2.0 * GRAVITY_M_S2 * 0.1)) * (1 + amplitude**2 / 16)
    # (w h)^2 / 24 of the midpoint rule: 1e-5.
    assert 2 * STEP_S * np.diff(at).mean() == pytest.approx(period_s, rel=5e-5)


@pytest.mark.slow
def test_a_door_is_pushed_to_the_angle_of_the_block_that_pushed_it() -> None:
    keys = {"axis": [0, 0, 1], "anchor_mm": [0, 0, 0], "range_deg": [0, 100], "mass_kg": 2.0}
    keys |= {"restitution": 0.0, "friction_n_m": 5.0}
    played = stage(
        far(),
        [box("door", [0.09, 0.01, 0.08], [0.09, 0, 0])],
        [{**keys, "kind": "hinge", "object": "door"}],
        viewport=91,
    )
    for k in range(60):
        face_m = -0.02 + 0.001 * min(k, 50)
        played.step(box_hull(far(), [0.04, 0.03, 0.05], [0.12, face_m - 0.03, 0]), 5)
    # The block's near edge, at x = 0.08 and y = 0.03, meets the door's front, 0.01 off its middle.
    angles = np.linspace(0, np.pi / 2, 100_001)
    expected = angles[np.abs(0.08 * np.tan(angles) - 0.01 / np.cos(angles) - 0.03).argmin()]
    angle = played.column("door", "angle_rad")[-1]
    # Half a pixel and the slop at an arm of 0.08 m, and what it coasts on: w^2 I / 2 / friction.
    coast = (0.1 / 0.08) ** 2 * 0.022 / 2 / 5.0
    assert angle == pytest.approx(expected, abs=(PIXEL_M + SLOP_M) / 0.08 + coast)
    assert played.column("door", "angular_velocity_rad_s")[-1] == pytest.approx(0, abs=1e-6)
    assert played.column("door", "penetration_m").max() < 0.001
    assert_no_energy_but_the_hulls(played)


def test_friction_stops_what_slides() -> None:
    keys: dict[str, Any] = {"friction": 0.4, "velocity_m_s": [0.8, 0, 0], "restitution": 0.0}
    table = box("table", [1.0, 1.0, 0.05], [0, 0, -0.05])
    played = stage(
        far(), [box("box", [0.05, 0.05, 0.02], [0, 0, 0.02]), table], [rigid("box", **keys)]
    )
    played.hold(nothing(), 200)
    way_m = played.column("box", "position_m")[-1, 0]
    # It stops between two steps, of which the last is 0.8 mm long.
    assert way_m == pytest.approx(0.8**2 / (2 * 0.4 * GRAVITY_M_S2), abs=0.0008)
    np.testing.assert_allclose(played.column("box", "velocity_m_s")[-1], 0.0, atol=1e-6)
    # Nothing lifts off as it slides.
    assert np.abs(played.column("box", "position_m")[:, 2] - 0.02).max() < SLOP_M


# Where it is hard


@pytest.mark.slow
@pytest.mark.parametrize("on_cad", [True, False])
def test_a_stack_rests(on_cad: bool) -> None:
    n_steps = 10_000 if THOROUGH else 2_500
    boxes = [box(f"box{i}", [0.05, 0.05, 0.05], [0, 0, 0.05 + 0.1 * i]) for i in range(3)]
    table = [box("table", [0.2, 0.2, 0.05], [0, 0, -0.05])] if on_cad else []
    played = stage(far(), boxes + table, [rigid(f"box{i}", 1.0) for i in range(3)])
    played.hold(nothing() if on_cad else floor(), n_steps, each=250)
    for i in range(3):
        off_m = played.column(f"box{i}", "position_m") - [0, 0, 0.05 + 0.1 * i]
        assert np.linalg.norm(off_m, axis=1).max() < 1e-4
        assert played.column(f"box{i}", "penetration_m").max() < 1.01 * SLOP_M
    assert_no_energy_but_the_hulls(played)


def test_a_gram_bears_a_tonne() -> None:
    boxes = [box(f"box{i}", [0.05, 0.05, 0.05], [0, 0, 0.05 + 0.1 * i]) for i in range(3)]
    table = box("table", [0.2, 0.2, 0.05], [0, 0, -0.05])
    played = stage(
        far(), [*boxes, table], [rigid("box0", 0.001), rigid("box1", 1000.0), rigid("box2", 0.001)]
    )
    played.hold(nothing(), 500, each=20)
    for i in range(3):
        off_m = played.column(f"box{i}", "position_m") - [0, 0, 0.05 + 0.1 * i]
        assert np.linalg.norm(off_m, axis=1).max() < 1e-4
    assert_no_energy_but_the_hulls(played)


@pytest.mark.slow
def test_a_ball_is_held_between_two_hands() -> None:
    """They close to 90 mm on a ball of 100 mm, and stay."""

    def hands(gap_m: float) -> Hull:
        return joined_hull(
            far(),
            [
                box_hull(far(), [0.05, 0.06, 0.06], [side * (0.05 + gap_m), 0, -0.1])
                for side in (-1, 1)
            ],
        )

    played = stage(far(), [ball("ball", [0.001, 0, -0.1])], [rigid("ball")])
    for k in range(6):
        played.step(hands(max(0.055 - 0.0025 * k, 0.045)), 5)
    held = hands(0.045)
    played.hold(held, 300, each=20)
    places = played.column("ball", "position_m")[-10:]
    assert np.ptp(places, axis=0).max() < 1e-6, "it does not jitter"
    # Between the two, to the quarter of its depth that samples do not tell, and half a pixel.
    assert abs(places[-1, 0]) < 0.25 * 0.005 + PIXEL_M
    assert np.abs(played.column("ball", "velocity_m_s")[-10:]).max() < 1e-6
    assert played.column("ball", "penetration_m")[-1] < 0.005 + 0.25 * 0.005 + 2 * PIXEL_M
    assert_no_energy_but_the_hulls(played)


def test_a_hull_that_appears_in_a_body_moves_it_and_gives_it_no_speed() -> None:
    played = stage(far(), [ball("ball", [0, 0, 0.03])], [rigid("ball", gravity=False)])
    played.step(nothing())
    played.step(floor(), is_known=False)
    assert played.column("ball", "position_m")[-1, 2] == pytest.approx(
        0.05, abs=2 * PIXEL_M + SLOP_M
    )
    assert played.column("ball", "penetration_m")[-1] < 1.1 * SLOP_M
    played.hold(floor(), 20)
    assert np.abs(played.column("ball", "velocity_m_s")).max() == 0.0
    assert played.column("ball", "kinetic_j").max() == 0.0


def test_what_a_hull_swallows_falls_as_if_there_were_none() -> None:
    """No way out within reach is known: nothing is done, and how deep it is at least is told."""
    views = level_views()
    everywhere = make_hull(views, [np.ones((486, 720), np.uint8)] * 4)
    played = stage(views, [ball("ball", [0, 0, 0])], [rigid("ball")])
    played.hold(everywhere, 20)
    fallen_m = GRAVITY_M_S2 * (20 * STEP_S) ** 2 / 2
    assert played.column("ball", "position_m")[-1, 2] == pytest.approx(-fallen_m, abs=1e-9)
    assert played.column("ball", "n_contacts").max() == 0
    # Twice the diagonal of its box, which the polyhedron fills but for a hundredth or two.
    assert played.column("ball", "penetration_m")[-1] == pytest.approx(2 * 3**0.5 * 0.1, rel=0.03)


def test_what_a_hull_lifts_out_is_work_of_the_hull() -> None:
    played = stage(far(), [ball("ball", [0, 0, 0.03])], [rigid("ball")])
    played.step(floor(), is_known=False)
    lifted_m = played.column("ball", "position_m")[-1, 2] - 0.03
    assert lifted_m > 0.019
    # But for what it fell in that one step, half a g h^2 twice.
    fell_m = 2 * GRAVITY_M_S2 * STEP_S**2
    assert played.hull_work_j()[-1] == pytest.approx(
        0.2 * GRAVITY_M_S2 * lifted_m, abs=0.2 * GRAVITY_M_S2 * fell_m
    )
    assert_no_energy_but_the_hulls(played)


@pytest.mark.slow
def test_a_hull_that_flickers_gives_no_energy() -> None:
    played = stage(far(), [ball("ball", [0, 0, 0.1])], [rigid("ball", restitution=0.5)])
    for k in range(40):
        played.step(floor() if k % 2 else nothing(), 10)
    assert_no_energy_but_the_hulls(played)
    assert played.column("ball", "penetration_m").max() < 1.5 * SLOP_M
    # It falls while the block is away, at most 10 steps from rest, and half of that speed is left.
    fallen_m = GRAVITY_M_S2 * (10 * STEP_S) ** 2 / 2
    assert played.column("ball", "position_m")[20:, 2].min() > 0.05 - 4 * fallen_m


@pytest.mark.slow
def test_a_second_between_frames() -> None:
    played = stage(far(), [ball("ball", [0, 0, 0.12])], [rigid("ball", restitution=0.8)])
    played.step(floor(), 500)
    played.step(floor(), 500)
    assert_no_energy_but_the_hulls(played)
    assert played.column("ball", "position_m")[-1, 2] > 0.05 - 2 * PIXEL_M - 0.001
    assert played.column("ball", "penetration_m").max() < 1.5 * SLOP_M


@pytest.mark.slow
def test_a_door_falls_to_its_stop_and_stays() -> None:
    keys = {"axis": [0, 1, 0], "anchor_mm": [0, 0, 0], "range_deg": [20, 170], "angle_deg": 60}
    keys |= {"mass_kg": 2.0, "restitution": 0.3}
    door = box("door", [0.02, 0.02, 0.1], [0, 0, -0.1])
    played = stage(far(), [door], [{**keys, "kind": "hinge", "object": "door"}])
    played.hold(nothing(), 700, each=10)
    assert_no_energy_but_the_hulls(played)
    angle = played.column("door", "angle_rad")
    # Beyond it by what it turns in half a step at most, at the speed it arrives with.
    arrives = np.sqrt(2 * GRAVITY_M_S2 * 0.1 * (np.cos(np.radians(20)) - 0.5) / 0.01347)
    assert angle.min() > np.radians(20) - arrives * STEP_S / 2
    np.testing.assert_allclose(angle[-20:], np.radians(20), atol=2e-5)
    np.testing.assert_allclose(played.column("door", "kinetic_j")[-20:], 0.0, atol=1e-9)


@pytest.mark.slow
def test_a_cup_is_not_filled() -> None:
    """What is not convex keeps its hollow: a ball lies in a bowl of five slabs, joined as one."""
    walls = [
        box("w", half, at)
        for half, at in (
            ([0.1, 0.1, 0.01], [0, 0, 0.01]),
            ([0.01, 0.1, 0.1], [-0.11, 0, 0.1]),
            ([0.01, 0.1, 0.1], [0.11, 0, 0.1]),
        )
    ]
    vertices = np.concatenate([one.vertices_world for one in walls])
    faces = np.concatenate([BOX_FACES + 8 * i for i in range(3)]).astype(np.int32)
    bend = scene_object("bend", *l_shape())
    for cad in (scene_object("bowl", vertices, faces), bend):
        played = stage(far(), [ball("ball", [0, 0, 0.15]), cad], [rigid("ball", restitution=0.0)])
        played.hold(nothing(), 150, each=10)
        # On the floor of the hollow, 0.02 high; a hull of it all would hold it up higher.
        assert played.column("ball", "position_m")[-1, 2] == pytest.approx(0.07, abs=0.001)


def l_shape() -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return one closed surface that is not convex: a floor with a wall, as an extruded L."""
    outline = np.array(
        [[-0.15, 0.0], [0.15, 0.0], [0.15, 0.2], [0.13, 0.2], [0.13, 0.02], [-0.15, 0.02]]
    )
    near = np.insert(outline, 1, -0.1, axis=1)
    vertices = np.concatenate([near, near + np.array([0, 0.2, 0])])
    cap = np.array([[0, 1, 4], [0, 4, 5], [1, 2, 3], [1, 3, 4]])
    sides = [[i, (i + 1) % 6 + 6, (i + 1) % 6] for i in range(6)]
    sides += [[i, i + 6, (i + 1) % 6 + 6] for i in range(6)]
    return vertices, np.concatenate([cap, cap[:, ::-1] + 6, sides]).astype(np.int32)


def test_it_goes_on_from_a_state_to_the_bit() -> None:
    objects = [
        ball("ball", [0, 0, 0.1]),
        box("box", [0.03, 0.03, 0.03], [0.08, 0, 0.05]),
        box("table", [0.3, 0.3, 0.01], [0, 0, -0.05]),
    ]
    effects = [rigid("ball", velocity_m_s=[0.5, 0, 0]), rigid("box")]
    whole = stage(far(), objects, effects)
    whole.step(floor(), 40)
    state = whole.effect.state()
    again = stage(far(), objects, effects)
    again.effect.restore(state)
    again.before, again.time_s, again.n_instants = whole.before, whole.time_s, whole.n_instants
    for played in (whole, again):
        played.step(floor(), 60)
    for name, row in whole.told[-1].items():
        for column, value in row.items():
            np.testing.assert_array_equal(value, again.told[-1][name][column], err_msg=column)
    assert whole.told[-1]["ball"]["n_contacts"] > 0, "it would prove too little"


def test_poses_are_places_that_a_file_holds_about_its_origin() -> None:
    played = stage(far(), [ball("ball", [0, 0, 0])], [rigid("ball")])

    (pose,) = (one for one in played.effect.told["ball"].columns if one.shape == (3, 4))

    assert pose.is_place


def test_what_is_not_finite_is_named() -> None:
    played = stage(far(), [ball("ball", [0, 0, 0.1])], [rigid("ball")])
    state = dict(played.effect.state())
    state["velocities"] = np.full_like(state["velocities"], np.nan)
    played.effect.restore(state)
    with pytest.raises(UnstableError, match=r"^ball: a velocity of nan"):
        played.step(nothing())


# Where the hull meets a body


def patches_of(hull: Hull, body: Any, **keys: Any) -> list[Patch]:
    mesh = Triangles(body.vertices_world, body.faces, np.full(len(body.faces), 30, np.int32))
    with Native(1) as engine:
        (hits,) = engine.query(hull, [mesh])
    keys = {"center_world": mesh.vertices_world.mean(axis=0), "is_closed": True} | keys
    return find_patches(hull, mesh, hits, **keys)


def test_two_hands_are_two_patches_and_each_pushes_its_way() -> None:
    plate = box("plate", [0.08, 0.08, 0.02], [0, 0, 0])
    hands = joined_hull(
        far(), [box_hull(far(), [0.02, 0.02, 0.03], [0, 0, z_m]) for z_m in (-0.045, 0.045)]
    )
    below, above = sorted(patches_of(hands, plate), key=lambda patch: patch.points_world[0, 2])
    np.testing.assert_allclose(below.v_rec, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(above.v_rec, [0, 0, -1], atol=1e-9)
    for patch in (below, above):
        np.testing.assert_allclose(patch.out_m, 0.005, atol=PIXEL_M)
        contact = contact_of(hands, patch, size_m=0.1)
        assert contact is not None
        np.testing.assert_allclose(contact.n_hull, patch.v_rec, atol=1e-3)
    normals = np.array([below.v_rec, above.v_rec])
    is_squeezed, speeds = followed(normals, np.array([0.3, 0.1]))
    assert is_squeezed
    np.testing.assert_allclose(speeds, [0.1, -0.1])  # the one velocity between both: 0.1 upwards
    is_squeezed, speeds = followed(normals[:1], np.array([0.3]))
    assert not is_squeezed
    np.testing.assert_array_equal(speeds, 0.3)


def test_what_pierces_a_body_leaves_where_it_came_in() -> None:
    """A finger through a plate, 5 mm out on the far side: the way back is 45 mm, the other 205."""
    plate = box("plate", [0.08, 0.08, 0.02], [0, 0, 0])
    finger = box_hull(far(), [0.02, 0.02, 0.1], [0, 0, -0.075])
    (patch,) = patches_of(finger, plate)
    np.testing.assert_allclose(patch.v_rec, [0, 0, 1], atol=1e-9)
    assert patch.out_m[0] == pytest.approx(0.045, abs=PIXEL_M)


def test_an_open_sheet_gives_way_to_its_nearer_side() -> None:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float64) * 0.08
    for faces in ([[0, 1, 2], [0, 2, 3]], [[2, 1, 0], [3, 2, 0]]):
        sheet = scene_object("sheet", corners, np.array(faces, np.int32), is_closed=False)
        hand = box_hull(far(), [0.03, 0.03, 0.05], [0, 0, -0.04])
        (patch,) = patches_of(hand, sheet, is_closed=False)
        np.testing.assert_allclose(patch.v_rec, [0, 0, 1], atol=1e-9)
        assert patch.out_m[0] == pytest.approx(0.01, abs=PIXEL_M)


def test_a_hinged_body_gives_way_along_its_arc() -> None:
    door = box("door", [0.09, 0.01, 0.08], [0.09, 0, 0])
    hand = box_hull(far(), [0.01, 0.03, 0.03], [0.12, -0.035, 0])
    arc = Arc(np.array([0.0, 0.0, 1.0]), np.zeros(3))
    (patch,) = patches_of(hand, door, arc=arc)
    # The middle of the patch lies at x = 0.12 and y = -0.01, or 5 mm deeper on its rim.
    assert angle_deg(patch.v_rec, np.array([0.01, 0.12, 0]) / np.hypot(0.01, 0.12)) < 1.0


# Mass and shape


def test_the_mass_of_a_box_and_of_a_ball() -> None:
    half = np.array([0.1, 0.2, 0.3])
    one = box("box", half.tolist(), [5.0, 6.0, 7.0])
    share = mass_share(one.vertices_world, one.faces, is_closed=True)
    assert share.volume_m3 == pytest.approx(0.048, rel=1e-12)
    np.testing.assert_allclose(share.center, [5, 6, 7], rtol=1e-12)
    squares = (2 * half) ** 2
    np.testing.assert_allclose(
        np.sort(share.inertia_m2), np.sort((squares.sum() - squares) / 12), rtol=1e-8
    )
    sphere = sphere_mesh(20_000, 0.5)
    share = mass_share(sphere.vertices_world, sphere.faces, is_closed=True)
    # The polyhedron lies within the ball by less than (edge / radius)^2 / 8.
    np.testing.assert_allclose(share.inertia_m2, 0.4 * 0.5**2, rtol=2e-3)


def test_the_mass_of_an_open_sheet_lies_on_its_area() -> None:
    corners = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]], np.float64)
    share = mass_share(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), is_closed=False)
    assert share.area_m2 == pytest.approx(2.0)
    np.testing.assert_allclose(share.center, [1, 0.5, 0], atol=1e-12)
    np.testing.assert_allclose(np.sort(share.inertia_m2), [1 / 12, 4 / 12, 5 / 12], rtol=1e-8)


def test_what_collides() -> None:
    one = box("box", [0.1, 0.2, 0.3], [0, 0, 0])
    shape = collision_shape(one.vertices_world, one.faces, is_closed=True)
    assert (shape.n_convex, shape.n_prisms, shape.prism_m) == (1, 0, 0.0)
    assert shape.outside_m < 1e-12
    vertices, faces = l_shape()
    shape = collision_shape(vertices, faces, is_closed=True)
    assert (shape.n_convex, shape.n_prisms) == (0, len(faces))
    assert shape.outside_m == 0.0, "of a closed surface, prisms reach inwards"
    shape = collision_shape(vertices, faces, is_closed=False)
    assert shape.outside_m == shape.prism_m / 2


# Bad scenes


def refused(effects: list[dict[str, Any]], *, is_closed: bool = True) -> str:
    corners = box("ball", [0.05, 0.05, 0.05], [0, 0, 0])
    one = scene_object("ball", corners.vertices_world, corners.faces, is_closed=is_closed)
    with pytest.raises(SceneError) as error:
        stage(far(), [one], effects)
    return str(error.value)


HINGE = {"kind": "hinge", "object": "ball", "axis": [0, 0, 1], "anchor_mm": [0, 0, 0], "mass_kg": 1}


@pytest.mark.parametrize(
    ("effect", "said"),
    [
        ({"kind": "rigid", "object": "bell", "mass_kg": 1}, "there is no object 'bell'"),
        ({"kind": "rigid", "object": "ball"}, "found neither of mass_kg and density_kg_m3"),
        (rigid("ball", 1.0, density_kg_m3=1.0), "found both of mass_kg and density_kg_m3"),
        (rigid("ball", 0.0), "mass_kg"),
        (rigid("ball", -1.0), "mass_kg"),
        (rigid("ball", 1.0, restitution=1.5), "restitution"),
        (rigid("ball", 1.0, spin=1.5), "spin"),
        (rigid("ball", 1.0, angular_velocity_deg_s=[0, 0, 40_000]), "take a shorter step"),
        ({**HINGE, "axis": [0, 0, 0]}, "has no length"),
        ({**HINGE, "anchor_mm": [0, 0, 5000]}, "4950 mm off 'ball', which is 173 mm large"),
        ({**HINGE, "range_deg": [30, 30]}, "range_deg"),
        ({**HINGE, "range_deg": [0, 30], "angle_deg": 40}, "angle_deg"),
    ],
)
def test_bad_entries_are_one_clear_line(effect: dict[str, Any], said: str) -> None:
    text = refused([effect])
    assert "\n" not in text
    assert "effect.1" in text
    assert said in text


def test_an_open_mesh_has_no_density() -> None:
    effect = {"kind": "rigid", "object": "ball", "density_kg_m3": 100.0}
    assert "open and has no volume to fill; give mass_kg" in refused([effect], is_closed=False)


def test_two_effects_may_not_move_one_object() -> None:
    assert "moved by effect.1 already" in refused([rigid("ball"), HINGE])
