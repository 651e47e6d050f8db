"""One frame of a recording as pictures: the scene from outside, and what each camera saw.

What a camera saw can be drawn with the CAD in it, or with what the others say that it saw.
"""

import math
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.calib.lengths import bounds_mm
from hybridve.calib.lens import Undistortion
from hybridve.calib.pose import Pose, placed
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
from hybridve.hull.contact.nearness import Nearness
from hybridve.hull.query.engine import Engine
from hybridve.hull.query.silhouettes import Hull, make_hull
from hybridve.hull.report.moment import Moment, ObjectMoment, means
from hybridve.hull.trust import Witness
from hybridve.hull.view.contrast import contrast_sheet, draw_contrast
from hybridve.hull.view.drawn import Marks, Measure
from hybridve.hull.view.paint import MEASURE_RGB, PATH_RGB
from hybridve.hull.view.picture import (
    DrawnObject,
    Focus,
    HeatScale,
    Painter,
    Viewpoint,
    choose_viewpoint,
    contact_sheet,
    draw_from_camera,
    draw_overlay,
    draw_picture,
    sheet_layout,
)
from hybridve.hull.view.recorded import recorded_view
from hybridve.hull.view.viewpoint import zoomed

Image = NDArray[np.uint8]

#: Silhouettes of which there are no pictures are drawn in this grey, on black.
_MASK_GREY = 90

#: A sheet of what cameras saw is at most so large, in pixels.
_SHEET_PX = (3200, 2400)

#: Objects whose clearance is drawn as a line, the worst ones.
_MOST_MEASURES = 3

#: A picture of some objects shows this many times as much as they fill.
_AROUND_FOCUS = 1.5

_SIX_WAYS = np.concatenate([np.eye(3), -np.eye(3)])

