"""CAD files that were read once: their parts as they came, kept for the next start.

The libraries that read CAD take longer to import than most CAD takes to read, and ``detect`` needs
them for nothing else; and a STEP file takes seconds to become triangles. So what was read is kept,
named after the content that it was read from; see `hybridve.calib.cache` for where, and for how
long.
"""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.cache import cache_key, find_arrays, keep_arrays

_KIND = "meshes"

#: Part of every key: the layout of an entry, what this package makes of a file by itself (it reads
#: all kinds but STEP), and what it says of a mesh. Raised with any change of these.
_VERSION = 5

_Mesh = tuple[NDArray[np.float64], NDArray[np.int32]]


def mesh_key(content: bytes, kind: str, reader: str, how: str = "", *beside: bytes) -> str:
    """Return the name under which a file's parts are kept.

    Parameters
    ----------
    content : bytes
        The file, whole.
    kind : str
        What the reader takes the content for, such as ``STL``.
    reader : str
        The library that reads it, and its version: another one may read it otherwise.
    how : str
        What else was asked for, such as a tolerance.
    *beside : bytes
        The content of each file that it leans on, in the order that it names them.
    """
    return cache_key(_VERSION, reader, kind, how, content, *beside)


def find_meshes(key: str) -> tuple[list[_Mesh], dict[str, Any]] | None:
    """Return the meshes kept under a key, and what was said of them, or None."""
    found = find_arrays(_KIND, key, ("vertices", "faces", "counts", "about"))
    if found is None:
        return None
    vertices, faces, counts, about = found
    shapes = ((vertices, 3, np.float64), (faces, 3, np.int32), (counts, 2, np.int64))
    for array, width, dtype in shapes:
        if array.ndim != 2 or array.shape[1] != width or array.dtype != dtype:
            return None
    if about.dtype != np.uint8 or counts.sum(axis=0).tolist() != [len(vertices), len(faces)]:
        return None
    vertex_ends, face_ends = np.cumsum(counts, axis=0).T
    meshes = [
        (vertices[v_end - n_vertices : v_end], faces[f_end - n_faces : f_end])
        for (n_vertices, n_faces), v_end, f_end in zip(
            counts.tolist(), vertex_ends.tolist(), face_ends.tolist(), strict=True
        )
    ]
    try:
        return meshes, json.loads(about.tobytes())
    except ValueError:
        return None


def keep_meshes(key: str, meshes: Sequence[_Mesh], about: dict[str, Any]) -> None:
    """Keep meshes, each vertices (V, 3) and faces (T, 3), and plain JSON values under a key."""
    keep_arrays(
        _KIND,
        key,
        vertices=np.concatenate([vertices for vertices, _ in meshes]),
        faces=np.concatenate([faces for _, faces in meshes]),
        counts=np.array([[len(vertices), len(faces)] for vertices, faces in meshes], np.int64),
        about=np.frombuffer(json.dumps(about).encode(), np.uint8),
    )
