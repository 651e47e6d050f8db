"""The hard cases stay numerically stable: every engine, certificate, clearance and response.

See `helpers.hard_cases` for the cases, `helpers.hard_checks` for what is asserted of each, and
tests/README.md for the table of what was found, which ``make hard-cases`` writes.
"""

from collections.abc import Iterator

import pytest
from helpers.hard_cases import CASES, COLUMNS, Case
from helpers.hard_cases_table import README, rows_of
from helpers.hard_checks import Tools, check


def cells() -> Iterator[object]:
    """The quick rows, column by column; those that lack something must fail."""
    for case in CASES:
        for column in COLUMNS:
            if not case.is_quick or column in case.unasked:
                continue
            marks = []
            if column in case.lacking:
                marks.append(
                    pytest.mark.xfail(
                        strict=True, raises=AssertionError, reason=case.lacking[column]
                    )
                )
            yield pytest.param(case, column, marks=marks, id=f"{case.name}-{column}")


@pytest.fixture(scope="module")
def tools() -> Iterator[Tools]:
    tools = Tools()
    yield tools
    tools.close()


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.parametrize(("case", "column"), list(cells()))
def test_a_hard_case_has_the_right_answer(case: Case, column: str, tools: Tools) -> None:
    check(case, column, tools)


def test_the_table_has_a_row_for_every_case_and_the_columns_that_are_asked() -> None:
    head, _, *rows = rows_of(README.read_text(encoding="utf-8"))

    assert head == ["case", *COLUMNS]
    assert [row[0] for row in rows] == [case.name for case in CASES]
    for case, row in zip(CASES, rows, strict=True):
        for column, text in zip(COLUMNS, row[1:], strict=True):
            assert text.startswith("-") == (column in case.unasked), (case.name, column)
            assert text.startswith("fails") == (column in case.lacking), (case.name, column)
            assert text
