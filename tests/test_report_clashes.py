"""Contacts of a report become clashes: one for each thing; what rules leave out is counted."""

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.clash_reports import STEP_S, SURE, Spot, write_clash_report

from hybridve.calib.pose import rotation_about_axes
from hybridve.hull.agreement.record import NamedCause, SessionAgreement
from hybridve.hull.cad.rules import Rule
from hybridve.hull.report.clashes import KINDS, Clash, Clashes, gather_clashes, rules_of
from hybridve.hull.report.read import read_report

PROJECT = Path(__file__).resolve().parent.parent

#: Two places on the upper side of the box, 8 cm apart.
LEFT, RIGHT = (-0.04, 0.0, 0.5), (0.04, 0.0, 0.5)


def clashes_of(path: Path, **asked: object) -> Clashes:
    return gather_clashes(read_report(path), **asked)  # type: ignore[arg-type]


def only(path: Path) -> Clash:
    (clash,) = clashes_of(path).clashes
    return clash


def test_a_clash_says_when_how_long_how_often_and_how_bad(tmp_path: Path) -> None:
    deep, near = Spot(LEFT, 0.03), Spot(LEFT, -0.004)
    nothing: list[Spot] = []
    frames = [nothing, [near], [Spot(LEFT, 0.01)], [deep], nothing, nothing, nothing, [near]]
    path = write_clash_report(tmp_path / "r.h5", frames, required_m=0.005, first=100)

    clash = only(path)

    assert (clash.name, clash.kind, clash.required_m) == ("box", "clash", 0.005)
    assert clash.frames.tolist() == [101, 102, 103, 107]
    assert (clash.first_s, clash.last_s) == pytest.approx((10.1, 10.7))
    assert clash.dwell_s == pytest.approx(4 * STEP_S)
    assert clash.n_episodes == 2
    assert clash.worst.frame == 103
    assert clash.worst.clearance_m == pytest.approx((-0.0301, -0.03))
    assert clash.worst.at_least_m == pytest.approx(-0.0301 - 1.645e-4)
    assert clash.worst.ends_at == ("cam1",)
    assert clash.worst.n_seeing == 2
    np.testing.assert_allclose(clash.worst.on_object_world, LEFT, atol=1e-12)
    assert clash.is_sure
    assert clash.component == "real"


def test_a_frame_that_nobody_could_read_ends_no_episode(tmp_path: Path) -> None:
    touch = [Spot(LEFT)]
    path = write_clash_report(tmp_path / "r.h5", [touch, None, None, None, None, touch])

    assert only(path).n_episodes == 1


def test_kinds_are_those_of_verdicts_and_the_worst_comes_first(tmp_path: Path) -> None:
    frames = [[Spot(LEFT, -0.002), Spot(RIGHT, 0.01)], [Spot(LEFT, -0.001)]]
    path = write_clash_report(tmp_path / "r.h5", frames, required_m=0.005)

    first, second = clashes_of(path).clashes

    assert (first.kind, second.kind) == ("clash", "too near")
    assert second.worst.frame == 1
    assert second.worst.clearance_m == pytest.approx((0.001, 0.0011))
    assert second.worst.at_least_m == pytest.approx(0.001 - 1.645e-4)


def test_how_deep_is_known_of_the_deepest_of_a_frame_and_bounded_of_others(tmp_path: Path) -> None:
    frames = [[Spot(LEFT, 0.03), Spot(RIGHT, 0.001)]]
    path = write_clash_report(tmp_path / "r.h5", frames)

    first, second = clashes_of(path).clashes

    assert first.worst.clearance_m == pytest.approx((-0.0301, -0.03))
    assert second.worst.clearance_m == pytest.approx((-0.0301, 0.0))


@pytest.mark.parametrize(
    ("doubt", "depth_m", "word"),
    [
        (replace(SURE, component="unsure"), 0.01, "may be a phantom"),
        (replace(SURE, survives=False, hinges_on=("cam2",)), 0.01, "hinges on cam2 alone"),
        (replace(SURE, std_m=0.01), 0.01, "outlines may be off by as much"),
        (replace(SURE, std_m=np.nan), 0.01, "nobody asked"),
    ],
)
def test_what_speaks_against_a_clash_is_told(
    tmp_path: Path, doubt: object, depth_m: float, word: str
) -> None:
    spot = replace(Spot(LEFT, depth_m), doubt=doubt)  # type: ignore[arg-type]
    path = write_clash_report(tmp_path / "r.h5", [[spot], [spot]])

    clash = only(path)

    assert not clash.is_sure
    assert word in " ".join(clash.doubts)


def test_one_frame_that_stands_without_any_camera_is_enough(tmp_path: Path) -> None:
    weak = replace(SURE, survives=False, hinges_on=("cam2",), component="unsure")
    frames = [[replace(Spot(LEFT, 0.02), doubt=weak)], [Spot(LEFT, 0.01)]]
    path = write_clash_report(tmp_path / "r.h5", frames)

    assert only(path).is_sure


def test_a_deviation_of_nothing_in_the_worst_frame_is_not_believed(tmp_path: Path) -> None:
    still = replace(SURE, std_m=0.0)
    frames = [[replace(Spot(LEFT, 0.02), doubt=still)], [replace(Spot(LEFT), doubt=SURE)]]
    path = write_clash_report(tmp_path / "r.h5", frames)

    assert only(path).std_m == SURE.std_m


