"""How a file says that a viewer should turn its picture: EXIF of stills, rotation of videos.

Nothing here turns a picture (see `hybridve.calib.image_io`); who knows of a tag can tell of it.
"""

import struct
from pathlib import Path

import cv2

from hybridve.calib.opencv_files import open_capture

#: EXIF's number of the orientation, and how many bytes of a file are looked at for it.
_ORIENTATION, _LOOKED_AT = 0x0112, 65_536 + 16

_JPEG, _PNG, _TIFF = b"\xff\xd8", b"\x89PNG\r\n\x1a\n", (b"II*\0", b"MM\0*")

#: What EXIF's numbers from 2 on say, for messages.
_WAYS = {
    2: "mirrored",
    3: "turned by 180 degrees",
    4: "upside down, mirrored",
    5: "mirrored, turned by 90 degrees",
    6: "turned by 90 degrees",
    7: "mirrored, turned by 270 degrees",
    8: "turned by 270 degrees",
}


def said_orientation(path: Path, *, is_video: bool) -> str:
    """Return how a file wants to be turned to be looked at; "" where it says nothing of the kind.

    Examples
    --------
    >>> said_orientation(Path("there is no such file"), is_video=False)
    ''
    """
    if not is_video:
        return _WAYS.get(exif_orientation(path), "")
    video = open_capture(path)
    turn_deg = round(video.get(cv2.CAP_PROP_ORIENTATION_META)) % 360 if video.isOpened() else 0
    video.release()
    return f"turned by {turn_deg} degrees" if turn_deg else ""


def exif_orientation(path: Path) -> int:
    """Return the orientation that a JPEG, PNG or TIFF says, 1 to 8; 1 where it says none."""
    try:
        with path.open("rb") as file:
            head = file.read(_LOOKED_AT)
            if head.startswith(_TIFF):  # its table may stand behind the picture
                order = "<" if head.startswith(b"II") else ">"
                file.seek(int.from_bytes(head[4:8], "little" if order == "<" else "big"))
                head = head[:4] + struct.pack(f"{order}I", 8) + file.read(_LOOKED_AT)
    except OSError:
        return 1
    block = b""
    if head.startswith(_JPEG):
        block = _of_jpeg(head)
    elif head.startswith(_PNG):
        at = head.find(b"eXIf")
        block = head[at + 4 :] if at > 0 else b""
    elif head.startswith(_TIFF):
        block = head
    try:
        found = _tag(block)
    except struct.error:
        return 1
    return found if 1 <= found <= 8 else 1


def _of_jpeg(head: bytes) -> bytes:
    """Return the EXIF block of a JPEG, from what stands before the picture; empty if none does."""
    at = 2
    while at + 4 <= len(head) and head[at] == 0xFF and head[at + 1] not in (0xDA, 0xD9):
        (length,) = struct.unpack_from(">H", head, at + 2)
        if head[at + 1] == 0xE1 and head[at + 4 : at + 10] == b"Exif\0\0":
            return head[at + 10 : at + 2 + length]
        at += 2 + length
    return b""


def _tag(block: bytes) -> int:
    """Return the orientation in a block laid out as TIFF is; 1 if it is not there."""
    if not block.startswith(_TIFF):
        return 1
    order = "<" if block.startswith(b"II") else ">"
    (at,) = struct.unpack_from(f"{order}I", block, 4)
    (count,) = struct.unpack_from(f"{order}H", block, at)
    for number in range(count):
        entry = at + 2 + 12 * number
        if struct.unpack_from(f"{order}H", block, entry)[0] == _ORIENTATION:
            return int(struct.unpack_from(f"{order}H", block, entry + 8)[0])
    return 1
