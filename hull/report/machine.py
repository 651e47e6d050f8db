"""The run, the machine and the software that made a result, as its file remembers them."""

import os
import platform
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Self

#: The packages whose versions decide a result.
PACKAGES = (
    "hybridve",
    "numpy",
    "opencv-python-headless",
    "pycolmap",
    "numba",
    "moderngl",
    "h5py",
    "scipy",
    "cascadio",
)


def software_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that decide a result."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def n_threads() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def machine_text() -> str:
    """Return the machine in words: system, processor, processors to use."""
    processor = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                processor = line.split(":", 1)[1].strip()
                break
    return f"{platform.system()} {platform.release()}, {processor}, {n_threads()} processors"


def utc_now() -> str:
    """Return the time as files give it."""
    return datetime.now(UTC).isoformat(timespec="seconds")


@dataclass(frozen=True, slots=True)
class Run:
    """Which run made a result.

    Attributes
    ----------
    command : str
        The command line.
    machine : str
        The machine in words.
    versions : dict
        Versions of the software that took part.
    created_utc : str
        When the result was there.
    """

    command: str
    machine: str
    versions: dict[str, str]
    created_utc: str

    @classmethod
    def now(cls, command: str) -> Self:
        """Return the run of a command on this machine, now."""
        return cls(command, machine_text(), software_versions(), utc_now())
