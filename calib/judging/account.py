"""What a calibration tells: the rig, and as plain values where its numbers come from."""

import importlib.metadata
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations, is_seen
from hybridve.calib.placing.fixed_cameras import Solved, other_tilt
from hybridve.calib.placing.moving_cameras import Mounted
from hybridve.calib.placing.settings import CalibrationSettings
from hybridve.calib.rig import Rig, RigCovariance
from hybridve.calib.solving.bundle import POSE, BundleView
from hybridve.calib.solving.covariance import (
    Noise,
    camera_parameter_names,
)
from hybridve.calib.solving.lens_fit import FittedLens, rms

#: Outliers that are listed one by one.
_TOLD_OUTLIERS = 50


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A rig and what it was made from.

    Attributes
    ----------
    rig : Rig
        With its covariance; ``provenance`` holds errors per camera, what was dropped and why.
    noise : Noise
        How noisy the points of boards were.
    pixels, residuals_px : dict of str to (K, 2) float64
        By camera all points that were used, and observed minus projected.
    """

    rig: Rig
    noise: Noise
    pixels: dict[str, NDArray[np.float64]]
    residuals_px: dict[str, NDArray[np.float64]]


def put_together(
    boards: Sequence[Board],
    observations: Sequence[Observations],
    lenses: Sequence[FittedLens],
    solved: Solved | None,
    mounted: Sequence[Mounted],
    about: dict[str, Any],
    settings: CalibrationSettings,
) -> Calibration:
    """Return a calibration from its parts.

    Parameters
    ----------
    boards : sequence of Board
        The boards; sightings count them.
    observations, lenses : sequence of Observations, sequence of FittedLens
        Of the fixed cameras, then of the moving ones.
    solved : Solved or None
        The fixed cameras, if there are any.
    mounted : sequence of Mounted
        The moving ones.
    about : dict
        What was decided on the way, for the provenance.
    settings : CalibrationSettings
        How it was done.
    """
    cameras = (() if solved is None else solved.cameras) + tuple(one.camera for one in mounted)
    pixels: dict[str, NDArray[np.float64]] = {}
    residuals: dict[str, NDArray[np.float64]] = {}
    views: Sequence[tuple[BundleView, NDArray[np.float64]]] = ()
    if solved is not None:
        views = list(zip(solved.adjusted.bundle.views, solved.adjusted.residuals_px, strict=True))
    told = {}
    for index, (seen, lens) in enumerate(zip(observations, lenses, strict=True)):
        own = [(view, missed) for view, missed in views if view.camera == index]
        clip = [
            missed
            for view, missed in own
            if solved is not None and isinstance(solved.linked.pose_names[view.pose][0], int)
        ]
        alone = [
            missed
            for view, missed in own
            if solved is not None and isinstance(solved.linked.pose_names[view.pose][0], str)
        ]
        if own:
            every = np.concatenate([missed for _, missed in own])
            found = is_seen(every)
            residuals[seen.name] = every[found]
            pixels[seen.name] = np.concatenate([view.pixels for view, _ in own])[found]
        told[seen.name] = _told_of_camera(boards, seen, lens, alone, clip)
    for one in mounted:
        told[one.camera.name]["mount"] = one.told
    noise = (
        solved.noise
        if solved is not None
        else Noise(lenses[0].noise_px, lenses[0].noise_px, lenses[0].rms_px, 1.0, 0, 0)
    )
    provenance: dict[str, Any] = {
        "method": "joint bundle adjustment of lenses, poses and boards",
        "software": {
            name: importlib.metadata.version(name)
            for name in ("hybridve", "pycolmap", "opencv-python-headless")
        },
        "boards": [{"name": board.name, "body": board.body, "is": str(board)} for board in boards],
        "rms_px": round(noise.rms_px, 4),
        "noise": asdict(noise),
        "cameras": told,
        **about,
        "settings": {"lens": asdict(settings.lens), "observe": asdict(settings.observe)},
    }
    if solved is not None:
        provenance["adjustment"] = {
            "steps": solved.adjusted.n_steps,
            "views": len(views),
            "outliers": len(solved.outliers),
            "worst_outliers": solved.outliers[:_TOLD_OUTLIERS],
            "left_out": dict(solved.linked.left_out),
            "warnings": list(solved.linked.warnings),
        }
    rig = Rig(
        cameras,
        provenance,
        covariance=_whole_covariance(solved, mounted),
        mounts={one.camera.name: one.mount for one in mounted},
    )
    return Calibration(rig, noise, pixels, residuals)


def _whole_covariance(solved: Solved | None, mounted: Sequence[Mounted]) -> RigCovariance:
    """Return the covariance of all cameras; moving ones are independent, their lenses as given.

    The pose of a moving camera is that at one instant.
    """
    labels = () if solved is None else solved.covariance.labels
    blocks = [] if solved is None else [solved.covariance.matrix]
    for one in mounted:
        names = camera_parameter_names(one.camera)
        labels += tuple(f"{one.camera.name} {name}" for name in names)
        block = np.zeros((len(names), len(names)))
        block[:POSE, :POSE] = one.told["pose_covariance"]
        blocks.append((block + block.T) / 2.0)
    size = sum(map(len, blocks))
    matrix = np.zeros((size, size))
    position = 0
    for block in blocks:
        span = slice(position, position + len(block))
        matrix[span, span] = block
        position += len(block)
    return RigCovariance(labels, matrix)


def _told_of_camera(
    boards: Sequence[Board],
    seen: Observations,
    lens: FittedLens,
    stills: Sequence[NDArray[np.float64]],
    clip: Sequence[NDArray[np.float64]],
) -> dict[str, Any]:
    """Return where one camera's numbers come from, as plain JSON values."""
    extrinsics = {
        "source": seen.sources.get("extrinsics"),
        "corners_by_hand": seen.sources.get("corners"),
        **_errors(clip),
        "how": seen.how,
    }
    if seen.spread_px is not None and np.isfinite(seen.spread_px):
        extrinsics["spread_over_clip_px"] = round(seen.spread_px, 4)
    tilt = other_tilt(boards, lens.camera, seen) if seen.is_still else None
    if tilt is not None:
        extrinsics["other_tilt_times_worse"] = round(tilt, 2)
    told: dict[str, Any] = {
        "model": lens.camera.model,
        "intrinsics": {
            "source": seen.sources.get("intrinsics"),
            **_errors(stills),
            "views_dropped": lens.dropped,
            "views_without_board": seen.missed,
            "outliers": len(lens.outliers),
        },
        "extrinsics": extrinsics,
        "warnings": list(lens.warnings),
        "notes": list(seen.notes),
    }
    if lens.choice is not None:
        told["model_chosen"] = lens.choice
    return told


def _errors(residuals: Sequence[NDArray[np.float64]]) -> dict[str, Any]:
    if not residuals:
        return {"views_used": 0, "rms_px": None, "max_px": None}
    every = np.concatenate(residuals)
    every = every[is_seen(every)]
    return {
        "views_used": len(residuals),
        "rms_px": round(rms(every), 4),
        "max_px": round(float(np.linalg.norm(every, axis=1).max()), 3),
    }
