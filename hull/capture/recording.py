"""The silhouettes of a session, frame by frame, from all cameras side by side.

Each camera is read and segmented in a thread of its own, a few frames ahead of whoever asks. The
threads spend their time in OpenCV, which leaves Python's lock alone. Memory does not grow with the
length of the recording.
"""

import json
import logging
import queue
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import SessionError
from hybridve.calib.image_io import FrameSource, Image
from hybridve.calib.lens import Undistortion, cam_from_img
from hybridve.hull.capture.background import learn_background
from hybridve.hull.capture.mask_values import MASK_METHOD, MaskReading, reading_of
from hybridve.hull.capture.outline_motion import interpolate_masks
from hybridve.hull.capture.segment import METHOD_VERSION, Segmenter
from hybridve.hull.capture.session import Session, SessionCamera
from hybridve.hull.capture.silhouette_io import SilhouetteReader
from hybridve.hull.capture.tracks import Tracks

_log = logging.getLogger(__name__)

Mask = NDArray[np.uint8]

_Pixel = TypeVar("_Pixel", np.uint8, np.float32)

#: How many frames a camera is read ahead: enough to smooth out a slow frame.
_READ_AHEAD = 3

#: How many frames a header may be off without a word: containers count what codecs hold back.
HEADER_SLACK = 5

#: Ready masks that are looked at to find out what their values mean.
_MOST_LOOKED_AT = 12

#: How far apart, in recorded pixels, a lens is asked where a mask is bent as it bends.
_LENS_STEP_PX = 8


@dataclass(frozen=True, slots=True)
class FrameRange:
    """Which frames of a recording to look at: start, start + step, ... before stop."""

    start: int = 0
    stop: int | None = None
    step: int = 1

    def __post_init__(self) -> None:
        if self.start < 0 or self.step < 1 or (self.stop is not None and self.stop <= self.start):
            raise SessionError(
                f"frames {self}: no frame is in it; expected START:STOP or START:STOP:STEP with "
                "0 <= START < STOP and STEP >= 1"
            )

    def __str__(self) -> str:
        return f"{self.start}:{'' if self.stop is None else self.stop}:{self.step}"


@dataclass(frozen=True, slots=True, eq=False)
class FrameSilhouettes:
    """The silhouettes of one frame.

    Attributes
    ----------
    index : int
        Number of the frame in the session.
    masks : list of (H, W) uint8, or None
        Per camera 1 on object pixels; None if a camera has no picture of this frame.
    reason : str
        Why `masks` is None; else empty.
    decode_s, segment_s : float
        Seconds of processor time, summed over the cameras, which run side by side.
    """

    index: int
    masks: list[Mask] | None
    reason: str
    decode_s: float
    segment_s: float


def recorded_sizes(session: Session) -> list[tuple[int, int]]:
    """Return the width and height of each camera's pictures, in pixels, by their first.

    Raises
    ------
    SessionError
        If a camera recorded nothing.
    """
    sizes_px = []
    for number, camera in enumerate(session.cameras, start=1):
        recording = recording_of(session, camera)
        try:
            height, width = recording.first().shape[:2]
        except SessionError as error:
            raise SessionError(f"{session.path}: camera.{number}: {error}") from error
        sizes_px.append((width, height))
    return sizes_px


def claimed_length(session: Session) -> int:
    """Return how many frames the session has; where videos tell it only roughly, roughly."""
    return max(
        recording_of(session, camera).claimed_length() + camera.shift_frames
        for camera in session.cameras
    )


