"""Where the trackers of moving cameras were, frame by frame of a session."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field

from hybridve.calib.errors import CalibrationError, SessionError
from hybridve.calib.formats.tracker import read_poses
from hybridve.calib.pose import Pose
from hybridve.calib.rig import Rig
from hybridve.hull.capture.session import Session


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """The tracked poses of a session's moving cameras; empty where all stand still.

    Attributes
    ----------
    poses : mapping of str to mapping of int to (3, 4) float64
        By camera and frame of the session tracking_from_tracker, metres.
    sha256 : mapping of str to str
        By camera the checksum of its file, for reports.
    """

    poses: Mapping[str, Mapping[int, Pose]] = field(default_factory=dict)
    sha256: Mapping[str, str] = field(default_factory=dict)

    def __bool__(self) -> bool:
        """Whether a camera moves."""
        return bool(self.poses)

    def missing(self, index: int) -> str:
        """Say which cameras have no tracked pose in a frame; "" if all have."""
        return "; ".join(
            f"no tracked pose of camera {name!r} in frame {index}"
            for name, poses in self.poses.items()
            if index not in poses
        )

    def at(self, index: int) -> dict[str, Pose]:
        """Return the pose of each tracker in a frame in which none is missing."""
        return {name: poses[index] for name, poses in self.poses.items()}

    @property
    def first(self) -> int | None:
        """The first frame in which no pose is missing; None if there is none, or nothing moves."""
        if not self.poses:
            return None
        return min(set.intersection(*map(set, self.poses.values())), default=None)


def read_tracks(session: Session, rig: Rig) -> Tracks:
    """Return the tracked poses that a session names for its recordings.

    A row is a frame of its camera's recording, which may have begun after the session did.

    Raises
    ------
    CalibrationError
        If the rig does not know where a tracked camera sits on its tracker, or a file of poses is
        wrong.
    SessionError
        If the rig says that a camera moves and the session does not say where to, or no frame has
        the poses of all.
    """
    poses: dict[str, dict[int, Pose]] = {}
    sha256: dict[str, str] = {}
    for number, camera in enumerate(session.cameras, start=1):
        is_mounted = camera.name in rig.mounts
        if camera.poses is None:
            if is_mounted:
                raise SessionError(
                    f"{session.path}: camera.{number} ({camera.name!r}) moves with a tracker, says "
                    "the rig, but has no poses; name the file of its tracked poses with poses ="
                )
            continue
        if not is_mounted:
            raise CalibrationError(
                f"{session.path}: camera.{number}.poses: the rig does not say where camera "
                f"{camera.name!r} sits on its tracker; calibrate it with extrinsics_poses, or name "
                "a rig.json with its mount"
            )
        poses[camera.name] = {
            frame + camera.shift_frames: pose for frame, pose in read_poses(camera.poses).items()
        }
        sha256[camera.name] = hashlib.sha256(camera.poses.read_bytes()).hexdigest()
    tracks = Tracks(poses, sha256)
    if tracks and tracks.first is None:
        raise SessionError(
            f"{session.path}: no frame has a tracked pose of all of {', '.join(poses)}; their "
            "files name frames of each camera's own recording, from 0"
        )
    return tracks
