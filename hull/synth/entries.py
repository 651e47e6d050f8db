"""When real shapes first touch a CAD part: roots in time of the distance between them.

The motion is a function of time, so the instant of contact does not depend on the frames. Between
two moments no shape travels farther than its path, and no distance changes by more: stretches in
which nothing can happen are passed over, the rest is halved down to steps of the path's own grid.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import Pose
from hybridve.hull.synth.closest import Closest, closest_on_surface
from hybridve.hull.synth.stage import Stage

#: Steps of the grid at least: for the whole recording, and from one frame to the next. A touch, or
#: a parting, that begins and ends within one step may go unnoticed.
_STEPS, _STEPS_PER_FRAME = 512, 8

#: Between two places on the grid a shape travels no farther than this many times the straight way.
_BENT = 1.1

#: How near to zero the distance is at the moment that is returned.
CONTACT_TOLERANCE_M = 1e-8

_MAX_STEPS = 80


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """The beginning of a contact.

    Attributes
    ----------
    moment : float
        When, from 0, the beginning of the recording, to 1, its end.
    point_world : (3,) float64
        Where on the surface of the part, metres.
    """

    moment: float
    point_world: NDArray[np.float64]


class Motion:
    """The paths of a stage's shapes.

    Parameters
    ----------
    stage : Stage
        What moves.
    n_frames : int
        How many frames the recording has: each is a place on the grid.
    """

    def __init__(self, stage: Stage, n_frames: int) -> None:
        gaps = max(1, n_frames - 1)
        self.steps_per_frame = max(_STEPS_PER_FRAME, -(-_STEPS // gaps))
        self._stage = stage
        self._shapes = [real.shape for real in stage.shapes]
        self.moments = np.linspace(0.0, 1.0, gaps * self.steps_per_frame + 1)
        poses = np.array([stage.poses(float(moment)) for moment in self.moments])  # (G, S, 3, 4)
        self._reach = np.array([shape.reach_m for shape in self._shapes])
        self._centers = poses[..., 3]
        steps = np.diff(poses, axis=0)
        # Of a point 1 m away; the Frobenius norm counts a turn about an axis twice, squared.
        turned = np.linalg.norm(steps[..., :3], axis=(-2, -1)) / np.sqrt(2.0)
        way = np.linalg.norm(steps[..., 3], axis=-1) + turned * self._reach
        self._path = np.concatenate([np.zeros((1, len(self._reach))), _BENT * way.cumsum(axis=0)])

    def entries(
        self, triangles_world: NDArray[np.float64], at_frames: Sequence[Closest]
    ) -> list[Entry]:
        """Return every moment at which a surface that was free begins to be touched, in order.

        A contact that is there from the beginning has no such moment.

        Parameters
        ----------
        triangles_world : (T, 3, 3) float64
            Corners in metres.
        at_frames : sequence of Closest
            What is known of it in each frame.
        """
        known = {frame * self.steps_per_frame: closest for frame, closest in enumerate(at_frames)}
        low, high = triangles_world.min(axis=(0, 1)), triangles_world.max(axis=(0, 1))
        outside = np.maximum(np.maximum(low - self._centers, self._centers - high), 0.0)
        at_least_m = np.linalg.norm(outside, axis=-1) - self._reach  # (G, S)

        def closest_at(step: int) -> Closest:
            if step not in known:
                poses = self._stage.poses(float(self.moments[step]))
                known[step] = closest_on_surface(triangles_world, self._shapes, poses)
            return known[step]

        def nothing_happens(start: int, stop: int) -> bool:
            first, last = closest_at(start), closest_at(stop)
            path = self._path[stop] - self._path[start]  # (S,)
            total_m = abs(first.distance_m) + abs(last.distance_m)
            if first.distance_m > 0 and last.distance_m > 0:
                comes_near = at_least_m[start] + at_least_m[stop] < path
                return bool((path[comes_near] < total_m).all())
            if first.distance_m < 0 and last.distance_m < 0:
                if first.shape == last.shape and path[first.shape] < total_m:
                    return True
                return bool(
                    path[first.shape] < -first.distance_m or path[last.shape] < -last.distance_m
                )
            return False

        found = []
        waiting = [
            (frame * self.steps_per_frame, (frame + 1) * self.steps_per_frame)
            for frame in reversed(range(len(at_frames) - 1))
        ]
        while waiting:
            start, stop = waiting.pop()
            if stop - start > 1:
                if not nothing_happens(start, stop):
                    middle = (start + stop) // 2
                    waiting += [(middle, stop), (start, middle)]
            elif closest_at(start).distance_m >= 0 > closest_at(stop).distance_m:
                found.append(self._root(triangles_world, start, stop))
        return found

    def _root(self, triangles_world: NDArray[np.float64], start: int, stop: int) -> Entry:
        """Return when and where the distance passes zero, by false position that never stalls."""

        def closest_at(moment: float) -> Closest:
            poses: list[Pose] = self._stage.poses(moment)
            return closest_on_surface(
                triangles_world, self._shapes, poses, tolerance_m=CONTACT_TOLERANCE_M / 4
            )

        free, touching = float(self.moments[start]), float(self.moments[stop])
        at_free, closest = closest_at(free).distance_m, closest_at(touching)
        at_touching = closest.distance_m
        moment = touching
        for _ in range(_MAX_STEPS):
            moment = (free * at_touching - touching * at_free) / (at_touching - at_free)
            closest = closest_at(moment)
            if abs(closest.distance_m) <= CONTACT_TOLERANCE_M:
                break
            if closest.distance_m > 0:
                free, at_free, at_touching = moment, closest.distance_m, at_touching / 2
            else:
                touching, at_touching, at_free = moment, closest.distance_m, at_free / 2
        return Entry(moment, closest.point_world)
