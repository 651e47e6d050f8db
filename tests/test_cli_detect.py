"""``hybridve detect`` as a user runs it, on a ball whose place is known in every frame."""

import json
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from helpers.sessions import BALL_RADIUS_M, write_ball_session, write_cube_scene

from hybridve.hull.capture.recording import FrameRange, segmented_frames
from hybridve.hull.capture.session import load_session
from hybridve.hull.report.read import read_points, read_report

Run = Callable[..., int]

#: The ball comes along x from far to well beyond the cube at the origin.
CENTERS = np.column_stack([np.linspace(-0.9, 0.9, 13), np.zeros(13), np.zeros(13)])

#: Half the edge of the cube.
HALF_M = 0.1


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ball_session(tmp_path_factory.mktemp("ball"), CENTERS, n_cameras=6)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    places = {"hit": (0.0, 0.0, 0.0), "far": (0.0, 0.0, 900.0)}
    return write_cube_scene(tmp_path_factory.mktemp("cubes"), places)


def distance_to_cube_surface_m(center: np.ndarray) -> float:
    outside = np.linalg.norm(np.maximum(np.abs(center) - HALF_M, 0.0))
    inside = np.maximum(HALF_M - np.abs(center), 0.0).min()
    return float(outside if outside > 0 else inside)


@pytest.mark.slow
@pytest.mark.parametrize(
    "engine",
    [
        "native",
        "reference",
        pytest.param("compute", marks=pytest.mark.gl),
        pytest.param("stencil", marks=pytest.mark.gl),
    ],
)
def test_every_frame_in_which_the_ball_meets_the_surface_collides(
    run: Run, tmp_path: Path, session: Path, scene: Path, engine: str
) -> None:
    path = tmp_path / "report.h5"

    status = run(
        "detect", session, "--scene", scene, "-o", path, "--viewport", 40, "--engine", engine
    )

    assert status == 0
    report = read_report(path)
    assert report.attributes["engine"] == engine
    hit, far = report.objects["hit"], report.objects["far"]
    for row, center in enumerate(CENTERS):
        # The hull of a ball contains the ball. Samples are 0.2 sqrt(2) / 39 m apart, and a pixel is
        # 2.3 / 150 m wide: contacts shallower than both may be missed, no deeper one.
        if distance_to_cube_surface_m(center) < BALL_RADIUS_M - 0.025:
            assert hit.collides[row], row
            assert hit.certificate[row] == "colliding"
        xyz_m, triangle = read_points(path, "hit", row)
        assert len(xyz_m) == hit.n_points[row]
        # Collision points lie on the surface of the cube, and none is far from the ball.
        np.testing.assert_allclose(np.abs(xyz_m).max(axis=1), HALF_M, atol=1e-6)
        assert (np.linalg.norm(xyz_m - center, axis=1) < 1.5 * BALL_RADIUS_M).all()
        assert (triangle < 12).all()
    assert not hit.collides[0]
    assert not hit.collides[-1]
    assert not far.collides.any()
    assert (far.certificate == "free").all()


@pytest.mark.slow
def test_the_engines_write_the_same_points(
    run: Run, tmp_path: Path, session: Path, scene: Path
) -> None:
    found = {}
    for engine in ("native", "reference"):
        path = tmp_path / f"{engine}.h5"
        assert run("detect", session, "--scene", scene, "-o", path, "--engine", engine) == 0
        with h5py.File(path) as file:
            runs = file["hybridve/objects/hit/runs"]
            found[engine] = [runs[name][:] for name in ("triangle", "first", "count", "offset")]

    for native, reference in zip(found["native"], found["reference"], strict=True):
        np.testing.assert_array_equal(native, reference)
    assert len(found["native"][0]) > 0


