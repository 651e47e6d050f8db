"""A report is complete or absent, and what is written is what is read."""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, get_args

import h5py
import numpy as np
import pytest
from helpers.contacts import FREE, crumpled_body, free_contact, points_of, some_hits, stored_mesh
from helpers.thorough import asked
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from vtkmodules.vtkIOHDF import vtkHDFReader

from hybridve.calib.errors import ReportError
from hybridve.hull.agreement.outlines import CUT, FIRST, Outline
from hybridve.hull.contact.backtrack import FirstContact
from hybridve.hull.contact.clearance import Clearance
from hybridve.hull.contact.detect import Body, Certificate, Contact
from hybridve.hull.contact.finding import Finding, judged
from hybridve.hull.contact.patches import Patch
from hybridve.hull.contact.recovery import Recovery
from hybridve.hull.contact.respond import Response
from hybridve.hull.contact.uncertainty import Doubt
from hybridve.hull.contact.verdict import VERDICTS
from hybridve.hull.report import write
from hybridve.hull.report.collisions import StoredMesh
from hybridve.hull.report.machine import Run
from hybridve.hull.report.read import read_points, read_report
from hybridve.hull.report.result_file import Kind
from hybridve.hull.report.schema import STAGES, CameraFrame, FrameResult, ReportHeader, State
from hybridve.hull.report.summarize import spans, summarize
from hybridve.hull.report.write import ReportWriter

