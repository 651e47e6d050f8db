"""What strangers give does no harm: it is read as what it should be, or refused in one line."""

import os
import struct
import sys
import threading
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from helpers.clash_reports import Spot, write_clash_report
from helpers.fuzzing import readers, tried
from helpers.sessions import write_ball_session, write_cube_scene

from hybridve.calib.bounded import parse_json, printable
from hybridve.calib.errors import HybridveError, SessionError
from hybridve.calib.formats.rigs import read_any_rig
from hybridve.calib.image_io import open_source, read_image
from hybridve.hull import stored
from hybridve.hull.cad.mesh import read_cad
from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture.session import load_session
from hybridve.hull.capture.silhouette_io import SilhouetteReader, SilhouetteWriter
from hybridve.hull.report.read import read_report
from hybridve.hull.stored_check import look_through

Run = Callable[..., int]
HEAD = 'format = "hybridve-session"\nversion = 1\nfps = 25\nrig = "rig.csv"\nrig_unit = "m"\n'


def refused(read: Callable[[], object]) -> str:
    """Return the one line in which something is refused."""
    with pytest.raises(HybridveError) as error:
        read()
    (line,) = error.value.lines
    assert "\n" not in line
    assert "\x1b" not in printable(line)
    return line


# --- Nesting and size, before they cost anything ----------------------------------------------

DEEP = 100_000
NESTED = {
    "list.toml": "a = " + "[" * DEEP + "]" * DEEP,
    "dotted.toml": "a" + ".a" * DEEP + " = 1",
    "rig.json": '{"format": "hybridve-rig", "a": ' + "[" * DEEP + "]" * DEEP + "}",
    "storage.json": '{"a": ' + '{"b": ' * DEEP + "1" + "}" * DEEP + "}",
    "storage.yml": "%YAML:1.0\n---\na: " + "[" * DEEP + "]" * DEEP + "\n",
    "storage.xml": '<?xml version="1.0"?><opencv_storage>' + "<a>" * DEEP + "</a>" * DEEP,
    "chain.yaml": "cam0:\n" + "".join(" " * n + "- a:\n" for n in range(1, 3000)),
}


@pytest.mark.parametrize("name", list(NESTED))
def test_what_is_nested_without_end_is_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(NESTED[name], encoding="utf-8")

    readers: list[Callable[[], object]] = []
    if "toml" in name:
        readers.append(lambda: load_session(path))
    readers.append(lambda: read_any_rig(path, unit="m", image_sizes=(64, 48)))
    for read in readers:
        assert "deep" in refused(read)


def test_json_is_read_as_deep_as_descriptions_are() -> None:
    assert parse_json("[" * 60 + "]" * 60)
    with pytest.raises(ValueError, match="deep"):
        parse_json("[" * 80 + "]" * 80)


def png_of(width: int, height: int) -> bytes:
    """Return a PNG whose header says a size, and that has next to nothing behind it."""
    head = struct.pack(">II5B", width, height, 8, 2, 0, 0, 0)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(b"\0" * 1000))
        + chunk(b"IEND", b"")
    )


def test_a_picture_that_says_it_is_huge_is_refused_by_its_header(tmp_path: Path) -> None:
    path = tmp_path / "1.png"
    path.write_bytes(png_of(60_000, 60_000))

    assert "60000 x 60000" in refused(lambda: read_image(path))


