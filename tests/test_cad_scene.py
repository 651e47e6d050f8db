"""scene.toml: what is accepted, where objects end up, and the one line for each mistake."""

import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridve.calib.errors import SceneError
from hybridve.calib.pose import rotation_about_axes
from hybridve.hull.cad.rules import Rule
from hybridve.hull.cad.scene import load_scene, part_names

TETRAHEDRON = "v 0 0 0\nv 1000 0 0\nv 0 1000 0\nv 0 0 1000\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"

TWO_PARTS = (
    "v 0 0 0\nv 10 0 0\nv 0 10 0\nv 0 0 10\nv 100 0 0\n"
    "o a\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\no b\nf 5 2 3\n"
)

HEAD = 'format = "hybridve-scene"\nversion = 1\n'
STEP = '[[object]]\nname = "part"\nmesh = "part.step"\n'
OBJECT = '[[object]]\nname = "part"\nmesh = "part.obj"\nunit = "mm"\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "part.obj").write_text(TETRAHEDRON, encoding="utf-8")
    (tmp_path / "two.obj").write_text(TWO_PARTS, encoding="utf-8")
    (tmp_path / "part.step").write_text("ISO-10303-21;", encoding="utf-8")
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
        (
            HEAD + OBJECT + "required_clearance_mm = -1\n",
            r"object\.1\.required_clearance_mm: .*greater than or equal to 0, found -1$",
        ),
        (
            HEAD + OBJECT + "tessellation_mm = 1\n",
            r"object\.1\.tessellation_mm: found 1, but OBJ is made of triangles already",
        ),
        (
            HEAD + STEP + "tessellation_mm = 0\n",
            r"object\.1\.tessellation_mm: .*greater than or equal to 0\.001, found 0$",
        ),
        (HEAD + STEP + 'unit = "mm"\n', r"object\.1\.unit: found 'mm', but a STEP file brings its"),
        (HEAD + OBJECT + 'up = "-z"\n', r"object\.1\.up: .*'x', 'y' or 'z', found '-z'"),
        (HEAD + OBJECT + 'parts = "all"\n', r"object\.1\.parts: .*'split' or 'merge', found 'all'"),
        (
            HEAD + OBJECT.replace("part.obj", "two.obj") + OBJECT.replace('"part"', '"part.b"'),
            r"object\.2\.name: .*would be called 'part\.b', as another is already",
        ),
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


def test_a_file_of_several_parts_becomes_as_many_objects(folder: Path) -> None:
    table = OBJECT.replace("part.obj", "two.obj") + (
        "translate_mm = [1, 2, 3]\nrequired_clearance_mm = 7\nrecovery_direction = [0, 0, 2]\n"
    )

    a, b = load_scene(scene_path(folder, HEAD + table)).objects
    (whole,) = load_scene(scene_path(folder, HEAD + table + 'parts = "merge"\n')).objects

    assert (a.name, b.name, whole.name) == ("part.a", "part.b", "part")
    assert (a.about["part"], b.about["part"], whole.about["part"]) == ("a", "b", None)
    assert {thing.about["object"] for thing in (a, b, whole)} == {"part"}
    for thing in (a, b, whole):
        assert thing.required_clearance_m == 0.007
        assert thing.recovery_direction is not None
        assert thing.recovery_direction.tolist() == [0, 0, 1]
    np.testing.assert_allclose(a.reference_point_world, [0.006, 0.007, 0.008], atol=1e-12)
    np.testing.assert_allclose(b.reference_point_world, [0.051, 0.007, 0.003], atol=1e-12)
    assert (a.is_closed, b.is_closed, whole.is_closed) == (True, False, False)
    corners = [thing.vertices_world[thing.faces] for thing in (a, b)]
    np.testing.assert_array_equal(
        whole.vertices_world[whole.faces], np.concatenate(corners), strict=True
    )


def test_what_the_report_is_told_of_an_object_is_exact(folder: Path) -> None:
    text = HEAD + OBJECT + "rotate_deg = [10, 20, 30]\ntranslate_mm = [1000, 0, 0]\n"

    about = load_scene(scene_path(folder, text)).objects[0].about

    assert json.loads(json.dumps(about)) == about
    assert about.pop("volume_m3") == pytest.approx(1 / 6, rel=1e-12)
    assert about == {
        "object": "part",
        "mesh": "part.obj",
        "format": "OBJ",
        "part": None,
        "unit": "mm",
        "unit_m": 0.001,
        "up": "z",
        "tessellation_m": None,
        "tessellation_error_m": 0.0,
        "rounding_m": 0.0,
        "n_polygons": 0,
        "n_bent_polygons": 0,
        "bent_by_m": 0.0,
        "notes": [],
        "n_triangles": 4,
        "n_vertices": 4,
        "n_zero_area": 0,
        "n_open_edges": 0,
        "n_nonmanifold_edges": 0,
        "n_inconsistent_edges": 0,
        "closed": True,
        "closed_within_m": 0.0,
        "inside_out": False,
        "material": {"name": None, "rgba": None},
    }


def test_a_mesh_that_is_inside_out_is_closed_and_said_to_be(folder: Path) -> None:
    text = TETRAHEDRON
    for face in ("f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4"):
        _, a, b, c = face.split()
        text = text.replace(face, f"f {a} {c} {b}")
    (folder / "part.obj").write_text(text, encoding="utf-8")

    part = load_scene(scene_path(folder, HEAD + OBJECT)).objects[0]

    assert part.is_closed
    assert part.about["inside_out"] is True
    assert part.about["volume_m3"] == pytest.approx(1 / 6, rel=1e-12)


