"""STL files, binary and text: triangles in the order of the file, as one part.

A binary file is as long as its count of triangles says, each with as many bytes of payload behind
it as it says itself. Where the count is 0 or none, as programs leave it that write as they go, it
is told by the length. What stands behind the last triangle and is no triangle is told, and not
read; a file that is too short, or has more triangles than its count, is refused. A text ends with
``endsolid`` or is cut off. Several solids are one part. Loops of more than three vertices, which
the format forbids and exporters write, are cut into triangles.
"""

import re
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.part import Contents, Part, single_rounding
from hybridve.hull.cad.polygons import PolygonError, cut_polygons
from hybridve.hull.cad.text import decode, number, split_lines

_HEAD, _RECORD = 84, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])

#: What 21 words of a text are that holds triangles and nothing else; None is a number.
_FACET = (
    *("facet", "normal", None, None, None, "outer", "loop"),
    *(("vertex", None, None, None) * 3),
    *("endloop", "endfacet"),
)
#: A count of triangles that is none.
_UNKNOWN = 0xFFFFFFFF

_VERTEX_LINES = re.compile(r"^[ \t]*(?:vertex|facet)\b[^\r\n]*", re.IGNORECASE | re.MULTILINE)
_SOLID_LINES = re.compile(r"^[ \t]*(?:end)?solid\b[^\r\n]*", re.IGNORECASE | re.MULTILINE)


def parse_stl(content: bytes) -> Contents:
    """Return the part in an STL file.

    Raises
    ------
    ValueError
        If it is damaged, or may have been cut off.
    """
    if not content.strip():
        return Contents(())
    if _is_text(content):
        return _parse_text(decode(content))
    if len(content) < _HEAD:
        raise ValueError(f"neither text nor binary STL: {len(content)} bytes; export it again")
    return _parse_binary(content)


def _parse_binary(content: bytes) -> Contents:
    """Return the part in a binary file."""
    count = int.from_bytes(content[80:_HEAD], "little")
    behind = len(content) - _HEAD
    notes: tuple[str, ...] = ()
    if count in (0, _UNKNOWN) and behind and behind % _RECORD.itemsize == 0:
        notes = (f"its header says {count} triangles; {behind // _RECORD.itemsize} follow",)
        count = behind // _RECORD.itemsize
    expected = _HEAD + _RECORD.itemsize * count
    left = content[expected:].strip(b"\0\r\n")
    records = None
    if len(content) > expected:
        records = _with_payload(content, count)
        plain = np.frombuffer(content, _RECORD, count, _HEAD)
        # Where triangles may have a payload, nobody knows where the next one begins.
        is_aligned = (len(content) - expected) % _RECORD.itemsize != 0 and not plain["rest"].any()
        if records is None and left and is_aligned:
            notes = (f"{len(content) - expected} bytes behind its last triangle are not read",)
            left = b""
    if len(content) < expected or (records is None and left):
        raise ValueError(
            f"{len(content)} bytes, where its header promises {expected} for {count} triangles; "
            "export it again"
        )
    if records is None:
        records = np.frombuffer(content, _RECORD, count, _HEAD)
    corners = records["corners"].reshape(-1, 3)
    faces = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    rounding = single_rounding(corners)
    return replace(_contents(corners.astype(np.float64), faces, rounding), notes=notes)


def _with_payload(content: bytes, count: int) -> NDArray[np.void] | None:
    """Return triangles that have bytes behind them, as many as each says; None if none has any."""
    places, at = [], _HEAD
    for _ in range(count):
        end = at + _RECORD.itemsize
        if end > len(content):
            return None
        places.append(at)
        at = end + int.from_bytes(content[end - 2 : end], "little")
    if at == _HEAD + _RECORD.itemsize * count or at != len(content):
        return None
    whole = b"".join(content[place : place + _RECORD.itemsize] for place in places)
    return np.frombuffer(whole, _RECORD)


def _contents(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], rounding: float = 0.0
) -> Contents:
    part = Part("", vertices, faces, rounding=rounding)
    return Contents((part,) if len(faces) else ())


