"""Which frames of an AVI file are damaged, told by the index at its end.

A hole in the file, from a bad sector or a lost packet, destroys some frames. Programs that read on
behind it count those that they find, and everything after is one frame early. The index says where
each frame begins: what does not stand there is lost.
"""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

#: The first bytes of a JPEG picture, and its last.
_JPEG_BEGIN, _JPEG_END = b"\xff\xd8", b"\xff\xd9"

#: Motion JPEG, as AVI files call it.
_MOTION_JPEG = (b"MJPG", b"mjpg")

#: Bytes at the end of a picture in which its end mark stands: the rest is filled up.
_TAIL = 64


@dataclass(frozen=True, slots=True)
class AviFrames:
    """The frames of an AVI file.

    Attributes
    ----------
    n_frames : int
        How many its index has.
    unreachable : frozenset of int
        Those whose beginning is destroyed: readers pass over them.
    damaged : frozenset of int
        Those that are found, with a hole in them.
    """

    n_frames: int
    unreachable: frozenset[int]
    damaged: frozenset[int]


def is_avi(path: Path) -> bool:
    """Tell whether a file is an AVI, whose frames have no time stamps of their own."""
    try:
        with path.open("rb") as file:
            head = file.read(12)
    except OSError:
        return False
    return head[:4] == b"RIFF" and head[8:] == b"AVI "


def avi_frames(path: Path) -> AviFrames | None:
    """Return what the index of an AVI file says of its frames; None if it has none, or is no AVI.

    Whether there is a hole in a frame that is found is told of motion JPEG only.
    """
    try:
        with path.open("rb") as file:
            head = file.read(4096)
            if head[:4] != b"RIFF" or head[8:12] != b"AVI ":
                return None
            file.seek(0, 2)
            size = file.tell()
            movi, entries = _index(file, size)
            if not entries:
                return None
            is_jpeg = any(code in head for code in _MOTION_JPEG)
            base = _base(file, movi, entries[0])
            unreachable, damaged = set(), set()
            for number, (name, offset, length) in enumerate(entries):
                file.seek(base + offset)
                if file.read(8) != name + struct.pack("<I", length):
                    unreachable.add(number)
                elif is_jpeg and length and not _is_whole(file, base + offset + 8, length):
                    damaged.add(number)
            if len(unreachable) == len(entries):  # another kind of index than we know
                return None
            return AviFrames(len(entries), frozenset(unreachable), frozenset(damaged))
    except (OSError, struct.error):
        return None


def _index(file: BinaryIO, size: int) -> tuple[int, list[tuple[bytes, int, int]]]:
    """Return where the frames' list begins, and name, offset and length of each video frame."""
    at, movi = 12, 0
    while at + 8 <= size:
        file.seek(at)
        name, length = struct.unpack("<4sI", file.read(8))
        if name == b"LIST" and file.read(4) == b"movi":
            movi = at + 8
        if name == b"idx1":
            table = file.read(length)
            entries = [
                (entry[0], entry[2], entry[3])
                for entry in struct.iter_unpack("<4sIII", table[: len(table) // 16 * 16])
            ]
            first = next((one[0] for one in entries if one[0][2:] in (b"dc", b"db")), b"")
            stream = [one for one in entries if one[0][:2] == first[:2]]
            if any(name != first or length <= 1 for name, _, length in stream):
                return movi, []  # frames that stand for the one before: readers leave them out
            return movi, stream
        at += 8 + length + length % 2
    return movi, []


def _base(file: BinaryIO, movi: int, first: tuple[bytes, int, int]) -> int:
    """Return what offsets are counted from: the list, as the format says, or the file."""
    name, offset, _ = first
    for base in (movi, 0):
        file.seek(base + offset)
        if file.read(4) == name:
            return base
    return movi


def _is_whole(file: BinaryIO, begin: int, length: int) -> bool:
    file.seek(begin)
    if file.read(2) != _JPEG_BEGIN:
        return False
    file.seek(begin + max(0, length - _TAIL))
    return _JPEG_END in file.read(min(_TAIL, length))
