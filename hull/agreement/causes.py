"""Why the silhouettes of a session contradict each other: causes, tried against each other.

What can be wrong with a camera shows in all cameras that it is compared with, so that the largest
contradiction does not name the guilty one. Each cause is a change that would undo it, and is tried:
the one after which outlines fit best is named, undone, and the rest looked at again. What is tried,
and what is asked before it is named:

* two cameras **exchanged**; a picture **mirrored**, **upside down** or **turned** by 180 degrees,
  or **scaled** from another camera's size; a mask **inverted**: outlines must fit by
  `_GROSS_GAIN_PX` better, and by a third;
* a picture **late** by up to `hybridve.hull.agreement.offsets.LATEST` frames, a picture **bumped**
  since the start or since some frame: the estimate must be beyond `_SIGNIFICANT` standard errors of
  what is tolerated (`_LEAST_LATE`, `_LEAST_BUMP_PX`);
* **frames** in which a camera's outlines fit none of the others, though they do in others;
* something **left behind** since the empty scene was taken: what one camera sees all the time, in
  one place, and no other does.

A camera whose outlines fit none of the others for most of the session, whatever is tried, is called
**contradictory**: something is wrong with it that is not in this list.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.agreement.carving import Unconfirmed, unconfirmed_shares
from hybridve.hull.agreement.offsets import (
    LEAST_COUNT,
    Offset,
    Step,
    ends_gain,
    offset_of,
    step_of,
    wander_of,
)
from hybridve.hull.agreement.trials import MOST_PX, Change, Misfit, Trial, misfit_by_frame
from hybridve.hull.query.silhouettes import Views

Kind = Literal[
    "exchanged",
    "mirrored",
    "upside down",
    "turned",
    "scaled",
    "inverted",
    "late",
    "bumped",
    "frames",
    "left behind",
    "contradictory",
]

#: How the pictures that are tried are turned, along x and y.
_PICTURES: dict[Kind, tuple[float, float]] = {
    "mirrored": (-1.0, 1.0),
    "upside down": (1.0, -1.0),
    "turned": (-1.0, -1.0),
}

#: A gross cause must make outlines fit by so many pixels better, and leave so much at most.
_GROSS_GAIN_PX, _GROSS_SHARE = 2.0, 0.67

#: Sizes of pictures whose logarithms differ by less come of undistorting like pictures.
_OTHER_SIZE = 0.2

#: Pictures are changed in so many frames at most, evenly chosen, to find which change is best.
_FRAMES_TRIED = 200

#: Cameras that fit better than this, in pixels, are not tried for gross causes, unless more of the
#: silhouettes than this share is not confirmed; a cause must confirm so much of them, and this
#: share of what was not.
_SUSPECT_PX, _UNCONFIRMED, _CONFIRMED_GAIN, _CONFIRMED_SHARE = 3.0, 0.08, 0.06, 0.4

#: What is tolerated: outlines and rigs are off by a pixel or two, clocks of cameras by a tenth.
_LEAST_BUMP_PX, _LEAST_LATE = 1.5, 0.15

#: A picture that is off by more than this, in pixels, was not bumped: outlines meet by chance.
_FARTHEST_BUMP_PX = 60.0

_SIGNIFICANT = 2.0

#: A delay of so many standard errors is named even where most ends stand still, if others move by
#: so many pixels a frame.
_PLAIN, _PLAIN_SPEED_PX = 8.0, 1.0

#: From so many pixels, or frames, on a session is not to be trusted until it is mended.
GROSS_BUMP_PX, GROSS_LATE = 4.5, 1.5

#: Without a delay or a bump, ends of pencils fit by at least this share of what it moves them
#: better. So many ends must tell, and no more than this share of them fit worse, by so many pixels.
_EXPECTED_SHARE, _LEAST_ENDS, _MOST_WORSE, _NO_WORSE_PX = 0.55, 4, 0.2, 1.0

#: Another camera says something of a change if it is expected to gain this share of all.
_PARTNER_SHARE = 0.1

#: A picture that was moved stays there: halves of the time differ by no more than this share of it.
_WANDER = 0.35

#: Of so many causes of a sort at most a session is freed, one after the other.
_MOST_CAUSES = 4

#: A cause that explains this share of what the best one does is as good.
_AS_GOOD = 0.85

#: A bump within the session: frames that must lie to either side, at least; a tenth of the session
#: where that is more, up to so many: some frames in a row may be badly segmented.
_LEAST_SIDE, _MOST_SIDE = 5, 20

#: In a frame that is told alone, the outlines of one camera fit by so many pixels worse than usual
#: in this share of its pencils, and those of the others by no more than this.
_FRAME_PX, _FRAME_SHARE, _OTHERS_PX = 4.0, 0.8, 1.5

#: And by so many pixels worse in the middle one of them.
_FRAME_MEDIAN_PX = 6.0

#: Something was left behind that one camera sees in this share of the frames, about a place that
#: moves by no more than so many pixels: of a large thing now this square is denied, now that.
_ALL_THE_TIME, _SAME_PLACE_PX = 0.9, 60.0

#: A camera contradicts the session whose outlines fit the others no better than this, in pixels
#: (15 is the most), if they support no more than this share of its silhouette; or that denies what
#: they see in more than this share of the frames.
_CONTRADICTORY_PX, _SUPPORTED, _MOST_FRAMES = 9.0, 0.7, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Cause:
    """One thing that is wrong, with its size.

    Attributes
    ----------
    kind : Kind
        What.
    cameras : tuple of str
        Whose: one, or the two that are exchanged.
    first, last : int
        Rows of the table: from when to when.
    size : float
        Of "late" frames, of "bumped" pixels, of "frames" pixels by which they fit worse; else NaN.
    low, high : float
        95 % interval of a delay, or of a shift's length; else NaN.
    moved_px : (2,) float64
        Of "bumped": how far the picture has moved, along x and y.
    before_px, after_px : float
        How badly the cameras' outlines fit the others, as they are and with the cause undone.
    instead : tuple of str
        Cameras of which the same could be said as well.
    box_px : (4,) float64
        Of "left behind": left, top, right and bottom in the undistorted picture.
    """

    kind: Kind
    cameras: tuple[str, ...]
    first: int
    last: int
    size: float = np.nan
    low: float = np.nan
    high: float = np.nan
    moved_px: NDArray[np.float64] = field(default_factory=lambda: np.full(2, np.nan))
    before_px: float = np.nan
    after_px: float = np.nan
    instead: tuple[str, ...] = ()
    box_px: NDArray[np.float64] = field(default_factory=lambda: np.full(4, np.nan))

    @property
    def is_gross(self) -> bool:
        """Whether nothing that the session says is to be trusted while it lasts."""
        if self.kind == "late":
            return abs(self.size) >= GROSS_LATE
        if self.kind == "bumped":
            return self.size >= GROSS_BUMP_PX
        return self.kind not in {"frames", "left behind"}


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """What is wrong with a session, and what is left when that is undone.

    Attributes
    ----------
    causes : tuple of Cause
        The likeliest first.
    offsets : tuple of C Offset
        Of each camera, as it is: with what was named of it.
    is_plain : (C,) bool
        Whether outlines fit better without a camera's offset, as they should.
    misfit_px : (C,) float64
        How badly each camera's outlines fit the others as they are.
    is_told : bool
        Whether there were outlines enough to say anything.
    """

    causes: tuple[Cause, ...]
    offsets: tuple[Offset, ...]
    is_plain: NDArray[np.bool_]
    misfit_px: NDArray[np.float64]
    is_told: bool


@dataclass(frozen=True, slots=True, eq=False)
class FrameVerdicts:
    """What F frames say by themselves of C cameras; see `hybridve.hull.agreement.frame`.

    Attributes
    ----------
    denies : (F, C) bool
        Whether each camera denies what several others see.
    supported_share : (F, C) float64
        How much of its silhouette the others support; NaN where nobody can tell.
    alone_px : (F, C, 4) float64
        Left, top, right and bottom of what each camera sees alone; NaN without.
    is_contradictory : (F,) bool
        Whether no point is in all silhouettes.
    """

    denies: NDArray[np.bool_]
    supported_share: NDArray[np.float64]
    alone_px: NDArray[np.float64]
    is_contradictory: NDArray[np.bool_]


def diagnose(
    trial: Trial, said: FrameVerdicts | None = None, *, with_clock: bool = True
) -> Diagnosis:
    """Return what is wrong with the cameras of a session, as their silhouettes tell.

    Parameters
    ----------
    trial : Trial
        The outlines of F frames of C cameras.
    said : FrameVerdicts, optional
        What the frames say by themselves.
    with_clock : bool
        Whether delays are looked for: the frames are not far apart.
    """
    names = trial.views.names
    misfits = np.array([trial.misfit([camera]).px for camera in range(len(names))])
    causes, trial = _inverted(trial)
    is_told = bool(causes) or trial.misfit().count >= LEAST_COUNT
    for _ in range(_MOST_CAUSES):
        cause, trial = _gross(trial, with_clock=with_clock)
        if cause is None:
            break
        causes.append(cause)
    # Pictures that were put right as pictures are, about their middles, are a few pixels off.
    put_right = {name for cause in causes for name in cause.cameras}
    # What is left of each camera, what was undone of it added.
    undone = {name: np.zeros(3) for name in names}
    offsets = [offset_of(trial, camera, far=with_clock) for camera in range(len(names))]
    for _ in range(_MOST_CAUSES):
        found, trial = _fine(trial, offsets, put_right, with_clock=with_clock)
        if not found:
            break
        causes += found
        for cause in found:
            if cause.kind == "late":
                undone[cause.cameras[0]][2] += cause.size
            elif cause.first == 0:
                undone[cause.cameras[0]][:2] += cause.moved_px
        offsets = [offset_of(trial, camera, far=False) for camera in range(len(names))]
    causes += _contradictory(trial, said, causes)
    causes += _left_behind(trial, said, causes)
    causes += _frames(trial, None if said is None else said.denies, causes)
    is_plain = np.array(
        [
            undone[name].any() or _is_plain(trial, camera, offsets[camera], with_clock=with_clock)
            for camera, name in enumerate(names)
        ]
    )
    offsets = [
        replace(
            offset, moved_px=offset.moved_px + undone[name][:2], late=offset.late + undone[name][2]
        )
        for name, offset in zip(names, offsets, strict=True)
    ]
    return Diagnosis(tuple(causes), tuple(offsets), is_plain, misfits, is_told)


def _is_plain(trial: Trial, camera: int, offset: Offset, *, with_clock: bool) -> bool:
    """Tell whether a camera's outlines fit as much better as they should, were its offset undone.

    Where little tells an offset, as sideways of cameras of one height, anything may come out.
    """
    late = offset.late if with_clock and offset.has_clock else 0.0
    return _is_fine_gain(trial.change(camera), trial.change(camera, -offset.moved_px, late))


def _inverted(trial: Trial) -> tuple[list[Cause], Trial]:
    """Return the cameras whose masks show what is not there."""
    names = trial.views.names
    most = np.flatnonzero(trial.table.is_inverse.mean(axis=0) > _MOST_FRAMES).tolist()
    if not most:
        return [], trial
    undone = trial.inverted(most)
    fits = {camera: undone.misfit([camera]) for camera in most}
    last = trial.table.n_frames - 1
    return [
        Cause("inverted", (names[camera],), 0, last, before_px=MOST_PX, after_px=fit.px)
        for camera, fit in fits.items()
        if fit.count >= LEAST_COUNT and fit.px <= _GROSS_SHARE * MOST_PX
    ], undone


def _gross(trial: Trial, *, with_clock: bool) -> tuple[Cause | None, Trial]:
    """Return the gross cause without which outlines fit best, and the session without it."""
    few = trial.some(_FRAMES_TRIED)
    every = range(len(trial.views))
    suspects = [camera for camera in every if few.misfit([camera]).px >= _SUSPECT_PX]
    shares = unconfirmed_shares(few)
    if shares.all_ >= _UNCONFIRMED:
        suspects = list(every)
    least_px, best = np.inf, None
    changes = list(_changes(trial.views, suspects))
    fair = []
    for change in changes:
        undone = change.make(few)
        before, after = few.misfit(change.cameras), undone.misfit(change.cameras)
        if after.count < max(LEAST_COUNT, before.count // 2):
            continue
        if after.px < before.px + _NO_WORSE_PX:
            fair.append(change)
        is_gain = before.px - after.px >= _GROSS_GAIN_PX and after.px <= _GROSS_SHARE * before.px
        if is_gain and undone.misfit().px < least_px:
            least_px, best = undone.misfit().px, change
    # A delay or a bump that explains as much is told as such, with its size.
    for camera in suspects if best is not None else []:
        offset = offset_of(trial, camera, far=with_clock)
        if offset.size_px > _FARTHEST_BUMP_PX:
            continue
        late = offset.late if with_clock and offset.has_clock else 0.0
        if trial.change(camera, -offset.moved_px, late).adopted().misfit().px < least_px:
            return None, trial
    if best is None and shares.all_ >= _UNCONFIRMED:
        best = _confirmed_best(few, shares, fair)
    if best is None:
        return None, trial
    undone = best.make(trial)
    return Cause(
        best.kind,
        tuple(trial.views.names[camera] for camera in best.cameras),
        0,
        trial.table.n_frames - 1,
        before_px=trial.misfit(best.cameras).px,
        after_px=undone.misfit(best.cameras).px,
    ), undone


def _confirmed_best(
    few: Trial, shares: Unconfirmed, changes: Sequence["_Pictures"]
) -> "_Pictures | None":
    """Return the change after which most of the silhouettes is confirmed, if that is enough.

    What the others do not confirm must be that camera's: a chair that one camera sees may come to
    be confirmed by chance as another's picture is turned.
    """
    least, best = shares.all_ - max(_CONFIRMED_GAIN, _CONFIRMED_SHARE * shares.all_), None
    for change in changes:
        if min(shares.by_camera[change.cameras]) < _UNCONFIRMED:
            continue
        undone = unconfirmed_shares(change.make(few))
        is_own = undone.by_camera[change.cameras] <= 0.5 * shares.by_camera[change.cameras]
        if undone.all_ <= least and is_own.all():
            least, best = undone.all_, change
    return best


class _Pictures(NamedTuple):
    """A change of the pictures of cameras, by number, that is tried."""

    kind: Kind
    cameras: list[int]
    make: Callable[[Trial], Trial]


def _changes(views: Views, suspects: Sequence[int]) -> Iterator[_Pictures]:
    """Yield every change of pictures that is tried."""
    sizes = views.sizes_px.astype(np.float64)

    def mapped(kind: Kind, camera: int, factor: NDArray[np.float64]) -> _Pictures:
        ends = np.where(factor < 0, sizes[camera], 0.0)
        return _Pictures(kind, [camera], lambda trial: trial.mapped(camera, factor, ends))

    for camera in suspects:
        for kind, turned in _PICTURES.items():
            yield mapped(kind, camera, np.array(turned))
        # Where the rig tells no size, nobody else notices that pictures were made smaller.
        for size in np.unique(sizes, axis=0):
            if np.abs(np.log(size / sizes[camera])).max() > _OTHER_SIZE:
                yield mapped("scaled", camera, size / sizes[camera])
    for first, second in combinations(suspects, 2):
        yield _exchange(first, second)


def _exchange(first: int, second: int) -> _Pictures:
    return _Pictures("exchanged", [first, second], lambda trial: trial.exchanged(first, second))


def _fine(
    trial: Trial, offsets: Sequence[Offset], but: Collection[str], *, with_clock: bool
) -> tuple[list[Cause], Trial]:
    """Return the delay and the bump of the camera that explain most, and the session without."""
    tried: list[_Tried] = []
    for camera, offset in enumerate(offsets):
        if trial.views.names[camera] in but:
            continue
        tried += _tries(trial, camera, offset, with_clock=with_clock)
    best = max(tried, key=lambda one: one.gain_px, default=None)
    if best is None:
        return [], trial
    instead = tuple(
        trial.views.names[one.camera]
        for one in tried
        if one.camera != best.camera and one.gain_px >= _AS_GOOD * best.gain_px
    )
    causes = [replace(cause, instead=instead) for cause in best.causes]
    return causes, best.change.adopted()


@dataclass(frozen=True, slots=True, eq=False)
class _Tried:
    """A delay or a bump of one camera, and how much better all outlines fit without it."""

    camera: int
    causes: tuple[Cause, ...]
    change: Change
    gain_px: float


def _tries(trial: Trial, camera: int, offset: Offset, *, with_clock: bool) -> list[_Tried]:
    now = trial.change(camera)
    is_late = (
        with_clock
        and offset.has_clock
        and abs(offset.late) - _SIGNIFICANT * offset.late_se > _LEAST_LATE
    )
    error_px = float(offset.moved_se_px.max())
    is_bumped = _is_beyond(offset.moved_px, error_px)
    result = []
    if is_late or is_bumped:
        shift = -offset.moved_px if is_bumped else None
        change = trial.change(camera, shift, offset.late if is_late else 0.0)
        is_plain = (
            is_late
            and not is_bumped
            and abs(offset.late) > _PLAIN * offset.late_se
            and offset.speed_px >= _PLAIN_SPEED_PX
        )
        if is_plain or _is_fine_gain(now, change):
            before, after = now.misfit(), change.misfit()
            causes = []
            is_bumped = is_bumped and wander_of(change) <= _WANDER * offset.size_px
            if is_late:
                causes.append(_late(trial, camera, offset, before, after))
            if is_bumped:
                step = Step(0, offset.moved_px, error_px, error_px, 0.0)
                causes.append(_bumped(trial, camera, step, before, after))
            gain_px = (before.px - after.px) * after.count
            if causes:
                result.append(_Tried(camera, tuple(causes), change, gain_px))
    n_frames = trial.table.n_frames
    step_ = step_of(trial, camera, min(max(n_frames // 10, _LEAST_SIDE), _MOST_SIDE))
    if (
        step_ is not None
        and _is_beyond(step_.moved_px, step_.se_px)
        and step_.size_se_px < float(np.linalg.norm(step_.moved_px))
        and step_.wander_px <= _WANDER * float(np.linalg.norm(step_.moved_px))
    ):
        rows = np.arange(trial.table.n_frames)[:, None]
        change = trial.change(camera, np.where(rows >= step_.first, -step_.moved_px, 0.0))
        if _is_fine_gain(now, change, step_.first):
            before, after = now.misfit(), change.misfit()
            gain_px = (before.px - after.px) * after.count
            cause = _bumped(trial, camera, step_, before, after)
            result.append(_Tried(camera, (cause,), change, gain_px))
    return result


def _is_beyond(moved_px: NDArray[np.float64], error_px: float) -> bool:
    size_px = float(np.linalg.norm(moved_px))
    return size_px - _SIGNIFICANT * error_px > _LEAST_BUMP_PX and size_px <= _FARTHEST_BUMP_PX


def _is_fine_gain(now: Change, change: Change, since: int = 0) -> bool:
    """Tell whether a change does to the ends of a camera's pencils what it would, were it so."""
    gains, expected, partner = ends_gain(now, change, since)
    is_worse = gains < -_NO_WORSE_PX
    # With one other camera alone outlines may come to fit by chance: two must say so, if there are.
    of_partner, told = (np.bincount(partner, value, minlength=1) for value in (gains, expected))
    agree = (told >= _PARTNER_SHARE * expected.sum()) & (of_partner >= _EXPECTED_SHARE * told)
    return bool(
        len(gains) >= _LEAST_ENDS
        and agree.sum() >= min(2, len(now.rows))
        and gains.sum() >= _EXPECTED_SHARE * expected.sum()
        and is_worse.mean() <= _MOST_WORSE
    )


