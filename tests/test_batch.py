"""``hybridve batch``: sessions by layouts by settings, of which none loses another."""

import json
import os
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from helpers.pool_work import mark_and_die
from helpers.sessions import write_ball_session, write_cube_scene

from hybridve.calib.errors import SessionError
from hybridve.cli import threads
from hybridve.cli.batch import _check_lines
from hybridve.cli.main import _in_order
from hybridve.hull.manifest import append_record, checksum, made_of, read_records, verifies
from hybridve.hull.pool import Pool, ProcessDiedError
from hybridve.hull.report.read import read_report
from hybridve.hull.units import load_batch

Run = Callable[..., int]
HEAD = 'format = "hybridve-batch"\nversion = 1\noutput = "out"\n'


def a_batch(folder: Path, text: str) -> Path:
    """Write a batch beside three sessions and two layouts, of which only the names count."""
    for name in ("p1", "p2", "q1"):
        (folder / name).mkdir(exist_ok=True)
        (folder / name / "session.toml").touch()
    (folder / "lay").mkdir(exist_ok=True)
    for name in ("near", "far"):
        (folder / "lay" / f"{name}.toml").touch()
    path = folder / "night.toml"
    path.write_text(HEAD + text, encoding="utf-8")
    return path


ALL = 'sessions = ["p*", "q1/session.toml"]\nscenes = ["lay/*.toml"]\n'


def test_every_session_meets_every_layout_with_every_setting(tmp_path: Path) -> None:
    batch = load_batch(
        a_batch(
            tmp_path,
            ALL + "[options]\nviewport = 10\nresponse = false\n"
            '[[setting]]\nname = "quick"\noptions = { viewport = 4 }\n'
            '[[setting]]\nname = "fine"\noptions = { let-pass = ["open", "unknown"] }\n'
            '[[exception]]\nsession = "p2"\nscene = "far"\nskip = true\n'
            '[[exception]]\nsession = "q*"\nsetting = "fine"\noptions = { drop-camera = "cam2" }\n',
        )
    )

    names = [unit.name for unit in batch.units]
    assert len(set(names)) == len(names) == 3 * 2 * 2 - 2
    assert "p2__far__quick" not in names
    by_name = {unit.name: unit for unit in batch.units}
    quick, fine = by_name["p1__near__quick"], by_name["q1__near__fine"]
    assert quick.output == tmp_path / "out" / "p1__near__quick.h5"
    assert quick.words[6:] == ("--viewport", "4", "--no-response")
    assert fine.words[6:] == (
        *("--viewport", "10", "--no-response", "--let-pass", "open", "--let-pass", "unknown"),
        *("--drop-camera", "cam2"),
    )
    assert shlex.split(quick.line)[:3] == ["hybridve", "detect", f"{tmp_path}/p1/session.toml"]
    _check_lines(batch)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('sessions = ["r*"]\nscenes = ["lay/near.toml"]\n', "no session.toml matches 'r*'"),
        (ALL + '[[exception]]\nsession = "p9"\nskip = true\n', "nothing is called 'p9'"),
        (ALL + "[[exception]]\nskip = true\n", "all is skipped"),
        (ALL + '[[setting]]\nname = "a"\n[[setting]]\nname = "a"\n', "two have one name"),
        (ALL + "[options]\nviewprt = 4\n", "viewprt"),
        (ALL + "[options]\nviewport = 0\n", "viewport"),
        (ALL + "workers = 3\n", "there is no such key"),
        ('sessions = ["p1", "p1/session.toml"]\nscenes = ["lay/near.toml"]\n', ""),
    ],
)
def test_what_is_wrong_with_a_batch_is_told_before_anything_runs(
    text: str, told: str, tmp_path: Path
) -> None:
    path = a_batch(tmp_path, text)

    def asked() -> int:
        batch = load_batch(path)
        _check_lines(batch)
        return len(batch.units)

    if not told:
        assert asked() == 1  # one session that is named twice is one
        return
    with pytest.raises(SessionError) as error:
        asked()
    (line,) = error.value.lines
    assert told in line
    assert line.startswith(str(path))


