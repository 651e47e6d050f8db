"""The hull from a novel viewpoint: the device against the specification."""

from collections.abc import Iterator

import moderngl
import numpy as np
import pytest
from helpers.hulls import ball_hull, random_masks, random_views, ring_views, with_gaps
from numpy.typing import NDArray

from hybridve.hull.query.device import open_device
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, Unseen, make_hull
from hybridve.hull.view.cells import hull_cells
from hybridve.hull.view.novel import (
    NEVER_M,
    HullOnDevice,
    NovelView,
    first_surface,
    full_screen,
    hull_depth,
)

pytestmark = pytest.mark.gl

SIZE_PX = (48, 32)

#: Rays compared in a picture.
N_RAYS = 150

#: Distance of the specification's samples along a ray.
STEP_M = 4e-3

#: How far behind the device's surface a point of the hull must be: the device finds it 2e-3 px of
#: a camera too late at most, plus single precision; cameras here resolve some millimetres.
BEHIND_M = np.array([0.0, 1e-5, 1e-4, 4e-4, 1e-3])

#: Share of rays that may pass the hull so flatly that single precision decides: a corner of two
#: silhouettes is met or missed.
GRAZING_SHARE = 0.02


@pytest.fixture(scope="module")
def shared_device() -> Iterator[moderngl.Context]:
    context = open_device()
    yield context
    context.release()


@pytest.fixture
def device(shared_device: moderngl.Context) -> Iterator[moderngl.Context]:
    """A device that is clean before the test and must be clean after it."""
    assert shared_device.error == "GL_NO_ERROR"
    yield shared_device
    assert shared_device.error == "GL_NO_ERROR"
    shared_device.gc()


