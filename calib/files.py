"""Files that appear under their names when they are complete, or not at all."""

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
