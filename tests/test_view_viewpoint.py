"""From where a picture is seen, what it must hold, and what is written into it."""

import numpy as np
import pytest
from helpers.hulls import ball_hull, look_at, ring_views
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.rig import Rig
from hybridve.hull.query.silhouettes import Views, make_hull
from hybridve.hull.view.cells import hull_cells
from hybridve.hull.view.drawn import DrawnObject, thinned
from hybridve.hull.view.labels import Labels, fitted, text_size
from hybridve.hull.view.paint import camera_corners, camera_length_m, floor_under, round_length
from hybridve.hull.view.viewpoint import (
    Focus,
    choose_viewpoint,
    fitting_eye,
    orbited,
    overview,
    up_axis,
    zoomed,
)

ASPECT = 1.6


def rig_of(views: Views, turn: NDArray[np.float64] | None = None) -> Rig:
    """Return the cameras of `ring_views` as a rig, in a world turned by `turn`."""
    turn = np.eye(3) if turn is None else turn
    cameras = []
    for name, img_from_local in zip(views.names, views.img_from_local, strict=True):
        center = views.origin_world - np.linalg.solve(img_from_local[:, :3], img_from_local[:, 3])
        pose = look_at(center, np.zeros(3))
        pose[:, :3] = pose[:, :3] @ turn.T
        lens = np.array([700.0, 700.0, 360.0, 243.0])
        cameras.append(Camera(name, "PINHOLE", 720, 486, lens, pose))
    return Rig(tuple(cameras))


def plate(center: tuple[float, float, float], edges: tuple[float, float, float]) -> DrawnObject:
    """Return a free box."""
    corners = np.array([[i >> axis & 1 for axis in range(3)] for i in range(8)], np.float64) - 0.5
    quads = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
    faces = [[q[0], q[1], q[2]] for q in quads] + [[q[0], q[2], q[3]] for q in quads]
    return DrawnObject(
        "plate",
        corners * edges + np.array(center),
        np.array(faces, np.int32),
        False,
        np.zeros(0, np.uint32),
        np.zeros((0, 3), np.float32),
    )


def test_the_eye_is_as_near_as_all_points_allow() -> None:
    """No point lies beyond a border, and no eye nearer along the view would do."""
    rng = np.random.default_rng(0)
    half = np.array([0.5, 0.3])
    for _ in range(50):
        axes = tuple(np.linalg.qr(rng.normal(size=(3, 3)))[0])
        points = rng.normal(size=(40, 3)) * rng.uniform(0.1, 5.0, 3) + rng.normal(size=3) * 10

        eye = fitting_eye(points, (axes[0], axes[1], axes[2]), half)

        view = (points - eye) @ np.stack(axes).T
        places = view[:, :2] / view[:, 2:] / half
        assert (view[:, 2] > 0).all()
        assert np.abs(places).max() == pytest.approx(1.0, abs=1e-9)
        # Both borders of one direction are touched: moving nearer would push one of them out.
        touched = (np.abs(places.min(axis=0) + 1) < 1e-9) & (np.abs(places.max(axis=0) - 1) < 1e-9)
        assert touched.any()


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_up_is_where_the_upper_edges_of_the_images_are(axis: int, sign: float) -> None:
    up = np.zeros(3)
    up[axis] = sign
    turn = np.linalg.qr(np.column_stack([up, np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]]))
    turn_from_z = np.stack([turn[0][:, 1], turn[0][:, 2], up], axis=1)
    turn_from_z[:, 0] *= np.sign(np.linalg.det(turn_from_z))

    rig = rig_of(ring_views(6), turn_from_z)

    np.testing.assert_array_equal(up_axis(rig), up)


def test_cameras_looking_straight_down_leave_z_up() -> None:
    poses = [look_at(np.array([x, 0.0, 3.0]), np.array([x, 0.0, 0.0])) for x in (0.0, 1.0)]
    lens = np.array([700.0, 700.0, 360.0, 243.0])
    cameras = [Camera(str(k), "PINHOLE", 720, 486, lens, pose) for k, pose in enumerate(poses)]

    np.testing.assert_array_equal(up_axis(Rig(tuple(cameras))), [0.0, 0.0, 1.0])


