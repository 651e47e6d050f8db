"""Which CAD objects touch the hull, where, and how sure that is.

Section 4.2.4 of the paper: bounding boxes first, then every triangle of the objects whose box may
touch the hull; collision points are positions on the surface of the object. Samples alone say
nothing about what lies between them, so a certificate stands beside them (`certify_contacts`).
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.query.bounds import boxes_are_free
from hybridve.hull.query.certify import COLLIDING, FREE, Certifier
from hybridve.hull.query.clusters import spatial_order
from hybridve.hull.query.engine import Engine, Hits, Triangles, checked_vertices
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.viewport import (
    place_runs,
    read_only,
    sample_positions,
    viewports_for_accuracy,
)

#: "colliding": a point of the surface, the witness, is inside every silhouette. "free": proved, no
#: point of the object is in the hull. "open": nothing as wide as `Contact.open_at_m` is. "": only
#: sampled; a smaller contact may hide between the samples.
Certificate = Literal["colliding", "free", "open", ""]


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A CAD object laid into viewports, ready to be asked about frame after frame.

    Attributes
    ----------
    name : str
        The object.
    triangles : Triangles
        Its mesh, neighbours in space next to each other.
    numbers : (T,) uint32
        The number that each triangle has in the scene.
    lower_world, upper_world : (3,) float64
        Its axis-aligned bounding box, metres.
    spacing_m : float
        The largest spacing of samples along an edge: the accuracy of section 4.4.3.
    """

    name: str
    triangles: Triangles
    numbers: NDArray[np.uint32]
    lower_world: NDArray[np.float64]
    upper_world: NDArray[np.float64]
    spacing_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """What one frame's hull does to one object.

    Attributes
    ----------
    certificate : Certificate
        How far the verdict can be trusted. It may say "colliding" where no sample does.
    body : Body
        The object.
    hits : Hits
        Which of its samples are in the hull: the collision points CP_i, as runs. A swallowed
        object is one run, and nobody waits for points that he does not want; `points` makes them.
    witness_world : (3,) float64
        Metres: a point of the surface that is in the hull; NaN unless it is certified to collide.
    open_at_m : float
        No disc of this diameter on the surface is in the hull; NaN unless it is "open".
    """

    certificate: Certificate
    body: Body
    hits: Hits
    witness_world: NDArray[np.float64] = field(default_factory=lambda: np.full(3, np.nan))
    open_at_m: float = np.nan

    @property
    def collides(self) -> bool:
        """Whether a sample of the object's surface is in the hull."""
        return len(self.hits.start) > 0

    @property
    def n_points(self) -> int:
        """How many samples are in the hull."""
        return len(self.hits)

    @property
    def n_triangles(self) -> int:
        """How many triangles have a collision point."""
        return len(self.hits.touched()[0]) if self.collides else 0

    def triangles(self) -> NDArray[np.uint32]:
        """Return the numbers in the scene of the triangles with a collision point, ascending."""
        return np.sort(self.body.numbers[self.hits.touched()[0]])

    def points(self) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
        """Return all collision points, (P, 3) metres in the world, and each one's triangle (P,).

        Those of a triangle stand together; triangles are numbered as in the scene.
        """
        return collision_points(self.body, self.hits)

    def some_points(self, most: int) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
        """Return every k-th collision point, at most so many; as `points`."""
        if self.n_points <= most:
            return self.points()
        return self._placed(*self.hits.thinned(most))

    def end_points(self) -> NDArray[np.float64]:
        """Return collision points among which is the farthest from any point, (E, 3) metres."""
        return self._placed(*self.hits.ends())[0]

    def _placed(
        self, triangle: NDArray[np.int64], sample: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
        mesh = self.body.triangles
        points_world = sample_positions(
            mesh.vertices_world[mesh.faces[triangle]],
            mesh.viewports[triangle],
            sample.astype(np.uint32),
        )
        return points_world, self.body.numbers[triangle]


def make_body(
    scene_object: SceneObject, *, viewport: int | None = None, accuracy_m: float | None = None
) -> Body:
    """Return an object laid into viewports: one size for all, or as small as an accuracy allows.

    Exactly one of `viewport` (samples along an edge) and `accuracy_m` (largest spacing of samples
    along an edge, in metres) is given.

    Raises
    ------
    ValueError
        If both are given or none, the accuracy needs a viewport too large, a coordinate is not
        finite, or there is no triangle.
    """
    if (viewport is None) == (accuracy_m is None):
        raise ValueError("give either viewport or accuracy_m")
    if len(scene_object.faces) == 0:
        raise ValueError("there is no triangle to lay into a viewport")
    vertices_world = checked_vertices(scene_object.vertices_world)
    corners = vertices_world[scene_object.faces]  # (T, 3, 3)
    if accuracy_m is not None:
        viewports = viewports_for_accuracy(corners, accuracy_m)
    else:
        viewports = np.full(len(corners), viewport, np.int32)
    edges_m = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    lower, upper = scene_object.box_world
    order = spatial_order(vertices_world, scene_object.faces)
    return Body(
        scene_object.name,
        Triangles(
            vertices_world, read_only(scene_object.faces[order]), read_only(viewports[order])
        ),
        order.astype(np.uint32),
        lower,
        upper,
        float((edges_m / np.maximum(viewports - 1, 1)).max()),
    )


def moved_body(body: Body, scene_object: SceneObject) -> Body:
    """Return a body where its object stands, which has moved rigidly since it was made.

    Its triangles keep their viewports, order and numbers.
    """
    lower, upper = scene_object.box_world
    triangles = body.triangles.moved(scene_object.vertices_world)
    return replace(body, triangles=triangles, lower_world=lower, upper_world=upper)


def detect_contacts(hull: Hull, bodies: list[Body], engine: Engine) -> list[Contact]:
    """Return for each body its contact with the hull of one frame, as its samples tell it."""
    if not bodies:
        return []
    free = boxes_are_free(
        hull,
        np.array([body.lower_world for body in bodies]),
        np.array([body.upper_world for body in bodies]),
    )
    near = [body for body, is_free in zip(bodies, free, strict=True) if not is_free]
    hits = iter(engine.query(hull, [body.triangles for body in near]))
    return [
        no_contact(body) if is_free else _contact(hull, body, next(hits))
        for body, is_free in zip(bodies, free, strict=True)
    ]


def certify_contacts(
    hull: Hull, bodies: list[Body], contacts: list[Contact], certifier: Certifier
) -> list[Contact]:
    """Return contacts with a certificate for those that are only sampled."""
    return [
        _certified(hull, body, contact, certifier) if contact.certificate == "" else contact
        for body, contact in zip(bodies, contacts, strict=True)
    ]


def _certified(hull: Hull, body: Body, contact: Contact, certifier: Certifier) -> Contact:
    found = certifier.certify_mesh(hull, body.triangles)
    if found.verdict == FREE:
        # Points, if there are any, were rounded across the rim of a silhouette in single precision.
        return no_contact(body)
    if found.verdict == COLLIDING:
        return replace(contact, certificate="colliding", witness_world=found.witness_world)
    return replace(contact, certificate="open", open_at_m=found.open_at_m)


def no_contact(body: Body, certificate: Certificate = "free") -> Contact:
    """Return that no sample of an object is in the hull."""
    return Contact(certificate, body, Hits.none(body.triangles.topology))


def _contact(hull: Hull, body: Body, hits: Hits) -> Contact:
    contact = Contact("", body, hits)
    if not contact.collides:
        return contact
    # An engine in single precision may err at the rim of a silhouette; a witness may not.
    mesh = body.triangles
    triangle, sample = hits.samples(_MAX_WITNESSES)
    candidates_world = sample_positions(
        mesh.vertices_world[mesh.faces[triangle]], mesh.viewports[triangle], sample
    )
    inside = contains_points(hull, candidates_world)
    if not inside.any():
        return contact
    witness_world = candidates_world[int(inside.argmax())]
    return replace(contact, certificate="colliding", witness_world=witness_world)


def collision_points(body: Body, hits: Hits) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """Return where the samples of hits lie, (P, 3) metres, and each one's triangle of the scene."""
    mesh = body.triangles
    triangle, points_world = place_runs(
        hits.start,
        hits.stop,
        mesh.topology.samples_before,
        mesh.vertices_world,
        mesh.faces,
        mesh.viewports,
    )
    return points_world, body.numbers[triangle]


#: How many collision points are asked again in double precision for one that stands.
_MAX_WITNESSES = 64
