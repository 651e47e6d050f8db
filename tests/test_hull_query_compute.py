"""The engine in OpenGL compute shaders: its precision, its buffers, its manners on the device."""

import gc
from collections.abc import Iterator

import moderngl
import numpy as np
import pytest
from helpers.hulls import (
    EDGE_BAND_PX,
    MASK_KINDS,
    TRIANGLE_KINDS,
    assert_same_samples,
    ball_hull,
    differences,
    is_in_order,
    large_views,
    look_at,
    near_pixel_edge,
    projection,
    random_corners,
    random_masks,
    random_views,
    ring_views,
    soup,
    sphere_mesh,
)
from helpers.thorough import some_of
from numpy.typing import NDArray

from hybridve.calib.errors import DeviceError
from hybridve.hull.query import compute as compute_module
from hybridve.hull.query import device as device_module
from hybridve.hull.query.bounds import OPEN, ROUNDOFF_FLOAT32, rectangle_pads, verdicts
from hybridve.hull.query.compute import Compute
from hybridve.hull.query.device import is_software_renderer, open_device
from hybridve.hull.query.engine import Triangles
from hybridve.hull.query.native import Native
from hybridve.hull.query.reference import Reference
from hybridve.hull.query.silhouettes import Hull, Unseen, Views, make_hull, make_views
from hybridve.hull.query.viewport import sample_positions

pytestmark = pytest.mark.gl

native = Native(n_threads=1)


@pytest.fixture(scope="module")
def context() -> Iterator[moderngl.Context]:
    context = open_device()
    yield context
    context.release()


@pytest.fixture
def compute(context: moderngl.Context) -> Iterator[Compute]:
    """The engine, on a device that is clean before the test and must be clean after it."""
    assert context.error == "GL_NO_ERROR"
    with Compute(context) as engine:
        yield engine
    assert context.error == "GL_NO_ERROR"


def counters(engine: Compute) -> tuple[int, int]:
    """Return how many clusters and blocks the first mesh of the last query left open."""
    read = np.frombuffer(engine._counters.read(), np.uint32)
    return int(read[3]), int(read[7])


def matrix_world(views: Views, camera: int) -> NDArray[np.float64]:
    """Return the (3, 4) projection of a camera, from the world."""
    matrix = views.img_from_local[camera].copy()
    matrix[:, 3] -= matrix[:, :3] @ views.origin_world
    return np.asarray(matrix)


def random_scene(seed: int, n_triangles: int, n_cameras: int = 4) -> tuple[Hull, Triangles]:
    """Every kind of silhouette and triangle in no order, so that clusters are large and mixed."""
    rng = np.random.default_rng(seed)
    unseen: Unseen = "keep" if seed % 2 else "carve"
    views = random_views(rng, n_cameras, unseen, min_cameras=1 + seed % n_cameras)
    kinds = rng.choice(MASK_KINDS, n_cameras).tolist()
    hull = make_hull(views, random_masks(rng, views, kinds))
    corners = [random_corners(rng, views, kind) for kind in rng.choice(TRIANGLE_KINDS, n_triangles)]
    viewports = rng.choice([1, 2, 7, 10, 32, 33, 64, 65], n_triangles).astype(np.int32)
    return hull, soup(views, np.array(corners), viewports)


# The largest triangles span the image and more: float32 about a vertex would not do for them.
@pytest.mark.slow
@pytest.mark.parametrize("extent_m", [0.003, 0.05, 0.3, 1.5, 6.0])
def test_a_large_image_is_sampled_to_a_thousandth_of_a_pixel(
    compute: Compute, extent_m: float
) -> None:
    rng = np.random.default_rng(1)
    views = large_views(rng)
    # In noise that differs from pixel to pixel nearly every wrong pixel shows.
    hull = make_hull(views, [rng.integers(0, 5, (1200, 1600)).astype(np.uint8) for _ in range(4)])
    n_triangles = 400 if extent_m < 1.0 else 4000
    corners = rng.normal(size=(n_triangles, 1, 3)) * 0.2
    corners = corners + rng.normal(size=(n_triangles, 3, 3)) * extent_m
    mesh = soup(views, corners, np.full(n_triangles, 40, np.int32))

    (found,), (expected,) = compute.query(hull, [mesh]), native.query(hull, [mesh])

    difference = differences(views, mesh, found, expected, EDGE_BAND_PX)
    assert difference.outside_band == []
    assert len(expected) > 10_000, "the test would prove too little"
    samples = np.tile(np.arange(820, dtype=np.uint32), 100)
    viewports = np.full(len(samples), 40, np.int32)
    positions = sample_positions(np.repeat(corners[:100], 820, axis=0), viewports, samples)
    # Two coordinates in each of four cameras, a band on either side of each edge: 1.6 %.
    assert near_pixel_edge(views, positions, EDGE_BAND_PX).mean() < 0.02


