"""Boxes of pixels: rows and columns from one up to another."""

import cv2
import numpy as np
from numpy.typing import NDArray

#: A part of an image: rows and columns, both from the first to the one after the last.
Box = tuple[int, int, int, int]


def slices_of(box: Box) -> tuple[slice, slice]:
    """Return the slices of an image that a box is."""
    return slice(box[0], box[1]), slice(box[2], box[3])


def is_empty(box: Box) -> bool:
    """Tell whether a box holds no pixel."""
    return box[0] >= box[1] or box[2] >= box[3]


def contains(box: Box, row: int, column: int) -> bool:
    """Tell whether a box holds another."""
    return box[0] <= row < box[1] and box[2] <= column < box[3]


def intersection(a: Box, b: Box) -> Box:
    """Return what two boxes share."""
    return max(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), min(a[3], b[3])


def union(a: Box, b: Box) -> Box:
    """Return the smallest box about two."""
    return min(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), max(a[3], b[3])


def grown_box(box: Box, margin: int) -> Box:
    """Return a box grown to all sides."""
    return box[0] - margin, box[1] + margin, box[2] - margin, box[3] + margin


def shifted(box: Box, shift_px: tuple[int, int]) -> Box:
    """Return a box moved to the right and down."""
    x, y = shift_px
    return box[0] + y, box[1] + y, box[2] + x, box[3] + x


def box_of(mask: NDArray[np.uint8]) -> Box:
    """Return the box of the pixels that are not 0."""
    left, top, width, height = cv2.boundingRect(mask)
    return top, top + height, left, left + width
