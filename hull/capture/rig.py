"""The rig of a session: calibrated from its pictures of the board, or made elsewhere and tested."""

import hashlib
import json
import logging
from collections.abc import Callable
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.calibrate import calibrate_rig
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats.rig_json import read_rig, rig_to_dict
from hybridve.calib.formats.rigs import import_rig
from hybridve.calib.formats.tracker import read_poses
from hybridve.calib.image_io import FrameSource
from hybridve.calib.judging.account import Calibration
from hybridve.calib.judging.twins import find_twins, twins_text
from hybridve.calib.placing.marks import Mark
from hybridve.calib.placing.settings import CalibrationSettings
from hybridve.calib.rig import Rig
from hybridve.hull.capture.recording import recorded_sizes
from hybridve.hull.capture.rig_check import (
    camera_inputs,
    corner_cache,
    examined,
    remember_made,
    session_boards,
)
from hybridve.hull.capture.session import RigFile, Session

_log = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]
Box = tuple[NDArray[np.float64], NDArray[np.float64]]


def calibrate_session(
    session: Session, progress: Progress | None = None, box_world: Box | None = None
) -> Calibration:
    """Return a session's rig from its pictures of its boards, and what it was made from.

    What was found in the pictures is kept beside the session (rig/corners), so that they are
    searched once. `box_world` has two corners of the working volume, metres, if one is asked for.

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
        box_world=box_world,
    )
    tracks = {
        camera.name: read_poses(camera.extrinsics_poses)
        for camera in session.cameras
        if camera.extrinsics_poses is not None
    }
    calibration = calibrate_rig(
        boards, camera_inputs(session.cameras), settings, progress, corner_cache(session), tracks
    )
    remember_made(session, calibration.rig)
    return calibration


def has_rig(session: Session) -> bool:
    """Whether the session names a rig, or one was calibrated for it."""
    return session.rig_file is not None or (session.folder / "rig" / "rig.json").is_file()


def load_rig(session: Session, progress: Progress | None = None) -> Rig:
    """Return the session's rig: the one it names, or the one that was calibrated for it.

    Whichever it is, it was tested against the boards that the session's cameras saw, if they saw
    any (`hybridve.hull.capture.rig_check`); its ``check`` says so.

    Parameters
    ----------
    session : Session
        The session.
    progress : callable, optional
        Told ``(what, done, total)`` while the boards' pictures are searched: the first time a rig
        is used in a session. Without it, one line is logged where that takes long.

    Raises
    ------
    CalibrationError
        If there is none, or it lacks a camera of the session, or is for images of another size, or
        the session's boards refute it.
    """
    names = [camera.name for camera in session.cameras]
    sizes_px = dict(zip(names, recorded_sizes(session), strict=True))
    if session.rig_file is not None:
        rig, label = _import(session, session.rig_file, sizes_px), session.rig_file.pattern
    else:
        path = session.folder / "rig" / "rig.json"
        if not path.is_file():
            raise CalibrationError(
                f"{session.path}: there is no rig at {path}; run `hybridve calibrate "
                f"{session.path}` first, or name one with rig ="
            )
        rig, label = read_rig(path), str(path)
    for name, (width_px, height_px) in sizes_px.items():
        camera = rig[name]
        if (camera.width_px, camera.height_px) != (width_px, height_px):
            raise CalibrationError(
                f"{session.path}: camera {name!r} recorded {width_px}x{height_px}, but its rig is "
                f"for {camera.width_px}x{camera.height_px}; calibrate it at the size recorded"
            )
    _tell_twins(session, rig)
    return examined(session, rig, label, progress)


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
        If the rig cannot be read, or the boards that the session's cameras saw refute it.
    """
    assert session.rig_file is not None
    label = session.rig_file.pattern
    rig = _import(session, session.rig_file, board_sizes(session))
    rig = examined(session, rig, label, progress)
    assert rig.check is not None
    if rig.check.verdict == "no board":
        _log.warning(
            "%s: the rig %r is taken as it is: there is no board in the session to test it against",
            session.path,
            label,
        )
    _tell_twins(session, rig)
    return rig


def _tell_twins(session: Session, rig: Rig) -> None:
    """Log which cameras add nothing to others: by the rig, or because they recorded the same."""
    told = twins_text(find_twins(rig))
    if told:
        _log.warning("%s: %s", session.path, told)
    for first, second in combinations(session.cameras, 2):
        if first.recording is not None and _is_same(first.recording, second.recording):
            _log.warning(
                "%s: cameras %r and %r have one recording, %s: one of them is not where it was "
                "made",
                session.path,
                first.name,
                second.name,
                first.recording.label,
            )


def _is_same(first: FrameSource, second: FrameSource | None) -> bool:
    if second is None or len(first.paths) != len(second.paths):
        return False
    # The first picture tells, as a rule: a thousand need not be looked up for each pair.
    pairs = zip(first.paths, second.paths, strict=True)
    return all(one.resolve() == other.resolve() for one, other in pairs)


def _import(session: Session, rig_file: RigFile, sizes_px: dict[str, tuple[int, int]]) -> Rig:
    rig = import_rig(
        session.root,
        rig_file.pattern,
        rig_file.unit,
        rig_file.pixel_centre,
        sizes_px,
        session.target.unit_m if session.target is not None else None,
    )
    # The session's cameras in the session's order; a rig may hold more.
    return rig.only([camera.name for camera in session.cameras])


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
