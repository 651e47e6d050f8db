"""A camera that moved between the board clip and the empty scene is told before the task begins."""

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.rooms import bent_lens, exposed, see_wall, true_shift_px, wall
from helpers.sessions import write_cube_scene
from numpy.typing import NDArray

from hybridve.calib.formats.rig_json import write_rig
from hybridve.calib.plain import read_strictly, to_plain
from hybridve.calib.rig import Rig
from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture import room_check
from hybridve.hull.capture.room_check import RoomCheck, check_room
from hybridve.hull.capture.room_shift import room_shift
from hybridve.hull.capture.session import load_session
from hybridve.hull.chain import EvaluateSettings, make_chain

LENS = bent_lens((320, 240))
NAMES = ("cam1", "cam2")
NONE = np.zeros(3)
BUMP = np.array([0.01, -0.02, 0.004])

Run = Callable[..., int]


def rig() -> Rig:
    """Two cameras one above the other: enough for a check that asks each alone."""
    poses = [np.column_stack([np.eye(3), [0.0, height_m, 3.0]]) for height_m in (0.0, 0.5)]
    return Rig(
        tuple(
            replace(LENS, name=name, cam_from_world=pose)
            for name, pose in zip(NAMES, poses, strict=True)
        )
    )


def write_pictures(
    folder: Path,
    name: str,
    turn: NDArray[np.float64],
    *,
    seed: int = 0,
    gain: float = 1.0,
    blank: bool = False,
) -> None:
    """Write three pictures of a room in which something else stands each time."""
    rng = np.random.default_rng(seed)
    picture = see_wall(LENS, wall(0), turn)
    if blank:
        picture[:] = 100.0
    (folder / name).mkdir(parents=True, exist_ok=True)
    for frame in range(3):
        shown = picture.copy()
        shown[60:200, 90 * frame : 90 * frame + 80] = 20.0
        cv2.imwrite(str(folder / name / f"{frame}.png"), exposed(shown, rng, gain=gain))


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A session of two cameras, of which the second was bumped into after its calibration."""
    lines = ['format = "hybridve-session"', "version = 1", "fps = 25", 'rig = "rig.json"']
    mask = np.zeros((LENS.height_px, LENS.width_px), np.uint8)
    mask[100:140, 140:180] = 255
    for name, turn in zip(NAMES, (NONE, BUMP), strict=True):
        write_pictures(tmp_path, f"{name}/board", NONE, seed=1)
        write_pictures(tmp_path, f"{name}/empty", turn, seed=2, gain=0.7)
        cv2.imwrite(str(tmp_path / name / "mask.png"), mask)
        lines += ["[[camera]]", f'name = "{name}"', f'extrinsics = "{name}/board/*.png"']
        lines += [f'background = "{name}/empty/*.png"', f'masks = "{name}/mask.png"']
    write_rig(tmp_path / "rig.json", rig())
    path = tmp_path / "session.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.slow
def test_a_camera_that_moved_is_told_in_one_line_and_the_other_is_not(
    session: Path, caplog: pytest.LogCaptureFixture
) -> None:
    check = check_room(load_session(session), rig())

    stands, moved = (check.cameras[name] for name in NAMES)
    true_px = true_shift_px(LENS, BUMP)
    assert check.moved == ("cam2",)
    assert stands.state == "same"
    assert stands.largest_px is not None
    assert stands.largest_px < 0.2
    assert moved.shift_px is not None
    assert moved.se_px is not None
    assert (np.abs(moved.shift_px - true_px) < 4.0 * np.array(moved.se_px)).all()
    (record,) = caplog.records
    assert record.getMessage() == f"{session}: {check.messages[0]}"
    assert "\n" not in check.messages[0]
    x_px, y_px = true_px
    assert x_px < 0 < -y_px  # that the words below name the right sides
    assert (
        f"camera 'cam2' has moved since its board was recorded: in the empty scene the room "
        f"stands {-x_px:.1f} px to the left and {-y_px:.1f} px up of where it stood"
    ) in check.messages[0]
    assert "expected less than 1); calibrate again" in check.messages[0]


@pytest.mark.slow
def test_what_was_found_is_kept_until_a_picture_changes(
    session: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked, told = [], []

    def counted(*given: object) -> object:
        asked.append(1)
        return room_shift(*given)  # type: ignore[arg-type]

    def watch(*step: object) -> None:
        told.append(step)

    monkeypatch.setattr(room_check, "room_shift", counted)
    first = check_room(load_session(session), rig(), watch)
    again = check_room(load_session(session), rig(), watch)

    assert again == first
    assert len(asked) == 2
    assert told == [("comparing rooms", 1, 2), ("comparing rooms", 2, 2)]
    assert len(caplog.records) == 2  # a moved camera is told each time

    write_pictures(session.parent, "cam2/empty", NONE, seed=3)
    put_back = check_room(load_session(session), rig())

    assert len(asked) == 3
    assert put_back.moved == ()


@pytest.mark.slow
def test_another_lens_is_asked_anew(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded, other = load_session(session), rig()
    first = check_room(loaded, other)
    wider = tuple(replace(one, params=one.params * [0.5, 0.5, *[1.0] * 6]) for one in other.cameras)
    second = check_room(loaded, Rig(wider))

    first_deg, second_deg = (check.cameras["cam2"].turn_deg for check in (first, second))
    assert first_deg is not None
    assert second_deg is not None
    assert second_deg > 1.5 * first_deg


def test_cameras_without_both_pictures_and_where_no_test_is_wanted_are_not_asked(
    session: Path,
) -> None:
    text = session.read_text(encoding="utf-8")
    session.write_text(text.replace('background = "cam1/empty/*.png"\n', ""), encoding="utf-8")
    assert set(check_room(load_session(session), rig()).cameras) == {"cam2"}

    session.write_text(f'rig_check = "off"\n{text}', encoding="utf-8")
    assert check_room(load_session(session), rig()) == RoomCheck()


@pytest.mark.slow
def test_a_blank_wall_tells_nothing_and_is_no_warning(
    session: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    write_pictures(session.parent, "cam2/empty", NONE, blank=True)

    check = check_room(load_session(session), rig())

    found = check.cameras["cam2"]
    assert found.state == "cannot tell"
    assert found.message.startswith(
        f"too few features of the room were found again: {found.n_found},"
    )
    assert check.messages == ()
    assert {record.levelname for record in caplog.records} == {"INFO"}


def test_pictures_of_another_size_or_that_cannot_be_read_are_said_to_tell_nothing(
    session: Path,
) -> None:
    for path in (session.parent / "cam1" / "empty").glob("*.png"):
        cv2.imwrite(str(path), np.zeros((100, 120), np.uint8))
    for path in (session.parent / "cam2" / "empty").glob("*.png"):
        path.write_bytes(b"no picture")

    check = check_room(load_session(session), rig())

    assert check.cameras["cam1"].message == (
        "cam1/empty/*.png is 120x100 pixels, the rig is for 320x240"
    )
    assert check.cameras["cam2"].state == "cannot tell"
    assert "0.png" in check.cameras["cam2"].message


@pytest.mark.slow
def test_a_board_that_was_carried_is_not_taken_for_the_room(session: Path) -> None:
    text = session.read_text(encoding="utf-8")
    target = (
        '[target]\nkind = "charuco"\ncolumns = 7\nrows = 6\nsquare_mm = 100\nmarker_mm = 70\n'
        'dictionary = "DICT_4X4_50"\n'
    )
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((7, 6), 0.1, 0.07, dictionary).generateImage((224, 192))
    for name, left in (("board", 20), ("empty", 50)):
        picture = np.full((LENS.height_px, LENS.width_px), 128, np.uint8)
        picture[20:212, left : left + 224] = board
        for path in (session.parent / "cam1" / name).glob("*.png"):
            cv2.imwrite(str(path), picture)

    mistaken = check_room(load_session(session), rig())
    session.write_text(text.replace("[[camera]]", target + "[[camera]]", 1), encoding="utf-8")
    check = check_room(load_session(session), rig())

    assert mistaken.cameras["cam1"].n_found > 50  # were it not known to be a board
    assert check.cameras["cam1"].state == "cannot tell"
    assert check.cameras["cam1"].n_found < 12


@pytest.mark.slow
def test_a_check_goes_through_json_whole(session: Path) -> None:
    check = check_room(load_session(session), rig())

    assert read_strictly(RoomCheck, to_plain(check), "room") == check


@pytest.mark.slow
def test_whatever_is_evaluated_knows_of_it(session: Path) -> None:
    scene = write_cube_scene(session.parent / "scene", {"cube": (0.0, 0.0, 0.0)})

    chain = make_chain(load_session(session), load_scene(scene), EvaluateSettings())

    assert chain.room.moved == ("cam2",)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["detect", "segment"])
def test_commands_tell_it_once(
    command: str, session: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments: list[object] = []
    if command == "detect":
        scene = write_cube_scene(session.parent / "scene", {"cube": (0.0, 0.0, 0.0)})
        arguments = ["--scene", scene, "-o", session.parent / "report.h5"]
    else:
        text = session.read_text(encoding="utf-8")
        for name in NAMES:
            text = text.replace(f'masks = "{name}/mask.png"', f'video = "{name}/empty/*.png"')
        session.write_text(text, encoding="utf-8")

    assert run(command, session, *arguments, "--no-progress") == 0

    lines = [line for line in capsys.readouterr().err.splitlines() if "has moved since" in line]
    assert len(lines) == 1
    assert lines[0].startswith(f"WARNING: {session}: camera 'cam2' has moved since its board")
