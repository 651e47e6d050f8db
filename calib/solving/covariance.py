"""How far a rig can be wrong: its covariance, and what that means in space and in images.

The covariance is that of the joint adjustment (`hybridve.calib.solving.bundle`), for the noise that
its residuals show. Residuals are told apart into what is smooth over a board, by which parameters
are moved, and what is not, the noise of single points: a lens model that does not fit, a bent board
or motion blur raise the former, and the covariance with it.

This work is based on: Triggs, McLauchlan, Hartley and Fitzgibbon, *Bundle adjustment: a modern
synthesis*, 2000 (section 9); Hartley and Zisserman, *Multiple View Geometry*, 2nd ed., 2003
(sections 5.1 and 5.2, error of estimation and propagation of covariance).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from hybridve.calib.boards.board import is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.lens import cam_from_img, img_from_cam, parameter_names
from hybridve.calib.pose import Pose, transform
from hybridve.calib.record import Noise
from hybridve.calib.rig import Rig, RigCovariance
from hybridve.calib.solving.bundle import (
    POSE,
    Adjusted,
    Bundle,
    Layout,
    even_information,
    lens_derivatives,
    make_layout,
)

#: Of the largest eigenvalue: what is below is rounding.
_ROUNDING = 1e-15

#: What is smooth over a board: polynomials in its coordinates up to this degree.
_SMOOTH_DEGREE = 3

#: The smooth part of residuals is a misfit, or a group of views noisier or quieter than others, if
#: its mean square is larger, or other, by so many standard deviations of what chance does.
_MISFIT_SIGMAS = 2.0
_GROUP_SIGMAS = 3.0

#: Weak knowledge of what no picture told, as standard deviations: a rotation (radians), a place
#: (metres), and by its share a focal length or, by the image's width, a principal point; the
#: coefficients of distortion. It keeps the covariance finite where the pictures tell nothing, and
#: changes what they tell by less than a millionth.
_PRIOR_RAD = np.pi
_PRIOR_M = 100.0
_PRIOR_SHARE = 1.0
_PRIOR_DISTORTION = 10.0

_POSE_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")

#: Points on an octant of the sphere over which `radius95` integrates, a side.
_SPHERE_POINTS = 16

#: Entries a side of the table from which `radius95` reads, linearly between them.
_TABLE_POINTS = 25

#: Rays at less than a millionth of a radian are one, and place no point: the share of the largest
#: eigenvalue of what they tell of it that the smallest must reach.
_ONE_RAY = 1e-12

#: Points of a pixel grid over an image, a side, for the error within the image.
_IMAGE_POINTS = 9


def measure_noise(adjusted: Adjusted) -> Noise:
    """Return how noisy the points of an adjusted bundle were."""
    return _group_sums(adjusted, [""] * len(adjusted.bundle.views))[""].noise()


def measure_group_noise(adjusted: Adjusted, groups: Sequence[str]) -> dict[str, Noise]:
    """Return how noisy the points of groups of views were.

    Parameters
    ----------
    adjusted : Adjusted
        The bundle after its adjustment.
    groups : sequence of str
        For each view of the bundle its group; views of one pose should be of one.

    Returns
    -------
    dict of str to Noise
        By group. A group whose noise differs from that of all views by no more than chance allows
        (`_GROUP_SIGMAS`) is told with that of all.
    """
    whole = measure_noise(adjusted)
    found = {}
    for name, sums in _group_sums(adjusted, groups).items():
        own = sums.noise()
        left = sums.n_smooth - sums.n_parameters
        ratio = (own.smooth_px / whole.smooth_px) ** 2 if whole.smooth_px > 0 else 1.0
        chance = _GROUP_SIGMAS * np.sqrt(2.0 / left) if left > 0 else np.inf
        if not abs(ratio - 1.0) > chance:
            own = replace(own, rough_px=whole.rough_px, smooth_px=whole.smooth_px)
        found[name] = own
    return found


@dataclass(slots=True)
class _Sums:
    """Squares of residuals, smooth and rough, and how many numbers they stand for."""

    smooth: float = 0.0
    rough: float = 0.0
    n_smooth: int = 0
    n_rough: int = 0
    n_points: int = 0
    n_parameters: float = 0.0

    def noise(self) -> Noise:
        total, freedom = self.smooth + self.rough, 2 * self.n_points - self.n_parameters
        pooled = total / max(1.0, freedom)
        rough = self.rough / self.n_rough if self.n_rough else pooled
        # The parameters have taken their share of what is smooth. What chance explains is no
        # misfit of model or boards.
        left = self.n_smooth - self.n_parameters
        smooth = self.smooth / left if left > self.n_smooth / 10 else pooled
        if smooth < rough * (1.0 + _MISFIT_SIGMAS * np.sqrt(2.0 / max(1.0, left))):
            smooth = rough = pooled
        expected = rough * max(1.0, freedom)
        return Noise(
            float(np.sqrt(rough)),
            float(np.sqrt(smooth)),
            float(np.sqrt(total / max(1, self.n_points))),
            min(1.0, float(expected / total)) if total > 0 else 1.0,
            self.n_points,
            round(self.n_parameters),
        )


def _group_sums(adjusted: Adjusted, groups: Sequence[str]) -> dict[str, _Sums]:
    bundle, layout = adjusted.bundle, adjusted.layout
    sums: dict[str, _Sums] = {}
    of_lens: dict[int, dict[str, int]] = {}
    of_camera: dict[int, dict[str, int]] = {}
    of_pose: dict[int, str] = {}
    for view, missed, group in zip(bundle.views, adjusted.residuals_px, groups, strict=True):
        seen = is_seen(view.pixels)
        points, rows = bundle.points_board[view.board][seen, :2], missed[seen]
        basis = _smooth_basis(points)
        fitted = basis @ (basis.T @ rows)
        own = sums.setdefault(group, _Sums())
        own.smooth += float((fitted**2).sum())
        own.rough += float(((rows - fitted) ** 2).sum())
        own.n_smooth += 2 * basis.shape[1]
        own.n_rough += 2 * (len(rows) - basis.shape[1])
        own.n_points += len(rows)
        if view.pose not in of_pose and view.pose != bundle.held_pose:
            own.n_parameters += POSE
        of_pose[view.pose] = group
        lens = bundle.lens_of[view.camera]
        for table, key in ((of_lens, lens), (of_camera, view.camera)):
            counts = table.setdefault(key, {})
            counts[group] = counts.get(group, 0) + 2 * basis.shape[1]
    # A lens is told by all of its views. A camera's place is told by the poses that others saw,
    # too; a still of one camera alone says nothing of it.
    shared = _shared_groups(bundle, groups)
    for lens, counts in of_lens.items():
        if lens in layout.of_lens:
            span = layout.of_lens[lens]
            _share_out(sums, counts, span.stop - span.start)
    for counts in of_camera.values():
        told = {group: count for group, count in counts.items() if group in shared}
        _share_out(sums, told or counts, POSE)
    _share_out(sums, dict.fromkeys(shared or sums, 1), POSE * len(layout.of_board))
    return sums


def _shared_groups(bundle: Bundle, groups: Sequence[str]) -> set[str]:
    """Return the groups with a pose that tells where cameras are."""
    cameras: dict[int, set[int]] = {}
    for view in bundle.views:
        cameras.setdefault(view.pose, set()).add(view.camera)
    return {
        group
        for view, group in zip(bundle.views, groups, strict=True)
        if len(cameras[view.pose]) > 1 or view.pose == bundle.held_pose
    }


def _share_out(sums: dict[str, _Sums], counts: Mapping[str, int], n_parameters: int) -> None:
    total = sum(counts.values())
    for group, count in counts.items():
        sums[group].n_parameters += n_parameters * count / total


def _smooth_basis(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an orthonormal basis (S, K) of the smooth functions over points (S, 2) of a board."""
    centred = points - points.mean(axis=0)
    x, y = (centred / max(float(np.abs(centred).max()), 1e-12)).T
    degree = _SMOOTH_DEGREE
    terms = [x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)]
    u, values, _ = np.linalg.svd(np.column_stack(terms), full_matrices=False)
    return np.asarray(u[:, values > 1e-9 * values[0]])


