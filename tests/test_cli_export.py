"""``hybridve export``: what other programs make of a report."""

import json
import math
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pandas as pd
import pytest
import trimesh
import xarray as xr
from click.testing import CliRunner
from helpers.clash_reports import CAMERAS, STEP_S, Spot, write_clash_report
from helpers.sessions import BALL_RADIUS_M, write_ball_session, write_cube_scene
from vtkmodules.vtkFiltersCore import vtkFeatureEdges
from vtkmodules.vtkIOHDF import vtkHDFReader

from hybridve.cli.main import cli
from hybridve.hull.report.read import read_report

Run = Callable[..., int]

LEFT, RIGHT = (-0.04, 0.0, 0.5), (0.04, 0.0, 0.5)


@pytest.fixture
def report(tmp_path: Path) -> Path:
    frames = [[Spot(LEFT, 0.03), Spot(RIGHT, -0.002)], None, [Spot(RIGHT, -0.003)], []]
    return write_clash_report(tmp_path / "r.h5", frames, required_m=0.005, name="a, b")


def error_of(
    run: Run, capsys: pytest.CaptureFixture[str], *arguments: object, status: int = 1
) -> str:
    capsys.readouterr()
    assert run("export", *arguments) == status
    shown = capsys.readouterr()
    assert shown.out == ""
    return shown.err


# --- Tables -------------------------------------------------------------------------------------


def test_pandas_reads_a_row_a_frame_and_object(run: Run, report: Path, tmp_path: Path) -> None:
    assert run("export", report, "--csv", tmp_path / "tables") == 0
    found = pd.read_csv(tmp_path / "tables" / "frames.csv")
    rows = read_report(report).objects["a, b"]

    assert found["frame"].tolist() == [0, 1, 2, 3]
    assert found["object"].tolist() == ["a, b"] * 4
    assert found["verdict"].tolist() == rows.verdict.tolist()
    assert found["collides"].tolist() == rows.collides.tolist()
    for column, values in (
        ("time_s", STEP_S * np.arange(4)),
        ("clearance_lower_m", rows["clearance_m"][:, 0]),
        ("clearance_upper_m", rows["clearance_m"][:, 1]),
        ("clearance_on_hull_z_m", rows["clearance_on_hull_m"][:, 2]),
        ("clearance_at_least_m", rows["clearance_at_least_m"]),
        (f"m_per_px_{CAMERAS[0]}", rows["m_per_px"][:, 0]),
    ):
        np.testing.assert_allclose(found[column], values, rtol=1e-9, equal_nan=True)


