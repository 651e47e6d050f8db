"""The response against closed forms: hulls of balls, boxes and cylinders seen by a ring of cameras.

A silhouette's boundary lies between the outlines moved inwards and outwards by half the diagonal of
a pixel, so D_rec lies between two closed forms, without exception; and it is the closed form's own
to the pixel footprint wherever one camera alone ends the hull.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from helpers import contacts
from helpers.hulls import ball_hull, ring_views
from helpers.response import (
    HALF_PX,
    Exit,
    angle_deg,
    ball_exits,
    ball_silhouettes,
    box_vertices,
    cylinder_vertices,
    polyhedron_exits,
    polyhedron_masks,
    random_rotation,
    random_unit,
)
from numpy.typing import NDArray

from hybridve.hull.contact.detect import Contact
from hybridve.hull.contact.respond import (
    Response,
    ResponseSettings,
    collision_point,
    respond,
)
from hybridve.hull.query.silhouettes import Hull, Views, make_hull

Exits = Callable[[NDArray[np.float64], NDArray[np.float64], float], list[Exit]]


def contact_at(*points_world: tuple[float, ...] | NDArray[np.float64]) -> Contact:
    return contacts.contact_at(np.array(points_world))


def move(
    hull: Hull,
    start_world: NDArray[np.float64],
    direction: NDArray[np.float64],
    settings: ResponseSettings | None = None,
) -> Response:
    """The response of an object that touches at one point and gives in one direction."""
    return respond(
        hull,
        contact_at(start_world),
        reference_point_world=start_world,
        recovery_direction=direction,
        settings=settings,
        cp_obj_world=start_world,
    )


# -- Closed forms -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    hull: Hull
    exits: Exits  # of a line, the outlines wider by some pixels
    start_world: NDArray[np.float64]
    unit: NDArray[np.float64]


def ball_case(rng: np.random.Generator, views: Views) -> Case:
    center, radius_m = rng.uniform(-0.2, 0.2, 3), rng.uniform(0.1, 0.3)
    return Case(
        make_hull(views, ball_silhouettes(views, center, radius_m)),
        lambda start, unit, wider_px: ball_exits(views, center, radius_m, start, unit, wider_px),
        center + 0.9 * radius_m * rng.random() * random_unit(rng),
        random_unit(rng),
    )


def polyhedron_case(
    rng: np.random.Generator,
    views: Views,
    vertices_world: NDArray[np.float64],
    inner_m: float,
) -> Case:
    center = vertices_world.mean(axis=0)
    return Case(
        make_hull(views, polyhedron_masks(views, vertices_world)),
        lambda start, unit, wider_px: polyhedron_exits(
            views, vertices_world, start, unit, wider_px
        ),
        center + 0.8 * inner_m * rng.random() * random_unit(rng),
        random_unit(rng),
    )


def box_case(rng: np.random.Generator, views: Views) -> Case:
    half_m = rng.uniform(0.08, 0.25, 3)
    vertices = box_vertices(half_m, random_rotation(rng), rng.uniform(-0.2, 0.2, 3))
    return polyhedron_case(rng, views, vertices, float(half_m.min()))


def cylinder_case(rng: np.random.Generator, views: Views) -> Case:
    radius_m, half_m = rng.uniform(0.08, 0.25, 2)
    vertices = cylinder_vertices(radius_m, half_m, random_rotation(rng), rng.uniform(-0.2, 0.2, 3))
    return polyhedron_case(rng, views, vertices, min(radius_m, half_m))


CASES = {"ball": ball_case, "box": box_case, "cylinder": cylinder_case}

#: Triangles that end beyond the shapes, so that the paper's form finds an end too.
LARGE = ResponseSettings(height_m=2.0, window=1600)


@pytest.fixture(scope="module", params=CASES)
def answers(request: pytest.FixtureRequest) -> list[tuple[Case, Response]]:
    """Shapes 3 m away at 1080 x 736, two to six cameras."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(40):
        views = ring_views(int(rng.integers(2, 7)), 1080, 736, 1050.0)
        case = CASES[request.param](rng, views)
        found.append((case, move(case.hull, case.start_world, case.unit, LARGE)))
    return found


