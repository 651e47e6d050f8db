"""Pictures of a stage: rays through the lens, met with planes and shapes in closed form.

All is traced through the lens of `hybridve.calib.lens`, a ray for each pixel centre, so that the
true silhouette of a shape is exactly the pixels whose centre sees it. Colours are grey levels as
float32 (H, W, 3), blue first, until `expose` adds what a sensor adds.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.image_io import Image
from hybridve.calib.lens import cam_from_img, img_from_cam
from hybridve.calib.pose import Pose, invert, transform
from hybridve.hull.synth.shapes import Shape, sphere_points
from hybridve.hull.synth.stage import Lamp, Material, RealShape, Room, plate_of

Picture = NDArray[np.float32]
Floats = NDArray[np.float64]

#: Standard deviation of the lens' own blur, in pixels.
LENS_BLUR_PX = 0.5

#: Sensor noise in grey levels: what all three channels share, and what each has of its own.
GREY_NOISE, COLOR_NOISE = 1.7, 1.0

#: The texture of floor and walls repeats after this many texels of this size.
_TEXTURE_SIZE = 512
_TEXEL_M = 0.006

#: The floor's shadows: half the extent of their map about the room's middle, and its pixel.
_SHADOW_HALF_M = 2.0
_SHADOW_PIXEL_M = 0.01
_LAMP_SAMPLES = 24

#: Fixed-point bits of OpenCV's polygon corners.
_SHIFT = 4


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera with the rays of its pixels.

    Attributes
    ----------
    camera : Camera
        The camera.
    rays_cam : (H, W, 2) float64
        The rays of the pixel centres at depth 1.
    across, down : (H, W, 2) float64
        How the ray changes from a pixel to the next in its row and its column. Within a pixel the
        lens is straight to 3e-4 px.
    """

    camera: Camera
    rays_cam: Floats
    across: Floats
    down: Floats

    def rays(self, window: tuple[slice, slice], offset: tuple[float, float] = (0.0, 0.0)) -> Floats:
        """Return camera rays (h, w, 2) of a window, `offset` pixels (x, y) off the centres."""
        rays = self.rays_cam[window]
        if offset != (0.0, 0.0):
            rays = rays + offset[0] * self.across[window] + offset[1] * self.down[window]
        return rays

    def directions_world(self, rays_cam: Floats) -> Floats:
        """Return rays (..., 2) as directions (..., 3) in the world."""
        rotation = self.camera.cam_from_world[:, :3]
        return np.asarray(rays_cam @ rotation[:2] + rotation[2])

    @property
    def window(self) -> tuple[slice, slice]:
        """The whole image."""
        return slice(0, self.camera.height_px), slice(0, self.camera.width_px)


def make_view(camera: Camera) -> View:
    """Return a camera with the rays of all its pixels."""
    columns, rows = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    rays = cam_from_img(camera, pixels).reshape(camera.height_px, camera.width_px, 2)
    down, across = (np.asarray(slope) for slope in np.gradient(rays, axis=(0, 1)))
    return View(camera, rays, across, down)


def _offsets(side: int) -> list[tuple[float, float]]:
    """Return side * side places (x, y) spread evenly over a pixel, about its centre."""
    steps = (np.arange(side) + 0.5) / side - 0.5
    return [(float(x), float(y)) for y in steps for x in steps]


# ---------------------------------------------------------------------------- the empty room


def make_texture(rng: np.random.Generator) -> Picture:
    """Return seeded noise (size, size) that tiles: soft blotches and grain, deviation 1."""
    size = _TEXTURE_SIZE
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :])
    # Blotches of decimetres that fade into a grain of two texels; nothing finer, which would alias.
    weight = np.exp(-((frequency / 0.22) ** 2)) / (frequency + 0.004)
    weight[0, 0] = 0.0
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * weight, (size, size))
    return np.asarray(noise / noise.std(), np.float32)


def render_room(view: View, room: Room, lamp: Lamp, texture: Picture) -> Picture:
    """Return the empty room, antialiased."""
    total = np.zeros((view.camera.height_px, view.camera.width_px, 3))
    offsets = _offsets(2)
    for offset in offsets:
        total += _room_colors(view, view.rays(view.window, offset), room, lamp, texture)
    return np.asarray(total / len(offsets), np.float32)


