"""``hybridve board``: a printed board is found where it is said to be, in millimetres."""

import io
import json
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board
from hybridve.calib.boards.markers import AprilGrid, Charuco
from hybridve.calib.boards.target import Chessboard
from hybridve.hull.view.board_sheet import BoardPage, draw_board

Run = Callable[..., int]

#: Pages of whole millimetres have whole pixels then.
PX_PER_MM = 4

#: Corners of an ideal picture are found to a tenth of a pixel.
TOLERANCE_MM = 0.1 / PX_PER_MM

BOARDS: list[Board] = [
    Chessboard(7, 4, 0.03),
    Chessboard(6, 5, 0.03, 0.024),
    Charuco(7, 5, 0.03, 0.022),
    Charuco(6, 4, 0.03, 0.022, legacy=True),
    Charuco(6, 4, 0.03, 0.02, legacy=False, first_id=20),
    AprilGrid(4, 3, 0.04, 0.012, first_id=3),
]


def picture_of(page: BoardPage) -> NDArray[np.uint8]:
    with io.BytesIO() as file:
        page.figure.savefig(file, format="png", dpi=25.4 * PX_PER_MM)
        raw = np.frombuffer(file.getvalue(), np.uint8)
    return np.asarray(cv2.imdecode(raw, cv2.IMREAD_GRAYSCALE), np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("board", BOARDS, ids=str)
def test_a_board_is_found_where_its_page_says(board: Board) -> None:
    page = draw_board(board)
    picture = picture_of(page)

    corners = board.detect(picture).corners

    assert corners is not None
    assert picture.shape == (round(PX_PER_MM * page.height_mm), round(PX_PER_MM * page.width_mm))
    x_mm = corners[:, 0] / PX_PER_MM - page.left_mm
    y_mm = page.height_mm - corners[:, 1] / PX_PER_MM - page.bottom_mm
    found_mm = np.column_stack([x_mm, y_mm])
    assert np.abs(found_mm - 1e3 * board.points_board[:, :2]).max() < TOLERANCE_MM


def test_the_scale_bar_is_as_long_as_it_says() -> None:
    page = draw_board(Chessboard(7, 4, 0.03))
    picture = picture_of(page)

    # Below the board's margin the bar is the only line; its text is lower still.
    below = picture[round(PX_PER_MM * (page.height_mm - page.bottom_mm + 30.0)) :]
    lengths = [int(np.ptp(np.flatnonzero(row < 128))) + 1 for row in below if (row < 128).any()]

    assert page.bar_mm == 100.0
    # A line is 0.28 mm wide, and sticks out by half of it at both ends.
    assert max(lengths[: len(lengths) // 2]) / PX_PER_MM == pytest.approx(100.0, abs=0.6)


def write_target(folder: Path, *targets: str) -> Path:
    path = folder / "session.toml"
    text = 'format = "hybridve-session"\nversion = 1\n' + "\n".join(targets)
    path.write_text(text, encoding="utf-8")
    return path


CHESSBOARD = '[[target]]\nkind = "chessboard"\ncolumns = 7\nrows = 4\nsquare_mm = 30\n'
APRILGRID = (
    '[[target]]\nname = "tags"\nkind = "aprilgrid"\ncolumns = 4\nrows = 3\ntag_mm = 40\n'
    "tag_spacing = 0.3\n"
)


def test_each_board_is_a_page_of_its_true_size(
    tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    session = write_target(tmp_path, CHESSBOARD, APRILGRID)
    output = tmp_path / "boards.pdf"

    assert run("board", session, "-o", output, "--json") == 0

    pages = json.loads(capsys.readouterr().out)["pages"]
    boxes = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", output.read_bytes())
    # A point is 1/72 inch; 8 by 5 squares of 30 mm, 30 mm of white, 16 mm for the bar.
    assert len(boxes) == len(pages) == 2
    assert [float(side) * 25.4 / 72 for side in boxes[0]] == pytest.approx([300.0, 226.0], abs=0.01)
    assert (pages[0]["width_mm"], pages[0]["height_mm"]) == pytest.approx((300.0, 226.0))
    assert run("board", session, "-o", output) == 1


def test_it_says_on_which_paper_and_how_to_move_it(
    tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("board", write_target(tmp_path, CHESSBOARD), "-o", tmp_path / "b.pdf") == 0

    text = capsys.readouterr().out
    assert "300 x 226 mm, fits on A3" in text
    assert "print at 100 %" in text
    assert "extrinsics: all cameras see it at once" in text


def test_a_session_without_a_board_is_refused(
    tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("board", write_target(tmp_path), "-o", tmp_path / "b.pdf") == 1

    assert "target: this table is missing; describe the board" in capsys.readouterr().err
    assert not (tmp_path / "b.pdf").exists()
