"""The preset "payload": how much room a pipe and a power cord need between two payloads.

After section 5 of Lok, Naik, Whitton and Brooks (2003). A shaft opens in the top of a
photon-multiplier box (PMT); payload A hangs above it, payload B stands beside it. A person slides a
pipe of 14 cm upright into the gap between the PMT and payload A, lowers it into the shaft, and then
feeds a power cord down the pipe. The pipe alone asks for its length and some air: what the four
designers of the study allowed for. The first has a stiff cord and pushes it with the fingers; the
others need tongs, which stand on end above the pipe, with the hand about them.

All that is real is here; the CAD has its own frame above. Heights are above the floor.
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import Pose, compose
from hybridve.hull.synth.meshes import bored_box_mesh, box_mesh
from hybridve.hull.synth.presets.hands import between, fist, limb, pinching_hand
from hybridve.hull.synth.presets.studio import (
    BOARD,
    LAMP,
    Key,
    make_room,
    ring_camera,
    track,
)
from hybridve.hull.synth.shapes import Box, Capsule, Cylinder
from hybridve.hull.synth.stage import (
    Actor,
    CadPart,
    Material,
    Preset,
    PresetOption,
    RealShape,
    Spacing,
    Stage,
    pose_at,
)

#: The axis of the shaft, and the height of the PMT's top, metres.
_SHAFT = (0.37, 0.18)
_TOP_M = 0.72

_PMT_MM = (240.0, 200.0, 220.0)
_BORE_RADIUS_MM, _BORE_DEPTH_MM, _BORE_SIDES = 32.0, 100.0, 24

_PAYLOAD_A_MM = (240.0, 200.0, 160.0)
_PAYLOAD_B_MM = (140.0, 200.0, 320.0)

#: The pipe of the paper, 14 cm by 4 cm.
_PIPE_M, _PIPE_RADIUS_M = 0.140, 0.020

#: In place, the pipe stands this high above the floor of the shaft.
_PIPE_AIR_M = 0.008

#: The height of the pipe's upper end when it is in place.
_RIM_M = _TOP_M - _BORE_DEPTH_MM / 1000.0 + _PIPE_AIR_M + _PIPE_M

#: The hand holds the pipe so far above its middle.
_GRIP_M = 0.046

_CORD_RADIUS_M, _CORD_LINK_M, _CORD_LINKS = 0.004, 0.045, 11

#: From the tips of the tongs to the round end at their hinge, and its radius.
_TONGS_M, _HINGE_RADIUS_M = 0.150, 0.006

#: How far below the hinge the fist closes about the tongs.
_FIST_BELOW_M = 0.052

#: For each participant: how far above the PMT the pipe passes; how far above the pipe's rim the
#: cord's tip arrives; how steeply the forearm rises away from the hand. The first uses no tool.
_PARTICIPANTS: dict[int, tuple[float, float, float]] = {
    1: (0.005, 0.010, 0.10),
    2: (0.006, 0.016, 0.00),
    3: (0.005, 0.014, -0.12),
    4: (0.007, 0.021, 0.06),
}

#: Payload A is shifted straight up.
_ALONG = (0.0, 0.0, 1.0)
_SHIFTS_M = (-0.1, 0.2)

# Red and blue as in the paper's diagram of the task.
_PVC = Material((40.0, 44.0, 196.0), (58.0, 84.0, 214.0), 0.05)
_RUBBER = Material((190.0, 60.0, 24.0), (210.0, 84.0, 40.0), 0.012)
_STEEL = Material((66.0, 62.0, 58.0), (92.0, 88.0, 84.0), 0.04)
_GRIPS = Material((36.0, 150.0, 60.0), (50.0, 170.0, 74.0), 0.02)


def make_stage(participant: int, gap_mm: float) -> Stage:
    """Return the stage: `participant` from 1 to 4, payload A `gap_mm` above the PMT."""
    pipe_air_m, lift_m, rise = _PARTICIPANTS[participant]
    pipe, left = _pipe_and_hand(pipe_air_m)
    feed = _cord_by_hand if participant == 1 else _cord_by_tongs
    # Two cameras stand level with the gap, a quarter of a turn apart: from above, nothing tells how
    # high the upper end of a thing reaches.
    return Stage(
        cameras=(
            ring_camera("cam1", 640, 480, 34.0, 2.15, 1.00, (588.0, -0.24, 0.065)),
            ring_camera("cam2", 640, 480, 128.0, 2.30, 1.75, (602.0, -0.27, 0.085)),
            ring_camera("cam3", 640, 480, 217.0, 2.25, 2.00, (592.0, -0.22, 0.055)),
            ring_camera("cam4", 640, 480, 305.0, 2.10, 0.95, (580.0, -0.29, 0.100)),
        ),
        board=BOARD,
        room=make_room(),
        lamp=LAMP,
        actors=(pipe, left, *feed(lift_m, rise)),
        parts=_parts(gap_mm),
        spacings=(Spacing("payload_a", _ALONG, _SHIFTS_M, gap_mm / 1000.0),),
    )


def _parts(gap_mm: float) -> tuple[CadPart, ...]:
    x, y, top = 1000.0 * _SHAFT[0], 1000.0 * _SHAFT[1], 1000.0 * _TOP_M
    return (
        CadPart(
            "pmt",
            bored_box_mesh(_PMT_MM, _BORE_RADIUS_MM, _BORE_DEPTH_MM, _BORE_SIDES, 45.0),
            (x, y, top - _PMT_MM[2] / 2),
            required_clearance_mm=2.0,
            comment="The photon-multiplier box; its shaft opens in the middle of its top.",
        ),
        CadPart(
            "payload_a",
            box_mesh(_PAYLOAD_A_MM, 40.0),
            (x, y, top + gap_mm + _PAYLOAD_A_MM[2] / 2),
            required_clearance_mm=5.0,
            comment=(
                f"It hangs above the PMT; between their facing sides lie {gap_mm:g} mm.\n"
                "To make room, shift it along 0,0,1: each millimetre widens the gap by one."
            ),
        ),
        CadPart(
            "payload_b",
            box_mesh(_PAYLOAD_B_MM, 40.0),
            (x + _PMT_MM[0] / 2 + 90.0 + _PAYLOAD_B_MM[0] / 2, y, top - 60.0),
            required_clearance_mm=10.0,
            comment="It stands beside the PMT, 90 mm away, and 100 mm taller.",
        ),
    )


def _pipe_and_hand(air_m: float) -> tuple[Actor, Actor]:
    """Return the pipe and the hand that carries, turns and lowers it, and lets it go."""
    x, y = _SHAFT
    above = _TOP_M + air_m + _PIPE_M / 2
    in_place = _RIM_M - _PIPE_M / 2
    carried = track(
        (
            Key(0.00, (x - 0.10, y - 0.56, above + 0.03), (0.0, -78.0, 0.0)),
            Key(0.10, (x - 0.04, y - 0.42, above + 0.02), (0.0, -70.0, 0.0)),
            Key(0.21, (x, y - 0.30, above), (0.0, 0.0, 0.0)),
            Key(0.31, (x, y, above), (0.0, 0.0, 0.0)),
            Key(0.43, (x, y, in_place), (0.0, 0.0, 0.0)),
        )
    )
    leaving = track(
        (
            Key(0.43, (x, y, in_place)),
            Key(0.55, (x - 0.22, y - 0.50, in_place + 0.02), (0.0, 0.0, 6.0)),
            Key(0.66, (x - 0.30, y - 1.25, in_place), (0.0, 0.0, 10.0)),
        )
    )
    grip = pose_at((0.0, 0.0, _GRIP_M))
    pipe = Actor(
        (RealShape("pipe", Cylinder(_PIPE_M / 2, _PIPE_RADIUS_M), pose_at((0, 0, 0)), _PVC),),
        carried,
    )
    hand = Actor(
        pinching_hand("left", _PIPE_RADIUS_M, rise=0.10, is_left=True),
        lambda moment: compose((carried if moment < 0.43 else leaving)(moment), grip),
    )
    return pipe, hand


def _cord_by_hand(lift_m: float, rise: float) -> tuple[Actor, ...]:
    """Return a stiff cord and the hand that pushes it down the pipe, a stroke at a time."""
    x, y = _SHAFT
    below_m = 0.050  # from the fingers to the cord's tip, at first
    ready = _RIM_M + lift_m + below_m
    low = _RIM_M + 0.020
    motion = track(
        (
            Key(0.46, (x + 0.30, y - 1.25, ready), (0.0, 0.0, -10.0)),
            Key(0.58, (x + 0.02, y - 0.34, ready), (0.0, 0.0, -4.0)),
            Key(0.66, (x, y, ready)),
            Key(0.73, (x, y, low)),
            Key(0.78, (x, y, ready)),
            Key(0.85, (x, y, low)),
            Key(1.00, (x + 0.02, y - 0.30, ready), (0.0, 0.0, -4.0)),
        )
    )
    fed_m = ready - low  # by each stroke

    def cord(moment: float) -> NDArray[np.float64]:
        hand = motion(moment)[:, 3]
        if moment <= 0.73:
            tip = hand - [0.0, 0.0, below_m]
        elif moment <= 0.78:  # the fingers go back up alone
            tip = np.array([x, y, low - below_m])
        elif moment <= 0.85:
            tip = hand - [0.0, 0.0, below_m + fed_m]
        else:
            tip = np.array([x, y, low - below_m - fed_m])
        bend = max(float(hand[2]), _RIM_M + 0.016) if moment <= 0.85 else _RIM_M + 0.020
        return _links(tip, bend)

    hand = Actor(pinching_hand("right", _CORD_RADIUS_M, rise=rise, is_left=False), motion)
    return (hand, *_cord(cord))


def _cord_by_tongs(lift_m: float, rise: float) -> tuple[Actor, ...]:
    """Return a limp cord, tongs that hold its plug, and the fist about them."""
    x, y = _SHAFT
    ready = _RIM_M + lift_m  # of the tips
    plugged = _RIM_M - 0.050  # the fist stops short of the rim
    motion = track(
        (
            Key(0.46, (x + 0.30, y - 1.25, ready), (-8.0, 6.0, -8.0)),
            Key(0.58, (x + 0.04, y - 0.34, ready), (-8.0, 6.0, -4.0)),
            Key(0.68, (x, y, ready)),
            Key(0.78, (x, y, plugged)),
            Key(0.82, (x, y, plugged)),
            Key(0.90, (x, y, _RIM_M + 0.010)),
            Key(1.00, (x + 0.02, y - 0.34, ready), (-6.0, 4.0, -4.0)),
        )
    )

    def cord(moment: float) -> NDArray[np.float64]:
        tip = motion(min(moment, 0.80))[:, 3]
        return _links(tip, max(float(tip[2]) + 0.016, _RIM_M + 0.016))

    hinge = (0.0, 0.0, _TONGS_M)
    tongs = (
        limb("tongs_hinge", (0.0, 0.0, _TONGS_M - 0.07), hinge, _HINGE_RADIUS_M, _STEEL),
        *(
            RealShape(
                f"tongs_{which}",
                Box(0.0025, 0.004, 0.045),
                between((side * 0.0045, 0.0, 0.0), (side * 0.010, 0.0, 0.088)),
                _STEEL,
            )
            for which, side in (("a", -1.0), ("b", 1.0))
        ),
        limb("plug", (0.0, 0.0, 0.003), (0.0, 0.0, 0.014), 0.0065, _GRIPS),
    )
    at_fist = pose_at((0.0, 0.0, _TONGS_M - _FIST_BELOW_M))
    hand = tuple(
        RealShape(part.name, part.shape, compose(at_fist, part.actor_from_shape), part.material)
        for part in fist("right", rise=rise, is_left=False)
    )
    return (Actor((*tongs, *hand), motion), *_cord(cord))


def _links(tip: NDArray[np.float64], bend_m: float) -> NDArray[np.float64]:
    """Return the joints of the cord, (N + 1, 3): straight up from its tip, then over and away.

    It bends at the height `bend_m` towards the person, and hangs.
    """
    radius = 0.020
    away = np.array([-0.45, -0.80, 0.0]) / np.hypot(0.45, 0.80)
    upright = max(bend_m - float(tip[2]), 0.0)
    over = 0.5 * np.pi * radius
    along = _CORD_LINK_M * np.arange(_CORD_LINKS + 1)
    joints = np.zeros((len(along), 3))
    joints[:] = tip
    joints[:, 2] += np.minimum(along, upright)
    angle = np.clip((along - upright) / radius, 0.0, 0.5 * np.pi)
    joints += radius * (1.0 - np.cos(angle))[:, None] * away
    joints[:, 2] += radius * np.sin(angle)
    rest = np.maximum(along - upright - over, 0.0)
    # A parabola of that length would need an integral; each link is laid in its own direction.
    for index in np.flatnonzero(rest > 0):
        step = along[index] - max(along[index - 1], upright + over)
        droop = min(2.2 * rest[index], 1.3)
        direction = np.cos(droop) * away - np.sin(droop) * np.array([0.0, 0.0, 1.0])
        before = joints[index - 1]
        if rest[index - 1] == 0:
            before = tip + radius * away + np.array([0.0, 0.0, upright + radius])
        joints[index] = before + step * direction
    return joints


def _cord(joints: Callable[[float], NDArray[np.float64]]) -> tuple[Actor, ...]:
    """Return a chain of capsules between joints that move."""
    joints = lru_cache(maxsize=4)(joints)  # each link asks for the same moment

    def link(number: int) -> Actor:
        def pose(moment: float) -> Pose:
            both = joints(moment)[number : number + 2]
            return between(both[0], both[1])

        shape = Capsule(_CORD_LINK_M / 2, _CORD_RADIUS_M)
        return Actor((RealShape(f"cord_{number + 1}", shape, pose_at((0, 0, 0)), _RUBBER),), pose)

    return tuple(link(number) for number in range(_CORD_LINKS))


#: The recording.
PAYLOAD = Preset(
    description=(
        "A pipe is lowered between two payloads into a shaft and a power cord fed down it, "
        "with or without a tool."
    ),
    n_frames=48,
    fps=10.0,
    make_stage=make_stage,
    options=(
        PresetOption("participant", 1, 1, 4, is_whole=True),
        PresetOption("gap_mm", 150.0, 60.0, 400.0),
    ),
)
