"""The hard cases: scenes at the edge of what numbers can hold, each with its truth.

A case builds one or several scenes: cameras, silhouettes, a mesh. `helpers.hard_checks` asks every
engine, the certificate, the clearance and the response about them; the table in tests/README.md
says what came of it. Where a scene is a likeness of another one (elsewhere, in another unit), the
truth is that of the other, so that nothing which the likeness rounds away can go unnoticed.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from helpers.cones import BOX_FACES, box_vertices
from helpers.hulls import look_at, projection, sphere_mesh
from hybridve.calib.camera import Camera
from hybridve.calib.lens import MAX_HALF_ANGLE_DEG, cam_from_img, img_from_cam
from hybridve.calib.rig import Rig
from hybridve.hull.capture.recording import undistort_mask
from hybridve.hull.chain import rig_views
from hybridve.hull.query.engine import Triangles
from hybridve.hull.query.silhouettes import Hull, Unseen, Views, make_hull, make_views

ENGINES = ("reference", "native", "compute", "stencil")
COLUMNS = (*ENGINES, "certificate", "clearance", "response")

#: Where silhouettes and meshes gather, metres: on no camera's axis, and round in no number.
MIDDLE = np.array([0.021, 0.033, 0.013])


def beside(x: float, y: float, z: float) -> NDArray[np.float64]:
    """Return a point beside the middle, (3,)."""
    return np.asarray(MIDDLE + np.array([x, y, z]))


Inside = Callable[[NDArray[np.float64]], NDArray[np.bool_]]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Cameras, silhouettes and a mesh, and what is asked of them.

    Attributes
    -----
    img_from_world : (C, 3, 4) float64
        Projections, pixels from the scene's unit.
    masks : list of C (H, W) uint8
        Silhouettes.
    vertices, faces
        The mesh, in the scene's unit.
    viewport : int
        Samples along an edge of each triangle.
    is_inside : callable, optional
        Which points (N, 3) the mesh encloses, for one that bounds a solid.
    unseen, min_cameras
        See `make_views`.
    n_threads : int
        Of the engines that take a number.
    unit : float
        How many metres one unit is, of which the scene is a likeness with metres for units; what
        is asked (tolerances, heights) is in its units, too.
    likeness : Scene, optional
        Of which scene it is one, by `unit` and `shift`.
    shift : (3,) float64
        Where the likeness has its origin.
    apart : (3,) float64
        A shift, metres of the likeness, by which the mesh may be moved away from the hull.
    band_px : float
        How near to a pixel's edge an engine in double precision may err: 1e-7, or what the
        scene's own numbers, rounded where it stands, may be off by.
    references : tuple of (3,) float64
        More reference points for the response, metres of the likeness.
    is_on_edges : bool
        Whether samples lie on edges of pixels by intent, in numbers short enough for every engine.
    views : Views, optional
        The views, where they are not made from projections and masks alone.
    recorded : callable, optional
        What the images as recorded, through bent lenses, say of points (N, 3): 1 in the hull, -1
        outside, 0 too near to a rim for pixels to tell.
    """

    img_from_world: NDArray[np.float64]
    masks: list[NDArray[np.uint8]]
    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    viewport: int = 32
    is_inside: Inside | None = None
    unseen: Unseen = "carve"
    min_cameras: int = 1
    n_threads: int = 2
    unit: float = 1.0
    likeness: "Scene | None" = None
    shift: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    apart: NDArray[np.float64] = field(default_factory=lambda: np.array([0.9, 0.25, 0.4]))
    band_px: float = 1e-7
    references: tuple[NDArray[np.float64], ...] = ()
    is_on_edges: bool = False
    views: Views | None = None
    recorded: Callable[[NDArray[np.float64]], NDArray[np.int8]] | None = None

    def hull(self) -> Hull:
        """Return the hull."""
        if self.views is not None:
            return make_hull(self.views, self.masks)
        sizes = np.array([mask.shape[::-1] for mask in self.masks])
        names = tuple(f"cam{k}" for k in range(len(self.masks)))
        views = make_views(names, sizes, self.img_from_world, self.unseen, self.min_cameras)
        return make_hull(views, self.masks)

    def mesh(self) -> Triangles:
        """Return the mesh."""
        viewports = np.full(len(self.faces), self.viewport, np.int32)
        return Triangles(self.vertices, self.faces, viewports)

    @property
    def truth(self) -> "Scene":
        """The scene that says what is true."""
        return self if self.likeness is None else self.likeness


