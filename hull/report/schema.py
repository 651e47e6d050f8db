"""What a report holds: one row a frame, and the names under which it is found in the file.

The layout is that of DESIGN, 4.4. A dataset that is not there was not computed; none holds invented
values.
"""

from dataclasses import dataclass, field
from typing import Any

from hybridve.hull.contact.detect import Contact

FORMAT = "hybridve-report"
VERSION = 1

#: The stages whose seconds a report keeps, in the order in which a frame runs through them.
STAGES = ("decode", "segment", "query", "certify", "write")


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """What became of one frame.

    Attributes
    ----------
    index : int
        Number of the frame in the session.
    time_s : float
        When it was recorded, seconds from the session's first frame.
    reason : str
        Why the frame could not be evaluated; empty if it was.
    contacts : tuple of Contact
        One for each object of the report, in its order; empty if there is a reason.
    stage_s : dict
        Seconds of work by stage. Cameras are decoded and segmented side by side: their seconds are
        summed and may exceed the time that passed.
    """

    index: int
    time_s: float
    reason: str
    contacts: tuple[Contact, ...]
    stage_s: dict[str, float]

    @property
    def is_valid(self) -> bool:
        """Whether the frame was evaluated."""
        return not self.reason


@dataclass(frozen=True, slots=True)
class ReportHeader:
    """What a report says of itself as a whole.

    Attributes
    ----------
    command : str
        The command line.
    objects : tuple of dict
        Per object ``name`` and what else is worth keeping, as plain JSON values.
    settings : dict
        The resolved configuration, as plain JSON values. Two runs with equal settings give equal
        results, so that one can take up the other.
    rig : dict
        The rig as it stands in rig.json.
    engine, renderer : str
        What answered the volume query.
    versions : dict
        Versions of the software that took part.
    machine : str
        The machine in words.
    """

    command: str
    objects: tuple[dict[str, Any], ...]
    settings: dict[str, Any]
    rig: dict[str, Any]
    engine: str
    renderer: str
    versions: dict[str, str] = field(default_factory=dict)
    machine: str = ""
