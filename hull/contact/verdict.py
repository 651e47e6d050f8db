"""The answer to the question that was asked: whether a part keeps its distance from real things.

One word for each object in each frame, and for each object over all frames, the worst of its
frames. "kept" is said only where it is proved; everything else names what stands in its way.
"""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from hybridve.calib.lengths import mm

#: From the worst on. "clash": a point of the surface is in the hull, sampled or certified.
#: "inside": the hull is in the closed object without touching its surface. "too near": the hull is
#: certainly nearer than the required clearance. "unknown": the frame could not be evaluated, or its
#: silhouettes contradict each other. "open": nothing of that was found, nor is it proved.
#: "not seen": the object stands where no point can be in the hull, whatever is there. "kept":
#: proved, the hull keeps the required clearance; without one, no point of the object is in it.
Verdict = Literal["clash", "inside", "too near", "unknown", "open", "not seen", "kept"]

VERDICTS: tuple[Verdict, ...] = get_args(Verdict)


@dataclass(frozen=True, slots=True)
class Facts:
    """What one evaluated frame says of one object.

    Attributes
    ----------
    touches, is_inside : bool
        Whether the hull touches its surface, or is within it.
    is_closed : bool
        Whether it bounds a solid, within which a hull could be.
    certificate : str
        Of the contact: "colliding", "free", "open" or "".
    open_at_m : float
        No disc of this diameter on the surface is in the hull; NaN unless "open".
    clearance_m : (float, float)
        Bounds of the clearance, metres; NaN where it was not measured.
    required_m : float
        The clearance that the object requires.
    share_seen : float
        Share of its surface that lies where the hull could be: in the sight of all cameras, or of
        as many as must see a point. 0 only if no point of it does; NaN where nobody asked.
    rests_on : str
        What an empty hull rests on, in words; empty if it is not empty.
    is_sound : bool
        Whether such a hull may be believed: not if silhouettes miss each other, be it by less than
        they err.
    """

    touches: bool
    is_inside: bool
    is_closed: bool
    certificate: str
    open_at_m: float = math.nan
    clearance_m: tuple[float, float] = (math.nan, math.nan)
    required_m: float = 0.0
    share_seen: float = math.nan
    rests_on: str = ""
    is_sound: bool = True


def judge(facts: Facts) -> tuple[Verdict, str]:
    """Return the verdict on an object in an evaluated frame, and its reason in words.

    Examples
    --------
    >>> near = Facts(False, False, True, "free", clearance_m=(0.0155, 0.0156), required_m=0.1)
    >>> judge(near)
    ('too near', 'at most 15.60 mm away, 100.00 mm are required')
    >>> judge(Facts(False, False, True, "free", clearance_m=(0.2, 0.2001), required_m=0.1))
    ('kept', '')
    """
    lower_m, upper_m = facts.clearance_m
    required = f"{mm(facts.required_m)} mm are required"
    if facts.touches:
        return "clash", ""
    if facts.is_inside:
        return "inside", "within the closed part, beneath its surface"
    if upper_m < facts.required_m:
        return "too near", f"at most {mm(upper_m)} mm away, {required}"
    if facts.share_seen == 0.0:
        return "not seen", "outside what the cameras can tell: no point of it can be in the hull"
    if not facts.is_sound:
        return "open", facts.rests_on
    if lower_m < facts.required_m:
        return "open", f"between {mm(lower_m)} and {mm(upper_m)} mm away, {required}"
    if math.isnan(lower_m) and facts.required_m > 0:
        return "open", f"the clearance was not measured, {required}"
    if facts.certificate == "open":
        return "open", f"a contact less than {mm(facts.open_at_m)} mm wide may hide"
    if facts.certificate != "free":
        return "open", "no sample collides, which proves nothing of what lies between them"
    if lower_m == 0.0:
        return "open", f"at most {mm(upper_m)} mm away, perhaps not at all"
    if math.isnan(lower_m) and facts.is_closed:
        return "open", "its surface is free; whether something is wholly inside was not asked"
    words = [facts.rests_on] if facts.rests_on else []
    if facts.share_seen < 1.0:
        unseen = 100.0 * (1.0 - facts.share_seen)
        words.append(f"{unseen:.0f} % of its surface lies outside what the cameras can tell")
    return "kept", "; ".join(words)


def worst(verdicts: "set[str]") -> Verdict:
    """Return the worst of verdicts; "unknown" of none.

    Examples
    --------
    >>> worst({"kept", "open", "too near"})
    'too near'
    """
    return next((verdict for verdict in VERDICTS if verdict in verdicts), "unknown")
