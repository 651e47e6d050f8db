"""The table that benchmarks fill: results.json, and the same as text in results.txt.

`make bench` runs every benchmark at full size and writes each number with the run that it is of:
machine, date, load and commit. The pages take their numbers from here; the README's headlines are
compared with them by tests/test_benchmarks.py.

A number is called after its file, its benchmark and the quantity, whose name ends in its unit:
``bench_query.bench_frame[native-1000000].median_ms``. What depends on the time is only replaced by
what was measured on a machine as quiet, or where nothing stands yet.

Run: python tests/benchmarks/results.py [bench_query ...]
"""

import argparse
import ast
import importlib.util
import json
import os
import re
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hybridve.hull.report.machine import machine_text

FOLDER = Path(__file__).parent
TABLE = FOLDER / "results.json"

#: Every benchmark: a file of functions for pytest, or a script with a ``main``.
FILES = sorted(FOLDER.glob("bench_*.py"))

#: What a script is given here. Against theory is measured by `make theory`, in an hour; here what
#: that left is read, as is what `make hard-cases` left.
_ARGUMENTS = {
    "bench_theory": ["--seeds", "0", "-o", str(FOLDER.parents[1] / "data/pictures/theory.json")]
}
_HARD_CASES = FOLDER.parent / "README.md"

#: A machine with more to do besides is called busy: programs that want to run, on average.
_QUIET_LOAD = 0.5

_OF_TIME = re.compile(r"(\.|_)(s|ms|us)$|_per_second$|times_alone$")


@dataclass(frozen=True, slots=True)
class Run:
    """What a number was measured on."""

    date: str
    commit: str
    machine: str
    load: float | None  # None: quiet, but not written down
    note: str = ""

    @property
    def is_quiet(self) -> bool:
        return self.load is None or self.load < _QUIET_LOAD

    @property
    def label(self) -> str:
        return f"{self.date} {self.commit}" + ("" if self.is_quiet else f" load {self.load:.1f}")


@dataclass(frozen=True, slots=True)
class Number:
    """One number of the table."""

    value: float
    run: Run


Table = dict[str, Number]


def functions_of(path: Path) -> set[str]:
    """Return the names of the functions that a file defines, without running it."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def is_script(path: Path) -> bool:
    """Whether a benchmark has a ``main``, and is not pytest's to run."""
    return "main" in functions_of(path)


