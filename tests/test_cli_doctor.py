"""``hybridve doctor``: what fails is told with what installs it, and nothing ends doctor itself."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.sessions import write_ball_session, write_cube_scene

from hybridve.cli.doctor import Outcome, try_each
from hybridve.hull.report.read import read_report

Run = Callable[..., int]

#: What libraries do where something of theirs is missing: raise, end the process, or leave.
BROKEN = {
    "raises": "raise ImportError('libEGL.so.1: cannot open shared object file: No such file')",
    "speaks": "print('hello')\nraise RuntimeError('first line\\nsecond line')",
    "dies": "import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)",
    "leaves": "import os\nos._exit(3)",
    "exits": "import sys\nsys.exit(4)",
    "good": "print('hello')",
}


@pytest.fixture
def broken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder whose modules are found first; each of `BROKEN` stands in it."""
    folder = tmp_path / "broken"
    folder.mkdir()
    for name, text in BROKEN.items():
        (folder / f"{name}.py").write_text(text, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(folder))
    return folder


@pytest.fixture
def without_egl(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenGL looks for a library of EGL that is not there."""
    monkeypatch.setenv("GLCONTEXT_LINUX_LIBEGL", "libEGL-that-is-not-here.so.1")


@pytest.mark.usefixtures("broken")
def test_what_ends_its_process_ends_nothing_else() -> None:
    found = try_each(["raises", "dies", "speaks", "leaves", "exits", "good", "nowhere"])

    missing = "ImportError: libEGL.so.1: cannot open shared object file: No such file"
    assert found == {
        "raises": Outcome("", missing),
        "dies": Outcome("", "it ended the process with SIGSEGV"),
        "speaks": Outcome("", "RuntimeError: first line"),
        "leaves": Outcome("", "it ended the process with status 3"),
        "exits": Outcome("", "SystemExit: 4"),
        "good": Outcome("loaded", ""),
        "nowhere": Outcome("", "ModuleNotFoundError: No module named 'nowhere'"),
    }


@pytest.mark.slow  # loads all libraries in processes of their own
def test_a_library_that_fails_is_told_with_what_installs_it(
    broken: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    (broken / "mujoco.py").write_text(BROKEN["dies"], encoding="utf-8")
    (broken / "matplotlib.py").write_text(
        "raise ImportError('libz.so.1: cannot open shared object file: No such file')",
        encoding="utf-8",
    )
    (broken / "yaml.py").write_text("raise ModuleNotFoundError(\"No module named 'yaml'\")")

    assert run("doctor", "--json") == 1

    found = json.loads(capsys.readouterr().out)
    yaml, curves, bodies = found["problems"]
    assert yaml.startswith("yaml cannot be loaded")
    assert yaml.endswith("rigs of Kalibr; pip install pyyaml")
    assert curves.endswith("pictures of curves; apt-get install zlib1g")
    assert "SIGSEGV" in bodies
    assert "rigid bodies, hinges and cloth" in bodies
    assert found["engine"] == "native"


@pytest.mark.slow
@pytest.mark.usefixtures("without_egl")
def test_without_egl_doctor_tells_it_and_all_but_pictures_works(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = write_ball_session(tmp_path / "session", np.zeros((2, 3)))
    scene = write_cube_scene(tmp_path / "scene", {"cube": (0.0, 0.0, 0.0)})
    report = tmp_path / "report.h5"

    assert run("doctor") == 1
    (line,) = [one for one in capsys.readouterr().out.splitlines() if one.startswith("problem")]
    assert "apt-get install libegl1 libgl1-mesa-dri" in line
    assert "--engine native" in line
    assert run("detect", session, "--scene", scene, "-o", report, "--no-progress") == 0
    assert read_report(report).attributes["engine"] == "native"
    capsys.readouterr()
    assert run("render", session, "--scene", scene, "-o", tmp_path / "p.png") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "no OpenGL 4.3 through EGL" in line
    assert not (tmp_path / "p.png").exists()


@pytest.mark.slow
def test_a_command_without_a_library_is_one_line_that_sends_to_doctor(
    broken: Path, tmp_path: Path
) -> None:
    (broken / "cv2.py").write_text(BROKEN["raises"], encoding="utf-8")

    done = subprocess.run(
        [sys.executable, "-m", "hybridve.cli", "check", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(broken)},
    )

    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "libEGL.so.1" in line
    assert "`hybridve doctor` tells what is missing" in line
