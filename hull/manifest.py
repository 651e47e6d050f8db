"""The manifest of a batch: a line of JSON for whatever was tried, written when it has ended.

A unit whose last line says ``done`` is not run again if its result *verifies*: its file has the
checksum that stands there, and was made by the same versions, with the same command, of the same
inputs. That a file exists says nothing.
"""

import hashlib
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hybridve.calib.errors import ReportError
from hybridve.hull.places import Inputs

#: The manifest's name in the folder of the results.
MANIFEST = "MANIFEST.jsonl"


def append_record(path: Path, record: dict[str, Any]) -> None:
    """Add a line; it is on the disk when this returns.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    try:
        with path.open("a", encoding="utf-8") as file:
            if file.tell() and not _ends_line(path):  # what a killed run began
                file.write("\n")
            file.write(json.dumps(record) + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error.strerror}") from error


def _ends_line(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"


def read_records(path: Path) -> dict[str, dict[str, Any]]:
    """Return the last line of each unit, by its name; lines that are damaged are passed over."""
    found: dict[str, dict[str, Any]] = {}
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise ReportError(f"{path}: cannot be read: {error.strerror}") from error
    for line in lines:
        try:
            record = json.loads(line)
            found[str(record["unit"])] = record
        except (ValueError, KeyError, TypeError, RecursionError):
            continue
    return found


def checksum(path: Path) -> str:
    """Return the SHA-256 of a file; empty where there is none."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


def made_of(words: Iterable[str], paths: Iterable[Path], versions: dict[str, str]) -> str:
    """Return a checksum of all that decides a result: command, inputs and versions.

    Of inputs that are large, recordings and meshes, it is their sizes and when they were written.
    """
    digest = hashlib.sha256(json.dumps([list(words), versions], sort_keys=True).encode())
    inputs = Inputs.of(paths)
    for path in sorted(_all_of(inputs)):
        try:
            state = path.stat()
        except OSError:
            continue
        digest.update(os.fsencode(path))
        if path.suffix == ".toml":
            digest.update(checksum(path).encode())
        else:
            digest.update(f"{state.st_size} {state.st_mtime_ns}".encode())
    return digest.hexdigest()


def _all_of(inputs: Inputs) -> set[Path]:
    """Return the files that are read, and those in folders that patterns lead to."""
    found = set(inputs.files)
    for folder in inputs.listed:
        found.update(one for one in folder.iterdir() if one.is_file())
    return found


def verifies(record: dict[str, Any] | None, output: Path, made: str) -> bool:
    """Tell whether a result stands that is what it should be."""
    return (
        record is not None
        and record.get("outcome") == "done"
        and record.get("made_of") == made
        and bool(record.get("sha256"))
        and checksum(output) == record["sha256"]
    )
