"""By how much an object must be moved, so that the hull keeps away from it: for all shifts at once.

Let f(s) be the signed distance between the hull of one frame and an object moved by s along a
direction, and C the clearance it requires. A shift *violates* where f(s) < C, or where hull and
surface meet. As f changes by at most a metre a metre, one measurement decides about a stretch of
shifts:

* f(m) >= L > C: every shift within L - C of m keeps the clearance;
* f(m) <= U < C: every shift within C - U of m violates it.

The second is little where a thin part is deep in a thick hull. So the line along the move through
the witness is looked at: with T the stretches of it in the hull, and O those in the object or
nearer to it than C, every shift in m + T - O violates, be it half a metre of them.

What is left is halved. A piece a quarter of the tolerance wide is measured once more, and what that
does not decide stays *undecided*: whoever asks counts it as violated, which is safe.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.contact.clearance import Clearance, ClearanceMeter
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.walk import spans_in_hull

#: Proofs are told less wide by this, far above rounding and far below what matters, metres.
_MARGIN_M = 1e-9

#: Pieces this share of the tolerance wide are not cut any further.
_FINEST = 1.0 / 4.0

#: A witness this many tolerances too near ends a measurement.
_DEEP_ENOUGH = 4.0

#: By how much each next point of a line is farther from the witness than the one before.
_STRIDE = 1.3

#: Bounds of a measurement are this share of the tolerance apart.
METER_SHARE = 1.0 / 8.0

#: No stretch at all.
NOTHING = np.zeros((0, 2))


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """Where to objects are moved: all of them rigidly together.

    Attributes
    ----------
    direction : (3,) float64
        Unit vector, world frame.
    start_m, stop_m : float
        The range of shifts along it, start < stop.
    tolerance_m : float
        How narrowly it is to be known where the clearance is kept, above 0.
    """

    direction: NDArray[np.float64]
    start_m: float
    stop_m: float
    tolerance_m: float

    def __post_init__(self) -> None:
        if not -np.inf < self.start_m < self.stop_m < np.inf:
            raise ValueError(f"a range from {self.start_m} to {self.stop_m} m holds no shift")
        if not self.tolerance_m > 0:
            raise ValueError(f"the tolerance is {self.tolerance_m} m, expected more than 0")


@dataclass(frozen=True, slots=True, eq=False)
class MovedObject:
    """One of the objects that are moved.

    Attributes
    ----------
    meter : ClearanceMeter
        Measures it, in its place at shift 0, to `METER_SHARE` of the move's tolerance. Of one that
        moves by itself, as it stands in the frame.
    clearance_m : float
        How far real things are to stay away, not negative.
    """

    meter: ClearanceMeter
    clearance_m: float


@dataclass(frozen=True, slots=True, eq=False)
class BlockedShifts:
    """The shifts of a range at which one frame does not let the objects be.

    Attributes
    ----------
    violated_m : (N, 2) float64
        Stretches of shifts that certainly violate, ascending and apart, metres.
    undecided_m : (M, 2) float64
        Stretches between them of which nothing is known. Where the clearance is just kept, or just
        not, many pieces may follow each other.
    n_measured : int
        How many measurements that took.
    """

    violated_m: NDArray[np.float64]
    undecided_m: NDArray[np.float64]
    n_measured: int


def blocked_shifts(hull: Hull, objects: Sequence[MovedObject], move: Move) -> BlockedShifts:
    """Return the shifts at which the hull of a frame violates the clearance of any object."""
    violated_m, undecided_m, n_measured = NOTHING, NOTHING, 0
    for one in objects:
        violated_m, more_m, n_more = blocked_by(hull, one, move, violated_m)
        undecided_m = union(undecided_m, more_m)
        n_measured += n_more
    return BlockedShifts(violated_m, without(undecided_m, violated_m), n_measured)


def verdict_at(
    hull: Hull, one: MovedObject, move: Move, shift_m: float
) -> Literal["keeps", "violates", "undecided"]:
    """Tell whether an object moved so far keeps its clearance."""
    keeps, violates = _decided_at(hull, one, move, shift_m, 0.0)
    at = np.array([shift_m])
    if covers(keeps, at)[0]:
        return "keeps"
    return "violates" if covers(violates, at)[0] else "undecided"


def tightest_at(
    hull: Hull, objects: Sequence[MovedObject], move: Move, shift_m: float
) -> tuple[int, Clearance]:
    """Return which object is nearest to violating its clearance, moved so far, and its clearance.

    Nearest is the one with the smallest upper bound less what it requires.
    """
    found = [
        one.meter.measure(
            hull,
            shift_m * move.direction,
            # Of a surface that bounds nothing a touch is all there is to know.
            stop_below_m=-np.inf if one.meter.is_closed else one.meter.tolerance_m,
        )
        for one in objects
    ]
    spare_m = [
        clearance.signed_m[1] - one.clearance_m
        for clearance, one in zip(found, objects, strict=True)
    ]
    tightest = int(np.argmin(spare_m))
    return tightest, found[tightest]


def union(*stretches: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what any of several sets (N, 2) of stretches covers, ascending and apart.

    Examples
    --------
    >>> union(np.array([[0.0, 2.0], [5.0, 6.0]]), np.array([[1.0, 3.0]])).tolist()
    [[0.0, 3.0], [5.0, 6.0]]
    """
    together = np.concatenate(stretches)
    together = together[np.argsort(together[:, 0], kind="stable")]
    if len(together) == 0:
        return NOTHING
    reached = np.maximum.accumulate(together[:, 1])
    begins = np.concatenate([[True], together[1:, 0] > reached[:-1]])
    ends = np.concatenate([begins[1:], [True]])
    return np.column_stack([together[begins, 0], reached[ends]])


