"""Objects that move, through the whole chain: as if the scene had been at rest, frame by frame."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.hulls import ball_hull, random_masks, random_views, ring_views, sphere_mesh
from helpers.motions import angles_csv, pose_of, poses_csv, with_keys
from helpers.sessions import ring_matrix, write_ball_session, write_cube_scene
from helpers.thorough import some_of
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from vtkmodules.vtkIOHDF import vtkHDFReader

from hybridve.calib.errors import SceneError, SessionError
from hybridve.calib.pose import (
    Pose,
    angle_between,
    compose,
    invert,
    placed,
    rotation_about_axes,
    rotation_of,
    transform,
)
from hybridve.cli.progress import Terminal
from hybridve.hull.about import about_objects, resolved_settings
from hybridve.hull.batch import DetectSettings, write_report
from hybridve.hull.cad.motion import Motion
from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture.recording import FrameRange
from hybridve.hull.capture.session import load_session
from hybridve.hull.chain import Chain, EvaluateSettings, hulls, make_chain, standing_at
from hybridve.hull.contact.clearance import Clearance, ClearanceMeter
from hybridve.hull.contact.detect import make_body
from hybridve.hull.contact.finding import Finding
from hybridve.hull.contact.outline_errors import DoubtSettings
from hybridve.hull.contact.respond import ResponseSettings
from hybridve.hull.contact.spacing import Move, covers
from hybridve.hull.evaluate import evaluate
from hybridve.hull.query.certify import COLLIDING, Certifier, certify_triangles
from hybridve.hull.query.engine import Engine
from hybridve.hull.query.native import Native
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import make_hull, seen_from
from hybridve.hull.report import write
from hybridve.hull.report.read import read_points, read_report
from hybridve.hull.report.schema import FrameResult
from hybridve.hull.show import draw_cameras, draw_scene, take_shot
from hybridve.hull.spacing import Layout, replay, shifts_of
from hybridve.hull.sweep.experiment import run_sweep
from hybridve.hull.sweep.frames import read_hulls
from hybridve.hull.sweep.judgement import make_rows
from hybridve.hull.sweep.room import EngineRoom

#: The ball goes slowly; the cube comes to it, turning, is in it, and leaves.
CENTERS = np.array([[0.01 * frame, 0.0, 0.0] for frame in range(7)])
ANGLES_DEG = {frame: (10.0 * frame, -7.0 * frame, 25.0 * frame) for frame in range(7)}
PLACES_M = {
    0: (0.8, 0.1, 0.05),
    1: (0.5, 0.05, 0.0),
    2: (0.27, 0.02, 0.0),
    3: (0.1, 0.0, -0.05),
    5: (0.36, -0.1, 0.0),
    6: (0.75, -0.3, 0.1),
}

#: In this frame the tracker was lost.
LOST = 4

#: Where the scene places the cube in its own moving frame.
REST_M = np.array([0.05, -0.02, 0.03])

POSES = {
    frame: pose_of(rotation_about_axes(ANGLES_DEG[frame]), place)
    for frame, place in PLACES_M.items()
}

#: RP_obj is not in the middle, so that no two corners are equally far from it.
KEYS = "required_clearance_mm = 50\nreference_point_mm = [13, -5, 8]"

#: Bounds of clearances are this far apart at most.
TOLERANCE_M = 1e-4

SETTINGS = EvaluateSettings(
    viewport=9,
    clearance_m=TOLERANCE_M,
    response=ResponseSettings(),
    doubt=DoubtSettings(),
)

#: Poses of CSV files, of rotations of vectors and of composition agree to so much, metres.
ROUNDING_M = 1e-12


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ball_session(tmp_path_factory.mktemp("ball"), CENTERS)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cube that moves."""
    folder = tmp_path_factory.mktemp("moving")
    still = write_cube_scene(folder, {"cube": tuple((1e3 * REST_M).tolist())})
    (folder / "poses.csv").write_text(poses_csv(POSES), encoding="utf-8")
    return with_keys(still, 'poses = "poses.csv"\n' + KEYS)


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    with Native() as native:
        yield native


def chain_of(session: Path, scene: Path, **changes: Any) -> Chain:
    return make_chain(load_session(session), load_scene(scene), replace(SETTINGS, **changes))


@pytest.fixture(scope="module")
def chain(session: Path, scene: Path) -> Chain:
    return chain_of(session, scene)


@pytest.fixture(scope="module")
def results(chain: Chain, engine: Engine) -> list[FrameResult]:
    return list(evaluate(chain, engine))


def at_rest(folder: Path, frame: int, name: str = "cube") -> Path:
    """Write the scene in which the cube rests where it was in a frame."""
    place_mm = 1e3 * transform(POSES[frame], REST_M[None])[0]
    still = write_cube_scene(folder / f"at{frame}", {name: tuple(place_mm.tolist())})
    return with_keys(still, f"rotate_deg = {list(ANGLES_DEG[frame])}\n{KEYS}")


