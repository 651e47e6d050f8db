"""Polygons become triangles: their area, once, wholly; or they are refused."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.hull.cad.polygons import (
    PolygonError,
    clip_ears,
    cut_holes_open,
    cut_polygons,
    turns,
)

U_SHAPE = [(0, 0), (4, 0), (4, 4), (3, 4), (3, 1), (1, 1), (1, 4), (0, 4)]
ARROW = [(0, 0), (2, -1), (1, 0), (2, 1)]  # concave at the third corner, from which no fan is right
STAR = [(0, 3), (-1, 1), (-3, 0), (-1, -1), (0, -3), (1, -1), (3, 0), (1, 1)]
#: A square with a square hole, cut open: both ends of the slit come twice.
KEYHOLE = [(0, 0), (6, 0), (6, 6), (0, 6), (0, 0), (2, 2), (2, 4), (4, 4), (4, 2), (2, 2)]


def raised(points: Sequence[tuple[float, float]]) -> NDArray[np.float64]:
    return np.column_stack([np.array(points, np.float64), np.zeros(len(points))])


def cut(vertices: NDArray[np.float64]) -> NDArray[np.int32]:
    return cut_polygons(vertices, np.arange(len(vertices)), np.array([len(vertices)]))[0]


def signed_areas(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the areas (T,) of triangles in the plane z = 0, upwards positive."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.asarray(np.cross(b - a, c - a)[:, 2] / 2.0)


@pytest.mark.parametrize(
    ("polygon", "area"), [(U_SHAPE, 10.0), (ARROW, 1.0), (STAR, 12.0), (KEYHOLE, 32.0)]
)
@pytest.mark.parametrize("shift", range(10))
@pytest.mark.parametrize("backwards", [False, True])
def test_a_concave_polygon_is_covered_once(
    polygon: list[tuple[float, float]], area: float, shift: int, backwards: bool
) -> None:
    """None of its triangles is turned over, so that their areas cannot cancel."""
    vertices = np.roll(raised(polygon), shift, axis=0)
    if backwards:
        vertices = vertices[::-1]

    faces = cut(vertices)

    areas = signed_areas(vertices, faces) * (-1.0 if backwards else 1.0)
    assert len(faces) == len(vertices) - 2
    assert (areas >= 0).all()
    assert areas.sum() == area


def test_convex_polygons_stay_fans_from_their_first_corner() -> None:
    angles = np.linspace(0, 2 * np.pi, 7, endpoint=False)
    vertices = np.column_stack([np.cos(angles), np.sin(angles), angles * 0])

    assert cut(vertices).tolist() == [[0, k, k + 1] for k in range(1, 6)]


def test_polygons_of_all_sizes_keep_their_places() -> None:
    vertices = np.concatenate([raised(STAR), raised([(0, 0), (1, 0), (0, 1)]), raised(ARROW)])
    corners = np.array([8, 9, 10, *range(8), 11, 12, 13, 14, 10, 9, 8])

    faces, cuts = cut_polygons(vertices, corners, np.array([3, 8, 4, 3]))

    assert faces[0].tolist() == [8, 9, 10]
    assert set(faces[1:7].ravel().tolist()) == set(range(8))
    assert set(faces[7:9].ravel().tolist()) == {11, 12, 13, 14}
    assert faces[9].tolist() == [10, 9, 8]
    assert (cuts.n_polygons, cuts.n_bent, cuts.bent_by) == (2, 0, 0.0)


@given(st.lists(st.tuples(*[st.integers(-3, 3)] * 2), min_size=3, max_size=9))
def test_a_polygon_is_covered_once_or_refused(points: list[tuple[float, float]]) -> None:
    """Of any corners: crossing, touching, doubled, on a line; the area is the shoelace's."""
    vertices = raised(points)
    x, y = np.array(points, np.float64).T
    area = float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) / 2.0

    try:
        faces = cut(vertices)
    except PolygonError:
        assert _crosses(points)
        return

    areas = signed_areas(vertices, faces) * (-1.0 if area < 0 else 1.0)
    assert len(faces) == len(points) - 2
    assert (areas >= 0).all()
    assert areas.sum() == abs(area)


