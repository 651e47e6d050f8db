"""The command line as a whole: help, documentation, errors, and how it leaves."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner
from helpers.sessions import write_ball_session

from hybridve.calib.errors import HybridveError
from hybridve.cli.main import cli

PROJECT = Path(__file__).parent.parent
README = (PROJECT / "README.md").read_text(encoding="utf-8")
PAGE = (PROJECT / "cli" / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", list(cli.commands))
def test_every_command_is_in_the_readme_and_its_help_tells_what_it_does(name: str) -> None:
    command = cli.commands[name]

    assert f"`hybridve {name}" in README
    assert command.help
    assert command.short_help
    if any(isinstance(parameter, click.Argument) for parameter in command.params):
        assert f"hybridve {name} " in command.help.split("Example:")[1]


@pytest.mark.parametrize("name", list(cli.commands))
def test_the_options_that_the_page_tells_of_a_command_exist(name: str) -> None:
    (row,) = (line for line in PAGE.splitlines() if line.startswith(f"| `hybridve {name} "))
    known = {
        option
        for parameter in cli.commands[name].params
        for option in [*parameter.opts, *parameter.secondary_opts]
    }

    told = set(re.findall(r"(?<![\w-])--?[a-z][a-z-]*", row))

    assert told <= known, told - known


@pytest.mark.parametrize("name", ["", *cli.commands])
def test_examples_in_help_keep_their_lines(name: str) -> None:
    shown = CliRunner().invoke(cli, [*name.split(), "--help"]).output

    assert "\\b" not in shown
    assert "\b" not in shown
    if "Example:" in shown:
        example = shown.split("Example:")[1].splitlines()
        assert example[0] == ""
        assert example[1].strip().startswith("hybridve ")


@pytest.mark.parametrize("name", list(cli.commands))
def test_every_option_is_explained(name: str) -> None:
    for parameter in cli.commands[name].params:
        if isinstance(parameter, click.Option):
            assert parameter.help, parameter.name


@pytest.mark.parametrize("name", ["-o", "--overwrite", "--frames", "--engine", "--scene"])
def test_the_same_option_means_the_same_everywhere(name: str) -> None:
    kinds = {
        type(parameter.type)
        for command in cli.commands.values()
        for parameter in command.params
        if isinstance(parameter, click.Option) and name in parameter.opts
    }

    assert len(kinds) == 1


def test_help_loads_no_heavy_library() -> None:
    code = (
        "import sys\nsys.argv = ['hybridve', '--help']\n"
        "from hybridve.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "print([n for n in ('numpy', 'cv2', 'h5py', 'open3d', 'pycolmap', 'numba', 'pydantic')"
        " if n in sys.modules])"
    )

    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert shown.stdout.strip().endswith("[]")
    assert "detect" in shown.stdout


def caused_by(cause: BaseException) -> SystemError:
    """Return an error as compiled code passes it on: wrapped, and wrapped again."""
    inner, outer = SystemError("returned a result with an exception set"), SystemError("the same")
    inner.__cause__, outer.__cause__ = cause, inner
    return outer


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (caused_by(KeyboardInterrupt()), 130, "interrupted"),
        (HybridveError("rig.json: camera 'left': broken"), 1, "error: rig.json: camera 'left'"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (click.UsageError("give one of both"), 2, "give one of both"),
    ],
)
def test_errors_become_one_line_and_a_status(
    run: Callable[..., int],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: BaseException,
    status: int,
    text: str,
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(cli.commands["doctor"], "callback", fail)

    assert run("doctor") == status

    shown = capsys.readouterr()
    assert text in shown.err
    assert shown.out == ""
    assert "Traceback" not in shown.err


def test_no_command_at_all_shows_the_help(
    run: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run() == 2

    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("Usage: hybridve")
    assert any(line.split()[:1] == ["calibrate"] for line in lines)
    assert not any("error:" in line for line in lines)


def test_a_system_error_of_another_cause_is_not_taken_for_an_interruption(
    run: Callable[..., int], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise caused_by(MemoryError())

    monkeypatch.setattr(cli.commands["doctor"], "callback", fail)

    with pytest.raises(SystemError, match="the same"):
        run("doctor")


def test_a_reader_that_has_seen_enough_hears_no_complaint() -> None:
    code = (
        "import click, sys\nfrom hybridve.cli.main import cli, main\n"
        "lines = ['x' * 80] * 10**5\n"
        "cli.commands['doctor'].callback = lambda **_: list(map(click.echo, lines))\n"
        "sys.argv = ['hybridve', 'doctor']\nmain()"
    )
    command = f'{sys.executable} -c "$CODE" | head -1'

    done = subprocess.run(
        ["bash", "-c", command],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "CODE": code},
    )

    assert done.stderr == ""
    assert done.stdout == "x" * 80 + "\n"


@pytest.mark.parametrize("where", ["before", "behind"])
def test_quiet_may_stand_before_a_command_or_behind_it(
    where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], run: Callable[..., int]
) -> None:
    session = write_ball_session(tmp_path, np.zeros((2, 3)), n_cameras=2)
    text = session.read_text(encoding="utf-8").replace("fps = 25\n", "")  # which is warned of
    session.write_text(text, encoding="utf-8")
    words: list[object] = ["segment", session, "--no-progress"]

    assert run(*(["-q", *words] if where == "before" else [*words, "-q"])) == 0

    assert capsys.readouterr().err == ""
    assert run(*words, "--overwrite") == 0
    assert "fps: this key is missing" in capsys.readouterr().err
