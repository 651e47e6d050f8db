"""Whether the cameras still stand where they were calibrated: the board clip's room, and today's.

Whoever bumps into a camera between calibration and task leaves a rig that is right about a place
where the camera is no more. The empty scene of the task shows it: it is the room that the clip of
the board showed. Every camera that has both is asked here, before the task begins. What was found
is kept beside the session, with what was found in its pictures (rig/corners), so it costs time
once.

A moved camera is told in a line; whoever calls decides what that means for the result.
"""

import hashlib
import json
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.errors import HybridveError
from hybridve.calib.image_io import FrameSource
from hybridve.calib.plain import Told, read_strictly, to_plain
from hybridve.calib.rig import Rig
from hybridve.calib.seeing import features
from hybridve.calib.seeing.corner_cache import CornerCache
from hybridve.hull.capture import room_shift as shift_module
from hybridve.hull.capture.rig_check import corner_cache, session_boards
from hybridve.hull.capture.room_shift import RoomShift, cannot_tell, room_shift
from hybridve.hull.capture.session import Session, SessionCamera

_log = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]

#: Frames of a clip whose median is its room: whoever crosses it for less than half of them leaves
#: no trace.
_FRAMES = 15

#: Bytes of frames held at once; of larger images fewer are looked at.
_CLIP_BYTES = 100_000_000

#: What lies about a board and is carried with it: its margin, in parts of its own size.
_MARGIN = 0.25


@dataclass(frozen=True, slots=True)
class RoomCheck(Told):
    """How the room of the calibration stands in the task's empty scene.

    Attributes
    ----------
    cameras : dict of str to RoomShift
        By camera that has pictures of both. Cameras that are not there were not asked: they lack
        one of the two, or move with a tracker, or no test was wanted (``rig_check = "off"``).
    """

    cameras: dict[str, RoomShift] = field(default_factory=dict)

    @property
    def moved(self) -> tuple[str, ...]:
        """The cameras that have moved since they were calibrated."""
        return tuple(name for name, found in self.cameras.items() if found.state == "moved")

    @property
    def messages(self) -> tuple[str, ...]:
        """A line for each camera that has moved: what was found, expected, and what to do."""
        return tuple(
            f"camera {name!r} has moved since its board was recorded: in the empty scene "
            f"{self.cameras[name].message}; calibrate again with a clip of the board from where "
            "the camera stands now, or put it back and record the empty scene and the task again"
            for name in self.moved
        )


def check_room(session: Session, rig: Rig, progress: Progress | None = None) -> RoomCheck:
    """Return whether the cameras stand where they were calibrated; found out once, and kept.

    Each camera that has moved is logged as a warning, every time.

    Parameters
    ----------
    session : Session
        Whose pictures: `extrinsics`, from which poses come, and `background`.
    rig : Rig
        The lenses of its cameras, as the pictures are.
    progress : callable, optional
        Told ``(what, done, total)`` while pictures are compared.
    """
    cameras = [camera for camera in session.cameras if _is_asked(session, rig, camera)]
    if not cameras:
        return RoomCheck()
    kept = corner_cache(session)
    boards = _boards(session)
    tables = json.dumps([target.table() for target in session.targets], sort_keys=True)
    found = {}
    with ThreadPoolExecutor(max_workers=min(len(cameras), cv2.getNumberOfCPUs())) as pool:
        answers = pool.map(
            lambda camera: _shift_of(rig[camera.name], camera, boards, tables, kept), cameras
        )
        for camera, (shift, is_new) in zip(cameras, answers, strict=True):
            found[camera.name] = shift
            if progress is not None and is_new:
                progress("comparing rooms", len(found), len(cameras))
    kept.save()
    check = RoomCheck(found)
    for message in check.messages:
        _log.warning("%s: %s", session.path, message)
    for name, answer in found.items():
        if answer.state != "moved":
            _log.info("%s: camera %r: %s", session.path, name, answer.message)
    return check


