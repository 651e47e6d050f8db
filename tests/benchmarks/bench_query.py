"""The volume query, side by side: engines, plain NumPy, and what a user would pick instead.

4 cameras of 720 x 486, viewport 10, a ball on the rim of a sphere of triangles, about 2 % of which
collide. ``bench_frame`` goes from masks to hits, integral images included; ``bench_query`` from the
hull to hits; ``bench_moving`` the same with new vertices in every frame. ``bench_voxels_and_fcl``
is carving with Open3D, a surface by marching cubes, and python-fcl. ``bench_curtain`` is the
paper's case; ``bench_floor`` reads and writes no more than each frame must.

Run: pytest tests/benchmarks/bench_query.py --full
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from helpers.compiled import source_of
from helpers.hulls import ball_hull, look_at, projection, ring_views, sphere_mesh
from numpy.typing import NDArray

from hybridve.hull.query import clusters, rectangles
from hybridve.hull.query.choose import open_engine
from hybridve.hull.query.engine import Engine, Triangles
from hybridve.hull.query.native import Native
from hybridve.hull.query.silhouettes import Hull, Views, make_hull, make_views
from hybridve.hull.query.stencil import Stencil
from hybridve.hull.query.threads import Threads

BALL_CENTER, BALL_RADIUS_M, SPHERE_RADIUS_M = np.array([0.5, 0.0, 0.0]), 0.17, 0.5

#: The largest mesh for which an engine is timed: beyond, it takes seconds a frame.
LARGEST = {"native": 4_000_000, "compute": 4_000_000, "stencil": 200_000, "reference": 20_000}

SIZES = [720, 20_000, 200_000, 1_000_000, 4_000_000]

Masks = list[NDArray[np.uint8]]


@pytest.fixture(scope="module")
def views() -> Views:
    return ring_views(4, 720, 486)


@pytest.fixture(scope="module")
def masks(views: Views) -> Masks:
    hull = ball_hull(views, BALL_CENTER, BALL_RADIUS_M)
    return [hull.mask(camera).copy() for camera in range(len(views))]


@pytest.fixture(scope="module", params=list(LARGEST))
def engine(request: pytest.FixtureRequest) -> Iterator[Engine]:
    with open_engine(request.param) as engine:
        yield engine


def mesh_for(engine: Engine, n_triangles: int) -> Triangles:
    if n_triangles > LARGEST[engine.name]:
        pytest.skip(f"{engine.name} takes seconds a frame")
    return sphere_mesh(n_triangles, SPHERE_RADIUS_M)


def frames(views: Views, masks: Masks) -> Callable[[], Hull]:
    """Return what gives two hulls in turn, so that no engine keeps the silhouettes of the last."""
    hulls = [make_hull(views, masks), make_hull(views, masks)]
    numbers = iter(range(1 << 30))
    return lambda: hulls[next(numbers) % 2]


def tell(benchmark: Any, mesh: Triangles, engine: Engine, hull: Hull) -> None:
    (hits,) = engine.query(hull, [mesh])
    triangle, _ = hits.samples()
    colliding = len(np.unique(triangle)) / len(mesh)
    assert 0.015 < colliding < 0.035
    benchmark.extra_info.update(
        triangles=len(mesh),
        colliding=colliding,
        hits=len(hits),
        runs=len(hits.start),
        renderer=engine.renderer,
    )


@pytest.mark.parametrize("n_triangles", SIZES)
@pytest.mark.smallest(n_triangles=720)
def bench_frame(
    benchmark: Any, engine: Engine, views: Views, masks: Masks, n_triangles: int
) -> None:
    """One frame of a mesh that stands still: masks, integral images, hits."""
    mesh = mesh_for(engine, n_triangles)
    for _ in range(2):
        tell(benchmark, mesh, engine, make_hull(views, masks))
    benchmark(lambda: engine.query(make_hull(views, masks), [mesh]))


@pytest.mark.parametrize("n_triangles", SIZES)
@pytest.mark.smallest(n_triangles=720)
def bench_query(
    benchmark: Any, engine: Engine, views: Views, masks: Masks, n_triangles: int
) -> None:
    """The same without the integral images, which do not depend on the mesh."""
    mesh = mesh_for(engine, n_triangles)
    next_hull = frames(views, masks)
    for _ in range(2):
        tell(benchmark, mesh, engine, next_hull())
    benchmark(lambda: engine.query(next_hull(), [mesh]))


@pytest.mark.parametrize("n_triangles", SIZES)
@pytest.mark.smallest(n_triangles=720)
def bench_every_hit(benchmark: Any, views: Views, masks: Masks, n_triangles: int) -> None:
    """``native``, and then triangle and number of each single sample instead of runs."""
    next_hull = frames(views, masks)
    with Native() as engine:
        mesh = mesh_for(engine, n_triangles)
        for _ in range(2):
            tell(benchmark, mesh, engine, next_hull())
        benchmark(lambda: engine.query(next_hull(), [mesh])[0].samples())


@pytest.mark.parametrize("n_triangles", SIZES)
@pytest.mark.smallest(n_triangles=720)
def bench_moving(
    benchmark: Any, engine: Engine, views: Views, masks: Masks, n_triangles: int
) -> None:
    """A mesh whose vertices are new in every frame: copied, checked, uploaded, queried."""
    mesh = mesh_for(engine, n_triangles)
    next_hull = frames(views, masks)
    tell(benchmark, mesh, engine, next_hull())
    vertices = mesh.vertices_world + 0.0
    benchmark(lambda: engine.query(next_hull(), [mesh.moved(vertices)]))


@pytest.mark.parametrize("viewport", [64, 512])
@pytest.mark.smallest(viewport=64, engine="native")
def bench_large_viewport(
    benchmark: Any, engine: Engine, views: Views, masks: Masks, viewport: int
) -> None:
    """Few triangles, many samples each: what halving the grid is for."""
    if engine.name == "reference" and viewport > 64:
        pytest.skip("the specification is slow: minutes")
    mesh = sphere_mesh(720, SPHERE_RADIUS_M, viewport)
    next_hull = frames(views, masks)
    benchmark.extra_info.update(
        samples=len(mesh) * viewport * (viewport + 1) // 2, renderer=engine.renderer
    )
    engine.query(next_hull(), [mesh])
    benchmark(lambda: engine.query(next_hull(), [mesh]))


def bench_hull(benchmark: Any, views: Views, masks: Masks) -> None:
    """Masks and integral images of one frame."""
    benchmark(lambda: make_hull(views, masks))


@pytest.mark.parametrize("what", ["masks in, integrals out", "a million triangles in"])
def bench_floor(benchmark: Any, masks: Masks, what: str) -> None:
    """What a frame cannot do without: read the masks and write the integral images once.

    And where the vertices are new in every frame, read them and the faces once.
    """
    if what.startswith("masks"):
        source = np.concatenate([mask.ravel() for mask in masks])
        target = np.zeros(len(source), np.int32)
        benchmark.extra_info["bytes"] = source.nbytes + target.nbytes
        benchmark(lambda: np.copyto(target, source))
    else:
        mesh = sphere_mesh(1_000_000, SPHERE_RADIUS_M)
        benchmark.extra_info["bytes"] = mesh.vertices_world.nbytes + mesh.faces.nbytes
        benchmark(lambda: (mesh.vertices_world.max(), mesh.faces.max()))


@pytest.mark.parametrize("n_triangles", [1_000_000, 4_000_000])
@pytest.mark.smallest(n_triangles=1_000_000)
def bench_work(
    benchmark: Any,
    monkeypatch: pytest.MonkeyPatch,
    views: Views,
    masks: Masks,
    n_triangles: int,
) -> None:
    """How many clusters and triangles a query asks, and samples: `extra_info`; the time is none.

    The sources of the compiled loops run, so that they can be counted.
    """
    mesh, threads = sphere_mesh(n_triangles, SPHERE_RADIUS_M), Threads(1)
    next_hull = frames(views, masks)
    asked = {"clusters": 0, "triangles": 0}
    for name, what, place in (
        ("_node_verdict", "clusters", None),
        ("_batch_verdicts", "triangles", 1),
    ):
        compiled = getattr(rectangles, name)

        def count(
            *given: Any, _of: Any = compiled, _as: str = what, _at: int | None = place
        ) -> Any:
            asked[_as] += 1 if _at is None else int(given[_at])
            return _of(*given)

        monkeypatch.setattr(rectangles, name, count)
    monkeypatch.setattr(clusters, "open_nodes", source_of(rectangles.open_nodes))
    for _ in range(2):  # clusters are made for the second frame
        asked.update(clusters=0, triangles=0)
        hull = next_hull()
        frame = hull.frame
        shares = clusters.make_shares(hull, frame, mesh, threads)
        left = [source_of(rectangles.survivors)(*share, frame) for share in shares]
    sampled = sum(int(part.is_open.any(axis=1).sum()) for part in left)
    benchmark.extra_info.update(asked, sampled=sampled)
    benchmark.pedantic(lambda: None, rounds=1)


class VoxelsAndFcl:
    """Carving with Open3D, a surface by marching cubes, python-fcl against the CAD.

    The volume carved is the cube about the ball, with edges of three radii: a user who knows where
    the hand is would carve no more. The CAD's bounding volume hierarchy is built once.
    """

    def __init__(self, views: Views, mesh: Triangles, voxel_m: float) -> None:
        import open3d
        import trimesh

        self._open3d, self._trimesh = open3d, trimesh
        self._views, self._voxel_m = views, voxel_m
        self._edge_m = 3 * BALL_RADIUS_M
        self._origin = BALL_CENTER - self._edge_m / 2
        self._cad = trimesh.collision.CollisionManager()
        self._cad.add_object(
            "cad", trimesh.Trimesh(mesh.vertices_world, mesh.faces, process=False, validate=False)
        )
        self._cameras = []
        for matrix, (width, height) in zip(views.img_from_local, views.sizes_px, strict=True):
            camera = open3d.camera.PinholeCameraParameters()
            pinhole, pose = decomposed(matrix, views.origin_world)
            camera.intrinsic = open3d.camera.PinholeCameraIntrinsic(
                int(width), int(height), pinhole
            )
            camera.extrinsic = pose
            self._cameras.append(camera)

    def query(self, masks: Masks) -> int:
        """Return how many triangles of the CAD touch the carved surface."""
        open3d, trimesh = self._open3d, self._trimesh
        grid = open3d.geometry.VoxelGrid.create_dense(
            self._origin, np.zeros(3), self._voxel_m, self._edge_m, self._edge_m, self._edge_m
        )
        for mask, camera in zip(masks, self._cameras, strict=True):
            image = open3d.geometry.Image(mask.astype(np.float32))
            grid.carve_silhouette(image, camera, keep_voxels_outside_image=False)
        cells = np.array([voxel.grid_index for voxel in grid.get_voxels()]).reshape(-1, 3)
        filled = np.zeros(np.array(cells.max(axis=0)) + 3, np.bool_)
        filled[tuple(cells.T + 1)] = True
        surface = trimesh.voxel.ops.matrix_to_marching_cubes(filled, pitch=self._voxel_m)
        surface.apply_translation(self._origin - 0.5 * self._voxel_m)
        _, contacts = self._cad.in_collision_single(surface, return_data=True)
        return len({contact.index("cad") for contact in contacts})


def decomposed(
    img_from_local: NDArray[np.float64], origin_world: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return pinhole matrix (3, 3) and pose (4, 4) cam_from_world of a projection."""
    import cv2

    matrix = img_from_local.copy()
    matrix[:, 3] -= matrix[:, :3] @ origin_world
    pinhole, rotation = cv2.decomposeProjectionMatrix(matrix)[:2]
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = np.linalg.solve(pinhole, matrix[:, 3])
    return pinhole / pinhole[2, 2], pose


