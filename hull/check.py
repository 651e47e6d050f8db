"""A look at a session, and at a layout in it, before a long run: in seconds, on a few frames.

::

    files of each camera -------------+
    a few frames, cut out ------------+-> SessionCheck: problems, notes, what a run will take
    rig -> what the cameras say ------+
    scene -> sizes, places, a trial --+

A *problem* makes a run impossible. A *note* is worth a look: a run would go through, and its result
may not be what was wanted.
"""

import logging
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import Faults, SessionError
from hybridve.calib.plain import Told
from hybridve.calib.rig import Rig
from hybridve.hull.agreement.blank import BlankKind, BlankLooks, blank_cameras, blank_message
from hybridve.hull.agreement.common_view import CommonView, common_view
from hybridve.hull.agreement.layout import first_seen, odd_parts
from hybridve.hull.agreement.outlines import FrameOutlines
from hybridve.hull.agreement.record import SessionAgreement
from hybridve.hull.agreement.sight import sight_of
from hybridve.hull.batch import DetectSettings, write_report
from hybridve.hull.cad.scene import Scene, SceneObject, load_scene
from hybridve.hull.capture.inspection import (
    CameraFiles,
    compare_cameras,
    inspect_camera,
)
from hybridve.hull.capture.recording import (
    HEADER_SLACK,
    FrameRange,
    Mask,
    check_lengths,
    recorded_sizes,
    segmented_frames,
    undistort_mask,
)
from hybridve.hull.capture.rig import has_rig, load_rig
from hybridve.hull.capture.room_check import RoomCheck, check_room
from hybridve.hull.capture.session import Session, load_session
from hybridve.hull.capture.silhouette_io import SilhouetteWriter
from hybridve.hull.capture.tracks import Tracks, read_tracks
from hybridve.hull.chain import EvaluateSettings, first_rig, make_chain, moved_views, rig_views
from hybridve.hull.effects.kinds import read_entries
from hybridve.hull.query.silhouettes import Views, make_hull
from hybridve.hull.report.read import read_report
from hybridve.hull.trust import Witness, judge_cameras
from hybridve.hull.watcher import Watcher

#: Frames that are looked at, spread over the recording from its first to its last.
N_LOOKS = 9

#: Videos are read on from their beginning, and so far at most: a look is to take seconds.
_MOST_READ = 3000

#: Frames that are evaluated, in the middle of those looked at, to tell what a run takes.
_N_TRIED = 6

#: Frames spread over a recording in which a silhouette is the very same, from which on it is told.
_LEAST_SAME = 3


@dataclass(frozen=True, slots=True)
class CameraLooks(Told):
    """What a camera shows in the frames that were looked at.

    Attributes
    ----------
    name : str
        The camera.
    object_share : tuple of float or None
        Of each frame, which share of its pixels is object; None where a camera lacks the frame.
    """

    name: str
    object_share: tuple[float | None, ...]


@dataclass(frozen=True, slots=True)
class ObjectCheck(Told):
    """One object of the scene.

    Attributes
    ----------
    name : str
        The object.
    size_mm : (x, y, z)
        The extents of its bounding box along the world's axes.
    low_mm, high_mm : (x, y, z)
        Its corners, in the world.
    n_triangles : int
        How many.
    is_closed : bool
        Whether it has an inside.
    seen_share : float or None
        The share of its surface that cameras enough see; None without a rig, or where a camera
        moves. An object that moves is where it is in the first frame that has its pose.
    """

    name: str
    size_mm: tuple[float, float, float]
    low_mm: tuple[float, float, float]
    high_mm: tuple[float, float, float]
    n_triangles: int
    is_closed: bool
    seen_share: float | None


