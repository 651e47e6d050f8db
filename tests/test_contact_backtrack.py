"""First contact between two frames: outlines that move, appear and cross, and what is said then."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.contacts import FREE, contact_at, points_of
from helpers.hulls import ball_hull, ball_masks, ring_views, sphere_mesh
from numpy.typing import NDArray

from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.capture.outline_motion import (
    distances_where,
    follow_outline,
    interpolate_masks,
    signed_distance_px,
)
from hybridve.hull.capture.pixel_boxes import slices_of
from hybridve.hull.contact.backtrack import FirstContact, _patch, approach_speed, first_contact
from hybridve.hull.contact.between import interpolated_hull
from hybridve.hull.contact.detect import (
    Body,
    certify_contacts,
    detect_contacts,
    make_body,
)
from hybridve.hull.query.certify import Certifier
from hybridve.hull.query.native import Native
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, make_hull

HEIGHT, WIDTH = 160, 240

#: How far an interpolated outline is from that of the moving shape: the rims of both frames' pixels
#: say where it is to half a pixel or so.
OUTLINE_PX = 0.8

VIEWS = ring_views(4, 480, 324, 470.0)


@pytest.fixture(scope="module")
def certifier() -> Iterator[Certifier]:
    with Certifier(1e-4, n_threads=2) as certifier:
        yield certifier


@pytest.fixture(scope="module")
def engine() -> Iterator[Native]:
    with Native(2) as engine:
        yield engine


def distance_to(center: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far each pixel's centre is from a point (x, y), in pixels."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return np.asarray(np.hypot(x - center[0], y - center[1]))


def disc(center: NDArray[np.float64], radius_px: float) -> NDArray[np.uint8]:
    return (distance_to(center) < radius_px).astype(np.uint8)


def bar(rows: tuple[int, int], columns: tuple[int, int]) -> NDArray[np.uint8]:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[slice(*rows), slice(*columns)] = 1
    return mask


@pytest.mark.parametrize("radius_px", [3.0, 8.0, 20.0])
@pytest.mark.parametrize("widths", [0.25, 0.5, 1.0, 2.5])
def test_a_disc_keeps_its_shape_however_fast_it_moves(radius_px: float, widths: float) -> None:
    rng = np.random.default_rng(int(radius_px * 100 + widths * 4))
    for fraction in (0.2, 0.5, 0.9):
        angle = rng.uniform(0, 2 * np.pi)
        way = 2 * radius_px * widths * np.array([np.cos(angle), 0.6 * np.sin(angle)])
        start = np.array([WIDTH, HEIGHT]) / 2 + rng.uniform(-3, 3, 2) - way / 2

        (between,) = interpolate_masks(
            [disc(start, radius_px)], [disc(start + way, radius_px)], fraction
        )

        outside_px = distance_to(start + fraction * way) - radius_px
        assert between[outside_px < -OUTLINE_PX].all()
        assert not between[outside_px > OUTLINE_PX].any()


def test_two_discs_that_move_past_each_other_keep_their_ways() -> None:
    upper, lower = np.array([60.0, 50.0]), np.array([160.0, 110.0])
    ways = np.array([70.0, 4.0]), np.array([-60.0, -3.0])
    before = disc(upper, 12) | disc(lower, 9)
    after = disc(upper + ways[0], 12) | disc(lower + ways[1], 9)

    (between,) = interpolate_masks([before], [after], 0.4)

    expected_px = np.minimum(
        distance_to(upper + 0.4 * ways[0]) - 12, distance_to(lower + 0.4 * ways[1]) - 9
    )
    assert between[expected_px < -OUTLINE_PX].all()
    assert not between[expected_px > OUTLINE_PX].any()


def test_what_stands_still_stays_while_something_passes_it() -> None:
    torso = bar((60, 160), (100, 130))
    start, way = np.array([60.0, 40.0]), np.array([90.0, 0.0])

    (between,) = interpolate_masks([torso | disc(start, 10)], [torso | disc(start + way, 10)], 0.5)

    outside_px = np.where(torso > 0, -1.0, distance_to(start + way / 2) - 10)
    assert between[outside_px < -OUTLINE_PX].all()
    # Between the disc, which comes within ten pixels, and the torso a bridge of a few may form.
    near_both = (distance_to(start + way / 2) < 14) & (np.arange(HEIGHT)[:, None] > 45)
    assert not between[(outside_px > OUTLINE_PX) & ~near_both].any()


def test_a_hand_on_an_arm_arrives_when_its_half_way_is_done() -> None:
    """The arm comes out of the image's border; the hand is wider, so the wrist is left behind."""

    def reaching(tip: int) -> NDArray[np.uint8]:
        return bar((75, 85), (0, tip)) | bar((70, 90), (tip - 20, tip))

    (between,) = interpolate_masks([reaching(100)], [reaching(150)], 0.5)

    assert abs(int(np.flatnonzero(between[80]).max()) + 1 - 125) <= 1
    assert abs(int(np.flatnonzero(between[71]).min()) - 105) <= 1
    assert between[80, :100].all()


