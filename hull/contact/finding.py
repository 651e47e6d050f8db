"""All that one frame says of one object, bundled."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hybridve.hull.contact.backtrack import FirstContact
from hybridve.hull.contact.clearance import Clearance
from hybridve.hull.contact.detect import Contact, no_contact
from hybridve.hull.contact.respond import Response
from hybridve.hull.contact.verdict import Facts, Verdict, judge

if TYPE_CHECKING:
    from hybridve.hull.contact.patches import Patch
    from hybridve.hull.contact.recovery import Recovery
    from hybridve.hull.contact.uncertainty import Doubt


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
    first_contact : FirstContact or None
        How this contact began, of an object that was free in the frame before.
    first_contact_s, first_contact_uncertainty_s : float
        The same instant in seconds from the session's first frame, and how far off it can be.
    response : Response or None
        Which way an object that is touched must give.
    doubt : Doubt or None
        How far contact and clearance can be trusted.
    recovery : Recovery or None
        Whether the response frees the whole object.
    patches : tuple of Patch
        The connected pieces of the hull that touch it, or come nearer than it requires.
    verdict : Verdict
        Whether it keeps its distance.
    reason : str
        Why, or what that rests on; empty where it goes without saying.
    """

    contact: Contact
    clearance: Clearance | None = None
    approach_m_s: tuple[float, float] = (np.nan, np.nan)
    first_contact: FirstContact | None = None
    first_contact_s: float = np.nan
    first_contact_uncertainty_s: float = np.nan
    response: Response | None = None
    doubt: "Doubt | None" = None
    recovery: "Recovery | None" = None
    patches: "tuple[Patch, ...]" = ()
    verdict: Verdict = "unknown"
    reason: str = ""

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

    @property
    def clashes(self) -> bool:
        """Whether the hull touches the object or is inside it."""
        return self.touches or self.is_inside


def judged(
    finding: Finding,
    *,
    is_closed: bool,
    required_m: float,
    share_seen: float,
    rests_on: str,
    is_sound: bool = True,
) -> Finding:
    """Return a finding with its verdict; see `hybridve.hull.contact.verdict.Facts`."""
    clearance = finding.clearance
    verdict, reason = judge(
        Facts(
            finding.touches,
            finding.is_inside,
            is_closed,
            finding.contact.certificate,
            finding.contact.open_at_m,
            (np.nan, np.nan) if clearance is None else (clearance.lower_m, clearance.upper_m),
            required_m,
            share_seen,
            rests_on,
            is_sound,
        )
    )
    return replace(finding, verdict=verdict, reason=reason)


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
        return no_contact(contact.body), clearance
    return contact, clearance


def widened(clearance: Clearance, off_by_m: float) -> Clearance:
    """Return the clearance of a surface that the triangles are this far from at most, metres.

    A contact, 0 and 0, stays that of the triangles, as everything does that is said of it.
    """
    if off_by_m == 0.0:
        return clearance
    if clearance.upper_m > 0.0:
        clearance = replace(
            clearance,
            lower_m=max(clearance.lower_m - off_by_m, 0.0),
            upper_m=clearance.upper_m + off_by_m,
        )
    if clearance.depth_upper_m > 0.0:
        clearance = replace(
            clearance,
            depth_lower_m=max(clearance.depth_lower_m - off_by_m, 0.0),
            depth_upper_m=clearance.depth_upper_m + off_by_m,
        )
    return clearance


def signed_clearance(clearance: Clearance) -> tuple[float, float]:
    """Return bounds of the clearance, depth counting as negative; metres.

    How deep the hull is in an object that is not closed is not known: the lower bound is -inf where
    it may touch.
    """
    lower_m, upper_m = clearance.signed_m
    if np.isnan(clearance.depth_lower_m) and clearance.lower_m <= 0.0:
        lower_m = -np.inf
    return lower_m, upper_m
