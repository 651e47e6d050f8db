"""The replay of recordings for all shifts at once, on balls that come near a cube."""

from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from helpers.sessions import write_ball_session, write_cube_scene

from hybridve.calib.errors import ReportError, SceneError, SessionError
from hybridve.hull.cad.scene import Scene, load_scene
from hybridve.hull.capture.recording import FrameRange, silhouettes_of
from hybridve.hull.capture.session import load_session
from hybridve.hull.chain import Chain, EvaluateSettings, make_chain
from hybridve.hull.contact.outline_errors import DoubtSettings
from hybridve.hull.contact.spacing import Move, covers, union
from hybridve.hull.query.silhouettes import make_hull
from hybridve.hull.report.machine import Run
from hybridve.hull.report.spacing_file import (
    SessionSpacing,
    Spacing,
    SpacingDoubt,
    make_stretches,
    read_spacing,
    spacing_as_dict,
    write_spacing,
)
from hybridve.hull.spacing import Layout, replay, shifts_of

#: Comes nearer, is nearest in frame 2, and goes.
CENTERS = np.array([[x, 0.0, 0.0] for x in (-0.3, 0.0, 0.1, 0.05, -0.4)])

MOVE = Move(np.array([1.0, 0.0, 0.0]), -0.1, 0.6, 2e-3)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    # The face of the part is at x = 0.2; the post is in the ball's way.
    places = {"part": (300.0, 0.0, 0.0), "post": (-300.0, 0.0, 200.0), "far": (0.0, 0.0, 900.0)}
    return load_scene(write_cube_scene(tmp_path_factory.mktemp("cubes"), places))


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory, scene: Scene) -> Chain:
    session = write_ball_session(tmp_path_factory.mktemp("ball"), CENTERS, n_cameras=5)
    return make_chain(load_session(session), scene, EvaluateSettings())


@pytest.fixture(scope="module")
def layout(scene: Scene) -> Layout:
    return Layout.of(scene, ["part"], MOVE, 0.01)


@pytest.fixture(scope="module")
def found(chain: Chain, layout: Layout) -> SessionSpacing:
    return replay("ball", chain, layout, shifts_of(MOVE))


def test_the_shift_found_keeps_the_clearance_in_every_frame_and_a_smaller_one_does_not(
    chain: Chain, layout: Layout, found: SessionSpacing
) -> None:
    frames = silhouettes_of(
        chain.session, None, chain.settings.frames, undistortions=chain.undistortions
    )
    hulls = [make_hull(chain.views, frame.masks or []) for frame in frames]
    (part,) = layout.moved

    def signed(shift_m: float) -> list[tuple[float, float]]:
        by = shift_m * MOVE.direction
        return [part.meter.measure(hull, by).signed_m for hull in hulls]

    at_answer = signed(found.shift_m)
    assert min(low for low, _ in at_answer) >= 0.01 - 1e-3
    assert min(high for _, high in at_answer) >= 0.01
    assert found.shift_m - MOVE.tolerance_m < found.at_least_m <= found.shift_m
    below = signed(found.at_least_m - 1e-6)
    assert min(low for low, _ in below) < 0.01
    # The ball's centre comes to 0.1 and its hull reaches a radius farther, or somewhat more.
    assert 0.1 + 0.01 - 0.02 < found.shift_m < 0.1 + 0.01 + 0.06
    assert found.free_m.tolist() == [[found.shift_m, MOVE.stop_m]]


def test_wider_outlines_need_more_room_and_block_what_was_blocked(
    chain: Chain, layout: Layout, found: SessionSpacing
) -> None:
    """A grown hull holds the hull, so that every shift it lets be, the other does too."""
    before = found
    for grow_px in (1, 3):
        wider = replay("wider", chain, layout, shifts_of(MOVE), grow_px=grow_px)
        for row in range(len(CENTERS)):
            blocked = before.frames.violated.of(row)
            middles_m = blocked.mean(axis=1)
            assert covers(
                union(wider.frames.violated.of(row), wider.frames.undecided.of(row)), middles_m
            ).all()
        assert wider.shift_m > before.shift_m + 1e-3
        before = wider


