"""Blocks of ``/VTKHDF``: meshes and points, frame after frame, as ParaView and VTK read them.

No numbers stand on points or triangles: of a collection with some, VTK 9.7 shows the first frame
only. Times are a link into ``/hybridve``.

References
----------
VTK file formats, section "VTKHDF format", version 2.2 of the format.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.report.result_file import STORED

_VERSION = (2, 2)

#: The kinds of cells of a PolyData, in VTK's order; collision points are vertices.
_CELLS = ("Vertices", "Lines", "Polygons", "Strips")
_POLYGONS = 2

_CHUNK_ROWS = 16_384


@dataclass(frozen=True, slots=True, eq=False)
class FramePoints:
    """Collision points of one object in some frames, sorted by frame.

    Attributes
    ----------
    n_points : (F,) int64
        How many each frame has.
    xyz_m : (P, 3) float32
        Metres about the report's local origin.
    triangle : (P,) uint32
        The triangle that each lies on.
    """

    n_points: NDArray[np.int64]
    xyz_m: NDArray[np.float32]
    triangle: NDArray[np.uint32]


@dataclass(frozen=True, slots=True, eq=False)
class FrameShapes:
    """Lines or triangles of one frame.

    Attributes
    ----------
    points_m : (V, 3) float64
        Metres about the file's local origin.
    cells : (N, K) int32
        Numbers of the points of each.
    """

    points_m: NDArray[np.float64]
    cells: NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class Collection:
    """The root of a collection, which blocks are added to."""

    root: h5py.Group
    assembly: h5py.Group

    def block(self, label: str, name: str) -> h5py.Group:
        """Return a new block, PolyData, of an object of this name."""
        block = self.root.create_group(label)
        block.attrs["Index"] = len(self.assembly)
        block.attrs["object"] = name
        declare(block, "PolyData")
        self.assembly[label] = h5py.SoftLink(f"/VTKHDF/{label}")
        return block


def make_collection(file: h5py.File) -> Collection:
    """Return the new and empty collection of a file."""
    root = file.create_group("VTKHDF", track_order=True)
    declare(root, "PartitionedDataSetCollection")
    return Collection(root, root.create_group("Assembly", track_order=True))


def labels_of(names: Sequence[str]) -> list[str]:
    """Return names that VTK takes for nodes of an assembly, all different."""
    labels: list[str] = []
    taken: set[str] = {"Assembly"}
    for name in names:
        label = plain = re.sub(r"^(?![A-Za-z_])", "_", re.sub(r"[^A-Za-z0-9_.-]", "_", name))
        number = 1
        while {label, f"{label}_points"} & taken:
            number += 1
            label = f"{plain}.{number}"
        taken |= {label, f"{label}_points"}
        labels.append(label)
    return labels


def declare(group: h5py.Group, kind: str) -> None:
    """Say that a group is of a kind of VTK's."""
    group.attrs["Version"] = _VERSION
    # VTK reads a fixed-length ASCII string only.
    group.attrs.create("Type", kind.encode(), dtype=h5py.string_dtype("ascii", len(kind)))


def add_surface(
    block: h5py.Group,
    faces: NDArray[np.int32],
    vertices_at: Callable[[int], NDArray[np.floating]],
    shown: NDArray[np.int64],
) -> None:
    """Add a mesh that every frame shows where it stood.

    `vertices_at` gives the vertices (V, 3) in a frame, metres about the file's local origin.
    `shown` (F,) names for each frame one whose vertices it shows, for all frames in which they are
    the same the same one; -1 in a frame that shows nothing, for which there is a second part that
    has nothing.
    """
    n_frames, n_triangles = len(shown), len(faces)
    is_there = shown >= 0
    rows, place = np.unique(shown[is_there], return_inverse=True)
    points = _growing(block, "Points", (3,), np.float32)
    n_vertices = 0
    for row in rows.tolist():
        vertices_m = vertices_at(row)
        n_vertices = len(vertices_m)
        _append(points, vertices_m.astype(np.float32))
    points_before = np.zeros(n_frames, np.int64)
    points_before[is_there] = n_vertices * place
    cells_before = np.zeros((n_frames, len(_CELLS)), np.int64)
    every = np.ones(n_frames, np.int64)
    if not is_there.all():
        every = np.asarray(np.arange(max(n_frames, 2)) == 0, np.int64)
    _store(block, "NumberOfPoints", n_vertices * every)
    for number, kind in enumerate(_CELLS):
        n_cells = n_triangles if number == _POLYGONS else 0
        _store(block, f"{kind}/NumberOfCells", n_cells * every)
        _store(block, f"{kind}/NumberOfConnectivityIds", 3 * n_cells * every)
        offsets = 3 * np.arange(n_cells + 1, dtype=np.int64)
        if not is_there.all():
            offsets = np.append(offsets, 0)
            cells_before[~is_there, number] = n_cells
        _store(block, f"{kind}/Offsets", offsets)
        corners = faces.ravel() if n_cells else faces.ravel()[:0]
        _append(_growing(block, f"{kind}/Connectivity", (), np.int64), corners.astype(np.int64))
    steps = _add_steps(block, n_frames)
    _store(steps, "PartOffsets", np.asarray(~is_there, np.int64))
    _store(steps, "PointOffsets", points_before)
    _store(steps, "CellOffsets", cells_before)
    _store(steps, "ConnectivityIdOffsets", np.zeros((n_frames, len(_CELLS)), np.int64))


