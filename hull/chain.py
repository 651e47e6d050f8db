"""A session, its rig and a scene, made ready; its frames as hulls, one after another.

::

    session -> silhouettes -+
    rig --------------------+-> Hull (one frame)
"""

import logging
import time
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError, SessionError
from hybridve.calib.lens import Undistortion, undistortion
from hybridve.calib.lens_bound import lens_shift_px
from hybridve.calib.pose import Pose
from hybridve.calib.rig import Rig
from hybridve.hull.agreement.common_view import common_view
from hybridve.hull.agreement.layout import odd_parts
from hybridve.hull.cad.scene import Scene, SceneObject
from hybridve.hull.capture.recording import (
    FrameRange,
    check_lengths,
    claimed_length,
    silhouettes_of,
    stored_silhouettes,
)
from hybridve.hull.capture.rig import load_rig, rig_digest
from hybridve.hull.capture.room_check import RoomCheck, check_room
from hybridve.hull.capture.session import Session
from hybridve.hull.capture.silhouette_io import SilhouetteReader
from hybridve.hull.capture.tracks import Tracks, read_tracks
from hybridve.hull.contact.detect import (
    Body,
    make_body,
    moved_body,
)
from hybridve.hull.contact.respond import ResponseSettings
from hybridve.hull.query.silhouettes import (
    Hull,
    Seen,
    Views,
    make_hull,
    make_seen,
    make_views,
)

_log = logging.getLogger(__name__)

if TYPE_CHECKING:
    from hybridve.hull.contact.outline_errors import DoubtSettings
    from hybridve.hull.contact.uncertainty import Doubter


@dataclass(frozen=True, slots=True)
class EvaluateSettings:
    """How a recording is evaluated; by default for contacts alone.

    Attributes
    ----------
    frames : FrameRange
        Which frames.
    viewport : int or None
        Samples along every triangle's edge.
    accuracy_m : float or None
        Or, instead, the largest spacing of samples along an edge: each triangle takes the smallest
        viewport that keeps it.
    open_at_m : float or None
        Verdicts are certified down to discs of this diameter; None leaves them as sampled.
    clearance_m : float or None
        How far apart the bounds of the clearance may be; None leaves it unmeasured.
    response : ResponseSettings or None
        How the way out of the hull is searched; None leaves it alone.
    backtrack : bool
        Whether that search begins at the point of first contact in the frame of first contact.
    doubt : DoubtSettings or None
        What is assumed of outlines; None, or no clearance, leaves everything undoubted.
    drop_cameras : tuple of str
        Cameras that are left out, as if the session had none of them.
    """

    frames: FrameRange = field(default_factory=FrameRange)
    viewport: int | None = 10
    accuracy_m: float | None = None
    open_at_m: float | None = 1e-4
    clearance_m: float | None = None
    response: ResponseSettings | None = None
    backtrack: bool = False
    doubt: "DoubtSettings | None" = None
    drop_cameras: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """A session, its rig and a scene, made ready.

    Attributes
    ----------
    session, rig, scene
        What is evaluated.
    settings : EvaluateSettings
        How.
    undistortions : list of Undistortion
        Per camera of the session.
    views : Views
        The cameras' pinhole images; moving cameras where they are first tracked (see `views_at`).
    bodies : list of Body
        The scene's objects, laid into viewports; those that move at rest (see `standing_at`).
    silhouettes : Path or None
        Where stored silhouettes stand that are those of this session; None to segment now.
    tracks : Tracks
        Where moving cameras were.
    room : RoomCheck
        Whether the cameras still stand where they were calibrated, as far as the session's
        pictures show it.
    """

    session: Session
    rig: Rig
    scene: Scene
    settings: EvaluateSettings
    undistortions: list[Undistortion]
    views: Views
    bodies: list[Body]
    silhouettes: Path | None
    tracks: Tracks = field(default_factory=Tracks)
    room: RoomCheck = field(default_factory=RoomCheck)


def rig_views(session: Session, rig: Rig) -> tuple[Views, list[Undistortion]]:
    """Return the session's cameras as pinhole views, and how their images become so."""
    lenses = [undistortion(rig[camera.name]) for camera in session.cameras]
    seen = None
    if session.unseen == "keep":  # where a lens leaves a gap in the pinhole image, nobody looked
        names = tuple(camera.name for camera in session.cameras)
        seen = make_seen(names, _sizes_px(lenses), [lens.seen for lens in lenses])
    return _lens_views(session, rig, lenses, seen=seen), lenses


