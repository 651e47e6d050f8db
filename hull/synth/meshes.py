"""CAD meshes in millimetres, made by code, and written as binary STL.

All are closed and face outwards but the sheet, which has a border.
"""

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


def frame_mesh(size_mm: tuple[float, float, float], thickness_mm: float, spacing_mm: float) -> Mesh:
    """Return a window frame about the origin: a box with a rectangular opening along y.

    Parameters
    ----------
    size_mm : tuple of 3 float
        Extent along x, y and z.
    thickness_mm : float
        How wide the four beams are, along x and z.
    spacing_mm : float
        Longest edge along an axis.
    """
    half = np.array(size_mm) / 2
    inner = half - thickness_mm
    lines = [
        _divide(np.array([-half[0], -inner[0], inner[0], half[0]]), spacing_mm),
        _divide(np.array([-half[1], half[1]]), spacing_mm),
        _divide(np.array([-half[2], -inner[2], inner[2], half[2]]), spacing_mm),
    ]
    in_beam = [
        (lines[axis][:-1] < -inner[axis]) | (lines[axis][1:] > inner[axis]) for axis in (0, 2)
    ]
    outline = in_beam[0][:, None] | in_beam[1][None, :]  # (X, Z)
    filled = np.repeat(outline[:, None, :], len(lines[1]) - 1, axis=1)
    return _rectilinear_mesh(lines, filled)


