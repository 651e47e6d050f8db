"""The empty scene of one camera: what each pixel looks like, and how much it varies by itself."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.calib.image_io import Image


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
        How many frames it was learnt from.
    """

    mean: NDArray[np.float32]
    noise: NDArray[np.float32]
    n_frames: int


def learn_background(frames: Iterable[Image]) -> Background:
    """Return mean and noise of the empty scene, from frames read once.

    Integer sums are exact, so that neither the order of the frames nor their number matters to the
    result; memory does not grow with them.

    Parameters
    ----------
    frames : iterable of (H, W, 3) uint8
        Pictures of the empty scene, BGR.

    Raises
    ------
    SessionError
        If there is no frame, or one has another size than those before.
    """
    total: NDArray[np.uint64] | None = None
    squares: NDArray[np.uint64] | None = None
    count = 0
    for frame in frames:
        wide = frame.astype(np.uint64)
        if total is None or squares is None:
            total, squares = wide, wide * wide
        elif wide.shape != total.shape:
            raise SessionError(
                f"background: frame {count} is {wide.shape[1]}x{wide.shape[0]}, those before are "
                f"{total.shape[1]}x{total.shape[0]}"
            )
        else:
            total += wide
            squares += wide * wide
        count += 1
    if total is None or squares is None:
        raise SessionError("background: the recording of the empty scene has no frame")
    mean = total / count
    variance = (squares * np.uint64(count) - total * total) / count**2
    return Background(mean.astype(np.float32), np.sqrt(variance).astype(np.float32), count)
