"""Text of a picture: title, caption, legend, and labels that keep clear of each other.

Drawn with ``cv2.putText``, in the sizes of a picture 1000 pixels high.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Rgb = tuple[float, float, float]
Box = tuple[int, int, int, int]

INK: Rgb = (0.13, 0.15, 0.18)
PALE_INK: Rgb = (0.36, 0.39, 0.43)
_PAPER: Rgb = (1.0, 1.0, 1.0)

_FONT = cv2.FONT_HERSHEY_SIMPLEX

#: Size of a label in units of OpenCV's font scale, for a picture 1000 pixels high.
LABEL_SIZE = 0.52


def bgr(rgb: Rgb) -> tuple[int, int, int]:
    """Return a colour as OpenCV draws it."""
    red, green, blue = (round(255 * value) for value in rgb)
    return blue, green, red


def text_size(text: str, size: float, bold: bool = False) -> tuple[int, int, int]:
    """Return width, height above the baseline and depth below it, in pixels."""
    (width, height), below = cv2.getTextSize(text, _FONT, size, 2 if bold else 1)
    return width, height, below


def put_text(
    image: Image, text: str, at: tuple[int, int], size: float, rgb: Rgb = INK, bold: bool = False
) -> None:
    """Write text into `image`, its baseline beginning at pixel `at`."""
    cv2.putText(image, text, at, _FONT, size, bgr(rgb), 2 if bold else 1, cv2.LINE_AA)


def fitted(text: str, size: float, width_px: int, bold: bool = False) -> str:
    """Return the text, cut off with dots where it would be wider than `width_px`."""
    if text_size(text, size, bold)[0] <= width_px:
        return text
    while text and text_size(text + "...", size, bold)[0] > width_px:
        text = text[:-1]
    return text.rstrip() + "..."


def plate(image: Image, box: Box, opacity: float = 0.8) -> None:
    """Lighten a rectangle (left, top, right, bottom), so that text on it can be read."""
    height, width = image.shape[:2]
    left, top = max(0, box[0]), max(0, box[1])
    right, bottom = min(width, box[2]), min(height, box[3])
    if right <= left or bottom <= top:
        return
    part = image[top:bottom, left:right]
    paper = np.full_like(part, 255)
    image[top:bottom, left:right] = cv2.addWeighted(part, 1 - opacity, paper, opacity, 0)


@dataclass(slots=True)
class Labels:
    """Labels on one picture; a later one keeps clear of the earlier ones.

    Attributes
    ----------
    image : (H, W, 3) uint8
        Drawn into.
    scale : float
        Height of the picture over 1000.
    taken : list of Box
        Where nothing more goes.
    """

    image: Image
    scale: float
    taken: list[Box] = field(default_factory=list)

    def reserve(self, box: Box) -> None:
        """Keep labels out of a rectangle."""
        self.taken.append(box)

    def add(
        self, text: str, anchor: NDArray[np.float64], rgb: Rgb = INK, bold: bool = False
    ) -> None:
        """Write a label near pixel `anchor`, with a line to it if it must stand off.

        Left out if the anchor is not in the picture or no place is free.
        """
        height, width = self.image.shape[:2]
        if not (np.isfinite(anchor).all() and (anchor >= 0).all()):
            return
        if not (anchor < (width, height)).all():
            return
        size = LABEL_SIZE * self.scale
        text_width, above, below = text_size(text, size, bold)
        pad = max(2, round(4 * self.scale))
        x, y = int(anchor[0]), int(anchor[1])
        for away in (10, 26, 48, 74):
            off = round(away * self.scale)
            diagonal = round(0.7 * off)
            places = [
                (x - text_width // 2, y - off - below),
                (x + off, y + above // 2),
                (x - off - text_width, y + above // 2),
                (x - text_width // 2, y + off + above),
                (x + diagonal, y - diagonal - below),
                (x - diagonal - text_width, y - diagonal - below),
                (x + diagonal, y + diagonal + above),
                (x - diagonal - text_width, y + diagonal + above),
            ]
            for left, baseline in places:
                box = (
                    left - pad,
                    baseline - above - pad,
                    left + text_width + pad,
                    baseline + below + pad,
                )
                if box[0] < 0 or box[1] < 0 or box[2] > width or box[3] > height:
                    continue
                if any(_overlap(box, taken) for taken in self.taken):
                    continue
                if away > 10:
                    nearest = np.clip((x, y), box[:2], box[2:])
                    cv2.line(
                        self.image,
                        (x, y),
                        (int(nearest[0]), int(nearest[1])),
                        bgr(PALE_INK),
                        max(1, round(self.scale)),
                        cv2.LINE_AA,
                    )
                plate(self.image, box, 0.72)
                put_text(self.image, text, (left, baseline), size, rgb, bold)
                self.taken.append(box)
                return


def _overlap(first: Box, second: Box) -> bool:
    return (
        first[0] < second[2]
        and second[0] < first[2]
        and first[1] < second[3]
        and second[1] < first[3]
    )


def legend_width(entries: list[tuple[str, Rgb, str]], scale: float) -> int:
    """Return how wide a line of entries is, in pixels, without what is around it."""
    beside = round(18 * scale) + round(8 * scale)
    widths = [beside + text_size(text, LABEL_SIZE * scale)[0] for _, _, text in entries]
    return sum(widths) + round(26 * scale) * (len(entries) - 1)


def draw_legend(
    image: Image, entries: list[tuple[str, Rgb, str]], left: int, baseline: int, scale: float
) -> Box:
    """Write a line of entries (kind, colour, text); return its rectangle.

    Kinds are "patch", "dot" and "line".
    """
    size = LABEL_SIZE * scale
    patch, gap = round(18 * scale), round(26 * scale)
    above = text_size("Ag", size)[1]
    pad = round(12 * scale)
    widths = [patch + round(8 * scale) + text_size(text, size)[0] for _, _, text in entries]
    right = left + legend_width(entries, scale)
    box = (left - pad, baseline - above - pad, right + pad, baseline + pad)
    plate(image, box, 0.8)
    x = left
    for (kind, rgb, text), width in zip(entries, widths, strict=True):
        middle = baseline - above // 2
        if kind == "dot":
            center = (x + patch // 2, middle)
            cv2.circle(image, center, max(2, round(4 * scale)), bgr(rgb), -1, cv2.LINE_AA)
        elif kind == "line":
            ends = (x, middle), (x + patch, middle)
            cv2.line(image, *ends, (0, 0, 0), max(3, round(5 * scale)), cv2.LINE_AA)
            cv2.line(image, *ends, bgr(rgb), max(1, round(3 * scale)), cv2.LINE_AA)
        else:
            corners = (x, middle - patch // 2), (x + patch, middle + patch // 2)
            cv2.rectangle(image, *corners, bgr(rgb), -1)
            cv2.rectangle(image, *corners, bgr(PALE_INK), 1, cv2.LINE_AA)
        put_text(image, text, (x + patch + round(8 * scale), baseline), size, INK)
        x += width + gap
    return box
