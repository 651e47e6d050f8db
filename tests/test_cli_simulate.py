"""``hybridve simulate`` with every effect that comes with it, on one recording of a ball."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.motions import angles_csv
from helpers.sessions import write_ball_session, write_cube_scene
from scipy.spatial.transform import Rotation
from vtkmodules.vtkIOHDF import vtkHDFReader

from hybridve.calib.pose import placed
from hybridve.hull.effects.instants import instants
from hybridve.hull.query.silhouettes import make_hull, make_views
from hybridve.hull.report.simulation_file import read_simulation
from hybridve.hull.show_simulation import drawn_objects

Run = Callable[..., int]

#: The ball of 0.2 m comes along x and stops.
CENTERS = np.column_stack([np.linspace(-0.45, 0.0, 7), np.zeros((7, 2))])

SHEET = "".join(
    f"v 150 {100 * column - 200} {100 * row - 200}\n" for row in range(5) for column in range(5)
) + "".join(
    f"f {5 * row + column + 1} {5 * row + column + 2} {5 * row + column + 6}\n"
    f"f {5 * row + column + 2} {5 * row + column + 7} {5 * row + column + 6}\n"
    for row in range(4)
    for column in range(4)
)

EFFECTS = """
[[effect]]
kind = "rigid"
object = "box"
mass_kg = 0.5
gravity = false

[[effect]]
kind = "hinge"
object = "door"
density_kg_m3 = 100
axis = [0, 0, 1]
anchor_mm = [0, 100, 0]

[[effect]]
kind = "cloth"
object = "sheet"

[[effect]]
kind = "particles"
count = 200
source_mm = [-100, -100, 300, 100, 100, 350]
lifetime_s = 5

[[effect]]
kind = "light"
lamp_mm = [0, -300, 900]
power_lm = 800
objects = ["ground"]

[[effect]]
kind = "shadow"
lamp_mm = [0, 300, 900]
objects = ["ground"]

