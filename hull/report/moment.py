"""One frame of a report, in the words and places that a picture of it needs."""

import math
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.calib.lengths import bounds_mm
from hybridve.hull.contact.verdict import VERDICTS, Verdict
from hybridve.hull.report.clashes import Clash, gather_clashes
from hybridve.hull.report.read import ObjectColumns, Report

_Point = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ObjectMoment:
    """What a report says of one object in one frame; places in the world, metres.

    Attributes
    ----------
    name : str
        The object.
    verdict : Verdict
        Whether it keeps its distance.
    required_m : float
        The clearance that it requires.
    clearance_m : (float, float)
        Bounds, depth in a closed object counting as negative; NaN where unknown, inf above where
        there is no hull.
    on_object_world, on_hull_world : (3,) float64
        The points that it was measured between; NaN where there are none.
    cp_obj_world, cp_hull_world : (3,) float64
        Ends of the way out, D_rec; NaN likewise.
    n_hull : (3,) float64
        Out of the hull where that way ends, unit vector; NaN likewise.
    """

    name: str
    verdict: Verdict
    required_m: float
    clearance_m: tuple[float, float]
    on_object_world: _Point
    on_hull_world: _Point
    cp_obj_world: _Point
    cp_hull_world: _Point
    n_hull: _Point

    @property
    def text(self) -> str:
        """Its verdict and its clearance, as "too near: 464.4 +-0.1 mm"."""
        lower_m, upper_m = self.clearance_m
        if not (math.isfinite(lower_m) and math.isfinite(upper_m)) or self.verdict == "unknown":
            return self.verdict
        if upper_m < 0.0:
            return f"{self.verdict}: {bounds_mm(-upper_m, -lower_m)} mm deep"
        return f"{self.verdict}: {bounds_mm(lower_m, upper_m)} mm"


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One frame of a report.

    Attributes
    ----------
    index : int
        Its number in the session.
    time_s : float
        When it was recorded.
    reason : str
        Why it could not be evaluated; else empty.
    objects : tuple of ObjectMoment
        In the scene's order.
    """

    index: int
    time_s: float
    reason: str
    objects: tuple[ObjectMoment, ...]

    def worst_first(self) -> list[ObjectMoment]:
        """Return the objects, the worst verdict first, of equals the nearest."""
        return sorted(
            self.objects,
            key=lambda one: (
                VERDICTS.index(one.verdict),
                np.nan_to_num(one.clearance_m[1] - one.required_m, nan=np.inf),
            ),
        )

    def text(self, most: int = 3) -> str:
        """Return what is worst, in a line."""
        if self.reason:
            return f"not evaluated: {self.reason}"
        told = [f"{one.name} {one.text}" for one in self.worst_first()]
        more = f"; {len(told) - most} more" if len(told) > most else ""
        return "; ".join(told[:most]) + more


def moment_of(report: Report, index: int, names: tuple[str, ...] | None = None) -> Moment | None:
    """Return what a report says of a frame, by its number; None if it does not have it.

    Parameters
    ----------
    report : Report
        As it was read.
    index : int
        Number of the frame in the session.
    names : tuple of str, optional
        Only these objects.
    """
    rows = np.flatnonzero(report.index == index)
    if len(rows) == 0:
        return None
    row = int(rows[0])
    return Moment(
        index,
        float(report.time_s[row]),
        str(report.reason[row]),
        tuple(
            _of_object(name, columns, row)
            for name, columns in report.objects.items()
            if names is None or name in names
        ),
    )


def _of_object(name: str, columns: ObjectColumns, row: int) -> ObjectMoment:
    def point(column: str) -> _Point:
        found = columns.get(column)
        return np.full(3, np.nan) if found is None else np.asarray(found[row], np.float64)

    clearance_m, depth_m = columns.get("clearance_m"), columns.get("depth_m")
    lower_m, upper_m = (np.nan, np.nan) if clearance_m is None else clearance_m[row]
    if depth_m is not None and depth_m[row, 1] > 0.0:
        lower_m, upper_m = lower_m - depth_m[row, 1], upper_m - depth_m[row, 0]
    verdict: Verdict = columns.verdict[row]
    return ObjectMoment(
        name,
        verdict,
        float(columns.about.get("required_clearance_m", 0.0)),
        (float(lower_m), float(upper_m)),
        point("clearance_on_object_m"),
        point("clearance_on_hull_m"),
        point("cp_obj_m"),
        point("cp_hull_m"),
        point("n_hull"),
    )


def named_objects(report: Report, pattern: str) -> tuple[str, ...]:
    """Return the objects of a report that a name, or a pattern with ``*``, means.

    A name means its parts as well: ``rack`` is ``rack.bolt``, too.

    Raises
    ------
    ReportError
        If there is none.
    """
    found = tuple(name for name in report.objects if means(pattern, name))
    if not found:
        raise ReportError(
            f"{report.path}: there is no object {pattern!r}; it has {', '.join(report.objects)}"
        )
    return found


def means(pattern: str, name: str) -> bool:
    """Tell whether a name, or a pattern with ``*``, means an object or one that it is a part of.

    Examples
    --------
    >>> means("rack", "rack.bolt"), means("ra*", "rack"), means("rack", "rack2")
    (True, True, False)
    """
    return fnmatchcase(name, pattern) or fnmatchcase(name, f"{pattern}.*")


def worst_clashes(report: Report, names: tuple[str, ...] | None = None) -> tuple[Clash, ...]:
    """Return the clashes of a report, by the scene's rules, of some objects; the worst first."""
    found = gather_clashes(report).clashes
    return tuple(one for one in found if names is None or one.name in names)


def worst_frame(report: Report, names: tuple[str, ...] | None = None) -> int:
    """Return the number of the frame that a report would have one look at first.

    That in which its worst clash is worst; without a clash the one in which the clearance is
    nearest to what is required; without clearances that with most collision points.

    Parameters
    ----------
    report : Report
        As it was read.
    names : tuple of str, optional
        Only these objects count.

    Raises
    ------
    ReportError
        If it has no frame or no object.
    """
    rows = [columns for name, columns in report.objects.items() if names is None or name in names]
    if not rows or len(report.index) == 0:
        raise ReportError(f"{report.path}: has no {'frame' if rows else 'object'}")
    if clashes := worst_clashes(report, names):
        return clashes[0].worst.frame
    spare_m = np.full(len(report.index), np.inf)
    for columns in rows:
        if (clearance_m := columns.get("clearance_m")) is not None:
            required_m = float(columns.about.get("required_clearance_m", 0.0))
            spare_m = np.fmin(spare_m, clearance_m[:, 1] - required_m)
    if np.isfinite(spare_m).any():
        return int(report.index[int(spare_m.argmin())])
    points = np.sum([columns.n_points for columns in rows], axis=0)
    return int(report.index[int(points.argmax())])
