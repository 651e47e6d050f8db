"""Frames belong to an instant, not to a position in a list: numbers, gaps, rates, damaged files."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.sessions import write_ball_session
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.avi_index import avi_frames
from hybridve.calib.errors import SessionError
from hybridve.calib.image_io import FrameSource, frame_numbers, in_step, open_source
from hybridve.hull.capture.recording import FrameRange, check_lengths, segmented_frames
from hybridve.hull.capture.session import load_session

#: Where the ball is, frame by frame: no two frames look alike.
CENTERS = np.column_stack([np.linspace(-0.2, 0.2, 8), np.zeros(8), np.zeros(8)])


def source_of(numbers: list[int], name: str = "cam/{:03d}.png") -> FrameSource:
    return FrameSource("cam", tuple(Path(name.format(one)) for one in numbers), is_video=False)


def masks_of(session: Path) -> list[list[NDArray[np.uint8]] | str]:
    return [
        frame.reason if frame.masks is None else frame.masks
        for frame in segmented_frames(load_session(session), FrameRange())
    ]


@pytest.mark.parametrize(
    "lost",
    [{"cam2/3"}, {"cam0/7", "cam1/2", "cam2/6", "cam3/0"}, {f"cam{one}/4" for one in range(4)}],
)
def test_a_picture_that_is_missing_is_a_row_and_shifts_none(tmp_path: Path, lost: set[str]) -> None:
    expected = masks_of(write_ball_session(tmp_path / "whole", CENTERS))
    session = write_ball_session(tmp_path / "gaps", CENTERS)
    for name in lost:
        (tmp_path / "gaps" / f"{name}.png").unlink()

    check_lengths(load_session(session), FrameRange())
    found = masks_of(session)

    assert len(found) == 8
    for frame, (one, two) in enumerate(zip(expected, found, strict=True)):
        lacking = [name for name in sorted(lost) if name.endswith(f"/{frame}")]
        if lacking:
            assert isinstance(two, str)
            assert all(repr(name[:4]) in two for name in lacking)
            assert f"no picture of frame {frame}" in two
        else:
            assert not isinstance(one, str)
            assert not isinstance(two, str)
            for first, second in zip(one, two, strict=True):
                np.testing.assert_array_equal(first, second)


def test_names_that_do_not_tell_are_refused(tmp_path: Path) -> None:
    session = write_ball_session(tmp_path, CENTERS)
    names = ("alpha", "beta", "gamma", "delta", "epsilon", "zeta", "eta")
    for number, name in enumerate(names):
        (tmp_path / "cam1" / f"{number}.png").rename(tmp_path / "cam1" / f"{name}.png")
    (tmp_path / "cam1" / "7.png").unlink()

    with pytest.raises(SessionError, match="names of its pictures do not tell which are missing"):
        check_lengths(load_session(session), FrameRange())


def test_counters_that_have_nothing_in_common_are_refused_unless_all_are_there() -> None:
    first, second = source_of([0, 1, 2, 3, 4, 5]), source_of([100, 101, 102, 103, 104, 105])

    assert in_step([first, second]) == [first, second]
    with pytest.raises(SessionError, match="cam 0 to 5, cam 100 to 105"):
        in_step([first, source_of([100, 101, 103, 104, 105])])


def test_numbers_in_steps_keep_their_steps() -> None:
    sources = in_step([source_of([10, 20, 30, 50]), source_of([10, 20, 40, 50])])

    assert [one.slots for one in sources] == [(0, 1, 2, -1, 3), (0, 1, -1, 2, 3)]


def test_numbers_that_count_something_else_make_no_frames_that_nobody_has() -> None:
    times = [1000, 1033, 1067, 1100, 1133]

    sources = in_step([source_of(times), source_of(times[:2] + times[3:])])

    assert [one.slots for one in sources] == [(0, 1, 2, 3, 4), (0, 1, -1, 2, 3)]


@given(
    numbers=st.lists(st.sets(st.integers(0, 30), min_size=20, max_size=31), min_size=1, max_size=4)
)
def test_a_frame_holds_pictures_of_one_number_and_every_picture_has_a_frame(
    numbers: list[set[int]],
) -> None:
    sources = in_step([source_of(sorted(one)) for one in numbers])

    frames = list(zip(*(source.pictures for source in sources), strict=True))
    for frame in frames:
        assert len({path.stem for path in frame if path is not None}) <= 1 or all(
            len(one) == len(numbers[0]) and max(one) - min(one) == len(one) - 1 for one in numbers
        )
    for source in sources:
        assert [path for path in source.pictures if path is not None] == list(source.paths)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["cam2_007.png", "cam2_008.png"], (7, 8)),
        (["1.png", "02.png", "10.png"], (1, 2, 10)),
        (["a1_b2.png", "a2_b3.png"], None),  # which of the two counts?
        (["one.png", "two.png"], None),
        (["7.png"], None),
        (["1.png", "01.png"], None),
    ],
)
def test_the_number_in_a_name_is_the_only_one_that_differs(
    names: list[str], expected: tuple[int, ...] | None
) -> None:
    assert frame_numbers([Path(name) for name in names]) == expected


def write_video(path: Path, count: int, fps: float = 25.0, code: str = "MJPG") -> Path:
    """Write a video whose frames tell their number by their grey."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), fps, (160, 120))
    noise = np.random.default_rng(3).integers(0, 60, (120, 160, 3))
    for number in range(count):
        writer.write((noise + 8 * number).astype(np.uint8))
    writer.release()
    return path


