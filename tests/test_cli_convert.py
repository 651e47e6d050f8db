"""``hybridve convert`` as a user meets it."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from helpers.boards import look_at, make_camera

from hybridve.calib.errors import HybridveError
from hybridve.calib.formats.rig_export import FORMATS
from hybridve.calib.formats.rig_json import read_rig, write_rig
from hybridve.calib.formats.rigs import read_any_rig
from hybridve.calib.lens import project_points
from hybridve.calib.rig import Rig
from hybridve.cli.convert import FormatName
from hybridve.cli.main import cli


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with a rig.json, the current one."""
    cameras = [
        make_camera(name, model, look_at((2.0, y, 1.0), (0, 0, 0)))
        for name, model, y in (("left", "OPENCV", -0.5), ("right", "OPENCV_FISHEYE", 0.5))
    ]
    write_rig(tmp_path / "rig.json", Rig(tuple(cameras)))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def convert(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["convert", *arguments])


def assert_same_images(first: Rig, second: Rig) -> None:
    points_world = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3))
    for camera in first.cameras:
        expected, _ = project_points(camera, points_world)
        found, _ = project_points(second[camera.name], points_world)
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_the_formats_on_offer_are_those_that_are_written() -> None:
    assert FormatName.__args__ == FORMATS  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("to", "target"),
    [
        ("colmap", "sparse"),
        ("opencv", "{camera}/config.xml"),
        ("opencv", "lens_{camera}_of_{camera}.yml"),
        ("caliscope", "camera_array.toml"),
        ("aniposelib", "calibration.toml"),
        ("multical", "calibration.json"),
        ("json", "again.json"),
    ],
)
def test_there_and_back_is_the_same_rig(folder: Path, to: str, target: str) -> None:
    there = convert("rig.json", "--to", to, "-o", target)
    unit = [] if to in {"json", "caliscope", "aniposelib"} else ["--from-unit", "m"]
    back = convert(target, *unit, "--to", "json", "-o", "back.json")

    assert (there.exit_code, back.exit_code) == (0, 0), there.output + back.output
    assert there.output.startswith(f"{target}: 2 cameras as {to}, ")
    assert_same_images(read_rig(folder / "rig.json"), read_rig(folder / "back.json"))


def test_units_are_taken_and_given(folder: Path) -> None:
    convert("rig.json", "--to", "aniposelib", "-o", "a.toml", "--unit", "mm")
    (folder / "a.toml").write_text((folder / "a.toml").read_text().split("[metadata]")[0])
    refused = convert("a.toml", "--to", "json", "-o", "b.json")
    taken = convert("a.toml", "--from-unit", "mm", "--to", "json", "-o", "b.json")

    assert "does not say the unit" in str(refused.exception)
    assert taken.exit_code == 0
    assert_same_images(read_rig(folder / "rig.json"), read_rig(folder / "b.json"))


def test_json_says_what_was_written_and_what_was_lost(folder: Path) -> None:
    arguments = ["--camera", "right", "--camera", "left", "--to", "kalibr", "-o", "a.yaml"]
    told = json.loads(convert("rig.json", *arguments, "--json").output)

    assert told["files"] == ["a.yaml"]
    assert (told["format"], told["from_format"]) == ("kalibr", "json")
    assert told["cameras"] == ["right", "left"]
    assert told["approximated"] == {}
    assert "the world: it is the frame of 'right' now" in told["lost"]
    assert [c.name for c in read_any_rig(folder / "a.yaml").cameras] == ["right", "left"]


def test_an_approximation_is_told_with_its_error(folder: Path) -> None:
    write_rig(
        folder / "wide.json", Rig((make_camera("wide", "EUCM", look_at((1.0, 1, 1), (0, 0, 0))),))
    )
    arguments = ["wide.json", "--to", "opencv", "-o", "wide.yml"]
    refused = convert(*arguments)
    taken = convert(*arguments, "--approximate")

    assert isinstance(refused.exception, HybridveError)
    assert "--approximate" in str(refused.exception)
    assert "  wide: OPENCV_FISHEYE instead, up to " in taken.output
    assert " px off" in taken.output


@pytest.mark.parametrize(
    ("to", "target", "stands"),
    [
        ("kalibr", "a.yaml", "a.yaml"),
        ("opencv", "{camera}.yml", "right.yml"),
        ("colmap", "sparse", "sparse/images.txt"),
    ],
)
def test_nothing_is_written_over_without_being_told_to(
    folder: Path, to: str, target: str, stands: str
) -> None:
    (folder / stands).parent.mkdir(exist_ok=True)
    (folder / stands).write_text("mine")
    arguments = ["rig.json", "--to", to, "-o", target]

    refused = convert(*arguments)
    before = (folder / stands).read_text()
    taken = convert(*arguments, "--overwrite")

    assert isinstance(refused.exception, HybridveError)
    assert "exists already" in str(refused.exception)
    assert before == "mine"
    assert not (folder / "left.yml").exists() or to == "opencv"
    assert taken.exit_code == 0, taken.output
    assert (folder / stands).read_text() != "mine"


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        (["missing.json", "--to", "csv", "-o", "a.csv"], "there is no such rig file"),
        (["{camera}.yml", "--to", "csv", "-o", "a.csv"], "no such file for any camera"),
        (["rig.json", "--to", "csv", "-o", "a.csv"], "csv cannot hold camera 'left'"),
        (["rig.json", "--camera", "up", "--to", "csv", "-o", "a"], "no camera 'up'; it has left"),
        (["rig.json", "--to", "kalibr", "-o", "no/a.yaml"], "there is no folder no"),
        (["rig.json", "--to", "kalibr", "-o", "."], "is a folder"),
    ],
)
def test_a_problem_is_one_line(folder: Path, arguments: list[str], found: str) -> None:
    result = convert(*arguments)

    assert isinstance(result.exception, HybridveError)
    assert found in str(result.exception)
    assert "\n" not in str(result.exception)
    assert [path.name for path in folder.iterdir()] == ["rig.json"]


@pytest.mark.parametrize("size", ["640", "640x", "0x480", "axb"])
def test_a_size_that_is_none_is_wrong_usage(folder: Path, size: str) -> None:
    result = convert("rig.json", "--to", "csv", "-o", "a.csv", "--image-size", size)

    assert result.exit_code == 2
    assert "expected 1920x1080" in result.output


def test_a_size_is_taken_where_the_file_says_none(folder: Path) -> None:
    (folder / "rig.csv").write_text("cam1,500,0,320,0,0,500,240,0,0,0,1,0\n")
    arguments = ["rig.csv", "--from-unit", "mm", "--to", "json", "-o", "a.json"]

    convert(*arguments, "--image-size", "640x480", "--from-pixel-centre", "0")

    camera = read_rig(folder / "a.json")["cam1"]
    assert (camera.width_px, camera.height_px) == (640, 480)
    np.testing.assert_allclose(camera.params, [500.0, 500.0, 320.5, 240.5])
