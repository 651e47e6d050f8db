"""glTF 2.0, text and binary: parts where the scene's nodes put them.

Read here, with NumPy, because what an assembly needs is lost or wrong by way of trimesh 5.2:
sparse and normalised accessors come out as zeros or unscaled, triangle fans are left out, nodes of
several primitives get names that differ in every run, and colours need one more library. Morph
targets count with the weights that the file gives. Whatever would be guessed is refused by name
instead: compressed meshes, skins, instances on the GPU. Meshes that the scene does not show are
left out, and said to be.

References
----------
glTF 2.0 Specification, Khronos Group, sections 3.5 (scenes), 3.6 (buffers and accessors), 3.7.2
(meshes), 3.9 (materials) and 4 (GLB).
"""

import base64
import binascii
import math
import struct
import urllib.parse
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.bounded import parse_json
from hybridve.hull.cad.part import (
    Contents,
    Part,
    fan_triangles,
    join_meshes,
    move,
    single_rounding,
    strip_triangles,
)

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_NO_SURFACE = (0, 1, 2, 3)  # points and lines

#: Required extensions that leave the triangles what they are.
_HARMLESS = (
    "KHR_materials_",
    "KHR_texture_",
    "KHR_lights_",
    "KHR_mesh_quantization",
    "EXT_texture",
)


def parse_gltf(
    content: bytes, beside: Mapping[str, bytes], *, name_by_mesh: bool = False
) -> Contents:
    """Return the parts of a glTF or GLB file: one for each node that holds a mesh.

    Parameters
    ----------
    content : bytes
        The file.
    beside : mapping of str to bytes
        The buffers that it keeps elsewhere, as far as they are there; see `buffer_names`.
    name_by_mesh : bool
        Name a part after its mesh rather than after its node, if both have names.

    Raises
    ------
    ValueError
        If the file is damaged, or needs something that cannot be read.
    """
    try:
        document, binary = _split(content)
        _refuse_what_is_not_read(document)
        reader = _Reader(document, binary, beside)
        parts = [
            reader.part(node, matrix, name_by_mesh=name_by_mesh)
            for node, matrix in _placed_nodes(document)
        ]
        notes = _what_is_not_shown(document)
    except (KeyError, IndexError, TypeError, AttributeError, struct.error) as error:
        what = str(error)
        if isinstance(error, LookupError):
            missing = error if isinstance(error, KeyError) else "entry of the number that is named"
            what = f"no {missing} where one belongs"
        raise ValueError(f"not a sound glTF 2.0 file: {what}") from error
    filled = tuple(part for part in parts if len(part.faces))
    return Contents(filled, "m", 1.0, "y", notes=notes)


def buffer_names(content: bytes) -> list[str]:
    """Return the names of the files that a glTF or GLB file keeps its numbers in.

    Raises
    ------
    ValueError
        If the file is damaged.
    """
    document, _ = _split(content)
    try:
        names = [buffer["uri"] for buffer in document.get("buffers", []) if "uri" in buffer]
        return [urllib.parse.unquote(name) for name in names if not name.startswith("data:")]
    except (TypeError, AttributeError) as error:
        raise ValueError(f"not a sound glTF 2.0 file: {error}") from error


