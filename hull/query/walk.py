"""Where a ray is in the hull, to floating-point accuracy, and what ends it there.

Along a ray a camera's verdict changes only where the ray's projection crosses the edge of a pixel,
the border of the image or the plane of depth 0. With h(t) = h0 + t h1 the homogeneous projection of
the ray's point at t, it crosses column k where h_x = k h_z:

    t = (k h0_z - h0_x) / (h1_x - k h1_z)

and rows alike. Between two crossings one pixel answers for all points, so asking it once, in the
middle, is exact: nothing hides between samples. Each camera's answers are then laid over each
other by the rule of `hybridve.hull.query.silhouettes`.
"""

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.silhouettes import Hull

#: Stretches and gaps shorter than this are not told: rounding makes them where a ray crosses a
#: column and a row at once. Crossings within the working volume are off by some 1e-15 m.
ROUNDING_M = 1e-12

#: How far `boundary_cameras` looks to either side of a boundary point.
_LOOK_M = 1e-9

#: What a camera says of a point: it does not see it, it sees background, it sees an object pixel.
_UNSEEN, _BACKGROUND, _OBJECT = -1, 0, 1

#: Radius of the window that a silhouette's direction is taken from. A straight rim is a staircase
#: of pixels: on random half planes the direction is off by 1.1 degrees in the mean and 9 at most,
#: on discs 20 pixels in radius by 1.3 and 5; 4 pixels give twice that, and 8 blur two fingers.
WINDOW_PX = 6.0

#: A window with a smaller first moment, as a share of a half plane's, has no direction.
_NO_MOMENT = 1e-6


def spans_in_hull(
    hull: Hull,
    origin_world: NDArray[np.float64],
    direction: NDArray[np.float64],
    reach_m: float,
) -> NDArray[np.float64]:
    """Return the stretches of a ray that lie in the hull.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    origin_world : (3,) float64
        Where the ray begins, metres.
    direction : (3,) float64
        Where it goes, world frame; of any length but 0.
    reach_m : float
        How far it goes, metres.

    Returns
    -------
    (N, 2) float64
        Begin and end of each stretch, in metres from the origin, ascending and apart. Stretches
        and gaps shorter than `ROUNDING_M` are left out.

    Raises
    ------
    ValueError
        If the direction has no length, or the reach is not a positive length.
    """
    if not 0 < reach_m < np.inf:
        raise ValueError(f"reach_m is {reach_m}, expected a positive length")
    views = hull.views
    start_local = origin_world - views.origin_world
    unit = _unit(direction)
    begin = views.img_from_local[:, :, :3] @ start_local + views.img_from_local[:, :, 3]  # (C, 3)
    step = views.img_from_local[:, :, :3] @ unit
    first_m, last_m = _seen_range(begin, step, views.sizes_px, reach_m)
    if views.unseen == "carve":  # what one camera does not see, none need look at
        first_m[:], last_m[:] = first_m.max(), last_m.min()
    edges_m, states = _walk(hull, begin, step, first_m, last_m, reach_m)
    return _joined(edges_m, _is_inside(hull, states))


