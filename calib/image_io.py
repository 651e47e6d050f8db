"""Frames from videos and image globs, read one at a time.

A source is named as users name it: the path of a video, or a glob of images. Globs sort as people
count (2.png before 10.png). Memory does not grow with the length of a recording.

Pixels are the sensor's own: a tag in a file that says how to turn the picture for a viewer (EXIF of
stills, rotation of videos) turns nothing here, since a lens has no up. Pictures of 16 bits are
brought to 8 by the bits that hold something: sensors of 10, 12 and 14 bits leave the upper ones
empty.
"""

import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError

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
    """

    label: str
    paths: tuple[Path, ...]
    is_video: bool
    is_raw: bool = False
    bits: int = 16

    def claimed_length(self) -> int:
        """Return how many frames there should be; for a video what its header says.

        Headers are often a frame or two off: only reading tells.
        """
        if not self.is_video:
            return len(self.paths)
        video = _open_video(self.paths[0], self.label)
        length = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        video.release()
        return length

    def count(self) -> int:
        """Return how many frames can be read, by reading them."""
        if not self.is_video:
            return len(self.paths)
        video = _open_video(self.paths[0], self.label)
        length = 0
        while video.grab():
            length += 1
        video.release()
        return length

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[Image]:
        """Yield (H, W, 3) uint8 BGR frames `start`, `start + step`, ... before `stop`.

        Ends early, without an error, where the source ends; an image that cannot be read ends it
        with a `SessionError`.
        """
        if self.is_video:
            yield from self._video_frames(start, stop, step)
            return
        for path in self.paths[start:stop:step]:
            yield self.image(path)

    def frames_or_errors(
        self, start: int = 0, stop: int | None = None, step: int = 1
    ) -> Iterator[Image | SessionError]:
        """Yield what `frames` does, with a `SessionError` in the place of a damaged image."""
        if self.is_video:
            yield from self._video_frames(start, stop, step)
            return
        for path in self.paths[start:stop:step]:
            try:
                yield self.image(path)
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

    def _video_frames(self, start: int, stop: int | None, step: int) -> Iterator[Image]:
        video = _open_video(self.paths[0], self.label)
        try:
            index = 0
            # Reading on is the only seek that every container and codec gets right.
            while stop is None or index < stop:
                if index < start or (index - start) % step:
                    if not video.grab():
                        return
                else:
                    good, image = video.read()
                    if not good:
                        return
                    yield np.asarray(image, np.uint8)
                index += 1
        finally:
            video.release()

    def first(self) -> Image:
        """Return the first frame.

        Raises
        ------
        SessionError
            If there is none.
        """
        for image in self.frames(stop=1):
            return image
        raise SessionError(f"{self.label}: no frame can be read")


def open_source(root: Path, name: str) -> FrameSource:
    """Return the source that `name` stands for, relative to the folder `root`.

    Raises
    ------
    SessionError
        If there is no such file, or no file matches the glob. The text says nothing of where the
        name was written; the caller knows.
    """
    if any(mark in name for mark in "*?["):
        pattern = Path(name)
        base, relative = (
            (Path(pattern.anchor), pattern.relative_to(pattern.anchor))
            if (pattern.is_absolute())
            else (root, pattern)
        )
        found = [path for path in base.glob(str(relative)) if path.is_file()]
        if not found:
            raise SessionError(f"no file matches {name!r} in {root}")
        return FrameSource(
            name, tuple(sorted(found, key=lambda path: natural_order(str(path)))), False
        )
    path = root / name
    if not path.is_file():
        raise SessionError(f"there is no file {name!r} in {root}")
    is_video = path.suffix.lower() not in _IMAGE_SUFFIXES
    if is_video:
        _open_video(path, name).release()
    return FrameSource(name, (path,), is_video)


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
    image = cv2.imread(str(path), flags)
    if image is None:
        raise SessionError(f"{path}: not an image that can be read")
    return image


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
    video = cv2.VideoCapture(str(path))
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    if not video.isOpened():
        raise SessionError(f"{label}: {path} is not a video that can be read")
    # Frames are small and cameras are read side by side: one decoding thread each is quickest.
    return video
