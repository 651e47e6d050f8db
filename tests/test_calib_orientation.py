"""How files say that they want to be turned, as Pillow writes it."""

from pathlib import Path

import pytest
from PIL import Image

from hybridve.calib.opencv_files import picture_size
from hybridve.calib.orientation import exif_orientation, said_orientation

ORIENTATION = 0x0112


@pytest.mark.parametrize("ending", ["jpg", "png", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_tag_of_a_still_is_read(tmp_path: Path, ending: str, orientation: int) -> None:
    path = tmp_path / f"still.{ending}"
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    Image.new("RGB", (16, 12), (200, 90, 10)).save(path, exif=exif)

    assert exif_orientation(path) == orientation
    assert (said_orientation(path, is_video=False) == "") == (orientation == 1)


def test_the_tag_of_a_large_tiff_is_read_behind_its_picture(tmp_path: Path) -> None:
    path = tmp_path / "still.tif"
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    Image.new("RGB", (400, 300)).save(path, exif=exif)
    content = path.read_bytes()
    assert len(content) > 300_000
    at = int.from_bytes(content[4:8], "little")
    moved = content[:4] + len(content).to_bytes(4, "little") + content[8:] + content[at:]
    path.write_bytes(moved)

    assert exif_orientation(path) == 6


@pytest.mark.parametrize("ending", ["jpg", "png", "tif", "bmp"])
def test_a_still_without_a_tag_says_nothing(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"still.{ending}"
    Image.new("RGB", (16, 12)).save(path)

    assert said_orientation(path, is_video=False) == ""


@pytest.mark.parametrize(
    "content", [b"", b"\xff\xd8", b"\xff\xd8\xff\xe1\x00\x20Exif\0\0MM\0*", b"MM\0*\xff"]
)
def test_a_damaged_file_says_nothing(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "still.jpg"
    path.write_bytes(content)

    assert exif_orientation(path) == 1


@pytest.mark.parametrize("ending", ["jpg", "png"])
@pytest.mark.parametrize("is_progressive", [False, True])
def test_the_size_of_a_still_is_read_from_its_header(
    tmp_path: Path, ending: str, is_progressive: bool
) -> None:
    path = tmp_path / f"still.{ending}"
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    exif[0x010E] = "x" * 60_000  # a block as long as that of a telephone with its thumbnail
    Image.new("RGB", (321, 123)).save(path, exif=exif, progressive=is_progressive)

    assert picture_size(path) == (321, 123)


@pytest.mark.parametrize(
    "content", [b"", b"\xff\xd8", b"\xff\xd8\xff\xc0\x00", b"\x89PNG\r\n\x1a\n", b"BM"]
)
def test_a_damaged_file_says_no_size(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "still.jpg"
    path.write_bytes(content)

    assert picture_size(path) is None
