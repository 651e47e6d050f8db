"""Shapes in closed form, and how near they come to a surface."""

from collections.abc import Callable
from fractions import Fraction
from math import isqrt

import numpy as np
import pytest
from helpers.thorough import asked
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.pose import Pose, rotation_about_axes, transform
from hybridve.hull.synth.closest import TOLERANCE_M, closest_on_surface
from hybridve.hull.synth.meshes import box_mesh
from hybridve.hull.synth.shapes import (
    Ball,
    Box,
    Capsule,
    Cylinder,
    Shape,
    lengths_and_units,
)

ROUNDING_M = 1e-12  # float64 at coordinates of a metre, with room for a few operations

#: Of 2.7e-162 the square is one and a half of the smallest number there is: rounded, it is one.
TINY_M = (5e-324, 2.7e-162)


def shapes_of(sizes: st.SearchStrategy[float]) -> st.SearchStrategy[Shape]:
    return st.one_of(
        st.builds(Ball, sizes),
        st.builds(Capsule, sizes, sizes),
        st.builds(Cylinder, sizes, sizes),
        st.builds(Box, sizes, sizes, sizes),
    )


sizes = st.floats(0.01, 0.3)
shapes = shapes_of(sizes)
#: Points, needles and discs are shapes, too.
any_sizes = st.floats(0.0, 0.3)
any_shapes = shapes_of(any_sizes)
coordinates = st.floats(-1.0, 1.0)
points = st.tuples(coordinates, coordinates, coordinates).map(np.array)
angles_deg = st.floats(-180.0, 180.0)
poses = st.builds(
    lambda angles, position: np.column_stack([rotation_about_axes(angles), position]),
    st.tuples(angles_deg, angles_deg, angles_deg),
    points,
)


def distance(shape: Shape, point: NDArray[np.float64]) -> float:
    return float(shape.signed_distance(point[None])[0][0])


def near_the_origin(test: Callable[..., None]) -> Callable[..., None]:
    """Ask a test of a shape, and two points `first` and `second`, where squares vanish."""
    for shape in (Ball(0.1), Capsule(0.1, 0.05), Cylinder(0.1, 0.05), Box(0.0, 0.1, 0.2)):
        for tiny_m in TINY_M:
            for first in ([tiny_m, 0.0, 0.0], [tiny_m, -tiny_m, 0.0], [0.0, 0.0, tiny_m]):
                second = np.sign(first) * 0.5
                test = example(shape=shape, first=np.array(first), second=second)(test)
    return test


@near_the_origin
@given(shape=any_shapes, first=points, second=points)
def test_a_step_changes_the_distance_by_no_more_than_its_length(
    shape: Shape, first: NDArray[np.float64], second: NDArray[np.float64]
) -> None:
    step_m = float(np.linalg.norm(second - first))

    change_m = abs(distance(shape, second) - distance(shape, first))

    assert change_m <= step_m + ROUNDING_M


@near_the_origin
@given(shape=any_shapes, first=points, second=points)
def test_the_distance_lies_above_its_tangents(
    shape: Shape, first: NDArray[np.float64], second: NDArray[np.float64]
) -> None:
    at_first, slope = shape.signed_distance(first[None])

    tangent = float(at_first[0] + slope[0] @ (second - first))

    assert distance(shape, second) >= tangent - ROUNDING_M
    assert np.linalg.norm(slope) <= 1.0 + 1e-15


def reachable(largest: float) -> st.SearchStrategy[float]:
    """Return floats of every exponent, down to the smallest there is."""
    return st.builds(
        lambda mantissa, exponent: float(np.ldexp(mantissa, exponent)),
        st.floats(-1.0, 1.0),
        st.integers(-1074, int(np.log2(largest))),
    )


