"""CAD files by kind: triangles in the file's order, parts, names, units, axes, and refusals."""

import base64
import json
import struct
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.step_files import step_assembly, step_box, step_cylinder, step_file
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError
from hybridve.hull.cad import readers as readers_module
from hybridve.hull.cad import step as step_module
from hybridve.hull.cad.gltf import parse_gltf
from hybridve.hull.cad.mesh import check_mesh, read_cad
from hybridve.hull.cad.scene import Scene, load_scene

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
TWO_TRIANGLES = [[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]]


PLY = (
    "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 3\nproperty float x\n"
    "property float y\nproperty float z\nelement face 2\n"
    "property list uchar int vertex_indices\nend_header\n"
    "0 0 0\n1 0 0.25\n0 1 0\n3 0 1 2\n3 0 2 1\n"
)


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def corners(path: Path, part: int = 0) -> NDArray[np.float64]:
    """Return the corners (T, 3, 3) of a part's triangles."""
    found = read_cad(path).parts[part]
    return found.vertices[found.faces]


def scene_of(folder: Path, keys: str) -> Scene:
    head = 'format = "hybridve-scene"\nversion = 1\n[[object]]\nname = "thing"\n'
    return load_scene(write(folder / "scene.toml", head + keys))


# --- text formats -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n",
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n",
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf -4 -3 -2 -1\n",
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nf -3 -2 -1\nv 0 1 0\nf -4 -2 -1\n",  # counted where they stand
        "v 0 0 0 0.5 0.5 0.5\nv 1 0 0 1 1 1\nv 1 1 0 0 0 0\nv 0 1 0 0 0 0\nf 1// 2// 3//\n"
        "f 1 3 4\n",
        "# a comment\r\nv 0 0 0\r\nv 1 0 0 # there\r\nv 1 1 0\r\nv 0 1 0\r\nf 1/1/1 2/2/2 \\\r\n"
        " 3/3/3 4/4/4 # a square\r\n",
        "mtllib none.mtl\nv\t0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\ng a\nf 1 2 3\ng b\no one\nf 1 3 4\n",
    ],
)
def test_an_obj_gives_its_triangles_in_the_files_order(tmp_path: Path, text: str) -> None:
    cad = read_cad(write(tmp_path / "part.obj", text))

    assert len(cad.parts) == 1
    assert corners(cad.path).tolist() == TWO_TRIANGLES


def test_polygons_are_cut_where_they_stand_in_the_file(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nf 1 2 3 4\nf 1 2 5\nf 1 2 3 4 5\n"

    faces = read_cad(write(tmp_path / "part.obj", text)).parts[0].faces

    assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 4], [0, 1, 2], [0, 2, 3], [0, 3, 4]]


