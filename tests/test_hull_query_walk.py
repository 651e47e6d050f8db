"""Rays through hulls small enough to be worked out by hand, and the directions of outlines."""

from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from helpers.hulls import ball_hull, look_at, projection, ring_views
from helpers.response import angle_deg, camera_center, random_unit
from numpy.typing import NDArray

from hybridve.hull.query.silhouettes import (
    Hull,
    Unseen,
    Views,
    make_hull,
    make_seen,
    make_views,
)
from hybridve.hull.query.walk import boundary_cameras, silhouette_normal, spans_in_hull

#: Looks along +z from the origin; a point (x, y, 1) projects to pixel (x, y).
ALONG_Z = np.eye(3, 4)

#: Looks along -z from (0, 0, 10), mirrored so that (x, y, 9) projects to pixel (x, y).
ALONG_MINUS_Z = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, -1.0, 10.0]])

X, Y, Z = np.eye(3)


def small_hull(
    masks: list[list[list[int]]],
    unseen: Unseen = "carve",
    min_cameras: int = 1,
    matrices: tuple[NDArray[np.float64], ...] = (ALONG_Z, ALONG_MINUS_Z),
) -> Hull:
    """Cameras by hand; make_views is left out so that nothing is rounded."""
    arrays = [np.array(mask, np.uint8) for mask in masks]
    sizes = np.array([[mask.shape[1], mask.shape[0]] for mask in arrays])
    names = tuple("abcd"[: len(arrays)])
    matrices_used = np.array(matrices[: len(arrays)], np.float64)
    views = Views(names, sizes, matrices_used, np.zeros(3), unseen, min_cameras)
    return make_hull(views, arrays)


ROW = [[0, 1, 1, 0, 1]]


@pytest.mark.parametrize(
    ("origin", "direction", "reach_m", "expected"),
    [
        ((0, 0.5, 1), X, 9.0, [[1, 3], [4, 5]]),  # 5 is the image's border
        ((0, 0.5, 1), 7 * X, 9.0, [[1, 3], [4, 5]]),
        ((0, 1, 2), X, 20.0, [[2, 6], [8, 10]]),  # twice as deep
        ((1.5, 0.5, 1), X, 9.0, [[0, 1.5], [2.5, 3.5]]),
        ((1.5, 0.5, 1), X, 3.0, [[0, 1.5], [2.5, 3]]),  # cut at the reach
        ((1.5, 0.5, 1), X, 2.0, [[0, 1.5]]),
        ((5, 0.5, 1), -X, 9.0, [[0, 1], [2, 4]]),
        ((0, 0.0, 1), X, 9.0, [[1, 3], [4, 5]]),  # the upper edge is of the image
        ((0, 1.0, 1), X, 9.0, []),  # the lower is not
        ((0, 0.5, -1), X, 9.0, []),  # behind the camera
        ((0, 0.5, 0), X, 9.0, []),  # in its own plane
        ((1, 0.5, 1), Y, 9.0, [[0, 0.5]]),  # the edge of a column is of the one on its right
        ((3, 0.5, 1), Y, 9.0, []),
        ((4.5, 0.5, -1), Z, 9.0, [[1 + 4.5 / 5, 1 + 4.5 / 4], [1 + 4.5 / 3, 5.5]]),
        ((-1.5, -0.5, -1), (1.5, 0.5, 1), 9.0, [[np.sqrt(3.5), 9]]),  # through its centre
    ],
)
def test_one_row_of_pixels(
    origin: tuple[float, ...],
    direction: NDArray[np.float64],
    reach_m: float,
    expected: list[list[float]],
) -> None:
    hull = small_hull([ROW])

    spans_m = spans_in_hull(hull, np.array(origin, float), np.array(direction, float), reach_m)

    assert spans_m.shape == (len(expected), 2)
    np.testing.assert_allclose(spans_m, np.array(expected).reshape(-1, 2), rtol=0, atol=1e-14)


