"""``hybridve detect`` over several sessions and layouts: a report each, and one table."""

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.sessions import write_ball_session, write_cube_scene

from hybridve.hull.report.read import read_report
from hybridve.hull.report.schema import FrameResult
from hybridve.hull.report.write import ReportWriter

Run = Callable[..., int]

#: The ball of the first stays away from the cube at the origin, that of the second goes into it.
AWAY = np.array([[-0.9, 0.0, 0.0], [-0.8, 0.0, 0.0]])
INTO = np.array([[-0.5, 0.0, 0.0], [-0.2, 0.0, 0.0]])

QUICK = ("--viewport", 6, "--clearance-mm", 5, "--no-doubt", "--no-progress")


@pytest.fixture
def sessions(tmp_path: Path) -> list[Path]:
    """Two sessions whose files have the same name, so that the folders' names tell them apart."""
    return [
        write_ball_session(tmp_path / name, centers)
        for name, centers in (("ann", AWAY), ("bob", INTO))
    ]


@pytest.fixture
def layouts(tmp_path: Path) -> list[Path]:
    near = write_cube_scene(tmp_path / "near", {"cube": (0.0, 0.0, 0.0)})
    far = write_cube_scene(
        tmp_path / "far", {"cube": (900.0, 0.0, 0.0), "other": (0.0, 0.0, 700.0)}
    )
    text = near.read_text(encoding="utf-8") + "required_clearance_mm = 1000\n"
    near.write_text(text, encoding="utf-8")
    return [near, far]


def arguments(
    sessions: list[Path], layouts: list[Path], output: Path, *more: object
) -> list[object]:
    scenes = [part for layout in layouts for part in ("--scene", layout)]
    return ["detect", *sessions, *scenes, "-o", output, *QUICK, *more]


REPORTS = ["ann__far.h5", "ann__near.h5", "bob__far.h5", "bob__near.h5"]