@pytest.mark.parametrize("number", ["1000.123456789012", "-0.1", "1e-17", "9.87654321e17"])
def test_text_keeps_double_precision(tmp_path: Path, number: str) -> None:
    obj = write(tmp_path / "a.obj", f"v {number} 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    off = write(tmp_path / "a.off", f"OFF\n3 1 0\n{number} 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")

    assert corners(obj)[0, 0, 0] == corners(off)[0, 0, 0] == float(number)


def test_objects_of_an_obj_are_parts_and_groups_are_not(tmp_path: Path) -> None:
    vertices = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
    text = f"{vertices}f 1 2 3\no left plate\ng x\nf 1 2 3\ng y\nf 1 3 4\no empty\no b\nf 2 3 4\n"

    parts = read_cad(write(tmp_path / "part.obj", text)).parts

    assert [part.name for part in parts] == ["", "left plate", "b"]
    assert [len(part.faces) for part in parts] == [1, 2, 1]
    assert corners(tmp_path / "part.obj", 2).tolist() == [SQUARE[[1, 2, 3]].tolist()]
    assert [len(part.vertices) for part in parts] == [3, 4, 3]


def binary_stl(triangles: NDArray[np.float64]) -> bytes:
    records = np.zeros(len(triangles), [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    records["v"] = triangles
    return b"\0" * 80 + np.uint32(len(triangles)).tobytes() + records.tobytes()


def ascii_stl(triangles: NDArray[np.float64], *names: str) -> str:
    solids = []
    for name, share in zip(names, np.array_split(triangles, len(names)), strict=True):
        facets = "".join(
            "facet normal 0 0 0\nouter loop\n"
            + "".join(f"vertex {x!r} {y!r} {z!r}\n" for x, y, z in triangle)
            + "endloop\nendfacet\n"
            for triangle in share.tolist()
        )
        solids.append(f"solid {name}\n{facets}endsolid {name}\n")
    return "".join(solids)


def test_an_stl_is_one_part_in_the_files_order(tmp_path: Path) -> None:
    triangles = np.random.default_rng(1).normal(size=(40, 3, 3))
    binary = write(tmp_path / "a.stl", binary_stl(triangles))
    text = write(tmp_path / "b.stl", ascii_stl(triangles, "zebra", "ape", "zebra"))

    assert len(read_cad(text).parts) == 1
    np.testing.assert_array_equal(corners(binary), triangles.astype(np.float32))
    np.testing.assert_array_equal(corners(text), triangles)


def test_ply_and_off_give_their_triangles_in_the_files_order(tmp_path: Path) -> None:
    expected = [[[0, 0, 0], [1, 0, 0.25], [0, 1, 0]], [[0, 0, 0], [0, 1, 0], [1, 0, 0.25]]]
    off = "0 0 0\n1 0 0.25\n0 1 0\n3 0 1 2\n3 0 2 1\n"

    for name, text in (("a.ply", PLY), ("a.off", f"OFF\n# hi\n3 2 0\n{off}")):
        assert corners(write(tmp_path / name, text)).tolist() == expected


# --- glTF -------------------------------------------------------------------------------------


class Gltf:
    """A document built by hand."""

    def __init__(self) -> None:
        self.numbers = b""
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [],
            "accessors": [],
            "bufferViews": [],
        }

    def view(self, data: bytes, **more: Any) -> int:
        self.numbers += b"\0" * (-len(self.numbers) % 4)
        view = {"buffer": 0, "byteOffset": len(self.numbers), "byteLength": len(data)} | more
        self.document["bufferViews"].append(view)
        self.numbers += data
        return len(self.document["bufferViews"]) - 1

    def accessor(self, values: NDArray[Any], **more: Any) -> int:
        values = np.asarray(values)
        kinds = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
        accessor = {
            "componentType": kinds[values.dtype.str[1:]],
            "count": len(values),
            "type": "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}",
        }
        if "bufferView" not in more and "sparse" not in more:
            accessor["bufferView"] = self.view(values.tobytes())
        self.document["accessors"].append(accessor | more)
        return len(self.document["accessors"]) - 1

    def mesh(self, positions: int, indices: int | None = None, **more: Any) -> None:
        primitive = {"attributes": {"POSITION": positions}} | more
        if indices is not None:
            primitive["indices"] = indices
        self.document["meshes"].append({"primitives": [primitive]})

    def glb(self) -> bytes:
        self.document["buffers"] = [{"byteLength": len(self.numbers)}]
        text = json.dumps(self.document).encode()
        numbers = self.numbers + b"\0" * (-len(self.numbers) % 4)
        chunks = [(b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", numbers)]
        body = b"".join(struct.pack("<I", len(data)) + kind + data for kind, data in chunks)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body

    def gltf(self) -> str:
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.numbers).decode()
        self.document["buffers"] = [{"byteLength": len(self.numbers), "uri": uri}]
        return json.dumps(self.document)


def square_gltf() -> Gltf:
    gltf = Gltf()
    gltf.mesh(
        gltf.accessor(SQUARE.astype("<f4")), gltf.accessor(np.array([0, 1, 2, 0, 2, 3], "<u2"))
    )
    return gltf


def plain(gltf: Gltf) -> None:
    indices = np.array([0, 1, 2, 0, 2, 3], "<u1")
    gltf.mesh(gltf.accessor(SQUARE.astype("<f4")), gltf.accessor(indices))


def without_indices(gltf: Gltf) -> None:
    gltf.mesh(gltf.accessor(np.array(TWO_TRIANGLES, "<f4").reshape(-1, 3)))


def fan(gltf: Gltf) -> None:
    gltf.mesh(gltf.accessor(SQUARE.astype("<f4")), mode=6)


def interleaved(gltf: Gltf) -> None:
    rows = np.hstack([np.full((4, 3), 9.0), SQUARE]).astype("<f4")
    view = gltf.view(rows.tobytes(), byteStride=24)
    positions = gltf.accessor(SQUARE.astype("<f4"), bufferView=view, byteOffset=12)
    gltf.mesh(positions, gltf.accessor(np.array([0, 1, 2, 0, 2, 3], "<u4")))


def sparse(gltf: Gltf) -> None:
    """All but the corners that are not at the origin stay zero."""
    places, values = np.array([1, 2, 3], "<u1"), SQUARE[1:].astype("<f4")
    about = {
        "count": 3,
        "indices": {"bufferView": gltf.view(places.tobytes()), "componentType": 5121},
        "values": {"bufferView": gltf.view(values.tobytes())},
    }
    positions = gltf.accessor(SQUARE.astype("<f4"), sparse=about)
    gltf.mesh(positions, gltf.accessor(np.array([0, 1, 2, 0, 2, 3], "<u2")))


def quantised(gltf: Gltf) -> None:
    gltf.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    positions = gltf.accessor((SQUARE * 127).astype("<i1"), normalized=True)
    gltf.mesh(positions, gltf.accessor(np.array([0, 1, 2, 0, 2, 3], "<u2")))


@pytest.mark.parametrize(
    "build", [plain, without_indices, fan, interleaved, sparse, quantised], ids=lambda f: f.__name__
)
@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_every_way_to_store_a_square_in_gltf_is_read(
    tmp_path: Path, build: Callable[[Gltf], None], suffix: str
) -> None:
    gltf = Gltf()
    build(gltf)
    path = write(tmp_path / f"part{suffix}", gltf.glb() if suffix == ".glb" else gltf.gltf())

    found = corners(path)

    expected = np.array(TWO_TRIANGLES)
    turned = [np.roll(expected, shift, axis=1) for shift in range(3)]  # a fan ends at its hub
    assert any(np.array_equal(found, same) for same in turned)
    cad = read_cad(path)
    assert (cad.unit, cad.unit_m, cad.up) == ("m", 1.0, "y")


def test_a_strip_keeps_one_side_out(tmp_path: Path) -> None:
    gltf = Gltf()
    zigzag = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0]], "<f4")
    gltf.mesh(gltf.accessor(zigzag), mode=5)

    a, b, c = np.moveaxis(corners(write(tmp_path / "part.glb", gltf.glb())), 1, 0)

    assert (np.cross(b - a, c - a)[:, 2] == 1).all()
    assert len(a) == 3


