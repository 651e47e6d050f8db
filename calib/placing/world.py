"""Where the world is: from a board, from named points, or from the floor.

Cameras and boards are given in a frame of the rig; what comes back is the motion into the world,
metres, Z up. A rig stands above its floor: a camera under it means that something is mirrored, and
is refused.

This work is based on: Hartley and Zisserman, *Multiple View Geometry*, 2nd ed., 2003, chapter 12
(triangulation); Umeyama, *Least-squares estimation of transformation parameters between two point
patterns*, IEEE Trans. PAMI 13(4), 1991.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.placing.marks import Mark, click_warnings, rounded, triangulated
from hybridve.calib.placing.moments import PoseKey
from hybridve.calib.pose import Pose, compose, invert, nearest_rotation, transform
from hybridve.calib.record import WorldRecord
from hybridve.calib.solving.bundle import BundleView

#: The rig's scale by the named points: what is worth a warning, and what no measurement explains.
SCALE_WARNING = 0.02
_SCALE_REFUSED = 0.2

#: Points whose second extent is less than this share of the first lie on a line; if the third is,
#: they lie in a plane, where a mirror image is a turn.
_LINE = 1e-2
_FLAT = 2e-2

#: Cameras that are all nearer to the board than this are doubted.
_SMALL_M = 0.05

#: Boards in several planes mirror a camera to places that are further apart than this share of how
#: far it is behind the first.
_MIRRORED_APART = 0.1

#: Points that fit worse than this share of their extent are looked at for exchanged names; an
#: explanation must fit better by this factor.
_POOR_FIT = 0.02
_EXPLAINS_FACTOR = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """The world, and how it was found.

    Attributes
    ----------
    world_from_rig : (3, 4) float64
        Metres.
    told : WorldRecord
        What it was placed by.
    """

    world_from_rig: Pose
    told: WorldRecord


@dataclass(frozen=True, slots=True, eq=False)
class SeenBoards:
    """Boards as they were seen, in the rig's frame (what an adjustment gives).

    Attributes
    ----------
    boards : sequence of Board
        The boards.
    body_from_board, rig_from_body : sequence of (3, 4) float64
        Where boards sit on their bodies, and where bodies were.
    pose_keys : sequence of PoseKey
        What each of `rig_from_body` is of.
    views : sequence of BundleView
        What was seen.
    """

    boards: Sequence[Board]
    body_from_board: Sequence[Pose]
    rig_from_body: Sequence[Pose]
    pose_keys: Sequence[PoseKey]
    views: Sequence[BundleView]

    def rig_from_board(self, pose: int, board: int) -> Pose:
        """Return where a board was."""
        return compose(self.rig_from_body[pose], self.body_from_board[board])

    @property
    def instants(self) -> set[int]:
        """The instants of the clip at which boards were seen."""
        return {key.moment.instant for key in self.pose_keys if key.moment.is_clip}

    def main(self) -> tuple[int, int, frozenset[int]]:
        """Return the pose and board that most cameras see, the earliest of these; and who does.

        Boards of the clip go before those of stills; of several boards the first
        of `boards` counts (a calibration gives them in order of name).
        """
        seeing: dict[tuple[int, int], set[int]] = {}
        for view in self.views:
            seeing.setdefault((view.pose, view.board), set()).add(view.camera)

        def rank(key: tuple[int, int]) -> tuple[bool, int, int, int, int]:
            moment = self.pose_keys[key[0]].moment
            return (not moment.is_clip, -len(seeing[key]), moment.instant, key[1], key[0])

        if not seeing:
            raise CalibrationError("no view of a board is left to place the world by")
        pose, board = min(seeing, key=rank)
        return pose, board, frozenset(seeing[pose, board])


def place_world(
    kind: str, cameras: Sequence[Camera], seen: SeenBoards, marks: Sequence[Mark] = ()
) -> Placed:
    """Place the world as a session's ``world`` says.

    Parameters
    ----------
    kind : {"board", "points", "floor"}
        How.
    cameras : sequence of Camera
        Their "world" is the rig's frame.
    seen : SeenBoards
        The boards, in that frame.
    marks : sequence of Mark
        Points of the scene, for "points" and "floor".

    Raises
    ------
    CalibrationError
        Naming what does not fit: points, or cameras that came out under the floor.
    """
    if kind == "points":
        placed = place_by_points(cameras, [mark for mark in marks if mark.xyz_m is not None])
    elif kind == "floor":
        placed = place_on_floor(cameras, seen, [mark for mark in marks if mark.is_floor])
    elif kind == "board":
        placed = place_by_board(cameras, seen)
    else:
        raise ValueError(f"unknown kind of world {kind!r}")
    told = placed.told
    return replace(
        placed, told=replace(told, warnings=(*told.warnings, *_told_small(cameras, seen)))
    )


def _told_small(cameras: Sequence[Camera], seen: SeenBoards) -> list[str]:
    """Tell cameras that came out nearer to each other and to the board than cameras are built."""
    pose, board, _ = seen.main()
    middle = transform(seen.rig_from_board(pose, board), seen.boards[board].center_board[None])[0]
    centers = np.array([camera.center_world for camera in cameras])
    reach_m = float(np.linalg.norm(centers - middle, axis=1).max())
    if reach_m >= _SMALL_M:
        return []
    square_mm = 1000.0 * seen.boards[board].square_m
    return [
        f"all cameras came out within {1000 * reach_m:.0f} mm of the board: is its square of "
        f"{square_mm:g} mm told in millimetres? of as many centimetres, it has {10 * square_mm:g}"
    ]


def place_by_board(cameras: Sequence[Camera], seen: SeenBoards) -> Placed:
    """Let the world be the board in the first of the instants that most cameras see.

    Raises
    ------
    CalibrationError
        If a camera that sees it came out behind it, and nothing tells that it sees its back through
        a transparent sheet.
    """
    pose, board, seeing = seen.main()
    world_from_rig = invert(seen.rig_from_board(pose, board))
    moment = seen.pose_keys[pose].moment
    is_still = moment.is_clip and len(seen.instants) == 1
    heights = _heights(cameras, world_from_rig)
    below = [index for index in range(len(cameras)) if heights[index] <= 0]
    wrong = [
        index for index in below if index in seeing and not _sees_backs(index, cameras[index], seen)
    ]
    if wrong:
        raise _under_floor(
            [cameras[index] for index in wrong],
            [heights[index] for index in wrong],
            "is its picture mirrored, or did it see another board? (if it sees the board's back "
            "through a transparent sheet, move and tilt the board before it)",
        )
    warnings = [
        f"camera {cameras[index].name!r} stands {-heights[index]:.2f} m behind the plane of the "
        "board that is the world: wrong, if this board lies on the floor"
        for index in below
        if index not in seeing
    ]
    text = (
        "the board as it lies in the clip"
        if is_still
        else f"the board in {f'frame {moment.instant}' if moment.is_clip else moment.image}"
    )
    return Placed(
        world_from_rig,
        WorldRecord(
            kind="board",
            text=text,
            board=str(seen.boards[board]),
            instant=moment.instant if moment.is_clip else moment.image,
            cameras=tuple(sorted(cameras[index].name for index in seeing)),
            warnings=tuple(warnings),
        ),
    )


def _sees_backs(index: int, camera: Camera, seen: SeenBoards) -> bool:
    """Tell whether a camera behind boards that it sees stands there, and is not merely mirrored.

    A picture of a board that is mirrored is that of a camera behind it: of the true one, mirrored
    at the board's plane. With boards in several planes, that other cameras see too, these are
    several places. And a camera that sees boards of markers from the front records no mirrored
    pictures (a mirrored chessboard is a chessboard).
    """
    center = camera.center_world
    others = {view.pose for view in seen.views if view.camera != index}
    mirrored = []
    for view in seen.views:
        is_shared = view.pose in others
        if view.camera != index or not (is_shared or _has_markers(seen.boards[view.board])):
            continue
        rig_from_board = seen.rig_from_board(view.pose, view.board)
        height_m = float((center - rig_from_board[:, 3]) @ rig_from_board[:, 2])
        if height_m > 0:
            return True
        if is_shared:
            mirrored.append(center - 2.0 * height_m * rig_from_board[:, 2])
    apart_m = np.linalg.norm(np.array(mirrored) - mirrored[0], axis=1).max()
    distance_m = np.linalg.norm(center - mirrored[0]) / 2.0
    return bool(apart_m > _MIRRORED_APART * distance_m)


def _has_markers(board: Board) -> bool:
    return not isinstance(board, Chessboard)


def place_by_points(cameras: Sequence[Camera], marks: Sequence[Mark]) -> Placed:
    """Place the world by points whose places in it are known: rotation and shift, no scale.

    Parameters
    ----------
    cameras : sequence of Camera
        Their "world" is the rig's frame.
    marks : sequence of Mark
        At least three, not on a line, each with `Mark.xyz_m` and clicked in two cameras or more.

    Raises
    ------
    CalibrationError
        If there are too few points, they lie on a line, their names are exchanged, they are
        mirrored, their distances contradict the rig's scale, or cameras come out under the floor.
    """
    points_rig, misses_px = triangulated(cameras, marks)
    if len(marks) < 3:
        raise CalibrationError(
            f"the world needs 3 named points or more, found {len(marks)}: "
            f"{', '.join(mark.name for mark in marks) or 'none'}"
        )
    points_world = np.array([mark.xyz_m for mark in marks], np.float64)
    extents = _extents(points_world)
    if extents[1] < _LINE * extents[0]:
        raise CalibrationError(
            "the points that name the world lie on a line, about which it could turn; add one "
            "beside it"
        )
    size_m = float(extents[0]) / np.sqrt(len(marks))
    scale = _scale(points_rig, points_world)
    _, error_m = _rigid_fit(points_rig / scale, points_world)
    if error_m > _POOR_FIT * size_m:
        _explain_poor_fit(marks, points_rig / scale, points_world, error_m)
    if abs(scale - 1.0) > _SCALE_REFUSED:
        raise CalibrationError(
            f"the named points are {scale:.3f} times as far apart in the rig as their xyz says; "
            "is xyz in millimetres, and is the board's square given rightly?"
        )
    world_from_rig, _ = _rigid_fit(points_rig, points_world)
    residuals_mm = 1000.0 * np.linalg.norm(
        transform(world_from_rig, points_rig) - points_world, axis=1
    )
    heights = _heights(cameras, world_from_rig)
    wrong = [index for index in range(len(cameras)) if heights[index] <= 0]
    if wrong:
        cause = (
            "all of them: does z of the points run downwards, or are they listed mirrored?"
            if len(wrong) == len(cameras)
            else "is its picture mirrored, or does the world's z = 0 lie above it?"
        )
        raise _under_floor(
            [cameras[index] for index in wrong], [heights[index] for index in wrong], cause
        )
    warnings = click_warnings(cameras, marks, misses_px)
    if abs(scale - 1.0) > SCALE_WARNING:
        warnings.append(
            f"the named points are {scale:.3f} times as far apart in the rig as their xyz says: "
            "one of the points' distances and the board's square was measured wrongly"
        )
    return Placed(
        world_from_rig,
        WorldRecord(
            kind="points",
            text=f"{len(marks)} named points",
            residuals_mm={
                mark.name: round(float(residual), 3)
                for mark, residual in zip(marks, residuals_mm, strict=True)
            },
            scale=round(scale, 5),
            misses_px=rounded(misses_px),
            warnings=tuple(warnings),
        ),
    )


def place_on_floor(
    cameras: Sequence[Camera], seen: SeenBoards, marks: Sequence[Mark] = ()
) -> Placed:
    """Fit the floor: Z up, towards the cameras; X along the board's, laid onto the floor.

    The origin is the foot of the middle of the board that `place_by_board` would take. The floor
    runs through the marks, or, where there are none, through the boards of a clip in which they lie
    still.

    Parameters
    ----------
    cameras : sequence of Camera
        Their "world" is the rig's frame.
    seen : SeenBoards
        The boards, in that frame.
    marks : sequence of Mark
        Points of the floor, three or more, not on a line; or none.

    Raises
    ------
    CalibrationError
        If the points do not tell a plane, or cameras are on both sides of it.
    """
    misses_px: dict[str, dict[str, float]] = {}
    if marks:
        floor_rig, misses_px = triangulated(cameras, marks)
        names = [mark.name for mark in marks]
    else:
        floor_rig, names = _still_corners(seen)
    if len(floor_rig) < 3:
        raise CalibrationError(
            f"the floor needs 3 points or more, found {len(floor_rig)}: {', '.join(names)}"
        )
    middle = floor_rig.mean(axis=0)
    extents = _extents(floor_rig)
    if extents[1] < _LINE * extents[0]:
        raise CalibrationError(
            f"the points of the floor ({', '.join(names)}) lie on a line, about which the floor "
            "could turn; add one beside it"
        )
    up = np.linalg.svd(floor_rig - middle)[2][2]
    centers = np.array([camera.center_world for camera in cameras])
    heights = (centers - middle) @ up
    if (heights < 0).sum() > len(cameras) / 2:
        up, heights = -up, -heights
    if (heights <= 0).any():
        wrong = np.flatnonzero(heights <= 0).tolist()
        raise _under_floor(
            [cameras[index] for index in wrong],
            [float(heights[index]) for index in wrong],
            "is its picture mirrored, or is a point of the floor clicked wrongly?",
        )
    pose, board, _ = seen.main()
    rig_from_board = seen.rig_from_board(pose, board)
    along = rig_from_board[:, 0]
    if np.linalg.norm(along - (along @ up) * up) < 0.1:  # the board's x stands upright
        along = rig_from_board[:, 1]
    x = along - (along @ up) * up
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(up, x), up])
    foot = transform(rig_from_board, seen.boards[board].center_board[None])[0]
    foot = foot - ((foot - middle) @ up) * up
    offsets_mm = 1000.0 * (floor_rig - middle) @ up
    told = (
        {name: round(float(offset), 3) for name, offset in zip(names, offsets_mm, strict=True)}
        if marks
        else {"boards, rms": round(float(np.sqrt((offsets_mm**2).mean())), 3)}
    )
    return Placed(
        np.column_stack([rotation, -rotation @ foot]),
        WorldRecord(
            kind="floor",
            text=f"the floor through {len(names) if marks else 'the boards on it'}"
            + (" points" if marks else ""),
            residuals_mm=told,
            misses_px=rounded(misses_px),
            warnings=tuple(click_warnings(cameras, marks, misses_px)),
        ),
    )


def _still_corners(seen: SeenBoards) -> tuple[NDArray[np.float64], list[str]]:
    if len(seen.instants) != 1:
        raise CalibrationError(
            "the floor cannot be told: no point of it is named ([[point]] with floor = true), and "
            "the boards do not lie still in the clip"
        )
    lying = sorted(
        {(view.pose, view.board) for view in seen.views if seen.pose_keys[view.pose].moment.is_clip}
    )
    corners = [
        transform(seen.rig_from_board(pose, board), seen.boards[board].points_board)
        for pose, board in lying
    ]
    return np.concatenate(corners), [str(seen.boards[board]) for _, board in lying]


def _extents(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the singular values (3,) of points about their middle, largest first."""
    values = np.zeros(3)
    found = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    values[: len(found)] = found
    return values


