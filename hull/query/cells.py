"""Cells of space in the hull's sight: cubes that are cut into eight, and what is proved of each.

A cube is *free* where the rectangle that it projects into holds no object pixel in some camera:
then no point of it is in the hull. A camera that may abstain must see all of the rectangle for
that. Where it sees a part, without an object pixel, it can support no point of the cube, and the
cube is free as well once fewer than ``min_cameras`` cameras can. (Without this, cubes astride the
border of what a camera sees would stay open however small they are, and all along that border.)
The argument is that of `hybridve.hull.query.bounds`, with another rectangle, which spares the
projection of eight corners. Let p be the pixel of the cube's
centre, h half of its edge, P the projection matrix, w the depth of the centre, and x = center + d
with |d_j| <= h. Then the pixel of x is off p, along the image's rows, by

    (P_1 . d - p_x P_3 . d) / (w + P_3 . d),

at most h sum_j |P_1j - p_x P_3j| / w_min, where w_min = w - h sum_j |P_3j| is the smallest depth in
the cube: exact to first order in h, and a proof at any h as long as w_min is positive.

Rounding: p is off by at most 4.3 u (B_x + |p| B_z) / w, the bound of the offset by less than three
times as much over w_min (B_k as in `bounds`, u the unit roundoff), so that a rectangle that is
widened by 40 u (B_x + |p_x| B_z) / w_min holds the pixel of every point of the cube, and of every
point that is computed within 16 u of one.

A centre is called *inside* only where its pixel keeps 1e-7 px from the edges of its pixel in every
camera, a thousand times what rounding moves it: whoever asks again gets the same answer.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import ZERO, compiled
from hybridve.hull.query.clusters import make_frame
from hybridve.hull.query.rectangles import (
    ACCEPTS,
    REJECTS,
    UNDECIDED,
    Frame,
    rectangle_vote,
)
from hybridve.hull.query.silhouettes import BACKGROUND, OBJECT, Hull

_PAD = 40.0 * 2.0**-53

#: From this multiple of B_z on a depth is told from zero, rounding or not.
_NEAR = 1000.0 * 2.0**-53

#: A point this near to the edge of a pixel, in pixels, is not called inside.
_EDGE_PX = 1e-7


class CellFrame(NamedTuple):
    """The hull of one frame, asked about cells.

    Attributes
    ----------
    frame : Frame
        Silhouettes and projections.
    pads : (C, 3) float64
        40 u B_x, 40 u B_y and 40 u B_z of each camera, cameras as in the frame.
    offset_local : (3,) float64
        From the cells' frame to the local frame of the views, metres; the axes are parallel.
    """

    frame: Frame
    pads: NDArray[np.float64]
    offset_local: NDArray[np.float64]


def make_cell_frame(hull: Hull, origin_world: NDArray[np.float64], reach_m: float) -> CellFrame:
    """Return the hull of a frame as cells within `reach_m` of `origin_world`, their origin, ask it.

    `reach_m` bounds each coordinate of any corner of a cell.
    """
    frame = make_frame(hull)
    offset_local = origin_world - hull.views.origin_world
    matrices = np.abs(frame.matrices.reshape(-1, 3, 4))
    largest = matrices[:, :, :3] @ (np.abs(offset_local) + reach_m) + matrices[:, :, 3]
    return CellFrame(frame, _PAD * largest, offset_local)


@compiled
def is_inside(
    x: float,
    y: float,
    z: float,
    matrices: NDArray[np.float64],
    sizes: NDArray[np.int64],
    answers: NDArray[np.uint8],
    mask_offset: NDArray[np.int64],
    keep: bool,
    min_cameras: int,
) -> bool:
    """Tell whether a point, local frame, is in the hull and clear of all edges of pixels."""
    n_seen = ZERO
    for camera in range(len(matrices)):
        m = matrices[camera]
        depth_m = m[8] * x + m[9] * y + m[10] * z + m[11]
        if depth_m > 0:
            width, height = sizes[camera, 0], sizes[camera, 1]
            pixel_x = (m[0] * x + m[1] * y + m[2] * z + m[3]) / depth_m
            pixel_y = (m[4] * x + m[5] * y + m[6] * z + m[7]) / depth_m
            if -_EDGE_PX < pixel_x < width + _EDGE_PX and -_EDGE_PX < pixel_y < height + _EDGE_PX:
                column, row = int(pixel_x), int(pixel_y)
                if (
                    not _EDGE_PX < pixel_x - column < 1.0 - _EDGE_PX
                    or not _EDGE_PX < pixel_y - row < 1.0 - _EDGE_PX
                ):
                    return False
                answer = answers[mask_offset[camera] + row * width + column]
                if answer == BACKGROUND:
                    return False
                n_seen += answer == OBJECT
                continue
        if not keep:
            return False
    return not keep or n_seen >= min_cameras


@compiled
def are_inside(points: NDArray[np.float64], asked: CellFrame) -> NDArray[np.bool_]:
    """Tell which points (N, 3), cells' frame, are in the hull and clear of all edges of pixels."""
    frame, offset = asked.frame, asked.offset_local
    inside = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        inside[i] = is_inside(
            points[i, 0] + offset[0],
            points[i, 1] + offset[1],
            points[i, 2] + offset[2],
            frame.matrices,
            frame.sizes,
            frame.answers,
            frame.mask_offset,
            frame.keep,
            frame.min_cameras,
        )
    return inside


