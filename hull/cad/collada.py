"""COLLADA 1.4 and 1.5: parts where the scene's nodes put them, names, colours, unit and up axis.

Read here, in double precision, because libraries lose surfaces in silence: pycollada 0.9 leaves out
polygons with holes and rounds to single precision. Whatever makes a surface in a way that is not
read (skins, morphs, convex hulls, boundary representations, other files) is refused by name.
Geometry that the scene does not show is left out, and said to be.

References
----------
COLLADA Digital Asset Schema 1.4.1, Khronos Group, chapters 5 (geometry, transforms, scenes) and 8.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import cross_matrix
from hybridve.hull.cad.part import (
    Contents,
    Part,
    Up,
    fan_triangles,
    join_meshes,
    move,
    strip_triangles,
)
from hybridve.hull.cad.polygons import Cuts, PolygonError, cut_holes_open, cut_polygons

_UP: dict[str, Up] = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}

#: What a mesh may hold that has no surface.
_NO_SURFACE = ("source", "vertices", "lines", "linestrips", "extra")

#: What it may hold that has one.
_SURFACES = ("triangles", "polylist", "polygons", "tristrips", "trifans")

#: The most nodes one inside the other; more hold each other in a circle.
_DEEPEST = 500

_Rgba = tuple[float, float, float, float]
_Mesh = tuple[NDArray[np.float64], NDArray[np.int32]]


def parse_collada(content: bytes) -> Contents:
    """Return the parts of a COLLADA file: one for each node that holds geometry.

    Raises
    ------
    ValueError
        If the file is damaged, or needs something that cannot be read.
    """
    try:
        root = ET.fromstring(content)
    except (ET.ParseError, LookupError, ValueError) as error:
        raise ValueError(f"its XML cannot be read: {error}") from error
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]  # the name of its schema says nothing more
    if root.tag != "COLLADA":
        raise ValueError(f"it is {root.tag!r}, not COLLADA")
    document = _Document(root)
    parts = [document.part(node, matrix) for node, matrix in document.placed_nodes()]
    unit = root.find("asset/unit")
    unit_name = "meter" if unit is None else unit.get("name")  # the standard's default
    metre = "1" if unit is None else unit.get("meter", "1")
    try:
        unit_m = float(metre)
    except ValueError:
        unit_m = math.nan
    if not (math.isfinite(unit_m) and unit_m > 0):
        raise ValueError(f"its unit measures {metre!r} metres")
    up = (root.findtext("asset/up_axis") or "Y_UP").strip()
    if up not in _UP:
        raise ValueError(f"its up_axis is {up!r}, expected one of {', '.join(_UP)}")
    filled = tuple(part for part in parts if len(part.faces))
    unit_name = unit_name or f"{unit_m} m"
    return Contents(filled, unit_name, unit_m, _UP[up], notes=document.what_is_not_shown())


class _Document:
    """The elements of one file, found by their ids."""

    def __init__(self, root: ET.Element) -> None:
        self._root = root
        self._by_id = {name: element for element in root.iter() if (name := element.get("id"))}
        self._meshes: dict[str, tuple[list[tuple[_Mesh, str]], Cuts]] = {}
        self._shown: set[str] = set()

    def _find(self, element: ET.Element, attribute: str = "url") -> ET.Element:
        """Return the element that another one names."""
        name = element.get(attribute, "")
        if not name.startswith("#"):
            raise ValueError(
                f"its {element.tag} leans on {name!r}, which is another file; export it as one"
            )
        if name[1:] not in self._by_id:
            raise ValueError(f"its {element.tag} names {name[1:]!r}, and there is none")
        return self._by_id[name[1:]]

    def placed_nodes(self) -> Iterator[tuple[ET.Element, NDArray[np.float64]]]:
        """Yield each node of the scene that holds geometry itself, and where it is: (4, 4)."""
        scene = self._root.find("scene/instance_visual_scene")
        if scene is None:
            return
        roots = self._find(scene).findall("node")
        waiting = [(node, np.eye(4), "", 0) for node in reversed(roots)]
        while waiting:
            node, world_from_parent, foreign, depth = waiting.pop()
            if depth > _DEEPEST:
                raise ValueError("its nodes hold each other in a circle")
            world_from_node = world_from_parent
            for step in node:
                if step.tag in _STEPS:
                    world_from_node = world_from_node @ _step(step)
                elif step.tag in _FOREIGN_STEPS:
                    foreign = step.tag
            if node.find("instance_controller") is not None:
                raise ValueError(
                    "it holds a skinned or morphed mesh, which has no fixed shape; export it rigid"
                )
            if node.find("instance_geometry") is not None:
                if foreign:
                    raise ValueError(f"a {foreign} places its geometry; export a matrix instead")
                yield node, world_from_node
            children = [
                self._find(child) if child.tag == "instance_node" else child
                for child in node
                if child.tag in ("node", "instance_node")
            ]
            waiting.extend(
                (child, world_from_node, foreign, depth + 1) for child in reversed(children)
            )

    def part(self, node: ET.Element, matrix: NDArray[np.float64]) -> Part:
        """Return what a node holds, where the matrix (4, 4) puts it."""
        pieces, made_of, cuts = [], set(), Cuts()
        name = node.get("name", "")
        for instance in node.findall("instance_geometry"):
            geometry = self._find(instance)
            key = geometry.get("id", "")
            name = name or geometry.get("name") or key
            self._shown.add(key)
            if key not in self._meshes:
                self._meshes[key] = self._geometry(geometry)
            meshes, found_cuts = self._meshes[key]
            cuts += found_cuts
            bound = {
                entry.get("symbol", ""): entry
                for entry in instance.iterfind("bind_material/technique_common/instance_material")
            }
            for mesh, symbol in meshes:
                pieces.append(move(*mesh, matrix))
                made_of.add(self._material(bound.get(symbol)))
        material, rgba = made_of.pop() if len(made_of) == 1 else ("", None)
        cuts = cuts.scaled(float(np.linalg.norm(matrix[:3, :3], 2)))
        return Part(name, *join_meshes(pieces), material, rgba, cuts)

    def what_is_not_shown(self) -> tuple[str, ...]:
        """Return a sentence on geometry that the scene does not hold, if there is any."""
        hidden = [
            _name(geometry)
            for geometry in self._root.iterfind("library_geometries/geometry")
            if geometry.get("id", "") not in self._shown
        ]
        if not hidden:
            return ()
        return (f"{len(hidden)} of its geometries are not in its scene, first {hidden[0]!r}",)

    def _geometry(self, geometry: ET.Element) -> tuple[list[tuple[_Mesh, str]], Cuts]:
        """Return the meshes of a geometry with the symbols of their materials."""
        name = _name(geometry)
        found, cuts = [], Cuts()
        for shape in geometry:
            if shape.tag in ("asset", "extra", "spline"):  # a spline is a curve
                continue
            if shape.tag != "mesh":
                raise ValueError(f"{name!r} is a {shape.tag}, which is not read; export a mesh")
            for primitive in shape:
                if primitive.tag in _NO_SURFACE:
                    continue
                try:
                    mesh, found_cuts = self._primitive(primitive)
                except ValueError as error:
                    raise ValueError(f"{primitive.tag} of {name!r}: {error}") from None
                cuts += found_cuts
                if len(mesh[1]):
                    found.append((mesh, primitive.get("material", "")))
        return found, cuts

    def _primitive(self, primitive: ET.Element) -> tuple[_Mesh, Cuts]:
        """Return a mesh of all vertices that an element leans on."""
        if primitive.tag not in _SURFACES:
            raise ValueError("this is not read; export triangles or polygons")
        inputs = primitive.findall("input")
        stride = 1 + max((int(entry.get("offset", "0")) for entry in inputs), default=0)
        chosen = next((entry for entry in inputs if entry.get("semantic") == "VERTEX"), None)
        if chosen is None:
            if any(len(_ints(entry)) for entry in primitive.iterfind("p")):
                raise ValueError("no input is its VERTEX")
            return (np.zeros((0, 3)), np.zeros((0, 3), np.int32)), Cuts()
        offset = int(chosen.get("offset", "0"))

        def rows(element: ET.Element) -> NDArray[np.int64]:
            numbers = _ints(element)
            if len(numbers) % stride:
                raise ValueError(f"{len(numbers)} numbers do not make corners of {stride}")
            return numbers[offset::stride]

        vertices = self._positions(chosen)
        promised = int(primitive.get("count", "0"))
        strips = [rows(entry) for entry in primitive.findall("p")]
        flat = np.concatenate([np.zeros(0, np.int64), *strips])
        cuts = Cuts()
        if primitive.tag == "polygons":
            faces, cuts, there = self._polygons(vertices, primitive, strips, rows)
        elif primitive.tag == "polylist":
            counts = np.concatenate(
                [np.zeros(0, np.int64), *(_ints(entry) for entry in primitive.findall("vcount"))]
            )
            there = len(counts)
            if counts.sum() != len(flat):
                raise ValueError(f"{len(flat)} corners, where vcount promises {counts.sum()}")
            faces, cuts = _cut(vertices, flat, counts)
        elif primitive.tag == "triangles":
            there = len(flat) // 3
            if len(flat) % 3:
                raise ValueError(f"{len(flat)} corners do not make triangles")
            faces, _ = _cut(vertices, flat, np.full(there, 3))
        else:
            there = len(strips)
            shape = strip_triangles if primitive.tag == "tristrips" else fan_triangles
            _cut(vertices, flat, np.zeros(0, np.int64))  # looks whether its vertices are there
            faces = np.concatenate([np.zeros((0, 3), np.int32), *(shape(s) for s in strips)])
        if there < promised:
            raise ValueError(
                f"{there} of the {promised} that it promises are there; is it cut off?"
            )
        return (vertices, faces), cuts

    def _polygons(
        self,
        vertices: NDArray[np.float64],
        primitive: ET.Element,
        outlines: list[NDArray[np.int64]],
        rows: Callable[[ET.Element], NDArray[np.int64]],
    ) -> tuple[NDArray[np.int32], Cuts, int]:
        """Return the triangles of polygons, those with holes last."""
        chains = list(outlines)
        for number, entry in enumerate(primitive.findall("ph"), start=1):
            outline = entry.find("p")
            if outline is None:
                raise ValueError(f"polygon with holes {number} has no outline")
            rings = [rows(outline), *(rows(hole) for hole in entry.findall("h"))]
            corners = np.concatenate(rings)
            if min(len(ring) for ring in rings) < 3:
                raise ValueError(f"polygon with holes {number}: a ring of fewer than 3 corners")
            _cut(vertices, corners, np.zeros(0, np.int64))  # looks whether its vertices are there
            try:
                chain = cut_holes_open(vertices[rings[0]], [vertices[ring] for ring in rings[1:]])
            except PolygonError as error:
                raise ValueError(f"polygon with holes {number}: {error}") from None
            chains.append(corners[chain])
        counts = np.array([len(chain) for chain in chains], np.int64)
        faces, cuts = _cut(vertices, np.concatenate([np.zeros(0, np.int64), *chains]), counts)
        return faces, cuts, len(chains)

    def _positions(self, chosen: ET.Element) -> NDArray[np.float64]:
        """Return the coordinates (V, 3) that an input of vertices stands for."""
        vertices = self._find(chosen, "source")
        position = next(
            (entry for entry in vertices.findall("input") if entry.get("semantic") == "POSITION"),
            None,
        )
        if position is None:
            raise ValueError("its vertices have no POSITION")
        source = self._find(position, "source")
        accessor = source.find("technique_common/accessor")
        if accessor is None:
            raise ValueError("its POSITION has no accessor")
        numbers = _floats(self._find(accessor, "source"))
        stride = int(accessor.get("stride", "1"))
        start, count = int(accessor.get("offset", "0")), int(accessor.get("count", "0"))
        params = [entry.get("name", "") for entry in accessor.findall("param")]
        columns = [params.index(axis) if axis in params else k for k, axis in enumerate("XYZ")]
        if stride < 3 or start < 0 or count < 0 or len(numbers) < start + (count - 1) * stride + 3:
            raise ValueError(
                f"{len(numbers)} numbers, too few for {count} vertices; is it cut off?"
            )
        if max(columns) >= stride:
            raise ValueError(f"its POSITION has the parameters {params}, expected X, Y and Z")
        full = np.zeros(max(count * stride, 0))
        there = numbers[start : start + count * stride]
        full[: len(there)] = there
        return full.reshape(-1, stride)[:, columns]

    def _material(self, bound: ET.Element | None) -> tuple[str, _Rgba | None]:
        """Return the name and colour of what an instance binds to a symbol."""
        if bound is None:
            return "", None
        material = self._find(bound, "target")
        name = _name(material)
        instance = material.find("instance_effect")
        if instance is None:
            return name, None
        colour = next(iter(self._find(instance).iterfind(".//diffuse/color")), None)
        values = [] if colour is None else _floats(colour).tolist()
        if len(values) != 4:  # a picture, or none
            return name, None
        red, green, blue, opacity = values
        return name, (red, green, blue, opacity)


def _cut(
    vertices: NDArray[np.float64], corners: NDArray[np.int64], counts: NDArray[np.int64]
) -> tuple[NDArray[np.int32], Cuts]:
    try:
        return cut_polygons(vertices, corners, counts)
    except PolygonError as error:
        raise ValueError(f"polygon {error.number + 1} of {len(counts)}: {error}") from None


def _name(element: ET.Element) -> str:
    return element.get("name") or element.get("id") or ""


def _words(element: ET.Element) -> list[str]:
    return "".join(element.itertext()).split()


def _floats(element: ET.Element) -> NDArray[np.float64]:
    try:
        numbers = np.array([float(word) for word in _words(element)], np.float64)
    except ValueError as error:
        raise ValueError(f"its {element.tag} {element.get('id', '')!r}: {error}") from None
    promised = element.get("count")
    if promised is not None and int(promised) > len(numbers):
        raise ValueError(f"its {element.tag} holds {len(numbers)} of {promised} numbers")
    return numbers


def _ints(element: ET.Element) -> NDArray[np.int64]:
    return np.array([int(word) for word in _words(element)], np.int64)


def _step(element: ET.Element) -> NDArray[np.float64]:
    """Return the matrix (4, 4) of a transform."""
    n_numbers, build = _STEPS[element.tag]
    values = _floats(element)
    if len(values) != n_numbers:
        raise ValueError(f"a {element.tag} of {len(values)} numbers, expected {n_numbers}")
    return build(values)


def _matrix(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return values.reshape(4, 4)


def _translate(values: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, 3] = values
    return matrix


def _scale(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.diag([*values.reshape(3).tolist(), 1.0])


def _rotate(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a turn about an axis by degrees, by Rodrigues' formula; exact at quarter turns."""
    x, y, z, degrees = values.tolist()
    length = math.hypot(x, y, z)
    matrix = np.eye(4)
    if length == 0.0:
        return matrix
    quarters, rest = divmod(degrees, 90.0)
    sine, cosine = math.sin(math.radians(rest)), math.cos(math.radians(rest))
    for _ in range(int(quarters % 4)):
        sine, cosine = cosine, -sine
    across = cross_matrix(np.array([x, y, z]) / length)
    matrix[:3, :3] += sine * across + (1.0 - cosine) * (across @ across)
    return matrix


#: The transforms of a node: how many numbers they have, and the matrix (4, 4) that they make.
_STEPS: dict[str, tuple[int, Callable[[NDArray[np.float64]], NDArray[np.float64]]]] = {
    "matrix": (16, _matrix),
    "translate": (3, _translate),
    "rotate": (4, _rotate),
    "scale": (3, _scale),
}

#: Those of cameras, and one that no exporter was found to write.
_FOREIGN_STEPS = ("lookat", "skew")
