"""One recording through the whole chain, on a ball whose place is known in every frame."""

import itertools
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.contacts import contact_at
from helpers.sessions import BALL_RADIUS_M, write_ball_session, write_cube_scene
from hypothesis import given
from hypothesis import strategies as st

from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture.session import load_session
from hybridve.hull.chain import Chain, EvaluateSettings, Standing, make_chain, standing_at
from hybridve.hull.contact.clearance import Clearance
from hybridve.hull.contact.finding import Finding, agreed, signed_clearance
from hybridve.hull.contact.outline_errors import DoubtSettings
from hybridve.hull.contact.respond import ResponseSettings
from hybridve.hull.evaluate import evaluate
from hybridve.hull.query.engine import Engine
from hybridve.hull.query.native import Native
from hybridve.hull.report.columns import PATCH_COLUMNS, TABLES
from hybridve.hull.report.schema import FrameResult

FPS = 25

#: Half the edge of the cube at the origin.
HALF_M = 0.1

#: The ball comes along x, is in the cube in frames 2 to 4, goes and comes back in the last frame.
X_M = np.array([-0.5, -0.35, -0.2, -0.1, -0.25, -0.4, -0.45, -0.15])
CENTERS = np.column_stack([X_M, np.zeros_like(X_M), np.zeros_like(X_M)])

#: A picture of this frame, between the two contacts, is damaged.
DAMAGED = 6

#: Two pixels at the distance of the cameras: the hull of a ball is no bigger than this, metres.
BULGE_M = 2 * 2.3 / 150 + 0.03


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ball")
    path = write_ball_session(folder, CENTERS, n_cameras=6)
    (folder / "cam2" / f"{DAMAGED}.png").write_bytes(b"torn")
    return path


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_cube_scene(
        tmp_path_factory.mktemp("cubes"), {"hit": (0.0, 0.0, 0.0), "beside": (0.0, 400.0, 0.0)}
    )


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    with Native() as native:
        yield native


def chain_of(session: Path, scene: Path, **changes: Any) -> Chain:
    settings = EvaluateSettings(
        viewport=6,
        clearance_m=1e-4,
        response=ResponseSettings(),
        backtrack=True,
        doubt=DoubtSettings(near_m=10.0),
    )
    return make_chain(load_session(session), load_scene(scene), replace(settings, **changes))


@pytest.fixture(scope="module")
def results(session: Path, scene: Path, engine: Engine) -> list[FrameResult]:
    return list(evaluate(chain_of(session, scene), engine))


def bits(result: FrameResult) -> list[object]:
    """Return all that a report keeps of a frame but its timings, comparable to the bit."""
    kept: list[object] = [result.index, result.time_s, result.reason]
    for finding in result.findings:
        for table in TABLES:
            part = table.of(finding)
            kept += [
                None if part is None else np.asarray(column.take(part)).tobytes()
                for column in table.columns
            ]
        hits = finding.contact.hits
        kept += [hits.start.tobytes(), hits.stop.tobytes()]
        kept += [
            np.asarray(column.take(patch)).tobytes()
            for patch in finding.patches
            for column in PATCH_COLUMNS
        ]
    return kept


def hits(results: list[FrameResult]) -> list[Finding | None]:
    return [result.findings[0] if result.is_valid else None for result in results]


@pytest.mark.slow
@pytest.mark.parametrize("skip", range(1, len(CENTERS) + 1))
def test_frames_taken_up_anywhere_are_the_same_to_the_bit(
    session: Path, scene: Path, engine: Engine, results: list[FrameResult], skip: int
) -> None:
    rest = list(evaluate(chain_of(session, scene), engine, skip=skip))

    assert [bits(result) for result in rest] == [bits(result) for result in results[skip:]]


@pytest.mark.slow
@pytest.mark.parametrize("n_at_once", [1, 2, 5])
def test_frames_side_by_side_are_those_one_after_another_to_the_bit(
    session: Path, scene: Path, results: list[FrameResult], n_at_once: int
) -> None:
    with Native(1) as engine:
        found = list(evaluate(chain_of(session, scene), engine, n_at_once=n_at_once))

    assert [bits(result) for result in found] == [bits(result) for result in results]


