"""Between two frames: what every interpolation keeps, and when a ball's true hull touches."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.hulls import ball_angles, ball_hull, pixels_of, ring_views
from helpers.thorough import asked
from hypothesis import Phase, assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.capture.outline_motion import interpolate_masks
from hybridve.hull.contact.backtrack import approach_speed, first_contact
from hybridve.hull.contact.between import interpolated_hull
from hybridve.hull.contact.detect import certify_contacts, detect_contacts, make_body
from hybridve.hull.query.certify import Certifier
from hybridve.hull.query.native import Native
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Views

HEIGHT, WIDTH = 80, 120

#: The outline of an interpolated mask is off by less than this (`test_contact_backtrack.py`), and
#: a pixel reaches half a diagonal beyond its centre, whose ray decides in the closed form.
OUTLINE_PX = 0.8 + 0.71

#: The first colliding fraction is known to this.
RESOLUTION = 1 / 256

#: The plane of the plate, in metres, and half its edge: wider than any ball's way.
PLATE_Z_M, PLATE_HALF_M = -0.2, 0.8

fractions = st.floats(0.0, 1.0)


@st.composite
def masks(draw: st.DrawFn) -> NDArray[np.uint8]:
    """Unions of discs and bars, a few specks, nothing, or everything."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["things", "things", "things", "noise", "empty", "full"]))
    if kind in ("empty", "full"):
        return np.full((HEIGHT, WIDTH), kind == "full", np.uint8)
    if kind == "noise":
        share = rng.choice([0.02, 0.5, 0.98])
        return np.asarray(rng.random((HEIGHT, WIDTH)) < share).astype(np.uint8)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    mask = np.zeros((HEIGHT, WIDTH), np.bool_)
    for _ in range(rng.integers(1, 5)):
        u, v = x - rng.uniform(-10, WIDTH + 10), y - rng.uniform(-10, HEIGHT + 10)
        if rng.random() < 0.5:
            mask |= u**2 + v**2 < rng.uniform(1, 25) ** 2
        else:
            angle = rng.uniform(0, np.pi)
            along, across = rng.uniform(3, 60), rng.uniform(1, 8)
            mask |= (np.abs(u * np.cos(angle) + v * np.sin(angle)) < along) & (
                np.abs(v * np.cos(angle) - u * np.sin(angle)) < across
            )
    return mask.astype(np.uint8)


@given(mask=masks(), fraction=fractions)
def test_between_equal_masks_is_the_mask(mask: NDArray[np.uint8], fraction: float) -> None:
    (between,) = interpolate_masks([mask], [mask.copy()], fraction)

    np.testing.assert_array_equal(between, mask)


@given(before=masks(), after=masks(), fraction=fractions)
def test_ends_are_the_frames_and_the_rest_lies_within_their_changes(
    before: NDArray[np.uint8], after: NDArray[np.uint8], fraction: float
) -> None:
    (start,) = interpolate_masks([before], [after], 0.0)
    (between,) = interpolate_masks([before], [after], fraction)
    (end,) = interpolate_masks([before], [after], 1.0)

    np.testing.assert_array_equal(start, before)
    np.testing.assert_array_equal(end, after)
    assert set(np.unique(between)) <= {0, 1}
    assert between[(before & after) > 0].all()  # what is there in both frames stays
    rows, columns = np.nonzero(before != after)
    untouched = np.ones_like(before, np.bool_)
    if len(rows):
        untouched[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] = False
    np.testing.assert_array_equal(between[untouched], before[untouched])


