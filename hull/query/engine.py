"""The one interface of the volume query, and which engine serves it.

Four rooms stand behind it: ``reference`` (the specification, float64 NumPy), ``native`` (numba on
the CPU), ``compute`` (OpenGL 4.3 compute) and ``stencil`` (the paper's multi-pass method). They
return the same samples, except those that project within 1e-3 px of a pixel edge.
"""

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.silhouettes import Hull

EngineName = Literal["auto", "compute", "native", "reference"]


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Triangles:
    """A triangle mesh in the world, with the viewport of each triangle.

    Engines keep what they derive from it (uploads, bounds) for as long as the object lives, so
    pass the same object for every frame in which the mesh does not move.

    Attributes
    ----------
    vertices_world : (V, 3) float64
        Metres.
    faces : (T, 3) int32
        Vertex numbers.
    viewports : (T,) int32
        Samples along an edge of each triangle; see `hybridve.hull.query.viewport`.
    """

    vertices_world: NDArray[np.float64]
    faces: NDArray[np.int32]
    viewports: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.faces)

    @property
    def corners_world(self) -> NDArray[np.float64]:
        """The vertices a, b, c of each triangle, (T, 3, 3) metres."""
        return self.vertices_world[self.faces]


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
        """Release what the engine holds on the device."""
        ...
