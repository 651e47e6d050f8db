"""Rigs, silhouettes and meshes for tests of the volume query.

Nothing here uses the code under test beyond building its inputs and projecting in plain float64.
"""

from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.engine import Hits, Triangles
from hybridve.hull.query.silhouettes import (
    Hull,
    Unseen,
    Views,
    make_hull,
    make_seen,
    make_views,
)
from hybridve.hull.query.viewport import sample_positions

#: Engines may differ for samples that project this near to a pixel edge (DESIGN.md, part 5).
EDGE_BAND_PX = 1e-3

#: The same for an engine in double precision: a thousand times the rounding of a projection.
DOUBLE_BAND_PX = 1e-7


def look_at(
    center: NDArray[np.float64], target: NDArray[np.float64], roll_rad: float = 0.0
) -> NDArray[np.float64]:
    """Return the (3, 4) pose cam_from_world of a camera at `center` that faces `target`."""
    forward = (target - center) / np.linalg.norm(target - center)
    side = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    down = np.cross(forward, side)
    cosine, sine = np.cos(roll_rad), np.sin(roll_rad)
    rotation = np.stack([cosine * side + sine * down, cosine * down - sine * side, forward])
    return np.column_stack([rotation, -rotation @ center])


def projection(
    cam_from_world: NDArray[np.float64], focal_px: float, width: int, height: int
) -> NDArray[np.float64]:
    """Return the (3, 4) projection of a camera whose principal point is the image's middle."""
    matrix = np.array([[focal_px, 0.0, width / 2], [0.0, focal_px, height / 2], [0.0, 0.0, 1.0]])
    return matrix @ cam_from_world


def ring_views(
    n_cameras: int = 4,
    width: int = 720,
    height: int = 486,
    focal_px: float = 700.0,
    distance_m: float = 3.0,
    unseen: Unseen = "carve",
    min_cameras: int = 1,
) -> Views:
    """Return cameras on a ring, somewhat above the origin, that face it."""
    matrices = []
    for k in range(n_cameras):
        angle = 2 * np.pi * k / n_cameras + 0.3
        center = np.array([distance_m * np.cos(angle), distance_m * np.sin(angle), 1.2])
        matrices.append(projection(look_at(center, np.zeros(3)), focal_px, width, height))
    return make_views(
        tuple(f"cam{k}" for k in range(n_cameras)),
        np.array([[width, height]] * n_cameras),
        np.array(matrices),
        unseen,
        min_cameras,
    )


