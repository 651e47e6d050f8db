"""Whether cameras stand where a rig says, or turned about a board that looks the same when turned.

A rig of which cameras are turned about a symmetric board, by one of the turns that leave its look,
agrees with every picture of that board alone. A board that looks different when turned tells, and
so does a symmetric one that was seen in two places; where it only lies still, what the cameras see
around it does, as it does where rigs are made (`hybridve.calib.placing.labelling`). Where nothing
tells, that is said: such a rig is neither right nor wrong.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations
from hybridve.calib.placing.labelling import WEAK_EVIDENCE, votes_for_looks
from hybridve.calib.placing.mirrored import CLEAR_EVIDENCE
from hybridve.calib.placing.surroundings import LooksByVote, choose_looks, sigmas_apart
from hybridve.calib.pose import Pose, compose, invert, transform
from hybridve.calib.solving.placement import Placed, imaged
from hybridve.calib.verdict import Turned

#: Boards in two places exclude a turn if it would move one of them in an image by so many times
#: what a camera may miss: each of two cameras between which it is placed shows half of that, and
#: its other places and the scale take a share.
_EXCLUDED = 4.0

#: Votes for what boards themselves tell: more than there are matches of any scene.
_CERTAIN = 1e6


@dataclass(frozen=True, slots=True)
class ListedView:
    """One board in one image, listed as those of other cameras that saw it at that moment.

    Attributes
    ----------
    camera, place : int
        Which camera of the rig, and which placement of the boards.
    board : int
        Which of the boards.
    look : int
        Which look of the board the list as it was found is read in.
    """

    camera: int
    place: int
    board: int
    look: int


@dataclass(frozen=True, slots=True)
class Turns:
    """What tells whether cameras are turned about a board.

    Attributes
    ----------
    turned : dict of int to Turned
        The cameras that are, or may be.
    sides : tuple of tuple of int
        All of those that are; or, where it may as well be others of as many cameras, these sides,
        of which one stands as the rig says.
    undecided : tuple of int
        Cameras of which nothing tells.
    """

    turned: dict[int, Turned]
    sides: tuple[tuple[int, ...], ...]
    undecided: tuple[int, ...]


def judge_turns(
    boards: Sequence[Board],
    placed: Placed,
    views: Sequence[ListedView],
    limits_px: NDArray[np.float64],
    around: Mapping[int, Observations],
) -> Turns:
    """Tell which cameras of a rig that agrees with its boards are turned about one all the same.

    All cameras turned alike are not turned: that is another world, which no board tells.

    Parameters
    ----------
    boards : sequence of Board
        The boards.
    placed : Placed
        The cameras, and the boards by their middles, in one world.
    views : sequence of ListedView
        What the cameras saw.
    limits_px : (C,) float64
        How far each camera may miss the boards and still agree, pixels.
    around : mapping of int to Observations
        By camera what it saw in the clip, with its picture; those of cameras of which a board lies
        still are used.
    """
    groups = _Groups({view.camera for view in views})
    _join_by_boards(groups, boards, placed, views, limits_px)
    turned: dict[int, Turned] = {}
    sides: tuple[tuple[int, ...], ...] = ()
    unsure: set[int] = set()
    for number, board in enumerate(boards):
        if groups.count == 1:
            break
        looks = {
            view.camera: view.look
            for view in views
            if view.board == number
            and view.camera in around
            and around[view.camera].is_still
            and view.camera not in turned
        }
        if len(board.looks) == 1 or len({groups.of(camera) for camera in looks}) < 2:
            continue
        seeing = sorted(looks)
        votes = votes_for_looks(
            board,
            [placed.cameras[camera] for camera in seeing],
            [around[camera] for camera in seeing],
            number,
        )
        for i, j in combinations(range(len(seeing)), 2):
            # From the lists as they were found to those that the rig implies.
            ahead = looks[seeing[j]] - looks[seeing[i]]
            votes[i, j] = np.roll(votes[i, j], -ahead)
            if groups.of(seeing[i]) == groups.of(seeing[j]):
                votes[i, j, 0] += _CERTAIN
        chosen = choose_looks(votes)
        weak = {seeing[place] for place in _weak(chosen)}
        # Cameras of which nothing is known count neither as guilty nor as witnesses.
        sure = [place for place, camera in enumerate(seeing) if camera not in weak]
        found, accused = _accused(board, number, placed, views, seeing, votes, chosen, sure)
        sides += accused
        turned |= found
        unsure |= weak
        if not found and len({chosen.looks[place] for place in sure}) > 1:
            unsure |= set(seeing)  # the scene is against the rig, but not clearly
        groups.join([camera for camera in seeing if camera not in unsure and camera not in turned])
    apart = groups.apart() - set(turned)
    return Turns(turned, sides, tuple(sorted(apart)))


class _Groups:
    """Cameras that are known not to be turned against each other."""

    def __init__(self, cameras: set[int]) -> None:
        self._group = {camera: camera for camera in cameras}

    def of(self, camera: int) -> int:
        return self._group[camera]

    @property
    def count(self) -> int:
        return len(set(self._group.values()))

    def join(self, cameras: Sequence[int]) -> None:
        joined = {self._group[camera] for camera in cameras}
        for camera, group in self._group.items():
            if group in joined:
                self._group[camera] = min(joined)

    def apart(self) -> set[int]:
        """Return the cameras that are not of the largest group; all, if several are as large."""
        if self.count < 2:
            return set()
        sizes = Counter(self._group.values()).most_common()
        if sizes[0][1] == sizes[1][1]:
            return set(self._group)
        return {camera for camera, group in self._group.items() if group != sizes[0][0]}


# --- What boards tell -------------------------------------------------------------------------


def _join_by_boards(
    groups: _Groups,
    boards: Sequence[Board],
    placed: Placed,
    views: Sequence[ListedView],
    limits_px: NDArray[np.float64],
) -> None:
    """Join cameras that saw together what only they, as they stand, can have seen together."""
    shared: dict[tuple[int, int], list[ListedView]] = {}
    by_place: dict[int, list[ListedView]] = {}
    for view in views:
        by_place.setdefault(view.place, []).append(view)
    for together in by_place.values():
        for one, other in combinations(sorted(together, key=lambda view: view.camera), 2):
            shared.setdefault((one.camera, other.camera), []).append(other)
    for pair, seen in sorted(shared.items()):
        if groups.of(pair[0]) != groups.of(pair[1]):
            limit_px = _EXCLUDED * float(limits_px[list(pair)].max())
            if all(_tells(boards, placed, camera, seen, limit_px) for camera in pair):
                groups.join(pair)


def _tells(
    boards: Sequence[Board],
    placed: Placed,
    camera: int,
    seen: Sequence[ListedView],
    limit_px: float,
) -> bool:
    """Tell whether boards exclude every turn about one of them that leaves its look."""
    first = min(seen, key=lambda view: len(boards[view.board].looks))
    n_looks = len(boards[first.board].looks)
    for look in range(1, n_looks):
        about = placed.boards[first.place]
        turn = compose(compose(about, _turn(look, n_looks)), invert(about))
        if not any(
            _moved_px(boards[view.board], placed, camera, view.place, turn) > limit_px
            for view in seen
        ):
            return False
    return True


def _moved_px(board: Board, placed: Placed, camera: int, place: int, turn: Pose) -> float:
    """Return how far a turn of the world moves a board in an image, up to the board's own looks."""
    world_from_board = placed.boards[place]
    points = placed.scale * (board.points_board - board.center_board)
    seen_by = placed.cameras[camera]
    turned = transform(compose(turn, world_from_board), points)
    pixels = imaged(seen_by, transform(seen_by.cam_from_world, turned))
    n_looks = len(board.looks)
    misses = []
    for look in range(n_looks):
        alike = transform(compose(world_from_board, _turn(look, n_looks)), points)
        missed = imaged(seen_by, transform(seen_by.cam_from_world, alike)) - pixels
        misses.append(float(np.sqrt((missed**2).sum(axis=1).mean())))
    return min(misses)