def add_points(block: h5py.Group, parts: Iterable[FramePoints]) -> None:
    """Add points, some frames at a time."""
    points = _growing(block, "Points", (3,), np.float32)
    connectivity = _growing(block, "Vertices/Connectivity", (), np.int64)
    counts = [np.zeros(0, np.int64)]
    for part in parts:
        counts.append(part.n_points)
        _append(points, part.xyz_m)
        starts = np.repeat(_before(part.n_points), part.n_points)
        _append(connectivity, np.arange(len(starts)) - starts)  # 0, 1, ... within each frame
    n_points = np.concatenate(counts)
    # One poly-vertex holds all points of a frame; a frame without points has no cell.
    n_cells = (n_points > 0).astype(np.int64)
    none = np.zeros_like(n_points)
    offsets = np.column_stack([none, n_points])[
        np.column_stack([np.ones(len(n_points), np.bool_), n_points > 0])
    ]
    _add_frames(block, "Vertices", n_points, n_cells, n_points, offsets)


def add_shapes(
    block: h5py.Group, kind: Literal["Lines", "Polygons"], parts: Iterable[FrameShapes]
) -> None:
    """Add lines or triangles that are others in each frame, a frame after another."""
    points = _growing(block, "Points", (3,), np.float32)
    connectivity = _growing(block, f"{kind}/Connectivity", (), np.int64)
    n_points, n_cells, n_ids, offsets = [], [], [], [np.zeros(0, np.int64)]
    for part in parts:
        n_points.append(len(part.points_m))
        n_cells.append(len(part.cells))
        n_ids.append(part.cells.size)
        offsets.append(part.cells.shape[1] * np.arange(len(part.cells) + 1, dtype=np.int64))
        _append(points, part.points_m.astype(np.float32))
        _append(connectivity, part.cells.ravel().astype(np.int64))
    _add_frames(
        block,
        kind,
        np.array(n_points, np.int64),
        np.array(n_cells, np.int64),
        np.array(n_ids, np.int64),
        np.concatenate(offsets),
    )


def _add_frames(
    block: h5py.Group,
    kind: str,
    n_points: NDArray[np.int64],
    n_cells: NDArray[np.int64],
    n_ids: NDArray[np.int64],
    offsets: NDArray[np.int64],
) -> None:
    """Add how much each frame (F,) has of cells of one kind, whose points and ids stand there."""
    none = np.zeros_like(n_points)
    _store(block, "NumberOfPoints", n_points)
    for one in _CELLS:
        _store(block, f"{one}/NumberOfCells", n_cells if one == kind else none)
        _store(block, f"{one}/NumberOfConnectivityIds", n_ids if one == kind else none)
        _store(block, f"{one}/Offsets", offsets if one == kind else none)
        if one != kind:
            _growing(block, f"{one}/Connectivity", (), np.int64)
    steps = _add_steps(block, len(n_points))
    _store(steps, "PartOffsets", np.arange(len(n_points), dtype=np.int64))
    _store(steps, "PointOffsets", _before(n_points))
    _store(steps, "CellOffsets", _only(kind, _before(n_cells)))
    _store(steps, "ConnectivityIdOffsets", _only(kind, _before(n_ids)))


def _add_steps(block: h5py.Group, n_frames: int) -> h5py.Group:
    steps = block.create_group("Steps")
    steps.attrs["NSteps"] = n_frames
    steps["Values"] = h5py.SoftLink("/hybridve/frames/time_s")
    _store(steps, "NumberOfParts", np.ones(n_frames, np.int64))
    return steps


def _only(kind: str, column: NDArray[np.int64]) -> NDArray[np.int64]:
    table = np.zeros((len(column), len(_CELLS)), np.int64)
    table[:, _CELLS.index(kind)] = column
    return table


def _before(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    return (np.cumsum(counts) - counts).astype(np.int64)


def _growing(group: h5py.Group, name: str, row: tuple[int, ...], dtype: Any) -> h5py.Dataset:
    return group.create_dataset(
        name, (0, *row), dtype, chunks=(_CHUNK_ROWS, *row), maxshape=(None, *row), **STORED
    )


def _append(dataset: h5py.Dataset, rows: NDArray[Any]) -> None:
    start = len(dataset)
    dataset.resize(start + len(rows), axis=0)
    dataset[start:] = rows


def _store(group: h5py.Group, name: str, data: NDArray[np.int64]) -> None:
    group.create_dataset(name, data=data, chunks=True, **STORED)
