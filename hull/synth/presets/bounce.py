"""The preset "bounce": a virtual ball thrown among real blocks, as in figure 5 of the paper.

Six blocks stand in a ring on the floor; the ball rolls and bounces between them on a virtual table
top that lies on the floor. A hand pushes one of the blocks inward while the ball is on its way.
"""

import numpy as np

from hybridve.calib.pose import compose
from hybridve.hull.synth.meshes import ball_mesh, box_mesh
from hybridve.hull.synth.presets.hands import pinching_hand
from hybridve.hull.synth.presets.studio import (
    BOARD,
    LAMP,
    Key,
    make_room,
    ring_camera,
    track,
)
from hybridve.hull.synth.shapes import Box
from hybridve.hull.synth.stage import Actor, CadPart, Material, Preset, RealShape, Stage, pose_at

#: The middle of the ring, how far the blocks' inner faces are from it, and half their size, metres.
_MIDDLE, _INNER_M = (0.37, 0.18), 0.26
_HALF_M = (0.13, 0.03, 0.055)

_BALL_M = 0.05

#: How far the block before the hand is pushed in.
_PUSH_M = 0.06

_COLOURS = (
    Material((40.0, 44.0, 190.0), (52.0, 60.0, 210.0), 0.05),
    Material((180.0, 84.0, 36.0), (200.0, 104.0, 50.0), 0.05, (1.0, 0.0, 0.0)),
    Material((70.0, 150.0, 40.0), (84.0, 172.0, 56.0), 0.05, (0.0, 1.0, 0.0)),
)


def make_stage() -> Stage:
    """Return the stage."""
    actors = [_block(number) for number in range(1, 6)]
    outward = np.array([0.0, -1.0])
    rest = np.array(_MIDDLE) + (_INNER_M + _HALF_M[1]) * outward
    pushed_in = rest - _PUSH_M * outward
    on_floor = _HALF_M[2]
    pushed = track(
        (
            Key(0.30, (*rest.tolist(), on_floor)),
            Key(0.42, (*pushed_in.tolist(), on_floor)),
            Key(0.80, (*pushed_in.tolist(), on_floor)),
            Key(1.00, (*rest.tolist(), on_floor)),
        )
    )
    behind = pose_at((0.0, -_HALF_M[1] + 0.005, 0.03), (-28.0, 0.0, 0.0))
    actors += [
        Actor((RealShape("block0", Box(*_HALF_M), pose_at((0, 0, 0)), _COLOURS[0]),), pushed),
        Actor(
            pinching_hand("left", 0.05, rise=0.0, is_left=True),
            lambda moment: compose(pushed(moment), behind),
        ),
    ]
    x, y = (1000.0 * at for at in _MIDDLE)
    return Stage(
        cameras=(
            ring_camera("cam1", 640, 480, 34.0, 2.00, 1.65, (588.0, -0.24, 0.065)),
            ring_camera("cam2", 640, 480, 128.0, 2.10, 1.55, (602.0, -0.27, 0.085)),
            ring_camera("cam3", 640, 480, 217.0, 2.05, 1.75, (592.0, -0.22, 0.055)),
            ring_camera("cam4", 640, 480, 305.0, 2.00, 1.60, (580.0, -0.29, 0.100)),
        ),
        board=BOARD,
        room=make_room(),
        lamp=LAMP,
        actors=tuple(actors),
        parts=(
            CadPart(
                "ball",
                ball_mesh(1000.0 * _BALL_M, 3),
                (x - 60.0, y - 20.0, 1000.0 * _BALL_M + 2.0),
                comment="Thrown among the blocks: what becomes of it, `hybridve simulate` tells.",
                effect=(
                    'kind = "rigid"\nobject = "ball"\nmass_kg = 0.2\nrestitution = 0.95\n'
                    "friction = 0.1\nvelocity_m_s = [1.3, 0.75, 0.0]"
                ),
            ),
            CadPart(
                "table",
                box_mesh((1100.0, 1100.0, 20.0), 300.0),
                (x, y, -10.0),
                comment="Its top lies in the floor.",
            ),
        ),
    )


def _block(number: int) -> Actor:
    """Return a block of the ring that stands still; number 0 is before the hand."""
    angle = np.radians(60.0 * number - 90.0)
    away = _INNER_M + _HALF_M[1]
    place = (
        _MIDDLE[0] + away * float(np.cos(angle)),
        _MIDDLE[1] + away * float(np.sin(angle)),
        _HALF_M[2],
    )
    still = pose_at(place, (0.0, 0.0, 60.0 * number))
    shape = RealShape(f"block{number}", Box(*_HALF_M), pose_at((0, 0, 0)), _COLOURS[number % 3])
    return Actor((shape,), lambda _: still)


#: The recording.
BOUNCE = Preset(
    description="A virtual ball bounces among real blocks, one of which a hand pushes inward.",
    n_frames=60,
    fps=25.0,
    make_stage=make_stage,
)
