"""How a sheet keeps off the CAD of the scene that no effect moves.

Felt are the nodes and the middles of the edges, by the exact signed distance to the surface; what a
triangle spans between them is not. Of a surface that is not closed there is no inside: the sheet
keeps off it by half its thickness, and may pass through it where it goes farther in one step.

A point is measured anew only when it may have come near by what it has gone since: distances change
by no more than that. So what is measured when changes no result.
"""

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.distance import SurfaceDistance
from hybridve.hull.cad.scene import SceneObject

#: Nearer to the surface than this a point has no direction to go, metres.
_ON_IT_M = 1e-9


class Obstacle:
    """One object, and the sheet that keeps off it.

    Parameters
    ----------
    thing : SceneObject
        What stands.
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
        low, high = thing.box_world
        self._middle = (low + high) / 2.0
        self._half = (high - low) / 2.0
        self._surface = SurfaceDistance(
            thing.vertices_world - self._middle,
            thing.faces,
            is_closed=thing.is_closed,
            solid_faces=thing.solid_faces,
        )
        own = np.repeat(np.arange(n_nodes)[:, None], 2, axis=1)
        self._ends = np.concatenate([own, edges])  # a node is the middle of itself twice
        self._off_m = off_m
        self._measured_at = np.zeros((len(self._ends), 3))
        self._apart_m = np.zeros(len(self._ends))
        self.forget()

    def forget(self) -> None:
        """Measure all points anew when next asked: the sheet may be anywhere."""
        self._apart_m[:] = -np.inf

    def push(
        self,
        x: NDArray[np.float64],
        inverse_mass: NDArray[np.float64],
        shift: NDArray[np.float64],
    ) -> bool:
        """Move nodes (N, 3) off the surface, in place; tell whether any was.

        `inverse_mass` (N,) is 0 for nodes that do not move; to `shift` (N, 4) is added as to that
        of `hybridve.hull.effects.push_out.push_hits`.
        """
        if (
            (x.min(axis=0) > self._middle + self._half + self._off_m)
            | (x.max(axis=0) < self._middle - self._half - self._off_m)
        ).any():
            return False
        points = (x[self._ends[:, 0]] + x[self._ends[:, 1]]) / 2.0 - self._middle
        gone_m = np.sqrt(((points - self._measured_at) ** 2).sum(axis=1))
        near = np.flatnonzero(~(self._apart_m - gone_m > self._off_m))
        if len(near) == 0:
            return False
        apart_m, nearest = self._surface.signed(points[near])
        self._measured_at[near], self._apart_m[near] = points[near], apart_m
        is_in = apart_m < self._off_m
        near, apart_m = near[is_in], apart_m[is_in]
        way = (points[near] - nearest[is_in]) * np.where(apart_m < 0, -1.0, 1.0)[:, None]
        length = np.linalg.norm(way, axis=1)
        has_way = length > _ON_IT_M
        near, way = near[has_way], way[has_way] / length[has_way, None]
        ends, missing_m = self._ends[near], self._off_m - apart_m[has_way]
        # A middle goes where its two ends go by the same way, or the one that is free by twice it.
        free = inverse_mass[ends] > 0.0
        n_free = free.sum(axis=1)
        share = np.where(free, (2.0 / np.maximum(n_free, 1))[:, None], 0.0)
        moved_m = share * missing_m[:, None]  # (K, 2)
        # Of all that ask a node to move, the one that asks for most.
        node, asked_m = ends.ravel(), moved_m.ravel()
        order = np.argsort(-asked_m, kind="stable")
        node, first = np.unique(node[order], return_index=True)
        chosen = order[first]
        shifts = asked_m[chosen, None] * np.repeat(way, 2, axis=0)[chosen]
        x[node] += shifts
        shift[node, :3] += shifts
        shift[node, 3] += asked_m[chosen]
        return bool((asked_m > 0).any())
