"""The nodes of an FBX file, binary or text: names, values and nodes inside them.

Binary files are read to the last node of their outermost level, which ends with an empty one; text
until all braces are closed. Both say how long their arrays are. So a file that was cut off before
its end is known to be.

References
----------
Blender Foundation, FBX binary file format specification, 2013: records and arrays of versions up to
7.4; from 7.5 on, the three lengths of a record have 64 bits.
"""

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.text import decode

_MAGIC = b"Kaydara FBX Binary  \x00"
_HEAD = len(_MAGIC) + 6  # two bytes without meaning, and the version

_SCALARS = {"Y": "<h", "C": "<B", "I": "<i", "F": "<f", "D": "<d", "L": "<q"}
_ARRAYS = {"f": "<f4", "d": "<f8", "l": "<i8", "i": "<i4", "b": "<u1"}

#: More levels of nodes than any program writes.
_DEEPEST = 64

_TOKENS = re.compile(r'"[^"]*"|;[^\r\n]*|[{}:,]|[^\s{}:,;"]+|"')


@dataclass(slots=True)
class Node:
    """One node.

    Attributes
    ----------
    name : str
        What it is.
    values : list
        Numbers, texts, raw bytes and arrays, as they stand behind its name.
    children : list of Node
        The nodes inside.
    """

    name: str
    values: list[Any] = field(default_factory=list)
    children: list["Node"] = field(default_factory=list)

    def all(self, name: str) -> Iterator["Node"]:
        """Yield the nodes inside that have a name."""
        return (child for child in self.children if child.name == name)

    def first(self, name: str) -> "Node | None":
        """Return the first node inside that has a name, or None."""
        return next(self.all(name), None)

    def numbers(self, dtype: type[np.float64] | type[np.int64]) -> NDArray[Any]:
        """Return the array that it holds.

        Raises
        ------
        ValueError
            If it holds something else, or fewer numbers than it promises.
        """
        values = self.values
        if len(values) == 1 and isinstance(values[0], np.ndarray):
            return values[0].astype(dtype)
        inner = self.first("a")
        promised = None
        if values and isinstance(values[0], str) and values[0].startswith("*"):
            promised, values = values[0][1:], inner.values if inner is not None else []
        found = np.array([_number(value, self.name) for value in values], np.float64)
        if promised is not None and promised != str(len(found)):
            raise ValueError(f"its {self.name} holds {len(found)} of {promised} numbers")
        if dtype is np.int64 and not (np.isfinite(found) & (found == np.floor(found))).all():
            raise ValueError(f"its {self.name} holds numbers that are not whole")
        return found.astype(dtype)


def _number(value: object, name: str) -> float:
    if isinstance(value, (int, float)):
        return float(value)
    raise ValueError(f"its {name} holds {value!r} where a number belongs")


def parse_nodes(content: bytes) -> tuple[Node, int]:
    """Return a node that holds the outermost ones of a file, and the version that it says it has.

    Raises
    ------
    ValueError
        If the file is damaged or cut off.
    """
    if content.startswith(_MAGIC):
        if len(content) < _HEAD:
            raise ValueError("the file is cut off")
        (version,) = struct.unpack_from("<I", content, _HEAD - 4)
        try:
            children, _ = _binary_nodes(content, _HEAD, len(content), version, 0)
        except (struct.error, zlib.error) as error:
            raise ValueError(f"the file is damaged or cut off: {error}") from error
        return Node("", children=children), version
    root = _text_nodes(decode(content))
    header = root.first("FBXHeaderExtension")
    stated = header.first("FBXVersion") if header is not None else None
    if stated is None or not stated.values or not isinstance(stated.values[0], int):
        raise ValueError("it does not say its FBXVersion; it is no FBX file")
    return root, stated.values[0]


