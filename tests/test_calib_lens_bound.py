"""What undistorting a silhouette can change: no more than is promised, and not much less."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from helpers.boards import LENSES, look_at, make_camera
from helpers.sessions import FOCAL_PX, SIZE_PX, write_ball_session, write_cube_scene
from helpers.thorough import asked, some_of
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.camera import PINHOLE_MODELS, Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats.rig_json import read_rig, write_rig
from hybridve.calib.formats.rigs import import_rig
from hybridve.calib.lens import (
    Undistortion,
    cam_from_img,
    img_from_cam,
    project_points,
    undistortion,
)
from hybridve.calib.lens_bound import Interval, distorted, lens_shift_px
from hybridve.calib.rig import Rig
from hybridve.hull.capture.recording import undistort_mask

Array = NDArray[np.float64]
Mask = NDArray[np.uint8]

POSE = look_at((1.2, -0.8, 0.9), (0.0, 0.0, 0.1), 5.0)

BENT = sorted(set(LENSES) - PINHOLE_MODELS)

#: Odd on purpose: boxes of the search that hang over the image's edge.
WIDTH_PX, HEIGHT_PX = 171, 127

#: float32 maps of 700 pixels round to this.
MAP_PX = 1e-4

#: The bound may be too large by two pixels of rim, which matter to an image this small.
TIGHT = 1.15

#: Nearer to a fold than this, by the area of a pixel's image, it is open which side a ray is on.
RIM = 0.05


def n_pixel_params(model: str) -> int:
    """Return how many of a lens's parameters are pixels: focal lengths and the principal point."""
    return 1 + LENSES[model].index(233.0)


def small_camera(
    model: str,
    strength: float,
    zoom: float = 1.0,
    squeeze: float = 1.0,
    middle_px: tuple[float, float] = (0.0, 0.0),
) -> Camera:
    """Return a small camera with the lens of `LENSES`: at `strength` 1, or bent the other way."""
    params = np.array(LENSES[model])
    first = n_pixel_params(model)
    params[:first] *= WIDTH_PX / 640.0
    params[: first - 2] *= zoom
    if first == 4:
        params[1] *= squeeze
    params[first - 2 : first] += middle_px
    if model == "EUCM":  # from a pinhole to a parabola; its other parameter is about 1
        params[-2] = 0.4 * (1.0 + strength / 1.3)
    else:
        params[first:] *= abs(strength) if model == "FOV" else strength
    return Camera("cam", model, WIDTH_PX, HEIGHT_PX, params, POSE)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    """Return a small camera of a plausible lens: barrel or pincushion, its middle anywhere."""
    return small_camera(
        draw(st.sampled_from(BENT)),
        draw(st.floats(-1.2, 1.2)),
        draw(st.floats(0.75, 2.0)),
        draw(st.floats(0.7, 1.4)),
        draw(st.tuples(st.floats(-8, 8), st.floats(-8, 8))),
    )


def rays_of(lens: Undistortion, pixels: Array) -> Array:
    """Return the rays (N, 3), at depth 1, of places (N, 2) in the pinhole image."""
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
    return np.asarray(np.linalg.solve(lens.img_from_cam, homogeneous.T).T)


def recorded_at(camera: Camera, lens: Undistortion, pixels: Array) -> Array:
    """Return d: where in the recorded image places (N, 2) of the pinhole image lie; NaN if not."""
    return img_from_cam(camera, rays_of(lens, pixels))


def turn(camera: Camera, lens: Undistortion, pixels: Array) -> NDArray[np.int64]:
    """Return for places (N, 2) 1 where d keeps the image's sense, -1 folded over, 0 at the rim.

    On the whole way from the middle of the lens, that is: a lens may fold twice.
    """
    middle, step = lens.img_from_cam[:2, 2], 1e-3
    least = np.full(len(pixels), np.inf)
    for share in np.linspace(1.0 / 16.0, 1.0, 16):
        places = middle + share * (pixels - middle)
        right, down = (
            recorded_at(camera, lens, places + move) - recorded_at(camera, lens, places - move)
            for move in (np.array([step, 0.0]), np.array([0.0, step]))
        )
        determinant = (right[:, 0] * down[:, 1] - right[:, 1] * down[:, 0]) / (2 * step) ** 2
        least = np.minimum(least, determinant)
    return (least > RIM).astype(np.int64) - (least < -RIM)


