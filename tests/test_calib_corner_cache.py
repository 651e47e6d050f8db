"""Answers about pictures kept beside a session: the same to the bit, or as if there were none."""

import hashlib
import os
import shutil
import time
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridve.calib.cache import cache_key
from hybridve.calib.seeing import corner_cache
from hybridve.calib.seeing.corner_cache import Answer, CornerCache

#: Facts, and points with everything that is hard to keep.
ANSWER: Answer = (
    {"how": "classic at 1x3", "notes": ["mirrored: seen from the back"], "px": 0.1, "far": np.inf},
    np.array([[0.1, -0.0], [np.nan, np.nan], [1e-320, 1.0 / 3.0]]),
)


def never() -> Answer:
    raise AssertionError("was asked again")


def is_answer(found: Answer | None) -> bool:
    if found is None:
        return False
    facts, points = found
    assert points is not None
    assert ANSWER[1] is not None
    return facts == ANSWER[0] and points.tobytes() == ANSWER[1].tobytes()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "rig" / "corners"


def test_an_answer_comes_back_to_the_bit(folder: Path) -> None:
    first = CornerCache(folder)
    assert first.recall(("which", 1), lambda: ANSWER) is ANSWER
    assert first.recall(("no points", 1), lambda: ({}, None)) == ({}, None)
    first.save()

    second = CornerCache(folder)

    assert is_answer(second.recall(("which", 1), never))
    assert second.recall(("no points", 1), never) == ({}, None)
    assert second.known(("which", 2)) is None
    assert second.known(("which", "1")) is None


def test_another_opencv_asks_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = CornerCache(folder)
    cache.keep(("which",), ANSWER)

    monkeypatch.setattr(cv2, "__version__", "99.0")

    assert cache.known(("which",)) is None


def test_an_error_is_not_an_answer(folder: Path) -> None:
    cache = CornerCache(folder)

    with pytest.raises(AssertionError):
        cache.recall(("which",), never)

    assert is_answer(cache.recall(("which",), lambda: ANSWER))


def test_without_a_folder_all_is_forgotten_with_the_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    cache = CornerCache(None)
    cache.keep(("which",), ANSWER)
    cache.recall_picture(("which",), lambda: np.zeros((2, 3)))
    cache.save()

    assert is_answer(cache.known(("which",)))
    assert CornerCache(None).known(("which",)) is None
    assert list(tmp_path.iterdir()) == []


def test_a_picture_comes_back_to_the_bit(folder: Path) -> None:
    picture = np.arange(12, dtype=np.uint16).reshape(3, 4)
    CornerCache(folder).recall_picture(("mean", 5), lambda: picture)

    found = CornerCache(folder).recall_picture(("mean", 5), lambda: np.zeros(0))

    assert (found.dtype, found.shape) == (picture.dtype, picture.shape)
    assert found.tobytes() == picture.tobytes()
    other = CornerCache(folder).recall_picture(("mean", 6), lambda: np.ones(1))
    assert other.shape == (1,)


