"""Progress on stderr: how far, how fast, how long still."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from hybridve.cli.options import tell
from hybridve.hull.watcher import Advance

#: Seconds between two lines where stderr is a file and not a terminal.
_QUIET_INTERVAL_S = 10.0


class Terminal:
    """Shows what goes on; a `hybridve.hull.watcher.Watcher`.

    Parameters
    ----------
    enabled : bool
        Whether progress is shown; warnings are in any case.
    """

    def __init__(self, *, enabled: bool = True) -> None:
        self._enabled = enabled
        self._what = ""

    def stage(self, what: str, done: int, total: int) -> None:
        """Show one line after another for work that names its stages, where stderr is one."""
        if not (self._enabled and sys.stderr.isatty()):
            return
        if what != self._what and self._what:
            sys.stderr.write("\n")
        self._what = what
        sys.stderr.write(f"\r{what}: {done}/{total}")
        if done == total:
            sys.stderr.write("\n")
            self._what = ""
        sys.stderr.flush()

    @contextmanager
    def steps(
        self, what: str, total: int, *, done: int = 0, unit: str = "frame"
    ) -> Iterator[Advance]:
        """Show a bar with speed and time left while the block runs."""
        from tqdm import tqdm

        with tqdm(
            desc=what,
            total=total,
            initial=done,
            unit=unit,
            file=sys.stderr,
            disable=not self._enabled,
            mininterval=0.1 if sys.stderr.isatty() else _QUIET_INTERVAL_S,
            dynamic_ncols=True,
        ) as bar:
            yield bar.update

    def say(self, text: str) -> None:
        """Show a line."""
        if self._enabled:
            self.warn(text)

    def warn(self, text: str) -> None:
        """Show a line in any case."""
        tell(text, err=True)
