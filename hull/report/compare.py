"""Several sessions and several layouts side by side: one table, and names for its reports."""

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hybridve.calib.errors import ReportError
from hybridve.calib.files import write_whole

#: Between a session and a layout in the name of their report; names themselves never hold it.
_BETWEEN = "__"


@dataclass(frozen=True, slots=True)
class Pair:
    """One session with one layout.

    Attributes
    ----------
    session, layout : str
        Their names.
    summary : dict or None
        What `hybridve.hull.report.summarize` says of its report; None where there is none.
    error : str
        Why there is none.
    """

    session: str
    layout: str
    summary: dict[str, Any] | None
    error: str = ""


def report_name(session: str, layout: str) -> str:
    """Return the file name of a report; different for different pairs of `distinct_names`."""
    return f"{session}{_BETWEEN}{layout}.h5"


def distinct_names(paths: Sequence[Path], default: str) -> list[str]:
    """Return a name for each path that tells it from the others, and serves in a file's name.

    It is the end of the path, as long as is needed for all of them to differ.

    Parameters
    ----------
    paths : sequence of Path
        Files, or folders that hold one called `default`, which then goes without saying.
    default : str
        As "session.toml".

    Raises
    ------
    ValueError
        If two of them are the same file.

    Examples
    --------
    >>> distinct_names([Path("/a/p1/session.toml"), Path("/a/p2")], "session.toml")
    ['p1', 'p2']
    >>> distinct_names([Path("/a/x.toml"), Path("/b/x.toml")], "session.toml")
    ['a-x', 'b-x']
    """
    files = [_file_of(path, default) for path in paths]
    for number, file in enumerate(files):
        if file in files[:number]:
            raise ValueError(f"{paths[number]} is given twice")
    parts = [
        (file.parent if file.name == default else file.with_suffix("")).parts for file in files
    ]
    for length in range(1, max(len(one) for one in parts) + 1):
        names = [_file_name("-".join(one[-length:])) for one in parts]
        # Some file systems take capitals for small letters.
        if len({name.casefold() for name in names}) == len(names):
            return names
    # They differ only in what a name cannot hold, or are a.toml and a/scene.toml.
    return [f"{number}-{name}" for number, name in enumerate(names, start=1)]


def _file_of(path: Path, default: str) -> Path:
    path = path.resolve()
    return path if path.suffix == ".toml" else path / default


def _file_name(text: str) -> str:
    return re.sub(r"_+", "_", re.sub(r"[^\w.-]", "_", text)).strip("_") or "-"


@dataclass(frozen=True, slots=True)
class _Quantity:
    key: str
    unit: str
    kind: str


#: What the table has of each object, each session and each layout. Kinds are those of a report.
_QUANTITIES = (
    _Quantity("verdict", "", "exact"),
    _Quantity("trusted", "", "estimate"),
    _Quantity("kept_rests_on", "", "exact"),
    _Quantity("clearance_lower", "mm", "bound"),
    _Quantity("clearance_upper", "mm", "bound"),
    _Quantity("clearance_at_least_95", "mm", "estimate"),
    _Quantity("depth_upper", "mm", "bound"),
    _Quantity("required_clearance", "mm", "exact"),
    _Quantity("frames", "", "exact"),
    _Quantity("frames_invalid", "", "exact"),
    _Quantity("frames_colliding", "", "bound"),
    _Quantity("frames_inside", "", "bound"),
    _Quantity("frames_below_required", "", "bound"),
)


def compare(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Return sessions and layouts side by side, as plain JSON values.

    Returns
    -------
    dict
        ``sessions`` and ``layouts``, in their order; ``failed``: ``session``, ``layout`` and
        ``error`` of the pairs that have no report; ``rows``, one for each layout and object:
        ``layout``, ``object`` and ``sessions``, by name: ``report`` and the quantities that
        ``COMPARISON.csv`` has, lengths in metres (``clearance_lower_m``), None where not known.
    """
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for pair in pairs:
        if pair.summary is not None:
            for found in pair.summary["objects"]:
                row = rows.setdefault((pair.layout, found["name"]), {})
                row[pair.session] = _cell(pair.summary, found)
    layouts = list(dict.fromkeys(pair.layout for pair in pairs))
    return {
        "sessions": list(dict.fromkeys(pair.session for pair in pairs)),
        "layouts": layouts,
        "failed": [
            {"session": pair.session, "layout": pair.layout, "error": pair.error}
            for pair in pairs
            if pair.summary is None
        ],
        "rows": [
            {"layout": layout, "object": name, "sessions": cells}
            for (layout, name), cells in sorted(
                rows.items(), key=lambda item: layouts.index(item[0][0])
            )
        ],
    }


def _cell(summary: dict[str, Any], found: dict[str, Any]) -> dict[str, Any]:
    clearance, depth = found["clearance"] or {}, found["depth"] or {}
    return {
        "report": summary["report"],
        "verdict": found["verdict"],
        "trusted": summary["trusted"],
        "kept_rests_on": summary["kept_rests_on"],
        "clearance_lower_m": clearance.get("lower_m"),
        "clearance_upper_m": clearance.get("upper_m"),
        "clearance_at_least_95_m": clearance.get("at_least_95_m"),
        "depth_upper_m": depth.get("upper_m"),
        "required_clearance_m": found["required_clearance_m"],
        "frames": summary["frames"],
        "frames_invalid": summary["frames_invalid"],
        "frames_colliding": found["frames_colliding"],
        "frames_inside": found["frames_inside"],
        "frames_below_required": found["frames_below_required"],
    }


def write_comparison(path: Path, comparison: dict[str, Any]) -> None:
    """Write a comparison as CSV: sessions in columns; layouts, objects and quantities in rows.

    An empty cell is not known, or has no report.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    sessions = comparison["sessions"]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["layout", "object", "quantity", "unit", "kind", *sessions])
    for row in comparison["rows"]:
        for quantity in _QUANTITIES:
            cells = [_csv_value(row["sessions"].get(name), quantity) for name in sessions]
            about = [row["layout"], row["object"], quantity.key, quantity.unit, quantity.kind]
            writer.writerow([*about, *cells])
    try:
        write_whole(path, text.getvalue())
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error.strerror}") from error


def _csv_value(cell: dict[str, Any] | None, quantity: _Quantity) -> Any:
    if cell is None:
        return ""
    if quantity.unit != "mm":
        value = cell[quantity.key]
    else:
        metres = cell[f"{quantity.key}_m"]
        value = None if metres is None else f"{1e3 * metres:.4f}"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "" if value is None else value
