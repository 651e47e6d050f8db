"""What is drawn beside the hull: CAD objects and what of them collides, points and paths."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class DrawnObject:
    """A CAD object as it stands in one frame.

    Attributes
    ----------
    name : str
        Shown beside it.
    vertices_world : (V, 3) float64
        Metres.
    faces : (T, 3) int32
        Vertex numbers.
    collides : bool
        Whether it is drawn as colliding.
    hit_triangles : (K,) uint32
        Numbers of the triangles with collision points.
    hit_points_world : (P, 3) float64
        The collision points, in metres.
    share_lit : (T,) float or None
        Of each triangle how much of it a lamp of the scene reaches: the rest is drawn darker.
    warmth : (V,) float or None
        Of each vertex how near something came, from 0 to 1: it is coloured by the heat's scale.
    """

    name: str
    vertices_world: NDArray[np.float64]
    faces: NDArray[np.int32]
    collides: bool
    hit_triangles: NDArray[np.uint32]
    hit_points_world: NDArray[np.float64]
    share_lit: NDArray[np.floating] | None = None
    warmth: NDArray[np.floating] | None = None

    @property
    def corners_world(self) -> NDArray[np.float64]:
        """The vertices of each triangle, (T, 3, 3) metres."""
        return self.vertices_world[self.faces]


@dataclass(frozen=True, slots=True, eq=False)
class Measure:
    """A line with a number: a clearance between two points, or an arrow.

    Attributes
    ----------
    start_world, end_world : (3,) float64
        Its ends, metres.
    text : str
        Written at its middle; empty for nothing.
    rgb : (float, float, float)
        Its colour, 0 to 1.
    has_head : bool
        Whether it is an arrow.
    """

    start_world: NDArray[np.float64]
    end_world: NDArray[np.float64]
    text: str
    rgb: tuple[float, float, float]
    has_head: bool = False

    @property
    def middle_world(self) -> NDArray[np.float64]:
        """The point half way."""
        return np.asarray((self.start_world + self.end_world) / 2)


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """What is drawn over a picture.

    Attributes
    ----------
    points_world : (N, 3) float64
        Dots.
    paths_world : tuple of (P, 3) float64
        Ways that something went, each with an arrow's head at its end and at every `head_every`-th
        of its places, as in figure 5 of the paper.
    head_every : int
        Places from one head to the next.
    measures : tuple of Measure
        Lines with numbers, and arrows.
    """

    points_world: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    paths_world: tuple[NDArray[np.float64], ...] = ()
    head_every: int = 5
    measures: tuple[Measure, ...] = ()


def thinned(points: NDArray[np.float64], spacing: float) -> NDArray[np.int64]:
    """Return numbers of points (N, D), one in each cell of `spacing`; so that dots stay dots."""
    if len(points) == 0:
        return np.zeros(0, np.int64)
    cells = np.floor(points / spacing).astype(np.int64)
    cells -= cells.min(axis=0)
    # One number a cell sorts far quicker than a row of them.
    numbers = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1))
    _, first = np.unique(numbers, return_index=True)
    return np.sort(first)
