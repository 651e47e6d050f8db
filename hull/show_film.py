"""A recording as a film: hull, CAD and what a report says, frame after frame."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.calib.pose import Pose
from hybridve.hull.capture.recording import FrameRange
from hybridve.hull.chain import Chain, FrameHull, hulls, views_at
from hybridve.hull.contact.nearness import Nearness
from hybridve.hull.query.engine import Engine
from hybridve.hull.query.silhouettes import make_hull
from hybridve.hull.report.clashes import Clash
from hybridve.hull.report.moment import means, moment_of, worst_clashes, worst_frame
from hybridve.hull.report.read import Report
from hybridve.hull.show import (
    Heat,
    Image,
    Look,
    Shot,
    draw_scene,
    draw_through_camera,
    pinhole_images,
    shot_of,
    viewpoint_of,
)
from hybridve.hull.view.heat_scale import HeatScale
from hybridve.hull.view.picture import Painter, Viewpoint
from hybridve.hull.view.viewpoint import orbited

#: Of each clash so much is shown before and after its worst frame, seconds.
_AROUND_S = 1.0

#: It shows so much about the worst point at least: who touches the part, too.
_REACH_M = 0.45

#: Clashes that a film shows, the worst.
_MOST_CLASHES = 6

#: An orbit takes so long, seconds.
_ORBIT_S = 12.0

#: Ways of the nearest point: so much of the past, and steps longer than this are jumps.
_PATH_S, _JUMP_M = 2.0, 0.15

#: A head sees so much, degrees from the upper to the lower border.
_HEAD_FOV_DEG = 60.0

#: A heat map is looked at in so many frames at most, spread over the recording.
_MOST_HEAT_FRAMES = 200


@dataclass(frozen=True, slots=True)
class Span:
    """A part of a film.

    Attributes
    ----------
    frames : FrameRange
        Which frames.
    heading : str
        Written before what is told of each.
    focus : str
        The object that it is about; empty for all.
    """

    frames: FrameRange
    heading: str = ""
    focus: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Outside:
    """Seen from outside, from one place for each span."""


@dataclass(frozen=True, slots=True, eq=False)
class Orbit:
    """Seen from outside, going around."""


@dataclass(frozen=True, slots=True, eq=False)
class ThroughCamera:
    """Seen as one of the session's cameras saw it, by its number."""

    number: int


@dataclass(frozen=True, slots=True, eq=False)
class Head:
    """Seen by a head that moves.

    Attributes
    ----------
    poses : mapping of int to (3, 4) float64
        By frame world_from_head; it looks along its z, x is right and y is down.
    """

    poses: Mapping[int, Pose]

    def viewpoint(self, index: int) -> Viewpoint | None:
        """Return from where it looks in a frame; None where that is not known."""
        pose = self.poses.get(index)
        if pose is None:
            return None
        eye = np.asarray(pose[:, 3], np.float64)
        return Viewpoint(eye, eye + pose[:, 2], -pose[:, 1], _HEAD_FOV_DEG)


View = Outside | Orbit | ThroughCamera | Head


