"""Clusters of triangles: their order in space, their tree, and that asking them changes nothing."""

from collections.abc import Iterator

import numpy as np
import pytest
from helpers.hulls import (
    MASK_KINDS,
    TRIANGLE_KINDS,
    assert_same_samples,
    ball_hull,
    is_in_order,
    random_corners,
    random_masks,
    random_views,
    ring_views,
    soup,
    sphere_mesh,
)
from helpers.thorough import asked
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hybridve.hull.query import clusters as clusters_module
from hybridve.hull.query.clusters import spatial_order
from hybridve.hull.query.engine import Triangles
from hybridve.hull.query.native import Native
from hybridve.hull.query.rectangles import CLUSTER
from hybridve.hull.query.silhouettes import Hull, Unseen, make_hull


@pytest.fixture
def _deep_trees() -> Iterator[None]:
    """Make trees of small meshes, up to a single root, and share out their lowest groups."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clusters_module, "_TOP_NODES", 1)
        patch.setattr(clusters_module, "_TREE_TRIANGLES", 0)
        patch.setattr(clusters_module, "_SHARE_TRIANGLES", 4 * CLUSTER)
        yield


def again(hull: Hull) -> Hull:
    """Return the hull of another frame with the same silhouettes."""
    return make_hull(hull.views, [hull.mask(camera) for camera in range(len(hull.views))])


@pytest.mark.slow
@pytest.mark.usefixtures("_deep_trees")
@settings(
    max_examples=asked(60),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_cameras=st.integers(2, 20),
    n_triangles=st.integers(1, 700),
    unseen=st.sampled_from(["carve", "keep"]),
    is_sorted=st.booleans(),
    n_threads=st.integers(1, 3),
    data=st.data(),
)
def test_clusters_take_the_same_samples(
    seed: int,
    n_cameras: int,
    n_triangles: int,
    unseen: Unseen,
    is_sorted: bool,
    n_threads: int,
    data: st.DataObject,
) -> None:
    rng = np.random.default_rng(seed)
    views = random_views(rng, n_cameras, unseen, data.draw(st.integers(1, n_cameras)))
    hull = make_hull(views, random_masks(rng, views, rng.choice(MASK_KINDS, n_cameras).tolist()))
    # Mostly small ones, of which a cluster can be free or inside as a whole.
    weights = np.array([60 if kind in ("small", "tiny") else 1 for kind in TRIANGLE_KINDS])
    kinds = rng.choice(TRIANGLE_KINDS, n_triangles, p=weights / weights.sum())
    mesh = soup(
        views,
        np.array([random_corners(rng, views, kind) for kind in kinds]),
        rng.integers(1, 12, n_triangles).astype(np.int32),
    )
    if is_sorted:
        order = spatial_order(mesh.vertices_world, mesh.faces)
        mesh = Triangles(mesh.vertices_world, mesh.faces[order], mesh.viewports[order])

    with Native(n_threads) as engine:
        (by_triangle,) = engine.query(hull, [mesh])
        (by_cluster,) = engine.query(again(hull), [mesh])

    assert is_in_order(mesh, by_cluster)
    assert_same_samples(by_cluster, by_triangle)


@pytest.mark.usefixtures("_deep_trees")
def test_a_mesh_inside_the_hull_is_one_run() -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.5)
    mesh = sphere_mesh(3000, 0.1)

    with Native(2) as engine:
        engine.query(hull, [mesh])
        (hits,) = engine.query(again(hull), [mesh])

    assert hits.start.tolist() == [0]
    assert hits.stop.tolist() == [55 * len(mesh)]
    assert len(hits) == 55 * len(mesh)


@pytest.mark.usefixtures("_deep_trees")
def test_a_tree_follows_the_cameras_it_was_made_for() -> None:
    mesh = sphere_mesh(2000, 0.2)
    with Native(1) as engine:
        for n_cameras in (2, 7, 3):
            views = ring_views(n_cameras, 80, 60, 80.0)
            for radius_m in (0.1, 0.15):  # the order of the cameras may change, the tree does not
                hull = ball_hull(views, np.array([0.2, 0.0, 0.0]), radius_m)
                (found,) = engine.query(hull, [mesh])
                fresh = mesh.moved(mesh.vertices_world)
                (expected,) = engine.query(hull, [fresh])
                assert_same_samples(found, expected)


@given(seed=st.integers(0, 2**32 - 1), n_triangles=st.integers(0, 300))
def test_an_order_names_every_triangle_once(seed: int, n_triangles: int) -> None:
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.integers(-9, 9, 3)
    vertices = rng.normal(size=(3 * n_triangles, 3)) * scale + rng.normal(size=3) * 1e6
    faces = rng.permutation(3 * n_triangles).astype(np.int32).reshape(-1, 3)

    order = spatial_order(vertices, faces)

    assert np.sort(order).tolist() == list(range(n_triangles))


def test_an_order_puts_neighbours_together() -> None:
    """Of a shuffled sphere, the triangles of a cluster fill a patch, not the sphere."""
    mesh = sphere_mesh(20_000, 0.5)
    shuffled = np.random.default_rng(0).permutation(mesh.faces)

    def mean_edge_m(faces: np.ndarray) -> float:
        centroids = mesh.vertices_world[faces].mean(axis=1)
        clusters = centroids[: len(faces) // CLUSTER * CLUSTER].reshape(-1, CLUSTER, 3)
        return float((clusters.max(axis=1) - clusters.min(axis=1)).max(axis=1).mean())

    edge_m = (4 * np.pi * 0.25 * CLUSTER / 20_000) ** 0.5  # of a square patch of as much area
    assert mean_edge_m(shuffled) > 0.8
    assert mean_edge_m(shuffled[spatial_order(mesh.vertices_world, shuffled)]) < 2.5 * edge_m


@pytest.mark.parametrize("n_triangles", [0, 1])
def test_an_order_of_next_to_nothing(n_triangles: int) -> None:
    faces = np.zeros((n_triangles, 3), np.int32)

    assert spatial_order(np.ones((1, 3)), faces).tolist() == list(range(n_triangles))
