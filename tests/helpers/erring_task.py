"""A ball that comes near a wall, seen by cameras and outlines that err: how much room it needs.

The true hull is a set of tangent cones in closed form. In every repeat the cameras are believed to
stand where a rig's covariance lets them, one draw for all frames; each frame's outlines are off, a
number of pixels all round for each camera.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from helpers.cones import ball_extent, plate
from helpers.hulls import ball_masks, look_at
from hybridve.calib.camera import Camera
from hybridve.calib.pose import moved_pose
from hybridve.calib.rig import Rig, RigCovariance
from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.contact.outline_errors import DoubtSettings, outline_errors
from hybridve.hull.contact.spacing import (
    METER_SHARE,
    Move,
    MovedObject,
    blocked_shifts,
    free_of,
    union,
)
from hybridve.hull.contact.spacing_doubt import unsure_shifts
from hybridve.hull.contact.uncertainty import Doubter
from hybridve.hull.query.silhouettes import Hull, Views, make_hull, make_views

#: The lens: some 9 mm a pixel at 3 m.
FOCAL_PX, WIDTH_PX, HEIGHT_PX = 350.0, 360, 243


@dataclass(frozen=True, slots=True, eq=False)
class ErringTask:
    """What is recorded, and how much cameras and outlines err.

    Attributes
    ----------
    cameras : tuple of Camera
        Where they truly stand.
    shared, own : (10 C,) float64
        Standard deviations of what all cameras err together by, and each by itself.
    segmentation_px : float
        That of outlines.
    centers_world : (F, 3) float64
        Where the ball is, frame by frame, metres.
    radius_m : float
        Its radius.
    normal : (3,) float64
        Of the wall, toward the side that the ball is not on.
    move : Move
        Whereto the wall is moved, from a place through the origin.
    required_m : float
        How far it is to stay away.
    """

    cameras: tuple[Camera, ...]
    shared: NDArray[np.float64]
    own: NDArray[np.float64]
    segmentation_px: float
    centers_world: NDArray[np.float64]
    radius_m: float
    normal: NDArray[np.float64]
    move: Move
    required_m: float = 0.01

    def needed_by_frame_m(self) -> NDArray[np.float64]:
        """Return the shift (F,) that the true hull of each frame needs."""
        views, cosine = views_of(self.cameras), float(self.normal @ self.move.direction)
        needed = []
        for center in self.centers_world:
            reach_m = center @ self.normal + ball_extent(
                views, center, self.radius_m, self.normal, np.zeros(len(views))
            )
            needed.append((reach_m + self.required_m) / cosine)
        return np.array(needed)

    def wall(self) -> MovedObject:
        """Return the wall, a metre thick."""
        square, _ = plate(np.zeros(3), self.normal)
        faces = np.array(
            [
                [0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4],
                [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7],
            ],
            np.int32,
        )  # fmt: skip
        corners = np.concatenate([square, square + self.normal])
        a, b, c = np.moveaxis(corners[faces], 1, 0)
        if (a * np.cross(b, c)).sum() < 0:  # wound inside out
            faces = faces[:, ::-1].copy()
        meter = ClearanceMeter(
            corners, faces, is_closed=True, tolerance_m=METER_SHARE * self.move.tolerance_m
        )
        return MovedObject(meter, self.required_m)

    def believed(self, rng: np.random.Generator) -> Rig:
        """Return the cameras as a calibration might find them, and how far it may be off."""
        size = 10 * len(self.cameras)
        change = self.shared * rng.normal() + self.own * rng.normal(size=size)
        cameras = tuple(
            replace(
                camera,
                cam_from_world=moved_pose(camera.cam_from_world, change[10 * k : 10 * k + 6]),
                params=camera.params + change[10 * k + 6 : 10 * k + 10],
            )
            for k, camera in enumerate(self.cameras)
        )
        labels = tuple(f"{cameras[index // 10].name} {index % 10}" for index in range(size))
        matrix = np.outer(self.shared, self.shared) + np.diag(self.own**2)
        return Rig(cameras, covariance=RigCovariance(labels, matrix))

    def hull(self, rng: np.random.Generator, rig: Rig, frame: int) -> Hull:
        """Return the hull that the believed cameras make of a frame's outlines."""
        true, center = views_of(self.cameras), self.centers_world[frame]
        masks = []
        for k in range(len(true)):
            matrix = true.img_from_local[k]
            camera_world = true.origin_world - np.linalg.solve(matrix[:, :3], matrix[:, 3])
            distance_m = float(np.linalg.norm(center - camera_world))
            opening = np.arcsin(self.radius_m / distance_m)
            # Off the axis a pixel spans cos^2 / f radians along the image's radius, 1 / f across.
            opening += rng.normal(0.0, self.segmentation_px) / FOCAL_PX
            alone = replace(
                true,
                names=(true.names[k],),
                sizes_px=true.sizes_px[[k]],
                img_from_local=true.img_from_local[[k]],
            )
            masks += ball_masks(alone, center, distance_m * float(np.sin(opening)))
        return make_hull(views_of(rig.cameras), masks)

    def repeat(self, rng: np.random.Generator, wall: MovedObject) -> tuple[float, float, float]:
        """Return the shift found, the one that suffices at 95 %, and the deviation used, metres."""
        rig = self.believed(rng)
        settings = DoubtSettings(segmentation_px=self.segmentation_px)
        names = tuple(camera.name for camera in rig.cameras)
        doubter = Doubter(outline_errors(names, rig, [0.0] * len(names), settings), settings)
        blocked, unsure, std_m = [], [], 0.0
        for frame in range(len(self.centers_world)):
            hull = self.hull(rng, rig, frame)
            mine = blocked_shifts(hull, [wall], self.move)
            found = unsure_shifts(doubter.frame(hull), [wall], self.move, mine)
            blocked.append(union(mine.violated_m, mine.undecided_m))
            unsure.append(found.unsure_m)
            std_m = max(std_m, found.std_m)
        first_m = [
            float(free_of(self.move, union(*of_frames))[0, 0]) for of_frames in (blocked, unsure)
        ]
        return first_m[0], first_m[1], std_m


