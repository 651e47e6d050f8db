"""A report as a page: one HTML file that needs nothing else, and asks nobody for anything.

What scrubs it is in ``templates/report.js``, which draws the scene with three.js
(``vendor/three.min.js``, built by `make vendor`). Numbers, meshes and pictures stand in the page
as text (`hybridve.hull.view.packed`). Equal input gives the same file to the byte.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.calib.files import write_whole
from hybridve.hull.view.pages import page_template

#: How the verdict looks at first sight.
Look = Literal["good", "limits", "bad"]

#: Columns of a lane's drawing: of more frames than these the least and the most of each are drawn.
_COLUMNS = 1000

#: Height of a lane's drawing, in its own units.
_HEIGHT = 100.0

#: Rows of the table that says what the timeline draws, at most.
_MOST_ROWS = 40

#: Marks on the axis of time, at most.
_MOST_TICKS = 8


@dataclass(frozen=True, slots=True, eq=False)
class PagePicture:
    """A picture on a page.

    Attributes
    ----------
    webp : str
        In base64.
    says : str
        What it shows, for who does not see it.
    caption : str
        What stands beneath it.
    """

    webp: str
    says: str
    caption: str


@dataclass(frozen=True, slots=True, eq=False)
class ClashCard:
    """A clash on a page.

    Attributes
    ----------
    id, status, kind, object : str
        As the ledger has them.
    words : str
        What it is, in a sentence.
    frame : int
        Number of its worst frame.
    row : int
        Which of the report's that is.
    place_m : (float, float, float)
        Where, about the page's origin.
    facts : sequence of (str, str)
        What else is known: a term, and what of it.
    pictures : sequence of PagePicture
        The largest first.
    """

    id: str
    status: str
    kind: str
    object: str
    words: str
    frame: int
    row: int
    place_m: tuple[float, float, float]
    facts: Sequence[tuple[str, str]]
    pictures: Sequence[PagePicture] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """One object along the timeline.

    Attributes
    ----------
    name : str
        Of the object.
    verdict : str
        Its worst.
    verdicts : (F,) str
        Of each frame.
    lower_mm, upper_mm, at_least_mm : (F,) float64
        Bounds of the clearance and what it is at least at 95 %, depth counting as negative; NaN
        where that is not known.
    required_mm : float
        The clearance it requires.
    """

    name: str
    verdict: str
    verdicts: NDArray[np.str_]
    lower_mm: NDArray[np.float64]
    upper_mm: NDArray[np.float64]
    at_least_mm: NDArray[np.float64]
    required_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class Page:
    """All that a page says.

    Attributes
    ----------
    title : str
        Of what report it is.
    look : Look
        How the verdict looks.
    verdict, sentence : str
        One word, and the answer in one sentence.
    about : sequence of str
        What it rests on, a line each.
    missing : sequence of str
        What the page does not show, and why.
    clashes : sequence of ClashCard
        The worst first.
    clashes_note : str
        What was grouped and left out.
    lanes : sequence of Lane
        In the scene's order.
    index, time_s : (F,) arrays
        Numbers of the frames, and when they were recorded.
    reasons : sequence of F str
        Why a frame was not evaluated; else empty.
    warnings : sequence of str
        What is wrong with cameras and parts.
    cameras : sequence of mappings
        What is known of each camera: a row of a table.
    objects : sequence of mappings
        What is known of each object: a row of a table.
    trust : mapping of str to values
        What else speaks for the numbers.
    settings : mapping of str to values
        How the report came about.
    scene : mapping
        What ``report.js`` is told, as plain JSON values.
    chunks : mapping of str to str
        Packed numbers, and pictures, by name.
    pictures_every : int
        Pictures of the cameras are there of every so manieth frame; 0 for none.
    """

    title: str
    look: Look
    verdict: str
    sentence: str
    about: Sequence[str]
    missing: Sequence[str]
    clashes: Sequence[ClashCard]
    clashes_note: str
    lanes: Sequence[Lane]
    index: NDArray[np.integer]
    time_s: NDArray[np.float64]
    reasons: Sequence[str]
    warnings: Sequence[str]
    cameras: Sequence[Mapping[str, Any]]
    objects: Sequence[Mapping[str, Any]]
    trust: Mapping[str, Any]
    settings: Mapping[str, Any]
    scene: Mapping[str, Any]
    chunks: Mapping[str, str] = field(default_factory=dict)
    pictures_every: int = 0


def write_report_page(path: Path, page: Page) -> int:
    """Write the page, which appears only when it is complete; return its size in bytes.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    whole = page_text(page).encode("utf-8")
    try:
        write_whole(path, whole)
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error.strerror}") from error
    return len(whole)


