"""A calibration errs no more than theory makes it, and by as much as it says itself.

The whole of `solve_rig` on noisy corners, over seeds; `tests/benchmarks/bench_theory.py` does the
same with more cameras and many more of them.
"""

from functools import lru_cache

import numpy as np
import pytest
from helpers.theory import (
    BOARD,
    least_covariance,
    observed,
    parameter_errors,
    placed,
    squared_in_units,
    still_scene,
)
from numpy.typing import NDArray

from hybridve.calib.calibrate import solve_rig
from hybridve.calib.rig import Rig
from hybridve.calib.solving.errors_in_space import point_errors

NOISE_PX = 0.3
N_SEEDS = 14
SCENE = still_scene(n_cameras=3, n_stills=7)

#: About where all cameras look (metres).
POINTS = BOARD.center_board + np.array([[0.0, 0.0, 0.1], [0.25, 0.2, 0.3], [-0.3, 0.1, 0.5]])


@lru_cache(maxsize=1)
def calibrations() -> list[Rig]:
    return [solve_rig([BOARD], observed(SCENE, NOISE_PX, seed)).rig for seed in range(N_SEEDS)]


def matrix_of(rig: Rig) -> NDArray[np.float64]:
    assert rig.covariance is not None
    return rig.covariance.matrix


def mean_of_squares(matrices: list[NDArray[np.float64]]) -> tuple[float, float]:
    """Return the mean squared error a parameter in units of covariances, and 4 deviations of it.

    An error that is as the covariance says has the mean 1, for the sum is chi-squared.
    """
    found = [
        squared_in_units(parameter_errors(rig, SCENE.rig), matrix)
        for rig, matrix in zip(calibrations(), matrices, strict=True)
    ]
    count = sum(n for _, n in found)
    return sum(squares for squares, _ in found) / count, 4.0 * np.sqrt(2.0 / count)


@pytest.mark.slow
def test_errors_are_as_small_as_theory_allows() -> None:
    """An estimate a quarter worse than the Cramer-Rao bound would have the mean 1.56, not 1."""
    bound = least_covariance(SCENE, NOISE_PX)

    mean, four_deviations = mean_of_squares([bound] * N_SEEDS)

    assert four_deviations < 0.25
    assert mean == pytest.approx(1.0, abs=four_deviations)


@pytest.mark.slow
def test_errors_are_as_large_as_each_rig_says() -> None:
    """Deviations stated a fifth too small or too large would have the mean 1.56 or 0.69."""
    mean, four_deviations = mean_of_squares([matrix_of(rig) for rig in calibrations()])

    assert mean == pytest.approx(1.0, abs=four_deviations)


@pytest.mark.slow
def test_the_stated_covariance_is_the_bound() -> None:
    """Entry by entry, but for the noise, which each rig measures by itself."""
    bound = least_covariance(SCENE, NOISE_PX)
    deviations = np.sqrt(np.diag(bound))

    stated = np.mean([matrix_of(rig) for rig in calibrations()], axis=0)

    np.testing.assert_allclose(np.diag(stated) / np.diag(bound), 1.0, atol=0.1)
    np.testing.assert_allclose((stated - bound) / np.outer(deviations, deviations), 0.0, atol=0.1)


@pytest.mark.slow
def test_points_are_within_the_radius_stated_for_them() -> None:
    inside = np.array(
        [
            np.linalg.norm(placed(rig, SCENE.rig, POINTS) - POINTS, axis=1)
            <= point_errors(rig, POINTS).radius95_m
            for rig in calibrations()
        ]
    )
    # The points of one rig err together: 4 deviations of as many trials as rigs.
    assert inside.mean() > 0.95 - 4.0 * np.sqrt(0.95 * 0.05 / N_SEEDS)
