"""What is real, and where CAD is, between two frames: the hull as often as its motion asks for.

A recording has 25 to 60 frames a second, a simulation takes hundreds of steps. Between two frames
nothing was seen: the hull there is an estimate, from the interpolated outlines that first contact
uses (`hybridve.hull.contact.between`), or it is held, which is that of the next frame all the way.

Objects that move as a file says go on with every step, whether or not the hull is held: their poses
between two frames are those of `hybridve.hull.cad.motion`. Where nothing is known of the frame
before, they have been where the frame has them, as the hull has.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.motion import Motion
from hybridve.hull.capture.outline_motion import Outline
from hybridve.hull.capture.pixel_boxes import box_of, grown_box, intersection, is_empty, slices_of
from hybridve.hull.contact.between import Between
from hybridve.hull.effects.effect import Course, Instant
from hybridve.hull.query.silhouettes import Hull, Views
from hybridve.hull.query.threads import Threads

HullMode = Literal["interpolate", "hold"]

#: How far the hull moves at most from one instant to the next, metres: less than a finger is wide,
#: so that nothing is on its other side between two steps.
MOST_MOTION_M = 0.008

#: What cameras look at is not nearer than the first; it is taken to be at the second where nothing
#: tells.
_LEAST_DEPTH_M, _USUAL_DEPTH_M = 0.05, 3.0

#: Hulls between two frames at most: 0.5 m from one frame to the next are followed.
MOST_HULLS = 64


@dataclass(frozen=True, slots=True)
class Pace:
    """How the way from one frame to the next is divided.

    Attributes
    ----------
    n_hulls : int
        Hulls on the way, evenly spaced; the last is that of the frame.
    n_steps : int
        Steps of a simulation for each.
    """

    n_hulls: int
    n_steps: int


def pace_of(elapsed_s: float, step_s: float, n_hulls: int) -> Pace:
    """Return the fewest steps no longer than `step_s`, as many for each of `n_hulls` hulls."""
    n_steps = max(1, math.ceil(elapsed_s / step_s * (1 - 1e-12)))
    return Pace(n_hulls, -(-n_steps // n_hulls))


def instants(
    before: Hull | None,
    after: Hull,
    *,
    start_s: float,
    elapsed_s: float,
    frame: int,
    step_s: float,
    mode: HullMode,
    motions: Mapping[str, Motion] | None = None,
    since: int | None = None,
    threads: Threads | None = None,
) -> Iterator[Sequence[Instant]]:
    """Yield for each hull that leads to a frame the instants of its equal steps.

    Where no CAD moves, the steps of one hull are the same instant.

    Parameters
    ----------
    before : Hull or None
        Of the frame before, or None where the hull may have been anywhere: it is then held.
    after : Hull
        Of the frame.
    start_s, elapsed_s : float
        When the frame before was, and how long ago.
    frame : int
        Number of the frame.
    step_s : float
        The longest step.
    mode : "interpolate" or "hold"
        What the hull is on the way.
    motions : mapping of str to Motion, optional
        Of the objects that move as a file says, by name; each has a pose of the frame.
    since : int or None
        Number of the frame before, if it has a pose of each, too; None where they are held.
    threads : Threads, optional
        Follow the outlines of several cameras at once.
    """
    n_hulls, between = 1, None
    if mode == "interpolate" and before is not None:
        n_hulls, between = _way(before, after, threads or Threads(1))
    pace = pace_of(elapsed_s, step_s, n_hulls)
    last = before
    for number in range(1, n_hulls + 1):
        fraction = number / n_hulls
        hull = after if between is None or number == n_hulls else between.hull(fraction)
        instant = Instant(
            time_s=start_s + fraction * elapsed_s,
            hull=hull,
            before=last,
            elapsed_s=elapsed_s / n_hulls,
            frame=frame,
            recorded=None if before is None or n_hulls == 1 else (before, after),
            recorded_s=elapsed_s,
        )
        steps = [instant] * pace.n_steps
        if motions:
            first = (number - 1) * pace.n_steps
            steps = [
                replace(
                    instant,
                    courses=_courses(motions, since, frame, first + step, n_hulls * pace.n_steps),
                )
                for step in range(pace.n_steps)
            ]
        yield steps
        last = hull


def _courses(
    motions: Mapping[str, Motion], since: int | None, frame: int, step: int, n_steps: int
) -> dict[str, Course]:
    """Return where objects are over one of all equal steps to a frame."""
    if since is None:
        return {name: Course(*[motion.poses[frame]] * 3) for name, motion in motions.items()}
    shares = (step / n_steps, (step + 0.5) / n_steps, (step + 1) / n_steps)
    return {
        name: Course(*(motion.between(since, frame, share) for share in shares))
        for name, motion in motions.items()
    }


def _way(before: Hull, after: Hull, threads: Threads) -> tuple[int, Between | None]:
    """Return how many hulls the way takes, and what gives them; None where it takes just one."""
    views = after.views
    most_px = MOST_MOTION_M / _pixels_m(views)
    still = (before.views.img_from_local == views.img_from_local).all()
    if still and all(
        moves_at_most(before.mask(camera), after.mask(camera), int(most_px[camera]))
        for camera in range(len(views))
    ):
        return 1, None
    windows = [(0, int(height), 0, int(width)) for width, height in views.sizes_px]
    between = Between(before, after, windows, threads)
    moved_px = np.array([_moved_px(outline) for outline in between.outlines(0.5)])
    n_hulls = math.ceil(float((moved_px / most_px).max()))
    return min(max(n_hulls, 1), MOST_HULLS), between


def _pixels_m(views: Views) -> NDArray[np.float64]:
    """Return how long a pixel of each camera is in the middle of what they see, (C,) metres."""
    matrices = views.img_from_local
    focal_px = np.linalg.norm(np.cross(matrices[:, 0, :3], matrices[:, 2, :3]), axis=1)
    depth_m = np.abs(matrices[:, 2, 3])
    # Parallel axes meet nowhere: there the cameras themselves are the middle.
    depth_m = np.where(depth_m > _LEAST_DEPTH_M, depth_m, _USUAL_DEPTH_M)
    return np.asarray(depth_m / focal_px)


def moves_at_most(before: NDArray[np.uint8], after: NDArray[np.uint8], most_px: int) -> bool:
    """Tell whether every object pixel of either mask is so near to one of the other.

    In a square's measure: up to 1.4 times as far as the crow flies.
    """
    changed = box_of(before ^ after)
    if is_empty(changed):
        return True
    height, width = before.shape
    crop = slices_of(intersection(grown_box(changed, most_px + 1), (0, height, 0, width)))
    first, second = before[crop], after[crop]
    kernel = np.ones((2 * most_px + 1, 2 * most_px + 1), np.uint8)
    return not (
        (second > cv2.dilate(first, kernel)).any() or (first > cv2.dilate(second, kernel)).any()
    )


def _moved_px(outline: Outline) -> float:
    """Return how far an outline moves between its frames, pixels; up to where distances end."""
    if is_empty(outline.changed):
        return 0.0
    crop = slices_of(outline.crop)
    first, second = outline.before[crop] > 0, outline.after[crop] > 0
    gained, lost = second & ~first, first & ~second
    moved = [float(math.hypot(*move.shift_px)) for move in outline.moves]
    if gained.any():
        moved.append(float(-outline.distance_before[gained].min()))
    if lost.any():
        moved.append(float(-outline.distance_after[lost].min()))
    return max(moved, default=0.0)
