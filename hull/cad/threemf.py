"""3MF: a ZIP of XML; a part for each mesh that the build places, names, colours and the unit.

Read here, in double precision, element by element. What makes a surface in another way than by a
mesh (beam lattices, booleans, slices, level sets), what needs an extension that is not read, and
what a slicer counts as no part of the thing (modifiers, negative volumes) is refused by name.
Objects that the build does not place are left out, and said to be.

A package may come from anybody: a ZIP that unfolds to more than `_MOST_BYTES`, components that
unfold to more than `_MOST_TRIANGLES`, and XML with a document type, which could define entities,
are refused.

References
----------
3MF Core Specification 1.3, 3MF Consortium, chapters 2 (package), 3 (model) and 4 (objects,
transforms: ``x' = m00 x + m10 y + m20 z + m30``); Production Extension 1.1 (other model files).
"""

import io
import math
import posixpath
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.part import Contents, Part, move
from hybridve.hull.cad.text import number, whole

#: What a package may unfold to, and what its build may place, copies counted each time.
_MOST_BYTES = 2**30
_MOST_TRIANGLES = 50_000_000
_MOST_PLACED = 200_000

#: The most objects one inside the other; more hold each other in a circle.
_DEEPEST = 100

_UNITS_M = {
    "micron": 1e-6,
    "millimeter": 0.001,
    "centimeter": 0.01,
    "meter": 1.0,
    "inch": 0.0254,
    "foot": 0.3048,
}

_SCHEMAS = "http://schemas.microsoft.com/3dmanufacturing/"
_MODEL_RELATION = _SCHEMAS + "2013/01/3dmodel"
_CORE = _SCHEMAS + "core/2015/02"
_PRODUCTION = _SCHEMAS + "production/2015/06"

#: Extensions that leave the triangles what they are; production is read.
_HARMLESS = (_PRODUCTION, _SCHEMAS + "material/2015/02", _SCHEMAS + "trianglesets/2021/07")

#: Kinds of objects that are the thing itself; the others hold it up while it is printed.
_SOLID = ("model", "surface")

#: How slicers mark, beside the model, volumes that only change how others are printed.
_MODIFIER = re.compile(
    rb'value="(NegativeVolume|ParameterModifier|SupportEnforcer|SupportBlocker)"'
    rb'|subtype="(negative_part|modifier_part|support_enforcer|support_blocker)"'
    rb'|key="(modifier)" value="1"'
)

_Rgba = tuple[float, float, float, float]
_Key = tuple[str, str]  # a model file, and an object's id in it


@dataclass(slots=True)
class _Object:
    kind: str
    name: str
    line: int
    property: tuple[str, str]
    coordinates: list[float] = field(default_factory=list)
    corners: list[int] = field(default_factory=list)
    components: list[tuple[_Key, NDArray[np.float64]]] = field(default_factory=list)
    has_mesh: bool = False
    is_mixed: bool = False  # triangles are of other materials than the object


@dataclass(slots=True)
class _Model:
    unit: str = "millimeter"
    objects: dict[str, _Object] = field(default_factory=dict)
    items: list[tuple[_Key, NDArray[np.float64], str]] = field(default_factory=list)
    materials: dict[str, list[tuple[str, _Rgba | None]]] = field(default_factory=dict)
    has_build: bool = False


def parse_3mf(content: bytes) -> Contents:
    """Return the parts of a 3MF file: one for each mesh that its build places.

    Raises
    ------
    ValueError
        If the file is damaged, or needs something that cannot be read.
    """
    package = _Package(content)
    package.refuse_modifiers()
    root = package.root_model()
    document = _Document(package, root)
    parts = tuple(document.parts())
    return Contents(
        parts, document.unit, _UNITS_M[document.unit], "z", notes=document.what_is_not_placed()
    )


