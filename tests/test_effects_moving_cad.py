"""Effects beside CAD that moves as a file says: closed forms, and scenes where it stands there."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.effect_bodies import STEP_S, ball, box, far_views, stage
from helpers.effect_cloth import make_cloth, sheet
from helpers.effects import cube, empty_hull, entry_of, floor, setting_of
from helpers.hulls import ball_hull, ring_views
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybridve.calib.errors import SceneError
from hybridve.calib.pose import Pose, transform
from hybridve.hull.cad.motion import Motion
from hybridve.hull.cad.scene import Scene, SceneObject
from hybridve.hull.effects.effect import GRAVITY_M_S2, Effect, Placed
from hybridve.hull.effects.instants import HullMode, instants
from hybridve.hull.effects.kinds import read_entries
from hybridve.hull.effects.light import Light
from hybridve.hull.effects.particles import Particles
from hybridve.hull.effects.proximity import Proximity
from hybridve.hull.effects.shadow import Shadow
from hybridve.hull.query.silhouettes import Hull, Views
from hybridve.hull.query.threads import Threads

VIEWS = ring_views(4)
FAR = far_views()
FRAME_S = 0.02


def moving(one: SceneObject, motion: Motion) -> SceneObject:
    return replace(one, motion=motion)


def slide(velocity_m_s: Sequence[float], n_frames: int) -> Motion:
    """Return the motion of what goes straight from where the scene puts it."""
    way_m = np.array(velocity_m_s) * FRAME_S
    return Motion.of_poses(
        {frame: np.column_stack([np.eye(3), frame * way_m]) for frame in range(n_frames)}
    )


def turn(rate_rad_s: float, axis: Sequence[float], n_frames: int) -> Motion:
    """Return the motion of what turns evenly about an axis through the origin."""
    angles = {frame: rate_rad_s * FRAME_S * frame for frame in range(n_frames)}
    return Motion.of_hinge(angles, np.array(axis), np.zeros(3))


def play(
    effect: Effect,
    hull: Hull,
    objects: Sequence[SceneObject],
    n_frames: int,
    *,
    step_s: float = STEP_S,
    mode: HullMode = "hold",
    known: bool = True,
) -> list[Mapping[str, Mapping[str, NDArray[Any]]]]:
    """Return what is told of frames 1, 2, ..., as the driver goes through them; the hull stands."""
    motions = {one.name: one.motion for one in objects if one.motion is not None}
    told = []
    for frame in range(1, n_frames):
        for steps in instants(
            hull if known else None,
            hull,
            start_s=(frame - 1) * FRAME_S,
            elapsed_s=FRAME_S,
            frame=frame,
            step_s=step_s,
            mode=mode,
            motions=motions,
            since=frame - 1 if known else None,
        ):
            for instant in steps:
                effect.advance(instant, steps[0].elapsed_s / len(steps))
        told.append(effect.values(hull))
    return told


def bodies(objects: Sequence[SceneObject], views: Views = FAR, **keys: Any) -> tuple[Effect, str]:
    """Return the first of the objects as a rigid body among the others."""
    entry = {"kind": "rigid", "object": objects[0].name, "mass_kg": 0.2, **keys}
    return stage(views, objects, [entry]).effect, objects[0].name


# ---------------------------------------------------------------------------- rigid bodies


@pytest.mark.parametrize("speed_m_s", [0.5, 2.0])
@pytest.mark.parametrize("restitution", [0.0, 1.0])
def test_a_paddle_hands_on_its_speed_and_what_bounces_off_it(
    speed_m_s: float, restitution: float
) -> None:
    paddle = moving(box("paddle", [0.02, 0.1, 0.1], [-0.1, 0, 0]), slide([speed_m_s, 0, 0], 12))
    objects = [ball("ball", [0, 0, 0]), paddle]
    effect, name = bodies(objects, restitution=restitution, friction=0.0, gravity=False)

    told = [row[name] for row in play(effect, empty_hull(FAR), objects, 12)]

    wanted = (1.0 + restitution) * speed_m_s
    np.testing.assert_allclose(told[-1]["velocity_m_s"], [wanted, 0, 0], atol=1e-3 * speed_m_s)
    # An impulse of m (1 + e) v at the speed of the paddle.
    assert told[-1]["cad_work_j"] == pytest.approx(0.2 * wanted * speed_m_s, rel=1e-3)
    assert told[-1]["hull_work_j"] == 0.0
    for row in told:
        assert row["kinetic_j"] <= row["cad_work_j"] * (1 + 1e-3) + 1e-12
    lowest_m = transform(told[-1]["world_from_mesh"], objects[0].vertices_world)[:, 0].min()
    assert lowest_m >= -0.08 + speed_m_s * 11 * FRAME_S - 2e-4, "it is not in the paddle"


def test_a_bat_that_turns_hands_on_twice_the_speed_of_where_it_hits() -> None:
    rate = 4.0
    bat = moving(box("bat", [0.3, 0.01, 0.1], [0.3, -0.01, 0]), turn(rate, [0, 0, 1], 12))
    objects = [ball("ball", [0.4, 0.15, 0], n_triangles=1280), bat]
    effect, name = bodies(objects, restitution=1.0, friction=0.0, gravity=False)

    told = [row[name] for row in play(effect, empty_hull(FAR), objects, 12)]

    # The face is the plane through the axis: it meets the ball when it is its radius off.
    distance_m = np.hypot(0.4, 0.15)
    angle = np.arctan2(0.15, 0.4) - np.arcsin(0.05 / distance_m)
    along_m = np.sqrt(distance_m**2 - 0.05**2)
    speed_m_s = np.linalg.norm(told[-1]["velocity_m_s"])
    assert speed_m_s == pytest.approx(2.0 * rate * along_m, rel=0.01)
    # MuJoCo takes the normal of the ball's facet, which is up to 6 degrees off the face's.
    across = np.array([-np.sin(angle), np.cos(angle), 0.0])
    assert told[-1]["velocity_m_s"] @ across > np.cos(np.radians(7.0)) * speed_m_s


@pytest.mark.slow
def test_a_lift_carries_what_stands_on_it_and_its_work_is_the_height() -> None:
    lift = moving(box("lift", [0.2, 0.2, 0.02], [0, 0, -0.02]), slide([0, 0, 0.25], 21))
    objects = [box("crate", [0.05, 0.05, 0.05], [0, 0, 0.05]), lift]
    effect, name = bodies(objects, restitution=0.0)

    told = [row[name] for row in play(effect, empty_hull(FAR), objects, 21)]

    rose_m = 0.25 * 20 * FRAME_S
    assert told[-1]["position_m"][2] == pytest.approx(0.05 + rose_m, abs=2e-4)
    gained_j = 0.2 * GRAVITY_M_S2 * rose_m + 0.5 * 0.2 * 0.25**2
    # Set in motion at once it takes m v^2, of which half is lost.
    assert told[-1]["cad_work_j"] == pytest.approx(gained_j + 0.5 * 0.2 * 0.25**2, rel=5e-3)
    assert told[-1]["kinetic_j"] + told[-1]["potential_j"] == pytest.approx(gained_j, rel=5e-3)


def test_a_belt_speeds_up_what_lies_on_it_by_friction() -> None:
    belt = moving(box("belt", [1.0, 0.2, 0.02], [0, 0, -0.02]), slide([0.6, 0, 0], 21))
    objects = [box("crate", [0.05, 0.05, 0.05], [0, 0, 0.05]), belt]
    effect, name = bodies(objects, restitution=0.0, friction=0.2)

    told = [row[name] for row in play(effect, empty_hull(FAR), objects, 21)]

    speeds = np.array([row["velocity_m_s"][0] for row in told])
    times_s = FRAME_S * np.arange(1, 21)
    expected = np.minimum(0.2 * GRAVITY_M_S2 * times_s, 0.6)
    np.testing.assert_allclose(speeds, expected, atol=0.02)


def test_where_nothing_is_known_before_it_has_stood_there_and_gives_no_speed() -> None:
    paddle = moving(box("paddle", [0.02, 0.1, 0.1], [-0.1, 0, 0]), slide([4.0, 0, 0], 3))
    objects = [ball("ball", [0, 0, 0]), paddle]
    effect, name = bodies(objects, restitution=1.0, friction=0.0, gravity=False)

    told = [row[name] for row in play(effect, empty_hull(FAR), objects, 2, known=False)]

    # The paddle is in the ball, by 50 mm: moved out without a speed.
    assert abs(told[-1]["velocity_m_s"]).max() < 1e-6
    assert told[-1]["cad_work_j"] == pytest.approx(0.0, abs=1e-9)


def test_a_door_of_an_effect_is_pushed_by_cad_that_moves() -> None:
    pusher = moving(box("pusher", [0.05, 0.05, 0.05], [0.3, -0.08, 0]), slide([0, 0.5, 0], 21))
    door = box("door", [0.2, 0.01, 0.2], [0.2, 0, 0])
    keys = {"axis": [0, 0, 1], "anchor_mm": [0, 0, 0], "mass_kg": 2.0, "restitution": 0.0}
    effect = stage(FAR, [door, pusher], [{"kind": "hinge", "object": "door", **keys}]).effect

    told = [row["door"] for row in play(effect, empty_hull(FAR), [door, pusher], 21)]

    # The face of the pusher, 0.25 to 0.35 m from the axis, is at y; the door's near face is 10 mm
    # off its middle plane. Once pushed it never falls behind.
    y_m = -0.03 + 0.5 * FRAME_S * np.arange(1, 21)
    angles = np.array([row["angle_rad"] for row in told])
    for angle, level_m in zip(angles.tolist(), y_m.tolist(), strict=True):
        edge = np.array([0.25, level_m])  # the corner nearer to the axis leads
        behind_m = -np.sin(angle) * edge[0] + np.cos(angle) * edge[1]
        assert behind_m <= -0.01 + 5e-4
    assert angles[-1] > 0.5
    assert told[-1]["cad_work_j"] >= told[-1]["kinetic_j"] * (1 - 1e-3)


# ---------------------------------------------------------------------------- cloth


def test_a_sheet_rides_on_a_plate_that_rises() -> None:
    plate = moving(box("plate", [0.4, 0.4, 0.02], [0, 0, -0.02]), slide([0, 0, 0.5], 16))
    hung = sheet((6, 6), (0.4, 0.4))
    lying = replace(hung, vertices_world=hung.vertices_world[:, [0, 2, 1]] + [0.0, 0.0, 0.001])
    cloth = make_cloth(VIEWS, [lying, plate], pin="none", damping_per_s=0.0, thickness_mm=2.0)

    told = [row["sheet"] for row in play(cloth, empty_hull(VIEWS), [plate], 16)]

    top_m = 0.5 * FRAME_S * np.arange(1, 16)
    for row, level_m in zip(told, top_m.tolist(), strict=True):
        np.testing.assert_allclose(row["vertices_m"][:, 2], level_m + 0.001, atol=2e-4)
    mass_kg = 0.2 * 0.4 * 0.4
    gained_j = mass_kg * GRAVITY_M_S2 * top_m[-1] + 0.5 * mass_kg * 0.5**2
    assert told[-1]["kinetic_j"] + told[-1]["potential_j"] == pytest.approx(gained_j, rel=0.01)
    assert told[-1]["cad_work_j"] == pytest.approx(gained_j, rel=0.02)
    assert told[-1]["hull_work_j"] == 0.0


def test_a_fast_thin_board_pushes_a_curtain_and_no_node_gets_behind_it() -> None:
    board = moving(box("board", [0.15, 0.002, 0.15], [0, -0.05, 0]), slide([0, 2.0, 0], 7))
    hung = sheet((12, 15))
    cloth = make_cloth(VIEWS, [hung, board])
    is_before = (np.abs(hung.vertices_world[:, [0, 2]]) <= 0.101).all(axis=1)

    told = [row["sheet"] for row in play(cloth, empty_hull(VIEWS), [board], 7)]

    for frame, row in enumerate(told, start=1):
        middle_m = -0.05 + 2.0 * FRAME_S * frame
        # Of the board's face by half the sheet's thickness, but for what neighbours pull.
        assert (row["vertices_m"][is_before, 1] > middle_m + 0.002).all()
    assert told[-1]["displacement_m"] > 0.15
    assert told[-1]["cad_work_j"] > 0.0


# ---------------------------------------------------------------------------- particles


def particles(objects: Sequence[SceneObject], **keys: Any) -> Particles:
    keys = {"count": 1, "lifetime_s": 100.0, "drag_s": 0.0, "gravity": 0.0, **keys}
    return Particles([entry_of("particles", **keys)], setting_of(VIEWS, *objects), Threads(1))


def test_a_plate_that_comes_throws_a_particle_off_at_twice_its_speed() -> None:
    plate = moving(box("plate", [0.2, 0.2, 0.005], [0, 0, -0.05]), slide([0, 0, 3.0], 6))
    swarm = particles([plate], source_mm=[10, 20, 0], restitution=1.0)

    told = [row["it"] for row in play(swarm, empty_hull(VIEWS), [plate], 6, step_s=0.005)]

    hit_s = 0.045 / 3.0
    np.testing.assert_allclose(swarm.state()["it/velocity"][0], [0, 0, 6.0], atol=1e-9)
    height_m = 6.0 * (5 * FRAME_S - hit_s)
    np.testing.assert_allclose(told[-1]["position_m"][0], [0.01, 0.02, height_m], atol=1e-5)
    assert told[-1]["cad_work_j"] == pytest.approx(0.5 * 4.2e-6 * 36.0, rel=1e-6)
    assert told[-1]["n_deflected"][0] == 0  # it counts real things


@pytest.mark.parametrize("restitution", [0.0, 0.7])
def test_a_bat_that_sweeps_leaves_no_particle_behind_it(restitution: float) -> None:
    bat = moving(box("bat", [0.25, 0.004, 0.2], [0.25, -0.004, 0]), turn(8.0, [0, 0, 1], 8))
    swarm = particles(
        [bat],
        source_mm=[100, 60, -100, 400, 60, 100],
        count=200,
        restitution=restitution,
        friction=0.0,
    )

    play(swarm, empty_hull(VIEWS), [bat], 8, step_s=0.005)

    place = swarm.state()["it/position"] + VIEWS.origin_world
    angle = 8.0 * FRAME_S * 7
    own = place @ Rotation.from_rotvec([0, 0, angle]).as_matrix()
    assert (own[:, 1] > 0.0).all(), "all are in front of its face"
    assert swarm.state()["it/cad_work_j"].sum() > 0.0


# ---------------------------------------------------------------------------- who looks on


def placed_at(one: SceneObject, pose: Pose) -> dict[str, Placed]:
    return {one.name: Placed(one.at(pose).vertices_world, pose)}


def some_poses() -> list[Pose]:
    turns = Rotation.from_rotvec([[0.1, 0.2, -0.3], [0.6, 0.0, 0.2], [0.0, 0.0, 1.4]]).as_matrix()
    shifts = [[0.05, -0.1, 0.02], [-0.2, 0.1, 0.1], [0.3, 0.0, -0.05]]
    return [np.column_stack([r, t]) for r, t in zip(turns, shifts, strict=True)]


@pytest.mark.parametrize("kind", ["light", "shadow"])
@pytest.mark.parametrize("told_of", ["ground", "block"])
def test_light_and_shadow_are_those_of_a_scene_in_which_the_object_stands(
    kind: str, told_of: str
) -> None:
    make = {"light": Light, "shadow": Shadow}[kind]
    keys: dict[str, Any] = {"lamp_mm": [100, 50, 1200], "objects": [told_of]}
    if kind == "light":
        keys["intensity_cd"] = 100.0
    ground = floor("ground", 0.5, -0.3, n_quads=4)
    block = cube("block", (0, 0, 0.2), 0.2)
    hull = ball_hull(VIEWS, np.array([0.15, 0.1, 0.0]), 0.1)
    goes = moving(block, Motion.of_poses(dict(enumerate(some_poses()))))
    effect = make([entry_of(kind, **keys)], setting_of(VIEWS, ground, goes), Threads(1))

    for pose in some_poses():
        effect.see_objects(placed_at(goes, pose))
        found = effect.values(hull)["it"]
        stands = setting_of(VIEWS, ground, block.at(pose))
        expected = make([entry_of(kind, **keys)], stands, Threads(1)).values(hull)["it"]
        for column, values in expected.items():
            np.testing.assert_allclose(found[column], values, atol=1e-9, err_msg=column)
        assert ("vertices_m" in found) is (told_of == "block")
    if told_of == "block":
        np.testing.assert_allclose(
            found["vertices_m"], transform(some_poses()[-1], block.vertices_world), atol=1e-12
        )
        assert 0.0 < float(found["lit_m2"][0]) < 0.24


def test_what_another_effect_moves_shades_where_it_is() -> None:
    ground, block = floor("ground", 0.5, -0.3, n_quads=4), cube("block", (0, 0, 0.2), 0.2)
    entry = entry_of("shadow", lamp_mm=[100, 50, 1200], objects=["ground"])
    effect = Shadow([entry], setting_of(VIEWS, ground, block, claimed=("block",)), Threads(1))
    bent = block.vertices_world * [1.0, 1.0, 0.5] + [0.1, 0.0, 0.0]

    effect.see_objects({"block": Placed(bent, None)})
    found = effect.values(empty_hull(VIEWS))["it"]

    stands = setting_of(VIEWS, ground, replace(block, vertices_world=bent))
    expected = Shadow([entry], stands, Threads(1)).values(empty_hull(VIEWS))["it"]
    np.testing.assert_array_equal(found["share_lit"], expected["share_lit"])
    assert found["lit_m2"][0] < 0.99


def test_proximity_is_that_to_an_object_that_stands_there() -> None:
    block = cube("block", (0, 0, 0.2), 0.2)
    hull = ball_hull(VIEWS, np.array([0.15, 0.1, -0.1]), 0.1)
    goes = moving(block, Motion.of_poses(dict(enumerate(some_poses()))))
    keys: dict[str, Any] = {
        "object": "block",
        "zones_mm": [300, 50],
        "falloff": {"kind": "linear", "range_mm": 200.0},
    }
    effect = Proximity([entry_of("proximity", **keys)], setting_of(VIEWS, goes))
    gathered = np.zeros(12)

    for pose in some_poses():
        effect.see_objects(placed_at(goes, pose))
        found = effect.values(hull)["it"]
        other = Proximity([entry_of("proximity", **keys)], setting_of(VIEWS, block.at(pose)))
        expected = other.values(hull)["it"]
        lower_m, upper_m = found["clearance_m"]
        # Both enclose the same clearance, and are 0.1 mm wide.
        assert lower_m <= expected["clearance_m"][1] + 1e-9
        assert upper_m >= expected["clearance_m"][0] - 1e-9
        assert upper_m - lower_m <= 1.01e-4
        np.testing.assert_array_equal(found["is_in_zone"], expected["is_in_zone"])
        strength, wanted = (one.state()["it/strength"] for one in (effect, other))
        assert (strength[:, 0] <= wanted[:, 1] + 1e-9).all()
        assert (strength[:, 1] >= wanted[:, 0] - 1e-9).all()
        gathered = gathered + wanted[:, 1]
    assert gathered.max() > 0.0


# ---------------------------------------------------------------------------- what cannot be


def test_an_effect_cannot_move_what_a_file_moves() -> None:
    door = moving(cube("door", (0, 0, 0), 0.2), slide([0, 0, 1], 2))
    scene = Scene(
        Path("scene.toml"), (door,), ({"kind": "rigid", "object": "door", "mass_kg": 1.0},), ""
    )

    with pytest.raises(SceneError, match=r"effect.1.object: 'door' moves as its `poses` says") as e:
        read_entries(scene)

    assert "\n" not in str(e.value)


def test_particles_come_out_of_no_object_that_moves() -> None:
    door = moving(cube("door", (0, 0, 0), 0.2), slide([0, 0, 1], 2))

    with pytest.raises(SceneError, match=r"effect.1.object: 'door' moves as a file says"):
        particles([door], object="door")