def _split(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the JSON document and the binary chunk of a file."""
    binary = b""
    if content[:4] == b"glTF":
        if len(content) < 20:
            raise ValueError("the file is cut off")
        _, container, length, json_length, json_kind = struct.unpack_from("<4sIII4s", content)
        if container != 2:
            raise ValueError(f"glTF version {container}; version 2 can be read")
        if length > len(content):
            raise ValueError(f"the file is cut off: {len(content)} of {length} bytes are there")
        if content[length:].strip(b"\0\r\n\t "):
            raise ValueError(f"{len(content)} bytes, where its header promises {length}")
        if json_kind != b"JSON":
            raise ValueError("the file does not begin with its JSON chunk")
        text = content[20 : 20 + json_length]
        start = 20 + json_length
        if len(content) >= start + 8:
            (binary_length,) = struct.unpack_from("<I", content, start)
            binary = content[start + 8 : start + 8 + binary_length]
    else:
        text = content
    try:
        document = parse_json(text)
    except ValueError as error:
        raise ValueError(f"its JSON cannot be read: {error}") from None
    asset = document.get("asset") if isinstance(document, dict) else None
    if not isinstance(asset, dict) or not str(asset.get("version")).startswith("2."):
        raise ValueError("it is not glTF of version 2")
    return document, binary


def _refuse_what_is_not_read(document: dict[str, Any]) -> None:
    required = document.get("extensionsRequired", [])
    foreign = [name for name in required if not name.startswith(_HARMLESS)]
    if "EXT_mesh_gpu_instancing" in document.get("extensionsUsed", []):
        foreign.append("EXT_mesh_gpu_instancing")
    if foreign:
        raise ValueError(f"it needs {foreign[0]}, which is not read here; export it without")
    if any("skin" in node for node in document.get("nodes", [])):
        raise ValueError("it holds a skinned mesh, which has no fixed shape; export it rigid")


def _placed_nodes(
    document: dict[str, Any],
) -> Iterator[tuple[dict[str, Any], NDArray[np.float64]]]:
    """Yield each node of the scene that has a mesh, and where it is: a matrix (4, 4)."""
    nodes = document.get("nodes", [])
    if "scenes" in document:
        roots = document["scenes"][document.get("scene", 0)].get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [number for number in range(len(nodes)) if number not in children]
    waiting = [(number, np.eye(4), 0) for number in reversed(roots)]
    while waiting:
        number, world_from_parent, depth = waiting.pop()
        if depth > len(nodes):
            raise ValueError("its nodes hold each other in a circle")
        node = nodes[number]
        world_from_node = world_from_parent @ _matrix(node)
        if "mesh" in node:
            yield node, world_from_node
        waiting.extend(
            (child, world_from_node, depth + 1) for child in reversed(node.get("children", []))
        )


def _what_is_not_shown(document: dict[str, Any]) -> tuple[str, ...]:
    """Return a sentence on nodes with meshes that the scene does not hold, if there are any."""
    nodes = document.get("nodes", [])
    shown = {id(node) for node, _ in _placed_nodes(document)}
    hidden = [
        str(node.get("name", number))
        for number, node in enumerate(nodes)
        if "mesh" in node and id(node) not in shown
    ]
    if not hidden:
        return ()
    return (f"{len(hidden)} nodes with meshes are not in its scene, first {hidden[0]!r}",)


def _matrix(node: dict[str, Any]) -> NDArray[np.float64]:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T  # column by column
    matrix = np.eye(4)
    if "rotation" in node:
        x, y, z, w = np.array(node["rotation"], np.float64) / np.linalg.norm(node["rotation"])
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    if "scale" in node:
        matrix[:3, :3] *= np.array(node["scale"], np.float64)
    if "translation" in node:
        matrix[:3, 3] = node["translation"]
    return matrix


class _Reader:
    """The numbers of one document."""

    def __init__(
        self, document: dict[str, Any], binary: bytes, beside: Mapping[str, bytes]
    ) -> None:
        self._document = document
        self._buffers = [
            _buffer(number, buffer, binary, beside)
            for number, buffer in enumerate(document.get("buffers", []))
        ]

    def part(
        self, node: dict[str, Any], matrix: NDArray[np.float64], *, name_by_mesh: bool
    ) -> Part:
        mesh = self._document["meshes"][node["mesh"]]
        pieces, made_of, roundings = [], [], [0.0]
        for primitive in mesh["primitives"]:
            mode = primitive.get("mode", _TRIANGLES)
            if mode in _NO_SURFACE:
                continue
            if mode not in (_TRIANGLES, _STRIP, _FAN):
                raise ValueError(f"a primitive of mode {mode!r}, which is none of glTF 2.0")
            vertices, rounding = self._positions(primitive["attributes"]["POSITION"])
            faces = self._faces(primitive, len(vertices))
            if len(faces) == 0:
                continue
            vertices = self._morph(
                vertices, primitive, node.get("weights", mesh.get("weights", []))
            )
            pieces.append(move(vertices, faces, matrix))
            made_of.append(primitive.get("material"))
            roundings.append(rounding * float(np.linalg.norm(matrix[:3, :3], 2)))
        names = [node.get("name"), mesh.get("name")]
        name = next((str(name) for name in names[:: -1 if name_by_mesh else 1] if name), "")
        vertices, faces = join_meshes(pieces)
        if len(set(made_of)) != 1 or made_of[0] is None:
            return Part(name, vertices, faces, rounding=max(roundings))
        material = self._document["materials"][made_of[0]]
        return Part(
            name,
            vertices,
            faces,
            str(material.get("name", "")),
            _colour(material),
            rounding=max(roundings),
        )

    def _positions(self, number: int) -> tuple[NDArray[np.float64], float]:
        """Return vertices (V, 3), and how far what they are written in may have moved them."""
        rows = self._accessor(number)
        accessor = self._document["accessors"][number]
        dtype = np.dtype(_COMPONENTS[accessor["componentType"]])
        rounding = single_rounding(rows)
        if dtype.kind in "iu":  # quantized: half a step in each direction
            step = 1.0 / np.iinfo(dtype).max if accessor.get("normalized") else 1.0
            rounding = math.sqrt(3.0) * step / 2.0
        return rows.astype(np.float64), rounding

    def _faces(self, primitive: dict[str, Any], n_vertices: int) -> NDArray[np.int32]:
        if "indices" in primitive:
            corners = self._accessor(primitive["indices"]).astype(np.int64).ravel()
        else:
            corners = np.arange(n_vertices)
        if len(corners) and corners.max() >= n_vertices:
            raise ValueError(f"a face names vertex {corners.max()} of {n_vertices}")
        mode = primitive.get("mode", _TRIANGLES)
        if mode == _STRIP:
            return strip_triangles(corners)
        if mode == _FAN:
            return fan_triangles(corners)
        if len(corners) % 3:
            raise ValueError(f"{len(corners)} corners do not make triangles")
        return corners.reshape(-1, 3).astype(np.int32)

    def _morph(
        self, vertices: NDArray[np.float64], primitive: dict[str, Any], weights: list[float]
    ) -> NDArray[np.float64]:
        """Return vertices moved to the shape that the weights of a node or mesh stand for."""
        targets = primitive.get("targets", [])
        if weights and len(weights) != len(targets):
            raise ValueError(f"{len(weights)} weights for {len(targets)} morph targets")
        for target, weight in zip(targets, weights, strict=False):
            if weight and "POSITION" in target:
                vertices = vertices + weight * self._accessor(target["POSITION"])
        return vertices

    def _accessor(self, number: int) -> NDArray[Any]:
        """Return the rows of an accessor."""
        accessor = self._document["accessors"][number]
        dtype, width = np.dtype(_COMPONENTS[accessor["componentType"]]), _WIDTHS[accessor["type"]]
        count = accessor["count"]
        if "bufferView" in accessor:
            start = accessor.get("byteOffset", 0)
            rows = self._rows(accessor["bufferView"], start, dtype, width, count)
        elif "sparse" in accessor:
            rows = np.zeros((count, width), dtype)
        else:
            raise ValueError(f"accessor {number} has no numbers: they are compressed, or left out")
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            at, values = sparse["indices"], sparse["values"]
            at_dtype = np.dtype(_COMPONENTS[at["componentType"]])
            places = self._rows(
                at["bufferView"], at.get("byteOffset", 0), at_dtype, 1, sparse["count"]
            )
            rows[places.ravel()] = self._rows(
                values["bufferView"], values.get("byteOffset", 0), dtype, width, sparse["count"]
            )
        if accessor.get("normalized") and dtype.kind in "iu":
            rows = np.maximum(rows / np.iinfo(dtype).max, -1.0)
        return rows

    def _rows(
        self, view_number: int, start: int, dtype: np.dtype[Any], width: int, count: int
    ) -> NDArray[Any]:
        """Return a private copy of rows (count, width) that lie in a buffer view."""
        view = self._document["bufferViews"][view_number]
        start += view.get("byteOffset", 0)
        row_length = dtype.itemsize * width
        stride = view.get("byteStride", row_length)
        content = self._buffers[view["buffer"]]
        end = start + (count - 1) * stride + row_length
        if count < 0 or start < 0 or stride < row_length or (count and end > len(content)):
            raise ValueError(f"buffer view {view_number} reaches beyond its buffer; is it cut off?")
        if count == 0:
            return np.zeros((0, width), dtype)
        raw = np.frombuffer(content, np.uint8, end - start, start)
        rows = np.lib.stride_tricks.as_strided(raw, (count, row_length), (stride, 1))
        return np.ascontiguousarray(rows).view(dtype).copy()


def _buffer(
    number: int, buffer: dict[str, Any], binary: bytes, beside: Mapping[str, bytes]
) -> bytes:
    uri = buffer.get("uri")
    if uri is None:
        # Only the first may be the file's own; a buffer without numbers waits for a decoder.
        content = binary if number == 0 else b""
    elif uri.startswith("data:"):
        try:
            content = base64.b64decode(uri.partition(",")[2], validate=True)
        except binascii.Error as error:
            raise ValueError(f"buffer {number} is not base64: {error}") from None
    else:
        name = urllib.parse.unquote(uri)
        if name not in beside:
            raise ValueError(f"it keeps its numbers in {name}, and there is no such file beside it")
        content = beside[name]
    if not content and buffer["byteLength"]:
        raise ValueError(f"buffer {number} has no numbers: they are compressed, or left out")
    if len(content) < buffer["byteLength"]:
        raise ValueError(
            f"buffer {number} is cut off: {len(content)} of {buffer['byteLength']} bytes are there"
        )
    return content


def _colour(material: dict[str, Any]) -> tuple[float, float, float, float] | None:
    """Return the base colour as pictures show it; the file holds it linear in light."""
    factor = material.get("pbrMetallicRoughness", {}).get("baseColorFactor")
    if factor is None:
        return None
    linear = np.clip(np.array(factor, np.float64), 0.0, 1.0)
    curved = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    shown = np.where(linear <= 0.0031308, 12.92 * linear, curved)
    red, green, blue = (round(float(value), 6) for value in shown[:3])
    return red, green, blue, float(linear[3])
