"""The rig of a session: calibrated from its pictures of the board, or made elsewhere and tested."""

import hashlib
import json
import logging
from collections.abc import Callable
from dataclasses import asdict

import numpy as np

from hybridve.calib.account import Calibration
from hybridve.calib.board import Board
from hybridve.calib.boards import make_board
from hybridve.calib.calibrate import calibrate_rig
from hybridve.calib.check import RigCheck, check_rig
from hybridve.calib.corner_cache import CornerCache
from hybridve.calib.errors import CalibrationError
from hybridve.calib.observe import CameraInput, find_boards
from hybridve.calib.rig import Rig
from hybridve.calib.rig_io import import_rig, read_rig, rig_to_dict
from hybridve.calib.settings import CalibrationSettings
from hybridve.calib.tracker_io import read_poses
from hybridve.calib.world import Mark
from hybridve.hull.capture.recording import recording_of
from hybridve.hull.capture.session import RigFile, Session

_log = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]


def calibrate_session(session: Session, progress: Progress | None = None) -> Calibration:
    """Return a session's rig from its pictures of its boards, and what it was made from.

    What was found in the pictures is kept beside the session (rig/corners), so that they are
    searched once.

    Raises
    ------
    CalibrationError
        If the session says too little, no board can be found, or the cameras cannot be linked.
    """
    boards = session_boards(session)
    for number, camera in enumerate(session.cameras, start=1):
        if camera.extrinsics is None:
            raise CalibrationError(
                f"{session.path}: camera.{number} ({camera.name!r}) has no extrinsics; name the "
                "recording in which all cameras see the board at once"
            )
    settings = CalibrationSettings(
        world=session.world,
        marks=tuple(
            Mark(
                point.name,
                point.pixels,
                None if point.xyz_mm is None else np.array(point.xyz_mm) / 1000.0,
                point.floor,
            )
            for point in session.points
        ),
        sync=session.sync,
    )
    tracks = {
        camera.name: read_poses(camera.extrinsics_poses)
        for camera in session.cameras
        if camera.extrinsics_poses is not None
    }
    return calibrate_rig(
        boards, _inputs(session), settings, progress, _corner_cache(session), tracks
    )


def session_boards(session: Session) -> list[Board]:
    """Return the boards that a session describes.

    Raises
    ------
    CalibrationError
        If it describes none, or one that cannot be.
    """
    if not session.targets:
        raise CalibrationError(
            f"{session.path}: has neither a [target] to calibrate with nor a rig made elsewhere; "
            "describe the board, or name a rig with rig ="
        )
    return [make_board(target.table()) for target in session.targets]


def _corner_cache(session: Session) -> CornerCache:
    return CornerCache(session.folder / "rig" / "corners")


def has_rig(session: Session) -> bool:
    """Whether the session names a rig, or one was calibrated for it."""
    return session.rig_file is not None or (session.folder / "rig" / "rig.json").is_file()


def load_rig(session: Session) -> Rig:
    """Return the session's rig: the one it names, or the one that was calibrated for it.

    Raises
    ------
    CalibrationError
        If there is none, or it lacks a camera of the session, or is for images of another size.
    """
    sizes_px = _recorded_sizes(session)
    if session.rig_file is not None:
        rig = _import(session, session.rig_file, sizes_px)
    else:
        path = session.folder / "rig" / "rig.json"
        if not path.is_file():
            raise CalibrationError(
                f"{session.path}: there is no rig at {path}; run `hybridve calibrate "
                f"{session.path}` first, or name one with rig ="
            )
        rig = read_rig(path)
    for name, (width_px, height_px) in sizes_px.items():
        camera = rig[name]
        if (camera.width_px, camera.height_px) != (width_px, height_px):
            raise CalibrationError(
                f"{session.path}: camera {name!r} recorded {width_px}x{height_px}, but its rig is "
                f"for {camera.width_px}x{camera.height_px}; calibrate it at the size recorded"
            )
    return rig


def rig_digest(rig: Rig) -> str:
    """Return a text that is the same for the same cameras on the same mounts only."""
    content = rig_to_dict(rig)
    told = [content["cameras"], content["mounts"]] if rig.mounts else content["cameras"]
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def take_elsewhere(session: Session, progress: Progress | None = None) -> Rig:
    """Return the rig that a session names, tested against its boards if it has any.

    Raises
    ------
    CalibrationError
        If the rig cannot be read, or does not fit the boards that the session's cameras saw.
    """
    assert session.rig_file is not None
    rig = _import(session, session.rig_file, board_sizes(session))
    seeing = [camera for camera in session.cameras if camera.extrinsics is not None]
    if session.target is None or len(seeing) < 2:
        _log.warning(
            "%s: the rig %r is taken as it is: there is no board in the session to test it against",
            session.path,
            session.rig_file.pattern,
        )
        return rig
    check = check_session(session, rig, progress)
    if not check.is_trustworthy:
        raise CalibrationError(f"{session.path}: rig {session.rig_file.pattern!r}: {check.message}")
    return Rig(rig.cameras, {**rig.provenance, "check": asdict(check)}, rig.covariance, rig.mounts)


def check_session(session: Session, rig: Rig, progress: Progress | None = None) -> RigCheck:
    """Test a rig against the boards that a session's cameras saw at once.

    Raises
    ------
    CalibrationError
        If no board can be found, or fewer than two cameras of the rig see one.
    """
    boards = session_boards(session)
    observations = find_boards(
        boards, _inputs(session), progress=progress, cache=_corner_cache(session)
    )
    return check_rig(rig, boards, observations)


def _import(session: Session, rig_file: RigFile, sizes_px: dict[str, tuple[int, int]]) -> Rig:
    rig = import_rig(
        session.root,
        rig_file.pattern,
        rig_file.unit or "m",
        rig_file.pixel_centre,
        sizes_px,
        session.target.unit_m if session.target is not None else None,
    )
    # The session's cameras in the session's order; a rig may hold more.
    return rig.only([camera.name for camera in session.cameras])


def _recorded_sizes(session: Session) -> dict[str, tuple[int, int]]:
    sizes_px = {}
    for camera in session.cameras:
        height_px, width_px = recording_of(session, camera).first().shape[:2]
        sizes_px[camera.name] = (width_px, height_px)
    return sizes_px


def board_sizes(session: Session) -> dict[str, tuple[int, int]]:
    """Return image sizes from the recordings or, where there is none yet, from the boards'."""
    sizes_px = {}
    for camera in session.cameras:
        source = camera.recording or camera.extrinsics or camera.intrinsics
        if source is None:
            raise CalibrationError(
                f"{session.path}: camera {camera.name!r} has no picture at all; its image size "
                "cannot be known"
            )
        height_px, width_px = source.first().shape[:2]
        sizes_px[camera.name] = (width_px, height_px)
    return sizes_px


def _inputs(session: Session) -> list[CameraInput]:
    return [
        CameraInput(
            camera.name,
            camera.model,
            camera.intrinsics,
            camera.extrinsics,
            camera.corners,
            camera.lens,
            camera.params,
        )
        for camera in session.cameras
    ]
