"""Silhouettes are read as they were written, and a file is whole or not there."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.thorough import asked
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.hull.capture.silhouette_io import SilhouetteReader, SilhouetteWriter

_FEW = settings(
    max_examples=asked(25),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)

Masks = list[NDArray[np.uint8]]


@st.composite
def recordings_of_masks(
    draw: st.DrawFn,
) -> tuple[list[str], list[tuple[int, int]], list[tuple[Masks | None, str]]]:
    """Cameras, their sizes, and frames: masks, or None and a reason."""
    names = draw(st.lists(st.text(min_size=1, max_size=5), min_size=1, max_size=3, unique=True))
    names = [name.replace("\0", "_") for name in names]
    sizes_px = [
        (draw(st.integers(1, 20)), draw(st.integers(1, 9))) for _ in names
    ]  # (width, height)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    frames: list[tuple[Masks | None, str]] = []
    for _ in range(draw(st.integers(0, 5))):
        reason = draw(st.sampled_from(["", "", "", "camera 'ü' has stopped recording"]))
        masks = [
            (rng.random((height, width)) < rng.random()).astype(np.uint8)
            for width, height in sizes_px
        ]
        frames.append((None, reason) if reason else (masks, ""))
    return names, sizes_px, frames


def write(path: Path, n_frames: int = 4) -> list[NDArray[np.uint8]]:
    """Write one camera's noise and return it: noise does not compress, so that chunks are large."""
    rng = np.random.default_rng(7)
    masks = [rng.integers(0, 2, (40, 52), np.uint8) for _ in range(n_frames)]
    with SilhouetteWriter(path, ["cam1"], [(52, 40)], "a stamp") as writer:
        for mask in masks:
            writer.append([mask])
    return masks


@_FEW
@given(recording=recordings_of_masks(), stamp=st.text(st.characters(codec="utf-8"), max_size=20))
def test_what_is_written_is_what_is_read(
    tmp_path: Path,
    recording: tuple[list[str], list[tuple[int, int]], list[tuple[Masks | None, str]]],
    stamp: str,
) -> None:
    names, sizes_px, frames = recording
    stamp = stamp.replace("\0", "")
    path = tmp_path / "silhouettes.h5"

    with SilhouetteWriter(path, names, sizes_px, stamp) as writer:
        for masks, reason in frames:
            writer.append(masks, reason)

    with SilhouetteReader(path) as reader:
        assert (reader.names, reader.stamp, reader.n_frames) == (names, stamp, len(frames))
        for index in reversed(range(len(frames))):  # in any order
            masks, reason = reader.frame(index)
            expected, expected_reason = frames[index]
            assert reason == expected_reason
            assert (masks is None) == (expected is None)
            for found, wanted in zip(masks or [], expected or [], strict=True):
                assert found.dtype == np.uint8
                np.testing.assert_array_equal(found, wanted)


def test_any_value_above_0_is_an_object_pixel(tmp_path: Path) -> None:
    path = tmp_path / "silhouettes.h5"
    with SilhouetteWriter(path, ["a"], [(3, 1)], "") as writer:
        writer.append([np.array([[0, 1, 255]], np.uint8)])

    with SilhouetteReader(path) as reader:
        masks, _ = reader.frame(0)

    assert masks is not None
    assert masks[0].tolist() == [[0, 1, 1]]


def test_the_file_appears_only_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "silhouettes.h5"

    with SilhouetteWriter(path, ["a"], [(8, 8)], "") as writer:
        writer.append([np.ones((8, 8), np.uint8)])
        assert not path.exists()

    assert [entry.name for entry in tmp_path.iterdir()] == ["silhouettes.h5"]


@pytest.mark.parametrize("stop", [RuntimeError, KeyboardInterrupt])
def test_a_run_that_was_stopped_leaves_nothing_and_spares_what_was_there(
    tmp_path: Path, stop: type[BaseException]
) -> None:
    path = tmp_path / "silhouettes.h5"
    path.write_text("precious", encoding="utf-8")

    with pytest.raises(stop), SilhouetteWriter(path, ["a"], [(8, 8)], "") as writer:  # noqa: PT012
        writer.append([np.ones((8, 8), np.uint8)])
        raise stop

    assert [entry.name for entry in tmp_path.iterdir()] == ["silhouettes.h5"]
    assert path.read_text(encoding="utf-8") == "precious"


