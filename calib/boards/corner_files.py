"""Corners of one picture in the files of other programs."""

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Detection as Detection
from hybridve.calib.errors import CalibrationError
from hybridve.calib.opencv_storage import NotOpencvError, read_storage


def read_corners(path: Path) -> NDArray[np.float64]:
    """Return corners that were marked by hand, (N, 2) pixels, pixel centre at 0.5, as listed.

    Taken are OpenCV's XML, YAML or JSON (a matrix ``corners`` of N points, or ``CornersAmount``
    with nodes ``Corner_0``, ``Corner_1``, ...) and CSV with a column x and a column y. All of them
    are understood as OpenCV counts: the centre of the top-left pixel is at (0, 0).

    Raises
    ------
    CalibrationError
        If the file is missing or holds no corners.
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
    with path.open(newline="", encoding="utf-8") as file:
        lines = [line for line in csv.reader(file) if line and not line[0].startswith("#")]
    columns = (0, 1)
    try:
        float(lines[0][0])
    except (ValueError, IndexError):
        header = [cell.strip().lower() for cell in lines[0]] if lines else []
        if "x" not in header or "y" not in header:
            return None
        columns = (header.index("x"), header.index("y"))
        lines = lines[1:]
    try:
        return np.array([[float(line[column]) for column in columns] for line in lines]).reshape(
            -1, 2
        )
    except (ValueError, IndexError):
        return None
