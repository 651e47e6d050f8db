"""What effects add to a run: to its start, to a frame, and to memory; alone and together.

Each row is a process of its own that runs a recording (a ball of 0.2 m that comes and goes, seen by
four cameras of 160 x 120 pixels, ready masks, 25 frames a second) through `simulate`'s loop, with a
scene that names one effect, or all: balls, sheets of cloth, clouds of particles, a lamp, zones. The
row "none" goes through the same frames without any, and imports none. Told are

* start: imports, the scene read, and effects made, beyond what "none" takes;
* frame: what the effects take of a frame of 20 steps of 2 ms, median and 95 %; and the hulls
  between two frames, which "none" does without;
* memory: the most that the process held, beyond that of "none".

Compiled code is at hand: each row runs once before. Bodies hang about the way of the ball, which
meets some of them. Last, `hybridve detect` with a scene that names effects, which it leaves alone,
and with the same scene without them, in turn: seconds from the command to its end.

Run: python tests/benchmarks/bench_effects.py
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))

from helpers.sessions import CUBE, SCENE_HEAD, write_ball_session

#: Runs a scene and tells what it took.
_CHILD = """
import json, resource, sys, time
started = time.perf_counter()
from pathlib import Path
from typing import Any
from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture.session import load_session
from hybridve.hull.chain import EvaluateSettings, hulls, make_chain
from hybridve.hull.query.choose import open_engine
session, scene = map(Path, sys.argv[1:])
loaded = load_scene(scene)
chain = make_chain(load_session(session), loaded, EvaluateSettings())
seconds, between = [], []
if loaded.effects:
    from hybridve.hull.simulate import SimulateSettings, Simulation
    with open_engine("native") as engine:
        simulation = Simulation.of(chain, engine, SimulateSettings())
        start_s = time.perf_counter() - started
        for frame in simulation.run():
            if frame.n_steps:
                seconds.append(
                    sum(float(frame.values[n[0]]["step_s"]) for _, n in simulation.effects)
                )
                between.append(frame.stage_s["between"])
else:
    start_s = time.perf_counter() - started
    seconds = between = [0.0 for _ in hulls(chain)]
print(json.dumps({
    "start_s": start_s, "frame_s": seconds, "between_s": between,
    "rss_kb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
}))
"""

#: Kinds with the numbers of things that are tried; what a thing is, for the table.
_COUNTS = {
    "rigid": ((1, 10, 100), "bodies"),
    "hinge": ((1, 10), "doors"),
    "cloth": ((100, 400, 1600), "nodes"),
    "particles": ((100, 1_000, 10_000, 100_000), "particles"),
    "light": ((1,), "lamp"),
    "shadow": ((1,), "lamp"),
    "proximity": ((1,), "object"),
}

_TOGETHER = {
    "rigid": 10,
    "hinge": 1,
    "cloth": 400,
    "particles": 10_000,
    "light": 1,
    "shadow": 1,
    "proximity": 1,
}


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    """Print a line a row; return its numbers."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--smallest", action="store_true", help="few frames, one of each kind")
    asked = parser.parse_args(arguments)
    n_frames = 3 if asked.smallest else 40
    wanted: list[dict[str, int]] = [{}]
    if asked.smallest:
        wanted.append({"particles": 100})
    else:
        wanted += [{kind: count} for kind, (counts, _) in _COUNTS.items() for count in counts]
        wanted.append(_TOGETHER)
    numbers: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        x_m = 0.7 * np.cos(np.linspace(0.0, 2 * np.pi, n_frames))
        centers = np.column_stack([x_m, np.zeros((n_frames, 2))])
        session = write_ball_session(folder / "session", centers)
        _say("effect                    start s   frame ms (95 %)   between ms   memory MB")
        none = _run(session, write_scene(folder, {}))
        for one in wanted:
            found = _run(session, write_scene(folder, one), warm=bool(one) and not asked.smallest)
            label = "none"
            if one:
                kinds = (f"{kind} {count}" for kind, count in one.items())
                label = "all together" if one is _TOGETHER else ", ".join(kinds)
            frame_ms = 1e3 * np.array(found["frame_s"])
            told = {
                "start_s": found["start_s"] - (none["start_s"] if one else 0.0),
                "frame_ms": float(np.median(frame_ms)),
                "frame_p95_ms": float(np.percentile(frame_ms, 95)),
                "between_ms": 1e3 * float(np.median(found["between_s"])),
                "memory_mb": (found["rss_kb"] - (none["rss_kb"] if one else 0)) / 1024,
            }
            numbers |= {f"{label}.{name}": value for name, value in told.items()}
            _say(
                f"{label:24} {told['start_s']:8.2f}   {told['frame_ms']:8.2f} "
                f"({told['frame_p95_ms']:.1f})   {told['between_ms']:8.1f}   "
                f"{told['memory_mb']:8.0f}"
            )
        for label, seconds in ({} if asked.smallest else _detects(session, folder, 5)).items():
            numbers[f"detect, {label}.median_s"] = float(np.median(seconds))
            _say(f"detect, {label:17} {np.median(seconds):8.2f} s ({np.ptp(seconds):.2f} apart)")
    return numbers


