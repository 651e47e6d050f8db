"""Two hands on one part are two things; what is near one of them is not the other's."""

import numpy as np
import pytest
from helpers.contacts import FREE
from helpers.plates import balls, found_in, looking_down, plate
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.contact.patches import contact_patches
from hybridve.hull.contact.recovery import recover
from hybridve.hull.contact.respond import collision_point
from hybridve.hull.query.reference import contains_points

CENTERS = np.array([[-0.3, 0.0, 0.0], [0.3, 0.05, 0.0]])
RADII_M = (0.06, 0.05)


@pytest.mark.slow
def test_two_balls_that_touch_one_plate_are_two_patches() -> None:
    hull, part = balls(looking_down(), RADII_M, CENTERS), plate(0.03)
    meter, contact = found_in(hull, part)
    reference = part.reference_point_world

    patches = contact_patches(hull, meter, contact, required_m=0.0, reference_point_world=reference)

    assert len(patches) == 2
    points_world, triangle = contact.points()
    assert sum(patch.n_points for patch in patches) == len(points_world)
    for patch in patches:
        assert patch.clearance_m == (0.0, 0.0)
        inside = ((points_world >= patch.lower_world) & (points_world <= patch.upper_world)).all(1)
        assert inside.sum() == patch.n_points
        assert len(set(triangle[inside].tolist())) == patch.n_triangles
        center = 0.5 * (patch.lower_world + patch.upper_world)
        assert np.linalg.norm(CENTERS - center, axis=1).min() < 0.06
        away_m = np.linalg.norm(points_world[inside] - reference, axis=1)
        assert np.linalg.norm(patch.cp_obj_world - reference) == away_m.max()
    cp_obj = collision_point(contact, reference)
    assert any((patch.cp_obj_world == cp_obj).all() for patch in patches)


@pytest.mark.slow
@pytest.mark.parametrize(("required_m", "count"), [(0.1, 2), (0.05, 1), (0.02, 0)])
def test_what_is_nearer_than_required_is_a_patch_with_bounds_of_its_own(
    required_m: float, count: int
) -> None:
    centers = CENTERS - [[0.0, 0.0, 0.0], [0.0, 0.0, 0.03]]
    hull, part = balls(looking_down(), RADII_M, centers), plate(0.1)
    meter, contact = found_in(hull, part)

    patches = contact_patches(
        hull,
        meter,
        contact,
        required_m=required_m,
        reference_point_world=part.reference_point_world,
    )

    # The balls end 40 and 80 mm below the plate; their hulls are higher by the bulge.
    whole = meter.measure(hull)
    assert len(patches) == count
    for patch, center, radius, nearest in zip(
        patches, centers[:count], RADII_M, (0.04, 0.08), strict=False
    ):
        lower_m, upper_m = patch.clearance_m
        assert nearest - 0.02 < lower_m <= upper_m <= nearest
        assert upper_m - lower_m <= 1.001 * meter.tolerance_m
        assert np.linalg.norm((patch.on_hull_world - center)[:2]) < radius
        assert contains_points(hull, patch.on_hull_world[None])[0]
        away_m = np.linalg.norm(patch.cp_obj_world - patch.on_hull_world)
        assert away_m == pytest.approx(upper_m, abs=1e-9)
        assert patch.n_points == patch.n_triangles == 0
    if count:
        assert patches[0].clearance_m[1] <= whole.lower_m + 2 * meter.tolerance_m
        assert min(patch.clearance_m[0] for patch in patches) <= whole.upper_m


@pytest.mark.slow
@settings(max_examples=asked(12))
@given(seed=st.integers(0, 2**32 - 1))
def test_patches_share_out_the_points_and_the_nearest_of_them_is_the_clearance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centers = rng.uniform([-0.5, -0.2, -0.1], [0.5, 0.2, 0.1], (2, 3))
    hull, part = balls(looking_down(3), RADII_M, centers), plate(0.1)
    meter, contact = found_in(hull, part)
    required_m = float(rng.choice([0.0, 0.03, 0.2]))
    whole = meter.measure(hull)

    patches = contact_patches(
        hull,
        meter,
        contact,
        required_m=required_m,
        reference_point_world=part.reference_point_world,
    )

    assert sum(patch.n_points for patch in patches) == contact.n_points
    if whole.upper_m < required_m or contact.collides:
        assert patches
        nearest_m = min(patch.clearance_m[0] for patch in patches)
        assert whole.lower_m - 1e-9 <= min(patch.clearance_m[1] for patch in patches)
        assert nearest_m <= whole.upper_m + 1e-9
    if whole.lower_m >= required_m and whole.lower_m > 0:
        assert patches == ()


def test_nothing_near_is_no_patch() -> None:
    hull, part = balls(looking_down(), RADII_M, CENTERS - [0, 0, 0.5]), plate(0.1)
    meter = ClearanceMeter(part.vertices_world, part.faces, is_closed=True)

    assert (
        contact_patches(hull, meter, FREE, required_m=0.1, reference_point_world=np.zeros(3)) == ()
    )


UP = np.array([0.0, 0.0, 1.0])


def test_a_plate_is_free_once_it_is_moved_above_the_hull() -> None:
    """The way up that frees it is the height of the hull above its underside, which is measured."""
    hull, part = balls(looking_down(), RADII_M, CENTERS), plate(0.03)
    meter = ClearanceMeter(part.vertices_world, part.faces, is_closed=True)
    above = meter.measure(hull, 0.5 * UP)
    needed_m = 0.5 - 0.5 * (above.lower_m + above.upper_m)  # to half a tolerance
    assert 0.03 < needed_m < 0.06

    short = recover(hull, meter, UP, 0.01, 2.0)
    enough = recover(hull, meter, UP, needed_m + 1e-3, 2.0)

    assert short.frees == "no"
    assert short.blocked_m - 1e-4 <= needed_m <= short.free_m + 1e-4
    assert short.free_m - short.blocked_m <= short.free_m / 32 + 1e-12
    assert enough.frees == "yes"
    assert (enough.blocked_m, enough.free_m) == (needed_m + 1e-3, needed_m + 1e-3 + 1e-4)
    assert recover(hull, meter, UP, 0.01, 0.02).free_m == np.inf
    assert recover(hull, meter, UP, np.nan, 2.0).frees == ""


@pytest.mark.slow
def test_a_point_that_is_out_does_not_mean_that_the_object_is() -> None:
    """D_rec frees CP_obj; the other ball still holds the plate."""
    raised = CENTERS + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.02]])
    hull, part = balls(looking_down(), RADII_M, raised), plate(0.03)
    meter = ClearanceMeter(part.vertices_world, part.faces, is_closed=True)
    first = balls(looking_down(), RADII_M, np.array([CENTERS[0], [0.0, 0.0, -0.9]]))
    alone = recover(first, meter, UP, 0.01, 2.0)

    both = recover(hull, meter, UP, alone.free_m, 2.0)

    assert both.frees in ("yes", "no")
    assert both.free_m >= alone.blocked_m
