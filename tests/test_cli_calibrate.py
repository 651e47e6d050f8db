"""``hybridve calibrate`` from end to end, on rendered pictures: files, verdicts, statuses."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from helpers.boards import board_poses, look_at, make_camera, render_board
from helpers.recorded_boards import held_up
from helpers.records import make_opinion
from numpy.typing import NDArray

from hybridve.calib.boards.board import Detection, Effort
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.formats.rig_json import read_rig
from hybridve.calib.judging.account import Calibration
from hybridve.calib.pose import compose
from hybridve.calib.record import BY_SCENE, Labelling
from hybridve.cli.calibrate import NOT_GOOD_ENOUGH, calibrate
from hybridve.hull.capture import rig as rig_of_session

Run = Callable[..., int]
Captured = pytest.CaptureFixture[str]

#: Rendered boards of few stills place cameras to this, metres.
PLACED_M = 0.02

SIZE_PX = (320, 240)
BOARD = Chessboard(7, 6, 0.1)
HEAD = (
    'format = "hybridve-session"\nversion = 1\nfps = 25\n[target]\nkind = "chessboard"\n'
    "columns = 7\nrows = 6\nsquare_mm = 100\n"
)
CAMERA = '[[camera]]\nname = "{}"\nmodel = "{}"\nextrinsics = "{}"\n'


def around() -> list[Camera]:
    """Three cameras about a board on the floor, of different focal lengths."""
    x, y, _ = BOARD.center_board
    cameras = []
    for index, (dx, dy, height) in enumerate(
        [(-0.9, -0.7, 1.0), (0.8, -0.8, 1.1), (0.1, 1.1, 1.2)]
    ):
        pose = look_at((x + dx, y + dy, height), (x, y, 0.0))
        camera = make_camera(f"cam{index + 1}", "SIMPLE_PINHOLE", pose, SIZE_PX)
        params = camera.params * [1.0 + 0.15 * index, 1.0, 1.0]
        cameras.append(Camera(camera.name, camera.model, *SIZE_PX, params, camera.cam_from_world))
    return cameras


def bumped(camera: Camera) -> Camera:
    """Return the camera as it stands after somebody ran into it."""
    pose = camera.cam_from_world.copy()
    turn = cv2.Rodrigues(np.array([0.0, 0.05, 0.02]))[0]
    moved = np.column_stack([turn, [0.03, 0.0, 0.0]])
    return Camera(camera.name, camera.model, *SIZE_PX, camera.params, compose(moved, pose))


def in_front() -> list[Camera]:
    """Two cameras side by side, before whom a board is moved."""
    return [
        make_camera(name, "SIMPLE_PINHOLE", look_at((x, -1.7, 0.1), (x, 0.0, 0.0)), SIZE_PX)
        for name, x in (("left", 0.0), ("right", 0.25))
    ]


def read(path: Path) -> NDArray[np.uint8]:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)


def write(path: Path, image: cv2.typing.MatLike) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of pictures: sessions in it share what was found in them."""
    root = tmp_path_factory.mktemp("recorded")
    for index, camera in enumerate(around()):
        folder = root / camera.name
        for number, pose in enumerate(board_poses(BOARD, 4, index)):
            write(folder / f"stills/{number}.png", render_board(camera, BOARD, pose, samples=2))
        picture = render_board(camera, BOARD, samples=2)
        write(folder / "clip/0.png", picture)
    write(root / "cam2/bumped/0.png", render_board(bumped(around()[1]), BOARD, samples=2))
    for number in range(4):
        still = read(root / f"cam2/stills/{number}.png")
        write(root / f"cam2/turned/stills/{number}.png", cv2.rotate(still, cv2.ROTATE_180))
    still = read(root / "cam2/clip/0.png")
    write(root / "cam2/turned/clip/0.png", cv2.rotate(still, cv2.ROTATE_180))
    rng = np.random.default_rng(3)
    for number in range(4):
        pose = held_up(rng, BOARD, (0.12 + rng.uniform(-0.1, 0.1), rng.uniform(-0.2, 0.1), 0.05))
        for camera in in_front():
            seen = compose(camera.cam_from_world, pose)
            image = render_board(camera, BOARD, seen, samples=2)
            write(root / camera.name / f"{number}.png", image)
            write(root / camera.name / f"mirrored/{number}.png", cv2.flip(image, 1))
    return root


