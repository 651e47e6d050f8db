"""``hybridve clashes`` and ``hybridve diff`` as people use them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.clash_reports import Spot, write_clash_report
from helpers.sessions import write_ball_session, write_cube_scene

from hybridve.hull.report.clashes import rules_of
from hybridve.hull.report.read import read_report

Run = Callable[..., int]

LEFT, RIGHT = (-0.04, 0.0, 0.5), (0.04, 0.0, 0.5)


@pytest.fixture
def report(tmp_path: Path) -> Path:
    frames = [[Spot(LEFT, 0.03), Spot(RIGHT, -0.002)], [Spot(RIGHT, -0.003)], []]
    return write_clash_report(tmp_path / "r.h5", frames, required_m=0.005)


def told(run: Run, capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    capsys.readouterr()
    run(*arguments, "--json")
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def error_of(
    run: Run, capsys: pytest.CaptureFixture[str], *arguments: object, status: int = 1
) -> str:
    capsys.readouterr()
    assert run(*arguments) == status
    shown = capsys.readouterr()
    assert shown.out == ""
    if status == 1:
        assert len(shown.err.splitlines()) == 1
    return shown.err


def test_the_answer_comes_first_and_the_worst_on_top(
    run: Run, report: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("clashes", report) == 0

    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("2 clashes (2 new); look first at box-")
    assert "reaches into box, 30.0 +-0.1 mm deep (frame 0, 0.00 s); sure" in lines[0]
    assert "3 contacts of single frames gathered into 2 clashes" in lines[1]
    assert lines[3].split()[1:4] == ["new", "clash", "box"]
    assert lines[4].split()[1:5] == ["new", "too", "near", "box"]
    assert f"ids and decisions: {report.with_suffix('.clashes.toml')}" in lines[-1]


def test_what_was_decided_is_kept_shown_and_lets_a_script_pass(
    run: Run, report: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = (one["id"] for one in told(run, capsys, "clashes", report)["clashes"])
    assert run("clashes", report, "--fail-on-clash") == 3

    why = ("--comment", "only the sleeve", "--who", "anna")
    assert run("clashes", report, "--approve", first, *why, "--fail-on-clash") == 3
    assert run("clashes", report, "--resolve", second, "--fail-on-clash") == 0

    assert f"{first}: only the sleeve, anna" in capsys.readouterr().out
    found = told(run, capsys, "clashes", report)
    assert found["counts"] == {"approved": 1, "resolved": 1}
    assert found["clashes"][0]["who"] == "anna"
    assert run("clashes", report, "--reopen", first, "--fail-on-clash") == 3
    (again, _) = told(run, capsys, "clashes", report)["clashes"]
    assert (again["status"], again["comment"]) == ("active", "only the sleeve")


def test_json_has_all_about_a_clash_in_metres(
    run: Run, report: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = told(run, capsys, "clashes", report)["clashes"]

    assert (first["kind"], second["kind"]) == ("clash", "too near")
    assert first["worst"]["lower_m"] == pytest.approx(-0.0301)
    assert first["worst"]["upper_m"] == pytest.approx(-0.03)
    assert first["worst"]["on_object_m"] == pytest.approx(LEFT)
    assert first["place_on_part_m"] == pytest.approx([-0.04, 0.0, 0.495])  # what is on the part
    assert (second["first_frame"], second["last_frame"], second["frames"]) == (0, 1, 2)
    assert second["worst"]["ends_at"] == []
    assert first["sure"] is True


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (("--approve", "bax-2222"), 1, "there is no clash 'bax-2222'"),
        (("--comment", "why"), 2, "--comment says why"),
        (("--approve", "x", "--who", "a\x1bb"), 2, r"--who holds a control character, in 'a\x1bb'"),
        (("--approve", "x", "--review", "x"), 2, "x is decided about twice"),
    ],
)
def test_a_decision_that_cannot_be_is_one_line_and_nothing_is_written(
    run: Run,
    report: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    status: int,
    message: str,
) -> None:
    assert message in error_of(run, capsys, "clashes", report, *arguments, status=status)
    assert [path.name for path in report.parent.iterdir()] == ["r.h5"]


def test_a_ledger_that_is_nonsense_is_never_written_over(
    run: Run, report: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ledger = report.with_suffix(".clashes.toml")
    ledger.write_text('status = "aproved', encoding="utf-8")

    assert "not valid TOML" in error_of(run, capsys, "clashes", report)
    assert "not valid TOML" in error_of(run, capsys, "clashes", report, "--approve", "x")
    assert ledger.read_text(encoding="utf-8") == 'status = "aproved'


def test_where_nothing_can_be_written_a_look_is_possible_and_a_decision_is_not(
    run: Run, report: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ledger = tmp_path / "no" / "ledger.toml"

    assert run("clashes", report, "--ledger", ledger) == 0
    shown = capsys.readouterr()
    assert "cannot be written" in shown.err
    assert shown.out.startswith("2 clashes")
    name = shown.out.splitlines()[3].split()[0]
    call = ("clashes", report, "--ledger", ledger, "--approve", name)
    assert "cannot be written" in error_of(run, capsys, *call)


def test_reports_in_a_folder_share_its_ledger_if_there_is_one(
    run: Run, report: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write_clash_report(report.with_name("p2.h5"), [[Spot((-0.038, 0.001, 0.5), 0.03)]])
    ledger = report.with_name("clashes.toml")
    first, _ = told(run, capsys, "clashes", report, "--ledger", ledger)["clashes"]

    (found,) = told(run, capsys, "clashes", other)["clashes"]

    assert found["id"] == first["id"]
    names = sorted(path.name for path in report.parent.iterdir())
    assert names == ["clashes.toml", "p2.h5", "r.h5"]


@pytest.mark.slow
def test_what_no_longer_clashes_is_told_and_what_was_never_found_too(
    run: Run, report: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, _ = (one["id"] for one in told(run, capsys, "clashes", report)["clashes"])
    frames = [[Spot(RIGHT, -0.002)], [], []]
    write_clash_report(report, frames, required_m=0.005, made="2026-02-01")

    assert run("clashes", report) == 0
    assert f"no longer found, so resolved: {first}" in capsys.readouterr().out

    free = write_clash_report(report.parent / "free.h5", [[], []])
    assert run("clashes", free, "--fail-on-clash") == 0
    assert capsys.readouterr().out.startswith("no clashes: ")


def test_rules_of_a_scene_replace_those_of_the_report(
    run: Run, report: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "box.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", encoding="utf-8")
    scene = tmp_path / "scene.toml"
    scene.write_text(
        'format = "hybridve-scene"\nversion = 1\n[[object]]\nname = "box"\nmesh = "box.obj"\n'
        'unit = "m"\n[[rule]]\nshortest_s = 0.15\ncomment = "brushes past"\n',
        encoding="utf-8",
    )

    assert run("clashes", report, "--scene", scene) == 0

    shown = capsys.readouterr().out
    assert shown.startswith("1 clash (1 new)")
    assert "rule 1 left out 1 clash in 1 frame: shorter than 0.15 s (brushes past)" in shown


@pytest.mark.slow
def test_a_clash_keeps_its_id_and_status_when_the_report_is_made_anew(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A ball of 20 cm radius goes through a cube, seen by cameras of 13 mm a pixel."""
    centers = np.column_stack([np.linspace(-0.3, 0.3, 8), np.full(8, 0.15), np.zeros(8)])
    session = write_ball_session(tmp_path / "session", centers)
    larger = write_ball_session(tmp_path / "larger", centers)
    for mask in larger.parent.glob("*/*.png"):
        image = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        cv2.imwrite(str(mask), cv2.dilate(image, np.ones((3, 3))))
    scene = write_cube_scene(tmp_path / "scene", {"cube": (0.0, 0.0, 0.0)})
    moved = write_cube_scene(tmp_path / "moved", {"cube": (1.0, 1.0, 1.0)})
    scene.write_text(scene.read_text() + "\n[[rule]]\nshortest_s = 0.02\n", encoding="utf-8")
    report = tmp_path / "r.h5"

    def detected(of: Path, layout: Path, *more: str) -> dict[str, Any]:
        call = ("detect", of, "--scene", layout, "-o", report, "--viewport", 8, "--no-response")
        assert run(*call, "--no-progress", "--overwrite", *more) == 0
        clash: dict[str, Any]
        (clash,) = told(run, capsys, "clashes", report)["clashes"]
        return clash

    first = detected(session, scene)
    assert [rule.shortest_s for rule in rules_of(read_report(report))] == [0.02]
    assert run("clashes", report, "--approve", first["id"], "--comment", "a ball") == 0
    again = [
        detected(session, scene, "--frames", "::2"),
        detected(larger, scene),
        detected(session, moved),
    ]

    for clash in again:
        assert (clash["id"], clash["status"]) == (first["id"], "approved")
        assert (clash["comment"], clash["ties"]) == ("a ball", [])
    assert first["kind"] == "clash"


