"""Meshes that were read once: vertices and faces as they came from a file, kept for the next start.

Open3D takes longer to import than most CAD takes to read, and ``detect`` needs it for nothing
else. So what it read is kept in the folder ``meshes`` of ``$XDG_CACHE_HOME/hybridve``, or of
``~/.cache/hybridve`` where that is not set: one NumPy archive a mesh, named after the content that
it was read from.

The environment variable ``HYBRIDVE_CACHE`` names another folder in place of
``$XDG_CACHE_HOME/hybridve``; empty or ``off``, nothing is kept and nothing is looked up.

The cache only saves time. An entry that is damaged is as good as none and is written anew; a
folder that cannot be written to is left alone. Entries appear whole or not at all, so that several
processes may use one folder, and those not used for longest go when there are more than `LIMIT_B`.
"""

import hashlib
import io
import logging
import os
import tempfile
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_log = logging.getLogger(__name__)

#: What the entries may take together, in bytes: some thirty meshes of a million triangles.
LIMIT_B = 1_000_000_000

#: Part of every key: the layout of an entry, and how a mesh is taken from what its reader returns.
_VERSION = 1

#: Names of entries, and of what an interrupted writer left: files called otherwise are not ours.
_OURS = "[0-9a-f]" * 64 + ".npz*"

_NAMES = ("vertices.npy", "faces.npy")


def cache_folder() -> Path | None:
    """Return the folder that keeps meshes, whether or not it exists yet; None for no cache."""
    chosen = os.environ.get("HYBRIDVE_CACHE")
    if chosen is not None:
        return None if chosen in ("", "off") else Path(chosen) / "meshes"
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not base.is_absolute():  # unset, or relative, which the XDG specification says to ignore
        try:
            base = Path.home() / ".cache"
        except RuntimeError:  # a user without a home
            return None
    return base / "hybridve" / "meshes"


def mesh_key(content: bytes, suffix: str, reader: str) -> str:
    """Return the name under which a mesh is kept.

    Parameters
    ----------
    content : bytes
        The file, whole.
    suffix : str
        What the reader takes the content for, such as ``.stl``.
    reader : str
        The library that reads it, and its version: another one may read it otherwise.

    Returns
    -------
    str
        64 hexadecimal digits: a SHA-256.
    """
    about = f"{_VERSION}\n{reader}\n{suffix}\n{hashlib.sha256(content).hexdigest()}"
    return hashlib.sha256(about.encode()).hexdigest()


def find_mesh(key: str) -> tuple[NDArray[np.float64], NDArray[np.int32]] | None:
    """Return the vertices (V, 3) and faces (T, 3) kept under a key, or None."""
    folder = cache_folder()
    if folder is None:
        return None
    path = folder / f"{key}.npz"
    try:
        # Members are read whole before they are parsed, because zipfile compares the checksum only
        # at the end: a damaged header that promises fewer numbers would get by.
        with zipfile.ZipFile(path) as archive:
            vertices, faces = (
                np.lib.format.read_array(io.BytesIO(archive.read(name)), allow_pickle=False)
                for name in _NAMES
            )
        if vertices.shape != (len(vertices), 3) or vertices.dtype != np.float64:
            raise ValueError(f"vertices are {vertices.shape} {vertices.dtype}")
        if faces.shape != (len(faces), 3) or faces.dtype != np.int32:
            raise ValueError(f"faces are {faces.shape} {faces.dtype}")
    except FileNotFoundError:
        return None
    except Exception as error:  # damage has many names, and reading the mesh itself mends them all
        _log.info("%s: not a mesh that can be used, read anew: %s", path, error)
        return None
    with suppress(OSError):  # a folder that may only be read serves as well
        os.utime(path)  # the time of last use
    return vertices, faces


def keep_mesh(key: str, vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> None:
    """Keep vertices (V, 3) and faces (T, 3) under a key, where there is a folder and room."""
    folder = cache_folder()
    if folder is None:
        return
    packed = io.BytesIO()
    np.savez(packed, vertices=vertices, faces=faces)
    if packed.tell() > LIMIT_B:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # The new name differs for each writer: two processes may read the same mesh.
        descriptor, partial = tempfile.mkstemp(prefix=f"{key}.npz.", dir=folder)
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(packed.getbuffer())
            Path(partial).replace(folder / f"{key}.npz")
        except BaseException:
            Path(partial).unlink(missing_ok=True)
            raise
        _drop_oldest(folder)
    except OSError as error:
        _log.info("%s: the mesh is not kept for the next start: %s", folder, error)


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
