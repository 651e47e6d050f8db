"""Charts: accuracy against time, and clearance against time."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.calib.files import sink
from hybridve.hull.places import MARK

#: What a chart may be written as.
SUFFIXES = (".png", ".svg", ".pdf")

#: Okabe and Ito's colours, told apart by the colour-blind; a marker each for black and white.
STYLES = (
    ("#0072B2", "o"),
    ("#D55E00", "s"),
    ("#009E73", "^"),
    ("#CC79A7", "D"),
    ("#E69F00", "v"),
    ("#56B4E9", "P"),
)
_INK = "#333333"
_SIZE_IN = (12.5, 6.2)
_DPI = 130


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """One method's U points.

    Attributes
    ----------
    name : str
        The method.
    labels : tuple of str
        What each point is called, "" for one that needs no name.
    time_ms : (U,) float64
        Median time a frame.
    time_range_ms : (2, U) float64
        Quartiles of it.
    error_mm, predicted_mm : (U,) float64
        The largest distance measured and the one predicted; NaN where unknown.
    missed_percent : (U,) float64
        Share of the colliding triangles that were missed.
    viewport : (U,) int64
        The viewport; 0 for a point that has none, which the second panel leaves out.
    on_front : (U,) bool
        Points that nothing beats.
    is_chosen : (U,) bool
        Points to mark as the ones that an accuracy would choose.
    """

    name: str
    labels: tuple[str, ...]
    time_ms: NDArray[np.float64]
    time_range_ms: NDArray[np.float64]
    error_mm: NDArray[np.float64]
    predicted_mm: NDArray[np.float64]
    missed_percent: NDArray[np.float64]
    viewport: NDArray[np.int64]
    on_front: NDArray[np.bool_]
    is_chosen: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class ClearanceCurve:
    """How far one object was from the hull, F frames.

    Attributes
    ----------
    name : str
        The object.
    time_s : (F,) float64
        Ascending.
    lower_mm, upper_mm : (F,) float64
        Bounds of the clearance, depth beneath the surface of a closed object counting as negative;
        NaN where a frame was not evaluated or has no hull.
    at_least_mm : (F,) float64
        What the clearance is at least, at 95 %; NaN where unknown.
    clashes : (F,) bool
        Frames in which the hull touches the object or is inside it.
    required_mm : float
        How far real things are to stay away; 0 if nothing is required.
    first_contact_s : (E,) float64
        When contact began, each time.
    """

    name: str
    time_s: NDArray[np.float64]
    lower_mm: NDArray[np.float64]
    upper_mm: NDArray[np.float64]
    at_least_mm: NDArray[np.float64]
    clashes: NDArray[np.bool_]
    required_mm: float
    first_contact_s: NDArray[np.float64]


def write_chart(
    path: Path,
    curves: Sequence[Curve],
    chosen: str,
    *,
    title: str,
    subtitle: str = "",
    note: str = "",
) -> None:
    """Draw curves into a picture, which appears only when it is complete.

    Parameters
    ----------
    path : Path
        A .png, .svg or .pdf.
    curves : sequence of Curve
        One for each method.
    chosen : str
        What the marked points are.
    title, subtitle : str
        Above the curves.
    note : str
        Below them.

    Raises
    ------
    ReportError
        If it cannot be written.
    ValueError
        If the name has another ending.
    """
    refuse_suffix(path)
    save_figure(draw_chart(curves, chosen, title=title, subtitle=subtitle, note=note), path)


def refuse_suffix(path: Path) -> None:
    """Raise ValueError if a chart cannot be written as a file of that name."""
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: charts are {', '.join(SUFFIXES)}")


#: Under which name each kind of file says what it was made by.
_SAYS_WHO = {"png": "Software", "svg": "Creator", "pdf": "Creator"}


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure, which appears only when it is complete."""
    kind = path.suffix.lower()[1:]
    try:
        with sink(path) as file:
            figure.savefig(file, format=kind, dpi=_DPI, metadata={_SAYS_WHO[kind]: MARK})
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error}") from error


def draw_chart(
    curves: Sequence[Curve], chosen: str, *, title: str, subtitle: str = "", note: str = ""
) -> Figure:
    """Return the figure of `write_chart`."""
    figure = Figure(figsize=_SIZE_IN, layout="constrained")
    FigureCanvasAgg(figure)
    tradeoff, missed = figure.subplots(1, 2, width_ratios=(2.2, 1))
    for number, curve in enumerate(curves):
        colour, marker = STYLES[number % len(STYLES)]
        _draw_tradeoff(tradeoff, curve, colour, marker)
        # Methods mostly miss the same: each later one is drawn smaller, so that all are seen.
        _draw_missed(missed, curve, colour, marker, shrink=number / len(curves))
    _draw_front(tradeoff, curves)
    _label_axes(tradeoff, missed, chosen)
    if not any((one > 0).any() for each in curves for one in (each.error_mm, each.predicted_mm)):
        tradeoff.set_ylim(1.0, 10.0)  # a logarithmic axis must have something to show
    figure.suptitle("\n".join([*textwrap.wrap(title, 110), subtitle]).strip(), fontsize=10)
    if note:
        figure.supxlabel(note, fontsize=9, color="#B00020")
    return figure


