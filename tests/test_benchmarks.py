"""Every benchmark runs, and the README's headlines are what was measured.

Benchmarks that are functions are collected beside the tests, at their smallest (see
benchmarks/conftest.py); those that are scripts run here.
"""

import math
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from types import ModuleType

import pytest

PROJECT = Path(__file__).resolve().parent.parent


def load_results() -> ModuleType:
    from importlib.util import module_from_spec, spec_from_file_location

    path = PROJECT / "tests" / "benchmarks" / "results.py"
    spec = spec_from_file_location("results", path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


results = load_results()
SCRIPTS = [path for path in results.FILES if results.is_script(path)]
OTHERS = [path for path in results.FILES if not results.is_script(path)]


@pytest.mark.slow
@pytest.mark.recording
@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_runs_at_its_smallest_and_returns_numbers(
    path: Path, recordings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HYBRIDVE_DATA", str(recordings))
    main: Callable[[list[str]], dict[str, float]] = results.load_script(path)

    numbers = main(["--smallest"])

    assert numbers
    assert all(math.isfinite(value) for value in numbers.values())


@pytest.mark.parametrize("path", OTHERS, ids=lambda path: path.stem)
def test_what_is_no_script_is_collected_with_the_tests(
    path: Path, pytestconfig: pytest.Config
) -> None:
    assert any(fnmatch(path.name, pattern) for pattern in pytestconfig.getini("python_files"))
    prefixes = tuple(pytestconfig.getini("python_functions"))
    assert any(name.startswith(prefixes) for name in results.functions_of(path)), path.name


def headlines() -> list[tuple[str, list[str], list[str]]]:
    """Return the rows of the README's table of numbers: what, numbers as written, keys."""
    text = (PROJECT / "README.md").read_text(encoding="utf-8")
    section = text.split("\n## Measured\n")[1].split("\n## ")[0]
    rows = [line.strip("|").split("|") for line in section.splitlines() if line.startswith("| ")]
    found = []
    for what, told, by in rows[1:]:
        numbers = re.findall(r"[-+]?(?:\d[\d,]*)?\.?\d+", told)
        titles = re.findall(r'\]\([^)\s]+ "([^"]+)"\)', by)
        found.append(
            (what.strip(), numbers, [key for title in titles for key in title.split("; ")])
        )
    return found


@pytest.mark.parametrize(("what", "numbers", "keys"), headlines())
def test_a_headline_is_what_was_measured(what: str, numbers: list[str], keys: list[str]) -> None:
    table = results.read_table()

    assert len(numbers) == len(keys) > 0, what
    for written, key in zip(numbers, keys, strict=True):
        digits = len(written.partition(".")[2])
        measured = table[key].value
        assert round(measured, digits) == float(written.replace(",", "")), (
            f"{what}: the README says {written}, {key} is {measured}"
        )


def test_headlines_of_time_were_measured_on_a_quiet_machine() -> None:
    table = results.read_table()

    for what, _, keys in headlines():
        for key in keys:
            if key.endswith(("_ms", "_per_second")):
                assert table[key].run.is_quiet, what


def test_the_text_is_that_of_the_table() -> None:
    text = results.TABLE.with_suffix(".txt").read_text(encoding="utf-8")

    assert text == results.text_of(results.read_table())


def test_a_table_is_read_as_it_was_written(tmp_path: Path) -> None:
    table = results.read_table()

    results.write_table(table, tmp_path / "results.json")

    assert results.read_table(tmp_path / "results.json") == table
    assert (tmp_path / "results.json").read_bytes() == results.TABLE.read_bytes()


def test_times_of_a_busy_machine_replace_no_quiet_ones() -> None:
    quiet = results.Run("2026-01-01", "abc", "a machine", 0.1)
    busy = replace(quiet, date="2026-01-02", load=7.0)
    quieter = replace(busy, load=0.2)
    before = results.merged({}, {"a.median_ms": 1.0, "a.wrong": 3.0}, quiet)
    asked = {"a.median_ms": 2.0, "a.wrong": 4.0, "b.median_ms": 5.0}

    found = {key: each.value for key, each in results.merged(before, asked, busy).items()}
    again = {key: each.value for key, each in results.merged(before, asked, quieter).items()}

    assert found == {"a.median_ms": 1.0, "a.wrong": 4.0, "b.median_ms": 5.0}
    assert again == asked
