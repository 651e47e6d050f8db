"""Where the hull is, roughly: boxes of space that no camera's silhouette rejects."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.bounds import FREE, verdicts
from hybridve.hull.query.silhouettes import Hull

#: Cells along an edge of the first cube.
_FIRST_SPLIT = 8

#: Cells are halved until there would be more than so many, or they are this share of the reach;
#: not until the box around them is so many cells long, since a stray cell where the planes of all
#: cameras meet is proved free only when it is small.
_MOST_CELLS = 24_000
_SMALLEST_EDGE = 1e-5

#: The first cube reaches this much farther than the farthest camera or object.
_REACH = 1.5

#: How far to look where neither cameras nor objects give a scale, in metres.
_DEFAULT_REACH_M = 10.0

_CORNERS = np.array([[i >> axis & 1 for axis in range(3)] for i in range(8)], np.float64)  # (8, 3)


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Cubes that together contain the hull.

    Attributes
    ----------
    centers_local : (N, 3) float64
        Metres in the local frame of the hull's views; N = 0 for an empty hull.
    edge_m : float
        Edge of each cube.
    """

    centers_local: NDArray[np.float64]
    edge_m: float

    def __len__(self) -> int:
        return len(self.centers_local)

    def box_local(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lower and upper corner of the box around all cells; both 0 for none."""
        if len(self) == 0:
            return np.zeros(3), np.zeros(3)
        half = self.edge_m / 2
        return self.centers_local.min(axis=0) - half, self.centers_local.max(axis=0) + half


def hull_cells(
    hull: Hull, points_world: NDArray[np.float64] | None = None, most: int = _MOST_CELLS
) -> Cells:
    """Return cubes that contain the hull, as far as anybody looks.

    The space looked at is a cube about the views' local origin, half as large again as the
    distance of the farthest camera or of the farthest of `points_world`. What few cameras bound
    reaches to infinity; it is cut there.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    points_world : (P, 3) float64, optional
        What else the scene holds, in metres.
    most : int
        How many cubes at most; few tell sooner, and more roughly, where the hull is.
    """
    views = hull.views
    reach_m = float(np.linalg.norm(views.centers_local(), axis=1).max())
    if points_world is not None and len(points_world):
        reach_m = max(reach_m, float(np.abs(points_world - views.origin_world).max()))
    reach_m = _REACH * reach_m if reach_m > 0 else _DEFAULT_REACH_M

    edge_m = 2 * reach_m / _FIRST_SPLIT
    steps = (np.arange(_FIRST_SPLIT) + 0.5) * edge_m - reach_m
    cells = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    while True:
        corners = cells[:, None] + (_CORNERS - 0.5) * edge_m  # (N, 8, 3)
        cells = cells[verdicts(hull, corners) != FREE]
        if len(cells) == 0:
            break
        if 8 * len(cells) > most or edge_m < _SMALLEST_EDGE * reach_m:
            break
        edge_m /= 2
        cells = (cells[:, None] + (_CORNERS - 0.5) * edge_m).reshape(-1, 3)
    return Cells(cells, edge_m)
