"""The contacts of a report gathered into clashes: one for each thing worth a word.

A report has a patch for each connected piece of the hull at a part in a frame, thousands of them.
Which are of one thing is decided by where on the part they are, and when
(`hybridve.hull.contact.gathering`); what the rules of the scene leave out is counted.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.plain import read_strictly
from hybridve.hull.cad.rules import Rule
from hybridve.hull.contact.gathering import Boxes, boxes_on_part, gathered
from hybridve.hull.contact.verdict import VERDICTS, Verdict
from hybridve.hull.report.read import ObjectColumns, Report, Standing, read_standing

#: One-sided 95 % of a normal distribution, in standard deviations.
_ONE_SIDED_95 = 1.645

#: What a clash can be: the verdicts that say that a part does not keep its distance.
KINDS: tuple[Verdict, ...] = ("clash", "inside", "too near")

#: An episode goes on over a gap of so many seconds, or of a single frame.
_GAP_S = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Worst:
    """A clash in its worst frame.

    Attributes
    ----------
    frame : int
        Its number in the session.
    time_s : float
        When it was recorded.
    clearance_m : (float, float)
        Bounds of the clearance of what clashes, metres; how deep it is in a closed part counts as
        negative. The lower one is -inf in a part that is not closed.
    at_least_m : float
        What the clearance is at least at 95 %, an estimate, negative likewise; NaN if unknown.
    on_object_world, on_hull_world : (3,) float64
        The two points that it was measured between, metres.
    n_seeing : int
        How many cameras see it; 0 where that was not asked.
    ends_at : tuple of str
        The cameras whose outlines end the hull there, by which the clearance is decided.
    """

    frame: int
    time_s: float
    clearance_m: tuple[float, float]
    at_least_m: float
    on_object_world: NDArray[np.float64]
    on_hull_world: NDArray[np.float64]
    n_seeing: int
    ends_at: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Clash:
    """One thing that touched a part, was in it, or came nearer than it requires.

    Attributes
    ----------
    name : str
        Of the object.
    part : str
        What it is called in a file of several parts; else empty.
    kind : Verdict
        The worst that it was.
    required_m : float
        The clearance that the object requires.
    frames : (N,) int64
        Numbers of the frames that it was found in.
    first_s, last_s : float
        When the first and the last of them were recorded.
    dwell_s : float
        How long it was there.
    n_episodes : int
        How often it came.
    place : Boxes
        The box that it mostly keeps within, in the frame of the part.
    around : Boxes
        The box that it never leaves.
    worst : Worst
        Its worst frame; of several that bounds cannot tell apart, that with most collision points.
    std_m : float
        The standard deviation of its clearance, an estimate: that of its worst frame. Where that is
        0, as the hull covers a point from which all surface is nearer than from those about it, the
        median of its frames in which it is not. NaN if unknown.
    hinges_on : tuple of str
        Cameras without any one of which it would not touch, in all frames in which it does; none if
        it stands without any one in some frame, or only comes near.
    component : "real", "unsure" or ""
        Whether the volume of the hull that it is of holds something real: "unsure" if in no frame
        it is known to, so that it may be a phantom; "" where nobody asked.
    is_sure : bool
        Whether nothing that the report knows speaks against it.
    doubts : tuple of str
        What does, in words.
    """

    name: str
    part: str
    kind: Verdict
    required_m: float
    frames: NDArray[np.int64]
    first_s: float
    last_s: float
    dwell_s: float
    n_episodes: int
    place: Boxes
    around: Boxes
    worst: Worst
    std_m: float
    hinges_on: tuple[str, ...]
    component: str
    is_sure: bool
    doubts: tuple[str, ...]

    @property
    def badness(self) -> tuple[int, float, float, str, int]:
        """What clashes are sorted by: the worst first, then the nearest, the longest."""
        upper_m = self.worst.clearance_m[1]
        return KINDS.index(self.kind), upper_m, -self.dwell_s, self.name, int(self.frames[0])


@dataclass(frozen=True, slots=True)
class LeftOut:
    """What one rule left out.

    Attributes
    ----------
    rule : Rule
        Which.
    number : int
        Which of the scene's it is, from 1.
    clashes, frames : int
        How many clashes, in how many frames together.
    """

    rule: Rule
    number: int
    clashes: int
    frames: int


@dataclass(frozen=True, slots=True, eq=False)
class Clashes:
    """The clashes of a report.

    Attributes
    ----------
    clashes : tuple of Clash
        Worst first.
    left_out : tuple of LeftOut
        By rules that left out something.
    n_patches : int
        How many contacts of single frames they were gathered from.
    frames_undecided : dict of str to int
        In how many frames, or parts of frames, nothing could be said, by verdict.
    """

    clashes: tuple[Clash, ...]
    left_out: tuple[LeftOut, ...]
    n_patches: int
    frames_undecided: dict[str, int]


def rules_of(report: Report) -> tuple[Rule, ...]:
    """Return the rules of the scene that a report was made with."""
    told = report.settings.get("rules", [])
    return tuple(read_strictly(Rule, rule, f"{report.path}: rules") for rule in told)


def gather_clashes(
    report: Report, rules: Sequence[Rule] | None = None, frames: Collection[int] | None = None
) -> Clashes:
    """Return the clashes of a report.

    Parameters
    ----------
    report : Report
        Its file is read once more, for where the parts stood.
    rules : sequence of Rule, optional
        Instead of those of the scene that it was made with.
    frames : collection of int, optional
        Only frames of these numbers.

    Raises
    ------
    ReportError
        If the file cannot be read any more.
    """
    rules = rules_of(report) if rules is None else tuple(rules)
    standing = read_standing(report.path)
    is_wanted = np.ones(len(report.index), np.bool_)
    if frames is not None:
        is_wanted = np.isin(report.index, np.array(sorted(frames), np.int64))
    found: list[Clash] = []
    left_out = [LeftOut(rule, number, 0, 0) for number, rule in enumerate(rules, start=1)]
    n_patches = 0
    for name, rows in report.objects.items():
        contacts = _contacts(rows, standing[name]).only(is_wanted)
        n_patches += len(contacts.row)
        for number, rule in enumerate(rules):
            if rule.ignore and rule.holds_for(name):
                out = _in_zone(contacts, rule)
                things = _things(report, name, rows, contacts.those(out), is_wanted)
                left_out[number] = _more(left_out[number], things)
                contacts = contacts.those(~out)
        things = _things(report, name, rows, contacts, is_wanted)
        for number, rule in enumerate(rules):
            if rule.shortest_s and rule.holds_for(name):
                short = [one for one in things if one.dwell_s < rule.shortest_s]
                left_out[number] = _more(left_out[number], short)
                things = [one for one in things if one.dwell_s >= rule.shortest_s]
        found += things
    verdicts = [rows.verdict[is_wanted] for rows in report.objects.values()]
    undecided = {
        verdict: sum(int((of_object == verdict).sum()) for of_object in verdicts)
        for verdict in VERDICTS
        if verdict not in (*KINDS, "kept")
    }
    return Clashes(
        tuple(sorted(found, key=lambda one: one.badness)),
        tuple(one for one in left_out if one.clashes),
        n_patches,
        {verdict: count for verdict, count in undecided.items() if count},
    )


def _more(left_out: LeftOut, things: Sequence[Clash]) -> LeftOut:
    frames = left_out.frames + sum(len(one.frames) for one in things)
    return LeftOut(left_out.rule, left_out.number, left_out.clashes + len(things), frames)


@dataclass(frozen=True, slots=True, eq=False)
class _Contacts:
    """The patches of one object, N of them, with what their frames say of them.

    Attributes
    ----------
    row : (N,) int64
        Of the report.
    kind : (N,) int64
        Its place in `KINDS`.
    boxes : Boxes
        In the frame of the part.
    center_world : (N, 3) float64
        Metres.
    clearance_m : (N, 2) float64
        Bounds, depth counting as negative.
    is_worst : (N,) bool
        Whether it is the one that the numbers of its frame are about.
    on_object_world, on_hull_world : (N, 3) float64
        Witnesses.
    n_points : (N,) int64
        Collision points.
    """

    row: NDArray[np.int64]
    kind: NDArray[np.int64]
    boxes: Boxes
    center_world: NDArray[np.float64]
    clearance_m: NDArray[np.float64]
    is_worst: NDArray[np.bool_]
    on_object_world: NDArray[np.float64]
    on_hull_world: NDArray[np.float64]
    n_points: NDArray[np.int64]

    def those(self, which: NDArray[Any]) -> "_Contacts":
        """Return some of them."""
        return _Contacts(
            self.row[which],
            self.kind[which],
            self.boxes[which],
            self.center_world[which],
            self.clearance_m[which],
            self.is_worst[which],
            self.on_object_world[which],
            self.on_hull_world[which],
            self.n_points[which],
        )

    def only(self, is_wanted: NDArray[np.bool_]) -> "_Contacts":
        """Return those of some rows."""
        return self.those(is_wanted[self.row])


def _contacts(rows: ObjectColumns, standing: Standing) -> _Contacts:
    """Return the patches of an object; of a frame that has none though it clashes, its witness."""
    verdict = rows.verdict
    offset = rows.patches.get("offset", np.zeros(len(verdict) + 1, np.uint64)).astype(np.int64)
    counts = np.diff(offset)
    bare = np.flatnonzero((counts == 0) & np.isin(verdict, KINDS))
    row = np.concatenate([np.repeat(np.arange(len(verdict)), counts), bare])
    witness_world = _witnesses(rows)[bare]
    nothing = np.zeros((0, 3))
    patches = rows.patches

    def column(name: str, otherwise: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([patches[name], otherwise]) if patches else otherwise

    on_object, on_hull = column("cp_obj_m", witness_world), column("on_hull_m", witness_world)
    lower_world = column("lower_m", witness_world)
    upper_world = lower_world + column("extent_m", np.zeros((len(bare), 3)))
    n_points = column("points", np.zeros(len(bare), np.uint64)).astype(np.int64)
    own_m = column("clearance_m", _clearance_m(rows)[bare]).reshape(-1, 2)
    placed = np.isfinite(lower_world).all(axis=1)
    boxes = Boxes(nothing, nothing)
    if len(row):
        boxes = boxes_on_part(
            Boxes(lower_world, upper_world), standing.world_from_part_at(row), standing.box
        )
    is_worst = _is_worst(rows, row, Boxes(lower_world, upper_world), own_m)
    clearance_m = _signed(rows, row, own_m, is_worst)
    for name, points in (("clearance_on_object_m", on_object), ("clearance_on_hull_m", on_hull)):
        measured = rows.get(name)
        if measured is not None:
            there = is_worst & np.isfinite(measured[row]).all(axis=1)
            points[there] = measured[row[there]]
    kind = np.where(own_m[:, 1] > 0.0, KINDS.index("too near"), KINDS.index("clash"))
    kind[(own_m[:, 1] <= 0.0) & (verdict[row] == "inside")] = KINDS.index("inside")
    contacts = _Contacts(
        row,
        kind,
        boxes,
        0.5 * (lower_world + upper_world),
        clearance_m,
        is_worst,
        on_object,
        on_hull,
        n_points,
    )
    return contacts.those(np.flatnonzero(placed)[np.argsort(row[placed], kind="stable")])


def _clearance_m(rows: ObjectColumns) -> NDArray[np.float64]:
    """Return the clearance of each row (F, 2); of one without, 0 where something touches."""
    measured = rows.get("clearance_m")
    return np.zeros((len(rows.verdict), 2)) if measured is None else measured


def _witnesses(rows: ObjectColumns) -> NDArray[np.float64]:
    """Return a point of each row (F, 3) where it touches or is nearest; NaN where there is none."""
    found = rows.witness_m.copy()
    for name in ("cp_obj_m", "clearance_on_object_m"):
        other = rows.get(name)
        if other is not None:
            lost = ~np.isfinite(found).all(axis=1)
            found[lost] = other[lost]
    return found


def _is_worst(
    rows: ObjectColumns, row: NDArray[np.int64], boxes_world: Boxes, own_m: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return which patch of each row (N,) is the one that the row's numbers are about.

    It is the nearest to the point of the hull that they were measured at, or the nearest at all.
    """
    at = rows.get("clearance_on_hull_m")
    away_m = own_m[:, 1].copy()
    if at is not None:
        point = at[row]
        apart = np.maximum(boxes_world.lower - point, point - boxes_world.upper)
        known = np.isfinite(apart).all(axis=1)
        away_m[known] = np.linalg.norm(np.maximum(apart[known], 0.0), axis=1)
    is_worst = np.zeros(len(row), np.bool_)
    order = np.lexsort((own_m[:, 1], away_m, row))
    is_worst[order[np.flatnonzero(np.diff(row[order], prepend=-1))]] = True
    return is_worst