@given(st.lists(reachable(1e100), min_size=2, max_size=3))
@example([5e-324, 5e-324])
@example([2.7e-162, 0.0])
@example([-1e-200, 1e-200, 1e100])
def test_lengths_and_directions_are_right_however_short_a_vector_is(vector: list[float]) -> None:
    (length,), (unit,) = lengths_and_units(np.array([vector]))

    # Whole numbers have no smallest part: the length lies between two that differ by rounding.
    as_whole = [int(Fraction(x) * 2**1074) for x in vector]
    exact = Fraction(isqrt(sum(x * x for x in as_whole) << 200), 2 ** (1074 + 100))
    assert abs(Fraction(length) - exact) <= exact * Fraction(1, 2**50) + Fraction(1, 2**1074)
    for x, along in zip(vector, unit, strict=True):
        expected = float(Fraction(x) / exact) if exact else 0.0
        assert along == pytest.approx(expected, abs=1e-15)


@example(radius_m=0.0, point=np.array([2.7e-162, 0.0, 0.0]))
@given(radius_m=any_sizes, point=points)
def test_distance_of_a_ball_is_that_of_its_centre_less_its_radius(
    radius_m: float, point: NDArray[np.float64]
) -> None:
    expected = np.sqrt(point[0] ** 2 + point[1] ** 2 + point[2] ** 2) - radius_m

    assert distance(Ball(radius_m), point) == pytest.approx(expected, abs=ROUNDING_M)


@example(half_length_m=0.0, radius_m=0.0, point=np.array([0.0, 5e-324, 5e-324]))
@example(half_length_m=0.0, radius_m=0.0, point=np.array([0.0, 0.0, 3.9001727462134305e-158]))
@given(half_length_m=any_sizes, radius_m=any_sizes, point=points)
def test_a_capsule_is_as_near_as_the_nearest_of_the_balls_it_consists_of(
    half_length_m: float, radius_m: float, point: NDArray[np.float64]
) -> None:
    along = np.linspace(-half_length_m, half_length_m, 2001)
    spacing_m = along[1] - along[0]
    balls = np.sqrt(point[0] ** 2 + point[1] ** 2 + (point[2] - along) ** 2) - radius_m

    found = distance(Capsule(half_length_m, radius_m), point)

    assert -spacing_m / 2 - ROUNDING_M <= found - balls.min() <= ROUNDING_M


@example(half=(0.0, 0.0, 0.0), point=np.array([5e-324, 5e-324, 0.0]))
@given(half=st.tuples(any_sizes, any_sizes, any_sizes), point=points)
def test_distance_of_a_box_is_that_to_its_nearest_surface_point(
    half: tuple[float, float, float], point: NDArray[np.float64]
) -> None:
    nearest = np.clip(point, -np.array(half), half)
    if np.array_equal(nearest, point):  # inside: straight to the nearest of six faces
        expected = -min(h - abs(p) for h, p in zip(half, point, strict=True))
    else:
        expected = float(np.linalg.norm(point - nearest))

    assert distance(Box(*half), point) == pytest.approx(expected, abs=ROUNDING_M)


@example(half_length_m=0.1, radius_m=0.05, point=np.array([5e-324, 0.0, 0.0]))
@example(half_length_m=0.0, radius_m=0.0, point=np.array([5e-324, 0.0, 5e-324]))
@given(half_length_m=any_sizes, radius_m=any_sizes, point=points)
def test_distance_of_a_cylinder_is_that_to_its_nearest_surface_point(
    half_length_m: float, radius_m: float, point: NDArray[np.float64]
) -> None:
    from_axis = float(np.hypot(point[0], point[1]))
    height = abs(point[2])
    if from_axis <= radius_m and height <= half_length_m:  # straight to the mantle or to an end
        expected = -min(radius_m - from_axis, half_length_m - height)
    else:
        # In the plane of the axis and the point it is a rectangle.
        nearest = np.array([min(from_axis, radius_m), min(height, half_length_m)])
        expected = float(np.linalg.norm(nearest - [from_axis, height]))

    assert distance(Cylinder(half_length_m, radius_m), point) == pytest.approx(
        expected, abs=ROUNDING_M
    )


@given(half_length_m=sizes, radius_m=sizes, origin=points)
def test_a_ray_along_the_axis_of_a_cylinder_enters_through_its_end(
    half_length_m: float, radius_m: float, origin: NDArray[np.float64]
) -> None:
    above = origin + 2.0 * np.eye(3)[2]
    assume(abs(np.hypot(above[0], above[1]) - radius_m) > 1e-9)

    (entry,) = Cylinder(half_length_m, radius_m).hit(above, np.array([[0.0, 0.0, -1.0]]))

    over_the_end = np.hypot(above[0], above[1]) < radius_m
    assert entry == (pytest.approx(above[2] - half_length_m) if over_the_end else np.inf)


