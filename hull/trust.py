"""Whether a session is to be trusted: what its frames give to that, and the judgement of all.

::

    Hull (one frame) -> FrameOutlines -+
    room of the empty scene -----------+-> SessionAgreement
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.lens import Undistortion
from hybridve.calib.rig import Rig
from hybridve.hull.agreement.blank import blank_cameras, blank_message, blank_short
from hybridve.hull.agreement.causes import GROSS_BUMP_PX
from hybridve.hull.agreement.frame import (
    DEFAULT_ERROR_PX,
    Coherence,
    coherence,
    stated_error_px,
)
from hybridve.hull.agreement.outlines import FrameOutlines, inner_of, outline_of
from hybridve.hull.agreement.pieces import drop_unconfirmed
from hybridve.hull.agreement.record import NamedCause, SessionAgreement
from hybridve.hull.agreement.search import Pencils, make_pencils
from hybridve.hull.agreement.session import judge_session
from hybridve.hull.capture.recording import Mask, undistort_mask
from hybridve.hull.capture.resemblance import unlike_rooms
from hybridve.hull.capture.room_check import RoomCheck
from hybridve.hull.capture.session import Session
from hybridve.hull.capture.tracks import Tracks, read_tracks
from hybridve.hull.chain import first_rig, moved_views, rig_views
from hybridve.hull.query.silhouettes import Hull, Views, make_hull


@dataclass(frozen=True, slots=True, eq=False)
class Witness:
    """Looks at the silhouettes of each frame of a session.

    Attributes
    ----------
    inners : list of C (H, W) uint8, or None
        Where each camera recorded all pixels around; see
        `hybridve.hull.agreement.outlines.inner_of`.
    error_px : (C,) int64
        By how much each outline may be off.
    pencils : Pencils or None
        Of the cameras, if they stand still.
    """

    inners: list[NDArray[np.uint8] | None]
    error_px: NDArray[np.int64]
    pencils: Pencils | None

    @classmethod
    def of(
        cls,
        views: Views,
        undistortions: Sequence[Undistortion],
        sigma_px: NDArray[np.float64] | None = None,
        *,
        is_still: bool,
    ) -> Self:
        """Return one for cameras whose outlines have standard deviations (C,), if they are known.

        Parameters
        ----------
        views : Views
            C cameras.
        undistortions : sequence of Undistortion
            How their images became pinhole images.
        sigma_px : (C,) float64, optional
            Standard deviations of their outlines, pixels.
        is_still : bool
            Whether no camera moves.
        """
        error_px = np.full(len(views), DEFAULT_ERROR_PX, np.int64)
        if sigma_px is not None:
            error_px = stated_error_px(sigma_px)
        inners = [inner_of(lens.seen) for lens in undistortions]
        return cls(inners, error_px, make_pencils(views) if is_still else None)

    def look(self, index: int, hull: Hull) -> tuple[Coherence, FrameOutlines]:
        """Return what the silhouettes of a frame say of each other, and what is kept of them."""
        names = hull.views.names
        found = coherence(hull, self.error_px, self.pencils)
        outlines = tuple(
            outline_of(hull.mask(camera), inner) for camera, inner in enumerate(self.inners)
        )
        deniers = np.isin(names, found.deniers)
        alone_px = found.alone_px(names)
        return found, FrameOutlines(
            index, outlines, deniers, found.supported_share, alone_px, hull.object_shares()
        )


def judge_cameras(
    session: Session,
    views: Views,
    frames: Sequence[FrameOutlines],
    room: RoomCheck,
    *,
    lenses: Sequence[Undistortion],
    is_still: bool,
) -> SessionAgreement:
    """Return what the cameras of a session say about each other, and what the empty room does.

    Besides, cameras that show one and the same in all frames. Of cameras that move nothing else is
    asked, but of the empty room.

    Parameters
    ----------
    session : Session
        Whose cameras.
    views : Views
        Their images.
    frames : sequence of FrameOutlines
        Of all frames, those that were not read among them.
    room : RoomCheck
        What the empty scene shows of the room in which they were calibrated.
    lenses : sequence of Undistortion
        How their images became pinhole images.
    is_still : bool
        Whether no camera moves.
    """
    found = SessionAgreement()
    if is_still:
        found = judge_session(
            views,
            frames,
            offset_s={
                camera.name: (camera.shift_frames + camera.lag) / session.fps
                for camera in session.cameras
            },
            fps=session.fps,
        )
    if not frames:
        return found
    found = _with_rooms(session, found, frames)
    moved = tuple(
        NamedCause(
            kind="moved",
            cameras=(name,),
            first_frame=frames[0].index,
            last_frame=frames[-1].index,
            is_gross=(room.cameras[name].largest_px or np.inf) >= GROSS_BUMP_PX,
            short=f"{name} has moved since it was calibrated",
            message=message,
            size=room.cameras[name].largest_px,
            high=room.cameras[name].largest_px,
        )
        for name, message in zip(room.moved, room.messages, strict=True)
    )
    read = [frame for frame in frames if frame.outlines]
    if not read:
        return replace(found, causes=(*moved, *found.causes))
    recorded = [1.0 if lens.seen is None else float(lens.seen.mean()) for lens in lenses]
    shares = np.array([frame.object_share for frame in read]) / recorded
    # Of one area, with the same corners: the same, but for what is no larger than noise.
    is_same = [
        np.ptp(shares[:, camera]) == 0.0
        and all(frame.outlines[camera].is_same(read[0].outlines[camera]) for frame in read)
        for camera in range(len(lenses))
    ]
    explained = {name for cause in found.causes if cause.is_gross for name in cause.cameras}
    blank = blank_causes(
        session, shares, np.array(is_same), (read[0].index, read[-1].index), explained
    )
    return replace(found, causes=(*moved, *found.causes, *blank))


def blank_causes(
    session: Session,
    shares: NDArray[np.float64],
    is_same: NDArray[np.bool_],
    frames: tuple[int, int],
    explained: Collection[str] = (),
) -> tuple[NamedCause, ...]:
    """Return what there is to say of cameras that show one and the same in all frames.

    Parameters
    ----------
    session : Session
        Whose C cameras.
    shares, is_same
        As of `hybridve.hull.agreement.blank.blank_cameras`.
    frames : (first, last)
        Numbers of the frames.
    explained : collection of str
        Cameras of which it is known already why they are all object, as of inverted masks.
    """
    names = [camera.name for camera in session.cameras]
    causes = []
    for one in blank_cameras(shares, is_same):
        cameras = tuple(names[camera] for camera in one.cameras)
        if one.kind == "all object" and set(cameras) <= set(explained):
            continue
        has_masks = session.cameras[one.cameras[0]].has_masks
        causes.append(
            NamedCause(
                kind=one.kind,
                cameras=cameras,
                first_frame=frames[0],
                last_frame=frames[1],
                is_gross=False,
                short=blank_short(one, names),
                message=blank_message(one, names, has_masks=has_masks),
                size=float(one.n_frames),
            )
        )
    return tuple(causes)


def _with_rooms(
    session: Session, found: SessionAgreement, frames: Sequence[FrameOutlines]
) -> SessionAgreement:
    """Return the same, with recordings that do not show their own room named.

    Against an empty scene that is not its own all of a picture is object, and outlines tell
    nothing.
    """
    unlike = unlike_rooms(session)
    named = {name for _, cameras in unlike for name in cameras}
    causes = tuple(
        NamedCause(
            kind=kind,
            cameras=cameras,
            first_frame=frames[0].index,
            last_frame=frames[-1].index,
            is_gross=True,
            short=f"{' and '.join(cameras)} {kind}",
            message=(
                f"{' and '.join(cameras)} have each other's recording: each looks like the other's "
                "empty scene, and not like its own; exchange their recordings in session.toml"
            )
            if kind == "exchanged"
            else (
                f"{cameras[0]}'s recording is {kind}: so changed it looks like the empty scene, "
                "and as it is it does not; turn it back"
            ),
        )
        for kind, cameras in unlike
    )
    others = (cause for cause in found.causes if not named & set(cause.cameras))
    return replace(found, causes=(*causes, *others)) if unlike else found


@dataclass(frozen=True, slots=True, eq=False)
class Desk:
    """Where silhouettes are looked through as they are cut out, before they are stored.

    Attributes
    ----------
    session : Session
        Whose they are.
    rig : Rig
        Its cameras.
    room : RoomCheck
        What the empty scene shows.
    tracks : Tracks
        Where moving cameras were.
    views, lenses
        What `hybridve.hull.chain.rig_views` gives.
    witness : Witness
        Looks at them.
    frames : list of FrameOutlines
        What it has seen.
    """

    session: Session
    rig: Rig
    room: RoomCheck
    tracks: Tracks
    views: Views
    lenses: list[Undistortion]
    witness: Witness
    frames: list[FrameOutlines]

    @classmethod
    def of(cls, session: Session, rig: Rig, room: RoomCheck) -> Self:
        """Return an empty one."""
        tracks = read_tracks(session, rig)
        views, lenses = rig_views(session, first_rig(rig, tracks))
        witness = Witness.of(views, lenses, is_still=not tracks)
        return cls(session, rig, room, tracks, views, lenses, witness, [])

    def take(self, index: int, masks: list[Mask] | None) -> list[Mask] | None:
        """Return a frame's silhouettes (H, W), as recorded, without what no other camera confirms.

        Where nobody knows what a camera sees, nothing is dropped.
        """
        if masks is None or self.tracks.missing(index):
            self.frames.append(FrameOutlines.unread(index, len(self.views)))
            return masks
        views = moved_views(self.session, self.rig, self.tracks, index, self.views, self.lenses)
        undistorted = [
            undistort_mask(mask, lens) for mask, lens in zip(masks, self.lenses, strict=True)
        ]
        self.frames.append(self.witness.look(index, make_hull(views, undistorted))[1])
        return drop_unconfirmed(views, self.lenses, masks)

    def judge(self) -> SessionAgreement:
        """Return what the cameras say about each other in all frames that were taken."""
        return judge_cameras(
            self.session,
            self.views,
            self.frames,
            self.room,
            lenses=self.lenses,
            is_still=not self.tracks,
        )
