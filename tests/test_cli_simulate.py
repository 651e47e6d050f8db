"""``hybridve simulate`` with every effect that comes with it, on one recording of a ball."""

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.sessions import write_ball_session, write_cube_scene

from hybridve.hull.report.simulation_file import read_simulation

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
    groups = read_simulation(path).groups
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


def test_cad_that_moves_is_refused_by_name(
    run: Run, tmp_path: Path, session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = write_scene(tmp_path, '\n[[effect]]\nkind = "cloth"\nobject = "sheet"\n')
    (tmp_path / "door.csv").write_text("frame,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n")
    text = scene.read_text(encoding="utf-8").replace(
        'name = "door"', 'name = "door"\nposes = "door.csv"'
    )
    scene.write_text(text, encoding="utf-8")

    assert run("simulate", session, "--scene", scene, "-o", tmp_path / "sim.h5") == 1

    assert "object 'door' moves as a file says" in capsys.readouterr().err
