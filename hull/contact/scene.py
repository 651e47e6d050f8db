"""The CAD scene: scene.toml, checked, its meshes placed in the world."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from hybridve.calib.errors import SceneError
from hybridve.calib.pose import rotation_about_axes
from hybridve.hull.contact.mesh import read_mesh
from hybridve.hull.toml_io import expand_root, explain_validation, read_toml

#: How many metres one unit of a mesh file is.
UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}

_Vector = tuple[float, float, float]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _ObjectTable(_Table):
    # The name becomes a group of the report, where "/" separates and "." stands for the group.
    name: Annotated[str, Field(pattern=r"^[^/\s.][^/\s]*$")]
    mesh: str
    unit: Literal["m", "cm", "mm", "in", "ft"]
    translate_mm: _Vector = (0.0, 0.0, 0.0)
    rotate_deg: _Vector = (0.0, 0.0, 0.0)
    required_clearance_mm: Annotated[float, Field(ge=0)] = 0.0
    reference_point_mm: _Vector | None = None
    recovery_direction: _Vector | None = None

    @field_validator("recovery_direction")
    @classmethod
    def _has_length(cls, direction: _Vector | None) -> _Vector | None:
        if direction is not None and not any(direction):
            raise ValueError("[0, 0, 0] points nowhere; give a direction")
        return direction


class _EffectTable(BaseModel):
    # Each effect has keys of its own, which are its own to check.
    model_config = ConfigDict(extra="allow", frozen=True)
    kind: str


class _SceneTable(_Table):
    format: Literal["hybridve-scene"]
    version: Literal[1]
    root: str = "."
    object: Annotated[list[_ObjectTable], Field(min_length=1)]
    effect: list[_EffectTable] = []


@dataclass(frozen=True, slots=True, eq=False)
class SceneObject:
    """One CAD object, placed in the world.

    Attributes
    ----------
    name : str
        Unique within the scene.
    mesh_path : Path
        The file it was read from.
    vertices_world : (V, 3) float64
        Metres.
    faces : (T, 3) int32
        Vertex numbers.
    required_clearance_m : float
        How far real things are to stay away.
    reference_point_world : (3,) float64
        The paper's RP_obj; the centre of the bounding box unless the scene says otherwise.
    recovery_direction : (3,) float64 or None
        Unit vector of a constrained object's V_rec, world; the scene gives it, as it gives the
        reference point, in the frame of the mesh.
    """

    name: str
    mesh_path: Path
    vertices_world: NDArray[np.float64]
    faces: NDArray[np.int32]
    required_clearance_m: float
    reference_point_world: NDArray[np.float64]
    recovery_direction: NDArray[np.float64] | None

    @property
    def box_world(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The lower and upper corner of the axis-aligned bounding box, (3,) metres."""
        used = self.vertices_world[self.faces.ravel()]
        return used.min(axis=0), used.max(axis=0)


@dataclass(frozen=True, slots=True)
class Scene:
    """The CAD objects of one scene and the effects it calls for.

    Attributes
    ----------
    path : Path
        The scene.toml.
    objects : tuple of SceneObject
        At least one.
    effects : tuple of dict
        The ``[[effect]]`` tables as they stand.
    checksum : str
        SHA-256 over the scene.toml and the meshes it names.
    """

    path: Path
    objects: tuple[SceneObject, ...]
    effects: tuple[dict[str, Any], ...]
    checksum: str


def load_scene(path: Path) -> Scene:
    """Return the scene that a scene.toml describes, its meshes in metres in the world.

    An object's file is scaled by its unit, turned by `rotate_deg` about x, then y, then z of the
    world, and moved by `translate_mm`.

    Raises
    ------
    SceneError
        One line that names the key at fault, or what is wrong with a mesh.
    """
    table, text = read_toml(path, "scene", SceneError)
    _refuse_missing_units(table, path)
    try:
        parsed = _SceneTable.model_validate(table)
    except ValidationError as error:
        raise SceneError(explain_validation(error, path)) from None
    names = [entry.name for entry in parsed.object]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise SceneError(
                f"{path}: object.{number + 1}.name: {name!r} is the name of object."
                f"{names.index(name) + 1} too; give each object its own"
            )
    root = expand_root(parsed.root, path, SceneError)
    checksum = hashlib.sha256(text)
    objects = []
    for number, entry in enumerate(parsed.object, start=1):
        try:
            objects.append(_place(entry, root))
        except SceneError as error:
            raise SceneError(f"{path}: object.{number}.mesh: {error}") from error
        checksum.update((root / entry.mesh).read_bytes())
    return Scene(
        path=path,
        objects=tuple(objects),
        effects=tuple(entry.model_dump() for entry in parsed.effect),
        checksum=checksum.hexdigest(),
    )


def _refuse_missing_units(table: dict[str, Any], path: Path) -> None:
    for number, entry in enumerate(table.get("object", []), start=1):
        if isinstance(entry, dict) and "unit" not in entry:
            raise SceneError(
                f"{path}: object.{number}.unit: this key is missing; mesh files do not say their "
                f"unit, and it is never guessed: one of {', '.join(UNITS_M)}"
            )


def _place(entry: _ObjectTable, root: Path) -> SceneObject:
    mesh_path = root / entry.mesh
    mesh = read_mesh(mesh_path)
    rotation = rotation_about_axes(entry.rotate_deg)
    translation_m = np.array(entry.translate_mm) / 1000.0
    vertices_world = (mesh.vertices * UNITS_M[entry.unit]) @ rotation.T + translation_m
    if entry.reference_point_mm is not None:
        reference_point_m = rotation @ (np.array(entry.reference_point_mm) / 1000.0) + translation_m
    else:
        used = vertices_world[mesh.faces.ravel()]
        reference_point_m = (used.min(axis=0) + used.max(axis=0)) / 2.0
    direction = None
    if entry.recovery_direction is not None:
        direction = rotation @ np.array(entry.recovery_direction)
        direction /= np.linalg.norm(direction)
    return SceneObject(
        name=entry.name,
        mesh_path=mesh_path,
        vertices_world=vertices_world,
        faces=mesh.faces,
        required_clearance_m=entry.required_clearance_mm / 1000.0,
        reference_point_world=reference_point_m,
        recovery_direction=direction,
    )