def test_a_triangle_seen_on_edge_beside_a_pixel_edge_is_not_rejected(compute: Compute) -> None:
    """The rectangle of such a triangle has no width: without its pad, rounding would move it.

    The camera stands 60 m from the local origin, as it may where optical axes are nearly parallel:
    single precision is then off by 0.01 px near the camera, in rectangles and, taken plainly, in
    samples.
    """
    rng = np.random.default_rng(2)
    n_triangles, column = 300, 801
    pose = look_at(np.array([52.0, 10.0, 28.0]), np.array([50.0, 9.0, 27.0]), 0.4)
    matrix = projection(pose, 1700.0, 1600, 1200)
    views = Views(("cam",), np.array([[1600, 1200]]), matrix[None], np.zeros(3))
    mask = np.zeros((1200, 1600), np.uint8)
    mask[:, column] = 1
    hull = make_hull(views, [mask])
    # All samples fall twice the band inside the only object column, to either side of it.
    inside_px = np.where(rng.random(n_triangles) < 0.5, 2e-3, 1.0 - 2e-3)
    pixels = np.stack(
        [
            np.repeat(column + inside_px, 3).reshape(-1, 3),
            rng.uniform(50, 1150, (n_triangles, 3)),
            np.ones((n_triangles, 3)),
        ],
        axis=-1,
    )
    depths_m = rng.uniform(1.0, 8.0, (n_triangles, 3, 1))
    local = views.img_from_local[0]
    corners = (pixels * depths_m - local[:, 3]) @ np.linalg.inv(local[:, :3]).T
    mesh = soup(views, corners, np.full(n_triangles, 10, np.int32))

    (hits,) = compute.query(hull, [mesh])

    assert len(hits) == n_triangles * 55


@pytest.mark.parametrize("inside_px", [2e-3, 1.0 - 2e-3])
def test_a_cluster_seen_on_edge_beside_a_pixel_edge_is_not_rejected(
    compute: Compute, inside_px: float
) -> None:
    """The same for the box around a cluster, flat in the plane of the camera and a pixel column."""
    rng = np.random.default_rng(4)
    column = 801
    for _ in range(20):
        camera_local = rng.uniform(60.0, 100.0, 3)  # farther: all corners must fall to one side
        matrix = np.array(
            [[1700.0, 0.0, column + inside_px], [0.0, 1700.0, 600.0], [0.0, 0.0, 1.0]]
        )
        matrix = matrix @ np.column_stack([np.eye(3), -camera_local])
        views = Views(("cam",), np.array([[1600, 1200]]), matrix[None], np.zeros(3))
        mask = np.zeros((1200, 1600), np.uint8)
        mask[:, column] = 1
        n_triangles = compute_module._CLUSTER
        around = np.array([0.0, 0.0, rng.uniform(0.4, 1.0)])
        corners = around + rng.uniform(-0.05, 0.05, (n_triangles, 3, 3)) * (0.0, 1.0, 1.0)
        mesh = soup(views, corners + camera_local, np.full(n_triangles, 10, np.int32))

        (hits,) = compute.query(make_hull(views, [mask]), [mesh])

        assert len(hits) == n_triangles * 55


def test_only_what_rectangles_leave_open_is_sampled(compute: Compute) -> None:
    views = ring_views()
    hull = ball_hull(views, np.array([0.5, 0.0, 0.0]), 0.13)
    mesh = sphere_mesh(20_000)
    n_open = int((verdicts(hull, mesh.corners_world - views.origin_world) == OPEN).sum())

    compute.query(hull, [mesh])

    n_open_clusters, n_items = counters(compute)
    assert 0 < n_open_clusters < 0.1 * len(mesh) / compute_module._CLUSTER
    assert n_open <= n_items
    assert n_items - n_open <= 0.01 * n_open  # what the wider pad of single precision costs


