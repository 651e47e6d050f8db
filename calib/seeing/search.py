"""Boards looked for in pictures, many at once; what was found before is recalled."""

import dataclasses
import hashlib
import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Detection, Effort
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import FrameSource
from hybridve.calib.seeing.corner_cache import Answer, CornerCache
from hybridve.calib.seeing.inputs import ObserveSettings, Progress

#: What pictures are a question about, beside the question itself.
Key = tuple[str | float, ...]


class Search:
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
        self.threads = settings.threads or _usable_cpus()
        self.pool = ThreadPoolExecutor(self.threads)
        self._descriptions = [describe_board(board) for board in boards]

    def __enter__(self) -> "Search":
        return self

    def __exit__(self, *_: object) -> None:
        # Keeps what was found before an error or an interruption.
        self.pool.shutdown(cancel_futures=True)
        self.cache.save()

    def question(self, picture: Key, board: int, effort: Effort) -> Key:
        """Return the question whether a picture shows a board."""
        return (*picture, self._descriptions[board], effort)

    def detect(
        self, picture: Key, board: int, effort: Effort, image: Callable[[], NDArray[Any]]
    ) -> Detection:
        """Return whether a picture shows a board, looking at it only if that is not known."""

        def look() -> Answer:
            return _told(self.boards[board].detect(image(), effort))

        return _detection(self.cache.recall(self.question(picture, board, effort), look))

    def identify(self, paths: Iterable[Path], label: str) -> str:
        """Return what tells these files from all others, or say which cannot be read."""
        try:
            return self.cache.identify(paths)
        except OSError as error:
            raise CalibrationError(f"{label}: cannot be read: {error.strerror}") from error


def _told(detection: Detection) -> Answer:
    told = {
        "how": detection.how,
        "notes": list(detection.notes),
        "beyond": list(detection.beyond),
    }
    return told, detection.corners


def _detection(answer: Answer) -> Detection:
    told, corners = answer
    columns, rows = told["beyond"]
    return Detection(corners, told["how"], tuple(told["notes"]), (columns, rows))


def describe_board(board: Board) -> str:
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
    own = {base.__module__ for base in type(board).__mro__}
    files = {getattr(sys.modules.get(module), "__file__", None) for module in own}
    code = _digest_of_code(frozenset(Path(file) for file in files if file))
    return f"{type(board).__qualname__} {said} {code}"


@cache
def _digest_of_code(files: frozenset[Path]) -> str:
    """Return a digest of a board's sources and of all that reads pictures and looks for boards.

    What another version finds may differ.
    """
    here = Path(__file__).parent
    rooms = (here, here.parent / "boards")
    ours = [here.parent / "image_io.py", *(path for room in rooms for path in room.glob("*.py"))]
    digest = hashlib.sha256()
    for path in sorted(files.union(ours)):
        with suppress(OSError):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def listed_boards(boards: Sequence[Board]) -> str:
    """Return that none of the boards is there, to be followed by where."""
    if len(boards) == 1:
        return f"no board of {boards[0]}"
    return "none of the boards (" + "; ".join(map(str, boards)) + ")"


@dataclass(frozen=True, slots=True)
class Choice:
    """Every `step`-th picture of a source, and some more by index."""

    step: int
    more: frozenset[int] = frozenset()

    def takes(self, index: int) -> bool:
        """Tell whether a picture is looked at."""
        return index % self.step == 0 or index in self.more

    def of(self, count: int) -> list[int]:
        """Return which of so many pictures are looked at."""
        return [index for index in range(count) if self.takes(index)]

    def read_video(self, source: FrameSource) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield the pictures that are looked at, each with its number."""
        step = 1 if self.more else self.step  # frames that are skipped are not decoded
        for index, image in source.numbered_frames(step=step):
            if self.takes(index):
                yield index, image


@dataclass(frozen=True, slots=True, eq=False)
class Found:
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


def search_pictures(
    search: Search,
    source: FrameSource,
    choice: Choice,
    effort_of: Callable[[int], Effort],
    is_wanted: Callable[[int, int], bool],
    found: Found,
    what: str,
) -> None:
    """Look for the boards in pictures of a source, and add to what was found.

    What is known is not looked at, and a picture of which all is known is not decoded.

    Parameters
    ----------
    search, source
        What to look for, and where.
    choice : Choice
        Which pictures.
    effort_of : callable
        With how much effort, by picture.
    is_wanted : callable
        Whether a picture is searched for a board.
    found : Found
        What was found before; changed.
    what : str
        What is being done, for the progress.
    """
    waiting: deque[tuple[int, int, Key, Future[Detection]]] = deque()

    def collect(down_to: int) -> None:
        while len(waiting) > down_to:
            index, board, question, future = waiting.popleft()
            detection = future.result()
            found.detections[index, board] = detection
            search.cache.keep(question, _told(detection))

    def recall(index: int, picture: Key) -> list[int] | None:
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

    def look(index: int, picture: Key, image: NDArray[np.uint8]) -> None:
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
        total = len(choice.of(length_of(search, source)))
        content = search.identify(source.paths, source.label)
        # Only reading tells how many frames a video has.
        walk: Key = ("frames", content, choice.step, *sorted(choice.more))
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
        pictures = source.pictures
        indices = choice.of(len(pictures))
        total = len(indices)
        for number, index in enumerate(indices, start=1):
            path = pictures[index]
            if path is None:  # a view fewer
                continue
            picture: Key = ("picture", search.identify([path], source.label), 0)
            if recall(index, picture) != []:
                look(index, picture, source.image(path))
            search.report(what, number, total)
        collect(0)
    search.report(what, total, total)  # a video may end before its header says


def length_of(search: Search, source: FrameSource) -> int:
    """Return how many frames there are, about; some videos do not say."""

    def count() -> Answer:
        claimed = source.claimed_length()
        return {"length": claimed if claimed > 0 else max(1, source.count())}, None

    if not source.is_video:
        return len(source.pictures)
    question = ("length", search.identify(source.paths, source.label))
    length: int = search.cache.recall(question, count)[0]["length"]
    return length


def _usable_cpus() -> int:
    """Return how many processors this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