@pytest.mark.slow
def test_cameras_are_in_the_picture_where_they_stand_near() -> None:
    """A ring close around a large ball fits; one far around a small ball would make it a dot."""
    near = ring_views(6, focal_px=300.0, distance_m=1.4)
    far = ring_views(6, distance_m=6.0)
    for views, radius_m, seen in ((near, 0.75, True), (far, 0.1, False)):
        rig = rig_of(views)
        viewpoint = choose_viewpoint(ball_hull(views, np.zeros(3), radius_m), rig, [])
        view = viewpoint.novel_view(ASPECT, (1e-3, 100.0))

        places, _ = view.pixels(rig.centers_world, (1, 1))

        inside = (~np.isnan(places)).all() and ((places > 0) & (places < 1)).all()
        assert bool(inside) == seen


def test_a_huge_object_does_not_make_the_hull_a_dot() -> None:
    views = ring_views(6)
    hall = plate((0.0, 0.0, -0.5), (200.0, 200.0, 0.1))

    viewpoint = choose_viewpoint(ball_hull(views, np.zeros(3), 0.4), rig_of(views), [hall])

    assert np.linalg.norm(viewpoint.eye_world) < 10.0


@pytest.mark.slow
def test_the_chosen_view_is_the_same_every_time() -> None:
    views = ring_views(5)
    hull, rig = ball_hull(views, np.zeros(3), 0.4), rig_of(views)
    objects = [plate((0.6, 0.1, 0.0), (0.2, 0.4, 0.3))]

    first, second = (choose_viewpoint(hull, rig, objects) for _ in range(2))

    np.testing.assert_array_equal(first.eye_world, second.eye_world)
    np.testing.assert_array_equal(first.target_world, second.target_world)


def test_without_hull_and_objects_one_looks_at_the_cameras() -> None:
    views = ring_views(4)
    rig = rig_of(views)
    nothing = make_hull(views, [np.zeros((486, 720), np.uint8)] * 4)

    viewpoint = choose_viewpoint(nothing, rig, [])

    assert len(hull_cells(nothing)) == 0
    view = viewpoint.novel_view(ASPECT, (1e-3, 100.0))
    places, _ = view.pixels(rig.centers_world, (1, 1))
    assert ((places > 0) & (places < 1)).all()


def test_the_overview_holds_every_point_and_is_on_the_same_side() -> None:
    views = ring_views(6)
    rig = rig_of(views)
    viewpoint = choose_viewpoint(ball_hull(views, np.zeros(3), 0.2), rig, [])

    wide = overview(rig.centers_world, viewpoint, ASPECT)

    places, _ = wide.novel_view(ASPECT, (1e-3, 100.0)).pixels(rig.centers_world, (1, 1))
    assert ((places > 0) & (places < 1)).all()
    before, after = (v.target_world - v.eye_world for v in (viewpoint, wide))
    assert before[:2] @ after[:2] > 0.999 * np.linalg.norm(before[:2]) * np.linalg.norm(after[:2])
    assert after[2] < 0


def test_the_floor_is_at_the_worlds_origin_or_under_the_scene() -> None:
    scene = np.array([[0.0, 0.0, 0.1], [1.0, 1.0, 1.9]])
    up = np.array([0.0, 0.0, 1.0])

    assert floor_under(scene, up).height_m == 0.0
    assert floor_under(scene + np.array([0, 0, 8.0]), up).height_m == pytest.approx(8.1)
    assert floor_under(scene - np.array([0, 0, 5.0]), up).height_m == pytest.approx(-4.9)
    # Where up is -Y the height counts along -Y, and the grid's corners lie in the plane.
    turned = floor_under(scene[:, [0, 2, 1]] + np.array([0, 8.0, 0]), np.array([0.0, -1.0, 0.0]))
    assert turned.height_m == pytest.approx(-9.9)
    np.testing.assert_allclose(turned.points_world(np.zeros((1, 2)))[0], [0.0, 9.9, 0.0])


def test_grid_lines_are_a_round_length_apart() -> None:
    for length_m in np.geomspace(1e-3, 1e3, 200):
        rounded = round_length(float(length_m))
        assert rounded <= length_m * (1 + 1e-6) < 2.51 * rounded
        assert float(f"{rounded:.0e}") == pytest.approx(rounded, rel=1e-12)
        assert f"{rounded:.0e}"[0] in "125"


