"""Files that appear under their names when they are complete, or not at all; and missing ones."""

import difflib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def appearing(path: Path, *, is_contended: bool = False) -> Iterator[Path]:
    """Yield a name beside `path` to write a file under, which becomes `path` if all goes well.

    Nothing is left of it otherwise.

    Parameters
    ----------
    path : Path
        The file; its folder exists.
    is_contended : bool
        Whether several programs may write the file at once: each then has a name of its own. Else
        it is ``NAME.partial``, so that what a killed program left is written over.
    """
    partial = path.with_name(path.name + ".partial")
    if is_contended:
        descriptor, name = tempfile.mkstemp(prefix=f"{path.name}.", dir=path.parent)
        os.close(descriptor)
        partial = Path(name)
    try:
        yield partial
        partial.replace(path)
    except BaseException:
        with suppress(OSError):  # there may be none, nor a folder to remove it from
            partial.unlink()
        raise


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
