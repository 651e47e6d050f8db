"""Boards in the clip that all cameras recorded at once: lying still, or moving."""

import hashlib
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import (
    Board,
    Detection,
    Effort,
    Observations,
    Sighting,
    is_seen,
)
from hybridve.calib.boards.suggest import what_is_seen
from hybridve.calib.boards.target import Chessboard, refine_corners
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import FrameSource
from hybridve.calib.seeing.corner_cache import Answer
from hybridve.calib.seeing.given import Given, take_given
from hybridve.calib.seeing.inputs import CLIP, CameraInput
from hybridve.calib.seeing.search import (
    Choice,
    Found,
    Key,
    Search,
    length_of,
    listed_boards,
    search_pictures,
)
from hybridve.calib.seeing.stills import notes_of, sightings_of, without_parts

logger = logging.getLogger(__name__)

#: Frames in which the stillness of an averaged clip is measured.
_SPREAD_FRAMES = 9


#: Frames whose means over 15x15 pixels differ by less show the same.
_STILL_GREY = 8.0


#: Averages in which another board is looked for where none is found.
_AVERAGES = 4


#: Bytes of grey frames of one clip held at once; larger images are averaged over fewer frames.
_CLIP_BYTES = 200_000_000


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
    faint : Observations or None
        Boards that the average shows, and most single frames do not.
    """

    moves: bool
    changes: bool
    tried: str = ""
    faint: Observations | None = None


class _Clip:
    """The frames of one camera's clip, read when they are first looked at."""

    def __init__(self, search: Search, camera: CameraInput, source: FrameSource, step: int) -> None:
        self.camera = camera
        self.source = source
        self.step = step
        self._cache = search.cache
        self.key: Key = ("clip", search.identify(source.paths, source.label), step)

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


def observe_clips(
    search: Search, cameras: Sequence[CameraInput], given: dict[str, Given]
) -> list[Observations]:
    """Return what each camera saw of the boards in the clip, as its average or frame by frame."""
    sources = [camera.extrinsics for camera in cameras if camera.extrinsics is not None]
    # One step for all cameras: frames with the same number were taken at the same time.
    lengths = [length_of(search, source) for source in sources]
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
    seen = [still for still in stills if isinstance(still, Observations)]
    if len(seen) == len(clips):
        return seen
    moves = any(isinstance(still, _Unseen) and still.moves for still in stills)
    looked_at: dict[str, Found] = {}
    if not moves:
        # No board is seen to move, and some cameras see none: perhaps frame by frame.
        for index, (clip, still) in enumerate(zip(clips, stills, strict=True)):
            if not isinstance(still, _Unseen):
                continue
            found = _search_clip(search, clip, given) if still.changes else Found()
            if not found.with_board and still.faint is not None:
                stills[index] = still.faint  # in the noise of each frame, and in no other place
                continue
            if not found.with_board:
                raise CalibrationError(
                    f"camera {clip.camera.name!r}: {listed_boards(search.boards)} found in "
                    f"{clip.source.label}"
                    + (
                        _seen_instead(
                            search, clip, [clip, *(one for one in clips if one is not clip)]
                        )
                        or f" (average of {clip.n_frames} frames; {still.tried}); check columns "
                        "and rows, or mark the corners by hand (`corners`)"
                    )
                )
            looked_at[clip.camera.name] = found
            stills[index] = _still_in_frames(search, clip, found) or still
        seen = [still for still in stills if isinstance(still, Observations)]
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


