"""What the charts of a certificate share: colours, levels, lines with their numbers."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

INK = "#333333"
GREY = "#DDDDDD"
BLUE, ORANGE, GREEN, RED = "#0072B2", "#D55E00", "#009E73", "#B00020"

#: A line of equal error has a label if it is longer than this share of the picture.
_LABELLED = 0.12


def nice(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step <= value / power * 1.000001))


def halo(width: float = 2.0) -> list[AbstractPathEffect]:
    """Return what keeps a text apart from what is drawn below it."""
    return [withStroke(linewidth=width, foreground="white")]


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure that needs no screen."""
    figure = Figure(figsize=(width_in, height_in))
    FigureCanvasAgg(figure)
    return figure


def short_text(value: float) -> str:
    """Return a number in three digits, without an exponent."""
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def draw_iso_lines(
    axes: Axes,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    values: NDArray[np.float64],
    n_levels: int,
    *,
    colour: str,
    levels: NDArray[np.float64] | None = None,
) -> QuadContourSet | None:
    """Draw labelled lines of equal value; none where the values are all the same or unknown."""
    known = values[np.isfinite(values)]
    if not len(known) or np.ptp(known) <= 1e-3 * known.max():
        return None
    if levels is None:
        levels = spread_levels(values, n_levels)
    levels = levels[(levels > known.min()) & (levels < known.max())]
    if not len(levels):
        return None
    lines = axes.contour(
        x, y, np.ma.masked_invalid(values), levels=levels, colors=colour, linewidths=0.9
    )
    # One label a level, on its longest piece: where the map is ragged there are many short ones.
    shortest = _LABELLED * max(float(np.ptp(x)), float(np.ptp(y)))
    places = []
    for pieces in lines.allsegs:
        lengths = [float(np.linalg.norm(np.diff(piece, axis=0), axis=1).sum()) for piece in pieces]
        if lengths and max(lengths) > shortest:
            piece = np.asarray(pieces[int(np.argmax(lengths))])
            # Of closed lines, below their middle; of others, halfway.
            closed = np.allclose(piece[0], piece[-1])
            at = int(piece[:, 1].argmin()) if closed else len(piece) // 2
            places.append((float(piece[at, 0]), float(piece[at, 1])))
    if places:
        labels = axes.clabel(lines, fmt=short_text, fontsize=7, inline=False, manual=places)
        for label in labels:
            label.set_path_effects(halo())
            label.set_clip_on(True)
    return lines


def spread_levels(values: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return round levels between the known values: even, or 1, 2, 3, 5 where they span much."""
    known = values[np.isfinite(values) & (values > 0)]
    if not len(known):
        return np.zeros(0)
    low, high = float(known.min()), float(np.quantile(known, 0.98))
    if high > 6.0 * low:
        powers = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(known.max())) + 1)
        levels = np.outer(powers, (1.0, 2.0, 3.0, 5.0)).ravel()
        return np.asarray(levels[levels <= high])
    return np.asarray(MaxNLocator(count).tick_values(low, high))
