"""``/VTKHDF``: the same report as ParaView and VTK read it.

A report is a VTKHDF file too: a collection with, for each object, its CAD where it stood, and its
collision points frame after frame. The CAD stands there once for each place that it was
at. Unless all are asked for, the points are a sample: every k-th of an object in a frame, at most
`MOST_SHOWN`, as attributes say.
"""

from collections.abc import Iterable, Sequence

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.report.collisions import StoredMesh
from hybridve.hull.report.vtk_blocks import (
    FramePoints,
    add_points,
    add_surface,
    labels_of,
    make_collection,
)

#: Collision points of one object in one frame that a sample has at most.
MOST_SHOWN = 500


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
    collection = make_collection(file)
    n_frames = len(file["hybridve/frames/index"])
    for name, label, mesh, parts in zip(names, labels_of(names), meshes, points, strict=True):
        add_surface(
            collection.block(label, name),
            mesh.faces,
            mesh.vertices_at,
            shown_rows(mesh, n_frames),
        )
        shown = collection.block(f"{label}_points", name)
        shown.attrs["sample"] = is_sample
        if is_sample:
            shown.attrs["points_each_frame_at_most"] = MOST_SHOWN
        add_points(shown, parts)


def shown_rows(mesh: StoredMesh, n_frames: int) -> NDArray[np.int64]:
    """Return the first frame in which a mesh stood where it does in each (F,); -1 if not known."""
    placement = np.broadcast_to(mesh.placement, (n_frames, 3, 4)).reshape(n_frames, 12)
    known = np.flatnonzero(np.isfinite(placement).all(axis=1))
    _, first, place = np.unique(placement[known], axis=0, return_index=True, return_inverse=True)
    rows = np.full(n_frames, -1, np.int64)
    rows[known] = known[first][place.ravel()]
    return rows
