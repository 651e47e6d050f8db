"""Rigid bodies: a thrown ball, a part that falls, a stack; pushed by whatever is real."""

import numpy as np

from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.effects.bodies import (
    BodyTable,
    Motion,
    Vector,
    make_bodies,
    software,
)
from hybridve.hull.effects.effect import EffectKind, Entry


class RigidTable(BodyTable):
    """The keys of a rigid body.

    Attributes
    ----------
    velocity_m_s : (float, float, float)
        Of its centre of mass at the start, world.
    angular_velocity_deg_s : (float, float, float)
        At the start, about the world's axes.
    """

    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    angular_velocity_deg_s: Vector = (0.0, 0.0, 0.0)

    def motion(self, entry: Entry, scene_object: SceneObject) -> Motion:
        """Return how it begins: its keys go with every object."""
        del entry, scene_object
        return Motion(np.array(self.velocity_m_s), np.radians(self.angular_velocity_deg_s))


KIND = EffectKind("rigid", RigidTable, make_bodies, software)
