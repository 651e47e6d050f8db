"""One step of bodies that meet each other, the CAD and the hull: MuJoCo's solve, Newton's impacts.

A step is the midpoint rule: half a step with the old velocity, forces and contacts there, half a
step with the new one. It is exact where forces are constant, keeps a pendulum's energy, and leaves
what rests where it is. The gyroscopic torque is taken at the middle of the angular velocities, so
that turning keeps its energy too.

Contacts are not springs. Of each the velocity after the step is known: away from each other at the
restitution's share of the approach, or none at all where the approach is no more than weight gives
in a step; where CAD moves, that is the velocity beside its own. MuJoCo's solver is told so through
the reference acceleration of its row, as hard as double precision bears, and finds the forces that
reach it, never pulling, within the cone of friction. That cone is dual to a cone of velocities, in
which what slides lifts off at friction's share of its speed; the share is taken off the reference,
and the solve repeated until it is right (De Saxce and Feng 1998; Acary, Cadoux, Lemarechal and
Malick 2011).

Depth is taken away by displacements that are solved for in the same way, as velocities of no
kinetic energy: a body between two hands, or a stack on one, goes where all contacts let it.

References
----------
Moreau, *Unilateral contact and dry friction in finite freedom dynamics*, 1988.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.effects.body_model import World
from hybridve.hull.effects.body_shape import cross
from hybridve.hull.effects.effect import GRAVITY_M_S2

#: What remains of MuJoCo's softness. A tonne on a gram sinks by a micrometre a second; of forces,
#: which are rounding over the softness, six digits are left, and at a hundredth of this four.
_SOFT = 1e-6

#: The same of displacements, of which a hundredth may be left: of two hands that are not quite
#: parallel, the way out is far to the side, and no body takes it.
_SOFT_MOVES = 100.0

#: Bodies are displaced at most by so many times the deepest depth.
_MOST_MOVE = 3.0

#: Solves for friction: until slip is known to so many metres a second, at most so often.
_SLIP_TOLERANCE, _MOST_SOLVES = 1e-5, 12

#: How deep contacts are left, metres, and stops, radians: what is pushed out farther is lost, and
#: falls back.
SLOP_M, _SLOP_RAD = 1e-4, 1e-5

#: Turning by this in a step, radians, the gyroscopic torque is found by repetition.
MOST_TURN_RAD = 0.5
_GYRATIONS = 20

_CONTACT_ROWS = (
    mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS,
    mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC,
)


@dataclass(frozen=True, slots=True, eq=False)
class HullRow:
    """One contact point of a body with the hull.

    Attributes
    ----------
    body : int
        Its number.
    point_local : (3,) float64
        Metres, in the model's frame, of the body where the solve takes it.
    normal : (3,) float64
        N_hull.
    depth_m : float
        How deep it is.
    after_m_s : float
        How fast it must leave along the normal, at least; not of displacements.
    grips : bool
        Whether an opposed contact presses the body against it, however hard: whatever friction
        there is then holds.
    """

    body: int
    point_local: NDArray[np.float64]
    normal: NDArray[np.float64]
    depth_m: float
    after_m_s: float = 0.0
    grips: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """What a solve found.

    Attributes
    ----------
    change : (nv,) float64
        Velocities after the step, or displacements.
    hull_impulse : (R,) float64
        Along the normal of each hull row, newton seconds.
    joined : (K, 2) int64
        MuJoCo's bodies that met each other.
    meets : bool
        Whether anything met anything, stops included.
    missed_m_s : float
        By how much something moves farther into the hull than it was to, at most.
    cad_work_j : dict of int to float
        What CAD that moves does to what it meets, by MuJoCo's number of the latter.
    """

    change: NDArray[np.float64]
    hull_impulse: NDArray[np.float64]
    joined: NDArray[np.int64]
    meets: bool
    missed_m_s: float = 0.0
    cad_work_j: Mapping[int, float] = field(default_factory=dict)


def least_impact(step_s: float) -> float:
    """Return the approach, metres a second, below which nothing bounces: weight's in two steps."""
    return 2.0 * GRAVITY_M_S2 * step_s


