"""Fixtures of all tests."""

import gc
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.thorough import THOROUGH, asked
from hypothesis import HealthCheck, settings
from hypothesis.internal.conjecture import providers

from hybridve.calib.cache import cache_folder

PROJECT = Path(__file__).resolve().parent.parent
BENCHMARKS = PROJECT / "tests" / "benchmarks"

#: The marks of what --quick leaves out.
_NOT_QUICK = ("slow", "recording", "hypothesis")

# A property test is asked the same examples in every run, on every machine: what is red for one is
# red for all. Nothing is kept from run to run either. Machines are noisy, and compiled code
# compiles in its first example: no example has a time limit, nor has the drawing of it.
settings.register_profile(
    "same",
    max_examples=asked(100),
    deadline=None,
    derandomize=True,
    database=None,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],
)
# New examples, all of which follow from the seed (`make soak`).
settings.register_profile("new", settings.get_profile("same"), derandomize=False)
settings.load_profile("same")

# Hypothesis draws some numbers from the sources of whatever modules this process has loaded so far.
# Which those are depends on the tests that came before, and with several processes on their speed;
# so no source is read.
providers.is_local_module_file = lambda path: False  # type: ignore[attr-defined,assignment]

# Compiled code is the user's own: it takes long, and is named after its sources. numba looks where
# to keep it when it is loaded, before there is any fixture.
if (_compiled := cache_folder("compiled")) is not None:
    os.environ.setdefault("NUMBA_CACHE_DIR", str(_compiled))


def pytest_addoption(parser: pytest.Parser) -> None:
    """Benchmarks run at their smallest unless they are asked for what is published."""
    parser.addoption("--full", action="store_true", help="benchmarks: all cases, at full size")
    parser.addoption("--quick", action="store_true", help="of each quick test the first case")


@pytest.hookimpl(trylast=True)  # once hypothesis has marked what it draws
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with the files that take longest, lest one process be left with them at the end.

    Leave out what only `make thorough` asks. With --quick leave out what takes long, recordings,
    drawn examples, and all but one case.
    """
    long = {item.path for item in items if item.get_closest_marker("recording")}
    items.sort(key=lambda item: item.path not in long)
    if not THOROUGH:
        left_out = [item for item in items if item.get_closest_marker("thorough")]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if not item.get_closest_marker("thorough")]
    if not config.getoption("--quick"):
        return
    quick: dict[str, pytest.Item] = {}
    for item in items:
        if not any(item.get_closest_marker(name) for name in _NOT_QUICK) and not (
            item.path.is_relative_to(BENCHMARKS)
        ):
            quick.setdefault(item.nodeid.partition("[")[0], item)
    kept = set(quick.values())
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    items[:] = [item for item in items if item in kept]


def pytest_collection_finish() -> None:
    """Spare the garbage collector what is loaded by now: it stays to the end, and is most."""
    gc.collect()
    gc.freeze()


def pytest_configure(config: pytest.Config) -> None:
    """Draw new examples if a seed is given, which tests of the same examples would not heed."""
    if config.getoption("--hypothesis-seed") is not None:
        settings.load_profile("new")


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep what tests keep away from the user's, for the session, as fixtures keep things too.

    Processes side by side share it: corners that one has found spare the others the search.
    """
    with pytest.MonkeyPatch.context() as patch:
        mine = tmp_path_factory.getbasetemp()
        of_all = mine.parent if "PYTEST_XDIST_WORKER" in os.environ else mine
        patch.setenv("HYBRIDVE_CACHE", str(of_all / "cache"))
        yield


@pytest.fixture(autouse=True)
def _numerical_errors_raise() -> Iterator[None]:
    with np.errstate(divide="raise", over="raise", invalid="raise"):
        yield


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of real recordings; without it a test is skipped, except in CI, where it fails."""
    folder = Path(os.environ.get("HYBRIDVE_DATA", PROJECT.parent / "shared" / "data"))
    if not (folder / "horseman").is_dir():
        message = f"the real recordings are not in {folder}; set HYBRIDVE_DATA to their folder"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return folder


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Run ``hybridve`` with arguments, in this process; returns the exit status."""

    def run_command(*arguments: object) -> int:
        from hybridve.cli.main import main

        monkeypatch.setattr(sys, "argv", ["hybridve", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            main()
        return int(left.value.code or 0)

    return run_command
