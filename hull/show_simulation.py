"""Frames of a simulation as pictures: the hull, and virtual things where they were by then."""

from collections.abc import Iterator
from contextlib import closing

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.calib.pose import placed
from hybridve.hull.chain import Chain, FrameHull, hulls
from hybridve.hull.query.silhouettes import Hull, make_hull
from hybridve.hull.report.simulation_data import StoredGroup, StoredSimulation
from hybridve.hull.view.drawn import DrawnObject, Marks
from hybridve.hull.view.picture import Painter, draw_picture
from hybridve.hull.view.viewpoint import Viewpoint, choose_viewpoint

Image = NDArray[np.uint8]

#: Points of particles that a picture shows at most.
_MOST_POINTS = 20_000

#: What lamps tell of triangles.
_LIT = "share_lit"

#: Ways are drawn of the last so many frames.
_PATH_FRAMES = 60


def refuse_other(chain: Chain, simulation: StoredSimulation) -> None:
    """Refuse a simulation that is of another recording or scene.

    Raises
    ------
    SessionError
        If it is.
    """
    for what, checksum in (("session", chain.session.checksum), ("scene", chain.scene.checksum)):
        if simulation.settings[f"{what}_sha256"] != checksum:
            raise SessionError(
                f"{simulation.path}: is a simulation of another {what}, or of this one before it "
                "was changed; simulate it again"
            )


def draw_frame(
    chain: Chain, simulation: StoredSimulation, row: int, size_px: tuple[int, int]
) -> Image:
    """Return one frame of a simulation, by its row.

    Raises
    ------
    SessionError
        If the recording does not have it.
    """
    with closing(hulls(chain, skip=row)) as frames:
        frame = next(frames, None)
    if frame is None:
        raise SessionError(
            f"{chain.session.path}: the recording has no frame {simulation.index[row]}"
        )
    viewpoint = _viewpoint(chain, simulation, row, frame, size_px)
    return _draw(chain, simulation, row, frame, viewpoint, size_px)


def draw_film(
    chain: Chain, simulation: StoredSimulation, size_px: tuple[int, int]
) -> Iterator[Image]:
    """Yield all frames of a simulation, from where its middle is seen best."""
    middle = len(simulation.index) // 2
    with closing(hulls(chain, skip=middle)) as frames:
        frame = next(frames, None)
    if frame is None:
        raise SessionError(
            f"{chain.session.path}: the recording has no frame {simulation.index[middle]}"
        )
    viewpoint = _viewpoint(chain, simulation, middle, frame, size_px)
    with Painter() as painter, closing(hulls(chain)) as frames:
        for row, frame in zip(range(len(simulation.index)), frames, strict=False):
            yield _draw(chain, simulation, row, frame, viewpoint, size_px, painter)


def _viewpoint(
    chain: Chain,
    simulation: StoredSimulation,
    row: int,
    frame: FrameHull,
    size_px: tuple[int, int],
) -> Viewpoint:
    hull = frame.hull or _nothing(chain)
    objects = drawn_objects(simulation, row)
    return choose_viewpoint(hull, chain.rig, objects, aspect=size_px[0] / size_px[1])


def _draw(
    chain: Chain,
    simulation: StoredSimulation,
    row: int,
    frame: FrameHull,
    viewpoint: Viewpoint,
    size_px: tuple[int, int],
    painter: Painter | None = None,
) -> Image:
    met = [name for name, group in simulation.groups.items() if group.values["n_contacts"][row]]
    caption = f"touched: {', '.join(met)}" if met else "nothing is touched"
    if simulation.reason[row]:
        caption = f"paused: {simulation.reason[row]}"
    time_s = simulation.time_s[row]
    return draw_picture(
        frame.hull or _nothing(chain),
        chain.rig,
        drawn_objects(simulation, row),
        viewpoint=viewpoint,
        size_px=size_px,
        title=f"{chain.session.name}, frame {simulation.index[row]} ({time_s:.2f} s)",
        caption=caption,
        marks=marks_of(simulation, row),
        painter=painter,
    )


