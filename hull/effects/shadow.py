"""What real things shade on the CAD, from a lamp of the scene: a share of each triangle.

See `hybridve.hull.effects.lamp`.
"""

from typing import Any

from numpy.typing import NDArray

from hybridve.hull.effects.effect import EffectKind, Entry, Told
from hybridve.hull.effects.lamp import (
    Lamp,
    Lamps,
    LampTable,
    Lit,
    about_of,
    columns_of,
    values_of,
)


class Shadow(Lamps):
    """All shadows of a scene; an `Effect`."""

    def _tell(self, lamp: Lamp, entry: Entry) -> Told:
        return Told(columns_of(lamp), lamp.drawn("share_lit"), about=about_of(lamp, entry))

    def _values(self, name: str, lit: Lit) -> dict[str, NDArray[Any]]:
        return values_of(self.lamps[name], lit)


KIND = EffectKind("shadow", LampTable, Shadow)
