"""Rigs in the files of other programs: what they mean, what they cannot hold, what is wrong."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.boards import LENSES, look_at, make_camera
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats.rig_export import export_rig
from hybridve.calib.formats.rigs import import_rig, read_any_rig
from hybridve.calib.lens import cam_from_img, img_from_cam, project_points
from hybridve.calib.pose import Pose, compose, invert, rotation_about_axes
from hybridve.calib.provenance import MadeElsewhere
from hybridve.calib.rig import Mount, Rig, RigCovariance

EXACT_PX = 1e-9

#: Rays that every lens of the tests shows.
RAYS = np.column_stack([np.random.default_rng(3).uniform(-0.4, 0.4, (20, 2)), np.ones(20)])

POINTS_WORLD = np.random.default_rng(4).uniform(-0.4, 0.4, (20, 3))

ROTATION = rotation_about_axes((100.0, -20.0, 5.0))


def rig_of(*models: str) -> Rig:
    poses = [look_at((2.0, 0.7 * k, 1.0), (0, 0, 0), 5.0 * k) for k in range(len(models))]
    return Rig(
        tuple(make_camera(f"cam{k + 1}", m, poses[k]) for k, m in enumerate(models)),
        MadeElsewhere({"made": "up"}),
    )


def opencv_pixels(
    matrix: NDArray[np.float64],
    distortion: NDArray[np.float64],
    pose: Pose,
    points: NDArray[np.float64],
    *,
    is_fisheye: bool = False,
) -> NDArray[np.float64]:
    """Return what OpenCV's own projection gives, its pixel centre at 0 moved to ours."""
    rvec = np.asarray(cv2.Rodrigues(pose[:, :3])[0])
    if is_fisheye:
        found, _ = cv2.fisheye.projectPoints(points[:, None], rvec, pose[:, 3], matrix, distortion)
    else:
        found, _ = cv2.projectPoints(points, rvec, pose[:, 3], matrix, distortion)
    return np.asarray(found, np.float64)[:, 0] + 0.5


def assert_images(camera: Camera, expected: NDArray[np.float64]) -> None:
    pixels, depth_m = project_points(camera, POINTS_WORLD)
    assert (depth_m > 0).all()
    np.testing.assert_allclose(pixels, expected, atol=EXACT_PX)


# --- Files as the programs write them ---------------------------------------------------------

MATRIX = np.array([[900.5, 0.0, 639.25], [0.0, 901.5, 358.75], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.21, 0.05, 0.001, -0.0005, 0.01])
FISHEYE = np.array([0.03, -0.01, 0.004, -0.001])
POSE = np.column_stack([ROTATION, [0.1, -0.2, 2.5]])
RVEC = np.asarray(cv2.Rodrigues(ROTATION)[0]).ravel()


def toml_section(
    head: str, distortion: NDArray[np.float64], rotation: object, translation: object, *more: str
) -> str:
    return "\n".join(
        [
            f"[{head}]",
            "size = [ 1280, 720,]",
            f"matrix = {MATRIX.tolist()}",
            f"distortions = {distortion.tolist()}",
            f"rotation = {rotation}",
            f"translation = {translation}",
            *more,
            "",
        ]
    )


def test_aniposelib_is_taken_with_the_unit_that_is_named(tmp_path: Path) -> None:
    translation_mm = (1000.0 * POSE[:, 3]).tolist()
    (tmp_path / "calibration.toml").write_text(
        toml_section("cam_0", DISTORTION, RVEC.tolist(), translation_mm, 'name = "left"')
        + toml_section(
            "cam_1", FISHEYE, RVEC.tolist(), translation_mm, 'name = "right"', "fisheye = true"
        )
        + "[metadata]\nadjusted = false\nerror = 0.3\n"
    )

    rig = read_any_rig(tmp_path / "calibration.toml", unit="mm")

    assert [camera.name for camera in rig.cameras] == ["left", "right"]
    assert (rig["left"].width_px, rig["left"].height_px) == (1280, 720)
    assert rig.provenance.format == "aniposelib"
    assert_images(rig["left"], opencv_pixels(MATRIX, DISTORTION, POSE, POINTS_WORLD))
    assert_images(rig["right"], opencv_pixels(MATRIX, FISHEYE, POSE, POINTS_WORLD, is_fisheye=True))


@pytest.mark.parametrize("rotation", [RVEC.tolist(), ROTATION.tolist()])
@pytest.mark.parametrize("head", ["cameras.3", "cam_3"])
def test_caliscope_is_taken_in_metres(tmp_path: Path, head: str, rotation: object) -> None:
    number = "cam_id = 3" if head == "cameras.3" else "port = 3"
    path = tmp_path / "camera_array.toml"
    path.write_text(
        toml_section(head, DISTORTION, rotation, POSE[:, 3].tolist(), number, "ignore = false")
    )

    rig = read_any_rig(path)
    # A session may call it as the videos are called.
    taken = import_rig(tmp_path, path.name, None, None, {"cam3": (1280, 720)}, None)

    expected = opencv_pixels(MATRIX, DISTORTION, POSE, POINTS_WORLD)
    assert [camera.name for camera in rig.cameras] == ["cam_3"]
    assert_images(rig["cam_3"], expected)
    assert_images(taken["cam3"], expected)


