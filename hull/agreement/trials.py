"""What would be, were a camera's pictures other than they are: how well outlines fit then.

Limits of outlines (`hybridve.hull.agreement.tangents`) are all that is looked at, so that to try a
mirrored picture, another camera's, an earlier one, or one that is shifted, takes microseconds a
frame. How badly outlines fit is the mean of ``min(|r|, MOST_PX)`` over the limits: what is not seen
by both cameras, or is segmented in one alone, counts no more than that.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.agreement.outlines import OutlineTable
from hybridve.hull.agreement.tangents import (
    Limits,
    Misses,
    Pencils,
    limits_of,
    make_pencils,
    misses,
)
from hybridve.hull.jit import compiled
from hybridve.hull.query.silhouettes import Views

#: A limit misses its like by no more than this, in pixels: beyond, they are not of one thing.
MOST_PX = 15.0

#: Cameras that each one is compared with, at most: those whose views cross its own best.
_PARTNERS = 6

#: A limit moves from frame to frame by no more than this, in pixels; else it is another thing's.
_FASTEST_PX = 60.0


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """The outlines of a session, as they are or as they would be.

    Attributes
    ----------
    views : Views
        The cameras, C of them, which stand still.
    pencils : Pencils
        D of them.
    table : OutlineTable
        The outlines of F frames, evenly spaced.
    late : (C,) float64
        So many rows later are the outlines that are taken of each camera.
    limits : Limits
        Of all that.
    """

    views: Views
    pencils: Pencils
    table: OutlineTable
    late: NDArray[np.float64]
    limits: Limits

    @classmethod
    def of(cls, views: Views, table: OutlineTable) -> Self:
        """Return the outlines as they are."""
        pencils = make_pencils(views, _pairs(views))
        return cls(views, pencils, table, np.zeros(len(views)), limits_of(pencils, table))

    def some(self, most: int) -> "Trial":
        """Return the same of so many frames at most, evenly chosen: they tell no delay."""
        n_frames = self.table.n_frames
        if n_frames <= most:
            return self
        chosen = np.unique(np.linspace(0, n_frames - 1, most).astype(np.int64))
        n_cameras = len(self.views)
        rows = (chosen[:, None] * n_cameras + np.arange(n_cameras)).ravel()
        angle, gradient, is_known = self.limits
        limits = Limits(angle[:, chosen], gradient[:, chosen], is_known[:, chosen])
        table = _rows_of(self.table, rows, self.table.is_inverse[chosen])
        return replace(self, table=table, late=np.zeros(n_cameras), limits=limits)

    def rows(self, cameras: Sequence[int]) -> NDArray[np.int64]:
        """Return which pencils any of these cameras has a part in."""
        return np.flatnonzero(np.isin(self.pencils.cameras, cameras).any(axis=1))

    def misses(self, rows: NDArray[np.int64] | None = None) -> Misses:
        """Return by how much outlines miss each other in some pencils, or in all."""
        rows = np.arange(len(self.pencils.cameras)) if rows is None else rows
        return misses(self.limits.of(rows), self.pencils.reverse[rows], self.limits)

    def misfit(self, cameras: Sequence[int] | None = None) -> "Misfit":
        """Return how badly the outlines of cameras, or of all, fit those of the others."""
        rows = None if cameras is None else self.rows(cameras)
        return misfit_of(self.misses(rows).miss_px)

    def mapped(
        self, camera: int, factor: NDArray[np.float64], offset_px: NDArray[np.float64]
    ) -> "Trial":
        """Return the same with all pixels of one camera times (2,), and moved by (2,) pixels."""
        corners = self.table.corners_px.copy()
        mine = _corners_of(self.table, camera)
        corners[mine] = corners[mine] * factor + offset_px
        return self._with(replace(self.table, corners_px=corners), [camera])

    def inverted(self, cameras: Sequence[int]) -> "Trial":
        """Return the same with what is not object of these cameras for their objects."""
        return self._with(self.table, cameras, inverse=True)

    def exchanged(self, first: int, second: int) -> "Trial":
        """Return the same with the pictures of two cameras exchanged, middle upon middle."""
        return self._with(_exchanged(self.table, self.views, first, second), [first, second])

    def change(
        self, camera: int, shift_px: NDArray[np.float64] | None = None, late: float = 0.0
    ) -> "Change":
        """Return the outlines of one camera, shifted, and of `late` rows later.

        `shift_px` is (2,) or (F, 2) pixels along x and y, to be added.
        """
        rows = np.flatnonzero(self.pencils.cameras[:, 0] == camera)
        table = self.table
        if shift_px is not None and shift_px.any():
            corners = table.corners_px.copy()
            by_frame = np.broadcast_to(shift_px, (table.n_frames, 2))
            corners[_corners_of(table, camera)] += by_frame[_frames_of(table, camera)]
            table = replace(table, corners_px=corners)
            limits = limits_of(self.pencils.of(rows), table)
            late += float(self.late[camera])
        else:
            limits = self.limits.of(rows)
        return Change(self, camera, rows, table, limits).later(late)

    def _with(self, table: OutlineTable, cameras: Sequence[int], inverse: bool = False) -> "Trial":
        limits = self.limits
        for camera in cameras:
            rows = np.flatnonzero(self.pencils.cameras[:, 0] == camera)
            some = limits_of(self.pencils.of(rows), table, inverse)
            if self.late[camera]:
                some = _later(*some, float(self.late[camera]))
            limits = limits.with_rows(rows, some)
        return replace(self, table=table, limits=limits)


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """One camera's outlines as they would be, against those of the others as they are.

    Attributes
    ----------
    trial : Trial
        All outlines.
    camera : int
        Whose are others.
    rows : (R,) int64
        The pencils that are seen from it.
    table : OutlineTable
        The outlines with its own changed.
    limits : Limits
        Its own.
    delay : float
        By how many rows later they are taken, beyond what the trial says.
    """

    trial: Trial
    camera: int
    rows: NDArray[np.int64]
    table: OutlineTable
    limits: Limits
    delay: float = 0.0

    def later(self, late: float) -> "Change":
        """Return the outlines of `late` rows later; between rows, between."""
        if late == 0.0:
            return self
        limits = _later(*self.limits, late)
        return replace(self, limits=limits, delay=self.delay + late)

    def misses(self) -> Misses:
        """Return by how much they miss the others': first in its own images, then in theirs."""
        trial, rows = self.trial, self.rows
        reverse = trial.pencils.reverse[rows]
        mine = misses(self.limits, reverse, trial.limits)
        theirs = misses(trial.limits.of(reverse), np.arange(len(rows)), self.limits)
        return Misses(
            np.concatenate([mine.miss_px, theirs.miss_px]),
            np.concatenate([mine.slope, theirs.slope]),
            np.concatenate([mine.other_slope, theirs.other_slope]),
        )

    def slopes(self, found: Misses) -> NDArray[np.float64]:
        """Return how misses change as its picture is shifted by a pixel: (2 R, F, 2, K, 2)."""
        half = len(self.rows)
        return np.concatenate([found.slope[:half], found.other_slope[half:]])

    def misfit(self) -> "Misfit":
        """Return how badly they fit the others'."""
        return misfit_of(self.misses().miss_px)

    def adopted(self) -> Trial:
        """Return all outlines with the change made."""
        late = self.trial.late.copy()
        late[self.camera] += self.delay
        limits = self.trial.limits.with_rows(self.rows, self.limits)
        return replace(self.trial, table=self.table, late=late, limits=limits)


