"""What property tests are asked: the same wherever they run, or what follows from a seed."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

PROJECT = Path(__file__).resolve().parent.parent


def drawn_now() -> list[list[float]]:
    """Return what a property test is asked."""
    examples = []

    @settings(derandomize=True, max_examples=100)
    @given(st.lists(st.floats(0.0, 1.0), min_size=20))
    def ask(numbers: list[float]) -> None:
        examples.append(numbers)

    ask()
    return examples


@pytest.mark.slow
def test_modules_that_are_loaded_by_chance_change_no_example(tmp_path: Path) -> None:
    # Their numbers would be drawn, if they were read, five times in a hundred.
    (tmp_path / "odd.py").write_text(f"ODD = {[k / 1000.3 for k in range(1, 1000)]}\n")
    before = drawn_now()

    spec = importlib.util.spec_from_file_location("odd_by_chance", tmp_path / "odd.py")
    assert spec is not None
    assert spec.loader is not None
    sys.modules["odd_by_chance"] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
        after = drawn_now()
    finally:
        del sys.modules["odd_by_chance"]

    assert len(before) == 100
    assert after == before


def asked(tmp_path: Path, *options: str, ci: str = "") -> list[str]:
    """Return what a test is asked by a pytest of its own, under the project's own conftest."""
    test = tmp_path / "test_it.py"
    test.write_text(
        "from hypothesis import given, strategies as st\n"
        "@given(st.integers())\n"
        "def test_it(number): print('\\nasked', number)\n"
    )
    conftest = PROJECT / "tests" / "conftest.py"
    (tmp_path / "conftest.py").write_text(conftest.read_text(encoding="utf-8"), encoding="utf-8")
    without = [f"-pno:{plugin}" for plugin in ("cacheprovider", "dash", "xdist")]
    environment = {name: value for name, value in os.environ.items() if "XDIST" not in name}
    environment |= {"PYTHONPATH": str(PROJECT / "tests"), "HYBRIDVE_TESTS": "thorough"}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-s", *without, "-c", os.devnull, *options, test],
        env={**environment, "CI": ci},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    return [line for line in done.stdout.splitlines() if line.startswith("asked")]


@pytest.mark.slow
def test_examples_are_the_same_in_every_run_and_new_ones_follow_from_the_seed(
    tmp_path: Path,
) -> None:
    same = asked(tmp_path)
    first, other = (asked(tmp_path, f"--hypothesis-seed={seed}") for seed in (1, 2))

    assert len(same) == 100
    assert asked(tmp_path, ci="true") == same
    assert asked(tmp_path, "--hypothesis-seed=1") == first
    assert first != other
    assert same not in (first, other)
