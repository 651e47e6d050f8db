"""What a mounted camera saw of boards at the instants at which its mount was tracked."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Sighting
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.pose import (
    Pose,
    angle_between,
    compose,
    invert,
    nearest_rotation,
    rotation_vector,
)
from hybridve.calib.solving.locate import locate_board

Floats = NDArray[np.float64]

#: Instants without which nothing is begun, and without which leaving one out says nothing.
LEAST_INSTANTS = 3
LEAST_TO_LEAVE_OUT = 6

#: A tracker that turns less than this about an axis (rms, degrees) did not turn: an offset would
#: be known no better than the tracker's position times its inverse.
_LEAST_TURN_DEG = 1.0

#: A tracker that moves less than this (rad, metres) while the camera moves more than that is stuck.
_STUCK = 1e-6
_MOVED_RAD, _MOVED_M = 0.02, 0.01

#: Poses and pictures do not belong together if the median picture is missed by more than this
#: share of the image's width; another reading of the poses is the right one if it fits this many
#: times better.
MISSED, FITS_BETTER = 0.02, 4.0

#: The tracker's unit is wrong if its lengths are off by more than this share, and so many sigmas.
SCALE, SCALE_SIGMAS = 0.05, 5.0

_UNITS = {0.001: "millimetres", 0.01: "centimetres", 0.0254: "inches", 0.3048: "feet"}


@dataclass(frozen=True, slots=True, eq=False)
class MountedView:
    """One board in one picture, the corners that were seen.

    Attributes
    ----------
    instant, image, board
        Of the sighting.
    points_world : (N, 3) float64
        Its corners in metres.
    listings : (L, N, 2) float64
        Their pixels in all orders that the board's looks allow, NaN where unseen.
    look : int
        The listing that holds.
    poses : sequence of L (3, 4) float64
        Where the camera was under each listing: cam_from_world, by this picture alone.
    tracking_from_tracker : (3, 4) float64
        Where the tracker was.
    """

    instant: int
    image: str
    board: int
    points_world: Floats
    listings: Floats
    look: int
    poses: Sequence[Pose]
    tracking_from_tracker: Pose

    @property
    def pixels(self) -> Floats:
        """The corners (N, 2), pixels; NaN where unseen."""
        return np.asarray(self.listings[self.look])

    @property
    def cam_from_world(self) -> Pose:
        """Where the camera was (3, 4), by this picture alone."""
        return self.poses[self.look]


def make_views(
    camera: Camera,
    boards: Sequence[Board],
    sightings: Sequence[Sighting],
    tracking_from_tracker: Mapping[int, Pose],
    world_from_board: Mapping[int, Pose],
) -> tuple[list[MountedView], dict[str, str], list[int]]:
    """Return what can be used in a fixed order, what cannot and why, and instants not tracked."""
    views, missed, untracked = [], {}, set()
    for seen in sightings:
        if seen.instant is None or seen.board not in world_from_board:
            continue
        if seen.instant not in tracking_from_tracker:
            untracked.add(seen.instant)
            continue
        board, pose = boards[seen.board], world_from_board[seen.board]
        found = locate_board(camera, board.points_board, seen.pixels)
        if found is None:
            missed[seen.image] = "the board cannot be located"
            continue
        views.append(
            MountedView(
                seen.instant,
                seen.image,
                seen.board,
                board.points_board @ pose[:, :3].T + pose[:, 3],
                np.array([seen.pixels[look] for look in board.looks]),
                0,
                [
                    compose(compose(found[0], board.board_from_turned(look)), invert(pose))
                    for look in range(len(board.looks))
                ],
                tracking_from_tracker[seen.instant],
            )
        )
    views.sort(key=lambda view: (view.instant, view.board, view.image))
    return views, missed, sorted(untracked)


def without_stuck(views: list[MountedView]) -> tuple[list[MountedView], dict[str, str]]:
    """Return views without those at which the tracker repeated itself and the camera had moved."""
    kept: list[MountedView] = []
    stuck: dict[str, str] = {}
    for view in views:
        # The first of a run may be right, so it is the one that stays.
        last = kept[-1] if kept else None
        if (
            last is not None
            and last.instant != view.instant
            and not _differ(last.tracking_from_tracker, view.tracking_from_tracker, _STUCK, _STUCK)
            and _differ(last.cam_from_world, view.cam_from_world, _MOVED_RAD, _MOVED_M)
        ):
            stuck[view.image] = f"the tracker reports the pose of instant {last.instant} again"
        else:
            kept.append(view)
    return kept, stuck


def _differ(first: Pose, second: Pose, angle_rad: float, distance_m: float) -> bool:
    apart_m = np.linalg.norm(invert(first)[:, 3] - invert(second)[:, 3])
    return bool(angle_between(first, second) > angle_rad or apart_m > distance_m)


def check_motion(
    camera: Camera, views: list[MountedView], n_untracked: int, was_stuck: bool
) -> list[float]:
    """Return how far the tracker turned about three axes, rms in degrees, most first.

    Raises
    ------
    CalibrationError
        If that does not determine a mount.
    """
    poses = {view.instant: view.tracking_from_tracker for view in views}
    name = f"camera {camera.name!r}"
    advice = (
        "record still boards from 20 or more places, and turn the camera by 20 degrees or more "
        "about two of its axes at least (nod, shake, tilt)"
    )
    if len(poses) < LEAST_INSTANTS:
        if was_stuck:
            raise CalibrationError(
                f"{name}: its tracker is stuck: it reports one pose while the camera moves; look "
                "at the tracker, and record again"
            )
        lost = f" ({n_untracked} more without a tracked pose)" if n_untracked else ""
        raise CalibrationError(
            f"{name}: {len(poses)} instants with both a board and a tracked pose{lost}, expected "
            f"{LEAST_INSTANTS} or more; {advice}"
        )
    rotations = np.array(list(poses.values()))[:, :, :3]
    mean = nearest_rotation(rotations.sum(axis=0))
    turns = rotation_vector(mean.T @ rotations)
    _, spread, axes = np.linalg.svd(np.rad2deg(turns), full_matrices=False)
    turn_deg = [float(value) for value in spread / np.sqrt(len(turns))]
    if turn_deg[0] < _LEAST_TURN_DEG:
        positions = np.array(list(poses.values()))[:, :, 3]
        did = "only moved straight" if np.ptp(positions, axis=0).max() > _MOVED_M else "stood still"
        raise CalibrationError(
            f"{name}: its tracker {did} ({turn_deg[0]:.1f} degrees of turning, rms): where the "
            f"camera sits on it cannot be found; {advice}"
        )
    if turn_deg[1] < _LEAST_TURN_DEG:
        axis = axes[0] * np.sign(axes[0][np.abs(axes[0]).argmax()])
        raise CalibrationError(
            f"{name}: its tracker turned about one axis only, ({axis[0]:.2f}, {axis[1]:.2f}, "
            f"{axis[2]:.2f}) of its own frame: the camera's offset along that axis cannot be "
            f"found; {advice}"
        )
    return turn_deg


def wrong_unit(camera: Camera, scale: float) -> CalibrationError:
    """Return the error that lengths of the tracker are off by `scale`, with the unit it may be."""
    unit = next((name for size, name in _UNITS.items() if abs(scale / size - 1.0) < 0.1), None)
    found = f"they look like {unit}" if unit else "check the board's squares, or the tracker"
    return CalibrationError(
        f"camera {camera.name!r}: the lengths of its tracked poses have to be multiplied by "
        f"{scale:.4g} to fit the board, expected 1: poses are in metres; {found}"
    )
