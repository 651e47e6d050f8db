"""transforms.json of NeRF, Instant NGP and nerfstudio: a camera for each picture.

``frames`` have a ``file_path`` and a ``transform_matrix`` (4x4), world_from_cam with OpenGL's axes:
x right, y up, z backwards. The lens stands in a frame, or at the top for all: ``fl_x``, ``fl_y``,
``cx``, ``cy``, ``w``, ``h`` and ``k1 k2 k3 p1 p2`` of OpenCV's polynomial, or of its fisheye
``k1 k2 k3 k4`` (``camera_model`` "OPENCV_FISHEYE", or ``is_fisheye``). ``camera_angle_x`` (radians,
over the whole width) stands for ``fl_x``, as does ``camera_angle_y`` for ``fl_y``; without
``fl_y`` it is ``fl_x``, without ``cx`` the middle. The centre of the top-left pixel is at 0.5, as
in COLMAP, where most come from. There is no unit; programs move, turn and scale the world.

References
----------
https://docs.nerf.studio/quickstart/data_conventions.html; nerfstudio,
process_data/colmap_utils.py and data/dataparsers/nerfstudio_dataparser.py; Instant NGP,
docs/nerf_dataset_tips.md and scripts/colmap2nerf.py.
"""

import math
from collections import Counter
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.bounded import parse_json
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats.foreign import (
    ForeignCamera,
    ForeignRig,
    as_numbers,
    as_pose,
    as_size,
    read_text,
)
from hybridve.calib.formats.opencv_lens import opencv_camera
from hybridve.calib.pose import invert

#: Camera models that are OpenCV's polynomial, or a part of it.
_POLYNOMIAL = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYE = ("OPENCV_FISHEYE",)

#: From OpenGL's axes of a camera to ours.
_TURN = np.diag([1.0, -1.0, -1.0])


def is_transforms(content: Any) -> bool:
    """Whether JSON values look like such a file's."""
    frames = content.get("frames") if isinstance(content, dict) else None
    return isinstance(frames, list) and any(
        isinstance(frame, dict) and "transform_matrix" in frame for frame in frames
    )


def read_transforms(path: Path) -> ForeignRig:
    """Read a transforms.json: a camera for each frame, named after its picture.

    Raises
    ------
    CalibrationError
        If a frame is damaged, or its lens is not one that COLMAP has.
    """
    try:
        content = parse_json(read_text(path))
    except ValueError as error:
        raise CalibrationError(f"{path}: not JSON ({error})") from error
    if not is_transforms(content):
        raise CalibrationError(f"{path}: expected frames, each with a transform_matrix")
    cameras: list[ForeignCamera] = []
    frames: list[Any] = content["frames"]
    for number, (frame, name) in enumerate(zip(frames, _names(frames), strict=True)):
        where = f"{path}, frame {number} ({name!r})"
        if not isinstance(frame, dict) or "transform_matrix" not in frame:
            raise CalibrationError(f"{where}: has no transform_matrix")
        matrix = as_numbers(frame["transform_matrix"], "transform_matrix", where)
        if matrix.shape not in ((3, 4), (4, 4)):
            raise CalibrationError(
                f"{where}: transform_matrix of shape {matrix.shape}, expected (4, 4)"
            )
        pose = invert(as_pose(matrix[:3, :3] @ _TURN, matrix[:3, 3], where))
        camera_matrix, distortion, is_fisheye, size_px = _lens(content | frame, where)
        cameras.append(
            opencv_camera(
                name,
                camera_matrix,
                distortion,
                pose[:, :3],
                pose[:, 3],
                is_fisheye=is_fisheye,
                size_px=size_px,
                where=where,
                other_names=(str(frame.get("file_path", "")),),
            )
        )
    return ForeignRig("nerf", tuple(cameras), pixel_centre=0.5, is_centre_fixed=False)


def _names(frames: list[Any]) -> list[str]:
    """Return what frames are called: their pictures, without folders where that is clear."""
    paths = [
        PurePosixPath(
            str(frame.get("file_path", number) if isinstance(frame, dict) else number).replace(
                "\\", "/"
            )
        )
        for number, frame in enumerate(frames)
    ]
    stems = Counter(path.stem for path in paths)
    return [
        path.stem if stems[path.stem] == 1 else str(path.with_suffix("")) if path.stem else "frame"
        for path in paths
    ]


def _lens(
    said: dict[str, Any], where: str
) -> tuple[NDArray[np.float64], list[float], bool, tuple[int, int] | None]:
    """Return camera matrix, OpenCV's coefficients, whether these are a fisheye's, and the size."""

    def number(key: str, otherwise: float = math.nan) -> float:
        value = said.get(key, otherwise)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise CalibrationError(f"{where}: {key} is {str(value)[:60]!r}, not a number")
        return float(value)

    size_px = None
    if "w" in said and "h" in said:
        size_px = as_size([said["w"], said["h"]], where)
    width_px, height_px = (math.nan, math.nan) if size_px is None else size_px
    fx = number("fl_x", _focal_px(width_px, number("camera_angle_x")))
    fy = number("fl_y", _focal_px(height_px, number("camera_angle_y")))
    fx, fy = (fy if math.isnan(fx) else fx), (fx if math.isnan(fy) else fy)
    cx, cy = number("cx", width_px / 2), number("cy", height_px / 2)
    if not np.isfinite([fx, fy, cx, cy]).all():
        raise CalibrationError(
            f"{where}: its lens is not told; expected fl_x, fl_y, cx and cy, or camera_angle_x "
            "with w and h"
        )
    model = str(said.get("camera_model", "OPENCV")).upper()
    if model not in _POLYNOMIAL + _FISHEYE:
        raise CalibrationError(
            f"{where}: camera_model {model!r} is not read; it has to be one of "
            f"{', '.join(_POLYNOMIAL + _FISHEYE)}"
        )
    is_fisheye = model in _FISHEYE or said.get("is_fisheye") is True
    k1, k2, k3, k4, p1, p2 = (number(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if (is_fisheye and (p1 or p2)) or (not is_fisheye and k4):
        raise CalibrationError(
            f"{where}: its lens has {'p1 and p2' if is_fisheye else 'k4'}, which "
            f"{'a fisheye' if is_fisheye else 'only a fisheye'} has "
            f"{'not' if is_fisheye else '(is_fisheye, or camera_model OPENCV_FISHEYE)'}"
        )
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return matrix, [k1, k2, k3, k4] if is_fisheye else [k1, k2, p1, p2, k3], is_fisheye, size_px


def _focal_px(extent_px: float, angle_rad: float) -> float:
    """Return the focal length that sees an extent under an angle; NaN where there is none."""
    is_angle = 0.0 < angle_rad < math.pi
    return extent_px / 2 / math.tan(angle_rad / 2) if is_angle else math.nan
