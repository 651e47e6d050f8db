"""How the nodes of a sheet get out of the hull.

The volume query says which samples of the triangles are in the hull. Each is moved out along its
way to where the hull ends, by moving the free corners of its triangle: the share of a corner is its
weight in the sample over its mass, as in position based dynamics (Mueller, Heidelberger, Hennix and
Ratcliff 2007). The deepest sample goes first; one that is out by then is left.

The way out is the direction that the object gives way in (V_rec of the paper, section 4.3), or the
shortest: a point leaves the visual hull by leaving the silhouette of any one camera. Its way
through the outline of a camera is along the normal of the cone of that outline, taken where the
background is nearest to its pixel. How long that way is in the hull of all cameras is then found
along it. A sheet keeps its side: of the cameras, those are asked first whose way leads where the
corners went before.

How fast the hull comes is told by how far the outline that ends it has moved. An outline jumps from
pixel to pixel, but not everywhere at once: the object's share of a window about the place tells its
movement to a fraction of a pixel. Where it moved farther than a window tells, the ways out of both
hulls are compared.

What hangs on pinned nodes cannot always follow. Held are the samples of triangles of which a pinned
corner is in the hull, and those that hang by more than half on pinned corners outside of it.
"""

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import ZERO, compiled, inlined
from hybridve.hull.query.frame import Frame
from hybridve.hull.query.points import is_inside, project
from hybridve.hull.query.silhouettes import BACKGROUND

#: Along its way a sample is looked at in steps of this length, then halved to that of the second:
#: gaps of the hull that are narrower than the first are no way out. Metres.
_MARCH_M, _EXACT_M = 5e-4, 1e-6

#: How far beyond the hull's end a sample is put: single precision and rounding must not call it
#: inside again. Metres.
_BEYOND_M = 1e-5

#: A sample leans on a hull that is no farther below it, and not farther above, metres.
_NEAR_M, _FAR_M = 1e-3, 0.02

#: No way out is longer, metres: no hull is.
_REACH_M = 2.0

#: A sample that its free corners make up less of is held: they would go farther than twice as far.
LEAST_FREE = 0.5

#: Radius of the window that an outline's direction is taken from, pixels; as
#: `hybridve.hull.query.walk.WINDOW_PX`.
_WINDOW_PX = 6

#: A window whose first moment is smaller, as a share of a half plane's, has no direction.
_NO_MOMENT = 1e-6

#: An outline that moved by more pixels is no straight line to the window.
_TOLD_PX = 2.0

#: An outline is asked how far it has come along a way that crosses it at this sine at least.
_ACROSS = 0.2

#: The background is looked for so far around a pixel, and a camera whose background is farther is
#: asked along no way: other cameras end the hull before. Pixels.
_SEARCH_PX = 400

#: How much longer the way on the side where a sheet was may be than the shortest, metres: a sheet
#: that went around something is on another side now.
_SIDE_WORTH_M = 0.05


@compiled
def _is_in(x: float, y: float, z: float, frame: Frame) -> bool:
    return is_inside(
        x,
        y,
        z,
        frame.every,
        len(frame.every),
        ZERO,
        frame.matrices,
        frame.sizes,
        frame.answers,
        frame.mask_offset,
        frame.keep,
        frame.min_cameras,
        0.0,
    )


@compiled
def way_out(
    point: NDArray[np.float64], direction: NDArray[np.float64], frame: Frame, reach_m: float
) -> float:
    """Return how far a point (3,), local frame, is from the end of the hull along a unit vector.

    At the returned distance it is out. 0 for a point that is; -1 if the reach does not do.
    """
    x, y, z = point
    dx, dy, dz = direction
    if not _is_in(x, y, z, frame):
        return 0.0
    inside_m, outside_m = 0.0, _MARCH_M
    while _is_in(x + outside_m * dx, y + outside_m * dy, z + outside_m * dz, frame):
        inside_m = outside_m
        outside_m += _MARCH_M
        if outside_m > reach_m:
            return -1.0
    while outside_m - inside_m > _EXACT_M:
        middle_m = 0.5 * (inside_m + outside_m)
        if _is_in(x + middle_m * dx, y + middle_m * dy, z + middle_m * dz, frame):
            inside_m = middle_m
        else:
            outside_m = middle_m
    return outside_m


