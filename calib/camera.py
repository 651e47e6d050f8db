"""One fixed camera: a COLMAP lens model, its parameters and its pose.

Conventions of the whole project:

* Lengths are metres, angles radians, image coordinates pixels.
* The centre of the top-left pixel is (0.5, 0.5); x runs right, y runs down. The pixel that a
  point projects onto is the floor of its image coordinates.
* ``b_from_a`` maps coordinates in frame a to frame b: ``x_b = R @ x_a + t``.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import CalibrationError

#: How many parameters each COLMAP camera model has (COLMAP, sensor/models.h).
N_PARAMS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4,
    "DIVISION": 5,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EUCM": 6,
}

#: Models whose first parameter is one focal length for both axes.
_ONE_FOCAL_LENGTH = {
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "SIMPLE_DIVISION",
    "SIMPLE_FISHEYE",
}

#: Models without distortion: a straight line stays straight.
PINHOLE_MODELS = {"SIMPLE_PINHOLE", "PINHOLE"}

#: A rotation further than this from orthonormal was damaged, not rounded (largest entry of RR'-I).
_ORTHONORMAL_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)  # eq: comparing arrays has no single answer
class Camera:
    """One camera with a fixed pose.

    Attributes
    ----------
    name : str
        Unique within the rig.
    model : str
        A COLMAP camera model, a key of `N_PARAMS`.
    width_px, height_px : int
        Image size in pixels.
    params : (P,) float64
        The parameters of the model in COLMAP's order, pixel centre at 0.5.
    cam_from_world : (3, 4) float64
        Pose ``[R | t]`` with ``t`` in metres.
    skew_px : float
        Skew of a pinhole matrix that was calibrated elsewhere, in pixels; COLMAP's models have
        none, so it must be 0 for models with distortion.

    Raises
    ------
    CalibrationError
        If the model is unknown, or an array has the wrong shape or is not what it claims to be.
    """

    name: str
    model: str
    width_px: int
    height_px: int
    params: NDArray[np.float64]
    cam_from_world: NDArray[np.float64]
    skew_px: float = 0.0

    def __post_init__(self) -> None:
        if self.model not in N_PARAMS:
            known = ", ".join(N_PARAMS)
            raise CalibrationError(
                f"camera {self.name!r}: unknown camera model {self.model!r}; one of {known}"
            )
        if self.width_px <= 0 or self.height_px <= 0:
            raise CalibrationError(
                f"camera {self.name!r}: image size {self.width_px}x{self.height_px} is not positive"
            )
        for field, shape in (("params", (N_PARAMS[self.model],)), ("cam_from_world", (3, 4))):
            value = np.array(getattr(self, field), dtype=np.float64)  # a private copy
            if value.shape != shape or not np.isfinite(value).all():
                raise CalibrationError(
                    f"camera {self.name!r}: {field} has shape {value.shape}, expected {shape} "
                    "of finite numbers"
                )
            value.flags.writeable = False
            object.__setattr__(self, field, value)
        rotation = self.cam_from_world[:, :3]
        error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if error > _ORTHONORMAL_TOLERANCE or np.linalg.det(rotation) < 0:
            raise CalibrationError(
                f"camera {self.name!r}: cam_from_world is not a rotation and a translation "
                f"(error {error:.0e}); calibrate again"
            )
        if self.skew_px and self.model not in PINHOLE_MODELS:
            raise CalibrationError(f"camera {self.name!r}: model {self.model} takes no skew")

    @property
    def has_distortion(self) -> bool:
        """Whether straight lines bend in this camera's image."""
        return self.model not in PINHOLE_MODELS

    @property
    def pinhole(self) -> NDArray[np.float64]:
        """The (3, 3) camera matrix in pixels, distortion left out."""
        if self.model in _ONE_FOCAL_LENGTH:
            fx, cx, cy = self.params[:3]
            fy = fx
        else:
            fx, fy, cx, cy = self.params[:4]
        return np.array([[fx, self.skew_px, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def center_world(self) -> NDArray[np.float64]:
        """Where the camera stands: (3,) metres, world."""
        rotation, translation = self.cam_from_world[:, :3], self.cam_from_world[:, 3]
        return np.asarray(-rotation.T @ translation)
