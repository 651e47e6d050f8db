"""A rig that is used was tested against the session's own board, wherever it comes from."""

import logging
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.boards import floor_of_noise, look_at, make_camera, render_board, turned_about
from helpers.records import make_record

from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats.rig_json import read_rig, write_rig
from hybridve.calib.pose import compose, rotation_about_axes
from hybridve.calib.provenance import MadeElsewhere
from hybridve.calib.record import BY_SCENE, Labelling
from hybridve.calib.rig import Rig
from hybridve.cli.calibrate import NOT_GOOD_ENOUGH
from hybridve.hull.capture import rig_check
from hybridve.hull.capture.rig import load_rig
from hybridve.hull.capture.rig_check import ask_boards, check_session, remember_made
from hybridve.hull.capture.session import load_session

SIZE_PX = (320, 240)
BOARD = Chessboard(7, 6, 0.1)
SYMMETRIC = Chessboard(8, 6, 0.1)
NAMES = ("cam1", "cam2", "cam3")


def cameras() -> list[Camera]:
    """Three cameras about a board on the floor."""
    x, y, _ = BOARD.center_board
    found = []
    for name, (dx, dy, height) in zip(
        NAMES, [(-0.9, -0.7, 1.0), (0.8, -0.8, 1.1), (0.1, 1.1, 1.2)], strict=True
    ):
        pose = look_at((x + dx, y + dy, height), (x, y, 0.0))
        found.append(make_camera(name, "PINHOLE", pose, SIZE_PX))
    return found


def bumped() -> list[Camera]:
    """The same, after somebody ran into the second."""
    bump = np.column_stack([rotation_about_axes((0.0, 5.0, 0.0)), [0.05, 0.0, 0.0]])
    first, second, third = cameras()
    return [first, replace(second, cam_from_world=compose(bump, second.cam_from_world)), third]


def write_rows(folder: Path, listed: list[Camera]) -> None:
    """Write a rig as lines of projection matrices."""
    rows = []
    for camera in listed:
        matrix = camera.pinhole @ camera.cam_from_world
        rows.append(",".join([camera.name, *map(repr, matrix.ravel().tolist())]))
    (folder / "rig.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


@pytest.fixture(scope="module")
def pictures() -> dict[str, np.ndarray]:
    return {camera.name: render_board(camera, BOARD, samples=2) for camera in cameras()}


@pytest.fixture
def session(tmp_path: Path, pictures: dict[str, np.ndarray]) -> Path:
    """A session with a board clip, masks, and a rig made elsewhere that is right."""
    lines = [
        *(
            'format = "hybridve-session"',
            "version = 1",
            "fps = 25",
            'rig = "rig.csv"',
            'rig_unit = "m"',
        ),
        *("[target]", 'kind = "chessboard"', "columns = 7", "rows = 6", "square_mm = 100"),
    ]
    mask = np.zeros(SIZE_PX[::-1], np.uint8)
    mask[100:140, 140:180] = 255
    for name, picture in pictures.items():
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "board.png"), picture)
        cv2.imwrite(str(tmp_path / name / "mask0.png"), mask)
        lines += [
            *("[[camera]]", f'name = "{name}"', 'model = "PINHOLE"'),
            *(f'extrinsics = "{name}/board.png"', f'masks = "{name}/mask*.png"'),
        ]
    path = tmp_path / "session.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    write_rows(tmp_path, cameras())
    return path


@pytest.fixture(autouse=True)
def _no_haste(monkeypatch: pytest.MonkeyPatch) -> None:
    """However slow the machine is, only what is asked for is told."""
    monkeypatch.setattr(rig_check, "_PATIENCE_S", np.inf)


def load(session: Path) -> Rig:
    return load_rig(load_session(session))


def told(rig: Rig) -> tuple[str, str]:
    assert rig.check is not None
    return rig.check.verdict, rig.check.message


def no_board(session: Path, name: str) -> None:
    """Take the board out of a camera's clip."""
    blank = np.full((*SIZE_PX[::-1], 3), 128, np.uint8)
    cv2.imwrite(str(session.parent / name / "board.png"), blank)


def forbid_searching(patch: pytest.MonkeyPatch) -> None:
    def search(*_: object, **__: object) -> None:
        raise AssertionError("pictures are searched again")

    patch.setattr(rig_check, "find_boards", search)
    patch.setattr(rig_check, "check_rig", search)


