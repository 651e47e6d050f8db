"""A batch on a Dask cluster: the extra ``cluster`` (``pip install hybridve[cluster]``)."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hybridve.calib.errors import DeviceError
from hybridve.cli.unit import Job, run_job

#: How often a task may lose the worker that it runs on: tried once again, as in the pool.
_STRIKES = 1


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
        for future in distributed.as_completed(futures):
            failure = future.exception()
            ended(futures[future], future.result() if failure is None else _told(failure))


def _set_strikes(dask_scheduler: Any = None, *, strikes: int) -> None:
    dask_scheduler.allowed_failures = strikes


def _told(error: BaseException) -> Exception:
    name = type(error).__name__
    text = "the workers that worked at it died" if name == "KilledWorker" else str(error)
    return RuntimeError(text)


def _on_worker(job: Job) -> Any:
    """Run a job in a process of its own: a worker's threads are not the main one."""
    import multiprocessing
    import os
    from concurrent.futures import ProcessPoolExecutor

    cpus = tuple(sorted(os.sched_getaffinity(0)))
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(run_job, job, cpus).result()