def test_a_camera_without_a_pose_is_named(tmp_path: Path) -> None:
    path = tmp_path / "camera_array.toml"
    path.write_text(
        toml_section("cameras.0", DISTORTION, RVEC.tolist(), [0, 0, 1])
        + "[cameras.1]\nsize = [4, 3]\n"
    )

    with pytest.raises(CalibrationError, match="'cam_1' has no matrix, distortions, rotation, tra"):
        read_any_rig(path)
    with pytest.raises(CalibrationError, match="'cam_1' has no matrix"):
        read_any_rig(path, names=["cam_1"])
    assert [camera.name for camera in read_any_rig(path, names=["cam_0"]).cameras] == ["cam_0"]


def chain_entry(model: str, intrinsics: object, distortion: str, coefficients: object) -> str:
    return (
        f"  camera_model: {model}\n  intrinsics: {intrinsics}\n"
        f"  distortion_model: {distortion}\n  distortion_coeffs: {coefficients}\n"
        "  resolution: [640, 480]\n"
    )


def kalibr_pinhole(
    rays: NDArray[np.float64], distort: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> NDArray[np.float64]:
    plane = distort(rays[:, :2] / rays[:, 2:])
    return plane * [400.0, 402.0] + [320.25, 238.5]


def fov_distort(plane: NDArray[np.float64]) -> NDArray[np.float64]:
    radius = np.linalg.norm(plane, axis=1, keepdims=True)
    w = 0.85
    return np.asarray(plane * np.arctan(2.0 * np.tan(w / 2.0) * radius) / (radius * w))


def radtan_distort(plane: NDArray[np.float64]) -> NDArray[np.float64]:
    k1, k2, p1, p2 = -0.25, 0.07, 0.002, -0.001
    x, y = plane.T
    xx, yy, xy = x * x, y * y, x * y
    rho = xx + yy
    radial = k1 * rho + k2 * rho * rho
    return np.column_stack(
        [
            x + x * radial + 2.0 * p1 * xy + p2 * (rho + 2.0 * xx),
            y + y * radial + 2.0 * p2 * xy + p1 * (rho + 2.0 * yy),
        ]
    )


def equidistant_distort(plane: NDArray[np.float64]) -> NDArray[np.float64]:
    radius = np.linalg.norm(plane, axis=1, keepdims=True)
    theta = np.arctan(radius)
    series = 1.0 + 0.03 * theta**2 - 0.01 * theta**4 + 0.004 * theta**6 - 0.001 * theta**8
    return np.asarray(plane * theta * series / radius)


def eucm(
    rays: NDArray[np.float64], alpha: float, beta: float, plane: list[float]
) -> NDArray[np.float64]:
    x, y, z = rays.T
    depth = alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1.0 - alpha) * z
    return np.column_stack([plane[0] * x / depth + plane[2], plane[1] * y / depth + plane[3]])


def omni(rays: NDArray[np.float64], xi: float, plane: list[float]) -> NDArray[np.float64]:
    x, y, z = rays.T
    depth = z + xi * np.linalg.norm(rays, axis=1)
    return np.column_stack([plane[0] * x / depth + plane[2], plane[1] * y / depth + plane[3]])


PLANE = [400.0, 402.0, 320.25, 238.5]

#: What Kalibr writes of a lens, and its projection of rays in our own words.
KALIBR = [
    (("pinhole", PLANE, "none", []), lambda rays: kalibr_pinhole(rays, lambda plane: plane)),
    (("pinhole", PLANE, "fov", [0.85]), lambda rays: kalibr_pinhole(rays, fov_distort)),
    (
        ("pinhole", PLANE, "radtan", [-0.25, 0.07, 0.002, -0.001]),
        lambda rays: kalibr_pinhole(rays, radtan_distort),
    ),
    (
        ("pinhole", PLANE, "equidistant", [0.03, -0.01, 0.004, -0.001]),
        lambda rays: kalibr_pinhole(rays, equidistant_distort),
    ),
    (("eucm", [0.6, 1.1, *PLANE], "none", []), lambda rays: eucm(rays, 0.6, 1.1, PLANE)),
    (("omni", [1.7, *PLANE], "none", []), lambda rays: omni(rays, 1.7, PLANE)),
]