@pytest.mark.slow
def test_a_finer_accuracy_takes_smaller_steps_and_says_so(
    run: Run, tmp_path: Path, session: Path, scene: Path
) -> None:
    path = tmp_path / "report.h5"

    assert run("detect", session, "--scene", scene, "-o", path, "--accuracy-mm", 5) == 0

    about = read_report(path).objects["hit"].about
    assert about["closed"] is True
    assert json.loads(about["material"]) == {"name": None, "rgba": None}
    assert about["sample_spacing_m"] <= 0.005
    # The longest edge is a diagonal of 0.2 sqrt(2) m: 57 steps of 5 mm, 58 samples.
    assert about["largest_viewport"] == 58


@pytest.mark.slow
def test_a_range_of_frames_keeps_their_numbers(
    run: Run, tmp_path: Path, session: Path, scene: Path
) -> None:
    path = tmp_path / "report.h5"

    assert run("detect", session, "--scene", scene, "-o", path, "--frames", "2:11:4") == 0

    report = read_report(path)
    assert report.index.tolist() == [2, 6, 10]
    np.testing.assert_allclose(report.time_s, np.array([2, 6, 10]) / 25)


@pytest.mark.slow
def test_a_damaged_picture_is_a_row_with_a_reason(run: Run, tmp_path: Path, scene: Path) -> None:
    session = write_ball_session(tmp_path / "session", CENTERS[5:8])
    (tmp_path / "session" / "cam2" / "1.png").write_bytes(b"torn")
    path = tmp_path / "report.h5"

    assert run("detect", session, "--scene", scene, "-o", path) == 0

    report = read_report(path)
    assert (report.reason == "").tolist() == [True, False, True]
    assert "cam2" in report.reason[1]
    assert "1.png" in report.reason[1]
    assert report.objects["hit"].collides.tolist() == [True, False, True]


@pytest.mark.slow
def test_a_late_camera_is_read_in_step_with_the_others(
    run: Run, tmp_path: Path, scene: Path
) -> None:
    session = write_ball_session(tmp_path / "session", CENTERS[2:11])
    text = session.read_text(encoding="utf-8")
    late = text.replace('masks = "cam3/*.png"', 'masks = "cam3/*.png"\noffset_s = 0.08')
    for frame in (0, 1):  # cam3 began two frames after the others
        (tmp_path / "session" / "cam3" / f"{frame}.png").unlink()
    session.write_text(late, encoding="utf-8")
    whole = write_ball_session(tmp_path / "whole", CENTERS[2:11])

    assert run("detect", session, "--scene", scene, "-o", tmp_path / "late.h5") == 0
    assert run("detect", whole, "--scene", scene, "-o", tmp_path / "whole.h5") == 0

    late_report, report = read_report(tmp_path / "late.h5"), read_report(tmp_path / "whole.h5")
    assert "cam3" in late_report.reason[0]
    assert (late_report.reason[2:] == "").all()
    np.testing.assert_array_equal(
        late_report.objects["hit"].n_points[2:], report.objects["hit"].n_points[2:]
    )
    assert report.objects["hit"].n_points.sum() > 0


@pytest.mark.slow
def test_a_camera_that_stops_early_is_told_frame_by_frame(
    run: Run, tmp_path: Path, scene: Path
) -> None:
    session = write_ball_session(tmp_path / "session", CENTERS)
    for frame in range(9, len(CENTERS)):
        (tmp_path / "session" / "cam1" / f"{frame}.png").unlink()
    path = tmp_path / "report.h5"

    assert run("detect", session, "--scene", scene, "-o", path) == 0

    report = read_report(path)
    assert (report.reason[:9] == "").all()
    assert len(report.reason) == len(CENTERS)
    assert all("'cam1'" in reason and "no picture" in reason for reason in report.reason[9:])


@pytest.mark.slow
def test_status_3_tells_of_a_clash_only_if_asked(
    run: Run, tmp_path: Path, session: Path, scene: Path
) -> None:
    clash = ["detect", session, "--scene", scene, "--frames", "6"]
    clear = ["detect", session, "--scene", scene, "--frames", "0"]

    assert run(*clash, "-o", tmp_path / "a.h5") == 0
    assert run(*clash, "-o", tmp_path / "b.h5", "--fail-on-clash") == 3
    assert run(*clear, "-o", tmp_path / "c.h5", "--fail-on-clash") == 0
    assert run(*clash, "-o", tmp_path / "d.h5", "--fail-on-clash", "--let-pass", "clash") == 0