def test_a_wire_that_moves_by_many_widths_is_not_lost() -> None:
    (between,) = interpolate_masks([bar((20, 140), (50, 52))], [bar((20, 140), (80, 82))], 0.5)

    rows, columns = np.nonzero(between)
    assert len(set(rows.tolist())) > 110
    assert columns.min() >= 64
    assert columns.max() <= 67


@pytest.mark.parametrize("shape", [(97, 151), (203, 300)])
@pytest.mark.parametrize("density", [0.0, 0.001, 0.3, 0.9999, 1.0])
def test_distances_where_they_are_wanted_are_opencvs(
    density: float, shape: tuple[int, int]
) -> None:
    rng = np.random.default_rng(3)
    mask = (rng.random(shape) < density).astype(np.uint8)
    mask[20:50, 60:120] = density > 0
    wanted = (rng.random(mask.shape) < 0.5).astype(np.uint8)

    found, expected = distances_where(mask, wanted), signed_distance_px(mask)

    # Theirs may err by a rounding; on this machine large ones are the same to the bit.
    np.testing.assert_allclose(found[wanted > 0], expected[wanted > 0], rtol=1e-6)
    np.testing.assert_array_equal(np.sign(found), np.sign(expected))


def test_outlines_are_what_distances_everywhere_make_of_them() -> None:
    rng = np.random.default_rng(7)
    n_moves = 0
    for _ in range(12):
        starts = rng.uniform((20, 20), (WIDTH - 20, HEIGHT - 20), (3, 2))
        radii, ways = rng.uniform(3, 25, 3), rng.uniform(-25, 25, (3, 2))
        before, after = (
            np.maximum.reduce(
                [
                    disc(start + f * way, r)
                    for start, way, r in zip(starts, ways, radii, strict=True)
                ]
            )
            for f in (0.0, 1.0)
        )
        outline = follow_outline(before, after, (0, HEIGHT, 0, WIDTH))
        crop = slices_of(outline.crop)
        n_moves += len(outline.moves)

        everywhere = replace(
            outline,
            distance_before=signed_distance_px(before[crop]),
            distance_after=signed_distance_px(after[crop]),
        )

        for fraction in (0.125, 1 / 3, 0.5, 0.8):
            # OpenCV's distances hang by a rounding on how many threads it has; that may decide
            # pixels which the outline passes through the middle of, of some 300 that it passes.
            assert (outline.at(fraction) != everywhere.at(fraction)).sum() <= 5
    assert n_moves > 12


def test_masks_that_cannot_be_interpolated_are_refused() -> None:
    mask = bar((0, 5), (0, 5))
    with pytest.raises(ValueError, match=r"fraction is 1\.5, expected 0\.\.1"):
        interpolate_masks([mask], [mask], 1.5)
    with pytest.raises(ValueError, match=r"fraction is nan"):
        interpolate_masks([mask], [mask], float("nan"))
    with pytest.raises(ValueError, match="1 masks before and 2 after"):
        interpolate_masks([mask], [mask, mask], 0.5)
    with pytest.raises(ValueError, match=r"mask 0 has shape \(160, 240\) before and \(5, 240\)"):
        interpolate_masks([mask], [mask[:5]], 0.5)


