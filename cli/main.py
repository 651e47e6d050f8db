"""The command ``hybridve``: its sub-commands, and the one place where errors become text."""

import errno
import logging
import re
import signal
import sys
import threading
from collections.abc import Sequence
from importlib.metadata import version
from typing import NoReturn

import click

from hybridve.calib.bounded import printable
from hybridve.calib.errors import HybridveError
from hybridve.cli.batch import batch
from hybridve.cli.board import board
from hybridve.cli.calibrate import calibrate
from hybridve.cli.check import check
from hybridve.cli.clashes import clashes
from hybridve.cli.convert import convert
from hybridve.cli.demo import demo
from hybridve.cli.detect import detect
from hybridve.cli.diff import diff
from hybridve.cli.doctor import doctor
from hybridve.cli.export import export
from hybridve.cli.init import init
from hybridve.cli.options import tell
from hybridve.cli.plan import plan
from hybridve.cli.render import render
from hybridve.cli.segment import segment
from hybridve.cli.simulate import simulate
from hybridve.cli.spacing import spacing
from hybridve.cli.summary import summary
from hybridve.cli.sweep import sweep
from hybridve.cli.synth import synth
from hybridve.cli.threads import take_threads

#: Exit status of a run that was interrupted, as shells have it: 128 + SIGINT.
_INTERRUPTED = 130

#: And of one that was told to end, by a scheduler or by a container that stops: 128 + SIGTERM.
_TERMINATED = 143


class _TerminatedError(KeyboardInterrupt):
    """SIGTERM has come: what is open is closed, as where a person presses Ctrl-C."""


class _Printable(logging.Formatter):
    """Spells out what a terminal would obey: names of files and things come from strangers."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


class _InOrder(click.Group):
    """Lists commands in the order of the work, not of the alphabet."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002  # click's
        return list(self.commands)


@click.group(cls=_InOrder, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(version("hybridve"), prog_name="hybridve")
@click.option("-v", "--verbose", count=True, help="Tell more on stderr; twice for everything.")
@click.option("-q", "--quiet", is_flag=True, help="Tell only errors on stderr.")
@click.option(
    "--threads",
    type=click.IntRange(1),
    metavar="N",
    help="Use so many processors and no more. Default: all that there are.",
)
def cli(verbose: int, quiet: bool, threads: int | None) -> None:
    r"""Tell what real thing in a recording touched which CAD part, frame by frame.

    \b
    The whole job on a recording:
      hybridve calibrate my_session
      hybridve detect my_session --scene scene.toml -o report.h5
      hybridve summary report.h5

    Results go to stdout, progress to stderr. Exit status: 0 done (a collision found is a result),
    1 a problem you can fix, 2 wrong usage, 3 something clashes and --fail-on-clash was given,
    4 a rig is worse than --max-error-mm or does not pass --check, 6 diff found something worse,
    130 interrupted.
    """
    if threads is not None:
        take_threads(threads)
    level = (
        logging.ERROR if quiet else (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    )
    logging.basicConfig(stream=sys.stderr, level=level, force=True)
    for handler in logging.root.handlers:
        handler.setFormatter(_Printable("%(levelname)s: %(message)s"))


for command in (
    *(demo, synth, plan, init, board, check, calibrate, convert, segment, detect, batch),
    *(spacing, sweep, simulate, summary, clashes, diff, export, render, doctor),
):
    cli.add_command(command)

for command in (cli, *cli.commands.values()):
    # click keeps the lines after a backspace character as they are; raw docstrings spell it out.
    command.help = (command.help or "").replace("\\b", "\b")


def _terminate(*_: object) -> NoReturn:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough: what follows is tidying up
    raise _TerminatedError


def _leave_interrupted(error: BaseException) -> NoReturn:
    was_told = _is_caused_by(error, _TerminatedError)
    click.echo("terminated" if was_told else "interrupted", err=True)
    sys.exit(_TERMINATED if was_told else _INTERRUPTED)


def _is_caused_by(error: BaseException | None, kind: type[BaseException]) -> bool:
    """Tell whether an error comes from one of a kind, as a KeyboardInterrupt is from Ctrl-C.

    Pressed while compiled code hands its result to Python, it arrives wrapped in SystemErrors;
    click wraps it, too.
    """
    while error is not None:
        if isinstance(error, kind):
            return True
        error = error.__cause__ or error.__context__
    return False


#: What may stand behind a command as well as before it.
_FOR_ALL = re.compile(r"-q|-v+|--quiet|--verbose|--threads=.*")


def _in_order(words: Sequence[str]) -> list[str]:
    """Return a command line with what holds for all commands before the command.

    Examples
    --------
    >>> _in_order(["detect", "s", "-q", "-o", "r.h5"])
    ['-q', 'detect', 's', '-o', 'r.h5']
    """
    words = list(words)
    end = words.index("--") if "--" in words else len(words)
    if "--threads" in words[: end - 1]:
        at = words.index("--threads")
        words[at : at + 2] = [f"--threads={words[at + 1]}"]
        end -= 1
    first = [word for word in words[:end] if _FOR_ALL.fullmatch(word)]
    rest = [word for word in words[:end] if not _FOR_ALL.fullmatch(word)]
    return [*first, *rest, *words[end:]]


def _refuse(*lines: str) -> NoReturn:
    """Tell what is wrong, a line each, and leave."""
    for line in lines:
        tell(f"error: {line}", err=True)
    sys.exit(1)


def _of_file(error: OSError) -> str:
    return "" if error.filename is None else f"{error.filename}: "


def _way_out(error: OSError) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "; free some room there and run it again"
    if error.errno in (errno.EIO, errno.ESTALE, errno.ENOTCONN):
        return "; is the disk or the network folder still there?"
    return ""


def main() -> NoReturn:
    """Run the command line and leave with its exit status."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _terminate)
    try:
        cli.main(_in_order(sys.argv[1:]), standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:  # whose message is the help
        error.show()
        sys.exit(error.exit_code)
    except click.ClickException as error:  # wrong usage
        context = getattr(error, "ctx", None)
        command = "hybridve" if context is None else context.command_path
        text = error.format_message().rstrip(".")
        between = "" if text.endswith("?") else ";"
        tell(f"error: {text}{between} `{command} --help` shows what there is", err=True)
        sys.exit(error.exit_code)
    except HybridveError as error:
        _refuse(*error.lines)
    except ImportError as error:
        if (error.name or "").startswith("hybridve"):
            raise
        _refuse(
            f"{error.name or 'a library'} cannot be loaded ({error}); "
            "`hybridve doctor` tells what is missing and what installs it"
        )
    except (KeyboardInterrupt, click.Abort, SystemError) as error:
        if not isinstance(error, click.Abort) and not _is_caused_by(error, KeyboardInterrupt):
            raise
        _leave_interrupted(error)
    except OSError as error:
        # Where files are written and read, what goes wrong is told in their own terms. What comes
        # here is a disk that is full or gone in the midst of something else.
        if error.errno is None:
            raise
        _refuse(f"{_of_file(error)}{error.strerror}{_way_out(error)}")
    except MemoryError:
        _refuse(
            "there is not enough memory; take fewer frames (--frames) or a smaller viewport, or "
            "close other programs"
        )
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    sys.exit(0)
