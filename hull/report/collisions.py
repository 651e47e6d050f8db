"""Collision points as a report keeps them: runs of consecutive samples, and the mesh they are on.

A run names a triangle, the number of its first sample there (`hybridve.hull.query.viewport` numbers
them), and how many samples it has. It goes on through the triangles that follow in the order that
the report gives, so that a swallowed mesh is one run. Runs, the placed mesh and the viewports are
the points CP_i, to the last digit: nothing is rounded, and few bytes are kept of millions.
"""

import hashlib
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import placed

#: Samples in one run at most: what 32 bits count.
_MOST_IN_RUN = 2**32 - 1


@dataclass(frozen=True, slots=True, eq=False)
class StoredMesh:
    """The mesh of one object as a report holds it.

    Attributes
    ----------
    vertices_m : (V, 3) float64
        In the frame of the mesh, metres.
    faces : (T, 3) int32
        Vertex numbers, triangles as the scene numbers them.
    viewport : (T,) uint16
        Samples along an edge of each.
    order : (T,) uint32
        The triangles in the order in which runs go on through them.
    placement : (1 or F, 3, 4) float64
        From the frame of the mesh to the report's, metres about its local origin: where the object
        stood; of one that moves, a row a frame, NaN where that is not known.
    """

    vertices_m: NDArray[np.float64]
    faces: NDArray[np.int32]
    viewport: NDArray[np.uint16]
    order: NDArray[np.uint32]
    placement: NDArray[np.float64]

    @property
    def sha256(self) -> str:
        """The checksum of vertices and faces: the same for the same CAD, wherever it stands."""
        digest = hashlib.sha256(np.ascontiguousarray(self.vertices_m, "<f8").tobytes())
        digest.update(np.ascontiguousarray(self.faces, "<i4").tobytes())
        return digest.hexdigest()

    def vertices_at(self, row: int) -> NDArray[np.float64]:
        """Return the vertices (V, 3) in the report's frame, as they stood in one of its rows."""
        return placed(self.vertices_m, self.placement[row if len(self.placement) > 1 else 0])

    def points(
        self, runs: "Runs", row: int, most: int | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
        """Return the samples of runs (P, 3), in the report's frame, and each one's triangle (P,).

        Parameters
        ----------
        runs : Runs
            Of one row.
        row : int
            Which, for where an object that moves stood.
        most : int, optional
            Only every k-th sample, at most so many.
        """
        # Late: it brings compiled code, for which a summary need not wait.
        from hybridve.hull.query.viewport import place_runs, samples_before, thinned_samples

        viewports = self.viewport[self.order].astype(np.int32)
        before = samples_before(viewports)
        place = np.zeros(len(self.order), np.int64)
        place[self.order] = np.arange(len(self.order))
        start = before[place[runs.triangle]] + runs.first
        stop = start + runs.count
        if most is not None:
            start = thinned_samples(start, stop, most)
            stop = start + 1
        triangle, xyz_m = place_runs(
            start,
            stop,
            before,
            self.vertices_at(row),
            self.faces[self.order],
            viewports,
        )
        return xyz_m, self.order[triangle]


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """Runs of consecutive samples, R of them, in the order of the mesh.

    Attributes
    ----------
    triangle : (R,) uint32
        The triangle that each begins in, as the scene numbers it.
    first : (R,) uint32
        The number of its first sample in that triangle's viewport.
    count : (R,) uint32
        How many samples it has.
    """

    triangle: NDArray[np.uint32]
    first: NDArray[np.uint32]
    count: NDArray[np.uint32]

    def __len__(self) -> int:
        return len(self.triangle)

    @classmethod
    def of(
        cls,
        start: NDArray[np.int64],
        stop: NDArray[np.int64],
        samples_before: NDArray[np.int64],
        numbers: NDArray[np.uint32],
    ) -> Self:
        """Return the runs of samples that are numbered through a mesh.

        Parameters
        ----------
        start, stop : (R,) int64
            As `hybridve.hull.query.engine.Hits` has them.
        samples_before : (T + 1,) int64
            Of the mesh.
        numbers : (T,) uint32
            What the scene calls its triangles.
        """
        if len(start) and int((stop - start).max()) > _MOST_IN_RUN:
            begins = [
                np.arange(first, last, _MOST_IN_RUN)
                for first, last in zip(start.tolist(), stop.tolist(), strict=True)
            ]
            start = np.concatenate(begins)
            stop = np.minimum(start + _MOST_IN_RUN, np.repeat(stop, [len(one) for one in begins]))
        place = np.searchsorted(samples_before, start, side="right") - 1
        return cls(
            numbers[place],
            (start - samples_before[place]).astype(np.uint32),
            (stop - start).astype(np.uint32),
        )

    def part(self, start: int, stop: int) -> "Runs":
        """Return the runs from one number to before another."""
        return Runs(self.triangle[start:stop], self.first[start:stop], self.count[start:stop])
