"""What was computed once, kept on disk for the next start.

It lies in ``$XDG_CACHE_HOME/hybridve``, or in ``~/.cache/hybridve`` where that is not set, in a
folder for each kind: ``meshes``, ``lenses``, ``compiled``. The environment variable
``HYBRIDVE_CACHE`` names another place for all of them; empty or ``off``, nothing is kept and
nothing is looked up.

The cache only saves time: whatever comes from it is, to the bit, what would be computed without
it. An entry is named after everything that it depends on; one that is damaged is as good as none
and is written anew; a folder that cannot be written to is left alone. Entries appear whole or not
at all, so that several processes may use one folder, and of each kind those not used for longest
go when there are more than `LIMIT_B`.
"""

import hashlib
import io
import logging
import os
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.files import appearing

_log = logging.getLogger(__name__)

#: What the entries of one kind may take together, in bytes: some thirty meshes of a million
#: triangles.
LIMIT_B = 1_000_000_000

#: Names of entries, and of what an interrupted writer left: files called otherwise are not ours.
_OURS = "[0-9a-f]" * 64 + ".npz*"


def cache_folder(kind: str) -> Path | None:
    """Return the folder that keeps one kind, whether or not it exists yet; None for no cache."""
    chosen = os.environ.get("HYBRIDVE_CACHE")
    if chosen is not None:
        return None if chosen in ("", "off") else Path(chosen) / kind
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not base.is_absolute():  # unset, or relative, which the XDG specification says to ignore
        try:
            base = Path.home() / ".cache"
        except RuntimeError:  # a user without a home
            return None
    return base / "hybridve" / kind


def cache_key(*parts: str | bytes | float) -> str:
    """Return the name of what depends on `parts`, and on nothing else.

    Returns
    -------
    str
        64 hexadecimal digits: a SHA-256. Other parts, or the same in another order or cut
        otherwise, have another name.
    """
    digest = hashlib.sha256()
    for part in parts:
        content = part if isinstance(part, bytes) else repr(part).encode()
        digest.update(f"{type(part).__name__} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()


def find_arrays(kind: str, key: str, names: tuple[str, ...]) -> list[NDArray[Any]] | None:
    """Return the arrays of these names that are kept under a key, or None."""
    folder = cache_folder(kind)
    if folder is None:
        return None
    path = folder / f"{key}.npz"
    try:
        # Members are read whole before they are parsed, because zipfile compares the checksum only
        # at the end: a damaged header that promises fewer numbers would get by.
        with zipfile.ZipFile(path) as archive:
            arrays = [
                np.lib.format.read_array(
                    io.BytesIO(archive.read(f"{name}.npy")), allow_pickle=False
                )
                for name in names
            ]
    except FileNotFoundError:
        return None
    except Exception as error:  # damage has many names, and computing it anew mends them all
        _log.info("%s: cannot be used, computed anew: %s", path, error)
        return None
    with suppress(OSError):  # a folder that may only be read serves as well
        os.utime(path)  # the time of last use
    return arrays


def keep_arrays(kind: str, key: str, **arrays: NDArray[Any]) -> None:
    """Keep arrays under a key and their names, where there is a folder and room."""
    folder = cache_folder(kind)
    if folder is None:
        return
    packed = io.BytesIO()
    np.savez(packed, allow_pickle=False, **arrays)
    if packed.tell() > LIMIT_B:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Two processes may compute the same.
        with appearing(folder / f"{key}.npz", is_contended=True) as partial:
            partial.write_bytes(packed.getbuffer())
        _drop_oldest(folder)
    except OSError as error:
        _log.info("%s: nothing is kept for the next start: %s", folder, error)


def _drop_oldest(folder: Path) -> None:
    """Remove entries, the one used least lately first, until the rest fit into `LIMIT_B`."""
    entries = []
    for path in folder.glob(_OURS):
        with suppress(FileNotFoundError):  # another process was faster
            found = path.stat()
            entries.append((found.st_mtime_ns, found.st_size, path))
    total_b = sum(size_b for _, size_b, _ in entries)
    for _, size_b, path in sorted(entries):
        if total_b <= LIMIT_B:
            return
        path.unlink(missing_ok=True)
        total_b -= size_b
