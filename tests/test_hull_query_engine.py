"""Meshes as engines take them, and which engine serves."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridve.calib.errors import DeviceError
from hybridve.hull.query import compute as compute_module
from hybridve.hull.query.choose import open_engine
from hybridve.hull.query.engine import MAX_COORDINATE_M, EngineName, Hits, Triangles

VERTICES = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
VIEWPORTS = np.array([10, 4], np.int32)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("vertices_world", VERTICES * [1, np.nan, 1], r"vertex 0 is not finite"),
        ("vertices_world", np.where(VERTICES == 1, -np.inf, VERTICES), r"vertex 1 is not finite"),
        (
            "vertices_world",
            np.where(VERTICES == 1, -2e18, VERTICES),
            r"vertex 1 is .* within 1e\+18",
        ),
        ("vertices_world", np.zeros((4, 2)), r"vertices_world has shape \(4, 2\), expected"),
        (
            "faces",
            FACES + np.array([[0], [1]]),
            r"triangle 1 has vertices \[1, 3, 4\], expected numbers below 4",
        ),
        ("faces", FACES - 1, r"triangle 0 has vertices \[-1, 0, 1\]"),
        ("faces", FACES.astype(np.int64) + 2**32, r"faces holds a number that does not fit int32"),
        ("faces", FACES[0], r"faces has shape \(3,\), expected \(N, 3\)"),
        ("viewports", VIEWPORTS[:1], r"1 viewports for 2 triangles"),
        ("viewports", VIEWPORTS - 4, r"triangle 1 has viewport 0, expected 1\.\.65535"),
        ("viewports", VIEWPORTS * 10_000, r"triangle 0 has viewport 100000"),
    ],
)
def test_a_mesh_that_cannot_be_sampled_is_refused_by_name(
    field: str, value: np.ndarray, message: str
) -> None:
    fields = {"vertices_world": VERTICES, "faces": FACES, "viewports": VIEWPORTS, field: value}

    with pytest.raises(ValueError, match=message):
        Triangles(**fields)


def test_a_mesh_is_taken_up_to_the_largest_coordinates() -> None:
    assert len(Triangles(VERTICES * MAX_COORDINATE_M, FACES, VIEWPORTS)) == 2


def test_an_empty_mesh_is_a_mesh() -> None:
    assert len(Triangles(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, np.int32))) == 0


def test_a_mesh_does_not_change_with_the_arrays_it_was_made_from() -> None:
    vertices, faces = VERTICES.copy(), FACES.astype(np.int64)
    mesh = Triangles(vertices, faces, VIEWPORTS)  # type: ignore[arg-type]  # any whole numbers

    vertices[:] = 7.0
    faces[:] = 0

    np.testing.assert_array_equal(mesh.vertices_world, VERTICES)
    np.testing.assert_array_equal(mesh.faces, FACES)
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices_world[0] = 1.0


def test_a_moved_mesh_shares_all_but_its_vertices() -> None:
    mesh = Triangles(VERTICES, FACES, VIEWPORTS)
    vertices = VERTICES + 1.0

    moved = mesh.moved(vertices)
    vertices[:] = 7.0

    assert moved.topology is mesh.topology
    assert moved.faces is mesh.faces
    assert moved.viewports is mesh.viewports
    np.testing.assert_array_equal(moved.corners_world, mesh.corners_world + 1.0)


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        (VERTICES[:3], r"shape \(3, 3\), expected \(4, 3\)"),
        (np.where(VERTICES == 1, np.inf, VERTICES), r"vertex 1 is not finite"),
    ],
)
def test_a_mesh_is_not_moved_to_nowhere(vertices: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Triangles(VERTICES, FACES, VIEWPORTS).moved(vertices)


@given(
    viewports=st.lists(st.integers(1, 12), min_size=1, max_size=30),
    share=st.floats(0, 1),
    seed=st.integers(0, 2**32 - 1),
)
def test_runs_hold_the_samples_they_were_made_of(
    viewports: list[int], share: float, seed: int
) -> None:
    n_triangles = len(viewports)
    faces = np.zeros((n_triangles, 3), np.int32)
    mesh = Triangles(np.zeros((1, 3)), faces, np.array(viewports, np.int32))
    every = [(t, s) for t, u in enumerate(viewports) for s in range(u * (u + 1) // 2)]
    some = np.random.default_rng(seed).random(len(every)) < share
    expected = [sample for sample, is_in in zip(every, some, strict=True) if is_in]
    triangle, sample = np.array(expected, np.uint32).reshape(-1, 2).T

    hits = Hits.from_samples(mesh.topology, triangle, sample)

    assert len(hits) == len(expected)
    numbers = [n for a, b in zip(hits.start, hits.stop, strict=True) for n in range(a, b)]
    assert numbers == np.flatnonzero(some).tolist()
    assert (hits.start[1:] > hits.stop[:-1]).all()  # as few runs as can be
    for most in (None, 0, 3):
        assert list(zip(*(a.tolist() for a in hits.samples(most)), strict=True)) == expected[:most]


@pytest.mark.parametrize(
    "name",
    [
        "reference",
        "native",
        pytest.param("compute", marks=pytest.mark.gl),
        pytest.param("stencil", marks=pytest.mark.gl),
    ],
)
def test_an_engine_is_opened_by_name(name: EngineName) -> None:
    with open_engine(name) as engine:
        assert engine.name == name
        assert engine.renderer


def test_an_unknown_engine_is_refused() -> None:
    with pytest.raises(ValueError, match="engine 'warp', expected auto, compute"):
        open_engine("warp")  # type: ignore[arg-type]  # not that one


class FakeCompute:
    name = "compute"
    renderer = "NVIDIA H100"

    def programs_for(self, n_cameras: int) -> None:
        pass

    def close(self) -> None:
        self.is_closed = True


def test_auto_takes_opengl_on_hardware(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compute_module, "Compute", FakeCompute)

    assert open_engine("auto").name == "compute"


def test_auto_takes_native_where_opengl_is_software(monkeypatch: pytest.MonkeyPatch) -> None:
    software = FakeCompute()
    software.renderer = "llvmpipe (LLVM 15.0.6, 256 bits)"
    monkeypatch.setattr(compute_module, "Compute", lambda: software)

    assert open_engine("auto").name == "native"
    assert software.is_closed


def test_auto_takes_native_without_opengl(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise DeviceError("no OpenGL")

    monkeypatch.setattr(compute_module, "Compute", missing)

    assert open_engine("auto").name == "native"
    with pytest.raises(DeviceError):
        open_engine("compute")


def test_auto_takes_native_where_the_driver_does_not_compile_the_shaders(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class OldDriver(FakeCompute):
        def programs_for(self, n_cameras: int) -> None:
            raise DeviceError("old driver does not compile")

    monkeypatch.setattr(compute_module, "Compute", OldDriver)

    assert open_engine("auto").name == "native"
    assert "old driver does not compile" in caplog.text
