"""From the words of a session to the board they describe."""

from collections.abc import Mapping
from typing import Any

from hybridve.calib.boards.board import Board
from hybridve.calib.boards.markers import AprilGrid, Charuco
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.errors import CalibrationError

_COMMON = {"kind", "name", "body", "columns", "rows"}

#: The keys of each kind, beside those of all: what must be there, and what may.
_KEYS: dict[str, tuple[set[str], set[str]]] = {
    "chessboard": ({"square_mm"}, set()),
    "charuco": ({"square_mm", "marker_mm"}, {"dictionary", "legacy", "first_id"}),
    "aprilgrid": ({"tag_mm"}, {"gap_mm", "tag_spacing", "dictionary", "first_id"}),
}


def make_board(table: Mapping[str, Any]) -> Board:
    """Return the board that a session's ``[target]`` describes.

    Parameters
    ----------
    table : mapping
        The keys of ``[target]``, lengths in mm; one that is None counts as absent.

    Raises
    ------
    CalibrationError
        If a key is missing, unknown to this kind of board, or has no meaning; the message names it.
    """
    given = {key: value for key, value in table.items() if value is not None}
    kind = given.get("kind")
    if kind not in _KEYS:
        raise CalibrationError(f"[target] kind = {kind!r}: expected one of {', '.join(_KEYS)}")
    needed, allowed = _KEYS[kind]
    for key in sorted((needed | {"columns", "rows"}) - given.keys()):
        raise CalibrationError(f"[target] {key}: missing; a board of kind {kind!r} needs it")
    for key in sorted(given.keys() - needed - allowed - _COMMON):
        raise CalibrationError(f"[target] {key}: a board of kind {kind!r} has none")
    shared: dict[str, Any] = {
        "columns": _count(given, "columns"),
        "rows": _count(given, "rows"),
        "name": str(given.get("name", "board")),
        "body": given.get("body"),
    }
    try:
        if kind == "aprilgrid":
            tag_m = _length_m(given["tag_mm"], "tag_mm")
            return AprilGrid(tag_m=tag_m, gap_m=_gap_m(given, tag_m), **_coding(given), **shared)
        square_m, square_y_m = _sides_m(given["square_mm"])
        if kind == "chessboard":
            return Chessboard(square_m=square_m, square_y_m=square_y_m, **shared)
        return Charuco(
            square_m=square_m,
            square_y_m=square_y_m,
            marker_m=_length_m(given["marker_mm"], "marker_mm"),
            legacy=given.get("legacy"),
            **_coding(given),
            **shared,
        )
    except CalibrationError as error:
        text = str(error)
        raise CalibrationError(
            text if text.startswith("[target]") else f"[target] {text}"
        ) from error


def _count(given: Mapping[str, Any], key: str) -> int:
    value = given[key]
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise CalibrationError(f"[target] {key} = {value!r}: expected a whole number above 0")
    return value


def _length_m(value: Any, key: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
        raise CalibrationError(f"[target] {key} = {value!r}: expected a length above 0, in mm")
    return float(value) / 1000.0


def _sides_m(value: Any) -> tuple[float, float | None]:
    if isinstance(value, list | tuple):
        if len(value) != 2:
            raise CalibrationError(
                f"[target] square_mm = {value!r}: expected one side, or those along x and y"
            )
        return _length_m(value[0], "square_mm"), _length_m(value[1], "square_mm")
    return _length_m(value, "square_mm"), None


def _gap_m(given: Mapping[str, Any], tag_m: float) -> float:
    if ("gap_mm" in given) == ("tag_spacing" in given):
        raise CalibrationError(
            "[target] gap_mm: give the gap between tags, or tag_spacing, its share of a tag; one "
            "of the two"
        )
    if "gap_mm" in given:
        return _length_m(given["gap_mm"], "gap_mm")
    spacing = given["tag_spacing"]
    if isinstance(spacing, bool) or not isinstance(spacing, int | float) or not 0 < spacing <= 1:
        raise CalibrationError(
            f"[target] tag_spacing = {spacing!r}: expected a share of the tag, above 0 and up to 1"
        )
    return float(spacing) * tag_m


def _coding(given: Mapping[str, Any]) -> dict[str, Any]:
    return {key: given[key] for key in ("dictionary", "first_id") if key in given}
