"""Figures of a calibration's certificate: what each camera saw, the error in space, the cameras.

All are vector graphics with text as outlines, so that they look the same everywhere; what would
be thousands of marks is put in as an image. Positions are given, not solved for: a page has one
figure a camera, and a layout engine would draw each of them twice.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.judging.certificate import SeenPoints, Volume, image_errors
from hybridve.calib.rig import Rig
from hybridve.hull.view.chart_marks import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    RED,
    draw_iso_lines,
    halo,
    new_figure,
    nice,
    short_text,
)

#: Cells across and down an image: those in which `hybridve.calib.judging.certificate.coverage`
#: counts.
CELLS = (8, 6)

#: More points than this are drawn as means over cells, so that what they have in common shows.
_MOST_ARROWS = 250

#: Cells of such means along the longer side of an image, and the fewest points of one.
_MEAN_CELLS, _FEWEST = 16, 3

#: Chi-squared with two degrees of freedom exceeds this once in 1000.
_ONE_IN_1000 = 13.8

#: Residuals smaller than this are those of rounding.
_NOTHING_PX = 1e-9

#: Residuals further out than this many standard deviations are counted, not drawn.
_HISTOGRAM_END = 5.0


def draw_camera(rig: Rig, index: int, seen: SeenPoints, noise_px: float, volume: Volume) -> Figure:
    """Return coverage, residual vectors and their histogram of one camera.

    Parameters
    ----------
    rig : Rig
        With its covariance.
    index : int
        The camera.
    seen : SeenPoints
        What it saw; rows that are not finite are left out.
    noise_px : float
        Standard deviation of a coordinate that residuals are compared with.
    volume : Volume
        Gives the distance at which the error within the image is drawn.
    """
    camera = rig.cameras[index]
    finite = np.isfinite(seen.pixels).all(axis=1) & np.isfinite(seen.residuals_px).all(axis=1)
    pixels, residuals_px = seen.pixels[finite], seen.residuals_px[finite]
    figure = new_figure(11.0, 3.5)
    covered = figure.add_axes((0.005, 0.1, 0.375, 0.79))
    missed = figure.add_axes((0.395, 0.1, 0.375, 0.79))
    spread = figure.add_axes((0.8, 0.2, 0.185, 0.65))
    for axes in (covered, missed):
        axes.set_xlim(0, camera.width_px)
        axes.set_ylim(camera.height_px, 0)
        axes.set_aspect("equal")
        axes.set_xticks([])
        axes.set_yticks([])
    _draw_coverage(covered, camera, pixels)
    _draw_image_errors(covered, rig.only([camera.name]), volume)
    _draw_residuals(missed, camera, pixels, residuals_px, noise_px)
    _draw_histogram(spread, residuals_px, noise_px)
    return figure


def cell_counts(camera: Camera, pixels: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return how many of the pixels (K, 2) lie in each cell of an image: (rows, columns)."""
    cells = np.floor(pixels / (camera.width_px, camera.height_px) * CELLS).astype(int)
    inside = ((cells >= 0) & (cells < CELLS)).all(axis=1)
    counts = np.zeros((CELLS[1], CELLS[0]), dtype=np.intp)
    np.add.at(counts, (cells[inside, 1], cells[inside, 0]), 1)
    return counts


def _draw_coverage(axes: Axes, camera: Camera, pixels: NDArray[np.float64]) -> None:
    counts = cell_counts(camera, pixels)
    width, height = camera.width_px / CELLS[0], camera.height_px / CELLS[1]
    for row, column in np.argwhere(counts == 0):
        axes.add_patch(
            Rectangle(
                (column * width, row * height),
                width,
                height,
                facecolor="#E4E4E4",
                edgecolor="#B8B8B8",
                hatch="//",
                linewidth=0.0,
            )
        )
    for column in range(1, CELLS[0]):
        axes.axvline(column * width, color=GREY, linewidth=0.5)
    for row in range(1, CELLS[1]):
        axes.axhline(row * height, color=GREY, linewidth=0.5)
    size = float(np.clip(120.0 / np.sqrt(max(1, len(pixels))), 1.2, 4.0))
    axes.plot(
        *pixels.T, "o", markersize=size, color=BLUE, alpha=0.6, markeredgewidth=0, rasterized=True
    )
    full = int((counts > 0).sum())
    axes.set_title(
        f"{len(pixels)} points in {full} of {counts.size} cells, the others hatched", fontsize=9
    )
    if not len(pixels):
        _say(axes, "saw no point of a board")


def _say(axes: Axes, text: str) -> None:
    axes.text(
        *(0.5, 0.5, text),
        transform=axes.transAxes,
        ha="center",
        va="center",
        fontsize=10,
        color=RED,
        path_effects=halo(4.0),
    )


def _draw_image_errors(axes: Axes, alone: Rig, volume: Volume) -> None:
    """Draw lines of equal 95 % error of the image over it."""
    pixels, errors_px = image_errors(alone, volume)
    side = round(np.sqrt(len(pixels)))
    shape = (side, side)
    drawn = draw_iso_lines(
        axes,
        pixels[:, 0].reshape(shape),
        pixels[:, 1].reshape(shape),
        errors_px.reshape(shape),
        4,
        colour=ORANGE,
    )
    known = "lines: its image is known to so many px, 95 %"
    if drawn is None and np.isfinite(errors_px).any():
        known = f"its image is known to {short_text(float(np.nanmedian(errors_px)))} px, 95 %"
    axes.set_xlabel(known, fontsize=8, color=ORANGE)


