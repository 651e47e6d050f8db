"""Rotations: exact at every angle, and freed of rounding; poses moved as poses."""

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridve.calib.pose import (
    cross_matrix,
    moved_pose,
    nearest_rotation,
    rotation_of,
    rotation_vector,
    turned_pose,
)


def vectors(n: int = 20_000) -> NDArray[np.float64]:
    """Return rotation vectors (N, 3): a third next to nothing, a third nearly half turns."""
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(n, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    small = 10.0 ** rng.uniform(-17.0, -1.0, n)
    angles = np.choose(np.arange(n) % 3, [small, np.pi - small, rng.uniform(0.0, np.pi, n)])
    return np.asarray(axes * angles[:, None])


def rodrigues(vectors: NDArray[np.float64]) -> NDArray[np.longdouble]:
    """Return rotations (N, 3, 3) by Rodrigues' formula, in more digits."""
    long = vectors.astype(np.longdouble)
    angle = np.sqrt((long**2).sum(axis=1))[:, None, None]
    cross = np.array([np.cross(axis, np.eye(3)).T for axis in vectors]).astype(np.longdouble)
    half = np.sin(angle / 2.0) / angle
    result = np.eye(3) + np.sin(angle) / angle * cross + 2.0 * half**2 * (cross @ cross)
    return np.asarray(result, np.longdouble)


@pytest.mark.slow
def test_rotations_are_exact_at_every_angle_and_orthogonal_to_rounding() -> None:
    some = vectors()

    rotations = rotation_of(some)

    assert np.abs(rotations - rodrigues(some)).max() < 2e-15
    assert np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max() < 3e-15
    # The smallest turns, too, to all digits: what is antisymmetric is the vector itself.
    tiny = np.linalg.norm(some, axis=1) < 1e-9
    halves = (rotations - rotations.transpose(0, 2, 1))[tiny] / 2.0
    np.testing.assert_allclose(halves, cross_matrix(some[tiny]), rtol=1e-14, atol=0.0)


def test_a_rotations_vector_gives_the_rotation_back() -> None:
    some = vectors()
    rotations = rotation_of(some)

    found = rotation_vector(rotations)

    assert np.abs(rotation_of(found) - rotations).max() < 3e-15
    assert np.linalg.norm(found, axis=1).max() < np.pi + 1e-15
    clear = np.linalg.norm(some, axis=1) < 3.14  # beyond, an axis may point either way
    np.testing.assert_allclose(found[clear], some[clear], rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("noise", [1e-9, 1e-3, 0.3])
@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_no_rotation_is_nearer_than_the_nearest(noise: float, mirror: float) -> None:
    rng = np.random.default_rng(1)
    matrices = mirror * rotation_of(vectors(200)) + noise * rng.normal(size=(200, 3, 3))

    found = nearest_rotation(matrices)

    assert np.abs(found @ found.transpose(0, 2, 1) - np.eye(3)).max() < 4e-15
    np.testing.assert_allclose(np.linalg.det(found), 1.0, rtol=1e-14)
    apart = np.linalg.norm(found - matrices, axis=(1, 2))
    for size in (1e-4, 0.1, 3.0):
        other = rotation_of(size * rng.normal(size=(200, 3))) @ found
        assert (np.linalg.norm(other - matrices, axis=(1, 2)) > apart - 1e-12).all()


def test_a_pose_moves_in_the_frame_it_leads_to_or_turns_about_its_own_origin() -> None:
    rng = np.random.default_rng(2)
    poses = np.concatenate([rotation_of(vectors(30)), rng.normal(size=(30, 3, 1))], axis=2)
    changes = 1e-6 * rng.normal(size=(30, 6))
    omega, v = changes[:, :3], changes[:, 3:]
    points = rng.normal(size=(30, 3))

    def placed(some: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.einsum("nij,nj->ni", some[:, :, :3], points) + some[:, :, 3])

    before, origins = placed(poses), poses[:, :, 3]
    moved, turned = moved_pose(poses, changes), turned_pose(poses, changes)

    np.testing.assert_allclose(placed(moved), before + np.cross(omega, before) + v, atol=2e-11)
    expected = before + np.cross(omega, before - origins) + v
    np.testing.assert_allclose(placed(turned), expected, atol=2e-11)
    np.testing.assert_array_equal(moved_pose(poses[3], changes[3]), moved[3])


@pytest.mark.slow
def test_a_pose_that_is_moved_ten_thousand_times_is_still_a_pose() -> None:
    rng = np.random.default_rng(3)
    pose = np.eye(3, 4)
    for change in rng.normal(size=(10_000, 6)):
        pose = moved_pose(pose, change)
    assert np.abs(pose[:, :3] @ pose[:, :3].T - np.eye(3)).max() < 2e-15
