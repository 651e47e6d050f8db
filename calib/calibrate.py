"""From pictures of a board to a rig: observe, fit each lens, label, adjust everything at once.

Each camera's lens is fitted to stills of the board; views that are blurred or wrong show by their
own error and are dropped. The rig follows from a clip that shows the board to all cameras: lying
still, then the clip is averaged, or being moved, then each frame ties the cameras together. At the
end one bundle adjustment refines lenses, poses and boards from all views together.

The world is the board: Z points away from its printed side, so cameras are above the floor on
which it lies. A board that looks the same when turned leaves open which way round each camera saw
it; what the cameras see around the board decides that (see `hybridve.calib.check`), and corners
given by hand vote with the order in which they are listed.
"""

import importlib.metadata
import logging
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import N_PARAMS, Camera
from hybridve.calib.check import count_agreeing, describe_scene
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import FrameSource, natural_order
from hybridve.calib.pose import Pose, compose, invert
from hybridve.calib.rig import Rig
from hybridve.calib.solve import (
    Adjustment,
    BoardView,
    adjust,
    link_cameras,
    locate_board,
    rms,
    seed_camera,
)
from hybridve.calib.target import (
    Chessboard,
    detect_corners,
    grey_of,
    list_corners,
    read_corners,
    refine_corners,
)

logger = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class CameraInput:
    """What was recorded of the board by one camera.

    Attributes
    ----------
    name : str
        Unique within the rig.
    model : str
        A COLMAP camera model, a key of `hybridve.calib.camera.N_PARAMS`.
    intrinsics : FrameSource or None
        The board in many places, in this camera alone. None: the views of `extrinsics` serve,
        if the board moves there.
    extrinsics : FrameSource or None
        The board as all cameras see it at once, frame by frame.
    corners : Path or None
        Corners marked by hand in `extrinsics`, see `read_corners`; taken where detection fails.
    """

    name: str
    model: str
    intrinsics: FrameSource | None
    extrinsics: FrameSource | None
    corners: Path | None


@dataclass(frozen=True, slots=True)
class CalibrationSettings:
    """How a calibration is done; the defaults serve.

    Attributes
    ----------
    max_view_px : float
        A view whose corners miss by more than this, root mean square, is dropped.
    max_view_medians : float
        So is one that misses by this many times the median of its camera's views, ...
    always_good_px : float
        ... unless it misses by no more than this.
    min_views : int
        Views a lens is fitted to at least.
    max_stills : int
        Stills looked at, evenly spread over what there is.
    clip_frames : int
        Frames of the extrinsic clip looked at, evenly spread.
    still_px : float
        A board that moves less than this in the clip lies still, and the clip is averaged.
    loss_px : float
        Corners that miss by more than this weigh less than squared.
    threads : int
        Images searched at the same time; 0 for as many as there are processors.
    """

    max_view_px: float = 1.0
    max_view_medians: float = 3.0
    always_good_px: float = 0.5
    min_views: int = 3
    max_stills: int = 120
    clip_frames: int = 40
    still_px: float = 1.0
    loss_px: float = 1.0
    threads: int = 0


_DEFAULTS = CalibrationSettings()

#: Frames in which the stillness of an averaged clip is measured.
_SPREAD_FRAMES = 9

#: Bytes of grey frames of one clip held at once; larger images are averaged over fewer frames.
_CLIP_BYTES = 200_000_000

#: Views from which the focal length is seeded: more do not change it, and each is located once
#: for every focal length tried.
_SEED_VIEWS = 12

#: An order of corners that was given by hand counts as this many agreeing matches of the scene.
_HAND_VOTES = 6.0

#: Evidence below this many standard deviations (of counts of chance matches) is called weak.
_WEAK_EVIDENCE = 3.0

