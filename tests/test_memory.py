"""Memory does not grow with the length of a recording."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

DATA = Path(__file__).parent.parent / "data"


def peak_bytes(folder: Path, recordings: Path, frames: str) -> int:
    """Return the most memory that ``hybridve detect`` held over some frames of horseman."""
    command = [sys.executable, "-m", "hybridve.cli", "detect", str(folder), "--no-progress"]
    command += ["--scene", str(DATA / "horseman" / "scene.toml"), "--engine", "native"]
    # Doubt keeps nothing from frame to frame, and takes half of the time.
    command += ["--no-doubt", "-o", str(folder / "report.h5"), "--overwrite", "--frames", frames]
    environment = {**os.environ, "HYBRIDVE_DATA": str(recordings.resolve())}
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=environment)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    return usage.ru_maxrss * 1024


@pytest.mark.slow
@pytest.mark.recording
def test_200_frames_take_no_more_memory_than_25(recordings: Path, tmp_path: Path) -> None:
    text = (DATA / "horseman" / "session.toml").read_text(encoding="utf-8")
    rig = 'rig = "{camera}/reference_b_mm.xml"\nrig_unit = "mm"\nrig_pixel_centre = 0\n\n[target]'
    (tmp_path / "session.toml").write_text(text.replace("[target]", rig), encoding="utf-8")

    few = peak_bytes(tmp_path, recordings, "0:25")
    many = peak_bytes(tmp_path, recordings, "0:200")

    # What the frames that are added hold would fill 160 MB as collision points, and 650 MB decoded.
    assert many <= 1.2 * few
