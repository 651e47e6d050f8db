"""The visual hull as seen from any viewpoint: depth of its first visible surface, and its shape.

Sections 3.1 and 3.2 of Lok, Naik, Whitton and Brooks, 2003, pixel by pixel: the ray through a
pixel is asked front to back whether its points are inside the hull, and the first that is lies on
the surface. No mesh of the hull is made, and what comes back is a depth map, so that the hull and
virtual objects obscure each other correctly.

Four things make it quick without a graphics device:

* The working volume is halved again and again, and boxes that `hybridve.hull.query.bounds` proves
  free are dropped. Rays walk the grid of those that are left.
* Inside such a cell a ray is sampled every `step_m`, about one pixel of the recording cameras.
  What is thinner than that along a ray can be missed.
* The surface is then bisected to `SURFACE_TOLERANCE_M`.
* Rows of the picture are dealt out to threads.

All in float64 and in the local frame of the hull's views.
"""

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import compiled
from hybridve.hull.query.bounds import boxes_are_free
from hybridve.hull.query.silhouettes import Hull

#: How closely the surface is found along the ray, in metres of depth.
SURFACE_TOLERANCE_M = 1e-5

#: Subdivision of the working volume stops once this many cells may hold something.
_MANY_CELLS = 12_000

#: It stops at the latest here: 1024 cells along an edge.
_MAX_LEVELS = 10

#: The working volume reaches this many times as far as the farthest camera.
_REACH = 1.5

#: Voxels of the field that normals are taken from, at most.
_MAX_VOXELS = 4_000_000

