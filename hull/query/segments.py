"""Where segments first enter the hull, and leave it: compiled, for loops that ask it themselves.

Between two crossings of pixels' edges a camera has one answer for all points of a segment, as
`hybridve.hull.query.walk` has it. So camera after camera is asked how long its answer lasts, and
what one denies the others need not be asked about: the answer is exact, nothing hides between
samples, however thin it is. Stretches shorter than `least` are left out, as they are there.

A long segment is looked at in pieces first: one whose rectangle of pixels holds no object pixel in
some camera is passed over at once.

Segments are given by a start (3,) and a way (3,), metres, local frame; a place on one by its share
t of the way, 0 to 1.
"""

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import ZERO, compiled
from hybridve.hull.query.boxes import REJECTS, pixel_range, rectangle_vote
from hybridve.hull.query.frame import Frame
from hybridve.hull.query.silhouettes import BACKGROUND, OBJECT, UNSEEN
from hybridve.hull.query.walk import WINDOW_PX, lines_crossed, next_crossing, seen_range

#: A piece that is not longer than this, in pixels of all cameras, is walked.
_FEW_PX = 8.0

#: The smallest piece that is not walked, as a share of the segment.
_SMALLEST_PIECE = 2.0**-10

#: By how much a piece's rectangle is grown, pixels: ten thousand times what rounding does to it.
_PAD_PX = 1e-6

#: Nearer to a camera's own plane than this, metres, a piece has no rectangle.
_LEAST_DEPTH_M = 1e-6

#: Less counts as this, lest a pixel be divided by zero.
_TINY_M = float(np.finfo(np.float64).tiny)

#: A silhouette's window with a smaller moment, as a share of a half plane's, has no direction.
_NO_MOMENT = 1e-6


@compiled
def place_segment(
    start: NDArray[np.float64],
    way: NDArray[np.float64],
    frame: Frame,
    begin: NDArray[np.float64],
    step: NDArray[np.float64],
) -> None:
    """Write the projections of a segment: that of the place at t is begin + t step, (C, 3) each."""
    for camera in range(len(frame.matrices)):
        m = frame.matrices[camera]
        for row in range(3):
            a, b, c = m[4 * row], m[4 * row + 1], m[4 * row + 2]
            begin[camera, row] = a * start[0] + b * start[1] + c * start[2] + m[4 * row + 3]
            step[camera, row] = a * way[0] + b * way[1] + c * way[2]


@compiled
def _answer(
    begin: NDArray[np.float64],
    step: NDArray[np.float64],
    from_t: float,
    camera: int,
    frame: Frame,
) -> tuple[int, float]:
    """Return what a camera says just behind `from_t`, below 1, and until where it says the same."""
    width, height = frame.sizes[camera, 0], frame.sizes[camera, 1]
    first_t, last_t = seen_range(begin, step, width, height, 1.0)
    if from_t < first_t:
        return UNSEEN, min(first_t, 1.0)
    if from_t >= last_t:
        return UNSEEN, 1.0
    x0, y0, z0 = begin
    x1, y1, z1 = step
    columns = lines_crossed(x0, z0, x1, z1, width, from_t, last_t)
    rows = lines_crossed(y0, z0, y1, z1, height, from_t, last_t)
    column_t, next_column = next_crossing(x0, z0, x1, z1, columns, from_t, last_t)
    row_t, next_row = next_crossing(y0, z0, y1, z1, rows, from_t, last_t)
    offset = frame.mask_offset[camera]
    said = -1
    at_t = from_t
    while at_t < last_t:
        until_t = min(column_t, row_t)
        middle_t = 0.5 * (at_t + until_t)
        depth_m = max(z0 + middle_t * z1, _TINY_M)
        x, y = (x0 + middle_t * x1) / depth_m, (y0 + middle_t * y1) / depth_m
        column = int(min(x, width - 1.0)) if x > 0 else 0
        row = int(min(y, height - 1.0)) if y > 0 else 0
        answer = int(frame.answers[offset + row * width + column])
        if said < 0:
            said = answer
        elif answer != said:
            return said, at_t
        at_t = until_t
        if column_t <= at_t:
            rest = (next_column, columns[1], columns[2])
            column_t, next_column = next_crossing(x0, z0, x1, z1, rest, at_t, last_t)
        if row_t <= at_t:
            rest = (next_row, rows[1], rows[2])
            row_t, next_row = next_crossing(y0, z0, y1, z1, rest, at_t, last_t)
    return said, last_t


