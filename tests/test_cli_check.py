"""``hybridve check``: what a look before a run tells, and that it is silent where all is well."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.sessions import SIZE_PX, ball_mask, ring_matrix, write_ball_session, write_cube_scene
from numpy.typing import NDArray

from hybridve.cli.progress import Terminal
from hybridve.hull.chain import EvaluateSettings
from hybridve.hull.check import check_session

Run = Callable[..., int]
Picture = NDArray[np.uint8]
Check = Callable[..., tuple[int, dict[str, Any]]]

#: Enough for frames 0, 1, ... 8: the first, the last, and all between.
CENTERS = np.column_stack([np.linspace(-0.2, 0.2, 9), np.zeros(9), np.linspace(0.0, 0.1, 9)])


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ball_session(tmp_path_factory.mktemp("ball"), CENTERS).parent


@pytest.fixture
def session(written: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "session"
    shutil.copytree(written, folder)
    return folder


@pytest.fixture
def check(run: Run, capsys: pytest.CaptureFixture[str]) -> Check:
    def call(*arguments: object) -> tuple[int, dict[str, Any]]:
        status = run("check", *arguments, "--json")
        return status, json.loads(capsys.readouterr().out)

    return call


def spoil(folder: Path, camera: str, change: Callable[[Picture], Picture]) -> None:
    for path in (folder / camera).glob("*.png"):
        image = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), np.uint8)
        cv2.imwrite(str(path), change(image))


@pytest.mark.slow  # the first loads what is compiled
def test_of_a_good_session_nothing_is_said(session: Path, check: Check) -> None:
    status, found = check(session, "--strict")

    assert status == 0
    assert (found["problems"], found["notes"]) == ([], [])
    assert found["rig"] == "no board"
    assert found["frames"] == list(range(9))
    for number, camera in enumerate(found["cameras"]):
        (source,) = camera["sources"]
        assert (source["width_px"], source["height_px"]) == SIZE_PX
        assert (source["bits"], source["n_frames"], source["n_missing"]) == (8, 9, 0)
        assert camera["masks"] == "grey above 127 of 255"
        matrix = ring_matrix(number, 4)
        expected = [float((ball_mask(matrix, center) > 0).mean()) for center in CENTERS]
        assert found["looks"][number]["object_share"] == pytest.approx(expected)
    assert found["cost"]["n_frames"] == 9
    assert found["cost"]["disk_bytes"] is None


def test_the_text_ends_with_what_is_wrong(
    session: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("check", session) == 0

    text = capsys.readouterr().out

    assert text.splitlines()[-1] == "nothing is wrong, as far as a look can tell"
    assert "there is no board in the session to test it with" in text


NOTES: list[tuple[str, Callable[[Path], object], str]] = [
    (
        "inverted",
        lambda folder: spoil(folder, "cam1", lambda mask: np.bitwise_not(mask)),
        "are the masks black on white?",
    ),
    (
        "empty",
        lambda folder: spoil(folder, "cam1", lambda mask: np.zeros_like(mask)),
        "cam1 saw nothing in all 9 frames looked at, and all that is kept or free rests on that",
    ),
    (
        "the same",
        lambda folder: [
            shutil.copy(folder / "cam1" / "4.png", folder / "cam1" / f"{frame}.png")
            for frame in range(9)
            if frame != 4
        ],
        "cam1 shows the very same silhouette in all 9 frames looked at; is one picture there",
    ),
    (
        "a gap",
        lambda folder: (folder / "cam1" / "3.png").unlink(),
        "'cam1/*.png' lacks 1 of the instants of which other cameras have pictures",
    ),
]


@pytest.mark.parametrize(
    ("spoiled", "line"), [case[1:] for case in NOTES], ids=[n[0] for n in NOTES]
)
def test_what_is_odd_is_noted_and_a_run_would_go_through(
    session: Path, check: Check, spoiled: Callable[[Path], object], line: str
) -> None:
    spoiled(session)

    status, found = check(session)

    assert status == 0
    assert found["problems"] == []
    notes = [note for note in found["notes"] if line in note]
    assert len(notes) == 1
    assert "cam1" in notes[0] or "camera.2" in notes[0]
    assert check(session, "--strict")[0] == 1


def test_what_a_run_would_warn_of_is_a_note_and_told_once(
    session: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    path = session / "session.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("fps = 25\n", ""), encoding="utf-8")

    assert run("check", session, "--json") == 0

    told = capsys.readouterr()
    notes = [note for note in json.loads(told.out)["notes"] if "fps: this key is missing" in note]
    assert len(notes) == 1
    assert told.err == ""


def test_every_missing_file_is_told_at_once(session: Path, check: Check) -> None:
    for camera in ("cam1", "cam3"):
        shutil.rmtree(session / camera)

    status, found = check(session)

    assert status == 1
    assert [line.split(": ")[1] for line in found["problems"]] == [
        "camera.2.masks",
        "camera.4.masks",
    ]


def test_a_picture_that_is_none_is_named(session: Path, check: Check) -> None:
    (session / "cam2" / "5.png").write_bytes(b"")

    status, found = check(session)

    assert status == 1
    (line,) = found["problems"]
    assert "camera.3.masks: 1 of 9 files ('5.png') cannot be read" in line


def test_a_session_that_cannot_be_loaded_is_one_line(session: Path, check: Check) -> None:
    path = session / "session.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("fps", "fpss"), encoding="utf-8")

    status, found = check(session)

    assert status == 1
    (line,) = found["problems"]
    assert "fpss" in line
    assert "did you mean fps" in line


def test_without_a_rig_it_is_told_what_comes_first(
    session: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    path = session / "session.toml"
    lines = [line for line in path.read_text().splitlines() if not line.startswith("rig")]
    path.write_text("\n".join(lines), encoding="utf-8")

    assert run("check", session, "--strict") == 0

    assert "there is no rig yet: name one with rig =" in capsys.readouterr().out


@pytest.mark.slow  # a part is evaluated in a few frames
def test_parts_are_told_with_size_place_and_what_is_seen(session: Path, check: Check) -> None:
    places = {"near": (0.0, 0.0, 0.0), "aside": (0.0, 0.0, 5000.0)}
    scene = write_cube_scene(session / "scene", places)

    status, found = check(session, "--scene", scene)

    assert status == 0
    near, aside = found["objects"]
    assert near["size_mm"] == pytest.approx([200.0] * 3)
    assert near["low_mm"] == pytest.approx([-100.0] * 3)
    assert (near["seen_share"], aside["seen_share"]) == (1.0, 0.0)
    assert near["is_closed"]
    (note,) = found["notes"]
    assert "object 'aside' is outside of what 4 cameras see" in note
    cost = found["cost"]
    assert cost["engine"] == "native"
    assert cost["evaluate_s"] > 0.0
    # An empty HDF5 file of a report's columns is some 100 KB; each frame adds to it.
    assert cost["disk_bytes"] > 50_000


@pytest.mark.slow
@pytest.mark.parametrize(("unit", "said"), [("m", "200,000 mm large"), ("ft", None)])
def test_a_part_a_thousand_times_too_large_is_told(
    session: Path, unit: str, said: str | None
) -> None:
    scene = write_cube_scene(session / "scene", {"cube": (0.0, 0.0, 0.0)})
    text = scene.read_text(encoding="utf-8").replace('unit = "mm"', f'unit = "{unit}"')
    scene.write_text(text, encoding="utf-8")

    # No clearance is measured: of a part of that size it takes long.
    found, _ = check_session(session, scene, EvaluateSettings(), Terminal(enabled=False))

    told = [note for note in found.notes if "is its unit right?" in note]
    # 200 ft are 26 times as large as the room that the cameras look at from 2.3 m: a hall may be.
    assert len(told) == (1 if said else 0)
    assert said is None or said in told[0]


@pytest.mark.slow  # an effect brings its solver
def test_effects_are_named_and_one_that_cannot_be_read_is_a_problem(
    session: Path, check: Check
) -> None:
    scene = write_cube_scene(session / "scene", {"cube": (0.0, 0.0, 0.0)})
    whole = scene.read_text(encoding="utf-8")
    (session / "rig.csv").rename(session / "no_rig.csv")  # nothing is evaluated

    scene.write_text(
        f'{whole}[[effect]]\nkind = "proximity"\nobject = "cube"\nzones_mm = [50]\n',
        encoding="utf-8",
    )
    _, named = check(session, "--scene", scene)
    scene.write_text(f'{whole}[[effect]]\nkind = "rigidd"\n', encoding="utf-8")
    _, unknown = check(session, "--scene", scene)

    assert named["effects"] == ["proximity"], named["problems"]
    assert unknown["effects"] == []
    assert any("there is no effect 'rigidd'" in line for line in unknown["problems"])


@pytest.mark.slow
def test_cameras_that_are_exchanged_are_told(session: Path, check: Check) -> None:
    (session / "cam0").rename(session / "cam")
    (session / "cam1").rename(session / "cam0")
    (session / "cam").rename(session / "cam1")

    status, found = check(session)

    assert status == 0
    assert found["notes"]
    assert any("cam0" in note and "cam1" in note for note in found["notes"])


def test_the_sheet_has_the_first_and_the_middle_frame_of_each_camera(
    session: Path, run: Run, tmp_path: Path
) -> None:
    path = tmp_path / "sheet.png"

    assert run("check", session, "--picture", path) == 0

    sheet = cv2.imread(str(path))
    assert sheet is not None
    # Two pictures of 480 in a row, as high as 160 x 120 makes them, and a row for each camera.
    assert 2 * 480 < sheet.shape[1] < 2 * 500
    assert 4 * 360 < sheet.shape[0] < 4 * 380
    # The outlines' colour is there in each of the eight.
    height, width = sheet.shape[0] // 4, sheet.shape[1] // 2
    blue, green, red = (sheet[..., channel].astype(int) for channel in range(3))
    outline = (green > red + 100) & (green > 150) & (blue > 100)
    cells = outline[: 4 * height, : 2 * width].reshape(4, height, 2, width)
    assert (cells.sum(axis=(1, 3)) > 50).all()
    assert run("check", session, "--picture", path) == 1


# --- Videos and tags --------------------------------------------------------------------------


def write_video(path: Path, n_frames: int = 12, fourcc: str = "MJPG") -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*fourcc), 25, (64, 48))
    for number in range(n_frames):
        writer.write(np.full((48, 64, 3), 100 + number, np.uint8))
    writer.release()


def video_session(folder: Path, **keys: str) -> Path:
    """Write a session of a camera that recorded nothing but an even grey."""
    folder.mkdir()
    for name in ("background.avi", "video.avi"):
        write_video(folder / name)
    told = {"background": "background.avi", "video": "video.avi", **keys}
    lines = "\n".join(f'{key} = "{value}"' for key, value in told.items())
    text = f'format = "hybridve-session"\nversion = 1\n[[camera]]\nname = "a"\n{lines}\n'
    (folder / "session.toml").write_text(text, encoding="utf-8")
    return folder


def test_a_video_tells_its_rate_and_its_count(tmp_path: Path, check: Check) -> None:
    _, found = check(video_session(tmp_path / "session"))

    background, video = found["cameras"][0]["sources"]
    assert (background["key"], video["key"]) == ("background", "video")
    assert (video["rate_hz"], video["n_frames"], video["channels"]) == (25.0, 12, 3)
    assert found["problems"] == []


def test_stills_of_another_shape_are_a_problem_and_of_another_size_a_note(
    tmp_path: Path, check: Check
) -> None:
    folder = video_session(tmp_path / "session", intrinsics="still*.png")
    cv2.imwrite(str(folder / "still1.png"), np.zeros((96, 128), np.uint8))

    _, twice = check(folder)
    cv2.imwrite(str(folder / "still1.png"), np.zeros((128, 128), np.uint8))
    status, square = check(folder)

    assert any(
        "is 128x96, but 'video.avi' is 64x48; the lens is scaled" in n for n in twice["notes"]
    )
    assert status == 1
    assert any("of another shape" in line for line in square["problems"])


def test_tags_of_files_are_told_and_a_mixture_is_noted(tmp_path: Path, check: Check) -> None:
    folder = video_session(tmp_path / "session", intrinsics="still*.jpg")
    write_turned_jpeg(folder / "still1.jpg", 6)

    _, found = check(folder)

    still = found["cameras"][0]["sources"][0]
    assert still["orientation"] == "turned by 90 degrees"
    (note,) = [one for one in found["notes"] if "to be looked at differently" in one]
    assert "intrinsics turned by 90 degrees" in note
    assert "video upright" in note


def test_the_rotation_of_a_video_is_told(tmp_path: Path, check: Check) -> None:
    folder = video_session(tmp_path / "session", video="turned.mp4")
    write_video(folder / "turned.mp4", fourcc="mp4v")
    content = bytearray((folder / "turned.mp4").read_bytes())
    # The matrix of the track's header, as a telephone held upside down writes it: 180 degrees.
    at = content.find(b"tkhd") + 4 + 4 + 36
    turned = [-(1 << 16), 0, 0, 0, -(1 << 16), 0, 64 << 16, 48 << 16, 1 << 30]
    content[at : at + 36] = b"".join(one.to_bytes(4, "big", signed=True) for one in turned)
    (folder / "turned.mp4").write_bytes(content)

    _, found = check(folder)

    assert found["cameras"][0]["sources"][1]["orientation"] == "turned by 180 degrees"
    assert any("video turned by 180 degrees" in note for note in found["notes"])


@pytest.mark.slow  # a process of its own
def test_the_text_needs_no_opengl() -> None:
    code = "import sys; import hybridve.hull.check; sys.exit('moderngl' in sys.modules)"

    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def write_turned_jpeg(path: Path, orientation: int) -> None:
    """Write a JPEG with the tag of EXIF 2.3 for an orientation, big-endian as cameras do."""
    good, encoded = cv2.imencode(".jpg", np.zeros((48, 64), np.uint8))
    assert good
    entry = bytes([0x01, 0x12, 0, 3, 0, 0, 0, 1, 0, orientation, 0, 0])
    block = b"Exif\0\0MM\0*\0\0\0\x08\0\x01" + entry + bytes(4)
    marker = b"\xff\xe1" + (len(block) + 2).to_bytes(2, "big") + block
    content = encoded.tobytes()
    path.write_bytes(content[:2] + marker + content[2:])
