"""session.toml: what is accepted, and the one line for each mistake."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from hybridve.calib.errors import SessionError
from hybridve.hull.capture.session import load_session

HEAD = 'format = "hybridve-session"\nversion = 1\nfps = 25\n'
CAMERA = '[[camera]]\nname = "left"\nmasks = "left/*.png"\n'
OTHER = CAMERA.replace('name = "left"', 'name = "right"')
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


@pytest.mark.parametrize(
    ("offset_s", "shift_frames", "lag"),
    [(0.12, 3, 0.0), (0.1205, 3, 0.0), (0.136, 3, 0.4), (-0.01, -1, 0.75), (-0.08, -2, 0.0)],
)
def test_a_late_clock_is_late_by_frames_and_a_share_of_one(
    folder: Path, offset_s: float, shift_frames: int, lag: float
) -> None:
    session = load_session(session_path(folder, HEAD + CAMERA + f"offset_s = {offset_s}\n"))

    (camera,) = session.cameras
    assert camera.shift_frames == shift_frames
    assert camera.lag == pytest.approx(lag)
    assert camera.nearest_shift == round(25.0 * offset_s)


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
        (HEAD + CAMERA + 'poses = "p.csv"\n', r"camera\.1\.poses: there is no file 'p.csv'"),
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


CHARUCO = """
[[target]]
kind = "charuco"
columns = 7
rows = 5
square_mm = [40, 40.5]
marker_mm = 30
"""
APRILGRID = """
[[target]]
kind = "aprilgrid"
columns = 6
rows = 6
tag_mm = 80
tag_spacing = 0.25
body = "cube"
"""
CHESSBOARD = TARGET.replace("[target]", "[[target]]")


def test_boards_of_all_kinds_are_named_and_described_in_order(folder: Path) -> None:
    session = load_session(session_path(folder, HEAD + CAMERA + CHARUCO + APRILGRID + CHESSBOARD))

    assert session.target is session.targets[0]
    assert [target.table() for target in session.targets] == [
        {
            "kind": "charuco",
            "name": "board",
            "columns": 7,
            "rows": 5,
            "square_mm": (40, 40.5),
            "marker_mm": 30,
            "dictionary": "DICT_4X4_1000",
            "first_id": 0,
        },
        {
            "kind": "aprilgrid",
            "name": "board2",
            "body": "cube",
            "columns": 6,
            "rows": 6,
            "tag_mm": 80,
            "gap_mm": 20,
            "dictionary": "DICT_APRILTAG_36h11",
            "first_id": 0,
        },
        {"kind": "chessboard", "name": "board3", "columns": 8, "rows": 6, "square_mm": 30},
    ]
    assert [target.unit_m for target in session.targets] == [0.04, None, 0.03]


def test_one_table_is_one_board_and_none_is_none(folder: Path) -> None:
    assert load_session(session_path(folder, HEAD + CAMERA)).targets == ()
    assert load_session(session_path(folder, HEAD + CAMERA)).target is None
    (target,) = load_session(session_path(folder, HEAD + CAMERA + TARGET)).targets
    assert target.name == "board"


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (TARGET.replace("30", "[30, 0]"), r"target\.square_mm: found \[30, 0\]; expected a len"),
        (TARGET.replace("30", "[30]"), r"target\.square_mm: found \[30\]"),
        (TARGET.replace("30", "true"), r"target\.square_mm: found True"),
        (TARGET.replace("30", "nan"), r"target\.square_mm: found nan"),
        (TARGET.replace("columns = 8\n", ""), r"target\.columns: this key is missing"),
        (TARGET + "marker_mm = 3\n", r"target\.marker_mm: there is no such key"),
        (TARGET + 'name = "a/b"\n', r"target\.name: "),
        ("target = 3\n", r"target: expected a table, \[target\], or several"),
        (CHESSBOARD + CHARUCO.replace("30", "40"), r"target\.2\.marker_mm: 40 mm is not less"),
        (CHARUCO + 'dictionary = "DICT_3X3"\n', r"target\.1\.dictionary: unknown dictionary"),
        (CHARUCO.replace("charuco", "dots"), r"target\.1\.kind: one of .*found 'dots'"),
        (CHARUCO.replace('kind = "charuco"', ""), r"target\.1\.kind: this key is missing"),
        (CHARUCO.replace("marker_mm = 30", ""), r"target\.1\.marker_mm: this key is missing"),
        (CHARUCO + "tag_mm = 3\n", r"target\.1\.tag_mm: there is no such key"),
        (CHARUCO.replace("7", "2.5"), r"target\.1\.columns: .*found 2\.5"),
        (APRILGRID.replace("tag_mm = 80", ""), r"target\.1\.tag_mm: this key is missing"),
        (APRILGRID + "marker_mm = 3\n", r"target\.1\.marker_mm: there is no such key"),
        (APRILGRID.replace("0.25", "-1"), r"target\.1\.tag_spacing: .*greater than 0, found -1"),
        (APRILGRID + "first_id = -1\n", r"target\.1\.first_id: .*found -1"),
        (APRILGRID.replace("tag_spacing = 0.25", ""), r"target\.1\.gap_mm: give the gap"),
        (APRILGRID + "gap_mm = 20\n", r"target\.1\.gap_mm: give the gap"),
        (CHARUCO + APRILGRID + 'name = "board"\n', r"target\.2\.name: 'board' is the name of t"),
        ('rig = "r"\nrig_unit = "squares"\n' + APRILGRID, r"rig_unit: 'squares' needs a \[target"),
    ],
)
def test_a_mistake_in_a_board_names_it_and_the_key(folder: Path, text: str, line: str) -> None:
    with pytest.raises(SessionError, match=rf"session\.toml: {line}") as caught:
        load_session(session_path(folder, HEAD + text + CAMERA))

    assert "\n" not in str(caught.value)


def test_a_shared_lens_has_one_set_of_known_intrinsics(folder: Path) -> None:
    lens = 'lens = "gopro"\nmodel = "PINHOLE"\n'
    params = "params = [500, 501, 320, 240]\n"

    session = load_session(session_path(folder, HEAD + CAMERA + lens + OTHER + lens + params))

    assert [camera.params for camera in session.cameras] == [(500, 501, 320, 240)] * 2
    assert [camera.lens for camera in session.cameras] == ["gopro"] * 2


def test_how_many_parameters_a_lens_has_may_be_left_open(folder: Path) -> None:
    (camera,) = load_session(session_path(folder, HEAD + CAMERA + 'model = "auto"\n')).cameras

    assert (camera.model, camera.params, camera.lens) == ("auto", None, None)


@pytest.mark.parametrize(
    ("first", "second", "line"),
    [
        ("params = [1, 2]", "", r"camera\.1\.params: 2 numbers, expected 8 for OPENCV"),
        ('model = "auto"\nparams = [1]', "", r"camera\.1\.params: .*which model"),
        ('model = "PINHOLE"\nparams = [0, 1, 2, 3]', "", r"camera\.1\.params: a focal length of 0"),
        ('model = "PINHOLE"\nparams = [nan, 1, 2, 3]', "", r"camera\.1\.params\.1: .*finite"),
        ('lens = "a"', 'lens = "a"\nmodel = "PINHOLE"', r"camera\.2\.lens: 'a' has model PINHOLE"),
        (
            'lens = "a"\nmodel = "SIMPLE_PINHOLE"\nparams = [9, 1, 2]',
            'lens = "a"\nmodel = "SIMPLE_PINHOLE"\nparams = [9, 1, 3]',
            r"camera\.2\.params: differ",
        ),
        ('extrinsics_poses = "p.csv"', "", r"camera\.1\.extrinsics_poses: there are no extrinsics"),
        (
            'extrinsics = "left/*.png"\nextrinsics_poses = "p.csv"',
            "",
            r"camera\.1\.extrinsics_poses: .*\(poses\)",
        ),
    ],
)
def test_a_mistake_in_a_lens_or_its_motion_names_the_camera(
    folder: Path, first: str, second: str, line: str
) -> None:
    with pytest.raises(SessionError, match=line):
        load_session(session_path(folder, f"{HEAD}{CAMERA}{first}\n{OTHER}{second}\n"))


def test_a_moving_camera_has_poses_and_masks(folder: Path) -> None:
    for name in ("poses.csv", "clip.csv"):
        (folder / name).write_text("frame,x,y,z,qw,qx,qy,qz\n", encoding="utf-8")
    moving = 'poses = "poses.csv"\n'
    clip = 'extrinsics = "left/*.png"\nextrinsics_poses = "clip.csv"\n'
    (camera,) = load_session(session_path(folder, HEAD + CAMERA + moving + clip)).cameras

    assert camera.poses == folder / "poses.csv"
    assert camera.extrinsics_poses == folder / "clip.csv"
    without_masks = '[[camera]]\nname = "left"\n'
    with pytest.raises(SessionError, match=r"camera\.1\.poses: there are no masks"):
        load_session(session_path(folder, HEAD + without_masks + moving))
    with pytest.raises(SessionError, match=r"camera\.1\.video: a camera that moves .*give masks"):
        load_session(session_path(folder, HEAD + without_masks + 'video = "note.avi"\n' + moving))


def point(name: str, rest: str, cameras: tuple[str, ...] = ("left", "right")) -> str:
    pixels = ", ".join(f"{camera} = [1, 2.5]" for camera in cameras)
    return f'[[point]]\nname = "{name}"\npixels = {{ {pixels} }}\n{rest}\n'


CORNER = point("o", "xyz_mm = [0, 0, 0]") + point("x", "xyz_mm = [2000, 0, 0]")


def test_the_world_may_be_points_or_the_floor(folder: Path) -> None:
    cameras = CAMERA + OTHER
    points = CORNER + point("y", "xyz_mm = [0, 900.5, 0]")
    floor = "".join(point(name, "floor = true") for name in "abc")

    named = load_session(session_path(folder, HEAD + 'world = "points"\n' + points + cameras))
    flat = load_session(session_path(folder, HEAD + 'world = "floor"\n' + floor + cameras))

    assert named.world == "points"
    assert [found.xyz_mm for found in named.points] == [(0, 0, 0), (2000, 0, 0), (0, 900.5, 0)]
    assert named.points[2].pixels == {"left": (1.0, 2.5), "right": (1.0, 2.5)}
    assert flat.world == "floor"
    assert [found.floor for found in flat.points] == [True] * 3


def test_clocks_are_as_given_unless_they_are_to_be_estimated(folder: Path) -> None:
    assert load_session(session_path(folder, HEAD + CAMERA)).sync == "given"
    text = HEAD + 'sync = "estimate"\n' + CAMERA
    assert load_session(session_path(folder, text)).sync == "estimate"


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ('world = "ceiling"\n', r"world: .*'ceiling'"),
        ('sync = "guess"\n', r"sync: .*'guess'"),
        (CORNER, r"point: world = 'board' needs no points"),
        ('world = "points"\n' + CORNER, r"world: 'points' needs 3 or more .* xyz_mm, found 2"),
        ('world = "floor"\n' + CORNER, r"world: 'floor' needs 3 or more .* floor = true, found 0"),
        (
            'world = "points"\n' + CORNER + point("y", "xyz_mm = [5000, 0.5, 0]"),
            r"point: those with xyz_mm lie on a line",
        ),
        (
            'world = "points"\n' + CORNER + point("y", "xyz_mm = [0, 0, 0]"),
            r"point: those with xyz_mm lie on a line",
        ),
        (
            'world = "points"\n' + CORNER + point("y", "xyz_mm = [0, 9, 0]", ("left",)),
            r"point\.3\.pixels: 'y' is seen by 1 camera",
        ),
        ('world = "points"\n' + CORNER + point("x", ""), r"point\.3\.name: 'x' is the name of p"),
        ('world = "floor"\n' + point("a", "", ("top",)), r"point\.1\.pixels: .*no camera 'top'"),
        ('world = "floor"\n' + point("a", "", ()), r"point\.1\.pixels: "),
        ('world = "points"\n' + point("a", "xyz_mm = [0, 1]"), r"point\.1\.xyz_mm\.3: this key is"),
    ],
)
def test_a_mistake_in_the_world_names_the_key(folder: Path, text: str, line: str) -> None:
    with pytest.raises(SessionError, match=rf"session\.toml: {line}") as caught:
        load_session(session_path(folder, HEAD + text + CAMERA + OTHER))

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
