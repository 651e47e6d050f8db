"""Whether a rig that is used agrees with the boards that the session's own cameras saw.

Every rig that is loaded is asked here, wherever it comes from. What was found is kept beside the
session, with what was found in its pictures (rig/corners), under all that it depends on: the rig,
the boards, the clips. So it costs time once, and is silent afterwards. A rig that was calibrated
from these very clips is known to agree with them.

A rig that the boards refute is not used. Where they leave something open, or cannot be read, that
is said each time, and the rig is used: a recording is not lost because its board was not seen. The
session's ``rig_check = "off"`` asks for no test, and that is said, too.
"""

import hashlib
import json
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import hybridve.calib
from hybridve.calib.boards.board import Board, Observations
from hybridve.calib.boards.named import make_board
from hybridve.calib.errors import CalibrationError, HybridveError
from hybridve.calib.formats.rig_json import rig_to_dict
from hybridve.calib.judging.case import NotTestableError
from hybridve.calib.judging.check import check_rig
from hybridve.calib.plain import to_plain
from hybridve.calib.record import CalibrationRecord
from hybridve.calib.rig import Rig
from hybridve.calib.seeing.corner_cache import CornerCache
from hybridve.calib.seeing.inputs import CameraInput
from hybridve.calib.seeing.observe import find_boards
from hybridve.calib.verdict import RigCheck, RigTest, check_from_dict
from hybridve.hull.capture.session import Session, SessionCamera

_log = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]

#: Whoever is told nothing of progress is told once that a test is going on, after so long.
_PATIENCE_S = 2.0

_REMEDY = 'or use it all the same with rig_check = "off"'


def examined(session: Session, rig: Rig, label: str, progress: Progress | None = None) -> Rig:
    """Return a rig with what the session's boards say of it, as its ``check``.

    What a user should know is logged as a warning.

    Parameters
    ----------
    session : Session
        Whose boards.
    rig : Rig
        The rig that is to be used.
    label : str
        What the user calls it.
    progress : callable, optional
        Told ``(what, done, total)`` while pictures are searched.

    Raises
    ------
    CalibrationError
        If the boards refute the rig.
    """
    found = ask_boards(session, rig, progress)
    place = f"{session.path}: rig {label!r}"
    if found.verdict == "wrong":
        raise CalibrationError(f"{place}: {found.message}; {_REMEDY}")
    if found.verdict in ("open", "off"):
        _log.warning("%s: %s", place, found.message)
    elif found.verdict == "not tested":
        _log.warning(
            "%s is taken as it is: it could not be tested against the session's board: %s",
            place,
            found.message,
        )
    elif found.check is not None and found.check.untested:
        _log.warning(
            "%s: not tested: %s; no board was seen there together with others",
            place,
            ", ".join(found.check.untested),
        )
    return replace(rig, check=found)


def ask_boards(session: Session, rig: Rig, progress: Progress | None = None) -> RigTest:
    """Return what the session's boards say of a rig; found out once, and kept.

    Parameters
    ----------
    session : Session
        The session, which describes boards and names clips.
    rig : Rig
        The rig.
    progress : callable, optional
        Told ``(what, done, total)`` while pictures are searched. Without it, one line is logged
        where that takes long.
    """
    if session.rig_check == "off":
        return RigTest(
            "off", 'rig_check = "off": it is used without a test against the session\'s board'
        )
    names = _testing(session, rig)
    if not session.targets or len(names) < 2:
        return RigTest("no board", "the session has no board that two of its cameras saw at once")
    try:
        kept = corner_cache(session)
        if kept.known(("rig made", *_about(session, rig, names, kept))) is not None:
            return _made_here(rig)
        check = _check_among(session, rig, names, progress or _Announced(session))
    except NotTestableError as error:
        return RigTest("not tested", str(error))
    except CalibrationError as error:
        return RigTest("wrong", str(error))
    if check.is_trustworthy:
        return RigTest("agrees", check.message, check)
    return RigTest("wrong" if check.is_refuted else "open", check.message, check)


def _made_here(rig: Rig) -> RigTest:
    if not isinstance(rig.provenance, CalibrationRecord):
        return RigTest(
            "open",
            "it was calibrated from the session's own board, but what was doubted then is told no "
            "more",
        )
    labelling = rig.provenance.labelling
    if labelling is not None and labelling.is_weak:
        return RigTest(
            "open",
            "it was calibrated from the session's own board, which looks the same turned, and "
            "hardly anything tells which way round each camera saw it",
        )
    return RigTest("made here", "it was calibrated from the session's own board")


def remember_made(session: Session, rig: Rig) -> None:
    """Keep in mind that a rig was calibrated from the session's own clips."""
    names = _testing(session, rig)
    if len(names) < 2:
        return
    kept = corner_cache(session)
    kept.keep(("rig made", *_about(session, rig, names, kept)), ({}, None))
    kept.save()


