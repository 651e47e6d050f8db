"""Which way an object must give, and how far: section 4.3 of the paper, and the same exactly.

From CP_obj, the collision point farthest from the object's reference point RP_obj, the object is
backed out along the recovery vector V_rec: towards RP_obj, or in the direction of an object that
is constrained (a hinged door). V_rec leaves the visual hull at CP_hull, D_rec away, where the
normal of the hull is N_hull. RP_obj gives V_rec its direction and nothing else: where it lies
nearer than the height of the triangle below, the search begins beyond it all the same, for the
object as a whole is moved.

As published
------------
A triangle ABC, A = CP_obj, has a small angle at A and a height along V_rec. Stepping along V_rec
from the base BC, CP_hull is the first sample within the hull; stepping along BA and CA gives I and
J, along DA and EA of a second triangle DAE, perpendicular to ABC, K and L, and N_hull is the cross
product of IJ and KL. Only the five lines that are read are sampled, each at `window` + 1 positions
from A to the base, so that CP_hull is off by less than height / window: 0.0125 cm at 5 cm and 400.
Where the paper leaves room: BC is parallel to the cross product of V_rec with the axis of the
world that it is farthest from (the first of equals); N_hull is turned so that V_rec leaves along it
(its dot product with V_rec is positive).

Exactly
-------
`hybridve.hull.query.walk` gives the stretches of V_rec that lie in the hull, to rounding. The
search of the paper, from the height back to CP_obj, meets the last stretch that begins below the
height, and so does this one; but where the base lies in the hull, it goes on to that stretch's true
end, up to `reach_m`. N_hull is the normal of the silhouette that ends it; of several, at a crease
of the hull, of the first camera in the order of the views that has one.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.contact.detect import Contact
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.walk import (
    boundary_cameras,
    contains_few,
    silhouette_normal,
    spans_in_hull,
)

#: What is wrong with an exact answer. "": nothing. "no direction": CP_obj lies at RP_obj; no vector
#: is known. "no exit": V_rec is in the hull up to `ResponseSettings.reach_m`. "outside": CP_obj is
#: outside the hull in double precision, or on its very rim, and V_rec does not enter it below the
#: height: there is nothing to recover from, D_rec is 0, CP_hull is CP_obj, and only N_hull is
#: unknown. "no normal": the silhouette has no direction at CP_hull, or one that points back.
Status = Literal["", "no direction", "no exit", "outside", "no normal"]

#: The same of an answer as published. "base inside": so is the middle of BC, and nothing is known.
#: "outside": no sample along V_rec is in the hull; nothing is known. "missed": the stretch that the
#: exact search ends in lies between two samples; another one was found. "no normal": I, J, K and L
#: were not all found, or span no plane.
PaperStatus = Literal["", "no direction", "base inside", "outside", "missed", "no normal"]

#: A collision point is rounded where it is placed. One no farther from RP_obj than this, as a share
#: of its largest coordinate, has no direction to it but that of its rounding.
_SAME_POINT = 2.0**-46

#: Two vectors whose angle has no larger sine span no plane.
_NO_PLANE = 1e-6


@dataclass(frozen=True, slots=True)
class ResponseSettings:
    """How the hull is searched along V_rec.

    Attributes
    ----------
    angle_rad : float
        The paper's angle BAC, between 0 and pi.
    height_m : float
        Height of ABC, metres.
    window : int
        Steps between A and the base.
    reach_m : float
        How far the exact search follows the hull, metres; at least the height.
    """

    angle_rad: float = np.radians(10.0)
    height_m: float = 0.05
    window: int = 400
    reach_m: float = 2.0

    def __post_init__(self) -> None:
        if not 0 < self.angle_rad < np.pi:
            raise ValueError(f"angle_rad is {self.angle_rad}, expected an angle of a triangle")
        if not 0 < self.height_m <= self.reach_m < np.inf:
            raise ValueError(
                f"height_m is {self.height_m} and reach_m {self.reach_m}, "
                "expected positive lengths, the height no larger"
            )
        if self.window < 1:
            raise ValueError(f"window is {self.window}, expected 1 or more")


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """How to move one object out of the hull of one frame.

    What is not known is NaN, and the status says why.

    Attributes
    ----------
    cp_obj_world : (3,) float64
        CP_obj, metres.
    v_rec : (3,) float64
        V_rec, a unit vector, world frame.
    cp_hull_world : (3,) float64
        CP_hull, metres: where V_rec leaves the hull.
    n_hull : (3,) float64
        N_hull, a unit vector that points out of the hull, world frame.
    d_rec_m : float
        D_rec: the distance of `cp_obj_world` and `cp_hull_world`.
    status : Status
        What is wrong with it; "" if nothing is.
    cp_hull_paper_world, n_hull_paper, d_rec_paper_m, status_paper
        The same as published.
    """

    cp_obj_world: NDArray[np.float64]
    v_rec: NDArray[np.float64]
    cp_hull_world: NDArray[np.float64]
    n_hull: NDArray[np.float64]
    d_rec_m: float
    status: Status
    cp_hull_paper_world: NDArray[np.float64]
    n_hull_paper: NDArray[np.float64]
    d_rec_paper_m: float
    status_paper: PaperStatus

    @property
    def difference_m(self) -> float:
        """D_rec as published less the exact one, metres; NaN where either is unknown."""
        return self.d_rec_paper_m - self.d_rec_m


def respond(
    hull: Hull,
    contact: Contact,
    *,
    reference_point_world: NDArray[np.float64],
    recovery_direction: NDArray[np.float64] | None = None,
    settings: ResponseSettings | None = None,
    cp_obj_world: NDArray[np.float64] | None = None,
) -> Response:
    """Return how to move an object out of the hull that it collides with.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    contact : Contact
        A contact that collides: with points, or with a witness alone.
    reference_point_world : (3,) float64
        RP_obj, metres.
    recovery_direction : (3,) float64, optional
        V_rec of a constrained object, world frame, of any length; by default towards RP_obj.
    settings : ResponseSettings, optional
        By default those of the paper.
    cp_obj_world : (3,) float64, optional
        CP_obj where it is known better, metres; by default `collision_point`.

    Raises
    ------
    ValueError
        If the contact has neither points nor a witness and no CP_obj is given, the recovery
        direction has no length, or a point is not finite.
    """
    if settings is None:
        settings = ResponseSettings()
    if not np.isfinite(reference_point_world).all():
        raise ValueError(f"RP_obj is {reference_point_world}, expected a finite point")
    if cp_obj_world is None:
        cp_obj_world = collision_point(contact, reference_point_world)
    if not np.isfinite(cp_obj_world).all():
        raise ValueError(f"CP_obj is {cp_obj_world}, expected a finite point")
    v_rec = _recovery_vector(cp_obj_world, reference_point_world, recovery_direction)
    nowhere = np.full(3, np.nan)
    if v_rec is None:
        unknown = (nowhere, nowhere, np.nan)
        return Response(cp_obj_world, nowhere, *unknown, "no direction", *unknown, "no direction")
    exact = _exactly(hull, cp_obj_world, v_rec, settings)
    cp_hull_world, n_hull, d_rec_m, status = _as_published(hull, cp_obj_world, v_rec, settings)
    spacing_m = settings.height_m / settings.window
    if abs(d_rec_m - exact[2]) > spacing_m * (1 + 1e-9):  # not where either is NaN
        status = "missed"
    return Response(cp_obj_world, v_rec, *exact, cp_hull_world, n_hull, d_rec_m, status)


def collision_point(
    contact: Contact, reference_point_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return CP_obj (3,): the collision point farthest from RP_obj, metres.

    Of several, the first in the order of x, then y, then z: whatever the order they come in. Of a
    contact without points, its witness.

    Raises
    ------
    ValueError
        If the contact has neither.
    """
    if not contact.collides:
        if np.isnan(contact.witness_world).any():
            raise ValueError("the contact has neither a collision point nor a witness")
        return contact.witness_world
    return farthest_from(reference_point_world, contact.end_points())


