"""Connected volumes of a hull, and phantom volumes where they must be."""

from pathlib import Path

import numpy as np
import pytest
from helpers.cones import hull_of_balls, views_from
from helpers.hulls import MASK_KINDS, UNSEEN, ball_hull, random_masks, random_views, ring_views
from helpers.thorough import asked
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.hull.capture.recording import FrameRange, segmented_frames
from hybridve.hull.capture.rig import load_rig
from hybridve.hull.capture.session import load_session
from hybridve.hull.chain import rig_views
from hybridve.hull.contact.components import (
    NOWHERE,
    Coverage,
    Volumes,
    connected_volumes,
    cover,
    grown,
    is_real,
    is_real_at,
    pixel_rays,
)
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, make_hull
from hybridve.hull.query.walk import spans_in_hull
from hybridve.hull.report.columns import TABLES

CELL_M = 0.02

BALL_A, BALL_B = np.array([-0.4, 0.1, 0.0]), np.array([0.5, -0.1, 0.0])
FIRST, SECOND = np.array([-0.6, -3.0, 0.0]), np.array([1.2, -2.8, 0.0])
ABOVE = np.array([0.2, 2.0, 2.4])  # sees both balls, and between them
RADIUS_M = 0.08


def crossing(
    a: NDArray[np.float64],
    through_a: NDArray[np.float64],
    b: NDArray[np.float64],
    through_b: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return where the lines from a and from b meet, in a plane of constant z."""
    along = np.column_stack([(through_a - a)[:2], -(through_b - b)[:2]])
    return np.asarray(a + np.linalg.solve(along, (b - a)[:2])[0] * (through_a - a))


def tell(hull: Hull) -> tuple[Volumes, list[bool]]:
    volumes = connected_volumes(grown(hull))
    coverage = cover(volumes)
    return volumes, [is_real(hull, volumes, coverage, k) for k in range(len(volumes))]


def volume_at(volumes: Volumes, point: NDArray[np.float64]) -> int:
    return int(volumes.at(point[None])[0])


@pytest.mark.slow
def test_rays_of_different_balls_cross_in_a_phantom_that_is_unsure_and_the_balls_are_real() -> None:
    # The first camera sees the phantom before ball B, the second before A, the third behind A.
    phantom = crossing(FIRST, BALL_B, SECOND, BALL_A)
    third = phantom + (BALL_A - phantom) * 3.0 / np.linalg.norm(BALL_A - phantom)
    hull = hull_of_balls(
        views_from([FIRST, SECOND, third]), [(BALL_A, RADIUS_M), (BALL_B, RADIUS_M)]
    )

    volumes, real = tell(hull)

    of_a, of_b, of_phantom = (volume_at(volumes, point) for point in (BALL_A, BALL_B, phantom))
    assert len({of_a, of_b, of_phantom}) == 3 == len(volumes)
    assert [real[of_a], real[of_b], real[of_phantom]] == [True, True, False]


@pytest.mark.slow
def test_a_phantom_on_a_neck_is_one_volume_with_what_is_real_and_no_more_is_said() -> None:
    phantom = crossing(FIRST, BALL_B, SECOND, BALL_A)
    third = phantom + (BALL_A - phantom) * 3.0 / np.linalg.norm(BALL_A - phantom)
    balls = [(BALL_A, RADIUS_M), (BALL_B, RADIUS_M)]
    way = phantom - BALL_A
    # A string of beads, a cell wide, from the ball half into the phantom.
    neck = [(BALL_A + share * way, CELL_M / 2.0) for share in np.linspace(0.0, 1.0, 60)]

    volumes, real = tell(hull_of_balls(views_from([FIRST, SECOND, third]), balls + neck))

    # Apart, the phantom is unsure (above). On its neck it is of a volume that holds the ball; where
    # in it something real is, is not proved, and `component` is called an estimate for it.
    assert volume_at(volumes, phantom) == volume_at(volumes, BALL_A) != NOWHERE
    assert real[volume_at(volumes, phantom)]
    (told,) = [one for table in TABLES for one in table.columns if one.name == "component"]
    assert told.kind == "estimate"


def test_the_proof_rests_on_rays_and_not_on_the_blocks_that_suggest_them() -> None:
    phantom = crossing(FIRST, BALL_B, SECOND, BALL_A)
    third = phantom + (BALL_A - phantom) * 3.0 / np.linalg.norm(BALL_A - phantom)
    hull = hull_of_balls(
        views_from([FIRST, SECOND, third]), [(BALL_A, RADIUS_M), (BALL_B, RADIUS_M)]
    )
    volumes, _ = tell(hull)
    number = volume_at(volumes, phantom)

    everywhere = Coverage([np.full((120, 160), number)] * 3)

    assert not is_real(hull, volumes, everywhere, number)


def test_a_camera_that_sees_background_through_a_phantom_carves_it() -> None:
    phantom = crossing(FIRST, BALL_B, SECOND, BALL_A)
    third = ABOVE
    hull = hull_of_balls(
        views_from([FIRST, SECOND, third]), [(BALL_A, RADIUS_M), (BALL_B, RADIUS_M)]
    )

    volumes, real = tell(hull)

    assert volume_at(volumes, phantom) == NOWHERE
    assert sorted({volume_at(volumes, BALL_A), volume_at(volumes, BALL_B)}) == [0, 1]
    assert real == [True, True]


def test_with_two_cameras_nothing_tells_two_balls_from_their_two_phantoms() -> None:
    hull = hull_of_balls(views_from([FIRST, SECOND]), [(BALL_A, RADIUS_M), (BALL_B, RADIUS_M)])

    volumes, real = tell(hull)

    points = [
        BALL_A,
        BALL_B,
        crossing(FIRST, BALL_A, SECOND, BALL_B),
        crossing(FIRST, BALL_B, SECOND, BALL_A),
    ]
    assert sorted(volume_at(volumes, point) for point in points) == [0, 1, 2, 3]
    assert real == [False] * 4


def test_one_volume_is_real_and_no_volume_is_none() -> None:
    views = ring_views()

    one, real = tell(ball_hull(views, np.array([0.1, 0.0, 0.1]), 0.2))
    none, of_none = tell(make_hull(views, [np.zeros((486, 720), np.uint8)] * 4))

    assert real == [True]
    assert len(one) == 1
    assert (len(none), of_none) == (0, [])
    assert volume_at(none, np.zeros(3)) == NOWHERE


def test_an_object_pixel_that_no_other_camera_supports_proves_nothing() -> None:
    # A speck in one camera beside two real balls: its ray meets no hull.
    views = views_from([FIRST, SECOND, ABOVE])
    hull = hull_of_balls(views, [(BALL_A, RADIUS_M), (BALL_B, RADIUS_M)])
    masks = [hull.mask(camera).copy() for camera in range(3)]
    masks[0][5:9, 5:9] = 1

    with_speck = make_hull(views, masks)
    volumes, real = tell(with_speck)

    assert real == [True, True]
    assert (cover(volumes).sole[0][:3, :3] == NOWHERE).all()


def test_cells_are_not_much_larger_than_the_hull() -> None:
    center, radius_m = np.array([0.1, 0.0, 0.1]), 0.2
    hull = grown(ball_hull(ring_views(8), center, radius_m))
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.6, 0.6, (50_000, 3)) + center
    volume_m3 = 1.2**3 * contains_points(hull, points).mean()

    volumes = connected_volumes(hull, CELL_M)

    taken_m3 = np.count_nonzero(volumes.number) * CELL_M**3
    # All cells within a diagonal of a ball of this volume.
    equal_m = (0.75 / np.pi * volume_m3) ** (1 / 3)
    assert volume_m3 < taken_m3 < 4 / 3 * np.pi * (equal_m + np.sqrt(3) * CELL_M) ** 3


@st.composite
def hulls(draw: st.DrawFn) -> Hull:
    n_cameras = draw(st.integers(1, 6))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    unseen = draw(st.sampled_from(UNSEEN))
    views = random_views(rng, n_cameras, unseen, draw(st.integers(1, n_cameras)))
    return make_hull(views, random_masks(rng, views, rng.choice(MASK_KINDS, n_cameras).tolist()))


@settings(max_examples=asked(25))
@given(hull=hulls(), seed=st.integers(0, 2**32 - 1))
def test_every_point_of_a_hull_is_in_a_volume_and_what_is_connected_in_one(
    hull: Hull, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    volumes = connected_volumes(hull, 0.1)
    views = hull.views
    camera = int(rng.integers(len(views)))
    width, height = views.sizes_px[camera]
    origin, (direction,) = pixel_rays(
        views, camera, [(int(rng.integers(width)), int(rng.integers(height)))]
    )

    spans_m = spans_in_hull(hull, origin, direction, 6.0)

    for begin, end in spans_m:
        inner = rng.uniform(begin, end, 50)[:, None]
        found = volumes.at(origin + inner * direction)
        assert found[0] != NOWHERE
        assert (found == found[0]).all()


@pytest.mark.slow
@settings(max_examples=asked(40))
@given(seed=st.integers(0, 2**32 - 1), n_cameras=st.integers(2, 5), n_balls=st.integers(1, 4))
@example(seed=242, n_cameras=2, n_balls=1)
def test_what_is_called_real_holds_a_part_of_a_real_ball(
    seed: int, n_cameras: int, n_balls: int
) -> None:
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(n_cameras, 3))
    centers *= rng.uniform(2.0, 4.0, (n_cameras, 1)) / np.linalg.norm(centers, axis=1)[:, None]
    balls = [(rng.uniform(-0.4, 0.4, 3), float(rng.uniform(0.04, 0.15))) for _ in range(n_balls)]
    hull = hull_of_balls(views_from(list(centers), 320, 240, 240.0), balls)

    volumes, real = tell(hull)

    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    filling = np.concatenate([share * directions for share in (0.95, 0.5, 0.0)])
    inside = [center + radius_m * filling for center, radius_m in balls]
    held = np.unique(volumes.at(np.concatenate(inside)))
    assert NOWHERE not in held, "all cameras see all of the balls"
    assert set(np.flatnonzero(real)) <= set(held.tolist())
    # Two cameras that nearly face each other may leave crumbs of the hull far from the ball.
    assert n_balls > 1 or all(real[volume] for volume in held.tolist())
    # The quick proof claims no more, and tells a ball that stands alone.
    larger = grown(hull)
    for volume in range(len(volumes)):
        cells = np.argwhere(volumes.number == volume + 1)[::7] + volumes.first
        middles = (cells + 0.5) * volumes.cell_m + hull.views.origin_world
        if volume not in held:
            assert not any(is_real_at(hull, larger, middle) for middle in middles)
    assert n_balls > 1 or is_real_at(hull, larger, balls[0][0])


def test_the_quick_proof_is_of_what_the_point_is_connected_with() -> None:
    # Side by side for the first camera; for the second, the one hides the other.
    one, other = np.array([0.0, -0.3, 0.0]), np.array([0.0, 0.3, 0.0])
    views = views_from([np.array([3.0, 0.0, 0.0]), np.array([0.0, 3.0, 0.0])], 320, 240, 240.0)
    hull = hull_of_balls(views, [(one, 0.1), (other, 0.1)])
    larger = grown(hull)

    assert is_real_at(hull, larger, one)
    assert is_real_at(hull, larger, other)
    assert not is_real_at(hull, larger, np.zeros(3)), "between the two: background"
    alone = make_hull(views_from([np.array([3.0, 0.0, 0.0])]), [np.ones((480, 640), np.uint8)])
    assert not is_real_at(alone, alone, np.array([4.0, 0.0, 0.0])), "behind the camera"


def test_cells_have_a_size() -> None:
    with pytest.raises(ValueError, match="cell_m is 0"):
        connected_volumes(ball_hull(ring_views(), np.zeros(3), 0.1), 0.0)


@pytest.mark.slow
@pytest.mark.recording
def test_a_hand_whose_arm_one_silhouette_lacks_is_a_volume_of_its_own_and_real(
    recordings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # In frame 190 the last camera's silhouette shows the hand, but no arm.
    monkeypatch.setenv("HYBRIDVE_DATA", str(recordings.resolve()))
    session = load_session(Path(__file__).parent.parent / "data" / "child_rope" / "session.toml")
    views, lenses = rig_views(session, load_rig(session))
    (seen,) = segmented_frames(session, FrameRange(190, 191), undistortions=lenses)
    assert seen.masks is not None

    volumes, real = tell(make_hull(views, seen.masks))

    child, hand = np.array([0.36, 0.02, 0.58]), np.array([0.02, -0.07, 0.78])
    assert len(volumes) == 2
    assert {volume_at(volumes, child), volume_at(volumes, hand)} == {0, 1}
    assert real == [True, True]
