"""The rig that a calibration of a drawn rig would leave: the true cameras, with their covariance.

The covariance is that of the joint adjustment (`hybridve.calib.solving`) at the truth: what boards
seen so, with corners as noisy as the plan says, tell of lenses and places. A real calibration is
worse where a lens model does not fit, a board is bent or a picture blurred, and says so.
"""

from dataclasses import dataclass

import numpy as np

from hybridve.calib.errors import CalibrationError
from hybridve.calib.pose import Pose, compose, invert
from hybridve.calib.provenance import MadeElsewhere
from hybridve.calib.rig import Rig
from hybridve.calib.solving.bundle import Bundle, BundleView, adjust
from hybridve.calib.solving.covariance import rig_covariance
from hybridve.hull.plan.drawing import Drawing, moved_boards, pixels_of, stills_of
from hybridve.hull.plan.tables import CalibrationTable


@dataclass(frozen=True, slots=True, eq=False)
class DrawnCalibration:
    """What a drawn calibration leaves.

    Attributes
    ----------
    rig : Rig
        The cameras that are placed, with their covariance.
    not_placed : tuple of str
        Cameras that see the board in no picture that another sees it in.
    """

    rig: Rig
    not_placed: tuple[str, ...]


def calibrate_drawing(drawing: Drawing, asked: CalibrationTable) -> DrawnCalibration:
    """Return the rig that boards seen as a plan says would give.

    Raises
    ------
    CalibrationError
        If fewer than two cameras can be placed.
    """
    boards = [drawing.world_from_board, *moved_boards(drawing, asked.moved)]
    seen = [
        [
            pixels_of(camera, drawing.board, pose, is_on_floor=number == 0)
            for number, pose in enumerate(boards)
        ]
        for camera in drawing.cameras
    ]
    placed = _placed(np.array([[pixels is not None for pixels in own] for own in seen]))
    names = tuple(camera.name for camera in drawing.cameras)
    not_placed = tuple(name for index, name in enumerate(names) if index not in placed)
    if len(placed) < 2:
        raise CalibrationError(
            f"the board on the floor is wholly seen by {len(placed)} of {len(names)} cameras, "
            "expected two at least: move it (calibration.lies_at_m), print it larger or smaller, "
            "or have it carried about (calibration.moved)"
        )
    poses: list[Pose] = list(boards)
    views = []
    for number, index in enumerate(placed):
        camera = drawing.cameras[index]
        world_from_cam = invert(camera.cam_from_world)
        for still in stills_of(camera, drawing.board, asked.stills, index):
            pose = compose(world_from_cam, still)
            pixels = pixels_of(camera, drawing.board, pose)
            assert pixels is not None
            views.append(BundleView(number, len(poses), 0, pixels, "still", asked.corner_px))
            poses.append(pose)
        for pose_number, pixels in enumerate(seen[index]):
            if pixels is not None:
                views.append(BundleView(number, pose_number, 0, pixels, "board", asked.corner_px))
    used = sorted({0} | {view.pose for view in views})
    rank = {pose: place for place, pose in enumerate(used)}
    cameras = tuple(drawing.cameras[index] for index in placed)
    bundle = Bundle(
        points_board=(drawing.board.points_board,),
        cameras=cameras,
        rig_from_body=tuple(poses[pose] for pose in used),
        body_from_board=(np.eye(3, 4),),
        views=tuple(
            BundleView(
                view.camera, rank[view.pose], view.board, view.pixels, view.image, view.sigma_px
            )
            for view in views
        ),
        held_pose=0,
        lens_of=tuple(range(len(cameras))),
        fixed_lenses=frozenset(),
        held_boards=frozenset({0}),
    )
    rig = Rig(
        cameras, MadeElsewhere({"method": "drawn"}), rig_covariance(adjust(bundle), sigma_px=1.0)
    )
    return DrawnCalibration(rig, not_placed)


def _placed(sees: np.ndarray) -> list[int]:
    """Return the cameras that boards link to the one on the floor, (C, boards) bool."""
    linked = set(np.flatnonzero(sees[:, 0]).tolist())
    while True:
        shared = sees[sorted(linked)].any(axis=0) if linked else np.zeros(sees.shape[1], bool)
        more = set(np.flatnonzero((sees & shared).any(axis=1)).tolist())
        if more <= linked:
            return sorted(linked)
        linked |= more
