"""What the outlines of a whole session say: clocks, bumps, pictures exchanged or turned."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.agreement import Masks, balls, shifted
from helpers.hulls import look_at, projection
from helpers.thorough import THOROUGH, asked, some_of
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import t as student

from hybridve.hull.agreement.causes import FrameVerdicts, diagnose
from hybridve.hull.agreement.offsets import offset_of, step_of, student_95
from hybridve.hull.agreement.outlines import (
    CUT,
    FIRST,
    FrameOutlines,
    Outline,
    inner_of,
    outline_of,
    table_of,
)
from hybridve.hull.agreement.record import SessionAgreement
from hybridve.hull.agreement.session import judge_session
from hybridve.hull.agreement.tangents import limits_of, make_pencils
from hybridve.hull.agreement.trials import Trial
from hybridve.hull.query.silhouettes import Views, make_views

N_FRAMES = 30
SIZE_PX = (320, 240)


@cache
def ring_views(n_cameras: int = 4) -> Views:
    """Return cameras about the origin, of heights of their own."""
    width, height = SIZE_PX
    matrices = []
    for camera in range(n_cameras):
        angle = 2.0 * np.pi * camera / n_cameras + 0.2 * camera
        center = np.array([2.5 * np.cos(angle), 2.5 * np.sin(angle), 0.6 + 0.5 * (camera % 3)])
        matrices.append(projection(look_at(center, np.zeros(3), 0.0), 320.0, width, height))
    names = tuple(f"cam{camera}" for camera in range(n_cameras))
    return make_views(names, np.array([SIZE_PX] * n_cameras), np.array(matrices))


def masks_at(views: Views, moment: float) -> Masks:
    """Return the silhouettes of two balls, one of which goes about the other, which sways."""
    angle = 0.15 * moment
    round_ = np.array([0.45 * np.cos(angle), 0.35 * np.sin(angle), 0.25 * np.sin(0.7 * angle)])
    sways = np.array([0.1 * np.sin(2.0 * angle), 0.0, -0.1 + 0.05 * np.cos(angle)])
    return balls(views, (round_, 0.12), (sways, 0.2))


@cache
def session_of(n_cameras: int = 4, late: tuple[float, ...] = ()) -> tuple[Masks, ...]:
    """Return the silhouettes of all frames; some cameras show what was so many frames before."""
    views = ring_views(n_cameras)
    delays = [*late, *[0.0] * (n_cameras - len(late))]
    frames = []
    for frame in range(N_FRAMES):
        at = {delay: masks_at(views, frame - delay) for delay in set(delays)}
        frames.append([at[delay][camera] for camera, delay in enumerate(delays)])
    return tuple(frames)


def trial_of(views: Views, frames: Sequence[Masks]) -> Trial:
    return Trial.of(views, table_of([[outline_of(mask) for mask in masks] for masks in frames]))


def spoilt(frames: Sequence[Masks], camera: int, change: object) -> list[Masks]:
    """Return frames with a camera's silhouette changed by a function of silhouette and frame."""
    return [
        [
            np.ascontiguousarray(change(mask, frame)) if number == camera else mask  # type: ignore[operator]
            for number, mask in enumerate(masks)
        ]
        for frame, masks in enumerate(frames)
    ]


def kinds(frames: Sequence[Masks], n_cameras: int = 4) -> list[tuple[str, tuple[str, ...]]]:
    found = diagnose(trial_of(ring_views(n_cameras), frames))
    return [(cause.kind, cause.cameras) for cause in found.causes]


@pytest.mark.slow
def test_silhouettes_that_agree_are_not_accused() -> None:
    for n_cameras in (2, 3, 4, 6):
        found = diagnose(trial_of(ring_views(n_cameras), session_of(n_cameras)))
        assert found.causes == (), n_cameras
        assert found.is_told
        assert (found.misfit_px < 1.0).all()
        for offset in found.offsets:
            assert offset.has_clock
            assert abs(offset.late) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("camera", some_of(range(4)))
@pytest.mark.parametrize(
    ("kind", "axes"), [("mirrored", (1,)), ("upside down", (0,)), ("turned", (0, 1))]
)
def test_a_picture_that_is_turned_is_named(camera: int, kind: str, axes: tuple[int, ...]) -> None:
    frames = spoilt(session_of(), camera, lambda mask, _: np.flip(mask, axes))

    assert kinds(frames) == [(kind, (f"cam{camera}",))]


def test_pictures_of_another_size_are_named() -> None:
    views = ring_views()
    sizes_px = views.sizes_px.copy()
    sizes_px[2] //= 2
    frames = spoilt(session_of(), 2, lambda mask, _: mask[::2, ::2])

    (cause,) = diagnose(trial_of(replace(views, sizes_px=sizes_px), frames)).causes
    assert (cause.kind, cause.cameras) == ("scaled", ("cam2",))


