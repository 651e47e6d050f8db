"""Whatever is thrown at whatever hull: finite, and no energy but what the hull puts in."""

from typing import Any

import numpy as np
import pytest
from helpers.effect_bodies import ball, box, level_views, scene_object, stage
from helpers.hulls import ring_views
from helpers.response import box_vertices, polyhedron_masks, random_rotation
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridve.hull.query.silhouettes import Hull, Views, make_hull

#: Steps of each example, and for how many the hull stands.
N_STEPS, HELD = 1000, 20


def block(views: Views, rng: np.random.Generator, center_world: Any) -> Hull:
    """The hull of a block, any way up."""
    half_m = rng.uniform(0.04, 0.15, 3)
    corners = box_vertices(half_m, random_rotation(rng), np.asarray(center_world))
    return make_hull(views, polyhedron_masks(views, corners))


@pytest.mark.slow
@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), moves=st.booleans(), level=st.booleans())
def test_random_bodies_thrown_at_random_hulls(seed: int, moves: bool, level: bool) -> None:
    rng = np.random.default_rng(seed)
    views = level_views() if level else ring_views()
    objects, effects = [], []
    for number in range(3):
        at = rng.uniform(-0.3, 0.3, 3) + np.array([0.3 * (number - 1), 0, 0.2])
        name = f"thing{number}"
        if number == 0:
            objects.append(ball(name, at.tolist(), rng.uniform(0.02, 0.08), 320))
        else:
            one = box(name, rng.uniform(0.02, 0.08, 3).tolist(), [0, 0, 0])
            turned = one.vertices_world @ random_rotation(rng).T + at
            objects.append(scene_object(name, turned, one.faces))
        effects.append(
            {
                "kind": "rigid",
                "object": name,
                "mass_kg": float(10 ** rng.uniform(-3, 2)),
                "restitution": float(rng.choice([0.0, 0.5, 1.0])),
                "friction": float(rng.choice([0.0, 0.5])),
                "velocity_m_s": (-3 * (at - [0, 0, 0.1])).tolist(),
                "angular_velocity_deg_s": (300 * rng.normal(size=3)).tolist(),
            }
        )
    played = stage(views, objects, effects, viewport=6)
    center, drift = rng.uniform(-0.1, 0.1, 3), 0.01 * rng.normal(size=3) * moves
    hull = block(views, np.random.default_rng(seed), center)
    for _ in range(N_STEPS // HELD):
        if moves:
            center = center + drift
            hull = block(views, np.random.default_rng(seed), center)
        played.step(hull, HELD)
    made_j = played.energy_j() - played.hull_work_j()
    moving_j = np.sum([played.column(name, "kinetic_j") for name in played.told[0]], axis=0)
    scale_j = max(float(np.max(moving_j)), float(np.abs(played.hull_work_j()).max()))
    assert np.isfinite(made_j).all()
    # The first row is after some steps: at the start there was at least as much, so it is no bound
    # of the start but of all that follows.
    assert np.diff(made_j).max() <= 0.005 * scale_j
    assert (made_j - made_j[0]).max() <= 0.005 * scale_j
