"""Caliscope's camera_array.toml and aniposelib's calibration.toml.

Both hold OpenCV's numbers (pixel centre at 0) in one section a camera: ``size`` (width, height),
``matrix`` (3x3), ``distortions`` (k1 k2 p1 p2 k3; k1..k4 of a fisheye), ``rotation`` (Rodrigues,
world to camera; old Caliscope files: 3x3) and ``translation``, and ``fisheye = true`` where the
lens is one. Caliscope names its sections ``[cameras.N]``, with ``cam_id = N`` (``[cam_N]`` and
``port`` in its older config.toml), and is in metres. aniposelib names them ``[cam_N]`` with a
``name``, beside ``[metadata]``, in the unit of its board, which the file does not say; what is
written here says it in the metadata. Caliscope knows cameras by number; it passes over the ``name``
that is written here too.

References
----------
https://github.com/mprib/caliscope, src/caliscope/cameras/camera_array.py (to_toml, from_toml,
to_aniposelib_toml); https://github.com/lambdaloop/aniposelib, aniposelib/cameras.py
(Camera.get_dict, CameraGroup.dump).
"""

import json
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hybridve.calib.bounded import DEEPEST
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats import opencv_lens
from hybridve.calib.formats.foreign import (
    ForeignCamera,
    ForeignRig,
    as_size,
    read_text,
    translation_in,
)
from hybridve.calib.pose import rotation_vector

#: Coefficients of the polynomial lens that both programs unpack.
_N_COEFFICIENTS = 5

_SECTION = re.compile(r"^\s*\[\s*(cam_|cameras\.)", re.MULTILINE)

#: What every calibrated camera has.
_NEEDED = ("size", "matrix", "distortions", "rotation", "translation")


def is_camera_toml(text: str) -> bool:
    """Whether a text has sections as these files have."""
    return _SECTION.search(text) is not None


def refusal(camera: Camera) -> str | None:
    """Return why these files cannot hold a camera, or None."""
    return opencv_lens.refusal(camera, _N_COEFFICIENTS)


def camera_ids(names: Sequence[str]) -> list[int]:
    """Return the numbers that Caliscope knows cameras by: those that end their names, if distinct.

    Else 0, 1, 2, ... in order.
    """
    ends = [re.search(r"(?:^|\D)(\d+)$", name) for name in names]
    ids = [int(end.group(1)) for end in ends if end is not None]
    return ids if len(set(ids)) == len(names) else list(range(len(names)))


def write_caliscope(cameras: Sequence[Camera]) -> str:
    """Return the text of a camera_array.toml, in metres."""
    sections = []
    for number, camera in zip(camera_ids([c.name for c in cameras]), cameras, strict=True):
        lines = [f"[cameras.{number}]", f"cam_id = {number}", f"name = {_quoted(camera.name)}"]
        sections.append("\n".join([*lines, *_lines(camera, 1.0), f"fisheye = {_fisheye(camera)}"]))
    return "\n\n".join(sections) + "\n"


def write_aniposelib(cameras: Sequence[Camera], unit: str, unit_m: float) -> str:
    """Return the text of a calibration.toml as aniposelib's CameraGroup.load reads it."""
    sections = []
    for number, camera in enumerate(cameras):
        lines = [f"[cam_{number}]", f"name = {_quoted(camera.name)}", *_lines(camera, unit_m)]
        if _fisheye(camera) == "true":
            lines.append("fisheye = true")
        sections.append("\n".join(lines))
    sections.append(f'[metadata]\nadjusted = false\nerror = 0.0\nunit = "{unit}"')
    return "\n\n".join(sections) + "\n"


def _fisheye(camera: Camera) -> str:
    return "true" if opencv_lens.opencv_lens(camera).is_fisheye else "false"


def _lines(camera: Camera, unit_m: float) -> list[str]:
    lens = opencv_lens.opencv_lens(camera)
    rotation = rotation_vector(camera.cam_from_world[:, :3])
    return [
        f"size = [{camera.width_px}, {camera.height_px}]",
        f"matrix = {lens.matrix.tolist()}",
        f"distortions = {lens.distortion[:_N_COEFFICIENTS].tolist()}",
        f"rotation = {rotation.tolist()}",
        f"translation = {translation_in(camera, unit_m)}",
    ]


def _quoted(text: str) -> str:
    """Return a TOML basic string: JSON's, but for the one control sign that JSON lets stand."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def read_camera_toml(path: Path) -> ForeignRig:
    """Read either file.

    Raises
    ------
    CalibrationError
        If it is not TOML, has no section of a camera, or one is damaged.
    """
    try:
        content = tomllib.loads(_short_keys(read_text(path), path))
    except tomllib.TOMLDecodeError as error:
        raise CalibrationError(f"{path}: not TOML ({error})") from error
    nested = content.get("cameras")
    is_caliscope = isinstance(nested, dict)
    sections: dict[str, Any] = (
        {f"cam_{number}": section for number, section in nested.items()}
        if isinstance(nested, dict)
        else {key: value for key, value in content.items() if key.startswith("cam_")}
    )
    sections = {key: value for key, value in sections.items() if isinstance(value, dict)}
    if not sections:
        raise CalibrationError(
            f"{path}: holds no camera; expected sections [cam_0], ... (aniposelib) or "
            "[cameras.0], ... (Caliscope)"
        )
    # The older Caliscope wrote a port instead of a name.
    is_caliscope = is_caliscope or all("port" in section for section in sections.values())
    cameras: list[ForeignCamera] = []
    incomplete = {}
    for key, section in sections.items():
        given = {name: value for name, value in section.items() if value != "null"}
        name = str(given.get("name", key))
        missing = [what for what in _NEEDED if what not in given]
        if missing:
            incomplete[name] = ", ".join(missing)
            continue
        where = f"{path}, [{key}]"
        number = key.removeprefix("cam_")
        cameras.append(
            opencv_lens.opencv_camera(
                name,
                given["matrix"],
                given["distortions"],
                given["rotation"],
                given["translation"],
                is_fisheye=given.get("fisheye") is True,
                size_px=as_size(given["size"], where),
                where=where,
                other_names=(key, f"cam{number}", number),
            )
        )
    metadata = content.get("metadata")
    said = metadata.get("unit") if isinstance(metadata, dict) else None
    return ForeignRig(
        "caliscope" if is_caliscope else "aniposelib",
        tuple(cameras),
        pixel_centre=0.0,
        is_centre_fixed=True,
        unit="m" if is_caliscope else said if isinstance(said, str) else None,
        incomplete=incomplete,
    )


def _short_keys(text: str, path: Path) -> str:
    """Return the text; a key in very many parts takes the parser the square of their number."""
    if any(line.partition("=")[0].count(".") > DEEPEST for line in text.splitlines()):
        raise CalibrationError(f"{path}: a key has more than {DEEPEST} parts, so deep is no rig")
    return text
