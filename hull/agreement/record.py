"""What the cameras of a session say about each other, as a report keeps it."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.plain import Told
from hybridve.hull.agreement.blank import rests_on_text

#: Of a picture's shift so much is taken to be in the outlines' stated error, in pixels.
STATED_PX = 1.0


@dataclass(frozen=True, slots=True)
class NamedCause(Told):
    """One thing that is wrong with a session; see `hybridve.hull.agreement.causes.Cause`.

    Attributes
    ----------
    kind : str
        What.
    cameras : tuple of str
        Whose.
    first_frame, last_frame : int
        Numbers of frames of the session.
    is_gross : bool
        Whether nothing that these frames say is to be trusted.
    short : str
        What was found, in a few words.
    message : str
        What was found, what was expected, and what to do: one line.
    size, low, high : float or None
        Of a delay in frames, of a bump in pixels, with a 95 % interval; of a camera that shows one
        and the same (see `hybridve.hull.agreement.blank`) in how many frames it does.
    moved_px : (float, float) or None
        Of a bump.
    before_px, after_px : float or None
        How badly outlines fit, as they are and with the cause undone.
    """

    kind: str
    cameras: tuple[str, ...]
    first_frame: int
    last_frame: int
    is_gross: bool
    short: str
    message: str
    size: float | None = None
    low: float | None = None
    high: float | None = None
    moved_px: tuple[float, float] | None = None
    before_px: float | None = None
    after_px: float | None = None


@dataclass(frozen=True, slots=True)
class CameraAgreement(Told):
    """How one camera's outlines fit those of the others.

    Attributes
    ----------
    misfit_px : float or None
        Mean of what limits of outlines miss each other by, each counted as 15 px at most.
    moved_px, moved_se_px : (float, float) or None
        How far its pictures seem to have moved, and the standard errors; None where nothing tells.
    late_frames, late_se_frames : float or None
        How late they are; None where nobody moved enough to tell.
    excess_px : float
        By how much its outlines may be off beyond what is stated of outlines, at 95 %.
    """

    misfit_px: float | None = None
    moved_px: tuple[float, float] | None = None
    moved_se_px: tuple[float, float] | None = None
    late_frames: float | None = None
    late_se_frames: float | None = None
    excess_px: float = 0.0


@dataclass(frozen=True, slots=True)
class SessionAgreement(Told):
    """What the cameras of a session say about each other.

    Attributes
    ----------
    is_told : bool
        Whether the outlines were enough to say anything.
    causes : tuple of NamedCause
        What is wrong, the worst first.
    cameras : dict of str to CameraAgreement
        By name.
    """

    is_told: bool = False
    causes: tuple[NamedCause, ...] = ()
    cameras: dict[str, CameraAgreement] = field(default_factory=dict)

    @property
    def is_trusted(self) -> bool:
        """Whether what the session says may be believed."""
        return not any(cause.is_gross for cause in self.causes)

    @property
    def distrust(self) -> str:
        """Why it may not, in words; empty if it may."""
        gross = [cause.short for cause in self.causes if cause.is_gross]
        return f"the session is not to be trusted: {'; '.join(gross)}" if gross else ""

    @property
    def rests_on(self) -> str:
        """Which cameras saw nothing at all, on which all that is free rests; in words, or empty."""
        silent = [cause for cause in self.causes if cause.kind == "saw nothing"]
        names = [name for cause in silent for name in cause.cameras]
        return rests_on_text(names, round(silent[0].size or 0)) if silent else ""

    def wrong(self, index: NDArray[np.int64]) -> list[str]:
        """Return of each frame number (F,) why that frame is not to be believed; else empty."""
        reasons = [""] * len(index)
        for cause in self.causes:
            if cause.kind != "frames":
                continue
            for row in np.flatnonzero((index >= cause.first_frame) & (index <= cause.last_frame)):
                reasons[row] = "; ".join(filter(None, [reasons[row], cause.short]))
        return reasons

    def excess_px(self, names: Sequence[str], index: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return by how much outlines may be off beyond what is stated, (F, C) pixels, at 95 %."""
        excess = np.zeros((len(index), len(names)))
        for camera, name in enumerate(names):
            if name in self.cameras:
                excess[:, camera] = self.cameras[name].excess_px
        for cause in self.causes:
            if cause.kind in ("bumped", "moved") and cause.high is not None:
                is_then = (index >= cause.first_frame) & (index <= cause.last_frame)
                camera = list(names).index(cause.cameras[0])
                excess[is_then, camera] = np.maximum(
                    excess[is_then, camera], max(0.0, cause.high - STATED_PX)
                )
        return excess
