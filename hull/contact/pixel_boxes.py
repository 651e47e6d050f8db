"""Boxes of pixels: rows and columns from one up to another."""

import itertools

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.contact.detect import Body
from hybridve.hull.query.silhouettes import Views

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


def windows_of(views: Views, body: Body) -> list[Box]:
    """Return for each camera a box that the object projects into, with some pixels to spare."""
    ends_world = np.stack([body.lower_world, body.upper_world])
    corners_world = np.array(list(itertools.product(*ends_world.T)))  # (8, 3)
    windows = []
    for camera, (width, height) in enumerate(views.sizes_px.tolist()):
        whole = (0, height, 0, width)
        projected = views.project(corners_world, camera)  # (8, 3)
        if projected[:, 2].min() <= 1e-6:
            windows.append(whole)  # part of it is behind the camera
            continue
        pixels = projected[:, :2] / projected[:, 2:]
        left, top = np.clip(np.floor(pixels.min(axis=0)) - 2, 0, (width, height)).tolist()
        right, bottom = np.clip(np.ceil(pixels.max(axis=0)) + 2, 0, (width, height)).tolist()
        windows.append((int(top), int(bottom), int(left), int(right)))
    return windows