def check_session(session: Session, rig: Rig, progress: Progress | None = None) -> RigCheck:
    """Test a rig against the boards that all of a session's fixed cameras saw at once.

    Raises
    ------
    NotTestableError
        If the session describes no board, a camera's clip shows none, cannot be read, or is of
        another size than the rig is for, or fewer than two cameras of the rig see a board.
    CalibrationError
        If a lens cannot have seen what its camera did.
    """
    names = [
        camera.name
        for camera in session.cameras
        if camera.extrinsics is not None and camera.extrinsics_poses is None
    ]
    return _check(session, rig, names, progress)


def _check_among(session: Session, rig: Rig, names: Sequence[str], progress: Progress) -> RigCheck:
    """Test a rig with the cameras that see a board, if some do not."""
    try:
        return _check(session, rig, names, progress)
    except NotTestableError:
        seeing = []
        for name in names:
            try:
                _observe(session, rig, [name], corner_cache(session), progress)
            except HybridveError as error:
                reason = error
            else:
                seeing.append(name)
        if len(seeing) == len(names):
            raise
        if len(seeing) < 2:
            raise NotTestableError(str(reason)) from reason
        return _check(session, rig, seeing, progress)


def _check(session: Session, rig: Rig, names: Sequence[str], progress: Progress | None) -> RigCheck:
    kept = corner_cache(session)
    question = ("rig check", _digest_of_code(), *_about(session, rig, names, kept))
    known = kept.known(question)
    if known is not None:
        return check_from_dict(known[0])
    observations = _observe(session, rig, names, kept, progress)
    if progress is not None:
        progress("testing the rig", 0, 1)
    check = check_rig(rig, session_boards(session), observations)
    if progress is not None:
        progress("testing the rig", 1, 1)
    kept.keep(question, (to_plain(check), None))
    kept.save()
    return check


def _observe(
    session: Session,
    rig: Rig,
    names: Sequence[str],
    kept: CornerCache,
    progress: Progress | None,
) -> list[Observations]:
    """Return what cameras saw of the boards in the clip.

    Raises
    ------
    NotTestableError
        If that tells nothing of the rig.
    """
    inputs = [one for one in camera_inputs(session.cameras) if one.name in names]
    try:
        boards = session_boards(session)
        observations = find_boards(boards, inputs, progress=progress, cache=kept)
    except HybridveError as error:
        raise NotTestableError(str(error)) from error
    for seen in observations:
        if not any(camera.name == seen.name for camera in rig.cameras):
            continue
        camera = rig[seen.name]
        if seen.size_px != (camera.width_px, camera.height_px):
            raise NotTestableError(
                "camera {!r}: its board clip is {}x{} pixels, the rig is for {}x{}".format(
                    seen.name, *seen.size_px, camera.width_px, camera.height_px
                )
            )
    if session.sync == "estimate" and not all(seen.is_still for seen in observations):
        raise NotTestableError(
            "the board moves, and the clocks of its clips are not known; calibrate the session "
            'without the rig to see how late each is, or say sync = "given"'
        )
    return observations


def _testing(session: Session, rig: Rig) -> list[str]:
    """Return the cameras of a rig that stand still and saw the boards at once with others."""
    known = {camera.name for camera in rig.cameras} - set(rig.mounts)
    return [
        camera.name
        for camera in session.cameras
        if camera.extrinsics is not None
        and camera.extrinsics_poses is None
        and camera.name in known
    ]


def _about(
    session: Session, rig: Rig, names: Sequence[str], kept: CornerCache
) -> tuple[str | float, ...]:
    """Return all that a test depends on, but for code.

    Raises
    ------
    NotTestableError
        If a file cannot be read.
    """
    told = rig_to_dict(rig)
    told.pop("provenance")
    files = []
    try:
        for camera in session.cameras:
            if camera.name in names:
                assert camera.extrinsics is not None
                files += [camera.name, kept.identify(camera.extrinsics.paths)]
                files.append("" if camera.corners is None else kept.identify([camera.corners]))
    except OSError as error:
        raise NotTestableError(f"{error.filename}: cannot be read: {error.strerror}") from error
    targets = [target.table() for target in session.targets]
    return (_digest(told), _digest(targets), session.sync, *files)


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


@cache
def _digest_of_code() -> str:
    """Return a digest of all that decides how a rig is tested: another version may differ."""
    digest = hashlib.sha256()
    for folder in hybridve.calib.__path__:
        for path in sorted(Path(folder).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


class _Announced:
    """Tells once that a test is going on, if it takes long."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._started_s = time.monotonic()
        self._is_told = False

    def __call__(self, what: str, done: int, total: int) -> None:
        """Log the first step that comes late."""
        del done, total
        if not self._is_told and time.monotonic() - self._started_s > _PATIENCE_S:
            self._is_told = True
            _log.warning(
                "%s: the rig is tested against the session's board, once (%s)",
                self._session.path,
                what,
            )


# --- What a session says of boards ------------------------------------------------------------


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


def corner_cache(session: Session) -> CornerCache:
    """Return what was found in the session's pictures before."""
    return CornerCache(session.folder / "rig" / "corners")


def camera_inputs(cameras: Sequence[SessionCamera]) -> list[CameraInput]:
    """Return what was recorded of the boards by each camera."""
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
        for camera in cameras
    ]
