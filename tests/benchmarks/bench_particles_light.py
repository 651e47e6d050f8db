"""What particles, light and proximity take: a step, a frame, a frame.

4 cameras of 720 x 486 about a ball 0.3 m in radius. Particles are drops in a box 0.6 m wide: far
from it ("free"), or raining down on it for 0.2 s, of which each step of 5 ms is timed ("rain"; the
share that the ball touches in a step is told). Light is that of a lamp 1.3 m above a floor of 1.2
m, a third of it dark. Proximity is that of a cube of as many triangles beside the ball, with zones
and an exposure.

Run: pytest tests/benchmarks/bench_particles_light.py --full
"""

from itertools import cycle
from typing import Any

import numpy as np
import pytest
from helpers.effects import empty_hull, entry_of, floor, held, scene_object, setting_of
from helpers.hulls import ball_hull, ring_views, sphere_mesh

from hybridve.hull.effects.light import Light
from hybridve.hull.effects.particles import Particles
from hybridve.hull.effects.proximity import Proximity

VIEWS = ring_views()
BALL = ball_hull(VIEWS, np.array([0.0, 0.0, 0.1]), 0.3)

STEP_S = 0.005

#: Steps in which drops have reached the ball, and lie on it or have run off.
N_STEPS = 40


@pytest.mark.parametrize("case", ["free", "rain"])
@pytest.mark.parametrize("count", [100, 1_000, 10_000, 100_000])
@pytest.mark.smallest(count=100)
def bench_particles(benchmark: Any, count: int, case: str, is_full: bool) -> None:
    hull = BALL if case == "rain" else empty_hull(VIEWS)
    entry = entry_of(
        "particles",
        count=count,
        source_mm=[-300, -300, 450, 300, 300, 750],
        velocity_m_s=[0.0, 0.0, -1.0],
        lifetime_s=100.0,
    )
    swarm = Particles([entry], setting_of(VIEWS))
    swarm.advance(held(hull), STEP_S)
    start, turn, touched = swarm.state(), cycle(range(N_STEPS)), []

    def step() -> None:
        if next(turn) == 0:
            swarm.restore(start)
        swarm.advance(held(hull, hull, STEP_S), STEP_S)

    benchmark.pedantic(step, rounds=2 * N_STEPS if is_full else 1)
    for _ in range(N_STEPS):
        step()
        touched.append(int(swarm.values(None)["it"]["n_contacts"]) / count)
    benchmark.extra_info.update(
        particles=count, contacts_a_particle=round(float(np.median(touched)), 3)
    )


@pytest.mark.parametrize("n_triangles", [720, 20_000])
@pytest.mark.smallest(n_triangles=720)
def bench_light(benchmark: Any, n_triangles: int) -> None:
    ground = floor("floor", 0.6, -0.2, n_quads=round((n_triangles / 2) ** 0.5))
    entry = entry_of("light", lamp_mm=[300, -200, 1100], intensity_cd=100.0)
    lamp = Light([entry], setting_of(VIEWS, ground))

    values = benchmark(lamp.values, BALL)

    benchmark.extra_info.update(
        triangles=len(ground.faces), shaded_m2=round(float(values["it"]["shaded_m2"][0]), 4)
    )


@pytest.mark.parametrize("n_triangles", [720, 20_000])
@pytest.mark.smallest(n_triangles=720)
def bench_proximity(benchmark: Any, n_triangles: int) -> None:
    mesh = sphere_mesh(n_triangles, 0.15, center_world=(0.55, 0.0, 0.1))
    entry = entry_of(
        "proximity",
        object="ball",
        zones_mm=[200, 120, 50],
        falloff={"kind": "exponential", "range_mm": 50},
    )
    ball = scene_object("ball", mesh.vertices_world, mesh.faces)
    watch = Proximity([entry], setting_of(VIEWS, ball))
    watch.advance(held(BALL), STEP_S)

    values = benchmark(watch.values, BALL)

    benchmark.extra_info.update(
        triangles=len(mesh.faces), clearance_m=values["it"]["clearance_m"].round(4).tolist()
    )
