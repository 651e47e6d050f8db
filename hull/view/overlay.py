"""One camera's recorded image with the silhouette outlined and the CAD drawn over it."""

from dataclasses import dataclass

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.hull.view.drawn import DrawnObject, Measure, thinned
from hybridve.hull.view.labels import bgr, plate, put_text, text_size
from hybridve.hull.view.novel import NEVER_M, clear_all, load_shader, set_uniforms
from hybridve.hull.view.paint import (
    COLLIDING,
    FREE,
    INSIDE_RGB,
    TOUCHED,
    Rgb,
)

Image = NDArray[np.uint8]

#: Colour of the silhouette's outline: one that neither people nor rooms have much of.
_OUTLINE_RGB: Rgb = (0.10, 0.95, 0.75)

#: How much of the frame is seen through the CAD.
_SEEN_THROUGH = {FREE: 0.35, COLLIDING: 0.35, TOUCHED: 0.25}

#: Stronger than in the drawing: a room is darker and busier than paper.
_COLOURS = {FREE: (0.42, 0.64, 0.93), COLLIDING: (0.98, 0.70, 0.64), TOUCHED: (0.95, 0.42, 0.36)}

#: How much of its strength CAD keeps where the hull is before it, and from what share of the depth
#: on it is.
_HIDDEN, _SLACK = 0.25, 2e-3

#: Longest edge of a triangle in a distorted image, in pixels: longer ones are cut, so that they
#: bend as the lens bends them (0.2 px off the true curve at a curvature radius of 1000 px).
_LONGEST_EDGE_PX = 40.0
_MOST_CUTS = 6

#: Collision points: radius and spacing of the dots in pixels, for an image 500 high.
_POINT_RADIUS_PX, _POINT_SPACING_PX = 1.6, 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
    """What is drawn over a camera's frame; see `hybridve.hull.view.picture.draw_overlay`."""

    objects: list[DrawnObject]
    hull_depth_m: NDArray[np.float32] | None = None
    measures: tuple[Measure, ...] = ()
    share: float = 1.0


def overlay_picture(
    device: moderngl.Context,
    image: Image,
    camera: Camera,
    mask: NDArray[np.uint8],
    over: Overlay,
) -> Image:
    """Return the picture; see `hybridve.hull.view.picture.draw_overlay`."""
    from hybridve.calib.lens import project_points  # late: pycolmap takes a quarter of a second

    # What is drawn must be seen once the picture is as small as it will be.
    scale = max(camera.height_px / 500, 1.0 / over.share if over.share < 1.0 else 0.0)
    result, objects = image.copy(), over.objects
    triangles, kinds = _projected_triangles(camera, objects)
    if len(triangles):
        kind, facing, edge, distance = _rasterised(device, camera, triangles, kinds)
        hidden = np.zeros(kind.shape, np.bool_)
        if over.hull_depth_m is not None:
            before = np.repeat(np.repeat(over.hull_depth_m, 2, axis=0), 2, axis=1)
            hidden = before * (1.0 + _SLACK) < distance
        result = _blended(result, kind, facing, edge, hidden)
    contours, _ = cv2.findContours(
        (mask > 0).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE
    )
    width = max(1, round(scale))
    cv2.drawContours(result, contours, -1, (0, 0, 0), width + 1, cv2.LINE_AA)
    cv2.drawContours(result, contours, -1, bgr(_OUTLINE_RGB), width, cv2.LINE_AA)
    for item in objects:
        if not item.collides or len(item.hit_points_world) == 0:
            continue
        pixels, _ = project_points(camera, np.asarray(item.hit_points_world, np.float64))
        pixels = pixels[np.isfinite(pixels).all(axis=1)]
        pixels = pixels[
            ((pixels >= 0) & (pixels < (camera.width_px, camera.height_px))).all(axis=1)
        ]
        for x, y in pixels[thinned(pixels, _POINT_SPACING_PX * scale)]:
            # Sub-pixel places in OpenCV's convention, in 1/16 px.
            center = (round((x - 0.5) * 16), round((y - 0.5) * 16))
            radius = round(_POINT_RADIUS_PX * scale * 16)
            cv2.circle(result, center, radius, bgr(INSIDE_RGB), -1, cv2.LINE_AA, 4)
    for measure in over.measures:
        _measure(result, camera, measure, scale)
    if over.share < 1.0:
        size = tuple(max(1, round(over.share * extent)) for extent in result.shape[1::-1])
        result = np.asarray(cv2.resize(result, size, interpolation=cv2.INTER_AREA), np.uint8)
    _name(result, camera.name, camera.height_px * over.share / 500)
    return result


