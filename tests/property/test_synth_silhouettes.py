"""True silhouettes against closed forms that know nothing of rays and pixels."""

from functools import cache

import cv2
import numpy as np
import pytest
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridve.calib.lens import project_points
from hybridve.calib.pose import Pose, rotation_about_axes, transform
from hybridve.hull.synth.presets import PRESETS
from hybridve.hull.synth.render import View, make_view, true_silhouette
from hybridve.hull.synth.shapes import Ball, Box, Capsule, Cylinder, Shape

#: A pixel belongs to a silhouette if its centre does, so its border is known to half a pixel, or
#: 0.71 px across the corner; the polygon through projected points falls short by less than 0.1 px.
BORDER_PX = 0.85

places = st.tuples(st.floats(-0.4, 1.1), st.floats(-0.5, 0.9), st.floats(0.1, 1.2))
sizes = st.floats(0.02, 0.15)
angles_deg = st.floats(-180.0, 180.0)


@cache
def view(camera: int) -> View:
    return make_view(PRESETS["boxes"].make_stage().cameras[camera])


@settings(max_examples=asked(40))
@given(camera=st.integers(0, 3), place=places, radius_m=sizes)
def test_silhouette_of_a_ball_is_its_tangent_cone(
    camera: int, place: tuple[float, float, float], radius_m: float
) -> None:
    seen_from = view(camera)
    center = np.array(place)
    # The cone from the camera touches the ball along a circle.
    toward = center - seen_from.camera.center_world
    distance_m = np.linalg.norm(toward)
    toward = toward / distance_m
    sine = radius_m / distance_m
    across = np.linalg.svd(toward[None])[2][1:]  # two directions across the axis
    turn = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    circle = np.column_stack([np.cos(turn), np.sin(turn)]) @ across
    rim = center - sine * radius_m * toward + np.sqrt(1 - sine**2) * radius_m * circle
    outline, _ = project_points(seen_from.camera, rim)

    pose = np.column_stack([np.eye(3), center])
    silhouette = true_silhouette(seen_from, [Ball(radius_m)], [pose])

    height, width = silhouette.shape
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    border = outline.astype(np.float32)[:, None]
    low = np.floor(outline.min(axis=0) - 3).astype(int)
    high = np.ceil(outline.max(axis=0) + 3).astype(int)
    near = (columns > low[0]) & (columns < high[0]) & (rows > low[1]) & (rows < high[1])
    assert not silhouette[~near].any()
    tried = np.argwhere(near)[::7]  # every seventh pixel, a different set in each row
    for row, column in tried:
        inside_px = cv2.pointPolygonTest(border, (column + 0.5, row + 0.5), True)
        if abs(inside_px) > 0.1:  # the polygon itself is that good
            assert bool(silhouette[row, column]) == (inside_px > 0)


@settings(max_examples=asked(40))
@given(
    camera=st.integers(0, 3),
    place=places,
    rotate_deg=st.tuples(angles_deg, angles_deg, angles_deg),
    shape=st.one_of(
        st.builds(Capsule, sizes, sizes),
        st.builds(Cylinder, sizes, sizes),
        st.builds(Box, sizes, sizes, sizes),
    ),
)
def test_points_of_a_shape_project_into_its_silhouette_and_fill_it(
    camera: int,
    place: tuple[float, float, float],
    rotate_deg: tuple[float, float, float],
    shape: Shape,
) -> None:
    seen_from = view(camera)
    pose: Pose = np.column_stack([rotation_about_axes(rotate_deg), np.array(place)])
    outline = shape.outline()
    rng = np.random.default_rng(0)
    weights = rng.dirichlet(np.full(2, 0.3), 4000)
    pairs = rng.integers(0, len(outline), (4000, 2))
    inside = (outline[pairs] * weights[:, :, None]).sum(axis=1)  # a convex shape holds its chords
    pixels, _ = project_points(seen_from.camera, transform(pose, inside))
    pixels = pixels[((pixels >= 0) & (pixels < silhouette_size(camera))).all(axis=1)]

    silhouette = true_silhouette(seen_from, [shape], [pose])

    columns, rows = np.floor(pixels).astype(int).T
    to_shape_px = cv2.distanceTransform(1 - silhouette, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    assert len(pixels) == 0 or to_shape_px[rows, columns].max() <= 1.0 + BORDER_PX
    hull = cv2.convexHull(project_points(seen_from.camera, transform(pose, outline))[0].astype("f"))
    if (hull[:, 0] > 3).all() and (hull[:, 0] < silhouette_size(camera) - 3).all():
        # Lens distortion bends straight edges, by less than a pixel over so short a way.
        perimeter_px = cv2.arcLength(hull, True)
        assert silhouette.sum() == pytest.approx(
            cv2.contourArea(hull), abs=BORDER_PX * perimeter_px
        )


def silhouette_size(camera: int) -> np.ndarray:
    return np.array([view(camera).camera.width_px, view(camera).camera.height_px])


@given(camera=st.integers(0, 3))
def test_nothing_is_seen_behind_the_camera(camera: int) -> None:
    from_cam = view(camera).camera
    behind = from_cam.center_world - 0.5 * from_cam.cam_from_world[2, :3]

    silhouette = true_silhouette(view(camera), [Ball(0.1)], [np.column_stack([np.eye(3), behind])])

    assert not silhouette.any()


def test_of_two_shapes_the_nearer_one_is_seen() -> None:
    from_cam = view(0).camera
    near, far = (from_cam.center_world + d * from_cam.cam_from_world[2, :3] for d in (1.0, 2.0))
    poses = [np.column_stack([np.eye(3), place]) for place in (far, near)]

    silhouette = true_silhouette(view(0), [Ball(0.1), Ball(0.02)], poses)

    counts = np.bincount(silhouette.ravel(), minlength=3)
    assert counts[1] > 0
    assert counts[2] > 0
    alone = true_silhouette(view(0), [Ball(0.02)], poses[1:])
    np.testing.assert_array_equal(silhouette == 2, alone == 1)