def views_of(cameras: tuple[Camera, ...]) -> Views:
    """Return the views of cameras without distortion."""
    return make_views(
        tuple(camera.name for camera in cameras),
        np.array([(camera.width_px, camera.height_px) for camera in cameras]),
        np.array([camera.pinhole @ camera.cam_from_world for camera in cameras]),
    )


def erring_task(
    rng: np.random.Generator, n_frames: int, *, is_tied: bool, segmentation_px: float = 1.2
) -> ErringTask:
    """Return a task of random cameras, ball and wall, which may be moved at a slant.

    Either all frames need the same room, or the first needs far more than the others.
    """
    n_cameras = int(rng.integers(3, 6))
    cameras = []
    for k in range(n_cameras):
        angle = 2.0 * np.pi * (k + rng.uniform(-0.2, 0.2)) / n_cameras
        center = np.array([3.0 * np.cos(angle), 3.0 * np.sin(angle), rng.uniform(0.3, 1.5)])
        params = np.array([FOCAL_PX, FOCAL_PX, WIDTH_PX / 2, HEIGHT_PX / 2])
        cameras.append(
            Camera(f"cam{k}", "PINHOLE", WIDTH_PX, HEIGHT_PX, params, look_at(center, np.zeros(3)))
        )
    shared = np.zeros(10 * n_cameras)
    for k, camera in enumerate(cameras):  # all turn alike about the vertical, and rise
        axis, at = camera.cam_from_world[:, 2], camera.cam_from_world[:, 3]
        shared[10 * k : 10 * k + 3] = 0.002 * axis
        shared[10 * k + 3 : 10 * k + 6] = 0.002 * -np.cross(axis, at) + 0.003 * axis
    own = np.tile([1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 0.5, 0.5, 0.2, 0.2], n_cameras)
    normal = rng.normal(size=3) * [1.0, 1.0, 0.3]  # from above nothing tells how high a hull ends
    normal /= np.linalg.norm(normal)
    aslant = np.cross(normal, rng.normal(size=3))
    direction = normal + rng.uniform(0.0, 1.0) * aslant / np.linalg.norm(aslant)
    direction /= np.linalg.norm(direction)
    radius_m = float(rng.uniform(0.1, 0.2))
    beside = np.cross(normal, [0.3, 0.5, 0.8])
    beside /= np.linalg.norm(beside)
    along_m = np.linspace(-0.1, 0.1, n_frames)[:, None] if n_frames > 1 else np.zeros((1, 1))
    centers_world = along_m * beside
    task = ErringTask(
        tuple(cameras), shared, own, segmentation_px, centers_world, radius_m, normal,
        Move(direction, 0.0, 0.8, 1e-3),
    )  # fmt: skip
    # The hull of a ball is larger than the ball, and from place to place otherwise.
    lack_m = (0.3 - task.needed_by_frame_m()) * float(normal @ direction)
    if not is_tied:
        lack_m[1:] -= 0.15
    return replace(task, centers_world=centers_world + lack_m[:, None] * normal)