def test_peers_agree_on_an_assembly_in_glb(tmp_path: Path) -> None:
    """trimesh writes nested, turned, scaled and mirrored instances, and reads them its way."""
    import trimesh

    rng = np.random.default_rng(3)
    scene = trimesh.Scene()
    bolt, plate = trimesh.creation.cylinder(0.1, 1.0), trimesh.creation.box((1, 2, 3))
    turn = trimesh.transformations.random_rotation_matrix
    for name, parent, matrix, thing in (
        ("plate", None, turn(rng.random(3)), plate),
        ("left bolt", "plate", turn(rng.random(3)) @ np.diag([2.0, 3, 1, 1]), bolt),
        ("inner", "left bolt", np.diag([-1.0, 1, 1, 1]), bolt),
    ):
        matrix[:3, 3] = rng.normal(size=3)
        scene.add_geometry(thing, name, name, parent_node_name=parent, transform=matrix)
    path = write(tmp_path / "assembly.glb", scene.export(file_type="glb"))

    ours = read_cad(path)
    theirs = trimesh.load_scene(path, process=False)

    assert sorted(part.name for part in ours.parts) == ["inner", "left bolt", "plate"]
    for part, topology in zip(ours.parts, ours.topologies, strict=True):
        matrix, geometry = theirs.graph[part.name]
        peer = theirs.geometry[geometry].copy().apply_transform(matrix)
        place = peer.triangles.mean(axis=1)
        np.testing.assert_allclose(
            part.vertices[part.faces].mean(axis=1), place, atol=1e-6, strict=True
        )
        assert topology.volume == pytest.approx(abs(peer.volume), rel=1e-5)


def test_nodes_place_meshes_and_mirrors_keep_the_outside_outside(tmp_path: Path) -> None:
    gltf = square_gltf()
    half_turn_about_z = [0.0, 0, 1, 0]
    gltf.document["nodes"] = [
        {"name": "root", "children": [2, 1], "translation": [10, 0, 0]},
        {"name": "b", "mesh": 0, "scale": [2, 3, -1], "rotation": half_turn_about_z},
        {"name": "a", "mesh": 0, "matrix": [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1]},
        {"name": "not in the scene", "mesh": 0},
    ]
    path = write(tmp_path / "part.glb", gltf.glb())

    a, b = read_cad(path).parts

    assert (a.name, b.name) == ("a", "b")  # as the root lists them
    quarter = SQUARE @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + np.array([10.0, 0, 5])
    np.testing.assert_allclose(a.vertices, quarter, atol=1e-12)
    np.testing.assert_allclose(b.vertices, SQUARE * [-2, -3, -1] + [10, 0, 0], atol=1e-12)
    assert a.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert b.faces.tolist() == [[0, 2, 1], [0, 3, 2]]


@given(
    axis=st.tuples(*[st.integers(-5, 5)] * 3).filter(any),
    angle=st.floats(-7, 7),
)
def test_quaternions_turn_about_their_axis(
    tmp_path_factory: pytest.TempPathFactory, axis: tuple[int, int, int], angle: float
) -> None:
    unit = np.array(axis) / np.linalg.norm(axis)
    gltf = square_gltf()
    quaternion = [*(unit * np.sin(angle / 2)), np.cos(angle / 2)]
    gltf.document["nodes"] = [{"mesh": 0, "rotation": quaternion, "scale": [1, 2, 1]}]
    path = write(tmp_path_factory.mktemp("turn") / "part.glb", gltf.glb())

    found = read_cad(path).parts[0].vertices

    points = SQUARE * [1, 2, 1]  # Rodrigues' formula
    along = np.outer(points @ unit, unit)
    across = np.cross(unit, points) * np.sin(angle) + (points - along) * np.cos(angle)
    np.testing.assert_allclose(found, along + across, atol=1e-12)


def test_primitives_of_a_mesh_are_one_part_and_lines_are_none(tmp_path: Path) -> None:
    gltf = square_gltf()
    (primitive,) = gltf.document["meshes"][0]["primitives"]
    gltf.document["meshes"][0] = {
        "name": "plate",
        "primitives": [primitive | {"material": 0}, primitive | {"mode": 1}, primitive],
    }
    gltf.document["materials"] = [{"name": "steel"}]

    (part,) = read_cad(write(tmp_path / "part.glb", gltf.glb())).parts

    assert part.name == "plate"
    assert part.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    assert (part.material, part.rgba) == ("", None)


