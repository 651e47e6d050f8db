"""The hull of true shapes against cones in closed form, and distances to it against its points."""

import numpy as np
import pytest
from helpers.thorough import asked
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.lens import cam_from_img, project_points
from hybridve.calib.pose import Pose, rotation_about_axes, transform
from hybridve.hull.synth.cones import RESOLUTION_M, Surface, TrueHull
from hybridve.hull.synth.meshes import box_mesh
from hybridve.hull.synth.presets import PRESETS
from hybridve.hull.synth.shapes import Ball, Box, Capsule, Cylinder, Shape

CAMERAS = PRESETS["boxes"].make_stage().cameras

#: Float64 at a few metres, through an arcsine.
ROUNDING_RAD = 1e-7

places = st.tuples(st.floats(0.1, 0.6), st.floats(-0.1, 0.4), st.floats(0.3, 0.8)).map(np.array)
offsets = st.tuples(*[st.floats(-0.12, 0.12)] * 3).map(np.array)
sizes = st.floats(0.02, 0.08)
angles_deg = st.floats(-180.0, 180.0)


def at(place: NDArray[np.float64]) -> Pose:
    return np.column_stack([np.eye(3), place])


@given(place=places, radius_m=sizes, offset=offsets)
def test_a_point_is_in_the_hull_of_a_ball_if_every_tangent_cone_holds_it(
    place: NDArray[np.float64], radius_m: float, offset: NDArray[np.float64]
) -> None:
    point = place + offset
    margins = []
    for camera in CAMERAS:
        toward, ray = place - camera.center_world, point - camera.center_world
        across = float(np.linalg.norm(np.cross(toward, ray)))
        angle = np.arctan2(across, float(toward @ ray))
        margins.append(np.arcsin(radius_m / np.linalg.norm(toward)) - angle)
    assume(min(np.abs(margins)) > ROUNDING_RAD)

    (inside,) = TrueHull(CAMERAS, [Ball(radius_m)], [at(place)]).contains(point[None])

    assert inside == (min(margins) > 0)


@example(
    place=np.array([0.125, 5e-324, 0.5]),
    other=np.array([0.125, 5e-324, 0.5]),
    radius_m=0.02,
    rotate_deg=(0.0, 0.0, 0.0),
    offset=np.zeros(3),
)
@given(
    place=places,
    other=places,
    radius_m=sizes,
    rotate_deg=st.tuples(angles_deg, angles_deg, angles_deg),
    offset=offsets,
)
def test_the_hull_holds_the_shapes_and_the_points_they_explain_together(
    place: NDArray[np.float64],
    other: NDArray[np.float64],
    radius_m: float,
    rotate_deg: tuple[float, float, float],
    offset: NDArray[np.float64],
) -> None:
    turned = np.column_stack([rotation_about_axes(rotate_deg), other])
    shapes: tuple[Shape, ...] = (Ball(radius_m), Cylinder(2 * radius_m, radius_m))
    poses = (at(place), turned)
    point = place + offset

    (inside,) = TrueHull(CAMERAS, shapes, poses).contains(point[None])

    # Along the way from each camera and beyond, some point lies in a shape; and the reverse.
    seen = []
    for camera in CAMERAS:
        ray = point - camera.center_world
        along = camera.center_world + np.linspace(0.0, 2.0, 2001)[:, None] * ray
        depths = [
            shape.signed_distance((along - pose[:, 3]) @ pose[:, :3])[0].min()
            for shape, pose in zip(shapes, poses, strict=True)
        ]
        seen.append(min(depths))
    spacing_m = 2.0 * max(np.linalg.norm(point - c.center_world) for c in CAMERAS) / 2000
    if max(seen) < 0:
        assert inside
    if inside:
        assert max(seen) < spacing_m


def test_what_a_camera_does_not_see_is_not_in_the_hull() -> None:
    camera = CAMERAS[0]
    right, _, forward = camera.cam_from_world[:, :3]
    behind = camera.center_world - 2.0 * forward
    assert not TrueHull([camera], [Ball(0.1)], [at(behind)]).contains(behind[None]).any()

    # A big ball on the left border of the image: half of its middle line is out of sight.
    (slope,) = cam_from_img(camera, np.array([[0.0, 240.0]]))
    border = camera.center_world + 2.0 * np.append(slope, 1.0) @ camera.cam_from_world[:, :3]
    points = border + np.linspace(-0.1, 0.1, 40)[:, None] * right
    pixels, _ = project_points(camera, points)
    in_sight = pixels[:, 0] >= 0
    assert 0 < in_sight.sum() < len(points)

    inside = TrueHull([camera], [Ball(0.5)], [at(border)]).contains(points)

    np.testing.assert_array_equal(inside, in_sight)


