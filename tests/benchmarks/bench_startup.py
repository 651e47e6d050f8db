"""How long a user waits: ``--help``, the first ``detect``, and every later one.

Each round is a process of its own, timed from outside. ``detect`` evaluates one frame; what it says
on stderr tells when it began with that frame (its bar appears) and when the frame was done (it says
that it writes the report). Between the two lies learning the backgrounds of a recording, which is
work on the recording; the session of ready masks has none.

"cold" finds nothing that is kept: no compiled kernel, no compiled shader, no mesh and no lens;
"first" finds the kernels that `make` compiles, and "later" everything. In all of them the files of
the libraries are in memory, because earlier rounds read them: the first start after a boot also
waits for the disk. `cpu_s` is the processor time of the whole process, all threads and the
processes it waited for: it hardly depends on what else the machine does.
"""

import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.sessions import write_ball_session, write_cube_scene

from hybridve.calib.formats.rig_json import write_rig

PROJECT = Path(__file__).parent.parent.parent

Environment = Callable[[Path], dict[str, str]]

#: What the waits are to stay below, in seconds (for the reader: nothing is asserted).
AIM_S = {"help": 0.5, "cold": 10.0, "first": 10.0, "later": 1.5}

#: How often each start is measured: a cold one takes long.
ROUNDS = {"cold": 3, "first": 5, "later": 9}


@dataclass
class Waits:
    """The waits of one process after another, in seconds from its start, and what it worked."""

    frames_s: list[float] = field(default_factory=list)
    first_frame_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)

    def run(self, arguments: list[str], environment: dict[str, str]) -> None:
        started = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "hybridve.cli", *arguments],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        assert process.stderr is not None
        seen = b""
        while chunk := os.read(process.stderr.fileno(), 4096):
            now_s = time.perf_counter() - started
            for sign, waits in ((b"detect:", self.frames_s), (b"writing ", self.first_frame_s)):
                if sign not in seen and sign in seen + chunk:
                    waits.append(now_s)
            seen += chunk
        process.stderr.close()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        assert process.returncode == 0, seen.decode()
        self.cpu_s.append(used.ru_utime + used.ru_stime)


@pytest.fixture(scope="module", params=["masks", "horseman"])
def job(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return the arguments of a ``detect`` of one frame in which something collides."""
    folder = tmp_path_factory.mktemp(request.param)
    if request.param == "masks":
        session = write_ball_session(folder, np.zeros((1, 3)))
        scene = write_cube_scene(folder, {"part": (0.0, 0.0, 150.0)})
    else:
        _, rig = request.getfixturevalue("horseman")
        for name in ("session.toml", "scene.toml"):
            (folder / name).write_bytes((PROJECT / "data" / "horseman" / name).read_bytes())
        session, scene = folder / "session.toml", folder / "scene.toml"
        (folder / "rig").mkdir()
        write_rig(folder / "rig" / "rig.json", rig)
    places = ["--scene", str(scene), "-o", str(folder / "report.h5"), "--overwrite"]
    return ["detect", str(session), *places, "--frames", "0:1"]


@pytest.fixture(scope="module")
def with_caches(is_full: bool) -> Environment:
    """The environment in which all that is kept for later is kept in a folder.

    The smallest takes code that is compiled already: compiling takes most of a minute.
    """
    others = dict(os.environ)
    if is_full:
        others.pop("NUMBA_CACHE_DIR", None)
    return lambda folder: (
        others
        | {
            "MESA_SHADER_CACHE_DIR": str(folder / "shaders"),
            "HYBRIDVE_CACHE": str(folder / "hybridve"),
        }
    )


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory, with_caches: Environment) -> Path:
    """A cache as `make` leaves it."""
    folder = tmp_path_factory.mktemp("prepared")
    (folder / "hybridve").mkdir()
    Waits().run(["doctor", "--prepare"], with_caches(folder))
    return folder


@pytest.mark.parametrize("engine", ["native", "compute"])
@pytest.mark.parametrize("start", ["cold", "first", "later"])
@pytest.mark.smallest(job="masks", start="first", engine="native")
def bench_detect(
    benchmark: Any,
    tmp_path: Path,
    with_caches: Environment,
    prepared: Path,
    job: list[str],
    start: str,
    engine: str,
) -> None:
    """From the command to its end; the waits up to the frames and the first one are beside it."""
    waits = Waits()
    arguments = [*job, "--engine", engine]
    if start == "later":
        shutil.copytree(prepared, tmp_path / "0")
        Waits().run(arguments, with_caches(tmp_path / "0"))
    folders = (tmp_path / ("0" if start == "later" else str(number)) for number in range(100))

    def setup() -> tuple[tuple[Any, ...], dict[str, Any]]:
        folder = next(folders)
        if start == "first":
            shutil.copytree(prepared / "hybridve", folder / "hybridve")
        return (arguments, with_caches(folder)), {}

    benchmark.pedantic(waits.run, setup=setup, rounds=ROUNDS[start])
    for name, values in (("frames", waits.frames_s), ("first_frame", waits.first_frame_s)):
        benchmark.extra_info[f"{name}_after_s"] = round(statistics.median(values), 2)
        benchmark.extra_info[f"{name}_after_min_s"] = round(min(values), 2)
    benchmark.extra_info["cpu_s"] = round(statistics.median(waits.cpu_s), 2)
    benchmark.extra_info["aim_s"] = AIM_S[start]
    for kept in ("hybridve/compiled", "hybridve/meshes", "hybridve/lenses", "shaders"):
        files = [path for path in (tmp_path / "0" / kept).rglob("*") if path.is_file()]
        benchmark.extra_info[f"{Path(kept).name}_files"] = len(files)


def bench_prepare(benchmark: Any, tmp_path: Path, with_caches: Environment) -> None:
    """``hybridve doctor --prepare`` where nothing is compiled: what `make` adds to an install."""
    waits = Waits()
    folders = (tmp_path / str(number) for number in range(100))

    def setup() -> tuple[tuple[Any, ...], dict[str, Any]]:
        return (["doctor", "--prepare"], with_caches(next(folders))), {}

    benchmark.pedantic(waits.run, setup=setup, rounds=ROUNDS["cold"])
    benchmark.extra_info["cpu_s"] = round(statistics.median(waits.cpu_s), 2)


def bench_help(benchmark: Any) -> None:
    """``hybridve --help``, whole."""
    waits = Waits()
    benchmark.pedantic(waits.run, args=(["--help"], dict(os.environ)), rounds=15, warmup_rounds=1)
    benchmark.extra_info["cpu_s"] = round(statistics.median(waits.cpu_s), 2)
    benchmark.extra_info["aim_s"] = AIM_S["help"]