def rig_covariance(adjusted: Adjusted, sigma_px: float) -> RigCovariance:
    """Return the covariance of an adjusted rig's parameters.

    Parameters
    ----------
    adjusted : Adjusted
        After `hybridve.calib.solving.bundle.adjust`; its held pose is the world.
    sigma_px : float
        Standard deviation of a coordinate of a point, pixels; 1 if the views were weighed by
        theirs (`BundleView.sigma_px`).
    """
    bundle, layout = adjusted.bundle, adjusted.layout
    if sigma_px > 0:
        information = adjusted.information / sigma_px**2 + np.diag(_prior(bundle, layout))
        inverse = _inverted(information)
    else:
        inverse = np.zeros_like(adjusted.information)  # points without noise
    return _of_rig(bundle, layout, inverse)


def even_covariance(bundle: Bundle) -> RigCovariance:
    """Return the covariance that an adjusted rig had, were all its points counted alike.

    Parameters
    ----------
    bundle : Bundle
        Adjusted; its points are as noisy as its views say (`BundleView.sigma_px`), and its held
        pose is the world. Where they all say the same, it is the rig's own covariance.
    """
    layout = make_layout(bundle)
    information, spread = even_information(bundle)
    variance = float(np.mean([view.sigma_px**2 for view in bundle.views]))
    prior = np.diag(_prior(bundle, layout)) * variance
    inverse = _inverted(information + prior)
    # As a square, which rounding leaves positive where the pictures tell next to nothing.
    scale = np.sqrt(np.diag(information + prior))
    values, vectors = np.linalg.eigh((spread + variance * prior) / np.outer(scale, scale))
    root = (inverse * scale) @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    return _of_rig(bundle, layout, root @ root.T)


