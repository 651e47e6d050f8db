"""Distances and sides beside rational numbers: slivers, lines, points; on edges, by last bits."""

from itertools import pairwise

import numpy as np
import pytest
from helpers.exact_geometry import (
    ExactSolid,
    is_within,
    side_of_line,
    side_of_plane,
    squared_to_triangle,
)
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.pose import rotation_about_axes
from hybridve.hull.cad import predicates
from hybridve.hull.cad.distance import SurfaceDistance

#: Coordinates that fall together, that differ by last bits, and that are far apart in size.
_COORDINATES = st.one_of(
    st.integers(-4, 4).map(float),
    st.integers(-4, 4).map(lambda k: k / 3.0),
    st.integers(-4, 4).map(lambda k: np.nextafter(k / 3.0, 9.0)),
    st.floats(-1.0, 1.0),
    st.floats(-1e6, 1e6),
)
_POINTS = st.tuples(_COORDINATES, _COORDINATES, _COORDINATES).map(np.array)


@given(_POINTS, _POINTS, _POINTS, _POINTS, st.sampled_from([0.0, 0.25, 0.5, 1.0]))
@settings(max_examples=asked(400))
def test_sides_are_those_of_rational_arithmetic(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    c: NDArray[np.float64],
    p: NDArray[np.float64],
    share: float,
) -> None:
    """Also of points as near to the line and the plane as rounding brings them."""
    near = a + share * (b - a)
    a, b, c, p, near, over = predicates.within_range(
        np.stack([a, b, c, p, near, near + (1.0 - share) / 3.0 * (c - a)])
    )
    for tried in (p, near, over):
        for first, second in ((a, b), (b, c)):
            expected = side_of_line(first[1:], second[1:], tried[1:])
            assert predicates.side_of_line(*first[1:], *second[1:], *tried[1:]) == expected
            assert predicates.side_of_line(*second[1:], *first[1:], *tried[1:]) == -expected
        expected = side_of_plane(a, b, c, tried)
        assert predicates.side_of_plane(a, b, c, tried) == expected
        assert predicates.side_of_plane(b, a, c, tried) == -expected


