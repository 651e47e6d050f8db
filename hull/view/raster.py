"""Triangles and lines drawn into a depth buffer, in compiled loops on the CPU.

A picture needs no more than a few hundred thousand triangles once, so that drawing them here is a
matter of a second, comes out the same on every machine, and needs no graphics device.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import compiled
from hybridve.hull.view.march import in_bands

#: Nothing nearer to the viewer than this is drawn, metres.
_NEAR_M = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """A picture with depth.

    Attributes
    ----------
    depth_m : (H, W) float32
        Depth along the viewing axis of what is seen, infinite where nothing is.
    color : (H, W, 3) uint8
        Its colour, BGR.
    number : (H, W) int32
        The triangle that is seen, -1 where none is.
    """

    depth_m: NDArray[np.float32]
    color: NDArray[np.uint8]
    number: NDArray[np.int32]


def make_layer(size_px: tuple[int, int]) -> Layer:
    """Return a layer of this width and height with nothing on it."""
    width, height = size_px
    return Layer(
        np.full((height, width), np.inf, np.float32),
        np.zeros((height, width, 3), np.uint8),
        np.full((height, width), -1, np.int32),
    )


def draw_triangles(
    layer: Layer,
    corners_img: NDArray[np.float64],
    colors: NDArray[np.float64],
    numbers: NDArray[np.int32],
) -> None:
    """Draw triangles over what is farther away.

    Parameters
    ----------
    layer : Layer
        Drawn into.
    corners_img : (T, 3, 3) float64
        Pixels x and y, pixel centre at 0.5, and depth in metres, which must be positive.
    colors : (T, 3, 3) float64
        BGR of each corner, 0 to 255.
    numbers : (T,) int32
        What `Layer.number` becomes.
    """
    if len(corners_img) == 0:
        return

    def draw(start: int, stop: int) -> None:
        _fill_triangles(
            layer.depth_m, layer.color, layer.number, start, stop, corners_img, colors, numbers
        )

    in_bands(draw, len(layer.depth_m))


def draw_points(
    layer: Layer, points_img: NDArray[np.float64], color: tuple[int, int, int], radius_px: float
) -> None:
    """Draw discs at points (N, 3) in pixels and metres of depth over what is farther away."""
    visible = np.isfinite(points_img).all(axis=1) & (points_img[:, 2] > _NEAR_M)
    if visible.any():
        _fill_discs(
            layer.depth_m,
            layer.color,
            np.ascontiguousarray(points_img[visible]),
            np.array(color, np.float64),
            radius_px,
        )


def clip_triangles(
    corners_cam: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Cut off what lies behind the viewer.

    Parameters
    ----------
    corners_cam : (T, 3, K) float64
        The first three of K numbers are a corner in the viewer's frame, metres; the others (a
        colour, say) are interpolated where an edge is cut.

    Returns
    -------
    corners_cam : (M, 3, K) float64
        Triangles in front of the viewer.
    source : (M,) int64
        The triangle that each is a part of.
    """
    in_front = corners_cam[..., 2] > _NEAR_M  # (T, 3)
    whole = in_front.all(axis=1)
    parts, sources = [corners_cam[whole]], [np.flatnonzero(whole)]
    for triangle in np.flatnonzero(in_front.any(axis=1) & ~whole):
        polygon = []
        for corner in range(3):
            a, b = corners_cam[triangle, corner], corners_cam[triangle, (corner + 1) % 3]
            if a[2] > _NEAR_M:
                polygon.append(a)
            if (a[2] > _NEAR_M) != (b[2] > _NEAR_M):
                share = (2 * _NEAR_M - a[2]) / (b[2] - a[2])
                polygon.append(a + min(max(share, 0.0), 1.0) * (b - a))
        fan = [np.array([polygon[0], *polygon[k : k + 2]]) for k in range(1, len(polygon) - 1)]
        parts.append(np.array(fan))
        sources.append(np.full(len(fan), triangle))
    return np.concatenate(parts), np.concatenate(sources)


