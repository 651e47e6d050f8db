"""Files as people have them: names, capitals, brackets, what other systems leave behind."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.sessions import write_ball_session, write_cube_scene

from hybridve.calib.errors import SessionError
from hybridve.calib.image_io import open_source
from hybridve.hull.capture.session import load_session
from hybridve.hull.report.read import read_report
from hybridve.hull.toml_io import read_toml


def write_pictures(folder: Path, *names: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(names):
        good, packed = cv2.imencode(".png", np.full((8, 8), number, np.uint8))
        assert good
        (folder / name).write_bytes(packed.tobytes())


def names_of(root: Path, name: str) -> list[str]:
    return [path.name for path in open_source(root, name).paths]


def test_a_file_of_that_very_name_comes_before_a_pattern(tmp_path: Path) -> None:
    write_pictures(tmp_path, "take [1].png", "take 1.png", "what?.png")

    assert names_of(tmp_path, "take [1].png") == ["take [1].png"]
    assert names_of(tmp_path, "what?.png") == ["what?.png"]
    assert names_of(tmp_path, "take ?.png") == ["take 1.png"]


def test_capitals_are_found_where_nothing_else_is(tmp_path: Path) -> None:
    write_pictures(tmp_path / "loud", "IMG_2.PNG", "IMG_10.PNG")
    write_pictures(tmp_path / "both", "1.png", "2.PNG")

    assert names_of(tmp_path, "loud/img_*.png") == ["IMG_2.PNG", "IMG_10.PNG"]
    assert names_of(tmp_path, "loud/IMG_[0-9].png") == ["IMG_2.PNG"]
    assert names_of(tmp_path, "both/*.png") == ["1.png"]
    with pytest.raises(SessionError, match="no file matches 'loud/none_"):
        open_source(tmp_path, "loud/none_*.png")


def test_what_macos_leaves_is_no_picture(tmp_path: Path) -> None:
    write_pictures(tmp_path, "1.png", "2.png")
    (tmp_path / "._1.png").write_bytes(b"\0\5\x16\7")

    assert names_of(tmp_path, "*.png") == ["1.png", "2.png"]


def test_paths_of_windows_are_understood(tmp_path: Path) -> None:
    write_pictures(tmp_path / "cam1" / "board", "1.png", "2.png")

    assert names_of(tmp_path, "cam1\\board\\1.png") == ["1.png"]
    assert names_of(tmp_path, "cam1\\board\\*.png") == ["1.png", "2.png"]


def test_a_name_that_is_nearly_right_is_told(tmp_path: Path) -> None:
    write_pictures(tmp_path, "background.png")

    with pytest.raises(SessionError, match=r"no file 'backgruond.png'.*did you mean 'background"):
        open_source(tmp_path, "backgruond.png")
    with pytest.raises(SessionError, match="there is no folder"):
        open_source(tmp_path, "nowhere/background.png")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_toml_is_read_as_windows_writes_it(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "session.toml"
    path.write_bytes('name = "Gerät"\r\nrows = 3\r\n'.encode(encoding))

    assert read_toml(path, "session", SessionError)[0] == {"name": "Gerät", "rows": 3}


def test_toml_that_cannot_be_read_says_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "session.toml"
    path.write_bytes('name = "Gerät"'.encode("latin-1"))
    with pytest.raises(SessionError, match="not UTF-8 at byte 11; save it as UTF-8"):
        read_toml(path, "session", SessionError)
    path.write_text('video = "cam1\\video.avi"\n', encoding="utf-8")
    with pytest.raises(SessionError, match="write folders with /"):
        read_toml(path, "session", SessionError)


@pytest.mark.parametrize("name", ["Camera 1", "Kamera ü", "left (wide)", "cam[2]"])
def test_a_camera_may_be_called_as_people_call_it(tmp_path: Path, name: str) -> None:
    path = write_ball_session(tmp_path, np.zeros((2, 3)), n_cameras=3)
    text = path.read_text(encoding="utf-8").replace('name = "cam1"', f'name = "{name}"')
    path.write_text(text, encoding="utf-8")

    assert load_session(path).cameras[1].name == name


@pytest.mark.parametrize("name", ["a/b", "", " a", "a ", ".a", "a\\\\b", "a'b"])
def test_a_name_that_cannot_be_a_folder_is_refused_in_words(tmp_path: Path, name: str) -> None:
    path = write_ball_session(tmp_path, np.zeros((2, 3)), n_cameras=3)
    text = path.read_text(encoding="utf-8").replace('name = "cam1"', f'name = "{name}"')
    path.write_text(text, encoding="utf-8")

    with pytest.raises(SessionError, match=r"camera.2.name: found .*expected a name without") as e:
        load_session(path)
    assert "pattern" not in str(e.value)


def test_keys_that_do_not_exist_name_what_they_are_most_like_all_in_one_go(tmp_path: Path) -> None:
    path = write_ball_session(tmp_path, np.zeros((2, 3)), n_cameras=2)
    text = path.read_text(encoding="utf-8")
    path.write_text(
        text.replace("fps = 25", "fpss = 25").replace('name = "cam1"', 'name = "cam1"\noffset = 1'),
        encoding="utf-8",
    )

    with pytest.raises(SessionError) as error:
        load_session(path)

    (line,) = str(error.value).splitlines()
    assert "fpss: there is no such key; did you mean fps?" in line
    assert "camera.2.offset: there is no such key; did you mean offset_s?" in line


@pytest.mark.parametrize(
    ("target", "line"),
    [
        ("sqare_mm = 30", "target.sqare_mm: there is no such key; did you mean square_mm?"),
        ("square_mm = 30\nzzz = 1", "target.zzz: there is no such key; there are kind, name"),
    ],
)
def test_a_mistyped_key_of_a_board_names_its_neighbour(
    tmp_path: Path, target: str, line: str
) -> None:
    path = write_ball_session(tmp_path, np.zeros((2, 3)), n_cameras=2)
    board = f'[target]\nkind = "chessboard"\ncolumns = 8\nrows = 6\n{target}\n'
    path.write_text(path.read_text(encoding="utf-8") + board, encoding="utf-8")

    with pytest.raises(SessionError) as error:
        load_session(path)

    assert line in str(error.value)


@pytest.mark.slow
def test_a_recording_with_names_with_spaces_goes_through_to_its_report(
    run: Callable[..., int], tmp_path: Path
) -> None:
    session = write_ball_session(tmp_path / "my session", np.zeros((2, 3)), n_cameras=3)
    text = session.read_text(encoding="utf-8").replace('name = "cam1"', 'name = "Camera 1"')
    session.write_text(text, encoding="utf-8")
    rig = session.with_name("rig.csv")
    rig.write_text(rig.read_text(encoding="utf-8").replace("cam1,", "Camera 1,"), encoding="utf-8")
    scene = write_cube_scene(tmp_path / "my scene", {"the box (left)": (0, 0, 0)})
    report, rig_out = tmp_path / "a report.h5", tmp_path / "rig out"

    assert run("detect", session, "--scene", scene, "-o", report) == 0
    assert run("convert", rig, "--from-unit", "m", "--to", "colmap", "-o", rig_out,
               "--image-size", "160x120") == 0  # fmt: skip

    found = read_report(report)
    assert list(found.objects) == ["the box (left)"]
    assert list(found.cameras) == ["cam0", "Camera 1", "cam2"]
    assert (
        run(
            "convert",
            rig_out,
            "--from-unit",
            "m",
            "--to",
            "csv",
            "--unit",
            "m",
            "-o",
            tmp_path / "back.csv",
        )
        == 0
    )
    lines = (tmp_path / "back.csv").read_text(encoding="utf-8").splitlines()
    # COLMAP cuts names off at spaces, so they are written without.
    names = {line.partition(",")[0] for line in lines[1:]}
    assert names == {"Camera_1", "cam0", "cam2"}
