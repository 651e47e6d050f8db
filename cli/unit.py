"""What a worker of a batch does: one command line, on its processors; its words go to a log."""

import multiprocessing
import os
import signal
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from hybridve.cli.threads import take_cpus


@dataclass(frozen=True, slots=True)
class Job:
    """A command line that a worker runs.

    Attributes
    ----------
    unit : str
        What it is called.
    words : tuple of str
        The command line, from the command's name on.
    log : str
        The file that takes all that it tells; written anew.
    """

    unit: str
    words: tuple[str, ...]
    log: str


@dataclass(frozen=True, slots=True)
class Ended:
    """How a command line ended.

    Attributes
    ----------
    status : int
        Its exit status.
    reason : str
        Its last line of an error, where that is not 0.
    seconds : float
        How long it took.
    pid : int
        The process that ran it.
    """

    status: int
    reason: str
    seconds: float
    pid: int


_watches_parent = threading.Event()


def run_job(job: Job, cpus: tuple[int, ...]) -> Ended:
    """Run a command line in this process, and tell how it ended."""
    if not _watches_parent.is_set():
        _watches_parent.set()
        threading.Thread(target=_end_with_parent, daemon=True).start()
    take_cpus(cpus)
    from hybridve.cli.main import main

    started = time.monotonic()
    sys.argv = ["hybridve", *job.words]
    kept = [os.dup(1), os.dup(2)]
    streams = sys.stdout, sys.stderr
    # Through the descriptors, so that libraries' own words go there as well.
    with Path(job.log).open("w", encoding="utf-8", buffering=1) as log:
        try:
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
            sys.stdout = sys.stderr = log
            try:
                main()
            except SystemExit as left:
                status = left.code if isinstance(left.code, int) else 1
        finally:
            sys.stdout, sys.stderr = streams
            for number, descriptor in zip((1, 2), kept, strict=True):
                os.dup2(descriptor, number)
                os.close(descriptor)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)  # while it waits there is nothing to tidy
    return Ended(
        status,
        "" if status == 0 else reason_in(Path(job.log)),
        time.monotonic() - started,
        os.getpid(),
    )


def reason_in(log: Path) -> str:
    """Return the first error that a log tells, or its last line."""
    lines = [
        line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line
    ]
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    return (errors or lines[-1:] or ["it left no word"])[0]


def _end_with_parent() -> None:
    """End this process where the one that gives it work has died."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)


def _main() -> None:
    """Run a command line that ends where whoever began it dies: its input comes to an end."""
    from hybridve.cli.main import main

    def watch() -> None:
        # Not through Python's buffer, whose lock would be missed when the program ends.
        while os.read(0, 1024):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()
    main()


if __name__ == "__main__":
    _main()
