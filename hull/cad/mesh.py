"""CAD meshes as they come from files: read, checked, never silently repaired."""

import dataclasses
import logging
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError
from hybridve.calib.files import nearly
from hybridve.hull.cad.mesh_cache import find_meshes, keep_meshes, mesh_key
from hybridve.hull.cad.part import Contents, Part, Up, join_parts
from hybridve.hull.cad.polygons import Cuts
from hybridve.hull.cad.readers import (
    FORMATS,
    NOT_READ,
    TESSELLATED,
    leans_on,
    parse,
    reader_version,
)
from hybridve.hull.cad.topology import Topology, examine_topology

_log = logging.getLogger(__name__)

#: How far triangles may be from the surface of a STEP file, unless the scene says otherwise.
TESSELLATION_M = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class CadFile:
    """A CAD file, read and checked.

    Attributes
    ----------
    path : Path
        Where it lies.
    beside : tuple of Path
        The files that it leans on, as far as they are there.
    kind : str
        Such as ``STL``.
    parts : tuple of Part
        At least one, each with at least one triangle, in the file's order, unit and axes.
    topologies : tuple of Topology
        What the edges of each part say.
    unit : str
        What the file says its unit is; empty if its kind does not say.
    unit_m : float or None
        That unit in metres; None if the file does not say.
    up : {"x", "y", "z"}
        The axis that points up by the file, or by the standard of its kind.
    tessellation_m : float or None
        How far the triangles were asked to be from the surface they stand for at most; None if the
        file is made of triangles or polygons. How far they are is said by each part.
    notes : tuple of str
        What the file holds besides, or leaves open; each a sentence.
    """

    path: Path
    beside: tuple[Path, ...]
    kind: str
    parts: tuple[Part, ...]
    topologies: tuple[Topology, ...]
    unit: str
    unit_m: float | None
    up: Up
    tessellation_m: float | None
    notes: tuple[str, ...] = ()


def kind_of(path: Path) -> str:
    """Return what kind of CAD a file is, by its suffix.

    Raises
    ------
    SceneError
        If there is no such file, or its kind is unknown.
    """
    if not path.is_file():
        raise SceneError(f"there is no mesh file {path}{nearly(path)}")
    kind = FORMATS.get(path.suffix.lower())
    if kind is None:
        kinds = ", ".join(FORMATS)
        why = NOT_READ.get(path.suffix.lower())
        raise SceneError(
            f"{path}: a {path.suffix or 'file without suffix'} cannot be read"
            f"{f' ({why})' if why else ''}; {kinds} can: export STEP, where the program has it"
        )
    return kind


def read_cad(path: Path, *, merge: bool = False, tessellation_m: float = TESSELLATION_M) -> CadFile:
    """Return the parts in a file.

    What was read before comes from `hybridve.hull.cad.mesh_cache`, the same to the bit.

    Parameters
    ----------
    path : Path
        The file.
    merge : bool
        Take the whole file for one part.
    tessellation_m : float
        How far triangles may be from the surface of a STEP file; nothing to others.

    Raises
    ------
    SceneError
        If there is no such file, it cannot be read, its kind is unknown, or it holds no triangle or
        a coordinate that is not a finite number.
    """
    kind = kind_of(path)
    content = _read_bytes(path)
    try:
        names = leans_on(content, kind)
    except ValueError as error:
        raise SceneError(f"{path}: the file cannot be read: {error}") from error
    for name in names:
        if not _is_beside(path, name):
            raise SceneError(
                f"{path}: names the file {name[:100]!r}, which lies outside of its folder; put it "
                "beside it"
            )
    beside = {
        name: _read_bytes(path.parent / name) for name in names if _is_file(path.parent / name)
    }
    how = f"{tessellation_m if kind in TESSELLATED else None} {'merge' if merge else 'split'}"
    reader = reader_version(kind)
    key = None
    if reader is not None:
        stamped = (f"{name} {name in beside} ".encode() + beside.get(name, b"") for name in names)
        key = mesh_key(content, kind, reader, how, *stamped)
    found = None if key is None else _find(key)
    if found is None:
        contents = _parse(content, kind, path, beside, tessellation_m)
        parts = (join_parts(contents.parts),) if merge else contents.parts
        for part in parts:
            label = f"{path}: part {part.name!r}" if len(parts) > 1 else str(path)
            check_mesh(part.vertices, part.faces, label)
        topologies = tuple(examine_topology(part.vertices, part.faces) for part in parts)
        if all(len(part.faces) == t.n_zero_area for part, t in zip(parts, topologies, strict=True)):
            raise SceneError(f"{path}: none of its triangles has an area; export it again")
        _refuse_what_may_be_cut_off(path, contents, topologies)
        contents = dataclasses.replace(contents, parts=parts)
        if key is not None:
            _keep(key, contents, topologies)
    else:
        contents, topologies = found
    for part, topology in zip(contents.parts, topologies, strict=True):
        _log_flaws(path, part, topology)
    notes = contents.notes + _open_without_count(kind, topologies)
    for note in notes:
        _log.warning("%s: %s", path, note)
    return CadFile(
        path=path,
        beside=tuple(path.parent / name for name in beside),
        kind=kind,
        parts=contents.parts,
        topologies=topologies,
        unit=contents.unit,
        unit_m=contents.unit_m,
        up=contents.up,
        tessellation_m=tessellation_m if kind in TESSELLATED else None,
        notes=notes,
    )


