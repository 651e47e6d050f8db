"""What can be recognised in a picture: places, what they look like, which look alike.

This work is based on: Lowe, *Distinctive image features from scale-invariant keypoints*, IJCV
60(2), 2004; Arandjelovic and Zisserman, *Three things everyone should know to improve object
retrieval*, CVPR 2012 (RootSIFT).
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_MIN_CONTRAST = 0.02


def find_features(
    grey: NDArray[np.uint8], max_features: int, mask: NDArray[np.uint8] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return places (K, 2), pixel centre at 0.5, and RootSIFT descriptors (K, 128).

    Parameters
    ----------
    grey : (H, W) uint8
        The picture.
    max_features : int
        Features kept, the strongest first.
    mask : (H, W) uint8, optional
        Features are looked for where it is not 0.
    """
    sift: Any = cv2.SIFT.create(max_features, contrastThreshold=_MIN_CONTRAST)
    points, descriptors = sift.detectAndCompute(grey, mask)
    if not points:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    total = np.maximum(np.abs(descriptors).sum(axis=1, keepdims=True), 1e-9)
    places = np.array([point.pt for point in points], np.float64) + 0.5
    return places, np.sqrt(descriptors / total).astype(np.float32)


def mutual_matches(
    first: NDArray[np.float32], second: NDArray[np.float32], ratio: float = 1.0
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of descriptors (K, 128) and (L, 128) that are each other's nearest.

    With a `ratio` below 1, only those whose distance is less than so many times the distance to
    the second nearest: what occurs once in the second picture.
    """
    if not len(first) or not len(second):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    likeness = first @ second.T
    forward, backward = likeness.argmax(axis=1), likeness.argmax(axis=0)
    mutual = np.flatnonzero(backward[forward] == np.arange(len(first)))
    if ratio < 1.0 and len(second) > 1:
        # RootSIFT descriptors have length 1: a squared distance is 2 less twice the likeness.
        best, next_best = -np.sort(-np.partition(likeness[mutual], -2, axis=1)[:, -2:], axis=1).T
        mutual = mutual[1.0 - best < ratio**2 * (1.0 - next_best)]
    return mutual, forward[mutual]
