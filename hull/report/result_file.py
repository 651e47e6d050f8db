"""HDF5 files with one result each: complete or absent, of a known format and version."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py

from hybridve.calib.errors import ReportError
from hybridve.calib.files import appearing

#: How every dataset of a result is stored.
STORED = {
    "compression": "gzip",
    "compression_opts": 1,  # twice as quick as the default, files a few per cent larger
    "shuffle": True,
    "fletcher32": True,
    "track_times": False,
}


@contextmanager
def writing(path: Path) -> Iterator[h5py.File]:
    """Yield a file to write into, which appears under its name once it is complete.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    try:
        with appearing(path) as partial, h5py.File(partial, "w") as file:
            yield file
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error}") from error


@contextmanager
def reading(path: Path, what: str, *versions: int) -> Iterator[h5py.File]:
    """Yield a file of the format ``hybridve-WHAT`` and one of these versions to read from.

    Raises
    ------
    ReportError
        If there is no such file, it is of another format, of an unknown version, or damaged.
    """
    if not path.is_file():
        raise ReportError(f"{path}: there is no such {what}")
    try:
        with h5py.File(path, "r") as file:
            found = file.attrs.get("format", "an unknown format")
            if found != f"hybridve-{what}":
                raise ReportError(f"{path}: holds {found}, expected hybridve-{what}")
            stored = int(file.attrs["version"])
            if stored not in versions:
                known = " and ".join(map(str, versions))
                raise ReportError(
                    f"{path}: {what} version {stored}, this hybridve reads {known}; "
                    "use the version that wrote it"
                )
            yield file
    except (OSError, KeyError, ValueError) as error:
        text = str(error).splitlines()[0]
        raise ReportError(f"{path}: not a readable {what}, or damaged: {text}") from error
