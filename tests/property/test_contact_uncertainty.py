"""Bounds of where the real thing is hold for every ball, and doubts are the same every time."""

from functools import cache

import numpy as np
import pytest
from helpers.cones import BOX_FACES, box_vertices, views_from
from helpers.contacts import FREE
from helpers.hulls import (
    EMPTYING_MASK_KINDS,
    MASK_KINDS,
    ball_masks,
    random_masks,
    random_views,
)
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridve.hull.contact.bulge import Ray, farthest_on, real_upper
from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.contact.components import grown
from hybridve.hull.contact.outline_errors import DoubtSettings, outline_errors
from hybridve.hull.contact.uncertainty import Doubter
from hybridve.hull.query.silhouettes import Hull, Unseen, make_hull

BOX_HALF_M = 0.1

seeds = st.integers(0, 2**32 - 1)


@cache
def meter() -> ClearanceMeter:
    return ClearanceMeter(
        box_vertices(np.zeros(3), BOX_HALF_M), BOX_FACES, is_closed=True, tolerance_m=5e-4
    )


def hull_beside_box(seed: int, n_cameras: int, n_balls: int) -> tuple[Hull, float]:
    """Return the hull of balls beside or in the box, and how far the nearest ball truly is."""
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(n_cameras, 3))
    centers *= rng.uniform(2.0, 3.5, (n_cameras, 1)) / np.linalg.norm(centers, axis=1)[:, None]
    views = views_from(list(centers), 160, 128, 130.0)
    masks, nearest_m = [], np.inf
    for _ in range(n_balls):
        center, radius_m = rng.uniform(-0.35, 0.35, 3), float(rng.uniform(0.05, 0.15))
        masks.append(ball_masks(views, center, radius_m))
        nearest_m = min(nearest_m, float(meter().signed_distance(center[None])[0]) - radius_m)
    seen = [np.maximum.reduce(of_camera) for of_camera in zip(*masks, strict=True)]
    return make_hull(views, seen), max(nearest_m, 0.0)


@pytest.mark.slow
@settings(max_examples=asked(200))
@given(seed=seeds, n_cameras=st.integers(2, 5), n_balls=st.integers(1, 3))
def test_the_real_thing_is_not_farther_away_than_the_bound(
    seed: int, n_cameras: int, n_balls: int
) -> None:
    hull, nearest_m = hull_beside_box(seed, n_cameras, n_balls)
    clearance = meter().measure(hull)

    bound_m = real_upper(hull, grown(hull), meter(), clearance)

    assert bound_m >= nearest_m - 1e-9
    assert bound_m >= clearance.lower_m
    assert np.isfinite(bound_m)


@settings(max_examples=asked(50))
@given(seed=seeds)
def test_the_farthest_point_of_a_ray_is_bounded_closely(seed: int) -> None:
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    ends_m = np.sort(rng.uniform(0.0, 1.2, 2 * int(rng.integers(1, 4)))).reshape(-1, 2)
    ray = Ray(rng.uniform(-0.5, 0.5, 3), direction / np.linalg.norm(direction), ends_m)
    within_m = np.linspace(ends_m[:, 0], ends_m[:, 1], 2001, axis=1).ravel()

    bound_m = farthest_on(meter(), ray, np.inf)

    farthest_m = meter().signed_distance(ray.at(within_m)).max()
    assert farthest_m <= bound_m + 1e-12
    assert bound_m <= farthest_m + 2e-3
    assert farthest_on(meter(), ray, farthest_m - 0.01) in (bound_m, np.inf)


@settings(max_examples=asked(10))
@given(seed=seeds, n_cameras=st.integers(2, 5), n_balls=st.integers(1, 3))
def test_a_doubt_does_not_depend_on_what_was_doubted_before(
    seed: int, n_cameras: int, n_balls: int
) -> None:
    hull, _ = hull_beside_box(seed, n_cameras, n_balls)
    free = FREE
    doubter = Doubter(outline_errors(hull.views.names, None, [0.0] * len(hull.views)))
    fresh = ClearanceMeter(
        box_vertices(np.zeros(3), BOX_HALF_M), BOX_FACES, is_closed=True, tolerance_m=5e-4
    )
    clearance = fresh.measure(hull)

    first = doubter.frame(hull).doubt(fresh, free, clearance)
    used = doubter.frame(hull)
    used.doubt(meter(), free, meter().measure(hull))
    again = used.doubt(meter(), free, clearance)

    for name in first.__slots__:
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name), err_msg=name)


@settings(max_examples=asked(40))
@given(seed=seeds, n_cameras=st.integers(1, 5), unseen=st.sampled_from(["carve", "keep"]))
def test_whatever_the_silhouettes_a_doubt_agrees_with_itself(
    seed: int, n_cameras: int, unseen: Unseen
) -> None:
    rng = np.random.default_rng(seed)
    views = random_views(rng, n_cameras, unseen, int(rng.integers(1, n_cameras + 1)), 100)
    kinds = rng.choice(MASK_KINDS * 3 + EMPTYING_MASK_KINDS, n_cameras).tolist()
    hull = make_hull(views, random_masks(rng, views, kinds))
    clearance = meter().measure(hull)
    contact = FREE
    doubter = Doubter(
        outline_errors(views.names, None, [0.0] * n_cameras),
        DoubtSettings(cell_m=0.2, near_m=np.inf),
    )

    found = doubter.frame(hull).doubt(meter(), contact, clearance)

    assert (found.m_per_px >= 0).all() or np.isnan(found.m_per_px).all()
    assert not found.at_least_m > clearance.lower_m
    assert found.real_upper_m >= clearance.lower_m
    assert found.survives == (not found.hinges_on)
    assert set(found.hinges_on) <= set(views.names)
    if np.isinf(clearance.upper_m):
        assert (found.n_seeing, found.component) == (0, "")
    else:
        assert found.n_seeing >= (n_cameras if unseen == "carve" else views.min_cameras)
        reach_m = np.linalg.norm(clearance.on_hull_world)
        assert found.component != "" or reach_m > 3.0
