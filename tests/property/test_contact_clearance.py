"""Clearance against exact distances between polytopes, over thousands of random cases."""

import numpy as np
import pytest
from helpers.hulls import MASK_KINDS, look_at, projection, random_masks, random_views, with_gaps
from helpers.polytopes import depth_in_box, distance_between, rectangle_hull
from helpers.thorough import some_of
from numpy.typing import NDArray

from hybridve.calib.pose import rotation_about_axes
from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.query.cells import make_cell_frame, split_cells
from hybridve.hull.query.points import are_inside
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, Views, make_hull, make_views
from hybridve.hull.synth.meshes import box_mesh

#: The exact answers come from solvers that bound their own error; a tenth of the tolerance.
SOLVER_M = 1e-5

_CORNERS = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T


class Box:
    """A box somewhere, as a closed mesh in the world."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.half = rng.uniform(0.02, 0.3, 3)
        self.rotation = rotation_about_axes(tuple(rng.uniform(-180, 180, 3)))
        direction = rng.normal(size=3)
        self.center = direction / np.linalg.norm(direction) * rng.uniform(0.0, 1.5)
        mesh = box_mesh(tuple(2000 * self.half), 150.0)
        self.vertices = mesh.vertices_mm / 1000 @ self.rotation.T + self.center
        self.faces = mesh.faces.astype(np.int32)
        self.corners = _CORNERS * self.half @ self.rotation.T + self.center

    def signed_distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distances (N,) of points (N, 3) in closed form, negative inside."""
        beyond = np.abs((points - self.center) @ self.rotation) - self.half
        outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
        return np.asarray(outside + np.minimum(beyond.max(axis=1), 0.0))


@pytest.mark.slow
@pytest.mark.parametrize("seed", some_of(range(12)))
def test_bounds_hold_the_exact_distance_of_convex_hulls(seed: int) -> None:
    rng = np.random.default_rng([4, seed])
    n_apart = n_inside = n_wide = 0
    while n_apart + n_inside < 100:
        views = random_views(rng, int(rng.integers(3, 6)))
        made = rectangle_hull(rng, views, 0.2 * rng.normal(size=3))
        if made is None:
            continue
        hull, shape = made
        box = Box(rng)
        tolerance_m = rng.choice([1e-4, 1e-3])
        meter = ClearanceMeter(box.vertices, box.faces, is_closed=True, tolerance_m=tolerance_m)
        found = meter.measure(hull)
        depth = depth_in_box(shape, box.rotation, box.center, box.half)
        assert found.upper_m - found.lower_m <= tolerance_m + 1e-9
        if depth > 1e-8:
            n_inside += 1
            n_wide += bool(found.depth_upper_m - found.depth_lower_m > tolerance_m + 1e-9)
            assert found.lower_m == 0
            assert found.depth_lower_m - 1e-8 <= depth <= found.depth_upper_m + 1e-8
        else:
            n_apart += 1
            lower, upper = distance_between(shape.corners, box.corners)
            assert upper - lower < SOLVER_M  # or the exact answer is none
            assert found.lower_m <= upper
            assert lower <= found.upper_m
            assert found.depth_lower_m == 0
        # The witnesses are what they are said to be, whoever computes it.
        assert contains_points(hull, found.on_hull_world[None])[0]
        signed = box.signed_distance(found.on_hull_world[None])[0]
        assert signed == pytest.approx(found.upper_m - found.depth_lower_m, abs=1e-9)
        assert box.signed_distance(found.on_object_world[None])[0] == pytest.approx(0, abs=1e-9)
        between = np.linalg.norm(found.on_hull_world - found.on_object_world)
        assert between == pytest.approx(abs(signed), abs=1e-9)
    assert min(n_apart, n_inside) > 10
    assert n_wide <= 0.1 * n_inside + 2  # all along the middle of a plate depth is left less exact


def _random_hull(rng: np.random.Generator) -> Hull:
    n_cameras = int(rng.integers(1, 6))
    unseen = rng.choice(["carve", "keep"])
    least = int(rng.integers(1, n_cameras + 1)) if unseen == "keep" else 1
    views = random_views(rng, n_cameras, unseen, least, origin_world=rng.normal(size=3) * 100)
    return make_hull(views, random_masks(rng, views, list(rng.choice(MASK_KINDS, n_cameras))))


@pytest.mark.slow
@pytest.mark.parametrize("seed", some_of(range(10)))
def test_no_point_of_any_hull_is_nearer_than_the_lower_bound(seed: int) -> None:
    """Blobs, holes, noise, half images, abstaining cameras: nothing about the hull is known."""
    rng = np.random.default_rng([5, seed])
    for _ in range(20):
        hull, box = _random_hull(rng), Box(rng)
        origin = hull.views.origin_world
        meter = ClearanceMeter(box.vertices + origin, box.faces, is_closed=True, tolerance_m=1e-3)
        found = meter.measure(hull)
        near, far = found.signed_m
        spread = 10.0 ** rng.uniform(-3, 0.5, (3000, 1))
        around = box.corners[rng.integers(8, size=3000)]
        if np.isfinite(far):
            around = np.where(rng.random((3000, 1)) < 0.5, around, found.on_hull_world - origin)
            assert contains_points(hull, found.on_hull_world[None])[0]
            assert box.signed_distance(found.on_hull_world[None] - origin)[0] == pytest.approx(
                far, abs=1e-9
            )
        points = around + spread * rng.normal(size=(3000, 3))
        inside = contains_points(hull, points + origin)
        assert (box.signed_distance(points[inside]) >= near - 1e-9).all()


