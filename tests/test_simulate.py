"""``hybridve simulate`` with an effect of somebody else's: frames, steps, hulls, files."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from helpers import toy_effect
from helpers.sessions import BALL_RADIUS_M, write_ball_session, write_cube_scene

from hybridve.hull.report.simulation_file import read_simulation
from hybridve.hull.report.simulation_sweep import read_simulation_sweep

Run = Callable[..., int]

#: The ball comes along x; 25 frames a second, 0.1 m from one to the next.
CENTERS = np.column_stack([np.linspace(-0.6, 0.6, 13), np.zeros(13), np.zeros(13)])
FRAME_S = 1 / 25

#: Half the edge of the cube.
HALF_M = 0.1


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ball_session(tmp_path_factory.mktemp("ball"), CENTERS, n_cameras=6)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = write_cube_scene(
        tmp_path_factory.mktemp("cubes"), {"box": (0, 0, 0), "far": (0, 0, 900)}
    )
    path.write_text(
        path.read_text(encoding="utf-8") + '\n[[effect]]\nkind = "dwell"\nobject = "box"\n',
        encoding="utf-8",
    )
    return path


@pytest.fixture(scope="module")
def toy_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy_effect.install(tmp_path_factory.mktemp("toy"))


@pytest.fixture
def toy(toy_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The package is installed."""
    monkeypatch.syspath_prepend(str(toy_folder))


def datasets(path: Path) -> dict[str, np.ndarray]:
    """Return every dataset of a file but timings."""
    found: dict[str, np.ndarray] = {}

    def visit(name: str, item: h5py.HLObject) -> None:
        if isinstance(item, h5py.Dataset) and not name.endswith("step_s") and "stage_s" not in name:
            found[name] = item[()]

    with h5py.File(path) as file:
        file.visititems(visit)
    return found


@pytest.mark.slow
@pytest.mark.usefixtures("toy")
def test_an_installed_effect_is_simulated_for_the_time_of_the_recording(
    run: Run, tmp_path: Path, session: Path, scene: Path
) -> None:
    path = tmp_path / "sim.h5"

    assert run("simulate", session, "--scene", scene, "-o", path, "--step-ms", 5) == 0

    found = read_simulation(path)
    group = found.groups["dwell"]
    # The first frame shows the state that the scene gives; 40 ms are 8 steps of 5 ms at least.
    assert found.n_steps[0] == 0
    assert (found.n_steps[1:] >= 8).all()
    assert (found.n_steps[1:] % found.n_hulls[1:] == 0).all()
    np.testing.assert_allclose(group.values["simulated_s"], FRAME_S * np.arange(13), atol=1e-12)
    # The ball moves at 2.5 m/s. A hull of six cameras holds the ball and little more: the time in
    # which it meets the cube's surface is that of the ball's way, within a step and what a pixel
    # of 15 mm, and the hull beside the ball, add on either side.
    way_m = 2 * (BALL_RADIUS_M + HALF_M)
    seconds = group.values["dwell_s"][-1]
    speed_m_s = 0.1 / FRAME_S
    assert way_m / speed_m_s - 0.01 <= seconds <= (way_m + 0.06) / speed_m_s + 0.01
    assert group.about["kind"] == "dwell"
    assert found.settings["solvers"] == {"toy": "1.0"}


@pytest.mark.slow
@pytest.mark.usefixtures("toy")
def test_hulls_between_frames_follow_the_motion_and_are_held_when_asked(
    run: Run, tmp_path: Path, session: Path, scene: Path
) -> None:
    for mode in ("interpolate", "hold"):
        path = tmp_path / f"{mode}.h5"
        assert run("simulate", session, "--scene", scene, "-o", path, "--hull", mode) == 0
        found = read_simulation(path)
        if mode == "hold":
            assert (found.n_hulls[1:] == 1).all()
        else:
            # 0.1 m a frame; no more than 8 mm from one hull to the next as pixels of 15 mm tell
            # it, in the middle of what the cameras see.
            assert (found.n_hulls[1:] >= 6).all()


@pytest.mark.slow
@pytest.mark.usefixtures("toy")
def test_a_run_that_was_cut_off_goes_on_to_the_same_bits(
    run: Run,
    tmp_path: Path,
    session: Path,
    scene: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("hybridve.hull.report.simulation_file._PART_FRAMES", 3)
    whole, cut = tmp_path / "whole.h5", tmp_path / "cut.h5"
    common = ("simulate", session, "--scene", scene, "-o")
    assert run(*common, whole) == 0
    monkeypatch.setenv("TOY_FAILS", "interrupt 8")
    assert run(*common, cut) == 130
    assert not cut.exists()
    monkeypatch.delenv("TOY_FAILS")

    assert run(*common, cut) == 1
    assert "--resume" in capsys.readouterr().err
    monkeypatch.setenv("TOY", "1.1")
    assert run(*common, cut, "--resume") == 1
    assert "had toy 1.0, this is toy 1.1" in capsys.readouterr().err
    monkeypatch.delenv("TOY")
    assert run(*common, cut, "--resume", "--seed", 1) == 1
    assert "other settings" in capsys.readouterr().err
    assert run(*common, cut, "--resume") == 0

    first, second = datasets(whole), datasets(cut)
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)
    assert not cut.with_name("cut.h5.parts").exists()


