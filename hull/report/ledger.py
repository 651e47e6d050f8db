"""The ledger of clashes: what each is called, and what people have decided about it.

A text file beside the report, ``REPORT.clashes.toml`` (or ``clashes.toml`` for all in a folder, if
that is there, or any other that is named), made to be edited and put under version control. It
remembers every clash that was ever found: its id, where on its part it is, and its status. A clash
of another run, of fewer frames, of outlines that err a little, of a layout that was moved, or of
another session is the one that the ledger has nearest to that place on the part
(`hybridve.hull.contact.gathering.matched`); only one that has none near gets a new id. A new id is
short for the object and for a place on it, and never one that the ledger has.

Status, as clash tools of the trade have it: *new* (first found in this run), *active* (found in an
earlier run, too), *reviewed* and *approved* (as people say), *resolved* (found in an earlier run
and not in the last one, or as people say). What is found again though it was resolved is new.
"""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from hybridve.calib.errors import ReportError
from hybridve.calib.files import write_whole
from hybridve.calib.plain import to_json
from hybridve.hull.contact.gathering import Boxes, matched
from hybridve.hull.report.clashes import Clash
from hybridve.hull.report.read import Report
from hybridve.hull.toml_io import Name, explain_validation, like, read_toml

Status = Literal["new", "active", "reviewed", "approved", "resolved"]

STATUSES: tuple[Status, ...] = get_args(Status)

#: The ledger of all reports in a folder.
OF_ALL = "clashes.toml"

#: First ids are made of places to so many metres. Only first ones: afterwards the ledger knows.
_CELL_M = 0.05

#: What ids end in: no letter that is taken for a digit, and none that makes words.
_LETTERS = "23456789bcdfghjkmnpqrstvwxz"
_LENGTH = 4

#: A place is written anew where it has moved by more than this, metres.
_MOVED_M = 0.01

_HEAD = """\
# What hybridve found to clash, and what was decided; made to be edited and kept under version
# control. status: new, active, reviewed, approved or resolved; who, when and comment are yours.
# place_mm and size_mm say where on the part a clash is, in the part's own frame: by these it is
# found again. Lines like this one are not kept when the file is written anew; comments are.
"""

_Vector = tuple[float, float, float]
_Id = Annotated[str, Field(pattern=r"^[^\s\"\\]+$")]


def _as_text(value: Any) -> Any:
    """Return a time of TOML, which needs no quotes, as text."""
    return value.isoformat() if isinstance(value, date) else value


class _EntryTable(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    id: _Id
    object: Name
    status: Status
    who: str = ""
    when: Annotated[str, BeforeValidator(_as_text)] = ""
    comment: str = ""
    place_mm: _Vector
    size_mm: tuple[
        Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]
    ]
    found_in: list[str] = []


