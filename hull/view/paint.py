"""The scene on the graphics device: hull, objects, cameras, floor; no text.

Drawn in layers at twice the picture's size in each direction, put together by
``shaders/compose.frag.glsl``, and averaged down.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.rig import Rig
from hybridve.hull.query.device import make_current, open_device
from hybridve.hull.query.engine import Closing
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.view.cells import Cells
from hybridve.hull.view.drawn import DrawnObject, Marks, Measure, thinned
from hybridve.hull.view.novel import (
    NEVER_M,
    NOTHING,
    HullOnDevice,
    NovelView,
    clear_all,
    draw_within,
    full_screen,
    load_shader,
    set_uniforms,
    view_uniforms,
)
from hybridve.hull.view.skin import SkinOnDevice
from hybridve.hull.view.strokes import Colour, Strokes

Image = NDArray[np.uint8]
Rgb = tuple[float, float, float]

#: How fine what the cameras see of the hull is looked at, in pixels of theirs for one drawn.
_DEPTHS_PER_PX = 0.5

#: Pixels drawn for one pixel of the picture, in each direction.
_SAMPLES = 2

# Kinds of surface, the same in mesh.frag.glsl and overlay.frag.glsl.
FREE, COLLIDING, TOUCHED = 1.0, 2.0, 3.0

#: Added to the kind of a triangle that no lamp reaches; of one that is reached in part, less.
DARKEST = 0.4

HULL_RGB: Rgb = (0.86, 0.79, 0.70)
FREE_RGB: Rgb = (0.56, 0.66, 0.77)
COLLIDING_RGB: Rgb = (0.93, 0.79, 0.76)
TOUCHED_RGB: Rgb = (0.93, 0.53, 0.47)
INSIDE_RGB: Rgb = (0.86, 0.03, 0.07)
POINT_RGB: Rgb = (0.42, 0.0, 0.02)
MARK_RGB: Rgb = (0.10, 0.42, 0.62)
PATH_RGB: Rgb = (0.85, 0.45, 0.05)
CAMERA_RGB: Rgb = (0.22, 0.27, 0.34)
MEASURE_RGB: Rgb = (0.02, 0.05, 0.45)
#: Colours of the heat, from far to near: told apart by the colour-blind by their brightness.
HEAT_RGB: tuple[Rgb, ...] = (
    (0.62, 0.68, 0.76),
    (0.55, 0.76, 0.80),
    (0.78, 0.86, 0.55),
    (0.98, 0.82, 0.25),
    (0.95, 0.48, 0.13),
    (0.72, 0.04, 0.15),
)
AXIS_RGB: tuple[Rgb, Rgb, Rgb] = ((0.84, 0.39, 0.33), (0.27, 0.62, 0.34), (0.25, 0.42, 0.80))

#: Dots of collision points: radius, and the distance below which one stands for all, in pixels of
#: a picture 1000 high.
_POINT_RADIUS_PX, _POINT_SPACING_PX = 1.5, 7.0

#: Dots and ways of a simulation: radius, width, and length of an arrow's head, in such pixels, and
#: the sine below which an arrow points along the line of sight.
_MARK_RADIUS_PX, _PATH_WIDTH_PX, _HEAD_PX, _END_ON = 1.6, 3.0, 20.0, 0.05

#: A camera is drawn this long, as a share of its distance from the middle of the scene, and of the
#: distance to the next camera.
_CAMERA_LENGTH, _CAMERA_CROWDING = 0.10, 0.45

#: Half the angle of the widest lens drawn, as a tangent.
_WIDEST_TANGENT = 1.2

#: Sizes of which layers are kept: a picture's, its small one's, the floor's.
_MOST_LAYERS = 3

#: Side of the floor's shadow, in texels.
_SHADE_PX = 256


@dataclass(frozen=True, slots=True, eq=False)
class Floor:
    """The plane that the grid lies in.

    Attributes
    ----------
    up, along_x, along_y : (3,) float64
        World axes: off the plane, and the two in it.
    height_m : float
        Of the plane above the world's origin.
    grid_m : float
        Distance of the grid's lines; one runs through the world's origin or below it.
    low_m, high_m : (2,) float64
        What of the plane lies under the scene, along its two axes.
    """

    up: NDArray[np.float64]
    along_x: NDArray[np.float64]
    along_y: NDArray[np.float64]
    height_m: float
    grid_m: float
    low_m: NDArray[np.float64]
    high_m: NDArray[np.float64]

    def points_world(self, places_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the points (N, 3) of the plane at places (N, 2)."""
        return (
            places_m[:, :1] * self.along_x
            + places_m[:, 1:] * self.along_y
            + self.height_m * self.up
        )


