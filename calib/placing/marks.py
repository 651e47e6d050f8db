"""Points that were marked by hand in several pictures, and where they are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import cam_from_img

#: A click that misses its point by more than this share of the image's width is worth a warning.
_CLICK_SHARE = 0.01

#: Rays that meet at a smaller angle (radians) tell no distance.
_MIN_ANGLE_RAD = 5e-3

#: Where least squares end: rounding.
_ROUNDING = 1e-15


@dataclass(frozen=True, slots=True, eq=False)
class Mark:
    """A point of the scene, clicked in several cameras.

    Attributes
    ----------
    name : str
        For messages.
    pixels : mapping of str to (x, y)
        By camera, pixel centre at 0.5.
    xyz_m : (3,) float64, or None
        Where it is in the world, metres.
    is_floor : bool
        Whether it lies on the floor.
    """

    name: str
    pixels: Mapping[str, tuple[float, float]]
    xyz_m: NDArray[np.float64] | None = None
    is_floor: bool = False


def triangulate(
    cameras: Sequence[Camera], pixels: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the point that several cameras see, with the least squared error in their images.

    Parameters
    ----------
    cameras : sequence of Camera
        At least two.
    pixels : (C, 2) float64
        Where each sees it, pixel centre at 0.5.

    Returns
    -------
    point_world : (3,) float64
        NaN where a camera has no ray there, the rays are as good as parallel, or meet behind a
        camera.
    misses_px : (C,) float64
        By how far each camera misses it.
    """
    nowhere = np.full(3, np.nan), np.full(len(cameras), np.nan)
    rays = np.stack([cam_from_img(camera, pixels[i, None])[0] for i, camera in enumerate(cameras)])
    if not np.isfinite(rays).all():
        return nowhere
    focal_px = np.array([camera.pinhole[0, 0] for camera in cameras])
    poses = np.stack([camera.cam_from_world for camera in cameras])
    directions = np.einsum(
        "cji,cj->ci", poses[:, :, :3], np.column_stack([rays, np.ones(len(rays))])
    )
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    spread = np.linalg.norm(np.cross(directions[:, None], directions[None]), axis=2)
    if spread.max() < _MIN_ANGLE_RAD:
        return nowhere
    # Late: most commands triangulate nothing, and need not wait for SciPy's optimisers.
    from scipy.optimize import least_squares

    def points_cam(point: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(poses[:, :, :3] @ point + poses[:, :, 3])

    def misses(point: NDArray[np.float64]) -> NDArray[np.float64]:
        seen = points_cam(point)
        return np.asarray(focal_px[:, None] * (seen[:, :2] / seen[:, 2:] - rays)).ravel()

    def slopes(point: NDArray[np.float64]) -> NDArray[np.float64]:
        seen = points_cam(point)[:, :, None]
        flat = seen[:, :2] / seen[:, 2:]
        by_point = (poses[:, :2, :3] - flat * poses[:, 2:, :3]) / seen[:, 2:]
        return np.asarray(focal_px[:, None, None] * by_point).reshape(-1, 3)

    # Start where the rays pass nearest to one another, in space.
    centers = np.array([camera.center_world for camera in cameras])
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    start = np.linalg.solve(across.sum(axis=0), np.einsum("cij,cj->i", across, centers))
    if (points_cam(start)[:, 2] <= 0).any():
        return nowhere
    found = least_squares(
        misses, start, slopes, method="lm", ftol=_ROUNDING, xtol=_ROUNDING, gtol=_ROUNDING
    )
    if (points_cam(found.x)[:, 2] <= 0).any():
        return nowhere
    return found.x, np.linalg.norm(found.fun.reshape(-1, 2), axis=1)


def triangulated(
    cameras: Sequence[Camera], marks: Sequence[Mark]
) -> tuple[NDArray[np.float64], dict[str, dict[str, float]]]:
    """Return the marks' places (M, 3) in the rig, and by mark and camera how far it is missed."""
    by_name = {camera.name: camera for camera in cameras}
    points = np.zeros((len(marks), 3))
    misses: dict[str, dict[str, float]] = {}
    for index, mark in enumerate(marks):
        names = sorted(name for name in mark.pixels if name in by_name)
        if len(names) < 2:
            raise CalibrationError(
                f"point {mark.name!r} is seen by {len(names)} camera of the rig; mark it in 2 or "
                "more"
            )
        pixels = np.array([mark.pixels[name] for name in names], np.float64)
        points[index], missed_px = triangulate([by_name[name] for name in names], pixels)
        if not np.isfinite(points[index]).all():
            raise CalibrationError(
                f"point {mark.name!r}: the rays of {', '.join(map(repr, names))} do not meet "
                "before them; is it clicked at the same place in each picture, and are the cameras "
                "far enough apart?"
            )
        misses[mark.name] = dict(zip(names, map(float, missed_px), strict=True))
    return points, misses


def click_warnings(
    cameras: Sequence[Camera],
    marks: Sequence[Mark],
    misses_px: Mapping[str, Mapping[str, float]],
) -> list[str]:
    """Return what is to be said of marks that miss their points by much."""
    widths = {camera.name: camera.width_px for camera in cameras}
    warnings = []
    for mark in marks:
        missed = misses_px[mark.name]
        worst = max(missed, key=lambda name: missed[name] / widths[name])
        if missed[worst] > _CLICK_SHARE * widths[worst]:
            warnings.append(
                f"point {mark.name!r}: the rays of {', '.join(map(repr, sorted(missed)))} miss one "
                f"another by {missed[worst]:.1f} px (in {worst!r}); is it the same place in each?"
            )
    return warnings


def rounded(misses_px: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Return plain numbers, to the tenth of a millimetre."""
    return {
        point: {camera: round(missed, 2) for camera, missed in missed_px.items()}
        for point, missed_px in misses_px.items()
    }
