"""The preset "curtain": two hands that push at a virtual curtain, as in figure 4 of the paper.

The curtain hangs in folds before a window frame: an open sheet of 720 triangles and 399 vertices,
as many as the paper's. It gives way along y, away from the person.
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
            CadPart(
                "curtain",
                sheet_mesh((760.0, 840.0), (18, 20), 12.0, 3),
                (mm[0], mm[1], mm[2]),
                recovery_direction=(0.0, 1.0, 0.0),
                comment="An open sheet: it has no inside. It gives way along y only.",
                effect='kind = "cloth"\nobject = "curtain"\nareal_density_kg_m2 = 0.2\npin = "top"',
            ),
            CadPart(
                "window",
                frame_mesh((880.0, 50.0, 960.0), 50.0, 60.0),
                (mm[0], mm[1] + 60.0, mm[2]),
                required_clearance_mm=20.0,
            ),
        ),
    )


def _hand(name: str, side: float) -> Actor:
    """Return a hand on one side, 1 for right: on edge, its back outwards, the fingers lead."""
    x, y, z = _MIDDLE
    reach = track(
        tuple(
            Key(moment, (x + side * out, y + along, z + up), (0.0, side * 82.0, -side * turn))
            for moment, out, along, up, turn in (
                (0.00, 0.08, -0.52, -0.12, 4.0),
                (0.28, 0.05, 0.07, -0.05, 0.0),
                (0.58, 0.20, 0.11, -0.02, 12.0),
                (0.78, 0.22, -0.26, -0.06, 8.0),
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
    description="Two hands push at a virtual curtain in a window, and withdraw.",
    n_frames=48,
    fps=25.0,
    make_stage=make_stage,
)