def floor_under(points_world: NDArray[np.float64], up: NDArray[np.float64]) -> Floor:
    """Return the floor of a scene of points (N, 3).

    The plane through the world's origin, where a board on the floor puts it; under the scene where
    the scene lies far off that plane.
    """
    axis = int(np.abs(up).argmax())
    up = np.eye(3)[axis] * np.sign(up[axis])
    along_x, along_y = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
    if len(points_world) == 0:
        points_world = np.zeros((1, 3))
    heights = points_world @ up
    lowest, tallness = float(heights.min()), float(np.ptp(heights))
    stands_on_origin = -0.15 * tallness <= lowest <= 1.0 * tallness
    places = np.stack([points_world @ along_x, points_world @ along_y], axis=1)
    low, high = places.min(axis=0), places.max(axis=0)
    extent_m = max(float((high - low).max()), tallness, 1e-6)
    return Floor(
        up,
        along_x,
        along_y,
        0.0 if stands_on_origin else lowest,
        round_length(extent_m / 4),
        low - 0.5 * extent_m,
        high + 0.5 * extent_m,
    )


def round_length(length_m: float) -> float:
    """Return the length of the series 1, 2, 5, 10 that is nearest below; 0.1 m of nothing.

    Examples
    --------
    >>> round_length(0.7), round_length(3.0), round_length(0.02)
    (0.5, 2.0, 0.02)
    """
    if not length_m > 0:
        return 0.1
    power = 10.0 ** np.floor(np.log10(length_m) + 1e-9)
    steps = [step for step in (1.0, 2.0, 5.0) if step * power <= length_m * (1 + 1e-9)]
    return float(steps[-1] * power) if steps else float(power)


def camera_length_m(rig: Rig, middle_world: NDArray[np.float64]) -> float:
    """Return how long cameras are drawn, so that they are seen and do not run into each other."""
    centers = rig.centers_world
    length_m = _CAMERA_LENGTH * float(np.median(np.linalg.norm(centers - middle_world, axis=1)))
    apart = np.linalg.norm(centers[:, None] - centers, axis=2)[~np.eye(len(centers), dtype=bool)]
    apart = apart[apart > 0]
    if len(apart):
        length_m = min(length_m, _CAMERA_CROWDING * float(np.quantile(apart, 0.1)))
    return max(length_m, 1e-6)


def camera_corners(camera: Camera, length_m: float) -> NDArray[np.float64]:
    """Return the corners (4, 3) of the image that a camera is drawn with, in the world."""
    width, height = camera.width_px, camera.height_px
    corners = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], np.float64)
    rays = np.linalg.solve(camera.pinhole, corners.T).T
    rays[:, :2] = np.clip(rays[:, :2], -_WIDEST_TANGENT, _WIDEST_TANGENT)
    rays *= length_m / np.linalg.norm(rays, axis=1).max()
    rotation, translation = camera.cam_from_world[:, :3], camera.cam_from_world[:, 3]
    return np.asarray((rays - translation) @ rotation)