def reports(folder: Path, old: list[Spot], new: list[Spot], seen: str = "two") -> list[Path]:
    """Write two reports of one layout that requires 5 mm, of silhouettes of their own."""
    return [
        write_clash_report(folder / name, [spots] * 2, required_m=0.005, seen=which)
        for name, spots, which in (("old.h5", old, "one"), ("new.h5", new, seen))
    ]


@pytest.mark.parametrize(
    ("old", "new", "status", "changes"),
    [
        ([Spot(LEFT, 0.03)], [Spot(LEFT, 0.0301)], 0, ["same"]),
        ([Spot(LEFT, 0.03)], [Spot(LEFT, 0.033)], 6, ["worse"]),
        ([Spot(LEFT, 0.03)], [Spot(LEFT, 0.027)], 0, ["better"]),
        ([Spot(LEFT, 0.03)], [Spot(LEFT, 0.03), Spot(RIGHT, 0.01)], 6, ["appeared", "same"]),
        ([Spot(LEFT, 0.03), Spot(RIGHT, -0.001)], [Spot(LEFT, 0.03)], 0, ["vanished", "same"]),
        ([Spot(LEFT, 0.03), Spot(RIGHT, -0.0048)], [Spot(LEFT, 0.03)], 0, ["unclear", "same"]),
        ([], [], 0, []),
    ],
)
def test_a_change_is_what_is_beyond_what_both_reports_may_be_off(
    run: Run,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    old: list[Spot],
    new: list[Spot],
    status: int,
    changes: list[str],
) -> None:
    pair = reports(tmp_path, old, new)

    assert run("diff", *pair) == status

    text = capsys.readouterr().out
    assert text.startswith("no change") == (set(changes) <= {"same", "unclear"})
    found = told(run, capsys, "diff", *pair)
    assert [one["change"] for one in found["comparisons"][0]["clashes"]] == changes
    assert found["worse"] is (status == 6)
    assert not (tmp_path / "new.clashes.toml").exists()


