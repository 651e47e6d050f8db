"""Views of boards that were located: from each, where its board was."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Sighting, is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.lens import img_from_cam
from hybridve.calib.placing.moments import Moment
from hybridve.calib.pose import Pose, compose, invert, transform
from hybridve.calib.solving.lens_judge import view_label
from hybridve.calib.solving.locate import locate_board

#: Common views that differ by more than this (radians plus shares of the board's distance, median)
#: share no relative pose.
DISAGREE = 0.2


class SolvedLens(Protocol):
    """What linking needs of a lens that was fitted to the views of one camera."""

    @property
    def camera(self) -> Camera:
        """The lens; its pose is not used."""
        ...

    @property
    def views(self) -> Mapping[tuple[str, int], Pose]:
        """By image and board, where the board lay as the camera saw it: cam_from_board."""
        ...

    @property
    def pixels(self) -> Mapping[tuple[str, int], NDArray[np.float64]]:
        """Their points: (N, 2) pixels, NaN where not seen or an outlier."""
        ...

    @property
    def dropped(self) -> Mapping[str, str]:
        """Views that do not fit, by `view_label`, and why."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """A located view.

    Attributes
    ----------
    cam_from_board : (L, 3, 4) float64
        One pose for each look of the board, for `moment` and the pixels as given.
    weight : float
        How sure the board's tilt is: 1 / rad^2 for noise of one pixel.
    """

    camera: int
    board: int
    moment: Moment
    image: str
    pixels: NDArray[np.float64]
    cam_from_board: NDArray[np.float64]
    weight: float


def locate(
    boards: Sequence[Board],
    lens: SolvedLens,
    camera: int,
    sighting: Sighting,
    is_labelled: bool,
) -> Look | None:
    """Return a view with its poses; None if it was dropped, or has none."""
    board = boards[sighting.board]
    key = (sighting.image, sighting.board)
    pose, pixels = lens.views.get(key), lens.pixels.get(key, sighting.pixels)
    is_dropped = view_label(boards, sighting.image, sighting.board) in lens.dropped
    if pose is None and sighting.instant is not None and not is_dropped:
        located = locate_board(lens.camera, board.points_board, pixels)
        pose = None if located is None else located[0]
    if pose is None:
        return None
    # Stills are listed as they were found: only what was seen at once can be listed consistently.
    n_looks = 1 if is_labelled and sighting.instant is not None else len(board.looks)
    turned = [compose(pose, board.board_from_turned(look)) for look in range(n_looks)]
    moment = (
        Moment.of_still(camera, sighting.image)
        if sighting.instant is None
        else Moment.of_clip(sighting.instant)
    )
    points_cam = transform(pose, board.points_board[is_seen(pixels)])
    weight = _tilt_weight(points_cam, float(lens.camera.pinhole[0, 0]))
    return Look(camera, sighting.board, moment, sighting.image, pixels, np.stack(turned), weight)


def corner_residuals(
    camera: Camera, cam_from_board: Pose, board: Board, pixels: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return observed minus projected, (S, 2) pixels, of the points that were seen.

    A point behind the camera misses by more than the image.
    """
    seen = is_seen(pixels)
    points_cam = transform(cam_from_board, board.points_board[seen])
    projected = np.full((len(points_cam), 2), 10.0 * camera.width_px)
    ahead = points_cam[:, 2] > 0
    if ahead.any():
        projected[ahead] = img_from_cam(camera, points_cam[ahead])
    return np.asarray(pixels[seen] - np.where(np.isfinite(projected), projected, 1e5))


def _tilt_weight(points_cam: NDArray[np.float64], focal_px: float) -> float:
    """Return 1 / variance of a board's tilt (rad^-2) for corners that are wrong by one pixel."""
    x, y, z = points_cam.T
    zero, one = np.zeros_like(z), np.ones_like(z)
    along_u = np.stack([one / z, zero, -x / z**2], axis=-1)
    along_v = np.stack([zero, one / z, -y / z**2], axis=-1)
    gradients = focal_px * np.concatenate([along_u, along_v])  # (2N, 3)
    points = np.concatenate([points_cam, points_cam]) - points_cam.mean(axis=0)
    jacobian = np.concatenate([np.cross(points, gradients), gradients], axis=1)  # (2N, 6)
    normal = jacobian.T @ jacobian
    scale = np.sqrt(np.diag(normal)) + 1e-12
    covariance = np.linalg.pinv(normal / np.outer(scale, scale), hermitian=True)
    variance = float(np.trace((covariance / np.outer(scale, scale))[:3, :3]))
    return 1.0 / max(variance, 1e-12)


def placed_by(look: Look, cam_from_rig: Pose, body_from_board: Pose) -> NDArray[np.float64]:
    """Return where a view places its board's body in its camera's rig: (L, 3, 4)."""
    from_cam, from_body = invert(cam_from_rig), invert(body_from_board)
    return np.stack([compose(from_cam, compose(pose, from_body)) for pose in look.cam_from_board])


def inverses(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse of each pose, (K, 3, 4)."""
    return np.stack([invert(pose) for pose in poses])


def products(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return every pose of (K, 3, 4) after every one of (L, 3, 4): (K L, 3, 4)."""
    return np.stack([compose(one, other) for one in first for other in second])
