"""OFF files as text: polygons in the order of the file, as one part.

Colours, normals and texture coordinates behind a vertex (COFF, NOFF, STOFF) and colours behind a
face have no bearing on the surface. Vertices in another space than three dimensions (4OFF, nOFF)
and the binary kind are refused by name.

References
----------
Geomview manual, "OFF Files".
"""

import re
from collections.abc import Iterator

import numpy as np

from hybridve.hull.cad.part import Contents, Part
from hybridve.hull.cad.polygons import PolygonError, cut_polygons
from hybridve.hull.cad.text import decode, is_ended, number, split_lines, whole

_HEAD = re.compile(r"(ST)?C?N?(4?)(n?)OFF")


def parse_off(content: bytes) -> Contents:
    """Return the part in an OFF file.

    Raises
    ------
    ValueError
        If the file is damaged or cut off, or of a kind that is not read.
    """
    text = decode(content.partition(b"BINARY")[0] or content)
    lines = _filled_lines(text)
    line, words = next(lines, (1, [""]))
    head = _HEAD.fullmatch(words[0])
    if head is not None:
        if head[2] or head[3]:
            raise ValueError(f"line {line}: {words[0]}: its vertices have no three coordinates")
        words = words[1:]
        if words[:1] == ["BINARY"] or b"BINARY" in content[:32]:
            raise ValueError("a binary OFF, which is not read here; save it as text")
        if not words:
            line, words = next(lines, (line, []))
    elif not words[0].isdigit():
        raise ValueError(f"line {line}: it begins with {words[0]!r}, not with OFF; export it again")
    try:
        if len(words) < 2:
            raise ValueError("no count of vertices and faces; export it again")
        n_vertices, n_faces = whole(words[0]), whole(words[1])
    except ValueError as error:
        raise ValueError(f"line {line}: {error}") from None
    vertices: list[list[float]] = []
    corners: list[int] = []
    counts: list[int] = []
    lines_of: list[int] = []
    for line, words in lines:
        try:
            if len(vertices) < n_vertices:
                if len(words) < 3:
                    raise ValueError(f"a vertex of {len(words)} numbers, expected 3")
                vertices.append([number(word) for word in words[:3]])
            elif len(counts) < n_faces:
                count = whole(words[0])
                named = [whole(word) for word in words[1 : 1 + max(count, 0)]]
                if len(named) < count:
                    raise ValueError(f"a face of {len(named)} corners, where {count} are promised")
                if any(not 0 <= corner < n_vertices for corner in named):
                    raise ValueError(
                        f"a face names one of {named}, of {n_vertices} vertices from 0"
                    )
                corners += named
                counts.append(count)
                lines_of.append(line)
            else:
                raise ValueError(
                    f"more than the {n_vertices} vertices and {n_faces} faces promised"
                )
        except ValueError as error:
            raise ValueError(f"line {line}: {error}") from None
    there, expected = len(vertices) + len(counts), n_vertices + n_faces
    if there < expected:
        raise ValueError(f"the file is cut off: {there} of {expected} lines are there")
    points = np.array(vertices, np.float64).reshape(-1, 3)
    try:
        faces, cuts = cut_polygons(points, np.array(corners, np.int64), np.array(counts, np.int64))
    except PolygonError as error:
        raise ValueError(f"line {lines_of[error.number]}: {error}") from None
    parts = (Part("", points, faces, cuts=cuts),) if len(faces) else ()
    return Contents(parts, is_ended=is_ended(text))


def _filled_lines(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the lines that are not empty but for a comment: their numbers and words."""
    for line, raw in enumerate(split_lines(text), start=1):
        words = raw.partition("#")[0].split()
        if words:
            yield line, words
