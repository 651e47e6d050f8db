"""Plain Python threads for compiled loops, which release the GIL.

They sleep between queries. numba's own thread pools are not used: they spin while they wait and
slow down whatever else runs (OpenCV, Open3D); ``tests/benchmarks/bench_thread_pools.py`` shows it.
"""

import itertools
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

#: Shares of the work for each thread: the last one to finish should not be waited for long.
_SHARES = 4


class Threads:
    """Threads that work off calls together with the thread that asks; several may ask at once.

    Parameters
    ----------
    number : int, optional
        How many, with the one that asks; by default as many as the process may run on.
    """

    def __init__(self, number: int | None = None) -> None:
        self.number = number or usable_cpus()
        self._executor: ThreadPoolExecutor | None = None
        self._opening = threading.Lock()

    @property
    def n_shares(self) -> int:
        """Into how many calls work is best cut."""
        return _SHARES * self.number

    def run(self, calls: list[tuple[Callable[..., Any], tuple[Any, ...]]]) -> list[Any]:
        """Return the results of functions called with arguments; who is free takes the next one."""
        results: list[Any] = [None] * len(calls)
        numbers = itertools.count()  # next() is atomic

        def work() -> None:
            while (number := next(numbers)) < len(calls):
                function, arguments = calls[number]
                results[number] = function(*arguments)

        n_helpers = min(self.number, len(calls)) - 1
        if n_helpers > 0:
            with self._opening:  # several threads may ask at once
                if self._executor is None:
                    self._executor = ThreadPoolExecutor(self.number - 1, "volume-query")
        helpers = [
            self._executor.submit(work) for _ in range(n_helpers) if self._executor is not None
        ]
        work()
        for helper in helpers:
            helper.result()
        return results

    def close(self) -> None:
        """End the threads; a later run starts them again."""
        if self._executor is not None:
            self._executor.shutdown()
            self._executor = None


def usable_cpus() -> int:
    """Return how many processors this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