def _narrow_views(rng: np.random.Generator) -> Views:
    """Cameras that abstain, and that show a part of what is about the origin only."""
    n_cameras = int(rng.integers(2, 7))
    sizes, matrices = rng.integers(16, 120, (n_cameras, 2)), []
    for width, height in sizes.tolist():
        direction = rng.normal(size=3)
        center = direction / np.linalg.norm(direction) * rng.uniform(1.5, 4.0)
        pose = look_at(center, 0.25 * rng.normal(size=3), rng.uniform(0, 6))
        focal_px = rng.uniform(1.0, 5.0) * max(width, height)
        matrices.append(projection(pose, focal_px, width, height))
    names = tuple(f"cam{k}" for k in range(n_cameras))
    least = int(rng.integers(1, n_cameras + 1))
    views = make_views(names, sizes, np.array(matrices), "keep", least)
    return with_gaps(rng, views) if rng.random() < 0.5 else views


@pytest.mark.parametrize("seed", some_of(range(6)))
def test_bounds_come_together_where_cameras_see_parts_and_abstain(seed: int) -> None:
    """Cubes astride what a camera sees must not stay open: it sees no object pixel in its part."""
    rng = np.random.default_rng([8, seed])
    tolerance_m, n_found = 1e-3, 0
    for _ in range(20):
        views = _narrow_views(rng)
        kinds = rng.choice(["blobs", "blobs", "half", "holes", "noise"], len(views)).tolist()
        hull, box = make_hull(views, random_masks(rng, views, kinds)), Box(rng)
        meter = ClearanceMeter(box.vertices, box.faces, is_closed=True, tolerance_m=tolerance_m)

        found = meter.measure(hull)

        points = box.center + rng.normal(size=(3000, 3)) * 10.0 ** rng.uniform(-2, 0.3, (3000, 1))
        inside = contains_points(hull, points)
        assert (box.signed_distance(points[inside]) >= found.signed_m[0] - 1e-9).all()
        if np.isfinite(found.upper_m):
            n_found += 1
            assert contains_points(hull, found.on_hull_world[None])[0]
            assert found.upper_m - found.lower_m <= tolerance_m + 1e-9
    assert n_found >= 10


@pytest.mark.parametrize("seed", some_of(range(10)))
def test_cells_that_are_dropped_hold_no_point_of_the_hull(seed: int) -> None:
    rng = np.random.default_rng([6, seed])
    n_dropped = n_inside = 0
    for _ in range(20):
        hull = _random_hull(rng)
        half_m = float(10.0 ** rng.uniform(-2.5, 0.5))
        center = rng.normal(size=(40, 3)) * 0.4
        asked = make_cell_frame(hull, hull.views.origin_world, 10.0)
        whole, part_center = split_cells(center, half_m, asked)
        assert (np.diff(whole) >= 0).all()
        octants = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij")).reshape(3, -1).T
        everywhere = (center[:, None] + half_m * octants[:, ::-1]).reshape(-1, 3)  # x changes first
        apart = np.abs(part_center[:, None] - everywhere).max(axis=2)  # (K, 320)
        part = apart.argmin(axis=1)
        assert (apart.min(axis=1) < 1e-12).all()
        np.testing.assert_array_equal(part // 8, whole)
        dropped = np.setdiff1d(np.arange(320), part)
        n_dropped += len(dropped)
        points = everywhere[dropped][:, None] + half_m * rng.uniform(-1, 1, (len(dropped), 50, 3))
        corners = everywhere[dropped][:, None] + half_m * octants
        for tried in (points, corners):
            tried_world = tried.reshape(-1, 3) + hull.views.origin_world
            assert not contains_points(hull, tried_world).any()
        # A centre is called inside if it is, but for those on the edge of a pixel.
        inside = are_inside(part_center, asked.offset_local, asked.frame)
        truly = contains_points(hull, part_center + hull.views.origin_world)
        assert not (inside & ~truly).any()
        assert (truly & ~inside).sum() <= 1
        n_inside += int(inside.sum())
    assert n_dropped > 1000
    assert n_inside > 100


@pytest.mark.parametrize("seed", some_of(range(5)))
def test_what_was_measured_before_changes_nothing(seed: int) -> None:
    rng = np.random.default_rng([7, seed])
    box = Box(rng)
    used = ClearanceMeter(box.vertices, box.faces, is_closed=True)
    for _ in range(12):
        views = random_views(rng, 4)
        hull = make_hull(views, random_masks(rng, views, ["blobs"] * 4))
        shift = rng.normal(size=3) * 0.3
        fresh = ClearanceMeter(box.vertices, box.faces, is_closed=True)
        a, b = used.measure(hull, shift), fresh.measure(hull, shift)
        assert a.signed_m == b.signed_m
        np.testing.assert_array_equal(a.on_hull_world, b.on_hull_world)
        np.testing.assert_array_equal(a.on_object_world, b.on_object_world)
        # Moving the object is measuring another object: the same bounds hold for both.
        moved = ClearanceMeter(box.vertices + shift, box.faces, is_closed=True).measure(hull)
        assert moved.signed_m[0] <= a.signed_m[1] + 1e-9
        assert a.signed_m[0] <= moved.signed_m[1] + 1e-9
