"""HDF5 files with one result each: complete or absent, of a known format and version."""

import json
import re
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.calib.files import sink, write_whole
from hybridve.hull.report.machine import Run
from hybridve.hull.stored import DAMAGED, open_stored, remember, telling_damage

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
        with sink(path, holds_errors=True) as out, h5py.File(out, "w") as file:
            yield file
        remember(path)
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error.strerror or error}") from error


def parts_of(path: Path) -> Path:
    """Return the folder beside a result in which its parts are gathered."""
    return path.with_name(path.name + ".parts")


def refuse_parts(parts: Path, *, resume: bool, overwrite: bool) -> None:
    """Refuse to begin where the parts of a run stand that was cut off.

    Raises
    ------
    ReportError
        If they do, and are to be neither taken up nor replaced; or somebody else's files do.
    """
    if parts.is_symlink():
        raise ReportError(f"{parts}: is a link; the parts of a result are kept in a true folder")
    strange = _strange_in(parts)
    if strange:
        raise ReportError(
            f"{parts}: holds {strange[0]!r}, which is none of hybridve's; move it elsewhere, or "
            "choose another name for the output"
        )
    if parts.is_dir() and not resume and not overwrite:
        raise ReportError(
            f"{parts}: a run that was cut off stands there; take it up with --resume, or start "
            "anew with --overwrite"
        )


def refuse_other(path: Path, found: object, wanted: object) -> None:
    """Refuse to take up a result that is finished, where it is one of something else.

    The parts that it was made of, if a run was cut off before it removed them, are removed.

    Parameters
    ----------
    path : Path
        The result.
    found, wanted
        What it says that it was made with, and what it is to be made with; both as JSON has it.

    Raises
    ------
    ReportError
        If these differ.
    """
    if json.loads(json.dumps(found)) != json.loads(json.dumps(wanted)):
        raise ReportError(
            f"{path}: was finished with other settings, another recording or another scene; "
            "give the same again, or start anew with --overwrite"
        )
    with suppress(OSError):
        remove_parts(parts_of(path))


def begin_parts(path: Path, parts: Path, stamp: str) -> None:
    """Make the empty folder in which the parts of a result are gathered, with what it is of.

    What stands there of another run is removed.

    Raises
    ------
    ReportError
        If it cannot be written; it names the result at `path`.
    """
    try:
        remove_parts(parts)
        parts.mkdir(parents=True, exist_ok=True)
        write_whole(parts / "settings.json", stamp)
    except OSError as error:
        raise ReportError(
            f"{path}: cannot be written: {error.strerror} ({error.filename or parts})"
        ) from error


def read_stamp(parts: Path) -> str:
    """Return what the parts of a result say that they are of; empty if they say nothing."""
    try:
        return (parts / "settings.json").read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""


def sound_parts(parts: Path, index: str) -> list[Path]:
    """Return the parts that a run may be taken up from, in their order.

    A part that is damaged, or does not follow on the one before, is removed, and all after it: what
    they held is computed again.

    Parameters
    ----------
    parts : Path
        Their folder.
    index : str
        Which array has an entry for each frame.

    Raises
    ------
    ReportError
        If a part cannot be removed.
    """
    found: list[Path] = []
    n_done = 0
    paths = sorted(parts.glob("*.npz"))
    for number, path in enumerate(paths):
        count = _frames_of(path, index)
        if path.stem != f"{n_done:09d}" or not count:
            for bad in paths[number:]:
                try:
                    bad.unlink()
                except OSError as error:
                    raise ReportError(
                        f"{bad}: is damaged, and cannot be removed: {error.strerror}"
                    ) from error
            break
        found.append(path)
        n_done += count
    return found


def _frames_of(part: Path, index: str) -> int:
    """Return how many frames a part holds, all of whose checksums are right; else 0."""
    try:
        with zipfile.ZipFile(part) as archive:
            if archive.testzip() is not None:
                return 0
        with np.load(part) as columns:
            return len(columns[index])
    except Exception:  # damage has many names
        return 0


#: What a run leaves among its parts.
_PART = re.compile(r"settings\.json(\.partial)?|\d{9}(\.npz)?(\.partial)?")


def _strange_in(parts: Path) -> list[str]:
    """Return what stands among parts that no run of ours has put there."""
    if not parts.is_dir():
        return []
    return sorted(one.name for one in parts.iterdir() if not _PART.fullmatch(one.name))


def remove_parts(parts: Path) -> None:
    """Remove the parts of a result; what somebody else has put among them stays.

    Raises
    ------
    OSError
        If they cannot be removed.
    """
    if not parts.is_dir() or parts.is_symlink():
        return
    for one in parts.iterdir():
        if _PART.fullmatch(one.name):
            one.unlink(missing_ok=True)
    if not any(parts.iterdir()):
        parts.rmdir()


def format_of(path: Path) -> str:
    """Return which result a file holds: "report", "simulation", ...; "" if it is none of ours."""
    try:
        with open_stored(path) as file:
            return str(file.attrs.get("format", "")).removeprefix("hybridve-")
    except (ReportError, *DAMAGED):
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
    with telling_damage(path, what), open_stored(path) as file:
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
