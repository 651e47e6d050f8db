"""Kalibr's camera chains (camchain.yaml).

Cameras are ``cam0``, ``cam1``, ... with ``camera_model`` and ``intrinsics``:

* pinhole [fu fv pu pv] with ``distortion_model`` none, radtan (k1 k2 p1 p2: OpenCV's), equidistant
  (k1 k2 k3 k4: OpenCV's fisheye) or fov (w),
* eucm [alpha beta fu fv pu pv]: COLMAP's EUCM, its parameters in another order,
* omni [xi fu fv pu pv]: without distortion it is an EUCM with beta = 1 and alpha = xi / (1 + xi),
  both focal lengths divided by 1 + xi; with distortion no COLMAP model,
* ds (double sphere): no COLMAP model.

``T_cn_cnm1`` (4x4) maps from the camera before in the chain, metres. Kalibr has no world: cam0's
frame is the world, unless cam0 has a ``T_cn_cnm1`` too, as mrcal writes it. Cameras are called
after their topics, where these are all ``/NAME/image_raw``. The centre of the top-left pixel is at
0, as Kalibr's detectors have it.

References
----------
https://github.com/ethz-asl/kalibr/wiki/yaml-formats and its wiki's page supported-models;
aslam_cv/aslam_cameras of its sources (ExtendedUnifiedProjection, OmniProjection, FovDistortion);
https://github.com/ethz-asl/kalibr/issues/115 (pixel positions); mrcal's mrcal-to-kalibr.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats.foreign import (
    ForeignCamera,
    ForeignRig,
    as_numbers,
    as_pose,
    as_size,
    read_text,
)
from hybridve.calib.formats.opencv_lens import opencv_lens
from hybridve.calib.pose import Pose, compose, invert

#: Kalibr's distortion models of a pinhole: how many coefficients, and COLMAP's model.
_PINHOLE = {
    "none": (0, "PINHOLE"),
    "radtan": (4, "OPENCV"),
    "equidistant": (4, "OPENCV_FISHEYE"),
    "fov": (1, "FOV"),
}

#: How many intrinsics each camera model has.
_N_INTRINSICS = {"pinhole": 4, "omni": 5, "eucm": 6, "ds": 6}

_NEEDED = ("camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution")

_CHAIN = re.compile(r"^cam\d+\s*:", re.MULTILINE)

#: A topic that says its camera's name.
_TOPIC = re.compile(r"/([^/]+)/image_raw")

#: Models that a chain holds besides those that opencv_lens turns into radtan or equidistant.
_OWN_MODELS = ("EUCM", "FOV")

_OPENCV_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"),
)


def is_chain(text: str) -> bool:
    """Whether a text looks like a camera chain."""
    return _CHAIN.search(text) is not None and "camera_model" in text


def refusal(camera: Camera) -> str | None:
    """Return why a chain cannot hold a camera, or None."""
    if camera.skew_px:
        return f"a skew of {camera.skew_px:.3g} px"
    if camera.model not in _OPENCV_MODELS + _OWN_MODELS:
        return f"the lens model {camera.model}; Kalibr has radtan, equidistant, fov and eucm"
    if camera.model == "FULL_OPENCV" and camera.params[8:].any():
        return "more than radtan's k1, k2, p1, p2"
    return None


def write_chain(cameras: Sequence[Camera]) -> str:
    """Return the text of a camchain.yaml, metres, cameras in order; names stand in the topics."""
    chain = {}
    before: Pose | None = None
    for number, camera in enumerate(cameras):
        camera_model, intrinsics, distortion_model, coefficients = _kalibr_lens(camera)
        entry: dict[str, Any] = {
            "camera_model": camera_model,
            "intrinsics": intrinsics,
            "distortion_model": distortion_model,
            "distortion_coeffs": coefficients,
            "resolution": [camera.width_px, camera.height_px],
            "rostopic": f"/{camera.name}/image_raw",
        }
        if before is not None:
            cn_from_cnm1 = np.vstack(
                [compose(camera.cam_from_world, invert(before)), [0.0, 0.0, 0.0, 1.0]]
            )
            entry["T_cn_cnm1"] = cn_from_cnm1.tolist()
        before = camera.cam_from_world
        chain[f"cam{number}"] = entry
    return yaml.safe_dump(chain, sort_keys=True, default_flow_style=None, allow_unicode=True)


def _kalibr_lens(camera: Camera) -> tuple[str, list[float], str, list[float]]:
    """Return camera model, intrinsics, distortion model and coefficients of a camera."""
    if camera.model in _OWN_MODELS:
        fx, fy, cx, cy, *rest = (float(value) for value in camera.params)
        plane = [fx, fy, cx - 0.5, cy - 0.5]
        if camera.model == "EUCM":
            return "eucm", [*rest, *plane], "none", []
        return "pinhole", plane, "fov", rest
    lens = opencv_lens(camera)
    matrix = lens.matrix
    plane = [float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))]
    if lens.is_fisheye:
        return "pinhole", plane, "equidistant", lens.distortion.tolist()
    if lens.distortion.any():
        return "pinhole", plane, "radtan", lens.distortion[:4].tolist()
    return "pinhole", plane, "none", []


def read_chain(path: Path) -> ForeignRig:
    """Read a camchain.yaml.

    Raises
    ------
    CalibrationError
        If it is no chain, or a camera is damaged or has a lens that is no COLMAP model.
    """
    try:
        # Some programs put OpenCV's first line, which is no YAML of any version, before a chain.
        content = yaml.safe_load(re.sub(r"\A%YAML.*\n", "", read_text(path)))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or "not readable"
        raise CalibrationError(f"{path}: not YAML{line} ({problem})") from error
    entries = content if isinstance(content, dict) else {}
    names = sorted(
        (key for key in entries if re.fullmatch(r"cam\d+", str(key))), key=lambda key: int(key[3:])
    )
    if not names or names != [f"cam{number}" for number in range(len(names))]:
        found = ", ".join(str(key) for key in entries) or "nothing"
        raise CalibrationError(f"{path}: expected cameras cam0, cam1, ..., found {found}")
    called = _topic_names([entries[name] for name in names]) or names
    cameras: list[ForeignCamera] = []
    cam_from_world: Pose = np.eye(3, 4)
    for number, name in enumerate(names):
        where = f"{path}, {name}"
        entry = entries[name]
        missing = [key for key in _NEEDED if not isinstance(entry, dict) or key not in entry]
        if missing:
            raise CalibrationError(f"{where}: has no {', '.join(missing)}")
        if "T_cn_cnm1" in entry:
            step = as_numbers(entry["T_cn_cnm1"], "T_cn_cnm1", where)
            if step.shape != (4, 4):
                raise CalibrationError(f"{where}: T_cn_cnm1 of shape {step.shape}, expected (4, 4)")
            cn_from_cnm1 = as_pose(step[:3, :3], step[:3, 3], where)
            cam_from_world = compose(cn_from_cnm1, cam_from_world)
        elif number > 0:
            raise CalibrationError(f"{where}: has no T_cn_cnm1; calibrate the cameras together")
        model, params = _colmap_lens(entry, where)
        size_px = as_size(entry["resolution"], where)
        cameras.append(
            ForeignCamera(
                called[number],
                model,
                params,
                cam_from_world,
                size_px=size_px,
                other_names=(name, str(entry.get("rostopic", ""))),
            )
        )
    return ForeignRig("kalibr", tuple(cameras), pixel_centre=0.0, is_centre_fixed=True, unit="m")


def _topic_names(entries: Sequence[Any]) -> list[str] | None:
    """Return the names in topics "/NAME/image_raw", or None unless each camera has its own."""
    topics = (entry.get("rostopic") if isinstance(entry, dict) else None for entry in entries)
    found = [_TOPIC.fullmatch(topic) if isinstance(topic, str) else None for topic in topics]
    names = [match.group(1) for match in found if match is not None]
    return names if len(set(names)) == len(entries) else None


def _colmap_lens(entry: dict[str, Any], where: str) -> tuple[str, NDArray[np.float64]]:
    """Return COLMAP's model and parameters of a camera, pixel centre at 0."""
    camera_model, distortion_model = str(entry["camera_model"]), str(entry["distortion_model"])
    intrinsics = as_numbers(entry["intrinsics"], "intrinsics", where).ravel()
    coefficients = as_numbers(entry["distortion_coeffs"], "distortion_coeffs", where).ravel()
    if camera_model not in _N_INTRINSICS or distortion_model not in _PINHOLE:
        raise CalibrationError(
            f"{where}: camera_model {camera_model!r} with distortion_model {distortion_model!r}; "
            f"expected one of {', '.join(_N_INTRINSICS)} with one of {', '.join(_PINHOLE)}"
        )
    n_coefficients, pinhole_model = _PINHOLE[distortion_model]
    if len(intrinsics) != _N_INTRINSICS[camera_model] or len(coefficients) != n_coefficients:
        raise CalibrationError(
            f"{where}: {camera_model} with {len(intrinsics)} intrinsics and {distortion_model} "
            f"with {len(coefficients)} coefficients, expected {_N_INTRINSICS[camera_model]} and "
            f"{n_coefficients}"
        )
    if camera_model == "pinhole":
        return pinhole_model, np.concatenate([intrinsics, coefficients])
    plane = intrinsics[-4:]
    if camera_model == "ds" or (camera_model == "omni" and coefficients.any()):
        raise CalibrationError(
            f"{where}: camera_model {camera_model} with distortion_model {distortion_model} is no "
            "COLMAP model; calibrate with pinhole and equidistant, or with eucm"
        )
    if coefficients.any():
        raise CalibrationError(f"{where}: Kalibr has no eucm with {distortion_model}")
    if camera_model == "eucm":
        return "EUCM", np.concatenate([plane, intrinsics[:2]])
    xi = float(intrinsics[0])
    scale = np.array([1.0 + xi, 1.0 + xi, 1.0, 1.0])
    return "EUCM", np.concatenate([plane / scale, [xi / (1.0 + xi), 1.0]])
