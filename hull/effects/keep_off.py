"""How a sheet keeps off the CAD of the scene that no effect moves.

Felt are the nodes and the middles of the edges, by the exact signed distance to the surface; what a
triangle spans between them is not. Of a surface that is not closed there is no inside: the sheet
keeps off it by half its thickness, and may pass through it where it goes farther in one step.

What the nearest surface of a point is, is taken for flat for one step. Of an object that moves it
is that at the beginning of the step, which goes along to its end: nothing is on its other side
then. What slides along a surface is not taken with it.

A point is measured anew only when it may have come near by what it has gone since, as the object
sees it: distances change by no more than that. So what is measured when changes no result.
"""

import itertools

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import invert, placed
from hybridve.hull.cad.distance import SurfaceDistance
from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.effects.cloth_model import Contacts, no_contacts
from hybridve.hull.effects.effect import Course

#: Nearer to the surface than this a point has no direction to go, metres.
_ON_IT_M = 1e-9


class Obstacle:
    """One object, and the sheet that keeps off it.

    Parameters
    ----------
    thing : SceneObject
        What no effect moves.
    edges : (E, 2) int64
        The edges of the sheet, node numbers.
    n_nodes : int
        Its nodes.
    off_m : float
        How far the sheet keeps off the surface, metres.
    """

    def __init__(
        self, thing: SceneObject, edges: NDArray[np.int64], n_nodes: int, off_m: float
    ) -> None:
        self.name = thing.name
        low, high = thing.box_world
        self._corners = np.array(list(itertools.product(*np.stack([low, high]).T)))
        self._middle = (low + high) / 2.0
        self._half = (high - low) / 2.0
        self._surface = SurfaceDistance(
            thing.vertices_world - self._middle,
            thing.faces,
            is_closed=thing.is_closed,
            solid_faces=thing.solid_faces,
        )
        # A node is the middle of itself twice.
        own = np.repeat(np.arange(n_nodes)[:, None], 2, axis=1)
        self._ends = np.concatenate([own, edges])
        self._off_m = off_m
        self._measured_at = np.zeros((len(self._ends), 3))
        self._apart_m = np.zeros(len(self._ends))
        self.forget()

    def forget(self) -> None:
        """Measure all points anew when next asked: the sheet may be anywhere."""
        self._apart_m[:] = -np.inf

    def contacts(
        self, x: NDArray[np.float64], margin_m: float, step_s: float, course: Course | None = None
    ) -> Contacts:
        """Return what nodes (N, 3) and middles of edges are near to.

        Parameters
        ----------
        x : (N, 3) float64
            Metres, at the beginning of the step.
        margin_m : float
            How near counts, beyond how far the sheet keeps off: farther than any node goes.
        step_s : float
            Seconds.
        course : Course or None
            Where the object is over the step; None of one that stands.
        """
        reach_m = self._off_m + margin_m
        if course is not None:
            gone_m = placed(self._corners, course.end) - placed(self._corners, course.begin)
            reach_m += float(np.linalg.norm(gone_m, axis=1).max())
            x = placed(x, invert(course.begin))
        near = np.zeros(0, np.int64)
        if (
            (x.min(axis=0) <= self._middle + self._half + reach_m)
            & (x.max(axis=0) >= self._middle - self._half - reach_m)
        ).all():
            points = (x[self._ends[:, 0]] + x[self._ends[:, 1]]) / 2.0 - self._middle
            gone_m = np.sqrt(((points - self._measured_at) ** 2).sum(axis=1))
            near = np.flatnonzero(~(self._apart_m - gone_m > reach_m))
        if len(near) == 0:
            return no_contacts()
        apart_m, nearest = self._surface.signed(points[near])
        self._measured_at[near], self._apart_m[near] = points[near], apart_m
        way = (points[near] - nearest) * np.where(apart_m < 0, -1.0, 1.0)[:, None]
        length = np.linalg.norm(way, axis=1)
        is_told = (apart_m <= reach_m) & (length > _ON_IT_M)
        near, way = near[is_told], way[is_told] / length[is_told, None]
        surface = nearest[is_told] + self._middle
        rise_m = np.zeros(len(near))
        if course is not None:
            way = np.ascontiguousarray(way @ course.end[:, :3].T)
            begin, surface = placed(surface, course.begin), placed(surface, course.end)
            rise_m = np.einsum("ij,ij->i", way, surface - begin)
        level_m = np.einsum("ij,ij->i", way, surface) + self._off_m
        ends = self._ends[near]
        return Contacts(
            np.column_stack([ends, ends[:, :1]]),
            np.where((ends[:, :1] == ends[:, 1:]), [1.0, 0.0, 0.0], [0.5, 0.5, 0.0]),
            way,
            level_m,
            rise_m,
            rise_m / step_s,
        )
