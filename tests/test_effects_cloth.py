"""A sheet hangs, swings and is pushed aside; where physics has a closed form, as that says.

Hulls are balls and half spaces whose silhouettes are closed forms (helpers.response). What is in
them after a step is asked of `contains_few` and `spans_in_hull`, not of the effect.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.effect_cloth import (
    STEP_S,
    Row,
    deepest_m,
    drive,
    half_space,
    half_space_views,
    make_cloth,
    no_hull,
    nudged,
    sheet,
    thing,
    views_around,
)
from helpers.hulls import ring_views
from helpers.response import ball_silhouettes
from numpy.typing import NDArray
from pydantic import ValidationError

from hybridve.calib.errors import SceneError
from hybridve.hull.cad.scene import SceneObject, load_scene
from hybridve.hull.effects.cloth_model import highest_frequency, longest_step, make_springs, weld
from hybridve.hull.effects.effect import GRAVITY_M_S2, Instant, Setting, UnstableError
from hybridve.hull.effects.kinds import make_effects, read_entries
from hybridve.hull.query.native import Native
from hybridve.hull.query.silhouettes import Hull, make_hull
from hybridve.hull.synth.meshes import ball_mesh, box_mesh, sheet_mesh, write_stl

#: What a sample may be deep after a step, metres.
LEFT_M = 1e-3

#: What energy may come from nowhere, as a share of all that came from the hull.
FROM_NOWHERE = 5e-3

VIEWS = views_around()
EMPTY = no_hull(VIEWS)


def ball(center: NDArray[np.float64], radius_m: float) -> Hull:
    return make_hull(VIEWS, ball_silhouettes(VIEWS, center, radius_m))


def balls(*centers_and_radii: tuple[NDArray[np.float64], float]) -> Hull:
    masks = [ball_silhouettes(VIEWS, center, radius) for center, radius in centers_and_radii]
    return make_hull(VIEWS, [np.maximum.reduce(each) for each in zip(*masks, strict=True)])


def assert_no_energy_from_nowhere(rows: list[Row]) -> None:
    """Nothing but weight, which is in the energy, and the hull, which tells its work."""
    energy = np.array([row.energy_j for row in rows])
    work = np.array([float(row.values["hull_work_j"]) for row in rows])
    given = np.abs(np.diff(work, prepend=0.0)).cumsum()
    # 1e-7 J lifts the lightest sheet here by a micrometre: rounding of sums of some joules is less.
    assert (energy <= work + FROM_NOWHERE * given + 1e-7).all()


# ---------------------------------------------------------------------------- without a hull


def test_a_sheet_without_pins_falls_as_everything_does() -> None:
    cloth = make_cloth(VIEWS, [sheet()], pin="none", damping_per_s=0.0)
    rest = sheet().vertices_world

    *_, last = drive(cloth, lambda _: EMPTY, 100)

    fallen_m = 0.5 * GRAVITY_M_S2 * last.time_s**2
    # Verlet is exact for a constant force; 1e-9 m is rounding.
    np.testing.assert_allclose(last.vertices_m, rest - [0, 0, fallen_m], rtol=0, atol=1e-9)
    assert abs(last.energy_j) < 1e-9
    assert last.values["kinetic_j"] > 0.1
    assert last.values["hull_work_j"] == 0.0


def test_drag_takes_speed_as_it_says() -> None:
    cloth = make_cloth(VIEWS, [sheet()], pin="none", damping_per_s=5.0)

    *_, last = drive(cloth, lambda _: EMPTY, 1000)

    # dv/dt = g - 5 v ends at g / 5; after 2 s e^-10 of the way is left: 5e-5,
    # twice that in energy.
    mass_kg = 0.2 * 0.6 * 0.75
    end_m_s = GRAVITY_M_S2 / 5.0
    assert last.values["kinetic_j"] == pytest.approx(0.5 * mass_kg * end_m_s**2, rel=2e-4)


def test_a_hanging_sheet_is_stretched_by_its_weight() -> None:
    height_m, stretch_n_m = 0.75, 200.0
    cloth = make_cloth(
        VIEWS, [sheet()], stretch_n_m=stretch_n_m, damping_per_s=20.0, inner_damping=0.5
    )

    *_, last = drive(cloth, lambda _: EMPTY, 1000)

    rest = sheet().vertices_world
    lowered_m = (rest - last.vertices_m)[rest[:, 2] < -0.3749, 2]
    # Strain at height z is the weight of what hangs below it, over the stiffness.
    expected_m = 0.2 * GRAVITY_M_S2 * height_m**2 / 2 / stretch_n_m
    # 10 %: springs along one diagonal hold more or less than a membrane, by Poisson's ratio.
    assert lowered_m.mean() == pytest.approx(expected_m, rel=0.1)
    assert np.ptp(lowered_m) < 0.1 * expected_m
    pinned = rest[:, 2] > 0.3749
    np.testing.assert_array_equal(last.vertices_m[pinned], rest[pinned])


@pytest.mark.slow
def test_a_sheet_at_rest_stays_at_rest_for_10_000_steps() -> None:
    cloth = make_cloth(VIEWS, [sheet((5, 6), fold_m=0.01)], damping_per_s=20.0, inner_damping=0.5)
    *_, settled = drive(cloth, lambda _: EMPTY, 1500)

    *_, last = drive(cloth, lambda _: EMPTY, 10_000)

    # A tenth of what the issue of effects allows a stack at rest.
    assert np.abs(last.vertices_m - settled.vertices_m).max() < 1e-5
    assert last.values["kinetic_j"] < 1e-12


def test_a_sheet_that_swings_keeps_its_energy() -> None:
    cloth = make_cloth(
        VIEWS, [tilted(sheet(), 40.0)], damping_per_s=0.0, inner_damping=0.0, pin="top"
    )

    rows = list(drive(cloth, lambda _: EMPTY, 1500))

    kinetic = np.array([row.values["kinetic_j"] for row in rows])
    energy = np.array([row.energy_j for row in rows])
    assert kinetic.max() > 0.05
    # 3 s, two swings: Verlet's energy errs by the square of the step, and does not drift.
    assert np.abs(energy).max() < 1e-3 * kinetic.max()


def tilted(flat: SceneObject, angle_deg: float) -> SceneObject:
    """Return a sheet turned about its top edge."""
    top = flat.vertices_world[:, 2].max()
    angle = np.radians(angle_deg)
    down = flat.vertices_world[:, 2] - top
    vertices = np.column_stack(
        [flat.vertices_world[:, 0], -np.sin(angle) * down, top + np.cos(angle) * down]
    )
    return thing("sheet", vertices, flat.faces)


def test_folds_that_are_at_rest_stay_folded_without_weight() -> None:
    folded = sheet((12, 4), fold_m=0.02)
    nodes = weld(folded.vertices_world, folded.faces, folded.vertices_world)
    springs = make_springs(nodes.nodes_world, nodes.faces, 500.0, 1e-3)
    turns = np.einsum("bk,bki->bi", springs.weights, nodes.nodes_world[springs.hinges])
    turned = nodes.nodes_world[springs.hinges] @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]])

    # At rest as it stands, wherever it stands: of a vector only the length counts.
    np.testing.assert_allclose(np.linalg.norm(turns, axis=1), springs.turn_m, atol=1e-12)
    again = np.einsum("bk,bki->bi", springs.weights, turned)
    np.testing.assert_allclose(np.linalg.norm(again, axis=1), springs.turn_m, atol=1e-12)
    assert springs.turn_m.max() > 0.01


def test_a_bend_costs_what_a_plate_costs() -> None:
    """Two squares at a right angle less a little: B / 2 times length times turn^2 over width."""
    flat = sheet((2, 1), (0.2, 0.1))
    nodes = weld(flat.vertices_world, flat.faces, flat.vertices_world)
    springs = make_springs(nodes.nodes_world, nodes.faces, 500.0, 1.0)
    assert springs.turn_m.max() < 1e-12
    angle = 1e-3
    bent = nodes.nodes_world.copy()
    right = bent[:, 0] > 0
    bent[right, 1] = angle * bent[right, 0]

    turns = np.einsum("bk,bki->bi", springs.weights, bent[springs.hinges])
    energy = 0.5 * float(springs.resistance @ (turns**2).sum(axis=1))

    # A plate of stiffness 1 J bent over a third of its two triangles' area: 3 l^2 / (2 A) angle^2.
    expected = 3.0 * 0.1**2 / (2 * 0.01) * angle**2
    assert energy == pytest.approx(expected, rel=1e-3)


# ---------------------------------------------------------------------------- in a hull


@pytest.mark.slow
@pytest.mark.parametrize("direction", [None, (0.0, 1.0, 0.0)])
def test_a_ball_that_comes_through_pushes_the_sheet_before_it(
    direction: tuple[float, float, float] | None,
) -> None:
    hung = sheet((10, 12), direction=direction)
    cloth = make_cloth(VIEWS, [hung])
    radius_m, speed_m_s = 0.06, 1.2

    def center(time_s: float) -> NDArray[np.float64]:
        return np.array([0.03, -0.15 + speed_m_s * time_s, -0.04])

    rows = list(drive(cloth, lambda time_s: ball(center(time_s), radius_m), 130))

    assert max(row.values["n_contacts"] for row in rows) > 0
    for row in rows:
        assert row.values["penetration_m"] <= LEFT_M
        assert deepest_m(row.hull, hung, row.vertices_m) <= LEFT_M
        # The hull of a ball is wider than it, where no camera looks along its rim, but has its
        # middle in the middle: all that is beside it is on the far side.
        middle = center(row.time_s)
        beside = np.hypot(*(row.vertices_m[:, [0, 2]] - middle[[0, 2]]).T) < radius_m
        assert (row.vertices_m[beside, 1] > middle[1]).all()
    assert rows[-1].vertices_m[:, 1].max() > 0.15
    assert_no_energy_from_nowhere(rows)


@pytest.mark.slow
def test_what_a_ball_pushes_goes_as_fast_as_it() -> None:
    """Without weight on it, a sheet in one piece would go faster only if it were thrown."""
    hung = sheet((10, 12), direction=(0.0, 1.0, 0.0))
    cloth = make_cloth(VIEWS, [hung], inner_damping=0.5)
    speed_m_s = 0.5

    rows = list(
        drive(cloth, lambda t: ball(np.array([0.0, -0.08 + speed_m_s * t, 0.0]), 0.06), 150)
    )

    at = int(np.hypot(*hung.vertices_world[:, [0, 2]].T).argmin())
    first = next(k for k, row in enumerate(rows) if row.values["n_contacts"] > 0)
    went_m = rows[-1].vertices_m[at, 1] - rows[first].vertices_m[at, 1]
    took_s = rows[-1].time_s - rows[first].time_s
    # Two pixels of 3.7 mm each: where the outline is at both ends.
    assert went_m / took_s == pytest.approx(speed_m_s, abs=2 * 0.0037 / took_s)


@pytest.mark.slow
@pytest.mark.parametrize("recovery", ["direction", "nearest"])
def test_a_half_space_pushed_against_a_pinned_sheet_has_its_nodes_on_its_plane(
    recovery: str,
) -> None:
    views = half_space_views()
    hung = sheet((8, 10), direction=(0.0, 1.0, 0.0))
    pins = [[-1e4, -1e4, 374.0, 1e4, 1e4, 376.0], [-1e4, -1e4, -376.0, 1e4, 1e4, -374.0]]
    cloth = make_cloth(views, [hung], pin=pins, recovery=recovery, damping_per_s=20.0)

    advanced = {}

    def hull_at(time_s: float) -> Hull:
        y_m = round(min(-0.02 + 0.5 * time_s, 0.04) / 0.0025) * 0.0025  # pixel by pixel
        if y_m not in advanced:
            advanced[y_m] = half_space(views, y_m)
        return advanced[y_m]

    *_, last = drive(cloth, hull_at, 300)

    free = np.abs(hung.vertices_world[:, 2]) < 0.37
    _, y, z = last.vertices_m[free].T
    # Pixels are those whose middle is in it, so that on a line between pixels it is the plane.
    beyond_m = y - 0.04 * (2.0 - z) / 2.0
    assert np.abs(beyond_m).max() < LEFT_M
    assert last.values["n_held"] > 0  # at the pins, which are in it


def test_what_hangs_on_pinned_nodes_stays_in_the_hull_and_is_told() -> None:
    hung = sheet(direction=(0.0, 1.0, 0.0))
    cloth = make_cloth(VIEWS, [hung])
    top = hung.vertices_world[:, 2] > 0.3749

    *_, last = drive(cloth, lambda _: ball(np.array([0.0, -0.03, 0.36]), 0.08), 30)

    np.testing.assert_array_equal(last.vertices_m[top], hung.vertices_world[top])
    assert last.values["n_held"] > 10
    assert last.values["penetration_m"] <= LEFT_M
    # It is what it says: in the hull there are samples of the top row's triangles only.
    assert deepest_m(last.hull, hung, last.vertices_m) > 0.01


def test_a_still_hull_does_no_work_on_a_sheet_that_leans_on_it() -> None:
    hung = tilted(sheet((10, 12)), 25.0)
    cloth = make_cloth(VIEWS, [hung], recovery="nearest")
    hull = ball(np.array([0.0, 0.02, -0.1]), 0.06)

    rows = list(drive(cloth, lambda _: hull, 600))

    assert sum(int(row.values["n_contacts"]) for row in rows) > 20
    work = np.array([float(row.values["hull_work_j"]) for row in rows])
    assert (np.diff(work) <= 1e-12).all()  # it only takes
    energy = np.array([row.energy_j for row in rows])
    assert energy.max() <= 1e-3 * np.abs(energy).max()


@pytest.mark.slow
def test_a_hull_without_an_end_near_moves_nothing_and_is_told() -> None:
    """Cameras that abstain see no background at all: the hull ends where none sees, metres away."""
    views = ring_views(4, 64, 48, 60.0, 8.0, unseen="keep")
    everything = make_hull(views, [np.ones((48, 64), np.uint8)] * 4)
    hung = sheet((3, 3), (0.2, 0.2), direction=(0.0, 1.0, 0.0))
    for recovery in ("direction", "nearest"):
        cloth = make_cloth(views, [hung], recovery=recovery)

        *_, last = drive(cloth, lambda _: everything, 3)

        assert last.values["displacement_m"] < 1e-3
        assert last.values["penetration_m"] > 1.0


# ---------------------------------------------------------------------------- when it is hard


def in_a_fist(time_s: float) -> Hull:
    near_m = max(0.12 - 0.5 * time_s, 0.035)
    return balls(
        (np.array([0.0, -near_m, 0.0]), 0.05),
        (np.array([0.0, near_m, 0.0]), 0.05),
    )


def appearing(time_s: float) -> Hull:
    return ball(np.array([0.0, 0.01, 0.0]), 0.08) if 0.1 < time_s < 0.2 else EMPTY


def flickering(time_s: float) -> Hull:
    is_there = round(time_s / (4 * STEP_S)) % 2 == 0
    return ball(np.array([0.02, -0.03, -0.05]), 0.06) if is_there else EMPTY


def leaping(time_s: float) -> Hull:
    """A second between two frames, in which a hand goes where it likes."""
    places = ([0.0, -0.03, 0.0], [0.1, 0.2, 0.1], [-0.1, 0.0, -0.2])
    return ball(np.array(places[int(time_s - STEP_S / 2) % 3]), 0.07)


@pytest.mark.slow
@pytest.mark.parametrize("recovery", ["direction", "nearest"])
@pytest.mark.parametrize(
    ("hull_at", "per_hull", "n_steps"),
    [(in_a_fist, 1, 250), (appearing, 4, 200), (flickering, 4, 300), (leaping, 500, 1200)],
)
def test_it_stays_sound_and_out_of_the_hull(
    recovery: str, hull_at: Callable[[float], Hull], per_hull: int, n_steps: int
) -> None:
    hung = sheet((10, 12), direction=(0.0, 1.0, 0.0))
    cloth = make_cloth(VIEWS, [hung], recovery=recovery)

    rows = list(drive(cloth, hull_at, n_steps, per_hull=per_hull))

    assert sum(int(row.values["n_contacts"]) for row in rows) > 0
    for row in rows:
        assert np.isfinite(row.vertices_m).all()
        assert row.values["penetration_m"] <= LEFT_M
    for row in rows[:: max(1, n_steps // 40)]:
        assert deepest_m(row.hull, hung, row.vertices_m) <= LEFT_M
    assert_no_energy_from_nowhere(rows)
    # No shred of it is anywhere else: 1.5 is more than threads bear, and what blew up is beyond it.
    edges = np.concatenate([hung.faces[:, [0, 1]], hung.faces[:, [1, 2]]])
    rest_m = np.linalg.norm(np.diff(hung.vertices_world[edges], axis=1)[:, 0], axis=1)
    end_m = np.linalg.norm(np.diff(rows[-1].vertices_m[edges], axis=1)[:, 0], axis=1)
    assert (end_m / rest_m).max() < 1.5


def test_a_sheet_that_blows_up_is_stopped_and_named() -> None:
    cloth = make_cloth(VIEWS, [sheet()])
    state = dict(cloth.state())
    state["sheet.velocities"][-1] = np.nan
    cloth.restore(state)

    with pytest.raises(UnstableError, match=r"cloth 'sheet' at 0\.002 s"):
        list(drive(cloth, lambda _: EMPTY, 1))


# ---------------------------------------------------------------------------- other CAD


@pytest.mark.slow
def test_a_sheet_falls_over_a_box_and_stays_there() -> None:
    mesh = box_mesh((240.0, 240.0, 200.0), 60.0)
    box = thing("box", mesh.vertices_mm / 1000.0, mesh.faces.astype(np.int32))
    flat = sheet((10, 10), (0.5, 0.5))
    lying = thing("sheet", flat.vertices_world[:, [0, 2, 1]] + [0.0, 0.0, 0.12], flat.faces)
    cloth = make_cloth(
        VIEWS, [lying, box], pin="none", friction=0.5, damping_per_s=5.0, thickness_mm=4.0
    )

    rows = list(drive(cloth, lambda _: EMPTY, 2000))

    on_top = (np.abs(lying.vertices_world[:, :2]) < 0.11).all(axis=1)
    last, before = rows[-1].vertices_m, rows[-500].vertices_m
    # On it by half its thickness, but for wrinkles: 0.1 mm is what it sinks in a step of 2 ms, and
    # more.
    assert last[on_top, 2].min() > 0.1 + 0.002 - 1e-4
    assert last[on_top, 2].max() < 0.1 + 0.002 + 5e-3
    assert np.median(last[on_top, 2]) < 0.1 + 0.002 + 1e-3
    np.testing.assert_allclose(last[on_top], before[on_top], atol=1e-4)  # in a second
    beside = (np.abs(last[:, :2]) > 0.13).any(axis=1)
    assert last[beside, 2].max() < 0.1
    inside = (np.abs(last[:, :2]) < 0.12).all(axis=1) & (last[:, 2] < 0.1)
    assert not inside.any()
    assert_no_energy_from_nowhere(rows)


def test_friction_decides_whether_it_slides_down_a_slope() -> None:
    mesh = box_mesh((800.0, 800.0, 100.0), 100.0)
    slope = np.radians(20.0)
    turn = np.array(
        [[np.cos(slope), 0, np.sin(slope)], [0, 1, 0], [-np.sin(slope), 0, np.cos(slope)]]
    )
    board = thing("board", mesh.vertices_mm / 1000.0 @ turn.T, mesh.faces.astype(np.int32))
    flat = sheet((4, 4), (0.2, 0.2)).vertices_world[:, [0, 2, 1]] + [-0.2, 0.0, 0.051]
    lying = thing("sheet", flat @ turn.T, sheet((4, 4)).faces)
    gone_m = {}
    for friction in (0.0, 0.2, 0.5):
        cloth = make_cloth(VIEWS, [lying, board], pin="none", friction=friction, damping_per_s=0.0)
        *_, last = drive(cloth, lambda _: EMPTY, 150)
        gone_m[friction] = float(((last.vertices_m - lying.vertices_world) @ turn)[:, 0].mean())

    # g (sin - mu cos) t^2 / 2; tan 20 degrees is 0.36.
    for friction in (0.0, 0.2):
        speeds_up = GRAVITY_M_S2 * (np.sin(slope) - friction * np.cos(slope))
        assert gone_m[friction] == pytest.approx(0.5 * speeds_up * 0.3**2, rel=0.03)
    assert abs(gone_m[0.5]) < 1e-4  # a tenth of a millimetre, for the first touch


# ---------------------------------------------------------------------------- as told


@pytest.mark.slow
@pytest.mark.parametrize("recovery", ["direction", "nearest"])
def test_it_goes_on_from_a_state_to_the_same_bits(recovery: str) -> None:
    hung = sheet((6, 8), direction=(0.0, 1.0, 0.0))
    mesh = ball_mesh(50.0, 1)
    post = thing("post", mesh.vertices_mm / 1000 + [0.0, 0.12, 0.0], mesh.faces.astype(np.int32))
    hulls = [ball(np.array([0.0, -0.09 + 0.003 * k, 0.0]), 0.05) for k in range(80)]

    def run(cloth: Any, start: int, n_steps: int) -> list[Row]:
        hull_at = iter(hulls[start : start + n_steps])
        return list(drive(cloth, lambda _: next(hull_at), n_steps, knows_before=False))

    first = make_cloth(VIEWS, [hung, post], recovery=recovery)
    run(first, 0, 40)
    state = {key: array.copy() for key, array in first.state().items()}
    went_on = run(first, 40, 40)
    second = make_cloth(VIEWS, [hung, post], recovery=recovery)
    second.restore(state)
    resumed = run(second, 40, 40)

    assert sum(int(row.values["n_contacts"]) for row in resumed) > 0
    for one, other in zip(went_on, resumed, strict=True):
        for key, value in one.values.items():
            np.testing.assert_array_equal(value, other.values[key])


def test_vertices_that_a_file_repeats_move_as_one() -> None:
    whole, soup = sheet((4, 5), fold_m=0.01), sheet((4, 5), fold_m=0.01, is_soup=True)
    turned = nudged(soup, np.array([0.1, 0.2, 0.3]) / 3)  # rounding parts what met
    cloth = make_cloth(VIEWS, [turned])

    *_, last = drive(cloth, lambda _: EMPTY, 50)

    assert cloth.told["sheet"].about["nodes"] == len(whole.vertices_world)
    assert last.vertices_m.shape == soup.vertices_world.shape
    *_, expected = drive(make_cloth(VIEWS, [whole]), lambda _: EMPTY, 50)
    corners = expected.vertices_m[whole.faces].reshape(-1, 3)
    np.testing.assert_allclose(
        last.vertices_m - np.array([0.1, 0.2, 0.3]) / 3, corners, rtol=0, atol=1e-9
    )


def test_a_scene_names_a_cloth_and_its_stl_is_welded(tmp_path: Path) -> None:
    write_stl(tmp_path / "curtain.stl", sheet_mesh((760, 840), (18, 20), 12, 3), "millimetres")
    path = tmp_path / "scene.toml"
    path.write_text(
        """
