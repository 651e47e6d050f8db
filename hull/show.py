"""One frame of a recording as pictures: the scene from outside, and what each camera saw.

What a camera saw can be drawn with the CAD in it, or with what the others say that it saw.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.calib.rig import Rig
from hybridve.hull.agreement.others import differences, in_view_of_others, meets_others
from hybridve.hull.agreement.pieces import drop_unconfirmed
from hybridve.hull.agreement.record import NamedCause
from hybridve.hull.agreement.search import make_pencils
from hybridve.hull.agreement.told import brief
from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.capture.recording import (
    FrameRange,
    as_recorded,
    mask_reading,
    recording_of,
    segmented_frames,
    undistort_mask,
)
from hybridve.hull.capture.session import Session, SessionCamera
from hybridve.hull.chain import Chain, make_doubter, standing_at, views_at
from hybridve.hull.contact.detect import Contact, detect_contacts
from hybridve.hull.query.engine import Engine
from hybridve.hull.query.silhouettes import Hull, make_hull
from hybridve.hull.trust import Witness
from hybridve.hull.view.contrast import contrast_sheet, draw_contrast
from hybridve.hull.view.picture import (
    DrawnObject,
    contact_sheet,
    draw_overlay,
    draw_picture,
)

Image = NDArray[np.uint8]

#: Silhouettes of which there are no pictures are drawn in this grey, on black.
_MASK_GREY = 90


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
    objects : tuple of SceneObject
        The scene's objects, as they stand in this frame.
    """

    chain: Chain
    rig: Rig
    index: int
    masks: list[NDArray[np.uint8]]
    hull: Hull
    contacts: list[Contact]
    objects: tuple[SceneObject, ...]


def take_shot(chain: Chain, index: int, engine: Engine) -> Shot:
    """Return one frame of a recording, evaluated.

    Raises
    ------
    SessionError
        If the recording does not have this frame, or a camera lacks it, or it is not known where
        one was, or an object that moves.
    """
    if missing := chain.scene.missing(index):
        raise SessionError(f"{chain.session.path}: frame {index}: {missing}")
    recorded = _silhouettes(chain, index)
    views = views_at(chain, index)
    masks = drop_unconfirmed(views, chain.undistortions, recorded)
    hull = make_hull(views, _undistorted(chain, masks))
    rig = chain.rig.at(chain.tracks.at(index))
    standing = standing_at(chain, index)
    contacts = detect_contacts(hull, standing.bodies, engine)
    return Shot(chain, rig, index, masks, hull, contacts, standing.objects)


def draw_scene(shot: Shot, size_px: tuple[int, int]) -> Image:
    """Return the frame from outside: cameras, the hull, the CAD, what collides in red."""
    touched = [
        body.name
        for body, contact in zip(shot.chain.bodies, shot.contacts, strict=True)
        if contact.collides
    ]
    outcome = f"touched: {', '.join(touched)}" if touched else "nothing is touched"
    return draw_picture(
        shot.hull,
        shot.rig,
        _drawn_objects(shot),
        size_px=size_px,
        title=_title(shot.chain, shot.index),
        caption=outcome,
    )


def draw_cameras(shot: Shot, columns: int = 2) -> Image:
    """Return what each camera saw, with the silhouette's outline and the CAD drawn in."""
    objects = _drawn_objects(shot)
    pictures = []
    for camera, mask in zip(shot.chain.session.cameras, shot.masks, strict=True):
        for image in _images(shot.chain.session, camera, shot.index):
            pictures.append(draw_overlay(image, shot.rig[camera.name], mask, objects))
    return contact_sheet(pictures, columns)