def test_pixels_that_touch_at_a_corner_are_one_stretch() -> None:
    hull = small_hull([[[1, 0, 0], [0, 1, 0], [0, 0, 1]]])

    spans_m = spans_in_hull(hull, np.array([0.0, 0.0, 1.0]), np.array([1.0, 1.0, 0.0]), 9.0)

    np.testing.assert_allclose(spans_m, [[0, 3 * np.sqrt(2)]], atol=1e-14)


def test_another_camera_carves_where_it_sees_nothing_unless_it_abstains() -> None:
    masks = [ROW, [[1, 1, 0]]]
    start = np.array([0.0, 0.5, 5.0])  # both are 5 m away: pixels are 5 m wide

    carved = spans_in_hull(small_hull(masks), start, X, 90.0)
    kept = spans_in_hull(small_hull(masks, "keep"), start, X, 90.0)
    both = spans_in_hull(small_hull(masks, "keep", 2), start, X, 90.0)

    np.testing.assert_allclose(carved, [[5, 10]])
    np.testing.assert_allclose(kept, [[5, 10], [20, 25]])
    np.testing.assert_allclose(both, [[5, 10]])


def with_recorded(hull: Hull, *recorded: list[list[int]] | None) -> Hull:
    """Return the hull of cameras that recorded these pixels of their images, or all."""
    masks = [None if mask is None else np.array(mask, np.uint8) for mask in recorded]
    seen = make_seen(hull.views.names, hull.views.sizes_px, masks)
    cameras = range(len(hull.views))
    return make_hull(replace(hull.views, seen=seen), [hull.mask(camera) for camera in cameras])


def test_a_camera_abstains_along_a_ray_where_it_recorded_nothing() -> None:
    masks = [[[0, 1, 1, 0, 1]], [[1, 1, 0]]]
    start = np.array([0.0, 0.5, 5.0])  # both are 5 m away: pixels are 5 m wide
    recorded = [[0, 1, 0, 0, 1]], [[1, 1, 0]]  # b did not record what was background to it

    kept, both = (
        spans_in_hull(with_recorded(small_hull(masks, "keep", least), *recorded), start, X, 90.0)
        for least in (1, 2)
    )

    np.testing.assert_allclose(kept, [[0, 10], [20, 25]])
    np.testing.assert_allclose(both, [[5, 10]])


def test_the_end_of_what_a_camera_recorded_ends_the_hull_where_too_few_are_left() -> None:
    masks = [[[1, 1, 1, 1, 1]], [[1, 1, 1, 1, 1]]]
    start = np.array([0.0, 0.5, 5.0])
    hulls = [
        with_recorded(small_hull(masks, "keep", least), [[1, 1, 0, 0, 0]], None) for least in (1, 2)
    ]

    ends = [spans_in_hull(hull, start, X, 90.0)[-1, 1] for hull in hulls]

    assert ends == [25.0, 10.0]
    points = [start + end * X for end in ends]
    assert boundary_cameras(hulls[0], points[0], X) == (1,)
    assert boundary_cameras(hulls[1], points[1], X) == (0,)
    assert boundary_cameras(hulls[0], points[1], X) == ()


@pytest.mark.parametrize("reach_m", [0.0, -1.0, np.nan, np.inf])
def test_a_reach_is_a_length(reach_m: float) -> None:
    with pytest.raises(ValueError, match="reach_m"):
        spans_in_hull(small_hull([ROW]), np.zeros(3), X, reach_m)


@pytest.mark.parametrize("far", [np.nan, np.inf])
def test_an_origin_is_a_point(far: float) -> None:
    with pytest.raises(ValueError, match="origin"):
        spans_in_hull(small_hull([ROW]), np.array([0.0, far, 1.0]), X, 1.0)


