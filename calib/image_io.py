"""Frames from videos and image globs, read one at a time.

A source is named as users name it: the path of a video, or a glob of images. Globs sort as people
count (2.png before 10.png). Memory does not grow with the length of a recording.

Pixels are the sensor's own: a tag in a file that says how to turn the picture for a viewer (EXIF of
stills, rotation of videos) turns nothing here, since a lens has no up. Pictures of 16 bits are
brought to 8 by the bits that hold something: sensors of 10, 12 and 14 bits leave the upper ones
empty.
"""

import difflib
import itertools
import logging
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.avi_index import AviFrames, avi_frames, is_avi
from hybridve.calib.errors import SessionError
from hybridve.calib.files import nearly
from hybridve.calib.opencv_files import decode_picture, open_capture

_log = logging.getLogger(__name__)

Image = NDArray[Any]  # uint8, or as it is stored

_IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"}


def natural_order(text: str) -> list[tuple[int, int, str]]:
    """Return a sort key under which numbers in `text` count as numbers.

    Examples
    --------
    >>> sorted(["10.png", "2.png", "1.png"], key=natural_order)
    ['1.png', '2.png', '10.png']
    """
    parts = re.split(r"(\d+)", text)
    return [(1, int(part), "") if part.isdigit() else (0, 0, part) for part in parts if part]


@dataclass(frozen=True, slots=True)
class FrameSource:
    """A video, or images in the order in which people count.

    Attributes
    ----------
    label : str
        What the user wrote, for messages.
    paths : tuple of Path
        One video, or one image a frame.
    is_video : bool
        Whether `paths` is one video.
    is_raw : bool
        Whether images are given as they are stored: (H, W) or (H, W, 3 or 4), 8 or 16 bits.
    bits : int
        How many bits of images of 16 hold something; see `significant_bits`.
    slots : tuple of int
        Of images that are numbered, which of `paths` each frame is, -1 where there is none; empty
        if each path is a frame. See `in_step`.
    """

    label: str
    paths: tuple[Path, ...]
    is_video: bool
    is_raw: bool = False
    bits: int = 16
    slots: tuple[int, ...] = ()

    @property
    def pictures(self) -> tuple[Path | None, ...]:
        """Of images, the file of each frame; None where there is none."""
        if not self.slots:
            return self.paths
        return tuple(None if slot < 0 else self.paths[slot] for slot in self.slots)

    def claimed_length(self) -> int:
        """Return how many frames there should be; for a video what its header says.

        Headers are often a frame or two off: only reading tells.
        """
        if not self.is_video:
            return len(self.pictures)
        video = _open_video(self.paths[0], self.label)
        length = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        video.release()
        return length

    def rate(self) -> float | None:
        """Return how many frames a second a video says it has; None if it does not say."""
        if not self.is_video:
            return None
        video = _open_video(self.paths[0], self.label)
        rate = float(video.get(cv2.CAP_PROP_FPS))
        video.release()
        return rate if _LEAST_RATE <= rate <= _MOST_RATE else None

    def count(self) -> int:
        """Return how many frames there are, by reading them; damaged ones among others count."""
        if not self.is_video:
            return len(self.pictures)
        return sum(1 for _ in self._video_frames(0, None, 1, decode=False))

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[Image]:
        """Yield (H, W, 3) uint8 BGR frames `start`, `start + step`, ... before `stop`.

        Ends early, without an error, where the source ends; frames that are missing or damaged are
        left out, but an image that cannot be read ends it with a `SessionError`.
        """
        for _, image in self.numbered_frames(start, stop, step):
            yield image

    def numbered_frames(
        self, start: int = 0, stop: int | None = None, step: int = 1
    ) -> Iterator[tuple[int, Image]]:
        """Yield what `frames` does, each with its number."""
        if self.is_video:
            for number, image in enumerate(self._video_frames(start, stop, step)):
                if not isinstance(image, SessionError):
                    yield start + number * step, image
            return
        pictures = self.pictures
        for number in range(*slice(start, stop, step).indices(len(pictures))):
            path = pictures[number]
            if path is not None:
                yield number, self.image(path)

    def frames_or_errors(
        self, start: int = 0, stop: int | None = None, step: int = 1
    ) -> Iterator[Image | SessionError]:
        """Yield all frames, with a `SessionError` in the place of a missing or damaged one."""
        if self.is_video:
            yield from self._video_frames(start, stop, step)
            return
        pictures = self.pictures
        for number in range(*slice(start, stop, step).indices(len(pictures))):
            path = pictures[number]
            try:
                yield (
                    SessionError(f"{self.label}: there is no picture of frame {number}")
                    if path is None
                    else self.image(path)
                )
            except SessionError as error:
                yield error

    def image(self, path: Path) -> Image:
        """Return one of its images, as `frames` gives it.

        Raises
        ------
        SessionError
            If it cannot be read.
        """
        return read_raw(path) if self.is_raw else read_image(path, self.bits)

    def _video_frames(
        self, start: int, stop: int | None, step: int, *, decode: bool = True
    ) -> Iterator[Image | SessionError]:
        """Yield the frames of a video, each in its place, whatever is lost before it.

        Reading on is the only seek that every container and codec gets right.
        """
        avi = avi_frames(self.paths[0])
        places = _Places(avi)
        video = _open_video(self.paths[0], self.label)
        # An AVI counts frames; where it holds one for two, as of some codecs, readers jump a stamp.
        rate = 0.0 if is_avi(self.paths[0]) else video.get(cv2.CAP_PROP_FPS)
        index = 0  # the next frame to be yielded
        try:
            while stop is None or index < stop:
                is_there = video.grab()
                at = places.next(video.get(cv2.CAP_PROP_POS_MSEC), rate) if is_there else None
                end = (avi.n_frames if avi else index) if at is None else at
                while index < end and (stop is None or index < stop):
                    if index >= start and (index - start) % step == 0:
                        yield SessionError(f"{self.label}: frame {index} is lost or damaged")
                    index += 1
                if at is None or (stop is not None and index >= stop):
                    return
                if index >= start and (index - start) % step == 0:
                    if avi is not None and index in avi.damaged:
                        yield SessionError(f"{self.label}: frame {index} is damaged")
                    elif not decode:
                        yield _NOTHING
                    else:
                        good, image = video.retrieve()
                        yield (
                            np.asarray(image, np.uint8)
                            if good
                            else SessionError(f"{self.label}: frame {index} cannot be decoded")
                        )
                index += 1
        finally:
            video.release()

    def first(self) -> Image:
        """Return the first frame that there is.

        Raises
        ------
        SessionError
            If there is none.
        """
        for image in self.frames():
            return image
        raise SessionError(f"{self.label}: no frame can be read")


