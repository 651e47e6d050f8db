"""How many processors a command takes: what ``--threads N`` says."""

import os
from collections.abc import Sequence

#: What libraries of linear algebra and of threads ask, when they are loaded.
_ASKED = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def take_threads(number: int) -> None:
    """Run on so many of the processors that this process may use, and no more.

    Which ones follows from the process, so that several that are started side by side spread.
    """
    if not hasattr(os, "sched_getaffinity"):
        take_cpus(range(number))
        return
    cpus = sorted(os.sched_getaffinity(0))
    begin = os.getpid() * number % len(cpus)
    take_cpus([cpus[(begin + step) % len(cpus)] for step in range(min(number, len(cpus)))])


def take_cpus(cpus: Sequence[int]) -> None:
    """Run on these processors only; threads that are begun from now on do so, too."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cpus)
    for name in _ASKED:
        os.environ[name] = str(len(cpus))
