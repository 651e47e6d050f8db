"""Rigs on disk: our rig.json, and the files of other programs, read and written.

A foreign file is recognised by what it holds, not by its name. What it does not say (its unit,
where its pixel centres lie, the images' size) is given by the caller, never guessed.
"""

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hybridve.calib.bounded import parse_json
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.files import nearly
from hybridve.calib.formats import (
    caliscope,
    easymocap,
    kalibr,
    mccalib,
    multical,
    nerf,
    opencv,
    rows,
)
from hybridve.calib.formats.colmap import read_colmap_model
from hybridve.calib.formats.foreign import (
    ForeignCamera,
    ForeignRig,
    UnknownRigError,
    principal_point_index,
    read_text,
)
from hybridve.calib.formats.rig_export import PLACEHOLDER, UNITS_M, metres_of
from hybridve.calib.formats.rig_json import FORMAT, check_focal_lengths, read_rig
from hybridve.calib.opencv_storage import NotOpencvError
from hybridve.calib.pose import nearest_to_axes
from hybridve.calib.provenance import MadeElsewhere
from hybridve.calib.record import CalibrationRecord
from hybridve.calib.rig import Rig, RigCovariance

_log = logging.getLogger(__name__)

#: What is read, in words, for whoever comes with another file.
_READ = (
    "rig.json, a COLMAP model (its folder), OpenCV's XML, YAML and JSON, rows of matrices, and the "
    "files of Caliscope, aniposelib, Kalibr, multical, EasyMocap, MC-Calib and NeRF "
    "(transforms.json)"
)

#: Condition number from which on optical axes are called parallel: all within some 6 degrees.
_PARALLEL = 100.0


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
    factor_m = None if unit is None else metres_of(unit, square_m)
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
    square_m: float | None = None,
    pixel_centre: float | None = None,
    image_sizes: Mapping[str, tuple[int, int]] | tuple[int, int] | None = None,
    names: Sequence[str] = (),
) -> Rig:
    """Read a rig in any of the formats known here, recognised by its content.

    Parameters
    ----------
    source : Path
        A file, the folder of a COLMAP model, or, with the placeholder ``{camera}``, one file a
        camera.
    unit : str or None
        See `import_rig`.
    square_m : float or None
        See `import_rig`.
    pixel_centre : float or None
        See `import_rig`.
    image_sizes : mapping of str to (width, height), or (width, height), or None
        For files that do not say it: by camera, or of all.
    names : sequence of str
        The cameras wanted, in this order; none: all.

    Raises
    ------
    CalibrationError
        Saying which file or camera, what was found and what was expected.
    """
    pattern = str(source)
    factor_m = None if unit is None else metres_of(unit, square_m)
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
        given = image_sizes.get(name) if isinstance(image_sizes, Mapping) else image_sizes
        size_px = _foreign(found, name, pattern).size_px or given
        if size_px is None:
            raise CalibrationError(
                f"{pattern}: does not say the image size of camera {name!r}; give it, width x "
                "height in pixels (--image-size)"
            )
        sizes[name] = size_px
    return _to_rig(found, pattern, unit, factor_m, pixel_centre, sizes)


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
        factor_m = metres_of(unit, None)
    elif found.unit is not None and factor_m != metres_of(found.unit, None):
        _log.warning(
            "%s: %s has its lengths in %s; they are taken in %s, as was asked",
            pattern,
            found.format,
            found.unit,
            unit,
        )
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
            check_focal_lengths(camera)
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
        if (path / easymocap.INTRINSICS).is_file():
            return easymocap.read_easymocap(path)
        return _read_colmap_folder(path)
    if not path.is_file():
        raise CalibrationError(f"{path}: there is no such rig file{nearly(path)}")
    return _read_known(path, names)


def _read_known(path: Path, names: list[str]) -> ForeignRig | Rig:
    """Read one file, and say of one that is not known which are."""
    try:
        return _read_file(path, names)
    except (UnknownRigError, NotOpencvError) as error:
        raise CalibrationError(f"{error}; a rig can be {_READ}") from error


def _read_one_a_camera(root: Path, pattern: str, names: list[str]) -> ForeignRig:
    cameras = []
    rig: ForeignRig | Rig | None = None
    for name in names:
        path = root / pattern.replace(PLACEHOLDER, name)
        if not path.is_file():
            raise CalibrationError(
                f"{path}: there is no such file; the rig {pattern!r} needs one for camera {name!r}"
            )
        rig = _read_known(path, [name])
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
            content = parse_json(text)
        except ValueError as error:
            raise CalibrationError(f"{path}: not JSON ({error})") from error
        if multical.is_multical(content):
            return multical.read_multical(path)
        if nerf.is_transforms(content):
            return nerf.read_transforms(path)
        is_opencv = True
    elif start.startswith("<"):
        is_opencv = True
    elif kalibr.is_chain(text):
        return kalibr.read_chain(path)
    elif caliscope.is_camera_toml(text) or path.suffix.lower() == ".toml":
        return caliscope.read_camera_toml(path)
    elif easymocap.is_easymocap(text):
        return easymocap.read_easymocap(path)
    elif mccalib.is_mccalib(text):
        return mccalib.read_mccalib(path)
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
