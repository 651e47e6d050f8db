"""Clearance where the answer is known in closed form, and where there is none."""

import numpy as np
import pytest
from helpers.hulls import ball_masks, look_at, projection, ring_views
from numpy.typing import NDArray

from hybridve.hull.cad.distance import SurfaceDistance
from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.contact.lattice import Best, DistanceLattice, bound_cells
from hybridve.hull.query.cells import make_cell_frame
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, Views, make_hull, make_views
from hybridve.hull.synth.meshes import box_mesh

Mesh = tuple[NDArray[np.float64], NDArray[np.int32]]


def box(size_m: tuple[float, float, float], center: tuple[float, float, float]) -> Mesh:
    x, y, z = (1000 * size for size in size_m)
    mesh = box_mesh((x, y, z), 100.0)
    return mesh.vertices_mm / 1000 + np.array(center), mesh.faces.astype(np.int32)


def sheet(half_m: float, height_m: float) -> Mesh:
    corners = half_m * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return corners + np.array([0, 0, height_m]), np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def level_views(n_cameras: int, distance_m: float, width_px: int, focal_px: float) -> Views:
    """Cameras on a ring in the plane z = 0 that look at the origin."""
    matrices = [
        projection(
            look_at(distance_m * np.array([np.cos(angle), np.sin(angle), 0.0]), np.zeros(3)),
            focal_px,
            width_px,
            width_px,
        )
        for angle in 2 * np.pi * np.arange(n_cameras) / n_cameras
    ]
    names = tuple(f"cam{k}" for k in range(n_cameras))
    return make_views(names, np.full((n_cameras, 2), width_px), np.array(matrices))


@pytest.mark.parametrize("n_cameras", [3, 4, 7])
@pytest.mark.parametrize("height_m", [0.1, 0.25, 0.6])
def test_hull_of_a_ball_below_a_ceiling(n_cameras: int, height_m: float) -> None:
    """Level cameras at distance D see a ball of radius r: its hull is D r / sqrt(D^2 - r^2) high.

    The tangent cones all meet above the centre; anywhere else one of the cameras is nearer.
    """
    distance_m, radius_m, focal_px = 2.0, 0.08, 2000.0
    views = level_views(n_cameras, distance_m, 400, focal_px)
    hull = make_hull(views, ball_masks(views, np.zeros(3), radius_m))
    top_m = distance_m * radius_m / np.sqrt(distance_m**2 - radius_m**2)
    footprint_m = (distance_m + radius_m) / focal_px
    for is_closed, (vertices, faces) in (
        (True, box((1.0, 1.0, 0.2), (0, 0, height_m + 0.1))),
        (False, sheet(0.5, height_m)),
    ):
        found = ClearanceMeter(vertices, faces, is_closed=is_closed).measure(hull)
        assert found.upper_m - found.lower_m <= 1e-4 + 1e-9
        # Half a pixel either way: a pixel is of the silhouette if its centre is.
        assert found.lower_m - footprint_m <= height_m - top_m <= found.upper_m + footprint_m
        assert found.on_object_world[2] == pytest.approx(height_m)
        assert found.on_hull_world[2] == pytest.approx(height_m - found.upper_m)
        assert (found.depth_lower_m == 0) if is_closed else np.isnan(found.depth_lower_m)


def test_depth_of_a_ball_in_a_table() -> None:
    """The lowest point of the hull lies as deep under the table's top as it hangs below it."""
    distance_m, radius_m, focal_px = 2.0, 0.08, 2000.0
    views = level_views(4, distance_m, 400, focal_px)
    hull = make_hull(views, ball_masks(views, np.zeros(3), radius_m))
    bottom_m = distance_m * radius_m / np.sqrt(distance_m**2 - radius_m**2)
    footprint_m = (distance_m + radius_m) / focal_px
    meter = ClearanceMeter(*box((2.0, 2.0, 1.0), (0, 0, -0.55)), is_closed=True)
    for drop_m in (0.0, 0.02, -0.025):
        found = meter.measure(hull, np.array([0, 0, drop_m]))
        depth_m = bottom_m - 0.05 + drop_m
        assert (found.lower_m, found.upper_m) == (0, 0)
        assert found.depth_upper_m - found.depth_lower_m <= 1e-4 + 1e-9
        assert found.depth_lower_m - footprint_m <= depth_m <= found.depth_upper_m + footprint_m
        assert found.on_hull_world[2] == pytest.approx(-0.05 + drop_m - found.depth_lower_m)
        assert found.on_object_world[2] == pytest.approx(-0.05 + drop_m)


