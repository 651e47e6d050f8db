"""The hull from any viewpoint: its first visible surface, as depth and normal of every pixel.

Section 3.2 of Lok, Naik, Whitton and Brooks (2003): the frustum of a new view is queried against
the hull. Here the rays of the new view walk through the silhouettes on the graphics device, as far
at a time as the distance to the nearest object pixel allows (``shaders/novel.frag.glsl``).

The novel view is a pinhole camera, or a parallel one, that looks along `forward`; `depth` is
measured along it, so that it compares with the depth of anything else that is drawn.
"""

from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import BACKGROUND, Hull
from hybridve.hull.view.cells import Cells, hull_cells

#: By how many pixels of a camera the device may find the surface too late; novel.frag.glsl.
OVERSHOOT_PX = 2e-3

#: Depth of a ray that misses the hull, as the device writes it.
NEVER_M = 3.0e38

#: Width of the blur from which surface normals come, in pixels of the silhouette: a staircase of
#: pixels at any slope is level at this scale, and a finger is not yet lost.
_SOFT_SIGMA_PX = 2.5

#: Added to the distances of pixels that were not recorded; UNRECORDED in hull.common.glsl.
_UNRECORDED = np.uint8(128)

#: Margin around a silhouette's bounding box, in pixels, so that its blur fades out.
_MARGIN_PX = 10


