"""Pictures of a textured room from a camera that turns, in closed form but for the texture."""

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import N_PARAMS, Camera
from hybridve.calib.lens import cam_from_img, img_from_cam
from hybridve.calib.pose import rotation_of

#: Texels of the wall at depth 1, a side, and how many of them a unit has.
_SIZE = 2048
_PER_UNIT = 700.0


def bent_lens(size_px: tuple[int, int] = (480, 360), model: str = "OPENCV") -> Camera:
    """A camera whose straight lines bend by some pixels at the border, unless it is a pinhole."""
    width_px, height_px = size_px
    pinhole = [0.8 * width_px, 0.79 * width_px, width_px / 2 + 4, height_px / 2 - 3]
    bent = [-0.15, 0.05] if model == "OPENCV" else [0.05, -0.01]
    params = np.zeros(N_PARAMS[model])
    params[:6] = (pinhole + bent)[: len(params)]
    return Camera("cam1", model, width_px, height_px, params, np.eye(3, 4))


@cache
def wall(seed: int, blank: float = 0.0) -> NDArray[np.float32]:
    """Grey levels of the plane at depth 1: blotches of many sizes; a share of it is blank."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(_SIZE)[:, None], np.fft.rfftfreq(_SIZE)[None])
    weight = np.exp(-((frequency / 0.12) ** 2)) / (frequency + 0.01)
    weight[0, 0] = 0.0
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((_SIZE, _SIZE))) * weight)
    noise /= noise.std()
    tiles = rng.random((16, 16)) < blank
    noise[np.kron(tiles, np.ones((_SIZE // 16, _SIZE // 16), bool))] = 0.0
    return np.asarray(cv2.GaussianBlur(128.0 + 30.0 * noise, (0, 0), 1.5), np.float32)


def _on_wall(rays: NDArray[np.float64]) -> NDArray[np.float64]:
    return rays * _PER_UNIT + (_SIZE / 2 - 0.5)


def see_wall(
    lens: Camera,
    texture: NDArray[np.float32],
    turn: NDArray[np.float64],
    zoom: float = 1.0,
    place_of: Callable[[NDArray[np.float64]], NDArray[np.float64]] = _on_wall,
) -> NDArray[np.float32]:
    """The wall as a camera sees it once the room was turned by the vector `turn` about it, (H, W).

    `zoom` is how many times longer its focal length is than the lens says; `place_of` tells which
    texel a ray (N, 2) at depth 1 meets before the turn.
    """
    columns, rows = np.meshgrid(np.arange(lens.width_px) + 0.5, np.arange(lens.height_px) + 0.5)
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    center = lens.pinhole[:2, 2]
    rays = cam_from_img(lens, center + (pixels - center) / zoom)
    before = np.column_stack([rays, np.ones(len(rays))]) @ rotation_of(turn)
    places = place_of(before[:, :2] / before[:, 2:]).astype(np.float32)
    x, y = (places[:, axis].reshape(lens.height_px, lens.width_px) for axis in (0, 1))
    found = cv2.remap(texture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
    return np.asarray(found, np.float32)


def true_shift_px(
    lens: Camera, turn: NDArray[np.float64], zoom: float = 1.0
) -> NDArray[np.float64]:
    """By how much that shifts the room in the middle of the picture: (2,) right and down."""
    middle = np.array([[lens.width_px / 2, lens.height_px / 2]])
    ray = np.append(cam_from_img(lens, middle)[0], 1.0)
    center = lens.pinhole[:2, 2]
    now = img_from_cam(lens, (rotation_of(turn) @ ray)[None])[0]
    return np.asarray(center + zoom * (now - center) - middle[0])


def exposed(
    picture: NDArray[np.float32],
    rng: np.random.Generator,
    *,
    gain: float = 1.0,
    noise: float = 1.0,
    quality: int = 90,
) -> NDArray[np.uint8]:
    """A picture of another exposure, with noise, through JPEG."""
    grey = gain * picture + noise * rng.standard_normal(picture.shape)
    whole = np.clip(np.round(grey), 0, 255).astype(np.uint8)
    packed = cv2.imencode(".jpg", whole, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), np.uint8)


def with_blob(
    picture: NDArray[np.float32], texture: NDArray[np.float32], place: tuple[int, int]
) -> NDArray[np.float32]:
    """A picture in which something textured, a third as wide, stands at (column, row)."""
    height_px, width_px = (side // 3 for side in picture.shape)
    left, top = (
        int(np.clip(at, 0, side))
        for at, side in zip(place, (2 * width_px, 2 * height_px), strict=True)
    )
    covered = picture.copy()
    covered[top : top + height_px, left : left + width_px] = texture[:height_px, :width_px]
    return covered