def moved(
    world: World, positions: NDArray[np.float64], rates: NDArray[np.float64], seconds: float
) -> NDArray[np.float64]:
    """Return positions (nq,) after a time at velocities (nv,)."""
    found = positions.copy()
    mujoco.mj_integratePos(world.model, found, np.ascontiguousarray(rates), seconds)
    return found


def free_velocities(
    world: World,
    data: mujoco.MjData,
    middle: NDArray[np.float64],
    velocities: NDArray[np.float64],
    step_s: float,
) -> NDArray[np.float64]:
    """Return the velocities (nv,) after a step in which nothing meets.

    Leaves in `data` the state of the middle of the step, `middle` (nq,).
    """
    model = world.model
    model.opt.timestep = step_s
    data.qpos[:], data.qvel[:] = middle, velocities
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_makeM(model, data)
    mujoco.mj_factorM(model, data)
    mujoco.mj_collision(model, data)
    mujoco.mj_makeConstraint(model, data)
    mujoco.mj_fwdVelocity(model, data)
    turning = world.dof_at[world.is_free, None] + np.arange(3, 6)
    if turning.size:
        inertia, before = world.mass_diagonal[turning], velocities[turning]
        data.qfrc_bias[turning] = _gyroscopic(inertia, before, step_s)
    mujoco.mj_fwdActuation(model, data)
    mujoco.mj_fwdAcceleration(model, data)
    return np.asarray(velocities + step_s * data.qacc_smooth)


def _gyroscopic(
    inertia: NDArray[np.float64], before: NDArray[np.float64], step_s: float
) -> NDArray[np.float64]:
    """Return w x I w (B, 3) at the mean w of the angular velocities before and after a step."""
    torque = np.zeros_like(before)
    for _ in range(_GYRATIONS):
        mean = before - (0.5 * step_s) * torque / inertia
        then = cross(mean, inertia * mean)
        if np.abs(then - torque).max() <= 1e-14 * np.abs(then).max():
            break
        torque = then
    return torque


