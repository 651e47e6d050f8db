"""What errors of outlines and cameras do to the room a task needs: the shift that suffices at 95 %.

Let c(s) be the clearance that the hull of one frame keeps from an object moved by s, found from
silhouettes and cameras that err: too large by more than q in 5 % of recordings
(`hybridve.hull.contact.outline_errors`: segmentation, undistortion, rounding, and the rig's
covariance; q is 1.645 standard deviations, or more where any of several cameras ends the hull).
With C the clearance that is required, a frame is *sure to keep it at 95 %* where

    c(s) - q >= C,

which is what ``clearance_at_least_m`` of a report says of the layout moved by s. The shift that
suffices at 95 % is the smallest one at which every frame is sure to keep what every object
requires. It is an estimate.

Why 95 % of each frame are 95 % of the recording
------------------------------------------------
Let T be the shift that is truly needed, found from true silhouettes and true cameras, and b the
frame (and object) that truly decides it: moved by less than T, b falls short of C. Which one that
is is a fact of what was recorded; no error changes it. The shift told is below T only if b, too, is
taken to be sure of its clearance there, for which its own clearance must be found too large by more
than q: in 5 % of recordings. What all other frames say can only raise the answer.

So nothing need be known of how errors hang together from frame to frame: not that all share the
cameras', nor that outlines of neighbouring frames of a slow motion err alike. What it costs is that
the answer is larger than need be where several frames decide and err independently. Of n frames
that need the same room one or the other is as a rule found to need more than it does, and all must
be wrong together for the answer to fall short: at 95 % is then at 1 - 0.05^n. The 95 % quantile of
``max_f (s_f + e_f)``, with s_f what frames were found to need and e_f their errors, would count
that twice, once in s_f and once in e_f, and is larger still.

Conversion to a length along the move is not needed: what is asked is the same question with a
larger clearance, so that a surface that moves away at a slant must go as much farther.

What is assumed
---------------
* Errors are normal and small against what they act on. Of a thing thinner than its outlines' errors
  the silhouette may lack the whole, and no deviation tells of that.
* q is that at the ends of the shifts that a frame is not sure of, the largest of them where
  there are several, one of each object. It is found by going round: shifts for a q, q at their
  ends, until they agree.
* One end decides. If what is free ends again farther away, there is another end with 5 % of its
  own, which matters where the stretch is about as narrow as q.
* The hull holds whatever is real, and is larger where no camera looks: what real things need is
  less than T, never more.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.contact.spacing import (
    METER_SHARE,
    NOTHING,
    BlockedShifts,
    Move,
    MovedObject,
    blocked_by,
    free_of,
    union,
    without,
)
from hybridve.hull.contact.uncertainty import ONE_SIDED_95, Deviation, FrameDoubts
from hybridve.hull.query.silhouettes import Views

#: A frame is first asked for so many times the deviation that a pixel's size makes likely. One that
#: keeps even that is left alone, so it is generous.
_LOOK = 3.0

#: Times that shifts and what their ends may be off are found from each other, at most; most often
#: it is two or three.
_MOST_ROUNDS = 8

#: What shifts were found for may be larger than what their ends may be off, by this share.
_AGREE = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class UnsureShifts:
    """The shifts of a range at which one frame is not sure to keep what is required, at 95 %.

    Attributes
    ----------
    unsure_m : (N, 2) float64
        Stretches of shifts, ascending and apart, metres. Those that violate what is required, and
        those of which that is unknown, are among them.
    std_m : float
        Standard deviation of the clearance at their ends, metres: where it may be found too large
        by most; of several objects the largest; NaN where none comes near.
    too_large_95_m : float
        By how much it is found too large there in no more than 5 % of recordings; likewise.
    n_measured : int
        How many measurements that took.
    """

    unsure_m: NDArray[np.float64]
    std_m: float
    too_large_95_m: float
    n_measured: int


def unsure_shifts(
    doubts: FrameDoubts, objects: Sequence[MovedObject], move: Move, blocked: BlockedShifts
) -> UnsureShifts:
    """Return the shifts at which a frame is not sure, at 95 %, to keep any object's clearance.

    Parameters
    ----------
    doubts : FrameDoubts
        Of the frame.
    objects : sequence of MovedObject
        What is moved.
    move : Move
        Whereto.
    blocked : BlockedShifts
        What `hybridve.hull.contact.spacing.blocked_shifts` found of the frame.
    """
    unsure_m = union(blocked.violated_m, blocked.undecided_m)
    std_m, too_large_m, n_measured = np.nan, np.nan, 0
    for one in objects:
        found = _unsure_of(doubts, one, move, blocked.violated_m)
        unsure_m = union(unsure_m, found.unsure_m)
        std_m = float(np.fmax(std_m, found.std_m))
        too_large_m = float(np.fmax(too_large_m, found.too_large_95_m))
        n_measured += found.n_measured
    return UnsureShifts(unsure_m, std_m, too_large_m, n_measured)


def _unsure_of(
    doubts: FrameDoubts, one: MovedObject, move: Move, violated_m: NDArray[np.float64]
) -> UnsureShifts:
    """Return the shifts at which a frame is not sure to keep one object's clearance."""
    whole_m = np.array([[move.start_m, move.stop_m]])
    margin_m = _LOOK * ONE_SIDED_95 * _likely_std_m(doubts)
    known_m, free_m = violated_m, NOTHING
    n_measured, has_grown = 0, False
    for _ in range(_MOST_ROUNDS):
        wider = replace(one, clearance_m=one.clearance_m + margin_m)
        more_m, undecided_m, n_more = blocked_by(doubts.hull, wider, move, known_m, free_m)
        n_measured += n_more
        unsure_m = union(more_m, undecided_m)
        # What other objects violate ends where it does, whatever this one's deviation is.
        ends_m = _ends_of(free_of(move, unsure_m), move)
        ends_m = ends_m[~np.isin(ends_m, violated_m)]
        if len(ends_m) == 0:
            return UnsureShifts(unsure_m, np.nan, np.nan, n_measured)
        found = [_deviation_at(doubts, one, move, float(at)) for at in ends_m]
        n_measured += len(ends_m)
        worst = found[int(np.argmax([other.too_large_95_m for other in found]))]  # or NaN
        std_m, found_m = worst.std_m, worst.too_large_95_m
        if not np.isfinite(found_m):  # no direction leads from the hull: nothing is sure
            return UnsureShifts(whole_m, np.nan, np.nan, n_measured)
        tolerance_m = METER_SHARE * move.tolerance_m
        is_enough = found_m <= margin_m + tolerance_m
        if is_enough and (has_grown or margin_m <= (1.0 + _AGREE) * found_m + tolerance_m):
            break
        has_grown = has_grown or not is_enough
        # Of a larger clearance less is kept, and more violated.
        if found_m > margin_m:
            known_m, free_m = more_m, NOTHING
        else:
            known_m, free_m = violated_m, without(whole_m, unsure_m)
        margin_m = found_m
    return UnsureShifts(unsure_m, std_m, margin_m, n_measured)


