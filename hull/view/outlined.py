"""What a camera saw, with the outline of its silhouette and a label: drawn without OpenGL."""

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.view.labels import bgr, plate, put_text, text_size

#: Colour of the outlines: one that neither people nor rooms have much of.
_OUTLINE_RGB = (0.10, 0.95, 0.75)

#: Silhouettes of which there are no pictures are drawn in this grey, on black.
_MASK_GREY = 150

#: Size of the label's letters.
_SCALE = 0.5


def outlined(
    image: NDArray[np.uint8] | None, mask: NDArray[np.uint8], label: str, width_px: int
) -> NDArray[np.uint8]:
    """Return a picture of a width with its silhouette's outline: (h, w, 3) BGR.

    Parameters
    ----------
    image : (H, W, 3) uint8 or None
        What the camera saw, BGR; where there is none, the silhouette is drawn itself.
    mask : (H, W) uint8
        1 on object pixels.
    label : str
        Stands in the corner.
    width_px : int
        Of the picture that is returned.
    """
    if image is None:
        image = np.repeat((mask * np.uint8(_MASK_GREY))[..., None], 3, axis=2)
    scale = width_px / image.shape[1]
    size = (width_px, max(1, round(image.shape[0] * scale)))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    drawn = np.asarray(cv2.resize(image, size, interpolation=way), np.uint8)
    small = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)
    contours, _ = cv2.findContours(small, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, contours, -1, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.drawContours(drawn, contours, -1, bgr(_OUTLINE_RGB), 1, cv2.LINE_AA)
    width, above, below = text_size(label, _SCALE)
    plate(drawn, (0, 0, width + 12, above + below + 12), 0.8)
    put_text(drawn, label, (6, above + 6), _SCALE)
    return drawn
