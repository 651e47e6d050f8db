"""Each mistake in `helpers/mistakes.py` is one line that says what to do, and leaves nothing."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.mistakes import MISTAKES, PROBLEM, USAGE, Mistake, write_good

Run = Callable[..., int]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("good") / "session"
    write_good(folder)
    return folder


@pytest.fixture
def folder(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "session"))


def words(command: str, folder: Path) -> list[str]:
    """Return a command's words, with the session's paths in them."""
    paths = {"S": folder, "SCENE": folder / "scene.toml", "OUT": folder / "out.h5"}
    found = []
    for word in command.split():
        first, slash, rest = word.partition("/")
        found.append(f"{paths[first]}{slash}{rest}" if first in paths else word)
    return found


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): b"" if path.is_dir() else path.read_bytes()
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize("mistake", MISTAKES, ids=[one.what for one in MISTAKES])
def test_a_mistake_is_one_line_that_names_it_and_leaves_nothing(
    run: Run, folder: Path, capsys: pytest.CaptureFixture[str], mistake: Mistake
) -> None:
    mistake.spoil(folder)
    before = contents(folder)

    status = run(*words(mistake.command, folder))

    shown = capsys.readouterr()
    lines = [line for line in shown.err.splitlines() if not line.startswith("WARNING: ")]
    assert status == mistake.status, shown.err
    assert len(lines) == 1, shown.err
    assert lines[0].startswith("error: ")
    for text in mistake.says:
        assert text in lines[0], lines[0]
    assert shown.out == ""
    after = contents(folder)
    if mistake.keeps:
        after = {
            name: one
            for name, one in after.items()
            if name != mistake.keeps and not name.startswith(f"{mistake.keeps}/")
        }
    assert after == before


@pytest.mark.slow
def test_the_session_that_is_spoilt_is_good(run: Run, folder: Path) -> None:
    assert run(*words("segment S", folder)) == 0
    assert run(*words("detect S --scene SCENE -o OUT --no-doubt", folder)) == 0


def test_the_table_is_of_sixty_mistakes_at_least_each_met_once() -> None:
    assert len(MISTAKES) >= 60
    assert len({one.what for one in MISTAKES}) == len(MISTAKES)
    assert {one.status for one in MISTAKES} == {PROBLEM, USAGE}
    assert "NO_SUCH_VARIABLE" not in os.environ