#: N_hull is drawn so long, metres, or half as long as D_rec.
_NORMAL_M = 0.05
_NORMAL_RGB = (0.10, 0.42, 0.62)


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
    poses : tuple of (3, 4) float64 or None
        Where each is, seen from where the scene places it; None of one that does not move.
    """

    chain: Chain
    rig: Rig
    index: int
    masks: list[NDArray[np.uint8]]
    hull: Hull
    contacts: list[Contact]
    objects: tuple[SceneObject, ...]
    poses: tuple[Pose | None, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Heat:
    """How near real things came to objects over frames.

    Attributes
    ----------
    maps : mapping of str to Nearness
        By the object's name.
    scale : HeatScale
        What its colours mean.
    """

    maps: Mapping[str, Nearness]
    scale: HeatScale


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """What a picture of the scene shows besides hull and CAD.

    Attributes
    ----------
    moment : Moment or None
        What a report says of the frame: its clearances are drawn, and its words are the caption.
    focus : str
        The objects that it is about, by name or pattern; empty for all.
    reach_m : float
        A picture of these shows what is so near to the worst point, too.
    zoom : float
        How many times as large.
    images : sequence of C (H, W, 3) uint8 or None
        What the cameras recorded, as pinhole images: the hull is drawn as it looked.
    heat : Heat or None
        The CAD is coloured by how near something came.
    paths_world : tuple of (P, 3) float64
        Ways that are drawn, of the nearest point.
    arrows : bool
        Whether V_rec and N_hull of the moment are drawn.
    heading : str
        Before the caption.
    """

    moment: Moment | None = None
    focus: str = ""
    reach_m: float = 0.0
    zoom: float = 1.0
    images: Sequence[Image | None] = ()
    heat: Heat | None = None
    paths_world: tuple[NDArray[np.float64], ...] = ()
    arrows: bool = False
    heading: str = ""

    @property
    def about(self) -> list[ObjectMoment]:
        """What the moment says of the objects in focus, the worst first."""
        if self.moment is None:
            return []
        return [
            one
            for one in self.moment.worst_first()
            if not self.focus or means(self.focus, one.name)
        ]


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
    return shot_of(chain, index, hull, masks, engine)


def shot_of(
    chain: Chain, index: int, hull: Hull, masks: list[NDArray[np.uint8]], engine: Engine
) -> Shot:
    """Return a frame whose hull is known, evaluated; no pose may be missing in it."""
    rig = chain.rig.at(chain.tracks.at(index))
    standing = standing_at(chain, index)
    contacts = detect_contacts(hull, standing.bodies, engine)
    poses = standing.world_from_rest
    return Shot(chain, rig, index, masks, hull, contacts, standing.objects, poses)


def draw_scene(
    shot: Shot,
    size_px: tuple[int, int],
    look: Look | None = None,
    viewpoint: Viewpoint | None = None,
    painter: Painter | None = None,
) -> Image:
    """Return the frame from outside: cameras, the hull, the CAD, what collides in red.

    Parameters
    ----------
    shot : Shot
        The frame.
    size_px : tuple of int
        Width and height.
    look : Look, optional
        What else is shown.
    viewpoint : Viewpoint, optional
        From where; by default from where what collides, or is in focus, is seen best.
    painter : Painter, optional
        Draws it; for many pictures make one and keep it.
    """
    look = look or Look()
    if viewpoint is None:
        viewpoint = viewpoint_of(shot, size_px, look)
    return draw_picture(
        shot.hull,
        shot.rig,
        drawn_objects(shot, look.heat),
        viewpoint=viewpoint,
        size_px=size_px,
        title=frame_title(shot.chain, shot.index),
        caption=caption_of(shot, look),
        marks=marks_of(look),
        images=look.images,
        heat=None if look.heat is None else look.heat.scale,
        with_overview=not look.focus and look.zoom <= 1.0,
        painter=painter,
    )


def draw_through_camera(
    shot: Shot, camera: int, size_px: tuple[int, int], look: Look, painter: Painter
) -> Image:
    """Return the frame as one of the cameras saw it, with the CAD in it, hidden where it would be.

    Where the camera recorded no picture, its silhouette stands for it, grey on black.

    Parameters
    ----------
    shot : Shot
        The frame.
    camera : int
        Which, of the session's.
    size_px : tuple of int
        Width and height.
    look : Look
        What else is shown; its images are used.
    painter : Painter
        Draws it.
    """
    image = look.images[camera] if len(look.images) else None
    if image is None:
        mask = shot.hull.mask(camera)
        image = np.repeat(mask[..., None] * np.uint8(_MASK_GREY), 3, axis=2)
    name = shot.chain.session.cameras[camera].name
    return draw_from_camera(
        shot.hull,
        camera,
        image,
        drawn_objects(shot, look.heat),
        size_px=size_px,
        zoom=look.zoom,
        at_world=_point_of(shot, look),
        title=f"{frame_title(shot.chain, shot.index)}, as {name} saw it",
        caption=caption_of(shot, look),
        marks=marks_of(look),
        heat=None if look.heat is None else look.heat.scale,
        painter=painter,
    )


def viewpoint_of(shot: Shot, size_px: tuple[int, int], look: Look) -> Viewpoint:
    """Return from where a frame is seen best: all of it, or what is in focus."""
    objects = drawn_objects(shot)
    ends = _ends_of(look)
    focus = None
    if look.focus:
        chosen = [one for one in objects if means(look.focus, one.name)]
        points = np.concatenate([one.vertices_world[np.unique(one.faces)] for one in chosen])
        points = np.concatenate([points, *(end[None] for end in ends)])
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        around = middle + _AROUND_FOCUS * (points - middle)
        at_world = _point_of(shot, look)
        if look.reach_m and at_world is not None:
            around = np.concatenate([around, at_world + look.reach_m * _SIX_WAYS])
        focus = Focus(around, tuple(one.name for one in chosen))
    aspect = size_px[0] / size_px[1]
    viewpoint = choose_viewpoint(shot.hull, shot.rig, objects, aspect=aspect, focus=focus)
    if look.zoom == 1.0:
        return viewpoint
    return zoomed(viewpoint, look.zoom, _point_of(shot, look))


def _ends_of(look: Look) -> list[NDArray[np.float64]]:
    """Return the points that the worst clearance was measured between, if they are known."""
    ends = [point for one in look.about[:1] for point in (one.on_object_world, one.on_hull_world)]
    return [point for point in ends if np.isfinite(point).all()]


def _point_of(shot: Shot, look: Look) -> NDArray[np.float64] | None:
    """Return what a picture that is zoomed in is about; None if there is no such point."""
    if ends := _ends_of(look):
        return np.asarray(np.mean(ends, axis=0))
    hits = [
        contact.points()[0]
        for part, contact in zip(shot.objects, shot.contacts, strict=True)
        if contact.collides and (not look.focus or means(look.focus, part.name))
    ]
    points = np.concatenate(hits) if hits else np.zeros((0, 3))
    return np.median(points, axis=0) if len(points) else None


def caption_of(shot: Shot, look: Look) -> str:
    """Return what is to be said of a frame: the report's words, or what is touched."""
    if look.moment is not None:
        outcome = replace(look.moment, objects=tuple(look.about)).text()
    else:
        touched = [
            body.name
            for body, contact in zip(shot.chain.bodies, shot.contacts, strict=True)
            if contact.collides
        ]
        outcome = f"touched: {', '.join(touched)}" if touched else "nothing is touched"
    return f"{look.heading}: {outcome}" if look.heading else outcome