def test_a_hull_wholly_inside_a_solid_is_deep_in_it_and_before_an_open_one_apart() -> None:
    views = ring_views()
    hull = make_hull(views, ball_masks(views, np.zeros(3), 0.05))
    vertices, faces = box((0.6, 0.6, 0.6), (0.0, 0.0, 0.0))
    solid = ClearanceMeter(vertices, faces, is_closed=True).measure(hull)
    assert solid.upper_m == 0
    assert solid.depth_lower_m <= 0.3 <= solid.depth_upper_m  # of its middle
    assert solid.depth_upper_m - solid.depth_lower_m < 1e-3
    shell = ClearanceMeter(vertices, faces, is_closed=False).measure(hull)
    assert 0.2 < shell.lower_m <= shell.upper_m < 0.25
    assert np.isnan(shell.depth_upper_m)


def test_touching_is_no_distance() -> None:
    """A sheet through the hull: nothing between them, and no depth, as it bounds no solid."""
    views = ring_views()
    hull = make_hull(views, ball_masks(views, np.zeros(3), 0.05))
    found = ClearanceMeter(*sheet(0.5, 0.01), is_closed=False).measure(hull)
    assert (found.lower_m, found.upper_m) == (0, 0)
    np.testing.assert_allclose(found.on_hull_world[2], 0.01)
    assert contains_points(hull, found.on_hull_world[None])[0]
    assert np.isnan(found.depth_lower_m)


def _masks(views: Views, value: int) -> list[NDArray[np.uint8]]:
    return [np.full((height, width), value, np.uint8) for width, height in views.sizes_px.tolist()]


def test_no_hull_is_far_away() -> None:
    views = ring_views()
    meter = ClearanceMeter(*box((0.2, 0.2, 0.2), (0, 0, 0)), is_closed=True)
    found = meter.measure(make_hull(views, _masks(views, 0)))
    assert found.lower_m > 10
    assert found.upper_m == np.inf
    assert np.isnan(found.on_hull_world).all()
    assert np.isnan(found.on_object_world).all()
    assert (found.depth_lower_m, found.depth_upper_m) == (0, 0)


def test_everything_is_hull() -> None:
    """Full images: the middle of the box is in the hull, and nothing is deeper in it."""
    views = ring_views()
    found = ClearanceMeter(*box((0.2, 0.3, 0.4), (0, 0, 0)), is_closed=True).measure(
        make_hull(views, _masks(views, 1))
    )
    assert (found.lower_m, found.upper_m) == (0, 0)
    assert found.depth_lower_m <= 0.1 <= found.depth_upper_m + 1e-9
    assert found.depth_upper_m - found.depth_lower_m < 0.01


def test_it_stops_early_when_told_and_says_nothing_false() -> None:
    views = ring_views()
    hull = make_hull(views, ball_masks(views, np.zeros(3), 0.05))
    meter = ClearanceMeter(*sheet(0.5, 0.3), is_closed=False)
    exact = meter.measure(hull)
    above = meter.measure(hull, stop_above_m=0.1)
    below = meter.measure(hull, stop_below_m=0.4)
    for early in (above, below):
        assert early.upper_m - early.lower_m > 1e-3
        assert early.lower_m <= exact.upper_m
        assert exact.lower_m <= early.upper_m
    assert above.lower_m > 0.1
    assert below.upper_m < 0.4
    assert contains_points(hull, below.on_hull_world[None])[0]


def test_a_finer_tolerance_narrows_the_bounds() -> None:
    views = ring_views()
    hull = make_hull(views, ball_masks(views, np.zeros(3), 0.05))
    bounds = []
    for tolerance_m in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        meter = ClearanceMeter(*sheet(0.5, 0.2), is_closed=False, tolerance_m=tolerance_m)
        found = meter.measure(hull)
        assert found.upper_m - found.lower_m <= tolerance_m + 1e-9
        bounds.append((found.lower_m, found.upper_m))
    lowers, uppers = zip(*bounds, strict=True)
    assert max(lowers) <= min(uppers)


def test_what_cannot_be_measured_is_refused() -> None:
    vertices, faces = sheet(0.5, 0.0)
    with pytest.raises(ValueError, match="tolerance is 0"):
        ClearanceMeter(vertices, faces, is_closed=False, tolerance_m=0)
    with pytest.raises(ValueError, match="no triangle"):
        ClearanceMeter(vertices, faces[:0], is_closed=False)
    vertices[2, 0] = np.nan
    with pytest.raises(ValueError, match="vertex 2 is not finite"):
        ClearanceMeter(vertices, faces, is_closed=False)


