"""``hybridve doctor``: what this machine has, and what it lacks."""

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import click

from hybridve.cli import options


@dataclass(frozen=True, slots=True)
class _Need:
    """A library that is loaded, what installs it, and what does not work without it."""

    module: str
    package: str
    serves: str


_NEEDS = (
    _Need("numpy", "numpy", "every command"),
    _Need("cv2", "opencv-python-headless", "every command that reads pictures"),
    _Need("numba", "numba", "detect, spacing, simulate and segment"),
    _Need("scipy.optimize", "scipy", "calibrate, detect and spacing"),
    _Need("h5py", "h5py", "reports and stored silhouettes"),
    _Need("pydantic", "pydantic", "every command that reads a session or a scene"),
    _Need("pycolmap", "pycolmap", "every command that needs a rig"),
    _Need("yaml", "pyyaml", "rigs of Kalibr"),
    _Need("tqdm", "tqdm", "progress"),
    _Need("matplotlib.pyplot", "matplotlib", "pictures of curves"),
    _Need("jinja2", "jinja2", "certificate.html, and reports as pages"),
    _Need("skimage.measure", "scikit-image", "the hull as a surface (export)"),
    _Need("av", "av", "films"),
    _Need("cascadio", "cascadio", "STEP files"),
    _Need("mujoco", "mujoco-core", "simulate: rigid bodies, hinges and cloth"),
    _Need("moderngl", "moderngl", "render, and the engines compute and stencil"),
)

#: Debian packages that bring shared libraries which these load.
_DEBIAN = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libGLX.so.0": "libglx0",
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libatomic.so.1": "libatomic1",
    "libgcc_s.so.1": "libgcc-s1",
    "libglib-2.0.so.0": "libglib2.0-0",
    "libgomp.so.1": "libgomp1",
    "libgthread-2.0.so.0": "libglib2.0-0",
    "libstdc++.so.6": "libstdc++6",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libxcb.so.1": "libxcb1",
    "libz.so.1": "zlib1g",
}

#: A trial that takes longer hangs, in seconds.
_LONGEST_S = 300.0


@click.command(short_help="Tell what this machine has.")
@click.option(
    "--prepare", is_flag=True, help="Compile for this machine now what the first detect would."
)
@options.json_option
def doctor(prepare: bool, as_json: bool) -> None:
    """Tell what this machine has: OpenGL renderer, threads, versions, and what is missing.

    All that the commands load is tried, each in a process that it may end, and what fails is told
    with what installs it.

    With --prepare, the loops of the query are compiled, if they are not yet: a minute or two that
    the first detect need not wait. They are kept in ~/.cache/hybridve, or where HYBRIDVE_CACHE
    says.

    Leaves with status 1 if something is missing. Without OpenGL all commands but render work, with
    the engine native.
    """
    found = examine()
    prepare_s = None
    if prepare and found["engine"]:
        prepare_s = _prepare()
        found["compiled"] = True
    found["prepare_s"] = prepare_s
    if as_json:
        options.tell(json.dumps(found))
    else:
        options.tell(f"machine    {found['machine']}")
        options.tell(f"opengl     {found['opengl'] or 'none'}")
        engine = f"{found['engine']} (what --engine auto takes here)"
        options.tell(f"engine     {engine if found['engine'] else 'none'}")
        ready = "compiled" if found["compiled"] else "compiled in the first detect, or by --prepare"
        options.tell(f"query      {ready}" + (f" ({prepare_s:.1f} s)" if prepare_s else ""))
        for package, number in found["versions"].items():
            options.tell(f"{package:24}{number}")
        for problem in found["problems"]:
            options.tell(f"problem    {problem}")
        if not found["problems"]:
            options.tell("nothing is missing")
    if found["problems"]:
        sys.exit(1)


def _prepare() -> float:
    """Compile what detect needs, and return how many seconds that took."""
    from hybridve.hull.prepare import prepare_kernels

    started = time.perf_counter()
    prepare_kernels()
    return time.perf_counter() - started


def examine() -> dict[str, Any]:
    """Return what the machine has, as plain JSON values."""
    from hybridve.hull.report.machine import machine_text, n_threads, software_versions

    tried = try_each([need.module for need in _NEEDS])
    problems = [
        f"{need.module} cannot be loaded ({tried[need.module].problem}), needed for "
        f"{need.serves}; {_remedy(tried[need.module].problem, need.package)}"
        for need in _NEEDS
        if tried[need.module].problem
    ]
    tried |= try_each(["opengl", "engine", "compiled"])
    gl, engine = tried["opengl"], tried["engine"]
    # What comes of a library that is told of already is not told again.
    if gl.problem and not tried["moderngl"].problem:
        problems.append(f"render cannot draw: {gl.problem}")
    if engine.problem and not problems:
        problems.append(f"no engine can be opened: {engine.problem}")
    return {
        "machine": machine_text(),
        "threads": n_threads(),
        "opengl": gl.found,
        "opengl_problem": gl.problem,
        "engine": engine.found,
        "compiled": bool(tried["compiled"].found),
        "versions": software_versions(),
        "problems": problems,
    }


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a trial: what was found, or what went wrong; the other is empty."""

    found: str
    problem: str


def try_each(names: Sequence[str]) -> dict[str, Outcome]:
    """Return what comes of trials, by name; see `hybridve.cli.trials`.

    All run in one process; where one ends it, the rest run in another.
    """
    outcomes: dict[str, Outcome] = {}
    left = list(names)
    while left:
        # -P: what lies in the folder where the user stands is not what is installed.
        command = [sys.executable, "-P", "-m", "hybridve.cli.trials", *left]
        try:
            done = subprocess.run(command, capture_output=True, check=False, timeout=_LONGEST_S)
            out, ended = done.stdout, _ended(done.returncode)
        except subprocess.TimeoutExpired as hung:
            out, ended = hung.stdout or b"", f"it did not end within {_LONGEST_S:g} s"
        for line in out.decode("utf-8", "replace").splitlines():
            name, found, problem = json.loads(line)
            outcomes[name] = Outcome(found, problem)
        left = [name for name in left if name not in outcomes]
        if left:
            outcomes[left.pop(0)] = Outcome("", ended)
    return outcomes


def _ended(status: int) -> str:
    """Return in words how a trial ended its process."""
    if status < 0:
        return f"it ended the process with {signal.Signals(-status).name}"
    return f"it ended the process with status {status}"


def _remedy(problem: str, package: str) -> str:
    """Return what to do about a library that cannot be loaded.

    Examples
    --------
    >>> _remedy("ImportError: libGL.so.1: cannot open shared object file: No such ...", "moderngl")
    'apt-get install libgl1'
    >>> _remedy("ModuleNotFoundError: No module named 'yaml'", "pyyaml")
    'pip install pyyaml'
    """
    missing = re.search(r"(lib[\w.+-]+\.so[.\d]*): cannot open shared object", problem)
    if missing is not None:
        if missing[1] in _DEBIAN:
            return f"apt-get install {_DEBIAN[missing[1]]}"
        return f"install the Debian package that brings {missing[1]} (apt-file search {missing[1]})"
    if problem.startswith("ModuleNotFoundError"):
        return f"pip install {package}"
    return f"pip install --force-reinstall {package}"
