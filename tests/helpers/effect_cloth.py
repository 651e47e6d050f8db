"""Sheets, hulls in motion and the least driver for tests of the effect "cloth"."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from helpers.hulls import look_at, projection, ring_views
from hybridve.hull.cad.scene import Scene, SceneObject
from hybridve.hull.cad.topology import examine_topology
from hybridve.hull.effects.cloth import KIND, Cloths
from hybridve.hull.effects.effect import Entry, Instant, Setting
from hybridve.hull.query.engine import Engine, Triangles
from hybridve.hull.query.native import Native
from hybridve.hull.query.silhouettes import Hull, Views, make_hull, make_views
from hybridve.hull.query.viewport import sample_positions
from hybridve.hull.query.walk import contains_few, spans_of_rays
from hybridve.hull.synth.meshes import sheet_mesh

STEP_S = 0.002


def sheet(
    cells: tuple[int, int] = (8, 10),
    size_m: tuple[float, float] = (0.6, 0.75),
    fold_m: float = 0.0,
    *,
    direction: tuple[float, float, float] | None = None,
    is_soup: bool = False,
) -> SceneObject:
    """Return a sheet in x and z about the origin; `is_soup` repeats vertices as STL files do."""
    mesh = sheet_mesh((1000 * size_m[0], 1000 * size_m[1]), cells, 1000 * fold_m, 4)
    vertices, faces = mesh.vertices_mm / 1000.0, mesh.faces.astype(np.int32)
    if is_soup:
        vertices = vertices[faces].reshape(-1, 3)
        faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return thing("sheet", vertices, faces, direction)


def thing(
    name: str,
    vertices: NDArray[np.float64],
    faces: NDArray[np.int32] | NDArray[np.int64],
    direction: tuple[float, float, float] | None = None,
) -> SceneObject:
    """Return an object of a scene."""
    faces = np.asarray(faces, np.int32)
    return SceneObject(
        name=name,
        mesh_path=Path("sheet.stl"),
        vertices_world=np.asarray(vertices, np.float64),
        faces=faces,
        required_clearance_m=0.0,
        reference_point_world=vertices.mean(axis=0),
        recovery_direction=None if direction is None else np.array(direction),
        is_closed=examine_topology(vertices, faces).closed,
    )


def make_cloth(
    views: Views,
    objects: list[SceneObject],
    *,
    engine: Engine | None = None,
    step_s: float = STEP_S,
    names: Sequence[str] = ("sheet",),
    **keys: Any,
) -> Cloths:
    """Return the effect on some objects."""
    tables = [
        KIND.table.model_validate({"kind": "cloth", "object": name, **keys}) for name in names
    ]
    scene = Scene(
        Path("scene.toml"), tuple(objects), tuple(table.model_dump() for table in tables), ""
    )
    setting = Setting(
        scene=scene,
        claimed=frozenset(names),
        views=views,
        engine=engine or Native(1),
        step_s=step_s,
        frame_s=1 / 60,
    )
    entries = [
        Entry(name, table, f"scene.toml: effect.{number}")
        for number, (name, table) in enumerate(zip(names, tables, strict=True), start=1)
    ]
    effect = KIND.make(entries, setting)
    assert isinstance(effect, Cloths)
    return effect


def views_around() -> Views:
    """Return four cameras of 640 x 480 about the origin: a pixel is some 3.7 mm wide there."""
    return ring_views(4, 640, 480, 600.0, 2.0)


def half_space_views() -> Views:
    """Return a camera above that looks down, and one at the side: a pixel is 2.5 mm wide."""
    eyes = np.array([[0.0, 0.0, 2.0], [2.0, 0.0, 0.0]])
    matrices = [projection(look_at(eye, np.zeros(3)), 800.0, 640, 640) for eye in eyes]
    return make_views(("above", "side"), np.array([[640, 640]] * 2), np.array(matrices))


def half_space(views: Views, y_m: float) -> Hull:
    """Return all below a plane, as far as the cameras of `half_space_views` see.

    The plane goes through the camera above and, at z = 0, through y = `y_m`.
    """
    width, height = views.sizes_px[0].tolist()
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    rays = rays @ np.linalg.inv(views.img_from_local[0, :, :3]).T
    center = views.origin_world + views.centers_local()[0]
    at_floor = center - rays * (center[2] / rays[..., 2])[..., None]
    below = (at_floor[..., 1] < y_m).astype(np.uint8)
    return make_hull(views, [below, np.ones_like(below)])


def deepest_m(hull: Hull, thing: SceneObject, vertices_m: NDArray[np.float64]) -> float:
    """Return how far the sample deepest in the hull is from the nearest way out of many, metres."""
    samples = samples_world(thing, vertices_m)
    inside = samples[contains_few(hull, samples)]
    if len(inside) == 0:
        return 0.0
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 3), axis=-1).reshape(-1, 3)
    ways = grid[np.abs(grid).max(axis=1) == 1.0]
    origins, directions = np.repeat(inside, len(ways), axis=0), np.tile(ways, (len(inside), 1))
    out_m = np.zeros(len(origins))
    for number, spans in enumerate(spans_of_rays(hull, origins, directions, 1.0)):
        if len(spans) and spans[0, 0] < 1e-6:  # a sample on the rim may begin with a gap
            out_m[number] = spans[0, 1]
    return float(out_m.reshape(len(inside), -1).min(axis=1).max())


def no_hull(views: Views) -> Hull:
    """Return a hull of which no camera sees anything."""
    return make_hull(views, [np.zeros((h, w), np.uint8) for w, h in views.sizes_px.tolist()])


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """What stands after one step."""

    time_s: float
    hull: Hull
    values: dict[str, Any]

    @property
    def energy_j(self) -> float:
        return float(self.values["kinetic_j"] + self.values["potential_j"])

    @property
    def vertices_m(self) -> NDArray[np.float64]:
        return np.asarray(self.values["vertices_m"])


def drive(
    cloth: Cloths,
    hull_at: Callable[[float], Hull],
    n_steps: int,
    *,
    step_s: float = STEP_S,
    start_s: float = 0.0,
    per_hull: int = 1,
    knows_before: bool = True,
) -> Iterator[Row]:
    """Advance step by step and yield what stands after each; the hull is new every `per_hull`."""
    before: Hull | None = None
    hull: Hull | None = None
    for step in range(n_steps):
        time_s = start_s + (step + 1) * step_s
        if step % per_hull == 0:
            before, hull = hull, hull_at(time_s)
            told_before = before if knows_before else None
        else:
            told_before = hull
        assert hull is not None
        instant = Instant(time_s, hull, told_before, per_hull * step_s, step)
        cloth.advance(instant, step_s)
        values = dict(cloth.values(None)["sheet"])
        yield Row(time_s, hull, values)


def samples_world(
    thing: SceneObject, vertices_m: NDArray[np.float64], viewport: int = 10
) -> NDArray[np.float64]:
    """Return where all samples of all triangles are, (P, 3) metres."""
    mesh = Triangles(vertices_m, thing.faces, np.full(len(thing.faces), viewport, np.int32))
    count = viewport * (viewport + 1) // 2
    triangle = np.repeat(np.arange(len(mesh)), count)
    sample = np.tile(np.arange(count, dtype=np.uint32), len(mesh))
    return sample_positions(mesh.corners_world[triangle], mesh.viewports[triangle], sample)


def nudged(thing: SceneObject, shift_m: NDArray[np.float64]) -> SceneObject:
    """Return an object elsewhere."""
    return replace(thing, vertices_world=thing.vertices_world + shift_m)
