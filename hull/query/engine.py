"""The one interface of the volume query, and which engine serves it.

Four rooms stand behind it: ``reference`` (the specification, float64 NumPy), ``native`` (numba on
the CPU), ``compute`` (OpenGL 4.3 compute) and ``stencil`` (the paper's multi-pass method). They
return the same samples, except those that project within 1e-3 px of a pixel edge.
"""

from dataclasses import dataclass
from types import TracebackType
from typing import Any, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.viewport import MAX_VIEWPORT

EngineName = Literal["auto", "compute", "native", "reference"]


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Triangles:
    """A triangle mesh in the world, with the viewport of each triangle.

    Engines keep what they derive from it (uploads, bounds) for as long as the object lives, so
    pass the same object for every frame in which the mesh does not move. Its arrays are private
    copies that cannot be written to; an array that is read-only already is taken as it is, so
    ``dataclasses.replace(triangles, vertices_world=...)`` moves a mesh without copying the rest.

    Attributes
    ----------
    vertices_world : (V, 3) float64
        Metres.
    faces : (T, 3) int32
        Vertex numbers.
    viewports : (T,) int32
        Samples along an edge of each triangle; see `hybridve.hull.query.viewport`.

    Raises
    ------
    ValueError
        If a shape is wrong, a coordinate is not finite, a face names no vertex, or a viewport is
        not within 1..`MAX_VIEWPORT`.
    """

    vertices_world: NDArray[np.float64]
    faces: NDArray[np.int32]
    viewports: NDArray[np.int32]

    def __post_init__(self) -> None:
        vertices_world = _private(self.vertices_world, np.float64, (3,), "vertices_world")
        faces = _private(self.faces, np.int32, (3,), "faces")
        viewports = _private(self.viewports, np.int32, (), "viewports")
        if len(viewports) != len(faces):
            raise ValueError(f"{len(viewports)} viewports for {len(faces)} triangles")
        # A sum is finite only where every summand is: one pass over millions of coordinates.
        with np.errstate(over="ignore", invalid="ignore"):
            total = vertices_world.sum()
        if not np.isfinite(total) and not np.isfinite(vertices_world).all():
            vertex = int(np.flatnonzero(~np.isfinite(vertices_world).all(axis=1))[0])
            raise ValueError(f"vertex {vertex} is not finite: {vertices_world[vertex]}")
        if len(faces):
            if faces.min() < 0 or faces.max() >= len(vertices_world):
                face = int(
                    np.flatnonzero(((faces < 0) | (faces >= len(vertices_world))).any(axis=1))[0]
                )
                raise ValueError(
                    f"triangle {face} has vertices {faces[face].tolist()}, "
                    f"expected numbers below {len(vertices_world)}"
                )
            if viewports.min() < 1 or viewports.max() > MAX_VIEWPORT:
                triangle = int(np.flatnonzero((viewports < 1) | (viewports > MAX_VIEWPORT))[0])
                raise ValueError(
                    f"triangle {triangle} has viewport {viewports[triangle]}, "
                    f"expected 1..{MAX_VIEWPORT}"
                )
        object.__setattr__(self, "vertices_world", vertices_world)
        object.__setattr__(self, "faces", faces)
        object.__setattr__(self, "viewports", viewports)

    def __len__(self) -> int:
        return len(self.faces)

    @property
    def corners_world(self) -> NDArray[np.float64]:
        """The vertices a, b, c of each triangle, (T, 3, 3) metres."""
        return self.vertices_world[self.faces]


def _private(
    given: NDArray[Any], dtype: type[np.generic], shape: tuple[int, ...], name: str
) -> NDArray[Any]:
    """Return `given` as a contiguous array that cannot be written to, copied unless it is one."""
    value = np.ascontiguousarray(given)
    if value.shape[1:] != shape or value.ndim != len(shape) + 1:
        expected = ", ".join(["N", *map(str, shape)])
        raise ValueError(f"{name} has shape {value.shape}, expected ({expected})")
    if value.dtype == dtype and not value.flags.writeable:
        return value
    private = value.astype(dtype, casting="same_kind")
    if value.dtype.kind in "iu" and value.dtype != dtype and (private != value).any():
        raise ValueError(f"{name} holds a number that does not fit {np.dtype(dtype)}")
    private.flags.writeable = False
    return private


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """The samples inside the hull, sorted by triangle, then sample.

    Attributes
    ----------
    triangle : (P,) uint32
        Number of the triangle in its mesh.
    sample : (P,) uint32
        Number of the sample in the triangle's viewport.
    """

    triangle: NDArray[np.uint32]
    sample: NDArray[np.uint32]

    def __len__(self) -> int:
        return len(self.triangle)


class Engine(Protocol):
    """What answers the volume query.

    Attributes
    ----------
    name : str
        The engine's room.
    renderer : str
        What does the work on this machine, for reports.
    """

    name: str
    renderer: str

    def query(self, hull: Hull, meshes: list[Triangles]) -> list[Hits]:
        """Return for each mesh its samples inside the hull of this frame."""
        ...

    def close(self) -> None:
        """Release what the engine holds: threads, memory on the device."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None: ...
