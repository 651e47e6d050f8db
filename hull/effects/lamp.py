"""A lamp of the scene, and how much of each triangle it reaches: what light and shadow share.

Every triangle is laid into its viewport; from the lamp to each sample goes a ray. It is stopped by
CAD where that is in the frame, asked anew only where some of it has moved, and by the hull: that is
the volume query from the lamp, and the ray's way through the silhouettes is exact
(`hybridve.hull.query.segments`). Before any ray is walked, the pyramid from the lamp to the
triangle is cut into slices along its way. Those whose rectangle of pixels holds no object pixel in
some camera are passed over for all samples, and one that holds nothing else in any camera stops the
light for all.

The samples cut the triangle into equal small ones. What is told of the triangle is the mean over
the small ones of their corners: exact for what is linear between samples. Where the corners of a
small one disagree, a shadow's edge runs somewhere between them; these make up `share_unsure`.

A lamp with a radius is a ball that shines alike all over: points spread evenly on its surface, the
same for all triangles and frames. What has no shadow is as bright by them, taken together, as by
one in the middle (Newton's theorem of shells).
"""

import itertools
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from hybridve.hull.cad.distance import SurfaceDistance
from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.cad.surface_ray import WAITING, first_triangle, tree_of
from hybridve.hull.cad.surface_tree import SurfaceTree
from hybridve.hull.effects.effect import (
    VERTICES,
    Drawn,
    EffectTable,
    Entry,
    Instant,
    Placed,
    Quantity,
    Setting,
    Told,
)
from hybridve.hull.effects.still import still, vertices_columns, vertices_of
from hybridve.hull.jit import ZERO, compiled
from hybridve.hull.query.bounds import FREE, FULL, OPEN
from hybridve.hull.query.boxes import ABSTAINS, ACCEPTS, REJECTS, pixel_range, rectangle_vote
from hybridve.hull.query.frame import Frame
from hybridve.hull.query.segments import first_entry, place_segment
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.threads import Threads
from hybridve.hull.query.viewport import n_samples, sample_positions, sample_steps
from hybridve.hull.query.walk import least_stretches

#: What lies nearer to a sample than this, metres, does not shade it: it is its own triangle, or
#: one that meets it there.
_OWN_M = 1e-6

#: The thinnest slice of a pyramid, as a share of the way, and how near to a camera's own plane one
#: has no rectangle, metres.
_THINNEST, _LEAST_DEPTH_M = 2.0**-6, 1e-6

#: By how much a rectangle is grown, pixels: ten thousand times what rounding does to it.
_PAD_PX = 1e-6

#: Triangles that are worth another thread.
_MANY = 50

_Vector = tuple[float, float, float]


class LampTable(EffectTable):
    """Keys of a lamp, and of what it shines on.

    Attributes
    ----------
    lamp_mm : tuple of 3 floats
        Where it is.
    radius_mm : float
        How large; 0 for a point, whose shadows are hard.
    lamp_points : int
        Points that a lamp with a radius is made of.
    direction : tuple of 3 floats, or None
        Where it shines; None for all around.
    cone_deg : float
        How far from that direction it shines, to the rim of its cone.
    objects : tuple of str, or None
        What is told of; None for all objects that no effect moves. All objects shade.
    """

    lamp_mm: _Vector
    radius_mm: Annotated[float, Field(ge=0.0)] = 0.0
    lamp_points: Annotated[int, Field(ge=2, le=256)] = 16
    direction: _Vector | None = None
    cone_deg: Annotated[float, Field(gt=0.0, le=180.0)] = 90.0
    objects: Annotated[tuple[str, ...], Field(min_length=1)] | None = None

    @field_validator("direction")
    @classmethod
    def _has_length(cls, direction: _Vector | None) -> _Vector | None:
        if direction is not None and not any(direction):
            raise ValueError("[0, 0, 0] points nowhere; give a direction")
        return direction

    @property
    def solid_angle_sr(self) -> float:
        """Into how much of all directions it shines."""
        if self.direction is None:
            return float(4.0 * np.pi)
        return float(4.0 * np.pi * np.sin(np.radians(self.cone_deg) / 2.0) ** 2)


