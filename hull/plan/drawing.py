"""A plan as cameras, boards and places: where everything is, and what is seen of it.

Metres in the frame of the plan: Z up from the floor, on which the board lies.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board
from hybridve.calib.boards.named import make_board
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError, SessionError
from hybridve.calib.lens import img_from_cam
from hybridve.calib.pose import Pose, compose, invert, rotation_about_axes, transform
from hybridve.hull.capture.session_tables import TargetTable
from hybridve.hull.plan.tables import CameraTable, LensTable, PlanTable, RingTable

#: A board is found where all of it is in the picture by so much, and is seen at less than this
#: angle off its normal: what holds for boards in hand. One on the floor is found up to 80 degrees.
_MARGIN_PX = 4.0
_MOST_SLANT_DEG, _MOST_FLOOR_SLANT_DEG = 65.0, 80.0

#: Squares are found down to so many pixels across.
LEAST_SQUARE_PX = 5.0

#: How a board in hand is held: tilted by up to so much, its diagonal filling such a share of the
#: picture's width.
_TILT_DEG = 40.0
_FILLS = (0.35, 0.7)

#: Places of a board that are tried for each that is wanted.
_TRIES = 60


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """What a plan draws.

    Attributes
    ----------
    cameras : tuple of Camera
        Pinholes, as lenses of the model OPENCV whose distortion is zero.
    board : Board
        The board.
    world_from_board : (3, 4) float64
        Where it lies on the floor.
    low_world, high_world : (3,) float64
        The corners of the volume, metres.
    """

    cameras: tuple[Camera, ...]
    board: Board
    world_from_board: Pose
    low_world: NDArray[np.float64]
    high_world: NDArray[np.float64]


def draw(plan: PlanTable, target: TargetTable) -> Drawing:
    """Return what a plan draws.

    Raises
    ------
    SessionError
        If a camera looks at where it stands, or straight up or down past its own up.
    CalibrationError
        If there can be no such board.
    """
    cameras = [_camera(one, plan.lens) for one in plan.camera]
    if plan.ring is not None:
        taken = {one.name for one in cameras}
        free = (name for name in _numbered() if name not in taken)
        cameras = [_camera(one, plan.lens) for one in _ring(plan.ring, free)] + cameras
    board = make_board(target.table())
    middle = board.points_board.mean(axis=0)
    lies = np.column_stack([np.eye(3), np.array(plan.calibration.lies_at_m) - middle])
    return Drawing(
        tuple(cameras),
        board,
        lies,
        np.array(plan.volume.low_m),
        np.array(plan.volume.high_m),
    )


def _numbered() -> Iterator[str]:
    number = 1
    while True:
        yield f"cam{number}"
        number += 1


def _ring(ring: RingTable, names: Iterator[str]) -> list[CameraTable]:
    heights = (ring.height_m, ring.height_m if ring.other_height_m is None else ring.other_height_m)
    # All round, the last is not where the first is; over less, cameras stand at both ends.
    gaps = ring.cameras if ring.over_deg == 360.0 else ring.cameras - 1
    found = []
    for number in range(ring.cameras):
        angle = np.deg2rad(ring.first_deg + ring.over_deg * number / gaps)
        at_m = (
            ring.looks_at_m[0] + ring.radius_m * float(np.cos(angle)),
            ring.looks_at_m[1] + ring.radius_m * float(np.sin(angle)),
            heights[number % 2],
        )
        found.append(CameraTable(name=next(names), at_m=at_m, looks_at_m=ring.looks_at_m))
    return found


def _camera(one: CameraTable, lens: LensTable) -> Camera:
    width_px, height_px = map(int, (one.size_px or lens.size_px).split("x"))
    across = np.deg2rad(one.across_deg or lens.across_deg)
    focal_px = width_px / 2.0 / np.tan(across / 2.0)
    center, target = np.array(one.at_m), np.array(one.looks_at_m)
    distance_m = float(np.linalg.norm(target - center))
    if distance_m < 1e-6:
        raise SessionError(f"camera {one.name!r}: looks at where it stands; move looks_at_m")
    forward = (target - center) / distance_m
    # Straight up or down there is no upright: then y is taken for it.
    up = np.array([0.0, 0.0, 1.0] if np.hypot(*forward[:2]) > 1e-6 else [0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    upright = np.stack([right, np.cross(forward, right), forward])
    rotation = rotation_about_axes((0.0, 0.0, one.roll_deg)) @ upright
    params = np.array([focal_px, focal_px, width_px / 2.0, height_px / 2.0, 0.0, 0.0, 0.0, 0.0])
    pose = np.column_stack([rotation, -rotation @ center])
    return Camera(one.name, "OPENCV", width_px, height_px, params, pose)


# --- What is seen of boards ---------------------------------------------------------------------


def square_px(camera: Camera, board: Board, world_from_board: Pose) -> float:
    """Return how small the smallest square, or tag, of a board is in a picture, pixels.

    0 where the board is not wholly in the picture, or shows its back.
    """
    cam_from_board = compose(camera.cam_from_world, world_from_board)
    pixels = _seen(camera, cam_from_board, board, _MOST_FLOOR_SLANT_DEG)
    if pixels is None:
        return 0.0
    points = board.points_board
    apart_m = np.linalg.norm(points[:, None] - points[None], axis=2)
    first, second = np.nonzero(np.abs(apart_m - board.square_m) < 0.01 * board.square_m)
    return float(np.linalg.norm(pixels[first] - pixels[second], axis=1).min())


def stills_of(camera: Camera, board: Board, count: int, seed: int) -> list[Pose]:
    """Return cam_from_board of a board in hand, all over the picture, tilted, near and far.

    Raises
    ------
    CalibrationError
        If no such view has the whole board in it.
    """
    rng = np.random.default_rng(seed)
    middle = board.points_board.mean(axis=0)
    diagonal_m = float(np.linalg.norm(np.ptp(board.points_board, axis=0)))
    focal_px = camera.params[0]
    found: list[Pose] = []
    for _ in range(_TRIES * count):
        tilt = rotation_about_axes(
            (
                180.0 + rng.uniform(-_TILT_DEG, _TILT_DEG),
                rng.uniform(-_TILT_DEG, _TILT_DEG),
                rng.uniform(-25.0, 25.0),
            )
        )
        depth_m = diagonal_m * focal_px / (camera.width_px * rng.uniform(*_FILLS))
        across = rng.uniform(-0.45, 0.45, 2) * (camera.width_px, camera.height_px) / focal_px
        at = np.append(across, 1.0) * depth_m
        pose = np.column_stack([tilt, at - tilt @ middle])
        if _seen(camera, pose, board, _MOST_SLANT_DEG) is not None:
            found.append(pose)
            if len(found) == count:
                return found
    raise CalibrationError(
        f"camera {camera.name!r}: of {_TRIES * count} places of the board {len(found)} have it "
        f"wholly in the picture, expected {count}; is the picture very narrow?"
    )


def moved_boards(drawing: Drawing, count: int) -> list[Pose]:
    """Return world_from_board of a board that is carried about in the volume."""
    rng = np.random.default_rng(1)
    middle = drawing.board.points_board.mean(axis=0)
    found = []
    for _ in range(count):
        turn = rotation_about_axes(
            (rng.uniform(-70, 70), rng.uniform(-70, 70), rng.uniform(-180, 180))
        )
        at = rng.uniform(drawing.low_world, drawing.high_world)
        found.append(np.column_stack([turn, at - turn @ middle]))
    return found


def pixels_of(
    camera: Camera, board: Board, world_from_board: Pose, *, is_on_floor: bool = False
) -> NDArray[np.float64] | None:
    """Return where a camera sees the points of a board, (N, 2) pixels; None if it finds none."""
    slant_deg = _MOST_FLOOR_SLANT_DEG if is_on_floor else _MOST_SLANT_DEG
    return _seen(camera, compose(camera.cam_from_world, world_from_board), board, slant_deg)


def _seen(
    camera: Camera, cam_from_board: Pose, board: Board, most_slant_deg: float
) -> NDArray[np.float64] | None:
    points_cam = transform(cam_from_board, board.points_board)
    if (points_cam[:, 2] <= 0).any():
        return None
    to_camera = invert(cam_from_board)[:, 3] - board.points_board.mean(axis=0)
    if to_camera[2] <= np.linalg.norm(to_camera) * np.cos(np.deg2rad(most_slant_deg)):
        return None
    pixels = img_from_cam(camera, points_cam)
    size_px = np.array([camera.width_px, camera.height_px])
    is_inside = ((pixels > _MARGIN_PX) & (pixels < size_px - _MARGIN_PX)).all()
    return pixels if is_inside else None


# --- What is seen of the volume -----------------------------------------------------------------


def places_in(drawing: Drawing, n: int, margin_m: float = 0.0) -> NDArray[np.float64]:
    """Return the middles of n x n x n equal boxes of the volume less a margin, (n^3, 3) metres."""
    low, high = drawing.low_world + margin_m, drawing.high_world - margin_m
    middle = (drawing.low_world + drawing.high_world) / 2.0
    low, high = np.minimum(low, middle), np.maximum(high, middle)
    shares = (np.arange(n) + 0.5) / n
    grid = np.stack(np.meshgrid(shares, shares, shares, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(low + grid * (high - low))


def sees_ball(camera: Camera, center_world: NDArray[np.float64], radius_m: float) -> bool:
    """Tell whether all of a ball is in a camera's picture."""
    center = transform(camera.cam_from_world, center_world[None])[0]
    if center[2] <= radius_m:
        return False
    focal_px, size_px = camera.params[0], np.array([camera.width_px, camera.height_px])
    # The four planes through the picture's sides: the ball is wholly on the inner side of each.
    half = size_px / 2.0
    inward_m = (half * center[2] - focal_px * np.abs(center[:2])) / np.hypot(focal_px, half)
    return bool((inward_m >= radius_m).all())
