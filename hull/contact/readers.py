"""Which library reads which kind of CAD file, and what that kind says of unit and axes.

| kind           | read by                    | unit         | up by default | parts            |
|----------------|----------------------------|--------------|---------------|------------------|
| STL, PLY, OFF  | trimesh                    | none         | z             | one              |
| OBJ            | `hybridve.hull.contact.obj`| none         | z             | each ``o``       |
| glTF, GLB      | `hybridve.hull.contact.gltf`| metre       | y             | each node        |
| COLLADA        | pycollada                  | ``<unit>``   | ``<up_axis>`` | each node        |
| STEP           | cascadio (OpenCASCADE)     | its own      | z             | each product     |
| FBX            | Open3D                     | none         | y             | one              |

Files without a word for it are taken as they stand, z up, as CAD draws. glTF is y up by its
standard, and exporters turn what was z up accordingly; it is turned back, so that the STEP, the
STL and the GLB of one part end up in the same place. Whoever exports z up all the same says
``up = "z"`` in the scene.

Open3D is kept for FBX alone, which nothing else here reads: its assemblies come without names,
their unit is ignored, and their axes arrive turned y up. For all others it was measured against
trimesh 5.2 on 31 files: binary STL and PLY the same to the bit in the same order; text STL and OBJ
rounded to single precision (to 24 nm); OBJ with relative indices or polygons not read at all.
"""

import dataclasses
import io
import re
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.contact.collada import parse_collada
from hybridve.hull.contact.gltf import buffer_names, parse_gltf
from hybridve.hull.contact.obj import mtl_names, parse_obj
from hybridve.hull.contact.part import Contents, Part, join_meshes

#: What each suffix stands for.
FORMATS = {
    ".stl": "STL",
    ".obj": "OBJ",
    ".ply": "PLY",
    ".off": "OFF",
    ".glb": "GLB",
    ".gltf": "glTF",
    ".dae": "COLLADA",
    ".step": "STEP",
    ".stp": "STEP",
    ".fbx": "FBX",
}

#: Kinds that say what their unit is. A STEP file's is not to be overridden: it is part of each
#: number in it, and may differ between its parts.
WITH_UNIT = ("GLB", "glTF", "COLLADA", "STEP")

#: Kinds made of curved surfaces, which become triangles here.
TESSELLATED = ("STEP",)

#: The packages that decide what is read from a kind, besides this one.
_PACKAGES = {
    "STL": ("trimesh",),
    "PLY": ("trimesh",),
    "OFF": ("trimesh",),
    "COLLADA": ("pycollada",),
    "STEP": ("cascadio",),
    "FBX": ("open3d-cpu", "open3d"),  # the same library under two names
}

#: Chords of an arc turn by this at most, whatever the tolerance: a small hole stays round.
ANGLE_RAD = 0.5


def parse(
    content: bytes, kind: str, path: Path, beside: Mapping[str, bytes], tessellation_m: float
) -> Contents:
    """Return what is in a file.

    Parameters
    ----------
    content : bytes
        The file.
    kind : str
        One of the values of `FORMATS`.
    path : Path
        Where it lies; its content is read from there again for an FBX only.
    beside : mapping of str to bytes
        The files it leans on, by the names that `leans_on` gave.
    tessellation_m : float
        How far triangles may be from the surface of a STEP file.

    Raises
    ------
    ValueError
        If the file is damaged, or needs something that cannot be read.
    ImportError
        If the library that reads it is not there.
    """
    if kind == "OBJ":
        return parse_obj(content, beside)
    if kind in ("GLB", "glTF"):
        return parse_gltf(content, beside)
    if kind == "COLLADA":
        return parse_collada(content)
    if kind == "STEP":
        return _parse_step(content, tessellation_m)
    if kind == "FBX":
        return _parse_fbx(path)
    return _parse_with_trimesh(content, kind)


def leans_on(content: bytes, kind: str) -> list[str]:
    """Return the names of the files beside it that decide what is read from a file.

    Raises
    ------
    ValueError
        If the file is damaged.
    """
    if kind == "OBJ":
        return mtl_names(content)
    if kind in ("GLB", "glTF"):
        return buffer_names(content)
    return []


def reader_version(kind: str) -> str | None:
    """Return the library that reads a kind and its version, without importing it.

    None if the same content may be read otherwise another time: an FBX may lean on files that are
    not known here.
    """
    if kind == "FBX":
        return None
    found = []
    for package in _PACKAGES.get(kind, ()):
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            return None
    return " ".join(found)


