"""The empty scene of one camera: what each pixel looks like, and how much it varies by itself."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.calib.image_io import Image
from hybridve.hull.jit import compiled

#: At most this many frames, evenly spread over the recording, are held at a time and looked at.
SAMPLE_FRAMES = 64

#: Values within this many robust standard deviations of the median count as the empty scene.
_ODD_BEYOND = 3.0

#: Least robust standard deviation, grey levels: values are whole numbers.
_LEAST_SPREAD = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """Mean and noise of every pixel of the empty scene.

    Attributes
    ----------
    mean : (H, W, 3) float32
        Grey levels, BGR.
    noise : (H, W, 3) float32
        Standard deviation over time, grey levels.
    n_frames : int
        How many frames were read.
    """

    mean: NDArray[np.float32]
    noise: NDArray[np.float32]
    n_frames: int


def learn_background(frames: Iterable[Image]) -> Background:
    """Return mean and noise of the empty scene, from frames read once.

    Of all frames an evenly spread sample is kept, so that memory does not grow with their number.
    Per pixel and channel, values far from the median do not count: something that passes through
    the scene, or a broken frame, leaves no trace as long as it is there less than half of the time.

    Parameters
    ----------
    frames : iterable of (H, W, 3) uint8
        Pictures of the empty scene, BGR.

    Raises
    ------
    SessionError
        If there is no frame, or one has another size than those before.
    """
    sample: list[Image] = []
    stride = 1
    count = 0
    for frame in frames:
        if sample and frame.shape != sample[0].shape:
            raise SessionError(
                f"background: frame {count} is {frame.shape[1]}x{frame.shape[0]}, those before are "
                f"{sample[0].shape[1]}x{sample[0].shape[0]}"
            )
        if count % stride == 0:
            if len(sample) == SAMPLE_FRAMES:
                sample = sample[::2]
                stride *= 2
            if count % stride == 0:
                sample.append(frame.copy())  # a source may use its buffer again
        count += 1
    if not sample:
        raise SessionError("background: the recording of the empty scene has no frame")
    shape = sample[0].shape
    mean = np.zeros(shape, np.float32)
    noise = np.zeros(shape, np.float32)
    for row in range(shape[0]):
        _summarise(np.stack([frame[row].ravel() for frame in sample]), mean[row], noise[row])
    return Background(mean, noise, count)


@compiled
def _summarise(
    values: NDArray[np.uint8], mean: NDArray[np.float32], noise: NDArray[np.float32]
) -> None:
    """Write mean and standard deviation of (N, 3 W) `values` without the odd ones to (W, 3)."""
    n_frames = values.shape[0]
    counts = np.zeros(256, np.int64)
    for place in range(values.shape[1]):
        for level in range(256):  # a loop: compiling a slice takes long
            counts[level] = 0
        for frame in range(n_frames):
            counts[values[frame, place]] += 1
        median = 0
        below = counts[0]
        while 2 * below < n_frames:
            median += 1
            below += counts[median]
        # The median of the distances: widen a band about the median until it holds half of them.
        distance = 0
        within = counts[median]
        while 2 * within < n_frames:
            distance += 1
            if median - distance >= 0:
                within += counts[median - distance]
            if median + distance <= 255:
                within += counts[median + distance]
        spread = max(1.4826 * distance, _LEAST_SPREAD)  # 1.4826: exact for normal noise
        reach = int(_ODD_BEYOND * spread)
        number = 0
        total = 0
        squares = 0
        for level in range(max(median - reach, 0), min(median + reach, 255) + 1):
            number += counts[level]
            total += counts[level] * level
            squares += counts[level] * level * level
        center = total / number
        mean[place // 3, place % 3] = center
        noise[place // 3, place % 3] = np.sqrt(max(squares / number - center * center, 0.0))
