"""FBX of version 7: parts where the scene's nodes put them, polygons of any number of corners.

Read here, because Open3D (through assimp, in single precision) leaves out every polygon that is no
triangle, and all names. A part is a model with geometry; it stands where its model and those above
put it, after the formula of Autodesk's FbxNode with its pivots, offsets and rotation orders. Where
programs differ in what a file means, or a surface is not made of polygons, it is refused by name:
skins, shapes that are blended in, patches and NURBS, scales that a child inherits askew.

Coordinates stay as they are in files that are z up or y up in the usual way; others are turned.

References
----------
Autodesk FBX SDK documentation, "Computing transformation matrices" and FbxAxisSystem.
"""

import math
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.fbx_nodes import Node, parse_nodes
from hybridve.hull.cad.part import Contents, Part, Up, join_meshes, move, single_rounding
from hybridve.hull.cad.polygons import Cuts, PolygonError, cut_polygons

#: The axes that rotations go about, the first of them first, by the number of the file.
_ORDERS = ("xyz", "xzy", "yzx", "yxz", "zxy", "zyx")

#: Geometry without a surface, and targets of blended shapes, which count by their weight.
_NO_SURFACE = ("Shape", "Line", "NurbsCurve", "Boundary")

#: Vertices, triangles, what became of polygons, and what single precision may have moved.
_Mesh = tuple[NDArray[np.float64], NDArray[np.int32], Cuts, float]

_AXES = ("CoordAxis", "UpAxis", "FrontAxis")

#: Axis and sign of what is right, up and towards the viewer in files that need not be turned.
_USUAL: dict[tuple[tuple[int, int], ...], Up] = {
    ((0, 1), (1, 1), (2, 1)): "y",
    ((0, 1), (2, 1), (1, -1)): "z",
}

_OLDEST = 7000


def parse_fbx(content: bytes) -> Contents:
    """Return the parts of an FBX file: one for each model that holds geometry.

    Raises
    ------
    ValueError
        If the file is damaged or cut off, or holds what is not read.
    """
    root, version = parse_nodes(content)
    if version < _OLDEST:
        raise ValueError(f"it is of version {version}; save it as FBX 2013 (version 7300) or later")
    document = _Document(root)
    parts = tuple(part for part in document.parts() if len(part.faces))
    settings = root.first("GlobalSettings")
    properties = {} if settings is None else _properties(settings)
    axes, up = _axes(properties)
    if axes is not None:
        parts = tuple(_turned(part, axes) for part in parts)
    unit_cm = properties.get("UnitScaleFactor")
    unit, unit_m = "", None
    if unit_cm:
        if not (math.isfinite(unit_cm[0]) and unit_cm[0] > 0):
            raise ValueError(f"its unit measures {unit_cm[0]} centimetres")
        unit_m = float(unit_cm[0]) / 100.0
        unit = f"{unit_cm[0]:g} cm"
    return Contents(parts, unit, unit_m, up, notes=document.what_is_not_shown())


def _axes(properties: dict[str, list[Any]]) -> tuple[NDArray[np.float64] | None, Up]:
    """Return a matrix (4, 4) that turns the file y up, if it must be, and what is up then."""
    numbers = tuple(
        (
            int((properties.get(name) or [usual])[0]),
            int((properties.get(f"{name}Sign") or [1])[0]),
        )
        for name, usual in zip(_AXES, (0, 1, 2), strict=True)
    )
    if sorted(axis for axis, _ in numbers) != [0, 1, 2] or any(
        sign not in (-1, 1) for _, sign in numbers
    ):
        raise ValueError(f"its axes (right, up, front) are {numbers}, no frame")
    if numbers in _USUAL:
        return None, _USUAL[numbers]
    matrix = np.zeros((4, 4))
    for row, (axis, sign) in enumerate(numbers):
        matrix[row, axis] = sign
    matrix[3, 3] = 1.0
    return matrix, "y"


