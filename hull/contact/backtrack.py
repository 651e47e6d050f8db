"""When and where the hull first touched an object: between the last free frame and the next.

The paper cannot backtrack real objects (section 4.3); a recording can look at both sides of the
instant. Between two frames nothing was seen, so the outlines between them are an *estimate*:

* Each silhouette's signed distance to its outline, positive on the object, is blended:
  ``(1 - f) d_before(x) + f d_after(x) > 0``. Distances are capped at `_CAP_PX`.
* A blend alone loses what moves by its own width in a frame: a disc of radius r that moves by D
  becomes an ellipse of half-width sqrt(r^2 - D^2/4), and nothing at D = 2 r. So what moves is
  found first (`_find_moves`): a shift s that carries the changed pixels of one frame onto those of
  the other. Then ``(1 - f) d_before(x - f s) + f d_after(x + (1 - f) s)`` is asked as well, within
  the box that moves along. A pixel is on the object where either is positive.

Why either: the distance of a convex shape is concave, and the two places asked have the mean x, or
differ from the right ones by an offset whose weighted mean is 0. By Jensen's inequality the blend
with a wrong shift lies within the blend with the right one, for what stands still as for what
moves. A shift that is off by e thins an outline of radius r by no more than e^2 / (8 r), so whole
pixels are good enough.

An outline that moves by one pixel passes that pixel half-way, by construction: a thing slower than
some pixels a frame has its contact in the middle, which is the best that can be said.

A camera that moves is taken to go straight and to turn evenly between its two poses. Both of its
silhouettes are first turned to where it looks at the instant, which is exact but for what its
straight way shifts; the rest is motion as above.

An object that moves stands, at each instant, where its own estimate of the way between its two
poses puts it (`hybridve.hull.cad.motion`).

What no shift explains and no blend keeps, something that was not there a frame before, is told by
the status "outline lost": then the instant is unknown within the frame.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.capture.outline_motion import CAP_PX, OUTLINE_PX, Outline, signed_distance_px
from hybridve.hull.capture.pixel_boxes import (
    contains,
    grown_box,
    intersection,
    slices_of,
)
from hybridve.hull.contact.between import Between
from hybridve.hull.contact.detect import Body, Contact
from hybridve.hull.contact.windows import windows_of
from hybridve.hull.query.certify import COLLIDING, Certifier
from hybridve.hull.query.engine import Engine
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, Views, interpolated_views
from hybridve.hull.query.viewport import sample_positions

#: First looks at each frame pair, evenly spaced: contact is not assumed to last once begun.
_N_COARSE = 16

#: The first colliding fraction is known to this.
_RESOLUTION = 1.0 / 256

#: Halfway, a blend covers about half of what was gained; below this share its outline is lost.
_LOST_SHARE = 0.25

#: Samples across the square in which the patch of first contact is looked for, and triangles.
_PATCH_SAMPLES = 33
_PATCH_TRIANGLES = 32

#: Collision points of an engine that are asked again in double precision.
_MOST_SAMPLES = 4096


@dataclass(frozen=True, slots=True, eq=False)
class FirstContact:
    """When and where the hull first touched an object, between two frames.

    Attributes
    ----------
    fraction : float
        Estimate: the instant, 0 at the last free frame, 1 at the first that collides.
    fraction_uncertainty : float
        Bound: how far the instant can be from it. All that is certain is that it lies between the
        two frames: ``max(fraction, 1 - fraction)``.
    point_world : (3,) float64
        Metres: estimate of the point of first contact. It lies on the object's surface, of one
        that moves as it stood at that instant.
    status : str
        ``""``: as described. ``"outline lost"``: what touches was not there a frame before, or
        moved in a way that cannot be followed; the fraction is 0.5, the point one of the second
        frame. ``"touches before"``: the object's surface is in the hull of the free frame already,
        between its samples; the fraction is 0, and contact began there or earlier.
        ``"no touch found"``: not even the second frame's hull holds a point of the surface in
        double precision; the fraction is 1, the point that of the contact.
    """

    fraction: float
    fraction_uncertainty: float
    point_world: NDArray[np.float64]
    status: str


def first_contact(
    before: Hull,
    after: Hull,
    body: Body,
    contact: Contact,
    certifier: Certifier | None,
    engine: Engine,
    body_at: Callable[[float], Body] | None = None,
) -> FirstContact:
    """Return when and where an object that is free in one frame and collides in the next was hit.

    The interpolated hulls of `_N_COARSE` instants are asked in turn, then the interval before the
    first that touches is halved down to `_RESOLUTION`.

    Parameters
    ----------
    before, after : Hull
        The last frame without and the first with a collision, of the same cameras.
    body : Body
        The object as it stands in the second frame.
    contact : Contact
        Its contact with `after`.
    certifier : Certifier or None
        Says whether a hull holds a point of the surface. Without one the samples of `engine` do,
        checked in double precision.
    engine : Engine
        Not used where there is a certifier.
    body_at : callable, optional
        Of an object that moves between the two, where it stands at a fraction of the way.

    Raises
    ------
    ValueError
        If the hulls are not of the same cameras, or the contact has neither points nor a witness.
    """
    interpolated_views(before.views, after.views, 0.5)  # other cameras are refused
    if not contact.collides and not np.isfinite(contact.witness_world).all():
        raise ValueError(f"object {body.name}: the contact has neither points nor a witness")

    def probe_at(fraction: float) -> _Probe:
        return _Probe(body if body_at is None else body_at(fraction), certifier, engine)

    if probe_at(0.0).touches(before):
        return FirstContact(0.0, 1.0, probe_at(0.0).patch_center(before), "touches before")
    if body_at is None:
        windows = windows_of(before.views, body)
    else:  # it may pass through any part of an image
        windows = [(0, height, 0, width) for width, height in before.views.sizes_px.tolist()]
    between = Between(before, after, windows)
    free, touching = 0.0, 1.0
    last_free, first_touching = before, after
    for step in range(1, _N_COARSE + 1):
        fraction = step / _N_COARSE
        hull = between.hull(fraction)
        if probe_at(fraction).touches(hull):
            touching, first_touching = fraction, hull
            break
        free, last_free = fraction, hull
    else:
        return FirstContact(1.0, 1.0, _point_of(contact), "no touch found")
    while touching - free > _RESOLUTION:
        middle = 0.5 * (free + touching)
        hull = between.hull(middle)
        if probe_at(middle).touches(hull):
            touching, first_touching = middle, hull
        else:
            free, last_free = middle, hull
    point_world = probe_at(touching).patch_center(first_touching)
    outlines = between.outlines(touching)
    if _outline_is_lost(outlines, last_free, first_touching, touching, point_world):
        return FirstContact(0.5, 0.5, probe_at(1.0).patch_center(after), "outline lost")
    return FirstContact(touching, max(touching, 1.0 - touching), point_world, "")


def approach_speed(
    clearance_before_m: tuple[float, float], clearance_last_m: tuple[float, float], dt_s: float
) -> tuple[float, float]:
    """Return bounds of the mean speed in m/s at which a clearance shrank between two frames.

    Parameters
    ----------
    clearance_before_m, clearance_last_m : (lower, upper)
        Bounds of the clearance, in metres, in the last frame but one and in the last; an upper
        bound may be infinite, and NaN says that a bound is unknown.
    dt_s : float
        Time between the two.

    Returns
    -------
    (lower, upper)
        Positive where the hull came nearer; NaN where it depends on an unknown bound, infinite
        where nothing bounds it.

    Raises
    ------
    ValueError
        If the time is not positive, or a lower bound is above its upper one.

    Examples
    --------
    From 30 to 10 mm, each known to a millimetre, in a fiftieth of a second:

    >>> lower, upper = approach_speed((0.030, 0.031), (0.010, 0.011), 0.02)
    >>> round(lower, 3), round(upper, 3)
    (0.95, 1.05)
    """
    if not 0.0 < dt_s < math.inf:
        raise ValueError(f"dt_s is {dt_s}, expected a positive time")
    for lower, upper in (clearance_before_m, clearance_last_m):
        if lower > upper:
            raise ValueError(f"a clearance of {lower} to {upper} m: the bounds are the wrong way")
    return (
        _difference(clearance_before_m[0], clearance_last_m[1], -math.inf) / dt_s,
        _difference(clearance_before_m[1], clearance_last_m[0], math.inf) / dt_s,
    )


def _difference(first: float, second: float, unbounded: float) -> float:
    """Return first - second, and `unbounded` where both are infinite."""
    return unbounded if math.isinf(first) and first == second else float(first) - float(second)


def _point_of(contact: Contact) -> NDArray[np.float64]:
    """Return a point of a contact: its witness, or the first of its points."""
    if np.isfinite(contact.witness_world).all():
        return contact.witness_world
    return np.asarray(contact.some_points(1)[0][0])


def _outline_is_lost(
    outlines: list[Outline],
    last_free: Hull,
    first_touching: Hull,
    fraction: float,
    point_world: NDArray[np.float64],
) -> bool:
    """Tell whether the interpolation lost what it lets touch a point first.

    Only the cameras count whose pixel of the point became an object pixel last. There the blend
    must have kept to what that camera gained: halfway it covers about half of it, or little if
    nothing near could move or grow into it.
    """
    views = first_touching.views
    for camera, outline in enumerate(outlines):
        x, y, depth_m = views.project(point_world, camera)
        width, height = views.sizes_px[camera]
        if not (depth_m > 0 and 0 <= x < width * depth_m and 0 <= y < height * depth_m):
            continue  # a camera that abstains
        column, row = int(x / depth_m), int(y / depth_m)
        if last_free.mask(camera)[row, column] or not first_touching.mask(camera)[row, column]:
            continue
        if any(contains(outline.moved_box(move, fraction), row, column) for move in outline.moves):
            continue
        gained = outline.after & ~outline.before
        if not gained[row, column]:
            continue
        _, labels, stats, _ = cv2.connectedComponentsWithStats(gained, connectivity=8)
        label = labels[row, column]
        left, top, box_width, box_height, area = stats[label].tolist()
        box = (top, top + box_height, left, left + box_width)
        crop = intersection(grown_box(box, CAP_PX), (0, *gained.shape[:1], 0, *gained.shape[1:]))
        distance_before = signed_distance_px(outline.before[slices_of(crop)])
        halfway = distance_before + signed_distance_px(outline.after[slices_of(crop)]) > 0
        halfway |= distance_before > -OUTLINE_PX  # that near, there is nothing to lose
        covered = int(np.count_nonzero(halfway & (labels[slices_of(crop)] == label)))
        if covered < _LOST_SHARE * area:
            return True
    return False


@dataclass(frozen=True, slots=True, eq=False)
class _Probe:
    """Asks hulls about one object, with a certifier or, without one, by samples."""

    body: Body
    certifier: Certifier | None
    engine: Engine

    def touches(self, hull: Hull) -> bool:
        """Tell whether a point of the surface is known to be in a hull."""
        if self.certifier is None:
            return len(self._witnesses(hull)[0]) > 0
        return self.certifier.certify_mesh(hull, self.body.triangles).verdict == COLLIDING

    def patch_center(self, hull: Hull) -> NDArray[np.float64]:
        """Return a point (3,) of the surface in a hull that it touches, amid those about it.

        The patch about the witness on the first triangle that touches is sampled, in squares that
        grow until it is inside them; of its samples the one nearest to their mean is taken.
        """
        triangle, witness_world = self._witnesses(hull)
        first_world = witness_world[0]
        apart_m = np.linalg.norm(witness_world - first_world, axis=1)
        near = np.argsort(apart_m, kind="stable")[:_PATCH_TRIANGLES]
        corners_world = self.body.triangles.corners_world[triangle[near]]
        reach_m = 2.0 * _footprint_m(hull.views, first_world)
        samples_world = np.zeros((0, 3))
        for _ in range(8):
            inside_world, in_rim = _patch(hull, corners_world, first_world, reach_m)
            if len(inside_world) == 0:
                break
            samples_world = inside_world
            if not in_rim:
                break
            reach_m *= 2.0
        if len(samples_world) == 0:
            return np.asarray(first_world, np.float64)
        distance_m = np.linalg.norm(samples_world - samples_world.mean(axis=0), axis=1)
        return np.asarray(samples_world[int(distance_m.argmin())], np.float64)

    def _witnesses(self, hull: Hull) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return triangles (K,) that touch a hull, ascending, and a point (K, 3) of each in it."""
        mesh = self.body.triangles
        if self.certifier is not None:
            found = self.certifier.certify(hull, mesh)
            touching = np.flatnonzero(found.verdict == COLLIDING)
            return touching, found.witness_world[touching]
        (hits,) = self.engine.query(hull, [mesh])
        triangle, sample = hits.samples(_MOST_SAMPLES)
        points_world = sample_positions(
            mesh.vertices_world[mesh.faces[triangle]], mesh.viewports[triangle], sample
        )
        # An engine in single precision may err at the rim of a silhouette.
        inside = contains_points(hull, points_world)
        touching, first = np.unique(triangle[inside], return_index=True)
        return touching.astype(np.int64), points_world[inside][first]