def test_what_changed_most_is_told_first(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = [Spot(LEFT, 0.03), Spot(RIGHT, 0.01)]
    pair = reports(tmp_path, both, [Spot(LEFT, 0.04), Spot(RIGHT, 0.01)])

    assert run("diff", *pair) == 6

    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("worse: 1 worse (1 clash the same); look first at box-")
    assert first.endswith(
        ": 30.0 +-0.1 deep (mm, frame 0) before, 40.0 +-0.1 deep (mm, frame 0) now"
    )


def test_of_the_same_silhouettes_a_tenth_of_a_millimetre_counts(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pair = reports(tmp_path, [Spot(LEFT, 0.03)], [Spot(LEFT, 0.0303)], seen="one")

    assert run("diff", *pair) == 6
    assert "the same silhouettes, so that only bounds count" in capsys.readouterr().out


@pytest.mark.slow
def test_a_clash_that_broke_in_two_has_not_appeared(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = [Spot((0.0, 0.0, 0.5), 0.02, size_m=0.12)]
    ends = [Spot((-0.05, 0.0, 0.5), 0.02), Spot((0.05, 0.0, 0.5), 0.01)]

    for old, new in ((whole, ends), (ends, whole)):
        pair = reports(tmp_path, old, new)
        assert run("diff", *pair) == 0
        assert capsys.readouterr().out.startswith("no change")


def test_clashes_are_called_in_a_diff_what_the_ledger_calls_them(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new = reports(tmp_path, [Spot(LEFT, 0.03)], [Spot(LEFT, 0.03)])
    (mine,) = told(run, capsys, "clashes", old)["clashes"]
    ledger = old.with_suffix(".clashes.toml")
    text = ledger.read_text(encoding="utf-8").replace(mine["id"], "the-sleeve")
    ledger.write_text(text, encoding="utf-8")

    (found,) = told(run, capsys, "diff", old, new)["comparisons"][0]["clashes"]

    assert found["id"] == "the-sleeve"


def test_of_one_recording_the_frames_are_compared_that_both_have(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    deeper = [[Spot(LEFT, 0.01 + 0.01 * frame)] for frame in range(4)]
    every = write_clash_report(tmp_path / "every.h5", deeper)
    other = write_clash_report(tmp_path / "other.h5", deeper[::2], step=2)

    assert run("diff", every, other) == 0
    assert "in the 2 frames that both have" in capsys.readouterr().out


def test_folders_are_compared_report_by_report(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write_clash_report(tmp_path / folder / "same.h5", [[Spot(LEFT)]])
    write_clash_report(tmp_path / "a" / "alone.h5", [[]])

    assert run("diff", tmp_path / "a", tmp_path / "b") == 0

    text = capsys.readouterr().out
    assert "no change (1 clash the same)" in text
    assert f"{tmp_path / 'a' / 'alone.h5'}: the other folder has no such report" in text


def test_what_cannot_be_compared_is_told_in_one_line(
    run: Run, tmp_path: Path, report: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()

    assert "is a folder" in error_of(run, capsys, "diff", tmp_path, report)
    message = error_of(run, capsys, "diff", tmp_path, tmp_path / "empty")
    assert "have no reports (*.h5) of the same name" in message
    missing = tmp_path / "missing.h5"
    assert f"{missing}: there is no such report" in error_of(run, capsys, "diff", report, missing)
    assert list((tmp_path / "empty").iterdir()) == []