@pytest.mark.parametrize(
    ("up", "front", "top"),  # where z (the front) and y (the top) of a y-up file are, and so on
    [("z", (0, 1, 0), (0, 0, 1)), ("y", (0, 0, -1), (0, 1, 0)), ("x", (0, 0, -1), (1, 0, 0))],
)
def test_what_is_up_in_the_file_is_up_in_the_world(
    folder: Path, up: str, front: tuple[int, int, int], top: tuple[int, int, int]
) -> None:
    """A blade from the origin to the top and away from the viewer: world z and world y."""
    rows = "\n".join("v {} {} {}".format(*point) for point in ((0, 0, 0), top, front))
    (folder / "part.obj").write_text(f"{rows}\nf 1 2 3\n", encoding="utf-8")

    part = load_scene(scene_path(folder, HEAD + OBJECT + f'up = "{up}"\n')).objects[0]

    expected = [[0, 0, 0], [0, 0, 0.001], [0, 0.001, 0]]
    np.testing.assert_array_equal(part.vertices_world, expected)


@given(st.lists(st.sampled_from(["a", "a.2", "a.3", "b/c", "b c", "", "part", ".", "\t"])))
def test_names_of_parts_are_fit_for_a_report_and_all_different(names: list[str]) -> None:
    result = part_names(names)

    assert len(set(result)) == len(names)
    assert all(re.fullmatch(r"[^/\s]+", name) for name in result)
    for place, name in enumerate(names):  # the first of a name has it, if it is fit
        if name not in names[:place] and re.fullmatch(r"[^/\s]+", name) and name != "part":
            assert result[place] == name


def test_parts_of_one_name_are_numbered_in_the_files_order() -> None:
    assert part_names(["bolt", "nut", "bolt", "bolt"]) == ["bolt", "nut", "bolt.2", "bolt.3"]
    assert part_names(["bolt", "bolt", "bolt.2"]) == ["bolt", "bolt.3", "bolt.2"]


def test_the_checksum_covers_all_that_the_meshes_lean_on(folder: Path) -> None:
    path = scene_path(folder, HEAD + OBJECT)
    (folder / "part.obj").write_text(f"mtllib paint.mtl\n{TETRAHEDRON}", encoding="utf-8")
    checksums = []
    for text in (None, "newmtl a\n", "newmtl b\n"):
        if text is not None:
            (folder / "paint.mtl").write_text(text, encoding="utf-8")
        checksums.append(load_scene(path).checksum)

    assert len(set(checksums)) == 3


def test_the_checksum_of_a_mesh_by_itself_is_that_of_scene_and_mesh(folder: Path) -> None:
    path = scene_path(folder, HEAD + OBJECT)

    expected = hashlib.sha256(path.read_bytes() + (folder / "part.obj").read_bytes()).hexdigest()

    assert load_scene(path).checksum == expected


RULE = "[[rule]]\n"


def test_a_rule_requires_of_single_parts_what_it_says(folder: Path) -> None:
    text = (
        HEAD
        + '[[object]]\nname = "pair"\nmesh = "two.obj"\nunit = "mm"\nrequired_clearance_mm = 9\n'
        + RULE
        + 'object = "pair.b"\nrequired_clearance_mm = 2\n'
        + RULE
        + 'ignore = true\nobject = ["pair.*"]\ncomment = "table"\n'
        + "zone_mm = [[0, 0, 0], [1, 2, 3]]\n"
        + RULE
        + "shortest_s = 0.5\n"
    )

    scene = load_scene(scene_path(folder, text))

    required_mm = {part.name: 1e3 * part.required_clearance_m for part in scene.objects}
    assert required_mm == {"pair.a": 9.0, "pair.b": 2.0}
    assert scene.rules == (
        Rule(("pair.b",), required_clearance_m=0.002),
        Rule(("pair.*",), True, ((0.0, 0.0, 0.0), (0.001, 0.002, 0.003)), comment="table"),
        Rule(shortest_s=0.5),
    )


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        ("", "rule.1: has none of ignore, shortest_s, required_clearance_mm; a rule does one"),
        ("ignore = true\nshortest_s = 1", "rule.1: has ignore and shortest_s of"),
        ("ignore = false", "rule.1.ignore"),
        ("shortest_s = 0", "rule.1.shortest_s"),
        ("shortest = 1", "there is no such key; did you mean shortest_s?"),
        ("shortest_s = 1\nzone_mm = [[0, 0, 0], [1, 1, 1]]", "rule.1.zone_mm: is of rules that"),
        ("ignore = true\nzone_mm = [[0, 0, 0], [1, 0, 1]]", "rule.1.zone_mm: [[0.0, 0.0, 0.0], "),
        ('ignore = true\nzone_in = "object"', "rule.1.zone_in: says of what frame zone_mm is"),
        ('ignore = true\nobject = "prat"', "rule.1.object: no object is called 'prat'; did you"),
        ('ignore = true\nobject = ["part", "x*"]', "rule.1.object: no object is called 'x*'"),
        ("ignore = true\nobject = []", "rule.1.object"),
    ],
)
def test_a_rule_that_cannot_be_is_refused_by_its_key(folder: Path, rule: str, message: str) -> None:
    with pytest.raises(SceneError) as error:
        load_scene(scene_path(folder, HEAD + OBJECT + RULE + rule + "\n"))

    assert message in str(error.value)
    assert "\n" not in str(error.value)