def _turned(part: Part, matrix: NDArray[np.float64]) -> Part:
    vertices, faces = move(part.vertices, part.faces, matrix)
    return Part(part.name, vertices, faces, part.material, part.rgba, part.cuts)


def _properties(node: Node | None, defaults: dict[str, list[Any]] | None = None) -> dict[str, Any]:
    """Return the values of a node's properties by their names."""
    result = dict(defaults or {})
    held = None if node is None else node.first("Properties70")
    for entry in () if held is None else held.all("P"):
        if len(entry.values) >= 4:
            result[str(entry.values[0])] = entry.values[4:]
    return result


class _Document:
    """The objects of one file, and how they are connected."""

    def __init__(self, root: Node) -> None:
        self._objects: dict[int, Node] = {}
        for node in _children(root, "Objects"):
            if len(node.values) >= 3 and isinstance(node.values[0], int):
                self._objects[node.values[0]] = node
            elif node.name in ("Model", "Geometry"):
                raise ValueError(f"a {node.name} has no number; the file is damaged")
        self._below: dict[int, list[int]] = defaultdict(list)
        for entry in _children(root, "Connections"):
            if entry.name == "C" and len(entry.values) >= 3 and entry.values[0] == "OO":
                self._below[int(entry.values[2])].append(int(entry.values[1]))
        self._defaults: dict[str, dict[str, list[Any]]] = {}
        for kind in _children(root, "Definitions"):
            if kind.name == "ObjectType" and kind.values:
                template = kind.first("PropertyTemplate")
                self._defaults[str(kind.values[0])] = _properties(template)
        self._shown: set[int] = set()
        self._meshes: dict[int, _Mesh] = {}

    def parts(self) -> Iterator[Part]:
        """Yield a part for each model with geometry that hangs below the root, in its order."""
        waiting = [(number, np.eye(4), 0) for number in reversed(self._of(0, "Model"))]
        while waiting:
            number, world_from_parent, depth = waiting.pop()
            if depth > len(self._objects):
                raise ValueError("its models hold each other in a circle")
            world_from_model = world_from_parent @ self._local(number, world_from_parent)
            if self._of(number, "Geometry"):
                yield self._part(number, world_from_model)
            waiting.extend(
                (child, world_from_model, depth + 1)
                for child in reversed(self._of(number, "Model"))
            )

    def what_is_not_shown(self) -> tuple[str, ...]:
        """Return a sentence on geometry that hangs below no model, if there is any."""
        hidden = [
            _name(node)
            for number, node in self._objects.items()
            if node.name == "Geometry"
            and node.values[2] not in _NO_SURFACE
            and number not in self._shown
        ]
        if not hidden:
            return ()
        return (f"{len(hidden)} of its geometries are not in its scene, first {hidden[0]!r}",)

    def _of(self, number: int, kind: str) -> list[int]:
        """Return the objects of a kind that are connected to another one."""
        return [
            below
            for below in self._below.get(number, ())
            if below in self._objects and self._objects[below].name == kind
        ]

    def _part(self, number: int, world_from_model: NDArray[np.float64]) -> Part:
        model = self._objects[number]
        found = _properties(model, self._defaults.get("Model"))
        turn = _vector(found, "GeometricRotation")
        if np.count_nonzero(turn) > 1 and (found.get("RotationOrder") or [0])[0]:
            raise ValueError(
                f"model {_name(model)!r} has a geometric rotation and a rotation order, which "
                "programs read differently; apply its rotation and export it again"
            )
        matrix = (
            world_from_model
            @ _shift(_vector(found, "GeometricTranslation"))
            @ _rotation(turn, "xyz")
            @ _stretch(_vector(found, "GeometricScaling", 1.0))
        )
        pieces, cuts, rounding = [], Cuts(), 0.0
        for geometry in self._of(number, "Geometry"):
            self._shown.add(geometry)
            if geometry not in self._meshes:
                self._meshes[geometry] = self._mesh(geometry)
            vertices, faces, found_cuts, found_rounding = self._meshes[geometry]
            if len(faces):
                stretch = float(np.linalg.norm(matrix[:3, :3], 2))
                pieces.append(move(vertices, faces, matrix))
                cuts += found_cuts.scaled(stretch)
                rounding = max(rounding, stretch * found_rounding)
        materials = self._of(number, "Material")
        material, rgba = "", None
        if len(materials) == 1:
            material, rgba = self._material(self._objects[materials[0]])
        return Part(_name(model), *join_meshes(pieces), material, rgba, cuts, rounding=rounding)

    def _material(self, node: Node) -> tuple[str, tuple[float, float, float, float] | None]:
        found = _properties(node, self._defaults.get("Material"))
        colour = found.get("DiffuseColor") or found.get("Diffuse")
        if colour is None or len(colour) != 3:
            return _name(node), None
        red, green, blue = (min(max(float(value), 0.0), 1.0) for value in colour)
        opacity = float((found.get("Opacity") or [1.0])[0])
        return _name(node), (red, green, blue, min(max(opacity, 0.0), 1.0))

    def _mesh(self, number: int) -> _Mesh:
        """Return the vertices and triangles of a geometry."""
        node = self._objects[number]
        nothing = np.zeros((0, 3)), np.zeros((0, 3), np.int32), Cuts(), 0.0
        if node.values[2] in _NO_SURFACE:
            return nothing
        label = f"geometry {_name(node)!r}"
        if node.values[2] != "Mesh":
            raise ValueError(f"{label} is a {node.values[2]}, which is not read; export a mesh")
        self._refuse_what_deforms(number, label)
        points, ends = node.first("Vertices"), node.first("PolygonVertexIndex")
        if points is None or ends is None:
            return nothing
        try:
            vertices = points.numbers(np.float64)
            if len(vertices) % 3:
                raise ValueError(f"{len(vertices)} coordinates do not make points")
            vertices = vertices.reshape(-1, 3)
            corners = ends.numbers(np.int64)
            last = np.flatnonzero(corners < 0)  # the last corner of each polygon, as -1 - number
            if len(corners) and (not len(last) or last[-1] != len(corners) - 1):
                raise ValueError("its last polygon does not end; is it cut off?")
            corners = np.where(corners < 0, -1 - corners, corners)
            faces, cuts = cut_polygons(vertices, corners, np.diff(last, prepend=-1))
        except PolygonError as error:
            raise ValueError(f"{label}: polygon {error.number + 1}: {error}") from None
        except ValueError as error:
            raise ValueError(f"{label}: {error}") from None
        rounding = 0.0
        if len(points.values) == 1 and isinstance(points.values[0], np.ndarray):
            rounding = single_rounding(points.values[0].reshape(-1, 3))
        return vertices, faces, cuts, rounding

    def _refuse_what_deforms(self, geometry: int, label: str) -> None:
        for number in self._of(geometry, "Deformer"):
            kind = self._objects[number].values[2]
            if kind == "BlendShape":
                for channel in self._of(number, "Deformer"):
                    if self._weight(self._objects[channel]):
                        raise ValueError(f"{label} is blended with other shapes; export it without")
            else:
                raise ValueError(f"{label} has a {kind}, so no fixed shape; export it rigid")

    def _weight(self, channel: Node) -> float:
        """Return how much of a shape is blended in, in percent."""
        stated = channel.first("DeformPercent")
        values = stated.values if stated is not None else _properties(channel).get("DeformPercent")
        return float(values[0]) if values else 0.0

    def _local(self, number: int, world_from_parent: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return parent_from_model (4, 4)."""
        node = self._objects[number]
        label = f"model {_name(node)!r}"
        found = _properties(node, self._defaults.get("Model"))
        order = int((found.get("RotationOrder") or [0])[0])
        before = _vector(found, "PreRotation")
        after = _vector(found, "PostRotation")
        is_active = bool((found.get("RotationActive") or [0])[0])
        if not is_active and (order or before.any() or after.any()):
            raise ValueError(
                f"{label} has a rotation order or pre-rotation that is switched off, which "
                "programs read differently; apply its rotation and export it again"
            )
        if not 0 <= order < len(_ORDERS):
            raise ValueError(f"{label} has the rotation order {order}, which is not read")
        rotation = (
            _rotation(before, "xyz")
            @ _rotation(_vector(found, "Lcl Rotation"), _ORDERS[order])
            @ _rotation(after, "xyz").T
        )
        scale = _stretch(_vector(found, "Lcl Scaling", 1.0))
        self._refuse_askew(found, label, world_from_parent[:3, :3], rotation[:3, :3])
        turn_about, stretch_about = _vector(found, "RotationPivot"), _vector(found, "ScalingPivot")
        return (
            _shift(_vector(found, "Lcl Translation"))
            @ _shift(_vector(found, "RotationOffset") + turn_about)
            @ rotation
            @ _shift(_vector(found, "ScalingOffset") + stretch_about - turn_about)
            @ scale
            @ _shift(-stretch_about)
        )

    def _refuse_askew(
        self,
        found: dict[str, Any],
        label: str,
        linear: NDArray[np.float64],
        rotation: NDArray[np.float64],
    ) -> None:
        """Refuse a model for which inheriting a scale is not the product of matrices.

        By the number of the file: 0, its scale is applied after the rotations of both; 1, the
        product; 2, it inherits no scale.
        """
        inherits = int((found.get("InheritType") or [0])[0])
        square = linear.T @ linear
        size = float(np.trace(square)) / 3.0
        # To rounding of degrees, which files give to seven digits or better.
        is_even = np.abs(square - size * np.eye(3)).max() <= 1e-6 * size
        is_turned = np.abs(rotation - np.eye(3)).max() > 1e-9
        if (inherits == 0 and not is_even and is_turned) or (
            inherits == 2 and not (is_even and abs(size - 1.0) <= 1e-6)
        ):
            raise ValueError(
                f"{label} inherits an uneven scale in a way that programs read differently; apply "
                "the scale of what holds it and export it again"
            )


def _children(root: Node, name: str) -> list[Node]:
    return [child for node in root.all(name) for child in node.children]


def _name(node: Node) -> str:
    """Return the name of an object: text says ``Model::Box``, binary ``Box`` and a mark."""
    name = str(node.values[1]).partition("\0")[0]
    return name.removeprefix(f"{node.name}::")


def _vector(found: dict[str, Any], name: str, usual: float = 0.0) -> NDArray[np.float64]:
    values = found.get(name) or [usual] * 3
    try:
        vector = np.array([float(value) for value in values], np.float64)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,):
        raise ValueError(f"a {name} of {values!r}, expected 3 numbers")
    return vector


def _shift(offset: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return matrix


def _stretch(factors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.diag([*factors.tolist(), 1.0])


def _rotation(degrees: NDArray[np.float64], order: str) -> NDArray[np.float64]:
    """Return turns about the axes (4, 4), the first of the order first; exact at quarter turns."""
    matrix = np.eye(4)
    for name in order:
        axis = "xyz".index(name)
        quarters, rest = divmod(float(degrees[axis]), 90.0)
        sine, cosine = math.sin(math.radians(rest)), math.cos(math.radians(rest))
        for _ in range(int(quarters % 4)):
            sine, cosine = cosine, -sine
        turn = np.eye(4)
        first, second = (axis + 1) % 3, (axis + 2) % 3
        turn[first, first], turn[first, second] = cosine, -sine
        turn[second, first], turn[second, second] = sine, cosine
        matrix = turn @ matrix
    return matrix
