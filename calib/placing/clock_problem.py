"""Clocks, poses and paths adjusted together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.lens import cam_from_img
from hybridve.calib.placing.board_tracks import Tracks, interpolated
from hybridve.calib.placing.clock_start import MIN_COMMON, Start
from hybridve.calib.pose import Pose, compose, invert
from hybridve.calib.solving.consensus import pose_distances

#: Instants adjusted together at most.
_MAX_INSTANTS = 80

#: Steps of the adjustment; it has converged when no offset moves further (frames).
_MAX_STEPS = 30
_CONVERGED_FRAMES = 1e-8

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
    """All views at given offsets: residuals (V, N, 2) px and their slopes; 0 where not seen."""

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
        """Fit everything by Levenberg and Marquardt's method, robustly."""
        damping = 1e-4
        sampled = self._sample(self.offsets, self.cam_from_rig, self.rig_from_board)
        for _ in range(_MAX_STEPS):
            weights, limit = self._weights(sampled)
            normal, right, back = self._normal_equations(sampled, weights)
            cost = self._cost(sampled, limit)
            moved = 0.0
            while damping < 1e8:
                damped = normal + damping * np.diag(np.diag(normal) + 1e-9)
                step = np.asarray(np.linalg.solve(damped, right), np.float64)
                trial = self._moved(step, back(step))
                trial_sampled = self._sample(*trial)
                if self._cost(trial_sampled, limit) <= cost:
                    moved = float(np.abs(trial[0] - self.offsets).max())
                    self.offsets, self.cam_from_rig, self.rig_from_board = trial
                    sampled = trial_sampled
                    damping = max(0.1 * damping, 1e-12)
                    break
                damping *= 10.0
            if moved < _CONVERGED_FRAMES:
                break
        weights, _ = self._weights(sampled)
        normal, _, back = self._normal_equations(sampled, weights)
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
        pull, false_motion = np.zeros((2, len(self.offsets), 7))
        np.add.at(pull[:, 6], self.cameras, of_noise * sampled.common_noise)
        np.add.at(false_motion[:, 6], self.cameras, of_noise * sampled.speed_noise)
        scale = np.sqrt(np.diag(normal)) + 1e-12
        true_normal = normal - np.diag(false_motion[1:].ravel())
        inverse = np.linalg.pinv(true_normal / np.outer(scale, scale), hermitian=True)
        inverse /= np.outer(scale, scale)
        offsets = self.offsets.copy()
        offsets[1:] -= (inverse @ pull[1:].ravel()).reshape(-1, 7)[:, 6]
        scatter = self._scatter(sampled, weights, back)
        covariance = variance * inverse @ scatter @ inverse
        stds = np.zeros(len(self.offsets))
        motion, telling = np.ones((2, len(self.offsets)))
        for camera in range(1, len(self.offsets)):
            column = 7 * (camera - 1) + 6
            stds[camera] = np.sqrt(max(float(covariance[column, column]), 0.0))
            false, power = false_motion[camera, 6], float(normal[column, column])
            motion[camera] = 1.0 - false / power if power > _STILL * n_points else 0.0
            left = float(inverse[column, column])
            telling[camera] = 1.0 / (1.0 + false * left) if left > 0.0 else 0.0
        total = float((sampled.residuals**2).sum()) / max(n_points, 1)
        return _Found(offsets, stds, motion, telling, float(np.sqrt(total)))

    def _scatter(
        self, sampled: _Sampled, weights: NDArray[np.float64], back: "_Back"
    ) -> NDArray[np.float64]:
        """Return the covariance of the right-hand side for noise of variance 1 in the frames.

        Neighbouring instants are interpolated from the same frames, and share their noise: it is
        summed up frame by frame.
        """
        size = len(back.solved[0, 0])
        camera_part, board_part = self._slopes(sampled)
        scatter = np.zeros((size, size))
        for camera in np.unique(self.cameras):
            of_frame: dict[tuple[int, int], NDArray[np.float64]] = {}
            for row in np.flatnonzero(self.cameras == camera).tolist():
                _, pose, board, instant, listing = self.views[row]
                track = interpolated(
                    self.rays[camera], board, instant - self.offsets[camera], self.spacing
                )
                if track is None:
                    continue
                slopes = -board_part[row] @ back.solved[pose]  # (N, 2, size)
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

    def _sample(
        self,
        offsets: NDArray[np.float64],
        cam_from_rig: NDArray[np.float64],
        rig_from_board: NDArray[np.float64],
    ) -> _Sampled:
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
            residuals, by_point, points_cam, speed, noise, speed_noise, common_noise, seen
        )

    def _weights(self, sampled: _Sampled) -> tuple[NDArray[np.float64], float]:
        """Return the weights (V, N) of Huber's loss, and where it leaves the square."""
        misses = np.linalg.norm(sampled.residuals, axis=2)
        sigma = 0.85 * float(np.median(misses[sampled.seen]))  # of a two-dimensional error
        limit = max(_LOSS_SIGMAS * sigma, 1e-9)
        return np.where(misses <= limit, 1.0, limit / np.maximum(misses, limit)), limit

    @staticmethod
    def _cost(sampled: _Sampled, limit: float) -> float:
        misses = np.linalg.norm(sampled.residuals, axis=2)[sampled.seen]
        if not len(misses):
            return np.inf
        loss = np.where(misses <= limit, misses**2, 2.0 * limit * misses - limit**2)
        return float(loss.mean())  # the mean: as offsets move, corners come and go

    def _normal_equations(
        self, sampled: _Sampled, weights: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], "_Back"]:
        """Return the equations of cameras and offsets, the boards' poses eliminated."""
        n_cameras, n_poses = len(self.offsets), len(self.rig_from_board)
        camera_part, board_part = self._slopes(sampled)
        weighted = weights[..., None, None] * camera_part
        cc = np.einsum("vnki,vnkj->vij", weighted, camera_part)
        cb = np.einsum("vnki,vnkj->vij", weighted, board_part)
        bb = np.einsum("vnki,vnkj,vn->vij", board_part, board_part, weights)
        rc = np.einsum("vnki,vnk->vi", weighted, sampled.residuals)
        rb = np.einsum("vnki,vnk,vn->vi", board_part, sampled.residuals, weights)
        normal = np.zeros((n_cameras, 7, n_cameras, 7))
        right = np.zeros((n_cameras, 7))
        across = np.zeros((n_poses, n_cameras, 7, 6))
        boards, right_boards = np.zeros((n_poses, 6, 6)), np.zeros((n_poses, 6))
        for camera in range(n_cameras):
            normal[camera, :, camera] = cc[self.cameras == camera].sum(axis=0)
        np.add.at(right, self.cameras, rc)
        np.add.at(across, (self.poses, self.cameras), cb)
        np.add.at(boards, self.poses, bb)
        np.add.at(right_boards, self.poses, rb)
        boards += 1e-9 * np.eye(6) * (1.0 + np.trace(boards, axis1=1, axis2=2))[:, None, None]
        # The reference holds the rig's frame and the session's clock.
        flat = across[:, 1:].reshape(n_poses, -1, 6)
        size = flat.shape[1]
        solved = np.asarray(
            np.linalg.solve(boards, flat.swapaxes(1, 2)), np.float64
        )  # (P, 6, size)
        whole = normal[1:, :, 1:].reshape(size, size) - np.einsum("pia,paj->ij", flat, solved)
        solved_right = np.asarray(np.linalg.solve(boards, right_boards[..., None]), np.float64)[
            ..., 0
        ]
        reduced = right[1:].ravel() - np.einsum("pia,pa->i", flat, solved_right)
        return whole, reduced, _Back(solved, solved_right)

    def _slopes(self, sampled: _Sampled) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return by what residuals fall: camera and offset (V, N, 2, 7), board (V, N, 2, 6)."""
        camera_part = np.zeros((*sampled.residuals.shape, 7))
        camera_part[..., :6] = _by_motion(sampled.by_point, sampled.points_cam)
        camera_part[..., 6] = sampled.speed
        seeing = self.cam_from_rig[self.cameras]
        points_rig = (sampled.points_cam - seeing[:, None, :, 3]) @ seeing[:, :, :3]
        return camera_part, _by_motion(sampled.by_point @ seeing[:, None, :, :3], points_rig)

    def _moved(
        self, step: NDArray[np.float64], board_steps: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        steps = step.reshape(-1, 7)
        offsets = self.offsets.copy()
        offsets[1:] += np.clip(steps[:, 6], -0.5, 0.5)
        cam_from_rig = self.cam_from_rig.copy()
        for camera, motion in enumerate(steps[:, :6], start=1):
            cam_from_rig[camera] = _nudged(cam_from_rig[camera], motion)
        placed = np.stack(
            [_nudged(*pair) for pair in zip(self.rig_from_board, board_steps, strict=True)]
        )
        return offsets, cam_from_rig, placed


@dataclass(frozen=True, slots=True, eq=False)
class _Back:
    """How the boards' poses follow from the rest."""

    solved: NDArray[np.float64]
    solved_right: NDArray[np.float64]

    def __call__(self, step: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(self.solved_right - self.solved @ step)


def _by_motion(by_point: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return slopes (V, N, 2, 6) by turn and shift from those by points (V, N, 2, 3)."""
    turn = np.cross(points[:, :, None, :], by_point)
    return np.concatenate([turn, by_point], axis=3)


def _nudged(pose: Pose, motion: NDArray[np.float64]) -> Pose:
    turn = np.asarray(cv2.Rodrigues(motion[:3])[0], np.float64)
    return np.column_stack([turn @ pose[:, :3], turn @ pose[:, 3] + motion[3:]])


def _rays(camera: Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rays (N, 2) at depth 1; NaN where a point is not seen."""
    rays = np.full(pixels.shape, np.nan)
    seen = is_seen(pixels)
    if seen.any():
        rays[seen] = cam_from_img(camera, pixels[seen])
    return rays