def worst_spans(
    report: Report,
    fps: float,
    ids: Callable[[Sequence[Clash]], Sequence[str]],
    focus: str = "",
) -> list[Span]:
    """Return the worst seconds of each clash of a report; without one, those of its worst frame.

    Parameters
    ----------
    report : Report
        As it was read.
    fps : float
        Of the session.
    ids : callable
        Returns what the ledger calls clashes.
    focus : str
        Only of these objects, by name or pattern; empty for all.
    """
    names = tuple(one for one in report.objects if not focus or means(focus, one))
    first, last = int(report.index.min()), int(report.index.max())
    step = int(np.diff(report.index).min()) if len(report.index) > 1 else 1
    around = max(1, round(_AROUND_S * fps))

    def span(frame: int, heading: str, about: str) -> Span:
        start = max(first, frame - around // step * step)
        frames = FrameRange(start, min(last, frame + around) + 1, step)
        return Span(frames, heading, about)

    clashes = worst_clashes(report, names)
    if not clashes:
        return [span(worst_frame(report, names), "", focus)]
    named = ids(clashes)
    spans = [
        span(clash.worst.frame, name, clash.name)
        for clash, name in zip(clashes, named, strict=True)
    ]
    return spans[:_MOST_CLASHES]


def draw_span(
    chain: Chain,
    span: Span,
    engine: Engine,
    painter: Painter,
    size_px: tuple[int, int],
    *,
    look: Look,
    view: View,
    textured: bool,
    report: Report | None = None,
    paths: bool = False,
) -> Iterator[Image]:
    """Yield the frames of a span, as pictures.

    Parameters
    ----------
    chain : Chain
        The recording.
    span : Span
        Which frames of it, and what they are about.
    engine : Engine
        Answers what collides.
    painter : Painter
        Draws.
    size_px : tuple of int
        Width and height.
    look : Look
        What else is shown; moment and images are those of each frame.
    view : View
        From where.
    textured : bool
        Whether the hull is drawn as it looked.
    report : Report, optional
        What is told of each frame.
    paths : bool
        Whether the ways of the nearest points are drawn, of a report.

    Raises
    ------
    SessionError
        If no frame is known that it could be looked at from, as a head's poses are of others.
    """
    focus = look.focus or span.focus
    reach_m = look.reach_m if look.focus else _REACH_M
    look = replace(look, focus=focus, reach_m=reach_m, heading=span.heading)
    chain = replace(chain, settings=replace(chain.settings, frames=span.frames))
    still: Viewpoint | None = None
    if isinstance(view, (Outside, Orbit)):
        still = _still_viewpoint(chain, span, engine, size_px, look, report)
    wants_images = textured or isinstance(view, ThroughCamera)
    with closing(hulls(chain)) as frames, closing(pinhole_images(chain, span.frames)) as images:
        first_s = span.frames.start / chain.session.fps
        for frame in frames:
            seen = next(images) if wants_images else []
            viewpoint = still
            if isinstance(view, Head):
                viewpoint = view.viewpoint(frame.index)
                if viewpoint is None:
                    continue
            if isinstance(view, Orbit) and still is not None:
                turn = 2 * np.pi * (frame.time_s - first_s) / _ORBIT_S
                viewpoint = orbited(still, turn)
            shot = _shot(chain, frame, engine)
            told = None if report is None else moment_of(report, frame.index)
            ways = () if report is None or not paths else nearest_paths(report, frame.index, focus)
            now = replace(look, moment=told, images=seen, paths_world=ways)
            if frame.reason:
                now = replace(now, heading=f"not evaluated ({frame.reason})")
            if isinstance(view, ThroughCamera):
                yield draw_through_camera(shot, view.number, size_px, now, painter)
            else:
                yield draw_scene(shot, size_px, now, viewpoint, painter)


def _still_viewpoint(
    chain: Chain,
    span: Span,
    engine: Engine,
    size_px: tuple[int, int],
    look: Look,
    report: Report | None,
) -> Viewpoint:
    """Return from where the middle frame of a span is seen best."""
    frames = span.frames
    if frames.stop is not None:
        middle = frames.start + (frames.stop - frames.start) // 2 // frames.step * frames.step
        chain = replace(
            chain, settings=replace(chain.settings, frames=FrameRange(middle, middle + 1))
        )
    with closing(hulls(chain)) as found:
        frame = next(found, None)
    if frame is None:
        raise SessionError(
            f"{chain.session.path}: the recording has none of the frames {span.frames}; there is "
            "no picture to make a film of"
        )
    told = None if report is None else moment_of(report, frame.index)
    shot = _shot(chain, frame, engine)
    return viewpoint_of(shot, size_px, replace(look, moment=told))


def _shot(chain: Chain, frame: FrameHull, engine: Engine) -> Shot:
    """Return a frame as a shot; one without a hull as one of nothing."""
    if frame.hull is not None:
        return shot_of(chain, frame.index, frame.hull, [], engine)
    known = _known_frame(chain, frame.index)
    views = views_at(chain, known)
    masks = [np.zeros((height, width), np.uint8) for width, height in views.sizes_px]
    return replace(shot_of(chain, known, make_hull(views, masks), [], engine), index=frame.index)


def _known_frame(chain: Chain, index: int) -> int:
    """Return a frame in which it is known where all is that moves: this one, if it can be."""
    if not (chain.tracks.missing(index) or chain.scene.missing(index)):
        return index
    moving = [set(poses) for poses in chain.tracks.poses.values()]
    moving += [set(one.motion.poses) for one in chain.scene.objects if one.motion is not None]
    return min(set.intersection(*moving), key=lambda other: abs(other - index))


def nearest_paths(
    report: Report, last: int | None, focus: str = ""
) -> tuple[NDArray[np.float64], ...]:
    """Return the ways of the point of the hull that was nearest to each object, metres.

    Parameters
    ----------
    report : Report
        As it was read.
    last : int or None
        The number of the frame up to which the last seconds are shown; None for all frames.
    focus : str
        Only of these objects.
    """
    kept = np.ones(len(report.index), np.bool_)
    if last is not None:
        now_s = report.time_s[report.index <= last].max(initial=-np.inf)
        kept = (report.index <= last) & (report.time_s >= now_s - _PATH_S)
    ways = []
    for name, rows in report.objects.items():
        points = rows.get("clearance_on_hull_m")
        if points is None or (focus and not means(focus, name)):
            continue
        points = points[kept]
        with np.errstate(invalid="ignore"):
            apart_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
            breaks = np.flatnonzero(~(apart_m <= _JUMP_M)) + 1
        ways += [way for way in np.split(points, breaks) if len(way) > 1]
    return tuple(way for way in ways if np.isfinite(way).all())


def heat_of(
    chain: Chain,
    reach_m: float,
    names: tuple[str, ...],
    progress: Callable[[str, int, int], None] | None = None,
) -> Heat:
    """Return how near real things came to objects in the chosen frames of a recording.

    Parameters
    ----------
    chain : Chain
        The recording.
    reach_m : float
        How far is looked.
    names : tuple of str
        The objects.
    progress : callable, optional
        Told ``(what, done, total)``.

    Raises
    ------
    SessionError
        If no frame has a hull.
    """
    maps = {
        one.name: Nearness(
            one.vertices_world,
            one.faces,
            is_closed=one.is_closed,
            solid_faces=one.solid_faces,
            reach_m=reach_m,
        )
        for one in chain.scene.objects
        if one.name in names
    }
    motions = {one.name: one.motion for one in chain.scene.objects}
    first: int | None = None
    last, count = 0, 0
    with closing(hulls(chain)) as frames:
        for frame in frames:
            if frame.hull is None:
                continue
            for name, nearness in maps.items():
                motion = motions[name]
                pose = None if motion is None else motion.world_from_rest(frame.index)
                nearness.look(frame.hull, pose)
            first = frame.index if first is None else first
            last, count = frame.index, count + 1
            if progress is not None:
                progress("heat", count, 0)
    if first is None:
        raise SessionError(f"{chain.session.path}: none of the frames has a hull to measure from")
    off_m = max((one.off_m for one in maps.values()), default=0.0)
    step = f", every {chain.settings.frames.step}." if chain.settings.frames.step > 1 else ""
    return Heat(maps, HeatScale(reach_m, off_m, f"frames {first} to {last}{step}"))
