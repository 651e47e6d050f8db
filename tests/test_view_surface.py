"""The hull as a closed surface, against solids whose silhouettes are exact."""

import numpy as np
import pytest
import trimesh
from helpers.sessions import BALL_RADIUS_M, SIZE_PX, ball_mask, ring_matrix

from hybridve.hull.query.silhouettes import Hull, Unseen, make_hull, make_views
from hybridve.hull.view.surface import MOST_NODES, Surface, hull_surface


def ball_hull(n_cameras: int = 6, unseen: Unseen = "carve", shift_px: float = 0.0) -> Hull:
    """The hull of a ball in the middle of a ring of cameras."""
    matrices = np.array([ring_matrix(camera, n_cameras) for camera in range(n_cameras)])
    matrices[:, 0] += shift_px * matrices[:, 2]
    sizes_px = np.array([SIZE_PX] * n_cameras)
    views = make_views(
        tuple(f"cam{camera}" for camera in range(n_cameras)), sizes_px, matrices, unseen
    )
    return make_hull(views, [ball_mask(matrix, np.zeros(3)) for matrix in matrices])


def solid(surface: Surface) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.vertices_world, surface.faces, process=False)


def test_it_is_closed_and_turned_outwards() -> None:
    found = solid(hull_surface(ball_hull(), split=48))

    assert found.is_watertight
    assert found.is_winding_consistent
    assert found.volume > 4 / 3 * np.pi * BALL_RADIUS_M**3  # the hull contains the ball


def test_points_of_the_surface_are_at_the_border_of_the_hull() -> None:
    hull = ball_hull()
    surface = hull_surface(hull, cell_m=0.01)
    # A pixel is 13 mm wide at the ball; a step of a cell and a pixel leads out, or in.
    normals = solid(surface).vertex_normals
    for way, is_inside in ((-0.03, True), (0.03, False)):
        points = surface.vertices_world + way * normals
        inside = np.ones(len(points), np.bool_)
        for camera in range(len(hull.views)):
            projected = hull.views.project(points, camera)
            column, row = np.floor(projected[:, :2] / projected[:, 2:]).astype(int).T
            inside &= hull.mask(camera)[row, column] > 0
        assert (inside == is_inside).mean() > 0.98


@pytest.mark.slow
def test_finer_cells_come_nearer_to_a_limit() -> None:
    volumes = [solid(hull_surface(ball_hull(), cell_m=cell)).volume for cell in (0.04, 0.02, 0.01)]

    assert abs(volumes[2] - volumes[1]) < abs(volumes[1] - volumes[0])


def test_a_hull_that_reaches_out_of_pictures_is_closed_there() -> None:
    hull = ball_hull(shift_px=75.0)  # half of the ball is out of every picture

    found = solid(hull_surface(hull, split=40))

    assert found.is_watertight
    whole = solid(hull_surface(ball_hull(), split=40))
    assert found.volume < 0.8 * whole.volume


def test_cameras_that_abstain_leave_it_closed() -> None:
    found = solid(hull_surface(ball_hull(2, "keep"), split=40))

    assert found.is_watertight
    assert found.volume > 0.0


def test_an_empty_hull_has_no_triangle() -> None:
    views = ball_hull().views
    nothing = [np.zeros(SIZE_PX[::-1], np.uint8)] * len(views)

    assert len(hull_surface(make_hull(views, nothing), split=40).faces) == 0


def test_more_cells_than_fit_into_memory_are_refused_with_what_fits() -> None:
    with pytest.raises(ValueError, match=rf"{MOST_NODES} at most; take \d+ mm"):
        hull_surface(ball_hull(), cell_m=1e-4)
