"""The preset "boxes": an arm, a ball and a carton among four CAD parts."""

import numpy as np

from hybridve.calib.pose import Pose
from hybridve.hull.synth.meshes import box_mesh, bracket_mesh
from hybridve.hull.synth.presets.studio import (
    BOARD,
    LAMP,
    make_room,
    ring_camera,
    there_and_back,
)
from hybridve.hull.synth.shapes import Ball, Box, Capsule
from hybridve.hull.synth.stage import (
    Actor,
    CadPart,
    Material,
    Preset,
    RealShape,
    Stage,
    pose_at,
)

#: How far the ball passes payload_b, metres: it moves along the face, so this is exact.
BOXES_PASSING_CLEARANCE_M = 0.05


def make_stage() -> Stage:
    """Return the stage of the preset "boxes".

    An arm reaches into payload_a and withdraws; a ball on a rod passes payload_b at a constant
    distance; a carton touches the bracket with its edge; nothing comes near the shelf.
    """
    skin = Material((128.0, 152.0, 208.0), (112.0, 136.0, 196.0), 0.031, (0.8, 0.6, 0.0))
    sleeve = Material((142.0, 82.0, 48.0), (158.0, 98.0, 60.0), 0.09)
    orange = Material((34.0, 96.0, 226.0), (48.0, 168.0, 240.0), 0.06, (0.6, 0.0, 0.8))
    steel = Material((62.0, 58.0, 54.0), (88.0, 84.0, 80.0), 0.04)
    pasteboard = Material((70.0, 112.0, 158.0), (84.0, 128.0, 172.0), 0.045, (0.0, 1.0, 0.0))

    # Shapes of the arm lie along its x axis, the fist at the origin.
    def along_x(middle_m: float) -> Pose:
        return pose_at((middle_m, 0.0, 0.0), (0.0, 90.0, 0.0))

    arm = Actor(
        (
            RealShape("fist", Ball(0.05), pose_at((0.0, 0.0, 0.0)), skin),
            RealShape("forearm", Capsule(0.13, 0.036), along_x(-0.16), skin),
            RealShape("sleeve", Capsule(0.11, 0.05), along_x(-0.38), sleeve),
        ),
        lambda moment: pose_at(
            np.array([-0.28, 0.04, 0.86])
            + there_and_back(moment, 0.5) * np.array([0.34, 0.13, -0.12]),
            (0.0, 14.0, 18.0 - 16.0 * there_and_back(moment, 0.5)),
        ),
    )
    ball_radius_m = 0.06
    ball = Actor(
        (
            RealShape("ball", Ball(ball_radius_m), pose_at((0.0, 0.0, 0.0)), orange),
            RealShape("rod", Capsule(0.16, 0.009), pose_at((0.09, 0.0, 0.185), (0, 26, 0)), steel),
        ),
        # Along the face of payload_b at x = 0.72.
        lambda moment: pose_at(
            (
                0.72 + BOXES_PASSING_CLEARANCE_M + ball_radius_m,
                0.78 - 1.1 * moment,
                0.62 + 0.03 * np.sin(2 * np.pi * moment),
            )
        ),
    )
    carton = Actor(
        (RealShape("carton", Box(0.075, 0.055, 0.045), pose_at((0.0, 0.0, 0.0)), pasteboard),),
        lambda moment: pose_at(
            np.array([0.62, -0.72, 0.98])
            + there_and_back(moment, 0.72) * np.array([-0.185, 0.335, -0.33]),
            (12.0 + 10.0 * moment, 8.0 - 14.0 * moment, 25.0 + 50.0 * moment),
        ),
    )
    parts = (
        CadPart(
            "payload_a",
            box_mesh((240.0, 180.0, 160.0), 30.0),
            (160.0, 200.0, 720.0),
            required_clearance_mm=10.0,
        ),
        CadPart(
            "payload_b",
            box_mesh((200.0, 160.0, 140.0), 30.0),
            (620.0, 250.0, 620.0),
            required_clearance_mm=25.0,
        ),
        CadPart(
            "bracket",
            bracket_mesh((160.0, 120.0, 140.0), 30.0, 25.0),
            (430.0, -350.0, 560.0),
            (10.0, -15.0, 35.0),
        ),
        CadPart("shelf", box_mesh((600.0, 250.0, 20.0), 40.0), (-350.0, 1000.0, 350.0)),
    )
    return Stage(
        cameras=(
            ring_camera("cam1", 640, 480, 34.0, 2.15, 1.85, (588.0, -0.24, 0.065)),
            ring_camera("cam2", 640, 480, 128.0, 2.30, 1.60, (602.0, -0.27, 0.085)),
            ring_camera("cam3", 800, 600, 217.0, 2.25, 2.05, (740.0, -0.22, 0.055)),
            ring_camera("cam4", 640, 480, 305.0, 2.10, 1.70, (580.0, -0.29, 0.100)),
        ),
        board=BOARD,
        room=make_room(),
        lamp=LAMP,
        actors=(arm, ball, carton),
        parts=parts,
    )


#: The recording.
BOXES = Preset(
    description="An arm, a ball and a carton move among four CAD parts, seen by four cameras.",
    n_frames=48,
    fps=25.0,
    make_stage=make_stage,
)