def _nothing(chain: Chain) -> Hull:
    """Return the hull of a frame that has none: of nothing."""
    views = chain.views
    return make_hull(
        views, [np.zeros((height, width), np.uint8) for width, height in views.sizes_px]
    )


def drawn_objects(simulation: StoredSimulation, row: int) -> list[DrawnObject]:
    """Return the CAD as it stood in a row: what effects move, what files move, and what stands.

    What light, shadow and proximity tell of is drawn once; each triangle that lamps shine on as
    bright as the one that reaches most of it.
    """
    shares = _shares_lit(simulation, row)
    meshes = [
        (name, vertices_world, group.shown.faces)
        for name, group in simulation.groups.items()
        if group.shown is not None
        and group.shown.faces is not None
        and not _tells_of_others(simulation, name)
        and (vertices_world := places_at(group, row)) is not None
    ]
    taken = {name for name, _, _ in meshes}
    meshes += [one for one in simulation.standing if one[0] not in taken]
    meshes += [
        (name, placed(vertices, poses[row]), faces)
        for name, vertices, faces, poses in simulation.moving
        if name not in taken and np.isfinite(poses[row]).all()
    ]
    return [
        DrawnObject(
            name,
            np.asarray(vertices_world, np.float64),
            faces,
            collides=False,
            hit_triangles=np.zeros(0, np.uint32),
            hit_points_world=np.zeros((0, 3)),
            share_lit=shares.get((name, len(faces))),
        )
        for name, vertices_world, faces in meshes
    ]


def _tells_of_others(simulation: StoredSimulation, name: str) -> bool:
    """Tell whether an effect's mesh is that of objects which stand, or which others move."""
    about = simulation.groups[name].about
    objects = {one for one in (about.get("objects") or [about.get("object")]) if one}
    placed_by_others = {one[0] for one in (*simulation.standing, *simulation.moving)}
    return bool(objects) and objects <= placed_by_others | (set(simulation.groups) - {name})


def _shares_lit(
    simulation: StoredSimulation, row: int
) -> dict[tuple[str, int], NDArray[np.floating]]:
    """Return by object and number of its triangles how much of each (T,) a lamp reaches."""
    found: dict[tuple[str, int], NDArray[np.floating]] = {}
    for group in simulation.groups.values():
        if _LIT not in group.values:
            continue
        starts = group.about["object_first_triangle"]
        parts = np.split(group.values[_LIT][row], starts[1:])
        for name, share in zip(group.about["objects"], parts, strict=True):
            key = (name, len(share))
            found[key] = np.maximum(found[key], share) if key in found else share
    return {key: share for key, share in found.items() if np.isfinite(share).all()}


def places_at(group: StoredGroup, row: int) -> NDArray[np.float64] | None:
    """Return where the vertices or points (V, 3) of an effect were in a row; None if not shown."""
    shown = group.shown
    if shown is None:
        return None
    if not shown.column:
        return shown.vertices
    values = group.values[shown.column][row]
    return values if shown.vertices is None else placed(shown.vertices, values)


def marks_of(simulation: StoredSimulation, row: int) -> Marks:
    """Return points of particles, and the ways of bodies up to a row."""
    points, paths = [np.zeros((0, 3))], []
    for group in simulation.groups.values():
        if group.shown is not None and group.shown.faces is None:
            there = places_at(group, row)
            if there is not None:
                there = there[np.isfinite(there).all(axis=1)]
                points.append(there[:: max(1, -(-len(there) // _MOST_POINTS))])
        elif "position_m" in group.values:
            paths.append(group.values["position_m"][max(0, row - _PATH_FRAMES) : row + 1])
    return Marks(np.concatenate(points).astype(np.float64), tuple(paths))
