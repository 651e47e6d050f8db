"""Hinged bodies: a door or a lid that a hand pushes along its arc."""

from typing import Annotated

import numpy as np
from pydantic import Field, field_validator

from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.effects.bodies import BodyTable, Motion, Vector, make_bodies, software
from hybridve.hull.effects.body_model import Hinge
from hybridve.hull.effects.effect import EffectKind, Entry


class HingeTable(BodyTable):
    """The keys of a hinged body.

    Attributes
    ----------
    axis : (float, float, float)
        Of the hinge, in the frame of the mesh turned z up, as `reference_point_mm`; the body turns
        about it as a right hand's fingers bend.
    anchor_mm : (float, float, float)
        A point of the axis, in that frame.
    range_deg : (float, float) or None
        From where to where it turns, from its place in the scene; by default all around.
    angle_deg : float
        Where it is at the start.
    damping_n_m_s : float
        Viscous friction: torque for each radian a second.
    friction_n_m : float
        Dry friction: torque.
    """

    axis: Vector
    anchor_mm: Vector
    range_deg: tuple[float, float] | None = None
    angle_deg: float = 0.0
    damping_n_m_s: Annotated[float, Field(ge=0)] = 0.0
    friction_n_m: Annotated[float, Field(ge=0)] = 0.0

    @field_validator("axis")
    @classmethod
    def _has_length(cls, axis: Vector) -> Vector:
        if not any(axis):
            raise ValueError("[0, 0, 0] has no length; give a direction")
        return axis

    @field_validator("range_deg")
    @classmethod
    def _is_not_empty(cls, range_deg: tuple[float, float] | None) -> tuple[float, float] | None:
        if range_deg is not None and not range_deg[0] < range_deg[1]:
            raise ValueError(
                f"found {list(range_deg)}, expected the smaller angle first, and some room between"
            )
        return range_deg

    def motion(self, entry: Entry, scene_object: SceneObject) -> Motion:
        """Return how it begins; raises `SceneError` if it hangs elsewhere or out of its range."""
        rotation, translation = np.split(scene_object.world_from_mesh, [3], axis=1)
        anchor_world = rotation @ np.array(self.anchor_mm) / 1000.0 + translation[:, 0]
        lower, upper = scene_object.box_world
        away_m = float(
            np.linalg.norm(np.maximum(0, np.maximum(lower - anchor_world, anchor_world - upper)))
        )
        size_m = float(np.linalg.norm(upper - lower))
        if away_m > size_m:
            raise entry.error(
                f"found {list(self.anchor_mm)}, {1000 * away_m:.0f} mm off {scene_object.name!r}, "
                f"which is {1000 * size_m:.0f} mm large; expected a point at or in it, in the "
                "frame of its mesh",
                "anchor_mm",
            )
        if self.range_deg is not None and not (
            self.range_deg[0] <= self.angle_deg <= self.range_deg[1]
        ):
            raise entry.error(
                f"found {self.angle_deg:g}, expected an angle within range_deg, "
                f"{self.range_deg[0]:g} to {self.range_deg[1]:g}",
                "angle_deg",
            )
        axis = rotation @ np.array(self.axis)
        hinge = Hinge(
            axis=axis / np.linalg.norm(axis),
            anchor_world=anchor_world,
            range_rad=None
            if self.range_deg is None
            else tuple(np.radians(self.range_deg).tolist()),
            friction_n_m=self.friction_n_m,
            damping_n_m_s=self.damping_n_m_s,
        )
        return Motion(hinge=hinge, angle_rad=float(np.radians(self.angle_deg)))


KIND = EffectKind("hinge", HingeTable, make_bodies, software)
