"""The background is what the empty scene looks like most of the time, and how much that varies."""

import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest
from helpers.thorough import asked
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.hull.capture.background import SAMPLE_FRAMES, learn_background

_FEW = settings(max_examples=asked(20))

#: How far a mean of 20 or more values with noise of 3 is off at most, 1 sigma in grey levels: where
#: few values are near the middle one, the others do not count, and it is as rough as a median.
MEAN_SIGMA = 1.25 * 3 / np.sqrt(20)

#: The same of 3600 values: 6.4 sigma, and half a level because values were rounded; once in 1e6.
MEAN_TOLERANCE = 6.4 * MEAN_SIGMA + 0.5

seeds = st.integers(0, 2**32 - 1)


def noisy(rng: np.random.Generator, scene: NDArray[np.float64], sigma: float) -> NDArray[np.uint8]:
    return np.clip(np.round(scene + rng.normal(0, sigma, scene.shape)), 0, 255).astype(np.uint8)


def a_scene(rng: np.random.Generator, height: int = 9, width: int = 13) -> NDArray[np.float64]:
    return rng.uniform(20, 235, (height, width, 3))


@_FEW
@given(seed=seeds, n_frames=st.integers(1, 3 * SAMPLE_FRAMES))
def test_a_scene_that_never_changes_is_its_own_mean_without_noise(seed: int, n_frames: int) -> None:
    scene = a_scene(np.random.default_rng(seed)).astype(np.uint8)

    background = learn_background(iter([scene] * n_frames))

    np.testing.assert_array_equal(background.mean, scene.astype(np.float32))
    np.testing.assert_array_equal(background.noise, 0)
    assert background.n_frames == n_frames
    assert background.mean.dtype == background.noise.dtype == np.float32


@example(seed=671, n_frames=20)
@_FEW
@given(seed=seeds, n_frames=st.integers(20, 3 * SAMPLE_FRAMES))
def test_mean_and_noise_are_those_of_the_distribution(seed: int, n_frames: int) -> None:
    rng = np.random.default_rng(seed)
    scene = a_scene(rng, 30, 40)

    background = learn_background(noisy(rng, scene, 3.0) for _ in range(n_frames))

    errors = background.mean - scene
    assert np.abs(errors).max() < MEAN_TOLERANCE
    assert np.sqrt((errors**2).mean()) < MEAN_SIGMA  # of so many values it is known to 1.3 %
    # Leaving out what is beyond 3 sigma takes little from a normal distribution; with few frames
    # the median distance, and with it the cut, is rough.
    assert 2.5 < np.median(background.noise) < 3.2


@_FEW
@given(seed=seeds, n_frames=st.integers(10, 200), share=st.floats(0.0, 0.45))
def test_what_is_there_less_than_half_of_the_time_leaves_no_trace(
    seed: int, n_frames: int, share: float
) -> None:
    rng = np.random.default_rng(seed)
    scene = a_scene(rng)
    odd = int(share * n_frames) - 1  # the sample need not hold exactly this share
    start = int(rng.integers(0, n_frames - max(odd, 0) + 1))

    def frames() -> Iterator[NDArray[np.uint8]]:
        quiet = np.random.default_rng(1)
        for index in range(n_frames):
            frame = noisy(quiet, scene, 1.0)
            if start <= index < start + odd:
                frame[2:7, 3:9] = 255 - frame[2:7, 3:9]
            yield frame

    background = learn_background(frames())

    changed = np.abs(scene - (255 - scene)) > 20  # where the odd frames are unlike the others
    # Grey levels: 5 sigma of a mean of ten frames with noise of 1, and half a level of rounding.
    assert np.abs(background.mean - scene)[changed].max() < 5 / np.sqrt(10) + 0.5
    assert background.noise[changed].max() < 2.5


def test_all_of_a_long_recording_counts() -> None:
    before, after = np.full((4, 4, 3), 50, np.uint8), np.full((4, 4, 3), 200, np.uint8)

    background = learn_background([before] * 400 + [after] * 600)

    np.testing.assert_array_equal(background.mean, after)


def test_a_source_may_use_its_buffer_again() -> None:
    def frames() -> Iterator[NDArray[np.uint8]]:
        buffer = np.zeros((4, 4, 3), np.uint8)
        for level in (100, 102, 104):
            buffer[:] = level
            yield buffer
        buffer[:] = 0

    np.testing.assert_array_equal(learn_background(frames()).mean, 102)


def test_memory_does_not_grow_with_the_recording() -> None:
    def peak_bytes(n_frames: int) -> int:
        frames = (np.full((60, 80, 3), 128, np.uint8) for _ in range(n_frames))
        tracemalloc.start()
        learn_background(frames)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    peak_bytes(1)  # compiles

    assert peak_bytes(20 * SAMPLE_FRAMES) < 1.1 * peak_bytes(2 * SAMPLE_FRAMES)


def test_a_recording_without_frames_is_refused() -> None:
    with pytest.raises(SessionError, match="no frame"):
        learn_background(iter([]))


def test_frames_of_different_sizes_are_refused_with_both_sizes() -> None:
    frames = [np.zeros((10, 20, 3), np.uint8)] * 3 + [np.zeros((10, 24, 3), np.uint8)]

    with pytest.raises(SessionError, match="frame 3 is 24x10, those before are 20x10"):
        learn_background(frames)
