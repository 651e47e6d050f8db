"""Meshes kept for the next start: the same to the bit, or as if there were no cache at all."""

import json
import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.sessions import CUBE, write_ball_session, write_cube_scene
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError
from hybridve.hull.contact import mesh as mesh_module
from hybridve.hull.contact.mesh import read_mesh
from hybridve.hull.contact.mesh_cache import find_mesh, mesh_key

VERTICES = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1 / 3]])
FACES = np.array([[0, 2, 1], [0, 1, 3]], np.int32)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of this test's own."""
    monkeypatch.setenv("HYBRIDVE_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "meshes"


@pytest.fixture
def cube(tmp_path: Path) -> Path:
    path = tmp_path / "cube.obj"
    path.write_text(CUBE, encoding="utf-8")
    return path


def without_open3d(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)  # importing it raises ImportError


def glb(vertices: NDArray[np.float64], faces: NDArray[np.int32], **more: object) -> bytes:
    """Return a binary glTF of one mesh, and what else it is to say."""
    numbers = vertices.astype("<f4").tobytes() + faces.astype("<u4").tobytes()
    split = 12 * len(vertices)
    views = [(0, split, 34962), (split, len(numbers) - split, 34963)]
    extent = {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()}
    described = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(vertices), "type": "VEC3"}
            | extent,
            {"bufferView": 1, "componentType": 5125, "count": faces.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": length, "target": target}
            for start, length, target in views
        ],
        "buffers": [{"byteLength": len(numbers)}],
    } | more
    text = json.dumps(described).encode()
    chunks = [(b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", numbers)]
    body = b"".join(struct.pack("<I", len(data)) + kind + data for kind, data in chunks)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def entries(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply", ".off", ".glb", ".STL"])
def test_a_mesh_is_read_once_and_then_comes_back_to_the_bit(
    folder: Path, cube: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    import open3d

    path = tmp_path / f"part{suffix}"
    if suffix == ".glb":  # Open3D writes none that it can read
        path.write_bytes(glb(VERTICES, FACES))
    else:
        written = open3d.io.read_triangle_mesh(cube).compute_triangle_normals()
        assert open3d.io.write_triangle_mesh(tmp_path / f"part{suffix.lower()}", written)
        (tmp_path / f"part{suffix.lower()}").rename(path)
    first = read_mesh(path)

    without_open3d(monkeypatch)
    again = read_mesh(path)

    assert len(entries(folder)) == 1
    assert len(again.faces) == (2 if suffix == ".glb" else 12)
    assert again.vertices.tobytes() == first.vertices.tobytes()
    assert again.faces.tobytes() == first.faces.tobytes()
    assert (again.vertices.dtype, again.faces.dtype) == (np.float64, np.int32)


def test_what_counts_is_the_content_and_neither_name_nor_time(
    folder: Path, cube: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_mesh(cube)
    before = cube.stat()
    moved = tmp_path / "moved.obj"
    moved.write_bytes(cube.read_bytes())
    cube.write_text(CUBE.replace("v 100 100 100", "v 100 100 107"), encoding="utf-8")
    os.utime(cube, ns=(before.st_atime_ns, before.st_mtime_ns))

    changed = read_mesh(cube)
    without_open3d(monkeypatch)
    same = read_mesh(moved)

    assert changed.vertices.max() == 107
    assert same.vertices.max() == 100


def test_another_reader_another_kind_or_another_content_is_another_entry() -> None:
    keys = [
        mesh_key(content, suffix, reader)
        for content in (b"", b"a")
        for suffix in (".stl", ".ply")
        for reader in ("open3d 0.19.0", "open3d 0.20.0")
    ]

    assert len(set(keys)) == 8


def test_another_open3d_reads_anew(
    folder: Path, cube: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_mesh(cube)
    monkeypatch.setattr(mesh_module, "version", lambda _: "999.0")

    read_mesh(cube)

    assert len(entries(folder)) == 2


@pytest.mark.parametrize(
    ("vertices", "faces"),
    [
        (VERTICES[:, :2], FACES),
        (VERTICES.astype(np.float32), FACES),
        (VERTICES, FACES.astype(np.int64)),
        (VERTICES, FACES[:, :2]),
        (VERTICES[0], FACES),
    ],
)
def test_an_archive_of_something_else_is_no_entry(
    folder: Path, vertices: NDArray[np.generic], faces: NDArray[np.generic]
) -> None:
    key = mesh_key(b"", ".stl", "test")
    folder.mkdir(parents=True)
    np.savez(folder / f"{key}.npz", vertices=vertices, faces=faces)

    assert find_mesh(key) is None


def test_a_damaged_entry_is_written_anew(
    folder: Path, cube: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = read_mesh(cube)
    (name,) = entries(folder)
    (folder / name).write_bytes(b"\0" * 100)

    read_mesh(cube)
    without_open3d(monkeypatch)
    again = read_mesh(cube)

    assert entries(folder) == [name]
    np.testing.assert_array_equal(again.vertices, first.vertices)


@pytest.mark.parametrize("place", ["file/cache", "file", ""])
def test_where_nothing_can_be_kept_meshes_are_read_all_the_same(
    tmp_path: Path, cube: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    (tmp_path / "file").write_text("not a folder", encoding="utf-8")
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.setenv("HYBRIDVE_CACHE", str(tmp_path / place) if place else "off")

    assert len(read_mesh(cube).faces) == 12
    assert len(read_mesh(cube).faces) == 12

    assert sorted(tmp_path.rglob("*")) == before


def test_a_mesh_that_may_lean_on_another_file_is_not_kept(folder: Path, tmp_path: Path) -> None:
    import open3d

    written = open3d.geometry.TriangleMesh.create_box()
    open3d.io.write_triangle_mesh(tmp_path / "part.gltf", written)
    (tmp_path / "part.glb").write_bytes(glb(VERTICES, FACES, images=[{"uri": "paint.png"}]))
    (tmp_path / "part.obj").write_text(f"mtllib part.mtl\n{CUBE}", encoding="utf-8")

    counts = [len(read_mesh(tmp_path / f"part.{kind}").faces) for kind in ("gltf", "glb", "obj")]

    assert counts == [12, 2, 12]
    assert entries(folder) == []


def test_materials_change_the_order_of_an_objs_triangles(folder: Path, tmp_path: Path) -> None:
    """Why an OBJ that names materials is read anew: its triangles' numbers stand in the report."""
    vertices, faces = (
        [line for line in CUBE.splitlines() if line.startswith(kind)] for kind in "vf"
    )
    coloured = [f"usemtl {('blue', 'red')[n % 2]}\n{face}" for n, face in enumerate(faces)]
    path = tmp_path / "part.obj"
    path.write_text("\n".join(["mtllib part.mtl", *vertices, *coloured]), encoding="utf-8")
    orders = []
    for materials in ("newmtl red\nnewmtl blue\nKd 0 0 1\n", "newmtl blue\nKd 1 0 0\nnewmtl red\n"):
        (tmp_path / "part.mtl").write_text(materials, encoding="utf-8")
        mesh = read_mesh(path)
        orders.append(mesh.vertices[mesh.faces].round(6).tolist())

    assert orders[0] != orders[1]
    assert sorted(map(sorted, orders[0])) == sorted(map(sorted, orders[1]))


def test_a_file_that_changes_while_it_is_read_is_not_kept(
    folder: Path, cube: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = mesh_module._read_with_open3d

    def write_then_read(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        path.write_text(CUBE.replace("v 100 100 100", "v 100 100 107"), encoding="utf-8")
        return read(path)

    monkeypatch.setattr(mesh_module, "_read_with_open3d", write_then_read)

    read_mesh(cube)

    assert entries(folder) == []


def test_a_mesh_that_is_refused_is_not_kept(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "empty.obj"
    path.write_text("v 0 0 0\n", encoding="utf-8")

    for _ in range(2):
        with pytest.raises(SceneError, match="the mesh is empty"):
            read_mesh(path)

    assert entries(folder) == []


def test_a_second_detect_does_without_open3d(folder: Path, tmp_path: Path) -> None:
    session = write_ball_session(tmp_path, np.zeros((1, 3)))
    scene = write_cube_scene(tmp_path, {"part": (0.0, 0.0, 150.0)})
    code = (
        "import sys\nfrom hybridve.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as left:\n    assert left.code == 0\n"
        "print('open3d' in sys.modules)"
    )

    arguments = ["detect", session, "--scene", scene, "-o", tmp_path / "report.h5", "--overwrite"]

    shown = [
        subprocess.run(
            [sys.executable, "-c", code, *arguments],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.splitlines()
        for _ in range(2)
    ]

    assert [lines[-1] for lines in shown] == ["True", "False"]
    assert shown[0][2:-2] == shown[1][2:-2]
    assert "colliding" in shown[0][2]
