"""What the pictures show of the boards: the slow half of a calibration, done once.

Stills of a camera alone are searched quickly, and again with more effort if few show a board. In
the clip that all cameras recorded at once the boards lie still, then it is averaged (somebody who
walks through leaves no trace), or they move, then each frame is searched. Any board of the session
may be in any picture; parts of it may be hidden. All that was found is kept in a `CornerCache`, so
that a second run decodes no picture.
"""

import dataclasses
import hashlib
import logging
import os
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Detection, Effort, Observations, Sighting, is_seen
from hybridve.calib.boards.corners_io import GivenCorners, read_given
from hybridve.calib.boards.target import Chessboard, refine_corners
from hybridve.calib.camera import N_PARAMS
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import FrameSource, read_image
from hybridve.calib.seeing.corner_cache import Answer, CornerCache

logger = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]

#: What pictures are a question about, beside the question itself.
_Key = tuple[str | float, ...]

#: The model of a lens whose degrees of freedom are found out from the pictures.
AUTO_MODEL = "auto"

#: What a still clip is called where images are named.
CLIP = "board clip"

#: Frames in which the stillness of an averaged clip is measured.
_SPREAD_FRAMES = 9

#: Frames whose means over 15x15 pixels differ by less show the same.
_STILL_GREY = 8.0

#: Bytes of grey frames of one clip held at once; larger images are averaged over fewer frames.
_CLIP_BYTES = 200_000_000


@dataclass(frozen=True, slots=True)
class CameraInput:
    """What was recorded of the boards by one camera.

    Attributes
    ----------
    name : str
        Unique within the rig.
    model : str
        A COLMAP camera model, a key of `hybridve.calib.camera.N_PARAMS`, or "auto".
    intrinsics : FrameSource or None
        Boards in many places, in this camera alone. None: the views of `extrinsics` serve,
        if the boards move there.
    extrinsics : FrameSource or None
        The boards as all cameras see them at once, frame by frame.
    corners : Path or None
        Corners found by something else, see `hybridve.calib.boards.corners_io`. Those of named
        images stand instead of what would be found there; those of the clip as a whole serve where
        nothing is found.
    lens : str or None
        Cameras with the same lens share intrinsics.
    params : tuple of float, or None
        Intrinsics that are known, in COLMAP's order.
    """

    name: str
    model: str
    intrinsics: FrameSource | None
    extrinsics: FrameSource | None
    corners: Path | None = None
    lens: str | None = None
    params: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class ObserveSettings:
    """How pictures are searched; the defaults serve.

    Attributes
    ----------
    max_stills : int
        Stills looked at, evenly spread over what there is.
    enough_stills : int
        With fewer stills found by the quick search, the others are searched again with more
        effort.
    clip_frames : int
        Frames of the extrinsic clip looked at, evenly spread.
    still_px : float
        A board that moves less than this in the clip lies still, and the clip is averaged.
    threads : int
        Images searched at the same time; 0 for as many as there are processors.
    every_clip_frame : bool
        Whether each frame of a clip with moving boards is looked at (quickly, between those of
        `clip_frames`): what moves is a clock only if it is seen often.
    """

    max_stills: int = 120
    enough_stills: int = 20
    clip_frames: int = 40
    still_px: float = 1.0
    threads: int = 0
    every_clip_frame: bool = False