@pytest.mark.parametrize(("first", "second"), [(0, 1), (0, 2), (1, 3)])
def test_pictures_that_are_exchanged_are_named(first: int, second: int) -> None:
    order = list(range(4))
    order[first], order[second] = second, first
    frames = [[masks[camera] for camera in order] for masks in session_of()]

    assert kinds(frames) == [("exchanged", (f"cam{first}", f"cam{second}"))]


@pytest.mark.parametrize("cameras", [(0,), (3,), (0, 1, 2, 3)])
def test_masks_that_are_inverted_are_named(cameras: tuple[int, ...]) -> None:
    frames = [
        [1 - mask if camera in cameras else mask for camera, mask in enumerate(masks)]
        for masks in session_of()
    ]

    assert kinds(frames) == [("inverted", (f"cam{camera}",)) for camera in cameras]


@pytest.mark.slow
@settings(max_examples=6 if THOROUGH else 3)
@given(st.integers(0, 3), st.floats(-8.0, 8.0).filter(lambda late: abs(late) > 0.5))
def test_a_late_clock_is_named_to_a_tenth_of_a_frame(camera: int, late: float) -> None:
    delays = tuple(late if number == camera else 0.0 for number in range(4))
    found = diagnose(trial_of(ring_views(), session_of(4, delays)))

    (cause,) = found.causes
    assert (cause.kind, cause.cameras) == ("late", (f"cam{camera}",))
    assert cause.size == pytest.approx(late, abs=0.1)
    assert cause.low - 0.1 < late < cause.high + 0.1
    assert cause.is_gross == (abs(cause.size) >= 1.5)


@settings(max_examples=asked(15))
@given(st.integers(0, 3), st.integers(-12, 12), st.integers(-12, 12))
def test_a_bump_is_named_to_half_a_pixel(camera: int, right_px: int, down_px: int) -> None:
    size_px = float(np.hypot(right_px, down_px))
    frames = spoilt(session_of(), camera, lambda mask, _: shifted(mask, right_px, down_px))
    found = diagnose(trial_of(ring_views(), frames))

    np.testing.assert_allclose(found.offsets[camera].moved_px, (right_px, down_px), atol=0.5)
    if size_px > 2.5:
        (cause,) = found.causes
        assert (cause.kind, cause.cameras, cause.first) == ("bumped", (f"cam{camera}",), 0)
        np.testing.assert_allclose(cause.moved_px, (right_px, down_px), atol=0.5)
        assert cause.is_gross == (cause.size >= 4.5)
    elif size_px < 1.0:
        assert found.causes == ()


@pytest.mark.parametrize("since", [8, 15, 22])
def test_a_bump_within_the_session_is_named_since_its_frame(since: int) -> None:
    def bumped(mask: NDArray[np.uint8], frame: int) -> NDArray[np.uint8]:
        return shifted(mask, 6, -3) if frame >= since else mask

    (cause,) = diagnose(trial_of(ring_views(), spoilt(session_of(), 2, bumped))).causes

    assert (cause.kind, cause.cameras) == ("bumped", ("cam2",))
    assert abs(cause.first - since) <= 1
    np.testing.assert_allclose(cause.moved_px, (6, -3), atol=0.7)


def test_single_frames_that_fit_none_are_named() -> None:
    def wrong(mask: NDArray[np.uint8], frame: int) -> NDArray[np.uint8]:
        return shifted(mask, 30, 25) if 11 <= frame <= 12 else mask

    (cause,) = diagnose(trial_of(ring_views(), spoilt(session_of(), 1, wrong))).causes

    assert (cause.kind, cause.cameras, cause.first, cause.last) == ("frames", ("cam1",), 11, 12)
    assert not cause.is_gross


def test_where_nobody_moves_no_clock_is_told() -> None:
    still = [masks_at(ring_views(), 3.0)] * N_FRAMES
    found = diagnose(trial_of(ring_views(), still))

    assert found.causes == ()
    assert not any(offset.has_clock for offset in found.offsets)


@pytest.mark.slow
def test_of_two_cameras_a_delay_is_the_other_way_round_as_well() -> None:
    (cause,) = diagnose(trial_of(ring_views(2), session_of(2, (3.0,)))).causes

    assert cause.kind == "late"
    other = {"cam0": "cam1", "cam1": "cam0"}[cause.cameras[0]]
    assert cause.instead == (other,)
    assert abs(cause.size) == pytest.approx(3.0, abs=0.1)