def test_a_rig_that_fits_is_used_silently_and_tested_once(
    session: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    first = load(session)
    forbid_searching(monkeypatch)
    again = load(session)

    verdict, message = told(first)
    assert verdict == "agrees"
    assert "the rig agrees with the board" in message
    assert again.check == first.check
    assert not caplog.records


def test_a_rig_that_the_board_refutes_is_refused_with_what_a_check_says(
    session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = load(session)
    write_rows(session.parent, bumped())
    said = check_session(
        load_session(session), Rig(tuple(bumped()), covariance=rig.covariance)
    ).message

    with pytest.raises(CalibrationError) as caught:
        load(session)
    forbid_searching(monkeypatch)
    with pytest.raises(CalibrationError) as again:
        load(session)

    assert str(caught.value) == str(again.value)
    assert "camera 'cam2' stands elsewhere than the rig says" in said
    start, _, rest = str(caught.value).partition(": camera")
    assert start == f"{session}: rig 'rig.csv'"
    assert rest.endswith('; or use it all the same with rig_check = "off"')
    numbers = re.compile(r"[\d.]+")
    assert numbers.sub("", said) in numbers.sub("", str(caught.value))


def test_a_rig_of_another_unit_is_refused(session: Path) -> None:
    text = session.read_text(encoding="utf-8")
    session.write_text(text.replace('rig_unit = "m"', 'rig_unit = "cm"'), encoding="utf-8")

    with pytest.raises(CalibrationError, match=r"scale 0\.010 .*check the rig's unit"):
        load(session)


def test_a_rig_is_used_all_the_same_where_that_is_said(
    session: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    write_rows(session.parent, bumped())
    text = session.read_text(encoding="utf-8")
    session.write_text(f'rig_check = "off"\n{text}', encoding="utf-8")
    forbid_searching(monkeypatch)

    rig = load(session)

    assert told(rig)[0] == "off"
    (record,) = caplog.records
    assert "used without a test" in record.getMessage()


def test_a_rig_is_asked_again_when_the_clip_the_board_or_the_rig_changes(
    session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load(session)
    text = session.read_text(encoding="utf-8")
    rows = (session.parent / "rig.csv").read_text(encoding="utf-8")
    picture = (session.parent / "cam1" / "board.png").read_bytes()
    asked: list[int] = []

    def find_none(*_: Any, **__: Any) -> list[Any]:
        asked.append(1)
        return []

    monkeypatch.setattr(rig_check, "find_boards", find_none)

    def is_asked() -> bool:
        asked.clear()
        load(session)
        return bool(asked)

    assert not is_asked()
    session.write_text(text.replace("square_mm = 100", "square_mm = 101"), encoding="utf-8")
    assert is_asked()
    session.write_text(text, encoding="utf-8")
    write_rows(session.parent, bumped())
    assert is_asked()
    (session.parent / "rig.csv").write_text(rows, encoding="utf-8")
    no_board(session, "cam1")
    assert is_asked()
    (session.parent / "cam1" / "board.png").write_bytes(picture)
    assert not is_asked()


@pytest.mark.slow
def test_where_no_clip_shows_the_board_that_is_said_and_the_rig_used(
    session: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name in NAMES:
        no_board(session, name)

    rig = load(session)

    assert told(rig)[0] == "not tested"
    (record,) = caplog.records
    assert "could not be tested against the session's board: camera 'cam" in record.getMessage()
    assert "no board of 7x6 inner corners" in record.getMessage()


@pytest.mark.slow
def test_one_clip_without_a_board_does_not_hide_what_the_others_show(
    session: Path, caplog: pytest.LogCaptureFixture
) -> None:
    no_board(session, "cam3")

    rig = load(session)

    assert told(rig)[0] == "agrees"
    assert rig.check is not None
    assert rig.check.check is not None
    assert rig.check.check.untested == ("cam3",)
    (record,) = caplog.records
    assert "not tested: cam3" in record.getMessage()
    write_rows(session.parent, bumped())
    with pytest.raises(CalibrationError, match="one of 'cam1' and 'cam2' stands elsewhere"):
        load(session)


def test_a_clip_of_another_size_tests_nothing(
    session: Path, pictures: dict[str, np.ndarray], caplog: pytest.LogCaptureFixture
) -> None:
    for name in NAMES:
        larger = cv2.resize(pictures[name], (640, 480), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(session.parent / name / "board.png"), larger)

    rig = load(session)

    assert told(rig)[0] == "not tested"
    assert "640x480 pixels, the rig is for 320x240" in caplog.records[-1].getMessage()


def test_a_session_without_a_board_has_nothing_to_say(
    session: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = re.sub(r"extrinsics = .*\n", "", session.read_text(encoding="utf-8"))
    session.write_text(text, encoding="utf-8")
    write_rows(session.parent, bumped())

    assert told(load(session))[0] == "no board"
    assert not caplog.records


def test_a_rig_that_was_calibrated_from_the_clip_is_not_tested_again(
    session: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Not even a wrong one: what is asked is whether this very rig was made of this very clip."""
    text = re.sub(r"rig(_unit)? = .*\n", "", session.read_text(encoding="utf-8"))
    session.write_text(text, encoding="utf-8")
    made = Rig(tuple(bumped()), make_record(["cam1", "cam2", "cam3"]))
    (session.parent / "rig").mkdir()
    write_rig(session.parent / "rig" / "rig.json", made)
    loaded = load_session(session)

    with pytest.raises(CalibrationError, match="'cam2' stands elsewhere"):
        load(session)
    remember_made(loaded, made)
    with monkeypatch.context() as patch:
        forbid_searching(patch)
        assert told(load(session))[0] == "made here"
        assert not caplog.records
        weak = Labelling(
            looks=2,
            decided_by=BY_SCENE,
            matches_by_look={},
            margin_sigma={},
            weakest_sigma=1.0,
            is_weak=True,
        )
        doubtful = replace(made, provenance=make_record(["cam1", "cam2", "cam3"], labelling=weak))
        assert ask_boards(loaded, doubtful).verdict == "open"
        nothing_told = ask_boards(loaded, replace(made, provenance=MadeElsewhere()))
        assert nothing_told.verdict == "open"
        assert "told no more" in nothing_told.message
    other = replace(made, cameras=tuple(cameras()))
    assert ask_boards(loaded, other).verdict == "agrees"
    assert read_rig(session.parent / "rig" / "rig.json").cameras[1].name == "cam2"


def test_cameras_with_one_view_are_named_wherever_a_rig_is_loaded(
    session: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first, second, third = cameras()
    twin = replace(first, name="cam2")
    text = re.sub(r"extrinsics = .*\n", "", session.read_text(encoding="utf-8"))
    session.write_text(text.replace("cam2/mask", "cam1/mask"), encoding="utf-8")
    write_rows(session.parent, [first, twin, third])

    load(session)

    said = [record.getMessage() for record in caplog.records]
    assert any("cameras 'cam1' and 'cam2' stand in one place and have one view" in s for s in said)
    assert any("cameras 'cam1' and 'cam2' have one recording" in s for s in said)
    assert len(said) == 2
    del second


def lie_symmetric_board(session: Path, is_textured: bool) -> None:
    """Put a board that looks the same turned into the place of the other."""
    floor = floor_of_noise(4) if is_textured else None
    for camera in cameras():
        picture = render_board(camera, SYMMETRIC, floor=floor, samples=2)
        cv2.imwrite(str(session.parent / camera.name / "board.png"), picture)
    text = session.read_text(encoding="utf-8")
    session.write_text(text.replace("columns = 7", "columns = 8"), encoding="utf-8")


@pytest.mark.slow
def test_a_camera_turned_about_a_board_that_looks_the_same_then_is_refused(session: Path) -> None:
    lie_symmetric_board(session, is_textured=True)
    assert told(load(session))[0] == "agrees"
    first, second, third = cameras()
    write_rows(session.parent, [first, turned_about(SYMMETRIC, second, 1), third])

    with pytest.raises(CalibrationError, match=r"'cam2' stands .* turned by 180 degrees about the"):
        load(session)


@pytest.mark.slow
def test_where_nothing_tells_how_cameras_are_turned_that_is_said_each_time(
    session: Path,
    run: Callable[..., int],
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A rig is used all the same, and does not pass its check."""
    lie_symmetric_board(session, is_textured=False)

    verdicts = [told(load(session))[0] for _ in range(2)]
    rows = session.parent / "rig.csv"
    status = run("calibrate", "--check", rows, session, "--rig-unit", "m", "--no-progress")

    assert verdicts == ["open", "open"]
    assert sum("it cannot be told whether" in one.getMessage() for one in caplog.records) == 2
    assert status == NOT_GOOD_ENOUGH
    assert "it cannot be told whether 'cam1' and 'cam2' and 'cam3'" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["detect", "segment", "spacing", "sweep", "render"])
def test_no_command_uses_a_rig_that_the_board_refutes(
    session: Path,
    command: str,
    run: Callable[..., int],
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_rows(session.parent, bumped())
    scene = session.parent / "scene.toml"
    (session.parent / "part.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    scene.write_text(
        'format = "hybridve-scene"\nversion = 1\n[[object]]\nname = "part"\nmesh = "part.obj"\n'
        'unit = "m"\n'
    )
    output = session.parent / "out"
    arguments = {
        "detect": ("--scene", scene, "-o", output.with_suffix(".h5")),
        "segment": (),
        "spacing": (
            *("--scene", scene, "--move", "part", "--along", "1,0,0", "--range-mm", "0:10"),
        ),
        "sweep": ("--scene", scene, "--viewport", "4", "-o", output.with_suffix(".h5")),
        "render": ("--scene", scene, "-o", output.with_suffix(".png")),
    }[command]

    assert run(command, session, *arguments) == 1

    told_user = capsys.readouterr().err
    assert "'cam2' stands elsewhere than the rig says" in told_user
    assert list(session.parent.glob("out*")) == []
    assert not (session.parent / "silhouettes.h5").exists()


def test_a_user_who_is_told_no_progress_is_told_once_that_it_takes_long(
    session: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(rig_check, "_PATIENCE_S", 0.0)
    with caplog.at_level(logging.WARNING):
        load(session)
        load(session)

    (record,) = caplog.records
    assert "tested against the session's board, once" in record.getMessage()