@dataclass(frozen=True, slots=True, eq=False)
class Lit:
    """What a lamp reaches of triangles, T of them.

    Attributes
    ----------
    share : (T,) float64
        Of the area: the share that it reaches.
    share_unsure : (T,) float64
        The share in small triangles whose corners disagree.
    gain : (T,) float64
        The mean of what reaches it, per candela: cosine over squared distance, 1 / m^2.
    """

    share: NDArray[np.float64]
    share_unsure: NDArray[np.float64]
    gain: NDArray[np.float64]


@compiled
def _slice(
    corners: NDArray[np.float64],
    lamp: NDArray[np.float64],
    near: float,
    far: float,
    frame: Frame,
) -> int:
    """Return what is proved of a slice of the pyramid from a lamp to a triangle: see `bounds`."""
    n_accept, n_abstain = 0, 0
    for camera in range(len(frame.matrices)):
        m = frame.matrices[camera]
        low_x, high_x, low_y, high_y = np.inf, -np.inf, np.inf, -np.inf
        in_front = True
        for corner in range(6):
            share = near if corner < 3 else far
            x = lamp[0] + share * (corners[corner % 3, 0] - lamp[0])
            y = lamp[1] + share * (corners[corner % 3, 1] - lamp[1])
            z = lamp[2] + share * (corners[corner % 3, 2] - lamp[2])
            depth_m = m[8] * x + m[9] * y + m[10] * z + m[11]
            if depth_m < _LEAST_DEPTH_M:
                in_front = False
                break
            pixel_x = (m[0] * x + m[1] * y + m[2] * z + m[3]) / depth_m
            pixel_y = (m[4] * x + m[5] * y + m[6] * z + m[7]) / depth_m
            low_x, high_x = min(low_x, pixel_x), max(high_x, pixel_x)
            low_y, high_y = min(low_y, pixel_y), max(high_y, pixel_y)
        if not in_front:
            continue
        width, height = frame.sizes[camera, 0], frame.sizes[camera, 1]
        first_x, last_x = pixel_range(low_x - _PAD_PX, high_x + _PAD_PX, width, ZERO)
        first_y, last_y = pixel_range(low_y - _PAD_PX, high_y + _PAD_PX, height, ZERO)
        vote = rectangle_vote(
            first_x,
            last_x,
            first_y,
            last_y,
            width,
            height,
            frame.integral_offset[camera],
            frame.integrals,
            frame.keep,
            camera,
            frame.recorded,
        )
        if vote == REJECTS:
            return FREE
        n_accept += vote == ACCEPTS
        n_abstain += vote == ABSTAINS
    is_full = n_accept + n_abstain == len(frame.matrices)
    if is_full and (not frame.keep or n_accept >= frame.min_cameras):
        return FULL
    return OPEN


@compiled
def _open_range(
    corners: NDArray[np.float64], lamp: NDArray[np.float64], frame: Frame
) -> tuple[int, float, float]:
    """Return what is proved of the way from a lamp to a triangle, and where it is open.

    `FULL` if all of its rays pass the hull, `FREE` if none does, else `OPEN`: only from so far to
    so far they may.
    """
    first, last = 1.0, 0.0
    at, size = 0.0, 1.0
    while at < 1.0:
        until = min(at + size, 1.0)
        proved = _slice(corners, lamp, at, until, frame)
        if proved == FULL:
            return FULL, 0.0, 1.0
        if proved == OPEN:
            if size > _THINNEST:
                size *= 0.5
                continue
            first, last = min(first, at), until
        at = until
        size *= 2.0
    return (OPEN if first < last else FREE), first, last