class _Package:
    """The files of a ZIP, by the names that its models use."""

    def __init__(self, content: bytes) -> None:
        try:
            self._zip = zipfile.ZipFile(io.BytesIO(content))
            entries = self._zip.infolist()
        except (zipfile.BadZipFile, ValueError, NotImplementedError, OverflowError) as error:
            raise ValueError(f"its ZIP cannot be read: {error}; is it cut off?") from error
        except (LookupError, EOFError, OSError) as error:
            raise ValueError(f"its ZIP cannot be read: {error!r}; is it cut off?") from error
        self._entries = {entry.filename.lstrip("/").lower(): entry for entry in entries}
        unfolded = sum(entry.file_size for entry in entries)
        if unfolded > _MOST_BYTES:
            raise ValueError(
                f"its ZIP unfolds to {unfolded:,} bytes, expected up to {_MOST_BYTES:,}; export "
                "fewer parts"
            )

    def read(self, name: str) -> bytes:
        """Return one file."""
        entry = self._entries.get(name.lstrip("/").lower())
        if entry is None:
            raise ValueError(f"it has no {name!r}; it is damaged, or no 3MF")
        try:
            with self._zip.open(entry) as file:
                found = file.read(entry.file_size + 1)  # no more than the directory says
        except (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError) as error:
            raise ValueError(f"its {name!r} is damaged: {error}") from error
        except (NotImplementedError, RuntimeError, LookupError, OverflowError) as error:
            raise ValueError(f"its {name!r} cannot be unfolded: {error}") from error
        if len(found) != entry.file_size:
            raise ValueError(f"its {name!r} is not as long as the ZIP says")
        return found

    def root_model(self) -> str:
        """Return the name of the model that the package stands for."""
        relations = self.read("_rels/.rels")
        targets: list[str] = []

        def start(_: str, said: dict[str, str], __: int) -> None:
            if said.get("Type") == _MODEL_RELATION:
                targets.append(said.get("Target", ""))

        _parse_xml(relations, "_rels/.rels", start, lambda _: None, lambda *_: None)
        if not targets:
            raise ValueError("its _rels/.rels names no 3D model; it is no 3MF")
        return _normal("/", targets[0])

    def refuse_modifiers(self) -> None:
        """Refuse meshes that a slicer takes for something else than the thing."""
        for name, entry in self._entries.items():
            if not name.startswith("metadata/") or not name.endswith(".config"):
                continue
            found = _MODIFIER.search(self.read(entry.filename))
            if found is not None:
                word = next(group for group in found.groups() if group).decode()
                raise ValueError(
                    f"its {entry.filename} makes a mesh a {word}, which is no part of the thing; "
                    "export it without"
                )


class _Document:
    """The models of a package, read when they are named."""

    def __init__(self, package: _Package, root: str) -> None:
        self._package = package
        self._models: dict[str, _Model] = {}
        self._meshes: dict[_Key, tuple[NDArray[np.float64], NDArray[np.int32]]] = {}
        self._shown: set[_Key] = set()
        self._held_up: list[str] = []
        self._n_placed = self._n_triangles = 0
        self._root_name = root
        self._root = self._model(root)
        self.unit = self._root.unit
        if not self._root.has_build:
            raise ValueError(f"{root}: it has no build, which says what is where; is it cut off?")

    def parts(self) -> Iterator[Part]:
        """Yield a part for each mesh that the build places, in its order."""
        for key, matrix, label in self._root.items:
            waiting = [(key, matrix, 0)]
            while waiting:
                key, matrix, depth = waiting.pop()
                self._n_placed += 1
                if self._n_placed + len(waiting) > _MOST_PLACED:
                    raise ValueError(f"it places more than {_MOST_PLACED:,} objects")
                if depth > _DEEPEST:
                    raise ValueError("its objects hold each other in a circle")
                found = self._object(key)
                self._shown.add(key)
                if found.kind not in _SOLID:
                    self._held_up.append(found.name or key[1])
                    continue
                if found.has_mesh:
                    yield self._part(key, found, matrix, "" if depth else label)
                waiting.extend(
                    (inner, matrix @ placed, depth + 1)
                    for inner, placed in reversed(found.components)
                )

    def what_is_not_placed(self) -> tuple[str, ...]:
        """Return sentences on what the build leaves out."""
        notes = []
        hidden = [
            found.name or number_
            for model_name, model in self._models.items()
            for number_, found in model.objects.items()
            if (model_name, number_) not in self._shown and found.has_mesh
        ]
        if hidden:
            notes.append(f"{len(hidden)} of its objects are not in its build, first {hidden[0]!r}")
        if self._held_up:
            notes.append(
                f"{len(self._held_up)} of its objects only hold others up and are not read, first "
                f"{self._held_up[0]!r}"
            )
        return tuple(notes)

    def _model(self, name: str) -> _Model:
        if name not in self._models:
            model = _read_model(self._package.read(name), name)
            if self._models and model.unit != self._models[self._root_name].unit:
                raise ValueError(
                    f"{name}: its unit is {model.unit}, that of {self._root_name} "
                    f"{self._models[self._root_name].unit}; export it in one unit"
                )
            self._models[name] = model
        return self._models[name]

    def _object(self, key: _Key) -> _Object:
        name, number_ = key
        found = self._model(name).objects.get(number_)
        if found is None:
            raise ValueError(f"{name}: it names object {number_!r}, and there is none")
        return found

    def _part(self, key: _Key, found: _Object, matrix: NDArray[np.float64], label: str) -> Part:
        if key not in self._meshes:
            self._meshes[key] = _mesh(found, key)
        vertices, faces = self._meshes[key]
        self._n_triangles += len(faces)
        if self._n_triangles > _MOST_TRIANGLES:
            raise ValueError(f"it places more than {_MOST_TRIANGLES:,} triangles")
        material, rgba = ("", None) if found.is_mixed else self._material(key[0], found.property)
        return Part(found.name or label, *move(vertices, faces, matrix), material, rgba)

    def _material(self, model: str, stated: tuple[str, str]) -> tuple[str, _Rgba | None]:
        group, index = stated
        bases = self._models[model].materials.get(group, [])
        return bases[int(index)] if index.isdecimal() and int(index) < len(bases) else ("", None)