def _draw_tradeoff(axes: Axes, curve: Curve, colour: str, marker: str) -> None:
    along = curve.viewport > 0
    spread_ms = np.abs(curve.time_range_ms - curve.time_ms)
    # An error of nought has no place on a logarithmic axis.
    error_mm = np.where(curve.error_mm > 0, curve.error_mm, np.nan)
    predicted_mm = np.where(curve.predicted_mm > 0, curve.predicted_mm, np.nan)
    axes.plot(
        curve.time_ms[along],
        predicted_mm[along],
        "--",
        color=colour,
        linewidth=0.9,
        alpha=0.7,
    )
    axes.errorbar(
        curve.time_ms[along],
        error_mm[along],
        xerr=spread_ms[:, along],
        color=colour,
        marker=marker,
        markersize=6,
        linewidth=1.6,
        capsize=2,
        label=curve.name,
    )
    chosen = curve.is_chosen
    axes.plot(
        curve.time_ms[chosen],
        error_mm[chosen],
        linestyle="none",
        marker="*",
        markersize=15,
        markerfacecolor=colour,
        markeredgecolor=_INK,
    )
    # Where nothing was measured, the labels stand at what was predicted.
    heights_mm = np.where(np.isnan(error_mm), predicted_mm, error_mm)
    for time_ms, height_mm, label in zip(curve.time_ms, heights_mm, curve.labels, strict=True):
        if label and np.isfinite(height_mm):
            axes.annotate(
                label,
                (time_ms, height_mm),
                xytext=(5, 5),
                textcoords="offset points",
                fontsize=8,
                color=colour,
            )


def _draw_front(axes: Axes, curves: Sequence[Curve]) -> None:
    """Draw the points that nothing beats as a staircase: what a time buys at best."""
    front = [
        (time_ms, error_mm)
        for curve in curves
        for time_ms, error_mm in zip(
            curve.time_ms[curve.on_front], curve.error_mm[curve.on_front], strict=True
        )
    ]
    if front:
        time_ms, error_mm = np.array(sorted(front)).T
        axes.plot(
            time_ms,
            error_mm,
            drawstyle="steps-post",
            color=_INK,
            linewidth=6,
            alpha=0.18,
            solid_capstyle="round",
            zorder=0,
        )
        axes.plot(
            time_ms,
            error_mm,
            linestyle="none",
            marker="o",
            markersize=13,
            markerfacecolor="none",
            markeredgecolor=_INK,
            markeredgewidth=1.4,
        )


def _draw_missed(axes: Axes, curve: Curve, colour: str, marker: str, shrink: float) -> None:
    along = curve.viewport > 0
    axes.plot(
        curve.viewport[along],
        curve.missed_percent[along],
        color=colour,
        marker=marker,
        markersize=11 - 8 * shrink,
        linewidth=4.5 - 3.5 * shrink,
        label=curve.name,
    )


def _label_axes(tradeoff: Axes, missed: Axes, chosen: str) -> None:
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    tradeoff.set_xscale("log")
    tradeoff.set_yscale("log")
    tradeoff.set_xlabel("ms a frame, median and quartiles (query and positions)")
    tradeoff.set_ylabel("mm from a true collision to the nearest reported point, largest")
    tradeoff.grid(which="both", color="#DDDDDD", linewidth=0.5)
    proxies = [
        tradeoff.plot([], [], "--", color=_INK, linewidth=0.9, label="predicted, edge/(u-1)"),
        tradeoff.plot(
            [], [], "*", markersize=12, color="white", markeredgecolor=_INK, label=chosen
        ),
        tradeoff.plot(
            [],
            [],
            "o",
            markersize=10,
            markerfacecolor="none",
            markeredgecolor=_INK,
            label="Pareto front",
        ),
    ]
    handles, _ = tradeoff.get_legend_handles_labels()
    lines = [line for (line,) in proxies]
    named = [handle for handle in handles if handle not in lines]
    tradeoff.legend(handles=[*named, *lines], fontsize=8, framealpha=0.9)
    missed.set_xscale("log", base=2)
    missed.set_xlabel("viewport u")
    missed.set_ylabel("colliding triangles missed, %")
    missed.set_ylim(bottom=0)
    missed.grid(color="#DDDDDD", linewidth=0.5)
    for axis in (tradeoff.xaxis, tradeoff.yaxis, missed.xaxis):
        axis.set_major_formatter(plain)
    for axis in (tradeoff.xaxis, tradeoff.yaxis):
        axis.set_minor_formatter(NullFormatter())


_BOUNDS, _AT_LEAST, _CLASH, _REQUIRED = "#0072B2", "#009E73", "#D55E00", "#CC79A7"

#: Up to so many mm, or up to what is required, a clearance is drawn evenly; a curve that reaches so
#: many times as far has the rest of its axis in tenfold steps.
_EVEN_MM, _FAR = 10.0, 5.0

#: Height of an object's panel, and of all around the panels, inches.
_PANEL_IN, _AROUND_IN = 1.7, 1.3


