"""What the other cameras say that a camera sees: which of its pixels meet the hull of the others.

It is the silhouette of the hull of all cameras but one, as that one would see it. What this camera
sees outside of it, the others deny: they hold whatever is real, where they look. What it does not
see inside of it is no contradiction by itself: a hull is larger than what it was made of.

Squares of pixels are halved, as long as a point of the hull of the others is found on their rays
(`hybridve.hull.agreement.search`), down to `_STEP_PX`. A square in the midst of such squares is
taken to meet the hull with all its pixels; at the rim, and at the border of the image, each pixel
is asked.
"""

from contextlib import closing

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.agreement.search import (
    EMPTY,
    FOUND,
    Images,
    Pencils,
    Rule,
    images_of,
    make_pencils,
    search_cells,
)
from hybridve.hull.jit import ZERO, compiled
from hybridve.hull.query.points import project
from hybridve.hull.query.silhouettes import Hull, Views, make_hull
from hybridve.hull.query.threads import Threads

#: Side of the squares that are asked first, and of those that are not halved further unless they
#: lie at the rim; of these where it is asked what can be seen at all. In pixels.
_BLOCK_PX, _STEP_PX, _LOOK_PX = 32, 4, 8

#: Cells after which a square is taken to meet the hull.
_MOST_CELLS = 1000


def meets_others(hull: Hull, camera: int, pencils: Pencils | None = None) -> NDArray[np.bool_]:
    """Return which pixels of a camera meet the hull of all others.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame, of two cameras at least.
    camera : int
        The one that is left out. Its own silhouette plays no part.
    pencils : Pencils, optional
        Those of the hull's views, where they were made already.

    Returns
    -------
    (H, W) bool
        False where no point of the hull of the others projects into the pixel, by proof. Holes
        narrower than 8 px are overlooked.

    Raises
    ------
    ValueError
        If there is no other camera.
    """
    masks = [hull.mask(other) for other in range(len(hull.views))]
    return _met(hull.views, masks, camera, pencils, _STEP_PX)


def in_view_of_others(
    views: Views, camera: int, pencils: Pencils | None = None
) -> NDArray[np.bool_]:
    """Return through which pixels of a camera the hull of all others could be seen at all.

    That is `meets_others` of silhouettes that fill their images.
    """
    masks = [np.ones((height, width), np.uint8) for width, height in views.sizes_px.tolist()]
    return _met(views, masks, camera, pencils, _LOOK_PX)


