"""What the silhouettes of one frame say together, in cases whose truth is known."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.agreement import Masks, balls, random_views, shifted
from helpers.hulls import ball_masks, look_at, projection, ring_views
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.formats.rigs import import_rig
from hybridve.hull.agreement.frame import (
    DEFAULT_ERROR_PX,
    deniers,
    disputes,
    judge_frame,
    object_pixels,
    stated_error_px,
)
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, Views, make_hull, make_views

HERE = (np.array([0.1, -0.05, 0.0]), 0.25)
THERE = (np.array([-0.45, 0.45, 0.3]), 0.2)


def ring(n_cameras: int = 4, unseen: str = "carve", min_cameras: int = 1) -> Views:
    return ring_views(n_cameras, 360, 243, 350.0, unseen=unseen, min_cameras=min_cameras)  # type: ignore[arg-type]


def nothing(views: Views, camera: int) -> NDArray[np.uint8]:
    width, height = views.sizes_px[camera]
    return np.zeros((height, width), np.uint8)


def test_a_ball_that_all_see_is_agreed_on() -> None:
    views = ring()
    hull = make_hull(views, balls(views, HERE))

    told = judge_frame(hull)

    assert (told.kind, told.silent, told.reason, told.is_empty) == ("agreed", (), "", False)
    assert told.is_sound
    assert contains_points(hull, told.point_world[None]).all()
    assert disputes(hull) == ()


@pytest.mark.parametrize("unseen", ["carve", "keep"])
def test_an_empty_room_is_empty(unseen: str) -> None:
    views = ring(4, unseen, 2)
    told = judge_frame(make_hull(views, [nothing(views, camera) for camera in range(4)]))

    assert (told.kind, told.is_empty, told.is_sound) == ("nobody", True, True)
    assert told.silent == views.names


@pytest.mark.parametrize("unseen", ["carve", "keep"])
def test_a_camera_that_saw_nothing_is_named(unseen: str) -> None:
    views = ring(4, unseen, 2)
    masks = balls(views, HERE)
    masks[2] = nothing(views, 2)

    told = judge_frame(make_hull(views, masks))

    assert (told.kind, told.silent, told.is_outside) == ("silent", ("cam2",), False)
    assert told.is_empty
    assert not told.is_sound
    assert told.reason == (
        "cam2 saw nothing, while others did: no place that they could mean is outside of its image"
    )


def cropped(views: Views, masks: Masks, windows: dict[int, tuple[int, int]]) -> Hull:
    """Return the hull when of some cameras' images only columns first..last - 1 were recorded."""
    sizes, matrices, left = views.sizes_px.copy(), views.img_from_local.copy(), list(masks)
    for camera, (first, last) in windows.items():
        sizes[camera, 0] = last - first
        matrices[camera, 0] -= first * matrices[camera, 2]
        left[camera] = masks[camera][:, first:last]
    origin = np.zeros(3)
    cut = make_views(
        views.names, sizes, matrices, views.unseen, views.min_cameras, origin_world=origin
    )
    np.testing.assert_allclose(views.origin_world, origin, atol=1e-9)
    return make_hull(cut, left)


def columns(mask: NDArray[np.uint8]) -> tuple[int, int]:
    """Return the first object column of a silhouette, and the one after the last."""
    found = np.flatnonzero(mask.any(axis=0))
    return int(found[0]), int(found[-1]) + 1