@pytest.mark.parametrize("unseen", ["carve", "keep"])
def test_among_the_largest_numbers_a_ray_still_ends_within_its_reach(unseen: Unseen) -> None:
    hull, reach_m = small_hull([ROW, [[1, 1, 0]]], unseen), 1e308
    for origin in ([1e308, 1e308, 1e308], [-1e308, 0.0, 1e308], [0.0, 0.0, -1e308]):
        ends_m = spans_in_hull(hull, np.array(origin), np.array([1.0, 1.0, -1.0]), reach_m).ravel()
        assert ((ends_m >= 0) & (ends_m <= reach_m)).all()
        assert (np.diff(ends_m) > 0).all()


@pytest.mark.parametrize("direction", [0 * X, np.nan * X, np.array([np.inf, 0, 0])])
def test_a_direction_has_a_length(direction: NDArray[np.float64]) -> None:
    with pytest.raises(ValueError, match="direction"):
        spans_in_hull(small_hull([ROW]), np.zeros(3), direction, 1.0)
    with pytest.raises(ValueError, match="direction"):
        boundary_cameras(small_hull([ROW]), np.zeros(3), direction)


def exact_spans(
    matrices: list[NDArray[np.int64]],
    masks: list[NDArray[np.uint8]],
    start: NDArray[np.int64],
    direction: NDArray[np.int64],
    reach: int,
    needed: int | None,
) -> list[list[Fraction]] | None:
    """Stretches in rational numbers, in lengths of the direction; None if it runs along an edge.

    `needed` cameras must see a point, and the others abstain; None: all, and none abstains.
    """
    cuts = {Fraction(0), Fraction(reach)}
    rays = []
    for matrix, mask in zip(matrices, masks, strict=True):
        begin = [int(v) for v in matrix[:, :3] @ start + matrix[:, 3]]
        step = [int(v) for v in matrix[:, :3] @ direction]
        rays.append((begin, step))
        for axis, size in ((0, mask.shape[1]), (1, mask.shape[0])):
            lines = [
                (begin[axis] - k * begin[2], step[axis] - k * step[2]) for k in range(size + 1)
            ]
            for g0, g1 in [*lines, (begin[2], step[2])]:
                if g0 == g1 == 0:
                    return None
                if g1 != 0:
                    cuts.add(Fraction(-g0, g1))
    spans: list[list[Fraction]] = []
    for first, last in pairwise(sorted(cut for cut in cuts if 0 <= cut <= reach)):
        middle = (first + last) / 2
        n_seen, background = 0, False
        for (begin, step), mask in zip(rays, masks, strict=True):
            x, y, z = (b + middle * s for b, s in zip(begin, step, strict=True))
            if z > 0 and 0 <= x < z * mask.shape[1] and 0 <= y < z * mask.shape[0]:
                n_seen += 1
                background |= not mask[int(y / z), int(x / z)]
        if background or n_seen < (len(masks) if needed is None else needed):
            continue
        if spans and spans[-1][1] == first:
            spans[-1][1] = last
        else:
            spans.append([first, last])
    return spans


