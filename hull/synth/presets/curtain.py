"""The preset "curtain": two hands that part a virtual curtain, as in figure 4 of the paper.

The curtain hangs in folds before a window frame, in two panels that meet in the middle: open sheets
of 720 triangles together, as many as the paper's, and 420 vertices. Each gives way to its own side:
the hands come in between the two and draw apart.
"""

from hybridve.calib.pose import compose
from hybridve.hull.synth.meshes import frame_mesh, sheet_mesh
from hybridve.hull.synth.presets.hands import pinching_hand
from hybridve.hull.synth.presets.studio import (
    BOARD,
    LAMP,
    Key,
    make_room,
    ring_camera,
    track,
)
from hybridve.hull.synth.stage import Actor, CadPart, Preset, Stage, pose_at

#: The middle of the window, metres.
_MIDDLE = (0.37, 0.26, 0.72)

#: How wide each panel is, and half the gap between the two, millimetres.
_WIDTH_MM, _GAP_MM = 376.0, 4.0


def make_stage() -> Stage:
    """Return the stage."""
    hands = (_hand("right", 1.0), _hand("left", -1.0))
    mm = tuple(1000.0 * value for value in _MIDDLE)
    return Stage(
        cameras=(
            ring_camera("cam1", 640, 480, 34.0, 2.15, 1.85, (588.0, -0.24, 0.065)),
            ring_camera("cam2", 640, 480, 128.0, 2.30, 1.60, (602.0, -0.27, 0.085)),
            ring_camera("cam3", 640, 480, 217.0, 2.25, 2.05, (592.0, -0.22, 0.055)),
            ring_camera("cam4", 640, 480, 305.0, 2.10, 1.70, (580.0, -0.29, 0.100)),
        ),
        board=BOARD,
        room=make_room(),
        lamp=LAMP,
        actors=hands,
        parts=(
            _panel("curtain_left", -1.0),
            _panel("curtain_right", 1.0),
            CadPart(
                "window",
                frame_mesh((880.0, 50.0, 960.0), 50.0, 60.0),
                (mm[0], mm[1] + 60.0, mm[2]),
                required_clearance_mm=20.0,
            ),
        ),
    )


def _panel(name: str, side: float) -> CadPart:
    """Return the panel on one side, 1 for right."""
    x, y, z = (1000.0 * value for value in _MIDDLE)
    return CadPart(
        name,
        sheet_mesh((_WIDTH_MM, 840.0), (9, 20), 12.0, 2),
        (x + side * (_GAP_MM + _WIDTH_MM / 2.0), y, z),
        recovery_direction=(side, 0.0, 0.0),
        comment="An open sheet: it has no inside. It gives way to its own side only.",
        effect=f'kind = "cloth"\nobject = "{name}"\nareal_density_kg_m2 = 0.2\npin = "top"',
    )


def _hand(name: str, side: float) -> Actor:
    """Return a hand on one side, 1 for right: on edge, its back outwards, the fingers lead."""
    x, y, z = _MIDDLE
    reach = track(
        tuple(
            Key(moment, (x + side * out, y + along, z + up), (0.0, side * 82.0, -side * turn))
            for moment, out, along, up, turn in (
                (0.00, 0.07, -0.52, -0.12, 4.0),
                (0.22, 0.022, 0.02, -0.05, 0.0),
                (0.30, 0.022, 0.07, -0.04, 0.0),
                (0.56, 0.24, 0.09, -0.02, 10.0),
                (0.70, 0.25, 0.09, -0.02, 10.0),
                (0.84, 0.24, -0.26, -0.06, 8.0),
                (1.00, 0.10, -0.55, -0.14, 4.0),
            )
        )
    )
    flat = pose_at((-side * 0.03, 0.0, 0.0))
    return Actor(
        pinching_hand(name, 0.012, rise=0.08, is_left=side < 0),
        lambda moment: compose(reach(moment), flat),
    )


#: The recording.
CURTAIN = Preset(
    description="Two hands part a virtual curtain in a window, and withdraw.",
    n_frames=48,
    fps=25.0,
    make_stage=make_stage,
)