def check_lengths(session: Session, frames: FrameRange) -> None:
    """Compare how much the cameras recorded.

    Headers of videos are a frame or two off, so that they only raise the suspicion; frames are
    counted where they differ.

    Raises
    ------
    SessionError
        If one camera stops before the frames that are asked for, and another does not; or all do.
    """
    recordings = [recording_of(session, camera) for camera in session.cameras]
    claimed = [recording.claimed_length() for recording in recordings]
    shifts = [camera.shift_frames for camera in session.cameras]
    most = max(length + shift for length, shift in zip(claimed, shifts, strict=True))
    slack = HEADER_SLACK if any(recording.is_video for recording in recordings) else 0
    if min(claimed) > 0 and frames.start >= most + slack:
        raise SessionError(
            f"{session.path}: the recording has none of the frames {frames}: it has {most}, the "
            "first of which is 0; choose others with --frames"
        )
    if len(set(claimed)) == 1:
        return
    lengths = [
        recording.count() + shift for recording, shift in zip(recordings, shifts, strict=True)
    ]
    shortest, longest = min(lengths), max(lengths)
    if shortest == longest or (frames.stop is not None and frames.stop <= shortest):
        return
    number, other = lengths.index(shortest), lengths.index(longest)
    camera = session.cameras[number]
    label, count = recordings[number].label, f"{shortest} frames"
    what = (
        f"{session.path}: camera.{number + 1}.{'masks' if camera.has_masks else 'video'}: "
        f"{label!r} has {count}, that of camera {session.cameras[other].name!r} {longest}"
    )
    if not recordings[number].is_video:
        raise SessionError(
            f"{what}, and the names of its pictures do not tell which are missing; number the "
            "pictures of one instant alike in all cameras"
        )
    raise SessionError(
        f"{what}; record again, or, if it only stopped early and lost no frame before that, "
        f"evaluate what all cameras saw with --frames {frames.start}:{shortest}"
    )


def recording_of(session: Session, camera: SessionCamera) -> FrameSource:
    """Return a camera's recording.

    Raises
    ------
    SessionError
        If the session names none.
    """
    if camera.recording is None:
        raise SessionError(
            f"{session.path}: camera {camera.name!r} has neither video nor masks; name one of them"
        )
    return camera.recording


