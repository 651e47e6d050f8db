"""The specification: which points and samples are inside the hull, in float64 NumPy.

Plain rather than fast. The other engines are tested against it; so is the rectangle test of
`hybridve.hull.query.bounds`, which this room does not use.
"""

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.engine import Closing, Hits, Triangles
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.viewport import sample_positions

#: Samples asked at a time: bounds the memory to some 100 MB whatever the mesh.
_CHUNK = 1 << 18


def contains_points(hull: Hull, points_world: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which points are inside the hull.

    A camera sees a point that lies in front of it (positive depth) and whose projection falls
    into its image (0 <= x < width, 0 <= y < height), with ``unseen = "keep"`` onto a pixel that
    was recorded (`hybridve.hull.query.silhouettes.Seen`). With ``unseen = "carve"`` a point is
    inside when every camera sees it on an object pixel. With ``unseen = "keep"`` it is inside when
    no camera sees it on a background pixel and at least ``min_cameras`` see it.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    points_world : (N, 3) float64
        Points in metres.

    Returns
    -------
    (N,) bool

    References
    ----------
    Lok, Naik, Whitton and Brooks, *Incorporating Dynamic Real Objects into Immersive Virtual
    Environments*, 2003, Eq. 1.
    """
    return _contains(hull, points_world - hull.views.origin_world)


def _contains(hull: Hull, points_local: NDArray[np.float64]) -> NDArray[np.bool_]:
    views = hull.views
    n_seen = np.zeros(len(points_local), np.int64)
    on_background = np.zeros(len(points_local), np.bool_)
    for camera in range(len(views)):
        seen, on_object = _look(hull, camera, points_local)
        n_seen += seen
        on_background |= seen & ~on_object
    needed = len(views) if views.unseen == "carve" else views.min_cameras
    inside: NDArray[np.bool_] = ~on_background & (n_seen >= needed)
    return inside


def _look(
    hull: Hull, camera: int, points_local: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which points a camera sees, and which of these on an object pixel."""
    img_from_local = hull.views.img_from_local[camera]
    width, height = hull.views.sizes_px[camera]
    projected = points_local @ img_from_local[:, :3].T + img_from_local[:, 3]  # (N, 3)
    in_front = projected[:, 2] > 0
    with np.errstate(over="ignore"):  # just in front of the camera and far beside: infinitely out
        pixels = projected[:, :2] / np.where(in_front, projected[:, 2], 1.0)[:, None]
    seen = in_front & (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
    column, row = np.floor(np.where(seen[:, None], pixels, 0.0)).astype(np.int64).T
    recorded = hull.views.seen_mask(camera)
    if recorded is not None:
        seen &= recorded[row, column] != 0
    on_object = seen & (hull.mask(camera)[row, column] != 0)
    return seen, on_object


class Reference(Closing):
    """The engine that asks `contains_points` of every sample."""

    name = "reference"
    any_thread = True

    def __init__(self) -> None:
        self.renderer = f"NumPy {np.__version__}, double precision"

    def query(self, hull: Hull, meshes: list[Triangles]) -> list[Hits]:
        """Return for each mesh its samples inside the hull of this frame."""
        return [_query_mesh(hull, mesh) for mesh in meshes]

    def close(self) -> None:
        """Release nothing: there is nothing to release."""


def _query_mesh(hull: Hull, mesh: Triangles) -> Hits:
    """Ask the samples of a mesh in their order, a chunk at a time."""
    before = mesh.topology.samples_before
    vertices_local = mesh.vertices_world - hull.views.origin_world
    triangles: list[NDArray[np.uint32]] = [np.zeros(0, np.uint32)]
    samples: list[NDArray[np.uint32]] = [np.zeros(0, np.uint32)]
    total = int(before[-1])
    for start in range(0, total, _CHUNK):
        number = np.arange(start, min(start + _CHUNK, total))
        triangle = np.searchsorted(before, number, side="right") - 1
        sample = (number - before[triangle]).astype(np.uint32)
        positions_local = sample_positions(
            vertices_local[mesh.faces[triangle]], mesh.viewports[triangle], sample
        )
        inside = _contains(hull, positions_local)
        triangles.append(triangle[inside].astype(np.uint32))
        samples.append(sample[inside])
    return Hits.from_samples(mesh.topology, np.concatenate(triangles), np.concatenate(samples))
