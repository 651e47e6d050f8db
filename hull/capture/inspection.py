"""What the files of a session are, camera by camera, told without reading a recording to its end.

A `glance` takes a moment: of all pictures and clips that a camera names the first one is read, some
are asked for their size and their tags, and all are compared. Every command that works long begins
with it, and tells all that is wrong in one go (`opened_session`). `inspect_camera` looks at every
file besides: that it is not empty, and begins as a picture does; of videos at the header and, of an
AVI, at the index.
"""

import logging
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from hybridve.calib.avi_index import avi_frames
from hybridve.calib.errors import Faults, SessionError
from hybridve.calib.image_io import FrameSource
from hybridve.calib.opencv_files import picture_size
from hybridve.calib.orientation import said_orientation
from hybridve.calib.plain import Told
from hybridve.hull.capture.recording import HEADER_SLACK, mask_reading
from hybridve.hull.capture.session import Session, SessionCamera, load_session

_log = logging.getLogger(__name__)

#: The keys of a camera that name its recording.
RECORDINGS = ("video", "masks")

#: Names that a message lists at most.
_MOST_LISTED = 3

#: Pictures of one key whose tags are looked at, spread over all.
_MOST_TAGS = 40

#: Two sizes are of one shape if their ratios differ by less than this.
_SAME_SHAPE = 0.005


@dataclass(frozen=True, slots=True)
class SourceCheck(Told):
    """The pictures or the clip that one key of a camera names.

    Attributes
    ----------
    key : str
        "intrinsics", "extrinsics", "background", "video" or "masks".
    label : str
        What the session says.
    is_video : bool
        Whether it is one video.
    width_px, height_px : int
        Of the first picture; 0 if it cannot be read.
    bits : int
        Bits of a channel as stored, 8 or 16.
    channels : int
        1 grey, 3 colours, 4 with alpha; of a video 3.
    n_frames : int
        Of images how many, of a video what its header says. Of a recording of numbered images
        those that are missing count, too.
    n_missing : int
        How many instants other cameras have an image of, and this one has none.
    n_lost, n_damaged : int
        Frames of an AVI that its index has and the file has not, and those with a hole.
    rate_hz : float or None
        Frames a second, where a video says.
    orientation : str
        How it wants to be turned to be looked at; "" if it says nothing. Nothing is turned.
    """

    key: str
    label: str
    is_video: bool
    width_px: int
    height_px: int
    bits: int
    channels: int
    n_frames: int
    n_missing: int
    n_lost: int
    n_damaged: int
    rate_hz: float | None
    orientation: str


@dataclass(frozen=True, slots=True)
class CameraFiles(Told):
    """What one camera's files are.

    Attributes
    ----------
    name : str
        The camera.
    sources : tuple of SourceCheck
        Those that the session names.
    masks : str
        How ready masks are read; "" of a camera without, or where it cannot be told.
    problems, notes : tuple of str
        What makes a run impossible, and what else is worth a look, a line each.
    """

    name: str
    sources: tuple[SourceCheck, ...]
    masks: str
    problems: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def recording(self) -> SourceCheck | None:
        """The task's recording, if the session names one."""
        return next((one for one in self.sources if one.key in RECORDINGS), None)

    def source(self, key: str) -> SourceCheck | None:
        """Return what one key names, if it does."""
        return next((one for one in self.sources if one.key == key), None)


def opened_session(path: Path, without: Collection[str] = ()) -> Session:
    """Return a session, glanced at: what would fail later is told before any work, all in one go.

    What is odd about its tags is logged as a warning.

    Parameters
    ----------
    path : Path
        A session.toml, or its folder.
    without : collection of str
        Cameras that will not be used, by name.

    Raises
    ------
    SessionError
        A line for each thing that is wrong.
    """
    session = load_session(path)
    numbers = [
        number for number, camera in enumerate(session.cameras) if camera.name not in without
    ]
    with ThreadPoolExecutor(max_workers=max(1, len(numbers))) as pool:
        found = list(pool.map(lambda number: glance(session, number), numbers))
    if problems := [line for one in found for line in one.problems]:
        raise SessionError(*problems)
    for one in found:
        for line in one.tag_notes:
            _log.warning("%s", line)
    return session