@compiled
def _reach_past_cad(
    first: int,
    stop: int,
    samples: NDArray[np.float64],
    normals: NDArray[np.float64],
    is_two_sided: NDArray[np.bool_],
    lamps: NDArray[np.float64],
    direction: NDArray[np.float64],
    cone_cosine: float,
    tree: SurfaceTree,
    reached: NDArray[np.bool_],
    gain: NDArray[np.float32],
) -> None:
    """Write which samples (T, S, 3) which lamps (L, 3) reach: (T, S, L), and their gain there.

    Of triangles `first` to `stop`. Samples lie on CAD, whose triangles have unit normals (T, 3).
    """
    waiting, way = np.zeros(WAITING, np.int64), np.zeros(3)
    for triangle in range(first, stop):
        for sample in range(samples.shape[1]):
            for lamp in range(len(lamps)):
                squared, along, facing = 0.0, 0.0, 0.0
                for axis in range(3):
                    way[axis] = samples[triangle, sample, axis] - lamps[lamp, axis]
                    squared += way[axis] * way[axis]
                    along += way[axis] * direction[axis]
                    facing -= way[axis] * normals[triangle, axis]
                length_m = np.sqrt(squared)
                if is_two_sided[triangle]:
                    facing = abs(facing)
                if facing <= 0.0 or along < cone_cosine * length_m:
                    continue
                until = 1.0 - _OWN_M / length_m
                _, found = first_triangle(lamps[lamp], way, until, tree, waiting, ZERO)
                if found < 0:
                    reached[triangle, sample, lamp] = True
                    gain[triangle, sample, lamp] = facing / (squared * length_m)


@compiled
def _reach_past_hull(
    first: int,
    stop: int,
    corners: NDArray[np.float64],
    samples: NDArray[np.float64],
    small: NDArray[np.int64],
    lamps: NDArray[np.float64],
    reached: NDArray[np.bool_],
    gain: NDArray[np.float32],
    least_m: float,
    frame: Frame,
    told: NDArray[np.float64],
) -> None:
    """Write what of triangles `first` to `stop` lamps reach past the hull, too: (T, 3) as `Lit`."""
    n_each, n_lamps = reached.shape[1], reached.shape[2]
    begin, step = np.zeros((len(frame.matrices), 3)), np.zeros((len(frame.matrices), 3))
    start, way = np.zeros(3), np.zeros(3)
    lit, bright = np.zeros(n_each), np.zeros(n_each)
    for triangle in range(first, stop):
        lit[:] = 0.0
        bright[:] = 0.0
        for lamp in range(n_lamps):
            proved, near, far = _open_range(corners[triangle], lamps[lamp], frame)
            if proved == FULL:
                continue
            for sample in range(n_each):
                if not reached[triangle, sample, lamp]:
                    continue
                if proved == OPEN:
                    squared = 0.0
                    for axis in range(3):
                        whole = samples[triangle, sample, axis] - lamps[lamp, axis]
                        start[axis] = lamps[lamp, axis] + near * whole
                        way[axis] = (far - near) * whole
                        squared += way[axis] * way[axis]
                    place_segment(start, way, frame, begin, step)
                    at, _ = first_entry(begin, step, least_m / np.sqrt(squared), frame)
                    if at < 1.0:
                        continue
                lit[sample] += 1.0 / n_lamps
                bright[sample] += gain[triangle, sample, lamp] / n_lamps
        share, unsure, mean = 0.0, 0.0, 0.0
        for number in range(len(small)):
            a, b, c = small[number]
            share += lit[a] + lit[b] + lit[c]
            mean += bright[a] + bright[b] + bright[c]
            unsure += max(lit[a], lit[b], lit[c]) - min(lit[a], lit[b], lit[c])
        told[triangle, 0] = min(share / (3.0 * len(small)), 1.0)
        told[triangle, 1] = min(unsure / len(small), 1.0)
        told[triangle, 2] = mean / (3.0 * len(small))


def small_triangles(viewport: int) -> NDArray[np.int64]:
    """Return the samples at the corners of the (viewport - 1)^2 small triangles of one, (M, 3)."""
    count = n_samples(viewport)
    i, j = sample_steps(np.full(count, viewport, np.int32), np.arange(count, dtype=np.uint32))
    number = {(int(a), int(b)): k for k, (a, b) in enumerate(zip(i, j, strict=True))}
    small = []
    for (a, b), k in number.items():
        if (a + 1, b) in number:
            small.append((k, number[a + 1, b], number[a, b + 1]))
        if (a + 1, b + 1) in number:
            small.append((number[a + 1, b], number[a + 1, b + 1], number[a, b + 1]))
    return np.array(small, np.int64)