def likened(
    scene: Scene, unit: float = 1.0, shift: NDArray[np.float64] | None = None, **changes: Any
) -> Scene:
    """Return a scene in another unit (metres of the first a unit) and elsewhere."""
    shift = np.zeros(3) if shift is None else shift
    matrices = scene.img_from_world.copy()
    matrices[:, :, 3] = unit * matrices[:, :, 3] - matrices[:, :, :3] @ shift
    inside = scene.is_inside
    return replace(
        scene,
        img_from_world=matrices,
        vertices=unit * scene.vertices + shift,
        is_inside=None if inside is None else lambda points: inside((points - shift) / unit),
        unit=unit,
        likeness=scene,
        shift=shift,
        **changes,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One row of the table.

    Attributes
    -----
    name : str
        What the row is called.
    build : callable
        Returns the scenes.
    is_quick : bool
        Whether it is among the tests; the others are for the table alone.
    refusal : str
        What the error must say, a regular expression, where the case is none that has an answer.
    unasked : dict
        Columns that have no meaning here, each with the reason.
    refused : dict
        Columns that may refuse the case, on this renderer at least, each with what the error says.
    lacking : dict
        Columns that fail, each with what is missing.
    """

    name: str
    build: Callable[[], list[Scene]]
    is_quick: bool = True
    refusal: str = ""
    unasked: dict[str, str] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    lacking: dict[str, str] = field(default_factory=dict)


# -- cameras, silhouettes, meshes --------------------------------


def ring(
    n_cameras: int = 4,
    size_px: tuple[int, int] = (160, 120),
    focal_px: float = 200.0,
    distance_m: float = 3.0,
) -> tuple[NDArray[np.float64], list[tuple[int, int]]]:
    """Return projections of cameras in a ring about the origin, 1.2 m above it, and image sizes."""
    matrices = []
    for k in range(n_cameras):
        angle = 2 * np.pi * k / n_cameras + 0.3
        center = np.array([distance_m * np.cos(angle), distance_m * np.sin(angle), 1.2])
        matrices.append(projection(look_at(center, np.zeros(3)), focal_px, *size_px))
    return np.array(matrices), [size_px] * n_cameras


def pixels_of(matrix: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pixels (N, 2) of points in front of a camera."""
    projected = points @ matrix[:, :3].T + matrix[:, 3]
    return np.asarray(projected[:, :2] / projected[:, 2:])


def boxed_masks(
    matrices: NDArray[np.float64],
    sizes_px: list[tuple[int, int]],
    center: NDArray[np.float64] = MIDDLE,
    half_m: float = 0.15,
) -> list[NDArray[np.uint8]]:
    """Return silhouettes that are rectangles: what a cube's projection spans in each image."""
    masks = []
    for matrix, (width, height) in zip(matrices, sizes_px, strict=True):
        pixels = pixels_of(matrix, box_vertices(center, half_m))
        left, top = np.maximum(np.floor(pixels.min(axis=0)), 0).astype(int)
        right, bottom = np.ceil(pixels.max(axis=0)).astype(int)
        mask = np.zeros((height, width), np.uint8)
        mask[top:bottom, left:right] = 1
        masks.append(mask)
    return masks


def room(
    vertices: NDArray[np.float64], faces: NDArray[np.int32] | None = None, **changes: Any
) -> Scene:
    """Return the plain scene: four cameras, rectangles for silhouettes, and a mesh."""
    matrices, sizes_px = ring()
    scene = Scene(matrices, boxed_masks(matrices, sizes_px), *soup(vertices, faces))
    return replace(scene, **changes)


def soup(
    vertices: NDArray[np.float64], faces: NDArray[np.int32] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return a mesh; from (T, 3, 3) corners one whose triangles share no vertex."""
    if faces is not None:
        return vertices, faces.astype(np.int32)
    vertices = np.asarray(vertices, np.float64).reshape(-1, 3)
    return vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)


def scattered(n_triangles: int = 12, size_m: float = 0.15, seed: int = 0) -> NDArray[np.float64]:
    """Return triangles (T, 3, 3) about the middle, some in the hull, most across its border."""
    rng = np.random.default_rng(seed)
    middles = MIDDLE + 0.1 * rng.normal(size=(n_triangles, 1, 3))
    return np.asarray(middles + size_m * rng.normal(size=(n_triangles, 3, 3)))


def cube(
    center: NDArray[np.float64], half_m: float
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return a cube, facing outwards."""
    return box_vertices(center, half_m), BOX_FACES


def in_cube(center: NDArray[np.float64], half_m: float) -> Inside:
    """Return what tells the points within a cube."""
    return lambda points: np.asarray((np.abs(points - center) < half_m).all(axis=1))


def joined(
    *meshes: tuple[NDArray[np.float64], NDArray[np.int32]],
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return several meshes as one."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    return (
        np.concatenate([vertices for vertices, _ in meshes]),
        np.concatenate([f + start for (_, f), start in zip(meshes, starts, strict=False)]),
    )


def camera_center(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where a camera is, (3,)."""
    return np.asarray(-np.linalg.solve(matrix[:, :3], matrix[:, 3]))


def seen_by(
    matrices: list[NDArray[np.float64]] | NDArray[np.float64],
    size_px: tuple[int, int] = (160, 120),
    **changes: Any,
) -> Scene:
    """Return other cameras before the plain scene's silhouettes and scattered triangles."""
    matrices = np.array(matrices)
    masks = boxed_masks(matrices, [size_px] * len(matrices))
    return replace(Scene(matrices, masks, *soup(scattered())), **changes)


# -- one builder a case -------------------------------------


def edge_on() -> list[Scene]:
    """In a plane through the centre of a camera: there a line. And all powers of two, exactly."""
    matrices, _ = ring()
    center = camera_center(matrices[0])
    towards, across = MIDDLE - center, np.array([0.1, 0.2, 0.3])
    shares = np.array([[0.9, -0.5], [1.1, 0.1], [0.97, 0.6]])
    corners = center + shares[:, :1] * towards + shares[:, 1:] * across
    straight = np.array([[[1.0, 0, 0, 16], [0, 1.0, 0, 16], [0, 0, 1.0, 1]]])
    straight[0, :2, :3] *= 64.0
    straight[0, :2, 2] = 8.0  # 16 x 16 pixels
    straight[0, :2, 3] = 8.0
    mask = np.zeros((16, 16), np.uint8)
    mask[4:12, 4:12] = 1
    plane = np.array([[[0.0, 0.0, -0.5], [0.0, 0.03125, 1.0], [0.0, -0.015625, 2.0]]])
    return [
        room(corners[None]),
        Scene(straight, [mask], *soup(plane), viewport=9, is_on_edges=True),
        Scene(straight, [mask], *soup(plane[:, :, [1, 0, 2]]), viewport=9, is_on_edges=True),
    ]


def slivers(aspect: float) -> list[Scene]:
    """As long as the hull is wide, and thinner than long by the aspect."""
    rng = np.random.default_rng(1)
    along = rng.normal(size=(12, 3))
    along *= 0.3 / np.linalg.norm(along, axis=1)[:, None]
    across = rng.normal(size=(12, 3))
    across *= 0.6 / aspect / np.linalg.norm(across, axis=1)[:, None]
    middles = MIDDLE + 0.05 * rng.normal(size=(12, 3))
    corners = np.stack([middles - along, middles + along, middles + across], axis=1)
    return [room(corners)]


def without_area() -> list[Scene]:
    """Points, segments with a corner twice, segments with one between the others."""
    rng = np.random.default_rng(2)
    middles = MIDDLE + 0.1 * rng.normal(size=(12, 3))
    along = 0.2 * rng.normal(size=(12, 3))
    second, third = middles + along, middles - 0.5 * along
    second[:4] = third[:4] = middles[:4]
    third[4:8] = middles[4:8]
    return [room(np.stack([middles, second, third], axis=1))]


def twice() -> list[Scene]:
    """Every triangle is there twice, and one of them a third time, turned."""
    corners = scattered()
    return [room(np.concatenate([corners, corners, corners[:1, ::-1]]))]


def tiny() -> list[Scene]:
    """A ten-thousandth of a pixel, one of them next to the hull's border."""
    corners = scattered()
    about = corners.mean(axis=1, keepdims=True)
    return [room(about + 1e-6 * (corners - about))]


def enormous() -> list[Scene]:
    """Ten kilometres and a light second, from within a hull of a third of a metre."""
    corners = scattered(6)
    at = corners[:, :1]  # of which four are in the hull
    return [room(at + size * (corners - at), viewport=65) for size in (1e5, 3e9)]


def through_a_camera() -> list[Scene]:
    """A corner is the centre of a camera; an edge goes through it; so does the inside."""
    matrices, _ = ring()
    center = camera_center(matrices[1])
    beyond = center + 0.5 * (center - MIDDLE)
    side = np.array([0.05, 0.02, 0.3])
    return [
        room(
            np.array(
                [
                    [center, MIDDLE, MIDDLE + side],
                    [beyond, MIDDLE - 0.5 * (center - MIDDLE), MIDDLE + side],
                    [beyond + side, beyond - side, 2 * MIDDLE - center],
                ]
            ),
            viewport=25,
        )
    ]


def behind_a_camera() -> list[Scene]:
    """What a camera would see mirrored, did it see behind itself."""
    matrices, _ = ring()
    center = camera_center(matrices[2])
    return [room(scattered() + 2 * (center - MIDDLE))]


def across_a_camera() -> list[Scene]:
    """One corner in front of a camera's own plane, one on it, one behind."""
    matrices, _ = ring()
    center, forward = camera_center(matrices[3]), matrices[3, 2, :3]
    rng = np.random.default_rng(3)
    corners = center + 0.4 * rng.normal(size=(12, 3, 3))
    corners[:, 0] = MIDDLE + 0.1 * rng.normal(size=(12, 3))
    corners[:, 1] -= ((corners[:, 1] - center) @ forward)[:, None] * forward
    corners[:, 2] -= (1.0 + (corners[:, 2] - center) @ forward)[:, None] * forward
    return [room(corners, viewport=33)]


def far_away(shift_m: tuple[float, float, float], band_px: float) -> list[Scene]:
    """The plain scene elsewhere: corners on whole micrometres or so, which no shift rounds."""
    grid = np.round(scattered() * 2.0**18) / 2.0**18
    return [likened(room(grid), shift=np.array(shift_m), band_px=band_px)]


def in_units(unit: float) -> list[Scene]:
    """The plain scene in another unit, and a cube in it."""
    return [likened(scene, unit) for scene in (room(scattered()), *cube_in_hull())]


def finger() -> list[Scene]:
    """One pixel wide and high in each of two images, between the samples of a coarse viewport."""
    matrices, sizes_px = ring()
    masks = boxed_masks(matrices, sizes_px, half_m=0.3)
    for camera in (0, 1):
        column, row = np.floor(pixels_of(matrices[camera], MIDDLE[None])[0]).astype(int)
        masks[camera][:] = 0
        masks[camera][max(row - 12, 0) : row + 1, column] = 1
    corners = MIDDLE + np.array([[[-0.5, -0.4, 0.001], [0.6, -0.4, 0.0], [0.0, 0.7, -0.001]]])
    return [room(corners, masks=masks, viewport=viewport) for viewport in (4, 150)]


def filled(value: int) -> list[Scene]:
    """All images empty, or all full."""
    _, sizes_px = ring()
    masks = [np.full(size[::-1], value, np.uint8) for size in sizes_px]
    return [room(scattered(size_m=0.6), masks=masks)]


def single_pixels() -> list[Scene]:
    """Each silhouette the pixel of one and the same point."""
    matrices, sizes_px = ring()
    masks = []
    for matrix, size in zip(matrices, sizes_px, strict=True):
        column, row = np.floor(pixels_of(matrix, MIDDLE[None])[0]).astype(int)
        mask = np.zeros(size[::-1], np.uint8)
        mask[row, column] = 1
        masks.append(mask)
    corners = MIDDLE + 0.01 * np.random.default_rng(4).normal(size=(8, 3, 3))
    return [room(corners, masks=masks, viewport=17)]


def at_the_border() -> list[Scene]:
    """Silhouettes that fill the image to its border on two sides, and reach it on the others."""
    _, sizes_px = ring()
    masks = [np.ones(size[::-1], np.uint8) for size in sizes_px]
    for camera, (width, height) in enumerate(sizes_px):
        masks[camera][:, : width // 3 if camera % 2 else 1] = 0
        masks[camera][2 * height // 3 if camera < 2 else height - 1 :] = 0
    return [room(scattered(size_m=0.8), masks=masks, viewport=20)]


def contradictory() -> list[Scene]:
    """Three cameras see one thing, the fourth another, elsewhere: no point is in all four."""
    matrices, sizes_px = ring()
    masks = boxed_masks(matrices, sizes_px)
    masks[3] = boxed_masks(matrices[3:], sizes_px[3:], beside(0.0, 0.0, 0.75), 0.1)[0]
    return [room(scattered(), masks=masks)]


def in_one_place() -> list[Scene]:
    """Four cameras in one place, turned about one another; two of them the same."""
    center = np.array([2.9, 0.4, 1.2])
    targets = [MIDDLE, beside(0.0, 0.2, 0.1), beside(0.0, -0.2, -0.1), MIDDLE]
    rolls = [0.0, 0.7, -0.4, 0.0]
    return [
        seen_by(
            [
                projection(look_at(center, target, roll), 200.0, 160, 120)
                for target, roll in zip(targets, rolls, strict=True)
            ]
        )
    ]


def facing(*centers: tuple[float, float, float]) -> list[Scene]:
    """Cameras that look at the origin."""
    return [
        seen_by([projection(look_at(np.array(c), np.zeros(3)), 200.0, 160, 120) for c in centers])
    ]


def turned_away() -> list[Scene]:
    """Three cameras see it, the fourth has its back to it: nothing, or nothing to say."""
    scenes = []
    for unseen in ("carve", "keep"):
        scene = room(scattered(), unseen=unseen, min_cameras=2)
        matrices = scene.img_from_world.copy()
        center = camera_center(matrices[3])
        matrices[3] = projection(look_at(center, 2 * center), 200.0, 160, 120)
        scenes.append(replace(scene, img_from_world=matrices))
    return scenes


def many(n_cameras: int) -> list[Scene]:
    """A ring of many cameras."""
    matrices, _ = ring(n_cameras)
    return [seen_by(matrices, viewport=16)]


def on_pixel_edges() -> list[Scene]:
    """Short numbers: every sample of a coarse viewport lies on the edge of a pixel, exactly.

    Seen from 2 m with a focal length of 256 px, 1/128 m is a pixel; samples are as far apart.
    """
    matrices = []
    for axes in ([0, 1, 2], [1, 2, 0], [2, 0, 1]):
        matrix = np.zeros((3, 4))
        matrix[0, axes[0]], matrix[1, axes[1]] = 256.0, 256.0
        matrix[:2, axes[2]], matrix[:2, 3] = 32.0, 64.0
        matrix[2, axes[2]], matrix[2, 3] = 1.0, 2.0
        matrices.append(matrix)
    masks = [np.zeros((64, 64), np.uint8) for _ in matrices]
    for mask in masks:
        mask[24:40, 24:40] = 1
    edge = 1.0 / 128.0
    plates = [
        edge * np.array([[-16.0, -16, 0], [16, -16, 0], [-16, 16, 0]]),
        edge * np.array([[0.0, -16, -16], [0, 16, -16], [0, -16, 16]]),
        edge * np.array([[-8.0, 0, -8], [8, 0, -8], [-8, 0, 8]]),
        edge * np.array([[8.0, 8, 0], [8, -8, 0], [-8, 8, 0]]),
    ]
    return [
        Scene(np.array(matrices), masks, *soup(np.array(plates)), viewport=33, is_on_edges=True)
    ]


def through_corners() -> list[Scene]:
    """V_rec goes through corners of pixels, where a column and a row are crossed at once."""
    scene = room(MIDDLE + 1e-3 * np.random.default_rng(7).normal(size=(1, 3, 3)), viewport=3)
    rng = np.random.default_rng(8)
    references = []
    for matrix in scene.img_from_world:
        corners = np.round(pixels_of(matrix, MIDDLE + 0.05 * rng.normal(size=(5, 3))))
        for corner in corners:
            ray = np.linalg.solve(matrix[:, :3], np.append(corner, 1.0))
            along = (MIDDLE - camera_center(matrix)) @ ray / (ray @ ray)
            references.append(camera_center(matrix) + along * ray)
    scene = replace(scene, references=tuple(references))
    return [scene, likened(scene, 1e6), likened(scene, 1e-6)]


def with_bad_vertex(value: float) -> list[Scene]:
    """One coordinate of vertex 3 is none."""
    vertices, faces = soup(scattered())
    vertices[3, 1] = value
    return [room(vertices, faces)]


def cube_in_hull() -> list[Scene]:
    """A cube within the hull: it reaches nowhere out of it."""
    return [room(*cube(MIDDLE, 0.05), is_inside=in_cube(MIDDLE, 0.05))]


def hull_in_cube() -> list[Scene]:
    """A hull within a cube, near one of its walls: no point of the surface is in it."""
    center = beside(0.4, 0.0, 0.0)
    return [room(*cube(center, 0.9), is_inside=in_cube(center, 0.9))]


def across_a_cube() -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return a cube whose wall the hull reaches through."""
    return cube(beside(0.3, 0.02, 0.05), 0.25)


def with_hole() -> list[Scene]:
    """A cube without one of its triangles: nothing is inside."""
    vertices, faces = across_a_cube()
    return [room(vertices, faces[1:])]


def flipped() -> list[Scene]:
    """A cube of whose faces some are turned: nothing is inside for sure."""
    vertices, faces = across_a_cube()
    faces = faces.copy()
    faces[::3] = faces[::3, ::-1]
    return [room(vertices, faces)]


def non_manifold() -> list[Scene]:
    """Two cubes that share an edge, and a fin that stands on it."""
    vertices, faces = joined(across_a_cube(), cube(beside(-0.2, 0.02, 0.55), 0.25))
    fin = np.array([vertices[0], vertices[1], vertices[0] - [0.2, 0.1, 0.1]])
    return [room(*joined((vertices, faces), (fin, np.array([[0, 1, 2]]))))]


def nested(*, is_hollow: bool) -> list[Scene]:
    """A cube in a cube: a cavity that the hull reaches into, or the solid again around the hull."""
    center, half_m = (beside(0.3, 0.02, 0.05), 0.25) if is_hollow else (MIDDLE, 0.5)
    outer, (vertices, faces) = cube(center, half_m + 0.3), cube(center, half_m)
    inner = (vertices, faces[:, ::-1] if is_hollow else faces)
    in_outer, in_inner = in_cube(center, half_m + 0.3), in_cube(center, half_m)

    def is_inside(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        return in_outer(points) & ~in_inner(points) if is_hollow else in_outer(points)

    return [room(*joined(outer, inner), is_inside=is_inside)]


def overlapping() -> list[Scene]:
    """Two cubes that share a part of space, in which the hull lies."""
    first, second = (beside(0.25, 0.02, 0.05), 0.4), (beside(-0.15, 0.05, 0.0), 0.3)

    def is_inside(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        return in_cube(*first)(points) | in_cube(*second)(points)

    return [room(*joined(cube(*first), cube(*second)), is_inside=is_inside)]


def inverted() -> list[Scene]:
    """A cube that faces inwards all over: a solid all the same."""
    vertices, faces = across_a_cube()
    inside = in_cube(beside(0.3, 0.02, 0.05), 0.25)
    return [room(vertices, faces[:, ::-1], is_inside=inside)]


def abstaining() -> list[Scene]:
    """Pinhole cameras that abstain: images of which each shows another part of the room."""
    scenes = []
    for least in (1, 3):
        scene = room(scattered(size_m=0.5), unseen="keep", min_cameras=least, viewport=15)
        masks = [
            mask[10:-10, :-70] if k % 2 else mask[:, 70:] for k, mask in enumerate(scene.masks)
        ]
        matrices = scene.img_from_world.copy()
        for camera in range(4):
            left, top = (0, 10) if camera % 2 else (70, 0)
            matrices[camera, 0] -= left * matrices[camera, 2]
            matrices[camera, 1] -= top * matrices[camera, 2]
        scenes.append(
            replace(scene, img_from_world=matrices, masks=[np.ascontiguousarray(m) for m in masks])
        )
    return scenes


def sampled_at(viewport: int, n_triangles: int = 12) -> list[Scene]:
    """A viewport of some size."""
    return [room(scattered(n_triangles), viewport=viewport)]


def largest_viewport() -> list[Scene]:
    """Two thousand million samples, of which a hull of some pixels takes few."""
    scene = single_pixels()[0]
    corners = MIDDLE + np.array([[[-0.5, -0.4, 0.1], [0.6, -0.4, 0.0], [0.0, 0.7, -0.1]]])
    vertices, faces = soup(corners)
    return [replace(scene, vertices=vertices, faces=faces, viewport=65_535)]


def one_pixel_images() -> list[Scene]:
    """Images of a single pixel, all object: cones of one pixel's width."""
    matrices, _ = ring(4, (1, 1), 6.0)
    return [Scene(matrices, [np.ones((1, 1), np.uint8)] * 4, *soup(scattered()))]


def unequal_images() -> list[Scene]:
    """Images of 1 x 1, 3 x 7, 641 x 2 and 640 x 480 pixels before one and the same thing."""
    sizes_px = [(1, 1), (3, 7), (641, 2), (640, 480)]
    matrices = np.array(
        [
            projection(
                look_at(camera_center(matrix), MIDDLE), 5.0 * min(width, height), width, height
            )
            for matrix, (width, height) in zip(ring()[0], sizes_px, strict=True)
        ]
    )
    return [Scene(matrices, boxed_masks(matrices, sizes_px), *soup(scattered()))]


def enormous_image() -> list[Scene]:
    """An image of 12,000 x 9,000 pixels beside one of 160 x 120."""
    sizes_px = [(12_000, 9_000), (160, 120), (160, 120)]
    matrices = np.array(
        [
            projection(look_at(camera_center(matrix), np.zeros(3)), 1.25 * width, width, height)
            for matrix, (width, height) in zip(ring(3)[0], sizes_px, strict=True)
        ]
    )
    return [Scene(matrices, boxed_masks(matrices, sizes_px), *soup(scattered()))]


def focal_length(focal_px: float) -> list[Scene]:
    """Lenses so wide that the image is a few degrees a pixel, or so long that it is arc seconds."""
    distance_m = 3.0 if focal_px < 100 else 0.02 * focal_px / 20
    size_px = (160, 120) if focal_px > 100 else (60, 40)
    matrices = []
    for k in range(4):
        angle = np.pi * k / 2 + 0.3
        center = distance_m * np.array([np.cos(angle), np.sin(angle), 0.4])
        matrices.append(projection(look_at(center, MIDDLE), focal_px, *size_px))
    return [seen_by(matrices, size_px)]


def bent_camera(
    center: NDArray[np.float64],
    model: str,
    params: tuple[float, ...],
    size_px: tuple[int, int],
    roll_rad: float = 0.0,
) -> Camera:
    """Return a camera with a lens that looks at the middle."""
    return Camera("bent", model, *size_px, np.array(params), look_at(center, MIDDLE, roll_rad))


#: A fisheye that sees 170 degrees across its image circle's diameter of 160 px: r = f theta.
FISHEYE_PX = (160, 160)
FISHEYE = (80.0 / np.radians(85.0), 80.0 / np.radians(85.0), 80.0, 80.0, 0.0, 0.0, 0.0, 0.0)


def recorded_ball(
    camera: Camera, center: NDArray[np.float64], radius_m: float
) -> NDArray[np.uint8]:
    """Return the recorded silhouette of a ball: pixels whose centre's ray meets it."""
    x, y = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    rays = cam_from_img(camera, np.stack([x.ravel(), y.ravel()], axis=1))
    exists = np.asarray(np.isfinite(rays).all(axis=1))
    rays = np.column_stack([np.where(exists[:, None], rays, 0.0), np.ones(len(rays))])
    to_ball = camera.cam_from_world[:, :3] @ center + camera.cam_from_world[:, 3]
    along = rays @ to_ball / np.linalg.norm(rays, axis=1)
    on_ball = (along > 0) & (to_ball @ to_ball - along**2 < radius_m**2) & exists
    return np.asarray(on_ball).reshape(x.shape).astype(np.uint8)


def told_by_recorded(
    cameras: list[Camera], masks: list[NDArray[np.uint8]], unseen: Unseen, min_cameras: int
) -> Callable[[NDArray[np.float64]], NDArray[np.int8]]:
    """Return what recorded silhouettes say of points, but for two pixels about every rim."""
    kernel = np.ones((5, 5), np.uint8)

    def tell(points: NDArray[np.float64]) -> NDArray[np.int8]:
        n_object, n_unseen, n_maybe = np.zeros((3, len(points)), np.int64)
        denied = np.zeros(len(points), np.bool_)
        for camera, mask in zip(cameras, masks, strict=True):
            points_cam = points @ camera.cam_from_world[:, :3].T + camera.cam_from_world[:, 3]
            depth_m = points_cam[:, 2]
            off_axis_deg = np.degrees(
                np.arctan2(np.linalg.norm(points_cam[:, :2], axis=1), depth_m)
            )
            in_reach = off_axis_deg < MAX_HALF_ANGLE_DEG - 2.0
            pixels = np.full((len(points), 2), -1e3)
            if in_reach.any():
                pixels[in_reach] = img_from_cam(camera, points_cam[in_reach])
            size = np.array([camera.width_px, camera.height_px])
            well_seen = in_reach & (pixels > 2.0).all(axis=1) & (pixels < size - 2.0).all(axis=1)
            # Behind it the lens sees nothing; beyond its reach nothing is made of what it sees.
            never_seen = off_axis_deg > MAX_HALF_ANGLE_DEG + 2.0
            never_seen |= in_reach & (
                (pixels < -2.0).any(axis=1) | (pixels > size + 2.0).any(axis=1)
            )
            column, row = np.where(well_seen[:, None], pixels, 0.0).astype(np.int64).T
            well_on = well_seen & (cv2.erode(mask, kernel)[row, column] != 0)
            well_off = well_seen & (cv2.dilate(mask, kernel)[row, column] == 0)
            n_object += well_on
            n_unseen += never_seen
            n_maybe += ~never_seen
            denied |= well_off
        n_cameras = len(cameras)
        if unseen == "carve":
            inside, outside = n_object == n_cameras, denied | (n_unseen > 0)
        else:
            inside = (n_object + n_unseen == n_cameras) & (n_object >= min_cameras)
            outside = denied | (n_maybe < min_cameras)
        return np.where(outside, -1, np.where(inside, 1, 0)).astype(np.int8)

    return tell


def bent(cameras: list[Camera], unseen: Unseen, least: int, **changes: Any) -> Scene:
    """Return a ball before bent lenses, freed of distortion as recordings are."""
    cameras = [replace(camera, name=f"cam{k}") for k, camera in enumerate(cameras)]
    recorded = [recorded_ball(camera, MIDDLE, 0.15) for camera in cameras]
    # What of a session is asked for here.
    session: Any = SimpleNamespace(cameras=cameras, unseen=unseen, min_cameras=least)
    views, lenses = rig_views(session, Rig(tuple(cameras)))
    scene = Scene(
        views.img_from_local,
        [undistort_mask(*pair) for pair in zip(recorded, lenses, strict=True)],
        *soup(scattered(30, size_m=0.5)),
        unseen=unseen,
        min_cameras=least,
        views=views,
        recorded=told_by_recorded(cameras, recorded, unseen, least),
    )
    return replace(scene, **changes)


def fisheye() -> list[Scene]:
    """Four fisheyes of 170 degrees near a ball: what they see beyond 140 is cut off."""
    cameras = []
    for k in range(4):
        angle = np.pi * k / 2 + 0.3
        center = np.array([0.7 * np.cos(angle), 0.7 * np.sin(angle), 0.3 * (-1) ** k])
        cameras.append(bent_camera(center, "OPENCV_FISHEYE", FISHEYE, FISHEYE_PX))
    vertices, faces = soup(scattered())
    return [bent(cameras, "carve", 1, vertices=vertices, faces=faces)]


def bent_and_abstaining() -> list[Scene]:
    """Lenses that bend much, near: what the corners of their images deny is denied.

    The cameras are rolled, so that what the others see left and right of the ball is in corners.
    """
    scenes = []
    for k1, least in ((-0.28, 1), (-0.28, 3), (0.2, 2)):
        cameras = []
        for k in range(4):
            angle = np.pi * k / 2 + 0.3
            away_m = 0.9 + 0.05 * k
            center = np.array([away_m * np.cos(angle), away_m * np.sin(angle), 0.3 + 0.07 * k])
            params = (150.0, 150.0, 80.0, 60.0, k1, 0.04, 0.0, 0.0)
            cameras.append(bent_camera(center, "OPENCV", params, (160, 120), 0.64 + 0.1 * k))
        scenes.append(bent(cameras, "keep", least, viewport=40))
    return scenes


def reordered_triangles() -> list[Scene]:
    """A sphere in three orders."""
    mesh = sphere_mesh(200, 0.22, center_world=tuple(MIDDLE))
    rng = np.random.default_rng(5)
    orders = [np.arange(len(mesh)), np.arange(len(mesh))[::-1], rng.permutation(len(mesh))]
    return [room(mesh.vertices_world, mesh.faces[order], viewport=5) for order in orders]


def reordered_cameras() -> list[Scene]:
    """Cameras of unequal silhouettes in four orders."""
    scene = room(scattered())
    orders = ([0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1], [1, 3, 0, 2])
    return [
        replace(
            scene,
            img_from_world=scene.img_from_world[order],
            masks=[scene.masks[k] for k in order],
        )
        for order in orders
    ]


def threaded() -> list[Scene]:
    """1, 2, 3 and 8 threads, on a mesh of which each gets a share."""
    mesh = sphere_mesh(9000, 0.22, center_world=tuple(MIDDLE))
    scene = room(mesh.vertices_world, mesh.faces, viewport=2)
    return [replace(scene, n_threads=number) for number in (1, 2, 3, 8)]


def in_pieces() -> list[Scene]:
    """Silhouettes that are boards of chess, rings with holes, and noise."""
    rng = np.random.default_rng(6)
    y, x = np.mgrid[:120, :160]
    masks = [
        ((x + y) % 2).astype(np.uint8),
        (rng.random((120, 160)) < 0.9).astype(np.uint8),
        cv2.circle(np.zeros((120, 160), np.uint8), (80, 60), 20, 1, 5),
        np.ones((120, 160), np.uint8),
    ]
    return [room(scattered(), masks=masks, viewport=25)]


def strange_pinholes() -> list[Scene]:
    """Skewed and flat pixels, a principal point far outside, a projection of another scale."""
    matrices, _ = ring()
    skews = np.array(
        [
            [[1.0, 0.4, 0.0], [0, 1, 0], [0, 0, 1]],
            [[5.0, 0, -320.0], [0, 0.2, 48.0], [0, 0, 1]],
            [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]],
            [[1e-3, 0, 0], [0, 1e-3, 0], [0, 0, 1e-3]],
        ]
    )
    matrices = skews @ matrices
    shifted = matrices[2].copy()
    center = camera_center(shifted)
    pose = look_at(center, center + np.array([1.0, -0.3, 0.2]) * [-1, 1, -1] * center)
    pixel = pixels_of(projection(pose, 200.0, 0, 0), MIDDLE[None])[0]
    matrices[2] = projection(pose, 200.0, 0, 0)
    matrices[2, 0] += (80.0 - pixel[0]) * matrices[2, 2]
    matrices[2, 1] += (60.0 - pixel[1]) * matrices[2, 2]
    return [seen_by(matrices)]


def nothing() -> list[Scene]:
    """A mesh without a triangle."""
    return [room(np.zeros((0, 3)), np.zeros((0, 3), np.int32))]


CASES = (
    Case("a triangle seen exactly edge-on", edge_on),
    Case("slivers of aspect 1e6", lambda: slivers(1e6)),
    Case("slivers of aspect 1e9", lambda: slivers(1e9)),
    Case("triangles without area: points, segments", without_area),
    Case("duplicate triangles", twice),
    Case("far smaller than a pixel", tiny),
    Case("far larger than the room (10 km, a light second)", enormous),
    Case("through a camera's centre", through_a_camera),
    Case("behind a camera", behind_a_camera),
    Case("across a camera's own plane", across_a_camera),
    Case(
        "10 km from the origin",
        lambda: far_away((8e3, -6e3, 50.0), 1e-7),
    ),
    Case(
        "5,000 km from the origin",
        lambda: far_away((3e6, 4e6, -2e5), 1e-5),
    ),
    Case("in units of 1e-6 (lengths in these)", lambda: in_units(1e-6)),
    Case("in units of 1e6 (lengths in these)", lambda: in_units(1e6)),
    Case("a finger one pixel wide, between samples", finger),
    Case("empty silhouettes", lambda: filled(0)),
    Case("full silhouettes", lambda: filled(1)),
    Case("silhouettes of a single pixel", single_pixels),
    Case("silhouettes in pieces: chessboard, noise, ring", in_pieces),
    Case("a hull at the images' borders", at_the_border),
    Case("contradictory silhouettes", contradictory),
    Case("cameras in one place", in_one_place),
    Case("opposite cameras", lambda: facing((3.0, 0.1, 0.2), (-3.0, -0.1, -0.2))),
    Case("nearly parallel cameras", lambda: facing((3.0, 0.1, 0.2), (3.0, 0.1, 0.200001))),
    Case("a camera turned away", turned_away),
    Case("one camera", lambda: facing((3.0, 0.1, 0.2))),
    Case("20 cameras", lambda: many(20)),
    Case("64 cameras", lambda: many(64)),
    Case(
        "300 cameras",
        lambda: many(300),
        is_quick=False,
        refused={"compute": "300 cameras, .* room for 256", "stencil": "300 cameras, .* to 255"},
    ),
    Case("samples exactly on pixel edges", on_pixel_edges),
    Case(
        "a way out through pixels' corners",
        through_corners,
        unasked={"clearance": "the case is one of rays alone"},
    ),
    Case("a NaN vertex", lambda: with_bad_vertex(np.nan), refusal="vertex 3 is not finite"),
    Case("an infinite vertex", lambda: with_bad_vertex(np.inf), refusal="vertex 3 is not finite"),
    Case(
        "no triangle at all",
        nothing,
        refused={"clearance": "no triangle to measure", "response": "no triangle to lay"},
    ),
    Case("a mesh with a hole", with_hole),
    Case("flipped faces", flipped),
    Case("non-manifold edges", non_manifold),
    Case("nested shells: a cavity", lambda: nested(is_hollow=True)),
    Case(
        "nested shells: a solid in a solid",
        lambda: nested(is_hollow=False),
    ),
    Case("overlapping shells", overlapping),
    Case("an inverted shell", inverted),
    Case("object inside the hull", cube_in_hull),
    Case("hull inside the object", hull_in_cube),
    Case("cameras that abstain", abstaining),
    Case(
        "cameras that abstain, with bent lenses",
        bent_and_abstaining,
    ),
    Case("viewport 1", lambda: sampled_at(1)),
    Case("viewport 2", lambda: sampled_at(2)),
    Case("viewport 512", lambda: sampled_at(512, 1), is_quick=False),
    Case(
        "viewport 65,535",
        largest_viewport,
        is_quick=False,
        unasked={
            "reference": "asks 2,147,450,880 samples in turn: many minutes",
            "stencil": "draws each of 2,147,450,880 samples for every camera: many minutes",
        },
        refused={"compute": "viewport of 65535, .* a software renderer"},
    ),
    Case("images of 1 x 1", one_pixel_images),
    Case("images of 1 x 1 to 641 x 480 in one rig", unequal_images),
    Case(
        "an image of 12,000 x 9,000",
        enormous_image,
        is_quick=False,
        refused={"compute": "integral images of a frame .* in one buffer"},
    ),
    Case("a focal length of 10 px", lambda: focal_length(10.0)),
    Case("a focal length of 1e6 px", lambda: focal_length(1e6)),
    Case("skewed pixels, a principal point far outside", strange_pinholes),
    Case("fisheyes of 170 degrees", fisheye),
    Case("any order of triangles", reordered_triangles),
    Case("any order of cameras", reordered_cameras),
    Case(
        "1, 2, 3 and 8 threads",
        threaded,
        unasked={"clearance": "works in the thread that asks, whatever the number"},
    ),
)