def test_the_frame_that_decides_is_the_one_that_comes_nearest(found: SessionSpacing) -> None:
    binding = found.binding
    assert binding is not None
    assert (binding.frame, binding.time_s, binding.object_name) == (2, 2 / 25, "part")
    assert binding.shift_m == found.shift_m
    assert binding.required_m == 0.01
    low, high = binding.clearance_m
    assert 0.01 - 1e-3 < low <= high < 0.01 + MOVE.tolerance_m
    between = np.linalg.norm(binding.on_hull_world - binding.on_object_world)
    assert between == pytest.approx(high, abs=1e-9)
    assert binding.on_object_world[0] == pytest.approx(0.2 + found.shift_m, abs=1e-9)


def test_the_recording_is_what_its_frames_are_one_by_one(
    chain: Chain, layout: Layout, found: SessionSpacing
) -> None:
    shifts_m = found.curve.shift_m
    together = np.zeros(len(shifts_m), np.int64)
    alone = []
    for number in range(len(CENTERS)):
        settings = replace(chain.settings, frames=FrameRange(number, number + 1))
        one = replay("one", replace(chain, settings=settings), layout, shifts_m)
        np.testing.assert_array_equal(one.frames.violated.shift_m, found.frames.violated.of(number))
        together += one.curve.violated
        alone.append(one.shift_m)
    np.testing.assert_array_equal(found.curve.violated, together)
    assert found.shift_m == max(alone)
    assert (found.curve.violated > 0).any()
    blocked = union(*(found.frames.violated.of(row) for row in range(len(CENTERS))))
    np.testing.assert_array_equal(covers(blocked, shifts_m), found.curve.violated > 0)
    assert found.at_zero == (int(found.curve.violated[np.abs(shifts_m).argmin()]), 0)


@pytest.fixture(scope="module")
def doubted(chain: Chain, layout: Layout) -> tuple[Chain, SessionSpacing]:
    settings = replace(chain.settings, doubt=DoubtSettings(segmentation_px=0.5))
    doubting = replace(chain, settings=settings)
    return doubting, replay("ball", doubting, layout, shifts_of(MOVE))


def test_doubt_adds_room_and_changes_nothing_that_is_proved(
    found: SessionSpacing, doubted: tuple[Chain, SessionSpacing]
) -> None:
    _, with_doubt = doubted
    assert found.doubt is None
    assert (with_doubt.shift_m, with_doubt.at_least_m) == (found.shift_m, found.at_least_m)
    np.testing.assert_array_equal(with_doubt.free_m, found.free_m)
    for name in ("violated", "undecided"):
        np.testing.assert_array_equal(
            getattr(with_doubt.frames, name).shift_m, getattr(found.frames, name).shift_m
        )
    doubt = with_doubt.doubt
    assert doubt is not None
    assert doubt.frame == 2
    row = with_doubt.frames.index.tolist().index(2)
    assert doubt.std_m == doubt.std_by_frame_m[row]
    # A pixel is 13 mm wide there. The wall is the cube's face, across the move.
    assert 0.003 < doubt.std_m < 0.03
    added_m = doubt.shift_m - found.shift_m
    assert added_m == pytest.approx(1.645 * doubt.std_m, abs=2 * MOVE.tolerance_m)


def test_the_recording_needs_at_95_percent_what_the_worst_of_its_frames_does(
    doubted: tuple[Chain, SessionSpacing], layout: Layout
) -> None:
    doubting, together = doubted
    assert together.doubt is not None
    alone = []
    for number in range(len(CENTERS)):
        settings = replace(doubting.settings, frames=FrameRange(number, number + 1))
        one = replay("one", replace(doubting, settings=settings), layout, shifts_of(MOVE)).doubt
        assert one is not None
        np.testing.assert_array_equal(one.unsure.shift_m, together.doubt.unsure.of(number))
        alone.append(one.shift_m)
    assert together.doubt.shift_m == max(alone)