def test_no_cameras_have_no_masks_between() -> None:
    assert interpolate_masks([], [], 0.5) == []


# --- first contact --------------------------------------------------------------------------------


def plates(*heights_m: float, half_m: float = 0.5) -> SceneObject:
    """Squares in planes across Z, of two triangles each."""
    square = half_m * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = np.concatenate([square + np.array([0, 0, height_m]) for height_m in heights_m])
    faces = np.concatenate(
        [4 * k + np.array([[0, 1, 2], [0, 2, 3]]) for k in range(len(heights_m))]
    )
    return SceneObject(
        "plates", Path("plates.stl"), vertices, faces.astype(np.int32), 0.0, np.zeros(3), None
    )


def ball(x_m: float, z_m: float, radius_m: float = 0.06) -> Hull:
    return ball_hull(VIEWS, np.array([x_m, 0.0, z_m]), radius_m)


def entry(
    before: Hull, after: Hull, body: Body, certifier: Certifier | None, engine: Native
) -> FirstContact:
    """Return the first contact of a body that collides in the second frame."""
    contacts = detect_contacts(after, [body], engine)
    if certifier is not None:
        contacts = certify_contacts(after, [body], contacts, certifier)
    return first_contact(before, after, body, contacts[0], certifier, engine)


def test_a_plate_that_is_crossed_between_the_frames_is_where_contact_begins(
    certifier: Certifier, engine: Native
) -> None:
    """Nothing touches any more at three quarters of the way, and again something at its end."""
    before, after = ball(0.0, 0.30, 0.03), ball(0.0, -0.21, 0.03)
    body = make_body(plates(0.15, -0.2), viewport=200)

    found = entry(before, after, body, certifier, engine)

    assert found.status == ""
    assert found.point_world[2] == pytest.approx(0.15, abs=1e-12)
    assert 0.1 < found.fraction < (0.30 - 0.15) / 0.51  # before the centre is in the plate


def test_what_grazes_an_object_and_goes_on_first_touches_where_it_grazes(
    certifier: Certifier, engine: Native
) -> None:
    """A ball slides past the edge of a plate, above a lower one that it then reaches."""
    upper, lower = plates(0.05, half_m=0.1), plates(-0.2)
    vertices = np.concatenate([upper.vertices_world, lower.vertices_world])
    faces = np.concatenate([upper.faces, lower.faces + 4])
    both = SceneObject("both", Path("b.stl"), vertices, faces, 0.0, np.zeros(3), None)
    before, after = ball(0.22, 0.25), ball(0.10, -0.17)  # passes x = 0.16 half-way, 0.06 away

    grazing = entry(before, after, make_body(both, viewport=200), certifier, engine)
    falling = entry(before, after, make_body(lower, viewport=200), certifier, engine)

    assert grazing.status == falling.status == ""
    assert grazing.point_world[2] == pytest.approx(0.05, abs=1e-12)
    assert falling.point_world[2] == pytest.approx(-0.2, abs=1e-12)
    assert grazing.fraction < falling.fraction


def test_of_two_bodies_that_cross_the_one_that_comes_down_is_timed(
    certifier: Certifier, engine: Native
) -> None:
    """Another ball goes up beside it by twice its own width."""

    def two(down_m: float, up_m: float) -> Hull:
        masks = zip(
            ball_masks(VIEWS, np.array([0.0, 0.0, down_m]), 0.05),
            ball_masks(VIEWS, np.array([0.3, 0.3, up_m]), 0.05),
            strict=True,
        )
        return make_hull(VIEWS, [first | second for first, second in masks])

    body = make_body(plates(-0.2, half_m=0.15), viewport=150)

    alone = entry(ball(0.0, 0.0, 0.05), ball(0.0, -0.18, 0.05), body, certifier, engine)
    found = entry(two(0.0, -0.1), two(-0.18, 0.1), body, certifier, engine)

    assert found.status == ""
    assert found.fraction == pytest.approx(alone.fraction, abs=0.02)  # 4 mm of 180
    np.testing.assert_allclose(found.point_world, alone.point_world, atol=0.02)