@pytest.mark.slow
def test_a_frame_that_could_not_be_read_is_no_kept_distance(
    run: Run, tmp_path: Path, scene: Path
) -> None:
    session = write_ball_session(tmp_path / "session", CENTERS[:2])
    (tmp_path / "session" / "cam2" / "1.png").write_bytes(b"torn")
    asked = ["detect", session, "--scene", scene, "--fail-on-clash"]

    assert run(*asked, "-o", tmp_path / "a.h5") == 3
    assert run(*asked, "-o", tmp_path / "b.h5", "--let-pass", "unknown") == 0

    rows = read_report(tmp_path / "a.h5").objects["hit"]
    assert rows.verdict.tolist() == ["kept", "unknown"]
    assert "cam2" in rows.why[1]


@pytest.mark.slow
def test_something_inside_or_too_near_is_a_clash_too(
    run: Run, tmp_path: Path, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    room = write_cube_scene(tmp_path / "room", {"room": (0.0, 0.0, 0.0)})
    mesh = tmp_path / "room" / "cube.obj"
    mesh.write_text(mesh.read_text(encoding="utf-8").replace("100", "1300"), encoding="utf-8")
    near = write_cube_scene(tmp_path / "near", {"near": (0.0, 0.0, 0.0)})
    text = near.read_text(encoding="utf-8")
    # In frame 0 the ball, of 0.2 m about (-0.9, 0, 0), is 0.6 m away from the cube.
    common = ("--frames", "0", "--no-doubt", "--viewport", 3, "--fail-on-clash")

    assert run("detect", session, "--scene", room, "-o", tmp_path / "a.h5", *common) == 3
    assert "inside" in capsys.readouterr().out
    for required_mm, status in ((700, 3), (400, 0)):
        near.write_text(f"{text}required_clearance_mm = {required_mm}\n", encoding="utf-8")
        path = tmp_path / f"{required_mm}.h5"
        assert run("detect", session, "--scene", near, "-o", path, *common) == status, required_mm


@pytest.mark.slow
def test_an_existing_report_is_refused_and_kept(
    run: Run, tmp_path: Path, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "report.h5"
    path.write_text("precious", encoding="utf-8")

    assert run("detect", session, "--scene", scene, "-o", path) == 1

    assert "exists already" in capsys.readouterr().err
    assert path.read_text(encoding="utf-8") == "precious"
    assert run("detect", session, "--scene", scene, "-o", path, "--overwrite") == 0
    assert len(read_report(path).index) == len(CENTERS)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--frames", "90:95"], "none of the frames 90:95"),
        (["-o", "nowhere/report.h5"], "there is no folder"),
        (["--accuracy-mm", "0.0001"], "needs a viewport of"),
    ],
)
def test_a_problem_is_one_line_and_status_1(
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    session: Path,
    scene: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    output = [] if "-o" in arguments else ["-o", "report.h5"]

    assert run("detect", session, "--scene", scene, "--no-progress", *output, *arguments) == 1

    error = capsys.readouterr().err.strip()
    assert error.startswith("error: ")
    assert message in error
    assert "\n" not in error
    assert list(tmp_path.iterdir()) == []


def test_a_missing_rig_is_told_with_the_command_that_makes_one(
    run: Run, tmp_path: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = write_ball_session(tmp_path / "session", CENTERS[:2])
    text = session.read_text(encoding="utf-8").replace('rig = "rig.csv"\nrig_unit = "m"\n', "")
    session.write_text(text, encoding="utf-8")

    assert run("detect", session, "--scene", scene, "-o", tmp_path / "report.h5") == 1

    assert "run `hybridve calibrate" in capsys.readouterr().err


@pytest.mark.slow
def test_masks_of_another_size_than_the_others_are_a_row_with_a_reason(
    run: Run, tmp_path: Path, scene: Path
) -> None:
    session = write_ball_session(tmp_path / "session", CENTERS[5:8])
    cv2.imwrite(str(tmp_path / "session" / "cam0" / "2.png"), np.zeros((50, 60), np.uint8))

    assert run("detect", session, "--scene", scene, "-o", tmp_path / "report.h5") == 0

    report = read_report(tmp_path / "report.h5")
    assert "60x50" in report.reason[2]
    assert (report.reason[:2] == "").all()


@pytest.mark.parametrize(
    "arguments",
    [
        ["detect"],
        ["detect", "s", "--scene", "x", "-o", "r.h5", "--frames", "x"],
        ["detect", "s", "--scene", "x", "-o", "r.h5", "--viewport", "0"],
        ["detect", "s", "--scene", "x", "-o", "r.h5", "--viewport", "3", "--accuracy-mm", "3"],
        ["detect", "s", "--scene", "x", "-o", "r.h5", "--abc-deg", "180"],
        ["detect", "s", "--scene", "x", "-o", "r.h5", "--clearance-mm", "-1"],
        ["detect", "s", "--scene", "x", "-o", "r.h5", "--backtrack", "--no-response"],
        ["detect", "s", "-o", "r.h5"],
        ["no-such-command"],
    ],
)
def test_wrong_usage_is_status_2(run: Run, arguments: list[str]) -> None:
    assert run(*arguments) == 2


@pytest.mark.slow
def test_options_of_contact_are_kept_and_options_left_out_leave_columns_out(
    run: Run, tmp_path: Path, session: Path, scene: Path
) -> None:
    full, lean = tmp_path / "full.h5", tmp_path / "lean.h5"
    common = ("detect", session, "--scene", scene, "--frames", "5:7", "--no-progress")
    chosen = ("--clearance-mm", 1, "--abc-mm", 40, "--abc-window", 100, "--mask-std-px", 0.5)

    assert run(*common, "-o", full, *chosen, "--abc-deg", 20, "--backtrack") == 0
    assert run(*common, "-o", lean, "--no-response", "--no-doubt") == 0

    report = read_report(full)
    settings = report.settings
    assert settings["clearance_m"] == 0.001
    assert settings["response"]["angle_rad"] == pytest.approx(np.radians(20))
    assert settings["response"]["height_m"] == 0.04
    assert settings["response"]["window"] == 100
    assert settings["backtrack"] is True
    assert settings["doubt"]["segmentation_px"] == 0.5
    hit, other = report.objects["hit"], read_report(lean).objects["hit"]
    assert {"clearance_m", "d_rec_m", "first_contact_s", "survives"} <= hit.columns.keys()
    assert {"clearance_m", "first_contact_s"} <= other.columns.keys()
    assert not {"d_rec_m", "survives"} & other.columns.keys()
    width_m = np.diff(report.objects["far"]["clearance_m"], axis=1)
    assert (width_m <= 0.001 + 1e-9).all()


@pytest.mark.slow
def test_json_of_detect_is_that_of_summary(
    run: Run, tmp_path: Path, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "report.h5"
    call = ("detect", session, "--scene", scene, "-o", path, "--frames", "5:7", "--no-doubt")

    assert run(*call, "--json") == 0

    told = json.loads(capsys.readouterr().out)
    assert run("summary", path, "--json") == 0
    assert json.loads(capsys.readouterr().out) == told


@pytest.mark.slow
def test_summary_counts_what_the_report_holds(
    run: Run, tmp_path: Path, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "report.h5"
    run("detect", session, "--scene", scene, "-o", path)
    capsys.readouterr()

    assert run("summary", path, "--json") == 0

    numbers = json.loads(capsys.readouterr().out)
    report = read_report(path)
    by_name = {found["name"]: found for found in numbers["objects"]}
    assert numbers["frames"] == len(CENTERS)
    assert by_name["hit"]["frames_colliding"] == report.objects["hit"].collides.sum()
    assert by_name["far"]["verdict"] == "kept"
    assert run("summary", path) == 0
    text = capsys.readouterr().out
    assert text.startswith("clash: 1 of 2 objects is touched, hit: ")
    assert text.splitlines()[0].endswith("sure; 1 keeps the distance")


@pytest.mark.slow
def test_an_interrupted_run_leaves_no_report_and_is_taken_up_to_the_same_bits(
    tmp_path: Path, scene: Path, run: Run
) -> None:
    centers = np.tile(CENTERS, (6, 1))  # a part is 64 frames
    session = write_ball_session(tmp_path / "session", centers, n_cameras=2)
    path, whole = tmp_path / "report.h5", tmp_path / "whole.h5"
    arguments = ["detect", str(session), "--scene", str(scene), "--engine", "reference"]
    arguments += ["--no-progress"]
    # The run interrupts itself once a part stands. A shell that starts the tests in the background
    # has them ignore the signal; here it counts.
    code = (
        "import os, signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from hybridve.hull.report.write import ReportWriter\n"
        "append = ReportWriter.append\n"
        "def append_and_interrupt(writer, result):\n"
        "    append(writer, result)\n"
        "    if writer.n_done: os.kill(os.getpid(), signal.SIGINT)\n"
        "ReportWriter.append = append_and_interrupt\n"
        "from hybridve.cli.main import main; main()"
    )
    process = subprocess.run(
        [sys.executable, "-c", code, *arguments, "-o", str(path)],
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    error = process.stderr

    assert list(tmp_path.glob("report.h5.parts/*.npz"))
    assert process.returncode == 130, error
    assert "Traceback" not in error
    assert not path.exists()
    assert run(*arguments, "-o", path, "--resume") == 0
    assert run(*arguments, "-o", whole) == 0
    with h5py.File(path) as resumed, h5py.File(whole) as expected:
        compared = 0
        names: list[str] = []
        expected["hybridve"].visit(names.append)
        for name in names:
            item = expected["hybridve"][name]
            if isinstance(item, h5py.Dataset) and "stage_s" not in name:
                assert (
                    resumed["hybridve"][name][()].tobytes() == item[()].tobytes()
                    if (item.shape)
                    else resumed["hybridve"][name][()] == item[()]
                ), name
                compared += 1
        assert compared > 10
    assert not (tmp_path / "report.h5.parts").exists()


@pytest.mark.slow
def test_what_the_samples_miss_is_certified_told_and_fails_on_clash(
    run: Run, tmp_path: Path, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At viewport 1 only centroids are asked: in some frames none is in the ball."""
    path, plain = tmp_path / "certified.h5", tmp_path / "sampled.h5"
    common = ("detect", session, "--scene", scene, "--viewport", 1)

    assert run(*common, "-o", path, "--fail-on-clash") == 3
    told = capsys.readouterr().out
    assert run(*common, "-o", plain, "--open-at-mm", 0) == 0

    hit = read_report(path).objects["hit"]
    missed = (hit.certificate == "colliding") & ~hit.collides
    assert missed.any()
    count = missed.sum()
    frames = "frame" if count == 1 else "frames"
    assert f"hit: in {count} {frames} no sample collides, but a certified point does" in told
    # The witness is on the cube's surface, in a frame whose ball is there.
    np.testing.assert_allclose(np.abs(hit.witness_m[missed]).max(axis=1), HALF_M, atol=1e-9)
    distance_m = np.linalg.norm(hit.witness_m[missed] - CENTERS[missed], axis=1)
    assert (distance_m < 1.5 * BALL_RADIUS_M).all()
    sampled = read_report(plain).objects["hit"]
    np.testing.assert_array_equal(sampled.collides, hit.collides)
    assert (sampled.certificate[missed] == "").all()


@pytest.mark.slow
def test_whoever_leaves_a_recording_early_leaves_no_thread_behind(tmp_path: Path) -> None:
    """A thread that is inside a library when Python ends would take the process down."""
    session = load_session(write_ball_session(tmp_path / "session", np.tile(CENTERS, (10, 1))))
    frames = segmented_frames(session, FrameRange())
    next(frames)
    lanes = [thread for thread in threading.enumerate() if thread.name.startswith("camera ")]
    assert len(lanes) == 4

    frames.close()

    assert not any(lane.is_alive() for lane in lanes)
