"""What a rig on disk must keep, for every rig."""

import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
from helpers.boards import LENSES
from helpers.hulls import look_at, projection
from helpers.thorough import asked
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.camera import N_PARAMS, Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats.rig_export import FORMATS, UNITS_M, export_rig
from hybridve.calib.formats.rig_json import read_rig, rig_to_dict, write_rig
from hybridve.calib.formats.rigs import import_rig, read_any_rig
from hybridve.calib.lens import img_from_cam, project_points
from hybridve.calib.pose import compose, rotation_about_axes, rotation_vector
from hybridve.calib.provenance import MadeElsewhere
from hybridve.calib.rig import Mount, Rig, RigCovariance

#: Text with 17 digits gives a projection back to this, in pixels.
EXACT_PX = 1e-9

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


#: Models whose first parameter is the focal length of both axes.
ONE_FOCAL_LENGTH = {name for name in N_PARAMS if name.startswith("SIMPLE_")} | {
    "RADIAL",
    "RADIAL_FISHEYE",
}


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    model = draw(st.sampled_from(sorted(N_PARAMS)))
    numbers = st.floats(-1e6, 1e6, allow_subnormal=True)
    params = np.array(draw(st.lists(numbers, min_size=N_PARAMS[model], max_size=N_PARAMS[model])))
    params[: 1 if model in ONE_FOCAL_LENGTH else 2] = draw(st.floats(1e-6, 1e6))
    name = draw(st.text(min_size=1).filter(lambda text: text.isprintable()))
    size = st.integers(1, 100_000)
    return Camera(name, model, draw(size), draw(size), params, draw(poses))


def img_from_world(camera: Camera) -> NDArray[np.float64]:
    return np.asarray(camera.pinhole @ camera.cam_from_world)


@pytest.mark.slow
@given(
    camera=pinholes(),
    log_factor=st.floats(-8.0, 8.0),
    sign=st.sampled_from([-1.0, 1.0]),
    points_cam=st.lists(
        st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.5, 50)), min_size=1, max_size=5
    ),
)
@settings(max_examples=asked(150))
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


@given(
    parts=st.lists(
        st.tuples(
            st.floats(-180.0, 180.0),  # where on the ring, degrees
            st.floats(-0.2, 0.8),  # how high, in ring radii
            st.booleans(),  # whether the picture is mirrored
            st.sampled_from([1.0, -1.0, 1e-3, -2e4]),  # factor of a matrix that is not
            st.booleans(),  # whether the picture is upside down
        ),
        min_size=3,
        max_size=6,
    )
)
@settings(max_examples=asked(150))
def test_mirrored_pictures_are_refused_and_reversed_signs_are_not(
    parts: list[tuple[float, float, bool, float, bool]],
) -> None:
    angles = np.deg2rad([part[0] for part in parts])
    turn = np.abs(np.exp(2j * angles).mean())
    assume(turn < 0.9)  # else the axes are nearly parallel, and nothing is told
    rows, guilty = [], []
    for number, (_, height, is_mirrored, factor, is_upside_down) in enumerate(parts):
        angle = angles[number]
        center = 2.0 * np.array([np.cos(angle), np.sin(angle), height])
        pose = look_at(center, np.zeros(3), np.pi if is_upside_down else 0.0)
        matrix = projection(pose, 600.0, 640, 480)
        if is_mirrored:
            matrix = np.array([[-1.0, 0, 640], [0, 1, 0], [0, 0, 1]]) @ matrix
            guilty.append(f"'cam{number}'")
        else:
            matrix = factor * matrix
        rows.append(f"cam{number} " + " ".join(repr(float(v)) for v in matrix.ravel()))
    sizes = {f"cam{number}": (640, 480) for number in range(len(parts))}

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "rig.txt").write_text("\n".join(rows))
        if guilty:
            with pytest.raises(CalibrationError) as error:
                import_rig(Path(folder), "rig.txt", "m", 0.5, sizes, None)
            assert f"{', '.join(guilty)}: the matrix has a negative" in str(error.value)
        else:
            taken = import_rig(Path(folder), "rig.txt", "m", 0.5, sizes, None)
            for camera in taken.cameras:
                assert project_points(camera, np.zeros((1, 3)))[1] > 0


@given(camera=cameras(), note=st.text(), number=st.floats(allow_nan=False, allow_infinity=False))
def test_a_rig_is_read_back_to_the_bit(camera: Camera, note: str, number: float) -> None:
    rig = Rig(
        (camera,), MadeElsewhere({"note": note, "number": number, "list": [None, True, {"a": 1}]})
    )

    with tempfile.TemporaryDirectory() as folder:
        write_rig(Path(folder) / "rig.json", rig)
        again = read_rig(Path(folder) / "rig.json")

    assert json.dumps(rig_to_dict(again)) == json.dumps(rig_to_dict(rig))
    np.testing.assert_array_equal(again.cameras[0].params, camera.params)
    np.testing.assert_array_equal(again.cameras[0].cam_from_world, camera.cam_from_world)


# --- Other programs' files ---------------------------------------------------------------------

#: Which lens models each format gives back exactly.
POLYNOMIAL = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
FISHEYE = (
    *("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"),
    "OPENCV_FISHEYE",
)
HELD = {
    "json": tuple(LENSES),
    "colmap": tuple(LENSES),
    "opencv": (*POLYNOMIAL, *FISHEYE, "FULL_OPENCV"),
    "csv": ("SIMPLE_PINHOLE", "PINHOLE"),
    "caliscope": (*POLYNOMIAL, *FISHEYE),
    "aniposelib": (*POLYNOMIAL, *FISHEYE),
    "kalibr": (*POLYNOMIAL, *FISHEYE, "EUCM", "FOV"),
    "multical": (*POLYNOMIAL, *FISHEYE, "FULL_OPENCV"),
}

