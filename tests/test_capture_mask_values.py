"""What the values of ready masks mean, as people have them; and what is refused."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.sessions import write_ball_session
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.calib.image_io import read_image, significant_bits
from hybridve.hull.capture.mask_values import MaskReading, reading_of
from hybridve.hull.capture.recording import FrameRange, segmented_frames
from hybridve.hull.capture.session import load_session

#: A silhouette: a disc, and two pixels beside it.
ROWS, COLUMNS = np.mgrid[:40, :60]
OBJECT = (ROWS - 20) ** 2 + (COLUMNS - 25) ** 2 < 12**2
OBJECT[5, 50:52] = True


def bgr(grey: NDArray[Any]) -> NDArray[Any]:
    return np.repeat(grey[..., None], 3, axis=2)


def levels(low: int, high: int, dtype: type = np.uint8) -> NDArray[Any]:
    return np.where(OBJECT, high, low).astype(dtype)


def stored_at(path: Path) -> NDArray[Any]:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    assert picture is not None
    return picture


SOFT = cv2.GaussianBlur(levels(0, 255), (0, 0), 1.0)
NUMBERED = np.where(OBJECT, np.where(COLUMNS > 25, 2, 1), 0).astype(np.uint8)
RED = np.where(OBJECT[..., None], np.array([0, 0, 255], np.uint8), np.uint8(0))
LABEL_COLOUR = np.where(OBJECT[..., None], np.array([0, 0, 64], np.uint8), np.uint8(0))
PHOTO = np.random.default_rng(1).integers(0, 255, (40, 60, 3)).astype(np.uint8)

#: Masks as people have them, all of the same silhouette.
UNDERSTOOD = {
    "0 and 255": levels(0, 255),
    "0 and 1": levels(0, 1),
    "0 and 1 in 16 bits": levels(0, 1, np.uint16),
    "0 and 255 in 16 bits": levels(0, 255, np.uint16),
    "0 and 65535": levels(0, 65535, np.uint16),
    "0 and 4095": levels(0, 4095, np.uint16),
    "0 and 64": levels(0, 64),
    "100 and 140": levels(100, 140),
    "numbers of things": NUMBERED,
    "soft edges": SOFT,
    "red on black": RED,
    "a dark colour of a palette": LABEL_COLOUR,
    "grey in three channels": bgr(levels(0, 255)),
    "white, the silhouette in alpha": np.dstack([np.full((40, 60, 3), 255), levels(0, 255)]),
    "a cut-out": np.dstack([bgr(levels(0, 70)), levels(0, 255)]),
    "a photograph, cut out": np.dstack([PHOTO, levels(0, 255)]),
    "a mask with an alpha channel that says nothing": np.dstack(
        [bgr(levels(0, 255)), np.full((40, 60), 255)]
    ),
}


@pytest.mark.parametrize("kind", UNDERSTOOD)
def test_masks_are_read_for_what_they_are(kind: str) -> None:
    stored = UNDERSTOOD[kind]
    stored = stored.astype(np.uint8) if stored.max() <= 255 and stored.ndim == 3 else stored

    mask = reading_of([stored]).mask(stored)

    assert mask.dtype == np.uint8
    if kind == "soft edges":  # the outline is where it was, but for half a pixel
        around = cv2.dilate(OBJECT.astype(np.uint8), np.ones((3, 3), np.uint8))
        core = cv2.erode(OBJECT.astype(np.uint8), np.ones((3, 3), np.uint8))
        assert (mask <= around).all()
        assert (mask >= core).all()
    else:
        np.testing.assert_array_equal(mask, OBJECT)


UNCLEAR = {
    "0, 128 and 255": (
        np.where(OBJECT, 255, np.where(ROWS < 6, 128, 0)).astype(np.uint8),
        "the values 0, 128 and 255.*mask_threshold",
    ),
    "labels with gaps": (
        np.where(OBJECT, 24, np.where(ROWS < 6, 7, 0)).astype(np.uint8),
        "values from 0 to 24, none above half of 255.*mask_threshold",
    ),
    "one value": (levels(7, 7), "every pixel .* has the value 7"),
    "told twice": (
        np.dstack([bgr(levels(0, 255)), np.where(ROWS < 6, 255, 0)]).astype(np.uint8),
        "told twice.*mask_channel",
    ),
}


@pytest.mark.parametrize("kind", UNCLEAR)
def test_what_is_not_clear_is_refused_with_the_values_and_the_key(kind: str) -> None:
    stored, message = UNCLEAR[kind]

    with pytest.raises(ValueError, match=message):
        reading_of([stored])


@pytest.mark.parametrize("threshold", [127, 48])
def test_a_threshold_that_is_given_holds_whatever_the_values_are(threshold: int) -> None:
    ramp = np.arange(256, dtype=np.uint8)[None]
    coloured = np.stack([ramp, np.zeros_like(ramp), ramp // 2], axis=2)
    deep = (ramp.astype(np.uint16) * 257)[:]

    for stored in (ramp, coloured, deep):
        mask = reading_of([stored], threshold).mask(stored)
        np.testing.assert_array_equal(mask, ramp > threshold)


def test_the_channel_that_is_given_holds() -> None:
    stored = UNCLEAR["told twice"][0]

    grey, alpha = (reading_of([stored], channel=one).mask(stored) for one in ("grey", "alpha"))

    np.testing.assert_array_equal(grey, OBJECT)
    np.testing.assert_array_equal(alpha, ROWS < 6)


def test_a_picture_that_holds_what_the_others_cannot_is_refused() -> None:
    reading = reading_of([levels(0, 1)])

    assert reading.mask(NUMBERED).any()  # one thing more is a thing
    with pytest.raises(ValueError, match="has the value 255, those looked at first none above 32"):
        reading.mask(levels(0, 255))
    with pytest.raises(ValueError, match="values 0 and 255, those looked at first only 0 and 64"):
        MaskReading("grey", 0, 255, (0, 64)).mask(levels(0, 255))
    with pytest.raises(ValueError, match="only the values 0 and 1, those looked at first up to"):
        reading_of([levels(0, 255)]).mask(levels(0, 1))
    assert not reading_of([SOFT]).mask(np.zeros_like(SOFT)).any()
    with pytest.raises(ValueError, match="no alpha channel"):
        reading_of([np.dstack([PHOTO, levels(0, 255)])]).mask(PHOTO)


@given(
    low=st.integers(0, 65534),
    high=st.integers(1, 65535),
    share=st.floats(0.01, 0.99),
    seed=st.integers(0, 99),
)
def test_of_any_two_values_the_larger_is_object(
    low: int, high: int, share: float, seed: int
) -> None:
    low, high = sorted((low, high))
    truth = np.random.default_rng(seed).random((20, 20)) < share
    truth[0, :2] = True, False
    stored = np.where(truth, high, low).astype(np.uint16)
    # White is the end of a scale, on which a grey is not clear, or nearly white too.
    assume(high != low)
    assume(high not in (255, 65535) or low <= 0.12 * high)

    reading = reading_of([stored])

    np.testing.assert_array_equal(reading.mask(stored), truth)


def test_a_session_of_masks_of_any_values_has_one_hull(tmp_path: Path) -> None:
    """Each camera has masks of its own kind; what a camera cannot mean is its frame's reason."""
    centers = np.array([[-0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    plain = write_ball_session(tmp_path / "plain", centers)
    other = write_ball_session(tmp_path / "other", centers)
    changes: tuple[Callable[[NDArray[Any]], NDArray[Any]], ...] = (
        lambda mask: np.greater(mask, 0).view(np.uint8),
        lambda mask: np.greater(mask, 0).astype(np.uint16) * 4095,
        lambda mask: np.dstack([np.full((*mask.shape, 3), 255, np.uint8), mask]),
        lambda mask: np.where(mask[..., None] > 0, np.array([0, 0, 64]), 0).astype(np.uint8),
    )
    for camera, change in enumerate(changes):
        for path in (tmp_path / "other" / f"cam{camera}").glob("*.png"):
            cv2.imwrite(str(path), change(stored_at(path)))
    # Too late for the look at the first ones: cam0's third picture is of another kind.
    third = tmp_path / "other" / "cam0" / "2.png"
    cv2.imwrite(str(third), 255 * stored_at(third))

    with pytest.raises(SessionError, match=r"camera 'cam0'.*only the values 0 and 1, others up"):
        list(segmented_frames(load_session(other), FrameRange()))
    third.unlink()
    expected = list(segmented_frames(load_session(plain), FrameRange(0, 2)))
    found = list(segmented_frames(load_session(other), FrameRange(0, 2)))

    for one, two in zip(expected, found, strict=True):
        assert one.masks is not None
        assert two.masks is not None
        for first, second in zip(one.masks, two.masks, strict=True):
            np.testing.assert_array_equal(first, second)


def test_masks_whose_first_pictures_are_empty_are_read_by_those_that_are_not(
    tmp_path: Path,
) -> None:
    centers = np.zeros((40, 3))
    session = write_ball_session(tmp_path / "late", centers, n_cameras=2)
    for camera in range(2):
        for frame in range(40):
            path = tmp_path / "late" / f"cam{camera}" / f"{frame}.png"
            shown = np.greater(stored_at(path), 0) & (frame == 37)
            cv2.imwrite(str(path), shown.view(np.uint8))

    frames = list(segmented_frames(load_session(session), FrameRange()))

    assert [bool(one.masks and one.masks[0].any()) for one in frames] == [
        frame == 37 for frame in range(40)
    ]


@pytest.mark.parametrize(("bits", "ending"), [(10, "png"), (12, "tiff"), (14, "png"), (16, "png")])
def test_pictures_of_more_than_8_bits_are_brought_to_8_by_those_that_hold_something(
    tmp_path: Path, bits: int, ending: str
) -> None:
    from hybridve.calib.image_io import FrameSource

    path, other = tmp_path / f"1.{ending}", tmp_path / f"2.{ending}"
    deep = np.linspace(0, (1 << bits) - 1, 1200).astype(np.uint16).reshape(30, 40)
    cv2.imwrite(str(path), deep)
    cv2.imwrite(str(other), deep // 2)
    sources = [FrameSource("a", (other,), is_video=False), FrameSource("b", (path,), False)]

    assert significant_bits(sources) == bits
    for one, values in ((path, deep), (other, deep // 2)):
        np.testing.assert_array_equal(read_image(one, bits)[..., 0], values >> (bits - 8))
    if bits < 16:
        cv2.imwrite(str(other), deep * 2 + 1)
        with pytest.raises(SessionError, match="give pictures of one depth"):
            read_image(other, bits)


def test_pictures_are_the_sensors_own_pixels_whatever_a_tag_says(tmp_path: Path) -> None:
    picture = np.arange(30 * 40 * 3, dtype=np.uint32).reshape(30, 40, 3).astype(np.uint8) // 2
    path = tmp_path / "turned.jpg"
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, 100])
    plain = read_image(path)
    # An EXIF block of one entry: orientation (0x0112) 6, a quarter turn.
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    jpeg = path.read_bytes()
    path.write_bytes(jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:])
    turned = cv2.imread(str(path))
    assert turned is not None
    assert turned.shape == (40, 30, 3)  # the tag is there

    np.testing.assert_array_equal(read_image(path), plain)