@pytest.mark.slow
def test_every_session_is_tested_against_every_layout(
    run: Run,
    tmp_path: Path,
    sessions: list[Path],
    layouts: list[Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "out"

    assert run(*arguments(sessions, layouts, folder)) == 0

    told = capsys.readouterr().out
    assert sorted(path.name for path in folder.iterdir()) == ["COMPARISON.csv", *REPORTS]
    for name in REPORTS:
        settings = read_report(folder / name).settings
        session, layout = name.removesuffix(".h5").split("__")
        assert Path(settings["session"]).parent.name == session
        assert Path(settings["scene"]).parent.name == layout
    with (folder / "COMPARISON.csv").open(encoding="utf-8", newline="") as file:
        rows = {(r["layout"], r["object"], r["quantity"]): r for r in csv.DictReader(file)}
    verdict = rows["near", "cube", "verdict"]
    assert (verdict["ann"], verdict["bob"]) == ("too near", "clash")
    assert rows["near", "cube", "frames_below_required"]["ann"] == "2"
    # The ball of 0.2 m comes as near as 0.5 m; its hull is bigger, and contains it.
    assert 350 < float(rows["near", "cube", "clearance_lower"]["ann"]) <= 500.0
    assert rows["far", "other", "verdict"]["bob"] == "kept"
    line = next(line for line in told.splitlines() if line.strip().startswith("near"))
    assert "too near" in line
    assert "2 frames below 1000 mm" in line
    assert "clash, 1 of 2 frames" in line


@pytest.mark.slow
def test_a_report_of_several_is_that_of_one(
    run: Run, tmp_path: Path, sessions: list[Path], layouts: list[Path]
) -> None:
    alone = tmp_path / "alone.h5"

    assert run(*arguments(sessions, layouts[:1], tmp_path / "out")) == 0
    assert run(*arguments(sessions[1:], layouts[:1], alone)) == 0

    one, other = read_report(alone), read_report(tmp_path / "out" / "bob__near.h5")
    for name, values in one.objects["cube"].columns.items():
        assert values.tobytes() == other.objects["cube"][name].tobytes(), name
    assert one.settings == other.settings


@pytest.mark.slow
def test_one_that_fails_does_not_lose_the_others(
    run: Run,
    tmp_path: Path,
    sessions: list[Path],
    layouts: list[Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "out"
    (sessions[0].parent / "rig.csv").write_text("cam0,1,2\n", encoding="utf-8")
    broken = tmp_path / "broken.toml"
    broken.write_text("format = 1\n", encoding="utf-8")
    call = arguments(sessions, [*layouts, broken], folder, "--json")

    assert run(*call) == 1

    told = capsys.readouterr()
    errors = told.err.strip().splitlines()
    assert all(error.startswith("error: ") for error in errors)
    # The scene is told once; the rig for each layout that could be read; then how to go on.
    assert sum("broken.toml" in error for error in errors) == 1
    assert sum("rig.csv" in error for error in errors) == 2
    assert "4 of 6 reports could not be made" in errors[-1]
    assert "--resume" in errors[-1]
    comparison = json.loads(told.out)
    failed = {(one["session"], one["layout"]) for one in comparison["failed"]}
    assert failed == {("ann", "near"), ("ann", "far"), ("ann", "broken"), ("bob", "broken")}
    assert (folder / "bob__near.h5").exists()


@pytest.mark.slow
def test_resuming_makes_what_is_missing_and_keeps_what_is_finished(
    run: Run, tmp_path: Path, sessions: list[Path], layouts: list[Path]
) -> None:
    folder = tmp_path / "out"
    call = arguments(sessions, layouts, folder)
    assert run(*call) == 0
    (folder / "bob__near.h5").unlink()
    kept = {name: (folder / name).read_bytes() for name in REPORTS if name != "bob__near.h5"}

    assert run(*call, "--resume") == 0

    assert (folder / "bob__near.h5").exists()
    assert all((folder / name).read_bytes() == content for name, content in kept.items())


@pytest.mark.slow
def test_an_interrupted_call_goes_on_in_the_middle_of_a_report(
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    sessions: list[Path],
    layouts: list[Path],
) -> None:
    whole, folder = tmp_path / "whole", tmp_path / "out"
    assert run(*arguments(sessions, layouts[:1], whole)) == 0
    appended: list[FrameResult] = []
    append = ReportWriter.append

    def append_three(writer: ReportWriter, result: FrameResult) -> None:
        if len(appended) == 3:  # two of the first report, one of the second
            raise KeyboardInterrupt
        appended.append(result)
        append(writer, result)

    with monkeypatch.context() as patch:
        patch.setattr(ReportWriter, "append", append_three)
        assert run(*arguments(sessions, layouts[:1], folder)) == 130
    assert {path.name for path in folder.iterdir()} == {"ann__near.h5", "bob__near.h5.parts"}

    assert run(*arguments(sessions, layouts[:1], folder, "--resume")) == 0

    names = {path.name for path in whole.iterdir()}
    assert {path.name for path in folder.iterdir()} == names
    expected, found = (read_report(place / "bob__near.h5").objects for place in (whole, folder))
    assert found["cube"]["first_contact_s"][1] > 0, "what hangs on the frame before the cut"
    for name, values in expected["cube"].columns.items():
        assert found["cube"][name].tobytes() == values.tobytes(), name


@pytest.mark.slow
def test_a_finished_report_of_other_settings_is_not_taken_for_this_one(
    run: Run,
    tmp_path: Path,
    sessions: list[Path],
    layouts: list[Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    call = arguments(sessions, layouts[:1], tmp_path / "out")
    assert run(*call) == 0
    capsys.readouterr()

    assert run(*call, "--resume", "--abc-mm", 40) == 1

    error = capsys.readouterr().err
    assert "ann__near.h5: was finished with other settings" in error
    assert "2 of 2 reports could not be made" in error


@pytest.mark.slow
def test_clashes_of_any_session_fail_on_clash(
    run: Run, tmp_path: Path, sessions: list[Path], layouts: list[Path]
) -> None:
    near, far = layouts

    assert run(*arguments(sessions, [far], tmp_path / "a", "--fail-on-clash")) == 0
    assert run(*arguments(sessions, [near], tmp_path / "b", "--fail-on-clash")) == 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ann__near.h5", "COMPARISON.csv"])
def test_what_stands_in_the_folder_is_refused_before_any_work(
    run: Run,
    tmp_path: Path,
    sessions: list[Path],
    layouts: list[Path],
    capsys: pytest.CaptureFixture[str],
    name: str,
) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / name).write_text("precious", encoding="utf-8")
    call = arguments(sessions, layouts[:1], folder)

    assert run(*call) == 1

    assert f"{name}: exists already" in capsys.readouterr().err
    assert [path.name for path in folder.iterdir()] == [name]
    assert run(*call, "--overwrite") == 0
    assert len(list(folder.iterdir())) == 3


def test_several_reports_need_a_folder_that_can_be_made(
    run: Run,
    tmp_path: Path,
    sessions: list[Path],
    layouts: list[Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    a_file = tmp_path / "report.h5"
    a_file.write_text("precious", encoding="utf-8")

    assert run(*arguments(sessions, layouts, a_file)) == 1
    assert "is a file; several sessions or layouts need a folder" in capsys.readouterr().err
    assert run(*arguments(sessions, layouts, tmp_path / "no" / "folder")) == 1
    assert "cannot be made" in capsys.readouterr().err
    assert a_file.read_text(encoding="utf-8") == "precious"


def test_a_session_given_twice_is_wrong_usage(
    run: Run,
    tmp_path: Path,
    sessions: list[Path],
    layouts: list[Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    twice = [sessions[0], sessions[0].parent]

    assert run(*arguments(twice, layouts[:1], tmp_path / "out")) == 2

    assert "is given twice" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
