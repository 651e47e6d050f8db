"""From what a session says of a board, checked where it is read, to the board."""

from collections.abc import Mapping
from typing import Any

from hybridve.calib.boards.board import Board
from hybridve.calib.boards.markers import AprilGrid, Charuco
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.errors import CalibrationError

_KINDS: dict[str, type[Chessboard | Charuco | AprilGrid]] = {
    "chessboard": Chessboard,
    "charuco": Charuco,
    "aprilgrid": AprilGrid,
}


def make_board(said: Mapping[str, Any]) -> Board:
    """Return the board that a session's ``[target]`` describes.

    Parameters
    ----------
    said : mapping
        ``kind``, and what the board of that kind is made from by name, lengths in mm under names
        that end so; ``square_mm`` may be two, those along x and y. Keys and types were checked by
        who read them.

    Raises
    ------
    CalibrationError
        If there can be no such board; the message says why not.

    Examples
    --------
    >>> make_board({"kind": "chessboard", "columns": 8, "rows": 6, "square_mm": 115}).square_m
    0.115
    """
    values = {key: value for key, value in said.items() if key != "kind"}
    if isinstance(values.get("square_mm"), tuple):
        values["square_mm"], values["square_y_mm"] = values["square_mm"]
    for key in [key for key in values if key.endswith("_mm")]:
        values[f"{key.removesuffix('_mm')}_m"] = values.pop(key) / 1000.0
    try:
        return _KINDS[said["kind"]](**values)
    except CalibrationError as error:
        raise CalibrationError(f"[target] {error}") from error
