"""A ball seen by a ring of cameras: which samples are inside is known in closed form."""

from collections.abc import Iterator

import numpy as np
import pytest
from helpers.hulls import ball_angles, ball_hull, ring_views, sphere_mesh

from hybridve.hull.query.choose import open_engine
from hybridve.hull.query.engine import Engine
from hybridve.hull.query.viewport import sample_positions


@pytest.fixture(
    params=[
        "reference",
        "native",
        pytest.param("compute", marks=pytest.mark.gl),
        pytest.param("stencil", marks=pytest.mark.gl),
    ]
)
def engine(request: pytest.FixtureRequest) -> Iterator[Engine]:
    with open_engine(request.param) as engine:
        yield engine


@pytest.mark.parametrize("shift_m", [0.0, 1e4])
def test_samples_in_all_tangent_cones_of_a_ball_are_inside(engine: Engine, shift_m: float) -> None:
    """A pixel is an object pixel when the ray through its centre meets the ball.

    So a sample whose ray passes the cone's surface by more than the half diagonal of a pixel is
    decided by geometry alone.
    """
    views = ring_views(5)
    center, radius_m = np.array([0.35, 0.1, -0.05]), 0.2
    if shift_m:  # the same scene far from the world's origin
        views = type(views)(
            views.names, views.sizes_px, views.img_from_local, views.origin_world + shift_m
        )
        center = center + shift_m
    hull = ball_hull(views, center, radius_m)
    viewport = 8
    mesh = sphere_mesh(1500, 0.5, viewport, (shift_m,) * 3)

    (hits,) = engine.query(hull, [mesh])

    n_samples = viewport * (viewport + 1) // 2
    found = np.zeros(len(mesh) * n_samples, np.bool_)
    triangle, sample = hits.samples()
    found[triangle.astype(np.int64) * n_samples + sample] = True
    positions = sample_positions(
        np.repeat(mesh.corners_world, n_samples, axis=0),
        np.full(len(found), viewport, np.int32),
        np.tile(np.arange(n_samples, dtype=np.uint32), len(mesh)),
    )
    outside_rad, depths_m, pixel_rad = ball_angles(views, positions, center, radius_m)
    half_diagonal_rad = 0.71 * pixel_rad[:, None]
    surely_inside = (outside_rad < -half_diagonal_rad).all(axis=0)
    surely_outside = ((outside_rad > half_diagonal_rad) | (depths_m <= 0)).any(axis=0)
    assert found[surely_inside].all()
    assert not found[surely_outside].any()
    assert surely_inside.sum() > 1000
    assert (~surely_inside & ~surely_outside).mean() < 0.01, "the test would prove too little"
