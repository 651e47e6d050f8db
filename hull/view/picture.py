"""One frame as a picture: cameras, the hull, the CAD, and what collides in red.

`draw_picture` shows the scene from outside, `draw_overlay` what one camera recorded with the CAD
drawn in. Both are for people: an engineer should see at a glance what was touched, and whether the
cameras, the silhouettes and the CAD are where they should be.

Pictures are drawn at twice their size and reduced, which smooths every edge alike.
"""

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import ReportError
from hybridve.calib.lens import cam_from_img, project_points
from hybridve.calib.pose import invert, transform
from hybridve.calib.rig import Rig
from hybridve.hull.jit import compiled
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.view.march import (
    SurfaceField,
    Viewpoint,
    WorkingVolume,
    bound_working_volume,
    in_bands,
    make_surface_field,
    march_depth,
)
from hybridve.hull.view.raster import (
    Layer,
    clip_lines,
    clip_triangles,
    draw_points,
    draw_triangles,
    line_triangles,
    make_layer,
)

__all__ = [
    "DrawnObject",
    "Viewpoint",
    "choose_viewpoint",
    "contact_sheet",
    "draw_overlay",
    "draw_picture",
    "write_picture",
]

Image = NDArray[np.uint8]
Color = tuple[int, int, int]

# Colours, BGR.
_HULL: Color = (176, 190, 202)
_FREE: Color = (186, 152, 122)
_COLLIDING: Color = (142, 156, 238)
_FREE_EDGE: Color = (97, 79, 63)
_COLLIDING_EDGE: Color = (74, 81, 124)
_HIT: Color = (28, 22, 222)
_HIT_POINT: Color = (14, 8, 118)
_CAMERA: Color = (92, 76, 62)
_GRID: Color = (206, 202, 198)
_GRID_MIDDLE: Color = (178, 174, 170)
_AXES: tuple[Color, Color, Color] = ((52, 52, 210), (62, 150, 46), (206, 104, 40))
_INK: Color = (52, 44, 38)
_FAINT_INK: Color = (120, 112, 104)
_PAPER: Color = (252, 251, 250)
_PAPER_BELOW: Color = (232, 229, 226)
_SILHOUETTE: Color = (90, 235, 60)

#: How many times larger a picture is drawn than it comes out.
_OVERSAMPLING = 2

#: Angle between the upper and the lower border of a picture, degrees.
_FOV_DEG = 28.0

#: Cameras are in the picture if the rest then still fills this share of its height.
_SMALLEST_SHARE = 0.34

#: Edges are drawn, and normals not smoothed across them, where faces meet at more than this.
_CREASE_DEG = 32.0

#: More collision points than this are thinned out before they are drawn.
_MAX_POINTS = 4000

#: Objects that the legend names; the rest are counted.
_MAX_NAMED = 8


@dataclass(frozen=True, slots=True, eq=False)
class DrawnObject:
    """A CAD object of one frame.

    Attributes
    ----------
    name : str
        As it stands in the legend.
    vertices_world : (V, 3) float64
        Metres.
    faces : (T, 3) int32
        Vertex numbers.
    collides : bool
        Whether it is touched.
    hit_triangles : (K,) uint32
        Numbers of the triangles that have collision points.
    hit_points_world : (P, 3) float32
        The collision points, metres.
    """

    name: str
    vertices_world: NDArray[np.float64]
    faces: NDArray[np.int32]
    collides: bool
    hit_triangles: NDArray[np.uint32]
    hit_points_world: NDArray[np.float32]


# ---------------------------------------------------------------------------------------------
# Where a picture is taken from


def choose_viewpoint(hull: Hull, rig: Rig, objects: Sequence[DrawnObject]) -> Viewpoint:
    """Return a view from above in which one sees the hull, the objects and where they touch.

    Of views from all around, the one that shows most of the touching triangles, then of the hull
    and the objects. Cameras are in it unless the rest would become tiny.
    """
    return _choose_viewpoint(bound_working_volume(hull), rig, objects)


def _choose_viewpoint(
    volume: WorkingVolume, rig: Rig, objects: Sequence[DrawnObject], *, aspect: float = 1.6
) -> Viewpoint:
    content = _content_points(volume, objects)
    if len(content) == 0:
        content = rig.centers_world
    best, best_score = None, -1.0
    trials = [
        (azimuth_deg, elevation_deg)
        for elevation_deg in (24.0, 40.0)
        for azimuth_deg in np.arange(-60.0, 300.0, 30.0)
    ]
    seen = []
    for azimuth_deg, elevation_deg in trials:
        viewpoint = _fit(content, content, azimuth_deg, elevation_deg, aspect)
        seen.append((viewpoint, _what_is_seen(volume, objects, viewpoint)))
    most = np.maximum(1.0, np.max([counts for _, counts in seen], axis=0))
    for viewpoint, counts in seen:
        score = float((counts / most) @ np.array([2.0, 0.6, 0.8, 0.8]))
        if score > best_score + 1e-9:
            best, best_score = viewpoint, score
    assert best is not None
    return _with_cameras(best, content, rig, aspect)


def _content_points(volume: WorkingVolume, objects: Sequence[DrawnObject]) -> NDArray[np.float64]:
    """Return points (N, 3) of the hull and the objects, metres, world."""
    parts = [np.zeros((0, 3))]
    if not volume.is_empty:
        parts.append(volume.centers_world)
    parts.extend(drawn.vertices_world[np.unique(drawn.faces)] for drawn in objects)
    return np.concatenate(parts)


