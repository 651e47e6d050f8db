"""Whether a rig agrees with pictures of boards.

Boards of known squares tell the scale of a rig, and which camera stands elsewhere than the rig
says.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.board import Board, Sighting, is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import project_points
from hybridve.calib.lens_fit import locate_board, rms
from hybridve.calib.pose import Pose, compose, invert, transform
from hybridve.calib.rig import Rig

#: A board clip contradicts a rig beyond these: the rig's scale by more than 5 % (independent
#: careful calibrations of one recording differ by up to 4 %), or its corners by more than 1 % of
#: the image's width.
SCALE_TOLERANCE = 0.05
REPROJECTION_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class RigCheck:
    """What a board clip says of a rig.

    Attributes
    ----------
    scale : float
        How many times too large the rig is: the board's squares as the rig measures them, by the
        squares as they are. NaN where it cannot be told (fewer than two cameras).
    pair_scales : dict of str to float
        The same from the distance of each two cameras alone, "cam1 cam2"; they differ where the
        rig is wrong by more than its scale.
    rms_px : dict of str to float
        How far corners lie from where the rig, at the scale found, says: per camera, pixels.
    odd_camera : str or None
        The camera without which the others agree.
    is_trustworthy : bool
        Whether scale and corners are within tolerance.
    message : str
        The verdict in one line.
    """

    scale: float
    pair_scales: dict[str, float]
    rms_px: dict[str, float]
    odd_camera: str | None
    is_trustworthy: bool
    message: str


def check_rig(
    rig: Rig, boards: Sequence[Board], sightings: Mapping[str, Sequence[Sighting]]
) -> RigCheck:
    """Check a rig against boards that several of its cameras saw at once.

    The board is placed in the rig's world by position, orientation and size, so that its corners
    are reprojected best: the size tells the rig's scale, what remains tells whether the cameras
    agree with one another. Which way round a symmetric board was seen follows from the rig.

    Parameters
    ----------
    rig : Rig
        The rig to be checked.
    boards : sequence of Board
        The boards, with their true squares; `Sighting.board` counts them.
    sightings : mapping of str to sequence of Sighting
        By camera what it saw of them; what was seen at no common instant is not used.

    Raises
    ------
    CalibrationError
        If fewer than two cameras of the rig see the board.
    """
    placed: dict[tuple[int, int], dict[str, NDArray[np.float64]]] = {}
    for name, seen in sightings.items():
        for sighting in seen:
            if sighting.instant is not None and is_seen(sighting.pixels).sum() >= 4:
                key = (sighting.instant, sighting.board)
                placed.setdefault(key, {})[name] = sighting.pixels
    best = max(sorted(placed), key=lambda key: len(placed[key]), default=None)
    extrinsic_corners = placed[best] if best is not None else {}
    board = boards[best[1] if best is not None else 0]
    names = [camera.name for camera in rig.cameras if camera.name in extrinsic_corners]
    if len(names) < 2:
        raise CalibrationError(
            f"the rig cannot be checked: {len(names)} of its cameras see the board, expected two "
            f"or more (rig: {', '.join(camera.name for camera in rig.cameras)}; board: "
            f"{', '.join(sorted(extrinsic_corners)) or 'none'})"
        )
    cameras = [rig[name] for name in names]
    poses = []
    for camera in cameras:
        located = locate_board(camera, board.points_board, extrinsic_corners[camera.name])
        if located is None:
            raise CalibrationError(
                f"camera {camera.name!r}: its lens cannot have seen the board's corners; "
                "check the image size and the unit of its parameters"
            )
        poses.append(located[0])
    looks = _looks_by_rig(cameras, poses, board)
    poses = [
        compose(pose, board.board_from_turned(look))
        for pose, look in zip(poses, looks, strict=True)
    ]
    corners = [
        extrinsic_corners[name][board.looks[look]] for name, look in zip(names, looks, strict=True)
    ]
    pair_scales = _pair_scales(cameras, poses)
    scale = float(np.median(list(pair_scales.values())))
    scale, residuals = _fit_board(cameras, poses, corners, board, scale)
    rms_px = {name: rms(residual) for name, residual in zip(names, residuals, strict=True)}
    odd_camera = None
    limits = {camera.name: REPROJECTION_TOLERANCE * camera.width_px for camera in cameras}
    agree = all(rms_px[name] <= limits[name] for name in names)
    if not agree and len(names) > 2:
        odd_camera = _odd_one_out(cameras, poses, corners, board, scale, limits)
    is_scaled = abs(scale - 1.0) > SCALE_TOLERANCE
    return RigCheck(
        scale,
        pair_scales,
        rms_px,
        odd_camera,
        agree and not is_scaled,
        _verdict(board, scale, pair_scales, rms_px, odd_camera, agree, is_scaled),
    )


def _verdict(
    board: Board,
    scale: float,
    pair_scales: dict[str, float],
    rms_px: dict[str, float],
    odd_camera: str | None,
    agree: bool,
    is_scaled: bool,
) -> str:
    measured = (
        f"the board's squares measure {scale * board.square_m * 1000:.1f} mm in the rig, "
        f"{board.square_m * 1000:g} mm in truth: scale {scale:.3f} "
        f"(by pairs of cameras {min(pair_scales.values()):.3f} to {max(pair_scales.values()):.3f})"
    )
    worst = max(rms_px, key=lambda name: rms_px[name])
    missed = f"its corners are missed by {max(rms_px.values()):.1f} px in camera {worst!r}"
    if odd_camera is not None:
        return (
            f"camera {odd_camera!r} stands elsewhere than the rig says; without it the others "
            f"agree; {measured}; calibrate again"
        )
    if is_scaled:
        return f"{measured}; {missed}; check the rig's unit, or calibrate again"
    if not agree:
        return f"the cameras disagree: {missed}; {measured}; calibrate again"
    return f"{measured}; {missed}: the rig agrees with the board"


def _looks_by_rig(cameras: Sequence[Camera], poses: Sequence[Pose], board: Board) -> list[int]:
    """Return for each camera the look under which its board agrees with the first one's.

    Orientation decides: it does not depend on the rig's scale.
    """
    first = invert(cameras[0].cam_from_world)[:, :3] @ poses[0][:, :3]  # world_from_board
    looks = []
    for camera, pose in zip(cameras, poses, strict=True):
        agreement = [
            float(
                np.trace(
                    first.T
                    @ invert(camera.cam_from_world)[:, :3]
                    @ compose(pose, board.board_from_turned(look))[:, :3]
                )
            )
            for look in range(len(board.looks))
        ]
        looks.append(int(np.argmax(agreement)))
    return looks


def _pair_scales(cameras: Sequence[Camera], poses: Sequence[Pose]) -> dict[str, float]:
    scales = {}
    for i, first in enumerate(cameras):
        for j in range(i + 1, len(cameras)):
            in_rig = float(np.linalg.norm(first.center_world - cameras[j].center_world))
            by_board = float(np.linalg.norm(invert(poses[i])[:, 3] - invert(poses[j])[:, 3]))
            scales[f"{first.name} {cameras[j].name}"] = in_rig / max(by_board, 1e-12)
    return scales


def _fit_board(
    cameras: Sequence[Camera],
    poses: Sequence[Pose],
    corners: Sequence[NDArray[np.float64]],
    board: Board,
    scale: float,
) -> tuple[float, list[NDArray[np.float64]]]:
    """Place the board in the world with its size free; return the size and residuals, pixels."""
    points = board.points_board - board.center_board

    def residuals(
        rotation: NDArray[np.float64], center: NDArray[np.float64], size: float
    ) -> list[NDArray[np.float64]]:
        placed = size * points @ rotation.T + center
        found = []
        for camera, pixels in zip(cameras, corners, strict=True):
            projected, _ = project_points(camera, placed)
            # A corner behind a camera misses by more than the image.
            missed = np.where(np.isfinite(projected), projected, 10.0 * camera.width_px)
            found.append(np.where(np.isfinite(pixels), pixels - missed, 0.0))
        return found

    # Start where the cameras, each on its own, see the board on average.
    rotations, centers = [], []
    for camera, pose in zip(cameras, poses, strict=True):
        world_from_cam = invert(camera.cam_from_world)
        rotations.append(world_from_cam[:, :3] @ pose[:, :3])
        center_cam = scale * transform(pose, board.center_board[None])[0]
        centers.append(world_from_cam[:, :3] @ center_cam + world_from_cam[:, 3])
    u, _, vt = np.linalg.svd(np.sum(rotations, axis=0))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    center, size = np.mean(centers, axis=0), scale

    damping = 1e-3
    current = residuals(rotation, center, size)
    cost = sum(float((residual**2).sum()) for residual in current)
    unit_m = size * float(np.linalg.norm(board.center_board))
    for _ in range(100):
        # Seven unknowns: turn (radians), shift (in half diagonals of the board), size (relative).
        columns = []
        for axis in range(7):
            nudge = np.zeros(7)
            nudge[axis] = 1e-6
            moved = residuals(*_moved(rotation, center, size, nudge, unit_m))
            columns.append((np.concatenate(moved) - np.concatenate(current)).ravel() / 1e-6)
        jacobian = np.stack(columns, axis=1)
        normal, right = jacobian.T @ jacobian, -jacobian.T @ np.concatenate(current).ravel()
        damped = normal + damping * np.diag(np.diag(normal) + 1e-9)
        step = np.asarray(np.linalg.solve(damped, right), np.float64)
        candidate = _moved(rotation, center, size, step, unit_m)
        if not candidate[2] > 0:
            damping *= 10.0
            continue
        trial = residuals(*candidate)
        trial_cost = sum(float((residual**2).sum()) for residual in trial)
        if trial_cost < cost:
            done = cost - trial_cost < 1e-10 * cost
            (rotation, center, size), current, cost = candidate, trial, trial_cost
            damping = max(damping * 0.1, 1e-12)
            if done:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    return float(size), current


def _moved(
    rotation: NDArray[np.float64],
    center: NDArray[np.float64],
    size: float,
    step: NDArray[np.float64],
    unit_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    turn = cv2.Rodrigues(step[:3])[0]
    return turn @ rotation, center + step[3:6] * unit_m, size * (1.0 + float(step[6]))


def _odd_one_out(
    cameras: Sequence[Camera],
    poses: Sequence[Pose],
    corners: Sequence[NDArray[np.float64]],
    board: Board,
    scale: float,
    limits: dict[str, float],
) -> str | None:
    """Return the one camera without which the others agree; None where there is no such one."""
    odd = []
    for left_out in range(len(cameras)):
        others = [index for index in range(len(cameras)) if index != left_out]
        _, residuals = _fit_board(
            [cameras[index] for index in others],
            [poses[index] for index in others],
            [corners[index] for index in others],
            board,
            scale,
        )
        if all(
            rms(residual) <= limits[cameras[index].name]
            for index, residual in zip(others, residuals, strict=True)
        ):
            odd.append(cameras[left_out].name)
    return odd[0] if len(odd) == 1 else None