@pytest.mark.parametrize(("lens", "pixels_of"), KALIBR)
def test_kalibrs_lenses_bend_rays_as_kalibr_does(
    tmp_path: Path,
    lens: tuple[str, object, str, object],
    pixels_of: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> None:
    (tmp_path / "chain.yaml").write_text(
        "cam0:\n" + chain_entry(*lens) + "  rostopic: /cam0/image_raw\n  cam_overlaps: []\n"
    )

    camera = read_any_rig(tmp_path / "chain.yaml").cameras[0]

    np.testing.assert_allclose(img_from_cam(camera, RAYS), pixels_of(RAYS) + 0.5, atol=EXACT_PX)


def test_a_chain_is_followed_from_camera_to_camera(tmp_path: Path) -> None:
    steps = [
        np.column_stack([rotation_about_axes((0, 10.0 * k, 3.0)), [-0.1 * k, 0.01, 0.02]])
        for k in (1, 2)
    ]
    text = ""
    for number, step in enumerate([None, *steps]):
        text += f"cam{number}:\n" + chain_entry("pinhole", PLANE, "none", [])
        if step is not None:
            rows = np.vstack([step, [0.0, 0.0, 0.0, 1.0]]).tolist()
            text += "  T_cn_cnm1:\n" + "".join(f"  - {row}\n" for row in rows)
    (tmp_path / "chain.yaml").write_text(text)

    rig = read_any_rig(tmp_path / "chain.yaml")

    assert [camera.name for camera in rig.cameras] == ["cam0", "cam1", "cam2"]
    np.testing.assert_allclose(rig["cam0"].cam_from_world, np.eye(3, 4), atol=1e-15)
    np.testing.assert_allclose(rig["cam1"].cam_from_world, steps[0], atol=1e-12)
    np.testing.assert_allclose(rig["cam2"].cam_from_world, compose(steps[1], steps[0]), atol=1e-12)


def test_the_name_in_a_topic_goes_before_the_place_in_the_chain(tmp_path: Path) -> None:
    rig = rig_of("PINHOLE", "EUCM")  # cam1, cam2: in the chain they are cam0, cam1
    export_rig(rig, "kalibr", tmp_path / "chain.yaml")

    sizes = {"cam1": (640, 480)}
    taken = import_rig(tmp_path, "chain.yaml", None, None, sizes, None)

    assert taken["cam1"].model == "PINHOLE"


def test_a_unit_that_is_not_the_files_own_is_taken_and_that_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rig = rig_of("PINHOLE", "EUCM")
    export_rig(rig, "kalibr", tmp_path / "chain.yaml")  # metres, by definition

    read_any_rig(tmp_path / "chain.yaml", unit="m")
    assert not caplog.messages
    taken = read_any_rig(tmp_path / "chain.yaml", unit="mm")

    (said,) = caplog.messages
    assert "kalibr has its lengths in m; they are taken in mm, as was asked" in said
    apart_m = np.linalg.norm(rig.centers_world[1] - rig.centers_world[0])
    found_m = np.linalg.norm(taken.centers_world[1] - taken.centers_world[0])
    assert found_m == pytest.approx(0.001 * apart_m)


def test_multicals_relative_poses_are_linked_from_an_absolute_one(tmp_path: Path) -> None:
    # x_a = R x_b + T for "a_to_b", as multical's export has it.
    rng = np.random.default_rng(5)
    poses = {
        name: np.column_stack(
            [rotation_about_axes(tuple(rng.uniform(-30, 30, 3))), rng.uniform(-1, 1, 3)]
        )
        for name in "abcd"
    }

    def entry(pose: Pose) -> str:
        return f'{{"R": {pose[:, :3].tolist()}, "T": {pose[:, 3].tolist()}}}'

    steps = {
        "d_to_c": compose(poses["d"], invert(poses["c"])),
        "b": poses["b"],
        "a_to_b": compose(poses["a"], invert(poses["b"])),
        "b_to_c": compose(poses["b"], invert(poses["c"])),
    }
    lens = f'{{"model": "standard", "image_size": [1280.0, 720.0], "K": {MATRIX.tolist()}, '
    lens += f'"dist": [{DISTORTION.tolist()}]}}'
    (tmp_path / "calibration.json").write_text(
        '{"cameras": {'
        + ", ".join(f'"{name}": {lens}' for name in poses)
        + '}, "camera_poses": {'
        + ", ".join(f'"{name}": {entry(pose)}' for name, pose in steps.items())
        + '}, "image_sets": {"rgb": []}}'
    )

    rig = read_any_rig(tmp_path / "calibration.json", unit="m")

    for name, pose in poses.items():
        np.testing.assert_allclose(rig[name].cam_from_world, pose, atol=1e-12)
        np.testing.assert_allclose(
            img_from_cam(rig[name], RAYS),
            opencv_pixels(MATRIX, DISTORTION, np.eye(3, 4), RAYS),
            atol=EXACT_PX,
        )


def opencv_matrix(key: str, values: NDArray[np.float64], indent: str = "") -> str:
    rows, columns = np.atleast_2d(values).shape
    return (
        f"{indent}{key}: !!opencv-matrix\n{indent}  rows: {rows}\n{indent}  cols: {columns}\n"
        f"{indent}  dt: d\n{indent}  data: {values.ravel().tolist()}\n"
    )


def write_easymocap(folder: Path, *, sized: bool = True, **extrinsics: NDArray[np.float64]) -> None:
    """Write two cameras; entries of the second file may be others."""
    names = 'names:\n  - "01"\n  - "02"\n'
    lenses, poses = "%YAML:1.0\n---\n" + names, "%YAML:1.0\n---\n" + names
    for name in ("01", "02"):
        lenses += opencv_matrix(f"K_{name}", MATRIX)
        lenses += opencv_matrix(f"dist_{name}", DISTORTION)
        lenses += f"H_{name}: 720\nW_{name}: 1280\n" if sized else ""
        entries = {
            f"R_{name}": RVEC[:, None],
            f"Rot_{name}": ROTATION,
            f"T_{name}": POSE[:, 3:],
        } | {key: value for key, value in extrinsics.items() if key.endswith(name)}
        poses += "".join(opencv_matrix(key, value) for key, value in entries.items())
    (folder / "intri.yml").write_text(lenses)
    (folder / "extri.yml").write_text(poses)


@pytest.mark.parametrize("name", ["intri.yml", "extri.yml", "."])
@pytest.mark.parametrize("sized", [True, False])
def test_easymocaps_two_files_are_one_rig(tmp_path: Path, name: str, sized: bool) -> None:
    write_easymocap(tmp_path, sized=sized)

    sizes = None if sized else {"01": (1280, 720), "02": (640, 480)}
    rig = read_any_rig(tmp_path / name, unit="m", image_sizes=sizes)

    assert [camera.name for camera in rig.cameras] == ["01", "02"]
    assert rig["01"].width_px == 1280
    assert rig["02"].height_px == (720 if sized else 480)
    assert rig.provenance.format == "easymocap"
    assert_images(rig["01"], opencv_pixels(MATRIX, DISTORTION, POSE, POINTS_WORLD))


def test_easymocaps_files_that_disagree_or_are_alone_are_named(tmp_path: Path) -> None:
    write_easymocap(tmp_path, Rot_02=rotation_about_axes((100.0, -20.0, 6.0)))
    with pytest.raises(CalibrationError, match="camera '02': R_02 and Rot_02 are different"):
        read_any_rig(tmp_path / "intri.yml", unit="m")

    (tmp_path / "extri.yml").unlink()
    with pytest.raises(CalibrationError, match=r"extri.yml: there is no such file; EasyMocap's"):
        read_any_rig(tmp_path / "intri.yml", unit="m")


def mccalib(groups: tuple[int, int] = (0, 0), count: int = 2) -> str:
    """Return a file of a pinhole at the origin and a fisheye that stands at `POSE`'s inverse."""
    ref_from_cam = np.vstack([invert(POSE), [0.0, 0.0, 0.0, 1.0]])
    text = f"%YAML:1.0\n---\nnb_camera: {count}\n"
    for number, (distortion, pose) in enumerate([(DISTORTION, np.eye(4)), (FISHEYE, ref_from_cam)]):
        text += f"camera_{number}:\n" + opencv_matrix("camera_matrix", MATRIX, "   ")
        text += opencv_matrix("distortion_vector", distortion, "   ")
        text += f"   distortion_type: {number}\n   camera_group: {groups[number]}\n"
        text += "   img_width: 1280\n   img_height: 720\n"
        text += opencv_matrix("camera_pose_matrix", pose, "   ")
    return text


def test_mccalibs_poses_are_those_of_the_cameras(tmp_path: Path) -> None:
    path = tmp_path / "calibrated_cameras_data.yml"
    path.write_text(mccalib())

    rig = read_any_rig(path, unit="m")
    # A session may call cameras as MC-Calib calls their folders, counted from 1.
    taken = import_rig(tmp_path, path.name, "m", None, {"Cam_002": (1280, 720)}, None)

    ahead = POINTS_WORLD + np.array([0.0, 0.0, 2.0])
    expected = opencv_pixels(MATRIX, DISTORTION, np.eye(3, 4), ahead)
    np.testing.assert_allclose(project_points(rig["camera_0"], ahead)[0], expected, atol=EXACT_PX)
    expected = opencv_pixels(MATRIX, FISHEYE, POSE, POINTS_WORLD, is_fisheye=True)
    assert_images(rig["camera_1"], expected)
    assert_images(taken["Cam_002"], expected)


def test_mccalibs_cameras_that_have_no_place_in_each_other_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "cameras.yml"
    path.write_text(mccalib(groups=(0, 1)))
    with pytest.raises(CalibrationError, match=r"in 2 groups.*camera_1 in 1\); calibrate them tog"):
        read_any_rig(path, unit="m")

    # MC-Calib leaves those out that are not in its first group.
    path.write_text(mccalib(count=3))
    with pytest.raises(CalibrationError, match="'camera_2' has no pose in the group"):
        read_any_rig(path, unit="m")
    assert len(read_any_rig(path, unit="m", names=["camera_0", "camera_1"]).cameras) == 2


def seen_by_opengl(points: NDArray[np.float64], fx: float, fy: float) -> NDArray[np.float64]:
    """Return pixels of points in a camera's own axes: x right, y up, z backwards; no distortion."""
    x, y, z = points.T
    return np.column_stack([639.75 + fx * x / -z, 359.25 - fy * y / -z])


#: A frame's matrix: a camera that looks along -z of its own axes from (0.3, -0.1, 2.5).
LOOKS_DOWN = np.eye(4)
LOOKS_DOWN[:3, 3] = [0.3, -0.1, 2.5]

NERF_LENS = {"w": 1280, "h": 720, "cx": 639.75, "cy": 359.25, "fl_x": 900.5, "fl_y": 901.5}


def transforms(frames: list[dict[str, object]], **lens: object) -> str:
    return json.dumps(lens | {"frames": frames})


def test_nerfs_cameras_look_along_minus_z_with_y_up(tmp_path: Path) -> None:
    frames: list[dict[str, object]] = [
        {"file_path": "./images/a.png", "transform_matrix": LOOKS_DOWN.tolist()},
        {"file_path": "images/b.png", "transform_matrix": LOOKS_DOWN.tolist(), "fl_x": 700.0},
    ]
    (tmp_path / "transforms.json").write_text(transforms(frames, **NERF_LENS))

    rig = read_any_rig(tmp_path / "transforms.json", unit="m")

    assert [camera.name for camera in rig.cameras] == ["a", "b"]
    own_axes = POINTS_WORLD - LOOKS_DOWN[:3, 3]
    assert_images(rig["a"], seen_by_opengl(own_axes, 900.5, 901.5))
    assert_images(rig["b"], seen_by_opengl(own_axes, 700.0, 901.5))


@pytest.mark.parametrize("fisheye", [{"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}, {}])
def test_nerfs_coefficients_are_opencvs(tmp_path: Path, fisheye: dict[str, object]) -> None:
    values = FISHEYE if fisheye else DISTORTION
    keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    frame: dict[str, object] = {
        "file_path": "a.png",
        "transform_matrix": LOOKS_DOWN.tolist(),
        **dict(zip(keys, values.tolist(), strict=True)),
    }
    (tmp_path / "transforms.json").write_text(transforms([frame], **NERF_LENS, **fisheye))

    camera = read_any_rig(tmp_path / "transforms.json", unit="m")["a"]

    # Their principal point is from the corner of the image, OpenCV's from a pixel's centre.
    matrix = np.array([[900.5, 0.0, 639.25], [0.0, 901.5, 358.75], [0.0, 0.0, 1.0]])
    expected = opencv_pixels(matrix, values, np.eye(3, 4), RAYS, is_fisheye=bool(fisheye))
    np.testing.assert_allclose(img_from_cam(camera, RAYS), expected, atol=EXACT_PX)


def test_nerfs_angle_is_over_the_whole_width(tmp_path: Path) -> None:
    frame: dict[str, object] = {"file_path": "r_0", "transform_matrix": LOOKS_DOWN.tolist()}
    path = tmp_path / "transforms_train.json"
    path.write_text(transforms([frame], camera_angle_x=np.pi / 2, w=800, h=600))

    np.testing.assert_allclose(
        read_any_rig(path, unit="m")["r_0"].params, [400.0, 400.0, 400.0, 300.0], rtol=1e-15
    )


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"fl_x": None}, "fl_x is 'None', not a number"),
        ({"k4": 0.1}, "its lens has k4, which only a fisheye has"),
        ({"is_fisheye": True, "p1": 0.1}, "its lens has p1 and p2, which a fisheye has not"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model 'EQUIRECTANGULAR' is not read"),
        ({"transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}, "the rotation mirrors"),
        ({"transform_matrix": [[1, 0], [0, 1]]}, r"shape \(2, 2\), expected \(4, 4\)"),
    ],
)
def test_what_nerf_has_and_colmap_has_not_is_refused(
    tmp_path: Path, changes: dict[str, object], found: str
) -> None:
    frame = {"file_path": "a.png", "transform_matrix": LOOKS_DOWN.tolist()} | changes
    (tmp_path / "transforms.json").write_text(transforms([frame], **NERF_LENS))

    with pytest.raises(CalibrationError, match=r"frame 0 \('a'\): .*" + found):
        read_any_rig(tmp_path / "transforms.json", unit="m")


def test_nerfs_lens_that_is_not_told_is_refused(tmp_path: Path) -> None:
    frame: dict[str, object] = {"file_path": "r_0", "transform_matrix": LOOKS_DOWN.tolist()}
    path = tmp_path / "transforms_train.json"
    path.write_text(transforms([frame], camera_angle_x=0.69))  # as Blender's synthetic scenes have

    with pytest.raises(CalibrationError, match=r"its lens is not told; .* with w and h"):
        read_any_rig(path, unit="m", image_sizes=(800, 800))


#: Camera matrices that hold more than focal lengths and a principal point.
SKEWED = MATRIX + np.array([[0.0, 1.25, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


def opencv_file(matrix: NDArray[np.float64], distortion: NDArray[np.float64], model: str) -> str:
    return (
        f"%YAML:1.0\n---\nimage_width: 1280\nimage_height: 720\ndistortion_model: {model}\n"
        + opencv_matrix("K", matrix)
        + opencv_matrix("D", distortion)
        + opencv_matrix("R", ROTATION)
        + opencv_matrix("T", POSE[:, 3:])
    )


def skewed_toml(matrix: NDArray[np.float64]) -> str:
    text = toml_section("cam_0", DISTORTION, RVEC.tolist(), POSE[:, 3].tolist())
    return text.replace(str(MATRIX.tolist()), str(matrix.tolist()))


@pytest.mark.parametrize(
    ("name", "text", "way"),
    [
        ("a.yml", opencv_file(SKEWED, DISTORTION, "plumb_bob"), "or write 0 there if the program"),
        ("a.yml", opencv_file(SKEWED, FISHEYE, "equidistant"), "calibrate with CALIB_FIX_SKEW"),
        ("a.toml", skewed_toml(SKEWED), "calibrate without skew"),
        ("a.yml", mccalib().replace("900.5, 0.0", "900.5, 1.25"), "calibrate without skew"),
    ],
)
def test_a_skew_beside_distortion_is_refused(
    tmp_path: Path, name: str, text: str, way: str
) -> None:
    (tmp_path / name).write_text(text)

    with pytest.raises(CalibrationError, match=rf"has a skew of 1\.25 px .*{way}"):
        read_any_rig(tmp_path / name, unit="m")


def test_a_skew_of_a_pinhole_is_kept_and_rounding_beside_distortion_is_none(tmp_path: Path) -> None:
    (tmp_path / "a.yml").write_text(opencv_file(SKEWED, np.zeros(5), "plumb_bob"))
    pixels = POINTS_WORLD @ POSE[:, :3].T + POSE[:, 3]
    pixels = pixels @ SKEWED.T
    assert_images(
        read_any_rig(tmp_path / "a.yml", unit="m")["a"], pixels[:, :2] / pixels[:, 2:] + 0.5
    )

    rounded = MATRIX + 1e-13 * (SKEWED - MATRIX)
    (tmp_path / "a.yml").write_text(opencv_file(rounded, DISTORTION, "plumb_bob"))
    assert_images(
        read_any_rig(tmp_path / "a.yml", unit="m")["a"],
        opencv_pixels(MATRIX, DISTORTION, POSE, POINTS_WORLD),
    )


def test_a_camera_matrix_that_is_transposed_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.yml").write_text(opencv_file(MATRIX.T, DISTORTION, "plumb_bob"))

    with pytest.raises(CalibrationError, match=r"below its diagonal.*transposed, as MATLAB"):
        read_any_rig(tmp_path / "a.yml", unit="m")


def test_a_matrix_that_does_not_say_its_columns_is_none(tmp_path: Path) -> None:
    text = opencv_file(MATRIX, DISTORTION, "plumb_bob")
    (tmp_path / "a.yml").write_text(text.replace("cols: 1", "col: 1"))  # of T

    # OpenCV's own reading of it ends the process, now and then.
    with pytest.raises(CalibrationError, match="holds no translation"):
        read_any_rig(tmp_path / "a.yml", unit="m")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("views.sfm", b'{"version": ["1", "0"], "views": [], "intrinsics_": []}'),  # AliceVision
        ("sensors.yaml", b"sensor: camera\nT_BS: 3\n"),
        ("chunk.xml", b"<?xml version='1.0'?><document version='1'><chunk/></document>"),
        ("notes.txt", b"the cameras stand where they stood\n"),
        ("calibration.pkl", b"\x80\x04\x95\xff\xfe rig"),
        ("empty.yml", b""),
    ],
)
def test_a_file_of_another_program_is_refused_with_what_is_read(
    tmp_path: Path, name: str, content: bytes
) -> None:
    (tmp_path / name).write_bytes(content)

    with pytest.raises(
        CalibrationError, match=r"a rig can be rig.json, .*NeRF \(transforms.json\)"
    ):
        read_any_rig(tmp_path / name, unit="m")


# --- What is written --------------------------------------------------------------------------


@pytest.mark.parametrize("ending", ["xml", "yml", "json"])
@pytest.mark.parametrize(
    "model", ["SIMPLE_PINHOLE", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "FISHEYE"]
)
def test_opencv_sees_with_what_is_written_what_we_see(
    tmp_path: Path, model: str, ending: str
) -> None:
    rig = rig_of(model, model)

    written = export_rig(rig, "opencv", tmp_path / "{camera}" / f"config.{ending}", unit="mm")

    assert [path.parent.name for path in written.files] == ["cam1", "cam2"]
    for camera, path in zip(rig.cameras, written.files, strict=True):
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        nodes = ("camera_matrix", "distortion_coefficients", "R", "tvec")
        matrix, distortion, rotation, tvec = (
            np.asarray(storage.getNode(name).mat(), np.float64) for name in nodes
        )
        is_fisheye = storage.getNode("distortion_model").string() == "equidistant"
        storage.release()
        pose = np.column_stack([rotation, tvec / 1000.0])
        expected = opencv_pixels(
            matrix, distortion.ravel(), pose, POINTS_WORLD, is_fisheye=is_fisheye
        )
        assert_images(camera, expected)


def test_what_a_format_has_no_place_for_is_told(tmp_path: Path) -> None:
    rig = rig_of("PINHOLE", "PINHOLE")
    labels = tuple(f"{c.name} {number}" for c in rig.cameras for number in range(10))
    full = Rig(
        rig.cameras,
        rig.provenance,
        RigCovariance(labels, np.eye(20)),
        {"cam2": Mount(np.eye(3, 4), np.eye(3, 4))},
    )

    lost = {
        to: " / ".join(export_rig(full, to, tmp_path / name).lost)
        for to, name in (("json", "a.json"), ("csv", "a.csv"), ("kalibr", "a.yaml"))
    }

    assert lost["json"] == ""
    assert lost["csv"] == "the image sizes / the covariance / the mounts of cam2 on their trackers"
    assert "the world: it is the frame of 'cam1' now" in lost["kalibr"]
    assert "cam0 is 'cam1', cam1 is 'cam2'" in lost["kalibr"]


@pytest.mark.parametrize(
    ("to", "model", "found"),
    [
        ("opencv", "EUCM", "cannot hold camera 'cam2': it has the lens model EUCM, which is none"),
        ("opencv", "THIN_PRISM_FISHEYE", "the lens model THIN_PRISM_FISHEYE"),
        ("aniposelib", "FULL_OPENCV", "a rational lens .* only 5 coefficients are read"),
        ("caliscope", "FOV", "the lens model FOV"),
        ("kalibr", "DIVISION", "the lens model DIVISION; Kalibr has radtan, equidistant, fov"),
        ("kalibr", "FULL_OPENCV", "more than radtan's k1, k2, p1, p2"),
        ("multical", "EUCM", "the lens model EUCM"),
        ("csv", "OPENCV", "the lens model OPENCV; a 3x4 matrix bends no lines"),
    ],
)
def test_a_lens_that_a_format_lacks_is_refused_by_name_and_nothing_is_written(
    tmp_path: Path, to: str, model: str, found: str
) -> None:
    target = tmp_path / ("{camera}.yml" if to == "opencv" else "rig")

    with pytest.raises(CalibrationError, match=found):
        export_rig(rig_of("PINHOLE", model), to, target)
    assert not list(tmp_path.iterdir())


def test_an_approximated_lens_is_as_near_as_it_says(tmp_path: Path) -> None:
    rig = rig_of("EUCM", "THIN_PRISM_FISHEYE", "OPENCV")
    target = tmp_path / "{camera}.yml"

    written = export_rig(rig, "opencv", target, approximate_lenses=True)

    assert list(written.approximated) == ["cam1", "cam2"]
    again = read_any_rig(target, unit="m")
    for name, lens in written.approximated.items():
        pixels, _ = project_points(rig[name], POINTS_WORLD)
        found, _ = project_points(again[name], POINTS_WORLD)
        inside = ((pixels >= 0) & (pixels <= [640, 480])).all(axis=1)
        assert inside.sum() > 10
        distances_px = np.linalg.norm(pixels - found, axis=1)[inside]
        assert distances_px.max() <= 1.05 * lens["error_px"] + EXACT_PX
    assert written.approximated["cam1"]["error_px"] < 1e-3
    assert 0.01 < written.approximated["cam2"]["error_px"] < 2.0


def test_a_real_lens_is_approximated_where_its_polynomial_turns_back(tmp_path: Path) -> None:
    # Fitted to an old camera; the polynomial turns back near the corners of its image.
    params = [494.3, 494.3, 322.0, 243.0, -0.364, 0.2014, 0.0, 0.0, -0.0723, 0.0, 0.0, 0.0]
    camera = Camera("cam1", "FULL_OPENCV", 644, 484, np.array(params), np.eye(3, 4))

    written = export_rig(Rig((camera,)), "kalibr", tmp_path / "a.yaml", approximate_lenses=True)

    assert 0.1 < written.approximated["cam1"]["error_px"] < 3.0


@pytest.mark.parametrize("to", ["opencv", "kalibr", "multical", "colmap", "aniposelib"])
def test_a_skew_that_a_format_lacks_is_refused_or_approximated_as_near_as_it_says(
    tmp_path: Path, to: str
) -> None:
    params = np.array([900.0, 905.0, 320.0, 240.0])
    camera = Camera("cam1", "PINHOLE", 640, 480, params, np.eye(3, 4), 0.5)
    target = tmp_path / "a.yml"

    with pytest.raises(CalibrationError, match=r"a skew of 0\.5 px.*json holds every.*--approxim"):
        export_rig(Rig((camera,)), to, target)
    assert not list(tmp_path.iterdir())

    written = export_rig(Rig((camera,)), to, target, approximate_lenses=True)

    error_px = written.approximated["cam1"]["error_px"]
    again = read_any_rig(target, unit="m", names=["cam1"])["cam1"]
    edges = np.stack(np.meshgrid([0.0, 640.0], [0.0, 240.0, 480.0]), axis=-1).reshape(-1, 2)
    rays = np.column_stack([cam_from_img(camera, edges), np.ones(len(edges))])
    off_px = np.linalg.norm(img_from_cam(again, rays) - edges, axis=1)
    assert again.skew_px == 0.0
    assert off_px.max() <= 1.01 * error_px
    # A shear moves the upper edge against the lower by this much, and nothing takes it back.
    assert error_px == pytest.approx(0.5 * 240.0 / 905.0, rel=0.05)


@pytest.mark.parametrize(
    ("to", "name", "unit", "found"),
    [
        ("kalibr", "a.yaml", "mm", "kalibr is in m by definition, not in mm"),
        ("json", "a.json", "mm", "json is in m by definition"),
        ("opencv", "a.yml", None, "hold one camera, the rig has 2; put {camera}"),
        ("opencv", "{camera}.txt", None, r"OpenCV writes \.xml, \.yml"),
        ("csv", "{camera}.csv", None, "is one file for all cameras"),
        ("csv", "missing/a.csv", None, "missing/a.csv: cannot be written"),
    ],
)
def test_a_target_that_does_not_fit_is_named(
    tmp_path: Path, to: str, name: str, unit: str | None, found: str
) -> None:
    with pytest.raises(CalibrationError, match=found):
        export_rig(rig_of("PINHOLE", "PINHOLE"), to, tmp_path / name, unit=unit)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("to", "name", "found"),
    [
        ("csv", "a b", "a row's name has no blank"),
        ("multical", "a_to_b", "stands for a relative pose"),
        ("opencv", "a/b", "cannot be part of a file's name"),
    ],
)
def test_a_name_that_a_format_cannot_spell_is_named(
    tmp_path: Path, to: str, name: str, found: str
) -> None:
    camera = make_camera(name, "PINHOLE", np.eye(3, 4))

    with pytest.raises(CalibrationError, match=found):
        export_rig(Rig((camera,)), to, tmp_path / "{camera}.yml" if to == "opencv" else tmp_path)


# --- Wrong files ------------------------------------------------------------------------------

CHAIN = "cam0:\n" + chain_entry("pinhole", PLANE, "none", [])


@pytest.mark.parametrize(
    ("name", "text", "found"),
    [
        ("a.toml", "[cam_0]\nsize = [1,", "not TOML"),
        ("a.toml", "[charuco]\ncolumns = 4\n", "holds no camera; expected sections"),
        ("a.toml", toml_section("cam_0", DISTORTION, [1, 2], [0, 0, 1]), r"shape \(2,\), expected"),
        ("a.toml", toml_section("cam_0", DISTORTION, '"x"', [0, 0, 1]), "'x', not numbers"),
        ("a.toml", toml_section("cam_0", DISTORTION, [0, 0, 0], [0, 1]), r"\(2,\), expected 3"),
        (
            "a.toml",
            toml_section("cam_0", DISTORTION, [0, 0, 0], [0, 0, 1]),
            "does not say the unit",
        ),
        ("a.yaml", CHAIN + "cam2:\n" + chain_entry("pinhole", PLANE, "none", []), "cam0, cam1"),
        ("a.yaml", CHAIN + "cam1:\n" + chain_entry("pinhole", PLANE, "none", []), "no T_cn_cnm1"),
        ("a.yaml", CHAIN.replace("pinhole", "ds"), "ds with 4 intrinsics"),
        ("a.yaml", CHAIN.replace("pinhole", "ds").replace("[400", "[1, 0.5, 400"), "no COLMAP mod"),
        ("a.yaml", CHAIN.replace("none", "brown"), "distortion_model 'brown'; expected one of"),
        ("a.yaml", CHAIN.replace("resolution", "size"), "cam0: has no resolution"),
        ("a.yaml", CHAIN.replace("[640, 480]", "[640]"), "expected width and height"),
        ("a.yaml", CHAIN + "  bad: [1, 2\n", "not YAML in line"),
        ("a.json", '{"cameras": {"a": {"K": []}}}', "has no camera_poses"),
        ("a.json", '{"cameras": ', "not JSON"),
        (
            "a.json",
            '{"cameras": {"a": {"K": []}}, "camera_poses": {"x_to_y": {"R": '
            '[[1,0,0],[0,1,0],[0,0,1]], "T": [0,0,0]}}}',
            "'x_to_y': names no camera; they are a",
        ),
        ("a.json", '{"cameras": {"a": {"K": []}}, "camera_poses": {}}', "'a' has no camera_poses"),
        ("a.csv", "cam1,1,2\n", "2 numbers after the name"),
    ],
)
def test_a_wrong_file_is_named_in_one_line(
    tmp_path: Path, name: str, text: str, found: str
) -> None:
    (tmp_path / name).write_text(text)

    with pytest.raises(CalibrationError, match=found) as caught:
        read_any_rig(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_image_size_is_asked_for_where_a_file_does_not_say_it(tmp_path: Path) -> None:
    export_rig(rig_of("PINHOLE"), "csv", tmp_path / "rig.csv")

    with pytest.raises(CalibrationError, match="does not say the image size of camera 'cam1'"):
        read_any_rig(tmp_path / "rig.csv", unit="m")
    rig = read_any_rig(tmp_path / "rig.csv", unit="m", image_sizes=(640, 480))
    assert (rig["cam1"].width_px, rig["cam1"].height_px) == (640, 480)


@pytest.mark.parametrize("to", ["caliscope", "aniposelib", "kalibr", "multical", "colmap"])
def test_a_format_that_fixes_its_pixel_centre_is_not_asked(tmp_path: Path, to: str) -> None:
    rig = rig_of("PINHOLE")
    export_rig(rig, to, tmp_path / "rig")

    for centre in (0.0, 0.5, None):
        taken = import_rig(tmp_path, "rig", "m", centre, {"cam1": (640, 480)}, None)
        np.testing.assert_allclose(taken["cam1"].params, rig["cam1"].params, atol=EXACT_PX)


def test_files_are_recognised_whatever_they_are_called(tmp_path: Path) -> None:
    rig = rig_of("OPENCV")
    for to in ("json", "caliscope", "aniposelib", "kalibr", "multical"):
        export_rig(rig, to, tmp_path / "rig.txt")
        taken = read_any_rig(tmp_path / "rig.txt", unit="m")
        np.testing.assert_allclose(taken.cameras[0].params, rig["cam1"].params, atol=EXACT_PX)


def test_every_lens_is_written_by_some_format_besides_ours(tmp_path: Path) -> None:
    for model in LENSES:
        export_rig(rig_of(model), "colmap", tmp_path / model)
        assert read_any_rig(tmp_path / model, unit="m").cameras[0].model == model