def moved_views(
    session: Session, rig: Rig, tracks: Tracks, index: int, first: Views, lenses: list[Undistortion]
) -> Views:
    """Return the views of one frame, about the origin of the first.

    Parameters
    ----------
    session, rig
        Whose cameras.
    tracks : Tracks
        Where the moving ones were; in this frame none is missing.
    index : int
        Number of the frame.
    first, lenses
        What `rig_views` gave. Where no camera moves, `first` is returned.
    """
    if not tracks:
        return first
    return _lens_views(session, rig.at(tracks.at(index)), lenses, first.origin_world, first.seen)


def _lens_views(
    session: Session,
    rig: Rig,
    lenses: list[Undistortion],
    origin_world: NDArray[np.float64] | None = None,
    seen: Seen | None = None,
) -> Views:
    cameras = [rig[camera.name] for camera in session.cameras]
    return make_views(
        tuple(camera.name for camera in cameras),
        _sizes_px(lenses),
        np.array(
            [
                lens.img_from_cam @ camera.cam_from_world
                for lens, camera in zip(lenses, cameras, strict=True)
            ]
        ),
        session.unseen,
        session.min_cameras,
        origin_world,
        seen,
    )


def _sizes_px(lenses: list[Undistortion]) -> NDArray[np.int64]:
    """Return the sizes (C, 2) of the cameras' pinhole images: width, height."""
    return np.array([(lens.width_px, lens.height_px) for lens in lenses], np.int64)


def make_chain(
    session: Session,
    scene: Scene,
    settings: EvaluateSettings,
    progress: Callable[[str, int, int], None] | None = None,
) -> Chain:
    """Return everything that is the same for all frames.

    `progress` is told ``(what, done, total)`` while a rig that was not tested yet is tested. A
    camera that has moved since it was calibrated is logged as a warning, and stands in ``room``;
    so is a part whose size or place does not go with what the cameras see.

    Raises
    ------
    HybridveError
        If recordings, rig and scene do not fit together.
    """
    session = session.without(settings.drop_cameras)
    rig = load_rig(session, progress)
    room = check_room(session, rig, progress)
    tracks = read_tracks(session, rig)
    silhouettes = stored_silhouettes(session, rig_digest(rig))
    if silhouettes is None:
        check_lengths(session, settings.frames)
    views, undistortions = rig_views(session, first_rig(rig, tracks))
    if not tracks:
        seen = common_view(views)
        if seen.kind == "none":
            raise SessionError(f"{session.path}: nothing can be in the hull: {seen.reason}")
        for note in odd_parts(scene, views, seen).values():
            _log.warning("%s", note)
    _refuse_no_common_pose(scene)
    bodies = []
    for scene_object in scene.objects:
        try:
            bodies.append(
                make_body(scene_object, viewport=settings.viewport, accuracy_m=settings.accuracy_m)
            )
        except ValueError as error:
            raise SceneError(
                f"{scene.path}: object {scene_object.name!r}: {error}; ask for less accuracy, or "
                "refine the mesh"
            ) from error
    return Chain(
        session, rig, scene, settings, undistortions, views, bodies, silhouettes, tracks, room
    )


def _refuse_no_common_pose(scene: Scene) -> None:
    """Refuse objects that no frame has the poses of all of."""
    moving = {
        str(one.about.get("object", one.name)): set(one.motion.poses)
        for one in scene.objects
        if one.motion is not None
    }
    if moving and not set.intersection(*moving.values()):
        raise SceneError(
            f"{scene.path}: no frame has a pose of all of {', '.join(moving)}; their files name "
            "frames of the session, from 0"
        )


def first_rig(rig: Rig, tracks: Tracks) -> Rig:
    """Return the rig with moving cameras where they are first tracked all together."""
    return rig if tracks.first is None else rig.at(tracks.at(tracks.first))


def views_at(chain: Chain, index: int) -> Views:
    """Return the views of a frame in which no tracked pose is missing.

    They keep the local origin of all others. Where no camera moves, they are the same object.
    """
    return moved_views(
        chain.session, chain.rig, chain.tracks, index, chain.views, chain.undistortions
    )


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """The objects of a scene as they stand in one frame.

    Attributes
    ----------
    objects : tuple of SceneObject
        In the scene's order.
    bodies : list of Body
        The same, laid into viewports.
    world_from_rest : tuple of (3, 4) float64 or None
        Where each is, seen from where the scene places it; None of one that does not move.
    """

    objects: tuple[SceneObject, ...]
    bodies: list[Body]
    world_from_rest: tuple[Pose | None, ...]

    def let_go(self) -> None:
        """Drop what engines keep of the triangles of objects that move: no frame has them again."""
        for body, pose in zip(self.bodies, self.world_from_rest, strict=True):
            if pose is not None:
                body.triangles.hold(None)


