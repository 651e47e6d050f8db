"""What one camera proves with a rectangle of its pixels, compiled: asked of whatever lies in it.

A set of points (a triangle, a tile of samples, a cube, a cell between two depths) projects into a
rectangle, which each of those that ask makes as suits it. What the rectangle then proves is one
question (`hybridve.hull.query.bounds` has the argument): four look-ups in an integral image count
its object pixels, four in another those that were recorded.
"""

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import compiled, inlined

#: A column or a row, of 64 bits.
Pixel = int | np.int64

#: What one camera's rectangle proves: no point inside, all on object pixels, none seen, nothing,
#: none seen on an object pixel (of a camera that may abstain; it may still reject some).
REJECTS, ACCEPTS, ABSTAINS, UNDECIDED, WITHHOLDS = 0, 1, 2, 3, 4


@inlined
def pixel_range(low: float, high: float, size: int, grown: int) -> tuple[int, int]:
    """Return the first and the last column (or row) that a rectangle from `low` to `high` touches.

    Grown by a number of pixels to both sides. Of what lies beyond an image of so many columns,
    only that it does is told: one column farther out than the growth reaches back.
    """
    least, most = -1.0 - grown, float(size + grown)
    return (
        int(np.floor(min(max(low, least), most))) - grown,
        int(np.floor(min(max(high, least), most))) + grown,
    )


@inlined
def _count(
    x0: Pixel, x1: Pixel, y0: Pixel, y1: Pixel, width: int, first: int, integrals: NDArray[np.int32]
) -> int:
    """Return how many pixels the integral image at `first` counts in x0..x1 - 1, y0..y1 - 1."""
    above, below = first + y0 * (width + 1), first + y1 * (width + 1)
    return int(
        integrals[below + x1]
        - integrals[above + x1]
        - integrals[below + x0]
        + integrals[above + x0]
    )


@compiled
def count_pixels(
    first_x: int,
    last_x: int,
    first_y: int,
    last_y: int,
    width: int,
    height: int,
    first: int,
    integrals: NDArray[np.int32],
) -> int:
    """Return how many pixels of a rectangle an integral image counts, which begins at `first`."""
    x0, x1 = max(first_x, 0), min(last_x + 1, width)
    y0, y1 = max(first_y, 0), min(last_y + 1, height)
    if x1 <= x0 or y1 <= y0:
        return 0
    return _count(x0, x1, y0, y1, width, first, integrals)


@inlined  # for 64-bit pixels only: callers convert, lest it be compiled twice
def rectangle_vote(
    first_x: Pixel,
    last_x: Pixel,
    first_y: Pixel,
    last_y: Pixel,
    width: int,
    height: int,
    first: int,
    integrals: NDArray[np.int32],
    keep: bool,
    camera: int,
    recorded: NDArray[np.int64] | None,
) -> int:
    """Return what a rectangle of pixels, which may reach beyond the image, proves in one camera.

    Its image is width x height pixels, its integral image begins at `first`, and that of what it
    recorded where `recorded` says of it. With `keep` it abstains where it does not see.
    """
    x0, x1 = max(first_x, 0), min(last_x + 1, width)
    y0, y1 = max(first_y, 0), min(last_y + 1, height)
    if x1 <= x0 or y1 <= y0:
        return ABSTAINS if keep else REJECTS
    wholly_seen = first_x >= 0 and first_y >= 0 and last_x < width and last_y < height
    count = _count(x0, x1, y0, y1, width, first, integrals)
    if recorded is not None:  # not compiled where it is
        start = recorded[camera]
        if start >= 0:
            n_seen = _count(x0, x1, y0, y1, width, start, integrals)
            if n_seen == 0:
                return ABSTAINS if keep else REJECTS
            wholly_seen = wholly_seen and n_seen == (x1 - x0) * (y1 - y0)
    if count == 0:
        return REJECTS if wholly_seen or not keep else WITHHOLDS
    if wholly_seen and count == (x1 - x0) * (y1 - y0):
        return ACCEPTS
    return UNDECIDED
