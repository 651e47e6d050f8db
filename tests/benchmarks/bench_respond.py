"""The response of one object: the exact form, and the paper's at windows of 100, 400 and 1600.

4 cameras of 720 x 486, a ball 0.2 m in radius, 200 collision points 1 to 40 mm deep in its hull,
taken in turn. ``bench_exact`` is the walk along V_rec, the cameras that end it and the normal;
``bench_respond`` is both forms. Its `extra_info` holds, where both have an answer, the difference
of their D_rec in micrometres, median and largest, beside the step of the window, which bounds it;
of their N_hull in degrees, median and 95 %; and of each N_hull from that of the ball's cones in
closed form. At 3 m a pixel is 4.3 mm wide, more than I, J, K and L are apart: their cross product
follows the staircase of pixels, whatever the window.

Run: pytest tests/benchmarks/bench_respond.py --full
"""

from itertools import cycle
from typing import Any

import numpy as np
import pytest
from helpers.contacts import contact_at
from helpers.hulls import ball_hull, ring_views
from helpers.response import angle_deg, ball_exits, random_unit
from numpy.typing import NDArray

from hybridve.hull.contact.respond import Response, ResponseSettings, respond
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.walk import boundary_cameras, silhouette_normal, spans_in_hull

RADIUS_M = 0.2

Points = list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]


@pytest.fixture(scope="module")
def hull() -> Hull:
    return ball_hull(ring_views(), np.zeros(3), RADIUS_M)


@pytest.fixture(scope="module")
def points(hull: Hull) -> Points:
    """CP_obj, V_rec and N_hull in closed form, (3,) each."""
    rng, views = np.random.default_rng(0), ring_views()
    found: Points = []
    while len(found) < 200:
        unit = random_unit(rng)
        end = ball_exits(views, np.zeros(3), RADIUS_M, np.zeros(3), unit)[0]
        start = (end.distance_m - rng.uniform(0.001, 0.04)) * unit
        # Of pixels, the hull may end a few millimetres before that of the ball's own cones.
        if contains_points(hull, start[None])[0]:
            found.append((start, unit, end.normal))
    return found


def spread(values: list[float]) -> list[float]:
    """Return the median and the 95 % quantile."""
    return [round(float(value), 1) for value in np.percentile(values, [50, 95])]


def bench_exact(benchmark: Any, hull: Hull, points: Points) -> None:
    turn = cycle(points)

    def run() -> NDArray[np.float64]:
        start, unit, _ = next(turn)
        end = start + spans_in_hull(hull, start, unit, 0.1)[-1, 1] * unit
        return silhouette_normal(hull, boundary_cameras(hull, end, unit)[0], end)

    benchmark(run)


@pytest.mark.parametrize("window", [100, 400, 1600])
@pytest.mark.smallest(window=100)
def bench_respond(benchmark: Any, hull: Hull, points: Points, window: int) -> None:
    settings = ResponseSettings(window=window)

    def answer(start: NDArray[np.float64], unit: NDArray[np.float64]) -> Response:
        contact = contact_at(start)
        return respond(hull, contact, reference_point_world=start + unit, settings=settings)

    answers = [(answer(start, unit), normal) for start, unit, normal in points]
    both = [(a, normal) for a, normal in answers if a.status == a.status_paper == ""]
    apart_um = [1e6 * abs(a.difference_m) for a, _ in both]
    benchmark.extra_info.update(
        answered=f"{len(both)} of {len(answers)}",
        d_rec_apart_um=[round(float(value), 1) for value in (np.median(apart_um), max(apart_um))],
        step_um=round(1e6 * settings.height_m / window, 1),
        n_hull_apart_deg=spread([angle_deg(a.n_hull, a.n_hull_paper) for a, _ in both]),
        n_hull_off_deg=spread([angle_deg(a.n_hull, normal) for a, normal in both]),
        n_hull_paper_off_deg=spread([angle_deg(a.n_hull_paper, normal) for a, normal in both]),
    )
    turn = cycle(points)
    benchmark(lambda: answer(*next(turn)[:2]))
