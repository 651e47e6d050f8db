"""Progress on stderr: how far, how fast, how long still."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

#: Seconds between two lines where stderr is a file and not a terminal.
_QUIET_INTERVAL_S = 10.0


class Advance(Protocol):
    """Told after each step."""

    def __call__(self, n: int = 1) -> object:
        """Count `n` steps more."""
        ...


@contextmanager
def progress_bar(
    what: str, total: int, *, unit: str = "frame", done: int = 0, enabled: bool = True
) -> Iterator[Advance]:
    """Show a bar with speed and time left while the block runs."""
    from tqdm import tqdm

    terminal = sys.stderr.isatty()
    with tqdm(
        desc=what,
        total=total,
        initial=done,
        unit=unit,
        file=sys.stderr,
        disable=not enabled,
        mininterval=0.1 if terminal else _QUIET_INTERVAL_S,
        dynamic_ncols=True,
    ) as bar:
        yield bar.update


class StageProgress:
    """Shows one bar after another for work that names its stages: ``(what, done, total)``."""

    def __init__(self, *, enabled: bool = True) -> None:
        self._enabled = enabled and sys.stderr.isatty()
        self._what = ""

    def __call__(self, what: str, done: int, total: int) -> None:
        """Tell that `done` of `total` steps of the stage `what` are done."""
        if not self._enabled:
            return
        if what != self._what and self._what:
            sys.stderr.write("\n")
        self._what = what
        sys.stderr.write(f"\r{what}: {done}/{total}")
        if done == total:
            sys.stderr.write("\n")
            self._what = ""
        sys.stderr.flush()
