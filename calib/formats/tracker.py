"""Poses of a tracked body, frame by frame, from a CSV file.

The first line names the columns: ``x,y,z,qw,qx,qy,qz`` (where the body is, in metres, and its
rotation as a quaternion), or ``m11,m12,..,m34`` (the matrix ``[R | t]`` by rows). Both are
``tracking_from_tracker``: they map coordinates on the body to the tracker's own world. With a
column ``frame`` rows may be missing; without one they are frames 0, 1, 2, ... Other columns are
left alone, as are lines that begin with #. Quaternions spelled x, y, z, w are read by their names.
The angles of a hinge are read from the same kind of file, with a column ``angle_deg``.
"""

import csv
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import CalibrationError
from hybridve.calib.files import nearly
from hybridve.calib.pose import Pose, nearest_rotation

#: A quaternion's length, and a matrix's R R^T, may be this far from 1: rounded, not damaged.
_ROUNDED = 1e-3

_PLACE = ("x", "y", "z")
_QUATERNION = ("qw", "qx", "qy", "qz")
_ANGLE = "angle_deg"
_MATRIX = tuple(f"m{row}{column}" for row, column in product((1, 2, 3), (1, 2, 3, 4)))


def read_poses(path: Path) -> dict[int, Pose]:
    """Return tracking_from_tracker (3, 4), metres, by frame, ascending; lost frames have no entry.

    A row in which all numbers of the pose are empty or NaN is a frame in which the tracker was
    lost.

    Parameters
    ----------
    path : Path
        The CSV file.

    Raises
    ------
    CalibrationError
        If it cannot be read, lacks columns or holds no pose, a number is none, a rotation is none,
        or a frame stands there twice.
    """
    header, rows = _read_table(path, "poses")
    wanted = _PLACE + _QUATERNION if set(_PLACE + _QUATERNION) <= set(header) else _MATRIX
    if not set(wanted) <= set(header):
        raise CalibrationError(
            f"{path}: the first line is {','.join(header)[:80]!r}; expected the columns "
            "frame,x,y,z,qw,qx,qy,qz or frame,m11,m12,..,m34 (frame may be left out)"
        )
    poses: dict[int, Pose] = {}
    for frame, values, where in _by_frame(header, rows, wanted):
        if not np.isfinite(values).all():
            raise CalibrationError(f"{where}: a part of the pose is missing; expected all or none")
        if frame in poses:
            raise CalibrationError(f"{where}: frame {frame} stands there twice")
        poses[frame] = (
            _from_quaternion(values, where)
            if wanted is not _MATRIX
            else _from_matrix(values.reshape(3, 4), where)
        )
    if not poses:
        raise CalibrationError(f"{path}: holds no pose; expected one row a frame")
    return dict(sorted(poses.items()))


def read_angles(path: Path) -> dict[int, float]:
    """Return the angles of a hinge in radians, by frame, ascending; frames without have no entry.

    The first line names the columns, ``angle_deg`` among them; all else is as with poses.

    Parameters
    ----------
    path : Path
        The CSV file.

    Raises
    ------
    CalibrationError
        If it cannot be read, lacks the column or holds no angle, a number is none, or a frame
        stands there twice.
    """
    header, rows = _read_table(path, "angles")
    if _ANGLE not in header:
        raise CalibrationError(
            f"{path}: the first line is {','.join(header)[:80]!r}; expected the columns "
            f"frame,{_ANGLE} (frame may be left out)"
        )
    angles_rad: dict[int, float] = {}
    for frame, (angle_deg,), where in _by_frame(header, rows, (_ANGLE,)):
        if not np.isfinite(angle_deg):
            raise CalibrationError(f"{where}: {_ANGLE} is {angle_deg}, expected a finite number")
        if frame in angles_rad:
            raise CalibrationError(f"{where}: frame {frame} stands there twice")
        angles_rad[frame] = float(np.deg2rad(angle_deg))
    if not angles_rad:
        raise CalibrationError(f"{path}: holds no angle; expected one row a frame")
    return dict(sorted(angles_rad.items()))


#: A row of a table: where it stands, and what it holds, column by column.
_Row = tuple[str, list[str]]


def _read_table(path: Path, what: str) -> tuple[list[str], list[_Row]]:
    """Return what a file calls its columns, and its rows."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError:
        raise CalibrationError(f"{path}: there is no such file of {what}{nearly(path)}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: cannot be read: {error}") from error
    rows = [
        (f"{path}: line {number}", next(csv.reader([line])))
        for number, line in enumerate(lines, start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    return [name.strip().lower() for name in rows[0][1]] if rows else [], rows[1:]


def _by_frame(
    header: list[str], rows: list[_Row], wanted: tuple[str, ...]
) -> Iterator[tuple[int, NDArray[np.float64], str]]:
    """Yield of each row its frame, the numbers in some columns, and where it stands.

    Rows in which none of them stands are left out.
    """
    columns = [header.index(name) for name in wanted]
    frame_column = header.index("frame") if "frame" in header else None
    for position, (where, row) in enumerate(rows):
        if len(row) != len(header):
            raise CalibrationError(f"{where}: has {len(row)} columns, the first line {len(header)}")
        frame = position if frame_column is None else _frame(row[frame_column], where)
        values = np.array([_number(row[column], where) for column in columns])
        if not np.isnan(values).all():
            yield frame, values, where


def _frame(text: str, where: str) -> int:
    try:
        number = float(text)
    except ValueError:
        number = np.nan
    if not (number >= 0 and number.is_integer()):
        raise CalibrationError(f"{where}: frame is {text!r}, expected 0, 1, 2, ...")
    return int(number)


def _number(text: str, where: str) -> float:
    if not text.strip():
        return np.nan
    try:
        return float(text)
    except ValueError:
        raise CalibrationError(f"{where}: {text!r} is not a number") from None


def _from_quaternion(values: NDArray[np.float64], where: str) -> Pose:
    """Return the pose of x, y, z, qw, qx, qy, qz."""
    length = float(np.linalg.norm(values[3:]))
    if abs(length - 1.0) > _ROUNDED:
        raise CalibrationError(
            f"{where}: the quaternion has length {length:.4g}, expected 1; are the columns in the "
            "order that the first line says?"
        )
    w, x, y, z = values[3:] / length
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.column_stack([np.array(rotation), values[:3]])


def _from_matrix(matrix: NDArray[np.float64], where: str) -> Pose:
    """Return the pose of a matrix (3, 4) whose rotation was rounded."""
    rotation = matrix[:, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > _ROUNDED or np.linalg.det(rotation) < 0:
        raise CalibrationError(
            f"{where}: the matrix is not a rotation and a translation (error {error:.1g}); "
            "expected m11..m14 to be its first row"
        )
    return np.column_stack([nearest_rotation(rotation), matrix[:, 3]])