def solve_velocities(
    world: World,
    data: mujoco.MjData,
    velocities: NDArray[np.float64],
    rows: Sequence[HullRow],
    step_s: float,
    *,
    n_own: int,
    moving: Mapping[int, NDArray[np.float64]],
    bounces: bool = True,
) -> Solved:
    """Return the velocities after a step in which bodies meet; `free_velocities` came before.

    Parameters
    ----------
    world, data
        The model, and the state in the middle of the step.
    velocities : (nv,) float64
        Before the step.
    rows : sequence of HullRow
        Contacts with the hull, the bodies taken where `data` has them.
    step_s : float
        Seconds.
    n_own : int
        How many contacts MuJoCo itself found; what others were added before goes.
    moving : mapping of int to (3, 4) float64
        CAD that moves; see `hybridve.hull.effects.body_model.cad_rates`.
    bounces : bool
        Whether bodies bounce off each other, the CAD and their stops.
    """
    model = world.model
    data.ncon = n_own
    _constrain(world, data, rows, _SOFT)
    if data.nefc == 0:
        free = np.asarray(velocities + step_s * data.qacc_smooth)
        return Solved(free, np.zeros(len(rows)), np.zeros((0, 2), np.int64), False)
    # Rates of rows are those of bodies beside the CAD that they meet.
    beside = _cad_row_rates(world, data, n_own, moving)
    before = _row_rates(world, data, velocities) + beside
    after = np.zeros(data.nefc)  # of friction, in contacts and in joints: at rest
    limits = np.flatnonzero(data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)
    address = np.asarray(data.contact.efc_address, np.int64)
    pairs = model.geom_bodyid[np.asarray(data.contact.geom)].reshape(-1, 2)
    if bounces:
        is_impact = before < -least_impact(step_s)
        joint = data.efc_id[limits]
        restitution = world.restitution[model.jnt_bodyid[joint]]
        # Of a stop, the approach is an angular velocity; at 1 m it is as large as a velocity.
        after[limits] = np.where(is_impact[limits], -restitution * before[limits], 0.0)
    own = np.flatnonzero(address[:n_own] >= 0)
    hit, gap_m = address[own], np.maximum(np.asarray(data.contact.dist)[own], 0.0)
    after[hit] = -gap_m / step_s  # what does not touch yet may come so near
    if bounces:
        restitution = np.fmin(*world.restitution[pairs[own]].T)
        touches = is_impact[hit] & (before[hit] < after[hit])
        after[hit] = np.where(touches, -restitution * before[hit], after[hit])
    for row, at in zip(rows, address[n_own:].tolist(), strict=True):
        after[at] = row.after_m_s
    sliding = np.flatnonzero((np.asarray(data.contact.dim) == 3) & (address >= 0))
    at, share = address[sliding], np.asarray(data.contact.friction)[sliding, 0]
    # What is gripped cannot lift off as it slides, so it does not slide.
    grips = np.array([False] * n_own + [row.grips for row in rows])[sliding]
    share = np.where(grips, 0.0, share)
    slip = np.hypot(before[at + 1], before[at + 2])
    data.qacc_warmstart[:] = data.qacc_smooth
    for _ in range(_MOST_SOLVES):
        wanted = after.copy()
        wanted[at] -= share * slip
        data.efc_aref[:] = (wanted - before) / step_s
        mujoco.mj_fwdConstraint(model, data)
        found = velocities + step_s * data.qacc
        if not len(at):
            break
        reached = _row_rates(world, data, found) + beside
        then = np.hypot(reached[at + 1], reached[at + 2])
        is_known = np.abs(then - slip).max() <= _SLIP_TOLERANCE
        slip = then
        if is_known:
            break
        data.qacc_warmstart[:] = data.qacc
    impulses = step_s * np.asarray(data.efc_force)[address[n_own:]]
    reached = _row_rates(world, data, found)[address[n_own:]]
    asked = np.array([row.after_m_s for row in rows])
    missed_m_s = float((asked - reached).max(initial=0.0))
    meets = data.ncon > 0 or len(limits) > 0
    cad_work_j: dict[int, float] = {}
    for contact in range(n_own if moving else 0):
        rows_of = slice(address[contact], address[contact] + data.contact[contact].dim)
        work_j = -step_s * float(np.asarray(data.efc_force)[rows_of] @ beside[rows_of])
        for body in pairs[contact].tolist():
            if address[contact] >= 0 and body not in moving:
                cad_work_j[body] = cad_work_j.get(body, 0.0) + work_j
    return Solved(
        np.asarray(found), impulses, pairs.astype(np.int64), meets, missed_m_s, cad_work_j
    )


def own_depth(world: World, data: mujoco.MjData, positions: NDArray[np.float64]) -> float:
    """Return how much deeper than is left bodies are in each other, in CAD or beyond their stops.

    At positions (nq,), metres or radians; not positive if nothing need be moved.
    """
    model = world.model
    data.qpos[:], data.qvel[:] = positions, 0.0
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_makeM(model, data)
    mujoco.mj_factorM(model, data)
    mujoco.mj_collision(model, data)
    deepest = float((-np.asarray(data.contact.dist) - SLOP_M).max(initial=0.0))
    for plan, at in zip(world.plans, world.qpos_at.tolist(), strict=True):
        if plan.hinge is not None and plan.hinge.range_rad is not None:
            low, high = plan.hinge.range_rad
            beyond = max(low - positions[at], positions[at] - high) - _SLOP_RAD
            deepest = max(deepest, beyond)
    return deepest


