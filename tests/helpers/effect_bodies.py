"""Bodies stepped by hand: scenes in memory, hulls in closed form, and the books that they keep."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from helpers.hulls import look_at, projection, sphere_mesh
from helpers.response import box_vertices, polyhedron_masks
from hybridve.hull.cad.scene import Scene, SceneObject
from hybridve.hull.effects.effect import Effect, Instant, Setting
from hybridve.hull.effects.kinds import make_effects, read_entries
from hybridve.hull.query.native import Native
from hybridve.hull.query.silhouettes import Hull, Views, make_hull, make_views

#: A shortest recording's step, seconds.
STEP_S = 0.002

#: The faces of a box whose corners are those of `box_vertices`, outwards.
BOX_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ],
    np.int32,
)[:, ::-1]


def level_views(height_m: float = 0.0, n_cameras: int = 4, distance_m: float = 3.0) -> Views:
    """Return cameras on a ring that look along the plane z = height, with its edge between pixels.

    What lies below that plane is cut off by it exactly: no camera looks onto it from above.
    """
    matrices = []
    for k in range(n_cameras):
        angle = 2 * np.pi * k / n_cameras + 0.3
        center = np.array([distance_m * np.cos(angle), distance_m * np.sin(angle), height_m])
        pose = look_at(center, np.array([0.0, 0.0, height_m]))
        matrices.append(projection(pose, 700.0, 720, 486))
    names = tuple(f"cam{k}" for k in range(n_cameras))
    return make_views(names, np.array([[720, 486]] * n_cameras), np.array(matrices))


def far_views(pixel_m: float = 0.0005, size_px: int = 800, distance_m: float = 300.0) -> Views:
    """Return cameras so far off along x, y and z that the hull of a box along them is the box.

    To half a pixel; and what is 0.1 m nearer is a fifteenth of a millimetre larger at the rim.
    """
    matrices = []
    for direction in np.eye(3):
        pose = look_at(distance_m * direction, np.zeros(3))
        matrices.append(projection(pose, distance_m / pixel_m, size_px, size_px))
    return make_views(("x", "y", "z"), np.array([[size_px, size_px]] * 3), np.array(matrices))


def box_hull(views: Views, half_m: Sequence[float], center_world: Sequence[float]) -> Hull:
    """Return the hull of a box along the world's axes."""
    return make_hull(
        views,
        polyhedron_masks(
            views, box_vertices(np.array(half_m), np.eye(3), np.array(center_world, np.float64))
        ),
    )


def joined_hull(views: Views, hulls: Sequence[Hull]) -> Hull:
    """Return the hull of several things at once."""
    masks = [
        np.maximum.reduce([hull.mask(camera) for hull in hulls]) for camera in range(len(views))
    ]
    return make_hull(views, masks)


def empty_hull(views: Views) -> Hull:
    """Return the hull of an empty room."""
    return make_hull(views, [np.zeros((int(h), int(w)), np.uint8) for w, h in views.sizes_px])


def scene_object(
    name: str,
    vertices: NDArray[np.float64],
    faces: NDArray[np.int32],
    *,
    is_closed: bool = True,
) -> SceneObject:
    """Return an object whose mesh stands in the world as it is."""
    return SceneObject(
        name,
        Path(f"{name}.stl"),
        vertices,
        faces,
        0.0,
        (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0,
        None,
        is_closed=is_closed,
    )


def ball(
    name: str, center_world: Sequence[float], radius_m: float = 0.05, n_triangles: int = 320
) -> SceneObject:
    """Return a ball, whose lowest vertex lies exactly below its centre."""
    mesh = sphere_mesh(n_triangles, radius_m)
    return scene_object(name, mesh.vertices_world + np.array(center_world), mesh.faces)


def box(name: str, half_m: Sequence[float], center_world: Sequence[float]) -> SceneObject:
    """Return a box along the world's axes."""
    vertices = box_vertices(np.array(half_m), np.eye(3), np.array(center_world, np.float64))
    return scene_object(name, vertices, BOX_FACES)


def scene_of(objects: Sequence[SceneObject], effects: Sequence[dict[str, Any]]) -> Scene:
    """Return a scene in memory."""
    return Scene(Path("scene.toml"), tuple(objects), tuple(effects), "")


@dataclass(slots=True)
class Stage:
    """One effect of bodies, and what became of it step by step.

    Attributes
    ----------
    effect : Effect
    views : Views
    """

    effect: Effect
    views: Views
    time_s: float = 0.0
    n_instants: int = 0
    before: Hull | None = None
    told: list[dict[str, dict[str, Any]]] = field(default_factory=list)

    def step(
        self, hull: Hull, n_steps: int = 1, step_s: float = STEP_S, *, is_known: bool = True
    ) -> None:
        """Go on to an instant of which the hull is known, in some steps, and keep what is told."""
        before = self.before if is_known else None
        elapsed_s = n_steps * step_s
        self.time_s += elapsed_s
        self.n_instants += 1
        instant = Instant(self.time_s, hull, before, elapsed_s, self.n_instants)
        for _ in range(n_steps):
            self.effect.advance(instant, step_s)
        self.told.append({name: dict(row) for name, row in self.effect.values(None).items()})
        self.before = hull

    def hold(self, hull: Hull, n_steps: int, step_s: float = STEP_S, *, each: int = 1) -> None:
        """Go on by many steps in a hull that stands; what is told is kept after every so many."""
        self.before = hull
        for _ in range(n_steps // each):
            self.step(hull, each, step_s)

    def column(self, name: str, column: str) -> NDArray[Any]:
        """Return what was told of an entry after each step."""
        return np.array([row[name][column] for row in self.told])

    def energy_j(self) -> NDArray[np.float64]:
        """Return the mechanical energy of all bodies after each step, about that at the start."""
        return np.asarray(
            sum(self.column(n, "kinetic_j") + self.column(n, "potential_j") for n in self.told[0])
        )

    def hull_work_j(self) -> NDArray[np.float64]:
        """Return what the hull has put into all bodies after each step."""
        return np.asarray(sum(self.column(n, "hull_work_j") for n in self.told[0]))


def stage(
    views: Views,
    objects: Sequence[SceneObject],
    effects: Sequence[dict[str, Any]],
    *,
    step_s: float = STEP_S,
    viewport: int = 10,
) -> Stage:
    """Return bodies ready to be stepped; refuses what a scene with these effects is refused for."""
    scene = scene_of(objects, effects)
    found = read_entries(scene)
    claimed = frozenset(name for entry, _ in found for name in entry.table.claimed)
    setting = Setting(scene, claimed, views, Native(1), step_s, 0.02, viewport=viewport)
    ((effect, _),) = make_effects(found, setting)
    return Stage(effect, views)
