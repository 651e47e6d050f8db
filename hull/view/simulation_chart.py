"""A simulation against time: energy, and how deep real things were in virtual ones."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hybridve.hull.view.chart import refuse_suffix, save_figure

_ENERGY, _GIVEN, _DEPTH, _MET = "#0072B2", "#009E73", "#D55E00", "#E69F00"

#: Width of the picture, height of an effect's panel, and of all around the panels, inches.
_WIDTH_IN, _PANEL_IN, _AROUND_IN = 12.5, 2.0, 1.3


@dataclass(frozen=True, slots=True, eq=False)
class EffectCurve:
    """One effect, F frames.

    Attributes
    ----------
    name : str
        What it is called.
    time_s : (F,) float64
        When.
    energy_j, given_j : (F,) float64
        Its energy, and what real things have put in so far beside what it began with.
    penetration_mm : (F,) float64
        The deepest after a step.
    is_met : (F,) bool
        Whether something real touched it since the frame before.
    """

    name: str
    time_s: NDArray[np.float64]
    energy_j: NDArray[np.float64]
    given_j: NDArray[np.float64]
    penetration_mm: NDArray[np.float64]
    is_met: NDArray[np.bool_]


def write_effects(path: Path, curves: Sequence[EffectCurve], *, title: str) -> None:
    """Draw energy and penetration against time, one panel an effect, into a picture.

    It appears only when it is complete.

    Raises
    ------
    ReportError
        If it cannot be written.
    ValueError
        If the name has another ending than .png, .svg or .pdf.
    """
    refuse_suffix(path)
    figure = Figure(figsize=(_WIDTH_IN, _AROUND_IN + _PANEL_IN * len(curves)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(curves), 1, sharex=True, squeeze=False)[:, 0]
    every: list[Axes] = []
    for axes, curve in zip(panels, curves, strict=True):
        every += [axes, _draw(axes, curve)]
    handles = {
        label: handle
        for axes in every
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    panels[-1].set_xlabel("seconds from the session's first frame")
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles), fontsize=8
    )
    figure.suptitle("\n".join(textwrap.wrap(title, 110)), fontsize=10)
    save_figure(figure, path)


def _draw(axes: Axes, curve: EffectCurve) -> Axes:
    """Draw one effect, and return the axes of its depths."""
    time_s = curve.time_s
    axes.plot(time_s, curve.energy_j, color=_ENERGY, linewidth=1.2, label="energy")
    axes.plot(
        time_s,
        curve.given_j,
        color=_GIVEN,
        linewidth=1.0,
        linestyle="--",
        label="what it began with, and what real things put in",
    )
    half_s = 0.5 * float(np.diff(time_s).min()) if len(time_s) > 1 else 0.5
    edges = np.flatnonzero(np.diff(np.concatenate([[False], curve.is_met, [False]])))
    for number, (first, after) in enumerate(edges.reshape(-1, 2)):
        axes.axvspan(
            time_s[first] - half_s,
            time_s[after - 1] + half_s,
            color=_MET,
            alpha=0.18,
            linewidth=0,
            label="" if number else "touched",
        )
    axes.set_ylabel("energy, J", color=_ENERGY)
    axes.set_xlim(time_s[0] - half_s, time_s[-1] + half_s)
    axes.set_title(curve.name, fontsize=9, loc="left")
    axes.grid(color="#DDDDDD", linewidth=0.5)
    depth: Axes = axes.twinx()
    depth.plot(
        time_s,
        curve.penetration_mm,
        color=_DEPTH,
        linewidth=0.9,
        label="deepest in the hull after a step",
    )
    depth.set_ylabel("mm", color=_DEPTH)
    depth.set_ylim(bottom=0)
    return depth