def test_a_thing_that_may_be_outside_of_the_silent_cameras_image_is_told() -> None:
    views = ring()
    masks = balls(views, HERE)
    first, last = columns(masks[3])

    told = judge_frame(cropped(views, masks, {3: (last + 10, 360)}))

    assert (told.kind, told.silent, told.is_outside) == ("silent", ("cam3",), True)
    assert "may be outside of its image" in told.reason
    half = judge_frame(cropped(views, masks, {3: ((first + last) // 2, 360)}))
    assert half.kind == "agreed"


def test_two_silent_cameras_are_named_together() -> None:
    views = ring()
    masks = balls(views, HERE)
    masks[0], masks[3] = nothing(views, 0), nothing(views, 3)

    told = judge_frame(make_hull(views, masks))

    assert (told.kind, told.silent) == ("silent", ("cam0", "cam3"))
    assert told.reason.startswith("cam0, cam3 saw nothing")


@pytest.mark.parametrize("n_cameras", [3, 4, 6])
def test_one_camera_that_sees_another_thing_contradicts_all(n_cameras: int) -> None:
    views = ring(n_cameras)
    masks = balls(views, HERE)
    masks[1] = shifted(masks[1], 0, -85)
    hull = make_hull(views, masks)

    told = judge_frame(hull)

    assert told.kind == "contradiction"
    assert told.is_empty
    assert "cam1" in told.suspects[0].cameras
    assert told.suspects[0].explained > 0.9
    assert "contradict each other" in told.reason
    if n_cameras > 3:
        assert [suspect.cameras for suspect in told.suspects] == [("cam1",)]
        found = {dispute.camera: dispute for dispute in disputes(hull, 2)}
        for name in set(views.names) - {"cam1"}:
            assert found[name].denied_by == ("cam1",)
            assert found[name].share == 1.0
        assert found["cam1"].denied_by == ()


def test_two_exchanged_cameras_are_a_pair_of_suspects() -> None:
    views = ring(6)
    # High above, so that neighbours see it at other heights.
    masks = balls(views, (np.array([0.35, 0.0, 0.3]), 0.08), (np.array([0.45, 0.0, 0.35]), 0.05))
    masks[0], masks[2] = masks[2], masks[0]

    told = judge_frame(make_hull(views, masks))

    assert told.kind == "contradiction"
    assert told.suspects[0].cameras == ("cam0", "cam2")


def test_without_a_pair_that_explains_it_all_are_suspect() -> None:
    views = ring(6)
    masks = balls(views, HERE)
    masks = [shifted(mask, 0, 85 * (camera % 3 - 1)) for camera, mask in enumerate(masks)]

    told = judge_frame(make_hull(views, masks))

    assert (told.kind, told.suspects) == ("contradiction", ())
    assert "no two cameras alone explain it" in told.reason


def horizon_strips(above_px: int, below_px: int) -> Hull:
    """Two cameras level with each other: one sees only above the horizon, the other only below."""
    width, height = 200, 100
    matrices = [
        projection(look_at(np.array(center), np.zeros(3)), 150.0, width, height)
        for center in ([2.0, 0.0, 0.0], [0.0, 2.0, 0.0])
    ]
    views = make_views(("a", "b"), np.array([[width, height]] * 2), np.array(matrices))
    upper, lower = np.zeros((height, width), np.uint8), np.zeros((height, width), np.uint8)
    # Clear of the borders, however much they are grown here.
    upper[15 : height // 2 - above_px, 15:-15] = 1
    lower[height // 2 + below_px : -15, 15:-15] = 1
    return make_hull(views, [upper, lower])


@pytest.mark.parametrize("error_px", range(12))
def test_errors_and_contradictions_are_told_apart_to_the_pixel(error_px: int) -> None:
    # Rows above the horizon are points above both cameras; the other camera sees none of these.
    told = judge_frame(horizon_strips(4, 7), error_px)

    if error_px <= 4:
        assert told.kind == "contradiction"
    if error_px > 7:
        assert told.kind == "within error"
        assert "unless they are off by up to" in told.reason
    assert told.is_empty


def test_of_two_cameras_each_is_suspect() -> None:
    told = judge_frame(horizon_strips(4, 7), 2)

    assert {suspect.cameras for suspect in told.suspects} == {("a",), ("b",)}


def test_each_camera_has_its_own_error() -> None:
    assert judge_frame(horizon_strips(4, 7), np.array([5, 8])).kind == "within error"
    assert judge_frame(horizon_strips(4, 7), np.array([4, 6])).kind == "contradiction"


def test_what_one_camera_does_not_see_is_elsewhere() -> None:
    """Two things, of which each is beside another camera's image."""
    views = ring()
    here, there = balls(views, HERE), balls(views, THERE)
    masks = balls(views, HERE, THERE)
    windows = {}
    for camera, (shown, hidden) in {0: (here, there), 2: (there, here)}.items():
        (first, last), (begin, end) = columns(shown[camera]), columns(hidden[camera])
        assert last < begin - 10 or end < first - 10
        windows[camera] = (0, last + 5) if last < begin else (first - 5, 360)

    told = judge_frame(cropped(views, masks, windows), 1)

    assert (told.kind, told.is_empty, told.is_sound) == ("elsewhere", True, False)
    assert "may be outside of each other's images" in told.reason


def test_a_thing_that_one_of_four_lacks_is_denied_by_it() -> None:
    views = ring()
    masks = balls(views, HERE, THERE)
    masks[3] = ball_masks(views, *HERE)[3]
    hull = make_hull(views, masks)

    assert judge_frame(hull).kind == "agreed"
    found = disputes(hull, 2)

    assert {dispute.camera for dispute in found} == {"cam0", "cam1", "cam2"}
    for dispute in found:
        assert dispute.denied_by == ("cam3",)
        camera = views.names.index(dispute.camera)
        there = np.argwhere(ball_masks(views, *THERE)[camera])
        left, top, right, bottom = dispute.box_px
        assert (left, top) >= tuple(there[:, ::-1].min(axis=0))
        assert (right, bottom) <= tuple(there[:, ::-1].max(axis=0) + 1)
        assert 0 < dispute.area_px <= (right - left) * (bottom - top)


def test_a_blot_that_one_camera_alone_sees_is_denied_by_no_camera_alone() -> None:
    views = ring(5)
    masks = balls(views, HERE)
    masks[2][5:60, 5:60] = 1

    (found,) = disputes(make_hull(views, masks), 2)

    assert (found.camera, found.denied_by) == ("cam2", ())
    assert found.box_px[0] >= 5
    assert found.box_px[2] <= 60


def test_nothing_is_disputed_where_one_camera_does_not_see() -> None:
    """A thing half out of a camera's image is not denied by that camera."""
    views = ring()
    masks = balls(views, HERE)
    middle = sum(columns(masks[1])) // 2

    assert disputes(cropped(views, masks, {1: (0, middle)}), 1) == ()


@given(seed=st.integers(0, 2**32 - 1), n_cameras=st.integers(2, 6), error_px=st.integers(1, 5))
@settings(max_examples=asked(100))
def test_outlines_within_their_errors_never_contradict(
    seed: int, n_cameras: int, error_px: int
) -> None:
    rng = np.random.default_rng(seed)
    views = random_views(rng, n_cameras)
    thing = rng.uniform(-0.15, 0.15, 3), float(rng.uniform(0.05, 0.25))
    masks = balls(views, thing)
    for camera, mask in enumerate(masks):
        by_px = int(rng.integers(-error_px, error_px + 1))
        if rng.random() < 0.5:
            masks[camera] = shifted(mask, by_px, int(rng.integers(-error_px, error_px + 1)))
        else:
            kernel = np.ones((2 * abs(by_px) + 1,) * 2, np.uint8)
            changed = (cv2.dilate if by_px > 0 else cv2.erode)(mask, kernel)
            masks[camera] = np.asarray(changed, np.uint8)
    hull = make_hull(views, masks)

    # A pixel more: silhouettes are of pixels' centres.
    told = judge_frame(hull, error_px + 1)

    if all(mask.any() for mask in masks):
        # What images cut off may leave each camera another part of the ball.
        is_cut = any(mask[[0, -1]].any() or mask[:, [0, -1]].any() for mask in masks)
        assert told.kind in {"agreed", "within error"} or (is_cut and told.kind == "elsewhere")
        assert is_cut or disputes(hull, error_px + 1) == ()
    else:
        assert told.kind in {"silent", "nobody"}
    if told.kind == "agreed":
        assert contains_points(hull, told.point_world[None]).all()


@given(seed=st.integers(0, 2**32 - 1), n_cameras=st.integers(1, 6), keep=st.booleans())
@settings(max_examples=asked(60))
def test_whatever_is_told_holds(seed: int, n_cameras: int, keep: bool) -> None:
    rng = np.random.default_rng(seed)
    unseen, min_cameras = ("keep", int(rng.integers(1, n_cameras + 1))) if keep else ("carve", 1)
    views = random_views(rng, n_cameras, unseen, min_cameras, 0.5)  # type: ignore[arg-type]
    masks: Masks = [
        shifted(mask, *rng.integers(-50, 50, 2).tolist()) if rng.random() < 0.4 else mask
        for mask in balls(views, (rng.uniform(-0.4, 0.4, 3), float(rng.uniform(0.05, 0.2))))
    ]
    hull = make_hull(views, masks)

    told = judge_frame(hull, 3)

    points = rng.uniform(-1.0, 1.0, (10_000, 3))
    if told.is_empty:
        assert not contains_points(hull, points).any()
    assert told.is_empty == (told.kind not in {"agreed", "open"})
    assert set(told.silent) == {
        name for name, mask in zip(views.names, masks, strict=True) if not mask.any()
    }
    kernel = np.ones((7, 7), np.uint8)
    grown = [np.asarray(cv2.dilate(mask, kernel), np.uint8) for mask in masks]
    if told.kind == "contradiction":
        assert not contains_points(make_hull(views, grown), points).any()


def test_object_pixels_are_evenly_chosen() -> None:
    mask = np.zeros((20, 30), np.uint8)
    mask[3:7, 5:9] = 1
    mask[15, :] = 1
    width, height = 30, 20
    matrix = projection(look_at(np.array([2.0, 0, 0]), np.zeros(3)), 30.0, width, height)
    hull = make_hull(make_views(("a",), np.array([[width, height]]), matrix[None]), [mask])

    every = object_pixels(hull, 0, 1000)
    np.testing.assert_array_equal(every[:, ::-1] - 0.5, np.argwhere(mask))
    some = object_pixels(hull, 0, 7)
    assert len(some) == 7
    assert mask[tuple(np.floor(some[:, ::-1]).astype(int).T)].all()
    assert len(object_pixels(make_hull(hull.views, [0 * mask]), 0, 5)) == 0


def test_stated_errors_are_three_deviations_in_whole_pixels() -> None:
    np.testing.assert_array_equal(stated_error_px(np.array([1.0, 1.6, np.nan])), [3, 5, 5])
    shift_px = np.array([0.5, 1.0])
    np.testing.assert_array_equal(stated_error_px(np.array([1.0, 1.5]), shift_px), [4, 6])
    # What hybridve.hull.contact.uncertainty assumes of outlines and rigs that tell nothing.
    assumed_px = np.sqrt(1.5**2 + 0.5**2 + 1.0 / 12.0)
    assert stated_error_px(np.array([assumed_px])) == [DEFAULT_ERROR_PX]


def test_a_negative_error_is_a_mistake() -> None:
    views = ring()
    with pytest.raises(ValueError, match="expected no negative number"):
        judge_frame(make_hull(views, balls(views, HERE)), -1)


# --- a real recording -------------------------------------------------------------------------


def child_rope(folder: Path, frame: int) -> tuple[Views, Masks]:
    """Return the cameras and silhouettes of a frame."""
    names = [f"cam{number:02d}" for number in range(10)]
    sizes = dict.fromkeys(names, (1624, 1224))
    rig = import_rig(folder, "{camera}/cam_par.txt", "m", 0.5, sizes, None)
    matrices = [camera.pinhole @ camera.cam_from_world for camera in rig.cameras]
    masks = []
    for name in names:
        mask = cv2.imread(str(folder / name / f"{frame}.png"), cv2.IMREAD_GRAYSCALE)
        assert mask is not None
        masks.append(np.asarray(mask, np.uint8))
    size_px = np.array([sizes[name] for name in names])
    return make_views(tuple(names), size_px, np.array(matrices)), masks


@pytest.mark.recording
@pytest.mark.parametrize("frame", [0, 100])
def test_a_real_person_is_agreed_on_and_exchanged_cameras_are_named(
    recordings: Path, frame: int
) -> None:
    views, masks = child_rope(recordings / "child_rope", frame)
    hull = make_hull(views, masks)

    assert judge_frame(hull).kind == "agreed"
    assert deniers(disputes(hull)) == ()

    # cam04 a third of its image off: it agrees with nobody.
    masks[4] = shifted(masks[4], 500, 0)
    moved = make_hull(views, masks)
    told = judge_frame(moved)
    assert told.kind == "contradiction"
    assert [suspect.cameras for suspect in told.suspects] == [("cam04",)]
    denied = [dispute for dispute in disputes(moved) if dispute.camera != "cam04"]
    assert len(denied) == 9
    assert all(dispute.denied_by == ("cam04",) for dispute in denied)


@pytest.mark.recording
def test_a_published_silhouette_that_is_wrong_is_named(recordings: Path) -> None:
    """In frame 47 the last camera's silhouette is a shape 400 px beside the child."""
    views, masks = child_rope(recordings / "child_rope", 47)
    hull = make_hull(views, masks)

    told = judge_frame(hull)

    assert told.kind == "contradiction"
    assert [suspect.cameras for suspect in told.suspects] == [("cam09",)]
    assert deniers(disputes(hull)) == ("cam09",)


@pytest.mark.recording
def test_a_published_silhouette_that_lacks_an_arm_is_named(recordings: Path) -> None:
    """In frame 48 the last camera's silhouette has a hand, and no arm that leads to it."""
    views, masks = child_rope(recordings / "child_rope", 48)
    hull = make_hull(views, masks)

    assert judge_frame(hull).kind == "agreed"
    found = disputes(hull)
    assert deniers(found) == ("cam09",)
    assert {dispute.camera for dispute in found} == {"cam03", "cam04"}
