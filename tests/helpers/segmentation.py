"""Segmentation in float64 NumPy: what `hull.capture.segment` computes, written for reading."""

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.capture import evidence as room
from hybridve.hull.capture import segment
from hybridve.hull.capture.background import Background
from hybridve.hull.capture.segment import SegmentSettings

Reals = NDArray[np.float64]

#: Half a level to round the value, another kept as a margin, and one to round the bounds.
OUTRIGHT_LEVELS = 2.0


def evidence_reference(
    image: NDArray[np.uint8], background: Background, settings: SegmentSettings, gain: float
) -> tuple[Reals, Reals]:
    """Return the evidence for an object of each pixel, and how safely it is background outright.

    `gain` is how much brighter the camera sees the scene than when it was empty. Both results are
    (H, W). The evidence is limited in both directions. The second is by how many grey levels every
    channel by itself is within its share of the threshold: below 0 the evidence decides; from
    `OUTRIGHT_LEVELS` on nothing is asked, and the evidence is as low as it gets; between, how
    values are rounded tells which of the two.
    """
    mean = background.mean.astype(np.float64)
    variance = (
        settings.noise_floor**2
        + background.noise.astype(np.float64) ** 2
        + (settings.noise_share * mean) ** 2
    )
    value = image / gain

    # The empty scene: how far outside of the range of the neighbours.
    around = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(mean, around), cv2.dilate(mean, around)
    off = value - np.clip(value, low, high)
    misfit2 = (off**2 / variance).sum(axis=2)

    # A shadow: the factor that fits best within the limits, and how far off the colour still is.
    norm2 = (mean**2 / variance).sum(axis=2)
    shade = (value * mean / variance).sum(axis=2) / np.maximum(norm2, 1e-6)
    shade = np.clip(shade, settings.shadow_darkest, settings.shadow_brightest)
    colour2 = ((value - shade[..., None] * mean) ** 2 / variance).sum(axis=2)

    # Texture: how far the factor is off its mean over the pixels around that may be in shadow.
    trust = np.where(colour2 < settings.shadow_threshold**2, norm2, 0.0)
    trust_around, shade_around = window_sum(trust), window_sum(trust * shade)
    trusted = trust_around > 0
    smooth = np.divide(shade_around, trust_around, out=np.zeros_like(shade), where=trusted)
    texture2 = np.where(
        trusted, (shade - smooth) ** 2 * norm2 / (1 + room._SHADE_VARIES**2 * norm2), 0.0
    )

    # An object may have any colour: the noisier a pixel, the more colours it covers by itself.
    covers = 0.5 * np.log(variance / settings.noise_floor**2).sum(axis=2)
    bar, shadow_bar = (
        np.maximum(sigmas**2 / 2 - covers, sigmas**2 / 8)
        for sigmas in (settings.threshold, settings.shadow_threshold)
    )
    evidence = np.minimum(misfit2 / 2 - bar, (colour2 + texture2) / 2 - shadow_bar)

    # Objects have a few colours: those that pixels beyond doubt show are likelier elsewhere.
    box = (image >> room._COLOUR_SHIFT).astype(np.int64) @ np.array([256, 16, 1])
    certain = evidence > room._BEYOND_DOUBT
    counts = np.bincount(box[certain], minlength=room._N_COLOURS)
    n_certain = counts.sum()
    weight = room._COLOUR_WEIGHT * n_certain / (n_certain + room._COLOUR_PIXELS)
    share = counts / max(n_certain, 1) * room._N_COLOURS
    evidence = evidence + np.log(weight * share + 1 - weight)[box]
    limit = room.EVIDENCE_LIMIT
    evidence = np.clip(evidence, -limit, limit)

    # A value that the gain takes out of the range of bytes was saturated, and says no more than the
    # end of the range.
    off = np.clip(value, 0, 255) - np.clip(value, low, high)
    reach = segment._OUTRIGHT * np.sqrt(2 * bar[..., None] * variance / 3)
    return np.asarray(evidence), (reach - np.abs(off)).min(axis=2)


def window_sum(values: Reals) -> Reals:
    """Return the sum over the square window around each pixel, nothing beyond the image."""
    side = 2 * room.SHADE_REACH_PX + 1
    kernel = np.ones((side, side))
    return np.asarray(cv2.filter2D(values, -1, kernel, borderType=cv2.BORDER_CONSTANT))
