"""PLY files, text and binary of either byte order: polygons and strips in order, as one part.

All that the header promises must be there, and nothing after it. Lists may have any types and
lengths. Faces are the lists ``vertex_indices`` (or ``vertex_index``) of the elements ``face`` and
``tristrips``; in a strip, -1 begins another. Elements that name vertices for something else than
lines, such as a range grid, make a surface that is not read here, and are refused by name.

References
----------
Turk, The PLY Polygon File Format, 1994.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.part import Contents, Part, single_rounding, strip_triangles
from hybridve.hull.cad.polygons import Cuts, PolygonError, cut_polygons
from hybridve.hull.cad.text import number

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2"},
    **{"uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_INDICES = ("vertex_indices", "vertex_index")
_FACE, _STRIPS = "face", "tristrips"

#: Elements that name vertices and have no surface.
_LINES = ("edge", "line", "polyline", "segment")


@dataclass(frozen=True, slots=True)
class _Property:
    name: str
    kind: str
    counted_by: str = ""  # the type of a list's length; empty for a single value


@dataclass(frozen=True, slots=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]


#: The values of an element: of a property (count,), of a list a pair of values and lengths.
_Values = Mapping[str, tuple[NDArray[Any], NDArray[np.int64]] | NDArray[Any]]


def parse_ply(content: bytes) -> Contents:
    """Return the part in a PLY file.

    Raises
    ------
    ValueError
        If the file is damaged or cut off, or holds a surface that is not read.
    """
    order, elements, start = _parse_header(content)
    for element in elements:
        indices = [entry.name for entry in element.properties if entry.name in _INDICES]
        known = element.name in (_FACE, _STRIPS, *_LINES)
        if element.count and element.name in (_FACE, _STRIPS) and not indices:
            names = ", ".join(entry.name for entry in element.properties) or "nothing"
            raise ValueError(f"its {element.name} have {names}, expected {_INDICES[0]}; rename it")
        if element.count and indices and not known:
            raise ValueError(
                f"its element {element.name!r} makes a surface of vertices in a way that is not "
                "read here; export faces"
            )
    is_text = not order
    read = _read_text if is_text else _read_binary
    values = read(content[start:], elements, order)
    vertices, faces, rounding, cuts = _surface(elements, values)
    is_ended = not is_text or content.endswith((b"\n", b"\r"))
    return Contents(
        (Part("", vertices, faces, cuts=cuts, rounding=rounding),) if len(faces) else (),
        is_ended=is_ended,
    )


def _parse_header(content: bytes) -> tuple[str, list[_Element], int]:
    """Return the byte order ("" for text), the elements, and where their values begin."""
    match = re.match(rb"(?:\xef\xbb\xbf)?ply[ \t]*(\r\n|\r|\n)", content)
    if match is None:
        raise ValueError("it does not begin with the line 'ply'; export it again")
    eol = match[1]
    end = re.search(rb"(?:\r\n|\r|\n)end_header[ \t]*" + eol, content)
    if end is None:
        raise ValueError("its header has no end_header; the file is cut off, export it again")
    order: str | None = None
    elements: list[_Element] = []
    header = content[match.end() : end.start()].decode("utf-8", errors="replace")
    for line, raw in enumerate(header.split(eol.decode()), start=2):
        words = raw.split()
        try:
            if not words or words[0] in ("comment", "obj_info"):
                continue
            if words[0] == "format" and len(words) >= 2 and words[1] in _ORDERS:
                order = _ORDERS[words[1]]
            elif words[0] == "element":
                name, count = words[1], int(words[2])
                if count < 0 or name in (element.name for element in elements):
                    raise ValueError
                elements.append(_Element(name, count, ()))
            elif words[0] == "property":
                entry = (
                    _Property(words[4], _TYPES[words[3]], _TYPES[words[2]])
                    if words[1] == "list"
                    else _Property(words[2], _TYPES[words[1]])
                )
                last = elements.pop()
                elements.append(_Element(last.name, last.count, (*last.properties, entry)))
            else:
                raise ValueError
        except (ValueError, KeyError, IndexError):
            raise ValueError(f"line {line}: {raw!r} is no PLY header; export it again") from None
    if order is None:
        raise ValueError("its header names no format; export it again")
    return order, elements, end.end()


def _cut_off(element: _Element, row: int) -> ValueError:
    return ValueError(
        f"the file is cut off: {row} of {element.count} rows of its element {element.name!r} are "
        "there; export it again"
    )


def _read_text(body: bytes, elements: list[_Element], _: str) -> dict[str, _Values]:
    words = body.decode("utf-8", errors="replace").split()
    place = 0
    result: dict[str, _Values] = {}
    for element in elements:
        width = len(element.properties)
        if not any(entry.counted_by for entry in element.properties):
            end = place + width * element.count
            if end > len(words):
                raise _cut_off(element, (len(words) - place) // max(width, 1))
            rows = np.array([number(word) for word in words[place:end]]).reshape(-1, width)
            place = end
            result[element.name] = {
                entry.name: rows[:, column] for column, entry in enumerate(element.properties)
            }
            continue
        columns: list[tuple[list[float], list[int]]] = [([], []) for _ in element.properties]
        for row in range(element.count):
            for entry, (found, lengths) in zip(element.properties, columns, strict=True):
                length = 1
                if entry.counted_by:
                    if place >= len(words):
                        raise _cut_off(element, row)
                    length = int(_whole(number(words[place]), element, row))
                    place += 1
                if length < 0 or place + length > len(words):
                    raise _cut_off(element, row)
                found += [number(word) for word in words[place : place + length]]
                lengths.append(length)
                place += length
        result[element.name] = _by_name(element, columns)
    if place < len(words):
        raise ValueError(
            f"{len(words) - place} words follow the rows that its header promises; export it again"
        )
    return result


def _by_name(element: _Element, columns: list[tuple[list[float], list[int]]]) -> _Values:
    return {
        entry.name: (np.array(found, np.float64), np.array(lengths, np.int64))
        if entry.counted_by
        else np.array(found, np.float64)
        for entry, (found, lengths) in zip(element.properties, columns, strict=True)
    }


def _read_binary(body: bytes, elements: list[_Element], order: str) -> dict[str, _Values]:
    place = 0
    result: dict[str, _Values] = {}
    for element in elements:
        result[element.name], place = _read_rows(body, place, element, order)
    if body[place:].strip(b"\0\r\n\t "):
        raise ValueError(
            f"{len(body) - place} bytes follow the rows that its header promises; export it again"
        )
    return result


def _read_rows(body: bytes, place: int, element: _Element, order: str) -> tuple[_Values, int]:
    """Return the values of an element, and where the next begins.

    Rows whose lists are as long as those of the row before are read at once.
    """
    columns: list[tuple[list[NDArray[Any]], list[int]]] = [([], []) for _ in element.properties]
    row = 0
    while row < element.count:
        lengths = _lengths_at(body, place, element, order)
        if lengths is None:
            raise _cut_off(element, row)
        fields: list[tuple[Any, ...]] = []
        for number_, (entry, length) in enumerate(zip(element.properties, lengths, strict=True)):
            if entry.counted_by:
                fields.append((f"n{number_}", order + entry.counted_by))
            fields.append((f"v{number_}", order + entry.kind, (length,)))
        kind = np.dtype(fields)
        most = min(
            element.count - row, (len(body) - place) // kind.itemsize if kind.itemsize else 0
        )
        if kind.itemsize == 0:
            break  # an element without properties
        if most == 0:
            raise _cut_off(element, row)
        taken = min(most, 64)
        rows = np.frombuffer(body, kind, taken, place)
        alike = _n_alike(rows, element, lengths)
        if alike == taken and most > taken:
            rows = np.frombuffer(body, kind, most, place)
            alike = _n_alike(rows, element, lengths)
        for number_, (found, counts) in enumerate(columns):
            found.append(rows[f"v{number_}"][:alike].ravel())
            counts += [lengths[number_]] * alike
        row += alike
        place += alike * kind.itemsize
    values: dict[str, tuple[NDArray[Any], NDArray[np.int64]] | NDArray[Any]] = {}
    for entry, (found, counts) in zip(element.properties, columns, strict=True):
        flat = np.concatenate([np.zeros(0, entry.kind), *found])
        values[entry.name] = (flat, np.array(counts, np.int64)) if entry.counted_by else flat
    return values, place


def _lengths_at(body: bytes, place: int, element: _Element, order: str) -> list[int] | None:
    """Return how many values each property of the row at a place has; None if it is cut off."""
    lengths = []
    for entry in element.properties:
        length = 1
        if entry.counted_by:
            kind = np.dtype(order + entry.counted_by)
            if place + kind.itemsize > len(body):
                return None
            length = int(np.frombuffer(body, kind, 1, place)[0])
            place += kind.itemsize
        lengths.append(length)
        place += length * np.dtype(entry.kind).itemsize
        if length < 0 or place > len(body):
            return None
    return lengths


def _n_alike(rows: NDArray[Any], element: _Element, lengths: list[int]) -> int:
    """Return how many rows from the first on have lists of the lengths that they were read with."""
    same = np.ones(len(rows), np.bool_)
    for column, (entry, length) in enumerate(zip(element.properties, lengths, strict=True)):
        if entry.counted_by:
            same &= rows[f"n{column}"] == length
    return len(rows) if same.all() else int(np.argmin(same))


def _whole(value: float, element: _Element, row: int) -> float:
    if value != np.floor(value):
        raise ValueError(f"row {row} of its element {element.name!r} has {value}, no whole number")
    return value


def _surface(
    elements: list[_Element], values: dict[str, _Values]
) -> tuple[NDArray[np.float64], NDArray[np.int32], float, Cuts]:
    """Return the vertices (V, 3), the triangles (T, 3) of all faces and strips, the rounding."""
    found = values.get("vertex", {})
    axes = [axis for name in "xyz" if isinstance(axis := found.get(name), np.ndarray)]
    if len(axes) < 3:
        raise ValueError("its vertices have no x, y and z; export it again")
    rounding = float(np.linalg.norm([single_rounding(axis[:, None]) for axis in axes]))
    vertices = np.stack([axis.astype(np.float64) for axis in axes], axis=1)
    pieces, cuts = [], Cuts()
    for element in elements:
        if element.name not in (_FACE, _STRIPS) or not element.count:
            continue
        indices = next(
            values[element.name][name] for name in _INDICES if name in values[element.name]
        )
        if not isinstance(indices, tuple):
            raise ValueError(f"the vertices of its element {element.name!r} are no list")
        corners, counts = indices
        if not (np.isfinite(corners) & (corners == np.floor(corners))).all():
            raise ValueError(f"its element {element.name!r} names vertices by no whole numbers")
        corners = corners.astype(np.int64)
        if element.name == _STRIPS:
            pieces.append(_strips(corners, counts, len(vertices)))
            continue
        try:
            faces, found_cuts = cut_polygons(vertices, corners, counts)
        except PolygonError as error:
            raise ValueError(f"face {error.number + 1} of {element.count}: {error}") from None
        pieces.append(faces)
        cuts += found_cuts
    return vertices, np.concatenate([np.zeros((0, 3), np.int32), *pieces]), rounding, cuts


def _strips(
    corners: NDArray[np.int64], counts: NDArray[np.int64], n_vertices: int
) -> NDArray[np.int32]:
    if len(corners) and (corners.min() < -1 or corners.max() >= n_vertices):
        raise ValueError(f"a strip names a vertex that is not there, of {n_vertices} from 0")
    pieces = [np.zeros((0, 3), np.int32)]
    for strip in np.split(corners, np.cumsum(counts)[:-1]):
        ends = [-1, *np.flatnonzero(strip == -1).tolist(), len(strip)]
        for before, end in pairwise(ends):
            piece = strip[before + 1 : end]
            if 0 < len(piece) < 3:
                raise ValueError(f"a strip of {len(piece)} corners; export it again")
            pieces.append(strip_triangles(piece))
    return np.concatenate(pieces)