def _is_asked(session: Session, rig: Rig, camera: SessionCamera) -> bool:
    return (
        session.rig_check == "on"
        and camera.extrinsics is not None
        and camera.background is not None
        and camera.extrinsics_poses is None
        and camera.poses is None
        and camera.name not in rig.mounts
    )


def _boards(session: Session) -> list[Board]:
    try:
        return session_boards(session)
    except HybridveError:
        return []  # a board that cannot be described cannot be left out, either


def _shift_of(
    lens: Camera, camera: SessionCamera, boards: list[Board], tables: str, kept: CornerCache
) -> tuple[RoomShift, bool]:
    """Return how a camera's room stands, and whether that had to be found out."""
    assert camera.extrinsics is not None
    assert camera.background is not None
    try:
        question = (
            "room",
            _digest_of_code(),
            *(lens.model, lens.width_px, lens.height_px, lens.skew_px, *lens.params.tolist()),
            tables,
            kept.identify(camera.extrinsics.paths),
            kept.identify(camera.background.paths),
        )
    except OSError as error:
        return cannot_tell(f"{error.filename}: cannot be read: {error.strerror}"), True
    known = kept.known(question)
    if known is not None:
        return read_strictly(RoomShift, known[0], "room"), False
    try:
        then, now = _room_of(camera.extrinsics), _room_of(camera.background)
    except HybridveError as error:
        return cannot_tell(str(error)), True
    found = _compare(lens, camera, boards, then, now)
    kept.keep(question, (to_plain(found), None))
    return found, True


def _compare(
    lens: Camera,
    camera: SessionCamera,
    boards: list[Board],
    then: NDArray[np.uint8],
    now: NDArray[np.uint8],
) -> RoomShift:
    size_px = (lens.height_px, lens.width_px)
    for source, picture in ((camera.extrinsics, then), (camera.background, now)):
        if picture.shape != size_px:
            assert source is not None
            return cannot_tell(
                f"{source.label} is {picture.shape[1]}x{picture.shape[0]} pixels, the rig is for "
                f"{size_px[1]}x{size_px[0]}"
            )
    return room_shift(lens, then, now, _without(boards, then), _without(boards, now))


def _room_of(source: FrameSource) -> NDArray[np.uint8]:
    """Return the median of frames spread over a clip, grey (H, W); those of another size left out.

    Raises
    ------
    SessionError
        If no frame, or an image, can be read.
    """
    step = max(1, source.claimed_length() // _FRAMES)
    grey: list[NDArray[np.uint8]] = []
    for image in source.frames(step=step):
        frame = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        if grey and frame.shape != grey[0].shape:
            continue
        grey.append(frame)
        if (len(grey) + 1) * frame.size > _CLIP_BYTES and len(grey) >= 3:
            break
    if not grey:
        source.first()  # says what is wrong
    middle = np.zeros(grey[0].shape, np.uint8)
    for row in range(0, len(middle), 64):  # in strips, to sort little memory at a time
        strip = np.stack([frame[row : row + 64] for frame in grey])
        middle[row : row + 64] = np.round(np.median(strip, axis=0))
    return middle


def _without(boards: list[Board], grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a mask (H, W) of a picture that is 0 on boards and their margins."""
    mask = np.full(grey.shape, 255, np.uint8)
    for board in boards:
        corners = board.detect(grey, "quick").corners
        if corners is None or not is_seen(corners).any():
            continue
        points = corners[is_seen(corners)]
        middle = points.mean(axis=0)
        outline = np.asarray(cv2.convexHull(points.astype(np.float32)))[:, 0]
        wider = middle + (1.0 + 2.0 * _MARGIN) * (outline - middle)
        cv2.fillConvexPoly(mask, np.round(wider).astype(np.int32), (0,))
    return mask


@cache
def _digest_of_code() -> str:
    """Return a digest of what decides how rooms are compared: another version may differ."""
    digest = hashlib.sha256()
    for path in (__file__, shift_module.__file__, features.__file__):
        digest.update(Path(path).read_bytes())
    return digest.hexdigest()
