"""How near real things come to objects, how long, and what each triangle gets of it.

Zones: the clearance of each object lies between two bounds that are certain
(`hybridve.hull.contact.clearance`), frame after frame. A zone of 20 mm is *surely* entered where
the upper bound is within it, *possibly* where the lower one is. Between two frames the clearance is
taken to lie between theirs: time counts as surely spent in a zone if both ends are surely in it,
as possibly if either possibly is. So the time lies between the two, for whatever comes and goes
more slowly than from frame to frame. A gap in the recording counts for neither.

Exposure: a triangle takes in f(d), d being the distance of its middle from the hull's nearest
point, f the falloff; its time integral is the exposure, in seconds at full strength. Space near the
object is cut into cubes (`ClearanceMeter.near_cells`): every point of the hull that is so near is
in one of them, and the middles of some are in the hull. So d is at least the distance of the
nearest cube's middle less half its diagonal, and at most that of the nearest middle in the hull:
bounds, as wide as the cubes are large. Twice as far away they are twice as large.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator

from hybridve.hull.cad.surface_tree import SurfaceTree, closest_on_surface, make_tree
from hybridve.hull.contact.clearance import Clearance, ClearanceMeter
from hybridve.hull.effects.effect import (
    VERTICES,
    Drawn,
    EffectKind,
    EffectTable,
    Entry,
    Instant,
    Placed,
    Quantity,
    Setting,
    Told,
)
from hybridve.hull.effects.still import still, vertices_columns, vertices_of
from hybridve.hull.query.points import are_inside
from hybridve.hull.query.silhouettes import Hull

#: Cubes at most; larger ones serve where there were more. And how far beyond the clearance, in
#: cubes, the smallest ones reach.
_MOST_CELLS, _FINE_CELLS = 50_000, 8.0

#: How far, in ranges, cubes are looked at: beyond, an inverse square has left 1/400 of its strength
#: and an exponential 1/50 000 000.
_RANGES = {"inverse_square": 20.0, "exponential": 18.0, "linear": 1.0}

#: How far rounding may move a distance of a cube, metres.
_ROUNDING_M = 1e-9


class _Falloff(BaseModel):
    """How strong an object is felt, or feels, at a distance d, with a range r.

    "inverse_square": 1 up to r, then (r / d)^2. "exponential": exp(-d / r). "linear": 1 - d / r, 0
    from r on. All are 1 at no distance.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    kind: Literal["inverse_square", "exponential", "linear"]
    range_mm: Annotated[float, Field(gt=0.0)]

    @property
    def range_m(self) -> float:
        """The range in metres."""
        return self.range_mm / 1000.0

    def strength(self, distance_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the strength at distances, infinite ones too."""
        if self.kind == "inverse_square":
            return np.asarray((self.range_m / np.maximum(distance_m, self.range_m)) ** 2)
        if self.kind == "exponential":
            return np.asarray(np.exp(-distance_m / self.range_m))
        return np.asarray(np.maximum(1.0 - distance_m / self.range_m, 0.0))


class ProximityTable(EffectTable):
    """Keys of ``kind = "proximity"``.

    Attributes
    ----------
    object : str
        What real things come near to.
    zones_mm : tuple of floats
        How near, the outermost zone first.
    falloff : table or None
        How strength falls off with distance, for an exposure; None for no exposure.
    resolution_mm : float
        The largest cube that an exposure is bounded with, where the hull is nearest.
    tolerance_mm : float
        How far apart the bounds of the clearance may be.
    """

    object: str
    zones_mm: Annotated[tuple[Annotated[float, Field(gt=0.0)], ...], Field(min_length=1)]
    falloff: _Falloff | None = None
    resolution_mm: Annotated[float, Field(ge=0.1)] = 10.0
    tolerance_mm: Annotated[float, Field(ge=0.001)] = 0.1

    @field_validator("zones_mm")
    @classmethod
    def _descend(cls, zones_mm: tuple[float, ...]) -> tuple[float, ...]:
        if any(inner >= outer for outer, inner in itertools.pairwise(zones_mm)):
            raise ValueError(
                f"{list(zones_mm)} does not descend; give the outermost zone first, each once"
            )
        return zones_mm

    @property
    def default_name(self) -> str:
        """As the object: it is not moved, but it is what is told of."""
        return f"{self.object}.proximity"


class _Watch:
    """The object of one entry, and what was gathered of it."""

    def __init__(self, entry: Entry, setting: Setting) -> None:
        table: ProximityTable = entry.table
        self._object = one = setting.object_of(entry, table.object)
        self._moves = setting.moves(one)
        self._falloff = table.falloff
        self._zones_m = np.array(table.zones_mm) / 1000.0
        self._cell_m = table.resolution_mm / 1000.0
        self._tolerance_m = table.tolerance_mm / 1000.0
        self._vertices = one.vertices_world
        self._meter = self._meter_at_rest = self._meter_of(one.vertices_world)
        self._middles = one.vertices_world[one.faces].mean(axis=1)
        count, n_zones = len(one.faces), len(self._zones_m)
        n_exposed = count if self._falloff is not None else 0
        #: All that was gathered, by name; arrays of lower and upper bounds.
        self.state: dict[str, NDArray[Any]] = {
            "time_in_zone_s": np.zeros((n_zones, 2)),
            "stay_s": np.zeros((n_zones, 2)),
            "exposure_s": np.zeros((n_exposed, 2)),
            # At the frame before: what is not known lies between none and all.
            "was_in": np.zeros((n_zones, 2), np.bool_),
            "strength": np.zeros((n_exposed, 2)),
        }
        cell_columns = ("exposure_s",) if n_exposed else ()
        drawn = Drawn("", one.vertices_world, one.faces, cell_columns)
        if self._moves:
            drawn = Drawn(VERTICES, None, one.faces, cell_columns)
        columns = (
            *vertices_columns(len(one.vertices_world) if self._moves else 0),
            *_columns(n_zones, n_exposed),
        )
        self.told = Told(columns, drawn, about=entry.table.model_dump(mode="json"))

    def _meter_of(self, vertices_world: NDArray[np.float64]) -> ClearanceMeter:
        one = self._object
        return ClearanceMeter(
            vertices_world,
            one.faces,
            is_closed=one.is_closed,
            tolerance_m=self._tolerance_m,
            solid_faces=one.solid_faces,
        )

    def see_objects(self, placed: Mapping[str, Placed]) -> None:
        """Take note of where the object is; what is known of its distances goes with it."""
        there = placed.get(self._object.name)
        if there is None:
            return
        self._vertices = vertices_of(self._object, placed)
        self._middles = self._vertices[self._object.faces].mean(axis=1)
        if there.world_from_rest is None:
            self._meter = self._meter_of(self._vertices)
        else:
            self._meter = self._meter_at_rest.at(there.world_from_rest)

    def look(self, hull: Hull, elapsed_s: float, is_known: bool) -> dict[str, NDArray[Any]]:
        """Take in a frame, so long after what was known before; return what is told then."""
        state = self.state
        clearance = self._meter.measure(hull)
        bounds_m = np.array([clearance.lower_m, clearance.upper_m])
        # Surely in by the upper bound, possibly by the lower.
        is_in = bounds_m[::-1] <= self._zones_m[:, None]
        before = state["was_in"]
        spent_s = np.zeros((len(self._zones_m), 2))
        if is_known:
            spent_s[:, 0] = elapsed_s * (before[:, 0] & is_in[:, 0])
            spent_s[:, 1] = elapsed_s * (before[:, 1] | is_in[:, 1])
        state["time_in_zone_s"] += spent_s
        stay_s = np.where(is_in, state["stay_s"] + spent_s, 0.0)
        state["stay_s"][:] = np.where(is_known, stay_s, 0.0)
        state["was_in"][:] = is_in
        if self._falloff is not None:
            strength = self._falloff.strength(self._distances(hull, clearance))[:, ::-1]
            if is_known:
                both = np.stack([state["strength"], strength])
                state["exposure_s"][:, 0] += elapsed_s * both[..., 0].min(axis=0)
                state["exposure_s"][:, 1] += elapsed_s * both[..., 1].max(axis=0)
            state["strength"][:] = strength
        return self._told(bounds_m, is_in)

    def pause(self) -> dict[str, NDArray[Any]]:
        """Return what is told where there is no hull: nothing surely, everything possibly."""
        nowhere = np.tile([False, True], (len(self._zones_m), 1))
        return self._told(np.array([0.0, np.inf]), nowhere)

    def _told(
        self, bounds_m: NDArray[np.float64], is_in: NDArray[np.bool_]
    ) -> dict[str, NDArray[Any]]:
        state = self.state
        told: dict[str, NDArray[Any]] = {
            **({VERTICES: self._vertices} if self._moves else {}),
            "clearance_m": bounds_m,
            "is_in_zone": is_in.astype(np.uint8),
            "time_in_zone_s": state["time_in_zone_s"].copy(),
            "stay_s": state["stay_s"].copy(),
        }
        if self._falloff is not None:
            told |= {
                "exposure_lower_s": state["exposure_s"][:, 0].copy(),
                "exposure_s": state["exposure_s"].mean(axis=1),
                "exposure_upper_s": state["exposure_s"][:, 1].copy(),
            }
        return {**still(), **told}

    def _distances(self, hull: Hull, clearance: Clearance) -> NDArray[np.float64]:
        """Return bounds (T, 2) of how far the hull is from the middle of each triangle, metres."""
        falloff, middles = self._falloff, self._middles
        bounds_m = np.full((len(middles), 2), np.inf)
        if falloff is None:
            return bounds_m
        within_m = _RANGES[falloff.kind] * falloff.range_m
        # What is not looked at is farther from the object, and farther from all of its triangles.
        bounds_m[:, 0] = max(within_m, clearance.lower_m)
        if clearance.upper_m == np.inf:
            bounds_m[:, 0] = clearance.lower_m
            return bounds_m
        witness_m = np.linalg.norm(middles - clearance.on_hull_world, axis=1)
        bounds_m[:, 1] = witness_m + _ROUNDING_M
        # Near the object cubes are small. Farther out they are larger, and only there they count:
        # what of the hull is in none of the smaller ones is at least as far as these were looked
        # for.
        looked_m, cell_m = 0.0, self._cell_m
        look_m = clearance.upper_m + _FINE_CELLS * cell_m
        lower_m = bounds_m[:, 0].copy()
        while looked_m < within_m:
            look_m = min(look_m, within_m)
            cells = self._meter.near_cells(hull, look_m, cell_m, _MOST_CELLS)
            center = np.ascontiguousarray(cells.center_world)
            if len(center):
                nearest_m = closest_on_surface(middles, _tree_of_points(center))[0]
                nearest_m -= np.sqrt(3.0) * cells.half_m + _ROUNDING_M
                lower_m = np.minimum(lower_m, np.maximum(nearest_m, looked_m))
                inside = center[are_inside(center, -hull.views.origin_world, hull.frame)]
                if len(inside):
                    nearest_m = closest_on_surface(middles, _tree_of_points(inside))[0]
                    bounds_m[:, 1] = np.minimum(bounds_m[:, 1], nearest_m + _ROUNDING_M)
            looked_m, look_m, cell_m = look_m, 2.0 * look_m, 2.0 * cell_m
        bounds_m[:, 0] = np.maximum(lower_m, clearance.lower_m)
        return bounds_m


def _tree_of_points(points: NDArray[np.float64]) -> SurfaceTree:
    """Return the tree of points (N, 3): triangles whose corners meet."""
    corners = np.repeat(points[:, None], 3, axis=1)
    return make_tree(corners, corners)


def _columns(n_zones: int, n_exposed: int) -> tuple[Quantity, ...]:
    columns = (
        Quantity(
            "clearance_m",
            "m",
            "bound",
            "lower and upper bound of how far real things are; inf where nothing real is",
            (2,),
        ),
        Quantity(
            "is_in_zone",
            "1",
            "bound",
            "whether something real is surely, and possibly, in each zone",
            (n_zones, 2),
            np.uint8,
        ),
        Quantity(
            "time_in_zone_s",
            "s",
            "bound",
            "how long something real was surely, and possibly, in each zone so far, what comes and "
            "goes between two frames left out",
            (n_zones, 2),
        ),
        Quantity(
            "stay_s",
            "s",
            "bound",
            "how long it has been there without having surely, or possibly, left",
            (n_zones, 2),
        ),
    )
    if n_exposed == 0:
        return columns
    said = "the time integral of the falloff at the middle of each triangle"
    return (
        *columns,
        Quantity("exposure_lower_s", "s", "bound", f"{said}: at least", (n_exposed,)),
        Quantity(
            "exposure_s", "s", "estimate", f"{said}: halfway between its bounds", (n_exposed,)
        ),
        Quantity("exposure_upper_s", "s", "bound", f"{said}: at most", (n_exposed,)),
    )


class Proximity:
    """All that is watched in a scene; an `Effect` and `Onlooker`.

    The hull is looked at once a frame.
    """

    def __init__(self, entries: Sequence[Entry], setting: Setting) -> None:
        self._watches = {entry.name: _Watch(entry, setting) for entry in entries}
        self.told: Mapping[str, Told] = {name: one.told for name, one in self._watches.items()}
        #: How long since the frame before, and whether all of that is known.
        self._gone = np.zeros(2)

    def advance(self, instant: Instant, step_s: float) -> None:
        """Take note of the time that goes by, and whether it is known what was before."""
        self._gone[0] += step_s
        if instant.before is None:
            self._gone[1] = 1.0

    def see_objects(self, placed: Mapping[str, Placed]) -> None:
        """Take note of where objects are in the frame that is told next."""
        for one in self._watches.values():
            one.see_objects(placed)

    def values(self, hull: Hull | None) -> Mapping[str, Mapping[str, NDArray[Any]]]:
        """Return by entry and column what stands at the end of a frame."""
        if hull is None:
            return {name: one.pause() for name, one in self._watches.items()}
        elapsed_s, is_unknown = self._gone
        told = {
            name: one.look(hull, float(elapsed_s), not is_unknown)
            for name, one in self._watches.items()
        }
        self._gone[:] = 0.0
        return told

    def state(self) -> Mapping[str, NDArray[Any]]:
        """Return all that decides how it goes on."""
        gathered = {
            f"{name}/{key}": array.copy()
            for name, one in self._watches.items()
            for key, array in one.state.items()
        }
        return gathered | {"gone": self._gone.copy()}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from a state."""
        self._gone[:] = state["gone"]
        for name, one in self._watches.items():
            for key, array in one.state.items():
                array[:] = state[f"{name}/{key}"]


KIND = EffectKind("proximity", ProximityTable, Proximity)