@compiled
def _state(
    begin: NDArray[np.float64], step: NDArray[np.float64], at_t: float, frame: Frame
) -> tuple[bool, float, int]:
    """Tell whether a segment is in the hull just behind `at_t`, and until where that is sure.

    Then which camera denies it; -1 where none does.
    """
    n_seen, until_t = 0, 1.0
    for camera in range(len(begin)):
        answer, end_t = _answer(begin[camera], step[camera], at_t, camera, frame)
        if answer == BACKGROUND or (answer == UNSEEN and not frame.keep):
            return False, end_t, camera
        n_seen += answer == OBJECT
        until_t = min(until_t, end_t)
    return not frame.keep or n_seen >= frame.min_cameras, until_t, -1


@compiled
def _piece(
    begin: NDArray[np.float64],
    step: NDArray[np.float64],
    from_t: float,
    to_t: float,
    frame: Frame,
) -> tuple[int, float]:
    """Return a camera that proves a piece of a segment free, or -1; then its length in pixels.

    The length is that in the image where it is longest.
    """
    longest_px = 0.0
    for camera in range(len(begin)):
        x0, y0, z0 = begin[camera]
        x1, y1, z1 = step[camera]
        from_m, to_m = z0 + from_t * z1, z0 + to_t * z1
        if min(from_m, to_m) < _LEAST_DEPTH_M:
            continue
        from_x, to_x = (x0 + from_t * x1) / from_m, (x0 + to_t * x1) / to_m
        from_y, to_y = (y0 + from_t * y1) / from_m, (y0 + to_t * y1) / to_m
        width, height = frame.sizes[camera, 0], frame.sizes[camera, 1]
        first_x, last_x = pixel_range(
            min(from_x, to_x) - _PAD_PX, max(from_x, to_x) + _PAD_PX, width, ZERO
        )
        first_y, last_y = pixel_range(
            min(from_y, to_y) - _PAD_PX, max(from_y, to_y) + _PAD_PX, height, ZERO
        )
        vote = rectangle_vote(
            first_x,
            last_x,
            first_y,
            last_y,
            width,
            height,
            frame.integral_offset[camera],
            frame.integrals,
            frame.keep,
            camera,
            frame.recorded,
        )
        if vote == REJECTS:
            return camera, 0.0
        longest_px = max(longest_px, abs(to_x - from_x), abs(to_y - from_y))
    return -1, longest_px


@compiled
def first_entry(
    begin: NDArray[np.float64], step: NDArray[np.float64], least: float, frame: Frame
) -> tuple[float, int]:
    """Return where a placed segment first enters the hull, and the camera whose cone it enters.

    Parameters
    ----------
    begin, step : (C, 3) float64
        What `place_segment` wrote.
    least : float
        Shorter stretches in the hull are left out, as a share of the way.
    frame : Frame
        The hull.

    Returns
    -------
    at_t : float
        0 where it starts in the hull; infinite where it stays outside.
    camera : int
        As numbered in the frame; -1 where it starts in the hull, or where the number of cameras
        that see it changes there.
    """
    at_t, size_t, denier = 0.0, 1.0, -1
    while at_t < 1.0:
        to_t = min(at_t + size_t, 1.0)
        camera, length_px = _piece(begin, step, at_t, to_t, frame)
        if camera >= 0:
            denier = camera
            at_t = to_t
            size_t *= 2.0
            continue
        if length_px > _FEW_PX and size_t > _SMALLEST_PIECE:
            size_t *= 0.5
            continue
        while at_t < to_t:
            is_in, until_t, camera = _state(begin, step, at_t, frame)
            if is_in and until_t - at_t > least:
                return at_t, denier
            if not is_in:
                denier = camera
            at_t = until_t
        size_t *= 2.0
    return np.inf, -1


