"""Whether the way out of the hull frees the whole object, and which shift along it does.

D_rec moves CP_obj out of the hull, the point that lies deepest as RP_obj sees it (section 4.3 of
the paper). Other points of the object may still be in it, or get into it on the way. Here the whole
object is moved and measured: what is said is proved, by the bounds of the clearance.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.query.silhouettes import Hull

#: The first step beyond D_rec: a share of it, metres at least. Each next one is twice as long.
_STEP, _LEAST_STEP_M = 1.0 / 4.0, 1e-3

#: Halvings between a shift that is not certain to free and one that does, until they are this share
#: of the latter apart.
_APART = 1.0 / 32.0


@dataclass(frozen=True, slots=True)
class Recovery:
    """What moving an object along V_rec does.

    Attributes
    ----------
    frees : "yes", "no", "open" or ""
        Whether the whole object is free of the hull, moved by D_rec and the meter's tolerance:
        "yes" and "no" are proved. "" where there is no D_rec.
    blocked_m, free_m : float
        A shift along V_rec that is not certain to free it, and a larger one that is proved to; the
        latter inf where none was found, both NaN where there is no D_rec. Beyond it the object may
        meet the hull again.
    """

    frees: Literal["yes", "no", "open", ""]
    blocked_m: float
    free_m: float


def recover(
    hull: Hull,
    meter: ClearanceMeter,
    v_rec: NDArray[np.float64],
    d_rec_m: float,
    reach_m: float,
) -> Recovery:
    """Return whether an object that is moved along V_rec gets free, and by which shift.

    Parameters
    ----------
    hull : Hull
        The hull of one frame.
    meter : ClearanceMeter
        Of the object.
    v_rec : (3,) float64
        Unit vector, world frame.
    d_rec_m : float
        D_rec, metres; NaN where it is not known.
    reach_m : float
        The largest shift that is tried.
    """
    if not np.isfinite(d_rec_m):
        return Recovery("", np.nan, np.nan)
    first_m = d_rec_m + meter.tolerance_m

    def frees(shift_m: float) -> Literal["yes", "no", "open"]:
        found = meter.measure(hull, shift_m * v_rec, stop_above_m=0.0, stop_below_m=0.0)
        lower_m, upper_m = found.signed_m
        if lower_m > 0.0:
            return "yes"
        return "no" if upper_m <= 0.0 else "open"

    answer = frees(first_m)
    if answer == "yes":
        return Recovery(answer, d_rec_m, first_m)
    blocked_m, free_m, step_m = first_m, np.inf, max(_STEP * d_rec_m, _LEAST_STEP_M)
    while blocked_m < reach_m:
        shift_m = min(blocked_m + step_m, reach_m)
        if frees(shift_m) == "yes":
            free_m = shift_m
            break
        blocked_m, step_m = shift_m, 2.0 * step_m
    while np.isfinite(free_m) and free_m - blocked_m > max(_APART * free_m, meter.tolerance_m):
        middle_m = 0.5 * (blocked_m + free_m)
        if frees(middle_m) == "yes":
            free_m = middle_m
        else:
            blocked_m = middle_m
    return Recovery(answer, blocked_m, free_m)
