"""What cameras see around a board that lies still, and how it speaks for each look of the board."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.placing.surroundings import (
    MAX_FEATURES,
    SceneFeatures,
    count_agreeing,
    describe_scene,
    with_floor,
)
from hybridve.calib.pose import Pose, compose
from hybridve.calib.solving.locate import locate_board

#: Whether a picture is mirrored is asked of so many pairs of each camera, the nearest first, and,
#: where nothing else is, of so many features: the answer must be quick where pictures agree, and
#: not take long where none do.
TRIES = 3
_FEATURES = 1000

#: Turns of a board by a quarter; those that are none of its looks show what chance agrees to.
QUARTERS = 4


def clip_corners(seen: Observations, board: int) -> NDArray[np.float64] | None:
    """Return the corners of a board in the clip where it lies still, or None."""
    for sighting in seen.sightings:
        if sighting.instant is not None and sighting.board == board:
            return sighting.pixels
    return None


def _clip_pose(board: Board, camera: Camera, seen: Observations, number: int) -> Pose:
    pose = located(board, camera, seen, number)
    if pose is None:
        raise CalibrationError(
            f"camera {camera.name!r}: the lens fitted to its stills cannot have seen the board "
            "clip; were both recorded by this camera, with the same zoom?"
        )
    return pose


def located(board: Board, camera: Camera, seen: Observations, number: int) -> Pose | None:
    """Return where a camera has a board that lies still; None if that cannot be told."""
    corners = clip_corners(seen, number)
    assert corners is not None
    located = locate_board(camera, board.points_board, corners)
    return None if located is None else located[0]


class Scenes:
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
        self._turns = [_quarter_turn(board, quarters) for quarters in range(QUARTERS)]
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
            return np.zeros(QUARTERS, np.intp)
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