@dataclass(frozen=True, slots=True, eq=False)
class PaintedScene:
    """All that is drawn of one frame.

    Attributes
    ----------
    hull, cells, objects
        The frame.
    cameras : tuple of Camera
        The cameras that are drawn.
    camera_m : float
        How long they are drawn.
    floor : Floor
        The plane of the grid.
    marks : Marks
        What is drawn over it.
    images : sequence of C (H, W, 3) uint8 or None
        What the hull's cameras recorded, as pinhole images, BGR: the hull has their colours. Empty
        for a hull of plain colour.
    backdrop : (H, W, 3) uint8, or None
        The whole scene is drawn over this picture, which has the hull in it already, BGR.
    """

    hull: Hull
    cells: Cells
    objects: list[DrawnObject]
    cameras: tuple[Camera, ...]
    camera_m: float
    floor: Floor
    marks: Marks = field(default_factory=Marks)
    images: Sequence[Image | None] = ()
    backdrop: Image | None = None


class Painter(Closing):
    """Draws scenes; keeps what is compiled from one picture to the next.

    The context belongs to the thread that opened it.

    Parameters
    ----------
    device : moderngl.Context, optional
        What to draw with; its own by default.
    samples : int
        Pixels drawn for one pixel of the picture, in each direction; 1 is quicker.
    """

    def __init__(self, device: moderngl.Context | None = None, samples: int = _SAMPLES) -> None:
        self._samples = samples
        self._owned = device is None
        self._device = open_device() if device is None else device
        self._march = full_screen(self._device, "novel.frag.glsl")
        self._smooth = full_screen(self._device, "smooth.frag.glsl")
        self._compose = full_screen(self._device, "compose.frag.glsl")
        self._skin = full_screen(self._device, "skin.frag.glsl")
        self._mesh = self._device.program(
            vertex_shader=load_shader("mesh.vert.glsl"),
            fragment_shader=load_shader("mesh.frag.glsl"),
        )
        self._layers: dict[tuple[int, int], _Layers] = {}
        self._stroke = self._device.program(
            vertex_shader=load_shader("stroke.vert.glsl"),
            fragment_shader=load_shader("stroke.frag.glsl"),
        )

    @property
    def device(self) -> moderngl.Context:
        """The context that is drawn with."""
        return self._device

    def close(self) -> None:
        """Release the device if it was opened here, and all on it."""
        self._layers.clear()
        self._device.gc()
        if self._owned:
            self._device.release()

    def paint(self, scene: PaintedScene, view: NovelView, size_px: tuple[int, int]) -> Image:
        """Return the scene as seen by `view`, (H, W, 3) BGR."""
        make_current(self._device)
        try:
            samples = self._samples
            picture = self._paint(scene, view, (size_px[0] * samples, size_px[1] * samples))
        finally:
            self._device.gc()
        small = cv2.resize(picture, size_px, interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.cvtColor(small, cv2.COLOR_RGBA2BGR), np.uint8)

    def depth(
        self, hull: Hull, view: NovelView, size_px: tuple[int, int], cells: Cells | None = None
    ) -> NDArray[np.float32]:
        """Return how deep the hull is in each pixel (H, W) of a view, metres; inf for nothing."""
        make_current(self._device)
        try:
            depth = self._device.texture(size_px, 1, dtype="f4")
            normal = self._device.texture(size_px, 4, dtype="f2")
            target = self._device.framebuffer([depth, normal])
            HullOnDevice(self._device, self._march, hull, cells).draw(target, view, size_px)
            found = np.frombuffer(depth.read(), np.float32).reshape(size_px[1], size_px[0])
        finally:
            self._device.gc()
        return np.asarray(np.where(found < NEVER_M / 2, found, np.inf), np.float32)

    def _paint(self, scene: PaintedScene, view: NovelView, size_px: tuple[int, int]) -> Image:
        """Return the scene before it is averaged down, (H, W, 4) RGBA."""
        layers = self._layers_of(size_px)
        hull = HullOnDevice(self._device, self._march, scene.hull, scene.cells)
        meshes = self._upload_meshes(scene)
        hull.draw(layers.hull, view, size_px)
        self._smooth_normals(layers, hull, view, size_px)
        if len(scene.images) and scene.backdrop is None:
            per_px = _DEPTHS_PER_PX * self._samples
            skin = SkinOnDevice(self._device, scene.hull, hull, scene.images, per_px)
            sources = (layers.hull_depth, layers.hull_normal)
            skin.draw(layers.skinned, self._skin, sources, view, size_px)
        self._draw_meshes(layers.mesh, meshes, hull, scene, view, inside_only=False)
        self._draw_meshes(layers.hits, meshes, hull, scene, view, inside_only=True)
        shade = self._floor_shade(scene, hull, meshes)
        layers.use()
        shade.use(8)
        layers.skin.use(9)
        if scene.backdrop is not None:
            self._backdrop(scene.backdrop, size_px).use(10)
        self._compose_layers(layers, scene, view, size_px)
        self._draw_strokes(layers, self._strokes(scene, view, size_px))
        return np.frombuffer(layers.picture.read(), np.uint8).reshape(size_px[1], size_px[0], 4)

    def _backdrop(self, image: Image, size_px: tuple[int, int]) -> moderngl.Texture:
        fine = cv2.resize(image, size_px, interpolation=cv2.INTER_LINEAR)
        rgb = np.ascontiguousarray(fine[..., ::-1])
        return self._device.texture(size_px, 3, rgb.tobytes(), alignment=1)

    def _layers_of(self, size_px: tuple[int, int]) -> "_Layers":
        """Return the layers of a size; kept, since the next picture is likely as large."""
        if size_px not in self._layers:
            if len(self._layers) >= _MOST_LAYERS:
                self._layers.clear()
            self._layers[size_px] = _Layers(self._device, size_px)
        return self._layers[size_px]

    def _upload_meshes(self, scene: PaintedScene) -> moderngl.VertexArray | None:
        """Upload all triangles; None if there is none."""
        parts = [np.zeros((0, 5), np.float32)]
        for item in scene.objects:
            part = np.zeros((len(item.faces), 3, 5), np.float32)
            part[..., 4] = -1.0 if item.warmth is None else item.warmth[item.faces]
            part[..., :3] = item.corners_world - scene.hull.views.origin_world
            part[..., 3] = COLLIDING if item.collides else FREE
            if item.collides:
                part[item.hit_triangles, :, 3] = TOUCHED
            if item.share_lit is not None:
                part[..., 3] += DARKEST * (1.0 - np.clip(item.share_lit, 0.0, 1.0))[:, None]
            parts.append(part.reshape(-1, 5))
        vertices = np.concatenate(parts)
        if len(vertices) == 0:
            return None
        buffer = self._device.buffer(vertices.tobytes())
        return self._device.vertex_array(
            self._mesh, [(buffer, "3f 1f 1f", "point", "kind", "warmth")]
        )

    def _draw_meshes(
        self,
        target: moderngl.Framebuffer,
        meshes: moderngl.VertexArray | None,
        hull: HullOnDevice,
        scene: PaintedScene,
        view: NovelView,
        *,
        inside_only: bool,
    ) -> None:
        clear_all(target, NOTHING)
        if meshes is None or (inside_only and not any(item.collides for item in scene.objects)):
            return
        origin = scene.hull.views.origin_world
        hull.bind(self._mesh)
        matrix = view.clip_from_local(origin)
        set_uniforms(
            self._mesh,
            clip_from_local=tuple(matrix.T.ravel()),  # column-major
            inside_only=inside_only,
            eye=tuple(view.eye_world - origin),
            forward=tuple(view.forward),
            parallel=view.parallel,
        )
        self._device.enable(moderngl.DEPTH_TEST)
        meshes.render(moderngl.TRIANGLES)
        self._device.disable(moderngl.DEPTH_TEST)

    def _smooth_normals(
        self, layers: "_Layers", hull: HullOnDevice, view: NovelView, size_px: tuple[int, int]
    ) -> None:
        program, triangle = self._smooth
        rectangle = hull.rectangle(view, size_px)
        if rectangle is None:
            return
        low, high = hull.cells.box_local()
        diagonal_m = float(np.linalg.norm(high - low))
        set_uniforms(program, sigma_px=size_px[1] / 400, step_m=0.01 * diagonal_m, reach=6)
        layers.hull_depth.use(2)
        for along, source, target in (
            ((1, 0), layers.hull_normal, layers.smoothing),
            ((0, 1), layers.smoothed, layers.normal_only),
        ):
            source.use(3)
            set_uniforms(program, along=along)
            draw_within(target, rectangle, triangle)

    def _floor_shade(
        self,
        scene: PaintedScene,
        hull: HullOnDevice,
        meshes: moderngl.VertexArray | None,
    ) -> moderngl.Texture:
        """Return how dark the floor is: by how near above it something is, blurred."""
        floor, size = scene.floor, (_SHADE_PX, _SHADE_PX)
        half = (floor.high_m - floor.low_m) / 2
        middle = floor.points_world(((floor.high_m + floor.low_m) / 2)[None])[0]
        tallness = float(half.max())
        # Seen from the floor upwards; what is nearest is what shades most.
        below_m = 0.02 * tallness
        view = NovelView(
            middle - below_m * floor.up,
            floor.along_x,
            floor.along_y,
            floor.up,
            half,
            (0.0, 4 * tallness),
            parallel=True,
        )
        layers = self._layers_of(size)
        hull.draw(layers.hull, view, size)
        self._draw_meshes(layers.mesh, meshes, hull, scene, view, inside_only=False)
        heights = np.minimum(
            np.frombuffer(layers.hull_depth.read(), np.float32),
            np.frombuffer(layers.mesh_depth.read(), np.float32),
        ).reshape(size[::-1])
        near = np.exp(-2 * np.minimum(heights, 9 * tallness) / tallness)  # next to 0 for nothing
        near = near.astype(np.float32)
        shade = 0.5 * cv2.GaussianBlur(near, (0, 0), 2.0) + 0.5 * cv2.GaussianBlur(
            near, (0, 0), 9.0
        )
        texture = self._device.texture(size, 1, shade.astype(np.float32).tobytes(), dtype="f4")
        texture.repeat_x = texture.repeat_y = False
        return texture

    def _compose_layers(
        self, layers: "_Layers", scene: PaintedScene, view: NovelView, size_px: tuple[int, int]
    ) -> None:
        program, triangle = self._compose
        origin, floor = scene.hull.views.origin_world, scene.floor
        on_floor = (view.eye_world @ floor.up) > floor.height_m
        middle = (floor.low_m + floor.high_m) / 2
        set_uniforms(
            program,
            **view_uniforms(view, origin),
            size_px=size_px,
            edge_px=float(max(1, round(size_px[1] / 1600))),
            occlusion_m=0.06 * float((floor.high_m - floor.low_m).max()) / 2,
            up=tuple(floor.up),
            floor_x=tuple(floor.along_x),
            floor_y=tuple(floor.along_y),
            floor_point=tuple(floor.points_world(np.zeros((1, 2)))[0] - origin),
            grid_m=floor.grid_m,
            floor_low=tuple(floor.low_m),
            floor_high=tuple(floor.high_m),
            floor_middle=tuple(middle),
            floor_reach_m=1.1 * float(np.linalg.norm(floor.high_m - floor.low_m)),
            has_floor=bool(on_floor) and scene.backdrop is None,
            has_skin=len(scene.images) > 0 and scene.backdrop is None,
            has_backdrop=scene.backdrop is not None,
            heat_colours=HEAT_RGB,
            hull_colour=HULL_RGB,
            free_colour=FREE_RGB,
            colliding_colour=COLLIDING_RGB,
            touched_colour=TOUCHED_RGB,
            inside_colour=INSIDE_RGB,
        )
        layers.target.use()
        layers.target.scissor = (0, 0, *size_px)
        triangle.render(moderngl.TRIANGLES, vertices=3)

    def _strokes(self, scene: PaintedScene, view: NovelView, size_px: tuple[int, int]) -> Strokes:
        """Return axes, cameras and collision points."""
        scale = size_px[1] / 1000.0
        strokes = Strokes(view, size_px)
        origin, length_m = np.zeros((1, 3)), scene.floor.grid_m
        for axis, rgb in enumerate(AXIS_RGB if scene.backdrop is None else ()):
            tip = np.eye(3)[axis][None] * length_m
            strokes.lines(origin, tip, 3.0 * scale, (*rgb, 1.0))
        for camera in scene.cameras:
            _add_camera(strokes, camera, scene.camera_m, scale)
        for item in scene.objects:
            if not item.collides or len(item.hit_points_world) == 0:
                continue
            points = np.asarray(item.hit_points_world, np.float64)
            pixels, _ = view.pixels(points, size_px)
            points, pixels = points[~np.isnan(pixels[:, 0])], pixels[~np.isnan(pixels[:, 0])]
            shown = points[thinned(pixels, _POINT_SPACING_PX * scale)]
            strokes.dots(shown, _POINT_RADIUS_PX * scale, (*POINT_RGB, 0.9), 1.0)
        strokes.dots(scene.marks.points_world, _MARK_RADIUS_PX * scale, (*MARK_RGB, 0.75), 0.1)
        for path in scene.marks.paths_world:
            _add_path(strokes, path, scene.marks.head_every, scale)
        for measure in scene.marks.measures:
            _add_measure(strokes, measure, scale)
        return strokes

    def _draw_strokes(self, layers: "_Layers", strokes: Strokes) -> None:
        vertices = strokes.vertices()
        if len(vertices) == 0:
            return
        buffer = self._device.buffer(vertices.tobytes())
        array = self._device.vertex_array(
            self._stroke,
            [(buffer, "4f 4f 2f 1f", "clip", "colour", "place", "when_hidden")],
        )
        layers.target.use()
        self._device.enable(moderngl.BLEND)
        self._device.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        array.render(moderngl.TRIANGLES)
        self._device.disable(moderngl.BLEND)


