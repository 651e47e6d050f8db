"""Whether a chessboard goes on beyond the corners that were asked for.

A search for a smaller chessboard finds one somewhere within a larger, in another place from picture
to picture, and nothing in those corners says so. What says it is the next line of them: beyond the
last inner corners of a board there is one square, and then its margin; never another crossing.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

#: How many lines further are looked for on each side.
_MOST_LINES = 8

#: The next line is where the homography of so many lines before it has it: near the edge, where a
#: lens bends the board most.
_LINES_BEFORE = 3

#: Squares are sampled so far from a corner (in squares) in x and in y, over a blur of this share.
_SAMPLED_AT = 0.3
_BLUR = 0.12

#: Both neighbours of a corner differ by at least this share of what squares of the board differ by.
_CONTRAST = 0.5

#: Corners of a line that goes on are drawn onto the picture from within this share of a square.
_DRAWN_FROM = 0.3

#: A line goes on if so many of its corners that are in the picture look like crossings, of at least
#: this share of the line.
_CROSSINGS = 0.8
_IN_PICTURE = 0.6


def lines_beyond(grey: NDArray[np.float32], grid_px: NDArray[np.float64]) -> tuple[int, int]:
    """Return how many columns and rows of inner corners lie beyond those that were found.

    Parameters
    ----------
    grey : (H, W) float32
        The picture, 0 to 255.
    grid_px : (rows, columns, 2) float64
        The corners that were found, pixel centre at 0.5.

    Returns
    -------
    columns, rows : int
        Of both sides together; 0, 0 where the board ends as it was described.
    """
    # Most boards end where they should: the picture next to them tells, and is quickly smoothed.
    if _looked_for(grey, grid_px, 1) == (0, 0):
        return 0, 0
    return _looked_for(grey, grid_px, _MOST_LINES)


def _looked_for(
    grey: NDArray[np.float32], grid_px: NDArray[np.float64], most_lines: int
) -> tuple[int, int]:
    """Return how many columns and rows go on, up to so many on each side."""
    steps_px = [np.linalg.norm(np.diff(grid_px, axis=axis), axis=-1) for axis in (0, 1)]
    blur_px = _BLUR * min(float(np.median(steps)) for steps in steps_px)
    height, width = grey.shape
    # Only what lies around the board is smoothed.
    reach_px = 2.0 * (most_lines + _SAMPLED_AT) * max(float(steps.max()) for steps in steps_px)
    low = np.maximum(np.floor(grid_px.min(axis=(0, 1)) - reach_px), 0).astype(int)
    high = np.minimum(np.ceil(grid_px.max(axis=(0, 1)) + reach_px), (width, height)).astype(int)
    around = grey[low[1] : high[1], low[0] : high[0]]
    smooth = np.asarray(cv2.GaussianBlur(around, (0, 0), max(blur_px, 0.3)), np.float32)
    grid = grid_px - low
    upright = grid.transpose(1, 0, 2)
    rows = _lines_after(smooth, grid, most_lines) + _lines_after(smooth, grid[::-1], most_lines)
    columns = _lines_after(smooth, upright, most_lines) + _lines_after(
        smooth, upright[::-1], most_lines
    )
    return columns, rows


def _lines_after(smooth: NDArray[np.float32], grid_px: NDArray[np.float64], most_lines: int) -> int:
    """Return how many lines (rows of the grid) come after the last."""
    lines = list(grid_px)
    length = len(lines[0])
    img_from_lines = _img_from_lines(lines)
    if img_from_lines is None:
        return 0
    inner, outer, _ = _across(smooth, img_from_lines, length, 0)
    # At a crossing, neighbours differ one way on this side of the line, the other way beyond it.
    signs = np.where(np.arange(len(inner)) % 2 == 0, 1.0, -1.0)
    known = np.isfinite(inner - outer)
    if not known.any():
        return 0
    step = float(np.median((signs * (inner - outer))[known])) / 2
    signs *= np.sign(step)
    for count in range(most_lines):
        if count > 0:
            img_from_lines = _img_from_lines(lines)
        if img_from_lines is None:
            return count
        inner, outer, places = _across(smooth, img_from_lines, length, 1)
        signs = -signs
        inside = np.isfinite(inner) & np.isfinite(outer)
        is_crossing = (signs * inner > _CONTRAST * abs(step)) & (
            -signs * outer > _CONTRAST * abs(step)
        )
        if inside.sum() < max(3, _IN_PICTURE * len(inside)):
            return count
        if is_crossing[inside].mean() < _CROSSINGS or not np.isfinite(places).all():
            return count
        lines.append(_drawn(smooth, places, lines[-1]))
    return most_lines


def _drawn(
    smooth: NDArray[np.float32], places: NDArray[np.float64], before: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return corners (N, 2) drawn from where they are expected to where they are."""
    steps_px = [
        np.linalg.norm(places - before, axis=1),
        np.linalg.norm(np.diff(places, axis=0), axis=1),
    ]
    half = max(1, int(_DRAWN_FROM * min(float(steps.min()) for steps in steps_px)))
    start = np.ascontiguousarray(places - 0.5, np.float32).reshape(-1, 1, 2)
    height, width = smooth.shape
    inside = ((start >= half + 2) & (start < (width - half - 3, height - half - 3))).all(
        axis=(1, 2)
    )
    if not inside.any():
        return places
    enough = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 0.02)
    moved = cv2.cornerSubPix(smooth, start[inside], (half, half), (-1, -1), enough)
    drawn = places.copy()
    drawn[inside] = moved.reshape(-1, 2) + 0.5
    is_near = np.linalg.norm(drawn - places, axis=1) <= half
    return np.where(is_near[:, None], drawn, places)


def _img_from_lines(lines_px: list[NDArray[np.float64]]) -> NDArray[np.float64] | None:
    """Return the homography of the last lines, which has the last of them at y = 0."""
    before = np.array(lines_px[-_LINES_BEFORE:])
    x, y = np.meshgrid(np.arange(before.shape[1]), np.arange(1 - len(before), 1))
    plane = np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float64)
    found, _ = cv2.findHomography(plane, before.reshape(-1, 2))
    matrix = np.asarray(found, np.float64)
    return matrix if matrix.shape == (3, 3) else None  # OpenCV's None has no shape


def _across(
    smooth: NDArray[np.float32], img_from_lines: NDArray[np.float64], length: int, after: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Compare the four squares around each corner of a line so many after the last.

    Returned are how much brighter the next square is than the one before along the line, on this
    side of it and beyond, (N,), NaN outside the picture; and where the corners are, (N, 2).
    """
    middles = np.column_stack([np.arange(length, dtype=float), np.full(length, float(after))])
    offsets = _SAMPLED_AT * np.array([[0, 0], [-1, -1], [1, -1], [-1, 1], [1, 1]])
    wanted = (middles + offsets[:, None]).reshape(-1, 2)
    mapped = wanted @ img_from_lines[:, :2].T + img_from_lines[:, 2]
    mapped[mapped[:, 2] <= 0] = np.nan
    places = (mapped[:, :2] / mapped[:, 2:]).reshape(5, length, 2)
    height, width = smooth.shape
    inside = np.all((places > 1) & (places < (width - 1, height - 1)), axis=-1)
    at = np.where(inside[..., None], places, 1.0).astype(np.float32) - np.float32(0.5)
    sampled = cv2.remap(
        smooth,
        np.ascontiguousarray(at[..., 0]),
        np.ascontiguousarray(at[..., 1]),
        cv2.INTER_LINEAR,
    )
    grey = np.where(inside, sampled, np.nan)
    return grey[2] - grey[1], grey[4] - grey[3], places[0]
