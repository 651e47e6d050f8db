"""A ball seen by a ring of cameras, boxes beside it, and what colour a pixel is."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from helpers.hulls import ball_hull, ring_views
from hybridve.calib.camera import Camera
from hybridve.calib.rig import Rig
from hybridve.hull.query.engine import Triangles
from hybridve.hull.query.reference import Reference
from hybridve.hull.query.silhouettes import Hull, Views
from hybridve.hull.query.viewport import sample_positions
from hybridve.hull.view.picture import DrawnObject, Viewpoint

BALL_RADIUS_M = 0.4

#: The ring of `ring_views`.
WIDTH_PX, HEIGHT_PX, FOCAL_PX = 720, 486, 700.0

#: The corners of a unit cube, and its triangles.
_CUBE = np.array([[i >> axis & 1 for axis in range(3)] for i in range(8)], np.float64) - 0.5
_CUBE_FACES = np.array(
    [
        [0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
        [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5],
    ],
    np.int32,
)  # fmt: skip


def ball_scene(n_cameras: int = 6, radius_m: float = BALL_RADIUS_M) -> tuple[Hull, Rig]:
    """Return the hull of a ball at the origin, and the ring of cameras that saw it."""
    views = ring_views(n_cameras)
    return ball_hull(views, np.zeros(3), radius_m), ring_rig(views)


def ring_rig(views: Views) -> Rig:
    """Return the cameras of `ring_views` as a rig."""
    pinhole = np.array([FOCAL_PX, FOCAL_PX, WIDTH_PX / 2, HEIGHT_PX / 2])
    matrix = np.array([[FOCAL_PX, 0, WIDTH_PX / 2], [0, FOCAL_PX, HEIGHT_PX / 2], [0, 0, 1.0]])
    cameras = []
    for name, img_from_local in zip(views.names, views.img_from_local, strict=True):
        pose = np.linalg.solve(matrix, img_from_local)
        pose[:, 3] -= pose[:, :3] @ views.origin_world
        cameras.append(Camera(name, "PINHOLE", WIDTH_PX, HEIGHT_PX, pinhole, pose))
    return Rig(tuple(cameras))


def box(
    name: str,
    center_world: tuple[float, float, float],
    edges_m: float | tuple[float, float, float] = 0.2,
    *,
    hits: tuple[int, ...] = (),
) -> DrawnObject:
    """Return a box; the triangles `hits` are touched, each with a collision point in its middle."""
    vertices = _CUBE * edges_m + np.array(center_world)
    middles = vertices[_CUBE_FACES[list(hits)]].mean(axis=1).astype(np.float32)
    return DrawnObject(
        name,
        vertices,
        _CUBE_FACES,
        len(hits) > 0,
        np.array(hits, np.uint32),
        middles.reshape(-1, 3),
    )


def touched_box(
    name: str, hull: Hull, center_world: tuple[float, float, float], edges_m: float = 0.3
) -> DrawnObject:
    """Return a box with the collision points that the reference finds in the hull."""
    plain = box(name, center_world, edges_m)
    viewports = np.full(len(plain.faces), 24, np.int32)
    with Reference() as engine:
        hits = engine.query(hull, [Triangles(plain.vertices_world, plain.faces, viewports)])[0]
    triangle, sample = hits.samples()
    corners = plain.vertices_world[plain.faces[triangle]]
    points = sample_positions(corners, viewports[triangle], sample)
    return replace(
        plain,
        collides=len(hits) > 0,
        hit_triangles=np.unique(triangle),
        hit_points_world=points.astype(np.float32),
    )


def view_from(x: float, y: float, z: float, fov_deg: float = 30.0) -> Viewpoint:
    """Return the view from a place to the origin."""
    return Viewpoint(np.array([x, y, z]), np.zeros(3), np.array([0.0, 0.0, 1.0]), fov_deg)


def pixels_of(
    viewpoint: Viewpoint, points_world: NDArray[np.float64], size_px: tuple[int, int]
) -> NDArray[np.float64]:
    """Return where points (N, 3) before the viewer are in a picture: (N, 2) pixels."""
    forward = viewpoint.target_world - viewpoint.eye_world
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, viewpoint.up_world)
    right = right / np.linalg.norm(right)
    across = (points_world - viewpoint.eye_world) @ np.array([right, np.cross(forward, right)]).T
    depth_m = (points_world - viewpoint.eye_world) @ forward
    assert (depth_m > 0).all(), "behind the viewer"
    focal_px = 0.5 * size_px[1] / np.tan(np.deg2rad(0.5 * viewpoint.vertical_fov_deg))
    return np.asarray(0.5 * np.array(size_px) + focal_px * across / depth_m[:, None])


def cone_intersections(
    eye: NDArray[np.float64],
    rays: NDArray[np.float64],
    apexes: NDArray[np.float64],
    axis_target: NDArray[np.float64],
    half_angles: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where rays (N, 3) enter and leave the intersection of cones, in closed form.

    The cones stand at `apexes` (C, 3) and open by `half_angles` (C,) towards `axis_target`. A ray
    that misses enters after it leaves.
    """
    enter, leave = np.zeros(len(rays)), np.full(len(rays), np.inf)
    for apex, half_angle in zip(apexes, half_angles, strict=True):
        axis = (axis_target - apex) / np.linalg.norm(axis_target - apex)
        squared = np.cos(half_angle) ** 2
        start = eye - apex
        a = (rays @ axis) ** 2 - squared * (rays**2).sum(axis=1)
        b = (start @ axis) * (rays @ axis) - squared * rays @ start
        c = (start @ axis) ** 2 - squared * start @ start
        root = np.sqrt(np.maximum(0.0, b * b - a * c))
        first, second = np.sort(np.stack([(-b - root) / a, (-b + root) / a]), axis=0)
        # A cone is convex: one of the three pieces of a line is inside, or none. The cone behind
        # the apex, which solves the same equation, is left out.
        far = np.full(len(rays), np.inf)
        pieces = [(-far, first), (first, second), (second, far)]
        here_enter, here_leave = np.full(len(rays), 1e9), np.full(len(rays), -1e9)
        for low, high in pieces:
            middle = 0.5 * (np.maximum(low, -1e3) + np.minimum(high, 1e3))
            points = start + middle[:, None] * rays
            inside = points @ axis > np.cos(half_angle) * np.linalg.norm(points, axis=1)
            inside &= (b * b > a * c) & (high > low)
            here_enter = np.where(inside, np.minimum(here_enter, low), here_enter)
            here_leave = np.where(inside, np.maximum(here_leave, high), here_leave)
        enter, leave = np.maximum(enter, here_enter), np.minimum(leave, here_leave)
    return enter, leave


def is_red(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Tell where a picture is the saturated red of touching triangles."""
    blue, green, red = (image[..., channel].astype(int) for channel in range(3))
    return np.asarray((red > 120) & (red > 2 * green) & (red > 2 * blue))


def is_blue_grey(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Tell where a picture is the blue-grey of free objects."""
    blue, red = image[..., 0].astype(int), image[..., 2].astype(int)
    return np.asarray((blue > 1.25 * red) & (red > 30))


def is_warm_grey(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Tell where a picture is the warm grey of the hull."""
    blue, green, red = (image[..., channel].astype(int) for channel in range(3))
    return np.asarray((red > 1.05 * blue) & (red < 1.35 * blue) & (green < red) & (blue < green))
