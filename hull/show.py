"""One frame of a recording as pictures: the scene from outside, and what each camera saw."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.calib.rig import Rig
from hybridve.hull.agreement.pieces import drop_unconfirmed
from hybridve.hull.capture.recording import (
    FrameRange,
    recording_of,
    segmented_frames,
    undistort_mask,
)
from hybridve.hull.chain import Chain, views_at
from hybridve.hull.contact.detect import Contact, detect_contacts
from hybridve.hull.query.engine import Engine
from hybridve.hull.query.silhouettes import Hull, make_hull
from hybridve.hull.view.picture import (
    DrawnObject,
    contact_sheet,
    draw_overlay,
    draw_picture,
)

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One frame, evaluated and ready to be drawn.

    Attributes
    ----------
    chain : Chain
        The recording it is from.
    rig : Rig
        Its cameras, where they were in this frame.
    index : int
        Number of the frame.
    masks : list of (H, W) uint8
        Silhouettes in the images as recorded, without pieces that no other camera confirms.
    hull : Hull
        The frame's hull.
    contacts : list of Contact
        One for each object of the scene.
    """

    chain: Chain
    rig: Rig
    index: int
    masks: list[NDArray[np.uint8]]
    hull: Hull
    contacts: list[Contact]


def take_shot(chain: Chain, index: int, engine: Engine) -> Shot:
    """Return one frame of a recording, evaluated.

    Raises
    ------
    SessionError
        If the recording does not have this frame, or a camera lacks it, or it is not known where
        one was.
    """
    for frame in segmented_frames(chain.session, FrameRange(index, index + 1)):
        reason = frame.reason or chain.tracks.missing(index)
        if frame.masks is None or reason:
            raise SessionError(f"{chain.session.path}: frame {index}: {reason}")
        views = views_at(chain, index)
        masks = drop_unconfirmed(views, chain.undistortions, frame.masks)
        undistorted = [
            undistort_mask(mask, lens)
            for mask, lens in zip(masks, chain.undistortions, strict=True)
        ]
        hull = make_hull(views, undistorted)
        rig = chain.rig.at(chain.tracks.at(index))
        return Shot(chain, rig, index, masks, hull, detect_contacts(hull, chain.bodies, engine))
    raise SessionError(f"{chain.session.path}: the recording has no frame {index}")


def draw_scene(shot: Shot, size_px: tuple[int, int]) -> Image:
    """Return the frame from outside: cameras, the hull, the CAD, what collides in red."""
    touched = [
        body.name
        for body, contact in zip(shot.chain.bodies, shot.contacts, strict=True)
        if contact.collides
    ]
    time_s = shot.index / shot.chain.session.fps
    outcome = f"touched: {', '.join(touched)}" if touched else "nothing is touched"
    return draw_picture(
        shot.hull,
        shot.rig,
        _drawn_objects(shot),
        size_px=size_px,
        title=f"{shot.chain.session.name}, frame {shot.index} ({time_s:.2f} s)",
        caption=outcome,
    )


def draw_cameras(shot: Shot, columns: int = 2) -> Image:
    """Return what each camera saw, with the silhouette's outline and the CAD drawn in."""
    objects = _drawn_objects(shot)
    pictures = []
    for camera, mask in zip(shot.chain.session.cameras, shot.masks, strict=True):
        recording = recording_of(shot.chain.session, camera)
        number = shot.index - camera.shift_frames
        for image in recording.frames(number, number + 1):
            pictures.append(draw_overlay(image, shot.rig[camera.name], mask, objects))
    return contact_sheet(pictures, columns)


def _drawn_objects(shot: Shot) -> list[DrawnObject]:
    return [
        DrawnObject(
            name=part.name,
            vertices_world=part.vertices_world,
            faces=part.faces,
            collides=contact.collides,
            hit_triangles=contact.triangles(),
            hit_points_world=contact.points()[0],
        )
        for part, contact in zip(shot.chain.scene.objects, shot.contacts, strict=True)
    ]