@compiled
def _way_in(
    point: NDArray[np.float64], direction: NDArray[np.float64], frame: Frame, reach_m: float
) -> float:
    """Return how far behind a point, against a direction, the hull begins; -1 beyond the reach."""
    x, y, z = point
    dx, dy, dz = direction
    outside_m, inside_m = 0.0, _MARCH_M
    while not _is_in(x - inside_m * dx, y - inside_m * dy, z - inside_m * dz, frame):
        outside_m = inside_m
        inside_m += _MARCH_M
        if inside_m > reach_m:
            return -1.0
    while inside_m - outside_m > _EXACT_M:
        middle_m = 0.5 * (inside_m + outside_m)
        if _is_in(x - middle_m * dx, y - middle_m * dy, z - middle_m * dz, frame):
            inside_m = middle_m
        else:
            outside_m = middle_m
    return inside_m


@inlined
def _is_object(
    answers: NDArray[np.uint8], image: tuple[int, int, int, bool], column: int, row: int
) -> bool:
    """Tell whether a camera sees no background at a pixel; beyond its image if it abstains.

    Its image begins at the first of `image` in the answers, then come width, height, and whether it
    abstains.
    """
    first, width, height, keep = image
    if 0 <= column < width and 0 <= row < height:
        return bool(answers[first + row * width + column] != BACKGROUND)
    return keep


@inlined
def _image_of(frame: Frame, camera: int) -> tuple[int, int, int, bool]:
    sizes = frame.sizes
    return frame.mask_offset[camera], sizes[camera, 0], sizes[camera, 1], frame.keep


@compiled
def _nearest_background(
    answers: NDArray[np.uint8],
    image: tuple[int, int, int, bool],
    x: float,
    y: float,
    limit_px: float,
) -> tuple[float, float, float]:
    """Return how far the nearest background of a camera is from a pixel, and the way to it.

    Infinity if it is not within the limit. Squares of pixels are looked at, ring after ring.
    """
    column, row = int(np.floor(x)), int(np.floor(y))
    best, best_x, best_y = np.inf, 0.0, 0.0
    ring = ZERO
    while ring <= limit_px + 1.0 and ring - 1.0 < best:
        for dy in range(-ring, ring + 1):
            is_end = dy == -ring or dy == ring
            dx = -ring
            while dx <= ring:
                if not _is_object(answers, image, column + dx, row + dy):
                    left, top = float(column + dx), float(row + dy)
                    to_x = min(max(x, left), left + 1.0) - x
                    to_y = min(max(y, top), top + 1.0) - y
                    apart = np.sqrt(to_x * to_x + to_y * to_y)
                    if apart < best:
                        best, best_x, best_y = apart, to_x, to_y
                dx += 1 if is_end or ring == 0 else 2 * ring
        ring += 1
    return best, best_x, best_y


@compiled
def _outline_normal(
    answers: NDArray[np.uint8], image: tuple[int, int, int, bool], x: float, y: float
) -> tuple[float, float]:
    """Return the direction of an outline at a pixel, from object to background; (0, 0) for none.

    That of `hybridve.hull.query.walk.silhouette_normal`: the first moment of a window.
    """
    column, row = int(np.floor(x)), int(np.floor(y))
    moment_x, moment_y, total = 0.0, 0.0, 0.0
    all_x, all_y, whole = 0.0, 0.0, 0.0
    for dy in range(-_WINDOW_PX - 1, _WINDOW_PX + 2):
        for dx in range(-_WINDOW_PX - 1, _WINDOW_PX + 2):
            at_x, at_y = column + dx + 0.5 - x, row + dy + 0.5 - y
            weight = 1.0 - (at_x * at_x + at_y * at_y) / _WINDOW_PX**2
            if weight <= 0.0:
                continue
            all_x += weight * at_x
            all_y += weight * at_y
            whole += weight
            if _is_object(answers, image, column + dx, row + dy):
                moment_x += weight * at_x
                moment_y += weight * at_y
                total += weight
    if 2.0 * total > whole:  # of the pixels that are fewer
        moment_x, moment_y = moment_x - all_x, moment_y - all_y
    length = np.sqrt(moment_x**2 + moment_y**2)
    if length < _NO_MOMENT * 4.0 / 15.0 * _WINDOW_PX**3:
        return 0.0, 0.0
    return -moment_x / length, -moment_y / length