def _crosses(points: list[tuple[float, float]]) -> bool:
    """Tell whether edges that are no neighbours meet, which a simple polygon's do not."""
    n = len(points)

    def turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
        return float(np.sign((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])))

    for i in range(n):
        for j in range(i + 1, n):
            a, b, c, d = points[i], points[(i + 1) % n], points[j], points[(j + 1) % n]
            apart = turn(a, b, c) * turn(a, b, d) > 0 or turn(c, d, a) * turn(c, d, b) > 0
            if (j - i) % n not in (1, n - 1) and not apart:
                return True
            if a in (b, c) or b == d or (turn(a, b, d) == 0 and (j - i) % n == 1):
                return True  # doubled, or two neighbours on a line, which may lie on each other
    return False


@given(
    st.lists(st.floats(0.1, 1.0), min_size=4, max_size=24),
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    st.sampled_from([1e-3, 1.0, 1e3]),
    st.booleans(),
)
def test_a_star_keeps_its_area_however_it_lies(
    radii: list[float], quaternion: tuple[float, ...], scale: float, is_single: bool
) -> None:
    angles = np.arange(len(radii)) * 2 * np.pi / len(radii)
    flat = np.column_stack([np.cos(angles), np.sin(angles)]) * np.array(radii)[:, None]
    vertices = np.column_stack([flat, np.zeros(len(radii))]) @ _rotation(quaternion).T * scale
    if is_single:
        vertices = vertices.astype(np.float32).astype(np.float64)
    steps = np.sin(2 * np.pi / len(radii)) * np.array(radii) * np.roll(radii, -1)

    faces, cuts = cut_polygons(vertices, np.arange(len(radii)), np.array([len(radii)]))

    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0
    assert area == pytest.approx(steps.sum() / 2.0 * scale**2, rel=1e-5)
    assert cuts.n_bent == 0
    assert cuts.bent_by <= 2e-7 * scale  # single precision


def _rotation(quaternion: tuple[float, ...]) -> NDArray[np.float64]:
    x, y, z, w = np.array(quaternion) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@pytest.mark.parametrize("n_teeth", [3, 40, 300])
def test_a_comb_has_the_area_of_its_teeth(n_teeth: int) -> None:
    """Every second corner is concave, and all tips and all roots are on a line."""
    roots = [(float(k), 1.0 if k % 2 else 5.0) for k in range(2 * n_teeth, -1, -1)]
    vertices = raised([(0.0, 0.0), (2.0 * n_teeth, 0.0), *roots])

    areas = signed_areas(vertices, cut(vertices))

    assert (areas >= 0).all()
    assert areas.sum() == pytest.approx(6.0 * n_teeth, rel=1e-12)


@pytest.mark.parametrize(
    "points",
    [
        [(0, 0), (2, 2), (2, 0), (0, 2)],  # a bow tie of no area
        [(0, 0), (3, 3), (3, 0), (0, 2)],
        [(1.0, 0.0), (-0.81, 0.59), (0.31, -0.95), (0.31, 0.95), (-0.81, -0.59)],  # a pentagram
    ],
)
def test_a_polygon_that_crosses_itself_is_refused(points: list[tuple[float, float]]) -> None:
    good = raised(U_SHAPE)
    vertices = np.concatenate([good, raised(points)])
    counts = np.array([len(good), len(points)])

    with pytest.raises(PolygonError, match="crosses itself; cut it") as caught:
        cut_polygons(vertices, np.arange(len(vertices)), counts)

    assert caught.value.number == 1


def test_a_polygon_that_rounding_crosses_is_cut() -> None:
    """The third corner belongs on the line of the first two, and lies below it by 1e-8 of them."""
    vertices = raised([(0, 0), (10, 0), (5, -1e-7), (4, 5), (3, -1e-7)])

    areas = signed_areas(vertices, cut(vertices))

    assert areas.min() == pytest.approx(0.0, abs=1e-6)
    assert np.abs(areas).sum() == pytest.approx(5.0, abs=1e-5)


