"""``hybridve summary``: the numbers a report comes down to, in words, as JSON and as curves."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.contacts import FREE, free_contact, stored_mesh
from helpers.sessions import write_ball_session, write_cube_scene

from hybridve.hull.contact.backtrack import FirstContact
from hybridve.hull.contact.clearance import Clearance
from hybridve.hull.contact.finding import Finding, judged
from hybridve.hull.contact.recovery import Recovery
from hybridve.hull.contact.respond import Response
from hybridve.hull.contact.uncertainty import Doubt
from hybridve.hull.curves import write_curves
from hybridve.hull.report import machine
from hybridve.hull.report.read import read_report
from hybridve.hull.report.schema import FrameResult, Part, ReportHeader, State
from hybridve.hull.report.summarize import failing, summarize
from hybridve.hull.report.write import ReportWriter

Run = Callable[..., int]

TOUCHING = free_contact("colliding", witness_world=np.ones(3))
DOUBT = Doubt(0.002, 0.0, 0.05, np.zeros(2), False, 2, True, (), "real")

#: When the one contact began, and how well that is known.
BEGAN_S, BEGAN_DOUBT_S = 0.131, 0.02


def near(
    lower_mm: float, at_least_mm: float = np.nan, depth_mm: float = 0.0, **changes: Any
) -> Finding:
    """Return a finding with a clearance of `lower_mm` to 0.1 mm more."""
    upper_mm = 0.0 if depth_mm else lower_mm + 0.1
    clearance = Clearance(
        lower_mm / 1e3,
        upper_mm / 1e3,
        np.ones(3),
        np.zeros(3),
        depth_mm / 1e3,
        depth_mm / 1e3 + (1e-4 if depth_mm else 0.0),
    )
    doubt = replace(DOUBT, at_least_m=at_least_mm / 1e3)
    return Finding(FREE, clearance, **{"doubt": doubt, **changes})


def deep(depth_mm: float, **changes: Any) -> Finding:
    vector = np.array([0.0, 0.0, 1.0])
    response = Response(vector, vector, vector, vector, 0.0123, "", vector, vector, 0.0125, "")
    touching = replace(near(0.0, depth_mm=depth_mm), contact=TOUCHING, response=response)
    return replace(touching, **changes)


ENTRY = deep(
    4.0,
    first_contact=FirstContact(0.5, 0.5, np.ones(3), "outline lost"),
    first_contact_s=BEGAN_S,
    first_contact_uncertainty_s=BEGAN_DOUBT_S,
    approach_m_s=(0.2, 0.3),
    recovery=Recovery("no", 0.04, 0.05),
)
assert ENTRY.response is not None
LOST = replace(ENTRY.response, d_rec_m=np.nan, status="no exit")
PHANTOM = replace(
    DOUBT, survives=False, hinges_on=("cam2", "cam1"), component="unsure", at_least_m=np.nan
)
FRAMES = [
    near(20.0, 15.0),
    near(9.95, 12.0),  # the bounds enclose the 10 mm that are required
    near(7.0, 3.0),
    ENTRY,
    deep(6.0, doubt=PHANTOM, response=LOST, recovery=Recovery("", np.nan, np.nan)),
    None,
    near(0.0, depth_mm=30.0),  # inside
]


def verdict_on(finding: Finding, required_m: float) -> Finding:
    return judged(finding, is_closed=True, required_m=required_m, share_seen=1.0, rests_on="")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "report.h5"
    header = ReportHeader(
        run=machine.Run("hybridve detect", "", {}, ""),
        objects=({"name": "box", "required_clearance_m": 0.01, "closed": True},),
        settings={},
        rig={},
        engine="native",
        renderer="",
        parts=frozenset({"clearance", "first contact", "response", "recovery", "doubt"}),
        cameras=("cam1", "cam2"),
        meshes=(stored_mesh(FREE.body),),
    )
    with ReportWriter(path, header) as writer:
        for row, finding in enumerate(FRAMES):
            findings = () if finding is None else (verdict_on(finding, 0.01),)
            reason = "torn" if finding is None else ""
            state: State = "unread" if finding is None else "evaluated"
            writer.append(FrameResult(row + 100, row / 10, reason, findings, {}, state))
        writer.finish()
    return path


def test_the_summary_counts_bounds_dates_and_names(path: Path) -> None:
    (found,) = summarize(read_report(path))["objects"]

    assert found["verdict"] == "clash"
    assert found["frames_by_verdict"] == {
        "clash": 2,
        "inside": 1,
        "too near": 1,
        "unknown": 1,
        "open": 1,
        "kept": 1,
    }
    assert (found["frames_colliding"], found["frames_inside"]) == (2, 1)
    assert found["frames_proved_free"] == 3
    # Two touch, one is inside, one is certainly nearer than 10 mm; of another nobody can tell.
    assert found["frames_below_required"] == 4
    assert found["frames_perhaps_below_required"] == 1
    assert found["clearance"]["lower_m"] == found["clearance"]["upper_m"] == 0.0
    assert found["clearance"]["frame"] == 103
    assert found["clearance"]["at_least_95_m"] == 0.0
    assert found["depth"] == {
        "lower_m": 0.03,
        "upper_m": pytest.approx(0.0301),
        "frame": 106,
        "time_s": 0.6,
    }
    assert found["recovery"]["d_rec_m"] == 0.0123
    assert found["recovery"]["d_rec_paper_m"] == 0.0125
    assert found["recovery"]["frames_no_exit"] == 1
    assert found["recovery"]["frames_asked_to_free"] == 1
    assert found["recovery"]["frames_freed"] == 0
    assert found["recovery"]["free_shift_m"] == 0.05
    assert (found["frames_hinging"], found["hinges_on"]) == (1, ["cam1", "cam2"])
    assert found["frames_unsure"] == 1
    # Nobody knows of frame 105; it does not tell two contacts apart.
    (first,) = found["spans"]
    assert (first["first_frame"], first["last_frame"]) == (103, 106)
    assert first["first_contact_s"] == BEGAN_S
    assert first["first_contact_status"] == "outline lost"
    assert first["approach_m_s"] == [0.2, 0.3]
    assert failing(summarize(read_report(path))) == ["box"]


def only(
    frames: list[Finding], path: Path, required_m: float = 0.0, parts: frozenset[Part] = frozenset()
) -> dict[str, Any]:
    header = ReportHeader(
        run=machine.Run("", "", {}, ""),
        objects=({"name": "box", "required_clearance_m": required_m, "closed": True},),
        settings={},
        rig={},
        engine="",
        renderer="",
        parts=frozenset({"clearance", "doubt", *parts}),
        cameras=("cam1", "cam2"),
        meshes=(stored_mesh(FREE.body),),
    )
    with ReportWriter(path, header, overwrite=True) as writer:
        for row, finding in enumerate(frames):
            findings = (verdict_on(finding, required_m),)
            writer.append(FrameResult(row, row / 10, "", findings, {}))
        writer.finish()
    return summarize(read_report(path))


def test_the_nearest_frame_and_the_least_at_95_percent_may_be_different_ones(
    tmp_path: Path,
) -> None:
    numbers = only([near(20.0, 1.0), near(15.0, 12.0)], tmp_path / "r.h5")

    (found,) = numbers["objects"]
    assert found["verdict"] == "kept"
    assert found["clearance"]["frame"] == 1
    assert found["clearance"]["lower_m"] == pytest.approx(0.015)
    assert found["clearance"]["at_least_95_m"] == pytest.approx(0.001)
    assert found["depth"] is None
    assert found["spans"] == []
    assert failing(numbers) == []


@pytest.mark.parametrize("parts", [{"response"}, {"response", "recovery"}])
def test_a_shift_that_nobody_asked_for_is_not_there(tmp_path: Path, parts: set[Part]) -> None:
    no_exit = deep(6.0, response=LOST, recovery=Recovery("", np.nan, np.nan))

    (found,) = only([no_exit], tmp_path / "r.h5", parts=frozenset(parts))["objects"]

    assert found["recovery"]["frames_asked_to_free"] == 0
    assert found["recovery"]["free_shift_m"] is None


def test_inside_alone_is_a_verdict_and_fails(tmp_path: Path) -> None:
    numbers = only([near(0.0, depth_mm=30.0), near(20.0)], tmp_path / "r.h5")

    (found,) = numbers["objects"]
    assert found["verdict"] == "inside"
    assert found["frames_proved_free"] == 1
    assert len(found["spans"]) == 1
    assert failing(numbers) == ["box"]


@pytest.mark.parametrize(
    ("lower_mm", "verdict"), [(9.85, "too near"), (9.95, "open"), (10.0, "kept")]
)
def test_only_what_is_certainly_far_enough_passes_unless_more_is_let_pass(
    tmp_path: Path, lower_mm: float, verdict: str
) -> None:
    numbers = only([near(lower_mm), near(50.0)], tmp_path / "r.h5", required_m=0.01)

    assert numbers["verdict"] == verdict
    assert failing(numbers) == ([] if verdict == "kept" else ["box"])
    assert failing(numbers, [verdict]) == []
    assert failing(numbers, ["not seen"]) == ([] if verdict == "kept" else ["box"])


def test_json_holds_no_number_that_json_does_not_know(
    run: Run, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("summary", path, "--json") == 0

    def refuse(name: str) -> float:
        raise ValueError(name)

    json.loads(capsys.readouterr().out, parse_constant=refuse)


def test_the_text_says_what_must_be_known(
    run: Run, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("summary", path) == 0

    told = capsys.readouterr().out
    assert "touched at 0.131 s, 20 ms either way at most (outline lost)" in told
    assert "coming at 0.20-0.30 m/s" in told
    assert "in 1 frame something is wholly inside, without touching the surface" in told
    assert "hinges on a single camera: cam1, cam2" in told
    assert "may hold nothing real" in told
    assert "4, 1 more perhaps" in told
    assert "30.0 +-0.1" in told
    assert "12.3, no exit in 1 frame" in told
    assert "50.0 mm along V_rec do in all" in told
    assert "2 clash, 1 inside, 1 too near, 1 unknown, 1 open, 1 kept" in told
    assert "moving it by D_rec frees all of it in 0 of 1 frame; 50.0 mm along V_rec do" in told


def first_line(
    run: Run, capsys: pytest.CaptureFixture[str], frames: list[Finding], path: Path, **asked: Any
) -> str:
    """Return what `summary` says first of a report of one object and these frames."""
    only(frames, path, **asked)
    capsys.readouterr()
    assert run("summary", path) == 0
    return capsys.readouterr().out.splitlines()[0]


def touching(depth_mm: float, std_mm: float) -> Finding:
    return deep(depth_mm, doubt=replace(DOUBT, std_m=std_mm / 1e3))


@pytest.mark.parametrize(
    ("frames", "required_m", "line"),
    [
        (
            [near(20.0), touching(6.0, 1.0)],
            0.0,
            "clash: 1 of 1 object is touched, box: 6.1 +-0.1 mm deep at 0.10 s (frame 1), sure",
        ),
        (
            [touching(6.0, 5.0), near(20.0)],
            0.0,
            "clash: 1 of 1 object is touched, box: 6.1 +-0.1 mm deep at 0.00 s (frame 0), not "
            "sure: outlines may be off by as much",
        ),
        (
            [deep(6.0, doubt=PHANTOM)],
            0.0,
            "clash: 1 of 1 object is touched, box: 6.1 +-0.1 mm deep at 0.00 s (frame 0), not "
            "sure: may be a phantom, hinges on cam1 or cam2 alone",
        ),
        (
            [near(7.0, 3.0)],
            0.01,
            "too near: 1 of 1 object has less room than it requires, box: 7.0 +-0.1 mm away "
            "where 10 are required at 0.00 s (frame 0), not sure: outlines may be off by as much",
        ),
        (
            [near(9.95, 5.0)],
            0.01,
            "open: 1 of 1 object may not keep its distance: nothing is proved (box)",
        ),
        (
            [near(20.0, 15.0)],
            0.01,
            "kept: the object keeps the distance, which is proved",
        ),
        (
            [near(20.0, 5.0)],
            0.01,
            "kept: the object keeps the distance, which is proved; if outlines are off, box might "
            "not (at 95 %)",
        ),
    ],
)
def test_the_answer_comes_first_who_how_surely_and_where_to_look(
    run: Run,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    frames: list[Finding],
    required_m: float,
    line: str,
) -> None:
    path = tmp_path / "r.h5"

    assert first_line(run, capsys, frames, path, required_m=required_m) == line


@pytest.mark.slow
def test_the_picture_shows_each_object_in_its_colours(
    run: Run, tmp_path: Path, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "curves.png"

    assert run("summary", path, "--picture", picture) == 0

    assert f"clearance against time: {picture}" in capsys.readouterr().out
    image = cv2.imread(str(picture))
    assert image is not None
    blue, green, red = image.astype(int).transpose(2, 0, 1)
    assert ((blue > 150) & (red < 60)).sum() > 200, "bounds"
    assert ((red > 200) & (blue < 190) & (green < 220) & (green > 100)).sum() > 2000, "a collision"
    assert run("summary", path, "--picture", picture) == 1
    assert "exists already" in capsys.readouterr().err
    assert run("summary", path, "--picture", picture, "--overwrite", "--json") == 0
    assert json.loads(capsys.readouterr().out)["picture"] == str(picture)


@pytest.mark.parametrize(
    ("picture", "status", "message"),
    [("curves.gif", 2, "pictures are .png, .svg, .pdf"), ("no/curves.png", 1, "no folder")],
)
def test_a_picture_that_cannot_be_is_told_first(
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    picture: str,
    status: int,
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)

    assert run("summary", "missing.h5", "--picture", picture) == status

    assert message in capsys.readouterr().err


def test_a_report_without_clearances_has_no_curves_and_says_how_to_get_them(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = write_ball_session(tmp_path / "session", np.zeros((1, 3)))
    scene = write_cube_scene(tmp_path, {"cube": (0.0, 0.0, 0.0)})
    path = tmp_path / "report.h5"
    call = ("detect", session, "--scene", scene, "-o", path, "--viewport", 3, "--no-response")
    assert run(*call, "--clearance-mm", 0) == 0
    rows = read_report(path).objects["cube"]
    assert "clearance_m" not in rows
    assert "survives" not in rows
    assert "d_rec_m" not in rows
    capsys.readouterr()

    assert run("summary", path, "--picture", tmp_path / "curves.png") == 1

    assert "holds no clearances to draw" in capsys.readouterr().err
    assert not (tmp_path / "curves.png").exists()


def test_frames_without_a_hull_are_told_and_leave_a_gap_in_the_curve(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "r.h5"
    nowhere = Clearance(15.8, np.inf, np.full(3, np.nan), np.full(3, np.nan), 0.0, 0.0)
    numbers = only([near(20.0, 15.0), replace(near(20.0), clearance=nowhere)], path)
    drawn: list[Any] = []
    monkeypatch.setattr("hybridve.hull.curves.write_clearances", lambda *a, **k: drawn.append(a))

    assert run("summary", path, "--picture", tmp_path / "curves.png") == 0

    assert numbers["frames_without_hull"] == 1
    assert "1 frame without a hull" in capsys.readouterr().out
    (curve,) = drawn[0][1]
    assert np.isfinite(curve.lower_mm).tolist() == [True, False]
    assert np.isfinite(curve.upper_mm).tolist() == [True, False]


def test_of_many_objects_the_nearest_are_drawn(
    tmp_path: Path, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = read_report(path)
    (rows,) = report.objects.values()
    drawn: list[Any] = []
    monkeypatch.setattr(
        "hybridve.hull.curves.write_clearances", lambda *a, **k: drawn.append((a, k))
    )
    many = {}
    for number in range(20):
        away_m = rows["clearance_m"] + 0.001 * ((7 * number) % 20)
        many[f"part{number}"] = replace(rows, columns={**rows.columns, "clearance_m": away_m})

    write_curves(tmp_path / "curves.png", replace(report, objects=many))

    ((_, curves), options) = drawn[0]
    shown = [int(curve.name.removeprefix("part")) for curve in curves]
    assert shown == sorted(number for number in range(20) if (7 * number) % 20 < 12)
    assert options["note"] == "the nearest 12 of 20 objects"