@compiled
def _cone_way(
    point: NDArray[np.float64],
    frame: Frame,
    camera: int,
    limit_m: float,
    direction: NDArray[np.float64],
) -> float:
    """Write the way of a point through the outline of a camera; return an estimate of its length.

    Infinity if the camera does not see the point, or its outline is beyond the limit.
    """
    m, image = frame.matrices[camera], _image_of(frame, camera)
    depth_m, x, y = project(point[0], point[1], point[2], m)
    if not (depth_m > 0.0 and 0.0 <= x < image[1] and 0.0 <= y < image[2]):
        return np.inf
    focal_px = np.sqrt((m[0] - x * m[8]) ** 2 + (m[1] - x * m[9]) ** 2 + (m[2] - x * m[10]) ** 2)
    limit_px = min(limit_m * focal_px / depth_m + 2.0, 1.0 * _SEARCH_PX)
    apart, to_x, to_y = _nearest_background(frame.answers, image, x, y, limit_px)
    if not apart <= limit_px:
        return np.inf
    q_x, q_y = x + to_x, y + to_y
    n_x, n_y = _outline_normal(frame.answers, image, q_x, q_y)
    forward = n_x * to_x + n_y * to_y
    if (n_x == 0.0 and n_y == 0.0) or forward < 0.5 * apart:  # a corner, or a hair, of the outline
        if apart == 0.0:
            return np.inf
        n_x, n_y, forward = to_x / apart, to_y / apart, apart
    squared = 0.0
    for k in range(3):
        component = n_x * m[k] + n_y * m[4 + k] - (n_x * q_x + n_y * q_y) * m[8 + k]
        direction[k] = component
        squared += component * component
    length = np.sqrt(squared)
    direction /= length
    return float(forward * depth_m / length)


@compiled
def _shortest_way(
    point: NDArray[np.float64],
    side: NDArray[np.float64],
    frame: Frame,
    first: int,
    direction: NDArray[np.float64],
) -> int:
    """Write the direction of the shortest way out of all cameras' outlines; return whose it is.

    Cameras are asked from `first` on: the one that ends the hull at a neighbour ends the search of
    the others. Where the shortest leads against `side`, one that does not is taken if there is any
    that is not much longer. -1, and zeros, where there is none.
    """
    n_cameras = len(frame.sizes)
    best, best_m = -1, _REACH_M
    tried = np.zeros(3)
    direction[:] = 0.0
    for number in range(n_cameras):
        camera = (first + number) % n_cameras
        length_m = _cone_way(point, frame, camera, best_m, tried)
        if length_m < best_m:
            best, best_m = camera, length_m
            direction[:] = tried
    if best < 0 or direction[0] * side[0] + direction[1] * side[1] + direction[2] * side[2] >= 0.0:
        return best
    kept_m = best_m + _SIDE_WORTH_M
    for camera in range(n_cameras):
        length_m = _cone_way(point, frame, camera, kept_m, tried)
        along = tried[0] * side[0] + tried[1] * side[1] + tried[2] * side[2]
        if length_m < kept_m and along > 0.0:
            best, kept_m = camera, length_m
            direction[:] = tried
    return best