def _scale(points_rig: NDArray[np.float64], points_world: NDArray[np.float64]) -> float:
    """Return how many times as far apart points are in the rig as in the world."""
    in_rig = np.linalg.norm(points_rig - points_rig.mean(axis=0))
    return float(in_rig / np.linalg.norm(points_world - points_world.mean(axis=0)))


def _rigid_fit(
    points_rig: NDArray[np.float64], points_world: NDArray[np.float64], is_mirrored: bool = False
) -> tuple[Pose, float]:
    """Return world_from_rig (with a mirror, if asked for), and the rms distance that is left."""
    middle_rig, middle_world = points_rig.mean(axis=0), points_world.mean(axis=0)
    hand = -1.0 if is_mirrored else 1.0
    together = (points_world - middle_world).T @ (points_rig - middle_rig)
    rotation = hand * nearest_rotation(hand * together)
    pose = np.column_stack([rotation, middle_world - rotation @ middle_rig])
    left = transform(pose, points_rig) - points_world
    return pose, float(np.sqrt((left**2).sum(axis=1).mean()))


def _explain_poor_fit(
    marks: Sequence[Mark],
    points_rig: NDArray[np.float64],
    points_world: NDArray[np.float64],
    error_m: float,
) -> None:
    """Refuse points that fit far better mirrored, or with two names exchanged."""
    extents = _extents(points_world)
    _, mirrored_m = _rigid_fit(points_rig, points_world, is_mirrored=True)
    if extents[2] > _FLAT * extents[0] and mirrored_m < error_m / _EXPLAINS_FACTOR:
        raise CalibrationError(
            f"the named points are a mirror image of those in the rig: they fit to "
            f"{1000 * error_m:.0f} mm as they are, to {1000 * mirrored_m:.1f} mm mirrored; x, y "
            "and z must be right-handed (check a sign, or the order of x and y)"
        )
    if len(marks) < 4:
        return  # three points always fit some exchange about as well
    for one, other in combinations(range(len(marks)), 2):
        order = np.arange(len(marks))
        order[[one, other]] = other, one
        _, exchanged_m = _rigid_fit(points_rig[order], points_world)
        if exchanged_m < error_m / _EXPLAINS_FACTOR:
            raise CalibrationError(
                f"points {marks[one].name!r} and {marks[other].name!r} seem to be exchanged: the "
                f"named points fit to {1000 * error_m:.0f} mm as they are, to "
                f"{1000 * exchanged_m:.1f} mm with these two exchanged"
            )


def _heights(cameras: Sequence[Camera], world_from_rig: Pose) -> list[float]:
    centers = np.array([camera.center_world for camera in cameras])
    return [float(height) for height in transform(world_from_rig, centers)[:, 2]]


def _under_floor(
    cameras: Sequence[Camera], heights_m: Sequence[float], cause: str
) -> CalibrationError:
    told = ", ".join(
        f"{camera.name!r} ({-height:.2f} m)"
        for camera, height in zip(cameras, heights_m, strict=True)
    )
    plural = "s" if len(cameras) > 1 else ""
    return CalibrationError(f"camera{plural} {told} came out under the floor: {cause}")
