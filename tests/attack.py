"""What breaks in a night, done on purpose: ``make attack``, into the table of tests/README.md.

Small sessions of a ball are run as a batch while workers are killed, ``detect`` is killed at random
moments and resumed, and every write that a result takes is made to fail, one after another.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import psutil
from helpers.failing import contents, failing
from helpers.sessions import write_ball_session, write_cube_scene

from hybridve.calib.errors import HybridveError
from hybridve.hull.manifest import MANIFEST, read_records

#: What differs between two runs of one command, and may.
_MAY_DIFFER = ("created_utc", "machine", "command", "versions")


def differences(one: Path, other: Path) -> list[str]:
    """Return what differs between two reports: datasets but timings, attributes but of the run."""
    found: list[str] = []

    def look(name: str, item: Any) -> None:
        there = second.get(name)
        if there is None:
            found.append(name)
            return
        for key, value in item.attrs.items():
            same = np.array_equal(np.asarray(value), np.asarray(there.attrs.get(key)))
            if key not in _MAY_DIFFER and not same:
                found.append(f"{name}@{key}")
        if isinstance(item, h5py.Dataset) and "stage_s" not in name:
            a, b = item[()], there[()]
            equal = a.tobytes() == b.tobytes() if hasattr(a, "tobytes") else a == b
            if not equal and not (item.dtype.kind == "O" and np.array_equal(a, b)):
                found.append(name)

    with h5py.File(one) as first, h5py.File(other) as second:
        first.visititems(look)
    return found


def hybridve(*words: object, **how: Any) -> subprocess.CompletedProcess[str]:
    """Run a command, and return how it ended."""
    return subprocess.run(
        [sys.executable, "-m", "hybridve.cli", *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        **how,
    )


def write_night(folder: Path, n_sessions: int, bad: Sequence[int], n_frames: int) -> Path:
    """Write a batch of small sessions, some of whose rigs are broken."""
    for number in range(n_sessions):
        centers = np.array([[0.02 * frame + 0.01 * number, 0, 0] for frame in range(n_frames)])
        session = write_ball_session(folder / f"p{number:02d}", centers)
        if number in bad:
            (session.parent / "rig.csv").write_text("cam0,1,2\n", encoding="utf-8")
    write_cube_scene(folder / "lay", {"near": (0.0, 0.0, 150.0), "far": (0.0, 0.0, 605.0)})
    path = folder / "night.toml"
    path.write_text(
        'format = "hybridve-batch"\nversion = 1\nsessions = ["p*"]\nscenes = ["lay"]\n'
        'output = "out"\n[options]\nengine = "native"\nviewport = 6\n',
        encoding="utf-8",
    )
    return path


def attack_batch(folder: Path, n_sessions: int, every_s: float) -> dict[str, Any]:
    """Run a batch in quiet, and again while its workers are killed; return what came of it."""
    bad = sorted({n_sessions // 5, n_sessions // 2, n_sessions - 2}) if n_sessions > 4 else [1]
    path = write_night(folder, n_sessions, bad, 12)
    took: dict[str, float] = {}
    for name, workers in (("warm", 1), ("one", 1), ("two", 2)):
        text = path.read_text(encoding="utf-8")
        named = folder / f"{name}.toml"
        named.write_text(text.replace('"out"', f'"{name}"'), encoding="utf-8")
        if name == "warm":
            named.write_text(
                named.read_text(encoding="utf-8").replace('["p*"]', '["p00"]'), encoding="utf-8"
            )
        started = time.monotonic()
        hybridve("batch", named, "--workers", workers, "--no-progress")
        took[name] = time.monotonic() - started
    process = subprocess.Popen(
        [sys.executable, "-m", "hybridve.cli", "batch", str(path), "--workers", "2"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    kills = 0
    done = threading.Event()

    def kill() -> None:
        nonlocal kills
        while not done.wait(every_s):
            workers = [
                one
                for one in psutil.Process(process.pid).children()
                if "spawn_main" in " ".join(one.cmdline())
            ]
            if workers:
                random.choice(workers).kill()
                kills += 1

    killer = threading.Thread(target=kill)
    killer.start()
    process.communicate()
    done.set()
    killer.join()
    good = [number for number in range(n_sessions) if number not in bad]
    differing = [
        number
        for number in good
        if not (folder / "out" / f"p{number:02d}__lay.h5").exists()
        or differences(
            folder / "one" / f"p{number:02d}__lay.h5", folder / "out" / f"p{number:02d}__lay.h5"
        )
    ]
    records = [
        json.loads(line)
        for line in (folder / "one" / "MANIFEST.jsonl").read_text(encoding="utf-8").splitlines()
    ]
    bare_s = sum(one["seconds"] for one in records)
    ended = read_records(folder / "out" / MANIFEST)
    return {
        "sessions": n_sessions,
        "bad": len(bad),
        "kills": kills,
        "reports equal": len(good) - len(differing),
        "reasons": sum(bool(one["reason"]) for one in ended.values()),
        "status": process.returncode,
        "overhead": took["one"] / bare_s - 1.0,
        "two workers, times one": took["one"] / took["two"],
    }


def attack_detect(folder: Path, n_kills: int) -> dict[str, Any]:
    """Kill ``detect`` at random moments, resume it, and compare."""
    session = write_ball_session(folder / "m", np.array([[0.01 * n, 0, 0] for n in range(40)]))
    scene = write_cube_scene(folder / "m", {"near": (0.0, 0.0, 150.0)})
    call = ["detect", session, "--scene", scene, "--engine", "native", "--no-progress"]
    whole = folder / "whole.h5"
    hybridve(*call, "-o", whole)  # what is compiled and kept from here on costs none of them
    started = time.monotonic()
    hybridve(*call, "-o", whole, "--overwrite")
    took_s = time.monotonic() - started
    equal, killed = 0, 0
    rng = random.Random(1)
    for number in range(n_kills):
        path = folder / f"{number}.h5"
        process = subprocess.Popen(
            [sys.executable, "-m", "hybridve.cli", *map(str, call), "-o", str(path)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        time.sleep(rng.uniform(0.3, 1.0) * took_s)
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
            killed += 1
        process.wait()
        ended = hybridve(*call, "-o", path, "--resume")
        left = [one.name for one in folder.iterdir() if one.name.startswith(f"{path.name}.")]
        equal += ended.returncode == 0 and not differences(whole, path) and not left
        for one in folder.glob(f"{path.name}*"):
            one.unlink()
    return {"runs": n_kills, "killed": killed, "equal": equal}


def attack_writes(folder: Path, stride: int) -> dict[str, dict[str, int]]:
    """Make each write, flush and rename of a command fail; return what was left, by command."""
    session = write_ball_session(folder / "m", np.array([[0.01 * n, 0, 0] for n in range(3)]))
    scene = write_cube_scene(folder / "m", {"near": (0.0, 0.0, 150.0)})
    (folder / "m" / "board.toml").write_text(
        'format = "hybridve-session"\nversion = 1\n[target]\nkind = "chessboard"\ncolumns = 8\n'
        'rows = 5\nsquare_mm = 30\n[[camera]]\nname = "a"\n',
        encoding="utf-8",
    )
    calls: dict[str, list[object]] = {
        "detect": ["detect", session, "--scene", scene, "-o", "OUT.h5", "--engine", "native"],
        "spacing": [
            *("spacing", session, "--scene", scene, "--move", "near", "--along", "0,0,1"),
            *("--range-mm", "0:900", "--tolerance-mm", "50", "-o", "OUT.h5"),
        ],
        "board": ["board", folder / "m" / "board.toml", "-o", "OUT.pdf"],
        "convert": [
            *("convert", folder / "m" / "rig.csv", "--from-unit", "m", "--image-size", "160x120"),
            *("--to", "colmap", "--unit", "m", "-o", "OUT"),
        ],
        "check": ["check", session, "--picture", "OUT.png"],
    }
    table: dict[str, dict[str, int]] = {}
    for name, call in calls.items():
        out = folder / name
        out.mkdir()

        def run(where: Path, call: list[object] = call) -> str:
            return _in_process([str(word).replace("OUT", str(where / "out")) for word in call])

        with failing() as disk:
            run(out)
        whole = set(contents(out))
        row = {"k": 0, "told": 0, "whole": 0, "old": 0, "half": 0}
        for k in range(1, len(disk.asked) + 1, stride):
            where = folder / f"{name}{k}"
            where.mkdir()
            with failing(k):
                told = run(where)
            left = {one for one in contents(where) if ".parts/" not in one}
            row["k"] += 1
            row["told"] += told == "told"
            row["whole"] += left == whole
            row["old"] += not left
            row["half"] += left not in (whole, set()) or told not in ("told", "done")
        table[name] = row
    return table


def _in_process(words: list[str]) -> str:
    """Run a command here; return "done", "told" where it told one line, or what else came."""
    from contextlib import redirect_stderr, redirect_stdout
    from io import StringIO

    from hybridve.cli.main import main

    sys.argv = ["hybridve", *words]
    told = StringIO()
    try:
        with redirect_stdout(StringIO()), redirect_stderr(told):
            main()
    except SystemExit as left:
        errors = [line for line in told.getvalue().splitlines() if line.startswith("error: ")]
        if left.code in (0, None):
            return "done"
        return "told" if left.code == 1 and len(errors) == 1 else f"{left.code}: {errors}"
    except (Exception, HybridveError) as error:
        return repr(error)


def main() -> None:
    """Attack, and print what came of it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=50)
    parser.add_argument("--every-s", type=float, default=20.0)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--only", choices=["batch", "detect", "writes"])
    asked = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    attacks: dict[str, Callable[[Path], Any]] = {
        "batch": lambda folder: attack_batch(folder, asked.sessions, asked.every_s),
        "detect": lambda folder: attack_detect(folder, asked.kills),
        "writes": lambda folder: attack_writes(folder, asked.stride),
    }
    for name, attack in attacks.items():
        if asked.only in (None, name):
            with tempfile.TemporaryDirectory() as folder:
                print(json.dumps({name: attack(Path(folder))}), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
