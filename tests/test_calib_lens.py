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
from hybridve.calib.lens import cam_from_img, img_from_cam, project_points, trimmed, undistortion
from hybridve.calib.pose import (
    angle_between,
    compose,
    invert,
    rotation_about_axes,
    transform,
)
from hybridve.calib.rig import Rig
from hybridve.hull.capture.recording import undistort_mask
from hybridve.hull.evaluate import rig_views
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import make_hull

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
def test_a_camera_that_cannot_be_is_refused_by_name(changes: dict[str, object], found: str) -> None:
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
def test_a_trimmed_image_has_no_gaps_and_cannot_grow(model: str) -> None:
    whole = undistortion(make_camera("cam", model, POSE))

    part = trimmed(whole)

    if whole.map_x is None or part.map_x is None or part.map_y is None:
        assert part is whole
        return
    has_gap = whole.map_x == -1
    assert (part.map_x != -1).all()
    assert (part.map_y != -1).all()
    # The same rays in the same pixels, shifted by whole ones.
    shift = whole.img_from_cam[:2, 2] - part.img_from_cam[:2, 2]
    left, top = np.round(shift).astype(int)
    np.testing.assert_allclose(shift, (left, top), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(part.img_from_cam[:, :2], whole.img_from_cam[:, :2])
    bottom, right = top + part.height_px, left + part.width_px
    np.testing.assert_array_equal(part.map_x, whole.map_x[top:bottom, left:right])
    # A row or column more on any side would have a gap, or is not there.
    padded = np.pad(has_gap, 1, constant_values=True)
    for more in (
        padded[top, left + 1 : right + 1],
        padded[bottom + 1, left + 1 : right + 1],
        padded[top + 1 : bottom + 1, left],
        padded[top + 1 : bottom + 1, right + 1],
    ):
        assert more.any()
    # It holds the middle of the lens and most of what the camera sees.
    assert part.map_x.size > 0.5 * (~has_gap).sum()


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
    rays = np.linalg.solve(
        whole.img_from_cam, np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    ).T
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