def test_colours_of_gltf_are_linear_in_the_file_and_as_shown_here(tmp_path: Path) -> None:
    gltf = square_gltf()
    gltf.document["meshes"][0]["primitives"][0]["material"] = 1
    factor = [0.0, 0.21404114, 1.0, 0.5]  # half of what a screen can show takes a fifth of light
    gltf.document["materials"] = [
        {},
        {"name": "glass", "pbrMetallicRoughness": {"baseColorFactor": factor}},
    ]
    write(tmp_path / "part.glb", gltf.glb())

    (thing,) = scene_of(tmp_path, 'mesh = "part.glb"\n').objects

    assert thing.color == pytest.approx((0.0, 0.5, 1.0, 0.5), abs=1e-6)
    assert thing.about["material"] == {"name": "glass", "rgba": list(thing.color or ())}


def drop(key: str) -> Callable[[Gltf], None]:
    return lambda gltf: gltf.document.pop(key)


def put(**more: Any) -> Callable[[Gltf], None]:
    return lambda gltf: gltf.document.update(more)


@pytest.mark.parametrize(
    ("damage", "line"),
    [
        (
            put(extensionsRequired=["KHR_draco_mesh_compression"]),
            "needs KHR_draco_mesh_compression",
        ),
        (put(extensionsUsed=["EXT_mesh_gpu_instancing"]), "needs EXT_mesh_gpu_instancing"),
        (put(nodes=[{"mesh": 0, "skin": 0}]), "skinned"),
        (put(nodes=[{"children": [0]}]), "circle"),
        (put(nodes=[{"mesh": 7}]), "sound"),
        (put(scene=3), "sound"),
        (put(asset={"version": "1.0"}), "version 2"),
        (put(asset=[]), "not glTF of version 2"),
        (drop("accessors"), "no 'accessors' where one belongs"),
        (put(bufferViews=[{"buffer": 0, "byteLength": 9}] * 2), "reaches beyond its buffer"),
        (lambda gltf: gltf.document["accessors"][0].pop("bufferView"), "has no numbers"),
        (lambda gltf: gltf.document["accessors"][1].update(count=5), "do not make triangles"),
        (lambda gltf: gltf.document["accessors"][0].update(count=3), "names vertex 3 of 3"),
        (lambda gltf: gltf.document["accessors"][0].update(count=-1), "reaches beyond"),
        (lambda gltf: gltf.document["meshes"][0].update(primitives=[]), "mesh is empty"),
        (lambda gltf: gltf.document["meshes"][0]["primitives"][0].update(mode=7), "of mode 7"),
        (
            lambda gltf: gltf.document["meshes"][0].update(weights=[1.0, 2.0]),
            "2 weights for 0 morph targets",
        ),
        (
            # What waits for a decoder: a buffer without numbers, although the file has some.
            lambda gltf: [view.update(buffer=1) for view in gltf.document["bufferViews"]],
            "sound glTF 2.0 file: no entry of the number",
        ),
    ],
)
def test_a_gltf_that_cannot_be_read_is_refused(
    tmp_path: Path, damage: Callable[[Gltf], Any], line: str
) -> None:
    gltf = square_gltf()
    damage(gltf)
    if "reaches beyond its buffer" in line:
        gltf.numbers = gltf.numbers[:4]
    path = write(tmp_path / "part.glb", gltf.glb())

    with pytest.raises(SceneError, match=line) as caught:
        read_cad(path)

    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("where", ["mesh", "node"])
def test_morph_targets_count_with_their_weights(tmp_path: Path, where: str) -> None:
    gltf = Gltf()
    corners_ = gltf.accessor(SQUARE.astype("<f4"))
    up, right = (np.tile(step, (4, 1)).astype("<f4") for step in ([0.0, 0, 1], [1.0, 0, 0]))
    targets = [{"POSITION": gltf.accessor(up)}, {"NORMAL": 0}, {"POSITION": gltf.accessor(right)}]
    gltf.mesh(corners_, gltf.accessor(np.array([0, 1, 2, 0, 2, 3], "<u2")), targets=targets)
    gltf.document["meshes"][0]["weights"] = [9.0, 9.0, 9.0] if where == "node" else [2.0, 1.0, 0.5]
    if where == "node":
        gltf.document["nodes"][0]["weights"] = [2.0, 1.0, 0.5]

    found = corners(write(tmp_path / "part.glb", gltf.glb()))

    np.testing.assert_array_equal(found, np.array(TWO_TRIANGLES) + np.array([0.5, 0, 2]))


