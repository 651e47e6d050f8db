"""Recordings with known truth, made by code.

A preset says what there is: cameras around a room, a chessboard, real things in motion, CAD parts
among them. From it come the files a real session has (stills of the board, the board on the floor,
the empty room, the task; rendered through the true lens, with noise, flicker and soft shadows), and
truth.h5, which says of every frame what the real shapes touched, how deep, how near, and which
pixels show them; when contacts began; the same of the hull that perfect silhouettes would carve;
and how much room the task needs.
"""

from hybridve.hull.synth.presets import BOXES_PASSING_CLEARANCE_M, PRESETS
from hybridve.hull.synth.stage import Preset
from hybridve.hull.synth.truth import ObjectTruth, SpacingTruth, Truth, read_truth, true_masks
from hybridve.hull.synth.write import write_session

__all__ = [
    "BOXES_PASSING_CLEARANCE_M",
    "PRESETS",
    "ObjectTruth",
    "Preset",
    "SpacingTruth",
    "Truth",
    "read_truth",
    "true_masks",
    "write_session",
]
