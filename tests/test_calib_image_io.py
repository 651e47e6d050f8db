"""Frames from videos and globs."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridve.calib.errors import SessionError
from hybridve.calib.image_io import natural_order, open_source, read_image

#: What a lossy codec may change of an even grey.
CODEC_GREY = 4


@pytest.fixture
def images(tmp_path: Path) -> Path:
    for number in (10, 2, 1, 3):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((8, 12, 3), number, np.uint8))
    return tmp_path


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    for number in range(12):
        writer.write(np.full((48, 64, 3), 20 * number, np.uint8))
    writer.release()
    return path


@given(numbers=st.lists(st.integers(0, 10**6)))
def test_numbers_in_names_count_as_numbers(numbers: list[int]) -> None:
    names = [f"cam{number}/image.png" for number in numbers]

    assert sorted(names, key=natural_order) == [
        f"cam{number}/image.png" for number in sorted(numbers)
    ]


def test_names_of_letters_and_names_of_digits_can_be_compared() -> None:
    assert sorted(["b", "1", "a2", "a10", ""], key=natural_order) == ["", "a2", "a10", "b", "1"]


def test_a_glob_sorts_as_people_count(images: Path) -> None:
    source = open_source(images, "*.png")

    assert [int(image[0, 0, 0]) for image in source.frames()] == [1, 2, 3, 10]
    assert source.count() == source.claimed_length() == 4
    assert not source.is_video


@pytest.mark.parametrize(
    ("start", "stop", "step", "expected"),
    [(0, None, 1, list(range(12))), (3, 9, 2, [3, 5, 7]), (10, 99, 1, [10, 11]), (12, None, 1, [])],
)
def test_a_video_gives_the_frames_asked_for(
    video: Path, start: int, stop: int | None, step: int, expected: list[int]
) -> None:
    source = open_source(video.parent, video.name)

    greys = [float(image.mean()) for image in source.frames(start, stop, step)]

    np.testing.assert_allclose(greys, [20 * number for number in expected], atol=CODEC_GREY)
    assert source.is_video
    assert source.count() == 12


def test_an_absolute_glob_is_taken(images: Path) -> None:
    assert open_source(Path("/nowhere"), f"{images}/*.png").count() == 4


@pytest.mark.parametrize("name", ["missing.avi", "*.jpg"])
def test_a_source_that_is_not_there_is_named(images: Path, name: str) -> None:
    with pytest.raises(SessionError, match=name.replace("*", r"\*")):
        open_source(images, name)


def test_a_file_that_is_no_video_is_named(tmp_path: Path) -> None:
    (tmp_path / "clip.avi").write_text("no video")

    with pytest.raises(SessionError, match="not a video that can be read"):
        open_source(tmp_path, "clip.avi")


def test_an_image_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "1.png").write_text("no image")

    with pytest.raises(SessionError, match=r"1\.png: not an image"):
        list(open_source(tmp_path, "*.png").frames())
    with pytest.raises(SessionError, match="not an image"):
        read_image(tmp_path / "1.png")
