"""Rigs on disk: our rig.json, and rigs that were calibrated elsewhere.

Taken are rig.json, rows of 3x4 matrices, Middlebury's ``*_par.txt``, folders with a COLMAP model,
and OpenCV's XML, YAML or JSON, one file a camera. What a foreign file does not say (its unit,
where its pixel centres lie, the images' size) is given by the caller, never guessed.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.colmap_io import read_colmap_model
from hybridve.calib.errors import CalibrationError
from hybridve.calib.pose import Pose
from hybridve.calib.rig import Mount, Rig, RigCovariance

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

#: COLMAP's numbers for its camera models (COLMAP, sensor/models.h).
_COLMAP_MODEL_IDS = {
    0: "SIMPLE_PINHOLE",
    1: "PINHOLE",
    2: "SIMPLE_RADIAL",
    3: "RADIAL",
    4: "OPENCV",
    5: "OPENCV_FISHEYE",
    6: "FULL_OPENCV",
    7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
    12: "SIMPLE_DIVISION",
    13: "DIVISION",
    14: "SIMPLE_FISHEYE",
    15: "FISHEYE",
    16: "EUCM",
}

#: How files of OpenCV's kind spell what they hold, in lower case without "_", "-" and blanks.
_OPENCV_KEYS = {
    "matrix": ("cameramatrix", "mtx", "k", "intrinsicmatrix", "intrinsics", "intrinsic", "m"),
    "distortion": (
        "distortioncoefficients",
        "distortioncoeffs",
        "distcoeffs",
        "distortion",
        "dist",
        "d",
    ),
    "rotation": ("rvec", "rotation", "rotationvalues", "rotationmatrix", "rotationvector", "r"),
    "translation": ("tvec", "translation", "translationvalues", "translationvector", "t"),
    "pose": ("camfromworld", "extrinsicmatrix", "extrinsics", "extrinsic", "rt"),
    "model": ("distortionmodel", "cameramodel", "model"),
    "width": ("imagewidth", "width"),
    "height": ("imageheight", "height"),
}

#: A rotation with this error (largest entry of RR'-I) was rounded; beyond it, it is none.
_ROUNDED_ROTATION = 1e-3


#: A skew below this comes from the decomposition's own rounding.
_NO_SKEW_PX = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class _Foreign:
    """A camera as a foreign file has it: its own unit, its own pixel centre, perhaps no size."""

    name: str
    model: str
    params: NDArray[np.float64]
    cam_from_world: Pose
    skew_px: float = 0.0
    size_px: tuple[int, int] | None = None


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
        "provenance": rig.provenance,
    }


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
    text = json.dumps(rig_to_dict(rig), indent=1, allow_nan=False)
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_text(text + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written ({error.strerror})") from error


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
        return Rig(
            cameras,
            dict(content.get("provenance", {})),
            _covariance_from_dict(content["covariance"]) if "covariance" in content else None,
            {
                str(name): Mount(
                    np.array(entry["cam_from_tracker"], dtype=np.float64),
                    np.array(entry["world_from_tracking"], dtype=np.float64),
                )
                for name, entry in content.get("mounts", {}).items()
            },
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
    unit: str,
    pixel_centre: float,
    image_sizes: dict[str, tuple[int, int]],
    square_m: float | None,
) -> Rig:
    """Read a rig that was calibrated elsewhere.

    Parameters
    ----------
    root : Path
        The folder that `pattern` starts from.
    pattern : str
        A file for all cameras, the folder of a COLMAP model, or, with the placeholder
        ``{camera}``, one file a camera; then the name inside a file does not count.
    unit : str
        "m", "cm", "mm", "in", "ft" or "squares": that of the file's translations. Of no
        consequence for rig.json, which is in metres.
    pixel_centre : float
        Where the file has the centre of the top-left pixel: 0.5 (COLMAP) or 0 (OpenCV).
    image_sizes : dict of str to (width, height)
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
    if pixel_centre not in (0.0, 0.5):
        raise CalibrationError(
            f"the rig's pixel centre is {pixel_centre!r}; expected 0.5 (COLMAP) or 0 (OpenCV)"
        )
    factor_m = _metres(unit, square_m)
    if not image_sizes:
        raise CalibrationError(f"{pattern}: no camera is asked for; name at least one")
    path = root / pattern
    if path.suffix == ".json" and "{camera}" not in pattern and _is_rig_json(path):
        return _choose(read_rig(path), image_sizes, pattern)
    found = _read_foreign(root, pattern, list(image_sizes))
    cameras = []
    for name, size_px in image_sizes.items():
        foreign = found[_pick([(c.name, c.cam_from_world) for c in found], name, pattern)]
        if foreign.size_px is not None:
            _check_size(foreign.size_px, size_px, name, pattern)
        params = foreign.params.copy()
        start = 1 if _has_one_focal_length(foreign.model) else 2
        params[start : start + 2] += 0.5 - pixel_centre
        pose = foreign.cam_from_world.copy()
        pose[:, 3] *= factor_m
        try:
            cameras.append(
                Camera(
                    name,
                    foreign.model,
                    int(size_px[0]),
                    int(size_px[1]),
                    params,
                    pose,
                    foreign.skew_px,
                )
            )
        except CalibrationError as error:
            raise CalibrationError(f"{pattern}: {error}") from error
    provenance = {
        "method": "imported",
        "file": pattern,
        "unit": unit,
        "pixel_centre": pixel_centre,
    } | ({"square_m": square_m} if unit == "squares" else {})
    return Rig(tuple(cameras), provenance)