def ball_angles(
    views: Views,
    points_world: NDArray[np.float64],
    center_world: NDArray[np.float64],
    radius_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return how far points lie outside the tangent cones of a ball: (C, N) radians.

    Then the depth of the points (C, N), and the angle that a pixel subtends at most (C,).
    """
    outside, depths, pixel_angles = [], [], []
    for k in range(len(views)):
        matrix = views.img_from_local[k]
        camera_world = views.origin_world - np.linalg.solve(matrix[:, :3], matrix[:, 3])
        to_ball, to_point = center_world - camera_world, points_world - camera_world
        distance_m = np.linalg.norm(to_ball)
        across = np.linalg.norm(np.cross(to_point, to_ball), axis=-1)
        angle = np.arctan2(across, to_point @ to_ball)
        outside.append(angle - np.arcsin(radius_m / distance_m))
        depths.append(to_point @ matrix[2, :3])
        pixel_angles.append(1.0 / np.linalg.norm(np.linalg.svd(matrix[:2, :3])[1], -np.inf))
    return np.array(outside), np.array(depths), np.array(pixel_angles)


def ball_masks(
    views: Views, center_world: NDArray[np.float64], radius_m: float
) -> list[NDArray[np.uint8]]:
    """Return silhouettes of a ball in closed form: pixels whose centre's ray meets its cone."""
    masks = []
    for k, (width, height) in enumerate(views.sizes_px):
        matrix = views.img_from_local[k]
        camera_world = views.origin_world - np.linalg.solve(matrix[:, :3], matrix[:, 3])
        to_ball = center_world - camera_world
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(matrix[:, :3]).T
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        along = rays @ to_ball
        masks.append(((along > 0) & (to_ball @ to_ball - along**2 < radius_m**2)).astype(np.uint8))
    return masks


def ball_hull(views: Views, center_world: NDArray[np.float64], radius_m: float) -> Hull:
    """Return the hull of a ball."""
    return make_hull(views, ball_masks(views, center_world, radius_m))


def sphere_mesh(
    n_triangles: int,
    radius_m: float = 0.5,
    viewport: int = 10,
    center_world: tuple[float, ...] = (0, 0, 0),
) -> Triangles:
    """Return a sphere of about `n_triangles` triangles, quads of longitude and latitude halved."""
    rows = max(2, round((n_triangles / 4) ** 0.5))
    columns = 2 * rows
    polar, azimuth = np.meshgrid(
        np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, columns + 1)[:-1], indexing="ij"
    )
    directions = np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1
    )
    directions[-1] = [0.0, 0.0, -1.0]  # closed: the sine of pi is not quite 0
    row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a, b = row * columns + column, row * columns + (column + 1) % columns
    c, d = a + columns, b + columns
    faces = np.stack([np.stack([a, c, b], -1), np.stack([b, c, d], -1)], axis=2).reshape(-1, 3)
    vertices = directions.reshape(-1, 3) * radius_m + np.array(center_world)
    return Triangles(vertices, faces.astype(np.int32), np.full(len(faces), viewport, np.int32))


def random_views(
    rng: np.random.Generator,
    n_cameras: int,
    unseen: Unseen = "carve",
    min_cameras: int = 1,
    largest_px: int = 160,
    origin_world: NDArray[np.float64] | None = None,
    *,
    gaps: bool = True,
) -> Views:
    """Return cameras around the origin, 1.5 to 6 m away, of unequal image size and any roll.

    Where they may abstain, half of the rigs have cameras that did not record all of their images,
    unless without `gaps`.
    """
    sizes, projections = [], []
    for _ in range(n_cameras):
        width, height = rng.integers(8, largest_px, 2)
        direction = rng.normal(size=3)
        center = direction / np.linalg.norm(direction) * rng.uniform(1.5, 6.0)
        pose = look_at(center, rng.normal(size=3) * 0.1, rng.uniform(0, 2 * np.pi))
        matrix = projection(pose, rng.uniform(0.6, 2.5) * max(width, height), width, height)
        matrix *= rng.uniform(0.1, 10.0)  # a projection has no scale
        sizes.append((width, height))
        projections.append(matrix)
    matrices = np.array(projections)
    if origin_world is not None:
        matrices[:, :, 3] -= matrices[:, :, :3] @ origin_world
    names = tuple(f"cam{k}" for k in range(n_cameras))
    views = make_views(names, np.array(sizes), matrices, unseen, min_cameras)
    has_gaps = gaps and unseen == "keep" and rng.random() < 0.5
    return with_gaps(rng, views) if has_gaps else views


#: What of a pinhole image was recorded: a circle, all but some holes, part of it, all, or nothing.
_SEEN_KINDS = ("circle", "circle", "holes", "blobs", "half", "noise", "full", "empty")


def with_gaps(rng: np.random.Generator, views: Views) -> Views:
    """Return cameras that abstain with pixels in their images that were not recorded."""
    masks = []
    for camera, kind in enumerate(rng.choice(_SEEN_KINDS, len(views)).tolist()):
        width, height = views.sizes_px[camera]
        if kind == "circle":  # of a fisheye, which the image may cut
            x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
            radius = rng.uniform(0.3, 0.6) * max(width, height)
            masks.append((x - width / 2) ** 2 + (y - height / 2) ** 2 < radius**2)
        else:
            masks.append(random_masks(rng, views, [kind] * len(views))[camera] > 0)
    return replace(views, seen=make_seen(views.names, views.sizes_px, masks))