# --- The manifest -----------------------------------------------------------------------------


def test_only_what_verifies_is_left_alone(tmp_path: Path) -> None:
    session = write_ball_session(tmp_path / "m", np.zeros((1, 3)), n_cameras=2)
    result = tmp_path / "r.h5"
    result.write_bytes(b"a result")
    words, versions = ("detect", "m"), {"numpy": "2"}

    def made() -> str:
        return made_of(words, [session], versions)

    record = {"unit": "m", "outcome": "done", "made_of": made(), "sha256": checksum(result)}
    assert verifies(record, result, made())
    assert not verifies(None, result, made())
    assert not verifies(record | {"outcome": "failed"}, result, made())
    assert not verifies(record, tmp_path / "other.h5", made())
    assert not verifies(record, result, made_of(("detect", "n"), [session], versions))
    assert not verifies(record, result, made_of(words, [session], {"numpy": "3"}))
    picture = session.parent / "cam0" / "0.png"
    picture.write_bytes(picture.read_bytes() + b"\0")
    assert not verifies(record, result, made())
    record["made_of"] = made()
    session.write_text(session.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    assert not verifies(record, result, made())
    record["made_of"] = made()
    result.write_bytes(b"a resulT")
    assert not verifies(record, result, made())


def test_a_manifest_that_a_kill_cut_off_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "MANIFEST.jsonl"
    append_record(path, {"unit": "a", "outcome": "failed"})
    append_record(path, {"unit": "a", "outcome": "done"})
    with path.open("a", encoding="utf-8") as file:
        file.write('{"unit": "b", "outc')
    append_record(path, {"unit": "c", "outcome": "done"})

    found = read_records(path)

    assert {name: one["outcome"] for name, one in found.items()} == {"a": "done", "c": "done"}
    assert len(path.read_text(encoding="utf-8").splitlines()) == 4
    assert read_records(tmp_path / "none.jsonl") == {}


# --- The pool ---------------------------------------------------------------------------------


def test_work_whose_process_is_killed_is_tried_once_again_and_harms_no_other(
    tmp_path: Path,
) -> None:
    deaths = {"whole": 0, "once": 1, "twice": 2, "wrong": -1, "later": 0}
    tasks = [(str(tmp_path / name), count) for name, count in deaths.items()]
    begun: list[str] = []
    answers: dict[str, Any] = {}

    with Pool(2, mark_and_die, (0, 1, 2)) as pool:
        pool.run(
            tasks,
            begun=lambda task: begun.append(Path(task[0]).name),
            ended=lambda task, answer: answers.update({Path(task[0]).name: answer}),
        )

    assert sorted(begun) == sorted(answers) == sorted(deaths)
    assert [answers[name][0] for name in ("whole", "once", "later")] == [1, 2, 1]
    assert isinstance(answers["twice"], ProcessDiedError)
    assert str(answers["wrong"]) == "this work is wrong"
    assert {answers[name][1] for name in ("whole", "once", "later")} <= {(0, 2), (1,)}


# --- The command ------------------------------------------------------------------------------


def small(folder: Path) -> Path:
    """Write two sessions that can be tested and one whose rig is broken."""
    for name in ("ann", "bob", "cut"):
        write_ball_session(folder / name, np.array([[0.0, 0, 0], [0.1, 0, 0]]), n_cameras=3)
    (folder / "cut" / "rig.csv").write_text("cam0,1,2\n", encoding="utf-8")
    write_cube_scene(folder / "lay", {"cube": (0.0, 0.0, 150.0)})
    path = folder / "night.toml"
    path.write_text(
        HEAD + 'sessions = ["ann", "bob", "cut"]\nscenes = ["lay"]\n'
        '[options]\nviewport = 4\nengine = "native"\nclearance-mm = 5\ndoubt = false\n',
        encoding="utf-8",
    )
    return path


@pytest.mark.slow
def test_a_night_loses_nothing_and_does_nothing_twice(
    tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = small(tmp_path), tmp_path / "out"

    assert run("batch", path, "--workers", 1, "--no-progress") == 1

    told = capsys.readouterr()
    assert "1 of 3 failed" in told.err
    assert "cut__lay" in told.err
    assert "expected 12" in told.err
    assert "clash" in told.out
    records = read_records(out / "MANIFEST.jsonl")
    assert {name: one["outcome"] for name, one in records.items()} == {
        **{"ann__lay": "done", "bob__lay": "done"},
        "cut__lay": "failed",
    }
    alone = tmp_path / "alone.h5"
    words = shlex.split(records["ann__lay"]["line"])[1:]
    words[words.index("-o") + 1] = str(alone)
    assert run(*words, "--no-progress") == 0
    expected, found = read_report(alone), read_report(out / "ann__lay.h5")
    for name, values in expected.objects["cube"].columns.items():
        assert values.tobytes() == found.objects["cube"].columns[name].tobytes(), name
    assert "hybridve detect" in found.attributes["command"]
    assert (out / "logs" / "cut__lay.log").read_text(encoding="utf-8").startswith("error: ")

    capsys.readouterr()
    assert run("batch", path, "--dry-run", "--json") == 0
    plan = json.loads(capsys.readouterr().out)
    assert [one["stands"] for one in plan["units"]] == [True, True, False]
    assert plan["seconds"] > 0

    # What is missing is mended, and what was spoilt is made anew; nothing else is touched.
    good = (tmp_path / "ann" / "rig.csv").read_text(encoding="utf-8")
    (tmp_path / "cut" / "rig.csv").write_text(good, encoding="utf-8")
    report = out / "bob__lay.h5"
    report.write_bytes(report.read_bytes()[:-100])
    before = (out / "ann__lay.h5").stat().st_mtime_ns
    assert run("batch", path, "--workers", 1, "--no-progress") == 0
    assert (out / "ann__lay.h5").stat().st_mtime_ns == before
    assert len(read_report(report).index) == 2
    assert len((out / "MANIFEST.jsonl").read_text(encoding="utf-8").splitlines()) == 5


def test_the_lines_of_a_batch_are_command_lines_for_whoever_runs_them(
    tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("batch", small(tmp_path), "--list") == 0

    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    for line in lines:
        words = shlex.split(line)
        assert words[:2] == ["hybridve", "detect"]
        assert words[-2:] == ["--resume", "--no-progress"]


# --- Threads ----------------------------------------------------------------------------------


def test_threads_may_stand_before_or_behind_the_command() -> None:
    wanted = ["--threads=2", "detect", "s", "-o", "r.h5"]

    assert _in_order(["detect", "s", "--threads", "2", "-o", "r.h5"]) == wanted
    assert _in_order(["--threads=2", "detect", "s", "-o", "r.h5"]) == wanted
    assert _in_order(["detect", "--", "--threads", "2"]) == ["detect", "--", "--threads", "2"]


def test_threads_are_processors_that_the_process_may_use(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[list[int]] = []
    for name in threads._ASKED:
        monkeypatch.setenv(name, "7")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {2, 3, 5, 7}, raising=False)
    monkeypatch.setattr(
        os, "sched_setaffinity", lambda _, cpus: taken.append(list(cpus)), raising=False
    )

    threads.take_threads(2)
    threads.take_threads(9)

    assert [len(one) for one in taken] == [2, 4]
    assert all(set(one) <= {2, 3, 5, 7} and len(set(one)) == len(one) for one in taken)
    assert {os.environ[name] for name in threads._ASKED} == {"4"}
    assert run("--threads", 0, "plan", "--example") == click.UsageError.exit_code