class _Places:
    """Where the frames of a video belong that a reader gives one after another.

    The index of an AVI tells which it passes over. Time stamps tell of others: a step of more than
    one and a half frames is a gap. Stamps that go back, or are not given, tell nothing.
    """

    def __init__(self, avi: AviFrames | None) -> None:
        unreachable = frozenset() if avi is None else avi.unreachable
        self._unreachable = unreachable
        self._place = -1
        self._ms: float | None = None

    def next(self, ms: float, rate: float) -> int:
        """Return the number of the frame that was read, by its time stamp in milliseconds."""
        gap = 1
        if self._ms is not None and ms > self._ms and _LEAST_RATE <= rate <= _MOST_RATE:
            gap = max(1, round((ms - self._ms) * rate / 1e3))
        if self._ms is None or ms > self._ms:
            self._ms = ms
        for _ in range(gap):
            self._place += 1
            while self._place in self._unreachable:
                self._place += 1
        return self._place


#: What stands for a frame that nobody looks at.
_NOTHING = np.zeros((0, 0, 3), np.uint8)

#: Frames a second that a header may say; others are no rates.
_LEAST_RATE, _MOST_RATE = 1.0, 1000.0


def frame_numbers(paths: Sequence[Path]) -> tuple[int, ...] | None:
    """Return the numbers in the names of images, if the names differ in one number only.

    Examples
    --------
    >>> frame_numbers([Path("cam2_007.png"), Path("cam2_009.png")])
    (7, 9)
    >>> frame_numbers([Path("a.png"), Path("b.png")]) is None
    True
    """
    parts = [re.split(r"(\d+)", path.stem) for path in paths]
    if len(paths) < 2 or len({len(part) for part in parts}) != 1:
        return None
    differing = [
        column
        for column in range(len(parts[0]))
        if len({int(part[column]) if column % 2 else part[column] for part in parts}) > 1
    ]
    if len(differing) != 1 or differing[0] % 2 == 0:
        return None
    numbers = tuple(int(part[differing[0]]) for part in parts)
    return numbers if len(set(numbers)) == len(numbers) else None


