"""rig.json: our own file of a rig, whole: lenses, poses, covariance, record, mounts."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hybridve.calib.bounded import parse_json, read_bounded
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.files import write_together
from hybridve.calib.provenance import provenance_from_plain, provenance_to_plain
from hybridve.calib.rig import Mount, Rig, RigCovariance
from hybridve.calib.verdict import RigTest

FORMAT = "hybridve-rig"
VERSION = 1

_CONVENTIONS = {
    "length": "metres",
    "image": "pixels; the centre of the top-left pixel is (0.5, 0.5), x right, y down",
    "camera frame": "x right, y down, z forward",
    "cam_from_world": "[R | t], row by row: x_cam = R x_world + t",
    "params": "the parameters of COLMAP's camera model, in COLMAP's order",
    "skew_px": "entry (1, 2) of the camera matrix",
    "covariance": "lower triangle, row by row; a camera's pose errors (rx ry rz, tx ty tz) are in "
    "its own frame, radians and metres: R_true = exp(r) R, t_true = t + (tx, ty, tz)",
    "mounts": "cam_from_world = cam_from_tracker, then the inverse of the tracker's pose, then "
    "the inverse of world_from_tracking",
}


def rig_to_dict(rig: Rig) -> dict[str, Any]:
    """Return a rig as the plain JSON values of a rig.json, with all digits."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "conventions": _CONVENTIONS,
        "cameras": [
            {
                "name": camera.name,
                "model": camera.model,
                "width_px": camera.width_px,
                "height_px": camera.height_px,
                "params": camera.params.tolist(),
                "skew_px": camera.skew_px,
                "cam_from_world": camera.cam_from_world.tolist(),
            }
            for camera in rig.cameras
        ],
        **_covariance_to_dict(rig.covariance),
        **_mounts_to_dict(rig.mounts),
        "provenance": provenance_to_plain(rig.provenance) | _check_to_dict(rig.check),
    }


def _check_to_dict(check: RigTest | None) -> dict[str, Any]:
    return {} if check is None else {"check": check.to_dict()}


def _covariance_to_dict(covariance: RigCovariance | None) -> dict[str, Any]:
    if covariance is None:
        return {}
    rows = [row[: index + 1].tolist() for index, row in enumerate(covariance.matrix)]
    return {"covariance": {"labels": list(covariance.labels), "matrix": rows}}


def _mounts_to_dict(mounts: Mapping[str, Mount]) -> dict[str, Any]:
    if not mounts:
        return {}
    return {
        "mounts": {
            name: {
                "cam_from_tracker": mount.cam_from_tracker.tolist(),
                "world_from_tracking": mount.world_from_tracking.tolist(),
            }
            for name, mount in mounts.items()
        }
    }


def write_rig(path: Path, rig: Rig) -> None:
    """Write a rig.json; the file appears only when it is complete."""
    write_texts({path: rig_json_text(rig)})


def rig_json_text(rig: Rig) -> str:
    """Return the text of a rig.json."""
    return json.dumps(rig_to_dict(rig), indent=1, allow_nan=False) + "\n"


def read_rig(path: Path) -> Rig:
    """Read a rig.json.

    Raises
    ------
    CalibrationError
        If the file is missing, is not a rig, or is of a version that this program does not know.
    """
    try:
        content = parse_json(read_bounded(path))
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise CalibrationError(f"{path}: not JSON ({error}); expected a rig.json") from error
    return rig_from_dict(content, str(path))


def rig_from_dict(content: Any, path: str) -> Rig:
    """Return the rig that a rig.json holds, or a report.

    Raises
    ------
    CalibrationError
        If it is not a rig, or of a version that this program does not know; it begins with `path`.
    """
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else type(content).__name__
        raise CalibrationError(f"{path}: format is {found!r}, expected {FORMAT!r}")
    if content.get("version") != VERSION:
        raise CalibrationError(
            f"{path}: version {content.get('version')!r} is not known, expected {VERSION}; "
            "calibrate again, or use the program that wrote it"
        )
    try:
        cameras = tuple(
            Camera(
                name=str(entry["name"]),
                model=str(entry["model"]),
                width_px=int(entry["width_px"]),
                height_px=int(entry["height_px"]),
                params=np.array(entry["params"], dtype=np.float64),
                cam_from_world=np.array(entry["cam_from_world"], dtype=np.float64),
                skew_px=float(entry.get("skew_px", 0.0)),
            )
            for entry in content["cameras"]
        )
        for camera in cameras:
            check_focal_lengths(camera)
        told = dict(content.get("provenance", {}))
        check = RigTest.from_dict(told.pop("check")) if "check" in told else None
        return Rig(
            cameras,
            provenance_from_plain(told),
            _covariance_from_dict(content["covariance"]) if "covariance" in content else None,
            {
                str(name): Mount(
                    np.array(entry["cam_from_tracker"], dtype=np.float64),
                    np.array(entry["world_from_tracking"], dtype=np.float64),
                )
                for name, entry in content.get("mounts", {}).items()
            },
            check,
        )
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error
    except KeyError as error:
        raise CalibrationError(
            f"{path}: a camera has no {error}, or a mount or the covariance; expected {FORMAT} 1"
        ) from error
    except (AttributeError, TypeError, ValueError) as error:
        raise CalibrationError(f"{path}: {error}; expected {FORMAT} 1") from error


def _covariance_from_dict(entry: Mapping[str, Any]) -> RigCovariance:
    rows = [np.array(row, dtype=np.float64) for row in entry["matrix"]]
    matrix = np.zeros((len(rows), len(rows)))
    for index, row in enumerate(rows):
        if row.shape != (index + 1,):
            raise CalibrationError(
                f"row {index + 1} of the covariance has shape {row.shape}, expected "
                f"{(index + 1,)}: the lower triangle"
            )
        matrix[index, : index + 1] = matrix[: index + 1, index] = row
    return RigCovariance(tuple(str(label) for label in entry["labels"]), matrix)


def write_texts(texts: Mapping[Path, str]) -> None:
    """Write text files, none under its final name before all are complete."""
    try:
        write_together({path: text.encode() for path, text in texts.items()})
    except OSError as error:
        named = error.filename or next(iter(texts))
        raise CalibrationError(
            f"{str(named).removesuffix('.partial')}: cannot be written ({error.strerror})"
        ) from error


def check_focal_lengths(camera: Camera) -> None:
    """Refuse focal lengths that mirror a picture or turn it around.

    Raises
    ------
    CalibrationError
        If one is not above zero.
    """
    focal_px = np.diag(camera.pinhole)[:2]
    if (focal_px > 0).all():
        return
    found = " and ".join(f"{value:g}" for value in focal_px)
    if focal_px.prod() < 0:
        why = "the picture is mirrored; flip it, and make both positive"
    else:
        why = (
            "expected both above 0; where both are negative, the picture is upside down or the "
            "camera looks the other way: turn its pose by 180 degrees"
        )
    raise CalibrationError(f"camera {camera.name!r}: focal lengths of {found} px: {why}")