def _segment_distance(
    points: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]
) -> NDArray[np.float64]:
    way = b - a
    length = np.maximum((way * way).sum(axis=-1), 1e-300)
    along = np.clip(((points[:, None] - a) * way).sum(axis=-1) / length, 0, 1)
    return np.asarray(np.linalg.norm(points[:, None] - a - along[..., None] * way, axis=-1))


def _soup_distance(
    points: NDArray[np.float64], corners: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The specification: the nearest of all triangles' edges and planes, (N,)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    distance = np.minimum(
        _segment_distance(points, a, b),
        np.minimum(_segment_distance(points, b, c), _segment_distance(points, c, a)),
    )
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    normal /= np.where(length > 0, length, 1.0)[:, None]
    over = np.repeat(length[None] > 0, len(points), axis=0)
    for start, stop in ((a, b), (b, c), (c, a)):
        side = np.cross(stop - start, points[:, None] - start)
        over &= np.einsum("ntk,tk->nt", side, normal) >= 0
    height = np.abs(np.einsum("ntk,tk->nt", points[:, None] - a, normal))
    return np.asarray(np.where(over, np.minimum(height, distance), distance).min(axis=1))


def test_distances_agree_with_the_specification_on_slivers_too() -> None:
    rng = np.random.default_rng(0)
    corners = rng.normal(size=(300, 3, 3)) * 0.1 + rng.normal(size=(300, 1, 3)) * 0.3
    corners[:100, 2] = corners[:100, 0] + 1e-7 * rng.normal(size=(100, 3))  # slivers
    corners[100:110, 1] = corners[100:110, 0]  # no area
    faces = np.arange(900, dtype=np.int32).reshape(-1, 3)
    surface = SurfaceDistance(corners.reshape(-1, 3), faces, is_closed=False)
    points = rng.normal(size=(2000, 3)) * 0.4
    points[:500] = corners[rng.integers(300, size=500)].mean(axis=1) + 1e-5 * points[:500]
    distance, nearest, triangle = surface.closest(points)
    np.testing.assert_allclose(distance, _soup_distance(points, corners), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(points - nearest, axis=1), distance, atol=1e-12)
    on_triangle = [
        _soup_distance(point[None], corners[[number]])[0]
        for point, number in zip(nearest[:100], triangle[:100], strict=True)
    ]
    np.testing.assert_allclose(on_triangle, 0, atol=1e-9)
    assert surface.closest(np.zeros((0, 3)))[0].shape == (0,)


def test_the_side_of_a_closed_surface() -> None:
    vertices, faces = box((0.2, 0.3, 0.4), (0, 0, 0))
    surface = SurfaceDistance(vertices, faces, is_closed=True)
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.3, 0.3, (20_000, 3))
    beyond = np.abs(points) - [0.1, 0.15, 0.2]
    expected = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
    distance, _ = surface.signed(points)
    # Within a millionth of the size the side is not asked.
    np.testing.assert_allclose(distance, expected, atol=1e-6)
    assert (distance < 0).sum() > 1000


@pytest.mark.slow
def test_a_lattice_computes_a_distance_once() -> None:
    """Corners are shared by neighbours, by levels and by frames."""
    lattice = DistanceLattice(SurfaceDistance(*sheet(0.5, 0.0), is_closed=False), 4.0)
    grid = np.array(np.meshgrid(*[np.arange(-3, 4, 2.0)] * 3)).reshape(3, -1).T  # 4 x 4 x 4 cubes
    for _ in range(2):
        cubes = lattice.cubes(grid, 1.0, 0.1)
        assert lattice.corners.n == len(np.unique(cubes.corner)) == 5**3
    eighth = lattice.cubes(grid[:1] / 2, 0.5, 0.1)  # some of its corners are known
    assert lattice.corners.n == 5**3 + np.count_nonzero(eighth.corner >= 5**3) <= 5**3 + 7
    octants = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij")).reshape(3, -1).T
    corners = grid[:, None] + octants[:, ::-1]  # x changes first
    expected = np.linalg.norm(
        np.concatenate([np.maximum(np.abs(corners[..., :2]) - 0.5, 0), corners[..., 2:]], -1),
        axis=-1,
    )
    np.testing.assert_allclose(lattice.corners.distance_m[cubes.corner], expected, atol=1e-12)