def _seen_instead(search: Search, clip: _Clip, averages: Sequence[_Clip] = ()) -> str:
    """Return what a clip shows in place of the boards, to follow what it does not; or nothing.

    Of still boards the average is looked at first, and that of other clips, which may see better.
    """

    def look() -> Answer:
        frames = clip.frames
        chosen = sorted({0, len(frames) // 2, len(frames) - 1})
        pictures: list[NDArray[Any]] = [one.picture for one in averages[:_AVERAGES]]
        pictures += [frames[index] for index in chosen]
        for board in search.boards:
            seen = what_is_seen(board, pictures)
            if seen is not None:
                which = f"for board {board.name!r}, " if len(search.boards) > 1 else ""
                return {"said": f": {which}{seen}"}, None
        return {"said": ""}, None

    keys = [part for one in (clip, *averages[:_AVERAGES]) for part in one.key]
    asked = [
        part for board in range(len(search.boards)) for part in search.question((), board, "quick")
    ]
    return str(search.cache.recall((*keys, *asked, "seen instead"), look)[0]["said"])


def _observe_still_clip(search: Search, clip: _Clip, given: Given) -> Observations | _Unseen:
    """Return the boards in the average of a clip, or that there are none or they move."""
    boards = search.boards
    by_hand = given.whole
    marked = _marked_still(given, search.settings.still_px)
    if marked is None:
        return _Unseen(True, True)
    average: Key = (*clip.key, "average")

    def detect(board: int, effort: Effort) -> Detection:
        return search.detect(average, board, effort, lambda: clip.picture)

    found = {board: detect(board, "quick") for board in range(len(boards))}
    missing = [board for board, detection in found.items() if detection.corners is None]
    moves, changes = _moves(search, clip, missing) if missing else (False, False)
    if moves:
        return _Unseen(True, True)
    found |= {board: detect(board, "thorough") for board in missing if board not in marked}
    found = without_parts(boards, found)
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
        notes += notes_of(boards, number, CLIP, detection)
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
    seen = Observations(
        clip.camera.name,
        clip.camera.model,
        clip.size_px,
        tuple(
            Sighting(CLIP, 0, number, pixels, found[number].beyond)
            for number, pixels in corners.items()
        ),
        True,
        picture=clip.picture,
        how="; ".join(f"{boards[number].name}: {how}" for number, how in hows.items())
        if len(boards) > 1
        else hows[0],
        spread_px=max(known_px) if known_px else None,
        hand_look=min(hand_looks)[2] if hand_looks else None,
        notes=tuple(notes),
    )
    return _Unseen(False, True, faint=seen) if np.inf in strays_px else seen


def _still_in_frames(search: Search, clip: _Clip, found: Found) -> Observations | None:
    """Return boards that lie where single frames show them; None if they move.

    Somebody may stand before a board for so long that the average does not show it.
    """
    by_board: dict[int, list[NDArray[np.float64]]] = {}
    beyond: dict[int, Counter[tuple[int, int]]] = {}
    notes: dict[str, None] = {}
    for (_, board), detection in sorted(found.detections.items(), key=lambda item: item[0]):
        if detection.corners is not None:
            by_board.setdefault(board, []).append(detection.corners)
            beyond.setdefault(board, Counter())[detection.beyond] += 1
            notes |= dict.fromkeys(notes_of(search.boards, board, CLIP, detection))
    middles = {}
    strays_px = []
    for board, listed in sorted(by_board.items()):
        seen = np.isfinite(stack := np.stack(listed)).any(axis=0)
        middles[board] = np.full(seen.shape, np.nan)
        middles[board][seen] = np.nanmedian(stack[:, seen], axis=0)
        strays_px += [_stray_px(corners, middles[board]) for corners in listed]
    if max(strays_px) > search.settings.still_px:
        return None
    return Observations(
        clip.camera.name,
        clip.camera.model,
        clip.size_px,
        tuple(
            Sighting(CLIP, 0, board, corners, max(beyond[board], key=beyond[board].__getitem__))
            for board, corners in middles.items()
        ),
        True,
        picture=clip.picture,
        how=f"detected in {len(found.with_board)} of {len(found.sizes)} frames, not in the average",
        spread_px=float(np.median(strays_px)),
        notes=tuple(notes),
    )


def _marked_still(given: Given, still_px: float) -> dict[int, NDArray[np.float64]] | None:
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


def _moves(search: Search, clip: _Clip, boards: Sequence[int]) -> tuple[bool, bool]:
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


def _spread(search: Search, clip: _Clip, number: int, corners: NDArray[np.float64]) -> float | None:
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


def _search_clip(search: Search, clip: _Clip, given: dict[str, Given]) -> Found:
    """Look for the boards frame by frame."""
    marked = given[clip.camera.name].clip
    more = frozenset(index for index, _ in marked)
    choice = Choice(1 if search.settings.every_clip_frame else clip.step, more)
    found = Found()
    search_pictures(
        search,
        clip.source,
        choice,
        lambda index: "usual" if index % clip.step == 0 else "quick",
        lambda index, board: (index, board) not in marked,
        found,
        f"board clip of {clip.camera.name}",
    )
    take_given(found, marked)
    return found


def _moving_clip(search: Search, clip: _Clip, found: Found) -> Observations:
    if not found.with_board:
        raise CalibrationError(
            f"camera {clip.camera.name!r}: {listed_boards(search.boards)} found in any of "
            f"{len(found.sizes)} frames of {clip.source.label}"
            + (_seen_instead(search, clip) or "; check columns and rows")
        )
    names = {index: f"{CLIP}, frame {index}" for index in sorted(found.sizes)}
    sightings, notes = sightings_of(search.boards, found, names, True)
    sizes = set(found.sizes.values())
    if len(sizes) > 1:
        raise CalibrationError(
            f"camera {clip.camera.name!r}: the pictures of {clip.source.label} differ in size"
        )
    how = f"detected in {len(found.with_board)} of {len(found.sizes)} frames"
    camera = clip.camera
    return Observations(
        camera.name, camera.model, sizes.pop(), sightings, False, how=how, notes=notes
    )
