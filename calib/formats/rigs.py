"""Rigs on disk: our rig.json, and the files of other programs, read and written.

A foreign file is recognised by what it holds, not by its name. What it does not say (its unit,
where its pixel centres lie, the images' size) is given by the caller, never guessed.
"""

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats import caliscope, kalibr, multical, opencv, rows
from hybridve.calib.formats.approximate import approximate
from hybridve.calib.formats.colmap import read_colmap_model, write_colmap_model
from hybridve.calib.formats.foreign import (
    ForeignCamera,
    ForeignRig,
    principal_point_index,
    read_text,
)
from hybridve.calib.pose import nearest_to_axes
from hybridve.calib.record import (
    CalibrationRecord,
    MadeElsewhere,
    provenance_from_plain,
    provenance_to_plain,
)
from hybridve.calib.rig import Mount, Rig, RigCovariance
from hybridve.calib.verdict import RigTest

FORMAT = "hybridve-rig"
VERSION = 1

#: Metres a unit of length; "squares" are those of the board.
UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}

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

#: Stands for a camera's name in the path of a rig that is one file a camera.
PLACEHOLDER = "{camera}"

#: Condition number from which on optical axes are called parallel: all within some 6 degrees.
_PARALLEL = 100.0

#: The files of a COLMAP text model that are written.
_COLMAP_FILES = ("cameras.txt", "frames.txt", "images.txt", "points3D.txt", "rigs.txt")

#: OpenCV's models as targets of an approximation, with so many free parameters.
_OPENCV_5 = (("FULL_OPENCV", 9), ("OPENCV_FISHEYE", 8))
_OPENCV_8 = (("FULL_OPENCV", 12), ("OPENCV_FISHEYE", 8))
_KALIBR_MODELS = (("OPENCV", 8), ("OPENCV_FISHEYE", 8), ("EUCM", 6), ("FOV", 5))


@dataclass(frozen=True, slots=True)
class _Target:
    """A format to write: what it can hold, and what of a rig stays behind.

    Attributes
    ----------
    refusal : callable
        Why it cannot hold a camera, or None.
    substitutes : tuple of (str, int)
        The lens models to approximate another one with; see `approximate`.
    unit : str or None
        The unit that it fixes.
    """

    refusal: Callable[[Camera], str | None]
    substitutes: tuple[tuple[str, int], ...] = ()
    unit: str | None = None


def _colmap_refusal(camera: Camera) -> str | None:
    return f"a skew of {camera.skew_px:.3g} px" if camera.skew_px else None


_TARGETS = {
    "json": _Target(lambda _: None, unit="m"),
    "colmap": _Target(_colmap_refusal),
    "opencv": _Target(opencv.refusal, _OPENCV_8),
    "csv": _Target(rows.refusal),
    "caliscope": _Target(caliscope.refusal, _OPENCV_5, unit="m"),
    "aniposelib": _Target(caliscope.refusal, _OPENCV_5),
    "kalibr": _Target(kalibr.refusal, _KALIBR_MODELS, unit="m"),
    "multical": _Target(multical.refusal, _OPENCV_8),
}

#: The short names of the formats that are written, and read.
FORMATS = tuple(_TARGETS)


@dataclass(frozen=True, slots=True)
class Written:
    """What became of a rig in another format.

    Attributes
    ----------
    files : tuple of Path
        The files written.
    approximated : dict of str to dict
        For each camera whose lens the format does not have: "model", what stands for it, and
        "error_px", the largest distance between the two images of a ray.
    lost : tuple of str
        What of the rig the format has no place for, in words.
    """

    files: tuple[Path, ...]
    approximated: dict[str, dict[str, Any]]
    lost: tuple[str, ...]


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
    _write_texts({path: _rig_json(rig)})


def _rig_json(rig: Rig) -> str:
    return json.dumps(rig_to_dict(rig), indent=1, allow_nan=False) + "\n"


