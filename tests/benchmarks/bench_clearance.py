"""Clearance of a frame, side by side: certain bounds, and a mesh of the hull asked by python-fcl.

4 cameras, one CAD object of some 20,000 triangles, every round another frame of a recording in
which a thing moves. ``bench_clearance`` bounds the distance to 0.1 mm without a surface of the
hull. ``bench_mesh_and_fcl`` does what a user would do instead: it samples the hull on a grid about
the thing, makes a surface by marching cubes (scikit-image), and asks python-fcl for the distance of
that surface from the CAD, whose bounding volumes are built once. Its extra columns tell how far its
answers are from the certain ones, in millimetres: that is the resolution of its grid, which it
cannot bound itself.

Run: pytest tests/benchmarks/bench_clearance.py --full
"""

import itertools
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.hulls import ball_masks, ring_views, sphere_mesh
from numpy.typing import NDArray

from hybridve.calib.rig import Rig
from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture.recording import FrameRange, segmented_frames
from hybridve.hull.capture.session import Session
from hybridve.hull.chain import rig_views
from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, Views, make_hull

SCENE = Path(__file__).parent.parent.parent / "data" / "horseman" / "scene.toml"
BALL_RADIUS_M = 0.06


def ball_path(views: Views, n_frames: int) -> list[tuple[Hull, NDArray[np.float64]]]:
    """Return frames in which a ball passes a sphere of radius 0.2 m at 5 to 80 mm, and its place.

    An ellipse about the sphere: every frame asks elsewhere.
    """
    frames = []
    for turn in np.linspace(0, 2 * np.pi, n_frames, endpoint=False):
        radius_m = 0.2 + BALL_RADIUS_M + 0.0425 + 0.0375 * np.cos(3 * turn)
        center = radius_m * np.array([np.cos(turn), np.sin(turn) * 0.8, 0.6 * np.sin(turn)])
        center *= radius_m / np.linalg.norm(center)
        frames.append((make_hull(views, ball_masks(views, center, BALL_RADIUS_M)), center))
    return frames


@pytest.fixture(scope="module")
def frames(is_full: bool) -> list[tuple[Hull, NDArray[np.float64]]]:
    return ball_path(ring_views(4, 720, 486), 60 if is_full else 3)


@pytest.mark.parametrize("tolerance_mm", [1.0, 0.1, 0.01])
@pytest.mark.parametrize("lap", ["first lap", "later laps"])
@pytest.mark.smallest(tolerance_mm=1.0)
def bench_clearance(benchmark: Any, frames: Any, tolerance_mm: float, lap: str) -> None:
    """Hull to bounds; distances that earlier frames computed are kept from one to the next."""
    mesh = sphere_mesh(20_000, 0.2)
    meter = ClearanceMeter(
        mesh.vertices_world, mesh.faces, is_closed=True, tolerance_m=tolerance_mm / 1e3
    )
    if lap == "later laps":
        for hull, _ in frames:
            meter.measure(hull)
    else:
        meter.measure(frames[-1][0])  # the libraries are loaded
    hulls = itertools.cycle([hull for hull, _ in frames])
    widths = []

    def measure() -> None:
        found = meter.measure(next(hulls))
        widths.append(found.upper_m - found.lower_m)

    benchmark.pedantic(measure, rounds=len(frames))
    benchmark.extra_info.update(
        triangles=len(mesh), widest_mm=round(1e3 * max(widths), 4), asked_mm=tolerance_mm
    )


class MeshAndFcl:
    """Marching cubes about the ball, and python-fcl.

    `spent_ms` gathers what sampling the hull, making the surface and asking for the distance took.
    """

    def __init__(self, vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> None:
        import trimesh

        self._trimesh = trimesh
        self.spent_ms: list[NDArray[np.float64]] = []
        self._cad = trimesh.collision.CollisionManager()
        self._cad.add_object("cad", trimesh.Trimesh(vertices, faces, process=False, validate=False))

    def distance_m(self, hull: Hull, center: NDArray[np.float64], voxel_m: float) -> float:
        """Return the distance of the surface of the hull within 10 cm of a point."""
        from skimage.measure import marching_cubes

        line = np.arange(-0.1, 0.1 + voxel_m, voxel_m)
        grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1)
        clock = [time.perf_counter()]
        inside = contains_points(hull, grid.reshape(-1, 3) + center).reshape(grid.shape[:3])
        clock.append(time.perf_counter())
        corners, triangles, _, _ = marching_cubes(inside.astype(np.float32), 0.5)
        surface = self._trimesh.Trimesh(
            corners * voxel_m + line[0] + center, triangles, process=False, validate=False
        )
        clock.append(time.perf_counter())
        distance_m = float(self._cad.min_distance_single(surface))
        self.spent_ms.append(1e3 * np.diff([*clock, time.perf_counter()]))
        return distance_m


@pytest.mark.parametrize("voxel_mm", [10, 5, 2.5])
@pytest.mark.smallest(voxel_mm=10)
def bench_mesh_and_fcl(benchmark: Any, frames: Any, voxel_mm: float) -> None:
    """Hull to a distance without bounds."""
    mesh = sphere_mesh(20_000, 0.2)
    peer = MeshAndFcl(mesh.vertices_world, mesh.faces)
    meter = ClearanceMeter(mesh.vertices_world, mesh.faces, is_closed=True)
    queue = itertools.cycle(frames)
    off_mm = []

    def measure() -> None:
        hull, center = next(queue)
        distance_m = peer.distance_m(hull, center, voxel_mm / 1e3)
        found = meter.measure(hull)
        off_mm.append(1e3 * (distance_m - (found.lower_m + found.upper_m) / 2))

    def measure_alone() -> None:
        hull, center = next(queue)
        peer.distance_m(hull, center, voxel_mm / 1e3)

    for _ in range(min(20, len(frames))):
        measure()
    benchmark.pedantic(measure_alone, rounds=20, warmup_rounds=1)
    sampling_ms, surface_ms, fcl_ms = np.median(peer.spent_ms, axis=0).round(2).tolist()
    benchmark.extra_info.update(
        sampling_ms=sampling_ms,
        surface_ms=surface_ms,
        fcl_ms=fcl_ms,
        voxel_mm=voxel_mm,
        off_median_mm=round(float(np.median(off_mm)), 3),
        off_most_mm=round(float(np.abs(off_mm).max()), 3),
    )