def _mesh(found: _Object, key: _Key) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    vertices = np.array(found.coordinates, np.float64).reshape(-1, 3)
    corners = np.array(found.corners, np.int64)
    outside = np.flatnonzero((corners < 0) | (corners >= len(vertices)))
    if len(outside):
        raise ValueError(
            f"{key[0]}, line {found.line}: object {found.name or key[1]!r}: triangle "
            f"{outside[0] // 3} names vertex {corners[outside[0]]} of {len(vertices)} from 0"
        )
    return vertices, corners.astype(np.int32).reshape(-1, 3)


# --- XML --------------------------------------------------------------------------------------


def _parse_xml(
    content: bytes,
    name: str,
    start: Callable[[str, dict[str, str], int], None],
    end: Callable[[str], None],
    prefix: Callable[[str | None, str], None],
) -> None:
    """Tell of the elements of a file one after another.

    Parameters
    ----------
    content : bytes
        The file.
    name : str
        What it is called.
    start : callable
        Told of each element: "schema name", its attributes, and its line.
    end : callable
        Told of its end.
    prefix : callable
        Told what a prefix stands for.

    Raises
    ------
    ValueError
        If it is not XML; what these raise is told with the line.
    """
    parser = expat.ParserCreate(namespace_separator=" ")

    def refuse(*_: object) -> None:
        raise ValueError("it has a document type, as no 3MF may; export it again")

    parser.StartDoctypeDeclHandler = refuse
    parser.StartNamespaceDeclHandler = prefix
    parser.StartElementHandler = lambda element, said: start(
        element, said, parser.CurrentLineNumber
    )
    parser.EndElementHandler = end
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, LookupError) as error:  # the latter of an encoding
        raise ValueError(f"{name}: its XML cannot be read: {error}") from error
    except ValueError as error:
        raise ValueError(f"{name}, line {parser.CurrentLineNumber}: {error}") from None