@pytest.mark.slow
def test_the_distance_lies_between_the_outlines_of_half_a_pixel(
    answers: list[tuple[Case, Response]],
) -> None:
    for case, answer in answers:
        assert answer.status in ("", "no normal")
        nearest = case.exits(case.start_world, case.unit, -HALF_PX)[0].distance_m
        farthest = case.exits(case.start_world, case.unit, HALF_PX)[0].distance_m
        assert nearest <= answer.d_rec_m <= farthest
        away = answer.cp_hull_world - case.start_world
        np.testing.assert_allclose(away, answer.d_rec_m * case.unit, atol=1e-12)
        np.testing.assert_array_equal(answer.cp_obj_world, case.start_world)
        np.testing.assert_allclose(answer.v_rec, case.unit, atol=1e-15)


def alone(case: Case) -> Exit | None:
    """The exit of the hull, where one camera ends it, its line not along its cone."""
    exits = case.exits(case.start_world, case.unit, 0.0)
    first = exits[0]
    if first.normal @ case.unit < 0.2:
        return None
    if len(exits) > 1 and exits[1].distance_m < first.distance_m + 3 * first.footprint_m:
        return None
    return first


def test_the_distance_is_the_closed_form_s_to_the_pixel_footprint(
    answers: list[tuple[Case, Response]],
) -> None:
    shares = [
        abs(answer.d_rec_m - truth.distance_m) / truth.footprint_m
        for case, answer in answers
        if (truth := alone(case)) is not None
    ]

    assert len(shares) > 15
    assert max(shares) < 1.0
    assert np.median(shares) < 0.4


def test_the_normal_is_that_of_the_cone_that_ends_the_hull(
    answers: list[tuple[Case, Response]],
) -> None:
    exact, paper = [], []
    for case, answer in answers:
        truth = alone(case)
        if truth is None:
            continue
        # Corners of outlines turn within the window: what ends the hull 15 px further in or out
        # must be the same plane, but for the curvature.
        moved = [case.exits(case.start_world, case.unit, wider)[0] for wider in (-15.0, 15.0)]
        if max(angle_deg(truth.normal, other.normal) for other in moved) > 10:
            continue
        assert answer.status == ""
        exact.append(angle_deg(answer.n_hull, truth.normal))
        if answer.status_paper == "":
            paper.append(angle_deg(answer.n_hull_paper, truth.normal))

    assert len(exact) > 12
    assert np.median(exact) < 2.0
    assert max(exact) < 10.0  # the silhouette's direction within its window, and its curvature
    assert len(paper) > 12
    assert np.median(paper) < 8.0


def test_the_paper_s_distance_is_within_a_step_of_the_exact_one(
    answers: list[tuple[Case, Response]],
) -> None:
    step_m = LARGE.height_m / LARGE.window
    differences = np.array([answer.difference_m for _, answer in answers])

    assert np.isfinite(differences).all()
    assert (differences <= 0).all()  # the last sample in the hull lies before its end
    assert (differences > -step_m).sum() >= 0.95 * len(differences)
    for (_, answer), difference in zip(answers, differences, strict=True):
        assert (answer.status_paper == "missed") == (difference <= -step_m * (1 + 1e-9))
        if answer.status_paper != "no normal":
            continue
        assert np.isnan(answer.n_hull_paper).all()


def test_the_paper_s_settings_find_the_hull_to_an_eighth_of_a_millimetre() -> None:
    """5 cm and 400 steps, section 4.4.3: 0.0125 cm."""
    rng = np.random.default_rng(1)
    views = ring_views()
    differences = []
    for _ in range(200):
        unit = random_unit(rng)
        hull_ball = ball_exits(views, np.zeros(3), 0.2, np.zeros(3), unit)[0]
        start = (hull_ball.distance_m - rng.uniform(0.002, 0.04)) * unit
        answer = move(BALL, start, unit)
        if answer.status_paper in ("", "no normal"):
            differences.append(answer.difference_m)

    assert len(differences) > 150
    assert np.abs(differences).max() <= 0.000125 + 1e-12
    assert np.abs(differences).max() > 0.000115  # as large as said: it is no better sampled


BALL = ball_hull(ring_views(), np.zeros(3), 0.2)


# -- CP_obj and V_rec ---------------------------------------------------------------------------


def test_the_farthest_collision_point_is_chosen() -> None:
    contact = contact_at((0.1, 0, 0), (0, -0.15, 0), (0, 0, 0.12))

    answer = respond(BALL, contact, reference_point_world=np.array([0, 1e-3, 0]))

    np.testing.assert_array_equal(answer.cp_obj_world, [0, -0.15, 0])
    np.testing.assert_allclose(answer.v_rec, [0, 1, 0], atol=1e-15)