def contains_few(hull: Hull, points_world: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return what `hybridve.hull.query.reference.contains_points` does, of all cameras at once.

    A third of its time for some thousand points, at more memory. The two may differ for points
    that project onto the edge of a pixel but for rounding.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    points_world : (N, 3) float64
        Points in metres.

    Returns
    -------
    (N,) bool
    """
    return _is_inside(hull, _states(hull, points_world - hull.views.origin_world))


def boundary_cameras(
    hull: Hull, point_world: NDArray[np.float64], direction: NDArray[np.float64]
) -> tuple[int, ...]:
    """Return the cameras that end the hull at a point, going along a direction.

    These are the cameras that see background just behind the point; and those that see it no
    more, where that ends the hull: always with ``unseen = "carve"``, else if fewer than
    ``min_cameras`` are left. Several at a crease of the hull, none where it does not end.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    point_world : (3,) float64
        End of a stretch of `spans_in_hull`, metres.
    direction : (3,) float64
        The direction of its ray, world frame; turned around, for the begin of a stretch.

    Raises
    ------
    ValueError
        If the direction has no length.
    """
    views = hull.views
    # Far from the world's origin, numbers are coarser than the step.
    look_m = _LOOK_M + 64 * np.finfo(np.float64).eps * float(np.abs(point_world).max())
    sides = np.array([-look_m, look_m])[:, None] * _unit(direction)
    points_local = point_world - views.origin_world + sides  # (2, 3)
    states = _states(hull, points_local)  # (C, 2)
    before, behind = _is_inside(hull, states)
    if behind or not before:
        return ()
    ends = states[:, 1] == _BACKGROUND
    n_seen = int((states[:, 1] != _UNSEEN).sum())
    if views.unseen == "carve" or n_seen < views.min_cameras:
        ends |= (states[:, 1] == _UNSEEN) & (states[:, 0] == _OBJECT)
    return tuple(np.flatnonzero(ends).tolist())


def silhouette_normal(
    hull: Hull, camera: int, point_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the normal of a camera's silhouette cone at a point of its boundary.

    The silhouette's direction n at the point's pixel p, from object pixels to background, is that
    of its first moment about p in a window of radius `WINDOW_PX`, weighted 1 - r^2 / R^2. The line
    (n, -n p) of the image is the plane P^T (n, -n p) of space, through the camera's centre.

    Beyond the image's border nothing is seen: background to a camera that carves there, while one
    that abstains is taken to see what it sees at its border, unless only the border is a boundary.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    camera : int
        Its number in the views.
    point_world : (3,) float64
        Metres.

    Returns
    -------
    (3,) float64
        Unit vector in the world's frame that points out of the hull. NaN where there is none: the
        point does not lie in front of the camera and in its image, the window holds no boundary,
        or what it holds has no side (the middle of a line).
    """
    nowhere = np.full(3, np.nan)
    views = hull.views
    matrix = views.img_from_local[camera]
    projected = matrix[:, :3] @ (point_world - views.origin_world) + matrix[:, 3]
    width, height = views.sizes_px[camera].tolist()
    if not projected[2] > 0:
        return nowhere
    with np.errstate(over="ignore"):
        pixel = projected[:2] / projected[2]
    border_px = 1e-6  # an end at the border may be rounded to either side of it
    if not ((pixel >= -border_px) & (pixel <= np.add([width, height], border_px))).all():
        return nowhere
    guesses: tuple[int | None, ...] = (None, 0, 1) if views.unseen == "keep" else (0,)
    for beyond in guesses:
        moment = _moment(hull.mask(camera), pixel, beyond)
        if np.linalg.norm(moment) > _NO_MOMENT:
            break
    else:
        return nowhere
    line = np.array([-moment[0], -moment[1], moment @ pixel])
    normal: NDArray[np.float64] = line @ matrix[:, :3]
    normal /= np.linalg.norm(normal)
    return normal


def _unit(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    scale = float(np.abs(direction).max())
    if not 0 < scale < np.inf:
        raise ValueError(f"direction is {direction}, expected one that has a length")
    scaled = direction / scale  # squares of tiny components are 0
    unit: NDArray[np.float64] = scaled / np.linalg.norm(scaled)
    return unit


def _seen_range(
    begin: NDArray[np.float64],
    step: NDArray[np.float64],
    sizes_px: NDArray[np.int64],
    reach_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return from where (C,) to where (C,) cameras see a ray; empty where the first is not less.

    In front and in the image are five conditions g0 + t g1 >= 0 (C, 5).
    """
    width, height = sizes_px[:, 0], sizes_px[:, 1]

    def conditions(h: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y, z = h.T
        return np.stack([z, x, width * z - x, y, height * z - y], axis=-1)

    g0, g1 = conditions(begin), conditions(step)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        crossing_m = -g0 / g1
    first_m = np.where(g1 > 0, crossing_m, 0.0).max(axis=1)
    last_m = np.where(g1 < 0, crossing_m, reach_m).min(axis=1)
    # Along an edge of the image, only the left and the upper one are of it.
    is_outside = (g1 == 0) & np.where([True, False, True, False, True], g0 <= 0, g0 < 0)
    last_m[is_outside.any(axis=1)] = -1.0
    return np.clip(first_m, 0.0, reach_m), np.clip(last_m, -1.0, reach_m)


def _walk(
    hull: Hull,
    begin: NDArray[np.float64],
    step: NDArray[np.float64],
    first_m: NDArray[np.float64],
    last_m: NDArray[np.float64],
    reach_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.int8]]:
    """Return where along a ray what cameras say changes (K + 1,), and what they say (C, K).

    Camera c sees it from ``first_m[c]`` to ``last_m[c]`` and goes through its pixels there.
    """
    n_cameras, sizes_px = len(begin), hull.views.sizes_px
    is_blind = ~(first_m < last_m)
    first_m, last_m = np.where(is_blind, 0.0, first_m), np.where(is_blind, 0.0, last_m)
    begin, step = begin[:, :, None], step[:, :, None]  # (C, 3, 1)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        # In front of a camera a projection moves to one side all the way.
        ends = begin + np.stack([first_m, last_m], axis=-1)[:, None] * step  # (C, 3, 2)
        ends_px = ends[:, :2] / ends[:, 2:]  # (C, 2, 2)
        low, high = np.floor(ends_px.min(axis=2)), np.ceil(ends_px.max(axis=2))  # (C, 2)
        low, high = np.fmax(low, 0.0), np.fmin(high, sizes_px)  # anywhere, at the camera's centre
        n_crossings = np.where(is_blind[:, None], 0.0, high - low + 1).max()
        k = low[:, :, None] + np.arange(max(n_crossings, 0.0))  # (C, 2, N)
        t = (k * begin[:, 2:] - begin[:, :2]) / (step[:, :2] - k * step[:, 2:])
    is_between = (t > first_m[:, None, None]) & (t < last_m[:, None, None])
    t = np.where(is_between, t, last_m[:, None, None]).reshape(n_cameras, -1)
    edges_m = np.sort(np.column_stack([first_m, t, last_m]), axis=1)  # (C, 2N + 2)
    middles_m = 0.5 * (edges_m[:, :-1] + edges_m[:, 1:])
    said = np.full((n_cameras, edges_m.shape[1] + 1), _UNSEEN, np.int8)  # before the first edge, ..
    said[:, 1:-1] = _at_pixels(hull, begin + middles_m[:, None] * step)
    said[is_blind] = _UNSEEN
    changes_m = edges_m[said[:, 1:] != said[:, :-1]]
    all_m = np.unique(np.concatenate([[0.0, reach_m], changes_m]))
    middles_m = 0.5 * (all_m[:-1] + all_m[1:])
    states = [said[c, np.searchsorted(edges_m[c], middles_m)] for c in range(n_cameras)]
    return all_m, np.stack(states)


def _at_pixels(hull: Hull, projected: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return the silhouettes (C, N) at projections (C, 3, N) that are seen but for rounding."""
    sizes_px = hull.views.sizes_px
    depth_m = np.maximum(projected[:, 2:], np.finfo(np.float64).tiny)
    with np.errstate(over="ignore"):
        pixels = np.clip(projected[:, :2] / depth_m, 0, sizes_px[:, :, None] - 1)
    pixels = pixels.astype(np.int64)  # not negative: the floor
    at = hull.mask_offset[:, None] + pixels[:, 1] * sizes_px[:, :1] + pixels[:, 0]
    silhouettes: NDArray[np.uint8] = hull.masks_flat[at]
    return silhouettes


def _states(hull: Hull, points_local: NDArray[np.float64]) -> NDArray[np.int8]:
    """Return what each camera says of each point: (N, 3) to (C, N)."""
    views = hull.views
    projected = views.img_from_local[:, :, :3] @ points_local.T + views.img_from_local[:, :, 3:]
    depth_m = projected[:, 2:]  # (C, 1, N)
    # Over the depth, lest a point just in front of the camera overflow.
    in_image = (projected[:, :2] >= 0) & (projected[:, :2] < views.sizes_px[:, :, None] * depth_m)
    seen = (depth_m[:, 0] > 0) & in_image.all(axis=1)
    return np.where(seen, _at_pixels(hull, projected).astype(np.int8), np.int8(_UNSEEN))


def _is_inside(hull: Hull, states: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Return whether points are in the hull, (C, N) to (N,)."""
    views = hull.views
    if views.unseen == "carve":
        return np.asarray((states == _OBJECT).all(axis=0))
    enough = (states != _UNSEEN).sum(axis=0) >= views.min_cameras
    return np.asarray(enough & (states != _BACKGROUND).all(axis=0))


def _joined(edges_m: NDArray[np.float64], inside: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return stretches (N, 2) from the pieces between edges (K + 1,) that are inside (K,)."""
    changes = np.diff(np.concatenate([[0], inside.astype(np.int8), [0]]))
    spans_m = np.column_stack([edges_m[changes == 1], edges_m[changes == -1]])
    if len(spans_m) == 0:
        return spans_m
    is_gap = spans_m[1:, 0] - spans_m[:-1, 1] > ROUNDING_M
    spans_m = np.column_stack(
        [
            spans_m[np.concatenate([[True], is_gap]), 0],
            spans_m[np.concatenate([is_gap, [True]]), 1],
        ]
    )
    is_told = spans_m[:, 1] - spans_m[:, 0] > ROUNDING_M
    return np.asarray(spans_m[is_told])


def _moment(
    mask: NDArray[np.uint8], pixel: NDArray[np.float64], beyond: int | None
) -> NDArray[np.float64]:
    """Return the first moment (2,) of a silhouette about a pixel; of length 1 at a straight rim.

    Beyond its border the silhouette is `beyond`, or None: as at the border.
    """
    height, width = mask.shape
    reach = np.arange(-int(WINDOW_PX) - 1, int(WINDOW_PX) + 2)
    columns = int(np.floor(pixel[0])) + reach
    rows = int(np.floor(pixel[1])) + reach
    x, y = columns + 0.5 - pixel[0], rows + 0.5 - pixel[1]
    weight = np.maximum(1.0 - (x**2 + (y**2)[:, None]) / WINDOW_PX**2, 0.0)
    window = mask[np.clip(rows, 0, height - 1)[:, None], np.clip(columns, 0, width - 1)]
    if beyond is not None:
        window[:, (columns < 0) | (columns >= width)] = beyond
        window[(rows < 0) | (rows >= height)] = beyond
    # Of the pixels that are fewer: those of a whole disc do not balance about every point.
    on_object = weight * window
    weight = on_object if 2 * on_object.sum() <= weight.sum() else on_object - weight
    # A half plane's moment is the integral of (1 - r^2 / R^2) r sin over half a disc: 4/15 R^3.
    return np.array([weight.sum(axis=0) @ x, weight.sum(axis=1) @ y]) / (4 / 15 * WINDOW_PX**3)