def _prior(bundle: Bundle, layout: Layout) -> NDArray[np.float64]:
    """Return what is known without a picture: inverse variances (A,) in a layout's columns."""
    prior = np.zeros(layout.size)
    for span in (*layout.of_camera, *layout.of_board.values()):
        prior[span] = [_PRIOR_RAD**-2] * 3 + [_PRIOR_M**-2] * 3
    for camera, lens in zip(bundle.cameras, bundle.lens_of, strict=True):
        if lens in layout.of_lens:
            prior[layout.of_lens[lens]] = _prior_of_lens(camera) ** -2
    return prior


def _inverted(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse of a positive definite matrix whose units differ along the diagonal.

    What rounding leaves of a direction that nothing tells may be negative: it counts as the least
    that rounding lets be told, so that no variance is.
    """
    scale = np.sqrt(np.diag(information))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    half = vectors / np.sqrt(np.maximum(values, _ROUNDING * values[-1])) / scale[:, None]
    return np.asarray(half @ half.T)


def _of_rig(bundle: Bundle, layout: Layout, inverse: NDArray[np.float64]) -> RigCovariance:
    """Return the covariance of cameras from that of a layout's columns (A, A)."""
    columns: list[int | None] = []
    labels: list[str] = []
    for index, camera in enumerate(bundle.cameras):
        span = layout.of_camera[index]
        columns += range(span.start, span.stop)
        lens_span = layout.of_lens.get(bundle.lens_of[index])
        if lens_span is None:
            columns += [None] * len(camera.params)
        else:
            columns += range(lens_span.start, lens_span.stop)
        labels += [f"{camera.name} {what}" for what in camera_parameter_names(camera)]
    taken = np.array([0 if column is None else column for column in columns])
    matrix = inverse[np.ix_(taken, taken)]
    given = np.array([column is None for column in columns])
    matrix[given] = 0.0
    matrix[:, given] = 0.0
    return RigCovariance(tuple(labels), (matrix + matrix.T) / 2.0)


def camera_parameter_names(camera: Camera) -> tuple[str, ...]:
    """Return the names of a camera's parameters: pose first, lens in COLMAP's order."""
    return (*_POSE_NAMES, *parameter_names(camera.model))


def _prior_of_lens(camera: Camera) -> NDArray[np.float64]:
    """Return the standard deviations (P,) of what is known of a lens without a picture."""
    prior = np.full(len(camera.params), _PRIOR_DISTORTION)
    for index, name in enumerate(parameter_names(camera.model)):
        if name.startswith("f"):
            prior[index] = _PRIOR_SHARE * camera.params[index]
        elif name.startswith("c"):
            prior[index] = _PRIOR_SHARE * camera.width_px
    return prior


def in_world(
    covariance: RigCovariance,
    cameras: Sequence[Camera],
    world_by_parameter: NDArray[np.float64],
    world_covariance: NDArray[np.float64],
) -> RigCovariance:
    """Return the covariance of cameras in a world that was found by means of them.

    Parameters
    ----------
    covariance : RigCovariance
        Of the cameras in the rig's frame.
    cameras : sequence of Camera
        In the world.
    world_by_parameter : (6, P) float64
        How world_from_rig changes with each parameter, as (omega, v) in the world's frame.
    world_covariance : (6, 6) float64
        Of world_from_rig for what else it was found by, in the same form.
    """
    change = np.eye(len(covariance.matrix))
    spans = parameter_slices(cameras)
    turned = [_turned_twist(camera.cam_from_world) for camera in cameras]
    for span, twist in zip(spans, turned, strict=True):
        # A world that is off by delta sees the camera off by -Ad(cam_from_world) delta.
        change[span.start : span.start + POSE] -= twist @ world_by_parameter
    matrix = change @ covariance.matrix @ change.T
    for span, twist in zip(spans, turned, strict=True):
        for other, other_twist in zip(spans, turned, strict=True):
            matrix[span.start : span.start + POSE, other.start : other.start + POSE] += (
                twist @ world_covariance @ other_twist.T
            )
    return RigCovariance(covariance.labels, (matrix + matrix.T) / 2.0)


def _turned_twist(b_from_a: Pose) -> NDArray[np.float64]:
    """Return the matrix (6, 6) that takes (omega, v) in frame a to frame b (the adjoint)."""
    rotation, (x, y, z) = b_from_a[:, :3], b_from_a[:, 3]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    zero = np.zeros((3, 3))
    return np.block([[rotation, zero], [cross @ rotation, rotation]])


# --- In images and in space -------------------------------------------------------------------


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


def _joint_covariance(rig: Rig, derivatives: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the covariance (N, C, 2, C, 2) of images that change so (N, 2, 6 + P) by camera."""
    matrix, slices = _matrix(rig), parameter_slices(rig.cameras)
    n_cameras = len(rig.cameras)
    found = np.zeros((len(derivatives[0]), n_cameras, 2, n_cameras, 2))
    for i, first in enumerate(derivatives):
        for j, second in enumerate(derivatives):
            found[:, i, :, j] = first @ matrix[slices[i], slices[j]] @ second.transpose(0, 2, 1)
    return found


def undistorted_covariance(rig: Rig, point_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance of where the cameras see a point in images freed of distortion.

    Parameters
    ----------
    rig : Rig
        With its covariance.
    point_world : (3,) float64
        A point in metres.

    Returns
    -------
    (C, 2, C, 2) float64
        Pixels squared of pinhole images with the lenses' focal lengths
        (`hybridve.calib.lens.undistortion`); NaN where a camera does not see the point.

    Raises
    ------
    ValueError
        If the rig has no covariance.
    """
    derivatives = []
    for camera in rig.cameras:
        by_point, by_parameter = image_derivatives(camera, point_world[None])
        if camera.has_distortion and np.isfinite(by_point).all():
            rotation, shift = camera.cam_from_world[:, :3], camera.cam_from_world[:, 3]
            depth_m = rotation[2] @ point_world + shift[2]
            by_ray = (by_point[0] @ rotation.T)[:, :2] * depth_m
            by_parameter = camera.pinhole[:2, :2] @ np.linalg.inv(by_ray) @ by_parameter
        derivatives.append(by_parameter)
    return np.asarray(_joint_covariance(rig, derivatives)[0])


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
