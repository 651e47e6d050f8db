"""How far one camera's pictures are shifted, and how late they are, against those of the others.

Both change how far the limits of outlines miss their like (`hybridve.hull.agreement.tangents`)
linearly, to first order: by the slope of a limit times the shift, and by how far the limit moves
from frame to frame times the delay. All limits of a camera in all frames are one overdetermined
system of three unknowns, solved by least squares with weights that fade beyond some pixels (Geman
and McClure, 1985), so that what is segmented in one camera alone does not count.

Limits do not err independently: who holds still shows the same outline again and again, and a
shadow errs at one end of it all the time. So errors are taken to be common to blocks of frames,
and common to all that one end of one pencil ever shows (the sandwich of Liang and Zeger, 1986, for
both groupings, added up, with Student's quantiles for their numbers): then they say how far the
estimate would be off in another recording.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.agreement.trials import MOST_PX, Change, Trial

#: Weights fade beyond this, in pixels: a few times what outlines err by.
_SCALE_PX = 2.0

#: Delays that are tried at first, in frames.
LATEST = 12

#: Blocks whose errors are taken to be independent, at most, and their least length in frames.
_BLOCKS, LEAST_BLOCK = 24, 4

#: Of two cameras' few ends of pencils: by this the variance is multiplied.
_FEW_ENDS = 4.0

#: Student's quantiles, two-sided 95 %, from one degree of freedom on.
_STUDENT = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179)

#: Between two frames outlines are taken to go straight: what turns within some frames, as hands do,
#: is then late by so many frames more or less, one standard error.
_BETWEEN_FRAMES = 0.02

#: So many limits must tell.
LEAST_COUNT = 12

_ROUNDS = 8

#: Where the standard error of a delay is above this, in frames, or outlines move by less than this
#: from frame to frame, in pixels, nobody moved enough to tell.
_NO_CLOCK, _LEAST_SPEED_PX = 0.5, 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Offset:
    """By how much one camera's pictures are off.

    Attributes
    ----------
    moved_px : (2,) float64
        How far its pictures have moved, along x and y.
    late : float
        How many frames too late its pictures show what happens; negative: too early.
    moved_se_px, late_se : (2,) float64, float
        Their standard errors; infinite where nothing tells.
    speed_px : float
        How far limits move from frame to frame, root mean square.
    count : int
        So many limits told.
    """

    moved_px: NDArray[np.float64]
    late: float
    moved_se_px: NDArray[np.float64]
    late_se: float
    speed_px: float = 0.0
    count: int = 0

    @property
    def size_px(self) -> float:
        """How far the pictures have moved."""
        return float(np.linalg.norm(self.moved_px))

    @property
    def has_clock(self) -> bool:
        """Whether there was enough motion to tell the delay, and it is not where they end."""
        is_moving = self.speed_px >= _LEAST_SPEED_PX
        return self.late_se <= _NO_CLOCK and is_moving and abs(self.late) < LATEST - 0.5


def offset_of(trial: Trial, camera: int, *, far: bool = True) -> Offset:
    """Return by how much a camera's pictures are off.

    Parameters
    ----------
    trial : Trial
        The outlines.
    camera : int
        Whose pictures.
    far : bool
        Whether delays of up to `LATEST` frames are tried; else the pictures are taken to be nearly
        in time.
    """
    near = _offset_from(trial, camera, 0.0)
    start = _likeliest_delay(trial, camera) if far else 0.0
    if start == 0.0:
        return near
    # A picture that has moved far fits no better at its own time than at others, as it is.
    found = _offset_from(trial, camera, start)
    fits = [
        trial.change(camera, -one.moved_px, one.late).misfit().px if one.count else np.inf
        for one in (near, found)
    ]
    return found if fits[1] < fits[0] else near


def _offset_from(trial: Trial, camera: int, late: float) -> Offset:
    """Return the offset that is found from a delay on."""
    untold = Offset(np.zeros(2), 0.0, np.full(2, np.inf), np.inf)
    shift, errors, speed_px, count = np.zeros(2), np.full(3, np.inf), 0.0, 0
    for number in range(_ROUNDS):
        now = trial.change(camera, shift, late)
        found = now.misses()
        by_late = now.later(0.5).misses().miss_px - now.later(-0.5).misses().miss_px
        design = np.concatenate([now.slopes(found), by_late[..., None]], axis=-1)
        # Where a limit changes its partner, it does not move.
        is_used = np.isfinite(found.miss_px) & np.isfinite(by_late) & (np.abs(by_late) < MOST_PX)
        miss, design = found.miss_px[is_used], design[is_used]
        count = len(miss)
        if count < LEAST_COUNT:
            return untold
        if number < 3:  # from afar: the median's weights
            weights = 1.0 / np.maximum(np.abs(miss), 0.5)
        else:
            weights = 1.0 / (1.0 + (miss / _SCALE_PX) ** 2) ** 2
        # A delay that nothing tells stays where it is, and so does a shift.
        normal = (design * weights[:, None]).T @ design + 1e-6 * count * np.eye(3)
        step = -np.linalg.solve(normal, design.T @ (weights * miss))
        shift = shift + np.clip(step[:2], -2 * MOST_PX, 2 * MOST_PX)
        late += float(np.clip(step[2], -1.0, 1.0))
        speed_px = float(np.sqrt((weights * design[:, 2] ** 2).sum() / weights.sum()))
        rows, frames, kinds, _ = np.nonzero(is_used)
        errors = _errors(
            np.linalg.inv(normal),
            design * (weights * miss)[:, None],
            frames,
            2 * (rows % len(now.rows)) + kinds,
        )
        if number >= 4 and np.abs(step[:2]).max() < 1e-2 and abs(step[2]) < 1e-3:
            break
    late_se = float(np.hypot(errors[2], _BETWEEN_FRAMES))
    return Offset(-shift, late, errors[:2], late_se, speed_px, count)


def _errors(
    inverse: NDArray[np.float64],
    scores: NDArray[np.float64],
    frames: NDArray[np.int64],
    ends: NDArray[np.int64] | None,
) -> NDArray[np.float64]:
    """Return the standard errors (P,) of an estimate.

    Parameters
    ----------
    inverse : (P, P) float64
        Of the normal equations of P unknowns.
    scores : (N, P) float64
        What each limit adds to their right side.
    frames, ends : (N,) int64
        Of which frame it is, and of which end of which pencil; without ends, no error is taken to
        be common to them.
    """
    n_frames = int(frames.max()) + 1 - int(frames.min())
    length = max(min(LEAST_BLOCK, n_frames // 4), 1, -(-n_frames // _BLOCKS))
    n_unknown = len(inverse)
    meat = np.zeros((n_unknown, n_unknown))
    n_blocks = _add_scores(meat, scores, (frames - frames.min()) // length)
    if n_blocks <= n_unknown:
        return np.full(n_unknown, np.inf)
    covariance = inverse @ meat @ inverse * _few(n_blocks, n_unknown)
    if ends is not None:
        common = np.zeros_like(meat)
        n_ends = _add_scores(common, scores, np.unique(ends, return_inverse=True)[1])
        if n_ends > n_unknown:
            covariance += inverse @ common @ inverse * _few(n_ends, n_unknown)
        else:  # so few ends fit whatever errs at them: reckon with as much again, and more
            covariance *= _FEW_ENDS
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def _few(n_groups: int, n_unknown: int) -> float:
    """Return what a variance found from few groups is to be multiplied by.

    They have lost the unknowns' degrees of freedom; and so few as are left make Student's
    distribution of what would be normal, of which the 95 % are taken.
    """
    left = n_groups - n_unknown
    return n_groups / left * (student_95(left) / 1.96) ** 2


def student_95(freedom: int) -> float:
    """Return by how many standard errors Student's t is off in no more than 5 % of the cases.

    To half a percent, of so many degrees of freedom; SciPy's statistics take half a second to load.

    Examples
    --------
    >>> student_95(3)
    3.182
    """
    known = len(_STUDENT)
    return _STUDENT[freedom - 1] if freedom <= known else 1.96 + 2.5 / freedom


def _add_scores(
    meat: NDArray[np.float64], scores: NDArray[np.float64], groups: NDArray[np.int64]
) -> int:
    """Add the squares of the sums (P,) of scores of each group to (P, P); return how many."""
    sums = np.zeros((int(groups.max()) + 1, len(meat)))
    np.add.at(sums, groups, scores)
    meat += sums.T @ sums
    return len(sums)


def _likeliest_delay(trial: Trial, camera: int) -> float:
    """Return the whole number of frames by which a camera's outlines fit the others best."""
    now = trial.change(camera)
    best, least = 0, now.misfit()
    enough = 0.5 * least.count
    most = min(LATEST, trial.table.n_frames // 3)
    for late in range(-most, most + 1):
        found = now.later(float(late)).misfit()
        if found.count >= enough and found.px < least.px - 0.02:
            best, least = late, found
    return float(best)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """How far one camera's pictures have moved from some frame on.

    Attributes
    ----------
    first : int
        The first row of the table that has moved.
    moved_px : (2,) float64
        How far, along x and y.
    se_px : float
        Standard error of either, if what errs at one end of a pencil all the time does so before
        and after: whether it has moved.
    size_se_px : float
        Standard error of either, however it errs: how far.
    wander_px : float
        By how much two halves of the time that it holds, or held before, differ.
    """

    first: int
    moved_px: NDArray[np.float64]
    se_px: float
    size_se_px: float
    wander_px: float


def step_of(trial: Trial, camera: int, least_side: int) -> Step | None:
    """Return when, and how far, a camera's pictures have moved most within the session.

    Shifts of the frames before and after are found for some places, and the best of them made
    exact. None where less than `least_side` frames, or too little in them, tells on either side.
    """
    n_frames = trial.table.n_frames
    if n_frames < 2 * least_side:
        return None
    limits = _seen(trial.change(camera))
    frames = limits.frames
    places = np.unique(np.linspace(least_side, n_frames - least_side, _PLACES).astype(int))
    tried = []
    for place in places.tolist():
        before, after = limits.of(frames < place), limits.of(frames >= place)
        if min(len(before.miss), len(after.miss)) < LEAST_COUNT:
            continue
        shifts = before.shift(), after.shift()
        loss = np.zeros((2, n_frames))
        for side, shift in enumerate(shifts):
            np.add.at(loss[side], frames, limits.loss(shift))
        # Before a place the first shift holds, from it on the second.
        by_place = np.append(0.0, loss[0].cumsum()) + np.append(loss[1][::-1].cumsum()[::-1], 0.0)
        inside = slice(least_side, n_frames - least_side + 1)
        best = least_side + int(by_place[inside].argmin())
        tried.append((float(by_place[best]), best))
    if not tried:
        return None
    _, place = min(tried)
    before, after = limits.of(frames < place), limits.of(frames >= place)
    if min(len(before.miss), len(after.miss)) < LEAST_COUNT:
        return None
    was, became = before.shift(), after.shift()
    # What errs at one end all the time, errs before and after.
    sure, whole = (
        np.hypot(before.error(was, by_end=by_end), after.error(became, by_end=by_end)).max()
        for by_end in (False, True)
    )
    wander = max(before.wander(), after.wander())
    return Step(place, was - became, float(sure), float(whole), wander)


def wander_of(change: Change) -> float:
    """Return by how much a camera's shifts in the first and the second half differ, pixels."""
    limits = _seen(change)
    return limits.wander() if len(limits.miss) else 0.0


def _seen(change: Change) -> "_Seen":
    found = change.misses()
    is_used = np.isfinite(found.miss_px)
    rows, frames, kinds, _ = np.nonzero(is_used)
    return _Seen(
        found.miss_px[is_used],
        change.slopes(found)[is_used],
        frames,
        2 * (rows % len(change.rows)) + kinds,
    )


#: No end gains or loses more than it was expected to and so many pixels.
_FLIPPED_PX = 2.0

#: Places in a session at which a step is looked for, before it is made exact.
_PLACES = 12


class _Seen(NamedTuple):
    """N limits: what they miss (N,), slopes (N, 2), of which frame and which end (N,)."""

    miss: NDArray[np.float64]
    slope: NDArray[np.float64]
    frames: NDArray[np.int64]
    ends: NDArray[np.int64]

    def of(self, is_chosen: NDArray[np.bool_]) -> "_Seen":
        chosen = (array[is_chosen] for array in (self.frames, self.ends))
        return _Seen(self.miss[is_chosen], self.slope[is_chosen], *chosen)

    def _weights(self, shift: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(1.0 / (1.0 + ((self.miss + self.slope @ shift) / _SCALE_PX) ** 2) ** 2)

    def shift(self) -> NDArray[np.float64]:
        """Return the shift (2,) to be added, pixels, that makes misses least."""
        shift = np.zeros(2)
        for number in range(_ROUNDS):
            left = self.miss + self.slope @ shift
            weights = 1.0 / np.maximum(np.abs(left), 0.5) if number < 3 else self._weights(shift)
            normal = (self.slope * weights[:, None]).T @ self.slope + 1e-6 * len(left) * np.eye(2)
            shift = shift - np.linalg.solve(normal, self.slope.T @ (weights * left))
        return shift

    def loss(self, shift: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what is lost by each limit (N,), Geman and McClure's."""
        square = ((self.miss + self.slope @ shift) / _SCALE_PX) ** 2
        return np.asarray(square / (1.0 + square))

    def wander(self) -> float:
        """Return by how much the shifts of the first and of the second half differ, pixels."""
        middle = (int(self.frames.min()) + int(self.frames.max()) + 1) / 2.0
        halves = self.of(self.frames < middle), self.of(self.frames >= middle)
        if min(len(half.miss) for half in halves) < LEAST_COUNT:
            return 0.0
        return float(np.linalg.norm(halves[0].shift() - halves[1].shift()))

    def error(self, shift: NDArray[np.float64], *, by_end: bool) -> NDArray[np.float64]:
        """Return the standard errors (2,) of that shift; `by_end` of what errs there all along."""
        weights = self._weights(shift)
        normal = (self.slope * weights[:, None]).T @ self.slope
        normal += 1e-6 * len(weights) * np.eye(2)
        scores = self.slope * (weights * (self.miss + self.slope @ shift))[:, None]
        inverse = np.asarray(np.linalg.inv(normal), np.float64)
        return _errors(inverse, scores, self.frames, self.ends if by_end else None)


def ends_gain(now: Change, then: Change, since: int = 0) -> tuple[NDArray[np.float64], ...]:
    """Return what a change does to the ends of the pencils of a camera, from a row on.

    Returns
    -------
    gains, expected, partner : (E,) float64, float64, int64
        By how much each end that tells misses its like less, and by how much it would, were the
        change the truth: medians over frames, in pixels. What it moves and what is left add up in
        squares. And which other camera's it is, numbered from 0.
    """
    before, after = (one.misses().miss_px[:, since:] for one in (now, then))
    if before.size == 0:  # a camera at the place of all others has no pencils
        return np.zeros(0), np.zeros(0), np.zeros(0, np.int64)
    is_both = np.isfinite(before) & np.isfinite(after)
    before, after = (np.where(is_both, one, np.nan) for one in (before, after))
    values = [
        np.moveaxis(one, 2, 1).reshape(2 * len(before), -1)
        for one in (
            np.minimum(np.abs(before), MOST_PX),
            np.minimum(np.abs(after), MOST_PX),
            np.minimum(np.abs(before - after), MOST_PX),
        )
    ]
    is_told = np.isfinite(values[0]).sum(axis=1) >= LEAST_BLOCK
    was, became, moves = (np.nanmedian(one[is_told], axis=1) for one in values)
    expected = np.hypot(became, moves) - became
    # An end that takes another partner says little, however far that is.
    gains = np.clip(was - became, -expected - _FLIPPED_PX, expected + _FLIPPED_PX)
    partner = np.repeat(np.arange(len(before)) % len(now.rows), 2)[is_told]
    return gains, expected, partner