@given(st.lists(st.floats(-1e300, 1e300), max_size=30), st.randoms())
@settings(max_examples=asked(300))
def test_a_sum_has_the_sign_of_the_exact_sum(terms: list[float], random: object) -> None:
    """Of numbers that cancel, too: each stands there with its opposite, but for some."""
    from fractions import Fraction

    several = terms + [-term for term in terms[: len(terms) // 2]]
    random.shuffle(several)  # type: ignore[attr-defined]
    exact = sum((Fraction(term) for term in several), Fraction(0))
    expected = (exact > 0) - (exact < 0)
    if abs(exact) < 1e307:
        assert predicates.sign_of_sum(np.array(several, np.float64)) == expected


def one_triangle(corners: NDArray[np.float64]) -> SurfaceDistance:
    return SurfaceDistance(corners, np.array([[0, 1, 2]], np.int32), is_closed=False)


def assert_exact(surface: SurfaceDistance, corners: NDArray[np.float64], points: object) -> None:
    """Distances (N,) from triangles (T, 3, 3) are the exact ones to what is said to be the error.

    And the point that is named is that far away, and on the triangle that is named.
    """
    points = np.asarray(points)
    distance_m, nearest, triangle = surface.closest(points)
    for point, found_m, on_surface, number in zip(
        points, distance_m.tolist(), nearest, triangle.tolist(), strict=True
    ):
        error_m = surface.error_m(found_m)
        exact = min(squared_to_triangle(point, each) for each in corners)
        assert is_within(found_m, exact, error_m)
        # Coordinates of the named point are rounded, too.
        placed_m = error_m + 4.0 * float(np.spacing(np.abs(corners[number]).max()))
        assert is_within(0.0, squared_to_triangle(on_surface, corners[number]), placed_m)
        away_m = float(np.linalg.norm(point - on_surface))
        assert abs(away_m - found_m) <= placed_m + 4.0 * np.spacing(away_m)


@pytest.mark.slow
@given(_POINTS, _POINTS, _POINTS, st.lists(_POINTS, min_size=1, max_size=3))
@settings(max_examples=asked(300))
def test_distances_to_any_triangle_are_exact_but_for_rounding(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    c: NDArray[np.float64],
    points: list[NDArray[np.float64]],
) -> None:
    corners = np.array([a, b, c])

    assert_exact(one_triangle(corners), corners[None], [*points, a, (a + b + c) / 3.0])


def thin_triangle(rng: np.random.Generator, kind: str) -> NDArray[np.float64]:
    """Return corners (3, 3) of a triangle that is hardly one, in a random order."""
    length_m = 10.0 ** rng.uniform(-3, 0.5)
    a = rng.normal(size=3) * rng.choice([0.0, 0.1, 10.0])
    b = a + length_m * rng.normal(size=3)
    share = rng.choice([0.0, 0.5, 1.0, rng.uniform(), 1e-9 * rng.uniform()])
    c = a + share * (b - a)
    if kind == "sliver":
        c = c + length_m * 10.0 ** -rng.uniform(5, 18) * rng.normal(size=3)
    elif kind == "needle":
        c = b + length_m * 10.0 ** -rng.uniform(5, 18) * rng.normal(size=3)
    elif kind == "line":
        a, b, c = np.round([a, b, c], 2)
        b = a + 4.0 * np.round(b - a, 2)
        c = a + (b - a) / 4.0
    elif kind == "point":
        b = c = a
    elif kind == "speck":
        b, c = a + 1e-17 * rng.normal(size=(2, 3))
    return rng.permutation(np.array([a, b, c]))


def about(rng: np.random.Generator, corners: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """Return points (n, 3) on, beside and far from a triangle."""
    weights = rng.dirichlet(np.ones(3), n)
    size_m = max(float(np.ptp(corners, axis=0).max()), 1e-3)
    off_m = size_m * 10.0 ** rng.uniform(-17, 1.5, (n, 1))
    return weights @ corners + off_m * rng.normal(size=(n, 3))


KINDS = ["sliver", "collinear", "needle", "line", "point", "speck"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_slivers_lines_and_points_are_measured_as_exactly(kind: str) -> None:
    rng = np.random.default_rng([11, KINDS.index(kind)])
    for _ in range(500):
        corners = thin_triangle(rng, kind)

        assert_exact(one_triangle(corners), corners[None], about(rng, corners, 3))


@pytest.mark.slow
def test_among_others_thin_triangles_are_measured_as_exactly() -> None:
    """And who is measured first, and in which company, changes no bit."""
    rng = np.random.default_rng(12)
    for _ in range(25):
        common = rng.normal(size=(6, 1, 3)) * 0.3 + 0.1 * rng.normal(size=(6, 3, 3))
        corners = np.concatenate([common, [thin_triangle(rng, kind) for kind in KINDS]])
        corners = np.concatenate([corners, corners[:2]])  # twice the same
        faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
        surface = SurfaceDistance(corners.reshape(-1, 3), faces, is_closed=False)
        points = np.concatenate([about(rng, triangle, 3) for triangle in corners])

        assert_exact(surface, corners, points)
        alone = [one_triangle(triangle).closest(points)[0] for triangle in corners]
        distance_m, nearest, triangle = surface.closest(points)
        np.testing.assert_array_equal(distance_m, np.min(alone, axis=0))
        np.testing.assert_array_equal(triangle, np.argmin(alone, axis=0))
        order = rng.permutation(len(points))
        again = surface.closest(points[order])
        np.testing.assert_array_equal(again[0], distance_m[order])
        np.testing.assert_array_equal(again[1], nearest[order])
        np.testing.assert_array_equal(again[2], triangle[order])


Mesh = tuple[NDArray[np.float64], NDArray[np.int32]]


def box(half: NDArray[np.float64], center: NDArray[np.float64]) -> Mesh:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [(a, b, c) for a, b, c, _ in quads] + [(a, c, d) for a, _, c, d in quads]
    return corners * half + center, np.array(faces, np.int32)


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    return (
        np.concatenate([vertices for vertices, _ in meshes]),
        np.concatenate(
            [faces + start for (_, faces), start in zip(meshes, starts, strict=False)]
        ).astype(np.int32),
    )


def crumpled(rng: np.random.Generator) -> Mesh:
    """Return a box whose corners went anywhere: closed, and it may run through itself."""
    vertices, faces = box(np.ones(3), np.zeros(3))
    return rng.normal(size=vertices.shape), faces


def solids(rng: np.random.Generator) -> list[Mesh]:
    """Return solids whose faces lie along the axes or not, nested, inverted and overlapping."""
    half = rng.integers(1, 5, 3) / 4.0
    inner = box(half / 2.0, np.zeros(3))
    outer = box(half, np.zeros(3))
    turned = rotation_about_axes(tuple(rng.uniform(-180, 180, 3)))
    all_of_them = [
        outer,
        (outer[0], outer[1][:, ::-1].copy()),
        joined(outer, inner),
        joined(outer, (inner[0], inner[1][:, ::-1].copy())),
        joined(outer, box(half, half * 0.5)),
        crumpled(rng),
        joined(crumpled(rng), crumpled(rng)),
    ]
    return [
        mesh
        for vertices, faces in all_of_them
        for mesh in ((vertices, faces), (vertices @ turned.T, faces))
    ]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_winding_numbers_are_those_of_rational_arithmetic(seed: int) -> None:
    """Points on a grid that the faces lie on, rays through edges and corners, last bits away."""
    rng = np.random.default_rng([13, seed])
    numbers = set()
    for vertices, faces in solids(rng):
        corners = vertices[faces]
        surface, exact = SurfaceDistance(vertices, faces, is_closed=True), ExactSolid(corners, rng)
        grid = rng.integers(-5, 6, (6, 3)) / 4.0
        weights = rng.dirichlet(np.ones(3), 9)
        weights[:3] = np.round(weights[:3])
        weights[3:6] = [0.5, 0.25, 0.25]
        on_face = (weights[:, None] @ corners[rng.integers(len(corners), size=9)])[:, 0]
        steps = rng.integers(-3, 4, on_face.shape)
        beside = on_face + steps * np.spacing(np.abs(on_face))
        points = np.concatenate([grid, on_face, beside, vertices, rng.normal(size=(6, 3))])
        off_surface = [min(squared_to_triangle(p, each) for each in corners) > 0 for p in points]

        found = surface.winding(points)
        signed_m, _ = surface.signed(points)

        for point, is_off, winding, distance_m in zip(
            points, off_surface, found.tolist(), signed_m.tolist(), strict=True
        ):
            if is_off:
                assert winding == exact.winding(point)
                assert (distance_m < 0) == (winding != 0) or distance_m == 0
            else:
                assert abs(distance_m) <= surface.error_m(0.0)
        numbers |= set(found.tolist())
    assert {-1, 0, 1, 2} <= numbers


@pytest.mark.parametrize("seed", range(4))
def test_sides_do_not_depend_on_the_points_before(seed: int) -> None:
    """Sides are taken over from point to point where no surface is between."""
    rng = np.random.default_rng([14, seed])
    n_inside = 0
    for vertices, faces in solids(rng):
        surface = SurfaceDistance(vertices, faces, is_closed=True)
        path = np.cumsum(0.02 * rng.normal(size=(2000, 3)), axis=0)

        signed_m, _ = surface.signed(path)

        np.testing.assert_array_equal(signed_m < 0, surface.winding(path) != 0)
        n_inside += int((signed_m < 0).sum())
        jumps = np.abs(np.diff(signed_m))
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        assert (jumps <= steps + 1e-12).all()  # a metre a metre, through any surface
        for point, along in pairwise(path[:20]):
            assert surface.signed(along[None])[0] == surface.signed(np.stack([point, along]))[0][1]
    assert n_inside > 1000