def test_a_buffer_that_waits_for_a_decoder_is_refused(tmp_path: Path) -> None:
    gltf = square_gltf()
    content = gltf.glb()
    gltf.document["buffers"].append({"byteLength": len(gltf.numbers)})
    for view in gltf.document["bufferViews"]:
        view["buffer"] = 1
    text = json.dumps(gltf.document).encode()
    text += b" " * (-len(text) % 4)
    numbers = content[20 + struct.unpack_from("<I", content, 12)[0] :]
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(numbers), len(text), b"JSON")

    with pytest.raises(SceneError, match="buffer 1 has no numbers: they are compressed"):
        read_cad(write(tmp_path / "part.glb", head + text + numbers))


def test_meshes_outside_the_scene_are_said(tmp_path: Path) -> None:
    gltf = square_gltf()
    gltf.document["nodes"].append({"mesh": 0, "name": "hidden"})

    cad = read_cad(write(tmp_path / "part.glb", gltf.glb()))

    assert cad.notes == ("1 nodes with meshes are not in its scene, first 'hidden'",)
    assert len(cad.parts) == 1


def test_a_glb_cut_off_anywhere_is_refused_and_so_is_more() -> None:
    content = square_gltf().glb()

    for end in range(len(content)):
        with pytest.raises(ValueError, match=r"cut off|JSON"):
            parse_gltf(content[:end], {})
    with pytest.raises(ValueError, match="bytes, where its header promises"):
        parse_gltf(content + b"more", {})


# --- COLLADA ----------------------------------------------------------------------------------

DAE = """<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset>ASSET</asset>
  <library_effects><effect id="paint-fx"><profile_COMMON><technique sid="common"><lambert>
    <diffuse><color>0.8 0.4 0.2 1</color></diffuse>
  </lambert></technique></profile_COMMON></effect></library_effects>
  <library_materials><material id="paint" name="orange paint">
    <instance_effect url="#paint-fx"/></material></library_materials>
  <library_geometries><geometry id="square" name="square mesh"><mesh>
    <source id="p"><float_array id="pa" count="12">0 0 0 1 0 0 1 1 0 0 1 0</float_array>
      <technique_common><accessor source="#pa" count="4" stride="3">
        <param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
      </accessor></technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    PRIMITIVE
  </mesh></geometry></library_geometries>
  <library_nodes><node id="lib" name="bolt"><scale>2 2 2</scale>
    <instance_geometry url="#square"><bind_material><technique_common>
      <instance_material symbol="m" target="#paint"/></technique_common></bind_material>
    </instance_geometry></node></library_nodes>
  <library_visual_scenes><visual_scene id="s">NODES</visual_scene></library_visual_scenes>
  <scene><instance_visual_scene url="#s"/></scene>
</COLLADA>
"""
TRIANGLES = (
    '<triangles count="2" material="m"><input semantic="VERTEX" source="#v" offset="0"/>'
    "<p>0 1 2 0 2 3</p></triangles>"
)
POLYLIST = (
    '<polylist count="1" material="m"><input semantic="VERTEX" source="#v" offset="0"/>'
    "<vcount>4</vcount><p>0 1 2 3</p></polylist>"
)
ONE_NODE = '<node id="n" name="plate"><instance_geometry url="#square"/></node>'
ASSEMBLY = """<node id="root"><translate>10 0 0</translate>
  <node id="x1"><rotate>0 0 1 90</rotate><instance_node url="#lib"/></node>
  <node id="x2" name="plate"><matrix>1 0 0 0 0 1 0 0 0 0 -1 7 0 0 0 1</matrix>
    <instance_geometry url="#square"/></node>
  <node id="x3"><instance_node url="#lib"/></node>
</node>"""


def dae(asset: str = "", primitive: str = TRIANGLES, nodes: str = ONE_NODE) -> str:
    return DAE.replace("ASSET", asset).replace("PRIMITIVE", primitive).replace("NODES", nodes)


@pytest.mark.parametrize("primitive", [TRIANGLES, POLYLIST])
def test_a_collada_file_gives_its_triangles(tmp_path: Path, primitive: str) -> None:
    path = write(tmp_path / "part.dae", dae(primitive=primitive))

    assert corners(path).tolist() == TWO_TRIANGLES
    assert read_cad(path).parts[0].name == "plate"


def test_a_collada_assembly_is_placed_named_and_coloured(tmp_path: Path) -> None:
    asset = '<unit name="inch" meter="0.0254"/><up_axis>Z_UP</up_axis>'
    write(tmp_path / "assembly.dae", dae(asset, nodes=ASSEMBLY))

    first, plate, second = scene_of(tmp_path, 'mesh = "assembly.dae"\n').objects

    assert [thing.name for thing in (first, plate, second)] == [
        "thing.bolt",
        "thing.plate",
        "thing.bolt.2",
    ]
    turned = SQUARE @ np.array([[0.0, 2, 0], [-2, 0, 0], [0, 0, 2]]) + np.array([10.0, 0, 0])
    np.testing.assert_allclose(first.vertices_world, turned * 0.0254, atol=1e-7)
    mirrored = SQUARE * [1, 1, -1] + [10, 0, 7]
    np.testing.assert_allclose(plate.vertices_world, mirrored * 0.0254, atol=1e-7)
    assert plate.faces.tolist() == [[0, 2, 1], [0, 3, 2]]
    np.testing.assert_allclose(second.vertices_world, (SQUARE * 2 + [10, 0, 0]) * 0.0254, atol=1e-7)
    assert first.about["material"] == {"name": "orange paint", "rgba": [0.8, 0.4, 0.2, 1.0]}
    assert (plate.color, plate.about["unit"], plate.about["unit_m"]) == (None, "inch", 0.0254)


