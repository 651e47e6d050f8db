"""What stands under a name is the old file or the whole new one, whatever fails in between."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.clash_reports import Spot, write_clash_report
from helpers.failing import contents, failing
from helpers.sessions import write_ball_session, write_cube_scene
from matplotlib.figure import Figure

from hybridve.calib.camera import Camera
from hybridve.calib.errors import HybridveError, ReportError
from hybridve.calib.files import write_whole
from hybridve.calib.formats.colmap import COLMAP_FILES, write_colmap_model
from hybridve.calib.formats.rig_json import write_rig
from hybridve.calib.holding import holding
from hybridve.calib.image_io import read_image
from hybridve.calib.provenance import MadeElsewhere
from hybridve.calib.rig import Rig
from hybridve.cli.main import cli
from hybridve.hull import jit
from hybridve.hull.capture.silhouette_io import SilhouetteWriter
from hybridve.hull.places import Inputs, is_result
from hybridve.hull.report import write
from hybridve.hull.report.read import read_report
from hybridve.hull.report.result_file import parts_of, refuse_parts
from hybridve.hull.report.write import refuse_result
from hybridve.hull.view.chart import save_figure
from hybridve.hull.view.picture import write_picture

PROJECT = Path(__file__).parent.parent
Run = Callable[..., int]

#: Two frames in which a box is touched, and one in which it is not.
FRAMES: tuple[list[Spot], ...] = ([Spot((0.1, 0.2, 0.3))], [Spot((0.1, 0.2, 0.3))], [])


def a_rig() -> Rig:
    pose = np.eye(3, 4)
    params = np.array([500.0, 500.0, 320.0, 240.0])
    cameras = tuple(Camera(f"cam{i}", "PINHOLE", 640, 480, params, pose) for i in range(2))
    return Rig(cameras, MadeElsewhere({"method": "drawn"}))


def report(path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write, "_PART_FRAMES", 1)
        write_clash_report(path, FRAMES)


def silhouettes(path: Path) -> None:
    with SilhouetteWriter(path, ["a", "b"], [(64, 48)] * 2, "stamp") as writer:
        for frame in range(3):
            writer.append([np.full((48, 64), frame, np.uint8)] * 2)


def chart(path: Path) -> None:
    save_figure(Figure(), path)


WRITERS: dict[str, Callable[[Path], None]] = {
    "report.h5": report,
    "silhouettes.h5": silhouettes,
    "rig.json": lambda path: write_rig(path, a_rig()),
    "colmap": lambda path: write_colmap_model(path, a_rig()),
    "picture.png": lambda path: write_picture(path, np.zeros((4, 5, 3), np.uint8)),
    "text.toml": lambda path: write_whole(path, "a text\n"),
}


def which(count: int, most: int) -> list[int]:
    """Return numbers from 1 to `count`: all where HYBRIDVE_EVERY is set, else some, spread."""
    if count <= most or os.environ.get("HYBRIDVE_EVERY"):
        return list(range(1, count + 1))
    return sorted({1, 2, *(round(1 + n * (count - 1) / (most - 3)) for n in range(most - 2))})


@pytest.mark.slow
@pytest.mark.parametrize("stays", [True, False], ids=["full", "hiccup"])
@pytest.mark.parametrize("name", list(WRITERS))
def test_whichever_write_fails_the_old_file_or_the_whole_new_one_stands(
    name: str, tmp_path: Path, *, stays: bool
) -> None:
    make = WRITERS[name]
    folder = tmp_path / "whole"
    folder.mkdir()
    with failing() as disk:
        make(folder / name)
    whole = set(contents(folder))
    n_asked = len(disk.asked)
    assert {"write", "fsync", "rename"} <= set(disk.asked)

    for k in which(n_asked, 9):
        folder = tmp_path / f"{k}"
        folder.mkdir()
        with failing(k, stays=stays) as disk:
            told = ""
            try:
                make(folder / name)
            except (OSError, HybridveError) as error:
                told = str(error)
        left = {one for one in contents(folder) if ".parts/" not in one}
        # What fails behind the last rename, a folder that cannot be settled, changes nothing.
        assert left in (set(), whole), (k, disk.asked[k - 1])
        assert "space" in told or (not told and left == whole), (k, disk.asked[k - 1])


@pytest.mark.slow
def test_a_run_goes_on_from_whatever_parts_a_full_disk_has_left(tmp_path: Path) -> None:
    report(tmp_path / "report.h5")
    expected = read_report(tmp_path / "report.h5")
    with failing() as disk:
        report(tmp_path / "again.h5")

    for k in which(len(disk.asked) - 1, 6):
        path = tmp_path / f"{k}.h5"
        with failing(k), pytest.raises((OSError, HybridveError)):
            report(path)
        if path.exists():
            continue
        refuse_parts(parts_of(path), resume=True, overwrite=False)
        resumed = read_report(resume(path))
        assert resumed.index.tolist() == expected.index.tolist()
        columns = expected.objects["box"].columns
        for column, values in columns.items():
            assert values.tobytes() == resumed.objects["box"][column].tobytes(), column
        assert not parts_of(path).exists()


def resume(path: Path) -> Path:
    """Return a report that is taken up where its run was cut off."""
    made: list[write.ReportWriter] = []
    begin = write.ReportWriter.__init__

    def taken_up(self: write.ReportWriter, *args: object, **how: object) -> None:
        begin(self, *args, **(how | {"resume": True}))  # type: ignore[arg-type]
        made.append(self)

    def appended(self: write.ReportWriter, result: object) -> None:
        if result.index >= self.n_done + len(self._pending):  # type: ignore[attr-defined]
            append(self, result)  # type: ignore[arg-type]

    append = write.ReportWriter.append
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write.ReportWriter, "__init__", taken_up)
        patch.setattr(write.ReportWriter, "append", appended)
        report(path)
    assert made
    return path


@pytest.mark.parametrize("spoil", [lambda b: b[: len(b) // 2], lambda b: b[:-40] + b"x" + b[-39:]])
def test_a_part_that_is_damaged_is_computed_again(
    tmp_path: Path, spoil: Callable[[bytes], bytes]
) -> None:
    path = tmp_path / "report.h5"
    with failing() as disk:
        report(tmp_path / "whole.h5")
    with failing(len(disk.asked) - 4), pytest.raises(HybridveError):
        report(path)
    parts = sorted(parts_of(path).glob("*.npz"))
    assert len(parts) == len(FRAMES)
    parts[1].write_bytes(spoil(parts[1].read_bytes()))

    assert read_report(resume(path)).index.tolist() == [0, 1, 2]


# --- What may be replaced -------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session and a scene in one folder, with a video's name in a folder elsewhere."""
    folder = tmp_path_factory.mktemp("recorded")
    write_ball_session(folder, np.zeros((1, 3)), n_cameras=2)
    write_cube_scene(folder, {"cube": (0.0, 0.0, 0.0)})
    return folder