class _ModelReader:
    """What a model file says, element by element."""

    def __init__(self, name: str) -> None:
        self.model = _Model()
        self._name = name
        self._schemas: dict[str, str] = {}
        self._required: list[str] = []
        self._within: list[str] = []
        self._skipped = 0  # how deep in something without bearing on where a surface is
        self._object = _Object("", "", 0, ("", ""))
        self._bases: list[tuple[str, _Rgba | None]] = []
        self._line = 0

    def prefix(self, word: str | None, schema: str) -> None:
        """Take what a prefix stands for."""
        self._schemas.setdefault(word or "", schema)

    def start(self, element: str, said: dict[str, str], line: int) -> None:
        """Take the beginning of an element."""
        self._line = line
        schema, _, tag = element.rpartition(" ")
        if self._skipped:
            self._skipped += 1
            return
        where = self._within[-1] if self._within else ""
        taken = self._take(tag, schema, where, said)
        if taken:
            self._within.append(tag)
        else:
            self._skipped = 1

    def end(self, _: str) -> None:
        """Take the end of an element."""
        if self._skipped:
            self._skipped -= 1
            return
        self._within.pop()

    def _take(self, tag: str, schema: str, where: str, said: dict[str, str]) -> bool:
        """Take an element of the core; tell whether what is in it is to be looked at."""
        if not where:
            if tag != "model" or schema != _CORE:
                raise ValueError(f"it is {tag!r} of {schema or 'no schema'!r}, not a 3MF model")
            self._take_model(said)
            return True
        is_core = schema == _CORE
        if where == "object" and not (is_core and tag in ("mesh", "components", "metadatagroup")):
            raise ValueError(
                f"object {self._object.name!r} is a {tag}, which is not read; export a mesh"
            )
        if where == "mesh" and not (tag == "trianglesets" or (is_core and tag in _OF_A_MESH)):
            raise ValueError(
                f"object {self._object.name!r} has a {tag}, which is not read; export a mesh"
            )
        if not is_core:
            return False
        if (where, tag) in _CONTAINERS:
            self._object.has_mesh |= tag == "mesh"
            self.model.has_build |= tag == "build"
            return True
        take = _TAKEN.get((where, tag))
        if take is None:
            return False
        take(self, said)
        return True

    def _take_model(self, said: dict[str, str]) -> None:
        self.model.unit = said.get("unit", "millimeter")
        if self.model.unit not in _UNITS_M:
            raise ValueError(
                f"its unit is {self.model.unit!r}, expected one of {', '.join(_UNITS_M)}"
            )
        self._required = said.get("requiredextensions", "").split()

    def refuse_extensions(self) -> None:
        """Refuse a model that needs an extension that is not read, by its prefix."""
        for prefix in self._required:
            schema = self._schemas.get(prefix, prefix)
            if schema not in _HARMLESS:
                raise ValueError(
                    f"{self._name}: it needs the extension {schema!r}, which is not read here; "
                    "export it without"
                )

    def _take_object(self, said: dict[str, str]) -> None:
        name = said.get("name") or said.get("partnumber") or ""
        self._object = _Object(
            said.get("type", "model"),
            name,
            self._line,
            (said.get("pid", ""), said.get("pindex", "0")),
        )
        number_ = _stated(said, "id", "an object")
        if number_ in self.model.objects:
            raise ValueError(f"object {number_} stands there twice")
        self.model.objects[number_] = self._object

    def _take_vertex(self, said: dict[str, str]) -> None:
        self._object.coordinates += [number(_stated(said, axis, "a vertex")) for axis in "xyz"]

    def _take_triangle(self, said: dict[str, str]) -> None:
        self._object.corners += [
            whole(_stated(said, corner, "a triangle")) for corner in ("v1", "v2", "v3")
        ]
        self._object.is_mixed |= "p1" in said

    def _take_component(self, said: dict[str, str]) -> None:
        self._object.components.append((self._key(said, "a component"), _matrix(said)))

    def _take_item(self, said: dict[str, str]) -> None:
        self.model.items.append(
            (self._key(said, "an item"), _matrix(said), said.get("partnumber", ""))
        )

    def _take_bases(self, said: dict[str, str]) -> None:
        self._bases = self.model.materials.setdefault(_stated(said, "id", "a material"), [])

    def _take_base(self, said: dict[str, str]) -> None:
        self._bases.append((said.get("name", ""), _colour(said.get("displaycolor", ""))))

    def _key(self, said: dict[str, str], what: str) -> _Key:
        path = said.get(f"{_PRODUCTION} path")
        file = self._name if path is None else _normal("/", path)
        return file, _stated(said, "objectid", what)


#: Elements that hold others, by what holds them.
_CONTAINERS = (
    ("model", "resources"),
    ("model", "build"),
    ("object", "mesh"),
    ("object", "components"),
    ("mesh", "vertices"),
    ("mesh", "triangles"),
)
_OF_A_MESH = ("vertices", "triangles")

#: The others: what holds them, and what takes them.
_TAKEN = {
    ("resources", "object"): _ModelReader._take_object,
    ("resources", "basematerials"): _ModelReader._take_bases,
    ("basematerials", "base"): _ModelReader._take_base,
    ("vertices", "vertex"): _ModelReader._take_vertex,
    ("triangles", "triangle"): _ModelReader._take_triangle,
    ("components", "component"): _ModelReader._take_component,
    ("build", "item"): _ModelReader._take_item,
}


def _read_model(content: bytes, name: str) -> _Model:
    reader = _ModelReader(name)
    _parse_xml(content, name, reader.start, reader.end, reader.prefix)
    reader.refuse_extensions()
    return reader.model


def _stated(said: dict[str, str], key: str, what: str) -> str:
    if key not in said:
        raise ValueError(f"{what} has no {key}; export it again")
    return said[key]


def _matrix(said: dict[str, str]) -> NDArray[np.float64]:
    """Return the matrix (4, 4) of a transform: the file has it by rows that follow a point."""
    matrix = np.eye(4)
    if "transform" in said:
        values = [number(word) for word in said["transform"].split()]
        if len(values) != 12 or not all(math.isfinite(value) for value in values):
            raise ValueError(f"a transform of {said['transform'][:60]!r}, expected 12 numbers")
        matrix[:3] = np.array(values).reshape(4, 3).T
    return matrix


def _colour(text: str) -> _Rgba | None:
    """Return the colour of "#RRGGBB" or "#RRGGBBAA", as pictures show it."""
    match = re.fullmatch(r"#([0-9A-Fa-f]{6})([0-9A-Fa-f]{2})?", text.strip())
    if match is None:
        return None
    red, green, blue, opacity = bytes.fromhex(match[1] + (match[2] or "FF"))
    return red / 255.0, green / 255.0, blue / 255.0, opacity / 255.0


def _normal(folder: str, target: str) -> str:
    """Return a name in a package without "." and "..", from its root."""
    return posixpath.normpath(posixpath.join(folder, target)).lstrip("/")