@pytest.fixture(scope="module")
def person(horseman: tuple[Session, Rig], is_full: bool) -> list[Hull]:
    session, rig = horseman
    views, undistortions = rig_views(session, rig)
    which = FrameRange(0, 400 if is_full else 8, 4)
    frames = segmented_frames(session, which, undistortions=undistortions)
    with closing(frames):
        return [make_hull(views, frame.masks) for frame in frames if frame.masks is not None]


@pytest.mark.recording
@pytest.mark.parametrize("part", [0, 3, 5])
@pytest.mark.smallest(part=0)
def bench_horseman(benchmark: Any, person: list[Hull], part: int) -> None:
    """A link of the robot beside the horseman, its triangles cut into four until they are 20,000.

    The base is half a metre away, the forearm and the wrist are reached into.
    """
    link = load_scene(SCENE).objects[part]
    vertices = link.vertices_world
    faces = link.faces if link.solid_faces is None else link.solid_faces
    while len(faces) < 16_000:
        vertices, faces = subdivided(vertices, faces)
    meter = ClearanceMeter(vertices, faces, is_closed=link.is_closed)
    meter.measure(person[-1])
    hulls = itertools.cycle(person)
    found = []
    benchmark.pedantic(
        lambda: found.append(meter.measure(next(hulls))), rounds=len(person), iterations=1
    )
    benchmark.extra_info.update(
        object=link.name,
        triangles=len(faces),
        widest_mm=round(1e3 * max(each.upper_m - each.lower_m for each in found), 4),
        nearest_mm=round(1e3 * min(each.signed_m[0] for each in found), 2),
    )


@pytest.mark.recording
@pytest.mark.parametrize("library", ["hybridve", "libigl", "Open3D"])
@pytest.mark.smallest(library="hybridve")
def bench_distances(benchmark: Any, recordings: Path, is_full: bool, library: str) -> None:
    """1000 distances to each part of a printer, sized to 0.4 m: time, and how far off the nearest.

    What is larger than ours, which is exact but for rounding, is wrong by that.
    """
    import igl
    import open3d

    from hybridve.hull.cad.distance import SurfaceDistance
    from hybridve.hull.cad.mesh import read_cad

    rng = np.random.default_rng(0)
    asked, off_mm = [], {"hybridve": 0.0, "libigl": 0.0, "Open3D": 0.0}
    paths = sorted((recordings / "meshes" / "prusa").glob("*.stl"))
    for path in paths if is_full else paths[:1]:
        mesh = read_cad(path).parts[0]
        vertices = mesh.vertices - (mesh.vertices.max(axis=0) + mesh.vertices.min(axis=0)) / 2
        vertices *= 0.2 / np.abs(vertices).max()
        points = vertices[mesh.faces[rng.integers(len(mesh.faces), size=1000)]].mean(axis=1)
        points += 10.0 ** rng.uniform(-4, -1, (1000, 1)) * rng.normal(size=(1000, 3))
        points = points.astype(np.float32).astype(np.float64)  # the same for both
        exact = SurfaceDistance(vertices, mesh.faces, is_closed=False)
        single = open3d.t.geometry.RaycastingScene(nthreads=1)
        single.add_triangles(
            open3d.core.Tensor.from_numpy(vertices.astype(np.float32)),
            open3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)),
        )
        tensor = open3d.core.Tensor.from_numpy(points.astype(np.float32))
        double = igl.AABB()
        numbers = mesh.faces.astype(np.int64)
        double.init(vertices, numbers)
        distance_m = exact.closest(points)[0]
        for name, found in (
            ("libigl", np.sqrt(double.squared_distance(vertices, numbers, points)[0]).ravel()),
            ("Open3D", single.compute_distance(tensor, nthreads=1).numpy()),
        ):
            off_mm[name] = max(off_mm[name], 1e3 * float((found - distance_m).max()))
        asked.append((exact, double, vertices, numbers, single, points, tensor))

    def measure() -> None:
        for exact, double, vertices, numbers, single, points, tensor in asked:
            if library == "hybridve":
                exact.closest(points)
            elif library == "libigl":
                double.squared_distance(vertices, numbers, points)
            else:
                single.compute_distance(tensor, nthreads=1)

    benchmark.pedantic(measure, rounds=5, warmup_rounds=1)
    benchmark.extra_info.update(parts=len(asked), too_large_mm=round(off_mm[library], 4))


def subdivided(
    vertices: NDArray[np.float64], faces: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return a mesh with every triangle cut into four."""
    corners = vertices[faces]  # (T, 3, 3)
    a, b, c = np.moveaxis(corners, 1, 0)
    ab, bc, ca = np.moveaxis((corners + np.roll(corners, -1, axis=1)) / 2, 1, 0)
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    vertices = np.concatenate([np.stack(part, axis=1) for part in parts]).reshape(-1, 3)
    return vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
