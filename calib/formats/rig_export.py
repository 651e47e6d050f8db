"""Rigs written for other programs, and what of them these cannot say."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats import caliscope, colmap, kalibr, multical, opencv, rows
from hybridve.calib.formats.approximate import approximate
from hybridve.calib.formats.rig_json import rig_json_text, write_texts
from hybridve.calib.rig import Rig

#: Metres a unit of length; "squares" are those of the board.
UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}

#: Stands for a camera's name in the path of a rig that is one file a camera.
PLACEHOLDER = "{camera}"

#: OpenCV's models as targets of an approximation, with so many free parameters.
_OPENCV_5 = (("FULL_OPENCV", 9), ("OPENCV_FISHEYE", 8))
_OPENCV_8 = (("FULL_OPENCV", 12), ("OPENCV_FISHEYE", 8))
_UNSKEWED = (("PINHOLE", 4),)
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


_TARGETS = {
    "json": _Target(lambda _: None, unit="m"),
    "colmap": _Target(colmap.refusal),
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


def output_files(rig: Rig, to: str, target: Path) -> list[Path]:
    """Return the files that `export_rig` writes.

    Raises
    ------
    CalibrationError
        If the format needs another kind of path.
    """
    if to == "colmap":
        return [target / name for name in colmap.COLMAP_FILES]
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
    unit_m = metres_of(unit, None)
    if known.unit not in {None, unit}:
        raise CalibrationError(f"{target}: {to} is in {known.unit} by definition, not in {unit}")
    files = output_files(rig, to, target)
    cameras, approximated = [], {}
    for camera in rig.cameras:
        why = known.refusal(camera)
        if why is not None:
            reason = f"{target}: {to} cannot hold camera {camera.name!r}: it has {why}"
            # Only another lens can be put in a lens's place, and no skew in a skew's.
            substitutes = _UNSKEWED if camera.skew_px else known.substitutes
            if not substitutes or not (camera.has_distortion or camera.skew_px):
                raise CalibrationError(f"{reason}; --to json holds every camera")
            if not approximate_lenses:
                raise CalibrationError(
                    f"{reason}; --to json holds every camera, and --approximate takes the nearest "
                    "lens that can be held"
                )
            camera, error_px = approximate(camera, substitutes)
            if (why := known.refusal(camera)) is not None:
                raise CalibrationError(
                    f"{target}: {to} cannot hold camera {camera.name!r}: it has {why}"
                )
            approximated[camera.name] = {"model": camera.model, "error_px": error_px}
        cameras.append(camera)
    if to == "colmap":
        moved = [
            replace(c, cam_from_world=c.cam_from_world * [1.0, 1.0, 1.0, 1.0 / unit_m])
            for c in cameras
        ]
        colmap.write_colmap_model(target, Rig(tuple(moved)))
    else:
        texts: dict[str, Callable[[], list[str]]] = {
            "json": lambda: [rig_json_text(rig)],
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
        write_texts(dict(zip(files, texts[to](), strict=True)))
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


def metres_of(unit: str, square_m: float | None) -> float:
    """Return how long a unit is; squares are those of the board."""
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