def standing_at(chain: Chain, index: int) -> Standing:
    """Return the scene's objects as they stand in a frame in which no pose is missing.

    Those that do not move are the same objects in all frames.
    """
    poses = tuple(
        None if one.motion is None else one.motion.world_from_rest(index)
        for one in chain.scene.objects
    )
    if not chain.scene.moves:
        return Standing(chain.scene.objects, chain.bodies, poses)
    stand = [
        (one, body) if pose is None else _moved(one, body, pose)
        for one, body, pose in zip(chain.scene.objects, chain.bodies, poses, strict=True)
    ]
    return Standing(tuple(one for one, _ in stand), [body for _, body in stand], poses)


def _moved(one: SceneObject, body: Body, world_from_rest: Pose) -> tuple[SceneObject, Body]:
    moved = one.at(world_from_rest)
    return moved, moved_body(body, moved)


def body_at(chain: Chain, number: int, world_from_rest: Pose) -> Body:
    """Return one of the scene's objects, by number, laid into viewports and moved rigidly."""
    return _moved(chain.scene.objects[number], chain.bodies[number], world_from_rest)[1]


@dataclass(frozen=True, slots=True, eq=False)
class FrameHull:
    """One frame of a recording.

    Attributes
    ----------
    index : int
        Its number in the session.
    time_s : float
        When it was recorded, seconds from frame 0.
    hull : Hull or None
        What is real in it; None where it cannot be read.
    reason : str
        Why it cannot; otherwise empty.
    decode_s, segment_s, hull_s : float
        How long threads worked at that.
    """

    index: int
    time_s: float
    hull: Hull | None
    reason: str
    decode_s: float
    segment_s: float
    hull_s: float


def hulls(
    chain: Chain,
    *,
    skip: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
) -> Generator[FrameHull]:
    """Yield the chosen frames of a recording; to be closed where it is left before its end.

    Parameters
    ----------
    chain : Chain
        Whose frames.
    skip : int
        How many frames at the start are left out.
    progress : callable, optional
        Told ``(what, done, total)`` while the backgrounds are learnt.
    """
    chosen = chain.settings.frames
    start = chosen.start + skip * chosen.step
    if chosen.stop is not None and start >= chosen.stop:
        return
    found = silhouettes_of(
        chain.session,
        chain.silhouettes,
        FrameRange(start, chosen.stop, chosen.step),
        tracks=chain.tracks,
        undistortions=chain.undistortions,
        progress=progress,
    )
    with closing(found) as frames:
        for frame in frames:
            started, hull = time.thread_time(), None
            reason = frame.reason or chain.scene.missing(frame.index)
            if frame.masks is not None and not reason:
                hull = make_hull(views_at(chain, frame.index), frame.masks)
            yield FrameHull(
                index=frame.index,
                time_s=frame.index / chain.session.fps,
                hull=hull,
                reason=reason,
                decode_s=frame.decode_s,
                segment_s=frame.segment_s,
                hull_s=time.thread_time() - started,
            )


def count_frames(chain: Chain) -> int:
    """Return how many frames there are to evaluate; where videos tell it only roughly, roughly."""
    frames = chain.settings.frames
    if chain.silhouettes is not None:
        with SilhouetteReader(chain.silhouettes) as reader:
            length = reader.n_frames
    else:
        length = claimed_length(chain.session)
    stop = length if frames.stop is None else min(length, frames.stop)
    return len(range(frames.start, max(stop, frames.start), frames.step))


def make_doubter(chain: Chain) -> "Doubter | None":
    """Return what doubts the clearances of a recording; None where nothing is to be doubted."""
    if chain.settings.doubt is None:
        return None
    # Late: it brings scipy's optimisers, for which a picture or a sweep need not wait.
    from hybridve.hull.contact.outline_errors import outline_errors
    from hybridve.hull.contact.uncertainty import Doubter

    names, shift_px = chain.views.names, mask_shift_px(chain)
    errors = outline_errors(
        names,
        chain.rig,
        [shift_px[name] for name in names],
        chain.settings.doubt,
    )
    return Doubter(errors, chain.settings.doubt)


def mask_shift_px(chain: Chain) -> dict[str, float | None]:
    """Return by camera how far undistorting can shift its silhouette, in recorded pixels.

    It is the bound of `hybridve.calib.lens_bound`; None where no bound is known.
    """
    shift_px = {
        camera.name: lens_shift_px(chain.rig[camera.name], lens)
        for camera, lens in zip(chain.session.cameras, chain.undistortions, strict=True)
    }
    return {name: shift if np.isfinite(shift) else None for name, shift in shift_px.items()}
