"""Silhouettes of all frames as curves: how large they are, and how far the cameras agree."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hybridve.hull.view.chart import STYLES

#: Size of a panel, and what is around it, inches.
_WIDTH_IN, _PANEL_IN, _AROUND_IN = 11.0, 1.15, 0.75


def draw_silhouettes(
    names: Sequence[str],
    time_s: NDArray[np.float64],
    shares: NDArray[np.float64],
    supported: NDArray[np.float64],
    marked: Sequence[int],
) -> Figure:
    """Return a panel a camera: the share of its picture that is object, and what others support.

    Parameters
    ----------
    names : sequence of C str
        The cameras.
    time_s : (F,) float64
        When the frames were recorded, seconds.
    shares : (F, C) float64
        Object pixels by pixels; NaN where there is no silhouette.
    supported : (F, C) float64
        Of the object's rays those that the other cameras support; NaN where nobody can tell.
    marked : sequence of int
        Frames that are to stand out.
    """
    figure = Figure(figsize=(_WIDTH_IN, _AROUND_IN + _PANEL_IN * len(names)), layout="constrained")
    FigureCanvasAgg(figure)
    panels: list[Axes] = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0].tolist()
    for number, (axes, name) in enumerate(zip(panels, names, strict=True)):
        colour, _ = STYLES[number % len(STYLES)]
        axes.plot(time_s, 100.0 * shares[:, number], color=colour, linewidth=1.2)
        axes.set_ylabel(f"{name}\nobject, %", fontsize=8)
        known = shares[np.isfinite(shares[:, number]), number]
        axes.set_ylim(0.0, 115.0 * max(float(known.max()), 1e-4) if len(known) else 1.0)
        axes.grid(color="#DDDDDD", linewidth=0.5)
        axes.tick_params(labelsize=8)
        for frame in marked:
            axes.axvline(time_s[frame], color="#B00020", linewidth=0.7, linestyle=":")
        if np.isfinite(supported[:, number]).any():
            beside = axes.twinx()
            beside.plot(time_s, 100.0 * supported[:, number], color="#777777", linewidth=0.8)
            beside.set_ylim(0.0, 105.0)
            beside.set_ylabel("supported, %", fontsize=8, color="#555555")
            beside.tick_params(labelsize=8, colors="#555555")
    panels[-1].set_xlabel("seconds from the session's first frame", fontsize=8)
    return figure
