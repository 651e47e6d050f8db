"""What a report holds: every column declared once, and how it is taken from a result.

A dataset that is not there was not computed; none holds invented
values. Writing, taking up a run that was cut off, and reading all go by the tables of this module:
a new number in a report is one more line in one of them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import Pose
from hybridve.hull.report.collisions import StoredMesh
from hybridve.hull.report.machine import Run
from hybridve.hull.report.result_file import Described

if TYPE_CHECKING:  # whoever only reads a report waits for none of these
    from hybridve.hull.agreement.outlines import Outline
    from hybridve.hull.contact.finding import Finding


VERSION = 2

#: Versions that are read.
READ_VERSIONS = (1, 2)

#: The stages whose seconds a report keeps, in the order in which a frame runs through them.
STAGES = (
    "decode",
    "segment",
    "agree",
    "query",
    "certify",
    "clearance",
    "respond",
    "patches",
    "doubt",
    "write",
)

#: What an evaluation may compute of an object.
Part = Literal["contact", "clearance", "first contact", "response", "recovery", "doubt"]

#: What became of a frame. "unread": its pictures, or the pose of a camera, are missing or damaged.
#: "contradictory": its silhouettes cannot all be right.
State = Literal["evaluated", "unread", "contradictory"]


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """What is said of one camera's silhouette in one frame.

    Attributes
    ----------
    object_share : float
        The share of its picture that is object.
    denied_px : int
        Area of the pieces of it that are proved to be denied by others, square pixels.
    supported_share, denies_share : float
        Of its squares of object pixels, the share that the others are not proved to deny; of
        theirs, the share that it denies. See `hybridve.hull.agreement.frame.Coherence`.
    is_denier : bool
        Whether it denies pieces of two others' silhouettes at least.
    alone_px : (4,) float64
        Left, top, right and bottom of what it sees alone; NaN where there is nothing.
    outline : Outline
        Its outline.
    """

    object_share: float
    denied_px: int
    supported_share: float
    denies_share: float
    is_denier: bool
    alone_px: NDArray[np.float64]
    outline: "Outline"


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
    state : State
        What became of it.
    rests_on : str
        What the hull's emptiness rests on, in words; empty if it is not empty.
    cameras : tuple of C CameraFrame
        What is said of each camera's silhouette; empty if the frame was not read.
    findings : tuple of Finding
        One for each object of the report, in its order; empty if there is a reason.
    stage_s : dict
        Seconds of work by stage. Cameras are decoded and segmented side by side: their seconds are
        summed and may exceed the time that passed.
    """

    index: int
    time_s: float
    reason: str
    findings: "tuple[Finding, ...]"
    stage_s: dict[str, float]
    state: State = "evaluated"
    rests_on: str = ""
    cameras: tuple[CameraFrame, ...] = ()

    def __post_init__(self) -> None:
        if (self.state == "evaluated") == bool(self.reason):
            raise ValueError(f"the frame is {self.state}, and its reason {self.reason!r}")

    @property
    def is_valid(self) -> bool:
        """Whether the frame was evaluated."""
        return not self.reason


@dataclass(frozen=True, slots=True)
class ReportHeader:
    """What a report says of itself as a whole.

    Attributes
    ----------
    run : Run
        Which run made it; when it was there is said when it is.
    objects : tuple of dict
        Per object ``name`` and what else is worth keeping, as plain JSON values; None is left out.
    settings : dict
        The resolved configuration, as plain JSON values. Two runs with equal settings give equal
        results, so that one can take up the other.
    rig : dict
        The rig as it stands in rig.json.
    engine, renderer : str
        What answered the volume query.
    parts : frozenset of str
        What was computed of each object besides its contact.
    cameras : tuple of str
        The cameras, C of them, in the order of columns that have a number for each.
    local_origin_m : tuple of 3 floats
        Places in the file are metres about this point of the world.
    meshes : tuple of StoredMesh
        Per object.
    placements : tuple of mappings of int to (3, 4) float64, or None
        Per object that moves, by frame of the session where its mesh stood, as a mesh's placement;
        frames in which that is not known have none. None of one that stands as its mesh says, as
        they all do if this is empty.
    points : "sample" or "all"
        Whether all collision points are spelt out, or only a sample of them for pictures.
    """

    run: Run
    objects: tuple[dict[str, Any], ...]
    settings: dict[str, Any]
    rig: dict[str, Any]
    engine: str
    renderer: str
    parts: frozenset[Part] = frozenset()
    cameras: tuple[str, ...] = ()
    local_origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    meshes: tuple[StoredMesh, ...] = ()
    placements: tuple[Mapping[int, Pose] | None, ...] = ()
    points: Literal["sample", "all"] = "sample"


T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Column(Described, Generic[T]):
    """One dataset of the report.

    Attributes
    ----------
    dtype : type
        NumPy's; `str` for texts.
    take : callable
        Returns its value of one row; (n, *shape) for a column of points.
    shape : tuple
        Of one value; "C" stands for the number of cameras.
    is_place : bool
        Whether it is a place: `take` gives it in the world, the file holds it about its local
        origin.
    absent : callable, optional
        Its value in a frame that was not evaluated, of that frame; else `fill`.
    """

    dtype: type
    take: Callable[[T], Any]
    shape: tuple[int | Literal["C"], ...] = ()
    is_place: bool = False
    absent: Callable[[FrameResult], Any] | None = None

    def shape_of(self, n_cameras: int) -> tuple[int, ...]:
        """Return the shape of one value."""
        return tuple(n_cameras if size == "C" else size for size in self.shape)

    @property
    def fill(self) -> Any:
        """What stands where there is nothing to say: NaN, 0, False or an empty text."""
        return np.nan if np.issubdtype(self.dtype, np.floating) else self.dtype()


@dataclass(frozen=True, slots=True)
class Table(Generic[T]):
    """The columns of one part of a finding.

    Attributes
    ----------
    part : str
        What it belongs to: the columns of a part that an evaluation did not compute are absent.
    of : callable
        Returns that part of a finding; None where the frame has none.
    columns : tuple of Column
        One row a frame.
    """

    part: Part
    of: "Callable[[Finding], T | None]"
    columns: tuple[Column[T], ...]
