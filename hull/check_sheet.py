"""What a check looked at, as a picture: each camera's first and middle frame, silhouettes outlined.

Drawn without OpenGL, so that it can be drawn on any machine.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.hull.capture.recording import Mask, recording_of
from hybridve.hull.capture.session import Session, SessionCamera
from hybridve.hull.view.outlined import outlined
from hybridve.hull.view.picture import contact_sheet, write_picture

Image = NDArray[np.uint8]

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
        outlined(
            _image(session, camera, frame),
            masks[frame][number],
            f"{camera.name}, frame {frame}: {masks[frame][number].mean():.1%}",
            _WIDTH_PX,
        )
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