def bored_box_mesh(
    size_mm: tuple[float, float, float],
    bore_radius_mm: float,
    bore_depth_mm: float,
    sides: int,
    spacing_mm: float,
) -> Mesh:
    """Return a box about the origin with a blind bore down from the middle of its top.

    The bore is a prism whose corners lie on the radius. The surface is one ring of points after
    another: from the middle of the underside outwards, up the sides, in over the top to the rim
    of the bore, down its wall, and in over its floor.

    Parameters
    ----------
    size_mm : tuple of 3 float
        Extent along x, y and z.
    bore_radius_mm, bore_depth_mm : float
        Within the box.
    sides : int
        Of the bore; a multiple of four, so that each side of the box has as many.
    spacing_mm : float
        How far rings lie apart at most.

    Raises
    ------
    ValueError
        If the bore does not fit or `sides` is not a multiple of four.
    """
    half = np.array(size_mm) / 2
    if not (0 < bore_radius_mm < half[:2].min() and 0 < bore_depth_mm < size_mm[2]):
        raise ValueError(f"a bore of {bore_radius_mm} by {bore_depth_mm} mm leaves the box")
    if sides < 4 or sides % 4:
        raise ValueError(f"{sides} sides, expected a multiple of four")
    # Begin in the corner at -x, -y and go round counter-clockwise, both on the box and on the bore.
    way = np.arange(sides // 4) / (sides // 4)
    corners = half[:2] * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    square = np.concatenate([a + way[:, None] * (b - a) for a, b in pairwise(corners)])
    turn = 2.0 * np.pi * np.arange(sides) / sides - 0.75 * np.pi
    bore = bore_radius_mm * np.column_stack([np.cos(turn), np.sin(turn)])

    def ring(outline: NDArray[np.float64], height_mm: float) -> NDArray[np.float64]:
        return np.column_stack([outline, np.full(sides, height_mm)])

    floor_mm = half[2] - bore_depth_mm
    bends = [  # where the surface turns; straight in between
        ring(0.0 * square, -half[2]),
        ring(square, -half[2]),
        ring(square, half[2]),
        ring(bore, half[2]),
        ring(bore, floor_mm),
        ring(0.0 * bore, floor_mm),
    ]
    rings = bends[:1]
    for start, stop in pairwise(bends):
        longest = np.linalg.norm(stop - start, axis=1).max()
        steps = int(np.ceil(longest / spacing_mm - 1e-9))
        rings += [start + (stop - start) * k / steps for k in range(1, steps + 1)]
    return _lofted_mesh(np.array(rings))


def ball_mesh(radius_mm: float, halvings: int) -> Mesh:
    """Return an icosahedron whose triangles were cut in four, all corners on the radius.

    From one cut on, the six points on the axes are corners.

    Parameters
    ----------
    radius_mm : float
        Of the sphere about it.
    halvings : int
        How often each triangle is cut: 20 * 4^halvings triangles.
    """
    golden = (1.0 + np.sqrt(5.0)) / 2.0
    signs = ((-1.0, -golden), (-1.0, golden), (1.0, -golden), (1.0, golden))
    vertices = np.array([np.roll([0.0, a, b], k) for k in range(3) for a, b in signs])
    # Neighbours are two apart; three that are all neighbours make a face.
    near = np.linalg.norm(vertices[:, None] - vertices, axis=2) < 2.1
    triples = np.array(
        [
            (i, j, k)
            for i in range(12)
            for j in range(i + 1, 12)
            for k in range(j + 1, 12)
            if near[i, j] and near[j, k] and near[i, k]
        ]
    )
    corners = vertices[triples]
    inwards = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0
    corners[inwards] = corners[inwards][:, ::-1]
    for _ in range(halvings):
        a, b, c = np.moveaxis(corners, 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        corners = np.concatenate([np.stack(part, axis=1) for part in parts])
        corners /= np.linalg.norm(corners, axis=2, keepdims=True)
    corners = radius_mm * corners / np.linalg.norm(corners, axis=2, keepdims=True)
    return _welded_mesh(corners)


def sheet_mesh(
    size_mm: tuple[float, float], cells: tuple[int, int], fold_mm: float, folds: int
) -> Mesh:
    """Return a curtain: a sheet in x and z that swings along y in upright folds; it has a border.

    Parameters
    ----------
    size_mm : tuple of 2 float
        Extent along x and z; the origin lies in the middle.
    cells : tuple of 2 int
        Into how many rectangles it is divided along x and z; each is two triangles.
    fold_mm : float
        How far the folds reach to either side of y = 0.
    folds : int
        How many there are along x.
    """
    x = np.linspace(-size_mm[0] / 2, size_mm[0] / 2, cells[0] + 1)
    z = np.linspace(-size_mm[1] / 2, size_mm[1] / 2, cells[1] + 1)
    y = fold_mm * np.sin(2.0 * np.pi * folds * (x / size_mm[0] + 0.5))
    numbers = np.arange(len(x) * len(z)).reshape(len(x), len(z))
    vertices = np.column_stack([np.repeat(x, len(z)), np.repeat(y, len(z)), np.tile(z, len(x))])
    a, b = numbers[:-1, :-1].ravel(), numbers[1:, :-1].ravel()
    c, d = numbers[1:, 1:].ravel(), numbers[:-1, 1:].ravel()
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return Mesh(vertices, faces.astype(np.int64))


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


def _lofted_mesh(rings: NDArray[np.float64]) -> Mesh:
    """Return the surface through rings (R, N, 3) of which the first and the last are a point."""
    a, d = rings[:-1], rings[1:]
    b, c = np.roll(a, -1, axis=1), np.roll(d, -1, axis=1)
    lower = np.stack([a, b, c], axis=2)[1:]  # at the first ring a and b are one point
    upper = np.stack([a, c, d], axis=2)[:-1]
    return _welded_mesh(np.concatenate([lower.reshape(-1, 3, 3), upper.reshape(-1, 3, 3)]))


def _welded_mesh(corners: NDArray[np.float64]) -> Mesh:
    """Return triangles (T, 3, 3) as a mesh; corners within a nanometre are one vertex."""
    _, first, numbers = np.unique(
        np.round(corners.reshape(-1, 3), 6), axis=0, return_index=True, return_inverse=True
    )
    return Mesh(corners.reshape(-1, 3)[first], numbers.reshape(-1, 3).astype(np.int64))
