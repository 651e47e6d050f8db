"""Rigid and hinged bodies and the CAD they meet, as one MuJoCo model.

Every body is a tree of its own with its frame at the centre of mass and along the principal axes,
so that the mass matrix is diagonal. The model's origin is the local one of the cameras.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError
from hybridve.calib.pose import Pose, rotation_of
from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.effects.body_shape import (
    CollisionShape,
    MassShare,
    collision_shape,
    cross,
)
from hybridve.hull.effects.effect import GRAVITY_M_S2, Course

#: How hard MuJoCo's constraints are: as hard as it allows. `hybridve.hull.effects.body_solver`
#: makes them harder still.
_HARD = [0.9999, 0.9999, 0.001, 0.5, 2.0]

#: Bodies this near to each other are asked not to come nearer than touching, metres: what is
#: stacked without a gap stays where it is.
_NEAR_M = 1e-4

#: What collides is at most in so many pieces: more take minutes to prepare.
_MOST_PIECES = 30_000

#: Name of the geom that the hull's contacts are told of; it stands for nothing itself.
_HULL = "hull"


@dataclass(frozen=True, slots=True, eq=False)
class Hinge:
    """How a hinged body is held.

    Attributes
    ----------
    axis : (3,) float64
        Unit vector, world.
    anchor_world : (3,) float64
        A point of the axis, metres.
    range_rad : (float, float) or None
        From where to where it turns from its place in the scene; None for all around.
    friction_n_m : float
        Torque of dry friction.
    damping_n_m_s : float
        Torque for each radian a second; of viscous friction.
    """

    axis: NDArray[np.float64]
    anchor_world: NDArray[np.float64]
    range_rad: tuple[float, float] | None
    friction_n_m: float
    damping_n_m_s: float


@dataclass(frozen=True, slots=True, eq=False)
class BodyPlan:
    """One body, with its place at the start.

    Attributes
    ----------
    name : str
        Of its entry.
    scene_object : SceneObject
        Its mesh, as it stands in the scene.
    faces : (T, 3) int32
        Of the mesh; of a closed one all outwards.
    share : MassShare
        Of its mesh, in the world's frame.
    mass_kg : float
    restitution, friction : float
    has_weight : bool
    velocity_m_s, angular_velocity_rad_s : (3,) float64
        At the start, world; of a rigid body.
    hinge : Hinge or None
        None for a rigid body.
    angle_rad : float
        Of a hinge at the start.
    """

    name: str
    scene_object: SceneObject
    faces: NDArray[np.int32]
    share: MassShare
    mass_kg: float
    restitution: float
    friction: float
    has_weight: bool
    velocity_m_s: NDArray[np.float64]
    angular_velocity_rad_s: NDArray[np.float64]
    hinge: Hinge | None = None
    angle_rad: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """A MuJoCo model and where bodies are found in it.

    Attributes
    ----------
    model : mujoco.MjModel
    origin_world : (3,) float64
        Of its coordinates, metres.
    plans : tuple of BodyPlan
        The bodies, B of them.
    shapes : dict of str to CollisionShape
        What collides in place of each object.
    body_id, geom_id : (B,) int64
        MuJoCo's number of each body, and of one of its geoms.
    obstacle_id : dict of str to int
        MuJoCo's number of the body that stands for each object of CAD.
    hull_geom : int
        The geom that contacts with the hull are told of.
    qpos_at, dof_at : (B,) int64
        Where the position and the velocity of each body begin.
    is_free : (B,) bool
        Whether it is rigid, not hinged.
    mass_diagonal : (nv,) float64
        The mass matrix.
    restitution : (n bodies of MuJoCo,) float64
        Of each of its bodies; NaN for CAD.
    unmet : tuple of (str, str)
        Hinged bodies and what they reach into at the start; these do not meet.
    """

    model: mujoco.MjModel
    origin_world: NDArray[np.float64]
    plans: tuple[BodyPlan, ...]
    shapes: dict[str, CollisionShape]
    body_id: NDArray[np.int64]
    geom_id: NDArray[np.int64]
    obstacle_id: dict[str, int]
    hull_geom: int
    qpos_at: NDArray[np.int64]
    dof_at: NDArray[np.int64]
    is_free: NDArray[np.bool_]
    mass_diagonal: NDArray[np.float64]
    restitution: NDArray[np.float64]
    unmet: tuple[tuple[str, str], ...]


def make_world(
    plans: Sequence[BodyPlan], obstacles: Sequence[SceneObject], origin_world: NDArray[np.float64]
) -> World:
    """Return the model of bodies and of the CAD that they meet, which is at rest in it.

    Raises
    ------
    SceneError
        If MuJoCo refuses it.
    """
    shapes = {}
    for scene_object, faces in (
        *((plan.scene_object, plan.faces) for plan in plans),
        *((one, one.faces) for one in obstacles),
    ):
        shapes[scene_object.name] = collision_shape(
            scene_object.vertices_world, faces, is_closed=scene_object.is_closed
        )
    n_pieces = sum(len(shape.pieces) for shape in shapes.values())
    if n_pieces > _MOST_PIECES:
        most = max(shapes, key=lambda name: len(shapes[name].pieces))
        raise SceneError(
            f"what bodies can meet is in {n_pieces} pieces, {len(shapes[most].pieces)} of them of "
            f"{most!r}, expected at most {_MOST_PIECES}; simulate with a coarser mesh of it, or "
            "without it"
        )
    unmet: tuple[tuple[str, str], ...] = ()
    world = _compiled(plans, obstacles, origin_world, shapes, unmet)
    unmet = _overlaps_of_hinges(world, obstacles)
    return _compiled(plans, obstacles, origin_world, shapes, unmet) if unmet else world


def _compiled(
    plans: Sequence[BodyPlan],
    obstacles: Sequence[SceneObject],
    origin_world: NDArray[np.float64],
    shapes: dict[str, CollisionShape],
    unmet: tuple[tuple[str, str], ...],
) -> World:
    spec = mujoco.MjSpec()
    spec.compiler.boundmass = 0.0
    spec.option.gravity = [0.0, 0.0, -GRAVITY_M_S2]
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.option.iterations = 100
    spec.option.tolerance = 1e-12
    # Hull contacts come after the collisions, of which islands are made.
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_ISLAND
    marker = spec.worldbody.add_geom(
        name=_HULL, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-3, 0.0, 0.0]
    )
    marker.contype, marker.conaffinity = 0, 0
    for one in obstacles:
        # As something that can be moved: where CAD moves, only its pose does.
        body = spec.worldbody.add_body(name=f"obstacle {one.name}", mocap=True)
        pieces = [points - origin_world for points in shapes[one.name].pieces]
        _add_pieces(spec, body, one.name, pieces, friction=0.0)
    for plan in plans:
        _add_body(spec, plan, origin_world, shapes[plan.scene_object.name])
    for name, other in unmet:
        spec.add_exclude(bodyname1=f"body {name}", bodyname2=f"obstacle {other}")
    try:
        model = spec.compile()
    except ValueError as error:
        raise SceneError(f"MuJoCo refuses the bodies of this scene: {error}") from error
    body_id = np.array([model.body(f"body {plan.name}").id for plan in plans], np.int64)
    joint = model.body_jntadr[body_id]
    dof_at = model.jnt_dofadr[joint].astype(np.int64)
    restitution = np.full(model.nbody, np.nan)
    restitution[body_id] = [plan.restitution for plan in plans]
    return World(
        model=model,
        origin_world=origin_world,
        plans=tuple(plans),
        shapes=shapes,
        body_id=body_id,
        geom_id=model.body_geomadr[body_id].astype(np.int64),
        obstacle_id={one.name: int(model.body(f"obstacle {one.name}").id) for one in obstacles},
        hull_geom=int(model.geom(_HULL).id),
        qpos_at=model.jnt_qposadr[joint].astype(np.int64),
        dof_at=dof_at,
        is_free=np.array([plan.hinge is None for plan in plans]),
        mass_diagonal=_mass_diagonal(plans, dof_at, model.nv),
        restitution=restitution,
        unmet=unmet,
    )


def _add_pieces(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    name: str,
    pieces: Sequence[NDArray[np.float64]],
    friction: float,
) -> None:
    for number, points in enumerate(pieces):
        mesh = spec.add_mesh(name=f"{name} {number}")
        mesh.uservert = points.ravel().tolist()
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=mesh.name,
            condim=3 if friction > 0 else 1,
            friction=[friction, 0.0, 0.0],
            solimp=_HARD,
            margin=_NEAR_M,
        )


def _add_body(
    spec: mujoco.MjSpec, plan: BodyPlan, origin_world: NDArray[np.float64], shape: CollisionShape
) -> None:
    share = plan.share
    body = spec.worldbody.add_body(
        name=f"body {plan.name}",
        pos=share.center - origin_world,
        gravcomp=0.0 if plan.has_weight else 1.0,
    )
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(share.axes).ravel())
    body.quat = quat
    body.explicitinertial = True
    body.mass = plan.mass_kg
    body.ipos = [0.0, 0.0, 0.0]
    body.iquat = [1.0, 0.0, 0.0, 0.0]
    body.inertia = plan.mass_kg * share.inertia_m2
    if plan.hinge is None:
        body.add_freejoint()
    else:
        hinge = plan.hinge
        joint = body.add_joint(
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=share.axes.T @ hinge.axis,
            pos=share.axes.T @ (hinge.anchor_world - share.center),
            frictionloss=hinge.friction_n_m,
            solimp_limit=_HARD,
            solimp_friction=_HARD,
        )
        if hinge.range_rad is not None:
            joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
            joint.range = list(np.degrees(hinge.range_rad))
    pieces = [(points - share.center) @ share.axes for points in shape.pieces]
    _add_pieces(spec, body, plan.scene_object.name, pieces, plan.friction)


def _mass_diagonal(
    plans: Sequence[BodyPlan], dof_at: NDArray[np.int64], n_dofs: int
) -> NDArray[np.float64]:
    diagonal = np.zeros(n_dofs)
    for plan, at in zip(plans, dof_at.tolist(), strict=True):
        inertia = plan.mass_kg * plan.share.inertia_m2
        if plan.hinge is None:
            diagonal[at : at + 3] = plan.mass_kg
            diagonal[at + 3 : at + 6] = inertia
        else:
            axis = plan.hinge.axis
            arm = cross(axis, plan.share.center - plan.hinge.anchor_world)
            about_center = inertia @ (plan.share.axes.T @ axis) ** 2
            diagonal[at] = about_center + plan.mass_kg * (arm @ arm)
    return diagonal


def start_of(world: World) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the positions (nq,) and velocities (nv,) at the start, in MuJoCo's coordinates."""
    positions, velocities = world.model.qpos0.copy(), np.zeros(world.model.nv)
    for plan, at, dof in zip(
        world.plans, world.qpos_at.tolist(), world.dof_at.tolist(), strict=True
    ):
        if plan.hinge is not None:
            positions[at] = plan.angle_rad
        else:
            velocities[dof : dof + 3] = plan.velocity_m_s
            velocities[dof + 3 : dof + 6] = plan.share.axes.T @ plan.angular_velocity_rad_s
    return positions, velocities