@settings(max_examples=asked(20))
@given(st.integers(0, 2**32 - 1))
def test_outlines_of_two_cameras_end_at_the_same_planes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    views = ring_views(2)
    things = [(rng.uniform(-0.35, 0.35, 3), rng.uniform(0.05, 0.2)) for _ in range(3)]
    table = table_of([[outline_of(mask) for mask in balls(views, *things)]])
    pencils = make_pencils(views, np.array([[0, 1]]))
    limits = limits_of(pencils, table)

    # A ball's planes are those about its centre's, by an angle whose sine is r over its distance
    # from the line of centres.
    centers = views.centers_local()
    line = centers[1] - centers[0]
    line /= np.linalg.norm(line)
    rays = np.linalg.inv(views.img_from_local[0, :, :3])
    planes = pencils.axes[0] @ np.linalg.inv(rays)
    spans = []
    for center, radius_m in things:
        across = center - views.origin_world - centers[0]
        across = across - (across @ line) * line
        about = np.arctan2(*(planes @ across)[::-1])
        reach = np.arcsin(radius_m / np.linalg.norm(across))
        spans.append((about - reach, about + reach))
    starts = sorted(low for low, _ in spans)
    found = limits.angle[0, 0, 0]
    size = np.linalg.norm(limits.gradient[0, 0, 0], axis=-1)
    for angle, per_px in zip(found, size, strict=True):
        if np.isfinite(angle):  # every limit is where some ball begins, to a pixel
            assert min(abs(angle - start) for start in starts) < 1.5 * per_px
    lowest = np.nanmin(found)
    assert abs(lowest - starts[0]) < 1.5 * size[np.nanargmin(found)]


@settings(max_examples=asked(25))
@given(st.integers(-5, 5), st.floats(0.0, 1.0))
def test_what_is_later_is_later(rows: int, share: float) -> None:
    trial = trial_of(ring_views(), session_of())
    change = trial.change(1)
    moved = change.later(float(rows)).limits.angle
    inside = slice(max(-rows, 0), N_FRAMES - max(rows, 0))
    there = slice(max(rows, 0), N_FRAMES - max(-rows, 0))

    np.testing.assert_array_equal(moved[:, inside], change.limits.angle[:, there])
    outside = np.ones(N_FRAMES, np.bool_)
    outside[inside] = False
    assert np.isnan(moved[:, outside]).all()
    # Between two rows, a limit that both have is between the two.
    between = change.later(share).limits.angle[:, :-1, :, 0]
    ends = change.limits.angle[:, :-1, :, 0], change.limits.angle[:, 1:, :, 0]
    is_told = np.isfinite(between) & (np.abs(ends[0] - ends[1]) < 0.05)
    assert (between >= np.minimum(*ends) - 1e-12)[is_told].all()
    assert (between <= np.maximum(*ends) + 1e-12)[is_told].all()


def test_a_change_that_is_adopted_says_the_same() -> None:
    trial = trial_of(ring_views(), session_of())
    change = trial.change(2, np.array([5.0, -2.0]), 1.5)

    adopted = change.adopted()
    np.testing.assert_allclose(adopted.misfit([2]).px, change.misfit().px, rtol=1e-12)
    back = adopted.change(2, np.array([-5.0, 2.0]), -1.5)
    assert back.misfit().px < trial.misfit([2]).px + 0.2


@pytest.mark.parametrize("freedom", [1, 2, 3, 7, 12, 13, 20, 50, 1000])
def test_students_quantiles_are_students(freedom: int) -> None:
    assert student_95(freedom) == pytest.approx(student.ppf(0.975, freedom), rel=5e-3)


def test_steps_and_offsets_need_frames() -> None:
    trial = trial_of(ring_views(), session_of()[:3])

    assert step_of(trial, 0, 5) is None
    assert not np.isfinite(offset_of(trial_of(ring_views(), session_of()[:1]), 0).late_se)


