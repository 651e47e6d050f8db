"""What of each object was touched in each frame, as a viewer shows it: triangles and points."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.report.collisions import Runs, StoredMesh
from hybridve.hull.report.columns import RUN_COLUMNS, RUN_OFFSET
from hybridve.hull.report.read import local_origin_m, read_mesh
from hybridve.hull.report.result_file import reading
from hybridve.hull.report.schema import READ_VERSIONS


@dataclass(frozen=True, slots=True, eq=False)
class Touched:
    """One object of a report: where it stood, and what of it was touched.

    Attributes
    ----------
    mesh : StoredMesh
        Its mesh; placements are metres about the report's local origin.
    runs : Runs
        Collision points of all frames, frame after frame.
    offset : (F + 1,) int64
        Those of row f are ``offset[f]`` to ``offset[f + 1]``.
    """

    mesh: StoredMesh
    runs: Runs
    offset: NDArray[np.int64]

    def triangles(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the numbers (K,) of the touched triangles, ascending in each frame, and offsets.

        Those of row f are ``offset[f]`` to ``offset[f + 1]`` (F + 1,).
        """
        from hybridve.hull.query.viewport import samples_before  # late: compiled code

        order = self.mesh.order.astype(np.int64)
        n_rows, n_triangles = len(self.offset) - 1, len(order)
        before = samples_before(self.mesh.viewport[order].astype(np.int32))
        place = np.zeros(n_triangles, np.int64)
        place[order] = np.arange(n_triangles)
        first = place[self.runs.triangle]
        last_sample = before[first] + self.runs.first + self.runs.count.astype(np.int64) - 1
        last = np.searchsorted(before, last_sample, side="right") - 1
        counts = last - first + 1
        row = np.repeat(np.arange(n_rows), np.diff(self.offset))
        steps = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
        number = order[np.repeat(first, counts) + steps]
        keys = np.unique(np.repeat(row, counts) * n_triangles + number)
        rows, triangles = np.divmod(keys, max(n_triangles, 1))
        return triangles, np.searchsorted(rows, np.arange(n_rows + 1))

    def points(self, row: int, most: int | None = None) -> NDArray[np.float64]:
        """Return collision points (P, 3) of a row, metres about the report's local origin.

        With `most`, every k-th only, at most so many.
        """
        start, stop = (int(one) for one in self.offset[row : row + 2])
        if start == stop:
            return np.zeros((0, 3))
        return self.mesh.points(self.runs.part(start, stop), row, most)[0]


def read_touched(path: Path) -> tuple[NDArray[np.float64], dict[str, Touched]]:
    """Return a report's local origin (3,), metres, and its objects by name.

    A report of version 1 holds no meshes: it has none.

    Raises
    ------
    ReportError
        As `hybridve.hull.report.read.read_report`.
    """
    with reading(path, "report", *READ_VERSIONS) as file:
        found = {
            name: Touched(
                read_mesh(group),
                Runs(*(group[column.name][:] for column in RUN_COLUMNS)),
                group[RUN_OFFSET.name][:].astype(np.int64),
            )
            for name, group in file["hybridve/objects"].items()
            if RUN_OFFSET.name in group
        }
        return local_origin_m(file), found