# The settings of HDF5 do not matter here; small parts make the joins between them happen.
_FEW = settings(
    max_examples=asked(15),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


CAMERAS = ("left", "right", "top")
CERTIFICATES: tuple[Certificate, ...] = get_args(Certificate)
UNREAD: tuple[State, ...] = ("unread", "contradictory")
PARTS = ("clearance", "first contact", "response", "recovery", "doubt")

#: What the reports are about: two objects, and a frame far from the world's origin.
BODIES = [crumpled_body(seed, f"object_{seed}") for seed in range(2)]
ORIGIN_M = (4_000_000.0, -200.0, 0.0)


def a_header(n_objects: int, **changes: Any) -> ReportHeader:
    values: dict[str, Any] = {
        "run": Run("hybridve detect", "a machine", {}, ""),
        "objects": tuple({"name": f"object_{i}", "triangles": 12} for i in range(n_objects)),
        "settings": {"viewport": 10},
        "rig": {"cameras": []},
        "engine": "native",
        "renderer": "a processor",
        "cameras": CAMERAS,
        "local_origin_m": ORIGIN_M,
        "meshes": tuple(local_mesh(BODIES[i]) for i in range(n_objects)),
    }
    return ReportHeader(**(values | changes))


def local_mesh(body: Body) -> StoredMesh:
    """Return the mesh of an object that stands where the report's places begin."""
    return stored_mesh(body)


def a_result(index: int, *contacts: Contact, reason: str = "") -> FrameResult:
    state: State = "unread" if reason else "evaluated"
    findings = tuple(
        judged(Finding(one), is_closed=False, required_m=0.0, share_seen=1.0, rests_on="")
        for one in contacts
    )
    return FrameResult(index, index / 25, reason, findings, {}, state)


def a_contact(draw: st.DrawFn, rng: np.random.Generator, body: Body) -> Contact:
    share = draw(st.sampled_from([0.0, 0.1, 0.5, 0.9, 1.0]))
    certificate = draw(st.sampled_from(CERTIFICATES))
    return Contact(
        certificate,
        body,
        some_hits(body, rng, share),
        rng.normal(size=3) if certificate == "colliding" else np.full(3, np.nan),
        rng.uniform() if certificate == "open" else np.nan,
    )


def numbers_of(
    rng: np.random.Generator,
) -> tuple[Callable[[], NDArray[np.float64]], Callable[[], float]]:
    """Return what draws vectors (3,), and what draws numbers."""
    return lambda: rng.normal(size=3), lambda: float(rng.normal())


def a_patch(rng: np.random.Generator) -> Patch:
    vector, number = numbers_of(rng)
    return Patch(vector(), vector(), (number(), number()), vector(), vector(), 3, 2**40)


def a_finding(draw: st.DrawFn, rng: np.random.Generator, body: Body) -> Finding:
    """Return a finding in which every number differs from every other, and parts are missing."""
    vector, number = numbers_of(rng)
    there = {part for part in PARTS if draw(st.booleans())}
    clearance = Clearance(number(), number(), vector(), vector(), number(), number())
    first = FirstContact(number(), number(), vector(), "outline lost")
    response = Response(
        vector(),
        vector(),
        vector(),
        vector(),
        number(),
        "no exit",
        vector(),
        vector(),
        number(),
        "",
    )
    hinges_on = draw(st.sampled_from([(), ("left",), ("left", "top")]))
    survives = draw(st.sampled_from([not hinges_on, None]))
    doubt = Doubt(number(), number(), number(), vector(), False, 2, survives, hinges_on, "unsure")
    return Finding(
        a_contact(draw, rng, body),
        clearance if "clearance" in there else None,
        (number(), number()),
        first if "first contact" in there else None,
        number(),
        number(),
        response if "response" in there else None,
        doubt if "doubt" in there else None,
        Recovery("open", number(), number()) if "recovery" in there else None,
        tuple(a_patch(rng) for _ in range(draw(st.integers(0, 2)))),
        draw(st.sampled_from(VERDICTS)),
        draw(st.sampled_from(["", "at most 3 mm away"])),
    )


def an_outline(rng: np.random.Generator) -> Outline:
    pieces = [rng.uniform(0.0, 700.0, (rng.integers(3, 9), 2)) for _ in range(rng.integers(3))]
    marks = [np.append(FIRST, np.zeros(len(piece) - 1)) for piece in pieces]
    corners_px = np.concatenate([np.zeros((0, 2)), *pieces]).astype(np.float32)
    cut = rng.choice([0, CUT], len(corners_px))
    flat = (np.concatenate([np.zeros(0), *marks]) + cut).astype(np.uint8)
    return Outline(corners_px, flat, bool(rng.integers(2)))


@st.composite
def frame_results(draw: st.DrawFn, n_objects: int = 2) -> list[FrameResult]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    results = []
    for index in range(draw(st.integers(1, 9))):
        reason = draw(st.sampled_from(["", "", "", "camera 'ü' has stopped recording"]))
        findings = tuple(
            a_finding(draw, rng, body) for body in BODIES[: 0 if reason else n_objects]
        )
        stage_s = dict(zip(STAGES, rng.uniform(size=len(STAGES)).tolist(), strict=True))
        state = draw(st.sampled_from(UNREAD)) if reason else "evaluated"
        rests_on = draw(st.sampled_from(["", "left saw nothing"]))
        cameras = tuple(
            CameraFrame(
                float(rng.uniform()),
                int(rng.integers(1 << 20)),
                float(rng.uniform()),
                float(rng.uniform()),
                bool(rng.integers(2)),
                rng.uniform(size=4),
                an_outline(rng),
            )
            for _ in CAMERAS[: 0 if state == "unread" else None]
        )
        results.append(
            FrameResult(index, index / 25, reason, findings, stage_s, state, rests_on, cameras)
        )
    return results


def write_all(
    path: Path, results: list[FrameResult], parts: Sequence[str] = PARTS, **options: Any
) -> None:
    with ReportWriter(path, a_header(2, parts=frozenset(parts)), **options) as writer:
        for result in results[writer.n_done :]:
            writer.append(result)
        writer.finish()


def datasets(path: Path, *, but: str = "stage_s") -> dict[str, bytes]:
    found: dict[str, bytes] = {}

    def keep(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and but not in name:
            found[name] = np.asarray(item[()]).tobytes()

    with h5py.File(path) as file:
        file.visititems(keep)
    return found


@pytest.mark.slow
@_FEW
@given(results=frame_results())
def test_what_is_written_is_read_back(tmp_path: Path, results: list[FrameResult]) -> None:
    path = tmp_path / "report.h5"

    write_all(path, results, overwrite=True)

    report = read_report(path)
    assert report.index.tolist() == [result.index for result in results]
    assert report.reason.tolist() == [result.reason for result in results]
    assert report.state.tolist() == [result.state for result in results]
    assert report.rests_on.tolist() == [result.rests_on for result in results]
    for number, camera in enumerate(CAMERAS):
        read = report.cameras[camera]
        expected = [one.cameras[number].object_share if one.cameras else np.nan for one in results]
        np.testing.assert_array_equal(read["object_share"], expected)
        denied_px = [one.cameras[number].denied_px if one.cameras else 0 for one in results]
        assert read["denied_px"].tolist() == denied_px
        for name in ("supported_share", "denies_share"):
            shares = [
                getattr(one.cameras[number], name) if one.cameras else np.nan for one in results
            ]
            np.testing.assert_array_equal(read[name], shares)
        nowhere = np.full(4, np.nan)
        alone_px = [one.cameras[number].alone_px if one.cameras else nowhere for one in results]
        np.testing.assert_array_equal(read["alone_px"], alone_px)
        deny = [bool(one.cameras) and one.cameras[number].is_denier for one in results]
        assert read["is_denier"].tolist() == deny
    assert list(report.objects) == ["object_0", "object_1"]
    for stage in STAGES:
        assert report.stage_s[stage].tolist() == [result.stage_s[stage] for result in results]
    for number, rows in enumerate(report.objects.values()):
        for row, result in enumerate(results):
            xyz_m, triangle = read_points(path, f"object_{number}", row)
            if result.reason:
                assert not rows.collides[row]
                assert rows.certificate[row] == ""
                assert np.isnan(rows.witness_m[row]).all()
                assert np.isnan(rows.open_at_m[row])
                assert len(xyz_m) == 0
                assert (rows.verdict[row], rows.why[row]) == ("unknown", result.reason)
                continue
            contact = result.findings[number].contact
            assert rows.collides[row] == contact.collides
            expected_m, expected_triangle = contact.points()
            assert rows.n_triangles[row] == len(set(expected_triangle.tolist()))
            assert rows.n_points[row] == len(expected_triangle)
            finding = result.findings[number]
            assert (rows.verdict[row], rows.why[row]) == (finding.verdict, finding.reason)
            assert rows.certificate[row] == contact.certificate
            assert_place(rows.witness_m[row], contact.witness_world)
            np.testing.assert_array_equal(rows.open_at_m[row], contact.open_at_m)
            np.testing.assert_array_equal(xyz_m - ORIGIN_M, expected_m + ORIGIN_M - ORIGIN_M)
            np.testing.assert_array_equal(triangle, expected_triangle)
            start, stop = rows.patches["offset"][row : row + 2]
            for patch, at in zip(finding.patches, range(int(start), int(stop)), strict=True):
                assert_place(rows.patches["cp_obj_m"][at], patch.cp_obj_world)
                assert_place(rows.patches["on_hull_m"][at], patch.on_hull_world)
                assert_place(rows.patches["lower_m"][at], patch.lower_world)
                extent_m = patch.upper_world - patch.lower_world
                np.testing.assert_array_equal(rows.patches["extent_m"][at], extent_m)
                np.testing.assert_array_equal(rows.patches["clearance_m"][at], patch.clearance_m)
                assert (rows.patches["triangles"][at], rows.patches["points"][at]) == (3, 2**40)


@_FEW
@given(results=frame_results())
def test_outlines_are_read_from_the_parts_as_they_were_taken_in(
    tmp_path: Path, results: list[FrameResult]
) -> None:
    with ReportWriter(tmp_path / "report.h5", a_header(2), overwrite=True) as writer:
        for result in results[:-1]:
            writer.append(result)
        writer.outlines()  # makes a part of what is there
        writer.append(results[-1])
        found = writer.outlines()
        writer.finish()

    assert [frame.index for frame in found] == [result.index for result in results]
    for frame, result in zip(found, results, strict=True):
        assert len(frame.outlines) == len(result.cameras)
        deny = [camera.is_denier for camera in result.cameras] or [False] * len(CAMERAS)
        assert frame.deniers.tolist() == deny
        for outline, camera in zip(frame.outlines, result.cameras, strict=True):
            np.testing.assert_array_equal(outline.corners_px, camera.outline.corners_px)
            np.testing.assert_array_equal(outline.marks, camera.outline.marks)
            assert outline.is_inverse == camera.outline.is_inverse
    with h5py.File(tmp_path / "report.h5") as file:
        for number, name in enumerate(CAMERAS):
            stored = file[f"hybridve/cameras/{name}/outline"]
            ends = np.cumsum(
                [len(one.outlines[number].marks) if one.outlines else 0 for one in found]
            )
            assert stored["offset"][1:].tolist() == ends.tolist()
            assert len(stored["corners_px"]) == len(stored["marks"]) == ends[-1]


def assert_place(found_m: NDArray[np.float64], expected_m: NDArray[np.float64]) -> None:
    """Assert that a place is where it was, but for the rounding at 4,000 km."""
    np.testing.assert_allclose(found_m, expected_m, atol=1e-9)


def expected_columns(finding: Finding) -> dict[str, Any]:
    """Return what the columns beyond the contact's hold of a finding, said once more by hand."""
    clearance, first = finding.clearance, finding.first_contact
    response, doubt = finding.response, finding.doubt
    expected: dict[str, Any] = {
        "approach_m_s": finding.approach_m_s,
        "first_contact_s": finding.first_contact_s,
        "first_contact_uncertainty_s": finding.first_contact_uncertainty_s,
    }
    if clearance is not None:
        expected |= {
            "clearance_m": (clearance.lower_m, clearance.upper_m),
            "clearance_on_object_m": clearance.on_object_world,
            "clearance_on_hull_m": clearance.on_hull_world,
            "depth_m": (clearance.depth_lower_m, clearance.depth_upper_m),
        }
    if first is not None:
        expected |= {"first_contact_m": first.point_world, "first_contact_status": first.status}
    if response is not None:
        expected |= {
            "cp_obj_m": response.cp_obj_world,
            "v_rec": response.v_rec,
            "cp_hull_m": response.cp_hull_world,
            "n_hull": response.n_hull,
            "d_rec_m": response.d_rec_m,
            "response_status": response.status,
            "cp_hull_paper_m": response.cp_hull_paper_world,
            "n_hull_paper": response.n_hull_paper,
            "d_rec_paper_m": response.d_rec_paper_m,
            "d_rec_difference_m": response.d_rec_paper_m - response.d_rec_m,
            "response_status_paper": response.status_paper,
        }
    if finding.recovery is not None:
        recovery = finding.recovery
        expected |= {
            "recovery_frees": recovery.frees,
            "free_shift_m": (recovery.blocked_m, recovery.free_m),
        }
    if doubt is not None:
        expected |= {
            "clearance_std_m": doubt.std_m,
            "clearance_at_least_m": doubt.at_least_m,
            "real_clearance_at_most_m": doubt.real_upper_m,
            "m_per_px": doubt.m_per_px,
            "n_seeing": doubt.n_seeing,
            "survives": "" if doubt.survives is None else "yes" if doubt.survives else "no",
            "hinges_on": ", ".join(doubt.hinges_on),
            "component": doubt.component,
        }
    return expected


PLACES = {
    "clearance_on_object_m",
    "clearance_on_hull_m",
    "first_contact_m",
    "cp_obj_m",
    "cp_hull_m",
    "cp_hull_paper_m",
}

COLUMNS_OF_CONTACT = {
    "verdict",
    "reason",
    "collides",
    "n_points",
    "n_triangles",
    "certificate",
    "witness_m",
    "open_at_m",
}


@pytest.mark.slow
@_FEW
@given(results=frame_results())
def test_every_column_is_read_back_and_what_is_missing_is_nan_nought_or_empty(
    tmp_path: Path, results: list[FrameResult]
) -> None:
    path = tmp_path / "report.h5"

    write_all(path, results, overwrite=True)

    for number, rows in enumerate(read_report(path).objects.values()):
        for row, result in enumerate(results):
            expected = {} if result.reason else expected_columns(result.findings[number])
            for name, values in rows.columns.items():
                value = values[row]
                if name in PLACES and name in expected:
                    assert_place(value, expected[name])
                elif name in expected:
                    np.testing.assert_array_equal(value, np.asarray(expected[name]), name)
                elif name not in COLUMNS_OF_CONTACT:
                    is_float = np.issubdtype(values.dtype, np.floating)
                    assert np.isnan(value).all() if is_float else not value, name
            assert expected.keys() <= rows.columns.keys()
        assert rows["m_per_px"].shape == (len(results), len(CAMERAS))


def test_columns_of_what_was_not_computed_are_absent(tmp_path: Path) -> None:
    path = tmp_path / "report.h5"

    write_all(path, one_result(), parts=["response"])

    rows = read_report(path).objects["object_0"]
    assert "d_rec_m" in rows
    for name in ("clearance_m", "approach_m_s", "first_contact_s", "survives"):
        assert name not in rows
    with h5py.File(path) as file:
        assert "clearance_m" not in file["hybridve/objects/object_0"]


def test_a_column_with_a_number_for_each_camera_names_them(tmp_path: Path) -> None:
    path = tmp_path / "report.h5"

    write_all(path, one_result())

    with h5py.File(path) as file:
        column = file["hybridve/objects/object_0/m_per_px"]
        assert tuple(column.attrs["cameras"]) == CAMERAS


@pytest.mark.slow
@_FEW
@given(results=frame_results(), data=st.data())
def test_a_run_that_was_cut_off_and_taken_up_gives_the_same_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, results: list[FrameResult], data: st.DataObject
) -> None:
    monkeypatch.setattr(write, "_PART_FRAMES", data.draw(st.integers(1, 4)))
    cut = data.draw(st.integers(1, len(results)))
    whole, resumed = tmp_path / "whole.h5", tmp_path / "resumed.h5"
    resumed.unlink(missing_ok=True)
    write_all(whole, results, overwrite=True)

    def write_until_cut_off() -> None:
        with ReportWriter(resumed, a_header(2, parts=frozenset(PARTS))) as writer:
            for result in results[:cut]:
                writer.append(result)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_until_cut_off()
    assert not resumed.exists()
    write_all(resumed, results, resume=True)

    assert datasets(resumed) == datasets(whole)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["resumed.h5", "whole.h5"]


@pytest.mark.slow
@_FEW
@given(results=frame_results(), data=st.data())
def test_vtk_reads_the_points_of_every_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, results: list[FrameResult], data: st.DataObject
) -> None:
    monkeypatch.setattr(write, "_PART_FRAMES", data.draw(st.integers(1, 4)))
    path = tmp_path / "report.h5"
    write_all(path, results, overwrite=True)
    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == len(results)

    for result in results:
        reader.UpdateTimeStep(result.time_s)  # as ParaView asks

        shown = reader.GetOutputDataObject(0)
        assert shown.GetNumberOfPartitionedDataSets() == 2 * len(BODIES)
        for number, body in enumerate(BODIES):
            surface = shown.GetPartition(2 * number, 0)
            vertices_m = body.triangles.vertices_world
            assert surface.GetNumberOfPoints() == len(vertices_m)
            assert surface.GetNumberOfCells() == len(body.triangles)
            cloud = shown.GetPartition(2 * number + 1, 0)
            expected_m = np.zeros((0, 3))
            if result.findings:
                expected_m = points_of(result.findings[number].contact)
            found_m = [cloud.GetPoint(i) for i in range(cloud.GetNumberOfPoints())]
            assert found_m == [tuple(one) for one in expected_m.astype(np.float32).tolist()]
            assert cloud.GetNumberOfCells() == (1 if len(expected_m) else 0)


