"""OpenCV's XML, YAML and JSON, one file a camera, or a stereo pair as its sample writes it.

OpenCV fixes how matrices are written (``cv::FileStorage``), not their names: those of its samples
and of common programs are taken, ROS's ``camera_info`` among them. Written are
``camera_matrix``, ``distortion_coefficients``, ``image_width`` and ``image_height`` as in OpenCV's
calibration sample, ``distortion_model`` as in ROS, and the pose as ``R``, ``rvec`` and ``tvec``.
The centre of the top-left pixel is usually at 0, where OpenCV's own functions have it.

References
----------
https://docs.opencv.org/5.x/da/d56/classcv_1_1FileStorage.html,
samples/cpp/calibration.cpp and samples/cpp/stereo_calib.cpp of OpenCV,
https://docs.ros.org/en/api/sensor_msgs/html/msg/CameraInfo.html
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats import opencv_lens
from hybridve.calib.formats.foreign import (
    ForeignCamera,
    ForeignRig,
    UnknownRigError,
    translation_in,
)
from hybridve.calib.opencv_storage import read_storage
from hybridve.calib.pose import rotation_vector

#: How files of OpenCV's kind spell what they hold, in lower case without "_", "-" and blanks.
_KEYS = {
    "matrix": ("cameramatrix", "mtx", "k", "intrinsicmatrix", "intrinsics", "intrinsic", "m"),
    "distortion": (
        "distortioncoefficients",
        "distortioncoeffs",
        "distcoeffs",
        "distortion",
        "dist",
        "d",
    ),
    "rotation": ("rvec", "rotation", "rotationvalues", "rotationmatrix", "rotationvector", "r"),
    "translation": ("tvec", "translation", "translationvalues", "translationvector", "t"),
    "pose": ("camfromworld", "extrinsicmatrix", "extrinsics", "extrinsic", "rt"),
    "model": ("distortionmodel", "cameramodel", "model"),
    "width": ("imagewidth", "width"),
    "height": ("imageheight", "height"),
}

#: What of these no other file is likely to have.
_OF_A_CAMERA = ("matrix", "rotation", "translation", "pose")

#: The most keys of a file that an error names.
_MOST_TOLD = 12

#: Endings by which OpenCV chooses how to write.
SUFFIXES = (".xml", ".yml", ".yaml", ".json")


def refusal(camera: Camera) -> str | None:
    """Return why an OpenCV file cannot hold a camera, or None."""
    return opencv_lens.refusal(camera, 8)


def write_opencv(camera: Camera, suffix: str, unit_m: float) -> str:
    """Return the text of one camera's file; `suffix` is one of `SUFFIXES`."""
    lens = opencv_lens.opencv_lens(camera)
    if lens.is_fisheye:
        model, distortion = "equidistant", lens.distortion
    elif lens.distortion[5:].any():
        model, distortion = "rational_polynomial", lens.distortion
    else:
        model, distortion = "plumb_bob", lens.distortion[:5]
    rotation = camera.cam_from_world[:, :3]
    storage = cv2.FileStorage(
        f"camera{suffix}", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY, "utf-8"
    )
    storage.write("image_width", camera.width_px)
    storage.write("image_height", camera.height_px)
    storage.write("distortion_model", model)
    storage.write("camera_matrix", lens.matrix)
    storage.write("distortion_coefficients", distortion[None])
    storage.write("R", rotation)
    storage.write("rvec", rotation_vector(rotation)[:, None])
    storage.write("tvec", np.array([translation_in(camera, unit_m)]).T)
    return storage.releaseAndGetString()