def _fit(
    fitted: NDArray[np.float64],
    middle_of: NDArray[np.float64],
    azimuth_deg: float,
    elevation_deg: float,
    aspect: float,
) -> Viewpoint:
    """Return the nearest view from a direction in which all `fitted` points are in the picture."""
    azimuth, elevation = np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg)
    towards_eye = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    return _fit_along(fitted, middle_of, towards_eye, aspect)


def _fit_along(
    fitted: NDArray[np.float64],
    middle_of: NDArray[np.float64],
    towards_eye: NDArray[np.float64],
    aspect: float,
) -> Viewpoint:
    up = np.array([0.0, 0.0, 1.0])
    target = 0.5 * (middle_of.min(axis=0) + middle_of.max(axis=0))
    tangent = np.tan(np.deg2rad(0.5 * _FOV_DEG))
    # Titles stand above and the legend below, so the middle of the picture is not filled whole.
    half_width, half_height = 0.86 * tangent * aspect, 0.80 * tangent
    distance_m = 1.0
    for _ in range(6):
        pose = Viewpoint(target + towards_eye, target, up, _FOV_DEG).cam_from_world
        points = (fitted - target) @ pose[:, :3].T  # (N, 3), about the target
        needed = np.maximum(np.abs(points[:, 0]) / half_width, np.abs(points[:, 1]) / half_height)
        distance_m = max(1e-3, float((needed - points[:, 2]).max()))
        if fitted is not middle_of:
            break
        slopes = points[:, :2] / (points[:, 2:] + distance_m)
        shift = 0.5 * (slopes.min(axis=0) + slopes.max(axis=0)) * distance_m
        target = target + shift @ pose[:2, :3]
    return Viewpoint(target + distance_m * towards_eye, target, up, _FOV_DEG)


def _with_cameras(
    viewpoint: Viewpoint, content: NDArray[np.float64], rig: Rig, aspect: float
) -> Viewpoint:
    """Return a view from the same direction with all cameras in it, if the rest stays large."""
    towards_eye = viewpoint.eye_world - viewpoint.target_world
    towards_eye = towards_eye / np.linalg.norm(towards_eye)
    everything = np.concatenate([content, rig.centers_world])
    wide = _fit_along(everything, everything, towards_eye, aspect)
    near_share = _height_share(viewpoint, content)
    return wide if _height_share(wide, content) >= _SMALLEST_SHARE * near_share else viewpoint


def _height_share(viewpoint: Viewpoint, points_world: NDArray[np.float64]) -> float:
    """Return the share of the picture's height that points fill."""
    points_img = _to_image(points_world, viewpoint, (1000, 1000))
    rows = points_img[np.isfinite(points_img[:, 1]), 1]
    return float(np.ptp(rows)) / 1000 if len(rows) else 0.0


def _what_is_seen(
    volume: WorkingVolume, objects: Sequence[DrawnObject], viewpoint: Viewpoint
) -> NDArray[np.float64]:
    """Return how many pixels show touching triangles, such behind the hull, hull, and objects."""
    size_px = (160, 100)
    hull_m = march_depth(volume, viewpoint, size_px)
    solids, hits = make_layer(size_px), make_layer(size_px)
    for drawn in objects:
        corners = drawn.vertices_world[drawn.faces]
        colors = np.zeros(corners.shape)
        _draw_world(solids, corners, colors, viewpoint, size_px)
        touching = drawn.hit_triangles
        _draw_world(hits, corners[touching], colors[touching], viewpoint, size_px)
    there = np.isfinite(hits.depth_m)
    open_to_solids = there & (hits.depth_m <= solids.depth_m * 1.001)
    in_front = hits.depth_m <= hull_m
    return np.array(
        [
            (open_to_solids & in_front).sum(),
            (open_to_solids & ~in_front).sum(),
            (hull_m < solids.depth_m).sum(),
            (solids.depth_m < hull_m).sum(),
        ],
        np.float64,
    )


# ---------------------------------------------------------------------------------------------
# The scene from outside


def draw_picture(
    hull: Hull,
    rig: Rig,
    objects: Sequence[DrawnObject],
    *,
    viewpoint: Viewpoint | None = None,
    size_px: tuple[int, int] = (1600, 1000),
    title: str = "",
    caption: str = "",
) -> Image:
    """Return a picture of one frame: cameras, hull and objects, touching triangles in red.

    The hull is drawn pixel by pixel from its silhouettes (see `hybridve.hull.view.march`), and it
    and the objects obscure each other. Touching triangles shine through what hides them. Where
    not all cameras are in the picture, a small one in the corner shows the whole rig.

    Parameters
    ----------
    hull : Hull
        The hull of the frame.
    rig : Rig
        The cameras.
    objects : sequence of DrawnObject
        The CAD.
    viewpoint : Viewpoint, optional
        By default that of `choose_viewpoint`.
    size_px : (width, height)
        Of the picture.
    title, caption : str
        One line each, at the top.

    Returns
    -------
    (height, width, 3) uint8
        BGR.
    """
    width, height = size_px
    volume = bound_working_volume(hull)
    field = make_surface_field(volume)
    if viewpoint is None:
        viewpoint = _choose_viewpoint(volume, rig, objects, aspect=width / height)
    scene = _Scene(volume, field, rig, tuple(objects), _grid_spacing(volume, rig, objects))
    scale = height / 1000
    image = _draw_view(scene, viewpoint, size_px, scale)
    if not _all_in_view(rig, viewpoint, size_px):
        _draw_inset(image, scene, viewpoint, scale)
    _write_title(image, title, caption, scale)
    _write_legend(image, scene, scale)
    return image


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """What is in the picture, whatever the viewpoint."""

    volume: WorkingVolume
    field: SurfaceField
    rig: Rig
    objects: tuple[DrawnObject, ...]
    grid_m: float

    @property
    def content(self) -> NDArray[np.float64]:
        points = _content_points(self.volume, self.objects)
        return points if len(points) else self.rig.centers_world


