"""A session's silhouettes: cut out of every frame, looked at, and stored."""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.agreement.blank import BlankLooks
from hybridve.hull.agreement.record import SessionAgreement
from hybridve.hull.capture.recording import (
    FrameRange,
    check_lengths,
    claimed_length,
    recorded_sizes,
    segmented_frames,
    silhouette_stamp,
)
from hybridve.hull.capture.rig import has_rig, load_rig, rig_digest
from hybridve.hull.capture.room_check import check_room
from hybridve.hull.capture.session import Session
from hybridve.hull.capture.silhouette_io import SilhouetteWriter
from hybridve.hull.trust import Desk, blank_causes
from hybridve.hull.watcher import Watcher


@dataclass(frozen=True, slots=True, eq=False)
class Segmented:
    """What was found of F frames of C cameras while they were cut out.

    Attributes
    ----------
    path : Path
        The stored silhouettes.
    names : tuple of C str
        The cameras.
    reasons : tuple of F str
        Why a frame has no silhouettes; empty if it has.
    shares : (F, C) float64
        Which share of each recorded picture is object; NaN where the frame has no silhouettes.
    supported : (F, C) float64
        How much of each silhouette the other cameras support; NaN where nobody can tell.
    denies : (F, C) bool
        Cameras that deny what several others see.
    is_confirmed : bool
        Whether pieces that no other camera confirms were dropped, for which a rig is needed.
    agreement : SessionAgreement
        What the cameras say about each other.
    """

    path: Path
    names: tuple[str, ...]
    reasons: tuple[str, ...]
    shares: NDArray[np.float64]
    supported: NDArray[np.float64]
    denies: NDArray[np.bool_]
    is_confirmed: bool
    agreement: SessionAgreement


def segment_session(
    session: Session, output: Path, watcher: Watcher, *, unconfirmed: bool
) -> Segmented:
    """Cut the real things out of every frame of a session, and store their silhouettes.

    Parameters
    ----------
    session : Session
        The recordings.
    output : Path
        Where they are stored; it appears when it is complete.
    watcher : Watcher
        Told what goes on.
    unconfirmed : bool
        Keep pieces that no other camera confirms.

    Raises
    ------
    SessionError
        If the recordings do not belong together, or cannot be read.
    ReportError
        If the silhouettes cannot be written.
    """
    sizes_px = recorded_sizes(session)
    check_lengths(session, FrameRange())
    digest, desk = None, None
    if not unconfirmed and has_rig(session):
        rig = load_rig(session, watcher.stage)
        room = check_room(session, rig, watcher.stage)  # said before the work, and once
        digest, desk = rig_digest(rig), Desk.of(session, rig, room)
    names = [camera.name for camera in session.cameras]
    looks = BlankLooks()
    reasons: list[str] = []
    recording = segmented_frames(session, FrameRange(), progress=watcher.stage)
    with (
        closing(recording) as frames,
        SilhouetteWriter(output, names, sizes_px, silhouette_stamp(session, digest)) as writer,
        watcher.steps("segment", claimed_length(session)) as advance,
    ):
        for frame in frames:
            masks = frame.masks
            if desk is not None:
                masks = desk.take(frame.index, masks)
            writer.append(masks, frame.reason)
            reasons.append(frame.reason)
            if masks is not None:
                looks.take(frame.index, masks)
            advance()
    agreement = SessionAgreement()
    nobody = (len(reasons), len(names))
    shares, supported = np.full(nobody, np.nan), np.full(nobody, np.nan)
    denies = np.zeros(nobody, np.bool_)
    if looks.index:
        shares[looks.index] = looks.shares
    if desk is not None:
        agreement = desk.judge()
        supported = np.array([one.supported_share for one in desk.frames]).reshape(nobody)
        denies = np.array([one.deniers for one in desk.frames], np.bool_).reshape(nobody)
    elif looks.index:
        span = (looks.index[0], looks.index[-1])
        causes = blank_causes(session, looks.shares, looks.is_same, span)
        agreement = SessionAgreement(causes=causes)
    return Segmented(
        output,
        tuple(names),
        tuple(reasons),
        shares,
        supported,
        denies,
        desk is not None,
        agreement,
    )
