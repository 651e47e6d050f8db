"""What is told of rigid and hinged bodies: columns of the file, books of each, and their shapes."""

from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.effects.body_model import BodyPlan, Places, World, places_of, twist_of
from hybridve.hull.effects.body_shape import CollisionShape
from hybridve.hull.effects.effect import CAD_WORK, Drawn, Quantity, Told
from hybridve.hull.effects.hull_contacts import HullContact

_POSE = Quantity(
    "world_from_mesh",
    "m",
    "exact",
    "rotation and place of the mesh, of the simulated state",
    (3, 4),
    is_place=True,
)

#: The arrows of the paper's figure 5, of the deepest contact since the frame before.
_ARROWS = (
    Quantity(
        "cp_obj_m",
        "m",
        "sampled",
        "CP_obj of the deepest contact since the frame before; NaN where there was none",
        (3,),
        is_place=True,
    ),
    Quantity("cp_hull_m", "m", "estimate", "CP_hull of that contact", (3,), is_place=True),
    Quantity("v_rec", "1", "estimate", "V_rec of that contact, a unit vector", (3,)),
    Quantity("n_hull", "1", "estimate", "N_hull of that contact, a unit vector", (3,)),
)

RIGID_COLUMNS = (
    Quantity("position_m", "m", "exact", "centre of mass", (3,), is_place=True),
    Quantity(
        "orientation_wxyz",
        "1",
        "exact",
        "how it has turned since it stood as the scene has it: a unit quaternion",
        (4,),
    ),
    Quantity("velocity_m_s", "m/s", "exact", "of the centre of mass", (3,)),
    Quantity("angular_velocity_rad_s", "rad/s", "exact", "in the world's frame", (3,)),
    _POSE,
    CAD_WORK,
    *_ARROWS,
)

HINGE_COLUMNS = (
    Quantity("angle_rad", "rad", "exact", "from its place in the scene, about its axis"),
    Quantity("angular_velocity_rad_s", "rad/s", "exact", "about its axis"),
    _POSE,
    CAD_WORK,
    *_ARROWS,
)


@dataclass(slots=True, eq=False)
class Books:
    """What is told of one body, since the start or since the frame before."""

    hull_work_j: float = 0.0
    cad_work_j: float = 0.0
    penetration_m: float = 0.0
    n_contacts: int = 0
    deepest_m: float = 0.0
    arrows: NDArray[np.float64] = field(default_factory=lambda: np.full((4, 3), np.nan))

    def meet(self, contact: HullContact) -> None:
        """Count a contact."""
        self.n_contacts += len(contact.points_world)
        if contact.out_m > self.deepest_m:
            self.deepest_m = contact.out_m
            start = contact.points_world[0]
            end = start + contact.out_m * contact.v_rec
            self.arrows = np.stack([start, end, contact.v_rec, contact.n_hull])

    def begin_frame(self) -> None:
        """Count anew what is counted since the frame before."""
        self.penetration_m, self.n_contacts, self.deepest_m = 0.0, 0, 0.0
        self.arrows = np.full((4, 3), np.nan)


def told_of(world: World, plan: BodyPlan) -> Told:
    """Return what will be told of a body, and what it was resolved to."""
    scene_object, share = plan.scene_object, plan.share
    shape = world.shapes[scene_object.name]
    is_closed = scene_object.is_closed
    about = {
        "object": scene_object.name,
        "mass_kg": plan.mass_kg,
        "mass_lies_in": "its volume" if is_closed else "its area, for its surface is open",
        "volume_m3": abs(share.volume_m3) if is_closed else None,
        "center_of_mass_m": share.center.tolist(),
        "moments_of_inertia_kg_m2": (plan.mass_kg * share.inertia_m2).tolist(),
        "collides_with_the_hull_as": "its mesh",
        "collides_with_bodies_and_cad_as": _shape_in_words(shape),
        "outside_its_mesh_by_at_most_m": shape.outside_m,
        "cad_collides_as": {
            name: _shape_in_words(one)
            for name, one in world.shapes.items()
            if name not in {other.scene_object.name for other in world.plans}
        },
        "friction_along_the_hull": "as if its surface stood: silhouettes do not show it slide",
        "does_not_meet": [other for name, other in world.unmet if name == plan.name],
    }
    mesh = scene_object.vertices_mesh
    return Told(
        columns=RIGID_COLUMNS if plan.hinge is None else HINGE_COLUMNS,
        drawn=Drawn(
            "world_from_mesh",
            scene_object.vertices_world if mesh is None else mesh,
            scene_object.faces,
        ),
        about=about,
    )


def _shape_in_words(shape: CollisionShape) -> str:
    words = []
    if shape.n_convex:
        words.append(f"{shape.n_convex} convex part{'s' if shape.n_convex > 1 else ''} of its mesh")
    if shape.n_prisms:
        words.append(f"{shape.n_prisms} triangles {1000 * shape.prism_m:.1f} mm thick")
    return " and ".join(words)


def pose_of(
    world: World,
    scene_places: Places,
    positions: NDArray[np.float64],
    velocities: NDArray[np.float64],
    body: int,
) -> dict[str, NDArray[Any]]:
    """Return what is told of where a body is and how it moves, at positions (nq,).

    `scene_places` are those that bodies have in the scene.
    """
    plan, places = world.plans[body], places_of(world, positions)
    rotation = places.rotation[body] @ scene_places.rotation[body].T
    center_world = places.center_local[body] + world.origin_world
    shift = center_world - rotation @ plan.share.center
    mesh = plan.scene_object.world_from_mesh
    pose = np.column_stack([rotation @ mesh[:, :3], rotation @ mesh[:, 3] + shift])
    dof = int(world.dof_at[body])
    if plan.hinge is not None:
        return {
            "angle_rad": np.asarray(positions[world.qpos_at[body]]),
            "angular_velocity_rad_s": np.asarray(velocities[dof]),
            "world_from_mesh": pose,
        }
    orientation = np.zeros(4)
    mujoco.mju_mat2Quat(orientation, np.ascontiguousarray(rotation).ravel())
    linear, angular = twist_of(world, places, velocities, body)
    return {
        "position_m": center_world,
        "orientation_wxyz": orientation,
        "velocity_m_s": linear.copy(),
        "angular_velocity_rad_s": angular,
        "world_from_mesh": pose,
    }
