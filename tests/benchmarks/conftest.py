"""Fixtures of all benchmarks; which of their cases run.

Every benchmark runs in ``make test``, once and at its smallest, so that it is known to run at all:
of the cases of a function those that its mark ``smallest`` names, on as little as `is_full` lets
them. ``--full`` takes all, as ``make bench`` does.
"""

import os
from pathlib import Path

import pytest

from hybridve.calib.rig import Rig
from hybridve.hull.capture.rig import calibrate_session, load_rig
from hybridve.hull.capture.session import Session, load_session

FOLDER = Path(__file__).parent
HORSEMAN = FOLDER.parent.parent / "data" / "horseman"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the cases that are not the smallest."""
    if config.getoption("--full"):
        return
    own = [item for item in items if FOLDER in item.path.parents]
    larger = {item for item in own if not _is_smallest(item)}
    smallest = {_function_of(item) for item in own if item not in larger}
    for item in larger:
        if _function_of(item) not in smallest:
            raise pytest.UsageError(f"{item.nodeid}: no case is the smallest; all: --full")
    config.hook.pytest_deselected(items=list(larger))
    items[:] = [item for item in items if item not in larger]


def _function_of(item: pytest.Item) -> str:
    return item.nodeid.partition("[")[0]


def _is_smallest(item: pytest.Item) -> bool:
    mark = item.get_closest_marker("smallest")
    if mark is None:
        return True
    case = item.callspec.params  # type: ignore[attr-defined]
    return all(case[name] == value for name, value in mark.kwargs.items())


@pytest.fixture(scope="session")
def is_full(request: pytest.FixtureRequest) -> bool:
    """Whether times are wanted, and not only that the benchmark runs."""
    return bool(request.config.getoption("--full"))


@pytest.fixture(scope="session")
def horseman(
    recordings: Path, is_full: bool, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Session, Rig]:
    """The recording and its rig; the smallest takes the rig that came with it, which is no wait."""
    os.environ.setdefault("HYBRIDVE_DATA", str(recordings))
    if is_full:
        session = load_session(HORSEMAN)
        return session, calibrate_session(session).rig
    text = (HORSEMAN / "session.toml").read_text(encoding="utf-8")
    given = 'rig = "{camera}/reference_b_mm.xml"\nrig_unit = "mm"\nrig_pixel_centre = 0\n'
    path = tmp_path_factory.mktemp("horseman") / "session.toml"
    path.write_text(text.replace("[target]", f'{given}rig_check = "off"\n\n[target]', 1))
    session = load_session(path)
    return session, load_rig(session)
