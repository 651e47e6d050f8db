"""Which reader reads which kind of CAD file, and what that kind says of unit and axes.

| kind           | read by                         | unit         | up by default | parts        |
|----------------|---------------------------------|--------------|---------------|--------------|
| STL, PLY, OFF  | `stl`, `ply`, `off` beside here | none         | z             | one          |
| OBJ            | `obj`                           | none         | z             | each ``o``   |
| glTF, GLB      | `gltf`                          | metre        | y             | each node    |
| COLLADA        | `collada`                       | ``<unit>``   | ``<up_axis>`` | each node    |
| STEP           | `step`: cascadio (OpenCASCADE)  | its own      | z             | each product |
| FBX            | `fbx`                           | if it says   | as it says    | each model   |
| 3MF            | `threemf`                       | its own      | z             | each placed  |

All but STEP are read here, because what libraries make of them loses something in silence. Seen
with trimesh 5.2, Open3D 0.20 and pycollada 0.9: polygons left out, or cut so that they cover what
is no part of them; what follows a damaged line; strips, polygons with holes, several solids;
vertices after a mark of byte order. What a reader here does not take in, it refuses by the line or
element where it stands.

Files without a word for it are taken as they stand, z up, as CAD draws. glTF is y up by its
standard, and exporters turn what was z up accordingly; it is turned back, so that the STEP, the
STL and the GLB of one part end up in the same place. Whoever exports z up all the same says
``up = "z"`` in the scene.
"""

from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version

from hybridve.hull.cad.collada import parse_collada
from hybridve.hull.cad.fbx import parse_fbx
from hybridve.hull.cad.gltf import buffer_names, parse_gltf
from hybridve.hull.cad.obj import mtl_names, parse_obj
from hybridve.hull.cad.off import parse_off
from hybridve.hull.cad.part import Contents
from hybridve.hull.cad.ply import parse_ply
from hybridve.hull.cad.step import parse_step
from hybridve.hull.cad.stl import parse_stl
from hybridve.hull.cad.threemf import parse_3mf

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
    ".3mf": "3MF",
}

#: Kinds that are not read, and why; with all others the same is to be done.
NOT_READ = {
    ".igs": "IGES holds loose faces, and nothing tells whether one was lost",
    ".iges": "IGES holds loose faces, and nothing tells whether one was lost",
}

#: Kinds that say what their unit is, FBX at times. A STEP file's is not to be overridden: it is
#: part of each number in it, and may differ between its parts.
WITH_UNIT = ("GLB", "glTF", "COLLADA", "STEP", "FBX", "3MF")

#: Kinds made of curved surfaces, which become triangles here.
TESSELLATED = ("STEP",)

#: The packages that decide what is read from a kind, besides this one.
_PACKAGES = {"STEP": ("cascadio",)}


def parse(
    content: bytes, kind: str, beside: Mapping[str, bytes], tessellation_m: float
) -> Contents:
    """Return what is in a file.

    Parameters
    ----------
    content : bytes
        The file.
    kind : str
        One of the values of `FORMATS`.
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
    if kind == "STEP":
        return parse_step(content, tessellation_m)
    alone = {
        "STL": parse_stl,
        "PLY": parse_ply,
        "OFF": parse_off,
        "COLLADA": parse_collada,
        "FBX": parse_fbx,
        "3MF": parse_3mf,
    }
    try:
        if kind == "OBJ":
            return parse_obj(content, beside)
        if kind in ("GLB", "glTF"):
            return parse_gltf(content, beside)
        return alone[kind](content)
    except (LookupError, TypeError, AttributeError, ArithmeticError, MemoryError) as error:
        # A value of another kind than belongs there, or too large a number: damage has many forms.
        raise ValueError(f"not a sound {kind} file: {type(error).__name__}: {error}") from error


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
    """Return the libraries that read a kind and their versions, without importing them.

    Empty if it is read here; None if a library is not there.
    """
    found = []
    for package in _PACKAGES.get(kind, ()):
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            return None
    return " ".join(found)
