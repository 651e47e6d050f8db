"""Of rooms, turns, exposures and passers-by drawn at random: what a moved camera shows is found."""

import numpy as np
import pytest
from helpers.rooms import bent_lens, exposed, see_wall, true_shift_px, wall, with_blob
from helpers.thorough import asked
from hypothesis import event, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.hull.capture.room_shift import LIMIT_PX, MIN_FEATURES, RoomShift, room_shift

LENS = bent_lens((320, 240))
NONE = np.zeros(3)


def compare(
    seed: int, turn: NDArray[np.float64], zoom: float, noise: float, blank: float
) -> RoomShift:
    """A room before and after, of another exposure, with something textured that was carried."""
    rng = np.random.default_rng(seed)
    texture, thing = wall(seed % 4, blank), wall(9)
    width_px, height_px = LENS.width_px, LENS.height_px
    then, now = (
        with_blob(picture, thing, (int(rng.integers(width_px)), int(rng.integers(height_px))))
        for picture in (see_wall(LENS, texture, NONE), see_wall(LENS, texture, turn, zoom))
    )
    gain = rng.uniform(0.5, 1.2)
    return room_shift(
        LENS, exposed(then, rng, noise=noise), exposed(now, rng, gain=gain, noise=noise)
    )


turns = st.tuples(*[st.floats(-0.1, 0.1)] * 2, st.floats(-0.05, 0.05)).map(np.array)
small_turns = st.tuples(*[st.floats(-0.006, 0.006)] * 3).map(np.array)
noises = st.floats(0.0, 5.0)
seeds = st.integers(0, 2**31)


@pytest.mark.slow
@settings(max_examples=asked(25))
@given(seed=seeds, turn=turns | small_turns, zoom=st.floats(0.97, 1.03), noise=noises)
def test_a_turned_camera_is_found_within_its_stated_error(
    seed: int, turn: NDArray[np.float64], zoom: float, noise: float
) -> None:
    found = compare(seed, turn, zoom, noise, 0.0)

    event(found.state)
    assert found.shift_px is not None
    assert found.se_px is not None
    assert found.zoom is not None
    assert found.turn_deg is not None
    errors_px = np.array(found.shift_px) - true_shift_px(LENS, turn, zoom)
    assert (np.abs(errors_px) < 4.0 * np.array(found.se_px)).all()
    assert max(found.se_px) < 0.1
    assert found.zoom == pytest.approx(zoom, abs=1e-3)
    assert found.turn_deg == pytest.approx(np.degrees(np.linalg.norm(turn)), abs=0.05)
    true_px = float(np.linalg.norm(true_shift_px(LENS, turn, zoom)))
    if true_px > LIMIT_PX + 0.2:
        assert found.state == "moved"


@pytest.mark.slow
@settings(max_examples=asked(25))
@given(seed=seeds, noise=noises, blank=st.sampled_from([0.0, 0.0, 0.8, 0.9, 0.95, 1.0]))
def test_a_camera_that_stands_is_never_told_to_have_moved(
    seed: int, noise: float, blank: float
) -> None:
    found = compare(seed, NONE, 1.0, noise, blank)

    event(found.state)
    assert found.state in (("same",) if blank == 0.0 else ("same", "cannot tell"))


@pytest.mark.slow
@settings(max_examples=asked(25))
@given(seed=seeds, turn=turns, noise=noises, blank=st.sampled_from([0.8, 0.9, 0.95]))
def test_in_a_bare_room_what_is_said_of_a_turned_camera_is_true(
    seed: int, turn: NDArray[np.float64], noise: float, blank: float
) -> None:
    found = compare(seed, turn, 1.0, noise, blank)

    event(found.state)
    true_px = true_shift_px(LENS, turn)
    assert found.state != "same" or np.linalg.norm(true_px) < LIMIT_PX + 0.5
    if found.state == "moved":
        assert found.shift_px is not None
        assert found.se_px is not None
        assert (np.abs(found.shift_px - true_px) < 5.0 * np.array(found.se_px)).all()


@pytest.mark.slow
@settings(max_examples=asked(10))
@given(seed=seeds, turn=turns, noise=noises)
def test_a_blank_room_tells_nothing(seed: int, turn: NDArray[np.float64], noise: float) -> None:
    rng = np.random.default_rng(seed)
    blank = np.full((240, 320), 128.0, np.float32)

    found = room_shift(LENS, exposed(blank, rng, noise=noise), exposed(blank, rng, noise=noise))

    assert found.state == "cannot tell"
    assert found.n_features < MIN_FEATURES
    assert found.shift_px is None
    assert f"found again: {found.n_features}, expected {MIN_FEATURES} or more" in found.message


@pytest.mark.slow
@settings(max_examples=asked(10))
@given(first=st.integers(0, 3), more=st.integers(1, 3), noise=noises)
def test_two_different_rooms_tell_nothing(first: int, more: int, noise: float) -> None:
    rng = np.random.default_rng(first)
    then, now = (see_wall(LENS, wall(seed), NONE) for seed in (first, (first + more) % 4))

    found = room_shift(LENS, exposed(then, rng, noise=noise), exposed(now, rng, noise=noise))

    assert found.state == "cannot tell"
