"""Pictures that are mirrored, of boards that do not tell."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from hybridve.calib.errors import CalibrationError
from hybridve.calib.placing.scene_votes import QUARTERS, TRIES, Scenes
from hybridve.calib.placing.surroundings import (
    sigmas_apart,
)
from hybridve.calib.pose import invert

#: The scene tells that two pictures are alike, or that one of them is mirrored, from so many
#: standard deviations on: a rig has a hundred pairs, and matches that err are not independent.
CLEAR_EVIDENCE = 5.0

#: A picture is called mirrored if so many times more matches agree when it is flipped.
_CLEAR_FACTOR = 2.0


class Groups:
    """Cameras whose pictures are known to be mirrored all or none."""

    def __init__(self, n_cameras: int) -> None:
        self._group = list(range(n_cameras))

    def are_one(self, one: int, other: int) -> bool:
        """Tell whether two cameras are known to be of one kind."""
        return self._group[one] == self._group[other]

    def join(self, one: int, other: int) -> None:
        """Take note that two cameras are of one kind, and with them all that are of theirs."""
        old, new = self._group[other], self._group[one]
        self._group = [new if group == old else group for group in self._group]

    def among(self, cameras: Sequence[int]) -> list[list[int]]:
        """Return the places in `cameras` of those of each group, the largest group first."""
        groups: dict[int, list[int]] = {}
        for place, camera in enumerate(cameras):
            groups.setdefault(self._group[camera], []).append(place)
        return sorted(groups.values(), key=len, reverse=True)


def refuse_mirrored(
    scenes: Scenes, looks: Sequence[int], seeing: Sequence[int], groups: Groups
) -> None:
    """Refuse a picture that agrees with those of the other cameras only if it is flipped.

    Parameters
    ----------
    scenes : Scenes
        What the cameras see around one board.
    looks : sequence of int
        The look of the board that each of them saw, by the pictures as they are.
    seeing : sequence of int
        Which cameras they are; `groups` counts them so.
    groups : Groups
        Gains what is found out: pictures that agree as they are are both mirrored or both not.

    Raises
    ------
    CalibrationError
        Naming the camera.
    """
    quarters = [look * (QUARTERS // len(scenes.board.looks)) for look in looks]
    pictured = [place for place in range(len(seeing)) if scenes.has_picture[place]]
    # The pictures themselves are mostly enough; views of the floor are drawn only if they are not,
    # or have been to choose the looks.
    unlike: list[tuple[int, int]] = []
    for has_floor in (False, True) if len(scenes.board.looks) == 1 else (True,):
        unlike = []
        tries = dict.fromkeys(pictured, 0)
        for i, j in _nearest_first(scenes, pictured):
            if groups.are_one(seeing[i], seeing[j]) or min(tries[i], tries[j]) >= TRIES:
                continue
            counts = scenes.agreeing(i, j, has_floor=has_floor).tolist()
            agreeing = counts.pop((quarters[j] - quarters[i]) % QUARTERS)
            if sigmas_apart(agreeing, max(counts)) > CLEAR_EVIDENCE:
                groups.join(seeing[i], seeing[j])
            else:
                unlike.append((i, j))
                tries[i] += 1
                tries[j] += 1
    parts = groups.among([seeing[place] for place in pictured])
    parts = [[pictured[place] for place in part] for part in parts]
    compared = []
    for one, other in combinations(range(len(parts)), 2):
        pairs = [
            (i, j) for i, j in product(parts[one], parts[other]) if (min(i, j), max(i, j)) in unlike
        ]
        plain, flipped, chance = _compare_flipped(scenes, quarters, pairs)
        rival = max(plain, chance)
        sigmas = sigmas_apart(flipped, rival)
        if sigmas > CLEAR_EVIDENCE and flipped > _CLEAR_FACTOR * rival:
            compared.append(_Mirrored(sigmas, one, other, plain, flipped))
    if compared:
        raise _mirrored_error([camera.name for camera in scenes.cameras], parts, compared)


def _nearest_first(scenes: Scenes, places: Sequence[int]) -> list[tuple[int, int]]:
    """Return pairs of cameras, those first that see the board's middle from alike directions."""
    directions = {}
    for place in places:
        ray = invert(scenes.poses[place])[:, 3] - scenes.board.center_board
        directions[place] = ray / np.linalg.norm(ray)
    return sorted(
        combinations(places, 2), key=lambda pair: -float(directions[pair[0]] @ directions[pair[1]])
    )


def _compare_flipped(
    scenes: Scenes, quarters: Sequence[int], pairs: Sequence[tuple[int, int]]
) -> tuple[int, int, int]:
    """Return how many matches of pairs agree as they are, the second flipped, and by chance.

    By chance is what agrees most when the second pictures are flipped and the board is turned by
    what is no look of it, or not the best.
    """
    plain = 0
    flipped = np.zeros(QUARTERS, np.intp)
    for i, j in pairs:
        first, second = min(i, j), max(i, j)
        ahead = (quarters[second] - quarters[first]) % QUARTERS
        plain += int(scenes.agreeing(first, second)[ahead])
        # In a mirror turns run backwards.
        flipped += np.roll(scenes.agreeing(i, j, True), quarters[i] + quarters[j])
    step = QUARTERS // len(scenes.board.looks)
    best = step * int(np.argmax(flipped[::step]))
    return plain, int(flipped[best]), int(np.delete(flipped, best).max())


@dataclass(frozen=True, slots=True)
class _Mirrored:
    """Two parts of the cameras that agree if the pictures of one of them are flipped."""

    sigmas: float
    one: int
    other: int
    plain: int
    flipped: int


def _mirrored_error(
    names: Sequence[str], parts: Sequence[Sequence[int]], compared: Sequence[_Mirrored]
) -> CalibrationError:
    """Return what to say: of the two kinds of cameras the fewer are mirrored."""
    surest_first = sorted(compared, key=lambda pair: -pair.sigmas)
    side = {surest_first[0].one: False}
    grew = True
    while grew:
        grew = False
        for pair in surest_first:
            for near, far in ((pair.one, pair.other), (pair.other, pair.one)):
                if near in side and far not in side:
                    side[far], grew = not side[near], True
    across = [pair for pair in compared if pair.one in side and side[pair.one] != side[pair.other]]
    these, those = (
        sorted(place for part in side if side[part] == wanted for place in parts[part])
        for wanted in (False, True)
    )
    few, many = sorted((these, those), key=len)
    is_one = len(few) == 1
    who = ", ".join(repr(names[place]) for place in few)
    if len(few) == len(many):
        others = ", ".join(repr(names[place]) for place in many)
        if is_one:
            who = f"the picture of camera {who} or of {others} seems to be mirrored"
        else:
            who = f"the pictures of cameras {who} or of {others} seem to be mirrored"
    elif is_one:
        who = f"camera {who}: its picture seems to be mirrored"
    else:
        who = f"cameras {who}: their pictures seem to be mirrored"
    it = "it is" if is_one else "they are"
    return CalibrationError(
        f"{who}: {sum(pair.flipped for pair in across)} matches of the scene agree with the others "
        f"if {it} flipped left to right, {sum(pair.plain for pair in across)} if not; record "
        f"{'it' if is_one else 'them'} unmirrored"
    )
