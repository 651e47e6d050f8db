"""A camera against the others as a picture: what is filled, what is dark, and what stands below."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridve.hull.view.contrast import contrast_sheet, draw_contrast

SIZE = (300, 400)
GREY = 120


def area(rows: slice, columns: slice) -> NDArray[np.bool_]:
    result = np.zeros(SIZE, np.bool_)
    result[rows, columns] = True
    return result


MASK = area(slice(100, 200), slice(100, 200))
OTHERS = area(slice(100, 200), slice(150, 250))
IN_VIEW = area(slice(0, 300), slice(0, 350))


def drawn(**changes: object) -> NDArray[np.uint8]:
    image = np.full((*SIZE, 3), GREY, np.uint8)
    alone = (MASK & ~OTHERS, OTHERS & ~MASK)
    known: dict[str, Any] = {"name": "cam7", **changes}
    return draw_contrast(image, MASK, OTHERS, alone, IN_VIEW, **known)


def test_what_one_alone_holds_has_the_colour_of_its_outline() -> None:
    image = drawn().astype(int)

    own, both, others, outside, unseen = (image[150, x] for x in (125, 175, 225, 300, 380))
    assert own[1] > 150 > own[2]  # green, BGR
    assert others[2] > 150 > others[0]  # orange
    assert np.ptp(both) == np.ptp(outside) == np.ptp(unseen) == 0
    assert unseen[0] < 0.6 * outside[0] < 0.6 * GREY
    np.testing.assert_array_equal(both, outside)


def test_outlines_are_drawn_where_they_are() -> None:
    image = drawn().astype(int)

    for x, is_own in ((100, True), (199, True), (150, False), (249, False)):
        near = image[150, x - 1 : x + 2]
        strongest = near[np.abs(near[:, 2] - near[:, 0]).argmax()]
        assert (strongest[1] > strongest[2]) == is_own


def test_what_is_wrong_stands_beside_the_name() -> None:
    plain, wrong = drawn(), drawn(remark="mirrored")

    differ = np.argwhere((plain != wrong).any(axis=2))
    assert differ[:, 0].max() < 40
    assert differ[:, 1].max() < 200
    # However long it is, it stays in the picture.
    assert drawn(remark="w" * 400).shape == plain.shape


@pytest.mark.parametrize("has_unseen", [False, True])
def test_a_sheet_has_pictures_of_one_width_a_title_and_a_legend(has_unseen: bool) -> None:
    small = np.full((60, 80, 3), 10, np.uint8)
    large = np.full((90, 120, 3), 20, np.uint8)

    sheet = contrast_sheet([small, large], 2, "a title", has_unseen=has_unseen)

    dark = (sheet == 10).all(axis=2), (sheet == 20).all(axis=2)
    assert [int(part.sum()) for part in dark] == [90 * 120] * 2
    rows = np.flatnonzero(dark[1].any(axis=1))
    assert (sheet[: rows[0]] < 100).any()
    assert (sheet[rows[-1] + 1 :] < 160).any()
    assert sheet.shape[1] == 2 * 120 + 3 * 6