@pytest.mark.slow
def test_ends_are_those_of_rational_arithmetic() -> None:
    """Cameras and rays in small integers: projections to corners, from behind, from the centre."""
    rng = np.random.default_rng(0)
    n_compared = n_spans = n_inner = 0
    for _ in range(3000):
        n_cameras = int(rng.integers(1, 4))
        matrices = [rng.integers(-3, 4, (3, 4)) for _ in range(n_cameras)]
        for matrix in matrices:
            matrix[:2] += 2 * matrix[2]  # something of it in the image
        shapes = rng.integers(3, 8, (n_cameras, 2))
        masks = [(rng.random(shape) < 0.75).astype(np.uint8) for shape in shapes]
        start, direction = rng.integers(-3, 4, 3), rng.integers(-3, 4, 3)
        needed = None if rng.random() < 0.5 else int(rng.integers(1, n_cameras + 1))
        if not direction.any():
            continue
        expected = exact_spans(matrices, masks, start, direction, 6, needed)
        if expected is None:
            continue
        views = Views(
            tuple("abc"[:n_cameras]),
            shapes[:, ::-1].astype(np.int64),
            np.array(matrices, np.float64),
            np.zeros(3),
            "carve" if needed is None else "keep",
            needed or 1,
        )
        length = float(np.linalg.norm(direction))

        spans_m = spans_in_hull(
            make_hull(views, masks), start.astype(float), direction.astype(float), 6 * length
        )

        truth = length * np.array(expected, np.float64).reshape(-1, 2)
        assert len(spans_m) == len(truth)
        np.testing.assert_allclose(spans_m, truth, rtol=0, atol=1e-13)
        n_compared, n_spans = n_compared + 1, n_spans + len(truth)
        n_inner += int(((truth > 0) & (truth < 6 * length)).sum())
    assert n_compared > 1500
    assert n_spans > 1000
    assert n_inner > 1000


def test_the_cameras_that_end_a_stretch() -> None:
    # At z = 5 columns are 5 m wide. Rows of c are 2 m high, and its silhouette is a step.
    beside = np.array([[1.0, 0, 0, 0], [0, 2.5, 0, 0], [0, 0, 0, 5.0]])
    hull = small_hull(
        [[[1, 1, 0, 1]], [[1, 1, 1]], [[1, 1, 0], [1, 1, 1]]],
        matrices=(ALONG_Z, ALONG_MINUS_Z, beside),
    )
    here = np.array([10.0, 3.0, 5.0])

    assert boundary_cameras(hull, here, X) == (0,)
    assert boundary_cameras(hull, here - 2 * Y, 3 * X) == (0, 2)  # the upper row of c
    assert boundary_cameras(hull, here - 0.1 * X, X) == ()  # within the hull
    assert boundary_cameras(hull, here + 1.0 * X, X) == ()  # outside
    assert boundary_cameras(hull, here, -X) == ()  # a begin, not an end
    assert boundary_cameras(hull, here - 10 * X, -X) == (0, 1, 2)  # the images' left borders


@pytest.mark.parametrize(("min_cameras", "expected"), [(1, ()), (2, (1,))])
def test_a_camera_that_may_abstain_ends_a_stretch_when_it_is_needed(
    min_cameras: int, expected: tuple[int, ...]
) -> None:
    behind = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, -20.0]])  # sees nothing of it
    hull = small_hull(
        [[[1, 1, 1, 1]], [[1, 1, 1]], [[1]]],
        "keep",
        min_cameras,
        (ALONG_Z, ALONG_MINUS_Z, behind),
    )

    assert boundary_cameras(hull, np.array([15.0, 2.0, 5.0]), X) == expected


def test_a_camera_that_begins_to_see_background_ends_a_stretch() -> None:
    hull = small_hull([[[1, 1, 1, 1]], [[0, 0, 0]]], "keep")
    start = np.array([19.0, 2.5, 5.0])

    spans_m = spans_in_hull(hull, start, -X, 90.0)
    normal = silhouette_normal(hull, 1, start - 4 * X)

    np.testing.assert_allclose(spans_m, [[0, 4]])
    assert boundary_cameras(hull, start - 4 * X, -X) == (1,)
    truth = np.array([-1.0, 0, 3]) @ ALONG_MINUS_Z[:, :3]  # into the image, over its right border
    assert angle_deg(normal, truth / np.linalg.norm(truth)) < 1e-6


def one_camera(
    rng: np.random.Generator, unseen: Unseen = "carve", size: tuple[int, int] = (90, 70)
) -> Views:
    width, height = size
    pose = look_at(3 * random_unit(rng), 0.1 * rng.normal(size=3), rng.uniform(0, 6))
    matrix = projection(pose, rng.uniform(60, 300), width, height)
    return make_views(("a",), np.array([[width, height]]), matrix[None], unseen)


