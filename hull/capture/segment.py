"""From a frame and the empty scene to the silhouette of what is new.

A pixel is an object pixel when it differs from the empty scene by more than noise explains, and
not in the way of a cast shadow:

* *Noise* has three parts: what the pixel did over time in the empty scene, a floor in grey levels
  for rounding and compression, and a share of the brightness. A picture may also be shifted by a
  pixel (compression, a camera that was touched), so that a value is compared with the range of its
  neighbours in the empty scene and only what lies outside counts.
* *A shadow* darkens all channels by one factor: the pixel is the empty scene times a, with a
  between two limits. (A little light thrown back by an object is the same with a above 1.)
* *The camera's gain* may have changed: the median of the ratio to the empty scene tells by how
  much, since objects fill less than half of the picture.

Afterwards a median takes out lone pixels, a closing joins what a pixel parts, specks go and holes
that are too small to look through are filled.

References
----------
Horprasert, Harwood and Davis, A statistical approach for real-time robust background subtraction
and shadow detection, ICCV Frame-Rate Workshop, 1999: brightness and chromaticity distortion.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.calib.image_io import Image
from hybridve.hull.capture.background import Background
from hybridve.hull.jit import compiled

#: Every how many pixels the camera's gain looks at the picture.
_GAIN_STEP = 8

#: Pixels of the empty scene darker than this (grey levels) say nothing of the gain.
_GAIN_DARKEST = 16.0


@dataclass(frozen=True, slots=True)
class SegmentSettings:
    """How objects are told from the empty scene: the ``[segmentation]`` table of a session.

    Attributes
    ----------
    threshold : float
        By how many standard deviations of the noise an object pixel differs.
    noise_floor : float
        Least standard deviation of a pixel, grey levels.
    noise_share : float
        Standard deviation as a share of the brightness.
    shadow_darkest, shadow_brightest : float
        Between which factors of the empty scene a pixel may be a shadow, or light thrown back.
    shadow_threshold : float
        How many standard deviations a shadow may be off the empty scene's colour.
    speck_px : int
        Objects of fewer pixels are dropped.
    hole_px : int
        Holes of fewer pixels are filled.
    """

    threshold: float = 8.0
    noise_floor: float = 2.0
    noise_share: float = 0.015
    shadow_darkest: float = 0.55
    shadow_brightest: float = 1.15
    shadow_threshold: float = 5.0
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

    Parameters
    ----------
    background : Background
        The empty scene.
    settings : SegmentSettings
        How objects are told from it.
    """

    def __init__(self, background: Background, settings: SegmentSettings) -> None:
        self._settings = settings
        mean = background.mean
        self._mean = np.ascontiguousarray(mean)
        variance = (
            settings.noise_floor**2
            + background.noise**2
            + np.square(np.float32(settings.noise_share) * mean)
        )
        self._weight = np.ascontiguousarray(1.0 / variance, np.float32)  # (H, W, 3)
        around = np.ones((3, 3), np.uint8)
        self._low = cv2.erode(mean, around)
        self._high = cv2.dilate(mean, around)
        # Where each channel alone stays within threshold / sqrt(3), the pixel is background. Half a
        # grey level less on either side allows for a picture that is rounded after its gain.
        reach = settings.threshold / np.sqrt(3.0 * self._weight)
        self._surely_above = np.clip(np.ceil(self._low - reach + 0.5), 0, 255).astype(np.uint8)
        self._surely_below = np.clip(np.floor(self._high + reach - 0.5), 0, 255).astype(np.uint8)
        self._ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
        sampled = mean[::_GAIN_STEP, ::_GAIN_STEP].ravel()
        self._tells_gain = np.flatnonzero(sampled > _GAIN_DARKEST)
        self._sampled_mean = sampled[self._tells_gain]

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
        settings = self._settings
        gain = self._gain(image)
        as_when_empty = np.clip(np.round(np.arange(256) / gain), 0, 255).astype(np.uint8)
        mask = cv2.inRange(
            cv2.LUT(image, as_when_empty), self._surely_above, self._surely_below
        )  # 255 where the pixel is background beyond doubt
        _classify(
            image,
            self._mean,
            self._low,
            self._high,
            self._weight,
            np.float32(1.0 / gain),
            np.float32(settings.threshold**2),
            np.float32(settings.shadow_threshold**2),
            np.float32(settings.shadow_darkest),
            np.float32(settings.shadow_brightest),
            mask,
        )
        cv2.medianBlur(mask, 3, dst=mask)
        cv2.morphologyEx(mask, cv2.MORPH_CLOSE, self._ellipse, dst=mask)
        return clean(mask, settings.speck_px, settings.hole_px)

    def _gain(self, image: Image) -> float:
        """Return how much brighter the camera sees the scene than when it was empty."""
        if len(self._sampled_mean) == 0:
            return 1.0
        values = image[::_GAIN_STEP, ::_GAIN_STEP].ravel()[self._tells_gain]
        return max(float(np.median(values / self._sampled_mean)), 1e-3)