@dataclass(frozen=True, slots=True, eq=False)
class NovelView:
    """A camera that nobody placed.

    Attributes
    ----------
    eye_world : (3,) float64
        Where it stands, in metres; parallel: the middle of its picture plane.
    right, down, forward : (3,) float64
        Its axes, unit vectors in the world.
    half_extent : (2,) float64
        From the middle of the picture to its right and lower border: tangents, or metres if
        parallel.
    range_m : tuple of float
        The nearest and farthest depth drawn; the nearest is positive unless parallel.
    parallel : bool
        Whether all rays are parallel.
    middle : (2,) float64
        Where the middle of the picture lies off `forward`, along right and down, as tangents: a
        camera's principal point is not quite in the middle of its image.
    skew : float
        How far right, as a tangent, the lower border lies of the middle.
    """

    eye_world: NDArray[np.float64]
    right: NDArray[np.float64]
    down: NDArray[np.float64]
    forward: NDArray[np.float64]
    half_extent: NDArray[np.float64]
    range_m: tuple[float, float]
    parallel: bool = False
    middle: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    skew: float = 0.0

    @property
    def ray_axes(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """What a ray is made of: to the picture's right border, to its lower one, to its middle.

        A ray through (x, y), which run from -1 to 1 across the picture, is ``x right + y down +
        middle``, a metre deep.
        """
        right, down = self.right * self.half_extent[0], self.down * self.half_extent[1]
        middle = self.forward + self.middle[0] * self.right + self.middle[1] * self.down
        return right, down + self.skew * self.right, middle

    def places(self, points_view: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where points (N, 3) of `view_points` appear, (N, 2) from -1 to 1.

        They must not be as deep as the eye, unless the view is parallel.
        """
        away = 1.0 if self.parallel else points_view[:, 2:]
        across = points_view[:, :2] / away - self.middle
        down = across[:, 1] / self.half_extent[1]
        return np.stack([(across[:, 0] - self.skew * down) / self.half_extent[0], down], axis=1)

    def view_points(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points (N, 3) along right, down and forward of the eye, in metres."""
        return (points_world - self.eye_world) @ np.stack([self.right, self.down, self.forward]).T

    def pixels(
        self, points_world: NDArray[np.float64], size_px: tuple[int, int]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return where points (N, 3) appear and how deep they lie.

        Pixels are (N, 2), NaN where a point is nearer than the nearest depth; depths (N,) metres.
        """
        points_view = self.view_points(points_world)
        depth_m = points_view[:, 2]
        pixels = np.full((len(points_world), 2), np.nan)
        in_front = depth_m >= self.range_m[0]
        pixels[in_front] = (self.places(points_view[in_front]) + 1.0) / 2.0 * size_px
        return pixels, depth_m

    def clip_from_local(self, origin_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return OpenGL's (4, 4) clip coordinates from metres about an origin; rows run down."""
        near, far = self.range_m
        view_from_local = np.eye(4)
        view_from_local[:3, :3] = np.stack([self.right, self.down, self.forward])
        view_from_local[:3, 3] = self.view_points(origin_world[None])[0]
        clip_from_view = np.zeros((4, 4))
        half, (middle_x, middle_y) = self.half_extent, self.middle
        clip_from_view[1, 1:3] = np.array([1.0, -middle_y]) / half[1]
        clip_from_view[0, :3] = (
            np.array([1.0, 0.0, -middle_x]) - self.skew * clip_from_view[1, :3]
        ) / half[0]
        if self.parallel:
            clip_from_view[2, 2:] = np.array([2.0, -(far + near)]) / (far - near)
            clip_from_view[3, 3] = 1.0
        else:
            clip_from_view[2, 2:] = np.array([far + near, -2.0 * far * near]) / (far - near)
            clip_from_view[3, 2] = 1.0
        return clip_from_view @ view_from_local

    def rays(
        self, pixels: NDArray[np.float64], size_px: tuple[int, int]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return origins and directions (N, 3) of the rays through pixels (N, 2), pixel centre 0.5.

        A point of a ray is ``origin + depth * direction``.
        """
        place = 2.0 * pixels / size_px - 1.0
        right, down, middle = self.ray_axes
        across = place[:, :1] * right + place[:, 1:] * down
        if self.parallel:
            return self.eye_world + across, np.broadcast_to(middle, across.shape).copy()
        return np.broadcast_to(self.eye_world, across.shape).copy(), middle + across


def first_surface(
    hull: Hull,
    origins_world: NDArray[np.float64],
    directions: NDArray[np.float64],
    range_m: tuple[float, float],
    step_m: float,
) -> NDArray[np.float64]:
    """Return where rays first enter the hull: the specification, float64 NumPy.

    Plain rather than fast: samples `step_m` apart, then bisection. What is thinner than a step
    along a ray can be missed.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    origins_world, directions : (N, 3) float64
        Rays; a point is ``origin + depth * direction``.
    range_m : tuple of float
        The depths between which to look.
    step_m : float
        Distance of samples, in depth.

    Returns
    -------
    (N,) float64
        Depth; NaN for a ray that misses.
    """
    depths = np.arange(range_m[0], range_m[1], step_m)
    points = origins_world[:, None] + depths[:, None] * directions[:, None]  # (N, D, 3)
    inside = contains_points(hull, points.reshape(-1, 3)).reshape(points.shape[:2])
    hits = inside.any(axis=1)
    first = inside.argmax(axis=1)
    high = depths[first]
    low = np.where(first > 0, high - step_m, high)
    for _ in range(40):
        middle = (low + high) / 2
        within = contains_points(hull, origins_world + middle[:, None] * directions)
        high = np.where(within, middle, high)
        low = np.where(within, low, middle)
    return np.where(hits, high, np.nan)


@cache
def load_shader(name: str) -> str:
    """Return the source of a shader in ``hull/view/shaders``, its insertions made."""
    folder = files("hybridve.hull.view") / "shaders"
    source = (folder / name).read_text(encoding="utf-8")
    if "// INSERT\n" in source:
        common = (folder / "hull.common.glsl").read_text(encoding="utf-8")
        source = source.replace("// INSERT\n", common)
    return source


def set_uniforms(program: moderngl.Program, **values: object) -> None:
    """Set uniforms by name; one that the compiler dropped because nothing depends on it is fine."""
    for name, value in values.items():
        if name in program:
            program[name] = value


def clear_all(
    target: moderngl.Framebuffer,
    values: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
) -> None:
    """Clear all of a target, whatever rectangle was drawn in before, in this target or another."""
    target.use()
    target.scissor = (0, 0, *target.size)
    target.clear(*values, depth=1.0)


#: What a target of depths is cleared with.
NOTHING = (NEVER_M, 0.0, 0.0, 0.0)


def draw_within(
    target: moderngl.Framebuffer,
    rectangle: tuple[int, int, int, int],
    triangle: moderngl.VertexArray,
) -> None:
    """Run a program of `full_screen` for the pixels of a rectangle: left, top, width, height."""
    target.use()
    target.scissor = rectangle
    triangle.render(moderngl.TRIANGLES, vertices=3)
    target.scissor = (0, 0, *target.size)


def full_screen(
    device: moderngl.Context, shader: str
) -> tuple[moderngl.Program, moderngl.VertexArray]:
    """Return a program that runs once for each pixel, and what to draw to run it."""
    program = device.program(
        vertex_shader=load_shader("full.vert.glsl"), fragment_shader=load_shader(shader)
    )
    return program, device.vertex_array(program, [])


class HullOnDevice:
    """The silhouettes of one frame in graphics memory, and the rays that walk through them.

    Its memory is given back by the owner's ``device.gc()`` once it is dropped, as that of all that
    is made in `hybridve.hull.view`.

    Attributes
    ----------
    cells : Cells
        Where the hull is.
    regions : list of (first, size, matrix)
        What of each camera's image is held: its first pixel (2,), its width and height, and the
        projection (3, 4) into its pixels from metres in the local frame. Empty if nothing is
        inside.
    """

    def __init__(
        self,
        device: moderngl.Context,
        march: tuple[moderngl.Program, moderngl.VertexArray],
        hull: Hull,
        cells: Cells | None = None,
    ) -> None:
        self._device = device
        self._program, self._triangle = march
        self._views = hull.views
        self.cells = hull_cells(hull) if cells is None else cells
        regions = [_region(hull, camera, self.cells) for camera in range(len(hull.views))]
        # Without any object pixel in a camera that carves, nothing is inside.
        self._n_cameras = 0 if len(self.cells) == 0 or None in regions else len(regions)
        self._upload(hull, [region for region in regions if region is not None])

    def _upload(self, hull: Hull, regions: list["_Region"]) -> None:
        if self._n_cameras == 0:
            regions = []
        width = max((region.distance.shape[1] for region in regions), default=1)
        height = max((region.distance.shape[0] for region in regions), default=1)
        n_layers = max(1, len(regions))
        cameras = np.zeros((n_layers, 4, 4), np.float64)
        self.regions: list[tuple[NDArray[np.int64], tuple[int, int], NDArray[np.float64]]] = []
        size = (width, height, n_layers)
        self._distances = self._device.texture_array(size, 1, alignment=1, dtype="u1")
        self._distances.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._soft = self._device.texture_array(size, 1, alignment=1, dtype="f1")
        self._soft.repeat_x = self._soft.repeat_y = False
        for camera, region in enumerate(regions):
            cameras[camera, :3] = hull.views.img_from_local[camera]
            # Pixels of the region: the camera's, less the region's first pixel.
            cameras[camera, :2] -= region.first[:, None] * cameras[camera, 2]
            cameras[camera, 3] = region.window
            rows, columns = region.distance.shape
            self.regions.append((region.first, (columns, rows), cameras[camera, :3].copy()))
            place = (0, 0, camera, columns, rows, 1)
            self._distances.write(region.distance, viewport=place)
            self._soft.write(region.soft, viewport=place)
        self._cameras = self._device.buffer(cameras.astype(np.float32).tobytes())

    def bind(self, program: moderngl.Program) -> None:
        """Make the hull what `program` asks (``hull.common.glsl``)."""
        low, high = self.cells.box_local()
        self._distances.use(0)
        self._soft.use(1)
        self._cameras.bind_to_storage_buffer(0)
        set_uniforms(
            program,
            n_cameras=self._n_cameras,
            keeps=self._views.unseen == "keep",
            has_gaps=self._views.seen is not None,
            min_cameras=self._views.min_cameras,
            box_low=tuple(low),
            box_high=tuple(high),
        )

    def draw(self, target: moderngl.Framebuffer, view: NovelView, size_px: tuple[int, int]) -> None:
        """Write depth and normal of the hull's first surface into `target`, `size_px` large."""
        clear_all(target, NOTHING)
        scissor = self.rectangle(view, size_px)
        if scissor is None:
            return
        self.bind(self._program)
        set_uniforms(
            self._program,
            **view_uniforms(view, self._views.origin_world),
            size_px=size_px,
        )
        draw_within(target, scissor, self._triangle)

    def rectangle(
        self, view: NovelView, size_px: tuple[int, int]
    ) -> tuple[int, int, int, int] | None:
        """Return where in the picture the hull can be: left, top, width, height; None for none."""
        if self._n_cameras == 0:
            return None
        low, high = self.cells.box_local()
        corners = np.array([[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)])
        pixels, _ = view.pixels(corners + self._views.origin_world, size_px)
        if np.isnan(pixels).any():  # the box reaches behind the eye
            return (0, 0, *size_px)
        first = np.clip(np.floor(pixels.min(axis=0)), 0, size_px).astype(int)
        last = np.clip(np.ceil(pixels.max(axis=0)), 0, size_px).astype(int)
        width, height = last - first
        if width <= 0 or height <= 0:
            return None
        return int(first[0]), int(first[1]), int(width), int(height)


def view_uniforms(view: NovelView, origin_world: NDArray[np.float64]) -> dict[str, object]:
    """Return a view as ``novel.frag.glsl`` and ``compose.frag.glsl`` take it."""
    right, down, middle = view.ray_axes
    return {
        "eye": tuple(view.eye_world - origin_world),
        "right": tuple(right),
        "down": tuple(down),
        "forward": tuple(middle),
        "parallel": view.parallel,
        "range_m": view.range_m,
    }


def hull_depth(
    device: moderngl.Context, hull: Hull, view: NovelView, size_px: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the hull's first visible surface from a novel viewpoint.

    Parameters
    ----------
    device : moderngl.Context
        From `hybridve.hull.query.device.open_device`.
    hull : Hull
        The visual hull of one frame.
    view : NovelView
        From where to look.
    size_px : tuple of int
        Width and height of the picture.

    Returns
    -------
    depth_m : (H, W) float64
        Along `view.forward`; NaN where the hull is not.
    normals : (H, W, 3) float64
        Outward unit vectors in the world; 0 where the hull is not.
    """
    march = full_screen(device, "novel.frag.glsl")
    depth = device.texture(size_px, 1, dtype="f4")
    normal = device.texture(size_px, 4, dtype="f4")
    target = device.framebuffer([depth, normal])
    HullOnDevice(device, march, hull).draw(target, view, size_px)
    width, height = size_px
    depth_m = np.frombuffer(depth.read(), np.float32).reshape(height, width)
    normals = np.frombuffer(normal.read(), np.float32).reshape(height, width, 4)
    hit = depth_m < NEVER_M / 2
    return (
        np.where(hit, depth_m, np.nan).astype(np.float64),
        np.where(hit[..., None], normals[..., :3], 0.0).astype(np.float64),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Region:
    """The part of a camera's image that matters: distances, blur, first pixel, window."""

    distance: NDArray[np.uint8]
    soft: NDArray[np.uint8]
    first: NDArray[np.int64]
    window: NDArray[np.int64]


def _region(hull: Hull, camera: int, cells: Cells) -> _Region | None:
    """Return a camera's region; None where it carves everything.

    What of its silhouette is beside all cells has no part in the hull.
    """
    mask = hull.mask(camera)
    if hull.views.unseen == "keep":
        # Beyond the border the camera abstains: a ray may become free there.
        background = np.equal(hull.answers(camera), BACKGROUND).view(np.uint8)
        distance = np.ascontiguousarray(_distance(np.pad(background, 1))[1:-1, 1:-1])
        if hull.views.seen is not None:
            distance = np.minimum(distance, _UNRECORDED - 1)
        seen = hull.views.seen_mask(camera)
        if seen is not None:
            to_seen = np.minimum(_distance(1 - seen), _UNRECORDED - 1)
            distance = np.where(seen, distance, to_seen + _UNRECORDED)
        height, width = mask.shape
        window = np.array([0, 0, width, height])
        return _Region(distance, _blurred(mask), np.zeros(2, np.int64), window)
    x, y, width, height = cv2.boundingRect(mask)
    low, high = np.array([x, y]), np.array([x + width, y + height])
    around = _pixels_of_cells(hull, camera, cells)
    if around is not None:
        low, high = np.maximum(low, around[0]), np.minimum(high, around[1])
    if (low >= high).any():
        return None
    # With what of the silhouette lies right beside the window, or its border would be an edge.
    first, last = np.maximum(low - _MARGIN_PX, 0), np.minimum(high + _MARGIN_PX, mask.shape[::-1])
    beside = np.stack([first - (low - _MARGIN_PX), high + _MARGIN_PX - last], axis=1)
    part = np.pad(mask[first[1] : last[1], first[0] : last[0]], beside[::-1])
    # Where the window lies in the region, and the region in the image.
    window = np.concatenate([np.zeros(2, np.int64), high - low]) + _MARGIN_PX
    return _Region(_distance(1 - part), _blurred(part), low - _MARGIN_PX, window)


def _pixels_of_cells(
    hull: Hull, camera: int, cells: Cells
) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """Return where a camera sees the box of the cells: the first pixel, the one after the last.

    None where the box reaches behind the camera.
    """
    low, high = cells.box_local()
    corners = np.array([[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)])
    matrix = hull.views.img_from_local[camera]
    projected = corners @ matrix[:, :3].T + matrix[:, 3]
    if (projected[:, 2] <= 1e-6 * np.abs(corners).max()).any():
        return None
    pixels = projected[:, :2] / projected[:, 2:]
    limit = 1e6
    first = np.floor(np.clip(pixels.min(axis=0), -limit, limit)).astype(np.int64)
    last = np.ceil(np.clip(pixels.max(axis=0), -limit, limit)).astype(np.int64)
    return first - 1, last + 1


def _distance(background: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return distances to the nearest pixel that is 0, rounded down, at most 255."""
    distance = cv2.distanceTransform(background, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.minimum(distance, 255.0).astype(np.uint8)


def _blurred(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a mask of 0 and 1 as 0 to 255 with soft edges."""
    return np.asarray(cv2.GaussianBlur(mask * np.uint8(255), (0, 0), _SOFT_SIGMA_PX), np.uint8)
