"""OBJ files: triangles in the order of the file, objects by name, colours from the MTL beside it.

trimesh 5.2 reads relative (negative) indices wrongly where vertices follow faces, cuts polygons so
that triangles change their order, and stops at a comment behind a face; Open3D 0.20 skips polygons,
rounds to single precision, and sorts triangles by material. Numbers of triangles stand in the
report and refer to the file, so this kind is read here.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from hybridve.hull.contact.part import Contents, Part

_Rgba = tuple[float, float, float, float]


@dataclass(slots=True)
class _Section:
    name: str
    faces: list[tuple[int, int, int]] = field(default_factory=list)
    materials: set[str] = field(default_factory=set)


def parse_obj(content: bytes, beside: Mapping[str, bytes]) -> Contents:
    """Return the parts of an OBJ file.

    Where there are several ``o``, each starts a part; groups (``g``) do not. Polygons are cut into
    fans, which is right for convex ones.

    Parameters
    ----------
    content : bytes
        The file.
    beside : mapping of str to bytes
        The MTL files that it names, as far as they are there.

    Raises
    ------
    ValueError
        If a line cannot be read, or a face names a vertex that is not there.
    """
    vertices: list[list[float]] = []
    sections = [_Section("")]
    material = ""
    libraries: list[str] = []
    text = content.decode("utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        key = words[0]
        try:
            if key == "v":
                x, y, z = words[1:4]
                vertices.append([float(x), float(y), float(z)])
            elif key == "f":
                corners = [_vertex(word, len(vertices)) for word in words[1:]]
                if len(corners) < 3:
                    raise ValueError(f"a face of {len(corners)} corners")
                sections[-1].faces.extend(
                    (corners[0], corners[k], corners[k + 1]) for k in range(1, len(corners) - 1)
                )
                sections[-1].materials.add(material)
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from None
        rest = line.strip()[len(key) :].strip()
        if key == "o":
            sections.append(_Section(rest))
        elif key == "usemtl":
            material = rest
        elif key == "mtllib":
            libraries.append(rest)
    colours: dict[str, _Rgba] = {}
    for library in libraries:
        colours |= _parse_mtl(beside.get(library, b""))
    points = np.array(vertices, np.float64).reshape(-1, 3)
    filled = [section for section in sections if section.faces]
    if sum(section is not sections[0] for section in filled) < 2:
        whole = _Section("")
        for section in filled:
            whole.faces += section.faces
            whole.materials |= section.materials
        filled = [whole] if filled else []
    parts = []
    for section in filled:
        faces = np.array(section.faces, np.int64)
        if faces.max() >= len(points):
            raise ValueError(f"a face names vertex {faces.max() + 1} of {len(points)}")
        used = points
        if len(filled) > 1:
            numbers, inverse = np.unique(faces, return_inverse=True)
            used, faces = points[numbers], inverse.reshape(-1, 3)
        made_of = section.materials.pop() if len(section.materials) == 1 else ""
        parts.append(
            Part(section.name, used, faces.astype(np.int32), made_of, colours.get(made_of))
        )
    return Contents(tuple(parts))


def mtl_names(content: bytes) -> list[str]:
    """Return the names of the MTL files that an OBJ file names."""
    lines = (line.strip() for line in content.splitlines())
    return [
        line[6:].strip().decode("utf-8", errors="replace")
        for line in lines
        if line.startswith((b"mtllib ", b"mtllib\t"))
    ]


def _vertex(word: str, n_before: int) -> int:
    """Return the vertex that a corner such as ``7/1/2`` names; negative ones count backwards."""
    number = int(word.partition("/")[0])
    if number < -n_before or number == 0:
        raise ValueError(f"a face names vertex {number}, after {n_before} vertices")
    return number - 1 if number > 0 else n_before + number


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
