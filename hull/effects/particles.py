"""Smoke, drops and sparks: many particles without size that a hand deflects.

Between contacts a particle follows the exact solution of weight and drag, v' = a - v / drag_s: a
step's length changes nothing. What it goes through in a step is the chord of that path (off by a
hundredth of a millimetre at 5 ms), which is walked through the hull's silhouettes to rounding
(`hybridve.hull.query.segments`) and through all other CAD (`hybridve.hull.effects.cad_ways`), which
may move meanwhile: nothing is jumped over. At the point of
entry the particle is thrown back at N_hull, the normal of the silhouette that ends the hull there,
with restitution and friction, relative to the speed at which the hull's surface came there: its way
along N_hull since the instant before. CAD throws it back at its own normal, relative to its own
speed. The rest of the step follows. What lands and does not bounce
slides: it gives way along N_hull over the steps of a silhouette's pixels.

A particle that the hull has moved over is put out of it along one of fourteen ways: the one along
which the hull's surface had least to move to get past it; where nothing is known of the hull
before, the shortest. It then goes at least as fast as that surface there, and gains no more. One
that has no way out is lost, and counted.

Particle number n is drawn from counter n of a Philox generator (its key: the seed and the entry's
name), so that which particles there are depends on neither steps nor threads.
"""

import itertools
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from hybridve.hull.agreement.sight import sight_of
from hybridve.hull.cad.surface_ray import WAITING
from hybridve.hull.effects.cad_ways import Cad, CadWays, cad_normal, cad_speed, carry, first_cad
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
from hybridve.hull.jit import ZERO, compiled, inlined
from hybridve.hull.query.frame import Frame
from hybridve.hull.query.points import is_inside
from hybridve.hull.query.segments import first_entry, first_exit, outward_normal, place_segment
from hybridve.hull.query.silhouettes import Hull, Views
from hybridve.hull.query.threads import Threads
from hybridve.hull.query.walk import least_stretches

#: Contacts of one particle in a step that are followed, and of those without a bounce; it then
#: stays where it is to the step's end.
_MOST_CONTACTS, _MOST_RESTS = 8, 3

#: How far from a surface a particle is stopped; and how far from the hull's, which is a stair of
#: pixels, what lies on it is put, to slide on to the next. Metres.
_MARGIN_M, _SKIN_M = 1e-6, 2e-4

#: How far the hull is followed: for its surface at the instant before, for a way out, and over the
#: steps of a silhouette's pixels. Metres. What is likely nearer is looked for nearer first.
_REACH_M, _OUT_M, _HOP_M, _NEAR_M = 0.25, 0.5, 0.01, 0.01

#: Random numbers of each particle, a multiple of the four that a counter of Philox gives.
_DRAWN = 8

#: Particles that are worth another thread.
_MANY = 2000

#: The ways out of the hull: along the axes, and between all three.
_WAYS = np.array(
    [way for way in itertools.product((-1.0, 0.0, 1.0), repeat=3) if np.abs(way).sum() in (1, 3)]
)
_WAYS /= np.linalg.norm(_WAYS, axis=1)[:, None]


class _Style(NamedTuple):
    """What is usual of one kind of particle."""

    gravity: float
    buoyancy: float
    drag_s: float
    restitution: float
    friction: float
    lifetime_s: float
    mass_mg: float


#: A drop of 2 mm falls at 6.5 m/s at most, smoke rises at 0.3 m/s, a spark is a glowing grain.
_STYLES = {
    "drops": _Style(1.0, 0.0, 0.66, 0.1, 0.3, 3.0, 4.2),
    "smoke": _Style(1.0, 1.6, 0.05, 0.0, 0.0, 5.0, 0.001),
    "sparks": _Style(1.0, 0.0, 0.4, 0.5, 0.2, 0.8, 0.05),
}

_Vector = tuple[float, float, float]
_NotNegative = Annotated[float, Field(ge=0.0)]
_Share = Annotated[float, Field(ge=0.0, le=1.0)]