def write_clearances(
    path: Path, curves: Sequence[ClearanceCurve], *, title: str, note: str = ""
) -> None:
    """Draw clearance against time, one panel an object, into a picture.

    It appears only when it is complete.

    Parameters
    ----------
    path : Path
        A .png, .svg or .pdf.
    curves : sequence of ClearanceCurve
        At least one.
    title, note : str
        Above the panels.

    Raises
    ------
    ReportError
        If it cannot be written.
    ValueError
        If the name has another ending.
    """
    refuse_suffix(path)
    save_figure(draw_clearances(curves, title=title, note=note), path)


def draw_clearances(curves: Sequence[ClearanceCurve], *, title: str, note: str = "") -> Figure:
    """Return the figure of `write_clearances`."""
    height_in = _AROUND_IN + _PANEL_IN * len(curves)
    figure = Figure(figsize=(_SIZE_IN[0], height_in), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(curves), 1, sharex=True, squeeze=False)[:, 0]
    for axes, curve in zip(panels, curves, strict=True):
        _draw_clearance(axes, curve)
    panels[-1].set_xlabel("seconds from the session's first frame")
    handles = {
        label: handle
        for axes in panels
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles), fontsize=8
    )
    figure.suptitle("\n".join([*textwrap.wrap(title, 110), note]).strip(), fontsize=10)
    return figure


def _scale_clearance(axes: Axes, curve: ClearanceCurve) -> None:
    """Have what is near seen beside what is far: there each 10 mm count, farther out each tenfold.

    Nothing changes where all of a curve is near, or all of it is far.
    """
    known_mm = np.concatenate([curve.lower_mm, curve.upper_mm, curve.at_least_mm])
    known_mm = known_mm[np.isfinite(known_mm)]
    if len(known_mm) == 0:
        return
    even_mm = max(_EVEN_MM, curve.required_mm)
    largest_mm, nearest_mm = float(np.abs(known_mm).max()), float(known_mm.min())
    if largest_mm < _FAR * even_mm or nearest_mm > largest_mm / _FAR:
        return
    axes.set_yscale("symlog", linthresh=even_mm, linscale=1.0)
    decades = [digit * 10.0**power for power in range(5) for digit in (1, 2, 5)]
    inside = [value for value in decades if even_mm < value <= 1.3 * largest_mm]
    ticks = [*(value for value in inside if str(value)[0] in "15"), even_mm, 0.0]
    lowest_mm = min(0.0, nearest_mm)
    ticks += [-value for value in ticks if 0.0 < value <= -1.3 * lowest_mm]
    axes.yaxis.set_major_locator(FixedLocator(ticks))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylim(1.3 * lowest_mm - 0.15 * even_mm, 1.3 * float(known_mm.max()))


def _draw_clearance(axes: Axes, curve: ClearanceCurve) -> None:
    time_s = curve.time_s
    lower_mm, upper_mm = curve.lower_mm, curve.upper_mm
    # A band a tenth of a millimetre wide would not be seen: its edges are drawn as lines.
    axes.fill_between(
        time_s, lower_mm, upper_mm, color=_BOUNDS, alpha=0.35, linewidth=0, label="bounds"
    )
    for edge_mm in (lower_mm, upper_mm):
        axes.plot(time_s, edge_mm, color=_BOUNDS, linewidth=0.9)
    if not np.isnan(curve.at_least_mm).all():
        axes.plot(
            time_s,
            curve.at_least_mm,
            color=_AT_LEAST,
            linewidth=0.9,
            label="at least, at 95 % (estimate)",
        )
    if curve.required_mm > 0:
        axes.axhline(
            curve.required_mm, color=_REQUIRED, linewidth=1.2, linestyle="--", label="required"
        )
    axes.axhline(0.0, color=_INK, linewidth=0.6)
    axes.fill_between(
        time_s,
        0.0,
        np.where(curve.clashes, np.minimum(lower_mm, 0.0), np.nan),
        color=_CLASH,
        alpha=0.5,
        linewidth=0,
    )
    half_s = 0.5 * float(np.diff(time_s).min()) if len(time_s) > 1 else 0.5
    edges = np.flatnonzero(np.diff(np.concatenate([[False], curve.clashes, [False]])))
    for number, (first, after) in enumerate(edges.reshape(-1, 2)):
        axes.axvspan(
            time_s[first] - half_s,
            time_s[after - 1] + half_s,
            color=_CLASH,
            alpha=0.15,
            linewidth=0,
            label="" if number else "collides",
        )
    if len(curve.first_contact_s):
        axes.plot(
            curve.first_contact_s,
            np.zeros(len(curve.first_contact_s)),
            linestyle="none",
            marker="v",
            markersize=7,
            color=_INK,
            label="first contact (estimate)",
        )
    axes.set_xlim(time_s[0] - half_s, time_s[-1] + half_s)
    _scale_clearance(axes, curve)
    axes.set_title(curve.name, fontsize=9, loc="left", pad=2)
    axes.set_ylabel("mm", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.grid(color="#DDDDDD", linewidth=0.5)