def outline_errors(rng: np.random.Generator, radius_px: float | None) -> NDArray[np.float64]:
    """Degrees between normals and those of a disc's outline in closed form; None: a half plane's.

    The boundary points are ends of rays in any direction that leaves.
    """
    errors = []
    for _ in range(400):
        views = one_camera(rng)
        x, y = np.meshgrid(np.arange(90) + 0.5, np.arange(70) + 0.5)
        middle = np.array([45.0, 35.0]) + rng.uniform(-3, 3, 2)
        angle = rng.uniform(0, 2 * np.pi)
        if radius_px is None:
            mask = (x - middle[0]) * np.cos(angle) + (y - middle[1]) * np.sin(angle) < 0
        else:
            mask = (x - middle[0]) ** 2 + (y - middle[1]) ** 2 < radius_px**2
            middle += radius_px * np.array([np.cos(angle), np.sin(angle)])
        hull = make_hull(views, [mask.astype(np.uint8)])
        # From 4 px within to 4 px without, up to 60 degrees beside the outline's direction.
        matrix, slant = views.img_from_local[0], angle + rng.uniform(-1.0, 1.0)
        ends_px = middle + np.outer([-4.0, 4.0], [np.cos(slant), np.sin(slant)])
        depth_m = rng.uniform(2.0, 4.0, 2)[:, None]
        ends_local = np.linalg.solve(
            matrix[:, :3], (depth_m * np.column_stack([ends_px, [1, 1]]) - matrix[:, 3]).T
        ).T
        start, along = ends_local[0] + views.origin_world, ends_local[1] - ends_local[0]
        end_m = spans_in_hull(hull, start, along, float(np.linalg.norm(along)))[-1, 1]
        point = start + end_m * along / np.linalg.norm(along)

        normal = silhouette_normal(hull, 0, point)

        pixel = matrix @ np.append(point - views.origin_world, 1.0)
        pixel = pixel[:2] / pixel[2]
        truth_px = np.array([np.cos(angle), np.sin(angle)])
        if radius_px is not None:
            truth_px = pixel - (middle - radius_px * truth_px)
        truth = np.append(truth_px, -truth_px @ pixel) @ matrix[:, :3]
        errors.append(angle_deg(normal, truth / np.linalg.norm(truth)))
        assert abs(np.linalg.norm(normal) - 1) < 1e-12
        assert abs(normal @ (point - camera_center(views, 0))) < 1e-9  # the plane holds the camera
    return np.array(errors)


@pytest.mark.parametrize("radius_px", [None, 20.0])
def test_normals_of_half_planes_and_discs(radius_px: float | None) -> None:
    errors = outline_errors(np.random.default_rng(0), radius_px)

    # What `walk.WINDOW_PX` says of its choice.
    assert errors.mean() < 1.3
    assert errors.max() < 9.0


@pytest.mark.parametrize("unseen", ["carve", "keep"])
def test_the_border_of_an_image_is_a_boundary_where_nothing_is_seen(unseen: Unseen) -> None:
    views = one_camera(np.random.default_rng(1), unseen)
    hull = make_hull(views, [np.ones((70, 90), np.uint8)])
    matrix = views.img_from_local[0]
    for pixel, truth_px in (((90, 31.4), (1, 0)), ((0, 35), (-1, 0)), ((50, 0), (0, -1))):
        point_local = np.linalg.solve(matrix[:, :3], 2.0 * np.array([*pixel, 1]) - matrix[:, 3])

        normal = silhouette_normal(hull, 0, point_local + views.origin_world)

        truth = np.array([*truth_px, -np.dot(truth_px, pixel)]) @ matrix[:, :3]
        assert angle_deg(normal, truth / np.linalg.norm(truth)) < 1.0


