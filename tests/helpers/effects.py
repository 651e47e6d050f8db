"""Effects made for tests: a scene of given objects, cameras in a ring, hulls held still."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.scene import Scene, SceneObject
from hybridve.hull.cad.topology import meeting_faces
from hybridve.hull.effects.effect import Entry, Instant, Setting
from hybridve.hull.effects.kinds import kind_of
from hybridve.hull.query.native import Native
from hybridve.hull.query.silhouettes import Hull, Views, make_hull

#: The corners of a unit cube, and its triangles, which face outwards.
CUBE = np.array([[i >> axis & 1 for axis in range(3)] for i in range(8)], np.float64) - 0.5
CUBE_FACES = np.array(
    [
        [0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
        [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5],
    ],
    np.int32,
)  # fmt: skip


def scene_object(
    name: str, vertices_world: NDArray[np.float64], faces: NDArray[np.int32]
) -> SceneObject:
    """Return an object of a scene; closed if its edges meet."""
    solid_faces = meeting_faces(vertices_world, faces)
    return SceneObject(
        name,
        Path(f"{name}.stl"),
        vertices_world,
        faces,
        0.0,
        vertices_world.mean(axis=0),
        None,
        is_closed=solid_faces is not None,
        solid_faces=solid_faces,
    )


def cube(name: str, center_world: tuple[float, float, float], edge_m: float) -> SceneObject:
    """Return a cube of 12 triangles."""
    return scene_object(name, CUBE * edge_m + np.array(center_world), CUBE_FACES)


def floor(name: str, half_m: float, z_m: float, n_quads: int = 1) -> SceneObject:
    """Return a square of 2 * n_quads^2 triangles that faces up, its middle on the z axis."""
    ticks = np.linspace(-half_m, half_m, n_quads + 1)
    x, y = np.meshgrid(ticks, ticks, indexing="ij")
    corner = (np.arange(n_quads)[:, None] * (n_quads + 1) + np.arange(n_quads)).ravel()
    beside = corner + n_quads + 1
    faces = np.concatenate(
        [np.stack([corner, beside, corner + 1], 1), np.stack([corner + 1, beside, beside + 1], 1)]
    )
    vertices = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z_m)])
    return scene_object(name, vertices, faces.astype(np.int32))


def setting_of(
    views: Views, *objects: SceneObject, claimed: tuple[str, ...] = (), viewport: int = 10
) -> Setting:
    """Return what effects are made for."""
    return Setting(
        Scene(Path("scene.toml"), objects, (), ""),
        frozenset(claimed),
        views,
        Native(1),
        step_s=0.005,
        frame_s=0.02,
        viewport=viewport,
    )


def entry_of(kind: str, name: str = "it", **keys: Any) -> Entry:
    """Return an entry of a scene, its keys checked."""
    table = kind_of(kind, "scene.toml: effect.1").table.model_validate({"kind": kind, **keys})
    return Entry(name, table, "scene.toml: effect.1")


def empty_hull(views: Views) -> Hull:
    """Return a hull that holds nothing."""
    return make_hull(
        views, [np.zeros((height, width), np.uint8) for width, height in views.sizes_px]
    )


def held(hull: Hull, before: Hull | None = None, elapsed_s: float = 0.0) -> Instant:
    """Return an instant with a hull."""
    return Instant(0.0, hull, before, elapsed_s, 0)
