"""Files handed to OpenCV, which crashes on some names, and on some contents.

OpenCV's Python binding takes names that are UTF-8 only: a folder from a disk of another encoding
ends the program without a word. Its reader of structured files calls itself for each level of
nesting, and its pictures are decoded whatever size they say they have. So contents are looked at
first, and names are made plain.
"""

import io
import os
import struct
import tempfile
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.bounded import read_bounded
from hybridve.calib.errors import SessionError

_JPEG, _PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"

#: The marks in a JPEG behind which its size stands: of all its ways to code, but no tables.
_FRAMES_OF_JPEG = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}

#: Pixels of a picture at most: 16,384 x 16,384, a gigabyte in colours of 8 bits.
MOST_PX = 1 << 28


def open_capture(path: Path) -> cv2.VideoCapture:
    """Return a video opened by OpenCV, whatever its folders are called; see whether it is open."""
    if _is_plain(path):
        return cv2.VideoCapture(str(path))
    # What is open stays open when the name by which it was opened goes.
    with tempfile.TemporaryDirectory(prefix="hybridve-") as folder:
        link = Path(folder) / f"video{path.suffix if path.suffix.isascii() else ''}"
        link.symlink_to(path.absolute())
        return cv2.VideoCapture(str(link))


def decode_picture(path: Path, flags: int) -> NDArray[np.generic]:
    """Return a picture as OpenCV reads it.

    Raises
    ------
    SessionError
        If it is no picture that can be read, or says that it has more than `MOST_PX` pixels.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise SessionError(f"{path}: cannot be read: {error.strerror}") from error
    size = _size_of(content)
    if size is not None and size[0] * size[1] > MOST_PX:
        raise SessionError(
            f"{path}: says that it has {size[0]} x {size[1]} pixels; pictures of at most "
            f"{MOST_PX >> 20} million are read"
        )
    image = None
    if content:
        try:
            image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
        except (cv2.error, MemoryError):
            image = None
    if image is None:
        raise SessionError(f"{path}: not an image that can be read")
    return image


def picture_size(path: Path) -> tuple[int, int] | None:
    """Return the width and height that the header of a JPEG or PNG says; None of other files.

    Examples
    --------
    >>> picture_size(Path("there is no such file")) is None
    True
    """
    try:
        with path.open("rb") as file:
            return _size_in(file)
    except OSError:
        return None


def _size_of(content: bytes) -> tuple[int, int] | None:
    """Return what `picture_size` does, of what a file holds."""
    return _size_in(io.BytesIO(content))


def _size_in(file: BinaryIO) -> tuple[int, int] | None:
    try:
        head = file.read(24)
        if head.startswith(_PNG) and len(head) == 24:
            width_px, height_px = struct.unpack_from(">II", head, 16)
            return width_px, height_px
        if not head.startswith(_JPEG):
            return None
        file.seek(2)
        while len(mark := file.read(4)) == 4 and mark[0] == 0xFF:
            if mark[1] in _FRAMES_OF_JPEG:
                height_px, width_px = struct.unpack_from(">HH", file.read(5), 1)
                return width_px, height_px
            file.seek(max(0, int.from_bytes(mark[2:]) - 2), 1)
    except struct.error:
        return None
    return None


def structured_text(path: Path) -> str:
    """Return the text of a file that OpenCV is to read as XML, YAML or JSON.

    Raises
    ------
    ValueError
        If it is nested too deeply, or too large; the text says which.
    OSError
        If it cannot be read.
    """
    return read_bounded(path).decode("utf-8", errors="replace")


def _is_plain(path: Path) -> bool:
    """Tell whether OpenCV finds a file by the name that Python has for it."""
    try:
        return str(path).encode() == os.fsencode(path)
    except UnicodeEncodeError:
        return False
