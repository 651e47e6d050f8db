"""The hull of one frame as compiled loops take it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Frame(NamedTuple):
    """Silhouettes and projections, cameras in the order in which they are asked.

    `hybridve.hull.query.silhouettes.Hull.frame` makes it, once for each hull.

    Attributes
    ----------
    matrices : (C, 12) float64
        Projections in pixels from metres, local frame, row-major.
    sizes : (C, 2) int64
        Width and height.
    answers, mask_offset, integrals, integral_offset
        As in `hybridve.hull.query.silhouettes.Hull`.
    recorded : (C,) int64 or None
        `hybridve.hull.query.silhouettes.Hull.recorded_offset`; None where all cameras recorded all
        of their images. That is another type, so that the loops for them are compiled without.
    order : (C,) int64
        The number of each camera in the views.
    every : (C,) int64
        All cameras by their numbers here, 0..C - 1: for what asks some of the cameras.
    keep : bool
        Whether a camera that cannot see a point abstains.
    min_cameras : int
        How many must see it then.
    """

    matrices: NDArray[np.float64]
    sizes: NDArray[np.int64]
    answers: NDArray[np.uint8]
    mask_offset: NDArray[np.int64]
    integrals: NDArray[np.int32]
    integral_offset: NDArray[np.int64]
    recorded: NDArray[np.int64] | None
    order: NDArray[np.int64]
    every: NDArray[np.int64]
    keep: bool
    min_cameras: int