@pytest.mark.parametrize("is_closed", [True, False])
def test_bounds_of_cells_hold_at_every_point_of_them(is_closed: bool) -> None:
    """Cells in cubes larger by any power of two, on either side of and across a surface."""
    rng = np.random.default_rng(2)
    half = np.array([0.1, 0.15, 0.02])
    surface = SurfaceDistance(*box(tuple(2 * half), (0, 0, 0)), is_closed=is_closed)
    views = ring_views()
    asked = make_cell_frame(make_hull(views, _masks(views, 0)), np.zeros(3), 4.0)
    sides = set()
    for level in range(3, 14):
        lattice = DistanceLattice(surface, 4.0)
        cube_half_m = 4.0 / 2**level
        steps = np.floor(half * rng.uniform(-1.5, 1.5, (40, 3)) / (2 * cube_half_m))
        cube_center = (2 * steps + 1) * cube_half_m
        cubes = lattice.cubes(cube_center, cube_half_m, 1e-4)
        sides |= set(cubes.side.tolist())
        for deeper in (0, 1, 2, 5):
            half_m = cube_half_m / 2**deeper
            place = rng.integers(0, 2**deeper, (40, 3))
            center = cube_center - cube_half_m + (2 * place + 1) * half_m
            lower_m, deepest = bound_cells(
                center,
                half_m,
                np.arange(40),
                cubes,
                lattice.corners.distance_m,
                lattice.corners.nearest,
                surface.error_m(16.0),
                asked,
                Best(np.full(1, np.inf), np.full(3, np.nan)),
            )
            assert deepest == -1
            points = center[:, None] + half_m * rng.uniform(-1, 1, (40, 200, 3))
            beyond = np.abs(points) - half
            outside = np.linalg.norm(np.maximum(beyond, 0), axis=-1)
            truth = outside + np.minimum(beyond.max(axis=-1), 0)
            truth = truth if is_closed else np.abs(truth)
            assert (truth >= lower_m[:, None] - 1e-6).all()  # the side is not asked that near
            # And they are worth something: within a diagonal of what was found.
            assert (truth.min(axis=1) - lower_m <= 4 * np.sqrt(3) * cube_half_m).all()
    assert sides == ({-1, 0, 1} if is_closed else {1})


@pytest.mark.slow
def test_forgetting_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    views = ring_views()
    hulls: list[Hull] = [
        make_hull(views, ball_masks(views, np.array([0.01 * k, 0, 0]), 0.05)) for k in range(6)
    ]
    vertices, faces = box((0.2, 0.2, 0.2), (0.3, 0, 0))
    remembering = ClearanceMeter(vertices, faces, is_closed=True)
    expected = [remembering.measure(hull).signed_m for hull in hulls]
    monkeypatch.setattr("hybridve.hull.contact.lattice._MOST_CORNERS", 100)
    forgetting = ClearanceMeter(vertices, faces, is_closed=True)
    assert [forgetting.measure(hull).signed_m for hull in hulls] == expected


@pytest.mark.slow
@pytest.mark.parametrize("voxel_m", [0.01, 0.005])
def test_a_peer_agrees_to_the_resolution_of_its_mesh(voxel_m: float) -> None:
    """python-fcl between the CAD and a surface of the same hull by marching cubes.

    A surface point lies in a cell of the grid with a sample inside and one outside: within a
    diagonal of the hull, as the hull of a ball is thicker than the grid is wide.
    """
    import trimesh
    from skimage.measure import marching_cubes

    views = ring_views(4)
    vertices, faces = box((0.3, 0.2, 0.25), (0, 0, 0))
    meter = ClearanceMeter(vertices, faces, is_closed=True)
    peer = trimesh.collision.CollisionManager()
    peer.add_object("cad", trimesh.Trimesh(vertices, faces, process=False))
    line = np.arange(-0.1, 0.1 + voxel_m, voxel_m)
    grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(3)
    for _ in range(6):
        direction = rng.normal(size=3)
        center = direction / np.linalg.norm(direction) * rng.uniform(0.3, 0.4)
        hull = make_hull(views, ball_masks(views, center, 0.05))
        inside = contains_points(hull, grid + center).reshape((len(line),) * 3)
        corners, triangles, _, _ = marching_cubes(inside.astype(np.float32), 0.5)
        surface = trimesh.Trimesh(corners * voxel_m + line[0] + center, triangles, process=False)
        found = meter.measure(hull)
        assert found.lower_m > 0
        theirs_m = peer.min_distance_single(surface)
        assert abs(theirs_m - found.upper_m) <= np.sqrt(3) * voxel_m + 1e-4
        assert theirs_m >= found.lower_m - voxel_m / 2  # no mesh vertex is farther from the hull