def sorted_rows(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points in an order that rounding does not change."""
    rounded = points.round(9)
    return points[np.lexsort(rounded.T)]


def assert_same_clearance(
    found: Clearance | None, expected: Clearance | None, rounding_m: float = ROUNDING_M
) -> None:
    """Both hold the true distance, and are as narrow as was asked."""
    assert found is not None
    assert expected is not None
    for lower, upper in (("lower_m", "upper_m"), ("depth_lower_m", "depth_upper_m")):
        mine = getattr(found, lower), getattr(found, upper)
        other = getattr(expected, lower), getattr(expected, upper)
        assert mine[0] <= other[1] + rounding_m
        assert other[0] <= mine[1] + rounding_m
        assert mine[1] - mine[0] <= TOLERANCE_M + rounding_m


def assert_same_finding(found: Finding, expected: Finding) -> None:
    """All that is said of an object in a frame by itself agrees."""
    assert (found.verdict, found.contact.certificate) == (
        expected.verdict,
        expected.contact.certificate,
    )
    assert found.contact.triangles().tolist() == expected.contact.triangles().tolist()
    points, triangle = found.contact.points()
    others, of_other = expected.contact.points()
    np.testing.assert_allclose(sorted_rows(points), sorted_rows(others), atol=ROUNDING_M)
    assert np.sort(triangle).tolist() == np.sort(of_other).tolist()
    assert_same_clearance(found.clearance, expected.clearance)
    assert (found.response is None) == (expected.response is None)
    if found.response is not None and expected.response is not None:
        for name in (
            "cp_obj_world",
            "v_rec",
            "cp_hull_world",
            "n_hull",
            "d_rec_m",
            "d_rec_paper_m",
        ):
            np.testing.assert_allclose(
                getattr(found.response, name), getattr(expected.response, name), atol=1e-9
            )
    assert (found.recovery is None) == (expected.recovery is None)
    if found.recovery is not None and expected.recovery is not None:
        assert found.recovery.frees == expected.recovery.frees
        assert found.recovery.free_m == pytest.approx(expected.recovery.free_m, abs=2 * TOLERANCE_M)
    assert len(found.patches) == len(expected.patches)
    for one, other in zip(found.patches, expected.patches, strict=True):
        assert (one.n_points, one.n_triangles) == (other.n_points, other.n_triangles)
        if one.n_points:
            np.testing.assert_allclose(one.lower_world, other.lower_world, atol=1e-9)
            np.testing.assert_allclose(one.upper_world, other.upper_world, atol=1e-9)
    assert found.doubt is not None
    assert expected.doubt is not None
    assert found.doubt.component == expected.doubt.component
    assert found.doubt.survives == expected.doubt.survives
    assert found.doubt.n_seeing == expected.doubt.n_seeing
    if not found.clashes:  # many points of a hull may be deepest, each with outlines of its own
        np.testing.assert_allclose(found.doubt.std_m, expected.doubt.std_m, rtol=0.01)
    np.testing.assert_allclose(
        found.doubt.real_upper_m, expected.doubt.real_upper_m, atol=2e-3, equal_nan=True
    )


@pytest.mark.slow
def test_a_moving_object_is_in_each_frame_as_one_that_rests_there(
    session: Path, engine: Engine, results: list[FrameResult], tmp_path: Path
) -> None:
    verdicts = []
    for frame in POSES:
        still = chain_of(session, at_rest(tmp_path, frame), frames=FrameRange(frame, frame + 1))
        (expected,) = evaluate(still, engine)

        assert results[frame].index == expected.index == frame
        (found,), (other,) = results[frame].findings, expected.findings
        assert_same_finding(found, other)
        verdicts.append(found.verdict)
    assert verdicts == ["kept", "kept", "clash", "clash", "clash", "kept"]


def test_a_frame_without_a_pose_is_a_row_with_the_reason(results: list[FrameResult]) -> None:
    reasons = [result.reason for result in results]

    assert reasons[LOST] == f"no pose of object 'cube' in frame {LOST}"
    assert (results[LOST].state, results[LOST].findings) == ("unread", ())
    assert [bool(reason) for reason in reasons] == [frame == LOST for frame in range(len(CENTERS))]


def numbers(result: FrameResult) -> list[Any]:
    """Return what a frame says, to be compared to the bit."""
    said: list[Any] = [result.index, result.reason]
    for one in result.findings:
        assert one.clearance is not None
        said += [one.verdict, one.contact.certificate, one.contact.points()[0].tolist()]
        said += [one.clearance.lower_m, one.clearance.upper_m, str(one.approach_m_s)]
        said += [str(one.first_contact), str(one.response), str(one.recovery), str(one.doubt)]
        said += [str(one.patches)]
    return said


@pytest.mark.slow
def test_identity_poses_leave_the_scene_as_it_is_to_the_bit(
    session: Path, engine: Engine, tmp_path: Path
) -> None:
    still = with_keys(
        write_cube_scene(tmp_path, {"cube": (250.0, 20.0, 10.0)}), "rotate_deg = [10, 20, 30]"
    )
    every = {frame: np.eye(3, 4) for frame in range(len(CENTERS))}
    (tmp_path / "poses.csv").write_text(poses_csv(every), encoding="utf-8")
    moving = with_keys(still, 'poses = "poses.csv"', "moving.toml")

    expected, found = (
        [numbers(one) for one in evaluate(chain_of(session, path), engine)]
        for path in (still, moving)
    )

    assert found == expected


def test_objects_at_rest_are_the_same_objects_in_every_frame(session: Path, tmp_path: Path) -> None:
    chain = chain_of(session, write_cube_scene(tmp_path, {"a": (0, 0, 0), "b": (500, 0, 0)}))

    standing = standing_at(chain, 3)

    assert standing.objects is chain.scene.objects
    assert standing.bodies is chain.bodies


@pytest.mark.slow
def test_a_run_that_is_taken_up_says_the_same_to_the_bit(
    session: Path, scene: Path, engine: Engine
) -> None:
    chain = chain_of(session, scene, backtrack=True)
    whole = [numbers(one) for one in evaluate(chain, engine)]

    for skip in (2, 3, LOST + 1):
        assert [numbers(one) for one in evaluate(chain, engine, skip=skip)] == whole[skip:]


@pytest.mark.parametrize("far_m", [1.0, 1e6])
def test_what_moves_with_the_room_keeps_its_distances(
    engine: Engine, results: list[FrameResult], tmp_path: Path, far_m: float
) -> None:
    """Cameras, and so the hull, and the object's poses go elsewhere together."""
    place_m = (3.0 * far_m, -7.0 * far_m, 2.0)
    elsewhere = pose_of(rotation_about_axes((20.0, -50.0, 110.0)), place_m)
    path = write_ball_session(tmp_path / "session", CENTERS)
    rows = []
    for camera in range(4):
        matrix = ring_matrix(camera, 4) @ np.vstack([invert(elsewhere), [0, 0, 0, 1]])
        rows.append(",".join([f"cam{camera}", *map(repr, matrix.ravel().tolist())]))
    (path.parent / "rig.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    moving = with_keys(
        write_cube_scene(tmp_path, {"cube": tuple((1e3 * REST_M).tolist())}),
        'poses = "poses.csv"\n' + KEYS,
    )
    moved = {frame: compose(elsewhere, pose) for frame, pose in POSES.items()}
    (tmp_path / "poses.csv").write_text(poses_csv(moved), encoding="utf-8")

    found = list(evaluate(chain_of(path, moving), engine))

    for one, other in zip(found, results, strict=True):
        assert one.reason == other.reason
        for mine, expected in zip(one.findings, other.findings, strict=True):
            assert mine.verdict == expected.verdict
            assert mine.contact.n_points == pytest.approx(expected.contact.n_points, abs=far_m > 1)
            # Places so far away have nine digits behind the point.
            assert_same_clearance(mine.clearance, expected.clearance, ROUNDING_M * far_m)


def test_where_no_camera_looks_it_is_not_seen_and_elsewhere_it_is(
    session: Path, engine: Engine, tmp_path: Path
) -> None:
    places = {0: (0.7, 0.0, 0.0), 1: (0.0, 0.0, 80.0), 2: (0.7, 0.0, 0.0)}
    poses = {frame: pose_of(np.eye(3), place) for frame, place in places.items()}
    (tmp_path / "poses.csv").write_text(poses_csv(poses), encoding="utf-8")
    scene = with_keys(write_cube_scene(tmp_path, {"cube": (0, 0, 0)}), 'poses = "poses.csv"')

    found = evaluate(chain_of(session, scene, frames=FrameRange(0, 3), doubt=None), engine)

    assert [result.findings[0].verdict for result in found] == ["kept", "not seen", "kept"]


@pytest.mark.slow
@pytest.mark.gl
def test_engines_that_keep_things_from_frame_to_frame_agree(chain: Chain, engine: Engine) -> None:
    from hybridve.hull.query.compute import Compute
    from hybridve.hull.query.device import open_device
    from hybridve.hull.query.stencil import Stencil

    settings = replace(chain.settings, clearance_m=None, response=None, open_at_m=None, doubt=None)
    plain = replace(chain, settings=settings)
    expected = [
        [one.contact.hits.start.tolist() for one in result.findings]
        for result in evaluate(plain, engine)
    ]
    assert sum(len(starts) for frame in expected for starts in frame) > 50
    context = open_device()
    for kind in (Compute, Stencil):
        with kind(context) as other:
            found = [
                [one.contact.hits.start.tolist() for one in result.findings]
                for result in evaluate(plain, other)
            ]
        assert found == expected
    context.release()


# --- the meter of an object that moved ------------------------------------------------------------


@given(seed=st.integers(0, 2**32 - 1), far_m=st.sampled_from([0.3, 30.0]))
def test_a_hull_seen_from_an_object_holds_the_same_points(seed: int, far_m: float) -> None:
    rng = np.random.default_rng(seed)
    views = random_views(rng, 3)
    hull = make_hull(views, random_masks(rng, views, ["blobs"] * 3))
    pose = pose_of(rotation_of(rng.normal(size=3)), tuple(far_m * rng.normal(size=3)))
    points_world = views.origin_world + 0.3 * rng.normal(size=(500, 3))

    own = seen_from(hull, pose)

    inside = contains_points(hull, points_world)
    same = contains_points(own, transform(invert(pose), points_world)) == inside
    # But for points on a pixel's edge, of which there are none among a few hundred.
    assert same.all()
    assert own.masks_flat is hull.masks_flat


@pytest.mark.parametrize("seed", some_of(range(6)))
def test_a_meter_moved_measures_what_one_made_there_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    hull = ball_hull(ring_views(4, 360, 243, 350.0), 0.05 * rng.normal(size=3), 0.2)
    mesh = sphere_mesh(80, 0.15)
    pose = pose_of(rotation_of(rng.normal(size=3)), tuple(0.25 * rng.normal(size=3)))
    meter, there = (
        ClearanceMeter(vertices_world, mesh.faces, is_closed=True, tolerance_m=TOLERANCE_M)
        for vertices_world in (mesh.vertices_world, placed(mesh.vertices_world, pose))
    )
    shift = 0.1 * rng.normal(size=3)
    points_world = rng.normal(size=(50, 3))
    far_before = meter.measure(hull)

    moved = meter.at(pose)

    for by in (None, shift):
        found, expected = moved.measure(hull, by), there.measure(hull, by)
        assert_same_clearance(found, expected)
        # The witnesses are where it says: on the moved surface, in the hull, so far apart.
        _, nearest, _ = there.closest(found.on_object_world[None] - (0.0 if by is None else by))
        np.testing.assert_allclose(
            nearest[0], found.on_object_world - (0.0 if by is None else by), atol=1e-9
        )
        assert contains_points(hull, found.on_hull_world[None])[0]
        apart_m = np.linalg.norm(found.on_object_world - found.on_hull_world)
        assert apart_m == pytest.approx(max(found.upper_m, found.depth_lower_m), abs=1e-9)
    np.testing.assert_allclose(
        moved.signed_distance(points_world), there.signed_distance(points_world), atol=1e-12
    )
    # Which triangle is nearest is not one answer where an edge is.
    for one, other in zip(moved.closest(points_world), there.closest(points_world), strict=True):
        if one.dtype == np.float64:
            np.testing.assert_allclose(one, other, atol=1e-12)
    # Cubes hold what of the hull is near, whichever way they lie, and the boxes about them do.
    within_m = moved.measure(hull).upper_m + 0.1
    cells = moved.near_cells(hull, within_m, 0.02, 1 << 14)
    inside = rng.uniform(-0.3, 0.3, (4000, 3))
    inside = inside[contains_points(hull, inside)]
    inside = inside[moved.signed_distance(inside) < within_m]
    assert len(inside) > 20
    held = {tuple(place) for place in cells.places(cells.center_world).tolist()}
    assert {tuple(place) for place in cells.places(inside).tolist()} <= held
    away = np.abs(inside[:, None] - cells.center_world) - cells.reach_world
    assert (away.max(axis=2) <= 1e-12).any(axis=1).all()
    # The one at rest stays as it was.
    assert meter.measure(hull).upper_m == far_before.upper_m
    assert meter.world_from_rest is None


# --- the ways to move -----------------------------------------------------------------------------


def turned_about(
    points: NDArray[np.float64],
    axis: NDArray[np.float64],
    anchor: NDArray[np.float64],
    angle: float,
) -> NDArray[np.float64]:
    """Return points (N, 3) turned about an axis, by the formula of Rodrigues."""
    unit = axis / np.linalg.norm(axis)
    arm = points - anchor
    along = (arm @ unit)[:, None] * unit
    return np.asarray(
        anchor + along + np.cos(angle) * (arm - along) + np.sin(angle) * np.cross(unit, arm)
    )


HINGE = (
    "translate_mm = [100, 200, 300]\nrotate_deg = [30, -20, 50]\n"
    'hinge = { axis = [0, 1, 2], anchor_mm = [100, 0, -100], angles = "door.csv" }\n'
)


def test_a_hinge_turns_the_mesh_about_its_axis_before_it_is_placed(tmp_path: Path) -> None:
    still = write_cube_scene(tmp_path, {"door": (0.0, 0.0, 0.0)})
    text = still.read_text(encoding="utf-8").replace("translate_mm = [0.0, 0.0, 0.0]\n", "")
    still.write_text(text, encoding="utf-8")
    angles_deg = {0: 0.0, 2: 90.0, 3: -37.5, 9: 720.0}
    (tmp_path / "door.csv").write_text(angles_csv(angles_deg), encoding="utf-8")

    (door,) = load_scene(with_keys(still, HINGE)).objects

    assert door.motion is not None
    assert door.vertices_mesh is not None
    assert door.motion.world_from_rest(1) is None
    np.testing.assert_array_equal(door.motion.poses[0], np.eye(3, 4))
    for frame, angle_deg in angles_deg.items():
        turned = turned_about(
            door.vertices_mesh,
            np.array([0.0, 1.0, 2.0]),
            np.array([0.1, 0.0, -0.1]),
            np.deg2rad(angle_deg),
        )
        expected = turned @ rotation_about_axes((30, -20, 50)).T + np.array([0.1, 0.2, 0.3])
        found = door.at(door.motion.poses[frame])
        np.testing.assert_allclose(found.vertices_world, expected, atol=ROUNDING_M)
        np.testing.assert_allclose(
            found.reference_point_world, expected.mean(axis=0), atol=ROUNDING_M
        )


def test_a_track_puts_the_tracker_where_it_sits_on_the_object(scene: Path) -> None:
    """The place of the tracker on the object goes where the file says that the tracker was."""
    track = (
        'track = { poses = "poses.csv", object_from_tracker_mm = [60, -20, 130], '
        "rotate_deg = [90, 0, 0] }"
    )
    text = scene.read_text(encoding="utf-8").replace('poses = "poses.csv"', track)
    path = scene.with_name("track.toml")
    path.write_text(text, encoding="utf-8")

    (cube,) = load_scene(path).objects

    assert cube.motion is not None
    for frame, pose in POSES.items():
        world_from_rest = cube.motion.poses[frame]
        at = transform(world_from_rest, np.array([[0.06, -0.02, 0.13]]))[0]
        np.testing.assert_allclose(at, pose[:, 3], atol=ROUNDING_M)
        # The tracker's z is the object's -y, its y the object's z.
        np.testing.assert_allclose(-world_from_rest[:, 1], pose[:, 2], atol=ROUNDING_M)
        np.testing.assert_allclose(world_from_rest[:, 2], pose[:, 1], atol=ROUNDING_M)


def test_all_parts_of_a_file_move_together(tmp_path: Path) -> None:
    still = write_cube_scene(tmp_path, {"pair": (0.0, 0.0, 0.0)})
    (tmp_path / "cube.obj").write_text(
        "v 0 0 0\nv 10 0 0\nv 0 10 0\nv 0 0 10\nv 100 0 0\n"
        "o a\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\no b\nf 5 2 3\n",
        encoding="utf-8",
    )
    (tmp_path / "poses.csv").write_text(poses_csv(POSES), encoding="utf-8")

    scene = load_scene(with_keys(still, 'poses = "poses.csv"\nrecovery_direction = [0, 0, 1]'))

    a, b = scene.objects
    assert a.motion is not None
    assert a.motion is b.motion
    assert scene.missing(LOST) == f"no pose of object 'pair' in frame {LOST}"
    assert scene.missing(3) == ""
    moved = b.at(POSES[3])
    assert moved.recovery_direction is not None
    np.testing.assert_allclose(moved.recovery_direction, POSES[3][:, 2], atol=1e-15)
    assert b.about["motion"] == {"kind": "poses", "file": "poses.csv", "n_frames": len(POSES)}


@given(
    first=st.integers(0, 2**32 - 1),
    second=st.integers(0, 2**32 - 1),
    fraction=st.floats(0.0, 1.0),
)
def test_between_two_frames_the_pivot_goes_straight_and_the_object_turns_evenly(
    first: int, second: int, fraction: float
) -> None:
    def random_pose(seed: int) -> Pose:
        rng = np.random.default_rng(seed)
        return pose_of(rotation_of(rng.normal(size=3)), tuple(rng.normal(size=3)))

    poses = {4: random_pose(first), 7: random_pose(second)}
    sits = random_pose(first + 1)
    motion = Motion.of_track(poses, sits)

    between = motion.between(4, 7, fraction)

    for frame, end in ((4, 0.0), (7, 1.0)):
        np.testing.assert_array_equal(motion.between(4, 7, end), motion.poses[frame])
    tracker = compose(between, sits)
    straight = (1.0 - fraction) * poses[4][:, 3] + fraction * poses[7][:, 3]
    np.testing.assert_allclose(tracker[:, 3], straight, atol=1e-12)
    whole = angle_between(poses[4], poses[7])
    assert angle_between(poses[4], tracker) == pytest.approx(fraction * whole, abs=1e-9)
    assert angle_between(tracker, poses[7]) == pytest.approx((1 - fraction) * whole, abs=1e-9)


@given(angles=st.tuples(*[st.floats(-1.5, 1.5)] * 2), fraction=st.floats(0.0, 1.0))
def test_between_two_frames_a_door_keeps_to_its_circle(
    angles: tuple[float, float], fraction: float
) -> None:
    axis, anchor = np.array([0.0, 3.0, 4.0]), np.array([1.0, 2.0, -1.0])
    motion = Motion.of_hinge(dict(enumerate(angles)), axis, anchor)
    points = np.array([[0.0, 0.0, 0.0], [3.0, -1.0, 2.0]])

    found = transform(motion.between(0, 1, fraction), points)

    angle = (1.0 - fraction) * angles[0] + fraction * angles[1]
    np.testing.assert_allclose(found, turned_about(points, axis, anchor, angle), atol=1e-12)


# --- first contact and approach -------------------------------------------------------------------


@pytest.fixture(scope="module")
def door(tmp_path_factory: pytest.TempPathFactory) -> Chain:
    """A ball that rests, and a door that swings into it: 70 degrees in a frame."""
    folder = tmp_path_factory.mktemp("door")
    session = write_ball_session(folder / "session", np.zeros((3, 3)))
    scene = write_cube_scene(folder, {"door": (0.0, 500.0, 0.0)})
    (folder / "door.csv").write_text(angles_csv({0: 20.0, 1: -50.0, 2: -50.0}), encoding="utf-8")
    hinge = 'hinge = { axis = [0, 0, 1], anchor_mm = [-400, -350, 0], angles = "door.csv" }'
    return chain_of(session, with_keys(scene, hinge), backtrack=True)


def test_a_door_meets_a_ball_that_rests_at_the_angle_at_which_it_does(
    door: Chain, engine: Engine
) -> None:
    """Silhouettes that do not change leave no doubt of the hull between the frames."""
    (part,) = door.scene.objects
    motion = part.motion
    assert motion is not None
    first, second, third = evaluate(door, engine)
    body = make_body(part, viewport=9)
    with Certifier(1e-4) as certifier:
        hull = next(hulls(door)).hull
        assert hull is not None

        def touches(angle_deg: float) -> bool:
            turned = turned_about(
                part.vertices_world,
                np.array([0.0, 0.0, 1.0]),
                motion.pivot_rest,
                np.deg2rad(angle_deg),
            )
            found = certifier.certify_mesh(hull, body.triangles.moved(turned))
            return found.verdict == COLLIDING

        free_deg, touching_deg = 20.0, -50.0
        assert not touches(free_deg)
        assert touches(touching_deg)
        for _ in range(12):
            middle_deg = 0.5 * (free_deg + touching_deg)
            if touches(middle_deg):
                touching_deg = middle_deg
            else:
                free_deg = middle_deg

    assert not first.findings[0].touches
    found = second.findings[0].first_contact
    assert found is not None
    assert found.status == ""
    # It is found to 1/256 of the way.
    assert found.fraction == pytest.approx((20.0 - touching_deg) / 70.0, abs=1.5 / 256)
    assert 0.2 < found.fraction < 0.9
    there = part.at(motion.between(0, 1, found.fraction))
    meter = ClearanceMeter(there.vertices_world, there.faces, is_closed=True)
    assert meter.closest(found.point_world[None])[0][0] == pytest.approx(0.0, abs=1e-9)
    assert contains_points(hull, found.point_world[None])[0]
    # The response begins at the same point of the door, where that is by then.
    response = second.findings[0].response
    assert response is not None
    now = part.at(motion.poses[1])
    there_mesh = transform(invert(there.world_from_mesh), found.point_world[None])
    now_mesh = transform(invert(now.world_from_mesh), response.cp_obj_world[None])
    np.testing.assert_allclose(now_mesh, there_mesh, atol=1e-9)
    # Afterwards it rests, and is touched on: nothing begins.
    assert third.findings[0].touches
    assert third.findings[0].first_contact is None


def test_an_object_that_comes_nearer_approaches_though_nothing_real_moves(
    tmp_path: Path, engine: Engine
) -> None:
    session = write_ball_session(tmp_path / "session", np.zeros((2, 3)))
    scene = write_cube_scene(tmp_path, {"cube": (0.0, 0.0, 0.0)})
    poses = {0: pose_of(np.eye(3), (0.8, 0, 0)), 1: pose_of(np.eye(3), (0.7, 0, 0))}
    (tmp_path / "poses.csv").write_text(poses_csv(poses), encoding="utf-8")

    first, second = evaluate(
        chain_of(session, with_keys(scene, 'poses = "poses.csv"'), doubt=None), engine
    )

    lower_m_s, upper_m_s = second.findings[0].approach_m_s
    # 0.1 m in a 25th of a second, straight at the hull, whose nearest point stays the same.
    assert lower_m_s <= 2.5 <= upper_m_s
    assert upper_m_s - lower_m_s <= 2.1 * TOLERANCE_M * 25
    assert np.isnan(first.findings[0].approach_m_s).all()


# --- the report -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def report(chain: Chain, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.h5"
    settings = DetectSettings(chain.settings, points="all")
    write_report(chain, path, settings, Terminal(enabled=False))
    return path


@pytest.mark.slow
def test_points_of_a_report_lie_on_the_mesh_as_it_stood(
    report: Path, results: list[FrameResult]
) -> None:
    with h5py.File(report) as file:
        group = file["hybridve/objects/cube"]
        placement, xyz_m = group["mesh/placement"][:], group["points/xyz_m"][:]
        ends = group["points/offset"][:].astype(int)
        vertices_m = group["mesh/vertices_m"][:]
    assert placement.shape == (len(CENTERS), 3, 4)
    assert np.isnan(placement[LOST]).all()
    for frame, pose in POSES.items():
        expected = compose(pose, pose_of(np.eye(3), tuple(REST_M)))
        np.testing.assert_allclose(placement[frame], expected, atol=ROUNDING_M)
        points_world, triangle = read_points(report, "cube", frame)
        (finding,) = results[frame].findings
        np.testing.assert_allclose(points_world, finding.contact.points()[0], atol=ROUNDING_M)
        assert triangle.tolist() == finding.contact.points()[1].tolist()
        # Each is on the cube's surface, in the cube's own frame.
        on_cube = transform(invert(placement[frame]), points_world)
        assert np.abs(on_cube).max(initial=0.0) <= np.abs(vertices_m).max() + ROUNDING_M
        np.testing.assert_allclose(np.abs(on_cube).max(axis=1, initial=0.0), 0.1, atol=ROUNDING_M)
        rows = slice(ends[frame], ends[frame + 1])
        np.testing.assert_array_equal(xyz_m[rows], points_world.astype(np.float32))
    assert read_report(report).objects["cube"].n_points[[2, 3, 5]].min() > 0
    assert ends[LOST] == ends[LOST + 1]


def test_vtk_shows_the_object_where_it_was(report: Path) -> None:
    reader = vtkHDFReader()
    reader.SetFileName(str(report))
    reader.UpdateInformation()
    times_s = read_report(report).time_s
    assert reader.GetNumberOfSteps() == len(CENTERS)

    for frame in [*range(len(CENTERS)), 2, LOST, 0]:  # also back
        reader.UpdateTimeStep(times_s[frame])
        surface = reader.GetOutputDataObject(0).GetPartition(0, 0)
        found = np.array([surface.GetPoint(i) for i in range(surface.GetNumberOfPoints())])
        if frame == LOST:
            assert (len(found), surface.GetNumberOfCells()) == (0, 0)
            continue
        corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]) * 0.1
        expected = transform(POSES[frame], corners + REST_M)
        np.testing.assert_allclose(sorted_rows(found), sorted_rows(expected), atol=1e-6)
        assert surface.GetNumberOfCells() == 12
        cell = surface.GetCell(5)
        assert cell.GetNumberOfPoints() == 3


