"""Squares of a silhouette that the other cameras do not confirm, and who denies them.

A *block* is a square of object pixels of one camera, wider than the outline's error to both sides,
so that something real is on the rays through it. It is *unconfirmed* where it is proved that no
point of its rays counts by a rule (`hybridve.hull.agreement.search.Rule`). Every point that is
found to count confirms its blocks in all cameras at once, so that most are never searched.

An unconfirmed block is *denied* by a camera without which such a point is found.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.agreement.search import (
    EMPTY,
    FOUND,
    Images,
    Pencils,
    counts,
    search_cells,
)
from hybridve.hull.jit import ZERO, compiled
from hybridve.hull.query.boxes import count_pixels
from hybridve.hull.query.points import project

#: Points of a lattice to each side, and how far apart they are, in sides of a block.
_LATTICE, _SPACING = 96, 0.5

#: Unconfirmed blocks of one camera of which is asked who denies them, evenly chosen.
_MOST_ASKED = 16


class Blocks(NamedTuple):
    """The blocks of all cameras.

    Attributes
    ----------
    n_blocks : (C,) int64
        How many each camera has.
    unconfirmed : (N, 3) int64
        Camera, left and top of those that are proved unconfirmed.
    n_denied : (C, C) int64
        Of how many unconfirmed blocks of the first camera the second is the denier.
    n_asked : (C,) int64
        Of how many this was asked.
    """

    n_blocks: NDArray[np.int64]
    unconfirmed: NDArray[np.int64]
    n_denied: NDArray[np.int64]
    n_asked: NDArray[np.int64]


@compiled
def _confirm(
    x: float,
    y: float,
    z: float,
    matrices: NDArray[np.float64],
    sizes: NDArray[np.int64],
    sides_px: NDArray[np.int64],
    offset: NDArray[np.int64],
    is_confirmed: NDArray[np.bool_],
) -> None:
    """Confirm the blocks of all cameras that a point, local frame, projects into."""
    for camera in range(len(sizes)):
        depth_m, pixel_x, pixel_y = project(x, y, z, matrices[camera])
        if not depth_m > 0.0:
            continue
        side = sides_px[camera]
        columns, rows = sizes[camera, 0] // side, sizes[camera, 1] // side
        if 0.0 <= pixel_x < columns * side and 0.0 <= pixel_y < rows * side:
            is_confirmed[
                offset[camera] + (int(pixel_y) // side) * columns + int(pixel_x) // side
            ] = True


@compiled
def _flood(
    x: float,
    y: float,
    z: float,
    spacing_m: float,
    pencils: Pencils,
    images: Images,
    is_asked: NDArray[np.bool_],
    abstains: NDArray[np.bool_],
    needed: int,
    tolerance_px: NDArray[np.int64],
    sides_px: NDArray[np.int64],
    offset: NDArray[np.int64],
    is_confirmed: NDArray[np.bool_],
) -> None:
    """Confirm the blocks of a point that counts, and of those that count around it, on a lattice.

    Neighbours on the lattice are asked as long as there are any, so that one point of a person
    soon confirms nearly all blocks of that person.
    """
    matrices, sizes = pencils.matrices, pencils.sizes
    was_asked = np.zeros(_LATTICE**3, np.bool_)
    waiting = np.zeros(_LATTICE**3, np.int64)
    middle = _LATTICE // 2
    waiting[0] = (middle * _LATTICE + middle) * _LATTICE + middle
    was_asked[waiting[0]] = True
    _confirm(x, y, z, matrices, sizes, sides_px, offset, is_confirmed)
    n_waiting = 1
    while n_waiting > 0:
        n_waiting -= 1
        place = waiting[n_waiting]
        for side in range(6):
            i, j, k = place // _LATTICE**2, place // _LATTICE % _LATTICE, place % _LATTICE
            by = 1 if side & 1 else -1
            if side < 2:
                i += by
            elif side < 4:
                j += by
            else:
                k += by
            if min(i, min(j, k)) < 0 or max(i, max(j, k)) >= _LATTICE:
                continue
            there = (i * _LATTICE + j) * _LATTICE + k
            if was_asked[there]:
                continue
            was_asked[there] = True
            there_x = x + (i - middle) * spacing_m
            there_y = y + (j - middle) * spacing_m
            there_z = z + (k - middle) * spacing_m
            if counts(
                there_x,
                there_y,
                there_z,
                pencils,
                images,
                is_asked,
                abstains,
                needed,
                tolerance_px,
            ):
                _confirm(there_x, there_y, there_z, matrices, sizes, sides_px, offset, is_confirmed)
                waiting[n_waiting] = there
                n_waiting += 1


@compiled
def find_blocks(
    pencils: Pencils,
    images: Images,
    is_asked: NDArray[np.bool_],
    abstains: NDArray[np.bool_],
    needed: int,
    tolerance_px: NDArray[np.int64],
    sides_px: NDArray[np.int64],
    most_cells: int,
) -> Blocks:
    """Return the blocks of all asked cameras, whose sides are (C,) pixels, and who denies them.

    The search on one block's rays is given up after `most_cells`, and the block left alone.
    """
    sizes, matrices = pencils.sizes, pencils.matrices
    n_cameras = len(sizes)
    # Per block of each camera's grid whether it is confirmed.
    offset = np.zeros(n_cameras + 1, np.int64)
    for camera in range(n_cameras):
        side = sides_px[camera]
        offset[camera + 1] = offset[camera] + (sizes[camera, 0] // side) * (
            sizes[camera, 1] // side
        )
    is_confirmed = np.zeros(offset[n_cameras], np.bool_)
    n_blocks = np.zeros(n_cameras, np.int64)
    n_asked = np.zeros(n_cameras, np.int64)
    n_denied = np.zeros((n_cameras, n_cameras), np.int64)
    unconfirmed = np.zeros((64, 3), np.int64)
    n_unconfirmed = 0
    for camera in range(n_cameras):
        if not is_asked[camera]:
            continue
        side = sides_px[camera]
        width, height = sizes[camera, 0], sizes[camera, 1]
        columns, rows = width // side, height // side
        # Of a pixel in the middle, at a depth of 1 m.
        m_per_px = np.sqrt((pencils.rays[camera, :, 0] ** 2).sum()) / max(width, height)
        first = images.integral_offset[camera]
        for row in range(rows):
            top = row * side
            in_row = count_pixels(
                ZERO, width - 1, top, top + side - 1, width, height, first, images.integrals
            )
            if in_row < side * side:
                continue
            for column in range(columns):
                left = column * side
                n_object = count_pixels(
                    left,
                    left + side - 1,
                    top,
                    top + side - 1,
                    width,
                    height,
                    first,
                    images.integrals,
                )
                if n_object < side * side:
                    continue
                n_blocks[camera] += 1
                if is_confirmed[offset[camera] + row * columns + column]:
                    continue
                verdict, _, x, y, z = search_cells(
                    pencils,
                    images,
                    camera,
                    float(left),
                    float(left + side),
                    float(top),
                    float(top + side),
                    is_asked,
                    abstains,
                    needed,
                    tolerance_px,
                    most_cells,
                )
                if verdict == FOUND:
                    depth_m, _, _ = project(x, y, z, matrices[camera])
                    _flood(
                        x,
                        y,
                        z,
                        _SPACING * side * depth_m * m_per_px,
                        pencils,
                        images,
                        is_asked,
                        abstains,
                        needed,
                        tolerance_px,
                        sides_px,
                        offset,
                        is_confirmed,
                    )
                elif verdict == EMPTY:
                    if n_unconfirmed == len(unconfirmed):
                        longer = np.zeros((2 * n_unconfirmed, 3), np.int64)
                        longer[:n_unconfirmed] = unconfirmed
                        unconfirmed = longer
                    unconfirmed[n_unconfirmed, 0] = camera
                    unconfirmed[n_unconfirmed, 1] = left
                    unconfirmed[n_unconfirmed, 2] = top
                    n_unconfirmed += 1
    unconfirmed = unconfirmed[:n_unconfirmed]

    is_left = is_asked.copy()
    begin = 0
    while begin < n_unconfirmed:
        camera = unconfirmed[begin, 0]
        end = begin
        while end < n_unconfirmed and unconfirmed[end, 0] == camera:
            end += 1
        side = sides_px[camera]
        n_asked[camera] = min(end - begin, _MOST_ASKED)
        for number in range(n_asked[camera]):
            block = begin + number * (end - begin) // n_asked[camera]
            left, top = unconfirmed[block, 1], unconfirmed[block, 2]
            for denier in range(n_cameras):
                if denier == camera or not is_asked[denier]:
                    continue
                is_left[denier] = False
                verdict, _, _, _, _ = search_cells(
                    pencils,
                    images,
                    camera,
                    float(left),
                    float(left + side),
                    float(top),
                    float(top + side),
                    is_left,
                    abstains,
                    needed,
                    tolerance_px,
                    most_cells,
                )
                is_left[denier] = True
                if verdict == FOUND:
                    n_denied[camera, denier] += 1
        begin = end
    return Blocks(n_blocks, unconfirmed, n_denied, n_asked)
