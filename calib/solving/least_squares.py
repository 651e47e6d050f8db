"""Least squares by Levenberg and Marquardt's method, with blocks of unknowns eliminated.

Unknowns are of two kinds: the shared ones, some dozens (lenses, cameras), and blocks of a few each,
of which there may be hundreds (the poses of boards), that meet the shared ones but not each other.
The blocks are eliminated (Schur complement), so that a step solves for the shared ones alone; what
is left of the normal matrix is the information about them, from which their covariance follows.
Problems without blocks are the dense case of the same.

A `Problem` says how its unknowns are held, moved and linearized; that may be any value, so that
rotations are moved as rotations.

This work is based on: Marquardt, *An algorithm for least-squares estimation of nonlinear
parameters*, SIAM J. Appl. Math. 11(2), 1963; Nocedal and Wright, *Numerical optimization*, 2nd ed.,
2006, chapter 10; Triggs, McLauchlan, Hartley and Fitzgibbon, *Bundle adjustment: a modern
synthesis*, 2000, sections 4.3 (robust loss) and 6.1 (Schur complement).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

State = TypeVar("State")

#: Marquardt's damping: each diagonal is raised by this share; less after a step that serves, more
#: after one that does not.
_FIRST_DAMPING = 1e-4
_LEAST_DAMPING = 1e-13
_MOST_DAMPING = 1e12
_DAMPING_FACTOR = 10.0

#: A direction that is told by less than this share of what is told best is not known.
_ROUNDING = 1e-13

#: The length of a residual that nobody asks for, pixels.
FLOOR_PX = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """By how much the unknowns move.

    Attributes
    ----------
    shared : (A,) float64
        Those that all blocks share.
    blocks : (F, K) float64
        Those of each block.
    """

    shared: NDArray[np.float64]
    blocks: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Reduced:
    """Normal equations without the blocks, and what gives the blocks back.

    Attributes
    ----------
    information : (A, A) float64
        About the shared unknowns, wherever the blocks are.
    right : (A,) float64
        The right side that belongs to it.
    back : (F, K, A) float64
        By how much the blocks yield to the shared unknowns, ...
    alone : (F, K) float64
        ... and where they would go without: their step is ``alone - back @ step.shared``.
    """

    information: NDArray[np.float64]
    right: NDArray[np.float64]
    back: NDArray[np.float64]
    alone: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """Products of the derivatives of what is fitted with each other, and with the residuals.

    Residuals are observed minus fitted, so that the right sides lead downhill. An unknown whose
    diagonal is zero has no effect, and stays.

    Attributes
    ----------
    shared : (A, A) float64
        Of the shared unknowns.
    shared_right : (A,) float64
        With the residuals.
    blocks : (F, K, K) float64
        Of each block's unknowns.
    blocks_right : (F, K) float64
        With the residuals.
    mixed : (F, K, A) float64
        Of each block's unknowns with the shared ones.
    """

    shared: NDArray[np.float64]
    shared_right: NDArray[np.float64]
    blocks: NDArray[np.float64]
    blocks_right: NDArray[np.float64]
    mixed: NDArray[np.float64]

    @classmethod
    def zeros(cls, n_shared: int, n_blocks: int = 0, n_block: int = 0) -> Self:
        """Return equations to be filled: A shared unknowns, F blocks of K."""
        return cls(
            np.zeros((n_shared, n_shared)),
            np.zeros(n_shared),
            np.zeros((n_blocks, n_block, n_block)),
            np.zeros((n_blocks, n_block)),
            np.zeros((n_blocks, n_block, n_shared)),
        )

    def reduced(self, damping: float = 0.0) -> Reduced:
        """Return the equations without the blocks, each diagonal raised by a share."""
        diagonal = np.einsum("fkk->fk", self.blocks)
        raised = np.where(diagonal > 0.0, damping * diagonal, 1.0)
        blocks = self.blocks + raised[:, :, None] * np.eye(self.blocks.shape[1])
        sides = np.concatenate([self.mixed, self.blocks_right[:, :, None]], axis=2)
        solved = np.linalg.solve(blocks, sides)
        back, alone = solved[:, :, :-1], solved[:, :, -1]
        n_shared = len(self.shared)
        mixed = self.mixed.reshape(alone.size, n_shared)
        information = self.shared - mixed.T @ back.reshape(alone.size, n_shared)
        information = (information + information.T) / 2.0
        information[np.diag_indices(n_shared)] += damping * np.diag(self.shared)
        return Reduced(information, self.shared_right - mixed.T @ alone.ravel(), back, alone)

    def step(self, damping: float, rounding: float = _ROUNDING) -> Step:
        """Return the damped step downhill, along what the data tell.

        What rounding leaves of a direction that they do not tell, an eigenvalue below a share of
        the largest, is not walked along.
        """
        reduced = self.reduced(damping)
        diagonal = np.diag(self.shared)
        scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
        scaled = reduced.information / np.outer(scale, scale)
        scaled[np.diag_indices(len(scaled))] += diagonal <= 0.0
        values, vectors = np.linalg.eigh(scaled)
        known = values > rounding * values.max(initial=0.0)
        vectors = vectors[:, known] / scale[:, None]
        shared = vectors @ ((vectors.T @ reduced.right) / values[known])
        return Step(shared, reduced.alone - reduced.back @ shared)

    def length_of(self, step: Step) -> float:
        """Return the largest effect of an entry of a step on the root of the sum of squares."""
        of_shared = np.abs(step.shared) * np.sqrt(np.diag(self.shared))
        of_blocks = np.abs(step.blocks) * np.sqrt(np.einsum("fkk->fk", self.blocks))
        return float(max(of_shared.max(initial=0.0), of_blocks.max(initial=0.0)))


class Problem(Protocol[State]):
    """What is to be adjusted."""

    def cost(self, state: State) -> float:
        """Return the (robust) sum of squares; NaN or infinite where nothing can be fitted."""

    def normal_equations(self, state: State) -> NormalEquations:
        """Return the problem as it looks from nearby."""

    def moved(self, state: State, step: Step) -> State | None:
        """Return the state after a step; None if that leads where there is none."""


@dataclass(frozen=True, slots=True)
class Limits:
    """How far least squares go.

    Attributes
    ----------
    max_steps : int
        After so many steps, tried ones among them, what stands is taken.
    share : float
        A step that gains no more than this share of the cost is the last, ...
    floor : float
        ... and than this.
    rounding : float
        Directions that are told by less than this share of what is told best are not walked along.
    """

    max_steps: int
    share: float
    floor: float = 0.0
    rounding: float = _ROUNDING


@dataclass(frozen=True, slots=True, eq=False)
class Minimum(Generic[State]):
    """Where the sum of squares is least.

    Attributes
    ----------
    state : State
        What was adjusted.
    cost : float
        Its (robust) sum of squares.
    n_steps : int
        Steps that were tried.
    """

    state: State
    cost: float
    n_steps: int


def minimized(
    problem: Problem[State],
    start: State,
    limits: Limits,
    seen_from: Callable[[State], Problem[State]] | None = None,
) -> Minimum[State]:
    """Return the minimum that lies downhill of a start.

    The cost never rises; of a step that would raise it a shorter one is tried, unless the step was
    so short that rounding alone decides.

    Parameters
    ----------
    problem : Problem
        What is adjusted.
    start : State
        Where from.
    limits : Limits
        How far.
    seen_from : callable, optional
        Returns the problem as it looks from where a step led, if its loss follows the residuals.
    """
    state, cost, damping = start, problem.cost(start), _FIRST_DAMPING
    normal: NormalEquations | None = None
    n_steps = 0
    while n_steps < limits.max_steps and damping < _MOST_DAMPING:
        n_steps += 1
        if normal is None:
            normal = problem.normal_equations(state)
        step = normal.step(damping, limits.rounding)
        enough = limits.share * cost + limits.floor
        is_last = normal.length_of(step) ** 2 <= enough
        moved = problem.moved(state, step)
        moved_cost = np.inf if moved is None else problem.cost(moved)
        if moved is not None and moved_cost <= cost:  # False for NaN
            is_last |= cost - moved_cost <= enough
            state, cost, normal = moved, moved_cost, None
            if seen_from is not None:
                problem = seen_from(state)
                cost = problem.cost(state)
            damping = max(damping / _DAMPING_FACTOR, _LEAST_DAMPING)
        else:
            damping *= _DAMPING_FACTOR
        if is_last:
            break
    return Minimum(state, cost, n_steps)


# --- Soft L1 ----------------------------------------------------------------------------------


def soft_l1(squares: NDArray[np.float64], loss_px: float) -> NDArray[np.float64]:
    """Return what residuals of squared lengths (...) cost, pixels squared.

    Those much longer than `loss_px` count by their length alone; if it is infinite, all by their
    square.
    """
    if not np.isfinite(loss_px):
        return squares
    return 2.0 * loss_px**2 * (np.sqrt(1.0 + squares / loss_px**2) - 1.0)


def soft_l1_weights(squares: NDArray[np.float64], loss_px: float) -> NDArray[np.float64]:
    """Return by what to multiply residuals and their derivatives, so that squares serve for them.

    The gradient is the loss's own, the curvature that of the squares reweighted; never less than
    the truth.
    """
    if not np.isfinite(loss_px):
        return np.ones_like(squares)
    return np.asarray((1.0 + squares / loss_px**2) ** -0.25)


def soft_l1_rows(
    jacobian: NDArray[np.float64], residuals: NDArray[np.float64], loss_px: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return derivatives (..., 2, n) and residuals (..., 2) whose squares are the loss's own.

    To second order: also the curvature is the loss's, which a residual has less of along itself
    (Triggs et al., section 4.3). With s the squared length by `loss_px`, rows are scaled by
    (1 + s)^(-1/4), along the residual by another (1 + s)^(-1/2).
    """
    if not np.isfinite(loss_px):
        return jacobian, residuals
    column = residuals[..., None]
    squares = (residuals**2).sum(axis=-1)[..., None, None]
    stretch = np.sqrt(1.0 + squares / loss_px**2)
    along = column @ (np.swapaxes(column, -1, -2) @ jacobian) / np.maximum(squares, 1e-300)
    rows = (jacobian - (1.0 - 1.0 / stretch) * along) / np.sqrt(stretch)
    return rows, (column * np.sqrt(stretch))[..., 0]
