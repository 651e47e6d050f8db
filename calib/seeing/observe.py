"""What the pictures show of the boards: the slow half of a calibration, done once.

Stills of a camera alone are searched quickly, and again with more effort if few show a board. In
the clip that all cameras recorded at once the boards lie still, then it is averaged (somebody who
walks through leaves no trace), or they move, then each frame is searched. Any board of the session
may be in any picture; parts of it may be hidden. All that was found is kept in a `CornerCache`, so
that a second run decodes no picture.
"""

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations, Sighting, is_seen
from hybridve.calib.boards.markers import AprilGrid, Charuco
from hybridve.calib.boards.target import Chessboard, fit_homography
from hybridve.calib.camera import N_PARAMS
from hybridve.calib.errors import CalibrationError
from hybridve.calib.seeing.clip import observe_clips
from hybridve.calib.seeing.corner_cache import CornerCache
from hybridve.calib.seeing.given import given_corners
from hybridve.calib.seeing.inputs import AUTO_MODEL, CameraInput, ObserveSettings, Progress
from hybridve.calib.seeing.search import Search, describe_board
from hybridve.calib.seeing.stills import observe_stills

logger = logging.getLogger(__name__)


_DEFAULTS = ObserveSettings()

#: In so many pictures, rows that are not seen are no accident; well inside one is so far from its
#: edges, in its sides.
_NO_ACCIDENT = 3
_MARGIN = 0.1


def observe_boards(
    boards: Sequence[Board],
    cameras: Sequence[CameraInput],
    settings: ObserveSettings = _DEFAULTS,
    progress: Progress | None = None,
    cache: CornerCache | None = None,
) -> list[Observations]:
    """Find the boards in all pictures.

    Parameters
    ----------
    boards : sequence of Board
        All boards of the session; `Sighting.board` counts them.
    cameras : sequence of CameraInput
        The cameras; their order does not matter.
    settings : ObserveSettings
        How it is done.
    progress : callable, optional
        Called with what is being done, how many of it are done, and how many there are.
    cache : CornerCache, optional
        What was found before, and is kept for the next time.

    Returns
    -------
    list of Observations
        In the order of `cameras`. With or without a cache, filled or not, they are the same.

    Raises
    ------
    CalibrationError
        Naming the camera, and what was tried, where its clip shows no board at all; if two boards
        look alike, a camera is listed twice or has no clip, or its stills are of another aspect
        than its clip; for corners of a file that belong to no picture; for a chessboard that is
        larger than described.
    """
    _check_boards(boards)
    _check_inputs(cameras)
    with Search(boards, settings, progress or _no_progress, cache) as search:
        given = {camera.name: given_corners(boards, camera) for camera in cameras}
        clips = observe_clips(search, cameras, given)
        stills = [observe_stills(search, camera, given[camera.name]) for camera in cameras]
    seen = [
        _put_together(camera, still, clip)
        for camera, still, clip in zip(cameras, stills, clips, strict=True)
    ]
    _refuse_larger(boards, seen)
    _tell_rows_without_marker(boards, seen)
    return seen


def find_boards(
    boards: Sequence[Board],
    cameras: Sequence[CameraInput],
    settings: ObserveSettings = _DEFAULTS,
    progress: Progress | None = None,
    cache: CornerCache | None = None,
) -> list[Observations]:
    """Find the boards where all cameras see them at once, to check a rig made elsewhere.

    Parameters
    ----------
    boards, cameras, settings, progress, cache
        As for `observe_boards`; cameras without extrinsics are left out.

    Returns
    -------
    list of Observations
        What the clips show, without stills: one instant, 0, if the boards lie still in them.

    Raises
    ------
    CalibrationError
        Naming the camera, and what was tried, where no board is found.
    """
    _check_boards(boards)
    seeing = [camera for camera in cameras if camera.extrinsics is not None]
    if not seeing:
        return []
    with Search(boards, settings, progress or _no_progress, cache) as search:
        given = {camera.name: given_corners(boards, camera) for camera in seeing}
        clips = observe_clips(search, seeing, given)
    seen = [_put_together(camera, None, clip) for camera, clip in zip(seeing, clips, strict=True)]
    _refuse_larger(boards, seen)
    return seen