format = "hybridve-scene"
version = 1
[[object]]
name = "curtain"
mesh = "curtain.stl"
unit = "mm"
translate_mm = [370, 260, 720]
rotate_deg = [0, 0, 30]
recovery_direction = [0, 1, 0]
[[effect]]
kind = "cloth"
object = "curtain"
pin = "top"
""",
        encoding="utf-8",
    )
    scene = load_scene(path)
    found = read_entries(scene)
    claimed = frozenset(found[0][0].table.claimed)
    setting = Setting(scene, claimed, VIEWS, Native(1), step_s=STEP_S, frame_s=1 / 60)

    ((effect, entries),) = make_effects(found, setting)

    assert [entry.name for entry in entries] == ["curtain"]
    about = effect.told["curtain"].about
    assert (about["nodes"], about["triangles"], about["pinned_nodes"]) == (399, 720, 19)
    turned = [-np.sin(np.radians(30.0)), np.cos(np.radians(30.0)), 0.0]
    np.testing.assert_allclose(about["recovery_direction"], turned, atol=1e-12)
    for step in range(3):
        effect.advance(Instant((step + 1) * STEP_S, EMPTY, EMPTY, STEP_S, 0), STEP_S)
    vertices_m = effect.values(None)["curtain"]["vertices_m"]
    assert vertices_m.shape == scene.objects[0].vertices_world.shape
    # Corners that met in the file still meet.
    assert len(np.unique(vertices_m[scene.objects[0].faces].reshape(-1, 3), axis=0)) == 399


def test_a_vertex_that_no_triangle_uses_stays() -> None:
    flat = sheet((4, 5))
    vertices = np.vstack([flat.vertices_world, [[1.0, 2.0, 3.0]]])
    cloth = make_cloth(VIEWS, [thing("sheet", vertices, flat.faces)])

    *_, last = drive(cloth, lambda _: EMPTY, 5)

    np.testing.assert_array_equal(last.vertices_m[-1], [1.0, 2.0, 3.0])


def test_it_tells_what_it_was_resolved_to() -> None:
    cloth = make_cloth(VIEWS, [sheet(direction=(0.0, 1.0, 0.0))], mass_kg=0.3)
    told = cloth.told["sheet"]

    assert told.about["mass_kg"] == pytest.approx(0.3)
    assert told.about["areal_density_kg_m2"] == pytest.approx(0.3 / 0.45)
    assert told.about["recovery"] == "direction"
    assert told.about["pinned_nodes"] == 9
    assert told.drawn is not None
    assert told.drawn.column == "vertices_m"
    values = cloth.values(None)["sheet"]
    for column in told.columns:
        assert values[column.name].shape == column.shape
        assert values[column.name].dtype == column.dtype


def test_points_and_boxes_pin_nodes() -> None:
    cloth = make_cloth(VIEWS, [sheet()], pin=[[-300, 0, 375], [0, -5, 370, 400, 5, 380]])

    *_, last = drive(cloth, lambda _: EMPTY, 20)

    rest = sheet().vertices_world
    stays = (last.vertices_m == rest).all(axis=1)
    expected = (rest[:, 2] > 0.37) & ((rest[:, 0] < -0.29) | (rest[:, 0] > -0.01))
    np.testing.assert_array_equal(stays, expected)


def test_the_bound_of_steps_holds_and_is_not_far_off() -> None:
    nodes = weld(sheet().vertices_world, sheet().faces, sheet().vertices_world)
    springs = make_springs(nodes.nodes_world, nodes.faces, 500.0, 0.0)
    inverse_mass = np.full(len(nodes.nodes_world), 1.0 / 2e-4)
    stiffness = np.zeros((len(inverse_mass), len(inverse_mass)))
    for (i, j), k in zip(springs.ends, springs.stiffness, strict=True):
        stiffness[[i, j], [i, j]] += k
        stiffness[[i, j], [j, i]] -= k
    true = np.sqrt(np.linalg.eigvalsh(stiffness).max() / 2e-4)

    bound = highest_frequency(springs, inverse_mass)

    assert true <= bound < 1.5 * true
    assert longest_step(bound, 0.0) < 2.0 / true


# ---------------------------------------------------------------------------- bad scenes


def closed() -> SceneObject:
    mesh = box_mesh((200.0, 200.0, 200.0), 100.0)
    return thing("sheet", mesh.vertices_mm / 1000.0, mesh.faces.astype(np.int32))


def three_wings() -> SceneObject:
    vertices = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [-1, 1, 0], [-1, -1, 0.0]])
    return thing("sheet", vertices, np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]], np.int32))


def with_a_sliver() -> SceneObject:
    flat = sheet((2, 2))
    return thing("sheet", flat.vertices_world, np.vstack([flat.faces, [[0, 1, 1]]]))


def lying_flat() -> SceneObject:
    flat = sheet()
    return thing("sheet", flat.vertices_world[:, [0, 2, 1]], flat.faces)


@pytest.mark.parametrize(
    ("sheets", "keys", "message"),
    [
        ([nudged(sheet(), np.ones(3))], {"object": "curtian"}, "no object 'curtian'; the scene"),
        ([closed()], {}, "effect.1.object: 'sheet' is no sheet: it has no border"),
        ([three_wings()], {}, "1 of its edges are used by more than two triangles"),
        ([with_a_sliver()], {}, "'sheet' is no sheet: its triangle 8 has no area"),
        ([sheet()], {"pin": [[-999, -999, -999, 999, 999, 999]]}, "all 99 nodes .* are pinned"),
        ([sheet()], {"pin": [[0, 500, 0]]}, r"pin.1: point .* is 500 mm from the sheet"),
        ([sheet()], {"pin": [[0, 5, 0, 10, 9, 10]]}, r"pin.1: box .* holds no node"),
        ([lying_flat()], {}, "effect.1.pin: the sheet lies flat, so that it has no top"),
        ([sheet()], {"recovery": "direction"}, "'sheet' has no recovery_direction"),
        ([sheet()], {"stretch_n_m": 1e9}, r"steps of 2 ms are too long .* they bear 0\.\d+ ms"),
    ],
)
def test_a_bad_scene_is_one_clear_line(
    sheets: list[SceneObject], keys: dict[str, Any], message: str
) -> None:
    with pytest.raises(SceneError, match=message) as error:
        make_cloth(VIEWS, sheets, **{"object": "sheet", **keys})

    assert str(error.value).startswith("scene.toml: effect.1.")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "keys",
    [
        {"mass_kg": 0.0},
        {"mass_kg": -1.0},
        {"areal_density_kg_m2": 0.0},
        {"mass_kg": 1.0, "areal_density_kg_m2": 1.0},
        {"pin": []},
        {"pin": "left"},
        {"pin": [[0, 0]]},
        {"stretch_n_m": 0},
        {"bending_uj": -1},
        {"friction": -0.1},
        {"inner_damping": 2},
        {"recovery": "up"},
        {"colour": "red"},
    ],
)
def test_a_bad_key_is_refused(keys: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        make_cloth(VIEWS, [sheet()], **keys)


def test_the_step_that_is_named_is_borne() -> None:
    with pytest.raises(SceneError) as error:
        make_cloth(VIEWS, [sheet()], stretch_n_m=1e7)
    longest_s = float(str(error.value).split("bear ")[1].split(" ms")[0]) / 1000.0

    cloth = make_cloth(VIEWS, [sheet()], stretch_n_m=1e7, step_s=0.99 * longest_s)

    rows = list(drive(cloth, lambda _: EMPTY, 20, step_s=0.99 * longest_s))
    assert np.isfinite(rows[-1].energy_j)
