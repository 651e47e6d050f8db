"""What boards say of a rig, and what is known of a rig in the session that uses it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

from hybridve.calib.errors import CalibrationError
from hybridve.calib.plain import Told, read_strictly, to_plain

#: What is known of a rig: it agrees, or was made from the session's own clips; the boards refute
#: it; they leave something open; they could not be read; there are none; no test was wanted.
Verdict = Literal["agrees", "made here", "wrong", "open", "not tested", "no board", "off"]

#: Numbers of a check that are left out of JSON, which has no such values, where they are not
#: finite.
_MAY_BE_INFINITE = ("scale", "p_value", "scale_sigma")


@dataclass(frozen=True, slots=True)
class Moved(Told):
    """A camera that is not as the rig says.

    Attributes
    ----------
    what : str
        "pose", "lens" (the focal length: a zoom), or "pose and lens".
    shift_mm, turn_deg : float
        How far its centre lies from where the rig says, in true millimetres, and by how much it is
        turned; zero where the lens alone explains what it sees.
    focal_factor : float
        How many times longer the focal lengths are than the rig says; 1 where they are as it says.
    miss_px : float
        How far its image of the boards lies from where the rig says, pixels.
    p_value : float or None
        How often chance makes a camera that has not been touched look as bad; None where the rig
        does not know its own errors.
    """

    what: str
    shift_mm: float
    turn_deg: float
    focal_factor: float
    miss_px: float
    p_value: float | None


@dataclass(frozen=True, slots=True)
class Turned(Told):
    """A camera that stands turned about a board.

    Attributes
    ----------
    turn_deg : float
        By how much: 90 or 180 degrees.
    shift_m : float
        How far the rig has it from where it is, metres.
    sigma : float
        By how many standard deviations of chance matches the scene says so.
    """

    turn_deg: float
    shift_m: float
    sigma: float


@dataclass(frozen=True, slots=True)
class RigCheck(Told):
    """What boards say of a rig.

    Attributes
    ----------
    scale : float
        How many times too large the rig is: the boards' squares as the rig measures them, by the
        squares as they are. 1 where all cameras stand in one place: it cannot be told.
    pair_scales : dict of str to float
        The same from the distance of each two cameras alone, "cam1 cam2"; they differ where the
        rig is wrong by more than its scale. Without those that stand in one place.
    rms_px : dict of str to float
        How far corners lie from where the rig, at the scale found, says: per camera, pixels.
        Boards are placed by the cameras that agree.
    odd_camera : str or None
        The camera without which the others agree, if it is a single one.
    is_trustworthy : bool
        Whether scale and cameras are known to be within what is allowed.
    is_refuted : bool
        Whether they are known not to be. Neither: nothing tells whether cameras of the rig are
        turned about a board.
    message : str
        The verdict in one line.
    moved : dict of str to Moved
        The cameras without which the others agree.
    suspects : tuple of str
        Cameras of which one, or more, are not as the rig says, but it cannot be told which.
    exchanged : tuple of (str, str), or None
        Two cameras whose pictures are exchanged.
    turned : dict of str to Turned
        Cameras that fit the boards, but stand turned about one that looks the same when turned.
    turned_sides : tuple of tuple of str
        All of those; or, where it may as well be others of as many cameras, these sides, of which
        one stands as the rig says.
    undecided : tuple of str
        Cameras of which nothing tells whether they stand so.
    twins : tuple of tuple of str
        Cameras of the rig at one place with one view, by the group.
    untested : tuple of str
        Cameras of the rig that saw no board together with others.
    p_value : float or None
        How often chance makes a rig that has not been touched look as bad, its scale apart; None
        where the rig does not know its own errors.
    scale_sigma : float or None
        Standard deviation of `scale`, likewise.
    n_placements : int
        How many boards at how many moments it rests on.
    """

    scale: float
    pair_scales: dict[str, float]
    rms_px: dict[str, float]
    odd_camera: str | None
    is_trustworthy: bool
    is_refuted: bool
    message: str
    moved: dict[str, Moved]
    suspects: tuple[str, ...]
    exchanged: tuple[str, str] | None
    turned: dict[str, Turned]
    turned_sides: tuple[tuple[str, ...], ...]
    undecided: tuple[str, ...]
    twins: tuple[tuple[str, ...], ...]
    untested: tuple[str, ...]
    p_value: float | None
    scale_sigma: float | None
    n_placements: int


@dataclass(frozen=True, slots=True)
class RigTest(Told):
    """What is known of a rig's agreement with the session's boards.

    Attributes
    ----------
    verdict : str
        One of `Verdict`.
    message : str
        The same in one line.
    check : RigCheck or None
        All that was found; None where nothing was tested.
    """

    verdict: Verdict
    message: str
    check: RigCheck | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain JSON values, the check among them; no number is NaN or infinite."""
        told = {} if self.check is None else to_plain(self.check)
        finite = {
            key: value
            for key, value in told.items()
            if not isinstance(value, float) or math.isfinite(value)
        }
        return {**finite, "verdict": self.verdict, "message": self.message}

    @staticmethod
    def from_dict(told: Mapping[str, Any]) -> "RigTest | None":
        """Return what `to_dict` made plain; None for what an earlier version, which told less, did.

        Nobody relies on a test that was kept with a rig: each session that uses one asks anew.

        Raises
        ------
        CalibrationError
            Naming what is unknown, or of another type.
        """
        known = {one.name for one in fields(RigCheck)} | {"verdict"}
        for name in told:
            if name not in known:
                raise CalibrationError(f"check.{name}: is not known")
        said = {key: told[key] for key in ("verdict", "message") if key in told}
        if len(said) < 2:
            return None
        test = read_strictly(RigTest, said, "check")
        if told.keys() == said.keys():
            return test
        found = dict.fromkeys(_MAY_BE_INFINITE, math.nan) | dict(told)
        del found["verdict"]
        return replace(test, check=check_from_dict(found)) if len(found) == len(known) - 1 else None


def check_from_dict(told: Mapping[str, Any]) -> RigCheck:
    """Return what `hybridve.calib.plain.to_plain` made of a check, and JSON may have kept.

    Raises
    ------
    CalibrationError
        Naming what is missing, unknown, or of another type.
    """
    return read_strictly(RigCheck, told, "check")