@compiled
def first_exit(
    begin: NDArray[np.float64], step: NDArray[np.float64], least: float, frame: Frame
) -> float:
    """Return where a placed segment is first outside of the hull: 0 at once, infinite never.

    As `first_entry`; gaps shorter than `least` are left out.
    """
    at_t = 0.0
    while at_t < 1.0:
        is_in, until_t, _ = _state(begin, step, at_t, frame)
        if not is_in and until_t - at_t > least:
            return at_t
        at_t = until_t
    return np.inf


@compiled
def outward_normal(
    point: NDArray[np.float64], camera: int, frame: Frame, normal: NDArray[np.float64]
) -> bool:
    """Write the normal of a camera's silhouette at a point of its boundary, local frame.

    As `hybridve.hull.query.walk.silhouette_normal`, but that what an abstaining camera does not see
    is left out of the window rather than guessed. Tell whether there is one.
    """
    m = frame.matrices[camera]
    width, height = frame.sizes[camera, 0], frame.sizes[camera, 1]
    depth_m = m[8] * point[0] + m[9] * point[1] + m[10] * point[2] + m[11]
    if depth_m < _LEAST_DEPTH_M:
        return False
    pixel_x = (m[0] * point[0] + m[1] * point[1] + m[2] * point[2] + m[3]) / depth_m
    pixel_y = (m[4] * point[0] + m[5] * point[1] + m[6] * point[2] + m[7]) / depth_m
    if not (-1.0 <= pixel_x <= width + 1.0 and -1.0 <= pixel_y <= height + 1.0):
        return False
    reach = int(WINDOW_PX) + 1
    middle_x, middle_y = int(np.floor(pixel_x)), int(np.floor(pixel_y))
    whole, whole_x, whole_y = 0.0, 0.0, 0.0
    held, held_x, held_y = 0.0, 0.0, 0.0
    for row in range(middle_y - reach, middle_y + reach + 1):
        y = row + 0.5 - pixel_y
        for column in range(middle_x - reach, middle_x + reach + 1):
            x = column + 0.5 - pixel_x
            weight = 1.0 - (x * x + y * y) / WINDOW_PX**2
            if weight <= 0.0:
                continue
            answer = BACKGROUND
            if 0 <= row < height and 0 <= column < width:
                answer = int(frame.answers[frame.mask_offset[camera] + row * width + column])
            elif frame.keep:
                continue
            if answer == UNSEEN:
                continue
            whole += weight
            whole_x += weight * x
            whole_y += weight * y
            if answer == OBJECT:
                held += weight
                held_x += weight * x
                held_y += weight * y
    # Of the pixels that are fewer: those of a whole disc do not balance about every point.
    if 2.0 * held > whole:
        held_x, held_y = held_x - whole_x, held_y - whole_y
    scale = 4.0 / 15.0 * WINDOW_PX**3
    if np.sqrt(held_x * held_x + held_y * held_y) <= _NO_MOMENT * scale:
        return False
    along = held_x * pixel_x + held_y * pixel_y
    for axis in range(3):
        normal[axis] = -held_x * m[axis] - held_y * m[4 + axis] + along * m[8 + axis]
    length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    for axis in range(3):
        normal[axis] /= length
    return True


@compiled
def segments_enter(
    starts: NDArray[np.float64], ways: NDArray[np.float64], least_m: float, frame: Frame
) -> NDArray[np.float64]:
    """Return where segments (N, 3), (N, 3) first enter the hull, (N,); see `first_entry`.

    Stretches shorter than `least_m` metres are left out.
    """
    at_t = np.full(len(starts), np.inf)
    begin, step = np.zeros((len(frame.matrices), 3)), np.zeros((len(frame.matrices), 3))
    for i in range(len(starts)):
        way = ways[i]
        length_m = np.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
        if length_m > 0.0:
            place_segment(starts[i], way, frame, begin, step)
            at_t[i], _ = first_entry(begin, step, least_m / length_m, frame)
    return at_t