def session(root: Path, name: str, cameras: list[tuple[str, str, str | None]]) -> Path:
    """Write a session of cameras: name, pattern of the clip, and of the stills."""
    path = root / f"{name}.toml"
    text = HEAD
    for camera, clip, stills in cameras:
        text += CAMERA.format(camera, "SIMPLE_PINHOLE", clip)
        text += f'intrinsics = "{stills}"\n' if stills else ""
    path.write_text(text, encoding="utf-8")
    return path


def standing(root: Path, name: str = "session", **clips: str) -> Path:
    """Write the session of the three cameras; some clips may be others."""
    names = [camera.name for camera in around()]
    return session(
        root,
        name,
        [(one, f"{clips.get(one, one + '/clip')}/*.png", f"{one}/stills/*.png") for one in names],
    )


@pytest.fixture(scope="module")
def calibrated(recorded: Path) -> tuple[Path, dict[str, Any], str]:
    """The folder of a rig, what --json told of it, and what was told on the way."""
    path, out = standing(recorded), recorded / "rig"
    ran = CliRunner().invoke(calibrate, [str(path), "--json", "--max-error-mm", "100"])
    assert ran.exit_code == 0, ran.output
    return out, json.loads(ran.stdout), ran.stderr


@pytest.mark.slow
def test_the_rig_is_where_the_cameras_stood(calibrated: tuple[Path, dict[str, Any], str]) -> None:
    rig = read_rig(calibrated[0] / "rig.json")

    assert [camera.name for camera in rig.cameras] == ["cam1", "cam2", "cam3"]
    for camera in around():
        off_m = np.linalg.norm(rig[camera.name].center_world - camera.center_world)
        assert off_m < PLACED_M
    assert rig.covariance is not None


@pytest.mark.slow
def test_the_certificate_is_the_same_in_all_forms(
    calibrated: tuple[Path, dict[str, Any], str],
) -> None:
    folder, told, _ = calibrated
    certificate = json.loads((folder / "certificate.json").read_text(encoding="utf-8"))
    page = (folder / "certificate.html").read_text(encoding="utf-8")

    assert certificate == told["certificate"]
    assert certificate["verdict"].startswith("good to ")
    assert 0 < certificate["error95_m"] < 0.1
    assert certificate["doubts"] == []
    assert page.count("<img") > 3
    assert certificate["verdict"].split(";")[0] in page
    assert "data:image/jpeg;base64," in page, "the board, with the world's axes"
    assert told["rig"] == str(folder / "rig.json")
    assert told["page"] == str(folder / "certificate.html")
    assert [one["name"] for one in told["cameras"]] == ["cam1", "cam2", "cam3"]


@pytest.mark.slow
def test_nothing_half_written_stands_beside_the_rig(
    calibrated: tuple[Path, dict[str, Any], str],
) -> None:
    names = {path.name for path in calibrated[0].iterdir()}

    assert names == {"rig.json", "certificate.json", "certificate.html", "colmap", "corners"}


