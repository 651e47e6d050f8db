"""The specification of `hybridve.hull.query.certify`, in float64 NumPy. Plain rather than fast."""

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.bounds import FREE as ALL_FREE
from hybridve.hull.query.bounds import ROUNDOFF_FLOAT64, verdicts
from hybridve.hull.query.certify import COLLIDING, FREE, LEAF_EDGE, OPEN
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull


def certify_triangle(
    hull: Hull, corners_world: NDArray[np.float64], open_at_m: float, most_cells: int
) -> tuple[int, NDArray[np.float64], float]:
    """Return verdict, witness (3,) and `open_at_m` of a triangle (3, 3); NaN where there is none.

    All waiting cells are asked together, from large to small.
    """
    cells = (corners_world - hull.views.origin_world)[None]  # (N, 3, 3)
    n_made, edges_m = 1, [np.zeros(0)]
    while len(cells):
        cells = cells[verdicts(hull, cells, 3.0 * ROUNDOFF_FLOAT64) != ALL_FREE]
        middles = cells.mean(axis=1) + hull.views.origin_world
        inside = contains_points(hull, middles)
        if inside.any():
            return COLLIDING, middles[inside][0], np.nan
        sides_m = np.linalg.norm(np.roll(cells, -1, axis=1) - cells, axis=2)  # (N, 3)
        longest_m, corner = sides_m.max(axis=1, initial=0.0), sides_m.argmax(axis=1)
        room = max(0, (most_cells - n_made) // 2)
        is_cut = longest_m > LEAF_EDGE * open_at_m
        is_cut &= np.cumsum(is_cut) <= room
        edges_m.append(longest_m[~is_cut])
        n_made += 2 * int(is_cut.sum())
        cells, corner = cells[is_cut], corner[is_cut]
        number = np.arange(len(cells))
        following = (corner + 1) % 3
        middle = (cells[number, corner] + cells[number, following]) / 2
        halves = np.repeat(cells, 2, axis=0)
        halves[2 * number, corner] = middle
        halves[2 * number + 1, following] = middle
        cells = halves
    open_m = np.concatenate(edges_m)
    if len(open_m) == 0:
        return FREE, np.full(3, np.nan), np.nan
    return OPEN, np.full(3, np.nan), float(open_m.max()) / LEAF_EDGE