class _LedgerTable(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    format: Literal["hybridve-clashes"]
    version: Literal[1]
    runs: dict[str, str] = {}
    clash: list[_EntryTable] = []


@dataclass(frozen=True, slots=True)
class Entry:
    """What the ledger has of one clash.

    Attributes
    ----------
    id : str
        What it is called.
    object : str
        The name of the object.
    status : Status
        What was decided, or found.
    who, when, comment : str
        By whom, when, and why; as people write it.
    place_mm, size_mm : tuple of 3 floats
        The middle and the edges of the box it mostly keeps within, in the frame of the part.
    found_in : tuple of str
        The reports in whose last run it was found.
    """

    id: str
    object: str
    status: Status
    place_mm: _Vector
    size_mm: _Vector
    who: str = ""
    when: str = ""
    comment: str = ""
    found_in: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Ledger:
    """A ledger as it stands in its file.

    Attributes
    ----------
    path : Path
        The file, which need not be there yet.
    entries : tuple of Entry
        All clashes that it knows.
    runs : dict of str to str
        Of each report, which of its runs was looked at last: when that was made.
    """

    path: Path
    entries: tuple[Entry, ...] = ()
    runs: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Listed:
    """A clash of a report by its name.

    Attributes
    ----------
    clash : Clash
        What was found.
    entry : Entry
        What the ledger has of it.
    ties : tuple of str
        Ids of others of the same object that it could have been as well, or that it is beside.
    """

    clash: Clash
    entry: Entry
    ties: tuple[str, ...]

    def by(self, ledger: Ledger) -> "Listed":
        """Return it with what a ledger has of it."""
        entries = (entry for entry in ledger.entries if entry.id == self.entry.id)
        return replace(self, entry=next(entries, self.entry))


def ledger_path(report: Path) -> Path:
    """Return where the ledger of a report is kept unless another is named.

    It is that of the report, unless there is one of all reports in the folder, `OF_ALL`.

    Examples
    --------
    >>> ledger_path(Path("out/report.h5")).as_posix()
    'out/report.clashes.toml'
    """
    of_all = report.with_name(OF_ALL)
    return of_all if of_all.exists() else report.with_suffix(".clashes.toml")


def read_ledger(path: Path) -> Ledger:
    """Return a ledger; an empty one if there is no such file.

    Raises
    ------
    ReportError
        One line that names what is wrong with the file.
    """
    if not path.exists():
        return Ledger(path)
    table, _ = read_toml(path, "clashes", ReportError)
    try:
        told = _LedgerTable.model_validate(table)
    except ValidationError as error:
        raise ReportError(explain_validation(error, path, _LedgerTable)) from None
    for number, one in enumerate(told.clash, start=1):
        ids = [earlier.id for earlier in told.clash[: number - 1]]
        if one.id in ids:
            raise ReportError(
                f"{path}: clash.{number}.id: {one.id!r} is the id of clash."
                f"{ids.index(one.id) + 1} too; each has its own: remove one of the two"
            )
    entries = tuple(
        Entry(
            one.id,
            one.object,
            one.status,
            one.place_mm,
            one.size_mm,
            one.who,
            one.when,
            one.comment,
            tuple(one.found_in),
        )
        for one in told.clash
    )
    return Ledger(path, entries, tuple(sorted(told.runs.items())))


def write_ledger(ledger: Ledger) -> None:
    """Write a ledger, whole or not at all; the same ledger becomes the same bytes.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    path = ledger.path
    try:
        write_whole(path, _text(ledger))
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error.strerror}") from error


def _text(ledger: Ledger) -> str:
    lines = [_HEAD, 'format = "hybridve-clashes"', "version = 1", "", "[runs]"]
    lines += [f"{_quoted(name)} = {_quoted(when)}" for name, when in ledger.runs]
    for entry in sorted(ledger.entries, key=lambda one: one.id):
        lines += [
            "",
            "[[clash]]",
            f"id = {_quoted(entry.id)}",
            f"object = {_quoted(entry.object)}",
            f"status = {_quoted(entry.status)}",
        ]
        for key in ("who", "when", "comment"):
            if value := getattr(entry, key):
                lines.append(f"{key} = {_quoted(value)}")
        lines += [
            f"place_mm = {_numbers(entry.place_mm)}",
            f"size_mm = {_numbers(entry.size_mm)}",
            f"found_in = [{', '.join(map(_quoted, entry.found_in))}]",
        ]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    """Return a text as TOML has it: as JSON, but for DEL; what is no text becomes "?"."""
    whole = text.encode("utf-8", "replace").decode("utf-8")
    return json.dumps(whole, ensure_ascii=False).replace("\x7f", "\\u007f")


def _numbers(values: Sequence[float]) -> str:
    return f"[{', '.join(f'{value:.1f}' for value in values)}]"


def look_up(
    ledger: Ledger, clashes: Sequence[Clash], report: Report
) -> tuple[Ledger, tuple[Listed, ...]]:
    """Return what a report's clashes are called, and the ledger that knows of them.

    Of a run that the ledger has not seen, what is found again and what no more is noted, too.

    Parameters
    ----------
    ledger : Ledger
        As it was.
    clashes : sequence of Clash
        Of the report, worst first.
    report : Report
        Which.
    """
    name, made = report_name_in(ledger, report.path), str(report.attributes.get("created_utc", ""))
    runs = dict(ledger.runs)
    is_new_run = runs.get(name) != made
    runs[name] = made
    entries = {entry.id: entry for entry in ledger.entries}
    found = identified(ledger, clashes)
    listed = []
    for clash, (known, ties) in zip(clashes, found, strict=True):
        if known is None:
            entry = _first(clash, set(entries))
        else:
            entry = _placed(entries[known], clash)
            if is_new_run:
                entry = _found_again(entry, name)
        entry = replace(entry, found_in=tuple(sorted({*entry.found_in, name})))
        entries[entry.id] = entry
        listed.append(Listed(clash, entry, ties))
    if is_new_run:
        there = {one.entry.id for one in listed}
        for entry in ledger.entries:
            if entry.id not in there and name in entry.found_in:
                entries[entry.id] = _not_found(entry, name)
    return Ledger(ledger.path, tuple(entries.values()), tuple(sorted(runs.items()))), tuple(listed)


def report_name_in(ledger: Ledger, report: Path) -> str:
    """Return what a ledger calls a report: its path from the ledger's folder."""
    return Path(os.path.relpath(report.resolve(), ledger.path.resolve().parent)).as_posix()


def identified(
    ledger: Ledger, clashes: Sequence[Clash]
) -> list[tuple[str | None, tuple[str, ...]]]:
    """Return of each clash the id that the ledger has of it, or None, and those of ties."""
    found: list[tuple[str | None, tuple[str, ...]]] = [(None, ())] * len(clashes)
    for name in {clash.name for clash in clashes}:
        known = [entry for entry in ledger.entries if entry.object == name]
        mine = [number for number, clash in enumerate(clashes) if clash.name == name]
        matches = matched(
            boxes_of([_box(entry) for entry in known]),
            boxes_of([clashes[number].place for number in mine]),
        )
        for at, number in enumerate(mine):
            pair = matches.pairs.get(at)
            ties = tuple(known[other].id for other in matches.ties.get(at, ()))
            found[number] = (None if pair is None else known[pair].id, ties)
    return found


def boxes_of(each: Sequence[Boxes]) -> Boxes:
    """Return boxes one after another."""
    nothing = np.zeros((0, 3))
    return Boxes(
        np.concatenate([nothing, *(one.lower for one in each)]),
        np.concatenate([nothing, *(one.upper for one in each)]),
    )


def _box(entry: Entry) -> Boxes:
    center, size = np.array([entry.place_mm]) / 1e3, np.array([entry.size_mm]) / 1e3
    return Boxes(center - 0.5 * size, center + 0.5 * size)


def place_mm_of(clash: Clash) -> tuple[_Vector, _Vector]:
    """Return the middle and the edges of a clash's place, as they are written."""
    size = clash.place.upper - clash.place.lower
    (x, y, z), (a, b, c) = (
        np.round(1e3 * one[0], 1).tolist() for one in (clash.place.center, size)
    )
    return (x + 0.0, y + 0.0, z + 0.0), (a, b, c)  # never -0.0


def _first(clash: Clash, taken: set[str]) -> Entry:
    """Return the entry of a clash that nobody knows yet."""
    place_mm, size_mm = place_mm_of(clash)
    return Entry(first_id(clash.name, place_mm, taken), clash.name, "new", place_mm, size_mm)


def first_id(name: str, place_mm: _Vector, taken: set[str]) -> str:
    """Return an id for a place on an object that is not taken yet.

    Examples
    --------
    >>> one = first_id("lid", (0.0, 0.0, 0.0), set())
    >>> one == first_id("lid", (3.0, 2.0, 1.0), set()), one == first_id("lid", (3, 2, 1), {one})
    (True, False)
    """
    cell = [round(value / (1e3 * _CELL_M)) for value in place_mm]
    short = "_".join(name.split())
    count = 0
    while True:
        digest = hashlib.sha256(json.dumps([name, cell, count]).encode()).digest()
        number = int.from_bytes(digest[:8], "big")
        letters = ""
        for _ in range(_LENGTH):
            number, letter = divmod(number, len(_LETTERS))
            letters += _LETTERS[letter]
        if (found := f"{short}-{letters}") not in taken:
            return found
        count += 1


def _placed(entry: Entry, clash: Clash) -> Entry:
    """Return an entry with its place as it is now, unless it is much the same."""
    old, new = _box(entry), clash.place
    moved_m = max(np.abs(old.lower - new.lower).max(), np.abs(old.upper - new.upper).max())
    if moved_m <= _MOVED_M:
        return entry
    place_mm, size_mm = place_mm_of(clash)
    return replace(entry, place_mm=place_mm, size_mm=size_mm)


def _found_again(entry: Entry, report: str) -> Entry:
    """Return an entry of what another run of a report, or another report, has, too."""
    if entry.status == "resolved":
        return replace(entry, status="new", who="", when="")
    if entry.status == "new" and report in entry.found_in:
        return replace(entry, status="active")
    return entry


def _not_found(entry: Entry, report: str) -> Entry:
    """Return an entry of what a report's new run has no more."""
    left = tuple(one for one in entry.found_in if one != report)
    if left or entry.status == "resolved":
        return replace(entry, found_in=left)
    return replace(entry, found_in=left, status="resolved", who="", when="")


@dataclass(frozen=True, slots=True)
class Decision:
    """What somebody decided about a clash.

    Attributes
    ----------
    id : str
        Of the clash.
    status : Status
        What.
    who, when : str
        By whom and when.
    comment : str or None
        Why; None leaves what stands.
    """

    id: str
    status: Status
    who: str
    when: str
    comment: str | None = None


def decided(ledger: Ledger, decisions: Sequence[Decision]) -> Ledger:
    """Return a ledger with decisions.

    Raises
    ------
    ReportError
        If there is no clash of such an id; then nothing is decided.
    """
    entries = {entry.id: entry for entry in ledger.entries}
    for one in decisions:
        if one.id not in entries:
            raise ReportError(
                f"{ledger.path}: there is no clash {one.id!r}{like(one.id, list(entries))}"
            )
        entry = replace(entries[one.id], status=one.status, who=one.who, when=one.when)
        if one.comment is not None:
            entry = replace(entry, comment=one.comment)
        entries[one.id] = entry
    return Ledger(ledger.path, tuple(entries.values()), ledger.runs)


def to_list(listed: Sequence[Listed]) -> list[dict[str, Any]]:
    """Return clashes as plain values; lengths in metres, None where something is not known."""
    return [
        {
            "id": one.entry.id,
            "status": one.entry.status,
            "who": one.entry.who,
            "when": one.entry.when,
            "comment": one.entry.comment,
            "ties": list(one.ties),
            **told_of(one.clash),
        }
        for one in listed
    ]


def told_of(clash: Clash) -> dict[str, Any]:
    """Return all about a clash but its name, as plain JSON values; None where it is not known."""
    worst = clash.worst
    told: dict[str, Any] = to_json(
        {
            "kind": clash.kind,
            "object": clash.name,
            "part": clash.part or None,
            "required_clearance_m": clash.required_m,
            "first_frame": clash.frames[0],
            "last_frame": clash.frames[-1],
            "start_s": clash.first_s,
            "stop_s": clash.last_s,
            "frames": len(clash.frames),
            "dwell_s": clash.dwell_s,
            "episodes": clash.n_episodes,
            "place_on_part_m": clash.place.center[0],
            "size_on_part_m": (clash.place.upper - clash.place.lower)[0],
            "worst": {
                "frame": worst.frame,
                "time_s": worst.time_s,
                "lower_m": worst.clearance_m[0],
                "upper_m": worst.clearance_m[1],
                "std_m": clash.std_m,
                "at_least_95_m": worst.at_least_m,
                "on_object_m": worst.on_object_world,
                "on_hull_m": worst.on_hull_world,
                "cameras_seeing": worst.n_seeing or None,
                "ends_at": worst.ends_at,
            },
            "hinges_on": clash.hinges_on,
            "component": clash.component,
            "sure": clash.is_sure,
            "doubts": clash.doubts,
        }
    )
    return told
