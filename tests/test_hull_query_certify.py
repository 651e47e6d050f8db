"""Certificates: what is proved free is free at any viewport, what collides has a witness."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from helpers.hulls import (
    EMPTYING_MASK_KINDS,
    MASK_KINDS,
    TRIANGLE_KINDS,
    ball_hull,
    look_at,
    projection,
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

from hybridve.hull.query import certify as certify_module
from hybridve.hull.query.bounds import FREE as RECTANGLE_FREE
from hybridve.hull.query.bounds import verdicts
from hybridve.hull.query.certify import (
    COLLIDING,
    FREE,
    OPEN,
    Certifier,
    certify_triangles,
)
from hybridve.hull.query.certify_reference import certify_triangle
from hybridve.hull.query.engine import Triangles
from hybridve.hull.query.reference import Reference, contains_points
from hybridve.hull.query.silhouettes import Hull, make_hull, make_views

#: Coarse, so that triangles of metres stay within some thousand cells.
OPEN_AT_M = 0.01

examples = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


@pytest.fixture(scope="module")
def certifier() -> Iterator[Certifier]:
    with Certifier(OPEN_AT_M, n_threads=2) as certifier:
        yield certifier


@st.composite
def scenes(draw: st.DrawFn) -> tuple[Hull, Triangles]:
    """Rigs of 2 to 20 cameras, and triangles of every difficult kind about the hull."""
    n_cameras = draw(st.integers(2, 5) | st.integers(2, 20))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    views = random_views(
        rng, n_cameras, draw(st.sampled_from(["carve", "keep"])), draw(st.integers(1, n_cameras))
    )
    kinds = rng.choice(MASK_KINDS, n_cameras).tolist()
    emptying = draw(st.none() | st.none() | st.sampled_from(EMPTYING_MASK_KINDS))
    if emptying is not None:
        kinds[0] = emptying
    hull = make_hull(views, random_masks(rng, views, kinds))
    shapes = rng.choice(TRIANGLE_KINDS, 12)
    corners = np.array([random_corners(rng, views, kind) for kind in shapes])
    return hull, soup(views, corners, np.ones(12, np.int32))


@pytest.mark.slow
@examples
@given(scene=scenes())
def test_verdicts_are_those_of_the_specification(
    monkeypatch: pytest.MonkeyPatch, certifier: Certifier, scene: tuple[Hull, Triangles]
) -> None:
    hull, mesh = scene
    monkeypatch.setattr(certify_module, "MOST_CELLS", 2000)

    found = certifier.certify(hull, mesh)

    for triangle, corners in enumerate(mesh.corners_world):
        verdict, _, open_at_m = certify_triangle(hull, corners, OPEN_AT_M, 2000)
        assert found.verdict[triangle] == verdict
        np.testing.assert_allclose(found.open_at_m[triangle], open_at_m, rtol=1e-9)


@pytest.mark.slow
@settings(examples, max_examples=asked(30))
@given(scene=scenes())
def test_what_is_free_has_no_hit_at_any_viewport(
    certifier: Certifier, scene: tuple[Hull, Triangles]
) -> None:
    hull, mesh = scene
    verdict = certifier.certify(hull, mesh).verdict
    at_once = verdicts(hull, mesh.corners_world - hull.views.origin_world) == RECTANGLE_FREE
    assert (verdict[at_once] == FREE).all()
    by_cells = np.flatnonzero((verdict == FREE) & ~at_once)[:3]

    for viewport in (512, 100, 7):
        viewports = np.full(len(by_cells), viewport, np.int32)
        fine = Triangles(mesh.vertices_world, mesh.faces[by_cells], viewports)
        (hits,) = Reference().query(hull, [fine])
        assert len(hits) == 0


def test_cells_decide_what_one_rectangle_does_not(certifier: Certifier) -> None:
    """A proof that never succeeds would pass the test above."""
    hull = ball_hull(ring_views(6), np.zeros(3), 0.2)
    mesh = sphere_mesh(700, 0.21)  # its triangles' rectangles overlap silhouettes everywhere
    corners_local = mesh.corners_world - hull.views.origin_world
    open_at_once = verdicts(hull, corners_local) != RECTANGLE_FREE

    verdict = certifier.certify(hull, mesh).verdict

    assert (verdict[open_at_once] == FREE).sum() > 0.2 * open_at_once.sum()
    assert (verdict == COLLIDING).any()


@pytest.mark.slow
@examples
@given(scene=scenes())
def test_what_collides_has_a_witness_on_the_triangle(
    certifier: Certifier, scene: tuple[Hull, Triangles]
) -> None:
    hull, mesh = scene

    found = certifier.certify(hull, mesh)

    collides = found.verdict == COLLIDING
    assert np.isfinite(found.witness_world[collides]).all()
    assert np.isnan(found.witness_world[~collides]).all()
    assert contains_points(hull, found.witness_world[collides]).all()
    for corners, witness in zip(
        mesh.corners_world[collides], found.witness_world[collides], strict=True
    ):
        # The nearest convex combination of the corners, about the first of them.
        edges = (corners[1:] - corners[0]).T
        weights = np.linalg.lstsq(edges, witness - corners[0], rcond=1e-6)[0]
        size_m = 1.0 + np.abs(corners).max()
        assert np.linalg.norm(edges @ weights - (witness - corners[0])) < 1e-6 * size_m
        assert (witness >= corners.min(axis=0) - 1e-12 * size_m).all()
        assert (witness <= corners.max(axis=0) + 1e-12 * size_m).all()


@pytest.mark.slow
@examples
@given(scene=scenes(), viewport=st.integers(1, 40))
def test_samples_never_contradict_a_certificate(
    certifier: Certifier, scene: tuple[Hull, Triangles], viewport: int
) -> None:
    hull, mesh = scene
    sampled = Triangles(mesh.vertices_world, mesh.faces, np.full(len(mesh), viewport, np.int32))

    verdict = certifier.certify(hull, sampled).verdict
    (hits,) = Reference().query(hull, [sampled])

    assert not (verdict[np.unique(hits.samples()[0])] == FREE).any()
    np.testing.assert_array_equal(verdict, certifier.certify(hull, mesh).verdict)


def strip(width_m: float, *, slant: float) -> tuple[Hull, np.ndarray]:
    """Return the hull of one pixel column, and a triangle that it crosses in a strip of a width.

    The camera looks down on the triangle's plane, 2 m away; the triangle is turned in its plane.
    """
    size_px = 41
    matrix = projection(
        look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3)), 2.0 / width_m, size_px, size_px
    )
    views = make_views(("above",), np.array([[size_px, size_px]]), matrix[None])
    mask = np.zeros((size_px, size_px), np.uint8)
    mask[:, 20] = 1
    angles = slant + np.array([0.0, 2.2, 4.4])
    corners = 15 * width_m * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    return make_hull(views, [mask]), corners


@given(width_m=st.floats(1e-4, 0.1), share=st.floats(0.01, 1.0), slant=st.floats(0.0, 6.28))
def test_a_strip_as_wide_as_the_disc_is_always_found(
    width_m: float, share: float, slant: float
) -> None:
    hull, corners = strip(width_m, slant=slant)
    mesh = soup(hull.views, corners[None] - hull.views.origin_world, np.ones(1, np.int32))

    found = certify_triangles(hull, mesh, share * width_m * (1 - 1e-9))

    assert found.verdict[0] == COLLIDING


def test_a_strip_much_thinner_than_the_disc_may_stay_open_but_is_never_called_free() -> None:
    verdict = []
    for slant in np.linspace(0.0, 6.28, 50):
        hull, corners = strip(0.001, slant=slant)
        mesh = soup(hull.views, corners[None] - hull.views.origin_world, np.ones(1, np.int32))
        verdict.append(int(certify_triangles(hull, mesh, 0.1).verdict[0]))

    assert set(verdict) == {OPEN, COLLIDING}


def test_a_speck_between_the_samples_is_found() -> None:
    views = ring_views(4, 720, 486)
    hull = ball_hull(views, np.array([0.03, 0.02, 0.0]), 0.008)
    corners = np.array([[[-0.5, -0.4, 0.0], [0.6, -0.4, 0.01], [0.0, 0.7, 0.0]]])
    mesh = soup(views, corners - views.origin_world, np.full(1, 10, np.int32))
    (hits,) = Reference().query(hull, [mesh])
    assert len(hits) == 0

    found = certify_triangles(hull, mesh, 1e-4)

    assert found.verdict.tolist() == [COLLIDING]
    assert np.linalg.norm(found.witness_world[0] - [0.03, 0.02, 0.0]) < 0.02


def test_a_triangle_that_needs_too_many_cells_is_open_at_the_size_it_reached(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two silhouettes that touch along a line: nothing is in both, and no cell on it is free."""
    matrix = projection(look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3)), 1000.0, 40, 40)
    views = make_views(("a", "b"), np.array([[40, 40]] * 2), np.array([matrix, matrix]))
    left, right = np.zeros((2, 40, 40), np.uint8)
    left[:, :20], right[:, 20:] = 1, 1
    hull = make_hull(views, [left, right])
    corners = np.array([[[-0.03, -0.03, 0.0], [0.03, -0.02, 0.0], [0.01, 0.03, 0.0]]])
    mesh = soup(views, corners - views.origin_world, np.ones(1, np.int32))

    few: list[Any] = []
    many: list[Any] = []
    for most_cells, found in ((100, few), (1 << 17, many)):
        monkeypatch.setattr(certify_module, "MOST_CELLS", most_cells)
        certificates = certify_triangles(hull, mesh, 1e-4)
        found.extend([certificates.verdict[0], certificates.open_at_m[0]])

    assert few[0] == many[0] == OPEN
    assert many[1] <= 1e-4
    assert 1e-4 < few[1] < 0.1


@pytest.mark.slow
@examples
@given(scene=scenes(), n_threads=st.integers(1, 3))
def test_a_mesh_is_what_its_triangles_are(
    certifier: Certifier, scene: tuple[Hull, Triangles], n_threads: int
) -> None:
    hull, mesh = scene
    triangles = certifier.certify(hull, mesh)

    with Certifier(OPEN_AT_M, n_threads) as other:
        whole = other.certify_mesh(hull, mesh)

    assert whole.verdict == triangles.verdict.max()
    if whole.verdict == COLLIDING:
        first = int(np.argmax(triangles.verdict == COLLIDING))
        np.testing.assert_array_equal(whole.witness_world, triangles.witness_world[first])
    elif whole.verdict == OPEN:
        assert whole.open_at_m == np.nanmax(triangles.open_at_m)


def test_an_empty_mesh_is_free(certifier: Certifier) -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)
    nothing = Triangles(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, np.int32))

    assert len(certifier.certify(hull, nothing).verdict) == 0
    assert certifier.certify_mesh(hull, nothing).verdict == FREE


def test_a_disc_of_no_size_is_refused() -> None:
    with pytest.raises(ValueError, match=r"open_at_m is 0\.0, expected a positive length"):
        Certifier(0.0)