@pytest.mark.parametrize("unseen", ["carve", "keep"])
@pytest.mark.parametrize("n_triangles", [1, 63, 64, 65, 400, 5000])
def test_a_mesh_wholly_inside_is_one_run(
    compute: Compute, n_triangles: int, unseen: Unseen
) -> None:
    """Neither its triangles are asked one by one, nor its samples counted out."""
    hull = ball_hull(ring_views(unseen=unseen), np.zeros(3), 0.4)
    inside = sphere_mesh(5000, 0.2, viewport=100)
    mesh = Triangles(
        inside.vertices_world, inside.faces[:n_triangles], inside.viewports[:n_triangles]
    )

    (hits,) = compute.query(hull, [mesh])

    assert counters(compute) == (0, 0)
    assert hits.start.tolist() == [0]
    assert hits.stop.tolist() == [len(mesh) * 5050]


def test_a_camera_that_turns_its_back_leaves_a_mesh_whole(compute: Compute) -> None:
    ring = ring_views(3)
    away = look_at(np.array([3.0, 0.0, 1.0]), np.array([6.0, 0.0, 1.0]))
    matrices = [matrix_world(ring, k) for k in range(3)] + [projection(away, 700.0, 720, 486)]
    sizes_px = np.array([[720, 486]] * 4)
    views = make_views(tuple("abcd"), sizes_px, np.array(matrices), "keep", min_cameras=3)
    mesh = sphere_mesh(200, 0.2)

    (hits,) = compute.query(ball_hull(views, np.zeros(3), 0.4), [mesh])

    assert counters(compute) == (0, 0)
    assert hits.start.tolist() == [0]
    assert hits.stop.tolist() == [len(mesh) * 55]


def test_a_mesh_beyond_the_hull_is_dropped_by_the_cluster(compute: Compute) -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)

    (hits,) = compute.query(hull, [sphere_mesh(5000, 0.1, center_world=(0.4, 0.0, 0.0))])

    assert counters(compute) == (0, 0)
    assert len(hits) == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", some_of(range(12)))
def test_rectangles_only_save_work(compute: Compute, context: moderngl.Context, seed: int) -> None:
    hull, mesh = random_scene(seed, 150, n_cameras=(2, 4, 9, 20)[seed % 4])

    (with_rectangles,) = compute.query(hull, [mesh])
    with Compute(context, reject=False) as engine:
        (without,) = engine.query(hull, [mesh])
        n_open_clusters, _ = counters(engine)

    assert n_open_clusters == 3  # all of them
    assert is_in_order(mesh, with_rectangles)
    assert_same_samples(with_rectangles, without)


@pytest.mark.parametrize("n_triangles", [1, 7, 8, 9, 63, 64, 65, 127, 129, 500])
def test_the_size_of_clusters_does_not_matter(
    compute: Compute, context: moderngl.Context, monkeypatch: pytest.MonkeyPatch, n_triangles: int
) -> None:
    """In particular where it does not divide the number of triangles."""
    hull = ball_hull(ring_views(), np.array([0.3, 0.0, 0.0]), 0.25)
    whole = sphere_mesh(500, 0.3)
    viewports = np.random.default_rng(0).integers(1, 70, len(whole)).astype(np.int32)
    first = Triangles(whole.vertices_world, whole.faces[-n_triangles:], viewports[-n_triangles:])

    (found,) = compute.query(hull, [first])
    monkeypatch.setattr(compute_module, "_CLUSTER", compute._group_size)
    with Compute(context) as engine:
        (found_small,) = engine.query(hull, [first])

    (expected,) = Reference().query(hull, [first])
    assert differences(hull.views, first, found, expected, EDGE_BAND_PX).outside_band == []
    assert_same_samples(found, found_small)
    assert n_triangles < 500 or len(found) > 0