def test_where_no_shift_suffices_at_95_percent_that_is_told(
    chain: Chain, scene: Scene, found: SessionSpacing
) -> None:
    move = replace(MOVE, stop_m=found.shift_m + 0.003)
    settings = replace(chain.settings, doubt=DoubtSettings())
    layout = Layout.of(scene, ["part"], move, 0.01)

    short = replay("ball", replace(chain, settings=settings), layout, shifts_of(move))

    assert short.shift_m == pytest.approx(found.shift_m, abs=MOVE.tolerance_m)
    assert short.doubt is not None
    assert np.isnan(short.doubt.shift_m)
    assert short.doubt.frame in (1, 2, 3)


def test_a_camera_that_looks_aside_abstains_where_the_session_says_so(
    tmp_path: Path, scene: Scene
) -> None:
    """With ``unseen = "keep"`` it is as if it were not there; else no hull can be: refused."""
    places = {}
    for name, extra in (("carve", ""), ("keep", 'unseen = "keep"\nmin_cameras = 3')):
        path = write_ball_session(tmp_path / name, CENTERS[1:3], n_cameras=5, extra=extra)
        places[name] = path
        rows = (path.parent / "rig.csv").read_text(encoding="utf-8").splitlines()
        told = np.array(rows[0].split(",")[1:], np.float64).reshape(3, 4)
        told[0] += 3000.0 * told[2]  # its image is far to the side of all that happens
        rows[0] = ",".join(["cam0", *(repr(float(value)) for value in told.ravel())])
        (path.parent / "rig.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
        for number in range(2):
            blank = np.zeros_like(cv2.imread(str(path.parent / "cam0" / f"{number}.png"), 0))
            cv2.imwrite(str(path.parent / "cam0" / f"{number}.png"), blank)
    others = write_ball_session(tmp_path / "others", CENTERS[1:3], n_cameras=5)
    text = others.read_text(encoding="utf-8")
    others.write_text(
        text.replace('[[camera]]\nname = "cam0"\nmasks = "cam0/*.png"\n', ""), "utf-8"
    )
    places["others"] = others
    answers = {}
    with pytest.raises(SessionError, match="cam0 and cam1"):
        make_chain(load_session(places.pop("carve")), scene, EvaluateSettings())
    for name, path in places.items():
        chain = make_chain(load_session(path), scene, EvaluateSettings(doubt=DoubtSettings(0.5)))
        answers[name] = replay(name, chain, Layout.of(scene, ["part"], MOVE, 0.01), shifts_of(MOVE))

    kept, alone = answers["keep"], answers["others"]
    assert 0.1 < kept.shift_m == alone.shift_m
    assert kept.doubt is not None
    assert alone.doubt is not None
    assert kept.shift_m < kept.doubt.shift_m
    # The camera that abstains errs without effect.
    assert kept.doubt.std_m == pytest.approx(alone.doubt.std_m, rel=1e-6)
    assert kept.settings["unseen"] == "keep"


def test_objects_that_stay_are_counted_where_they_stand(found: SessionSpacing) -> None:
    violated, undecided = found.standing["post"]
    assert 1 <= violated < len(CENTERS)
    assert undecided == 0
    assert found.standing["far"] == (0, 0)
    assert "part" not in found.standing


def test_where_no_shift_is_free_the_worst_frame_at_the_end_is_told(
    chain: Chain, scene: Scene
) -> None:
    move = replace(MOVE, stop_m=0.05)

    found = replay("ball", chain, Layout.of(scene, ["part"], move, 0.01), shifts_of(move))

    assert np.isnan(found.shift_m)
    assert np.isnan(found.at_least_m)
    assert len(found.free_m) == 0
    assert found.binding is not None
    assert found.binding.frame == 2
    assert found.binding.shift_m == 0.05
    assert found.binding.clearance_m[1] < 0.01


def test_where_the_first_shift_is_free_nothing_decides(chain: Chain, scene: Scene) -> None:
    move = replace(MOVE, start_m=0.3)

    found = replay("ball", chain, Layout.of(scene, ["part"], move), shifts_of(move))

    assert found.shift_m == found.at_least_m == 0.3
    assert found.binding is None
    assert found.at_zero is None
    assert not found.curve.violated.any()


def test_an_object_takes_the_clearance_of_the_scene_unless_told_otherwise(scene: Scene) -> None:
    objects = tuple(replace(one, required_clearance_m=0.03) for one in scene.objects)
    asking = replace(scene, objects=objects)

    assert [one.clearance_m for one in Layout.of(asking, ["part"], MOVE).moved] == [0.03]
    override = Layout.of(asking, ["far", "part"], MOVE, 0.0)
    assert override.moved_names == ("part", "far")
    assert [one.clearance_m for one in override.moved] == [0.0, 0.0]
    assert [one.clearance_m for one in override.standing] == [0.03]


def test_frames_that_a_camera_lacks_are_left_out(tmp_path: Path, scene: Scene) -> None:
    session = write_ball_session(tmp_path, CENTERS, n_cameras=5)
    (tmp_path / "cam1" / "2.png").write_bytes(b"no picture")
    chain = make_chain(load_session(session), scene, EvaluateSettings())
    layout = Layout.of(scene, ["part"], MOVE, 0.01)

    found = replay("ball", chain, layout, shifts_of(MOVE))

    assert found.frames.n_valid == len(CENTERS) - 1
    assert "cam1" in found.frames.reason[2]
    assert found.binding is not None
    assert found.binding.frame == 3
    nothing = replace(chain, settings=replace(chain.settings, frames=FrameRange(2, 3)))
    with pytest.raises(SessionError, match="none of the frames 2:3:1 can be evaluated"):
        replay("ball", nothing, layout, shifts_of(MOVE))


def test_what_is_written_is_read_back(
    tmp_path: Path, found: SessionSpacing, doubted: tuple[Chain, SessionSpacing]
) -> None:
    path = tmp_path / "spacing.h5"
    unbound = replace(found, name="other", binding=None, at_zero=None, shift_m=np.nan, standing={})
    n_frames = len(found.frames.index)
    nowhere = SpacingDoubt(
        np.nan, None, np.nan, make_stretches([np.zeros((0, 2))] * n_frames),
        np.full(n_frames, np.nan),
    )  # fmt: skip
    _, with_doubt = doubted
    with_doubt = replace(with_doubt, name="doubted")
    none_doubted = replace(found, name="nowhere", doubt=nowhere)
    spacing = Spacing(
        Run("hybridve spacing", "a machine", {"numpy": "2"}, "2003-04-27"), {"move": ["part"]},
        (found, unbound, with_doubt, none_doubted),
    )  # fmt: skip

    write_spacing(path, spacing)

    assert spacing_as_dict(read_spacing(path)) == spacing_as_dict(spacing)
    assert read_spacing(path).run.versions == {"numpy": "2"}
    assert list(tmp_path.iterdir()) == [path]
    with h5py.File(path, "r+") as file:
        missing: list[str] = []
        file.visititems(
            lambda name, one: (
                missing.append(name)
                if isinstance(one, h5py.Dataset)
                and not {"unit", "description", "kind"} <= set(one.attrs)
                else None
            )
        )
        assert missing == []
        estimated = file["sessions/doubted/at_95"]
        assert estimated.attrs["kind"] == estimated["unsure/shift_m"].attrs["kind"] == "estimate"
        assert file["sessions/doubted"].attrs["kind"] == "bound"
        assert "at_95" not in file["sessions/ball"]  # as of a file that knows of no doubt
        file.attrs["version"] = 2
    with pytest.raises(ReportError, match="spacing version 2, this hybridve reads 1"):
        read_spacing(path)
    path.write_bytes(b"nothing")
    with pytest.raises(ReportError, match="not a readable spacing"):
        read_spacing(path)
    with pytest.raises(ReportError, match="there is no such spacing"):
        read_spacing(tmp_path / "none.h5")


def test_a_curve_has_both_ends_of_the_range() -> None:
    assert shifts_of(MOVE, 0.3).tolist() == pytest.approx([-0.1, 0.2, 0.5, 0.6])
    assert shifts_of(MOVE, 9.0).tolist() == [-0.1, 0.6]
    assert len(shifts_of(MOVE)) == 201
    with pytest.raises(SceneError, match="take longer steps"):
        shifts_of(MOVE, 1e-9)