def view_of(
    eye: NDArray[np.float64], target: NDArray[np.float64], *, parallel: bool = False
) -> NovelView:
    """Return a view that shows about 1.4 m around the target."""
    away_m = float(np.linalg.norm(target - eye))
    forward = (target - eye) / away_m
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.9 else [1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    half = np.array([0.75, 0.5]) / (1.0 if parallel else away_m)
    range_m = (max(0.05, away_m - 1.5), away_m + 1.5)
    return NovelView(eye, right, np.cross(forward, right), forward, half, range_m, parallel)


def all_rays(view: NovelView) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    columns, rows = np.meshgrid(np.arange(SIZE_PX[0]) + 0.5, np.arange(SIZE_PX[1]) + 0.5)
    return view.rays(np.column_stack([columns.ravel(), rows.ravel()]), SIZE_PX)


def assert_is_first_surface(device: moderngl.Context, hull: Hull, view: NovelView) -> int:
    """Compare some rays with the specification; return how many hit."""
    chosen = np.random.default_rng(0).permutation(SIZE_PX[0] * SIZE_PX[1])[:N_RAYS]
    origins, directions = (rays[chosen] for rays in all_rays(view))
    # The device draws what lies in the box of the hull's cells, as far as anybody looks.
    low, high = hull_cells(hull).box_local()
    depth_m = hull_depth(device, hull, view, SIZE_PX)[0].ravel()[chosen]
    expected_m = first_surface(hull, origins, directions, view.range_m, STEP_M)
    entry = origins + np.nan_to_num(expected_m)[:, None] * directions - hull.views.origin_world
    in_box = ((entry > low) & (entry < high)).all(axis=1)
    expected_m[~in_box] = np.nan

    hit, expected_hit = np.isfinite(depth_m), np.isfinite(expected_m)
    grazing = 0
    # Never too late: where samples find the hull, the device has found it before, or right there.
    late = expected_hit & ~(depth_m <= expected_m + BEHIND_M[-1])
    grazing += int(late.sum())
    # Never too early: behind the device's surface is hull.
    points = origins[hit, None] + (depth_m[hit, None] + BEHIND_M)[..., None] * directions[hit, None]
    inside = contains_points(hull, points.reshape(-1, 3)).reshape(points.shape[:2])
    grazing += int((~inside.any(axis=1)).sum())
    assert grazing <= max(1.0, GRAZING_SHARE * hit.sum())
    return int(hit.sum())


@pytest.mark.parametrize("eye", [(2.0, -1.5, 1.0), (0.1, 0.2, 3.0), (-2.0, 0.3, -1.0)])
def test_the_hull_of_a_ball_is_found_where_the_specification_finds_it(
    device: moderngl.Context, eye: tuple[float, float, float]
) -> None:
    hull = ball_hull(ring_views(5), np.array([0.05, 0.1, 0.0]), 0.3)

    n_hits = assert_is_first_surface(device, hull, view_of(np.array(eye), np.zeros(3)))

    assert n_hits > 15


@pytest.mark.slow
@pytest.mark.parametrize("unseen", ["carve", "keep"])
@pytest.mark.parametrize("parallel", [False, True])
def test_any_hull_is_found_where_the_specification_finds_it(
    device: moderngl.Context, unseen: Unseen, parallel: bool
) -> None:
    """Cameras of all sizes and rolls, silhouettes with holes and noise, views from all around."""
    n_hits = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        n_cameras = int(rng.integers(2, 6))
        min_cameras = int(rng.integers(1, n_cameras + 1))
        views = random_views(rng, n_cameras, unseen, min_cameras, gaps=False)
        if unseen == "keep" and seed % 2:
            views = with_gaps(np.random.default_rng([1, seed]), views)
        kinds = ["blobs", *rng.choice(["blobs", "holes", "noise", "half"], n_cameras - 1)]
        hull = make_hull(views, random_masks(rng, views, kinds))
        direction = rng.normal(size=3)
        eye = views.origin_world + direction / np.linalg.norm(direction) * rng.uniform(0.8, 4.0)
        view = view_of(eye, views.origin_world, parallel=parallel)
        n_hits += assert_is_first_surface(device, hull, view)
    assert n_hits > 150, "the test would prove too little"


def test_a_hull_far_from_the_worlds_origin_is_found_as_well(device: moderngl.Context) -> None:
    """100 km away: single precision about the world's origin would be off by centimetres."""
    rng = np.random.default_rng(4)
    there = np.array([1e5, -1e5, 300.0])
    views = random_views(rng, 4, origin_world=there)
    hull = make_hull(views, random_masks(rng, views, ["blobs"] * 4))
    eye = views.origin_world + np.array([1.5, -1.0, 0.8])

    n_hits = assert_is_first_surface(device, hull, view_of(eye, views.origin_world))

    assert n_hits > 10


def test_from_a_cameras_place_one_sees_its_silhouette(device: moderngl.Context) -> None:
    """Every ray stays in one pixel of that camera: nothing in front of it can be skipped."""
    views = ring_views(3)
    hull = ball_hull(views, np.zeros(3), 0.3)
    matrix = views.img_from_local[0]
    eye = views.origin_world - np.linalg.solve(matrix[:, :3], matrix[:, 3])
    view = view_of(eye, np.zeros(3))
    origins, directions = all_rays(view)

    depth_m = hull_depth(device, hull, view, SIZE_PX)[0].ravel()

    projected = (origins + directions - views.origin_world) @ matrix[:, :3].T + matrix[:, 3]
    pixels = projected[:, :2] / projected[:, 2:]
    column, row = np.floor(pixels).astype(int).T
    on_object = hull.mask(0)[row, column] != 0
    # The other cameras see the whole ball: what this one's silhouette holds is in the hull.
    near_border = np.array(
        [
            hull.mask(0)[r - 1 : r + 2, c - 1 : c + 2].std() > 0
            for r, c in zip(row, column, strict=True)
        ]
    )
    np.testing.assert_array_equal(np.isfinite(depth_m)[~near_border], on_object[~near_border])
    assert on_object.sum() > 100


@pytest.mark.slow
def test_normals_point_out_of_the_hull_and_towards_the_eye(device: moderngl.Context) -> None:
    """Many cameras make a ball of the hull of a ball: its normals are those of a sphere."""
    views = ring_views(24, distance_m=3.0)
    hull = ball_hull(views, np.zeros(3), 0.4)
    view = view_of(np.array([2.5, 0.4, 0.6]), np.zeros(3))
    origins, directions = all_rays(view)

    depth_m, normals = hull_depth(device, hull, view, SIZE_PX)

    hit = np.isfinite(depth_m).ravel()
    normals = normals.reshape(-1, 3)
    points = (origins + np.nan_to_num(depth_m).reshape(-1, 1) * directions)[hit]
    outward = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(normals[hit], axis=1), 1.0, atol=1e-4)
    assert (np.sum(normals[hit] * directions[hit], axis=1) < 1e-4).all()
    cosines = np.sum(normals[hit] * outward, axis=1)
    # The ring leaves cones above and below, up to some 20 degrees off the sphere.
    assert np.quantile(cosines, 0.1) > np.cos(np.deg2rad(25.0))
    assert (normals[~hit] == 0).all()