def _turn(look: int, n_looks: int) -> Pose:
    """Return the turn (3, 4) about a board's own middle of one of its looks."""
    angle = 2.0 * math.pi * look / n_looks
    cosine, sine = round(math.cos(angle)), round(math.sin(angle))
    return np.array(
        [[cosine, -sine, 0.0, 0.0], [sine, cosine, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]], np.float64
    )


# --- What the scene tells ---------------------------------------------------------------------


def _weak(chosen: LooksByVote) -> set[int]:
    """Return the cameras that might be turned against the votes: of each weak side, the fewer."""
    everyone = frozenset(range(len(chosen.looks)))
    weak: set[int] = set()
    for side, margin in chosen.sides:
        if margin < WEAK_EVIDENCE:
            rest = everyone - side
            weak |= min(side, rest, key=len)
            if len(side) == len(rest):
                weak |= everyone
    return weak


def _accused(
    board: Board,
    number: int,
    placed: Placed,
    views: Sequence[ListedView],
    seeing: Sequence[int],
    votes: NDArray[np.float64],
    chosen: LooksByVote,
    sure: Sequence[int],
) -> tuple[dict[int, Turned], tuple[tuple[int, ...], ...]]:
    """Return the cameras that the scene clearly has elsewhere, and of which sides it may be."""
    n_looks = len(board.looks)
    counts = Counter(chosen.looks[place] for place in sure).most_common()
    if len(counts) < 2:
        return {}, ()
    across = [(i, j) for i, j in combinations(sure, 2) if chosen.looks[i] != chosen.looks[j]]
    speaking = sum(votes[i, j, (chosen.looks[j] - chosen.looks[i]) % n_looks] for i, j in across)
    sigma = sigmas_apart(float(speaking), float(sum(votes[i, j, 0] for i, j in across)))
    if sigma < CLEAR_EVIDENCE:
        return {}, ()
    most = [look for look, count in counts if count == counts[0][1]]
    by_look: dict[int, list[int]] = {}
    place_of = {view.camera: view.place for view in views if view.board == number}
    turned = {}
    for place in sure:
        camera, look = seeing[place], chosen.looks[place]
        against = next((other for other in most if other != look), look)
        if against == look:
            continue  # the side of most cameras
        by_look.setdefault(look, []).append(camera)
        steps = (look - against) % n_looks
        angle = 2.0 * math.pi * min(steps, n_looks - steps) / n_looks
        middle_from_world = invert(placed.boards[place_of[camera]])
        center = transform(middle_from_world, placed.cameras[camera].center_world[None])[0]
        shift = 2.0 * math.sin(angle / 2.0) * float(np.hypot(center[0], center[1]))
        turned[camera] = Turned(math.degrees(angle), shift / placed.scale, sigma)
    # Where one side is the largest, all others are turned against it.
    sides = [tuple(cameras) for look, cameras in sorted(by_look.items()) if look in most]
    others = tuple(camera for camera in turned if not any(camera in side for side in sides))
    return turned, (*sides, *([others] if others else []))
