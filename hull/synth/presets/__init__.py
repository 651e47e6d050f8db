"""The recordings that can be generated, by name."""

from hybridve.hull.synth.presets.ball import BALL
from hybridve.hull.synth.presets.bounce import BOUNCE
from hybridve.hull.synth.presets.boxes import BOXES, BOXES_PASSING_CLEARANCE_M
from hybridve.hull.synth.presets.curtain import CURTAIN
from hybridve.hull.synth.presets.payload import PAYLOAD
from hybridve.hull.synth.stage import Preset

__all__ = ["BOXES_PASSING_CLEARANCE_M", "PRESETS"]

#: The recordings by name.
PRESETS: dict[str, Preset] = {
    "boxes": BOXES,
    "payload": PAYLOAD,
    "ball": BALL,
    "curtain": CURTAIN,
    "bounce": BOUNCE,
}