def _late(trial: Trial, camera: int, offset: Offset, before: Misfit, after: Misfit) -> Cause:
    reach = 1.96 * offset.late_se
    return Cause(
        "late",
        (trial.views.names[camera],),
        0,
        trial.table.n_frames - 1,
        offset.late,
        offset.late - reach,
        offset.late + reach,
        before_px=before.px,
        after_px=after.px,
    )


def _bumped(trial: Trial, camera: int, step: Step, before: Misfit, after: Misfit) -> Cause:
    size, reach = float(np.linalg.norm(step.moved_px)), 1.96 * step.size_se_px
    return Cause(
        "bumped",
        (trial.views.names[camera],),
        step.first,
        trial.table.n_frames - 1,
        size,
        max(size - reach, 0.0),
        size + reach,
        step.moved_px,
        before.px,
        after.px,
    )


def _contradictory(
    trial: Trial, said: FrameVerdicts | None, causes: Sequence[Cause]
) -> list[Cause]:
    """Return the cameras that contradict the others most of the time, whatever was tried.

    With a gross cause, what single frames say of the others tells nothing.
    """
    if any(cause.is_gross for cause in causes):
        return []
    named = {name for cause in causes for name in cause.cameras}
    last = trial.table.n_frames - 1
    found = []
    for camera, name in enumerate(trial.views.names):
        if name in named:
            continue
        fit = trial.misfit([camera])
        is_off = fit.count >= LEAST_COUNT and fit.px >= _CONTRADICTORY_PX
        if said is not None:
            told = np.isfinite(said.supported_share[:, camera])
            if told.any() and np.median(said.supported_share[told, camera]) > _SUPPORTED:
                is_off = False
            is_off = is_off or said.denies[:, camera].mean() > _MOST_FRAMES
        if is_off:
            found.append(Cause("contradictory", (name,), 0, last, before_px=fit.px))
    if said is not None and not found and said.is_contradictory.mean() > _MOST_FRAMES:
        found.append(Cause("contradictory", (), 0, last))
    return found