def size_px(camera: Camera) -> NDArray[np.int64]:
    return np.array([camera.width_px, camera.height_px])


def answers(mask: Mask, places: Array) -> NDArray[np.bool_]:
    """Return what a silhouette says at places (N, 2): the floor is the pixel, beyond is nothing."""
    inside = np.asarray(((places >= 0) & (places < mask.shape[::-1])).all(axis=1))
    columns, rows = np.floor(np.where(inside[:, None], places, 0.0)).astype(int).T
    return np.asarray(inside & (mask[rows, columns] != 0))


def alike_within(mask: Mask, places: Array, reach_px: float) -> NDArray[np.bool_]:
    """Tell where all pixels that the square of half side `reach_px` touches have one value."""
    far = max(mask.shape) + 3
    padded = cv2.copyMakeBorder(mask, far, far, far, far, cv2.BORDER_CONSTANT, value=0)
    total = cv2.integral((padded != 0).astype(np.uint8)).astype(np.int64)
    low = np.ceil(places - reach_px).astype(int) - 1 + far  # a touched edge counts
    high = np.floor(places + reach_px).astype(int) + 1 + far
    limits = np.array(padded.shape[::-1])
    (left, top), (right, bottom) = np.clip(low, 0, limits).T, np.clip(high, 0, limits).T
    count = total[bottom, right] - total[top, right] - total[bottom, left] + total[top, left]
    return np.asarray((count == 0) | (count == (right - left) * (bottom - top)))


def blobs(rng: np.random.Generator, grain_px: int, camera: Camera) -> Mask:
    """Return a silhouette of random pieces, some of them cut by the border."""
    coarse = rng.integers(
        0, 2, (camera.height_px // grain_px + 2, camera.width_px // grain_px + 2), np.uint8
    )
    fine = np.kron(coarse, np.ones((grain_px, grain_px), np.uint8))
    top, left = rng.integers(0, grain_px, 2)
    return np.ascontiguousarray(fine[top : top + camera.height_px, left : left + camera.width_px])


def differ_only_within(
    rng: np.random.Generator, camera: Camera, lens: Undistortion, mask: Mask
) -> float:
    """Assert what the bound promises, at random points; returns the share not at a fold's rim."""
    points = points_in_image(rng, lens, 5_000)
    places = recorded_at(camera, lens, points)
    sense = turn(camera, lens, points)
    clear = (sense != 0) & (sense == turn(camera, lens, np.floor(points) + 0.5))
    clear &= np.isfinite(places).all(axis=1)
    points, places, sense = points[clear], places[clear], sense[clear]
    # Farther out there is no pixel either.
    places = np.clip(places, -10.0, size_px(camera) + 10.0)
    exact = answers(mask, places) & (sense > 0)
    safe = alike_within(mask, places, lens_shift_px(camera, lens)) | (sense < 0)
    found = answers(undistort_mask(mask, lens), points)
    np.testing.assert_array_equal(found[safe], exact[safe])
    return float(clear.mean())


def points_in_image(rng: np.random.Generator, lens: Undistortion, count: int) -> Array:
    return rng.uniform(0.0, [lens.width_px, lens.height_px], (count, 2))


@pytest.mark.parametrize("model", BENT)
def test_the_formulas_are_those_that_undistort(model: str) -> None:
    camera = make_camera("cam", model, POSE)
    rng = np.random.default_rng(1)
    reach = 0.9 if model == "SIMPLE_RADIAL" else 1.1
    rays = np.vstack([rng.uniform(-reach, reach, (500, 2)), [[0.0, 0.0], [1e-3, -2e-3]]])
    pinhole, step = camera.pinhole, 1e-5

    x, y = distorted(model, camera.params, *(Interval(part, part) for part in rays.T))

    def place(moved: Array) -> Array:
        pixels = img_from_cam(camera, np.column_stack([moved, np.ones(len(moved))]))
        return np.asarray((pixels - pinhole[:2, 2]) / np.diag(pinhole)[:2])

    for number, jet in enumerate((x, y)):
        for end in (jet.value.low, jet.value.high):
            np.testing.assert_allclose(end, place(rays)[:, number], rtol=0, atol=1e-10)
        for slope, along in ((jet.du, [step, 0.0]), (jet.dv, [0.0, step])):
            measured = (place(rays + along) - place(rays - along))[:, number] / (2 * step)
            np.testing.assert_allclose(slope.low, measured, rtol=0, atol=1e-6)
            np.testing.assert_allclose(slope.high, measured, rtol=0, atol=1e-6)


@pytest.mark.parametrize("omega", [0.0, 0.005, -0.009, 0.011])
def test_a_narrow_field_of_view_is_taken_as_colmap_takes_it(omega: float) -> None:
    camera = Camera("cam", "FOV", 640, 480, np.array([500.0, 500, 320, 240, omega]), POSE)
    rays = np.array([[0.9, 0.0], [0.3, -0.4]])

    x, y = distorted("FOV", camera.params, *(Interval(part, part) for part in rays.T))

    expected = img_from_cam(camera, np.column_stack([rays, np.ones(2)]))
    found = 500.0 * np.column_stack([x.value.low, y.value.low]) + [320.0, 240.0]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@given(camera=cameras(), seed=st.integers(0, 2**32 - 1))
def test_a_box_of_rays_bounds_every_ray_in_it(camera: Camera, seed: int) -> None:
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-0.5, 0.5, (200, 2))
    half = rng.choice([1e-4, 1e-2, 0.2], (200, 1)) * rng.uniform(0.1, 1.0, (200, 2))
    rays = middle + half * rng.uniform(-1.0, 1.0, (200, 2))
    low, high = middle - half, middle + half

    boxes = distorted(
        camera.model,
        camera.params,
        Interval(low[:, 0], high[:, 0]),
        Interval(low[:, 1], high[:, 1]),
    )
    single = distorted(camera.model, camera.params, *(Interval(part, part) for part in rays.T))

    for box, one in zip(boxes, single, strict=True):
        for wide, narrow in (
            (box.value, one.value),
            (box.du, one.du),
            (box.dv, one.dv),
        ):
            assert (wide.low <= narrow.low + 1e-12).all()
            assert (narrow.high <= wide.high + 1e-12).all()


