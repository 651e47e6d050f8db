"""From ``[[effect]]`` tables of rigid and hinged bodies to one world in which all of them meet."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.effects.body_model import BodyPlan, Hinge
from hybridve.hull.effects.body_shape import MassShare, mass_share
from hybridve.hull.effects.body_solver import MOST_TURN_RAD
from hybridve.hull.effects.body_steps import Bodies
from hybridve.hull.effects.effect import EffectTable, Entry, Setting

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """How a body begins, and what holds it.

    Attributes
    ----------
    velocity_m_s, angular_velocity_rad_s : (3,) float64
        World.
    hinge : Hinge or None
    angle_rad : float
        Of the hinge.
    """

    velocity_m_s: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    angular_velocity_rad_s: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    hinge: Hinge | None = None
    angle_rad: float = 0.0


class BodyTable(EffectTable):
    """The keys of everything that has mass and does not bend.

    Attributes
    ----------
    object : str
        Which of the scene's objects.
    mass_kg, density_kg_m3 : float or None
        Exactly one of them. A closed mesh is filled evenly; the mass of an open one lies evenly on
        its area.
    restitution : float
        The share of its approach at which it leaves what it hits, 0 to 1; of two bodies the
        smaller counts.
    friction : float
        Coulomb's coefficient; of two bodies the larger counts.
    gravity : bool
        Whether it has weight.
    """

    object: str
    mass_kg: Annotated[float, Field(gt=0)] | None = None
    density_kg_m3: Annotated[float, Field(gt=0)] | None = None
    restitution: Annotated[float, Field(ge=0, le=1)] = 0.5
    friction: Annotated[float, Field(ge=0)] = 0.5
    gravity: bool = True

    @model_validator(mode="after")
    def _has_one_mass(self) -> Self:
        if (self.mass_kg is None) == (self.density_kg_m3 is None):
            found = "neither" if self.mass_kg is None else "both"
            raise ValueError(f"found {found} of mass_kg and density_kg_m3; give one of them")
        return self

    @property
    def claimed(self) -> tuple[str, ...]:
        """The object that it moves."""
        return (self.object,)

    @abstractmethod
    def motion(self, entry: Entry, scene_object: SceneObject) -> Motion:
        """Return how it begins; raises `SceneError` where its keys do not go with the object."""


def make_bodies(entries: Sequence[Entry], setting: Setting) -> Bodies:
    """Return all rigid and hinged bodies of a scene, simulated together.

    Raises
    ------
    SceneError
        If an entry names no object, or its keys do not go with it.
    """
    return Bodies([_plan_of(entry, setting) for entry in entries], setting)


def _plan_of(entry: Entry, setting: Setting) -> BodyPlan:
    table: BodyTable = entry.table
    scene_object = setting.object_of(entry, table.object)
    faces = scene_object.faces
    share = _share_of(entry, scene_object)
    if scene_object.is_closed and share.volume_m3 < 0:  # inside out
        faces = np.ascontiguousarray(faces[:, ::-1])
    if table.mass_kg is not None:
        mass_kg = table.mass_kg
    else:
        assert table.density_kg_m3 is not None
        mass_kg = table.density_kg_m3 * abs(share.volume_m3)
    motion = table.motion(entry, scene_object)
    _refuse_fast_turns(entry, motion, setting.step_s)
    return BodyPlan(
        name=entry.name,
        scene_object=scene_object,
        faces=faces,
        share=share,
        mass_kg=mass_kg,
        restitution=table.restitution,
        friction=table.friction,
        has_weight=table.gravity,
        velocity_m_s=motion.velocity_m_s,
        angular_velocity_rad_s=motion.angular_velocity_rad_s,
        hinge=motion.hinge,
        angle_rad=motion.angle_rad,
    )


def _share_of(entry: Entry, scene_object: SceneObject) -> MassShare:
    if entry.table.density_kg_m3 is not None and not scene_object.is_closed:
        raise entry.error(
            f"the mesh of {scene_object.name!r} is open and has no volume to fill; give mass_kg",
            "density_kg_m3",
        )
    try:
        return mass_share(
            scene_object.vertices_world, scene_object.faces, is_closed=scene_object.is_closed
        )
    except ValueError as error:
        raise entry.error(
            f"the mesh of {scene_object.name!r} has no {error} for its mass to lie in", "object"
        ) from error


def _refuse_fast_turns(entry: Entry, motion: Motion, step_s: float) -> None:
    rate_rad_s = float(np.linalg.norm(motion.angular_velocity_rad_s))
    if rate_rad_s * step_s > MOST_TURN_RAD:
        raise entry.error(
            f"found {np.degrees(rate_rad_s):.0f} degrees a second, "
            f"{np.degrees(rate_rad_s * step_s):.0f} in one step of {step_s:g} s, expected at most "
            f"{np.degrees(MOST_TURN_RAD):.0f} a step; take a shorter step",
            "angular_velocity_deg_s",
        )


def software() -> dict[str, str]:
    """Return the libraries that the numbers depend on, and their versions."""
    return {name: version(name) for name in ("mujoco-core", "numpy", "scipy")}
