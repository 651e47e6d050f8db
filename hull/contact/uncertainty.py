"""How far a contact or a clearance can be trusted: what outlines, cameras and bulges do to it.

The clearance of `hybridve.hull.contact.clearance` is that of the hull, and certain to a tenth of a
millimetre. What it says of the real thing depends on the silhouettes, the calibration, and on what
a hull is: everything that could be there. Here stands how much. Each number is one of these:

* **exact**: cameras that see a point; whether a verdict stands without a camera;
* **bound**, given right silhouettes (an object pixel's ray meets something real, and whatever is
  real lies in the hull of silhouettes grown by one pixel; see `hybridve.hull.contact.components`):
  how far away the real thing is at most;
* **estimate**: the standard deviation of the clearance, and what it is at least at 95 %; whether
  what touches is real. That a volume holds something real is proved, but not where in it.

What an outline does to the clearance
-------------------------------------
Let x be the hull's point nearest to the object, y the object's point nearest to x, and
u = (y - x) / |y - x|. The hull is an intersection of cones, one a camera. At x it ends where some
of them end; let m_k be their outward normals. As x is nearest, u cannot have a part that leads on
through the hull (Karush, Kuhn and Tucker):

    u = sum_k lambda_k m_k,   lambda_k >= 0.

If cone k moves outward at x by s_k metres, the clearance falls by lambda_k s_k, to first order: the
multipliers are the sensitivities. An outline that moves outward by one pixel moves its cone by

    s_k = |l|,   J_k^T l = m_k,

where J_k (2, 3) holds the derivatives of the pixel by the point: a step along m_k by one metre
moves the projection by 1 / |l| pixels along the outline's normal. lambda is found by non-negative
least squares over the cameras that have background within `_NEAR_PX` of x's projection.

Pixels make stairs of an outline, and x is the corner of a step; m_k is that of the smoothed outline
(`hybridve.hull.query.walk.silhouette_normal`). Where no combination comes within `_MOST_RESIDUAL`
of u (fingertips of a few pixels, holes), the clearance is measured again with the silhouette of
each of these cameras grown by one pixel all round, which moves straight outlines by 1 to 1.4 px.

Where more cones meet in x than are needed to end the hull there, lambda is not unique: one outline
alone that moves outward then changes nothing, one that moves inward does. The m_per_px and std_m
told are one of the answers, and nearer to the latter. What the clearance is at least takes all
of them: with e_k the outlines' errors, the hull reaches farther by ``min_v sum_k lambda_vk s_k
e_k`` over all sets v of cones that end it (duality of linear programs), so that it ends too early
if any of them has moved inward. Of two cameras that look level at the top of a thing, one has in
10 % of recordings by more than 1.645 standard deviations.

Where the hull reaches into a closed object, the same holds of the deepest point, with u reversed:
the signed clearance falls as the depth grows.

What moves an outline
---------------------
Per camera, in pixels: `OutlineErrors`. Segmentation, undistortion and rounding are independent from
camera to camera and add up in squares: ``sum (m_per_px[k] * sigma_px[k]) ** 2``. The calibration is
not: cameras that were placed by one board err together. A rig that knows its covariance
(`hybridve.calib.solving.covariance`) tells that of the images (e_1, .., e_C) of the point x; with
n_k the outline's outward normal in image k, the clearance errs by ``sum m_per_px[k] n_k . e_k``,
whose variance follows. Other rigs tell how far they missed the corners of their board, which stands
for an independent error. The lower bound less 1.645 standard deviations is what the clearance is at
least, at 95 % on one side; less more than that where several sets of cones end the hull.

What is not in it: a silhouette that is wrong by more than its outline (a hand cut off, a chair that
was not there before) has no standard deviation; the last numbers, of cameras left out, tell what
hangs on one silhouette.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import Pose
from hybridve.hull.contact.bulge import real_upper
from hybridve.hull.contact.clearance import Clearance, ClearanceMeter
from hybridve.hull.contact.components import (
    NOWHERE,
    Coverage,
    Volumes,
    connected_volumes,
    cover,
    grown_beside,
    is_real,
    is_real_at,
)
from hybridve.hull.contact.cones import (
    any_beyond,
    is_near_background,
    outline_sensitivity,
    outline_ways,
)
from hybridve.hull.contact.detect import Contact
from hybridve.hull.contact.outline_errors import DoubtSettings, OutlineErrors
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, Views, hull_of

#: One-sided 95 % of a normal distribution, in standard deviations.
ONE_SIDED_95 = 1.645

#: Non-negative combinations of the cones' normals that are farther than this from the direction to
#: the object (a unit vector) explain it badly: about 20 degrees.
_MOST_RESIDUAL = 0.35

#: Nearer than this there is no direction from the hull to the object.
_NO_DIRECTION_M = 1e-7

#: An object nearer than so many times the clearance that it requires is looked at closely.
_NEAR_REQUIRED = 2.0

#: Collision points that are asked whether they stand without a camera.
_MOST_POINTS = 4096

#: So many of a contact's points are asked for a proof that it is real before volumes are made.
_QUICK_POINTS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Doubt:
    """How far one object's contact or clearance in one frame can be trusted.

    Attributes
    ----------
    std_m : float
        Estimate: standard deviation of the clearance (of the depth, where the hull reaches into a
        closed object; 0 where it covers the object's innermost point, so that no outline matters).
        NaN where no clearance is known, or there is no direction from the hull to the surface.
    at_least_m : float
        Estimate: what the clearance is at least, at 95 %; not below 0. NaN with `std_m`. It is the
        lower bound less 1.645 `std_m`, or less more where any of several sets of cones ends the
        hull.
    real_upper_m : float
        Bound, given right silhouettes: the real thing is not farther away than this; 0 if it
        certainly reaches into a closed object; inf where no ray tells; NaN where the object is too
        far away to be looked at closely (`DoubtSettings.near_m`).
    m_per_px : (C,) float64
        Estimate: by how many metres the clearance falls when a camera's outline moves outward by
        one pixel.
    is_remeasured : bool
        Whether the latter were found by measuring again with silhouettes grown by a pixel, because
        the outlines' directions do not explain the direction to the object.
    n_seeing : int
        Exact: how many cameras see the contact, or the hull's nearest point.
    survives : bool or None
        Exact: whether the verdict, touched or not, stands with any one camera left out; None where
        the object is too far away to be looked at closely: it may stand, or not.
    hinges_on : tuple of str
        Exact: the cameras without which it does not, none where that was not looked at. A contact
        stands if one of its known points does, a free object if it is certainly free: not within
        the meter's tolerance of the hull.
    component : "real", "unsure" or ""
        Estimate: "real" if the volume that touches or is nearest is proved to hold something real,
        given right silhouettes, somewhere: it may be a phantom where it touches, if a neck of the
        hull, as thin as a cell, joins it to something real; "unsure" if each pixel it explains is
        explained by another volume, too, as of a phantom; "" where there is no volume, where it is
        farther away than cells are looked for, or the object is too far away to be looked at
        closely.
    """

    std_m: float
    at_least_m: float
    real_upper_m: float
    m_per_px: NDArray[np.float64]
    is_remeasured: bool
    n_seeing: int
    survives: bool | None
    hinges_on: tuple[str, ...]
    component: Literal["real", "unsure", ""]


@dataclass(frozen=True, slots=True, eq=False)
class Deviation:
    """How far a clearance may be off.

    Attributes
    ----------
    std_m : float
        Standard deviation, metres. NaN where no clearance is known, or there is no direction from
        the hull to the surface.
    too_large_95_m : float
        By how much it is found too large in no more than 5 % of recordings, metres; NaN likewise.
    m_per_px : (C,) float64
        By how many metres it falls as each camera's outline moves outward by a pixel.
    is_remeasured : bool
        Whether the latter were found by measuring anew.
    """

    std_m: float
    too_large_95_m: float
    m_per_px: NDArray[np.float64]
    is_remeasured: bool


class Doubter:
    """Doubts the contacts of a recording, frame by frame.

    Parameters
    ----------
    errors : OutlineErrors
        Of the cameras.
    settings : DoubtSettings, optional
        Those that `errors` were made with.
    """

    def __init__(self, errors: OutlineErrors, settings: DoubtSettings | None = None) -> None:
        self.errors = errors
        self._settings = settings or DoubtSettings()

    def frame(
        self, hull: Hull, tracking_from_tracker: Mapping[str, Pose] | None = None
    ) -> "FrameDoubts":
        """Return one that doubts all objects of a frame; what they share is computed once.

        Parameters
        ----------
        hull : Hull
            Of the frame.
        tracking_from_tracker : mapping of str to (3, 4) float64, optional
            Where the trackers of moving cameras were.
        """
        errors = self.errors
        if errors.rig is not None and tracking_from_tracker:
            errors = replace(errors, rig=errors.rig.at(tracking_from_tracker))
        return FrameDoubts(hull, errors, self._settings)


@dataclass(eq=False)
class FrameDoubts:
    """Doubts all objects of one frame. Nothing is computed before an object asks for it."""

    hull: Hull
    errors: OutlineErrors
    settings: DoubtSettings
    _is_real: dict[int, bool] = field(default_factory=dict, init=False)

    @cached_property
    def _beside(self) -> tuple[Hull, Hull]:
        return grown_beside(self.hull)

    @property
    def grown(self) -> Hull:
        """The hull of silhouettes grown by one pixel."""
        return self._beside[0]

    @cached_property
    def volumes(self) -> Volumes:
        """Its connected volumes."""
        return connected_volumes(self.grown, self.settings.cell_m)

    @cached_property
    def _coverage(self) -> Coverage:
        return cover(self.volumes)

    @cached_property
    def _fewer(self) -> list[Hull]:
        """The hulls without one camera each."""
        return [without_camera(self.hull, camera) for camera in range(len(self.hull.views))]

    def doubt(
        self,
        meter: ClearanceMeter,
        contact: Contact,
        clearance: Clearance,
        required_m: float = 0.0,
    ) -> Doubt:
        """Return how far an object's contact and clearance can be trusted.

        Parameters
        ----------
        meter : ClearanceMeter
            Of the object.
        contact : Contact
            Of the object in this frame.
        clearance : Clearance
            Of the object in this frame.
        required_m : float
            The clearance that the object requires.
        """
        deviation = self.deviation(meter, clearance)
        std_m = deviation.std_m
        touching_world = _touching_points(contact)
        points_world = touching_world
        if len(points_world) == 0 and np.isfinite(clearance.on_hull_world).all():
            points_world = clearance.on_hull_world[None]
        found = Doubt(
            std_m=std_m,
            at_least_m=max(0.0, clearance.lower_m - deviation.too_large_95_m)
            if np.isfinite(std_m)
            else np.nan,
            real_upper_m=np.nan,
            m_per_px=deviation.m_per_px,
            is_remeasured=deviation.is_remeasured,
            n_seeing=_count_seeing(self.hull.views, points_world[0]) if len(points_world) else 0,
            survives=None,
            hinges_on=(),
            component="",
        )
        is_clash = len(touching_world) > 0 or clearance.upper_m <= 0
        near_m = max(self.settings.near_m, _NEAR_REQUIRED * required_m)
        if not is_clash and clearance.lower_m >= near_m:
            return found
        if is_clash:  # swallowed by a closed object, no sample on its surface tells
            hinges_on = self._contact_hinges_on(points_world)
        else:
            hinges_on = self._freedom_hinges_on(meter)
        return replace(
            found,
            real_upper_m=real_upper(self.hull, self.grown, meter, clearance),
            survives=not hinges_on,
            hinges_on=hinges_on,
            component=self._component(points_world),
        )

    def deviation(
        self,
        meter: ClearanceMeter,
        clearance: Clearance,
        shift_world: NDArray[np.float64] | None = None,
    ) -> Deviation:
        """Return how far a clearance may be off.

        Parameters
        ----------
        meter : ClearanceMeter
            Of the object.
        clearance : Clearance
            What it measured in this frame.
        shift_world : (3,) float64, optional
            Where it measured: by how much the object was moved, metres.
        """
        errors = self.errors
        m_per_px, is_remeasured, normals_px = self.sensitivity(meter, clearance, shift_world)
        variance_m2 = float(((m_per_px * errors.sigma_px) ** 2).sum())
        if np.isfinite(variance_m2):
            variance_m2 += errors.calibration_variance_m2(
                clearance.on_hull_world, m_per_px, normals_px
            )
        std_m = float(np.sqrt(variance_m2))
        too_large_m = ONE_SIDED_95 * std_m
        if not is_remeasured and std_m > 0:
            ways_m, normals_px = outline_ways(
                self.hull, clearance.on_hull_world, _direction(clearance)
            )
            if len(ways_m) > 1:
                covariance_px2 = np.diag(errors.sigma_px**2)
                covariance_px2 += errors.calibration_covariance_px2(
                    clearance.on_hull_world, normals_px, np.asarray(ways_m.any(axis=0))
                )
                too_large_m = max(too_large_m, any_beyond(ways_m, covariance_px2))
        return Deviation(std_m, too_large_m, m_per_px, is_remeasured)

    def sensitivity(
        self,
        meter: ClearanceMeter,
        clearance: Clearance,
        shift_world: NDArray[np.float64] | None = None,
    ) -> tuple[NDArray[np.float64], bool, NDArray[np.float64]]:
        """Return metres per pixel (C,), whether they were measured anew, and outlines' normals.

        The normals (C, 2) are unit vectors in the images, NaN where not known. The object was
        measured in its place, or moved by `shift_world` (3,), metres.
        """
        n_cameras = len(self.hull.views)
        unknown = np.full((n_cameras, 2), np.nan)
        direction = _direction(clearance)
        if not np.isfinite(direction).all():
            return np.full(n_cameras, np.nan), False, unknown
        is_inside = _is_inside(clearance)
        sensitivity_m, residual, normals_px = outline_sensitivity(
            self.hull, clearance.on_hull_world, direction
        )
        if is_inside and not sensitivity_m.any():
            return (
                sensitivity_m,
                False,
                unknown,
            )  # the deepest point there can be: no outline ends it
        if residual <= _MOST_RESIDUAL:
            return sensitivity_m, False, normals_px
        for camera in range(n_cameras):
            if is_near_background(self.hull, camera, clearance.on_hull_world):
                then = meter.measure(self._grown_in(camera), shift_world)
                sensitivity_m[camera] = max(0.0, clearance.signed_m[1] - then.signed_m[1])
        return sensitivity_m, True, unknown

    def _grown_in(self, camera: int) -> Hull:
        """Return the hull with one camera's silhouette grown by a pixel; images are shared."""
        mask_offset, integral_offset = (
            self.hull.mask_offset.copy(),
            self.hull.integral_offset.copy(),
        )
        mask_offset[camera] = len(self.hull.masks_flat) + self.grown.mask_offset[camera]
        integral_offset[camera] = len(self.hull.integrals_flat) + self.grown.integral_offset[camera]
        return replace(self._beside[1], mask_offset=mask_offset, integral_offset=integral_offset)

    def _contact_hinges_on(self, points_world: NDArray[np.float64]) -> tuple[str, ...]:
        """Return the cameras without which no known point of a contact is left."""
        views = self.hull.views
        if len(views) == 1:
            return views.names
        if views.unseen == "carve":
            return ()  # a camera only carves: without it the hull is larger
        return tuple(
            name
            for name, fewer in zip(views.names, self._fewer, strict=True)
            if not contains_points(fewer, points_world).any()
        )

    def _freedom_hinges_on(self, meter: ClearanceMeter) -> tuple[str, ...]:
        """Return the cameras without which an object is not certainly free."""
        views = self.hull.views
        if len(views) == 1:
            return views.names
        return tuple(
            name
            for name, fewer in zip(views.names, self._fewer, strict=True)
            if not meter.measure(fewer, stop_above_m=0.0, stop_below_m=0.0).lower_m > 0
        )

    def _component(self, points_world: NDArray[np.float64]) -> Literal["real", "unsure", ""]:
        """Return whether one of the volumes that hold points is proved to hold something real."""
        for point_world in points_world[:_QUICK_POINTS]:
            if is_real_at(self.hull, self.grown, point_world):
                return "real"
        held_by = np.unique(self.volumes.at(points_world))
        held_by = held_by[held_by != NOWHERE]
        if len(held_by) == 0:
            return ""
        return "real" if any(self._proves(int(volume)) for volume in held_by) else "unsure"

    def _proves(self, volume: int) -> bool:
        if volume not in self._is_real:
            self._is_real[volume] = is_real(self.hull, self.volumes, self._coverage, volume)
        return self._is_real[volume]


def _touching_points(contact: Contact) -> NDArray[np.float64]:
    """Return points of a contact (P, 3), the witness first; evenly chosen where there are many."""
    witness_world = contact.witness_world[None]
    if not np.isfinite(witness_world).all():
        witness_world = np.zeros((0, 3))
    return np.concatenate([witness_world, contact.some_points(_MOST_POINTS)[0]])


def _count_seeing(views: Views, point_world: NDArray[np.float64]) -> int:
    """Return how many cameras see a point."""
    n_seeing = 0
    for camera, (width, height) in enumerate(views.sizes_px.tolist()):
        x, y, depth_m = views.project(point_world, camera).tolist()
        if not (depth_m > 0 and 0 <= x < width * depth_m and 0 <= y < height * depth_m):
            continue
        recorded = views.seen_mask(camera)
        column, row = min(int(x / depth_m), width - 1), min(int(y / depth_m), height - 1)
        n_seeing += recorded is None or bool(recorded[row, column])  # division may round up
    return n_seeing


def without_camera(hull: Hull, camera: int) -> Hull:
    """Return the hull of all cameras but one; images are shared, not copied.

    Where ``min_cameras`` asks for all of them, it asks for one less.

    Raises
    ------
    ValueError
        If there is only one.
    """
    views = hull.views
    if len(views) < 2:
        raise ValueError("there is one camera; without it there is no hull")
    return hull_of(hull, np.delete(np.arange(len(views)), camera))


def _is_inside(clearance: Clearance) -> bool:
    """Tell whether what was measured is how deep the hull reaches into a closed object."""
    return clearance.upper_m <= 0 and clearance.depth_lower_m > 0


def _direction(clearance: Clearance) -> NDArray[np.float64]:
    """Return the unit vector (3,) along which the clearance falls as the hull grows; NaN if none.

    From the hull to the object, or, of a hull that reaches into it, on into it.
    """
    toward = clearance.on_object_world - clearance.on_hull_world
    distance_m = float(np.linalg.norm(toward))
    if not distance_m > _NO_DIRECTION_M:  # or NaN
        return np.full(3, np.nan)
    return np.asarray(toward / (-distance_m if _is_inside(clearance) else distance_m))
