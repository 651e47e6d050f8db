"""The cost model of section 4.4.2 of the paper, fitted to measured times.

Given n cameras, m triangles and u x u viewports, the paper counts n m transforms, n m u^2 / 2
pixels filled, and the pixels of the window read back. Within one sweep n and m stay the same, so
that the transforms cannot be told from what a frame costs anyway: the two are one term.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from hybridve.hull.report.sweep_data import CostModel

#: The terms of the model: fixed, fill, read-back.
N_TERMS = 3


def fit_cost(
    time_s: NDArray[np.float64],
    *,
    transforms: float,
    fill_px: NDArray[np.float64],
    read_back_px: NDArray[np.float64],
    read_back: str,
    fitted: NDArray[np.bool_],
) -> CostModel | None:
    """Return the model with the smallest relative errors, no coefficient negative.

    Parameters
    ----------
    time_s : (U,) float64
        Seconds a frame, positive.
    transforms : float
        n m.
    fill_px, read_back_px : (U,) float64
        What the other terms count, a frame.
    read_back : str
        What `read_back_px` counts.
    fitted : (U,) bool
        The rows to fit; the model foretells the others.

    Returns
    -------
    CostModel or None
        None where there are fewer rows to fit than terms, or nothing was asked.

    References
    ----------
    Lok, Naik, Whitton and Brooks, *Incorporating Dynamic Real Objects into Immersive Virtual
    Environments*, 2003, section 4.4.2.
    """
    if fitted.sum() < N_TERMS or transforms <= 0:
        return None
    terms = np.column_stack([np.ones(len(time_s)), fill_px, read_back_px])  # (U, 3)
    weighted = terms[fitted] / time_s[fitted, None]
    scale = np.linalg.norm(weighted, axis=0)
    scale[scale == 0] = 1.0  # nothing was read back: the term is nought, and so its coefficient
    scaled, _ = nnls(weighted / scale, np.ones(len(weighted)))
    coefficients = scaled / scale
    predicted_s = terms @ coefficients
    residual = predicted_s / time_s - 1.0
    values = np.linalg.svd(weighted / scale, compute_uv=False)
    return CostModel(
        fixed_s=float(coefficients[0]),
        transform_most_s=float(coefficients[0] / transforms),
        fill_s_per_px=float(coefficients[1]),
        read_back_s_per_px=float(coefficients[2]),
        read_back=read_back,
        residual_rms=float(np.sqrt(np.mean(residual[fitted] ** 2))),
        residual_most=float(np.abs(residual[fitted]).max()),
        freedom=int(fitted.sum()) - N_TERMS,
        condition=float(values[0] / max(values[-1], values[0] * 1e-16)),
        fitted=fitted,
        fill_px=fill_px,
        read_back_px=read_back_px,
        predicted_s=predicted_s,
        residual=residual,
    )


def window_px_read(viewports: NDArray[np.int32], window_px: int) -> int:
    """Return how many pixels of windows the stencil engine reads back for the viewports of a mesh.

    They stand side by side in shelves as wide as the window, the largest first, and a window is
    read back as far as it is filled, so that the count does not depend on how many rounds it
    takes. A viewport larger than the window is cut into tiles, those beyond its diagonal left out.

    Parameters
    ----------
    viewports : (T,) int32
        The viewport of each triangle.
    window_px : int
        Width and height of the window.

    Examples
    --------
    Three viewports of 20 pixels a side, of which two find room in a shelf:

    >>> window_px_read(np.array([20, 20, 20], np.int32), window_px=50)
    2000
    """
    rows = room_px = 0
    for size, count in reversed(list(zip(*np.unique(viewports, return_counts=True), strict=True))):
        side, left = int(size), int(count)
        if side > window_px:
            rows += left * sum(
                -(-(side - start) // window_px) * min(window_px, side - start)
                for start in range(0, side, window_px)
            )
            continue
        left -= min(left, room_px // side)
        room_px -= (int(count) - left) * side
        if left:
            beside = window_px // side
            shelves = -(-left // beside)
            rows += shelves * side
            room_px = window_px - (left - (shelves - 1) * beside) * side
    return rows * window_px