def _parse_with_trimesh(content: bytes, kind: str) -> Contents:
    import trimesh  # late: half a second

    _refuse_what_is_cut_off(content, kind)
    with warnings.catch_warnings():
        # NumPy's word for a text whose numbers end early; the rest would be left out in silence.
        warnings.simplefilter("error", DeprecationWarning)
        try:
            scene: Any = trimesh.load_scene(
                io.BytesIO(content), file_type=kind.lower(), process=False, validate=False
            )
        except Exception as error:  # damage has many names
            raise ValueError(f"{type(error).__name__}: {error}".replace("\n", " ")) from error
    meshes = [
        (np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int32).reshape(-1, 3))
        for mesh in scene.geometry.values()
        if hasattr(mesh, "faces")  # the rest are points and curves
    ]
    return Contents((Part("", *join_meshes(meshes)),) if meshes else ())


def _refuse_what_is_cut_off(content: bytes, kind: str) -> None:
    """Refuse files that hold less than they promise; trimesh takes what is there, or nothing."""
    if kind == "STL":
        if b"\0" in content[:84] and len(content) >= 84:  # not text
            expected = 84 + 50 * int.from_bytes(content[80:84], "little")
            if len(content) != expected:
                raise ValueError(f"{len(content)} bytes, where its header promises {expected}")
        return
    lines = [
        line for line in (raw.partition(b"#")[0].split() for raw in content.splitlines()) if line
    ]
    if kind == "PLY":
        if [b"format", b"ascii"] not in [line[:2] for line in lines[:2]]:
            return  # of numbers that are not text, trimesh knows how many there must be
        head = next((n for n, line in enumerate(lines) if line == [b"end_header"]), 0)
        promised = [line[2] for line in lines[:head] if line[0] == b"element" and len(line) == 3]
    else:
        head = 0 if lines and len(lines[0]) > 1 else 1  # the numbers may stand behind the word OFF
        promised = [word for word in lines[head] if word.isdigit()][:2] if len(lines) > head else []
    there, expected = len(lines) - head - 1, sum(int(number) for number in promised)
    if there < expected:
        raise ValueError(f"the file is cut off: {there} of {expected} lines are there")


def _parse_fbx(path: Path) -> Contents:
    import open3d  # late: half a second

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        loaded = open3d.io.read_triangle_mesh(path)
    vertices: NDArray[np.float64] = np.array(loaded.vertices, np.float64).reshape(-1, 3)
    faces: NDArray[np.int32] = np.array(loaded.triangles, np.int32).reshape(-1, 3)
    return Contents((Part("", vertices, faces),) if len(faces) else (), up="y")


#: Runs by itself, because OpenCASCADE talks on stdout, where our results go, and because a damaged
#: file may end the process that reads it. cascadio would import trimesh, for nothing we need.
_CONVERT = """
import sys
sys.modules["trimesh"] = None
import cascadio
source, target, linear_mm, angle_rad = sys.argv[1:]
cascadio.step_to_glb(source, target, float(linear_mm), float(angle_rad), False, True, False)
"""


def _parse_step(content: bytes, tessellation_m: float) -> Contents:
    """Return the parts of a STEP file in metres, named after their products, not their places."""
    version("cascadio")  # raises here, where the package can be named, if it is not there
    with tempfile.TemporaryDirectory(prefix="hybridve-") as folder:
        source, target = Path(folder, "part.step"), Path(folder, "part.glb")
        source.write_bytes(content)
        arguments = [str(source), str(target), repr(tessellation_m * 1000.0), repr(ANGLE_RAD)]
        done = subprocess.run(
            [sys.executable, "-P", "-c", _CONVERT, *arguments],
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
        )
        converted = target.read_bytes() if target.is_file() else b""
    if done.returncode != 0 or not converted:
        raise ValueError(f"OpenCASCADE says: {_complaint(done.stdout + done.stderr)}")
    contents = parse_gltf(converted, {}, name_by_mesh=True)
    # Colours come as materials without names, which the conversion numbers.
    parts = tuple(dataclasses.replace(part, material="") for part in contents.parts)
    return Contents(parts, "of the file", 1.0, "z")


def _complaint(talk: str) -> str:
    """Return what OpenCASCADE found wrong, in one line."""
    lines = [re.sub(r"\x1b\[[0-9;]*m|\*{2,}|\s+", " ", line).strip() for line in talk.splitlines()]
    errors = [line for line in lines if "ERR" in line] or [line for line in lines if line]
    return re.sub(r"^ERR\s*", "", errors[0]) if errors else "it gives no reason; export it again"