def page_text(page: Page) -> str:
    """Return the page as HTML."""
    return page_template("report.html.jinja").render(
        page=page,
        drawings=[_drawing(lane, page.time_s) for lane in page.lanes],
        ticks=_ticks(page.time_s),
        table=_table(page),
        script=_script("templates/report.js"),
        three=_script("vendor/three.min.js"),
        licence=(files(__package__) / "vendor" / "LICENSE.three").read_text(encoding="utf-8"),
    )


def _script(name: str) -> str:
    """Return a script of this package as it is; it ends no element of a page."""
    text = files(__package__).joinpath(*name.split("/")).read_text(encoding="utf-8")
    assert "</script" not in text.lower(), name
    return text


@dataclass(frozen=True, slots=True)
class _Drawing:
    """A lane, drawn 1000 wide and 100 high; paths are of SVG."""

    lane: Lane
    low_mm: float
    high_mm: float
    between: str
    middle: str
    at_least: str
    required: float | None
    zero: float | None
    strips: tuple[tuple[str, float, float], ...]


def _drawing(lane: Lane, time_s: NDArray[np.float64]) -> _Drawing:
    x = _places(time_s)
    upper = np.where(np.isfinite(lane.upper_mm), lane.upper_mm, np.nan)
    lower = np.where(np.isfinite(lane.lower_mm), lane.lower_mm, upper)
    known = np.concatenate([upper, lower, lane.at_least_mm])
    known = known[np.isfinite(known)]
    if lane.required_mm > 0 and len(known):
        known = np.append(known, lane.required_mm)
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    if high - low < 2.0:
        low, high = 0.5 * (low + high) - 1.0, 0.5 * (low + high) + 1.0
    margin = 0.06 * (high - low)
    low, high = low - margin, high + margin

    def y(values: Any) -> Any:
        return _HEIGHT * (high - values) / (high - low)

    columns = np.minimum(x.astype(np.int64), _COLUMNS)
    top_x, top = _thinned(columns, x, upper, np.fmax)
    bottom_x, bottom = _thinned(columns, x, lower, np.fmin)
    least_x, least = _thinned(columns, x, lane.at_least_mm, np.fmin)
    is_known = bool(len(known))
    return _Drawing(
        lane,
        low + margin,
        high - margin,
        _band(top_x, y(top), y(bottom)) if is_known else "",
        _path(bottom_x, y(bottom)) if is_known else "",
        _path(least_x, y(least)) if is_known else "",
        float(y(lane.required_mm)) if lane.required_mm > 0 and is_known else None,
        float(y(0.0)) if low < 0.0 < high and is_known else None,
        tuple(_strips(lane.verdicts, x)),
    )