def _left_behind(trial: Trial, said: FrameVerdicts | None, causes: Sequence[Cause]) -> list[Cause]:
    """Return the cameras that see something in one place all the time, and no other camera does."""
    found: list[Cause] = []
    if said is None or any(cause.is_gross for cause in causes):
        return found
    for camera, name in enumerate(trial.views.names):
        boxes = said.alone_px[:, camera]
        is_told = np.isfinite(boxes[:, 0])
        if is_told.mean() < _ALL_THE_TIME:
            continue
        box = np.median(boxes[is_told], axis=0)
        middles = (boxes[is_told, :2] + boxes[is_told, 2:]) / 2.0
        away_px = np.abs(middles - (box[:2] + box[2:]) / 2.0).max(axis=1)
        if (away_px <= _SAME_PLACE_PX).mean() >= _ALL_THE_TIME:
            last = trial.table.n_frames - 1
            low, high = np.percentile(boxes[is_told], (5, 95), axis=0)
            box = np.concatenate([low[:2], high[2:]])
            found.append(Cause("left behind", (name,), 0, last, box_px=box))
    return found


def _frames(trial: Trial, denies: NDArray[np.bool_] | None, causes: Sequence[Cause]) -> list[Cause]:
    """Return runs of frames in which one camera's silhouettes fit none of the others."""
    count = len(trial.views)
    if count < 3:
        return []
    gross = {name for cause in causes if cause.is_gross for name in cause.cameras}
    found = []
    for camera, name in enumerate(trial.views.names):
        is_wrong, excess = _wrong_frames(trial, camera)
        if denies is not None and not gross:  # with a gross cause, who denies whom says nothing
            is_wrong = is_wrong | denies[:, camera]
        if name in gross:
            continue
        starts = np.flatnonzero(is_wrong & ~np.append(False, is_wrong[:-1]))
        stops = np.flatnonzero(is_wrong & ~np.append(is_wrong[1:], False))
        for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
            run = excess[start : stop + 1]
            size = float(np.nanmax(run)) if (run > 0.0).any() else np.nan
            found.append(Cause("frames", (name,), start, stop, size))
    return found


