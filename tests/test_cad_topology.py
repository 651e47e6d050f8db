"""Whether a mesh is closed, and where it is not: closed forms and what breaks them, to the edge."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.hull.cad.topology import Topology, examine_topology

Mesh = tuple[NDArray[np.float64], NDArray[np.int32]]


def soup(mesh: Mesh) -> Mesh:
    """Return the same triangles without a shared vertex, as STL has them."""
    vertices, faces = mesh
    return vertices[faces].reshape(-1, 3), np.arange(faces.size, dtype=np.int32).reshape(-1, 3)


def prism(outline: list[tuple[float, float]], triangles: list[list[int]], height: float) -> Mesh:
    """Return a prism over an outline, counter-clockwise, that is cut into triangles."""
    n = len(outline)
    low = np.column_stack([outline, np.zeros(n)])
    high = low + np.array([0.0, 0.0, height])
    floor = [[a, c, b] for a, b, c in triangles]
    lid = [[a + n, b + n, c + n] for a, b, c in triangles]
    sides = []
    for a in range(n):
        b = (a + 1) % n
        sides += [[a, b, b + n], [a, b + n, a + n]]
    return np.concatenate([low, high]), np.array(floor + lid + sides, np.int32)


def box(a: float, b: float, c: float) -> Mesh:
    return prism([(0, 0), (a, 0), (a, b), (0, b)], [[0, 1, 2], [0, 2, 3]], c)


def bracket() -> Mesh:
    """An L of 5 unit squares, one unit high: not convex."""
    outline = [(0.0, 0.0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)]
    return prism(outline, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]], 1.0)


def torus(n: int, m: int, large: float, small: float) -> Mesh:
    around, about = np.meshgrid(
        2 * np.pi * np.arange(n) / n, 2 * np.pi * np.arange(m) / m, indexing="ij"
    )
    reach = large + small * np.cos(about)
    points = [reach * np.cos(around), reach * np.sin(around), small * np.sin(about)]
    vertices = np.stack(points, axis=-1).reshape(-1, 3)
    i, j = (index.ravel() for index in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    a, b = i * m + j, (i + 1) % n * m + j
    c, d = (i + 1) % n * m + (j + 1) % m, i * m + (j + 1) % m
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return vertices, faces.astype(np.int32)


def torus_volume(n: int, m: int, large: float, small: float) -> float:
    """Return the volume of that mesh: its cross-section swept by chords.

    Between two cross-sections each triangle pair spans planes through corners of both, so the
    volume is found from the corners in closed form by Gauss's theorem, summed in exact order.
    """
    vertices, faces = torus(n, m, large, small)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a) / 2.0
    return float((normal[:, 2] * (a + b + c)[:, 2] / 3.0).sum())  # flux of (0, 0, z)


def counts(topology: Topology) -> tuple[int, int, int]:
    return (
        topology.n_open_edges,
        topology.n_nonmanifold_edges,
        topology.n_inconsistent_edges,
    )


SOLIDS = [
    pytest.param(box(1, 2, 3), 6.0, id="box"),
    pytest.param(bracket(), 5.0, id="bracket"),
    pytest.param(torus(24, 12, 3.0, 1.0), torus_volume(24, 12, 3.0, 1.0), id="torus"),
]


@pytest.mark.parametrize(("mesh", "volume"), SOLIDS)
@pytest.mark.parametrize("written", ["shared", "soup"])
def test_solids_are_closed_and_enclose_their_volume(
    mesh: Mesh, volume: float, written: str
) -> None:
    vertices, faces = mesh if written == "shared" else soup(mesh)
    far = vertices + np.array([1000.0, -2000.0, 500.0])

    found = examine_topology(vertices, faces)
    inside_out = examine_topology(vertices, faces[:, ::-1].copy())
    moved = examine_topology(far, faces)

    assert found.closed_within == inside_out.closed_within == 0.0
    assert counts(found) == counts(inside_out) == (0, 0, 0)
    assert found.volume == pytest.approx(volume, rel=1e-12)
    assert inside_out.volume == pytest.approx(-volume, rel=1e-12)
    assert moved.volume == pytest.approx(volume, rel=1e-9)


def test_the_torus_of_many_facets_has_the_volume_of_the_torus() -> None:
    found = examine_topology(*torus(400, 200, 3.0, 1.0))

    assert found.volume == pytest.approx(2 * np.pi**2 * 3.0, rel=5e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("mesh", "volume"), SOLIDS)
@given(data=st.data())
def test_one_triangle_decides(mesh: Mesh, volume: float, data: st.DataObject) -> None:
    vertices, faces = soup(mesh)
    which = data.draw(st.integers(0, len(faces) - 1))
    order = np.array(data.draw(st.permutations(range(len(faces)))))
    removed = np.delete(faces, which, axis=0)
    flipped = faces.copy()
    flipped[which] = flipped[which, ::-1]
    doubled = np.concatenate([faces, faces[which : which + 1]])
    doubled_and_flipped = np.concatenate([faces, faces[which : which + 1, ::-1]])

    assert examine_topology(vertices, faces[order]).closed
    for changed, expected in (
        (removed, (3, 0, 0)),
        (flipped, (0, 0, 3)),
        (doubled, (0, 3, 0)),
        (doubled_and_flipped, (0, 3, 0)),
    ):
        found = examine_topology(vertices, changed)
        assert counts(found) == expected
        assert not found.closed
        assert found.volume is None


def test_solids_that_share_an_edge_and_solids_twice_are_not_closed() -> None:
    vertices, faces = soup(box(1, 1, 1))
    diagonal = np.concatenate([vertices, vertices + np.array([1.0, 1.0, 0.0])])
    twice = np.concatenate([vertices, vertices])
    apart = np.concatenate([vertices, vertices + np.array([3.0, 0.0, 0.0])])
    both = np.concatenate([faces, faces + len(vertices)]).astype(np.int32)

    assert counts(examine_topology(diagonal, both)) == (0, 1, 0)
    assert counts(examine_topology(twice, both)) == (0, 18, 0)
    assert examine_topology(apart, both).volume == pytest.approx(2.0)


def test_a_cavity_is_taken_off() -> None:
    outer, faces = soup(box(3, 3, 3))
    inner = soup(box(1, 1, 1))[0] + 1.0
    both = np.concatenate([faces, faces[:, ::-1] + len(outer)]).astype(np.int32)

    assert examine_topology(np.concatenate([outer, inner]), both).volume == pytest.approx(26.0)


def with_triangles(mesh: Mesh, triangles: list[list[list[float]]]) -> Mesh:
    vertices, faces = soup(mesh)
    more = np.array(triangles, np.float64).reshape(-1, 3)
    numbers = np.arange(len(more)).reshape(-1, 3) + len(vertices)
    return np.concatenate([vertices, more]), np.concatenate([faces, numbers]).astype(np.int32)


@pytest.mark.parametrize(
    "needle",
    [
        [[0.0, 0, 0], [1, 0, 0], [0, 0, 0]],  # there and back along an edge
        [[0.0, 0, 0], [0, 0, 0], [0, 0, 0]],  # a point
        [[0.0, 0, 0], [0.5, 0, 0], [1, 0, 0]],  # along an edge, and past its middle
        [[0.5, 0.5, 0.5], [0.25, 0.25, 0.25], [0, 0, 0]],  # into the middle of the solid
    ],
)
def test_triangles_without_area_do_not_open_a_solid(needle: list[list[float]]) -> None:
    found = examine_topology(*with_triangles(box(1, 1, 1), [needle]))

    assert found.n_zero_area == 1
    assert counts(found) == (0, 0, 0)
    assert found.closed_within == 0.0
    assert found.volume == pytest.approx(1.0)


def test_a_triangle_without_area_may_be_what_closes_a_solid() -> None:
    """A tetrahedron whose one edge is split on one side only, and the needle that joins them."""
    o, x, y, z, m = [0.0, 0, 0], [2.0, 0, 0], [0.0, 2, 0], [0.0, 0, 2], [1.0, 0, 0]
    sides = [[o, y, m], [m, y, x], [o, x, z], [o, z, y], [x, y, z]]
    needle = [o, m, x]
    none: Mesh = (np.zeros((0, 3)), np.zeros((0, 3), np.int32))

    without = examine_topology(*with_triangles(none, sides))
    joined = examine_topology(*with_triangles(none, [*sides, needle]))

    assert counts(without) == (3, 0, 0)
    assert not without.closed
    assert counts(joined) == (0, 0, 0)
    assert joined.n_zero_area == 1
    assert joined.volume == pytest.approx(8 / 6)


def test_triangles_without_area_alone_close_nothing() -> None:
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    there_and_back = np.array([[0, 1, 2], [2, 1, 0]], np.int32)

    found = examine_topology(line, there_and_back)

    assert found.n_zero_area == 2
    assert not found.closed


@given(seed=st.integers(0, 2**32 - 1), offset=st.sampled_from([0.0, 1.0, 300.0]))
def test_noise_of_single_precision_is_allowed_for_and_told(seed: int, offset: float) -> None:
    rng = np.random.default_rng(seed)
    vertices, faces = soup(bracket())
    vertices = vertices + offset
    last_place = float(np.spacing(np.float32(np.abs(vertices).max())))
    noisy = vertices + rng.choice([0.0, 0.9 * last_place], vertices.shape)

    found = examine_topology(noisy, faces)

    assert found.n_open_edges > 0
    assert found.closed_within is not None
    assert last_place <= found.closed_within <= 4.0 * last_place
    assert found.volume == pytest.approx(5.0, rel=1e-3)


def test_a_crack_wider_than_that_stays_open() -> None:
    vertices, faces = soup(box(1, 1, 1))
    cracked = vertices.copy()
    cracked[0] += 1e-6

    found = examine_topology(cracked, faces)

    assert not found.closed
    assert counts(found) == (4, 0, 0)


def test_what_is_as_fine_as_the_noise_is_not_closed_by_it() -> None:
    """A speck smaller than the noise would vanish, and its open edges with it."""
    speck = [[0.5, 0.5, 0.5], [0.5 + 1e-8, 0.5, 0.5], [0.5, 0.5 + 1e-8, 0.5]]

    found = examine_topology(*with_triangles(box(1, 1, 1), [speck]))

    assert counts(found) == (3, 0, 0)
    assert found.n_zero_area == 0
    assert not found.closed


def test_signs_of_zero_are_no_difference() -> None:
    vertices, faces = soup(box(1, 1, 1))
    vertices[::2][vertices[::2] == 0] = -0.0

    assert examine_topology(vertices, faces).closed_within == 0.0
