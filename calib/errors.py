"""The errors a user can fix.

Each message is complete on its own: which thing, what was found, what was expected, what to do.
Only ``cli/main.py`` turns them into text. Programming mistakes stay `ValueError` and `TypeError`.
"""

from collections.abc import Callable
from typing import Any, TypeVar, overload

_T = TypeVar("_T")
_A = TypeVar("_A")
_B = TypeVar("_B")
_C = TypeVar("_C")


class HybridveError(Exception):
    """Root of all errors raised on purpose by hybridve: one line, or several found at once."""

    @property
    def lines(self) -> tuple[str, ...]:
        """What is wrong, a line each."""
        return tuple(str(line) for line in self.args)

    def __str__(self) -> str:
        return "; ".join(self.lines)


class SessionError(HybridveError):
    """A session.toml, or a file it names, cannot be used."""


class SceneError(HybridveError):
    """A scene.toml, or a mesh it names, cannot be used."""


class CalibrationError(HybridveError):
    """A rig cannot be found, read, solved or trusted."""


class DeviceError(HybridveError):
    """No OpenGL device that serves."""


class ReportError(HybridveError):
    """A report or silhouette file cannot be read or written."""


class Faults:
    """Asks one thing after the other, and keeps what is wrong, so that all is told in one go.

    Attributes
    ----------
    lines : list of str
        What is wrong, a line each.
    """

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._kind: type[HybridveError] = HybridveError

    def of(self, ask: Callable[[], _T]) -> _T | None:
        """Return the answer; None where there is none."""
        try:
            return ask()
        except HybridveError as error:
            if not self.lines:
                self._kind = type(error)
            self.lines += error.lines
            return None

    def refuse(self) -> None:
        """Raise an error of the first one's class with all that is wrong, if anything is."""
        if self.lines:
            raise self._kind(*dict.fromkeys(self.lines))


@overload
def ask_all(first: Callable[[], _A], second: Callable[[], _B], /) -> tuple[_A, _B]: ...
@overload
def ask_all(
    first: Callable[[], _A], second: Callable[[], _B], third: Callable[[], _C], /
) -> tuple[_A, _B, _C]: ...
def ask_all(*asked: Callable[[], Any]) -> tuple[Any, ...]:
    """Return the answers to all that is asked.

    Raises
    ------
    HybridveError
        With all that is wrong, of the class of the first that is.
    """
    faults = Faults()
    answers = tuple(faults.of(ask) for ask in asked)
    faults.refuse()
    return answers