def marks_of(look: Look) -> Marks:
    """Return clearances as lines with their numbers, ways, and V_rec and N_hull as arrows."""
    measures = []
    for one in _told_of(look):
        lower_m, upper_m = one.clearance_m
        ends = np.stack([one.on_object_world, one.on_hull_world])
        if not (np.isfinite(ends).all() and np.isfinite([lower_m, upper_m]).all()):
            continue
        if (ends[0] == ends[1]).all():
            continue
        deep = upper_m < 0.0
        told = bounds_mm(-upper_m, -lower_m) if deep else bounds_mm(lower_m, upper_m)
        text = f"{told} mm{' deep' if deep else ''}"
        measures.append(Measure(ends[0], ends[1], text, MEASURE_RGB))
    for one in _told_of(look) if look.arrows else ():
        start, end = one.cp_obj_world, one.cp_hull_world
        if not np.isfinite([start, end]).all():
            continue
        d_rec_m = float(np.linalg.norm(end - start))
        measures.append(Measure(start, end, f"V_rec, {1e3 * d_rec_m:.1f} mm", PATH_RGB, True))
        if np.isfinite(one.n_hull).all():
            tip = end + max(_NORMAL_M, 0.5 * d_rec_m) * one.n_hull
            measures.append(Measure(end, tip, "N_hull", _NORMAL_RGB, True))
    return Marks(paths_world=look.paths_world, measures=tuple(measures))


def _told_of(look: Look) -> list[ObjectMoment]:
    """Return the objects that do not keep their distance, or the one that keeps it least."""
    bad = [one for one in look.about if one.verdict not in ("kept", "not seen")]
    return (bad or look.about[:1])[:_MOST_MEASURES]


def has_pictures(session: Session, camera: SessionCamera) -> bool:
    """Tell whether a camera recorded pictures: ready masks are none, unless they are in colours."""
    if not camera.has_masks:
        return True
    first = recording_of(session, camera).first()
    if first.ndim != 3 or first.dtype != np.uint8:
        return False
    return bool((first[..., :3].max(axis=2) != first[..., :3].min(axis=2)).any())


def pinhole_images(chain: Chain, frames: FrameRange) -> Generator[list[Image | None]]:
    """Yield what the cameras recorded, frame by frame, as pinhole images; without an end.

    None for a camera that has no picture of a frame, or only masks.
    """
    lanes = [
        _pinhole_lane(chain, camera, lens, frames)
        for camera, lens in zip(chain.session.cameras, chain.undistortions, strict=True)
    ]
    try:
        while True:
            yield [next(lane) for lane in lanes]
    finally:
        for lane in lanes:
            lane.close()


