"""A rig: the cameras of one session in one world frame."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Cameras in one world frame, metres, and where their numbers come from.

    Attributes
    ----------
    cameras : tuple of Camera
        At least one; names are unique.
    provenance : dict
        What made the rig, as plain JSON values: the method, its inputs, and reprojection errors
        per camera. Written into rig.json and the report as it stands.

    Raises
    ------
    CalibrationError
        If there is no camera, or two have the same name.
    """

    cameras: tuple[Camera, ...]
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.cameras:
            raise CalibrationError("the rig has no camera; expected at least one")
        names = [camera.name for camera in self.cameras]
        for name in names:
            if names.count(name) > 1:
                raise CalibrationError(
                    f"camera {name!r} stands in the rig {names.count(name)} times"
                )

    def __getitem__(self, name: str) -> Camera:
        """Return the camera called `name`."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        known = ", ".join(camera.name for camera in self.cameras)
        raise CalibrationError(f"the rig has no camera {name!r}; it has {known}")

    @property
    def centers_world(self) -> NDArray[np.float64]:
        """Where the cameras stand: (C, 3) metres."""
        return np.array([camera.center_world for camera in self.cameras])
