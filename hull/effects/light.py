"""How bright a lamp of the scene makes each triangle of the CAD past whatever real shades it.

The illuminance is I cos / r^2 at each sample that the lamp reaches, and its mean over the triangle;
light that is thrown back from anything is not followed. See `hybridve.hull.effects.lamp`.
"""

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hybridve.hull.effects.effect import EffectKind, Entry, Quantity, Told
from hybridve.hull.effects.lamp import (
    Lamp,
    Lamps,
    LampTable,
    Lit,
    about_of,
    columns_of,
    values_of,
)


class LightTable(LampTable):
    """Keys of ``kind = "light"``: those of a lamp, and one of two that say how bright it is.

    Attributes
    ----------
    power_lm : float or None
        All light that comes out of it, evenly over its cone.
    intensity_cd : float or None
        Or how much of it a steradian.
    """

    power_lm: Annotated[float, Field(gt=0.0)] | None = None
    intensity_cd: Annotated[float, Field(gt=0.0)] | None = None


class Light(Lamps):
    """All light of a scene; an `Effect`."""

    def _tell(self, lamp: Lamp, entry: Entry) -> Told:
        table: LightTable = entry.table
        if (table.power_lm is None) == (table.intensity_cd is None):
            found = "neither" if table.power_lm is None else "both"
            raise entry.error(f"found {found} of power_lm and intensity_cd; give one of them")
        columns = (
            *columns_of(lamp),
            Quantity(
                "illuminance_lx",
                "lx",
                "sampled",
                "how bright the lamp makes each triangle, in the mean over it",
                (len(lamp.areas_m2),),
                np.float32,
            ),
            Quantity(
                "flux_lm",
                "lm",
                "sampled",
                "the light that falls on each object",
                (len(lamp.objects),),
            ),
        )
        about = about_of(lamp, entry) | {"intensity_cd": _intensity(table)}
        return Told(columns, lamp.drawn("illuminance_lx", "share_lit"), about=about)

    def _values(self, name: str, lit: Lit) -> dict[str, NDArray[Any]]:
        lamp = self.lamps[name]
        illuminance_lx = _intensity(self.tables[name]) * lit.gain
        return values_of(lamp, lit) | {
            "illuminance_lx": illuminance_lx.astype(np.float32),
            "flux_lm": lamp.by_object(illuminance_lx),
        }


def _intensity(table: LightTable) -> float:
    """Return what a lamp gives a steradian of its cone, candela."""
    if table.intensity_cd is not None:
        return table.intensity_cd
    if table.power_lm is None:
        raise ValueError("neither power nor intensity is given")
    return table.power_lm / table.solid_angle_sr


KIND = EffectKind("light", LightTable, Light)