def _room_colors(view: View, rays: Floats, room: Room, lamp: Lamp, texture: Picture) -> Floats:
    turn = pose_of_room(room)
    directions = view.directions_world(rays) @ turn[:, :3]  # room frame
    origin = transform(invert(turn), view.camera.center_world[None])[0]
    half = np.array([*room.half_size_m, np.inf])
    low = np.array([-half[0], -half[1], 0.0])
    steep = np.where(np.abs(directions) < 1e-9, 1e-9, directions)
    high = np.array([half[0], half[1], 1e3])  # no ceiling in sight
    exits = (np.where(steep > 0, high, low) - origin) / steep  # (H, W, 3)
    axis = exits.argmin(axis=-1)
    points = origin + exits.min(axis=-1)[..., None] * directions

    on_floor = axis == 2
    wall = np.where(axis == 0, steep[..., 0] > 0, 2 + (steep[..., 1] > 0))
    along = np.where(axis == 0, points[..., 1], points[..., 0])
    u = np.where(on_floor, points[..., 0], along + 0.37 * wall)
    v = np.where(on_floor, points[..., 1], points[..., 2])
    size = _TEXTURE_SIZE
    noise = cv2.remap(
        texture,
        np.asarray(np.mod(u / _TEXEL_M, size), np.float32),
        np.asarray(np.mod(v / _TEXEL_M, size), np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )

    colors = np.where(on_floor[..., None], room.floor, room.wall)
    for panel in room.panels:
        covered = (
            ~on_floor
            & (wall == panel.wall)
            & (along >= panel.low_m[0])
            & (along <= panel.high_m[0])
            & (points[..., 2] >= panel.low_m[1])
            & (points[..., 2] <= panel.high_m[1])
        )
        colors[covered] = panel.color
    skirting = ~on_floor & (points[..., 2] < 0.09)
    colors[skirting] = 0.55 * np.array(room.wall)
    contrast = np.where(on_floor, 0.045, 0.022)
    colors = colors * (1.0 + contrast * noise)[..., None]
    # Joints of 6 mm between the tiles, a little darker.
    to_joint = np.minimum(_to_grid(u, room.tile_m), _to_grid(v, room.tile_m))
    joint = np.clip((0.005 - to_joint) / 0.004, 0.0, 1.0) * on_floor
    colors *= (1.0 - 0.28 * joint)[..., None]
    # Light falls off away from the lamp and into the corners.
    lamp_room = transform(invert(turn), np.array(lamp.position_world)[None])[0]
    far = ((points - lamp_room) ** 2).sum(axis=-1)
    to_wall = np.minimum(half[0] - np.abs(points[..., 0]), half[1] - np.abs(points[..., 1]))
    corner = np.where(on_floor, to_wall, points[..., 2])
    light = (0.72 + 0.42 * np.exp(-far / 14.0)) * (1.0 - 0.12 * np.exp(-np.abs(corner) / 0.25))
    return np.asarray(colors * light[..., None])


def _to_grid(values: Floats, spacing: float) -> Floats:
    """Return the distance of each value to the nearest multiple of the spacing."""
    return np.asarray(np.abs(values - spacing * np.round(values / spacing)))


def pose_of_room(room: Room) -> Pose:
    """Return ``world_from_room``."""
    cosine, sine = np.cos(room.yaw_rad), np.sin(room.yaw_rad)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return np.column_stack([rotation, [*room.center_world, 0.0]])


# ---------------------------------------------------------------------------- the board


def add_board(view: View, background: Picture, board: Chessboard, cam_from_board: Pose) -> Picture:
    """Return the picture with the board in it, antialiased."""
    low, high = plate_of(board)
    edge = np.linspace(0.0, 1.0, 25)
    outline = np.concatenate(
        [
            np.column_stack([low[0] + edge * (high[0] - low[0]), np.full(25, y)])
            for y in (low[1], high[1])
        ]
        + [
            np.column_stack([np.full(25, x), low[1] + edge * (high[1] - low[1])])
            for x in (low[0], high[0])
        ]
    )
    points = transform(cam_from_board, np.column_stack([outline, np.zeros(len(outline))]))
    window = _window(view.camera, points)
    if window is None:
        return background
    # A ray meets the plane of the board where board_from_ray @ (x, y, 1) is (u w, v w, w), so all
    # three change by even steps from place to place within a pixel.
    plane = np.column_stack([cam_from_board[:, :2], cam_from_board[:, 3]])
    board_from_ray = np.linalg.inv(plane)
    middle, across, down = (
        np.ascontiguousarray(np.moveaxis(part[window] @ board_from_ray[:, :2].T, -1, 0))
        for part in (view.rays_cam, view.across, view.down)
    )  # (3, h, w)
    middle += board_from_ray[:, 2, None, None]
    height, width = middle.shape[1:]
    low, high = low / board.square_m, high / board.square_m
    covered = np.zeros((height, width))
    white = np.zeros((height, width))
    offsets = _offsets(4)
    for x, y in offsets:
        met = middle + x * across + y * down
        in_front = met[2] > 0
        depth = np.where(in_front, met[2], 1.0) * board.square_m
        u, v = met[0] / depth, met[1] / depth  # in squares
        on_plate = in_front & (u >= low[0]) & (u <= high[0]) & (v >= low[1]) & (v <= high[1])
        column, row = np.floor(u), np.floor(v)
        is_black = (column >= -1) & (column < board.columns) & (row >= -1) & (row < board.rows)
        half = 0.5 * (column + row)
        is_black &= half == np.floor(half)
        covered += on_plate
        white += on_plate & ~is_black
    covered /= len(offsets)
    white /= len(offsets)
    # Paper lit from above: brighter the more it faces up, and a little brighter to one side.
    normal = view.camera.cam_from_world[:, :3].T @ cam_from_board[:, 2]
    facing_up = max(0.0, float(normal[2]))
    light = 0.86 + 0.14 * facing_up + 0.05 * np.linspace(-1.0, 1.0, width)
    paper = light[..., None] * np.array([206.0, 210.0, 210.0])
    ink = light[..., None] * np.array([34.0, 32.0, 32.0])
    picture = background.copy()
    picture[window] = (
        (1.0 - covered)[..., None] * background[window]
        + white[..., None] * paper
        + (covered - white)[..., None] * ink
    )
    return picture


def _window(camera: Camera, points_cam: Floats) -> tuple[slice, slice] | None:
    """Return the part of the image that holds the points and two pixels more, or None."""
    in_front = points_cam[:, 2] > 0
    if not in_front.any():
        return None
    if not in_front.all():  # it reaches past the camera: anything may be covered
        return slice(0, camera.height_px), slice(0, camera.width_px)
    pixels = img_from_cam(camera, points_cam)
    size = np.array([camera.width_px, camera.height_px])
    low = np.clip(np.floor(pixels.min(axis=0)) - 2, 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)) + 2, 0, size).astype(int)
    if (low >= high).any():
        return None
    return slice(low[1], high[1]), slice(low[0], high[0])