@pytest.mark.parametrize(
    ("asset", "unit", "unit_m", "up"),
    [
        ("", "meter", 1.0, "y"),
        ("<up_axis>X_UP</up_axis>", "meter", 1.0, "x"),
        ('<unit meter="0.01"/>', "0.01 m", 0.01, "y"),
        ('<unit name="cm" meter="0.01"/><up_axis>Y_UP</up_axis>', "cm", 0.01, "y"),
    ],
)
def test_a_collada_file_says_its_unit_and_axis(
    tmp_path: Path, asset: str, unit: str, unit_m: float, up: str
) -> None:
    cad = read_cad(write(tmp_path / "part.dae", dae(asset)))

    assert (cad.unit, cad.unit_m, cad.up) == (unit, unit_m, up)


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("", "cannot be read"),
        ("<COLLADA", "cannot be read"),
        (dae('<unit name="x" meter="0"/>'), "unit measures '0' metres"),
        (dae('<unit name="x" meter="a lot"/>'), "unit measures 'a lot' metres"),
        (dae(primitive=TRIANGLES.replace("2 3<", "2 9<")), "cannot be read"),
        (dae(nodes=ONE_NODE.replace("#square", "#circle")), "circle"),
        (dae(primitive=TRIANGLES.replace("triangles", "trisomething")), "trisomething"),
        (dae(nodes=""), "mesh is empty"),
        (dae(primitive=""), "mesh is empty"),
    ],
)
def test_a_collada_file_that_cannot_be_read_is_refused(
    tmp_path: Path, content: str, line: str
) -> None:
    path = write(tmp_path / "part.dae", content)

    with pytest.raises(SceneError, match=line) as caught:
        read_cad(path)

    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


# --- STEP -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "unit_m"), [("mm", 0.001), ("m", 1.0), ("in", 0.0254)])
def test_a_step_file_brings_its_unit(tmp_path: Path, unit: str, unit_m: float) -> None:
    write(tmp_path / "box.step", step_file(step_box, unit, (1.0, 2.0, 3.0)))

    (thing,) = scene_of(tmp_path, 'mesh = "box.step"\n').objects

    lower, upper = thing.box_world
    np.testing.assert_allclose(lower, 0.0, atol=1e-9)
    np.testing.assert_allclose(upper, np.array([1, 2, 3]) * unit_m, rtol=1e-6)
    assert thing.is_closed
    assert thing.about["volume_m3"] == pytest.approx(6 * unit_m**3, rel=1e-6)
    assert (thing.about["inside_out"], thing.about["n_triangles"]) == (False, 12)
    assert thing.about["tessellation_m"] == 1e-4  # unless the scene says otherwise


@pytest.mark.parametrize(
    ("unit", "radius", "tolerance_mm"),
    [("mm", 50.0, 2.0), ("mm", 50.0, 0.02), ("m", 0.05, 0.1), ("in", 50 / 25.4, 0.1)],
)
def test_triangles_stay_within_the_tolerance_of_a_step_surface(
    tmp_path: Path, unit: str, radius: float, tolerance_mm: float
) -> None:
    """The farthest a chord goes from its circle is in its middle: between the rims of a rod."""
    write(tmp_path / "rod.stp", step_file(step_cylinder, unit, radius, 0.4 * radius))

    (rod,) = scene_of(tmp_path, f'mesh = "rod.stp"\ntessellation_mm = {tolerance_mm}\n').objects

    triangles = rod.vertices_world[rod.faces]  # (T, 3, 3)
    is_mantle = np.ptp(triangles[:, :, 2], axis=1) > 0
    middles = (triangles[is_mantle] + np.roll(triangles[is_mantle], 1, axis=1)) / 2.0
    depth_mm = (0.05 - np.linalg.norm(middles[:, :, :2], axis=2).min()) * 1000.0
    assert depth_mm <= tolerance_mm * 1.001
    assert depth_mm > 0.2 * min(tolerance_mm, 1.5)  # no finer than asked for either
    assert rod.about["tessellation_m"] == pytest.approx(tolerance_mm / 1000.0)
    assert rod.is_closed