def load_script(path: Path) -> Callable[[list[str]], dict[str, float]]:
    """Return the ``main`` of a script: arguments to numbers by name."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look themselves up
    spec.loader.exec_module(module)
    main: Callable[[list[str]], dict[str, float]] = module.main
    return main


def read_table(path: Path = TABLE) -> Table:
    """Return the numbers that stand."""
    if not path.is_file():
        return {}
    told = json.loads(path.read_text(encoding="utf-8"))
    runs = {label: Run(**run) for label, run in told["runs"].items()}
    return {key: Number(value, runs[label]) for key, (value, label) in told["numbers"].items()}


def write_table(table: Mapping[str, Number], path: Path = TABLE) -> None:
    """Write results.json, a number a line, and results.txt beside it."""
    runs = {number.run.label: number.run for number in table.values()}
    lines = [f"  {json.dumps(label)}: {json.dumps(asdict(runs[label]))}" for label in sorted(runs)]
    numbers = [
        f"  {json.dumps(key)}: {json.dumps([number.value, number.run.label])}"
        for key, number in sorted(table.items())
    ]
    text = ",\n".join(lines), ",\n".join(numbers)
    path.write_text(
        '{{"runs": {{\n{}\n}},\n"numbers": {{\n{}\n}}}}\n'.format(*text), encoding="utf-8"
    )
    path.with_suffix(".txt").write_text(text_of(table), encoding="utf-8")


def text_of(table: Mapping[str, Number]) -> str:
    """Return the table for readers: the numbers of each run."""
    lines = []
    runs = {number.run.label: number.run for number in table.values()}
    for label in sorted(runs):
        run = runs[label]
        state = "quiet" if run.is_quiet else "busy: its times are no measure"
        lines += [f"{label} ({state}): {run.machine}" + (f". {run.note}" if run.note else "")]
        own = {key: number.value for key, number in sorted(table.items()) if number.run == run}
        lines += [f"  {value:<14.8g} {key}" for key, value in own.items()] + [""]
    return "\n".join(lines)


def merged(table: Table, numbers: Mapping[str, float], run: Run) -> Table:
    """Return the table with numbers of a run; times of a busy machine replace no quiet ones."""
    kept = {
        key
        for key in numbers.keys() & table.keys()
        if _OF_TIME.search(key) and table[key].run.is_quiet and not run.is_quiet
    }
    fresh = {key: Number(value, run) for key, value in numbers.items() if key not in kept}
    return table | fresh


def numbers_of(told: Mapping[str, Any]) -> dict[str, float]:
    """Return the numbers in the JSON of pytest-benchmark, by name.

    Each benchmark has its median and the distance of its quartiles, and what it tells besides; one
    of several frames also the frames per second.
    """
    found: dict[str, float] = {}
    for one in told["benchmarks"]:
        name = f"{Path(one['fullname'].split('::')[0]).stem}.{one['name']}"
        median_s, extra = one["stats"]["median"], one["extra_info"]
        found[f"{name}.median_ms"] = 1e3 * median_s
        found[f"{name}.iqr_ms"] = 1e3 * one["stats"]["iqr"]
        if "frames" in extra:
            found[f"{name}.frames_per_second"] = extra["frames"] / median_s
        for what, value in extra.items():
            if isinstance(value, int | float):
                found[f"{name}.{what}"] = float(value)
            elif isinstance(value, list):
                found |= {f"{name}.{what}[{k}]": float(each) for k, each in enumerate(value)}
    return found


def measure(files: Iterable[Path]) -> tuple[dict[str, float], list[str]]:
    """Run benchmarks at full size, the scripts after the others.

    One that fails takes nothing from the others: returned are the numbers of all that did not, and
    what failed.
    """
    files = list(files)
    for_pytest = [str(path) for path in files if not is_script(path)]
    numbers: dict[str, float] = {}
    failed: list[str] = []
    if for_pytest:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "benchmarks.json"
            command = [sys.executable, "-m", "pytest", *for_pytest, "--full"]
            command += ["--benchmark-columns=median,iqr,min,rounds", "--benchmark-sort=fullname"]
            done = subprocess.run([*command, f"--benchmark-json={path}"])
            if done.returncode:
                failed.append(f"pytest (status {done.returncode}, see above)")
            if path.is_file() and path.stat().st_size:
                numbers |= numbers_of(json.loads(path.read_text(encoding="utf-8")))
    for path in files:
        if is_script(path):
            sys.stdout.write(f"{path.stem}\n")
            try:
                told = load_script(path)(_ARGUMENTS.get(path.stem, []))
            except Exception:
                traceback.print_exc()
                failed.append(path.stem)
                continue
            numbers |= {f"{path.stem}.{name}": value for name, value in told.items()}
    numbers |= hard_cases()
    return {key: float(f"{value:.7g}") for key, value in numbers.items()}, failed


def hard_cases() -> dict[str, float]:
    """Return how many samples of the hard cases an engine takes otherwise than is exact."""
    row = re.compile(r"^\* `(\w+)`: .* (\d+) taken otherwise than is exact", re.MULTILINE)
    rows = row.findall(_HARD_CASES.read_text(encoding="utf-8"))
    return {f"hard_cases.{engine}.taken_otherwise": float(count) for engine, count in rows}


def this_run() -> Run:
    """Return what is measured on, before it is."""
    command = ["git", "describe", "--always", "--dirty=+"]
    commit = subprocess.run(command, cwd=FOLDER, capture_output=True, text=True).stdout.strip()
    date = datetime.now(UTC).date().isoformat()
    return Run(date, commit or "unknown", machine_text(), round(os.getloadavg()[0], 1))


def main() -> None:
    """Measure, and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", help="bench_query and so on; all if left out")
    asked = parser.parse_args()
    run = this_run()
    files = [path for path in FILES if not asked.names or path.stem in asked.names]
    numbers, failed = measure(files)
    table = merged(read_table(), numbers, run)
    write_table(table)
    sys.stdout.write(text_of({key: each for key, each in table.items() if each.run == run}))
    if failed:
        sys.exit(f"failed: {', '.join(failed)}; what was measured stands in the table")


if __name__ == "__main__":
    main()