def greys(source: FrameSource) -> list[Any]:
    """Return the numbers that the frames tell, and for one that is no picture its error."""
    return [
        str(one) if isinstance(one, SessionError) else round((float(one.mean()) - 29.5) / 8)
        for one in source.frames_or_errors()
    ]


def punch(path: Path, frames: list[int], part: tuple[float, float]) -> None:
    """Write zeros over a part of each of some frames, as shares of its length; 8 bytes before."""
    data = bytearray(path.read_bytes())
    index = data.rfind(b"idx1")
    movi = data.find(b"movi")
    for number in frames:
        entry = index + 8 + 16 * number
        offset = int.from_bytes(data[entry + 8 : entry + 12], "little")
        length = int.from_bytes(data[entry + 12 : entry + 16], "little")
        at = movi + offset
        assert data[at : at + 4] == b"00dc"
        begin, end = at + 8 + int(part[0] * length), at + 8 + int(part[1] * length)
        begin = at if part[0] == 0 else begin
        data[begin:end] = bytes(end - begin)
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("frames", "part", "word"),
    [
        ([5], (0.0, 0.6), "lost or damaged"),  # its beginning is gone: readers pass over it
        ([5, 6, 11], (0.0, 1.0), "lost or damaged"),
        ([4], (0.7, 1.0), "is damaged"),  # found, with a hole at its end
        ([19], (0.0, 1.0), "lost or damaged"),  # the last
        ([0], (0.0, 0.5), "lost or damaged"),
    ],
)
def test_a_hole_in_a_video_costs_its_frames_and_shifts_none(
    tmp_path: Path, frames: list[int], part: tuple[float, float], word: str
) -> None:
    path = write_video(tmp_path / "video.avi", 20)
    punch(path, frames, part)
    source = open_source(tmp_path, "video.avi")

    found = greys(source)

    assert len(found) == 20 == source.count()
    for number, one in enumerate(found):
        if number in frames:
            assert f"frame {number} " in one
            assert word in one
        else:
            assert one == number
    some = list(source.frames_or_errors(3, 15, 4))
    assert [isinstance(one, SessionError) for one in some] == [
        number in frames for number in (3, 7, 11)
    ]
    assert [number for number, _ in source.numbered_frames()] == [
        number for number in range(20) if number not in frames
    ]


def test_a_whole_video_has_nothing_damaged(tmp_path: Path) -> None:
    for code, name in (("MJPG", "a.avi"), ("XVID", "b.avi"), ("mp4v", "c.mp4")):
        path = write_video(tmp_path / name, 12, code=code)
        source = open_source(tmp_path, name)
        index = avi_frames(path)

        assert index is None or (index.n_frames, index.unreachable, index.damaged) == (
            12,
            frozenset(),
            frozenset(),
        )
        assert source.count() == 12
        assert not any(isinstance(one, SessionError) for one in source.frames_or_errors())


