"""Two reports side by side: which clashes appeared, vanished, got better or worse.

A change counts only beyond what both reports state. Their bounds are certain. What outlines and
calibration may be off by, their standard deviations, counts as well, unless both were made of the
same silhouettes: then both err alike, and a layout moved by a millimetre is a change of one. Of
several clashes one is off by chance more often than one alone: the limit is such that of two
reports of one layout, seen anew, at least 95 % show no change at all.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Any, Literal

import numpy as np

from hybridve.calib.errors import ReportError
from hybridve.calib.plain import to_json
from hybridve.hull.contact.gathering import MATCH_M, matched
from hybridve.hull.report.clashes import Clash, Clashes, gather_clashes
from hybridve.hull.report.ledger import (
    boxes_of,
    first_id,
    identified,
    ledger_path,
    place_mm_of,
    read_ledger,
    told_of,
)
from hybridve.hull.report.read import Report, read_report

#: What became of a clash; the first of these four are for the worse. "same": no change beyond what
#: is stated. "unclear": only one report has it, by no more than is stated.
Change = Literal["appeared", "worse", "vanished", "better", "unclear", "same"]

_ORDER: tuple[Change, ...] = ("appeared", "worse", "vanished", "better", "unclear", "same")

#: Of two reports of the same layout, so many may show a change.
_FALSE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """One clash in two reports.

    Attributes
    ----------
    id : str
        What it is called.
    change : Change
        What became of it.
    old, new : Clash or None
        As each report has it.
    change_m : (float, float) or None
        Bounds of by how much its clearance grew, metres; negative for the worse. None where only
        one report has it.
    beyond_m : float
        What it would have to change by to count: what both state that they may be off by.
    """

    id: str
    change: Change
    old: Clash | None
    new: Clash | None
    change_m: tuple[float, float] | None
    beyond_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Two reports side by side.

    Attributes
    ----------
    old, new : Path
        Which.
    same_silhouettes : bool
        Whether both were made of the same silhouettes, seen by the same rig.
    n_frames : int or None
        How many frames they were compared in, where they have not the same; None for all.
    distrusted : tuple of Path
        Those that are not to be trusted.
    clashes : tuple of Compared
        The worst change first.
    """

    old: Path
    new: Path
    same_silhouettes: bool
    n_frames: int | None
    distrusted: tuple[Path, ...]
    clashes: tuple[Compared, ...]

    @property
    def is_worse(self) -> bool:
        """Whether something appeared or got worse."""
        return any(one.change in ("appeared", "worse") for one in self.clashes)

    def count(self, change: Change) -> int:
        """Return how many clashes changed so."""
        return sum(one.change == change for one in self.clashes)


def compare_reports(old: Report, new: Report) -> Comparison:
    """Return what changed from one report to another.

    Of two runs of one recording only the frames that both have are compared.
    """
    together, n_frames = _frames(old, new)
    same = _same_silhouettes(old, new)
    before, after = (
        gather_clashes(report, frames=None if n_frames is None else together)
        for report in (old, new)
    )
    pairs = _pairs(before, after)
    n_tests = max(1, len(after.clashes) + len(before.clashes) - len(pairs))
    deviations = 0.0 if same else NormalDist().inv_cdf(1.0 - _FALSE / (2.0 * n_tests))
    ids = _ids(old, new, before, after, pairs)
    compared = []
    for number, clash in enumerate(after.clashes):
        if number in pairs:
            was = before.clashes[pairs[number]]
            compared.append(_both(ids[number], was, clash, deviations))
        else:
            beside = _beside(clash, before)
            compared.append(_one(ids[number], None, clash, beside, deviations))
    for number, clash in enumerate(before.clashes):
        if number not in pairs.values():
            name = ids[len(after.clashes) + number]
            compared.append(_one(name, clash, None, _beside(clash, after), deviations))
    compared.sort(key=lambda one: _ORDER.index(one.change))
    distrusted = tuple(one.path for one in (old, new) if not one.agreement.is_trusted)
    return Comparison(old.path, new.path, same, n_frames, distrusted, tuple(compared))


def _frames(old: Report, new: Report) -> tuple[list[int], int | None]:
    """Return the numbers of frames that both have, and how many where they have not the same."""
    together = np.intersect1d(old.index, new.index)
    is_one = old.settings.get("session_sha256") == new.settings.get("session_sha256")
    all_alike = len(together) == len(old.index) == len(new.index)
    if not is_one or all_alike or not len(together):
        return together.tolist(), None
    return together.tolist(), len(together)


def _same_silhouettes(old: Report, new: Report) -> bool:
    """Tell whether both saw the same: each camera's share of object pixels, in all frames."""
    together, mine, others = np.intersect1d(old.index, new.index, return_indices=True)
    if not old.cameras or list(old.cameras) != list(new.cameras) or not len(together):
        return False
    if old.rig.get("cameras") != new.rig.get("cameras"):
        return False
    return all(
        "object_share" in old.cameras[name]
        and "object_share" in new.cameras[name]
        and np.array_equal(
            old.cameras[name]["object_share"][mine],
            new.cameras[name]["object_share"][others],
            equal_nan=True,
        )
        for name in old.cameras
    )


def _pairs(before: Clashes, after: Clashes) -> dict[int, int]:
    """Return of each clash that both have its number after, and before."""
    pairs: dict[int, int] = {}
    for name in {clash.name for clash in after.clashes}:
        was = [number for number, one in enumerate(before.clashes) if one.name == name]
        now = [number for number, one in enumerate(after.clashes) if one.name == name]
        matches = matched(
            boxes_of([before.clashes[number].place for number in was]),
            boxes_of([after.clashes[number].place for number in now]),
        )
        pairs |= {now[i]: was[j] for i, j in matches.pairs.items()}
    return pairs