def points_on_ball(count: int) -> NDArray[np.float64]:
    """Return points (N, 3) spread evenly on the unit sphere: a spiral by the golden angle."""
    number = np.arange(count) + 0.5
    height = 1.0 - 2.0 * number / count
    turn = np.pi * (1.0 + np.sqrt(5.0)) * number
    around = np.sqrt(1.0 - height**2)
    return np.column_stack([around * np.cos(turn), around * np.sin(turn), height])


class Lamp:
    """The lamp of one entry, and the triangles that it shines on.

    Parameters
    ----------
    entry : Entry
        With a `LampTable`.
    setting : Setting
        Its objects shade; a viewport below 2 counts as 2.
    threads : Threads
        Do the work.

    Attributes
    ----------
    objects : tuple of SceneObject
        What is told of.
    moves : bool
        Whether any of these does.
    first : (K + 1,) int64
        Where the triangles of each object begin among all.
    areas_m2 : (T,) float64
        Of the triangles, where they were put last.
    share_without : (T,) float64
        The share of each triangle that it reaches where nothing real is, likewise.

    Raises
    ------
    SceneError
        If an object does not exist, or the lamp is inside of a solid that stands.
    """

    def __init__(self, entry: Entry, setting: Setting, threads: Threads) -> None:
        table: LampTable = entry.table
        self._threads = threads
        self.objects = _objects(entry, setting)
        self.moves = any(setting.moves(one) for one in self.objects)
        self.first = np.cumsum([0] + [len(one.faces) for one in self.objects])
        lamp_world = np.array(table.lamp_mm) / 1000.0
        self._scene = setting.scene.objects
        for one in self._scene:
            if not setting.moves(one):
                _refuse_inside(entry, one, lamp_world)
        self._origin_world = setting.views.origin_world
        self._lamps = lamp_world[None] - self._origin_world
        if table.radius_mm > 0:
            ball = points_on_ball(table.lamp_points)
            self._lamps = self._lamps + table.radius_mm / 1000.0 * ball
        self._viewport = max(setting.viewport, 2)
        self._small = small_triangles(self._viewport)
        self._direction, self._cosine = np.zeros(3), -1.0
        if table.direction is not None:
            self._direction = np.array(table.direction) / np.linalg.norm(table.direction)
            self._cosine = float(np.cos(np.radians(table.cone_deg)))
        self._placed: Mapping[str, Placed] = {}
        self._put()

    def see_objects(self, placed: Mapping[str, Placed]) -> None:
        """Put objects where they are; what moved nowhere costs nothing."""
        is_same = self._placed.keys() == placed.keys() and all(
            np.array_equal(one.vertices_world, self._placed[name].vertices_world)
            for name, one in placed.items()
        )
        if not is_same:
            self._placed = placed
            self._put()

    def vertices(self) -> NDArray[np.float64]:
        """Return where the vertices of its objects are, (V, 3) metres."""
        return np.concatenate([vertices_of(one, self._placed) for one in self.objects])

    def _put(self) -> None:
        """Ask which samples the lamp reaches past CAD, where that is now."""
        origin_world = self._origin_world
        self._corners = np.concatenate(
            [vertices_of(one, self._placed)[one.faces] - origin_world for one in self.objects]
        )
        sides = np.cross(
            self._corners[:, 1] - self._corners[:, 0], self._corners[:, 2] - self._corners[:, 0]
        )
        twice_m2 = np.linalg.norm(sides, axis=1)
        self.areas_m2 = twice_m2 / 2.0
        normals = sides / np.where(twice_m2 > 0, twice_m2, 1.0)[:, None]
        outward = np.array([-1.0 if one.about.get("inside_out") else 1.0 for one in self.objects])
        owner = np.repeat(np.arange(len(self.objects)), np.diff(self.first))
        normals *= outward[owner][:, None]
        is_two_sided = np.array([not one.is_closed for one in self.objects])[owner]
        count, n_triangles = n_samples(self._viewport), len(self._corners)
        self._samples = sample_positions(
            np.repeat(self._corners, count, axis=0),
            np.full(n_triangles * count, self._viewport, np.int32),
            np.tile(np.arange(count, dtype=np.uint32), n_triangles),
        ).reshape(n_triangles, count, 3)
        shading = [vertices_of(one, self._placed)[one.faces] - origin_world for one in self._scene]
        shape = (n_triangles, count, len(self._lamps))
        self._reached, self._gain = np.zeros(shape, np.bool_), np.zeros(shape, np.float32)
        tree = tree_of(np.concatenate(shading))
        self._threads.run(
            [
                (
                    _reach_past_cad,
                    (
                        first,
                        stop,
                        self._samples,
                        normals,
                        is_two_sided,
                        self._lamps,
                        self._direction,
                        self._cosine,
                        tree,
                        self._reached,
                        self._gain,
                    ),
                )
                for first, stop in self._shares()
            ]
        )
        lit = self._reached.mean(axis=2)[:, self._small].mean(axis=(1, 2))
        self.share_without = np.asarray(lit, np.float64)

    def reach(self, hull: Hull) -> Lit:
        """Return what it reaches past CAD and a hull."""
        views = hull.views
        lamp_world = self._lamps[:1] + views.origin_world
        least_m = float(least_stretches(views, lamp_world)[0])
        told = np.zeros((len(self._corners), 3))
        self._threads.run(
            [
                (
                    _reach_past_hull,
                    (
                        first,
                        stop,
                        self._corners,
                        self._samples,
                        self._small,
                        self._lamps,
                        self._reached,
                        self._gain,
                        least_m,
                        hull.frame,
                        told,
                    ),
                )
                for first, stop in self._shares()
            ]
        )
        return Lit(told[:, 0], told[:, 1], told[:, 2])

    def _shares(self) -> list[tuple[int, int]]:
        """Return from which triangle to which each call of a thread goes."""
        count = len(self._corners)
        n_shares = min(self._threads.n_shares, max(count // _MANY, 1))
        ends = np.linspace(0, count, n_shares + 1).astype(np.int64)
        return list(itertools.pairwise(ends))

    def by_object(self, shares: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the area of each object, (K,) m^2, that shares (T,) of its triangles make up."""
        return np.add.reduceat(shares * self.areas_m2, self.first[:-1])

    def drawn(self, *cell_columns: str) -> Drawn:
        """Return the objects as one mesh, with numbers for its triangles."""
        before = np.cumsum([0] + [len(one.vertices_world) for one in self.objects])
        faces = np.concatenate(
            [one.faces + start for one, start in zip(self.objects, before[:-1], strict=True)]
        ).astype(np.int32)
        if self.moves:
            return Drawn(VERTICES, None, faces, cell_columns)
        return Drawn("", self.vertices(), faces, cell_columns)


def _objects(entry: Entry, setting: Setting) -> tuple[SceneObject, ...]:
    table: LampTable = entry.table
    if table.objects is None:
        if not setting.obstacles:
            raise entry.error("effects move all objects; name in `objects` on which it shines")
        return setting.obstacles
    found: list[SceneObject] = []
    for name in table.objects:
        one = setting.object_of(entry, name, "objects")
        if one in found:
            raise entry.error(f"{name!r} is named twice", "objects")
        found.append(one)
    return tuple(found)


def _refuse_inside(entry: Entry, one: SceneObject, lamp_world: NDArray[np.float64]) -> None:
    """Refuse a lamp that is inside of a solid, where it reaches nothing outside."""
    low, high = one.box_world
    if not one.is_closed or (lamp_world < low).any() or (lamp_world > high).any():
        return
    middle = (low + high) / 2.0
    surface = SurfaceDistance(
        one.vertices_world - middle, one.faces, is_closed=True, solid_faces=one.solid_faces
    )
    if surface.winding(lamp_world[None] - middle)[0] != 0:
        raise entry.error(
            f"the lamp is inside of {one.name!r}, a closed solid that lets no light out; move it",
            "lamp_mm",
        )


def columns_of(lamp: Lamp) -> tuple[Quantity, ...]:
    """Return the columns that light and shadow share."""
    count, n_objects = len(lamp.areas_m2), len(lamp.objects)
    return (
        *vertices_columns(len(lamp.vertices()) if lamp.moves else 0),
        Quantity(
            "share_lit",
            "1",
            "sampled",
            "the share of each triangle that the lamp reaches past real things and CAD",
            (count,),
            np.float32,
        ),
        Quantity(
            "share_unsure",
            "1",
            "sampled",
            "the share of each triangle between samples of which the lamp reaches some: what a "
            "finer viewport would tell better",
            (count,),
            np.float32,
        ),
        Quantity(
            "lit_m2", "m2", "sampled", "the area of each object that it reaches", (n_objects,)
        ),
        Quantity(
            "shaded_m2",
            "m2",
            "sampled",
            "the area of each object that real things alone keep it from",
            (n_objects,),
        ),
    )


def values_of(lamp: Lamp, lit: Lit) -> dict[str, NDArray[Any]]:
    """Return the values of the columns that light and shadow share."""
    lit_m2 = lamp.by_object(lit.share)
    return {
        **still(),
        **({VERTICES: lamp.vertices()} if lamp.moves else {}),
        "share_lit": lit.share.astype(np.float32),
        "share_unsure": lit.share_unsure.astype(np.float32),
        "lit_m2": lit_m2,
        "shaded_m2": np.maximum(lamp.by_object(lamp.share_without) - lit_m2, 0.0),
    }


def about_of(lamp: Lamp, entry: Entry) -> dict[str, Any]:
    """Return what light and shadow were resolved to."""
    return {
        **entry.table.model_dump(mode="json"),
        "objects": [one.name for one in lamp.objects],
        "object_first_triangle": lamp.first[:-1].tolist(),
    }


class Lamps(ABC):
    """The lamps of all entries of a kind; an `Effect` but for what is told and how it is called.

    And an `Onlooker`. The hull is looked at once a frame: nothing goes on in between.
    """

    def __init__(
        self, entries: Sequence[Entry], setting: Setting, threads: Threads | None = None
    ) -> None:
        threads = threads or Threads()
        self.lamps = {entry.name: Lamp(entry, setting, threads) for entry in entries}
        self.tables = {entry.name: entry.table for entry in entries}
        self.told: Mapping[str, Told] = {
            entry.name: self._tell(self.lamps[entry.name], entry) for entry in entries
        }

    @abstractmethod
    def _tell(self, lamp: Lamp, entry: Entry) -> Told:
        """Return what will be told of one entry."""

    @abstractmethod
    def _values(self, name: str, lit: Lit) -> dict[str, NDArray[Any]]:
        """Return the values of what is told of one entry."""

    def advance(self, instant: Instant, step_s: float) -> None:  # noqa: B027  # light takes no time
        """Do nothing."""

    def see_objects(self, placed: Mapping[str, Placed]) -> None:
        """Take note of where objects are in the frame that is told next."""
        for lamp in self.lamps.values():
            lamp.see_objects(placed)

    def values(self, hull: Hull | None) -> Mapping[str, Mapping[str, NDArray[Any]]]:
        """Return by entry and column what the lamps reach in a frame; NaN where it has no hull."""
        if hull is None:
            return {
                name: {
                    **still(),
                    **{one.name: np.full(one.shape, np.nan, one.dtype) for one in told.columns},
                    **({VERTICES: self.lamps[name].vertices()} if self.lamps[name].moves else {}),
                }
                for name, told in self.told.items()
            }
        return {name: self._values(name, lamp.reach(hull)) for name, lamp in self.lamps.items()}

    def state(self) -> Mapping[str, NDArray[Any]]:
        """Return nothing: each frame is told for itself."""
        return {}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from nothing."""
        if state:
            raise ValueError(f"lamps have no state, found {sorted(state)}")
