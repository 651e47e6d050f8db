"""The world of a rig, drawn into a picture that one of its cameras took."""

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.lens import project_points
from hybridve.hull.view.labels import Image, bgr, plate, put_text, text_size
from hybridve.hull.view.paint import AXIS_RGB, round_length

#: Points along a line, so that it bends as the lens bends it.
_STEPS = 40

#: Lines of the floor's grid on either side of the origin.
_GRID = 2

#: How long an axis is, as a share of how far off the origin is.
_AXIS_SHARE = 0.25


def axis_length_m(camera: Camera) -> float:
    """Return how long the axes are drawn in a camera's picture: a round length, metres."""
    return round_length(_AXIS_SHARE * float(np.linalg.norm(camera.center_world)))


def share_in_picture(camera: Camera) -> float:
    """Return how much of the axes a camera sees, 0 to 1; 0 where it does not see the origin."""
    lines = np.concatenate(_axes(axis_length_m(camera)))
    pixels, depths_m = project_points(camera, np.concatenate([np.zeros((1, 3)), lines]))
    extent = (camera.width_px, camera.height_px)
    with np.errstate(invalid="ignore"):
        seen = (depths_m > 0) & ((pixels >= 0) & (pixels < extent)).all(axis=1)
    return float(seen[1:].mean()) if seen[0] else 0.0


def draw_world(image: Image, camera: Camera) -> Image:
    """Return a camera's picture as recorded, with the world's axes and the grid of its floor.

    Parameters
    ----------
    image : (H, W, 3) uint8
        BGR.
    camera : Camera
        What took it, where it stood then.
    """
    length_m = axis_length_m(camera)
    result = image.copy()
    scale = max(camera.height_px / 500, 0.5)
    reach_m = _GRID * length_m
    places = np.arange(-_GRID, _GRID + 1) * length_m
    for at in places:
        for axis in (0, 1):
            ends = np.zeros((2, 3))
            ends[:, axis], ends[:, 1 - axis] = (-reach_m, reach_m), at
            _line(result, camera, _between(ends), (0.95, 0.95, 0.95), max(1, round(scale)))
    for axis, points in enumerate(_axes(length_m)):
        _line(result, camera, points, (0.0, 0.0, 0.0), max(3, round(6 * scale)))
        _line(result, camera, points, AXIS_RGB[axis], max(2, round(3.5 * scale)))
    for axis, points in enumerate(_axes(length_m)):
        tip, _ = project_points(camera, 1.08 * points[-1:])
        if np.isfinite(tip).all():
            _label(result, "XYZ"[axis], tip[0], scale, axis)
    return result


def _axes(length_m: float) -> list[NDArray[np.float64]]:
    """Return points along the three axes, (`_STEPS`, 3) each, from the origin on."""
    return [_between(np.stack([np.zeros(3), tip])) for tip in length_m * np.eye(3)]


def _between(ends: NDArray[np.float64]) -> NDArray[np.float64]:
    shares = np.linspace(0.0, 1.0, _STEPS)[:, None]
    return np.asarray((1.0 - shares) * ends[0] + shares * ends[1])


def _line(
    image: Image,
    camera: Camera,
    points_world: NDArray[np.float64],
    rgb: tuple[float, float, float],
    width_px: int,
) -> None:
    """Draw a line (N, 3) as far as it is before the camera and near its picture."""
    pixels, _ = project_points(camera, points_world)
    extent = np.array([camera.width_px, camera.height_px])
    off_px = np.nan_to_num(np.abs(pixels - extent / 2), nan=np.inf)
    near = np.asarray((off_px < 1.5 * extent).all(axis=1))
    for first in np.flatnonzero(near[:-1] & near[1:]):
        ends = np.rint(16 * (pixels[first : first + 2] - 0.5)).astype(int)
        start, stop = ((int(x), int(y)) for x, y in ends)
        cv2.line(image, start, stop, bgr(rgb), width_px, cv2.LINE_AA, 4)


def _label(image: Image, text: str, at_px: NDArray[np.float64], scale: float, axis: int) -> None:
    size = 0.7 * scale
    width, above, below = text_size(text, size, bold=True)
    left, baseline = round(float(at_px[0]) - width / 2), round(float(at_px[1]) + above / 2)
    if left < 0 or baseline - above < 0:
        return
    plate(image, (left - 3, baseline - above - 3, left + width + 3, baseline + below), 0.75)
    put_text(image, text, (left, baseline), size, AXIS_RGB[axis], bold=True)
