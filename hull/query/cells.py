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

Whether a cell's centre is in the hull is asked with `points.are_inside`: it is called so only where
it keeps `points.EDGE_PX` from the edges of its pixel in every camera, so that whoever asks again
gets the same answer.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import ZERO, compiled, inlined
from hybridve.hull.query.bounds import FREE, FULL, OPEN
from hybridve.hull.query.boxes import (
    ACCEPTS,
    REJECTS,
    UNDECIDED,
    WITHHOLDS,
    pixel_range,
    rectangle_vote,
)
from hybridve.hull.query.frame import Frame
from hybridve.hull.query.points import project
from hybridve.hull.query.silhouettes import Hull

_PAD = 40.0 * 2.0**-53

#: From this multiple of B_z on a depth is told from zero, rounding or not.
_NEAR = 1000.0 * 2.0**-53
_SMALLEST_NEAR_M = 1e-30


class CellFrame(NamedTuple):
    """The hull of one frame, asked about cells.

    Attributes
    ----------
    frame : Frame
        Silhouettes and projections.
    pads : (C, 4) float64
        40 u B_x, 40 u B_y and 40 u B_z of each camera, cameras as in the frame, and the depth in
        metres from which on a cube's rectangle is made of its projection.
    offset_local : (3,) float64
        From the cells' frame to the local frame of the views, metres; the axes are parallel.
    """

    frame: Frame
    pads: NDArray[np.float64]
    offset_local: NDArray[np.float64]


def make_cell_frame(
    hull: Hull, origin_world: NDArray[np.float64], reach_m: float, near_m: float = 0.0
) -> CellFrame:
    """Return the hull of a frame as cells within `reach_m` of `origin_world`, their origin, ask it.

    `reach_m` bounds each coordinate of any corner of a cell. A cube nearer than `near_m` to a
    camera's own plane is not projected: its rectangle would be most of the image, and the planes
    through the image's borders tell more.
    """
    frame = hull.frame
    offset_local = origin_world - hull.views.origin_world
    matrices = np.abs(frame.matrices.reshape(-1, 3, 4))
    largest = matrices[:, :, :3] @ (np.abs(offset_local) + reach_m) + matrices[:, :, 3]
    pads = _PAD * largest
    nearest_m = np.maximum(pads[:, 2:] * (_NEAR / _PAD) + _SMALLEST_NEAR_M, near_m)
    return CellFrame(frame, np.concatenate([pads, nearest_m], axis=1), offset_local)


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


@inlined
def _cube_bounds(
    x: float,
    y: float,
    z: float,
    half_m: float,
    m: NDArray[np.float64],
    pad_x: float,
    pad_y: float,
    pad_z: float,
) -> tuple[float, float, float, float]:
    """Return left, right, top and bottom, in pixels, of what a cube before a camera projects into.

    See this file's head.
    """
    depth_m, pixel_x, pixel_y = project(x, y, z, m)
    scale = 1.0 / (depth_m - half_m * (abs(m[8]) + abs(m[9]) + abs(m[10])))
    around_x = scale * (
        half_m
        * (abs(m[0] - pixel_x * m[8]) + abs(m[1] - pixel_x * m[9]) + abs(m[2] - pixel_x * m[10]))
        + pad_x
        + abs(pixel_x) * pad_z
    )
    around_y = scale * (
        half_m
        * (abs(m[4] - pixel_y * m[8]) + abs(m[5] - pixel_y * m[9]) + abs(m[6] - pixel_y * m[10]))
        + pad_y
        + abs(pixel_y) * pad_z
    )
    return pixel_x - around_x, pixel_x + around_x, pixel_y - around_y, pixel_y + around_y


@inlined
def cube_verdict(
    x: float,
    y: float,
    z: float,
    half_m: float,
    matrices: NDArray[np.float64],
    pads: NDArray[np.float64],
    sizes: NDArray[np.int64],
    integrals: NDArray[np.int32],
    integral_offset: NDArray[np.int64],
    recorded: NDArray[np.int64] | None,
    keep: bool,
    min_cameras: int,
) -> int:
    """Return what is proved of a cube about a point, local frame: `FREE`, `FULL` or `OPEN`."""
    n_accept, n_open, n_withheld = 0, 0, 0
    for camera in range(len(matrices)):
        m = matrices[camera]
        width, height, near_m = sizes[camera, 0], sizes[camera, 1], pads[camera, 3]
        depth_m = m[8] * x + m[9] * y + m[10] * z + m[11]
        thick_m = half_m * (abs(m[8]) + abs(m[9]) + abs(m[10]))
        low_x, high_x, low_y, high_y = -1.0, float(width), -1.0, float(height)
        if depth_m - thick_m >= near_m:
            low_x, high_x, low_y, high_y = _cube_bounds(
                x, y, z, half_m, m, pads[camera, 0], pads[camera, 1], pads[camera, 2]
            )
        elif depth_m + thick_m <= -near_m or _is_beside(
            x, y, z, half_m, m, pads[camera], width, height
        ):
            if keep:
                continue
            return FREE
        first_x, last_x = pixel_range(low_x, high_x, width, ZERO)
        first_y, last_y = pixel_range(low_y, high_y, height, ZERO)
        vote = rectangle_vote(
            first_x,
            last_x,
            first_y,
            last_y,
            width,
            height,
            integral_offset[camera],
            integrals,
            keep,
            camera,
            recorded,
        )
        if vote == REJECTS:
            return FREE
        n_accept += vote == ACCEPTS
        n_open += vote == UNDECIDED
        n_withheld += vote == WITHHOLDS
    if keep and n_accept + n_open < min_cameras:
        return FREE
    return FULL if n_open + n_withheld == 0 else OPEN


