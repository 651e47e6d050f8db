"""What the files of a session are, camera by camera, told without reading a recording to its end.

Every file is looked at: that it is there, not empty, and begins as a picture does. Of pictures the
first is read, of videos the first frame, the header and, of an AVI, the index.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hybridve.calib.avi_index import avi_frames
from hybridve.calib.errors import SessionError
from hybridve.calib.image_io import FrameSource, open_source
from hybridve.calib.orientation import said_orientation
from hybridve.calib.plain import Told
from hybridve.hull.capture.recording import mask_reading
from hybridve.hull.capture.session import Session, SessionCamera
from hybridve.hull.toml_io import expand_root, read_toml

#: The keys of a camera that name pictures or clips, in the order of the work; and the recording's.
SOURCES = ("intrinsics", "extrinsics", "background", "video", "masks")
RECORDINGS = ("video", "masks")

#: Names that a message lists at most.
_MOST_LISTED = 3

#: Pictures of one key whose tags are looked at, spread over all.
_MOST_TAGS = 40

#: Two sizes are of one shape if their ratios differ by less than this.
_SAME_SHAPE = 0.005

#: How many frames a header may be off without a word: containers count what codecs hold back.
HEADER_SLACK = 5


@dataclass(frozen=True, slots=True)
class SourceCheck(Told):
    """The pictures or the clip that one key of a camera names.

    Attributes
    ----------
    key : str
        One of `SOURCES`.
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


def missing_files(path: Path) -> list[str]:
    """Return a line for every file that a session.toml names and that cannot be opened.

    It is for a session that cannot be loaded: the first of its faults is told there, and all files
    here. Empty where something else is the matter with it.
    """
    if path.is_dir():
        path = path / "session.toml"
    table, _ = read_toml(path, "session", SessionError)
    cameras = table.get("camera")
    if not isinstance(cameras, list) or not isinstance(table.get("root", "."), str):
        return []
    root = expand_root(table.get("root", "."), path, SessionError)
    lines = []
    for number, camera in enumerate(cameras, start=1):
        for key in SOURCES if isinstance(camera, dict) else ():
            if not isinstance(camera.get(key), str):
                continue
            try:
                open_source(root, camera[key])
            except SessionError as error:
                lines.append(f"{path}: camera.{number}.{key}: {error}")
    return lines


def inspect_camera(session: Session, number: int) -> CameraFiles:
    """Return what the files of a session's camera are, by its place in the session."""
    camera = session.cameras[number]
    where = f"{session.path}: camera.{number + 1}"
    problems: list[str] = []
    notes: list[str] = []
    sources = [
        _inspect(session, source, key, f"{where}.{key}", problems, notes)
        for key, source in _sources_of(camera).items()
        if source is not None
    ]
    masks = ""
    if camera.has_masks and camera.recording is not None:
        try:
            reading = mask_reading(session, camera)
            masks = f"{reading.channel} above {reading.above} of {reading.most}"
        except SessionError as error:
            problems.append(str(error))
    found = CameraFiles(camera.name, tuple(sources), masks, (), ())
    _compare_sizes(found, where, problems, notes)
    _compare_orientations(found, where, notes)
    return CameraFiles(camera.name, tuple(sources), masks, tuple(problems), tuple(notes))


def _sources_of(camera: SessionCamera) -> dict[str, FrameSource | None]:
    return {
        "intrinsics": camera.intrinsics,
        "extrinsics": camera.extrinsics,
        "background": camera.background,
        "masks" if camera.has_masks else "video": camera.recording,
    }


def _inspect(
    session: Session,
    source: FrameSource,
    key: str,
    where: str,
    problems: list[str],
    notes: list[str],
) -> SourceCheck:
    unreadable = [path for path in source.paths if not _begins_well(path, source.is_video)]
    if unreadable:
        problems.append(
            f"{where}: {_named(unreadable, len(source.paths))} cannot be read: empty, or no "
            f"{'video' if source.is_video else 'picture'}; copy again, or take out what is none"
        )
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
        if not unreadable:
            problems.append(f"{where}: {error}")
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
    some = source.paths[:: -(-len(source.paths) // _MOST_TAGS)]
    marks = {said_orientation(path, is_video=source.is_video) for path in some}
    if len(marks) > 1:
        told = ", ".join(sorted(mark or "upright" for mark in marks))
        notes.append(
            f"{where}: the pictures of {source.label!r} say that they are {told}; they are read "
            "as the sensor has them, so the camera must not have been turned between them"
        )
    return SourceCheck(
        key,
        source.label,
        source.is_video,
        width_px,
        height_px,
        bits,
        channels,
        n_frames,
        n_missing,
        n_lost,
        n_damaged,
        source.rate(),
        "mixed" if len(marks) > 1 else next(iter(marks)),
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


def _compare_sizes(found: CameraFiles, where: str, problems: list[str], notes: list[str]) -> None:
    """Tell which pictures of a camera are of another size than its recording, or its board clip."""
    recording, clip = found.recording, found.source("extrinsics")
    for key in ("extrinsics", "background"):
        one = found.source(key)
        if one is None or recording is None or not one.width_px or not recording.width_px:
            continue
        if (one.width_px, one.height_px) != (recording.width_px, recording.height_px):
            problems.append(
                f"{where}.{key}: {one.label!r} is {one.width_px}x{one.height_px}, but "
                f"{recording.label!r} is {recording.width_px}x{recording.height_px}; record both "
                "with the same settings"
            )
    stills, clip = found.source("intrinsics"), clip or recording
    if stills is None or clip is None or not stills.width_px or not clip.width_px:
        return
    if (stills.width_px, stills.height_px) == (clip.width_px, clip.height_px):
        return
    ratio = stills.width_px * clip.height_px / (stills.height_px * clip.width_px)
    text = (
        f"{where}.intrinsics: {stills.label!r} is {stills.width_px}x{stills.height_px}, but "
        f"{clip.label!r} is {clip.width_px}x{clip.height_px}"
    )
    if abs(ratio - 1.0) < _SAME_SHAPE:
        notes.append(f"{text}; the lens is scaled, which is wrong where the clip was cut out of it")
    else:
        problems.append(f"{text}, of another shape; record both in the same mode")


def _compare_orientations(found: CameraFiles, where: str, notes: list[str]) -> None:
    said = {one.key: one.orientation for one in found.sources if one.orientation != "mixed"}
    if len(set(said.values())) > 1:
        told = ", ".join(f"{key} {mark or 'upright'}" for key, mark in said.items())
        notes.append(
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