def without(stretches: NDArray[np.float64], taken: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what is left of stretches (N, 2) without others (M, 2), each ascending and apart.

    Examples
    --------
    >>> without(np.array([[0.0, 4.0]]), np.array([[1.0, 2.0], [3.0, 9.0]])).tolist()
    [[0.0, 1.0], [2.0, 3.0]]
    """
    begins = np.concatenate([[-np.inf], taken[:, 1]])
    ends = np.concatenate([taken[:, 0], [np.inf]])
    low = np.maximum(stretches[:, None, 0], begins)  # (N, M + 1)
    high = np.minimum(stretches[:, None, 1], ends)
    left = low < high
    return np.column_stack([low[left], high[left]])


def covers(stretches: NDArray[np.float64], shifts_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which shifts (K,) lie in stretches (N, 2) that are ascending and apart; ends do."""
    at = np.searchsorted(stretches[:, 0], shifts_m, side="right") - 1
    inside = at >= 0
    inside[inside] = shifts_m[inside] <= stretches[at[inside], 1]
    return np.asarray(inside, np.bool_)


def free_of(move: Move, taken_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the stretches of a range that others (M, 2), ascending and apart, leave.

    Narrower ones than the tolerance are left out, but for one at the end of the range: what is left
    between two undecided pieces is no place to build anything.
    """
    free_m = without(np.array([[move.start_m, move.stop_m]]), taken_m)
    is_wide = free_m[:, 1] - free_m[:, 0] >= move.tolerance_m
    return np.asarray(free_m[is_wide | (free_m[:, 1] == move.stop_m)])


def blocked_by(
    hull: Hull,
    one: MovedObject,
    move: Move,
    violated_m: NDArray[np.float64] = NOTHING,
    free_m: NDArray[np.float64] = NOTHING,
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Return the shifts at which a frame does not let one object be, among those not known.

    Parameters
    ----------
    hull : Hull
        The hull of the frame.
    one : MovedObject
        The object.
    move : Move
        Whereto it is moved.
    violated_m, free_m : (N, 2) float64
        Stretches of shifts that are not asked for, as it is known that the one are violated and the
        other free; each ascending and apart, metres.

    Returns
    -------
    violated_m : (N, 2) float64
        Stretches that certainly violate, those known among them.
    undecided_m : (M, 2) float64
        Those of which nothing is known.
    n_measured : int
        How many measurements that took.
    """
    undecided: list[NDArray[np.float64]] = [NOTHING]
    n_measured = 0
    pieces = [(move.start_m, move.stop_m)]
    while pieces:
        piece = np.array([pieces.pop()])
        left = without(piece, union(free_m, violated_m))
        if not np.array_equal(left, piece):
            pieces.extend((low, high) for low, high in left.tolist()[::-1])
            continue
        low_m, high_m = piece[0].tolist()
        middle_m, half_m = 0.5 * (low_m + high_m), 0.5 * (high_m - low_m)
        keeps, violates = _decided_at(hull, one, move, middle_m, half_m)
        n_measured += 1
        free_m, violated_m = union(free_m, keeps), union(violated_m, violates)
        if high_m - low_m > _FINEST * move.tolerance_m:
            pieces += [(middle_m, high_m), (low_m, middle_m)]
        else:
            undecided.append(without(piece, union(free_m, violated_m)))
    undecided_m = without(union(*undecided), union(free_m, violated_m))
    return _within(violated_m, move), undecided_m, n_measured


def _decided_at(
    hull: Hull, one: MovedObject, move: Move, shift_m: float, half_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the stretches that keep the clearance and that violate it, by one measurement.

    `half_m` is how far to either side of the shift an answer is wanted.
    """
    meter, required_m = one.meter, one.clearance_m
    # A witness somewhat deep is enough: its line does the rest.
    enough_m = required_m - min(half_m, _DEEP_ENOUGH * move.tolerance_m)
    if not meter.is_closed:  # nothing is below 0 there
        enough_m = max(enough_m, meter.tolerance_m)
    found = meter.measure(
        hull,
        shift_m * move.direction,
        stop_above_m=required_m + half_m + 2 * _MARGIN_M,
        stop_below_m=enough_m,
    )
    lower_m, upper_m = found.signed_m
    keeps_m = lower_m - required_m - _MARGIN_M
    if keeps_m > 0:
        return np.array([[shift_m - keeps_m, shift_m + keeps_m]]), NOTHING
    if upper_m < required_m - _MARGIN_M:
        return NOTHING, _violated_on_line(hull, one, move, shift_m, found.on_hull_world)
    if required_m == 0 and upper_m <= meter.tolerance_m:  # does the surface's point touch?
        return NOTHING, _violated_on_line(hull, one, move, shift_m, found.on_object_world)
    return NOTHING, NOTHING


def _violated_on_line(
    hull: Hull, one: MovedObject, move: Move, shift_m: float, point_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return shifts (N, 2) that violate as the line through a point along the move shows it.

    The point lies in the hull and nearer than the clearance to the object, moved by `shift_m`; or,
    if no clearance is required, on its surface, in the hull or not.
    """
    reach_m, direction = move.stop_m - move.start_m, move.direction
    spans_m = spans_in_hull(hull, point_world - reach_m * direction, direction, 2 * reach_m)
    in_hull_m = spans_m - reach_m  # (N, 2)
    n_steps = int(np.log(max(reach_m / move.tolerance_m, 1.0)) / np.log(_STRIDE)) + 2
    steps_m = move.tolerance_m / 4.0 * _STRIDE ** np.arange(n_steps)
    along_m = np.concatenate([-steps_m[::-1], [0.0], steps_m])
    unmoved_world = point_world - shift_m * direction
    distance_m = one.meter.signed_distance(unmoved_world + along_m[:, None] * direction)
    spare_m = one.clearance_m - distance_m - one.meter.error_m
    near = spare_m > 0
    near_m = union(np.column_stack([along_m[near] - spare_m[near], along_m[near] + spare_m[near]]))
    if len(near_m) == 0:  # the point of the surface, and no clearance required
        near_m = np.zeros((1, 2))
    begins_m = in_hull_m[:, None, 0] - near_m[:, 1] + _MARGIN_M  # (N, K)
    ends_m = in_hull_m[:, None, 1] - near_m[:, 0] - _MARGIN_M
    is_stretch = begins_m < ends_m
    return shift_m + union(np.column_stack([begins_m[is_stretch], ends_m[is_stretch]]))


def _within(stretches: NDArray[np.float64], move: Move) -> NDArray[np.float64]:
    clipped = np.clip(stretches, move.start_m, move.stop_m)
    return np.asarray(clipped[clipped[:, 0] < clipped[:, 1]])