def differences(
    mask: NDArray[np.bool_], others: NDArray[np.bool_], error_px: int
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where a silhouette and that of the others differ by more than outlines err.

    Parameters
    ----------
    mask : (H, W) bool
        What a camera sees.
    others : (H, W) bool
        What the others say that it sees.
    error_px : int
        What differs nowhere by more than this, across the outline, is left out.

    Returns
    -------
    sees_alone, misses : (H, W) bool
        What only the camera sees, and what only the others see; each up to the outlines.
    """
    return _beyond(mask, others, error_px), _beyond(others, mask, error_px)


def _beyond(
    first: NDArray[np.bool_], second: NDArray[np.bool_], error_px: int
) -> NDArray[np.bool_]:
    """Return what of one silhouette lies outside of another, around where it does so by more."""
    size = 2 * error_px + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    farther = first & (cv2.dilate(second.view(np.uint8), disc) == 0)
    return first & ~second & (cv2.dilate(farther.view(np.uint8), disc) > 0)


def _met(
    views: Views,
    masks: list[NDArray[np.uint8]],
    camera: int,
    pencils: Pencils | None,
    step_px: int,
) -> NDArray[np.bool_]:
    """Return which pixels of a camera meet the hull of the others' silhouettes (H, W)."""
    if len(views) < 2:
        raise ValueError("there is no other camera")
    # A search looks along rays of object pixels.
    whole = [np.ones_like(mask) if k == camera else mask for k, mask in enumerate(masks)]
    rule = Rule.of(views).without(camera)
    asked = (
        make_pencils(views) if pencils is None else pencils,
        images_of(make_hull(views, whole)),
        camera,
        rule.is_asked,
        rule.abstains,
        int(rule.needed),
        rule.tolerance_px,
        step_px,
    )
    width, height = views.sizes_px[camera].tolist()
    is_met = np.zeros((-(-height // step_px), -(-width // step_px)), np.bool_)
    result = np.zeros((height, width), np.bool_)
    bands = [(top, min(top + _BLOCK_PX, height)) for top in range(0, height, _BLOCK_PX)]
    with closing(Threads()) as threads:
        threads.run([(_ask_squares, (*asked, *band, is_met)) for band in bands])
        threads.run([(_ask_pixels, (*asked, *band, is_met, result)) for band in bands])
    return result


@compiled
def _ask_squares(
    pencils: Pencils,
    images: Images,
    camera: int,
    is_asked: NDArray[np.bool_],
    abstains: NDArray[np.bool_],
    needed: int,
    tolerance_px: NDArray[np.int64],
    step_px: int,
    first_row: int,
    end_row: int,
    is_met: NDArray[np.bool_],
) -> None:
    """Write which squares (rows, columns) of `step_px` pixels, between two rows, are met."""
    width, height = pencils.sizes[camera, 0], pencils.sizes[camera, 1]
    # Left, top, side, and a pixel that is known to be met, if any.
    waiting = np.zeros((64, 5), np.int64)
    for left_most in range(0, width, _BLOCK_PX):
        waiting[0, 0], waiting[0, 1], waiting[0, 2] = left_most, first_row, _BLOCK_PX
        waiting[0, 3] = waiting[0, 4] = -1
        n_waiting = 1
        while n_waiting > 0:
            n_waiting -= 1
            left, top, side = waiting[n_waiting, 0], waiting[n_waiting, 1], waiting[n_waiting, 2]
            known_x, known_y = waiting[n_waiting, 3], waiting[n_waiting, 4]
            if left >= width or top >= min(height, end_row):
                continue
            is_known = left <= known_x < left + side and top <= known_y < top + side
            if not is_known:
                verdict, _, x, y, z = search_cells(
                    pencils,
                    images,
                    camera,
                    float(left),
                    float(min(left + side, width)),
                    float(top),
                    float(min(top + side, height)),
                    is_asked,
                    abstains,
                    needed,
                    tolerance_px,
                    ZERO + _MOST_CELLS,
                )
                if verdict == EMPTY:
                    continue
                known_x = known_y = -1
                if verdict == FOUND:
                    _, pixel_x, pixel_y = project(x, y, z, pencils.matrices[camera])
                    known_x, known_y = int(pixel_x), int(pixel_y)
            if side <= step_px:
                is_met[top // step_px, left // step_px] = True
                continue
            half = side // 2
            for part in range(4):
                waiting[n_waiting, 0] = left + (part & 1) * half
                waiting[n_waiting, 1] = top + (part >> 1) * half
                waiting[n_waiting, 2] = half
                waiting[n_waiting, 3], waiting[n_waiting, 4] = known_x, known_y
                n_waiting += 1


@compiled
def _ask_pixels(
    pencils: Pencils,
    images: Images,
    camera: int,
    is_asked: NDArray[np.bool_],
    abstains: NDArray[np.bool_],
    needed: int,
    tolerance_px: NDArray[np.int64],
    step_px: int,
    first_row: int,
    end_row: int,
    is_met: NDArray[np.bool_],
    result: NDArray[np.bool_],
) -> None:
    """Write which pixels (H, W), between two rows, are met: of squares at the rim, each asked."""
    height, width = result.shape
    rows, columns = is_met.shape
    for row in range(first_row // step_px, -(-end_row // step_px)):
        for column in range(columns):
            if not is_met[row, column]:
                continue
            is_rim = row == 0 or column == 0 or row == rows - 1 or column == columns - 1
            for near_row in range(max(row - 1, 0), min(row + 2, rows)):
                for near_column in range(max(column - 1, 0), min(column + 2, columns)):
                    is_rim |= not is_met[near_row, near_column]
            for y in range(row * step_px, min((row + 1) * step_px, height)):
                for x in range(column * step_px, min((column + 1) * step_px, width)):
                    result[y, x] = True
                    if is_rim:
                        verdict, _, _, _, _ = search_cells(
                            pencils,
                            images,
                            camera,
                            float(x),
                            float(x + 1),
                            float(y),
                            float(y + 1),
                            is_asked,
                            abstains,
                            needed,
                            tolerance_px,
                            ZERO + _MOST_CELLS,
                        )
                        result[y, x] = verdict != EMPTY