def test_pandas_reads_a_row_a_clash(
    run: Run, report: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run("clashes", report, "--json")
    told = json.loads(capsys.readouterr().out)["clashes"]
    assert run("export", report, "--csv", tmp_path / "f.csv") == 0
    found = pd.read_csv(tmp_path / "f.clashes.csv")

    assert found["id"].tolist() == [one["id"] for one in told]
    assert found["kind"].tolist() == ["clash", "too near"]
    for column, values in (
        ("worst_upper_m", [one["worst"]["upper_m"] for one in told]),
        ("worst_on_object_x_m", [one["worst"]["on_object_m"][0] for one in told]),
        ("dwell_s", [one["dwell_s"] for one in told]),
    ):
        np.testing.assert_allclose(found[column], values, rtol=1e-9)


def test_a_report_without_clashes_is_a_table_without_rows(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = write_clash_report(tmp_path / "free.h5", [[], []])

    assert run("export", report, "--csv", tmp_path / "tables") == 0
    assert "0 rows, a clash each" in capsys.readouterr().out
    assert len(pd.read_csv(tmp_path / "tables" / "clashes.csv")) == 0


# --- xarray -------------------------------------------------------------------------------------


def test_xarray_knows_the_axes_and_the_units_of_a_report(report: Path) -> None:
    rows = read_report(report).objects["a, b"]
    with xr.open_dataset(report, group="hybridve/objects/a, b", engine="h5netcdf") as found:
        assert found["clearance_m"].dims == ("time_s", "bound")
        assert found["clearance_on_hull_m"].dims == ("time_s", "axis")
        assert found["m_per_px"].dims == ("time_s", "camera")
        assert found["verdict"].dims == ("time_s",)
        np.testing.assert_allclose(found["time_s"], STEP_S * np.arange(4))
        assert found["camera"].astype(str).values.tolist() == list(CAMERAS)
        assert found["time_s"].attrs["units"] == "s"
        assert found["clearance_m"].attrs["units"] == "m"
        upper = found["clearance_m"].sel(bound=b"upper")
        np.testing.assert_allclose(upper, rows["clearance_m"][:, 1])
        assert not any("phony" in str(name) for name in found.dims)


@pytest.mark.parametrize("group", ["frames", "cameras/cam1"])
def test_frames_and_cameras_have_the_axis_of_time(report: Path, group: str) -> None:
    with xr.open_dataset(report, group=f"hybridve/{group}", engine="h5netcdf") as found:
        np.testing.assert_allclose(found["time_s"], STEP_S * np.arange(4))
        assert all(column.dims[0] == "time_s" for column in found.data_vars.values())


# --- ParaView and meshes ------------------------------------------------------------------------

#: A ball comes near a cube and goes through it.
CENTERS = np.array([[x, 0.0, 0.0] for x in (0.6, 0.4, 0.2)])


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session with its report."""
    folder = tmp_path_factory.mktemp("ball")
    session = write_ball_session(folder, CENTERS, n_cameras=6)
    scene = write_cube_scene(folder, {"hit": (0.0, 0.0, 0.0), "hull": (0.0, 0.0, 900.0)})
    call = ["detect", session, "--scene", scene, "-o", folder / "report.h5", "--no-progress"]
    ran = CliRunner().invoke(cli, [str(one) for one in call], catch_exceptions=False)
    assert ran.exit_code == 0, ran.output
    return folder


def blocks_of(reader: vtkHDFReader, time_s: float) -> dict[str, Any]:
    """What VTK shows at a time, by name."""
    reader.UpdateTimeStep(time_s)
    shown = reader.GetOutputDataObject(0)
    return {
        shown.GetMetaData(at).Get(shown.NAME()): shown.GetPartition(at, 0)
        for at in range(shown.GetNumberOfPartitionedDataSets())
    }


@pytest.mark.slow
def test_vtk_shows_cad_points_nearest_ways_and_the_hull_in_every_frame(
    run: Run, ball: Path, tmp_path: Path
) -> None:
    path = tmp_path / "r.vtkhdf"
    call = ("--vtk", path, "--session", ball, "--cell-mm", "20", "--no-progress")
    assert run("export", ball / "report.h5", *call) == 0
    report = read_report(ball / "report.h5")
    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()

    assert reader.GetNumberOfSteps() == len(CENTERS)
    for row, time_s in enumerate(report.time_s.tolist()):
        shown = blocks_of(reader, time_s)
        assert set(shown) == {
            *("hit", "hit_points", "hit_nearest", "hull", "hull_points", "hull_nearest", "hull.2")
        }
        assert shown["hit"].GetNumberOfCells() == 12
        n_points = report.objects["hit"].n_points[row]
        assert shown["hit_points"].GetNumberOfPoints() == min(n_points, 500)
        ends = [shown["hit_nearest"].GetPoint(end) for end in (0, 1)]
        rows = report.objects["hit"]
        np.testing.assert_allclose(ends[0], rows["clearance_on_object_m"][row], atol=1e-6)
        np.testing.assert_allclose(ends[1], rows["clearance_on_hull_m"][row], atol=1e-6)
        assert shown["hit_nearest"].GetNumberOfCells() == 1
        low_x, high_x, *_ = shown["hull.2"].GetBounds()
        assert abs(0.5 * (low_x + high_x) - CENTERS[row, 0]) < 0.02
        edges = vtkFeatureEdges()
        edges.SetInputData(shown["hull.2"])
        edges.BoundaryEdgesOn()
        edges.NonManifoldEdgesOn()
        edges.FeatureEdgesOff()
        edges.ManifoldEdgesOff()
        edges.Update()
        assert edges.GetOutput().GetNumberOfCells() == 0
    assert not report.objects["hull"].clashes.any()  # and yet there is something to see of it


def test_without_the_session_vtk_shows_all_but_the_hull(
    run: Run, ball: Path, tmp_path: Path
) -> None:
    assert run("export", ball / "report.h5", "--vtk", tmp_path / "r.vtkhdf") == 0
    reader = vtkHDFReader()
    reader.SetFileName(str(tmp_path / "r.vtkhdf"))
    reader.UpdateInformation()

    assert len(blocks_of(reader, 0.0)) == 6


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ply", "glb"])
def test_trimesh_reads_a_closed_hull_of_each_frame(
    run: Run, ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    call = ("--hull-mesh", tmp_path / "hulls", "--mesh-format", kind, "--session", ball)
    capsys.readouterr()
    assert run("export", ball / "report.h5", *call, "--no-progress") == 0
    assert capsys.readouterr().out == f"{tmp_path / 'hulls'}: 3 meshes of 3 frames\n"
    for frame, center in enumerate(CENTERS):
        found = trimesh.load_mesh(tmp_path / "hulls" / f"hull_{frame:06d}.{kind}")
        if kind == "glb":  # y up, by the standard
            center = center[[0, 2, 1]] * (1, 1, -1)
        assert found.is_watertight
        assert found.volume > 4 / 3 * np.pi * BALL_RADIUS_M**3
        np.testing.assert_allclose(found.bounds.mean(axis=0), center, atol=0.03)


def test_cells_that_memory_cannot_hold_are_refused_with_what_it_can(
    run: Run, ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call = ("--hull-mesh", tmp_path / "h", "--session", ball, "--cell-mm", "0.1", "--no-progress")
    line = error_of(run, capsys, ball / "report.h5", *call)

    assert "cells of 0.1 mm" in line
    assert "with --cell-mm" in line
    assert len(line.splitlines()) == 1


# --- BCF ----------------------------------------------------------------------------------------


def topics_of(path: Path) -> dict[str, dict[str, ElementTree.Element]]:
    """What the topics of a BCF file are, by their folders: markup and viewpoint."""
    found: dict[str, dict[str, ElementTree.Element]] = {}
    with zipfile.ZipFile(path) as file:
        assert file.testzip() is None
        version = ElementTree.fromstring(file.read("bcf.version"))
        assert (version.tag, version.attrib) == ("Version", {"VersionId": "3.0"})
        for name in file.namelist():
            folder, _, rest = name.rpartition("/")
            if rest in ("markup.bcf", "viewpoint.bcfv"):
                found.setdefault(folder, {})[rest] = ElementTree.fromstring(file.read(name))
            elif rest == "snapshot.png":
                image = cv2.imdecode(np.frombuffer(file.read(name), np.uint8), cv2.IMREAD_COLOR)
                assert image is not None
    return found


def vector_of(parent: ElementTree.Element, path: str) -> list[float]:
    return [float(str(parent.findtext(f"{path}/{axis}"))) for axis in "XYZ"]


def test_bcf_has_a_topic_a_clash_seen_from_where_its_picture_is(
    run: Run, ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "clashes.bcf"
    call = ("--bcf", path, "--session", ball, "--no-progress")
    capsys.readouterr()
    assert run("export", ball / "report.h5", *call) == 0
    assert capsys.readouterr().out == f"{path}: 1 topic\n"
    run("clashes", ball / "report.h5", "--json")
    (told,) = json.loads(capsys.readouterr().out)["clashes"]

    ((folder, parts),) = topics_of(path).items()
    topic = parts["markup.bcf"].find("Topic")
    assert topic is not None
    assert topic.attrib["Guid"] == folder
    assert topic.attrib["ServerAssignedId"] == told["id"]
    assert topic.attrib["TopicStatus"] == told["status"]
    view = parts["viewpoint.bcfv"]
    eye, way = (
        np.array(vector_of(view, f"PerspectiveCamera/{name}"))
        for name in ("CameraViewPoint", "CameraDirection")
    )
    assert abs(np.linalg.norm(way) - 1.0) < 1e-9
    at = np.array(told["worst"]["on_object_m"]) - eye
    half = math.radians(0.5 * float(str(view.findtext("PerspectiveCamera/FieldOfView"))))
    assert way @ at / np.linalg.norm(at) > math.cos(1.5 * half)  # the clash is in the picture
    np.testing.assert_allclose(
        vector_of(view, "Lines/Line/StartPoint"), told["worst"]["on_object_m"]
    )


def test_a_clash_has_the_same_identity_in_every_bcf_and_what_was_decided(
    run: Run, report: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run("export", report, "--bcf", tmp_path / "1.bcf")
    assert "without pictures: the report holds no meshes, or no rig" in capsys.readouterr().out
    first = topics_of(tmp_path / "1.bcf")
    topic = next(iter(first.values()))["markup.bcf"].find("Topic")
    assert topic is not None
    why = ("--comment", "a < b & c", "--who", "anna")
    assert run("clashes", report, "--approve", topic.attrib["ServerAssignedId"], *why) == 0
    run("export", report, "--bcf", tmp_path / "2.bcf")
    second = topics_of(tmp_path / "2.bcf")

    assert list(first) == list(second)
    topic = next(iter(second.values()))["markup.bcf"].find("Topic")
    assert topic is not None
    assert topic.attrib["TopicStatus"] == "approved"
    assert topic.findtext("Comments/Comment/Comment") == "a < b & c"
    assert topic.findtext("Comments/Comment/Author") == "anna"


# --- What cannot be -----------------------------------------------------------------------------


def test_what_there_is_is_listed(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("export", "--list") == 0
    assert "--html PAGE.html" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "say as what: --html"),
        (("--html", "OUT.pdf"), "OUT.pdf: pages are .html"),
        (("--bcf", "OUT.zip"), "OUT.zip: BCF files are .bcf or .bcfzip"),
        (("--rerun", "OUT.vtk"), "OUT.vtk: recordings for Rerun are .rrd"),
        (("--vtk", "OUT.vtk"), "OUT.vtk: files for ParaView are .vtkhdf"),
        (("--hull-mesh", "hulls"), "--hull-mesh needs --session SESSION"),
        (
            ("--session", "s", "--csv", "t"),
            "--session is of --html, --bcf, --rerun, --hull-mesh and --vtk",
        ),
    ],
)
def test_wrong_usage_is_one_line(
    run: Run,
    report: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    message: str,
) -> None:
    assert message in error_of(run, capsys, report, *arguments, status=2)


def test_without_its_library_rerun_says_what_installs_it(
    run: Run,
    report: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    line = error_of(run, capsys, report, "--rerun", tmp_path / "r.rrd")

    assert "`pip install hybridve[rerun]` installs it" in line
    assert not (tmp_path / "r.rrd").exists()


@pytest.mark.parametrize("name", ["page.html", "f.csv", "f.clashes.csv", "tables/clashes.csv"])
def test_what_exists_is_never_written_over(
    run: Run, report: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    there = tmp_path / name
    there.parent.mkdir(exist_ok=True)
    there.write_text("mine", encoding="utf-8")
    target = {"page.html": ("--html", there), "tables/clashes.csv": ("--csv", there.parent)}
    arguments = target.get(name, ("--csv", tmp_path / "f.csv"))

    assert "exists already" in error_of(run, capsys, report, *arguments)
    assert there.read_text(encoding="utf-8") == "mine"
    assert not list(tmp_path.glob("*.toml"))


def test_a_session_without_the_cameras_of_the_report_is_named(
    run: Run, report: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = write_ball_session(tmp_path / "other", np.zeros((1, 3)), n_cameras=2)
    page = tmp_path / "p.html"
    line = error_of(run, capsys, report, "--html", page, "--session", session)

    assert "has no camera 'cam2', which" in line
    assert "it has cam0, cam1: name the session that the report was made from" in line
    assert len(line.splitlines()) == 1
    assert not page.exists()


def test_a_page_of_a_report_of_no_rig_says_so(
    run: Run, report: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("export", report, "--html", tmp_path / "p.html", "--no-progress") == 0
    text = (tmp_path / "p.html").read_text(encoding="utf-8")

    assert "The report holds no rig that can be read" in text
    assert "1 of 1 object is touched" in text or "is touched" in text
    assert "p.html: " in capsys.readouterr().out