def one_result() -> list[FrameResult]:
    return [a_result(0, FREE, FREE)]


def test_a_killed_run_leaves_finished_parts_that_can_be_taken_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(write, "_PART_FRAMES", 1)
    path = tmp_path / "report.h5"
    killed = ReportWriter(path, a_header(2))  # never left, as after SIGKILL
    killed.append(one_result()[0])
    (tmp_path / "report.h5.parts" / "000000001.partial").write_bytes(b"half a part")

    writer = ReportWriter(path, a_header(2), resume=True)

    assert writer.n_done == 1


def test_an_interrupted_run_without_a_frame_leaves_nothing(tmp_path: Path) -> None:
    def interrupted() -> None:
        with ReportWriter(tmp_path / "report.h5", a_header(2)):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()

    assert list(tmp_path.iterdir()) == []


def test_a_run_cannot_be_taken_up_with_other_settings(tmp_path: Path) -> None:
    path = tmp_path / "report.h5"
    ReportWriter(path, a_header(2))

    with pytest.raises(ReportError, match="other settings"):
        ReportWriter(path, a_header(2, settings={"viewport": 20}), resume=True)


def test_parts_of_another_run_are_not_thrown_away_unasked(tmp_path: Path) -> None:
    path = tmp_path / "report.h5"
    ReportWriter(path, a_header(2))

    with pytest.raises(ReportError, match="--resume"):
        ReportWriter(path, a_header(2))


