"""COLLADA through pycollada: parts, names, unit and upward axis.

trimesh reads the same library's result, but ignores unit, axis and names, and leaves out in silence
what the library could not read.
"""

import io
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.contact.part import Contents, Part, Up, join_meshes, move

_UP: dict[str, Up] = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}


def parse_collada(content: bytes) -> Contents:
    """Return the parts of a COLLADA file: one for each node that holds geometry.

    Numbers are single precision, as pycollada reads them. Polygons are cut into fans, which is
    right for convex ones.

    Raises
    ------
    ValueError
        If the file is damaged, or needs something that cannot be read.
    """
    import collada  # late: most scenes have no such file

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # NumPy's word for numbers cut short
            document = collada.Collada(io.BytesIO(content))
            roots = document.scene.nodes if document.scene is not None else []
            parts = [
                _part(node, matrix) for root in roots for node, matrix in _placed(root, np.eye(4))
            ]
    except RecursionError as error:
        raise ValueError("its nodes hold each other in a circle") from error
    except ValueError:
        raise
    except Exception as error:  # XML and pycollada errors of many classes
        raise ValueError(str(error).replace("\n", " ")) from error
    asset = document.assetInfo
    unit = next((entry for entry in asset.xmlnode if entry.tag.endswith("}unit")), None)
    unit_name = "meter" if unit is None else unit.get("name")  # the standard's default
    metre = "1" if unit is None else unit.get("meter", "1")
    try:
        unit_m = float(metre)
    except ValueError:
        unit_m = np.nan
    if not (np.isfinite(unit_m) and unit_m > 0):
        raise ValueError(f"its unit measures {metre!r} metres")
    filled = tuple(part for part in parts if len(part.faces))
    return Contents(filled, unit_name or f"{unit_m} m", unit_m, _UP[asset.upaxis])


def _placed(
    node: Any, world_from_parent: NDArray[np.float64]
) -> Iterator[tuple[Any, NDArray[np.float64]]]:
    """Yield each node that holds geometry itself, and where it is: a matrix (4, 4)."""
    import collada

    if isinstance(node, collada.scene.NodeNode):  # stands for a node of the library
        node = node.node
    if isinstance(node, collada.scene.ControllerNode):
        raise ValueError("it holds a skinned mesh, which has no fixed shape; export it rigid")
    if not isinstance(node, collada.scene.Node):
        return
    world_from_node = world_from_parent
    for step in node.transforms:
        world_from_node = world_from_node @ step.matrix.astype(np.float64)
    if any(isinstance(child, collada.scene.GeometryNode) for child in node.children):
        yield node, world_from_node
    for child in node.children:
        yield from _placed(child, world_from_node)


def _part(node: Any, matrix: NDArray[np.float64]) -> Part:
    import collada

    pieces, made_of = [], set()
    name = node.name or ""
    for child in node.children:
        if not isinstance(child, collada.scene.GeometryNode):
            continue
        name = name or child.geometry.name or child.geometry.id
        materials = {entry.symbol: entry.target for entry in child.materials}
        for primitive in child.geometry.primitives:
            if isinstance(primitive, collada.lineset.LineSet):
                continue
            triangles = primitive.triangleset() if hasattr(primitive, "triangleset") else primitive
            if triangles.vertex is None or len(triangles.vertex_index) == 0:
                continue
            faces = np.array(triangles.vertex_index, np.int64).reshape(-1, 3)
            if faces.max() >= len(triangles.vertex) or faces.min() < 0:
                raise ValueError(f"a face of {name!r} names a vertex that is not there")
            vertices = np.array(triangles.vertex, np.float64)
            pieces.append(move(vertices, faces.astype(np.int32), matrix))
            made_of.add(_material(materials.get(primitive.material)))
    material, rgba = made_of.pop() if len(made_of) == 1 else ("", None)
    return Part(name, *join_meshes(pieces), material, rgba)


def _material(material: Any) -> tuple[str, tuple[float, float, float, float] | None]:
    if material is None:
        return "", None
    name = material.name or material.id or ""
    diffuse = material.effect.diffuse
    if not isinstance(diffuse, tuple) or len(diffuse) != 4:  # a picture, or none
        return name, None
    red, green, blue, opacity = (float(value) for value in diffuse)
    return name, (red, green, blue, opacity)