@settings(max_examples=asked(40))
@given(st.integers(0, 2**32 - 1))
def test_an_outline_is_the_convex_hull_of_each_piece(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mask = np.zeros((60, 80), np.uint8)
    for _ in range(rng.integers(1, 4)):
        x, y = rng.integers(0, 60), rng.integers(0, 40)
        mask[y : y + rng.integers(6, 20), x : x + rng.integers(6, 20)] = 1
    outline = outline_of(mask)

    rows, columns = np.nonzero(mask)
    assert outline.corners_px[:, 0].min() == columns.min() + 0.5
    assert outline.corners_px[:, 0].max() == columns.max() + 0.5
    assert outline.corners_px[:, 1].min() == rows.min() + 0.5
    assert outline.corners_px[:, 1].max() == rows.max() + 0.5
    column, row = (outline.corners_px - 0.5).astype(int).T
    assert mask[row, column].all()
    near = (column < 2) | (row < 2) | (column >= 78) | (row >= 58)
    assert ((outline.marks & CUT != 0) == near).all()
    assert outline.marks[0] & FIRST


def test_outlines_know_where_what_was_recorded_ends() -> None:
    seen = np.ones((40, 50), np.bool_)
    seen[:, :10] = False
    mask = np.zeros((40, 50), np.uint8)
    mask[15:25, 10:30] = 1  # it begins where the recording does
    outline = outline_of(mask, inner_of(seen))

    is_left = outline.corners_px[:, 0] < 12.0
    assert ((outline.marks & CUT != 0) == is_left).all()
    assert inner_of(None) is None
    inverse = outline_of((1 - mask) * seen.astype(np.uint8), inner_of(seen))
    assert inverse.is_inverse


def judged(frames: Sequence[Masks], first: int = 0, step: int = 1) -> SessionAgreement:
    views = ring_views()
    nothing, nobody = np.full(4, np.nan), np.zeros(4, np.bool_)
    kept = [
        FrameOutlines(
            first + step * row,
            tuple(outline_of(mask) for mask in masks),
            nobody,
            nothing,
            np.full((4, 4), np.nan),
            np.array([mask.mean() for mask in masks]),
        )
        for row, masks in enumerate(frames)
    ]
    return judge_session(views, kept, offset_s={"cam1": 0.5}, fps=25.0)


@pytest.mark.slow
def test_a_session_says_what_to_do() -> None:
    agreement = judged(session_of(4, (0.0, 5.0)), first=100)

    (cause,) = agreement.causes
    assert (cause.first_frame, cause.last_frame) == (100, 99 + N_FRAMES)
    assert not agreement.is_trusted
    assert agreement.distrust == "the session is not to be trusted: cam1 late"
    # Five frames are 0.2 s: its pictures are to be shown so much sooner.
    assert "give it offset_s = 0.3" in cause.message
    index = np.arange(100, 100 + N_FRAMES)
    assert agreement.wrong(index) == [""] * N_FRAMES
    assert (agreement.excess_px(ring_views().names, index)[:, 1] > 5.0).all()


def test_a_bump_that_is_small_is_trusted_and_reckoned_with() -> None:
    frames = spoilt(session_of(), 3, lambda mask, _: shifted(mask, 3, 0))
    agreement = judged(frames)

    (cause,) = agreement.causes
    assert cause.kind == "bumped"
    assert agreement.is_trusted
    assert agreement.distrust == ""
    excess_px = agreement.excess_px(ring_views().names, np.arange(N_FRAMES))
    assert (excess_px[:, 3] > 2.0).all()
    assert (excess_px[:, 3] < 4.0).all()
    assert (excess_px[:, :3] < 0.5).all()


@settings(max_examples=asked(20))
@given(st.integers(0, 3), st.integers(0, 15), st.integers(0, 8))
def test_what_one_camera_sees_all_the_time_was_left_behind(
    camera: int, n_without: int, wander_px: int
) -> None:
    rng = np.random.default_rng(n_without)
    alone_px = np.full((N_FRAMES, 4, 4), np.nan)
    alone_px[:, camera] = (
        np.array([10, 20, 60, 80]) + rng.integers(-2, 3, (N_FRAMES, 1)) * wander_px
    )
    alone_px[:n_without, camera] = np.nan
    said = FrameVerdicts(
        np.zeros((N_FRAMES, 4), np.bool_),
        np.ones((N_FRAMES, 4)),
        alone_px,
        np.zeros(N_FRAMES, np.bool_),
    )
    causes = diagnose(trial_of(ring_views(), session_of()), said).causes

    told = [(cause.kind, cause.cameras, cause.is_gross) for cause in causes]
    expected = [("left behind", (f"cam{camera}",), False)] if n_without <= 3 else []
    assert told == expected


def test_cameras_at_one_place_tell_nothing_of_each_other() -> None:
    views = ring_views(2)
    matrices = views.img_from_local[[0, 0]]
    twins = replace(views, img_from_local=matrices)
    frames = [[masks[0], masks[0]] for masks in session_of(2)]
    found = diagnose(trial_of(twins, frames))

    assert found.causes == ()
    assert not found.is_told


def test_frames_that_lie_apart_tell_no_clock() -> None:
    agreement = judged(session_of(4, (0.0, 5.0)), step=10)

    assert all(cause.kind != "late" for cause in agreement.causes)


def test_a_session_without_outlines_says_nothing() -> None:
    assert judge_session(ring_views(), [], offset_s={}, fps=25.0) == SessionAgreement()
    unread = [FrameOutlines.unread(row, 4) for row in range(5)]
    assert judge_session(ring_views(), unread, offset_s={}, fps=25.0) == SessionAgreement()
    assert not judged([[np.zeros((240, 320), np.uint8)] * 4] * 5).is_told
    assert len(Outline.empty().marks) == 0
