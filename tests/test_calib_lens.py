"""Cameras, lenses and poses: what goes out comes back, and what cannot be is refused."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.boards import HEIGHT_PX, LENSES, WIDTH_PX, look_at, make_camera
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib import lens
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import (
    MAX_HALF_ANGLE_DEG,
    cam_from_img,
    img_from_cam,
    project_points,
    undistortion,
)
from hybridve.calib.pose import (
    angle_between,
    compose,
    invert,
    rotation_about_axes,
    transform,
)
from hybridve.calib.rig import Rig
from hybridve.hull.capture.recording import as_recorded, undistort_mask
from hybridve.hull.chain import moved_views, rig_views
from hybridve.hull.query.bounds import FREE, verdicts
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Views, make_hull

#: A pixel led to a ray and back, in pixels; COLMAP iterates to 1e-10 of a ray.
ROUND_TRIP_PX = 1e-5

#: float32 maps of 700 pixels round to this.
MAP_PX = 1e-3

POSE = look_at((1.2, -0.8, 0.9), (0.0, 0.0, 0.1), 5.0)

angles = st.floats(-180.0, 180.0)
poses = st.tuples(
    st.tuples(angles, angles, angles).map(rotation_about_axes),
    st.lists(st.floats(-10, 10), min_size=3, max_size=3),
).map(lambda parts: np.column_stack(parts))


@given(a_from_b=poses, b_from_c=poses)
def test_inner_names_meet(a_from_b: NDArray[np.float64], b_from_c: NDArray[np.float64]) -> None:
    points_c = np.array([[0.3, -0.2, 1.0], [5.0, 0.0, -2.0]])

    at_once = transform(compose(a_from_b, b_from_c), points_c)
    one_by_one = transform(a_from_b, transform(b_from_c, points_c))

    np.testing.assert_allclose(at_once, one_by_one, atol=1e-9)
    np.testing.assert_allclose(
        transform(invert(b_from_c), transform(b_from_c, points_c)), points_c, atol=1e-9
    )


@given(pose=poses, turn_deg=st.floats(0.0, 180.0))
def test_the_angle_between_poses_is_that_of_the_turn(
    pose: NDArray[np.float64], turn_deg: float
) -> None:
    turn = np.column_stack([rotation_about_axes((0.0, 0.0, turn_deg)), np.zeros(3)])

    assert angle_between(pose, compose(pose, turn)) == pytest.approx(np.deg2rad(turn_deg), abs=1e-7)


@pytest.mark.parametrize("model", LENSES)
def test_a_pixel_leads_to_a_ray_that_leads_back(model: str) -> None:
    camera = make_camera("cam", model, POSE)
    x, y = np.meshgrid(np.linspace(40, WIDTH_PX - 40, 9), np.linspace(40, HEIGHT_PX - 40, 7))
    pixels = np.column_stack([x.ravel(), y.ravel()])

    rays = cam_from_img(camera, pixels)

    # Three times as far along the ray is the same pixel.
    again = img_from_cam(camera, 3.0 * np.column_stack([rays, np.ones(len(rays))]))
    assert np.abs(again - pixels).max() < ROUND_TRIP_PX


@pytest.mark.parametrize("model", LENSES)
def test_the_axis_is_imaged_at_the_principal_point(model: str) -> None:
    camera = make_camera("cam", model, POSE)
    on_axis = camera.center_world + 2.0 * camera.cam_from_world[2, :3]

    pixels, depth_m = project_points(camera, on_axis[None])

    np.testing.assert_allclose(pixels[0], camera.pinhole[:2, 2], atol=1e-9)
    np.testing.assert_allclose(depth_m, [2.0], atol=1e-12)


def test_points_behind_the_camera_have_no_pixel() -> None:
    camera = make_camera("cam", "OPENCV", POSE)
    behind = camera.center_world - camera.cam_from_world[2, :3]

    pixels, depth_m = project_points(camera, np.stack([behind, np.zeros(3)]))

    assert np.isnan(pixels[0]).all()
    assert depth_m[0] == pytest.approx(-1.0)
    assert np.isfinite(pixels[1]).all()


def test_no_points_give_no_pixels() -> None:
    pixels, depth_m = project_points(make_camera("cam", "OPENCV", POSE), np.zeros((0, 3)))

    assert pixels.shape == (0, 2)
    assert depth_m.shape == (0,)


def test_skew_shears_the_image() -> None:
    camera = make_camera("cam", "PINHOLE", POSE)
    skewed = replace(camera, skew_px=30.0)
    ray = np.array([[0.1, 0.2, 1.0]])

    difference = img_from_cam(skewed, ray) - img_from_cam(camera, ray)

    np.testing.assert_allclose(difference, [[30.0 * 0.2, 0.0]], atol=1e-12)
    np.testing.assert_allclose(
        cam_from_img(skewed, img_from_cam(skewed, ray)), ray[:, :2], atol=1e-12
    )


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE", "DIVISION", "SIMPLE_RADIAL"])
def test_the_undistorted_image_holds_the_recorded_one_and_is_a_pinhole(model: str) -> None:
    camera = make_camera("cam", model, POSE)

    pinhole = undistortion(camera)

    assert pinhole.map_x is not None
    assert pinhole.map_y is not None
    # Where a recorded pixel lands in the pinhole image, the map leads back to it.
    pixels = np.array([[60.0, 50.0], [320.0, 240.0], [600.0, 430.0]])
    rays = cam_from_img(camera, pixels)
    landed = np.column_stack([rays, np.ones(3)]) @ pinhole.img_from_cam.T
    columns, rows = np.floor(landed[:, :2]).astype(int).T
    assert ((columns >= 0) & (columns < pinhole.width_px)).all()
    assert ((rows >= 0) & (rows < pinhole.height_px)).all()
    centers = np.column_stack([columns + 0.5, rows + 0.5, np.ones(3)])
    expected = img_from_cam(camera, np.linalg.solve(pinhole.img_from_cam, centers.T).T)
    mapped = np.column_stack([pinhole.map_x[rows, columns], pinhole.map_y[rows, columns]])
    np.testing.assert_allclose(mapped + 0.5, expected, atol=MAP_PX)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_an_undistortion_is_kept_to_the_bit(
    model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = make_camera("cam", model, POSE)
    monkeypatch.setenv("HYBRIDVE_CACHE", "off")
    computed = undistortion(camera)
    monkeypatch.setenv("HYBRIDVE_CACHE", str(tmp_path))
    undistortion(camera)
    (entry,) = (tmp_path / "lenses").iterdir()
    monkeypatch.setattr(lens, "_undistort", None)  # calling it raises TypeError

    kept = undistortion(camera)

    assert (kept.width_px, kept.height_px) == (computed.width_px, computed.height_px)
    for name in ("img_from_cam", "map_x", "map_y"):
        before, after = getattr(computed, name), getattr(kept, name)
        assert (after.dtype, after.shape) == (before.dtype, before.shape)
        assert after.tobytes() == before.tobytes()
    np.savez(entry, img_from_cam=computed.img_from_cam, map_x=np.zeros(3), map_y=np.zeros(3))
    with pytest.raises(TypeError):  # an entry of something else is none
        undistortion(camera)


@pytest.mark.slow
def test_another_lens_is_another_entry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HYBRIDVE_CACHE", str(tmp_path))
    camera = make_camera("cam", "OPENCV", POSE)
    others = [
        replace(camera, width_px=camera.width_px + 1),
        replace(camera, height_px=camera.height_px + 1),
        replace(camera, params=camera.params * (1 + 1e-15)),
        make_camera("cam", "RADIAL", POSE),
    ]
    elsewhere = replace(camera, name="other", cam_from_world=np.eye(3, 4))

    for each in (*others, elsewhere):
        undistortion(each)
    widest = undistortion(camera)
    monkeypatch.setattr(lens, "MAX_HALF_ANGLE_DEG", 20.0)
    narrower = undistortion(camera)

    assert narrower.width_px < widest.width_px
    assert len(list((tmp_path / "lenses").iterdir())) == 1 + len(others) + 1


def test_a_pinhole_needs_no_undistortion() -> None:
    camera = make_camera("cam", "PINHOLE", POSE)

    same = undistortion(camera)

    assert same.map_x is None
    assert (same.width_px, same.height_px) == (WIDTH_PX, HEIGHT_PX)
    np.testing.assert_array_equal(same.img_from_cam, camera.pinhole)


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"model": "GOPRO"}, "unknown camera model 'GOPRO'; one of SIMPLE_PINHOLE"),
        ({"width_px": 0}, "image size 0x480 is not positive"),
        ({"params": np.ones(3)}, r"params has shape \(3,\), expected \(4,\)"),
        ({"params": np.array([1.0, np.nan, 1, 1])}, "of finite numbers"),
        ({"cam_from_world": np.eye(4)}, r"cam_from_world has shape \(4, 4\)"),
        ({"cam_from_world": 2.0 * np.eye(3, 4)}, "not a rotation and a translation"),
        ({"cam_from_world": np.diag([1.0, 1, -1])[:, [0, 1, 2, 2]]}, "not a rotation"),
        ({"model": "OPENCV", "params": np.ones(8), "skew_px": 1.0}, "takes no skew"),
    ],
)
def test_a_camera_that_cannot_be_is_refused_by_name(changes: dict[str, Any], found: str) -> None:
    camera = make_camera("cam7", "PINHOLE", POSE)

    with pytest.raises(CalibrationError, match=rf"'cam7'.*{found}"):
        replace(camera, **changes)


def test_a_cameras_arrays_are_its_own_and_cannot_be_written() -> None:
    params = np.array([500.0, 500.0, 320.0, 240.0])
    camera = Camera("cam", "PINHOLE", 640, 480, params, np.eye(3, 4))

    params[0] = 1.0

    assert camera.params[0] == 500.0
    with pytest.raises(ValueError, match="read-only"):
        camera.params[0] = 1.0


def test_a_rig_has_cameras_with_names_of_their_own() -> None:
    camera = make_camera("cam", "PINHOLE", POSE)

    with pytest.raises(CalibrationError, match="no camera"):
        Rig(())
    with pytest.raises(CalibrationError, match="'cam' stands in the rig 2 times"):
        Rig((camera, camera))
    with pytest.raises(CalibrationError, match="no camera 'other'; it has cam"):
        Rig((camera,))["other"]


@pytest.mark.parametrize("model", sorted(LENSES))
def test_a_pixel_is_called_seen_just_where_the_recording_fills_it(model: str) -> None:
    lens = undistortion(make_camera("cam", model, POSE))

    filled = undistort_mask(np.full((HEIGHT_PX, WIDTH_PX), 255, np.uint8), lens)

    if lens.seen is None:
        assert filled.all()
    else:
        np.testing.assert_array_equal(lens.seen, filled == 255)
        assert not lens.seen.all()


@pytest.mark.parametrize("model", sorted(LENSES))
def test_a_mask_comes_back_from_the_pinhole_image_as_it_was_recorded(model: str) -> None:
    camera = make_camera("cam", model, POSE)
    lens = undistortion(camera)
    rows, columns = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    # Where the border of a pinhole image cuts off what a fisheye saw, it does not come back.
    near = np.hypot(columns - WIDTH_PX / 2, rows - HEIGHT_PX / 2) < 0.45 * HEIGHT_PX
    squares = ((columns // 40 + rows // 40) % 2 == 0) & near

    again = as_recorded(undistort_mask(squares.astype(np.uint8), lens), camera, lens) > 0

    at_edge = np.zeros_like(squares)
    for down, right in ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        at_edge |= squares != np.roll(squares, (down, right), (0, 1))
    np.testing.assert_array_equal(again[~at_edge], squares[~at_edge])


@pytest.mark.parametrize("model", sorted(LENSES))
def test_all_that_was_recorded_is_seen_in_the_pinhole_image(model: str) -> None:
    camera = make_camera("cam", model, POSE)
    lens = undistortion(camera)
    x, y = np.meshgrid(np.arange(1.5, WIDTH_PX - 1), np.arange(1.5, HEIGHT_PX - 1))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    rays = cam_from_img(camera, pixels)
    # What a fisheye sees farther off the axis, and where a polynomial has turned back, is cut off.
    limit = np.tan(np.deg2rad(MAX_HALF_ANGLE_DEG - 1.0))
    kept = np.isfinite(rays).all(axis=1) & (np.abs(rays) < limit).all(axis=1)
    again = img_from_cam(camera, np.column_stack([rays[kept], np.ones(kept.sum())]))
    kept[kept] = np.linalg.norm(again - pixels[kept], axis=1) < ROUND_TRIP_PX
    assert kept.mean() > 0.5

    columns, rows = np.floor(rays[kept] @ lens.img_from_cam[:2, :2].T + lens.img_from_cam[:2, 2]).T

    assert (
        (columns >= 0) & (columns < lens.width_px) & (rows >= 0) & (rows < lens.height_px)
    ).all()
    if lens.seen is not None:
        assert lens.seen[rows.astype(np.int64), columns.astype(np.int64)].all()


def _session(unseen: str, min_cameras: int) -> Any:
    names = [SimpleNamespace(name=name) for name in ("left", "right")]
    return SimpleNamespace(cameras=names, unseen=unseen, min_cameras=min_cameras)


@pytest.mark.parametrize("model", sorted(LENSES))
def test_what_collides_where_cameras_carve_collides_where_they_abstain(model: str) -> None:
    """Both cameras see such a point on an object pixel, so that `min_cameras` = 2 have seen it."""
    rig = Rig(
        (
            make_camera("left", model, POSE),
            make_camera("right", model, look_at((-0.9, -1.1, 0.8), (0.0, 0.0, 0.1), -20.0)),
        )
    )
    rng = np.random.default_rng(sorted(LENSES).index(model))
    points_world = rng.uniform(-1.2, 1.2, (4000, 3))
    corners = points_world[:, None] + 0.004 * rng.normal(size=(4000, 3, 3))
    x, y = np.meshgrid(np.arange(WIDTH_PX), np.arange(HEIGHT_PX))
    disc = ((x - 300) ** 2 + (y - 240) ** 2 < 260**2).astype(np.uint8)  # reaches a border
    full = np.ones_like(disc)
    n_beyond = 0
    for recorded in (full, disc):
        hulls = []
        for session in (_session("carve", 1), _session("keep", 2), _session("keep", 1)):
            views, lenses = rig_views(session, rig)
            hulls.append(make_hull(views, [undistort_mask(recorded, lens) for lens in lenses]))
        carve, both, one = (contains_points(hull, points_world) for hull in hulls)

        np.testing.assert_array_equal(carve, both)
        assert (one | ~both).all()
        assert carve.sum() > 100
        assert (one & ~both).sum() > 100
        for hull in hulls[1:]:
            free = verdicts(hull, corners - hull.views.origin_world) == FREE
            inside = contains_points(hull, corners.mean(axis=1))
            assert not (free & inside).any()
            assert free.any()
        n_beyond += int(_are_beyond_gaps(hulls[1].views, points_world[carve]).sum())
    if make_camera("cam", model, POSE).has_distortion:
        assert n_beyond > 0  # a rectangle without gaps would lose them


def test_views_of_all_frames_share_what_was_recorded() -> None:
    """It is summed up once, however the cameras move."""
    rig = Rig(tuple(make_camera(name, "OPENCV", POSE) for name in ("left", "right")))
    session = _session("keep", 1)
    first, lenses = rig_views(session, rig)
    tracks: Any = SimpleNamespace(at=lambda index: {})  # a rig that moves: views of its own

    later = moved_views(session, rig, tracks, 7, first, lenses)

    assert later is not first
    assert later.seen is first.seen is not None


def _are_beyond_gaps(views: Views, points_world: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which points lie beyond a gap from the middle of some camera's image."""
    beyond = np.zeros(len(points_world), np.bool_)
    for camera, (matrix, size_px) in enumerate(
        zip(views.img_from_local, views.sizes_px, strict=True)
    ):
        integral = views.seen_integral(camera)
        if integral is not None:
            h = (points_world - views.origin_world) @ matrix[:, :3].T + matrix[:, 3]
            pixels = np.floor(h[:, :2] / h[:, 2:]).astype(np.int64)
            x0, y0 = np.minimum(pixels, size_px // 2).T
            x1, y1 = np.maximum(pixels, size_px // 2).T + 1
            n_seen = integral[y1, x1] - integral[y0, x1] - integral[y1, x0] + integral[y0, x0]
            beyond |= n_seen < (x1 - x0) * (y1 - y0)
    return beyond


def test_a_camera_that_abstains_does_not_carve_where_its_lens_shows_nothing() -> None:
    """In the corners of a pinhole image the recorded one has nothing: nobody knows what is there.

    A point there, seen by another camera on an object pixel, is in the hull.
    """
    camera = make_camera("bent", "OPENCV", POSE)
    plain = make_camera("plain", "PINHOLE", look_at((-1.0, 1.5, 1.2), (0.0, 0.0, 0.1), 0.0))
    session: Any = SimpleNamespace(
        cameras=[SimpleNamespace(name="bent"), SimpleNamespace(name="plain")],
        unseen="keep",
        min_cameras=1,
    )
    views, lenses = rig_views(session, Rig((camera, plain)))
    whole = undistortion(camera)
    assert whole.map_x is not None
    rows, columns = np.nonzero(whole.map_x == -1)
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    rays = np.asarray(np.linalg.solve(whole.img_from_cam, pixels).T, np.float64)
    points_world = transform(invert(camera.cam_from_world), 1.5 * rays)
    recorded = np.full((HEIGHT_PX, WIDTH_PX), 255, np.uint8)  # object wherever a camera looks
    masks = [undistort_mask(recorded, lens) for lens in lenses]
    pixels, depth_m = project_points(plain, points_world)
    seen = (
        (depth_m > 0) & (pixels > 1).all(axis=1) & (pixels < (WIDTH_PX - 1, HEIGHT_PX - 1)).all(1)
    )
    assert seen.sum() > 10

    inside = contains_points(make_hull(views, masks), points_world[seen])

    assert inside.all()