def _is_text(content: bytes) -> bool:
    """Tell text from binary, whose header may begin with ``solid`` too."""
    if len(content) >= _HEAD:
        count = int.from_bytes(content[80:_HEAD], "little")
        if len(content) == _HEAD + _RECORD.itemsize * count:
            return False
    try:
        text = decode(content[:_HEAD] if content[:2] in (b"\xff\xfe", b"\xfe\xff") else content)
    except ValueError:
        return False
    return text.lstrip()[:5].lower() == "solid"


def _parse_text(text: str) -> Contents:
    """Return the part in a text, its numbers in double precision."""
    body = _SOLID_LINES.sub("", text)
    if "," in body and "." not in body:  # decimal commas
        text = _VERTEX_LINES.sub(lambda line: line[0].replace(",", "."), text)
        return replace(
            _parse_text(text), notes=("its decimal sign is a comma, which is read as a point",)
        )
    words = body.split()
    ends = len(re.findall(r"^[ \t]*endsolid\b", text, re.IGNORECASE | re.MULTILINE))
    starts = len(re.findall(r"^[ \t]*solid\b", text, re.IGNORECASE | re.MULTILINE))
    table: NDArray[np.str_] | None = None
    if starts == ends and not words:
        return Contents(())
    if starts == ends and len(words) % len(_FACET) == 0 and "_" not in body:
        table = np.array(words).reshape(-1, len(_FACET))
        for column, word in enumerate(_FACET):
            if word is not None and (np.strings.lower(table[:, column]) != word).any():
                table = None
                break
    if table is not None:
        columns = [column for column, word in enumerate(_FACET) if word is None][3:]
        try:
            vertices = table[:, columns].astype(np.float64).reshape(-1, 3)
        except ValueError:
            return _walk(text)  # says which line
        return _contents(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3))
    return _walk(text)


def _walk(text: str) -> Contents:
    """Return the part in a text, line by line: for what is not triangles alone, or at fault."""
    vertices: list[list[float]] = []
    counts: list[int] = []
    lines_of: list[int] = []
    inside: list[str] = []  # of solid, facet, loop
    line = 0
    for line, raw in enumerate(split_lines(text), start=1):
        words = raw.lower().split()
        while words:
            try:
                words, done = _step(words, inside, vertices)
            except ValueError as error:
                raise ValueError(f"line {line}: {error}") from None
            if done == "loop":
                counts.append(0)
                lines_of.append(line)
            elif done == "vertex":
                counts[-1] += 1
            elif done == "endloop" and counts[-1] < 3:
                raise ValueError(f"line {line}: a loop of {counts[-1]} vertices; export it again")
    if inside:
        raise ValueError(
            f"the file is cut off: it ends at line {line}, in the {len(counts)}th facet or behind "
            f"it, without 'end{inside[-1]}'; export it again"
        )
    points = np.array(vertices, np.float64).reshape(-1, 3)
    try:
        faces, cuts = cut_polygons(points, np.arange(len(points)), np.array(counts, np.int64))
    except PolygonError as error:
        raise ValueError(f"line {lines_of[error.number]}: {error}") from None
    return Contents((Part("", points, faces, cuts=cuts),) if len(faces) else ())


def _step(
    words: list[str], inside: list[str], vertices: list[list[float]]
) -> tuple[list[str], str]:
    """Take one statement of a line; returns the words left, and what it was."""
    where = inside[-1] if inside else ""
    key = words[0]
    if key == "solid" and not inside:
        inside.append("solid")
        return [], key
    if key == "endsolid" and where == "solid":
        inside.pop()
        return [], key
    if key == "facet" and where == "solid":
        inside.append("facet")
        normal = words[1:5]
        if len(normal) == 4 and normal[0] == "normal":
            return words[5:], key
    elif words[:2] == ["outer", "loop"] and where == "facet":
        inside.append("loop")
        return words[2:], "loop"
    elif key == "vertex" and where == "loop":
        if len(words) < 4:
            raise ValueError(f"a vertex of {len(words) - 1} numbers, expected 3; export it again")
        vertices.append([number(word) for word in words[1:4]])
        return words[4:], key
    elif (key, where) in (("endloop", "loop"), ("endfacet", "facet")):
        inside.pop()
        return words[1:], key
    place = f"in a {where}" if where else "outside a solid"
    raise ValueError(f"found {' '.join(words[:4])!r} {place}; export it again")
