"""Which CAD objects touch the hull, where, and how sure that is.

Section 4.2.4 of the paper: bounding boxes first, then every triangle of the objects whose box may
touch the hull; collision points are positions on the surface of the object.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.contact.scene import SceneObject
from hybridve.hull.query.bounds import boxes_are_free
from hybridve.hull.query.engine import Engine, Hits, Triangles
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.viewport import Real, hit_positions, viewports_for_accuracy

#: "colliding": a sample of the surface is inside every silhouette. "free": proved, no point of the
#: object is in the hull. "": only sampled; a smaller contact may hide between the samples.
Certificate = Literal["colliding", "free", ""]


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A CAD object laid into viewports, ready to be asked about frame after frame.

    Attributes
    ----------
    name : str
        The object.
    triangles : Triangles
        Its mesh.
    lower_world, upper_world : (3,) float64
        Its axis-aligned bounding box, metres.
    spacing_m : float
        The largest spacing of samples along an edge: the accuracy of section 4.4.3.
    """

    name: str
    triangles: Triangles
    lower_world: NDArray[np.float64]
    upper_world: NDArray[np.float64]
    spacing_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """What one frame's hull does to one object.

    Attributes
    ----------
    certificate : Certificate
        How far the verdict can be trusted.
    points_world : (P, 3) float32
        The collision points CP_i in metres, sorted by triangle; none if the object is not touched.
    triangle : (P,) uint32
        The triangle that each collision point lies on.
    """

    certificate: Certificate
    points_world: NDArray[np.float32]
    triangle: NDArray[np.uint32]

    @property
    def collides(self) -> bool:
        """Whether a sample of the object's surface is in the hull."""
        return len(self.triangle) > 0

    @property
    def n_triangles(self) -> int:
        """How many triangles have a collision point."""
        return int(np.count_nonzero(np.diff(self.triangle))) + 1 if self.collides else 0


def make_body(
    scene_object: SceneObject, *, viewport: int | None = None, accuracy_m: float | None = None
) -> Body:
    """Return an object laid into viewports: one size for all, or as small as an accuracy allows.

    Exactly one of `viewport` (samples along an edge) and `accuracy_m` (largest spacing of samples
    along an edge, in metres) is given.

    Raises
    ------
    ValueError
        If both are given or none, or the accuracy needs a viewport too large.
    """
    if (viewport is None) == (accuracy_m is None):
        raise ValueError("give either viewport or accuracy_m")
    corners = scene_object.vertices_world[scene_object.faces]  # (T, 3, 3)
    if accuracy_m is not None:
        viewports = viewports_for_accuracy(corners, accuracy_m)
    else:
        viewports = np.full(len(corners), viewport, np.int32)
    edges_m = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    lower, upper = scene_object.box_world
    return Body(
        scene_object.name,
        Triangles(scene_object.vertices_world, scene_object.faces, viewports),
        lower,
        upper,
        float((edges_m / np.maximum(viewports - 1, 1)).max()),
    )


def detect_contacts(hull: Hull, bodies: list[Body], engine: Engine) -> list[Contact]:
    """Return for each body its contact with the hull of one frame."""
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
        _no_contact("free") if is_free else _contact(hull, body, next(hits))
        for body, is_free in zip(bodies, free, strict=True)
    ]


def _no_contact(certificate: Certificate) -> Contact:
    return Contact(certificate, np.zeros((0, 3), np.float32), np.zeros(0, np.uint32))


def _contact(hull: Hull, body: Body, hits: Hits) -> Contact:
    if len(hits) == 0:
        return _no_contact("")
    triangle, sample = hits.samples()
    # An engine in single precision may err at the rim of a silhouette; a witness may not.
    few = slice(0, _MAX_WITNESSES)
    witnesses_world = _place(body, triangle[few], sample[few], np.zeros((len(triangle[few]), 3)))
    has_witness = bool(contains_points(hull, witnesses_world).any())
    points_world = _place(body, triangle, sample, np.zeros((len(triangle), 3), np.float32))
    return Contact("colliding" if has_witness else "", points_world, triangle)


def _place(
    body: Body,
    triangle: NDArray[np.uint32],
    sample: NDArray[np.uint32],
    positions: NDArray[Real],
) -> NDArray[Real]:
    mesh = body.triangles
    return hit_positions(
        mesh.vertices_world, mesh.faces, mesh.viewports, triangle, sample, positions
    )


#: How many collision points are asked again in double precision for one that stands.
_MAX_WITNESSES = 64
