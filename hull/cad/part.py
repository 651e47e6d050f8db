"""What a CAD file holds: parts with names, in the unit and with the axes of the file."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.polygons import Cuts

#: Which axis of a file points up.
Up = Literal["x", "y", "z"]


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """One part of a file, where the file puts it.

    Attributes
    ----------
    name : str
        As the file calls it; empty if it does not.
    vertices : (V, 3) float64
        In the unit and with the axes of the file, after the transforms of its assembly.
    faces : (T, 3) int32
        Vertex numbers, in the file's order.
    material : str
        The name of what it is made of; empty if there is none, or more than one.
    rgba : tuple of 4 floats, or None
        Its colour, 0 to 1, as a picture shows it (sRGB), and its opacity.
    cuts : Cuts
        What became of its polygons.
    off_by_m : float
        How far its triangles are from the surface that they stand for, in metres: 0 if the file is
        made of triangles or polygons, otherwise an estimate; see `hybridve.hull.cad.step`.
    rounding : float
        How far its corners may be from those that were written, in the unit of the file: what
        single precision or whole numbers leave of coordinates. 0 where the file gives digits or
        double precision, which are taken at their word, and where `off_by_m` has it in it.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    material: str = ""
    rgba: tuple[float, float, float, float] | None = None
    cuts: Cuts = field(default_factory=Cuts)
    off_by_m: float = 0.0
    rounding: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Contents:
    """What was read from a file.

    Attributes
    ----------
    parts : tuple of Part
        In the file's order.
    unit : str
        What the file says its unit is; empty if its kind does not say.
    unit_m : float or None
        That unit in metres; None if the file does not say.
    up : {"x", "y", "z"}
        The axis that points up by the file, or by the standard of its kind.
    is_ended : bool
        False if the last line of a text does not end, so that digits or corners may be missing.
    notes : tuple of str
        What the file holds besides and is not read, or leaves open; each a sentence.
    """

    parts: tuple[Part, ...]
    unit: str = ""
    unit_m: float | None = None
    up: Up = "z"
    is_ended: bool = True
    notes: tuple[str, ...] = ()


def join_meshes(
    meshes: Sequence[tuple[NDArray[np.float64], NDArray[np.int32]]],
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return several meshes, each vertices (V, 3) and faces (T, 3), as one, in their order."""
    if len(meshes) == 1:
        return meshes[0]
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])[:-1]
    return (
        np.concatenate([np.zeros((0, 3)), *(vertices for vertices, _ in meshes)]),
        np.concatenate(
            [np.zeros((0, 3), np.int32)]
            + [
                (faces + start).astype(np.int32)
                for start, (_, faces) in zip(starts, meshes, strict=True)
            ]
        ),
    )


def move(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], matrix: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return a mesh moved by a matrix (4, 4); a mirror image keeps its outside outside."""
    if np.array_equal(matrix, np.eye(4)):
        return vertices, faces
    moved = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    mirrors = np.linalg.det(matrix[:3, :3]) < 0
    return moved, np.ascontiguousarray(faces[:, [0, 2, 1]]) if mirrors else faces


def join_parts(parts: Sequence[Part]) -> Part:
    """Return all parts as one without a name; what they are made of stays if it is one thing."""
    if len(parts) == 1:
        return parts[0]
    vertices, faces = join_meshes([(part.vertices, part.faces) for part in parts])
    made_of = {(part.material, part.rgba) for part in parts}
    material, rgba = made_of.pop() if len(made_of) == 1 else ("", None)
    cuts = sum((part.cuts for part in parts), Cuts())
    off_by_m = max(part.off_by_m for part in parts)
    rounding = max(part.rounding for part in parts)
    return Part("", vertices, faces, material, rgba, cuts, off_by_m, rounding)


def single_rounding(vertices: NDArray[np.generic]) -> float:
    """Return how far single precision may have moved one of the vertices (V, 3).

    Each coordinate by half of what lies between two numbers there; 0 if they are of another kind.
    """
    if vertices.dtype.kind != "f" or vertices.dtype.itemsize != np.dtype(np.float32).itemsize:
        return 0.0
    farthest = np.abs(vertices).max(axis=0, initial=0.0).astype(np.float32)
    with np.errstate(invalid="ignore"):  # what is not finite is refused elsewhere
        return float(np.linalg.norm(np.spacing(farthest).astype(np.float64))) / 2.0


def strip_triangles(corners: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the triangles (T, 3) of a strip of corners (C,), all with the sense of the first."""
    if len(corners) < 3:
        return np.zeros((0, 3), np.int32)
    faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    faces[1::2] = faces[1::2][:, [0, 2, 1]]  # every other one would be the other way round
    return faces.astype(np.int32)


def fan_triangles(corners: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the triangles (T, 3) of a fan of corners (C,) about the first."""
    if len(corners) < 3:
        return np.zeros((0, 3), np.int32)
    hub = np.full(len(corners) - 2, corners[0])
    return np.stack([corners[1:-1], corners[2:], hub], axis=1).astype(np.int32)
