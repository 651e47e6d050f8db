"""``hybridve init``: a session begun from the names of what lies in a folder."""

import tomllib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.sessions import CUBE

from hybridve.calib.errors import SceneError, SessionError
from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture.session import load_session

Run = Callable[..., int]

TARGET = 'kind = "chessboard"\ncolumns = 8\nrows = 6\nsquare_mm = 100'


def write_video(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (32, 24))
    for _ in range(3):
        writer.write(np.full((24, 32, 3), 90, np.uint8))
    writer.release()


def write_pictures(pattern: str, folder: Path, *, two_values: bool = False) -> None:
    """Write three pictures whose names have a number each where the pattern has ``#``."""
    shades = np.tile(np.arange(0, 256, 8, dtype=np.uint8), (24, 1))
    for number in range(9, 12):
        path = folder / pattern.replace("#", str(number))
        path.parent.mkdir(parents=True, exist_ok=True)
        image = np.where(shades > 100, 255, 0).astype(np.uint8) if two_values else shades
        cv2.imwrite(str(path), image)


def read(folder: Path) -> dict[str, dict[str, str]]:
    """Return what the session.toml says of each camera, by its name."""
    table = tomllib.loads((folder / "session.toml").read_text(encoding="utf-8"))
    return {camera.pop("name"): camera for camera in table.get("camera", [])}


@pytest.mark.parametrize(
    "name",
    [
        "{camera}/{what}.avi",
        "{what}/{camera}.avi",
        "{camera}_{what}.avi",
        "shots/{what}-{camera}.avi",
    ],
)
def test_folders_and_names_say_the_same(tmp_path: Path, run: Run, name: str) -> None:
    words = {"extrinsics": "checkerboard", "background": "empty", "video": "take"}
    for camera in ("cam1", "cam2"):
        for word in words.values():
            write_video(tmp_path / name.format(camera=camera, what=word))

    assert run("init", tmp_path) == 0

    assert read(tmp_path) == {
        camera: {key: name.format(camera=camera, what=word) for key, word in words.items()}
        for camera in ("cam1", "cam2")
    }


def test_pictures_of_two_values_are_masks_and_stills_of_the_lens_are_not(
    tmp_path: Path, run: Run
) -> None:
    for camera in ("left", "right"):
        write_pictures(f"{camera}/#.png", tmp_path, two_values=True)
        write_pictures(f"{camera}/intrinsics frames/shot_#.jpg", tmp_path)

    assert run("init", tmp_path) == 0

    assert read(tmp_path)["left"] == {
        "masks": "left/*.png",
        "intrinsics": "left/intrinsics frames/shot_*.jpg",
    }


def test_a_pattern_means_its_own_pictures_alone(tmp_path: Path, run: Run) -> None:
    write_pictures("a#.png", tmp_path, two_values=True)
    write_pictures("a_background_#.png", tmp_path)

    assert run("init", tmp_path) == 0

    session = load_session(tmp_path)
    assert session.cameras[0].recording is not None
    assert len(session.cameras[0].recording.paths) == 3


def test_what_names_do_not_tell_is_a_comment(
    tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    write_pictures("left#.png", tmp_path)
    write_pictures("right#.png", tmp_path)

    assert run("init", tmp_path) == 0

    assert read(tmp_path) == {"left": {}, "right": {}}
    text = (tmp_path / "session.toml").read_text(encoding="utf-8")
    assert '# extrinsics = "left*.png"    # or intrinsics' in text
    assert "left*.png (what for?)" in capsys.readouterr().out


def test_nothing_is_loaded_before_the_board_is_filled_in(tmp_path: Path, run: Run) -> None:
    for what in ("board", "background", "video"):
        write_video(tmp_path / "cam1" / f"{what}.avi")
    assert run("init", tmp_path) == 0
    path = tmp_path / "session.toml"

    with pytest.raises(SessionError, match=r"target\.kind: one of chessboard.*'FILL IN'"):
        load_session(tmp_path)
    lines = path.read_text(encoding="utf-8").splitlines()
    filled = [TARGET if 'FILL IN"' in line else line for line in lines]
    path.write_text("\n".join(filled), encoding="utf-8")
    session = load_session(tmp_path)

    assert session.fps == 25.0
    assert [camera.name for camera in session.cameras] == ["cam1"]
    assert session.cameras[0].extrinsics is not None


def test_a_unit_is_never_guessed(tmp_path: Path, run: Run) -> None:
    (tmp_path / "cad").mkdir()
    (tmp_path / "cad" / 'cube "1".obj').write_text(CUBE, encoding="utf-8")
    assert run("init", tmp_path) == 0
    path = tmp_path / "scene.toml"

    with pytest.raises(SceneError, match=r"object\.1\.unit.*'FILL IN'"):
        load_scene(path)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace('unit = "FILL IN"', 'unit = "mm"'), encoding="utf-8")
    (cube,) = load_scene(path).objects

    assert np.ptp(cube.vertices_world, axis=0) == pytest.approx([0.2, 0.2, 0.2])


@pytest.mark.parametrize("name", ["session.toml", "scene.toml"])
def test_nothing_is_written_over(
    tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    (tmp_path / name).write_text("mine", encoding="utf-8")

    assert run("init", tmp_path) == 1

    assert f"{name}: exists already, and init writes over nothing" in capsys.readouterr().err
    assert (tmp_path / name).read_text(encoding="utf-8") == "mine"
    assert len(list(tmp_path.iterdir())) == 1


def test_an_empty_folder_gets_files_that_say_what_belongs_there(tmp_path: Path, run: Run) -> None:
    assert run("init", tmp_path) == 0

    text = (tmp_path / "session.toml").read_text(encoding="utf-8")
    assert '# background = ""    # the empty scene' in text
    with pytest.raises(SessionError, match="camera: this key is missing"):
        load_session(tmp_path)