@pytest.mark.slow
def test_a_report_that_was_cut_off_is_taken_up_to_the_same_bits(
    chain: Chain, report: Path, tmp_path: Path
) -> None:
    path = tmp_path / "report.h5"
    settings = DetectSettings(chain.settings, points="all")
    append = write.ReportWriter.append

    def append_and_stop(writer: write.ReportWriter, result: FrameResult) -> None:
        append(writer, result)
        if result.index == 3:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write.ReportWriter, "append", append_and_stop)
        with pytest.raises(KeyboardInterrupt):
            write_report(chain, path, settings, Terminal(enabled=False))
    assert not path.exists()

    write_report(chain, path, replace(settings, resume=True), Terminal(enabled=False))

    compared = 0
    with h5py.File(path) as resumed, h5py.File(report) as whole:
        names: list[str] = []
        whole.visit(names.append)
        for name in names:
            if isinstance(whole[name], h5py.Dataset) and "stage_s" not in name:
                assert np.asarray(resumed[name][()]).tobytes() == (
                    np.asarray(whole[name][()]).tobytes()
                ), name
                compared += 1
    assert compared > 60


def test_what_is_told_of_an_object_tells_how_it_moves_and_other_poses_are_other_settings(
    session: Path, chain: Chain, tmp_path: Path
) -> None:
    (about,) = about_objects(chain)
    assert about["motion"] == {"kind": "poses", "file": "poses.csv", "n_frames": len(POSES)}

    still = write_cube_scene(tmp_path, {"cube": (0.0, 0.0, 0.0)})
    moving = with_keys(still, 'poses = "poses.csv"')
    checksums = []
    for poses in (POSES, {**POSES, LOST: np.eye(3, 4)}):
        (tmp_path / "poses.csv").write_text(poses_csv(poses), encoding="utf-8")
        checksums.append(resolved_settings(chain_of(session, moving))["scene_sha256"])
    assert checksums[0] != checksums[1]


