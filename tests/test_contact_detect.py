"""Contacts of objects: what the samples say, and what is certain beside them."""

from pathlib import Path

import numpy as np
import pytest
from helpers.hulls import ball_hull, look_at, projection, ring_views, sphere_mesh

from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.contact.detect import Body, certify_contacts, detect_contacts, make_body
from hybridve.hull.query.certify import Certifier
from hybridve.hull.query.engine import Hits, Triangles
from hybridve.hull.query.native import Native
from hybridve.hull.query.reference import Reference, contains_points
from hybridve.hull.query.silhouettes import Hull, make_hull, make_views


def part(vertices_world: np.ndarray, faces: np.ndarray) -> SceneObject:
    return SceneObject(
        "part", Path("part.stl"), vertices_world, faces.astype(np.int32), 0.0, np.zeros(3), None
    )


def plate(edge_m: float = 1.0) -> SceneObject:
    """Two triangles in the plane z = 0, about the origin."""
    corners = edge_m / 2 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return part(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def test_triangles_keep_the_numbers_of_the_scene() -> None:
    """A body is put into another order; its collision points name the scene's triangles."""
    hull = ball_hull(ring_views(), np.array([0.5, 0.0, 0.0]), 0.2)
    sphere = sphere_mesh(3000)
    faces = np.random.default_rng(0).permutation(sphere.faces)
    scene_object = part(sphere.vertices_world, faces)
    body = make_body(scene_object, viewport=5)

    with Native(2) as engine:
        (contact,) = detect_contacts(hull, [body], engine)

    points_world, triangle = contact.points()
    assert contact.triangles().tolist() == sorted(set(triangle.tolist()))
    assert len(contact.triangles()) == contact.n_triangles > 50
    corners = scene_object.vertices_world[faces[triangle]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets_m = np.einsum("pi,pi->p", points_world - corners[:, 0], normals)
    assert np.abs(offsets_m).max() < 1e-6  # float32 at half a metre
    reach_m = np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2).max(axis=1)
    distance_m = np.linalg.norm(points_world - corners.mean(axis=1), axis=1)
    assert (distance_m < 1.001 * reach_m).all()


def test_what_samples_miss_is_certified_with_a_witness() -> None:
    views = ring_views(4)
    hull = ball_hull(views, np.array([0.03, 0.21, 0.0]), 0.008)
    body = make_body(plate(), viewport=4)
    with Reference() as engine, Certifier(1e-4) as certifier:
        sampled = detect_contacts(hull, [body], engine)
        (contact,) = certify_contacts(hull, [body], sampled, certifier)

    assert not sampled[0].collides
    assert sampled[0].certificate == ""
    assert not contact.collides  # the samples still say what they say
    assert contact.certificate == "colliding"
    assert contains_points(hull, contact.witness_world[None])[0]
    assert abs(contact.witness_world[2]) < 1e-12
    assert np.linalg.norm(contact.witness_world - [0.03, 0.21, 0.0]) < 0.02


def test_a_collision_point_serves_as_witness() -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)
    body = make_body(plate(), viewport=30)

    with Reference() as engine:
        (contact,) = detect_contacts(hull, [body], engine)

    assert contact.certificate == "colliding"
    nearest_m = np.linalg.norm(contact.points()[0] - contact.witness_world, axis=1).min()
    assert nearest_m == 0
    assert contains_points(hull, contact.witness_world[None])[0]


def near_but_apart() -> tuple[Hull, Body]:
    """A slanted plate whose box reaches into the hull's rectangles, but not the plate itself."""
    hull = ball_hull(ring_views(6), np.array([0.0, 0.0, 0.15]), 0.1)
    slanted = plate().vertices_world @ np.array([[1, 0, 0], [0, 0.8, 0.6], [0, -0.6, 0.8]]).T
    return hull, make_body(part(slanted - [0.0, 0.0, 0.2], plate().faces), viewport=4)


def test_what_is_near_but_apart_is_proved_free() -> None:
    hull, body = near_but_apart()

    with Reference() as engine, Certifier(1e-4) as certifier:
        sampled = detect_contacts(hull, [body], engine)
        (contact,) = certify_contacts(hull, [body], sampled, certifier)

    assert sampled[0].certificate == ""  # the box alone proves nothing
    assert contact.certificate == "free"
    assert np.isnan(contact.witness_world).all()
    assert np.isnan(contact.open_at_m)


def touching_halves() -> Hull:
    """Two cameras in one place, whose silhouettes touch along a line: nothing is in both."""
    matrix = projection(look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3)), 1000.0, 40, 40)
    views = make_views(("a", "b"), np.array([[40, 40]] * 2), np.array([matrix, matrix]))
    left, right = np.zeros((2, 40, 40), np.uint8)
    left[:, :20], right[:, 20:] = 1, 1
    return make_hull(views, [left, right])


@pytest.mark.parametrize("open_at_m", [1e-3, 1e-4])
def test_what_cannot_be_decided_is_open_below_the_size_asked_for(open_at_m: float) -> None:
    hull = touching_halves()
    corners = plate(0.06).vertices_world
    corners[0, 0] += 0.001  # no edge along the line
    slanted = part(corners, plate().faces)
    body = make_body(slanted, viewport=10)

    with Reference() as engine, Certifier(open_at_m) as certifier:
        (contact,) = certify_contacts(
            hull, [body], detect_contacts(hull, [body], engine), certifier
        )

    assert contact.certificate == "open"
    assert 0 < contact.open_at_m <= open_at_m
    assert not contact.collides


def test_points_of_an_object_that_is_proved_free_are_taken_back() -> None:
    """An engine in single precision may round a sample across a rim; a proof outweighs it."""
    hull, body = near_but_apart()

    class Rounding(Reference):
        def query(self, hull: Hull, meshes: list[Triangles]) -> list[Hits]:
            first = np.zeros(1, np.uint32)
            return [Hits.from_samples(mesh.topology, first, first) for mesh in meshes]

    with Certifier(1e-4) as certifier:
        sampled = detect_contacts(hull, [body], Rounding())
        (contact,) = certify_contacts(hull, [body], sampled, certifier)

    assert sampled[0].collides
    assert sampled[0].certificate == ""  # no sample stands up to double precision
    assert contact.certificate == "free"
    assert not contact.collides
