"""What a check looked at, as a picture: each camera's first and middle frame, silhouettes outlined.

Drawn without OpenGL, so that it can be drawn on any machine.
"""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.hull.capture.recording import Mask, recording_of
from hybridve.hull.capture.session import Session, SessionCamera
from hybridve.hull.view.labels import bgr, plate, put_text, text_size
from hybridve.hull.view.picture import contact_sheet, write_picture

Image = NDArray[np.uint8]

#: Colour of the outlines: one that neither people nor rooms have much of.
_OUTLINE_RGB = (0.10, 0.95, 0.75)

#: Width of a picture on the sheet, in pixels.
_WIDTH_PX = 480


def write_check_sheet(path: Path, session: Session, masks: dict[int, list[Mask]]) -> None:
    """Draw the first and the middle one of the frames given, a row a camera.

    Parameters
    ----------
    path : Path
        A .png or .jpg.
    session : Session
        Whose pictures.
    masks : dict of int to list of (H, W) uint8
        By frame, those of all cameras, as recorded; at least one frame.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    frames = sorted(masks)
    chosen = list(dict.fromkeys((frames[0], frames[len(frames) // 2])))
    pictures = [
        _picture(camera, frame, _image(session, camera, frame), masks[frame][number])
        for number, camera in enumerate(session.cameras)
        for frame in chosen
    ]
    write_picture(path, contact_sheet(pictures, len(chosen)))


def _image(session: Session, camera: SessionCamera, frame: int) -> Image | None:
    """Return a camera's picture of a frame of the session; None of ready masks."""
    if camera.has_masks:
        return None
    at = frame - camera.nearest_shift
    found = next(recording_of(session, camera).frames_or_errors(at, at + 1), None)
    return None if found is None or isinstance(found, SessionError) else found


def _picture(camera: SessionCamera, frame: int, image: Image | None, mask: Mask) -> Image:
    if image is None:
        image = np.repeat((mask * np.uint8(150))[..., None], 3, axis=2)
    scale = _WIDTH_PX / image.shape[1]
    size = (_WIDTH_PX, max(1, round(image.shape[0] * scale)))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    drawn = np.asarray(cv2.resize(image, size, interpolation=way), np.uint8)
    small = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)
    contours, _ = cv2.findContours(small, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, contours, -1, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.drawContours(drawn, contours, -1, bgr(_OUTLINE_RGB), 1, cv2.LINE_AA)
    label = f"{camera.name}, frame {frame}: {mask.mean():.1%}"
    width, above, below = text_size(label, 0.5)
    plate(drawn, (0, 0, width + 12, above + below + 12), 0.8)
    put_text(drawn, label, (6, above + 6), 0.5)
    return drawn
