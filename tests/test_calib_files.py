"""Files appear whole or not at all."""

from pathlib import Path

import pytest

from hybridve.calib.files import appearing


@pytest.mark.parametrize("is_contended", [False, True])
def test_a_file_appears_when_it_is_complete(tmp_path: Path, *, is_contended: bool) -> None:
    path = tmp_path / "rig.json"
    path.write_text("before", encoding="utf-8")

    with appearing(path, is_contended=is_contended) as partial:
        partial.write_text("after", encoding="utf-8")
        assert path.read_text(encoding="utf-8") == "before"

    assert path.read_text(encoding="utf-8") == "after"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("is_contended", [False, True])
@pytest.mark.parametrize("error", [OSError("the disk is full"), KeyboardInterrupt()])
def test_what_goes_wrong_leaves_what_was_there(
    tmp_path: Path, error: BaseException, *, is_contended: bool
) -> None:
    path = tmp_path / "rig.json"
    path.write_text("before", encoding="utf-8")

    def write() -> None:
        with appearing(path, is_contended=is_contended) as partial:
            partial.write_text("half", encoding="utf-8")
            raise error

    with pytest.raises(type(error)):
        write()

    assert path.read_text(encoding="utf-8") == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_is_not_written_is_told(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), appearing(tmp_path / "rig.json"):
        pass

    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_writer_left_is_written_over(tmp_path: Path) -> None:
    left = tmp_path / "rig.json.partial"
    left.write_text("half of another", encoding="utf-8")

    with appearing(tmp_path / "rig.json") as partial:
        assert partial == left
        partial.write_text("whole", encoding="utf-8")

    assert (tmp_path / "rig.json").read_text(encoding="utf-8") == "whole"
    assert not left.exists()


def test_each_of_several_writers_has_a_name_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "entry"

    with appearing(path, is_contended=True) as first:
        first.write_text("first", encoding="utf-8")
        with appearing(path, is_contended=True) as second:
            second.write_text("second", encoding="utf-8")
        assert path.read_text(encoding="utf-8") == "second"

    assert path.read_text(encoding="utf-8") == "first"
    assert list(tmp_path.iterdir()) == [path]