def test_an_eye_inside_the_hull_sees_it_at_once(device: moderngl.Context) -> None:
    hull = ball_hull(ring_views(4), np.zeros(3), 0.4)

    view = view_of(np.array([0.05, 0.0, 0.02]), np.array([0.3, 0.1, 0.0]))
    depth_m, _ = hull_depth(device, hull, view, SIZE_PX)

    np.testing.assert_allclose(depth_m, view.range_m[0], rtol=1e-6)


@pytest.mark.parametrize("empty", [(0,), (0, 1, 2)])
@pytest.mark.parametrize("unseen", ["carve", "keep"])
def test_an_empty_silhouette_leaves_nothing(
    device: moderngl.Context, empty: tuple[int, ...], unseen: Unseen
) -> None:
    views = ring_views(3, unseen=unseen)
    masks = [np.ones((486, 720), np.uint8) for _ in range(3)]
    for camera in empty:
        masks[camera][:] = 0
    # Seen by every camera, so that with "keep" none of them abstains.
    view = NovelView(
        np.array([1.0, 0.0, 0.0]),
        np.array([0.0, 1.0, 0.0]),
        np.array([0.0, 0.0, -1.0]),
        np.array([-1.0, 0.0, 0.0]),
        np.array([0.1, 0.1]),
        (0.9, 1.1),
    )

    depth_m, _ = hull_depth(device, make_hull(views, masks), view, SIZE_PX)

    assert np.isnan(depth_m).all()


def test_a_view_beside_the_hull_shows_nothing(device: moderngl.Context) -> None:
    hull = ball_hull(ring_views(4), np.zeros(3), 0.3)

    view = view_of(np.array([2.0, 2.0, 0.5]), np.array([4.0, 4.0, 0.5]))  # it lies behind
    depth_m, _ = hull_depth(device, hull, view, SIZE_PX)

    assert np.isnan(depth_m).all()


def test_a_smaller_target_than_before_is_not_cut_by_an_old_rectangle(
    device: moderngl.Context,
) -> None:
    """One hull drawn twice into the same target: from near, where it fills the picture, and far."""
    hull = ball_hull(ring_views(4), np.zeros(3), 0.3)
    march = full_screen(device, "novel.frag.glsl")
    depth = device.texture(SIZE_PX, 1, dtype="f4")
    target = device.framebuffer([depth, device.texture(SIZE_PX, 4, dtype="f4")])
    on_device = HullOnDevice(device, march, hull)
    far, near = (view_of(np.array([away, 0.1, 0.2]), np.zeros(3)) for away in (3.0, 0.6))
    seen = []
    for view in (far, near, far):
        on_device.draw(target, view, SIZE_PX)
        seen.append(np.frombuffer(depth.read(), np.float32) < NEVER_M / 2)

    np.testing.assert_array_equal(seen[0], seen[2])
    assert seen[1].sum() != seen[0].sum()


@pytest.mark.slow
def test_the_cells_contain_the_hull() -> None:
    rng = np.random.default_rng(1)
    for seed in range(6):
        views = random_views(np.random.default_rng(seed), 4)
        hull = make_hull(views, random_masks(rng, views, ["blobs"] * 4))
        points = rng.uniform(-1.0, 1.0, (20_000, 3))
        inside = points[contains_points(hull, points + views.origin_world)]
        cells = hull_cells(hull)
        places = np.round((inside - cells.centers_local[0]) / cells.edge_m).astype(int)
        known = np.round((cells.centers_local - cells.centers_local[0]) / cells.edge_m).astype(int)

        assert len(inside) > 20
        assert set(map(tuple, places)) <= set(map(tuple, known))
