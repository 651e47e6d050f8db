"""From a frame and the empty scene to the silhouette of what is new.

Each pixel is asked which explains it best: the empty scene with its noise, the empty scene in a
shadow, or an object, which can have any colour. The answer is its *evidence*: the logarithm of how
much likelier an object is than the better of the two others.

* *Noise* has three parts: what the pixel did over time in the empty scene, a floor in grey levels
  for compression, and a share of the brightness. A picture may also be off by a pixel
  (compression, a camera that was touched), so that a value is compared with the range of its
  neighbours in the empty scene and only what lies outside counts.
* *A shadow* darkens all channels by one factor, between two limits, and the pixels around it by
  much the same factor, so that the texture of the empty scene is still seen in it. A grey car on a
  grey road has the colour of a shadow, but not the texture. (A little light thrown back by an
  object is the same with a factor above 1.)
* *Objects* have a few colours each: those of the pixels that are objects beyond doubt are likelier
  than others elsewhere in the same frame, too.
* *The camera's gain* may have changed: the median of the ratio to the empty scene tells by how
  much, since objects fill less than half of the picture.

The evidence, limited in both directions, is summed over 3 x 3 pixels; objects are where the sum is
positive. Then gaps of a pixel are closed, specks dropped, and holes filled that are too small to
tell from a patch of an object that looks like what is behind it.

References
----------
Horprasert, Harwood and Davis, A statistical approach for real-time robust background subtraction
and shadow detection, ICCV Frame-Rate Workshop, 1999: brightness and chromaticity distortion.
Sanin, Sanderson and Lovell, Shadow detection: a survey and comparative evaluation of recent
methods, Pattern Recognition 45(4), 2012: texture tells grey objects from shadows.
"""

import math
import threading
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.calib.image_io import Image
from hybridve.hull.capture.background import Background
from hybridve.hull.capture.evidence import (
    EVIDENCE_LIMIT,
    SHADE_REACH_PX,
    as_byte,
    compare_with_background,
    weigh_evidence,
)
from hybridve.hull.jit import ZERO, compiled

#: About how many pixels the camera's gain looks at.
_GAIN_PIXELS = 2000

#: Pixels of the empty scene darker than this (grey levels) say nothing of the gain.
_GAIN_DARKEST = 16.0

#: A pixel that differs by more than this factor is an object or a shadow, not another gain.
_GAIN_LIMIT = 1.25

#: Within this share of the threshold in every channel a pixel is background outright: nothing
#: else is asked of it. It saves nine tenths of the work.
_OUTRIGHT = 0.75

#: Counted up whenever the same frames and settings give other silhouettes than before, so that
#: stored ones are known to be stale.
METHOD_VERSION = 1


