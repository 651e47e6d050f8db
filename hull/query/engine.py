"""The one interface of the volume query, and which engine serves it.

Four rooms stand behind it: ``reference`` (the specification, float64 NumPy), ``native`` (numba on
the CPU), ``compute`` (OpenGL 4.3 compute) and ``stencil`` (the paper's multi-pass method). They
return the same samples, except those that project within 1e-3 px of a pixel edge.
"""

from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.rectangles import PreparedMesh
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.viewport import (
    MAX_VIEWPORT,
    expand_runs,
    read_only,
    run_ends,
    samples_before,
    thinned_samples,
)

#: The largest coordinate of a vertex, metres. Squares of what is projected must not overflow in
#: single precision, in which graphics hardware computes; nobody's CAD is a hundred light years.
MAX_COORDINATE_M = 1e18

EngineName = Literal["auto", "compute", "native", "stencil", "reference"]


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Topology:
    """What of a mesh stays the same when its vertices move.

    Attributes
    ----------
    faces : (T, 3) int32
        Vertex numbers.
    viewports : (T,) int32
        Samples along an edge of each triangle.
    samples_before : (T + 1,) int64
        How many samples all triangles before each have: samples are numbered through the mesh.
    """

    faces: NDArray[np.int32]
    viewports: NDArray[np.int32]
    samples_before: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.faces)


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Triangles:
    """A triangle mesh in the world, with the viewport of each triangle.

    Engines keep what they derive from it (uploads, bounds) for as long as the object lives, so
    pass the same object for every frame in which the mesh does not move, and `moved` gives the
    one to pass where it does: what does not depend on the vertices is kept then, too. Neighbours
    should stand next to each other (`hybridve.hull.query.clusters.spatial_order`): engines ask
    runs of consecutive triangles together. The arrays are private copies that cannot be written
    to; an array that is read-only already is taken as it is.

    Attributes
    ----------
    vertices_world : (V, 3) float64
        Metres.
    faces : (T, 3) int32
        Vertex numbers.
    viewports : (T,) int32
        Samples along an edge of each triangle; see `hybridve.hull.query.viewport`.
    topology : Topology
        The last two and what follows from them; one object for all that `moved` returns.
    prepared : PreparedMesh or None
        What was derived from it for the cameras that asked last; see `hold`.

    Raises
    ------
    ValueError
        If a shape is wrong, a coordinate is not finite or beyond `MAX_COORDINATE_M`, a face names
        no vertex, or a viewport is not within 1..`MAX_VIEWPORT`.
    """

    vertices_world: NDArray[np.float64]
    faces: NDArray[np.int32]
    viewports: NDArray[np.int32]
    topology: Topology = field(init=False)
    prepared: PreparedMesh | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        vertices_world = checked_vertices(self.vertices_world)
        faces = _private(self.faces, np.int32, (3,), "faces")
        viewports = _private(self.viewports, np.int32, (), "viewports")
        if len(viewports) != len(faces):
            raise ValueError(f"{len(viewports)} viewports for {len(faces)} triangles")
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
        topology = Topology(faces, viewports, samples_before(viewports))
        object.__setattr__(self, "topology", topology)

    def moved(self, vertices_world: NDArray[np.float64]) -> "Triangles":
        """Return the same triangles with their vertices elsewhere: (V, 3) metres, world.

        Raises
        ------
        ValueError
            If there is another number of vertices, or a coordinate is not finite.
        """
        if np.shape(vertices_world) != self.vertices_world.shape:
            raise ValueError(
                f"vertices_world has shape {np.shape(vertices_world)}, "
                f"expected {self.vertices_world.shape}"
            )
        moved = object.__new__(Triangles)
        object.__setattr__(moved, "vertices_world", checked_vertices(vertices_world))
        for name in ("faces", "viewports", "topology"):
            object.__setattr__(moved, name, getattr(self, name))
        moved.hold(None)
        return moved

    def hold(self, prepared: PreparedMesh | None) -> None:
        """Keep what was derived from this mesh, in place of what was kept before."""
        object.__setattr__(self, "prepared", prepared)

    def __len__(self) -> int:
        return len(self.faces)

    @property
    def corners_world(self) -> NDArray[np.float64]:
        """The vertices a, b, c of each triangle, (T, 3, 3) metres."""
        return self.vertices_world[self.faces]


