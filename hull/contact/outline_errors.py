"""How far outlines may be off in each camera: segmentation, undistortion, rounding, the rig."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.record import CalibrationRecord
from hybridve.calib.rig import Rig
from hybridve.calib.solving.errors_in_space import undistorted_covariance
from hybridve.hull.contact.components import (
    CELL_M,
)


@dataclass(frozen=True, slots=True)
class DoubtSettings:
    """What is assumed of silhouettes and cameras that tell nothing themselves.

    Attributes
    ----------
    segmentation_px : float
        Standard deviation of an outline about the true one. On the horseman recording our
        outlines are 1.4 to 2.1 px (by camera) off those painted by hand, where they are less than
        8 px off; hands have erred by about a pixel themselves.
    calibration_px : float
        Standard deviation of a projection along one axis, for cameras whose rig does not tell.
    cell_m : float
        Volumes that are nearer to each other than some two of these may be told as one.
    near_m : float
        Objects that are farther from the hull than this, and than twice the clearance that they
        require, have no `real_upper_m`, `survives` and `component`: that takes most of the time.
    """

    segmentation_px: float = 1.5
    calibration_px: float = 0.5
    cell_m: float = CELL_M
    near_m: float = 0.10


@dataclass(frozen=True, slots=True, eq=False)
class OutlineErrors:
    """Standard deviations of where each camera's outline is, across the outline, in pixels.

    Attributes
    ----------
    calibration_px : (C,) float64
        Of a projection along one axis.
    is_measured : (C,) bool
        Whether that comes from the rig; else it is assumed.
    segmentation_px : float
        Of the outline in the image.
    lens_px : (C,) float64
        Of undistorting the silhouette, whose shift is bounded: even within that bound.
    rig : Rig or None
        The cameras' rig, if it knows its covariance; `calibration_px` is not used then.
    """

    calibration_px: NDArray[np.float64]
    is_measured: NDArray[np.bool_]
    segmentation_px: float
    lens_px: NDArray[np.float64]
    rig: Rig | None = None

    #: Of an outline that is rounded to whole pixels: even within half a pixel.
    quantisation_px = 1.0 / np.sqrt(12.0)

    @property
    def sigma_px(self) -> NDArray[np.float64]:
        """All of it together, but the rig's covariance: (C,)."""
        variance = self.lens_px**2 + self.segmentation_px**2 + self.quantisation_px**2
        if self.rig is None:
            variance = variance + self.calibration_px**2
        return np.asarray(np.sqrt(variance))

    def calibration_variance_m2(
        self,
        point_world: NDArray[np.float64],
        m_per_px: NDArray[np.float64],
        normals_px: NDArray[np.float64],
    ) -> float:
        """Return the variance that the rig's covariance gives a clearance; 0 without one.

        Parameters
        ----------
        point_world : (3,) float64
            The hull's nearest point, metres.
        m_per_px : (C,) float64
            How far the clearance falls as each camera's outline moves outward by a pixel.
        normals_px : (C, 2) float64
            The outlines' outward normals in the images, unit vectors; NaN where not known: the
            error is taken to be that along either axis, independent of other cameras.
        """
        if self.rig is None or not m_per_px.any():
            return 0.0
        covariance = self.calibration_covariance_px2(point_world, normals_px, m_per_px != 0.0)
        return max(0.0, float(m_per_px @ covariance @ m_per_px))

    def calibration_covariance_px2(
        self,
        point_world: NDArray[np.float64],
        normals_px: NDArray[np.float64],
        is_asked: NDArray[np.bool_],
    ) -> NDArray[np.float64]:
        """Return what the rig's covariance makes of outlines, along their normals: (C, C), px^2.

        It is zero without a covariance, and of cameras that are not asked.

        Parameters
        ----------
        point_world, normals_px
            As of `calibration_variance_m2`.
        is_asked : (C,) bool
            Of which cameras.
        """
        n_cameras = len(normals_px)
        if self.rig is None:
            return np.zeros((n_cameras, n_cameras))
        covariance = np.nan_to_num(undistorted_covariance(self.rig, point_world, is_asked))
        is_known = np.asarray(np.isfinite(normals_px).all(axis=1))
        normals = np.where(is_known[:, None], normals_px, 0.0)
        along_px2 = np.asarray(np.einsum("ki,kilj,lj->kl", normals, covariance, normals))
        for camera in np.flatnonzero(~is_known & is_asked):
            along_px2[camera, camera] = np.trace(covariance[camera, :, camera]) / 2.0
        return along_px2


def outline_errors(
    names: Sequence[str],
    rig: Rig | None,
    mask_shift_px: Sequence[float | None],
    settings: DoubtSettings | None = None,
) -> OutlineErrors:
    """Return how far outlines may be off, as far as the rig tells.

    Parameters
    ----------
    names : sequence of str
        The cameras, C of them.
    rig : Rig or None
        The rig. Its covariance is used if it has one; else how far the corners of the board were
        missed, when it was calibrated or by the session's test of it, whichever is more. These are
        lengths, and an outline cares for one axis only. None: nothing is told.
    mask_shift_px : sequence of C floats or None
        Bounds of `hybridve.calib.lens_bound`; None where there is none, which counts as a pixel.
    settings : DoubtSettings, optional
        What is assumed where the rig does not tell.
    """
    settings = settings or DoubtSettings()
    missed_px = np.array([_missed_px(rig, name) for name in names])
    is_measured = np.isfinite(missed_px)
    shift_px = np.array([1.0 if shift is None else shift for shift in mask_shift_px], np.float64)
    return OutlineErrors(
        np.where(is_measured, missed_px / np.sqrt(2.0), settings.calibration_px),
        is_measured,
        settings.segmentation_px,
        shift_px / np.sqrt(3.0),
        rig.only(names) if rig is not None and rig.covariance is not None else None,
    )


def _missed_px(rig: Rig | None, name: str) -> float:
    """Return the rms length by which a camera's corners were missed; NaN where nobody knows."""
    told: list[float | None] = []
    if rig is not None and isinstance(rig.provenance, CalibrationRecord):
        camera = rig.provenance.cameras.get(name)
        if camera is not None:
            told += [camera.intrinsics.rms_px, camera.extrinsics.rms_px]
    if rig is not None and rig.check is not None and rig.check.check is not None:
        told.append(rig.check.check.rms_px.get(name))
    return max((missed_px for missed_px in told if missed_px is not None), default=np.nan)
