"""Meshes kept for the next start: the same to the bit, or as if there were no cache at all."""

import dataclasses
import json
import os
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.mesh_files import text_fbx
from helpers.sessions import CUBE, write_ball_session, write_cube_scene
from helpers.step_files import step_box, step_cylinder, step_file
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError
from hybridve.hull.cad import mesh as mesh_module
from hybridve.hull.cad import readers
from hybridve.hull.cad import readers as readers_module
from hybridve.hull.cad.mesh import CadFile, read_cad
from hybridve.hull.cad.mesh_cache import find_meshes, keep_meshes, mesh_key
from hybridve.hull.cad.part import Contents

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


def without_readers(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a file was read that is kept")

    monkeypatch.setattr(mesh_module, "parse", refuse)


def stl(path: Path) -> Path:
    """Write the cube as binary STL."""
    mesh = read_cad(path.parent / "cube.obj").parts[0]
    record = np.zeros(len(mesh.faces), [("normal", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    record["v"] = mesh.vertices[mesh.faces]
    head = b"\0" * 80 + np.uint32(len(record)).tobytes()
    path.write_bytes(head + record.tobytes())
    return path


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


def written(suffix: str, cube: Path) -> Path:
    """Write the cube as another kind of file, by another hand than ours."""
    path = cube.with_name(f"part{suffix}")
    if suffix.lower() in (".step", ".stp"):
        path.write_text(step_file(step_box, "mm", (200.0, 200.0, 200.0)), encoding="utf-8")
    elif suffix == ".glb":
        path.write_bytes(glb(VERTICES, FACES))
    elif suffix == ".fbx":
        path.write_bytes(text_fbx(VERTICES, FACES.tolist()))
    else:
        import trimesh

        mesh = trimesh.load_mesh(cube, process=False)
        content = mesh.export(file_type=suffix.lower()[1:])
        files = content if isinstance(content, dict) else {path.name: content}
        for name, data in files.items():  # a glTF is several
            target = path if name == "model.gltf" else path.with_name(name)
            target.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


def assert_same(first: CadFile, again: CadFile) -> None:
    for field in dataclasses.fields(CadFile):
        if field.name != "parts":
            assert getattr(first, field.name) == getattr(again, field.name)
    for part, other in zip(first.parts, again.parts, strict=True):
        assert part.vertices.tobytes() == other.vertices.tobytes()
        assert part.faces.tobytes() == other.faces.tobytes()
        assert other.vertices.dtype == np.float64
        assert other.faces.dtype == np.int32
        assert (part.name, part.material, part.rgba) == (other.name, other.material, other.rgba)
        assert (part.cuts, part.off_by_m) == (other.cuts, other.off_by_m)


@pytest.mark.parametrize(
    "suffix", [".obj", ".stl", ".ply", ".off", ".glb", ".gltf", ".dae", ".step", ".STL", ".fbx"]
)
def test_a_file_is_read_once_and_then_comes_back_to_the_bit(
    folder: Path, cube: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    path = written(suffix, cube)
    first = read_cad(path)

    without_readers(monkeypatch)
    again = read_cad(path)

    assert len(entries(folder)) == 1
    assert len(again.parts[0].faces) == (2 if suffix in (".glb", ".fbx") else 12)
    assert_same(first, again)


def test_an_assembly_comes_back_to_the_bit(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "paint.mtl").write_text("newmtl red\nKd 0.1 0.2 0.3\n", encoding="utf-8")
    path = tmp_path / "two.obj"
    vertices, faces = (
        "\n".join(line for line in CUBE.splitlines() if line.startswith(kind)) for kind in "vf"
    )
    path.write_text(
        f"mtllib paint.mtl\n{vertices}\no one\nusemtl red\n{faces}\no two\nf 1 2 3\nf 1 2 4\n",
        encoding="utf-8",
    )
    first = read_cad(path)

    without_readers(monkeypatch)
    again = read_cad(path)

    assert [part.name for part in again.parts] == ["one", "two"]
    assert again.parts[0].rgba == (0.1, 0.2, 0.3, 1.0)
    assert [topology.closed for topology in again.topologies] == [True, False]
    assert_same(first, again)


def test_what_counts_is_the_content_and_neither_name_nor_time(
    folder: Path, cube: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_cad(cube)
    before = cube.stat()
    moved = tmp_path / "moved.obj"
    moved.write_bytes(cube.read_bytes())
    cube.write_text(CUBE.replace("v 100 100 100", "v 100 100 107"), encoding="utf-8")
    os.utime(cube, ns=(before.st_atime_ns, before.st_mtime_ns))

    changed = read_cad(cube)
    without_readers(monkeypatch)
    same = read_cad(moved)

    assert changed.parts[0].vertices.max() == 107
    assert same.parts[0].vertices.max() == 100


def test_whatever_a_mesh_depends_on_makes_another_entry() -> None:
    keys = [
        mesh_key(content, kind, reader, how, *beside)
        for content in (b"", b"a")
        for kind in ("STL", "PLY")
        for reader in ("trimesh 5.1.0", "trimesh 5.2.0")
        for how in ("split", "merge")
        for beside in ((), (b"",), (b"b",), (b"", b"b"))
    ]

    assert len(set(keys)) == 64


def test_another_version_of_the_reader_reads_anew(
    folder: Path, cube: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(".step", cube)
    before = entries(folder)
    read_cad(path)
    monkeypatch.setattr(readers_module, "version", lambda _: "999.0")

    read_cad(path)

    assert len(entries(folder)) == len(before) + 2


@pytest.mark.slow
def test_other_tolerances_and_other_splits_are_other_entries(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "rod.step"
    path.write_text(step_file(step_cylinder, "mm", 50.0, 20.0), encoding="utf-8")

    counts = [
        len(read_cad(path, tessellation_m=tolerance_m, merge=merge).parts[0].faces)
        for tolerance_m, merge in ((1e-3, False), (1e-4, False), (1e-4, True), (1e-3, False))
    ]

    assert counts[0] == counts[3] < counts[1] == counts[2]
    assert len(entries(folder)) == 3


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("vertices", VERTICES[:, :2]),
        ("vertices", VERTICES.astype(np.float32)),
        ("vertices", VERTICES[0]),
        ("vertices", VERTICES[1:]),
        ("faces", FACES.astype(np.int64)),
        ("faces", FACES[:, :2]),
        ("faces", FACES[1:]),
        ("counts", np.array([4, 2])),
        ("about", np.frombuffer(b"{", np.uint8)),
    ],
)
def test_an_archive_of_something_else_is_no_entry(
    folder: Path, name: str, value: NDArray[np.generic]
) -> None:
    key = mesh_key(b"", "STL", "test")
    keep_meshes(key, [(VERTICES, FACES)], {"said": 1})
    assert find_meshes(key) is not None
    with np.load(folder / f"{key}.npz") as archive:
        arrays = dict(archive)

    np.savez(folder / f"{key}.npz", **(arrays | {name: value}))

    assert find_meshes(key) is None


@pytest.mark.parametrize("about", [None, {}, {"parts": []}, {"parts": [{}]}, []])
def test_a_damaged_entry_is_written_anew(
    folder: Path, cube: Path, monkeypatch: pytest.MonkeyPatch, about: Any
) -> None:
    first = read_cad(cube)
    (name,) = entries(folder)
    if about is None:
        (folder / name).write_bytes(b"\0" * 100)
    else:
        keep_meshes(name.removesuffix(".npz"), [(VERTICES, FACES)], about)

    read_cad(cube)
    without_readers(monkeypatch)
    again = read_cad(cube)

    assert entries(folder) == [name]
    assert_same(first, again)


@pytest.mark.parametrize("place", ["file/cache", "file", ""])
def test_where_nothing_can_be_kept_meshes_are_read_all_the_same(
    tmp_path: Path, cube: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    (tmp_path / "file").write_text("not a folder", encoding="utf-8")
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.setenv("HYBRIDVE_CACHE", str(tmp_path / place) if place else "off")

    assert len(read_cad(cube).parts[0].faces) == 12
    assert len(read_cad(cube).parts[0].faces) == 12

    assert sorted(tmp_path.rglob("*")) == before


def test_the_files_that_a_mesh_leans_on_count_as_its_own(folder: Path, tmp_path: Path) -> None:
    """The colours of an OBJ and the numbers of a glTF lie beside it."""
    path = tmp_path / "part.obj"
    path.write_text(f"mtllib part.mtl\nusemtl red\n{CUBE}", encoding="utf-8")
    colours = []
    for text in (None, "newmtl red\nKd 1 0 0\n", "newmtl red\nKd 0 1 0\nd 0.5\n"):
        if text is not None:
            (tmp_path / "part.mtl").write_text(text, encoding="utf-8")
        colours.append(read_cad(path).parts[0].rgba)
    assert colours == [None, (1.0, 0.0, 0.0, 1.0), (0.0, 1.0, 0.0, 0.5)]

    whole = glb(VERTICES, FACES)
    (json_length,) = struct.unpack_from("<I", whole, 12)
    document = json.loads(whole[20 : 20 + json_length])
    document["buffers"][0]["uri"] = "some%20numbers.bin"
    numbers = whole[28 + json_length :]
    path = tmp_path / "part.gltf"
    path.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(SceneError, match=r"keeps its numbers in some numbers\.bin"):
        read_cad(path)
    largest = []
    for content in (numbers, numbers.replace(np.float32(1).tobytes(), np.float32(7).tobytes())):
        (tmp_path / "some numbers.bin").write_bytes(content)
        cad = read_cad(path)
        largest.append(cad.parts[0].vertices.max())
        assert cad.beside == (tmp_path / "some numbers.bin",)
    assert largest == [1, 7]
    assert len(entries(folder)) == 5


def test_materials_leave_the_triangles_in_their_order(folder: Path, tmp_path: Path) -> None:
    """Their numbers stand in the report."""
    vertices, faces = (
        [line for line in CUBE.splitlines() if line.startswith(kind)] for kind in "vf"
    )
    coloured = [f"usemtl {('blue', 'red')[n % 2]}\n{face}" for n, face in enumerate(faces)]
    path = tmp_path / "part.obj"
    path.write_text("\n".join(["mtllib part.mtl", *vertices, *coloured]), encoding="utf-8")
    (tmp_path / "part.mtl").write_text("newmtl red\nnewmtl blue\nKd 0 0 1\n", encoding="utf-8")

    part = read_cad(path).parts[0]

    expected = [[int(word) - 1 for word in face.split()[1:]] for face in faces]
    assert part.faces.tolist() == expected
    assert (part.material, part.rgba) == ("", None)  # there are two


def test_what_is_kept_is_what_was_read_though_the_file_changes_meanwhile(
    folder: Path, cube: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parse = readers.parse

    def write_then_parse(*arguments: Any) -> Contents:
        cube.write_text(CUBE.replace("v 100 100 100", "v 100 100 107"), encoding="utf-8")
        return parse(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(mesh_module, "parse", write_then_parse)
        assert read_cad(cube).parts[0].vertices.max() == 100

    assert read_cad(cube).parts[0].vertices.max() == 107
    cube.write_text(CUBE, encoding="utf-8")
    assert read_cad(cube).parts[0].vertices.max() == 100


def test_a_mesh_that_is_refused_is_not_kept(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "empty.obj"
    path.write_text("v 0 0 0\n", encoding="utf-8")

    for _ in range(2):
        with pytest.raises(SceneError, match="the mesh is empty"):
            read_cad(path)

    assert entries(folder) == []


@pytest.mark.slow
def test_a_second_detect_does_without_the_readers(folder: Path, tmp_path: Path) -> None:
    session = write_ball_session(tmp_path, np.zeros((1, 3)))
    scene = write_cube_scene(tmp_path, {"part": (0.0, 0.0, 150.0)})
    stl(tmp_path / "cube.stl")
    scene.write_text(scene.read_text("utf-8").replace("cube.obj", "cube.stl"), encoding="utf-8")
    code = (
        "from hybridve.cli.main import main\n{}"
        "try:\n    main()\nexcept SystemExit as left:\n    assert left.code == 0\n"
    )
    without = "from hybridve.hull.cad import mesh\nmesh.parse = None\n"

    report = tmp_path / "report.h5"
    arguments: list[str | Path] = ["detect", session, "--scene", scene, "-o", report, "--overwrite"]

    shown = [
        subprocess.run(
            [sys.executable, "-c", code.format(prelude), *arguments],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.splitlines()
        for prelude in ("", without)
    ]

    assert shown[0][2:-1] == shown[1][2:-1]
    assert "1 of 1 object is touched" in shown[0][0]