def _ends_of(free_m: NDArray[np.float64], move: Move) -> NDArray[np.float64]:
    """Return where free stretches (N, 2) end within the range: (K,), metres."""
    ends_m = free_m.ravel()
    return np.asarray(ends_m[(ends_m > move.start_m) & (ends_m < move.stop_m)])


def _deviation_at(doubts: FrameDoubts, one: MovedObject, move: Move, shift_m: float) -> Deviation:
    """Return how far the clearance of an object moved so far may be off."""
    shift_world = shift_m * move.direction
    return doubts.deviation(one.meter, one.meter.measure(doubts.hull, shift_world), shift_world)


def _likely_std_m(doubts: FrameDoubts) -> float:
    """Return what an error of each camera's outline is at the origin of the views, the largest."""
    sizes_m = _pixel_sizes_m(doubts.hull.views)
    likely_m = np.hypot(doubts.errors.sigma_px, doubts.errors.calibration_px) * sizes_m
    return float(likely_m.max())


def _pixel_sizes_m(views: Views) -> NDArray[np.float64]:
    """Return how wide a pixel is at the views' origin, across its ray, for each camera (C,).

    A camera in whose own plane the origin lies sees nothing there, and tells 0.
    """
    origin = views.img_from_local[:, :, 3]  # (C, 3), homogeneous pixels
    in_front = origin[:, 2] != 0
    depth = np.where(in_front, origin[:, 2], 1.0)
    pixels = origin[:, :2] / depth[:, None]
    derivatives = (
        views.img_from_local[:, :2, :3] - pixels[:, :, None] * views.img_from_local[:, 2:, :3]
    ) / depth[:, None, None]  # (C, 2, 3), pixels a metre
    least = np.linalg.svd(derivatives, compute_uv=False)[:, -1]
    return np.where(in_front & (least > 0), 1.0 / np.where(least > 0, least, 1.0), 0.0)