def large_views(rng: np.random.Generator) -> Views:
    """Return four cameras of 1600 x 1200, 2 to 10 m away, focal lengths from wide to long."""
    matrices = []
    for focal_px in (500.0, 1000.0, 2000.0, 3000.0):
        direction = rng.normal(size=3)
        center = direction / np.linalg.norm(direction) * rng.uniform(2.0, 10.0)
        pose = look_at(center, np.zeros(3), rng.uniform(0, 6.0))
        matrices.append(projection(pose, focal_px, 1600, 1200))
    return make_views(tuple("abcd"), np.array([[1600, 1200]] * 4), np.array(matrices))


#: What a pixel that was not recorded may stand for.
UNSEEN: tuple[Unseen, ...] = get_args(Unseen)

#: Silhouettes that leave something of the hull, and those that leave (next to) nothing.
MASK_KINDS = ("blobs", "holes", "noise", "half", "full")
EMPTYING_MASK_KINDS = ("empty", "pixel")


def random_masks(
    rng: np.random.Generator, views: Views, kinds: list[str]
) -> list[NDArray[np.uint8]]:
    """Return silhouettes, one kind a camera.

    Blobs lie about the projection of the local origin, where `random_corners` puts most
    triangles; holes leave the rest of the image; noise leaves 19 of 20 pixels; half is one side.
    """
    masks = []
    for k, kind in enumerate(kinds):
        width, height = views.sizes_px[k]
        mask = np.zeros((height, width), np.uint8)
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        if kind in ("blobs", "holes"):
            middle = views.img_from_local[k, :2, 3] / views.img_from_local[k, 2, 3]
            for number in range(4):
                cx, cy = middle + rng.normal(size=2) * 0.2 * (width, height)
                radius = rng.uniform(0.02, 0.3 if kind == "holes" else 0.6) * min(width, height)
                if number == 0 and kind == "blobs":
                    (cx, cy), radius = middle, 0.4 * min(width, height)
                mask |= ((x - cx) ** 2 + (y - cy) ** 2 < radius**2).astype(np.uint8)
            if kind == "holes":
                mask = 1 - mask
        elif kind == "full":
            mask[:] = 1
        elif kind == "pixel":
            mask[rng.integers(height), rng.integers(width)] = 1
        elif kind == "noise":
            mask[:] = rng.random((height, width)) < 0.95
        elif kind == "half":
            angle = rng.uniform(0, 2 * np.pi)
            mask[(x - width / 2) * np.cos(angle) + (y - height / 2) * np.sin(angle) > 0] = 1
        masks.append(mask * 255)
    return masks


TRIANGLE_KINDS = (
    "small",
    "middle",
    "large",
    "sliver",
    "flat",
    "point",
    "tiny",
    "huge",
    "behind",
    "through camera",
    "crossing",
)


def random_corners(rng: np.random.Generator, views: Views, kind: str) -> NDArray[np.float64]:
    """Return a triangle (3, 3) of a kind, in the local frame of the views."""
    around = rng.normal(size=3) * 0.1
    shape = rng.normal(size=(3, 3))
    matrix = views.img_from_local[rng.integers(len(views))]
    camera, forward = -np.linalg.solve(matrix[:, :3], matrix[:, 3]), matrix[2, :3]
    if kind == "small":
        return around + 0.02 * shape
    if kind == "middle":
        return around + 0.1 * shape
    if kind == "large":
        return around + 0.5 * shape
    if kind == "sliver":  # aspect 1e6
        corners = [0.3 * shape[0], -0.3 * shape[0], 3e-7 * shape[1]]
        return np.asarray(around + np.array(corners))
    if kind == "flat":  # no area: three points on a line
        return around + 0.3 * np.array([shape[0], -shape[0], rng.uniform(-1, 1) * shape[0]])
    if kind == "point":
        return np.tile(around, (3, 1))
    if kind == "tiny":
        return around + 1e-7 * shape
    if kind == "huge":
        return around + 100.0 * shape
    if kind == "behind":
        return np.asarray(camera - forward * rng.uniform(0.5, 3.0) + 0.2 * shape)
    if kind == "through camera":
        return np.array([camera, around, around + 0.3 * shape[0]])
    assert kind == "crossing"  # the plane through the camera, beside its image
    return np.asarray(camera + np.array([forward, -forward, 0.5 * forward]) + 0.3 * shape)