def read_rig(path: Path) -> Rig:
    """Read a rig.json.

    Raises
    ------
    CalibrationError
        If the file is missing, is not a rig, or is of a version that this program does not know.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise CalibrationError(f"{path}: not JSON ({error}); expected a rig.json") from error
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
            _check_focal_lengths(camera)
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


def import_rig(
    root: Path,
    pattern: str,
    unit: str | None,
    pixel_centre: float | None,
    image_sizes: Mapping[str, tuple[int, int]],
    square_m: float | None,
) -> Rig:
    """Read a rig that was calibrated elsewhere, for cameras that are known.

    Parameters
    ----------
    root : Path
        The folder that `pattern` starts from.
    pattern : str
        A file for all cameras, the folder of a COLMAP model, or, with the placeholder
        ``{camera}``, one file a camera; then the name inside a file does not count.
    unit : str or None
        "m", "cm", "mm", "in", "ft" or "squares": that of the file's translations. None: the one
        that its format fixes, or that stands in the file. Of no consequence for rig.json.
    pixel_centre : float or None
        Where the file has the centre of the top-left pixel: 0.5 (COLMAP) or 0 (OpenCV). None: where
        such files usually have it. Of no consequence where the format fixes it: for rig.json,
        COLMAP models, Caliscope, aniposelib, Kalibr and multical.
    image_sizes : mapping of str to (width, height)
        The cameras wanted and the sizes of their images in pixels. Names in the file may have an
        ending that these have not ("cam1.png").
    square_m : float or None
        The side of the board's squares, for unit "squares".

    Returns
    -------
    rig : Rig
        The cameras of `image_sizes`, in that order.

    Raises
    ------
    CalibrationError
        Saying which file or camera, what was found and what was expected.
    """
    if not image_sizes:
        raise CalibrationError(f"{pattern}: no camera is asked for; name at least one")
    factor_m = None if unit is None else _metres(unit, square_m)
    found = _read(root, pattern, list(image_sizes))
    if isinstance(found, Rig):
        return _choose(found, image_sizes, pattern)
    rig = _to_rig(found, pattern, unit, factor_m, pixel_centre, image_sizes)
    if unit == "squares":
        assert isinstance(rig.provenance, MadeElsewhere)
        rig = replace(rig, provenance=MadeElsewhere({**rig.provenance.told, "square_m": square_m}))
    return rig


def read_any_rig(
    source: Path,
    *,
    unit: str | None = None,
    pixel_centre: float | None = None,
    image_size: tuple[int, int] | None = None,
    names: Sequence[str] = (),
) -> Rig:
    """Read a rig in any of the `FORMATS`, recognised by its content.

    Parameters
    ----------
    source : Path
        A file, the folder of a COLMAP model, or, with the placeholder ``{camera}``, one file a
        camera.
    unit : str or None
        See `import_rig`.
    pixel_centre : float or None
        See `import_rig`.
    image_size : (width, height) or None
        For files that do not say it.
    names : sequence of str
        The cameras wanted, in this order; none: all.

    Raises
    ------
    CalibrationError
        Saying which file or camera, what was found and what was expected.
    """
    pattern = str(source)
    factor_m = None if unit is None else _metres(unit, None)
    wanted = list(names)
    if PLACEHOLDER in pattern and not wanted:
        wanted = _names_on_disk(source)
    found = _read(Path(), pattern, wanted)
    if isinstance(found, Rig):
        if not names:
            return found
        known = [camera.name for camera in found.cameras]
        return found.only([known[_pick(found.cameras, name, pattern)] for name in names])
    if not wanted and found.incomplete:
        missing = "; ".join(f"{name!r} has no {what}" for name, what in found.incomplete.items())
        raise CalibrationError(f"{pattern}: {missing}; calibrate it, or name the cameras wanted")
    sizes: dict[str, tuple[int, int]] = {}
    for name in wanted or [camera.name for camera in found.cameras]:
        size_px = _foreign(found, name, pattern).size_px or image_size
        if size_px is None:
            raise CalibrationError(
                f"{pattern}: does not say the image size of camera {name!r}; give it"
            )
        sizes[name] = size_px
    return _to_rig(found, pattern, unit, factor_m, pixel_centre, sizes)


def output_files(rig: Rig, to: str, target: Path) -> list[Path]:
    """Return the files that `export_rig` writes.

    Raises
    ------
    CalibrationError
        If the format needs another kind of path.
    """
    if to == "colmap":
        return [target / name for name in _COLMAP_FILES]
    if to != "opencv":
        if PLACEHOLDER in str(target):
            raise CalibrationError(f"{target}: {to} is one file for all cameras; name one file")
        return [target]
    if target.suffix.lower() not in opencv.SUFFIXES:
        raise CalibrationError(
            f"{target}: OpenCV writes {', '.join(opencv.SUFFIXES)}; end the name with one of them"
        )
    if PLACEHOLDER not in str(target) and len(rig.cameras) > 1:
        raise CalibrationError(
            f"{target}: OpenCV's files hold one camera, the rig has {len(rig.cameras)}; put "
            f"{PLACEHOLDER} into the path, or name one camera"
        )
    for camera in rig.cameras:
        if PLACEHOLDER in str(target) and ("/" in camera.name or camera.name in {".", ".."}):
            raise CalibrationError(f"{target}: {camera.name!r} cannot be part of a file's name")
    return [Path(str(target).replace(PLACEHOLDER, camera.name)) for camera in rig.cameras]


def export_rig(
    rig: Rig, to: str, target: Path, *, unit: str | None = None, approximate_lenses: bool = False
) -> Written:
    """Write a rig in another format; all files stand complete, or none.

    Parameters
    ----------
    rig : Rig
        The rig.
    to : str
        One of `FORMATS`.
    target : Path
        The file; for "colmap" the folder; for "opencv", with more than one camera, a path with
        the placeholder ``{camera}``.
    unit : str or None
        Of the translations: a key of `UNITS_M`. None: metres.
    approximate_lenses : bool
        Whether a lens model that the format lacks is replaced by the nearest that it has.

    Raises
    ------
    CalibrationError
        If the format cannot hold a camera, or the unit, or the files cannot be written.
    """
    known = _TARGETS[to]
    unit = unit or "m"
    unit_m = _metres(unit, None)
    if known.unit not in {None, unit}:
        raise CalibrationError(f"{target}: {to} is in {known.unit} by definition, not in {unit}")
    files = output_files(rig, to, target)
    cameras, approximated = [], {}
    for camera in rig.cameras:
        why = known.refusal(camera)
        if why is not None:
            reason = f"{target}: {to} cannot hold camera {camera.name!r}: it has {why}"
            # Only another lens can be put in a lens's place.
            if not known.substitutes or not camera.has_distortion:
                raise CalibrationError(reason)
            if not approximate_lenses:
                raise CalibrationError(
                    f"{reason}; --approximate takes the nearest lens it can hold"
                )
            camera, error_px = approximate(camera, known.substitutes)
            approximated[camera.name] = {"model": camera.model, "error_px": error_px}
        cameras.append(camera)
    if to == "colmap":
        moved = [
            replace(c, cam_from_world=c.cam_from_world * [1.0, 1.0, 1.0, 1.0 / unit_m])
            for c in cameras
        ]
        write_colmap_model(target, Rig(tuple(moved)))
    else:
        texts: dict[str, Callable[[], list[str]]] = {
            "json": lambda: [_rig_json(rig)],
            "opencv": lambda: [
                opencv.write_opencv(camera, target.suffix.lower(), unit_m) for camera in cameras
            ],
            "csv": lambda: [rows.write_rows(cameras, unit_m)],
            "caliscope": lambda: [caliscope.write_caliscope(cameras)],
            "aniposelib": lambda: [caliscope.write_aniposelib(cameras, unit, unit_m)],
            "kalibr": lambda: [kalibr.write_chain(cameras)],
            "multical": lambda: [multical.write_multical(cameras, unit_m)],
        }
        _make_camera_folders(target, files)
        _write_texts(dict(zip(files, texts[to](), strict=True)))
    return Written(tuple(files), approximated, tuple(_lost(rig, to)))


def _lost(rig: Rig, to: str) -> Iterable[str]:
    """Say what of a rig a format has no place for."""
    if to == "json":
        return
    names = [camera.name for camera in rig.cameras]
    if to == "csv":
        yield "the image sizes"
    if to == "kalibr":
        yield f"the world: it is the frame of {names[0]!r} now"
        numbered = [f"cam{number}" for number in range(len(names))]
    elif to == "caliscope":
        numbered = [f"{number}" for number in caliscope.camera_ids(names)]
    else:
        numbered = names
    if numbered != names:
        pairs = (f"{number} is {name!r}" for number, name in zip(numbered, names, strict=True))
        yield f"the cameras' names, which {to} passes over: {', '.join(pairs)}"
    if rig.covariance is not None:
        yield "the covariance"
    if rig.mounts:
        yield f"the mounts of {', '.join(rig.mounts)} on their trackers"


def _make_camera_folders(target: Path, files: Sequence[Path]) -> None:
    """Make the folders that are named after cameras; those above must be there."""
    parent = target.parent
    while PLACEHOLDER in str(parent):
        parent = parent.parent
    for path in files if parent.is_dir() else ():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CalibrationError(f"{path.parent}: cannot be made ({error.strerror})") from error


def _write_texts(texts: Mapping[Path, str]) -> None:
    """Write text files, none under its final name before all are complete."""
    partials = {path: path.with_name(path.name + ".partial") for path in texts}
    try:
        for path, text in texts.items():
            partials[path].write_text(text, encoding="utf-8")
        for path in texts:
            partials[path].replace(path)
    except OSError as error:
        for partial in partials.values():
            partial.unlink(missing_ok=True)
        named = error.filename or next(iter(texts))
        raise CalibrationError(
            f"{str(named).removesuffix('.partial')}: cannot be written ({error.strerror})"
        ) from error


def _to_rig(
    found: ForeignRig,
    pattern: str,
    unit: str | None,
    factor_m: float | None,
    pixel_centre: float | None,
    image_sizes: Mapping[str, tuple[int, int]],
) -> Rig:
    """Return the cameras of a foreign rig that `image_sizes` names, in metres and our pixels."""
    if found.is_centre_fixed or pixel_centre is None:
        pixel_centre = found.pixel_centre
    if pixel_centre not in (0.0, 0.5):
        raise CalibrationError(
            f"the rig's pixel centre is {pixel_centre!r}; expected 0.5 (COLMAP) or 0 (OpenCV)"
        )
    if factor_m is None:
        unit = found.unit
        if unit is None:
            raise CalibrationError(
                f"{pattern}: {found.format} does not say the unit of its lengths; name it: one of "
                f"{', '.join(UNITS_M)}"
            )
        factor_m = _metres(unit, None)
    chosen = {name: _foreign(found, name, pattern) for name in image_sizes}
    _refuse_mirrored(found, chosen, pattern)
    cameras = []
    for name, size_px in image_sizes.items():
        foreign = chosen[name]
        if foreign.size_px is not None:
            _check_size(foreign.size_px, size_px, name, pattern)
        params = foreign.params.copy()
        start = principal_point_index(foreign.model)
        params[start : start + 2] += 0.5 - pixel_centre
        pose = foreign.cam_from_world.copy()
        pose[:, 3] *= factor_m
        width_px, height_px = (int(extent) for extent in size_px)
        try:
            camera = Camera(name, foreign.model, width_px, height_px, params, pose, foreign.skew_px)
            _check_focal_lengths(camera)
        except CalibrationError as error:
            raise CalibrationError(f"{pattern}: {error}") from error
        cameras.append(camera)
    provenance = {
        "method": "imported",
        "file": pattern,
        "format": found.format,
        "unit": unit,
        "pixel_centre": pixel_centre,
    }
    return Rig(tuple(cameras), MadeElsewhere(provenance))


def _refuse_mirrored(found: ForeignRig, chosen: Mapping[str, ForeignCamera], pattern: str) -> None:
    """Refuse mirrored pictures among cameras whose matrices have a negative determinant.

    Such a matrix is a mirrored picture of what lies on one side of the camera, or with its sign
    reversed a plain one of what lies on the other. Which it is shows where the optical axes come
    together: they are the same lines for either.
    """
    poses = [camera.cam_from_world for camera in found.cameras]
    axes = np.array([pose[2, :3] for pose in poses])
    centers = np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses])
    meeting = nearest_to_axes(centers, axes, _PARALLEL)
    if meeting is None:
        return
    mirrored = [
        name
        for name, camera in chosen.items()
        if camera.may_be_mirrored
        and camera.cam_from_world[2, :3] @ meeting + camera.cam_from_world[2, 3] < 0
    ]
    if mirrored:
        names = ", ".join(repr(name) for name in mirrored)
        plural = "camera" if len(mirrored) == 1 else "cameras"
        raise CalibrationError(
            f"{pattern}: {plural} {names}: the matrix has a negative determinant, and with its "
            "sign reversed looks away from where all optical axes come together: it is that of a "
            "mirrored picture (or one with y upwards); flip the pictures and the matrix's row, or "
            "reverse the sign of its 12 numbers if the camera does look away"
        )


def _check_focal_lengths(camera: Camera) -> None:
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


def _choose(rig: Rig, image_sizes: Mapping[str, tuple[int, int]], pattern: str) -> Rig:
    """Return the cameras asked for of a rig of ours, under the names asked for."""
    names = {rig.cameras[_pick(rig.cameras, name, pattern)].name: name for name in image_sizes}
    rig = rig.only(list(names))
    for camera in rig.cameras:
        size_px = (camera.width_px, camera.height_px)
        _check_size(size_px, image_sizes[names[camera.name]], names[camera.name], pattern)
    covariance = rig.covariance
    if covariance is not None:
        parts = [label.rpartition(" ") for label in covariance.labels]
        labels = tuple(f"{names[owner]} {parameter}" for owner, _, parameter in parts)
        covariance = RigCovariance(labels, covariance.matrix)
    provenance = rig.provenance
    if isinstance(provenance, CalibrationRecord):
        provenance = provenance.renamed(names)
    return Rig(
        tuple(replace(camera, name=names[camera.name]) for camera in rig.cameras),
        provenance,
        covariance,
        {names[name]: mount for name, mount in rig.mounts.items()},
    )


def _check_size(found: tuple[int, int], wanted: tuple[int, int], name: str, pattern: str) -> None:
    if tuple(found) != tuple(wanted):
        raise CalibrationError(
            "{}: camera {!r} is calibrated for images of {}x{}, those of the session are "
            "{}x{}; calibrate with the recorded size".format(pattern, name, *found, *wanted)
        )


def _metres(unit: str, square_m: float | None) -> float:
    if unit == "squares":
        if square_m is None or not square_m > 0:
            raise CalibrationError(
                "the rig's unit is squares, but the board's square has no size; name the target "
                "with its square"
            )
        return square_m
    if unit not in UNITS_M:
        raise CalibrationError(
            f"the rig's unit {unit!r} is not known; one of {', '.join(UNITS_M)}, squares"
        )
    return UNITS_M[unit]


def _foreign(found: ForeignRig, name: str, pattern: str) -> ForeignCamera:
    if found.incomplete and name in found.incomplete:
        raise CalibrationError(
            f"{pattern}: camera {name!r} has no {found.incomplete[name]}; calibrate it"
        )
    return found.cameras[_pick(found.cameras, name, pattern)]


def _pick(cameras: Sequence[Camera | ForeignCamera], name: str, pattern: str) -> int:
    """Return which of the cameras is the one called `name`."""
    names = [camera.name for camera in cameras]
    others = [c.other_names if isinstance(c, ForeignCamera) else () for c in cameras]
    for matches in (
        [i for i, found in enumerate(names) if found == name],
        [i for i, found in enumerate(others) if name in found],
        [i for i, found in enumerate(names) if Path(found).stem == name],
        [i for i, found in enumerate(names) if found.split("/")[0] == name],
    ):
        if len(matches) == 1:
            return matches[0]
        if matches:
            poses = [cameras[i].cam_from_world for i in matches]
            if all(np.allclose(pose, poses[0], atol=1e-9) for pose in poses):
                return matches[0]
            raise CalibrationError(f"{pattern}: camera {name!r} stands there {len(matches)} times")
    raise CalibrationError(f"{pattern}: there is no camera {name!r}; it has {', '.join(names)}")


def _names_on_disk(source: Path) -> list[str]:
    """Return the names that the placeholder stands for, of the files there are, as people sort."""
    first = next(index for index, part in enumerate(source.parts) if PLACEHOLDER in part)
    folder = Path(*source.parts[:first])
    pieces = [re.escape(piece) for piece in source.parts[first].split(PLACEHOLDER)]
    again = r"(?:\1)".join(pieces[1:])  # the same name wherever the placeholder stands
    pattern = re.compile(f"{pieces[0]}(.+?){again}")
    names = []
    for entry in folder.iterdir() if folder.is_dir() else ():
        match = pattern.fullmatch(entry.name)
        if match and Path(str(source).replace(PLACEHOLDER, match.group(1))).is_file():
            names.append(match.group(1))
    if not names:
        raise CalibrationError(f"{source}: there is no such file for any camera")
    return sorted(
        names,
        key=lambda name: [int(p) if p.isdigit() else p for p in re.split(r"(\d+)", name)],
    )


def _read(root: Path, pattern: str, names: list[str]) -> ForeignRig | Rig:
    """Read a rig, ours or a foreign one; `names` are the cameras wanted, where they are known."""
    path = root / pattern
    if PLACEHOLDER in pattern:
        return _read_one_a_camera(root, pattern, names)
    if path.is_dir():
        return _read_colmap_folder(path)
    if not path.is_file():
        raise CalibrationError(f"{path}: there is no such rig file")
    return _read_file(path, names)


def _read_one_a_camera(root: Path, pattern: str, names: list[str]) -> ForeignRig:
    cameras = []
    rig: ForeignRig | Rig | None = None
    for name in names:
        path = root / pattern.replace(PLACEHOLDER, name)
        if not path.is_file():
            raise CalibrationError(
                f"{path}: there is no such file; the rig {pattern!r} needs one for camera {name!r}"
            )
        rig = _read_file(path, [name])
        if isinstance(rig, Rig):
            raise CalibrationError(f"{path}: is a rig.json, which holds all cameras; name it alone")
        if len(rig.cameras) != 1:
            raise CalibrationError(
                f"{path}: holds {len(rig.cameras)} cameras, expected one, that of camera {name!r}"
            )
        cameras.append(replace(rig.cameras[0], name=name, other_names=()))
    if not isinstance(rig, ForeignRig):
        raise CalibrationError(f"{pattern}: no camera is asked for; name at least one")
    return replace(rig, cameras=tuple(cameras))


def _read_file(path: Path, names: list[str]) -> ForeignRig | Rig:
    """Read one file, recognised by what stands in it."""
    text = read_text(path)
    start = text.lstrip()
    is_opencv = path.suffix.lower() in opencv.SUFFIXES or start.startswith("%YAML")
    if start.startswith("{"):
        if f'"{FORMAT}"' in start[:2000]:
            return read_rig(path)
        try:
            content = json.loads(text)
        except ValueError as error:
            raise CalibrationError(f"{path}: not JSON ({error})") from error
        if multical.is_multical(content):
            return multical.read_multical(path)
        is_opencv = True
    elif start.startswith("<"):
        is_opencv = True
    elif kalibr.is_chain(text):
        return kalibr.read_chain(path)
    elif caliscope.is_camera_toml(text) or path.suffix.lower() == ".toml":
        return caliscope.read_camera_toml(path)
    return opencv.read_opencv(path, names or [path.stem]) if is_opencv else rows.read_rows(path)


def _read_colmap_folder(folder: Path) -> ForeignRig:
    """Read the cameras of a COLMAP model, binary or text."""
    cameras = tuple(
        ForeignCamera(
            camera.name,
            camera.model,
            camera.params,
            camera.cam_from_world,
            0.0,
            (camera.width_px, camera.height_px),
        )
        for camera in read_colmap_model(folder).cameras
    )
    return ForeignRig("colmap", cameras, pixel_centre=0.5, is_centre_fixed=True)