@dataclass(frozen=True, slots=True)
class SegmentSettings:
    """How objects are told from the empty scene: the ``[segmentation]`` table of a session.

    Attributes
    ----------
    threshold : float
        By how many standard deviations of the noise an object pixel differs; somewhat fewer where
        the scene is noisy by itself, and for colours that objects have elsewhere in the frame.
    noise_floor : float
        Least standard deviation of a pixel, grey levels. Lower it for cameras that do not
        compress.
    noise_share : float
        Standard deviation as a share of the brightness.
    shadow_darkest, shadow_brightest : float
        Between which factors of the empty scene a pixel may be a shadow, or light thrown back.
        Both 1: there are no shadows.
    shadow_threshold : float
        How many standard deviations a shadow may be off the colour and the texture of the scene.
    speck_px : int
        Objects of fewer pixels are dropped.
    hole_px : int
        Holes of fewer pixels are filled.
    """

    threshold: float = 4.0
    noise_floor: float = 5.0
    noise_share: float = 0.015
    shadow_darkest: float = 0.5
    shadow_brightest: float = 1.15
    shadow_threshold: float = 3.2
    speck_px: int = 60
    hole_px: int = 150

    def __post_init__(self) -> None:
        for name in ("threshold", "noise_floor", "noise_share", "shadow_threshold"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected a number above 0")
        if not 0 <= self.shadow_darkest <= self.shadow_brightest:
            raise ValueError(
                f"shadow_darkest is {self.shadow_darkest}, expected 0 to shadow_brightest "
                f"({self.shadow_brightest})"
            )
        for name in ("speck_px", "hole_px"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 0 or more")


class Segmenter:
    """Cuts objects out of the frames of one camera.

    It keeps what it works on between frames, so that threads that share one take turns; give each
    thread its own.

    Parameters
    ----------
    background : Background
        The empty scene.
    settings : SegmentSettings
        How objects are told from it.
    """

    def __init__(self, background: Background, settings: SegmentSettings) -> None:
        self._settings = settings
        mean = np.ascontiguousarray(background.mean, np.float32)
        self._mean = mean
        variance = (
            settings.noise_floor**2
            + np.square(background.noise)
            + np.square(np.float32(settings.noise_share) * mean)
        )
        self._weight = np.ascontiguousarray(1.0 / variance, np.float32)  # (H, W, 3)
        self._norm2 = (mean * mean * self._weight).sum(axis=2)  # (H, W)
        # The noisier a pixel, the more of the colours that an object could have it covers, and the
        # less it takes to prefer the object; but never less than half the threshold.
        covers = 0.5 * np.log(variance / settings.noise_floor**2).sum(axis=2)
        self._bar, self._shadow_bar = (
            np.maximum(sigmas**2 / 2 - covers, sigmas**2 / 8).astype(np.float32)
            for sigmas in (settings.threshold, settings.shadow_threshold)
        )
        around = np.ones((3, 3), np.uint8)
        self._low = np.asarray(cv2.erode(mean, around), np.float32)
        self._high = np.asarray(cv2.dilate(mean, around), np.float32)
        # Half a grey level less on either side allows for a picture that is rounded after its gain.
        reach = _OUTRIGHT * np.sqrt(2 * self._bar[..., None] * variance / 3)
        self._least = np.clip(np.ceil(self._low - reach + 0.5), 0, 255).astype(np.uint8)
        self._most = np.clip(np.floor(self._high + reach - 0.5), 0, 255).astype(np.uint8)
        self._cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
        side = 2 * SHADE_REACH_PX + 1
        self._shade_window = np.ones((side, side), np.uint8)
        self._gain_step = max(round(math.sqrt(self._bar.size / _GAIN_PIXELS)), 1)
        sampled = mean[:: self._gain_step, :: self._gain_step].ravel()
        self._tells_gain = np.flatnonzero(sampled > _GAIN_DARKEST)
        self._sampled_mean = sampled[self._tells_gain]

        self._lock = threading.Lock()
        self._as_when_empty = np.zeros(mean.shape, np.uint8)
        size = mean.shape[:2]
        self._misfit2, self._shadow_misfit2, self._shade, self._trust = (
            np.zeros(size, np.float32) for _ in range(4)
        )
        self._places = np.zeros((size[0] * size[1], 2), np.int32)

    def segment(self, image: Image) -> NDArray[np.uint8]:
        """Return the (H, W) silhouette of a (H, W, 3) BGR frame, 1 on object pixels.

        Raises
        ------
        SessionError
            If the frame has another size than the empty scene.
        """
        if image.shape != self._mean.shape:
            raise SessionError(
                f"the picture is {image.shape[1]}x{image.shape[0]}, its background is "
                f"{self._mean.shape[1]}x{self._mean.shape[0]}"
            )
        with self._lock:
            evidence = self._evidence(image)
        cv2.blur(evidence, (3, 3), dst=evidence)
        mask = np.greater(evidence[1:-1, 1:-1], as_byte(0.0)).view(np.uint8)
        closed = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, self._cross), np.uint8)
        # OpenCV closes towards the border, as if objects went on there.
        for border in np.s_[[0, -1], :], np.s_[:, [0, -1]]:
            closed[border] = mask[border]
        return clean(closed, self._settings.speck_px, self._settings.hole_px)

    def _evidence(self, image: Image) -> NDArray[np.uint8]:
        """Return how much more each pixel looks like an object: 128 + 20 per unit, (H + 2, W + 2).

        There is one pixel more on each side, of which nothing is known.
        """
        settings = self._settings
        gain = self._gain(image)
        levels = np.clip(np.round(np.arange(256) / gain), 0, 255).astype(np.uint8)
        cv2.LUT(image, levels, dst=self._as_when_empty)
        outright = cv2.inRange(self._as_when_empty, self._least, self._most)
        open_questions = np.asarray(cv2.bitwise_not(outright), np.uint8)
        compare_with_background(
            image,
            np.asarray(cv2.dilate(open_questions, self._shade_window), np.uint8),
            self._mean,
            self._low,
            self._high,
            self._weight,
            self._norm2,
            np.float32(1.0 / gain),
            np.float32(settings.shadow_darkest),
            np.float32(settings.shadow_brightest),
            np.float32(settings.shadow_threshold**2),
            self._misfit2,
            self._shadow_misfit2,
            self._shade,
            self._trust,
        )
        height, width = outright.shape
        result = np.full((height + 2, width + 2), as_byte(0.0), np.uint8)
        inner = result[1:-1, 1:-1]
        inner[:] = as_byte(-EVIDENCE_LIMIT)
        weigh_evidence(
            image,
            open_questions,
            self._norm2,
            self._bar,
            self._shadow_bar,
            self._shade,
            self._trust,
            self._shadow_misfit2,
            self._misfit2,
            self._places,
            inner,
        )
        return result

    def _gain(self, image: Image) -> float:
        """Return how much brighter the camera sees the scene than when it was empty."""
        values = image[:: self._gain_step, :: self._gain_step].ravel()[self._tells_gain]
        ratios = values / self._sampled_mean
        ratios = ratios[(ratios > 1 / _GAIN_LIMIT) & (ratios < _GAIN_LIMIT)]
        return float(np.median(ratios)) if len(ratios) else 1.0


