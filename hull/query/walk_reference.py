"""The specification of `hybridve.hull.query.walk`, in float64 NumPy. Plain rather than fast."""

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.walk import least_stretches


def spans_in_hull(
    hull: Hull,
    origin_world: NDArray[np.float64],
    direction: NDArray[np.float64],
    reach_m: float,
) -> NDArray[np.float64]:
    """Return the stretches (N, 2) of a ray that lie in the hull, metres.

    All columns, all rows and the plane of depth 0 of all cameras cut the ray. Each piece is what
    its middle is.
    """
    views = hull.views
    (least_m,) = least_stretches(views, origin_world[None])
    unit = direction / np.linalg.norm(direction)
    cuts_m = [np.array([0.0, reach_m])]
    for matrix, sizes in zip(views.img_from_local, views.sizes_px.tolist(), strict=True):
        begin = matrix[:, :3] @ (origin_world - views.origin_world) + matrix[:, 3]
        step = matrix[:, :3] @ unit
        with np.errstate(divide="ignore", invalid="ignore"):
            cuts_m.append(-begin[2:] / step[2:])
            for axis, size in enumerate(sizes):
                k = np.arange(size + 1)
                cuts_m.append((k * begin[2] - begin[axis]) / (step[axis] - k * step[2]))
    cut_m = np.concatenate(cuts_m)
    edges_m = np.unique(cut_m[(cut_m >= 0) & (cut_m <= reach_m)])
    middles_m = 0.5 * (edges_m[:-1] + edges_m[1:])
    inside = contains_points(hull, origin_world + middles_m[:, None] * unit)
    changes = np.diff(np.concatenate([[0], inside.astype(np.int8), [0]]))
    spans_m = np.column_stack([edges_m[changes == 1], edges_m[changes == -1]])
    is_gap = spans_m[1:, 0] - spans_m[:-1, 1] > least_m
    some = np.full(min(len(spans_m), 1), True)
    begins_m = spans_m[np.concatenate([some, is_gap]), 0]
    ends_m = spans_m[np.concatenate([is_gap, some]), 1]
    is_told = ends_m - begins_m > least_m
    return np.asarray(np.column_stack([begins_m, ends_m])[is_told])
