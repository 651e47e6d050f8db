"""Why cameras do not hang together, and what to record."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board
from hybridve.calib.errors import CalibrationError
from hybridve.calib.placing.chain import Chain, Join, Part
from hybridve.calib.placing.looks import DISAGREE, inverses, products
from hybridve.calib.placing.moments import Moment
from hybridve.calib.pose import Pose, compose, invert
from hybridve.calib.solving.consensus import common_pose

_MIRROR_IMAGE = np.diag([-1.0, 1.0, 1.0])


def explain_not_linked(chain: Chain) -> CalibrationError:
    """Return what to say of cameras that do not hang together."""
    names = [camera.name for camera in chain.cameras]
    parts = sorted(chain.camera_parts, key=lambda part: (-len(part), part))
    tried = {
        (first, second): join
        for kind, first, second, join in chain.candidates()
        if kind == "cameras"
    }
    # The surest pair of parts that see boards at once and yet could not be joined.
    for (first, second), join in sorted(tried.items(), key=lambda item: -item[1].weight):
        if not join.is_clear and join.common.error <= DISAGREE:
            one, other = _surest_pair(chain, first, second)
            return CalibrationError(
                f"cameras {names[one]!r} and {names[other]!r}: their {len(join.moments)} common "
                "views of a board that looks the same when turned do not tell which way round they "
                "saw it; tilt and move the board more, let it lie still, or use one with an odd "
                "sum of columns and rows"
            )
    main = parts[0]
    for part in parts[1:]:
        key = (min(main, part), max(main, part))
        if key in tried:
            return _contradiction(chain, main, part, tried[key])
    groups = "; ".join(", ".join(repr(names[rank]) for rank in part) for part in parts)
    part = parts[1]
    lost = ", ".join(repr(names[rank]) for rank in part)
    others = " or ".join(repr(names[rank]) for rank in range(len(names)) if rank not in part)
    return CalibrationError(
        f"camera {lost} never sees the board at the same time as {others}: these hang together: "
        f"{groups}; {_what_to_record(chain, part)}"
    )


def _surest_pair(chain: Chain, first: Part, second: Part) -> tuple[int, int]:
    """Return the cameras of two parts that share most moments."""

    def moments(camera: int) -> set[tuple[Moment, int]]:
        return {(look.moment, look.board) for look in chain.looks if look.camera == camera}

    pairs = [(len(moments(i) & moments(j)), -i, -j) for i in first for j in second]
    _, i, j = max(pairs)
    return -i, -j


def _what_to_record(chain: Chain, part: Part) -> str:
    """Name the missing edge: the pair across that came nearest to seeing a board at once."""
    names = [camera.name for camera in chain.cameras]
    instants: list[list[int]] = [[] for _ in names]
    for look in chain.looks:
        if look.moment.is_clip:
            instants[look.camera].append(look.moment.instant)
    blind = [rank for rank in part if not instants[rank]]
    if len(blind) == len(part):
        return (
            f"{names[part[0]]!r} sees no board in the clip that all cameras recorded, or too "
            "little of one; record the board where it and another camera see it at once"
        )
    gaps = [
        (abs(one - other), inside, outside)
        for inside in part
        for outside in range(len(names))
        if outside not in part
        for one in instants[inside]
        for other in instants[outside]
    ]
    if not gaps:
        return "no other camera sees a board in the clip; record the board where two see it at once"
    gap, inside, outside = min(gaps)
    nearest = (
        f"its nearest in time: {gap} frames between their views"
        if gap
        else "they see different boards at the same time; mounted on one body these would link them"
    )
    return (
        f"record the board where {names[inside]!r} and {names[outside]!r} ({nearest}) see it at "
        "once"
    )


def _contradiction(chain: Chain, main: Part, part: Part, join: Join) -> CalibrationError:
    """Return what to say of cameras whose common views share no relative pose."""
    names = [camera.name for camera in chain.cameras]
    lost = ", ".join(repr(names[rank]) for rank in part)
    others = ", ".join(repr(names[rank]) for rank in main)
    told = (
        f"{len(join.moments)} common views share no relative pose (they differ by "
        f"{join.common.error:.2f}, radians and shares of the board's distance)"
    )
    mirrored = _mirrored_error(chain, main, part)
    if mirrored is not None and mirrored < min(DISAGREE, join.common.error) / 3.0:
        who = (
            f"camera {lost}: its picture seems to be mirrored, or those of all others"
            if len(main) > 1
            else f"the picture of camera {lost} or of {others} seems to be mirrored"
        )
        return CalibrationError(
            f"{who}: {told}, but flipped left to right it agrees to {mirrored:.3f}; record "
            "it unmirrored"
        )
    return CalibrationError(
        f"camera {lost} contradicts {others}: their {told}; were the clips recorded at the same "
        'time, frame by frame (sync = "estimate" if some are late), by these cameras, and of a '
        "board as it is described?"
    )


def _mirrored_error(chain: Chain, main: Part, part: Part) -> float | None:
    """Return how far common views disagree if the pictures of a part are flipped in x."""
    best = None
    mirrors: list[Callable[[Board], NDArray[np.float64]]] = [_mirror_x, _mirror_y, _mirror_z]
    for mirror in mirrors:
        measured, weights = [], []
        for boards in chain.board_parts:
            seen = chain.placed(main, boards)
            for look in chain.looks:
                if look.camera not in part or look.board not in boards or len(part) > 1:
                    continue
                if look.moment not in seen:
                    continue
                flipped = np.stack(
                    [
                        _unmirrored(pose, mirror(chain.boards[look.board]))
                        for pose in look.cam_from_board
                    ]
                )
                from_part = invert(chain.part_from_board[look.board])
                in_camera = np.stack([compose(pose, from_part) for pose in flipped])
                measured.append(products(in_camera, inverses(seen[look.moment][0])))
                weights.append(look.weight)
        if len(measured) >= 3:
            error = common_pose(measured, np.array(weights), chain.length_m).error
            best = error if best is None else min(best, error)
    return best


def _unmirrored(cam_from_board: Pose, mirror: NDArray[np.float64]) -> Pose:
    """Return the pose that a mirrored picture hides; `mirror` (3, 4) maps the board onto itself."""
    rotation = _MIRROR_IMAGE @ cam_from_board[:, :3] @ mirror[:, :3]
    shift = _MIRROR_IMAGE @ (cam_from_board[:, :3] @ mirror[:, 3] + cam_from_board[:, 3])
    return np.column_stack([rotation, shift])


def _mirror_x(board: Board) -> NDArray[np.float64]:
    return np.column_stack([np.diag([-1.0, 1.0, 1.0]), board.center_board * [2.0, 0.0, 0.0]])


def _mirror_y(board: Board) -> NDArray[np.float64]:
    return np.column_stack([np.diag([1.0, -1.0, 1.0]), board.center_board * [0.0, 2.0, 0.0]])


def _mirror_z(board: Board) -> NDArray[np.float64]:
    """Return the mirror that leaves each point: markers name the points of a mirrored picture."""
    del board
    return np.column_stack([np.diag([1.0, 1.0, -1.0]), np.zeros(3)])
