"""A recorded camera as a view: from its place, with its field of view, its principal point."""

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.silhouettes import Views
from hybridve.hull.view.novel import NovelView


def recorded_view(views: Views, camera: int, range_m: tuple[float, float]) -> NovelView:
    """Return the view of one of the cameras: its whole pinhole image.

    Drawn `views.sizes_px[camera]` large, pixels are those of the image.

    Parameters
    ----------
    views : Views
        The cameras.
    camera : int
        Which.
    range_m : tuple of float
        The nearest and farthest depth drawn.
    """
    size_px = views.sizes_px[camera]
    return view_of_matrix(views.img_from_local[camera], size_px, views.origin_world, range_m)


def view_of_matrix(
    img_from_local: NDArray[np.float64],
    size_px: NDArray[np.int64] | NDArray[np.float64],
    origin_world: NDArray[np.float64],
    range_m: tuple[float, float],
) -> NovelView:
    """Return the view of a projection (3, 4), pixels from metres about an origin.

    Its third row tells the depth in metres, as `Views` has it.
    """
    x, y, forward = img_from_local[:, :3]
    middle_x, middle_y = x @ forward, y @ forward
    y = y - middle_y * forward
    focal_y = float(np.linalg.norm(y))
    down = y / focal_y
    x = x - middle_x * forward
    skew_px = float(x @ down)
    x = x - skew_px * down
    focal_x = float(np.linalg.norm(x))
    half_x, half_y = size_px[0] / 2 / focal_x, size_px[1] / 2 / focal_y
    off_y = (size_px[1] / 2 - middle_y) / focal_y
    off_x = (size_px[0] / 2 - middle_x - skew_px * off_y) / focal_x
    center = -np.linalg.solve(img_from_local[:, :3], img_from_local[:, 3])
    return NovelView(
        center + origin_world,
        x / focal_x,
        down,
        forward,
        np.array([half_x, half_y]),
        range_m,
        middle=np.array([off_x, off_y]),
        skew=-skew_px / focal_x * half_y,
    )
