"""Several sessions and layouts in one table: names that tell them apart, and cells that agree."""

import csv
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridve.calib.errors import ReportError
from hybridve.hull.report.compare import (
    Pair,
    compare,
    distinct_names,
    report_name,
    write_comparison,
)

#: Parts of paths that a name must not confuse, among them some that a name cannot hold.
_PARTS = st.sampled_from(["a", "A", "b", "a__b", "_", "a b", "é", "run-1", "scene", "b_"])
_PATHS = st.lists(
    st.lists(_PARTS, min_size=1, max_size=3).map(lambda parts: Path("/", *parts)),
    min_size=1,
    max_size=5,
    unique_by=str,
)


@given(sessions=_PATHS, layouts=_PATHS)
def test_no_two_reports_have_the_same_name(sessions: list[Path], layouts: list[Path]) -> None:
    sessions = [path / "session.toml" for path in sessions]
    layouts = [path.with_suffix(".toml") for path in layouts]

    names = [
        report_name(session, layout).casefold()
        for session in distinct_names(sessions, "session.toml")
        for layout in distinct_names(layouts, "scene.toml")
    ]

    assert len(set(names)) == len(sessions) * len(layouts)
    for name in names:
        assert Path(name).name == name
        assert name.count("__") == 1
        assert " " not in name


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["/r/p1", "/r/p2/session.toml"], ["p1", "p2"]),
        (["/r/p1/take.toml"], ["take"]),
        (["/r/p1/a.toml", "/r/p2/a.toml", "/r/p2/b.toml"], ["p1-a", "p2-a", "p2-b"]),
        (["/r/v1.2"], ["v1.2"]),
    ],
)
def test_a_name_is_the_end_of_the_path_that_tells_it_apart(
    paths: list[str], names: list[str]
) -> None:
    assert distinct_names([Path(path) for path in paths], "session.toml") == names


def test_the_same_file_twice_is_refused_however_it_is_written() -> None:
    with pytest.raises(ValueError, match=r"session\.toml is given twice"):
        distinct_names([Path("/r/p1"), Path("/r/p1/../p1/session.toml")], "session.toml")


def a_summary(verdict: str, lower_m: float | None, name: str = "payload") -> dict[str, Any]:
    clearance = {"lower_m": lower_m, "upper_m": 0.0125, "at_least_95_m": None}
    found = {
        "name": name,
        "verdict": verdict,
        "clearance": None if lower_m is None else clearance,
        "depth": {"upper_m": 0.002} if verdict == "colliding" else None,
        "required_clearance_m": 0.005,
        "frames_colliding": 3 if verdict == "colliding" else 0,
        "frames_inside": 0,
        "frames_below_required": 4,
    }
    trusted = verdict != "unknown"
    about = {"report": "r.h5", "trusted": trusted, "frames": 10, "frames_invalid": 1}
    about["kept_rests_on"] = "cam1 having seen nothing in all 9 frames" if lower_m else ""
    return {**about, "objects": [found]}


PAIRS = [
    Pair("p1", "narrow", a_summary("colliding", 0.0)),
    Pair("p1", "wide", a_summary("free", 0.0124)),
    Pair("p2", "narrow", None, "no rig"),
    Pair("p2", "wide", a_summary("unknown", None)),
]


def test_sessions_stand_in_columns_and_layouts_with_their_objects_in_rows() -> None:
    comparison = compare(PAIRS)

    assert comparison["sessions"] == ["p1", "p2"]
    assert comparison["layouts"] == ["narrow", "wide"]
    assert comparison["failed"] == [{"session": "p2", "layout": "narrow", "error": "no rig"}]
    narrow, wide = comparison["rows"]
    assert (narrow["layout"], narrow["object"]) == ("narrow", "payload")
    assert list(narrow["sessions"]) == ["p1"]
    assert wide["sessions"]["p1"]["clearance_lower_m"] == 0.0124
    assert wide["sessions"]["p2"]["clearance_lower_m"] is None


def test_the_table_has_units_and_kinds_and_leaves_unknown_cells_empty(tmp_path: Path) -> None:
    path = tmp_path / "COMPARISON.csv"

    write_comparison(path, compare(PAIRS))

    with path.open(encoding="utf-8", newline="") as file:
        rows = {(row["layout"], row["quantity"]): row for row in csv.DictReader(file)}
    deep, near = rows["narrow", "depth_upper"], rows["wide", "clearance_lower"]
    assert (deep["p1"], deep["p2"], deep["unit"], deep["kind"]) == ("2.0000", "", "mm", "bound")
    assert (near["p1"], near["p2"]) == ("12.4000", "")
    assert rows["wide", "frames_below_required"]["p2"] == "4"
    assert rows["narrow", "verdict"]["p1"] == "colliding"
    assert (rows["wide", "trusted"]["p1"], rows["wide", "trusted"]["p2"]) == ("yes", "no")
    rests_on = rows["wide", "kept_rests_on"]
    assert rests_on["p1"] == "cam1 having seen nothing in all 9 frames"
    assert rests_on["p2"] == ""
    assert list(tmp_path.iterdir()) == [path]


def test_a_table_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    with pytest.raises(ReportError, match=r"COMPARISON\.csv: cannot be written"):
        write_comparison(tmp_path / "nowhere" / "COMPARISON.csv", compare(PAIRS))
