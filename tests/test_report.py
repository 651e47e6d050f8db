"""A report is complete or absent, and what is written is what is read."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from vtkmodules.vtkIOHDF import vtkHDFReader

from hybridve.calib.errors import ReportError
from hybridve.hull.contact.backtrack import FirstContact
from hybridve.hull.contact.clearance import Clearance
from hybridve.hull.contact.detect import Contact
from hybridve.hull.contact.finding import Finding
from hybridve.hull.contact.respond import Response
from hybridve.hull.contact.uncertainty import Doubt
from hybridve.hull.report import write
from hybridve.hull.report.read import read_points, read_report
from hybridve.hull.report.schema import STAGES, FrameResult, Kind, ReportHeader
from hybridve.hull.report.summarize import spans, summarize
from hybridve.hull.report.write import ReportWriter

# The settings of HDF5 do not matter here; small parts make the joins between them happen.
_FEW = settings(
    max_examples=25,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


CAMERAS = ("left", "right", "top")
PARTS = ("clearance", "first contact", "response", "doubt")


def a_header(n_objects: int, **changes: Any) -> ReportHeader:
    values: dict[str, Any] = {
        "command": "hybridve detect",
        "objects": tuple({"name": f"object_{i}", "triangles": 12} for i in range(n_objects)),
        "settings": {"viewport": 10},
        "rig": {"cameras": []},
        "engine": "native",
        "renderer": "a processor",
        "cameras": CAMERAS,
    }
    return ReportHeader(**(values | changes))


def a_result(index: int, *contacts: Contact, reason: str = "") -> FrameResult:
    return FrameResult(index, index / 25, reason, tuple(map(Finding, contacts)), {})


def a_contact(draw: st.DrawFn, rng: np.random.Generator) -> Contact:
    n_points = draw(st.integers(0, 4))
    certificate = draw(st.sampled_from(["colliding", "free", "open", ""]))
    return Contact(
        certificate,
        rng.normal(size=(n_points, 3)).astype(np.float32),
        np.sort(rng.integers(0, 3, n_points)).astype(np.uint32),
        rng.normal(size=3) if certificate == "colliding" else np.full(3, np.nan),
        rng.uniform() if certificate == "open" else np.nan,
    )


def a_finding(draw: st.DrawFn, rng: np.random.Generator) -> Finding:
    """Return a finding in which every number differs from every other, and parts are missing."""
    number, vector = rng.normal, lambda: rng.normal(size=3)
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
        a_contact(draw, rng),
        clearance if "clearance" in there else None,
        (number(), number()),
        first if "first contact" in there else None,
        number(),
        number(),
        response if "response" in there else None,
        doubt if "doubt" in there else None,
    )


@st.composite
def frame_results(draw: st.DrawFn, n_objects: int = 2) -> list[FrameResult]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    results = []
    for index in range(draw(st.integers(1, 9))):
        reason = draw(st.sampled_from(["", "", "", "camera 'ü' has stopped recording"]))
        findings = tuple(a_finding(draw, rng) for _ in range(0 if reason else n_objects))
        stage_s = dict(zip(STAGES, rng.uniform(size=len(STAGES)).tolist(), strict=True))
        results.append(FrameResult(index, index / 25, reason, findings, stage_s))
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


@_FEW
@given(results=frame_results())
def test_what_is_written_is_read_back(tmp_path: Path, results: list[FrameResult]) -> None:
    path = tmp_path / "report.h5"

    write_all(path, results, overwrite=True)

    report = read_report(path)
    assert report.index.tolist() == [result.index for result in results]
    assert report.reason.tolist() == [result.reason for result in results]
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
                continue
            contact = result.findings[number].contact
            assert rows.collides[row] == contact.collides
            assert rows.n_triangles[row] == len(set(contact.triangle.tolist()))
            assert rows.certificate[row] == contact.certificate
            np.testing.assert_array_equal(rows.witness_m[row], contact.witness_world)
            np.testing.assert_array_equal(rows.open_at_m[row], contact.open_at_m)
            np.testing.assert_array_equal(xyz_m, contact.points_world)
            np.testing.assert_array_equal(triangle, contact.triangle)


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


COLUMNS_OF_CONTACT = {
    "collides",
    "n_points",
    "n_triangles",
    "certificate",
    "witness_m",
    "open_at_m",
}


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
                if name in expected:
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
        contacts = [finding.contact for finding in result.findings]
        expected = [point for c in contacts for point in c.points_world.tolist()]
        triangles = [number for c in contacts for number in c.triangle.tolist()]
        objects = [i for i, c in enumerate(contacts) for _ in c.triangle]
        assert [list(shown.GetPoint(i)) for i in range(shown.GetNumberOfPoints())] == expected
        assert shown.GetNumberOfCells() == (1 if expected else 0)
        for name, values in (("triangle", triangles), ("object", objects)):
            array = shown.GetPointData().GetArray(name)
            assert [array.GetValue(i) for i in range(array.GetNumberOfValues())] == values


def one_result() -> list[FrameResult]:
    contact = Contact("free", np.zeros((0, 3), np.float32), np.zeros(0, np.uint32))
    return [a_result(0, contact, contact)]


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
        assert file.attrs["version"] == 1


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


NOTHING = (np.zeros((0, 3), np.float32), np.zeros(0, np.uint32))


def test_a_witness_counts_as_a_collision_and_open_is_not_free(tmp_path: Path) -> None:
    free = Contact("free", *NOTHING)
    missed = Contact("colliding", *NOTHING, np.array([1.0, 2.0, 3.0]))
    is_open = [Contact("open", *NOTHING, open_at_m=size_m) for size_m in (1e-4, 3e-4)]
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
    assert first["verdict"] == "colliding"
    assert (first["frames_colliding"], first["frames_sampled_colliding"]) == (1, 0)
    assert [span["first_frame"] for span in first["spans"]] == [1]
    assert second["verdict"] == "open"
    assert (second["frames_open"], second["frames_proved_free"]) == (2, 1)
    assert second["open_at_m"] == 3e-4


def test_an_object_is_called_free_only_if_every_evaluated_frame_is_proved(tmp_path: Path) -> None:
    free, sampled = Contact("free", *NOTHING), Contact("", *NOTHING)
    path = tmp_path / "report.h5"

    write_all(
        path,
        [
            a_result(0, free, free),
            a_result(1, reason="camera gone"),
            a_result(2, free, sampled),
        ],
    )

    numbers = summarize(read_report(path))
    assert [found["verdict"] for found in numbers["objects"]] == ["free", "clear"]
    assert numbers["frames_invalid"] == 1
    assert numbers["reasons"] == {"camera gone": 1}
