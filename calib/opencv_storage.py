"""What a file of OpenCV's ``cv::FileStorage`` holds, XML, YAML or JSON, as Python's own values.

References
----------
https://docs.opencv.org/5.x/da/d56/classcv_1_1FileStorage.html
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hybridve.calib.errors import CalibrationError
from hybridve.calib.opencv_files import structured_text


class NotOpencvError(CalibrationError):
    """A file is none of OpenCV's."""


#: Maps and lists inside each other more deeply than this are no rig.
_DEEPEST = 20


def read_storage(path: Path) -> dict[str, Any]:
    """Return what stands at the top of a file, by its key.

    Numbers come as float, texts as str, matrices and lists of numbers as float64 arrays, other
    lists as list and maps as dict of these; what is none of it as None.

    Raises
    ------
    NotOpencvError
        If it is none of OpenCV's, or OpenCV cannot read it.
    """
    try:
        text = structured_text(path)
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        is_open = storage.isOpened()
    except ValueError as error:
        raise NotOpencvError(f"{path}: {error}; that is no rig") from error
    except (cv2.error, SystemError, OSError):
        is_open = False
    if not is_open:
        raise NotOpencvError(
            f"{path}: not an OpenCV file; expected XML, YAML or JSON as cv::FileStorage writes it"
        )
    try:
        root = storage.root()
        return {key: _value(root.getNode(key), 0) for key in root.keys()}  # noqa: SIM118 - no dict
    except (cv2.error, SystemError) as error:
        raise NotOpencvError(
            f"{path}: OpenCV finds nothing under a name in it; it is damaged, or no OpenCV file"
        ) from error
    finally:
        storage.release()


def _value(node: Any, depth: int) -> Any:
    if node.isInt() or node.isReal():
        return float(node.real())
    if node.isString():
        return node.string()
    if depth > _DEEPEST:
        return None
    if node.isSeq():
        values = [_value(node.at(index), depth + 1) for index in range(node.size())]
        if any(isinstance(value, str) for value in values):  # "01" is a name, not a number
            return values
        try:
            return np.array(values, dtype=np.float64)
        except (TypeError, ValueError):
            return values
    if node.isMap():
        return _map(node, depth)
    return None


def _map(node: Any, depth: int) -> Any:
    """Return the matrix that a map stands for, or what is in it.

    OpenCV's own ``FileNode.mat`` writes beyond its memory where a damaged file says no columns.
    """
    entries = {
        key: _value(node.getNode(key), depth + 1)
        for key in node.keys()  # noqa: SIM118 - no dict
    }
    # ROS writes these three without OpenCV's sign that this is a matrix.
    data, rows, columns = (entries.get(key) for key in ("data", "rows", "cols"))
    if not isinstance(data, np.ndarray) or rows is None or columns is None:
        return entries
    if not (isinstance(rows, float) and isinstance(columns, float)):
        return None
    count = rows * columns
    if data.ndim != 1 or count < 1 or data.size % count:
        return None
    shape = (int(rows), int(columns), data.size // int(count))  # several channels: one more axis
    return data.reshape(shape[:2] if shape[2] == 1 else shape)