def test_of_equally_far_points_the_first_in_x_y_z_is_chosen_whatever_their_order() -> None:
    points = [(s * 0.125, t * 0.125, u * 0.125) for s in (1, -1) for t in (1, -1) for u in (1, -1)]
    rng = np.random.default_rng(0)
    for _ in range(20):
        contact = contact_at(*rng.permutation(points), *rng.permutation(points)[:3])

        chosen = collision_point(contact, np.zeros(3))

        np.testing.assert_array_equal(chosen, [-0.125, -0.125, -0.125])
    mixed = contact_at((0.5, -0.25, -0.5), (-0.25, 0.5, 0.5), (0.5, -0.5, 0.25))
    np.testing.assert_array_equal(collision_point(mixed, np.zeros(3)), [-0.25, 0.5, 0.5])


def test_a_witness_alone_is_the_collision_point() -> None:
    witness = np.array([0.1, 0.05, 0.0123456789])
    contact = replace(contact_at(), certificate="colliding", witness_world=witness)

    answer = respond(BALL, contact, reference_point_world=np.array([1.0, 0, 0]))

    np.testing.assert_array_equal(answer.cp_obj_world, witness)
    assert answer.status == ""
    assert answer.d_rec_m > 0


def test_a_contact_that_does_not_collide_has_no_response() -> None:
    with pytest.raises(ValueError, match="neither a collision point nor a witness"):
        respond(BALL, contact_at(), reference_point_world=np.zeros(3))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_points_that_are_none_are_named(value: float) -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)
    contact = contact_at()
    nowhere = np.array([0.0, value, 0.0])

    with pytest.raises(ValueError, match=r"RP_obj is .* expected a finite point"):
        respond(hull, contact, reference_point_world=nowhere)
    with pytest.raises(ValueError, match=r"CP_obj is .* expected a finite point"):
        respond(hull, contact, reference_point_world=np.ones(3), cp_obj_world=nowhere)


def test_a_known_point_of_contact_and_direction_are_taken_as_they_are() -> None:
    contact = contact_at((0.1, 0, 0))
    start = np.array([0.0, 0.1, 0.05])

    answer = respond(
        BALL,
        contact,
        reference_point_world=np.zeros(3),
        recovery_direction=np.array([0, 0, 7.0]),
        cp_obj_world=start,
    )

    np.testing.assert_array_equal(answer.cp_obj_world, start)
    np.testing.assert_array_equal(answer.v_rec, [0, 0, 1])
    np.testing.assert_array_equal(answer.cp_hull_world[:2], start[:2])
    assert answer.n_hull[2] > 0


@pytest.mark.parametrize("direction", [[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 0]])
def test_a_recovery_direction_has_a_length(direction: list[float]) -> None:
    with pytest.raises(ValueError, match="recovery_direction"):
        move(BALL, np.zeros(3), np.array(direction, float))


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"angle_rad": 0.0}, "angle_rad"),
        ({"angle_rad": np.pi}, "angle_rad"),
        ({"height_m": 0.0}, "height_m"),
        ({"height_m": 3.0}, "height_m"),
        ({"reach_m": np.inf}, "reach_m"),
        ({"window": 0}, "window"),
    ],
)
def test_settings_that_are_no_triangle_are_refused(wrong: dict[str, Any], name: str) -> None:
    with pytest.raises(ValueError, match=name):
        ResponseSettings(**wrong)


# -- Degenerate cases ---------------------------------------------------------------------------


def assert_unknown(*values: NDArray[np.float64] | float) -> None:
    for value in values:
        assert np.isnan(value).all()


@pytest.mark.parametrize("apart_m", [0.0, 1e-16])
def test_at_the_reference_point_there_is_no_direction(apart_m: float) -> None:
    reference = np.array([0.1, 0.02, 0.03]) + apart_m

    answer = respond(BALL, contact_at((0.1, 0.02, 0.03)), reference_point_world=reference)

    assert answer.status == answer.status_paper == "no direction"
    assert np.isfinite(answer.cp_obj_world).all()
    assert_unknown(answer.v_rec, answer.cp_hull_world, answer.n_hull, answer.d_rec_m)
    assert_unknown(answer.cp_hull_paper_world, answer.n_hull_paper, answer.d_rec_paper_m)
    assert_unknown(answer.difference_m)


