"""The scale of a heat map: from how near something came to a colour, and the bar that says so."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.view.labels import (
    INK,
    LABEL_SIZE,
    Box,
    Image,
    bgr,
    plate,
    put_text,
    text_size,
)
from hybridve.hull.view.paint import HEAT_RGB

#: Numbers beside the bar.
_N_TICKS = 5


@dataclass(frozen=True, slots=True)
class HeatScale:
    """What colours of a heat map mean.

    Attributes
    ----------
    reach_m : float
        From how far on all is alike: the cold end of the scale.
    off_m : float
        How far off distances may be, those of the warm quarter.
    when : str
        Of which frames it is.
    """

    reach_m: float
    off_m: float
    when: str

    def warmth(self, distance_m: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return distances as 0 (far) to 1 (touched)."""
        return np.asarray(1.0 - np.clip(distance_m / self.reach_m, 0.0, 1.0), np.float32)


def heat_rgb(warmth: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the colours (..., 3) of warmth from 0 to 1, as the shader does."""
    stops = np.linspace(0.0, 1.0, len(HEAT_RGB))
    channels = [np.interp(warmth, stops, [rgb[k] for rgb in HEAT_RGB]) for k in range(3)]
    return np.stack(channels, axis=-1)


def draw_heat(image: Image, heat: HeatScale, scale: float) -> Box:
    """Draw the bar of a scale at the right border of a picture; return its rectangle."""
    height, width = image.shape[:2]
    size = LABEL_SIZE * scale
    bar_px, tall_px = max(6, round(18 * scale)), round(0.36 * height)
    title = f"nearest, mm; +-{1e3 * heat.off_m:.2g} where red"
    texts = [f"{1e3 * part * heat.reach_m:.3g}" for part in np.linspace(0.0, 1.0, _N_TICKS)]
    texts[-1] += " or more"
    widest = max(text_size(text, size)[0] for text in (title, heat.when, *texts))
    pad, line = round(10 * scale), round(24 * scale)
    box_width = max(widest, bar_px + round(12 * scale) + widest // 2) + 2 * pad
    left, top = width - box_width - pad, round(0.34 * height)
    box = (left, top, width - pad, top + tall_px + 3 * line + 2 * pad)
    plate(image, box, 0.82)
    put_text(image, title, (left + pad, top + line), size, INK)
    put_text(image, heat.when, (left + pad, top + 2 * line), size, INK)
    first = top + 2 * line + pad
    column = heat_rgb(np.linspace(1.0, 0.0, tall_px))
    bar = np.rint(255 * column[:, None, ::-1]).astype(np.uint8)
    rows = slice(first, min(first + tall_px, height))
    image[rows, left + pad : left + pad + bar_px] = bar[: rows.stop - rows.start]
    corners = (left + pad, first), (left + pad + bar_px, first + tall_px)
    cv2.rectangle(image, *corners, bgr(INK), 1)
    for number, text in enumerate(texts):
        at = first + round(number * (tall_px - 1) / (_N_TICKS - 1))
        beside = left + pad + bar_px + round(10 * scale)
        put_text(image, text, (beside, at + round(6 * scale)), size, INK)
    return box
