"""The ledger knows clashes again, whatever their numbers do, and keeps what people decided."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from helpers.clash_reports import Spot, write_clash_report
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridve.calib.bounded import has_control
from hybridve.calib.errors import ReportError
from hybridve.hull.report.clashes import gather_clashes
from hybridve.hull.report.ledger import (
    Decision,
    Entry,
    Ledger,
    Listed,
    decided,
    first_id,
    look_up,
    read_ledger,
    write_ledger,
)
from hybridve.hull.report.read import read_report

#: Two places on the upper side of the box, 3 cm of room between them.
LEFT, RIGHT = (-0.025, 0.0, 0.5), (0.025, 0.0, 0.5)


def made(run: int) -> str:
    return (datetime(2026, 1, 1, tzinfo=UTC) + timedelta(days=run)).isoformat()


def list_of(
    folder: Path, ledger: Ledger, run: int, *spots: Spot, report: str = "r.h5"
) -> tuple[Ledger, dict[tuple[float, float, float], Listed]]:
    """Look a run of a report up, two frames of the same; its clashes by where they were put."""
    path = write_clash_report(folder / report, [list(spots)] * 2, made=made(run))
    loaded = read_report(path)
    after, listed = look_up(ledger, gather_clashes(loaded).clashes, loaded)
    assert len(listed) == len(spots)
    by_place = {}
    for spot in spots:
        away_m = [np.abs(one.clash.place.center[0] - spot.at_m).max() for one in listed]
        by_place[spot.at_m] = listed[int(np.argmin(away_m))]
    return after, by_place


def moved(spot: Spot, *by_m: float) -> Spot:
    x, y, z = (a + b for a, b in zip(spot.at_m, by_m, strict=True))
    return replace(spot, at_m=(x, y, z))


@pytest.fixture
def empty(tmp_path: Path) -> Ledger:
    return Ledger(tmp_path / "r.clashes.toml")


@pytest.mark.slow
def test_a_status_and_its_comment_survive_ten_runs_of_places_that_waver(
    tmp_path: Path, empty: Ledger
) -> None:
    rng = np.random.default_rng(1)
    ledger, first = list_of(tmp_path, empty, 0, Spot(LEFT), Spot(RIGHT, 0.02))
    name = first[LEFT].entry.id
    ledger = decided(ledger, [Decision(name, "approved", "anna", "today", 'a "sleeve"\n#1')])
    write_ledger(ledger)

    for run in range(1, 11):
        left, right = (
            moved(spot, *rng.normal(0.0, 0.002, 3)) for spot in (Spot(LEFT), Spot(RIGHT, 0.02))
        )
        ledger, found = list_of(tmp_path, read_ledger(ledger.path), run, left, right)
        write_ledger(ledger)
        assert found[left.at_m].entry.id == name
        assert found[right.at_m].entry.id == first[RIGHT].entry.id
        assert found[left.at_m].ties == ()

    entry = next(one for one in read_ledger(ledger.path).entries if one.id == name)
    assert (entry.status, entry.who, entry.when) == ("approved", "anna", "today")
    assert entry.comment == 'a "sleeve"\n#1'


@pytest.mark.slow
def test_new_becomes_active_in_the_next_run_and_not_by_looking_twice(
    tmp_path: Path, empty: Ledger
) -> None:
    ledger, first = list_of(tmp_path, empty, 0, Spot(LEFT))
    again, twice = list_of(tmp_path, ledger, 0, Spot(LEFT))
    _, later = list_of(tmp_path, again, 1, Spot(LEFT))

    statuses = [found[LEFT].entry.status for found in (first, twice, later)]
    assert statuses == ["new", "new", "active"]
    assert again == ledger


@pytest.mark.slow
def test_what_is_gone_is_resolved_and_found_again_it_is_new(tmp_path: Path, empty: Ledger) -> None:
    ledger, first = list_of(tmp_path, empty, 0, Spot(LEFT), Spot(RIGHT, 0.02))
    name = first[LEFT].entry.id
    ledger = decided(ledger, [Decision(name, "approved", "anna", "today", "fine")])
    gone, _ = list_of(tmp_path, ledger, 1, Spot(RIGHT, 0.02))
    back, found = list_of(tmp_path, gone, 2, Spot(LEFT), Spot(RIGHT, 0.02))

    status = {entry.id: entry.status for entry in gone.entries}
    assert status == {name: "resolved", first[RIGHT].entry.id: "active"}
    assert found[LEFT].entry.id == name
    assert found[LEFT].entry.status == "new"
    assert found[LEFT].entry.comment == "fine"
    assert len(back.entries) == 2


def test_resolved_by_hand_stays_so_until_another_run_finds_it(
    tmp_path: Path, empty: Ledger
) -> None:
    ledger, first = list_of(tmp_path, empty, 0, Spot(LEFT))
    ledger = decided(ledger, [Decision(first[LEFT].entry.id, "resolved", "ben", "now")])
    ledger, same = list_of(tmp_path, ledger, 0, Spot(LEFT))
    _, later = list_of(tmp_path, ledger, 1, Spot(LEFT))

    assert same[LEFT].entry.status == "resolved"
    assert later[LEFT].entry.status == "new"


@pytest.mark.slow
def test_several_reports_share_a_ledger_and_a_clash_is_resolved_when_none_has_it(
    tmp_path: Path, empty: Ledger
) -> None:
    ledger, one = list_of(tmp_path, empty, 0, Spot(LEFT), report="p1.h5")
    ledger, two = list_of(tmp_path, ledger, 0, moved(Spot(LEFT), 0.004, 0, 0), report="p2.h5")
    (other,) = two.values()
    assert other.entry.id == one[LEFT].entry.id
    assert other.entry.status == "new"
    assert other.entry.found_in == ("p1.h5", "p2.h5")

    ledger, _ = list_of(tmp_path, ledger, 1, report="p1.h5")
    assert [entry.status for entry in ledger.entries] == ["new"]
    ledger, _ = list_of(tmp_path, ledger, 1, report="p2.h5")
    assert [entry.status for entry in ledger.entries] == ["resolved"]


def test_a_new_thing_three_centimetres_from_a_known_one_gets_an_id_of_its_own(
    tmp_path: Path, empty: Ledger
) -> None:
    ledger, first = list_of(tmp_path, empty, 0, Spot(LEFT))
    ledger, second = list_of(tmp_path, ledger, 1, Spot(RIGHT))

    assert second[RIGHT].entry.id != first[LEFT].entry.id
    assert second[RIGHT].entry.status == "new"


def test_what_breaks_off_a_known_clash_is_new_and_told_to_lie_beside_it(
    tmp_path: Path, empty: Ledger
) -> None:
    whole = Spot((0.0, 0.0, 0.5), 0.02, size_m=0.12)
    ledger, first = list_of(tmp_path, empty, 0, whole)
    ends = [Spot((-0.05, 0.0, 0.5), 0.02, 0.02), Spot((0.05, 0.0, 0.5), 0.01, 0.02)]
    _, found = list_of(tmp_path, ledger, 1, *ends)

    names = [found[one.at_m].entry.id for one in ends]
    known = first[whole.at_m].entry.id
    assert len(set(names)) == 2
    assert known in names
    new = next(one for one in found.values() if one.entry.id != known)
    assert new.ties == (known,)


@given(st.lists(st.tuples(*[st.integers(-100, 100)] * 3), max_size=30))
def test_first_ids_are_never_shared_and_always_the_same(
    places: list[tuple[float, float, float]],
) -> None:
    def named() -> list[str]:
        taken: list[str] = []
        for place in places:
            taken.append(first_id("a lid", place, set(taken)))
        return taken

    assert len(set(named())) == len(places)
    assert named() == named()
    assert all(name.startswith("a_lid-") for name in named())


#: Any text but halves of letters, and what no file may hold and no option takes.
TEXTS = st.text(st.characters(codec="utf-8"), max_size=20).filter(
    lambda text: not has_control(text)
)

entries = st.builds(
    Entry,
    st.from_regex(r"[a-z0-9._-]{1,12}", fullmatch=True),
    st.from_regex(r"[a-z]([a-z .]*[a-z])?", fullmatch=True),
    st.sampled_from(["new", "active", "reviewed", "approved", "resolved"]),
    st.tuples(*[st.integers(-10000, 10000).map(lambda n: n / 10)] * 3),
    st.tuples(*[st.integers(0, 10000).map(lambda n: n / 10)] * 3),
    TEXTS,
    TEXTS,
    TEXTS,
    st.lists(TEXTS).map(tuple),
)


@pytest.mark.slow
@settings(max_examples=asked(30))
@given(
    entries=st.lists(entries, max_size=4, unique_by=lambda one: one.id),
    runs=st.dictionaries(TEXTS, st.text("0:T-")),
)
def test_a_ledger_is_read_as_it_was_written(
    tmp_path_factory: pytest.TempPathFactory, entries: list[Entry], runs: dict[str, str]
) -> None:
    path = tmp_path_factory.mktemp("ledger") / "r.clashes.toml"
    ordered = tuple(sorted(entries, key=lambda one: one.id))
    ledger = Ledger(path, ordered, tuple(sorted(runs.items())))

    write_ledger(ledger)
    text = path.read_bytes()
    write_ledger(read_ledger(path))

    assert read_ledger(path) == ledger
    assert path.read_bytes() == text


GOOD = (
    'format = "hybridve-clashes"\nversion = 1\n[[clash]]\nid = "lid-k3f7"\nobject = "lid"\n'
    'status = "approved"\nplace_mm = [1, 2, 3]\nsize_mm = [4, 5, 6]\n'
)


def test_a_ledger_may_be_written_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "l.toml"
    path.write_text(GOOD + "when = 2026-12-01\n# mine\n", encoding="utf-8")

    (entry,) = read_ledger(path).entries

    assert entry == Entry("lid-k3f7", "lid", "approved", (1, 2, 3), (4, 5, 6), when="2026-12-01")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("approved", "aproved", "clash.1.status: Input should be 'new', 'active', 'reviewed'"),
        ("status =", "state =", "clash.1.status: this key is missing"),
        ("place_mm = [1, 2, 3]", "place_mm = [1, 2]", "clash.1.place_mm"),
        ("[4, 5, 6]", "[4, -5, 6]", "clash.1.size_mm.2: Input should be greater than or equal"),
        ("version = 1", "version = 2", "version: Input should be 1"),
        ('"lid-k3f7"', '"lid k3f7"', "clash.1.id"),
        ("[[clash]]", "[[clash]", "not valid TOML"),
        ("size_mm = [4, 5, 6]\n", "", "clash.1.size_mm: this key is missing"),
    ],
)
def test_a_ledger_edited_into_nonsense_is_refused_in_one_line(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    path = tmp_path / "l.toml"
    path.write_text(GOOD.replace(old, new), encoding="utf-8")

    with pytest.raises(ReportError) as error:
        read_ledger(path)

    assert str(error.value).startswith(f"{path}: ")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_two_clashes_of_one_id_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "l.toml"
    path.write_text(GOOD + GOOD[GOOD.index("[[") :], encoding="utf-8")

    with pytest.raises(ReportError, match=r"clash\.2\.id: 'lid-k3f7' is the id of clash\.1 too"):
        read_ledger(path)
