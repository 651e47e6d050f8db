"""Parts whose size or place cannot go with what the cameras see are told, and no others."""

import logging
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.sessions import write_ball_session, write_cube_scene

from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture.session import load_session
from hybridve.hull.chain import EvaluateSettings, make_chain


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four cameras 2.3 m from a ball."""
    return write_ball_session(tmp_path_factory.mktemp("ball"), np.zeros((1, 3)))


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("", "", None),
        (
            'unit = "mm"',
            'unit = "m"',
            '200,000 mm large, .* "mm" it would be 200 mm large',
        ),
        ('unit = "mm"', 'unit = "ft"', None),
        ('unit = "mm"', 'unit = "in"', None),
        ("[0.0, 0.0, 0.0]", "[3e6, 1e6, 0]", "3,161,... mm from where the cameras look.* far outs"),
        ("[0.0, 0.0, 0.0]", "[0, 0, 8000]", None),  # 'not seen' says it
    ],
)
def test_a_part_that_is_out_of_all_proportion_is_told(
    session: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    old: str,
    new: str,
    told: str | None,
) -> None:
    path = write_cube_scene(tmp_path, {"cube": (0.0, 0.0, 0.0)})
    path.write_text(path.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")

    make_chain(load_session(session), load_scene(path), EvaluateSettings(viewport=1))

    caplog.set_level(logging.WARNING)
    found = [r.getMessage() for r in caplog.records if "object 'cube'" in r.getMessage()]
    assert len(found) == (told is not None)
    assert told is None or re.search(told, found[0]), found


def test_a_part_a_thousand_times_too_small_is_told(
    session: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_cube_scene(tmp_path, {"cube": (0.0, 0.0, 0.0)})
    mesh = tmp_path / "cube.obj"
    lines = [
        f"v {' '.join(str(float(word) / 1000.0) for word in line.split()[1:])}"
        if line.startswith("v ")
        else line
        for line in mesh.read_text(encoding="utf-8").splitlines()
    ]
    mesh.write_text("\n".join(lines) + "\n", encoding="utf-8")  # in metres, which nobody said

    make_chain(load_session(session), load_scene(path), EvaluateSettings(viewport=1))

    (found,) = [r.getMessage() for r in caplog.records if "object 'cube'" in r.getMessage()]
    assert "is 0.2 mm large" in found
    assert 'With unit = "m" it would be 200 mm large; here it is "mm"' in found