@compiled
def _is_beside(
    x: float,
    y: float,
    z: float,
    half_m: float,
    m: NDArray[np.float64],
    pads: NDArray[np.float64],
    width_px: int,
    height_px: int,
) -> bool:
    """Tell whether a cube that the camera's own plane cuts lies beside the image, wholly.

    Where the depth w is positive, a point is left of the image if its homogeneous x is negative,
    right of it if x - width w is positive: linear in the point, so no division by depth is needed.
    """
    for axis in range(2):
        row, size = 4 * axis, float(width_px if axis == 0 else height_px)
        for border in range(2):
            far = size * border
            sign = 1.0 if border else -1.0
            form = sign * (
                (m[row] - far * m[8]) * x
                + (m[row + 1] - far * m[9]) * y
                + (m[row + 2] - far * m[10]) * z
                + (m[row + 3] - far * m[11])
            )
            around = half_m * (
                abs(m[row] - far * m[8])
                + abs(m[row + 1] - far * m[9])
                + abs(m[row + 2] - far * m[10])
            )
            if form - around > pads[axis] + far * pads[2]:
                return True
    return False


@compiled
def split_cells(
    center: NDArray[np.float64], half_m: float, asked: CellFrame
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
    """Cut cells into eight and return the parts that are not proved free.

    Parameters
    ----------
    center : (N, 3) float64
        The cells' centres, metres, in the cells' frame.
    half_m : float
        Half of an edge of the parts.
    asked : CellFrame
        The hull.

    Returns
    -------
    whole : (K,) int64
        The cell that each part is of, ascending.
    center : (K, 3) float64
        The centres of the parts.
    inside : (K,) bool
        Which of these are in the hull.
    """
    frame, pads = asked.frame, asked.pads
    offset_x, offset_y, offset_z = asked.offset_local
    matrices, sizes, integrals = frame.matrices, frame.sizes, frame.integrals
    answers, mask_offset = frame.answers, frame.mask_offset
    integral_offset = frame.integral_offset
    keep, min_cameras, n_cameras = frame.keep, frame.min_cameras, len(frame.matrices)
    whole = np.zeros(8 * len(center), np.int64)
    part_center = np.zeros((8 * len(center), 3))
    inside = np.zeros(8 * len(center), np.bool_)
    n_parts = 0
    for i in range(len(center)):
        for octant in range(8):
            cell_x = center[i, 0] + (half_m if octant & 1 else -half_m)
            cell_y = center[i, 1] + (half_m if octant & 2 else -half_m)
            cell_z = center[i, 2] + (half_m if octant & 4 else -half_m)
            x, y, z = cell_x + offset_x, cell_y + offset_y, cell_z + offset_z
            is_free, n_accept, n_left = False, 0, 0
            for camera in range(n_cameras):
                m = matrices[camera]
                width, height = sizes[camera, 0], sizes[camera, 1]
                depth_m = m[8] * x + m[9] * y + m[10] * z + m[11]
                thick_m = half_m * (abs(m[8]) + abs(m[9]) + abs(m[10]))
                near_m = pads[camera, 2] * (_NEAR / _PAD) + 1e-30
                if depth_m + thick_m <= -near_m:  # behind: never seen
                    if keep:
                        continue
                    is_free = True
                    break
                if depth_m - thick_m >= near_m:
                    scale = 1.0 / (depth_m - thick_m)
                    pixel_x = (m[0] * x + m[1] * y + m[2] * z + m[3]) / depth_m
                    pixel_y = (m[4] * x + m[5] * y + m[6] * z + m[7]) / depth_m
                    around_x = scale * (
                        half_m
                        * (
                            abs(m[0] - pixel_x * m[8])
                            + abs(m[1] - pixel_x * m[9])
                            + abs(m[2] - pixel_x * m[10])
                        )
                        + pads[camera, 0]
                        + abs(pixel_x) * pads[camera, 2]
                    )
                    around_y = scale * (
                        half_m
                        * (
                            abs(m[4] - pixel_y * m[8])
                            + abs(m[5] - pixel_y * m[9])
                            + abs(m[6] - pixel_y * m[10])
                        )
                        + pads[camera, 1]
                        + abs(pixel_y) * pads[camera, 2]
                    )
                    low_x, high_x = pixel_x - around_x, pixel_x + around_x
                    low_y, high_y = pixel_y - around_y, pixel_y + around_y
                elif _is_beside(x, y, z, half_m, m, pads[camera], width, height):
                    if keep:
                        continue
                    is_free = True
                    break
                else:
                    low_x, low_y = -1.0, -1.0
                    high_x, high_y = float(width), float(height)
                vote = rectangle_vote(
                    np.int64(np.floor(min(max(low_x, -1.0), width))),
                    np.int64(np.floor(min(max(high_x, -1.0), width))),
                    np.int64(np.floor(min(max(low_y, -1.0), height))),
                    np.int64(np.floor(min(max(high_y, -1.0), height))),
                    width,
                    height,
                    integral_offset[camera],
                    integrals,
                    keep,
                    camera,
                    frame.recorded,
                )
                if vote == REJECTS:
                    is_free = True
                    break
                if vote == ACCEPTS:
                    n_accept += 1
                elif vote == UNDECIDED:
                    n_left += 1
            if is_free or (keep and n_accept + n_left < min_cameras):
                continue
            whole[n_parts] = i
            part_center[n_parts, 0] = cell_x
            part_center[n_parts, 1] = cell_y
            part_center[n_parts, 2] = cell_z
            inside[n_parts] = is_inside(
                x, y, z, matrices, sizes, answers, mask_offset, keep, min_cameras
            )
            n_parts += 1
    return whole[:n_parts], part_center[:n_parts], inside[:n_parts]
