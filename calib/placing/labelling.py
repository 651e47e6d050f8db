"""Which way round each camera saw a board that looks the same when turned, or in a mirror.

No image of such a board tells; what the cameras see around it does
(`hybridve.calib.placing.surroundings`), and corners given by hand vote with the order in which they
are listed. The mirror image of any plain chessboard is a chessboard, too: a picture that is
mirrored shows by the scene alone. Where the board moves, the poses common to all frames decide
instead (`hybridve.calib.placing.link`).
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.placing.surroundings import (
    MAX_FEATURES,
    SceneFeatures,
    choose_looks,
    count_agreeing,
    describe_scene,
    sigmas_apart,
    with_floor,
)
from hybridve.calib.pose import Pose, compose, invert
from hybridve.calib.record import BY_SCENE, Labelling
from hybridve.calib.solving.lens_fit import locate_board

logger = logging.getLogger(__name__)

#: An order of corners that was given by hand counts as this many agreeing matches of the scene.
_HAND_VOTES = 10.0

#: Evidence below this many standard deviations (of counts of chance matches) is called weak.
WEAK_EVIDENCE = 3.0

#: The scene tells that two pictures are alike, or that one of them is mirrored, from so many
#: standard deviations on: a rig has a hundred pairs, and matches that err are not independent.
CLEAR_EVIDENCE = 5.0

#: A picture is called mirrored if so many times more matches agree when it is flipped.
_CLEAR_FACTOR = 2.0

#: Whether a picture is mirrored is asked of so many pairs of each camera, the nearest first, and,
#: where nothing else is, of so many features: the answer must be quick where pictures agree, and
#: not take long where none do.
_TRIES = 3
_FEATURES = 1000

#: Turns of a board by a quarter; those that are none of its looks show what chance agrees to.
_QUARTERS = 4


def label_still_boards(
    boards: Sequence[Board], cameras: Sequence[Camera], observations: Sequence[Observations]
) -> tuple[list[Observations], Labelling]:
    """List the corners of still, symmetric boards in one order in all cameras.

    Cameras whose pictures of the scene around a plain chessboard do not agree are tried with their
    pictures flipped, too.

    Parameters
    ----------
    boards : sequence of Board
        The boards; sightings count them.
    cameras : sequence of Camera
        Their lenses.
    observations : sequence of Observations
        Of these cameras; boards lie still in their clips.

    Returns
    -------
    observations : list of Observations
        The same with the clip's symmetric boards listed alike.
    evidence : Labelling
        What decided; of several symmetric boards that of which the evidence is weakest.

    Raises
    ------
    CalibrationError
        If a lens cannot have seen the board of its clip; naming the camera, if its picture is
        mirrored.
    """
    n_looks = max(len(board.looks) for board in boards)
    decided: list[Labelling] = []
    labelled = list(observations)
    groups = _Groups(len(cameras))
    for number, board in enumerate(boards):
        seeing = [
            index for index, seen in enumerate(labelled) if _clip_corners(seen, number) is not None
        ]
        may_be_mirrored = isinstance(board, Chessboard)
        if len(board.looks) == 1:
            # Only pictures are asked for; what a lens cannot have seen is told when it is linked.
            seeing = [
                index
                for index in seeing
                if may_be_mirrored
                and labelled[index].picture is not None
                and _located(board, cameras[index], labelled[index], number) is not None
            ]
        if not seeing:
            continue
        seen = [labelled[i] for i in seeing]
        scenes = _Scenes(board, [cameras[i] for i in seeing], seen, number)
        looks = [0] * len(seeing)
        if len(board.looks) > 1:
            looks, told = _choose(board, scenes, seen)
            decided += [] if told is None else [told]
        if may_be_mirrored:
            _refuse_mirrored(scenes, looks, seeing, groups)
        for index, look in zip(seeing, looks, strict=True):
            labelled[index] = _turned(labelled[index], number, board.looks[look])
    # The weakest decides: each board by itself may turn the cameras that see it.
    weakest = min(decided, key=lambda told: told.weakest_sigma or 0.0, default=None)
    if weakest is None:
        return labelled, Labelling(looks=n_looks, decided_by="the board's colours or markers")
    return labelled, replace(weakest, looks=n_looks)


def _clip_corners(seen: Observations, board: int) -> NDArray[np.float64] | None:
    """Return the corners of a board in the clip where it lies still, or None."""
    for sighting in seen.sightings:
        if sighting.instant is not None and sighting.board == board:
            return sighting.pixels
    return None


def _turned(seen: Observations, board: int, order: NDArray[np.intp]) -> Observations:
    return replace(
        seen,
        sightings=tuple(
            replace(sighting, pixels=sighting.pixels[order])
            if sighting.instant is not None and sighting.board == board
            else sighting
            for sighting in seen.sightings
        ),
    )


def _choose(
    board: Board, scenes: "_Scenes", seen: Sequence[Observations]
) -> tuple[list[int], Labelling | None]:
    """Choose the look of one board in each camera; return looks and what decided, if anything."""
    cameras = scenes.cameras
    n_cameras, n_looks = len(cameras), len(board.looks)
    evidence = None
    looks = [0] * n_cameras
    hands = [camera.hand_look for camera in seen]
    if n_cameras > 1:
        votes, matches = _votes(scenes, hands)
        chosen = choose_looks(votes)
        looks = list(chosen.looks)
        by_hand = sum(hand is not None for hand in hands) > 1
        evidence = Labelling(
            looks=n_looks,
            decided_by=BY_SCENE + (" and corners by hand" if by_hand else ""),
            matches_by_look=matches,
            margin_sigma={
                camera.name: round(margin, 2)
                for camera, margin in zip(cameras, chosen.margins_sigma, strict=True)
            },
            weakest_sigma=round(chosen.weakest_sigma, 2),
            is_weak=bool(chosen.weakest_sigma < WEAK_EVIDENCE),
        )
        log = logger.warning if evidence.is_weak else logger.info
        log(
            "the board looks the same turned by %d degrees; %s decide which way round each camera "
            "saw it, by %.1f sigma at the weakest%s",
            360 // n_looks,
            evidence.decided_by,
            chosen.weakest_sigma,
            ": uncertain; check the cameras' distances, mark the corners by hand in one order, or "
            "use a board with an odd sum of columns and rows"
            if evidence.is_weak
            else "",
        )
    # The world turns with all cameras alike: the first order given by hand sets it, else the way
    # in which the first camera sees columns run to the right.
    turn = -looks[0]
    for hand, look in zip(hands, looks, strict=True):
        if hand is not None:
            turn = hand - look
            break
    return [(look + turn) % n_looks for look in looks], evidence


def votes_for_looks(
    board: Board, cameras: Sequence[Camera], seen: Sequence[Observations], number: int
) -> NDArray[np.float64]:
    """Count what speaks for how much further each camera saw a still board turned than another.

    Parameters
    ----------
    board : Board
        The board.
    cameras, seen : sequence of Camera, sequence of Observations
        Cameras in whose clip it lies still, of which the lenses are used, and what they saw.
    number : int
        The board's number, as sightings count.

    Returns
    -------
    votes : (C, C, L) float64
        ``votes[i, j, k]``, for i < j: matches of the scene, and corners given by hand, for which
        camera j saw the board k looks ahead of camera i, both by their own lists of corners.

    Raises
    ------
    CalibrationError
        If a lens cannot have seen the board of its clip.
    """
    scenes = _Scenes(board, cameras, seen, number)
    return _votes(scenes, [camera.hand_look for camera in seen])[0]


def _votes(
    scenes: "_Scenes", hands: Sequence[int | None]
) -> tuple[NDArray[np.float64], dict[str, tuple[int, ...]]]:
    """Count votes for each pair of cameras and each look; return the matches among them, too."""
    cameras, n_looks = scenes.cameras, len(scenes.board.looks)
    votes = np.zeros((len(cameras), len(cameras), n_looks))
    matches: dict[str, tuple[int, ...]] = {}
    for i, j in combinations(range(len(cameras)), 2):
        votes[i, j] = scenes.agreeing(i, j)[:: _QUARTERS // n_looks]
        pair = f"{cameras[i].name} {cameras[j].name}"
        matches[pair] = tuple(int(count) for count in votes[i, j])
        hand_i, hand_j = hands[i], hands[j]
        if hand_i is not None and hand_j is not None:
            votes[i, j, (hand_j - hand_i) % n_looks] += _HAND_VOTES
    return votes, matches


def _clip_pose(board: Board, camera: Camera, seen: Observations, number: int) -> Pose:
    pose = _located(board, camera, seen, number)
    if pose is None:
        raise CalibrationError(
            f"camera {camera.name!r}: the lens fitted to its stills cannot have seen the board "
            "clip; were both recorded by this camera, with the same zoom?"
        )
    return pose


def _located(board: Board, camera: Camera, seen: Observations, number: int) -> Pose | None:
    corners = _clip_corners(seen, number)
    assert corners is not None
    located = locate_board(camera, board.points_board, corners)
    return None if located is None else located[0]


class _Scenes:
    """What cameras recognise around one still board, found out when it is asked for."""

    def __init__(
        self, board: Board, cameras: Sequence[Camera], seen: Sequence[Observations], number: int
    ) -> None:
        self.board = board
        self.cameras = cameras
        self.poses = [
            _clip_pose(board, camera, observed, number)
            for camera, observed in zip(cameras, seen, strict=True)
        ]
        self.has_picture = [observed.picture is not None for observed in seen]
        self._pictures = [observed.picture for observed in seen]
        self._max_features = _FEATURES if len(board.looks) == 1 else MAX_FEATURES
        self._turns = [_quarter_turn(board, quarters) for quarters in range(_QUARTERS)]
        self._features: dict[tuple[int, bool, bool], SceneFeatures] = {}
        self._counts: dict[tuple[int, int, bool, bool], NDArray[np.intp]] = {}

    def agreeing(
        self, i: int, j: int, is_flipped: bool = False, has_floor: bool = True
    ) -> NDArray[np.intp]:
        """Count the matches that agree if j saw the board 0 to 3 quarters ahead of i: (4,).

        Parameters
        ----------
        i, j : int
            Two cameras, i < j unless `is_flipped`.
        is_flipped : bool
            Whether the picture of j is flipped left to right first.
        has_floor : bool
            Whether views of the floor from above are compared, too: they take the most time.
        """
        if not (self.has_picture[i] and self.has_picture[j]):
            return np.zeros(_QUARTERS, np.intp)
        key = (i, j, is_flipped, has_floor)
        if key not in self._counts:
            self._counts[key] = count_agreeing(
                self._described(i, False, has_floor),
                self.poses[i],
                self._described(j, is_flipped, has_floor),
                self._pose(j, is_flipped),
                self.board,
                self._turns,
            )
        return self._counts[key]

    def _pose(self, camera: int, is_flipped: bool) -> Pose:
        pose = self.poses[camera]
        if not is_flipped:
            return pose
        assert isinstance(self.board, Chessboard)
        return unmirrored(pose, self.board)

    def _described(self, camera: int, is_flipped: bool, has_floor: bool) -> SceneFeatures:
        key = (camera, is_flipped, has_floor)
        if key not in self._features:
            picture = self._pictures[camera]
            assert picture is not None
            about = (
                self.cameras[camera],
                self._pose(camera, is_flipped),
                picture,
                self.board,
                is_flipped,
                self._max_features,
            )
            self._features[key] = (
                with_floor(self._described(camera, is_flipped, False), *about)
                if has_floor
                else describe_scene(*about)
            )
        return self._features[key]


def _quarter_turn(board: Board, quarters: int) -> Pose:
    """Return the motion (3, 4) that turns a board about its middle, as `board_from_turned` does."""
    cosine, sine = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[quarters]
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return np.column_stack([rotation, board.center_board - rotation @ board.center_board])


# --- Mirrored pictures ------------------------------------------------------------------------


def unmirrored(cam_from_board: Pose, board: Chessboard) -> Pose:
    """Return where a camera is whose picture of a still chessboard was mirrored left to right.

    Of the mirrors that map the board onto itself one is taken that leaves the colours of its
    squares, if there is one: in the mirrored picture the list started at that corner.

    Parameters
    ----------
    cam_from_board : (3, 4) float64
        Where it seems to be, by corners listed as of a picture that is not mirrored.
    board : Chessboard
        The board.

    Returns
    -------
    cam_from_board : (3, 4) float64
        Where it is, in one of the board's looks.
    """
    if board.columns % 2 == 0:
        mirror = np.diag([-1.0, 1.0, 1.0])
    elif board.rows % 2 == 0:
        mirror = np.diag([1.0, -1.0, 1.0])
    elif board.columns == board.rows:
        mirror = np.eye(3)[[1, 0, 2]]
    else:
        mirror = np.diag([-1.0, 1.0, 1.0])
    board_from_mirrored = np.column_stack(
        [mirror, board.center_board - mirror @ board.center_board]
    )
    return np.diag([-1.0, 1.0, 1.0]) @ compose(cam_from_board, board_from_mirrored)


class _Groups:
    """Cameras whose pictures are known to be mirrored all or none."""

    def __init__(self, n_cameras: int) -> None:
        self._group = list(range(n_cameras))

    def are_one(self, one: int, other: int) -> bool:
        return self._group[one] == self._group[other]

    def join(self, one: int, other: int) -> None:
        old, new = self._group[other], self._group[one]
        self._group = [new if group == old else group for group in self._group]

    def among(self, cameras: Sequence[int]) -> list[list[int]]:
        """Return the places in `cameras` of those of each group, the largest group first."""
        groups: dict[int, list[int]] = {}
        for place, camera in enumerate(cameras):
            groups.setdefault(self._group[camera], []).append(place)
        return sorted(groups.values(), key=len, reverse=True)


def _refuse_mirrored(
    scenes: _Scenes, looks: Sequence[int], seeing: Sequence[int], groups: _Groups
) -> None:
    """Refuse a picture that agrees with those of the other cameras only if it is flipped.

    Parameters
    ----------
    scenes : _Scenes
        What the cameras see around one board.
    looks : sequence of int
        The look of the board that each of them saw, by the pictures as they are.
    seeing : sequence of int
        Which cameras they are; `groups` counts them so.
    groups : _Groups
        Gains what is found out: pictures that agree as they are are both mirrored or both not.

    Raises
    ------
    CalibrationError
        Naming the camera.
    """
    quarters = [look * (_QUARTERS // len(scenes.board.looks)) for look in looks]
    pictured = [place for place in range(len(seeing)) if scenes.has_picture[place]]
    # The pictures themselves are mostly enough; views of the floor are drawn only if they are not,
    # or have been to choose the looks.
    unlike: list[tuple[int, int]] = []
    for has_floor in (False, True) if len(scenes.board.looks) == 1 else (True,):
        unlike = []
        tries = dict.fromkeys(pictured, 0)
        for i, j in _nearest_first(scenes, pictured):
            if groups.are_one(seeing[i], seeing[j]) or min(tries[i], tries[j]) >= _TRIES:
                continue
            counts = scenes.agreeing(i, j, has_floor=has_floor).tolist()
            agreeing = counts.pop((quarters[j] - quarters[i]) % _QUARTERS)
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


def _nearest_first(scenes: _Scenes, places: Sequence[int]) -> list[tuple[int, int]]:
    """Return pairs of cameras, those first that see the board's middle from alike directions."""
    directions = {}
    for place in places:
        ray = invert(scenes.poses[place])[:, 3] - scenes.board.center_board
        directions[place] = ray / np.linalg.norm(ray)
    return sorted(
        combinations(places, 2), key=lambda pair: -float(directions[pair[0]] @ directions[pair[1]])
    )


def _compare_flipped(
    scenes: _Scenes, quarters: Sequence[int], pairs: Sequence[tuple[int, int]]
) -> tuple[int, int, int]:
    """Return how many matches of pairs agree as they are, the second flipped, and by chance.

    By chance is what agrees most when the second pictures are flipped and the board is turned by
    what is no look of it, or not the best.
    """
    plain = 0
    flipped = np.zeros(_QUARTERS, np.intp)
    for i, j in pairs:
        first, second = min(i, j), max(i, j)
        ahead = (quarters[second] - quarters[first]) % _QUARTERS
        plain += int(scenes.agreeing(first, second)[ahead])
        # In a mirror turns run backwards.
        flipped += np.roll(scenes.agreeing(i, j, True), quarters[i] + quarters[j])
    step = _QUARTERS // len(scenes.board.looks)
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