# --- pictures and room ----------------------------------------------------------------------------


def test_pictures_draw_it_where_it_was(chain: Chain, engine: Engine) -> None:
    shot = take_shot(chain, 3, engine)

    corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]) * 0.1
    np.testing.assert_allclose(
        sorted_rows(shot.objects[0].vertices_world),
        sorted_rows(transform(POSES[3], corners + REST_M)),
        atol=ROUNDING_M,
    )
    assert shot.contacts[0].collides
    assert not take_shot(chain, 0, engine).contacts[0].collides
    with pytest.raises(SessionError, match=f"frame {LOST}: no pose of object 'cube' in frame"):
        take_shot(chain, LOST, engine)


@pytest.mark.slow
@pytest.mark.gl
def test_a_picture_shows_other_frames_otherwise(chain: Chain, engine: Engine) -> None:
    shots = [take_shot(chain, frame, engine) for frame in (0, 3)]

    for draw in (lambda shot: draw_scene(shot, (320, 240)), draw_cameras):
        first, second = map(draw, shots)
        assert first.shape == second.shape
        assert (first != second).any()


MOVE = Move(np.array([1.0, 0.0, 0.0]), -0.1, 0.5, 2e-3)


@pytest.mark.slow
def test_spacing_blocks_what_replays_of_objects_at_rest_block(
    session: Path, scene: Path, tmp_path: Path
) -> None:
    settings = {"clearance_m": None, "response": None}
    chain = chain_of(session, scene, **settings)
    shifts_m = shifts_of(MOVE)

    found = replay("moving", chain, Layout.of(chain.scene, ["cube"], MOVE, 0.02), shifts_m)

    shifts_needed, at_95 = [], []
    for frame in POSES:
        still = chain_of(
            session, at_rest(tmp_path, frame), frames=FrameRange(frame, frame + 1), **settings
        )
        alone = replay("rests", still, Layout.of(still.scene, ["cube"], MOVE, 0.02), shifts_m)
        shifts_needed.append(alone.shift_m)
        assert alone.doubt is not None
        at_95.append(alone.doubt.shift_m)
        # What either blocks for certain, the other does not let be.
        for one, other in ((found, alone), (alone, found)):
            row, of_other = (frame, 0) if one is found else (0, frame)
            certain = covers(one.frames.violated.of(row), shifts_m)
            maybe = covers(other.frames.violated.of(of_other), shifts_m)
            maybe |= covers(other.frames.undecided.of(of_other), shifts_m)
            assert (maybe | ~certain).all()
    assert found.shift_m == pytest.approx(max(shifts_needed), abs=MOVE.tolerance_m)
    assert found.shift_m > 0.1
    assert found.doubt is not None
    assert found.doubt.shift_m == pytest.approx(max(at_95), abs=MOVE.tolerance_m)
    assert found.doubt.shift_m > found.shift_m
    assert found.frames.reason[LOST] == f"no pose of object 'cube' in frame {LOST}"
    assert found.binding is not None
    frame = int(np.argmax(shifts_needed))
    assert found.binding.frame == list(POSES)[frame]
    # The witness is on the cube where it stood, shifted.
    unmoved = found.binding.on_object_world - found.binding.shift_m * MOVE.direction
    on_cube = transform(invert(POSES[found.binding.frame]), unmoved[None])[0] - REST_M
    assert np.abs(on_cube).max() == pytest.approx(0.1, abs=1e-9)


