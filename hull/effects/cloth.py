"""The effect "cloth": a sheet of the scene hangs, swings, and is pushed aside by real things.

What a sheet is made of and how it moves stands in `hybridve.hull.effects.cloth_model`. It leans on
the CAD that no effect moves (`hybridve.hull.effects.keep_off`) and, where it did before, on the
hull. After each step it is moved out of the hull (`hybridve.hull.effects.push_out`): all samples of
all its triangles are volume-queried, those inside moved out, and asked again, until none is deeper
than `_LEFT_M`. The hull has the last word.

A sheet does not feel itself.
"""

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from hybridve.hull.effects.cloth_model import (
    Contacts,
    Welded,
    highest_frequency,
    joined_contacts,
    kinetic_of,
    longest_step,
    make_springs,
    move_on,
    no_contacts,
    node_masses,
    potential_of,
    triangle_areas,
    weld,
    why_no_sheet,
)
from hybridve.hull.effects.effect import (
    CAD_WORK,
    GRAVITY_M_S2,
    Drawn,
    EffectKind,
    EffectTable,
    Entry,
    Instant,
    Quantity,
    Setting,
    Told,
    UnstableError,
)
from hybridve.hull.effects.keep_off import Obstacle
from hybridve.hull.effects.push_out import LEAST_FREE, may_meet, push_hits, renew, touch
from hybridve.hull.query.clusters import spatial_order
from hybridve.hull.query.engine import MAX_COORDINATE_M, Triangles
from hybridve.hull.query.silhouettes import Hull

#: What may be left of a sample in the hull after a step, metres.
_LEFT_M = 5e-4

#: How often samples are moved by their weights; then whole triangles; then all the same way, which
#: no two parts of the hull can undo for each other.
_BY_WEIGHT, _WHOLE, _ONE_WAY = 6, 6, 200

#: No real thing is faster, metres a second; and none is looked for farther back, metres.
_FASTEST_M_S, _FARTHEST_M = 10.0, 0.3

#: CAD is felt by what may come nearer to it in a step than this beyond what it goes, metres.
_NEAR_M = 1e-3

#: A node remembers for so long on which side of a real thing it was, seconds.
_REMEMBERED_S = 0.1

#: Into how many steps of its own a sheet may cut one.
_MOST_STEPS = 50

#: Nodes no farther below the highest than this share of the sheet's height hang from "top".
_TOP = 1e-3

#: Free motion may not change the energy of motion and springs by more than this share in one step.
_GROWTH = 0.5

_Point = tuple[float, float, float]
_Box = tuple[float, float, float, float, float, float]
_Positive = Annotated[float, Field(gt=0)]
_NotNegative = Annotated[float, Field(ge=0)]


class ClothTable(EffectTable):
    """The keys of a cloth.

    Attributes
    ----------
    object : str
        The sheet: an open mesh, at rest as it stands in the scene.
    areal_density_kg_m2, mass_kg : float or None
        What it weighs; one of them, by default 0.2 kg a square metre.
    pin : "top", "none", or list of points and boxes
        What does not move: the nodes at the top; none; those nearest to points [x, y, z], and those
        in boxes [x, y, z, x, y, z] from corner to corner, millimetres, world.
    stretch_n_m : float
        Tension per width and strain, newtons a metre.
    bending_uj : float
        Moment per width and curvature, microjoules (micronewton metres).
    damping_per_s : float
        The share of its speed that the air takes, a second.
    inner_damping : float
        Of springs and bends, as a share of what is critical to the stiffest mode.
    thickness_mm : float
        It keeps off other CAD by half of it.
    friction : float
        Coulomb's, on other CAD and on real things.
    recovery : "direction", "nearest" or None
        How it gets out of real things: along the object's `recovery_direction`, or the shortest
        way; by default the first where the object has one.
    """

    object: str
    areal_density_kg_m2: _Positive | None = None
    mass_kg: _Positive | None = None
    pin: Literal["top", "none"] | Annotated[list[_Point | _Box], Field(min_length=1)] = "top"
    stretch_n_m: _Positive = 500.0
    bending_uj: _NotNegative = 20.0
    damping_per_s: _NotNegative = 0.5
    inner_damping: Annotated[float, Field(ge=0, le=1)] = 0.1
    thickness_mm: _NotNegative = 2.0
    friction: _NotNegative = 0.2
    recovery: Literal["direction", "nearest"] | None = None

    @model_validator(mode="after")
    def _one_weight(self) -> "ClothTable":
        if self.areal_density_kg_m2 is not None and self.mass_kg is not None:
            raise ValueError("give areal_density_kg_m2 or mass_kg, not both")
        return self

    @property
    def claimed(self) -> tuple[str, ...]:
        """The sheet."""
        return (self.object,)


