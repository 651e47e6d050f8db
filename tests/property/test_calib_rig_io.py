"""What a rig on disk must keep, for every rig."""

import json
import tempfile
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.camera import N_PARAMS, Camera
from hybridve.calib.lens import project_points
from hybridve.calib.pose import rotation_about_axes
from hybridve.calib.rig import Rig
from hybridve.calib.rig_io import import_rig, read_rig, rig_to_dict, write_rig

#: Decomposing and composing a matrix keeps pixels to this, relative to the image.
RELATIVE = 1e-9

angles_deg = st.floats(-180.0, 180.0)
lengths_m = st.floats(-100.0, 100.0)
rotations = st.tuples(angles_deg, angles_deg, angles_deg).map(rotation_about_axes)
poses = st.tuples(rotations, st.tuples(lengths_m, lengths_m, lengths_m)).map(
    lambda parts: np.column_stack(parts)
)


@st.composite
def pinholes(draw: st.DrawFn) -> Camera:
    focal = st.floats(50.0, 20_000.0)
    center = st.floats(-500.0, 5000.0)
    params = np.array([draw(focal), draw(focal), draw(center), draw(center)])
    skew_px = draw(st.one_of(st.just(0.0), st.floats(-20.0, 20.0).filter(lambda v: abs(v) > 1e-6)))
    return Camera("cam", "PINHOLE", 640, 480, params, draw(poses), skew_px)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    model = draw(st.sampled_from(sorted(N_PARAMS)))
    numbers = st.floats(-1e6, 1e6, allow_subnormal=True)
    params = np.array(draw(st.lists(numbers, min_size=N_PARAMS[model], max_size=N_PARAMS[model])))
    name = draw(st.text(min_size=1).filter(lambda text: text.isprintable()))
    size = st.integers(1, 100_000)
    return Camera(name, model, draw(size), draw(size), params, draw(poses))


def img_from_world(camera: Camera) -> NDArray[np.float64]:
    return np.asarray(camera.pinhole @ camera.cam_from_world)


@given(
    camera=pinholes(),
    log_factor=st.floats(-8.0, 8.0),
    sign=st.sampled_from([-1.0, 1.0]),
    points_cam=st.lists(
        st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.5, 50)), min_size=1, max_size=5
    ),
)
@settings(max_examples=150)
def test_a_projection_matrix_is_decomposed_without_loss(
    camera: Camera,
    log_factor: float,
    sign: float,
    points_cam: list[tuple[float, float, float]],
) -> None:
    matrix = sign * 10.0**log_factor * img_from_world(camera)
    row = "cam " + " ".join(repr(float(value)) for value in matrix.ravel())
    rotation, translation = camera.cam_from_world[:, :3], camera.cam_from_world[:, 3]
    points_world = (np.array(points_cam) * [1, 1, 1] - translation) @ rotation

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "rig.txt").write_text(row)
        taken = import_rig(Path(folder), "rig.txt", "m", 0.5, {"cam": (640, 480)}, None)["cam"]

    expected, depth_m = project_points(camera, points_world)
    pixels, depth_taken_m = project_points(taken, points_world)
    reach_px = np.abs(camera.params).max()
    np.testing.assert_allclose(pixels, expected, atol=RELATIVE * reach_px)
    np.testing.assert_allclose(depth_taken_m, depth_m, atol=RELATIVE * 100)
    np.testing.assert_allclose(taken.params, camera.params, rtol=RELATIVE, atol=RELATIVE * reach_px)
    np.testing.assert_allclose(taken.skew_px, camera.skew_px, atol=RELATIVE * reach_px)


@given(camera=cameras(), note=st.text(), number=st.floats(allow_nan=False, allow_infinity=False))
def test_a_rig_is_read_back_to_the_bit(camera: Camera, note: str, number: float) -> None:
    rig = Rig((camera,), {"note": note, "number": number, "list": [None, True, {"a": 1}]})

    with tempfile.TemporaryDirectory() as folder:
        write_rig(Path(folder) / "rig.json", rig)
        again = read_rig(Path(folder) / "rig.json")

    assert json.dumps(rig_to_dict(again)) == json.dumps(rig_to_dict(rig))
    np.testing.assert_array_equal(again.cameras[0].params, camera.params)
    np.testing.assert_array_equal(again.cameras[0].cam_from_world, camera.cam_from_world)