@pytest.mark.slow
def test_an_error_in_one_of_the_frames_side_by_side_ends_them_all(
    session: Path, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(chain: Chain, index: int) -> Standing:
        if index == 3:
            raise MemoryError("no room")
        return standing_at(chain, index)

    monkeypatch.setattr("hybridve.hull.evaluate.standing_at", failing)
    found: list[int] = []
    with Native(1) as engine:
        results = evaluate(chain_of(session, scene), engine, n_at_once=3)
        indices = (result.index for result in results)
        with pytest.raises(MemoryError, match="no room"):
            found.extend(indices)

    assert found == [0, 1, 2]
    assert not [one.name for one in threading.enumerate() if one.name.startswith("frame")]


def test_contact_begins_where_the_object_was_free_a_frame_before(
    results: list[FrameResult],
) -> None:
    found = hits(results)

    touches = [None if f is None else f.touches for f in found]
    assert touches == [False, False, True, True, True, False, None, True]
    entered = [f is not None and f.first_contact is not None for f in found]
    # The last contact comes after a frame that could not be read: nobody saw it begin.
    assert entered == [False, False, True, False, False, False, False, False]
    entry = found[2]
    assert entry is not None
    assert entry.first_contact is not None
    # The ball meets the cube at x = -0.3, a third of the way; its hull is bigger and earlier.
    late_s = (1 + 1 / 3) / FPS
    early_s = late_s - BULGE_M / 0.15 / FPS
    assert early_s < entry.first_contact_s < late_s + 0.1 / FPS
    assert 0.5 / FPS <= entry.first_contact_uncertainty_s <= 1 / FPS
    np.testing.assert_allclose(np.abs(entry.first_contact.point_world).max(), HALF_M, atol=1e-9)


@pytest.mark.slow
def test_backtracking_begins_the_response_at_the_first_contact(
    session: Path, scene: Path, engine: Engine, results: list[FrameResult]
) -> None:
    plain = hits(list(evaluate(chain_of(session, scene, backtrack=False), engine)))
    found = hits(results)

    for row, (with_it, without) in enumerate(zip(found, plain, strict=True)):
        if with_it is None or without is None or with_it.response is None:
            continue
        assert without.response is not None
        first = with_it.first_contact
        if first is not None:
            np.testing.assert_array_equal(with_it.response.cp_obj_world, first.point_world)
            assert (with_it.response.cp_obj_world != without.response.cp_obj_world).any()
        else:
            np.testing.assert_array_equal(
                with_it.response.cp_obj_world, without.response.cp_obj_world, f"row {row}"
            )
    assert sum(f is not None and f.response is not None for f in found) == 4


def test_only_what_is_touched_must_give(results: list[FrameResult]) -> None:
    for finding in (f for result in results for f in result.findings):
        assert (finding.response is not None) == finding.touches


def test_clearance_is_that_of_the_ball_less_the_bulge_of_its_hull(
    results: list[FrameResult],
) -> None:
    for finding, x_m in zip(hits(results), X_M, strict=True):
        if finding is None:
            continue
        assert finding.clearance is not None
        true_m = max(0.0, abs(x_m) - HALF_M - BALL_RADIUS_M)
        assert finding.clearance.lower_m <= true_m + 1e-9
        assert finding.clearance.upper_m >= true_m - BULGE_M
        assert finding.clearance.upper_m - finding.clearance.lower_m <= 1e-4 + 1e-9
        if finding.touches:
            assert finding.clearance.upper_m == 0.0
        assert finding.doubt is not None
        # The real ball is no farther away than this.
        assert finding.doubt.real_upper_m >= true_m - 1e-9


def test_the_speed_of_approach_is_what_the_signed_clearance_changed_by(
    results: list[FrameResult],
) -> None:
    found = hits(results)
    assert np.isnan(found[0].approach_m_s).all()  # type: ignore[union-attr]

    for before, after in itertools.pairwise(found):
        if after is None:
            continue
        if before is None:
            assert np.isnan(after.approach_m_s).all()
            continue
        assert before.clearance is not None
        assert after.clearance is not None
        was, became = signed_clearance(before.clearance), signed_clearance(after.clearance)
        np.testing.assert_allclose(
            after.approach_m_s, ((was[0] - became[1]) * FPS, (was[1] - became[0]) * FPS)
        )
    # From frame 0 to 1 the ball comes by 0.15 m in 1/25 s, and its hull does so within its bulge.
    assert found[1] is not None
    lower, upper = found[1].approach_m_s
    assert lower - 1.0 < 0.15 * FPS < upper + 1.0
    assert 0 <= upper - lower < 2.1e-4 * FPS


def test_a_hull_that_comes_from_nowhere_has_no_speed(
    tmp_path: Path, scene: Path, engine: Engine
) -> None:
    session = write_ball_session(tmp_path, CENTERS[:4])
    for folder in tmp_path.glob("cam*"):  # nobody saw anything
        cv2.imwrite(str(folder / "1.png"), np.zeros((120, 160), np.uint8))

    found = hits(list(evaluate(chain_of(session, scene, doubt=None), engine)))

    assert found[1] is not None
    assert found[1].clearance is not None
    assert np.isposinf(found[1].clearance.upper_m)
    known = [f is not None and bool(np.isfinite(f.approach_m_s).all()) for f in found]
    assert known == [False, False, False, True]
    # It was free, and then it was touched: contact began, but nothing tells when.
    assert found[2] is not None
    assert found[2].first_contact is not None
    assert found[2].first_contact.status == "outline lost"
    assert found[2].first_contact_uncertainty_s == 0.5 / FPS


@pytest.mark.slow
def test_something_wholly_inside_a_closed_object_is_told_and_in_an_open_one_is_not(
    tmp_path: Path, session: Path, engine: Engine
) -> None:
    scene = write_cube_scene(tmp_path, {"room": (0.0, 0.0, 0.0)})
    mesh = (tmp_path / "cube.obj").read_text(encoding="utf-8")
    (tmp_path / "cube.obj").write_text(mesh.replace("100", "800"), encoding="utf-8")
    holed = write_cube_scene(tmp_path / "holed", {"room": (0.0, 0.0, 0.0)})
    lines = mesh.replace("100", "800").splitlines()
    (tmp_path / "holed" / "cube.obj").write_text("\n".join(lines[:-1]) + "\n", encoding="utf-8")

    closed_chain, open_chain = (chain_of(session, path, doubt=None) for path in (scene, holed))
    inside = next(evaluate(closed_chain, engine)).findings[0]
    unknown = next(evaluate(open_chain, engine)).findings[0]

    # The ball's centre is 0.3 m from the nearest wall, and the hull contains the ball.
    assert not inside.touches
    assert inside.is_inside
    assert inside.clearance is not None
    assert inside.clearance.upper_m == 0.0
    assert inside.clearance.depth_upper_m >= 0.3 - 1e-9
    assert unknown.clearance is not None
    assert not unknown.is_inside
    assert np.isnan(unknown.clearance.depth_upper_m)
    assert unknown.clearance.lower_m > 0.0


def test_what_is_not_asked_for_is_not_computed(session: Path, scene: Path, engine: Engine) -> None:
    chain = chain_of(session, scene, clearance_m=None, response=None, backtrack=False)

    for result in evaluate(chain, engine):
        for finding in result.findings:
            assert finding.clearance is None
            assert finding.response is None
            assert finding.doubt is None
            assert np.isnan(finding.approach_m_s).all()


NOWHERE = np.full(3, np.nan)
SOMEWHERE = np.array([1.0, 2.0, 3.0])
POINTS = np.ones((1, 3))


def a_clearance(lower_m: float, upper_m: float, depth_m: tuple[float, float]) -> Clearance:
    return Clearance(lower_m, upper_m, -SOMEWHERE, SOMEWHERE / 2, *depth_m)


def test_a_witness_makes_the_clearance_nought() -> None:
    contact = contact_at(POINTS, "colliding", witness_world=SOMEWHERE)

    shallow = agreed(contact, a_clearance(0.0, 5e-5, (0.0, 2e-5)))[1]
    deep = agreed(contact, a_clearance(0.0, 0.0, (0.01, 0.02)))[1]

    assert (shallow.lower_m, shallow.upper_m) == (0.0, 0.0)
    np.testing.assert_array_equal(shallow.on_object_world, SOMEWHERE)
    np.testing.assert_array_equal(shallow.on_hull_world, SOMEWHERE)
    assert (deep.depth_lower_m, deep.depth_upper_m) == (0.01, 0.02)
    np.testing.assert_array_equal(deep.on_hull_world, SOMEWHERE / 2)


@pytest.mark.parametrize("certificate", ["", "open"])
def test_a_clearance_above_nought_proves_an_object_free(certificate: Any) -> None:
    contact = contact_at(POINTS, certificate, open_at_m=1e-4)

    proved = agreed(contact, a_clearance(1e-6, 1e-4, (0.0, 0.0)))[0]
    still = agreed(contact, a_clearance(0.0, 1e-4, (0.0, 0.0)))[0]

    assert proved.certificate == "free"
    assert not proved.collides
    assert np.isnan(proved.open_at_m)
    assert still is contact


@given(
    lower_m=st.floats(0, 1), width_m=st.floats(0, 1), depth_m=st.floats(0, 1), closed=st.booleans()
)
def test_signed_clearance_is_in_order_and_open_below_where_depth_is_not_known(
    lower_m: float, width_m: float, depth_m: float, closed: bool
) -> None:
    touches = lower_m < 0.5
    lower_m = 0.0 if touches else lower_m
    depths_m = (0.0, depth_m if touches else 0.0) if closed else (np.nan, np.nan)

    signed = signed_clearance(a_clearance(lower_m, lower_m + width_m, depths_m))

    assert signed[0] <= signed[1]
    assert np.isneginf(signed[0]) == (touches and not closed)