def test_an_object_that_is_not_moved_violates_where_it_goes(
    session: Path, scene: Path, tmp_path: Path, results: list[FrameResult]
) -> None:
    text = scene.read_text(encoding="utf-8")
    post = (
        '\n[[object]]\nname = "post"\nmesh = "cube.obj"\nunit = "mm"\ntranslate_mm = [0, 0, 900]\n'
    )
    path = scene.with_name("two.toml")
    path.write_text(text + post, encoding="utf-8")
    chain = chain_of(session, path, doubt=None, clearance_m=None, response=None)

    found = replay("two", chain, Layout.of(chain.scene, ["post"], MOVE, 0.0), shifts_of(MOVE))

    near = [result for result in results if any(one.verdict == "clash" for one in result.findings)]
    assert found.standing == {"cube": (len(near), 0)}
    assert len(near) == 3


def test_a_sweep_asks_for_it_where_it_was(chain: Chain, results: list[FrameResult]) -> None:
    rows = make_rows(chain.scene.objects, [5, 9], 0.02)
    with EngineRoom(Native) as room:
        outcome = run_sweep(
            read_hulls(chain),
            rows,
            [room],
            certify=certify_triangles,
            open_at_m=1e-3,
            truth_room=room,
            repeats=1,
        )

    found = [result.findings[0] for result in results if result.findings]
    assert outcome.frames.index.tolist() == list(POSES)
    touched = [int(one.touches) for one in found]
    assert outcome.frames.objects_colliding.tolist() == touched
    (native,) = outcome.engines
    of_nine = int(np.flatnonzero(outcome.rows.viewport == 9)[0])
    assert native.points[of_nine] == np.mean([one.contact.n_points for one in found])
    # The truth was sampled at the same place: a sample that collides is near.
    assert (native.distance_p99_m <= outcome.rows.predicted_near_m).all()
    assert (native.within_predicted > 0.99).all()
    assert (native.triangles_against_proof == 0).all()