def _no_progress(what: str, done: int, total: int) -> None:
    del what, done, total


def _check_boards(boards: Sequence[Board]) -> None:
    if not boards:
        raise CalibrationError("there is no board to look for; describe at least one")
    for first, second in combinations(boards, 2):
        alike = describe_board(first) == describe_board(second)
        if isinstance(first, Chessboard) and isinstance(second, Chessboard):
            alike = {first.columns, first.rows} == {second.columns, second.rows}
        if alike:
            raise CalibrationError(
                f"boards {first.name!r} and {second.name!r} look alike "
                f"({first}), so that no picture tells one from the other; use boards of different "
                "numbers of corners, or with different markers"
            )


def _refuse_larger(boards: Sequence[Board], seen: Sequence[Observations]) -> None:
    """Refuse a chessboard whose corners go on beyond its edge in most pictures.

    Raises
    ------
    CalibrationError
        Naming the number that is wrong and the number of corners that it has.
    """
    for number, board in enumerate(boards):
        if not isinstance(board, Chessboard):
            continue
        beyond = []
        for each in seen:
            # What lies beside one board may be another, which has no margin.
            shown = Counter(one.image for one in each.sightings)
            beyond += [
                one.beyond
                for one in each.sightings
                if one.board == number and shown[one.image] == 1
            ]
        larger = Counter(lines for lines in beyond if any(lines))
        if 2 * larger.total() <= len(beyond):
            continue
        # Part of a larger board may be out of some pictures: of equal votes the larger one.
        more_columns, more_rows = max(larger, key=lambda lines: (larger[lines], sum(lines)))
        said = [
            f"{name} = {count}"
            for name, count, more in (
                ("columns", board.columns, more_columns),
                ("rows", board.rows, more_rows),
            )
            if more
        ]
        which = f"board {board.name!r}: " if len(boards) > 1 else ""
        raise CalibrationError(
            f"{which}{' and '.join(said)}, but corners go on beyond the edge in {larger.total()} "
            f"of {len(beyond)} pictures: the board has {board.columns + more_columns} x "
            f"{board.rows + more_rows} inner corners; say columns = {board.columns + more_columns} "
            f"and rows = {board.rows + more_rows}"
        )


def _tell_rows_without_marker(boards: Sequence[Board], seen: Sequence[Observations]) -> None:
    """Log that rows at an end of a marker board were never seen, though they were in view.

    The board may have fewer rows than described; its frame, from which the world may be measured,
    begins at the bottom left, elsewhere then.
    """
    for number, board in enumerate(boards):
        if not isinstance(board, Charuco | AprilGrid):
            continue
        views = [(one, each.size_px) for each in seen for one in each.sightings]
        views = [(one, size_px) for one, size_px in views if one.board == number]
        if not views:
            continue
        heights, row_of = np.unique(board.points_board[:, 1].round(9), return_inverse=True)
        some = np.any([is_seen(one.pixels) for one, _ in views], axis=0)
        rows_seen = np.unique(row_of[some])
        below, above = int(rows_seen.min()), int(len(heights) - 1 - rows_seen.max())
        lines_a_row = 2 if isinstance(board, AprilGrid) else 1
        missing = (below + above) // lines_a_row
        hidden = (row_of < below) | (row_of > rows_seen.max())
        in_view = sum(_are_in_view(board, one, hidden, size_px) for one, size_px in views)
        if missing and in_view >= _NO_ACCIDENT and 2 * in_view >= len(views):
            which = f"board {board.name!r}" if len(boards) > 1 else "the board"
            logger.warning(
                "%s has rows = %d, but its %s %d were never seen, and would have been in view in "
                "%d of %d pictures: if it has fewer, say rows = %d; its origin, the bottom left, "
                "is elsewhere then",
                *(which, board.rows, "lowest" if below else "highest", missing),
                *(in_view, len(views), board.rows - missing),
            )