def _places(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where frames (F,) stand along a drawing: the first at 0, the last at its end."""
    if len(time_s) < 2:
        return np.zeros(len(time_s))
    return np.asarray(_COLUMNS * (time_s - time_s[0]) / max(time_s[-1] - time_s[0], 1e-9))


def _thinned(
    columns: NDArray[np.int64], x: NDArray[np.float64], values: NDArray[np.float64], take: Any
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return one value a column, by `take`, where there is more than one."""
    starts = np.flatnonzero(np.diff(columns, prepend=-1))
    if len(starts) == len(columns) or not len(columns):
        return x, values
    return x[starts], np.asarray(take.reduceat(values, starts))


def _path(x: NDArray[np.float64], y: NDArray[np.float64]) -> str:
    """Return a line as SVG has it, with gaps where it is not known."""
    parts, was_known = [], False
    for one, at in zip(x.tolist(), y.tolist(), strict=True):
        if at == at:
            parts.append(f"{'L' if was_known else 'M'}{one:.1f} {at:.1f}")
        was_known = at == at
    return "".join(parts)


def _band(x: NDArray[np.float64], top: NDArray[np.float64], bottom: NDArray[np.float64]) -> str:
    """Return the area between two lines, run by run."""
    known = np.isfinite(top) & np.isfinite(bottom)
    edges = np.flatnonzero(np.diff(known, prepend=False, append=False)).reshape(-1, 2)
    parts = []
    for start, stop in edges.tolist():
        around = [*zip(x[start:stop].tolist(), top[start:stop].tolist(), strict=True)]
        around += [*zip(x[start:stop].tolist(), bottom[start:stop].tolist(), strict=True)][::-1]
        parts.append("M" + "L".join(f"{one:.1f} {at:.1f}" for one, at in around) + "Z")
    return "".join(parts)


def _strips(verdicts: NDArray[np.str_], x: NDArray[np.float64]) -> list[tuple[str, float, float]]:
    """Return runs of one verdict: which, where it begins, and how wide it is."""
    if not len(verdicts):
        return []
    starts = np.flatnonzero(np.append(True, verdicts[1:] != verdicts[:-1]))
    half = 0.5 * np.diff(x)
    begins = np.append(0.0, x[:-1] + half) if len(x) > 1 else np.zeros(1)
    ends = np.append(begins[1:], float(_COLUMNS))
    stops = np.append(starts[1:], len(verdicts)) - 1
    return [
        (str(verdicts[start]), float(begins[start]), float(ends[stop] - begins[start]))
        for start, stop in zip(starts.tolist(), stops.tolist(), strict=True)
    ]


def _ticks(time_s: NDArray[np.float64]) -> list[tuple[float, str]]:
    """Return marks on the axis of time: where, in per cent, and what stands there."""
    if len(time_s) < 2 or time_s[-1] <= time_s[0]:
        return []
    span = float(time_s[-1] - time_s[0])
    step = next(
        factor * power
        for power in (10.0**exponent for exponent in range(-3, 7))
        for factor in (1, 2, 5)
        if span / (factor * power) <= _MOST_TICKS
    )
    first = np.ceil(time_s[0] / step - 1e-9) * step
    marks = np.arange(first, time_s[-1] + 1e-9, step)
    return [
        (100 * (mark - time_s[0]) / span, f"{round(mark, 9) + 0.0:.10g}") for mark in marks.tolist()
    ]


def _table(page: Page) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return what the timeline draws, span of time by span: when, and of each lane what."""
    from hybridve.calib.lengths import bounds_mm

    n_rows = len(page.time_s)
    if not n_rows:
        return []
    step = -(-n_rows // _MOST_ROWS)
    rows = []
    for start in range(0, n_rows, step):
        stop = min(start + step, n_rows)
        first, last = page.time_s[start], page.time_s[stop - 1]
        when = f"{first:.2f} s" if stop - start == 1 else f"{first:.2f}-{last:.2f} s"
        cells = []
        for lane in page.lanes:
            counts = dict.fromkeys(lane.verdicts[start:stop].tolist())
            upper = lane.upper_mm[start:stop]
            text = ""
            if np.isfinite(upper).any():
                at = start + int(np.nanargmin(np.where(np.isfinite(upper), upper, np.nan)))
                lower_mm, upper_mm = lane.lower_mm[at], lane.upper_mm[at]
                text = (
                    bounds_mm(1e-3 * lower_mm, 1e-3 * upper_mm).replace("+-", "±")
                    if np.isfinite(lower_mm)
                    else f"at most {upper_mm:.1f}"
                )
            cells.append((text, ", ".join(counts)))
        rows.append((when, cells))
    return rows
