"""What a step, or a viewport, costs a simulation: time against penetration, energy, distance."""

import textwrap
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from hybridve.hull.view.chart import refuse_suffix, save_figure

_INK, _LINE = "#333333", "#0072B2"


@dataclass(frozen=True, slots=True, eq=False)
class CostCurve:
    """V values, in the order in which they are joined.

    Attributes
    ----------
    labels : tuple of str
        What each is called.
    time_ms : (V,) float64
        Median time a frame.
    time_range_ms : (2, V) float64
        Quartiles of it.
    penetration_mm, excess_percent, distance_mm : (V,) float64
        What it costs.
    on_front, is_chosen : (V,) bool
        What nothing beats, and what is marked.
    """

    labels: tuple[str, ...]
    time_ms: NDArray[np.float64]
    time_range_ms: NDArray[np.float64]
    penetration_mm: NDArray[np.float64]
    excess_percent: NDArray[np.float64]
    distance_mm: NDArray[np.float64]
    on_front: NDArray[np.bool_]
    is_chosen: NDArray[np.bool_]


def write_cost(path: Path, curve: CostCurve, chosen: str, *, title: str, note: str) -> None:
    """Draw a curve into a picture, which appears only when it is complete.

    Parameters
    ----------
    path : Path
        A .png, .svg or .pdf.
    curve : CostCurve
        What is drawn.
    chosen : str
        What the marked value is.
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
    figure = Figure(figsize=(13.5, 4.8), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 3)
    for axes, values, label, has_front in zip(
        panels,
        (curve.distance_mm, curve.penetration_mm, curve.excess_percent),
        (
            "mm from the finest run, largest",
            "mm in the hull after a step, deepest",
            "energy that nothing real put in, %",
        ),
        (True, False, False),
        strict=True,
    ):
        _draw(axes, curve, values, label, chosen, has_front=has_front)
    figure.suptitle("\n".join([*textwrap.wrap(title, 120), note]), fontsize=10)
    save_figure(figure, path)


def _draw(
    axes: Axes,
    curve: CostCurve,
    values: NDArray[np.float64],
    label: str,
    chosen: str,
    *,
    has_front: bool,
) -> None:
    spread_ms = np.abs(curve.time_range_ms - curve.time_ms)
    axes.errorbar(
        curve.time_ms,
        values,
        xerr=spread_ms,
        color=_LINE,
        marker="o",
        markersize=5,
        capsize=2,
        linewidth=1.4,
    )
    for time_ms, value, text in zip(curve.time_ms, values, curve.labels, strict=True):
        axes.annotate(text, (time_ms, value), xytext=(5, 5), textcoords="offset points", fontsize=8)
    marked = curve.is_chosen
    axes.plot(
        curve.time_ms[marked],
        values[marked],
        linestyle="none",
        marker="*",
        markersize=15,
        markerfacecolor=_LINE,
        markeredgecolor=_INK,
        label=chosen,
    )
    if has_front:
        axes.plot(
            curve.time_ms[curve.on_front],
            values[curve.on_front],
            linestyle="none",
            marker="o",
            markersize=13,
            markerfacecolor="none",
            markeredgecolor=_INK,
            label="Pareto front",
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylim(bottom=0)
    axes.set_xlabel("ms a frame, median and quartiles")
    axes.set_ylabel(label)
    axes.grid(which="both", color="#DDDDDD", linewidth=0.5)
    axes.legend(fontsize=8, framealpha=0.9)