def _ids(
    old: Report, new: Report, before: Clashes, after: Clashes, pairs: dict[int, int]
) -> list[str]:
    """Return what the clashes after are called, and then those before; a pair is called the same.

    What the ledger beside either report calls them, the newer first; else what it would.
    """
    taken: set[str] = set()
    known: dict[Path, list[str | None]] = {}
    for report, clashes in ((new, after), (old, before)):
        ledger = read_ledger(ledger_path(report.path))
        taken |= {entry.id for entry in ledger.entries}
        known[report.path] = [one for one, _ in identified(ledger, clashes.clashes)]
    names: list[str] = []
    used: set[str] = set()

    def name(clash: Clash, *candidates: str | None) -> str:
        free = [one for one in candidates if one is not None and one not in used]
        chosen = free[0] if free else first_id(clash.name, place_mm_of(clash)[0], taken | used)
        used.add(chosen)
        return chosen

    for number, clash in enumerate(after.clashes):
        was = known[old.path][pairs[number]] if number in pairs else None
        names.append(name(clash, known[new.path][number], was))
    back = {j: i for i, j in pairs.items()}
    for number, clash in enumerate(before.clashes):
        if number in back:
            names.append(names[back[number]])
        else:
            names.append(name(clash, known[old.path][number]))
    return names


def _both(name: str, old: Clash, new: Clash, deviations: float) -> Compared:
    grew_m = _grew(old, new)
    beyond_m = _beyond(deviations, old, new)
    change: Change = "same"
    if grew_m[1] < -beyond_m:
        change = "worse"
    elif grew_m[0] > beyond_m:
        change = "better"
    return Compared(name, change, old, new, grew_m, beyond_m)


def _grew(old: Clash, new: Clash) -> tuple[float, float]:
    """Return bounds of by how much the clearance of a clash grew, metres."""
    was, now = old.worst.clearance_m, new.worst.clearance_m
    return now[0] - was[1], now[1] - was[0]


def _beyond(deviations: float, *clashes: Clash) -> float:
    """Return what a difference of clashes must exceed to count, metres; inf if nobody knows."""
    if deviations == 0.0:
        return 0.0
    std_m = math.hypot(*(one.std_m for one in clashes))
    return math.inf if math.isnan(std_m) else deviations * std_m


def _beside(clash: Clash, others: Clashes) -> list[Clash]:
    """Return the clashes of another report that one is a piece of, or holds."""
    return [
        one
        for one in others.clashes
        if one.name == clash.name and clash.around.gaps_m(one.around)[0, 0] <= MATCH_M
    ]


def _one(
    name: str, old: Clash | None, new: Clash | None, beside: Sequence[Clash], deviations: float
) -> Compared:
    """Return what became of a clash that only one report has.

    Beside one that the other has it is a piece of that, which broke off or was joined, and counts
    only if it is worse than that. Elsewhere the other report has at least the required clearance.
    """
    mine = old or new
    if mine is None:
        raise ValueError("neither report has it")
    # The deviation of the other report's clearance is taken for as large: nobody measured it.
    beyond_m = _beyond(deviations, mine, *(beside or [mine])[:1])
    limit_m = min([one.worst.clearance_m[0] for one in beside], default=mine.required_m)
    excess_m = limit_m - mine.worst.clearance_m[1]
    if beside and not excess_m > beyond_m:
        change: Change = "same"
    elif excess_m > beyond_m or (not beside and deviations == 0.0):
        change = "vanished" if new is None else "appeared"
    else:
        change = "unclear"
    return Compared(name, change, old, new, None, beyond_m)


def compare_paths(old: Path, new: Path) -> tuple[list[Comparison], list[Path]]:
    """Return what changed from reports to others: two files, or all that two folders both have.

    Returns
    -------
    list of Comparison
        One for each pair of reports.
    list of Path
        Reports of which the other folder has none of the same name.

    Raises
    ------
    ReportError
        If one is a folder and the other is not, there is nothing to compare, or a report cannot be
        read.
    """
    if old.is_dir() != new.is_dir():
        folder, file = (old, new) if old.is_dir() else (new, old)
        raise ReportError(f"{folder} is a folder, {file} is not; name two reports or two folders")
    if not old.is_dir():
        return [compare_reports(read_report(old), read_report(new))], []
    mine, others = ({path.name: path for path in folder.glob("*.h5")} for folder in (old, new))
    both = sorted(mine.keys() & others.keys())
    if not both:
        raise ReportError(f"{old} and {new} have no reports (*.h5) of the same name")
    alone = [*(mine[name] for name in sorted(mine.keys() - others.keys()))]
    alone += [others[name] for name in sorted(others.keys() - mine.keys())]
    compared = [
        compare_reports(read_report(mine[name]), read_report(others[name])) for name in both
    ]
    return compared, alone


def told_of_comparison(comparison: Comparison) -> dict[str, Any]:
    """Return a comparison as plain JSON values; lengths in metres, None where not known."""
    told: dict[str, Any] = to_json(
        {
            "old": str(comparison.old),
            "new": str(comparison.new),
            "worse": comparison.is_worse,
            "same_silhouettes": comparison.same_silhouettes,
            "frames_compared": comparison.n_frames,
            "distrusted": [str(path) for path in comparison.distrusted],
            "counts": {one: comparison.count(one) for one in _ORDER},
            "clashes": [
                {
                    "id": one.id,
                    "change": one.change,
                    "change_m": None if one.change_m is None else list(one.change_m),
                    "beyond_m": one.beyond_m,
                    "old": None if one.old is None else told_of(one.old),
                    "new": None if one.new is None else told_of(one.new),
                }
                for one in comparison.clashes
            ],
        }
    )
    return told