@compiled
def _share_of_window(
    answers: NDArray[np.uint8], image: tuple[int, int, int, bool], x: float, y: float
) -> float:
    """Return the object's weight in a window about a pixel, in pixels along its radius.

    A straight outline through the pixel that moves by so much changes it by that.
    """
    column, row = int(np.floor(x)), int(np.floor(y))
    total = 0.0
    for dy in range(-_WINDOW_PX - 1, _WINDOW_PX + 2):
        for dx in range(-_WINDOW_PX - 1, _WINDOW_PX + 2):
            at_x, at_y = column + dx + 0.5 - x, row + dy + 0.5 - y
            weight = 1.0 - (at_x * at_x + at_y * at_y) / _WINDOW_PX**2
            if weight > 0.0 and _is_object(answers, image, column + dx, row + dy):
                total += weight
    return total / (4.0 / 3.0 * _WINDOW_PX)


@compiled
def _advance_of_outline(
    end: NDArray[np.float64], way: NDArray[np.float64], frame: Frame, before: Frame
) -> float:
    """Return how far the hull's end (3,) has come along a way since before, metres; NaN if unclear.

    `end` is just out of the hull, local frame.
    """
    for camera in range(len(frame.sizes)):
        m, image = frame.matrices[camera], _image_of(frame, camera)
        depth_m, x, y = project(end[0], end[1], end[2], m)
        if not (depth_m > 0.0 and 0.0 <= x < image[1] and 0.0 <= y < image[2]):
            continue
        if _is_object(frame.answers, image, int(x), int(y)):
            continue
        n_x, n_y = _outline_normal(frame.answers, image, x, y)
        along = 0.0  # how many pixels a metre of the way is across the outline
        for k in range(3):
            component = n_x * m[k] + n_y * m[4 + k] - (n_x * x + n_y * y) * m[8 + k]
            along += component * way[k] / depth_m
        size_px = np.sqrt((m[0] - x * m[8]) ** 2 + (m[1] - x * m[9]) ** 2) / depth_m
        if along <= _ACROSS * size_px:
            continue
        then = ZERO
        while before.order[then] != frame.order[camera]:
            then += 1
        then_depth_m, then_x, then_y = project(end[0], end[1], end[2], before.matrices[then])
        if not then_depth_m > 0.0:
            continue
        moved_px = _share_of_window(frame.answers, image, x, y)
        image_then = _image_of(before, then)
        moved_px -= _share_of_window(before.answers, image_then, then_x, then_y)
        if np.abs(moved_px) < _TOLD_PX:
            return moved_px / along
    return np.nan


@compiled
def may_meet(
    low: NDArray[np.float64], high: NDArray[np.float64], origin: NDArray[np.float64], frame: Frame
) -> bool:
    """Tell whether a box may reach into the hull; False only where some camera denies all of it.

    `low` and `high` (3,), metres, and `origin` (3,), which leads to the local frame.
    """
    for camera in range(len(frame.sizes)):
        width, height = frame.sizes[camera]
        least_x, most_x, least_y, most_y = np.inf, -np.inf, np.inf, -np.inf
        is_before = True
        for corner in range(8):
            depth_m, x, y = project(
                (high[0] if corner & 1 else low[0]) + origin[0],
                (high[1] if corner & 2 else low[1]) + origin[1],
                (high[2] if corner & 4 else low[2]) + origin[2],
                frame.matrices[camera],
            )
            if depth_m <= 0.0:
                is_before = False
                break
            least_x, most_x = min(least_x, x), max(most_x, x)
            least_y, most_y = min(least_y, y), max(most_y, y)
        if not is_before:
            continue
        is_whole = least_x > 0.0 and most_x < width and least_y > 0.0 and most_y < height
        if frame.keep and not (is_whole and frame.recorded is None):
            continue
        left = int(min(max(np.floor(least_x) - 1.0, 0.0), 1.0 * width))
        right = int(min(max(np.ceil(most_x) + 1.0, 0.0), 1.0 * width))
        top = int(min(max(np.floor(least_y) - 1.0, 0.0), 1.0 * height))
        bottom = int(min(max(np.ceil(most_y) + 1.0, 0.0), 1.0 * height))
        first = frame.integral_offset[camera]
        above, below = first + top * (width + 1), first + bottom * (width + 1)
        integrals = frame.integrals
        n_object = integrals[below + right] - integrals[below + left]
        n_object -= integrals[above + right] - integrals[above + left]
        if n_object == 0:
            return False
    return True


