"""The compiled walk tells what its specification does, whatever the rig and the silhouettes."""

import numpy as np
import pytest
from helpers.hulls import EMPTYING_MASK_KINDS, MASK_KINDS, UNSEEN, random_masks, random_views
from helpers.response import camera_center, random_unit
from helpers.thorough import asked
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.hull.query import walk_reference
from hybridve.hull.query.silhouettes import Hull, make_hull, make_views
from hybridve.hull.query.walk import boundary_cameras, spans_in_hull, spans_of_rays

Rays = tuple[Hull, NDArray[np.float64], NDArray[np.float64]]


@st.composite
def rays(draw: st.DrawFn) -> Rays:
    """Rigs of 1 to 6 cameras of unequal image size, and rays: origins (R, 3), unit directions."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n_cameras = draw(st.integers(1, 6))
    unseen = draw(st.sampled_from(UNSEEN))
    views = random_views(rng, n_cameras, unseen, draw(st.integers(1, n_cameras)), 160)
    kinds = rng.choice(MASK_KINDS * 3 + EMPTYING_MASK_KINDS, n_cameras).tolist()
    hull = make_hull(views, random_masks(rng, views, kinds))
    starts = views.origin_world + rng.choice([0.02, 0.3, 3.0], (9, 1)) * rng.normal(size=(9, 3))
    units = np.stack([random_unit(rng) for _ in range(9)])
    camera = int(rng.integers(n_cameras))
    center, matrix = camera_center(views, camera), views.img_from_local[camera]
    starts[0] = center  # out of a camera, as the ray of a pixel
    starts[1] = center - 0.7 * units[1]  # from behind it, through its centre
    starts[2] = center - 0.7 * units[2] + 0.01  # and beside it
    units[3] = matrix[2, :3]  # along its axis
    units[4] = -matrix[2, :3]
    for number, row in ((5, 1), (6, 0)):  # parallel to its rows, and to its columns
        units[number] = np.cross(matrix[row, :3], matrix[2, :3])
    units[7] = [0.0, 0.0, 1.0]
    units /= np.linalg.norm(units, axis=1)[:, None]
    return hull, starts, units


@pytest.mark.slow
@settings(max_examples=asked(300))
@given(rays=rays(), reach_m=st.sampled_from([0.05, 4.0, 1e3, 1e7]))
def test_the_compiled_walk_is_the_specification(rays: Rays, reach_m: float) -> None:
    hull, starts, units = rays
    for number, (start, unit) in enumerate(zip(starts, units, strict=True)):
        found_m = spans_in_hull(hull, start, unit, reach_m)
        expected_m = walk_reference.spans_in_hull(hull, start, unit, reach_m)

        # Ends are off by the rounding of a pixel, over how fast the projection moves.
        assert found_m.shape == expected_m.shape, number
        np.testing.assert_allclose(found_m, expected_m, rtol=1e-9, atol=1e-9)


@settings(max_examples=asked(50))
@given(rays=rays(), seed=st.integers(0, 99))
def test_a_ray_is_walked_alike_among_others(rays: Rays, seed: int) -> None:
    hull, starts, units = rays
    order = np.random.default_rng(seed).permutation(len(starts))[: seed % len(starts)]

    together = spans_of_rays(hull, starts[order], 3.0 * units[order], 8.0)

    assert len(together) == len(order)
    for spans_m, number in zip(together, order, strict=True):
        alone_m = spans_in_hull(hull, starts[number], 3.0 * units[number], 8.0)
        np.testing.assert_array_equal(spans_m, alone_m)


#: A unit in metres, and how far away the scene stands.
PLACES = ((1e-6, 0.0), (1e3, 0.0), (1e6, 0.0), (1e9, 0.0), (1.0, 1e4), (1.0, 5e6))


@settings(max_examples=asked(60))
@given(seed=st.integers(0, 2**32 - 1), place=st.sampled_from(PLACES))
@example(seed=29301, place=(1.0, 1e4))  # a corner that the projection passes slowly
@example(seed=29301, place=(1e-6, 0.0))
def test_stretches_are_the_same_in_every_unit_and_place(
    seed: int, place: tuple[float, float]
) -> None:
    """Through corners of pixels, where rounding would tell stretches and gaps that are none."""
    rng = np.random.default_rng(seed)
    here = random_views(rng, int(rng.integers(1, 5)))
    masks = random_masks(rng, here, rng.choice(MASK_KINDS, len(here)).tolist())
    unit_m, away_m = place
    shift = away_m * np.array([0.6, -0.7, 0.2])
    matrices = here.img_from_local.copy()
    matrices[:, :, 3] -= matrices[:, :, :3] @ here.origin_world
    there_matrices = matrices.copy()
    there_matrices[:, :, 3] = unit_m * matrices[:, :, 3] - matrices[:, :, :3] @ shift
    there = make_views(here.names, here.sizes_px, there_matrices)
    hull_here, hull_there = make_hull(here, masks), make_hull(there, masks)
    for _ in range(50):
        camera = int(rng.integers(len(here)))
        corner = np.append(rng.integers(0, here.sizes_px[camera] + 1), 1.0)
        ray = np.linalg.solve(matrices[camera, :, :3], corner)
        target = camera_center(here, camera) + ray / np.linalg.norm(ray) * rng.uniform(1.0, 6.0)
        start = 0.2 * rng.normal(size=3)
        direction = target - start

        spans = spans_in_hull(hull_here, start, direction, 8.0)
        start_there = unit_m * start + shift
        spans_m = spans_in_hull(hull_there, start_there, direction, 8.0 * unit_m)

        # At 5,000 km a coordinate is 1e-9 m, seen at a glancing angle.
        np.testing.assert_allclose(spans_m / unit_m, spans, atol=1e-9 + 1e-12 * away_m, rtol=0)
        unit = direction / np.linalg.norm(direction)
        for end_m in spans_m[:, 1][spans_m[:, 1] < 7.99 * unit_m]:
            assert boundary_cameras(hull_there, start_there + end_m * unit, direction)
