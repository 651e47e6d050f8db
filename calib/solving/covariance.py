"""How far a rig can be wrong: its covariance, and what that means in space and in images.

The covariance is that of the joint adjustment (`hybridve.calib.solving.bundle`), for the noise that
its residuals show. Residuals are told apart into what is smooth over a board, by which parameters
are moved, and what is not, the noise of single points: a lens model that does not fit, a bent board
or motion blur raise the former, and the covariance with it.

This work is based on: Triggs, McLauchlan, Hartley and Fitzgibbon, *Bundle adjustment: a modern
synthesis*, 2000 (section 9); Hartley and Zisserman, *Multiple View Geometry*, 2nd ed., 2003
(sections 5.1 and 5.2, error of estimation and propagation of covariance).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.lens import parameter_names
from hybridve.calib.pose import Pose, cross_matrix
from hybridve.calib.rig import RigCovariance
from hybridve.calib.solving.bundle import (
    POSE,
    Adjusted,
    Bundle,
    Layout,
    even_information,
    make_layout,
)
from hybridve.calib.solving.errors_in_space import parameter_slices

#: Of the largest eigenvalue: what is below is rounding.
_ROUNDING = 1e-15

#: Weak knowledge of what no picture told, as standard deviations: a rotation (radians), a place
#: (metres), and by its share a focal length or, by the image's width, a principal point; the
#: coefficients of distortion. It keeps the covariance finite where the pictures tell nothing, and
#: changes what they tell by less than a millionth.
_PRIOR_RAD = np.pi
_PRIOR_M = 100.0
_PRIOR_SHARE = 1.0
_PRIOR_DISTORTION = 10.0

_POSE_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")


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
    rotation, cross = b_from_a[:, :3], cross_matrix(b_from_a[:, 3])
    return np.block([[rotation, np.zeros((3, 3))], [cross @ rotation, rotation]])