def _detects(session: Path, folder: Path, repeats: int) -> dict[str, list[float]]:
    """Return how long `detect` takes with a scene that names effects and one that names none."""
    with_effects = write_scene(folder, _TOGETHER)
    text = with_effects.read_text(encoding="utf-8")
    without = folder / "without.toml"
    without.write_text(text.partition("[[effect]]")[0], encoding="utf-8")
    took: dict[str, list[float]] = {"effects named": [], "none named": []}
    for _ in range(repeats):
        for label, scene in (("effects named", with_effects), ("none named", without)):
            command = [sys.executable, "-m", "hybridve.cli", "-q", "detect", str(session)]
            asked = ["--scene", str(scene), "-o", str(folder / "r.h5"), "--overwrite"]
            started = time.perf_counter()
            subprocess.run([*command, *asked, "--no-progress"], check=True, stdout=subprocess.PIPE)
            took[label].append(time.perf_counter() - started)
    return took


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _run(session: Path, scene: Path, *, warm: bool = False) -> dict[str, Any]:
    """Return what a run took, after one that compiles if it is to be warm."""
    for _ in range(1 + warm):
        done = subprocess.run(
            [sys.executable, "-c", _CHILD, session, scene],
            capture_output=True,
            text=True,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            check=False,
        )
        if done.returncode:
            raise RuntimeError(done.stderr)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def write_scene(folder: Path, wanted: dict[str, int]) -> Path:
    """Write a scene that names so many things of some kinds of effects."""
    (folder / "cube.obj").write_text(CUBE, encoding="utf-8")
    objects, effects = [], []

    def add(name: str, mesh: str, at_mm: tuple[float, float, float], scale: str = "mm") -> None:
        objects.append(
            f'[[object]]\nname = "{name}"\nmesh = "{mesh}"\nunit = "{scale}"\n'
            f"translate_mm = {list(at_mm)}\n"
        )

    add("post", "cube.obj", (0.0, 600.0, 0.0))
    for number in range(wanted.get("rigid", 0)):
        row, column = divmod(number, 10)
        place = (100.0 * column - 450.0, 100.0 * row - 450.0, 350.0)
        (folder / "small.obj").write_text(_scaled(CUBE, 0.2), encoding="utf-8")
        add(f"body{number}", "small.obj", place)
        effects.append(f'kind = "rigid"\nobject = "body{number}"\nmass_kg = 0.1\n')
    for number in range(wanted.get("hinge", 0)):
        add(f"door{number}", "cube.obj", (300.0, 240.0 * number - 300.0, -150.0))
        effects.append(
            f'kind = "hinge"\nobject = "door{number}"\nmass_kg = 1\naxis = [0, 0, 1]\n'
            "anchor_mm = [100, 100, 0]\n"
        )
    if nodes := wanted.get("cloth"):
        side = round(nodes**0.5)
        (folder / "sheet.obj").write_text(_sheet(side), encoding="utf-8")
        add("sheet", "sheet.obj", (-200.0, 0.0, 0.0))
        effects.append('kind = "cloth"\nobject = "sheet"\nareal_density_kg_m2 = 0.2\n')
    if count := wanted.get("particles"):
        effects.append(
            f'kind = "particles"\ncount = {count}\n'
            "source_mm = [-400, -200, 350, 400, 200, 450]\nlifetime_s = 10\n"
        )
    for kind in ("light", "shadow"):
        if kind in wanted:
            effects.append(f'kind = "{kind}"\nlamp_mm = [0, -200, 900]\n')
    if "light" in wanted:
        effects = [one + "intensity_cd = 100\n" if "light" in one else one for one in effects]
    if "proximity" in wanted:
        effects.append(
            'kind = "proximity"\nobject = "post"\nzones_mm = [500, 300]\nname = "zone"\n'
        )
    path = folder / "scene.toml"
    tables = "".join(f"[[effect]]\n{effect}\n" for effect in effects)
    path.write_text(SCENE_HEAD + "\n".join(objects) + "\n" + tables, encoding="utf-8")
    return path


def _scaled(obj: str, factor: float) -> str:
    lines = []
    for line in obj.splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            line = " ".join(["v", *(f"{factor * float(word):g}" for word in words[1:])])
        lines.append(line)
    return "\n".join(lines) + "\n"


def _sheet(side: int) -> str:
    """Return a sheet of `side` x `side` vertices across the way of the ball, 0.5 m wide."""
    ticks = np.linspace(-250.0, 250.0, side)
    lines = [f"v 0 {y:g} {z:g}" for z in ticks for y in ticks]
    for row in range(side - 1):
        for column in range(side - 1):
            a = row * side + column + 1
            lines += [f"f {a} {a + 1} {a + side}", f"f {a + 1} {a + side + 1} {a + side}"]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
