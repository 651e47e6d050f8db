"""Inside or outside of real CAD: how often is each way of asking wrong, and how long does it take?

Every closed part of the meshes in HYBRIDVE_DATA, sized to a metre. Half of the points are anywhere
in the box about a part, half are beside its surface, from a nanometre to a decimetre away. The
truth is libigl's sum of solid angles over all triangles (`winding_number`); where that is no
integer to a thousandth, which happens within some 1e-12 of the surface, rational numbers decide.

* ``hybridve``: `SurfaceDistance.winding`, crossings of a ray counted with exact determinants;
* ``fast``: libigl's fast winding number (`fast_winding_number`), rounded;
* ``rays``: the majority of three rays in single precision (Open3D), as is common; what is within a
  millionth of the size of the surface counts as outside.

Wrong signs are counted apart for points farther from the surface than that millionth, and nearer.

Run: python tests/benchmarks/bench_signs.py [--points 1000000] [--seed 0]
"""

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import igl
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parent.parent))

from helpers.exact_geometry import ExactSolid

from hybridve.hull.cad.distance import SurfaceDistance
from hybridve.hull.cad.mesh import read_cad
from hybridve.hull.cad.topology import meeting_faces

_KINDS = (".stl", ".ply", ".obj", ".step", ".stp")

#: Farther from an integer a sum of solid angles is not trusted.
_TRUSTED = 1e-3

Ways = dict[str, Callable[[NDArray[np.float64]], NDArray[np.bool_]]]


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    """Print a line a part, and the sums; return these."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smallest", action="store_true", help="one file, few points")
    asked = parser.parse_args(arguments)
    folder = Path(os.environ["HYBRIDVE_DATA"]) / "meshes"
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _KINDS)
    if asked.smallest:
        paths, asked.points = paths[:1], 100
    parts = []
    for path in paths:
        cad = read_cad(path)
        parts += [
            (f"{path.name} {part.name}".strip(), part)
            for part, topology in zip(cad.parts, cad.topologies, strict=True)
            if topology.closed
        ]
    n_each = -(-asked.points // len(parts))
    rng = np.random.default_rng(asked.seed)
    names = ("hybridve", "fast", "rays")
    spent_s, n_points, n_near, n_rational = dict.fromkeys(names, 0.0), 0, 0, 0
    wrong = {name: np.zeros((2, 0), np.int64) for name in names}  # far and near, (2, parts)
    for label, part in parts:
        meets = meeting_faces(part.vertices, part.faces)
        assert meets is not None
        vertices = part.vertices - part.vertices.mean(axis=0)
        vertices /= np.ptp(vertices, axis=0).max()
        surface = SurfaceDistance(vertices, part.faces, is_closed=True, solid_faces=meets)
        points = _points(rng, vertices, part.faces, n_each)
        distance_m = surface.closest(points)[0]
        is_told = distance_m > max(1e-15, surface.apart_m)
        points, is_near = points[is_told], distance_m[is_told] < 1e-6
        truth, n_exact = _truth(vertices, meets, points, rng)
        n_points, n_near = n_points + len(points), n_near + int(is_near.sum())
        n_rational += n_exact
        told = []
        for name, way in _ways(surface, vertices, part.faces).items():
            way(points[:10])
            begin_s = time.perf_counter()
            found = way(points)
            spent_s[name] += time.perf_counter() - begin_s
            is_wrong = found != truth
            n_wrong = [int((is_wrong & ~is_near).sum()), int((is_wrong & is_near).sum())]
            wrong[name] = np.column_stack([wrong[name], n_wrong])
            told.append(f"{name} {n_wrong[0]} far {n_wrong[1]} near")
        print(  # noqa: T201
            f"{label}: {len(part.faces)} triangles, {len(points)} points, "
            f"{100 * truth.mean():.0f} % inside; wrong: {', '.join(told)}",
            flush=True,
        )
    print(  # noqa: T201
        f"{len(parts)} parts, {n_points} points, {n_near} of them near, "
        f"{n_rational} judged by rational numbers"
    )
    for name in names:
        print(  # noqa: T201
            f"{name}: far {wrong[name][0].sum()} wrong, on {(wrong[name][0] > 0).sum()} parts; "
            f"near {wrong[name][1].sum()}, on {(wrong[name][1] > 0).sum()}; "
            f"{1e6 * spent_s[name] / n_points:.2f} us a point"
        )
    measured: dict[str, float] = {
        "parts": len(parts),
        "points": n_points,
        "near": n_near,
        "judged_exactly": n_rational,
    }
    for name in names:
        measured[f"{name}.wrong"] = int(wrong[name].sum())
        measured[f"{name}.wrong_far"] = int(wrong[name][0].sum())
        measured[f"{name}.point_us"] = 1e6 * spent_s[name] / n_points
    return measured


def _points(
    rng: np.random.Generator, vertices: NDArray[np.float64], faces: NDArray[np.int32], n: int
) -> NDArray[np.float64]:
    low, high = vertices[faces].min(axis=(0, 1)), vertices[faces].max(axis=(0, 1))
    anywhere = rng.uniform(low - 0.02, high + 0.02, (n // 2, 3))
    corners = vertices[faces[rng.integers(len(faces), size=n - n // 2)]]
    on_it = (rng.dirichlet(np.ones(3), len(corners))[:, None] @ corners)[:, 0]
    off_m = 10.0 ** rng.uniform(-9, -1, (len(corners), 1))
    return np.concatenate([anywhere, on_it + off_m * rng.normal(size=on_it.shape)])


def _truth(
    vertices: NDArray[np.float64],
    meets: NDArray[np.int32],
    points: NDArray[np.float64],
    rng: np.random.Generator,
) -> tuple[NDArray[np.bool_], int]:
    turns = igl.winding_number(vertices, meets.astype(np.int64), points)
    doubtful = np.flatnonzero(np.abs(turns - np.round(turns)) > _TRUSTED)
    if len(doubtful):
        exact = ExactSolid(vertices[meets], rng)
        turns[doubtful] = [exact.winding(point) for point in points[doubtful]]
    return np.round(turns) != 0, len(doubtful)


def _ways(
    surface: SurfaceDistance, vertices: NDArray[np.float64], faces: NDArray[np.int32]
) -> Ways:
    import open3d

    tree = igl.FastWindingNumberBVH()
    tree.init(vertices, faces.astype(np.int64), 2)
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        open3d.core.Tensor.from_numpy(vertices.astype(np.float32)),
        open3d.core.Tensor.from_numpy(faces.astype(np.uint32)),
    )

    def by_rays(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        tensor = open3d.core.Tensor.from_numpy(points.astype(np.float32))
        occupied = scene.compute_occupancy(tensor, nthreads=1, nsamples=3).numpy() > 0.5
        is_near = surface.closest(points)[0] <= 1e-6 * float(np.abs(vertices).max())
        return np.asarray(occupied & ~is_near)

    return {
        "hybridve": lambda points: surface.winding(points) != 0,
        "fast": lambda points: np.abs(tree.winding_number(points, 2.0)) > 0.5,
        "rays": by_rays,
    }


if __name__ == "__main__":
    main()