def test_a_step_assembly_becomes_objects_named_after_its_products(tmp_path: Path) -> None:
    places = [
        ("bolt", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
        ("bolt", (50.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)),
        ("base plate", (0.0, 0.0, -10.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
    ]
    boxes = {"bolt": (1.0, 2.0, 3.0), "base plate": (10.0, 20.0, 1.0)}
    write(tmp_path / "assembly.step", step_assembly("mm", boxes, places))

    things = scene_of(tmp_path, 'mesh = "assembly.step"\n').objects
    (whole,) = scene_of(tmp_path, 'mesh = "assembly.step"\nparts = "merge"\n').objects

    extents_mm = {thing.name: np.array(thing.box_world) * 1000.0 for thing in things}
    assert list(extents_mm) == ["thing.bolt", "thing.bolt.2", "thing.base_plate"]
    # z of the second bolt lies along y, and its y along -z.
    for name, lower, upper in (
        ("thing.bolt", (0, 0, 0), (1, 2, 3)),
        ("thing.bolt.2", (50, 0, -1), (51, 3, 1)),
        ("thing.base_plate", (0, 0, -10), (10, 20, -9)),
    ):
        np.testing.assert_allclose(extents_mm[name], [lower, upper], atol=1e-5)
    np.testing.assert_allclose(np.array(whole.box_world) * 1000, [(0, 0, -10), (51, 20, 3)], 1e-5)
    assert whole.about["n_triangles"] == 36
    assert all(thing.is_closed for thing in (*things, whole))


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("", "OpenCASCADE says: .*end of file"),
        ("hello world", "OpenCASCADE says: .*syntax"),
        (step_file(step_box, "mm", (1.0, 1.0, 1.0))[:3000], "OpenCASCADE says: .*end of file"),
        (
            step_file(step_box, "mm", (1.0, 1.0, 1.0)).replace("CLOSED_SHELL", "CLOSED_SHALL"),
            "the mesh is empty",
        ),
    ],
)
def test_a_damaged_step_file_is_refused_without_talk_on_stdout(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], content: str, line: str
) -> None:
    path = write(tmp_path / "part.step", content)

    with pytest.raises(SceneError, match=line) as caught:
        read_cad(path)

    assert str(path) in str(caught.value)
    assert str(caught.value).isprintable()
    assert capfd.readouterr() == ("", "")


# --- FBX --------------------------------------------------------------------------------------

FBX = """; FBX 7.3.0 project file
FBXHeaderExtension:  {
	FBXHeaderVersion: 1003
	FBXVersion: 7300
}
GlobalSettings:  {
	Version: 1000
	Properties70:  {
		P: "UpAxis", "int", "Integer", "",2
		P: "UpAxisSign", "int", "Integer", "",1
		P: "FrontAxis", "int", "Integer", "",1
		P: "FrontAxisSign", "int", "Integer", "",-1
		P: "CoordAxis", "int", "Integer", "",0
		P: "CoordAxisSign", "int", "Integer", "",1
	}
}
Objects:  {
	Geometry: 1001, "Geometry::Box", "Mesh" {
		Vertices: *12 {
			a: 0,0,0,1,0,0,0,1,0,0,0,1
		}
		PolygonVertexIndex: *12 {
			a: 0,2,-2,0,1,-4,0,3,-3,1,2,-4
		}
		GeometryVersion: 124
	}
	Model: 2001, "Model::Box", "Mesh" {
		Version: 232
		Properties70:  {
			P: "Lcl Translation", "Lcl Translation", "", "A",10,20,30
		}
	}
}
Connections:  {
	C: "OO",2001,0
	C: "OO",1001,2001
}
"""


def test_an_fbx_stands_as_it_was_drawn(tmp_path: Path) -> None:
    write(tmp_path / "part.fbx", FBX)  # z up

    (thing,) = scene_of(tmp_path, 'mesh = "part.fbx"\nunit = "m"\n').objects

    np.testing.assert_allclose(thing.box_world, [(10, 20, 30), (11, 21, 31)], atol=1e-5)
    assert thing.is_closed
    assert thing.about["inside_out"] is False
    with pytest.raises(SceneError, match=r"object\.1\.unit: .*this FBX file does not say its unit"):
        scene_of(tmp_path, 'mesh = "part.fbx"\n')


# --- what holds for all -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("suffix", "content"),
    [
        (".obj", ""),
        (".obj", "v 0 0 0\nv 1 0 0\n"),
        (".obj", "v 0 0 0\nv 1 0 0\nl 1 2\n"),
        (".stl", ""),
        (".stl", "solid\nendsolid\n"),
        (".stl", b"\0" * 84),
        (".off", "OFF\n0 0 0\n"),
        (".ply", PLY.replace("face 2", "face 0").partition("3 0 1 2")[0]),
    ],
)
def test_an_empty_mesh_is_refused(tmp_path: Path, content: str | bytes, suffix: str) -> None:
    with pytest.raises(SceneError, match="the mesh is empty"):
        read_cad(write(tmp_path / f"empty{suffix}", content))


