"""multical's calibration.json.

``cameras`` has ``model``, ``image_size`` (width, height), ``K`` (3x3) and ``dist`` of OpenCV (pixel
centre at 0): 4, 5 or 8 numbers of the polynomial. For a fisheye multical writes OpenCV's four
coefficients as a column, and no other sign of it; so it is read and written here. ``camera_poses``
has ``R`` and ``T``: of "a" the pose cam_from_rig, of "a_to_b" the pose of a relative to b,
``x_a = R x_b + T`` (the name reads the other way round). The unit is that of the boards.

References
----------
https://github.com/oliver-batchelor/multical: FORMAT.md, multical/io/export_calib.py and
import_calib.py, multical/camera.py, multical/camera_fisheye.py.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hybridve.calib.bounded import parse_json
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats import opencv_lens
from hybridve.calib.formats.foreign import (
    ForeignCamera,
    ForeignRig,
    as_numbers,
    as_pose,
    as_size,
    read_text,
    translation_in,
)
from hybridve.calib.pose import Pose, compose, invert

#: Between the two names of a relative pose.
_RELATIVE = "_to_"


def is_multical(content: Any) -> bool:
    """Whether JSON values look like multical's."""
    cameras = content.get("cameras") if isinstance(content, dict) else None
    return isinstance(cameras, dict) and all(
        isinstance(camera, dict) and "K" in camera for camera in cameras.values()
    )


def refusal(camera: Camera) -> str | None:
    """Return why multical cannot hold a camera, or None."""
    if _RELATIVE in camera.name:
        return f"the name {camera.name!r}; {_RELATIVE!r} stands for a relative pose"
    return opencv_lens.refusal(camera, 8)


def write_multical(cameras: Sequence[Camera], unit_m: float) -> str:
    """Return the text of a calibration.json, every pose absolute."""
    lenses, poses = {}, {}
    for camera in cameras:
        lens = opencv_lens.opencv_lens(camera)
        if lens.is_fisheye:
            model, distortion = "standard", lens.distortion[:, None]
        elif lens.distortion[5:].any():
            model, distortion = "rational", lens.distortion[None]
        else:
            model, distortion = "standard", lens.distortion[None, :5]
        lenses[camera.name] = {
            "model": model,
            "image_size": [camera.width_px, camera.height_px],
            "K": lens.matrix.tolist(),
            "dist": distortion.tolist(),
        }
        poses[camera.name] = {
            "R": camera.cam_from_world[:, :3].tolist(),
            "T": translation_in(camera, unit_m),
        }
    return json.dumps({"cameras": lenses, "camera_poses": poses}, indent=2, allow_nan=False) + "\n"


def read_multical(path: Path) -> ForeignRig:
    """Read a calibration.json.

    Raises
    ------
    CalibrationError
        If it is not multical's, or a camera or pose is damaged.
    """
    try:
        content = parse_json(read_text(path))
    except ValueError as error:
        raise CalibrationError(f"{path}: not JSON ({error})") from error
    if not is_multical(content):
        raise CalibrationError(f"{path}: expected multical's cameras, each with K")
    entries: dict[str, Any] = content["cameras"]
    given = content.get("camera_poses")
    if not isinstance(given, dict):
        raise CalibrationError(f"{path}: has no camera_poses; calibrate the cameras together")
    poses = _absolute_poses(given, entries, str(path))
    cameras: list[ForeignCamera] = []
    for name, entry in entries.items():
        if name not in poses:
            continue
        where = f"{path}, camera {name!r}"
        missing = [key for key in ("image_size", "dist") if key not in entry]
        if missing:
            raise CalibrationError(f"{where}: has no {', '.join(missing)}")
        distortion = as_numbers(entry["dist"], "dist", where)
        cameras.append(
            opencv_lens.opencv_camera(
                name,
                entry["K"],
                distortion,
                poses[name][:, :3],
                poses[name][:, 3],
                is_fisheye=distortion.shape == (4, 1),
                size_px=as_size(entry["image_size"], where),
                where=where,
            )
        )
    return ForeignRig(
        "multical",
        tuple(cameras),
        pixel_centre=0.0,
        is_centre_fixed=True,
        incomplete={name: "camera_poses" for name in entries if name not in poses},
    )


def _absolute_poses(
    given: Mapping[str, Any], names: Mapping[str, Any], where: str
) -> dict[str, Pose]:
    """Return cam_from_rig of all cameras that hang together with an absolute one."""
    poses: dict[str, Pose] = {}
    steps: list[tuple[str, str, Pose]] = []  # a, b, a_from_b
    for key, entry in given.items():
        if not isinstance(entry, dict) or "R" not in entry or "T" not in entry:
            raise CalibrationError(f"{where}: camera_poses, {key!r}: has no R or no T")
        pose = as_pose(entry["R"], entry["T"], f"{where}: camera_poses, {key!r}")
        if key in names:
            poses[key] = pose
            continue
        ends = [
            (key[:at], key[at + len(_RELATIVE) :])
            for at in range(len(key))
            if key.startswith(_RELATIVE, at)
        ]
        pair = next(((a, b) for a, b in ends if a in names and b in names), None)
        if pair is None:
            raise CalibrationError(
                f"{where}: camera_poses, {key!r}: names no camera; they are {', '.join(names)}"
            )
        steps.append((*pair, pose))
    found = True
    while found:
        found = False
        for a, b, a_from_b in steps:
            if b in poses and a not in poses:
                poses[a], found = compose(a_from_b, poses[b]), True
            elif a in poses and b not in poses:
                poses[b], found = compose(invert(a_from_b), poses[a]), True
    return poses
