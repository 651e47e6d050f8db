"""A camera's image with its silhouette, that of the hull of the others, and where they differ.

What one of two outlines holds alone is filled in that outline's colour.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.view.labels import (
    INK,
    Rgb,
    bgr,
    draw_legend,
    fitted,
    legend_width,
    plate,
    put_text,
    text_size,
)
from hybridve.hull.view.picture import contact_sheet

Image = NDArray[np.uint8]

#: Colours that neither people nor rooms have much of, and that the colour-blind tell apart.
_OWN_RGB: Rgb = (0.10, 0.95, 0.75)
_OTHERS_RGB: Rgb = (1.00, 0.55, 0.05)

#: A cause is written in this colour, as what is wrong is in other pictures.
_WRONG_RGB: Rgb = (0.70, 0.02, 0.05)

#: How much of its colour the image keeps, how bright it is left, how bright where the others
#: cannot look, and how much of the image is seen through what is filled.
_COLOUR_KEPT, _BRIGHTNESS, _UNSEEN_BRIGHTNESS, _SEEN_THROUGH = 0.45, 0.85, 0.38, 0.40

#: The picture's paper.
_PAPER_GREY = 245


def draw_contrast(
    image: Image,
    mask: NDArray[np.bool_],
    others: NDArray[np.bool_],
    alone: tuple[NDArray[np.bool_], NDArray[np.bool_]],
    is_in_view: NDArray[np.bool_],
    *,
    name: str,
    remark: str = "",
) -> Image:
    """Return a camera's image with what it sees and what the others say that it sees.

    Parameters
    ----------
    image : (H, W, 3) uint8
        As recorded, BGR.
    mask, others : (H, W) bool
        Its silhouette, and that of the hull of the others.
    alone : two of (H, W) bool
        What only it sees, and what only the others do; to be filled.
    is_in_view : (H, W) bool
        Where the others can look; elsewhere the image is darkened.
    name, remark : str
        Of the camera, and what is wrong with it.

    Returns
    -------
    (H, W, 3) uint8
        BGR.
    """
    scale = image.shape[0] / 500
    grey = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    pale = image * _COLOUR_KEPT + grey * (1 - _COLOUR_KEPT)
    pale *= np.where(is_in_view, _BRIGHTNESS, _UNSEEN_BRIGHTNESS)[..., None]
    for area, rgb in zip(alone, (_OWN_RGB, _OTHERS_RGB), strict=True):
        pale[area] = _SEEN_THROUGH * pale[area] + (1 - _SEEN_THROUGH) * np.array(bgr(rgb))
    result = np.round(pale).astype(np.uint8)
    width = max(1, round(scale))
    for area, rgb in ((others, _OTHERS_RGB), (mask, _OWN_RGB)):
        contours, _ = cv2.findContours(area.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(result, contours, -1, (0, 0, 0), width + 1, cv2.LINE_AA)
        cv2.drawContours(result, contours, -1, bgr(rgb), width, cv2.LINE_AA)
    _write_name(result, name, remark, scale)
    return result


def contrast_sheet(images: list[Image], columns: int, title: str, *, has_unseen: bool) -> Image:
    """Return pictures side by side, all as wide as the widest, under a title.

    Below them stands what their colours mean; with `has_unseen` some are dark where the others
    cannot look.
    """
    widest = max(image.shape[1] for image in images)
    sheet = contact_sheet([_as_wide(image, widest) for image in images], columns)
    width = sheet.shape[1]
    entries = [
        ("line", _OWN_RGB, "its silhouette"),
        ("line", _OTHERS_RGB, "hull of all others as it would see it"),
        ("patch", _filled(_OWN_RGB), "only it sees this"),
        ("patch", _filled(_OTHERS_RGB), "only the others do"),
    ]
    if has_unseen:
        entries.append(("patch", (0.25, 0.25, 0.25), "out of the others' view"))
    scale = max(0.5, width / 1300)
    left = round(22 * scale)
    scale *= min(1.0, (width - 2 * left) / max(1, legend_width(entries, scale)))
    _, above, below = text_size(title, scale, bold=True)
    head = np.full((above + below + round(30 * scale), width, 3), _PAPER_GREY, np.uint8)
    shown = fitted(title, scale, width - 2 * left, bold=True)
    put_text(head, shown, (left, above + round(18 * scale)), scale, INK, bold=True)
    foot = np.full((round(54 * scale), width, 3), _PAPER_GREY, np.uint8)
    draw_legend(foot, entries, left, round(32 * scale), scale)
    return np.concatenate([head, sheet, foot])


def _as_wide(image: Image, width_px: int) -> Image:
    """Return a picture enlarged to a width."""
    height, width = image.shape[:2]
    if width == width_px:
        return image
    size = (width_px, round(height * width_px / width))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def _filled(rgb: Rgb) -> Rgb:
    """Return a colour as it looks on an image of middle brightness."""
    red, green, blue = (0.4 * _SEEN_THROUGH + (1 - _SEEN_THROUGH) * value for value in rgb)
    return red, green, blue


def _write_name(image: Image, name: str, remark: str, scale: float) -> None:
    """Write the camera's name into the upper left corner, and behind it what is wrong with it."""
    size, pad = 0.6 * scale, round(6 * scale)
    width, above, below = text_size(name, size, bold=True)
    room = image.shape[1] - width - 5 * pad
    remark = fitted(remark, size, room)
    beside = text_size(remark, size)[0] + 2 * pad if remark else 0
    plate(image, (0, 0, width + 2 * pad + beside, above + below + 2 * pad), 0.8)
    put_text(image, name, (pad, above + pad), size, INK if not remark else _WRONG_RGB, bold=True)
    if remark:
        put_text(image, remark, (width + 3 * pad, above + pad), size, _WRONG_RGB)