def test_an_outline_goes_on_beyond_the_border_of_a_camera_that_abstains() -> None:
    """A slanting outline meets the border: background beyond would turn its direction."""
    x, y = np.meshgrid(np.arange(90) + 0.5, np.arange(70) + 0.5)
    mask = (x - 45 + 0.5 * y < 0).astype(np.uint8)  # meets the upper border at x = 45
    pixel = np.array([45.0, 0.2])
    turned = []
    for unseen in ("carve", "keep"):
        views = one_camera(np.random.default_rng(2), unseen)
        matrix = views.img_from_local[0]
        point_local = np.linalg.solve(matrix[:, :3], 2.0 * np.append(pixel, 1) - matrix[:, 3])
        normal = silhouette_normal(make_hull(views, [mask]), 0, point_local + views.origin_world)
        truth = np.array([1, 0.5, -pixel @ [1, 0.5]]) @ matrix[:, :3]
        turned.append(angle_deg(normal, truth / np.linalg.norm(truth)))

    assert turned[1] < 15 < turned[0]


def test_an_outline_goes_on_where_a_camera_recorded_nothing() -> None:
    """An upright outline; below it, and beside, the camera recorded nothing."""
    views = one_camera(np.random.default_rng(4), "keep")
    mask = np.zeros((70, 90), np.uint8)
    mask[:, :45] = 1
    recorded = np.ones((70, 90), np.uint8)
    recorded[36:] = recorded[:, 48:] = 0
    hulls = [
        make_hull(replace(views, seen=make_seen(views.names, views.sizes_px, [pixels])), [mask])
        for pixels in (None, recorded, 0 * recorded)
    ]
    matrix = views.img_from_local[0]
    points_world = [
        np.linalg.solve(matrix[:, :3], 2.0 * np.array([45.0, y, 1]) - matrix[:, 3])
        + views.origin_world
        for y in (34.5, 36.5)
    ]

    normals = [silhouette_normal(hull, 0, points_world[0]) for hull in hulls]

    np.testing.assert_array_equal(normals[1], normals[0])
    assert np.isnan(normals[2]).all()
    assert np.isnan(silhouette_normal(hulls[1], 0, points_world[1])).all()
    assert np.isfinite(silhouette_normal(hulls[0], 0, points_world[1])).all()


@pytest.mark.parametrize("is_hole", [False, True])
def test_the_normal_of_a_single_pixel_points_away_from_its_centre(is_hole: bool) -> None:
    views = one_camera(np.random.default_rng(3))
    mask = np.full((70, 90), is_hole, np.uint8)
    mask[30, 40] = not is_hole
    matrix = views.img_from_local[0]
    point_local = np.linalg.solve(matrix[:, :3], 2.0 * np.array([41, 30.5, 1]) - matrix[:, 3])

    normal = silhouette_normal(make_hull(views, [mask]), 0, point_local + views.origin_world)

    truth = np.array([1, 0, -41]) @ matrix[:, :3] * (-1 if is_hole else 1)
    assert angle_deg(normal, truth / np.linalg.norm(truth)) < 1e-6


def test_where_there_is_no_boundary_there_is_no_normal() -> None:
    views = ring_views()
    hull = ball_hull(views, np.zeros(3), 0.3)
    center = camera_center(views, 0)

    assert np.isnan(silhouette_normal(hull, 0, np.zeros(3))).all()  # the middle of the ball
    assert np.isnan(silhouette_normal(hull, 0, 2 * center)).all()  # behind the camera
    assert np.isnan(silhouette_normal(hull, 0, center)).all()
    assert np.isnan(silhouette_normal(hull, 0, np.array([0, 0, 9.0]))).all()  # beside the image
    line = np.zeros((486, 720), np.uint8)
    line[:, 360] = 1
    views = make_views(("a",), np.array([[720, 486]]), ALONG_Z[None])
    middle = np.array([360.5, 200.5, 1.0])
    assert np.isnan(silhouette_normal(make_hull(views, [line]), 0, middle)).all()