@dataclass(frozen=True, slots=True)
class Misfit:
    """How badly outlines fit each other.

    Attributes
    ----------
    px : float
        Mean of ``min(|r|, MOST_PX)``; NaN of none.
    count : int
        Over so many limits.
    """

    px: float
    count: int


def misfit_of(miss_px: NDArray[np.float64]) -> Misfit:
    """Return the misfit of limits; those that are NaN do not count."""
    known = miss_px[np.isfinite(miss_px)]
    return Misfit(
        float(np.minimum(np.abs(known), MOST_PX).mean()) if len(known) else np.nan, len(known)
    )


def misfit_by_frame(miss_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the misfit of each frame, (F,) pixels, of misses (D, F, 2, K); NaN where none is."""
    is_known = np.isfinite(miss_px)
    sums = np.where(is_known, np.minimum(np.abs(miss_px), MOST_PX), 0.0).sum(axis=(0, 2, 3))
    counts = is_known.sum(axis=(0, 2, 3))
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def _pairs(views: Views) -> NDArray[np.int64]:
    """Return the pairs (N, 2) of cameras that are compared."""
    count = len(views)
    pairs = np.array(list(combinations(range(count), 2)), np.int64).reshape(-1, 2)
    if count <= _PARTNERS + 1:
        return pairs
    towards = -views.centers_local()
    towards /= np.maximum(np.linalg.norm(towards, axis=1), 1e-12)[:, None]
    crossing = np.linalg.norm(np.cross(towards[pairs[:, 0]], towards[pairs[:, 1]]), axis=1)
    is_kept = np.zeros(len(pairs), np.bool_)
    for camera in range(count):
        mine = np.flatnonzero((pairs == camera).any(axis=1))
        is_kept[mine[np.argsort(-crossing[mine], kind="stable")[:_PARTNERS]]] = True
    return pairs[is_kept]


def _corners_of(table: OutlineTable, camera: int) -> NDArray[np.int64]:
    """Return the numbers of all corners of one camera."""
    starts, stops = _spans(table, camera)
    return _ranges(starts, stops - starts)


def _frames_of(table: OutlineTable, camera: int) -> NDArray[np.int64]:
    """Return the frame of each of these corners."""
    starts, stops = _spans(table, camera)
    return np.repeat(np.arange(table.n_frames), stops - starts)


def _spans(table: OutlineTable, camera: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    rows = np.arange(table.n_frames) * table.is_inverse.shape[1] + camera
    return table.first_corner[table.first_piece[rows]], table.first_corner[
        table.first_piece[rows + 1]
    ]


def _exchanged(table: OutlineTable, views: Views, first: int, second: int) -> OutlineTable:
    n_frames, n_cameras = table.is_inverse.shape
    order = np.arange(n_cameras)
    order[[first, second]] = second, first
    rows = (np.arange(n_frames)[:, None] * n_cameras + order).ravel()
    exchanged = _rows_of(table, rows, table.is_inverse[:, order])
    shift_px = (views.sizes_px - views.sizes_px[order]) / 2.0
    for camera in (first, second):
        exchanged.corners_px[_corners_of(exchanged, camera)] += shift_px[camera]
    return exchanged


def _rows_of(
    table: OutlineTable, rows: NDArray[np.int64], is_inverse: NDArray[np.bool_]
) -> OutlineTable:
    """Return the outlines of some rows, in their order; `is_inverse` (F, C) is theirs."""
    n_pieces = np.diff(table.first_piece)[rows]
    pieces = _ranges(table.first_piece[rows], n_pieces)
    n_corners = np.diff(table.first_corner)[pieces]
    corners = _ranges(table.first_corner[pieces], n_corners)
    return OutlineTable(
        table.corners_px[corners],
        table.is_cut[corners],
        np.concatenate([[0], np.cumsum(n_corners)]).astype(np.int64),
        np.concatenate([[0], np.cumsum(n_pieces)]).astype(np.int64),
        np.ascontiguousarray(is_inverse),
    )


def _ranges(starts: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the numbers from each start, as many as its count, one after the other."""
    ends = np.cumsum(counts)
    return np.arange(int(ends[-1]) if len(ends) else 0) + np.repeat(starts - ends + counts, counts)


@compiled
def _later(
    angle: NDArray[np.float64],
    gradient: NDArray[np.float64],
    is_known: NDArray[np.bool_],
    late: float,
) -> Limits:
    """Return the limits of `late` rows later; between two rows, on the straight way."""
    n_pencils, n_frames, n_kinds, n_limits = angle.shape
    new_angle = np.full(angle.shape, np.nan)
    new_gradient = np.zeros(gradient.shape)
    new_known = np.zeros(is_known.shape, np.bool_)
    step = int(np.floor(late))
    share = late - step
    for pencil in range(n_pencils):
        for frame in range(n_frames):
            before, after = frame + step, frame + step + 1
            if before < 0 or before >= n_frames or (share > 0.0 and after >= n_frames):
                continue
            for kind in range(n_kinds):
                n_found = 0
                for number in range(n_limits):
                    value = angle[pencil, before, kind, number]
                    if np.isnan(value):
                        break
                    known = is_known[pencil, before, kind, number]
                    size = np.sqrt((gradient[pencil, before, kind, number] ** 2).sum())
                    if share > 0.0:
                        away = np.inf
                        nearest = -1
                        for place in range(n_limits):
                            there = angle[pencil, after, kind, place]
                            if np.isnan(there):
                                break
                            if abs(there - value) < abs(away):
                                away, nearest = there - value, place
                        if nearest < 0 or abs(away) > _FASTEST_PX * size:
                            continue
                        value += share * away
                        known = known and is_known[pencil, after, kind, nearest]
                    new_angle[pencil, frame, kind, n_found] = value
                    new_gradient[pencil, frame, kind, n_found] = gradient[
                        pencil, before, kind, number
                    ]
                    new_known[pencil, frame, kind, n_found] = known
                    n_found += 1
    return Limits(new_angle, new_gradient, new_known)
