"""The CAD scene: scene.toml, checked, its meshes placed in the world.

A file becomes an object. A file of several parts becomes as many objects, called ``OBJECT.PART``
after the names in the file; all keys of its table hold for each of them, and each has its own
centre for a reference point unless the table gives one. In a part's name, ``/`` and blanks become
``_``; a part without a name is ``part``; parts of the same name become ``bolt``, ``bolt.2``,
``bolt.3`` in the file's order. ``parts = "merge"`` keeps the file as one object.

A file is turned so that what is up in it is up in the world, before anything else is done: glTF is
y up by its standard, FBX and COLLADA say, all others are taken as z up, and ``up`` overrides any of
them.
STEP, glTF and COLLADA bring their unit (glTF is metres by its standard), and most FBX do; for all
others the scene must give it. For glTF, COLLADA and FBX it may, against what the file says; for
STEP it may not.

An object that moves is placed by the scene in a frame of its own, and a CSV file tells where that
was, frame by frame of the session (`hybridve.hull.cad.motion`); by ``poses``, by a ``track``, or by
a ``hinge``.
"""

import hashlib
import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from hybridve.calib.errors import CalibrationError, SceneError
from hybridve.calib.formats.tracker import read_angles, read_poses
from hybridve.calib.pose import Pose, compose, placed, rotation_about_axes
from hybridve.hull.cad.mesh import TESSELLATION_M, CadFile, kind_of, read_cad
from hybridve.hull.cad.motion import Motion
from hybridve.hull.cad.part import Part, Up
from hybridve.hull.cad.readers import FORMATS, TESSELLATED, WITH_UNIT
from hybridve.hull.cad.rules import Rule
from hybridve.hull.cad.topology import Topology, meeting_faces
from hybridve.hull.toml_io import Name, Roots, explain_validation, like, read_toml

_log = logging.getLogger(__name__)

#: How many metres one unit of a mesh file is.
UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}

#: Where the axes of a mesh that is z up lie in one that is not, and with which sign. Seen from the
#: front, COLLADA's conventions: right is x, x, -y; up is z, y, x; towards the viewer is -y, z, z.
_FROM_UP: dict[Up, tuple[tuple[int, int, int], tuple[float, float, float]]] = {
    "y": ((0, 2, 1), (1.0, -1.0, 1.0)),
    "x": ((1, 2, 0), (-1.0, -1.0, 1.0)),
}

#: What single precision leaves of coordinates is below this within 16 m of a file's origin, a
#: thousandth of what outlines in pictures leave open, and of no number that is printed.
_NO_ROUNDING_M = 1e-6

#: A file is told of whose coordinates are coarser than this.
_COARSE_M = 5e-5

_Vector = tuple[float, float, float]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class HingeTable(_Table):
    """A hinge, as an object's ``hinge`` describes it."""

    axis: _Vector
    anchor_mm: _Vector
    angles: str

    @field_validator("axis")
    @classmethod
    def _has_length(cls, axis: _Vector) -> _Vector:
        if not any(axis):
            raise ValueError("[0, 0, 0] is no axis; give its direction")
        return axis


class TrackTable(_Table):
    """A tracker on a part, as an object's ``track`` describes it."""

    poses: str
    object_from_tracker_mm: _Vector = (0.0, 0.0, 0.0)
    rotate_deg: _Vector = (0.0, 0.0, 0.0)


#: The keys of what makes an object move.
_MOTIONS = ("poses", "hinge", "track")


class ObjectTable(_Table):
    """An ``[[object]]`` of a scene."""

    name: Name
    mesh: str
    unit: Literal["m", "cm", "mm", "in", "ft"] | None = None
    up: Up | None = None
    parts: Literal["split", "merge"] = "split"
    # Less than a micrometre is more than single precision holds; more than a metre, no part.
    tessellation_mm: Annotated[float, Field(ge=0.001, le=1000.0)] | None = None
    translate_mm: _Vector = (0.0, 0.0, 0.0)
    rotate_deg: _Vector = (0.0, 0.0, 0.0)
    required_clearance_mm: Annotated[float, Field(ge=0)] = 0.0
    reference_point_mm: _Vector | None = None
    recovery_direction: _Vector | None = None
    poses: str | None = None
    hinge: HingeTable | None = None
    track: TrackTable | None = None

    @field_validator("recovery_direction")
    @classmethod
    def _has_length(cls, direction: _Vector | None) -> _Vector | None:
        if direction is not None and not any(direction):
            raise ValueError("[0, 0, 0] points nowhere; give a direction")
        return direction

    @model_validator(mode="after")
    def _moves_in_one_way(self) -> "ObjectTable":
        given = [key for key in _MOTIONS if getattr(self, key) is not None]
        if len(given) > 1:
            raise ValueError(f"has {' and '.join(given)}; an object moves in one way, keep one")
        return self


