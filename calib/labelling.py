"""Which way round each camera saw a board that looks the same when it is turned.

No image of such a board tells; what the cameras see around it does (`hybridve.calib.scene`), and
corners given by hand vote with the order in which they are listed. Where the board moves, the poses
common to all frames decide instead (`hybridve.calib.link`).
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.board import Board, Observations
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens_fit import locate_board
from hybridve.calib.pose import Pose
from hybridve.calib.scene import choose_looks, count_agreeing, describe_scene

logger = logging.getLogger(__name__)

#: An order of corners that was given by hand counts as this many agreeing matches of the scene.
_HAND_VOTES = 10.0

#: Evidence below this many standard deviations (of counts of chance matches) is called weak.
_WEAK_EVIDENCE = 3.0


def label_still_boards(
    boards: Sequence[Board], cameras: Sequence[Camera], observations: Sequence[Observations]
) -> tuple[list[Observations], dict[str, Any]]:
    """List the corners of still, symmetric boards in one order in all cameras.

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
    evidence : dict
        What decided, as plain JSON values.

    Raises
    ------
    CalibrationError
        If a lens cannot have seen the board of its clip.
    """
    evidence: dict[str, Any] = {
        "looks": max(len(board.looks) for board in boards),
        "decided_by": "the board's colours or markers",
    }
    labelled = list(observations)
    for number, board in enumerate(boards):
        seeing = [
            index for index, seen in enumerate(labelled) if _clip_corners(seen, number) is not None
        ]
        if len(board.looks) == 1 or not seeing:
            continue
        looks, told = _choose(
            board, [cameras[i] for i in seeing], [labelled[i] for i in seeing], number
        )
        evidence |= told
        for index, look in zip(seeing, looks, strict=True):
            labelled[index] = _turned(labelled[index], number, board.looks[look])
    return labelled, evidence


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
    board: Board, cameras: Sequence[Camera], seen: Sequence[Observations], number: int
) -> tuple[list[int], dict[str, Any]]:
    """Choose the look of one board in each camera; return looks and evidence."""
    n_cameras, n_looks = len(cameras), len(board.looks)
    evidence: dict[str, Any] = {}
    looks = [0] * n_cameras
    hands = [camera.hand_look for camera in seen]
    if n_cameras > 1:
        votes, matches = _votes_of_scene(board, cameras, seen, number)
        for i, j in combinations(range(n_cameras), 2):
            hand_i, hand_j = hands[i], hands[j]
            if hand_i is not None and hand_j is not None:
                votes[i, j, (hand_j - hand_i) % n_looks] += _HAND_VOTES
        chosen = choose_looks(votes)
        looks = list(chosen.looks)
        by_hand = sum(hand is not None for hand in hands) > 1
        evidence = {
            "decided_by": "matches of the scene" + (" and corners by hand" if by_hand else ""),
            "matches_by_look": matches,
            "margin_sigma": {
                camera.name: round(margin, 2)
                for camera, margin in zip(cameras, chosen.margins_sigma, strict=True)
            },
            "weakest_sigma": round(chosen.weakest_sigma, 2),
            "is_weak": chosen.weakest_sigma < _WEAK_EVIDENCE,
        }
        log = logger.warning if evidence["is_weak"] else logger.info
        log(
            "the board looks the same turned by %d degrees; %s decide which way round each camera "
            "saw it, by %.1f sigma at the weakest%s",
            360 // n_looks,
            evidence["decided_by"],
            chosen.weakest_sigma,
            ": uncertain; check the cameras' distances, mark the corners by hand in one order, or "
            "use a board with an odd sum of columns and rows"
            if evidence["is_weak"]
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


def _votes_of_scene(
    board: Board, cameras: Sequence[Camera], seen: Sequence[Observations], number: int
) -> tuple[NDArray[np.float64], dict[str, list[int]]]:
    """Count the matches of the scene for each pair of cameras and each look."""
    poses = [
        _clip_pose(board, camera, observed, number)
        for camera, observed in zip(cameras, seen, strict=True)
    ]
    scenes = [
        describe_scene(camera, pose, observed.picture, board)
        if observed.picture is not None
        else None
        for camera, pose, observed in zip(cameras, poses, seen, strict=True)
    ]
    votes = np.zeros((len(cameras), len(cameras), len(board.looks)))
    matches = {}
    for i, j in combinations(range(len(cameras)), 2):
        first, second = scenes[i], scenes[j]
        if first is not None and second is not None:
            votes[i, j] = count_agreeing(first, poses[i], second, poses[j], board)
        pair = f"{cameras[i].name} {cameras[j].name}"
        matches[pair] = [int(count) for count in votes[i, j]]
    return votes, matches


def _clip_pose(board: Board, camera: Camera, seen: Observations, number: int) -> Pose:
    corners = _clip_corners(seen, number)
    assert corners is not None
    located = locate_board(camera, board.points_board, corners)
    if located is None:
        raise CalibrationError(
            f"camera {camera.name!r}: the lens fitted to its stills cannot have seen the board "
            "clip; were both recorded by this camera, with the same zoom?"
        )
    return located[0]
