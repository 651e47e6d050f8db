"""All that one frame says of one object, bundled."""

from dataclasses import dataclass, replace

import numpy as np

from hybridve.hull.contact.clearance import Clearance
from hybridve.hull.contact.detect import Contact


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """One object in one frame. What was not computed, or has no meaning there, is None or NaN.

    Attributes
    ----------
    contact : Contact
        Whether it is touched, where, and how sure that is.
    clearance : Clearance or None
        How far the hull is from it.
    approach_m_s : (float, float)
        Bounds of the mean speed at which hull and object came nearer since the frame before,
        metres per second; negative where they parted.
    """

    contact: Contact
    clearance: Clearance | None = None
    approach_m_s: tuple[float, float] = (np.nan, np.nan)

    @property
    def touches(self) -> bool:
        """Whether a point of the object's surface is in the hull, sampled or certified."""
        return self.contact.collides or self.contact.certificate == "colliding"

    @property
    def is_inside(self) -> bool:
        """Whether the hull is in a closed object without touching its surface."""
        return (
            not self.touches and self.clearance is not None and self.clearance.depth_lower_m > 0.0
        )


def agreed(contact: Contact, clearance: Clearance) -> tuple[Contact, Clearance]:
    """Return a contact and a clearance of one object, each with what the other one proves.

    A witness is a point of the surface in the hull: the clearance is 0. A lower bound above 0 is a
    proof that no point of the object is in the hull, also of an object that was only sampled, and
    of one whose samples were rounded across the rim of a silhouette in single precision.
    """
    if contact.certificate == "colliding":
        is_deep = clearance.depth_lower_m > 0.0
        return contact, replace(
            clearance,
            lower_m=0.0,
            upper_m=0.0,
            on_object_world=clearance.on_object_world if is_deep else contact.witness_world,
            on_hull_world=clearance.on_hull_world if is_deep else contact.witness_world,
        )
    if clearance.lower_m > 0.0 and contact.certificate != "free":
        nothing = Contact("free", np.zeros((0, 3), np.float32), np.zeros(0, np.uint32))
        return nothing, clearance
    return contact, clearance


def approach_speed(before: Clearance, after: Clearance, seconds: float) -> tuple[float, float]:
    """Return bounds of the mean speed at which hull and object came nearer, metres per second.

    Depth beneath the surface of a closed object counts as negative distance.

    Parameters
    ----------
    before, after : Clearance
        Of two frames.
    seconds : float
        The time between them, above 0.
    """
    lower_before_m, upper_before_m = before.signed_m
    lower_after_m, upper_after_m = after.signed_m
    return (
        (lower_before_m - upper_after_m) / seconds,
        (upper_before_m - lower_after_m) / seconds,
    )
