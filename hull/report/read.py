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
from hybridve.hull.report.result_file import reading
from hybridve.hull.report.schema import (
    FRAME_COLUMNS,
    OFFSET,
    TABLES,
    VERSION,
    Column,
)


@dataclass(frozen=True, slots=True, eq=False)
class ObjectColumns:
    """One object's rows, F of them.

    Attributes
    ----------
    columns : dict of arrays
        By the names of `hybridve.hull.report.schema`, (F, ...) each; a column that is not there
        was not computed.
    offset : (F + 1,) uint64
        The collision points of row f are ``offset[f]`` to ``offset[f + 1]``; see `read_points`.
    about : dict
        Attributes: the mesh, its number of triangles, the spacing of its samples.
    """

    columns: dict[str, NDArray[Any]]
    offset: NDArray[np.uint64]
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
    def n_points(self) -> NDArray[np.uint32]:
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
    stage_s : dict of (F,) float64
        Seconds of work by stage.
    objects : dict of ObjectColumns
        By name.
    """

    path: Path
    attributes: dict[str, Any]
    settings: dict[str, Any]
    rig: dict[str, Any]
    index: NDArray[np.uint32]
    time_s: NDArray[np.float64]
    reason: NDArray[np.str_]
    stage_s: dict[str, NDArray[np.float64]]
    objects: dict[str, ObjectColumns]


def read_report(path: Path) -> Report:
    """Return what a report holds, except the collision points.

    Raises
    ------
    ReportError
        If there is no such file, it is not a report, of an unknown version, or damaged.
    """
    with reading(path, "report", VERSION) as file:
        frames = _columns(file["hybridve/frames"], FRAME_COLUMNS, may_be_absent=True)
        return Report(
            path=path,
            attributes={name: _plain(value) for name, value in file.attrs.items()},
            settings=json.loads(file["hybridve/settings/configuration"].asstr()[()]),
            rig=json.loads(file["hybridve/settings/rig"].asstr()[()]),
            index=frames["index"],
            time_s=frames["time_s"],
            reason=frames["reason"],
            stage_s={
                name.removeprefix(_STAGE): seconds
                for name, seconds in frames.items()
                if name.startswith(_STAGE)
            },
            objects={
                name: ObjectColumns(
                    columns={
                        key: values
                        for table in TABLES
                        for key, values in _columns(
                            group, table.columns, may_be_absent=table.part != "contact"
                        ).items()
                    },
                    offset=group[OFFSET.name][:],
                    about={key: _plain(value) for key, value in group.attrs.items()},
                )
                for name, group in file["hybridve/objects"].items()
            },
        )


_STAGE = "stage_s/"


def _columns(
    group: h5py.Group, columns: Iterable[Column[Any]], *, may_be_absent: bool
) -> dict[str, NDArray[Any]]:
    """Return columns by name; raise KeyError if one is absent that may not be."""
    return {
        column.name: group[column.name].asstr()[:].astype(np.str_)
        if column.dtype is str
        else group[column.name][:]
        for column in columns
        if not may_be_absent or column.name in group
    }


def read_points(path: Path, name: str, row: int) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return one object's collision points of one row.

    Returns
    -------
    xyz_m : (P, 3) float32
        World frame, metres.
    triangle : (P,) uint32
        The triangle that each lies on.

    Raises
    ------
    ReportError
        As `read_report`, or if there is no such object.
    """
    with reading(path, "report", VERSION) as file:
        if f"hybridve/objects/{name}" not in file:
            known = ", ".join(file["hybridve/objects"])
            raise ReportError(f"{path}: there is no object {name!r}; it has {known}")
        points = file[f"hybridve/objects/{name}/points"]
        start, stop = (int(value) for value in points["offset"][row : row + 2])
        return points["xyz_m"][start:stop], points["triangle"][start:stop]


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    return value.tolist() if isinstance(value, np.ndarray) else value
