"""What effects tell that move nothing: they have no energy, and are in nobody's way."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.effects.effect import COMMON, VERTICES, Placed, Quantity


def still() -> dict[str, NDArray[np.generic]]:
    """Return the columns that every effect tells, all 0."""
    return {quantity.name: np.zeros(quantity.shape, quantity.dtype) for quantity in COMMON}


def vertices_of(one: SceneObject, placed: Mapping[str, Placed]) -> NDArray[np.float64]:
    """Return where the vertices (V, 3) of an object are, metres, world."""
    there = placed.get(one.name)
    return one.vertices_world if there is None else there.vertices_world


def vertices_columns(n_vertices: int) -> tuple[Quantity, ...]:
    """Return the column that tells where what moves is; none for nothing that does."""
    if n_vertices == 0:
        return ()
    return (
        Quantity(
            VERTICES,
            "m",
            "exact",
            "vertices of what is told of, where files and effects put it; where a file has no "
            "pose, its last",
            (n_vertices, 3),
            is_place=True,
        ),
    )
