"""Which frame of a report one looks at first, and what it says of it."""

from pathlib import Path

import numpy as np
import pytest
from helpers.clash_reports import Spot, write_clash_report

from hybridve.calib.errors import ReportError
from hybridve.hull.report.moment import moment_of, named_objects, worst_frame
from hybridve.hull.report.read import read_report

#: On the upper side of the box.
TOP = (0.0, 0.0, 0.5)


def test_the_frame_of_the_worst_clash_is_looked_at_first(tmp_path: Path) -> None:
    frames = [[Spot(TOP, -0.01)], [Spot(TOP, 0.01)], [Spot(TOP, 0.03)], [Spot(TOP, 0.02)]]
    report = read_report(write_clash_report(tmp_path / "r.h5", frames, first=100))

    assert worst_frame(report) == 102


def test_where_nothing_is_touched_it_is_the_frame_with_least_room(tmp_path: Path) -> None:
    """Violated throughout, and never touched: most collision points would say frame 100."""
    gaps_m = [0.030, 0.020, 0.004, 0.015]
    frames = [[Spot(TOP, -gap_m)] for gap_m in gaps_m]
    near = read_report(write_clash_report(tmp_path / "a.h5", frames, required_m=0.05, first=100))
    kept = read_report(write_clash_report(tmp_path / "b.h5", frames, required_m=0.001, first=100))

    assert near.objects["box"].verdict.tolist() == ["too near"] * 4
    assert kept.objects["box"].verdict.tolist() == ["kept"] * 4
    assert worst_frame(near) == 102
    assert worst_frame(kept) == 102


def test_a_moment_says_the_verdict_with_its_number_and_between_which_points(tmp_path: Path) -> None:
    frames = [[Spot(TOP, -0.004)], [Spot(TOP, 0.02)], None]
    report = read_report(write_clash_report(tmp_path / "r.h5", frames, required_m=0.005, first=7))

    near, deep, torn = (moment_of(report, index) for index in (7, 8, 9))

    assert near is not None
    assert near.text() == "box too near: 4.1 +-0.1 mm"
    assert near.time_s == pytest.approx(0.7)
    np.testing.assert_allclose(near.objects[0].on_object_world, TOP, atol=1e-9)
    assert deep is not None
    assert deep.text() == "box clash: 20.1 +-0.1 mm deep"
    assert torn is not None
    assert torn.text() == "not evaluated: torn"
    assert moment_of(report, 10) is None


def test_a_name_means_its_parts_and_no_name_is_told_what_there_is(tmp_path: Path) -> None:
    path = write_clash_report(tmp_path / "r.h5", [[Spot(TOP)]], name="rack.bolt")
    report = read_report(path)

    assert named_objects(report, "rack") == ("rack.bolt",)
    assert named_objects(report, "*bolt") == ("rack.bolt",)
    with pytest.raises(ReportError, match=r"no object 'rac'; it has rack\.bolt"):
        named_objects(report, "rac")