def clean(mask: NDArray[np.uint8], speck_px: int, hole_px: int) -> NDArray[np.uint8]:
    """Return a silhouette without objects below `speck_px` and holes below `hole_px` pixels.

    Objects hang together across corners, holes do not. A hole is a piece of background that does
    not reach the border of the image.

    Parameters
    ----------
    mask : (H, W) uint8
        1 on object pixels.
    """
    result = mask.copy()
    for value, least_px in ((1, speck_px), (0, hole_px)):
        left, top, width, height = cv2.boundingRect(result)
        _flip_small(result, left, top, width, height, value, least_px)
    return result


@compiled
def _flip_small(
    mask: NDArray[np.uint8],
    left: int,
    top: int,
    width: int,
    height: int,
    value: int,
    least_px: int,
) -> None:
    """Turn the pieces of `value` (0 or 1) with fewer than `least_px` pixels into the other.

    Only within a rectangle of the mask, which may be empty. Pieces of 1 hang together across
    corners, those of 0 do not; pieces of 0 at the border of the rectangle stay. Runs of equal
    pixels along the rows are joined, which takes little time where silhouettes are few and smooth.
    """
    right, bottom = left + width, top + height
    n_runs = 0
    for row in range(top, bottom):
        before = 1 - value
        for column in range(left, right):
            if mask[row, column] == value != before:
                n_runs += 1
            before = mask[row, column]
    runs = np.zeros((n_runs, 3), np.int32)  # row, first column, column after the last
    parent, area = np.zeros(n_runs, np.int64), np.zeros(n_runs, np.int64)
    for run in range(n_runs):
        parent[run] = run
    reach = value  # how far beyond its ends a run touches those in the row above
    run = ZERO
    above = ZERO  # the first run in the row above that may touch
    above_ends = ZERO
    for row in range(top, bottom):
        row_starts = run
        column = left
        while column < right:
            if mask[row, column] != value:
                column += 1
                continue
            first = column
            while column < right and mask[row, column] == value:
                column += 1
            runs[run, 0] = row
            runs[run, 1] = first
            runs[run, 2] = column
            area[run] = column - first
            at_side = first == left or column == right
            if value == 0 and (at_side or row == top or row == bottom - 1):
                area[run] = least_px  # reaches the border: not small
            while above < above_ends and runs[above, 2] + reach <= first:
                above += 1
            other = above
            while other < above_ends and runs[other, 1] < column + reach:
                one = _root(parent, run)
                two = _root(parent, other)
                if one != two:
                    parent[max(one, two)] = min(one, two)
                    area[min(one, two)] += area[max(one, two)]
                other += 1
            run += 1
        above = row_starts
        above_ends = run
    for run in range(n_runs):
        if area[_root(parent, run)] < least_px:
            for column in range(runs[run, 1], runs[run, 2]):
                mask[runs[run, 0], column] = 1 - value


@compiled
def _root(parent: NDArray[np.int64], node: int) -> int:
    """Return the root of a node in a forest, and shorten the way there."""
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node
