"""EasyMocap's ``intri.yml`` and ``extri.yml``, which lie beside each other.

Both are OpenCV's YAML with the cameras' ``names``. The first has ``K_NAME`` (3x3), ``dist_NAME``
(or ``D_NAME``; OpenCV's polynomial) and perhaps ``H_NAME`` and ``W_NAME``; the second ``R_NAME``, a
Rodrigues vector, ``Rot_NAME``, the same as a matrix, and ``T_NAME``, cam_from_world. The unit is
that of the board. The centre of the top-left pixel is at 0, as OpenCV has it.

References
----------
https://github.com/zju3dv/EasyMocap, easymocap/mytools/camera_utils.py (write_camera, read_camera).
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats import opencv_lens
from hybridve.calib.formats.foreign import ForeignCamera, ForeignRig, as_pose, as_size
from hybridve.calib.opencv_storage import read_storage

#: The two files, and what a camera has in each.
INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"

_NAMES = re.compile(r"^names\s*:", re.MULTILINE)
_ENTRY = re.compile(r"^(?:K|Rot|R|T)_\S.*:\s*!!opencv-matrix", re.MULTILINE)

#: The vector and the matrix of one rotation, six decimals each, differ by less than this.
_SAME_ROTATION = 1e-4


def is_easymocap(text: str) -> bool:
    """Whether a text looks like one of the two files."""
    return _NAMES.search(text) is not None and _ENTRY.search(text) is not None


def read_easymocap(path: Path) -> ForeignRig:
    """Read both files; `path` is either of them, or their folder.

    Raises
    ------
    CalibrationError
        If one is missing or damaged.
    """
    intrinsics_path, extrinsics_path = _both(path)
    intrinsics, extrinsics = read_storage(intrinsics_path), read_storage(extrinsics_path)
    cameras: list[ForeignCamera] = []
    incomplete: dict[str, str] = {}
    for name in _names(intrinsics, intrinsics_path):
        needed = ((f"K_{name}", intrinsics), (f"T_{name}", extrinsics))
        missing = [key for key, entries in needed if not isinstance(entries.get(key), np.ndarray)]
        rotation = _rotation(extrinsics, name, extrinsics_path)
        if rotation is None:
            missing.append(f"R_{name} or Rot_{name}")
        if missing:
            incomplete[name] = ", ".join(missing)
            continue
        distortion = intrinsics.get(f"dist_{name}", intrinsics.get(f"D_{name}"))
        where = f"{intrinsics_path}, camera {name!r}"
        size = [intrinsics.get(f"{key}_{name}") for key in "WH"]
        is_sized = all(isinstance(extent, float) and extent > 0 for extent in size)
        cameras.append(
            opencv_lens.opencv_camera(
                name,
                intrinsics[f"K_{name}"],
                np.zeros(0) if distortion is None else distortion,
                rotation,
                extrinsics[f"T_{name}"],
                is_fisheye=False,
                size_px=as_size(size, where) if is_sized else None,
                where=where,
            )
        )
    return ForeignRig(
        "easymocap",
        tuple(cameras),
        pixel_centre=0.0,
        is_centre_fixed=True,
        incomplete=incomplete,
    )


def _both(path: Path) -> tuple[Path, Path]:
    """Return where the lenses and where the poses are."""
    if path.is_dir():
        pair = path / INTRINSICS, path / EXTRINSICS
    elif "extri" in path.name:
        pair = path.with_name("intri".join(path.name.rsplit("extri", 1))), path
    else:
        pair = path, path.with_name("extri".join(path.name.rsplit("intri", 1)))
    if pair[0] == pair[1]:
        raise CalibrationError(
            f"{path}: looks like EasyMocap's, which are two files; call them {INTRINSICS} and "
            f"{EXTRINSICS}"
        )
    for one, other in (pair, pair[::-1]):
        if not one.is_file():
            raise CalibrationError(
                f"{one}: there is no such file; EasyMocap's rig is {pair[0].name} and "
                f"{pair[1].name} in one folder, and {other.name} is there"
            )
    return pair


def _names(entries: dict[str, Any], path: Path) -> list[str]:
    """Return the cameras' names; numbers that stand without quotes are names, too."""
    found = entries.get("names")
    if isinstance(found, np.ndarray):
        found = [f"{value:g}" for value in found.ravel()]
    if not isinstance(found, list) or not found:
        raise CalibrationError(f"{path}: has no names; expected EasyMocap's list of cameras")
    names = [name if isinstance(name, str) else f"{name}" for name in found]
    # A name with an ending stands without it in the keys.
    return [name if f"K_{name}" in entries else name.split(".")[0] for name in names]


def _rotation(entries: dict[str, Any], name: str, path: Path) -> Any:
    """Return the rotation of a camera, vector or matrix; None if there is none."""
    vector, matrix = entries.get(f"R_{name}"), entries.get(f"Rot_{name}")
    if vector is None or matrix is None:
        return matrix if vector is None else vector
    where = f"{path}, camera {name!r}"
    both = [as_pose(value, np.zeros(3), where) for value in (vector, matrix)]
    if np.abs(both[0] - both[1]).max() > _SAME_ROTATION:
        raise CalibrationError(
            f"{where}: R_{name} and Rot_{name} are different rotations; remove the wrong one"
        )
    return vector