@pytest.mark.slow
def test_a_second_run_reads_no_picture_and_says_the_same(
    run: Run,
    capsys: Captured,
    calibrated: tuple[Path, dict[str, Any], str],
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a board was searched again")

    monkeypatch.setattr(Chessboard, "detect", refuse)

    out = tmp_path / "again"
    assert run("calibrate", standing(recorded), "-o", out, "--json", "--no-page") == 0

    again = json.loads(capsys.readouterr().out)
    assert again["certificate"] == calibrated[1]["certificate"]
    assert again["page"] is None
    assert not (out / "certificate.html").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("calibrated")
def test_without_a_page_nothing_is_loaded_that_makes_one(recorded: Path, tmp_path: Path) -> None:
    arguments = ["calibrate", str(standing(recorded)), "-o", str(tmp_path / "rig"), "--no-page"]
    code = (
        f"import sys\nsys.argv = ['hybridve', *{arguments}]\n"
        "from hybridve.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as left:\n    assert not left.code\n"
        "print([n for n in ('jinja2', 'matplotlib') if n in sys.modules])"
    )

    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert (tmp_path / "rig" / "rig.json").exists()
    assert shown.stdout.strip().endswith("[]")


@pytest.mark.slow
def test_what_is_unusual_about_boards_is_told_once(
    run: Run, capsys: Captured, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(recorded, tmp_path / "copy", ignore=shutil.ignore_patterns("rig"))
    detect = Chessboard.detect

    def detect_inverted(board: Chessboard, image: NDArray[np.uint8], effort: Effort) -> Detection:
        return replace(detect(board, image, effort), notes=("inverted",))

    monkeypatch.setattr(Chessboard, "detect", detect_inverted)

    assert run("calibrate", standing(tmp_path / "copy"), "--no-page") == 0

    lines = [line for line in capsys.readouterr().out.splitlines() if "inverted" in line]
    assert len(lines) == 3  # one a camera, however many pictures
    assert all(line.strip().endswith(" views: inverted") for line in lines)


@pytest.mark.slow
def test_a_rig_that_exists_is_kept_unless_told(
    run: Run, capsys: Captured, calibrated: tuple[Path, dict[str, Any], str], recorded: Path
) -> None:
    path = calibrated[0] / "rig.json"
    before = path.read_bytes(), path.stat().st_mtime_ns

    expect_error(run, capsys, "rig.json", "calibrate", standing(recorded), "--no-progress")
    assert (path.read_bytes(), path.stat().st_mtime_ns) == before

    assert run("calibrate", standing(recorded), "--no-progress", "--overwrite") == 0
    assert path.stat().st_mtime_ns != before[1]
    assert read_rig(path)["cam1"].params == pytest.approx(
        np.array(json.loads(before[0])["cameras"][0]["params"])
    )


@pytest.mark.slow
def test_the_text_begins_with_the_verdict(
    run: Run,
    capsys: Captured,
    calibrated: tuple[Path, dict[str, Any], str],
    recorded: Path,
    tmp_path: Path,
) -> None:
    assert run("calibrate", standing(recorded), "-o", tmp_path / "rig", "--no-page") == 0

    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == calibrated[1]["certificate"]["verdict"]
    told = calibrated[1]["certificate"]["second_opinion"]
    assert told["difference95_m"] < told["expected95_m"]
    (opinion,) = [line for line in lines if "second opinion" in line]
    assert f"{told['sigmas']:.1f} standard deviations" in opinion
    assert lines[1] == f"{tmp_path / 'rig' / 'rig.json'}: 3 cameras"
    low, high = (calibrated[1]["certificate"][f"volume_{end}_m"] for end in ("low", "high"))
    assert f"x {low[0]:.2f} to {high[0]:.2f}, y {low[1]:.2f} to {high[1]:.2f}" in lines[2]


@pytest.mark.slow
def test_a_rig_that_is_not_good_enough_has_a_status_of_its_own(
    run: Run, capsys: Captured, recorded: Path, tmp_path: Path
) -> None:
    arguments = ["calibrate", standing(recorded), "-o", tmp_path / "rig", "--no-page"]

    assert run(*arguments, "--max-error-mm", "0.001") == NOT_GOOD_ENOUGH == 4

    shown = capsys.readouterr()
    assert "not to 0.001 mm as --max-error-mm asks" in shown.err
    assert shown.out.startswith("good to ")
    assert (tmp_path / "rig" / "rig.json").is_file()


def contradicted(made: Calibration) -> Calibration:
    assert made.record.adjustment is not None
    adjustment = replace(made.record.adjustment, warnings=("cameras do not agree.",))
    return replace(made, record=replace(made.record, adjustment=adjustment))


def labelled_by_chance(made: Calibration) -> Calibration:
    weak = Labelling(
        looks=2,
        decided_by=BY_SCENE,
        matches_by_look={},
        margin_sigma={},
        weakest_sigma=1.0,
        is_weak=True,
    )
    return replace(made, record=replace(made.record, labelling=weak))


def contradicted_by_colmap(made: Calibration) -> Calibration:
    return replace(made, record=replace(made.record, second_opinion=make_opinion(9.0)))


def with_a_twin(made: Calibration) -> Calibration:
    first, second, third = made.rig.cameras
    twin = replace(first, name=second.name)
    return replace(made, rig=replace(made.rig, cameras=(first, twin, third)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("doubtful", "told"),
    [
        (contradicted, "cameras do not agree."),
        (labelled_by_chance, "which way round each camera saw it"),
        (with_a_twin, "stand in one place"),
        (contradicted_by_colmap, "COLMAP's own adjustment of the same points"),
    ],
)
def test_a_rig_that_is_doubted_passes_no_gate(
    run: Run,
    capsys: Captured,
    calibrated: tuple[Path, dict[str, Any], str],
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    doubtful: Callable[[Calibration], Calibration],
    told: str,
) -> None:
    """However small the error that is stated: without the doubt this rig passes 100 mm."""
    calibrate_well = rig_of_session.calibrate_session
    monkeypatch.setattr(
        rig_of_session, "calibrate_session", lambda *given: doubtful(calibrate_well(*given))
    )
    arguments = ["calibrate", standing(recorded), "-o", tmp_path / "rig", "--no-page"]

    assert run(*arguments, "--max-error-mm", "100") == NOT_GOOD_ENOUGH

    shown = capsys.readouterr()
    assert shown.out.startswith("not to be trusted: ")
    assert told in shown.out.splitlines()[0]
    assert "an unknown error, not to 100 mm" in shown.err
    assert calibrated[1]["certificate"]["doubts"] == []


@pytest.mark.slow
def test_the_volume_is_the_one_that_is_asked_for(
    run: Run,
    capsys: Captured,
    calibrated: tuple[Path, dict[str, Any], str],
    recorded: Path,
    tmp_path: Path,
) -> None:
    box = "0,0,0:600,500,200"
    arguments = ["calibrate", standing(recorded), "-o", tmp_path / "rig", "--no-page", "--json"]

    assert run(*arguments, "--volume-mm", box) == 0

    certificate = json.loads(capsys.readouterr().out)["certificate"]
    usual = calibrated[1]["certificate"]["second_opinion"]
    assert certificate["second_opinion"]["expected95_m"] < usual["expected95_m"]
    low, high = certificate["volume_low_m"], certificate["volume_high_m"]
    assert (np.array(low) >= -1e-9).all()
    assert (np.array(high) <= [0.6 + 1e-9, 0.5 + 1e-9, 0.2 + 1e-9]).all()
    assert high[2] == pytest.approx(0.2)


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ["--volume-mm", "1,2:3,4"],
        ["--volume-mm", "10,0,0:0,10,10"],
        ["--max-error-mm", "0"],
        ["--rig-unit", "mm"],
        ["--pixel-centre", "0"],
    ],
)
def test_wrong_usage_is_status_2(
    run: Run, recorded: Path, tmp_path: Path, arguments: list[str]
) -> None:
    assert run("calibrate", standing(recorded), "-o", tmp_path / "rig", *arguments) == 2
    assert not (tmp_path / "rig").exists()


# --- A rig that is checked ------------------------------------------------------------------


@pytest.mark.slow
def test_a_rig_that_still_fits_passes_its_check(
    run: Run, capsys: Captured, calibrated: tuple[Path, dict[str, Any], str], recorded: Path
) -> None:
    rig = calibrated[0] / "rig.json"

    assert run("calibrate", "--check", rig, standing(recorded), "--no-progress", "--json") == 0

    told = json.loads(capsys.readouterr().out)
    assert told["is_trustworthy"]
    assert told["scale"] == pytest.approx(1.0, abs=0.01)


@pytest.mark.slow
def test_a_camera_that_was_bumped_is_named_with_status_4(
    run: Run, capsys: Captured, calibrated: tuple[Path, dict[str, Any], str], recorded: Path
) -> None:
    rig = calibrated[0] / "rig.json"
    today = standing(recorded, "today", cam2="cam2/bumped")

    assert run("calibrate", "--check", rig, today, "--no-progress") == NOT_GOOD_ENOUGH

    shown = capsys.readouterr()
    assert "cam2" in shown.out.splitlines()[0]
    assert "cam1" not in shown.out.splitlines()[0].replace("cam1.", "")


@pytest.mark.slow
def test_a_rig_in_squares_and_without_sizes_is_checked_by_the_session_that_has_both(
    run: Run, capsys: Captured, calibrated: tuple[Path, dict[str, Any], str], recorded: Path
) -> None:
    for camera in read_rig(calibrated[0] / "rig.json").cameras:
        storage = cv2.FileStorage(str(recorded / f"{camera.name}.yml"), cv2.FILE_STORAGE_WRITE)
        storage.write("K", camera.pinhole - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        storage.write("R", camera.cam_from_world[:, :3])
        storage.write("T", camera.cam_from_world[:, 3:] / BOARD.square_m)
        storage.release()
    rig = recorded / "{camera}.yml"
    path = standing(recorded)

    in_squares = ("--check", rig, path, "--rig-unit", "squares", "--no-progress", "--json")
    assert run("calibrate", *in_squares) == 0

    told = json.loads(capsys.readouterr().out)
    assert told["scale"] == pytest.approx(1.0, abs=0.01)

    # OpenCV's pixel centres lie at 0; read as COLMAP's, each camera's image is half a pixel off.
    assert run("calibrate", *in_squares, "--pixel-centre", "0") == 0
    assert json.loads(capsys.readouterr().out)["rms_px"] == told["rms_px"]
    run("calibrate", *in_squares, "--pixel-centre", "0.5")
    shifted = json.loads(capsys.readouterr().out)["rms_px"]
    assert max(shifted.values()) > max(told["rms_px"].values())


# --- Rigs made elsewhere --------------------------------------------------------------------


def test_a_rig_with_a_skew_is_taken_without_a_colmap_model_and_that_is_said(
    run: Run, capsys: Captured, tmp_path: Path
) -> None:
    matrices = []
    for camera in in_front():
        write(tmp_path / f"{camera.name}/0.png", np.zeros(SIZE_PX[::-1], np.uint8))
        skewed = camera.pinhole + np.outer([0.25, 0.0, 0.0], [0.0, 1.0, 0.0])
        numbers = (skewed @ camera.cam_from_world).ravel().tolist()
        matrices.append(" ".join([camera.name, *map(repr, numbers)]))
    (tmp_path / "rig.csv").write_text("\n".join(matrices) + "\n")
    (tmp_path / "session.toml").write_text(
        'format = "hybridve-session"\nversion = 1\nfps = 25\nrig = "rig.csv"\nrig_unit = "m"\n'
        + "".join(f'[[camera]]\nname = "{c.name}"\nmasks = "{c.name}/*.png"\n' for c in in_front())
    )
    older = tmp_path / "rig" / "colmap"
    older.mkdir(parents=True)
    (older / "cameras.txt").write_text("of another rig")

    assert run("calibrate", tmp_path, "-o", tmp_path / "a new" / "folder") == 0
    assert (tmp_path / "a new" / "folder" / "rig.json").is_file()
    capsys.readouterr()

    assert run("calibrate", tmp_path, "--no-progress") == 0

    told = [line for line in capsys.readouterr().out.splitlines() if "COLMAP" in line]
    assert told == [
        "  no COLMAP model is written: camera 'left' has a skew of 0.25 px, which no lens of "
        "COLMAP has (2 cameras are so); rig.json holds all"
    ]
    rig = read_rig(tmp_path / "rig" / "rig.json")
    assert [camera.skew_px for camera in rig.cameras] == pytest.approx([0.25, 0.25])
    assert not older.exists()


# --- Degenerate recordings ------------------------------------------------------------------


def expect_error(run: Run, capsys: Captured, message: str, *arguments: object) -> None:
    """Assert that a command fails with one line that tells something, and tells nothing else."""
    assert run(*arguments) == 1

    shown = capsys.readouterr()
    lines = [line for line in shown.err.splitlines() if not line.startswith("WARNING")]
    assert len(lines) == 1, shown.err
    assert lines[0].startswith("error: ")
    assert message in lines[0]
    assert shown.out == ""


def expect_no_rig(run: Run, capsys: Captured, message: str, path: Path, output: Path) -> None:
    """Assert that a session gives an error and no rig."""
    expect_error(run, capsys, message, "calibrate", path, "-o", output, "--no-progress")
    assert not (output / "rig.json").exists()
    assert not list(output.glob("certificate*"))


@pytest.mark.slow
def test_one_camera_is_calibrated_and_passes_no_gate(
    run: Run, capsys: Captured, recorded: Path, tmp_path: Path
) -> None:
    alone = session(recorded, "alone", [("cam1", "cam1/clip/*.png", "cam1/stills/*.png")])
    arguments = ["calibrate", alone, "-o", tmp_path / "rig", "--no-progress", "--no-page"]

    assert run(*arguments, "--max-error-mm", "1000") == NOT_GOOD_ENOUGH

    shown = capsys.readouterr()
    assert "no error in mm can be stated" in shown.out
    assert "an unknown error" in shown.err
    off_m = np.linalg.norm(
        read_rig(tmp_path / "rig" / "rig.json")["cam1"].center_world - around()[0].center_world
    )
    assert off_m < PLACED_M


@pytest.mark.slow
def test_a_camera_upside_down_is_placed_as_it_hangs(
    run: Run, recorded: Path, tmp_path: Path
) -> None:
    hanging = session(
        recorded,
        "hanging",
        [
            ("cam1", "cam1/clip/*.png", "cam1/stills/*.png"),
            ("cam2", "cam2/turned/clip/*.png", "cam2/turned/stills/*.png"),
        ],
    )

    assert run("calibrate", hanging, "-o", tmp_path / "rig", "--no-page") == 0

    found, upright = read_rig(tmp_path / "rig" / "rig.json")["cam2"], around()[1]
    assert np.linalg.norm(found.center_world - upright.center_world) < PLACED_M
    half_a_turn = np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(
        found.cam_from_world[:, :3], half_a_turn @ upright.cam_from_world[:, :3], atol=0.02
    )


@pytest.mark.slow
def test_exchanged_clips_are_one_line(
    run: Run, capsys: Captured, recorded: Path, tmp_path: Path
) -> None:
    exchanged = standing(recorded, "exchanged", cam1="cam3/clip", cam3="cam1/clip")

    expect_no_rig(
        run, capsys, "'cam1' and 'cam3' seem to be exchanged", exchanged, tmp_path / "rig"
    )


@pytest.mark.slow
def test_a_recording_listed_twice_is_one_line(
    run: Run, capsys: Captured, recorded: Path, tmp_path: Path
) -> None:
    twice = standing(recorded, "twice", cam3="cam1/clip")
    text = twice.read_text(encoding="utf-8").replace("cam3/stills", "cam1/stills")
    twice.write_text(text, encoding="utf-8")

    expect_no_rig(run, capsys, "'cam1' and 'cam3' show the same pictures", twice, tmp_path / "rig")


@pytest.mark.slow
def test_mirrored_pictures_are_one_line(
    run: Run, capsys: Captured, recorded: Path, tmp_path: Path
) -> None:
    mirrored = session(
        recorded,
        "mirrored",
        [("left", "left/*.png", None), ("right", "right/mirrored/*.png", None)],
    )

    expect_no_rig(run, capsys, "seems to be mirrored", mirrored, tmp_path / "rig")


@pytest.mark.slow
def test_pictures_without_the_board_are_one_line(
    run: Run, capsys: Captured, recorded: Path, tmp_path: Path
) -> None:
    write(recorded / "bare/0.png", np.full((SIZE_PX[1], SIZE_PX[0]), 90, np.uint8))
    bare = standing(recorded, "bare", cam2="bare")

    expect_no_rig(
        run, capsys, "camera 'cam2': no board of 7x6 inner corners", bare, tmp_path / "rig"
    )


def test_of_many_cameras_the_nearest_and_the_farthest_are_told(
    run: Run, capsys: Captured, tmp_path: Path
) -> None:
    lines, tables = [], []
    for number in range(7):
        write(tmp_path / f"{number}/0.png", np.zeros(SIZE_PX[::-1], np.uint8))
        pose = look_at((float(number), -3.0, 1.0), (3.0, 0.0, 0.5))
        camera = replace(in_front()[0], name=f"cam{number}", cam_from_world=pose)
        numbers = (camera.pinhole @ pose).ravel().tolist()
        lines.append(",".join([camera.name, *map(repr, numbers)]))
        tables.append(f'[[camera]]\nname = "{camera.name}"\nmasks = "{number}/*.png"\n')
    (tmp_path / "rig.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "session.toml").write_text(
        'format = "hybridve-session"\nversion = 1\nfps = 25\nrig = "rig.csv"\nrig_unit = "m"\n'
        + "".join(tables)
    )

    assert run("calibrate", tmp_path, "--no-progress") == 0

    (told,) = [line for line in capsys.readouterr().out.splitlines() if "distances" in line]
    assert told.startswith("  21 distances, m: ")
    assert told.count(" 1.000") == 3  # of neighbours
    assert told.endswith("cam0 cam6 6.000; --json has all")
