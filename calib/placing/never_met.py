"""Two cameras and two boards of one body where each camera only sees a board of its own.

This work is based on: Shah, *Solving the robot-world/hand-eye calibration problem using the
Kronecker product*, J. Mechanisms Robotics 5(3), 2013.
"""

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.placing.looks import DISAGREE
from hybridve.calib.pose import Pose, compose, nearest_rotation
from hybridve.calib.solving.consensus import pose_distances

#: Moments from which the poses of cameras and boards that never meet are found, at least; how far
#: their rotations must be from turning about one axis only (share of the largest singular value).
_MIN_JOINT_MOMENTS = 4
_JOINT_GAP = 1e-3


def solve_joint(
    first_from_near: NDArray[np.float64], second_from_far: NDArray[np.float64], length_m: float
) -> tuple[Pose, Pose] | None:
    """Find two cameras and two boards of one body where each camera only sees a board of its own.

    ``second_from_far @ far_from_near = second_from_first @ first_from_near`` at every moment:
    rotations by the Kronecker product, translations by least squares. Moments that disagree with
    the solution of all are left out, and it is found again.

    Parameters
    ----------
    first_from_near, second_from_far : (M, 3, 4) float64
        Where each camera saw its board.
    length_m : float
        The length that counts as much as a radian where moments are compared.

    Returns
    -------
    second_from_first, far_from_near : (3, 4) float64
        None where there are too few moments, where they turn the body about one axis only, or
        where they do not agree.
    """
    kept = np.ones(len(first_from_near), np.bool_)
    found = None
    for _ in range(5):
        if kept.sum() < _MIN_JOINT_MOMENTS:
            return None
        found = _solve_joint_of_all(first_from_near[kept], second_from_far[kept])
        if found is None:
            return None
        second_from_first, far_from_near = found
        misses = np.array(
            [
                pose_distances(
                    compose(second_from_first, near)[None],
                    compose(far, far_from_near)[None],
                    length_m,
                )[0, 0]
                for near, far in zip(first_from_near, second_from_far, strict=True)
            ]
        )
        median = float(np.median(misses))
        again = misses <= max(0.02, 3.0 * median)
        if (again == kept).all():
            break
        kept = again
    return found if median <= DISAGREE / 2.0 else None


def _solve_joint_of_all(
    first_from_near: NDArray[np.float64], second_from_far: NDArray[np.float64]
) -> tuple[Pose, Pose] | None:
    # R2 W = Z R1, so vec(W) = (R1^T kron R2^T) vec(Z): with K the sum of R2 kron R1 over the
    # moments, Z and W are its first singular vectors (row-major vec).
    total = np.zeros((9, 9))
    for near, far in zip(first_from_near, second_from_far, strict=True):
        total += np.kron(far[:, :3], near[:, :3])
    u, singular, vt = np.linalg.svd(total)
    if singular[0] - singular[1] < _JOINT_GAP * singular[0]:
        return None
    z, w = u[:, 0].reshape(3, 3), vt[0].reshape(3, 3)
    sign = np.sign(np.linalg.det(z))
    rotation_z, rotation_w = nearest_rotation(sign * z), nearest_rotation(sign * w)
    # t2 + R2 t_w = Z t1 + t_z
    n = len(first_from_near)
    matrix, right = np.zeros((3 * n, 6)), np.zeros(3 * n)
    for row, (near, far) in enumerate(zip(first_from_near, second_from_far, strict=True)):
        here = slice(3 * row, 3 * row + 3)
        matrix[here, :3], matrix[here, 3:] = np.eye(3), -far[:, :3]
        right[here] = far[:, 3] - rotation_z @ near[:, 3]
    solution, _, _, values = np.linalg.lstsq(matrix, right, rcond=None)
    if values[-1] < np.sqrt(_JOINT_GAP) * values[0]:
        return None
    return (
        np.column_stack([rotation_z, solution[:3]]),
        np.column_stack([rotation_w, solution[3:]]),
    )
