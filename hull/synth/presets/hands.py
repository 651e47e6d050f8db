"""A person's hands, made of convex shapes, and the skin and cloth they are seen in.

A hand lies in a frame of its own: the fingers point along y, away from the person, x is to the
right and z up, the back of the hand. The origin is the middle of what it holds.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import Pose
from hybridve.hull.synth.shapes import Box, Capsule
from hybridve.hull.synth.stage import Material, RealShape, pose_at

Point = tuple[float, float, float]

SKIN = Material((128.0, 152.0, 208.0), (112.0, 136.0, 196.0), 0.031, (0.8, 0.6, 0.0))
SLEEVE = Material((142.0, 82.0, 48.0), (158.0, 98.0, 60.0), 0.09)


def between(start: Point | NDArray[np.float64], stop: Point | NDArray[np.float64]) -> Pose:
    """Return the pose whose origin is halfway from `start` to `stop` and whose z axis runs so."""
    first, last = np.asarray(start, np.float64), np.asarray(stop, np.float64)
    along = (last - first) / np.linalg.norm(last - first)
    # Across it, from the world's axis that it is least in line with.
    across = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    across /= np.linalg.norm(across)
    return np.column_stack([across, np.cross(along, across), along, (first + last) / 2])


def limb(name: str, start: Point, stop: Point, radius_m: float, material: Material) -> RealShape:
    """Return a capsule from `start` to `stop`."""
    half_m = float(np.linalg.norm(np.subtract(stop, start))) / 2
    return RealShape(name, Capsule(half_m, radius_m), between(start, stop), material)


def pinching_hand(name: str, grip_m: float, *, rise: float, is_left: bool) -> tuple[RealShape, ...]:
    """Return a hand, palm down, that holds something upright between thumb and fingers.

    Parameters
    ----------
    name : str
        What the names of its shapes begin with.
    grip_m : float
        Half as wide as what it holds.
    rise : float
        How many metres the forearm rises on each metre away from the hand.
    is_left : bool
        Whether it is a left hand.
    """
    side = grip_m + 0.008  # the fingers' middle: they are as thick as that
    parts = (
        limb("index", (side, -0.045, 0.004), (side - 0.002, 0.026, -0.002), 0.008, SKIN),
        limb("middle", (side + 0.018, -0.045, 0.004), (side + 0.015, 0.034, -0.004), 0.008, SKIN),
        limb("ring", (side + 0.036, -0.045, 0.003), (side + 0.032, 0.027, -0.006), 0.008, SKIN),
        limb("little", (side + 0.053, -0.048, 0.002), (side + 0.050, 0.010, -0.006), 0.007, SKIN),
        limb("thumb", (side + 0.005, -0.088, -0.002), (-side, -0.032, 0.0), 0.011, SKIN),
        limb("thumb_tip", (-side, -0.032, 0.0), (-side, 0.008, 0.0), 0.0085, SKIN),
        RealShape("palm", Box(0.036, 0.040, 0.0125), pose_at((side + 0.025, -0.082, 0.002)), SKIN),
        *_arm((side + 0.024, -0.118, 0.003), rise),
    )
    return tuple(_named(part, name, is_left) for part in parts)


def fist(name: str, *, rise: float, is_left: bool) -> tuple[RealShape, ...]:
    """Return a hand closed about something upright and thin, the thumb on top.

    Parameters
    ----------
    name : str
        What the names of its shapes begin with.
    rise : float
        How many metres the forearm rises on each metre away from the hand.
    is_left : bool
        Whether it is a left hand.
    """
    fingers = [
        limb(which, (-0.022, 0.020, height), (0.026, 0.019, height), 0.0095, SKIN)
        for which, height in (("index", 0.028), ("middle", 0.010), ("ring", -0.009))
    ]
    parts = (
        *fingers,
        limb("little", (-0.018, 0.017, -0.027), (0.024, 0.016, -0.027), 0.0085, SKIN),
        RealShape("palm", Box(0.014, 0.036, 0.040), pose_at((0.026, -0.016, 0.0)), SKIN),
        limb("thumb", (0.016, -0.040, 0.030), (-0.014, -0.004, 0.040), 0.011, SKIN),
        limb("thumb_tip", (-0.014, -0.004, 0.040), (-0.016, 0.018, 0.040), 0.009, SKIN),
        *_arm((0.024, -0.050, -0.004), rise),
    )
    return tuple(_named(part, name, is_left) for part in parts)


def _arm(wrist: Point, rise: float) -> tuple[RealShape, ...]:
    """Return wrist, forearm and sleeve, away from the hand."""

    def away(length_m: float) -> Point:
        return (wrist[0] + 0.12 * length_m, wrist[1] - length_m, wrist[2] + rise * length_m)

    return (
        limb("wrist", wrist, away(0.07), 0.025, SKIN),
        limb("forearm", away(0.06), away(0.22), 0.034, SKIN),
        limb("sleeve", away(0.21), away(0.52), 0.046, SLEEVE),
    )


def _named(part: RealShape, hand: str, is_left: bool) -> RealShape:
    """Return the part under the hand's name; a left hand is a right one in the mirror."""
    pose = part.actor_from_shape
    if is_left:
        # Mirrored in x of the hand and in x of the shape, which looks the same from both sides.
        mirror = np.array([-1.0, 1.0, 1.0])
        rotation = mirror[:, None] * pose[:, :3] * mirror
        pose = np.column_stack([rotation, mirror * pose[:, 3]])
    return replace(part, name=f"{hand}_{part.name}", actor_from_shape=pose)
