"""A picture in which one sees where the world of a rig is: of the board, with the axes drawn in."""

import numpy as np

from hybridve.calib.errors import SessionError
from hybridve.calib.image_io import FrameSource
from hybridve.calib.record import CalibrationRecord
from hybridve.calib.rig import Rig
from hybridve.hull.capture.session import Session, SessionCamera
from hybridve.hull.view.certificate_page import Photo
from hybridve.hull.view.labels import Image
from hybridve.hull.view.world_photo import axis_length_m, draw_world, share_in_picture

#: A camera that sees so much more of the axes is taken, however far off it stands.
_BETTER = 0.05


def world_photo(session: Session, rig: Rig, record: CalibrationRecord) -> Photo | None:
    """Return the picture of the camera that sees the world's axes best, with them drawn in.

    Of a board that moved the picture of the instant at which it is the world. None where no camera
    that stands still sees the origin, or none has such a picture.

    Parameters
    ----------
    session : Session
        Whose pictures.
    rig : Rig
        Where its cameras stand.
    record : CalibrationRecord
        What the world was defined by.
    """
    seen = [
        (share_in_picture(rig[camera.name]), -axis_length_m(rig[camera.name]), camera)
        for camera in session.cameras
        if camera.name not in rig.mounts and camera.name in {one.name for one in rig.cameras}
    ]
    seen = [one for one in seen if one[0] > 0.0]
    # Of those that see as much of the axes the nearest.
    seen.sort(key=lambda one: (-round(one[0] / _BETTER), -one[1]))
    instant = None if record.world is None else record.world.instant
    for _, _, camera in seen:
        image = _picture(camera, instant if isinstance(instant, int) else None)
        if image is not None:
            one = rig[camera.name]
            if image.shape[:2] == (one.height_px, one.width_px):
                return Photo(camera.name, axis_length_m(one), draw_world(image, one))
    return None


def _picture(camera: SessionCamera, instant: int | None) -> Image | None:
    """Return what a camera recorded of the board at an instant, or at first; in colours, 8 bits."""
    source: FrameSource | None = camera.extrinsics or camera.background
    if source is None:
        return None
    try:
        if camera.extrinsics is not None and instant is not None:
            image = next(iter(source.frames(instant, instant + 1)), None)
        else:
            image = source.first()
    except SessionError:
        return None
    if image is None or image.dtype != np.uint8:
        return None
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., :3])
