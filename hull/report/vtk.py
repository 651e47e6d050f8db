"""``/VTKHDF``: the same report as ParaView and VTK read it.

A report is a VTKHDF file too: a collection with, for each object, its CAD where it stood, and its
collision points frame after frame. The CAD stands there once for each place that it was at. No
numbers stand on the points: of a collection with some, VTK 9.7 shows the first frame only;
``/hybridve`` has them. Times are a link into ``/hybridve``. Unless all are asked for, the points
are a sample: every k-th of an object in a frame, at most `MOST_SHOWN`, as attributes say.

References
----------
VTK file formats, section "VTKHDF format", version 2.2 of the format.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.report.collisions import StoredMesh
from hybridve.hull.report.result_file import STORED

_VERSION = (2, 2)

#: The kinds of cells of a PolyData, in VTK's order; collision points are vertices.
_CELLS = ("Vertices", "Lines", "Polygons", "Strips")
_VERTICES, _POLYGONS = 0, 2

#: Collision points of one object in one frame that a sample has at most.
MOST_SHOWN = 500

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


def add_vtkhdf(
    file: h5py.File,
    names: Sequence[str],
    meshes: Sequence[StoredMesh],
    points: Sequence[Iterable[FramePoints]],
    *,
    is_sample: bool,
) -> None:
    """Add ``/VTKHDF`` to a report whose ``/hybridve`` is complete.

    Parameters
    ----------
    file : h5py.File
        The report.
    names, meshes : sequence of O
        The objects.
    points : sequence of O iterables of FramePoints
        Their collision points in all frames, some frames at a time.
    is_sample : bool
        Whether these are a sample.
    """
    root = file.create_group("VTKHDF", track_order=True)
    _declare(root, "PartitionedDataSetCollection")
    assembly = root.create_group("Assembly", track_order=True)
    n_frames = len(file["hybridve/frames/index"])
    index = 0
    for name, label, mesh, parts in zip(names, _labels(names), meshes, points, strict=True):
        for suffix in ("", "_points"):
            block = root.create_group(label + suffix)
            block.attrs["Index"] = index
            block.attrs["object"] = name
            _declare(block, "PolyData")
            if suffix:
                block.attrs["sample"] = is_sample
                if is_sample:
                    block.attrs["points_each_frame_at_most"] = MOST_SHOWN
                _add_points(block, parts)
            else:
                _add_surface(block, mesh, n_frames)
            assembly[label + suffix] = h5py.SoftLink(f"/VTKHDF/{label}{suffix}")
            index += 1


def _labels(names: Sequence[str]) -> list[str]:
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


def _declare(group: h5py.Group, kind: str) -> None:
    group.attrs["Version"] = _VERSION
    # VTK reads a fixed-length ASCII string only.
    group.attrs.create("Type", kind.encode(), dtype=h5py.string_dtype("ascii", len(kind)))


def _add_surface(block: h5py.Group, mesh: StoredMesh, n_frames: int) -> None:
    """Add a mesh that every frame shows where it stood; each place has its points once.

    Frames in which it is not known where it stood show a second part, which has nothing.
    """
    placement = np.broadcast_to(mesh.placement, (n_frames, 3, 4)).reshape(n_frames, 12)
    is_there = np.isfinite(placement).all(axis=1)
    _, first, place = np.unique(placement[is_there], axis=0, return_index=True, return_inverse=True)
    n_vertices, n_triangles = len(mesh.vertices_m), len(mesh.faces)
    points = _growing(block, "Points", (3,), np.float32)
    for row in np.flatnonzero(is_there)[first].tolist():
        _append(points, mesh.vertices_at(row).astype(np.float32))
    points_before = np.zeros(n_frames, np.int64)
    points_before[is_there] = n_vertices * place.ravel()
    every = np.ones(n_frames, np.int64)
    if not is_there.all():
        every = (np.arange(max(n_frames, 2)) == 0).astype(np.int64)
    _store(block, "NumberOfPoints", n_vertices * every)
    cells_before = np.zeros((n_frames, len(_CELLS)), np.int64)
    for number, kind in enumerate(_CELLS):
        n_cells = n_triangles if number == _POLYGONS else 0
        _store(block, f"{kind}/NumberOfCells", n_cells * every)
        _store(block, f"{kind}/NumberOfConnectivityIds", 3 * n_cells * every)
        offsets = 3 * np.arange(n_cells + 1, dtype=np.int64)
        if not is_there.all():
            offsets = np.append(offsets, 0)
            cells_before[~is_there, number] = n_cells
        _store(block, f"{kind}/Offsets", offsets)
        faces = mesh.faces.ravel() if n_cells else mesh.faces.ravel()[:0]
        _append(_growing(block, f"{kind}/Connectivity", (), np.int64), faces.astype(np.int64))
    steps = _add_steps(block, n_frames)
    _store(steps, "PartOffsets", np.asarray(~is_there, np.int64))
    _store(steps, "PointOffsets", points_before)
    _store(steps, "CellOffsets", cells_before)
    _store(steps, "ConnectivityIdOffsets", np.zeros((n_frames, len(_CELLS)), np.int64))


def _add_points(block: h5py.Group, parts: Iterable[FramePoints]) -> None:
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
    _store(block, "NumberOfPoints", n_points)
    for number, kind in enumerate(_CELLS):
        is_vertices = number == _VERTICES
        _store(block, f"{kind}/NumberOfCells", n_cells if is_vertices else none)
        _store(block, f"{kind}/NumberOfConnectivityIds", n_points if is_vertices else none)
        _store(block, f"{kind}/Offsets", offsets if is_vertices else none)
        if not is_vertices:
            _growing(block, f"{kind}/Connectivity", (), np.int64)
    steps = _add_steps(block, len(n_points))
    _store(steps, "PartOffsets", np.arange(len(n_points), dtype=np.int64))
    _store(steps, "PointOffsets", _before(n_points))
    _store(steps, "CellOffsets", _vertices_only(_before(n_cells)))
    _store(steps, "ConnectivityIdOffsets", _vertices_only(_before(n_points)))


def _add_steps(block: h5py.Group, n_frames: int) -> h5py.Group:
    steps = block.create_group("Steps")
    steps.attrs["NSteps"] = n_frames
    steps["Values"] = h5py.SoftLink("/hybridve/frames/time_s")
    _store(steps, "NumberOfParts", np.ones(n_frames, np.int64))
    return steps


def _vertices_only(column: NDArray[np.int64]) -> NDArray[np.int64]:
    table = np.zeros((len(column), len(_CELLS)), np.int64)
    table[:, _VERTICES] = column
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
