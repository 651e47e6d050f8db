"""What cameras recorded, as silhouettes: those of a session, or the true ones with erring outlines.

Lens distortion is left in: faults happen to pictures as they are recorded.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.lens import Undistortion, cam_from_img
from hybridve.calib.pose import Pose
from hybridve.hull.capture.recording import FrameRange, Mask, silhouettes_of, undistort_mask
from hybridve.hull.capture.session import Session
from hybridve.hull.query.silhouettes import Views
from hybridve.hull.synth.render import make_view, true_silhouette
from hybridve.hull.synth.stage import Stage

#: True outlines are found on a grid so many times finer.
FINER = 3

#: The error of an outline is alike over so many pixels.
_SMOOTH_PX = 40

#: An outline errs by less than this, in pixels.
_MARGIN_PX = 12


class Recording(ABC):
    """What C cameras recorded.

    Attributes
    ----------
    cameras : tuple of C Camera
        As they are believed to stand.
    views, lenses
        What `hybridve.hull.chain.rig_views` gives.
    fps : float
        Frames a second.
    n_frames : int
        How many there are.
    """

    cameras: tuple[Camera, ...]
    views: Views
    lenses: list[Undistortion]
    fps: float
    n_frames: int

    @abstractmethod
    def seen(self, camera: int, time: float) -> Mask:
        """Return a silhouette (H, W) at a time in frames, not 0 on object pixels."""

    @abstractmethod
    def has_time(self, time: float) -> bool:
        """Tell whether anything was seen at a time in frames."""

    def frame(self, index: int) -> list[Mask]:
        """Return the silhouettes of a frame."""
        return [self.seen(camera, float(index)) for camera in range(len(self.cameras))]

    def undistorted(self, masks: Sequence[Mask]) -> list[Mask]:
        """Return recorded silhouettes as pinhole images."""
        return [undistort_mask(*pair) for pair in zip(masks, self.lenses, strict=True)]

    def pinhole_shift(self, camera: int, moved_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far a shift (2,) of recorded pixels moves what is seen in the pinhole image.

        It is that of the middle of the silhouette, in the middle of the recording.
        """
        rows, columns = np.nonzero(self.seen(camera, float(self.n_frames // 2)))
        middle = np.array([columns.mean() + 0.5, rows.mean() + 0.5]) if len(rows) else np.zeros(2)
        rays = cam_from_img(self.cameras[camera], np.array([middle, middle + moved_px]))
        pixels = np.column_stack([rays, np.ones(2)]) @ self.lenses[camera].img_from_cam.T
        return np.asarray(pixels[1, :2] - pixels[0, :2])

    @cached_property
    def middle_world(self) -> NDArray[np.float64]:
        """The point (3,) that is nearest to what all cameras saw in the first frame they did."""
        for index in range(self.n_frames):
            masks = self.undistorted(self.frame(index))
            if all(mask.any() for mask in masks):
                break
        normal, right = np.zeros((3, 3)), np.zeros(3)
        for camera, lens, mask in zip(self.cameras, self.lenses, masks, strict=True):
            rows, columns = np.nonzero(mask)
            pixel = np.array([columns.mean() + 0.5, rows.mean() + 0.5, 1.0])
            ray = camera.cam_from_world[:, :3].T @ np.linalg.solve(lens.img_from_cam, pixel)
            ray /= np.linalg.norm(ray)
            across = np.eye(3) - np.outer(ray, ray)
            normal += across
            right += across @ camera.center_world
        return np.asarray(np.linalg.solve(normal, right))


class Recorded(Recording):
    """What a session's silhouettes are, cut out of its pictures.

    Parameters
    ----------
    session : Session
        Whose.
    cameras, views, lenses
        Of it.
    step : int
        Every which frame is taken.
    """

    def __init__(
        self,
        session: Session,
        cameras: tuple[Camera, ...],
        views: Views,
        lenses: list[Undistortion],
        step: int = 1,
    ) -> None:
        self.cameras, self.views, self.lenses = cameras, views, lenses
        self.fps, self._step = session.fps / step, step
        with closing(silhouettes_of(session, None, FrameRange())) as frames:
            self._packed = [
                [(np.packbits(mask > 0, axis=1), mask.shape[1]) for mask in frame.masks]
                for frame in frames
                if frame.masks is not None
            ]
        self.n_frames = -(-len(self._packed) // step)

    def has_time(self, time: float) -> bool:
        row = time * self._step
        return math.isclose(row, round(row)) and 0 <= round(row) < len(self._packed)

    def seen(self, camera: int, time: float) -> Mask:
        packed, width = self._packed[round(time * self._step)][camera]
        return np.unpackbits(packed, axis=1, count=width)


@dataclass(frozen=True, slots=True, eq=False)
class _Inside:
    """How deep pixels lie in a silhouette, from some row and column on, in tenths of pixels."""

    top: int
    left: int
    depth: NDArray[np.int8]


class Drawn(Recording):
    """The true silhouettes of a stage, whose outlines err by normal errors, smooth along them.

    Parameters
    ----------
    stage : Stage
        What is seen.
    true : tuple of C Camera
        From where.
    cameras, views, lenses
        What the cameras are believed to be.
    n_frames, fps
        In how many frames the whole motion is seen.
    std_px, constant_px : float
        Standard deviations of what is another error in each frame, and of what a camera errs by in
        all of them.
    """

    def __init__(
        self,
        stage: Stage,
        true: tuple[Camera, ...],
        cameras: tuple[Camera, ...],
        views: Views,
        lenses: list[Undistortion],
        n_frames: int,
        fps: float,
        std_px: float = 1.0,
        constant_px: float = 0.5,
    ) -> None:
        self.cameras, self.views, self.lenses = cameras, views, lenses
        self.n_frames, self.fps = n_frames, fps
        self._stage, self._true = stage, true
        self._std_px, self._constant_px = std_px, constant_px
        self._finer = [make_view(finer(camera)) for camera in true]
        self._kept: dict[tuple[int, float], _Inside | None] = {}
        self.seed = 0
        #: By how much each camera's pictures are shifted, (C, 2) pixels.
        self.moved_px = np.zeros((len(true), 2))

    def has_time(self, time: float) -> bool:
        return 0.0 <= time <= self.n_frames - 1

    def seen(self, camera: int, time: float) -> Mask:
        height, width = self._true[camera].height_px, self._true[camera].width_px
        mask = np.zeros((height, width), np.uint8)
        key = camera, round(time, 6)
        if key not in self._kept:
            self._kept[key] = self._inside(*key)
        found = self._kept[key]
        if found is None:
            return mask
        top, left, depth = found.top, found.left, found.depth
        error = self._error(self._rng(camera, 1 + round(1000 * time)), depth.shape, self._std_px)
        constant = self._error(self._rng(camera, 0), (height, width), self._constant_px)
        error += constant[top : top + depth.shape[0], left : left + depth.shape[1]]
        # Its shift: whole pixels, and what is left of them.
        shift = self.moved_px[camera]
        whole = np.floor(shift).astype(int)
        part = shift - whole
        moved = cv2.warpAffine(
            depth.astype(np.float32) / 10.0,
            np.array([[1.0, 0.0, part[0]], [0.0, 1.0, part[1]]]),
            depth.shape[::-1],
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=-12.0,
        )
        top, left = top + int(whole[1]), left + int(whole[0])
        rows = slice(max(top, 0), min(top + depth.shape[0], height))
        columns = slice(max(left, 0), min(left + depth.shape[1], width))
        inner = (
            slice(rows.start - top, rows.stop - top),
            slice(columns.start - left, columns.stop - left),
        )
        if rows.start < rows.stop and columns.start < columns.stop:
            mask[rows, columns] = (moved > error)[inner]
        return mask

    def _rng(self, camera: int, number: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, camera, number])

    @staticmethod
    def _error(
        rng: np.random.Generator, shape: tuple[int, ...], std_px: float
    ) -> NDArray[np.float64]:
        height, width = shape
        coarse = rng.normal(size=(height // _SMOOTH_PX + 4, width // _SMOOTH_PX + 4))
        # As large as its nodes are apart, or what is seen of it would vary faster in small pieces.
        size = (coarse.shape[1] * _SMOOTH_PX, coarse.shape[0] * _SMOOTH_PX)
        error = cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)[:height, :width]
        # Between its nodes an interpolated field varies less than at them.
        return np.clip(error * (std_px / 0.87), -_MARGIN_PX + 1, _MARGIN_PX - 1)

    def _inside(self, camera: int, time: float) -> _Inside | None:
        moment = time / max(1, self.n_frames - 1)
        poses: list[Pose] = self._stage.poses(moment)
        shapes = [real.shape for real in self._stage.shapes]
        fine = true_silhouette(self._finer[camera], shapes, poses)
        x, y, width, height = cv2.boundingRect((fine > 0).astype(np.uint8))
        if not width:
            return None
        size = np.array(fine.shape) // FINER
        low = np.maximum(np.array([y, x]) // FINER - _MARGIN_PX, 0)
        high = np.minimum(-(-np.array([y + height, x + width]) // FINER) + _MARGIN_PX, size)
        rows, columns = (
            slice(FINER * int(a), FINER * int(b)) for a, b in zip(low, high, strict=True)
        )
        depth = inside_px(fine[rows, columns])[FINER // 2 :: FINER, FINER // 2 :: FINER]
        whole = np.clip(np.round(10.0 * depth), -120, 120).astype(np.int8)
        return _Inside(int(low[0]), int(low[1]), whole)


def finer(camera: Camera) -> Camera:
    """Return a camera with `FINER` times as many pixels each way."""
    scale = np.array([FINER] * 4 + [1.0] * (len(camera.params) - 4))
    return replace(
        camera,
        width_px=FINER * camera.width_px,
        height_px=FINER * camera.height_px,
        params=camera.params * scale,
    )


def inside_px(fine: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return how deep each place of a finer grid lies in a silhouette, pixels, negative outside."""
    inside = (fine > 0).astype(np.uint8)
    depth: Any = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    away: Any = cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(np.where(fine > 0, depth - 0.5, 0.5 - away) / FINER, np.float32)
