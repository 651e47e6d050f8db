"""Frames from videos and image globs, read one at a time.

A source is named as users name it: the path of a video, or a glob of images. Globs sort as people
count (2.png before 10.png). Memory does not grow with the length of a recording.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError

Image = NDArray[np.uint8]

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
    """

    label: str
    paths: tuple[Path, ...]
    is_video: bool

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
            yield read_image(path)

    def frames_or_errors(
        self, start: int = 0, stop: int | None = None, step: int = 1
    ) -> Iterator[Image | SessionError]:
        """Yield what `frames` does, with a `SessionError` in the place of a damaged image."""
        if self.is_video:
            yield from self._video_frames(start, stop, step)
            return
        for path in self.paths[start:stop:step]:
            try:
                yield read_image(path)
            except SessionError as error:
                yield error

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


def read_image(path: Path, flags: int = cv2.IMREAD_COLOR) -> Image:
    """Return an image, BGR (H, W, 3) unless `flags` ask for something else.

    Raises
    ------
    SessionError
        If the file is not an image.
    """
    image = cv2.imread(str(path), flags)
    if image is None:
        raise SessionError(f"{path}: not an image that can be read")
    return np.asarray(image, np.uint8)


def _open_video(path: Path, label: str) -> cv2.VideoCapture:
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise SessionError(f"{label}: {path} is not a video that can be read")
    # Frames are small and cameras are read side by side: one decoding thread each is quickest.
    return video
