"""The hull of a ball from a novel viewpoint, in closed form: it is an intersection of cones."""

import numpy as np
import pytest
from helpers.hulls import ball_hull, ring_views
from helpers.view_scene import BALL_RADIUS_M, FOCAL_PX, cone_intersections, view_from

from hybridve.hull.query.device import open_device
from hybridve.hull.view.novel import hull_depth

SIZE_PX = (96, 64)

#: Silhouettes end at pixels, of which the centre decides: half a diagonal, as an angle.
HALF_PIXEL_RAD = np.sqrt(0.5) / FOCAL_PX

#: The device computes in single precision, some metres away from the ball.
DEPTH_TOLERANCE_M = 1e-4


@pytest.mark.gl
@pytest.mark.parametrize("eye", [(3.0, -2.0, 1.5), (0.2, 2.5, 4.0), (-3.0, 0.1, -2.0)])
def test_the_hull_of_a_ball_lies_between_two_intersections_of_cones(
    eye: tuple[float, float, float],
) -> None:
    """Cones narrower and wider by half a pixel's diagonal bound what pixels leave."""
    views = ring_views()
    hull = ball_hull(views, np.zeros(3), BALL_RADIUS_M)
    matrices = views.img_from_local
    apexes = views.origin_world - np.linalg.solve(matrices[:, :, :3], matrices[:, :, 3:])[..., 0]
    half_angles = np.arcsin(BALL_RADIUS_M / np.linalg.norm(apexes, axis=1))
    view = view_from(*eye).novel_view(SIZE_PX[0] / SIZE_PX[1], (0.1, 20.0))
    columns, rows = np.meshgrid(np.arange(SIZE_PX[0]) + 0.5, np.arange(SIZE_PX[1]) + 0.5)
    _, rays = view.rays(np.column_stack([columns.ravel(), rows.ravel()]), SIZE_PX)

    device = open_device()
    try:
        depth_m = hull_depth(device, hull, view, SIZE_PX)[0].ravel()
    finally:
        device.release()

    narrow_enter, narrow_leave = cone_intersections(
        view.eye_world, rays, apexes, np.zeros(3), half_angles - HALF_PIXEL_RAD
    )
    wide_enter, wide_leave = cone_intersections(
        view.eye_world, rays, apexes, np.zeros(3), half_angles + HALF_PIXEL_RAD
    )
    is_seen = np.isfinite(depth_m)
    must_be_seen = narrow_leave - narrow_enter > DEPTH_TOLERANCE_M
    assert must_be_seen.sum() > 300
    assert is_seen[must_be_seen].all()
    latest = narrow_enter[must_be_seen] + DEPTH_TOLERANCE_M
    assert (depth_m[must_be_seen] <= latest).all()
    assert (depth_m[is_seen] >= wide_enter[is_seen] - DEPTH_TOLERANCE_M).all()
    assert (depth_m[is_seen] <= wide_leave[is_seen] + DEPTH_TOLERANCE_M).all()
