"""How much of a part the cameras can see: closed forms, and points asked one by one."""

import numpy as np
import pytest
from helpers.agreement import random_views
from helpers.cones import BOX_FACES, box_vertices
from helpers.hulls import projection, ring_views, sphere_mesh
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.hull.agreement.sight import IN_PART, NOT_SEEN, SEEN, sight_of
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Views, make_hull, make_views


def one_camera(width: int = 200, height: int = 100, focal_px: float = 100.0) -> Views:
    """At the origin, looking along z: it sees 2 m by 1 m of the plane z = 1 m."""
    matrix = projection(np.eye(3, 4), focal_px, width, height)
    return make_views(("a",), np.array([[width, height]]), matrix[None], origin_world=np.zeros(3))


def sees(views: Views, points_world: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which points are in a hull whose silhouettes fill their images."""
    masks = [np.ones((height, width), np.uint8) for width, height in views.sizes_px]
    return contains_points(make_hull(views, masks), points_world)


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [
        ((-0.5, 0.5), (-0.25, 0.25), 1.0),
        ((0.0, 2.0), (-0.25, 0.25), 0.5),
        ((0.0, 2.0), (0.0, 1.0), 0.25),
        ((-4.0, 4.0), (-4.0, 4.0), 2.0 / 64.0),
        ((1.5, 2.0), (0.0, 0.1), 0.0),
    ],
)
def test_the_seen_share_of_a_rectangle_is_exact(
    x: tuple[float, float], y: tuple[float, float], expected: float
) -> None:
    corners = np.array([[x[i], y[j], 1.0] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])

    told = sight_of(one_camera(), corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))

    assert told.is_exact
    assert told.share == pytest.approx(expected, abs=1e-9)
    assert told.is_seen == (expected == 1.0)
    assert told.is_not_seen == (expected == 0.0)
    assert told.blind == (("a",) if expected == 0.0 else ())


def test_a_triangle_in_a_corner_that_no_plane_alone_rejects_is_not_seen() -> None:
    # Beside the upper right corner of what is seen, (1, 0.5): above none of the four planes alone.
    corners = np.array([[0.8, 0.9, 1.0], [1.4, 0.9, 1.0], [1.4, 0.3, 1.0]])

    told = sight_of(one_camera(), corners, np.array([[0, 1, 2]], np.int32))

    assert told.triangles.tolist() == [NOT_SEEN]
    assert told.is_not_seen


def test_what_is_behind_a_camera_is_not_seen() -> None:
    views = one_camera()
    assert sight_of(views, box_vertices(np.array([0.0, 0.0, -1.0]), 0.2), BOX_FACES).is_not_seen
    around = sight_of(views, box_vertices(np.zeros(3), 1.0), BOX_FACES)
    # Of the box around it the camera sees 2 m by 1 m of one side.
    assert around.share == pytest.approx(2.0 / 24.0, abs=1e-9)


def test_a_room_around_all_that_cameras_see_is_not_seen() -> None:
    told = sight_of(ring_views(), *_mesh(sphere_mesh(500, 3.0)))
    assert told.is_not_seen
    assert told.share == 0.0


def test_a_part_in_everyones_view_is_seen_and_one_far_off_is_not() -> None:
    views = ring_views()
    near = sight_of(views, *_mesh(sphere_mesh(500, 0.2)))
    assert (near.is_seen, near.share, near.blind) == (True, 1.0, ())
    far = sight_of(views, *_mesh(sphere_mesh(500, 0.2, center_world=(9.0, 0.0, 0.0))))
    assert (far.is_not_seen, far.share) == (True, 0.0)
    keep = ring_views(unseen="keep", min_cameras=1)
    kept = sight_of(keep, *_mesh(sphere_mesh(500, 0.2, center_world=(9.0, 0.0, 0.0))))
    assert not kept.is_not_seen
    assert set(kept.blind) < set(keep.names)


def test_nothing_of_no_triangles_is_seen() -> None:
    told = sight_of(ring_views(), np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    assert (told.share, told.is_not_seen) == (0.0, True)


def test_triangles_without_area_are_told_too() -> None:
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [9.0, 0.0, 1.0], [9.0, 0.0, 1.0]])
    faces = np.array([[0, 1, 1], [2, 3, 3], [0, 2, 2]], np.int32)
    told = sight_of(one_camera(), points, faces)
    assert told.triangles.tolist() == [SEEN, NOT_SEEN, IN_PART]
    assert 0.0 < told.share < 1.0


@given(seed=st.integers(0, 2**32 - 1), n_cameras=st.integers(1, 6), keep=st.booleans())
@settings(max_examples=asked(60))
def test_what_is_told_of_triangles_holds_at_their_points(
    seed: int, n_cameras: int, keep: bool
) -> None:
    rng = np.random.default_rng(seed)
    needed = int(rng.integers(1, n_cameras + 1)) if keep else n_cameras
    views = random_views(rng, n_cameras, "keep" if keep else "carve", needed, 0.8)
    sizes_m = rng.choice([0.1, 1.0, 5.0], (20, 1, 1))
    corners = rng.uniform(-2.0, 2.0, (20, 1, 3)) + sizes_m * rng.uniform(-1.0, 1.0, (20, 3, 3))
    told = sight_of(views, corners.reshape(-1, 3), np.arange(60, dtype=np.int32).reshape(-1, 3))

    weights = rng.dirichlet(np.ones(3), (20, 2000))
    points = np.einsum("tnk,tkj->tnj", weights, corners)
    inside = sees(views, points.reshape(-1, 3)).reshape(20, 2000)

    assert not inside[told.triangles == NOT_SEEN].any()
    assert inside[told.triangles == SEEN].all()
    # Five standard deviations of 2000 points, and the sampling of a share that is no polygon's.
    allowed = 5.0 * np.sqrt(0.25 / 2000) + (0.0 if told.is_exact else 0.1)
    assert np.abs(inside.mean(axis=1) - told.shares).max() < allowed
    for name in told.blind:
        camera = views.names.index(name)
        alone = make_views(
            (name,),
            views.sizes_px[[camera]],
            views.img_from_local[[camera]],
            origin_world=np.zeros(3),
        )
        assert not sees(alone, points.reshape(-1, 3) - views.origin_world).any()


def _mesh(mesh: object) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    return mesh.vertices_world, mesh.faces  # type: ignore[attr-defined]
