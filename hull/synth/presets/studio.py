"""What recordings share: the room, the lamp, the board, cameras on a ring, and ways to move."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.pose import Pose
from hybridve.hull.synth.stage import Lamp, Panel, Room, pose_at

#: The calibration target.
BOARD = Chessboard(columns=8, rows=5, square_m=0.1)

#: What casts the shadows.
LAMP = Lamp((0.75, -0.25, 2.9), 0.22, 0.42)

#: The middle of the working volume, metres, world: what cameras look at unless told otherwise.
MIDDLE_WORLD = (0.37, 0.18, 0.52)


def make_room() -> Room:
    """Return the room: a tiled floor, four walls, and what hangs on them."""
    return Room(
        center_world=(0.45, 0.1),
        half_size_m=(3.6, 3.3),
        yaw_rad=0.3,
        floor=(124.0, 136.0, 142.0),
        wall=(172.0, 176.0, 174.0),
        tile_m=0.45,
        panels=(
            Panel(0, (-1.9, 0.0), (-1.0, 2.05), (98.0, 118.0, 132.0)),
            Panel(0, (0.4, 0.9), (1.6, 1.7), (150.0, 122.0, 96.0)),
            Panel(1, (-1.4, 0.0), (0.3, 0.85), (108.0, 112.0, 104.0)),
            Panel(2, (-0.6, 1.0), (0.5, 1.8), (96.0, 108.0, 78.0)),
            Panel(2, (1.4, 0.0), (2.3, 1.4), (130.0, 138.0, 150.0)),
            Panel(3, (-2.2, 0.75), (-0.9, 1.6), (158.0, 150.0, 128.0)),
            Panel(3, (0.5, 0.0), (1.5, 1.1), (90.0, 104.0, 128.0)),
        ),
    )


def ring_camera(
    name: str,
    width_px: int,
    height_px: int,
    azimuth_deg: float,
    distance_m: float,
    height_m: float,
    lens: tuple[float, float, float],
    look_at_world: tuple[float, float, float] = MIDDLE_WORLD,
) -> Camera:
    """Return a camera on a ring about the working volume, and looking at it.

    `lens` is the focal length in pixels, k1 and k2. With k2 above 9/20 of k1 squared the radius in
    the image grows with the angle everywhere: r(1 + k1 r^2 + k2 r^4) has a positive derivative.
    """
    focal_px, k1, k2 = lens
    target = np.array(look_at_world)
    azimuth = np.deg2rad(azimuth_deg)
    center = np.array(
        [
            target[0] + distance_m * np.cos(azimuth),
            target[1] + distance_m * np.sin(azimuth),
            height_m,
        ]
    )
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    # Cheap lenses sit a few pixels off the middle and lean a little.
    off_x, off_y = 7.0 * np.cos(5.0 * azimuth), 6.0 * np.sin(3.0 * azimuth)
    params = np.array(
        [
            focal_px,
            focal_px * 1.003,
            width_px / 2 + off_x,
            height_px / 2 + off_y,
            k1,
            k2,
            4e-4 * np.sin(azimuth),
            -3e-4 * np.cos(azimuth),
        ]
    )
    pose = np.column_stack([rotation, -rotation @ center])
    return Camera(name, "OPENCV", width_px, height_px, params, pose)


def there_and_back(moment: float, turn: float) -> float:
    """Return 0 at the beginning and the end and 1 at `turn`, smoothly."""
    way = moment / turn if moment <= turn else (1.0 - moment) / (1.0 - turn)
    return float(0.5 - 0.5 * np.cos(np.pi * way))


@dataclass(frozen=True, slots=True)
class Key:
    """Where something is at a moment.

    Attributes
    ----------
    moment : float
        From 0 to 1.
    position : tuple of 3 float
        Metres, world.
    rotate_deg : tuple of 3 float
        Turned about x, then y, then z.
    """

    moment: float
    position: tuple[float, float, float]
    rotate_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)


def track(keys: Sequence[Key]) -> Callable[[float], Pose]:
    """Return the motion that goes from key to key and rests at each for an instant.

    Before the first key and after the last it stands still.
    """
    moments = np.array([key.moment for key in keys])
    values = np.array([[*key.position, *key.rotate_deg] for key in keys])

    def pose(moment: float) -> Pose:
        index = int(np.clip(np.searchsorted(moments, moment) - 1, 0, len(keys) - 2))
        way = (moment - moments[index]) / (moments[index + 1] - moments[index])
        eased = 0.5 - 0.5 * np.cos(np.pi * np.clip(way, 0.0, 1.0))
        x, y, z, a, b, c = values[index] + eased * (values[index + 1] - values[index])
        return pose_at((float(x), float(y), float(z)), (float(a), float(b), float(c)))

    return pose
