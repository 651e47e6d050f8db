"""The least-squares machine against dense algebra, and against sums of squares known in full."""

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridve.calib.solving.least_squares import (
    Limits,
    NormalEquations,
    Step,
    minimized,
    soft_l1,
    soft_l1_rows,
    soft_l1_weights,
)

N_SHARED, N_BLOCKS, N_BLOCK = 5, 7, 3
CLOSE = Limits(100, 1e-15)


def some_equations(seed: int = 0) -> tuple[NormalEquations, NDArray[np.float64]]:
    """Return equations of blocks that meet only the shared unknowns, and the dense ones of them."""
    rng = np.random.default_rng(seed)
    normal = NormalEquations.zeros(N_SHARED, N_BLOCKS, N_BLOCK)
    size = N_SHARED + N_BLOCKS * N_BLOCK
    dense = np.zeros((size, size + 1))
    for block in range(N_BLOCKS):
        rows = rng.normal(size=(8, N_SHARED + N_BLOCK + 1)) * 10.0 ** rng.uniform(-2.0, 2.0, 9)
        gram = rows.T @ rows
        own = slice(N_SHARED, N_SHARED + N_BLOCK)
        normal.shared[:] += gram[:N_SHARED, :N_SHARED]
        normal.shared_right[:] += gram[:N_SHARED, -1]
        normal.blocks[block] = gram[own, own]
        normal.blocks_right[block] = gram[own, -1]
        normal.mixed[block] = gram[own, :N_SHARED]
        first = N_SHARED + N_BLOCK * block
        columns = [*range(N_SHARED), *range(first, first + N_BLOCK), size]
        dense[np.ix_(columns[:-1], columns)] += gram[:-1]
    return normal, dense


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
def test_steps_are_those_of_the_dense_equations(damping: float) -> None:
    normal, dense = some_equations()
    matrix, right = dense[:, :-1], dense[:, -1]
    expected = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), right)

    step = normal.step(damping)

    found = np.concatenate([step.shared, step.blocks.ravel()])
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9 * np.abs(expected).max())


def test_the_information_is_the_inverse_of_the_covariance_of_the_shared_unknowns() -> None:
    normal, dense = some_equations()
    covariance = np.linalg.inv(dense[:, :-1])[:N_SHARED, :N_SHARED]
    scale = np.sqrt(np.diag(covariance))

    information = normal.reduced().information

    found = np.linalg.inv(information) / np.outer(scale, scale)
    np.testing.assert_allclose(found, covariance / np.outer(scale, scale), atol=1e-8)


def test_unknowns_without_effect_stay_and_change_nothing_for_others() -> None:
    normal, _ = some_equations()
    wider = NormalEquations.zeros(N_SHARED + 1, N_BLOCKS + 1, N_BLOCK)
    wider.shared[1:, 1:], wider.shared_right[1:] = normal.shared, normal.shared_right
    wider.blocks[1:], wider.blocks_right[1:] = normal.blocks, normal.blocks_right
    wider.mixed[1:, :, 1:] = normal.mixed

    narrow, wide = normal.step(1e-6), wider.step(1e-6)

    assert wide.shared[0] == 0.0
    assert (wide.blocks[0] == 0.0).all()
    np.testing.assert_allclose(wide.shared[1:], narrow.shared, rtol=1e-9)
    np.testing.assert_allclose(wide.blocks[1:], narrow.blocks, rtol=1e-9)


def test_a_direction_that_nothing_tells_is_not_walked_along() -> None:
    row = np.array([[1.0, 1.0]])  # only the sum is told
    normal = NormalEquations.zeros(2)
    normal.shared[:], normal.shared_right[:] = row.T @ row, [3.0, 3.0]
    np.testing.assert_allclose(normal.step(0.0).shared, [1.5, 1.5], rtol=1e-12)


