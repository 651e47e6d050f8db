"""What is told of a clearance that is known: a ball beside a plate, seen by cameras that are drawn.

The ball stands for a finger or a fist, the plate for a part. The cameras' silhouettes of the ball
are exact; the hull made of them is larger than the ball where no camera looks along its side, and
what is told of the plate is smaller by that (`hull_m`). Outlines and rig err besides: what is told
at 95 % is smaller once more (`doubt_m`). Clearance and doubt are those of `hybridve detect`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.pose import transform
from hybridve.calib.rig import Rig
from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.contact.outline_errors import DoubtSettings, outline_errors
from hybridve.hull.contact.uncertainty import Doubter
from hybridve.hull.plan.drawing import sees_ball
from hybridve.hull.query.silhouettes import make_hull, make_views

#: The sides of the ball on which the plate stands.
SIDES = np.concatenate([np.eye(3), -np.eye(3)])

#: How far the plate is from the ball, in radii and at least in metres: so far that no hull reaches
#: it but one that ends nowhere near the ball.
_GAP_RADII, _LEAST_GAP_M = 4.0, 0.1

#: Half a side of the plate, in radii: it is as wide as what is near the ball.
_PLATE_RADII = 1.5

#: How far apart the bounds of what is told may be.
_TOLERANCE_M = 5e-4


@dataclass(frozen=True, slots=True, eq=False)
class TriedPlaces:
    """What is told of the plate, for N places of the ball and six sides.

    Attributes
    ----------
    places_world : (N, 3) float64
        Where the ball was, metres.
    n_seeing : (N,) int
        Cameras that see all of it there. With fewer than two there is nothing to tell.
    hull_m : (N, 6) float64
        How much nearer the hull is than the ball; at most the gap. NaN where nothing is told.
    doubt_m : (N, 6) float64
        By how much less is told at 95 %; NaN too where nothing is left of the gap.
    """

    places_world: NDArray[np.float64]
    n_seeing: NDArray[np.intp]
    hull_m: NDArray[np.float64]
    doubt_m: NDArray[np.float64]

    @property
    def total_m(self) -> NDArray[np.float64]:
        """Both together: how much farther than it must be a part is, to be told to keep it."""
        return self.hull_m + np.nan_to_num(self.doubt_m)


def try_places(
    rig: Rig,
    places_world: NDArray[np.float64],
    radius_m: float,
    outline_px: float,
    advance: Callable[[], object],
) -> TriedPlaces:
    """Return what is told of a plate beside a ball at places of the volume.

    Parameters
    ----------
    rig : Rig
        The cameras, pinholes, with their covariance.
    places_world : (N, 3) float64
        Centres of the ball, metres.
    radius_m : float
        Of the ball.
    outline_px : float
        Standard deviation of outlines, pixels.
    advance : callable
        Called after each place.
    """
    n_places = len(places_world)
    n_seeing = np.zeros(n_places, np.intp)
    hull_m, doubt_m = (
        np.full((n_places, len(SIDES)), np.nan),
        np.full((n_places, len(SIDES)), np.nan),
    )
    for number, center in enumerate(places_world):
        names = [camera.name for camera in rig.cameras if sees_ball(camera, center, radius_m)]
        n_seeing[number] = len(names)
        if len(names) >= 2:
            hull_m[number], doubt_m[number] = _try_place(
                rig.only(names), center, radius_m, outline_px
            )
        advance()
    return TriedPlaces(places_world, n_seeing, hull_m, doubt_m)


def _try_place(
    rig: Rig, center: NDArray[np.float64], radius_m: float, outline_px: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    names = tuple(camera.name for camera in rig.cameras)
    sizes_px = np.array([(camera.width_px, camera.height_px) for camera in rig.cameras])
    matrices = np.array([camera.pinhole @ camera.cam_from_world for camera in rig.cameras])
    hull = make_hull(
        make_views(names, sizes_px, matrices, origin_world=center),
        [ball_mask(camera, center, radius_m) for camera in rig.cameras],
    )
    settings = DoubtSettings(segmentation_px=outline_px)
    doubts = Doubter(outline_errors(names, rig, [0.0] * len(names), settings), settings).frame(hull)
    gap_m = max(_GAP_RADII * radius_m, _LEAST_GAP_M)
    hull_m, doubt_m = np.full(len(SIDES), np.nan), np.full(len(SIDES), np.nan)
    for side, normal in enumerate(SIDES):
        vertices, faces = _plate(center + normal * (radius_m + gap_m), normal, radius_m)
        meter = ClearanceMeter(vertices, faces, is_closed=False, tolerance_m=_TOLERANCE_M)
        clearance = meter.measure(hull)
        if not np.isfinite(clearance.upper_m):
            continue  # a hull of no pixel
        hull_m[side] = gap_m - clearance.lower_m
        if clearance.lower_m > 0:
            doubt_m[side] = doubts.deviation(meter, clearance).too_large_95_m
    return hull_m, doubt_m


def ball_mask(
    camera: Camera, center_world: NDArray[np.float64], radius_m: float
) -> NDArray[np.uint8]:
    """Return a pinhole camera's silhouette of a ball before it: pixels whose middle shows it.

    Parameters
    ----------
    camera : Camera
        The camera, outside the ball.
    center_world : (3,) float64
        Metres.
    radius_m : float
        Of the ball.

    Returns
    -------
    (H, W) uint8
        255 where the ray through a pixel's middle meets the ball.
    """
    mask = np.zeros((camera.height_px, camera.width_px), np.uint8)
    center = transform(camera.cam_from_world, center_world[None])[0]
    focal_px, middle_px = camera.params[0], camera.params[2:4]
    # Off the axis a ball's outline is an ellipse; it is within this of the image of its centre.
    distance_m = float(np.linalg.norm(center))
    nearest_m = max(center[2] - radius_m, 1e-9)
    reach_px = focal_px * radius_m * distance_m / (nearest_m * center[2]) + 2.0
    at_px = middle_px + focal_px * center[:2] / center[2]
    size_px = np.array([camera.width_px, camera.height_px])
    left, top = np.clip(np.floor(at_px - reach_px), 0, size_px).astype(int)
    right, bottom = np.clip(np.ceil(at_px + reach_px), 0, size_px).astype(int)
    x = (np.arange(left, right) + 0.5 - middle_px[0]) / focal_px
    y = (np.arange(top, bottom)[:, None] + 0.5 - middle_px[1]) / focal_px
    along = x * center[0] + y * center[1] + center[2]  # of the ray (x, y, 1), times its length
    squared = x * x + y * y + 1.0
    # The ray misses the centre by sqrt(|c|^2 - along^2 / |ray|^2).
    is_met = (along > 0) & (distance_m**2 - along**2 / squared <= radius_m**2)
    mask[top:bottom, left:right][is_met] = 255
    return mask


def _plate(
    middle: NDArray[np.float64], normal: NDArray[np.float64], radius_m: float
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return a square, its corners (4, 3) in metres and two triangles, across a normal."""
    axis = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = np.cross(normal, axis)
    second = np.cross(normal, first)
    half_m = _PLATE_RADII * radius_m
    corners = [
        middle + half_m * (u * first + v * second) for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    return np.array(corners), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