def slab(n_columns: int = 100) -> Hull:
    """Two cameras far away, one behind the other: the hull is what lies left of a column."""
    mask = np.zeros((720, 720), np.uint8)
    mask[:, : 360 + n_columns] = 1
    along_z = np.array([[7200.0, 0, 360, 3600], [0, 7200, 360, 3600], [0, 0, 1, 10]])
    views = Views(
        ("a", "b"), np.array([[720, 720]] * 2), np.array([along_z] * 2), np.zeros(3), "carve", 1
    )
    return make_hull(views, [mask, mask])


def test_a_hull_without_end_within_reach_has_no_exit() -> None:
    answer = move(slab(), np.zeros(3), np.array([0, 0, 1.0]))

    assert (answer.status, answer.status_paper) == ("no exit", "base inside")
    np.testing.assert_array_equal(answer.v_rec, [0, 0, 1])
    assert_unknown(answer.cp_hull_world, answer.n_hull, answer.d_rec_m)
    assert_unknown(answer.cp_hull_paper_world, answer.n_hull_paper, answer.d_rec_paper_m)


def test_a_base_within_the_hull_is_gone_beyond_exactly_and_not_as_published() -> None:
    answer = move(slab(), np.zeros(3), np.array([1.0, 0, 0]))  # 100 columns, 10 / 7200 m each

    assert (answer.status, answer.status_paper) == ("", "base inside")
    assert answer.d_rec_m == pytest.approx(100 * 10 / 7200, abs=1e-14)
    assert_unknown(answer.cp_hull_paper_world, answer.n_hull_paper, answer.d_rec_paper_m)


def test_a_flat_boundary_has_its_normal_in_both_forms() -> None:
    rng = np.random.default_rng(0)
    end_m = 30 * 10 / 7200
    truth = np.array([7200.0, 0, 360 - 390.0])  # column 390 as a plane of space
    truth /= np.linalg.norm(truth)
    for _ in range(20):
        slant = rng.uniform(-0.5, 0.5, 2)
        unit = np.array([1.0, *slant]) / np.linalg.norm([1.0, *slant])
        start = np.array([end_m - 0.02, *rng.uniform(-0.05, 0.05, 2)])

        answer = move(slab(30), start, unit)

        assert (answer.status, answer.status_paper) == ("", "")
        assert angle_deg(answer.n_hull, truth) < 0.7
        # I, J, K and L are off by a step each, and as far apart as the triangle is wide there.
        step_m, width_m = 0.05 / 400, 2 * np.tan(np.radians(5)) * answer.d_rec_m
        assert angle_deg(answer.n_hull_paper, truth) < np.degrees(1.5 * step_m / (0.5 * width_m))


def test_a_reference_point_nearer_than_the_height_only_gives_the_direction() -> None:
    contact, unit = contact_at((0.0625, 0, 0)), np.array([1.0, 0, 0])
    start = np.array([0.0625, 0, 0])

    near = respond(slab(50), contact, reference_point_world=start + 0.001 * unit)
    far = respond(slab(50), contact, reference_point_world=start + 5.0 * unit)

    np.testing.assert_allclose(near.v_rec, unit, atol=1e-12)
    assert near.d_rec_m == pytest.approx(far.d_rec_m, abs=1e-12)
    assert near.d_rec_m == pytest.approx(500 / 7200 - 0.0625, abs=1e-12)
    assert near.d_rec_paper_m == far.d_rec_paper_m


def two_slabs() -> Hull:
    """Columns 360 to 369 and 376 to 381, 10 / 7200 m each; between them a gap."""
    hull = slab(0)
    mask = np.zeros((720, 720), np.uint8)
    mask[:, 360:370] = mask[:, 376:382] = 1
    return make_hull(hull.views, [mask, mask])


def test_the_search_comes_from_the_base_and_meets_the_last_stretch_below_it() -> None:
    column_m, x = 10 / 7200, np.array([1.0, 0, 0])
    start = 4 * column_m * x

    last = move(two_slabs(), start, x)
    first = move(two_slabs(), start, x, ResponseSettings(height_m=10 * column_m))
    through = move(two_slabs(), start, x, ResponseSettings(height_m=15 * column_m))

    assert last.d_rec_m == pytest.approx(18 * column_m, abs=1e-14)
    assert first.d_rec_m == pytest.approx(6 * column_m, abs=1e-14)
    assert through.d_rec_m == pytest.approx(18 * column_m, abs=1e-14)
    assert (last.status_paper, first.status_paper) == ("", "")
    assert through.status_paper == "base inside"
    assert abs(last.difference_m) <= 0.000125 + 1e-12
    assert abs(first.difference_m) <= 10 * column_m / 400 + 1e-12