#: The field is blurred by these many voxels: for normals, and for the light that reaches a place.
_NORMAL_SIGMA, _LIGHT_SIGMA = 1.4, 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """Where a picture is taken from.

    Attributes
    ----------
    eye_world, target_world : (3,) float64
        Where the viewer stands and what is in the middle of the picture, metres.
    up_world : (3,) float64
        What points upwards in the picture.
    vertical_fov_deg : float
        Angle between the upper and the lower border.
    """

    eye_world: NDArray[np.float64]
    target_world: NDArray[np.float64]
    up_world: NDArray[np.float64]
    vertical_fov_deg: float

    @property
    def cam_from_world(self) -> NDArray[np.float64]:
        """The (3, 4) pose of the viewer: x right, y down, z forward."""
        forward = self.target_world - self.eye_world
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, self.up_world)
        length = np.linalg.norm(right)
        if length < 1e-9:  # looking straight up or down: any direction serves as right
            right = np.cross(forward, np.roll(self.up_world, 1))
            length = np.linalg.norm(right)
        right = right / length
        rotation = np.array([right, np.cross(forward, right), forward])
        return np.column_stack([rotation, -rotation @ self.eye_world])

    def img_from_cam(self, size_px: tuple[int, int]) -> NDArray[np.float64]:
        """Return the (3, 3) pinhole matrix of a picture of this width and height."""
        width, height = size_px
        focal_px = 0.5 * height / np.tan(np.deg2rad(0.5 * self.vertical_fov_deg))
        return np.array([[focal_px, 0.0, 0.5 * width], [0.0, focal_px, 0.5 * height], [0, 0, 1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class WorkingVolume:
    """The cells of space that may hold something of the hull.

    Attributes
    ----------
    hull : Hull
        The hull of one frame.
    lower_local : (3,) float64
        Corner of the grid in metres, in the local frame of the views.
    cell_m : float
        Edge of a cell.
    occupied : (X, Y, Z) bool
        False where the cell is proved free; outside the grid everything is.
    step_m : float
        Spacing of samples along a ray: about what one pixel of the cameras covers here.
    """

    hull: Hull
    lower_local: NDArray[np.float64]
    cell_m: float
    occupied: NDArray[np.bool_]
    step_m: float

    @property
    def is_empty(self) -> bool:
        """Whether the hull is proved to be empty."""
        return self.occupied.size == 0

    @property
    def centers_world(self) -> NDArray[np.float64]:
        """Middle of each cell that may hold something: (N, 3) metres."""
        lower = self.lower_local + self.hull.views.origin_world
        return np.asarray(lower + (np.argwhere(self.occupied) + 0.5) * self.cell_m)


def bound_working_volume(hull: Hull) -> WorkingVolume:
    """Return the cells of space that are not proved free of the hull.

    What lies farther from the middle of the working volume than 1.5 times the farthest camera is
    left out: a hull can reach to infinity where no camera looks across.
    """
    views = hull.views
    matrices = views.img_from_local
    cameras_local = -np.linalg.solve(matrices[:, :, :3], matrices[:, :, 3:])[..., 0]  # (C, 3)
    reach_m = _REACH * max(1e-3, float(np.linalg.norm(cameras_local, axis=1).max()))

    corner_local = np.full(3, -reach_m)
    edge_m = 2.0 * reach_m
    numbers = np.zeros((1, 3), np.int64)
    halves = np.array([[i >> axis & 1 for axis in range(3)] for i in range(8)])
    for _ in range(_MAX_LEVELS):
        edge_m *= 0.5
        numbers = (2 * numbers[:, None] + halves).reshape(-1, 3)
        lower_world = corner_local + numbers * edge_m + views.origin_world
        numbers = numbers[~boxes_are_free(hull, lower_world, lower_world + edge_m)]
        if len(numbers) == 0:
            return WorkingVolume(hull, corner_local, edge_m, np.zeros((0, 0, 0), np.bool_), edge_m)
        if len(numbers) > _MANY_CELLS:
            break
    first = numbers.min(axis=0)
    occupied = np.zeros(numbers.max(axis=0) - first + 1, np.bool_)
    occupied[tuple((numbers - first).T)] = True
    step_m = _pixel_m(hull, corner_local + (numbers + 0.5) * edge_m)
    return WorkingVolume(hull, corner_local + first * edge_m, edge_m, occupied, step_m)


def _pixel_m(hull: Hull, points_local: NDArray[np.float64]) -> float:
    """Return what a pixel of the nearest camera covers, the median over some points."""
    sizes = []
    for matrix in hull.views.img_from_local:
        depth_m = points_local @ matrix[2, :3] + matrix[2, 3]
        focal_px = np.linalg.norm(np.cross(matrix[2, :3], matrix[0, :3]))
        sizes.append(np.where(depth_m > 0, depth_m, np.inf) / focal_px)
    nearest = np.min(sizes, axis=0)
    nearest = nearest[np.isfinite(nearest)]
    return float(np.median(nearest)) if len(nearest) else 1e-3


def march_depth(
    volume: WorkingVolume, viewpoint: Viewpoint, size_px: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the depth of the first visible surface of the hull at each pixel's centre.

    Parameters
    ----------
    volume : WorkingVolume
        Where the hull may be.
    viewpoint : Viewpoint
        Where it is seen from. A viewer inside the hull sees nothing but hull, at depth 0.
    size_px : (width, height)
        Of the picture.

    Returns
    -------
    (height, width) float64
        Depth along the viewing axis in metres, that of a point inside the hull at most
        `SURFACE_TOLERANCE_M` behind the surface; infinite where there is no hull.
    """
    width, height = size_px
    depth_m = np.full((height, width), np.inf)
    if volume.is_empty:
        return depth_m
    pose = viewpoint.cam_from_world
    local_from_img = pose[:, :3].T @ np.linalg.inv(viewpoint.img_from_cam(size_px))  # (3, 3)
    eye_local = viewpoint.eye_world - volume.hull.views.origin_world
    cameras = _camera_table(volume.hull)

    def march(start: int, stop: int) -> None:
        _march_rows(
            depth_m,
            start,
            stop,
            eye_local,
            local_from_img,
            *cameras,
            volume.occupied,
            volume.lower_local,
            volume.cell_m,
            volume.step_m,
            SURFACE_TOLERANCE_M,
        )

    in_bands(march, height)
    return depth_m


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceField:
    """A smoothed indicator of the hull, for normals and soft light.

    Attributes
    ----------
    lower_world : (3,) float64
        Centre of the first voxel, metres.
    voxel_m : float
        Spacing of voxels.
    fine, coarse : (X, Y, Z) float32
        The share of hull in a small and in a wide surrounding of each voxel, 0 to 1.
    """

    lower_world: NDArray[np.float64]
    voxel_m: float
    fine: NDArray[np.float32]
    coarse: NDArray[np.float32]


def make_surface_field(volume: WorkingVolume) -> SurfaceField:
    """Return the smoothed indicator of the hull in its working volume.

    Silhouettes end at pixels, so the hull has steps; its normals are those of a smoothed hull.
    """
    origin_world = volume.hull.views.origin_world
    if volume.is_empty:
        nothing = np.zeros((2, 2, 2), np.float32)
        return SurfaceField(origin_world, volume.cell_m, nothing, nothing)
    shape = np.array(volume.occupied.shape)
    per_cell = int(max(1, (_MAX_VOXELS / shape.prod()) ** (1 / 3)))
    per_cell = min(per_cell, max(1, round(volume.cell_m / (2.0 * volume.step_m))))
    voxel_m = volume.cell_m / per_cell
    margin = int(np.ceil(2 * _LIGHT_SIGMA))
    indicator = np.zeros(shape * per_cell + 2 * margin, np.float32)
    first_local = volume.lower_local + 0.5 * voxel_m
    cameras = _camera_table(volume.hull)

    def fill(start: int, stop: int) -> None:
        _fill_voxels(
            indicator,
            start,
            stop,
            margin,
            per_cell,
            first_local,
            voxel_m,
            *cameras,
            volume.occupied,
        )

    in_bands(fill, int(shape[0]))
    fine = _blurred(indicator, _NORMAL_SIGMA)
    coarse = _blurred(fine, _LIGHT_SIGMA)
    return SurfaceField(first_local - margin * voxel_m + origin_world, voxel_m, fine, coarse)


def _blurred(field: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Return a field smoothed by a Gaussian along its three axes."""
    radius = int(np.ceil(2.5 * sigma))
    kernel = cv2.getGaussianKernel(2 * radius + 1, sigma, cv2.CV_32F)
    result = np.zeros_like(field)
    for x, part in enumerate(field):
        cv2.sepFilter2D(part, -1, kernel, kernel, dst=result[x], borderType=cv2.BORDER_REPLICATE)
    only = np.ones((1, 1), np.float32)
    flat = cv2.sepFilter2D(
        result.reshape(len(field), -1), -1, only, kernel, borderType=cv2.BORDER_REPLICATE
    )
    return np.asarray(flat, np.float32).reshape(field.shape)


def in_bands(work: Callable[[int, int], None], n_rows: int) -> None:
    """Call ``work(start, stop)`` on bands of rows, from as many threads as there are processors."""
    n_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    n_bands = max(1, min(n_rows, 8 * (n_threads or 1)))
    cuts = np.linspace(0, n_rows, n_bands + 1).astype(int).tolist()
    with ThreadPoolExecutor(n_threads, "picture") as executor:
        for band in [executor.submit(work, *cut) for cut in itertools.pairwise(cuts)]:
            band.result()


_CameraTable = tuple[
    NDArray[np.float64], NDArray[np.int64], NDArray[np.uint8], NDArray[np.int64], bool, int
]


def _camera_table(hull: Hull) -> _CameraTable:
    """Return what `_is_inside` asks, as plain arrays."""
    views = hull.views
    return (
        np.ascontiguousarray(views.img_from_local.reshape(-1, 12)),
        views.sizes_px,
        hull.masks_flat,
        hull.mask_offset,
        views.unseen == "keep",
        views.min_cameras,
    )


@compiled
def _sees(
    matrix: NDArray[np.float64],
    size_px: NDArray[np.int64],
    masks: NDArray[np.uint8],
    offset: int,
    x: float,
    y: float,
    z: float,
) -> int:
    """Return 1 where a camera sees the point on an object pixel, 0 on background, -1 not at all."""
    h_z = matrix[8] * x + matrix[9] * y + matrix[10] * z + matrix[11]
    if not h_z > 0.0:
        return -1
    pixel_x = (matrix[0] * x + matrix[1] * y + matrix[2] * z + matrix[3]) / h_z
    if not (pixel_x >= 0.0 and pixel_x < size_px[0]):
        return -1
    pixel_y = (matrix[4] * x + matrix[5] * y + matrix[6] * z + matrix[7]) / h_z
    if not (pixel_y >= 0.0 and pixel_y < size_px[1]):
        return -1
    return 1 if masks[offset + int(pixel_y) * size_px[0] + int(pixel_x)] != 0 else 0


@compiled
def _is_inside(
    matrices: NDArray[np.float64],
    sizes_px: NDArray[np.int64],
    masks: NDArray[np.uint8],
    offsets: NDArray[np.int64],
    keep: bool,
    min_cameras: int,
    x: float,
    y: float,
    z: float,
    first: int,
) -> int:
    """Return -1 for a point inside the hull, else a camera that rejects it; `first` is asked first.

    Neighbouring points tend to be rejected by the same camera.
    """
    n_cameras = len(matrices)
    n_seen = 0
    for turn in range(n_cameras):
        camera = first + turn
        if camera >= n_cameras:
            camera -= n_cameras
        seen = _sees(matrices[camera], sizes_px[camera], masks, offsets[camera], x, y, z)
        if seen == 0 or (seen < 0 and not keep):
            return camera
        n_seen += seen > 0
    return -1 if n_seen >= min_cameras else 0


@compiled
def _march_rows(
    depth_m: NDArray[np.float64],
    start: int,
    stop: int,
    eye: NDArray[np.float64],
    local_from_img: NDArray[np.float64],
    matrices: NDArray[np.float64],
    sizes_px: NDArray[np.int64],
    masks: NDArray[np.uint8],
    offsets: NDArray[np.int64],
    keep: bool,
    min_cameras: int,
    occupied: NDArray[np.bool_],
    lower: NDArray[np.float64],
    cell_m: float,
    step_m: float,
    tolerance_m: float,
) -> None:
    """Write the depth of the rows `start` to `stop`.

    The grid is walked as in Amanatides and Woo, *A Fast Voxel Traversal Algorithm for Ray
    Tracing*, Eurographics 1987; the parameter of a ray is its depth.
    """
    infinity = np.inf
    ray = np.zeros(3)
    cell = np.zeros(3, np.int64)
    move = np.zeros(3, np.int64)
    next_t = np.zeros(3)
    per_cell_t = np.zeros(3)
    camera = 0
    for row in range(start, stop):
        for column in range(depth_m.shape[1]):
            length = 0.0
            enter, leave = 0.0, infinity
            for axis in range(3):
                ray[axis] = (
                    local_from_img[axis, 0] * (column + 0.5)
                    + local_from_img[axis, 1] * (row + 0.5)
                    + local_from_img[axis, 2]
                )
                length += ray[axis] * ray[axis]
                low = lower[axis] - eye[axis]
                high = low + cell_m * occupied.shape[axis]
                if ray[axis] == 0.0:
                    if low > 0.0 or high < 0.0:
                        leave = -1.0
                    continue
                t0, t1 = low / ray[axis], high / ray[axis]
                enter = max(enter, min(t0, t1))
                leave = min(leave, max(t0, t1))
            if enter >= leave:
                continue
            step_t = step_m / np.sqrt(length)
            for axis in range(3):
                place = (eye[axis] + enter * ray[axis] - lower[axis]) / cell_m
                cell[axis] = min(max(int(np.floor(place)), 0), occupied.shape[axis] - 1)
                if ray[axis] == 0.0:
                    move[axis], next_t[axis], per_cell_t[axis] = 0, infinity, infinity
                    continue
                move[axis] = 1 if ray[axis] > 0.0 else -1
                border = lower[axis] + cell_m * (cell[axis] + (1 if ray[axis] > 0.0 else 0))
                next_t[axis] = (border - eye[axis]) / ray[axis]
                per_cell_t[axis] = cell_m / abs(ray[axis])
            t = enter
            while True:
                axis = 0
                if next_t[1] < next_t[axis]:
                    axis = 1
                if next_t[2] < next_t[axis]:
                    axis = 2
                until = min(next_t[axis], leave)
                if occupied[cell[0], cell[1], cell[2]]:
                    # Samples are multiples of the step, whatever the cells are.
                    number = np.ceil(t / step_t)
                    found = False
                    while number * step_t <= until:
                        s = number * step_t
                        verdict = _is_inside(
                            matrices, sizes_px, masks, offsets, keep, min_cameras,
                            eye[0] + s * ray[0], eye[1] + s * ray[1], eye[2] + s * ray[2], camera,
                        )  # fmt: skip
                        if verdict < 0:
                            found = True
                            break
                        camera = verdict
                        number += 1.0
                    if found:
                        inside = number * step_t
                        outside = max(0.0, inside - step_t)
                        while inside - outside > tolerance_m:
                            s = 0.5 * (inside + outside)
                            verdict = _is_inside(
                                matrices, sizes_px, masks, offsets, keep, min_cameras,
                                eye[0] + s * ray[0], eye[1] + s * ray[1], eye[2] + s * ray[2],
                                camera,
                            )  # fmt: skip
                            if verdict < 0:
                                inside = s
                            else:
                                outside = s
                        depth_m[row, column] = inside
                        break
                t = until
                if t >= leave:
                    break
                cell[axis] += move[axis]
                if cell[axis] < 0 or cell[axis] >= occupied.shape[axis]:
                    break
                next_t[axis] += per_cell_t[axis]


@compiled
def _fill_voxels(
    indicator: NDArray[np.float32],
    start: int,
    stop: int,
    margin: int,
    per_cell: int,
    first: NDArray[np.float64],
    voxel_m: float,
    matrices: NDArray[np.float64],
    sizes_px: NDArray[np.int64],
    masks: NDArray[np.uint8],
    offsets: NDArray[np.int64],
    keep: bool,
    min_cameras: int,
    occupied: NDArray[np.bool_],
) -> None:
    """Write 1 at the voxels inside the hull, for the cells `start` to `stop` along x."""
    camera = 0
    for cell_x in range(start, stop):
        for cell_y in range(occupied.shape[1]):
            for cell_z in range(occupied.shape[2]):
                if not occupied[cell_x, cell_y, cell_z]:
                    continue
                for x in range(cell_x * per_cell, (cell_x + 1) * per_cell):
                    for y in range(cell_y * per_cell, (cell_y + 1) * per_cell):
                        for z in range(cell_z * per_cell, (cell_z + 1) * per_cell):
                            verdict = _is_inside(
                                matrices, sizes_px, masks, offsets, keep, min_cameras,
                                first[0] + x * voxel_m,
                                first[1] + y * voxel_m,
                                first[2] + z * voxel_m,
                                camera,
                            )  # fmt: skip
                            if verdict < 0:
                                indicator[x + margin, y + margin, z + margin] = 1.0
                            else:
                                camera = verdict
