"""Films are what browsers play, whole or not there at all."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.hull.view.film import write_film


def pictures(count: int, size: tuple[int, int] = (64, 96)) -> Iterator[NDArray[np.uint8]]:
    """Yield pictures, each of its own even grey."""
    for number in range(count):
        yield np.full((*size, 3), 20 + 30 * number, np.uint8)


def test_a_film_is_h264_of_halved_colours_and_has_every_picture(tmp_path: Path) -> None:
    import av

    path = tmp_path / "a.mp4"

    assert write_film(path, pictures(7, (65, 97)), 12.5) == 7

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert (stream.width, stream.height) == (96, 64), "players want even sides"
        assert float(stream.average_rate or 0) == 12.5
        greys = [frame.to_ndarray(format="bgr24").mean() for frame in container.decode(stream)]
    np.testing.assert_allclose(greys, 20 + 30 * np.arange(7), atol=4)
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat"), "plays while it is loaded"
    assert [one.name for one in tmp_path.iterdir()] == ["a.mp4"]


def test_a_film_of_no_picture_is_one_line_and_no_file(tmp_path: Path) -> None:
    with pytest.raises(ReportError, match="there is no picture to make a film of") as told:
        write_film(tmp_path / "a.mp4", pictures(0), 25.0)

    assert "\n" not in str(told.value)
    assert list(tmp_path.iterdir()) == []


def test_what_goes_wrong_half_way_leaves_what_stood_there(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(b"before")

    def torn() -> Iterator[NDArray[np.uint8]]:
        yield from pictures(3)
        raise ReportError("torn")

    with pytest.raises(ReportError, match="torn"):
        write_film(path, torn(), 25.0)

    assert path.read_bytes() == b"before"
    assert [one.name for one in tmp_path.iterdir()] == ["a.mp4"]


def test_a_place_that_cannot_be_written_to_is_named(tmp_path: Path) -> None:
    with pytest.raises(
        ReportError, match=r"missing/a\.mp4: cannot be written \(.*\); name a place"
    ):
        write_film(tmp_path / "missing" / "a.mp4", pictures(2), 25.0)