def looking_along_z(center: tuple[float, float, float]) -> Camera:
    pose = np.column_stack([np.eye(3), -np.array(center)])
    return Camera("ahead", "PINHOLE", 640, 480, np.array([500.0, 500, 320, 240]), pose)


def test_a_camera_beside_a_long_thing_sees_the_end_that_is_ahead() -> None:
    # Its middle lies behind the camera, and one end ahead, more than a right angle away.
    camera, bar = looking_along_z((0.0, 0.0, 0.0)), Box(0.01, 0.01, 1.3)
    pose = np.column_stack([rotation_about_axes((0.0, 61.4, 0.0)), [-1.0, 0.0, -0.1]])
    ahead = 0.9 * transform(pose, np.array([[0.0, 0.0, 1.25]]))

    hull = TrueHull([camera], [bar], [pose])

    assert hull.contains(ahead).all()


@pytest.mark.parametrize("depth_m", [0.0, 5e-324, 2.7e-162, -5e-324])
@pytest.mark.parametrize("across", [0.0, 0.02, 0.2, 1e300])
def test_points_next_to_a_camera_are_in_the_hull_if_its_ray_through_them_meets_a_shape(
    depth_m: float, across: float
) -> None:
    camera = looking_along_z((0.0, 0.0, 0.0))
    point = np.array([[across * depth_m, 0.0, depth_m]])

    (inside,) = TrueHull([camera], [Ball(0.1)], [at(np.array([0.0, 0.0, 1.0]))]).contains(point)

    # The ball is seen to a slope of 0.1; of the smallest number there is, 0.2 is nothing.
    assert inside == (depth_m > 0 and point[0, 0] <= 0.1 * depth_m)


def test_cells_that_hold_a_camera_hide_nothing_of_the_hull() -> None:
    # One of the first cells reaches from behind the camera, where its middle is, to before it.
    camera = looking_along_z((0.0, 0.0, 0.0))
    speck = np.array([[[0.0, 0, -0.2], [1e-7, 0, -0.2], [0, 1e-7, -0.2]]])
    hull = TrueHull([camera], [Ball(0.1)], [at(np.array([0.0, 0.0, 1.0]))])

    found = hull.distance(Surface(speck), within_m=1.0)

    assert 0.2 - 1e-6 <= found.distance_m <= 0.2 + RESOLUTION_M


@pytest.mark.slow
@settings(max_examples=asked(60))
@given(place=places, radius_m=sizes, offset=offsets, camera=st.integers(0, 3))
def test_a_speck_is_as_far_from_the_cone_of_one_camera_as_geometry_says(
    place: NDArray[np.float64], radius_m: float, offset: NDArray[np.float64], camera: int
) -> None:
    center = CAMERAS[camera].center_world
    point = place + offset
    toward, ray = place - center, point - center
    half = np.arcsin(radius_m / np.linalg.norm(toward))
    angle = np.arctan2(float(np.linalg.norm(np.cross(toward, ray))), float(toward @ ray))
    assume(angle > half + 1e-3)
    expected_m = float(np.linalg.norm(ray) * np.sin(angle - half))
    speck = point + 1e-7 * np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])

    hull = TrueHull([CAMERAS[camera]], [Ball(radius_m)], [at(place)])
    found = hull.distance(Surface(speck), within_m=expected_m + 0.02)

    assert not found.collides
    assert expected_m - 1e-6 <= found.distance_m <= expected_m + RESOLUTION_M + 1e-6
    beyond = hull.distance(Surface(speck), within_m=0.9 * expected_m)
    assert beyond.distance_m == np.inf


@pytest.mark.slow
@settings(max_examples=asked(25))
@given(
    place=places,
    sizes_m=st.tuples(sizes, sizes, sizes),
    rotate_deg=st.tuples(angles_deg, angles_deg, angles_deg),
    offset=st.tuples(*[st.floats(-0.25, 0.25)] * 3).map(np.array),
    seed=st.integers(0, 1000),
)
def test_no_point_of_the_hull_is_nearer_than_the_distance_and_a_collision_is_one(
    place: NDArray[np.float64],
    sizes_m: tuple[float, float, float],
    rotate_deg: tuple[float, float, float],
    offset: NDArray[np.float64],
    seed: int,
) -> None:
    turned = np.column_stack([rotation_about_axes(rotate_deg), place])
    shapes, poses = (Box(*sizes_m), Capsule(0.1, 0.02)), (turned, at(place + 0.04))
    triangles = box_mesh((80.0, 60.0, 40.0), 30.0).triangles_mm / 1000.0 + place + offset
    surface = Surface(triangles)
    hull = TrueHull(CAMERAS, shapes, poses)

    found = hull.distance(surface, within_m=0.2)

    rng = np.random.default_rng(seed)
    points = place + rng.uniform(-0.2, 0.2, (3000, 3))
    inside = points[hull.contains(points)]
    if len(inside):
        nearest_m = surface.distance(inside)[0].min()
        assert found.distance_m <= nearest_m + 1e-12 or nearest_m > 0.2 - RESOLUTION_M
    weights = rng.dirichlet(np.ones(3), (len(triangles), 20))
    samples = (weights[..., None] * triangles[:, None]).sum(axis=2).reshape(-1, 3)
    if hull.contains(samples).any() and not found.collides:
        assert found.distance_m <= RESOLUTION_M
    if np.isfinite(found.distance_m):  # somewhere near there is a point of the hull
        close = hull.points_within(surface, found.distance_m + 2 * RESOLUTION_M)
        assert len(close)
        assert hull.contains(close).all()


