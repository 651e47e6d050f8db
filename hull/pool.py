"""Work side by side in spawned processes, each of which may die without harm to the others.

A process is never forked: one that has an OpenGL context hangs. Each place has a pool of one
process of its own, as a process that is killed breaks the whole pool that it belongs to; the pool
is made anew, and the work that it had tried once again.
"""

import multiprocessing
import os
import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from typing import Generic, TypeVar

_Task = TypeVar("_Task")
_Answer = TypeVar("_Answer")


class ProcessDiedError(Exception):
    """The process that did some work died, and so did the next one."""


class Pool(Generic[_Task, _Answer]):
    """So many processes, each with its share of the machine's processors.

    Parameters
    ----------
    n_workers : int
        How many.
    work : callable
        What is done with a task, given that and the processors to use; both can be pickled.
    cpus : sequence of int
        The processors that may be used; each process has its share of them.
    """

    def __init__(
        self,
        n_workers: int,
        work: Callable[[_Task, tuple[int, ...]], _Answer],
        cpus: Sequence[int],
    ) -> None:
        self._work = work
        self._shares = [
            tuple(cpus[number::n_workers]) or tuple(cpus) for number in range(n_workers)
        ]
        self._pools: list[ProcessPoolExecutor | None] = [None] * n_workers
        self._ended = False

    def run(
        self,
        tasks: Sequence[_Task],
        *,
        begun: Callable[[_Task], None],
        ended: Callable[[_Task, _Answer | Exception], None],
    ) -> None:
        """Do all tasks; `begun` and `ended` are called one at a time, in this thread.

        A task whose process dies is tried once again; if that dies, too, it ends with a
        `ProcessDiedError`.
        """
        waiting: queue.SimpleQueue[_Task] = queue.SimpleQueue()
        for task in tasks:
            waiting.put(task)
        told: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()

        def serve(place: int) -> None:
            while not self._ended:
                try:
                    task = waiting.get_nowait()
                except queue.Empty:
                    break
                told.put(partial(begun, task))
                told.put(partial(ended, task, self._tried(place, task)))
            told.put(None)

        n_at_work = min(len(self._pools), len(tasks))
        for place in range(n_at_work):
            threading.Thread(target=serve, args=(place,), daemon=True).start()
        while n_at_work:
            call = told.get()
            if call is None:
                n_at_work -= 1
            else:
                call()

    def _tried(self, place: int, task: _Task) -> _Answer | Exception:
        for _ in range(0 if self._ended else 2):
            pool = self._pools[place]
            if pool is None:
                pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
                self._pools[place] = pool
            try:
                return pool.submit(self._work, task, self._shares[place]).result()
            except BrokenProcessPool:
                pool.shutdown(wait=False)
                self._pools[place] = None
                if self._ended:
                    break
            except Exception as error:  # what the work itself raises is its answer
                return error
        return ProcessDiedError("the process that worked at it was killed, twice")

    def end(self, *, at_once: bool) -> None:
        """End all processes; at once: whatever they are at, which they leave to be taken up."""
        self._ended = True
        for pool in self._pools:
            if pool is not None:
                processes = list((getattr(pool, "_processes", None) or {}).values())
                for process in processes if at_once else ():
                    process.terminate()
                pool.shutdown(wait=True, cancel_futures=True)

    def __enter__(self) -> "Pool[_Task, _Answer]":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End the processes."""
        self.end(at_once=kind is not None)


def usable_cpus() -> tuple[int, ...]:
    """Return the processors that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return tuple(sorted(os.sched_getaffinity(0)))
    return tuple(range(os.cpu_count() or 1))