def test_what_was_in_no_picture_a_frame_before_has_no_instant(
    certifier: Certifier, engine: Native
) -> None:
    nothing = make_hull(VIEWS, [np.zeros((324, 480), np.uint8)] * 4)
    after = ball(0.0, -0.2)
    body = make_body(plates(-0.2), viewport=100)

    found = entry(nothing, after, body, certifier, engine)

    assert found.status == "outline lost"
    assert (found.fraction, found.fraction_uncertainty) == (0.5, 0.5)
    assert contains_points(after, found.point_world[None])[0]


def test_an_outline_missing_in_one_camera_alone_is_lost_too(
    certifier: Certifier, engine: Native
) -> None:
    """Hidden from one camera, in the hull all the same as soon as that one sees it."""
    before = ball(0.0, -0.19)
    masks = [before.mask(camera).copy() for camera in range(4)]
    masks[2][:] = 0
    body = make_body(plates(-0.2), viewport=100)

    found = entry(make_hull(VIEWS, masks), ball(0.0, -0.2), body, certifier, engine)

    assert found.status == "outline lost"


def test_a_surface_that_is_touched_already_between_its_samples_is_told(
    certifier: Certifier, engine: Native
) -> None:
    before, after = ball(0.21, -0.2, 0.01), ball(0.0, -0.2, 0.06)
    body = make_body(plates(-0.2), viewport=3)
    (sampled,) = detect_contacts(before, [body], engine)
    assert not sampled.collides

    found = entry(before, after, body, certifier, engine)

    assert found.status == "touches before"
    assert (found.fraction, found.fraction_uncertainty) == (0.0, 1.0)
    assert contains_points(before, found.point_world[None])[0]


@pytest.mark.parametrize("is_certified", [False, True])
def test_a_contact_that_no_hull_confirms_keeps_its_own_point(
    certifier: Certifier, engine: Native, is_certified: bool
) -> None:
    before, after = ball(0.0, 0.2), ball(0.0, 0.1)
    body = make_body(plates(-0.2), viewport=50)
    rim = contact_at([[0.25, 0.5, -0.2]])

    found = first_contact(before, after, body, rim, certifier if is_certified else None, engine)

    assert found.status == "no touch found"
    assert (found.fraction, found.fraction_uncertainty) == (1.0, 1.0)
    np.testing.assert_array_equal(found.point_world, points_of(rim)[0])


def test_samples_touch_after_the_surface_does_and_soon(
    certifier: Certifier, engine: Native
) -> None:
    before, after = ball(0.02, -0.08), ball(0.0, -0.18)
    body = make_body(plates(-0.2), viewport=400)  # a sample each 2.5 mm

    certain = entry(before, after, body, certifier, engine)
    sampled = entry(before, after, body, None, engine)

    # One pixel is 6 mm, so samples miss little: a few millimetres of 100.
    assert certain.fraction <= sampled.fraction <= certain.fraction + 0.1
    assert contains_points(
        interpolated_hull(before, after, sampled.fraction), sampled.point_world[None]
    )[0]
    np.testing.assert_allclose(sampled.point_world, certain.point_world, atol=0.02)


def test_the_point_lies_amid_the_patch_of_first_contact(
    certifier: Certifier, engine: Native
) -> None:
    """On a fine mesh, whose first triangle that touches is not the middle one."""
    before, after = ball(0.0, 0.0, 0.05), ball(0.0, -0.15, 0.05)
    mesh = sphere_mesh(5000, 0.1, center_world=(0.0, 0.0, -0.25))
    scene_object = SceneObject(
        "sphere", Path("s.stl"), mesh.vertices_world, mesh.faces, 0.0, np.zeros(3), None
    )

    found = entry(before, after, make_body(scene_object, viewport=4), certifier, engine)

    hull = interpolated_hull(before, after, found.fraction)
    patch = certifier.certify(hull, mesh).witness_world
    patch = patch[np.isfinite(patch).all(axis=1)]
    assert len(patch) > 0
    size_m = float(np.linalg.norm(np.ptp(patch, axis=0))) + 0.01
    assert np.linalg.norm(found.point_world - patch.mean(axis=0)) < 0.5 * size_m
    radius_m = np.linalg.norm(found.point_world - [0.0, 0.0, -0.25])
    assert 0.0995 < radius_m < 0.1 + 1e-12  # on a triangle of the sphere