def _choose(rig: Rig, image_sizes: dict[str, tuple[int, int]], pattern: str) -> Rig:
    """Return the cameras asked for of a rig of ours, under the names asked for."""
    known = [(camera.name, camera.cam_from_world) for camera in rig.cameras]
    names = {rig.cameras[_pick(known, name, pattern)].name: name for name in image_sizes}
    rig = rig.only(list(names))
    for camera in rig.cameras:
        _check_size(
            (camera.width_px, camera.height_px),
            image_sizes[names[camera.name]],
            names[camera.name],
            pattern,
        )
    covariance = rig.covariance
    if covariance is not None:
        parts = [label.rpartition(" ") for label in covariance.labels]
        labels = tuple(f"{names[owner]} {parameter}" for owner, _, parameter in parts)
        covariance = RigCovariance(labels, covariance.matrix)
    return Rig(
        tuple(replace(camera, name=names[camera.name]) for camera in rig.cameras),
        rig.provenance,
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


def _has_one_focal_length(model: str) -> bool:
    return model.startswith("SIMPLE_") or model in {"RADIAL", "RADIAL_FISHEYE"}


def _is_rig_json(path: Path) -> bool:
    if not path.is_file():
        raise CalibrationError(f"{path}: there is no such rig file")
    return f'"{FORMAT}"' in path.read_text(encoding="utf-8", errors="replace")[:2000]


def _pick(known: Sequence[tuple[str, Pose]], name: str, pattern: str) -> int:
    """Return which of the cameras (name, cam_from_world) is the one called `name`."""
    for matches in (
        [i for i, (found, _) in enumerate(known) if found == name],
        [i for i, (found, _) in enumerate(known) if Path(found).stem == name],
        [i for i, (found, _) in enumerate(known) if found.split("/")[0] == name],
    ):
        if len(matches) == 1:
            return matches[0]
        if matches:
            poses = [known[i][1] for i in matches]
            if all(np.allclose(pose, poses[0], atol=1e-9) for pose in poses):
                return matches[0]
            raise CalibrationError(f"{pattern}: camera {name!r} stands there {len(matches)} times")
    names = ", ".join(found for found, _ in known)
    raise CalibrationError(f"{pattern}: there is no camera {name!r}; it has {names}")


def _read_foreign(root: Path, pattern: str, names: list[str]) -> list[_Foreign]:
    if "{camera}" in pattern:
        cameras = []
        for name in names:
            path = root / pattern.replace("{camera}", name)
            if not path.is_file():
                raise CalibrationError(
                    f"{path}: there is no such file; the rig {pattern!r} needs one for "
                    f"camera {name!r}"
                )
            found = _read_file(path, [name])
            if len(found) != 1:
                raise CalibrationError(
                    f"{path}: holds {len(found)} cameras, expected one, that of camera {name!r}"
                )
            cameras.append(replace(found[0], name=name))
        return cameras
    path = root / pattern
    if path.is_dir():
        return _read_colmap_folder(path)
    if not path.is_file():
        raise CalibrationError(f"{path}: there is no such rig file")
    return _read_file(path, names)


def _read_file(path: Path, names: list[str]) -> list[_Foreign]:
    if path.suffix.lower() in {".xml", ".yml", ".yaml", ".json"}:
        return _read_opencv(path, names)
    return _read_rows(path)


# --- Rows of numbers ------------------------------------------------------------------------


def _read_rows(path: Path) -> list[_Foreign]:
    """Read lines ``name p11 ... p34`` or ``name K(9) R(9) t(3)``, by commas or blanks."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: cannot be read as text ({error})") from error
    cameras: list[_Foreign] = []
    for number, line in enumerate(lines, start=1):
        words = line.replace(",", " ").replace(";", " ").split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) == 1 and words[0].isdigit() and not cameras:
            continue  # Middlebury's count of the lines that follow
        try:
            numbers = np.array([float(word) for word in words[1:]])
        except ValueError:
            if not cameras and number == 1:
                continue  # a header
            raise CalibrationError(
                f"{path}, line {number}: not a name and numbers: {line.strip()[:60]!r}"
            ) from None
        if len(numbers) not in (12, 21) or not np.isfinite(numbers).all():
            raise CalibrationError(
                f"{path}, line {number}: {len(numbers)} numbers after the name {words[0]!r}, "
                "expected 12 (a 3x4 matrix) or 21 (K, R and t)"
            )
        where = f"{path}, line {number}"
        if len(numbers) == 12:
            img_from_world = numbers.reshape(3, 4)
        else:
            rotation = _rotation(numbers[9:18].reshape(3, 3), where)
            matrix = numbers[:9].reshape(3, 3)
            img_from_world = matrix @ np.column_stack([rotation, numbers[18:]])
        cameras.append(_decompose(words[0], img_from_world, where))
    if not cameras:
        raise CalibrationError(
            f"{path}: holds no camera; expected lines of a name and 12 numbers (a 3x4 matrix), "
            "or 21 (K, R and t)"
        )
    return cameras


def _decompose(name: str, img_from_world: NDArray[np.float64], where: str) -> _Foreign:
    """Split a projection matrix (3, 4) into lens and pose without loss.

    A projection matrix is known up to a factor, which may be negative. It is chosen so that
    depths are positive in front of the camera: its left part has a positive determinant if the
    image is not mirrored.

    References
    ----------
    Hartley and Zisserman, *Multiple View Geometry*, 2nd ed., 2003, sections 6.2.3 and 6.2.4.
    """
    left = img_from_world[:, :3]
    scale = float(np.linalg.norm(left[2]))
    determinant = float(np.linalg.det(left / max(scale, 1e-300)))
    if scale == 0 or abs(determinant) < 1e-9 * float(np.abs(left).max() / scale) ** 2:
        raise CalibrationError(
            f"{where}: the matrix of camera {name!r} is singular; expected K [R | t]"
        )
    sign = np.sign(determinant)
    # RQ from QR: reverse the rows, transpose.
    flip = np.eye(3)[::-1]
    q, r = np.linalg.qr((flip @ (sign * left)).T)
    upper, rotation = flip @ r.T @ flip, flip @ q.T
    signs = np.diag(np.where(np.diag(upper) < 0, -1.0, 1.0))
    upper, rotation = upper @ signs, signs @ rotation
    translation = np.linalg.solve(upper, sign * img_from_world[:, 3])
    matrix = upper / upper[2, 2]
    skew_px = float(matrix[0, 1])
    if abs(skew_px) < _NO_SKEW_PX:
        skew_px = 0.0
    return _Foreign(
        name,
        "PINHOLE",
        np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]),
        np.column_stack([rotation, translation]),
        skew_px,
    )


def _rotation(matrix: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """Return a (3, 3) rotation freed of rounding."""
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if not error < _ROUNDED_ROTATION or np.linalg.det(matrix) < 0:
        raise CalibrationError(
            f"{where}: the rotation is none (R R' is off by {error:.0e}); check the order of its "
            "entries"
        )
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ vt)


# --- OpenCV ---------------------------------------------------------------------------------


def _read_opencv(path: Path, names: list[str]) -> list[_Foreign]:
    entries = _opencv_entries(path)
    if "m1" in entries and "m2" in entries:
        return _stereo_pair(path, entries, names)
    if len(names) != 1:
        raise CalibrationError(
            f"{path}: an OpenCV file holds one camera, expected {len(names)}; write the rig as "
            "one file a camera, with {camera} in its path"
        )

    def find(what: str) -> Any:
        return next((entries[key] for key in _OPENCV_KEYS[what] if key in entries), None)

    def need(what: str) -> NDArray[np.float64]:
        value = find(what)
        if not isinstance(value, np.ndarray):
            raise CalibrationError(
                f"{path}: holds no {what} (known keys: {', '.join(_OPENCV_KEYS[what])}); it has "
                f"{', '.join(entries) or 'nothing'}"
            )
        return value

    pose = find("pose")
    if isinstance(pose, np.ndarray) and pose.shape in ((3, 4), (4, 4)):
        rotation, translation = pose[:3, :3], pose[:3, 3]
    else:
        rotation, translation = need("rotation"), need("translation").ravel()
    distortion = find("distortion")
    model = find("model")
    width, height = find("width"), find("height")
    size_px = None
    if isinstance(width, float) and isinstance(height, float):
        size_px = (int(width), int(height))
    return [
        _opencv_camera(
            names[0],
            need("matrix"),
            distortion if isinstance(distortion, np.ndarray) else np.zeros(0),
            rotation,
            translation,
            isinstance(model, str) and model.lower() in {"fisheye", "equidistant"},
            size_px,
            str(path),
        )
    ]


def _opencv_entries(path: Path) -> dict[str, Any]:
    """Return the matrices, numbers and texts of an OpenCV file, by simplified key."""
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        is_open = storage.isOpened()
    except (cv2.error, SystemError):
        is_open = False
    if not is_open:
        raise CalibrationError(
            f"{path}: not an OpenCV file; expected XML, YAML or JSON as cv::FileStorage writes it"
        )
    try:
        root = storage.root()
        entries: dict[str, Any] = {}
        for key in root.keys():  # noqa: SIM118 - not a dict
            simple = key.lower().replace("_", "").replace("-", "").replace(" ", "")
            entries[simple] = _opencv_value(root.getNode(key))
        return entries
    finally:
        storage.release()


def _opencv_value(node: Any) -> Any:
    if node.isInt() or node.isReal():
        return float(node.real())
    if node.isString():
        return node.string()
    if node.isSeq():
        values = [_opencv_value(node.at(index)) for index in range(node.size())]
        try:
            return np.array(values, dtype=np.float64)
        except (TypeError, ValueError):
            return None
    if node.isMap():
        try:
            matrix = node.mat()
        except cv2.error:
            matrix = None
        if matrix is not None:
            return np.asarray(matrix, dtype=np.float64)
        data = node.getNode("data")  # ROS writes rows, cols and data
        if data.isSeq():
            values = _opencv_value(data)
            rows, columns = node.getNode("rows"), node.getNode("cols")
            if isinstance(values, np.ndarray) and rows.isInt() and columns.isInt():
                return values.reshape(int(rows.real()), int(columns.real()))
    return None


def _opencv_camera(
    name: str,
    matrix: NDArray[np.float64],
    distortion: NDArray[np.float64],
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
    is_fisheye: bool,
    size_px: tuple[int, int] | None,
    where: str,
) -> _Foreign:
    if matrix.shape != (3, 3) or translation.shape != (3,):
        raise CalibrationError(
            f"{where}: camera matrix of shape {matrix.shape} and translation of {translation.shape}"
            ", expected (3, 3) and (3,)"
        )
    if rotation.size == 3:
        rotation = np.asarray(cv2.Rodrigues(rotation.astype(np.float64).ravel())[0])
    if rotation.shape != (3, 3):
        raise CalibrationError(
            f"{where}: rotation of shape {rotation.shape}, expected 3 numbers or (3, 3)"
        )
    pose = np.column_stack([_rotation(rotation, where), translation])
    matrix = matrix / matrix[2, 2]
    lens = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
    coefficients = np.zeros(14)
    given = distortion.ravel()
    if len(given) > 14:
        raise CalibrationError(f"{where}: {len(given)} distortion coefficients, expected up to 14")
    coefficients[: len(given)] = given
    k1, k2, p1, p2, k3 = coefficients[:5]
    if is_fisheye:
        return _Foreign(
            name, "OPENCV_FISHEYE", np.array([*lens, *coefficients[:4]]), pose, 0.0, size_px
        )
    if coefficients[8:].any():
        raise CalibrationError(
            f"{where}: thin prism and tilt distortion ({len(given)} coefficients) is no COLMAP "
            "model; calibrate without it"
        )
    if coefficients[4:8].any():
        params = np.array([*lens, k1, k2, p1, p2, k3, *coefficients[5:8]])
        return _Foreign(name, "FULL_OPENCV", params, pose, 0.0, size_px)
    if coefficients[:4].any():
        return _Foreign(name, "OPENCV", np.array([*lens, k1, k2, p1, p2]), pose, 0.0, size_px)
    return _Foreign(name, "PINHOLE", np.array(lens), pose, float(matrix[0, 1]), size_px)


def _stereo_pair(path: Path, entries: dict[str, Any], names: list[str]) -> list[_Foreign]:
    """Read M1, D1, M2, D2, with R and T here or in ``extrinsics.*`` beside (OpenCV's sample)."""
    if len(names) != 2:
        raise CalibrationError(f"{path}: holds a stereo pair, expected {len(names)} cameras")
    beside = path.with_name("extrinsics" + path.suffix)
    if "r" not in entries and beside.is_file():
        entries = _opencv_entries(beside) | entries
    if not all(isinstance(entries.get(key), np.ndarray) for key in ("d1", "d2", "r", "t")):
        raise CalibrationError(
            f"{path}: a stereo pair needs M1, D1, M2, D2, and R and T here or in {beside.name}"
        )
    poses = [(np.eye(3), np.zeros(3)), (entries["r"], entries["t"].ravel())]
    return [
        _opencv_camera(
            name,
            entries[f"m{number}"],
            entries[f"d{number}"],
            rotation,
            translation,
            False,
            None,
            str(path),
        )
        for number, (name, (rotation, translation)) in enumerate(
            zip(names, poses, strict=True), start=1
        )
    ]


# --- COLMAP ---------------------------------------------------------------------------------


def _read_colmap_folder(folder: Path) -> list[_Foreign]:
    """Read the cameras of a COLMAP model, binary or text."""
    return [
        _Foreign(
            camera.name,
            camera.model,
            camera.params,
            camera.cam_from_world,
            0.0,
            (camera.width_px, camera.height_px),
        )
        for camera in read_colmap_model(folder).cameras
    ]
