"""By how many whole frames cameras are late, to begin with."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board
from hybridve.calib.camera import Camera
from hybridve.calib.placing.board_tracks import Tracks
from hybridve.calib.pose import Pose, compose, invert
from hybridve.calib.solving.consensus import common_pose
from hybridve.calib.solving.locate import locate_board

#: Offsets tried, and common instants from which each is judged.
MAX_OFFSET_FRAMES = 25
_JUDGED = 40
MIN_COMMON = 6

#: Common views that differ by more than this (radians plus shares of distance) are not in time at
#: all, or not of one board.
_DISAGREE = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A camera's offset to whole frames, and its pose against the reference."""

    offset: int
    cam_from_rig: Pose


def located(boards: Sequence[Board], camera: Camera, tracks: Tracks) -> dict[tuple[int, int], Pose]:
    """Return where a camera had the boards of its tracks, by instant and board."""
    poses = {}
    for (board, instant), pixels in tracks.items():
        found = locate_board(camera, boards[board].points_board, pixels)
        if found is not None:
            poses[board, instant] = found[0]
    return poses


def start_of(
    boards: Sequence[Board],
    poses: Sequence[Mapping[tuple[int, int], Pose]],
    spacing: int,
    max_offset: int,
) -> dict[int, Start]:
    """Return offsets and poses of the cameras that can be reached from the first one.

    Pairs that share most frames go first; pairs of cameras that hang together already are spared.
    """
    views = [_Views.of(boards, seen) for seen in poses]
    pairs = sorted(
        combinations(range(len(poses)), 2),
        key=lambda pair: (-len(poses[pair[0]].keys() & poses[pair[1]].keys()), pair),
    )
    part = list(range(len(poses)))
    edges: list[tuple[int, int, int, Pose]] = []
    for one, other in pairs:
        if part[one] == part[other]:
            continue
        found = _whole_offset(views[one], views[other], spacing, max_offset)
        if found is not None:
            edges += [
                (one, other, found[0], found[1]),
                (other, one, -found[0], invert(found[1])),
            ]
            part = [part[one] if label == part[other] else label for label in part]
    start = {0: Start(0, np.eye(3, 4))}
    while True:
        edge = next((edge for edge in edges if edge[0] in start and edge[1] not in start), None)
        if edge is None:
            return start
        known, new, ahead, new_from_known = edge
        pose = compose(new_from_known, start[known].cam_from_rig)
        start[new] = Start(start[known].offset + ahead, pose)


@dataclass(frozen=True, slots=True, eq=False)
class _Views:
    """A camera's located boards: by board and instant the row of each, and their poses.

    `cam_from_board` (V, L, 3, 4) holds one pose for each look, repeated for boards with fewer.
    """

    row_of: dict[tuple[int, int], int]
    cam_from_board: NDArray[np.float64]
    board_from_cam: NDArray[np.float64]

    @classmethod
    def of(cls, boards: Sequence[Board], poses: Mapping[tuple[int, int], Pose]) -> "_Views":
        turns = [
            [board.board_from_turned(look) for look in range(len(board.looks))] for board in boards
        ]
        n_looks = max(map(len, turns))
        keys = sorted(poses)
        turned = np.zeros((len(keys), n_looks, 3, 4))
        inverses = np.zeros((len(keys), 3, 4))
        for row, key in enumerate(keys):
            inverses[row] = invert(poses[key])
            for look in range(n_looks):
                turn = turns[key[0]][look % len(turns[key[0]])]
                turned[row, look] = compose(poses[key], turn)
        return cls({key: row for row, key in enumerate(keys)}, turned, inverses)


def _whole_offset(
    first: _Views, second: _Views, spacing: int, max_offset: int
) -> tuple[int, Pose] | None:
    """Return by how many frames the second is later, and second_from_first.

    None where no offset lets most of the common views share a relative pose.
    """
    best: tuple[float, int, int, Pose] | None = None
    for late in range(-(max_offset // spacing), max_offset // spacing + 1):
        ahead = late * spacing
        keys = sorted(key for key in first.row_of if (key[0], key[1] - ahead) in second.row_of)
        if len(keys) < MIN_COMMON:
            continue
        chosen = np.linspace(0, len(keys) - 1, min(len(keys), _JUDGED)).round().astype(int)
        mine = [first.row_of[keys[index]] for index in chosen]
        other = [second.row_of[keys[index][0], keys[index][1] - ahead] for index in chosen]
        turned, inverse = second.cam_from_board[other], first.board_from_cam[mine]
        relative = turned[..., :3] @ inverse[:, None]
        relative[..., 3] += turned[..., 3]
        length_m = float(np.median(np.linalg.norm(turned[:, 0, :, 3], axis=1)))
        common = common_pose(list(relative), np.ones(len(relative)), length_m)
        if common.error <= _DISAGREE:
            found = (common.error, abs(ahead), ahead, common.pose)
            best = found if best is None else min(best, found, key=lambda item: item[:3])
    return None if best is None else best[2:]