@dataclass(frozen=True, slots=True)
class Cost(Told):
    """What a run over all frames will take on this machine: estimates from a few frames.

    Attributes
    ----------
    n_frames : int
        How many that is.
    read_s, evaluate_s : float
        To read and cut out all frames, cameras side by side; and to evaluate them.
    memory_bytes : int or None
        What this look took at most, which is what a run takes: it does not grow with the frames.
        None where the system does not tell.
    disk_bytes : int or None
        Of the report; None without a scene.
    engine : str
        What evaluated; "" without a scene.
    """

    n_frames: int
    read_s: float
    evaluate_s: float
    memory_bytes: int | None
    disk_bytes: int | None
    engine: str


@dataclass(frozen=True, slots=True)
class SessionCheck(Told):
    """What there is to say of a session before a run.

    Attributes
    ----------
    session : str
        The session.toml.
    fps : float or None
        Frames a second, as the session or its videos say; None if it could not be loaded.
    cameras : tuple of CameraFiles
        Their files.
    frames : tuple of int
        Numbers of the frames that were looked at.
    looks : tuple of CameraLooks
        What they show.
    rig : str
        How the rig stands: "made here", "agrees", ..., "not looked at" where there is no recording
        that it would be used for, or "none".
    agreement : SessionAgreement
        What the cameras say about each other on these frames.
    objects : tuple of ObjectCheck
        Those of the scene, if one was given.
    effects : tuple of str
        What the scene names to be simulated.
    cost : Cost or None
        What a run will take; None where nothing could be evaluated.
    problems, notes : tuple of str
        See the module.
    """

    session: str
    fps: float | None = None
    cameras: tuple[CameraFiles, ...] = ()
    frames: tuple[int, ...] = ()
    looks: tuple[CameraLooks, ...] = ()
    rig: str = "none"
    agreement: SessionAgreement = field(default_factory=SessionAgreement)
    objects: tuple[ObjectCheck, ...] = ()
    effects: tuple[str, ...] = ()
    cost: Cost | None = None
    problems: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(slots=True, eq=False)
class Look:
    """What was seen, for who draws it.

    Attributes
    ----------
    session : Session or None
        The session, if it could be loaded.
    masks : dict of int to list of (H, W) uint8
        By frame, those of all cameras, as recorded.
    """

    session: Session | None = None
    masks: dict[int, list[Mask]] = field(default_factory=dict)


@dataclass(slots=True, eq=False)
class _Frames:
    """The frames that were looked at, and what reading them took."""

    n_frames: int
    n_planned: int
    step: int
    index: list[int] = field(default_factory=list)
    masks: list[list[Mask] | None] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    decode_s: float = 0.0
    segment_s: float = 0.0


def check_session(
    path: Path, scene: Path | None, settings: EvaluateSettings, watcher: Watcher
) -> tuple[SessionCheck, Look]:
    """Return what there is to say of a session, and of a layout in it, and what was looked at.

    What a run would log as a warning is a note here, and is not logged.

    Parameters
    ----------
    path : Path
        A session.toml or its folder.
    scene : Path, optional
        A scene.toml.
    settings : EvaluateSettings
        How a run would evaluate; which frames is chosen here.
    watcher : Watcher
        Told how the look goes on.
    """
    notes: list[str] = []
    with _warnings_noted(notes):
        return _check(path, scene, settings, watcher, notes)


