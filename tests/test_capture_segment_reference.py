"""The compiled loops of segmentation against their specification in float64 NumPy."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.segmentation import OUTRIGHT_LEVELS, evidence_reference
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.image_io import open_source
from hybridve.hull.capture.background import Background, learn_background
from hybridve.hull.capture.segment import Segmenter, SegmentSettings

Bytes = NDArray[np.uint8]

#: Evidence is rounded to bytes, in steps of 1/20: float32 may fall on the other side.
ROUNDING_STEPS = 1

#: Share of pixels that may differ by more: a pixel whose colour is within float32 rounding of what
#: a shadow may have counts for the shade around it, or not.
FLIPPED_SHARE = 1e-3

HEIGHT, WIDTH = 60, 83  # odd, and no multiple of what one instruction takes


def assert_agrees(image: Bytes, background: Background, settings: SegmentSettings) -> None:
    segmenter = Segmenter(background, settings)

    found = segmenter._evidence(image)[1:-1, 1:-1].astype(int)  # 128 + 20 per unit

    evidence, room = evidence_reference(image, background, settings, segmenter._gain(image))
    off_steps = np.abs(found - np.floor(128.5 + 20 * evidence))
    is_lowest = found == 128 - 20 * 6
    np.testing.assert_array_equal(is_lowest[room >= OUTRIGHT_LEVELS], True)
    agrees = (off_steps <= ROUNDING_STEPS) | (is_lowest & (room >= 0))
    assert (~agrees).mean() <= FLIPPED_SHARE


def smooth(rng: np.random.Generator, sigma_px: float) -> NDArray[np.float64]:
    layer = cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), sigma_px)
    return np.asarray(layer / layer.std())


@settings(max_examples=asked(30))
@given(
    seed=st.integers(0, 2**32 - 1),
    gain=st.floats(0.9, 1.1),
    shade=st.floats(0.3, 1.2),
    threshold=st.floats(2.0, 6.0),
    shadow_threshold=st.floats(1.0, 6.0),
    noise_floor=st.floats(1.0, 6.0),
)
def test_evidence_is_that_of_the_specification(
    seed: int,
    gain: float,
    shade: float,
    threshold: float,
    shadow_threshold: float,
    noise_floor: float,
) -> None:
    rng = np.random.default_rng(seed)
    scene = 120 + 40 * np.stack([smooth(rng, 3.0) for _ in range(3)], axis=2)
    spread = rng.uniform(0.5, 6.0, scene.shape)

    def recorded(picture: NDArray[np.float64]) -> Bytes:
        return np.clip(picture + rng.normal(0, spread), 0, 255).round().astype(np.uint8)

    background = learn_background(recorded(scene) for _ in range(9))
    shown = scene.copy()
    shown[:40, :45] *= shade  # a shadow, or light, or something in between; at the border, too
    shown[20:50, 30:70] = rng.uniform(0, 255, 3)  # an object
    shown[50:, :20] = rng.uniform(0, 255, (HEIGHT - 50, 20, 3))  # no sense at all
    limits = SegmentSettings(
        threshold=threshold, shadow_threshold=shadow_threshold, noise_floor=noise_floor
    )

    assert_agrees(recorded(gain * shown), background, limits)


@pytest.mark.recording
@pytest.mark.parametrize("camera", [1, 2, 3, 4])
def test_evidence_on_a_recording_is_that_of_the_specification(
    recordings: Path, camera: int
) -> None:
    folder = recordings / "horseman" / f"cam{camera}"
    background = learn_background(open_source(folder, "background.avi").frames())

    image = open_source(folder, "video.avi").first()

    assert_agrees(image, background, SegmentSettings())