def _signed(
    rows: ObjectColumns,
    row: NDArray[np.int64],
    own_m: NDArray[np.float64],
    is_worst: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Return bounds of each patch's clearance (N, 2), depth counting as negative.

    How deep a patch is that is not its frame's deepest is not known: between that and nothing.
    """
    depth_m = rows.get("depth_m")
    touches = own_m[:, 1] <= 0.0
    clearance_m = own_m.copy()
    deepest_m = np.full(len(row), np.inf) if depth_m is None else depth_m[row, 1].copy()
    deepest_m[np.isnan(deepest_m)] = np.inf
    clearance_m[touches, 0] = -deepest_m[touches]
    if depth_m is not None:
        own = touches & is_worst & np.isfinite(depth_m[row, 0])
        clearance_m[own, 1] = -depth_m[row[own], 0]
    return clearance_m


def _std_m(rows: ObjectColumns) -> NDArray[np.float64]:
    found = rows.get("clearance_std_m")
    return np.full(len(rows.verdict), np.nan) if found is None else found


def _in_zone(contacts: _Contacts, rule: Rule) -> NDArray[np.bool_]:
    """Return which patches (N,) have their middle in a rule's zone; all if it has none."""
    if rule.zone_m is None:
        return np.ones(len(contacts.row), np.bool_)
    lower, upper = np.array(rule.zone_m)
    center = contacts.center_world if rule.zone_in == "world" else contacts.boxes.center
    return np.asarray(((center >= lower) & (center <= upper)).all(axis=1))


def _things(
    report: Report,
    name: str,
    rows: ObjectColumns,
    contacts: _Contacts,
    is_wanted: NDArray[np.bool_],
) -> list[Clash]:
    """Return the clashes that patches of an object are of."""
    is_known = is_wanted & (report.state == "evaluated")
    step = np.cumsum(is_known) - 1
    label = gathered(contacts.boxes, step[contacts.row], report.time_s[contacts.row])
    frame_s = _frame_s(report, is_wanted)
    return [
        _clash(report, name, rows, contacts.those(label == thing), step, frame_s)
        for thing in range(int(label.max(initial=-1)) + 1)
    ]


def _frame_s(report: Report, is_wanted: NDArray[np.bool_]) -> float:
    """Return how long a frame lasts: the usual time from one to the next."""
    time_s = report.time_s[is_wanted]
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0


def _clash(
    report: Report,
    name: str,
    rows: ObjectColumns,
    contacts: _Contacts,
    step: NDArray[np.int64],
    frame_s: float,
) -> Clash:
    there = np.unique(contacts.row)
    time_s = report.time_s[there]
    went = (np.diff(step[there]) > 2) & (np.diff(time_s) > _GAP_S)
    at = _at_worst(contacts)
    required_m = float(rows.about.get("required_clearance_m", 0.0))
    std_m = _std_of(_std_m(rows), int(contacts.row[at]), there)
    worst = _worst(report, rows, contacts, at, std_m)
    kind = KINDS[int(contacts.kind.min())]
    hinges_on, component = _hinges_on(rows, contacts), _component(rows, contacts)
    upper_95_m = worst.clearance_m[1] + _ONE_SIDED_95 * std_m
    doubts = _doubts(report, kind, required_m, upper_95_m, hinges_on, component)
    return Clash(
        name=name,
        part=str(rows.about.get("part") or ""),
        kind=kind,
        required_m=required_m,
        frames=report.index[there].astype(np.int64),
        first_s=float(time_s[0]),
        last_s=float(time_s[-1]),
        dwell_s=len(there) * frame_s,
        n_episodes=1 + int(went.sum()),
        place=contacts.boxes.mostly(),
        around=contacts.boxes.around(),
        worst=worst,
        std_m=std_m,
        hinges_on=hinges_on,
        component=component,
        is_sure=not doubts,
        doubts=doubts,
    )


def _at_worst(contacts: _Contacts) -> int:
    """Return which patch is the worst: of those that bounds cannot tell apart, the largest."""
    lower_m, upper_m = contacts.clearance_m.T
    first = int(upper_m.argmin())
    alike = upper_m <= 2.0 * upper_m[first] - lower_m[first]
    order = np.lexsort((contacts.row, upper_m, -contacts.n_points, ~alike))
    return int(order[0])


def _std_of(std_m: NDArray[np.float64], worst: int, there: NDArray[np.int64]) -> float:
    """Return the standard deviation of a clash, of those of its frames."""
    if std_m[worst] != 0.0:
        return float(std_m[worst])
    above_m = std_m[there][std_m[there] > 0.0]
    return float(np.median(above_m)) if len(above_m) else 0.0


def _worst(
    report: Report, rows: ObjectColumns, contacts: _Contacts, at: int, std_m: float
) -> Worst:
    row = int(contacts.row[at])
    lower_m, upper_m = contacts.clearance_m[at].tolist()
    stated_m = rows.get("clearance_at_least_m")
    at_least_m = np.nan if np.isinf(lower_m) else lower_m - _ONE_SIDED_95 * std_m
    if stated_m is not None and upper_m > 0.0 and contacts.is_worst[at]:
        at_least_m = float(stated_m[row])
    m_per_px, n_seeing = rows.get("m_per_px"), rows.get("n_seeing")
    ends_at: tuple[str, ...] = ()
    if m_per_px is not None and contacts.is_worst[at]:
        ends_at = tuple(
            camera
            for camera, each in zip(report.cameras, m_per_px[row], strict=False)
            if np.isfinite(each) and each > 0.0
        )
    return Worst(
        frame=int(report.index[row]),
        time_s=float(report.time_s[row]),
        clearance_m=(lower_m, upper_m),
        at_least_m=at_least_m,
        on_object_world=contacts.on_object_world[at],
        on_hull_world=contacts.on_hull_world[at],
        n_seeing=0 if n_seeing is None or not contacts.is_worst[at] else int(n_seeing[row]),
        ends_at=ends_at,
    )


def _hinges_on(rows: ObjectColumns, contacts: _Contacts) -> tuple[str, ...]:
    """Return the cameras without one of which it would touch in no frame; none if in one it does.

    What comes near is no farther away without a camera: the hull only grows.
    """
    survives, hinges_on = rows.get("survives"), rows.get("hinges_on")
    asked = contacts.row[contacts.is_worst & (contacts.kind != KINDS.index("too near"))]
    if survives is None or hinges_on is None or not (survives[asked] == "no").all():
        return ()
    sets = [set(text.split(", ")) - {""} for text in hinges_on[asked].tolist()]
    return tuple(sorted(set.intersection(*sets) or set.union(*sets))) if sets else ()


def _component(rows: ObjectColumns, contacts: _Contacts) -> str:
    component = rows.get("component")
    if component is None:
        return ""
    told = set(component[contacts.row[contacts.is_worst]].tolist())
    return "real" if "real" in told else "unsure" if "unsure" in told else ""


def _doubts(
    report: Report,
    kind: Verdict,
    required_m: float,
    upper_95_m: float,
    hinges_on: tuple[str, ...],
    component: str,
) -> tuple[str, ...]:
    """Return what speaks against a clash, in words."""
    doubts = []
    if not report.agreement.is_trusted:
        doubts.append("the cameras contradict each other")
    if component == "unsure":
        doubts.append("may be a phantom")
    if hinges_on:
        doubts.append(f"hinges on {' or '.join(hinges_on)} alone")
    if math.isnan(upper_95_m):
        doubts.append("nobody asked how far outlines may be off")
    elif upper_95_m >= (required_m if kind == "too near" else 0.0):
        doubts.append("outlines may be off by as much")
    return tuple(doubts)
