"""What the rectangle around a projection proves: no point inside the hull, or every point.

A set of points (a triangle, a tile of its samples, a box) is given by the corners of a convex
hull that contains it. Where all corners lie in front of a camera, the set projects inside the
bounding rectangle of its projected corners, and four look-ups in the integral image count the
object pixels in that rectangle. None: this camera sees no object pixel at any point of the set.
All: it sees one at every point. The rectangles of all cameras together give a verdict:

* `FREE`: proved, no point of the set is inside the hull.
* `FULL`: proved, every point is.
* `OPEN`: look closer.

A camera that may abstain (``unseen = "keep"``) rejects only where the rectangle lies wholly inside
its image and holds no pixel but recorded ones, which four look-ups in another integral image count:
beyond these it says nothing. Where it sees no object pixel in a rectangle that it does not see
whole, it *withholds*: whatever point of the set it does not reject, it does not see. So the set is
free as well where fewer than ``min_cameras`` cameras do see an object pixel.

Why rounding cannot turn the proof into a guess
-----------------------------------------------
Let u be the unit roundoff, M_j the largest coordinate j of a corner, and P a projection matrix,
so that every point of the set has homogeneous coordinates |h_k| <= B_k = sum_j |P_kj| M_j + |P_k4|.
Write the computed value of a number with a hat.

1. A sample is a + (b - a) s + (c - a) t. Computed in any order, coordinate j is off by at most
   24 u M_j (differences are at most 2 M_j, the partial sums at most 5 M_j), and its projection,
   a dot product of four terms, by 4 u B_k more. Computed from projected corners instead,
   P a + s P (b - a) + t P (c - a), it is off by at most 22 u B_k. Rounding P and the corners to
   single precision first adds 2 u B_k. In all cases |h^_k - h_k| <= e_k with e_k = 32 u B_k.
2. Where h^_z >= 20 e_z, the pixel p = h_x / h_z is off by at most
   (e_x + |p| e_z) / (h^_z - e_z) <= 20/19 (e_x + |p| e_z) / h^_z. Rounding of the division itself
   (up to 5 u |p| in graphics hardware) is below a sixth of the term |p| e_z / h^_z, since
   B_z >= |h_z|.
3. A sample is a convex combination of the corners, so its exact pixel lies between the exact
   pixels of the corners. Both the sample and the corner are off by step 2: a computed sample lies
   inside the computed rectangle widened by 2.5 (e_x + |p| e_z) / z, with z the smallest h^_z of a
   corner (2 * 20/19 + 2 * 1/6 < 2.5).
4. In the pad, R = 2 max(width, height) stands for |p|. A point beyond R is computed beyond 0.8 R
   where e_x <= R z / 20: outside the image, whatever the pad. This, and step 2, hold where
   z >= n = 20 (max(e_x, e_y) / R + e_z), and there the pad is at most R / 8. Elsewhere the
   rectangle is taken to be the whole plane, unless every corner has h^_z <= -n: then every sample
   is computed behind the camera.

So a verdict holds for each sample as an engine computes it, not only for the sample as it is
meant. `rectangle_pads` gives the three constants of a camera: 2.5 (e_x + R e_z), the same for y,
and n. In double precision the pad is around 1e-10 px, in single precision some hundredths.
"""

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.silhouettes import Hull, Views

#: Verdicts; `native` knows the same numbers.
FREE, OPEN, FULL = 0, 1, 2

#: Unit roundoff of the two precisions that engines compute in.
ROUNDOFF_FLOAT64 = 2.0**-53
ROUNDOFF_FLOAT32 = 2.0**-24

#: Depth by which no engine divides by zero, in either precision.
_SMALLEST_NEAR_M = 1e-30

#: Corners that `verdicts` takes at a time: bounds its memory to some 100 MB.
_CHUNK = 1 << 18


def rectangle_pads(
    views: Views, reach_m: NDArray[np.float64], roundoff: float
) -> NDArray[np.float64]:
    """Return the constants that widen a camera's rectangles until rounding cannot matter.

    Parameters
    ----------
    views : Views
        C cameras.
    reach_m : (..., 3) float64
        The largest absolute coordinates of any corner, in metres, in the local frame of `views`.
    roundoff : float
        Unit roundoff of the precision that corners and samples are projected in.

    Returns
    -------
    (..., C, 3) float64
        By how many pixels times metres of depth a rectangle grows in x and in y, and the depth in
        metres from which on this holds. A rectangle whose nearest corner is z metres deep grows
        by the first two divided by z.
    """
    matrices = np.abs(views.img_from_local)
    largest = np.einsum("ckj,...j->...ck", matrices[:, :, :3], reach_m) + matrices[:, :, 3]
    error = 32.0 * roundoff * largest  # (..., C, 3)
    far_px = 2.0 * views.sizes_px.max(axis=1)  # R
    pad_x = 2.5 * (error[..., 0] + far_px * error[..., 2])
    pad_y = 2.5 * (error[..., 1] + far_px * error[..., 2])
    near_m = np.maximum(8.0 * np.maximum(pad_x, pad_y) / far_px, _SMALLEST_NEAR_M)
    return np.stack([pad_x, pad_y, near_m], axis=-1)


