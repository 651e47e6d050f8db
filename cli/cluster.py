"""A batch on a Dask cluster: the extra ``cluster`` (``pip install hybridve[cluster]``)."""

import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hybridve.calib.errors import DeviceError
from hybridve.cli.unit import Ended, Job, reason_in

#: How often a task may lose the worker that it runs on: tried once again, as in the pool.
_STRIKES = 1

#: How often a job is begun that finds its output held by another, and how long it waits between.
_TRIES, _PAUSE_S = 4, 5.0


def run_on_cluster(address: str, jobs: Sequence[Job], ended: Callable[[Job, Any], object]) -> None:
    """Run jobs on the workers of a cluster that stands; its size is its own.

    Raises
    ------
    DeviceError
        If Dask is not installed, or no scheduler answers.
    """
    try:
        import distributed
    except ImportError:
        raise DeviceError(
            "--cluster needs Dask, which is not installed: pip install 'hybridve[cluster]'"
        ) from None
    by_file = {"scheduler_file": address} if Path(address).is_file() else {"address": address}
    try:
        client = distributed.Client(**by_file, set_as_default=False, timeout="30s")
    except (OSError, ValueError) as error:
        raise DeviceError(f"{address}: no scheduler of Dask answers there: {error}") from error
    with client:
        client.run_on_scheduler(_set_strikes, strikes=_STRIKES)
        futures = {
            client.submit(_on_worker, job, key=f"hybridve-{job.unit}", pure=False): job
            for job in jobs
        }
        for future in distributed.as_completed(list(futures), loop=client.loop):
            failure = future.exception()
            ended(futures[future], future.result() if failure is None else _told(failure))


def _set_strikes(dask_scheduler: Any = None, *, strikes: int) -> None:
    dask_scheduler.allowed_failures = strikes


def _told(error: BaseException) -> Exception:
    name = type(error).__name__
    text = "the workers that worked at it died" if name == "KilledWorker" else str(error)
    return RuntimeError(text)


def _on_worker(job: Job) -> Ended:
    """Run a job in a process of its own, which ends where the worker dies."""
    started = time.monotonic()
    for _ in range(_TRIES):
        with Path(job.log).open("w", encoding="utf-8") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "hybridve.cli.unit", *job.words],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
            status = process.wait()
        reason = "" if status == 0 else reason_in(Path(job.log))
        if "another run is writing it" not in reason:
            break
        time.sleep(_PAUSE_S)  # that of a worker that died a moment ago, which is ending
    return Ended(status, reason, time.monotonic() - started, process.pid)
