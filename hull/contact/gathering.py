"""Patches gathered over time and place, and things found again in another run.

A *patch* (`hybridve.hull.contact.patches`) is one connected piece of the hull at one part in one
frame. What an engineer talks about is longer: the hand that leans on a part for two seconds, leaves
it, and comes back to the same place. Two patches are of one such thing

* if, from a frame to the next, each is the other's nearest and they are not farther apart than a
  hand moves in the time between (`SPEED_M_S`): a hand that slides along a part stays one thing;
* or if they are nearer to each other than `LINK_M`, whenever that was: what comes back to a place
  is the same thing;

and so are those that a chain of such pairs joins (single linkage). Patches are told apart where
they lie three centimetres from each other, and so are things.

Places are boxes in the frame of the part: where the part stands, and whether it moves, plays no
role. Of two runs, things are the same if their boxes are not farther apart than `MATCH_M`, one to
one, so that the corners of all boxes are as near to each other as they can be.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import Pose

#: Patches nearer to each other than this are of one thing, metres.
LINK_M = 0.01

#: A hand moves so fast along a part, metres per second, and at most so far from frame to frame.
SPEED_M_S, MOST_MOVED_M = 0.5, 0.1

#: Things of two runs that are farther apart than this are not the same, metres.
MATCH_M = 0.02

#: Where another thing would have matched nearly as well, it is a tie, metres.
TIE_M = 0.01

#: A thing's place holds all of its patches but a tenth at each end, along each axis.
_SHARE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """Boxes along the axes of a part's frame.

    Attributes
    ----------
    lower, upper : (N, 3) float64
        Metres.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.lower)

    def __getitem__(self, rows: NDArray[np.intp] | NDArray[np.bool_] | slice) -> "Boxes":
        """Return some of them."""
        return Boxes(self.lower[rows], self.upper[rows])

    @property
    def center(self) -> NDArray[np.float64]:
        """Their middles (N, 3)."""
        return 0.5 * (self.lower + self.upper)

    def gaps_m(self, others: "Boxes") -> NDArray[np.float64]:
        """Return how far each is from each of others (N, M); 0 where they meet."""
        apart = np.maximum(
            others.lower[None] - self.upper[:, None], self.lower[:, None] - others.upper[None]
        )
        return np.asarray(np.linalg.norm(np.maximum(apart, 0.0), axis=2))

    def around(self) -> "Boxes":
        """Return the one box that holds all."""
        return Boxes(self.lower.min(axis=0)[None], self.upper.max(axis=0)[None])

    def mostly(self) -> "Boxes":
        """Return the one box that holds all but what is rare: a tenth at each end of each axis."""
        return Boxes(
            np.quantile(self.lower, _SHARE, axis=0)[None],
            np.quantile(self.upper, 1.0 - _SHARE, axis=0)[None],
        )


def boxes_on_part(boxes_world: Boxes, world_from_part: Pose, part: Boxes | None = None) -> Boxes:
    """Return boxes in a part's own frame, those beside it drawn onto it.

    Of what fills a box only the size along the world's axes is known. It is taken for an ellipsoid,
    which is as large however it is turned; a box about a turned box would be larger.

    Parameters
    ----------
    boxes_world : Boxes
        N of them.
    world_from_part : (N or 1, 3, 4) float64
        Where the part stood.
    part : Boxes, optional
        The box of the part: what is near it counts as where it is nearest.
    """
    part_from_world = world_from_part[:, :, :3].transpose(0, 2, 1)
    away = boxes_world.center - world_from_part[:, :, 3]
    half = 0.5 * (boxes_world.upper - boxes_world.lower)
    center = (part_from_world @ away[:, :, None])[:, :, 0]
    half = np.sqrt(part_from_world**2 @ half[:, :, None] ** 2)[:, :, 0]
    lower, upper = center - half, center + half
    if part is not None:
        lower, upper = (np.clip(one, part.lower, part.upper) for one in (lower, upper))
    return Boxes(lower, upper)