def test_a_triangle_as_thin_as_rounding_gives_no_samples() -> None:
    """Its normal is not quite nothing, but what it says is across it is not."""
    sliver = np.array([[0.2, 0.3, 0.2], [0.0, 0.1, -0.3], [0.1, 0.2, -0.04999999999999999]])
    assert np.linalg.norm(np.cross(sliver[1] - sliver[0], sliver[2] - sliver[0])) > 0
    hull = ball(0.0, 0.0, 0.5)

    alone, _ = _patch(hull, sliver[None], sliver[2], 0.1)
    wide = sliver + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    beside, _ = _patch(hull, np.stack([sliver, wide]), sliver[2], 0.1)

    assert len(alone) == 0
    assert len(beside) > 0


def test_the_result_is_the_same_to_the_bit_on_any_number_of_threads_and_after_any_frame(
    engine: Native,
) -> None:
    before, after = ball(0.05, 0.0), ball(0.0, -0.15)
    mesh = sphere_mesh(5000, 0.1, center_world=(0.0, 0.0, -0.25))
    scene_object = SceneObject(
        "sphere", Path("s.stl"), mesh.vertices_world, mesh.faces, 0.0, np.zeros(3), None
    )
    results = []
    for n_threads, asks_first in ((1, False), (2, False), (3, True)):
        body = make_body(scene_object, viewport=4)
        with Certifier(1e-4, n_threads) as certifier:
            for hull in (ball(0.2, 0.1), ball(0.0, -0.2)) if asks_first else ():
                certifier.certify_mesh(hull, body.triangles)
            results.append(entry(before, after, body, certifier, engine))

    for other in results[1:]:
        assert other.fraction == results[0].fraction
        np.testing.assert_array_equal(other.point_world, results[0].point_world)


def test_hulls_of_other_cameras_and_contacts_without_a_point_are_refused(
    certifier: Certifier, engine: Native
) -> None:
    hull = ball(0.0, 0.1)
    others = ball_hull(ring_views(4, 480, 324, 471.0), np.zeros(3), 0.05)
    body = make_body(plates(-0.2), viewport=10)
    nothing = FREE
    with pytest.raises(ValueError, match="not of the same views"):
        interpolated_hull(hull, others, 0.5)
    with pytest.raises(ValueError, match="not of the same views"):
        first_contact(hull, others, body, nothing, certifier, engine)
    with pytest.raises(ValueError, match="plates: the contact has neither points nor a witness"):
        first_contact(hull, hull, body, nothing, certifier, engine)


# --- speed of approach ----------------------------------------------------------------------------


def test_what_is_unknown_or_unbounded_stays_so() -> None:
    nan, inf = float("nan"), float("inf")
    assert approach_speed((0.5, 0.5), (0.25, 0.25), 0.5) == (0.5, 0.5)
    assert approach_speed((0.25, 0.25), (0.5, 0.5), 0.5) == (-0.5, -0.5)
    assert approach_speed((1.0, inf), (0.5, 0.5), 0.5) == (1.0, inf)
    assert approach_speed((0.5, 0.5), (1.0, inf), 0.5) == (-inf, -1.0)
    assert approach_speed((1.0, inf), (1.0, inf), 0.5) == (-inf, inf)
    assert approach_speed((inf, inf), (inf, inf), 0.5) == (-inf, inf)
    np.testing.assert_array_equal(approach_speed((nan, nan), (0.5, 0.5), 0.5), (nan, nan))
    np.testing.assert_array_equal(approach_speed((0.5, 1.0), (0.5, nan), 0.5), (nan, 1.0))


def test_a_time_that_does_not_pass_and_bounds_the_wrong_way_are_refused() -> None:
    for dt_s in (0.0, -0.02, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="expected a positive time"):
            approach_speed((0.1, 0.2), (0.1, 0.2), dt_s)
    with pytest.raises(ValueError, match="the wrong way"):
        approach_speed((0.2, 0.1), (0.1, 0.2), 0.02)