@given(
    corners=st.lists(offsets, min_size=3, max_size=9),
    points=st.lists(offsets, min_size=1, max_size=5),
)
def test_a_surface_is_as_near_as_the_nearest_of_its_dense_samples(
    corners: list[NDArray[np.float64]], points: list[NDArray[np.float64]]
) -> None:
    triangles = np.array([corners[i : i + 3] for i in range(len(corners) - 2)])
    areas = np.linalg.norm(
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
    )
    assume(areas.min() > 1e-5)
    steps = 60
    i, j = (k.ravel() for k in np.mgrid[: steps + 1, : steps + 1])
    keep = i + j <= steps
    u, v = (k[keep][:, None] / steps for k in (i, j))
    a, b, c = (triangles[:, None, k] for k in range(3))
    samples = (a + (b - a) * u + (c - a) * v).reshape(-1, 3)
    spacing_m = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max() / steps

    distances, places_ = Surface(triangles).distance(np.array(points))

    for point, distance_m, place in zip(points, distances, places_, strict=True):
        sampled = np.linalg.norm(samples - point, axis=1).min()
        assert sampled - spacing_m <= distance_m <= sampled + 1e-9
        assert np.linalg.norm(place - point) == pytest.approx(distance_m, abs=1e-12)
        assert np.linalg.norm(samples - place, axis=1).min() <= spacing_m


@given(
    corners=st.lists(offsets, min_size=2, max_size=2),
    share=st.floats(0.0, 1.0),
    point=offsets,
    order=st.permutations(range(3)),
)
@example([np.zeros(3), np.zeros(3)], 0.5, np.array([0.1, 0.0, 0.0]), [0, 1, 2])
@example([np.zeros(3), np.array([5e-324, 0.0, 0.0])], 1.0, np.zeros(3), [0, 1, 2])
@example([np.zeros(3), np.array([2.7e-162, 0.0, 0.0])], 0.5, np.zeros(3), [2, 0, 1])
def test_a_triangle_without_area_is_as_near_as_the_line_that_it_is(
    corners: list[NDArray[np.float64]],
    share: float,
    point: NDArray[np.float64],
    order: list[int],
) -> None:
    start, stop = corners
    way = stop - start
    triangle = np.array([start, stop, start + share * way])[order]
    length2 = float(way @ way)
    nearest = start + (np.clip((point - start) @ way / length2, 0, 1) if length2 else 0.0) * way

    (distance_m,), (place,) = Surface(triangle[None]).distance(point[None])

    assert distance_m == pytest.approx(np.linalg.norm(point - nearest), abs=1e-9)
    assert np.linalg.norm(point - place) == pytest.approx(distance_m, abs=1e-12)


@pytest.mark.parametrize("side_m", [1.0, 1e-3, 1e-120, 1e-170])
def test_a_triangle_is_as_near_as_it_is_however_small(side_m: float) -> None:
    triangle = side_m * np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
    point = side_m * np.array([[0.25, 0.25, 0.0]]) + [0.0, 0.0, 0.5]

    (distance_m,), _ = Surface(triangle).distance(point)

    assert distance_m == pytest.approx(0.5, abs=1e-15)


def test_a_witness_shortens_the_search_and_leaves_the_answer() -> None:
    stage = PRESETS["boxes"].make_stage()
    poses = stage.poses(0.45)
    shapes = [real.shape for real in stage.shapes]
    hull = TrueHull(stage.cameras, shapes, poses)
    surface = Surface(stage.parts[1].triangles_world)
    in_ball = transform(poses[3], np.zeros((1, 3)))

    alone = hull.distance(surface, within_m=0.3)
    helped = hull.distance(surface, within_m=0.3, witnesses_world=in_ball)

    assert abs(alone.distance_m - helped.distance_m) <= RESOLUTION_M
    assert not alone.collides
