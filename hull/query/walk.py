"""Where a ray is in the hull, to floating-point accuracy, and what ends it there.

Along a ray a camera's verdict changes only where the ray's projection crosses the edge of a pixel,
the border of the image or the plane of depth 0. With h(t) = h0 + t h1 the homogeneous projection of
the ray's point at t, it crosses column k where h_x = k h_z:

    t = (k h0_z - h0_x) / (h1_x - k h1_z)

and rows alike. Between two crossings one pixel answers for all points, so asking it once, in the
middle, is exact: nothing hides between samples. Camera after camera takes its background away
from what the rule of `hybridve.hull.query.silhouettes` leaves where all pixels are object pixels.
`hybridve.hull.query.walk_reference` is the specification.
"""

import itertools

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import ZERO, compiled
from hybridve.hull.query.silhouettes import BACKGROUND, OBJECT, UNSEEN, Hull, Views

#: Stretches and gaps shorter than `least_stretches` are not told: rounding makes them where a ray
#: crosses a column and a row at once. Crossings are off by some 2^-52 of how far cameras and ray
#: lie apart, and of how far the world's origin is, times how much more slowly than across its view
#: the ray crosses the camera's pixels. As shares of these two: for rays that pass the camera at a
#: millionth of the first, 1e-9 m in a room; and at a thousandth, 2e-9 m at 10 km.
_LEAST_OF_ROOM, _LEAST_OF_WORLD = 2.0**-32, 2.0**-42

#: How far `boundary_cameras` looks to either side of a boundary point, as a share of how far the
#: cameras are from it: 1e-9 m in a room.
_LOOK_OF_ROOM = 2.0**-32

#: Less counts as this, lest a pixel be divided by zero.
_LEAST_DEPTH_M = float(np.finfo(np.float64).tiny)

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
        and gaps shorter than `least_stretches` are left out.

    Raises
    ------
    ValueError
        If the origin is not finite, the direction has no length, or the reach is not a positive
        length.
    """
    return spans_of_rays(hull, origin_world[None], direction[None], reach_m)[0]


def spans_of_rays(
    hull: Hull,
    origins_world: NDArray[np.float64],
    directions: NDArray[np.float64],
    reach_m: float,
) -> list[NDArray[np.float64]]:
    """Return what `spans_in_hull` does, to the bit, for each of many rays.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    origins_world : (R, 3) float64
        Where the rays begin, metres.
    directions : (R, 3) float64
        Where they go, world frame; of any length but 0.
    reach_m : float
        How far they go, metres.

    Returns
    -------
    list of R (N, 2) float64
        The stretches of each ray.

    Raises
    ------
    ValueError
        If an origin is not finite, a direction has no length, or the reach is not a positive
        length.
    """
    if not 0 < reach_m < np.inf:
        raise ValueError(f"reach_m is {reach_m}, expected a positive length")
    if not np.isfinite(origins_world).all():
        raise ValueError(f"origins are {origins_world}, expected finite points")
    views = hull.views
    units = np.zeros((len(directions), 3))
    for unit, direction in zip(units, directions, strict=True):
        unit[:] = _unit(direction)
    starts_local = origins_world - views.origin_world
    x, y, z = np.moveaxis(views.img_from_local[:, :, :3], 2, 0)  # (C, 3) each
    # Sums written out: a product of matrices is rounded as its size makes it.
    begin, step = (
        x * v[:, 0, None, None] + y * v[:, 1, None, None] + z * v[:, 2, None, None]
        for v in (starts_local, units)
    )  # (R, C, 3)
    spans_m, offset = _walk(
        begin + views.img_from_local[:, :, 3],
        step,
        least_stretches(views, origins_world),
        float(reach_m),
        np.ascontiguousarray(views.sizes_px),
        hull.answers_flat,
        hull.mask_offset,
        views.unseen == "keep",
        views.seen is not None,
        int(views.min_cameras),
    )
    return [spans_m[i:j] for i, j in itertools.pairwise(offset.tolist())]


def least_stretches(views: Views, origins_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how long the shortest stretches and gaps are that are told of some rays, (R,) metres.

    Rays that begin at (R, 3) metres, world. In a room it is 1e-9 m; in larger and smaller ones as
    much larger and smaller, and far from the world's origin what rounding leaves there.
    """
    room_m, world_m = _sizes(views, origins_world)
    return np.asarray(_LEAST_OF_ROOM * room_m + _LEAST_OF_WORLD * world_m)


