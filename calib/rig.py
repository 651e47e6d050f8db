"""A rig: the cameras of one session in one world frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.pose import Pose, compose, invert
from hybridve.calib.provenance import MadeElsewhere, Provenance
from hybridve.calib.verdict import RigTest

#: The names of a camera's pose parameters, in the order in which a covariance has them.
POSE_PARAMETERS = ("rx", "ry", "rz", "tx", "ty", "tz")

#: A rotation further than this from orthonormal was damaged, not rounded (largest entry of RR'-I).
_ORTHONORMAL_TOLERANCE = 1e-6

#: A covariance further than this from symmetric, relative to the variances, was damaged.
_SYMMETRIC_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class RigCovariance:
    """What is known about the errors of a rig's parameters.

    Camera by camera in the rig's order: six pose parameters, then the lens in COLMAP's order. The
    pose's are (omega, v) in the camera's frame, radians and metres: a point that the pose leads to
    x is, to first order, at ``x + omega x x + v``. Lenses that cameras share are repeated, fully
    correlated; what was given and not estimated has variance zero.

    Attributes
    ----------
    labels : tuple of str
        One a parameter: the camera's name, a blank, and the parameter ("cam1 rx", "cam1 fx").
    matrix : (P, P) float64
        The covariance, in the labels' order.

    Raises
    ------
    CalibrationError
        If the matrix has another shape than the labels ask for, or is not symmetric and finite
        with variances of at least zero.
    """

    labels: tuple[str, ...]
    matrix: NDArray[np.float64]

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, dtype=np.float64)  # a private copy
        count = len(self.labels)
        if matrix.shape != (count, count) or not np.isfinite(matrix).all():
            raise CalibrationError(
                f"the rig's covariance has shape {matrix.shape}, expected {(count, count)} of "
                f"finite numbers for its {count} labels"
            )
        variances = np.diag(matrix)
        if (variances < 0).any():
            raise CalibrationError(
                f"the rig's covariance: {self.labels[int(variances.argmin())]!r} has the variance "
                f"{variances.min():.3g}, expected at least 0"
            )
        # Each entry against the two deviations that it couples: units differ along the diagonal.
        deviations = np.sqrt(variances)
        allowed = _SYMMETRIC_TOLERANCE * np.outer(deviations, deviations)
        if (np.abs(matrix - matrix.T) > allowed).any():
            raise CalibrationError("the rig's covariance is not symmetric")
        matrix.flags.writeable = False
        object.__setattr__(self, "labels", tuple(self.labels))
        object.__setattr__(self, "matrix", matrix)


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """Where a moving camera sits on its tracker, and where the tracker's own world stands in ours.

    Attributes
    ----------
    cam_from_tracker : (3, 4) float64
        From the frame of the tracked body to the camera's, metres.
    world_from_tracking : (3, 4) float64
        From the frame that the tracker reports poses in to the rig's world, metres.

    Raises
    ------
    CalibrationError
        If one of them is not a rotation and a translation.
    """

    cam_from_tracker: Pose
    world_from_tracking: Pose

    def __post_init__(self) -> None:
        for name in ("cam_from_tracker", "world_from_tracking"):
            pose = np.array(getattr(self, name), dtype=np.float64)  # a private copy
            if pose.shape != (3, 4) or not np.isfinite(pose).all():
                raise CalibrationError(
                    f"a mount's {name} has shape {pose.shape}, expected (3, 4) of finite numbers"
                )
            rotation = pose[:, :3]
            error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
            if error > _ORTHONORMAL_TOLERANCE or np.linalg.det(rotation) < 0:
                raise CalibrationError(
                    f"a mount's {name} is not a rotation and a translation (error {error:.0e})"
                )
            pose.flags.writeable = False
            object.__setattr__(self, name, pose)

    def cam_from_world(self, tracking_from_tracker: Pose) -> Pose:
        """Return the camera's pose (3, 4) while the tracker reports `tracking_from_tracker`."""
        cam_from_tracking = compose(self.cam_from_tracker, invert(tracking_from_tracker))
        return compose(cam_from_tracking, invert(self.world_from_tracking))


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Cameras in one world frame, metres, and where their numbers come from.

    Attributes
    ----------
    cameras : tuple of Camera
        At least one; names are unique.
    provenance : CalibrationRecord or MadeElsewhere
        What made the rig: what its calibration by this program decided and doubted, or that it was
        made elsewhere, of which nothing is known. Written into rig.json and the report.
    covariance : RigCovariance or None
        How far the parameters can be trusted; None where nobody knows.
    mounts : mapping of str to Mount
        The cameras that move with a tracker. Their `cam_from_world` is that of one moment only;
        `at` gives that of another.
    check : RigTest or None
        What the boards of the session that uses it say of it; None where nobody asked. Written
        into rig.json and the report, with the provenance.

    Raises
    ------
    CalibrationError
        If there is no camera, or two have the same name, or the covariance is not that of these
        cameras, or a mount that of none.
    """

    cameras: tuple[Camera, ...]
    provenance: Provenance = field(default_factory=MadeElsewhere)
    covariance: RigCovariance | None = None
    mounts: Mapping[str, Mount] = field(default_factory=dict)
    check: RigTest | None = None

    def __post_init__(self) -> None:
        if not self.cameras:
            raise CalibrationError("the rig has no camera; expected at least one")
        names = [camera.name for camera in self.cameras]
        for name in names:
            if names.count(name) > 1:
                raise CalibrationError(
                    f"camera {name!r} stands in the rig {names.count(name)} times"
                )
        for name in self.mounts:
            if name not in names:
                raise CalibrationError(
                    f"the rig has a mount for {name!r}, but its cameras are {', '.join(names)}"
                )
        object.__setattr__(self, "mounts", dict(self.mounts))  # a private copy
        if self.covariance is not None:
            owners = [label.rpartition(" ")[0] for label in self.covariance.labels]
            expected = [
                camera.name for camera in self.cameras for _ in range(_n_parameters(camera))
            ]
            if owners != expected:
                wanted = ", ".join(f"{c.name} {_n_parameters(c)}" for c in self.cameras)
                raise CalibrationError(
                    "the rig's covariance is not that of its cameras; expected, in this order, "
                    f"so many parameters a camera: {wanted}"
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

    def only(self, names: Sequence[str]) -> "Rig":
        """Return the rig of the cameras `names`, in that order, with what is known about them.

        Raises
        ------
        CalibrationError
            If the rig lacks one of them, or one is named twice.
        """
        cameras = tuple(self[name] for name in names)
        covariance = self.covariance
        if covariance is not None:
            starts = np.cumsum([0, *(_n_parameters(camera) for camera in self.cameras)])
            rows_of = {
                camera.name: np.arange(start, start + _n_parameters(camera))
                for camera, start in zip(self.cameras, starts[:-1], strict=True)
            }
            rows = np.concatenate([rows_of[name] for name in names]) if names else np.arange(0)
            covariance = RigCovariance(
                tuple(covariance.labels[row] for row in rows), covariance.matrix[np.ix_(rows, rows)]
            )
        mounts = {name: mount for name, mount in self.mounts.items() if name in names}
        return replace(self, cameras=cameras, covariance=covariance, mounts=mounts)

    def at(self, tracking_from_tracker: Mapping[str, Pose]) -> "Rig":
        """Return the rig with moving cameras where their trackers report them to be.

        The covariance stays: its pose errors are in the camera's own frame, and what is uncertain
        about the place on the tracker moves with the camera.

        Parameters
        ----------
        tracking_from_tracker : mapping of str to (3, 4) float64
            For each camera to move, its tracker's pose, metres.

        Raises
        ------
        CalibrationError
            If a camera has no mount.
        """
        for name in tracking_from_tracker:
            if name not in self.mounts:
                known = ", ".join(self.mounts) or "none"
                raise CalibrationError(
                    f"camera {name!r} has no mount on a tracker; the rig's mounted cameras: {known}"
                )
        cameras = tuple(
            replace(
                camera,
                cam_from_world=self.mounts[camera.name].cam_from_world(
                    tracking_from_tracker[camera.name]
                ),
            )
            if camera.name in tracking_from_tracker
            else camera
            for camera in self.cameras
        )
        return replace(self, cameras=cameras)


def _n_parameters(camera: Camera) -> int:
    """Return how many rows of a covariance are this camera's."""
    return len(POSE_PARAMETERS) + len(camera.params)
