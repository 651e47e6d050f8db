"""The table of hard cases: asked anew, and written into tests/README.md between its marks.

``make hard-cases`` runs it. Nothing in the table is written by hand: a cell is what a checker of
`helpers.hard_checks` returned after its assertions held.
"""

import sys
import time
import warnings
from pathlib import Path

import numpy as np

from helpers.hard_cases import CASES, COLUMNS, ENGINES, Case
from helpers.hard_checks import Cell, Tools, check

README = Path(__file__).resolve().parents[1] / "README.md"

BEGIN, END = "<!-- hard cases: begin -->", "<!-- hard cases: end -->"


def cell_of(case: Case, column: str, tools: Tools) -> Cell:
    """Return a cell: what a checker measured, or that there is nothing to ask, or that it fails.

    Raises
    ------
    AssertionError
        If a check fails that should not, or one holds that is said to fail.
    """
    if column in case.unasked:
        return Cell("-")
    try:
        cell = check(case, column, tools)
    except AssertionError as error:
        if column not in case.lacking:
            raise AssertionError(f"{case.name}: {column}: {error}") from error
        return Cell("fails")
    if column in case.lacking:
        raise AssertionError(f"{case.name}: {column}: holds, but is said to fail")
    return cell


def as_markdown(rows: list[tuple[Case, dict[str, Cell]]]) -> str:
    """Return the table and its notes."""
    notes: list[str] = []
    lines = [
        f"| case | {' | '.join(COLUMNS)} |",
        f"|{'---|' * (len(COLUMNS) + 1)}",
    ]
    for case, cells in rows:
        texts = []
        for column in COLUMNS:
            text, reason = cells[column].text, case.unasked.get(column) or case.lacking.get(column)
            if reason:
                note = f"{'not asked' if column in case.unasked else 'fails'}: {reason}"
                if note not in notes:
                    notes.append(note)
                text += f" [{notes.index(note) + 1}]"
            texts.append(text)
        lines.append(f"| {case.name} | {' | '.join(texts)} |")
    if notes:
        lines += ["", *(f"{k}. {note}." for k, note in enumerate(notes, start=1))]
    return "\n".join([*lines, "", *_sums(rows)])


def _sums(rows: list[tuple[Case, dict[str, Cell]]]) -> list[str]:
    lines = []
    for engine in ENGINES:
        cells = [cells[engine] for _, cells in rows]
        n_samples, n_in_band, n_differing = (
            sum(getattr(cell, name) for cell in cells)
            for name in ("n_samples", "n_in_band", "n_differing")
        )
        lines.append(
            f"* `{engine}`: {n_samples:,} samples; {n_in_band:,} of them within its band of a "
            f"pixel's edge, {n_differing:,} taken otherwise than is exact."
        )
    return lines


def rows_of(text: str) -> list[list[str]]:
    """Return the cells of the table in a text, row by row, without its head's rule."""
    table = text.split(BEGIN)[1].split(END)[0]
    lines = [line for line in table.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def main() -> None:
    """Ask all cases and write the table."""
    warnings.simplefilter("error")
    tools, rows = Tools(), []
    begun = time.perf_counter()
    with np.errstate(divide="raise", over="raise", invalid="raise"):
        for case in CASES:
            rows.append((case, {column: cell_of(case, column, tools) for column in COLUMNS}))
            print(f"{time.perf_counter() - begun:6.1f} s  {case.name}", file=sys.stderr)  # noqa: T201
    tools.close()
    text = README.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    table = as_markdown(rows)
    README.write_text(f"{before}{BEGIN}\n{table}\n{END}{after}", encoding="utf-8")
    print(table)  # noqa: T201


if __name__ == "__main__":
    main()