def read_opencv(path: Path, names: list[str]) -> ForeignRig:
    """Read the camera of one file, called ``names[0]``, or a stereo pair, called `names`.

    Raises
    ------
    CalibrationError
        If it lacks something, or holds another number of cameras.
    UnknownRigError
        If it is not OpenCV's, or holds nothing of a camera.
    """
    entries = _entries(path)
    if "m1" in entries and "m2" in entries:
        return _rig(_stereo_pair(path, entries, names))
    known = {key for what in _OF_A_CAMERA for key in _KEYS[what]}
    given = (entries.get(key) for key in known)
    if not any(isinstance(value, np.ndarray) and value.size for value in given):
        raise UnknownRigError(
            f"{path}: holds no camera (known keys: {', '.join(sorted(known))}); it has "
            f"{_some(entries)}"
        )
    if len(names) != 1:
        raise CalibrationError(
            f"{path}: an OpenCV file holds one camera, expected {len(names)}; write the rig as "
            "one file a camera, with {camera} in its path"
        )

    def find(what: str) -> Any:
        return next((entries[key] for key in _KEYS[what] if key in entries), None)

    def need(what: str) -> Any:
        value = find(what)
        if not isinstance(value, np.ndarray):
            raise CalibrationError(
                f"{path}: holds no {what} (known keys: {', '.join(_KEYS[what])}); it has "
                f"{_some(entries)}"
            )
        return value

    pose = find("pose")
    if isinstance(pose, np.ndarray) and pose.shape in ((3, 4), (4, 4)):
        rotation, translation = pose[:3, :3], pose[:3, 3]
    else:
        rotation, translation = need("rotation"), need("translation").ravel()
    distortion = find("distortion")
    model = find("model")
    width, height = find("width"), find("height")
    size_px = None
    if isinstance(width, float) and isinstance(height, float):
        size_px = (int(width), int(height))
    camera = opencv_lens.opencv_camera(
        names[0],
        need("matrix"),
        distortion if isinstance(distortion, np.ndarray) else np.zeros(0),
        rotation,
        translation,
        is_fisheye=isinstance(model, str) and model.lower() in {"fisheye", "equidistant"},
        size_px=size_px,
        where=str(path),
    )
    return _rig([camera])


def _some(entries: dict[str, Any]) -> str:
    """Return what a file has, as far as a line holds it."""
    keys = list(entries)
    more = f" and {len(keys) - _MOST_TOLD} more" if len(keys) > _MOST_TOLD else ""
    return ", ".join(key[:40] for key in keys[:_MOST_TOLD]) + more if keys else "nothing"


def _rig(cameras: list[ForeignCamera]) -> ForeignRig:
    return ForeignRig("opencv", tuple(cameras), pixel_centre=0.0, is_centre_fixed=False)


def _entries(path: Path) -> dict[str, Any]:
    """Return the matrices, numbers and texts of an OpenCV file, by simplified key."""
    return {
        key.lower().replace("_", "").replace("-", "").replace(" ", ""): value
        for key, value in read_storage(path).items()
    }


def _stereo_pair(path: Path, entries: dict[str, Any], names: list[str]) -> list[ForeignCamera]:
    """Read M1, D1, M2, D2, with R and T here or in ``extrinsics.*`` beside (OpenCV's sample)."""
    if len(names) != 2:
        raise CalibrationError(
            f"{path}: holds a stereo pair, expected {len(names)} cameras; name two"
        )
    beside = path.with_name("extrinsics" + path.suffix)
    if "r" not in entries and beside.is_file():
        entries = _entries(beside) | entries
    if not all(isinstance(entries.get(key), np.ndarray) for key in ("d1", "d2", "r", "t")):
        raise CalibrationError(
            f"{path}: a stereo pair needs M1, D1, M2, D2, and R and T here or in {beside.name}"
        )
    poses = [(np.eye(3), np.zeros(3)), (entries["r"], entries["t"].ravel())]
    return [
        opencv_lens.opencv_camera(
            name,
            entries[f"m{number}"],
            entries[f"d{number}"],
            rotation,
            translation,
            is_fisheye=False,
            size_px=None,
            where=str(path),
        )
        for number, (name, (rotation, translation)) in enumerate(
            zip(names, poses, strict=True), start=1
        )
    ]