def opened_sessions(paths: Mapping[str, Path], without: Collection[str] = ()) -> dict[str, Session]:
    """Return several sessions, by name, each as `opened_session` gives it.

    Raises
    ------
    SessionError
        A line for each thing that is wrong with any of them.
    """
    faults = Faults()
    opened = {}
    for name, path in paths.items():
        session = faults.of(partial(opened_session, path, without))
        if session is not None:
            opened[name] = session
    faults.refuse()
    return opened


@dataclass(frozen=True, slots=True)
class GlancedSource:
    """What a moment's look at one key of a camera tells.

    Attributes
    ----------
    key : str
        "intrinsics", "extrinsics", "background", "video" or "masks".
    source : FrameSource
        What it names.
    width_px, height_px, channels, bits : int
        Of the first picture; 0 by 0 if it cannot be read.
    orientation : str
        How its files want to be turned; "mixed" where they differ, "" where they say nothing.
    """

    key: str
    source: FrameSource
    width_px: int
    height_px: int
    channels: int
    bits: int
    orientation: str

    @property
    def size(self) -> str:
        """Its size in words."""
        return f"{self.width_px}x{self.height_px}"

    def is_turned_from(self, other: "GlancedSource") -> bool:
        """Tell whether it is as wide as the other is high, and as high as that is wide."""
        return (self.width_px, self.height_px) == (other.height_px, other.width_px)


@dataclass(frozen=True, slots=True)
class GlancedCamera:
    """What a moment's look at one camera's files tells.

    Attributes
    ----------
    sources : tuple of GlancedSource
        A look at each of its keys.
    problems, notes, tag_notes : tuple of str
        What makes a run impossible, what else is worth a look, and what is odd about tags that say
        how to turn a picture; a line each.
    """

    sources: tuple[GlancedSource, ...]
    problems: tuple[str, ...]
    notes: tuple[str, ...]
    tag_notes: tuple[str, ...]


def glance(session: Session, number: int) -> GlancedCamera:
    """Return what a moment's look tells of a camera's files, by its place in the session."""
    camera = session.cameras[number]
    where = f"{session.path}: camera.{number + 1}"
    problems: list[str] = []
    notes: list[str] = []
    tag_notes: list[str] = []
    sources = tuple(
        _glance(source, key, f"{where}.{key}", problems, tag_notes)
        for key, source in _sources_of(camera).items()
        if source is not None
    )
    _compare_sizes(sources, where, problems, notes)
    _compare_orientations(sources, where, tag_notes)
    return GlancedCamera(sources, tuple(problems), tuple(notes), tuple(tag_notes))