def _are_in_view(
    board: Board, one: Sighting, hidden: NDArray[np.bool_], size_px: tuple[int, int]
) -> bool:
    """Whether points of a board that a picture does not show would be well inside of it."""
    shown = is_seen(one.pixels)
    plane = board.points_board[:, :2] / board.square_m
    img_from_board = fit_homography(plane[shown], one.pixels[shown])
    if img_from_board is None or not hidden.any():
        return False
    mapped = plane[hidden] @ img_from_board[:, :2].T + img_from_board[:, 2]
    if (mapped[:, 2] <= 0).any():
        return False
    share = mapped[:, :2] / mapped[:, 2:] / size_px
    return bool(((share > _MARGIN) & (share < 1.0 - _MARGIN)).all())


def _check_inputs(cameras: Sequence[CameraInput]) -> None:
    if not cameras:
        raise CalibrationError("there is no camera to calibrate; name at least one")
    names = [camera.name for camera in cameras]
    for camera in cameras:
        if names.count(camera.name) > 1:
            raise CalibrationError(
                f"camera {camera.name!r} is listed {names.count(camera.name)} times"
            )
        if camera.model != AUTO_MODEL and camera.model not in N_PARAMS:
            raise CalibrationError(
                f"camera {camera.name!r}: unknown camera model {camera.model!r}; one of "
                f"{AUTO_MODEL}, {', '.join(N_PARAMS)}"
            )
        if camera.extrinsics is None:
            raise CalibrationError(
                f"camera {camera.name!r}: no clip shows it the board together with the other "
                "cameras; name one as `extrinsics`"
            )


def _scaled(camera: CameraInput, stills: Observations, size_px: tuple[int, int]) -> Observations:
    """Return what was seen in stills as the clip would show it, if both have one aspect.

    Raises
    ------
    CalibrationError
        If they have not.
    """
    (width, height), (still_width, still_height) = size_px, stills.size_px
    # The shorter side of the smaller picture, rounded to a pixel, tells the aspect no closer.
    if abs(width * still_height - height * still_width) > max(still_width, width):
        raise CalibrationError(
            "camera {!r}: intrinsics are {}x{} pixels, extrinsics {}x{}, which is not the same "
            "picture at another size; record both in the same mode".format(
                camera.name, *stills.size_px, *size_px
            )
        )
    scale = np.array([width / still_width, height / still_height])
    word = (
        f"stills of {still_width}x{still_height} pixels are taken for the same picture as the "
        f"clip's {width}x{height}, at another size; that is wrong where the clip was cut out of it"
    )
    logger.warning("camera %s: %s", camera.name, word)
    return replace(
        stills,
        size_px=size_px,
        sightings=tuple(replace(one, pixels=one.pixels * scale) for one in stills.sightings),
    )


def _put_together(
    camera: CameraInput, stills: Observations | None, clip: Observations
) -> Observations:
    """Return what was seen in stills, where there are any, and in the clip."""
    if stills is not None and stills.size_px != clip.size_px:
        stills = _scaled(camera, stills, clip.size_px)
    seen = clip
    if stills is not None:
        seen = replace(
            clip,
            sightings=stills.sightings + clip.sightings,
            missed=stills.missed,
            notes=stills.notes + clip.notes,
        )
    for note in seen.notes:
        logger.info("camera %s: %s", camera.name, note)
    return replace(
        seen,
        sources={
            "intrinsics": camera.intrinsics.label if camera.intrinsics else None,
            "extrinsics": camera.extrinsics.label if camera.extrinsics else None,
            "corners": camera.corners.name if camera.corners else None,
        },
    )