@compiled
def cube_verdicts(center: NDArray[np.float64], half_m: float, asked: CellFrame) -> NDArray[np.int8]:
    """Return what is proved of cubes about points (N, 3), cells' frame: `FREE`, `FULL`, `OPEN`."""
    frame, pads = asked.frame, asked.pads
    offset_x, offset_y, offset_z = asked.offset_local
    matrices, sizes, integrals = frame.matrices, frame.sizes, frame.integrals
    integral_offset, recorded = frame.integral_offset, frame.recorded
    keep, min_cameras = frame.keep, frame.min_cameras
    verdicts = np.zeros(len(center), np.int8)
    for i in range(len(center)):
        verdicts[i] = cube_verdict(
            center[i, 0] + offset_x,
            center[i, 1] + offset_y,
            center[i, 2] + offset_z,
            half_m,
            matrices,
            pads,
            sizes,
            integrals,
            integral_offset,
            recorded,
            keep,
            min_cameras,
        )
    return verdicts


@compiled
def cube_bounds(
    center: NDArray[np.float64], half_m: float, camera: int, asked: CellFrame
) -> NDArray[np.float64]:
    """Return left, right, top and bottom (N, 4), pixels, of what cubes project into in a camera.

    The camera is numbered as in the frame. Of a cube that is cut by the camera's own plane these
    are all numbers; behind it, right is left of left.
    """
    m, pads, offset = asked.frame.matrices[camera], asked.pads, asked.offset_local
    thick_m = half_m * (abs(m[8]) + abs(m[9]) + abs(m[10]))
    bounds_px = np.zeros((len(center), 4))
    for i in range(len(center)):
        x, y, z = center[i, 0] + offset[0], center[i, 1] + offset[1], center[i, 2] + offset[2]
        depth_m = m[8] * x + m[9] * y + m[10] * z + m[11]
        low_x, high_x, low_y, high_y = -np.inf, np.inf, -np.inf, np.inf
        if depth_m - thick_m >= pads[camera, 3]:
            low_x, high_x, low_y, high_y = _cube_bounds(
                x, y, z, half_m, m, pads[camera, 0], pads[camera, 1], pads[camera, 2]
            )
        elif depth_m + thick_m <= -pads[camera, 3]:
            low_x, high_x, low_y, high_y = np.inf, -np.inf, np.inf, -np.inf
        bounds_px[i, 0], bounds_px[i, 1] = low_x, high_x
        bounds_px[i, 2], bounds_px[i, 3] = low_y, high_y
    return bounds_px


@compiled
def split_cells(
    center: NDArray[np.float64], half_m: float, asked: CellFrame
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
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
    """
    frame, pads = asked.frame, asked.pads
    offset_x, offset_y, offset_z = asked.offset_local
    matrices, sizes, integrals = frame.matrices, frame.sizes, frame.integrals
    integral_offset, recorded = frame.integral_offset, frame.recorded
    keep, min_cameras = frame.keep, frame.min_cameras
    whole = np.zeros(8 * len(center), np.int64)
    part_center = np.zeros((8 * len(center), 3))
    n_parts = 0
    for i in range(len(center)):
        for octant in range(8):
            cell_x = center[i, 0] + (half_m if octant & 1 else -half_m)
            cell_y = center[i, 1] + (half_m if octant & 2 else -half_m)
            cell_z = center[i, 2] + (half_m if octant & 4 else -half_m)
            verdict = cube_verdict(
                cell_x + offset_x,
                cell_y + offset_y,
                cell_z + offset_z,
                half_m,
                matrices,
                pads,
                sizes,
                integrals,
                integral_offset,
                recorded,
                keep,
                min_cameras,
            )
            if verdict == FREE:
                continue
            whole[n_parts] = i
            part_center[n_parts, 0] = cell_x
            part_center[n_parts, 1] = cell_y
            part_center[n_parts, 2] = cell_z
            n_parts += 1
    return whole[:n_parts], part_center[:n_parts]
