"""The volume query, engine beside engine: 4 cameras of 720 x 486, viewport 10, 2 % colliding.

Run: pytest tests/benchmarks/bench_query.py -o python_files='bench_*.py'
-o python_functions='bench_*' --benchmark-columns=median,iqr,rounds
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from helpers.hulls import ball_hull, ring_views, sphere_mesh

from hybridve.hull.query.choose import open_engine
from hybridve.hull.query.engine import Engine
from hybridve.hull.query.silhouettes import Hull, make_hull

#: A ball on the rim of a sphere meets 2 % of its triangles (asserted below).
BALL_CENTER, BALL_RADIUS_M, SPHERE_RADIUS_M = np.array([0.5, 0.0, 0.0]), 0.13, 0.5


@pytest.fixture(scope="module")
def hulls() -> list[Hull]:
    """Two frames in turn, so that no engine keeps the silhouettes of the last query."""
    views = ring_views(4, 720, 486)
    hull = ball_hull(views, BALL_CENTER, BALL_RADIUS_M)
    return [hull, make_hull(views, [hull.mask(camera) for camera in range(4)])]


@pytest.fixture(scope="module", params=["native", "compute", "reference"])
def engine(request: pytest.FixtureRequest) -> Iterator[Engine]:
    with open_engine(request.param) as engine:
        yield engine


@pytest.mark.parametrize("n_triangles", [720, 20_000, 200_000, 1_000_000])
def bench_static_mesh(benchmark: Any, engine: Engine, hulls: list[Hull], n_triangles: int) -> None:
    """One frame: masks and integral images to hits, a device's upload and read-back included."""
    if engine.name == "reference" and n_triangles > 20_000:
        pytest.skip("the specification is slow: minutes")
    mesh = sphere_mesh(n_triangles, SPHERE_RADIUS_M)
    frames = iter(range(1 << 30))

    (hits,) = engine.query(hulls[0], [mesh])
    colliding = len(np.unique(hits.samples()[0])) / len(mesh)
    assert 0.01 < colliding < 0.03
    benchmark.extra_info.update(
        triangles=len(mesh), colliding=colliding, hits=len(hits), renderer=engine.renderer
    )
    benchmark(lambda: engine.query(hulls[next(frames) % 2], [mesh]))


@pytest.mark.parametrize("n_triangles", [20_000, 200_000])
def bench_moving_mesh(benchmark: Any, engine: Engine, hulls: list[Hull], n_triangles: int) -> None:
    """The same with vertices that are new in every frame: copied, checked, uploaded."""
    if engine.name == "reference" and n_triangles > 20_000:
        pytest.skip("the specification is slow: minutes")
    mesh = sphere_mesh(n_triangles, SPHERE_RADIUS_M)
    benchmark.extra_info.update(triangles=len(mesh), renderer=engine.renderer)

    def query() -> None:
        engine.query(hulls[0], [mesh.moved(mesh.vertices_world + 0.0)])

    benchmark(query)


@pytest.mark.parametrize("viewport", [64, 512])
def bench_large_viewport(benchmark: Any, engine: Engine, hulls: list[Hull], viewport: int) -> None:
    """Few triangles, many samples each: what halving the grid is for."""
    if engine.name == "reference" and viewport > 64:
        pytest.skip("the specification is slow: minutes")
    mesh = sphere_mesh(720, SPHERE_RADIUS_M, viewport)
    benchmark.extra_info.update(
        samples=len(mesh) * viewport * (viewport + 1) // 2, renderer=engine.renderer
    )
    frames = iter(range(1 << 30))
    benchmark(lambda: engine.query(hulls[next(frames) % 2], [mesh]))