#: Of each command that writes, how it is called with a name for what it writes.
CALLS = {
    "detect": ("detect", "S", "--scene", "S/scene.toml", "-o", "OUT"),
    "simulate": ("simulate", "S", "--scene", "S/scene.toml", "-o", "OUT"),
    "simulate --picture": (
        *("simulate", "S", "--scene", "S/scene.toml", "-o", "S/new.h5", "--picture", "OUT.png"),
    ),
    "spacing": (
        *("spacing", "S", "--scene", "S/scene.toml", "--move", "cube", "--along", "1,0,0"),
        *("--range-mm", "0:10", "-o", "OUT"),
    ),
    "sweep": ("sweep", "S", "--scene", "S/scene.toml", "-o", "OUT", "--viewport", "4"),
    "render": ("render", "S", "--scene", "S/scene.toml", "-o", "OUT.png"),
    "check": ("check", "S", "--picture", "OUT.png"),
    "board": ("board", "S", "-o", "OUT.pdf"),
    "convert": ("convert", "S/rig.csv", "--to", "json", "-o", "OUT", "--from-unit", "m"),
    "summary": ("summary", "S/report.h5", "--picture", "OUT.png"),
    "calibrate": ("calibrate", "S", "-o", "FOLDER"),
    "segment": ("segment", "S"),
}