@given(half_length_m=sizes, radius_m=sizes, direction=points)
def test_the_outline_of_a_cylinder_reaches_as_far_as_it_does_in_every_direction(
    half_length_m: float, radius_m: float, direction: NDArray[np.float64]
) -> None:
    assume(np.linalg.norm(direction) > 0.1)
    cylinder = Cylinder(half_length_m, radius_m)
    reaches = half_length_m * abs(direction[2]) + radius_m * np.hypot(direction[0], direction[1])

    outline = cylinder.outline()

    # A polygon of 100 corners lies within a circle by 1 - cos(pi / 100) of its radius.
    assert reaches - 5e-4 * radius_m * 2 <= (outline @ direction).max() <= reaches + ROUNDING_M
    assert np.linalg.norm(outline, axis=1).max() == pytest.approx(cylinder.reach_m)


@given(shape=shapes, origin=points, toward=points)
def test_a_ray_enters_where_the_distance_first_vanishes(
    shape: Shape, origin: NDArray[np.float64], toward: NDArray[np.float64]
) -> None:
    assume(distance(shape, origin) > 0.01)
    direction = 0.4 * toward - origin  # many hit, some miss
    length_m = float(np.linalg.norm(direction))
    assume(length_m > 0.1)

    entry = float(shape.hit(origin, direction[None])[0])

    # A walk that never steps over the surface: each step is as long as the way is free.
    along, free_m = 0.0, distance(shape, origin)
    for _ in range(400):
        along += free_m / length_m
        free_m = distance(shape, origin + along * direction)
        if free_m < 1e-7 or along > 30.0:
            break
    if free_m >= 1e-7 and along > 30.0:
        assert entry == np.inf
    elif np.isfinite(entry):
        assert abs(distance(shape, origin + entry * direction)) < 1e-7
        assert along <= entry + 1e-7 / length_m
    else:  # a ray that grazes: the walk comes within its own resolution and no further
        ahead = along + np.linspace(0.0, 1.0, 2001)
        rest = origin + ahead[:, None] * direction
        assert shape.signed_distance(rest)[0].min() > -1e-6


@given(
    shape=shapes,
    origin=points,
    toward=points,
    exponent=st.integers(-1070, 60),
)
@example(Box(0.1, 0.1, 0.1), np.array([0.05, 0.0, -1.0]), np.array([0.05, 1e-13, 1.0]), -40)
def test_rays_of_any_length_enter_at_the_same_place(
    shape: Shape, origin: NDArray[np.float64], toward: NDArray[np.float64], exponent: int
) -> None:
    assume(distance(shape, origin) > 0.01)
    direction = 0.4 * toward - origin
    assume(np.linalg.norm(direction) > 0.1)
    short = np.ldexp(direction, exponent)
    as_short = np.ldexp(short, -exponent)  # what is left of it: small numbers have few digits

    # A ray that grazes, to rounding, may be said to meet or to miss.
    meets = [
        np.isfinite(
            type(shape)(*(size + more for size in shape.sizes_m)).hit(origin, as_short[None])
        )
        for more in (-1e-9, 1e-9)
    ]
    assume(meets[0] == meets[1])

    (expected,), (entry,) = (shape.hit(origin, d[None]) for d in (as_short, short))

    if np.isfinite(expected) and entry < np.finfo(np.float64).max:
        assert np.ldexp(entry, exponent) == pytest.approx(expected, rel=1e-9)
    else:  # a miss, or farther than a float can say
        assert np.isfinite(entry) == np.isfinite(expected)
        assert np.isinf(expected) or expected > 2.0**1000 * 2.0 ** max(exponent, -1070)


