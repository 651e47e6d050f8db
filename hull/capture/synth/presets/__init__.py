"""The recordings that can be generated, by name."""

from hybridve.hull.capture.synth.presets.boxes import BOXES, BOXES_PASSING_CLEARANCE_M
from hybridve.hull.capture.synth.stage import Preset

__all__ = ["BOXES_PASSING_CLEARANCE_M", "PRESETS"]

#: The recordings by name.
PRESETS: dict[str, Preset] = {"boxes": BOXES}
