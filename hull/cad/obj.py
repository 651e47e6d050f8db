"""OBJ files: triangles in the order of the file, objects by name, colours from the MTL beside it.

Numbers of triangles stand in the report and refer to the file, so polygons become triangles where
they stand, and nothing is sorted. Every statement is known: to hold polygons, to hold no surface,
or to hold one that is not read here (free-form patches, other files), which is refused by its line.
An OBJ neither counts its faces nor says where it ends. One that was cut off is recognised by a last
line that does not end, or by vertices after the last face that nothing uses.

References
----------
Wavefront, Object Files (.obj), Advanced Visualizer Manual, appendix B1.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.part import Contents, Part
from hybridve.hull.cad.polygons import PolygonError, cut_polygons
from hybridve.hull.cad.text import decode, is_ended, number, split_lines, whole

_Rgba = tuple[float, float, float, float]

#: Lines of numbers: vertices, their normals and places in pictures.
_NUMBER_LINES = re.compile(r"^[ \t]*v[tn]?[ \t][^\r\n#]*", re.MULTILINE)

#: Statements that name vertices and have no surface.
_LINES = ("l", "p", "curv", "curv2")

#: Statements that make a surface of something else than polygons, or of another file.
_FOREIGN = ("surf", "bzp", "bsp", "cdp", "res", "call", "csh", "scmp")

#: Statements that have no bearing on where a surface is, besides those that are read.
_SILENT = (
    *("vt", "vn", "vp", "g", "s", "mg", "cstype", "deg", "bmat", "step", "parm", "trim", "hole"),
    *("scrv", "sp", "end", "con", "bevel", "c_interp", "d_interp", "lod", "shadow_obj"),
    *("trace_obj", "ctech", "stech", "usemap", "maplib", "cdc", "illum"),
)


@dataclass(slots=True)
class _Section:
    name: str
    corners: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    materials: set[str] = field(default_factory=set)


def parse_obj(content: bytes, beside: Mapping[str, bytes]) -> Contents:
    """Return the parts of an OBJ file.

    Where there are several ``o``, each starts a part; groups (``g``) do not.

    Parameters
    ----------
    content : bytes
        The file.
    beside : mapping of str to bytes
        The MTL files that it names, as far as they are there.

    Raises
    ------
    ValueError
        If a line cannot be read, a face names a vertex that is not there or crosses itself, or the
        file holds a surface that is not read.
    """
    text = decode(content)
    numbers = "".join(_NUMBER_LINES.findall(text))
    has_commas = "," in numbers and "." not in numbers
    if has_commas:
        text = _NUMBER_LINES.sub(lambda line: line[0].replace(",", "."), text)
    vertices: list[list[float]] = []
    sections = [_Section("")]
    material = ""
    libraries: list[str] = []
    n_before_last_use = 0
    for line, raw in _statements(text):
        words = raw.partition("#")[0].split()
        if not words:
            continue
        key = words[0]
        rest = raw.strip()[len(key) :].strip()
        try:
            if key == "v":
                if len(words) < 4:
                    raise ValueError(f"a vertex of {len(words) - 1} numbers, expected 3")
                vertices.append([number(word) for word in words[1:4]])
            elif key in ("f", "fo"):
                if len(words) < 4:
                    raise ValueError(f"a face of {len(words) - 1} corners")
                section = sections[-1]
                section.corners += [_vertex(word, len(vertices)) for word in words[1:]]
                section.counts.append(len(words) - 1)
                section.lines.append(line)
                section.materials.add(material)
                n_before_last_use = len(vertices)
            elif key == "o":
                sections.append(_Section(rest))
            elif key == "usemtl":
                material = rest
            elif key == "mtllib":
                libraries.append(rest)
            elif key in _FOREIGN:
                raise ValueError(
                    f"{key!r} holds a surface that is not made of polygons here; export polygons"
                )
            elif key in _LINES:
                n_before_last_use = len(vertices)
            elif key not in _SILENT:
                raise ValueError(
                    f"{key!r} is no statement of OBJ files; take the line out if it has no surface"
                )
        except ValueError as error:
            raise ValueError(f"line {line}: {error}") from None
    filled = [section for section in sections if section.counts]
    if filled and n_before_last_use < len(vertices):
        last = max(max(section.corners) for section in filled) + 1
        n_unused = len(vertices) - max(n_before_last_use, last)
        if n_unused > 0:
            raise ValueError(
                f"{n_unused} vertices after the last face are used by none; if it is not cut off, "
                "take them out"
            )
    if sum(section is not sections[0] for section in filled) < 2:
        filled = [_joined(filled)] if filled else []
    points = np.array(vertices, np.float64).reshape(-1, 3)
    colours: dict[str, _Rgba] = {}
    for library in libraries:
        colours |= _parse_mtl(beside.get(library, b""))
    parts = tuple(_part(section, points, colours, alone=len(filled) == 1) for section in filled)
    notes = ("its decimal sign is a comma, which is read as a point",) if has_commas else ()
    return Contents(parts, is_ended=is_ended(text), notes=notes)


def _statements(text: str) -> Iterator[tuple[int, str]]:
    """Yield the statements, lines joined that end with a backslash, and where each begins."""
    begun, first = "", 0
    for line, raw in enumerate(split_lines(text), start=1):
        first = first or line
        if raw.endswith("\\"):
            begun += raw[:-1] + " "
            continue
        yield first, begun + raw
        begun, first = "", 0
    if begun:
        yield first, begun


def _joined(sections: list[_Section]) -> _Section:
    whole_file = _Section("")
    for section in sections:
        whole_file.corners += section.corners
        whole_file.counts += section.counts
        whole_file.lines += section.lines
        whole_file.materials |= section.materials
    return whole_file


def _part(
    section: _Section, points: NDArray[np.float64], colours: Mapping[str, _Rgba], *, alone: bool
) -> Part:
    corners = np.array(section.corners, np.int64)
    counts = np.array(section.counts, np.int64)
    if corners.max() >= len(points):
        face = int(np.searchsorted(np.cumsum(counts), int(np.argmax(corners)), side="right"))
        raise ValueError(
            f"line {section.lines[face]}: a face names vertex {corners.max() + 1} of {len(points)}"
        )
    if not alone:
        numbers, corners = np.unique(corners, return_inverse=True)
        points = points[numbers]
    try:
        faces, cuts = cut_polygons(points, corners.reshape(-1), counts)
    except PolygonError as error:
        raise ValueError(f"line {section.lines[error.number]}: {error}") from None
    made_of = next(iter(section.materials)) if len(section.materials) == 1 else ""
    return Part(section.name, points, faces, made_of, colours.get(made_of), cuts)


def mtl_names(content: bytes) -> list[str]:
    """Return the names of the MTL files that an OBJ file names.

    Raises
    ------
    ValueError
        If it is no text.
    """
    lines = (line.strip() for line in split_lines(decode(content)))
    return [line[6:].strip() for line in lines if line.startswith(("mtllib ", "mtllib\t"))]


def _vertex(word: str, n_before: int) -> int:
    """Return the vertex that a corner such as ``7/1/2`` names; negative ones count backwards."""
    named = whole(word.partition("/")[0])
    if named < -n_before or named == 0:
        raise ValueError(f"a face names vertex {named}, after {n_before} vertices")
    return named - 1 if named > 0 else n_before + named


def _parse_mtl(content: bytes) -> dict[str, _Rgba]:
    """Return the diffuse colour of each material that has one."""
    colours: dict[str, list[float]] = {}
    name = ""
    for line in content.decode("utf-8", errors="replace").splitlines():
        words = line.partition("#")[0].split()
        try:
            if words[:1] == ["newmtl"]:
                name = line.strip()[len("newmtl") :].strip()
            elif words[:1] == ["Kd"]:
                colours.setdefault(name, [1.0] * 4)[:3] = [float(word) for word in words[1:4]]
            elif words[:1] == ["d"]:
                colours.setdefault(name, [1.0] * 4)[3] = float(words[-1])
        except ValueError:  # colours named otherwise, as spectra are: for pictures only, so none
            continue
    return {
        name: (colour[0], colour[1], colour[2], colour[3])
        for name, colour in colours.items()
        if len(colour) == 4
    }
