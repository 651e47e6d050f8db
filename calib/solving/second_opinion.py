"""A second opinion on a rig: where another adjustment of the same points has its cameras.

Two estimates from the same data differ by chance where they weigh it differently: COLMAP takes all
points alike, the rig weighs them by the noise of their kind. Where the weights are right, the
difference has the covariance of the other estimate less that of the rig (Hausman), and so never
more than the other's own. What is beyond that error, and several standard deviations of it, is no
chance: one of the two is wrong, or the noise is not what it was taken for.

This work is based on: Hausman, *Specification tests in econometrics*, Econometrica 46(6), 1978.
"""

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.lens import project_points
from hybridve.calib.record import NoOpinion, SecondOpinion
from hybridve.calib.rig import Rig
from hybridve.calib.solving.covariance import image_derivatives, point_gains, radius95

#: The opinion is that of this share of the points.
_SHARE = 0.95


def second_opinion(
    rig: Rig, other: Rig | str, points_world: NDArray[np.float64]
) -> SecondOpinion | NoOpinion:
    """Return by how much another estimate of a rig differs from it.

    Parameters
    ----------
    rig : Rig
        The cameras.
    other : Rig or str
        The same cameras, or some of them, in the same world, with the covariance of this estimate;
        or why there is none, as a sentence.
    points_world : (N, 3) float64
        Points of the working volume, metres.
    """
    if isinstance(other, str):
        return NoOpinion(other)
    rig = rig.only([camera.name for camera in other.cameras])
    matrix = _covariance(other)
    gains, _ = point_gains(rig, points_world)
    information = np.zeros((len(points_world), 3, 3))
    moment = np.zeros((len(points_world), 3))
    largest_px = 0.0
    for camera, theirs in zip(rig.cameras, other.cameras, strict=True):
        by_point = image_derivatives(camera, points_world)[0]
        seen = np.isfinite(by_point).all(axis=(1, 2))
        if not seen.any():
            continue
        by_point, points = by_point[seen], points_world[seen]
        shifts_px = _image(theirs, points) - _image(camera, points)
        information[seen] += by_point.transpose(0, 2, 1) @ by_point
        moment[seen] += np.einsum("nij,ni->nj", by_point, shifts_px)
        lengths_px = np.linalg.norm(shifts_px, axis=1)
        largest_px = max(largest_px, float(np.quantile(lengths_px, _SHARE)))
    placed = np.isfinite(gains).all(axis=(1, 2))
    if not placed.any():
        return NoOpinion("no two cameras see a common volume in which to compare")
    gains, information, moment = gains[placed], information[placed], moment[placed]
    difference_m = np.linalg.solve(information, moment[..., None])[..., 0]
    covariance_m2 = gains @ matrix @ gains.transpose(0, 2, 1)
    whitened = np.linalg.solve(covariance_m2, difference_m[..., None])[..., 0]
    squares = np.einsum("ni,ni->n", difference_m, whitened)
    return SecondOpinion(
        difference95_m=float(np.quantile(np.linalg.norm(difference_m, axis=1), _SHARE)),
        expected95_m=float(np.quantile(radius95(covariance_m2), _SHARE)),
        sigmas=float(np.sqrt(np.quantile(squares, _SHARE))),
        difference95_px=largest_px,
    )


def _image(camera: Camera, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where points are seen (N, 2), pixels; a width off the image where they are not."""
    pixels, _ = project_points(camera, points_world)
    is_seen = np.isfinite(pixels).all(axis=1, keepdims=True)
    return np.where(is_seen, pixels, -float(camera.width_px))


def _covariance(rig: Rig) -> NDArray[np.float64]:
    if rig.covariance is None:
        raise ValueError("the other rig has no covariance")
    return rig.covariance.matrix
