"""scene.toml: what is accepted, where objects end up, and the one line for each mistake."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridve.calib.errors import SceneError
from hybridve.calib.pose import rotation_about_axes
from hybridve.hull.contact.mesh import check_mesh, read_mesh
from hybridve.hull.contact.scene import load_scene

TETRAHEDRON = "v 0 0 0\nv 1000 0 0\nv 0 1000 0\nv 0 0 1000\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"

HEAD = 'format = "hybridve-scene"\nversion = 1\n'
OBJECT = '[[object]]\nname = "part"\nmesh = "part.obj"\nunit = "mm"\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "part.obj").write_text(TETRAHEDRON, encoding="utf-8")
    return tmp_path


def scene_path(folder: Path, text: str) -> Path:
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_an_object_is_scaled_then_turned_then_moved(folder: Path) -> None:
    text = HEAD + OBJECT + "rotate_deg = [0, 0, 90]\ntranslate_mm = [10, 20, 30]\n"

    part = load_scene(scene_path(folder, text)).objects[0]

    # The corner at x = 1 m turns onto y, then everything moves by (1, 2, 3) cm.
    expected = {(0.01, 0.02, 0.03), (0.01, 1.02, 0.03), (-0.99, 0.02, 0.03), (0.01, 0.02, 1.03)}
    assert {tuple(vertex) for vertex in part.vertices_world.round(12).tolist()} == expected
    np.testing.assert_allclose(part.reference_point_world, [-0.49, 0.52, 0.53], atol=1e-12)


def test_the_reference_point_and_the_direction_move_with_the_object(folder: Path) -> None:
    text = (
        HEAD
        + OBJECT
        + "rotate_deg = [0, 0, 90]\ntranslate_mm = [10, 0, 0]\n"
        + "reference_point_mm = [100, 0, 0]\nrecovery_direction = [2, 0, 0]\n"
    )

    part = load_scene(scene_path(folder, text)).objects[0]

    np.testing.assert_allclose(part.reference_point_world, [0.01, 0.1, 0.0], atol=1e-12)
    assert part.recovery_direction is not None
    np.testing.assert_allclose(part.recovery_direction, [0, 1, 0], atol=1e-12)


@given(angles=st.tuples(*[st.floats(-720, 720)] * 3))
def test_rotations_turn_and_do_nothing_else(angles: tuple[float, float, float]) -> None:
    rotation = rotation_about_axes(angles)

    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_axes_turn_about_x_then_y_then_z_of_the_world() -> None:
    # y goes to z about x; z goes to x about y; x goes to y about z.
    np.testing.assert_allclose(rotation_about_axes((90, 90, 90)) @ [0, 1, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(rotation_about_axes((90, 90, 0)) @ [0, 1, 0], [1, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (HEAD + OBJECT.replace('unit = "mm"\n', ""), r"object\.1\.unit: .*never guessed"),
        (HEAD + OBJECT.replace('"mm"', '"parsec"'), r"object\.1\.unit: .*'parsec'"),
        (HEAD + OBJECT + "colour = 3\n", r"object\.1\.colour: there is no such key"),
        (HEAD + OBJECT + OBJECT, r"object\.2\.name: 'part' is the name of object\.1 too"),
        (HEAD + OBJECT.replace("part.obj", "other.obj"), r"object\.1\.mesh: there is no mesh file"),
        (HEAD + OBJECT.replace("part.obj", "scene.toml"), r"object\.1\.mesh: .*\.toml cannot be"),
        (HEAD + OBJECT + "recovery_direction = [0, 0, 0]\n", "recovery_direction: .*nowhere"),
        (HEAD + OBJECT + "translate_mm = [nan, 0, 0]\n", r"object\.1\.translate_mm\.1: "),
        (HEAD + OBJECT.replace('"part"', '"a/b"'), r"object\.1\.name: "),
        (HEAD, r"object: this key is missing"),
        (OBJECT, r"format: this key is missing"),
        (HEAD.replace("1", "2") + OBJECT, r"version: "),
        (HEAD + "object = ]", r"not valid TOML: .*line 3"),
        ('root = "${NO_SUCH_VARIABLE}"\n' + HEAD + OBJECT, r"NO_SUCH_VARIABLE is not set"),
        ('root = "nowhere"\n' + HEAD + OBJECT, r"root: there is no folder"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_key(folder: Path, text: str, line: str) -> None:
    with pytest.raises(SceneError, match=line) as caught:
        load_scene(scene_path(folder, text))

    assert "scene.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_scene_is_named(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"nothing\.toml: there is no such scene"):
        load_scene(tmp_path / "nothing.toml")


@pytest.mark.parametrize("content", ["", "v 0 0 0\nv 1 0 0\n", "solid\nendsolid\n"])
@pytest.mark.parametrize("suffix", [".obj", ".stl"])
def test_an_empty_mesh_is_refused(tmp_path: Path, content: str, suffix: str) -> None:
    path = tmp_path / f"empty{suffix}"
    path.write_text(content, encoding="utf-8")

    with pytest.raises(SceneError, match="the mesh is empty"):
        read_mesh(path)


def test_a_mesh_with_a_coordinate_that_is_no_number_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "broken.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0\n1 0 nan\n0 1 0\n3 0 1 2\n",
        encoding="utf-8",
    )

    with pytest.raises(SceneError, match=r"vertex 1 is .* not finite numbers"):
        read_mesh(path)


def test_a_face_without_its_vertex_is_refused() -> None:
    with pytest.raises(SceneError, match="a face names a vertex"):
        check_mesh(np.zeros((3, 3)), np.array([[0, 1, 3]], np.int32), "mesh")


def test_triangles_without_area_are_counted_and_kept() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 0, 0]], np.int32)

    mesh = check_mesh(vertices, faces, "mesh")

    assert mesh.n_zero_area == 2
    assert len(mesh.faces) == 3


@pytest.mark.recording
def test_cad_files_keep_their_size(recordings: Path) -> None:
    cube = read_mesh(recordings / "meshes" / "parts" / "20mm-xyz-cube.stl")
    extent = cube.vertices.max(axis=0) - cube.vertices.min(axis=0)

    np.testing.assert_allclose(extent, 20.0, atol=1e-3)  # single precision of the file
    arm = read_mesh(recordings / "meshes" / "ur5" / "ur5_upperarm.stl")
    assert len(arm.faces) == 1176