class ParticlesTable(EffectTable):
    """Keys of ``kind = "particles"``.

    Attributes
    ----------
    style : "drops", "smoke" or "sparks"
        What the keys below `spread_deg` are where they are not given.
    count : int
        Particles at once, at most; with a rate the oldest makes room.
    rate_per_s : float or None
        How many come out; None for all of them at the beginning.
    source_mm : tuple of 3 or 6 floats, or None
        A point, or two opposite corners of a box, in which they come out evenly.
    object : str or None
        They come out of this object's surface instead.
    spread_mm : float
        How far beside that they may.
    velocity_m_s : tuple of 3 floats
        With what they come out.
    spread_deg : float
        How far from that direction, evenly over the cone.
    gravity : float
        How much of the world's gravity pulls at them.
    buoyancy : float
        How much of their weight the air bears; above 1 they rise.
    drag_s : float
        After what time the air has taken all but 1 / e of their speed; 0 for no air.
    restitution, friction : float
        How much of the speed towards a surface is thrown back; the coefficient of friction.
    lifetime_s : float
        How long each is there.
    mass_mg : float
        Of each: it weighs the energies.
    """

    style: Literal["drops", "smoke", "sparks"] = "drops"
    count: Annotated[int, Field(ge=1, le=1_000_000)] = 10_000
    rate_per_s: Annotated[float, Field(gt=0.0, le=1e9)] | None = None
    source_mm: tuple[float, ...] | None = None
    object: str | None = None
    spread_mm: _NotNegative = 0.0
    velocity_m_s: _Vector = (0.0, 0.0, 0.0)
    spread_deg: Annotated[float, Field(ge=0.0, le=180.0)] = 0.0
    gravity: float | None = None
    buoyancy: _NotNegative | None = None
    drag_s: _NotNegative | None = None
    restitution: _Share | None = None
    friction: _NotNegative | None = None
    lifetime_s: Annotated[float, Field(gt=0.0, le=3600.0)] | None = None
    mass_mg: Annotated[float, Field(gt=0.0)] | None = None

    @field_validator("source_mm")
    @classmethod
    def _is_point_or_box(cls, source_mm: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if source_mm is None or len(source_mm) == 3:
            return source_mm
        if len(source_mm) != 6:
            raise ValueError(
                f"{len(source_mm)} numbers, expected 3 of a point or 6 of a box: its two corners"
            )
        if any(low > high for low, high in zip(source_mm[:3], source_mm[3:], strict=True)):
            raise ValueError("the box's first corner must be the lower one: x, y, z, x, y, z")
        return source_mm


class _Material(NamedTuple):
    """What all particles of one entry have in common, as the compiled loop takes it."""

    acceleration: float  # upwards, m/s^2
    drag_rate: float  # 1/s
    restitution: float
    friction: float
    mass_kg: float


@dataclass(slots=True, eq=False)
class _Swarm:
    """The particles of one entry, N places for them; what an interrupted run goes on from.

    Attributes
    ----------
    position, velocity : (N, 3) float64
        Metres about the views' local origin, and metres per second.
    age_s : (N,) float64
        Since it came out.
    is_alive : (N,) bool
        Whether there is one.
    n_contacts : (N,) uint32
        With the hull, of the particle that is there.
    work_j, cad_work_j : (N,) float64
        What the hull, and CAD that moves, has done to all that were in this place.
    depth_m : (N,) float64
        The deepest in the hull after any step since the frame before.
    n_out, n_lost : (1,) int64
        How many came out so far, and how many the hull left no way.
    n_gone, n_told : (1,) int64
        Contacts of particles that made room, and all contacts up to the frame before.
    time_s : (1,) float64
        How long it goes already.
    """

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    age_s: NDArray[np.float64]
    is_alive: NDArray[np.bool_]
    n_contacts: NDArray[np.uint32]
    work_j: NDArray[np.float64]
    cad_work_j: NDArray[np.float64]
    depth_m: NDArray[np.float64]
    n_out: NDArray[np.int64]
    n_lost: NDArray[np.int64]
    n_gone: NDArray[np.int64]
    n_told: NDArray[np.int64]
    time_s: NDArray[np.float64]

    @classmethod
    def none(cls, count: int, at_local: NDArray[np.float64]) -> "_Swarm":
        """Return places without particles."""
        return cls(
            np.tile(at_local, (count, 1)),
            np.zeros((count, 3)),
            np.zeros(count),
            np.zeros(count, np.bool_),
            np.zeros(count, np.uint32),
            np.zeros(count),
            np.zeros(count),
            np.zeros(count),
            np.zeros(1, np.int64),
            np.zeros(1, np.int64),
            np.zeros(1, np.int64),
            np.zeros(1, np.int64),
            np.zeros(1),
        )


@inlined
def _flight(dt_s: float, rate: float) -> tuple[float, float, float]:
    """Return what dt_s leaves of a speed, and what a speed and an acceleration move meanwhile.

    exp(-x), dt (1 - exp(-x)) / x and dt^2 (x - 1 + exp(-x)) / x^2 with x = rate dt.
    """
    x = rate * dt_s
    lost = -np.expm1(-x)
    if x < 0.01:  # the terms cancel; the fifth power left out is below 1e-13
        by_speed = 1.0 - x / 2.0 * (1.0 - x / 3.0 * (1.0 - x / 4.0 * (1.0 - x / 5.0)))
        by_pull = 0.5 - x / 6.0 * (1.0 - x / 4.0 * (1.0 - x / 5.0 * (1.0 - x / 6.0)))
    else:
        by_speed = lost / x
        by_pull = (x - lost) / (x * x)
    return 1.0 - lost, dt_s * by_speed, dt_s * dt_s * by_pull


@inlined
def _dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@inlined
def _slide(vector: NDArray[np.float64], normal: NDArray[np.float64], least: float) -> None:
    """Take from a vector what leads into the surface with an outward normal, which goes `least`."""
    into = min(_dot(vector, normal) - least, 0.0)
    for axis in range(3):
        vector[axis] -= into * normal[axis]


@compiled
def _throw_back(
    velocity: NDArray[np.float64],
    normal: NDArray[np.float64],
    surface_m_s: float,
    restitution: float,
    friction: float,
) -> None:
    """Change a velocity at a surface that moves along its outward normal: Newton and Coulomb."""
    towards = _dot(velocity, normal) - surface_m_s
    if towards >= 0.0:
        return
    given = -(1.0 + restitution) * towards
    for axis in range(3):
        velocity[axis] += given * normal[axis]
    away = _dot(velocity, normal)
    squared = 0.0
    for axis in range(3):
        squared += (velocity[axis] - away * normal[axis]) ** 2
    along = np.sqrt(squared)
    if along > 0.0:
        kept = max(along - friction * given, 0.0) / along
        for axis in range(3):
            across = away * normal[axis]
            velocity[axis] = across + kept * (velocity[axis] - across)


@compiled
def _is_in(point: NDArray[np.float64], frame: Frame) -> bool:
    return is_inside(
        point[0],
        point[1],
        point[2],
        frame.every,
        len(frame.every),
        ZERO,
        frame.matrices,
        frame.sizes,
        frame.answers,
        frame.mask_offset,
        frame.keep,
        frame.min_cameras,
        0.0,
    )


@compiled
def _surface_speed(
    point: NDArray[np.float64],
    normal: NDArray[np.float64],
    before: Frame,
    elapsed_s: float,
    least_m: float,
    room: NDArray[np.float64],
) -> float:
    """Return how fast the hull's surface has come to a point, along its normal there.

    0 where it was not within reach the instant before. `room` is (2, C, 3), to be written to.
    """
    begin, step = room[0], room[1]
    place, way = np.zeros(3), np.zeros(3)
    for axis in range(3):
        place[axis] = point[axis] - _MARGIN_M * normal[axis]
    was_in = _is_in(place, before)
    for reach_m in (_NEAR_M, _REACH_M):  # most surfaces have not moved far, and a walk takes time
        for axis in range(3):
            way[axis] = reach_m * normal[axis] if was_in else -reach_m * normal[axis]
        place_segment(place, way, before, begin, step)
        if was_in:
            at = first_exit(begin, step, least_m / reach_m, before)
            moved_m = min(_MARGIN_M - at * reach_m, 0.0)
        else:
            at, _ = first_entry(begin, step, least_m / reach_m, before)
            moved_m = at * reach_m + _MARGIN_M
        if at < 1.0:
            return moved_m / elapsed_s
    return 0.0


@compiled
def _put_out(
    point: NDArray[np.float64],
    velocity: NDArray[np.float64],
    ways: NDArray[np.float64],
    frame: Frame,
    before: Frame,
    elapsed_s: float,
    cad: Cad,
    share: float,
    least_m: float,
    room: NDArray[np.float64],
    cad_room: NDArray[np.float64],
    waiting: NDArray[np.int64],
) -> bool:
    """Move a particle out of the hull, and give it the surface's speed; tell whether it could.

    `elapsed_s` is 0 where nothing is known of the hull before; CAD is where it is at a share of the
    step.
    """
    begin, step = room[0], room[1]
    least = least_m / _OUT_M
    was_in = elapsed_s == 0.0 or _is_in(point, before)
    best, best_speed, is_front = -1, 0.0, False
    best_m = np.inf
    place, way = np.zeros(3), np.zeros(3)
    for number in range(len(ways)):
        for axis in range(3):
            way[axis] = _OUT_M * ways[number, axis]
        place_segment(point, way, frame, begin, step)
        out_m = first_exit(begin, step, least, frame) * _OUT_M + _MARGIN_M
        if out_m > _OUT_M or (out_m >= best_m and (was_in or is_front)):
            continue
        for axis in range(3):
            place[axis] = point[axis] + out_m * ways[number, axis]
        blocked, _, _ = first_cad(point, way, out_m / _OUT_M, cad, share, share, cad_room, waiting)
        if blocked <= 1.0 or _is_in(place, frame):
            continue
        moved_m = np.inf
        if not was_in:
            for axis in range(3):
                way[axis] = -way[axis]
            place_segment(point, way, before, begin, step)
            back, _ = first_entry(begin, step, least, before)
            moved_m = out_m + back * _OUT_M
        if moved_m < np.inf:
            if not is_front or moved_m < best_m:
                is_front, best, best_m = True, number, moved_m
                best_speed = moved_m / elapsed_s
        elif not is_front and out_m < best_m:
            best, best_m = number, out_m
    if best < 0:
        return False
    for axis in range(3):
        way[axis] = _OUT_M * ways[best, axis]
    place_segment(point, way, frame, begin, step)
    out_m = first_exit(begin, step, least, frame) * _OUT_M + _MARGIN_M
    for axis in range(3):
        point[axis] += out_m * ways[best, axis]
    _throw_back(velocity, ways[best], best_speed, 0.0, 0.0)
    return True


@compiled
def _depth(
    point: NDArray[np.float64],
    ways: NDArray[np.float64],
    frame: Frame,
    least_m: float,
    room: NDArray[np.float64],
) -> float:
    """Return the shortest of the ways out for a point that is in the hull, metres."""
    shortest = 1.0
    way = np.zeros(3)
    for number in range(len(ways)):
        for axis in range(3):
            way[axis] = _OUT_M * ways[number, axis]
        place_segment(point, way, frame, room[0], room[1])
        shortest = min(shortest, first_exit(room[0], room[1], least_m / _OUT_M, frame))
    return shortest * _OUT_M


@compiled
def _advance(
    first: int,
    stop: int,
    flight_s: NDArray[np.float64],
    each_position: NDArray[np.float64],
    each_velocity: NDArray[np.float64],
    is_alive: NDArray[np.bool_],
    n_contacts: NDArray[np.uint32],
    work_j: NDArray[np.float64],
    cad_work_j: NDArray[np.float64],
    depth_m: NDArray[np.float64],
    material: _Material,
    ways: NDArray[np.float64],
    frame: Frame,
    before: Frame,
    elapsed_s: float,
    cad: Cad,
    least_m: float,
) -> None:
    """Move particles `first` to `stop` by as long as each flies; see this file's head.

    `elapsed_s` is 0 where nothing is known of the hull before; one that is lost is not alive then.
    """
    room = np.zeros((2, len(frame.matrices), 3))
    begin, step = room[0], room[1]
    waiting, cad_room = np.zeros(WAITING, np.int64), np.zeros((2, 3))
    cad_moves = len(cad.root) > 1
    way, normal, rest, other = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    pull, rate, mass_kg = material.acceleration, material.drag_rate, material.mass_kg
    for i in range(first, stop):
        left_s = flight_s[i]
        if not (is_alive[i] and left_s > 0.0):
            continue
        position, velocity = each_position[i], each_velocity[i]
        if _is_in(position, frame):
            energy = 0.5 * _dot(velocity, velocity) - pull * position[2]
            if not _put_out(
                position,
                velocity,
                ways,
                frame,
                before,
                elapsed_s,
                cad,
                1.0 - left_s / cad.step_s,
                least_m,
                room,
                cad_room,
                waiting,
            ):
                is_alive[i] = False
                continue
            energy = 0.5 * _dot(velocity, velocity) - pull * position[2] - energy
            work_j[i] += mass_kg * energy
            n_contacts[i] += 1
        is_resting, n_rests, rest_m_s, is_stuck = False, 0, 0.0, True
        thing, share = -1, 0.0
        for _ in range(_MOST_CONTACTS):
            kept, by_speed, by_pull = _flight(left_s, rate)
            for axis in range(3):
                way[axis] = by_speed * velocity[axis]
            way[2] += by_pull * pull
            if is_resting:
                _slide(way, rest, rest_m_s * left_s)
            length_m = np.sqrt(_dot(way, way))
            at, camera, triangle = np.inf, -1, -1
            thing = -1
            if length_m > 0.0:
                place_segment(position, way, frame, begin, step)
                at, camera = first_entry(begin, step, least_m / length_m, frame)
            if length_m > 0.0 or cad_moves:
                share = 1.0 - left_s / cad.step_s
                at_cad, triangle, thing = first_cad(
                    position, way, min(at, 1.0), cad, share, 1.0, cad_room, waiting
                )
                if triangle >= 0:
                    at = at_cad
            used_s = left_s * min(at, 1.0)
            kept, by_speed, _ = _flight(used_s, rate)
            for axis in range(3):
                velocity[axis] *= kept
            velocity[2] += by_speed * pull
            if is_resting:
                _slide(velocity, rest, rest_m_s)
            if at > 1.0:
                for axis in range(3):
                    position[axis] += way[axis]
                is_stuck = False
                break
            left_s -= used_s
            share = 1.0 - left_s / cad.step_s
            if triangle >= 0:
                cad_normal(triangle, thing, share, cad, cad_room, normal)
            else:
                for axis in range(3):
                    other[axis] = position[axis] + at * way[axis]
                if camera < 0 or not outward_normal(other, camera, frame, normal):
                    for axis in range(3):
                        normal[axis] = -way[axis] / length_m
            surface_m_s = 0.0
            if triangle < 0 and elapsed_s > 0.0:
                surface_m_s = _surface_speed(other, normal, before, elapsed_s, least_m, room)
            if thing > 0:  # it comes from any side: the particle is put beside it
                for axis in range(3):
                    position[axis] += at * way[axis] + _MARGIN_M * normal[axis]
                surface_m_s = cad_speed(position, normal, thing, share, cad)
            else:
                steepness = abs(_dot(normal, way)) / length_m
                back = _MARGIN_M / (max(steepness, 1e-3) * length_m)
                at = max(at - back, 0.0)
                for axis in range(3):
                    position[axis] += at * way[axis]
            energy = 0.5 * _dot(velocity, velocity) - pull * position[2]
            towards = _dot(velocity, normal) - surface_m_s
            # What gravity alone gives back to it within a step is no bounce.
            is_resting = towards > -2.0 * abs(pull) * flight_s[i]
            if is_resting and triangle < 0:
                # The hull's surface is a stair of pixels: it is climbed along the normal.
                for axis in range(3):
                    other[axis] += _MARGIN_M * way[axis] / length_m
                    way[axis] = _HOP_M * normal[axis]
                place_segment(other, way, frame, begin, step)
                hop = first_exit(begin, step, least_m / _HOP_M, frame)
                if hop < 1.0:
                    for axis in range(3):
                        other[axis] += (hop + _SKIN_M / _HOP_M) * way[axis]
                    for axis in range(3):
                        way[axis] = other[axis] - position[axis]
                    blocked, _, _ = first_cad(
                        position, way, 1.0, cad, share, share, cad_room, waiting
                    )
                    if blocked > 1.0 and not _is_in(other, frame):
                        for axis in range(3):
                            position[axis] = other[axis]
            for axis in range(3):
                rest[axis] = normal[axis]
            rest_m_s = surface_m_s if thing > 0 else 0.0
            restitution = 0.0 if is_resting else material.restitution
            _throw_back(velocity, normal, surface_m_s, restitution, material.friction)
            if triangle < 0:
                energy = 0.5 * _dot(velocity, velocity) - pull * position[2] - energy
                work_j[i] += mass_kg * energy
                n_contacts[i] += 1
            elif thing > 0:
                energy = 0.5 * _dot(velocity, velocity) - pull * position[2] - energy
                cad_work_j[i] += mass_kg * energy
            n_rests += is_resting
            if n_rests == _MOST_RESTS:
                break
        if is_stuck and thing > 0:  # what lies on CAD goes with it all the same
            carry(position, thing, share, cad)
        if _is_in(position, frame):
            depth_m[i] = max(depth_m[i], _depth(position, ways, frame, least_m, room))


class _Source:
    """Where the particles of one entry come out, and how."""

    def __init__(self, entry: Entry, setting: Setting) -> None:
        table: ParticlesTable = entry.table
        self._table = table
        self._origin_world = setting.views.origin_world
        self._key = np.array([setting.seed, zlib.crc32(entry.name.encode())], np.uint64)
        self._corners: NDArray[np.float64] | None = None
        if (table.source_mm is None) == (table.object is None):
            found = "neither" if table.object is None else "both"
            raise entry.error(f"found {found} of source_mm and object; give one of them")
        if table.object is not None:
            one = setting.object_of(entry, table.object)
            if one.name in setting.claimed:
                raise entry.error(
                    f"{one.name!r} is moved by another effect; particles come out of objects that "
                    "stand",
                    "object",
                )
            if one.motion is not None:
                raise entry.error(
                    f"{one.name!r} moves as a file says; particles come out of objects that stand, "
                    "or of source_mm",
                    "object",
                )
            if sight_of(setting.views, one.vertices_world, one.faces).is_not_seen:
                raise entry.error(
                    f"no part of {one.name!r} is in the working volume: "
                    f"{_needed(setting.views)} cameras must see a place",
                    "object",
                )
            self._corners = one.vertices_world[one.faces]
            sides = np.cross(
                self._corners[:, 1] - self._corners[:, 0],
                self._corners[:, 2] - self._corners[:, 0],
            )
            twice_m2 = np.linalg.norm(sides, axis=1)
            if not twice_m2.sum() > 0:
                raise entry.error(f"{one.name!r} has no area to come out of", "object")
            self._until = np.cumsum(twice_m2) / twice_m2.sum()
            self._outward = sides / np.where(twice_m2 > 0, twice_m2, 1.0)[:, None]
            if one.about.get("inside_out"):
                self._outward = -self._outward
            self.middle_world = self._corners.mean(axis=(0, 1))
        if table.source_mm is not None:
            numbers = np.array(table.source_mm) / 1000.0
            self._low_world, self._high_world = numbers[:3], numbers[-3:]
            self.middle_world = (self._low_world + self._high_world) / 2.0
            choice = np.array([[i >> axis & 1 for axis in range(3)] for i in range(8)])
            ends = np.stack([self._low_world, self._high_world])
            places = np.concatenate([ends[choice, np.arange(3)], self.middle_world[None]])
            if not (_n_seen(setting.views, places) >= _needed(setting.views)).any():
                raise entry.error(
                    f"the source at {list(table.source_mm)} mm is outside of the working volume: "
                    f"{_needed(setting.views)} cameras must see it, "
                    f"{int(_n_seen(setting.views, places).max())} do",
                    "source_mm",
                )

    def draw(self, first: int, stop: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return places (K, 3), local frame, and velocities (K, 3) of particles by number."""
        table = self._table
        count = stop - first
        generator = np.random.Philox(key=self._key, counter=first * (_DRAWN // 4))
        # Bits by hand: what is made of them may not change with NumPy's version.
        bits = generator.random_raw(count * _DRAWN).reshape(count, _DRAWN)
        share = (bits >> np.uint64(11)).astype(np.float64) * 2.0**-53
        if self._corners is None:
            places = self._low_world + share[:, :3] * (self._high_world - self._low_world)
        else:
            number = np.searchsorted(self._until, share[:, 2], side="right")
            number = np.minimum(number, len(self._until) - 1)
            s, t = share[:, :1], share[:, 1:2]
            s, t = np.where(s + t > 1, 1 - s, s), np.where(s + t > 1, 1 - t, t)
            a, b, c = np.moveaxis(self._corners[number], 1, 0)
            places = a + s * (b - a) + t * (c - a) + _MARGIN_M * self._outward[number]
        out_m = table.spread_mm / 1000.0 * np.cbrt(share[:, 3:4])
        places = places + out_m * _in_cone(np.array([0, 0, 1.0]), np.pi, share[:, 4], share[:, 5])
        speed = float(np.linalg.norm(table.velocity_m_s))
        velocities = np.zeros((count, 3))
        if speed > 0:
            axis = np.array(table.velocity_m_s) / speed
            velocities = speed * _in_cone(
                axis, np.radians(table.spread_deg), share[:, 6], share[:, 7]
            )
        return places - self._origin_world, velocities


def _in_cone(
    axis: NDArray[np.float64],
    half_angle_rad: float,
    first: NDArray[np.float64],
    second: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return unit vectors (K, 3) spread evenly over a cone about an axis, of shares 0 to 1."""
    # 1 - cos, which keeps a narrow cone's directions apart.
    less = first * 2.0 * np.sin(half_angle_rad / 2.0) ** 2
    across = np.sqrt(less * (2.0 - less))
    turn = 2.0 * np.pi * second
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    up = np.cross(axis, side)
    return np.asarray(
        (1.0 - less)[:, None] * axis
        + (across * np.cos(turn))[:, None] * side
        + (across * np.sin(turn))[:, None] * up
    )


def _needed(views: Views) -> int:
    """Return how many cameras must see a point of the hull."""
    return len(views) if views.unseen == "carve" else views.min_cameras


def _n_seen(views: Views, points_world: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return how many cameras have points (N, 3) in their images, (N,)."""
    count = np.zeros(len(points_world), np.int64)
    for camera in range(len(views)):
        x, y, depth_m = views.project(points_world, camera).T
        width, height = views.sizes_px[camera]
        count += (
            (depth_m > 0) & (x >= 0) & (y >= 0) & (x < width * depth_m) & (y < height * depth_m)
        )
    return count


class _Cloud:
    """The particles of one entry."""

    def __init__(self, entry: Entry, setting: Setting, cad: CadWays, threads: Threads) -> None:
        table: ParticlesTable = entry.table
        style = _STYLES[table.style]
        self._name = entry.name
        settings = {
            key: value if (given := getattr(table, key)) is None else given
            for key, value in style._asdict().items()
        }
        self._table, self._cad, self._threads = table, cad, threads
        self._origin_world = setting.views.origin_world
        self._lifetime_s = settings["lifetime_s"]
        self._material = _Material(
            -GRAVITY_M_S2 * settings["gravity"] * (1.0 - settings["buoyancy"]),
            1.0 / settings["drag_s"] if settings["drag_s"] > 0 else 0.0,
            settings["restitution"],
            settings["friction"],
            settings["mass_mg"] * 1e-6,
        )
        self._source = _Source(entry, setting)
        middle_local = self._source.middle_world - self._origin_world
        self._middle_z = float(middle_local[2])
        self.swarm = _Swarm.none(table.count, middle_local)
        self.told = Told(
            _columns(table.count),
            Drawn("position_m"),
            about={
                "kind": table.kind,
                "style": table.style,
                "count": table.count,
                "rate_per_s": table.rate_per_s,
                **settings,
            },
        )

    def advance(self, instant: Instant, step_s: float) -> None:
        """Let new ones come out, and move all."""
        swarm = self.swarm
        flight_s = np.where(swarm.is_alive, step_s, 0.0)
        time_s = float(swarm.time_s[0]) + step_s
        self._let_out(time_s, flight_s)
        swarm.time_s[0] = time_s
        self._move(instant, flight_s, step_s)
        swarm.age_s += flight_s
        swarm.is_alive &= swarm.age_s < self._lifetime_s
        if not (np.isfinite(swarm.position).all() and np.isfinite(swarm.velocity).all()):
            raise UnstableError(f"{self._name}: a particle's place is not a number any more")

    def _let_out(self, until_s: float, flight_s: NDArray[np.float64]) -> None:
        """Put new particles in their places, with as much of the step as is left of it to each."""
        swarm, table = self.swarm, self._table
        first = int(swarm.n_out[0])
        stop = table.count
        if table.rate_per_s is not None:
            stop = int(np.ceil(until_s * table.rate_per_s))
        if stop <= first:
            return
        swarm.n_out[0] = stop
        first = max(first, stop - table.count)  # more than there are places for
        number = np.arange(first, stop)
        place = number % table.count
        swarm.position[place], swarm.velocity[place] = self._source.draw(first, stop)
        swarm.age_s[place] = 0.0
        swarm.is_alive[place] = True
        swarm.n_gone[0] += int(swarm.n_contacts[place].sum())
        swarm.n_contacts[place] = 0
        born_s = 0.0 if table.rate_per_s is None else number / table.rate_per_s
        flight_s[place] = until_s - born_s

    def _move(self, instant: Instant, flight_s: NDArray[np.float64], step_s: float) -> None:
        swarm, hull = self.swarm, instant.hull
        cad = self._cad.over(instant.courses, step_s)
        frame = hull.frame
        before, elapsed_s = frame, 0.0
        if instant.before is not None and instant.elapsed_s > 0:
            before, elapsed_s = instant.before.frame, instant.elapsed_s
        lived = swarm.is_alive.copy()
        least_m = float(least_stretches(hull.views, self._source.middle_world[None])[0])
        n_shares = min(self._threads.n_shares, max(len(flight_s) // _MANY, 1))
        ends = np.linspace(0, len(flight_s), n_shares + 1).astype(np.int64)
        self._threads.run(
            [
                (
                    _advance,
                    (
                        first,
                        stop,
                        flight_s,
                        swarm.position,
                        swarm.velocity,
                        swarm.is_alive,
                        swarm.n_contacts,
                        swarm.work_j,
                        swarm.cad_work_j,
                        swarm.depth_m,
                        self._material,
                        _WAYS,
                        frame,
                        before,
                        elapsed_s,
                        cad,
                        least_m,
                    ),
                )
                for first, stop in itertools.pairwise(ends)
            ]
        )
        swarm.n_lost[0] += int((lived & ~swarm.is_alive).sum())

    def values(self) -> dict[str, NDArray[Any]]:
        """Return what stands at the end of a frame."""
        swarm, mass_kg = self.swarm, self._material.mass_kg
        alive = swarm.is_alive
        height_m = swarm.position[alive, 2] - self._middle_z
        n_contacts = int(swarm.n_contacts.sum()) + int(swarm.n_gone[0])
        told = {
            "kinetic_j": np.asarray(0.5 * mass_kg * (swarm.velocity[alive] ** 2).sum()),
            "potential_j": np.asarray(-mass_kg * self._material.acceleration * height_m.sum()),
            "hull_work_j": np.asarray(swarm.work_j.sum()),
            "penetration_m": np.asarray(swarm.depth_m.max()),
            "n_contacts": np.asarray(n_contacts - swarm.n_told[0], np.uint32),
            "position_m": (swarm.position + self._origin_world).astype(np.float32),
            "is_alive": alive.astype(np.uint8),
            "age_s": swarm.age_s.astype(np.float32),
            "n_deflected": swarm.n_contacts.copy(),
            "n_alive": np.asarray(alive.sum(), np.uint32),
            "n_lost": np.asarray(swarm.n_lost[0], np.uint32),
            "cad_work_j": np.asarray(swarm.cad_work_j.sum()),
        }
        swarm.n_told[0] = n_contacts
        swarm.depth_m[:] = 0.0
        return told


def _columns(count: int) -> tuple[Quantity, ...]:
    """Return what is told of so many particles, each in its place."""
    return (
        Quantity(
            "position_m",
            "m",
            "estimate",
            "where each particle is, or where the last one of its place was",
            (count, 3),
            np.float32,
            is_place=True,
        ),
        Quantity("is_alive", "1", "exact", "whether there is one", (count,), np.uint8),
        Quantity("age_s", "s", "exact", "how long ago it came out", (count,), np.float32),
        Quantity(
            "n_deflected",
            "1",
            "exact",
            "how often real things have deflected it",
            (count,),
            np.uint32,
        ),
        Quantity("n_alive", "1", "exact", "how many there are", dtype=np.uint32),
        Quantity(
            "n_lost",
            "1",
            "exact",
            "how many real things have left no way out so far; they are gone",
            dtype=np.uint32,
        ),
        CAD_WORK,
    )


class Particles:
    """All particles of a scene; an `Effect`."""

    def __init__(
        self, entries: Sequence[Entry], setting: Setting, threads: Threads | None = None
    ) -> None:
        cad, threads = CadWays(setting), threads or Threads()
        self._clouds = {entry.name: _Cloud(entry, setting, cad, threads) for entry in entries}
        self.told: Mapping[str, Told] = {name: cloud.told for name, cloud in self._clouds.items()}

    def advance(self, instant: Instant, step_s: float) -> None:
        """Go on by one step; see `hybridve.hull.effects.effect.Effect`."""
        for cloud in self._clouds.values():
            cloud.advance(instant, step_s)

    def values(self, hull: Hull | None) -> Mapping[str, Mapping[str, NDArray[Any]]]:  # noqa: ARG002
        """Return by entry and column what stands at the end of a frame."""
        return {name: cloud.values() for name, cloud in self._clouds.items()}

    def state(self) -> Mapping[str, NDArray[Any]]:
        """Return all that decides how it goes on."""
        return {
            f"{name}/{field.name}": getattr(cloud.swarm, field.name).copy()
            for name, cloud in self._clouds.items()
            for field in fields(cloud.swarm)
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from a state."""
        for name, cloud in self._clouds.items():
            for field in fields(cloud.swarm):
                getattr(cloud.swarm, field.name)[:] = state[f"{name}/{field.name}"]


KIND = EffectKind("particles", ParticlesTable, Particles)