_DEFAULTS = ObserveSettings()


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
        look alike, a camera is listed twice or has no clip, or its stills are of another size
        than its clip; for corners of a file that belong to no picture.
    """
    _check_boards(boards)
    _check_inputs(cameras)
    with _Search(boards, settings, progress or _no_progress, cache) as search:
        given = {camera.name: _given(boards, camera) for camera in cameras}
        clips = _observe_clips(search, cameras, given)
        stills = [_observe_stills(search, camera, given[camera.name]) for camera in cameras]
    return [
        _observations(camera, still, clip)
        for camera, still, clip in zip(cameras, stills, clips, strict=True)
    ]


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
    with _Search(boards, settings, progress or _no_progress, cache) as search:
        given = {camera.name: _given(boards, camera) for camera in seeing}
        clips = _observe_clips(search, seeing, given)
    return [_observations(camera, None, clip) for camera, clip in zip(seeing, clips, strict=True)]


def _no_progress(what: str, done: int, total: int) -> None:
    del what, done, total


def _check_boards(boards: Sequence[Board]) -> None:
    if not boards:
        raise CalibrationError("there is no board to look for; describe at least one")
    for (i, first), (j, second) in combinations(enumerate(boards), 2):
        alike = _description(first) == _description(second)
        if isinstance(first, Chessboard) and isinstance(second, Chessboard):
            alike = {first.columns, first.rows} == {second.columns, second.rows}
        if alike:
            raise CalibrationError(
                f"boards {_name_of(boards, i)!r} and {_name_of(boards, j)!r} look alike "
                f"({first}), so that no picture tells one from the other; use boards of different "
                "numbers of corners, or with different markers"
            )


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


# --- Questions, and who answers them ----------------------------------------------------------


class _Search:
    """The boards, how they are searched, and what is known already."""

    def __init__(
        self,
        boards: Sequence[Board],
        settings: ObserveSettings,
        report: Progress,
        kept: CornerCache | None,
    ) -> None:
        self.boards = boards
        self.settings = settings
        self.report = report
        self.cache = CornerCache(None) if kept is None else kept
        self.threads = settings.threads or os.cpu_count() or 1
        self.pool = ThreadPoolExecutor(self.threads)
        self._descriptions = [_description(board) for board in boards]

    def __enter__(self) -> "_Search":
        return self

    def __exit__(self, *_: object) -> None:
        # Keeps what was found before an error or an interruption.
        self.pool.shutdown(cancel_futures=True)
        self.cache.save()

    def question(self, picture: _Key, board: int, effort: Effort) -> _Key:
        """Return the question whether a picture shows a board."""
        return (*picture, self._descriptions[board], effort)

    def detect(
        self, picture: _Key, board: int, effort: Effort, image: Callable[[], NDArray[Any]]
    ) -> Detection:
        """Return whether a picture shows a board, looking at it only if that is not known."""

        def look() -> Answer:
            return _told(self.boards[board].detect(image(), effort))

        return _detection(self.cache.recall(self.question(picture, board, effort), look))

    def identify(self, paths: Iterable[Path], label: str) -> str:
        try:
            return self.cache.identify(paths)
        except OSError as error:
            raise CalibrationError(f"{label}: cannot be read: {error.strerror}") from error


def _told(detection: Detection) -> Answer:
    return {"how": detection.how, "notes": list(detection.notes)}, detection.corners


def _detection(answer: Answer) -> Detection:
    told, corners = answer
    return Detection(corners, told["how"], tuple(told["notes"]))


def _description(board: Board) -> str:
    """Return a text of all that a board looks like, and of the code that looks for it.

    Its name, and what it is fixed to, are no part of it. A class that is no dataclass and has no
    `repr` of its own is described anew in each run, and nothing of it is found in a cache.
    """
    said = repr(board)
    if dataclasses.is_dataclass(board):
        values = {
            item.name: getattr(board, item.name)
            for item in dataclasses.fields(board)
            if item.name not in ("name", "body")
        }
        said = repr(sorted(values.items()))
    modules = sorted({base.__module__ for base in type(board).__mro__} | {Chessboard.__module__})
    code = [_digest_of_code(module) for module in [*modules, __name__]]
    return f"{type(board).__qualname__} {said} {' '.join(code)}"


@cache
def _digest_of_code(module: str) -> str:
    """Return a digest of a module's source: what another version finds may differ."""
    path = getattr(sys.modules.get(module), "__file__", None)
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest() if path else module
    except OSError:
        return module


def _name_of(boards: Sequence[Board], index: int) -> str:
    return getattr(boards[index], "name", f"board{index + 1}")


def _list_boards(boards: Sequence[Board]) -> str:
    if len(boards) == 1:
        return f"no board of {boards[0]}"
    return "none of the boards (" + "; ".join(map(str, boards)) + ")"


# --- Corners that are given -------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Given:
    """The corners that a file gives for one camera, by index of the image and board."""

    whole: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    stills: dict[tuple[int, int], NDArray[np.float64]] = field(default_factory=dict)
    clip: dict[tuple[int, int], NDArray[np.float64]] = field(default_factory=dict)


def _given(boards: Sequence[Board], camera: CameraInput) -> _Given:
    """Return given corners with the images they name found."""
    given = _Given()
    if camera.corners is None or camera.extrinsics is None:
        return given
    clip = camera.extrinsics
    stills = None if _serves_as_stills(camera) else camera.intrinsics
    for corners in read_given(camera.corners, boards):
        if corners.image is None:
            given.whole[corners.board] = corners.pixels
            continue
        if isinstance(corners.image, int):
            if not clip.is_video and corners.image >= len(clip.paths):
                raise CalibrationError(
                    f"{camera.corners}: frame {corners.image}; {clip.label} has "
                    f"{len(clip.paths)}, from 0"
                )
            places = [(given.clip, corners.image)]
        else:
            places = []
            if not clip.is_video:  # whose frames have a column of their own
                places += [(given.clip, index) for index in _named(clip, corners.image)]
            if stills is not None:
                places += [(given.stills, index) for index in _named(stills, corners.image)]
            _check_one(camera, corners, len(places))
        for images, index in places:
            images[index, corners.board] = corners.pixels
    return given


