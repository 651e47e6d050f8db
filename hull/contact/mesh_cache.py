"""Meshes that were read once: vertices and faces as they came from a file, kept for the next start.

Open3D takes longer to import than most CAD takes to read, and ``detect`` needs it for nothing
else. So what it read is kept, named after the content that it was read from; see
`hybridve.calib.cache` for where, and for how long.
"""

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.cache import cache_key, find_arrays, keep_arrays

_KIND = "meshes"

#: Part of every key: the layout of an entry, and how a mesh is taken from what its reader returns.
_VERSION = 1


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
    """
    return cache_key(_VERSION, reader, suffix, content)


def find_mesh(key: str) -> tuple[NDArray[np.float64], NDArray[np.int32]] | None:
    """Return the vertices (V, 3) and faces (T, 3) kept under a key, or None."""
    found = find_arrays(_KIND, key, ("vertices", "faces"))
    if found is None:
        return None
    vertices, faces = found
    for array, dtype in ((vertices, np.float64), (faces, np.int32)):
        if array.ndim != 2 or array.shape[1] != 3 or array.dtype != dtype:
            return None
    return vertices, faces


def keep_mesh(key: str, vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> None:
    """Keep vertices (V, 3) and faces (T, 3) under a key."""
    keep_arrays(_KIND, key, vertices=vertices, faces=faces)