def place_cad(world: World, data: mujoco.MjData, world_from_rest: Mapping[str, Pose]) -> None:
    """Put objects of CAD, by name, where they are seen from where the scene puts them."""
    origin = world.origin_world
    for name, pose in world_from_rest.items():
        at = world.model.body_mocapid[world.obstacle_id[name]]
        rotation = np.ascontiguousarray(pose[:, :3])
        data.mocap_pos[at] = rotation @ origin + pose[:, 3] - origin
        mujoco.mju_mat2Quat(data.mocap_quat[at], rotation.ravel())


def cad_rates(
    world: World, courses: Mapping[str, Course], step_s: float
) -> dict[int, NDArray[np.float64]]:
    """Return by MuJoCo's number of CAD that moves what takes a point of it to its velocity.

    (3, 4) each, of a point in the model's frame in the middle of the step.
    """
    rates = {}
    for name, course in courses.items():
        velocity = course.velocity(step_s)
        turning = velocity[:, :3] @ course.middle[:, :3].T
        shift = turning @ (world.origin_world - course.middle[:, 3]) + velocity[:, 3]
        rates[world.obstacle_id[name]] = np.column_stack([turning, shift])
    return rates


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where bodies are.

    Attributes
    ----------
    center_local : (B, 3) float64
        Centres of mass, metres, in the model's frame.
    rotation : (B, 3, 3) float64
        World from the principal axes.
    """

    center_local: NDArray[np.float64]
    rotation: NDArray[np.float64]


def places_of(world: World, positions: NDArray[np.float64]) -> Places:
    """Return where bodies are at positions (nq,)."""
    n_bodies = len(world.plans)
    center, rotation = np.zeros((n_bodies, 3)), np.zeros((n_bodies, 3, 3))
    free = np.flatnonzero(world.is_free)
    at = world.qpos_at[free, None]
    center[free] = positions[at + np.arange(3)]
    rotation[free] = _rotations(positions[at + np.arange(3, 7)])
    for body in np.flatnonzero(~world.is_free).tolist():
        plan = world.plans[body]
        assert plan.hinge is not None
        anchor = plan.hinge.anchor_world - world.origin_world
        turn = rotation_of(positions[world.qpos_at[body]] * plan.hinge.axis)
        center[body] = anchor + turn @ (plan.share.center - plan.hinge.anchor_world)
        rotation[body] = turn @ plan.share.axes
    return Places(center, rotation)


def _rotations(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rotations (N, 3, 3) of quaternions (N, 4), w first, of length 1 but for rounding."""
    w, x, y, z = quaternions.T / np.linalg.norm(quaternions, axis=1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def twist_of(
    world: World, places: Places, rates: NDArray[np.float64], body: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how a body's centre moves and how it turns, (3,) and (3,), world.

    Of velocities (nv,) in metres and radians a second, or of whatever has their coordinates.
    """
    at, hinge = int(world.dof_at[body]), world.plans[body].hinge
    if hinge is None:
        return rates[at : at + 3], places.rotation[body] @ rates[at + 3 : at + 6]
    turning = rates[at] * hinge.axis
    arm = places.center_local[body] - (hinge.anchor_world - world.origin_world)
    return cross(turning, arm), turning


def energies(
    world: World, places: Places, velocities: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the kinetic and the potential energy of each body, (B,) and (B,) joules.

    The potential is that of weight, about the model's origin.
    """
    halves = 0.5 * world.mass_diagonal * velocities**2
    kinetic = np.array(
        [
            halves[at : at + (6 if is_free else 1)].sum()
            for at, is_free in zip(world.dof_at.tolist(), world.is_free.tolist(), strict=True)
        ]
    )
    weight = np.array([plan.mass_kg * plan.has_weight * GRAVITY_M_S2 for plan in world.plans])
    return kinetic, weight * places.center_local[:, 2]


def _overlaps_of_hinges(
    world: World, obstacles: Sequence[SceneObject]
) -> tuple[tuple[str, str], ...]:
    """Return the hinged bodies and the CAD that stands and that they reach into at the start.

    A door overlaps its frame where it hangs. Were they to meet, it would never turn.
    """
    obstacles = [one for one in obstacles if one.motion is None]
    if world.is_free.all() or not obstacles:
        return ()
    data = mujoco.MjData(world.model)
    data.qpos[:] = start_of(world)[0]
    mujoco.mj_fwdPosition(world.model, data)
    hinged = {
        int(world.body_id[body]): world.plans[body].name
        for body in np.flatnonzero(~world.is_free).tolist()
    }
    standing = {world.obstacle_id[one.name]: one.name for one in obstacles}
    found = set()
    for pair in world.model.geom_bodyid[data.contact.geom].tolist():
        for body, other in (pair, pair[::-1]):
            if body in hinged and other in standing:
                found.add((hinged[body], standing[other]))
    return tuple(sorted(found))
