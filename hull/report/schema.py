"""What a report holds: every column declared once, and how it is taken from a result.

The layout is that of DESIGN, 4.4. A dataset that is not there was not computed; none holds invented
values. Writing, taking up a run that was cut off, and reading all go by the tables of this module:
a new number in a report is one more line in one of them.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # whoever only reads a report waits for none of these
    from hybridve.hull.contact.backtrack import FirstContact
    from hybridve.hull.contact.clearance import Clearance
    from hybridve.hull.contact.detect import Contact
    from hybridve.hull.contact.finding import Finding
    from hybridve.hull.contact.respond import Response
    from hybridve.hull.contact.uncertainty import Doubt

FORMAT = "hybridve-report"
VERSION = 1

#: The stages whose seconds a report keeps, in the order in which a frame runs through them.
STAGES = ("decode", "segment", "query", "certify", "clearance", "respond", "doubt", "write")

#: How far a number can be trusted. "exact": what it says, to floating-point accuracy. "bound": the
#: truth is on one side of it, or between two. "estimate": near the truth, by a model of errors or
#: a guess at what was not seen. "sampled": of the samples alone; what lies between them is missed.
Kind = Literal["exact", "bound", "estimate", "sampled"]

#: What an evaluation may compute of an object.
Part = Literal["contact", "clearance", "first contact", "response", "doubt"]


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
    parts: frozenset[Part] = frozenset()
    cameras: tuple[str, ...] = ()
    versions: dict[str, str] = field(default_factory=dict)
    machine: str = ""


T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Column(Generic[T]):
    """One dataset of the report.

    Attributes
    ----------
    name : str
        Its name in the file, below the group of the frames or of the object.
    unit : str
        "1" where it has none.
    kind : Kind
        How far it can be trusted.
    description : str
        What it says, for whoever opens the file.
    dtype : type
        NumPy's; `str` for texts.
    take : callable
        Returns its value of one row; (n, *shape) for a column of points.
    shape : tuple
        Of one value; "C" stands for the number of cameras.
    """

    name: str
    unit: str
    kind: Kind
    description: str
    dtype: type
    take: Callable[[T], Any]
    shape: tuple[int | Literal["C"], ...] = ()

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


def _stage(name: str) -> Column[FrameResult]:
    return Column(
        f"stage_s/{name}",
        "s",
        "estimate",
        f"seconds of work on the stage {name!r}, summed over the cameras",
        np.float64,
        lambda result: result.stage_s.get(name, 0.0),
    )


#: One row a frame.
FRAME_COLUMNS: tuple[Column[FrameResult], ...] = (
    Column(
        "index",
        "1",
        "exact",
        "number of the frame in the session",
        np.uint32,
        lambda result: result.index,
    ),
    Column(
        "time_s",
        "s",
        "exact",
        "time from the session's first frame",
        np.float64,
        lambda result: result.time_s,
    ),
    Column(
        "valid",
        "1",
        "exact",
        "whether the frame was evaluated",
        np.bool_,
        lambda result: result.is_valid,
    ),
    Column(
        "reason",
        "1",
        "exact",
        "why the frame was not evaluated",
        str,
        lambda result: result.reason,
    ),
    *(_stage(name) for name in STAGES),
)

_CONTACT: "tuple[Column[Contact], ...]" = (
    Column(
        "collides",
        "1",
        "sampled",
        "whether a sample of its surface is in the hull",
        np.bool_,
        lambda contact: contact.collides,
    ),
    Column(
        "n_points",
        "1",
        "sampled",
        "number of collision points",
        np.uint32,
        lambda contact: len(contact.triangle),
    ),
    Column(
        "n_triangles",
        "1",
        "sampled",
        "number of triangles with a collision point",
        np.uint32,
        lambda contact: contact.n_triangles,
    ),
    Column(
        "certificate",
        "1",
        "exact",
        "colliding: a witness point is in every silhouette; free: proved, no point of the object "
        "is in the hull; open: no disc of diameter open_at_m on its surface is in the hull; empty: "
        "sampled only, or not evaluated",
        str,
        lambda contact: contact.certificate,
    ),
    Column(
        "witness_m",
        "m",
        "exact",
        "a point of the surface in every silhouette, world frame; NaN unless colliding",
        np.float64,
        lambda contact: contact.witness_world,
        shape=(3,),
    ),
    Column(
        "open_at_m",
        "m",
        "bound",
        "no disc of this diameter on the surface is in the hull; NaN unless open",
        np.float64,
        lambda contact: contact.open_at_m,
    ),
)

_CLEARANCE: "tuple[Column[Clearance], ...]" = (
    Column(
        "clearance_m",
        "m",
        "bound",
        "lower and upper bound of the distance from the hull to the object; 0, 0 while colliding "
        "or inside; inf above where no hull was found; NaN where unknown",
        np.float64,
        lambda clearance: (clearance.lower_m, clearance.upper_m),
        shape=(2,),
    ),
    Column(
        "clearance_on_object_m",
        "m",
        "bound",
        "point of the object's surface that the upper bound was measured from, world frame",
        np.float64,
        lambda clearance: clearance.on_object_world,
        shape=(3,),
    ),
    Column(
        "clearance_on_hull_m",
        "m",
        "bound",
        "point of the hull that the upper bound was measured to, world frame; of a hull that is in "
        "a closed object its deepest point",
        np.float64,
        lambda clearance: clearance.on_hull_world,
        shape=(3,),
    ),
    Column(
        "depth_m",
        "m",
        "bound",
        "lower and upper bound of how far the deepest point of the hull lies beneath the surface "
        "of a closed object, which is no distance that separates them; 0, 0 if none does; NaN if "
        "the object is not closed",
        np.float64,
        lambda clearance: (clearance.depth_lower_m, clearance.depth_upper_m),
        shape=(2,),
    ),
)

_APPROACH: "tuple[Column[Finding], ...]" = (
    Column(
        "approach_m_s",
        "m/s",
        "bound",
        "lower and upper bound of the mean speed at which hull and object came nearer since the "
        "frame before, depth counting as negative distance; negative where they parted; infinite "
        "where nothing bounds it, as in an object that is not closed; NaN in the first frame, "
        "beside one that was not evaluated and one without a hull",
        np.float64,
        lambda finding: finding.approach_m_s,
        shape=(2,),
    ),
)

_INSTANT: "tuple[Column[Finding], ...]" = (
    Column(
        "first_contact_s",
        "s",
        "estimate",
        "when the hull first touched the object, from the session's first frame; in the first "
        "colliding frame after one without, else NaN",
        np.float64,
        lambda finding: finding.first_contact_s,
    ),
    Column(
        "first_contact_uncertainty_s",
        "s",
        "bound",
        "how far off first_contact_s can be",
        np.float64,
        lambda finding: finding.first_contact_uncertainty_s,
    ),
)

_FIRST_CONTACT: "tuple[Column[FirstContact], ...]" = (
    Column(
        "first_contact_m",
        "m",
        "estimate",
        "where the hull first touched the object's surface, world frame",
        np.float64,
        lambda first: first.point_world,
        shape=(3,),
    ),
    Column(
        "first_contact_status",
        "1",
        "exact",
        "what is wrong with first_contact_s and first_contact_m; empty if nothing is",
        str,
        lambda first: first.status,
    ),
)

_RESPONSE: "tuple[Column[Response], ...]" = (
    Column(
        "cp_obj_m",
        "m",
        "sampled",
        "CP_obj, world frame: the collision point farthest from RP_obj, or that of first contact "
        "where it was asked for; NaN where nothing collides",
        np.float64,
        lambda response: response.cp_obj_world,
        shape=(3,),
    ),
    Column(
        "v_rec",
        "1",
        "exact",
        "V_rec, unit vector, world frame: the way the object is moved out of the hull",
        np.float64,
        lambda response: response.v_rec,
        shape=(3,),
    ),
    Column(
        "cp_hull_m",
        "m",
        "exact",
        "CP_hull, world frame: where the ray from CP_obj along V_rec leaves the hull",
        np.float64,
        lambda response: response.cp_hull_world,
        shape=(3,),
    ),
    Column(
        "d_rec_m",
        "m",
        "exact",
        "D_rec: from CP_obj to CP_hull; moves CP_obj out, not necessarily the whole object",
        np.float64,
        lambda response: response.d_rec_m,
    ),
    Column(
        "n_hull",
        "1",
        "estimate",
        "N_hull, unit vector out of the hull, world frame: of the smoothed outline at CP_hull",
        np.float64,
        lambda response: response.n_hull,
        shape=(3,),
    ),
    Column(
        "response_status",
        "1",
        "exact",
        "what is wrong with the columns before it; empty if nothing is",
        str,
        lambda response: response.status,
    ),
    Column(
        "cp_hull_paper_m",
        "m",
        "sampled",
        "CP_hull as published: the first sample of triangle ABC within the hull",
        np.float64,
        lambda response: response.cp_hull_paper_world,
        shape=(3,),
    ),
    Column(
        "d_rec_paper_m",
        "m",
        "sampled",
        "D_rec as published",
        np.float64,
        lambda response: response.d_rec_paper_m,
    ),
    Column(
        "d_rec_difference_m",
        "m",
        "sampled",
        "d_rec_paper_m less d_rec_m",
        np.float64,
        lambda response: response.difference_m,
    ),
    Column(
        "n_hull_paper",
        "1",
        "sampled",
        "N_hull as published: the cross product of IJ and KL",
        np.float64,
        lambda response: response.n_hull_paper,
        shape=(3,),
    ),
    Column(
        "response_status_paper",
        "1",
        "exact",
        "what is wrong with the columns as published; empty if nothing is",
        str,
        lambda response: response.status_paper,
    ),
)

_DOUBT: "tuple[Column[Doubt], ...]" = (
    Column(
        "clearance_std_m",
        "m",
        "estimate",
        "standard deviation of the clearance, from outlines and calibration; of the depth, where "
        "the hull reaches into a closed object",
        np.float64,
        lambda doubt: doubt.std_m,
    ),
    Column(
        "clearance_at_least_m",
        "m",
        "estimate",
        "what the clearance is at least, at 95 %",
        np.float64,
        lambda doubt: doubt.at_least_m,
    ),
    Column(
        "real_clearance_at_most_m",
        "m",
        "bound",
        "the real thing is not farther away than this, given right silhouettes; inf if unknown, "
        "NaN of objects too far away to be looked at closely",
        np.float64,
        lambda doubt: doubt.real_upper_m,
    ),
    Column(
        "m_per_px",
        "m/px",
        "estimate",
        "by how much the clearance falls when a camera's outline moves outward by a pixel",
        np.float64,
        lambda doubt: doubt.m_per_px,
        shape=("C",),
    ),
    Column(
        "n_seeing",
        "1",
        "exact",
        "cameras that see the contact, or the point of the hull that is nearest",
        np.uint32,
        lambda doubt: doubt.n_seeing,
    ),
    Column(
        "survives",
        "1",
        "exact",
        "yes or no: whether the verdict, touched or not, stands with any one camera left out; "
        "empty of objects too far away to be looked at closely",
        str,
        lambda doubt: {True: "yes", False: "no", None: ""}[doubt.survives],
    ),
    Column(
        "hinges_on",
        "1",
        "exact",
        "the cameras without which it does not",
        str,
        lambda doubt: ", ".join(doubt.hinges_on),
    ),
    Column(
        "component",
        "1",
        "estimate",
        "the connected volume of the hull, in cells of some centimetres and with silhouettes grown "
        "by a pixel, that touches or is nearest; real: somewhere it holds something real, given "
        "right silhouettes, which need not be where it touches (a phantom that a thin neck joins "
        "to a person is of one volume with them); unsure: other volumes explain all that it does, "
        "as of a phantom; empty of objects too far away to be looked at closely",
        str,
        lambda doubt: doubt.component,
    ),
)

#: Of each object, one row a frame.
TABLES: tuple[Table[Any], ...] = (
    Table("contact", lambda finding: finding.contact, _CONTACT),
    Table("clearance", lambda finding: finding.clearance, _CLEARANCE),
    Table("clearance", lambda finding: finding, _APPROACH),
    Table("first contact", lambda finding: finding, _INSTANT),
    Table("first contact", lambda finding: finding.first_contact, _FIRST_CONTACT),
    Table("response", lambda finding: finding.response, _RESPONSE),
    Table("doubt", lambda finding: finding.doubt, _DOUBT),
)

#: Of each object, one row a collision point.
POINT_COLUMNS: "tuple[Column[Contact], ...]" = (
    Column(
        "points/xyz_m",
        "m",
        "sampled",
        "collision points CP_i, world frame",
        np.float32,
        lambda contact: contact.points_world,
        shape=(3,),
    ),
    Column(
        "points/triangle",
        "1",
        "sampled",
        "number of the triangle that the collision point lies on",
        np.uint32,
        lambda contact: contact.triangle,
    ),
)

#: Of each object, which points belong to which frame; made from the number of points.
OFFSET: Column[NDArray[np.uint64]] = Column(
    "points/offset",
    "1",
    "exact",
    "the collision points of row f are points offset[f] to offset[f + 1]",
    np.uint64,
    lambda offset: offset,
)


def tables_of(parts: frozenset[Part]) -> tuple[Table[Any], ...]:
    """Return the tables of an evaluation that computed `parts` besides the contact."""
    there = {"contact", *parts}
    return tuple(table for table in TABLES if table.part in there)