@given(
    before=masks(),
    growth_px=st.integers(1, 6),
    pair=st.tuples(fractions, fractions).map(sorted),
    shrinks=st.booleans(),
)
def test_what_grows_grows_all_the_time(
    before: NDArray[np.uint8], growth_px: int, pair: list[float], shrinks: bool
) -> None:
    padded = np.pad(before, growth_px)
    window = (2 * growth_px + 1, 2 * growth_px + 1)
    after = np.lib.stride_tricks.sliding_window_view(padded, window).max(axis=(2, 3))

    if shrinks:
        early, late = (interpolate_masks([after], [before], 1.0 - f)[0] for f in pair)
    else:
        early, late = (interpolate_masks([before], [after], f)[0] for f in pair)

    assert (before <= early).all()
    assert (early <= late).all()
    assert (late <= after).all()


@example(intervals=[[5.0, 5.0, 5.0], [0.0, 0.0, 1e-17]], dt_s=1.0, unbounded=(False, False))
@given(
    intervals=st.lists(
        st.tuples(st.floats(0, 5), st.floats(0, 5), st.floats(0, 5)).map(sorted),
        min_size=2,
        max_size=2,
    ),
    dt_s=st.floats(1e-3, 1.0),
    unbounded=st.tuples(st.booleans(), st.booleans()),
)
def test_the_mean_speed_of_approach_lies_within_its_bounds(
    intervals: list[list[float]], dt_s: float, unbounded: tuple[bool, bool]
) -> None:
    (low_0, true_0, high_0), (low_1, true_1, high_1) = intervals
    high_0, high_1 = (
        np.inf if is_open else high
        for is_open, high in zip(unbounded, (high_0, high_1), strict=True)
    )

    lower, upper = approach_speed((low_0, high_0), (low_1, high_1), dt_s)

    speed_m_s = (true_0 - true_1) / dt_s
    assert lower <= speed_m_s <= upper
    assert np.isinf(lower) == unbounded[1]
    assert np.isinf(upper) == unbounded[0]
    # Attained: the bounds are as near as the intervals allow.
    if not any(unbounded):
        # Speeds are rounded by 1e-16 of 5 m a dt each.
        widths_m = high_0 - low_0 + high_1 - low_1
        np.testing.assert_allclose(upper - lower, widths_m / dt_s, atol=1e-14 / dt_s)


@pytest.fixture(scope="module")
def certifier() -> Iterator[Certifier]:
    with Certifier(1e-4, n_threads=2) as certifier:
        yield certifier


@pytest.fixture(scope="module")
def engine() -> Iterator[Native]:
    with Native(2) as engine:
        yield engine


def plate() -> SceneObject:
    corners = PLATE_HALF_M * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    corners[:, 2] = PLATE_Z_M
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return SceneObject("plate", Path("plate.stl"), corners, faces, 0.0, np.zeros(3), None)


def gap(
    views: Views, center_world: NDArray[np.float64], radius_m: float, wider_px: float
) -> tuple[float, NDArray[np.float64]]:
    """Return how far the cones of a ball are from a common point in the plate, and that point.

    Radians, 0 or less where they have one; each cone is wider by some pixels. The cones cut convex
    pieces from the plate, so the largest angle outside of any has one minimum: a grid finds it.
    """
    middle, reach_m = np.append(center_world[:2], PLATE_Z_M), 0.4
    steps = np.linspace(-1.0, 1.0, 21)
    grid = np.stack([*np.meshgrid(steps, steps), np.zeros((21, 21))], axis=-1).reshape(-1, 3)
    best = np.inf
    for _ in range(5):
        points = middle + reach_m * grid
        outside_rad, _, pixel_rad = ball_angles(views, points, center_world, radius_m)
        worst_rad = (outside_rad - wider_px * pixel_rad[:, None]).max(axis=0)
        middle, best = points[int(worst_rad.argmin())], float(worst_rad.min())
        reach_m *= 0.25
    return best, middle


