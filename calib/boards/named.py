"""From what a session says of a board, checked where it is read, to the board."""

from collections.abc import Mapping
from typing import Any

from hybridve.calib.boards.board import Board
from hybridve.calib.boards.markers import AprilGrid, Charuco
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.errors import CalibrationError

#: Squares and tags that are printed for cameras measure between these.
_LENGTHS_MM = (1.0, 2000.0)

#: A marker or a gap of less than this share of its square or tag is in another unit than that.
_LEAST_SHARE = 0.02

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
        If there can be no such board, or its lengths are in another unit than millimetres; the
        message says why not, and the likely value.

    Examples
    --------
    >>> make_board({"kind": "chessboard", "columns": 8, "rows": 6, "square_mm": 115}).square_m
    0.115
    """
    values = {key: value for key, value in said.items() if key != "kind"}
    _check_unit(values)
    if isinstance(values.get("square_mm"), tuple):
        values["square_mm"], values["square_y_mm"] = values["square_mm"]
    for key in [key for key in values if key.endswith("_mm")]:
        values[f"{key.removesuffix('_mm')}_m"] = values.pop(key) / 1000.0
    try:
        return _KINDS[said["kind"]](**values)
    except CalibrationError as error:
        raise CalibrationError(f"[target] {error}") from error


def _check_unit(said: Mapping[str, Any]) -> None:
    """Refuse lengths that nobody prints: metres where millimetres are asked for, or micrometres.

    Raises
    ------
    CalibrationError
        With the values that they have in millimetres.
    """
    low, high = _LENGTHS_MM
    key = "square_mm" if "square_mm" in said else "tag_mm"
    sides = said[key] if isinstance(said[key], tuple) else (said[key],)
    if min(sides) <= 0:
        return  # what else is refused with it is said by the board
    if low <= min(sides) and max(sides) <= high:
        for part in ("marker_mm", "gap_mm"):
            if 0 < said.get(part, 0) < _LEAST_SHARE * min(sides):
                raise CalibrationError(
                    f"[target] {part} = {said[part]:g} beside {key} = {_plain(said[key])}: lengths "
                    f"are in millimetres; is it in metres? say {part} = {1000 * said[part]:g}"
                )
        return
    is_small = min(sides) < low
    unit, factor = ("metres", 1000.0) if is_small else ("micrometres", 0.001)
    # The gap of a grid may have been told as a share of the tag.
    say = [key, *(["marker_mm"] if (said.get("marker_mm", high) < low) == is_small else [])]
    raise CalibrationError(
        f"[target] {key} = {_plain(said[key])}: {key.removesuffix('_mm')}s measure {low:g} to "
        f"{high:g} mm, and lengths are in millimetres; is it in {unit}? say "
        + ", ".join(f"{name} = {_plain(said[name], factor)}" for name in say if name in said)
    )


def _plain(length: float | tuple[float, float], factor: float = 1.0) -> str:
    """Return one length, or two, as a session has them, times a factor."""
    if isinstance(length, tuple):
        return f"[{', '.join(f'{side * factor:.6g}' for side in length)}]"
    return f"{length * factor:.6g}"
