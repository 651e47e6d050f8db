"""What the files of other programs have in common: cameras, and what a file does not say."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.bounded import read_bounded
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.pose import Pose, nearest_rotation, rotation_of

#: A rotation with this error (largest entry of RR'-I) was rounded; beyond it, it is none.
_ROUNDED_ROTATION = 1e-3


class UnknownRigError(CalibrationError):
    """A file holds nothing that a reader knows: it is of another program, or no rig."""


@dataclass(frozen=True, slots=True, eq=False)
class ForeignCamera:
    """A camera as a foreign file has it: its own unit, its own pixel centre, perhaps no size.

    Attributes
    ----------
    name, model : str
        The file's name for it, and the COLMAP model that its lens is.
    params : (P,) float64
        In COLMAP's order.
    cam_from_world : (3, 4) float64
        Its translation in the file's unit.
    skew_px : float
        Entry (1, 2) of the camera matrix.
    size_px : (width, height) or None
        None where the file does not say.
    other_names : tuple of str
        What else the file calls it: a section, a topic.
    may_be_mirrored : bool
        Whether the file's matrix has a negative determinant, as that of a mirrored picture, or of
        one whose overall sign is reversed; here it is taken for the latter.
    """

    name: str
    model: str
    params: NDArray[np.float64]
    cam_from_world: Pose
    skew_px: float = 0.0
    size_px: tuple[int, int] | None = None
    other_names: tuple[str, ...] = ()
    may_be_mirrored: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class ForeignRig:
    """The cameras of a foreign file, and what its format fixes.

    Attributes
    ----------
    format : str
        The format's short name.
    cameras : tuple of ForeignCamera
        Those that have a lens and a pose.
    pixel_centre : float
        Where the centre of the top-left pixel lies: 0 (OpenCV and all that stands on it) or 0.5.
    is_centre_fixed : bool
        Whether the format fixes it; else it is only the usual one.
    unit : str or None
        Unit of the translations; None where neither format nor file says.
    incomplete : mapping of str to str
        The cameras that the file names without lens or pose, and what they lack.
    """

    format: str
    cameras: tuple[ForeignCamera, ...]
    pixel_centre: float
    is_centre_fixed: bool
    unit: str | None = None
    incomplete: Mapping[str, str] | None = None


def principal_point_index(model: str) -> int:
    """Return where in a COLMAP model's parameters the principal point begins."""
    return 1 if model.startswith("SIMPLE_") or model in {"RADIAL", "RADIAL_FISHEYE"} else 2


def read_text(path: Path) -> str:
    """Return a text file's content.

    Raises
    ------
    CalibrationError
        If it is missing.
    UnknownRigError
        If it is not UTF-8.
    """
    try:
        return read_bounded(path).decode("utf-8-sig")
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise UnknownRigError(f"{path}: cannot be read as text ({error.reason})") from error
    except ValueError as error:
        raise CalibrationError(f"{path}: {error}") from error


def as_numbers(value: Any, what: str, where: str) -> NDArray[np.float64]:
    """Return a file's nested lists as a float64 array.

    Raises
    ------
    CalibrationError
        If they are not finite numbers, or rows differ in length.
    """
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"{where}: {what} is {str(value)[:60]!r}, not numbers") from error
    if not np.isfinite(numbers).all():
        raise CalibrationError(f"{where}: {what} is {str(value)[:60]!r}, not finite numbers")
    return numbers


def as_size(value: Any, where: str) -> tuple[int, int]:
    """Return [width, height] in pixels.

    Raises
    ------
    CalibrationError
        If they are not two positive whole numbers.
    """
    numbers = as_numbers(value, "the image size", where).ravel()
    if len(numbers) != 2 or (numbers != np.round(numbers)).any() or (numbers <= 0).any():
        raise CalibrationError(f"{where}: the image size is {value}, expected width and height")
    return int(numbers[0]), int(numbers[1])


def as_pose(rotation: Any, translation: Any, where: str) -> Pose:
    """Return a (3, 4) pose from a rotation, a Rodrigues vector or a matrix, and a translation.

    Raises
    ------
    CalibrationError
        If the shapes are others, or the rotation is further from one than rounding takes it.
    """
    matrix = as_numbers(rotation, "the rotation", where)
    vector = as_numbers(translation, "the translation", where)
    if vector.size != 3:
        raise CalibrationError(f"{where}: translation of shape {vector.shape}, expected 3 numbers")
    if matrix.size == 3:
        matrix = rotation_of(matrix.ravel())
    if matrix.shape != (3, 3):
        raise CalibrationError(
            f"{where}: rotation of shape {matrix.shape}, expected 3 numbers or (3, 3)"
        )
    return np.column_stack([as_rotation(matrix, where), vector.ravel()])


def as_rotation(matrix: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """Return a (3, 3) rotation freed of rounding.

    Raises
    ------
    CalibrationError
        If it is further from a rotation than that, or mirrors.
    """
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if error < _ROUNDED_ROTATION and np.linalg.det(matrix) < 0:
        raise CalibrationError(
            f"{where}: the rotation mirrors (its determinant is -1): the picture is mirrored, or "
            "an axis of the world or the camera is reversed; flip the picture, or that axis"
        )
    if not error < _ROUNDED_ROTATION:
        raise CalibrationError(
            f"{where}: the rotation is none (R R' is off by {error:.0e}); check the order of its "
            "entries"
        )
    return nearest_rotation(matrix)


def translation_in(camera: Camera, unit_m: float) -> list[float]:
    """Return the translation of a camera's pose in units of `unit_m` metres."""
    return [float(value) for value in camera.cam_from_world[:, 3] / unit_m]