#: Where the two poses that a plane allows differ in error by less than this factor, its tilt is
#: not determined.
_TILT_FACTOR = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class _Stills:
    """The board in the stills of one camera: (name, corners) and names of stills without it."""

    size_px: tuple[int, int] | None
    seen: tuple[tuple[str, NDArray[np.float64]], ...]
    missed: dict[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class _Clip:
    """The board in the extrinsic clip of one camera."""

    size_px: tuple[int, int]
    corners: dict[int, NDArray[np.float64]]  # by frame; one frame, 0, where the board lies still
    is_still: bool
    picture: NDArray[np.float32]  # the average of the clip, grey
    how: str
    spread_px: float | None
    hand_look: int | None  # which look of the board the order given by hand is, of corners[0]


@dataclass(frozen=True, slots=True, eq=False)
class _Lens:
    """A camera's lens and the views it was fitted to."""

    camera: Camera
    used: tuple[tuple[str, NDArray[np.float64], Pose], ...]
    dropped: dict[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class _Labelling:
    """Which look of the board each camera saw, and how sure that is."""

    looks: tuple[int, ...]
    evidence: dict[str, Any] = field(default_factory=dict)


def calibrate_rig(
    board: Chessboard,
    cameras: list[CameraInput],
    settings: CalibrationSettings = _DEFAULTS,
    progress: Progress | None = None,
) -> Rig:
    """Calibrate lenses and poses of fixed cameras from pictures of a chessboard.

    Parameters
    ----------
    board : Chessboard
        The board in all pictures.
    cameras : list of CameraInput
        The cameras; their order does not matter.
    settings : CalibrationSettings
        How it is done.
    progress : callable, optional
        Called with what is being done, how many of it are done, and how many there are.

    Returns
    -------
    rig : Rig
        In the order of `cameras`. The world is the board in the still clip (in a moving clip: in
        the first frame that most cameras see), metres, Z up. ``provenance`` holds the errors per
        camera, the views that were dropped and why, and what decided how a symmetric board lies.

    Raises
    ------
    CalibrationError
        Naming the camera, and what was tried, where no board is found, too few views fit, or a
        camera shares no view of the board with the others.
    """
    report = progress or (lambda what, done, total: None)
    _check_inputs(cameras)
    # The rig's numbers must not depend on the order in which cameras are listed.
    ordered = sorted(cameras, key=lambda camera: natural_order(camera.name))
    threads = settings.threads or os.cpu_count() or 1
    with ThreadPoolExecutor(threads) as pool:
        clips = _observe_clips(board, ordered, settings, pool, report)
        stills = [
            _observe_stills(board, camera, settings, pool, report, threads) for camera in ordered
        ]
    lenses = []
    for index, (camera, clip, still) in enumerate(zip(ordered, clips, stills, strict=True)):
        report("fitting lenses", index, len(ordered))
        lenses.append(_fit_lens(board, camera, still, clip, settings))
    report("fitting lenses", len(ordered), len(ordered))

    lies_still = all(clip.is_still for clip in clips)
    labelling = _Labelling(tuple(0 for _ in clips))
    if lies_still:
        labelling = _label_still_board(board, lenses, clips)
        clips = [
            replace(clip, corners={0: clip.corners[0][board.looks[look]]})
            for clip, look in zip(clips, labelling.looks, strict=True)
        ]
    report("adjusting", 0, 1)
    rig = _adjust_all(board, ordered, lenses, clips, stills, labelling, settings)
    report("adjusting", 1, 1)
    return Rig(tuple(rig[camera.name] for camera in cameras), rig.provenance)


def find_board(
    board: Chessboard,
    cameras: list[CameraInput],
    settings: CalibrationSettings = _DEFAULTS,
    progress: Progress | None = None,
) -> dict[str, NDArray[np.float64]]:
    """Find the board's corners where all cameras see it at once, to check a rig made elsewhere.

    Parameters
    ----------
    board : Chessboard
        The board.
    cameras : list of CameraInput
        The cameras; those without extrinsics are left out.
    settings : CalibrationSettings
        How it is done.
    progress : callable, optional
        Called with what is being done, how many of it are done, and how many there are.

    Returns
    -------
    dict of str to (N, 2) float64
        By camera the corners in pixels, of the averaged clip if the board lies still in it, else
        of the frame in which most cameras see it.

    Raises
    ------
    CalibrationError
        Naming the camera, and what was tried, where no board is found.
    """
    report = progress or (lambda what, done, total: None)
    seeing = [camera for camera in cameras if camera.extrinsics is not None]
    with ThreadPoolExecutor(settings.threads or os.cpu_count() or 1) as pool:
        clips = _observe_clips(board, seeing, settings, pool, report)
    frames = {frame for clip in clips for frame in clip.corners}
    best = max(sorted(frames), key=lambda frame: sum(frame in clip.corners for clip in clips))
    return {
        camera.name: clip.corners[best]
        for camera, clip in zip(seeing, clips, strict=True)
        if best in clip.corners
    }


def _check_inputs(cameras: Sequence[CameraInput]) -> None:
    if not cameras:
        raise CalibrationError("there is no camera to calibrate; name at least one")
    names = [camera.name for camera in cameras]
    for camera in cameras:
        if names.count(camera.name) > 1:
            raise CalibrationError(
                f"camera {camera.name!r} is listed {names.count(camera.name)} times"
            )
        if camera.model not in N_PARAMS:
            raise CalibrationError(
                f"camera {camera.name!r}: unknown camera model {camera.model!r}; one of "
                f"{', '.join(N_PARAMS)}"
            )
        if camera.extrinsics is None:
            raise CalibrationError(
                f"camera {camera.name!r}: no clip shows it the board together with the other "
                "cameras; name one as `extrinsics`"
            )


# --- What the pictures show -----------------------------------------------------------------


def _observe_stills(
    board: Chessboard,
    camera: CameraInput,
    settings: CalibrationSettings,
    pool: ThreadPoolExecutor,
    report: Progress,
    threads: int,
) -> _Stills:
    source = camera.intrinsics
    if source is None or (camera.extrinsics and source.paths == camera.extrinsics.paths):
        return _Stills(None, (), {})  # the views of the extrinsic clip serve
    length = max(1, source.claimed_length())
    step = -(-length // settings.max_stills)
    total = -(-length // step)
    seen: list[tuple[str, NDArray[np.float64]]] = []
    missed: dict[str, str] = {}
    sizes: dict[str, tuple[int, int]] = {}
    waiting: list[tuple[str, Future[Any]]] = []

    def collect(down_to: int) -> None:
        while len(waiting) > down_to:
            name, future = waiting.pop(0)
            detection = future.result()
            if detection.corners is None:
                missed[name] = "no board found"
            else:
                seen.append((name, detection.corners))
            report(f"{camera.name}: stills", len(seen) + len(missed), total)

    for index, image in enumerate(source.frames(step=step)):
        name = f"frame {index * step}" if source.is_video else source.paths[index * step].name
        sizes[name] = (image.shape[1], image.shape[0])
        waiting.append((name, pool.submit(detect_corners, image, board, False)))
        collect(2 * threads)  # frames in flight, so that memory does not grow with the source
    collect(0)
    if not sizes:
        raise CalibrationError(f"camera {camera.name!r}: {source.label} holds no picture")
    counted = list(sizes.values())
    size_px = max(set(counted), key=lambda size: (counted.count(size), size))
    for name, corners in list(seen):
        if sizes[name] != size_px:
            missed[name] = "is {}x{}, the others {}x{}".format(*sizes[name], *size_px)
            seen = [item for item in seen if item[0] != name]
            del corners
    logger.info("camera %s: board found in %d of %d stills", camera.name, len(seen), len(sizes))
    return _Stills(size_px, tuple(seen), missed)


def _observe_clips(
    board: Chessboard,
    cameras: Sequence[CameraInput],
    settings: CalibrationSettings,
    pool: ThreadPoolExecutor,
    report: Progress,
) -> list[_Clip]:
    sources = [camera.extrinsics for camera in cameras if camera.extrinsics is not None]
    # One step for all cameras: frames with the same number were taken at the same time.
    length = max(1, min(source.claimed_length() for source in sources))
    step = -(-length // settings.clip_frames)
    clips: list[_Clip | None] = []
    futures = [
        pool.submit(_observe_still_clip, board, camera, source, step, settings)
        for camera, source in zip(cameras, sources, strict=True)
    ]
    for index, future in enumerate(futures):
        clips.append(future.result())
        report("board clips", index + 1, len(cameras))
    if any(clip is None for clip in clips):
        futures_moving = [
            pool.submit(_observe_moving_clip, board, camera, source, step)
            for camera, source in zip(cameras, sources, strict=True)
        ]
        moving = []
        for index, moving_future in enumerate(futures_moving):
            moving.append(moving_future.result())
            report("moving board", index + 1, len(cameras))
        return moving
    return [clip for clip in clips if clip is not None]


def _observe_still_clip(
    board: Chessboard,
    camera: CameraInput,
    source: FrameSource,
    step: int,
    settings: CalibrationSettings,
) -> _Clip | None:
    """Return the corners averaged over a clip; None if the board moves in it."""
    frames = _sample(source, step)
    if not frames:
        raise CalibrationError(f"camera {camera.name!r}: {source.label} holds no picture")
    if any(frame.shape != frames[0].shape for frame in frames):
        raise CalibrationError(
            f"camera {camera.name!r}: the pictures of {source.label} differ in size"
        )
    size_px = (frames[0].shape[1], frames[0].shape[0])
    picture = _steady_mean(frames)
    by_hand = _corners_by_hand(board, camera)
    detection = detect_corners(picture, board, thorough=False)
    if detection.corners is None and len(frames) > 1:
        some = [frames[index] for index in np.linspace(0, len(frames) - 1, 3).round().astype(int)]
        quick = [detect_corners(frame, board, thorough=False).corners for frame in some]
        found = [corners for corners in quick if corners is not None]
        if any(np.abs(a - b).max() > settings.still_px for a, b in combinations(found, 2)):
            return None
    if detection.corners is None:
        detection = detect_corners(picture, board)
    how, corners = f"detected ({detection.how})", detection.corners
    if corners is None and by_hand is not None:
        corners = refine_corners(picture, board, by_hand)
        how = "marked by hand, refined"
        if corners is None:
            corners, how = by_hand, "marked by hand, not refined: no chessboard at that place"
        logger.warning(
            "camera %s: no board found in %s; corners %s", camera.name, source.label, how
        )
    if corners is None:
        raise CalibrationError(
            f"camera {camera.name!r}: no board of {board.columns}x{board.rows} inner corners found "
            f"in {source.label} (average of {len(frames)} frames; {detection.how}); check columns "
            "and rows, or mark the corners by hand (`corners`)"
        )
    spread_px = None
    if len(frames) > 1:
        chosen = np.linspace(0, len(frames) - 1, min(_SPREAD_FRAMES, len(frames))).round()
        offsets = [
            np.inf if again is None else float(np.abs(again - corners).max())
            for again in (
                refine_corners(frames[index], board, corners) for index in chosen.astype(int)
            )
        ]
        spread_px = float(np.median(offsets))
        if spread_px > settings.still_px and not how.startswith("marked"):
            return None
    hand_look = None
    if by_hand is not None:
        misses = [float(np.abs(corners[look] - by_hand).max()) for look in board.looks]
        hand_look = int(np.argmin(misses))
        if min(misses) > 0.02 * max(size_px):
            logger.warning(
                "camera %s: corners marked by hand are up to %.0f px away from those found; "
                "the found ones are taken",
                camera.name,
                min(misses),
            )
            hand_look = None
    if spread_px is not None and not np.isfinite(spread_px):
        spread_px = None
    return _Clip(size_px, {0: corners}, True, picture, how, spread_px, hand_look)


def _sample(source: FrameSource, step: int) -> list[NDArray[np.uint8]]:
    """Return every `step`-th frame in grey, fewer where frames are large."""
    frames: list[NDArray[np.uint8]] = []
    for image in source.frames(step=step):
        if (len(frames) + 1) * image.shape[0] * image.shape[1] > _CLIP_BYTES and len(frames) > 4:
            break
        frames.append(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8))
    return frames


def _steady_mean(frames: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
    """Return the mean of the middle half of each pixel's values, (H, W) float32.

    Somebody who crosses the picture, for less than a quarter of the clip, leaves no trace; unlike
    a median the mean resolves less than a grey level.
    """
    quarter = len(frames) // 4
    mean = np.zeros(frames[0].shape, np.float32)
    for row in range(0, len(mean), 64):  # in strips, to sort little memory at a time
        strip = np.sort(np.stack([frame[row : row + 64] for frame in frames]), axis=0)
        mean[row : row + 64] = strip[quarter : len(frames) - quarter].mean(axis=0)
    return mean


def _corners_by_hand(board: Chessboard, camera: CameraInput) -> NDArray[np.float64] | None:
    if camera.corners is None:
        return None
    corners = read_corners(camera.corners)
    expected = board.columns * board.rows
    if len(corners) != expected:
        raise CalibrationError(
            f"{camera.corners}: {len(corners)} corners, expected {expected} "
            f"({board.columns}x{board.rows} inner corners)"
        )
    listed = list_corners(board, corners)
    if listed is None:
        raise CalibrationError(
            f"{camera.corners}: the corners do not form the board's grid; expected row by row, "
            f"{board.columns} a row"
        )
    return listed


def _observe_moving_clip(
    board: Chessboard, camera: CameraInput, source: FrameSource, step: int
) -> _Clip:
    corners: dict[int, NDArray[np.float64]] = {}
    picture = np.zeros((1, 1), np.float32)
    count = 0
    for index, image in enumerate(source.frames(step=step)):
        picture = grey_of(image)
        count += 1
        found = detect_corners(image, board, thorough=False).corners
        if found is not None:
            corners[index * step] = found
    if not corners:
        raise CalibrationError(
            f"camera {camera.name!r}: no board of {board.columns}x{board.rows} inner corners found "
            f"in any of {count} frames of {source.label}; check columns and rows"
        )
    size_px = (picture.shape[1], picture.shape[0])
    how = f"detected in {len(corners)} of {count} frames"
    return _Clip(size_px, corners, False, picture, how, None, None)


# --- Lenses ---------------------------------------------------------------------------------


def _fit_lens(
    board: Chessboard,
    camera: CameraInput,
    stills: _Stills,
    clip: _Clip,
    settings: CalibrationSettings,
) -> _Lens:
    """Fit one camera's lens to its views, dropping those that do not fit."""
    if stills.size_px is not None and stills.size_px != clip.size_px:
        raise CalibrationError(
            "camera {!r}: intrinsics are {}x{} pixels, extrinsics {}x{}; record both in the same "
            "mode".format(camera.name, *stills.size_px, *clip.size_px)
        )
    views = list(stills.seen)
    if not clip.is_still:
        views += [(f"board clip, frame {frame}", seen) for frame, seen in clip.corners.items()]
    if len(views) < settings.min_views:
        found = (
            f"{len(views)} of {len(views) + len(stills.missed)} stills"
            if stills.size_px
            else (f"{len(views)} views")
        )
        raise CalibrationError(
            f"camera {camera.name!r}: the board of {board.columns}x{board.rows} inner corners was "
            f"found in {found}, expected {settings.min_views} or more; check columns and rows, or "
            "take more pictures of it (`intrinsics`)"
        )
    points = board.points_board
    spread = np.linspace(0, len(views) - 1, min(len(views), _SEED_VIEWS)).round().astype(int)
    lens = seed_camera(
        camera.name, camera.model, clip.size_px, points, [views[index][1] for index in spread]
    )
    kept, boards = set(range(len(views))), dict[int, Pose]()
    reasons: dict[int, str] = {}
    fixed = True  # first without the principal point: the seed is rough
    for _ in range(50):
        for index in sorted(kept - boards.keys()):
            located = locate_board(lens, points, views[index][1])
            if located is not None:
                boards[index] = located[0]
        usable = sorted(kept & boards.keys())
        if len(usable) < settings.min_views:
            raise CalibrationError(
                f"camera {camera.name!r}: only {len(usable)} of {len(views)} views of the board "
                f"fit model {camera.model} to {settings.max_view_px:g} px; check columns and rows, "
                "take sharper pictures, or choose another model"
            )
        result = adjust(
            points,
            [lens],
            {index: boards[index] for index in usable},
            [BoardView(0, index, views[index][1], views[index][0]) for index in usable],
            settings.loss_px,
            fix_principal_point=fixed,
        )
        lens = result.cameras[0]
        boards.update(result.rig_from_board)
        if fixed:
            fixed = False
            continue
        errors = dict(zip(usable, map(rms, result.residuals_px), strict=True))
        limit_px = _view_limit(list(errors.values()), settings)
        # All views are asked again, also those that were dropped while the lens was rough.
        for index in sorted(set(range(len(views))) - set(usable)):
            located = locate_board(lens, points, views[index][1])
            if located is not None and located[1] <= limit_px:
                errors[index], boards[index] = located[1], located[0]
        bad = sorted((i for i in errors if errors[i] > limit_px), key=lambda i: -errors[i])
        # A wrong view spoils the error of the others: the worst fifth goes, then all are asked.
        bad = bad[: max(1, len(usable) // 5)]
        now = set(errors) - set(bad)
        for index in set(range(len(views))) - now:
            error = f"{errors[index]:.2f} px" if index in errors else "not seen by the lens"
            if index in errors or index not in reasons:
                reasons[index] = f"{error}, limit {limit_px:.2f} px"
        if now == kept:
            break
        kept = now
    dropped = {views[index][0]: reasons[index] for index in sorted(set(range(len(views))) - kept)}
    for name, reason in dropped.items():
        logger.info("camera %s: %s dropped: %s", camera.name, name, reason)
    used = tuple((*views[index], boards[index]) for index in sorted(kept))
    return _Lens(lens, used, dropped)


def _view_limit(errors_px: Sequence[float], settings: CalibrationSettings) -> float:
    relative = settings.max_view_medians * float(np.median(errors_px))
    return min(settings.max_view_px, max(relative, settings.always_good_px))


# --- Which way round the board was seen -----------------------------------------------------


def _label_still_board(
    board: Chessboard, lenses: Sequence[_Lens], clips: Sequence[_Clip]
) -> _Labelling:
    """Choose the look of the board in each camera by what the cameras see around it."""
    n_cameras, n_looks = len(lenses), len(board.looks)
    if n_looks == 1 or n_cameras == 1:
        look = clips[0].hand_look or 0
        return _Labelling(tuple(look for _ in lenses), {"looks": n_looks, "needed": False})
    poses = []
    for lens, clip in zip(lenses, clips, strict=True):
        located = locate_board(lens.camera, board.points_board, clip.corners[0])
        if located is None:
            raise _lens_misses_clip(lens.camera.name)
        poses.append(located[0])
    scenes = [
        describe_scene(lens.camera, pose, clip.picture, board)
        for lens, pose, clip in zip(lenses, poses, clips, strict=True)
    ]
    # votes[i, j, k]: matches for camera j being k looks ahead of camera i.
    votes = np.zeros((n_cameras, n_cameras, n_looks))
    pairs: dict[str, list[int]] = {}
    for i, j in combinations(range(n_cameras), 2):
        counts = count_agreeing(scenes[i], poses[i], scenes[j], poses[j], board)
        votes[i, j] = counts
        pairs[f"{lenses[i].camera.name} {lenses[j].camera.name}"] = counts.tolist()
        hand_i, hand_j = clips[i].hand_look, clips[j].hand_look
        if hand_i is not None and hand_j is not None:
            votes[i, j, (hand_j - hand_i) % n_looks] += _HAND_VOTES
        votes[j, i] = votes[i, j][-np.arange(n_looks) % n_looks]
    looks = _vote(votes)
    evidence: dict[str, Any] = {}
    by_hand = sum(clip.hand_look is not None for clip in clips)
    margins = {
        lens.camera.name: _margin(votes, looks, {index}) for index, lens in enumerate(lenses)
    }
    margin = min(*margins.values(), *(_margin(votes, looks, side) for side in _sides(votes, looks)))
    # The world turns with all cameras alike: the first order given by hand sets it, or the way in
    # which the first camera sees columns run to the right.
    turn = next(
        (
            (clip.hand_look - look) % n_looks
            for clip, look in zip(clips, looks, strict=True)
            if clip.hand_look is not None
        ),
        -looks[0] % n_looks,
    )
    looks = [(look + turn) % n_looks for look in looks]
    evidence = {
        "looks": n_looks,
        "needed": True,
        "decided_by": "scene matches" + (", corners given by hand" if by_hand > 1 else ""),
        "matches_by_look": pairs,
        "margin_sigma": {name: round(value, 2) for name, value in margins.items()},
        "weakest_margin_sigma": round(margin, 2),
        "is_weak": margin < _WEAK_EVIDENCE,
    }
    logger.info(
        "the board looks the same turned by %d degrees: the scene around it decides, weakest "
        "margin %.1f sigma",
        360 // n_looks,
        margin,
    )
    if margin < _WEAK_EVIDENCE:
        logger.warning(
            "which way round the cameras saw the board is uncertain (%.1f sigma): check the "
            "cameras' distances, mark the corners by hand in one order, or use a board with an "
            "odd sum of columns and rows",
            margin,
        )
    return _Labelling(tuple(looks), evidence)


def _lens_misses_clip(name: str) -> CalibrationError:
    return CalibrationError(
        f"camera {name!r}: the lens fitted to its stills cannot have seen the board clip; were "
        "both recorded by this camera, with the same zoom?"
    )


# --- Everything at once ---------------------------------------------------------------------


def _adjust_all(
    board: Chessboard,
    inputs: Sequence[CameraInput],
    lenses: Sequence[_Lens],
    clips: Sequence[_Clip],
    stills: Sequence[_Stills],
    labelling: _Labelling,
    settings: CalibrationSettings,
) -> Rig:
    points = board.points_board
    cameras, rig_from_board, common = link_cameras(
        board, [lens.camera for lens in lenses], [clip.corners for clip in clips]
    )
    tilts = {}
    for camera, clip in zip(cameras, clips, strict=True):
        if clip.is_still:
            located = locate_board(camera, points, clip.corners[0])
            if located is None:
                raise _lens_misses_clip(camera.name)
            tilts[camera.name] = located[2] / max(located[1], 1e-9)
            if tilts[camera.name] < _TILT_FACTOR:
                logger.warning(
                    "camera %s: the board clip hardly tells how the board is tilted (the other "
                    "pose fits %.1f times worse); use a larger board or bring it nearer",
                    camera.name,
                    tilts[camera.name],
                )
    # Views of the board by single cameras follow the common frames.
    views, n_common = list(common), len(common)
    boards = dict(rig_from_board)
    frame = max(boards) + 1
    from_clip = "board clip, frame "
    for index, lens in enumerate(lenses):
        for name, pixels, cam_from_board in lens.used:
            if name.startswith(from_clip):
                continue  # it is a view of a common frame already
            views.append(BoardView(index, frame, pixels, name))
            boards[frame] = compose(invert(cameras[index].cam_from_world), cam_from_board)
            frame += 1
    result = adjust(points, cameras, boards, views, settings.loss_px)
    for index, camera in enumerate(result.cameras):
        errors = [
            rms(residuals)
            for view, residuals in zip(views[:n_common], result.residuals_px, strict=False)
            if view.camera == index
        ]
        worst = max(errors)
        if worst > 5.0 * settings.max_view_px:
            raise CalibrationError(
                f"camera {camera.name!r}: the board clip misses its lens by {worst:.1f} px; were "
                "clip and stills recorded by this camera, with the same zoom, and is the board "
                "the same?"
            )
    # The world: the board in the first of the frames that most cameras see.
    seen = [view.frame for view in common]
    world = max(sorted(set(seen)), key=lambda candidate: (seen.count(candidate), -candidate))
    rig_from_world = result.rig_from_board[world]
    placed = tuple(
        replace(camera, cam_from_world=_orthonormal(compose(camera.cam_from_world, rig_from_world)))
        for camera in result.cameras
    )
    for camera in placed:
        if camera.center_world[2] <= 0:
            raise CalibrationError(
                f"camera {camera.name!r} came out under the floor ({camera.center_world[2]:.2f} m):"
                " is its picture mirrored, or did it see another board?"
            )
    provenance = _provenance(
        board, inputs, lenses, clips, stills, labelling, settings, views, n_common, result, placed
    )
    for name, tilt in tilts.items():
        provenance["cameras"][name]["extrinsics"]["other_tilt_factor"] = round(tilt, 2)
    return Rig(placed, provenance)


def _orthonormal(pose: Pose) -> Pose:
    u, _, vt = np.linalg.svd(pose[:, :3])
    return np.column_stack([u @ vt, pose[:, 3]])


def _provenance(
    board: Chessboard,
    inputs: Sequence[CameraInput],
    lenses: Sequence[_Lens],
    clips: Sequence[_Clip],
    stills: Sequence[_Stills],
    labelling: _Labelling,
    settings: CalibrationSettings,
    views: Sequence[BoardView],
    n_common: int,
    result: Adjustment,
    placed: Sequence[Camera],
) -> dict[str, Any]:
    """Return where the rig comes from, as plain JSON values."""

    def errors(indices: list[int]) -> dict[str, Any]:
        if not indices:
            return {"rms_px": None, "max_px": None}
        residuals = np.concatenate([result.residuals_px[index] for index in indices])
        lengths = np.linalg.norm(residuals, axis=1)
        return {"rms_px": round(rms(residuals), 4), "max_px": round(float(lengths.max()), 3)}

    cameras: dict[str, dict[str, Any]] = {}
    for index, (given, lens, clip, still) in enumerate(
        zip(inputs, lenses, clips, stills, strict=True)
    ):
        own = [i for i, view in enumerate(views) if view.camera == index and i >= n_common]
        common = [i for i, view in enumerate(views) if view.camera == index and i < n_common]
        cameras[given.name] = {
            "model": given.model,
            "intrinsics": {
                "source": given.intrinsics.label if given.intrinsics else None,
                **errors(own),
                "views_used": len(own),
                "views_dropped": lens.dropped,
                "views_without_board": still.missed,
            },
            "extrinsics": {
                "source": given.extrinsics.label if given.extrinsics else None,
                **errors(common),
                "views_used": len(common),
                "how": clip.how,
                "spread_over_clip_px": (
                    None if clip.spread_px is None else round(clip.spread_px, 4)
                ),
            },
            "center_m": [round(float(value), 4) for value in placed[index].center_world],
        }
    total = np.concatenate(result.residuals_px)
    return {
        "method": "chessboard; joint bundle adjustment of lenses, poses and boards (pycolmap)",
        "software": {
            name: importlib.metadata.version(name)
            for name in ("pycolmap", "opencv-python-headless")
        },
        "board": asdict(board),
        "world": (
            "the board in the still clip"
            if clips[0].is_still
            else "the board in one frame of the clip"
        )
        + "; Z up, away from its printed side; the origin is its first inner corner",
        "rms_px": round(rms(total), 4),
        "cameras": cameras,
        "labelling": labelling.evidence,
        "settings": asdict(settings),
    }