def test_an_existing_report_is_kept_unless_overwriting_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "report.h5"
    path.write_text("precious", encoding="utf-8")

    with pytest.raises(ReportError, match="--overwrite"):
        ReportWriter(path, a_header(2))

    assert path.read_text(encoding="utf-8") == "precious"


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(ReportError, match="there is no folder"):
        ReportWriter(tmp_path / "nowhere" / "report.h5", a_header(2))


@pytest.fixture
def report(tmp_path: Path) -> Path:
    path = tmp_path / "report.h5"
    write_all(path, one_result())
    return path


def test_every_dataset_says_its_unit_and_meaning_and_is_checked(report: Path) -> None:
    def check(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            assert item.attrs["unit"], name
            assert item.attrs["description"], name
            assert item.attrs["kind"] in get_args(Kind), name
            if item.shape:
                assert item.compression == "gzip", name
                assert item.shuffle, name
                assert item.fletcher32, name

    with h5py.File(report) as file:
        file["hybridve"].visititems(check)
        assert dict(file.attrs)["format"] == "hybridve-report"
        assert file.attrs["version"] == 2


def test_a_report_from_before_a_column_was_known_is_read(report: Path) -> None:
    with h5py.File(report, "r+") as file:
        del file["hybridve/frames/stage_s/doubt"]
        del file["hybridve/objects/object_0/survives"]

    found = read_report(report)

    assert "doubt" not in found.stage_s
    assert "query" in found.stage_s
    assert "survives" not in found.objects["object_0"]
    assert "survives" in found.objects["object_1"]


def test_a_report_without_a_column_of_every_report_is_damaged(report: Path) -> None:
    with h5py.File(report, "r+") as file:
        del file["hybridve/objects/object_0/certificate"]

    with pytest.raises(ReportError, match="damaged"):
        read_report(report)


def test_another_version_is_refused_by_name(report: Path) -> None:
    with h5py.File(report, "r+") as file:
        file.attrs["version"] = 7

    with pytest.raises(ReportError, match="report version 7"):
        read_report(report)


def test_a_flipped_byte_is_noticed(tmp_path: Path, report: Path) -> None:
    with h5py.File(report) as file:
        chunk = file["hybridve/frames/time_s"].id.get_chunk_info(0)
    damaged = tmp_path / "damaged.h5"
    shutil.copy(report, damaged)
    with damaged.open("r+b") as stream:
        stream.seek(chunk.byte_offset)
        byte = stream.read(1)
        stream.seek(chunk.byte_offset)
        stream.write(bytes([byte[0] ^ 0x10]))

    with pytest.raises(ReportError, match="damaged"):
        read_report(damaged)


@pytest.mark.parametrize("content", [b"", b"not HDF5 at all"])
def test_a_file_that_is_no_report_is_told_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other.h5"
    path.write_bytes(content)

    with pytest.raises(ReportError, match="not a readable report") as caught:
        read_report(path)

    assert "\n" not in str(caught.value)


def test_an_unknown_object_is_named_with_those_there_are(report: Path) -> None:
    with pytest.raises(ReportError, match="object_0, object_1"):
        read_points(report, "object_9", 0)


@given(flags=st.lists(st.booleans(), max_size=20))
def test_spans_cover_the_true_flags_and_nothing_else(flags: list[bool]) -> None:
    found = spans(np.array(flags, np.bool_))

    covered = [False] * len(flags)
    for first, last in found:
        assert first <= last
        assert first == 0 or not flags[first - 1]
        assert last == len(flags) - 1 or not flags[last + 1]
        covered[first : last + 1] = [True] * (last + 1 - first)
    assert covered == flags


def test_a_witness_counts_as_a_collision_and_open_is_not_free(tmp_path: Path) -> None:
    free = FREE
    missed = free_contact("colliding", witness_world=np.array([1.0, 2.0, 3.0]))
    is_open = [free_contact("open", open_at_m=size_m) for size_m in (1e-4, 3e-4)]
    path = tmp_path / "report.h5"

    write_all(
        path,
        [
            a_result(0, free, is_open[0]),
            a_result(1, missed, is_open[1]),
            a_result(2, free, free),
        ],
    )

    first, second = summarize(read_report(path))["objects"]
    assert first["verdict"] == "clash"
    assert (first["frames_colliding"], first["frames_sampled_colliding"]) == (1, 0)
    assert [span["first_frame"] for span in first["spans"]] == [1]
    assert second["verdict"] == "open"
    assert (second["frames_open"], second["frames_proved_free"]) == (2, 1)
    assert second["open_at_m"] == 3e-4


@pytest.mark.slow
def test_a_distance_is_kept_only_if_every_frame_is_evaluated_and_proved(tmp_path: Path) -> None:
    free, sampled = FREE, free_contact("")
    path = tmp_path / "report.h5"

    write_all(
        path,
        [
            a_result(0, free, free),
            a_result(2, free, sampled),
        ],
    )

    numbers = summarize(read_report(path))
    # The worst comes first.
    assert [found["name"] for found in numbers["objects"]] == ["object_1", "object_0"]
    assert [found["verdict"] for found in numbers["objects"]] == ["open", "kept"]
    write_all(path, [a_result(0, free, free), a_result(1, reason="camera gone")], overwrite=True)
    numbers = summarize(read_report(path))
    assert [found["verdict"] for found in numbers["objects"]] == ["unknown", "unknown"]
    assert numbers["verdict"] == "unknown"
    assert numbers["frames_invalid"] == 1
    assert numbers["reasons"] == {"camera gone": 1}
