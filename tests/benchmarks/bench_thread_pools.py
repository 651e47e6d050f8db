"""Whether the thread pools of numba, OpenCV and Open3D slow each other down.

Four kinds of work of a few milliseconds each, as a frame of ``detect`` would have them one after
the other; each is timed with nothing beside it, then in turn with others, which are not timed:

* ``native``: the volume query, 200,000 triangles, in plain Python threads that sleep between;
* ``opencv``: four camera images blurred, in OpenCV's own threads, and ``opencv_1``: in none, as
  ``detect`` has it, which runs the cameras side by side instead;
* ``open3d``: distances of points to a mesh, in Open3D's pool;
* ``prange``: the counter-example, a loop of numba's own pool (``parallel=True``) of about the cost
  of the query. The query does not use that pool, and this is why or why not.

`times_alone` says by what factor the work is slower than with nothing beside it. `cpu_ms` is the
processor time of one turn, all threads and all works of it: what it exceeds the works' own by was
spent on waiting, by threads that spin.

Turns with ``prange`` come last, for a pool once started is there until the process ends. Other
programs on the same processors disturb the pools more than the pools each other: look at the
spread, and repeat on a quiet machine.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import cv2
import numba
import numpy as np
import pytest
from helpers.hulls import ball_hull, ring_views, sphere_mesh
from numpy.typing import NDArray

from hybridve.hull.query.choose import open_engine
from hybridve.hull.query.silhouettes import make_hull
from hybridve.hull.query.threads import usable_cpus

Work = Callable[[], object]

#: What was measured with nothing beside it: milliseconds, by work.
_ALONE_MS: dict[str, float] = {}

_ROUNDS = 100

_BESIDE = {
    "native": ["nothing", "opencv", "opencv_1", "open3d", "opencv_1+open3d"],
    "opencv": ["nothing", "native", "open3d"],
    "opencv_1": ["nothing", "native", "open3d"],
    "open3d": ["nothing", "native", "opencv", "opencv_1"],
    "prange": ["nothing", "opencv", "opencv_1", "open3d", "opencv_1+open3d"],
}
_TURNS = [(work, beside) for work, others in _BESIDE.items() for beside in others]
# The others beside the counter-example; not the query, which is here to be compared with it.
_TURNS += [(work, "prange") for work in ("opencv", "opencv_1", "open3d", "native")]


@numba.njit(parallel=True)  # type: ignore[untyped-decorator]
def _prange_sums(points: NDArray[np.float64], sums: NDArray[np.float64]) -> None:
    for row in numba.prange(len(points)):
        total = 0.0
        for step in range(64):
            total += np.sqrt(points[row, 0] * step + points[row, 1]) * points[row, 2]
        sums[row] = total


def _native(closing: ExitStack) -> Work:
    engine = closing.enter_context(open_engine("native"))
    views = ring_views(4, 720, 486)
    hull = ball_hull(views, np.array([0.5, 0.0, 0.0]), 0.13)
    hulls = [hull, make_hull(views, [hull.mask(camera) for camera in range(4)])]
    mesh, frames = sphere_mesh(200_000, 0.5), iter(range(1 << 30))
    return lambda: engine.query(hulls[next(frames) % 2], [mesh])


def _opencv(n_threads: int) -> Work:
    cv2.setNumThreads(n_threads)
    images = np.random.default_rng(0).integers(0, 256, (4, 486, 644, 3), dtype=np.uint8)
    return lambda: [cv2.GaussianBlur(image, (15, 15), 0) for image in images]


def _open3d() -> Work:
    from open3d import core, t

    tensor: Any = core.Tensor  # whose types leave arrays out
    mesh = sphere_mesh(20_000, 0.5)
    scene = t.geometry.RaycastingScene()
    scene.add_triangles(
        tensor(mesh.vertices_world.astype(np.float32)),
        tensor(mesh.faces.astype(np.uint32)),
    )
    directions = np.random.default_rng(0).normal(size=(4_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = tensor((0.51 * directions).astype(np.float32))
    return lambda: scene.compute_distance(points)


def _prange() -> Work:
    # Not TBB: numba finds the one that Open3D has loaded, and complains that it is too old.
    numba.config.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]
    points = np.random.default_rng(0).random((50_000, 3))
    sums = np.zeros(len(points))
    return lambda: _prange_sums(points, sums)


@pytest.fixture
def make_work() -> Iterator[Callable[[str], Work]]:
    before = cv2.getNumThreads()
    with ExitStack() as closing:
        makers: dict[str, Callable[[], Work]] = {
            "nothing": lambda: lambda: None,
            "native": lambda: _native(closing),
            "opencv": lambda: _opencv(usable_cpus()),
            "opencv_1": lambda: _opencv(1),
            "open3d": _open3d,
            "prange": _prange,
        }
        yield lambda name: makers[name]()
    cv2.setNumThreads(before)


@pytest.mark.filterwarnings("ignore:The TBB threading layer")
@pytest.mark.parametrize(("timed", "beside"), _TURNS)
def bench_in_turn(
    benchmark: Any, make_work: Callable[[str], Work], timed: str, beside: str
) -> None:
    work = make_work(timed)
    others = [make_work(name) for name in beside.split("+")]
    cpu_s: list[float] = []

    def turn_to_the_others() -> None:
        cpu_s.append(time.process_time())
        for other in others:
            other()

    benchmark.pedantic(work, setup=turn_to_the_others, rounds=_ROUNDS, warmup_rounds=5)

    benchmark.extra_info.update(timed=timed, beside=beside)
    if "prange" in (timed, beside):
        benchmark.extra_info["layer"] = numba.threading_layer()
    if benchmark.stats is None:  # it only ran
        return
    median_ms = 1000 * benchmark.stats["median"]
    if beside == "nothing":
        _ALONE_MS[timed] = median_ms
    benchmark.extra_info.update(
        times_alone=round(median_ms / _ALONE_MS[timed], 2) if timed in _ALONE_MS else None,
        # The mean: time of a thread that runs is only booked every few milliseconds.
        cpu_ms=round(1000 * (cpu_s[-1] - cpu_s[-_ROUNDS]) / (_ROUNDS - 1), 2),
    )