def _is_beside(path: Path, name: str) -> bool:
    """Tell whether a file that a mesh names lies in its folder or below it, links followed."""
    try:
        folder = path.parent.resolve()
        return (path.parent / name).resolve().is_relative_to(folder)
    except (OSError, ValueError, RuntimeError):
        return False


def _is_file(path: Path) -> bool:
    """Tell whether there is a file; a damaged file may name what no file can be called."""
    try:
        return path.is_file()
    except OSError:
        return False


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path}: the file cannot be read: {error.strerror}") from error


def _parse(
    content: bytes, kind: str, path: Path, beside: dict[str, bytes], tessellation_m: float
) -> Contents:
    try:
        contents = parse(content, kind, beside, tessellation_m)
    except ValueError as error:
        raise SceneError(f"{path}: the file cannot be read: {error}") from error
    except ImportError as error:
        raise SceneError(
            f"{path}: {kind} cannot be read without the package {error.name}; install it"
        ) from error
    if not any(len(part.faces) for part in contents.parts):
        raise SceneError(f"{path}: the mesh is empty: no triangle was found in it; export it again")
    return contents


def _refuse_what_may_be_cut_off(
    path: Path, contents: Contents, topologies: tuple[Topology, ...]
) -> None:
    """Refuse a text whose last line does not end, unless none of its surfaces has an open edge.

    A face at its end may lack digits or corners then. Files that are whole and lack a line end are
    common, too; what has no open edge lacks nothing.
    """
    has_open_edges = any(t.n_open_edges and not t.closed for t in topologies)
    if not contents.is_ended and has_open_edges:
        raise SceneError(
            f"{path}: its last line does not end and its surface has open edges, as if it were cut "
            "off; if it is whole, end its last line"
        )


def _open_without_count(kind: str, topologies: tuple[Topology, ...]) -> tuple[str, ...]:
    """Return a sentence on what cannot be known of a file that does not count its faces."""
    n_open = sum(topology.n_open_edges for topology in topologies if not topology.closed)
    if kind != "OBJ" or not n_open:
        return ()
    return (
        f"its surface has {n_open} open edges, and an OBJ does not say how many faces it has: look "
        "whether it is whole",
    )


def _find(key: str) -> tuple[Contents, tuple[Topology, ...]] | None:
    found = find_meshes(key)
    if found is None:
        return None
    meshes, about = found
    try:
        parts = tuple(
            Part(
                said["name"],
                vertices,
                faces,
                said["material"],
                None if said["rgba"] is None else tuple(said["rgba"]),
                Cuts(**said["cuts"]),
                float(said["off_by_m"]),
                float(said["rounding"]),
            )
            for (vertices, faces), said in zip(meshes, about["parts"], strict=True)
        )
        topologies = tuple(Topology(**said["topology"]) for said in about["parts"])
        notes = tuple(str(note) for note in about["notes"])
        contents = Contents(parts, about["unit"], about["unit_m"], about["up"], notes=notes)
        return contents, topologies
    except (KeyError, TypeError, ValueError) as error:  # somebody else's entry
        _log.info("an entry of the cache cannot be used, read anew: %r", error)
        return None


def _keep(key: str, contents: Contents, topologies: tuple[Topology, ...]) -> None:
    about = {
        "unit": contents.unit,
        "unit_m": contents.unit_m,
        "up": contents.up,
        "notes": contents.notes,
        "parts": [
            {
                "name": part.name,
                "material": part.material,
                "rgba": part.rgba,
                "cuts": asdict(part.cuts),
                "off_by_m": part.off_by_m,
                "rounding": part.rounding,
                "topology": asdict(topology),
            }
            for part, topology in zip(contents.parts, topologies, strict=True)
        ],
    }
    keep_meshes(key, [(part.vertices, part.faces) for part in contents.parts], about)


def _log_flaws(path: Path, part: Part, topology: Topology) -> None:
    label = f"{path}: part {part.name!r}" if part.name else str(path)
    if part.cuts.n_bent:
        _log.info(
            "%s: %d of %d polygons are not flat; where they are cut into triangles moves the "
            "surface by up to %.3g of its units",
            label,
            part.cuts.n_bent,
            part.cuts.n_polygons,
            part.cuts.bent_by,
        )
    if topology.n_zero_area:
        _log.info(
            "%s: %d of %d triangles have no area", label, topology.n_zero_area, len(part.faces)
        )
    if not topology.closed:
        _log.info(
            "%s: not closed: %d open edges, %d that more than two triangles use, %d whose two "
            "triangles disagree on the outside",
            label,
            topology.n_open_edges,
            topology.n_nonmanifold_edges,
            topology.n_inconsistent_edges,
        )
    elif topology.volume is not None and topology.volume < 0:
        _log.info("%s: closed, but inside out", label)


#: Coordinates at most, in whatever unit: what is reckoned with their fourth power stays finite.
_FARTHEST = 1e18


def check_mesh(vertices: NDArray[np.float64], faces: NDArray[np.int32], label: str) -> None:
    """Look at a mesh's numbers.

    Raises
    ------
    SceneError
        If a coordinate is not finite, or beyond all measure, or a face names a vertex that is not
        there.
    """
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():
        worst = int(np.argmin(finite))
        raise SceneError(
            f"{label}: vertex {worst} is {vertices[worst].tolist()}: "
            f"{int((~finite).sum())} of {len(vertices)} vertices are not finite numbers; "
            "export it again"
        )
    most = float(np.abs(vertices).max())
    if most > _FARTHEST:
        raise SceneError(
            f"{label}: a coordinate is {most:.3g}, too large for anything that is built; export it "
            "again"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise SceneError(f"{label}: a face names a vertex that is not there; export it again")
