"""How a calibration is done, and what is asked of single lenses."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.placing.marks import Mark
from hybridve.calib.seeing.inputs import ObserveSettings
from hybridve.calib.solving.lens_fit import LensSettings


@dataclass(frozen=True, slots=True)
class CalibrationSettings:
    """How a calibration is done; the defaults serve.

    Attributes
    ----------
    observe : ObserveSettings
        How pictures are searched.
    lens : LensSettings
        How lenses are fitted.
    world : "board", "points" or "floor"
        What defines the world: the board (z up from its printed side), points whose places are
        known, or the floor.
    marks : tuple of Mark
        Points for the latter two.
    sync : "given" or "estimate"
        Whether the cameras' clocks are to be trusted, frame by frame.
    box_world : two (3,) float64, optional
        The lowest and the highest corner of the working volume, metres; by default what the
        cameras look at.
    """

    observe: ObserveSettings = field(default_factory=ObserveSettings)
    lens: LensSettings = field(default_factory=LensSettings)
    world: Literal["board", "points", "floor"] = "board"
    marks: tuple[Mark, ...] = ()
    sync: Literal["given", "estimate"] = "given"
    box_world: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class LensRequest:
    """What is asked of one camera's lens beyond its model.

    Attributes
    ----------
    group : str or None
        Cameras of one group share a lens.
    params : tuple of float, or None
        Its parameters, if they are known.
    """

    group: str | None = None
    params: tuple[float, ...] | None = None
