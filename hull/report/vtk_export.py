"""What ParaView is shown of a report on request: more than the report itself holds for it.

A VTKHDF file of its own: the CAD where it stood, by names; the collision points; the shortest way
between each object and the hull, which is there where nothing collides, too; and the hull as a
surface.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.report.read import Report
from hybridve.hull.report.result_file import writing
from hybridve.hull.report.touched import Touched
from hybridve.hull.report.vtk import MOST_SHOWN, shown_rows
from hybridve.hull.report.vtk_blocks import (
    FramePoints,
    FrameShapes,
    add_points,
    add_shapes,
    add_surface,
    labels_of,
    make_collection,
)

#: What the hull is called; an object of this name has another label.
HULL = "hull"


@dataclass(frozen=True, slots=True, eq=False)
class ShownHull:
    """The hull of one frame as triangles.

    Attributes
    ----------
    vertices_world : (V, 3) float64
        Metres.
    faces : (T, 3) int32
        Vertex numbers.
    """

    vertices_world: NDArray[np.float64]
    faces: NDArray[np.int32]


def write_vtk(
    path: Path,
    report: Report,
    origin_m: NDArray[np.float64],
    touched: Mapping[str, Touched],
    hulls: Iterable[ShownHull] | None = None,
) -> None:
    """Write what ParaView shows of a report: a block for each thing, frame after frame.

    Parameters
    ----------
    path : Path
        A .vtkhdf.
    report : Report
        Which.
    origin_m, touched
        Its local origin and objects (`hybridve.hull.report.touched.read_touched`).
    hulls : iterable of F ShownHull, optional
        The hull of each row.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    with writing(path) as file:
        file.create_dataset("hybridve/frames/time_s", data=report.time_s)
        file.attrs["local_origin_m"] = origin_m
        collection = make_collection(file)
        labels = labels_of([*touched, HULL])
        for label, (name, one) in zip(labels, touched.items(), strict=False):
            block = collection.block(label, name)
            rows = shown_rows(one.mesh, len(report.index))
            add_surface(block, one.mesh.faces, one.mesh.vertices_at, rows)
            add_points(collection.block(f"{label}_points", name), _points(one))
            add_shapes(
                collection.block(f"{label}_nearest", name), "Lines", _ways(report, name, origin_m)
            )
        if hulls is not None:
            shapes = (FrameShapes(one.vertices_world - origin_m, one.faces) for one in hulls)
            add_shapes(collection.block(labels[-1], HULL), "Polygons", shapes)


def _points(one: Touched) -> Iterator[FramePoints]:
    for row in range(len(one.offset) - 1):
        xyz_m = one.points(row, MOST_SHOWN)
        yield FramePoints(
            np.array([len(xyz_m)]), xyz_m.astype(np.float32), np.zeros(len(xyz_m), np.uint32)
        )


def _ways(report: Report, name: str, origin_m: NDArray[np.float64]) -> Iterator[FrameShapes]:
    """Yield the line between the two points that a clearance was measured between, if there is."""
    rows = report.objects[name]
    nothing = np.full((len(report.index), 3), np.nan)
    ends = [rows.get(f"clearance_on_{one}_m") for one in ("object", "hull")]
    first, last = (nothing if one is None else one - origin_m for one in ends)
    for row in range(len(report.index)):
        both = np.stack([first[row], last[row]])
        if np.isfinite(both).all():
            yield FrameShapes(both, np.array([[0, 1]], np.int32))
        else:
            yield FrameShapes(np.zeros((0, 3)), np.zeros((0, 2), np.int32))