def checked_vertices(given: NDArray[Any]) -> NDArray[np.float64]:
    """Return vertices (V, 3) as an array that cannot be written to, if all are usable numbers.

    Raises
    ------
    ValueError
        If the shape is wrong, or a coordinate is not finite or beyond `MAX_COORDINATE_M`: with the
        vertex's number.
    """
    vertices_world = _private(given, np.float64, (3,), "vertices_world")
    if len(vertices_world) == 0:
        return vertices_world
    # What is not a number is neither above nor below a limit, and hands itself on to both ends.
    lowest, highest = vertices_world.min(), vertices_world.max()
    if not (lowest >= -MAX_COORDINATE_M and highest <= MAX_COORDINATE_M):
        is_usable = np.isfinite(vertices_world).all(axis=1)
        if not is_usable.all():
            vertex = int(is_usable.argmin())
            raise ValueError(f"vertex {vertex} is not finite: {vertices_world[vertex]}")
        vertex = int(np.abs(vertices_world).max(axis=1).argmax())
        raise ValueError(
            f"vertex {vertex} is {vertices_world[vertex]}, "
            f"expected coordinates within {MAX_COORDINATE_M:.0e} m"
        )
    return vertices_world


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
    """The samples of a mesh that are inside the hull, as runs of consecutive samples.

    Samples are numbered through the mesh: sample s of triangle t is number
    ``topology.samples_before[t] + s``. Where the hull swallows whole triangles, or the whole mesh,
    one run says so, and nobody waits for millions of numbers that he may not want.

    Attributes
    ----------
    topology : Topology
        Of the mesh.
    start, stop : (R,) int64
        The first sample of each run, and the one after its last; runs are ascending, not empty,
        and do not overlap. Where one ends, the next may begin.
    """

    topology: Topology
    start: NDArray[np.int64]
    stop: NDArray[np.int64]

    @classmethod
    def from_samples(
        cls, topology: Topology, triangle: NDArray[np.uint32], sample: NDArray[np.uint32]
    ) -> Self:
        """Return hits from (P,) triangles and sample numbers in their viewports, ascending."""
        number = topology.samples_before[triangle] + sample
        is_first = np.diff(number, prepend=-2) != 1
        start = number[is_first]
        stop = number[np.append(is_first[1:], True)[: len(number)]] + 1
        return cls(topology, start, stop)

    @classmethod
    def none(cls, topology: Topology) -> Self:
        """Return no hits."""
        return cls(topology, np.zeros(0, np.int64), np.zeros(0, np.int64))

    def __len__(self) -> int:
        return int((self.stop - self.start).sum())

    def samples(self, most: int | None = None) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
        """Return triangle and number in its viewport of each sample, (P,) and (P,), ascending.

        With `most`, only of the first so many.
        """
        count = len(self) if most is None else min(most, len(self))
        triangle, sample = np.zeros(count, np.uint32), np.zeros(count, np.uint32)
        expand_runs(self.start, self.stop, self.topology.samples_before, triangle, sample)
        return triangle, sample

    def touched(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the triangles with a sample inside, ascending, and the first such sample of each.

        Without writing out the samples, which may be millions.
        """
        before = self.topology.samples_before
        first = np.searchsorted(before, self.start, side="right") - 1
        last = np.searchsorted(before, self.stop - 1, side="right") - 1
        steps = np.zeros(len(before), np.int64)
        np.add.at(steps, first, 1)
        np.add.at(steps, last + 1, -1)
        triangle = np.flatnonzero(np.cumsum(steps[:-1]) > 0)
        sample = np.zeros(len(triangle), np.int64)
        # A run begins in its first triangle and goes on from sample 0 of those that follow. Where a
        # run from before reaches into the triangle, sample 0 is the first.
        begins, run = np.unique(first, return_index=True)
        at = np.searchsorted(triangle, begins)
        sample[at] = self.start[run] - before[begins]
        reached = np.unique(last[last > first])
        sample[np.searchsorted(triangle, reached)] = 0
        return triangle, sample

    def thinned(self, most: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return triangle and sample of every k-th of the samples inside, at most so many."""
        return self.at(thinned_samples(self.start, self.stop, most))

    def at(self, number: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return triangle and number in its viewport of samples (N,) numbered through the mesh."""
        before = self.topology.samples_before
        triangle = np.searchsorted(before, number, side="right") - 1
        return triangle, number - before[triangle]

    def ends(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return triangle and sample of those among which is the farthest from any point."""
        topology = self.topology
        ends = run_ends(
            read_only(self.start),
            read_only(self.stop),
            topology.samples_before,
            topology.viewports,
        )
        return self.at(ends)


class Closing:
    """What a ``with`` statement closes at its end."""

    def close(self) -> None:
        """Release what is held."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


class Engine(Protocol):
    """What answers the volume query.

    Attributes
    ----------
    name : str
        The engine's room.
    renderer : str
        What does the work on this machine, for reports.
    any_thread : bool
        Whether any thread may ask it, also several at once; else only the one that opened it.
    """

    name: str
    renderer: str
    any_thread: bool

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
