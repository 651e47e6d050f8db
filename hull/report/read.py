"""Reports as they are read back: known versions only, damage told in one line."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.calib.plain import read_strictly, to_plain
from hybridve.hull.agreement.record import SessionAgreement
from hybridve.hull.contact.gathering import Boxes
from hybridve.hull.contact.verdict import Facts, judge
from hybridve.hull.report.collisions import Runs, StoredMesh
from hybridve.hull.report.columns import (
    CAMERA_COLUMNS,
    FRAME_COLUMNS,
    MESH_COLUMNS,
    PATCH_COLUMNS,
    PATCH_OFFSET,
    RUN_COLUMNS,
    RUN_OFFSET,
    TABLES,
)
from hybridve.hull.report.result_file import reading
from hybridve.hull.report.schema import READ_VERSIONS, Column


@dataclass(frozen=True, slots=True, eq=False)
class ObjectColumns:
    """One object's rows, F of them.

    Attributes
    ----------
    columns : dict of arrays
        By the names of `hybridve.hull.report.columns`, (F, ...) each; a column that is not there
        was not computed. Places are in the world.
    patches : dict of arrays
        By their names without ``patches/``: one row a patch, places in the world; ``offset``: those
        of row f are ``offset[f]`` to ``offset[f + 1]``. Empty where the report has none.
    about : dict
        Attributes: the mesh, its number of triangles, the spacing of its samples.
    """

    columns: dict[str, NDArray[Any]]
    patches: dict[str, NDArray[Any]]
    about: dict[str, Any]

    def __contains__(self, name: str) -> bool:
        """Tell whether a column was computed."""
        return name in self.columns

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a column; KeyError if it was not computed."""
        return self.columns[name]

    def get(self, name: str) -> NDArray[Any] | None:
        """Return a column, or None if it was not computed."""
        return self.columns.get(name)

    @property
    def collides(self) -> NDArray[np.bool_]:
        """Whether a sample is in the hull, (F,)."""
        return self.columns["collides"]

    @property
    def verdict(self) -> NDArray[np.str_]:
        """Whether it keeps its distance, (F,); see `hybridve.hull.contact.verdict`."""
        return self.columns["verdict"]

    @property
    def why(self) -> NDArray[np.str_]:
        """Why the verdicts are what they are, where that does not go without saying, (F,)."""
        return self.columns["reason"]

    @property
    def n_points(self) -> NDArray[np.uint64]:
        """The number of collision points, (F,)."""
        return self.columns["n_points"]

    @property
    def n_triangles(self) -> NDArray[np.uint32]:
        """The number of triangles with a collision point, (F,)."""
        return self.columns["n_triangles"]

    @property
    def certificate(self) -> NDArray[np.str_]:
        """How far each verdict can be trusted, (F,)."""
        return self.columns["certificate"]

    @property
    def witness_m(self) -> NDArray[np.float64]:
        """A point of the surface in the hull, world frame, (F, 3); NaN unless it is certified."""
        return self.columns["witness_m"]

    @property
    def open_at_m(self) -> NDArray[np.float64]:
        """No disc of this diameter on the surface is in the hull, (F,); NaN unless open."""
        return self.columns["open_at_m"]

    @property
    def touches(self) -> NDArray[np.bool_]:
        """Whether a point of the surface is in the hull, sampled or certified, (F,)."""
        touches: NDArray[np.bool_] = self.collides | (self.certificate == "colliding")
        return touches

    @property
    def is_inside(self) -> NDArray[np.bool_]:
        """Whether the hull is in the closed object without touching its surface, (F,)."""
        if "depth_m" not in self.columns:
            return np.zeros(len(self.collides), np.bool_)
        is_deep: NDArray[np.bool_] = self.columns["depth_m"][:, 0] > 0.0
        return is_deep & ~self.touches

    @property
    def clashes(self) -> NDArray[np.bool_]:
        """Whether the hull touches the object or is inside it, (F,)."""
        return self.touches | self.is_inside


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """A report without its collision points, which may be many.

    Attributes
    ----------
    path : Path
        The file.
    attributes : dict
        What it says of itself: created_utc, command, engine, renderer, machine, versions.
    settings, rig : dict
        The resolved configuration and the rig.
    index : (F,) uint32
        Numbers of the frames.
    time_s : (F,) float64
        When they were recorded.
    reason : (F,) str
        Why a frame could not be evaluated; empty if it was.
    state : (F,) str
        "evaluated", "unread" or "contradictory".
    rests_on : (F,) str
        What it rests on that a frame has no hull; empty if it has.
    stage_s : dict of (F,) float64
        Seconds of work by stage.
    objects : dict of ObjectColumns
        By name.
    cameras : dict of dicts of (F,) arrays
        By name; empty for a report of version 1.
    agreement : SessionAgreement
        What the cameras say about each other in all frames together; of a report that was written
        without asking, nothing.
    """

    path: Path
    attributes: dict[str, Any]
    settings: dict[str, Any]
    rig: dict[str, Any]
    index: NDArray[np.uint32]
    time_s: NDArray[np.float64]
    reason: NDArray[np.str_]
    state: NDArray[np.str_]
    rests_on: NDArray[np.str_]
    stage_s: dict[str, NDArray[np.float64]]
    objects: dict[str, ObjectColumns]
    cameras: dict[str, dict[str, NDArray[Any]]]
    agreement: SessionAgreement