def _wrong_frames(trial: Trial, camera: int) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return in which frames (F,) a camera's outlines fit none, and by how much worse than usual.

    Of each frame, how much worse than usual its outlines fit each other camera's is compared with
    how much worse those fit each other.
    """
    inverse = trial.table.is_inverse
    is_odd = inverse[:, camera] & (inverse[:, camera].mean() <= _MOST_FRAMES)
    has = (trial.pencils.cameras == camera).any(axis=1)
    by_pencil = np.array([misfit_by_frame(one[None]) for one in trial.misses().miss_px])  # (D, F)
    worse = by_pencil - _median(by_pencil, axis=1)[:, None]
    mine, others = worse[has], _median(worse[~has], axis=0)
    n_told = np.isfinite(mine).sum(axis=0)
    n_wrong = (mine > _FRAME_PX).sum(axis=0)
    excess = _median(mine, axis=0)
    is_wrong = (n_told >= 2) & (n_wrong >= _FRAME_SHARE * n_told) & (excess > _FRAME_MEDIAN_PX)
    return (is_wrong & ~(others > _OTHERS_PX)) | is_odd, excess


def _median(values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Return the median of what is not NaN along an axis; NaN where nothing is."""
    is_told = np.isfinite(values).any(axis=axis)
    result = np.full(is_told.shape, np.nan)
    chosen = np.compress(is_told, values, axis=1 - axis)
    if chosen.size:
        result[is_told] = np.nanmedian(chosen, axis=axis)
    return result
