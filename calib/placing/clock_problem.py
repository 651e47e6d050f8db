"""Clocks, poses and paths adjusted together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.lens import cam_from_img
from hybridve.calib.placing.board_tracks import Tracks, interpolated
from hybridve.calib.placing.clock_start import MIN_COMMON, Start
from hybridve.calib.pose import Pose, compose, invert, moved_pose
from hybridve.calib.solving.consensus import pose_distances
from hybridve.calib.solving.least_squares import Limits, NormalEquations, Step, minimized

#: Instants adjusted together at most.
_MAX_INSTANTS = 80

#: Steps of the adjustment, and the share of the cost that the last one gains.
_MAX_STEPS = 60
_COST_SHARE = 1e-13

#: A step moves an offset by so many frames at most.
_LARGEST_CHANGE = 0.5

#: Residuals beyond this many robust standard deviations weigh less than squared.
_LOSS_SIGMAS = 3.0

#: The least share of the corners' speed (mean square) that must be motion rather than noise: of all
#: of it, and of that which tells an offset; the mean square, (pixels a frame) squared, of no motion
#: at all; and the largest standard deviation of an offset that counts as known, frames.
MIN_MOTION = 0.75
MIN_TELLING = 0.5
_STILL = 1e-12
KNOWN_FRAMES = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Offsets, and how far they can be trusted.

    `motion` is the share of the corners' mean square speed that is no noise, `telling` the same of
    what tells an offset: the speed that no other place of the camera and the boards explains.
    """

    offset_frames: NDArray[np.float64]
    std_frames: NDArray[np.float64]
    motion: NDArray[np.float64]
    telling: NDArray[np.float64]
    rms_px: float


@dataclass(frozen=True, slots=True, eq=False)
class _Sampled:
    """Offsets, poses, and all views there: residuals (V, N, 2) px and slopes; 0 where not seen."""

    offsets: NDArray[np.float64]
    cam_from_rig: NDArray[np.float64]
    rig_from_board: NDArray[np.float64]
    residuals: NDArray[np.float64]
    by_point: NDArray[np.float64]
    points_cam: NDArray[np.float64]
    speed: NDArray[np.float64]
    noise: NDArray[np.float64]
    speed_noise: NDArray[np.float64]
    common_noise: NDArray[np.float64]
    seen: NDArray[np.bool_]


