"""Runs of samples are the collision points: any reader makes the same ones from a report."""

import gzip
from pathlib import Path

import h5py
import numpy as np
from helpers.contacts import crumpled_body, some_hits, stored_mesh
from helpers.sessions import write_ball_session, write_cube_scene
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.hull.contact.detect import collision_points
from hybridve.hull.query.engine import Hits
from hybridve.hull.report.collisions import Runs
from hybridve.hull.report.read import read_points, read_report
from hybridve.hull.report.summarize import summarize

DATA = Path(__file__).resolve().parent.parent / "data"


def points_by_hand(group: h5py.Group, row: int) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """Return an object's collision points of a row, as the manual tells to make them."""
    mesh, runs = group["mesh"], group["runs"]
    order, u = mesh["order"][:], mesh["viewport"][:].astype(np.int64)[mesh["order"][:]]
    before = np.concatenate([[0], np.cumsum(u * (u + 1) // 2)])
    rows = slice(*runs["offset"][row : row + 2].astype(int))
    start = before[np.argsort(order)[runs["triangle"][rows]]] + runs["first"][rows]
    number = np.concatenate([[], *map(np.arange, start, start + runs["count"][rows])]).astype(int)
    on = np.searchsorted(before, number, side="right") - 1  # the triangle, as `order` counts
    k, u = number - before[on], u[on]
    j = np.floor((2 * u + 1 - np.sqrt((2 * u + 1.0) ** 2 - 8 * k)) / 2).astype(int)
    i = k - (j * u - j * (j - 1) // 2)
    pose = mesh["placement"][row if len(mesh["placement"]) > 1 else 0]
    a, b, c = (mesh["vertices_m"][:] @ pose[:, :3].T + pose[:, 3])[mesh["faces"][:][order[on]].T]
    i, j = i / np.maximum(u - 1, 1), j / np.maximum(u - 1, 1)
    xyz = a + (b - a) * i[:, None] + (c - a) * j[:, None]
    xyz[u == 1] = ((a + b + c) / 3)[u == 1]
    return xyz, order[on]


@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 0.05, 0.5, 0.95, 1.0]))
def test_runs_and_mesh_are_the_points(seed: int, share: float) -> None:
    body = crumpled_body(seed)
    hits = some_hits(body, np.random.default_rng(seed), share)
    mesh = stored_mesh(body)

    runs = Runs.of(hits.start, hits.stop, hits.topology.samples_before, body.numbers)
    xyz_m, triangle = mesh.points(runs, 0)

    expected_m, expected = collision_points(body, hits)
    np.testing.assert_array_equal(xyz_m, expected_m)
    np.testing.assert_array_equal(triangle, expected)
    assert len(runs) == len(hits.start)


@given(seed=st.integers(0, 2**32 - 1), most=st.integers(1, 40))
def test_a_sample_is_every_kth_of_the_points(seed: int, most: int) -> None:
    body = crumpled_body(seed)
    hits = some_hits(body, np.random.default_rng(seed), 0.6)
    mesh = stored_mesh(body)
    runs = Runs.of(hits.start, hits.stop, hits.topology.samples_before, body.numbers)

    xyz_m, triangle = mesh.points(runs, 0, most)

    step = max(1, -(-len(hits) // most))
    expected_m, expected = collision_points(body, hits)
    np.testing.assert_array_equal(xyz_m, expected_m[::step])
    np.testing.assert_array_equal(triangle, expected[::step])
    assert len(xyz_m) <= most


def test_a_run_longer_than_its_number_holds_is_cut() -> None:
    """Two triangles with the largest viewport, wholly in the hull, have more samples than 2^32."""
    before = np.array([0, 3_000_000_000, 6_000_000_000], np.int64)
    numbers = np.array([7, 3], np.uint32)

    runs = Runs.of(np.array([5]), np.array([5_999_999_999]), before, numbers)

    assert runs.count.astype(np.int64).sum() == 5_999_999_994
    assert runs.triangle.tolist() == [7, 3]
    assert runs.first.tolist() == [5, 2**32 - 1 + 5 - 3_000_000_000]


def test_ten_lines_of_numpy_make_the_points_of_a_report(run, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    session = write_ball_session(tmp_path / "session", np.array([[-0.25, 0.0, 0.0], [0.9, 0, 0]]))
    scene = write_cube_scene(tmp_path, {"hit": (0.0, 0.0, 0.0)})
    scene.write_text(
        scene.read_text(encoding="utf-8") + "rotate_deg = [10, 20, 30]\n", encoding="utf-8"
    )
    path = tmp_path / "report.h5"
    call = ("detect", session, "--scene", scene, "-o", path, "--viewport", 9, "--no-doubt")
    assert run(*call, "--points", "all") == 0

    with h5py.File(path) as file:
        group = file["hybridve/objects/hit"]
        for row in range(2):
            xyz, triangle = points_by_hand(group, row)
            assert len(xyz) == group["n_points"][row]
            world_m, expected = read_points(path, "hit", row)
            np.testing.assert_allclose(
                xyz + file["hybridve/settings/local_origin_m"][:], world_m, atol=1e-12
            )
            np.testing.assert_array_equal(triangle, expected)
            start, stop = group["points/offset"][row : row + 2].astype(int)
            np.testing.assert_array_equal(group["points/xyz_m"][start:stop], xyz.astype(np.float32))
            np.testing.assert_array_equal(group["points/triangle"][start:stop], triangle)
        assert group["n_points"][0] > 100
        assert group["n_points"][1] == 0


def test_one_mesh_of_two_objects_stands_in_the_file_once(run, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    session = write_ball_session(tmp_path / "session", np.array([[-0.25, 0.0, 0.0]]))
    scene = write_cube_scene(tmp_path, {"one": (0.0, 0.0, 0.0), "two": (0.0, 500.0, 0.0)})
    path = tmp_path / "report.h5"
    assert run("detect", session, "--scene", scene, "-o", path, "--no-doubt") == 0

    with h5py.File(path) as file:
        one, two = (file[f"hybridve/objects/{name}/mesh"] for name in ("one", "two"))
        assert one["vertices_m"] == two["vertices_m"]  # the same place in the file
        assert one.attrs["sha256"] == two.attrs["sha256"]
        moved_m = two["placement"][0] - one["placement"][0]
        np.testing.assert_allclose(
            moved_m, np.array([[0, 0, 0, 0], [0, 0, 0, 0.5], [0, 0, 0, 0]]), atol=1e-15
        )
        assert len(file["hybridve/meshes"]) == 1


def test_a_report_of_version_1_is_read_with_the_verdicts_it_would_have(tmp_path: Path) -> None:
    path = tmp_path / "report_v1.h5"
    path.write_bytes(gzip.decompress((DATA / "golden" / "report_v1.h5.gz").read_bytes()))

    report = read_report(path)
    hit, far = report.objects["hit"], report.objects["far"]

    assert report.attributes["version"] == 1
    assert report.state.tolist() == ["evaluated", "unread", "evaluated"]
    assert hit.verdict.tolist() == ["kept", "unknown", "clash"]
    assert far.verdict.tolist() == ["too near", "unknown", "too near"]
    assert "4800.00 mm are required" in far.why[0]
    xyz_m, triangle = read_points(path, "hit", 2)
    assert len(xyz_m) == len(triangle) == hit.n_points[2] == 107
    np.testing.assert_allclose(np.abs(xyz_m).max(axis=1), 0.1, atol=1e-7)
    assert [found["name"] for found in summarize(report)["objects"]] == ["hit", "far"]


def test_hits_of_a_whole_mesh_are_one_run() -> None:
    body = crumpled_body(3)
    topology = body.triangles.topology
    hits = Hits(topology, np.zeros(1, np.int64), topology.samples_before[-1:])

    runs = Runs.of(hits.start, hits.stop, topology.samples_before, body.numbers)

    assert len(runs) == 1
    assert len(stored_mesh(body).points(runs, 0)[0]) == topology.samples_before[-1]
