"""One run at a time on one output: the second is told who holds it.

Beside the output lies ``NAME.lock`` while a run holds it, with who that is. It is the lock of the
file that counts, not that it is there: what a killed run leaves behind holds nobody up.
"""

import getpass
import json
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from filelock import FileLock, Timeout

from hybridve.calib.errors import ReportError


@contextmanager
def holding(path: Path, command: str, *, patience_s: float = 0.0) -> Iterator[None]:
    """Hold an output for as long as it takes; nobody else may write it meanwhile.

    Where no lock can be made (a folder that is not there, or may not be written to), none is held:
    whoever writes tells why it cannot be.

    Parameters
    ----------
    path : Path
        The output, whether it is there or not.
    command : str
        What the run was called with, for whoever comes second.
    patience_s : float
        How long to wait for another run, in seconds.

    Raises
    ------
    ReportError
        If another run holds it: which one, where, since when.
    """
    name = path.parent / (path.name + ".lock")
    if not path.name or not os.access(path.parent, os.W_OK) or name.is_symlink():
        yield
        return
    lock = FileLock(name, timeout=patience_s)
    try:
        lock.acquire()
    except Timeout:
        if not name.exists():  # it could not be made
            yield
            return
        raise ReportError(
            f"{path}: another run is writing it{_holder(name)}; wait for it, or choose another name"
        ) from None
    except (OSError, NotImplementedError):  # a full disk, a file system without locks
        yield
        return
    try:
        with suppress(OSError):
            name.write_text(json.dumps(_about(command)), encoding="utf-8")
        yield
    finally:
        with suppress(OSError):
            name.unlink()
        lock.release()


def _about(command: str) -> dict[str, object]:
    """Return who this is, for whoever comes second."""
    user = ""
    with suppress(OSError, KeyError):
        user = getpass.getuser()
    return {
        "pid": os.getpid(),
        "machine": platform.node(),
        "user": user,
        "since": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
    }


def _holder(name: Path) -> str:
    """Return, for a message, who holds a lock; empty where that does not stand in it."""
    try:
        told = json.loads(name.read_text(encoding="utf-8")[:4096])
        return (
            f" (process {told['pid']} of {told['user']} on {told['machine']}, since "
            f"{told['since']}: {told['command']})"
        )
    except (OSError, ValueError, KeyError, TypeError):
        return ""
