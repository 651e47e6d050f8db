"""What small things meet on their way through CAD that stands and CAD that moves, over one step.

CAD that moves is met in its own frame, as it is at rest: what goes straight in the world while an
object moves goes along a chord there, from where the object has it at the beginning to where it has
it at the end. So nothing is passed over, be it the thing that moves, or the object, or both. Within
a step the transform is taken to change evenly.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import invert
from hybridve.hull.cad.surface_ray import first_triangle, joined, tree_of
from hybridve.hull.cad.surface_tree import SurfaceTree
from hybridve.hull.effects.effect import Course, Setting
from hybridve.hull.jit import compiled


class Cad(NamedTuple):
    """The CAD that no effect moves, as compiled loops take it: K - 1 objects that move.

    Attributes
    ----------
    tree : SurfaceTree
        The triangles: first of all that stands, metres about the views' local origin; then of each
        object that moves, as it is at rest.
    root : (K,) int64
        Where each begins in the tree.
    begin, change : (K, 3, 4) float64
        What takes a point about the local origin into the object's own frame at the beginning of a
        step, and by how much that is another at its end.
    step_s : float
        How long the step is.
    """

    tree: SurfaceTree
    root: NDArray[np.int64]
    begin: NDArray[np.float64]
    change: NDArray[np.float64]
    step_s: float


class CadWays:
    """The CAD that particles meet, wherever it moves.

    Parameters
    ----------
    setting : Setting
        Whose obstacles.
    """

    def __init__(self, setting: Setting) -> None:
        self._origin_world = setting.views.origin_world
        self._names = tuple(one.name for one in setting.obstacles if one.motion is not None)
        standing = [np.zeros((0, 3, 3))] + [
            one.vertices_world[one.faces] for one in setting.obstacles if one.motion is None
        ]
        moving = [
            one.vertices_world[one.faces] for one in setting.obstacles if one.motion is not None
        ]
        trees = [
            tree_of(corners - self._origin_world) for corners in (np.concatenate(standing), *moving)
        ]
        self._tree, self._root = joined(trees)

    def over(self, courses: Mapping[str, Course], step_s: float) -> Cad:
        """Return the CAD of one step."""
        begin = np.tile(np.eye(3, 4), (len(self._root), 1, 1))
        end = begin.copy()
        for number, name in enumerate(self._names, start=1):
            course = courses.get(name)
            if course is not None:
                begin[number] = self._own_from_local(course.begin)
                end[number] = self._own_from_local(course.end)
        return Cad(self._tree, self._root, begin, end - begin, step_s)

    def _own_from_local(self, world_from_rest: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what takes points about the local origin to points at rest about it."""
        own = invert(world_from_rest)
        own[:, 3] += own[:, :3] @ self._origin_world - self._origin_world
        return own


@compiled
def _into(
    point: NDArray[np.float64], cad: Cad, one: int, share: float, own: NDArray[np.float64]
) -> None:
    """Write a point, local frame, at a share of the step, in an object's own frame."""
    for row in range(3):
        place = cad.begin[one, row, 3] + share * cad.change[one, row, 3]
        for axis in range(3):
            turn = cad.begin[one, row, axis] + share * cad.change[one, row, axis]
            place += turn * point[axis]
        own[row] = place


@compiled
def _out_of(
    own: NDArray[np.float64], cad: Cad, one: int, end: float, point: NDArray[np.float64]
) -> None:
    """Write a point of an object's own frame in the local one, as the step begins or, 1.0, ends."""
    for axis in range(3):
        point[axis] = 0.0
        for row in range(3):  # p = R' (own - t)
            turn = cad.begin[one, row, axis] + end * cad.change[one, row, axis]
            shift = cad.begin[one, row, 3] + end * cad.change[one, row, 3]
            point[axis] += turn * (own[row] - shift)


@compiled
def first_cad(
    start: NDArray[np.float64],
    way: NDArray[np.float64],
    until: float,
    cad: Cad,
    begin: float,
    end: float,
    room: NDArray[np.float64],
    waiting: NDArray[np.int64],
) -> tuple[float, int, int]:
    """Return where what goes straight first meets CAD, which triangle, and of which object.

    Parameters
    ----------
    start, way : (3,) float64
        Local frame, metres.
    until : float
        Up to which share of the way.
    cad : Cad
        Over the step.
    begin, end : float
        At which shares of the step it starts, and has gone all of its way.
    room : (2, 3) float64
        To be written to: what was met is met there from the first along the second.
    waiting : (`WAITING`,) int64
        Room for a stack.

    Returns
    -------
    at : float
        The share of the way, at most `until`; infinite if it meets none.
    triangle, one : int
        In the tree's order, and the number of the object, 0 for what stands; -1 for none.
    """
    at, triangle, one = np.inf, -1, -1
    place, chord = np.zeros(3), np.zeros(3)
    for number in range(len(cad.root)):
        if number == 0:
            for axis in range(3):
                place[axis], chord[axis] = start[axis], way[axis]
        else:
            _into(start, cad, number, begin, place)
            for axis in range(3):
                chord[axis] = start[axis] + way[axis]
            _into(chord.copy(), cad, number, end, chord)
            for axis in range(3):
                chord[axis] -= place[axis]
        nearest = min(until, at)
        found_at, found = first_triangle(place, chord, nearest, cad.tree, waiting, cad.root[number])
        if found >= 0 and found_at < at:
            at, triangle, one = found_at, found, number
            for axis in range(3):
                room[0, axis], room[1, axis] = place[axis], chord[axis]
    return at, triangle, one


@compiled
def cad_normal(
    triangle: int,
    one: int,
    share: float,
    cad: Cad,
    room: NDArray[np.float64],
    normal: NDArray[np.float64],
) -> None:
    """Write the unit normal of a triangle that was met, on the side it was met from, local frame.

    At a share of the step; `room` as `first_cad` left it.
    """
    solid, own = cad.tree.solid[triangle], np.zeros(3)
    facing = 0.0
    for axis in range(3):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        own[axis] = (solid[3 + j] - solid[j]) * (solid[6 + k] - solid[k]) - (
            solid[3 + k] - solid[k]
        ) * (solid[6 + j] - solid[j])
        facing += own[axis] * room[1, axis]
    if one > 0:
        for axis in range(3):
            normal[axis] = 0.0
            for row in range(3):
                turn = cad.begin[one, row, axis] + share * cad.change[one, row, axis]
                normal[axis] += turn * own[row]
    else:
        for axis in range(3):
            normal[axis] = own[axis]
    scale = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    if facing > 0.0:
        scale = -scale
    for axis in range(3):
        normal[axis] /= scale


@compiled
def cad_speed(
    point: NDArray[np.float64], normal: NDArray[np.float64], one: int, share: float, cad: Cad
) -> float:
    """Return how fast CAD comes along a normal at a point, local frame, at a share of the step."""
    if one <= 0:
        return 0.0
    own, there, speed = np.zeros(3), np.zeros(3), 0.0
    _into(point, cad, one, share, own)
    for end in range(2):
        _out_of(own, cad, one, float(end), there)
        for axis in range(3):
            speed += (2.0 * end - 1.0) * there[axis] * normal[axis]
    return speed / cad.step_s


@compiled
def carry(point: NDArray[np.float64], one: int, share: float, cad: Cad) -> None:
    """Take a point, local frame, along with an object from a share of the step to its end."""
    own = np.zeros(3)
    _into(point, cad, one, share, own)
    _out_of(own, cad, one, 1.0, point)
