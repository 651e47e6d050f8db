"""Frames that violate a clearance against how far objects were moved, drawn."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hybridve.hull.view.chart import STYLES, refuse_suffix, save_figure

_SIZE_IN = (10.0, 5.2)

#: How an answer is marked on the axis.
_AT_FOOT: dict[str, Any] = {"markersize": 9, "clip_on": False, "zorder": 5}


@dataclass(frozen=True, slots=True, eq=False)
class DoubtCurve:
    """What errors of outlines and cameras make of a recording's curve.

    Attributes
    ----------
    unsure : (S,) float64
        Frames that are not sure, at 95 %, to keep what is required.
    answer_mm : float
        The smallest shift at which all are; NaN if there is none.
    """

    unsure: NDArray[np.float64]
    answer_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class ShiftCurve:
    """One recording, between one shift and the next.

    Attributes
    ----------
    name : str
        What it is called.
    shift_mm : (S + 1,) float64
        Where the number of frames may change, ascending.
    violated, at_most : (S,) float64
        Frames that certainly violate between them, and these with all that may.
    answer_mm : float
        The smallest shift that none violates; NaN if there is none.
    doubt : DoubtCurve or None
        The same with errors; None where nothing was doubted.
    """

    name: str
    shift_mm: NDArray[np.float64]
    violated: NDArray[np.float64]
    at_most: NDArray[np.float64]
    answer_mm: float
    doubt: DoubtCurve | None = None


def write_spacing_chart(path: Path, curves: Sequence[ShiftCurve], *, title: str) -> None:
    """Draw one curve a recording into a picture, which appears only when it is complete.

    Parameters
    ----------
    path : Path
        A .png, .svg or .pdf.
    curves : sequence of ShiftCurve
        At least one, over the same range.
    title : str
        Above them.

    Raises
    ------
    ReportError
        If it cannot be written.
    ValueError
        If the name has another ending.
    """
    refuse_suffix(path)
    save_figure(draw_spacing_chart(curves, title=title), path)


def draw_spacing_chart(curves: Sequence[ShiftCurve], *, title: str) -> Figure:
    """Return the figure of `write_spacing_chart`."""
    figure = Figure(figsize=_SIZE_IN, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    most = max(
        float(counts.max())
        for curve in curves
        for counts in (curve.at_most, *(() if curve.doubt is None else (curve.doubt.unsure,)))
    )
    for number, curve in enumerate(curves):
        colour, marker = STYLES[number % len(STYLES)]
        # Curves often lie on each other: earlier ones are drawn wider, so that all are seen.
        width = 1.5 + 2.5 * (1.0 - (number + 1) / len(curves))
        label = f"{curve.name}: {_shift_text(curve.answer_mm)}"
        if np.isfinite(curve.answer_mm):
            axes.axvline(curve.answer_mm, color=colour, linestyle="--", linewidth=0.9)
            axes.plot([curve.answer_mm], [0.0], marker, color=colour, **_AT_FOOT)
        if curve.doubt is not None:
            label += f"; at 95 % {_shift_text(curve.doubt.answer_mm)}"
            axes.stairs(
                curve.doubt.unsure,
                curve.shift_mm,
                baseline=None,
                color=colour,
                linewidth=0.9,
                linestyle=":",
            )
            if np.isfinite(curve.doubt.answer_mm):
                axes.plot(
                    [curve.doubt.answer_mm],
                    [0.0],
                    marker,
                    color=colour,
                    markerfacecolor="white",
                    **_AT_FOOT,
                )
        axes.stairs(
            curve.violated,
            curve.shift_mm,
            baseline=None,
            color=colour,
            linewidth=width,
            label=label,
        )
        axes.stairs(
            curve.at_most,
            curve.shift_mm,
            baseline=curve.violated,
            fill=True,
            color=colour,
            alpha=0.3,
            linewidth=0,
        )
    axes.set_xlabel("moved by, mm")
    axes.set_ylabel("frames that violate")
    axes.set_ylim(0.0, max(1.05 * most, 1.0))
    axes.set_xlim(float(curves[0].shift_mm[0]), float(curves[0].shift_mm[-1]))
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(color="#DDDDDD", linewidth=0.5)
    axes.set_axisbelow(True)
    title_of_legend = "smallest shift that no frame violates"
    if any(curve.doubt is not None for curve in curves):
        title_of_legend += "\ndotted, hollow: the same at 95 %, as outlines and cameras err"
    axes.legend(title=title_of_legend, fontsize=8, title_fontsize=8)
    figure.suptitle("\n".join(textwrap.wrap(title, 100)), fontsize=10)
    return figure


def _shift_text(shift_mm: float) -> str:
    return "none is free" if np.isnan(shift_mm) else f"{shift_mm:.1f} mm"
