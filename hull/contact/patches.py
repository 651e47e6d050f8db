"""Contacts as things: the connected pieces of the hull that touch an object, or come too near.

The paper assumes one contact an object; a recording has two hands on one part, and a tool beside
them. Space near the object is cut into cubes (`ClearanceMeter.near_cells`); cubes that touch at a
face, an edge or a corner belong to one patch. Pieces of the hull that are three cubes apart are two
patches; those nearer to each other may be one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.contact.clearance import ClearanceMeter, NearCells
from hybridve.hull.contact.detect import Contact
from hybridve.hull.contact.respond import farthest_from
from hybridve.hull.jit import ZERO, compiled
from hybridve.hull.query.silhouettes import Hull

#: Cubes are at most this wide, metres: fingers of one hand are one patch, hands are two.
CELL_M = 0.01

#: Where there would be more cubes than this they are larger.
_MOST_CELLS = 1 << 14

#: Collision points that are told apart by patch at most; of more, every k-th.
_MOST_POINTS = 200_000

#: Places of cubes are packed into one number, this many bits an axis.
_BITS = 21


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """One connected piece of the hull that touches an object, or is nearer than it requires.

    Attributes
    ----------
    cp_obj_world : (3,) float64
        Metres: its collision point farthest from RP_obj; without one, the point of the object that
        `clearance_m` was measured from.
    on_hull_world : (3,) float64
        The point of the hull that it was measured to; the same point where the two touch.
    clearance_m : (float, float)
        Bounds of the distance from this piece of the hull to the object; 0, 0 where it touches.
    lower_world, upper_world : (3,) float64
        Corners of the box around its collision points; without any, around its cubes.
    n_triangles, n_points : int
        How many triangles have a collision point of it, and how many points; of an object with
        more than `_MOST_POINTS`, of every k-th.
    """

    cp_obj_world: NDArray[np.float64]
    on_hull_world: NDArray[np.float64]
    clearance_m: tuple[float, float]
    lower_world: NDArray[np.float64]
    upper_world: NDArray[np.float64]
    n_triangles: int
    n_points: int


def contact_patches(
    hull: Hull,
    meter: ClearanceMeter,
    contact: Contact,
    *,
    required_m: float,
    reference_point_world: NDArray[np.float64],
    cell_m: float = CELL_M,
) -> tuple[Patch, ...]:
    """Return the patches of one object in one frame: most points first, then the nearest.

    Parameters
    ----------
    hull : Hull
        The hull of the frame.
    meter : ClearanceMeter
        Of the object.
    contact : Contact
        Of the object in this frame.
    required_m : float
        The clearance that the object requires.
    reference_point_world : (3,) float64
        RP_obj, metres.
    cell_m : float
        How wide a cube is at most.
    """
    cells = meter.near_cells(hull, required_m, cell_m, _MOST_CELLS)
    places = cells.places(cells.center_world)
    labels, keys, order = _labelled(places)
    points_world, triangle = contact.some_points(_MOST_POINTS)
    of_point = _labels_of(cells, points_world, labels, keys, order)
    found = []
    for label in range(int(labels.max(initial=-1)) + 1):
        mine = of_point == label
        cubes = labels == label
        if mine.any():
            found.append(_touching(points_world[mine], triangle[mine], reference_point_world))
        elif (patch := _near(cells, cubes, required_m)) is not None:
            found.append(patch)
    return tuple(
        sorted(found, key=lambda p: (-p.n_points, p.clearance_m[1], p.cp_obj_world.tolist()))
    )


def _touching(
    points_world: NDArray[np.float64],
    triangle: NDArray[np.uint32],
    reference_point_world: NDArray[np.float64],
) -> Patch:
    cp_obj_world = farthest_from(reference_point_world, points_world)
    return Patch(
        cp_obj_world,
        cp_obj_world,
        (0.0, 0.0),
        points_world.min(axis=0),
        points_world.max(axis=0),
        len(np.unique(triangle)),
        len(points_world),
    )


def _near(cells: NearCells, cubes: NDArray[np.bool_], required_m: float) -> Patch | None:
    """Return the patch of cubes without a collision point; None if no hull so near is in them."""
    clearance = cells.measure(cubes)
    if clearance.upper_m > 0.0 and not clearance.upper_m < required_m:
        return None
    center_world = cells.center_world[cubes]
    return Patch(
        clearance.on_object_world,
        clearance.on_hull_world,
        (clearance.lower_m, clearance.upper_m),
        center_world.min(axis=0) - cells.reach_world,
        center_world.max(axis=0) + cells.reach_world,
        0,
        0,
    )


def _keys(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one number for each place (N, 3) of the lattice."""
    shifted = places + (1 << (_BITS - 1))
    return np.asarray((shifted[:, 0] << 2 * _BITS) | (shifted[:, 1] << _BITS) | shifted[:, 2])


def _labelled(
    places: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the piece (N,) that each cube is of, all keys ascending, and the cubes' order so."""
    keys = _keys(places)
    order = np.argsort(keys)
    keys = keys[order]
    labels = np.zeros(len(keys), np.int64)
    labels[order] = _connected(keys, 1 << _BITS)
    return labels, keys, order


def _labels_of(
    cells: NearCells,
    points_world: NDArray[np.float64],
    labels: NDArray[np.int64],
    keys: NDArray[np.int64],
    order: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Return the piece that each point lies in (P,); of one that lies in none, the nearest."""
    if len(points_world) == 0 or len(labels) == 0:
        return np.full(len(points_world), -1, np.int64)
    wanted = _keys(cells.places(points_world))
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    of_point = labels[order[at]]
    # An engine in single precision may put a sample into the hull that is a hair outside of it.
    for lost in np.flatnonzero(keys[at] != wanted):
        away = ((cells.center_world - points_world[lost]) ** 2).sum(axis=1)
        of_point[lost] = labels[away.argmin()]
    return of_point


@compiled
def _connected(keys: NDArray[np.int64], step: int) -> NDArray[np.int64]:
    """Return the piece of each cube (N,), numbered from 0 in the order of the keys, ascending.

    Cubes are joined to those of the thirteen places before them that are there.
    """
    parent = np.arange(len(keys))
    for dx in range(-1, 1):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                away = (dx * step + dy) * step + dz
                if away >= 0:
                    continue
                j = ZERO
                for i in range(len(keys)):
                    wanted = keys[i] + away
                    while j < len(keys) and keys[j] < wanted:
                        j += 1
                    if j < len(keys) and keys[j] == wanted:
                        a, b = i, j
                        while parent[a] != a:
                            parent[a] = parent[parent[a]]
                            a = parent[a]
                        while parent[b] != b:
                            parent[b] = parent[parent[b]]
                            b = parent[b]
                        if a != b:
                            parent[max(a, b)] = min(a, b)
    label = np.zeros(len(keys), np.int64)
    n = ZERO
    for i in range(len(keys)):
        a = parent[i]
        while parent[a] != a:
            a = parent[a]
        if a == i:
            label[i] = n
            n += 1
        else:
            label[i] = label[a]
    return label