@pytest.mark.parametrize("height", [0.0, 1e-5, 0.5])
def test_a_bent_polygon_is_counted_with_how_far_it_is_bent(height: float) -> None:
    """A square of which one corner is raised: its diagonals pass each other half as high."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, height], [0, 1, 0]])

    faces, cuts = cut_polygons(vertices, np.arange(4), np.array([4]))

    assert faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert cuts.n_polygons == 1
    assert cuts.n_bent == (height > 2e-5)
    assert cuts.bent_by == pytest.approx(height / np.sqrt(2 * height**2 + 4), abs=1e-16)


def test_a_polygon_without_area_keeps_its_edges() -> None:
    faces = cut(raised([(0, 0), (1, 0), (2, 0), (3, 0)]))

    assert faces.tolist() == [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize(
    ("corners", "counts", "line"),
    [
        ([0, 1], [2], "a face of 2 corners"),
        ([0, 1, 4], [3], "names vertex 4 of 4"),
        ([0, 1, -1], [3], "names vertex -1 of 4"),
    ],
)
def test_faces_that_are_none_are_refused(corners: list[int], counts: list[int], line: str) -> None:
    with pytest.raises(ValueError, match=line):
        cut_polygons(raised(STAR)[:4], np.array(corners), np.array(counts))


def test_turns_are_exact_where_products_round() -> None:
    """Corners on the line y = x, moved by one unit in the last place."""
    steps = np.array([-1, 0, 1]) * np.spacing(0.5)
    near = np.column_stack([np.full(3, 0.5), 0.5 + steps])
    far, between = np.full((3, 2), 24.0), np.full((3, 2), 12.0)

    assert turns(far, between, near).tolist() == [1, 0, -1]
    assert turns(between, between, near).tolist() == [0, 0, 0]
    tiny = np.array([[[0.0, 0.0]], [[1e-200, 0.0]], [[0.0, 1e-200]]])
    assert turns(*tiny).tolist() == [1]  # although its products are less than any number


def test_ears_of_a_spiral_are_found() -> None:
    square = [(0, 0), (9, 0), (9, 9), (1, 9), (1, 2), (7, 2), (7, 7), (3, 7), (3, 4), (5, 4)]
    back = [(5, 5), (4, 5), (4, 6), (6, 6), (6, 3), (2, 3), (2, 8), (8, 8), (8, 1), (0, 1)]
    points = [(float(x), float(y)) for x, y in square + back]

    found = clip_ears(points)

    assert found is not None
    vertices = raised(points)
    areas = signed_areas(vertices, np.array(found, np.int32))
    assert (areas >= 0).all()


@pytest.mark.parametrize("turned", [False, True])
def test_holes_are_left_out(turned: bool) -> None:
    """Nine square holes of a plate, with either sense of rotation."""
    square = np.array([(0.0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
    outline = square * 10
    holes = [square + np.array([1 + 3 * i, 1 + 3 * j, 0]) for i in range(3) for j in range(3)]
    if turned:
        holes = [hole[::-1] for hole in holes]
    vertices = np.concatenate([outline, *holes])

    chain = np.array(cut_holes_open(outline, holes))
    faces, _ = cut_polygons(vertices, chain, np.array([len(chain)]))

    areas = signed_areas(vertices, faces)
    assert len(faces) == 40 + 2 * 9 - 2
    assert (areas >= 0).all()
    assert areas.sum() == 100 - 9
    centres = vertices[faces].mean(axis=1)[areas > 0]
    assert not ((centres[:, :2] % 3 > 1) & (centres[:, :2] % 3 < 2)).all(axis=1).any()


def test_a_hole_outside_its_polygon_is_refused() -> None:
    square = np.array([(0.0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])

    with pytest.raises(PolygonError, match="is not inside it"):
        cut_holes_open(square, [square + np.array([5.0, 0, 0])])