class ClockProblem:
    """Offsets, poses of cameras and of boards at chosen instants, and the tracks that tell them."""

    def __init__(
        self,
        points: NDArray[np.float64],
        focal_px: NDArray[np.float64],
        rays: Sequence[Tracks],
        views: Sequence[tuple[int, int, int, int, NDArray[np.intp]]],
        start: Mapping[int, Start],
        rig_from_board: NDArray[np.float64],
        spacing: int,
    ) -> None:
        self.points = points  # (B, N, 3)
        self.focal_px = focal_px
        self.rays = rays
        self.views = views  # camera, pose, board, instant, listing
        self.spacing = spacing
        self.cameras = np.array([view[0] for view in views])
        self.poses = np.array([view[1] for view in views])
        self.board_points = points[[view[2] for view in views]]  # (V, N, 3)
        self.rig_from_board = rig_from_board
        n_cameras = len(focal_px)
        self.offsets = np.array(
            [start[c].offset if c in start else 0 for c in range(n_cameras)], np.float64
        )
        self.cam_from_rig = np.stack(
            [start[c].cam_from_rig if c in start else np.eye(3, 4) for c in range(n_cameras)]
        )

    @classmethod
    def of(
        cls,
        boards: Sequence[Board],
        cameras: Sequence[Camera],
        tracks: Sequence[Tracks],
        poses: Sequence[Mapping[tuple[int, int], Pose]],
        start: Mapping[int, Start],
        spacing: int,
    ) -> "ClockProblem | None":
        """Choose the instants that most cameras see, and list symmetric boards alike."""
        most = max(len(board.points_board) for board in boards)
        points = np.zeros((len(boards), most, 3))
        for index, board in enumerate(boards):
            points[index, : len(board.points_board)] = board.points_board
        rays = [
            {key: _rays(camera, pixels) for key, pixels in seen.items()}
            for camera, seen in zip(cameras, tracks, strict=True)
        ]
        # Fractions are not known yet, but for the session's own clock: a camera's frame needs its
        # neighbours, and one more on either side.
        usable: dict[tuple[int, int], list[int]] = {}
        for camera in sorted(start):
            late = start[camera].offset
            for key in sorted(rays[camera].keys() & poses[camera].keys()):
                around = [
                    (key[0], key[1] + step * spacing) in rays[camera] for step in (-2, -1, 1, 2)
                ]
                if camera == 0 or (any(around[::3]) and all(around[1:3])):
                    usable.setdefault((key[0], key[1] + late), []).append(camera)
        shared = sorted(key for key, seeing in usable.items() if len(seeing) > 1)
        if len(shared) < MIN_COMMON:
            return None
        chosen = np.linspace(0, len(shared) - 1, min(len(shared), _MAX_INSTANTS))
        views = []
        rig_from_board = []
        for number, place in enumerate(chosen.round().astype(int)):
            board, instant = shared[place]
            first_pose: Pose | None = None
            for camera in usable[board, instant]:
                here = start[camera]
                turned = np.stack(
                    [
                        compose(
                            invert(here.cam_from_rig),
                            compose(
                                poses[camera][board, instant - here.offset],
                                boards[board].board_from_turned(look),
                            ),
                        )
                        for look in range(len(boards[board].looks))
                    ]
                )
                if first_pose is None:
                    first_pose = turned[0]
                look = int(np.argmin(pose_distances(first_pose[None], turned, 1.0)))
                listing = np.arange(most)
                listing[: len(boards[board].points_board)] = boards[board].looks[look]
                views.append((camera, number, board, instant, listing))
            rig_from_board.append(first_pose)
        focal_px = np.array([float(camera.pinhole[0, 0]) for camera in cameras])
        return cls(points, focal_px, rays, views, start, np.array(rig_from_board), spacing)

    def solve(self) -> _Found:
        """Fit everything, robustly."""
        sampled = self.sampled(self.offsets, self.cam_from_rig, self.rig_from_board)
        limits = Limits(_MAX_STEPS, _COST_SHARE)
        sampled = minimized(self._robust(sampled), sampled, limits, self._robust).state
        weights = _weights(sampled, _outlier_px(sampled))
        reduced = self.normal_equations(sampled, weights).reduced()
        normal = reduced.information
        # Interpolation smooths noise: that of the frames themselves is what is sought.
        n_points = int(sampled.seen.sum())
        n_seen_poses = len(np.unique(self.poses[sampled.seen.any(axis=1)]))
        n_unknown = 6 * n_seen_poses + len(normal)
        share_left = max(2 * n_points - n_unknown, 1) / max(2 * n_points, 1)
        square = (weights * (sampled.residuals**2).sum(axis=2)).sum(axis=1) / sampled.noise
        variance = float(square.sum()) / max(2 * n_points - n_unknown, 1)
        # Noise in the speed looks like motion, and so like knowledge, and no pose of the board
        # explains it away; and noise in points is smoothed most half-way between frames, where
        # residuals are smallest, which pulls the offset there. Both are expected values, and are
        # taken off.
        of_noise = 2.0 * share_left * variance * (weights * sampled.seen).sum(axis=1)
        pull, false_motion = np.zeros((2, len(sampled.offsets), 7))
        np.add.at(pull[:, 6], self.cameras, of_noise * sampled.common_noise)
        np.add.at(false_motion[:, 6], self.cameras, of_noise * sampled.speed_noise)
        scale = np.sqrt(np.diag(normal)) + 1e-12
        true_normal = normal - np.diag(false_motion[1:].ravel())
        inverse = np.linalg.pinv(true_normal / np.outer(scale, scale), hermitian=True)
        inverse /= np.outer(scale, scale)
        offsets = sampled.offsets.copy()
        offsets[1:] -= (inverse @ pull[1:].ravel()).reshape(-1, 7)[:, 6]
        scatter = self._scatter(sampled, weights, reduced.back)
        covariance = variance * inverse @ scatter @ inverse
        stds = np.zeros(len(offsets))
        motion, telling = np.ones((2, len(offsets)))
        for camera in range(1, len(offsets)):
            column = 7 * (camera - 1) + 6
            stds[camera] = np.sqrt(max(float(covariance[column, column]), 0.0))
            false, power = false_motion[camera, 6], float(normal[column, column])
            motion[camera] = 1.0 - false / power if power > _STILL * n_points else 0.0
            left = float(inverse[column, column])
            telling[camera] = 1.0 / (1.0 + false * left) if left > 0.0 else 0.0
        total = float((sampled.residuals**2).sum()) / max(n_points, 1)
        return _Found(offsets, stds, motion, telling, float(np.sqrt(total)))

    def _robust(self, sampled: _Sampled) -> "_Robust":
        """Return the problem with outliers as the residuals tell them."""
        return _Robust(self, _outlier_px(sampled))

    def _scatter(
        self, sampled: _Sampled, weights: NDArray[np.float64], back: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the covariance of the right-hand side for noise of variance 1 in the frames.

        Neighbouring instants are interpolated from the same frames, and share their noise: it is
        summed up frame by frame.
        """
        size = back.shape[2]
        camera_part, board_part = self._slopes(sampled)
        scatter = np.zeros((size, size))
        for camera in np.unique(self.cameras):
            of_frame: dict[tuple[int, int], NDArray[np.float64]] = {}
            for row in np.flatnonzero(self.cameras == camera).tolist():
                _, pose, board, instant, listing = self.views[row]
                track = interpolated(
                    self.rays[camera], board, instant - sampled.offsets[camera], self.spacing
                )
                if track is None:
                    continue
                slopes = -board_part[row] @ back[pose]  # (N, 2, size)
                if camera > 0:
                    slopes[..., 7 * (camera - 1) : 7 * camera] += camera_part[row]
                unlisted = np.zeros_like(slopes)
                unlisted[listing] = weights[row][:, None, None] * slopes
                for frame, share in zip(track.frames, track.weights, strict=True):
                    sums = of_frame.setdefault((board, frame), np.zeros_like(unlisted))
                    sums += share * unlisted
            for sums in of_frame.values():
                flat = sums.reshape(-1, size)
                scatter += flat.T @ flat
        return scatter

    def sampled(
        self,
        offsets: NDArray[np.float64],
        cam_from_rig: NDArray[np.float64],
        rig_from_board: NDArray[np.float64],
    ) -> _Sampled:
        """Return all views at offsets, and with cameras and boards at poses."""
        n_views, n_points = self.board_points.shape[:2]
        tracked, speed = np.full((2, n_views, n_points, 2), np.nan)
        noise, speed_noise, common_noise = np.ones(n_views), np.zeros(n_views), np.zeros(n_views)
        for row, (camera, _, board, instant, listing) in enumerate(self.views):
            track = interpolated(self.rays[camera], board, instant - offsets[camera], self.spacing)
            if track is not None:
                tracked[row, : len(track.points)] = track.points
                speed[row, : len(track.points)] = track.speed
                tracked[row], speed[row] = tracked[row][listing], speed[row][listing]
                noise[row], speed_noise[row] = track.noise, track.speed_noise
                common_noise[row] = track.common_noise
        placed = rig_from_board[self.poses]
        points_rig = self.board_points @ placed[:, :, :3].swapaxes(1, 2) + placed[:, None, :, 3]
        seeing = cam_from_rig[self.cameras]
        points_cam = points_rig @ seeing[:, :, :3].swapaxes(1, 2) + seeing[:, None, :, 3]
        x, y, z = np.moveaxis(points_cam, 2, 0)
        focal = self.focal_px[self.cameras][:, None, None]
        seen = np.isfinite(tracked).all(axis=2) & (z > 1e-3)
        z = np.where(seen, z, 1.0)
        flat = np.stack([x / z, y / z], axis=2)
        residuals = np.where(seen[:, :, None], focal * (tracked - flat), 0.0)
        zero = np.zeros_like(z)
        by_point = np.stack(
            [
                np.stack([1.0 / z, zero, -x / z**2], axis=2),
                np.stack([zero, 1.0 / z, -y / z**2], axis=2),
            ],
            axis=2,
        )  # (V, N, 2, 3)
        by_point = np.where(seen[:, :, None, None], focal[..., None] * by_point, 0.0)
        speed = np.where(seen[:, :, None], focal * speed, 0.0)
        return _Sampled(
            offsets,
            cam_from_rig,
            rig_from_board,
            residuals,
            by_point,
            points_cam,
            speed,
            noise,
            speed_noise,
            common_noise,
            seen,
        )

    def normal_equations(self, sampled: _Sampled, weights: NDArray[np.float64]) -> NormalEquations:
        """Return those of cameras and offsets, which are shared, and of the boards' poses.

        The reference holds the rig's frame and the session's clock.
        """
        n_cameras, n_poses = len(sampled.offsets), len(sampled.rig_from_board)
        camera_part, board_part = self._slopes(sampled)
        weighted = weights[..., None, None] * camera_part
        cc = np.einsum("vnki,vnkj->vij", weighted, camera_part)
        bc = np.einsum("vnki,vnkj->vij", board_part, weighted)
        bb = np.einsum("vnki,vnkj,vn->vij", board_part, board_part, weights)
        rc = np.einsum("vnki,vnk->vi", weighted, sampled.residuals)
        rb = np.einsum("vnki,vnk,vn->vi", board_part, sampled.residuals, weights)
        shared, right = np.zeros((n_cameras, 7, n_cameras, 7)), np.zeros((n_cameras, 7))
        mixed = np.zeros((n_poses, n_cameras, 6, 7))
        boards, right_boards = np.zeros((n_poses, 6, 6)), np.zeros((n_poses, 6))
        for camera in range(n_cameras):
            shared[camera, :, camera] = cc[self.cameras == camera].sum(axis=0)
        np.add.at(right, self.cameras, rc)
        np.add.at(mixed, (self.poses, self.cameras), bc)
        np.add.at(boards, self.poses, bb)
        np.add.at(right_boards, self.poses, rb)
        # Of some boards hardly a corner is seen.
        boards += 1e-9 * np.eye(6) * (1.0 + np.trace(boards, axis1=1, axis2=2))[:, None, None]
        size = 7 * (n_cameras - 1)
        return NormalEquations(
            shared[1:, :, 1:].reshape(size, size),
            right[1:].ravel(),
            boards,
            right_boards,
            mixed[:, 1:].transpose(0, 2, 1, 3).reshape(n_poses, 6, size),
        )

    def _slopes(self, sampled: _Sampled) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return by what residuals fall: camera and offset (V, N, 2, 7), board (V, N, 2, 6)."""
        camera_part = np.zeros((*sampled.residuals.shape, 7))
        camera_part[..., :6] = _by_motion(sampled.by_point, sampled.points_cam)
        camera_part[..., 6] = sampled.speed
        seeing = sampled.cam_from_rig[self.cameras]
        points_rig = (sampled.points_cam - seeing[:, None, :, 3]) @ seeing[:, :, :3]
        return camera_part, _by_motion(sampled.by_point @ seeing[:, None, :, :3], points_rig)


def _outlier_px(sampled: _Sampled) -> float:
    """Return beyond which length a residual counts less than squared, pixels."""
    misses = np.linalg.norm(sampled.residuals, axis=2)
    sigma = 0.85 * float(np.median(misses[sampled.seen]))  # of a two-dimensional error
    return max(_LOSS_SIGMAS * sigma, 1e-9)


def _weights(sampled: _Sampled, limit_px: float) -> NDArray[np.float64]:
    """Return the weights (V, N) of Huber's loss."""
    misses = np.linalg.norm(sampled.residuals, axis=2)
    return np.where(misses <= limit_px, 1.0, limit_px / np.maximum(misses, limit_px))


@dataclass(frozen=True, slots=True, eq=False)
class _Robust:
    """What least squares need, with Huber's loss."""

    clocks: ClockProblem
    limit_px: float

    def cost(self, state: _Sampled) -> float:
        misses = np.linalg.norm(state.residuals, axis=2)[state.seen]
        if not len(misses):
            return np.inf
        limit = self.limit_px
        loss = np.where(misses <= limit, misses**2, 2.0 * limit * misses - limit**2)
        # By the mean: as offsets move, corners come and go.
        return float(loss.mean()) * state.seen.size

    def normal_equations(self, state: _Sampled) -> NormalEquations:
        return self.clocks.normal_equations(state, _weights(state, self.limit_px))

    def moved(self, state: _Sampled, step: Step) -> _Sampled:
        steps = step.shared.reshape(-1, 7)
        offsets, cam_from_rig = state.offsets.copy(), state.cam_from_rig.copy()
        offsets[1:] += np.clip(steps[:, 6], -_LARGEST_CHANGE, _LARGEST_CHANGE)
        cam_from_rig[1:] = moved_pose(cam_from_rig[1:], steps[:, :6])
        return self.clocks.sampled(
            offsets, cam_from_rig, moved_pose(state.rig_from_board, step.blocks)
        )


def _by_motion(by_point: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return slopes (V, N, 2, 6) by turn and shift from those by points (V, N, 2, 3)."""
    turn = np.cross(points[:, :, None, :], by_point)
    return np.concatenate([turn, by_point], axis=3)


def _rays(camera: Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rays (N, 2) at depth 1; NaN where a point is not seen."""
    rays = np.full(pixels.shape, np.nan)
    seen = is_seen(pixels)
    if seen.any():
        rays[seen] = cam_from_img(camera, pixels[seen])
    return rays
