"""What truly collides: certificates of the triangles, and collision points sampled densely.

A viewport is judged by what is true and not by what a larger viewport finds. Of every triangle the
certificate says whether it collides, with a witness, or is free, proved; where it says neither, no
disc larger than a stated diameter collides. To these witnesses come samples a quarter of the
finest predicted accuracy apart, on the triangles that are not free, so that the distance to the
nearest reported point is measured from everywhere on the colliding surface.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hybridve.hull.contact.detect import Body
from hybridve.hull.query.engine import Engine, Triangles
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.viewport import MAX_VIEWPORT, sample_positions

#: Verdicts of the certificate, as `hybridve.hull.query.certify` has them.
FREE, OPEN, COLLIDING = 0, 1, 2

#: How much finer than the finest accuracy predicted the truth is sampled.
FINER = 4

#: Samples of the truth in one frame: some seconds of work.
_MOST_SAMPLES = 1 << 27


class Certificates(Protocol):
    """A verdict and a witness for each triangle; see `hybridve.hull.query.certify`."""

    @property
    def verdict(self) -> NDArray[np.int8]:
        """`FREE`, `OPEN` or `COLLIDING`, (T,)."""
        ...

    @property
    def witness_world(self) -> NDArray[np.float64]:
        """A point of the triangle inside the hull, (T, 3) metres; NaN unless colliding."""
        ...

    @property
    def open_at_m(self) -> NDArray[np.float64]:
        """No disc of this diameter on an open triangle is in the hull, (T,); else NaN."""
        ...


#: Certifies the triangles of a mesh; collisions may go unnoticed below a disc of so many metres.
Certify = Callable[[Hull, Triangles, float], Certificates]


@dataclass(frozen=True, slots=True, eq=False)
class BodyTruth:
    """What truly collides of one object in one frame.

    Attributes
    ----------
    verdict : (T,) int8
        `FREE`, `OPEN` or `COLLIDING`, of every triangle.
    witnesses_world : (W, 3) float64
        A collision point in metres of each triangle that is certified to collide.
    dense_world : (N, 3) float64
        Collision points in metres, evenly spread over the colliding surface.
    open_at_m : float
        No disc of this diameter on a triangle that was left open is in the hull; 0 if none was.
    """

    verdict: NDArray[np.int8]
    witnesses_world: NDArray[np.float64]
    dense_world: NDArray[np.float64]
    open_at_m: float

    @property
    def collides(self) -> bool:
        """Whether a triangle is certified to collide."""
        return bool((self.verdict == COLLIDING).any())


def certify_body(hull: Hull, body: Body, certify: Certify, open_at_m: float) -> BodyTruth:
    """Return the verdicts on a body's triangles, and the witnesses."""
    certificates = certify(hull, body.triangles, open_at_m)
    verdict = np.asarray(certificates.verdict)
    return BodyTruth(
        verdict,
        certificates.witness_world[verdict == COLLIDING],
        np.zeros((0, 3)),
        float(certificates.open_at_m[verdict == OPEN].max(initial=0.0)),
    )


def longest_edges(mesh: Triangles) -> NDArray[np.float64]:
    """Return the longest edge of each triangle in metres, (T,)."""
    corners = mesh.corners_world
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    return np.asarray(edges.max(axis=1, initial=0.0))


def affordable_spacing(edges_m: NDArray[np.float64], wanted_m: float) -> float:
    """Return `wanted_m`, or as much more that triangles of these edges have not too many samples.

    Parameters
    ----------
    edges_m : (N,) float64
        The longest edge of each triangle to sample.
    wanted_m : float
        The spacing of samples along an edge that is wanted, in metres, positive.
    """
    spacing_m = wanted_m
    while (0.5 * dense_viewports(edges_m, spacing_m).astype(np.float64) ** 2).sum() > _MOST_SAMPLES:
        if spacing_m > edges_m.max():
            break  # so many triangles that their corners alone are too many; no spacing helps
        spacing_m *= 2**0.25
    return spacing_m


def dense_viewports(edges_m: NDArray[np.float64], spacing_m: float) -> NDArray[np.int32]:
    """Return the viewports that sample edges so far apart, as far as viewports reach: (N,)."""
    viewports = np.clip(np.ceil(edges_m / spacing_m) + 1, 2, MAX_VIEWPORT)
    return np.asarray(viewports, np.int32)


def dense_mesh(mesh: Triangles, near: NDArray[np.bool_], spacing_m: float) -> Triangles:
    """Return the mesh with the triangles that are `near` (T,) sampled so far apart."""
    viewports = np.ones(len(mesh), np.int32)
    viewports[near] = dense_viewports(longest_edges(mesh)[near], spacing_m)
    return Triangles(mesh.vertices_world, mesh.faces, viewports)


def sample_body(
    hull: Hull, truth: BodyTruth, dense: Triangles, engine: Engine, points_most: int
) -> BodyTruth:
    """Return the truth with the samples of a dense mesh that collide, thinned to so many.

    Triangles that the certificate left open and of which a sample collides, asked again in double
    precision, are colliding: the sample is their witness.
    """
    (hits,) = engine.query(hull, [dense])
    touched, first = hits.touched()
    is_open = truth.verdict[touched] == OPEN
    touched, first = touched[is_open], first[is_open]
    witnesses_world = _positions(dense, touched, first)
    stands = contains_points(hull, witnesses_world)
    verdict = truth.verdict.copy()
    verdict[touched[stands]] = COLLIDING
    return BodyTruth(
        verdict,
        np.concatenate([truth.witnesses_world, witnesses_world[stands]]),
        _positions(dense, *hits.thinned(points_most)),
        truth.open_at_m,
    )


def nearest_distances(
    points_world: NDArray[np.float64], reported_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return how far each of N points is from the nearest of P > 0 reported ones, (N,) metres."""
    # Points on a lattice are spread evenly: a balanced tree would take longer to build than to ask.
    tree = cKDTree(reported_world, balanced_tree=False, compact_nodes=False)
    distances_m, _ = tree.query(points_world, workers=-1)
    return np.asarray(distances_m, np.float64)


def _positions(
    mesh: Triangles, triangle: NDArray[np.int64], sample: NDArray[np.int64]
) -> NDArray[np.float64]:
    corners = mesh.vertices_world[mesh.faces[triangle]]
    return sample_positions(corners, mesh.viewports[triangle], sample.astype(np.uint32))