def in_step(sources: Sequence[FrameSource]) -> list[FrameSource]:
    """Return image sources with the images of one instant in one frame, by the numbers in names.

    A picture that one camera lacks is a frame without a picture, and shifts none of the others.
    Where all sources have as many images, without gaps, or the names do not tell, each path is a
    frame.

    Raises
    ------
    SessionError
        If some images are missing, and numbers do not tell which.
    """
    known = [
        one
        for source in sources
        if not source.is_video and (one := frame_numbers(source.paths)) is not None
    ]
    is_even = all(map(_is_even, known)) and len({len(one) for one in known}) <= 1
    if len(known) < len(sources) or is_even:
        return list(sources)
    if not all(_is_one_counter(number, known) for number in range(len(known))):
        ranges = ", ".join(
            f"{source.label} {min(one)} to {max(one)}"
            for source, one in zip(sources, known, strict=True)
        )
        raise SessionError(
            f"pictures are missing, and the numbers in their names do not tell which belong "
            f"together ({ranges}); number the pictures of one instant alike in all cameras"
        )
    every = sorted(set.union(*map(set, known)))
    stride = math.gcd(*(after - before for before, after in itertools.pairwise(every)))
    frames: Sequence[int] = range(every[0], every[-1] + 1, stride)
    if len(frames) > _MOST_GAPS * len(every):  # these are no numbers of frames
        frames = every
    found = []
    for source, one in zip(sources, known, strict=True):
        place = {number: slot for slot, number in enumerate(one)}
        found.append(replace(source, slots=tuple(place.get(at, -1) for at in frames)))
    return found


#: Frames that are kept free for pictures that nobody has, for each that somebody has.
_MOST_GAPS = 4


#: The share of a camera's pictures whose numbers others have, too, if they are counted alike.
_LEAST_SHARED = 0.25


def _is_one_counter(number: int, every: Sequence[Sequence[int]]) -> bool:
    """Tell whether one camera's pictures are numbered as those of others, if there are others."""
    others = {at for other, one in enumerate(every) if other != number for at in one}
    shared = len(others.intersection(every[number]))
    return len(every) == 1 or shared >= _LEAST_SHARED * len(every[number])


def _is_even(numbers: Sequence[int]) -> bool:
    """Tell whether numbers go up in equal steps."""
    return len({after - before for before, after in itertools.pairwise(sorted(numbers))}) <= 1


def open_source(root: Path, name: str) -> FrameSource:
    r"""Return the source that `name` stands for, relative to the folder `root`.

    A file of that very name comes before a pattern; a pattern that no file matches is tried with
    capitals, too; and where ``\`` is in no file's name it is ``/``. What macOS leaves beside files
    on foreign disks (``._1.png``) is no picture.

    Raises
    ------
    SessionError
        If there is no such file, or no file matches the glob. The text says nothing of where the
        name was written; the caller knows.
    """
    path = root / name
    if not path.is_file() and "\\" in name:
        return replace(open_source(root, name.replace("\\", "/")), label=name)
    if not path.is_file() and any(mark in name for mark in "*?["):
        found = _matching(root, name)
        return FrameSource(
            name, tuple(sorted(found, key=lambda path: natural_order(str(path)))), is_video=False
        )
    if not path.is_file():
        raise SessionError(f"there is no file {name!r} in {root}{nearly(path)}")
    is_video = path.suffix.lower() not in _IMAGE_SUFFIXES
    if is_video:
        _open_video(path, name).release()
    return FrameSource(name, (path,), is_video)


def _matching(root: Path, name: str) -> list[Path]:
    """Return the files that match a pattern.

    Raises
    ------
    SessionError
        If there is none.
    """
    pattern = Path(name)
    base, relative = root, pattern
    if pattern.is_absolute():
        base, relative = Path(pattern.anchor), pattern.relative_to(pattern.anchor)
    # ``[Jj][Pp][Gg]`` in place of ``jpg``: `glob` cannot be told to take capitals for equal.
    either = re.sub(
        r"\[[^]]*\]|[^\W\d_]",
        lambda one: one[0] if len(one[0]) > 1 else f"[{one[0].lower()}{one[0].upper()}]",
        relative.name,
    )
    found: list[Path] = []
    for last in (relative.name, either):
        for path in base.glob(str(relative.with_name(last))):
            if path.is_file() and not path.name.startswith("._"):
                found.append(path)
        if found:
            if last == either:
                _log.info("%s: no file matches but for capitals; %d do", name, len(found))
            return found
    raise SessionError(f"no file matches {name!r} in {root}{_instead(base, relative.parent)}")


