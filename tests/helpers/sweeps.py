"""A plain certificate of triangles, by brute force, to measure sweeps against."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.bounds import FREE as BOX_FREE
from hybridve.hull.query.bounds import verdicts
from hybridve.hull.query.engine import Triangles
from hybridve.hull.query.reference import Reference
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.viewport import sample_positions

FREE, OPEN, COLLIDING = 0, 1, 2


@dataclass(frozen=True)
class BruteCertificates:
    verdict: NDArray[np.int8]
    witness_world: NDArray[np.float64]
    open_at_m: NDArray[np.float64]


def certify_by_samples(hull: Hull, mesh: Triangles, open_at_m: float) -> BruteCertificates:
    """Certify by the rectangle of the whole triangle, and by samples `open_at_m` apart."""
    corners = mesh.corners_world
    verdict = np.where(
        verdicts(hull, corners - hull.views.origin_world) == BOX_FREE, FREE, OPEN
    ).astype(np.int8)
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    viewports = np.clip(np.ceil(edges / open_at_m) + 1, 2, 300).astype(np.int32)
    dense = Triangles(mesh.vertices_world, mesh.faces, viewports)
    (hits,) = Reference().query(hull, [dense])
    triangle, sample = hits.samples()
    colliding, first = np.unique(triangle, return_index=True)
    verdict[colliding] = COLLIDING
    witness_world = np.full((len(mesh), 3), np.nan)
    witness_world[colliding] = sample_positions(
        corners[colliding], viewports[colliding], sample[first]
    )
    # Every disc of twice the spacing's diameter holds a sample.
    open_m = np.where(verdict == OPEN, 2.0 * edges / np.maximum(viewports - 1, 1), np.nan)
    return BruteCertificates(verdict, witness_world, open_m)
