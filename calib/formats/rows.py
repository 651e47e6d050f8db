"""Rows of numbers: a name and a 3x4 projection matrix a line, or Middlebury's ``*_par.txt``.

Read are lines ``name p11 ... p34`` (img_from_world) and ``name K(9) R(9) t(3)``, by commas,
semicolons or blanks; a header and a count of the lines may come first. Written are commas and a
header. Such a file holds neither image sizes nor a lens that bends lines.

References
----------
https://vision.middlebury.edu/mview/data/ (the format of ``*_par.txt``).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats.foreign import (
    ForeignCamera,
    ForeignRig,
    UnknownRigError,
    as_rotation,
    read_text,
)

#: A skew below this comes from the decomposition's own rounding.
_NO_SKEW_PX = 1e-9

#: What separates the numbers of a row, and begins a remark: a name may hold none of it.
_SEPARATORS = " \t,;"


def refusal(camera: Camera) -> str | None:
    """Return why a row cannot hold a camera, or None."""
    if camera.has_distortion:
        return f"the lens model {camera.model}; a 3x4 matrix bends no lines"
    if any(sign in camera.name for sign in _SEPARATORS) or camera.name[:1] in {"", "#"}:
        return f"the name {camera.name!r}; a row's name has no blank, comma or semicolon"
    return None


def write_rows(cameras: Sequence[Camera], unit_m: float) -> str:
    """Return the text of a file of 3x4 matrices: img_from_world, pixel centre at 0.5."""
    columns = (f"p{row}{column}" for row in range(1, 4) for column in range(1, 5))
    lines = [",".join(["name", *columns])]
    for camera in cameras:
        pose = camera.cam_from_world.copy()
        pose[:, 3] /= unit_m
        numbers = (repr(float(value)) for value in (camera.pinhole @ pose).ravel())
        lines.append(",".join([camera.name, *numbers]))
    return "\n".join(lines) + "\n"


def _words(line: str) -> list[str]:
    """Return name and numbers of a line; a name may hold spaces where a comma ends it."""
    name, _, rest = line.partition(";" if ";" in line else ",")
    numbers = rest.replace(",", " ").replace(";", " ").split()
    if len(numbers) in (12, 21):
        return [name.strip(), *numbers]
    return line.replace(",", " ").replace(";", " ").split()


def read_rows(path: Path) -> ForeignRig:
    """Read lines ``name p11 ... p34`` or ``name K(9) R(9) t(3)``.

    Raises
    ------
    CalibrationError
        Naming the line that is none.
    UnknownRigError
        If none is.
    """
    cameras: list[ForeignCamera] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = _words(line)
        if not words or words[0].startswith("#"):
            continue
        if len(words) == 1 and words[0].isdigit() and not cameras:
            continue  # Middlebury's count of the lines that follow
        try:
            numbers = np.array([float(word) for word in words[1:]])
        except ValueError:
            if not cameras and number == 1:
                continue  # a header
            kind = CalibrationError if cameras else UnknownRigError
            raise kind(
                f"{path}, line {number}: not a name and numbers: {line.strip()[:60]!r}"
            ) from None
        if not np.isfinite(numbers).all():
            which = int(np.flatnonzero(~np.isfinite(numbers))[0])
            raise CalibrationError(
                f"{path}, line {number}: number {which + 1} after the name {words[0]!r} is "
                f"{words[1 + which]}; expected finite numbers"
            )
        if len(numbers) not in (12, 21):
            raise CalibrationError(
                f"{path}, line {number}: {len(numbers)} numbers after the name {words[0]!r}, "
                "expected 12 (a 3x4 matrix) or 21 (K, R and t)"
            )
        where = f"{path}, line {number}"
        if len(numbers) == 12:
            img_from_world = numbers.reshape(3, 4)
        else:
            rotation = as_rotation(numbers[9:18].reshape(3, 3), where)
            matrix = numbers[:9].reshape(3, 3)
            if matrix[2, 2] > 0 and np.linalg.det(matrix) < 0:
                raise CalibrationError(
                    f"{where}: the picture of camera {words[0]!r} is mirrored: its K has a "
                    "negative determinant; flip the picture, and make both focal lengths positive"
                )
            img_from_world = matrix @ np.column_stack([rotation, numbers[18:]])
        cameras.append(_decompose(words[0], img_from_world, where))
    if not cameras:
        raise UnknownRigError(
            f"{path}: holds no camera; expected lines of a name and 12 numbers (a 3x4 matrix), "
            "or 21 (K, R and t)"
        )
    return ForeignRig("csv", tuple(cameras), pixel_centre=0.5, is_centre_fixed=False)


def _decompose(name: str, img_from_world: NDArray[np.float64], where: str) -> ForeignCamera:
    """Split a projection matrix (3, 4) into lens and pose without loss.

    A projection matrix is known up to a factor, which may be negative. It is chosen so that
    depths are positive in front of the camera: its left part has a positive determinant if the
    image is not mirrored. Whether it is cannot be told from the matrix alone: mirrored, it would
    look the other way, which the rig's other cameras tell (`hybridve.calib.formats.rigs`).

    References
    ----------
    Hartley and Zisserman, *Multiple View Geometry*, 2nd ed., 2003, sections 6.2.3 and 6.2.4.
    """
    left = img_from_world[:, :3]
    scale = float(np.linalg.norm(left[2]))
    determinant = float(np.linalg.det(left / max(scale, 1e-300)))
    if scale == 0 or abs(determinant) < 1e-9 * float(np.abs(left).max() / scale) ** 2:
        raise CalibrationError(
            f"{where}: the matrix of camera {name!r} is singular; expected K [R | t]"
        )
    sign = float(np.sign(determinant))
    # RQ from QR: reverse the rows, transpose.
    flip = np.eye(3)[::-1]
    q, r = np.linalg.qr((flip @ (sign * left)).T)
    upper, rotation = flip @ r.T @ flip, flip @ q.T
    signs = np.diag(np.where(np.diag(upper) < 0, -1.0, 1.0))
    upper, rotation = upper @ signs, signs @ rotation
    translation = np.linalg.solve(upper, sign * img_from_world[:, 3])
    matrix = upper / upper[2, 2]
    skew_px = float(matrix[0, 1])
    if abs(skew_px) < _NO_SKEW_PX:
        skew_px = 0.0
    return ForeignCamera(
        name,
        "PINHOLE",
        np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]),
        np.column_stack([rotation, translation]),
        skew_px,
        may_be_mirrored=sign < 0,
    )
