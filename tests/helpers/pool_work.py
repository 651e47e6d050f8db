"""What processes of a pool are given to do in tests: light, and found by its name."""

import os
import signal
from pathlib import Path


def mark_and_die(task: tuple[str, int], cpus: tuple[int, ...]) -> tuple[int, tuple[int, ...]]:
    """Count the tries in a file; die as if killed in the first so many of them."""
    path, n_deaths = task
    tries = Path(path)
    tries.write_text(tries.read_text() + "x" if tries.exists() else "x")
    count = len(tries.read_text())
    if count <= n_deaths:
        os.kill(os.getpid(), signal.SIGKILL)
    if n_deaths < 0:
        raise ValueError("this work is wrong")
    return count, cpus