def test_a_gap_in_the_time_stamps_keeps_later_frames_in_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a recorder leaves it that drops frames and says when each was taken."""
    write_video(tmp_path / "c.mp4", 10, code="mp4v")
    source = open_source(tmp_path, "c.mp4")

    class Dropped:
        """The reader, as if frames 3 to 5 had been dropped between the third and the next."""

        def __init__(self, path: str) -> None:
            self._video = REAL(path)

        def get(self, key: int) -> float:
            ms = float(self._video.get(key))
            return ms + 120.0 if key == cv2.CAP_PROP_POS_MSEC and ms > 81.0 else ms

        def __getattr__(self, name: str) -> Any:
            return getattr(self._video, name)

    REAL: Callable[[str], cv2.VideoCapture] = cv2.VideoCapture
    monkeypatch.setattr(cv2, "VideoCapture", Dropped)

    found = list(source.frames_or_errors())

    assert [isinstance(one, SessionError) for one in found] == (
        [False] * 3 + [True] * 3 + [False] * 7
    )


def video_session(folder: Path, rates: list[float], fps: str) -> Path:
    cameras = ""
    for number, rate in enumerate(rates):
        write_video(folder / f"v{number}.avi", 6, rate)
        write_video(folder / f"b{number}.avi", 2, rate)
        cameras += (
            f'[[camera]]\nname = "cam{number}"\nvideo = "v{number}.avi"\n'
            f'background = "b{number}.avi"\n'
        )
    path = folder / "session.toml"
    path.write_text(f'format = "hybridve-session"\nversion = 1\n{fps}\n{cameras}', encoding="utf-8")
    return path


def test_the_rate_is_that_of_the_files_unless_the_session_says_another(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for number, (fps, expected, said) in enumerate(
        [("", 25.0, ""), ("fps = 25", 25.0, ""), ("fps = 100", 100.0, "the videos 25")]
    ):
        folder = tmp_path / f"{number}"
        folder.mkdir()
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            session = load_session(video_session(folder, [25.0, 25.0], fps))
        assert session.fps == expected
        assert said in caplog.text
        assert bool(caplog.text) is bool(said)


def test_cameras_of_different_rates_are_refused_by_name(tmp_path: Path) -> None:
    path = video_session(tmp_path, [25.0, 50.0], "fps = 25")

    with pytest.raises(
        SessionError, match=r"'cam0' recorded 25 frames a second, camera 'cam1' 50.*ffmpeg"
    ):
        load_session(path)


def test_pictures_without_a_rate_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_ball_session(tmp_path, CENTERS, n_cameras=2)
    path.write_text(path.read_text(encoding="utf-8").replace("fps = 25\n", ""), encoding="utf-8")

    with caplog.at_level(logging.WARNING):
        assert load_session(path).fps == 30.0

    assert "fps: this key is missing" in caplog.text


# --- A clock that is late by a share of a frame ---------------------------------------------------


def late_ball_session(folder: Path, by_frames: float) -> Path:
    """Write the ball's session; cam1 took each picture so many frames late, and says so."""
    session = write_ball_session(folder, CENTERS)
    step = CENTERS[1] - CENTERS[0]
    write_ball_session(folder / "late", CENTERS + by_frames * step)
    for number in range(len(CENTERS)):
        (folder / "late" / "cam1" / f"{number}.png").replace(folder / "cam1" / f"{number}.png")
    text = session.read_text(encoding="utf-8")
    key = 'name = "cam1"\n'
    assert key in text
    late = f"{key}offset_s = {by_frames / load_session(session).fps}\n"
    session.write_text(text.replace(key, late), encoding="utf-8")
    return session


@pytest.mark.parametrize("by_frames", [0.4, 1.7, -0.25])
@pytest.mark.parametrize("step", [1, 3])
def test_a_clock_that_is_late_by_a_share_of_a_frame_sees_what_was_between(
    tmp_path: Path, by_frames: float, step: int
) -> None:
    """The ball moves by a fifth of its diameter a frame; what it covers is known at all times."""
    expected = masks_of(write_ball_session(tmp_path / "in step", CENTERS))
    session = load_session(late_ball_session(tmp_path / "late", by_frames))

    frames = list(segmented_frames(session, FrameRange(0, None, step)))

    assert session.cameras[1].shift_frames + session.cameras[1].lag == pytest.approx(by_frames)
    assert [frame.index for frame in frames][:3] == [0, step, 2 * step]
    n_read = 0
    for frame in frames:
        before = frame.index - by_frames
        if frame.masks is None:
            is_between = 0 <= np.floor(before) <= np.ceil(before) < len(CENTERS)
            assert not (is_between and frame.index < len(CENTERS))
            assert "has not begun" in frame.reason or "has stopped" in frame.reason
            continue
        n_read += 1
        truth = expected[frame.index]
        assert not isinstance(truth, str)
        wrong = (frame.masks[1] != truth[1]).sum()
        # The outline is a pixel wide, and no more than it is open to doubt.
        outline = cv2.morphologyEx(truth[1], cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)).sum()
        assert wrong <= outline / 4
        np.testing.assert_array_equal(frame.masks[0], truth[0])
    assert n_read >= 5 if step == 1 else n_read >= 2


def test_a_camera_that_moves_is_not_asked_between_its_pictures(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    session = late_ball_session(tmp_path, 1.4)
    (tmp_path / "poses.csv").write_text("frame,x,y,z,qw,qx,qy,qz\n", encoding="utf-8")
    text = session.read_text(encoding="utf-8")
    session.write_text(
        text.replace('name = "cam1"\n', 'name = "cam1"\nposes = "poses.csv"\n'), encoding="utf-8"
    )

    camera = load_session(session).cameras[1]

    assert (camera.shift_frames, camera.lag) == (1, 0.0)
    assert "camera 'cam1' moves, and its offset_s is 1.40 frames, not a whole" in caplog.text