[[effect]]
kind = "proximity"
object = "ground"
zones_mm = [400, 150]
"""


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ball_session(tmp_path_factory.mktemp("ball"), CENTERS, n_cameras=6)


def write_scene(folder: Path, effects: str = EFFECTS) -> Path:
    places = {"box": (250.0, 0.0, 0.0), "door": (0.0, 450.0, 0.0), "ground": (0.0, 0.0, -500.0)}
    path = write_cube_scene(folder, places)
    (folder / "sheet.obj").write_text(SHEET, encoding="utf-8")
    text = path.read_text(encoding="utf-8")
    sheet = '\n[[object]]\nname = "sheet"\nmesh = "sheet.obj"\nunit = "mm"\n'
    path.write_text(text + sheet + effects, encoding="utf-8")
    return path


@pytest.mark.slow
def test_the_same_call_gives_the_same_but_for_timings(
    run: Run, tmp_path: Path, session: Path
) -> None:
    scene = write_scene(tmp_path)
    found: list[dict[str, np.ndarray]] = []
    for name in ("one.h5", "two.h5"):
        path = tmp_path / name
        assert run("simulate", session, "--scene", scene, "-o", path, "--frames", "2:6") == 0
        columns: dict[str, np.ndarray] = {}
        with h5py.File(path) as file:
            for group in file["hybridve/effects"].values():
                for key, values in group.items():
                    if isinstance(values, h5py.Dataset) and key != "step_s":
                        columns[f"{group.name}/{key}"] = values[()]
        found.append(columns)

    assert found[0].keys() == found[1].keys()
    assert len(found[0]) > 40
    for key, values in found[0].items():
        np.testing.assert_array_equal(values, found[1][key], err_msg=key)


@pytest.mark.slow
def test_every_effect_meets_the_ball_and_tells_it(
    run: Run, tmp_path: Path, session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, path = write_scene(tmp_path), tmp_path / "sim.h5"

    assert run("simulate", session, "--scene", scene, "-o", path, "--json") == 0

    told = json.loads(capsys.readouterr().out)
    assert [one["kind"] for one in told["effects"]] == [
        "rigid", "hinge", "cloth", "particles", "light", "shadow", "proximity",
    ]  # fmt: skip
    assert set(told["solvers"]) >= {"mujoco-core"}
    simulation = read_simulation(path)
    groups = simulation.groups
    # What a lamp shines on is drawn once, each triangle as bright as the lamps reach it.
    drawn = {one.name: one for one in drawn_objects(simulation, len(simulation.index) - 1)}
    assert set(drawn) == {"box", "door", "sheet", "ground"}
    reached = [groups[name].values["share_lit"][-1] for name in ("light", "shadow")]
    np.testing.assert_array_equal(drawn["ground"].share_lit, np.maximum(*reached))
    assert drawn["box"].share_lit is None
    # The hull reaches at least as far as the ball, 0.2 m, where the box began at 0.15 m.
    assert groups["box"].values["position_m"][-1, 0] >= 0.2 + 0.1 - 0.003
    assert groups["box"].values["hull_work_j"][-1] > 0
    # Beside the ball, which is 0.15 m away, the door hangs still.
    np.testing.assert_allclose(groups["door"].values["angle_rad"], 0.0, atol=1e-9)
    assert groups["sheet"].values["penetration_m"].max() <= 1e-3
    assert groups["sheet"].values["displacement_m"][-1] > 0.02
    # The ball comes under the drops, which are above it; none is let in.
    drops = groups["particles"].values
    assert drops["n_deflected"][-1].sum() > 0
    assert drops["penetration_m"].max() == 0.0
    lit = groups["shadow"].values
    # A lamp above and beside the ball: what it shades of the ground is no longer lit.
    assert lit["shaded_m2"][-1, 0] > 0
    np.testing.assert_allclose(
        lit["lit_m2"][:, 0] + lit["shaded_m2"][:, 0],
        lit["lit_m2"][0, 0] + lit["shaded_m2"][0, 0],
        rtol=1e-6,
    )
    assert np.isfinite(groups["light"].values["illuminance_lx"]).all()
    bounds_m = groups["ground.proximity"].values["clearance_m"]
    # From the ground's top at -0.4 m to the lowest point of the ball at -0.2 m; the hull of six
    # cameras from above bulges downwards.
    assert bounds_m[-1, 0] <= 0.2 + 1e-6
    assert (bounds_m[:, 0] <= bounds_m[:, 1]).all()
    with h5py.File(path) as file:
        every = [file[f"hybridve/effects/{name}/n_contacts"] for name in groups]
        assert all(one.attrs["unit"] == "1" and one.attrs["description"] for one in every)


BAD = {
    'kind = "rigid"\nobject = "bax"\nmass_kg = 1': "effect.1.object: there is no object 'bax'",
    'kind = "rigid"\nobject = "box"\nmass_kg = 0': "effect.1.mass_kg: Input should be greater",
    'kind = "rigid"\nobject = "box"\nmass_kg = -1': "effect.1.mass_kg: Input should be greater",
    'kind = "rigid"\nobject = "box"': "mass_kg",
    'kind = "hinge"\nobject = "door"\nmass_kg = 1\naxis = [0, 0, 0]\nanchor_mm = [0, 0, 0]': "axis",
    'kind = "hinge"\nobject = "door"\nmass_kg = 1\naxis = [0, 0, 1]\nanchor_mm = [9e4, 0, 0]': (
        "effect.1.anchor_mm"
    ),
    'kind = "cloth"\nobject = "box"': "effect.1.object",
    'kind = "cloth"\nobject = "sheet"\npin = [[-500, -500, -500, 500, 500, 500]]': "effect.1.pin",
    'kind = "cloth"\nobject = "sheet"\nmass_kg = 0': "effect.1.mass_kg",
    'kind = "rigid"\nobject = "box"\nmass_kg = 1\n[[effect]]\nkind = "hinge"\nobject = "box"\n'
    "mass_kg = 1\naxis = [0, 0, 1]\nanchor_mm = [0, 0, 0]": (
        "effect.2.object: 'box' is moved by effect.1 already"
    ),
    'kind = "particles"\nsource_mm = [9e4, 0, 0]': "effect.1.source_mm",
    'kind = "particles"\ncount = 0\nsource_mm = [0, 0, 300]': "effect.1.count",
    'kind = "light"\nlamp_mm = [0, 0, -500]\npower_lm = 1': "the lamp is inside of 'ground'",
    'kind = "proximity"\nobject = "ground"\nzones_mm = [5, 20]': "effect.1.zones_mm",
    'kind = "rigid"\nobject = "box"\nmas_kg = 1': "did you mean mass_kg?",
}


@pytest.mark.parametrize("text", BAD)
def test_a_bad_effect_is_one_line_and_leaves_nothing(
    run: Run, tmp_path: Path, session: Path, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = write_scene(tmp_path, f"\n[[effect]]\n{text}\n")

    assert run("simulate", session, "--scene", scene, "-o", tmp_path / "sim.h5") == 1

    # That the sheet is open, which it has to be, is told before.
    told = capsys.readouterr().err.splitlines()
    (line,) = (one for one in told if "open edges" not in one)
    assert BAD[text] in line
    assert str(scene) in line
    assert list(tmp_path.glob("sim.h5*")) == []


def test_a_step_that_the_stiffness_cannot_bear_is_refused_with_the_longest(
    run: Run, tmp_path: Path, session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = 'kind = "cloth"\nobject = "sheet"\nstretch_n_m = 1e9\n'
    scene = write_scene(tmp_path, f"\n[[effect]]\n{text}")

    assert run("simulate", session, "--scene", scene, "-o", tmp_path / "sim.h5") == 1

    assert "stretch_n_m" in capsys.readouterr().err


#: A block turns on a hinge and pushes a box; whatever else is simulated meets or tells of it.
MOVING = """
[[object]]
name = "board"
mesh = "cube.obj"
unit = "mm"
translate_mm = [0, -420, 300]
hinge = { axis = [0, 0, 1], anchor_mm = [-300, 0, 0], angles = "angles.csv" }