@pytest.mark.parametrize("name", list(CALLS))
def test_no_command_replaces_what_it_reads_or_a_strangers_file(
    name: str, recorded: Path, tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    session = tmp_path / "s"
    session.mkdir()
    for path in recorded.rglob("*"):
        if path.is_dir():
            (session / path.relative_to(recorded)).mkdir()
        else:
            (session / path.relative_to(recorded)).write_bytes(path.read_bytes())
    (session / "report.h5").write_bytes(b"no report of ours")
    (session / "notes.png").write_bytes(b"a picture of the room")
    (session / "notes.pdf").write_bytes(b"a plan of the room")
    (session / "rig.json").write_bytes(b"somebody's rig")
    (session / "silhouettes.h5").write_bytes(b"somebody's silhouettes")
    out = {"OUT.png": "notes.png", "OUT.pdf": "notes.pdf", "OUT": "rig.csv", "FOLDER": "."}
    before = contents(session)
    call = [
        str(session / out[part]) if part in out else re.sub("^S", str(session), part)
        for part in CALLS[name]
    ]

    status = run(*call, "--overwrite")

    told = capsys.readouterr().err.strip().splitlines()
    assert status == 1
    assert len(told) == 1, told
    assert told[0].startswith("error: ")
    assert "replaced" in told[0]
    assert contents(session) == before


def test_every_command_that_writes_says_what_it_writes() -> None:
    silent = {"demo", "diff", "doctor", "init", "plan", "synth", "clashes"}  # see each
    for name, command in cli.commands.items():
        writes = any("--output" in one.opts or "--picture" in one.opts for one in command.params)
        assert not writes or getattr(command, "_files", None) is not None, name
        assert not writes or name in silent or any(call[0] == name for call in CALLS.values())


def test_what_a_session_names_is_an_input_wherever_it_lies(tmp_path: Path) -> None:
    elsewhere = tmp_path / "disk" / "cam0"
    elsewhere.mkdir(parents=True)
    (elsewhere / "1.png").write_bytes(b"a picture")
    (tmp_path / "disk" / "rig.json").write_bytes(b'{"format": "hybridve-rig"}')
    session = tmp_path / "m"
    session.mkdir()
    (session / "session.toml").write_text(
        f'format = "hybridve-session"\nrig = "{tmp_path}/disk/rig.json"\n'
        f'[[camera]]\nname = "a"\nmasks = "{tmp_path}/disk/cam0/*.png"\n',
        encoding="utf-8",
    )
    inputs = Inputs.of([session])

    for path in (session / "session.toml", elsewhere / "1.png", tmp_path / "disk" / "rig.json"):
        with pytest.raises(ReportError, match="replaced"):
            inputs.refuse(path)
    inputs.refuse(session / "report.h5")
    (tmp_path / "free.txt").write_text("what lies elsewhere may be replaced", encoding="utf-8")
    inputs.refuse(tmp_path / "free.txt")
    (session / "link.h5").symlink_to(session / "session.toml")
    with pytest.raises(ReportError, match="input"):
        inputs.refuse(session / "link.h5")


def test_our_own_results_are_told_from_all_else(tmp_path: Path) -> None:
    report(tmp_path / "report.h5")
    silhouettes(tmp_path / "silhouettes.h5")
    write_rig(tmp_path / "rig.json", a_rig())
    for suffix in ("png", "jpg"):
        write_picture(tmp_path / f"picture.{suffix}", np.zeros((4, 5, 3), np.uint8))
        assert read_image(tmp_path / f"picture.{suffix}").shape == (4, 5, 3)
    for suffix in ("png", "svg", "pdf"):
        chart(tmp_path / f"chart.{suffix}")
    ours = sorted(tmp_path.iterdir())
    assert [path.name for path in ours if not is_result(path)] == []

    theirs = tmp_path / "theirs"
    theirs.mkdir()
    write_ball_session(theirs, np.zeros((1, 3)), n_cameras=1)
    write_cube_scene(theirs, {"cube": (0.0, 0.0, 0.0)})
    with h5py.File(theirs / "data.h5", "w") as file:
        file["values"] = np.arange(5)
    assert [path for path in theirs.rglob("*") if path.is_file() and is_result(path)] == []


def test_somebody_elses_file_among_the_parts_is_never_removed(tmp_path: Path) -> None:
    path = tmp_path / "report.h5"
    parts = parts_of(path)
    parts.mkdir()
    (parts / "000000000.npz").write_bytes(b"of a run")
    (parts / "thesis.tex").write_bytes(b"of somebody")

    with pytest.raises(ReportError, match=r"holds 'thesis.tex'"):
        refuse_result(path, resume=False, overwrite=True)

    assert (parts / "thesis.tex").read_bytes() == b"of somebody"
    (parts / "thesis.tex").unlink()
    refuse_result(path, resume=False, overwrite=True)


def test_parts_that_are_a_link_are_refused_in_words(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    parts_of(tmp_path / "report.h5").symlink_to(tmp_path / "elsewhere")

    with pytest.raises(ReportError, match="is a link"):
        refuse_result(tmp_path / "report.h5", resume=False, overwrite=True)


#: Modules that write into a folder of their own, which appears as a whole or is temporary; or that
#: write what grows, line by line.
OWN_FOLDER = {
    "cli/cluster.py",
    "cli/unit.py",
    "calib/files.py",
    "calib/cache.py",
    "calib/holding.py",
    "calib/seeing/corner_cache.py",
    "hull/cad/step.py",
    "hull/jit.py",
    "hull/manifest.py",
    "hull/prepare.py",
    "hull/synth/meshes.py",
    "hull/synth/write.py",
    "hull/view/film.py",
}


def test_no_module_writes_a_file_past_the_one_place_for_it() -> None:
    writes = re.compile(
        r"\.write_text\(|\.write_bytes\(|(?<!partial\.)open\([^)]*[\"'][wax]b?\+?[\"']|VideoWriter\(|imwrite\("
        r"|savefig\((?!file|page|buffer)|\.replace\(path\)|os\.rename|shutil\.(move|copy)"
    )
    found = {
        str(path.relative_to(PROJECT))
        for room in ("calib", "hull", "cli")
        for path in (PROJECT / room).rglob("*.py")
        if writes.search(path.read_text(encoding="utf-8").replace("model.write_text(partial)", ""))
    }

    assert found <= OWN_FOLDER


# --- Several at once, and what ends a run ---------------------------------------------------


def test_the_second_run_on_an_output_is_told_who_holds_it(tmp_path: Path) -> None:
    path = tmp_path / "report.h5"
    with holding(path, "hybridve detect one"):
        with (
            pytest.raises(ReportError, match=rf"process {os.getpid()} .*hybridve detect one\)"),
            holding(path, "hybridve detect two"),
        ):
            pytest.fail("two hold one output")
        with holding(tmp_path / "other.h5", "hybridve detect two"):
            pass

    with holding(path, "hybridve detect two"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_lock_that_a_killed_run_left_holds_nobody_up(tmp_path: Path) -> None:
    (tmp_path / "report.h5.lock").write_text('{"pid": 1}', encoding="utf-8")

    with holding(tmp_path / "report.h5", "hybridve detect"):
        pass


def test_who_may_wait_waits(tmp_path: Path) -> None:
    path = tmp_path / "clashes.toml"
    begun, order = threading.Event(), []

    def first() -> None:
        with holding(path, "one"):
            begun.set()
            time.sleep(0.2)
            order.append("one")

    thread = threading.Thread(target=first)
    thread.start()
    begun.wait()
    with holding(path, "two", patience_s=10.0):
        order.append("two")
    thread.join()

    assert order == ["one", "two"]


@pytest.mark.slow
def test_sigterm_ends_in_one_line_with_143_and_the_run_goes_on(tmp_path: Path, run: Run) -> None:
    write_ball_session(tmp_path, np.zeros((40, 3)), n_cameras=2)
    write_cube_scene(tmp_path, {"cube": (0.0, 0.0, 305.0)})
    call = ["detect", tmp_path, "--scene", tmp_path / "scene.toml", "-o", tmp_path / "r.h5"]
    call += ["--engine", "native", "--no-progress"]
    # Each frame waits until the signal has come, so that it comes in the midst of the work.
    code = (
        "import sys, time, hybridve.hull.batch as batch\n"
        "from hybridve.calib import colmap_library\n"
        "from hybridve.hull.report.write import ReportWriter\n"
        "take = ReportWriter.append\n"
        "def taken(self, result):\n"
        "    take(self, result)\n"
        "    if result.index == 2: print('begun', flush=True); time.sleep(60)\n"
        "ReportWriter.append = taken\n"
        "from hybridve.cli.main import main; main()\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, *map(str, call)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "begun\n"
    process.send_signal(signal.SIGTERM)
    _, told = process.communicate(timeout=60)

    assert process.returncode == 143
    assert told.splitlines()[-1] == "terminated"
    assert not [line for line in told.splitlines() if line.startswith(("***", "PC:", "  @"))]
    assert len(list(parts_of(tmp_path / "r.h5").glob("*.npz"))) == 1
    assert run(*call, "--resume") == 0
    assert len(read_report(tmp_path / "r.h5").index) == 40
    # Killed just behind the last rename, a run is finished: a loop that takes it up ends.
    parts_of(tmp_path / "r.h5").mkdir()
    assert run(*call, "--resume") == 0
    assert not parts_of(tmp_path / "r.h5").exists()


# --- Compiled code that is kept -------------------------------------------------------------


def _twice(values: np.ndarray) -> float:
    total = 0.0
    for value in values:
        total += 2.0 * value
    return total


@pytest.mark.parametrize("spoil", ["emptied", "cut", "flipped", "exchanged"])
def test_compiled_code_that_is_damaged_is_compiled_anew(
    spoil: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jit, "folder", lambda: tmp_path)
    assert jit.compiled(_twice)(np.arange(3.0)) == 6.0
    assert jit.compiled(_twice)(np.arange(3)) == 6.0
    kept = sorted(tmp_path.iterdir())
    assert len(kept) == 2
    first = kept[0].read_bytes()
    for path in kept:
        whole = path.read_bytes()
        middle = len(whole) // 2
        path.write_bytes(
            {
                "emptied": b"",
                "cut": whole[:middle],
                "flipped": whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :],
                "exchanged": kept[1].read_bytes() if path == kept[0] else first,
            }[spoil]
        )

    again = jit.compiled(_twice)
    assert again(np.arange(3.0)) == 6.0
    assert again(np.arange(3)) == 6.0
    assert sum(again.stats.cache_hits.values()) == 0  # type: ignore[attr-defined]
    later = jit.compiled(_twice)
    assert later(np.arange(3.0)) == 6.0
    assert sum(later.stats.cache_hits.values()) == 1  # type: ignore[attr-defined]


def test_where_compiled_code_cannot_be_kept_it_is_gone_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jit, "folder", lambda: tmp_path)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)

    assert jit.compiled(_twice)(np.arange(3.0)) == 6.0
    assert list(tmp_path.iterdir()) == []


def test_colmap_models_that_were_not_written_whole_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hybridve.calib.colmap_library import pycolmap

    def nothing(_: object, folder: str) -> None:
        for name in COLMAP_FILES:
            (Path(folder) / name).touch()

    monkeypatch.setattr(pycolmap.Reconstruction, "write_text", nothing)

    with pytest.raises(HybridveError, match="room"):
        write_colmap_model(tmp_path / "sparse", a_rig())
    assert not (tmp_path / "sparse").exists()


def test_what_a_full_disk_does_is_told_in_one_line(
    run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(**_: object) -> None:
        raise OSError(28, "No space left on device", "/data/x")

    monkeypatch.setattr(cli.commands["doctor"], "callback", full)

    assert run("doctor") == 1
    assert capsys.readouterr().err == (
        "error: /data/x: No space left on device; free some room there and run it again\n"
    )