@pytest.mark.parametrize("suffix", ["bmp", "tif", "pgm", "webp", "jpg", "png"])
def test_a_picture_of_nothing_is_refused(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"1.{suffix}"
    for content in (b"", b"\0" * 100, b"P5 99999999 99999999 255\n", b"\x89PNG\r\n\x1a\n"):
        path.write_bytes(content)
        refused(lambda: read_image(path))


# --- Where files lie --------------------------------------------------------------------------


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return write_ball_session(tmp_path / "m", np.zeros((1, 3)), n_cameras=2)


def test_no_path_leaves_a_sessions_folders_unless_it_says_so(session: Path, tmp_path: Path) -> None:
    folder = session.parent
    elsewhere = tmp_path / "elsewhere"
    (folder / "cam0").rename(elsewhere)
    text = session.read_text(encoding="utf-8")
    (folder / "cam0").symlink_to(elsewhere)
    linked = refused(lambda: load_session(session))
    (folder / "cam0").unlink()
    (folder / "cam0").mkdir()
    (folder / "cam0" / "0.png").symlink_to(elsewhere / "0.png")
    one_linked = refused(lambda: load_session(session))
    (folder / "cam0" / "0.png").unlink()
    above = text.replace("cam0/*.png", "../elsewhere/*.png")
    absolute = text.replace("cam0/*.png", f"{elsewhere}/*.png")
    found = [linked, one_linked]
    for changed in (above, absolute):
        session.write_text(changed, encoding="utf-8")
        found.append(refused(lambda: load_session(session)))
        session.write_text(f'roots = ["{elsewhere}"]\n{changed}', encoding="utf-8")
        assert len(load_session(session).cameras) == 2
    for line in found:
        assert "leads out of" in line
        assert f'roots = ["{elsewhere}"]' in line


def test_a_root_that_a_session_declares_is_allowed(session: Path, tmp_path: Path) -> None:
    moved = tmp_path / "described"
    moved.mkdir()
    (moved / "session.toml").write_text(
        'root = "../m"\n' + session.read_text(encoding="utf-8"), encoding="utf-8"
    )

    assert len(load_session(moved).cameras) == 2


@pytest.mark.parametrize("name", ["/etc/passwd", "../../etc/passwd", "../rig.csv"])
def test_a_rig_or_a_mesh_from_elsewhere_is_refused(
    name: str, session: Path, tmp_path: Path
) -> None:
    text = session.read_text(encoding="utf-8")
    session.write_text(text.replace('"rig.csv"', f'"{name}"'), encoding="utf-8")
    assert "leads out of" in refused(lambda: load_session(session))

    scene = write_cube_scene(tmp_path / "s", {"cube": (0.0, 0.0, 0.0)})
    text = scene.read_text(encoding="utf-8")
    scene.write_text(text.replace('"cube.obj"', f'"{name}"'), encoding="utf-8")
    assert "leads out of" in refused(lambda: load_scene(scene))


def test_a_mesh_names_no_file_outside_of_its_folder(tmp_path: Path) -> None:
    (tmp_path / "secret.bin").write_bytes(b"\0" * 100)
    path = tmp_path / "m" / "a.gltf"
    path.parent.mkdir()
    path.write_text(
        '{"asset": {"version": "2.0"}, "buffers": [{"uri": "../secret.bin", "byteLength": 36}]}',
        encoding="utf-8",
    )

    assert "outside of its folder" in refused(lambda: read_cad(path))


# --- Names --------------------------------------------------------------------------------------


@pytest.mark.parametrize("mark", ["\\u0000", "\\u001b[2J", "\\u009b2J", "\\u202e"])
def test_a_control_character_in_a_description_is_refused(mark: str, session: Path) -> None:
    text = session.read_text(encoding="utf-8")
    session.write_text(text.replace("cam0/*.png", f"cam0{mark}/*.png"), encoding="utf-8")

    assert "control character" in refused(lambda: load_session(session))


def test_nothing_that_a_terminal_obeys_reaches_it(
    tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "a\x1b[31m\x9bb"
    folder.mkdir()
    assert run("check", folder) == 1
    write_clash_report(tmp_path / "r.h5", [[Spot((0.1, 0.2, 0.3))]], name="box\x1b]0;x\x07")
    assert run("summary", tmp_path / "r.h5") == 0

    told = capsys.readouterr()
    assert not set(told.out + told.err) & set("\x1b\x07\x9b")
    assert "\\x1b" in told.out


@pytest.mark.skipif(sys.platform != "linux", reason="names are bytes there")
def test_folders_whose_names_are_not_utf8_are_read(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/gr\xfc\xdf"))
    picture = np.full((48, 64, 3), 90, np.uint8)
    ascii_video = tmp_path / "v.avi"
    video = cv2.VideoWriter(
        str(ascii_video), cv2.CAP_OPENCV_MJPEG, cv2.VideoWriter.fourcc(*"MJPG"), 25, (64, 48)
    )
    for _ in range(3):
        video.write(picture)
    video.release()
    session = write_ball_session(tmp_path / "m", np.zeros((1, 3)), n_cameras=2)
    session.parent.rename(folder)
    (folder / "v.avi").write_bytes(ascii_video.read_bytes())
    storage = cv2.FileStorage("a.json", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("camera_matrix", np.eye(3))
    (folder / "c.json").write_text(storage.releaseAndGetString(), encoding="utf-8")

    assert read_image(folder / "cam0" / "0.png").shape == (120, 160, 3)
    source = open_source(folder, "v.avi")
    assert (source.claimed_length(), source.count()) == (3, 3)
    assert [image.shape for image in source.frames()] == [(48, 64, 3)] * 3
    assert len(load_session(folder).cameras) == 2
    refused(lambda: read_any_rig(folder / "c.json", unit="m", image_sizes=(64, 48)))


def test_coordinates_beyond_all_measure_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1e308 0 0\nv 0 1e308 1\nf 1 2 3\n", encoding="utf-8")

    assert "too large" in refused(lambda: read_cad(path))


# --- HDF5 -----------------------------------------------------------------------------------------


def strange(path: Path, make: Callable[[h5py.File], object]) -> Path:
    """Write a report of ours, and change it as somebody else might."""
    write_clash_report(path, [[Spot((0.1, 0.2, 0.3))]])
    with h5py.File(path, "r+") as file:
        make(file)
    return path


def external(file: h5py.File) -> None:
    secret = Path(file.filename).with_name("secret")
    secret.write_bytes(b"\7" * 80)
    del file["hybridve/frames/time_s"]
    file["hybridve/frames"].create_dataset(
        "time_s", (10,), np.float64, external=[(str(secret), 0, 80)]
    )


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((4,), np.float64)
    layout[:] = h5py.VirtualSource("other.h5", "x", (4,))
    file.create_virtual_dataset("hybridve/frames/virtual", layout)


def loop(file: h5py.File) -> None:
    file["hybridve/objects/again"] = h5py.SoftLink("/hybridve/objects/again")


def outside(file: h5py.File) -> None:
    file["hybridve/objects/other"] = h5py.ExternalLink("/tmp/other.h5", "/")


def promising(file: h5py.File) -> None:
    file.create_dataset("hybridve/frames/much", (1 << 57,), np.float64, chunks=(1024,))


def vast(file: h5py.File) -> None:
    file.create_dataset("hybridve/frames/much", (1 << 30,), np.float64, chunks=(1 << 27,))


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (external, "another file"),
        (virtual, "elsewhere"),
        (loop, "a link"),
        (outside, "another file"),
        (promising, "says that it holds"),
        (vast, "chunks of"),
    ],
)
def test_a_file_that_leads_elsewhere_or_promises_without_end_is_refused(
    make: Callable[[h5py.File], object], told: str, tmp_path: Path
) -> None:
    path = strange(tmp_path / "r.h5", make)

    assert told in look_through(os.fsencode(path))
    assert told in refused(lambda: read_report(path))


def test_what_crashes_hdf5_is_a_line_and_what_passes_is_looked_through_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HYBRIDVE_CACHE", str(tmp_path / "cache"))
    asked: list[Path] = []
    answers = ["HDF5 crashes on it; it is damaged, or made to do harm", ""]

    def ask(path: Path, _: float) -> str:
        asked.append(path)
        return answers.pop(0)

    monkeypatch.setattr(stored._reader, "ask", ask)
    first, copy = tmp_path / "s.h5", tmp_path / "copy.h5"
    with SilhouetteWriter(first, ["a"], [(8, 8)], "") as writer:
        writer.append([np.zeros((8, 8), np.uint8)])

    def read(path: Path) -> None:
        with SilhouetteReader(path):
            pass

    read(first)
    assert asked == []  # it was written here
    copy.write_bytes(first.read_bytes())

    assert "crashes" in refused(lambda: read(copy))
    read(copy)
    read(copy)
    other = tmp_path / "other.h5"
    other.write_bytes(first.read_bytes())
    read(other)
    assert asked == [copy, copy]


@pytest.mark.slow
def test_a_process_that_dies_of_a_file_is_followed_by_another(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    write_clash_report(path, [[]])
    reader = stored._Reader()
    assert reader.ask(path, 60.0) == ""
    assert reader._process is not None
    killed = threading.Timer(0.0, reader._process.kill)
    killed.start()
    killed.join()
    reader._process.wait()
    assert reader.ask(path, 60.0) == ""
    assert "does not come to an end" in reader.ask(path, 0.0)
    reader.end()


def test_a_report_that_is_open_elsewhere_is_not_called_damaged(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    write_clash_report(path, [[]])
    with h5py.File(path, "r+") as file:
        file.attrs["touched"] = 1
        file.flush()

        assert "open in another program" in stored_answer(path)


def stored_answer(path: Path) -> str:
    return refused(lambda: read_report(path))


def test_reports_with_flipped_bytes_are_read_or_refused(tmp_path: Path) -> None:
    whole = tmp_path / "r.h5"
    write_clash_report(whole, [[Spot((0.1, 0.2, 0.3))], []])
    content = bytearray(whole.read_bytes())
    rng = np.random.default_rng(5)
    head = min(len(content), 60_000)
    read = 0
    for number in range(12):
        spoilt = bytearray(content)
        for at in rng.integers(0, head if number % 2 else len(content), 1 + number % 3):
            spoilt[at] ^= 1 << int(rng.integers(8))
        path = tmp_path / f"{number}.h5"
        path.write_bytes(spoilt)
        with suppress(HybridveError):
            read_report(path)
            read += 1
    assert read < 12
    with pytest.raises(SessionError):
        load_session(tmp_path / "0.h5")


def test_what_is_nearly_right_is_read_or_refused_in_one_line(tmp_path: Path) -> None:
    for reader in readers(tmp_path):
        if reader.in_libraries:  # `make fuzz` asks these, in processes that may die
            continue
        for _, problem in tried(reader, tmp_path, 12, seed=1):
            assert not problem, reader.name
