"""``/VTKHDF``: the same collision points as ParaView and VTK read them.

A report is a VTKHDF file too: one temporal PolyData whose vertices are the collision points of all
objects, frame after frame, with the number of the object and of the triangle on each. (A collection
with one PolyData an object would be closer to ``/hybridve``, but VTK 9.7 shows its first frame
only.) Times are a link into ``/hybridve``; the points stand here a second time, since VTK wants
those of all objects side by side.

References
----------
VTK file formats, section "VTKHDF format", version 2.2 of the format.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

_VERSION = (2, 2)

#: The kinds of cells of a PolyData, in VTK's order; collision points are vertices.
_CELLS = ("Vertices", "Lines", "Polygons", "Strips")

_STORED = {
    "compression": "gzip",
    "compression_opts": 1,
    "shuffle": True,
    "fletcher32": True,
    "track_times": False,
}

_CHUNK_POINTS = 16_384


@dataclass(frozen=True, slots=True, eq=False)
class FramePoints:
    """Collision points of some frames, sorted by frame.

    Attributes
    ----------
    n_points : (F,) int64
        How many each frame has, over all objects.
    xyz_m : (P, 3) float32
        World frame, metres.
    triangle, object_number : (P,) uint32
        The triangle and the object that each lies on.
    """

    n_points: NDArray[np.int64]
    xyz_m: NDArray[np.float32]
    triangle: NDArray[np.uint32]
    object_number: NDArray[np.uint32]


def by_frame(
    n_points: list[NDArray[np.uint32]],
    xyz_m: list[NDArray[np.float32]],
    triangle: list[NDArray[np.uint32]],
) -> FramePoints:
    """Return the points of several objects, each sorted by frame, sorted by frame together.

    Parameters
    ----------
    n_points : list of (F,) uint32
        Per object, how many points each frame has.
    xyz_m, triangle : list of (P_o, 3) float32 and (P_o,) uint32
        Per object, its points and their triangles.
    """
    frame = np.concatenate([np.repeat(np.arange(len(counts)), counts) for counts in n_points])
    number = np.repeat(np.arange(len(n_points), dtype=np.uint32), [len(t) for t in triangle])
    order = np.argsort(frame, kind="stable")
    return FramePoints(
        np.sum(n_points, axis=0, dtype=np.int64),
        np.concatenate(xyz_m)[order],
        np.concatenate(triangle)[order],
        number[order],
    )


def add_vtkhdf(file: h5py.File, parts: Iterable[FramePoints]) -> None:
    """Add ``/VTKHDF`` to a report whose ``/hybridve`` is complete.

    Parameters
    ----------
    file : h5py.File
        The report.
    parts : iterable of FramePoints
        The collision points of all frames, some frames at a time.
    """
    root = file.create_group("VTKHDF")
    root.attrs["Version"] = _VERSION
    # VTK reads a fixed-length ASCII string only.
    root.attrs.create("Type", b"PolyData", dtype=h5py.string_dtype("ascii", len("PolyData")))
    points = _growing(root, "Points", (3,), np.float32)
    triangle = _growing(root, "PointData/triangle", (), np.uint32)
    number = _growing(root, "PointData/object", (), np.uint32)
    connectivity = _growing(root, "Vertices/Connectivity", (), np.int64)
    counts = [np.zeros(0, np.int64)]
    for part in parts:
        counts.append(part.n_points)
        _append(points, part.xyz_m)
        _append(triangle, part.triangle)
        _append(number, part.object_number)
        starts = np.repeat(_before(part.n_points), part.n_points)
        _append(connectivity, np.arange(len(starts)) - starts)  # 0, 1, ... within each frame

    n_points = np.concatenate(counts)
    # One poly-vertex holds all points of a frame; a frame without points has no cell.
    n_cells = (n_points > 0).astype(np.int64)
    none = np.zeros_like(n_points)
    offsets = np.column_stack([none, n_points])[
        np.column_stack([np.ones(len(n_points), np.bool_), n_points > 0])
    ]
    _store(root, "NumberOfPoints", n_points)
    for kind in _CELLS:
        is_vertices = kind == "Vertices"
        _store(root, f"{kind}/NumberOfCells", n_cells if is_vertices else none)
        _store(root, f"{kind}/NumberOfConnectivityIds", n_points if is_vertices else none)
        _store(root, f"{kind}/Offsets", offsets if is_vertices else none)
        if not is_vertices:
            _growing(root, f"{kind}/Connectivity", (), np.int64)

    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = len(n_points)
    steps["Values"] = h5py.SoftLink("/hybridve/frames/time_s")
    _store(steps, "PartOffsets", np.arange(len(n_points), dtype=np.int64))
    _store(steps, "NumberOfParts", np.ones_like(n_points))
    _store(steps, "PointOffsets", _before(n_points))
    _store(steps, "PointDataOffsets/triangle", _before(n_points))
    _store(steps, "PointDataOffsets/object", _before(n_points))
    _store(steps, "CellOffsets", _vertices_only(_before(n_cells)))
    _store(steps, "ConnectivityIdOffsets", _vertices_only(_before(n_points)))


def _vertices_only(column: NDArray[np.int64]) -> NDArray[np.int64]:
    table = np.zeros((len(column), len(_CELLS)), np.int64)
    table[:, 0] = column
    return table


def _before(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    return (np.cumsum(counts) - counts).astype(np.int64)


def _growing(group: h5py.Group, name: str, row: tuple[int, ...], dtype: Any) -> h5py.Dataset:
    return group.create_dataset(
        name, (0, *row), dtype, chunks=(_CHUNK_POINTS, *row), maxshape=(None, *row), **_STORED
    )


def _append(dataset: h5py.Dataset, rows: NDArray[Any]) -> None:
    start = len(dataset)
    dataset.resize(start + len(rows), axis=0)
    dataset[start:] = rows


def _store(group: h5py.Group, name: str, data: NDArray[np.int64]) -> None:
    group.create_dataset(name, data=data, chunks=True, **_STORED)
