"""Where a moving camera sits on its tracker, from boards that lie still and tracked poses.

For every picture the boards give cam_from_world and the tracker tracking_from_tracker; of the chain

    cam_from_world = cam_from_tracker . tracker_from_tracking . tracking_from_world

the first and the last part never change and are found here (robot-world/hand-eye calibration,
A X = Z B). In closed form first: the nine-by-nine sum of Kronecker products of the rotations has
both unknown rotations as its leading singular vectors, and the translations then are linear. Wrong
poses (a board seen turned over, a tracker that jumped) are found by trying triples of pictures.
Then all corners are adjusted at once, over the twelve unknowns.

What cannot be found is asked first, since the equations would answer anyhow: a tracker that turned
about one axis only says nothing of the offset along it (Tsai and Lenz 1989, lemma IV).

How far the answer can be trusted comes from leaving out one instant at a time: what a tracker gets
wrong is the same for all corners of a picture, and counting corners would hide it.

This work is based on: Shah, *Solving the robot-world/hand-eye calibration problem using the
Kronecker product*, J. Mechanisms and Robotics 5(3), 2013; Tsai and Lenz, *A new technique for fully
autonomous and efficient 3D robotics hand/eye calibration*, IEEE Trans. Robotics and Automation
5(3), 1989; MacKinnon and White, *Some heteroskedasticity-consistent covariance matrix estimators*,
J. Econometrics 29, 1985 (HC3, the jackknife).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Sighting
from hybridve.calib.camera import Camera
from hybridve.calib.placing.mount_fit import fit_mount, jacobian_of, residuals_of, rms_of
from hybridve.calib.placing.mounted_views import (
    LEAST_TO_LEAVE_OUT,
    SCALE,
    SCALE_SIGMAS,
    Floats,
    MountedView,
    check_motion,
    make_views,
    without_stuck,
    wrong_unit,
)
from hybridve.calib.pose import Pose
from hybridve.calib.record import MountRecord
from hybridve.calib.rig import Mount

#: The unknowns: both poses as in a rig's covariance, (omega, dt) on the left of each.
PARAMETERS = tuple(
    f"{pose} {name}"
    for pose in ("cam_from_tracker", "world_from_tracking")
    for name in ("rx", "ry", "rz", "tx", "ty", "tz")
)


def mount_camera(
    camera: Camera,
    boards: Sequence[Board],
    sightings: Sequence[Sighting],
    tracking_from_tracker: Mapping[int, Pose],
    world_from_board: Mapping[int, Pose] | None = None,
) -> tuple[Mount, MountRecord]:
    """Return where a camera sits on its tracker, and the tracker's world in ours.

    Parameters
    ----------
    camera : Camera
        Its lens is used and stays as it is; its pose is not used.
    boards : sequence of Board
        The session's boards.
    sightings : sequence of Sighting
        What the camera saw of them while it moved; those of no instant, or at an instant without a
        tracked pose, are left alone.
    tracking_from_tracker : mapping of int to (3, 4) float64
        The tracked poses by instant, metres.
    world_from_board : mapping of int to (3, 4) float64, optional
        By number the boards that lie still, and where. By default the board that was seen most
        often is the world.

    Returns
    -------
    mount : Mount
        Both fixed poses.
    told : MountRecord
        How that was found, and how sure it is, what the tracker gets wrong included.

    Raises
    ------
    CalibrationError
        One line that says what is wrong with the recording and what to record: too few instants, a
        tracker that is stuck, did not turn, or turned about one axis only, poses in another unit
        or inverted, or poses that do not belong to the pictures.
    """
    if world_from_board is None:
        numbers = [one.board for one in sightings if one.instant in tracking_from_tracker]
        # The smallest number where several were seen equally often.
        most = min(set(numbers), key=lambda number: (-numbers.count(number), number), default=0)
        world_from_board = {most: np.eye(3, 4)}
    views, missed, untracked = make_views(
        camera, boards, sightings, tracking_from_tracker, world_from_board
    )
    views, stuck = without_stuck(views)
    turn_deg = check_motion(camera, views, len(untracked), bool(stuck))
    views, chosen, fit = fit_mount(camera, views)
    missed |= stuck | {
        view.image: f"{rms_px:.2f} px rms, the median is {fit.median_px:.2f} px"
        for view, rms_px, is_used in zip(views, fit.rms_px, fit.used, strict=True)
        if not is_used
    }
    used = [view for view, is_used in zip(views, fit.used, strict=True) if is_used]
    instants = sorted({view.instant for view in used})
    sure = _uncertainty(camera, used, fit.mount)
    if abs(sure.scale - 1.0) > max(SCALE, SCALE_SIGMAS * sure.scale_std):
        raise wrong_unit(camera, sure.scale)
    deviation = np.sqrt(np.diag(sure.covariance))
    return fit.mount, MountRecord(
        instants=len(instants),
        middle_instant=instants[len(instants) // 2],
        views=len(used),
        looks_turned=sum(view.look != 0 for view in used),
        untracked=tuple(untracked),
        dropped=missed,
        rms_px=rms_of(residuals_of(camera, used, fit.mount)),
        closed_form_rms_px=rms_of(residuals_of(camera, used, chosen)),
        turn_deg=tuple(turn_deg),
        tracker_scale=sure.scale,
        tracker_scale_std=sure.scale_std,
        parameters=PARAMETERS,
        covariance=_rows(sure.covariance),
        covariance_from=sure.covariance_from,
        offset_std_mm=float(1e3 * np.linalg.norm(deviation[3:6])),
        offset_std_deg=float(np.rad2deg(np.linalg.norm(deviation[:3]))),
        pose_covariance=_rows(sure.pose_covariance),
    )


def _rows(matrix: Floats) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in matrix.tolist())


@dataclass(frozen=True, slots=True, eq=False)
class _Uncertainty:
    """How sure a mount is.

    Attributes
    ----------
    scale, scale_std : float
        The tracker's unit in metres as the pictures show it, and its standard deviation.
    covariance : (12, 12) float64
        Of the mount, in the order of `PARAMETERS`.
    covariance_from : str
        "instants left out" or "corners".
    pose_covariance : (6, 6) float64
        Of cam_from_world at one instant, in the form of a rig's covariance.
    """

    scale: float
    scale_std: float
    covariance: Floats
    covariance_from: str
    pose_covariance: Floats


def _uncertainty(camera: Camera, views: list[MountedView], mount: Mount) -> _Uncertainty:
    """Return how sure a mount is by the views it was fitted to."""
    residuals = residuals_of(camera, views, mount).ravel()
    rows = jacobian_of(camera, views, mount)
    instants = np.unique(rows.instant)
    n_instants = len(instants)
    jacobian = np.column_stack([rows.parameters, rows.scale])
    of_all, is_known = _left_out(jacobian[:, :12], residuals, rows.instant)
    # The scale on top of them all: what it would become, and how sure that is.
    step = np.linalg.lstsq(jacobian / _lengths(jacobian), residuals)[0] / _lengths(jacobian)
    with_scale, _ = _left_out(jacobian, residuals - jacobian @ step, rows.instant)
    # What each instant's pose is off, by its own corners; and what the mount may be off.
    errors = np.zeros((6, 6))
    by_corners = np.zeros((6, 6))
    unexplained = 0.0
    of_mount = np.zeros((6, 6))
    for instant in instants:
        mine = rows.instant == instant
        lengths = _lengths(rows.pose[mine])
        inverse = np.linalg.pinv(rows.pose[mine] / lengths, rcond=1e-9) / lengths[:, None]
        off = inverse @ residuals[mine]
        unexplained += float(((residuals[mine] - rows.pose[mine] @ off) ** 2).sum())
        errors += np.outer(off, off) / max(n_instants - 2, 1)
        by_corners += inverse @ inverse.T / n_instants
        by_mount = inverse @ rows.parameters[mine]
        of_mount += by_mount @ of_all @ by_mount.T / n_instants
    # Corners are off by themselves, which says nothing of the tracker.
    variance_px2 = unexplained / max(len(residuals) - 6 * n_instants, 1)
    pose_covariance = of_mount + _at_least_zero(errors - variance_px2 * by_corners)
    return _Uncertainty(
        float(1.0 + step[12]),
        float(np.sqrt(with_scale[12, 12])),
        of_all,
        "instants left out" if is_known else "corners",
        pose_covariance,
    )


def _at_least_zero(matrix: Floats) -> Floats:
    """Return the part of a symmetric matrix that is a covariance; its units may differ."""
    lengths = np.sqrt(np.abs(np.diag(matrix)))
    lengths = np.where(lengths > 0, lengths, 1.0)
    values, vectors = np.linalg.eigh(matrix / np.outer(lengths, lengths))
    kept = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(kept * np.outer(lengths, lengths))


def _left_out(
    jacobian: Floats, residuals: Floats, instant: NDArray[np.int64]
) -> tuple[Floats, bool]:
    """Return the covariance (P, P) of a fit by leaving out one instant at a time.

    With few instants it comes from the corners as if each erred by itself; the second value says
    which it is.
    """
    lengths = _lengths(jacobian)
    scaled = jacobian / lengths
    normal = scaled.T @ scaled
    numbers = np.unique(instant)
    count = len(numbers)
    if count >= LEAST_TO_LEAVE_OUT:
        covariance = np.zeros_like(normal)
        for number in numbers:
            mine = instant == number
            rest = normal - scaled[mine].T @ scaled[mine]
            change = np.linalg.lstsq(rest, scaled[mine].T @ residuals[mine])[0]
            covariance += np.outer(change, change)
        covariance *= (count - 1) / count
    else:
        free = max(len(residuals) - len(normal), 1)
        covariance = np.linalg.pinv(normal) * float(residuals @ residuals) / free
    covariance = 0.5 * (covariance + covariance.T)
    return covariance / np.outer(lengths, lengths), count >= LEAST_TO_LEAVE_OUT


def _lengths(columns: Floats) -> Floats:
    lengths = np.linalg.norm(columns, axis=0)
    return np.where(lengths > 0, lengths, 1.0)