def _check_one(camera: CameraInput, corners: GivenCorners, count: int) -> None:
    if count != 1:
        found = "no picture" if count == 0 else f"{count} pictures"
        raise CalibrationError(
            f"{camera.corners}: image {corners.image!r} is the name of {found} of camera "
            f"{camera.name!r}; give as much of its path as makes it one"
        )


def _named(source: FrameSource, name: str) -> list[int]:
    """Return which images of a source a name may mean; those of a video are called "frame 3"."""
    if source.is_video:
        number = name.removeprefix("frame ")
        return [int(number)] if number != name and number.isdecimal() else []
    parts = Path(name).parts
    return [index for index, path in enumerate(source.paths) if path.parts[-len(parts) :] == parts]


# --- Pictures one by one ----------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Choice:
    """Every `step`-th picture of a source, and some more by index."""

    step: int
    more: frozenset[int] = frozenset()

    def takes(self, index: int) -> bool:
        return index % self.step == 0 or index in self.more

    def of(self, count: int) -> list[int]:
        return [index for index in range(count) if self.takes(index)]

    def read_video(self, source: FrameSource) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        step = 1 if self.more else self.step  # frames that are skipped are not decoded
        for number, image in enumerate(source.frames(step=step)):
            if self.takes(number * step):
                yield number * step, image


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """What a search of many pictures gave, by index of the picture.

    Attributes
    ----------
    sizes : dict of int to (width, height)
        All pictures that were looked at.
    detections : dict of (index, board) to Detection
        What was found, or how it was searched in vain.
    """

    sizes: dict[int, tuple[int, int]] = field(default_factory=dict)
    detections: dict[tuple[int, int], Detection] = field(default_factory=dict)

    @property
    def with_board(self) -> set[int]:
        """The pictures that show a board."""
        return {
            index
            for (index, _), detection in self.detections.items()
            if detection.corners is not None
        }


def _search_pictures(
    search: _Search,
    source: FrameSource,
    choice: _Choice,
    effort_of: Callable[[int], Effort],
    is_wanted: Callable[[int, int], bool],
    found: _Found,
    what: str,
) -> None:
    """Look for the boards in pictures of a source, and add to what was found.

    What is known is not looked at, and a picture of which all is known is not decoded.

    Parameters
    ----------
    search, source
        What to look for, and where.
    choice : _Choice
        Which pictures.
    effort_of : callable
        With how much effort, by picture.
    is_wanted : callable
        Whether a picture is searched for a board.
    found : _Found
        What was found before; changed.
    what : str
        What is being done, for the progress.
    """
    waiting: deque[tuple[int, int, _Key, Future[Detection]]] = deque()

    def collect(down_to: int) -> None:
        while len(waiting) > down_to:
            index, board, question, future = waiting.popleft()
            detection = future.result()
            found.detections[index, board] = detection
            search.cache.keep(question, _told(detection))

    def recall(index: int, picture: _Key) -> list[int] | None:
        """Take what is known of a picture; return the boards to look for, None for a new one."""
        size = search.cache.known((*picture, "size"))
        if size is None:
            return None
        width_px, height_px = size[0]["size_px"]
        found.sizes[index] = (width_px, height_px)
        missing = []
        for board in range(len(search.boards)):
            if is_wanted(index, board):
                known = search.cache.known(search.question(picture, board, effort_of(index)))
                if known is None:
                    missing.append(board)
                else:
                    found.detections[index, board] = _detection(known)
        return missing

    def look(index: int, picture: _Key, image: NDArray[np.uint8]) -> None:
        missing = recall(index, picture)
        if missing is None:
            missing = [board for board in range(len(search.boards)) if is_wanted(index, board)]
            size_px = (image.shape[1], image.shape[0])
            found.sizes[index] = size_px
            search.cache.keep((*picture, "size"), ({"size_px": list(size_px)}, None))
        for board in missing:
            effort = effort_of(index)
            future = search.pool.submit(search.boards[board].detect, image, effort)
            waiting.append((index, board, search.question(picture, board, effort), future))
        collect(2 * search.threads)  # so that memory does not grow with the source

    if source.is_video:
        total = len(choice.of(_length(search, source)))
        content = search.identify(source.paths, source.label)
        # Only reading tells how many frames a video has.
        walk: _Key = ("frames", content, choice.step, *sorted(choice.more))
        read = search.cache.known(walk)
        if read is None or any(
            recall(index, ("picture", content, index)) != [] for index in read[0]["indices"]
        ):
            done = []
            for index, image in choice.read_video(source):
                look(index, ("picture", content, index), image)
                done.append(index)
                search.report(what, min(len(done), total), total)
            collect(0)
            search.cache.keep(walk, ({"indices": done}, None))
    else:
        indices = choice.of(len(source.paths))
        total = len(indices)
        for number, index in enumerate(indices, start=1):
            path = source.paths[index]
            picture: _Key = ("picture", search.identify([path], source.label), 0)
            if recall(index, picture) != []:
                look(index, picture, read_image(path))
            search.report(what, number, total)
        collect(0)
    search.report(what, total, total)  # a video may end before its header says