def _add_path(
    strokes: Strokes, path_world: NDArray[np.float64], head_every: int, scale: float
) -> None:
    """Add a way with arrow heads, which lie in the plane of the picture."""
    if len(path_world) < 2:
        return
    colour: Colour = (*PATH_RGB, 0.95)
    starts, ends = path_world[:-1], path_world[1:]
    strokes.lines(starts, ends, _PATH_WIDTH_PX * scale, colour, 0.35)
    steps = np.arange(len(ends) - 1, -1, -head_every)
    along = ends[steps] - starts[steps]
    length_m = np.linalg.norm(along, axis=1)
    moved = length_m > 0
    tips, along = ends[steps][moved], along[moved] / length_m[moved, None]
    _add_heads(strokes, tips, along, colour, scale)


def _add_measure(strokes: Strokes, measure: Measure, scale: float) -> None:
    """Add a line with a pale rim, seen through everything; an arrow ends in its head."""
    start, end = measure.start_world[None], measure.end_world[None]
    strokes.lines(start, end, 7.0 * scale, (1.0, 1.0, 1.0, 0.75), 0.75)
    colour: Colour = (*measure.rgb, 1.0)
    strokes.lines(start, end, _PATH_WIDTH_PX * scale, colour, 1.0)
    if measure.has_head:
        length_m = float(np.linalg.norm(end - start))
        if length_m > 0:
            _add_heads(strokes, end, (end - start) / length_m, colour, scale)
    else:
        strokes.dots(np.concatenate([start, end]), 4.0 * scale, colour, 1.0)


