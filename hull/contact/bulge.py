"""How far away the real thing is at most: the hull is larger than what made its silhouettes.

Where no camera looks, a hull bulges: the real thing may be farther from an object than the hull is,
and need not touch what the hull touches. But the ray of an object pixel's centre meets something
real, somewhere in the hull. So something real is no farther from the object than the farthest point
of that ray in the hull, whatever the ray. This is a bound, given right silhouettes, as
`hybridve.hull.contact.components` has them: they are sampled at the centres of pixels, so the hull
that is asked is that of silhouettes grown by one pixel.

Along a ray the signed distance to the object changes by at most a metre a metre. Between two points
``step`` apart at distances a and b it is nowhere above (a + b + step) / 2.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.contact.clearance import Clearance, ClearanceMeter
from hybridve.hull.contact.components import FAR_M, pixel_rays
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.walk import spans_of_rays

#: Where rays are tried for a bound of the real thing's distance: at the nearest point's projection,
#: and in the most promising cameras at these distances about it, in eight directions.
_RINGS_PX = (2.5, 7.0)
_AROUND = np.array([(np.cos(k * np.pi / 4.0), np.sin(k * np.pi / 4.0)) for k in range(8)])
_CLOSE_CAMERAS = 2

#: So many of these rays, the most promising, are measured closely; to this many metres.
_CLOSE_RAYS = 6
_CLOSE_M = 1e-3

#: Rounds of halving a ray's steps, and steps of the first.
_MOST_ROUNDS, _FIRST_STEPS = 12, 8


def real_upper(hull: Hull, grown_hull: Hull, meter: ClearanceMeter, clearance: Clearance) -> float:
    """Return how far away from the object the real thing is at most, given right silhouettes.

    Rays of object pixels about the projections of the hull's nearest point are tried.

    Parameters
    ----------
    hull, grown_hull : Hull
        Of one frame; see `hybridve.hull.contact.components.grown`.
    meter : ClearanceMeter
        Of the object.
    clearance : Clearance
        Of the object in this frame.

    Returns
    -------
    float
        Metres, not below the clearance's lower bound; 0 if it certainly reaches into a closed
        object, inf if there is no ray.
    """
    if not np.isfinite(clearance.on_hull_world).all():
        return np.inf

    pixels = [
        _pixels_about(hull, camera, clearance.on_hull_world) for camera in range(len(hull.views))
    ]
    tried = _promises(grown_hull, meter, [found[:1] for found in pixels])
    best = sorted(tried, key=lambda promise: promise.at_least_m)[:_CLOSE_CAMERAS]
    close = {promise.camera for promise in best}
    tried += _promises(
        grown_hull,
        meter,
        [found[1:] if camera in close else [] for camera, found in enumerate(pixels)],
    )
    bound_m = np.inf
    for promise in sorted(tried, key=lambda promise: promise.at_least_m)[:_CLOSE_RAYS]:
        if promise.at_least_m >= bound_m:
            break
        bound_m = min(bound_m, farthest_on(meter, promise.ray, bound_m))
    return max(bound_m + meter.error_m, clearance.lower_m)


class Ray(NamedTuple):
    """A pixel's ray, and the stretches (N, 2) of it that lie in the hull, metres."""

    origin_world: NDArray[np.float64]
    direction: NDArray[np.float64]
    spans_m: NDArray[np.float64]

    def at(self, along_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points (K, 3), metres."""
        return self.origin_world + along_m[:, None] * self.direction

    @property
    def ends_world(self) -> NDArray[np.float64]:
        """Where its stretches begin and end, (2 N, 3) metres."""
        return self.at(self.spans_m.ravel())


class _Promise(NamedTuple):
    """What a ray's bound is not below, metres: the farther of its ends."""

    at_least_m: float
    camera: int
    ray: Ray


def _promises(
    grown_hull: Hull, meter: ClearanceMeter, pixels: list[list[tuple[int, int]]]
) -> list[_Promise]:
    """Return what the rays of each camera's pixels promise.

    Where silhouettes contradict each other, a ray may miss the hull: it is left out.
    """
    origins, directions = [], []
    cameras = [camera for camera, found in enumerate(pixels) for _ in found]
    for camera in dict.fromkeys(cameras):
        origin_world, units = pixel_rays(grown_hull.views, camera, pixels[camera])
        origins.append(np.tile(origin_world, (len(units), 1)))
        directions.append(units)
    if not cameras:
        return []
    origins_world, units = np.concatenate(origins), np.concatenate(directions)
    walked = spans_of_rays(grown_hull, origins_world, units, FAR_M)
    rays = [
        (camera, Ray(*ray))
        for camera, *ray in zip(cameras, origins_world, units, walked, strict=True)
        if len(ray[2])
    ]
    if not rays:
        return []
    ends_world = [ray.ends_world for _, ray in rays]
    distances_m = meter.signed_distance(np.concatenate(ends_world))
    first = np.cumsum([0, *map(len, ends_world[:-1])])
    promised_m = np.maximum.reduceat(distances_m, first).tolist()
    return [
        _Promise(at_least_m, camera, ray)
        for at_least_m, (camera, ray) in zip(promised_m, rays, strict=True)
    ]


def _pixels_about(
    hull: Hull, camera: int, point_world: NDArray[np.float64]
) -> list[tuple[int, int]]:
    """Return object pixels, columns and rows, at and about the projection of a point, in turn."""
    views = hull.views
    projected = views.project(point_world, camera)
    width, height = views.sizes_px[camera].tolist()
    if not projected[2] > 0:
        return []
    with np.errstate(over="ignore"):
        middle = projected[:2] / projected[2]
    if not ((middle >= 0) & (middle < (width, height))).all():
        return []
    asked = [middle] + [middle + ring * around for ring in _RINGS_PX for around in _AROUND]
    mask = hull.mask(camera)
    found = []
    for column, row in np.floor(asked).astype(np.int64).tolist():
        is_seen = 0 <= column < width and 0 <= row < height
        if is_seen and mask[row, column] and (column, row) not in found:
            found.append((column, row))
    return found


def farthest_on(meter: ClearanceMeter, ray: Ray, enough_m: float) -> float:
    """Return a bound of the signed distance along stretches of a ray, to `_CLOSE_M`.

    It is given up, with infinity, where it is certainly above `enough_m`.
    """
    begin, end = ray.spans_m.T
    steps = np.linspace(begin, end, _FIRST_STEPS + 1, axis=1)  # (N, K)
    distances_m = meter.signed_distance(ray.at(steps.ravel())).reshape(steps.shape)
    begin, end = steps[:, :-1].ravel(), steps[:, 1:].ravel()
    at_begin, at_end = distances_m[:, :-1].ravel(), distances_m[:, 1:].ravel()
    reached_m = float(distances_m.max())
    settled_m = -np.inf
    for _ in range(_MOST_ROUNDS):
        upper_m = 0.5 * (at_begin + at_end + (end - begin))
        is_open = upper_m > reached_m + _CLOSE_M
        settled_m = max(settled_m, float(upper_m[~is_open].max(initial=-np.inf)))
        if not is_open.any():
            return settled_m
        if reached_m >= enough_m:
            return np.inf
        begin, end = begin[is_open], end[is_open]
        at_begin, at_end = at_begin[is_open], at_end[is_open]
        middle = 0.5 * (begin + end)
        at_middle = meter.signed_distance(ray.at(middle))
        reached_m = max(reached_m, float(at_middle.max()))
        begin, end = np.concatenate([begin, middle]), np.concatenate([middle, end])
        at_begin, at_end = (
            np.concatenate([at_begin, at_middle]),
            np.concatenate([at_middle, at_end]),
        )
    return max(settled_m, float((0.5 * (at_begin + at_end + (end - begin))).max()))