# --- what is refused ------------------------------------------------------------------------------

POSE_HEAD = "frame,x,y,z,qw,qx,qy,qz\n"
HINGED = 'hinge = { axis = [0, 0, 1], anchor_mm = [0, 0, 0], angles = "file.csv" }'


@pytest.mark.parametrize(
    ("keys", "file", "line"),
    [
        (
            'poses = "gone.csv"',
            "",
            r"object\.1\.poses: .*gone\.csv: there is no such file of poses",
        ),
        (
            'poses = "file.csv"',
            "frame,x,y,z\n0,1,2,3\n",
            r"object\.1\.poses: .*expected the columns",
        ),
        ('poses = "file.csv"', POSE_HEAD, r"object\.1\.poses: .*holds no pose"),
        (
            'poses = "file.csv"',
            f"{POSE_HEAD}0,0,0,0,1,0,0,0\n0,0,0,0,1,0,0,0\n",
            r"line 3: frame 0 stands there twice",
        ),
        ('poses = "file.csv"', f"{POSE_HEAD}0,a,0,0,1,0,0,0\n", r"line 2: 'a' is not a number"),
        ('poses = "file.csv"', f"{POSE_HEAD}0,0,0,0,0,0,0,0\n", r"line 2: the quaternion has len"),
        (
            'poses = "file.csv"',
            f"{POSE_HEAD}-3,0,0,0,1,0,0,0\n",
            r"line 2: frame is '-3', expected",
        ),
        (
            'poses = "file.csv"',
            f"{POSE_HEAD}0,0,0,,1,0,0,0\n",
            r"line 2: a part of the pose is mis",
        ),
        ('poses = "file.csv"', f"{POSE_HEAD}0,0,0\n", r"line 2: has 3 columns, the first line 8"),
        (HINGED, POSE_HEAD, r"object\.1\.hinge\.angles: .*expected the columns frame,angle_deg"),
        (HINGED, "frame,angle_deg\n", r"object\.1\.hinge\.angles: .*holds no angle"),
        (HINGED, "frame,angle_deg\n0,inf\n", r"line 2: angle_deg is inf, expected a finite number"),
        (HINGED, "frame,angle_deg\n0,1\n0,2\n", r"line 3: frame 0 stands there twice"),
        (HINGED, "frame,angle_deg\n0,steep\n", r"line 2: 'steep' is not a number"),
        (HINGED.replace("file", "gone"), "", r"hinge\.angles: .*there is no such file of angles"),
        (HINGED.replace("[0, 0, 1]", "[0, 0, 0]"), "", r"object\.1\.hinge\.axis: .*is no axis"),
        (
            HINGED.replace("anchor_mm = [0, 0, 0], ", ""),
            "",
            r"hinge\.anchor_mm: this key is missing",
        ),
        (
            'track = { poses = "gone.csv" }',
            "",
            r"object\.1\.track\.poses: .*gone\.csv: there is no such file of poses",
        ),
        ("track = { offset = 3 }", "", r"object\.1\.track\.poses: this key is missing"),
        (
            f'{HINGED}\nposes = "file.csv"',
            "",
            r"object\.1: has poses and hinge; an object moves in one way, keep one",
        ),
    ],
)
def test_a_mistake_is_one_line_that_names_the_key(
    tmp_path: Path, keys: str, file: str, line: str
) -> None:
    path = with_keys(write_cube_scene(tmp_path, {"part": (0.0, 0.0, 0.0)}), keys)
    (tmp_path / "file.csv").write_text(file, encoding="utf-8")

    with pytest.raises(SceneError, match=line) as caught:
        load_scene(path)

    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_objects_that_no_frame_has_poses_of_together_are_told(
    session: Path, tmp_path: Path
) -> None:
    scene = write_cube_scene(tmp_path, {"lid": (0.0, 0.0, 0.0), "box": (500.0, 0.0, 0.0)})
    text = scene.read_text(encoding="utf-8")
    head, lid, box = text.split("[[object]]")
    scene.write_text(
        f'{head}[[object]]{lid}\nposes = "lid.csv"\n[[object]]{box}\nposes = "box.csv"\n', "utf-8"
    )
    (tmp_path / "lid.csv").write_text(poses_csv({0: np.eye(3, 4), 2: np.eye(3, 4)}), "utf-8")
    (tmp_path / "box.csv").write_text(poses_csv({1: np.eye(3, 4)}), "utf-8")

    with pytest.raises(SceneError, match="no frame has a pose of all of lid, box; their files"):
        chain_of(session, scene)
    both = load_scene(scene).missing(5)
    assert both == "no pose of object 'lid' in frame 5; no pose of object 'box' in frame 5"