def _add_heads(
    strokes: Strokes,
    tips: NDArray[np.float64],
    along: NDArray[np.float64],
    colour: Colour,
    scale: float,
) -> None:
    """Add heads of arrows at tips (N, 3) along (N, 3); none where that is the line of sight."""
    view = strokes.view
    aside = np.cross(along, view.forward)
    broad = np.linalg.norm(aside, axis=1)
    seen = broad > _END_ON  # along the line of sight an arrow has no sides
    tips, along, aside = tips[seen], along[seen], aside[seen] / broad[seen, None]
    depth_m = (tips - view.eye_world) @ view.forward
    head_m = (
        _HEAD_PX * scale * 2 * view.half_extent[1] / strokes.size_px[1] * np.maximum(depth_m, 0.0)
    )[:, None]
    back = tips - head_m * along
    corners = np.stack([tips, back + 0.45 * head_m * aside, back - 0.45 * head_m * aside], axis=1)
    strokes.faces(corners, colour, 0.35 if colour[3] < 1.0 else 1.0)


def _add_camera(strokes: Strokes, camera: Camera, length_m: float, scale: float) -> None:
    """Add a camera as the pyramid that it sees, with a mark on the upper edge."""
    center = camera.center_world
    corners = camera_corners(camera, length_m)
    following = np.roll(corners, -1, axis=0)
    sides = np.stack([np.broadcast_to(center, (4, 3)), corners, following], axis=1)
    strokes.faces(sides, (*CAMERA_RGB, 0.10), 0.3)
    picture = np.stack([corners[[0, 1, 2]], corners[[0, 2, 3]]])
    strokes.faces(picture, (0.55, 0.66, 0.80, 0.35), 0.3)
    colour: Colour = (*CAMERA_RGB, 1.0)
    strokes.lines(np.broadcast_to(center, (4, 3)), corners, 1.6 * scale, colour)
    strokes.lines(corners, following, 1.6 * scale, colour)
    above = (corners[0] + corners[1]) / 2 + 0.35 * (corners[0] - corners[3])
    mark = np.stack(
        [0.7 * corners[0] + 0.3 * corners[1], 0.3 * corners[0] + 0.7 * corners[1], above]
    )
    strokes.faces(mark[None], colour, 0.2)
    strokes.dots(center[None], 3.2 * scale, colour, 0.4)


