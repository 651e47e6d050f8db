"""Rotations, and rigid transforms as (3, 4) float64 matrices ``[R | t]``.

``b_from_a`` maps coordinates in frame a to frame b: ``x_b = R @ x_a + t``, so that in
``a_from_b`` after ``b_from_c`` the inner names meet. Translations are metres. A rotation's vector
is its axis times its angle in radians.
"""

import numpy as np
from numpy.typing import NDArray

Pose = NDArray[np.float64]


def compose(a_from_b: Pose, b_from_c: Pose) -> Pose:
    """Return ``a_from_c``, both (3, 4)."""
    rotation = a_from_b[:, :3] @ b_from_c[:, :3]
    translation = a_from_b[:, :3] @ b_from_c[:, 3] + a_from_b[:, 3]
    return np.column_stack([rotation, translation])


def invert(b_from_a: Pose) -> Pose:
    """Return ``a_from_b`` of a rigid (3, 4) transform."""
    rotation = b_from_a[:, :3].T
    return np.column_stack([rotation, -rotation @ b_from_a[:, 3]])


def transform(b_from_a: Pose, points_a: NDArray[np.float64]) -> NDArray[np.float64]:
    """Map points (N, 3) from frame a to frame b."""
    return points_a @ b_from_a[:, :3].T + b_from_a[:, 3]


def placed(vertices_a: NDArray[np.float64], b_from_a: Pose) -> NDArray[np.float64]:
    """Return the vertices (V, 3) of a mesh in frame b, to the same bits for any number of threads.

    As `transform`, but not with ``@``, whose threads cost more than they save on meshes, and may
    round by their number.
    """
    rotation = np.ascontiguousarray(b_from_a[:, :3])
    return np.asarray(np.einsum("ij,kj->ik", vertices_a, rotation) + b_from_a[:, 3])


def cross_matrix(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrices (..., 3, 3) of the cross products with vectors (..., 3)."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    matrix = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
    return np.moveaxis(matrix, (0, 1), (-2, -1))


def rotation_of(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotations (..., 3, 3) of rotation vectors (..., 3), exact at every angle."""
    # Late, here and below: most commands turn nothing, and need not wait for SciPy.
    from scipy.spatial.transform import Rotation

    found = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return np.asarray(found, np.float64).reshape(*vectors.shape, 3)


def rotation_vector(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the vectors (..., 3) of rotations (..., 3, 3), exact at every angle.

    OpenCV's takes angles below 1e-5 for none, which is a pixel's hundredth, and loses digits near a
    half turn.
    """
    from scipy.spatial.transform import Rotation

    found = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(found, np.float64).reshape(rotations.shape[:-1])


def nearest_rotation(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotations nearest to matrices (..., 3, 3), also to such as mirror."""
    u, _, vt = np.linalg.svd(matrices)
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return np.asarray(u @ vt)


def moved_pose(poses: NDArray[np.float64], changes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return poses (..., 3, 4) moved by changes (..., 6), (omega, v), in the frame they lead to.

    To first order ``x + omega x x + v``; the rotation is exact, and freed of rounding.
    """
    turns = rotation_of(changes[..., :3])
    shifted = (turns @ poses[..., 3:]) + changes[..., 3:, None]
    return np.concatenate([nearest_rotation(turns @ poses[..., :3]), shifted], axis=-1)


def turned_pose(poses: NDArray[np.float64], changes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return poses (..., 3, 4) turned about their own origins, then shifted: (omega, v), (..., 6).

    As `moved_pose`, but a frame far from what stands in it loses nothing.
    """
    turned = nearest_rotation(rotation_of(changes[..., :3]) @ poses[..., :3])
    return np.concatenate([turned, poses[..., 3:] + changes[..., 3:, None]], axis=-1)


def rotation_about_axes(rotate_deg: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return the (3, 3) rotation about x, then y, then z of the fixed frame, in degrees."""
    rotation = np.eye(3)
    for axis, angle_deg in enumerate(rotate_deg):
        cosine, sine = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[i, i], turn[i, j], turn[j, i], turn[j, j] = cosine, -sine, sine, cosine
        rotation = turn @ rotation
    return rotation


def angle_between(first: Pose, second: Pose) -> float:
    """Return the angle in radians between the rotations of two poses."""
    relative = first[:, :3].T @ second[:, :3]
    # atan2 of both parts: arccos alone loses half the digits at small angles.
    axis = np.array(
        [
            relative[2, 1] - relative[1, 2],
            relative[0, 2] - relative[2, 0],
            relative[1, 0] - relative[0, 1],
        ]
    )
    return float(np.arctan2(np.linalg.norm(axis), np.trace(relative) - 1.0))


def nearest_to_axes(
    centers: NDArray[np.float64], axes: NDArray[np.float64], most_condition: float
) -> NDArray[np.float64] | None:
    """Return the point (3,) nearest to some lines, in least squares; None if they are parallel.

    Parameters
    ----------
    centers : (N, 3) float64
        A point of each line.
    axes : (N, 3) float64
        Their directions, unit vectors; a line is the same when its direction is reversed.
    most_condition : float
        Lines are parallel for this purpose where the equations' condition number is not below.
    """
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # (N, 3, 3)
    normal_matrix = across.sum(axis=0)
    if not np.linalg.cond(normal_matrix) < most_condition:
        return None
    return np.asarray(np.linalg.solve(normal_matrix, np.einsum("cij,cj->i", across, centers)))
