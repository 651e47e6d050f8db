"""One pose that many measurements share, found although some of them are wrong.

Two poses differ by the angle between their rotations plus the distance between their translations,
the latter in lengths that the caller names (the distance of what was measured): an error in angle
and the shift that it causes count alike.

This work is based on: Rousseeuw, *Least median of squares regression*, J. Am. Stat. Assoc. 79,
1984; Hartley, Trumpf, Dai and Li, *Rotation averaging*, IJCV 103(3), 2013 (chordal mean).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import Pose, nearest_rotation

#: Measurements from which the common pose is taken, at most; all of them vote on it.
_MAX_PROPOSERS = 60

#: A measurement agrees when it differs by less than this, or by less than so many medians.
_AGREES = 0.02
_AGREES_MEDIANS = 3.0

#: Poses further apart than this (radians) are different answers, not one with errors.
_OTHER_RAD = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class CommonPose:
    """The pose that most measurements share.

    Attributes
    ----------
    pose : (3, 4) float64
        The mean of those that agree.
    error : float
        By how much measurements differ from it, median: radians plus lengths.
    rival_error : float
        The same for the best pose that is turned against it by more than half a radian; inf where
        no measurement proposes one.
    agrees : (M,) bool
        Which measurements share it.
    chosen : (M,) int
        Which of a measurement's candidates lies nearest to it.
    """

    pose: Pose
    error: float
    rival_error: float
    agrees: NDArray[np.bool_]
    chosen: NDArray[np.intp]


def pose_distances(
    first: NDArray[np.float64], second: NDArray[np.float64], length_m: float
) -> NDArray[np.float64]:
    """Return how much poses (M, 3, 4) differ from poses (K, 3, 4): (M, K)."""
    turned = first[:, None, :, :3] - second[None, :, :, :3]
    chords = np.sqrt((turned**2).sum(axis=(2, 3)))
    # The chord, not the trace: arccos loses half the digits of small angles.
    angles = 2.0 * np.arcsin(np.minimum(chords / np.sqrt(8.0), 1.0))
    shifts = np.linalg.norm(first[:, None, :, 3] - second[None, :, :, 3], axis=2)
    return np.asarray(angles + shifts / length_m)


def mean_pose(poses: NDArray[np.float64], weights: NDArray[np.float64]) -> Pose:
    """Return the weighted mean of poses (M, 3, 4) that lie close together, weights (M,)."""
    share = weights / weights.sum()
    mean = np.tensordot(share, poses, axes=1)
    return np.column_stack([nearest_rotation(mean[:, :3]), mean[:, 3]])


def common_pose(
    measured: Sequence[NDArray[np.float64]], weights: NDArray[np.float64], length_m: float
) -> CommonPose:
    """Find the pose that most measurements share.

    Parameters
    ----------
    measured : sequence of (K, 3, 4) float64
        One measurement each: the poses that it could mean (a board that looks the same when turned
        leaves several). At least one.
    weights : (M,) float64
        What each counts in the mean, positive.
    length_m : float
        The length that counts as much as a radian, metres.
    """
    counts = np.array([len(candidates) for candidates in measured])
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    everything = np.concatenate(list(measured))
    n_proposers = min(len(measured), _MAX_PROPOSERS)
    proposers = np.linspace(0, len(measured) - 1, n_proposers).round().astype(int)
    proposed = np.concatenate([measured[index] for index in proposers])
    apart = pose_distances(proposed, everything, length_m)
    nearest = np.minimum.reduceat(apart, starts, axis=1)  # (P, M)
    medians = np.median(nearest, axis=1)
    best = int(np.argmin(medians))
    error = float(medians[best])
    agrees = nearest[best] <= max(_AGREES, _AGREES_MEDIANS * error)
    chosen = np.array(
        [
            int(np.argmin(apart[best, start : start + count]))
            for start, count in zip(starts, counts, strict=True)
        ],
        np.intp,
    )
    pose = mean_pose(everything[starts + chosen][agrees], weights[agrees])
    turned = pose_distances(proposed, proposed[best][None], np.inf)[:, 0] > _OTHER_RAD
    rival_error = float(medians[turned].min()) if turned.any() else np.inf
    return CommonPose(pose, error, rival_error, np.asarray(agrees), chosen)