def touching_fraction(
    views: Views, ends: tuple[NDArray[np.float64], NDArray[np.float64]], radius_m: float, px: float
) -> float:
    """Return when the cones of a ball, wider by some pixels, first share a point of the plate.

    Between the instants at which its centre is four radii above the plate, and in it.
    """
    fall_m, height_m = ends[0][2] - ends[1][2], ends[0][2] - PLATE_Z_M
    free, touching = (height_m - 4 * radius_m) / fall_m, height_m / fall_m
    assert gap(views, ends[0] + free * (ends[1] - ends[0]), radius_m, px)[0] > 0
    assert gap(views, ends[0] + touching * (ends[1] - ends[0]), radius_m, px)[0] < 0
    while touching - free > 1e-3:
        middle = 0.5 * (free + touching)
        center = ends[0] + middle * (ends[1] - ends[0])
        if gap(views, center, radius_m, px)[0] <= 0:
            touching = middle
        else:
            free = middle
    return float(touching)


# Not shrunk: an example takes a tenth of a second.
@pytest.mark.slow
@settings(max_examples=asked(30), phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(
    radius_m=st.floats(0.04, 0.1),
    widths=st.floats(0.1, 3.0),
    slope=st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5)),
    place=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)),
    instant=st.floats(0.1, 0.9),
)
def test_a_ball_touches_when_its_true_cones_do_to_a_pixel(
    certifier: Certifier,
    engine: Native,
    radius_m: float,
    widths: float,
    slope: tuple[float, float],
    place: tuple[float, float],
    instant: float,
) -> None:
    """The interpolated outlines lie between the true ones made thinner and wider by some pixels.

    So contact lies between the times at which those cones touch. The pixels: what
    `OUTLINE_PX` says, and what straight lines in the image miss of a straight way in space. A point
    that moves by D pixels while its depth goes from z to z' is off by at most
    D |z' - z| / (4 min(z, z')); a radius, by as many parts of itself, squared.
    """
    views = ring_views(4, 480, 324, 470.0)
    way = np.array([*slope, -1.0])
    way *= 2 * radius_m * widths / np.linalg.norm(way)
    start = np.array([*place, PLATE_Z_M + 1.05 * radius_m]) - instant * way
    ends = (start, start + way)
    before, after = (ball_hull(views, end, radius_m) for end in ends)
    body = make_body(plate(), viewport=160)
    (free,) = certify_contacts(before, [body], detect_contacts(before, [body], engine), certifier)
    (contact,) = certify_contacts(after, [body], detect_contacts(after, [body], engine), certifier)
    assume(free.certificate == "free" and contact.certificate == "colliding")

    found = first_contact(before, after, body, contact, certifier, engine)

    pixels, depths_m = pixels_of(views, np.stack(ends) - views.origin_world)
    stretch = np.abs(np.diff(depths_m, axis=1))[:, 0] / depths_m.min(axis=1)
    radius_px = 470.0 * radius_m / depths_m.min(axis=1)
    bend_px = np.linalg.norm(np.diff(pixels, axis=1)[:, 0], axis=1) * stretch / 4
    pad_px = OUTLINE_PX + float((bend_px + radius_px * stretch**2).max())
    assert found.status == ""
    earliest = touching_fraction(views, ends, radius_m, pad_px)
    latest = touching_fraction(views, ends, radius_m, -pad_px)
    assert earliest - RESOLUTION - 1e-3 <= found.fraction <= latest + RESOLUTION + 1e-3
    assert 0.0 <= found.fraction <= 1.0
    assert found.fraction_uncertainty == max(found.fraction, 1.0 - found.fraction)
    assert abs(found.point_world[2] - PLATE_Z_M) < 1e-12
    # The windows that the interpolation was cut to are wide enough: the whole masks agree.
    hull = interpolated_hull(before, after, found.fraction)
    assert contains_points(hull, found.point_world[None])[0]
    # In the true cones, wider by as much, at that instant.
    center = ends[0] + found.fraction * way
    outside_rad, _, pixel_rad = ball_angles(views, found.point_world[None], center, radius_m)
    assert (outside_rad[:, 0] <= pad_px * pixel_rad).all()
