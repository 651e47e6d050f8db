"""Fixtures of all tests."""

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from hybridve.calib.cache import cache_folder

PROJECT = Path(__file__).resolve().parent.parent

# Machines are noisy, and compiled code compiles in its first example: no example has a time limit.
# In CI the examples are the same in every run; at a developer's desk they are new ones.
settings.register_profile("project", deadline=None, derandomize=bool(os.environ.get("CI")))
settings.load_profile("project")


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep what tests keep away from the user's, for the session, as fixtures keep things too.

    Compiled code is the user's own: it takes long, and is named after its sources.
    """
    with pytest.MonkeyPatch.context() as patch:
        compiled = cache_folder("compiled")
        if compiled is not None and "NUMBA_CACHE_DIR" not in os.environ:
            patch.setenv("NUMBA_CACHE_DIR", str(compiled))
        patch.setenv("HYBRIDVE_CACHE", str(tmp_path_factory.mktemp("cache")))
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