@pytest.mark.usefixtures("toy")
def test_what_blows_up_is_stopped_named_and_what_was_good_is_kept(
    run: Run,
    tmp_path: Path,
    session: Path,
    scene: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "sim.h5"
    monkeypatch.setenv("TOY_FAILS", "unstable 4")

    assert run("simulate", session, "--scene", scene, "-o", path, "--frames", ":6") == 1

    assert "frame 4: dwell: the toy was told to break" in capsys.readouterr().err
    found = read_simulation(path)
    assert found.index.tolist() == [0, 1, 2, 3, 4]
    assert found.groups["dwell"].values["simulated_s"][3] == pytest.approx(3 * FRAME_S)
    assert run("summary", path) == 0
    assert "stopped: frame 4: dwell" in capsys.readouterr().out


@pytest.mark.usefixtures("toy")
def test_a_frame_without_a_hull_is_a_pause_with_its_reason(
    run: Run, tmp_path: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = write_ball_session(tmp_path / "gap", CENTERS[:5], n_cameras=3)
    (tmp_path / "gap" / "cam1" / "2.png").write_bytes(b"not a picture")
    path = tmp_path / "sim.h5"

    assert run("simulate", session, "--scene", scene, "-o", path, "--json") == 0

    found = read_simulation(path)
    assert "cam1" in found.reason[2]
    assert found.n_steps[2] == 0
    # Nothing goes on in a pause; after it the hull is held, for nobody knows where it was.
    simulated_s = found.groups["dwell"].values["simulated_s"]
    np.testing.assert_allclose(simulated_s / FRAME_S, [0, 1, 1, 2, 3], atol=1e-12)
    assert found.n_hulls[3] == 1
    assert json.loads(capsys.readouterr().out)["frames_paused"] == 1


@pytest.mark.usefixtures("toy")
def test_the_file_opens_in_vtk_and_its_mesh_moves(
    run: Run, tmp_path: Path, session: Path, scene: Path
) -> None:
    from vtkmodules.vtkIOHDF import vtkHDFReader

    path = tmp_path / "sim.h5"
    drifting = tmp_path / "scene.toml"
    text = scene.read_text(encoding="utf-8").replace('"cube.obj"', f'"{scene.parent}/cube.obj"')
    roots = f'roots = ["{scene.parent}"]\n'
    drifting.write_text(roots + text + "drift_m_s = 2.0\n", encoding="utf-8")
    assert run("simulate", session, "--scene", drifting, "-o", path, "--frames", ":4") == 0

    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    for step in (0, 3):
        reader.SetStep(step)
        reader.Update()
        blocks = reader.GetOutputDataObject(0)
        moved = blocks.GetPartition(0, 0)
        xyz_m = np.array([moved.GetPoint(i) for i in range(moved.GetNumberOfPoints())])
        assert xyz_m[:, 0].max() == pytest.approx(HALF_M + 2.0 * step * FRAME_S, abs=1e-6)
        # What no effect moves stands beside it, for all frames: the box, for the toy moves none.
        still = blocks.GetPartition(2, 0)
        far_m = np.array([still.GetPoint(i) for i in range(still.GetNumberOfPoints())])
        assert far_m[:, 2].min() == pytest.approx(0.8, abs=1e-6)


BAD_EFFECTS = {
    'kind = "levitate"\nobject = "box"': "effect.1.kind: there is no effect 'levitate'; there are "
    "rigid, hinge, cloth, particles, shadow, light, proximity, dwell",
    'kind = "dwell"\nobject = "bax"': "effect.1.object: there is no object 'bax'; the scene has "
    "box, far",
    'kind = "dwell"\nobject = "box"\ncolour = 1': "effect.1.colour: there is no such key",
    'kind = "dwell"': "effect.1.object: this key is missing",
    'kind = "dwell"\nobject = "box"\n[[effect]]\nkind = "dwell"\nobject = "far"': "effect.2.name: "
    "'dwell' is what effect.1 is called too",
}


@pytest.mark.usefixtures("toy")
@pytest.mark.parametrize("text", BAD_EFFECTS)
def test_a_bad_effect_is_one_line(
    run: Run, tmp_path: Path, session: Path, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = write_cube_scene(tmp_path, {"box": (0, 0, 0), "far": (0, 0, 900)})
    scene.write_text(
        scene.read_text(encoding="utf-8") + "\n[[effect]]\n" + text + "\n", encoding="utf-8"
    )

    assert run("simulate", session, "--scene", scene, "-o", tmp_path / "sim.h5") == 1

    (line,) = capsys.readouterr().err.strip().splitlines()
    assert BAD_EFFECTS[text] in line
    assert list(tmp_path.glob("sim.h5*")) == []


def test_a_scene_without_effects_has_nothing_to_simulate(
    run: Run, tmp_path: Path, session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = write_cube_scene(tmp_path, {"box": (0, 0, 0)})

    assert run("simulate", session, "--scene", scene, "-o", tmp_path / "sim.h5") == 1

    assert "names no effect" in capsys.readouterr().err


#: Runs detect, and prints which modules it loaded and which files it opened.
_WATCHED = """
import sys
opened = []
sys.addaudithook(lambda name, about: opened.append(str(about[0])) if name == "open" else None)
from hybridve.cli.main import main
try:
    main()
except SystemExit as left:
    assert not left.code, left.code
# Whoever takes plugins looks through the names of all that is installed; and what is compiled is
# kept in a folder named after all sources, which are read for it. Neither is run.
files = [one for one in opened if "dist-info" not in one and not one.endswith(".py")]
names = [*sys.modules, *files]
touched = [one for one in names if "mujoco" in one or "effects" in one]
print("TOUCHED", touched)
"""


@pytest.mark.slow
@pytest.mark.parametrize("has_effects", [False, True])
def test_detect_touches_nothing_of_effects(
    tmp_path: Path, session: Path, scene: Path, *, has_effects: bool
) -> None:
    plain = write_cube_scene(tmp_path, {"box": (0, 0, 0)})
    path = tmp_path / "report.h5"
    asked: list[str | Path] = [scene if has_effects else plain, "-o", path, "--frames", "6"]

    done = subprocess.run(
        [sys.executable, "-c", _WATCHED, "detect", session, "--scene", *asked],
        capture_output=True,
        text=True,
        check=True,
    )

    assert "TOUCHED []" in done.stdout
    assert ("names effects (dwell), which detect leaves alone" in done.stderr) is has_effects
    with h5py.File(path) as file:
        assert "effects" not in file["hybridve"]


@pytest.mark.slow
@pytest.mark.usefixtures("toy")
def test_a_sweep_of_a_simulation_is_told_written_and_drawn(
    run: Run, tmp_path: Path, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "sweep.h5"
    common = ("sweep", session, "--scene", scene, "-o", path, "--over", "step", "--repeats", 2)

    assert run(*common, "--step-ms", "2,10,40", "--frames", ":6", "--json") == 0

    told = json.loads(capsys.readouterr().out)
    assert [row["value"] for row in told["rows"]] == [0.002, 0.01, 0.04]
    assert (told["chosen"], told["finest"]) == (0.002, 0.002)
    assert all(row["ms_median"] > 0 for row in told["rows"])
    # The toy stands still and has no energy: nothing is lost by longer steps.
    assert all(row["distance_max_m"] == row["excess_j"] == 0 for row in told["rows"])
    kept = read_simulation_sweep(path)
    assert kept.time_s.shape == (3, 2)
    assert kept.settings["n_frames"] == 6
    assert (tmp_path / "sweep.png").stat().st_size > 1000
    assert run(*common, "--step-ms", "2") == 1  # it is there already
    assert run(*common, "--step-ms", "2", "--overwrite") == 2
    assert "one value makes no sweep" in capsys.readouterr().err


@pytest.mark.gl
@pytest.mark.slow
@pytest.mark.usefixtures("toy")
def test_a_simulation_is_drawn_as_picture_and_film(
    run: Run, tmp_path: Path, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sim, film, picture = (tmp_path / name for name in ("sim.h5", "sim.mp4", "sim.png"))
    assert run("simulate", session, "--scene", scene, "-o", sim, "--frames", "4:9:2") == 0
    common = ("render", session, "--scene", scene, "--sim", sim, "-o")

    assert run(*common, film) == 0
    assert run(*common, picture, "--frame", 6) == 0
    assert run(*common, tmp_path / "no.png", "--frame", 7) == 1
    assert "has no frame 7" in capsys.readouterr().err

    frames = cv2.VideoCapture(str(film))
    assert frames.get(cv2.CAP_PROP_FPS) == pytest.approx(12.5)
    shown = 0
    while frames.read()[0]:
        shown += 1
    assert shown == 3
    drawn = cv2.imread(str(picture))
    assert drawn is not None
    assert drawn.shape == (1000, 1600, 3)
    other = write_cube_scene(tmp_path / "other", {"box": (0, 0, 0)})
    assert run("render", session, "--scene", other, "--sim", sim, "-o", tmp_path / "o.png") == 1
    assert "another scene" in capsys.readouterr().err