[[effect]]
kind = "rigid"
object = "box"
mass_kg = 0.5
gravity = false
restitution = 1.0

[[effect]]
kind = "cloth"
object = "sheet"

[[effect]]
kind = "particles"
count = 50
source_mm = [-100, -300, 300, 100, -250, 350]
lifetime_s = 5

[[effect]]
kind = "shadow"
lamp_mm = [0, 300, 1200]
objects = ["ground", "board", "box"]

[[effect]]
kind = "proximity"
object = "board"
zones_mm = [400, 150]
"""


def write_moving_scene(folder: Path, angles_deg: dict[int, float]) -> Path:
    scene = write_scene(folder, MOVING)
    (folder / "angles.csv").write_text(angles_csv(angles_deg), encoding="utf-8")
    text = scene.read_text(encoding="utf-8").replace("translate_mm = [250.0", "translate_mm = [0.0")
    scene.write_text(text.replace("[0.0, 0.0, 0.0]", "[0, -180, 300]"), encoding="utf-8")
    return scene


@pytest.mark.slow
def test_cad_that_moves_is_met_told_of_drawn_and_paused_without_a_pose(
    run: Run, tmp_path: Path, session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    angles = {0: 0.0, 1: 4.0, 2: 8.0, 3: 12.0, 5: 20.0, 6: 24.0}
    scene, whole, cut = write_moving_scene(tmp_path, angles), tmp_path / "w.h5", tmp_path / "c.h5"

    assert run("simulate", session, "--scene", scene, "-o", whole) == 0

    found = read_simulation(whole)
    assert [bool(reason) for reason in found.reason] == [frame == 4 for frame in range(7)]
    assert found.reason[4] == "no pose of object 'board' in frame 4"
    assert found.n_steps[4] == 0
    ((name, mesh, _, poses),) = found.moving
    assert name == "board"
    assert np.isnan(poses[4]).all()
    hinge = np.array([-0.3, -0.42, 0.3])
    for frame, angle_deg in angles.items():
        turn = Rotation.from_rotvec([0, 0, angle_deg], degrees=True).as_matrix()
        expected = (mesh + np.array([0.3, 0, 0])) @ turn.T + hinge
        there = mesh @ poses[frame, :, :3].T + poses[frame, :, 3]
        np.testing.assert_allclose(there, expected, atol=1e-9)
        told = found.groups["board.proximity"].values["vertices_m"][frame]
        np.testing.assert_allclose(told, expected, atol=1e-9)
        (drawn,) = (one for one in drawn_objects(found, frame) if one.name == "board")
        np.testing.assert_allclose(drawn.vertices_world, expected, atol=1e-9)
        np.testing.assert_allclose(shown_by_vtk(whole, "board", frame), expected, atol=1e-6)
    assert "board" not in [one.name for one in drawn_objects(found, 4)]
    assert len(shown_by_vtk(whole, "board", 4)) == 0
    box = found.groups["box"].values
    assert box["velocity_m_s"][-1, 1] > 0.5
    assert box["cad_work_j"][-1] > 0.0
    # The shadow is told of the box where the simulation has it.
    shadow = found.groups["shadow"]
    shown = found.groups["box"].shown
    assert shown is not None
    assert shown.vertices is not None
    moved = placed(shown.vertices, box["world_from_mesh"][-1])
    np.testing.assert_allclose(shadow.values["vertices_m"][-1, -8:], moved, atol=1e-9)

    monkeypatch.setattr("hybridve.hull.report.simulation_file._PART_FRAMES", 3)
    break_at(monkeypatch, 5)
    assert run("simulate", session, "--scene", scene, "-o", cut) == 130
    monkeypatch.undo()
    assert run("simulate", session, "--scene", scene, "-o", cut, "--resume") == 0
    with h5py.File(whole) as one, h5py.File(cut) as other:
        columns = datasets(one)
        assert len(columns) > 40
        for key, values in columns.items():
            np.testing.assert_array_equal(values, other[key][()], err_msg=key)


def shown_by_vtk(path: Path, name: str, step: int) -> np.ndarray:
    """Return the points (V, 3) that VTK shows of an object in a step, in the world."""
    with h5py.File(path) as file:
        label = next(key for key, one in file["VTKHDF"].items() if one.attrs.get("object") == name)
        index = int(file["VTKHDF"][label].attrs["Index"])
        origin_m = file["hybridve/settings/local_origin_m"][:]
    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    reader.SetStep(step)
    reader.Update()
    blocks = reader.GetOutputDataObject(0)
    shown = blocks.GetPartition(index, 0)
    xyz_m = np.array([shown.GetPoint(i) for i in range(shown.GetNumberOfPoints())])
    return np.asarray(xyz_m.reshape(-1, 3) + origin_m)


def datasets(file: h5py.File) -> dict[str, np.ndarray]:
    """Return all that is told of effects and of CAD that moves, but timings."""
    found: dict[str, np.ndarray] = {}

    def visit(name: str, item: h5py.HLObject) -> None:
        if isinstance(item, h5py.Dataset) and not name.endswith("step_s"):
            found[f"hybridve/{name}"] = item[()]

    file["hybridve/effects"].visititems(lambda name, item: visit(f"effects/{name}", item))
    file["hybridve/moving"].visititems(lambda name, item: visit(f"moving/{name}", item))
    return found


def break_at(monkeypatch: pytest.MonkeyPatch, frame: int) -> None:
    """Interrupt the simulation in a frame."""

    def broken(*hulls: Any, **keys: Any) -> Any:
        if keys["frame"] == frame:
            raise KeyboardInterrupt
        return instants(*hulls, **keys)

    monkeypatch.setattr("hybridve.hull.simulate.instants", broken)


def test_cameras_side_by_side_follow_what_moves_between_frames() -> None:
    # Their axes are parallel, and meet nowhere: how large a pixel is, no geometry tells.
    matrix = np.array([[200.0, 0, 80, 0], [0, 200, 60, 0], [0, 0, 1, 0]])
    beside = matrix @ np.array([[1.0, 0, 0, -0.2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    views = make_views(("left", "right"), np.array([[160, 120]] * 2), np.array([matrix, beside]))
    mask = np.zeros((120, 160), np.uint8)
    mask[40:70, 30:60] = 1
    before, after = (
        make_hull(views, [np.roll(mask, shift_px, axis=1)] * 2) for shift_px in (0, 40)
    )

    way = instants(
        before, after, start_s=0.0, elapsed_s=0.04, frame=1, step_s=0.002, mode="interpolate"
    )

    # 40 pixels of 15 mm, 3 m away: as often as once in 8 mm, and never more than 64 times.
    assert len(list(way)) == 64
