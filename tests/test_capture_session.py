"""session.toml: what is accepted, and the one line for each mistake."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from hybridve.calib.errors import SessionError
from hybridve.hull.capture.session import load_session

HEAD = 'format = "hybridve-session"\nversion = 1\nfps = 25\n'
CAMERA = '[[camera]]\nname = "left"\nmasks = "left/*.png"\n'
TARGET = '[target]\nkind = "chessboard"\ncolumns = 8\nrows = 6\nsquare_mm = 30\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "left").mkdir()
    for number in (10, 2, 1):
        cv2.imwrite(str(tmp_path / "left" / f"{number}.png"), np.zeros((4, 6), np.uint8))
    (tmp_path / "note.avi").write_text("not a video", encoding="utf-8")
    return tmp_path


def session_path(folder: Path, text: str) -> Path:
    path = folder / "session.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_folder_stands_for_the_session_in_it(folder: Path) -> None:
    session_path(folder, HEAD + CAMERA)

    session = load_session(folder)

    assert session.path == folder / "session.toml"
    assert session.name == folder.name


def test_pictures_come_in_the_order_in_which_people_count(folder: Path) -> None:
    session = load_session(session_path(folder, HEAD + CAMERA))

    recording = session.cameras[0].recording
    assert recording is not None
    assert [path.name for path in recording.paths] == ["1.png", "2.png", "10.png"]


def test_the_root_may_name_the_environment_with_a_default(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = 'root = "${WHERE_RECORDINGS_ARE:-nowhere}/left"\n' + HEAD
    text += '[[camera]]\nname = "left"\nmasks = "*.png"\n'
    path = session_path(folder, text)

    monkeypatch.setenv("WHERE_RECORDINGS_ARE", str(folder))
    assert load_session(path).root == folder / "left"
    monkeypatch.delenv("WHERE_RECORDINGS_ARE")
    with pytest.raises(SessionError, match=r"root: there is no folder .*nowhere"):
        load_session(path)


def test_a_late_clock_becomes_a_whole_number_of_frames(folder: Path) -> None:
    session = load_session(session_path(folder, HEAD + CAMERA + "offset_s = 0.121\n"))

    assert session.cameras[0].shift_frames == 3


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (HEAD, r"camera: this key is missing"),
        (HEAD + "camera = []\n", r"camera: "),
        (CAMERA, r"format: this key is missing"),
        (HEAD + "fsp = 3\n" + CAMERA, r"fsp: there is no such key"),
        (HEAD.replace("25", "0") + CAMERA, r"fps: .*greater than 0"),
        (HEAD.replace("25", '"fast"') + CAMERA, r"fps: .*'fast'"),
        (HEAD + CAMERA + CAMERA, r"camera\.2\.name: 'left' is the name of camera\.1 too"),
        (HEAD + CAMERA + 'model = "FISHY"\n', r"camera\.1: unknown camera model 'FISHY'; one of"),
        (HEAD + CAMERA + "vidoe = 3\n", r"camera\.1\.vidoe: there is no such key"),
        (HEAD + CAMERA + 'video = "note.avi"\n', r"camera\.1: has both video and masks"),
        (
            HEAD + '[[camera]]\nname = "left"\nvideo = "note.avi"\n',
            r"camera\.1: has a video but no background",
        ),
        (
            HEAD + '[[camera]]\nname = "left"\nvideo = "note.avi"\nbackground = "note.avi"\n',
            r"camera\.1\.background: .*not a video",
        ),
        (HEAD + CAMERA + 'background = "no.avi"\n', r"camera\.1\.background: there is no file"),
        (HEAD + CAMERA.replace("*.png", "*.tif"), r"camera\.1\.masks: no file matches 'left/\*"),
        (HEAD + CAMERA + 'corners = "no.xml"\n', r"camera\.1\.corners: there is no file"),
        (HEAD + CAMERA + 'poses = "p.csv"\n', r"camera\.1\.poses: moving, tracked cameras"),
        (HEAD + 'unseen = "maybe"\n' + CAMERA, r"unseen: .*'maybe'"),
        (HEAD + "min_cameras = 2\n" + CAMERA, r"min_cameras: 2 of 1 cameras"),
        (HEAD + 'rig = "rig.csv"\n' + CAMERA, r"rig needs rig_unit .*never guessed"),
        (HEAD + 'rig = "r"\nrig_unit = "furlong"\n' + CAMERA, r"rig_unit: .*'furlong'"),
        (HEAD + 'rig = "r"\nrig_unit = "squares"\n' + CAMERA, r"needs a \[target\]"),
        (HEAD + "rig_pixel_centre = 0.3\n" + CAMERA, r"rig_pixel_centre: "),
        (HEAD + CAMERA + TARGET.replace("30", "-3"), r"target\.square_mm: "),
        (HEAD + CAMERA + TARGET.replace("chess", "card"), r"target\.kind: .*'cardboard'"),
        (HEAD + CAMERA + "[segmentation]\nmagic = 1\n", r"segmentation\.magic: there is no such"),
        (HEAD + CAMERA + "[[[\n", r"not valid TOML: .*line"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_key(folder: Path, text: str, line: str) -> None:
    with pytest.raises(SessionError, match=line) as caught:
        load_session(session_path(folder, text))

    assert "session.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_session_is_named(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match=r"session\.toml: there is no such session"):
        load_session(tmp_path)


@pytest.mark.parametrize("name", ["horseman", "child_rope", "dino_ring"])
@pytest.mark.recording
def test_the_sessions_of_the_project_load(
    recordings: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("HYBRIDVE_DATA", str(recordings))

    session = load_session(Path(__file__).parent.parent / "data" / name)

    assert len(session.cameras) == {"horseman": 4, "child_rope": 10, "dino_ring": 15}[name]
