"""Rigid and hinged bodies: all of a scene in one MuJoCo world, so that they meet each other.

What a step does, in its order:

1. Bodies go on freely to where they would be at its end, and the hull is asked about them there
   (`hybridve.hull.effects.hull_contacts`).
2. Velocities are solved for in the middle of the step, all contacts at once
   (`hybridve.hull.effects.body_solver`). A body that hit the hull is where it would be had it
   turned at the surface, at the instant at which it crossed it: both flights are ballistic, and
   what bounces fully keeps its energy however coarse the step.
3. The hull is asked again, and what is still in it, in CAD or in another body is moved out, without
   a velocity.

CAD that moves as a file says is where it is in the middle of the step while velocities are solved
for, and at its end while bodies are moved out.

Energy may come from the hull and from CAD that moves alone: their speed at contacts times their
impulses, and the height that bodies are moved out to. Newton's restitution with friction can make
some where many contacts meet; where it would, the step is solved without bouncing, and what were
left is taken off the speed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from hybridve.hull.effects.body_model import (
    BodyPlan,
    cad_rates,
    energies,
    make_world,
    place_cad,
    places_of,
    start_of,
    twist_of,
)
from hybridve.hull.effects.body_shape import cross
from hybridve.hull.effects.body_solver import (
    SLOP_M,
    HullRow,
    Solved,
    free_velocities,
    least_impact,
    moved,
    own_depth,
    solve_displacements,
    solve_velocities,
)
from hybridve.hull.effects.body_told import Books, pose_of, told_of
from hybridve.hull.effects.effect import (
    Instant,
    Setting,
    Told,
    UnstableError,
)
from hybridve.hull.effects.hull_contacts import (
    Arc,
    HullContact,
    Patch,
    contact_of,
    find_patches,
    followed,
)
from hybridve.hull.query.bounds import boxes_are_free
from hybridve.hull.query.clusters import spatial_order
from hybridve.hull.query.engine import Triangles
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.viewport import read_only

#: Bodies are moved out of what they are in at most so often a step.
_MOST_MOVES = 3

#: Faster than this, metres a second, nothing real is thrown.
_MOST_SPEED = 1e4

#: A solve that misses what contacts ask for by this share of the speeds is of what cannot be: a
#: hand that presses a body through a table. The hull is then taken to stand.
_MISSED = 1e-3

#: What has moved by less, in metres and parts of a turn, is where it was.
_SAME_PLACE = 1e-8

#: Between two hands a body stays that is off their middle by no more than this share of how deep it
#: is in them: samples do not tell depth better.
_OFF_MIDDLE = 0.25

#: A step that makes more energy than this share of the kinetic is solved again; less is rounding.
_MADE = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class _Surface:
    """What of a body the hull is asked about: its mesh, and how large it is.

    The vertices are in the frame of the body, the radius about its centre of mass.
    """

    triangles: Triangles
    vertices_body: NDArray[np.float64]
    radius_m: float
    size_m: float


@dataclass(frozen=True, slots=True, eq=False)
class _Hit:
    """A row of the solve, with the speed of the hull along its normal."""

    row: HullRow
    hull_m_s: float


@dataclass(frozen=True, slots=True, eq=False)
class _Asked:
    """What was asked of a hull last: what rests need not ask again.

    `meets` says whether any body has samples in it, also such as have no way out.
    """

    instant: Instant
    positions: NDArray[np.float64]
    meets: bool
    contacts: Sequence[tuple[int, HullContact]]


class Bodies:
    """All rigid and hinged bodies of a scene; see `hybridve.hull.effects.effect.Effect`."""

    told: Mapping[str, Told]

    def __init__(self, plans: Sequence[BodyPlan], setting: Setting) -> None:
        self._engine = setting.engine
        self._world = make_world(plans, setting.obstacles, setting.views.origin_world)
        self._data = mujoco.MjData(self._world.model)
        self._surfaces = [_surface_of(plan, setting.viewport) for plan in plans]
        self._scene_places = places_of(self._world, self._world.model.qpos0)
        self._positions, self._velocities = start_of(self._world)
        self._potential_at_start_j = self._energies()[1]
        self._books = [Books() for _ in plans]
        self._asked: _Asked | None = None
        self._moved_out: tuple[Instant, NDArray[np.float64]] | None = None
        self.told = {plan.name: told_of(self._world, plan) for plan in plans}

    def advance(self, instant: Instant, step_s: float) -> None:
        """Go on by one step, to be out of the hull of this instant at its end."""
        world, data = self._world, self._data
        self._damp(step_s)
        before_j = float(np.sum(self._energies()))
        middle = moved(world, self._positions, self._velocities, 0.5 * step_s)
        place_cad(world, data, {name: one.middle for name, one in instant.courses.items()})
        free = free_velocities(world, data, middle, self._velocities, step_s)
        self._check(free)
        ahead = moved(world, middle, free, 0.5 * step_s)
        moving = cad_rates(world, instant.courses, step_s)
        asked = self._ask(instant, ahead)
        contacts = asked.contacts
        n_own = data.ncon
        hits, times = self._impacts(contacts, middle, ahead, free, step_s)
        for attempt in ("bounce", "rest", "stand"):
            if attempt != "bounce":
                hits = [_calmed(hit, stands=attempt == "stand") for hit in hits]
                times = np.full_like(times, 0.5 * step_s)
            solved = solve_velocities(
                world,
                data,
                self._velocities,
                [hit.row for hit in hits],
                step_s,
                n_own=n_own,
                moving=moving,
                bounces=attempt == "bounce",
            )
            ended = moved(world, ahead, times * (solved.change - free), 1.0)
            work_j = solved.hull_impulse * [hit.hull_m_s for hit in hits]
            kinetic, potential = energies(world, places_of(world, ended), solved.change)
            given_j = float(work_j.sum()) + sum(solved.cad_work_j.values())
            made_j = float(kinetic.sum() + potential.sum()) - given_j - before_j
            is_passive = not solved.meets or made_j <= _MADE * float(kinetic.sum())
            if is_passive and solved.missed_m_s <= _MISSED * max(1.0, float(np.abs(free).max())):
                break
        if solved.meets and made_j > 0:
            solved = replace(solved, change=self._slowed(solved.change, free, made_j))
        self._positions, self._velocities = ended, solved.change
        for hit, joules in zip(hits, work_j.tolist(), strict=True):
            self._books[hit.row.body].hull_work_j += joules
        for body, number in enumerate(world.body_id.tolist()):
            self._books[body].cad_work_j += solved.cad_work_j.get(number, 0.0)
        for body, contact in contacts:
            self._books[body].meet(contact)
        self._check(self._velocities)
        self._move_out(instant, near_hull=asked.meets)

    def values(self, hull: Hull | None) -> Mapping[str, Mapping[str, NDArray[Any]]]:  # noqa: ARG002
        """Return by entry and column what stands at the end of a frame; counts begin anew."""
        kinetic, potential = self._energies()
        potential = potential - self._potential_at_start_j
        found: dict[str, Mapping[str, NDArray[Any]]] = {}
        for body, (plan, books) in enumerate(zip(self._world.plans, self._books, strict=True)):
            found[plan.name] = {
                "kinetic_j": np.asarray(kinetic[body]),
                "potential_j": np.asarray(potential[body]),
                "hull_work_j": np.asarray(books.hull_work_j),
                "penetration_m": np.asarray(books.penetration_m),
                "n_contacts": np.asarray(books.n_contacts, np.uint32),
                "cad_work_j": np.asarray(books.cad_work_j),
                **pose_of(self._world, self._scene_places, self._positions, self._velocities, body),
                **dict(
                    zip(("cp_obj_m", "cp_hull_m", "v_rec", "n_hull"), books.arrows, strict=True)
                ),
            }
            books.begin_frame()
        self._forget()
        return found

    def state(self) -> Mapping[str, NDArray[Any]]:
        """Return all that decides how it goes on, as arrays."""
        self._forget()
        return {
            "positions": self._positions.copy(),
            "velocities": self._velocities.copy(),
            "hull_work_j": np.array([books.hull_work_j for books in self._books]),
            "cad_work_j": np.array([books.cad_work_j for books in self._books]),
            "penetration_m": np.array([books.penetration_m for books in self._books]),
            "n_contacts": np.array([books.n_contacts for books in self._books], np.int64),
            "deepest_m": np.array([books.deepest_m for books in self._books]),
            "arrows": np.array([books.arrows for books in self._books]),
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from what `state` gave, to the same values to the bit."""
        self._forget()
        self._positions = np.array(state["positions"], np.float64)
        self._velocities = np.array(state["velocities"], np.float64)
        self._books = [
            Books(
                float(work_j),
                float(cad_work_j),
                float(penetration_m),
                int(count),
                float(deepest_m),
                arrows.copy(),
            )
            for work_j, cad_work_j, penetration_m, count, deepest_m, arrows in zip(
                state["hull_work_j"],
                state["cad_work_j"],
                state["penetration_m"],
                state["n_contacts"],
                state["deepest_m"],
                state["arrows"],
                strict=True,
            )
        ]

    def _forget(self) -> None:
        """Ask the hull anew: whoever goes on from a state has not asked it."""
        self._asked, self._moved_out = None, None

    def _energies(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        places = places_of(self._world, self._positions)
        return energies(self._world, places, self._velocities)

    def _damp(self, step_s: float) -> None:
        """Let viscous friction in the hinges act, exactly, whatever the step."""
        for plan, dof in zip(self._world.plans, self._world.dof_at.tolist(), strict=True):
            if plan.hinge is not None and plan.hinge.damping_n_m_s > 0:
                rate = plan.hinge.damping_n_m_s / self._world.mass_diagonal[dof]
                self._velocities[dof] *= np.exp(-rate * step_s)

    def _slowed(
        self, velocities: NDArray[np.float64], free: NDArray[np.float64], made_j: float
    ) -> NDArray[np.float64]:
        """Return velocities (nv,) of so much less energy, of what met something."""
        met = velocities != free
        kinetic_j = float((0.5 * self._world.mass_diagonal * velocities**2)[met].sum())
        left = max(0.0, 1.0 - made_j / kinetic_j) if kinetic_j > 0 else 1.0
        return np.where(met, velocities * left**0.5, velocities)

    def _check(self, velocities: NDArray[np.float64]) -> None:
        # What is not a number is not below a limit either.
        is_sane = np.abs(velocities) < _MOST_SPEED
        if is_sane.all():
            return
        dof = int(is_sane.argmin())
        body = int(np.searchsorted(self._world.dof_at, dof, side="right")) - 1
        raise UnstableError(
            f"{self._world.plans[body].name}: a velocity of {velocities[dof]:g} m/s or rad/s, "
            f"expected one below {_MOST_SPEED:g}"
        )

    def _mesh(
        self, body: int, center_local: NDArray[np.float64], rotation: NDArray[np.float64]
    ) -> Triangles:
        surface = self._surfaces[body]
        center_world = center_local + self._world.origin_world
        return surface.triangles.moved(surface.vertices_body @ rotation.T + center_world)

    def _patches(self, hull: Hull, positions: NDArray[np.float64]) -> list[tuple[int, list[Patch]]]:
        """Return the bodies that the hull meets at positions (nq,), with their contacts."""
        world = self._world
        places = places_of(world, positions)
        centers = places.center_local + world.origin_world
        radii = np.array([surface.radius_m for surface in self._surfaces])[:, None]
        near = np.flatnonzero(~boxes_are_free(hull, centers - radii, centers + radii)).tolist()
        meshes = [
            self._mesh(body, places.center_local[body], places.rotation[body]) for body in near
        ]
        if not meshes:
            return []
        found = []
        for body, mesh, hits in zip(near, meshes, self._engine.query(hull, meshes), strict=True):
            plan = world.plans[body]
            patches = find_patches(
                hull,
                mesh,
                hits,
                center_world=centers[body],
                is_closed=plan.scene_object.is_closed,
                arc=None if plan.hinge is None else Arc(plan.hinge.axis, plan.hinge.anchor_world),
            )
            if patches:
                found.append((body, patches))
        return found

    def _ask(self, instant: Instant, positions: NDArray[np.float64]) -> _Asked:
        """Ask the hull about bodies at positions (nq,), unless it was the last that was asked."""
        asked = self._asked
        if (
            asked is None
            or not _asks_the_same(asked.instant, instant)
            or np.abs(asked.positions - positions).max() > _SAME_PLACE
        ):
            met = self._patches(instant.hull, positions)
            contacts = tuple(
                (body, contact)
                for body, patches in met
                for contact in self._contacts_of(instant, body, patches)
            )
            self._asked = asked = _Asked(instant, positions, bool(met), contacts)
        return asked

    def _contacts_of(
        self, instant: Instant, body: int, patches: Sequence[Patch]
    ) -> list[HullContact]:
        ways = [(instant.before, instant.hull, instant.elapsed_s)]
        if instant.recorded is not None:  # the longer way tells more closely, where it tells
            ways.insert(0, (*instant.recorded, instant.recorded_s))
        size_m = self._surfaces[body].size_m
        found = (contact_of(instant.hull, patch, size_m=size_m, ways=ways) for patch in patches)
        return [contact for contact in found if contact is not None]

    def _impacts(
        self,
        contacts: Sequence[tuple[int, HullContact]],
        middle: NDArray[np.float64],
        ahead: NDArray[np.float64],
        free: NDArray[np.float64],
        step_s: float,
    ) -> tuple[list[_Hit], NDArray[np.float64]]:
        """Return what contacts with the hull ask of velocities, and since when bodies have changed.

        A velocity that the solve gives to a body acts on its place for half a step, as the midpoint
        rule has it; of one that hit the hull, for as long as it has been in it.

        Parameters
        ----------
        contacts : sequence of (int, HullContact)
            Bodies and what they met `ahead`.
        middle, ahead : (nq,) float64
            Positions in the middle and at the end of the step, of bodies that met nothing.
        free : (nv,) float64
            Their velocities at its end.
        step_s : float
            Seconds.

        Returns
        -------
        hits : list of _Hit
        times : (nv,) float64
            Seconds.
        """
        world = self._world
        times = np.full(world.model.nv, 0.5 * step_s)
        if not contacts:
            return [], times
        gained = (free - self._velocities) / step_s
        there, here = places_of(world, ahead), places_of(world, middle)
        hits = []
        for body in sorted({body for body, _ in contacts}):
            own = [contact for other, contact in contacts if other == body]
            points_world = np.concatenate([contact.points_world for contact in own])
            counts = [len(contact.points_world) for contact in own]
            normals = np.array([contact.n_hull for contact in own])
            is_squeezed, speeds = followed(
                normals, np.array([contact.speed_m_s for contact in own])
            )
            normals, hull_m_s = np.repeat(normals, counts, axis=0), np.repeat(speeds, counts)
            depths_m = np.concatenate([contact.depths_m for contact in own])
            arms = points_world - world.origin_world - there.center_local[body]
            approach, pull = (
                ((linear + cross(angular, arms)) * normals).sum(axis=1)
                for linear, angular in (
                    twist_of(world, there, rates, body) for rates in (free, gained)
                )
            )
            approach -= hull_m_s
            # Since when it is that deep: depth = -approach t + pull t^2 / 2.
            root = np.sqrt(np.maximum(approach**2 + 2.0 * pull * depths_m, 0.0))
            since_s = np.clip(2.0 * depths_m / np.maximum(root - approach, 1e-12), 0.0, step_s)
            is_impact = approach - pull * since_s < -least_impact(step_s)
            leaves = np.zeros(len(arms))
            if is_impact.any() and not is_squeezed:
                # All points of a body are taken at the instant of its first touch.
                first_s = since_s[np.where(is_impact, depths_m, -1.0).argmax()]
                at_touch = approach - pull * first_s
                bounces = at_touch < -least_impact(step_s)
                leaves[bounces] = -world.plans[body].restitution * at_touch[bounces]
                leaves[bounces] += pull[bounces] * first_s  # it has flown on since
                at = int(world.dof_at[body])
                times[at : at + (6 if world.is_free[body] else 1)] = first_s
            turn = here.rotation[body] @ there.rotation[body].T
            points_local = here.center_local[body] + arms @ turn.T
            hits += [
                _Hit(HullRow(body, point, normal, depth_m, after, is_squeezed), float(speed))
                for point, normal, depth_m, after, speed in zip(
                    points_local,
                    normals,
                    depths_m,
                    leaves + hull_m_s,
                    hull_m_s,
                    strict=True,
                )
            ]
        return hits, times

    def _move_out(self, instant: Instant, *, near_hull: bool) -> None:
        """Move bodies out of the hull, of CAD and of each other, and tell how deep they stay."""
        world, data, hull = self._world, self._data, instant.hull
        place_cad(world, data, {name: one.end for name, one in instant.courses.items()})
        if self._moved_out is not None and not instant.courses:
            last, positions = self._moved_out
            if last.hull is hull and np.abs(positions - self._positions).max() <= _SAME_PLACE:
                return
        patches = self._patches(hull, self._positions) if near_hull else []
        for _ in range(_MOST_MOVES):
            deepest_m = max(
                (patch.deepest_m for _, found in patches for patch in found), default=0.0
            )
            rows = self._rows_out(hull, patches) if deepest_m > SLOP_M else []
            is_out = all(row.depth_m <= 1.01 * SLOP_M for row in rows)
            if own_depth(world, data, self._positions) <= 0 and is_out:
                self._moved_out = (instant, self._positions) if near_hull else None
                break
            if not rows:
                rows = self._rows_out(hull, patches)
            solved = solve_displacements(world, data, rows)
            before = self._energies()[1]
            self._positions = moved(world, self._positions, solved.change, 1.0)
            rose_j = self._energies()[1] - before
            is_pushed = self._pushed(rows, solved)
            for books, joules, is_hull in zip(
                self._books, rose_j.tolist(), is_pushed.tolist(), strict=True
            ):
                if is_hull:
                    books.hull_work_j += joules
                elif instant.courses:
                    books.cad_work_j += joules
            if near_hull:
                patches = self._patches(hull, self._positions)
        for body, found in patches:
            books = self._books[body]
            for patch in found:
                books.penetration_m = max(books.penetration_m, patch.deepest_m)

    def _rows_out(self, hull: Hull, patches: Sequence[tuple[int, list[Patch]]]) -> list[HullRow]:
        """Return what moves bodies out of the hull; from between two hands, to their middle."""
        rows = []
        centers = places_of(self._world, self._positions).center_local
        for body, found in patches:
            size_m = self._surfaces[body].size_m
            contacts = [contact_of(hull, patch, size_m=size_m) for patch in found]
            own = [contact for contact in contacts if contact is not None]
            if not own:
                continue
            deepest_m = np.array([contact.depths_m.max() for contact in own])
            is_squeezed, shares_m = followed(
                np.array([contact.n_hull for contact in own]), deepest_m
            )
            if is_squeezed:
                is_off = shares_m > np.maximum(_OFF_MIDDLE * deepest_m, SLOP_M)
                rows += [
                    HullRow(body, centers[body], contact.n_hull, share_m + SLOP_M)
                    for contact, share_m, moves in zip(own, shares_m.tolist(), is_off, strict=True)
                    if moves
                ]
                continue
            for contact in own:
                points_local = contact.points_world - self._world.origin_world
                rows += [
                    HullRow(body, point, contact.n_hull, depth_m)
                    for point, depth_m in zip(points_local, contact.depths_m.tolist(), strict=True)
                ]
        return rows

    def _pushed(self, rows: Sequence[HullRow], solved: Solved) -> NDArray[np.bool_]:
        """Return which bodies (B,) the hull moved, itself or through others."""
        world = self._world
        n_bodies = world.model.nbody
        moves = np.zeros(n_bodies, np.bool_)
        moves[world.body_id] = True
        joined = solved.joined[moves[solved.joined].all(axis=1)]
        graph = coo_array(
            (np.ones(len(joined)), (joined[:, 0], joined[:, 1])), shape=(n_bodies, n_bodies)
        )
        label = connected_components(graph, directed=False)[1]
        touched = label[world.body_id[[row.body for row in rows]]]
        return np.isin(label[world.body_id], touched)


def _asks_the_same(one: Instant, other: Instant) -> bool:
    """Tell whether the hull and what is known of its speed are the same at two instants."""
    return one is other or (
        one.hull is other.hull
        and one.before is other.before
        and one.recorded == other.recorded
        and one.elapsed_s == other.elapsed_s
    )


def _calmed(hit: _Hit, *, stands: bool) -> _Hit:
    """Return what a contact asks for if bodies do not bounce, or if the hull stands as well."""
    hull_m_s = 0.0 if stands else hit.hull_m_s
    return _Hit(replace(hit.row, after_m_s=hull_m_s), hull_m_s)


def _surface_of(plan: BodyPlan, viewport: int) -> _Surface:
    vertices_world = plan.scene_object.vertices_world
    faces = plan.faces[spatial_order(vertices_world, plan.faces)]
    used = vertices_world[faces.ravel()]
    return _Surface(
        Triangles(
            vertices_world, read_only(faces), read_only(np.full(len(faces), viewport, np.int32))
        ),
        (vertices_world - plan.share.center) @ plan.share.axes,
        float(np.linalg.norm(used - plan.share.center, axis=1).max()),
        float(np.linalg.norm(np.ptp(used, axis=0))),
    )