# ---------------------------------------------------------------------------- real things


def shadow_map(
    lamp: Lamp, room: Room, shapes: Sequence[Shape], world_from_shape: Sequence[Pose]
) -> Picture:
    """Return how much of the lamp the floor cannot see, 0 to 1, about the middle of the room.

    The shadow that a convex shape throws from one point is the convex hull of its outline's
    shadow. Many points of the lamp make it soft.
    """
    size = round(2 * _SHADOW_HALF_M / _SHADOW_PIXEL_M)
    outlines = [
        transform(pose, shape.outline())
        for shape, pose in zip(shapes, world_from_shape, strict=True)
    ]
    spiral = np.arange(_LAMP_SAMPLES) + 0.5
    radius = lamp.radius_m * np.sqrt(spiral / _LAMP_SAMPLES)
    turn = np.pi * (3.0 - np.sqrt(5.0)) * spiral
    total = np.zeros((size, size), np.float32)
    for x, y in zip(radius * np.cos(turn), radius * np.sin(turn), strict=True):
        point = np.array(lamp.position_world) + np.array([x, y, 0.0])
        layer = np.zeros((size, size), np.uint8)
        for outline in outlines:
            ways = point[2] / (point[2] - outline[:, 2])
            on_floor = point[:2] + ways[:, None] * (outline[:, :2] - point[:2])
            texels = (on_floor - room.center_world + _SHADOW_HALF_M) / _SHADOW_PIXEL_M - 0.5
            corners = cv2.convexHull(np.asarray(texels, np.float32))[:, 0]
            fixed = np.round(corners * 2**_SHIFT).astype(np.int32)
            cv2.fillConvexPoly(layer, fixed, (1,), shift=_SHIFT)
        total += layer
    return cv2.GaussianBlur(total / _LAMP_SAMPLES, (0, 0), 1.5).astype(np.float32)