def _footprint_m(views: Views, point_world: NDArray[np.float64]) -> float:
    """Return the smallest side of a pixel at a point, in metres, of the cameras before it."""
    local = np.append(point_world - views.origin_world, 1.0)
    depths_m = views.img_from_local[:, 2] @ local
    px_per_m = np.linalg.norm(views.img_from_local[:, :2, :3], axis=2).max(axis=1)  # at one metre
    seen = depths_m > 0
    return float((depths_m[seen] / px_per_m[seen]).min())


def _patch(
    hull: Hull,
    corners_world: NDArray[np.float64],
    center_world: NDArray[np.float64],
    reach_m: float,
) -> tuple[NDArray[np.float64], bool]:
    """Return samples (N, 3) of triangles (T, 3, 3) in a hull, within reach of a centre.

    Also whether some of them lie at the rim of the square that was sampled.
    """
    steps = np.linspace(-1.0, 1.0, _PATCH_SAMPLES)
    across, along = (grid.ravel() for grid in np.meshgrid(steps, steps))
    is_rim = np.maximum(np.abs(across), np.abs(along)) > 0.9
    samples_world, in_rim = [np.zeros((0, 3))], False
    for a, b, c in corners_world:
        edge, other = b - a, c - a
        normal = np.cross(edge, other)
        length, area = np.linalg.norm(edge), np.linalg.norm(normal)
        if not (length > 0 and area > 0):
            continue  # no area: nothing to be amid
        axis_u = edge / length
        axis_v = np.cross(normal / area, axis_u)
        if not other @ axis_v > 0:
            continue  # as thin as rounding: no direction is across it
        foot = center_world - ((center_world - a) @ normal / area) * normal / area
        points = foot + reach_m * (across[:, None] * axis_u + along[:, None] * axis_v)
        # Weights of b and c: within the triangle where both are at least 0 and add up to 1 or less.
        weight_c = (points - a) @ axis_v / (other @ axis_v)
        weight_b = ((points - a) @ axis_u - weight_c * (other @ axis_u)) / length
        kept = (weight_b >= 0) & (weight_c >= 0) & (weight_b + weight_c <= 1)
        kept[kept] = contains_points(hull, points[kept])
        samples_world.append(points[kept])
        in_rim |= bool((kept & is_rim).any())
    return np.concatenate(samples_world), in_rim