@pytest.mark.parametrize("shape", [Ball(0.1), Capsule(0.1, 0.1), Cylinder(0.1, 0.1), Box(1, 1, 1)])
def test_a_ray_without_a_direction_meets_nothing(shape: Shape) -> None:
    assert shape.hit(np.array([0.0, 0.0, 2.0]), np.zeros((1, 3))).tolist() == [np.inf]


@example(
    corners=[np.array([0.0, 1.0, 0.0])] * 3,
    first=(Ball(0.25), np.eye(3, 4)),
    second=(Ball(0.25), np.column_stack([rotation_about_axes((0.0, 0.0, 1.125)), np.zeros(3)])),
)
@settings(max_examples=asked(40))
@given(
    corners=st.lists(points, min_size=3, max_size=9),
    first=st.tuples(shapes, poses),
    second=st.tuples(shapes, poses),
)
def test_the_closest_point_agrees_with_dense_samples_of_the_surface(
    corners: list[NDArray[np.float64]], first: tuple[Shape, Pose], second: tuple[Shape, Pose]
) -> None:
    triangles = np.array([corners[i : i + 3] for i in range(len(corners) - 2)])
    steps = 60
    i, j = (k.ravel() for k in np.mgrid[: steps + 1, : steps + 1])
    keep = i + j <= steps
    u, v = (k[keep][:, None] / steps for k in (i, j))
    a, b, c = (triangles[:, None, k] for k in range(3))
    samples = (a + (b - a) * u + (c - a) * v).reshape(-1, 3)
    edges = triangles - np.roll(triangles, 1, axis=1)
    spacing_m = np.linalg.norm(edges, axis=2).max() / steps
    sampled = np.inf
    for shape, world_from_shape in (first, second):
        local = (samples - world_from_shape[:, 3]) @ world_from_shape[:, :3]
        sampled = min(sampled, float(shape.signed_distance(local)[0].min()))

    found = closest_on_surface(triangles, (first[0], second[0]), (first[1], second[1]))

    # Samples lie at most a spacing from any point of the surface, and distances are 1-Lipschitz.
    assert -spacing_m - ROUNDING_M <= found.distance_m - sampled <= TOLERANCE_M
    shape, world_from_shape = (first, second)[found.shape]
    local = (found.point_world - world_from_shape[:, 3]) @ world_from_shape[:, :3]
    assert distance(shape, local) == pytest.approx(found.distance_m, abs=10 * ROUNDING_M)


@given(half=st.tuples(sizes, sizes, sizes), center=points, radius_m=sizes, world_from_mesh=poses)
def test_a_ball_outside_a_box_of_triangles_is_as_far_as_outside_the_box(
    half: tuple[float, float, float],
    center: NDArray[np.float64],
    radius_m: float,
    world_from_mesh: Pose,
) -> None:
    size_mm = (2000 * half[0], 2000 * half[1], 2000 * half[2])
    surface = box_mesh(size_mm, 150.0).triangles_mm / 1000.0
    outside_m = float(np.linalg.norm(center - np.clip(center, -np.array(half), half)))
    assume(outside_m > 0)
    triangles = transform(world_from_mesh, surface.reshape(-1, 3)).reshape(-1, 3, 3)
    center_world = transform(world_from_mesh, center[None])[0]
    world_from_ball = np.column_stack([np.eye(3), center_world])

    found = closest_on_surface(triangles, (Ball(radius_m),), (world_from_ball,))

    excess_m = found.distance_m - (outside_m - radius_m)
    assert -10 * ROUNDING_M <= excess_m <= TOLERANCE_M + 10 * ROUNDING_M


@given(gap_m=st.floats(-0.02, 0.2), shift_m=st.floats(-0.03, 0.03))
def test_parallel_faces_are_as_far_apart_as_they_are(gap_m: float, shift_m: float) -> None:
    # The whole face is nearest: the worst case for a search that drops what is farther.
    surface = box_mesh((200.0, 200.0, 200.0), 50.0).triangles_mm / 1000.0
    pose = np.column_stack([np.eye(3), [0.1 + gap_m + 0.05, shift_m, 0.0]])

    found = closest_on_surface(surface, (Box(0.05, 0.05, 0.05),), (pose,))

    assert abs(found.distance_m - gap_m) <= TOLERANCE_M + ROUNDING_M