def draw_agreement(chain: Chain, index: int, causes: Sequence[NamedCause] = ()) -> Image:
    """Return what each camera saw, and what the others say that it saw.

    Each camera's image as recorded, with its own silhouette and that of the hull of all others;
    where they differ by more than outlines err, it is filled. Silhouettes are those that were cut
    out, with pieces that no other camera confirms. Where silhouettes are given and no pictures,
    they are grey on black. Parts of an image that the others cannot see are dark, and nothing is
    filled there that the camera sees.

    Parameters
    ----------
    chain : Chain
        The recording; its settings say what is assumed of outlines.
    index : int
        Number of the frame.
    causes : sequence of NamedCause
        What is wrong with cameras; stands beside their names.

    Raises
    ------
    SessionError
        If the recording does not have this frame, or a camera lacks it, or it is not known where
        one was, or there is only one camera.
    """
    session = chain.session
    if len(session.cameras) < 2:
        raise SessionError(f"{session.path}: a single camera has no others to agree with")
    masks = _silhouettes(chain, index)
    views = views_at(chain, index)
    hull = make_hull(views, _undistorted(chain, masks))
    pencils = make_pencils(views)
    doubter = make_doubter(chain)
    sigma_px = None if doubter is None else doubter.errors.sigma_px
    error_px = Witness.of(views, chain.undistortions, sigma_px, is_still=False).error_px.tolist()
    pictures, has_unseen = [], False
    for number, (camera, lens) in enumerate(zip(session.cameras, chain.undistortions, strict=True)):
        mask = masks[number] > 0
        others, in_view = (
            as_recorded(seen.astype(np.uint8), chain.rig[camera.name], lens) > 0
            for seen in (
                meets_others(hull, number, pencils),
                in_view_of_others(views, number, pencils),
            )
        )
        sees_alone, misses = differences(mask, others, error_px[number])
        has_unseen |= not (camera.has_masks or in_view.all())
        remarks = [brief(cause, camera.name) for cause in causes if camera.name in cause.cameras]
        images = [np.repeat(mask[..., None] * np.uint8(_MASK_GREY), 3, axis=2)]
        if not camera.has_masks:
            images = list(_images(session, camera, index))
        for image in images:
            pictures.append(
                draw_contrast(
                    image,
                    mask,
                    others,
                    (sees_alone & in_view, misses),
                    in_view,
                    name=camera.name,
                    remark="; ".join(remarks),
                )
            )
    columns = math.ceil(math.sqrt(len(pictures)))
    return contrast_sheet(pictures, columns, _title(chain, index), has_unseen=has_unseen)


def _silhouettes(chain: Chain, index: int) -> list[NDArray[np.uint8]]:
    """Return a frame's silhouettes (H, W), as recorded.

    Raises
    ------
    SessionError
        As `take_shot` does.
    """
    for frame in segmented_frames(chain.session, FrameRange(index, index + 1)):
        reason = frame.reason or chain.tracks.missing(index)
        if frame.masks is None or reason:
            raise SessionError(f"{chain.session.path}: frame {index}: {reason}")
        return frame.masks
    raise SessionError(f"{chain.session.path}: the recording has no frame {index}")


def _undistorted(chain: Chain, masks: list[NDArray[np.uint8]]) -> list[NDArray[np.uint8]]:
    return [undistort_mask(*pair) for pair in zip(masks, chain.undistortions, strict=True)]


def _images(session: Session, camera: SessionCamera, index: int) -> Iterator[Image]:
    """Yield the image that a camera recorded at a frame, (H, W, 3); of ready masks, what is object.

    Masks may be of any values; what they are in colours, if they are in colours, is shown as it is.
    """
    number = index - camera.nearest_shift
    for image in recording_of(session, camera).frames(number, number + 1):
        if not camera.has_masks:
            yield image
        elif image.ndim == 3 and image.dtype == np.uint8:
            yield np.ascontiguousarray(image[..., :3])
        else:
            mask = mask_reading(session, camera).mask(image)
            yield np.repeat(mask[..., None] * np.uint8(255), 3, axis=2)


def _title(chain: Chain, index: int) -> str:
    return f"{chain.session.name}, frame {index} ({index / chain.session.fps:.2f} s)"


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
        for part, contact in zip(shot.objects, shot.contacts, strict=True)
    ]
