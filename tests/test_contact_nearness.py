"""The map of how near the hull came to each place of a surface."""

import numpy as np
import pytest
from helpers.hulls import ball_hull, ring_views, sphere_mesh
from numpy.typing import NDArray

from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.contact.nearness import Nearness, refined

#: A plate of 0.6 by 0.6 m beside a ball, in two triangles.
PLATE = np.array([[0.36, -0.3, -0.3], [0.36, 0.3, -0.3], [0.36, 0.3, 0.3], [0.36, -0.3, 0.3]])
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def areas(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def test_a_refined_mesh_is_the_same_surface_in_small_triangles() -> None:
    mesh = sphere_mesh(60, radius_m=1.0)
    vertices, faces = mesh.vertices_world, mesh.faces

    fine, numbers, parent = refined(vertices, faces, 0.1)

    edges = fine[numbers] - np.roll(fine[numbers], 1, axis=1)
    assert np.linalg.norm(edges, axis=2).max() <= 0.1
    np.testing.assert_allclose(
        np.bincount(parent, areas(fine, numbers), len(faces)), areas(vertices, faces)
    )


@pytest.mark.parametrize("shift_m", [0.0, 0.05])
def test_bounds_enclose_the_distance_of_every_place(shift_m: float) -> None:
    """As a certified meter measures it that knows only a speck at the place."""
    hull = ball_hull(ring_views(5), np.zeros(3), 0.3)
    near = Nearness(PLATE, FACES, is_closed=False, reach_m=0.25)
    pose = np.eye(3, 4)
    pose[1, 3] = shift_m

    near.look(hull, pose)

    lower_m, upper_m = near.bounds_m.T
    assert (lower_m <= upper_m).all()
    within = np.flatnonzero(lower_m < near.reach_m)
    assert len(within) > 100
    speck = 1e-6 * np.eye(3)
    for place in within[:: len(within) // 12]:
        at = near.vertices[place] + pose[:, 3]
        truth = ClearanceMeter(
            at + speck, np.array([[0, 1, 2]], np.int32), is_closed=False, tolerance_m=1e-4
        ).measure(hull)
        assert lower_m[place] <= truth.upper_m + 1e-5
        assert upper_m[place] >= truth.lower_m - 1e-5
    close = lower_m + upper_m < 0.5 * near.reach_m
    assert close.any()
    assert (upper_m - lower_m)[close].max() <= 2 * near.off_m + 1e-12
    assert near.off_m < 0.01


def test_over_frames_the_nearest_counts_and_nothing_is_far() -> None:
    views = ring_views(5)
    near = Nearness(PLATE, FACES, is_closed=False, reach_m=0.25)
    empty = ball_hull(views, np.array([0.0, 0.0, 0.9]), 0.05)

    near.look(empty)
    assert (near.distance_m == near.reach_m).all()
    near.look(ball_hull(views, np.array([0.15, 0.15, 0.0]), 0.1))
    first = near.distance_m.copy()
    near.look(ball_hull(views, np.array([0.15, -0.15, 0.0]), 0.1))
    near.look(empty)

    left, right = near.vertices[:, 1] > 0.1, near.vertices[:, 1] < -0.1
    np.testing.assert_allclose(near.distance_m[left], first[left], atol=0.02)
    assert near.distance_m[right].min() < first[right].min() - 0.05