def gathered(
    boxes: Boxes, step: NDArray[np.int64], time_s: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return which thing each patch is of (N,), numbered from 0 as they begin.

    Parameters
    ----------
    boxes : Boxes
        Where each of N patches is, in the frame of the part.
    step : (N,) int64
        Which of the frames that are known it is of, ascending: of one to the next, nothing was seen
        between.
    time_s : (N,) float64
        When that was.
    """
    joined = _Joined(len(boxes))
    begins = np.flatnonzero(np.diff(step, prepend=-2))
    ends = np.append(begins[1:], len(step))
    for now in range(1, len(begins)):
        before = now - 1
        if step[begins[now]] != step[begins[before]] + 1:
            continue
        one, other = np.arange(begins[before], ends[before]), np.arange(begins[now], ends[now])
        reach_m = LINK_M + SPEED_M_S * float(time_s[other[0]] - time_s[one[0]])
        for i, j in _each_others_nearest(boxes[one], boxes[other], min(reach_m, MOST_MOVED_M)):
            joined.join(int(one[i]), int(other[j]))
    _join_places(boxes, joined)
    _, first, label = np.unique(joined.roots(), return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[label], np.int64)


def _each_others_nearest(one: Boxes, other: Boxes, reach_m: float) -> list[tuple[int, int]]:
    """Return the pairs of which each is the nearest of the other, and not beyond reach."""
    away = np.linalg.norm(one.center[:, None] - other.center[None], axis=2)
    away = np.where(one.gaps_m(other) <= reach_m, away, np.inf)
    to, back = away.argmin(axis=1), away.argmin(axis=0)
    return [(i, int(j)) for i, j in enumerate(to) if back[j] == i and np.isfinite(away[i, j])]


def _join_places(boxes: Boxes, joined: "_Joined") -> None:
    """Join what is nearer to each other than `LINK_M`, whenever it was."""
    roots = joined.roots()
    tracks = [np.flatnonzero(roots == root) for root in dict.fromkeys(roots.tolist())]
    around = [boxes[track].around() for track in tracks]
    whole = Boxes(
        np.concatenate([one.lower for one in around] or [np.zeros((0, 3))]),
        np.concatenate([one.upper for one in around] or [np.zeros((0, 3))]),
    )
    thing = np.arange(len(tracks))
    for i, track in enumerate(tracks):
        near = whole[slice(i, i + 1)].gaps_m(whole[slice(i + 1, None)])[0] <= LINK_M
        for j in (i + 1 + np.flatnonzero(near & (thing[i + 1 :] != thing[i]))).tolist():
            if thing[j] != thing[i] and _meet(boxes[track], boxes[tracks[j]]):
                joined.join(int(track[0]), int(tracks[j][0]))
                thing[thing == thing[j]] = thing[i]


#: Boxes that are compared with others at once.
_AT_ONCE = 256


def _meet(one: Boxes, other: Boxes) -> bool:
    """Tell whether any box is nearer to any other than `LINK_M`."""
    return any(
        bool((one[slice(start, start + _AT_ONCE)].gaps_m(other) <= LINK_M).any())
        for start in range(0, len(one), _AT_ONCE)
    )


class _Joined:
    """Sets of numbers, joined one pair after another."""

    def __init__(self, count: int) -> None:
        self._parent = list(range(count))

    def root(self, number: int) -> int:
        """Return the least number of a number's set."""
        while self._parent[number] != number:
            self._parent[number] = self._parent[self._parent[number]]
            number = self._parent[number]
        return number

    def join(self, one: int, other: int) -> None:
        """Make one set of two."""
        one, other = self.root(one), self.root(other)
        self._parent[max(one, other)] = min(one, other)

    def roots(self) -> NDArray[np.int64]:
        """Return the least number of each one's set."""
        return np.array([self.root(number) for number in range(len(self._parent))], np.int64)


@dataclass(frozen=True, slots=True)
class Matches:
    """Things of two runs that are the same.

    Attributes
    ----------
    pairs : dict of int to int
        Of a thing of the second run, which of the first it is; those without are new.
    ties : dict of int to tuple of int
        Of a thing of the second run, which others of the first it could have been, nearly as well.
    """

    pairs: dict[int, int]
    ties: dict[int, tuple[int, ...]]


def matched(first: Boxes, second: Boxes, within_m: float = MATCH_M) -> Matches:
    """Return which things of a second run are which of a first, by their places on one part.

    Examples
    --------
    >>> first = Boxes(np.array([[0.0, 0, 0], [0.05, 0, 0]]), np.array([[0.02, 0, 0], [0.06, 0, 0]]))
    >>> moved = Boxes(first.lower[::-1] + 0.001, first.upper[::-1] + 0.001)
    >>> matched(first, moved).pairs
    {0: 1, 1: 0}
    """
    # Late: who reads a report without comparing it need not wait for it.
    from scipy.optimize import linear_sum_assignment

    if not len(first) or not len(second):
        return Matches({}, {})
    corners = np.linalg.norm(second.lower[:, None] - first.lower[None], axis=2)
    corners = 0.5 * (corners + np.linalg.norm(second.upper[:, None] - first.upper[None], axis=2))
    may_be = second.gaps_m(first) <= within_m
    # As many as can be are matched; of all ways to do so the nearest is taken.
    beyond = 1.0 + len(second) * float(corners.max(initial=0.0))
    rows, columns = linear_sum_assignment(np.where(may_be, corners, beyond))
    pairs = {int(i): int(j) for i, j in zip(rows, columns, strict=True) if may_be[i, j]}
    ties = {}
    for i in range(len(second)):
        best_m = corners[i, pairs[i]] if i in pairs else np.inf
        others = np.flatnonzero(may_be[i] & (corners[i] <= best_m + TIE_M))
        others = others[others != pairs.get(i, -1)]
        if len(others):
            ties[i] = tuple(others.tolist())
    return Matches(pairs, ties)