class Cloths:
    """All sheets of a scene; see `hybridve.hull.effects.effect.Effect`."""

    def __init__(self, entries: Sequence[Entry], setting: Setting) -> None:
        self._sheets = {entry.name: _Sheet(entry, setting) for entry in entries}
        self.told: Mapping[str, Told] = {name: one.told for name, one in self._sheets.items()}

    def advance(self, instant: Instant, step_s: float) -> None:
        """Go on by one step."""
        for sheet in self._sheets.values():
            sheet.advance(instant, step_s)

    def values(self, hull: Hull | None) -> Mapping[str, Mapping[str, NDArray[Any]]]:  # noqa: ARG002
        """Return what stands at the end of a frame."""
        return {name: sheet.values() for name, sheet in self._sheets.items()}

    def state(self) -> Mapping[str, NDArray[Any]]:
        """Return all that decides how it goes on."""
        return {
            f"{name}.{key}": array.copy()
            for name, sheet in self._sheets.items()
            for key, array in sheet.state.items()
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from what `state` gave."""
        for name, sheet in self._sheets.items():
            for key, array in sheet.state.items():
                array[:] = state[f"{name}.{key}"]
            sheet.forget()


class _Sheet:
    """One sheet. `state` holds the arrays that decide how it goes on; they are changed in place."""

    def __init__(self, entry: Entry, setting: Setting) -> None:
        table: ClothTable = entry.table
        thing = setting.object_of(entry, table.object)
        given = thing.vertices_world if thing.vertices_mesh is None else thing.vertices_mesh
        self._entry, self._engine = entry, setting.engine
        self._mesh_vertices = thing.vertices_world
        self._welded = welded = weld(thing.vertices_world, thing.faces, given)
        nodes, faces = welded.nodes_world, welded.faces
        reason = why_no_sheet(nodes, faces)
        if reason:
            raise entry.error(f"{table.object!r} is no sheet: {reason}", "object")
        self._constrained = np.zeros(3)
        recovery = table.recovery
        if recovery != "nearest" and thing.recovery_direction is not None:
            recovery, self._constrained = "direction", np.array(thing.recovery_direction)
        elif recovery == "direction":
            raise entry.error(
                f"{table.object!r} has no recovery_direction to be pushed along; give the object "
                'one, or recovery = "nearest"',
                "recovery",
            )
        area_m2 = float(triangle_areas(nodes, faces).sum())
        density = table.areal_density_kg_m2 or 0.2
        if table.mass_kg is not None:
            density = table.mass_kg / area_m2
        self._masses = node_masses(nodes, faces, density)
        is_pinned = _pinned(entry, welded)
        if is_pinned.all():
            raise entry.error(
                f"all {len(nodes)} nodes of {table.object!r} are pinned; leave some free", "pin"
            )
        self._inverse_mass = np.where(is_pinned, 0.0, 1.0 / self._masses)
        self._springs = make_springs(nodes, faces, table.stretch_n_m, 1e-6 * table.bending_uj)
        frequency = highest_frequency(self._springs, self._inverse_mass)
        self._inner_s = 2.0 * table.inner_damping / frequency
        self._longest_s = longest_step(frequency, self._inner_s)
        if setting.step_s > _MOST_STEPS * self._longest_s:
            lightest = int(np.where(is_pinned, np.inf, self._masses).argmin())
            raise entry.error(
                f"steps of {1e3 * setting.step_s:g} ms are too long for {table.stretch_n_m:g} N/m "
                f"between nodes of {self._masses[lightest]:.3g} kg: they bear "
                f"{1e3 * _MOST_STEPS * self._longest_s:.3g} ms at most; shorten the step or lower "
                "stretch_n_m",
                "stretch_n_m",
            )
        self._friction, self._drag_per_s = table.friction, table.damping_per_s
        off_m = table.thickness_mm / 2000.0
        self._obstacles = [
            Obstacle(one, self._springs.ends, len(nodes), off_m) for one in setting.obstacles
        ]
        order = spatial_order(nodes, faces)
        viewports = np.full(len(faces), setting.viewport, np.int32)
        self._triangles = Triangles(nodes, faces[order], viewports)
        self._start_j = potential_of(nodes, self._masses, self._springs, GRAVITY_M_S2)
        self.state: dict[str, NDArray[Any]] = {
            "nodes_world": nodes.copy(),
            "velocities": np.zeros_like(nodes),
            "side": np.zeros_like(nodes),
            "side_age_s": np.zeros(len(nodes)),
            "contact_sample": np.full((len(faces), 3), -1, np.int64),
            "contact_way": np.zeros((len(faces), 3, 3)),
            "hull_work_j": np.zeros(1),
            "cad_work_j": np.zeros(1),
            "penetration_m": np.zeros(1),
            "n_contacts": np.zeros(1, np.int64),
            "n_held": np.zeros(1, np.int64),
        }
        steps = self._n_steps(setting.step_s)
        self.told = Told(
            columns=(
                Quantity(
                    "vertices_m",
                    "m",
                    "exact",
                    "vertices of the sheet, of the simulated state",
                    shape=(len(self._mesh_vertices), 3),
                    is_place=True,
                ),
                Quantity(
                    "displacement_m",
                    "m",
                    "exact",
                    "how far the vertex that is farthest from its place at rest is from there",
                ),
                Quantity(
                    "n_held",
                    "1",
                    "sampled",
                    "samples in the hull after the last step that stay there, as a pinned corner "
                    f"of their triangle is in it, or more than {1 - LEAST_FREE:g} of their weight "
                    "is on pinned corners; penetration_m leaves them out",
                    dtype=np.uint32,
                ),
                CAD_WORK,
            ),
            drawn=Drawn("vertices_m", faces=thing.faces),
            about={
                "object": table.object,
                "nodes": len(nodes),
                "triangles": len(faces),
                "pinned_nodes": int(is_pinned.sum()),
                "mass_kg": float(self._masses.sum()),
                "areal_density_kg_m2": density,
                "recovery": recovery or "nearest",
                "recovery_direction": self._constrained.tolist(),
                "steps_within_a_step": steps,
                "longest_step_s": self._longest_s,
                "obstacles": [one.name for one in setting.obstacles],
            },
        )

    def forget(self) -> None:
        """Trust no distance that was measured: the nodes may be elsewhere."""
        for obstacle in self._obstacles:
            obstacle.forget()

    def values(self) -> dict[str, NDArray[Any]]:
        """Return `COMMON` and the own columns; begin to count anew."""
        x, state = self.state["nodes_world"], self.state
        vertices = self._mesh_vertices.copy()
        is_used = self._welded.node_of_vertex >= 0
        vertices[is_used] = x[self._welded.node_of_vertex[is_used]]
        moved_m = np.linalg.norm(x - self._welded.nodes_world, axis=1)
        kinetic_j, potential_j = self._energies()
        found: dict[str, Any] = {
            "kinetic_j": np.float64(kinetic_j),
            "potential_j": np.float64(potential_j - self._start_j),
            "hull_work_j": state["hull_work_j"][0],
            "penetration_m": state["penetration_m"][0],
            "n_contacts": np.uint32(state["n_contacts"][0]),
            "vertices_m": vertices,
            "displacement_m": moved_m.max(),
            "n_held": np.uint32(state["n_held"][0]),
            "cad_work_j": state["cad_work_j"][0],
        }
        state["penetration_m"][:] = 0.0
        state["n_contacts"][:] = 0
        return {name: np.asarray(value) for name, value in found.items()}

    def advance(self, instant: Instant, step_s: float) -> None:
        """Go on by one step."""
        x, v, age_s = (self.state[key] for key in ("nodes_world", "velocities", "side_age_s"))
        before, before_j = x.copy(), sum(self._energies())
        state = self.state
        near_m = 2.0 * step_s * float(np.sqrt((v * v).sum(axis=1).max())) + _NEAR_M
        in_hull = self._contacts_in_hull(instant)
        others = [
            obstacle.contacts(x, near_m, step_s, instant.courses.get(obstacle.name))
            for obstacle in self._obstacles
        ]
        is_driven = any(bool(one.speed.any()) for one in others)
        n_steps = self._n_steps(step_s)
        is_held = np.zeros(len(x), np.bool_)
        lost_j, others_j = move_on(
            x,
            v,
            self._inverse_mass,
            self._springs,
            GRAVITY_M_S2,
            self._drag_per_s,
            self._inner_s,
            step_s / n_steps,
            n_steps,
            joined_contacts([in_hull, *others]),
            len(in_hull.level_m),
            self._friction,
            is_held,
            is_driven,
        )
        if not (np.abs(x) < MAX_COORDINATE_M).all():
            raise UnstableError(
                f"cloth {self._entry.name!r} at {instant.time_s:.3f} s: a node is nowhere, or as "
                "good as that"
            )
        has_contacts = len(in_hull.level_m) > 0 or any(len(one.level_m) > 0 for one in others)
        if not has_contacts:
            self._refuse_growth(before_j, sum(self._energies()), instant)
        age_s += step_s
        age_s[is_held] = 0.0
        state["side"][age_s > _REMEMBERED_S] = 0.0
        is_pushed = self._get_out(before, instant)
        touched = is_held | is_pushed
        gain_j = sum(self._energies()) - before_j
        is_still = not is_driven and (instant.before is instant.hull or not touched.any())
        if is_still and (has_contacts or touched.any()):
            gain_j -= self._take_back(gain_j, touched)
        if touched.any():
            # The balance: what it has more, and what was lost, came from the hull. What stands
            # still only takes; what drag and damping take of trembling, it did not give.
            work_j = gain_j + lost_j - others_j
            state["hull_work_j"] += min(work_j, max(gain_j, 0.0)) if is_still else work_j
        if is_driven:
            state["cad_work_j"] += others_j
        state["n_contacts"] += int(touched.sum())

    def _n_steps(self, step_s: float) -> int:
        return max(1, int(np.ceil(step_s / self._longest_s)))

    def _energies(self) -> tuple[float, float]:
        """Return kinetic and potential energy, joules."""
        x, v = self.state["nodes_world"], self.state["velocities"]
        potential_j = potential_of(x, self._masses, self._springs, GRAVITY_M_S2)
        return kinetic_of(v, self._masses), potential_j

    def _refuse_growth(self, before_j: float, after_j: float, instant: Instant) -> None:
        """Stop where free motion brings energy: it can take no more than it errs by."""
        kinetic_j, potential_j = self._energies()
        weight_j = GRAVITY_M_S2 * float(self._masses @ self.state["nodes_world"][:, 2])
        moving_j = kinetic_j + potential_j - weight_j
        if not after_j - before_j <= _GROWTH * moving_j + 1e-12:
            raise UnstableError(
                f"cloth {self._entry.name!r} at {instant.time_s:.3f} s: one step of free motion "
                f"brought {after_j - before_j:.3g} J, of {moving_j:.3g} J of motion and springs"
            )

    def _contacts_in_hull(self, instant: Instant) -> Contacts:
        """Return where the sheet leaned on the hull, as that is now."""
        sample = self.state["contact_sample"]
        if not (sample >= 0).any():
            return no_contacts()
        before, elapsed_s = _known_before(instant)
        return Contacts(
            *renew(
                self.state["nodes_world"],
                -instant.hull.views.origin_world,
                self._triangles.faces,
                self._triangles.viewports,
                instant.hull.frame,
                before.frame,
                elapsed_s,
                sample,
                self.state["contact_way"],
            )
        )

    def _get_out(self, start: NDArray[np.float64], instant: Instant) -> NDArray[np.bool_]:
        """Move the samples out of the hull; return which nodes (N,) that moves."""
        state = self.state
        moved = np.zeros(len(start), np.bool_)
        state["n_held"][:] = 0
        hits = self._hits(instant.hull)
        if hits is None:
            return moved
        x, v = state["nodes_world"], state["velocities"]
        hull_before, elapsed_s = _known_before(instant)
        origin = -instant.hull.views.origin_world
        reach_m = min(_FASTEST_M_S * elapsed_s, _FARTHEST_M)
        frame, frame_before = instant.hull.frame, hull_before.frame
        shift, speed = np.zeros((len(x), 4)), np.zeros((len(x), 2))
        constrained, depth_m = self._constrained, 0.0
        for turn in range(_BY_WEIGHT + _WHOLE + _ONE_WAY):
            if turn == _BY_WEIGHT + _WHOLE and not constrained.any():
                constrained = _main_way(shift)
            asked = x.copy()
            depth_m, n_held = push_hits(
                x,
                origin,
                self._inverse_mass,
                self._triangles.faces,
                self._triangles.viewports,
                *hits,
                frame,
                frame_before,
                elapsed_s,
                reach_m,
                constrained,
                state["side"],
                shift,
                speed,
                state["contact_sample"],
                state["contact_way"],
                0.0 if turn == 0 else _LEFT_M,
                turn >= _BY_WEIGHT,
            )
            state["n_held"][:] = n_held
            if turn > 0 and (depth_m <= _LEFT_M or (x == asked).all()):
                break
            if turn == 0:
                touch(x, v, start, self._inverse_mass, shift, speed, self._friction, state["side"])
                moved |= shift[:, 3] > 0
                elapsed_s = 0.0
                shift[:], speed[:] = 0.0, 0.0
            found = self._hits(instant.hull)
            if found is None:
                state["n_held"][:] = 0
                depth_m = 0.0
                break
            hits = found
        touch(x, v, x, self._inverse_mass, shift, speed, 0.0, state["side"])
        moved |= shift[:, 3] > 0
        state["side_age_s"][moved] = 0.0
        state["penetration_m"][:] = max(float(state["penetration_m"][0]), depth_m)
        return moved

    def _hits(self, hull: Hull) -> tuple[NDArray[np.uint32], NDArray[np.uint32]] | None:
        """Return triangle and number of the samples in the hull; None if there are none."""
        x = self.state["nodes_world"]
        if not may_meet(x.min(axis=0), x.max(axis=0), -hull.views.origin_world, hull.frame):
            return None
        (hits,) = self._engine.query(hull, [self._triangles.moved(x)])
        return hits.samples() if len(hits) else None

    def _take_back(self, gain_j: float, moved: NDArray[np.bool_]) -> float:
        """Slow nodes down by energy that they cannot have got; return how much that was.

        What stands still gives none, but nodes that are moved off it one by one pull at springs.
        Those that were moved are slowed first.
        """
        v, taken_j = self.state["velocities"], 0.0
        for some in (moved, np.ones_like(moved)):
            kinetic_j = kinetic_of(v[some], self._masses[some])
            if gain_j <= taken_j or kinetic_j == 0.0:
                continue
            take_j = min(gain_j - taken_j, kinetic_j)
            v[some] *= np.sqrt(1.0 - take_j / kinetic_j)
            taken_j += take_j
        return taken_j


def _known_before(instant: Instant) -> tuple[Hull, float]:
    """Return the hull before and the seconds since; 0 where nothing is known of the hull's speed.

    Or where it stands still.
    """
    if instant.before is None or instant.before is instant.hull:
        return instant.hull, 0.0
    return instant.before, instant.elapsed_s


def _main_way(shift: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit vector of the node that was moved most, (3,)."""
    way = shift[shift[:, 3].argmax(), :3]
    length = float(np.linalg.norm(way))
    return way / length if length > 0 else np.array([0.0, 0.0, 1.0])


def _pinned(entry: Entry, welded: Welded) -> NDArray[np.bool_]:
    """Return which nodes (N,) do not move."""
    nodes, pin = welded.nodes_world, entry.table.pin
    is_pinned = np.zeros(len(nodes), np.bool_)
    if pin == "none":
        return is_pinned
    if pin == "top":
        low_m, high_m = nodes[:, 2].min(), nodes[:, 2].max()
        if high_m - low_m <= _TOP * np.ptp(nodes, axis=0).max():
            raise entry.error(
                'the sheet lies flat, so that it has no top; give points or boxes, or "none"',
                "pin",
            )
        return np.asarray(nodes[:, 2] >= high_m - _TOP * (high_m - low_m))
    corners = nodes[welded.faces]
    longest_m = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
    for number, place in enumerate(pin, start=1):
        at_m = np.array(place) / 1000.0
        if len(place) == 3:
            apart_m = np.linalg.norm(nodes - at_m, axis=1)
            nearest = int(apart_m.argmin())
            if apart_m[nearest] > longest_m:
                raise entry.error(
                    f"point {list(place)} is {1e3 * apart_m[nearest]:.4g} mm from the sheet, "
                    "expected a point on it",
                    f"pin.{number}",
                )
            is_pinned[nearest] = True
            continue
        low_m, high_m = np.minimum(at_m[:3], at_m[3:]), np.maximum(at_m[:3], at_m[3:])
        inside = ((nodes >= low_m) & (nodes <= high_m)).all(axis=1)
        if not inside.any():
            raise entry.error(f"box {list(place)} holds no node of the sheet", f"pin.{number}")
        is_pinned |= inside
    return is_pinned


def _software() -> dict[str, str]:
    return {"numba": version("numba"), "numpy": np.__version__}


#: What a scene calls "cloth".
KIND = EffectKind("cloth", ClothTable, Cloths, _software)