@pytest.mark.slow
@settings(max_examples=asked(40))
@given(camera=cameras(), seed=st.integers(0, 2**32 - 1))
def test_no_point_is_answered_from_farther_than_promised(camera: Camera, seed: int) -> None:
    shift_px, largest_px = bound_and_largest(camera, seed)

    assert largest_px <= shift_px


@pytest.mark.parametrize("squeeze", [0.7, 1.4])
@pytest.mark.parametrize("strength", [-1.2, 1.2])
@pytest.mark.parametrize("model", some_of(BENT))
def test_the_bound_is_near_the_largest_shift_of_every_model(
    model: str, strength: float, squeeze: float
) -> None:
    shift_px, largest_px = bound_and_largest(small_camera(model, strength, 1.0, squeeze), 4)

    assert largest_px <= shift_px <= TIGHT * largest_px


def bound_and_largest(camera: Camera, seed: int) -> tuple[float, float]:
    """Return s, and the largest shift at the corners and a random place of every pixel."""
    lens = undistortion(camera)
    assert lens.map_x is not None
    assert lens.map_y is not None
    assert (lens.map_x >= -0.5).sum() > 1000
    rng = np.random.default_rng(seed)
    rows, columns = np.indices(lens.map_x.shape).reshape(2, -1)
    centers = np.asarray(np.column_stack([columns, rows]) + 0.5, np.float64)
    sourced = lens.map_x[rows, columns] >= -0.5
    taken_from = recorded_at(camera, lens, centers)
    taken_from[sourced] = np.column_stack([lens.map_x.ravel(), lens.map_y.ravel()])[sourced] + 0.5
    corners = [np.array([i, j]) for i in (-0.5, 0.5) for j in (-0.5, 0.5)]
    largest_px = 0.0
    for offset in [*corners, rng.uniform(-0.5, 0.5, centers.shape)]:
        wanted = recorded_at(camera, lens, centers + offset)
        # At the rim a pixel without a source has points that the recorded image shows.
        shown = ~sourced & ((wanted >= 0) & (wanted < size_px(camera))).all(axis=1)
        shown[shown] = turn(camera, lens, (centers + offset)[shown]) > 0
        shown[shown] = turn(camera, lens, centers[shown]) > 0
        counts = sourced | shown
        shift = np.abs(wanted[counts] - taken_from[counts])
        largest_px = max(largest_px, float(shift.max()))
    return lens_shift_px(camera, lens), largest_px


