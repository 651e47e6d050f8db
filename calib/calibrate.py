"""From pictures of a board to a rig: observe, fit each lens, label, adjust everything at once.

Each camera's lens is fitted to stills of the board; views that are blurred or wrong show by their
own error and are dropped. The rig follows from a clip that shows the board to all cameras: lying
still, then the clip is averaged, or being moved, then each frame ties the cameras together. At the
end one bundle adjustment refines lenses, poses and boards from all views together. Seeing
(`observe_board`) and solving (`solve_rig`) are apart, so that pictures are searched once.

The world is the board: Z points away from its printed side, so cameras are above the floor on
which it lies. A board that looks the same when turned leaves open which way round each camera saw
it; what the cameras see around the board decides that (see `hybridve.calib.check`), and corners
given by hand vote with the order in which they are listed.
"""

import importlib.metadata
import logging
import os
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import N_PARAMS, Camera
from hybridve.calib.check import choose_looks, count_agreeing, describe_scene
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import FrameSource, natural_order
from hybridve.calib.pose import Pose, compose, invert
from hybridve.calib.rig import Rig
from hybridve.calib.solve import (
    Adjustment,
    BoardView,
    FittedLens,
    adjust,
    fit_lens,
    link_cameras,
    locate_board,
    rms,
)
from hybridve.calib.target import (
    Chessboard,
    Detection,
    detect_corners,
    list_corners,
    read_corners,
    refine_corners,
)

logger = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]

T = TypeVar("T")


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
    enough_stills : int
        With fewer stills found by the quick search, the others are searched again with more
        effort.
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
    enough_stills: int = 20
    clip_frames: int = 40
    still_px: float = 1.0
    loss_px: float = 1.0
    threads: int = 0


_DEFAULTS = CalibrationSettings()

#: Frames in which the stillness of an averaged clip is measured.
_SPREAD_FRAMES = 9

#: Frames whose means over 15x15 pixels differ by less show the same.
_STILL_GREY = 8.0

#: Bytes of grey frames of one clip held at once; larger images are averaged over fewer frames.
_CLIP_BYTES = 200_000_000

#: An order of corners that was given by hand counts as this many agreeing matches of the scene.
_HAND_VOTES = 10.0

#: Evidence below this many standard deviations (of counts of chance matches) is called weak.
_WEAK_EVIDENCE = 3.0

#: Where the two poses that a plane allows differ in error by less than this factor, its tilt is
#: not determined.
_TILT_FACTOR = 1.5

