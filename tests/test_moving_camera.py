"""A camera that moves with a tracker, through the whole chain, on a ball whose hull is known."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.cones import ball_extent
from helpers.hulls import ball_masks, look_at, ring_views
from helpers.sessions import CUBE, SCENE_HEAD, SESSION_HEAD
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.boards.board import Sighting
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError, SessionError
from hybridve.calib.formats.rig_json import read_rig, write_rig
from hybridve.calib.lens import img_from_cam
from hybridve.calib.placing.hand_eye import mount_camera
from hybridve.calib.pose import Pose, compose, invert, transform
from hybridve.calib.rig import POSE_PARAMETERS, Mount, Rig, RigCovariance
from hybridve.hull.about import resolved_settings
from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture.recording import stored_silhouettes
from hybridve.hull.capture.rig import rig_digest
from hybridve.hull.capture.session import load_session
from hybridve.hull.chain import Chain, EvaluateSettings, make_chain, views_at
from hybridve.hull.contact.backtrack import first_contact
from hybridve.hull.contact.between import interpolated_hull
from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.contact.detect import detect_contacts
from hybridve.hull.contact.outline_errors import DoubtSettings, outline_errors
from hybridve.hull.contact.respond import ResponseSettings
from hybridve.hull.contact.spacing import Move
from hybridve.hull.contact.uncertainty import Doubter
from hybridve.hull.evaluate import evaluate
from hybridve.hull.query.certify import Certifier
from hybridve.hull.query.engine import Engine
from hybridve.hull.query.native import Native
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import (
    Hull,
    Views,
    interpolated_views,
    make_hull,
    make_views,
)
from hybridve.hull.report.schema import FrameResult
from hybridve.hull.show import draw_cameras, draw_scene, take_shot
from hybridve.hull.spacing import Layout, replay
from hybridve.hull.sweep.frames import read_hulls

Run = Callable[..., int]

SIZE_PX, FOCAL_PX = (320, 240), 330.0

#: The ball comes along x to the cube about the origin, whose faces are 0.1 m from it, and leaves.
RADIUS_M, HALF_M = 0.15, 0.1
X_M = np.array([-0.60, -0.50, -0.40, -0.32, -0.22, -0.12, -0.30, -0.45])
CENTERS = np.column_stack([X_M, np.zeros_like(X_M), np.zeros_like(X_M)])

#: How far an outline of pixels may be off the cone, in pixels: half a diagonal.
STAIRS_PX = 0.71

#: The head's tracker was lost in this frame.
LOST = 6

#: They see the ball's side towards the cube aslant, so that the head's outline ends the hull there.
FIXED = [(1.3, -1.5, 0.5), (1.5, 0.7, 1.3), (-1.7, -0.9, 0.8)]
MOUNT = Mount(
    np.column_stack([cv2.Rodrigues(np.array([0.4, -1.1, 0.7]))[0], [0.03, -0.12, 0.05]]),
    np.column_stack([cv2.Rodrigues(np.array([-0.5, 0.2, 2.0]))[0], [1.5, -0.7, 0.3]]),
)


def head_pose(instant: float) -> Pose:
    """Return cam_from_world of the head: it walks around the ball and looks about."""
    angle = 1.2 + 0.22 * instant
    center = 2.1 * np.array([np.cos(angle), np.sin(angle), 0.3 + 0.05 * instant])
    return look_at(center, np.array([-0.2, 0.0, 0.07 * instant]), 0.1 * instant)


def tracked(cam_from_world: Pose, mount: Mount = MOUNT) -> Pose:
    """Return tracking_from_tracker while the camera stands there."""
    world_from_tracker = compose(invert(cam_from_world), mount.cam_from_tracker)
    return compose(invert(mount.world_from_tracking), world_from_tracker)


def camera(name: str, pose: Pose) -> Camera:
    params = np.array([FOCAL_PX, FOCAL_PX, SIZE_PX[0] / 2, SIZE_PX[1] / 2])
    return Camera(name, "PINHOLE", *SIZE_PX, params, pose)


def true_rig(frame: float) -> Rig:
    fixed = [
        camera(f"cam{k}", look_at(np.array(center), np.array([-0.2, 0.0, 0.0])))
        for k, center in enumerate(FIXED)
    ]
    return Rig((*fixed, camera("head", head_pose(frame))), mounts={"head": MOUNT})


def panned_rig(pan_rad: float) -> Rig:
    """Return the rig with a head that stands still and looks aside by an angle."""
    still = true_rig(0)
    pose = compose(turn_about_y(pan_rad), look_at(np.array([-0.8, 1.9, 0.5]), np.zeros(3)))
    return Rig((*still.cameras[:3], camera("head", pose)))


def turn_about_y(angle_rad: float) -> Pose:
    return np.column_stack([cv2.Rodrigues(np.array([0.0, angle_rad, 0.0]))[0], np.zeros(3)])


def views_of(rig: Rig, origin_world: NDArray[np.float64] | None = None) -> Views:
    return make_views(
        tuple(one.name for one in rig.cameras),
        np.array([SIZE_PX] * len(rig.cameras)),
        np.array([one.pinhole @ one.cam_from_world for one in rig.cameras]),
        origin_world=origin_world,
    )


def poses_csv(poses: dict[int, Pose]) -> str:
    names = ",".join(f"m{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4))
    rows = [
        ",".join([str(frame), *(repr(float(value)) for value in pose.ravel())])
        for frame, pose in poses.items()
    ]
    return "\n".join([f"frame,{names}", *rows]) + "\n"


def write_session(folder: Path, *, poses: str = 'poses = "head.csv"', extra: str = "") -> Path:
    """Write the recording: ready masks of three fixed cameras and a moving one."""
    for frame, center in enumerate(CENTERS):
        rig = true_rig(frame)
        for one, mask in zip(rig.cameras, ball_masks(views_of(rig), center, RADIUS_M), strict=True):
            (folder / one.name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / one.name / f"{frame}.png"), 255 * mask)
    (folder / "rig").mkdir(exist_ok=True)
    write_rig(folder / "rig" / "rig.json", true_rig(3))
    known = {k: tracked(head_pose(k)) for k in range(len(CENTERS)) if k != LOST}
    (folder / "head.csv").write_text(poses_csv(known), encoding="utf-8")
    cameras = [
        f'[[camera]]\nname = "{one.name}"\nmasks = "{one.name}/*.png"\n'
        + (poses + "\n" if one.name == "head" else "")
        for one in true_rig(0).cameras
    ]
    path = folder / "session.toml"
    path.write_text(f"{SESSION_HEAD}{extra}\n" + "\n".join(cameras), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_session(tmp_path_factory.mktemp("head"))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cube")
    (folder / "cube.obj").write_text(CUBE, encoding="utf-8")
    path = folder / "scene.toml"
    path.write_text(
        f'{SCENE_HEAD}[[object]]\nname = "cube"\nmesh = "cube.obj"\nunit = "mm"\n', encoding="utf-8"
    )
    return path


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    with Native() as native:
        yield native


def chain_of(session: Path, scene: Path, **changes: Any) -> Chain:
    settings = EvaluateSettings(
        viewport=10,
        clearance_m=1e-4,
        response=ResponseSettings(),
        backtrack=True,
        doubt=DoubtSettings(),
    )
    return make_chain(load_session(session), load_scene(scene), replace(settings, **changes))


@pytest.fixture(scope="module")
def chain(session: Path, scene: Path) -> Chain:
    return chain_of(session, scene)


@pytest.fixture(scope="module")
def results(chain: Chain, engine: Engine) -> list[FrameResult]:
    return list(evaluate(chain, engine))


def gap_bounds(frame: int) -> tuple[float, float]:
    """Return how far the hull is from the face of the cube: the cones' extent in closed form.

    The outlines may be off by the stairs of pixels, either way. The hull's tip stands before the
    face, not beside it, so that the face's plane is as near as the face.
    """
    views = views_of(true_rig(frame))
    opening = np.full(len(views), STAIRS_PX / FOCAL_PX)
    axis = np.array([1.0, 0.0, 0.0])
    face_m = -HALF_M - X_M[frame]
    extents = [
        ball_extent(views, CENTERS[frame], RADIUS_M, axis, side * opening) for side in (1, -1)
    ]
    return face_m - extents[0], face_m - extents[1]


def test_clearance_and_certificate_are_those_of_the_cones_where_the_cameras_were(
    results: list[FrameResult],
) -> None:
    verdicts = []
    for result in results:
        if result.index == LOST:
            continue
        (finding,) = result.findings
        lower_m, upper_m = gap_bounds(result.index)
        assert finding.clearance is not None
        assert finding.clearance.lower_m <= max(0.0, upper_m)
        assert finding.clearance.upper_m >= max(0.0, lower_m)
        assert upper_m - lower_m < 0.02
        if lower_m > 0:
            assert finding.contact.certificate == "free"
        if upper_m < 0:
            assert finding.contact.certificate == "colliding"
            assert finding.contact.collides
        verdicts.append(finding.contact.certificate)
    assert verdicts == ["free", "free", "free", "free", "colliding", "colliding", "free"]


def test_leaving_out_the_motion_gives_a_wrong_answer(
    session: Path, scene: Path, engine: Engine, tmp_path: Path
) -> None:
    still = write_session(tmp_path, poses="")
    rig = true_rig(0)
    write_rig(tmp_path / "rig" / "rig.json", Rig(rig.cameras))

    found = list(evaluate(chain_of(still, scene, doubt=None, response=None), engine))

    # Frame 0 is right. In frame 5 the ball is deep in the cube, and by the head's cone, which
    # stands where it stood in frame 0, nothing is near.
    (first,), (fifth,) = found[0].findings, found[5].findings
    assert first.clearance is not None
    assert fifth.clearance is not None
    assert first.clearance.lower_m <= gap_bounds(0)[1]
    assert first.clearance.upper_m >= gap_bounds(0)[0]
    assert gap_bounds(5)[1] < -0.1
    assert fifth.contact.certificate == "free"
    assert fifth.clearance.lower_m > 0.05


@pytest.mark.slow
def test_a_mount_calibrated_from_noisy_boards_gives_the_same_answers(
    scene: Path, engine: Engine, tmp_path: Path, results: list[FrameResult]
) -> None:
    path = write_session(tmp_path)
    rng = np.random.default_rng(0)
    board, lens = Chessboard(8, 5, 0.1), true_rig(0)["head"]
    sightings, poses = [], {}
    for instant in range(30):
        center = board.center_board + np.array([*rng.uniform(-0.7, 0.7, 2), rng.uniform(1.0, 1.6)])
        pose = look_at(center, board.center_board, rng.uniform(-0.6, 0.6))
        pixels = img_from_cam(lens, transform(pose, board.points_board))
        pixels += rng.normal(0.0, 0.1, pixels.shape)
        sightings.append(Sighting(f"{instant}.png", instant, 0, pixels))
        poses[instant] = tracked(pose)
    mount, about = mount_camera(lens, [board], sightings, poses)
    write_rig(tmp_path / "rig" / "rig.json", Rig(true_rig(0).cameras, mounts={"head": mount}))

    found = list(evaluate(chain_of(path, scene), engine))

    assert 0.0 < about.offset_std_mm < 3.0
    for result, expected in zip(found, results, strict=True):
        for one, true in zip(result.findings, expected.findings, strict=True):
            assert one.contact.certificate == true.contact.certificate
            assert one.clearance is not None
            assert true.clearance is not None
            assert abs(one.clearance.upper_m - true.clearance.upper_m) < 0.005


def write_boards(folder: Path, board: Chessboard, noise_px: float) -> str:
    """Write what the cameras saw of a still board about the origin; return its part of the session.

    The head walked about it, the others stood: corners in files, OpenCV's pixels, dull pictures.
    """
    rng = np.random.default_rng(0)
    world_from_board = np.column_stack([np.eye(3), -board.center_board])
    tables, poses = [], {}
    for one in true_rig(0).cameras:
        (folder / one.name / "board").mkdir()
        rows = ["image,corner,x,y"]
        for instant in range(30 if one.name == "head" else 2):
            pose = one.cam_from_world
            if one.name == "head":
                center = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(0.9, 1.3)])
                pose = look_at(center, rng.uniform(-0.05, 0.05, 3), rng.uniform(-0.6, 0.6))
                poses[instant] = tracked(pose)
            points = transform(compose(pose, world_from_board), board.points_board)
            pixels = img_from_cam(one, points) - 0.5 + rng.normal(0.0, noise_px, (len(points), 2))
            rows += [f"{instant}.png,{k},{x},{y}" for k, (x, y) in enumerate(pixels)]
            dull = np.full(SIZE_PX[::-1], 128, np.uint8)
            cv2.imwrite(str(folder / one.name / "board" / f"{instant}.png"), dull)
        (folder / f"{one.name}_corners.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
        params = f"[{FOCAL_PX}, {FOCAL_PX}, {SIZE_PX[0] / 2}, {SIZE_PX[1] / 2}]"
        tables.append(
            f'[[camera]]\nname = "{one.name}"\nmodel = "PINHOLE"\nparams = {params}\n'
            f'masks = "{one.name}/*.png"\nextrinsics = "{one.name}/board/*.png"\n'
            f'corners = "{one.name}_corners.csv"\n'
        )
    (folder / "head_board.csv").write_text(poses_csv(poses), encoding="utf-8")
    tables[-1] += 'poses = "head.csv"\nextrinsics_poses = "head_board.csv"\n'
    target = f"columns = {board.columns}\nrows = {board.rows}\nsquare_mm = {1e3 * board.square_m}\n"
    return '[target]\nkind = "chessboard"\n' + target + "\n".join(tables)


@pytest.mark.slow
def test_a_session_with_a_moving_camera_is_calibrated_and_evaluated(
    scene: Path, engine: Engine, tmp_path: Path, run: Run, results: list[FrameResult]
) -> None:
    path = write_session(tmp_path)
    shutil.rmtree(tmp_path / "rig")
    board = Chessboard(8, 5, 0.06)
    path.write_text(SESSION_HEAD + write_boards(tmp_path, board, 0.02), encoding="utf-8")
    for name in ("cube.obj", "scene.toml"):
        shutil.copy(scene.parent / name, tmp_path / name)
    # The board's own frame is the world: the scene moves with it.
    with (tmp_path / "scene.toml").open("a", encoding="utf-8") as file:
        file.write(f"translate_mm = {(1e3 * board.center_board).tolist()}\n")

    assert run("calibrate", path, "--no-progress") == 0
    found = list(evaluate(chain_of(path, tmp_path / "scene.toml"), engine))

    for result, expected in zip(found, results, strict=True):
        assert result.reason == expected.reason
        for one, true in zip(result.findings, expected.findings, strict=True):
            assert one.contact.certificate == true.contact.certificate
            assert one.clearance is not None
            assert true.clearance is not None
            assert abs(one.clearance.upper_m - true.clearance.upper_m) < 0.008


@pytest.mark.slow
def test_doubt_comes_from_the_covariance_where_the_camera_was(
    scene: Path, engine: Engine, tmp_path: Path
) -> None:
    path = write_session(tmp_path)
    labels = [
        f"{one.name} {name}"
        for one in true_rig(0).cameras
        for name in (*POSE_PARAMETERS, "fx", "fy", "cx", "cy")
    ]
    of_camera = [1e-6] * 3 + [4e-6] * 3 + [0.1] * 4
    # The head errs most, so that it matters where it was.
    deviations = np.sqrt(np.array([*(of_camera * 3), *(100.0 * np.array(of_camera))]))
    covariance = RigCovariance(tuple(labels), np.diag(deviations**2))
    rig = Rig(true_rig(0).cameras, covariance=covariance, mounts={"head": MOUNT})
    write_rig(tmp_path / "rig" / "rig.json", rig)
    chain = chain_of(path, scene)
    names, settings = chain.views.names, DoubtSettings()

    (part,) = chain.scene.objects
    for result in evaluate(chain, engine):
        for finding in result.findings:
            still = Rig(true_rig(result.index).cameras, covariance=covariance)
            errors = outline_errors(names, still, [0.0] * len(names), settings)
            masks = ball_masks(views_of(true_rig(result.index)), CENTERS[result.index], RADIUS_M)
            hull = make_hull(views_at(chain, result.index), masks)
            meter = ClearanceMeter(part.vertices_world, part.faces, is_closed=True)
            assert finding.clearance is not None
            assert finding.doubt is not None
            expected = Doubter(errors, settings).frame(hull)
            wanted = expected.doubt(meter, finding.contact, finding.clearance)
            assert finding.doubt.std_m == pytest.approx(wanted.std_m, rel=1e-6)
            if not finding.touches:
                assert finding.doubt.std_m > 0.0


def test_a_frame_without_a_tracked_pose_is_a_row_with_the_reason(
    results: list[FrameResult],
) -> None:
    reasons = [result.reason for result in results]

    assert reasons[LOST] == f"no tracked pose of camera 'head' in frame {LOST}"
    assert results[LOST].findings == ()
    assert [bool(reason) for reason in reasons] == [k == LOST for k in range(len(CENTERS))]


def test_first_contact_lies_where_both_the_ball_and_the_camera_were_on_their_way(
    results: list[FrameResult],
) -> None:
    (finding,) = results[4].findings
    assert finding.first_contact is not None
    before, after = gap_bounds(3), gap_bounds(4)
    # The gap closes about evenly between the frames.
    earliest = before[0] / (before[0] - after[0])
    latest = before[1] / (before[1] - after[1])

    assert finding.first_contact.status == ""
    assert earliest - 0.15 < finding.first_contact.fraction < latest + 0.15
    # It is a point of the face, and a little later the hull of the cones holds it.
    point_world = finding.first_contact.point_world
    assert point_world[0] == pytest.approx(-HALF_M, abs=1e-9)
    assert np.abs(point_world).max() <= HALF_M + 1e-9
    instant = 3 + finding.first_contact.fraction + 0.15
    center = np.array([np.interp(instant, range(len(X_M)), X_M), 0.0, 0.0])
    views = views_of(true_rig(instant))
    later = make_hull(views, ball_masks(views, center, RADIUS_M))
    assert contains_points(later, point_world[None])[0]


def numbers(result: FrameResult) -> list[Any]:
    """Return what a frame says, to be compared to the bit."""
    said: list[Any] = [result.index, result.reason]
    for one in result.findings:
        assert one.clearance is not None
        said += [one.contact.certificate, one.contact.points()[0].tolist()]
        said += [one.clearance.lower_m, one.clearance.upper_m, str(one.approach_m_s)]
        said += [str(one.first_contact), str(one.response), str(one.doubt)]
    return said


def test_a_run_that_is_taken_up_says_the_same_to_the_bit(
    chain: Chain, engine: Engine, results: list[FrameResult]
) -> None:
    for skip in (3, 5, LOST + 1):
        rest = list(evaluate(chain, engine, skip=skip))

        assert [numbers(one) for one in rest] == [numbers(one) for one in results[skip:]]


def test_the_local_origin_is_that_of_the_whole_recording(
    session: Path, scene: Path, chain: Chain
) -> None:
    from hybridve.hull.capture.recording import FrameRange

    late = chain_of(session, scene, frames=FrameRange(4))

    origins = [views_at(chain, frame).origin_world for frame in (0, 4, 7)]
    for origin in [*origins, views_at(late, 4).origin_world]:
        np.testing.assert_array_equal(origin, chain.views.origin_world)
    for frame in (0, 4):
        views = views_at(chain, frame)
        expected = views_of(true_rig(frame))
        moved = expected.img_from_local.copy()
        shift = views.origin_world - expected.origin_world
        moved[:, :, 3] += moved[:, :, :3] @ shift
        np.testing.assert_allclose(views.img_from_local, moved, atol=1e-9)
        # What stands still does so to the bit.
        np.testing.assert_array_equal(views.img_from_local[:3], chain.views.img_from_local[:3])


@pytest.mark.slow
@pytest.mark.gl
def test_engines_that_keep_things_from_frame_to_frame_agree(chain: Chain, engine: Engine) -> None:
    from hybridve.hull.query.compute import Compute
    from hybridve.hull.query.device import open_device
    from hybridve.hull.query.stencil import Stencil

    plain = replace(
        chain, settings=replace(chain.settings, clearance_m=None, response=None, open_at_m=None)
    )
    expected = [
        [one.contact.hits.start.tolist() for one in result.findings]
        for result in evaluate(plain, engine)
    ]
    assert any(triangles for frame in expected for triangles in frame)
    context = open_device()
    for kind in (Compute, Stencil):
        with kind(context) as other:
            found = [
                [one.contact.hits.start.tolist() for one in result.findings]
                for result in evaluate(plain, other)
            ]
        assert found == expected
    context.release()


def test_other_poses_are_other_settings(
    session: Path, scene: Path, chain: Chain, tmp_path: Path
) -> None:
    other = write_session(tmp_path)
    (tmp_path / "head.csv").write_text(
        poses_csv({k: tracked(head_pose(k)) for k in range(8)}), encoding="utf-8"
    )

    first, second = resolved_settings(chain), resolved_settings(chain_of(other, scene))

    assert first["poses_sha256"]["head"] != second["poses_sha256"]["head"]


@pytest.mark.slow
def test_stored_silhouettes_serve_until_the_poses_change(
    scene: Path, tmp_path: Path, run: Run, engine: Engine, results: list[FrameResult]
) -> None:
    path = write_session(tmp_path)
    # Something that the head alone sees, in one frame; the others see nothing there.
    stray = tmp_path / "head" / "4.png"
    picture = np.asarray(cv2.imread(str(stray), cv2.IMREAD_GRAYSCALE))
    picture[5:15, 5:15] = 255
    cv2.imwrite(str(stray), picture)

    assert run("segment", path, "--no-progress") == 0
    stored = chain_of(path, scene)
    found = list(evaluate(stored, engine))
    head = tmp_path / "head.csv"
    head.write_text(head.read_text(encoding="utf-8").replace("\n0,", "\n00,"), encoding="utf-8")

    assert stored.silhouettes is not None
    assert [numbers(one) for one in found] == [numbers(one) for one in results]
    from hybridve.hull.capture.silhouette_io import SilhouetteReader

    with SilhouetteReader(tmp_path / "silhouettes.h5") as reader:
        masks, _ = reader.frame(4)
        lost, _ = reader.frame(LOST)
    assert masks is not None
    assert lost is not None
    assert masks[3][5:15, 5:15].sum() == 0
    assert masks[3].sum() == (picture > 0).sum() - 100
    assert (
        stored_silhouettes(load_session(path), rig_digest(read_rig(tmp_path / "rig" / "rig.json")))
        is None
    )


@pytest.mark.slow
def test_spacing_sweep_and_pictures_see_the_cameras_where_they_were(
    chain: Chain, scene: Path, engine: Engine
) -> None:
    hulls = read_hulls(chain)
    move = Move(np.array([1.0, 0.0, 0.0]), 0.0, 0.6, 1e-3)
    shifts = np.linspace(0.0, 0.6, 7)
    spacing = replay("head", chain, Layout.of(chain.scene, ["cube"], move), shifts)

    assert [frame.index for frame in hulls] == [k for k in range(len(CENTERS)) if k != LOST]
    for frame in hulls:
        np.testing.assert_array_equal(
            frame.hull.views.img_from_local, views_at(chain, frame.index).img_from_local
        )
    # The cube has to give way until the hull of frame 5, the deepest, is out of it.
    lower_m, upper_m = gap_bounds(5)
    assert -upper_m - 2e-3 < spacing.shift_m < -lower_m + 2e-3
    assert spacing.frames.reason[LOST].startswith("no tracked pose of camera 'head'")

    shot = take_shot(chain, 5, engine)
    np.testing.assert_allclose(shot.rig["head"].cam_from_world, head_pose(5), atol=1e-12)
    assert shot.contacts[0].collides
    assert draw_cameras(shot).size > 0
    assert draw_scene(shot, (320, 240)).size > 0
    last = take_shot(chain, 7, engine)
    true_masks = ball_masks(views_of(true_rig(7)), CENTERS[7], RADIUS_M)
    assert [int(mask.sum()) for mask in last.masks] == [int(mask.sum()) for mask in true_masks]
    with pytest.raises(SessionError, match=f"frame {LOST}: no tracked pose of camera 'head'"):
        take_shot(chain, LOST, engine)


def test_a_clock_that_began_late_moves_the_poses_too(tmp_path: Path, scene: Path) -> None:
    path = write_session(tmp_path, poses='poses = "head.csv"\noffset_s = 0.08')

    late = chain_of(path, scene)

    assert late.tracks.first == 2
    np.testing.assert_allclose(late.tracks.at(3)["head"], tracked(head_pose(1)), atol=1e-12)
    assert late.tracks.missing(LOST + 2) == f"no tracked pose of camera 'head' in frame {LOST + 2}"


def test_what_does_not_fit_together_is_told_by_name(tmp_path: Path, scene: Path) -> None:
    path = write_session(tmp_path, poses="")
    with pytest.raises(
        SessionError, match=r"camera.4 \('head'\) moves with a tracker, says the rig"
    ):
        chain_of(path, scene)

    write_session(tmp_path)
    write_rig(tmp_path / "rig" / "rig.json", Rig(true_rig(0).cameras))
    with pytest.raises(CalibrationError, match=r"camera.4.poses: the rig does not say where"):
        chain_of(path, scene)

    rig = true_rig(0)
    write_rig(
        tmp_path / "rig" / "rig.json", Rig(rig.cameras, mounts={"head": MOUNT, "cam0": MOUNT})
    )
    (tmp_path / "cam0.csv").write_text(poses_csv({99: MOUNT.cam_from_tracker}), encoding="utf-8")
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace('"cam0/*.png"', '"cam0/*.png"\nposes = "cam0.csv"'), "utf-8")
    with pytest.raises(SessionError, match="no frame has a tracked pose of all of cam0, head"):
        chain_of(path, scene)


# --- views between two frames ---------------------------------------------------------------------


def centers_of(views: Views) -> NDArray[np.float64]:
    matrices = views.img_from_local
    return np.asarray(-np.linalg.solve(matrices[:, :, :3], matrices[:, :, 3:])[..., 0], np.float64)


def test_between_two_frames_a_camera_goes_straight_and_turns_evenly(chain: Chain) -> None:
    before, after = views_at(chain, 1), views_at(chain, 2)

    middle = interpolated_views(before, after, 0.25)

    assert interpolated_views(before, after, 0.0) is before
    assert interpolated_views(before, after, 1.0) is after
    assert interpolated_views(before, before, 0.25) is before
    np.testing.assert_array_equal(middle.img_from_local[:3], before.img_from_local[:3])
    np.testing.assert_allclose(
        centers_of(middle), 0.75 * centers_of(before) + 0.25 * centers_of(after), atol=1e-12
    )

    def turned(first: Views, second: Views) -> NDArray[np.float64]:
        rotation = np.linalg.solve(first.img_from_local[3, :, :3], second.img_from_local[3, :, :3])
        return np.asarray(cv2.Rodrigues(rotation)[0], np.float64).ravel()

    np.testing.assert_allclose(turned(before, middle), 0.25 * turned(before, after), atol=1e-9)
    assert np.linalg.norm(turned(before, after)) > 0.1


@given(
    angle_rad=st.one_of(st.floats(-8, 0).map(lambda power: 10.0**power), st.floats(1.0, 3.1)),
    fraction=st.floats(0.01, 0.99),
)
def test_a_turn_of_any_angle_is_shared_out(angle_rad: float, fraction: float) -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    views = ring_views(2)
    matrices = views.img_from_local.copy()
    matrices[1, :, :3] = matrices[1, :, :3] @ cv2.Rodrigues(angle_rad * axis)[0]
    turned = replace(views, img_from_local=matrices)

    middle = interpolated_views(views, turned, fraction)

    part = cv2.Rodrigues(fraction * angle_rad * axis)[0]
    expected = views.img_from_local[1, :, :3] @ part
    error = np.linalg.solve(
        views.img_from_local[1, :, :3], middle.img_from_local[1, :, :3] - expected
    )
    assert np.abs(error).max() < 1e-11 + 1e-7 * (angle_rad > 1)
    np.testing.assert_array_equal(middle.img_from_local[0], views.img_from_local[0])


PANS_RAD = (-0.2, 0.18)


def two_hulls(x_before_m: float, x_after_m: float) -> tuple[Hull, Hull]:
    """Return the hulls of a ball in two frames between which the head turned aside."""
    origin = np.zeros(3)
    views = [views_of(panned_rig(pan), origin) for pan in PANS_RAD]
    before, after = (
        make_hull(one, ball_masks(one, np.array([x_m, 0.0, 0.0]), RADIUS_M))
        for one, x_m in zip(views, (x_before_m, x_after_m), strict=True)
    )
    return before, after


@pytest.mark.parametrize("fraction", [0.25, 0.5, 0.75])
def test_the_hull_between_two_frames_is_that_of_cameras_halfway(fraction: float) -> None:
    before, after = two_hulls(-0.35, -0.25)
    center = np.array([-0.35 + 0.1 * fraction, 0.0, 0.0])
    pan = PANS_RAD[0] + fraction * (PANS_RAD[1] - PANS_RAD[0])
    views = views_of(panned_rig(pan), np.zeros(3))
    true = make_hull(views, ball_masks(views, center, RADIUS_M))
    points = center + np.random.default_rng(0).uniform(-0.2, 0.2, (20_000, 3))

    found = interpolated_hull(before, after, fraction)

    expected, inside = contains_points(true, points), contains_points(found, points)
    assert (inside != expected).sum() < 0.05 * expected.sum()


def test_the_silhouette_of_what_stands_still_turns_with_the_camera() -> None:
    before, after = two_hulls(-0.3, -0.3)
    offsets_px = []
    for fraction in np.linspace(0.05, 0.95, 10):
        pan = PANS_RAD[0] + fraction * (PANS_RAD[1] - PANS_RAD[0])
        views = views_of(panned_rig(pan), np.zeros(3))
        true = ball_masks(views, np.array([-0.3, 0.0, 0.0]), RADIUS_M)

        found = interpolated_hull(before, after, float(fraction))

        middles = [np.argwhere(mask).mean(axis=0) for mask in (found.mask(3), true[3])]
        offsets_px.append(middles[0] - middles[1])
        assert (found.mask(3) != true[3]).sum() < 0.05 * true[3].sum()
        for camera in range(3):
            np.testing.assert_array_equal(found.mask(camera), true[camera])
    # Pixels are taken whole, which sways the middle by some tenths, but to no side.
    assert np.abs(offsets_px).max() < 0.5
    assert np.abs(np.mean(offsets_px, axis=0)).max() < 0.15


def test_first_contact_is_found_while_the_camera_turns_the_object_through_its_image(
    chain: Chain, engine: Engine
) -> None:
    before, after = two_hulls(-0.32, -0.22)
    (body,) = chain.bodies
    (contact,) = detect_contacts(after, [body], engine)
    assert contact.collides
    assert not detect_contacts(before, [body], engine)[0].collides
    axis = np.array([1.0, 0.0, 0.0])
    gaps_m = [
        -HALF_M - x_m - ball_extent(hull.views, np.array([x_m, 0, 0]), RADIUS_M, axis, np.zeros(4))
        for hull, x_m in ((before, -0.32), (after, -0.22))
    ]

    with Certifier(1e-4) as certifier:
        found = first_contact(before, after, body, contact, certifier, engine)

    assert found.status == ""
    assert abs(found.fraction - gaps_m[0] / (gaps_m[0] - gaps_m[1])) < 0.1


def test_views_of_other_cameras_have_nothing_between_them() -> None:
    views = ring_views(3)
    for other in (
        ring_views(4),
        ring_views(3, width=640),
        ring_views(3, focal_px=701.0),
        ring_views(3, unseen="keep"),
        replace(views, origin_world=views.origin_world + 1.0),
    ):
        with pytest.raises(ValueError, match="not of the same views"):
            interpolated_views(views, other, 0.5)


def test_hulls_of_standing_cameras_have_the_very_views_of_the_chain(
    tmp_path: Path, scene: Path
) -> None:
    path = write_session(tmp_path, poses="")
    write_rig(tmp_path / "rig" / "rig.json", Rig(true_rig(0).cameras))

    still = chain_of(path, scene)

    assert not still.tracks
    assert "poses_sha256" not in resolved_settings(still)
    assert views_at(still, 5) is still.views
    make_hull(views_at(still, 2), ball_masks(still.views, CENTERS[2], RADIUS_M))
