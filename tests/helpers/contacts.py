"""Contacts as tests need them: collision points wherever they are wanted."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridve.hull.contact.detect import Body, Contact, no_contact
from hybridve.hull.query.engine import Hits, Triangles
from hybridve.hull.report.collisions import StoredMesh


def body_at(points_world: ArrayLike, name: str = "points") -> Body:
    """Return an object of triangles without area, one at each point (P, 3), viewport 2."""
    points = np.asarray(points_world, np.float64).reshape(-1, 3)
    count = max(len(points), 1)
    corners = np.zeros((count, 3))
    corners[: len(points)] = points
    faces = np.repeat(np.arange(count, dtype=np.int32)[:, None], 3, axis=1)
    return Body(
        name,
        Triangles(corners, faces, np.full(count, 2, np.int32)),
        np.arange(count, dtype=np.uint32),
        corners.min(axis=0),
        corners.max(axis=0),
        0.0,
    )


def contact_at(points_world: ArrayLike, certificate: Any = "", **about: Any) -> Contact:
    """Return a contact with collision points at exactly these places, each of its own triangle."""
    points = np.asarray(points_world, np.float64).reshape(-1, 3)
    body = body_at(points)
    first = 3 * np.arange(len(points), dtype=np.int64)
    return Contact(certificate, body, Hits(body.triangles.topology, first, first + 1), **about)


def free_contact(certificate: Any = "free", **about: Any) -> Contact:
    """Return a contact without a collision point."""
    return contact_at(np.zeros((0, 3)), certificate, **about)


#: No sample of it is in the hull, which is proved.
FREE = no_contact(body_at(np.zeros((1, 3))))


def points_of(contact: Contact) -> NDArray[np.float64]:
    """Return the collision points of a contact, (P, 3) metres."""
    return contact.points()[0]


def stored_mesh(body: Body) -> StoredMesh:
    """Return the mesh of an object as a report holds it, in the frame of the world."""
    mesh = body.triangles
    place = np.argsort(body.numbers)
    return StoredMesh(
        mesh.vertices_world,
        mesh.faces[place],
        mesh.viewports[place].astype(np.uint16),
        body.numbers,
        np.eye(3, 4)[None],
    )


def crumpled_body(seed: int, name: str = "object", n_triangles: int = 5) -> Body:
    """Return an object of triangles anywhere, in an order of its own, viewports 1 to 4."""
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(n_triangles + 2, 3))
    faces = np.stack([rng.permutation(len(vertices))[:3] for _ in range(n_triangles)])
    return Body(
        name,
        Triangles(vertices, faces.astype(np.int32), rng.integers(1, 5, n_triangles).astype("i4")),
        rng.permutation(n_triangles).astype(np.uint32),
        vertices.min(axis=0),
        vertices.max(axis=0),
        1.0,
    )


def some_hits(body: Body, rng: np.random.Generator, share: float) -> Hits:
    """Return hits of some samples of an object, each with this probability."""
    topology = body.triangles.topology
    inside = rng.random(int(topology.samples_before[-1])) < share
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]])))
    return Hits(topology, edges[::2].astype(np.int64), edges[1::2].astype(np.int64))