def test_in_a_session_that_is_not_to_be_trusted_no_clash_is_sure(tmp_path: Path) -> None:
    cause = NamedCause("exchanged", ("cam1", "cam2"), 0, 1, True, "", "exchanged")
    path = write_clash_report(
        tmp_path / "r.h5", [[Spot(LEFT)]], agreement=SessionAgreement(causes=(cause,))
    )

    assert only(path).doubts == ("the cameras contradict each other",)


def test_where_the_part_stands_plays_no_role(tmp_path: Path) -> None:
    turned = np.column_stack([rotation_about_axes((20.0, 40.0, -100.0)), [1.0, -2.0, 0.5]])
    frames = [[Spot(LEFT), Spot(RIGHT, 0.02)]]

    rest, moved = (
        clashes_of(write_clash_report(tmp_path / f"{k}.h5", frames, world_from_mesh=pose)).clashes
        for k, pose in enumerate((np.eye(3, 4), turned))
    )

    assert len(rest) == len(moved) == 2
    for one, other in zip(rest, moved, strict=True):
        np.testing.assert_allclose(one.place.lower, other.place.lower, atol=1e-9)
        np.testing.assert_allclose(one.place.upper, other.place.upper, atol=1e-9)


def test_a_hand_that_goes_along_with_a_part_that_moves_is_one_clash_in_one_place(
    tmp_path: Path,
) -> None:
    poses = [np.column_stack([np.eye(3), [0.3 * frame, 0.0, 0.0]]) for frame in range(5)]
    along = [[Spot(LEFT)]] * 5
    # In the world this one stands still, and the part slides by beneath it.
    beside = [[Spot((LEFT[0] - 0.3 * frame, 0.0, 0.5))] for frame in range(5)]

    with_part = only(write_clash_report(tmp_path / "a.h5", along, poses=poses))
    against = clashes_of(write_clash_report(tmp_path / "b.h5", beside, poses=poses)).clashes

    np.testing.assert_allclose(with_part.around.center[0], [-0.04, 0.0, 0.495], atol=1e-9)
    assert len(with_part.frames) == 5
    assert len(against) > 1


def test_what_only_comes_near_hinges_on_no_camera(tmp_path: Path) -> None:
    weak = replace(SURE, survives=False, hinges_on=("cam2",))
    frames = [[replace(Spot(LEFT, -0.002), doubt=weak)]]
    path = write_clash_report(tmp_path / "r.h5", frames, required_m=0.005)

    assert only(path).hinges_on == ()


def test_rules_leave_out_and_what_they_leave_out_is_counted(tmp_path: Path) -> None:
    frames = [[Spot(LEFT), Spot(RIGHT)], [Spot(LEFT)], [Spot(LEFT)]]
    path = write_clash_report(tmp_path / "r.h5", frames)
    everywhere = Rule(("b*",), ignore=True)
    left = Rule(ignore=True, zone_m=((-0.1, -0.1, 0.4), (0.0, 0.1, 0.6)))
    short = Rule(shortest_s=0.15)
    other = Rule(("lid",), ignore=True)

    def asked(*rules: Rule) -> tuple[int, list[tuple[int, int, int]]]:
        found = clashes_of(path, rules=rules)
        left_out = [(one.number, one.clashes, one.frames) for one in found.left_out]
        return len(found.clashes), left_out

    assert asked() == (2, [])
    assert asked(everywhere) == (0, [(1, 2, 4)])
    assert asked(other, left) == (1, [(2, 1, 3)])
    assert asked(short) == (1, [(1, 1, 1)])
    assert asked(left, short) == (0, [(1, 1, 3), (2, 1, 1)])


def test_a_zone_may_go_along_with_the_object(tmp_path: Path) -> None:
    moved = np.column_stack([np.eye(3), [5.0, 0.0, 0.0]])
    path = write_clash_report(tmp_path / "r.h5", [[Spot(LEFT)]], world_from_mesh=moved)
    zone_m = ((-0.1, -0.1, 0.4), (0.0, 0.1, 0.6))

    of_object = clashes_of(path, rules=[Rule(ignore=True, zone_m=zone_m, zone_in="object")])
    of_world = clashes_of(path, rules=[Rule(ignore=True, zone_m=zone_m)])

    assert len(of_object.clashes) == 0
    assert len(of_world.clashes) == 1


def test_the_rules_of_the_scene_stand_in_the_report(tmp_path: Path) -> None:
    told = {"objects": ["box"], "ignore": True, "zone_in": "world", "shortest_s": 0.0}
    settings = {"rules": [{**told, "comment": "the table"}]}
    path = write_clash_report(tmp_path / "r.h5", [[Spot(LEFT)]], settings=settings)

    assert rules_of(read_report(path)) == (Rule(("box",), ignore=True, comment="the table"),)
    assert clashes_of(path).clashes == ()


def test_a_report_of_version_1_which_has_no_patches_has_its_clashes(tmp_path: Path) -> None:
    path = tmp_path / "v1.h5"
    golden = PROJECT / "data" / "golden" / "report_v1.h5.gz"
    path.write_bytes(gzip.decompress(golden.read_bytes()))
    report = read_report(path)
    expected = {name for name, rows in report.objects.items() if {*KINDS} & {*rows.verdict}}

    found = gather_clashes(report)

    assert expected >= {"hit"}
    assert {clash.name for clash in found.clashes} == expected


def test_a_report_without_a_contact_has_no_clashes(tmp_path: Path) -> None:
    found = clashes_of(write_clash_report(tmp_path / "r.h5", [[], []]))

    assert (found.clashes, found.n_patches) == ((), 0)
