"""Moving cameras on their trackers, beside the fixed ones of a rig."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from hybridve.calib.boards.board import Board, Observations
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.placing.fixed_cameras import Solved
from hybridve.calib.placing.hand_eye import mount_camera
from hybridve.calib.pose import Pose, compose
from hybridve.calib.record import MountRecord
from hybridve.calib.rig import Mount
from hybridve.calib.solving.lens_fit import FittedLens


@dataclass(frozen=True, slots=True, eq=False)
class Mounted:
    """A moving camera on its tracker."""

    camera: Camera
    mount: Mount
    told: MountRecord


def mount(
    boards: Sequence[Board],
    seen: Observations,
    lens: FittedLens,
    track: Mapping[int, Pose],
    solved: "Solved | None",
) -> Mounted:
    """Return a camera on its tracker, by the boards that fixed cameras saw lying still.

    Without fixed cameras the board that it sees most often is the world.

    Raises
    ------
    CalibrationError
        If no board lies still, or as `hybridve.calib.placing.hand_eye.mount_camera`.
    """
    world_from_board = None if solved is None else _still_boards(seen, solved)
    mount, told = mount_camera(lens.camera, boards, seen.sightings, track, world_from_board)
    # A moving camera stands in the rig where it was in the middle of its clip.
    middle = mount.cam_from_world(track[told.middle_instant])
    return Mounted(replace(lens.camera, cam_from_world=middle), mount, told)


def _still_boards(seen: Observations, solved: "Solved") -> dict[int, Pose]:
    """Return where the boards lie that were still in the clip of the fixed cameras."""
    bundle, keys = solved.adjusted.bundle, solved.linked.pose_keys
    moments = Counter(key.body for key in keys if key.moment.is_clip)
    found: dict[int, Pose] = {}
    for view in bundle.views:
        key = keys[view.pose]
        if key.moment.is_clip and moments[key.body] == 1:
            rig_from_board = compose(
                bundle.rig_from_body[view.pose], bundle.body_from_board[view.board]
            )
            found[view.board] = compose(solved.world_from_rig, rig_from_board)
    if not found:
        raise CalibrationError(
            f"camera {seen.name!r} moves: the board must lie still in the clips of all cameras, "
            "so that its place is known; record such a clip"
        )
    return found
