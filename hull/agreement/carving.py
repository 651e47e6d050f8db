"""How much of the silhouettes the others do not confirm, of outlines as they would be.

Limits of outlines compare two cameras at a time, and two cameras of one height tell each other's
heights alone. What three and more say together, a hull tells: here of the convex pieces of
outlines, drawn small, in a few frames. As they hold the silhouettes, what they do not confirm is
not confirmed by the silhouettes either.
"""

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.agreement.blocks import find_blocks
from hybridve.hull.agreement.outlines import OutlineTable
from hybridve.hull.agreement.search import images_of, make_pencils
from hybridve.hull.agreement.trials import Trial
from hybridve.hull.query.silhouettes import make_hull

#: The longer side of what is drawn, in pixels; how many frames; what outlines may be off, and the
#: sides of the squares that are asked for, in those pixels.
_SIDE_PX, _FRAMES, _ERROR_PX, _SQUARE_PX = 400, 8, 1, 4

#: Cells after which the search for what confirms a square is given up.
_CELLS = 500


class Unconfirmed(NamedTuple):
    """The share of squares of outlines that no point confirms: of all, and of each of C cameras."""

    all_: float
    by_camera: NDArray[np.float64]


def unconfirmed_shares(trial: Trial) -> Unconfirmed:
    """Return the share of squares of outlines that no point confirms; 0 of less than three cameras.

    A point must be seen by all cameras but one at least, and denied by none.
    """
    views, table = trial.views, trial.table
    count = len(views)
    if count < 3:
        return Unconfirmed(0.0, np.zeros(count))
    scale = _SIDE_PX / float(views.sizes_px.max())
    sizes_px = np.maximum((views.sizes_px * scale).astype(np.int64), 1)
    matrices = views.img_from_local.copy()
    matrices[:, :2] *= (sizes_px / views.sizes_px)[:, :, None]
    small = replace(
        views, sizes_px=sizes_px, img_from_local=matrices, unseen="carve", min_cameras=1, seen=None
    )
    pencils = make_pencils(small)
    told = np.flatnonzero(_is_whole(table))
    n_squares, n_unconfirmed = np.zeros(count), np.zeros(count)
    if len(told) == 0:
        return Unconfirmed(0.0, n_squares)
    for frame in told[np.unique(np.linspace(0, len(told) - 1, _FRAMES).astype(int))]:
        masks = [
            _drawn(
                table,
                int(frame),
                camera,
                sizes_px[camera],
                sizes_px[camera] / views.sizes_px[camera],
            )
            for camera in range(count)
        ]
        blocks = find_blocks(
            pencils,
            images_of(make_hull(small, masks)),
            np.ones(count, np.bool_),
            np.ones(count, np.bool_),
            count - 1,
            np.full(count, _ERROR_PX),
            np.full(count, _SQUARE_PX),
            _CELLS,
        )
        n_squares += blocks.n_blocks
        n_unconfirmed += np.bincount(blocks.unconfirmed[:, 0], minlength=count)
    return Unconfirmed(
        float(n_unconfirmed.sum() / max(n_squares.sum(), 1.0)),
        n_unconfirmed / np.maximum(n_squares, 1.0),
    )


def _is_whole(table: OutlineTable) -> NDArray[np.bool_]:
    """Return in which frames (F,) each camera saw something."""
    n_frames, n_cameras = table.is_inverse.shape
    return np.asarray((np.diff(table.first_piece).reshape(n_frames, n_cameras) > 0).all(axis=1))


def _drawn(
    table: OutlineTable,
    frame: int,
    camera: int,
    size_px: NDArray[np.int64],
    scale: NDArray[np.float64],
) -> NDArray[np.uint8]:
    image = np.zeros((int(size_px[1]), int(size_px[0])), np.uint8)
    row = frame * table.is_inverse.shape[1] + camera
    for piece in range(table.first_piece[row], table.first_piece[row + 1]):
        corners = (
            table.corners_px[table.first_corner[piece] : table.first_corner[piece + 1]] * scale
        )
        # In sixteenths of a pixel; OpenCV's pixel centres are at 0.
        cv2.fillConvexPoly(image, np.round(16.0 * (corners - 0.5)).astype(np.int32), 1, shift=4)
    return image