def _check(
    path: Path, scene: Path | None, settings: EvaluateSettings, watcher: Watcher, notes: list[str]
) -> tuple[SessionCheck, Look]:
    asked = Faults()
    problems = asked.lines
    look = Look(asked.of(lambda: load_session(path)))
    if look.session is None:
        return SessionCheck(str(path), problems=tuple(problems)), look
    session = look.session
    layout = None if scene is None else asked.of(lambda: load_scene(scene))
    effects = () if layout is None else asked.of(lambda: _effects(layout)) or ()
    with ThreadPoolExecutor(max_workers=len(session.cameras)) as pool:
        numbers = range(len(session.cameras))
        cameras = tuple(pool.map(lambda number: inspect_camera(session, number), numbers))
    for one in cameras:
        problems += one.problems
        notes += one.notes
    notes += compare_cameras(session.path, cameras)
    found = SessionCheck(str(session.path), session.fps, cameras, effects=effects)
    is_recorded = all(camera.recording is not None for camera in session.cameras)
    rig, room = None, RoomCheck()
    if has_rig(session):
        found = replace(found, rig="not looked at")
    if is_recorded and has_rig(session) and not problems:
        rig = asked.of(lambda: load_rig(session, watcher.stage))
        if rig is not None:
            room = check_room(session, rig, watcher.stage)
            found = replace(found, rig="given" if rig.check is None else rig.check.verdict)
    if is_recorded and not any(one.problems for one in cameras):
        frames = asked.of(lambda: _looked_at(session, cameras, watcher))
        if frames is not None:
            looks = _looks(session, frames, notes)
            found = replace(found, frames=tuple(frames.index), looks=looks)
            look.masks = {
                index: masks
                for index, masks in zip(frames.index, frames.masks, strict=True)
                if masks is not None
            }
            if rig is not None:
                agreement = asked.of(lambda: _agreement(session, rig, room, frames))
                found = replace(found, agreement=agreement or found.agreement)
            cost = asked.of(
                lambda: _cost(session, layout if rig else None, settings, frames, watcher)
            )
            found = replace(found, cost=cost)
    notes += [cause.message for cause in found.agreement.causes]
    if layout is not None:
        views = None if rig is None else asked.of(lambda: _still_views(session, rig))
        objects = tuple(_object(one, views) for one in layout.objects)
        notes += _placing_notes(layout, objects, views)
        found = replace(found, objects=objects)
    found = replace(
        found,
        problems=tuple(dict.fromkeys(problems)),
        notes=tuple(dict.fromkeys(notes)),
    )
    return found, look