def solve_displacements(world: World, data: mujoco.MjData, rows: Sequence[HullRow]) -> Solved:
    """Return the displacements that take bodies out of what they are in; after `own_depth`.

    Where contacts contradict each other they share what is left.
    """
    model = world.model
    n_own = data.ncon
    for contact in range(n_own):
        data.contact[contact].dim = 1
    _constrain(world, data, rows, _SOFT_MOVES, has_friction=False)
    mujoco.mj_referenceConstraint(model, data)
    kind = np.asarray(data.efc_type)
    wanted = np.zeros(data.nefc)
    is_contact = np.isin(kind, _CONTACT_ROWS)
    wanted[is_contact] = -np.asarray(data.contact.dist)[data.efc_id[is_contact]] - SLOP_M
    is_stop = kind == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT
    wanted[is_stop] = -np.asarray(data.efc_pos)[is_stop] - _SLOP_RAD
    data.efc_frictionloss[:] = 0.0
    data.efc_aref[:] = wanted
    data.qfrc_smooth[:], data.qacc_smooth[:], data.qacc_warmstart[:] = 0.0, 0.0, 0.0
    mujoco.mj_fwdConstraint(model, data)
    pairs = model.geom_bodyid[np.asarray(data.contact.geom)].reshape(-1, 2)
    most_m = _MOST_MOVE * float(wanted.max(initial=0.0))
    change = np.array(data.qacc)
    reach_m = np.linalg.norm(change[world.dof_at[world.is_free, None] + np.arange(3)], axis=1)
    change *= min(1.0, most_m / max(float(reach_m.max(initial=0.0)), 1e-12))
    return Solved(change, np.zeros(len(rows)), pairs.astype(np.int64), True)


def _constrain(
    world: World,
    data: mujoco.MjData,
    rows: Sequence[HullRow],
    softness: float,
    *,
    has_friction: bool = True,
) -> None:
    """Add contacts with the hull to those that MuJoCo found, and prepare the solve."""
    for row in rows:
        contact = mujoco.MjContact()
        contact.dist = -row.depth_m
        contact.pos = row.point_local
        side = cross(row.normal, np.eye(3)[np.abs(row.normal).argmin()])
        side /= np.linalg.norm(side)
        contact.frame = np.concatenate([row.normal, side, cross(row.normal, side)])
        contact.includemargin = 0.0
        friction = world.plans[row.body].friction if has_friction else 0.0
        contact.friction = [friction, friction, 0.0, 0.0, 0.0]
        contact.dim = 3 if friction > 0 else 1
        contact.solref = [0.02, 1.0]
        contact.solimp = [0.9999, 0.9999, 0.001, 0.5, 2.0]
        contact.geom = [world.hull_geom, world.geom_id[row.body]]
        contact.geom1, contact.geom2 = world.hull_geom, int(world.geom_id[row.body])
        contact.flex = contact.elem = contact.vert = [-1, -1]
        contact.exclude = 0
        if mujoco.mj_addContact(world.model, data, contact):
            raise MemoryError("MuJoCo has no room for another contact")
    mujoco.mj_makeConstraint(world.model, data)
    if data.nefc == 0:
        return
    mujoco.mj_projectConstraint(world.model, data)
    data.efc_R[:] *= softness
    data.efc_D[:] = 1.0 / np.asarray(data.efc_R)


def _cad_row_rates(
    world: World,
    data: mujoco.MjData,
    n_own: int,
    moving: Mapping[int, NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Return the rates of all rows that the motion of CAD makes, of bodies at rest."""
    found = np.zeros(data.nefc)
    for number in range(n_own if moving else 0):
        contact = data.contact[number]
        if contact.efc_address < 0:
            continue
        for geom, sign in zip(contact.geom.tolist(), (-1.0, 1.0), strict=True):
            rates = moving.get(int(world.model.geom_bodyid[geom]))
            if rates is not None:
                velocity = rates[:, :3] @ contact.pos + rates[:, 3]
                rows = contact.frame.reshape(3, 3)[: contact.dim] @ velocity
                found[contact.efc_address : contact.efc_address + contact.dim] += sign * rows
    return found


def _row_rates(
    world: World, data: mujoco.MjData, rates: NDArray[np.float64]
) -> NDArray[np.float64]:
    found = np.zeros(data.nefc)
    mujoco.mj_mulJacVec(world.model, data, found, np.ascontiguousarray(rates))
    return found
