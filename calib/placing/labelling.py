"""Which way round each camera saw a board that looks the same when turned, or in a mirror.

No image of such a board tells; what the cameras see around it does
(`hybridve.calib.placing.surroundings`), and corners given by hand vote with the order in which they
are listed. The mirror image of any plain chessboard is a chessboard, too: a picture that is
mirrored shows by the scene alone. Where the board moves, the poses common to all frames decide
instead (`hybridve.calib.placing.link`).
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.placing.mirrored import Groups, refuse_mirrored
from hybridve.calib.placing.scene_votes import QUARTERS, Scenes, clip_corners, located
from hybridve.calib.placing.surroundings import (
    choose_looks,
)
from hybridve.calib.record import BY_SCENE, Labelling

logger = logging.getLogger(__name__)

#: An order of corners that was given by hand counts as this many agreeing matches of the scene.
_HAND_VOTES = 10.0

#: Evidence below this many standard deviations (of counts of chance matches) is called weak.
WEAK_EVIDENCE = 3.0


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
    groups = Groups(len(cameras))
    for number, board in enumerate(boards):
        seeing = [
            index for index, seen in enumerate(labelled) if clip_corners(seen, number) is not None
        ]
        may_be_mirrored = isinstance(board, Chessboard)
        if len(board.looks) == 1:
            # Only pictures are asked for; what a lens cannot have seen is told when it is linked.
            seeing = [
                index
                for index in seeing
                if may_be_mirrored
                and labelled[index].picture is not None
                and located(board, cameras[index], labelled[index], number) is not None
            ]
        if not seeing:
            continue
        seen = [labelled[i] for i in seeing]
        scenes = Scenes(board, [cameras[i] for i in seeing], seen, number)
        looks = [0] * len(seeing)
        if len(board.looks) > 1:
            looks, told = _choose(board, scenes, seen)
            decided += [] if told is None else [told]
        if may_be_mirrored:
            refuse_mirrored(scenes, looks, seeing, groups)
        for index, look in zip(seeing, looks, strict=True):
            labelled[index] = _turned(labelled[index], number, board.looks[look])
    # The weakest decides: each board by itself may turn the cameras that see it.
    weakest = min(decided, key=lambda told: told.weakest_sigma or 0.0, default=None)
    if weakest is None:
        return labelled, Labelling(looks=n_looks, decided_by="the board's colours or markers")
    return labelled, replace(weakest, looks=n_looks)


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
    board: Board, scenes: "Scenes", seen: Sequence[Observations]
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
    scenes = Scenes(board, cameras, seen, number)
    return _votes(scenes, [camera.hand_look for camera in seen])[0]


def _votes(
    scenes: "Scenes", hands: Sequence[int | None]
) -> tuple[NDArray[np.float64], dict[str, tuple[int, ...]]]:
    """Count votes for each pair of cameras and each look; return the matches among them, too."""
    cameras, n_looks = scenes.cameras, len(scenes.board.looks)
    votes = np.zeros((len(cameras), len(cameras), n_looks))
    matches: dict[str, tuple[int, ...]] = {}
    for i, j in combinations(range(len(cameras)), 2):
        votes[i, j] = scenes.agreeing(i, j)[:: QUARTERS // n_looks]
        pair = f"{cameras[i].name} {cameras[j].name}"
        matches[pair] = tuple(int(count) for count in votes[i, j])
        hand_i, hand_j = hands[i], hands[j]
        if hand_i is not None and hand_j is not None:
            votes[i, j, (hand_j - hand_i) % n_looks] += _HAND_VOTES
    return votes, matches
