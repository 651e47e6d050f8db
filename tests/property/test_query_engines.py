"""The engines take the same samples, whatever the rig, the silhouettes and the mesh."""

from collections.abc import Iterator

import numpy as np
import pytest
from helpers.hulls import (
    DOUBLE_BAND_PX,
    EDGE_BAND_PX,
    EMPTYING_MASK_KINDS,
    MASK_KINDS,
    TRIANGLE_KINDS,
    UNSEEN,
    assert_same_samples,
    differences,
    is_in_order,
    keys,
    random_corners,
    random_masks,
    random_views,
    soup,
)
from helpers.thorough import asked
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hybridve.hull.query.compute import Compute
from hybridve.hull.query.engine import Hits, Triangles
from hybridve.hull.query.native import Native
from hybridve.hull.query.reference import Reference
from hybridve.hull.query.silhouettes import Hull, Unseen, Views, make_hull
from hybridve.hull.query.stencil import Stencil

examples = settings(
    max_examples=asked(150),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@pytest.fixture(scope="module")
def native() -> Iterator[Native]:
    with Native(n_threads=2) as engine:
        yield engine


@pytest.fixture(scope="module")
def compute() -> Iterator[Compute]:
    with Compute() as engine:
        yield engine


@pytest.fixture(scope="module")
def stencil() -> Iterator[Stencil]:
    # A small window: viewports of up to 100 pixels come in tiles, and most meshes in rounds.
    with Stencil(window_px=70) as engine:
        yield engine


@st.composite
def hulls(draw: st.DrawFn, min_cameras: int = 2, unseen: Unseen | None = None) -> Hull:
    """Rigs of 2 to 20 cameras of unequal image size, with silhouettes of any kind."""
    n_cameras = draw(st.integers(min_cameras, 5) | st.integers(min_cameras, 20))
    rules = st.sampled_from(UNSEEN)
    rule = draw(rules) if unseen is None else unseen
    needed = draw(st.integers(1, n_cameras))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    views = random_views(rng, n_cameras, rule, needed)
    kinds = rng.choice(MASK_KINDS, n_cameras).tolist()
    emptying = draw(st.none() | st.none() | st.none() | st.sampled_from(EMPTYING_MASK_KINDS))
    if emptying is not None:
        kinds[draw(st.integers(0, n_cameras - 1))] = emptying
    return make_hull(views, random_masks(rng, views, kinds))


@st.composite
def scenes(
    draw: st.DrawFn, min_cameras: int = 2, unseen: Unseen | None = None
) -> tuple[Hull, Triangles]:
    """A hull, and triangles of every difficult kind with viewports of their own."""
    hull = draw(hulls(min_cameras, unseen))
    n_triangles = draw(st.sampled_from([0, *[len(TRIANGLE_KINDS)] * 9]))
    kinds = draw(st.permutations(TRIANGLE_KINDS))[:n_triangles]
    # Several tiles and blocks an edge in both engines are rarer and larger.
    viewport = st.integers(1, 33) | st.sampled_from([1, 2, 8, 9, 32, 33, 64, 65, 100])
    viewports = draw(st.lists(viewport, min_size=len(kinds), max_size=len(kinds)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    corners = [random_corners(rng, hull.views, kind) for kind in kinds]
    return hull, soup(
        hull.views, np.array(corners).reshape(-1, 3, 3), np.array(viewports, np.int32)
    )


def ask(engine: Native | Compute | Stencil | Reference, hull: Hull, mesh: Triangles) -> Hits:
    (hits,) = engine.query(hull, [mesh])
    assert is_in_order(mesh, hits)
    return hits


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.parametrize(
    ("name", "band_px"),
    [("native", DOUBLE_BAND_PX), ("compute", EDGE_BAND_PX), ("stencil", EDGE_BAND_PX)],
)
@examples
@given(scene=scenes())
def test_an_engine_takes_the_samples_of_the_reference(
    request: pytest.FixtureRequest, name: str, band_px: float, scene: tuple[Hull, Triangles]
) -> None:
    hull, mesh = scene

    found, expected = (
        ask(engine, hull, mesh) for engine in (request.getfixturevalue(name), Reference())
    )

    assert differences(hull.views, mesh, found, expected, band_px).outside_band == []


@pytest.mark.slow
@examples
@given(scene=scenes())
def test_native_takes_the_same_samples_without_rejection(
    native: Native, scene: tuple[Hull, Triangles]
) -> None:
    hull, mesh = scene

    with_rejection = ask(native, hull, mesh)
    without = ask(Native(n_threads=1, reject=False), hull, mesh)

    assert_same_samples(with_rejection, without)


@examples
@given(scene=scenes(min_cameras=3, unseen="carve"))
def test_another_camera_only_carves(native: Native, scene: tuple[Hull, Triangles]) -> None:
    hull, mesh = scene
    fewer = Views(
        hull.views.names[:-1],
        hull.views.sizes_px[:-1],
        hull.views.img_from_local[:-1],
        hull.views.origin_world,
        hull.views.unseen,
        min(hull.views.min_cameras, len(hull.views) - 1),
    )
    hull_of_fewer = make_hull(fewer, [hull.mask(k) for k in range(len(fewer))])

    of_all, of_fewer = ask(native, hull, mesh), ask(native, hull_of_fewer, mesh)

    assert set(keys(of_all).tolist()) <= set(keys(of_fewer).tolist())


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.parametrize("engine_type", [Reference, Native, Compute, Stencil])
@examples
@given(scene=scenes(), data=st.data())
def test_a_viewport_of_twice_the_steps_loses_no_collision(
    engine_type: type[Reference | Native | Compute | Stencil],
    request: pytest.FixtureRequest,
    scene: tuple[Hull, Triangles],
    data: st.DataObject,
) -> None:
    hull, mesh = scene
    shared = {Native: "native", Compute: "compute", Stencil: "stencil"}.get(engine_type)
    engine = request.getfixturevalue(shared) if shared else engine_type()
    coarse = np.array(
        data.draw(st.lists(st.integers(2, 33), min_size=len(mesh), max_size=len(mesh))), np.int64
    )
    finer = 2 * (coarse - 1) + 1
    mesh_coarse = Triangles(mesh.vertices_world, mesh.faces, coarse.astype(np.int32))
    mesh_finer = Triangles(mesh.vertices_world, mesh.faces, finer.astype(np.int32))

    at_coarse, at_finer = ask(engine, hull, mesh_coarse), ask(engine, hull, mesh_finer)

    # Sample (i, j) of the coarse viewport is sample (2 i, 2 j) of the finer one.
    triangle, sample = at_coarse.samples()
    u, number = coarse[triangle], sample.astype(np.int64)
    row_starts = [np.cumsum([0, *range(v, 0, -1)]) for v in range(34)]
    j = np.array(
        [np.searchsorted(row_starts[v], s, "right") - 1 for v, s in zip(u, number, strict=True)],
        np.int64,
    )
    i = number - np.array([row_starts[v][r] for v, r in zip(u, j, strict=True)], np.int64)
    doubled = 2 * j * (2 * u - 1) - j * (2 * j - 1) + 2 * i
    expected = triangle.astype(np.int64) << 32 | doubled
    lost = np.isin(expected, keys(at_finer), invert=True)
    topology = mesh_finer.topology
    lost_hits = Hits.from_samples(topology, triangle[lost], doubled[lost].astype(np.uint32))
    nothing = Hits.from_samples(topology, triangle[:0], sample[:0])
    # Only OpenGL depends, within the band, on how a triangle is cut into blocks or placed.
    band_px = EDGE_BAND_PX if engine_type in (Compute, Stencil) else 0.0
    assert differences(hull.views, mesh_finer, lost_hits, nothing, band_px).outside_band == []


@pytest.mark.gl
@examples
@given(
    seed=st.integers(0, 2**32 - 1),
    kinds=st.lists(st.sampled_from(MASK_KINDS), min_size=4, max_size=4),
)
def test_verdicts_do_not_depend_on_where_the_origin_of_the_world_is(
    native: Native, compute: Compute, seed: int, kinds: list[str]
) -> None:
    shift = np.array([1e4, -2e4, 5e3])
    scenes_here_and_there = []
    for origin in (np.zeros(3), shift):
        rng = np.random.default_rng(seed)
        views = random_views(rng, 4, origin_world=origin)
        hull = make_hull(views, random_masks(rng, views, kinds))
        corners = rng.normal(size=(20, 1, 3)) * 0.2 + rng.normal(size=(20, 3, 3)) * 0.1
        vertices = corners.reshape(-1, 3) + origin
        faces = np.arange(60, dtype=np.int32).reshape(-1, 3)
        scenes_here_and_there.append((hull, Triangles(vertices, faces, np.full(20, 10, np.int32))))
    (hull_here, mesh_here), (hull_there, mesh_there) = scenes_here_and_there

    # 2e4 m are stored to 4e-12 m, and a projection about them to 1e-8 px.
    for engine, band_px in ((native, 1e-6), (compute, EDGE_BAND_PX)):
        here, there = ask(engine, hull_here, mesh_here), ask(engine, hull_there, mesh_there)

        difference = differences(hull_here.views, mesh_here, here, there, band_px)
        assert difference.outside_band == []


def test_views_made_here_use_their_own_origin() -> None:
    """The shifted scenes above would prove nothing if the local frame stayed at the world's."""
    rng = np.random.default_rng(0)
    shift = np.array([1e4, -2e4, 5e3])

    views = random_views(rng, 4, origin_world=shift)

    assert np.abs(views.origin_world - shift).max() < 3.0  # metres: the working volume