def line_triangles(
    ends_img: NDArray[np.float64], width_px: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the triangles of lines of a width in pixels.

    Parameters
    ----------
    ends_img : (L, 2, 3) float64
        Pixels and metres of depth.
    width_px : float
        How wide the line is drawn.

    Returns
    -------
    corners_img : (2 L, 3, 3) float64
        Ready for `draw_triangles`.
    source : (2 L,) int64
        The line that each triangle is a half of.
    """
    along = ends_img[:, 1, :2] - ends_img[:, 0, :2]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.divide(along, length, out=np.zeros_like(along), where=length > 0)
    side = np.zeros((len(ends_img), 3))
    side[:, 0], side[:, 1] = -along[:, 1], along[:, 0]
    side *= 0.5 * width_px
    a, b = ends_img[:, 0], ends_img[:, 1]
    first = np.stack([a - side, b - side, b + side], axis=1)
    second = np.stack([a - side, b + side, a + side], axis=1)
    source = np.arange(len(ends_img))
    return np.concatenate([first, second]), np.concatenate([source, source])


def clip_lines(ends_cam: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Cut off what of lines (L, 2, 3) in the viewer's frame lies behind the viewer.

    Returns
    -------
    ends_cam : (M, 2, 3) float64
    source : (M,) int64
    """
    depth_m = ends_cam[..., 2]
    keep = np.flatnonzero((depth_m > _NEAR_M).any(axis=1))
    ends = ends_cam[keep].copy()
    for end in range(2):
        behind = ends[:, end, 2] <= _NEAR_M
        here, there = ends[behind, end], ends[behind, 1 - end]
        share = (2 * _NEAR_M - here[:, 2]) / (there[:, 2] - here[:, 2])
        ends[behind, end] = here + np.clip(share, 0.0, 1.0)[:, None] * (there - here)
    return ends, keep


@compiled
def _narrow(enter: float, leave: float, at: float, slope: float) -> tuple[float, float]:
    """Return the part of an interval where ``at + slope x`` is not negative."""
    if slope > 0.0:
        return max(enter, -at / slope), leave
    if slope < 0.0:
        return enter, min(leave, -at / slope)
    return (enter, leave) if at >= 0.0 else (1.0, 0.0)


@compiled
def _fill_triangles(
    depth_m: NDArray[np.float32],
    color: NDArray[np.uint8],
    number: NDArray[np.int32],
    start: int,
    stop: int,
    corners: NDArray[np.float64],
    colors: NDArray[np.float64],
    numbers: NDArray[np.int32],
) -> None:
    """Draw the rows `start` to `stop` of all triangles; colours are perspectively correct."""
    width = depth_m.shape[1]
    for triangle in range(len(corners)):
        ax, ay, az = corners[triangle, 0]
        bx, by, bz = corners[triangle, 1]
        cx, cy, cz = corners[triangle, 2]
        low, high = min(ay, by, cy), max(ay, by, cy)
        left, right = min(ax, bx, cx), max(ax, bx, cx)
        if not (high > start and low < stop and right > 0.0 and left < width):
            continue
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        first_row = max(start, int(np.floor(max(low, start) - 0.5)))
        last_row = min(stop - 1, int(np.ceil(min(high, stop) - 0.5)))
        slope_b, slope_c = (cy - ay) / area, -(by - ay) / area  # of the weights along a row
        slope_a = -slope_b - slope_c
        for row in range(first_row, last_row + 1):
            y = row + 0.5
            # Where along the row all three weights are positive.
            at_b = (-ax * (cy - ay) - (y - ay) * (cx - ax)) / area
            at_c = ((bx - ax) * (y - ay) + (by - ay) * ax) / area
            enter, leave = max(left, 0.0), min(right, float(width))
            enter, leave = _narrow(enter, leave, 1.0 - at_b - at_c, slope_a)
            enter, leave = _narrow(enter, leave, at_b, slope_b)
            enter, leave = _narrow(enter, leave, at_c, slope_c)
            if enter > leave:
                continue
            first_column = max(0, int(np.ceil(enter - 0.5)))
            last_column = min(width - 1, int(np.floor(leave - 0.5)))
            for column in range(first_column, last_column + 1):
                x = column + 0.5
                b, c = at_b + slope_b * x, at_c + slope_c * x
                a = 1.0 - b - c
                # The inverse of depth is what is linear in the image.
                inverse = a / az + b / bz + c / cz
                here = 1.0 / inverse
                if here >= depth_m[row, column]:
                    continue
                depth_m[row, column] = here
                number[row, column] = numbers[triangle]
                wa, wb, wc = a / az * here, b / bz * here, c / cz * here
                for channel in range(3):
                    value = (
                        wa * colors[triangle, 0, channel]
                        + wb * colors[triangle, 1, channel]
                        + wc * colors[triangle, 2, channel]
                    )
                    color[row, column, channel] = np.uint8(min(max(value, 0.0), 255.0))


@compiled
def _fill_discs(
    depth_m: NDArray[np.float32],
    color: NDArray[np.uint8],
    points: NDArray[np.float64],
    bgr: NDArray[np.float64],
    radius_px: float,
) -> None:
    height, width = depth_m.shape
    reach = int(np.ceil(radius_px))
    for point in range(len(points)):
        x, y, z = points[point]
        if not (-reach < x < width + reach and -reach < y < height + reach):
            continue
        middle_column, middle_row = int(np.floor(x)), int(np.floor(y))
        for row in range(max(0, middle_row - reach), min(height, middle_row + reach + 1)):
            for column in range(
                max(0, middle_column - reach), min(width, middle_column + reach + 1)
            ):
                away = (column + 0.5 - x) ** 2 + (row + 0.5 - y) ** 2
                if away <= radius_px * radius_px and z < depth_m[row, column]:
                    depth_m[row, column] = z
                    for channel in range(3):
                        color[row, column, channel] = np.uint8(bgr[channel])
