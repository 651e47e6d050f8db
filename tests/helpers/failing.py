"""A disk of which one write, one flush to disk or one change of a name fails: the k-th."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from hybridve.calib import files


class Disk:
    """Counts what is asked of it, and fails from the k-th on, or at the k-th alone.

    Attributes
    ----------
    asked : list of str
        What was asked: "write", "fsync", "rename".
    """

    def __init__(self, fails_at: int, *, stays: bool = True) -> None:
        self.asked: list[str] = []
        self._fails_at = fails_at
        self._stays = stays

    def ask(self, what: str, name: object) -> None:
        self.asked.append(what)
        number = len(self.asked)
        if number == self._fails_at or (self._stays and number > self._fails_at > 0):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(name))


@contextmanager
def failing(fails_at: int = 0, *, stays: bool = True) -> Iterator[Disk]:
    """Yield a disk that fails at its k-th operation, counted from 1; 0: it never does."""
    disk = Disk(fails_at, stays=stays)
    write, fsync, rename = files.Sink._write_some, os.fsync, os.replace

    def written(self: files.Sink, data: memoryview) -> int:
        disk.ask("write", self.name)
        return write(self, data)

    def settled(descriptor: int) -> None:
        disk.ask("fsync", descriptor)
        fsync(descriptor)

    def renamed(source: Any, target: Any, **how: Any) -> None:
        disk.ask("rename", target)
        rename(source, target, **how)

    def renamed_path(self: Path, target: Any) -> Path:
        renamed(self, target)
        return Path(target)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files.Sink, "_write_some", written)
        patch.setattr(os, "fsync", settled)
        patch.setattr(os, "replace", renamed)
        patch.setattr(Path, "replace", renamed_path)
        yield disk


def contents(folder: Path) -> dict[str, bytes]:
    """Return all files below a folder, by their names."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
