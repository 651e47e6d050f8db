"""The recordings that a report is of: what its cameras saw, and the hull, frame by frame."""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import CalibrationError, SessionError
from hybridve.calib.formats.rig_json import rig_from_dict
from hybridve.calib.lens import Undistortion
from hybridve.calib.rig import Rig
from hybridve.hull.capture.recording import (
    FrameRange,
    as_recorded,
    recording_of,
    silhouettes_of,
    stored_silhouettes,
)
from hybridve.hull.capture.rig import load_rig, rig_digest
from hybridve.hull.capture.session import Session, load_session
from hybridve.hull.capture.tracks import Tracks, read_tracks
from hybridve.hull.chain import first_rig, moved_views, rig_views
from hybridve.hull.query.silhouettes import Hull, Views, make_hull
from hybridve.hull.report.read import Report

Progress = Callable[[str, int, int], None]

#: Silhouettes of which there are no pictures are drawn in this grey, on black.
_MASK_GREY = 150


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """A session's recordings, made ready to be shown.

    Attributes
    ----------
    session : Session
        Without the cameras that the report does without.
    rig : Rig
        Its rig.
    tracks : Tracks
        Where moving cameras were.
    views, undistortions
        Its cameras as pinhole views; see `hybridve.hull.chain.rig_views`.
    silhouettes : Path or None
        Where they are stored.
    """

    session: Session
    rig: Rig
    tracks: Tracks
    views: Views
    undistortions: list[Undistortion]
    silhouettes: Path | None

    def rig_at(self, index: int) -> Rig:
        """Return its rig in a frame in which no pose is missing."""
        return self.rig.at(self.tracks.at(index)) if self.tracks else self.rig


def open_recorded(report: Report, session: Path) -> tuple[Recorded, str]:
    """Return the recordings that a report is of, and what speaks against these being them, or "".

    Raises
    ------
    HybridveError
        If there is no such session, or it has not the cameras of the report.
    """
    loaded = load_session(session)
    wanted = tuple(report.cameras) or tuple(report.settings.get("cameras", ()))
    mine = [camera.name for camera in loaded.cameras]
    if missing := [name for name in wanted if name not in mine]:
        raise SessionError(
            f"{loaded.path}: has no camera {missing[0]!r}, which {report.path} is of; it has "
            f"{', '.join(mine)}: name the session that the report was made from"
        )
    loaded = loaded.without([name for name in mine if wanted and name not in wanted])
    rig = load_rig(loaded)
    tracks = read_tracks(loaded, rig)
    views, undistortions = rig_views(loaded, first_rig(rig, tracks))
    stored = stored_silhouettes(loaded, rig_digest(rig))
    doubt = ""
    if report.settings.get("session_sha256") not in (None, loaded.checksum):
        doubt = (
            f"{loaded.path} is not as it was when {report.path.name} was made; pictures and hull "
            "are those of the session as it is now"
        )
    return Recorded(loaded, rig, tracks, views, undistortions, stored), doubt


def rig_of(report: Report, recorded: Recorded | None) -> Rig | None:
    """Return the cameras of a report; None if it holds none that can be read."""
    names = list(report.cameras) or list(report.settings.get("cameras", ()))
    if recorded is not None:
        rig = recorded.rig
    else:
        try:
            rig = rig_from_dict(report.rig, f"{report.path}: rig")
        except CalibrationError:
            return None
    known = {camera.name for camera in rig.cameras}
    return rig.only([name for name in names if name in known] or sorted(known))


@dataclass(frozen=True, slots=True, eq=False)
class SeenFrame:
    """One frame as it was recorded.

    Attributes
    ----------
    index : int
        Its number in the session.
    masks : list of (H, W) uint8, or None
        Silhouettes in the images as recorded; None where the frame cannot be read.
    images : list of (H, W, 3) uint8 or None
        What each camera saw, BGR; of ready masks these, in grey. None where there is no picture.
    hull : Hull or None
        What is real in it.
    """

    index: int
    masks: list[NDArray[np.uint8]] | None
    images: list[NDArray[np.uint8] | None]
    hull: Hull | None


def seen_frames(
    recorded: Recorded,
    frames: FrameRange,
    *,
    with_images: bool = True,
    progress: Progress | None = None,
) -> Iterator[SeenFrame]:
    """Yield frames with silhouettes, hull and, unless nobody wants them, pictures.

    Raises
    ------
    SessionError
        If the recordings cannot be read.
    """
    cameras = recorded.session.cameras
    pictures = [_Pictures(recorded, number, frames) for number in range(len(cameras))]
    found = silhouettes_of(
        recorded.session,
        recorded.silhouettes,
        frames,
        tracks=recorded.tracks,
        undistortions=recorded.undistortions,
        progress=progress,
    )
    with closing(found) as silhouettes:
        for frame in silhouettes:
            images: list[NDArray[np.uint8] | None] = [None] * len(cameras)
            if with_images:
                images = [one.at(frame.index) for one in pictures]
            if frame.masks is None:
                yield SeenFrame(frame.index, None, images, None)
                continue
            masks: list[NDArray[np.uint8]] = []
            if with_images:
                masks = [
                    as_recorded(mask, recorded.rig[camera.name], lens)
                    for mask, camera, lens in zip(
                        frame.masks, cameras, recorded.undistortions, strict=True
                    )
                ]
                for number, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
                    if camera.has_masks:
                        images[number] = np.repeat(mask[..., None] * np.uint8(_MASK_GREY), 3, 2)
            views = moved_views(
                recorded.session,
                recorded.rig,
                recorded.tracks,
                frame.index,
                recorded.views,
                recorded.undistortions,
            )
            yield SeenFrame(frame.index, masks, images, make_hull(views, frame.masks))


class _Pictures:
    """The pictures of one camera, asked for frame by frame, forwards."""

    def __init__(self, recorded: Recorded, number: int, frames: FrameRange) -> None:
        camera = recorded.session.cameras[number]
        self._shift = camera.shift_frames
        self._next = max(frames.start - self._shift, 0)
        self._source: Iterator[NDArray[Any]] | None = None
        if not camera.has_masks:
            stop = None if frames.stop is None else max(frames.stop - self._shift, 0)
            self._source = recording_of(recorded.session, camera).frames(self._next, stop)

    def at(self, index: int) -> NDArray[np.uint8] | None:
        """Return the picture of a frame, (H, W, 3) BGR; None where there is none."""
        image = None
        while self._source is not None and self._next <= index - self._shift:
            image = next(self._source, None)
            self._next += 1
        if image is None or image.dtype != np.uint8:
            return None
        if image.ndim == 2:
            return np.repeat(image[..., None], 3, axis=2)
        return np.ascontiguousarray(image[..., :3])