def read_report(path: Path) -> Report:
    """Return what a report holds, except the collision points.

    Raises
    ------
    ReportError
        If there is no such file, it is not a report, of an unknown version, or damaged.
    """
    with reading(path, "report", *READ_VERSIONS) as file:
        frames = _columns(file["hybridve/frames"], FRAME_COLUMNS, 0.0, may_be_absent=True)
        origin_m = local_origin_m(file)
        reason = frames["reason"]
        nothing = np.full(len(reason), "", np.str_)
        return Report(
            path=path,
            attributes={name: to_plain(value) for name, value in file.attrs.items()},
            settings=json.loads(file["hybridve/settings/configuration"].asstr()[()]),
            rig=json.loads(file["hybridve/settings/rig"].asstr()[()]),
            index=frames["index"],
            time_s=frames["time_s"],
            reason=reason,
            state=frames.get("state", np.where(reason == "", "evaluated", "unread")),
            rests_on=frames.get("rests_on", nothing),
            stage_s={
                name.removeprefix(_STAGE): seconds
                for name, seconds in frames.items()
                if name.startswith(_STAGE)
            },
            objects={
                name: _object(group, origin_m, reason)
                for name, group in file["hybridve/objects"].items()
            },
            cameras={
                name: _columns(group, CAMERA_COLUMNS, 0.0, may_be_absent=True)
                for name, group in file.get("hybridve/cameras", {}).items()
            },
            agreement=_agreement(file, path),
        )


def _agreement(file: h5py.File, path: Path) -> SessionAgreement:
    if "hybridve/settings/agreement" not in file:
        return SessionAgreement()
    told = json.loads(file["hybridve/settings/agreement"].asstr()[()])
    return read_strictly(SessionAgreement, told, f"{path}: agreement")


def local_origin_m(file: h5py.File) -> NDArray[np.float64]:
    """Return where the places of a file begin; those of version 1 are in the world."""
    if "hybridve/settings/local_origin_m" not in file:
        return np.zeros(3)
    return np.asarray(file["hybridve/settings/local_origin_m"][:], np.float64)


def _object(
    group: h5py.Group, origin_m: NDArray[np.float64], reason: NDArray[np.str_]
) -> ObjectColumns:
    columns = {
        key: values
        for table in TABLES
        for key, values in _columns(group, table.columns, origin_m, may_be_absent=True).items()
    }
    patches: dict[str, NDArray[Any]] = {}
    if PATCH_OFFSET.name in group:
        patches = {
            key.removeprefix("patches/"): values
            for key, values in _columns(
                group, (PATCH_OFFSET, *PATCH_COLUMNS), origin_m, may_be_absent=False
            ).items()
        }
    about = {key: to_plain(value) for key, value in group.attrs.items()}
    found = ObjectColumns(columns, patches, about)
    for name in ("collides", "n_points", "n_triangles", "certificate", "witness_m", "open_at_m"):
        found[name]  # a report without these is damaged
    if "verdict" not in columns:
        verdict, why = _judged(found, reason)
        columns |= {"verdict": verdict, "reason": why}
    return found


