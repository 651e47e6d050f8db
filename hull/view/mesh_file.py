"""Triangles as files that others read: binary PLY, and GLB (glTF 2.0)."""

import json
import struct
from pathlib import Path

import numpy as np

from hybridve.calib.errors import ReportError
from hybridve.calib.files import write_whole
from hybridve.hull.places import MARK
from hybridve.hull.view.surface import Surface

#: What a surface may be written as.
MESH_SUFFIXES = (".ply", ".glb")

#: From z up, as worlds are here, to y up, as glTF has it.
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])

# Numbers of the standard: kinds of chunks, of buffers, of components.
_GLTF, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_VERTICES, _INDICES, _FLOAT, _UINT32 = 34962, 34963, 5126, 5125


def write_mesh(path: Path, surface: Surface) -> None:
    """Write a surface by its suffix, in metres; it appears only when it is complete.

    A PLY holds places of the world in double precision; a GLB holds them in single precision about
    a point that its node is moved to, and turned so that y is up.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    content = _ply(surface) if path.suffix.lower() == ".ply" else _glb(surface)
    try:
        write_whole(path, content)
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error.strerror}") from error


def _ply(surface: Surface) -> bytes:
    head = (
        "ply\nformat binary_little_endian 1.0\ncomment metres, z up\n"
        f"comment {MARK}\n"
        f"element vertex {len(surface.vertices_world)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(surface.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.zeros(len(surface.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, surface.faces
    return head.encode() + surface.vertices_world.astype("<f8").tobytes() + faces.tobytes()


def _glb(surface: Surface) -> bytes:
    if not len(surface.faces):
        return _chunks({"asset": _ASSET, "scene": 0, "scenes": [{"nodes": []}]}, b"")
    vertices = surface.vertices_world @ _Y_UP.T
    origin = np.round(vertices.mean(axis=0), 3)
    places = (vertices - origin).astype("<f4")
    indices = surface.faces.astype("<u4")
    data = places.tobytes() + indices.tobytes()
    views = [
        {"buffer": 0, "byteLength": places.nbytes, "target": _VERTICES},
        {
            "buffer": 0,
            "byteOffset": places.nbytes,
            "byteLength": indices.nbytes,
            "target": _INDICES,
        },
    ]
    told = {
        "asset": _ASSET,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "hull", "mesh": 0, "translation": origin.tolist()}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": views,
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": len(places),
                "type": "VEC3",
                "min": places.min(axis=0).tolist(),
                "max": places.max(axis=0).tolist(),
            },
            {
                "bufferView": 1,
                "componentType": _UINT32,
                "count": int(indices.size),
                "type": "SCALAR",
            },
        ],
    }
    return _chunks(told, data)


_ASSET = {"version": "2.0", "generator": MARK}


def _chunks(told: dict[str, object], data: bytes) -> bytes:
    """Return a GLB: its JSON, and the bytes that this is about, each to whole words."""
    text = json.dumps(told, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), _JSON) + text
    if data:
        data += b"\0" * (-len(data) % 4)
        chunks += struct.pack("<II", len(data), _BIN) + data
    return struct.pack("<III", _GLTF, 2, 12 + len(chunks)) + chunks
