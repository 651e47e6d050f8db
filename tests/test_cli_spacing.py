"""``hybridve spacing`` as a user runs it: two participants who reach differently far."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.sessions import write_ball_session, write_cube_scene
from matplotlib.patches import StepPatch

from hybridve.hull.report.spacing_file import read_spacing, spacing_as_dict
from hybridve.hull.spacing_picture import curve_of
from hybridve.hull.view.spacing_chart import DoubtCurve, ShiftCurve, draw_spacing_chart

Run = Callable[..., int]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("task")
    for name, reach_m in (("p1", 0.0), ("p2", 0.1)):
        centers = np.array([[-0.3, 0, 0], [reach_m, 0, 0], [-0.3, 0, 0]])
        write_ball_session(folder / name, centers, n_cameras=5)
    places = {"part": (300.0, 0.0, 0.0), "post": (-300.0, 0.0, 200.0)}
    write_cube_scene(folder, places)
    return folder


@pytest.fixture
def task(folder: Path) -> list[object]:
    return [
        *("spacing", folder / "p1", folder / "p2", "--scene", folder / "scene.toml"),
        *("--move", "part", "--along", "2,0,0", "--range-mm", "-50:400", "--no-progress"),
    ]


def test_sessions_are_columns_and_who_reaches_farther_needs_more(
    run: Run, task: list[object], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*task, "--clearance-mm", 5) == 0

    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "part moved along (1, 0, 0), -50 to 400 mm, to keep 5 mm"
    (head,) = (line for line in lines if line.split()[:1] == ["mm"])
    assert head.split() == ["mm", "p1", "p2"]
    (row,) = (line for line in lines if "smallest shift" in line)
    first_mm, second_mm = (float(word) for word in row.split()[2:])
    assert second_mm - first_mm == pytest.approx(100, abs=30)
    (row,) = (line for line in lines if "decided by frame" in line)
    assert row.split()[3:] == ["1", "1"]
    (row,) = (line for line in lines if "violated at 400" in line)
    assert row.split()[4:] == ["0", "of", "3", "0", "of", "3"]
    assert lines[-1].startswith("not moved, and violated all the same: post in ")


@pytest.mark.slow
def test_silhouettes_are_grown_on_demand_and_that_is_said(
    run: Run, task: list[object], capsys: pytest.CaptureFixture[str]
) -> None:
    answers = []
    for extra in ((), ("--grow-px", 2)):
        assert run(*task, *extra, "--json") == 0
        printed = json.loads(capsys.readouterr().out)
        assert printed["settings"]["grow_px"] == (2 if extra else 0)
        answers.append([one["shift_m"] for one in printed["sessions"]])
    assert all(wider > narrow for narrow, wider in zip(*answers, strict=True))
    assert run(*task, "--grow-px", 2) == 0
    assert capsys.readouterr().out.splitlines()[0].endswith(", silhouettes grown by 2 px")


@pytest.mark.slow
def test_the_shift_at_95_percent_is_told_and_grows_with_the_outlines_errors(
    run: Run, task: list[object], capsys: pytest.CaptureFixture[str]
) -> None:
    answers = []
    for std_px in (0.2, 1.0):
        assert run(*task, "--clearance-mm", 5, "--mask-std-px", std_px, "--json") == 0
        printed = json.loads(capsys.readouterr().out)
        assert printed["settings"]["doubt"]["segmentation_px"] == std_px
        for one in printed["sessions"]:
            assert one["at_95"]["kind"] == "estimate"
            assert one["at_95"]["shift_m"] > one["shift_m"]
        answers.append([one["at_95"]["shift_m"] for one in printed["sessions"]])
    assert all(more > less for less, more in zip(*answers, strict=True))

    assert run(*task, "--clearance-mm", 5, "--mask-std-px", 1.0) == 0
    (row,) = (line for line in capsys.readouterr().out.splitlines() if "suffices at 95 %" in line)
    told_mm = [float(word) for word in row.split()[4:]]
    assert told_mm == pytest.approx(1e3 * np.array(answers[1]), abs=0.051)

    assert run(*task, "--no-doubt") == 0
    assert "95 %" not in capsys.readouterr().out
    assert run(*task, "--no-doubt", "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["settings"]["doubt"] is None
    assert [one["at_95"] for one in printed["sessions"]] == [None, None]


@pytest.mark.slow
def test_json_says_what_the_file_holds_and_the_picture_is_drawn(
    run: Run, task: list[object], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output, picture = tmp_path / "out.h5", tmp_path / "out.png"

    assert run(*task, "-o", output, "--picture", picture, "--json", "--step-mm", 50) == 0

    printed = json.loads(capsys.readouterr().out)
    assert (printed.pop("spacing"), printed.pop("picture")) == (str(output), str(picture))
    written = read_spacing(output)
    assert printed == json.loads(json.dumps(spacing_as_dict(written)))
    assert [one["name"] for one in printed["sessions"]] == ["p1", "p2"]
    assert printed["sessions"][0]["curve"]["shift_m"] == pytest.approx(np.arange(-0.05, 0.41, 0.05))
    assert printed["settings"]["direction"] == [1.0, 0.0, 0.0]
    assert printed["sessions"][0]["settings"]["session_sha256"]
    image = cv2.imread(str(picture))
    assert image is not None
    assert len(np.unique(image)) > 50
    assert run(*task, "-o", output) == 1
    assert "exists already" in capsys.readouterr().err
    assert run(*task, "-o", output, "--overwrite") == 0
    assert sorted(tmp_path.iterdir()) == [output, picture]


@pytest.mark.slow
def test_a_larger_clearance_needs_as_much_more(
    run: Run, task: list[object], capsys: pytest.CaptureFixture[str]
) -> None:
    needed = []
    for clearance_mm in (0, 50):
        assert run(*task, "--clearance-mm", clearance_mm, "--json") == 0
        needed.append(json.loads(capsys.readouterr().out)["sessions"][1]["shift_m"])

    assert 0.0 < needed[1] - needed[0] <= 0.05 + 1e-3


def test_no_shift_that_serves_is_a_result(
    run: Run, task: list[object], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*task, "--range-mm", "-50:50") == 0

    (row,) = (line for line in capsys.readouterr().out.splitlines() if "smallest shift" in line)
    assert "none up to 50" in row


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--range-mm", "100:100"], "--range-mm 100:100 is empty"),
        (["--range-mm", "100:0"], "--range-mm 100:0 goes backwards"),
        (["--move", "lid"], "there is no object 'lid' to move; the scene has part, post"),
        (["--move", "part"], "object 'part' is to move twice"),
        (["--clearance-mm", "-1"], "--clearance-mm -1: expected 0 or more"),
        (["--along", "0,0,0"], "points nowhere"),
        (["--frames", "90:95"], "none of the frames 90:95:1: it has 3"),
        (["--step-mm", "0.0001"], "take longer steps"),
    ],
)
def test_bad_input_is_one_line(
    run: Run,
    task: list[object],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    assert run(*task, "-o", tmp_path / "out.h5", *arguments) == 1

    shown = capsys.readouterr()
    assert shown.out == ""
    assert message in shown.err
    assert shown.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_session_given_twice_is_one_line(
    run: Run, task: list[object], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [*task[:3], folder / "p1" / "session.toml", *task[3:]]

    assert run(*arguments) == 1

    assert "is given twice; each session is a column of its own" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--along", "1,0"], "'1,0' is not X,Y,Z"),
        (["--along", "1,0,nan"], "is not X,Y,Z"),
        (["--range-mm", "100"], "'100' is not A:B"),
        (["--tolerance-mm", "0"], "0.01"),
        (["--picture", "out.gif"], "pictures are .png"),
        (["--picture", "out.png", "-o", "out.png"], "cannot be both"),
    ],
)
def test_wrong_usage_is_status_2_and_says_what(
    run: Run,
    task: list[object],
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    assert run(*task, *arguments) == 2

    assert message in capsys.readouterr().err


def test_the_chart_shows_counts_and_answers_where_they_belong() -> None:
    shift_mm = np.array([0.0, 10.0, 20.0, 30.0])
    curves = [
        ShiftCurve(
            "p1",
            shift_mm,
            np.array([3.0, 1.0, 0.0]),
            np.array([3.0, 2.0, 0.0]),
            20.0,
            DoubtCurve(np.array([4.0, 3.0, 1.0]), 30.0),
        ),
        ShiftCurve("p2", shift_mm, np.array([3.0, 3.0, 2.0]), np.array([3.0, 3.0, 2.0]), np.nan),
    ]

    axes = draw_spacing_chart(curves, title="part").axes[0]

    steps = [patch.get_data() for patch in axes.patches if isinstance(patch, StepPatch)]
    drawn = [(values.tolist(), edges.tolist()) for values, edges, _ in steps]
    for curve in curves:
        for values in (curve.violated, curve.at_most):
            assert (values.tolist(), shift_mm.tolist()) in drawn
    lines = [np.asarray(line.get_xdata()).tolist() for line in axes.lines]
    assert lines == [[20.0, 20.0], [20.0], [30.0]]
    assert ([4.0, 3.0, 1.0], shift_mm.tolist()) in drawn
    assert axes.get_ylim()[1] >= 4.0
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [
        "p1: 20.0 mm; at 95 % 30.0 mm",
        "p2: none is free",
    ]


def test_the_picture_of_a_recording_has_its_steps_where_they_are(
    run: Run, task: list[object], tmp_path: Path
) -> None:
    output = tmp_path / "out.h5"
    assert run(*task, "-o", output, "--step-mm", 200) == 0
    written = read_spacing(output)
    one = written.sessions[0]

    curve = curve_of(one)

    assert curve.shift_mm[[0, -1]].tolist() == [-50.0, 400.0]
    at_answer = np.searchsorted(curve.shift_mm, 1e3 * one.shift_m + 1e-6) - 1
    assert curve.at_most[at_answer] == 0
    assert curve.at_most[at_answer - 1] >= 1
    assert curve.violated[0] == one.curve.violated[0]
    assert (curve.violated <= curve.at_most).all()
    assert curve.doubt is not None
    assert (curve.at_most <= curve.doubt.unsure).all()
    assert one.doubt is not None
    at_95 = np.searchsorted(curve.shift_mm, curve.doubt.answer_mm + 1e-6) - 1
    assert curve.doubt.unsure[at_95] == 0 < curve.doubt.unsure[at_95 - 1]