def _glance(
    source: FrameSource, key: str, where: str, problems: list[str], tag_notes: list[str]
) -> GlancedSource:
    height_px = width_px = channels = 0
    bits = 8
    try:
        # As it is stored: what is read to 8 bits and 3 colours no longer tells.
        first = source if source.is_video else FrameSource(source.label, source.paths, False, True)
        image = first.first()
        height_px, width_px = image.shape[:2]
        channels = 1 if image.ndim == 2 else image.shape[2]
        bits = 16 if image.dtype == np.uint16 else 8
    except SessionError as error:
        problems.append(f"{where}: {error}; copy it again, or take out what is none")
    some = source.paths[:: -(-len(source.paths) // _MOST_TAGS)]
    if not source.is_video:
        sizes = {path: picture_size(path) for path in some}
        turned = [path for path, size in sizes.items() if size == (height_px, width_px)]
        if turned and height_px != width_px:
            problems.append(
                f"{where}: {source.label!r}: {turned[0].name!r} is {height_px}x{width_px}, the "
                f"first picture {width_px}x{height_px}: some were turned when they were saved; "
                f"{_AS_RECORDED}"
            )
    marks = {said_orientation(path, is_video=source.is_video) for path in some}
    if len(marks) > 1:
        told = ", ".join(sorted(mark or "upright" for mark in marks))
        tag_notes.append(
            f"{where}: the pictures of {source.label!r} say that they are {told}; they are read "
            "as the sensor has them, so the camera must not have been turned between them"
        )
    orientation = "mixed" if len(marks) > 1 else next(iter(marks))
    return GlancedSource(key, source, width_px, height_px, channels, bits, orientation)


#: What to do about pictures that were turned by a program.
_AS_RECORDED = "give all as the camera wrote them"


def inspect_camera(session: Session, number: int) -> CameraFiles:
    """Return what the files of a session's camera are, by its place in the session."""
    camera = session.cameras[number]
    where = f"{session.path}: camera.{number + 1}"
    looked = glance(session, number)
    problems: list[str] = list(looked.problems)
    notes: list[str] = list(looked.notes)
    sources = [
        _inspect(session, one, f"{where}.{one.key}", problems, notes) for one in looked.sources
    ]
    masks = ""
    if camera.has_masks and camera.recording is not None:
        try:
            reading = mask_reading(session, camera)
            masks = f"{reading.channel} above {reading.above} of {reading.most}"
        except SessionError as error:
            problems.append(str(error))
    notes += looked.tag_notes
    return CameraFiles(camera.name, tuple(sources), masks, tuple(problems), tuple(notes))


def _sources_of(camera: SessionCamera) -> dict[str, FrameSource | None]:
    return {
        "intrinsics": camera.intrinsics,
        "extrinsics": camera.extrinsics,
        "background": camera.background,
        "masks" if camera.has_masks else "video": camera.recording,
    }


def _inspect(
    session: Session, looked: GlancedSource, where: str, problems: list[str], notes: list[str]
) -> SourceCheck:
    source, key = looked.source, looked.key
    unreadable = [path for path in source.paths if not _begins_well(path, source.is_video)]
    if unreadable and looked.width_px:  # else the first is told already
        problems.append(
            f"{where}: {_named(unreadable, len(source.paths))} cannot be read: empty, or no "
            f"{'video' if source.is_video else 'picture'}; copy again, or take out what is none"
        )
    # A recording's frames are numbered with those that nobody has.
    is_counted = source.is_video or key in RECORDINGS
    n_frames = source.claimed_length() if is_counted else len(source.paths)
    avi = avi_frames(source.paths[0]) if source.is_video else None
    n_lost, n_damaged = (0, 0) if avi is None else (len(avi.unreachable), len(avi.damaged))
    if n_lost or n_damaged:
        notes.append(
            f"{where}: {source.label!r}: of {n_frames} frames {n_lost} are lost and {n_damaged} "
            "damaged; each becomes a frame without a picture, the others stay in their places"
        )
    n_missing = _n_lacking(session, key, source)
    if n_missing:
        notes.append(
            f"{where}: {source.label!r} lacks {n_missing} of the instants of which other cameras "
            "have pictures; the others stay in their places"
        )
    return SourceCheck(
        key,
        source.label,
        source.is_video,
        looked.width_px,
        looked.height_px,
        looked.bits,
        looked.channels,
        n_frames,
        n_missing,
        n_lost,
        n_damaged,
        source.rate(),
        looked.orientation,
    )


def _begins_well(path: Path, is_video: bool) -> bool:
    try:
        if path.stat().st_size == 0:
            return False
    except OSError:
        return False
    return is_video or bool(cv2.haveImageReader(str(path)))


def _named(paths: list[Path], of: int) -> str:
    names = ", ".join(repr(path.name) for path in paths[:_MOST_LISTED])
    more = ", ..." if len(paths) > _MOST_LISTED else ""
    return f"{len(paths)} of {of} files ({names}{more})"


def _n_lacking(session: Session, key: str, source: FrameSource) -> int:
    """Return how many instants other cameras have a picture of, and this one has none."""
    others = [_sources_of(camera).get(key) for camera in session.cameras]
    same = [one for one in others if one is not None and len(one.slots) == len(source.slots)]
    return sum(
        slot < 0 and any(one.slots[at] >= 0 for one in same) for at, slot in enumerate(source.slots)
    )


def _compare_sizes(
    sources: tuple[GlancedSource, ...], where: str, problems: list[str], notes: list[str]
) -> None:
    """Tell which pictures of a camera are of another size than its recording, or its board clip."""
    known = {one.key: one for one in sources if one.width_px}
    recording = known.get("video") or known.get("masks")
    for key in ("extrinsics", "background"):
        one = known.get(key)
        if one is None or recording is None or one.size == recording.size:
            continue
        what_to_do = "record both with the same settings"
        if one.is_turned_from(recording):
            what_to_do = f"one was turned when it was saved; {_AS_RECORDED}"
        problems.append(
            f"{where}.{key}: {one.source.label!r} is {one.size}, but {recording.source.label!r} is "
            f"{recording.size}; {what_to_do}"
        )
    stills, clip = known.get("intrinsics"), known.get("extrinsics") or recording
    if stills is None or clip is None or stills.size == clip.size:
        return
    ratio = stills.width_px * clip.height_px / (stills.height_px * clip.width_px)
    text = (
        f"{where}.intrinsics: {stills.source.label!r} is {stills.size}, but {clip.source.label!r} "
        f"is {clip.size}"
    )
    if abs(ratio - 1.0) < _SAME_SHAPE:
        notes.append(f"{text}; the lens is scaled, which is wrong where the clip was cut out of it")
    elif abs(stills.width_px * clip.width_px / (stills.height_px * clip.height_px) - 1.0) < (
        _SAME_SHAPE
    ):
        problems.append(f"{text}: one was turned when it was saved; {_AS_RECORDED}")
    else:
        problems.append(f"{text}, of another shape; record both in the same mode")


def _compare_orientations(
    sources: tuple[GlancedSource, ...], where: str, tag_notes: list[str]
) -> None:
    said = {one.key: one.orientation for one in sources if one.orientation != "mixed"}
    if len(set(said.values())) > 1:
        told = ", ".join(f"{key} {mark or 'upright'}" for key, mark in said.items())
        tag_notes.append(
            f"{where}: its files say to be looked at differently ({told}); all are read as the "
            "sensor has them, so the camera must not have been turned between them"
        )


def compare_cameras(path: Path, cameras: tuple[CameraFiles, ...]) -> list[str]:
    """Return a line for each way in which the recordings of cameras differ."""
    recordings = {one.name: one.recording for one in cameras if one.recording is not None}
    notes = []
    kinds: list[tuple[str, Callable[[SourceCheck], object]]] = [
        ("frames a second", lambda one: one.rate_hz),
        ("bits", lambda one: one.bits),
    ]
    if recordings:
        counts = {name: one.n_frames for name, one in recordings.items()}
        least, most = min(counts, key=counts.__getitem__), max(counts, key=counts.__getitem__)
        slack = HEADER_SLACK if any(one.is_video for one in recordings.values()) else 0
        if counts[most] - counts[least] > slack:
            notes.append(
                f"{path}: camera {least!r} has {counts[least]} frames, camera {most!r} "
                f"{counts[most]}; frames that a camera lacks are not evaluated"
            )
    for what, value in kinds:
        values = {name: value(one) for name, one in recordings.items()}
        if len(set(values.values())) > 1:
            told = ", ".join(
                f"{name} {one if one is not None else '?'}" for name, one in values.items()
            )
            notes.append(f"{path}: the recordings differ in {what}: {told}")
    return notes
