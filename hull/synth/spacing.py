"""How much room a task needs: the smallest shift of a part at which all keeps its distance.

A distance changes by no more than the part is shifted. So where it falls short of what is required,
no shift that is smaller than what it lacks can help, and going on by just that much from shift to
shift ends at the smallest one that does, or beyond the range.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import Pose
from hybridve.hull.synth.closest import closest_on_surface
from hybridve.hull.synth.cones import Surface, TrueHull
from hybridve.hull.synth.shapes import Shape

#: How far a distance may fall short of what is required.
SHORTFALL_M = 2e-6

#: So many of the hull's points that come too near are followed until they are free.
_FOLLOWED = 64


@dataclass(frozen=True, slots=True, eq=False)
class Needed:
    """The room a recording needs, F frames.

    Attributes
    ----------
    by_frame_m : (F,) float64
        The smallest shift that each frame alone allows; inf where none in the range does.
    shift_m : float
        The smallest shift that all frames allow.
    frame : int
        The frame that asks for it.
    """

    by_frame_m: NDArray[np.float64]
    shift_m: float
    frame: int


def needed_for_shapes(
    triangles_world: NDArray[np.float64],
    along: NDArray[np.float64],
    range_m: tuple[float, float],
    required_m: float,
    shapes: Sequence[Shape],
    frames: Sequence[Sequence[Pose]],
) -> Needed:
    """Return the room that true shapes need.

    Parameters
    ----------
    triangles_world : (T, 3, 3) float64
        The part where the scene has it, metres: closed, and what lies wholly inside is not free.
    along : (3,) float64
        Unit vector, world: where it is shifted.
    range_m : tuple of 2 float
        The smallest and the largest shift considered.
    required_m : float
        The distance to keep.
    shapes : sequence of Shape
        The real things.
    frames : sequence of sequence of (3, 4) float64
        Where each stands in each frame.
    """

    def lacking_m(frame: int, shift_m: float) -> float:
        moved = triangles_world + shift_m * along
        distance_m = closest_on_surface(moved, shapes, frames[frame]).distance_m
        if distance_m > 0 and _encloses_any(moved, np.array([p[:, 3] for p in frames[frame]])):
            distance_m = -distance_m  # it would have to be carried out through the surface
        return required_m - distance_m

    def smallest(frame: int, shift_m: float) -> float:
        while shift_m <= range_m[1]:
            step_m = lacking_m(frame, shift_m)
            if step_m <= SHORTFALL_M:
                return shift_m
            shift_m += step_m
        return np.inf

    return _for_all_frames(smallest, [range_m[0]] * len(frames))


def needed_for_hulls(
    triangles_world: NDArray[np.float64],
    along: NDArray[np.float64],
    range_m: tuple[float, float],
    required_m: float,
    hulls: Sequence[TrueHull],
    at_least: Needed,
) -> Needed:
    """Return the room that the hulls of the shapes need, to the hull's resolution.

    What of a hull lies wholly inside the part, apart from all else, goes unnoticed.

    Parameters
    ----------
    triangles_world, along, range_m, required_m
        As in `needed_for_shapes`.
    hulls : sequence of TrueHull
        One a frame.
    at_least : Needed
        What the shapes need: a hull is never smaller than they are, where all cameras see them.
    """

    def smallest(frame: int, shift_m: float) -> float:
        while shift_m <= range_m[1]:
            surface = Surface(triangles_world + shift_m * along)
            points = hulls[frame].points_within(surface, required_m)
            if not len(points):
                return shift_m
            ahead = np.argsort(points @ along)[-_FOLLOWED:]
            shift_m += _until_free(surface, points[ahead], along, range_m[1], required_m)
        return np.inf

    return _for_all_frames(smallest, [float(shift_m) for shift_m in at_least.by_frame_m])


def _until_free(
    surface: Surface,
    points: NDArray[np.float64],
    along: NDArray[np.float64],
    limit_m: float,
    required_m: float,
) -> float:
    """Return the smallest further shift that frees every one of some points (N, 3).

    Each point forbids all shifts up to its own, so together they forbid all up to the largest.
    """
    shifts = np.zeros(len(points))
    waiting = np.arange(len(points))
    while len(waiting):
        # Shifting the surface one way is shifting the points the other way.
        distances, _ = surface.distance(points[waiting] - shifts[waiting, None] * along)
        lacking = required_m - distances
        shifts[waiting] += np.maximum(lacking, 0.0)
        waiting = waiting[(lacking > SHORTFALL_M) & (shifts[waiting] <= limit_m)]
    return max(float(shifts.max()), SHORTFALL_M)


def _encloses_any(triangles: NDArray[np.float64], points: NDArray[np.float64]) -> bool:
    """Tell whether a closed surface encloses any of some points, by the solid angle it fills.

    References
    ----------
    van Oosterom and Strackee, *The solid angle of a plane triangle*, IEEE Transactions on
    Biomedical Engineering 30, 1983, equation 8.
    """
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    points = points[((points > low) & (points < high)).all(axis=1)]
    a, b, c = np.moveaxis(triangles[None] - points[:, None, None], 2, 0)  # (N, T, 3)
    la, lb, lc = (np.linalg.norm(corner, axis=2) for corner in (a, b, c))
    volume = (a * np.cross(b, c)).sum(axis=2)
    across = la * lb * lc + (a * b).sum(axis=2) * lc
    across += (b * c).sum(axis=2) * la + (c * a).sum(axis=2) * lb
    turns = np.arctan2(volume, across).sum(axis=1) / (2.0 * np.pi)
    return bool((turns > 0.5).any())


def _for_all_frames(smallest: Callable[[int, float], float], starts_m: Sequence[float]) -> Needed:
    """Return what each frame needs from its start on, and what all need together."""
    by_frame_m = np.array([smallest(frame, start) for frame, start in enumerate(starts_m)])
    frame = int(by_frame_m.argmax())
    shift_m = float(by_frame_m[frame])
    # Farther away, a frame may clash that was free before: go round until all agree.
    agreed = 0
    other = 0
    while agreed < len(by_frame_m) and np.isfinite(shift_m):
        further_m = shift_m if by_frame_m[other] == shift_m else smallest(other, shift_m)
        if further_m > shift_m:
            shift_m, frame, agreed = further_m, other, 0
        agreed += 1
        other = (other + 1) % len(by_frame_m)
    return Needed(by_frame_m, shift_m, frame)
