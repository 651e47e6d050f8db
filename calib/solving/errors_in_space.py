"""What the covariance of a rig means for points in space and for pixels."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from hybridve.calib.camera import Camera
from hybridve.calib.lens import cam_from_img, img_from_cam
from hybridve.calib.pose import transform
from hybridve.calib.rig import Rig
from hybridve.calib.solving.bundle import (
    POSE,
    lens_derivatives,
)

#: Points on an octant of the sphere over which `radius95` integrates, a side.
_SPHERE_POINTS = 16

#: Entries a side of the table from which `radius95` reads, linearly between them.
_TABLE_POINTS = 25

#: Rays at less than a millionth of a radian are one, and place no point: the share of the largest
#: eigenvalue of what they tell of it that the smallest must reach.
_ONE_RAY = 1e-12


def parameter_slices(cameras: Sequence[Camera]) -> list[slice]:
    """Return where each camera's parameters stand in the covariance of a rig."""
    ends = np.cumsum([POSE + len(camera.params) for camera in cameras])
    return [
        slice(int(end) - POSE - len(camera.params), int(end))
        for end, camera in zip(ends, cameras, strict=True)
    ]


def image_derivatives(
    camera: Camera, points_world: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how a camera's image of points changes with the points and with its parameters.

    Parameters
    ----------
    camera : Camera
        The camera.
    points_world : (N, 3) float64
        Points in metres.

    Returns
    -------
    by_point : (N, 2, 3) float64
        Pixels a metre in the world's frame.
    by_parameter : (N, 2, 6 + P) float64
        Pixels a unit of the pose's (omega, v) and of the lens's parameters. Both are NaN where the
        camera does not see the point.
    """
    n_points = len(points_world)
    by_point = np.full((n_points, 2, 3), np.nan)
    by_parameter = np.full((n_points, 2, POSE + len(camera.params)), np.nan)
    points_cam = transform(camera.cam_from_world, points_world)
    seen = _is_in_image(camera, points_cam)
    if seen.any():
        by_cam, by_lens = lens_derivatives(camera, points_cam[seen])
        by_point[seen] = by_cam @ camera.cam_from_world[:, :3]
        turned = np.cross(points_cam[seen][:, None, :], by_cam)
        by_parameter[seen] = np.concatenate([turned, by_cam, by_lens], axis=2)
    return by_point, by_parameter


def _is_in_image(camera: Camera, points_cam: NDArray[np.float64]) -> NDArray[np.bool_]:
    seen = points_cam[:, 2] > 0
    pixels = np.full((len(points_cam), 2), np.nan)
    if seen.any():
        pixels[seen] = img_from_cam(camera, points_cam[seen])
    size = (camera.width_px, camera.height_px)
    with np.errstate(invalid="ignore"):
        seen &= ((pixels >= 0) & (pixels < size)).all(axis=1)
    # The polynomial of a lens folds back far outside the image: the pixel must lead back.
    if camera.has_distortion and seen.any():
        rays = cam_from_img(camera, pixels[seen])
        expected = points_cam[seen, :2] / points_cam[seen, 2:]
        with np.errstate(invalid="ignore"):
            near = np.linalg.norm(rays - expected, axis=1) < 1e-3 * (
                1.0 + np.linalg.norm(expected, axis=1)
            )
        seen[seen] = near
    return seen


@dataclass(frozen=True, slots=True, eq=False)
class PointErrors:
    """What a rig's errors do to points in space.

    Attributes
    ----------
    covariance_m2 : (N, 3, 3) float64
        Of the place at which the cameras see a point, least squares over those that do; NaN where
        fewer than two do.
    radius95_m : (N,) float64
        The distance that this error exceeds in 5 % of all calibrations.
    n_seeing : (N,) int
        Cameras that see the point.
    """

    covariance_m2: NDArray[np.float64]
    radius95_m: NDArray[np.float64]
    n_seeing: NDArray[np.intp]


def point_errors(
    rig: Rig, points_world: NDArray[np.float64], covariance: NDArray[np.float64] | None = None
) -> PointErrors:
    """Return how far from the truth the cameras place points, for the rig's errors alone.

    Parameters
    ----------
    rig : Rig
        With its covariance.
    points_world : (N, 3) float64
        Points in metres.
    covariance : (P, P) float64, optional
        Another one than the rig's, in its order.

    Raises
    ------
    ValueError
        If the rig has no covariance.
    """
    gains, n_seeing = point_gains(rig, points_world)
    matrix = _matrix(rig) if covariance is None else covariance
    covariance_m2 = gains @ matrix @ gains.transpose(0, 2, 1)
    return PointErrors(covariance_m2, radius95(covariance_m2), n_seeing)


def point_gains(
    rig: Rig, points_world: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return how points move as the rig's parameters do, and how many cameras see them.

    Returns
    -------
    gains : (N, 3, P) float64
        Metres a unit of each parameter: where the truth is off by dp, a point that is seen from
        the truth is placed ``gains @ dp`` off. NaN where fewer than two cameras see the point, or
        all of them along one ray.
    n_seeing : (N,) int
        Cameras that do.
    """
    n_points, slices = len(points_world), parameter_slices(rig.cameras)
    information = np.zeros((n_points, 3, 3))
    moments = np.zeros((n_points, 3, slices[-1].stop))
    n_seeing = np.zeros(n_points, dtype=np.intp)
    for camera, span in zip(rig.cameras, slices, strict=True):
        by_point, by_parameter = image_derivatives(camera, points_world)
        seen = np.isfinite(by_point).all(axis=(1, 2))
        information[seen] += by_point[seen].transpose(0, 2, 1) @ by_point[seen]
        moments[seen, :, span] = by_point[seen].transpose(0, 2, 1) @ by_parameter[seen]
        n_seeing += seen
    gains = np.full_like(moments, np.nan)
    spread = np.linalg.eigvalsh(information)  # rays at an angle a: about a^2 / 4 of the largest
    placed = (n_seeing >= 2) & (spread[:, 0] > _ONE_RAY * spread[:, -1])
    if placed.any():
        gains[placed] = np.linalg.solve(information[placed], moments[placed])
    return gains, n_seeing


def pixel_covariance(rig: Rig, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance of where the cameras see points, for the rig's errors alone.

    Parameters
    ----------
    rig : Rig
        With its covariance.
    points_world : (N, 3) float64
        Points in metres.

    Returns
    -------
    (N, C, 2, C, 2) float64
        Pixels squared, true minus computed image; NaN where a camera does not see the point.

    Raises
    ------
    ValueError
        If the rig has no covariance.
    """
    return _joint_covariance(
        rig, [image_derivatives(camera, points_world)[1] for camera in rig.cameras]
    )


def _joint_covariance(
    rig: Rig, derivatives: Sequence[NDArray[np.float64] | None]
) -> NDArray[np.float64]:
    """Return the covariance (N, C, 2, C, 2) of images that change so (N, 2, 6 + P) by camera.

    It is 0 of cameras of which that is None.
    """
    matrix, slices = _matrix(rig), parameter_slices(rig.cameras)
    n_cameras = len(rig.cameras)
    known = [(camera, one) for camera, one in enumerate(derivatives) if one is not None]
    n_points = len(known[0][1]) if known else 1
    found = np.zeros((n_points, n_cameras, 2, n_cameras, 2))
    for i, first in known:
        for j, second in known:
            found[:, i, :, j] = first @ matrix[slices[i], slices[j]] @ second.transpose(0, 2, 1)
    return found


def undistorted_covariance(
    rig: Rig, point_world: NDArray[np.float64], is_asked: NDArray[np.bool_] | None = None
) -> NDArray[np.float64]:
    """Return the covariance of where the cameras see a point in images freed of distortion.

    Parameters
    ----------
    rig : Rig
        With its covariance.
    point_world : (3,) float64
        A point in metres.
    is_asked : (C,) bool, optional
        Of which cameras; by default of all.

    Returns
    -------
    (C, 2, C, 2) float64
        Pixels squared of pinhole images with the lenses' focal lengths
        (`hybridve.calib.lens.undistortion`); NaN where a camera does not see the point, 0 where it
        was not asked.

    Raises
    ------
    ValueError
        If the rig has no covariance.
    """
    place = tuple(point_world.tolist())
    asked = [True] * len(rig.cameras) if is_asked is None else is_asked.tolist()
    return np.asarray(
        _joint_covariance(
            rig,
            [
                _undistorted_derivatives(camera, place) if is_one_asked else None
                for camera, is_one_asked in zip(rig.cameras, asked, strict=True)
            ],
        )[0]
    )


@lru_cache(maxsize=64)  # of a point more than one thing is asked
def _undistorted_derivatives(
    camera: Camera, place: tuple[float, float, float]
) -> NDArray[np.float64]:
    """Return how the image (1, 2, 6 + P) of a point, freed of distortion, changes with the rig."""
    point_world = np.array(place)
    by_point, by_parameter = image_derivatives(camera, point_world[None])
    if camera.has_distortion and np.isfinite(by_point).all():
        rotation, shift = camera.cam_from_world[:, :3], camera.cam_from_world[:, 3]
        depth_m = rotation[2] @ point_world + shift[2]
        by_ray = (by_point[0] @ rotation.T)[:, :2] * depth_m
        by_parameter = camera.pinhole[:2, :2] @ np.linalg.inv(by_ray) @ by_parameter
    by_parameter.flags.writeable = False
    return by_parameter


def _matrix(rig: Rig) -> NDArray[np.float64]:
    if rig.covariance is None:
        raise ValueError("the rig has no covariance")
    return rig.covariance.matrix


def radius95(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the radius within which 95 % of a normal error about zero lies.

    Parameters
    ----------
    covariance : (N, D, D) float64
        Of an error in D = 2 or 3 dimensions; NaN gives NaN.

    Returns
    -------
    (N,) float64
        In the root of the covariance's unit, relative error below 1e-3.
    """
    radii = np.full(len(covariance), np.nan)
    known = np.isfinite(covariance).all(axis=(1, 2))
    if not known.any():
        return radii
    values = np.linalg.eigvalsh(covariance[known])
    variances = np.zeros((len(values), 3))
    variances[:, : values.shape[1]] = np.maximum(values, 0.0)
    largest = variances.max(axis=1)
    shares = variances / np.where(largest > 0, largest, 1.0)[:, None]
    ordered = np.sort(shares, axis=1)[:, :2] * (_TABLE_POINTS - 1)  # the largest share is one
    low = np.minimum(ordered.astype(int), _TABLE_POINTS - 2)
    (u, v), (i, j) = (ordered - low).T, low.T
    table = _squared_radii95()
    squared = (
        table[i, j] * (1 - u) * (1 - v)
        + table[i + 1, j] * u * (1 - v)
        + table[i, j + 1] * (1 - u) * v
        + table[i + 1, j + 1] * u * v
    )
    radii[known] = np.sqrt(squared * largest)
    return radii


@lru_cache(maxsize=1)
def _squared_radii95() -> NDArray[np.float64]:
    """Return the squared radii of errors with variances (i / n, j / n, 1): (n + 1, n + 1)."""
    steps = np.linspace(0.0, 1.0, _TABLE_POINTS)
    shares = np.stack([*np.meshgrid(steps, steps, indexing="ij")], axis=-1).reshape(-1, 2)
    shares = np.column_stack([shares, np.ones(len(shares))])
    # In spherical coordinates: the squared radius of a standard normal error is chi-squared with
    # three degrees of freedom in each direction n, and stretched by q(n) = sum of shares n^2.
    cosines, weights = np.polynomial.legendre.leggauss(_SPHERE_POINTS)
    cosine, angle = (cosines + 1.0) / 2.0, (cosines + 1.0) * np.pi / 4.0
    sine = np.sqrt(1.0 - cosine**2)
    directions = np.stack(
        [
            np.outer(sine, np.cos(angle)) ** 2,
            np.outer(sine, np.sin(angle)) ** 2,
            np.repeat(cosine[:, None] ** 2, _SPHERE_POINTS, axis=1),
        ],
        axis=-1,
    ).reshape(-1, 3)
    weight = np.outer(weights, weights).ravel() / 4.0
    stretch = np.maximum(shares @ directions.T, 1e-300)  # (N, directions)
    low, high = np.full(len(shares), 3.0), np.full(len(shares), 8.0)  # chi-squared, 1 and 3
    for _ in range(16):
        middle = (low + high) / 2.0
        y = np.sqrt(middle[:, None] / (2.0 * stretch))
        inside = erf(y) - 2.0 / np.sqrt(np.pi) * y * np.exp(-np.minimum(y**2, 700.0))
        enough = inside @ weight >= 0.95
        high, low = np.where(enough, middle, high), np.where(enough, low, middle)
    return np.asarray((low + high).reshape(_TABLE_POINTS, _TABLE_POINTS) / 2.0)