@pytest.mark.parametrize("voxel_mm", [10, 5])
@pytest.mark.parametrize("n_triangles", [720, 20_000, 200_000])
@pytest.mark.smallest(n_triangles=720, voxel_mm=10)
def bench_voxels_and_fcl(
    benchmark: Any, views: Views, masks: Masks, n_triangles: int, voxel_mm: int
) -> None:
    """What a user would pick today; `colliding` beside that of the engines."""
    mesh = sphere_mesh(n_triangles, SPHERE_RADIUS_M)
    peer = VoxelsAndFcl(views, mesh, voxel_mm / 1000)
    with Native() as engine:
        (hits,) = engine.query(make_hull(views, masks), [mesh])
    benchmark.extra_info.update(
        triangles=len(mesh),
        touched_by_the_surface=peer.query(masks),
        colliding_native=len(np.unique(hits.samples()[0])),
    )
    benchmark.pedantic(lambda: peer.query(masks), rounds=3, warmup_rounds=1)


def curtain(phase: float) -> NDArray[np.float64]:
    """Return the vertices of a curtain 1.4 m wide and 1 m high, as it waves: 18 x 20 squares."""
    across, up = np.meshgrid(np.linspace(-0.7, 0.7, 21), np.linspace(-0.5, 0.5, 19))
    depth = 0.03 * np.sin(9 * across + phase) + 0.02 * np.cos(5 * up + phase)
    return np.stack([across, depth, up], axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("name", ["stencil-400", "stencil", "native", "compute", "reference"])
def bench_curtain(benchmark: Any, name: str) -> None:
    """The paper's curtain: 720 triangles, new in every frame, 10 x 10 viewports, 4 cameras.

    Three cameras of 720 x 486 and one of 640 x 480; the paper's window of 400 x 400 took 167 ms on
    its machine of 2003 (6 frames a second, response included).
    """
    sizes = np.array([[720, 486]] * 3 + [[640, 480]])
    eyes = np.array([[2.5, -2.0, 1.5], [-2.5, -2.0, 1.5], [1.0, -3.0, 1.8], [0.0, -1.2, 0.5]])
    matrices = [
        projection(look_at(eye, np.zeros(3)), 600.0 if number < 3 else 400.0, *size)
        for number, (eye, size) in enumerate(zip(eyes, sizes.tolist(), strict=True))
    ]
    views = make_views(("wall 1", "wall 2", "wall 3", "head"), sizes, np.array(matrices))
    masks = [
        ball_hull(views, np.array([0.1, 0.0, 0.1]), 0.09).mask(camera).copy() for camera in range(4)
    ]
    row, column = np.meshgrid(np.arange(18), np.arange(20), indexing="ij")
    corner = (21 * row + column).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + 21], axis=1),
            np.stack([corner + 1, corner + 22, corner + 21], axis=1),
        ]
    ).astype(np.int32)
    mesh = Triangles(curtain(0.0), faces, np.full(len(faces), 10, np.int32))
    assert len(mesh) == 720
    with Stencil(window_px=400) if name == "stencil-400" else open_engine(name) as engine:  # type: ignore[arg-type]
        phases = iter(0.1 * np.arange(1 << 20))

        def frame() -> int:
            moved = mesh.moved(curtain(next(phases)))
            return len(engine.query(make_hull(views, masks), [moved])[0])

        assert frame() > 100
        benchmark.extra_info.update(renderer=engine.renderer, frames=1)
        benchmark(frame)
