"""What is told while something long runs, whoever looks on."""

from contextlib import AbstractContextManager
from typing import Protocol


class Advance(Protocol):
    """Told after each step."""

    def __call__(self, n: int = 1) -> object:
        """Count `n` steps more."""
        ...


class Watcher(Protocol):
    """Who looks on."""

    def stage(self, what: str, done: int, total: int) -> None:
        """Tell that so many steps of a stage are done."""
        ...

    def steps(
        self, what: str, total: int, *, done: int = 0, unit: str = "frame"
    ) -> AbstractContextManager[Advance]:
        """Open something that is told after each of `total` steps, of which some are done."""
        ...

    def say(self, text: str) -> None:
        """Say what goes on, for those who look on."""
        ...

    def warn(self, text: str) -> None:
        """Say what everybody should know, whether they look on or not."""
        ...
