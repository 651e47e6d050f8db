"""The preset "ball": real blocks about a virtual ball, as in figure 5 of the paper.

Two blocks stand still. A hand pushes a third over the floor against the ball and draws it back; its
face is square to the way it goes and meets a corner of the ball's mesh, so that the instant of
contact has a closed form. Another hand sets a fourth down on the ball and lifts it off.
"""

from hybridve.calib.pose import compose
from hybridve.hull.synth.meshes import ball_mesh
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
from hybridve.hull.synth.stage import (
    Actor,
    CadPart,
    Material,
    Preset,
    RealShape,
    Stage,
    pose_at,
)

#: The ball hovers a little above the floor, metres.
_CENTER = (0.37, 0.18, 0.13)
_RADIUS_M = 0.09

#: How deep the pushed block goes, and half its length along its way.
_PUSH_M, _PUSHED_HALF_M = 0.012, 0.04

#: When the pushed block starts, is deepest, and is back.
_START, _DEEPEST, _BACK = 0.05, 0.36, 0.60

#: How far it goes.
_WAY_M = 0.22

_RED = Material((40.0, 44.0, 190.0), (52.0, 60.0, 210.0), 0.05)
_BLUE = Material((180.0, 84.0, 36.0), (200.0, 104.0, 50.0), 0.05, (1.0, 0.0, 0.0))
_GREEN = Material((70.0, 150.0, 40.0), (84.0, 172.0, 56.0), 0.05, (0.0, 1.0, 0.0))
_YELLOW = Material((40.0, 190.0, 226.0), (58.0, 206.0, 236.0), 0.05, (1.0, 0.0, 0.0))


def make_stage() -> Stage:
    """Return the stage."""
    x, y, z = _CENTER
    deepest = y - _RADIUS_M + _PUSH_M - _PUSHED_HALF_M
    on_floor = 0.075
    pushed = track(
        (
            Key(_START, (x, deepest - _WAY_M, on_floor)),
            Key(_DEEPEST, (x, deepest, on_floor)),
            Key(_BACK, (x, deepest - _WAY_M, on_floor)),
        )
    )
    top = z + _RADIUS_M + 0.035
    set_down = track(
        (
            Key(0.35, (x + 0.42, y - 0.46, top + 0.24), (0.0, 0.0, 40.0)),
            Key(0.62, (x + 0.03, y + 0.02, top + 0.05), (0.0, 0.0, 18.0)),
            Key(0.72, (x + 0.03, y + 0.02, top - 0.004), (0.0, 0.0, 18.0)),
            Key(0.80, (x + 0.03, y + 0.02, top + 0.05), (0.0, 0.0, 18.0)),
            Key(1.00, (x + 0.30, y - 0.42, top + 0.20), (0.0, 0.0, 40.0)),
        )
    )
    behind = pose_at((0.0, -0.035, 0.045), (-28.0, 0.0, 0.0))
    above = pose_at((0.0, 0.0, 0.018))
    actors = (
        _block("red", Box(0.06, 0.05, 0.09), (x - 0.23, y + 0.06, 0.09), 20.0, _RED),
        _block("blue", Box(0.09, 0.04, 0.06), (x + 0.07, y + 0.26, 0.06), -25.0, _BLUE),
        Actor(
            (RealShape("green", Box(0.05, _PUSHED_HALF_M, 0.075), pose_at((0, 0, 0)), _GREEN),),
            pushed,
        ),
        Actor(
            pinching_hand("left", 0.05, rise=0.0, is_left=True),
            lambda moment: compose(pushed(moment), behind),
        ),
        Actor(
            (RealShape("yellow", Box(0.035, 0.05, 0.035), pose_at((0, 0, 0)), _YELLOW),), set_down
        ),
        Actor(
            pinching_hand("right", 0.035, rise=0.30, is_left=False),
            lambda moment: compose(set_down(moment), above),
        ),
    )
    return Stage(
        cameras=(
            ring_camera("cam1", 640, 480, 34.0, 2.00, 1.45, (588.0, -0.24, 0.065)),
            ring_camera("cam2", 640, 480, 128.0, 2.10, 1.30, (602.0, -0.27, 0.085)),
            ring_camera("cam3", 640, 480, 217.0, 2.05, 1.60, (592.0, -0.22, 0.055)),
            ring_camera("cam4", 640, 480, 305.0, 2.00, 1.40, (580.0, -0.29, 0.100)),
        ),
        board=BOARD,
        room=make_room(),
        lamp=LAMP,
        actors=actors,
        parts=(
            CadPart(
                "ball",
                ball_mesh(1000.0 * _RADIUS_M, 3),
                (1000.0 * x, 1000.0 * y, 1000.0 * z),
                required_clearance_mm=10.0,
            ),
        ),
    )


def _block(
    name: str, shape: Box, position: tuple[float, float, float], yaw_deg: float, color: Material
) -> Actor:
    """Return a block that stands still."""
    still = pose_at(position, (0.0, 0.0, yaw_deg))
    return Actor((RealShape(name, shape, pose_at((0, 0, 0)), color),), lambda _: still)


#: The recording.
BALL = Preset(
    description="Blocks stand about a virtual ball, are pushed against it and set down on it.",
    n_frames=48,
    fps=25.0,
    make_stage=make_stage,
)