def soup(
    views: Views, corners_local: NDArray[np.float64], viewports: NDArray[np.int32]
) -> Triangles:
    """Return triangles that share no vertex, from (T, 3, 3) corners in the local frame."""
    n_triangles = len(corners_local)
    return Triangles(
        corners_local.reshape(-1, 3) + views.origin_world,
        np.arange(3 * n_triangles, dtype=np.int32).reshape(-1, 3),
        viewports,
    )


def pixels_of(
    views: Views, points_local: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return pixels (C, N, 2) and depths (C, N) in float64; NaN where a depth is 0."""
    projected = (
        np.einsum("cij,nj->cni", views.img_from_local[:, :, :3], points_local)
        + views.img_from_local[:, None, :, 3]
    )
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return projected[..., :2] / projected[..., 2:], projected[..., 2]


def near_pixel_edge(
    views: Views, points_local: NDArray[np.float64], band_px: float
) -> NDArray[np.bool_]:
    """Tell which points project within a band of a pixel edge, or lie in a camera's own plane."""
    pixels, depths_m = pixels_of(views, points_local)
    with np.errstate(invalid="ignore"):
        near = (np.abs(pixels - np.round(pixels)) < band_px).any(axis=-1)
    reach_m = 1.0 + np.abs(points_local).max(axis=-1, initial=0.0)
    result: NDArray[np.bool_] = (near | (np.abs(depths_m) < 1e-9 * reach_m)).any(axis=0)
    return result


@dataclass(frozen=True, slots=True)
class Difference:
    """How two engines' samples differ.

    Attributes
    ----------
    outside_band : list of (triangle, sample)
        Samples that only one has, and that are not excused by a pixel edge nearby.
    in_band : int
        How many are excused.
    """

    outside_band: list[tuple[int, int]]
    in_band: int


def differences(
    views: Views, mesh: Triangles, first: Hits, second: Hits, band_px: float
) -> Difference:
    """Compare the samples of two engines."""
    only_one = np.setxor1d(keys(first), keys(second))
    triangle, sample = only_one >> 32, (only_one & 0xFFFFFFFF).astype(np.uint32)
    corners_local = (mesh.vertices_world - views.origin_world)[mesh.faces[triangle]]
    positions = sample_positions(corners_local, mesh.viewports[triangle], sample)
    excused = near_pixel_edge(views, positions, band_px)
    unexcused = zip(triangle[~excused].tolist(), sample[~excused].tolist(), strict=True)
    return Difference(list(unexcused), int(excused.sum()))


def is_in_order(mesh: Triangles, hits: Hits) -> bool:
    """Tell whether runs ascend, are not empty, do not overlap, and hold samples of the mesh."""
    triangle, sample = hits.samples()
    viewports = mesh.viewports[triangle].astype(np.int64)
    in_range = (sample < viewports * (viewports + 1) // 2).all()
    ascend = (hits.start < hits.stop).all() and (hits.stop[:-1] <= hits.start[1:]).all()
    return bool(in_range and ascend and (np.diff(keys(hits)) > 0).all())


def keys(hits: Hits) -> NDArray[np.int64]:
    """Return one number for each sample, (P,): ``triangle << 32 | sample``."""
    triangle, sample = hits.samples()
    return triangle.astype(np.int64) << 32 | sample


def assert_same_samples(first: Hits, second: Hits) -> None:
    """Fail where two engines' samples differ at all."""
    np.testing.assert_array_equal(keys(first), keys(second))
