"""The preset "curtain": a hand that pushes through a virtual curtain, as in figure 4 of the paper.

The curtain hangs in folds before a window frame: an open sheet of 720 triangles, as many as the
paper's. It gives way along y, away from the person.
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


def make_stage() -> Stage:
    """Return the stage."""
    x, y, z = _MIDDLE
    # The hand is turned on edge, little finger down; its fingers lead.
    reach = track(
        (
            Key(0.00, (x + 0.05, y - 0.50, z - 0.10), (0.0, 80.0, -6.0)),
            Key(0.30, (x - 0.04, y + 0.10, z + 0.04), (0.0, 84.0, 0.0)),
            Key(0.55, (x + 0.20, y + 0.12, z + 0.08), (0.0, 84.0, -14.0)),
            Key(0.75, (x + 0.22, y - 0.26, z + 0.02), (0.0, 80.0, -10.0)),
            Key(1.00, (x + 0.05, y - 0.55, z - 0.12), (0.0, 80.0, -6.0)),
        )
    )
    flat = pose_at((-0.03, 0.0, 0.0))
    hand = Actor(
        pinching_hand("right", 0.012, rise=0.08, is_left=False),
        lambda moment: compose(reach(moment), flat),
    )
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
        actors=(hand,),
        parts=(
            CadPart(
                "curtain",
                sheet_mesh((760.0, 840.0), (24, 15), 12.0, 4),
                (mm[0], mm[1], mm[2]),
                recovery_direction=(0.0, 1.0, 0.0),
                comment="An open sheet: it has no inside. It gives way along y only.",
            ),
            CadPart(
                "window",
                frame_mesh((880.0, 50.0, 960.0), 50.0, 60.0),
                (mm[0], mm[1] + 60.0, mm[2]),
                required_clearance_mm=20.0,
            ),
        ),
    )


#: The recording.
CURTAIN = Preset(
    description="A hand pushes through a virtual curtain in a window, and aside, and withdraws.",
    n_frames=48,
    fps=25.0,
    make_stage=make_stage,
)
