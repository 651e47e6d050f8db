"""Files that appear under their names when they are complete, or not at all; and missing ones.

All that the program writes comes through here, so that one place sees to it: what stands under a
name is the old file or the whole new one, whatever fails or is killed in between.
"""

import difflib
import io
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


class Sink(io.FileIO):
    """A file that is written to, unbuffered: what cannot be written is known where it is written.

    Parameters
    ----------
    path : Path
        The file; what stands there is emptied.
    holds_errors : bool
        Whether a write that fails is kept in `error`, and all after it is passed over. HDF5, from
        whose hands such a file comes, cannot be closed after an error without harm.

    Attributes
    ----------
    error : OSError or None
        What failed first.
    """

    def __init__(self, path: Path, *, holds_errors: bool = False) -> None:
        super().__init__(path, "w+")
        self.error: OSError | None = None
        self._holds_errors = holds_errors

    def write(self, data: "ReadableBuffer", /) -> int:
        """Write all of some bytes."""
        rest = memoryview(data).cast("B")
        length = len(rest)
        if self.error is not None:
            self.seek(length, os.SEEK_CUR)
            return length
        try:
            while rest:
                rest = rest[self._write_some(rest) :]
        except OSError as error:
            if not self._holds_errors:
                raise
            self.error = error
            self.seek(len(rest), os.SEEK_CUR)
        return length

    def _write_some(self, data: memoryview) -> int:
        """Write what goes in one piece, and return how many bytes that was."""
        return super().write(data) or 0

    def truncate(self, size: int | None = None, /) -> int:
        """Make the file as long as that."""
        try:
            return super().truncate(size)
        except OSError as error:
            if not self._holds_errors:
                raise
            self.error = self.error or error
            return self.tell() if size is None else size


@contextmanager
def sink(path: Path, *, holds_errors: bool = False) -> Iterator[Sink]:
    """Yield a file to write bytes into, which becomes `path` if all goes well.

    Parameters
    ----------
    path : Path
        The file; its folder exists.
    holds_errors : bool
        See `Sink`: what failed is raised at the end.
    """
    with appearing(path) as partial, Sink(partial, holds_errors=holds_errors) as file:
        try:
            yield file
        except Exception as error:
            # What is raised after a write that failed comes of it; HDF5's errors are OSErrors, too.
            if file.error is None:
                raise
            raise file.error from error
        if file.error is not None:
            raise file.error


def write_together(contents: Mapping[Path, bytes]) -> None:
    """Write files that belong together: all are there, or those that were there before.

    Raises
    ------
    OSError
        If one cannot be written.
    """
    partials = {path: path.with_name(path.name + ".partial") for path in contents}
    before = {path: path.with_name(path.name + ".before") for path in contents}
    moved: list[Path] = []
    try:
        for path, content in contents.items():
            with suppress(FileNotFoundError):
                partials[path].unlink()
            with Sink(partials[path]) as file:
                file.write(content)
            _to_disk(partials[path])
        for path in contents:
            if path.exists():
                path.replace(before[path])
            moved.append(path)
            partials[path].replace(path)
    except BaseException:
        for path in moved:
            with suppress(OSError):
                path.unlink(missing_ok=True)
        for path in contents:
            with suppress(OSError):
                if before[path].exists():
                    before[path].rename(path)
        for partial in partials.values():
            with suppress(OSError):
                partial.unlink()
        raise
    for path in contents:
        with suppress(OSError):
            before[path].unlink()
    for folder in {path.parent for path in contents}:
        with suppress(OSError):
            _to_disk(folder)


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a text, as UTF-8, or bytes as a file that is there whole or not at all.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    with sink(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


@contextmanager
def appearing(path: Path, *, is_contended: bool = False) -> Iterator[Path]:
    """Yield a name beside `path` to write a file under, which becomes `path` if all goes well.

    Nothing is left of it otherwise.

    Parameters
    ----------
    path : Path
        The file; its folder exists.
    is_contended : bool
        Whether several programs may write the file at once: each then has a name of its own, and
        nobody misses the file where the machine fails: it is not seen to that it is on the disk.
        Else it is ``NAME.partial``, so that what a killed program left is written over.
    """
    partial = path.with_name(path.name + ".partial")
    if is_contended:
        descriptor, name = tempfile.mkstemp(prefix=f"{path.name}.", dir=path.parent)
        os.close(descriptor)
        partial = Path(name)
    else:
        with suppress(FileNotFoundError):
            partial.unlink()  # a link, too: what it leads to is somebody else's
    try:
        yield partial
        if not is_contended:
            _to_disk(partial)
        partial.replace(path)
    except BaseException:
        with suppress(OSError):  # there may be none, nor a folder to remove it from
            partial.unlink()
        raise
    if not is_contended:
        with suppress(OSError):  # where a folder cannot be settled, the name may come later
            _to_disk(path.parent)


def _to_disk(path: Path) -> None:
    """See to it that what a file holds, or which names a folder holds, is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def nearly(path: Path) -> str:
    """Return, for a message, what is there that has nearly the name of a file that is not.

    Examples
    --------
    >>> nearly(Path("/there is no such folder/a.csv"))
    '; there is no folder /there is no such folder'
    """
    try:
        names = [one.name for one in path.parent.iterdir() if one.is_file()]
    except OSError:
        return f"; there is no folder {path.parent}"
    close = difflib.get_close_matches(path.name, names, n=1, cutoff=0.75)
    return f"; did you mean {close[0]!r}?" if close else ""