class _Notes(logging.Handler):
    """Keeps what is logged as a warning."""

    def __init__(self, notes: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._notes = notes

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a message."""
        self._notes.append(record.getMessage())


@contextmanager
def _warnings_noted(notes: list[str]) -> Iterator[None]:
    """Have warnings of this package noted, and not logged, while the block runs."""

    def is_shown(record: logging.LogRecord) -> bool:
        return record.levelno < logging.WARNING or not record.name.startswith("hybridve.")

    logger, handlers = logging.getLogger("hybridve"), logging.getLogger().handlers[:]
    noting = _Notes(notes)
    logger.addHandler(noting)
    for handler in handlers:
        handler.addFilter(is_shown)
    try:
        yield
    finally:
        for handler in handlers:
            handler.removeFilter(is_shown)
        logger.removeHandler(noting)


def _effects(layout: Scene) -> tuple[str, ...]:
    return tuple(str(entry.table.kind) for entry, _ in read_entries(layout))


# --- Frames -----------------------------------------------------------------------------------


def _looked_at(session: Session, cameras: Sequence[CameraFiles], watcher: Watcher) -> _Frames:
    """Return a few frames, spread over the recording, cut out as a run would."""
    check_lengths(session, FrameRange())
    lengths = [
        one.recording.n_frames + camera.shift_frames
        for one, camera in zip(cameras, session.cameras, strict=True)
        if one.recording is not None
    ]
    end = min(lengths)
    if any(one.recording is not None and one.recording.is_video for one in cameras):
        # A header may promise a few frames more than there are.
        end = min(end - min(HEADER_SLACK, end // 20), _MOST_READ)
    step = max(1, (end - 1) // (N_LOOKS - 1))
    end = max(end, 1)
    found = _Frames(max(max(lengths), 1), len(range(0, end, step)), step)
    chosen = FrameRange(0, end, step)
    with closing(segmented_frames(session, chosen, progress=watcher.stage)) as frames:
        for frame in frames:
            found.index.append(frame.index)
            found.masks.append(frame.masks)
            found.reasons.append(frame.reason)
            found.decode_s += frame.decode_s
            found.segment_s += frame.segment_s
            watcher.stage("looking", len(found.index), found.n_planned)
    if not found.index:
        raise SessionError(f"{session.path}: no frame can be read of any camera")
    return found


def _looks(session: Session, frames: _Frames, notes: list[str]) -> tuple[CameraLooks, ...]:
    """Return what the cameras show, and note what is odd about it."""
    looks = []
    for number, camera in enumerate(session.cameras):
        masks = [None if every is None else every[number] for every in frames.masks]
        shares = tuple(None if one is None else float(one.mean()) for one in masks)
        looks.append(CameraLooks(camera.name, shares))
    notes += _blank_notes(session, frames)
    unread = [at for at, masks in enumerate(frames.masks) if masks is None]
    if unread:
        notes.append(
            f"{session.path}: {len(unread)} of {len(frames.index)} frames looked at have not the "
            f"pictures of all cameras and would not be evaluated; the first is frame "
            f"{frames.index[unread[0]]}: {frames.reasons[unread[0]]}"
        )
    if len(frames.index) < frames.n_planned:
        notes.append(
            f"{session.path}: the recordings end before frame {frames.index[-1] + frames.step}, "
            f"where their headers say {frames.n_frames} frames; were they cut off?"
        )
    return tuple(looks)


def _blank_notes(session: Session, frames: _Frames) -> list[str]:
    """Return what there is to say of cameras that show one and the same in all frames."""
    looks = BlankLooks()
    for index, masks in zip(frames.index, frames.masks, strict=True):
        if masks is not None:
            looks.take(index, masks)
    names = [camera.name for camera in session.cameras]
    return [
        f"{session.path}: "
        + blank_message(
            one,
            names,
            has_masks=session.cameras[one.cameras[0]].has_masks,
            looked=" looked at",
        )
        for one in blank_cameras(looks.shares, looks.is_same, _LEAST_SAME)
    ]


def _still_views(session: Session, rig: Rig) -> Views | None:
    """Return the cameras' views; None where one moves, and sees another place in each frame."""
    return None if read_tracks(session, rig) else rig_views(session, rig)[0]


def _agreement(session: Session, rig: Rig, room: RoomCheck, frames: _Frames) -> SessionAgreement:
    """Return what the cameras say about each other on the frames that were looked at.

    Which single frames are odd is left out: so few do not tell what is usual.
    """
    tracks: Tracks = read_tracks(session, rig)
    first, lenses = rig_views(session, first_rig(rig, tracks))
    if not tracks and (common := common_view(first)).kind == "none":
        raise SessionError(f"{session.path}: nothing can be in the hull: {common.reason}")
    witness = Witness.of(first, lenses, is_still=not tracks)
    seen = []
    for index, masks in zip(frames.index, frames.masks, strict=True):
        if masks is None or tracks.missing(index):
            seen.append(FrameOutlines.unread(index, len(first)))
            continue
        views = moved_views(session, rig, tracks, index, first, lenses)
        flat = [undistort_mask(mask, lens) for mask, lens in zip(masks, lenses, strict=True)]
        seen.append(witness.look(index, make_hull(views, flat))[1])
    found = judge_cameras(session, first, seen, room, lenses=lenses, is_still=not tracks)
    # What shows one and the same is noted of the silhouettes themselves, rig or not.
    left_out = {"frames", *get_args(BlankKind)}
    return replace(found, causes=tuple(one for one in found.causes if one.kind not in left_out))


# --- The scene --------------------------------------------------------------------------------


def _object(one: SceneObject, views: Views | None) -> ObjectCheck:
    """Return what there is to say of an object; one that moves where it is tracked first."""
    one = first_seen(one)
    low, high = (1e3 * corner for corner in one.box_world)
    share = None if views is None else sight_of(views, one.vertices_world, one.faces).share
    return ObjectCheck(
        one.name,
        _triple(high - low),
        _triple(low),
        _triple(high),
        len(one.faces),
        one.is_closed,
        share,
    )


def _triple(values: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _placing_notes(layout: Scene, objects: Sequence[ObjectCheck], views: Views | None) -> list[str]:
    """Return what is odd about sizes and places of what the scene's files hold."""
    if views is None:
        return []
    common: CommonView = common_view(views)
    if common.kind != "common":
        return []
    odd = odd_parts(layout, views, common)
    notes = list(odd.values())
    files: dict[str, list[ObjectCheck]] = {}
    for part, one in zip(layout.objects, objects, strict=True):
        if part.motion is None:
            files.setdefault(str(part.about.get("object", part.name)), []).append(one)
    for name, parts in files.items():
        if name in odd or any(one.seen_share for one in parts):
            continue
        needed = len(views) if views.unseen == "carve" else views.min_cameras
        notes.append(
            f"{layout.path}: object {name!r} is outside of what {needed} cameras see: it would be "
            "'not seen' in every frame; is it placed right?"
        )
    return notes


# --- What a run takes -------------------------------------------------------------------------


def _cost(
    session: Session,
    layout: Scene | None,
    settings: EvaluateSettings,
    frames: _Frames,
    watcher: Watcher,
) -> Cost:
    """Return what a run over all frames will take, from a trial on those that were looked at."""
    lanes = min(len(session.cameras), os.cpu_count() or 1)
    covered = frames.index[-1] + 1
    is_video = any(one.recording is not None and one.recording.is_video for one in session.cameras)
    # A video was decoded through to its last frame; of pictures only those looked at were read.
    decode_s = frames.decode_s / (covered if is_video else len(frames.index))
    segment_s = frames.segment_s / len(frames.index)
    read_s = frames.n_frames * (decode_s + segment_s) / lanes
    evaluate_s, disk_bytes, engine = 0.0, None, ""
    if layout is not None:
        evaluate_s, disk_bytes, engine = _trial(session, layout, settings, frames, watcher)
    return Cost(frames.n_frames, read_s, evaluate_s, _peak_bytes(), disk_bytes, engine)


def _trial(
    session: Session,
    layout: Scene,
    settings: EvaluateSettings,
    frames: _Frames,
    watcher: Watcher,
) -> tuple[float, int, str]:
    """Evaluate a few frames into a report that is thrown away; return what all frames take.

    Frames in a row, as a run has them: two that are far apart are compared at length. Twice: one
    frame, which readies what is compiled and made once, and tells what a report takes without
    frames; and then some.
    """
    middle = frames.index[len(frames.index) // 2]
    sizes, counts = [], []
    chain = make_chain(session, layout, settings, watcher.stage)
    with tempfile.TemporaryDirectory() as folder:
        if chain.silhouettes is None:
            stored = Path(folder) / "silhouettes.h5"
            _store(session, FrameRange(middle, middle + _N_TRIED), stored)
            chain = replace(chain, silhouettes=stored)
        for number, count in enumerate((1, _N_TRIED)):
            path = Path(folder) / f"trial{number}.h5"
            asked = replace(settings, frames=FrameRange(middle, middle + count))
            trial = DetectSettings(asked, engine="native")
            write_report(replace(chain, settings=asked), path, trial, watcher)
            sizes.append(path.stat().st_size)
            report = read_report(path)
            counts.append(len(report.index))
    each_s = sum(
        seconds for stage, seconds in report.stage_s.items() if stage not in ("decode", "segment")
    )
    per_frame_s = float(np.mean(each_s)) if counts[1] else 0.0
    per_frame_bytes = max(0, sizes[1] - sizes[0]) / max(1, counts[1] - counts[0])
    disk = sizes[1] + per_frame_bytes * max(0, frames.n_frames - counts[1])
    return frames.n_frames * per_frame_s, round(disk), "native"


def _store(session: Session, frames: FrameRange, path: Path) -> None:
    """Keep the silhouettes of a few frames, so that they are cut out once; each at its number."""
    sizes_px = recorded_sizes(session)
    names = [camera.name for camera in session.cameras]
    with (
        closing(segmented_frames(session, frames)) as cut,
        SilhouetteWriter(path, names, sizes_px, "") as writer,
    ):
        for _ in range(frames.start):
            writer.append(None, "not looked at")
        for frame in cut:
            writer.append(frame.masks, frame.reason)


def _peak_bytes() -> int | None:
    """Return the most memory that this process has had; None where the system does not tell."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
