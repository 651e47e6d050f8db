"""What a user gets wrong: one line, status 1, nothing lost and nothing half-written."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.sessions import SESSION_HEAD, write_ball_session, write_cube_scene
from PIL import Image

Run = Callable[..., int]

ORIENTATION = 0x0112
RIG = 'rig = "rig.csv"\nrig_unit = "m"\n'
TARGET = '[target]\nkind = "chessboard"\ncolumns = 8\nrows = 6\nsquare_mm = 30\n'


def write_video(path: Path, size_px: tuple[int, int], n_frames: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    # OpenCV's own encoder is in every build.
    fourcc = cv2.VideoWriter.fourcc(*"MJPG")
    video = cv2.VideoWriter(str(path), cv2.CAP_OPENCV_MJPEG, fourcc, 25.0, size_px)
    rng = np.random.default_rng(0)
    for _ in range(n_frames):
        video.write(rng.integers(100, 110, (size_px[1], size_px[0], 3)).astype(np.uint8))
    video.release()


@pytest.fixture
def films(tmp_path: Path) -> Path:
    """A session of two cameras with videos; background and board clip are of the same size."""
    cameras = []
    for name in ("left", "right"):
        for kind, n_frames in (("background", 3), ("board", 3), ("video", 6)):
            write_video(tmp_path / name / f"{kind}.avi", (64, 48), n_frames)
        cameras.append(
            f'[[camera]]\nname = "{name}"\nbackground = "{name}/background.avi"\n'
            f'video = "{name}/video.avi"\nextrinsics = "{name}/board.avi"\n'
            f'intrinsics = "{name}/board.avi"\n'
        )
    matrix = "50,0,32,0,0,50,24,0,0,0,1,2"
    (tmp_path / "rig.csv").write_text(f"left,{matrix}\nright,{matrix}\n", encoding="utf-8")
    text = SESSION_HEAD + RIG + "\n" + "\n".join(cameras)
    (tmp_path / "session.toml").write_text(text, encoding="utf-8")
    write_cube_scene(tmp_path, {"cube": (0.0, 0.0, 0.0)})
    return tmp_path


def expect_one_line(
    run: Run, capsys: pytest.CaptureFixture[str], message: str, *arguments: object
) -> None:
    assert run(*arguments) == 1

    shown = capsys.readouterr()
    lines = [line for line in shown.err.splitlines() if not line.startswith("WARNING")]
    assert len(lines) == 1, shown.err
    assert lines[0].startswith("error: ")
    assert message in lines[0]
    assert shown.out == ""


def detect_arguments(folder: Path) -> list[object]:
    output = folder / "report.h5"
    return ["detect", folder, "--scene", folder / "scene.toml", "-o", output, "--no-progress"]


#: Commands that work long, each with what it needs besides the session; "OUT" is its output.
LONG: dict[str, tuple[object, ...]] = {
    "calibrate": ("-o", "OUT"),
    "detect": ("--scene", "SCENE", "-o", "OUT"),
    "segment": (),
    "simulate": ("--scene", "SCENE", "-o", "OUT"),
    "spacing": (*("--scene", "SCENE", "--move", "cube", "--along", "0,0,1"), "--range-mm", "0:9"),
    "sweep": ("--scene", "SCENE", "-o", "OUT"),
}


def long_arguments(command: str, folder: Path) -> list[object]:
    paths = {"SCENE": folder / "scene.toml", "OUT": folder / "out.h5"}
    return [command, folder, *(paths.get(str(word), word) for word in LONG[command])]


def told(run: Run, capsys: pytest.CaptureFixture[str], *arguments: object) -> list[str]:
    assert run(*arguments, "--no-progress") == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    return shown.err.splitlines()


@pytest.mark.parametrize("command", LONG)
def test_all_that_is_wrong_with_the_files_is_told_in_one_go_before_any_work(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path, command: str
) -> None:
    write_video(films / "left" / "board.avi", (64, 48), 0)
    write_video(films / "right" / "background.avi", (48, 64), 3)
    scene = films / "scene.toml"
    scene.write_text(scene.read_text(encoding="utf-8").replace('unit = "mm"', 'unit = "mile"'))
    before = sorted(films.rglob("*"))

    lines = told(run, capsys, *long_arguments(command, films))

    wanted = [
        "camera.1.intrinsics: left/board.avi: no frame can be read",
        "camera.1.extrinsics: left/board.avi: no frame can be read",
        "camera.2.background: 'right/background.avi' is 48x64, but 'right/video.avi' is 64x48; one "
        "was turned when it was saved; give all as the camera wrote them",
    ]
    if "SCENE" in LONG[command]:
        wanted.append("scene.toml: object.1.unit: ")
    for text in wanted:
        assert sum(text in line for line in lines) == 1, (text, lines)
    assert len(lines) == len(wanted), lines
    assert all(line.startswith("error: ") for line in lines)
    assert sorted(films.rglob("*")) == before


@pytest.mark.parametrize("command", LONG)
def test_all_files_that_are_missing_are_told_in_one_go(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path, command: str
) -> None:
    (films / "left" / "video.avi").unlink()
    (films / "right" / "board.avi").unlink()
    before = sorted(films.rglob("*"))
    arguments = long_arguments(command, films)

    lines = told(run, capsys, *arguments)

    if command == "simulate":  # the scene names no effect, and that is told besides
        assert "names no effect" in lines.pop(0)
    assert [line.split(": ")[2] for line in lines] == [
        "camera.1.video",
        "camera.2.intrinsics",
        "camera.2.extrinsics",
    ]
    assert sorted(films.rglob("*")) == before


@pytest.mark.parametrize("command", ["detect", "simulate"])
def test_a_run_that_was_cut_off_is_told_before_any_work(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path, command: str
) -> None:
    (films / "out.h5.parts").mkdir()
    (films / "rig.csv").unlink()  # what would be found later

    lines = told(run, capsys, *long_arguments(command, films))

    assert any(
        "a run that was cut off stands there; take it up with --resume" in one for one in lines
    )
    assert not any("rig.csv" in line for line in lines)


def test_frames_that_no_camera_has_are_told_before_any_work(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path
) -> None:
    message = "has none of the frames 100:200:1: it has 6, the first of which is 0"

    expect_one_line(run, capsys, message, *detect_arguments(films), "--frames", "100:200")

    assert not (films / "report.h5").exists()


def still(path: Path, size_px: tuple[int, int], orientation: int = 1) -> None:
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    Image.new("RGB", size_px, (90, 90, 90)).save(path, exif=exif)


def with_stills(films: Path) -> None:
    session = films / "session.toml"
    text = session.read_text(encoding="utf-8")
    session.write_text(text.replace('"left/board.avi"', '"left/still*.jpg"'), encoding="utf-8")


def test_tags_that_differ_are_a_warning_and_the_pixels_stay(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path
) -> None:
    with_stills(films)
    for number, orientation in enumerate((1, 6, 1)):
        still(films / "left" / f"still{number}.jpg", (64, 48), orientation)

    assert run(*detect_arguments(films)) == 0

    warned = [line for line in capsys.readouterr().err.splitlines() if "say that they are" in line]
    assert len(warned) == 2, warned  # of intrinsics and of extrinsics, which are the same stills
    assert "camera.1.intrinsics: the pictures of 'left/still*.jpg' say that they are" in warned[0]
    assert "turned by 90 degrees, upright" in warned[0]


def test_stills_of_which_some_were_turned_when_they_were_saved_are_refused(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path
) -> None:
    with_stills(films)
    for number, size_px in enumerate(((64, 48), (48, 64), (64, 48))):
        still(films / "left" / f"still{number}.jpg", size_px)

    lines = told(run, capsys, *long_arguments("calibrate", films))

    text = (
        "camera.1.intrinsics: 'left/still*.jpg': 'still1.jpg' is 48x64, the first picture 64x48: "
        "some were turned when they were saved; give all as the camera wrote them"
    )
    assert sum(text in line for line in lines) == 1
    assert len(lines) == 2


@pytest.mark.slow
def test_the_session_of_these_tests_is_good(run: Run, films: Path) -> None:
    assert run(*detect_arguments(films)) == 0
    assert run("segment", films, "--no-progress") == 0


@pytest.mark.parametrize("command", ["detect", "segment"])
def test_a_video_of_another_size_than_its_background(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path, command: str
) -> None:
    write_video(films / "right" / "background.avi", (80, 48), 3)
    arguments = detect_arguments(films) if command == "detect" else ["segment", films]
    message = "camera.2.background: 'right/background.avi' is 80x48, but 'right/video.avi' is 64x48"

    expect_one_line(run, capsys, message, *arguments)

    assert not (films / "report.h5").exists()
    assert not (films / "silhouettes.h5").exists()


def test_a_recording_without_a_frame(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path
) -> None:
    write_video(films / "left" / "video.avi", (64, 48), 0)

    expect_one_line(run, capsys, "left/video.avi", *detect_arguments(films))


def test_a_background_without_a_frame(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path
) -> None:
    write_video(films / "left" / "background.avi", (64, 48), 0)

    expect_one_line(run, capsys, "left/background.avi", *detect_arguments(films))


def test_no_board_in_the_pictures(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path
) -> None:
    session = films / "session.toml"
    text = session.read_text(encoding="utf-8").replace(RIG, TARGET)
    session.write_text(text, encoding="utf-8")

    expect_one_line(run, capsys, "left", "calibrate", films, "--no-progress")

    assert not (films / "rig" / "rig.json").exists()


def test_neither_a_board_nor_a_rig(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path
) -> None:
    session = films / "session.toml"
    session.write_text(session.read_text(encoding="utf-8").replace(RIG, ""), encoding="utf-8")

    expect_one_line(run, capsys, "neither a [target]", "calibrate", films)


def test_a_rig_without_one_of_the_cameras(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path
) -> None:
    rig = films / "rig.csv"
    rig.write_text(rig.read_text(encoding="utf-8").splitlines()[0] + "\n", encoding="utf-8")

    expect_one_line(run, capsys, "right", *detect_arguments(films))


def test_a_rig_that_is_broken(run: Run, capsys: pytest.CaptureFixture[str], films: Path) -> None:
    (films / "rig.csv").write_text("left,1,2,3\n", encoding="utf-8")

    expect_one_line(run, capsys, "rig.csv", *detect_arguments(films))


@pytest.mark.parametrize("arguments", [["detect", "nothing"], ["segment", "nothing"]])
def test_no_such_session(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path, arguments: list[str]
) -> None:
    rest = detect_arguments(films)[2:] if arguments[0] == "detect" else []

    expect_one_line(run, capsys, "nothing: there is no such session", *arguments, *rest)


def test_no_such_scene(run: Run, capsys: pytest.CaptureFixture[str], films: Path) -> None:
    (films / "scene.toml").unlink()

    expect_one_line(run, capsys, "there is no such scene", *detect_arguments(films))


def test_an_output_that_cannot_be_written(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path
) -> None:
    arguments = detect_arguments(films)
    arguments[5] = Path("/proc/report.h5")  # not even root may write there

    expect_one_line(run, capsys, "/proc/report.h5: cannot be written", *arguments)


def test_an_output_that_is_a_folder(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path
) -> None:
    arguments = detect_arguments(films)
    arguments[5] = films

    expect_one_line(run, capsys, "is a folder", *arguments)


@pytest.mark.parametrize("command", ["calibrate", "segment"])
def test_results_that_exist_are_kept(
    run: Run, capsys: pytest.CaptureFixture[str], tmp_path: Path, command: str
) -> None:
    session = write_ball_session(tmp_path, np.zeros((1, 3)))
    kept = tmp_path / {"calibrate": "rig/rig.json", "segment": "silhouettes.h5"}[command]
    kept.parent.mkdir(exist_ok=True)
    kept.write_text("precious", encoding="utf-8")

    expect_one_line(run, capsys, "exists already", command, session)

    assert kept.read_text(encoding="utf-8") == "precious"


def test_stored_silhouettes_that_are_damaged(
    run: Run, capsys: pytest.CaptureFixture[str], films: Path
) -> None:
    assert run("segment", films, "--no-progress") == 0
    capsys.readouterr()
    path = films / "silhouettes.h5"
    path.write_bytes(path.read_bytes()[:1000])

    expect_one_line(run, capsys, "hybridve segment --overwrite", *detect_arguments(films))


@pytest.mark.slow
def test_stored_silhouettes_serve_until_the_recording_changes(run: Run, films: Path) -> None:
    from hybridve.hull.report.read import read_report

    def where() -> object:
        return read_report(films / "report.h5").settings["silhouettes"]

    assert run("segment", films, "--no-progress") == 0
    assert run(*detect_arguments(films)) == 0
    assert where() == str(films / "silhouettes.h5")
    write_video(films / "left" / "video.avi", (64, 48), 7)
    write_video(films / "right" / "video.avi", (64, 48), 7)

    assert run(*detect_arguments(films), "--overwrite") == 0

    assert where() is None
    assert len(read_report(films / "report.h5").index) == 7


def test_a_report_that_is_none(run: Run, capsys: pytest.CaptureFixture[str], films: Path) -> None:
    expect_one_line(run, capsys, "not a readable report", "summary", films / "scene.toml")
    expect_one_line(run, capsys, "there is no such report", "summary", films / "no.h5")


def test_an_unknown_preset(run: Run, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    expect_one_line(run, capsys, "boxes", "synth", "castle", "-o", tmp_path / "out")

    assert not (tmp_path / "out").exists()
