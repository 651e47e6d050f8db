"""How a room stands in two pictures of one camera: what is told, and what cannot be."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers.rooms import bent_lens, exposed, see_wall, true_shift_px, wall
from numpy.typing import NDArray

from hybridve.calib.pose import compose, rotation_of
from hybridve.hull.capture.room_shift import RoomShift, room_shift
from hybridve.hull.synth import render
from hybridve.hull.synth.presets import PRESETS

LENS = bent_lens((320, 240))
NONE = np.zeros(3)


def compare(then: NDArray[np.float32], now: NDArray[np.float32]) -> RoomShift:
    rng = np.random.default_rng(0)
    return room_shift(LENS, exposed(then, rng), exposed(now, rng, gain=0.8))


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "OPENCV_FISHEYE"])
def test_a_turn_is_found_through_any_lens(model: str) -> None:
    lens = bent_lens((320, 240), model)
    turn, rng = np.array([0.02, -0.03, 0.01]), np.random.default_rng(1)

    found = room_shift(
        lens,
        exposed(see_wall(lens, wall(0), NONE), rng),
        exposed(see_wall(lens, wall(0), turn), rng),
    )

    assert found.state == "moved"
    assert found.shift_px is not None
    np.testing.assert_allclose(found.shift_px, true_shift_px(lens, turn), atol=0.1)


def test_a_camera_turned_about_its_axis_has_moved_though_its_middle_stands() -> None:
    # Three degrees about the ray of the picture's middle.
    ray = np.array([-4.0 / 256, 3.0 / 253, 1.0])
    turn = np.radians(3.0) * ray / np.linalg.norm(ray)

    found = compare(see_wall(LENS, wall(0), NONE), see_wall(LENS, wall(0), turn))

    assert found.state == "moved"
    assert found.shift_px is not None
    assert found.largest_px is not None
    assert np.linalg.norm(found.shift_px) < 0.1
    # The outermost of the nine places are 107 and 80 px from the middle.
    assert found.largest_px == pytest.approx(np.radians(3.0) * np.hypot(107, 80), rel=0.02)


def test_a_lens_that_was_turned_has_moved() -> None:
    found = compare(see_wall(LENS, wall(0), NONE), see_wall(LENS, wall(0), NONE, zoom=1.02))

    assert found.state == "moved"
    assert found.zoom == pytest.approx(1.02, abs=5e-4)


@pytest.mark.parametrize(
    ("width_px", "message"), [(150, "stand where they stood, but"), (110, "are shifted by")]
)
def test_what_is_laid_over_much_of_the_picture_leaves_it_open(width_px: int, message: str) -> None:
    turn = np.array([0.02, -0.03, 0.0])
    then, now = see_wall(LENS, wall(0), NONE), see_wall(LENS, wall(0), turn)
    now[:, :width_px] = then[:, :width_px]

    found = compare(then, now)

    assert found.state == "cannot tell"
    assert message in found.message


@pytest.mark.slow
def test_one_thing_that_was_carried_is_not_taken_for_the_room() -> None:
    then, now = (np.full((240, 320), 128.0, np.float32) for _ in range(2))
    then[40:160, 40:160] = wall(1)[:120, :120]
    now[60:180, 70:190] = wall(1)[:120, :120]

    found = compare(then, now)

    assert found.state == "cannot tell"
    assert "may be of one thing that was carried" in found.message
    assert "features are shifted by" in found.message


@pytest.mark.slow
def test_what_is_masked_is_not_asked() -> None:
    then = exposed(see_wall(LENS, wall(0), NONE), np.random.default_rng(0))
    nothing = np.zeros(then.shape, np.uint8)

    assert room_shift(LENS, then, then, nothing).n_found == 0
    assert room_shift(LENS, then, then, None, nothing).n_found == 0
    assert room_shift(LENS, then, then).state == "same"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("aside_mm", "turn_deg", "has_moved"), [(0, 0.0, False), (20, 0.0, True), (50, 2.0, True)]
)
def test_a_camera_pushed_aside_in_a_room_with_depth_has_moved(
    aside_mm: float, turn_deg: float, has_moved: bool
) -> None:
    preset = PRESETS["boxes"]
    stage = preset.make_stage(**{option.name: option.default for option in preset.options})
    texture = render.make_texture(np.random.default_rng(1))
    camera = stage.cameras[0]
    bump = np.column_stack(
        [
            rotation_of(np.radians(turn_deg) * np.array([0.6, -0.7, 0.39])),
            aside_mm / 1000.0 * np.array([0.9, 0.4, -0.17]),
        ]
    )
    pushed = replace(camera, cam_from_world=compose(bump, camera.cam_from_world))
    pictures = []
    for one, seed in ((camera, 0), (pushed, 1)):
        empty = render.render_room(render.make_view(one), stage.room, stage.lamp, texture)
        image = render.expose(empty, 1.0, np.random.default_rng(seed))
        pictures.append(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8))

    found = room_shift(camera, *pictures)

    assert found.state == ("moved" if has_moved else "same")
