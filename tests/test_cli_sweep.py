"""``hybridve sweep`` as a user runs it, on a ball that comes along and meets a cube."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.sessions import write_ball_session, write_cube_scene

from hybridve.calib.errors import DeviceError
from hybridve.hull.query import choose
from hybridve.hull.query.engine import Engine, EngineName
from hybridve.hull.report.sweep_file import read_sweep, sweep_as_dict
from hybridve.hull.sweep import experiment

Run = Callable[..., int]

N_FRAMES = 43
CENTERS = np.column_stack([np.linspace(-0.9, 0.9, N_FRAMES), np.zeros((N_FRAMES, 2))])


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ball_session(tmp_path_factory.mktemp("ball"), CENTERS, n_cameras=3)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    places = {"hit": (0.0, 0.0, 0.0), "far": (0.0, 0.0, 900.0)}
    return write_cube_scene(tmp_path_factory.mktemp("cubes"), places)


@pytest.fixture
def quick(session: Path, scene: Path, tmp_path: Path) -> list[object]:
    """Arguments of a sweep that takes no time to speak of, but for the output."""
    return [
        *("sweep", session, "--scene", scene, "--viewport", "2,4,8", "--engine", "native"),
        *("--repeats", 2, "--open-at-mm", 5, "--frames", "18:26:4", "--no-progress"),
        *("-o", tmp_path / "sweep.h5"),
    ]


@pytest.mark.slow
def test_json_says_what_the_file_holds_and_the_picture_is_drawn(
    run: Run, tmp_path: Path, quick: list[object], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*quick, "--engine", "reference", "--json") == 0

    printed = json.loads(capsys.readouterr().out)
    sweep = read_sweep(tmp_path / "sweep.h5")
    assert printed.pop("sweep") == str(tmp_path / "sweep.h5")
    assert printed.pop("picture") == str(tmp_path / "sweep.png")
    assert printed == json.loads(json.dumps(sweep_as_dict(sweep)))
    hull_ms = 1e3 * sweep.frames.hull_s
    assert printed["stage_ms"]["hull"]["median"] == pytest.approx(np.median(hull_ms))
    assert (hull_ms > 0).all()
    assert printed["frames"] == [18, 22]
    assert [engine["name"] for engine in printed["engines"]] == ["native", "reference"]
    native, reference = printed["engines"]
    assert [row["label"] for row in native["rows"]][:3] == ["2", "4", "8"]
    for mine, other in zip(native["rows"], reference["rows"], strict=True):
        assert len(mine["ms_repeats"]) == 2
        assert mine["ms_median"] == pytest.approx(np.median(mine["ms_repeats"]))
        for name in ("points", "triangles_missed", "distance_max_m", "samples"):
            assert mine[name] == other[name], name
    assert sweep.settings["session_sha256"]
    assert sweep.settings["viewports"] == [2, 4, 8]
    assert sweep.settings["repeats"] == 2
    assert sweep.run.versions["numpy"] == np.__version__
    image = cv2.imread(str(tmp_path / "sweep.png"))
    assert image is not None
    assert len(np.unique(image)) > 50
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sweep.h5", "sweep.png"]


@pytest.mark.slow
def test_the_table_has_a_line_for_every_engine_and_viewport(
    run: Run, quick: list[object], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*quick, "--accuracy-mm", 20, "--engine", "native,reference") == 0

    lines = capsys.readouterr().out.splitlines()
    for engine in ("native", "reference"):
        for label in ("2", "4", "8", "accuracy 20 mm"):
            assert any(line.split("  ")[1:2] == [engine] and f" {label} " in line for line in lines)
        assert any(
            line.startswith(f"  {engine}: ") and "ns a pixel filled" in line for line in lines
        )
    assert any("triangles asked collide" in line for line in lines)


@pytest.mark.slow
def test_an_accuracy_gives_each_triangle_its_viewport(
    run: Run, tmp_path: Path, quick: list[object]
) -> None:
    assert run(*quick, "--accuracy-mm", 20) == 0

    rows = read_sweep(tmp_path / "sweep.h5").rows
    assert rows.labels[-1] == "accuracy 20 mm"
    assert rows.predicted_m[-1] <= 0.02
    assert rows.viewport_most[-1] == 16  # a diagonal of 0.2 sqrt(2) m in steps of 20 mm
    assert rows.viewport[-1] == 0


@pytest.mark.slow
def test_by_default_the_accuracy_is_that_of_the_middle_viewport(
    run: Run, tmp_path: Path, quick: list[object]
) -> None:
    assert run(*quick) == 0

    rows = read_sweep(tmp_path / "sweep.h5").rows
    assert rows.accuracy_m[-1] == rows.predicted_m[1]
    assert rows.viewport_most[-1] in (4, 5)  # the quotient may round up


@pytest.mark.slow
def test_by_default_few_frames_are_taken_from_the_whole_recording(
    run: Run, tmp_path: Path, quick: list[object]
) -> None:
    at = quick.index("--frames")

    assert run(*quick[:at], *quick[at + 2 :]) == 0

    index = read_sweep(tmp_path / "sweep.h5").frames.index
    assert 10 < len(index) <= 20
    assert index[0] == 0
    assert index[-1] >= N_FRAMES - 3


@pytest.mark.slow
def test_nothing_collides_is_told_and_times_are_given(
    run: Run, tmp_path: Path, quick: list[object], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*quick, "--frames", "0:2", "--json") == 0

    shown = capsys.readouterr()
    assert "nothing collides in the frames 0:2:1: accuracy cannot be measured" in shown.err
    assert len(shown.err.strip().splitlines()) == 1
    (engine,) = json.loads(shown.out)["engines"]
    for row in engine["rows"]:
        assert row["distance_max_m"] is row["triangles_missed_share"] is row["held"] is None
        assert row["ms_median"] > 0
    assert (tmp_path / "sweep.png").exists()
    assert run(*quick, "--frames", "0:2", "--overwrite") == 0


@pytest.mark.slow
def test_engines_that_do_not_open_are_left_out_unless_they_were_named(
    run: Run,
    tmp_path: Path,
    quick: list[object],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    really_open = choose.open_engine

    def open_without_opengl(name: EngineName = "auto") -> Engine:
        if name in ("compute", "stencil"):
            raise DeviceError("no OpenGL here")
        return really_open(name)

    monkeypatch.setattr(choose, "open_engine", open_without_opengl)
    at = quick.index("--engine")
    unnamed = [*quick[:at], *quick[at + 2 :]]

    assert run(*unnamed) == 0

    assert "compute is left out: no OpenGL here" in capsys.readouterr().err
    names = [engine.name for engine in read_sweep(tmp_path / "sweep.h5").engines]
    assert names == ["native", "reference"]
    assert run(*unnamed, "--engine", "native,compute", "--overwrite") == 1
    error = capsys.readouterr().err.strip()
    assert error == "error: engine compute: no OpenGL here"
    assert len(read_sweep(tmp_path / "sweep.h5").engines) == 2, "the sweep from before is kept"


@pytest.mark.slow
def test_the_reference_is_left_out_where_it_would_take_long(
    run: Run,
    tmp_path: Path,
    quick: list[object],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from hybridve.hull.sweep import session as command

    monkeypatch.setattr(command, "_MOST_REFERENCE_LOOKS", 10)
    at = quick.index("--engine")

    assert run(*quick[:at], *quick[at + 2 :]) == 0

    assert "reference is left out" in capsys.readouterr().err
    names = [engine.name for engine in read_sweep(tmp_path / "sweep.h5").engines]
    assert "native" in names
    assert "reference" not in names
    assert run(*quick, "--engine", "reference", "--overwrite") == 0
    names = [engine.name for engine in read_sweep(tmp_path / "sweep.h5").engines]
    assert names == ["native", "reference"]


@pytest.mark.slow
@pytest.mark.gl
def test_engines_that_draw_take_turns_and_agree(
    run: Run, tmp_path: Path, quick: list[object]
) -> None:
    assert run(*quick, "--engine", "compute") == 0

    native, compute = read_sweep(tmp_path / "sweep.h5").engines
    np.testing.assert_allclose(compute.points, native.points, rtol=0.01)
    assert native.points[2] > 0
    assert not compute.triangles_against_proof.any()


@pytest.mark.parametrize("name", ["sweep.h5", "sweep.png"])
def test_what_stands_there_is_kept(
    run: Run, tmp_path: Path, quick: list[object], capsys: pytest.CaptureFixture[str], name: str
) -> None:
    (tmp_path / name).write_text("precious", encoding="utf-8")

    assert run(*quick) == 1

    assert f"{name}: exists already" in capsys.readouterr().err
    assert (tmp_path / name).read_text(encoding="utf-8") == "precious"
    assert list(tmp_path.iterdir()) == [tmp_path / name]


def test_an_interrupted_sweep_leaves_nothing(
    run: Run, tmp_path: Path, quick: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(experiment, "_answer_in_time", interrupt)

    assert run(*quick) == 130

    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--viewport", "8,4"], "not ascending"),
        (["--viewport", "4,4"], "not ascending"),
        (["--viewport", "0,4"], "viewports are 1 to 65535"),
        (["--viewport", "four"], "not a list of numbers"),
        (["--engine", "auto"], "'auto' is not one of"),
        (["--engine", "native,cuda"], "'cuda' is not one of"),
        (["--picture", "out.gif"], "pictures are .png"),
        (["-o", "out.png"], "cannot be both"),
    ],
)
def test_wrong_usage_is_status_2_and_says_what(
    run: Run,
    quick: list[object],
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    assert run(*quick, *arguments) == 2

    assert message in capsys.readouterr().err


def test_frames_that_are_not_there_are_one_line(
    run: Run, tmp_path: Path, quick: list[object], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*quick, "--frames", "900:905") == 1

    error = capsys.readouterr().err.strip()
    assert "none of the frames 900:905:1: it has 43" in error
    assert "\n" not in error
    assert list(tmp_path.iterdir()) == []


def test_an_accuracy_too_fine_is_one_line(
    run: Run, quick: list[object], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*quick, "--accuracy-mm", 1e-4) == 1

    assert "ask for less accuracy" in capsys.readouterr().err
