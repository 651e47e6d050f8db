"""Two cameras of which each has the pictures of the other."""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from hybridve.calib.boards.board import Sighting
from hybridve.calib.errors import CalibrationError
from hybridve.calib.judging.accused import Finding
from hybridve.calib.judging.case import CLEAR_FACTOR, Case

#: Two cameras are tried in each other's place where the rig misses by more than so many times
#: REPROJECTION_TOLERANCE, on so many placements.
_EXCHANGE_TOLERANCES = 3.0
_EXCHANGE_PLACEMENTS = 6

#: With more pairs of cameras than this, only those that are accused are tried.
_MAX_EXCHANGES = 28


def exchange(
    sightings: Mapping[str, Sequence[Sighting]], first: str, second: str
) -> dict[str, Sequence[Sighting]]:
    """Return what cameras saw, two of them in each other's place."""
    exchanged = dict(sightings)
    exchanged[first], exchanged[second] = sightings[second], sightings[first]
    return exchanged


def misses_far(case: Case, found: Finding) -> bool:
    """Whether the rig misses so far that cameras may be exchanged."""
    return any(
        missed > _EXCHANGE_TOLERANCES * case.limits_px[index]
        for index, missed in found.everything.rms_px.items()
    )


def exchangeable(case: Case, found: Finding) -> list[tuple[str, str]]:
    """Return pairs of cameras in whose places the others' pictures fit better, best first."""
    pairs = list(combinations(range(len(case.names)), 2))
    if len(pairs) > _MAX_EXCHANGES:
        odd = {*found.moved, *found.suspects}
        pairs = [pair for pair in pairs if set(pair) <= odd]
    places = np.unique(case.table.place)
    some = np.linspace(0, len(places) - 1, min(len(places), _EXCHANGE_PLACEMENTS)).round()
    chosen = {case.moments[int(places[int(number)])] for number in some}
    sightings: dict[str, list[Sighting]] = {name: [] for name in case.names}
    for view in case.views:
        if view.moment in chosen:
            sightings[view.camera].append(Sighting("", *view.moment, view.pixels))
    now = Case.of(case.rig, case.boards, sightings).worst_miss()
    ranked = []
    for i, j in pairs:
        first, second = case.names[i], case.names[j]
        sizes = [(c.width_px, c.height_px) for c in (case.rig[first], case.rig[second])]
        if sizes[0] != sizes[1]:
            continue
        try:
            swapped = Case.of(case.rig, case.boards, exchange(sightings, first, second))
        except CalibrationError:
            continue  # a lens cannot have seen what the other did
        missed = swapped.worst_miss()
        if missed < now / CLEAR_FACTOR:
            ranked.append((missed, (first, second)))
    return [pair for _, pair in sorted(ranked)]