@compiled
def _write_weights(viewport: int, sample: int, weights: NDArray[np.float64]) -> None:
    """Write what the corners weigh in a sample of a viewport, (3,)."""
    i, j = sample + ZERO, ZERO
    while i >= viewport - j:
        i -= viewport - j
        j += 1
    weights[:] = 1.0 / 3.0
    if viewport > 1:
        weights[1], weights[2] = i / (viewport - 1.0), j / (viewport - 1.0)
        weights[0] = 1.0 - weights[1] - weights[2]


@compiled
def renew(
    x: NDArray[np.float64],
    origin: NDArray[np.float64],
    faces: NDArray[np.int32],
    viewports: NDArray[np.int32],
    frame: Frame,
    before: Frame,
    elapsed_s: float,
    kept_sample: NDArray[np.int64],
    kept_way: NDArray[np.float64],
) -> tuple[
    NDArray[np.int64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
]:
    """Return the contacts of samples that were moved before and still lean on the hull.

    Those are kept below which, by no more than `_NEAR_M`, the hull is; the others are forgotten.

    Parameters
    ----------
    kept_sample, kept_way : (T, 3), (T, 3, 3)
        As `push_hits` wrote them; samples that are forgotten become -1.

    The others are those of `push_hits`. Returned are the arrays of
    `hybridve.hull.effects.cloth_model.Contacts`.
    """
    most = np.count_nonzero(kept_sample >= 0)
    corners = np.zeros((most, 3), np.int64)
    weights, way = np.zeros((most, 3)), np.zeros((most, 3))
    level_m, rise_m, speed = np.zeros(most), np.zeros(most), np.zeros(most)
    point = np.zeros(3)
    n = ZERO
    for t in range(len(faces)):
        for corner in range(3):
            if kept_sample[t, corner] < 0:
                continue
            _write_weights(viewports[t], kept_sample[t, corner] + ZERO, weights[n])
            way[n] = kept_way[t, corner]
            at_m = 0.0
            point[:] = origin - _NEAR_M * way[n]
            for c in range(3):
                node = faces[t, c]
                corners[n, c] = node
                for axis in range(3):
                    point[axis] += weights[n, c] * x[node, axis]
                    at_m += weights[n, c] * x[node, axis] * way[n, axis]
            out_m = way_out(point, way[n], frame, _FAR_M)
            if out_m <= 0.0:
                kept_sample[t, corner] = -1
                continue
            rise_m[n] = max(out_m - _NEAR_M, 0.0)
            level_m[n] = at_m - _NEAR_M + out_m
            speed[n] = 0.0
            if elapsed_s > 0.0:
                advance_m = _advance_of_outline(point + out_m * way[n], way[n], frame, before)
                if not np.isnan(advance_m):
                    speed[n] = advance_m / elapsed_s
            n += 1
    return corners[:n], weights[:n], way[:n], level_m[:n], rise_m[:n], speed[:n]


@compiled
def push_hits(
    x: NDArray[np.float64],
    origin: NDArray[np.float64],
    inverse_mass: NDArray[np.float64],
    faces: NDArray[np.int32],
    viewports: NDArray[np.int32],
    triangle: NDArray[np.uint32],
    sample: NDArray[np.uint32],
    frame: Frame,
    before: Frame,
    elapsed_s: float,
    reach_before_m: float,
    constrained: NDArray[np.float64],
    side: NDArray[np.float64],
    shift: NDArray[np.float64],
    speed: NDArray[np.float64],
    kept_sample: NDArray[np.int64],
    kept_way: NDArray[np.float64],
    least_m: float,
    whole: bool,
) -> tuple[float, int]:
    """Move the samples that are in the hull out of it, in place.

    Parameters
    ----------
    x : (N, 3) float64
        Nodes, metres; moved.
    origin : (3,) float64
        Leads from the frame of the nodes to the local one of the views, metres.
    inverse_mass : (N,) float64
        1 / kg; 0 for nodes that are pinned.
    faces, viewports : (T, 3), (T,) int32
        The triangles that were asked.
    triangle, sample : (P,) uint32
        What is in the hull.
    frame, before : Frame
        The hull, and that of `elapsed_s` before; the same where nothing is known of its speed.
    elapsed_s : float
        Seconds; 0 where nothing is known of the hull's speed.
    reach_before_m : float
        How far the hull may have come in that time.
    constrained : (3,) float64
        The way out, a unit vector; zeros for the shortest.
    side : (N, 3) float64
        Where each node was moved last, unit vectors; zeros if not lately.
    shift, speed : (N, 4), (N, 2) float64
        To these is added: the sum of unit vectors along which a node was moved times how far, and
        how far; the sum of the speeds with which the hull went along them, times that, and that.
        Nothing is added to `speed` where it is not known.
    kept_sample, kept_way : (T, 3), (T, 3, 3)
        Of each triangle, the samples that were moved and where, one for each corner that weighs
        most: written; see `renew`.
    least_m : float
        Where no sample is deeper, nothing is moved.
    whole : bool
        Move the free corners of a triangle alike, so that no sample of it goes less far than asked.

    Returns
    -------
    float, int
        How deep the deepest sample was that is not held, along its way out, metres; and how many
        are held.
    """
    count = len(triangle)
    weights = np.zeros((count, 3))
    ways = np.zeros((count, 3))
    depth_m = np.zeros(count)
    point, about = np.zeros(3), np.zeros(3)
    is_constrained = constrained[0] != 0.0 or constrained[1] != 0.0 or constrained[2] != 0.0
    n_held, first = ZERO, ZERO
    deepest_m = 0.0
    for k in range(count):
        t = triangle[k]
        _write_weights(viewports[t], sample[k] + ZERO, weights[k])
        free = 0.0
        about[:] = 0.0
        point[:] = origin
        for c in range(3):
            node = faces[t, c]
            if inverse_mass[node] > 0.0:
                free += weights[k, c]
            elif _is_in(
                x[node, 0] + origin[0], x[node, 1] + origin[1], x[node, 2] + origin[2], frame
            ):
                free = -np.inf
            for axis in range(3):
                point[axis] += weights[k, c] * x[node, axis]
                about[axis] += weights[k, c] * side[node, axis]
        if free < LEAST_FREE - 1e-9:
            depth_m[k] = -1.0
            n_held += 1
            continue
        if is_constrained:
            ways[k] = constrained
        else:
            camera = _shortest_way(point, about, frame, first, ways[k])
            if camera >= 0:
                first = camera
            else:
                ways[k, 2] = 1.0  # no outline is near: up, as good as any
        depth_m[k] = way_out(point, ways[k], frame, _REACH_M)
        if depth_m[k] < 0.0:
            depth_m[k] = _REACH_M
        deepest_m = max(deepest_m, depth_m[k])
    if deepest_m <= least_m:
        return deepest_m, n_held
    order = np.argsort(-depth_m, kind="mergesort")
    for k in order:
        if depth_m[k] <= 0.0:
            break
        t = triangle[k]
        point[:] = origin
        for c in range(3):
            for axis in range(3):
                point[axis] += weights[k, c] * x[faces[t, c], axis]
        left_m = way_out(point, ways[k], frame, _REACH_M)
        if left_m <= 0.0:  # out by now; or cameras that abstain leave the hull without an end
            continue
        hull_speed, is_known = 0.0, False
        if elapsed_s > 0.0:
            advance_m = _advance_of_outline(point + left_m * ways[k], ways[k], frame, before)
            was_m = 0.0
            if np.isnan(advance_m):
                was_m = way_out(point, ways[k], before, left_m + reach_before_m)
            if not np.isnan(advance_m):
                hull_speed, is_known = advance_m / elapsed_s, True
            elif was_m > 0.0:
                hull_speed, is_known = (left_m - was_m) / elapsed_s, True
            elif was_m == 0.0:
                behind_m = _way_in(point, ways[k], before, reach_before_m)
                if behind_m >= 0.0:
                    hull_speed, is_known = (left_m + behind_m) / elapsed_s, True
        left_m += _BEYOND_M
        corner = np.argmax(weights[k])
        kept_sample[t, corner] = sample[k]
        kept_way[t, corner] = ways[k]
        total, free = 0.0, 0.0
        for c in range(3):
            total += weights[k, c] ** 2 * inverse_mass[faces[t, c]]
            if inverse_mass[faces[t, c]] > 0.0:
                free += weights[k, c]
        for c in range(3):
            node = faces[t, c]
            if inverse_mass[node] == 0.0:
                continue
            if whole:
                moved_m = left_m / free
            else:
                moved_m = left_m * weights[k, c] * inverse_mass[node] / total
            for axis in range(3):
                x[node, axis] += moved_m * ways[k, axis]
                shift[node, axis] += moved_m * ways[k, axis]
            shift[node, 3] += moved_m
            if is_known:
                speed[node, 0] += moved_m * hull_speed
                speed[node, 1] += moved_m
    return deepest_m, n_held


@compiled
def touch(
    x: NDArray[np.float64],
    v: NDArray[np.float64],
    x_start: NDArray[np.float64],
    inverse_mass: NDArray[np.float64],
    shift: NDArray[np.float64],
    speed: NDArray[np.float64],
    friction: float,
    side: NDArray[np.float64],
) -> int:
    """Give nodes that were moved out of something the speed of it, and its friction, in place.

    Speed that leads into it, against the way on which a node was moved, becomes that with which it
    comes; across the way, friction takes as much as `friction` times what was given along it, of
    the step's path and of the speed.

    Parameters
    ----------
    x, v, x_start : (N, 3) float64
        Nodes after they were moved, their speeds, and where they were before the step.
    inverse_mass : (N,) float64
        0 for nodes that do not move.
    shift, speed : (N, 4), (N, 2) float64
        See `push_hits`.
    friction : float
        Coulomb's.
    side : (N, 3) float64
        Where nodes were moved: written.

    Returns
    -------
    int
        How many nodes were moved.
    """
    n_moved = ZERO
    way, path = np.zeros(3), np.zeros(3)
    for i in range(len(x)):
        way[:] = shift[i, :3]
        length = np.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
        if length == 0.0 or inverse_mass[i] == 0.0:
            continue
        n_moved += 1
        way /= length
        side[i] = way
        comes = speed[i, 0] / speed[i, 1] if speed[i, 1] > 0.0 else 0.0
        along = v[i, 0] * way[0] + v[i, 1] * way[1] + v[i, 2] * way[2]
        given = comes - along
        if given > 0.0:
            v[i] += given * way
            along = comes
        if friction > 0.0:
            path[:] = x[i] - x_start[i]
            path -= (path[0] * way[0] + path[1] * way[1] + path[2] * way[2]) * way
            slid = np.sqrt(path[0] ** 2 + path[1] ** 2 + path[2] ** 2)
            if slid > 0.0:
                x[i] -= path * min(1.0, friction * length / slid)
            path[:] = v[i] - along * way
            slides = np.sqrt(path[0] ** 2 + path[1] ** 2 + path[2] ** 2)
            if slides > 0.0 and given > 0.0:
                v[i] -= path * min(1.0, friction * given / slides)
    return n_moved