def test_a_stretch_between_two_samples_is_told_from_the_exact_form() -> None:
    column_m = 10 / 7200
    settings = ResponseSettings(height_m=30 * column_m, window=3)  # samples 10 columns apart

    answer = move(
        two_slabs(), 4 * column_m * np.array([1.0, 0, 0]), np.array([1.0, 0, 0]), settings
    )

    assert (answer.status, answer.status_paper) == ("", "missed")
    assert answer.d_rec_m == pytest.approx(18 * column_m, abs=1e-14)
    assert answer.d_rec_paper_m == 0.0


def test_a_point_outside_has_nothing_to_recover_from() -> None:
    start = np.array([1e-8, 0, 0])  # single precision may put a point across a rim

    answer = move(slab(0), start, np.array([1.0, 0, 0]))

    assert (answer.status, answer.status_paper) == ("outside", "outside")
    assert answer.d_rec_m == 0.0
    np.testing.assert_array_equal(answer.cp_hull_world, start)
    assert_unknown(answer.n_hull, answer.cp_hull_paper_world, answer.n_hull_paper)
    assert_unknown(answer.d_rec_paper_m)


def test_a_point_outside_whose_way_enters_the_hull_is_moved_through_it() -> None:
    column_m, x = 10 / 7200, np.array([1.0, 0, 0])

    answer = move(two_slabs(), -1e-8 * x, x)

    assert (answer.status, answer.status_paper) == ("", "")
    assert answer.d_rec_m == pytest.approx(22 * column_m + 1e-8, abs=1e-14)


def test_without_four_points_there_is_no_normal_as_published() -> None:
    """At less than a step from the end, I, J, K and L are all CP_obj."""
    answer = move(slab(0), np.array([-5e-5, 0, 0]), np.array([1.0, 0, 0]))

    assert (answer.status, answer.status_paper) == ("", "no normal")
    assert answer.d_rec_paper_m == 0.0
    assert answer.d_rec_m == pytest.approx(5e-5, abs=1e-14)
    assert_unknown(answer.n_hull_paper)
    assert np.isfinite(answer.n_hull).all()


def test_a_corner_of_the_base_within_the_hull_leaves_no_normal_as_published() -> None:
    settings = ResponseSettings(angle_rad=np.radians(170))

    # 4 mm from the plane, but V_rec leaves at 45 degrees: the wide triangle does not.
    answer = move(slab(0), np.array([-0.004, 0, 0]), np.array([1.0, 1.0, 0]), settings)

    assert (answer.status, answer.status_paper) == ("", "no normal")
    assert abs(answer.difference_m) <= 0.000125 + 1e-12
    assert_unknown(answer.n_hull_paper)


def test_an_outline_that_points_back_gives_no_normal() -> None:
    """A wall two pixels thick before a slit of one: more is missing behind it than in front."""
    column_m = 10 / 7200
    mask = np.ones((720, 720), np.uint8)
    mask[:, :368] = mask[:, 370] = 0
    hull = make_hull(slab().views, [mask, mask])
    settings = ResponseSettings(height_m=2 * column_m)

    answer = move(hull, np.array([8.5, 0.5, 0]) * column_m, np.array([1.0, 0, 0]), settings)

    assert answer.status == "no normal"
    assert answer.d_rec_m == pytest.approx(1.5 * column_m, abs=1e-14)
    assert_unknown(answer.n_hull)


def test_the_answer_is_the_same_far_from_the_world_s_origin() -> None:
    views = ring_views()
    far = np.array([1000.0, -2000.0, 500.0])
    moved = replace(views, origin_world=views.origin_world + far)
    hull = replace(BALL, views=moved)
    start, unit = np.array([0.13, 0.05, 0.02]), np.array([0.6, 0, 0.8])

    here, there = move(BALL, start, unit), move(hull, start + far, unit)

    assert there.d_rec_m == pytest.approx(here.d_rec_m, abs=1e-11)
    np.testing.assert_allclose(there.n_hull, here.n_hull, atol=1e-6)
    np.testing.assert_allclose(there.n_hull_paper, here.n_hull_paper, atol=1e-6)