class _KeyError(Exception):
    """A key of the scene is at fault, not its mesh; the text is complete."""


class _EffectTable(BaseModel):
    # Each effect has keys of its own, which are its own to check.
    model_config = ConfigDict(extra="allow", frozen=True)
    kind: str


#: The keys of what a rule does.
_ACTIONS = ("ignore", "shortest_s", "required_clearance_mm")


class _RuleTable(_Table):
    object: str | Annotated[list[str], Field(min_length=1)] = "*"
    ignore: Literal[True] | None = None
    zone_mm: tuple[_Vector, _Vector] | None = None
    zone_in: Literal["world", "object"] | None = None
    shortest_s: Annotated[float, Field(gt=0)] | None = None
    required_clearance_mm: Annotated[float, Field(ge=0)] | None = None
    comment: str = ""

    @field_validator("zone_mm")
    @classmethod
    def _has_room(cls, zone: tuple[_Vector, _Vector] | None) -> tuple[_Vector, _Vector] | None:
        if zone is not None and not all(a < b for a, b in zip(*zone, strict=True)):
            raise ValueError(
                f"{list(map(list, zone))} holds nothing; give its lower corner and its upper one"
            )
        return zone

    @model_validator(mode="after")
    def _does_one_thing(self) -> "_RuleTable":
        given = [key for key in _ACTIONS if getattr(self, key) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            raise ValueError(f"has {found} of {', '.join(_ACTIONS)}; a rule does one thing")
        if self.zone_mm is not None and not self.ignore:
            raise ValueError(f"zone_mm: is of rules that ignore; {given[0]} holds everywhere")
        if self.zone_in is not None and self.zone_mm is None:
            raise ValueError("zone_in: says of what frame zone_mm is, which is missing")
        return self

    def rule(self) -> Rule:
        """Return it in metres."""
        zone_m = None
        if self.zone_mm is not None:
            (a, b, c), (d, e, f) = self.zone_mm
            zone_m = (a / 1e3, b / 1e3, c / 1e3), (d / 1e3, e / 1e3, f / 1e3)
        required_mm = self.required_clearance_mm
        return Rule(
            (self.object,) if isinstance(self.object, str) else tuple(self.object),
            bool(self.ignore),
            zone_m,
            self.zone_in or "world",
            self.shortest_s or 0.0,
            None if required_mm is None else required_mm / 1e3,
            self.comment,
        )


class _SceneTable(_Table):
    format: Literal["hybridve-scene"]
    version: Literal[1]
    root: str = "."
    roots: list[str] = []
    object: Annotated[list[ObjectTable], Field(min_length=1)]
    effect: list[_EffectTable] = []
    rule: list[_RuleTable] = []


@dataclass(frozen=True, slots=True, eq=False)
class SceneObject:
    """One CAD object, placed in the world; `load_scene` gives arrays that cannot be written to.

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
        reference point, in the frame of the mesh, after that was turned z up.
    is_closed : bool
        Whether the surface closes off a volume, so that inside and outside can be told apart.
    solid_faces : (T, 3) int32 or None
        Of a closed surface, its triangles in numbers that are equal where corners meet in the file;
        see `hybridve.hull.cad.topology.meeting_faces`.
    color : tuple of 4 floats, or None
        What the file says of its colour, 0 to 1, as a picture shows it (sRGB), and its opacity.
    tessellation_error_m : float
        How far the triangles are from the surface that they stand for: an estimate for STEP; for
        files made of triangles or polygons 0, unless single precision leaves more than a micrometre
        of their coordinates open. Distances to the part are uncertain by that much.
    about : dict
        What the report says of where it came from, as plain JSON values; see `load_scene`.
    vertices_mesh : (V, 3) float64 or None
        Metres, in the frame of the mesh, turned z up; None if that is the world's.
    world_from_mesh : (3, 4) float64
        Where that frame lies: `vertices_world` is `placed` by it.
    motion : Motion or None
        How it moves; None for one that stands where it is. Of one that moves everything above is
        told at rest, as the scene places it; `at` tells it of a frame.
    """

    name: str
    mesh_path: Path
    vertices_world: NDArray[np.float64]
    faces: NDArray[np.int32]
    required_clearance_m: float
    reference_point_world: NDArray[np.float64]
    recovery_direction: NDArray[np.float64] | None
    is_closed: bool = False
    solid_faces: NDArray[np.int32] | None = None
    color: tuple[float, float, float, float] | None = None
    tessellation_error_m: float = 0.0
    about: dict[str, Any] = field(default_factory=dict)
    vertices_mesh: NDArray[np.float64] | None = None
    world_from_mesh: NDArray[np.float64] = field(default_factory=lambda: np.eye(3, 4))
    motion: Motion | None = None

    def at(self, world_from_rest: Pose) -> "SceneObject":
        """Return the object moved rigidly from where it rests: it stands there, without a motion.

        Parameters
        ----------
        world_from_rest : (3, 4) float64
            Metres.
        """
        vertices_mesh = self.vertices_world if self.vertices_mesh is None else self.vertices_mesh
        world_from_mesh = compose(world_from_rest, self.world_from_mesh)
        vertices_world = placed(vertices_mesh, world_from_mesh)
        vertices_world.flags.writeable = False
        rotation, direction = world_from_rest[:, :3], self.recovery_direction
        return replace(
            self,
            vertices_world=vertices_world,
            reference_point_world=rotation @ self.reference_point_world + world_from_rest[:, 3],
            recovery_direction=None if direction is None else rotation @ direction,
            vertices_mesh=vertices_mesh,
            world_from_mesh=world_from_mesh,
            motion=None,
        )

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
        SHA-256 over the scene.toml, the meshes it names, the files that these lean on, and the
        files that tell where objects move.
    rules : tuple of Rule
        What the list of clashes leaves out, and what single objects require; `objects` have it.
    """

    path: Path
    objects: tuple[SceneObject, ...]
    effects: tuple[dict[str, Any], ...]
    checksum: str
    rules: tuple[Rule, ...] = ()

    @property
    def moves(self) -> bool:
        """Whether an object moves."""
        return any(one.motion is not None for one in self.objects)

    def missing(self, index: int) -> str:
        """Say which objects that move have no pose in a frame; "" if none of them lacks one."""
        # Parts of one file move together: it is named once.
        names = dict.fromkeys(
            str(one.about.get("object", one.name))
            for one in self.objects
            if one.motion is not None and one.motion.world_from_rest(index) is None
        )
        return "; ".join(f"no pose of object {name!r} in frame {index}" for name in names)


def load_scene(path: Path) -> Scene:
    """Return the scene that a scene.toml describes, its meshes in metres in the world.

    An object's file is turned z up, scaled by its unit, turned by `rotate_deg` about x, then y,
    then z of the world, and moved by `translate_mm`. That is where one that moves is at rest:

    * ``poses``: a file of poses (`hybridve.calib.formats.tracker`), world_from_rest by frame of the
      session;
    * ``track``: the same of a tracker on the object. ``object_from_tracker_mm`` and ``rotate_deg``
      (about x, then y, then z) say where it sits: ``x_rest = R x_tracker + t``;
    * ``hinge``: turned about ``axis`` through ``anchor_mm``, both given in the frame of the mesh
      after it was turned z up, by the angle that the file ``angles`` has for each frame.

    Each object's `about` holds: ``object`` (the name of its table, which parts of one file share),
    ``mesh`` (as the scene names it), ``format``, ``part`` (what the object is called after that
    name; None for a file of one part, or merged), ``unit`` (as the scene or the file names it),
    ``unit_m`` (metres), ``up`` (the axis that was turned up), ``tessellation_m`` (largest distance
    of a triangle from the surface it stands for; None if the file is made of triangles),
    ``rounding_m`` (how far single precision in the file may have moved a corner),
    ``n_triangles``, ``n_vertices``, ``n_zero_area``, ``n_open_edges``, ``n_nonmanifold_edges``,
    ``n_inconsistent_edges``, ``closed``, ``closed_within_m`` (0, or the noise of single precision),
    ``volume_m3`` and ``inside_out`` (these three None if not closed), and ``material`` (``name``
    and ``rgba``, either None); of one that moves ``motion``: ``kind``, ``file`` (as the scene names
    it) and ``n_frames``. How edges are counted, and what closed means, is told in
    `hybridve.hull.cad.topology`; nothing is repaired.

    Raises
    ------
    SceneError
        One line that names the key at fault, or what is wrong with a mesh or a file of poses.
    """
    table, text = read_toml(path, "scene", SceneError)
    _refuse_missing_units(table, path)
    try:
        parsed = _SceneTable.model_validate(table)
    except ValidationError as error:
        raise SceneError(explain_validation(error, path, _SceneTable)) from None
    for number, entry in enumerate(parsed.object, start=1):
        before = [earlier.name for earlier in parsed.object[: number - 1]]
        if entry.name in before:
            raise SceneError(
                f"{path}: object.{number}.name: {entry.name!r} is the name of object."
                f"{before.index(entry.name) + 1} too; give each object its own"
            )
    roots = Roots.of(parsed.root, parsed.roots, path, SceneError)
    root = roots.root
    checksum = hashlib.sha256(text)
    objects: dict[str, SceneObject] = {}
    for number, entry in enumerate(parsed.object, start=1):
        label = f"{path}: object.{number}"
        try:
            roots.refuse_outside(entry.mesh, [root / entry.mesh], SceneError)
            kind = kind_of(root / entry.mesh)
            _refuse_what_the_kind_has(entry, kind, label)
            tessellation_m = TESSELLATION_M
            if entry.tessellation_mm is not None:
                tessellation_m = entry.tessellation_mm / 1000.0
            cad = read_cad(
                root / entry.mesh, merge=entry.parts == "merge", tessellation_m=tessellation_m
            )
        except _KeyError as error:
            raise SceneError(str(error)) from None
        except SceneError as error:
            raise SceneError(f"{label}.mesh: {error}") from error
        if entry.unit is None and cad.unit_m is None:
            raise SceneError(
                f"{label}.unit: this key is missing; this {cad.kind} file does not say its unit, "
                f"and it is never guessed: one of {', '.join(UNITS_M)}"
            )
        _tell_coarse(entry, cad, label)
        motion = _motion(entry, roots, label)
        for part in _place(entry, cad, motion):
            if part.name in objects:
                raise SceneError(
                    f"{label}.name: this object or a part of it would be called {part.name!r}, "
                    "as another is already; give it another name"
                )
            objects[part.name] = part
        for file in (cad.path, *cad.beside):
            checksum.update(file.read_bytes())
        if (told_by := _motion_file(entry)) is not None:
            checksum.update((root / told_by[1]).read_bytes())
    rules = tuple(entry.rule() for entry in parsed.rule)
    return Scene(
        path=path,
        objects=_required_by(rules, objects, path),
        effects=tuple(entry.model_dump() for entry in parsed.effect),
        checksum=checksum.hexdigest(),
        rules=rules,
    )


def _tell_coarse(entry: ObjectTable, cad: CadFile, label: str) -> None:
    """Log that the coordinates of a file are coarse, if single precision makes them so."""
    unit_m = UNITS_M[entry.unit] if entry.unit is not None else cad.unit_m or 1.0
    worst = max(cad.parts, key=lambda part: part.rounding)
    if worst.rounding * unit_m <= _COARSE_M:
        return
    farthest_m = float(np.abs(worst.vertices).max()) * unit_m
    _log.warning(
        "%s.mesh: object %r: %s: coordinates of up to %s m in single precision are off by up to "
        "%.2g mm, which its clearances allow for; export it nearer to its origin and put it back "
        "with translate_mm, or in double precision",
        *(label, entry.name, cad.path, f"{farthest_m:,.0f}", 1000.0 * worst.rounding * unit_m),
    )


def _required_by(
    rules: tuple[Rule, ...], objects: dict[str, SceneObject], path: Path
) -> tuple[SceneObject, ...]:
    """Return the objects with the clearance that rules require of them, the last of those."""
    for number, rule in enumerate(rules, start=1):
        for pattern in rule.objects:
            if not any(Rule((pattern,)).holds_for(name) for name in objects):
                raise SceneError(
                    f"{path}: rule.{number}.object: no object is called {pattern!r}"
                    f"{like(pattern, list(objects))}"
                )
        if rule.required_clearance_m is not None:
            for name in filter(rule.holds_for, list(objects)):
                objects[name] = replace(
                    objects[name], required_clearance_m=rule.required_clearance_m
                )
    return tuple(objects.values())


def _refuse_missing_units(table: dict[str, Any], path: Path) -> None:
    entries = table.get("object", [])
    for number, entry in enumerate(entries if isinstance(entries, list) else [], start=1):
        if not isinstance(entry, dict) or "unit" in entry:
            continue
        kind = FORMATS.get(Path(str(entry.get("mesh", ""))).suffix.lower())
        if kind not in WITH_UNIT:
            raise SceneError(
                f"{path}: object.{number}.unit: this key is missing; {kind or 'mesh'} files do not "
                f"say their unit, and it is never guessed: one of {', '.join(UNITS_M)}"
            )


def _refuse_what_the_kind_has(entry: ObjectTable, kind: str, label: str) -> None:
    """Refuse keys that have no meaning for a kind of file."""
    if kind in TESSELLATED and entry.unit is not None:
        raise _KeyError(
            f"{label}.unit: found {entry.unit!r}, but a {kind} file brings its own unit; "
            "remove this key"
        )
    if kind not in TESSELLATED and entry.tessellation_mm is not None:
        raise _KeyError(
            f"{label}.tessellation_mm: found {entry.tessellation_mm:g}, but {kind} is made of "
            "triangles already, only STEP becomes triangles here; remove this key"
        )


def _motion_file(entry: ObjectTable) -> tuple[str, str] | None:
    """Return the key that names the file of an object's motion, and that name; None if at rest."""
    if entry.poses is not None:
        return "poses", entry.poses
    if entry.hinge is not None:
        return "hinge.angles", entry.hinge.angles
    if entry.track is not None:
        return "track.poses", entry.track.poses
    return None


def _motion(entry: ObjectTable, roots: Roots, label: str) -> Motion | None:
    """Return how an object moves; None if it does not."""
    told_by = _motion_file(entry)
    if told_by is None:
        return None
    key, name = told_by
    root = roots.root
    try:
        roots.refuse_outside(name, [root / name], CalibrationError)
        if entry.hinge is not None:
            rotation, translation_m = _placement(entry)
            return Motion.of_hinge(
                read_angles(root / name),
                rotation @ np.array(entry.hinge.axis),
                rotation @ (np.array(entry.hinge.anchor_mm) / 1000.0) + translation_m,
            )
        poses = read_poses(root / name)
    except CalibrationError as error:
        raise SceneError(f"{label}.{key}: {error}") from error
    if entry.track is None:
        return Motion.of_poses(poses)
    object_from_tracker = np.column_stack(
        [
            rotation_about_axes(entry.track.rotate_deg),
            np.array(entry.track.object_from_tracker_mm) / 1000.0,
        ]
    )
    return Motion.of_track(poses, object_from_tracker)


def _placement(entry: ObjectTable) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how the scene turns a mesh (3, 3), and by how much it moves it (3,), metres."""
    return rotation_about_axes(entry.rotate_deg), np.array(entry.translate_mm) / 1000.0


def _place(entry: ObjectTable, cad: CadFile, motion: Motion | None) -> Iterator[SceneObject]:
    """Yield the objects that a file becomes."""
    up = entry.up or cad.up
    unit_m = UNITS_M[entry.unit] if entry.unit is not None else cad.unit_m
    if unit_m is None:
        raise ValueError(f"{entry.name}: neither the scene nor the file gives a unit")
    rotation, translation_m = _placement(entry)
    direction = None
    if entry.recovery_direction is not None:
        direction = rotation @ np.array(entry.recovery_direction)
        direction /= np.linalg.norm(direction)
    is_assembly = len(cad.parts) > 1
    names = part_names([part.name for part in cad.parts])
    for part, topology, name in zip(cad.parts, cad.topologies, names, strict=True):
        vertices = part.vertices
        if up != "z":
            columns, signs = _FROM_UP[up]
            vertices = vertices[:, columns] * signs
        vertices_mesh = vertices * unit_m
        world_from_mesh = np.column_stack([rotation, translation_m])
        vertices_world = placed(vertices_mesh, world_from_mesh)
        if entry.reference_point_mm is not None:
            reference_point_world = (
                rotation @ (np.array(entry.reference_point_mm) / 1000.0) + translation_m
            )
        else:
            used = vertices_world[part.faces.ravel()]
            reference_point_world = (used.min(axis=0) + used.max(axis=0)) / 2.0
        rounding_m = part.rounding * unit_m
        off_by_m = part.off_by_m + (rounding_m if rounding_m > _NO_ROUNDING_M else 0.0)
        about: dict[str, Any] = {
            "object": entry.name,
            "mesh": entry.mesh,
            "format": cad.kind,
            "part": name if is_assembly else None,
            "unit": entry.unit or cad.unit,
            "unit_m": unit_m,
            "up": up,
            "tessellation_m": cad.tessellation_m,
            "notes": list(cad.notes),
        }
        told_by = _motion_file(entry)
        if motion is not None and told_by is not None:
            kind = told_by[0].partition(".")[0]
            about["motion"] = {"kind": kind, "file": told_by[1], "n_frames": len(motion.poses)}
        for array in (vertices_mesh, vertices_world, part.faces):
            array.flags.writeable = False  # so that nobody need copy them
        yield SceneObject(
            name=f"{entry.name}.{name}" if is_assembly else entry.name,
            mesh_path=cad.path,
            vertices_world=vertices_world,
            faces=part.faces,
            required_clearance_m=entry.required_clearance_mm / 1000.0,
            reference_point_world=reference_point_world,
            recovery_direction=direction,
            is_closed=topology.closed,
            solid_faces=meeting_faces(part.vertices, part.faces) if topology.closed else None,
            color=part.rgba,
            tessellation_error_m=off_by_m,
            about=about | _about_mesh(part, topology, unit_m),
            vertices_mesh=vertices_mesh,
            world_from_mesh=world_from_mesh,
            motion=motion,
        )


def _about_mesh(part: Part, topology: Topology, unit_m: float) -> dict[str, Any]:
    volume = topology.volume
    return {
        "n_triangles": len(part.faces),
        "n_vertices": len(part.vertices),
        "tessellation_error_m": part.off_by_m,
        "rounding_m": part.rounding * unit_m,
        "n_polygons": part.cuts.n_polygons,
        "n_bent_polygons": part.cuts.n_bent,
        "bent_by_m": part.cuts.bent_by * unit_m,
        "n_zero_area": topology.n_zero_area,
        "n_open_edges": topology.n_open_edges,
        "n_nonmanifold_edges": topology.n_nonmanifold_edges,
        "n_inconsistent_edges": topology.n_inconsistent_edges,
        "closed": topology.closed,
        "closed_within_m": (
            None if topology.closed_within is None else topology.closed_within * unit_m
        ),
        "volume_m3": None if volume is None else abs(volume) * unit_m**3,
        "inside_out": None if volume is None else volume < 0,
        "material": {
            "name": part.material or None,
            "rgba": None if part.rgba is None else list(part.rgba),
        },
    }


def part_names(names: list[str]) -> list[str]:
    """Return what parts are called that a file calls so: fit for a report, and all different.

    Examples
    --------
    >>> part_names(["bolt", "left plate", "bolt", "", "a/b"])
    ['bolt', 'left_plate', 'bolt.2', 'part', 'a_b']
    """
    fit = [re.sub(r"[/\s\x00-\x1f\x7f]+", "_", name.strip()) or "part" for name in names]
    # A name that stands in the file goes to the part that has it, not to the second of another.
    taken: set[str] = set()
    result = []
    for number, name in enumerate(fit):
        given = name
        count = 1
        while given in taken or (count > 1 and given in fit[number + 1 :]):
            count += 1
            given = f"{name}.{count}"
        taken.add(given)
        result.append(given)
    return result