class _Layers:
    """What is drawn before it is put together."""

    def __init__(self, device: moderngl.Context, size_px: tuple[int, int]) -> None:
        def layer(components: int, dtype: str) -> moderngl.Texture:
            texture = device.texture(size_px, components, dtype=dtype)
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
            return texture

        self.hull_depth, self.hull_normal = layer(1, "f4"), layer(4, "f2")
        self.mesh_depth, self.mesh_normal = layer(1, "f4"), layer(4, "f2")
        self.hit_depth, self.hit_normal = layer(1, "f4"), layer(4, "f2")
        self.smoothed, self.picture = layer(4, "f2"), layer(4, "f1")
        self.skin = layer(4, "f1")
        self.skinned = device.framebuffer([self.skin])
        depth = device.depth_renderbuffer(size_px)
        self.hull = device.framebuffer([self.hull_depth, self.hull_normal])
        self.mesh = device.framebuffer([self.mesh_depth, self.mesh_normal], depth)
        self.hits = device.framebuffer([self.hit_depth, self.hit_normal], depth)
        self.smoothing = device.framebuffer([self.smoothed])
        self.normal_only = device.framebuffer([self.hull_normal])
        self.target = device.framebuffer([self.picture])
        self._depth = depth

    def use(self) -> None:
        """Bind the layers where the shaders look for them."""
        for unit, texture in enumerate(
            (
                self.hull_depth,
                self.hull_normal,
                self.mesh_depth,
                self.mesh_normal,
                self.hit_depth,
                self.hit_normal,
            ),
            start=2,
        ):
            texture.use(unit)