def farthest_from(
    reference_point_world: NDArray[np.float64], points_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the one of points (P, 3) that is farthest from a reference point (3,), world frame.

    Of several, the first in the order of x, then y, then z.
    """
    # Summed by hand: a reduction may add in another order for another number of points.
    x, y, z = (points_world[:, axis] - reference_point_world[axis] for axis in range(3))
    squared = x * x + y * y + z * z
    farthest = points_world[squared == squared.max()]
    first: NDArray[np.float64] = farthest[np.lexsort(farthest.T[::-1])[0]]
    return first


def _recovery_vector(
    cp_obj_world: NDArray[np.float64],
    reference_point_world: NDArray[np.float64],
    recovery_direction: NDArray[np.float64] | None,
) -> NDArray[np.float64] | None:
    """Return V_rec as a unit vector, None if CP_obj lies at RP_obj."""
    if recovery_direction is not None:
        length = float(np.linalg.norm(recovery_direction))
        if not 0 < length < np.inf:
            raise ValueError(f"recovery_direction is {recovery_direction}, expected a direction")
        return np.asarray(recovery_direction / length)
    towards = reference_point_world - cp_obj_world
    distance_m = float(np.linalg.norm(towards))
    if distance_m <= _SAME_POINT * float(np.abs(cp_obj_world).max()):
        return None
    return np.asarray(towards / distance_m)


def _exactly(
    hull: Hull,
    cp_obj_world: NDArray[np.float64],
    v_rec: NDArray[np.float64],
    settings: ResponseSettings,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, Status]:
    """Return CP_hull, N_hull, D_rec and what is wrong with them, by walking the line."""
    nowhere = np.full(3, np.nan)
    # Few hulls reach beyond the height; most of a long ray's pixels would be crossed in vain.
    for reach_m in (min(2 * settings.height_m, settings.reach_m), settings.reach_m):
        spans_m = spans_in_hull(hull, cp_obj_world, v_rec, reach_m)
        spans_m = spans_m[spans_m[:, 0] < settings.height_m]
        if len(spans_m) == 0:
            return cp_obj_world, nowhere, 0.0, "outside"
        d_rec_m = float(spans_m[-1, 1])
        if d_rec_m < reach_m:
            break
    else:
        return nowhere, nowhere, np.nan, "no exit"
    cp_hull_world = cp_obj_world + d_rec_m * v_rec
    cameras = boundary_cameras(hull, cp_hull_world, v_rec)
    n_hull = _first_normal(hull, cameras, cp_hull_world, v_rec)
    return cp_hull_world, n_hull, d_rec_m, "no normal" if np.isnan(n_hull).any() else ""


def _first_normal(
    hull: Hull,
    cameras: tuple[int, ...],
    point_world: NDArray[np.float64],
    v_rec: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the normal of the first camera that has one along which V_rec leaves, NaN if none."""
    for camera in cameras:
        normal = silhouette_normal(hull, camera, point_world)
        # What is finer than the window can turn the mean direction of a rim around.
        if normal @ v_rec > 0:
            return normal
    return np.full(3, np.nan)


def _as_published(
    hull: Hull,
    cp_obj_world: NDArray[np.float64],
    v_rec: NDArray[np.float64],
    settings: ResponseSettings,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, PaperStatus]:
    """Return CP_hull, N_hull, D_rec and what is wrong with them, from samples of ABC and DAE."""
    nowhere = np.full(3, np.nan)
    across = np.cross(v_rec, np.eye(3)[np.abs(v_rec).argmin()])
    across *= np.tan(settings.angle_rad / 2) / np.linalg.norm(across)
    beside = np.cross(v_rec, across)
    # Along V_rec, AB, AC, AD and AE, by height above A.
    lines = v_rec + np.stack([np.zeros(3), across, -across, beside, -beside])  # (5, 3)
    heights_m = np.arange(settings.window + 1) * (settings.height_m / settings.window)
    samples_world = cp_obj_world + heights_m[:, None] * lines[:, None]  # (5, window + 1, 3)
    inside = contains_few(hull, samples_world.reshape(-1, 3)).reshape(samples_world.shape[:2])
    if not inside[0].any():
        return nowhere, nowhere, np.nan, "outside"
    if inside[0, -1]:
        return nowhere, nowhere, np.nan, "base inside"
    found = settings.window - inside[:, ::-1].argmax(axis=1)  # from the base
    cp_hull_world, d_rec_m = samples_world[0, found[0]], float(heights_m[found[0]])
    if inside[1:, -1].any() or not inside[1:].any(axis=1).all():
        return cp_hull_world, nowhere, d_rec_m, "no normal"
    i, j, k, l = samples_world[np.arange(1, 5), found[1:]]  # noqa: E741  # the paper's L
    ij, kl = j - i, l - k
    n_hull = np.cross(ij, kl)
    length = float(np.linalg.norm(n_hull))
    leaves = float(n_hull @ v_rec)
    if leaves == 0 or length <= _NO_PLANE * np.linalg.norm(ij) * np.linalg.norm(kl):
        return cp_hull_world, nowhere, d_rec_m, "no normal"
    return cp_hull_world, np.sign(leaves) * n_hull / length, d_rec_m, ""
