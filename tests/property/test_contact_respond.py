"""Rays and responses, whatever the rig and the silhouettes; the specification is the witness."""

import numpy as np
import pytest
from helpers.contacts import contact_at
from helpers.hulls import MASK_KINDS, UNSEEN, random_masks, random_views
from helpers.response import camera_center, random_unit
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.hull.contact.respond import Response, ResponseSettings, respond
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, make_hull
from hybridve.hull.query.walk import boundary_cameras, contains_few, spans_in_hull

#: What the ends of stretches are true to.
END_M = 1e-9

Ray = tuple[Hull, NDArray[np.float64], NDArray[np.float64], np.random.Generator]


@st.composite
def rays(draw: st.DrawFn) -> Ray:
    """Rigs of 1 to 6 cameras of unequal image size, and a ray: origin, unit direction."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n_cameras = draw(st.integers(1, 6))
    unseen = draw(st.sampled_from(UNSEEN))
    away = draw(st.sampled_from([0.0, 1.0, 1000.0]))
    views = random_views(
        rng, n_cameras, unseen, draw(st.integers(1, n_cameras)), 160, away * rng.normal(size=3)
    )
    kinds = rng.choice(MASK_KINDS, n_cameras).tolist()
    hull = make_hull(views, random_masks(rng, views, kinds))
    start = views.origin_world + draw(st.sampled_from([0.02, 0.3, 3.0])) * rng.normal(size=3)
    unit = random_unit(rng)
    kind = draw(st.sampled_from(["", "", "camera", "axis", "row"]))
    matrix = views.img_from_local[rng.integers(n_cameras)]
    if kind == "camera":  # from behind a camera, through its centre or beside it
        center = camera_center(views, int(rng.integers(n_cameras)))
        start = center - unit * rng.choice([0.0, 0.1, 1.0]) + rng.choice([0.0, 0.1]) * unit[::-1]
    elif kind == "axis":  # along a camera's axis: all its pixels at once
        unit = matrix[2, :3] * rng.choice([-1.0, 1.0])
    elif kind == "row":  # parallel to its rows, at one depth
        unit = np.cross(matrix[1, :3], matrix[2, :3])
        unit /= np.linalg.norm(unit)
    return hull, start, unit, rng


@settings(max_examples=asked(400))
@given(ray=rays(), reach_m=st.sampled_from([0.05, 0.5, 4.0, 20.0]))
def test_points_are_in_the_hull_where_the_ray_is(ray: Ray, reach_m: float) -> None:
    hull, start, unit, rng = ray

    spans_m = spans_in_hull(hull, start, unit, reach_m)

    ends_m = spans_m.ravel()
    assert (ends_m >= 0).all()
    assert (ends_m <= reach_m).all()
    assert (np.diff(ends_m) > 0).all()
    beside = np.concatenate([ends_m - END_M, ends_m + END_M])
    t = np.concatenate([rng.uniform(0, reach_m, 300), beside])
    t = t[(t >= 0) & (t <= reach_m)]
    near = (np.abs(t[:, None] - ends_m) < END_M / 2).any(axis=1)
    expected = contains_points(hull, start + t[:, None] * unit)
    in_span = np.searchsorted(ends_m, t) % 2 == 1
    np.testing.assert_array_equal(in_span[~near], expected[~near])


@settings(max_examples=asked(200))
@given(ray=rays())
def test_a_stretch_ends_at_a_camera_and_begins_at_one(ray: Ray) -> None:
    hull, start, unit, _ = ray
    reach_m = 8.0
    for first_m, last_m in spans_in_hull(hull, start, unit, reach_m):
        if last_m - first_m < 1e-6:
            continue
        if last_m < reach_m:
            assert boundary_cameras(hull, start + last_m * unit, unit)
        if first_m > 0:
            assert boundary_cameras(hull, start + first_m * unit, -unit)
        assert not boundary_cameras(hull, start + (first_m + last_m) / 2 * unit, unit)


@settings(max_examples=asked(200))
@given(ray=rays())
def test_few_points_are_asked_as_many_are(ray: Ray) -> None:
    hull, start, unit, rng = ray
    points = start + rng.uniform(-5, 5, (300, 1)) * unit + 0.1 * rng.normal(size=(300, 3))

    inside = contains_few(hull, points)

    np.testing.assert_array_equal(inside, contains_points(hull, points))


@st.composite
def collisions(draw: st.DrawFn) -> tuple[Hull, NDArray[np.float64], Response, ResponseSettings]:
    """The response of an object that touches a hull at one point, most often within it."""
    hull, start, unit, rng = draw(rays())
    tries = start + 0.3 * rng.normal(size=(50, 3))
    inside = contains_points(hull, tries)
    if inside.any() and draw(st.integers(0, 9)) > 0:
        start = tries[int(inside.argmax())]
    height_m = draw(st.sampled_from([0.01, 0.05, 0.5]))
    chosen = ResponseSettings(
        angle_rad=np.radians(draw(st.sampled_from([1.0, 10.0, 120.0]))),
        height_m=height_m,
        window=draw(st.sampled_from([1, 7, 100, 400])),
        reach_m=height_m * draw(st.sampled_from([1.0, 1.5, 40.0])),
    )
    answer = respond(
        hull,
        contact_at(start),
        reference_point_world=start + unit * draw(st.sampled_from([0.001, 0.1, 1.0])),
        recovery_direction=draw(st.sampled_from([None, 3.0 * unit])),
        settings=chosen,
        cp_obj_world=start,
    )
    return hull, start, answer, chosen


@pytest.mark.slow
@settings(max_examples=asked(400))
@given(collision=collisions())
def test_what_is_known_is_consistent_and_what_is_not_is_nan(
    collision: tuple[Hull, NDArray[np.float64], Response, ResponseSettings],
) -> None:
    hull, start, answer, chosen = collision
    np.testing.assert_array_equal(answer.cp_obj_world, start)
    assert answer.status != "no direction"
    assert abs(np.linalg.norm(answer.v_rec) - 1) < 1e-12
    for d_rec_m, cp_hull, normal, status in (
        (answer.d_rec_m, answer.cp_hull_world, answer.n_hull, answer.status),
        (
            answer.d_rec_paper_m,
            answer.cp_hull_paper_world,
            answer.n_hull_paper,
            answer.status_paper,
        ),
    ):
        assert np.isnan(cp_hull).all() == np.isnan(d_rec_m)
        if status == "":
            assert abs(np.linalg.norm(normal) - 1) < 1e-12
            assert normal @ answer.v_rec > 0
        elif status != "missed":
            assert np.isnan(normal).all()
        if not np.isnan(d_rec_m):
            np.testing.assert_allclose(cp_hull, start + d_rec_m * answer.v_rec, atol=1e-9)
            assert d_rec_m >= 0
    if answer.status in ("", "no normal"):
        ends = answer.cp_hull_world + np.array([[-END_M], [END_M]]) * answer.v_rec
        matrices = hull.views.img_from_local
        depths_m = (ends - hull.views.origin_world) @ matrices[:, 2, :3].T + matrices[:, 2, 3]
        # In a camera's own plane its pixels are as small as rounding.
        if answer.d_rec_m > 2 * END_M and (np.abs(depths_m) > 1e-6).all():
            assert contains_points(hull, ends).tolist() == [True, False]
    elif answer.status == "no exit":
        assert contains_points(hull, start + chosen.height_m * answer.v_rec * [[1 - 1e-9]]).all()


@pytest.mark.slow
@settings(max_examples=asked(400))
@given(collision=collisions())
def test_the_paper_s_distance_is_within_a_step_of_the_exact_one(
    collision: tuple[Hull, NDArray[np.float64], Response, ResponseSettings],
) -> None:
    _, _, answer, chosen = collision
    step_m = chosen.height_m / chosen.window

    if answer.status_paper in ("", "no normal") and answer.status in ("", "no normal"):
        assert -step_m * (1 + 1e-6) <= answer.difference_m <= 1e-9
    if answer.status_paper == "base inside":
        assert answer.status == "no exit" or answer.d_rec_m >= chosen.height_m - 1e-9
    if answer.status == "outside":  # or on the very rim
        assert answer.status_paper == "outside" or answer.d_rec_paper_m == 0


@settings(max_examples=asked(150))
@given(collision=collisions())
def test_the_exact_distance_is_what_dense_sampling_from_the_base_finds(
    collision: tuple[Hull, NDArray[np.float64], Response, ResponseSettings],
) -> None:
    """20,000 samples of the specification below the height, and what lies beyond if need be."""
    hull, start, answer, chosen = collision
    t, step_m = np.linspace(0, chosen.height_m, 20_001, retstep=True)
    inside = contains_points(hull, start + t[:, None] * answer.v_rec)
    if inside[-2:].any():  # the base, or within a step of it: the end lies there or beyond
        assert answer.status == "no exit" or answer.d_rec_m >= t[-2] - 1e-9
        return
    if not inside.any():
        assert answer.d_rec_m < step_m or answer.status_paper != ""  # thinner than a step
        return

    last_m = float(t[np.flatnonzero(inside)[-1]])

    spans_m = spans_in_hull(hull, start, answer.v_rec, chosen.height_m)
    is_missed = len(spans_m) > 0 and spans_m[-1, 0] > last_m  # by the samples
    assert is_missed or last_m - 1e-9 <= answer.d_rec_m <= last_m + step_m + 1e-9