def _measure(image: Image, camera: Camera, measure: Measure, scale: float) -> None:
    """Draw a line with its number; nothing if an end is behind the camera, or far outside."""
    from hybridve.calib.lens import project_points  # late: pycolmap takes a quarter of a second

    ends = np.stack([measure.start_world, measure.end_world])
    pixels, _ = project_points(camera, ends)
    extent = np.array([camera.width_px, camera.height_px])
    if not np.isfinite(pixels).all() or (np.abs(pixels - extent / 2) > extent).any():
        return
    first, last = ((round(x - 0.5), round(y - 0.5)) for x, y in pixels)
    width = max(1, round(1.5 * scale))
    cv2.line(image, first, last, (255, 255, 255), 3 * width, cv2.LINE_AA)
    cv2.line(image, first, last, bgr(measure.rgb), width, cv2.LINE_AA)
    if measure.text:
        size = 0.5 * max(scale, 0.6)
        wide, above, below = text_size(measure.text, size, bold=True)
        x, y = (int(value) for value in pixels.mean(axis=0))
        left = min(max(x - wide // 2, 4), max(camera.width_px - wide - 4, 4))
        baseline = max(y - round(22 * scale), above + 4)
        plate(image, (left - 3, baseline - above - 3, left + wide + 3, baseline + below), 0.75)
        put_text(image, measure.text, (left, baseline), size, measure.rgb, bold=True)


def _projected_triangles(
    camera: Camera, objects: list[DrawnObject]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return triangles (T, 3, 3) as x, y in pixels and depth in metres, and their kinds (T,).

    Triangles that reach behind the camera, or where the lens has no image, are left out.
    """
    corners, kinds = [np.zeros((0, 3, 3))], [np.zeros(0)]
    for item in objects:
        kind = np.full(len(item.faces), COLLIDING if item.collides else FREE)
        if item.collides:
            kind[item.hit_triangles] = TOUCHED
        corners.append(item.corners_world)
        kinds.append(kind)
    whole, kind = np.concatenate(corners), np.concatenate(kinds)
    done, done_kinds = [np.zeros((0, 3, 3))], [np.zeros(0)]
    for cut in range(_MOST_CUTS + 1):
        seen, flat = _project(camera, whole)
        # A triangle that reaches behind the camera is cut in the hope that a part of it does not.
        length = np.zeros(len(flat))
        length[seen] = np.linalg.norm(
            flat[seen, :, :2] - np.roll(flat[seen, :, :2], 1, axis=1), axis=2
        ).max(axis=1)
        long = ~seen | (camera.has_distortion & (length > _LONGEST_EDGE_PX))
        ready = seen & (~long | (cut == _MOST_CUTS))
        done.append(flat[ready])
        done_kinds.append(kind[ready])
        whole, kind = whole[long & ~ready], kind[long & ~ready]
        in_front = _may_be_seen(camera, whole)
        whole, kind = _quartered(whole[in_front]), np.repeat(kind[in_front], 4)
    return np.concatenate(done), np.concatenate(done_kinds)


def _project(
    camera: Camera, corners_world: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return which triangles have an image, and it: (T, 3, 3) x, y, depth."""
    from hybridve.calib.lens import project_points  # late: pycolmap takes a quarter of a second

    pixels, depths_m = project_points(camera, corners_world.reshape(-1, 3))
    flat = np.column_stack([pixels, depths_m]).reshape(-1, 3, 3)
    seen = np.isfinite(flat).all(axis=(1, 2)) & (flat[..., 2] > 0).all(axis=1)
    return np.asarray(seen), flat


def _may_be_seen(camera: Camera, corners_world: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which triangles (T, 3, 3) reach in front of the camera."""
    depths = corners_world @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]
    return np.asarray((depths > 0).any(axis=1))


def _quartered(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cut triangles (T, 3, 3) at the middles of their edges, (4 T, 3, 3), each's four together."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
    stacked = np.stack([np.stack(part, axis=1) for part in parts], axis=1)  # (T, 4, 3, 3)
    return stacked.reshape(-1, 3, 3)


def _rasterised(
    device: moderngl.Context,
    camera: Camera,
    triangles: NDArray[np.float64],
    kinds: NDArray[np.float64],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return of the nearest triangle in each pixel, (2 H, 2 W): kind, brightness, edge, depth."""
    size = (camera.width_px, camera.height_px)
    twice = (2 * size[0], 2 * size[1])
    program = device.program(
        vertex_shader=load_shader("overlay.vert.glsl"),
        fragment_shader=load_shader("overlay.frag.glsl"),
    )
    packed = np.zeros((len(triangles), 3, 4), np.float32)
    packed[..., :3] = triangles
    packed[..., 3] = kinds[:, None]
    buffer = device.buffer(packed.tobytes())
    array = device.vertex_array(program, [(buffer, "3f 1f", "place", "kind")])
    texture = device.texture(twice, 4, dtype="f4")
    depth = device.depth_renderbuffer(twice)
    target = device.framebuffer([texture], depth)
    depths = triangles[..., 2]
    set_uniforms(
        program,
        size_px=size,
        range_m=(float(depths.min()), float(depths.max()) * (1 + 1e-6) + 1e-6),
        focal_px=float(camera.pinhole[0, 0]),
    )
    clear_all(target, (0.0, 0.0, NEVER_M, 0.0))
    device.enable(moderngl.DEPTH_TEST)
    array.render(moderngl.TRIANGLES)
    device.disable(moderngl.DEPTH_TEST)
    drawn = np.frombuffer(texture.read(), np.float32).reshape(twice[1], twice[0], 4)
    kind, facing, distance = drawn[..., 0], drawn[..., 1], drawn[..., 2]
    edge = _edges(kind, facing, distance)
    return kind, facing, edge, distance


def _edges(
    kind: NDArray[np.float32], facing: NDArray[np.float32], distance: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return 1 where the drawn surface breaks off or bends, else 0."""
    edge = np.zeros(kind.shape, np.bool_)
    log_distance = np.log(np.minimum(distance, np.float32(1e6)))
    for axis in (0, 1):
        broken = np.abs(np.diff(log_distance, axis=axis)) > 0.02
        bent = np.abs(np.diff(facing, axis=axis)) > 0.12
        ends = np.diff((kind > 0).astype(np.int8), axis=axis) != 0
        here = broken | bent | ends
        first = [slice(None)] * 2
        last = [slice(None)] * 2
        first[axis], last[axis] = slice(None, -1), slice(1, None)
        edge[tuple(first)] |= here
        edge[tuple(last)] |= here
    return (edge & (kind > 0)).astype(np.float32)


def _blended(
    image: Image,
    kind: NDArray[np.float32],
    facing: NDArray[np.float32],
    edge: NDArray[np.float32],
    hidden: NDArray[np.bool_],
) -> Image:
    """Lay the surfaces, drawn at twice the size, over the image; faintly where they are hidden."""
    height, width = image.shape[:2]
    paint = np.zeros((*kind.shape, 3), np.float32)
    cover = np.zeros(kind.shape, np.float32)
    for value, rgb in _COLOURS.items():
        chosen = kind == value
        paint[chosen] = np.array(bgr(rgb), np.float32)
        cover[chosen] = 1 - _SEEN_THROUGH[value]
    paint *= (0.40 + 0.60 * facing)[..., None]
    paint[edge > 0] *= 0.35
    cover[edge > 0] = np.maximum(cover[edge > 0], 0.8)
    cover[hidden] *= _HIDDEN
    # Colours are weighted by their cover before they are averaged down.
    size = (width, height)
    added = cv2.resize(paint * cover[..., None], size, interpolation=cv2.INTER_AREA)
    kept = 1 - cv2.resize(cover, size, interpolation=cv2.INTER_AREA)
    blended = image * kept[..., None] + added
    return np.asarray(np.clip(np.rint(blended), 0, 255), np.uint8)


def _name(image: Image, name: str, scale: float) -> None:
    """Write the camera's name into the upper left corner."""
    size = 0.6 * max(scale, 0.6)
    width, above, below = text_size(name, size, bold=True)
    pad = round(6 * scale)
    plate(image, (0, 0, width + 2 * pad, above + below + 2 * pad), 0.75)
    put_text(image, name, (pad, above + pad), size, bold=True)
