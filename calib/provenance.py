"""Where a rig comes from: a calibration by this program, with its record, or elsewhere."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from hybridve.calib.plain import read_strictly, to_plain
from hybridve.calib.record import METHOD, CalibrationRecord

#: A record is known by its method, and by this among the software: either suffices.
_PROGRAM = "hybridve"


@dataclass(frozen=True, slots=True)
class MadeElsewhere:
    """A rig that this program did not calibrate: what was decided or doubted is not known.

    Attributes
    ----------
    told : dict
        What its file says of where it comes from, as plain JSON values; nobody relies on it.
    """

    told: dict[str, Any] = field(default_factory=dict)

    @property
    def format(self) -> str:
        """The format that it was read from, as far as known: a rig.json unless told otherwise."""
        return str(self.told.get("format", "json"))


Provenance = CalibrationRecord | MadeElsewhere


def provenance_to_plain(provenance: Provenance) -> dict[str, Any]:
    """Return what stands in a rig.json; what a foreign rig told is passed on as it was."""
    if isinstance(provenance, MadeElsewhere):
        return provenance.told
    plain: dict[str, Any] = to_plain(provenance)
    return plain


def provenance_from_plain(told: Mapping[str, Any]) -> Provenance:
    """Return what stands in a rig.json, typed.

    Raises
    ------
    CalibrationError
        If it is a record of this program, but not complete.
    """
    software = told.get("software")
    is_ours = isinstance(software, Mapping) and _PROGRAM in software
    if not is_ours and told.get("method") != METHOD:
        return MadeElsewhere(dict(told))
    return read_strictly(CalibrationRecord, told, "provenance")
