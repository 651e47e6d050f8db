"""Compiled code is kept where it belongs, and never taken for that of other sources."""

import gc
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numba
import numpy as np
import pytest
from helpers.sessions import write_ball_session, write_cube_scene

from hybridve.hull import jit, prepare

DAY_S = 24 * 3600.0


@pytest.fixture
def base(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of this test's own, for compiled code, too."""
    monkeypatch.setenv("HYBRIDVE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    return tmp_path / "cache" / "compiled"


def age(folder: Path, days: float) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "code.nbc").touch()
    then_s = time.time() - days * DAY_S
    os.utime(folder, (then_s, then_s))


def kept_code(folder: Path) -> dict[str, int]:
    """Return the files of compiled code, and when each was written."""
    return {path.name: path.stat().st_mtime_ns for path in folder.rglob("*.nbc")}


def test_compiled_code_lies_in_the_cache_under_the_name_of_its_sources(
    base: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = jit.open_folder()

    assert folder is not None
    assert folder.parent == base
    assert folder.is_dir()
    assert jit.open_folder() == folder
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(base / "users"))
    assert jit.open_folder() == base / "users" / folder.name


def test_a_change_of_any_source_that_is_compiled_is_another_folder(
    base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel, plain = tmp_path / "hull" / "deep" / "kernel.py", tmp_path / "hull" / "plain.py"
    kernel.parent.mkdir(parents=True)
    kernel.write_text("from hybridve.hull.jit import compiled\n", encoding="utf-8")
    plain.write_text("", encoding="utf-8")
    monkeypatch.setattr(jit, "__file__", str(tmp_path / "hull" / "jit.py"))
    first = jit.open_folder()

    plain.write_text("changed = 1\n", encoding="utf-8")
    same = jit.open_folder()
    kernel.write_text("from hybridve.hull.jit import compiled  # changed\n", encoding="utf-8")
    other = jit.open_folder()

    assert first == same != other


def test_without_a_cache_nothing_is_kept(
    base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HYBRIDVE_CACHE", "off")
    assert jit.open_folder() is None

    (tmp_path / "file").write_text("not a folder", encoding="utf-8")
    monkeypatch.setenv("HYBRIDVE_CACHE", str(tmp_path / "file"))
    assert jit.open_folder() is None
    assert sorted(tmp_path.iterdir()) == [tmp_path / "file"]


@pytest.mark.slow
def test_without_a_cache_code_is_compiled_all_the_same(tmp_path: Path) -> None:
    code = (
        "import numpy as np\n"
        "from hybridve.hull.jit import folder\n"
        "from hybridve.hull.capture.background import learn_background\n"
        "print(folder(), learn_background([np.full((2, 2, 3), 7, np.uint8)]).mean.sum())"
    )
    environment = os.environ | {"HYBRIDVE_CACHE": "off", "XDG_CACHE_HOME": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)

    shown = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )

    assert shown.stdout.split() == ["None", "84.0"]
    assert list(tmp_path.iterdir()) == []


def test_code_of_other_sources_goes_after_a_month_without_use(base: Path) -> None:
    forgotten, in_use, users = base / ("a" * 16), base / ("b" * 16), base / "somebody_elses"
    for folder, days in ((forgotten, 31), (in_use, 29), (users, 400)):
        age(folder, days)

    jit.open_folder()

    assert not forgotten.exists()
    assert in_use.exists()
    assert users.exists()


def test_code_in_use_is_not_forgotten(base: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mine = jit.open_folder()
    assert mine is not None
    age(mine, 31)
    jit.open_folder()

    monkeypatch.setattr(jit, "_digest", lambda: "0" * 16)
    other = jit.open_folder()

    assert other != mine
    assert mine.exists()


def test_in_a_folder_that_the_user_names_nothing_is_removed(
    base: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(base))
    age(base / ("a" * 16), 31)

    assert jit.open_folder() is not None

    assert (base / ("a" * 16)).exists()


@pytest.mark.slow
def test_to_load_what_is_compiled_touches_no_folder(tmp_path: Path) -> None:
    environment = os.environ | {"HYBRIDVE_CACHE": str(tmp_path / "cache")}
    environment.pop("NUMBA_CACHE_DIR", None)
    code = "import hybridve.hull.prepare, hybridve.hull.evaluate"

    subprocess.run([sys.executable, "-c", code], env=environment, check=True)

    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def prepared(tmp_path: Path) -> tuple[Path, dict[str, str]]:
    """The folder of what was prepared, and an environment in which it is found.

    It is what set-up prepared for these sources, or, a minute or two later, what is prepared here.
    """
    environment = dict(os.environ)
    if not prepare.is_prepared():
        environment["HYBRIDVE_CACHE"] = str(tmp_path / "cache")
        environment.pop("NUMBA_CACHE_DIR", None)
    code = "from hybridve.hull.prepare import *; print(prepare_kernels(), folder())"
    shown = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )
    done, folder = shown.stdout.split()
    assert done == "True", shown.stderr
    return Path(folder), environment


@pytest.mark.slow
def test_after_preparing_detect_compiles_nothing(
    prepared: tuple[Path, dict[str, str]], tmp_path: Path
) -> None:
    folder, environment = prepared
    listed = (folder / "complete").read_text(encoding="utf-8").split()
    alone = tmp_path / "alone" / folder.name  # what other tests compile is not there
    for name in listed:
        source = folder / name
        (alone / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(source, alone / name)
    before = kept_code(alone)
    centers = np.array([[0.0, 0, 0], [0.05, 0, 0], [0.9, 0, 0]])
    session = write_ball_session(tmp_path, centers)
    scene = write_cube_scene(tmp_path, {"near": (0.0, 0.0, 150.0), "touched": (0.0, 0.0, 305.0)})
    report = tmp_path / "report.h5"
    arguments: list[str | Path] = [session, "--scene", scene, "-o", report, "--engine", "native"]

    detected = subprocess.run(
        [sys.executable, "-m", "hybridve.cli", "detect", *arguments],
        env=environment | {"NUMBA_CACHE_DIR": str(alone.parent)},
        capture_output=True,
        text=True,
    )

    assert detected.returncode == 0, detected.stderr
    assert kept_code(alone) == before
    names = {Path(name).name.split(".")[0] for name in listed}
    assert names >= {"native", "certify", "segment", "background", "push_out", "particles", "lamp"}


def test_nothing_is_compiled_that_is_done_or_would_not_be_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = []
    monkeypatch.setattr(prepare, "_run_kernels", lambda: runs.append(gc.isenabled()))
    monkeypatch.setattr(prepare, "_run_effects", lambda: None)
    monkeypatch.setattr(prepare, "folder", lambda: None)
    assert not prepare.prepare_kernels()
    assert runs == []

    monkeypatch.setattr(prepare, "folder", lambda: tmp_path)
    assert not prepare.is_prepared()
    assert prepare.prepare_kernels()
    assert prepare.prepare_kernels()

    assert runs == [False]
    assert gc.isenabled()
