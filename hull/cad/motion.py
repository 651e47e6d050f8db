"""How an object moves: by frame, from where the scene puts it to where it was.

A scene places a mesh at rest: ``rest`` is the world's frame while nothing has moved. A motion
takes that place to the world in each frame of the session, ``world_from_rest``. Whatever moves does
so rigidly.

Between two frames nothing is known. The pose there is an *estimate*: one point of the object, the
pivot, goes straight, and the object turns evenly about it, the shorter way round. Of a hinge the
pivot lies on the axis, so that the object keeps to its circle; of poses it is the origin that they
tell of.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import (
    Pose,
    compose,
    invert,
    rotation_of,
    rotation_vector,
    transform,
)


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Where an object was, frame by frame.

    Attributes
    ----------
    poses : mapping of int to (3, 4) float64
        By frame of the session world_from_rest, metres; frames in which it is not known have none.
    pivot_rest : (3,) float64
        The point of the object, metres, at rest, that goes straight between two frames.
    """

    poses: Mapping[int, Pose]
    pivot_rest: NDArray[np.float64]

    @classmethod
    def of_poses(cls, world_from_object: Mapping[int, Pose]) -> Self:
        """Return the motion of an object that the scene places in a frame of its own.

        Parameters
        ----------
        world_from_object : mapping of int to (3, 4) float64
            By frame where that frame of its own was, metres.
        """
        return cls(world_from_object, np.zeros(3))

    @classmethod
    def of_track(cls, world_from_tracker: Mapping[int, Pose], object_from_tracker: Pose) -> Self:
        """Return the motion of an object with a tracker on it.

        Parameters
        ----------
        world_from_tracker : mapping of int to (3, 4) float64
            By frame where the tracker was, metres.
        object_from_tracker : (3, 4) float64
            Where it sits on the object, in the frame that the scene places the object in.
        """
        tracker_from_object = invert(object_from_tracker)
        return cls(
            {
                frame: compose(pose, tracker_from_object)
                for frame, pose in world_from_tracker.items()
            },
            object_from_tracker[:, 3],
        )

    @classmethod
    def of_hinge(
        cls,
        angles_rad: Mapping[int, float],
        axis_rest: NDArray[np.float64],
        anchor_rest: NDArray[np.float64],
    ) -> Self:
        """Return the motion of an object that turns about an axis.

        Parameters
        ----------
        angles_rad : mapping of int to float
            By frame how far it is turned from where the scene puts it, right-handed about the axis.
        axis_rest : (3,) float64
            The direction of the axis, of any length above 0, at rest.
        anchor_rest : (3,) float64
            A point of it, metres.
        """
        axis = axis_rest / np.linalg.norm(axis_rest)
        turns = rotation_of(np.array(list(angles_rad.values()))[:, None] * axis)  # (F, 3, 3)
        poses = {
            frame: np.column_stack([turn, anchor_rest - turn @ anchor_rest])
            for frame, turn in zip(angles_rad, turns, strict=True)
        }
        return cls(poses, anchor_rest)

    def world_from_rest(self, index: int) -> Pose | None:
        """Return where the object was in a frame, (3, 4); None where that is not known."""
        return self.poses.get(index)

    def last_known(self, index: int) -> Pose:
        """Return world_from_rest (3, 4) of the last frame up to this one that has it.

        Of the first that has one, where none before has.
        """
        known = sorted(self.poses)
        return self.poses[max((frame for frame in known if frame <= index), default=known[0])]

    def between(self, before: int, after: int, fraction: float) -> Pose:
        """Return the estimated world_from_rest (3, 4) of an instant between two frames.

        Parameters
        ----------
        before, after : int
            Frames with a pose.
        fraction : float
            The instant: 0 gives the pose of `before`, 1 that of `after`.
        """
        first, second = self.poses[before], self.poses[after]
        if fraction == 1.0:
            return second
        if fraction == 0.0 or np.array_equal(first, second):
            return first
        turn = rotation_vector(second[:, :3] @ first[:, :3].T)
        rotation = rotation_of(fraction * turn) @ first[:, :3]
        ends = [transform(pose, self.pivot_rest[None])[0] for pose in (first, second)]
        pivot_world = (1.0 - fraction) * ends[0] + fraction * ends[1]
        return np.column_stack([rotation, pivot_world - rotation @ self.pivot_rest])