def test_pictures_used_least_lately_go(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(corner_cache, "LIMIT_PICTURES", 2)
    cache = CornerCache(folder)

    def is_kept(number: int) -> bool:
        path = folder / f"{cache_key(cv2.__version__, number)}.zip"
        return path.exists()

    for number in range(2):
        cache.recall_picture((number,), lambda: np.zeros(1))
    for age, path in enumerate(sorted(folder.iterdir())):
        os.utime(path, (1e9 + age, 1e9 + age))
    cache.recall_picture((0,), lambda: np.zeros(1))  # whichever was older, this is used now
    cache.recall_picture((2,), lambda: np.zeros(1))

    assert [is_kept(number) for number in range(3)] == [True, False, True]


def test_answers_used_least_lately_go(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(corner_cache, "LIMIT", 2)
    cache = CornerCache(folder)
    for number in range(3):
        cache.keep((number,), ({"number": number}, None))
        cache.known((0,))
    cache.save()

    found = CornerCache(folder)

    assert [found.known((number,)) is not None for number in range(3)] == [True, False, True]


@given(st.data())
def test_a_damaged_cache_is_never_an_error_and_never_another_answer(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.getbasetemp() / "damaged_corners"
    shutil.rmtree(folder, ignore_errors=True)
    cache = CornerCache(folder)
    picture = np.arange(600, dtype=np.uint16).reshape(20, 30)
    cache.keep(("which",), ANSWER)
    cache.recall_picture(("mean",), lambda: picture)
    cache.save()
    for path in sorted(folder.iterdir()):
        content = bytearray(path.read_bytes())
        for _ in range(data.draw(st.integers(1, 3))):
            content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
        length = data.draw(st.sampled_from([len(content), data.draw(st.integers(0, len(content)))]))
        path.write_bytes(content[:length])

    again = CornerCache(folder)

    assert is_answer(again.recall(("which",), lambda: ANSWER))
    np.testing.assert_array_equal(again.recall_picture(("mean",), lambda: picture), picture)
    again.save()
    assert is_answer(CornerCache(folder).recall(("which",), lambda: ANSWER))


@pytest.mark.parametrize(
    "content",
    [
        '{"format": 2, "files": {}, "answers": []}',
        '{"format": 1, "files": {"a": 1}, "answers": []}',
        '{"format": 1, "files": {}, "answers": [1]}',
        '{"format": 1, "files": []}',
        "[]",
    ],
)
def test_a_file_that_means_something_else_is_as_good_as_none(folder: Path, content: str) -> None:
    cache = CornerCache(folder)
    cache.keep(("which",), ANSWER)
    cache.save()
    members = corner_cache._read_members(folder / "answers.zip", ("points.npy",))
    assert members is not None
    corner_cache._write_members(
        folder / "answers.zip", {"answers.json": content.encode(), "points.npy": members[0]}
    )

    assert CornerCache(folder).known(("which",)) is None


def test_where_nothing_can_be_written_all_works(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder", encoding="utf-8")
    cache = CornerCache(tmp_path / "file" / "corners")
    cache.keep(("which",), ANSWER)
    cache.save()

    assert is_answer(cache.known(("which",)))
    np.testing.assert_array_equal(cache.recall_picture(("a",), lambda: np.ones(2)), [1, 1])
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_full_disk_leaves_no_trace(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_space(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(zipfile.ZipFile, "writestr", no_space)
    cache = CornerCache(folder)
    cache.keep(("which",), ANSWER)
    cache.save()

    assert list(folder.iterdir()) == []


def test_many_threads_may_ask(folder: Path) -> None:
    cache = CornerCache(folder)

    def ask(number: int) -> Answer:
        return cache.recall((number % 7,), lambda: ({"number": number % 7}, None))

    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(ask, range(200)))

    assert [facts["number"] for facts, _ in answers] == [number % 7 for number in range(200)]


# --- Which files are the same -----------------------------------------------------------------


def write(path: Path, content: bytes, age_s: float = 60.0) -> Path:
    path.write_bytes(content)
    changed_ns = time.time_ns() - int(age_s * 1e9)
    os.utime(path, ns=(changed_ns, changed_ns))
    return path


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """Return how many files were read so far."""
    count = 0
    digest = hashlib.file_digest

    def counted(*arguments: Any) -> object:
        nonlocal count
        count += 1
        return digest(*arguments)

    monkeypatch.setattr(hashlib, "file_digest", counted)
    return lambda: count


def test_the_same_content_has_one_identity_wherever_it_lies(folder: Path, tmp_path: Path) -> None:
    cache = CornerCache(folder)
    one, same, other = (
        write(tmp_path / name, content)
        for name, content in (("a", b"123"), ("b", b"123"), ("c", b"124"))
    )

    assert cache.identify([one]) == cache.identify([same])
    assert cache.identify([one]) != cache.identify([other])
    assert cache.identify([one, other]) != cache.identify([other, one])
    assert cache.identify([one, same]) != cache.identify([one])
    with pytest.raises(FileNotFoundError):
        cache.identify([tmp_path / "missing"])


def test_a_file_that_did_not_change_is_not_read_again(
    folder: Path, tmp_path: Path, reads: Callable[[], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "a", b"123")
    now_ns = time.time_ns()
    monkeypatch.setattr(time, "time_ns", lambda: now_ns + 60_000_000_000)
    cache = CornerCache(folder)
    first = cache.identify([path])
    cache.save()
    assert reads() == 1

    assert CornerCache(folder).identify([path]) == first
    assert reads() == 1


def test_a_file_just_written_is_read_again_whatever_its_times_say(
    folder: Path, tmp_path: Path, reads: Callable[[], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "a", b"123", age_s=0.0)
    found = path.stat()
    monkeypatch.setattr(time, "time_ns", lambda: max(found.st_mtime_ns, found.st_ctime_ns) + 1)
    cache = CornerCache(folder)

    cache.identify([path])
    cache.identify([path])

    assert reads() == 2


def test_another_content_with_the_size_and_the_time_of_the_first_is_noticed(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "a", b"123")
    before = path.stat()
    now_ns = time.time_ns()
    monkeypatch.setattr(time, "time_ns", lambda: now_ns + 60_000_000_000)
    cache = CornerCache(folder)
    first = cache.identify([path])
    time.sleep(0.02)  # more than a tick of any file system's clock that counts finely

    path.write_bytes(b"321")
    os.utime(path, ns=(before.st_mtime_ns, before.st_mtime_ns))

    assert path.stat().st_mtime_ns == before.st_mtime_ns
    assert cache.identify([path]) != first
