"""What effects tell that move nothing: they have no energy, and are in nobody's way."""

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.effects.effect import COMMON


def still() -> dict[str, NDArray[np.generic]]:
    """Return the columns that every effect tells, all 0."""
    return {quantity.name: np.zeros(quantity.shape, quantity.dtype) for quantity in COMMON}