def _sizes(
    views: Views, points_world: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far cameras and points (N, 3) lie from the local origin together, (N,) metres.

    Then how far the points, or the local origin, lie from that of the world.
    """
    local_m = np.abs(points_world - views.origin_world).max(axis=1)
    world_m = np.maximum(np.abs(points_world).max(axis=1), np.abs(views.origin_world).max())
    return local_m + np.abs(views.img_from_local[:, 2, 3]).max(), world_m


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
    (room_m,), (world_m,) = _sizes(views, point_world[None])
    look_m = _LOOK_OF_ROOM * room_m + _LEAST_OF_WORLD * world_m
    sides = np.array([-look_m, look_m])[:, None] * _unit(direction)
    points_local = point_world - views.origin_world + sides  # (2, 3)
    states = _states(hull, points_local)  # (C, 2)
    before, behind = _is_inside(hull, states)
    if behind or not before:
        return ()
    ends = states[:, 1] == BACKGROUND
    n_seen = int((states[:, 1] != UNSEEN).sum())
    if views.unseen == "carve" or n_seen < views.min_cameras:
        ends |= (states[:, 1] == UNSEEN) & (states[:, 0] == OBJECT)
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
    Pixels that it did not record lie beyond it too.

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
        point does not lie in front of the camera and in its image, on a pixel that was recorded,
        the window holds no boundary, or what it holds has no side (the middle of a line).
    """
    nowhere = np.full(3, np.nan)
    views = hull.views
    matrix = views.img_from_local[camera]
    projected = views.project(point_world, camera)
    width, height = views.sizes_px[camera].tolist()
    if not projected[2] > 0:
        return nowhere
    with np.errstate(over="ignore"):
        pixel = projected[:2] / projected[2]
    border_px = 1e-6  # an end at the border may be rounded to either side of it
    if not ((pixel >= -border_px) & (pixel <= np.add([width, height], border_px))).all():
        return nowhere
    answers = hull.answers(camera)
    corners = pixel + border_px * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    columns, rows = np.clip(corners.astype(np.int64), 0, (width - 1, height - 1)).T
    if (answers[rows, columns] == UNSEEN).all():
        return nowhere
    guesses: tuple[int | None, ...] = (None, 0, 1) if views.unseen == "keep" else (0,)
    for beyond in guesses:
        moment = _moment(answers, pixel, beyond)
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


@compiled
def seen_range(
    begin: NDArray[np.float64],
    step: NDArray[np.float64],
    width: int,
    height: int,
    reach_m: float,
) -> tuple[float, float]:
    """Return from where to where a camera sees a ray; twice infinity where it does not.

    In front and in the image are five conditions g0 + t g1 >= 0.
    """
    first_m, last_m = 0.0, reach_m
    for condition in range(5):
        axis = (condition - 1) // 2
        if condition == 0:
            g0, g1 = begin[2], step[2]
        elif condition % 2:
            g0, g1 = begin[axis], step[axis]
        else:
            size = float(width if axis == 0 else height)
            g0, g1 = size * begin[2] - begin[axis], size * step[2] - step[axis]
        if g1 > 0:
            first_m = max(first_m, -g0 / g1)
        elif g1 < 0:
            last_m = min(last_m, -g0 / g1)
        # Along an edge of the image, only the left and the upper one are of it.
        elif g0 < 0 or (g0 == 0 and condition % 2 == 0):
            return np.inf, np.inf
    if first_m < last_m:
        return first_m, last_m
    return np.inf, np.inf


@compiled
def _append(begin_m: float, end_m: float, spans_m: NDArray[np.float64], n_spans: int) -> int:
    """Write a stretch after the others, or prolong the last, and return how many there are."""
    if n_spans > 0 and spans_m[n_spans - 1, 1] == begin_m:
        spans_m[n_spans - 1, 1] = end_m
        return n_spans
    spans_m[n_spans, 0], spans_m[n_spans, 1] = begin_m, end_m
    return n_spans + 1


@compiled
def lines_crossed(
    begin_x: float,
    begin_z: float,
    step_x: float,
    step_z: float,
    size: int,
    first_m: float,
    last_m: float,
) -> tuple[float, float, float]:
    """Return the first column (or row) that a stretch may cross, the one after the last, and 1.

    Where the projection goes the other way, these are the last, the one before the first, and -1.
    """
    first_z, last_z = begin_z + first_m * step_z, begin_z + last_m * step_z
    low, high = 0.0, float(size)  # from the camera's centre, any
    if first_z > 0 and last_z > 0:
        first_px = (begin_x + first_m * step_x) / first_z
        last_px = (begin_x + last_m * step_x) / last_z
        low = max(low, np.floor(min(first_px, last_px)))
        high = min(high, np.ceil(max(first_px, last_px)))
    if high < low:
        return 0.0, 0.0, 1.0
    # In front of a camera a projection moves to one side all the way.
    if step_x * begin_z >= begin_x * step_z:
        return low, high + 1.0, 1.0
    return high, low - 1.0, -1.0


@compiled
def next_crossing(
    begin_x: float,
    begin_z: float,
    step_x: float,
    step_z: float,
    lines: tuple[float, float, float],
    after_m: float,
    last_m: float,
) -> tuple[float, float]:
    """Return where a ray next crosses one of the lines, `last_m` if none; and the line after it."""
    k, stop, by = lines
    while k != stop:
        t = (k * begin_z - begin_x) / (step_x - k * step_z)
        k += by
        if after_m < t < last_m:
            return t, k
    return last_m, k


@compiled
def _walk_camera(
    begin: NDArray[np.float64],
    step: NDArray[np.float64],
    first_m: float,
    last_m: float,
    answers: NDArray[np.uint8],
    width: int,
    unwanted: int,
    spans_m: NDArray[np.float64],
    n_spans: int,
) -> int:
    """Write where, in a stretch that projects into a camera's image, its answer is not unwanted."""
    height = len(answers) // width
    x0, y0, z0 = begin
    x1, y1, z1 = step
    columns = lines_crossed(x0, z0, x1, z1, width, first_m, last_m)
    rows = lines_crossed(y0, z0, y1, z1, height, first_m, last_m)
    column_m, next_column = next_crossing(x0, z0, x1, z1, columns, first_m, last_m)
    row_m, next_row = next_crossing(y0, z0, y1, z1, rows, first_m, last_m)
    at_m = first_m
    while at_m < last_m:
        until_m = min(column_m, row_m)
        middle_m = 0.5 * (at_m + until_m)
        depth_m = max(z0 + middle_m * z1, _LEAST_DEPTH_M)
        x, y = (x0 + middle_m * x1) / depth_m, (y0 + middle_m * y1) / depth_m
        # Whatever rounding, or an overflow, made of them: a pixel of the image.
        column = int(min(x, width - 1.0)) if x > 0 else 0
        row = int(min(y, height - 1.0)) if y > 0 else 0
        if answers[row * width + column] != unwanted:
            n_spans = _append(at_m, until_m, spans_m, n_spans)
        at_m = until_m
        if column_m <= at_m:
            rest = (next_column, columns[1], columns[2])
            column_m, next_column = next_crossing(x0, z0, x1, z1, rest, at_m, last_m)
        if row_m <= at_m:
            rest = (next_row, rows[1], rows[2])
            row_m, next_row = next_crossing(y0, z0, y1, z1, rest, at_m, last_m)
    return n_spans


@compiled
def _seen_enough(
    seen_m: NDArray[np.float64], min_cameras: int, reach_m: float, spans_m: NDArray[np.float64]
) -> int:
    """Write where at least so many cameras see a ray, and return how many stretches that are.

    Of each camera there are the stretches (N, 2) in which it sees the ray, all cameras together.
    """
    begins_m, ends_m = np.zeros(len(seen_m)), np.zeros(len(seen_m))
    for i in range(len(seen_m)):
        begins_m[i], ends_m[i] = min(seen_m[i, 0], reach_m), min(seen_m[i, 1], reach_m)
    begins_m.sort()
    ends_m.sort()
    n_spans, n_begun, n_ended = ZERO, ZERO, ZERO
    at_m = 0.0
    while at_m < reach_m:
        while n_begun < len(begins_m) and begins_m[n_begun] <= at_m:
            n_begun += 1
        while n_ended < len(ends_m) and ends_m[n_ended] <= at_m:
            n_ended += 1
        until_m = reach_m
        if n_begun < len(begins_m):
            until_m = min(until_m, begins_m[n_begun])
        if n_ended < len(ends_m):
            until_m = min(until_m, ends_m[n_ended])
        if n_begun - n_ended >= min_cameras:
            n_spans = _append(at_m, until_m, spans_m, n_spans)
        at_m = until_m
    return n_spans


@compiled
def _walk(
    begin: NDArray[np.float64],
    step: NDArray[np.float64],
    least_m: NDArray[np.float64],
    reach_m: float,
    sizes: NDArray[np.int64],
    answers: NDArray[np.uint8],
    mask_offset: NDArray[np.int64],
    keep: bool,
    has_gaps: bool,
    min_cameras: int,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the stretches (N, 2) of all rays, and where each ray's begin among them (R + 1,).

    The homogeneous projection of a ray's point at t is ``begin + t * step``, (R, C, 3); stretches
    and gaps are told if they are longer than `least_m`, (R,). Camera
    after camera takes away what it sees background in: what one has taken the next need not walk.
    With `has_gaps` some camera has pixels that it did not record.
    """
    n_rays, n_cameras = begin.shape[:2]
    # Each line of pixels is crossed once, and the border of an image twice.
    most = 2 * n_cameras + 2 + sizes.sum() + 4 * n_cameras
    left_m, then_m = np.zeros((most, 2)), np.zeros((most, 2))
    seen_m = np.zeros((n_cameras, 2))
    recorded_m = np.zeros((most if has_gaps else 0, 2))
    told_m = np.zeros((8, 2))
    offset = np.zeros(n_rays + 1, np.int64)
    n_told = ZERO
    for ray in range(n_rays):
        first_m, last_m = 0.0, reach_m
        for camera in range(n_cameras):
            seen_m[camera] = seen_range(
                begin[ray, camera],
                step[ray, camera],
                sizes[camera, 0],
                sizes[camera, 1],
                reach_m,
            )
            first_m = max(first_m, seen_m[camera, 0])
            last_m = min(last_m, seen_m[camera, 1])
        n_left = ZERO
        if has_gaps:
            n_recorded = ZERO
            for camera in range(n_cameras):
                if seen_m[camera, 0] < seen_m[camera, 1]:
                    first, width, height = mask_offset[camera], sizes[camera, 0], sizes[camera, 1]
                    # Of its own array: the first stretch of a camera does not prolong another's.
                    n_recorded += _walk_camera(
                        begin[ray, camera],
                        step[ray, camera],
                        seen_m[camera, 0],
                        seen_m[camera, 1],
                        answers[first : first + width * height],
                        width,
                        ZERO + UNSEEN,
                        recorded_m[n_recorded:],
                        ZERO,
                    )
            n_left = _seen_enough(recorded_m[:n_recorded], min_cameras, reach_m, left_m)
        elif keep:
            n_left = _seen_enough(seen_m, min_cameras, reach_m, left_m)
        elif first_m < last_m:
            n_left = _append(first_m, last_m, left_m, n_left)
        for camera in range(n_cameras):
            n_then = ZERO
            first_m, last_m = seen_m[camera]
            width, height = sizes[camera]
            first = mask_offset[camera]
            image = answers[first : first + width * height]
            for i in range(n_left):
                from_m, to_m = left_m[i]
                if from_m < first_m:  # it abstains
                    n_then = _append(from_m, min(to_m, first_m), then_m, n_then)
                if max(from_m, first_m) < min(to_m, last_m):
                    n_then = _walk_camera(
                        begin[ray, camera],
                        step[ray, camera],
                        max(from_m, first_m),
                        min(to_m, last_m),
                        image,
                        width,
                        ZERO + BACKGROUND,
                        then_m,
                        n_then,
                    )
                if max(from_m, last_m) < to_m:
                    n_then = _append(max(from_m, last_m), to_m, then_m, n_then)
            left_m, then_m = then_m, left_m
            n_left = n_then
        if n_told + n_left > len(told_m):
            more_m = np.zeros((2 * (n_told + n_left), 2))
            more_m[:n_told] = told_m[:n_told]
            told_m = more_m
        i = ZERO
        while i < n_left:
            from_m, to_m = left_m[i]
            i += 1
            while i < n_left and left_m[i, 0] - to_m <= least_m[ray]:
                to_m = left_m[i, 1]
                i += 1
            if to_m - from_m > least_m[ray]:
                told_m[n_told, 0], told_m[n_told, 1] = from_m, to_m
                n_told += 1
        offset[ray + 1] = n_told
    return told_m[:n_told], offset


def _at_pixels(hull: Hull, projected: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return the answers (C, N) at projections (C, 3, N) into the images but for rounding."""
    sizes_px = hull.views.sizes_px
    depth_m = np.maximum(projected[:, 2:], np.finfo(np.float64).tiny)
    with np.errstate(over="ignore"):
        pixels = np.clip(projected[:, :2] / depth_m, 0, sizes_px[:, :, None] - 1)
    pixels = pixels.astype(np.int64)  # not negative: the floor
    at = hull.mask_offset[:, None] + pixels[:, 1] * sizes_px[:, :1] + pixels[:, 0]
    answers: NDArray[np.uint8] = hull.answers_flat[at]
    return answers


def _states(hull: Hull, points_local: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return what each camera says of each point: (N, 3) to (C, N)."""
    views = hull.views
    projected = views.img_from_local[:, :, :3] @ points_local.T + views.img_from_local[:, :, 3:]
    depth_m = projected[:, 2:]  # (C, 1, N)
    # Over the depth, lest a point just in front of the camera overflow.
    in_image = (projected[:, :2] >= 0) & (projected[:, :2] < views.sizes_px[:, :, None] * depth_m)
    seen = (depth_m[:, 0] > 0) & in_image.all(axis=1)
    return np.where(seen, _at_pixels(hull, projected), np.uint8(UNSEEN))


def _is_inside(hull: Hull, states: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return whether points are in the hull, (C, N) to (N,)."""
    views = hull.views
    if views.unseen == "carve":
        return np.asarray((states == OBJECT).all(axis=0))
    enough = (states != UNSEEN).sum(axis=0) >= views.min_cameras
    return np.asarray(enough & (states != BACKGROUND).all(axis=0))


def _moment(
    answers: NDArray[np.uint8], pixel: NDArray[np.float64], beyond: int | None
) -> NDArray[np.float64]:
    """Return the first moment (2,) of a silhouette about a pixel; of length 1 at a straight rim.

    Beyond its border, and where nothing was recorded, the silhouette is `beyond`, or None: as at
    the border.
    """
    height, width = answers.shape
    reach = np.arange(-int(WINDOW_PX) - 1, int(WINDOW_PX) + 2)
    columns = int(np.floor(pixel[0])) + reach
    rows = int(np.floor(pixel[1])) + reach
    x, y = columns + 0.5 - pixel[0], rows + 0.5 - pixel[1]
    weight = np.maximum(1.0 - (x**2 + (y**2)[:, None]) / WINDOW_PX**2, 0.0)
    window = answers[np.clip(rows, 0, height - 1)[:, None], np.clip(columns, 0, width - 1)]
    if beyond is not None:
        window[:, (columns < 0) | (columns >= width)] = beyond
        window[(rows < 0) | (rows >= height)] = beyond
    is_unseen = window == UNSEEN
    if is_unseen.any():
        window[is_unseen] = _nearest(window, is_unseen) if beyond is None else beyond
    # Of the pixels that are fewer: those of a whole disc do not balance about every point.
    on_object = weight * window
    weight = on_object if 2 * on_object.sum() <= weight.sum() else on_object - weight
    # A half plane's moment is the integral of (1 - r^2 / R^2) r sin over half a disc: 4/15 R^3.
    return np.array([weight.sum(axis=0) @ x, weight.sum(axis=1) @ y]) / (4 / 15 * WINDOW_PX**3)


def _nearest(window: NDArray[np.uint8], is_unseen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return for each unseen pixel of a window, row by row, what the nearest other one holds.

    Background where there is no other.
    """
    seen = np.argwhere(~is_unseen)
    if len(seen) == 0:
        return np.zeros(np.count_nonzero(is_unseen), np.uint8)
    apart = ((np.argwhere(is_unseen)[:, None] - seen) ** 2).sum(axis=2)
    nearest = seen[apart.argmin(axis=1)]
    return np.asarray(window[nearest[:, 0], nearest[:, 1]])