def test_work_groups_of_hardware_find_the_same(
    compute: Compute, context: moderngl.Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Few of them, so that each strides over its share of vertices, clusters and items."""
    monkeypatch.setattr(compute_module, "_SOFTWARE_GROUP_SIZE", compute_module._GROUP_SIZE)
    monkeypatch.setattr(compute_module, "_SOFTWARE_MAX_GROUPS", 3)
    hull = ball_hull(ring_views(), np.array([0.3, 0.0, 0.0]), 0.25)
    meshes = [sphere_mesh(20_000, 0.3), sphere_mesh(300, 0.2, viewport=70)]

    found = compute.query(hull, meshes)
    with Compute(context) as engine:
        found_there = engine.query(hull, meshes)

    for hits, hits_there in zip(found, found_there, strict=True):
        np.testing.assert_array_equal(hits.start, hits_there.start)
        np.testing.assert_array_equal(hits.stop, hits_there.stop)
        assert len(hits.start) > 100


def test_boxes_hold_their_clusters_and_no_more(compute: Compute) -> None:
    views = ring_views()
    rng = np.random.default_rng(3)
    n_triangles = 3 * compute_module._CLUSTER + 5
    corners = rng.normal(size=(n_triangles, 3, 3))
    mesh = soup(views, corners, np.full(n_triangles, 2, np.int32))

    compute.query(ball_hull(views, np.zeros(3), 0.2), [mesh])

    boxes = np.frombuffer(compute._placements[mesh].boxes.read(), np.float32).reshape(2, 3, 4)
    rounded = (mesh.corners_world - views.origin_world).astype(np.float32)
    for cluster in range(4):
        own = rounded[compute_module._CLUSTER * cluster :][: compute_module._CLUSTER]
        np.testing.assert_array_equal(boxes[0, :, cluster], own.min(axis=(0, 1)))
        np.testing.assert_array_equal(boxes[1, :, cluster], own.max(axis=(0, 1)))


def test_pads_follow_from_the_reach_of_each_set() -> None:
    views = random_views(np.random.default_rng(6), 5)
    reaches_m = np.array([[0.0, 0.0, 0.0], [0.1, 2.0, 0.4], [30.0, 0.0, 7.0]])

    pads = np.einsum("cpk,nk->ncp", compute_module._pad_rows(views), np.insert(reaches_m, 3, 1, 1))

    expected = rectangle_pads(views, reaches_m, ROUNDOFF_FLOAT32)[..., :2]
    np.testing.assert_allclose(pads, expected, rtol=1e-12)


@pytest.mark.parametrize("unseen", ["carve", "keep"])
def test_clusters_on_both_sides_of_a_camera_are_asked(compute: Compute, unseen: Unseen) -> None:
    """Camera 0 stands within the boxes of clusters whose triangles the others see."""
    views = ring_views(4, 160, 120, 150.0, unseen=unseen, min_cameras=2)
    full = [np.ones((120, 160), np.uint8)] * 4
    matrix = views.img_from_local[0]
    camera_world = views.origin_world - np.linalg.solve(matrix[:, :3], matrix[:, 3])
    rng = np.random.default_rng(5)
    # Between twice the camera's place and the middle, and beside it.
    corners = (
        camera_world * rng.uniform(-0.2, 2.0, (300, 1, 1)) + rng.normal(size=(300, 3, 3)) * 0.2
    )
    mesh = soup(views, corners - views.origin_world, np.full(300, 12, np.int32))
    hull = make_hull(views, full)

    (found,), (expected,) = compute.query(hull, [mesh]), Reference().query(hull, [mesh])

    assert differences(views, mesh, found, expected, EDGE_BAND_PX).outside_band == []
    assert len(found) > 1000


def test_a_mesh_that_moves_is_asked_where_it_is(compute: Compute) -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)
    first = mesh = sphere_mesh(700, 0.15, viewport=6)
    counts = set()
    for k in range(8):
        mesh = first.moved(first.vertices_world * (1 - 0.05 * k) + np.array([0.06 * k, 0.0, 0.0]))
        fresh = Triangles(mesh.vertices_world, mesh.faces, mesh.viewports)

        # The first stays alive, the others come and go; now and then two of them at a time.
        found, found_first, found_fresh = compute.query(hull, [mesh, first, fresh])
        (again,) = compute.query(hull, [mesh])

        (expected,) = Reference().query(hull, [mesh])
        assert differences(hull.views, mesh, found, expected, EDGE_BAND_PX).outside_band == []
        assert_same_samples(found, found_fresh)
        assert_same_samples(found, again)
        assert_same_samples(found_first, compute.query(hull, [first])[0])
        counts.add(len(found))
    assert len(counts) > 4, "it would not show where an earlier place was asked"


def test_a_mesh_that_is_still_there_keeps_its_place(compute: Compute) -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)
    first = sphere_mesh(300, 0.15, viewport=6)
    shifts_m = np.linspace(0.0, 0.3, 5)[:, None] * np.array([1.0, 0.0, 0.0])
    meshes = [first.moved(first.vertices_world + shift_m) for shift_m in shifts_m]
    alone = [compute.query(hull, [mesh])[0] for mesh in meshes]

    together = compute.query(hull, meshes)

    for mesh, hits, hits_alone in zip(meshes, together, alone, strict=True):
        assert_same_samples(hits, hits_alone)
        (expected,) = Reference().query(hull, [mesh])
        assert differences(hull.views, mesh, hits, expected, EDGE_BAND_PX).outside_band == []
    assert len({len(hits) for hits in together}) == len(meshes)


def test_other_cameras_see_a_mesh_about_their_own_origin(compute: Compute) -> None:
    mesh = sphere_mesh(300, 0.2, viewport=5)
    here = ring_views()
    shift = np.array([0.5, -0.25, 1.0])
    matrices = here.img_from_local.copy()
    matrices[:, :, 3] += matrices[:, :, :3] @ shift
    there = Views(here.names, here.sizes_px, matrices, here.origin_world + shift)
    for views in (here, there, here):
        hull = ball_hull(views, np.array([0.1, 0.0, 0.0]), 0.2)

        (found,), (expected,) = compute.query(hull, [mesh]), native.query(hull, [mesh])

        assert differences(views, mesh, found, expected, EDGE_BAND_PX).outside_band == []
        assert len(found) > 0


def test_only_the_vertices_of_a_mesh_that_moves_are_sent_again(compute: Compute) -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)
    mesh = sphere_mesh(700, 0.15)
    compute.query(hull, [mesh])
    surface, placement = compute._surfaces[mesh.topology], compute._placements[mesh]
    mesh = mesh.moved(mesh.vertices_world + 0.01)

    compute.query(hull, [mesh])

    assert compute._surfaces[mesh.topology] is surface
    assert compute._placements[mesh].vertices_world is placement.vertices_world
    assert compute._placements[mesh].boxes is placement.boxes
    assert len(surface.placements) == 1
    stays, goes = mesh, mesh.moved(mesh.vertices_world + 0.01)
    compute.query(hull, [stays, goes])
    del goes
    for _ in range(2):  # its buffers wait for one query, and are not wanted
        compute.query(hull, [stays])
    assert surface.spare == []
    assert len(surface.placements) == 1


@pytest.mark.parametrize("seed", [0, 1, 2, 5, 7])
def test_meshes_with_viewports_of_every_size_are_sampled_alike(compute: Compute, seed: int) -> None:
    scenes = [random_scene(seed, n) for n in (200, 130)]
    hull = scenes[0][0]
    meshes = [mesh for _, mesh in scenes]

    found, expected = compute.query(hull, meshes), Reference().query(hull, meshes)

    for mesh, hits, expected_hits in zip(meshes, found, expected, strict=True):
        assert is_in_order(mesh, hits)
        assert differences(hull.views, mesh, hits, expected_hits, EDGE_BAND_PX).outside_band == []
    assert sum(map(len, found)) > 100


def test_buffers_grow_when_a_frame_overflows_them(
    context: moderngl.Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compute_module, "_FIRST_SIZE", 64)
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)
    mesh = sphere_mesh(300, 0.1, viewport=70)
    with Compute(context) as engine:
        (found,) = engine.query(hull, [mesh])

    (expected,) = native.query(hull, [mesh])
    assert_same_samples(found, expected)
    assert len(found) == len(mesh) * 70 * 71 // 2  # all of it is inside


@pytest.mark.slow
def test_a_frame_too_large_for_the_device_is_asked_in_parts(
    context: moderngl.Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compute_module, "_FIRST_SIZE", 64)
    hull = ball_hull(ring_views(), np.array([0.1, 0.0, 0.0]), 0.2)
    meshes = [sphere_mesh(300, 0.2, viewport=60), sphere_mesh(200, 0.2, viewport=70)]
    with Compute(context) as engine:
        for mesh in meshes:  # their own buffers are larger than what follows
            engine.query(hull, [mesh])
        engine._items, engine._hits = engine._reserve(64), engine._reserve(64)
        engine._largest = 1 << 12  # as if the device held no larger buffer
        found = engine.query(hull, meshes)
        assert max(engine._items.size, engine._hits.size) <= 1 << 12

    for mesh, hits, expected in zip(meshes, found, native.query(hull, meshes), strict=True):
        assert is_in_order(mesh, hits)
        assert differences(hull.views, mesh, hits, expected, EDGE_BAND_PX).outside_band == []
        assert len(hits.start) > 1 << 8  # they would not fit


@pytest.mark.parametrize("radius_m", [0.1, 0.2])
def test_batches_may_begin_and_end_within_a_cluster(
    compute: Compute, monkeypatch: pytest.MonkeyPatch, radius_m: float
) -> None:
    hull = ball_hull(ring_views(), np.array([0.05, 0.0, 0.0]), 0.2)
    mesh = sphere_mesh(1000, radius_m)
    (at_once,) = compute.query(hull, [mesh])
    for n_triangles in (1, 10, 64, 100, 170):
        monkeypatch.setattr(compute_module, "_MAX_SAMPLES", 55 * n_triangles)

        (found,) = compute.query(hull, [mesh])

        np.testing.assert_array_equal(found.start, at_once.start)
        np.testing.assert_array_equal(found.stop, at_once.stop)


def test_a_triangle_too_large_for_the_device_is_named(context: moderngl.Context) -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)
    mesh = Triangles(
        np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.3, 0.0]]),
        np.array([[0, 1, 2]], np.int32),
        np.array([1000], np.int32),
    )
    with Compute(context) as engine:
        (fits,) = engine.query(hull, [mesh])
        engine._largest = 1 << 14
        engine._hits = engine._reserve(64)
        with pytest.raises(DeviceError, match=r"triangle 0 has \d+ runs of samples .* native"):
            engine.query(hull, [mesh])
    assert 0 < len(fits) < 1000 * 1001 // 2  # were all of it inside, one run would say so


def test_samples_that_32_bits_cannot_count_are_asked_in_batches() -> None:
    before = np.cumsum([0, *[3 << 29] * 3, 1 << 28, 1 << 28, 1 << 28])

    batches = compute_module._batches([before, before], [np.array([6]), np.array([4, 6])])

    samples = [sum(int(before[x.stop] - before[x.start]) for x in batch) for batch in batches]
    assert max(samples) <= 1 << 31
    covered = [(x.mesh, t) for batch in batches for x in batch for t in range(x.start, x.stop)]
    assert covered == [(mesh, t) for mesh in range(2) for t in range(6)]
    assert not any(x.mesh == 1 and x.start < 4 < x.stop for batch in batches for x in batch)


def test_no_invocation_turns_more_often_than_the_software_renderer_allows(
    monkeypatch: pytest.MonkeyPatch, context: moderngl.Context
) -> None:
    """Mesa's leaves all loops after 65,535 turns, and with them the samples that are left.

    Silhouettes that are boards of chess decide nothing: all cameras are asked of all samples.
    """
    monkeypatch.setattr(compute_module, "_SOFTWARE_MAX_GROUPS", 1)
    views = ring_views(12, 160, 120, 160.0)
    y, x = np.mgrid[:120, :160]
    hull = make_hull(views, [((x // 9 + y // 9) % 7 > 0).astype(np.uint8)] * 12)
    mesh = sphere_mesh(1000, 0.4, viewport=32)
    with Native(2) as native:
        (expected,) = native.query(hull, [mesh])

    with Compute(context) as engine:
        (found,) = engine.query(hull, [mesh])

    assert differences(views, mesh, found, expected, EDGE_BAND_PX).outside_band == []
    assert len(expected) > 10_000


def test_a_viewport_that_the_software_renderer_would_not_sample_to_its_end_is_named(
    context: moderngl.Context,
) -> None:
    views = ring_views()
    hull = ball_hull(views, np.zeros(3), 0.2)
    corners = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.3, 0.0]])
    viewports = np.array([9000, 12_000], np.int32)
    mesh = Triangles(corners, np.array([[0, 1, 2]] * 2, np.int32), viewports)
    with Compute(context) as engine:
        if not is_software_renderer(engine.renderer):
            pytest.skip("hardware has no such limit")
        with pytest.raises(DeviceError, match=r"triangle 1 has a viewport of 12000.*native"):
            engine.query(hull, [mesh])


def test_more_cameras_than_a_work_group_has_room_for_are_named(context: moderngl.Context) -> None:
    hull = ball_hull(ring_views(257, 8, 6, 8.0), np.zeros(3), 0.2)
    with Compute(context) as engine, pytest.raises(DeviceError, match=r"257 cameras.*256.*native"):
        engine.query(hull, [sphere_mesh(10)])


def test_what_belonged_to_a_mesh_leaves_the_device_with_it(compute: Compute) -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)
    kept = sphere_mesh(100)
    compute.query(hull, [kept, sphere_mesh(200)])
    gc.collect()

    compute.query(hull, [kept])

    assert list(compute._placements) == [kept]
    assert list(compute._surfaces) == [kept.topology]


def test_a_driver_that_does_not_compile_the_shaders_is_named(
    compute: Compute, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = "#version 430 core\nlayout(local_size_x = 1) in; void main() { nothing(); }"
    monkeypatch.setattr(device_module, "load_shader", lambda name: broken)

    with pytest.raises(DeviceError, match=r"does not compile volume_cluster.*nothing.*native"):
        compute.programs_for(4)