def _length(search: _Search, source: FrameSource) -> int:
    """Return how many frames there are, about; some videos do not say."""

    def count() -> Answer:
        claimed = source.claimed_length()
        return {"length": claimed if claimed > 0 else max(1, source.count())}, None

    if not source.is_video:
        return len(source.paths)
    question = ("length", search.identify(source.paths, source.label))
    length: int = search.cache.recall(question, count)[0]["length"]
    return length


# --- Stills of one camera ---------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Stills or a clip of one camera, as they go into its `Observations`."""

    size_px: tuple[int, int]
    sightings: tuple[Sighting, ...]
    how: str = ""
    notes: tuple[str, ...] = ()
    missed: dict[str, str] = field(default_factory=dict)
    is_still: bool = False
    picture: NDArray[np.float32] | None = None
    spread_px: float | None = None
    hand_look: int | None = None


def _serves_as_stills(camera: CameraInput) -> bool:
    """Tell whether the views of the extrinsic clip serve for the lens, too."""
    source = camera.intrinsics
    return source is None or (
        camera.extrinsics is not None and source.paths == camera.extrinsics.paths
    )


def _observe_stills(search: _Search, camera: CameraInput, given: _Given) -> _Seen | None:
    source = camera.intrinsics
    if source is None or _serves_as_stills(camera):
        return None
    step = -(-_length(search, source) // search.settings.max_stills)
    choice = _Choice(step, frozenset(index for index, _ in given.stills))
    found = _Found()
    what = f"stills of {camera.name}"

    def is_searched(index: int, board: int) -> bool:
        return (index, board) not in given.stills

    _search_pictures(search, source, choice, lambda _: "quick", is_searched, found, what)
    if not found.sizes:
        raise CalibrationError(f"camera {camera.name!r}: {source.label} holds no picture")
    _take_given(found, given.stills)
    first = found.with_board
    if len(first) < min(search.settings.enough_stills, len(found.sizes)):
        _search_pictures(
            search,
            source,
            choice,
            lambda _: "usual",
            lambda index, board: index not in first and is_searched(index, board),
            found,
            f"{what}, again",
        )
    logger.info(
        "camera %s: boards found in %d of %d stills",
        camera.name,
        len(found.with_board),
        len(found.sizes),
    )
    names = _names_of_images(source, found.sizes)
    counts = Counter(found.sizes.values())
    size_px = max(counts, key=lambda size: (counts[size], size))
    missed = {}
    for index in sorted(found.sizes):
        if found.sizes[index] != size_px:
            missed[names[index]] = "is {}x{} pixels, most are {}x{}".format(
                *found.sizes[index], *size_px
            )
        elif index not in found.with_board:
            missed[names[index]] = "no board found"
    fitting = {index: names[index] for index in names if names[index] not in missed}
    sightings, notes = _sightings(search.boards, found, fitting, False)
    return _Seen(size_px, sightings, notes=notes, missed=missed)


def _take_given(found: _Found, given: dict[tuple[int, int], NDArray[np.float64]]) -> None:
    for (index, board), pixels in given.items():
        if index in found.sizes:
            found.detections[index, board] = Detection(pixels, "given")


def _names_of_images(source: FrameSource, indices: Iterable[int]) -> dict[int, str]:
    """Return what to call images: by as little of their paths as tells them apart."""
    if source.is_video:
        return {index: f"frame {index}" for index in sorted(indices)}
    names = [path.name for path in source.paths]
    for depth in range(2, max(len(path.parts) for path in source.paths)):
        if len(set(names)) == len(names):
            break
        names = ["/".join(path.parts[-depth:]) for path in source.paths]
    return {index: names[index] for index in sorted(indices)}


def _sightings(
    boards: Sequence[Board], found: _Found, names: dict[int, str], is_clip: bool
) -> tuple[tuple[Sighting, ...], tuple[str, ...]]:
    """Return the sightings in pictures that have names, and what is unusual about them."""
    sightings = []
    notes = []
    for index, image in names.items():
        in_image = {
            number: found.detections[index, number]
            for number in range(len(boards))
            if (index, number) in found.detections
        }
        for number, detection in _without_parts(boards, in_image).items():
            if detection.corners is not None:
                instant = index if is_clip else None
                sightings.append(Sighting(image, instant, number, detection.corners))
                notes += _notes(boards, number, image, detection)
    return tuple(sightings), tuple(notes)


def _without_parts(boards: Sequence[Board], found: dict[int, Detection]) -> dict[int, Detection]:
    """Return what was found in one picture without chessboards that are a part of a larger one."""
    plain = {
        number: detection.corners[is_seen(detection.corners)].astype(np.float32)
        for number, detection in found.items()
        if detection.corners is not None and isinstance(boards[number], Chessboard)
    }
    kept = dict(found)
    for (i, first), (j, second) in combinations(plain.items(), 2):
        part, whole = (i, second) if len(first) < len(second) else (j, first)
        middle = plain[part].mean(axis=0)
        outline = np.asarray(cv2.convexHull(whole))
        if cv2.pointPolygonTest(outline, (float(middle[0]), float(middle[1])), False) > 0:
            kept[part] = Detection(None, "found only as a part of a larger board")
    return kept


def _notes(boards: Sequence[Board], number: int, image: str, detection: Detection) -> list[str]:
    which = f", {_name_of(boards, number)}" if len(boards) > 1 else ""
    return [f"{image}{which}: {note}" for note in detection.notes]


# --- The clip that all cameras recorded at once -----------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Unseen:
    """A clip whose average shows no board that can be trusted.

    Attributes
    ----------
    moves : bool
        Whether a board was seen to move.
    changes : bool
        Whether anything did.
    tried : str
        How the average was searched.
    faint : _Seen or None
        Boards that the average shows, and most single frames do not.
    """

    moves: bool
    changes: bool
    tried: str = ""
    faint: _Seen | None = None


class _Clip:
    """The frames of one camera's clip, read when they are first looked at."""

    def __init__(
        self, search: _Search, camera: CameraInput, source: FrameSource, step: int
    ) -> None:
        self.camera = camera
        self.source = source
        self.step = step
        self._cache = search.cache
        self.key: _Key = ("clip", search.identify(source.paths, source.label), step)

    @cached_property
    def frames(self) -> list[NDArray[np.uint8]]:
        """Every `step`-th frame in grey, fewer where frames are large."""
        frames: list[NDArray[np.uint8]] = []
        for image in self.source.frames(step=self.step):
            if len(frames) > 4 and (len(frames) + 1) * image.shape[0] * image.shape[1] > (
                _CLIP_BYTES
            ):
                break
            frames.append(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8))
        if not frames:
            raise CalibrationError(
                f"camera {self.camera.name!r}: {self.source.label} holds no picture"
            )
        if any(frame.shape != frames[0].shape for frame in frames):
            raise CalibrationError(
                f"camera {self.camera.name!r}: the pictures of {self.source.label} differ in size"
            )
        return frames

    @cached_property
    def _counts(self) -> dict[str, Any]:
        def count() -> Answer:
            height_px, width_px = self.frames[0].shape
            return {"frames": len(self.frames), "size_px": [width_px, height_px]}, None

        return self._cache.recall((*self.key, "counts"), count)[0]

    @property
    def n_frames(self) -> int:
        return int(self._counts["frames"])

    @property
    def size_px(self) -> tuple[int, int]:
        width_px, height_px = self._counts["size_px"]
        return width_px, height_px

    @cached_property
    def picture(self) -> NDArray[np.float32]:
        """The average: (H, W) grey levels."""
        total = self._cache.recall_picture((*self.key, "sum"), lambda: _steady_sum(self.frames))
        return np.asarray(total / (self.n_frames - 2 * (self.n_frames // 4)), np.float32)


def _steady_sum(frames: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint16]:
    """Return the sum of the middle half of each pixel's values, (H, W).

    Somebody who crosses the picture, for less than a quarter of the clip, leaves no trace; unlike
    a median the mean resolves less than a grey level. Half of the frames of `ObserveSettings` are
    far less than the 257 whose sum may be too large.
    """
    quarter = len(frames) // 4
    total = np.zeros(frames[0].shape, np.uint16 if len(frames) <= 257 else np.uint32)
    for row in range(0, len(total), 64):  # in strips, to sort little memory at a time
        strip = np.sort(np.stack([frame[row : row + 64] for frame in frames]), axis=0)
        total[row : row + 64] = strip[quarter : len(frames) - quarter].sum(axis=0)
    return total


def _observe_clips(
    search: _Search, cameras: Sequence[CameraInput], given: dict[str, _Given]
) -> list[_Seen]:
    sources = [camera.extrinsics for camera in cameras if camera.extrinsics is not None]
    # One step for all cameras: frames with the same number were taken at the same time.
    lengths = [_length(search, source) for source in sources]
    step = -(-min(lengths) // search.settings.clip_frames)
    clips = [
        _Clip(search, camera, source, step) for camera, source in zip(cameras, sources, strict=True)
    ]
    jobs = [
        search.pool.submit(_observe_still_clip, search, clip, given[clip.camera.name])
        for clip in clips
    ]
    search.report("board clips", 0, len(jobs))
    stills = []
    for done, job in enumerate(jobs, start=1):
        stills.append(job.result())
        search.report("board clips", done, len(jobs))
    seen = [still for still in stills if isinstance(still, _Seen)]
    if len(seen) == len(clips):
        return seen
    moves = any(isinstance(still, _Unseen) and still.moves for still in stills)
    looked_at: dict[str, _Found] = {}
    if not moves:
        # No board is seen to move, and some cameras see none: perhaps frame by frame.
        for index, (clip, still) in enumerate(zip(clips, stills, strict=True)):
            if not isinstance(still, _Unseen):
                continue
            found = _search_clip(search, clip, given) if still.changes else _Found()
            if not found.with_board and still.faint is not None:
                stills[index] = still.faint  # in the noise of each frame, and in no other place
                continue
            if not found.with_board:
                raise CalibrationError(
                    f"camera {clip.camera.name!r}: {_list_boards(search.boards)} found in "
                    f"{clip.source.label} (average of {clip.n_frames} frames; {still.tried}); "
                    "check columns and rows, or mark the corners by hand (`corners`)"
                )
            looked_at[clip.camera.name] = found
            stills[index] = _still_in_frames(search, clip, found) or still
        seen = [still for still in stills if isinstance(still, _Seen)]
        if len(seen) == len(clips):
            return seen
    logger.info("the board moves in the clips: each frame is looked at")
    if not all(source.is_video for source in sources) and len(set(lengths)) > 1:
        logger.warning(
            "the clips of the board have different numbers of pictures (%s); those with the same "
            "place in their order are taken for pictures of the same instant",
            ", ".join(
                f"{camera.name}: {length}" for camera, length in zip(cameras, lengths, strict=True)
            ),
        )
    return [
        _moving_clip(
            search, clip, looked_at.get(clip.camera.name) or _search_clip(search, clip, given)
        )
        for clip in clips
    ]


def _observe_still_clip(search: _Search, clip: _Clip, given: _Given) -> _Seen | _Unseen:
    """Return the boards in the average of a clip, or that there are none or they move."""
    boards = search.boards
    by_hand = given.whole
    marked = _marked_still(given, search.settings.still_px)
    if marked is None:
        return _Unseen(True, True)
    average: _Key = (*clip.key, "average")

    def detect(board: int, effort: Effort) -> Detection:
        return search.detect(average, board, effort, lambda: clip.picture)

    found = {board: detect(board, "quick") for board in range(len(boards))}
    missing = [board for board, detection in found.items() if detection.corners is None]
    moves, changes = _moves(search, clip, missing) if missing else (False, False)
    if moves:
        return _Unseen(True, True)
    found |= {board: detect(board, "thorough") for board in missing if board not in marked}
    found = _without_parts(boards, found)
    spreads_px = {
        board: _spread(search, clip, board, detection.corners)
        for board, detection in found.items()
        if detection.corners is not None
    }
    strays_px = [
        spread_px
        for board, spread_px in spreads_px.items()
        if spread_px is not None and board not in by_hand
    ]
    if any(search.settings.still_px < stray_px < np.inf for stray_px in strays_px):
        return _Unseen(True, True)
    found |= {board: Detection(pixels, "given") for board, pixels in marked.items()}
    notes = []
    hows = {}
    hand_looks = []
    for number, detection in sorted(found.items()):
        hows[number] = f"detected ({detection.how})"
        if number in marked:
            hows[number] = "given"
            hand_looks.append((len(boards[number].looks) < 2, number, 0))
        elif detection.corners is None and number in by_hand:
            detection = _place_by_hand(boards[number], clip, by_hand[number], detection.how)
            found[number] = detection
            hows[number] = detection.how
            if detection.corners is not None:
                spreads_px[number] = _spread(search, clip, number, detection.corners)
        if detection.corners is None:
            hows[number] = "not found"
            continue
        notes += _notes(boards, number, CLIP, detection)
        if number in by_hand and number not in marked:
            look = _look_by_hand(boards[number], clip, detection.corners, by_hand[number])
            if look is not None:
                hand_looks.append((len(boards[number].looks) < 2, number, look))
    corners = {
        number: detection.corners
        for number, detection in sorted(found.items())
        if detection.corners is not None
    }
    if not corners:
        tried = "; ".join(dict.fromkeys(detection.how for detection in found.values()))
        return _Unseen(False, changes, tried)
    known_px = [spread_px for spread_px in spreads_px.values() if spread_px is not None]
    seen = _Seen(
        clip.size_px,
        tuple(Sighting(CLIP, 0, number, pixels) for number, pixels in corners.items()),
        how="; ".join(f"{_name_of(boards, number)}: {how}" for number, how in hows.items())
        if len(boards) > 1
        else hows[0],
        notes=tuple(notes),
        is_still=True,
        picture=clip.picture,
        spread_px=max(known_px) if known_px else None,
        hand_look=min(hand_looks)[2] if hand_looks else None,
    )
    return _Unseen(False, True, faint=seen) if np.inf in strays_px else seen


def _still_in_frames(search: _Search, clip: _Clip, found: _Found) -> _Seen | None:
    """Return boards that lie where single frames show them; None if they move.

    Somebody may stand before a board for so long that the average does not show it.
    """
    by_board: dict[int, list[NDArray[np.float64]]] = {}
    notes: dict[str, None] = {}
    for (_, board), detection in sorted(found.detections.items(), key=lambda item: item[0]):
        if detection.corners is not None:
            by_board.setdefault(board, []).append(detection.corners)
            notes |= dict.fromkeys(_notes(search.boards, board, CLIP, detection))
    middles = {}
    strays_px = []
    for board, listed in sorted(by_board.items()):
        seen = np.isfinite(stack := np.stack(listed)).any(axis=0)
        middles[board] = np.full(seen.shape, np.nan)
        middles[board][seen] = np.nanmedian(stack[:, seen], axis=0)
        strays_px += [_stray_px(corners, middles[board]) for corners in listed]
    if max(strays_px) > search.settings.still_px:
        return None
    return _Seen(
        clip.size_px,
        tuple(Sighting(CLIP, 0, board, corners) for board, corners in middles.items()),
        how=f"detected in {len(found.with_board)} of {len(found.sizes)} frames, not in the average",
        notes=tuple(notes),
        is_still=True,
        picture=clip.picture,
        spread_px=float(np.median(strays_px)),
    )


def _marked_still(given: _Given, still_px: float) -> dict[int, NDArray[np.float64]] | None:
    """Return the mean of the corners given for frames of the clip, None if they move."""
    frames: dict[int, list[NDArray[np.float64]]] = {}
    for (_, board), pixels in sorted(given.clip.items(), key=lambda item: item[0]):
        frames.setdefault(board, []).append(pixels)
    marked = {}
    for board, listed in frames.items():
        for pixels in listed[1:]:
            both = is_seen(pixels) & is_seen(listed[0])
            if both.any() and np.abs(pixels - listed[0])[both].max() > still_px:
                return None
        stack = np.stack(listed)
        count = np.isfinite(stack).sum(axis=0)
        mean = np.nansum(stack, axis=0) / np.maximum(count, 1)
        marked[board] = np.where(count > 0, mean, np.nan)
    return marked


def _place_by_hand(board: Board, clip: _Clip, marked: NDArray[np.float64], tried: str) -> Detection:
    """Return corners that were marked by hand, drawn onto the picture if that can be done."""
    corners = None
    if isinstance(board, Chessboard):
        corners = refine_corners(clip.picture, board, marked)
    how = "marked by hand, refined"
    if corners is None:
        corners = marked
        how = "marked by hand, not refined"
        if isinstance(board, Chessboard):
            how += ": no chessboard at that place"
    logger.warning(
        "camera %s: no board found in %s (%s); corners %s",
        clip.camera.name,
        clip.source.label,
        tried,
        how,
    )
    return Detection(corners, how)


def _look_by_hand(
    board: Board, clip: _Clip, corners: NDArray[np.float64], marked: NDArray[np.float64]
) -> int | None:
    """Return which look of a board was listed by hand; None if they were not of this board."""

    def miss_px(listed: NDArray[np.float64]) -> float:
        both = is_seen(listed) & is_seen(marked)
        return float(np.abs(listed - marked)[both].max()) if both.any() else np.inf

    misses_px = [miss_px(corners[look]) for look in board.looks]
    points = marked[is_seen(marked)]
    steps_px = np.linalg.norm(np.diff(points, axis=0), axis=1)
    # Most neighbours in the list are neighbours on the board: a step is a square.
    square_px = float(np.median(steps_px)) if len(steps_px) else np.inf
    if min(misses_px) <= square_px:
        return int(np.argmin(misses_px))
    logger.warning(
        "camera %s: the corners marked by hand are %.0f px away from those found in %s; those "
        "found are taken",
        clip.camera.name,
        min(misses_px),
        clip.source.label,
    )
    return None


def _moves(search: _Search, clip: _Clip, boards: Sequence[int]) -> tuple[bool, bool]:
    """Tell whether boards are found in different places of a clip, and whether anything changes.

    Looked at are its first, middle and last frame.
    """
    still_px = search.settings.still_px

    def compare() -> Answer:
        frames = clip.frames
        chosen = sorted({0, len(frames) // 2, len(frames) - 1})
        change = max(
            float(cv2.blur(cv2.absdiff(frames[0], frames[index]), (15, 15)).max())
            for index in chosen
        )
        if change < _STILL_GREY:  # spares the search in three pictures that are the same
            return {"moves": False, "changes": False}, None
        for board in boards:
            found = [search.boards[board].detect(frames[index], "usual") for index in chosen]
            seen = [detection.corners for detection in found if detection.corners is not None]
            if any(_stray_px(first, second) > still_px for first, second in combinations(seen, 2)):
                return {"moves": True, "changes": True}, None
        return {"moves": False, "changes": True}, None

    asked = [search.question((), board, "usual") for board in boards]
    question = (*clip.key, "moves", still_px, *(part for parts in asked for part in parts))
    told = search.cache.recall(question, compare)[0]
    return told["moves"], told["changes"]


def _stray_px(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Return how far the worst point strays that both show; inf if there is none."""
    both = is_seen(first) & is_seen(second)
    return float(np.abs(first - second)[both].max()) if both.any() else np.inf


def _spread(
    search: _Search, clip: _Clip, number: int, corners: NDArray[np.float64]
) -> float | None:
    """Return how far the worst corner strays, median over frames; inf where most show no board."""
    if clip.n_frames == 1:
        return None
    board = search.boards[number]

    def look(frame: NDArray[np.uint8]) -> NDArray[np.float64] | None:
        if isinstance(board, Chessboard) and is_seen(corners).all():
            return refine_corners(frame, board, corners)
        return board.detect(frame, "quick").corners

    def measure() -> Answer:
        count = len(clip.frames)
        chosen = np.linspace(0, count - 1, min(_SPREAD_FRAMES, count)).round().astype(int)
        again = [look(clip.frames[index]) for index in chosen]
        strays = [np.inf if seen is None else _stray_px(seen, corners) for seen in again]
        return {"spread_px": float(np.median(strays))}, None

    place = hashlib.sha256(corners.tobytes()).hexdigest()
    question = (*search.question(clip.key, number, "quick"), "spread", place)
    return float(search.cache.recall(question, measure)[0]["spread_px"])


def _search_clip(search: _Search, clip: _Clip, given: dict[str, _Given]) -> _Found:
    """Look for the boards frame by frame."""
    marked = given[clip.camera.name].clip
    more = frozenset(index for index, _ in marked)
    choice = _Choice(1 if search.settings.every_clip_frame else clip.step, more)
    found = _Found()
    _search_pictures(
        search,
        clip.source,
        choice,
        lambda index: "usual" if index % clip.step == 0 else "quick",
        lambda index, board: (index, board) not in marked,
        found,
        f"board clip of {clip.camera.name}",
    )
    _take_given(found, marked)
    return found


def _moving_clip(search: _Search, clip: _Clip, found: _Found) -> _Seen:
    if not found.with_board:
        raise CalibrationError(
            f"camera {clip.camera.name!r}: {_list_boards(search.boards)} found in any of "
            f"{len(found.sizes)} frames of {clip.source.label}; check columns and rows"
        )
    names = {index: f"{CLIP}, frame {index}" for index in sorted(found.sizes)}
    sightings, notes = _sightings(search.boards, found, names, True)
    sizes = set(found.sizes.values())
    if len(sizes) > 1:
        raise CalibrationError(
            f"camera {clip.camera.name!r}: the pictures of {clip.source.label} differ in size"
        )
    how = f"detected in {len(found.with_board)} of {len(found.sizes)} frames"
    return _Seen(sizes.pop(), sightings, how=how, notes=notes)


def _observations(camera: CameraInput, stills: _Seen | None, clip: _Seen) -> Observations:
    if stills is not None and stills.size_px != clip.size_px:
        raise CalibrationError(
            "camera {!r}: intrinsics are {}x{} pixels, extrinsics {}x{}; record both in the same "
            "mode".format(camera.name, *stills.size_px, *clip.size_px)
        )
    own = stills or _Seen(clip.size_px, ())
    notes = own.notes + clip.notes
    for note in notes:
        logger.info("camera %s: %s", camera.name, note)
    return Observations(
        camera.name,
        camera.model,
        clip.size_px,
        own.sightings + clip.sightings,
        clip.is_still,
        missed=own.missed,
        picture=clip.picture,
        how=clip.how,
        spread_px=clip.spread_px,
        hand_look=clip.hand_look,
        notes=notes,
        sources={
            "intrinsics": camera.intrinsics.label if camera.intrinsics else None,
            "extrinsics": camera.extrinsics.label if camera.extrinsics else None,
            "corners": camera.corners.name if camera.corners else None,
        },
    )