def _pinhole_lane(
    chain: Chain, camera: SessionCamera, lens: Undistortion, frames: FrameRange
) -> Generator[Image | None]:
    shift, first = camera.shift_frames, frames.start
    if has_pictures(chain.session, camera):
        while first < shift and (frames.stop is None or first < frames.stop):
            yield None
            first += frames.step
        stop = None if frames.stop is None else max(frames.stop - shift, first - shift)
        source = recording_of(chain.session, camera)
        for image in source.frames_or_errors(first - shift, stop, frames.step):
            yield None if isinstance(image, SessionError) else _pinhole(image, lens)
    while True:
        yield None


def _pinhole(image: Image, lens: Undistortion) -> Image:
    """Return a recorded picture without lens distortion, BGR; black where nothing was recorded."""
    colours = image[..., :3] if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    if lens.map_x is None or lens.map_y is None:
        return np.ascontiguousarray(colours)
    return np.asarray(
        cv2.remap(colours, lens.map_x, lens.map_y, cv2.INTER_LINEAR, borderValue=0), np.uint8
    )


def draw_cameras(shot: Shot, look: Look | None = None) -> Image:
    """Return what each camera saw, with the silhouette's outline and the CAD drawn in.

    What of the CAD the hull hides is faint. Of many cameras the pictures are smaller, so that the
    sheet stays as wide as it is high, about.
    """
    objects = drawn_objects(shot)
    marks = marks_of(look or Look())
    cameras = shot.chain.session.cameras
    columns, share = sheet_layout(
        [(shot.rig[camera.name].width_px, shot.rig[camera.name].height_px) for camera in cameras],
        _SHEET_PX,
    )
    pictures = []
    with Painter() as painter:
        for number, (camera, mask) in enumerate(zip(cameras, shot.masks, strict=True)):
            one, lens = shot.rig[camera.name], shot.chain.undistortions[number]
            depth_m = _recorded_depth(shot, number, painter, lens)
            for image in _images(shot.chain.session, camera, shot.index):
                picture = draw_overlay(
                    image,
                    one,
                    mask,
                    objects,
                    hull_depth_m=depth_m,
                    measures=marks.measures,
                    share=share,
                    painter=painter,
                )
                pictures.append(picture)
    return contact_sheet(pictures, columns)


def _recorded_depth(
    shot: Shot, camera: int, painter: Painter, lens: Undistortion
) -> NDArray[np.float32]:
    """Return how deep the hull is in a camera's recorded image (H, W), metres; inf where it is not.

    By the nearest pixel of its pinhole image.
    """
    width, height = (int(size) for size in shot.hull.views.sizes_px[camera])
    view = recorded_view(shot.hull.views, camera, (1e-3, 1e6))
    depth_m = painter.depth(shot.hull, view, (width, height))
    known = np.where(np.isfinite(depth_m), depth_m, np.float32(0.0))
    name = shot.chain.session.cameras[camera].name
    found = as_recorded(known, shot.chain.rig[name], lens)
    return np.asarray(np.where(found > 0, found, np.inf), np.float32)


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
    return contrast_sheet(pictures, columns, frame_title(chain, index), has_unseen=has_unseen)


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


def frame_title(chain: Chain, index: int) -> str:
    """Return what a frame is called: session, number, time."""
    return f"{chain.session.name}, frame {index} ({index / chain.session.fps:.2f} s)"


def drawn_objects(shot: Shot, heat: Heat | None = None) -> list[DrawnObject]:
    """Return the CAD as it stands in a frame, with what collides; coloured by heat, if given."""
    drawn = []
    for part, contact, pose in zip(shot.objects, shot.contacts, shot.poses, strict=True):
        vertices, faces, hits = part.vertices_world, part.faces, contact.triangles()
        warmth = None
        if heat is not None and part.name in heat.maps:
            nearness = heat.maps[part.name]
            vertices = nearness.vertices if pose is None else placed(nearness.vertices, pose)
            faces = nearness.faces
            hits = np.flatnonzero(np.isin(nearness.parent, hits)).astype(np.uint32)
            warmth = heat.scale.warmth(nearness.distance_m)
        drawn.append(
            DrawnObject(
                name=part.name,
                vertices_world=vertices,
                faces=faces,
                collides=contact.collides,
                hit_triangles=hits,
                hit_points_world=contact.points()[0],
                warmth=warmth,
            )
        )
    return drawn