def _instead(base: Path, pattern: Path) -> str:
    """Return, for a message, what is there where no file matches: in a folder, or in its place."""
    if any(mark in str(pattern) for mark in "*?["):
        return "; look at the pattern"
    folder = base
    for part in pattern.parts:
        if not (folder / part).is_dir():
            names = [one.name for one in folder.iterdir() if one.is_dir()]
            close = difflib.get_close_matches(part, names, n=1, cutoff=0.6)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            return f"; there is no folder {folder / part}{hint}"
        folder /= part
    names = sorted((one.name for one in folder.iterdir() if one.is_file()), key=natural_order)
    if not names:
        return "; there is no file in that folder"
    count = "1 file" if len(names) == 1 else f"{len(names)} files"
    return f"; there is {count} in that folder, as {names[0]!r}"


def read_image(path: Path, bits: int = 16) -> NDArray[np.uint8]:
    """Return an image, (H, W, 3) uint8 BGR.

    Of an image of 16 bits the eight below and with bit number `bits` are taken.

    Raises
    ------
    SessionError
        If the file is not an image, or has larger values than `bits` hold.
    """
    if bits == 16:
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        return np.asarray(_decoded(path, flags), np.uint8)
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    image = _decoded(path, flags)
    if image.dtype != np.uint16:
        return np.asarray(image, np.uint8)
    if (most := int(image.max())) >= 1 << bits:
        raise SessionError(
            f"{path}: has the value {most}, the pictures looked at first none above "
            f"{(1 << bits) - 1}, which is {bits} bits; give pictures of one depth"
        )
    return (image >> (bits - 8)).astype(np.uint8)


def read_raw(path: Path) -> Image:
    """Return an image as it is stored, (H, W) or (H, W, 3 or 4), 8 or 16 bits, BGR and alpha.

    Raises
    ------
    SessionError
        If the file is not an image, or one of other numbers.
    """
    image = _decoded(path, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if image.dtype not in (np.uint8, np.uint16):
        raise SessionError(f"{path}: holds {image.dtype} values, expected 8 or 16 bits")
    return image


def _decoded(path: Path, flags: int) -> Image:
    return decode_picture(path, flags)


#: Depths of sensors that write files of 16 bits.
_DEPTHS = (10, 12, 14, 16)

#: Endings of files that may hold 16 bits.
_DEEP_SUFFIXES = {".png", ".tif", ".tiff", ".pgm", ".ppm"}


def significant_bits(sources: Iterable[FrameSource]) -> int:
    """Return how many bits of the images of some sources hold something: 10, 12, 14 or 16.

    The first, the middle and the last image of each are looked at; 16 where none has 16 bits. A
    dark picture of more bits than it fills is as well told by fewer, as long as all pictures of a
    camera are read alike.
    """
    most = 0
    for source in sources:
        if source.is_video or source.paths[0].suffix.lower() not in _DEEP_SUFFIXES:
            continue
        for path in {source.paths[0], source.paths[len(source.paths) // 2], source.paths[-1]}:
            if _is_shallow_png(path):
                continue
            with suppress(SessionError):  # said when its turn comes
                image = read_raw(path)
                if image.dtype == np.uint16:
                    most = max(most, int(image.max()))
    return 16 if most == 0 else next(bits for bits in _DEPTHS if most < 1 << bits)


def _is_shallow_png(path: Path) -> bool:
    """Tell whether a file is a PNG of 8 bits or fewer, from its first bytes."""
    try:
        with path.open("rb") as file:
            head = file.read(25)
    except OSError:
        return False
    return head[:8] == b"\x89PNG\r\n\x1a\n" and head[24] <= 8


def _open_video(path: Path, label: str) -> cv2.VideoCapture:
    video = open_capture(path)
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    if not video.isOpened():
        raise SessionError(f"{label}: {path} is not a video that can be read")
    # Frames are small and cameras are read side by side: one decoding thread each is quickest.
    return video
