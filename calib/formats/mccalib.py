"""MC-Calib's ``calibrated_cameras_data.yml``.

OpenCV's YAML: ``nb_camera``, and of ``camera_0``, ``camera_1``, ... each ``camera_matrix``,
``distortion_vector``, ``distortion_type`` (0: OpenCV's polynomial, 1: its fisheye), ``img_width``,
``img_height``, ``camera_group`` and ``camera_pose_matrix`` (4x4), the camera's pose in the group's
reference camera: ``x_ref = R x_cam + t``. Groups have no place in each other; MC-Calib writes one,
and leaves the cameras of others out. The unit is that of the boards. The centre of the top-left
pixel is at 0, as OpenCV has it.

References
----------
https://github.com/rameau-fr/MC-Calib: README.md (output), McCalib/src/McCalib.cpp
(saveCamerasParams, which writes the inverse of the group's pose) and CameraGroup.cpp.
"""

import re
from pathlib import Path
from typing import Any

from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats import opencv_lens
from hybridve.calib.formats.foreign import (
    ForeignCamera,
    ForeignRig,
    as_numbers,
    as_pose,
    as_size,
)
from hybridve.calib.opencv_storage import read_storage
from hybridve.calib.pose import invert

_HEAD = re.compile(r"^nb_camera\s*:", re.MULTILINE)

_NEEDED = (
    *("camera_matrix", "distortion_vector", "distortion_type", "camera_pose_matrix"),
    *("img_width", "img_height"),
)

_POLYNOMIAL, _FISHEYE = 0.0, 1.0


def is_mccalib(text: str) -> bool:
    """Whether a text looks like such a file."""
    return _HEAD.search(text) is not None and "camera_pose_matrix" in text


def read_mccalib(path: Path) -> ForeignRig:
    """Read a calibrated_cameras_data.yml.

    Raises
    ------
    CalibrationError
        If a camera is damaged, or they are not of one group.
    """
    entries = read_storage(path)
    count = entries.get("nb_camera")
    names = sorted(
        (key for key in entries if re.fullmatch(r"camera_\d+", key)), key=lambda key: int(key[7:])
    )
    if not isinstance(count, float) or not names:
        raise CalibrationError(f"{path}: expected nb_camera and camera_0, camera_1, ...")
    groups = {_group(entries[name]) for name in names}
    if len(groups) > 1:
        told = ", ".join(f"{name} in {_group(entries[name])}" for name in names)
        raise CalibrationError(
            f"{path}: its cameras are in {len(groups)} groups, whose places are not known to each "
            f"other ({told}); calibrate them together"
        )
    absent = [f"camera_{number}" for number in range(int(min(count, 10_000)))]
    cameras: list[ForeignCamera] = []
    for name in names:
        where = f"{path}, {name}"
        entry = entries[name]
        missing = [key for key in _NEEDED if not isinstance(entry, dict) or entry.get(key) is None]
        if missing:
            raise CalibrationError(f"{where}: has no {', '.join(missing)}")
        kind = entry["distortion_type"]
        if kind not in (_POLYNOMIAL, _FISHEYE):
            raise CalibrationError(
                f"{where}: distortion_type is {kind!r}, expected 0 (Brown) or 1 (Kannala)"
            )
        ref_from_cam = as_numbers(entry["camera_pose_matrix"], "camera_pose_matrix", where)
        if ref_from_cam.shape != (4, 4):
            raise CalibrationError(
                f"{where}: camera_pose_matrix of shape {ref_from_cam.shape}, expected (4, 4)"
            )
        cam_from_ref = invert(as_pose(ref_from_cam[:3, :3], ref_from_cam[:3, 3], where))
        folder = f"Cam_{int(name.removeprefix('camera_')) + 1:03d}"  # counted from 1
        cameras.append(
            opencv_lens.opencv_camera(
                name,
                entry["camera_matrix"],
                entry["distortion_vector"],
                cam_from_ref[:, :3],
                cam_from_ref[:, 3],
                is_fisheye=kind == _FISHEYE,
                size_px=as_size([entry["img_width"], entry["img_height"]], where),
                where=where,
                other_names=(folder,),
            )
        )
    return ForeignRig(
        "mccalib",
        tuple(cameras),
        pixel_centre=0.0,
        is_centre_fixed=True,
        incomplete={
            name: "pose in the group of the others" for name in absent if name not in entries
        },
    )


def _group(entry: Any) -> str:
    group = entry.get("camera_group") if isinstance(entry, dict) else None
    return f"{group:g}" if isinstance(group, float) else "none"
