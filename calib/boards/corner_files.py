"""Corners of one picture in the files of other programs."""

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Detection as Detection
from hybridve.calib.errors import CalibrationError
from hybridve.calib.opencv_storage import NotOpencvError, read_storage

#: What a CSV file may say of a corner.
COLUMNS = ("image", "frame", "board", "corner", "x", "y")

#: Names of columns that others give to these.
_MEANT = {
    **dict.fromkeys(
        ("id", "ids", "index", "idx", "number", "no", "nr", "point", "point_id", "corner_id"),
        "corner",
    ),
    **dict.fromkeys(("file", "filename", "picture", "img", "image_name", "view"), "image"),
    **dict.fromkeys(("frame_id", "frame_number", "time", "instant"), "frame"),
    **dict.fromkeys(("target", "board_id", "board_name"), "board"),
}


def read_corners(path: Path) -> NDArray[np.float64]:
    """Return corners that were marked by hand, (N, 2) pixels, pixel centre at 0.5, as listed.

    Taken are OpenCV's XML, YAML or JSON (a matrix ``corners`` of N points, or ``CornersAmount``
    with nodes ``Corner_0``, ``Corner_1``, ...) and CSV with a column x and a column y. All of them
    are understood as OpenCV counts: the centre of the top-left pixel is at (0, 0).

    Raises
    ------
    CalibrationError
        If the file is missing or holds no corners, or naming the line that holds none.
    """
    if not path.is_file():
        raise CalibrationError(f"{path}: there is no such corners file")
    read = _read_corners_csv if path.suffix.lower() in {".csv", ".txt"} else _read_corners_opencv
    corners = read(path)
    if corners is None or len(corners) == 0 or not np.isfinite(corners).all():
        raise CalibrationError(
            f"{path}: no corners found; expected an OpenCV matrix 'corners', nodes 'Corner_0', "
            "'Corner_1', ..., or CSV lines 'x,y'"
        )
    return corners + 0.5


def _read_corners_opencv(path: Path) -> NDArray[np.float64] | None:
    try:
        entries = read_storage(path)
    except NotOpencvError:
        return None
    matrix = entries.get("corners")
    if isinstance(matrix, np.ndarray):
        return matrix.reshape(-1, 2) if matrix.ndim > 1 and matrix.size % 2 == 0 else None
    amount = entries.get("CornersAmount")
    if not isinstance(amount, float):
        return None
    corners = [entries.get(f"Corner_{index}") for index in range(min(int(amount), len(entries)))]
    if len(corners) < amount or not all(
        isinstance(corner, np.ndarray) and corner.shape == (2,) for corner in corners
    ):
        return None
    return np.array(corners, dtype=np.float64).reshape(-1, 2)


def _read_corners_csv(path: Path) -> NDArray[np.float64] | None:
    lines = csv_lines(path)
    if not lines:
        return None
    header = [cell.lower() for cell in lines[0][1]]
    columns = (0, 1)
    if _is_number(header[0]):
        header = ["x", "y"]
    else:
        lines = lines[1:]
        columns = columns_of(path, header)
    corners = []
    for number, cells in lines:
        if len(cells) != len(header):
            raise CalibrationError(
                f"{path}, line {number}: {len(cells)} cells, expected {len(header)}: "
                f"{', '.join(header)[:80]}"
            )
        place = [cells[column] for column in columns]
        if not all(_is_number(cell) for cell in place):
            raise CalibrationError(
                f"{path}, line {number}: x = {place[0]!r}, y = {place[1]!r} is no place"
            )
        corners.append([float(cell) for cell in place])
    return np.array(corners, np.float64).reshape(-1, 2)


def csv_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Return the lines of a CSV file with their numbers, without those that begin with #.

    Raises
    ------
    CalibrationError
        If it is none, or separated by something else than commas.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            lines = [
                (reader.line_num, [cell.strip() for cell in line])
                for line in reader
                if any(cell.strip() for cell in line) and not line[0].startswith("#")
            ]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"{path}: not a CSV file: {error}") from error
    if lines and len(lines[0][1]) == 1 and any(sign in lines[0][1][0] for sign in ";\t"):
        raise CalibrationError(
            f"{path}, line {lines[0][0]}: {lines[0][1][0][:40]!r} has no comma; separate columns "
            "by commas, and write decimals with a point"
        )
    return lines


def columns_of(path: Path, header: list[str]) -> tuple[int, int]:
    """Return where x and y stand in a header.

    Raises
    ------
    CalibrationError
        If they do not, or a column that says which corner it is, or in which picture, has another
        name: it would be passed over.
    """
    if not {"x", "y"} <= set(header) or any(header.count(name) > 1 for name in COLUMNS):
        raise CalibrationError(
            f"{path}: no corners found: it has the columns {', '.join(header)[:80]}; expected x "
            f"and y, and perhaps {', '.join(COLUMNS[:4])}, each once"
        )
    for name in header:
        if name in _MEANT:
            raise CalibrationError(
                f"{path}: has a column {name!r}, which would be passed over; call it "
                f"{_MEANT[name]!r} if it is that, or leave it out"
            )
    return header.index("x"), header.index("y")


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False
