"""Closed CAD meshes in millimetres, made by code, and written as binary STL."""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_STL_FACET = np.dtype(
    [("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attributes", "<u2")], align=False
)


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A triangle mesh in its own frame.

    Attributes
    ----------
    vertices_mm : (V, 3) float64
        Millimetres.
    faces : (T, 3) int64
        Vertex numbers, counter-clockwise from outside.
    """

    vertices_mm: NDArray[np.float64]
    faces: NDArray[np.int64]

    @property
    def triangles_mm(self) -> NDArray[np.float64]:
        """The corners of the triangles, (T, 3, 3)."""
        return self.vertices_mm[self.faces]


def box_mesh(size_mm: tuple[float, float, float], spacing_mm: float) -> Mesh:
    """Return a box about the origin, its faces divided so that no edge exceeds the spacing.

    Parameters
    ----------
    size_mm : tuple of 3 float
        Extent along x, y and z.
    spacing_mm : float
        Longest edge along an axis; diagonals are longer by a factor of up to 1.41.
    """
    lines = [_divide(np.array([-size / 2, size / 2]), spacing_mm) for size in size_mm]
    filled = np.ones([len(line) - 1 for line in lines], np.bool_)
    return _rectilinear_mesh(lines, filled)


def bracket_mesh(
    size_mm: tuple[float, float, float], thickness_mm: float, spacing_mm: float
) -> Mesh:
    """Return an L-shaped bracket about the centre of its bounding box.

    A foot lies along x and a back stands up along z, both of the given thickness; the profile is
    the same all along y.

    Parameters
    ----------
    size_mm : tuple of 3 float
        Extent along x, y and z.
    thickness_mm : float
        Thickness of foot and back.
    spacing_mm : float
        Longest edge along an axis.
    """
    half = [size / 2 for size in size_mm]
    inner_x, inner_z = -half[0] + thickness_mm, -half[2] + thickness_mm
    lines = [
        _divide(np.array([-half[0], inner_x, half[0]]), spacing_mm),
        _divide(np.array([-half[1], half[1]]), spacing_mm),
        _divide(np.array([-half[2], inner_z, half[2]]), spacing_mm),
    ]
    in_back = lines[0][:-1] < inner_x
    in_foot = lines[2][:-1] < inner_z
    profile = in_back[:, None] | in_foot[None, :]  # (X, Z)
    filled = np.repeat(profile[:, None, :], len(lines[1]) - 1, axis=1)
    return _rectilinear_mesh(lines, filled)


def write_stl(path: Path, mesh: Mesh, title: str) -> None:
    """Write a mesh as binary STL; the format has no unit, so say it in the title."""
    corners = mesh.triangles_mm
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facets = np.zeros(len(corners), _STL_FACET)
    facets["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    facets["corners"] = corners
    count = np.array([len(corners)], "<u4")
    path.write_bytes(title.encode("ascii").ljust(80)[:80] + count.tobytes() + facets.tobytes())


def _divide(lines: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Return `lines` with as many even steps put between them as keep each within the spacing."""
    steps = [
        np.linspace(start, stop, int(np.ceil((stop - start) / spacing - 1e-9)) + 1)[:-1]
        for start, stop in pairwise(lines)
    ]
    return np.concatenate([*steps, lines[-1:]])


def _rectilinear_mesh(lines: list[NDArray[np.float64]], filled: NDArray[np.bool_]) -> Mesh:
    """Return the closed surface of the filled cells of a grid.

    Neighbouring faces share whole edges, so that the mesh is watertight after welding.
    """
    padded = np.pad(filled, 1)
    quads = []
    for axis in range(3):
        # A face stands wherever a filled cell meets an empty one across a line of this axis.
        step = np.diff(padded.astype(np.int8), axis=axis)
        inner = [slice(None) if k == axis else slice(1, -1) for k in range(3)]
        for value in (1, -1):  # 1: the solid begins here, its outside looks down the axis
            cells = np.argwhere(step[tuple(inner)] == value)  # (Q, 3) lower corner of each face
            u, v = np.eye(3, dtype=np.int64)[[(axis + 1) % 3, (axis + 2) % 3]]
            if value == 1:
                u, v = v, u
            quads.append(np.stack([cells, cells + u, cells + u + v, cells + v], axis=1))
    corners = np.concatenate(quads)  # (Q, 4, 3) grid numbers
    used, numbers = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    numbers = numbers.reshape(-1, 4)
    vertices = np.column_stack([lines[axis][used[:, axis]] for axis in range(3)])
    faces = np.concatenate([numbers[:, [0, 1, 2]], numbers[:, [0, 2, 3]]])
    return Mesh(vertices, faces.astype(np.int64))
