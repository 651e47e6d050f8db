"""The Pareto front: what nothing else beats."""

import numpy as np
from numpy.typing import NDArray


def pareto_front(costs: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which of N choices no other is as good as in every respect and better in one.

    Parameters
    ----------
    costs : (N, K) float64
        What each choice costs, in K respects. A choice with a NaN is on no front and beats none.

    Returns
    -------
    (N,) bool

    Examples
    --------
    Time and error of four choices; the third is slower than the second, and no better:

    >>> pareto_front(np.array([[1.0, 9.0], [2.0, 4.0], [3.0, 4.0], [5.0, 1.0]])).tolist()
    [True, True, False, True]
    """
    known = ~np.isnan(costs).any(axis=1)  # (N,)
    on_front = np.zeros(len(costs), np.bool_)
    for choice in np.flatnonzero(known):
        as_good = (costs <= costs[choice]).all(axis=1)  # never one with a NaN
        better = as_good & (costs < costs[choice]).any(axis=1)
        on_front[choice] = not better.any()
    return on_front