def _draw_residuals(
    axes: Axes,
    camera: Camera,
    pixels: NDArray[np.float64],
    residuals_px: NDArray[np.float64],
    noise_px: float,
) -> None:
    places, means, counts, step_px = binned_means(camera, pixels, residuals_px)
    lengths = np.linalg.norm(means, axis=1)
    is_binned = len(places) > 0 and len(pixels) > _MOST_ARROWS
    what = "mean residuals" if is_binned else "residuals"
    if not len(places) or lengths.max() < _NOTHING_PX:
        axes.set_title(what, fontsize=9)
        _say(axes, "no residuals" if not len(places) else "all residuals are zero")
        return
    times = nice(0.9 * step_px / float(np.quantile(lengths, 0.9)))
    systematic = np.zeros(len(places), np.bool_)
    if is_binned and noise_px > 0:
        systematic = counts * lengths**2 > _ONE_IN_1000 * noise_px**2
    for chosen, colour in ((~systematic, BLUE), (systematic, ORANGE)):
        if chosen.any():
            axes.quiver(
                *places[chosen].T,
                *means[chosen].T,
                color=colour,
                angles="xy",
                scale_units="xy",
                scale=1.0 / times,
                units="width",
                width=0.0035,
                headwidth=3.5,
                headlength=4.0,
                minlength=0.5,
            )
    axes.set_title(f"{what} (observed - projected), {times:g} times as long", fontsize=9)
    # The scale bar stands below the image, with what the colours mean.
    known_px = nice(0.12 * camera.width_px / times)
    note = f"= {known_px:g} px"
    if is_binned and noise_px > 0:
        times_noise = np.sqrt((counts * lengths**2).mean() / 2.0) / noise_px
        note += f"   |   {times_noise:.1f} times those of noise alone; orange: not noise"
    axes.set_xlabel(note, fontsize=8, color=INK, x=0.16, ha="left")
    axes.annotate(
        "",
        (0.14, -0.045),
        (0.14 - known_px * times / camera.width_px, -0.045),
        xycoords="axes fraction",
        annotation_clip=False,
        arrowprops={"arrowstyle": "->", "color": INK, "shrinkA": 0, "shrinkB": 0},
    )


def binned_means(
    camera: Camera, pixels: NDArray[np.float64], residuals_px: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.intp], float]:
    """Return the residuals to draw: each, or where there are many their means over cells.

    Parameters
    ----------
    camera : Camera
        Whose image it is.
    pixels, residuals_px : (K, 2) float64
        Finite.

    Returns
    -------
    places_px, means_px : (B, 2) float64
        Where arrows start, and the arrows.
    counts : (B,) int
        Points of each.
    step_px : float
        How far the arrows are apart, about.
    """
    step_px = max(camera.width_px, camera.height_px) / _MEAN_CELLS
    if len(pixels) <= _MOST_ARROWS:
        return pixels, residuals_px, np.ones(len(pixels), dtype=np.intp), step_px
    cells, member, counts = np.unique(
        np.floor(pixels / step_px).astype(int), axis=0, return_inverse=True, return_counts=True
    )
    sums, middles = np.zeros((len(cells), 2)), np.zeros((len(cells), 2))
    np.add.at(sums, member.ravel(), residuals_px)
    np.add.at(middles, member.ravel(), pixels)
    enough = counts >= _FEWEST
    per_cell = counts[enough, None]
    return middles[enough] / per_cell, sums[enough] / per_cell, counts[enough], step_px


def _draw_histogram(axes: Axes, residuals_px: NDArray[np.float64], noise_px: float) -> None:
    axes.set_title("residuals, x and y", fontsize=9)
    axes.set_yticks([])
    axes.tick_params(labelsize=8)
    axes.set_xlim(-_HISTOGRAM_END, _HISTOGRAM_END)
    for side in ("left", "top", "right"):
        axes.spines[side].set_visible(False)
    values = residuals_px.ravel()
    if not len(values):
        return
    unit_px = noise_px if noise_px > _NOTHING_PX else float(values.std())
    if unit_px < _NOTHING_PX:
        return
    scaled = values / unit_px
    edges = np.linspace(-_HISTOGRAM_END, _HISTOGRAM_END, 41)
    density = np.histogram(scaled, edges)[0] / (len(scaled) * np.diff(edges))
    axes.stairs(density, edges, fill=True, color=BLUE, alpha=0.5)
    x = np.linspace(-_HISTOGRAM_END, _HISTOGRAM_END, 101)
    axes.plot(x, np.exp(-(x**2) / 2.0) / np.sqrt(2.0 * np.pi), color=INK, linewidth=1.2)
    beyond = int((np.abs(scaled) > _HISTOGRAM_END).sum())
    axes.set_xlabel(
        f"in units of {unit_px:.2g} px, the noise;\n"
        f"line: normal; beyond ±{_HISTOGRAM_END:g}: {beyond}",
        fontsize=8,
    )
    axes.set_ylim(bottom=0)
