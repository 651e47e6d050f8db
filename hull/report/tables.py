"""A report as tables for spreadsheets and pandas: a row a frame and object, and a row a clash."""

import csv
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hybridve.calib.errors import ReportError
from hybridve.calib.files import appearing
from hybridve.hull.report.columns import TABLES
from hybridve.hull.report.ledger import Listed, to_list
from hybridve.hull.report.read import Report
from hybridve.hull.report.schema import Column

#: What names of columns end in, by unit.
_ENDINGS = {"m": "_m", "m/s": "_m_s", "s": "_s"}

#: Of a column of so many numbers a row what each is.
_PARTS = {2: ("lower", "upper"), 3: ("x", "y", "z")}


def write_tables(frames: Path, clashes: Path, report: Report, listed: Sequence[Listed]) -> None:
    """Write a report as CSV, in UTF-8; what is not known is empty, lengths are in metres.

    Parameters
    ----------
    frames, clashes : Path
        What is written: a row a frame and object, frame by frame; and a row a clash, worst first.
    report : Report
        Which.
    listed : sequence of Listed
        Its clashes by their names.

    Raises
    ------
    ReportError
        If one cannot be written.
    """
    _write(frames, _frame_rows(report))
    _write(clashes, _clash_rows(listed))


def _write(path: Path, rows: Iterable[Sequence[Any]]) -> None:
    try:
        with (
            appearing(path) as partial,
            partial.open("w", encoding="utf-8", newline="") as file,
        ):
            csv.writer(file, lineterminator="\n").writerows(rows)
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error.strerror}") from error


def _frame_rows(report: Report) -> Iterator[list[Any]]:
    """Yield the head, and a row for each object of each frame."""
    names = {name for rows in report.objects.values() for name in rows.columns}
    columns = [one for table in TABLES for one in table.columns if one.name in names]
    yield [
        *("frame", "time_s", "state", "object"),
        *(name for column in columns for name in _names(column, list(report.cameras))),
    ]
    for row, (index, time_s) in enumerate(
        zip(report.index.tolist(), report.time_s.tolist(), strict=True)
    ):
        for name, rows in report.objects.items():
            cells = [index, _cell(time_s), report.state[row], name]
            for column in columns:
                width = len(_names(column, list(report.cameras)))
                values = rows.get(column.name)
                if values is None:
                    cells += [""] * width
                else:
                    cells += [_cell(one) for one in np.atleast_1d(values[row]).tolist()]
            yield cells


def _names(column: Column[Any], cameras: Sequence[str]) -> list[str]:
    """Return what the columns of a table are called that a column of a report becomes."""
    if column.shape == ():
        return [column.name]
    ending = _ENDINGS.get(column.unit, "")
    if not column.name.endswith(ending):
        ending = ""
    plain = column.name.removesuffix(ending) if ending else column.name
    parts = cameras if column.shape == ("C",) else _PARTS[int(column.shape[0])]
    return [f"{plain}_{part}{ending}" for part in parts]


def _cell(value: Any) -> Any:
    """Return a value as a table has it: nothing for what is not known."""
    if value is None:
        return ""
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.10g}"
    return value


def _clash_rows(listed: Sequence[Listed]) -> Iterator[list[Any]]:
    """Yield the head, and a row for each clash."""
    told = [dict(_flat(one)) for one in to_list(listed)]
    names = list(told[0]) if told else ["id", "status", "kind", "object"]
    yield names
    for one in told:
        yield [one[name] for name in names]


def _flat(told: dict[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in told.items():
        name = f"{before}{key}"
        if isinstance(value, dict):
            yield from _flat(value, f"{name}_")
        elif isinstance(value, list | tuple) and key.endswith("_m"):
            plain = name.removesuffix("_m")
            points = [*value, *[None] * 3][:3]
            yield from (
                (f"{plain}_{axis}_m", _cell(one)) for axis, one in zip("xyz", points, strict=True)
            )
        elif isinstance(value, list | tuple):
            yield name, ", ".join(map(str, value))
        else:
            yield name, _cell(value)