def _draw_view(
    scene: _Scene, viewpoint: Viewpoint, size_px: tuple[int, int], scale: float
) -> Image:
    """Return the scene from a viewpoint, with labelled cameras, without title and legend."""
    width, height = size_px
    large_px = (_OVERSAMPLING * width, _OVERSAMPLING * height)
    line_px = _OVERSAMPLING * max(1.0, scale)
    hull_m = march_depth(scene.volume, viewpoint, large_px)

    solids, hits, lines = (make_layer(large_px) for _ in range(3))
    for number, drawn in enumerate(scene.objects):
        _draw_object(solids, hits, drawn, number, viewpoint, large_px, line_px)
    _draw_floor(lines, scene, viewpoint, large_px, line_px)
    _draw_cameras(lines, scene, viewpoint, large_px, line_px)

    large = _compose(hull_m, solids, hits, lines, scene, viewpoint)
    image = np.asarray(cv2.resize(large, size_px, interpolation=cv2.INTER_AREA), np.uint8)
    _label_cameras(image, scene.rig, viewpoint, scale)
    return image


def _draw_object(
    solids: Layer,
    hits: Layer,
    drawn: DrawnObject,
    number: int,
    viewpoint: Viewpoint,
    size_px: tuple[int, int],
    line_px: float,
) -> None:
    """Draw an object, its edges, its touching triangles and its collision points."""
    corners = drawn.vertices_world[drawn.faces]
    if len(corners) == 0:
        return
    normals = _corner_normals(drawn.vertices_world, drawn.faces)
    base = np.tile(np.array(_COLLIDING if drawn.collides else _FREE, np.float64), (len(corners), 1))
    touching = drawn.hit_triangles.astype(np.int64)
    base[touching] = _HIT
    light = _light(corners, normals, viewpoint)
    colors = base[:, None, :] * light[..., None]
    _draw_world(solids, corners, colors, viewpoint, size_px, number)
    # Red stays red in the shade.
    colors = np.array(_HIT) * (0.45 + 0.55 * light[touching])[..., None]
    _draw_world(hits, corners[touching], colors, viewpoint, size_px, number)

    edges = _feature_edges(drawn.vertices_world, drawn.faces)
    edge_color = _COLLIDING_EDGE if drawn.collides else _FREE_EDGE
    _draw_lines(solids, edges, edge_color, 0.55 * line_px, viewpoint, size_px, number)

    points = drawn.hit_points_world[:: max(1, len(drawn.hit_points_world) // _MAX_POINTS)]
    points_img = _to_image(points.astype(np.float64), viewpoint, size_px)
    points_img[:, 2] *= 1.0 - 1e-3  # they lie on the triangles
    draw_points(hits, points_img, _HIT_POINT, 0.75 * line_px)


def _corner_normals(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the unit normal at each corner of each triangle: (T, 3, 3).

    That of the surface around the vertex, or of the triangle alone where the two differ by more
    than a crease. Vertices at the same place count as one.
    """
    flat = _unit_normals(vertices[faces])
    _, place = np.unique(vertices, axis=0, return_inverse=True)
    corner_place = place.reshape(-1)[faces]  # (T, 3)
    corners = vertices[faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    total = np.zeros((int(corner_place.max()) + 1, 3))
    for corner in range(3):
        np.add.at(total, corner_place[:, corner], flat * area[:, None])
    around = _unit(total)[corner_place]  # (T, 3, 3)
    is_smooth = np.einsum("tkj,tj->tk", around, flat) > np.cos(np.deg2rad(_CREASE_DEG))
    return np.where(is_smooth[..., None], around, flat[:, None, :])


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0))


def _unit_normals(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    return _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def _feature_edges(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the edges (E, 2, 3) at creases and borders."""
    _, place = np.unique(vertices, axis=0, return_inverse=True)
    welded = place.reshape(-1)[faces].astype(np.int64)
    normals = _unit_normals(vertices[faces])
    pairs = np.sort(np.concatenate([welded[:, [0, 1]], welded[:, [1, 2]], welded[:, [2, 0]]]), 1)
    source = np.tile(np.arange(len(faces)), 3)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    keys = pairs[:, 0] * (int(welded.max()) + 1) + pairs[:, 1]
    order = np.argsort(keys, kind="stable")
    keys, source, ends = keys[order], source[order], ends[order]
    _, first, count = np.unique(keys, return_index=True, return_counts=True)
    second = np.minimum(first + 1, len(keys) - 1)
    cosine = np.einsum("ej,ej->e", normals[source[first]], normals[source[second]])
    is_feature = (count != 2) | (np.abs(cosine) < np.cos(np.deg2rad(_CREASE_DEG)))
    return np.asarray(vertices[ends[first[is_feature]]])


def _draw_floor(
    lines: Layer,
    scene: _Scene,
    viewpoint: Viewpoint,
    size_px: tuple[int, int],
    line_px: float,
) -> None:
    """Draw the plane z = 0 as a grid, and the world's axes."""
    spacing = scene.grid_m
    points = np.concatenate([scene.content, scene.rig.centers_world, np.zeros((1, 3))])
    low, high = scene.content.min(axis=0), scene.content.max(axis=0)
    margin = 0.6 * float(np.linalg.norm(high - low))
    reach = 30 * spacing
    middle = 0.5 * (low + high)
    low = np.maximum(np.minimum(points.min(axis=0), low - margin), middle - reach)
    high = np.minimum(np.maximum(points.max(axis=0), high + margin), middle + reach)
    first = np.floor(low[:2] / spacing).astype(int)
    last = np.ceil(high[:2] / spacing).astype(int)
    xs, ys = (np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
    grid = [[[x, first[1], 0], [x, last[1], 0]] for x in xs]
    grid += [[[first[0], y, 0], [last[0], y, 0]] for y in ys]
    _draw_lines(lines, np.array(grid) * spacing, _GRID, 0.7 * line_px, viewpoint, size_px)
    axis_m = spacing
    for axis, color in enumerate(_AXES):
        end = np.zeros((1, 2, 3))
        end[0, 1, axis] = axis_m
        _draw_lines(lines, end, color, 2.0 * line_px, viewpoint, size_px)


def _draw_cameras(
    lines: Layer,
    scene: _Scene,
    viewpoint: Viewpoint,
    size_px: tuple[int, int],
    line_px: float,
) -> None:
    """Draw each camera as the pyramid that it sees."""
    middle = 0.5 * (scene.content.min(axis=0) + scene.content.max(axis=0))
    for camera in scene.rig.cameras:
        depth_m = 0.13 * float(np.linalg.norm(camera.center_world - middle))
        corners_px = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (
            camera.width_px,
            camera.height_px,
        )
        homogeneous = np.column_stack([corners_px, np.ones(4)])
        rays = np.linalg.solve(camera.pinhole, homogeneous.T).T * depth_m
        top = 0.5 * (rays[0] + rays[1]) + 0.35 * (rays[0] - rays[3])
        world = transform(invert(camera.cam_from_world), np.vstack([np.zeros(3), rays, top]))
        ends = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1), (1, 5), (5, 2)]
        _draw_lines(lines, world[np.array(ends)], _CAMERA, 1.2 * line_px, viewpoint, size_px)


def _draw_lines(
    layer: Layer,
    ends_world: NDArray[np.float64],
    color: Color,
    width_px: float,
    viewpoint: Viewpoint,
    size_px: tuple[int, int],
    number: int = 0,
) -> None:
    """Draw lines (L, 2, 3) in metres, slightly in front of the surface that they lie on."""
    if len(ends_world) == 0:
        return
    ends, _ = clip_lines(transform_all(viewpoint.cam_from_world, ends_world))
    corners, _ = line_triangles(_project(ends, viewpoint, size_px), width_px)
    corners[..., 2] *= 1.0 - 5e-4
    colors = np.tile(np.array(color, np.float64), (len(corners), 3, 1))
    draw_triangles(layer, corners, colors, np.full(len(corners), number, np.int32))


def _draw_world(
    layer: Layer,
    corners_world: NDArray[np.float64],
    colors: NDArray[np.float64],
    viewpoint: Viewpoint,
    size_px: tuple[int, int],
    number: int = 0,
) -> None:
    """Draw triangles (T, 3, 3) in metres with a colour at each corner."""
    corners_cam = transform_all(viewpoint.cam_from_world, corners_world)
    clipped, _ = clip_triangles(np.concatenate([corners_cam, colors], axis=2))
    draw_triangles(
        layer,
        _project(clipped[..., :3], viewpoint, size_px),
        np.ascontiguousarray(clipped[..., 3:]),
        np.full(len(clipped), number, np.int32),
    )


def transform_all(
    b_from_a: NDArray[np.float64], points_a: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Map points (..., 3) from frame a to frame b."""
    return transform(b_from_a, points_a.reshape(-1, 3)).reshape(points_a.shape)


def _project(
    points_cam: NDArray[np.float64], viewpoint: Viewpoint, size_px: tuple[int, int]
) -> NDArray[np.float64]:
    """Return pixels and depth (..., 3) of points in front of the viewer."""
    matrix = viewpoint.img_from_cam(size_px)
    result = points_cam @ matrix.T
    result[..., :2] /= result[..., 2:]
    return np.asarray(result)


def _to_image(
    points_world: NDArray[np.float64], viewpoint: Viewpoint, size_px: tuple[int, int]
) -> NDArray[np.float64]:
    """Return pixels and depth (N, 3) of points; NaN pixels behind the viewer."""
    points_cam = transform(viewpoint.cam_from_world, points_world)
    visible = points_cam[:, 2] > 1e-3
    result = np.full(points_cam.shape, np.nan)
    result[visible] = _project(points_cam[visible], viewpoint, size_px)
    return result


#: Where light comes from in the viewer's frame (x right, y down, z forward), and how much.
_LIGHTS = (
    (np.array([-0.50, -0.70, -0.52]), 0.52),
    (np.array([0.75, -0.15, -0.64]), 0.14),
)
_AMBIENT, _FROM_ABOVE = 0.42, 0.10


def _light_vectors(viewpoint: Viewpoint) -> NDArray[np.float64]:
    """Return (3, 3): both lights and what is up, in the world, each as long as it is strong."""
    world_from_cam = viewpoint.cam_from_world[:, :3].T
    lights = [
        world_from_cam @ towards / np.linalg.norm(towards) * much for towards, much in _LIGHTS
    ]
    up = viewpoint.up_world / np.linalg.norm(viewpoint.up_world)
    return np.array([*lights, up * _FROM_ABOVE])


def _light(
    corners_world: NDArray[np.float64], normals: NDArray[np.float64], viewpoint: Viewpoint
) -> NDArray[np.float64]:
    """Return the light (T, 3) at the corners of triangles, which are lit from both sides."""
    to_eye = viewpoint.eye_world - corners_world
    flip = np.where(np.einsum("tkj,tkj->tk", normals, to_eye) < 0, -1.0, 1.0)
    normals = normals * flip[..., None]
    key, fill, above = _light_vectors(viewpoint)
    light = _AMBIENT + np.maximum(0, normals @ key) + np.maximum(0, normals @ fill)
    return np.asarray(light + normals @ above)


def _compose(
    hull_m: NDArray[np.float64],
    solids: Layer,
    hits: Layer,
    lines: Layer,
    scene: _Scene,
    viewpoint: Viewpoint,
) -> Image:
    """Return hull, objects and lines laid over each other by depth, on paper."""
    height, width = hull_m.shape
    pose = viewpoint.cam_from_world
    world_from_img = pose[:, :3].T @ np.linalg.inv(viewpoint.img_from_cam((width, height)))
    content = scene.content
    jump_m = 0.012 * float(np.linalg.norm(np.ptp(content, axis=0)))
    image = np.zeros((height, width, 3), np.uint8)
    field = scene.field

    def compose(start: int, stop: int) -> None:
        _compose_rows(
            image,
            start,
            stop,
            hull_m,
            solids.depth_m,
            solids.color,
            solids.number,
            hits.depth_m,
            hits.color,
            lines.depth_m,
            lines.color,
            viewpoint.eye_world,
            world_from_img,
            field.lower_world,
            field.voxel_m,
            field.fine,
            field.coarse,
            _light_vectors(viewpoint),
            _AMBIENT,
            np.array([_PAPER, _PAPER_BELOW, _HULL], np.float64),
            jump_m,
        )

    in_bands(compose, height)
    return image


@compiled
def _sample(field: NDArray[np.float32], x: float, y: float, z: float) -> float:
    """Return the trilinear value of a field at a place in voxels."""
    shape = field.shape
    x = min(max(x, 0.0), shape[0] - 1.001)
    y = min(max(y, 0.0), shape[1] - 1.001)
    z = min(max(z, 0.0), shape[2] - 1.001)
    if x < 0.0 or y < 0.0 or z < 0.0:  # a field of one voxel
        return 0.0
    i, j, k = int(x), int(y), int(z)
    u, v, w = x - i, y - j, z - k
    a = field[i, j, k] * (1.0 - w) + field[i, j, k + 1] * w
    b = field[i, j + 1, k] * (1.0 - w) + field[i, j + 1, k + 1] * w
    c = field[i + 1, j, k] * (1.0 - w) + field[i + 1, j, k + 1] * w
    d = field[i + 1, j + 1, k] * (1.0 - w) + field[i + 1, j + 1, k + 1] * w
    return float((a * (1.0 - v) + b * v) * (1.0 - u) + (c * (1.0 - v) + d * v) * u)


@compiled
def _hull_light(
    place: NDArray[np.float64],
    ray: NDArray[np.float64],
    fine: NDArray[np.float32],
    coarse: NDArray[np.float32],
    lights: NDArray[np.float64],
    ambient: float,
) -> float:
    """Return the light at a place (in voxels) on the hull, less where the hull is all around."""
    x, y, z = place
    normal_x = _sample(fine, x - 1.0, y, z) - _sample(fine, x + 1.0, y, z)
    normal_y = _sample(fine, x, y - 1.0, z) - _sample(fine, x, y + 1.0, z)
    normal_z = _sample(fine, x, y, z - 1.0) - _sample(fine, x, y, z + 1.0)
    length = np.sqrt(normal_x * normal_x + normal_y * normal_y + normal_z * normal_z)
    if length < 1e-6:  # too thin for the field: lit as if it faced the viewer
        normal_x, normal_y, normal_z = -ray[0], -ray[1], -ray[2]
        length = np.sqrt(normal_x * normal_x + normal_y * normal_y + normal_z * normal_z)
    normal_x, normal_y, normal_z = normal_x / length, normal_y / length, normal_z / length
    around = _sample(coarse, x + 3.0 * normal_x, y + 3.0 * normal_y, z + 3.0 * normal_z)
    key = lights[0, 0] * normal_x + lights[0, 1] * normal_y + lights[0, 2] * normal_z
    fill = lights[1, 0] * normal_x + lights[1, 1] * normal_y + lights[1, 2] * normal_z
    above = lights[2, 0] * normal_x + lights[2, 1] * normal_y + lights[2, 2] * normal_z
    light = ambient + max(0.0, key) + max(0.0, fill) + above
    return float(light * (1.22 - 0.75 * min(1.0, around)))


@compiled
def _compose_rows(
    image: NDArray[np.uint8],
    start: int,
    stop: int,
    hull_m: NDArray[np.float64],
    solid_m: NDArray[np.float32],
    solid_color: NDArray[np.uint8],
    solid_number: NDArray[np.int32],
    hit_m: NDArray[np.float32],
    hit_color: NDArray[np.uint8],
    line_m: NDArray[np.float32],
    line_color: NDArray[np.uint8],
    eye: NDArray[np.float64],
    world_from_img: NDArray[np.float64],
    field_lower: NDArray[np.float64],
    voxel_m: float,
    fine: NDArray[np.float32],
    coarse: NDArray[np.float32],
    lights: NDArray[np.float64],
    ambient: float,
    palette: NDArray[np.float64],
    jump_m: float,
) -> None:
    height, width = hull_m.shape
    ray = np.zeros(3)
    place = np.zeros(3)
    color = np.zeros(3)
    for row in range(start, stop):
        below = row / height
        for column in range(width):
            hull, solid, line = hull_m[row, column], solid_m[row, column], line_m[row, column]
            for channel in range(3):
                color[channel] = palette[0, channel] + below * (
                    palette[1, channel] - palette[0, channel]
                )
            nearest = min(hull, solid)
            if line < nearest:
                for channel in range(3):
                    color[channel] = line_color[row, column, channel]
            elif solid <= hull and solid < np.inf:
                for channel in range(3):
                    color[channel] = solid_color[row, column, channel]
            elif hull < np.inf:
                for axis in range(3):
                    ray[axis] = (
                        world_from_img[axis, 0] * (column + 0.5)
                        + world_from_img[axis, 1] * (row + 0.5)
                        + world_from_img[axis, 2]
                    )
                    place[axis] = (eye[axis] + hull * ray[axis] - field_lower[axis]) / voxel_m
                light = _hull_light(place, ray, fine, coarse, lights, ambient)
                for channel in range(3):
                    color[channel] = min(255.0, palette[2, channel] * light)
                if solid < np.inf:  # the part of the object inside or behind the hull, faintly
                    for channel in range(3):
                        color[channel] += 0.16 * (
                            solid_color[row, column, channel] - color[channel]
                        )
            hit = hit_m[row, column]
            if hit < np.inf:
                strength = 0.0
                if hit <= nearest * 1.0015:
                    strength = 1.0
                elif hit <= solid * 1.0015:
                    strength = 0.62  # behind the hull alone
                else:
                    strength = 0.25
                if line < hit and line < nearest:
                    strength = 0.0
                for channel in range(3):
                    color[channel] += strength * (hit_color[row, column, channel] - color[channel])
            # A thin dark rim where one thing ends in front of another.
            if 0 < column < width - 1 and 0 < row < height - 1 and nearest < np.inf:
                is_rim = False
                for turn in range(4):
                    r = row + (1 if turn == 0 else (-1 if turn == 1 else 0))
                    c = column + (1 if turn == 2 else (-1 if turn == 3 else 0))
                    other_hull, other_solid = hull_m[r, c], solid_m[r, c]
                    other = min(other_hull, other_solid)
                    opposite = min(
                        hull_m[2 * row - r, 2 * column - c], solid_m[2 * row - r, 2 * column - c]
                    )
                    if other - nearest > jump_m + 2.0 * abs(nearest - opposite):
                        is_rim = True
                if is_rim and not line < nearest:
                    for channel in range(3):
                        color[channel] *= 0.55
            for channel in range(3):
                image[row, column, channel] = np.uint8(min(max(color[channel], 0.0), 255.0))


# ---------------------------------------------------------------------------------------------
# Around the scene


def _grid_spacing(volume: WorkingVolume, rig: Rig, objects: Sequence[DrawnObject]) -> float:
    """Return a round spacing in metres: about six lines across hull and objects."""
    points = _content_points(volume, objects)
    if len(points) == 0:
        points = rig.centers_world
    extent_m = max(1e-3, float(np.ptp(points, axis=0).max()))
    wanted = extent_m / 4
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= wanted))


def _all_in_view(rig: Rig, viewpoint: Viewpoint, size_px: tuple[int, int]) -> bool:
    points_img = _to_image(rig.centers_world, viewpoint, size_px)
    if not np.isfinite(points_img).all():
        return False
    pixels = points_img[:, :2]
    return bool((pixels >= 0).all() and (pixels < size_px).all())


def _draw_inset(image: Image, scene: _Scene, viewpoint: Viewpoint, scale: float) -> None:
    """Draw the whole rig into the upper right corner of a picture."""
    height, width = image.shape[:2]
    size_px = (round(0.27 * width), round(0.27 * height))
    towards_eye = viewpoint.eye_world - viewpoint.target_world
    towards_eye = towards_eye / np.linalg.norm(towards_eye)
    everything = np.concatenate([scene.content, scene.rig.centers_world])
    overview = _fit_along(everything, everything, towards_eye, size_px[0] / size_px[1])
    inset = _draw_view(scene, overview, size_px, 0.62 * scale)
    margin = round(24 * scale)
    left = width - size_px[0] - margin
    image[margin : margin + size_px[1], left : left + size_px[0]] = inset
    cv2.rectangle(
        image,
        (left, margin),
        (left + size_px[0], margin + size_px[1]),
        _GRID_MIDDLE,
        max(1, round(scale)),
        cv2.LINE_AA,
    )


def _label_cameras(image: Image, rig: Rig, viewpoint: Viewpoint, scale: float) -> None:
    height, width = image.shape[:2]
    points_img = _to_image(rig.centers_world, viewpoint, (width, height))
    size = max(11, round(17 * scale))
    for camera, (x, y, _) in zip(rig.cameras, points_img, strict=True):
        if 0 <= x < width and 0 <= y < height:
            _write(image, camera.name, (round(x + 8 * scale), round(y - 8 * scale)), size, _CAMERA)


def _write_title(image: Image, title: str, caption: str, scale: float) -> None:
    left = round(36 * scale)
    _write(image, title, (left, round(58 * scale)), round(32 * scale), _INK, weight=600)
    _write(image, caption, (left, round(94 * scale)), round(20 * scale), _FAINT_INK)


def _write_legend(image: Image, scene: _Scene, scale: float) -> None:
    rows: list[tuple[Color, str]] = [(_HULL, "real: visual hull of the silhouettes")]
    if any(drawn.collides for drawn in scene.objects):
        rows.append((_HIT, "touching triangles"))
    # What is touched is named first.
    ordered = sorted(scene.objects, key=lambda drawn: not drawn.collides)
    for drawn in ordered[:_MAX_NAMED]:
        if drawn.collides:
            n_touching = len(drawn.hit_triangles)
            word = "triangle" if n_touching == 1 else "triangles"
            rows.append((_COLLIDING, f"{drawn.name}: touched, {n_touching} {word}"))
        else:
            rows.append((_FREE, f"{drawn.name}: free"))
    if len(ordered) > _MAX_NAMED:
        rows.append((_PAPER_BELOW, f"and {len(ordered) - _MAX_NAMED} more"))
    rows.append((_GRID, f"floor z = 0, grid {scene.grid_m:g} m; axes x red, y green, z blue"))
    size, pitch, swatch = round(17 * scale), round(27 * scale), round(15 * scale)
    left = round(36 * scale)
    y = image.shape[0] - round(36 * scale) - pitch * (len(rows) - 1)
    for color, text in rows:
        cv2.rectangle(image, (left, y - swatch + 2), (left + swatch, y + 2), color, -1)
        cv2.rectangle(image, (left, y - swatch + 2), (left + swatch, y + 2), _FAINT_INK, 1)
        _write(image, text, (left + 2 * swatch, y), size, _INK)
        y += pitch


def _write(
    image: Image,
    text: str,
    origin: tuple[int, int],
    size: int,
    color: Color,
    weight: int = 400,
) -> None:
    """Write a line of text with its baseline at `origin`, `size` pixels high."""
    if not text:
        return
    library: Any = cv2
    if hasattr(library, "FontFace"):  # OpenCV 5 brings a typeface
        library.putText(image, text, origin, color, library.FontFace("sans"), size, weight)
        return
    plain = text.encode("ascii", "replace").decode()
    thickness = 2 if weight > 500 else 1
    cv2.putText(
        image, plain, origin, cv2.FONT_HERSHEY_SIMPLEX, size / 30, color, thickness, cv2.LINE_AA
    )


# ---------------------------------------------------------------------------------------------
# What a camera recorded


#: A triangle whose edge is longer than this in the image is halved: a lens bends straight edges.
_LONGEST_EDGE_PX = 48.0


def draw_overlay(
    image: Image,
    camera: Camera,
    silhouette: NDArray[np.uint8],
    objects: Sequence[DrawnObject],
) -> Image:
    """Return a camera's frame with the silhouette outlined and the CAD drawn over it.

    The CAD is projected through the lens into the image as it was recorded. What lies behind the
    camera, or so far aside that the lens model does not hold, is left out.

    Parameters
    ----------
    image : (H, W, 3) or (H, W) uint8
        The frame as recorded, BGR or grey.
    camera : Camera
        The camera.
    silhouette : (H, W) uint8
        Above 0 on object pixels, as recorded.
    objects : sequence of DrawnObject
        The CAD.

    Returns
    -------
    (H, W, 3) uint8
    """
    frame = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
    height, width = frame.shape[:2]
    result = frame.astype(np.float32)
    layer, touching = make_layer((width, height)), make_layer((width, height))
    for number, drawn in enumerate(objects):
        base = _COLLIDING if drawn.collides else _FREE
        corners, source = _through_lens(drawn.vertices_world[drawn.faces], camera)
        colors = _flat_colors(drawn, camera, base)[source]
        draw_triangles(layer, corners, colors, np.full(len(corners), number, np.int32))
        is_hit = np.isin(source, drawn.hit_triangles.astype(np.int64))
        red = np.tile(np.array(_HIT, np.float64), (int(is_hit.sum()), 3, 1))
        draw_triangles(touching, corners[is_hit], red, np.full(len(red), number, np.int32))
    covered, red_there = layer.number >= 0, touching.number >= 0
    result[covered] += 0.5 * (layer.color[covered] - result[covered])
    result[red_there] += 0.7 * (touching.color[red_there] - result[red_there])
    # Rims of the objects: where the object that is seen changes.
    rims = cv2.morphologyEx(
        (layer.number + 1).astype(np.float32), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)
    )
    result[rims > 0] *= 0.45
    drawn_over = np.ascontiguousarray(result.clip(0, 255).astype(np.uint8))

    contours, _ = cv2.findContours(
        (silhouette > 0).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE
    )
    scale = max(height, 1) / 1000
    cv2.drawContours(drawn_over, contours, -1, _SILHOUETTE, max(1, round(1.6 * scale)), cv2.LINE_AA)
    size = max(14, round(30 * scale))
    for shift, color in ((1, (0, 0, 0)), (0, (255, 255, 255))):  # legible on light and on dark
        _write(
            drawn_over, camera.name, (size // 2 + shift, 3 * size // 2 + shift), size, color, 600
        )
    return drawn_over


def _flat_colors(drawn: DrawnObject, camera: Camera, base: Color) -> NDArray[np.float64]:
    """Return a colour for each corner of each triangle, lit from the camera."""
    corners = drawn.vertices_world[drawn.faces]
    normals = _corner_normals(drawn.vertices_world, drawn.faces) if len(corners) else corners
    to_eye = _unit(camera.center_world - corners)
    facing = np.abs(np.einsum("tkj,tkj->tk", normals, to_eye))
    return np.asarray(np.array(base) * (0.5 + 0.6 * facing)[..., None])


def _through_lens(
    corners_world: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Project triangles through a lens, halved until straight edges serve.

    Returns
    -------
    corners_img : (M, 3, 3) float64
        Pixels and metres of depth.
    source : (M,) int64
        The triangle that each is a part of.
    """
    source = np.arange(len(corners_world))
    done: list[NDArray[np.float64]] = [np.zeros((0, 3, 3))]
    sources: list[NDArray[np.int64]] = [np.zeros(0, np.int64)]
    for turn in range(6):
        if len(corners_world) == 0:
            break
        corners_img, is_good = _lens_points(corners_world, camera)
        edges = np.roll(corners_img, 1, axis=1)[..., :2] - corners_img[..., :2]
        length = np.where(is_good, np.linalg.norm(edges, axis=2), np.inf).max(axis=1)
        good = is_good.all(axis=1)
        keep = good & (length <= _LONGEST_EDGE_PX)
        if turn == 5 or (not camera.has_distortion and good.all()):
            keep = good
        done.append(corners_img[keep])
        sources.append(source[keep])
        split = ~keep & is_good.any(axis=1) if turn < 5 else np.zeros(len(keep), np.bool_)
        a, b, c = corners_world[split].transpose(1, 0, 2)
        ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
        quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        corners_world = np.concatenate([np.stack(quarter, axis=1) for quarter in quarters])
        source = np.tile(source[split], 4)
    return np.concatenate(done), np.concatenate(sources)


def _lens_points(
    points_world: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return pixels and depth of points (..., 3), and where the lens model holds."""
    flat = points_world.reshape(-1, 3)
    pixels, depth_m = project_points(camera, flat)
    good = (depth_m > 1e-3) & np.isfinite(pixels).all(axis=1)
    if camera.has_distortion and good.any():
        # Polynomial distortion folds over far outside the image: such a pixel leads to another ray.
        rays = cam_from_img(camera, pixels[good])
        points_cam = transform(camera.cam_from_world, flat[good])
        with np.errstate(invalid="ignore"):
            off = np.linalg.norm(rays - points_cam[:, :2] / points_cam[:, 2:], axis=1)
            good[good] = off < 1e-3
    result = np.column_stack([np.where(good[:, None], pixels, 0.0), np.where(good, depth_m, 1.0)])
    return result.reshape(points_world.shape), good.reshape(points_world.shape[:-1])


def contact_sheet(images: Sequence[Image], columns: int) -> Image:
    """Return pictures side by side, row after row, all in cells of the largest picture's size.

    Raises
    ------
    ValueError
        If there is no picture, or `columns` is not positive.
    """
    if not images or columns < 1:
        raise ValueError(f"{len(images)} images in {columns} columns, expected at least one each")
    height = max(image.shape[0] for image in images)
    width = max(image.shape[1] for image in images)
    gap = max(2, height // 120)
    columns = min(columns, len(images))
    n_rows = -(-len(images) // columns)
    sheet = np.full(
        (n_rows * (height + gap) + gap, columns * (width + gap) + gap, 3), _PAPER_BELOW, np.uint8
    )
    for number, image in enumerate(images):
        factor = min(width / image.shape[1], height / image.shape[0])
        size = (round(image.shape[1] * factor), round(image.shape[0] * factor))
        fitted = image if factor == 1 else cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
        row, column = divmod(number, columns)
        top = gap + row * (height + gap) + (height - size[1]) // 2
        left = gap + column * (width + gap) + (width - size[0]) // 2
        sheet[top : top + size[1], left : left + size[0]] = fitted
    return sheet


def write_picture(path: Path, image: Image) -> None:
    """Write a picture in the format that the file's ending names; it appears only when complete.

    Raises
    ------
    ReportError
        If the ending names no format, or the file cannot be written.
    """
    try:
        encoded, data = cv2.imencode(path.suffix or ".", image)
    except cv2.error as error:
        raise ReportError(
            f"{path}: {path.suffix or 'no ending'} names no picture format; expected .png or .jpg"
        ) from error
    if not encoded:
        raise ReportError(f"{path}: cannot be encoded as {path.suffix}; write a .png")
    partial = ""
    try:
        handle, partial = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(handle, "wb") as file:
            file.write(data.tobytes())
        umask = os.umask(0)
        os.umask(umask)
        Path(partial).chmod(0o666 & ~umask)  # what a plain open() would have given
        Path(partial).replace(path)
    except OSError as error:
        if partial:
            Path(partial).unlink(missing_ok=True)
        raise ReportError(
            f"{path}: cannot be written: {error.strerror or error}; choose another place"
        ) from error
