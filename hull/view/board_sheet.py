"""A board to be printed, to scale, with a scale bar to check the print by.

A page is as large as its board, with a white margin around and a strip below for the scale bar and
what the board is. What is drawn are lines and rectangles, no pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as File

import numpy as np
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board
from hybridve.calib.boards.printed import printed_board
from hybridve.calib.errors import ReportError
from hybridve.calib.files import sink
from hybridve.hull.places import MARK

_MM_PER_INCH = 25.4

#: White around a board: as much as a square, so that its outer corners are found, within bounds.
_MARGIN_MM = (10.0, 40.0)

#: Height of the strip below, and lengths that its bar may have.
_STRIP_MM = 16.0
_BARS_MM = (100.0, 50.0, 20.0, 10.0)


@dataclass(frozen=True, slots=True, eq=False)
class BoardPage:
    """A page with a board on it.

    Attributes
    ----------
    figure : Figure
        The page, in its true size.
    width_mm, height_mm : float
        Of the page.
    left_mm, bottom_mm : float
        Where the origin of the board's frame is on it, from its lower left corner.
    bar_mm : float
        The length of the scale bar.
    """

    figure: Figure
    width_mm: float
    height_mm: float
    left_mm: float
    bottom_mm: float
    bar_mm: float


def draw_board(board: Board) -> BoardPage:
    """Return a page with a board, to scale."""
    printed = printed_board(board)
    margin_mm = float(np.clip(1e3 * board.square_m, *_MARGIN_MM))
    low_mm, high_mm = 1e3 * printed.low_board, 1e3 * printed.high_board
    size_mm = high_mm - low_mm
    width_mm = float(size_mm[0]) + 2 * margin_mm
    height_mm = float(size_mm[1]) + 2 * margin_mm + _STRIP_MM
    bar_mm = next((bar for bar in _BARS_MM if bar <= size_mm[0]), _BARS_MM[-1])
    origin_mm = np.array([margin_mm, margin_mm + _STRIP_MM]) - low_mm
    figure = Figure(figsize=(width_mm / _MM_PER_INCH, height_mm / _MM_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(0.0, width_mm)
    axes.set_ylim(0.0, height_mm)
    axes.set_axis_off()
    # One outline of many parts: filled one by one, neighbours would show seams on a screen.
    axes.add_patch(
        PathPatch(_outline(1e3 * printed.dark_board, origin_mm), fc="black", ec="none", snap=False)
    )
    bar_y_mm = 0.5 * margin_mm + 6.0
    axes.plot([margin_mm, margin_mm + bar_mm], [bar_y_mm] * 2, color="black", lw=0.8)
    for x_mm in (margin_mm, margin_mm + bar_mm):
        axes.plot([x_mm] * 2, [bar_y_mm - 2.0, bar_y_mm + 2.0], color="black", lw=0.8)
    text = f"{bar_mm:g} mm between the ends: measure it.  {board}"
    room_mm = width_mm - 2 * margin_mm
    # A character is some 0.55 of its height wide; a point is 0.353 mm.
    size_pt = min(9.0, room_mm / (0.55 * 0.353 * len(text)))
    axes.text(margin_mm, bar_y_mm - 3.0, text, fontsize=size_pt, va="top", ha="left")
    return BoardPage(figure, width_mm, height_mm, float(origin_mm[0]), float(origin_mm[1]), bar_mm)


def _outline(dark_mm: NDArray[np.float64], origin_mm: NDArray[np.float64]) -> Path:
    """Return rectangles (N, 4) as the outline of all, each closed."""
    low = dark_mm[:, None, :2] + origin_mm
    turns = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    corners = low + turns * dark_mm[:, None, 2:]  # (N, 5, 2)
    codes = [Path.MOVETO, Path.LINETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY]
    return Path(corners.reshape(-1, 2), codes * len(dark_mm))


def write_boards(path: File, boards: Sequence[Board]) -> list[BoardPage]:
    """Write a PDF with a page for each board; it appears only when it is complete.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    pages = [draw_board(board) for board in boards]
    try:
        with sink(path) as out, PdfPages(out, metadata={"Creator": MARK}) as file:
            for page in pages:
                file.savefig(page.figure)
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error}") from error
    return pages