def shadow_lookup(view: View, room: Room) -> tuple[Picture, Picture]:
    """Return for each pixel (H, W) the place on the shadow map of the floor it sees, x and y.

    Pixels that see a wall get a place outside the map.
    """
    directions = view.directions_world(view.rays_cam)
    center = view.camera.center_world
    down = directions[..., 2] < -1e-6
    along = np.where(down, -center[2] / np.where(down, directions[..., 2], -1.0), 0.0)
    points = center + along[..., None] * directions
    in_room = transform(invert(pose_of_room(room)), points.reshape(-1, 3)).reshape(points.shape)
    on_floor = down & (np.abs(in_room[..., :2]) < room.half_size_m).all(axis=-1)
    texels = (points[..., :2] - room.center_world + _SHADOW_HALF_M) / _SHADOW_PIXEL_M - 0.5
    texels[~on_floor] = -1e3
    return texels[..., 0].astype(np.float32), texels[..., 1].astype(np.float32)


def add_shadow(background: Picture, lookup: tuple[Picture, Picture], shadow: Picture) -> Picture:
    """Return the picture with the shadow on its floor; `shadow` is the darkening, 0 to 1."""
    seen = cv2.remap(shadow, *lookup, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(background * (1.0 - seen)[..., None], np.float32)


def true_silhouette(
    view: View, shapes: Sequence[Shape], world_from_shape: Sequence[Pose]
) -> NDArray[np.uint8]:
    """Return which shape the centre of each pixel sees, (H, W): its number from 1, or 0."""
    height, width = view.camera.height_px, view.camera.width_px
    nearest = np.full((height, width), np.inf)
    seen = np.zeros((height, width), np.uint8)
    for number, (shape, pose) in enumerate(zip(shapes, world_from_shape, strict=True), start=1):
        window = _shape_window(view, shape, pose)
        if window is None:
            continue
        directions = view.directions_world(view.rays(window))
        along = _hit(view, shape, pose, directions.reshape(-1, 3)).reshape(directions.shape[:2])
        closer = along < nearest[window]
        nearest[window][closer] = along[closer]
        seen[window][closer] = number
    return seen


def add_shapes(
    view: View,
    background: Picture,
    lamp: Lamp,
    shapes: Sequence[RealShape],
    world_from_shape: Sequence[Pose],
    seen: NDArray[np.uint8],
) -> Picture:
    """Return the picture with the real things in it, antialiased.

    `seen` is their `true_silhouette`. Only pixels beside another shape, or beside none, are looked
    at more closely than at their centre.
    """
    picture = background.copy()
    if not seen.any():
        return picture
    kernel = np.ones((3, 3), np.uint8)
    at_edge = cv2.dilate(seen, kernel) != cv2.erode(seen, kernel)
    rows, columns = np.nonzero((seen > 0) & ~at_edge)
    numbers = seen[rows, columns]
    among = {int(number): np.flatnonzero(numbers == number) for number in np.unique(numbers)}
    color, _ = _shape_colors(
        view, view.rays_cam[rows, columns], lamp, shapes, world_from_shape, among
    )
    picture[rows, columns] = color

    rows, columns = np.nonzero(at_edge)
    # Many places within each of these pixels, one place after another.
    offsets = np.array(_offsets(4))
    count = len(rows)
    rays = view.rays_cam[rows, columns] + offsets[:, :1, None] * view.across[rows, columns]
    rays += offsets[:, 1:, None] * view.down[rows, columns]  # (16, N, 2)
    # Which shapes an edge pixel can see are those in whose window it lies.
    among = {}
    for number in np.unique(seen[seen > 0]):
        window = _shape_window(view, shapes[number - 1].shape, world_from_shape[number - 1])
        if window is not None:
            inside = (rows >= window[0].start) & (rows < window[0].stop)
            inside &= (columns >= window[1].start) & (columns < window[1].stop)
            places = count * np.arange(len(offsets))[:, None] + np.flatnonzero(inside)
            among[int(number)] = places.ravel()
    color, hit = _shape_colors(view, rays.reshape(-1, 2), lamp, shapes, world_from_shape, among)
    total = np.zeros((count, 3))
    covered = np.zeros(count)
    for part in range(len(offsets)):
        mine = slice(part * count, (part + 1) * count)
        total += color[mine] * hit[mine, None]
        covered += hit[mine]
    covered /= len(offsets)
    total /= len(offsets)
    picture[rows, columns] = (1.0 - covered)[:, None] * picture[rows, columns] + total
    return picture


def _shape_colors(
    view: View,
    rays: Floats,
    lamp: Lamp,
    shapes: Sequence[RealShape],
    world_from_shape: Sequence[Pose],
    among: dict[int, NDArray[np.int64]],
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the colours (N, 3) that rays (N, 2) see, and which (N,) meet a shape.

    `among` has the numbers of the shapes that may be met, and for each which rays may meet it.
    """
    directions = view.directions_world(rays)
    along = np.full(len(rays), np.inf)
    met = np.zeros(len(rays), np.uint8)
    for number, mine in among.items():
        shape = shapes[number - 1].shape
        entry = _hit(view, shape, world_from_shape[number - 1], directions[mine])
        closer = entry < along[mine]
        along[mine[closer]] = entry[closer]
        met[mine[closer]] = number
    colors = np.zeros((len(rays), 3))
    lamp_world = np.array(lamp.position_world)
    for number in np.unique(met[met > 0]):
        mine = np.flatnonzero(met == number)
        real, pose = shapes[number - 1], world_from_shape[number - 1]
        points = view.camera.center_world + along[mine, None] * directions[mine]
        local = transform(invert(pose), points)
        normals = real.shape.signed_distance(local)[1] @ pose[:, :3].T
        to_lamp = lamp_world - points
        to_lamp /= np.linalg.norm(to_lamp, axis=1, keepdims=True)
        facing = (normals * to_lamp).sum(axis=1)
        light = 0.60 + 0.16 * normals[:, 2] + 0.30 * np.maximum(facing, 0.0)
        colors[mine] = _material_colors(real.material, local) * light[:, None]
    return colors, met > 0


def _material_colors(material: Material, local: Floats) -> Floats:
    phase = 2.0 * np.pi * (local @ np.array(material.direction)) / material.stripe_m
    mix = 0.5 + 0.5 * np.tanh(2.0 * np.sin(phase))
    return np.asarray(
        (1.0 - mix)[:, None] * np.array(material.color) + mix[:, None] * np.array(material.other)
    )


def _hit(view: View, shape: Shape, pose: Pose, directions: Floats) -> Floats:
    origin = transform(invert(pose), view.camera.center_world[None])[0]
    return shape.hit(origin, directions @ pose[:, :3])


def _shape_window(view: View, shape: Shape, pose: Pose) -> tuple[slice, slice] | None:
    # A hundred points 5 % outside the bounding ball enclose it: they lie at most 0.3 rad apart.
    around = pose[:, 3] + 1.05 * shape.reach_m * sphere_points(100)
    return _window(view.camera, transform(view.camera.cam_from_world, around))


# ---------------------------------------------------------------------------- the sensor


def expose(picture: Picture, gain: float, rng: np.random.Generator) -> Image:
    """Return what the sensor makes of a picture: blurred by the lens, scaled, noisy, rounded."""
    noisy = cv2.GaussianBlur(picture, (0, 0), LENS_BLUR_PX) * np.float32(gain)
    noisy += COLOR_NOISE * rng.standard_normal(noisy.shape, np.float32)
    noisy += GREY_NOISE * rng.standard_normal((*noisy.shape[:2], 1), np.float32)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), np.uint8)
