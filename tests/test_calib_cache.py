"""What is kept for the next start: the same to the bit, or as if there were no cache at all."""

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridve.calib import cache
from hybridve.calib.cache import cache_folder, cache_key, find_arrays, keep_arrays

NUMBERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1 / 3]])
COUNTS = np.array([[0, 2, 1], [0, 1, 3]], np.int32)
NAMES = ("numbers", "counts")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of this test's own."""
    monkeypatch.setenv("HYBRIDVE_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "things"


def keep(key: str) -> None:
    keep_arrays("things", key, numbers=NUMBERS, counts=COUNTS)


def is_kept(key: str) -> bool:
    return find_arrays("things", key, NAMES) is not None


def entries(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


@given(
    first=st.lists(st.one_of(st.text(), st.binary(), st.integers(), st.floats())),
    second=st.lists(st.one_of(st.text(), st.binary(), st.integers(), st.floats())),
)
def test_other_parts_have_another_key(
    first: list[str | bytes | float], second: list[str | bytes | float]
) -> None:
    same = list(map(repr, first)) == list(map(repr, second))

    assert (cache_key(*first) == cache_key(*second)) == same


def test_parts_cut_otherwise_have_another_key() -> None:
    parts: list[tuple[str | bytes | float, ...]] = [
        ("ab", "c"),
        ("a", "bc"),
        ("abc",),
        ("c", "ab"),
        (b"ab", b"c"),
        (1, 2),
        (1.0, 2),
        ("1", 2),
        (12,),
        (),
    ]

    assert len({cache_key(*each) for each in parts}) == len(parts)


def test_arrays_come_back_to_the_bit_in_the_order_asked_for(folder: Path) -> None:
    key = cache_key("a")
    keep(key)

    found = find_arrays("things", key, ("counts", "numbers"))

    assert entries(folder) == [f"{key}.npz"]
    assert found is not None
    for array, expected in zip(found, (COUNTS, NUMBERS), strict=True):
        assert (array.dtype, array.shape) == (expected.dtype, expected.shape)
        assert array.tobytes() == expected.tobytes()


def test_kinds_are_kept_apart(folder: Path) -> None:
    key = cache_key("a")
    keep(key)

    assert find_arrays("others", key, NAMES) is None
    assert find_arrays("things", key, ("numbers", "missing")) is None
    assert is_kept(key)


@given(st.data())
def test_a_damaged_entry_is_never_another_one_and_never_an_error(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HYBRIDVE_CACHE", str(tmp_path_factory.getbasetemp() / "damaged"))
        key = cache_key("a")
        keep(key)
        folder = cache_folder("things")
        assert folder is not None
        path = folder / f"{key}.npz"
        content = bytearray(path.read_bytes())
        for _ in range(data.draw(st.integers(1, 3))):
            content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
        length = data.draw(st.sampled_from([len(content), data.draw(st.integers(0, len(content)))]))
        path.write_bytes(content[:length])

        found = find_arrays("things", key, NAMES)

    # A byte that tells the time of writing may well change.
    if found is not None:
        np.testing.assert_array_equal(found[0], NUMBERS)
        np.testing.assert_array_equal(found[1], COUNTS)


@pytest.mark.parametrize("place", ["file/cache", "file", ""])
def test_where_nothing_can_be_kept_nothing_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    (tmp_path / "file").write_text("not a folder", encoding="utf-8")
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.setenv("HYBRIDVE_CACHE", str(tmp_path / place) if place else "off")

    keep(cache_key("a"))

    assert not is_kept(cache_key("a"))
    assert sorted(tmp_path.rglob("*")) == before


def test_a_full_disk_leaves_no_trace(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_space(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", no_space)

    keep(cache_key("a"))

    assert entries(folder) == []


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({"HYBRIDVE_CACHE": "/a"}, Path("/a/things")),
        ({"HYBRIDVE_CACHE": "/a", "XDG_CACHE_HOME": "/b"}, Path("/a/things")),
        ({"HYBRIDVE_CACHE": "off", "XDG_CACHE_HOME": "/b"}, None),
        ({"HYBRIDVE_CACHE": "", "XDG_CACHE_HOME": "/b"}, None),
        ({"XDG_CACHE_HOME": "/b", "HOME": "/c"}, Path("/b/hybridve/things")),
        ({"XDG_CACHE_HOME": "b", "HOME": "/c"}, Path("/c/.cache/hybridve/things")),
        ({"HOME": "/c"}, Path("/c/.cache/hybridve/things")),
    ],
)
def test_the_environment_says_where_things_are_kept(
    monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], expected: Path | None
) -> None:
    for name in ("HYBRIDVE_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)

    assert cache_folder("things") == expected


def test_what_was_not_used_for_longest_goes_first(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = [cache_key(number) for number in range(4)]
    for age, key in enumerate(keys[:3]):
        keep(key)
        os.utime(folder / f"{key}.npz", (1e9 + age, 1e9 + age))
    size_b = (folder / f"{keys[0]}.npz").stat().st_size
    (folder / "somebody_elses.npz").write_bytes(b"\0" * 10 * size_b)
    monkeypatch.setattr(cache, "LIMIT_B", 3 * size_b)

    assert is_kept(keys[0])  # the oldest, but now the last that was used
    keep(keys[3])

    assert [key for key in keys if is_kept(key)] == [keys[0], keys[2], keys[3]]
    assert "somebody_elses.npz" in entries(folder)


def test_what_an_interrupted_writer_left_goes_in_its_turn(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left, key = cache_key("left"), cache_key("new")
    folder.mkdir(parents=True)
    (folder / f"{left}.npz.a1b2c3").write_bytes(b"\0" * 5000)
    os.utime(folder / f"{left}.npz.a1b2c3", (1e9, 1e9))
    monkeypatch.setattr(cache, "LIMIT_B", 5000)

    keep(key)

    assert entries(folder) == [f"{key}.npz"]


def test_what_is_larger_than_the_limit_drives_nothing_out(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep(cache_key("small"))
    monkeypatch.setattr(cache, "LIMIT_B", 3000)

    keep_arrays("things", cache_key("large"), numbers=np.zeros((1000, 3)), counts=COUNTS)

    assert entries(folder) == [f"{cache_key('small')}.npz"]


def test_many_writers_of_one_entry_leave_it_whole(folder: Path) -> None:
    key = cache_key("a")

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: keep(key), range(64)))

    assert entries(folder) == [f"{key}.npz"]
    assert is_kept(key)