def test_a_camera_is_drawn_as_what_it_sees() -> None:
    """The corners of its image project onto the corners of the image."""
    rig = rig_of(ring_views(3))
    length_m = camera_length_m(rig, np.zeros(3))
    for camera in rig.cameras:
        corners = camera_corners(camera, length_m)
        in_cam = corners @ camera.cam_from_world[:, :3].T + camera.cam_from_world[:, 3]
        pixels = in_cam @ camera.pinhole.T

        pixels = pixels[:, :2] / pixels[:, 2:]
        np.testing.assert_allclose(pixels, [[0, 0], [720, 0], [720, 486], [0, 486]], atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(corners - camera.center_world, axis=1), length_m)


def test_labels_stay_in_the_picture_and_clear_of_each_other() -> None:
    rng = np.random.default_rng(0)
    image = np.full((400, 640, 3), 255, np.uint8)
    labels = Labels(image, 0.6)
    for number in range(40):
        labels.add(f"camera {number}", rng.uniform(0, 1, 2) * (640, 400))

    assert len(labels.taken) > 15
    for number, (left, top, right, bottom) in enumerate(labels.taken):
        assert left >= 0
        assert top >= 0
        assert right <= 640
        assert bottom <= 400
        for other in labels.taken[:number]:
            apart_x = right <= other[0] or other[2] <= left
            apart_y = bottom <= other[1] or other[3] <= top
            assert apart_x or apart_y


def test_a_long_text_is_cut_to_its_room() -> None:
    text = "a recording with a name that goes on and on"

    assert fitted(text, 1.0, 10_000) == text
    short = fitted(text, 1.0, 200)
    assert short.endswith("...")
    assert text.startswith(short[:-3])
    assert text_size(short, 1.0)[0] <= 200


def test_dots_are_thinned_to_one_a_cell() -> None:
    points = np.array([[0.1, 0.1], [0.2, 0.3], [1.5, 0.1], [1.6, 0.2], [-0.1, 0.1]])

    np.testing.assert_array_equal(thinned(points, 1.0), [0, 2, 4])
    assert len(thinned(np.zeros((0, 2)), 1.0)) == 0


@pytest.mark.slow
def test_in_focus_a_small_part_fills_the_picture() -> None:
    """Beside a ball ten times as large, which would make it a dot."""
    views = ring_views(4)
    hull, rig = ball_hull(views, np.zeros(3), 0.4), rig_of(views)
    part = plate((0.8, 0.0, 0.0), (0.04, 0.04, 0.04))

    whole = choose_viewpoint(hull, rig, [part], aspect=ASPECT)
    focus = Focus(part.vertices_world, ("plate",))
    near = choose_viewpoint(hull, rig, [part], aspect=ASPECT, focus=focus)

    extents = []
    for viewpoint in (whole, near):
        view = viewpoint.novel_view(ASPECT, (0.01, 100.0))
        extents.append(np.ptp(view.pixels(part.vertices_world, (1600, 1000))[0], axis=0).max())
    assert extents[0] < 100
    assert extents[1] > 500


def test_zoomed_in_a_length_is_so_many_times_as_long_and_its_point_in_the_middle() -> None:
    views = ring_views(4)
    viewpoint = choose_viewpoint(ball_hull(views, np.zeros(3), 0.4), rig_of(views), [])
    point = viewpoint.target_world + 0.02 * np.array([0.0, 0.0, 1.0])

    near = zoomed(viewpoint, 5.0, point)

    size_px, tips = (1600, 1000), point + np.array([[0.0, 0.0, -1e-3], [0.0, 0.0, 1e-3]])
    before, after = (
        one.novel_view(ASPECT, (0.01, 100.0)).pixels(tips, size_px)[0] for one in (viewpoint, near)
    )
    np.testing.assert_allclose(after.mean(axis=0), (800, 500), atol=0.01)
    lengths = [float(np.linalg.norm(ends[1] - ends[0])) for ends in (before, after)]
    assert lengths[1] == pytest.approx(5.0 * lengths[0], rel=0.01)


def test_an_orbit_keeps_its_distance_and_its_target() -> None:
    views = ring_views(4)
    viewpoint = choose_viewpoint(ball_hull(views, np.zeros(3), 0.4), rig_of(views), [])

    eyes = np.array([orbited(viewpoint, angle).eye_world for angle in np.linspace(0, 2 * np.pi, 5)])

    away = eyes - viewpoint.target_world
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), np.linalg.norm(away[0]))
    np.testing.assert_allclose(eyes[:, 2], eyes[0, 2], atol=1e-12)
    np.testing.assert_allclose(away[2, :2], -away[0, :2], atol=1e-12)
    np.testing.assert_allclose(eyes[4], eyes[0], atol=1e-12)