def segmented_frames(
    session: Session,
    frames: FrameRange,
    *,
    undistortions: list[Undistortion] | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Generator[FrameSilhouettes]:
    """Yield the silhouettes of a session's frames, cut out of its recordings.

    A frame that a camera lacks is yielded with the reason. The frames end where all cameras end.

    Parameters
    ----------
    session : Session
        The recordings.
    frames : FrameRange
        Which frames.
    undistortions : list of Undistortion, optional
        If given, lens distortion is removed from the silhouettes.
    progress : callable, optional
        Told ``(what, done, total)`` while the backgrounds are learnt.

    Raises
    ------
    SessionError
        If a camera has no recording, or no background where it needs one.
    """
    sources = [_mask_source(session, camera) for camera in session.cameras]
    cutters = _make_cutters(session, progress)
    yield from _side_by_side(session, sources, cutters, frames, undistortions)


def stored_frames(
    reader: SilhouetteReader,
    frames: FrameRange,
    *,
    undistortions: list[Undistortion] | None = None,
) -> Generator[FrameSilhouettes]:
    """Yield the silhouettes of frames as they were stored by ``hybridve segment``."""
    stop = reader.n_frames if frames.stop is None else min(frames.stop, reader.n_frames)
    for index in range(frames.start, stop, frames.step):
        started = time.perf_counter()
        masks, reason = reader.frame(index)
        decoded = time.perf_counter()
        if masks is None:
            yield FrameSilhouettes(index, None, reason, decoded - started, 0.0)
            continue
        if undistortions is not None:
            masks = [undistort_mask(*pair) for pair in zip(masks, undistortions, strict=True)]
        yield FrameSilhouettes(index, masks, "", decoded - started, time.perf_counter() - decoded)


def silhouettes_of(
    session: Session,
    stored: Path | None,
    frames: FrameRange,
    *,
    tracks: Tracks | None = None,
    undistortions: list[Undistortion] | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Generator[FrameSilhouettes]:
    """Yield the silhouettes of a session's frames, from where they are stored or cut out now.

    A frame in which the pose of a moving camera is missing is yielded with the reason.

    Parameters
    ----------
    session : Session
        The recordings.
    stored : Path or None
        What `stored_silhouettes` says.
    tracks : Tracks, optional
        Where the moving cameras were.
    frames, undistortions, progress
        As of `segmented_frames`.

    Raises
    ------
    SessionError
        As of `segmented_frames`.
    ReportError
        If stored silhouettes cannot be read.
    """
    if stored is None:
        cut = segmented_frames(session, frames, undistortions=undistortions, progress=progress)
        yield from _placed(cut, tracks)
        return
    with SilhouetteReader(stored) as reader:
        yield from _placed(stored_frames(reader, frames, undistortions=undistortions), tracks)


def _placed(
    frames: Generator[FrameSilhouettes], tracks: Tracks | None
) -> Generator[FrameSilhouettes]:
    """Yield frames, without silhouettes those in which a camera's place is not known."""
    with closing(frames):
        for frame in frames:
            missing = "" if tracks is None else tracks.missing(frame.index)
            if missing:
                reasons = [frame.reason, missing] if frame.reason else [missing]
                frame = replace(frame, masks=None, reason="; ".join(reasons))
            yield frame


def silhouette_stamp(session: Session, rig_digest: str | None) -> str:
    """Return a text that changes whenever the session's silhouettes could.

    It holds the settings, and of every file involved its name, size and time of change.

    Parameters
    ----------
    session : Session
        The recordings.
    rig_digest : str or None
        A digest of the rig by which pieces that no camera confirms were dropped; None if none were.
    """
    files = []
    for camera in session.cameras:
        sources = [one for one in (camera.background, camera.recording) if one is not None]
        paths = [path for source in sources for path in source.paths]
        # Where a camera was decides which pieces the others confirm.
        for path in paths if camera.poses is None else [*paths, camera.poses]:
            status = path.stat()
            files.append([str(path), status.st_size, status.st_mtime_ns])
    return json.dumps(
        {
            "method": METHOD_VERSION,
            "segmentation": asdict(session.segmentation),
            "masks": [session.mask_threshold, session.mask_channel, MASK_METHOD],
            "rig": rig_digest,
            "shift_frames": [camera.shift_frames + camera.lag for camera in session.cameras],
            "files": files,
        }
    )


def stored_silhouettes(session: Session, rig_digest: str) -> Path | None:
    """Return the stored silhouettes of a session, or None where none stand or they are stale.

    Silhouettes from which pieces were dropped by another rig than that of the digest are stale.
    """
    path = session.folder / "silhouettes.h5"
    if not path.is_file():
        return None
    with SilhouetteReader(path) as reader:
        stamps = [silhouette_stamp(session, digest) for digest in (None, rig_digest)]
        return path if reader.stamp in stamps else None


def undistort_mask(mask: Mask, undistortion: Undistortion) -> Mask:
    """Return a silhouette without lens distortion; what the camera did not see is background."""
    if undistortion.map_x is None or undistortion.map_y is None:
        return mask
    return np.asarray(
        cv2.remap(
            mask,
            undistortion.map_x,
            undistortion.map_y,
            cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=0,
        ),
        np.uint8,
    )


def as_recorded(
    mask: NDArray[_Pixel], camera: Camera, undistortion: Undistortion
) -> NDArray[_Pixel]:
    """Return a mask of the pinhole image, (h, w), as the lens bends it into the recorded, (H, W).

    Or anything else that a pinhole image tells pixel by pixel, as uint8 or float32. 0 where the
    pinhole image has nothing. The lens is asked every 8 pixels and taken to be even between.
    """
    if undistortion.map_x is None:
        return mask
    size = (camera.height_px, camera.width_px)
    nodes = [np.arange(0.0, extent + 2 * _LENS_STEP_PX, _LENS_STEP_PX) for extent in size]
    grid = np.stack(np.meshgrid(*nodes[::-1]), axis=-1)
    rays = cam_from_img(camera, grid.reshape(-1, 2))
    places = rays @ undistortion.img_from_cam[:2, :2].T + undistortion.img_from_cam[:2, 2]
    # OpenCV's pixel centres are at 0, both of what is looked up and of the grid.
    coarse = (places - 0.5).reshape(grid.shape).astype(np.float32)
    at_y, at_x = ((np.arange(extent, dtype=np.float32) + 0.5) / _LENS_STEP_PX for extent in size)
    fine = cv2.remap(coarse, *np.meshgrid(at_x, at_y), cv2.INTER_LINEAR)
    fine = np.where(np.isfinite(fine), fine, np.float32(-2.0))
    bent = cv2.remap(mask, fine[..., 0], fine[..., 1], cv2.INTER_NEAREST, borderValue=0)
    return np.asarray(bent, mask.dtype)


def _mask_source(session: Session, camera: SessionCamera) -> FrameSource:
    recording = recording_of(session, camera)
    if not camera.has_masks and camera.background is None:
        raise SessionError(
            f"{session.path}: camera {camera.name!r} has no background; name a recording of the "
            "empty scene"
        )
    return recording


def mask_reading(session: Session, camera: SessionCamera) -> MaskReading:
    """Return how the ready masks of a camera are read, found from some of them.

    Raises
    ------
    SessionError
        If that cannot be told.
    """
    source = recording_of(session, camera)
    try:
        reading = reading_of(_looked_at(source), session.mask_threshold, session.mask_channel)
    except ValueError as error:
        raise SessionError(
            f"{session.path}: camera {camera.name!r}: {source.label!r}: {error}"
        ) from error
    _log.info(
        "camera %s: pixels of masks above %d are object (%s, up to %d)",
        camera.name,
        reading.above,
        reading.channel,
        reading.most,
    )
    return reading


def _looked_at(source: FrameSource) -> list[Image]:
    """Return some masks with something in them, spread over a recording where that is cheap."""
    n_frames = max(source.claimed_length(), 1)
    step = 1 if source.is_video else -(-n_frames // _MOST_LOOKED_AT)
    some: list[Image] = []
    starts = (0,) if step == 1 else range(step)  # those between where the first show nothing
    for start in starts:
        for image in source.frames_or_errors(start, None, step):
            if isinstance(image, SessionError):
                continue
            if not some or image.any():
                some.append(image)
            if len(some) > _MOST_LOOKED_AT:
                return some
        if any(image.any() for image in some):
            return some
    return some


def _make_cutter(session: Session, camera: SessionCamera) -> Callable[[Image], Mask]:
    if camera.has_masks or camera.background is None:
        return mask_reading(session, camera).mask
    segmenter = Segmenter(learn_background(camera.background.frames()), session.segmentation)
    return segmenter.segment


def _make_cutters(
    session: Session, progress: Callable[[str, int, int], None] | None
) -> list[Callable[[Image], Mask]]:
    with ThreadPoolExecutor(max_workers=len(session.cameras)) as pool:
        cutters = []
        for cutter in pool.map(partial(_make_cutter, session), session.cameras):
            cutters.append(cutter)
            if progress is not None:
                progress("background", len(cutters), len(session.cameras))
        return cutters


@dataclass(frozen=True, slots=True, eq=False)
class _Cut:
    """One camera's part of one frame, or the end of its recording."""

    mask: Mask | None
    reason: str
    decode_s: float = 0.0
    segment_s: float = 0.0
    ended: bool = False
    error: BaseException | None = None


class _Lane(threading.Thread):
    """Reads and segments one camera, a few frames ahead."""

    def __init__(
        self,
        camera: SessionCamera,
        source: FrameSource,
        cut: Callable[[Image], Mask],
        frames: FrameRange,
        undistortion: Undistortion | None,
    ) -> None:
        super().__init__(name=f"camera {camera.name}", daemon=True)
        self._camera = camera
        self._source = source
        self._cut = cut
        self._frames = frames
        self._undistortion = undistortion
        self._out: queue.Queue[_Cut] = queue.Queue(maxsize=_READ_AHEAD)
        self._stopped = threading.Event()

    def next_cut(self) -> _Cut:
        """Return the camera's part of the next frame; waits for it."""
        return self._out.get()

    def stop(self) -> None:
        """Have the thread end with the frame that it is at."""
        self._stopped.set()
        with suppress(queue.Empty):
            while True:
                self._out.get_nowait()

    def run(self) -> None:
        """Read, segment, undistort, hand over, until the recording ends."""
        try:
            for cut in self._cuts():
                if not self._put(cut):
                    return
            self._put(_Cut(None, f"camera {self._camera.name!r} has stopped recording", ended=True))
        except BaseException as error:
            self._put(_Cut(None, "", error=error))

    def _put(self, cut: _Cut) -> bool:
        while not self._stopped.is_set():
            with suppress(queue.Full):
                self._out.put(cut, timeout=0.2)
                return True
        return False

    def _cuts(self) -> Iterator[_Cut]:
        """Yield the camera's part of each frame; between two pictures where its clock lags."""
        frames, shift = self._frames, self._camera.shift_frames
        if not self._camera.lag:
            yield from self._pictures(frames, shift)
            return
        pairs: Iterable[tuple[_Cut, _Cut]]
        if frames.step == 1:
            stop = None if frames.stop is None else frames.stop + 1
            pairs = pairwise(self._pictures(replace(frames, stop=stop), shift + 1))
        else:
            later = self._pictures(frames, shift)
            pairs = zip(self._pictures(frames, shift + 1), later, strict=False)
        for before, after in pairs:
            yield self._between(before, after)

    def _between(self, before: _Cut, after: _Cut) -> _Cut:
        """Return the silhouette of an instant between two pictures."""
        if before.mask is None or after.mask is None:
            return after if after.mask is None else replace(before, decode_s=after.decode_s)
        started = time.thread_time()
        (mask,) = interpolate_masks([before.mask], [after.mask], 1.0 - self._camera.lag)
        return replace(after, mask=mask, segment_s=after.segment_s + time.thread_time() - started)

    def _pictures(self, frames: FrameRange, shift: int) -> Iterator[_Cut]:
        """Yield the silhouette of each picture: of the k-th of the camera at frame k + shift."""
        first = frames.start
        while first < shift and (frames.stop is None or first < frames.stop):
            yield _Cut(None, f"camera {self._camera.name!r} has not begun to record")
            first += frames.step
        stop = None if frames.stop is None else frames.stop - shift
        if stop is not None and stop <= first - shift:
            return
        images = self._source.frames_or_errors(first - shift, stop, frames.step)
        shape: tuple[int, ...] | None = None
        while True:
            started = time.thread_time()
            image = next(images, None)
            decoded = time.thread_time()
            if image is None:
                return
            if isinstance(image, SessionError):
                yield _Cut(None, f"camera {self._camera.name!r}: {image}", decoded - started)
                continue
            shape = shape or image.shape
            if image.shape != shape:
                yield _Cut(
                    None,
                    f"camera {self._camera.name!r}: the picture is {image.shape[1]}x"
                    f"{image.shape[0]}, those before are {shape[1]}x{shape[0]}",
                    decoded - started,
                )
                continue
            try:
                mask = self._cut(image)
            except ValueError as error:
                yield _Cut(None, f"camera {self._camera.name!r}: {error}", decoded - started)
                continue
            if self._undistortion is not None:
                mask = undistort_mask(mask, self._undistortion)
            yield _Cut(mask, "", decoded - started, time.thread_time() - decoded)


def _side_by_side(
    session: Session,
    sources: list[FrameSource],
    cutters: list[Callable[[Image], Mask]],
    frames: FrameRange,
    undistortions: list[Undistortion] | None,
) -> Generator[FrameSilhouettes]:
    lanes = [
        _Lane(camera, source, cutter, frames, undistortions[number] if undistortions else None)
        for number, (camera, source, cutter) in enumerate(
            zip(session.cameras, sources, cutters, strict=True)
        )
    ]
    for lane in lanes:
        lane.start()
    try:
        index = frames.start
        last: list[_Cut | None] = [None] * len(lanes)
        while True:
            cuts = []
            for number, lane in enumerate(lanes):
                before = last[number]
                cut = before if before is not None and before.ended else lane.next_cut()
                if cut.error is not None:
                    raise cut.error
                last[number] = cut
                cuts.append(cut)
            if all(cut.ended for cut in cuts):
                return
            reasons = [cut.reason for cut in cuts if cut.mask is None]
            yield FrameSilhouettes(
                index,
                None if reasons else [cut.mask for cut in cuts if cut.mask is not None],
                "; ".join(reasons),
                sum(0.0 if cut.ended else cut.decode_s for cut in cuts),
                sum(0.0 if cut.ended else cut.segment_s for cut in cuts),
            )
            index += frames.step
    finally:
        for lane in lanes:
            lane.stop()
        # A thread that is inside a library when Python ends takes the whole process down.
        for lane in lanes:
            lane.join()