def verdicts(
    hull: Hull, corners_local: NDArray[np.float64], roundoff: float = ROUNDOFF_FLOAT64
) -> NDArray[np.int8]:
    """Return what the rectangles prove of sets of points.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    corners_local : (N, K, 3) float64
        The K corners of a convex hull around each set, in metres in the local frame of the views.
    roundoff : float
        Unit roundoff to allow for.

    Returns
    -------
    (N,) int8
        `FREE`, `FULL` or `OPEN`.
    """
    result = np.zeros(len(corners_local), np.int8)
    step = max(1, _CHUNK // max(1, corners_local.shape[1] * len(hull.views)))
    for start in range(0, len(corners_local), step):
        chunk = corners_local[start : start + step]
        result[start : start + step] = _chunk_verdicts(hull, chunk, roundoff)
    return result


def _chunk_verdicts(
    hull: Hull, corners_local: NDArray[np.float64], roundoff: float
) -> NDArray[np.int8]:
    views = hull.views
    sizes_px = views.sizes_px
    pads = rectangle_pads(views, np.abs(corners_local).max(axis=1), roundoff)  # (N, C, 4)
    near_m = pads[..., 2]

    projected = (
        np.einsum("ckj,nmj->nmck", views.img_from_local[:, :, :3], corners_local)
        + views.img_from_local[:, :, 3]
    )  # (N, K, C, 3)
    depth_min_m, depth_max_m = projected[..., 2].min(axis=1), projected[..., 2].max(axis=1)
    in_front = depth_min_m >= near_m  # (N, C)
    behind = depth_max_m <= -near_m

    depths_m = np.where(in_front[:, None], projected[..., 2], 1.0)
    with np.errstate(over="ignore"):  # a pixel too far out to be a number is far out all the same
        pixels = projected[..., :2] / depths_m[..., None]
    pad_px = pads[..., :2] / np.where(in_front, depth_min_m, 1.0)[..., None]  # (N, C, 2)
    # One pixel beyond the image says as much as any farther out.
    first = np.floor(np.clip(pixels.min(axis=1) - pad_px, -1, sizes_px))
    last = np.floor(np.clip(pixels.max(axis=1) + pad_px, -1, sizes_px))
    first = np.where(in_front[..., None], first, -1)
    last = np.where(in_front[..., None], last, sizes_px)

    wholly_seen = in_front & ((first >= 0) & (last < sizes_px)).all(axis=-1)
    start = np.clip(first, 0, sizes_px).astype(np.int64)  # (N, C, 2)
    stop = np.clip(last + 1, 0, sizes_px).astype(np.int64)
    never_seen = behind | (stop <= start).any(axis=-1)
    stop = np.maximum(stop, start)
    area = (stop - start).prod(axis=-1)
    count, n_seen = np.zeros(in_front.shape, np.int64), area.copy()
    for camera in range(len(views)):
        count[:, camera] = _count(hull.integral(camera), start[:, camera], stop[:, camera])
        seen_integral = views.seen_integral(camera)
        if seen_integral is not None:
            n_seen[:, camera] = _count(seen_integral, start[:, camera], stop[:, camera])
    wholly_seen &= n_seen == area
    never_seen |= n_seen == 0

    accepts = wholly_seen & (count == area)
    if views.unseen == "keep":
        rejects = wholly_seen & (count == 0)
        may_see = (~never_seen & (count > 0)).sum(axis=1)  # others withhold
        free = rejects.any(axis=1) | (may_see < views.min_cameras)
        full = (accepts | never_seen).all(axis=1) & (accepts.sum(axis=1) >= views.min_cameras)
    else:
        free = (never_seen | (count == 0)).any(axis=1)
        full = accepts.all(axis=1)
    return np.where(free, FREE, np.where(full, FULL, OPEN)).astype(np.int8)


def _count(
    integral: NDArray[np.int32], start: NDArray[np.int64], stop: NDArray[np.int64]
) -> NDArray[np.int32]:
    """Return how many pixels an integral image counts in rectangles, from (N, 2) to (N, 2)."""
    (x0, y0), (x1, y1) = start.T, stop.T
    return np.asarray(integral[y1, x1] - integral[y0, x1] - integral[y1, x0] + integral[y0, x0])


def boxes_are_free(
    hull: Hull, lower_world: NDArray[np.float64], upper_world: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Tell which boxes are proved to hold no point of the hull.

    The proof covers every point of the box, so every triangle in it at every viewport. A box that
    is not proved free may still be.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    lower_world, upper_world : (N, 3) float64
        Opposite corners of boxes along the world's axes, in metres.

    Returns
    -------
    (N,) bool
    """
    # Subtraction rounds monotonically: a point between the corners stays between them.
    ends_local = np.stack([lower_world, upper_world], axis=1) - hull.views.origin_world  # (N, 2, 3)
    choice = np.array([[i >> axis & 1 for axis in range(3)] for i in range(8)])  # (8, 3)
    corners_local = ends_local[:, choice, np.arange(3)]  # (N, 8, 3)
    free: NDArray[np.bool_] = verdicts(hull, corners_local) == FREE
    return free