#: Formats that are in metres whatever is asked for.
METRIC = {"json", "caliscope", "kalibr"}

near_m = st.floats(-5.0, 5.0)
near_poses = st.tuples(rotations, st.tuples(near_m, near_m, near_m)).map(np.column_stack)


@st.composite
def seeing_cameras(draw: st.DrawFn, models: tuple[str, ...]) -> Rig:
    """Return a rig of cameras with lenses near plausible ones, anywhere, under any names."""
    names = draw(
        st.lists(
            st.from_regex(r"[A-Za-zäß]\w{0,5}", fullmatch=True),
            min_size=1,
            max_size=3,
            unique_by=str.lower,
        )
    )
    cameras = []
    for name in names:
        model = draw(st.sampled_from(models))
        params = np.array(LENSES[model])
        factors = st.lists(st.floats(0.8, 1.2), min_size=len(params), max_size=len(params))
        params *= draw(factors)
        cameras.append(Camera(name, model, 640, 480, params, draw(near_poses)))
    return Rig(tuple(cameras))


@pytest.mark.parametrize("to", FORMATS)
@given(data=st.data())
@settings(max_examples=asked(20))
def test_every_format_gives_back_the_images_of_every_lens_that_it_holds(
    to: str, data: st.DataObject
) -> None:
    rig = data.draw(seeing_cameras(HELD[to]))
    unit = "m" if to in METRIC else data.draw(st.sampled_from(sorted(UNITS_M)))
    rays = np.column_stack([np.random.default_rng(1).uniform(-0.4, 0.4, (10, 2)), np.ones(10)])

    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / ("{camera}.json" if to == "opencv" else "rig")
        written = export_rig(rig, to, target, unit=unit)
        size_px = (640, 480) if to == "csv" else None
        names = [camera.name for camera in rig.cameras]
        again = read_any_rig(target, unit=unit, image_sizes=size_px, names=names)
        assert all(path.is_file() for path in written.files)
        assert not list(Path(folder).rglob("*.partial"))

    # Kalibr has no world: the first camera's frame is in its place.
    world = rig.cameras[0].cam_from_world if to == "kalibr" else np.eye(3, 4)
    for camera, taken in zip(rig.cameras, again.cameras, strict=True):
        assert (taken.name, taken.width_px, taken.height_px) == (camera.name, 640, 480)
        np.testing.assert_allclose(
            img_from_cam(taken, rays), img_from_cam(camera, rays), atol=EXACT_PX
        )
        np.testing.assert_allclose(
            compose(taken.cam_from_world, world), camera.cam_from_world, atol=1e-11
        )


@given(
    axis=st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda axis: np.linalg.norm(axis) > 0.1),
    angle=st.one_of(
        st.floats(0.0, np.pi),
        st.floats(-12.0, 0.0).map(lambda power: 10.0**power),
        st.floats(-12.0, 0.0).map(lambda power: np.pi - 10.0**power),
    ),
)
def test_a_rotation_vector_turns_as_the_rotation_does_at_every_angle(
    axis: tuple[float, float, float], angle: float
) -> None:
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # 1 - cos without its cancellation.
    rotation = np.eye(3) + np.sin(angle) * cross + 2.0 * np.sin(angle / 2.0) ** 2 * cross @ cross

    found = rotation_vector(rotation)

    expected = angle * np.array([x, y, z])
    if np.pi - angle < 1e-9:  # a half turn is the same either way round
        expected *= np.sign(found @ expected)
    np.testing.assert_allclose(found, expected, atol=1e-14 + 1e-12 * angle)


@given(data=st.data(), n_cameras=st.integers(1, 4))
@settings(max_examples=asked(40))
def test_cameras_are_taken_from_a_rig_with_their_share_of_the_covariance(
    data: st.DataObject, n_cameras: int
) -> None:
    models = data.draw(
        st.lists(st.sampled_from(list(LENSES)), min_size=n_cameras, max_size=n_cameras)
    )
    cameras = tuple(
        Camera(f"cam {number}", model, 640, 480, np.array(LENSES[model]), np.eye(3, 4))
        for number, model in enumerate(models)
    )
    labels = tuple(f"{c.name} {p}" for c in cameras for p in range(6 + len(c.params)))
    root = np.random.default_rng(n_cameras).normal(size=(len(labels), len(labels)))
    mounts = {camera.name: Mount(np.eye(3, 4), np.eye(3, 4)) for camera in cameras[::2]}
    rig = Rig(cameras, MadeElsewhere(), RigCovariance(labels, root @ root.T), mounts)
    names = data.draw(st.permutations([c.name for c in cameras]))
    names = names[: data.draw(st.integers(1, n_cameras))]

    with tempfile.TemporaryDirectory() as folder:
        write_rig(Path(folder) / "rig.json", rig)
        taken = read_any_rig(Path(folder) / "rig.json", names=names)
        sizes = dict.fromkeys(names, (640, 480))
        imported = import_rig(Path(folder), "rig.json", None, None, sizes, None)

    assert rig_to_dict(taken) == rig_to_dict(imported) == rig_to_dict(rig.only(names))
    assert taken.covariance is not None
    assert rig.covariance is not None
    value_of = {
        (a, b): rig.covariance.matrix[i, j]
        for i, a in enumerate(labels)
        for j, b in enumerate(labels)
    }
    owners = [label.rpartition(" ")[0] for label in taken.covariance.labels]
    assert list(dict.fromkeys(owners)) == list(names)
    for i, a in enumerate(taken.covariance.labels):
        for j, b in enumerate(taken.covariance.labels):
            assert taken.covariance.matrix[i, j] == value_of[a, b]
    assert set(taken.mounts) == set(mounts) & set(names)
