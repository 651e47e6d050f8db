"""Rigs on disk: written and read without loss, and taken from elsewhere with unit and pixel."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from helpers.boards import LENSES, look_at, make_camera, ring
from numpy.typing import NDArray

from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import N_PARAMS, Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats.colmap import read_colmap_model, write_colmap_model
from hybridve.calib.formats.rig_json import read_rig, rig_to_dict, write_rig
from hybridve.calib.formats.rigs import import_rig
from hybridve.calib.lens import img_from_cam, project_points
from hybridve.calib.pose import angle_between, compose, transform
from hybridve.calib.provenance import MadeElsewhere
from hybridve.calib.rig import Mount, Rig, RigCovariance

#: Text with 17 digits gives a projection back to this, in pixels.
EXACT_PX = 1e-9

BOARD = Chessboard(8, 6, 0.1)
SIZES = {"cam1": (640, 480), "cam2": (640, 480)}


@pytest.fixture
def rig() -> Rig:
    cameras = ring(BOARD, ["PINHOLE", "PINHOLE"])
    return Rig(tuple(cameras), MadeElsewhere({"method": "made up", "rms_px": 0.1}))


def points() -> NDArray[np.float64]:
    return np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))


def assert_same_image(first: Camera, second: Camera) -> None:
    pixels, depth_m = project_points(first, points())
    again, depth_again_m = project_points(second, points())
    np.testing.assert_allclose(again, pixels, atol=EXACT_PX)
    np.testing.assert_allclose(depth_again_m, depth_m, atol=EXACT_PX)


def rows_of(rig: Rig, shift_px: float = 0.0, factor: float = 1.0) -> str:
    lines = []
    for camera in rig.cameras:
        matrix = camera.pinhole.copy()
        matrix[:2, 2] += shift_px
        pose = camera.cam_from_world.copy()
        pose[:, 3] *= factor
        numbers = ",".join(repr(float(value)) for value in (matrix @ pose).ravel())
        lines.append(f"{camera.name},{numbers}")
    return "\n".join(lines) + "\n"


def write_opencv(path: Path, **nodes: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in nodes.items():
        storage.write(name, value)
    storage.release()


# --- rig.json ---------------------------------------------------------------------------------


def test_a_rig_is_read_back_to_the_bit(tmp_path: Path) -> None:
    cameras = [
        make_camera(model, model, look_at((1.0, 0.1 * index, 1.0), (0, 0, 0)))
        for index, model in enumerate(LENSES)
    ]
    skewed = Camera("skewed", "PINHOLE", 8, 6, np.array([9.0, 9, 4, 3]), np.eye(3, 4), 0.125)
    rig = Rig((*cameras, skewed), MadeElsewhere({"rms_px": 1 / 3, "views": {"a.png": "blurred"}}))

    write_rig(tmp_path / "rig.json", rig)
    again = read_rig(tmp_path / "rig.json")

    assert rig_to_dict(again) == rig_to_dict(rig)
    assert [path.name for path in tmp_path.iterdir()] == ["rig.json"]


def test_the_file_says_its_conventions(tmp_path: Path, rig: Rig) -> None:
    write_rig(tmp_path / "rig.json", rig)

    content = json.loads((tmp_path / "rig.json").read_text())

    assert (content["format"], content["version"]) == ("hybridve-rig", 1)
    assert "(0.5, 0.5)" in content["conventions"]["image"]
    assert content["conventions"]["length"] == "metres"


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path, rig: Rig) -> None:
    with pytest.raises(CalibrationError, match="cannot be written"):
        write_rig(tmp_path / "missing" / "rig.json", rig)


def spoil(content: dict[str, object], *keys: object, value: object = None) -> None:
    node: object = content
    for key in keys[:-1]:
        node = node[key]  # type: ignore[index]
    if value is None:
        del node[keys[-1]]  # type: ignore[attr-defined]
    else:
        node[keys[-1]] = value  # type: ignore[index]


@pytest.mark.parametrize(
    ("keys", "value", "found"),
    [
        (("format",), "other", "format is 'other', expected 'hybridve-rig'"),
        (("version",), 99, "version 99 is not known, expected 1"),
        (("cameras", 0, "params"), None, "a camera has no 'params'"),
        (("cameras", 0, "params"), [1.0], "params has shape"),
        (("cameras", 0, "model"), "GOPRO", "unknown camera model 'GOPRO'"),
        (("cameras", 0, "width_px"), "wide", "wide"),
        (("cameras", 0, "cam_from_world"), [[1, 2, 3, 4]] * 3, "not a rotation"),
        (("cameras",), [], "no camera"),
    ],
)
def test_a_damaged_rig_is_named_with_what_is_wrong(
    tmp_path: Path, rig: Rig, keys: tuple[object, ...], value: object, found: str
) -> None:
    content = rig_to_dict(rig)
    spoil(content, *keys, value=value)
    (tmp_path / "rig.json").write_text(json.dumps(content))

    with pytest.raises(CalibrationError, match=found) as caught:
        read_rig(tmp_path / "rig.json")
    assert "rig.json" in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[]", '"rig"'])
def test_a_file_that_is_no_rig_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "rig.json").write_text(text)

    with pytest.raises(CalibrationError, match=r"rig\.json"):
        read_rig(tmp_path / "rig.json")


def test_a_missing_rig_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="cannot be read"):
        read_rig(tmp_path / "rig.json")


def test_our_own_rig_is_taken_as_it_is(tmp_path: Path, rig: Rig) -> None:
    write_rig(tmp_path / "rig.json", rig)

    # Unit and pixel centre belong to foreign files.
    taken = import_rig(tmp_path, "rig.json", "mm", 0.0, SIZES, None)

    assert rig_to_dict(taken) == rig_to_dict(rig)


# --- What is known about a rig, and cameras that move -------------------------------------------


def covered(rig: Rig) -> Rig:
    labels = tuple(f"{c.name} {p}" for c in rig.cameras for p in range(6 + len(c.params)))
    root = np.random.default_rng(0).normal(size=(len(labels), len(labels)))
    mount = Mount(look_at((1.0, 2, 3), (0, 0, 0)), look_at((3.0, 1, 2), (0, 0, 1)))
    return Rig(rig.cameras, rig.provenance, RigCovariance(labels, root @ root.T), {"cam2": mount})


def test_covariance_and_mounts_are_read_back_to_the_bit(tmp_path: Path, rig: Rig) -> None:
    whole = covered(rig)
    write_rig(tmp_path / "rig.json", whole)
    again = read_rig(tmp_path / "rig.json")

    assert again.covariance is not None
    assert whole.covariance is not None
    np.testing.assert_array_equal(again.covariance.matrix, whole.covariance.matrix)
    assert again.covariance.labels == whole.covariance.labels
    assert list(again.mounts) == ["cam2"]
    for name in ("cam_from_tracker", "world_from_tracking"):
        np.testing.assert_array_equal(
            getattr(again.mounts["cam2"], name), getattr(whole.mounts["cam2"], name)
        )


def test_a_rig_of_before_has_neither(tmp_path: Path, rig: Rig) -> None:
    write_rig(tmp_path / "rig.json", rig)
    content = json.loads((tmp_path / "rig.json").read_text())

    assert "covariance" not in content
    assert "mounts" not in content
    assert read_rig(tmp_path / "rig.json").covariance is None
    assert not read_rig(tmp_path / "rig.json").mounts


@pytest.mark.parametrize(
    ("keys", "value", "found"),
    [
        (("covariance", "labels"), ["cam1 rx"], r"shape \(20, 20\), expected \(1, 1\)"),
        (("covariance", "labels"), [f"cam1 {p}" for p in range(20)], "not that of its cameras"),
        (("covariance", "matrix", 3), [1.0], r"row 4 of the covariance has shape \(1,\)"),
        (("covariance", "matrix", 0), [-1.0], "'cam1 0' has the variance -1"),
        (("covariance", "matrix", 0), [float("nan")], "finite numbers"),
        (("covariance", "labels"), None, "or the covariance"),
        (("mounts", "cam2", "cam_from_tracker"), [[2, 0, 0, 0]] * 3, "not a rotation"),
        (("mounts", "cam2", "world_from_tracking"), [1.0], r"expected \(3, 4\)"),
        (("mounts", "cam2", "cam_from_tracker"), None, "'cam_from_tracker', or a mount"),
        (
            ("mounts",),
            {
                "cam9": {
                    "cam_from_tracker": np.eye(3, 4).tolist(),
                    "world_from_tracking": np.eye(3, 4).tolist(),
                }
            },
            "mount for 'cam9'",
        ),
        (("mounts",), [1], "expected hybridve-rig 1"),
    ],
)
def test_damage_to_them_is_named(
    tmp_path: Path, rig: Rig, keys: tuple[object, ...], value: object, found: str
) -> None:
    content = json.loads(json.dumps(rig_to_dict(covered(rig))))
    spoil(content, *keys, value=value)
    (tmp_path / "rig.json").write_text(json.dumps(content))

    with pytest.raises(CalibrationError, match=found):
        read_rig(tmp_path / "rig.json")


def test_a_covariance_that_is_not_symmetric_is_refused() -> None:
    matrix = np.diag([1.0, 1e-12])
    matrix[0, 1] = 1e-8  # large against the deviations 1 and 1e-6 that it couples

    with pytest.raises(CalibrationError, match="not symmetric"):
        RigCovariance(("a rx", "a ry"), matrix)


def test_a_tracked_camera_goes_with_its_tracker(rig: Rig) -> None:
    whole = covered(rig)
    mount = whole.mounts["cam2"]
    tracking_from_tracker = look_at((0.3, -1.0, 0.2), (1, 1, 1))
    points_tracker = points()
    # The same points by the other way round: tracker, its world, ours, camera.
    points_world = transform(
        compose(mount.world_from_tracking, tracking_from_tracker), points_tracker
    )

    moved = whole.at({"cam2": tracking_from_tracker})

    np.testing.assert_allclose(
        transform(moved["cam2"].cam_from_world, points_world),
        transform(mount.cam_from_tracker, points_tracker),
        atol=1e-12,
    )
    assert moved["cam1"] is whole["cam1"]
    assert moved.covariance is whole.covariance
    assert moved["cam2"].params.tolist() == whole["cam2"].params.tolist()
    with pytest.raises(CalibrationError, match=r"'cam1' has no mount .* cameras: cam2"):
        whole.at({"cam1": tracking_from_tracker})


def test_cameras_that_a_rig_lacks_cannot_be_taken_from_it(rig: Rig) -> None:
    with pytest.raises(CalibrationError, match="no camera 'cam3'"):
        covered(rig).only(["cam1", "cam3"])
    with pytest.raises(CalibrationError, match="2 times"):
        covered(rig).only(["cam1", "cam1"])
    with pytest.raises(CalibrationError, match="no camera"):
        covered(rig).only([])


# --- Rows of matrices -------------------------------------------------------------------------


@pytest.mark.parametrize("separator", [",", " ", "\t", ", "])
def test_rows_of_matrices_are_taken_without_loss(tmp_path: Path, rig: Rig, separator: str) -> None:
    (tmp_path / "rig.csv").write_text(rows_of(rig).replace(",", separator))

    taken = import_rig(tmp_path, "rig.csv", "m", 0.5, SIZES, None)

    for camera in rig.cameras:
        assert_same_image(camera, taken[camera.name])
    assert isinstance(taken.provenance, MadeElsewhere)
    assert taken.provenance.told["unit"] == "m"


@pytest.mark.parametrize(
    ("unit", "factor"),
    [("m", 1.0), ("cm", 100.0), ("mm", 1000.0), ("in", 1 / 0.0254), ("ft", 1 / 0.3048)],
)
def test_every_unit_becomes_metres(tmp_path: Path, rig: Rig, unit: str, factor: float) -> None:
    (tmp_path / "rig.csv").write_text(rows_of(rig, factor=factor))

    taken = import_rig(tmp_path, "rig.csv", unit, 0.5, SIZES, None)

    np.testing.assert_allclose(taken.centers_world, rig.centers_world, atol=1e-12)


def test_squares_become_metres_by_the_board(tmp_path: Path, rig: Rig) -> None:
    (tmp_path / "rig.csv").write_text(rows_of(rig, factor=1 / 0.115))

    taken = import_rig(tmp_path, "rig.csv", "squares", 0.5, SIZES, 0.115)

    np.testing.assert_allclose(taken.centers_world, rig.centers_world, atol=1e-12)


def test_a_pixel_centre_at_zero_is_moved_to_a_half(tmp_path: Path, rig: Rig) -> None:
    (tmp_path / "rig.csv").write_text(rows_of(rig, shift_px=-0.5))

    taken = import_rig(tmp_path, "rig.csv", "m", 0.0, SIZES, None)

    for camera in rig.cameras:
        assert_same_image(camera, taken[camera.name])


@pytest.mark.parametrize("factor", [2.0, -1.0, -1e-4, 1e6])
def test_the_factor_of_a_projection_matrix_does_not_matter(
    tmp_path: Path, rig: Rig, factor: float
) -> None:
    lines = []
    for line in rows_of(rig).splitlines():
        name, *numbers = line.split(",")
        lines.append(" ".join([name, *(repr(factor * float(number)) for number in numbers)]))
    (tmp_path / "rig.txt").write_text("\n".join(lines))

    taken = import_rig(tmp_path, "rig.txt", "m", 0.5, SIZES, None)

    for camera in rig.cameras:
        assert_same_image(camera, taken[camera.name])  # depths in front stay positive


def mirrored(matrix: NDArray[np.float64], width_px: int) -> NDArray[np.float64]:
    """Return the projection of the picture flipped left to right."""
    flip = np.array([[-1.0, 0.0, width_px], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(flip @ matrix)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("guilty", [["cam1"], ["cam2"], ["cam1", "cam2"]])
def test_mirrored_pictures_are_refused_by_name(
    tmp_path: Path, rig: Rig, guilty: list[str], sign: float
) -> None:
    lines = []
    for camera in rig.cameras:
        matrix = camera.pinhole @ camera.cam_from_world
        if camera.name in guilty:
            # Of a mirrored picture a reversed sign is a matrix like any other, that looks away.
            matrix = mirrored(matrix, camera.width_px)
        lines.append(" ".join([camera.name, *map(repr, (sign * matrix).ravel().tolist())]))
    (tmp_path / "rig.txt").write_text("\n".join(lines))

    if sign < 0:
        taken = import_rig(tmp_path, "rig.txt", "m", 0.5, SIZES, None)
        away = [c.name for c in taken.cameras if project_points(c, points())[1].max() < 0]
        assert away == guilty
        return
    names = ", ".join(f"'{name}'" for name in guilty)
    with pytest.raises(CalibrationError, match=f"rig.txt: cameras? {names}: .*mirrored"):
        import_rig(tmp_path, "rig.txt", "m", 0.5, SIZES, None)


def test_k_r_and_t_of_a_mirrored_picture_are_refused(tmp_path: Path, rig: Rig) -> None:
    camera = rig["cam1"]
    matrix = mirrored(camera.pinhole, camera.width_px)
    pose = camera.cam_from_world
    numbers = np.concatenate([matrix.ravel(), pose[:, :3].ravel(), pose[:, 3]])
    (tmp_path / "par.txt").write_text("cam1 " + " ".join(map(repr, numbers.tolist())))

    with pytest.raises(CalibrationError, match="picture of camera 'cam1' is mirrored"):
        import_rig(tmp_path, "par.txt", "m", 0.5, {"cam1": (640, 480)}, None)


def test_a_picture_turned_by_180_degrees_is_taken(tmp_path: Path, rig: Rig) -> None:
    camera = rig["cam1"]
    turned = camera.pinhole * [[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 1.0]]
    pose = camera.cam_from_world
    numbers = np.concatenate([turned.ravel(), pose[:, :3].ravel(), pose[:, 3]])
    (tmp_path / "par.txt").write_text("cam1 " + " ".join(map(repr, numbers.tolist())))

    taken = import_rig(tmp_path, "par.txt", "m", 0.5, {"cam1": (640, 480)}, None)["cam1"]

    pixels, depth_m = project_points(camera, points())
    again, depth_again_m = project_points(taken, points())
    middle = camera.pinhole[:2, 2]
    np.testing.assert_allclose(again, 2 * middle - pixels, atol=EXACT_PX)
    np.testing.assert_allclose(depth_again_m, depth_m, atol=EXACT_PX)


def test_a_rig_json_whose_focal_length_mirrors_is_refused(tmp_path: Path, rig: Rig) -> None:
    content = rig_to_dict(rig)
    content["cameras"][1]["params"][0] *= -1.0
    (tmp_path / "rig.json").write_text(json.dumps(content))

    with pytest.raises(CalibrationError, match=r"camera 'cam2': focal lengths of .* is mirrored"):
        read_rig(tmp_path / "rig.json")


def test_the_placeholder_names_a_camera_whatever_the_file_says(tmp_path: Path, rig: Rig) -> None:
    for camera, line in zip(rig.cameras, rows_of(rig).splitlines(), strict=True):
        (tmp_path / camera.name).mkdir()
        (tmp_path / camera.name / "par.txt").write_text(line.replace(camera.name, "somebody"))

    taken = import_rig(tmp_path, "{camera}/par.txt", "m", 0.5, SIZES, None)

    assert [camera.name for camera in taken.cameras] == ["cam1", "cam2"]
    for camera in rig.cameras:
        assert_same_image(camera, taken[camera.name])


def test_middlebury_rows_are_taken_and_endings_do_not_matter(tmp_path: Path, rig: Rig) -> None:
    lines = ["2"]
    for camera in rig.cameras:
        parts = [
            camera.pinhole.ravel(),
            camera.cam_from_world[:, :3].ravel(),
            camera.cam_from_world[:, 3],
        ]
        lines.append(f"{camera.name}.png " + " ".join(map(repr, np.concatenate(parts).tolist())))
    (tmp_path / "par.txt").write_text("\n".join(lines))

    taken = import_rig(tmp_path, "par.txt", "m", 0.5, {"cam2": (640, 480)}, None)

    assert [camera.name for camera in taken.cameras] == ["cam2"]
    assert taken["cam2"].skew_px == 0.0
    assert_same_image(rig["cam2"], taken["cam2"])


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("cam1,1,2,3\n", r"rig\.csv, line 1: 3 numbers after the name 'cam1', expected 12"),
        ("cam1," + ",".join("0" * 12), "singular"),
        ("cam1," + ",".join(["nan"] * 12), "number 1 after the name .cam1. is nan"),
        ("cam1 1 2\nrubbish here\n", "line 1"),
        ("", "holds no camera"),
        ("name,p11\n", "holds no camera"),
    ],
)
def test_rows_that_are_no_matrices_are_named(tmp_path: Path, text: str, found: str) -> None:
    (tmp_path / "rig.csv").write_text(text)

    with pytest.raises(CalibrationError, match=found):
        import_rig(tmp_path, "rig.csv", "m", 0.5, SIZES, None)


def test_a_camera_that_the_rig_lacks_is_named(tmp_path: Path, rig: Rig) -> None:
    (tmp_path / "rig.csv").write_text(rows_of(rig))

    with pytest.raises(CalibrationError, match="no camera 'cam3'; it has cam1, cam2"):
        import_rig(tmp_path, "rig.csv", "m", 0.5, {"cam3": (640, 480)}, None)


@pytest.mark.parametrize(
    ("pattern", "unit", "centre", "square_m", "found"),
    [
        ("rig.csv", "yards", 0.5, None, "unit 'yards' is not known; one of m, cm, mm, in, ft, sq"),
        ("rig.csv", "squares", 0.5, None, "squares, but the board's square has no size"),
        ("rig.csv", "m", 0.25, None, r"pixel centre is 0\.25; expected 0\.5"),
        ("other.csv", "m", 0.5, None, "no such rig file"),
        ("other.json", "m", 0.5, None, "no such rig file"),
        ("{camera}/rig.csv", "m", 0.5, None, r"no such file.*'cam1'"),
        ("empty", "m", 0.5, None, "not a COLMAP model"),
    ],
)
def test_a_wrong_request_is_named(
    tmp_path: Path,
    rig: Rig,
    pattern: str,
    unit: str,
    centre: float,
    square_m: float | None,
    found: str,
) -> None:
    (tmp_path / "rig.csv").write_text(rows_of(rig))
    (tmp_path / "empty").mkdir()

    with pytest.raises(CalibrationError, match=found):
        import_rig(tmp_path, pattern, unit, centre, SIZES, square_m)


# --- OpenCV -----------------------------------------------------------------------------------


def opencv_nodes(camera: Camera) -> dict[str, NDArray[np.float64]]:
    matrix = camera.pinhole.copy()
    matrix[:2, 2] -= 0.5
    return {
        "matrix": matrix,
        "rotation": np.asarray(cv2.Rodrigues(camera.cam_from_world[:, :3])[0]),
        "translation": 1000.0 * camera.cam_from_world[:, 3:],
    }


@pytest.mark.parametrize(
    ("names", "ending"),
    [
        (("mtx", "rvec", "tvec"), "xml"),
        (("CameraMatrix", "RotationValues", "TranslationValues"), "xml"),
        (("CameraMatrix", "Rotation", "Translation"), "yml"),
        (("camera_matrix", "rotation_matrix", "translation_vector"), "yaml"),
        (("K", "R", "T"), "json"),
    ],
)
def test_opencv_files_are_taken_in_their_spellings(
    tmp_path: Path, rig: Rig, names: tuple[str, str, str], ending: str
) -> None:
    for camera in rig.cameras:
        nodes = opencv_nodes(camera)
        path = tmp_path / camera.name / f"config.{ending}"
        write_opencv(path, **dict(zip(names, nodes.values(), strict=True)))

    taken = import_rig(tmp_path, f"{{camera}}/config.{ending}", "mm", 0.0, SIZES, None)

    for camera in rig.cameras:
        assert_same_image(camera, taken[camera.name])


@pytest.mark.parametrize(
    ("coefficients", "model"),
    [
        ((), "PINHOLE"),
        ((0.0, 0.0, 0.0, 0.0, 0.0), "PINHOLE"),
        ((-0.2, 0.1, 0.001, -0.002), "OPENCV"),
        ((-0.2, 0.1, 0.001, -0.002, 0.0), "OPENCV"),
        ((-0.2, 0.1, 0.001, -0.002, 0.05), "FULL_OPENCV"),
        ((-0.2, 0.1, 0.001, -0.002, 0.05, 0.1, 0.02, 0.01), "FULL_OPENCV"),
        ((-0.2, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, -0.3, *([0.0] * 6)), "FULL_OPENCV"),
    ],
)
def test_distortion_bends_rays_as_opencv_bends_them(
    tmp_path: Path, rig: Rig, coefficients: tuple[float, ...], model: str
) -> None:
    nodes = opencv_nodes(rig["cam1"])
    given = {"D": np.array([coefficients])} if coefficients else {}
    write_opencv(
        tmp_path / "cam1.yml",
        K=nodes["matrix"],
        rvec=nodes["rotation"],
        tvec=nodes["translation"],
        **given,
    )

    taken = import_rig(tmp_path, "{camera}.yml", "mm", 0.0, {"cam1": (640, 480)}, None)

    camera = taken["cam1"]
    assert camera.model == model
    rays = np.column_stack([np.random.default_rng(1).uniform(-0.4, 0.4, (10, 2)), np.ones(10)])
    expected, _ = cv2.projectPoints(
        rays, np.zeros(3), np.zeros(3), nodes["matrix"], np.array(coefficients)
    )
    np.testing.assert_allclose(img_from_cam(camera, rays), expected[:, 0] + 0.5, atol=EXACT_PX)


def test_a_fisheye_file_is_taken_as_fisheye(tmp_path: Path, rig: Rig) -> None:
    nodes = opencv_nodes(rig["cam1"])
    coefficients = np.array([[-0.03, 0.01, -0.004, 0.001]])
    write_opencv(
        tmp_path / "cam1.yml",
        K=nodes["matrix"],
        D=coefficients,
        R=nodes["rotation"],
        T=nodes["translation"],
        distortion_model="equidistant",
    )

    camera = import_rig(tmp_path, "{camera}.yml", "mm", 0.0, {"cam1": (640, 480)}, None)["cam1"]

    rays = np.column_stack([np.random.default_rng(1).uniform(-0.8, 0.8, (10, 2)), np.ones(10)])
    expected, _ = cv2.fisheye.projectPoints(
        rays[:, None], np.zeros(3), np.zeros(3), nodes["matrix"], coefficients[0]
    )
    np.testing.assert_allclose(img_from_cam(camera, rays), expected[:, 0] + 0.5, atol=EXACT_PX)


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"K": None}, r"holds no matrix .*it has"),
        ({"T": None}, "holds no translation"),
        ({"D": np.ones((1, 14))}, "thin prism and tilt distortion"),
        ({"R": 2.0 * np.eye(3)}, "the rotation is none"),
        ({"R": np.diag([1.0, 1.0, -1.0])}, "the rotation mirrors"),
        ({"K": np.diag([-500.0, 500.0, 1.0])}, "focal lengths of -500 and 500 px: .* is mirrored"),
        ({"K": np.diag([-500.0, -500.0, 1.0])}, "expected both above 0"),
        ({"K": np.eye(2)}, r"shape \(2, 2\)"),
    ],
)
def test_an_opencv_file_that_lacks_something_is_named(
    tmp_path: Path, rig: Rig, changes: dict[str, NDArray[np.float64] | None], found: str
) -> None:
    nodes = opencv_nodes(rig["cam1"])
    entries: dict[str, object] = {
        "K": nodes["matrix"],
        "R": nodes["rotation"],
        "T": nodes["translation"],
    }
    entries |= changes
    write_opencv(
        tmp_path / "cam1.yml", **{key: value for key, value in entries.items() if value is not None}
    )

    with pytest.raises(CalibrationError, match=found):
        import_rig(tmp_path, "{camera}.yml", "mm", 0.0, {"cam1": (640, 480)}, None)


def test_a_file_that_opencv_cannot_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "cam1.xml").write_text("this is no XML")

    with pytest.raises(CalibrationError, match="not an OpenCV file"):
        import_rig(tmp_path, "{camera}.xml", "mm", 0.0, {"cam1": (640, 480)}, None)


# --- COLMAP -----------------------------------------------------------------------------------


def mixed_rig() -> Rig:
    return Rig(tuple(ring(BOARD, ["OPENCV", "OPENCV_FISHEYE", "PINHOLE", "DIVISION"])))


def test_colmap_itself_reads_what_is_written(tmp_path: Path) -> None:
    rig = mixed_rig()

    write_colmap_model(tmp_path / "colmap", rig)
    model = pycolmap.Reconstruction(str(tmp_path / "colmap"))

    assert model.is_valid()
    assert (model.num_rigs(), model.num_frames(), model.num_reg_images()) == (1, 1, 4)
    for image in model.images.values():
        camera = rig[image.name]
        assert image.camera.model_name == camera.model
        np.testing.assert_allclose(image.camera.params, camera.params, rtol=1e-15)
        found = image.cam_from_world().matrix()
        assert angle_between(found, camera.cam_from_world) < 1e-12
        np.testing.assert_allclose(found[:, 3], camera.cam_from_world[:, 3], atol=1e-12)
        # The same pixel for the same point, by COLMAP's own projection.
        point = np.array([0.2, 0.1, 0.05])
        expected, _ = project_points(camera, point[None])
        np.testing.assert_allclose(image.project_point(point), expected[0], atol=1e-9)


@pytest.mark.parametrize("is_binary", [False, True])
def test_a_colmap_model_is_taken_text_or_binary(tmp_path: Path, is_binary: bool) -> None:
    rig = mixed_rig()
    folder = tmp_path / "sparse"
    write_colmap_model(folder, rig)
    if is_binary:
        model = pycolmap.Reconstruction(str(folder))
        folder = tmp_path / "binary"
        folder.mkdir()
        model.write_binary(str(folder))
    sizes = {camera.name: (640, 480) for camera in rig.cameras[::-1]}

    taken = import_rig(tmp_path, folder.name, "m", 0.5, sizes, None)
    again = read_colmap_model(folder)

    assert [camera.name for camera in taken.cameras] == list(sizes)
    for camera in rig.cameras:
        assert_same_image(camera, taken[camera.name])
        assert_same_image(camera, again[camera.name])


def test_a_colmap_model_is_replaced_whole(tmp_path: Path, rig: Rig) -> None:
    write_colmap_model(tmp_path, mixed_rig())
    write_colmap_model(tmp_path, rig)

    assert len(read_colmap_model(tmp_path).cameras) == 2
    assert not [path for path in tmp_path.iterdir() if "partial" in path.name]


def test_a_skew_that_colmap_cannot_hold_is_named(tmp_path: Path) -> None:
    skewed = Camera("cam1", "PINHOLE", 8, 6, np.array([9.0, 9, 4, 3]), np.eye(3, 4), 0.5)

    with pytest.raises(CalibrationError, match=r"'cam1': it has a skew of 0\.5 px"):
        write_colmap_model(tmp_path, Rig((skewed,)))


def test_images_of_another_size_than_the_rig_are_refused(tmp_path: Path) -> None:
    write_colmap_model(tmp_path / "colmap", mixed_rig())

    with pytest.raises(CalibrationError, match="images of 640x480, those of the session are 320x2"):
        import_rig(tmp_path, "colmap", "m", 0.5, {"cam1": (320, 240)}, None)


@pytest.mark.parametrize("name", ["cameras.txt", "images.txt"])
def test_a_damaged_colmap_model_is_named(tmp_path: Path, name: str) -> None:
    write_colmap_model(tmp_path / "colmap", mixed_rig())
    path = tmp_path / "colmap" / name
    path.write_text(path.read_text().replace("1 ", "one ", 1))
    text = path.read_text().splitlines()
    path.write_text("\n".join(["1 OPENCV x", *text]))

    with pytest.raises(CalibrationError, match="colmap"):
        import_rig(tmp_path, "colmap", "m", 0.5, {"cam1": (640, 480)}, None)
    with pytest.raises(CalibrationError, match="colmap"):
        read_colmap_model(tmp_path / "empty")


def test_every_model_we_know_is_known_to_colmap_with_as_many_parameters() -> None:
    for model, count in N_PARAMS.items():
        camera = pycolmap.Camera.create_from_model_name(1, model, 500.0, 640, 480)
        assert len(camera.params) == count