@pytest.mark.slow
@settings(max_examples=asked(40))
@given(camera=cameras(), grain_px=st.sampled_from([1, 2, 5, 30]), seed=st.integers(0, 2**32 - 1))
@example(camera=make_camera("cam", "OPENCV", POSE), grain_px=3, seed=0)
def test_answers_differ_only_near_pixels_of_the_other_value(
    camera: Camera, grain_px: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    lens = undistortion(camera)

    compared = differ_only_within(rng, camera, lens, blobs(rng, grain_px, camera))

    assume(compared > 0.95)  # else it is mostly a fold


@pytest.mark.parametrize("model", ["RADIAL", "OPENCV_FISHEYE", "FULL_OPENCV", "DIVISION"])
def test_nine_tenths_of_the_bound_would_be_too_little(model: str) -> None:
    camera = make_camera("cam", model, POSE, (320, 240))
    rng = np.random.default_rng(2)
    lens = undistortion(camera)
    mask = blobs(rng, 2, camera)
    points = points_in_image(rng, lens, 1_000_000)
    places = recorded_at(camera, lens, points)

    differ = answers(undistort_mask(mask, lens), points) != answers(mask, places)

    assert (differ & alike_within(mask, places, 0.9 * lens_shift_px(camera, lens))).any()


def test_a_lone_pixel_can_vanish_where_the_lens_stretches() -> None:
    params = np.array([150.0, 160.0, 120.0, 0.35])
    camera = Camera("cam", "SIMPLE_RADIAL", 320, 240, params, POSE)
    lens = undistortion(camera)
    assert lens.map_x is not None
    assert lens.map_y is not None
    shift_px = lens_shift_px(camera, lens)
    sampled = np.zeros((240, 320), np.bool_)
    columns, rows = (
        np.rint(part[lens.map_x >= -0.5]).astype(int) for part in (lens.map_x, lens.map_y)
    )
    sampled[rows, columns] = True
    row, column = np.argwhere(~sampled[5:-5, 5:-5])[0] + 5
    lone = np.zeros((240, 320), np.uint8)
    lone[row, column] = 1

    straight = undistort_mask(lone, lens)

    assert shift_px > 0.6
    assert not straight.any()
    # The exact answer is the object, and the bound has said that it may be missed.
    ray = cam_from_img(camera, np.array([[column + 0.5, row + 0.5]]))
    point = (np.column_stack([ray, [1.0]]) @ lens.img_from_cam.T)[:, :2]
    place = recorded_at(camera, lens, point)
    assert answers(lone, place)[0]
    assert not alike_within(lone, place, shift_px)[0]


@pytest.mark.slow
@given(camera=cameras(), seed=st.integers(0, 2**32 - 1))
def test_a_point_has_the_exact_answer_of_one_half_a_pixel_beside_it(
    camera: Camera, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    lens = undistortion(camera)
    mask = blobs(rng, 2, camera)
    pixels = points_in_image(rng, lens, 3000)
    depth_m = rng.uniform(0.5, 8.0, (len(pixels), 1))
    asked_cam = depth_m * rays_of(lens, pixels)

    # The other point lies on the ray of the pixel's centre, at the same depth.
    other_cam = depth_m * rays_of(lens, np.floor(pixels) + 0.5)
    aside_m = np.abs(other_cam - asked_cam)

    focal_px = np.diag(camera.pinhole)[:2]
    assert (aside_m[:, :2] <= depth_m / (2.0 * focal_px) * (1 + 1e-9)).all()
    rotation, translation = camera.cam_from_world[:, :3], camera.cam_from_world[:, 3]
    places, _ = project_points(camera, (other_cam - translation) @ rotation)
    imaged = turn(camera, lens, np.floor(pixels) + 0.5) > 0
    clear = imaged & ~(np.abs(places - np.rint(places)) < MAP_PX).any(axis=1)
    found = answers(undistort_mask(mask, lens), pixels)
    np.testing.assert_array_equal(found[clear], answers(mask, places[clear]))


@pytest.mark.parametrize("model", sorted(PINHOLE_MODELS))
def test_a_camera_without_distortion_shifts_nothing(model: str) -> None:
    camera = make_camera("cam", model, POSE)
    skewed = replace(camera, skew_px=3.0)

    assert lens_shift_px(camera, undistortion(camera)) == 0.0
    assert lens_shift_px(skewed, undistortion(skewed)) == 0.0


@pytest.mark.parametrize("model", BENT)
def test_the_middle_of_a_lens_shifts_by_half_its_magnification(model: str) -> None:
    camera = make_camera("cam", model, POSE)
    params = camera.params.copy()
    params[: n_pixel_params(model) - 2] *= 1000.0  # a tele lens shows the middle alone
    camera = replace(camera, params=params)
    magnification = np.tan(0.35) / 0.35 if model == "FOV" else 1.0  # its omega is 0.7

    found = lens_shift_px(camera, undistortion(camera))

    # The maps round to 640 / 2^24 px.
    assert found == pytest.approx(0.5 * magnification + 640 / 2**24, abs=1e-5)


def test_no_bound_is_named_where_the_formula_has_a_pole() -> None:
    # 1 - 4 k r^2 vanishes at r = 2.24, imaged at 4.47 focal lengths: within this image.
    params = np.array([30.0, 150.0, 150.0, 0.05])
    camera = Camera("cam", "SIMPLE_DIVISION", 300, 300, params, POSE)

    assert lens_shift_px(camera, undistortion(camera)) == np.inf


def test_an_unknown_lens_is_refused_by_name() -> None:
    one = Interval(np.ones(1), np.ones(1))

    with pytest.raises(CalibrationError, match="'GOPRO'"):
        distorted("GOPRO", np.ones(4), one, one)


def test_the_report_says_it_of_every_camera(run: Callable[..., int], tmp_path: Path) -> None:
    session = write_ball_session(tmp_path / "ball", np.zeros((1, 3)))
    scene = write_cube_scene(tmp_path / "scene", {"cube": (0.0, 0.0, 0.0)})
    rig = import_rig(
        session.parent, "rig.csv", "m", 0.5, {f"cam{i}": SIZE_PX for i in range(4)}, None
    )
    bent = replace(
        rig.cameras[1],
        model="SIMPLE_RADIAL",
        params=np.array([FOCAL_PX, SIZE_PX[0] / 2, SIZE_PX[1] / 2, 0.2]),
        skew_px=0.0,
    )
    write_rig(session.parent / "rig.json", Rig((rig.cameras[0], bent, *rig.cameras[2:])))
    text = session.read_text(encoding="utf-8").replace("rig.csv", "rig.json")
    session.write_text(text, encoding="utf-8")

    assert run("detect", session, "--scene", scene, "-o", tmp_path / "report.h5") == 0

    with h5py.File(tmp_path / "report.h5") as file:
        told = json.loads(file["hybridve/settings/rig"].asstr()[()])["cameras"]
    shifts = {entry["name"]: entry["mask_shift_px"] for entry in told}
    assert shifts == {
        "cam0": 0.0,
        "cam1": lens_shift_px(bent, undistortion(bent)),
        "cam2": 0.0,
        "cam3": 0.0,
    }
    assert shifts["cam1"] > 0.5
    (tmp_path / "again.json").write_text(
        json.dumps({"format": "hybridve-rig", "version": 1, "cameras": told}), encoding="utf-8"
    )
    assert read_rig(tmp_path / "again.json")["cam1"].model == "SIMPLE_RADIAL"


@pytest.mark.recording
@pytest.mark.parametrize(
    ("folder", "pattern", "unit", "names", "image_px"),
    [
        (
            "horseman",
            "{camera}/reference_a_squares.xml",
            "squares",
            "cam1 cam2 cam3 cam4",
            (644, 486),
        ),
        ("horseman", "{camera}/reference_b_mm.xml", "mm", "cam1 cam2 cam3 cam4", (644, 486)),
        ("opencv_stereo", "intrinsics.yml", "squares", "left right", (640, 480)),
    ],
)
def test_real_lenses_shift_by_hardly_more_than_half_a_pixel(
    recordings: Path,
    folder: str,
    pattern: str,
    unit: str,
    names: str,
    image_px: tuple[int, int],
) -> None:
    sizes_px = dict.fromkeys(names.split(), image_px)
    rig = import_rig(recordings / folder, pattern, unit, 0.0, sizes_px, 0.115)

    rng = np.random.default_rng(3)
    for camera in rig.cameras:
        lens = undistortion(camera)
        shift_px = lens_shift_px(camera, lens)
        assert 0.5 <= shift_px < 0.7
        assert differ_only_within(rng, camera, lens, blobs(rng, 4, camera)) > 0.98