def clean(mask: NDArray[np.uint8], speck_px: int, hole_px: int) -> NDArray[np.uint8]:
    """Return a silhouette without objects below `speck_px` and holes below `hole_px` pixels.

    Objects hang together across corners, holes do not. A hole is a piece of background that does
    not reach the border of the image.

    Parameters
    ----------
    mask : (H, W) uint8
        1 on object pixels.
    """
    result = _drop_small(mask, speck_px, connectivity=8)
    columns, rows = np.flatnonzero(result.any(axis=0)), np.flatnonzero(result.any(axis=1))
    if len(columns) == 0:
        return result
    # Holes lie within the bounding rectangle; a pixel more, so that what is outside hangs together.
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    framed = np.ones((bottom - top + 2, right - left + 2), np.uint8)
    np.subtract(1, result[top:bottom, left:right], out=framed[1:-1, 1:-1])
    kept = _drop_small(framed, hole_px, connectivity=4)
    np.subtract(1, kept[1:-1, 1:-1], out=result[top:bottom, left:right])
    return result


def _drop_small(mask: NDArray[np.uint8], least_px: int, *, connectivity: int) -> NDArray[np.uint8]:
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=connectivity)
    result = mask.copy()
    for label in np.flatnonzero(stats[:, cv2.CC_STAT_AREA] < least_px):
        if label == 0:
            continue
        left, top, width, height = stats[label, :4]
        box = np.s_[top : top + height, left : left + width]
        result[box][labels[box] == label] = 0
    return result


def threshold_mask(image: Image, threshold: int = 127) -> NDArray[np.uint8]:
    """Return 1 where a ready mask, grey or coloured, is brighter than `threshold`."""
    grey = image if image.ndim == 2 else image.max(axis=2)
    return (grey > threshold).astype(np.uint8)


@compiled
def _classify(
    image: NDArray[np.uint8],
    mean: NDArray[np.float32],
    low: NDArray[np.float32],
    high: NDArray[np.float32],
    weight: NDArray[np.float32],
    inverse_gain: np.float32,
    threshold2: np.float32,
    shadow_threshold2: np.float32,
    shadow_darkest: np.float32,
    shadow_brightest: np.float32,
    mask: NDArray[np.uint8],
) -> None:
    """Turn a mask of what is surely background (255) into one of objects (1).

    The exact test is made for the pixels that are 0 in `mask`; the others become 0.
    """
    zero = np.float32(0.0)
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            if mask[row, column] != 0:
                mask[row, column] = 0
                continue
            outside2 = zero
            along = zero
            norm2 = zero
            for channel in range(3):
                value = np.float32(image[row, column, channel]) * inverse_gain
                w = weight[row, column, channel]
                m = mean[row, column, channel]
                off = min(value - low[row, column, channel], zero) + max(
                    value - high[row, column, channel], zero
                )
                outside2 += off * off * w
                along += value * m * w
                norm2 += m * m * w
            if outside2 <= threshold2:
                continue
            factor = along / max(norm2, np.float32(1e-6))
            if shadow_darkest < factor < shadow_brightest:
                across2 = zero
                for channel in range(3):
                    value = np.float32(image[row, column, channel]) * inverse_gain
                    off = value - factor * mean[row, column, channel]
                    across2 += off * off * weight[row, column, channel]
                if across2 < shadow_threshold2:
                    continue
            mask[row, column] = 1
