"""HDF5 files of strangers: looked through once by a process that may die of them, then read.

HDF5's parser has memory faults that a damaged or malicious file reaches, and follows links to any
file of the machine. So a file that this machine did not write is first read from end to end by
`hybridve.hull.stored_check`, in a process of its own with bounded memory and time. What has passed
is remembered in the cache (``known``), by its checksum and by where it lies, and not looked through
again; what this program writes is known from the beginning.
"""

import atexit
import errno
import hashlib
import json
import os
import selectors
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py

from hybridve.calib.cache import cache_folder, cache_key
from hybridve.calib.errors import ReportError

#: What HDF5 raises on files that are damaged, and Python on what it then reads from them.
DAMAGED = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)


class DamagedError(ReportError):
    """A file that is not safe to read, or cannot be.

    Attributes
    ----------
    problem : str
        What is wrong with it, without its name.
    """

    def __init__(self, line: str, problem: str) -> None:
        super().__init__(line)
        self.problem = problem


#: How long a file is looked through at most: seconds, and seconds more for each byte.
_LONGEST_S, _S_PER_BYTE = 60.0, 1e-7

#: How many files are remembered at most.
_MOST_KNOWN = 20_000


def open_stored(path: Path) -> h5py.File:
    """Return an HDF5 file, opened to be read, that is safe to read.

    Raises
    ------
    ReportError
        If another program is writing it, or looking through it ended badly.
    OSError
        If it is no HDF5 file.
    """
    _look_through(path)
    try:
        return h5py.File(path, "r")
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EWOULDBLOCK) or "unable to lock" in str(error):
            raise _in_use(path) from error
        raise


def remember(path: Path) -> None:
    """Remember a file that this program has written: it need not be looked through."""
    with suppress(OSError):
        _keep(_place_key(path))


@contextmanager
def telling_damage(path: Path, what: str, hint: str = "") -> Iterator[None]:
    """Turn whatever reading a damaged file raises into one line.

    Raises
    ------
    ReportError
        It names the file, as a `what`.
    """
    try:
        yield
    except (DamagedError, *DAMAGED) as error:
        raise ReportError(
            f"{path}: not a readable {what}, or damaged: {damage_in(error)}{hint}"
        ) from error


def damage_in(error: Exception) -> str:
    """Return what is wrong, of an error of `DAMAGED` or a `DamagedError`, in one line."""
    if isinstance(error, DamagedError):
        return error.problem
    return (str(error).splitlines() or [type(error).__name__])[0]


def _in_use(path: Path) -> ReportError:
    return ReportError(
        f"{path}: is open in another program, which may be writing it; close it there, or wait"
    )


# --- What is known --------------------------------------------------------------------------


def _place_key(path: Path) -> str:
    """Return the name of a file as it is now, by where it lies and when it was written."""
    found = path.stat()
    state = (found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino, found.st_dev)
    return cache_key("place", os.path.realpath(path), *map(str, state))


def _keep(key: str) -> None:
    folder = cache_folder("known")
    if folder is None:
        return
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / key).touch()
        if key.startswith("00"):  # now and then
            known = sorted(folder.iterdir(), key=lambda one: one.stat().st_mtime_ns)
            for old in known[:-_MOST_KNOWN]:
                old.unlink(missing_ok=True)


def _is_known(key: str) -> bool:
    folder = cache_folder("known")
    return folder is not None and (folder / key).exists()


def _look_through(path: Path) -> None:
    place = _place_key(path)
    if _is_known(place):
        return
    with path.open("rb") as file:
        content = cache_key("content", hashlib.file_digest(file, "sha256").hexdigest())
    if not _is_known(content):
        problem = _reader.ask(path, _LONGEST_S + _S_PER_BYTE * path.stat().st_size)
        if problem == "in use":
            raise _in_use(path)
        if problem:
            raise DamagedError(f"{path}: {problem}", problem)
        _keep(content)
    _keep(place)


class _Reader:
    """A process that looks through files, one after another; another one when it dies."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()
        atexit.register(self.end)

    def ask(self, path: Path, longest_s: float) -> str:
        """Return what is wrong with a file; empty if nothing is."""
        with self._lock:
            process = self._running()
            assert process.stdin is not None
            assert process.stdout is not None
            try:
                process.stdin.write(json.dumps(os.fsencode(path.absolute()).hex()).encode() + b"\n")
                process.stdin.flush()
                with selectors.DefaultSelector() as waiting:
                    waiting.register(process.stdout, selectors.EVENT_READ)
                    answer = process.stdout.readline() if waiting.select(longest_s) else None
            except BrokenPipeError:
                answer = b""
            if answer is None:
                self.end()
                return f"HDF5 does not come to an end with it in {longest_s:.0f} s; it is damaged"
            if not answer:
                self.end()
                return "HDF5 crashes on it; it is damaged, or made to do harm"
            told: Any = json.loads(answer)
            return str(told)

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is not None and self._process.poll() is not None:
            self.end()
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "hybridve.hull.stored_check"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
        return self._process

    def end(self) -> None:
        """End the process, if one runs."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    with suppress(OSError):
                        pipe.close()


_reader = _Reader()