def _binary_nodes(
    content: bytes, place: int, end: int, version: int, depth: int
) -> tuple[list[Node], int]:
    """Return the nodes from a place on up to the empty one, and the place behind that."""
    if depth > _DEEPEST:
        raise ValueError("its nodes are too deep")
    lengths = struct.Struct("<QQQB" if version >= 7500 else "<IIIB")
    nodes: list[Node] = []
    while True:
        if place + lengths.size > end:
            raise ValueError("the file is cut off: its nodes do not end")
        node_end, n_values, values_length, name_length = lengths.unpack_from(content, place)
        start = place + lengths.size
        if node_end == 0:
            return nodes, start
        values_start = start + name_length
        if node_end > end or node_end < values_start + values_length:
            raise ValueError(
                f"the file is cut off: {len(content)} bytes, a node ends at {node_end}"
            )
        node = Node(content[start:values_start].decode("utf-8", errors="replace"))
        node.values = _binary_values(content, values_start, values_start + values_length, n_values)
        place = values_start + values_length
        if place < node_end:
            node.children, place = _binary_nodes(content, place, node_end, version, depth + 1)
        if place != node_end:
            raise ValueError(f"its node {node.name!r} ends at {place}, not at {node_end}")
        nodes.append(node)


def _binary_values(content: bytes, place: int, end: int, count: int) -> list[Any]:
    values: list[Any] = []
    for _ in range(count):
        kind = chr(content[place]) if place < end else ""
        place += 1
        if kind in _SCALARS:
            values.extend(struct.unpack_from(_SCALARS[kind], content, place))
            place += struct.calcsize(_SCALARS[kind])
        elif kind in _ARRAYS:
            length, is_packed, stored = struct.unpack_from("<III", content, place)
            place += 12
            dtype = np.dtype(_ARRAYS[kind])
            raw = content[place : min(place + stored, end)]
            expected = length * dtype.itemsize
            if is_packed:
                raw = zlib.decompressobj().decompress(raw, expected + 1)
            if len(raw) != expected:
                raise ValueError(f"an array of {len(raw)} bytes, where {expected} are promised")
            values.append(np.frombuffer(raw, dtype))
            place += stored
        elif kind in ("S", "R"):
            (length,) = struct.unpack_from("<I", content, place)
            place += 4
            raw = content[place : place + length]
            values.append(raw.decode("utf-8", errors="replace") if kind == "S" else raw)
            place += length
        else:
            raise ValueError(f"a value of the unknown kind {kind!r}; the file is damaged")
    if place != end:
        raise ValueError("the values of a node are longer than it says; the file is damaged")
    return values


def _text_nodes(text: str) -> Node:
    """Return a node that holds the outermost ones of a text."""
    tokens = [token for token in _TOKENS.findall(text) if token[0] != ";"]
    root = Node("")
    open_nodes = [root]
    current: Node | None = None
    for token, following in zip(tokens, [*tokens[1:], ""], strict=True):
        if token == '"':
            raise ValueError("the file is cut off in a text in quotes")
        if following == ":" and token[0] not in '{}:,"':
            current = Node(token)
            open_nodes[-1].children.append(current)
        elif token == "{":
            if current is None or len(open_nodes) > _DEEPEST:
                raise ValueError("a brace opens where no node begins; the file is damaged")
            open_nodes.append(current)
            current = None
        elif token == "}":
            if len(open_nodes) == 1:
                raise ValueError("a brace closes that was not opened; the file is damaged")
            open_nodes.pop()
            current = None
        elif token not in (":", ","):
            if current is None:
                raise ValueError(f"found {token!r} where a node belongs; the file is damaged")
            current.values.append(_text_value(token))
    if len(open_nodes) > 1:
        raise ValueError(f"the file is cut off: it ends inside {open_nodes[-1].name!r}")
    return root


def _text_value(token: str) -> int | float | str:
    if token[0] == '"':
        return token[1:-1]
    for kind in (int, float):
        try:
            return kind(token)
        except ValueError:
            continue
    return token
