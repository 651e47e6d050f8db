"""HDF5 files with one result each: complete or absent, of a known format and version."""

import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import h5py
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.calib.files import appearing
from hybridve.hull.report.machine import Run

#: How every dataset of a result is stored.
STORED = {
    "compression": "gzip",
    "compression_opts": 1,  # twice as quick as the default, files a few per cent larger
    "shuffle": True,
    "fletcher32": True,
    "track_times": False,
}

#: How far a number can be trusted. "exact": what it says, to floating-point accuracy. "bound": the
#: truth is on one side of it, or between two. "estimate": near the truth, by a model of errors or
#: a guess at what was not seen. "sampled": of the samples alone; what lies between them is missed.
Kind = Literal["exact", "bound", "estimate", "sampled"]


@dataclass(frozen=True, slots=True)
class Described:
    """What a dataset says of itself.

    Attributes
    ----------
    name : str
        Its name in the file, below its group.
    unit : str
        "1" where it has none.
    kind : Kind
        How far it can be trusted.
    description : str
        What it says, for whoever opens the file.
    """

    name: str
    unit: str
    kind: Kind
    description: str

    def describe(self, dataset: h5py.Dataset) -> None:
        """Write it to a dataset."""
        dataset.attrs["unit"] = self.unit
        if self.unit != "1":
            dataset.attrs["units"] = self.unit  # what netCDF's readers look for
        dataset.attrs["kind"] = self.kind
        dataset.attrs["description"] = self.description


def store(group: h5py.Group, column: Described, values: NDArray[Any]) -> h5py.Dataset:
    """Store an array in a group, and return its dataset."""
    dataset = group.create_dataset(column.name, data=values, chunks=True, **STORED)
    column.describe(dataset)
    return dataset


def store_fields(group: h5py.Group, value: object, columns: Sequence[Described]) -> None:
    """Store those fields of a value that columns name."""
    for column in columns:
        store(group, column, getattr(value, column.name))


def store_text(group: h5py.Group, name: str, text: str | list[str], description: str) -> None:
    """Store one text, or several."""
    dataset = group.create_dataset(name, data=text, dtype=h5py.string_dtype(), track_times=False)
    Described(name, "1", "exact", description).describe(dataset)


def write_run(file: h5py.File, what: str, version: int, run: Run) -> None:
    """Write that a file is of the format ``hybridve-WHAT``, of which version, and of which run."""
    file.attrs["format"] = f"hybridve-{what}"
    file.attrs["version"] = version
    file.attrs["created_utc"] = run.created_utc
    file.attrs["command"] = run.command
    file.attrs["machine"] = run.machine
    file.attrs["versions"] = json.dumps(run.versions)


def read_run(file: h5py.File) -> Run:
    """Return which run made a file."""
    return Run(
        command=file.attrs["command"],
        machine=file.attrs["machine"],
        versions=json.loads(file.attrs["versions"]),
        created_utc=file.attrs["created_utc"],
    )


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


def parts_of(path: Path) -> Path:
    """Return the folder beside a result in which its parts are gathered."""
    return path.with_name(path.name + ".parts")


def refuse_parts(parts: Path, *, resume: bool, overwrite: bool) -> None:
    """Refuse to begin where the parts of a run stand that was cut off.

    Raises
    ------
    ReportError
        If they do, and are to be neither taken up nor replaced.
    """
    if parts.is_dir() and not resume and not overwrite:
        raise ReportError(
            f"{parts}: a run that was cut off stands there; take it up with --resume, or start "
            "anew with --overwrite"
        )


def begin_parts(path: Path, parts: Path, stamp: str) -> None:
    """Make the empty folder in which the parts of a result are gathered, with what it is of.

    What stands there is removed.

    Raises
    ------
    ReportError
        If it cannot be written; it names the result at `path`.
    """
    try:
        if parts.is_dir():
            shutil.rmtree(parts)
        parts.mkdir(parents=True)
        (parts / "settings.json").write_text(stamp, encoding="utf-8")
    except OSError as error:
        raise ReportError(
            f"{path}: cannot be written: {error.strerror} ({error.filename})"
        ) from error


def format_of(path: Path) -> str:
    """Return which result a file holds: "report", "simulation", ...; "" if it is none of ours."""
    try:
        with h5py.File(path, "r") as file:
            return str(file.attrs.get("format", "")).removeprefix("hybridve-")
    except OSError:
        return ""


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
