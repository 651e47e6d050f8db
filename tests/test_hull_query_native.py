"""The compiled engine: its rejection, its threads, its grids of samples."""

import gc
import weakref
from typing import Any

import numpy as np
import pytest
from helpers.compiled import source_of
from helpers.hulls import (
    assert_same_samples,
    ball_hull,
    is_in_order,
    random_masks,
    random_views,
    ring_views,
    soup,
    sphere_mesh,
)

from hybridve.hull.query import clusters as clusters_module
from hybridve.hull.query import native as native_module
from hybridve.hull.query import rectangles as rectangles_module
from hybridve.hull.query.bounds import FREE, OPEN, verdicts
from hybridve.hull.query.engine import Triangles
from hybridve.hull.query.native import Native
from hybridve.hull.query.reference import Reference
from hybridve.hull.query.silhouettes import Unseen, make_hull


@pytest.mark.slow
@pytest.mark.parametrize("n_queries", [1, 2], ids=["triangles", "clusters"])
def test_only_what_rectangles_leave_open_is_sampled(
    monkeypatch: pytest.MonkeyPatch, n_queries: int
) -> None:
    views = ring_views()
    hull = ball_hull(views, np.array([0.5, 0.0, 0.0]), 0.13)
    mesh = sphere_mesh(3000)
    verdict = verdicts(hull, mesh.corners_world - views.origin_world)
    asked: list[int] = []
    kept: list[int] = []
    compiled = rectangles_module._batch_verdicts

    def spy(*arguments: Any) -> int:
        n_left = compiled(*arguments)
        asked.extend(range(arguments[0], arguments[0] + arguments[1]))
        kept.extend(arguments[-4][:n_left].tolist())
        return n_left

    engine = Native(1)
    for _ in range(n_queries - 1):
        engine.query(ball_hull(views, np.zeros(3), 0.2), [mesh])
    # Run the compiled loop's source, so that it can be listened to.
    monkeypatch.setattr(rectangles_module, "_batch_verdicts", spy)
    monkeypatch.setattr(native_module, "survivors", source_of(rectangles_module.survivors))
    monkeypatch.setattr(native_module, "_query", source_of(native_module._query))
    engine.query(hull, [mesh])

    is_asked = np.isin(np.arange(len(mesh)), asked)
    assert kept == np.flatnonzero(is_asked & (verdict != FREE)).tolist()
    if n_queries == 1:
        assert is_asked.all()
    else:  # clusters are asked first; some are proved free, or inside, as a whole
        assert is_asked[verdict == OPEN].all()
        assert is_asked.mean() < 0.3


@pytest.mark.parametrize("viewport", [1, 2, 7, 8, 9, 16, 17, 63, 64, 65, 129, 200])
@pytest.mark.parametrize("unseen", ["carve", "keep"])
def test_grids_of_any_size_are_covered(viewport: int, unseen: Unseen) -> None:
    rng = np.random.default_rng(viewport)
    views = random_views(rng, 3, unseen, min_cameras=2, gaps=False)
    hull = make_hull(views, random_masks(rng, views, ["noise", "blobs", "holes"]))
    corners = rng.normal(size=(4, 3, 3)) * np.array([0.05, 0.2, 0.5, 2.0])[:, None, None]
    mesh = soup(views, corners, np.full(4, viewport, np.int32))

    (found,), (expected,) = Native(1).query(hull, [mesh]), Reference().query(hull, [mesh])

    assert_same_samples(found, expected)
    if viewport > 2:
        assert 0 < len(expected) < 4 * viewport * (viewport + 1) // 2


def test_a_whole_grid_inside_is_returned_whole() -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)
    mesh = sphere_mesh(40, 0.15, viewport=150)

    (hits,) = Native(1).query(hull, [mesh])

    assert len(hits) == len(mesh) * 150 * 151 // 2
    assert is_in_order(mesh, hits)


@pytest.mark.parametrize("n_threads", [1, 2, 5])
def test_threads_do_not_change_the_result(n_threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clusters_module, "_SHARE_TRIANGLES", 37)
    hull = ball_hull(ring_views(), np.array([0.4, 0.0, 0.0]), 0.2)
    meshes = [sphere_mesh(2000), sphere_mesh(100, 0.4), sphere_mesh(500, 0.1)]

    with Native(n_threads) as engine:
        found = engine.query(hull, meshes)

    for hits, expected in zip(found, Reference().query(hull, meshes), strict=True):
        assert_same_samples(hits, expected)
    assert [len(hits) > 0 for hits in found] == [True, True, False]


def test_an_error_in_a_thread_surfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object) -> None:
        raise MemoryError

    monkeypatch.setattr(native_module, "_query", fail)
    monkeypatch.setattr(clusters_module, "_SHARE_TRIANGLES", 10)
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)

    with Native(2) as engine, pytest.raises(MemoryError):
        engine.query(hull, [sphere_mesh(100)])


def test_a_closed_engine_answers_again() -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.6)
    engine = Native(2)
    (before,) = engine.query(hull, [sphere_mesh(20_000)])
    engine.close()
    engine.close()

    (after,) = engine.query(hull, [sphere_mesh(20_000)])

    assert_same_samples(before, after)
    engine.close()


def test_no_meshes_and_empty_meshes_are_no_hits() -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)
    nothing = Triangles(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, np.int32))

    assert Native(1).query(hull, []) == []
    (hits,) = Native(1).query(hull, [nothing])
    assert len(hits) == 0


@pytest.mark.slow
def test_the_same_mesh_serves_other_cameras() -> None:
    mesh = sphere_mesh(500, 0.2)
    engine = Native(1)
    for n_cameras in (2, 7, 3, 255):
        hull = ball_hull(ring_views(n_cameras, 80, 60, 80.0), np.array([0.2, 0.0, 0.0]), 0.15)

        (found,) = engine.query(hull, [mesh])

        (expected,) = Reference().query(hull, [mesh])
        assert_same_samples(found, expected)
        assert len(expected) > 0


def test_what_is_kept_of_a_mesh_goes_with_it() -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)
    mesh = sphere_mesh(100)
    Native(1).query(hull, [mesh])
    assert mesh.prepared is not None
    kept = weakref.ref(mesh.prepared.surface.vertices_local)

    del mesh
    gc.collect()

    assert kept() is None
