"""OpenCV's two lens models, which most other formats hold, against COLMAP's.

OpenCV has the centre of the top-left pixel at 0, COLMAP at 0.5. Both write the polynomial model's
coefficients as k1 k2 p1 p2 k3 k4 k5 k6 (FULL_OPENCV) and the fisheye's as k1 k2 k3 k4. OpenCV's
further eight coefficients (thin prism, tilt) are in no COLMAP model.

A skew, entry (1, 2) of the camera matrix, OpenCV's ``projectPoints`` leaves out, and its
``calibrateCamera`` writes 0. Where there is one, another program calibrated (MATLAB, a projection
matrix taken apart) or ``cv::fisheye::calibrate`` without ``CALIB_FIX_SKEW``, and means it. Without
distortion it is kept; with it no COLMAP model holds it, and it is refused: left out, it would move
pixels by up to its own size, and nobody would know.

References
----------
https://docs.opencv.org/5.x/d9/d0c/group__calib3d.html (projectPoints) and its fisheye module;
COLMAP, sensor/models.h.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats.foreign import ForeignCamera, as_numbers, as_pose

#: COLMAP's models that are OpenCV's polynomial with coefficients left out: which stand in the file.
_POLYNOMIAL = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": (0,),
    "RADIAL": (0, 1),
    "OPENCV": (0, 1, 2, 3),
    "FULL_OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
}

#: The same of OpenCV's fisheye.
_FISHEYE = {
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "SIMPLE_RADIAL_FISHEYE": (0,),
    "RADIAL_FISHEYE": (0, 1),
    "OPENCV_FISHEYE": (0, 1, 2, 3),
}

#: Most coefficients that OpenCV reads.
_MOST_COEFFICIENTS = 14

#: A skew moves pixels by this at most within 45 degrees of the axis; so little is rounding.
_NO_SKEW_PX = 1e-3

#: What else stands below the diagonal of a camera matrix, as a share of its largest entry.
_NO_ENTRY = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class OpencvLens:
    """A lens as OpenCV has it.

    Attributes
    ----------
    matrix : (3, 3) float64
        The camera matrix, pixel centre at 0.
    distortion : (8,) or (4,) float64
        k1 k2 p1 p2 k3 k4 k5 k6, or a fisheye's k1 k2 k3 k4.
    is_fisheye : bool
        Which of the two.
    """

    matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    is_fisheye: bool


def refusal(camera: Camera, n_coefficients: int) -> str | None:
    """Return why a file with so many polynomial coefficients cannot hold a camera, or None."""
    if camera.skew_px:
        return f"a skew of {camera.skew_px:.3g} px, which OpenCV leaves out when it projects"
    if camera.model not in _POLYNOMIAL | _FISHEYE:
        return f"the lens model {camera.model}, which is none of OpenCV's"
    lens = opencv_lens(camera)
    if not lens.is_fisheye and lens.distortion[n_coefficients:].any():
        return f"a rational lens (k4, k5, k6), where only {n_coefficients} coefficients are read"
    return None


def opencv_lens(camera: Camera) -> OpencvLens:
    """Return the lens of a camera whose model is one of OpenCV's; see `refusal`."""
    is_fisheye = camera.model in _FISHEYE
    places = (_FISHEYE if is_fisheye else _POLYNOMIAL)[camera.model]
    distortion = np.zeros(4 if is_fisheye else 8)
    distortion[list(places)] = camera.params[len(camera.params) - len(places) :]
    matrix = camera.pinhole
    matrix[:2, 2] -= 0.5
    return OpencvLens(matrix, distortion, is_fisheye)


def opencv_camera(
    name: str,
    matrix: Any,
    distortion: Any,
    rotation: Any,
    translation: Any,
    *,
    is_fisheye: bool,
    size_px: tuple[int, int] | None,
    where: str,
    other_names: tuple[str, ...] = (),
) -> ForeignCamera:
    """Return a camera from what OpenCV's functions take, with the simplest COLMAP model it is.

    Raises
    ------
    CalibrationError
        If a shape is wrong, or no COLMAP model is this lens.
    """
    camera_matrix = as_numbers(matrix, "the camera matrix", where)
    if camera_matrix.shape != (3, 3) or not camera_matrix[2, 2]:
        raise CalibrationError(
            f"{where}: camera matrix of shape {camera_matrix.shape}, expected (3, 3)"
        )
    pose = as_pose(rotation, translation, where)
    below = camera_matrix[[1, 2, 2], [0, 0, 1]]
    if (np.abs(below) > _NO_ENTRY * np.abs(camera_matrix).max()).any():
        found = ", ".join(f"{value:g}" for value in below)
        raise CalibrationError(
            f"{where}: the camera matrix of {name!r} has {found} below its diagonal, expected "
            "zeros; is it transposed, as MATLAB writes it?"
        )
    camera_matrix = camera_matrix / camera_matrix[2, 2]
    fx, skew_px, cx = camera_matrix[0]
    fy, cy = camera_matrix[1, 1:]
    given = as_numbers(distortion, "the distortion", where).ravel()
    most = 4 if is_fisheye else _MOST_COEFFICIENTS
    if len(given) > most and given[most:].any():
        raise CalibrationError(
            f"{where}: {len(given)} distortion coefficients, expected up to {most}"
        )
    coefficients = np.zeros(_MOST_COEFFICIENTS)
    coefficients[: min(len(given), most)] = given[:most]
    k1, k2, p1, p2, k3 = coefficients[:5]
    if is_fisheye:
        model, lens = "OPENCV_FISHEYE", coefficients[:4]
    elif coefficients[8:].any():
        raise CalibrationError(
            f"{where}: thin prism and tilt distortion ({len(given)} coefficients) is no COLMAP "
            "model; calibrate without it"
        )
    elif coefficients[4:8].any():
        model, lens = "FULL_OPENCV", np.array([k1, k2, p1, p2, k3, *coefficients[5:8]])
    elif coefficients[:4].any():
        model, lens = "OPENCV", coefficients[:4]
    else:
        model, lens = "PINHOLE", coefficients[:0]
    if model != "PINHOLE" and abs(skew_px) > _NO_SKEW_PX:
        way = (
            "with CALIB_FIX_SKEW"
            if is_fisheye
            else "without skew, or write 0 there if the program that calibrated leaves it out, as "
            "OpenCV does"
        )
        raise CalibrationError(
            f"{where}: camera {name!r} has a skew of {skew_px:.3g} px (entry (1, 2) of its camera "
            f"matrix) together with distortion, which no COLMAP model holds; calibrate {way}"
        )
    return ForeignCamera(
        name,
        model,
        np.array([fx, fy, cx, cy, *lens]),
        pose,
        float(skew_px) if model == "PINHOLE" else 0.0,
        size_px,
        other_names,
    )