class Curve:
    """Rosenbrock's valley, of two unknowns and without blocks; its bottom is at (1, 1)."""

    def residuals(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y = state
        return np.array([1.0 - x, 10.0 * (y - x**2)])

    def cost(self, state: NDArray[np.float64]) -> float:
        return float((self.residuals(state) ** 2).sum())

    def normal_equations(self, state: NDArray[np.float64]) -> NormalEquations:
        jacobian = np.array([[1.0, 0.0], [20.0 * state[0], -10.0]])
        normal = NormalEquations.zeros(2)
        normal.shared[:] = jacobian.T @ jacobian
        normal.shared_right[:] = jacobian.T @ self.residuals(state)
        return normal

    def moved(self, state: NDArray[np.float64], step: Step) -> NDArray[np.float64] | None:
        return state + step.shared


def test_the_bottom_of_a_curved_valley_is_found() -> None:
    found = minimized(Curve(), np.array([-1.2, 1.0]), CLOSE)
    np.testing.assert_allclose(found.state, 1.0, atol=1e-10)
    assert found.cost < 1e-20
    assert found.n_steps < CLOSE.max_steps


def test_no_step_leads_where_there_is_nothing_nor_uphill() -> None:
    costs = []

    class Fenced(Curve):
        def cost(self, state: NDArray[np.float64]) -> float:
            return super().cost(state) if state[1] > -0.5 else np.nan

        def moved(self, state: NDArray[np.float64], step: Step) -> NDArray[np.float64] | None:
            costs.append(self.cost(state))
            moved = state + step.shared
            return moved if abs(moved[0]) < 1.3 else None

    found = minimized(Fenced(), np.array([-1.2, 1.0]), CLOSE)

    np.testing.assert_allclose(found.state, 1.0, atol=1e-10)
    assert costs == sorted(costs, reverse=True)


def test_it_ends_where_no_step_serves_and_after_so_many_steps() -> None:
    class Flat(Curve):
        def moved(self, state: NDArray[np.float64], step: Step) -> NDArray[np.float64] | None:
            return None

    start = np.array([-1.2, 1.0])
    found = minimized(Flat(), start, CLOSE)
    assert found.state is start
    assert found.n_steps < CLOSE.max_steps
    assert minimized(Curve(), start, Limits(3, 1e-15)).n_steps == 3


def test_what_a_step_may_gain_and_need_not_ends_it() -> None:
    near = np.array([1.0 + 1e-4, 1.0])
    problem = Curve()
    assert minimized(problem, near, Limits(100, 0.0, floor=1.0)).n_steps == 1
    assert minimized(problem, near, Limits(100, 0.0, floor=1e-20)).n_steps > 1


def test_soft_l1_is_the_square_near_and_the_length_far_away() -> None:
    near, far = np.array([1e-6]) ** 2, np.array([1e6]) ** 2
    np.testing.assert_allclose(soft_l1(near, 2.0), near, rtol=1e-4)
    np.testing.assert_allclose(soft_l1(far, 2.0), 2.0 * 2.0 * 1e6, rtol=1e-5)
    np.testing.assert_array_equal(soft_l1(far, np.inf), far)
    np.testing.assert_array_equal(soft_l1_weights(far, np.inf), 1.0)


@pytest.mark.parametrize("length_px", [0.01, 0.7, 1.0, 5.0, 300.0])
def test_weighted_and_corrected_rows_have_the_slope_and_the_curvature_of_soft_l1(
    length_px: float,
) -> None:
    loss_px = 0.8
    residual = length_px * np.array([np.cos(0.4), np.sin(0.4)])
    jacobian = np.eye(2)  # by the observation itself
    step = 1e-4 * max(1.0, length_px)

    def cost(x: float, y: float) -> float:
        return float(soft_l1(((residual - [x, y]) ** 2).sum(keepdims=True), loss_px)[0])

    slope = np.array([cost(step, 0) - cost(-step, 0), cost(0, step) - cost(0, -step)]) / (2 * step)
    second = [
        (cost(step, 0) - 2 * cost(0, 0) + cost(-step, 0)) / step**2,
        (cost(0, step) - 2 * cost(0, 0) + cost(0, -step)) / step**2,
    ]
    weight = soft_l1_weights((residual**2).sum(keepdims=True), loss_px)[0]
    rows, corrected = soft_l1_rows(jacobian, residual, loss_px)

    np.testing.assert_allclose(-2.0 * (weight * jacobian).T @ (weight * residual), slope, rtol=1e-5)
    np.testing.assert_allclose(-2.0 * rows.T @ corrected, slope, rtol=1e-5)
    atol = 1e-3 * max(second)
    np.testing.assert_allclose(2.0 * np.diag(rows.T @ rows), second, rtol=1e-3, atol=atol)