def test_a_mesh_without_area_is_refused(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"

    with pytest.raises(SceneError, match="none of its triangles has an area"):
        read_cad(write(tmp_path / "line.obj", text))


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "names vertex 9 of 3"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -4\n", "line 4: a face names vertex -4"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 0\n", "line 4: a face names vertex 0"),
        ("a.obj", "v 0 0 0\nv 1 0 zero\nf 1 1 1\n", "line 2: .*zero"),
        ("a.obj", "v 0 0 0\nv 1 0\nf 1 1 1\n", "line 2: "),
        ("a.obj", "v 0 0 0\nf 1 1\n", "line 2: a face of 2 corners"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "cannot be read"),
        ("a.off", "", "cannot be read"),
        ("a.ply", "", "cannot be read"),
        ("a.ply", "ply\nformat binary_little_endian 1.0\nelement vertex 9\n", "cannot be read"),
        ("a.ply", PLY[: PLY.rindex("3 0")], "cut off: 1 of 2 rows of its element 'face'"),
        ("a.off", "OFF 3 2 0\n0 0 0\n1 0 0\n0 1 0 # last\n\n3 0 1 2\n", "cut off: 4 of 5 lines"),
        ("a.off", "OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "cut off: 4 of 5 lines"),
        ("a.stl", binary_stl(np.ones((9, 3, 3)))[:-60], "474 bytes, where its header promises 534"),
        ("a.stl", binary_stl(np.ones((9, 3, 3))) + b"1" * 50, "584 bytes, where .* promises 534"),
        ("a.stl", ascii_stl(np.ones((9, 3, 3)), "a").replace("1.0", "1.x", 9), "cannot be read"),
        ("a.glb", b"glTF", "cut off"),
        ("a.glb", square_gltf().glb()[:-40], "cut off: [0-9]+ of [0-9]+ bytes"),
        ("a.gltf", "{", "JSON cannot be read"),
        ("a.gltf", "[]", "not glTF"),
        ("a.dwg", "", r"a \.dwg cannot be read; \.stl, .*\.step"),
        ("a", "", "a file without suffix cannot be read"),
    ],
)
def test_a_file_that_cannot_be_read_is_refused_in_one_line(
    tmp_path: Path, name: str, content: str | bytes, line: str
) -> None:
    path = write(tmp_path / name, content)

    with pytest.raises(SceneError, match=line) as caught:
        read_cad(path)

    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_mesh_with_a_coordinate_that_is_no_number_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"vertex 1 is .* not finite numbers"):
        read_cad(write(tmp_path / "broken.ply", PLY.replace("0.25", "nan")))


def test_a_face_without_its_vertex_is_refused() -> None:
    with pytest.raises(SceneError, match="a face names a vertex"):
        check_mesh(np.zeros((3, 3)), np.array([[0, 1, 3]], np.int32), "mesh")


def test_a_reader_that_is_not_installed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(package: str) -> str:
        raise PackageNotFoundError(package)

    for module in (readers_module, step_module):
        monkeypatch.setattr(module, "version", missing)

    with pytest.raises(SceneError, match="STEP cannot be read without the package cascadio"):
        read_cad(write(tmp_path / "part.step", step_file(step_box, "mm", (1.0, 2.0, 3.0))))


# --- real files -------------------------------------------------------------------------------


@pytest.mark.recording
def test_cad_files_keep_their_size(recordings: Path) -> None:
    cube = read_cad(recordings / "meshes" / "parts" / "20mm-xyz-cube.stl").parts[0]
    extent = cube.vertices.max(axis=0) - cube.vertices.min(axis=0)

    np.testing.assert_allclose(extent, 20.0, atol=1e-3)  # single precision of the file
    arm = read_cad(recordings / "meshes" / "ur5" / "ur5_upperarm.stl").parts[0]
    assert len(arm.faces) == 1176


@pytest.mark.recording
def test_binary_stl_is_what_open3d_reads_to_the_bit(recordings: Path) -> None:
    """Whose triangle numbers stand in reports written before."""
    import open3d

    for path in sorted((recordings / "meshes" / "ur5").glob("*.stl")):
        theirs = open3d.io.read_triangle_mesh(path)
        triangles = np.asarray(theirs.vertices)[np.asarray(theirs.triangles)]

        np.testing.assert_array_equal(corners(path), triangles, strict=True)


@pytest.mark.slow
@pytest.mark.recording
@pytest.mark.parametrize(
    ("step", "stl", "stl_unit_m", "volume"),
    [
        ("parts/featuretype.STEP", "parts/featuretype.STL", 0.0254, 1e-3),
        ("prusa/y-motor-holder.stp", "prusa/y-motor-holder.stl", 0.001, 1e-3),
        ("prusa/adapter-printer.stp", "prusa/adapter-printer.stl", 0.001, 5e-3),
    ],
)
def test_a_step_part_lies_where_its_stl_twin_lies(
    recordings: Path, step: str, stl: str, stl_unit_m: float, volume: float
) -> None:
    """Both are triangles of one surface: extents differ by both tolerances at most."""
    ours = read_cad(recordings / "meshes" / step)
    twin = read_cad(recordings / "meshes" / stl)

    (part,), (other,) = ours.parts, twin.parts
    for end in (np.min, np.max):
        difference_m = end(part.vertices, axis=0) - end(other.vertices, axis=0) * stl_unit_m
        assert np.abs(difference_m).max() < 1e-4
    (mine,), (its,) = ours.topologies, twin.topologies
    assert mine.closed
    assert its.closed
    assert mine.volume == pytest.approx((its.volume or 0.0) * stl_unit_m**3, rel=volume)