def test_a_folder_that_does_not_exist_is_named(tmp_path: Path) -> None:
    path = tmp_path / "nowhere" / "silhouettes.h5"

    with pytest.raises(ReportError) as caught:
        SilhouetteWriter(path, ["a"], [(8, 8)], "")

    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("masks", [[np.ones((8, 9), np.uint8)], []], ids=["size", "number"])
def test_masks_that_are_not_the_cameras_are_refused(tmp_path: Path, masks: Masks) -> None:
    with (
        pytest.raises(ValueError, match=r"mask 0 is|zip\(\)"),
        SilhouetteWriter(tmp_path / "silhouettes.h5", ["a"], [(8, 8)], "") as writer,
    ):
        writer.append(masks)


def test_the_same_silhouettes_give_the_same_file(tmp_path: Path) -> None:
    one, two = tmp_path / "one.h5", tmp_path / "two.h5"
    write(one)
    write(two)

    assert one.read_bytes() == two.read_bytes()


def test_smooth_silhouettes_take_little_room(tmp_path: Path) -> None:
    path = tmp_path / "silhouettes.h5"
    rows, columns = np.mgrid[:486, :644]
    ball = ((rows - 240) ** 2 + (columns - 300) ** 2 < 90**2).astype(np.uint8)

    with SilhouetteWriter(path, ["a"], [(644, 486)], "") as writer:
        for _ in range(20):
            writer.append([ball])

    assert path.stat().st_size / 20 < 2000, "bytes a frame; as bits it would be 39366"


def test_every_dataset_says_what_it_is_and_is_stored_with_a_checksum(tmp_path: Path) -> None:
    path = tmp_path / "silhouettes.h5"
    write(path)

    with h5py.File(path, "r") as file:
        described = []
        file.visititems(
            lambda name, item: (
                described.append(name)
                if isinstance(item, h5py.Dataset) and {"unit", "description"} <= set(item.attrs)
                else None
            )
        )
        assert sorted(described) == ["cameras", "masks/0", "reason", "stamp"]
        masks = file["masks/0"]
        assert masks.fletcher32
        assert masks.shuffle
        assert masks.compression == "gzip"
        assert masks.chunks == (1, 40, 7)


def test_a_flipped_byte_is_noticed_and_the_other_frames_can_still_be_read(tmp_path: Path) -> None:
    path = tmp_path / "silhouettes.h5"
    masks = write(path)
    with h5py.File(path, "r") as file:
        chunk = file["masks/0"].id.get_chunk_info(2)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset + chunk.size // 2] ^= 0x10
    path.write_bytes(content)

    with SilhouetteReader(path) as reader:
        with pytest.raises(ReportError, match=r"damaged .*segment --overwrite"):
            reader.frame(2)
        others, _ = reader.frame(3)

    assert others is not None
    np.testing.assert_array_equal(others[0], masks[3])


@_FEW
@given(share=st.floats(0, 0.999))
def test_a_file_that_was_cut_off_is_refused_in_one_line(tmp_path: Path, share: float) -> None:
    path = tmp_path / "silhouettes.h5"
    write(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])

    with pytest.raises(ReportError) as caught:
        SilhouetteReader(path)

    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("format", "hybridve-report", "holds hybridve-report, expected hybridve-silhouettes"),
        ("format", None, "holds an unknown format"),
        ("version", 2, "version 2, this hybridve reads 1"),
        ("version", None, "damaged"),
    ],
)
def test_another_format_or_version_is_named(
    tmp_path: Path, key: str, value: str | int | None, message: str
) -> None:
    path = tmp_path / "silhouettes.h5"
    write(path)
    with h5py.File(path, "r+") as file:
        del file.attrs[key]
        if value is not None:
            file.attrs[key] = value

    with pytest.raises(ReportError, match=message):
        SilhouetteReader(path)


@pytest.mark.parametrize("name", ["reason", "stamp", "cameras", "masks/0"])
def test_a_file_that_lacks_a_part_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / "silhouettes.h5"
    write(path)
    with h5py.File(path, "r+") as file:
        del file[name]

    with pytest.raises(ReportError, match="damaged"):
        SilhouetteReader(path)


def test_parts_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "silhouettes.h5"
    write(path)
    with h5py.File(path, "r+") as file:
        file["masks/0"].resize(3, axis=0)

    with pytest.raises(ReportError, match="contradict"):
        SilhouetteReader(path)


def test_where_there_are_none_it_is_said_how_to_make_them(tmp_path: Path) -> None:
    with pytest.raises(ReportError, match="hybridve segment"):
        SilhouetteReader(tmp_path / "silhouettes.h5")
