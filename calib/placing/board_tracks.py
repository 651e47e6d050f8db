"""What a camera saw of boards that move, frame by frame, and between frames."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations, Sighting, is_seen

#: A view is off its path if its corners, in the median, are further from a cubic through four
#: frames around it than all of these: so many times what the best tenth are (the noise), so much of
#: a step from frame to frame (a swing to and fro within 6 frames), and pixels.
_USUAL = 0.1
_JUMP_USUAL = 20.0
_JUMP_STEPS = 0.15
_JUMP_PX = 1.0

#: Views of the path are looked for so many frames away, and must have so many points in common. By
#: `_PATH_GAIN` the variance of noise grows where a view is compared with its four neighbours; where
#: noise grows more, up to so many times more is allowed for.
_PATH_REACH = 8
_PATH_POINTS = 4
_PATH_GAIN = 1.0 + 34.0 / 36.0
_MAX_GAIN = 3.0

#: By board and instant the points that a camera saw: (N, 2), pixels or rays.
Tracks = dict[tuple[int, int], NDArray[np.float64]]


def noise_shares(
    observations: Sequence[Observations], offset_frames: Mapping[str, float]
) -> dict[str, float]:
    """Return by camera the variance of noise in `resampled` points, that in its frames being 1.

    Interpolated points are less noisy than those of frames, but neighbours share their noise: all
    together they tell no more than the frames do. Where they are taken for independent, as all
    pictures are, their noise must be taken to be that of the frames.

    Parameters
    ----------
    observations : sequence of Observations
        What the cameras saw, not resampled.
    offset_frames : mapping of str to float
        As for `resampled`.
    """
    spacing = spacing_of([tracks_of(seen.sightings) for seen in observations])
    shares = {}
    for seen in observations:
        offset = offset_frames.get(seen.name, 0.0)
        is_moved = not seen.is_still and np.isfinite(offset)
        weights, _ = cubic((-offset / spacing) % 1.0 if is_moved else 0.0)
        shares[seen.name] = float((weights**2).sum())
    return shares


@dataclass(frozen=True, slots=True, eq=False)
class Interpolated:
    """Points (N, 2) between frames, their speed a frame, and what becomes of noise in both.

    The points are the sum of those in `frames`, by `weights`. Noise of variance 1 in the frames
    becomes `noise` in the points, `speed_noise` in the speed, and makes the two covary by
    `common_noise`.
    """

    points: NDArray[np.float64]
    speed: NDArray[np.float64]
    frames: tuple[int, ...]
    weights: NDArray[np.float64]
    noise: float
    speed_noise: float
    common_noise: float


def tracks_of(sightings: Sequence[Sighting]) -> Tracks:
    """Return by board and instant what was seen in the clip."""
    return {(s.board, s.instant): s.pixels for s in sightings if s.instant is not None}


def listed_alike(boards: Sequence[Board], tracks: Tracks, spacing: int) -> Tracks:
    """List boards that look the same when turned from frame to frame by the same end."""
    found: Tracks = {}
    for board, instant in sorted(tracks):
        pixels, looks = tracks[board, instant], boards[board].looks
        before = found.get((board, instant - spacing))
        if before is not None and len(looks) > 1:
            moved = [_mean_distance(pixels[look], before) for look in looks]
            pixels = pixels[looks[int(np.argmin(moved))]]
        found[board, instant] = pixels
    return found


def _mean_distance(pixels: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    both = is_seen(pixels) & is_seen(others)
    if not both.any():
        return np.inf
    return float(np.linalg.norm(pixels[both] - others[both], axis=1).mean())


def spacing_of(tracks: Sequence[Tracks]) -> int:
    """Return how many frames lie between neighbouring instants."""
    instants = sorted({instant for seen in tracks for _, instant in seen})
    return min((b - a for a, b in pairwise(instants)), default=1)


def jumped_keys(tracks: Tracks, spacing: int) -> set[tuple[int, int]]:
    """Return the views, by board and instant, that are off the path of those around them."""
    jumped: set[tuple[int, int]] = set()
    for board in sorted({board for board, _ in tracks}):
        path = {instant: tracks[b, instant] for b, instant in sorted(tracks) if b == board}
        jumped |= {(board, instant) for instant in _off_path(path, spacing)}
    return jumped


def _off_path(path: Mapping[int, NDArray[np.float64]], spacing: int) -> set[int]:
    """Return the instants of a path at which the board was found elsewhere.

    A view between two frames before and two behind is on the path if it lies on the cubic through
    them. Of the others, most only have a neighbour that is off: they are on the path if they lie
    on the cubic through the nearest views that are. What cannot be judged stays.
    """
    around = [step * spacing for step in (-2, -1, 1, 2)]
    misses = {}
    for instant in path:
        nodes = tuple(instant + step for step in around)
        if all(node in path for node in nodes):
            misses[instant] = _miss(path, instant, nodes)
    found = [miss.length_px for miss in misses.values() if miss is not None]
    if not found:
        return set()
    least_px = max(_JUMP_USUAL * float(np.quantile(found, _USUAL)), _JUMP_PX)
    on = {t for t, miss in misses.items() if miss is not None and miss.is_small(least_px)}
    again: dict[tuple[int, ...], _Miss | None] = {}
    while True:
        best: tuple[float, int] | None = None
        for instant in sorted(path.keys() - on):
            near = [node for node in on if abs(node - instant) <= _PATH_REACH * spacing]
            if len(near) < len(around):
                continue
            nearest = sorted((abs(node - instant), node) for node in near)[: len(around)]
            nodes = tuple(sorted(node for _, node in nearest))
            if (instant, *nodes) not in again:
                again[instant, *nodes] = _miss(path, instant, nodes)
            misses[instant] = miss = again[instant, *nodes]
            if miss is not None and miss.is_small(least_px):
                best = (miss.gain, instant) if best is None else min(best, (miss.gain, instant))
        if best is None:
            return {t for t, miss in misses.items() if miss is not None and t not in on}
        on.add(best[1])  # the surest first: it may show others to be off


@dataclass(frozen=True, slots=True)
class _Miss:
    """By how much a view misses a cubic through four others, median over its points, pixels.

    `gain` says by how much more than between neighbours noise and acceleration show, `step_px` how
    far points move from frame to frame.
    """

    length_px: float
    gain: float
    step_px: float

    def is_small(self, least_px: float) -> bool:
        limit_px = max(least_px, _JUMP_STEPS * self.step_px)
        return self.length_px <= min(self.gain, _MAX_GAIN) * limit_px


def _miss(
    path: Mapping[int, NDArray[np.float64]], instant: int, nodes: Sequence[int]
) -> _Miss | None:
    """Compare a view with four others; None where they have few points in common."""
    weights = np.ones(len(nodes))
    for index, node in enumerate(nodes):
        for other in nodes:
            if other != node:
                weights[index] *= (instant - other) / (node - other)
    frames = np.stack([path[node] for node in nodes])
    missed = np.tensordot(weights, frames, axes=1) - path[instant]
    common = is_seen(missed)
    if common.sum() < _PATH_POINTS:
        return None
    steps = np.linalg.norm(np.median(np.diff(frames[:, common], axis=0), axis=1), axis=1)
    return _Miss(
        float(np.linalg.norm(np.median(missed[common], axis=0))),
        float(np.sqrt((1.0 + (weights**2).sum()) / _PATH_GAIN)),
        float(np.median(steps / np.diff(nodes))),
    )


def interpolated(tracks: Tracks, board: int, time: float, spacing: int) -> Interpolated | None:
    """Return a board's points at a time between frames; None unless four frames around show it.

    Points that are not seen in all four are NaN. At a frame itself its own points are returned,
    without speed where the frames around do not show the board.
    """
    phase = next((instant % spacing for b, instant in tracks if b == board), 0)
    first = int(np.floor((time - phase) / spacing)) * spacing + phase
    nodes = [first + step * spacing for step in (-1, 0, 1, 2)]
    if any((board, node) not in tracks for node in nodes):
        if time != first or (board, first) not in tracks:
            return None
        alone = tracks[board, first]
        return Interpolated(alone, np.zeros_like(alone), (first,), np.ones(1), 1.0, 0.0, 0.0)
    weights, slopes = cubic((time - first) / spacing)
    frames = np.stack([tracks[board, node] for node in nodes])
    return Interpolated(
        np.tensordot(weights, frames, axes=1),
        np.tensordot(slopes, frames, axes=1) / spacing,
        tuple(nodes),
        weights,
        float((weights**2).sum()),
        float((slopes**2).sum()) / spacing**2,
        float((weights * slopes).sum()) / spacing,
    )


def cubic(share: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the weights (4,) of frames at -1, 0, 1, 2 for a cubic at `share`, and of its slope."""
    polynomials = np.array(  # Lagrange's, by powers of the share
        [
            [0.0, -1.0 / 3.0, 0.5, -1.0 / 6.0],
            [1.0, -0.5, -1.0, 0.5],
            [0.0, 1.0, 0.5, -0.5],
            [0.0, -1.0 / 6.0, 0.0, 1.0 / 6.0],
        ]
    )
    powers = share ** np.arange(4.0)
    slopes = np.array([0.0, 1.0, 2.0 * share, 3.0 * share**2])
    return polynomials @ powers, polynomials @ slopes