#: A board clip that misses its lens by this many times `max_view_px` is another camera's.
_WRONG_CLIP_FACTOR = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Stills:
    """The board in the stills of one camera.

    Attributes
    ----------
    size_px : (width, height) or None
        Of the stills; None where there are none.
    corners : dict of str to (N, 2) float64
        By the name of a still the board's corners, pixels.
    missed : dict of str to str
        Stills that do not count, and why.
    """

    size_px: tuple[int, int] | None
    corners: dict[str, NDArray[np.float64]]
    missed: dict[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class Clip:
    """The board in the extrinsic clip of one camera.

    Attributes
    ----------
    size_px : (width, height)
        Of its frames.
    corners : dict of int to (N, 2) float64
        By frame the board's corners, pixels; one frame, 0, where the board lies still.
    is_still : bool
        Whether it does, so that the clip could be averaged.
    picture : (H, W) float32, or None
        The average of a still clip, in grey levels.
    how : str
        How the corners were found.
    spread_px : float or None
        How far the worst corner strays from frame to frame (median over frames).
    hand_look : int or None
        Which look of the board was listed by hand, if one was.
    """

    size_px: tuple[int, int]
    corners: dict[int, NDArray[np.float64]]
    is_still: bool
    picture: NDArray[np.float32] | None = None
    how: str = "given"
    spread_px: float | None = None
    hand_look: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """All that one camera saw of the board; what a rig is solved from."""

    name: str
    model: str
    stills: Stills
    clip: Clip
    sources: dict[str, str | None] = field(default_factory=dict)


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
    return solve_rig(board, observe_board(board, cameras, settings, progress), settings, progress)


# --- What the pictures show -----------------------------------------------------------------


def observe_board(
    board: Chessboard,
    cameras: list[CameraInput],
    settings: CalibrationSettings = _DEFAULTS,
    progress: Progress | None = None,
) -> list[Observations]:
    """Find the board in all pictures: the slow half of `calibrate_rig`, and its parameters."""
    report = progress or _no_progress
    _check_inputs(cameras)
    threads = settings.threads or os.cpu_count() or 1
    with ThreadPoolExecutor(threads) as pool:
        clips = _observe_clips(board, cameras, settings, pool, report)
        stills = [
            _observe_stills(board, camera, settings, pool, 2 * threads, report)
            for camera in cameras
        ]
    return [
        Observations(
            camera.name,
            camera.model,
            still,
            clip,
            {
                "intrinsics": camera.intrinsics.label if camera.intrinsics else None,
                "extrinsics": camera.extrinsics.label if camera.extrinsics else None,
                "corners": camera.corners.name if camera.corners else None,
            },
        )
        for camera, still, clip in zip(cameras, stills, clips, strict=True)
    ]


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
    report = progress or _no_progress
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


def _no_progress(what: str, done: int, total: int) -> None:
    del what, done, total


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


def _observe_stills(
    board: Chessboard,
    camera: CameraInput,
    settings: CalibrationSettings,
    pool: ThreadPoolExecutor,
    in_flight: int,
    report: Progress,
) -> Stills:
    source = camera.intrinsics
    if source is None or (camera.extrinsics and source.paths == camera.extrinsics.paths):
        return Stills(None, {}, {})  # the views of the extrinsic clip serve
    length = _length(source)
    step = -(-length // settings.max_stills)
    total = -(-length // step)
    sizes: dict[str, tuple[int, int]] = {}
    corners: dict[str, NDArray[np.float64]] = {}
    missed: dict[str, str] = {}
    waiting: deque[tuple[str, Future[Detection]]] = deque()

    def collect(down_to: int) -> None:
        while len(waiting) > down_to:
            name, future = waiting.popleft()
            found = future.result().corners
            if found is None:
                missed[name] = "no board found"
            else:
                corners[name] = found
                missed.pop(name, None)

    def search(effort: Literal["quick", "usual"], what: str) -> None:
        done = 0
        for done, image in enumerate(source.frames(step=step), start=1):
            index = (done - 1) * step
            name = f"frame {index}" if source.is_video else source.paths[index].name
            sizes[name] = (image.shape[1], image.shape[0])
            if name not in corners:
                waiting.append((name, pool.submit(detect_corners, image, board, effort)))
            collect(in_flight)  # so that memory does not grow with the source
            report(what, min(done, total), total)
        collect(0)
        report(what, total, total)  # a video may end before its header says

    search("quick", f"stills of {camera.name}")
    if not sizes:
        raise CalibrationError(f"camera {camera.name!r}: {source.label} holds no picture")
    if missed and len(corners) < settings.enough_stills:
        search("usual", f"stills of {camera.name}, again")
    corners = {name: corners[name] for name in sizes if name in corners}  # in their own order
    logger.info("camera %s: board found in %d of %d stills", camera.name, len(corners), len(sizes))
    counts = Counter(sizes.values())
    size_px = max(counts, key=lambda size: (counts[size], size))
    for name in [name for name in corners if sizes[name] != size_px]:
        del corners[name]
        missed[name] = "is {}x{} pixels, most are {}x{}".format(*sizes[name], *size_px)
    return Stills(size_px, corners, missed)


def _length(source: FrameSource) -> int:
    """Return how many frames there are, about; some videos do not say."""
    claimed = source.claimed_length()
    return claimed if claimed > 0 else max(1, source.count())


def _observe_clips(
    board: Chessboard,
    cameras: Sequence[CameraInput],
    settings: CalibrationSettings,
    pool: ThreadPoolExecutor,
    report: Progress,
) -> list[Clip]:
    sources = [camera.extrinsics for camera in cameras if camera.extrinsics is not None]
    # One step for all cameras: frames with the same number were taken at the same time.
    step = -(-min(map(_length, sources)) // settings.clip_frames)
    still = [
        pool.submit(_observe_still_clip, board, camera, source, step, settings)
        for camera, source in zip(cameras, sources, strict=True)
    ]
    clips = list(_collected(still, "board clips", report))
    if all(clip is not None for clip in clips):
        return [clip for clip in clips if clip is not None]
    logger.info("the board moves in the clips: each frame is looked at")
    moving = [
        pool.submit(_observe_moving_clip, board, camera, source, step)
        for camera, source in zip(cameras, sources, strict=True)
    ]
    return list(_collected(moving, "clips with a moving board", report))


def _collected(futures: Sequence[Future[T]], what: str, report: Progress) -> Iterator[T]:
    report(what, 0, len(futures))
    for done, future in enumerate(futures, start=1):
        yield future.result()
        report(what, done, len(futures))


def _observe_still_clip(
    board: Chessboard,
    camera: CameraInput,
    source: FrameSource,
    step: int,
    settings: CalibrationSettings,
) -> Clip | None:
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
    detection = detect_corners(picture, board, "quick")
    if detection.corners is None:
        if _moves(board, frames, settings):
            return None
        detection = detect_corners(picture, board)
    corners, how = detection.corners, f"detected ({detection.how})"
    if corners is None and by_hand is not None:
        corners = refine_corners(picture, board, by_hand)
        how = "marked by hand, refined"
        if corners is None:
            corners, how = by_hand, "marked by hand, not refined: no chessboard at that place"
        logger.warning(
            "camera %s: no board found in %s (%s); corners %s",
            camera.name,
            source.label,
            detection.how,
            how,
        )
    if corners is None:
        raise CalibrationError(
            f"camera {camera.name!r}: no board of {board.columns}x{board.rows} inner corners found "
            f"in {source.label} (average of {len(frames)} frames; {detection.how}); check columns "
            "and rows, or mark the corners by hand (`corners`)"
        )
    spread_px = _spread(board, frames, corners)
    if spread_px is not None and spread_px > settings.still_px and by_hand is None:
        return None
    hand_look = None
    if by_hand is not None:
        misses = [float(np.abs(corners[look] - by_hand).max()) for look in board.looks]
        hand_look = int(np.argmin(misses))
        sides = np.linalg.norm(np.diff(by_hand.reshape(board.rows, -1, 2), axis=1), axis=-1)
        if min(misses) > float(sides.max()):
            logger.warning(
                "camera %s: the corners marked by hand are %.0f px away from those found in %s; "
                "those found are taken",
                camera.name,
                min(misses),
                source.label,
            )
            hand_look = None
    return Clip(size_px, {0: corners}, True, picture, how, spread_px, hand_look)


def _sample(source: FrameSource, step: int) -> list[NDArray[np.uint8]]:
    """Return every `step`-th frame in grey, fewer where frames are large."""
    frames: list[NDArray[np.uint8]] = []
    for image in source.frames(step=step):
        if len(frames) > 4 and (len(frames) + 1) * image.shape[0] * image.shape[1] > _CLIP_BYTES:
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


def _moves(
    board: Chessboard, frames: Sequence[NDArray[np.uint8]], settings: CalibrationSettings
) -> bool:
    """Tell whether the board is found in different places of a clip's first, middle, last frame."""
    chosen = sorted({0, len(frames) // 2, len(frames) - 1})
    change = max(
        float(cv2.blur(cv2.absdiff(frames[0], frames[index]), (15, 15)).max()) for index in chosen
    )
    if change < _STILL_GREY:
        return False  # spares the search in three pictures that are the same but for noise
    found = [detect_corners(frames[index], board, "usual").corners for index in chosen]
    seen = [corners for corners in found if corners is not None]
    return any(np.abs(a - b).max() > settings.still_px for a, b in combinations(seen, 2))


def _spread(
    board: Chessboard, frames: Sequence[NDArray[np.uint8]], corners: NDArray[np.float64]
) -> float | None:
    """Return how far the worst corner strays, median over frames; inf where most show no board."""
    if len(frames) == 1:
        return None
    chosen = np.linspace(0, len(frames) - 1, min(_SPREAD_FRAMES, len(frames))).round().astype(int)
    again = [refine_corners(frames[index], board, corners) for index in chosen]
    strays = [np.inf if seen is None else float(np.abs(seen - corners).max()) for seen in again]
    return float(np.median(strays))


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
) -> Clip:
    corners: dict[int, NDArray[np.float64]] = {}
    size_px = (0, 0)
    count = 0
    for index, image in enumerate(source.frames(step=step)):
        size_px = (image.shape[1], image.shape[0])
        count += 1
        found = detect_corners(image, board, "usual").corners
        if found is not None:
            corners[index * step] = found
    if not corners:
        raise CalibrationError(
            f"camera {camera.name!r}: no board of {board.columns}x{board.rows} inner corners found "
            f"in any of {count} frames of {source.label}; check columns and rows"
        )
    return Clip(size_px, corners, False, how=f"detected in {len(corners)} of {count} frames")


# --- From corners to a rig ------------------------------------------------------------------


def solve_rig(
    board: Chessboard,
    observations: Sequence[Observations],
    settings: CalibrationSettings = _DEFAULTS,
    progress: Progress | None = None,
) -> Rig:
    """Solve lenses and poses from the corners that were seen: the quick half of `calibrate_rig`."""
    report = progress or _no_progress
    # The rig's numbers must not depend on the order in which cameras are listed.
    ordered = sorted(observations, key=lambda seen: natural_order(seen.name))
    lenses = []
    for index, seen in enumerate(ordered):
        report("fitting lenses", index, len(ordered))
        lenses.append(_fit_lens(board, seen, settings))
    report("fitting lenses", len(ordered), len(ordered))
    report("adjusting everything", 0, 1)
    clips = [seen.clip for seen in ordered]
    labelling: dict[str, Any] = {"looks": len(board.looks), "decided_by": "the board's colours"}
    if all(clip.is_still for clip in clips):
        looks, labelling = _label_still_board(board, lenses, clips)
        clips = [
            replace(clip, corners={0: clip.corners[0][board.looks[look]]})
            for clip, look in zip(clips, looks, strict=True)
        ]
    elif len(board.looks) > 1:
        labelling["decided_by"] = "poses common to all frames"
    placed, result, views, n_common = _adjust_all(board, lenses, clips, settings)
    provenance = _provenance(
        board, ordered, lenses, labelling, settings, views, n_common, result, placed
    )
    report("adjusting everything", 1, 1)
    by_name = {camera.name: camera for camera in placed}
    return Rig(tuple(by_name[seen.name] for seen in observations), provenance)


def _fit_lens(board: Chessboard, seen: Observations, settings: CalibrationSettings) -> FittedLens:
    stills, clip = seen.stills, seen.clip
    if stills.size_px is not None and stills.size_px != clip.size_px:
        raise CalibrationError(
            "camera {!r}: intrinsics are {}x{} pixels, extrinsics {}x{}; record both in the same "
            "mode".format(seen.name, *stills.size_px, *clip.size_px)
        )
    views = dict(stills.corners)
    if not clip.is_still:
        views |= {_clip_view(frame): corners for frame, corners in clip.corners.items()}
    if len(views) < settings.min_views:
        found = f"in {len(views)} of {len(views) + len(stills.missed)} stills"
        if stills.size_px is None:
            found = "only lying still in the clip that all cameras see"
        raise CalibrationError(
            f"camera {seen.name!r}: the board of {board.columns}x{board.rows} inner corners was "
            f"found {found}, expected {settings.min_views} views or more to fit a lens; check "
            "columns and rows, or take more pictures of it (`intrinsics`)"
        )

    def limit_px(errors_px: Sequence[float]) -> float:
        relative = settings.max_view_medians * float(np.median(errors_px))
        return min(settings.max_view_px, max(relative, settings.always_good_px))

    lens = fit_lens(
        board.points_board,
        seen.name,
        seen.model,
        clip.size_px,
        views,
        limit_px,
        settings.min_views,
        settings.loss_px,
    )
    for name, reason in lens.dropped.items():
        logger.info("camera %s: %s dropped: %s", seen.name, name, reason)
    return lens


def _clip_view(frame: int) -> str:
    return f"board clip, frame {frame}"


def _label_still_board(
    board: Chessboard, lenses: Sequence[FittedLens], clips: Sequence[Clip]
) -> tuple[list[int], dict[str, Any]]:
    """Choose the look of the board in each camera; return looks and evidence."""
    n_cameras, n_looks = len(lenses), len(board.looks)
    evidence: dict[str, Any] = {"looks": n_looks, "decided_by": "the board's colours"}
    looks = [0] * n_cameras
    if n_looks > 1 and n_cameras > 1:
        votes, matches = _votes_of_scene(board, lenses, clips)
        for i, j in combinations(range(n_cameras), 2):
            hand_i, hand_j = clips[i].hand_look, clips[j].hand_look
            if hand_i is not None and hand_j is not None:
                votes[i, j, (hand_j - hand_i) % n_looks] += _HAND_VOTES
        chosen = choose_looks(votes)
        looks = list(chosen.looks)
        names = [lens.camera.name for lens in lenses]
        by_hand = sum(clip.hand_look is not None for clip in clips) > 1
        evidence |= {
            "decided_by": "matches of the scene" + (" and corners by hand" if by_hand else ""),
            "matches_by_look": matches,
            "margin_sigma": {
                name: round(margin, 2)
                for name, margin in zip(names, chosen.margins_sigma, strict=True)
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
    for clip, look in zip(clips, looks, strict=True):
        if clip.hand_look is not None:
            turn = clip.hand_look - look
            break
    return [(look + turn) % n_looks for look in looks], evidence


def _votes_of_scene(
    board: Chessboard, lenses: Sequence[FittedLens], clips: Sequence[Clip]
) -> tuple[NDArray[np.float64], dict[str, list[int]]]:
    """Count the matches of the scene for each pair of cameras and each look."""
    poses = [
        _clip_pose(board, lens.camera, clip)[0] for lens, clip in zip(lenses, clips, strict=True)
    ]
    scenes = [
        describe_scene(lens.camera, pose, clip.picture, board) if clip.picture is not None else None
        for lens, pose, clip in zip(lenses, poses, clips, strict=True)
    ]
    votes = np.zeros((len(lenses), len(lenses), len(board.looks)))
    matches = {}
    for i, j in combinations(range(len(lenses)), 2):
        first, second = scenes[i], scenes[j]
        if first is not None and second is not None:
            votes[i, j] = count_agreeing(first, poses[i], second, poses[j], board)
        pair = f"{lenses[i].camera.name} {lenses[j].camera.name}"
        matches[pair] = [int(count) for count in votes[i, j]]
    return votes, matches


def _clip_pose(board: Chessboard, camera: Camera, clip: Clip) -> tuple[Pose, float]:
    """Return cam_from_board of a still clip, and how many times worse the other pose fits."""
    located = locate_board(camera, board.points_board, clip.corners[0])
    if located is None:
        raise CalibrationError(
            f"camera {camera.name!r}: the lens fitted to its stills cannot have seen the board "
            "clip; were both recorded by this camera, with the same zoom?"
        )
    return located[0], located[2] / max(located[1], 1e-9)


def _adjust_all(
    board: Chessboard,
    lenses: Sequence[FittedLens],
    clips: Sequence[Clip],
    settings: CalibrationSettings,
) -> tuple[tuple[Camera, ...], Adjustment, list[BoardView], int]:
    """Return cameras in the world, the adjustment, its views, and how many are of the clips."""
    cameras, boards, views = link_cameras(
        board,
        [lens.camera for lens in lenses],
        [clip.corners for clip in clips],
        is_labelled=all(clip.is_still for clip in clips),
    )
    n_common = len(views)
    common_frames = [view.frame for view in views]
    of_clip = {(view.camera, _clip_view(view.frame)) for view in views}
    frame = max(boards) + 1  # views of the board by single cameras follow the common frames
    for index, lens in enumerate(lenses):
        for name, (corners, cam_from_board) in lens.views.items():
            if (index, name) not in of_clip:
                views.append(BoardView(index, frame, corners, name))
                boards[frame] = compose(invert(cameras[index].cam_from_world), cam_from_board)
                frame += 1
    result = adjust(board.points_board, cameras, boards, views, settings.loss_px)
    for view, residuals in zip(views[:n_common], result.residuals_px, strict=False):
        missed_px = rms(residuals)
        if missed_px > _WRONG_CLIP_FACTOR * settings.max_view_px and clips[view.camera].is_still:
            raise CalibrationError(
                f"camera {cameras[view.camera].name!r}: the board clip misses its lens by "
                f"{missed_px:.1f} px; were clip and stills recorded by this camera, with the same "
                "zoom, and is the board the same?"
            )
    # The world: the board in the first of the frames that most cameras see.
    seen = Counter(common_frames)
    world = max(sorted(seen), key=lambda common: (seen[common], -common))
    rig_from_world = result.rig_from_board[world]
    placed = tuple(
        replace(camera, cam_from_world=_orthonormal(compose(camera.cam_from_world, rig_from_world)))
        for camera in result.cameras
    )
    for camera in placed:
        if camera.center_world[2] <= 0:
            raise CalibrationError(
                f"camera {camera.name!r} came out {-camera.center_world[2]:.2f} m under the floor: "
                "is its picture mirrored, or did it see another board?"
            )
    return placed, result, views, n_common


def _orthonormal(pose: Pose) -> Pose:
    u, _, vt = np.linalg.svd(pose[:, :3])
    return np.column_stack([u @ vt, pose[:, 3]])


def _provenance(
    board: Chessboard,
    observations: Sequence[Observations],
    lenses: Sequence[FittedLens],
    labelling: dict[str, Any],
    settings: CalibrationSettings,
    views: Sequence[BoardView],
    n_common: int,
    result: Adjustment,
    placed: Sequence[Camera],
) -> dict[str, Any]:
    """Return where the rig comes from, as plain JSON values."""

    def errors(indices: list[int]) -> dict[str, Any]:
        if not indices:
            return {"views_used": 0, "rms_px": None, "max_px": None}
        residuals = np.concatenate([result.residuals_px[index] for index in indices])
        worst = float(np.linalg.norm(residuals, axis=1).max())
        return {
            "views_used": len(indices),
            "rms_px": round(rms(residuals), 4),
            "max_px": round(worst, 3),
        }

    cameras: dict[str, dict[str, Any]] = {}
    for index, (seen, lens, camera) in enumerate(zip(observations, lenses, placed, strict=True)):
        own = [i for i, view in enumerate(views) if view.camera == index and i >= n_common]
        common = [i for i, view in enumerate(views) if view.camera == index and i < n_common]
        clip = seen.clip
        extrinsics = {
            "source": seen.sources.get("extrinsics"),
            "corners_by_hand": seen.sources.get("corners"),
            **errors(common),
            "how": clip.how,
        }
        if clip.spread_px is not None and np.isfinite(clip.spread_px):
            extrinsics["spread_over_clip_px"] = round(clip.spread_px, 4)
        if clip.is_still:
            tilt = _clip_pose(board, camera, clip)[1]
            extrinsics["other_tilt_times_worse"] = round(min(tilt, 1e6), 2)
            if tilt < _TILT_FACTOR:
                logger.warning(
                    "camera %s: the board clip hardly tells how the board is tilted (the other "
                    "tilt fits %.1f times worse); use a larger board or bring it nearer",
                    camera.name,
                    tilt,
                )
        cameras[seen.name] = {
            "model": seen.model,
            "center_m": [round(float(value), 4) for value in camera.center_world],
            "intrinsics": {
                "source": seen.sources.get("intrinsics"),
                **errors(own),
                "views_dropped": lens.dropped,
                "views_without_board": seen.stills.missed,
            },
            "extrinsics": extrinsics,
        }
    is_still = all(seen.clip.is_still for seen in observations)
    return {
        "method": "chessboard; joint bundle adjustment of lenses, poses and boards (pycolmap)",
        "software": {
            name: importlib.metadata.version(name)
            for name in ("pycolmap", "opencv-python-headless")
        },
        "board": asdict(board),
        "world": "the board as it lies in the clip"
        if is_still
        else "the board in the first frame that most cameras see",
        "rms_px": round(rms(np.concatenate(result.residuals_px)), 4),
        "cameras": cameras,
        "labelling": labelling,
        "settings": asdict(settings),
    }