def _judged(
    rows: ObjectColumns, reason: NDArray[np.str_]
) -> tuple[NDArray[np.str_], NDArray[np.str_]]:
    """Return the verdicts and reasons (F,) of a report of version 1, which has none."""
    unknown = np.full((len(reason), 2), np.nan)
    clearance_m = rows.columns.get("clearance_m", unknown)
    found = [
        ("unknown", str(why))
        if why
        else judge(
            Facts(
                bool(rows.touches[row]),
                bool(rows.is_inside[row]),
                bool(rows.about.get("closed", False)),
                str(rows.certificate[row]),
                float(rows.open_at_m[row]),
                (float(clearance_m[row, 0]), float(clearance_m[row, 1])),
                float(rows.about.get("required_clearance_m", 0.0)),
            )
        )
        for row, why in enumerate(reason)
    ]
    verdicts, reasons = zip(*found, strict=True) if found else ((), ())
    return np.array(verdicts, np.str_), np.array(reasons, np.str_)


_STAGE = "stage_s/"


def _columns(
    group: h5py.Group,
    columns: Iterable[Column[Any]],
    origin_m: NDArray[np.float64] | float,
    *,
    may_be_absent: bool,
) -> dict[str, NDArray[Any]]:
    """Return columns by name, places in the world; raise KeyError if one is absent that may not."""
    found = {}
    for column in columns:
        if may_be_absent and column.name not in group:
            continue
        if column.dtype is str:
            found[column.name] = group[column.name].asstr()[:].astype(np.str_)
        elif column.is_place:
            found[column.name] = group[column.name][:] + origin_m
        else:
            found[column.name] = group[column.name][:]
    return found


def read_points(path: Path, name: str, row: int) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """Return one object's collision points of one row.

    Returns
    -------
    xyz_m : (P, 3) float64
        World frame, metres; of a report of version 1 rounded to single precision.
    triangle : (P,) uint32
        The triangle that each lies on.

    Raises
    ------
    ReportError
        As `read_report`, or if there is no such object.
    """
    with reading(path, "report", *READ_VERSIONS) as file:
        if f"hybridve/objects/{name}" not in file:
            known = ", ".join(file["hybridve/objects"])
            raise ReportError(f"{path}: there is no object {name!r}; it has {known}")
        group = file[f"hybridve/objects/{name}"]
        if RUN_OFFSET.name not in group:
            start, stop = (int(value) for value in group["points/offset"][row : row + 2])
            return (
                group["points/xyz_m"][start:stop].astype(np.float64),
                group["points/triangle"][start:stop],
            )
        start, stop = (int(value) for value in group[RUN_OFFSET.name][row : row + 2])
        runs = Runs(*(group[column.name][start:stop] for column in RUN_COLUMNS))
        xyz_m, triangle = read_mesh(group).points(runs, row)
        return xyz_m + local_origin_m(file), triangle


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """Where an object stood.

    Attributes
    ----------
    world_from_part : (1 or F, 3, 4) float64
        From the frame of its mesh to the world, metres; of one that moves a row a frame, NaN where
        that is not known.
    box : Boxes or None
        The box around its mesh, in the frame of the mesh; None in a report of version 1, which
        holds no mesh.
    """

    world_from_part: NDArray[np.float64]
    box: Boxes | None

    def world_from_part_at(self, row: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return it in some rows of the report, (N, 3, 4)."""
        moves = len(self.world_from_part) > 1
        return self.world_from_part[row if moves else np.zeros(len(row), np.int64)]


def read_standing(path: Path) -> dict[str, Standing]:
    """Return where the objects of a report stood, by name.

    Raises
    ------
    ReportError
        As `read_report`.
    """
    with reading(path, "report", *READ_VERSIONS) as file:
        origin_m = local_origin_m(file)
        return {
            name: _standing(group, origin_m) for name, group in file["hybridve/objects"].items()
        }


def _standing(group: h5py.Group, origin_m: NDArray[np.float64]) -> Standing:
    if "mesh/placement" not in group:
        return Standing(np.eye(3, 4)[None], None)
    world_from_part = group["mesh/placement"][:]
    world_from_part[:, :, 3] += origin_m
    used_m = group["mesh/vertices_m"][:][group["mesh/faces"][:].ravel()]
    return Standing(world_from_part, Boxes(used_m, used_m).around())


def read_mesh(group: h5py.Group) -> StoredMesh:
    """Return the mesh that stands in an object's group."""
    return StoredMesh(*(group[column.name][:] for column in MESH_COLUMNS))
