"""Whether a point is in the hull, compiled: of one camera, and of all.

`hybridve.hull.query.reference` is the specification.
"""

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import ZERO, compiled, inlined
from hybridve.hull.query.frame import Frame
from hybridve.hull.query.silhouettes import BACKGROUND, OBJECT

#: A point this near to the edge of a pixel, in pixels, is not called inside where whoever asks
#: again must get the same answer: a thousand times what rounding moves its projection.
EDGE_PX = 1e-7


@inlined
def project(x: float, y: float, z: float, m: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the depth of a point, local frame, and its pixel, by a projection (12,).

    The pixel means nothing unless the depth is positive.
    """
    depth_m = m[8] * x + m[9] * y + m[10] * z + m[11]
    return (
        depth_m,
        (m[0] * x + m[1] * y + m[2] * z + m[3]) / depth_m,
        (m[4] * x + m[5] * y + m[6] * z + m[7]) / depth_m,
    )


@inlined
def is_clear(pixel_x: float, pixel_y: float, edge_px: float) -> bool:
    """Tell whether a point of an image keeps so far from all edges of pixels."""
    in_x, in_y = pixel_x - np.floor(pixel_x), pixel_y - np.floor(pixel_y)
    return bool(edge_px < in_x < 1.0 - edge_px and edge_px < in_y < 1.0 - edge_px)


@inlined
def pixel_of(
    depth_m: float, pixel_x: float, pixel_y: float, width: int, height: int, first: int
) -> int:
    """Return where a flat buffer holds the pixel that sees a point; -1 where none does.

    The camera's image begins at `first`. Free of branches: several points in one instruction.
    """
    seen = (
        (depth_m > 0)
        & (pixel_x >= 0)
        & (pixel_x < float(width))
        & (pixel_y >= 0)
        & (pixel_y < float(height))
    )
    column, row = pixel_x if seen else 0.0, pixel_y if seen else 0.0
    return first + int(row) * width + int(column) if seen else -1


@compiled
def is_inside(
    x: float,
    y: float,
    z: float,
    cameras: NDArray[np.int64],
    n_cameras: int,
    n_accept: int,
    matrices: NDArray[np.float64],
    sizes: NDArray[np.int64],
    answers: NDArray[np.uint8],
    mask_offset: NDArray[np.int64],
    keep: bool,
    min_cameras: int,
    edge_px: float,
) -> bool:
    """Tell whether a point, local frame, is in the hull, asked of some of the frame's cameras.

    Of the others, so many as `n_accept` are known to see it on an object pixel, and none denies
    it. Where `edge_px` is above 0, only a point that keeps so far from all edges of pixels is
    called inside.
    """
    n_seen = n_accept
    for number in range(n_cameras):
        camera = cameras[number]
        width, height = sizes[camera, 0], sizes[camera, 1]
        depth_m, pixel_x, pixel_y = project(x, y, z, matrices[camera])
        if edge_px > 0.0 and depth_m > 0:
            is_near = -edge_px < pixel_x < width + edge_px and -edge_px < pixel_y < height + edge_px
            if is_near and not is_clear(pixel_x, pixel_y, edge_px):
                return False
        pixel = pixel_of(depth_m, pixel_x, pixel_y, width, height, mask_offset[camera])
        if pixel >= 0:
            answer = answers[pixel]
            if answer == BACKGROUND:
                return False
            n_seen += answer == OBJECT
        elif not keep:
            return False
    return not keep or n_seen >= min_cameras


@compiled
def are_inside(
    points: NDArray[np.float64], offset_local: NDArray[np.float64], frame: Frame
) -> NDArray[np.bool_]:
    """Tell which points (N, 3) are in the hull and clear of all edges of pixels.

    `offset_local` leads from their frame to the local one of the views.
    """
    inside = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        inside[i] = is_inside(
            points[i, 0] + offset_local[0],
            points[i, 1] + offset_local[1],
            points[i, 2] + offset_local[2],
            frame.every,
            len(frame.every),
            ZERO,
            frame.matrices,
            frame.sizes,
            frame.answers,
            frame.mask_offset,
            frame.keep,
            frame.min_cameras,
            EDGE_PX,
        )
    return inside
