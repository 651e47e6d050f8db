"""What each kind of CAD file may hold besides plain faces: read, or refused by its place."""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.mesh_files import (
    WRITERS,
    binary_stl,
    dae,
    fan,
    fbx_text,
    mesh_3mf,
    model_3mf,
    obj,
    off,
    package_3mf,
    text_fbx,
    text_ply,
    text_stl,
)
from helpers.step_files import step_assembly, step_box, step_file, step_torus
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError
from hybridve.hull.cad.mesh import read_cad
from hybridve.hull.cad.scene import load_scene
from hybridve.hull.cad.topology import examine_topology, widest_gap

BOX = np.array([[x, y, z] for x in (0, 100) for y in (0, 60) for z in (0, 40)], np.float64)
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
TRIANGLES = fan(QUADS)
INPUT = '<input semantic="VERTEX" source="#v" offset="0"/>'


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def is_the_box(path: Path, scale: float = 1.0) -> bool:
    """Tell whether a file holds the box whole: twelve triangles, its area, its volume, closed."""
    cad = read_cad(path)
    triangles = np.concatenate([part.vertices[part.faces] for part in cad.parts]) * scale
    area = np.linalg.norm(np.cross(*np.diff(triangles, axis=1).swapaxes(0, 1)), axis=1).sum() / 2
    volume = sum((topology.volume or np.nan) * scale**3 for topology in cad.topologies)
    return bool(
        len(triangles) == 12
        and np.isclose(area, 24800.0, rtol=1e-6)
        and np.isclose(volume, 240000.0, rtol=1e-6)
    )


PLAIN_STL = text_stl(BOX, TRIANGLES).decode()
PLAIN_OBJ = obj(BOX, QUADS).decode()
BINARY_STL = binary_stl(BOX, TRIANGLES)
PLAIN_PLY = text_ply(BOX, QUADS).decode()
PLAIN_OFF = off(BOX, QUADS).decode()
OBJECT_3MF = f'<object id="1" name="box">{mesh_3mf(BOX, TRIANGLES)}</object>'
ITEM_3MF = '<item objectid="1"/>'
PLAIN_3MF = model_3mf(OBJECT_3MF, ITEM_3MF, "millimeter")


def with_payload(stl: bytes, length: int) -> bytes:
    """Return a binary STL with so many bytes behind each triangle, as its attribute says."""
    records = [stl[at : at + 48] for at in range(84, len(stl), 50)]
    behind = length.to_bytes(2, "little") + b"\1" * length
    return stl[:84] + b"".join(record + behind for record in records)


def comma_stl() -> str:
    """Return the plain STL as a program of another country writes it."""
    return PLAIN_STL.replace(".", ",")


HALVES = [text_stl(BOX, half).decode() for half in (TRIANGLES[:5], TRIANGLES[5:])]
FACET = "facet normal 0 0 0\n outer loop\n  vertex 0 0 0\n  vertex 1 0 0\n  vertex 0 1 0\n endloop"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("upper.stl", PLAIN_STL.upper()),
        ("mac.stl", PLAIN_STL.replace("\n", "\r")),
        ("windows.stl", PLAIN_STL.replace("\n", "\r\n")),
        ("mark.stl", "\ufeff" + PLAIN_STL),
        ("wide.stl", PLAIN_STL.encode("utf-16")),
        ("blank.stl", "\n  " + PLAIN_STL),
        ("solids.stl", "".join(HALVES)),
        ("quads.stl", text_stl(BOX, QUADS)),
        ("named.stl", PLAIN_STL.replace("solid part", "solid facet normal vertex endsolid cover")),
        ("latin.stl", PLAIN_STL.replace("part", "Geh\u00e4use").encode("latin-1")),
        ("zeros.stl", BINARY_STL + b"\0\0"),
        ("streamed.stl", BINARY_STL[:80] + bytes(4) + BINARY_STL[84:]),
        ("streamed4.stl", BINARY_STL[:80] + b"\xff" * 4 + BINARY_STL[84:]),
        ("payload.stl", with_payload(BINARY_STL, 4)),
        ("made_by.stl", BINARY_STL + b"end of file: made by X"),
        ("comma.stl", comma_stl()),
        ("comma.obj", "\n".join(
            line.replace(".", ",") if line.startswith("v ") else line
            for line in PLAIN_OBJ.splitlines()
        ) + "\n"),
        ("fortran.stl", PLAIN_STL.replace("100.0", "1.0D+02")),
        ("line.stl", BINARY_STL + b"\n"),
        ("mark.obj", "\ufeff" + "\n".join(PLAIN_OBJ.splitlines()[1:]) + "\n"),
        ("wide.obj", PLAIN_OBJ.encode("utf-16")),
        ("mac.obj", PLAIN_OBJ.replace("\n", "\r")),
        ("unended.obj", PLAIN_OBJ.rstrip("\n")),
        ("weights.obj", PLAIN_OBJ.replace("\nv ", "\nv  ").replace(".0\n", ".0 1.0\n")),
        ("old.obj", PLAIN_OBJ.replace("\nf ", "\nfo ")),
        ("lines.obj", PLAIN_OBJ + "v 1 2 3\nv 3 4 5\nl 9 10\np 9\ndeg 1\ncurv 0 1 9 10\n"),
        ("unended.off", PLAIN_OFF.rstrip("\n")),
        ("bare.off", PLAIN_OFF.partition("\n\n")[2]),
        ("edges.ply", PLAIN_PLY.replace("end_header", "element edge 1\nproperty int vertex1\n"
        "property int vertex2\nend_header") + "0 1\n"),
        ("index.ply", PLAIN_PLY.replace("vertex_indices", "vertex_index")),
        ("plain.3mf", package_3mf(PLAIN_3MF)),
        ("mark.3mf", package_3mf("\ufeff" + PLAIN_3MF)),
        ("capital.3mf", package_3mf(PLAIN_3MF).replace(b"/3dmodel.model", b"/3DModel.model")),
        ("mirrored.3mf", package_3mf(PLAIN_3MF.replace('<item objectid="1"', '<item objectid="1" '
        'transform="-1 0 0 0 1 0 0 0 1 5 6 7"'))),
        ("others.3mf", package_3mf(PLAIN_3MF.replace("<resources>", "<resources><colorgroup "
        'xmlns="http://schemas.microsoft.com/3dmanufacturing/material/2015/02" id="9"><color '
        'color="#FF0000"/></colorgroup>'), {"Metadata/thumbnail.png": "no picture"})),
    ],
)  # fmt: skip
def test_what_programs_write_is_read_whole(tmp_path: Path, name: str, content: str | bytes) -> None:
    assert is_the_box(write(tmp_path / name, content))


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("a.stl", PLAIN_STL.replace("100.0", "100,0"), "line [0-9]+: '100,0' is no number; the"),
        ("a.stl", PLAIN_STL.replace("endsolid part\n", ""), "ends at line 85, .*endsolid"),
        ("a.stl", "".join(HALVES)[:-30], "cut off|line [0-9]+: found"),
        ("a.stl", f"solid\n{FACET}\nendsolid\n", "line 8: found 'endsolid' in a facet"),
        ("a.stl", PLAIN_STL.replace("  vertex 0.0 0.0 0.0\n", "", 1), "a loop of 2 vertices"),
        ("a.stl", PLAIN_STL + "facet normal 0 0 1\n", "found 'facet normal 0 0' outside a solid"),
        ("a.stl", BINARY_STL + bytes(49) + b"x", "734 bytes, .*promises 684 for 12"),
        ("a.stl", BINARY_STL[:80] + b"\1\0\0\0" + BINARY_STL[84:], "684 bytes, .*promises 134 "),
        ("a.stl", BINARY_STL[:80] + b"\xff" * 4 + BINARY_STL[84:-1], "683 .*4294967295 tri"),
        ("a.stl", with_payload(BINARY_STL, 4)[:-1], "731 bytes, where its header promises 684"),
        ("a.stl", comma_stl().replace("vertex 0,", "vertex 0.", 1), "no number; the decimal"),
        ("a.stl", b"\x01\x02\x03", "neither text nor binary STL: 3 bytes"),
        ("a.3mf", package_3mf(PLAIN_3MF)[:-1], "its ZIP cannot be read"),
        ("a.3mf", b"PK", "its ZIP cannot be read: File is not a zip file; is it cut off"),
        ("a.3mf", package_3mf(PLAIN_3MF).replace(b"_rels", b"_rolz"), "has no '_rels/.rels'"),
        ("a.3mf", package_3mf(PLAIN_3MF.replace('v3="1"', 'v3="8"', 1)), "model, line 5: object"
        " 'box': triangle 5 names vertex 8 of 8"),
        ("a.3mf", package_3mf(PLAIN_3MF.replace('z="0.0"', "", 1)), "line 6: a vertex has no z"),
        ("a.3mf", package_3mf(PLAIN_3MF.replace("100.0", "100,0")), "line 10: '100,0' is no num"),
        ("a.3mf", package_3mf(PLAIN_3MF.replace("</vertices>", "")), "line 28, column [0-9]+"),
        ("a.3mf", package_3mf(PLAIN_3MF.replace("<model", "<!DOCTYPE model [<!ENTITY a 'b'>]>"
        "<model")), "line 2: it has a document type"),
        ("a.3mf", package_3mf(PLAIN_3MF.replace("millimeter", "mm")), "unit is 'mm', expected one"),
        ("a.3mf", package_3mf(PLAIN_3MF.replace('<item objectid="1"', '<item objectid="2"')),
        "names object '2', and there is none"),
        ("a.3mf", package_3mf(PLAIN_3MF.replace('<item', '<item transform="1 0 0"')),
        "a transform of '1 0 0', expected 12 numbers"),
        ("a.3mf", package_3mf(PLAIN_3MF.replace("</mesh>", "<beamlattice xmlns='http://b'/></mesh>")
        ), "object 'box' has a beamlattice, which is not read; export a mesh"),
        ("a.3mf", package_3mf(PLAIN_3MF.replace("<mesh>", "<booleanshape xmlns='http://b'/><mesh>")
        ), "object 'box' is a booleanshape, which is not read"),
        ("a.3mf", package_3mf(model_3mf(OBJECT_3MF, ITEM_3MF, head='xmlns:x="http://volumetric" '
        'requiredextensions="x"')), "needs the extension 'http://volumetric', which is not"),
        ("a.3mf", package_3mf(model_3mf('<object id="1"><components><component objectid="1"/>'
        "</components></object>", ITEM_3MF)), "hold each other in a circle"),
        ("a.3mf", package_3mf(PLAIN_3MF, {"Metadata/Slic3r_PE_model.config": '<metadata '
        'type="volume" key="volume_type" value="NegativeVolume"/>'}), "makes a mesh a NegativeVol"),
        ("a.3mf", package_3mf(model_3mf(OBJECT_3MF, "")), "no triangle was found in it"),
        ("a.obj", PLAIN_OBJ + "surf 0 1 0 1 1 2 3 4\n", "line 16: 'surf' holds a surface"),
        ("a.obj", PLAIN_OBJ + "call more.obj\n", "line 16: 'call' holds a surface"),
        ("a.obj", PLAIN_OBJ + "ff 1 2 3\n", "line 16: 'ff' is no statement of OBJ files"),
        ("a.obj", PLAIN_OBJ + "v 1 2 3\n", "1 vertices after the last face are used by none"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3", "last line does not end and its surface"),
        ("a.obj", PLAIN_OBJ.replace("f ", "f x"), "line 10: 'x1' is no whole number"),
        ("a.obj", "v 0 0 0\nv 2 2 0\nv 2 0 0\nv 0 2 0\n\nf 1 2 3 4\n", "line 6: .*crosses itself"),
        ("a.obj", PLAIN_OBJ.encode("utf-16")[2:], "line 1: it holds a zero byte"),
        ("a.off", PLAIN_OFF.replace("OFF", "4OFF"), "line 1: 4OFF: its vertices have no three"),
        ("a.off", PLAIN_OFF.replace("OFF #", "OFF BINARY\n#"), "a binary OFF"),
        ("a.off", PLAIN_OFF + "3 0 1 2\n", "line 18: more than the 8 vertices and 6 faces"),
        ("a.off", PLAIN_OFF.replace("4 0 1 3 2", "4 0 1 3"), "line 12: a face of 3 corners"),
        ("a.off", "solid\n", "line 1: it begins with 'solid', not with OFF"),
        ("a.ply", PLAIN_PLY.replace("element face", "element range_grid"), "'range_grid' makes"),
        ("a.ply", PLAIN_PLY.replace("vertex_indices", "corners"), "its face have flags.*rename"),
        ("a.ply", PLAIN_PLY + "1 2\n", "2 words follow the rows"),
        ("a.ply", WRITERS["big.ply"][0](BOX, QUADS) + b"more", "4 bytes follow the rows"),
        ("a.ply", PLAIN_PLY.replace("property double z", "property double depth"), "no x, y and z"),
        ("a.ply", PLAIN_PLY.replace("format ascii", "format utf8"), "line 2: .*no PLY header"),
    ],
)  # fmt: skip
def test_what_is_not_read_is_refused_with_its_place(
    tmp_path: Path, name: str, content: str | bytes, line: str
) -> None:
    path = write(tmp_path / name, content)

    with pytest.raises(SceneError, match=line) as caught:
        read_cad(path)

    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_open_obj_is_said_not_to_count_its_faces(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = "\n".join(PLAIN_OBJ.splitlines()[:-1]) + "\n"

    cad = read_cad(write(tmp_path / "open.obj", text))

    (note,) = cad.notes
    assert "4 open edges" in note
    assert note in caplog.text
    assert read_cad(write(tmp_path / "closed.obj", PLAIN_OBJ)).notes == ()


def test_polygons_that_are_not_flat_are_counted_in_metres(tmp_path: Path) -> None:
    bent = BOX.copy()
    bent[7, 2] += 6.0  # a corner of three faces
    write(tmp_path / "bent.obj", obj(bent, QUADS))
    head = 'format = "hybridve-scene"\nversion = 1\n[[object]]\nname = "a"\nunit = "mm"\n'

    (thing,) = load_scene(write(tmp_path / "s.toml", head + 'mesh = "bent.obj"\n')).objects

    assert (thing.about["n_polygons"], thing.about["n_bent_polygons"]) == (6, 1)
    assert 0.0025 < thing.about["bent_by_m"] < 0.003  # half of 6 mm, along the normal
    assert thing.tessellation_error_m == 0.0


# --- COLLADA ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "primitive",
    [
        f'<polygons count="6">{INPUT}'
        + "".join(f"<p>{' '.join(map(str, quad))}</p>" for quad in QUADS) + "</polygons>",
        f'<triangles count="12">{INPUT}<p>{" ".join(str(c) for t in TRIANGLES for c in t)}</p>'
        "</triangles>",
        f'<trifans count="6">{INPUT}'
        + "".join(f"<p>{' '.join(map(str, quad))}</p>" for quad in QUADS) + "</trifans>",
        f'<tristrips count="6">{INPUT}'
        + "".join(f"<p>{a} {b} {d} {c}</p>" for a, b, c, d in QUADS) + "</tristrips>",
        f'<lines count="1">{INPUT}<p>0 1</p></lines><polylist count="6">{INPUT}'
        f"<vcount>{'4 ' * 6}</vcount><p>{' '.join(str(c) for q in QUADS for c in q)}</p>"
        "</polylist>",
    ],
)  # fmt: skip
def test_every_surface_of_collada_is_read(tmp_path: Path, primitive: str) -> None:
    assert is_the_box(write(tmp_path / "box.dae", dae(BOX, primitive)))


PART = f'<polygons count="1">{INPUT}<p>0 1 3 2</p></polygons>'


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("<p>0 1 3 2</p>", "<ph><p>0 1 3 2</p><h>4 5</h></ph>", "a ring of fewer than 3 corners"),
        ("<p>0 1 3 2</p>", "<ph><p>0 1 3 2</p><h>4 5 6</h></ph>", "holes 1: a hole .* not inside"),
        ('count="1"', 'count="2"', "1 of the 2 that it promises are there"),
        ("0 1 3 2", "0 1 3 9", "names vertex 9 of 8"),
        ("<p>0 1 3 2</p>", "<p>0 3 2 1</p>", "polygon 1 of 1: .*crosses itself"),
        ("mesh>", "convex_mesh>", "'g' is a convex_mesh, which is not read"),
        ("<instance_geometry", "<instance_controller url='#g'/><instance_geometry", "skinned or"),
        ('url="#g"', 'url="other.dae#g"', "leans on 'other.dae#g', which is another file"),
        ("<instance_geometry", "<skew>45 1 0 0 0 1 0</skew><instance_geometry", "a skew places"),
        ("<instance_geometry", "<scale>1 2</scale><instance_geometry", "a scale of 2 numbers"),
        ("Z_UP", "UP", "its up_axis is 'UP'"),
        ("</COLLADA>", "", "its XML cannot be read"),
        ('count="24"', 'count="27"', "float_array holds 24 of 27 numbers"),
        ('count="8"', 'count="9"', "too few for 9 vertices"),
    ],
)  # fmt: skip
def test_a_collada_surface_that_is_not_read_is_refused(
    tmp_path: Path, old: str, new: str, line: str
) -> None:
    content = dae(BOX, PART).decode()
    assert old in content

    with pytest.raises(SceneError, match=line) as caught:
        read_cad(write(tmp_path / "a.dae", content.replace(old, new)))

    assert "\n" not in str(caught.value)


def test_collada_geometry_outside_the_scene_is_said(tmp_path: Path) -> None:
    content = dae(BOX, PART).decode()
    more = '<geometry id="h" name="left over"><mesh/></geometry></library_geometries>'

    (note,) = read_cad(
        write(tmp_path / "a.dae", content.replace("</library_geometries>", more))
    ).notes

    assert "1 of its geometries are not in its scene, first 'left over'" in note


# --- FBX --------------------------------------------------------------------------------------


def test_a_box_of_triangles_beside_one_of_quads_is_read_whole(tmp_path: Path) -> None:
    """Open3D reads the twelve triangles of the first and nothing of the second."""
    import open3d

    more = text_fbx(BOX + np.array([200.0, 0, 0]), QUADS).decode()
    geometry = more[more.index("Geometry:") : more.index("Model:")].replace("11,", "12,", 1)
    content = fbx_text(
        BOX,
        TRIANGLES,
        objects=geometry + 'Model: 23, "Model::quads", "Mesh" {\n}\n',
        connections='C: "OO",23,0\n\tC: "OO",12,23',
    )
    path = write(tmp_path / "two.fbx", content)

    cad = read_cad(path)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        theirs = open3d.io.read_triangle_mesh(path)

    assert [part.name for part in cad.parts] == ["part", "quads"]
    assert [len(part.faces) for part in cad.parts] == [12, 12]
    assert all(topology.volume == pytest.approx(240000) for topology in cad.topologies)
    assert len(theirs.triangles) == 12
    assert [part.cuts.n_polygons for part in cad.parts] == [0, 6]


@pytest.mark.parametrize(
    ("settings", "unit_m"),
    [('P: "UnitScaleFactor", "double", "Number", "",2.54', 0.0254), ("", 1.0)],
)
def test_an_fbx_brings_its_unit(tmp_path: Path, settings: str, unit_m: float) -> None:
    write(tmp_path / "a.fbx", fbx_text(BOX, QUADS, settings=settings))
    head = 'format = "hybridve-scene"\nversion = 1\n[[object]]\nname = "a"\nmesh = "a.fbx"\n'

    (thing,) = load_scene(write(tmp_path / "s.toml", head)).objects
    (given,) = load_scene(write(tmp_path / "t.toml", head + 'unit = "mm"\n')).objects

    np.testing.assert_allclose(np.ptp(thing.box_world, axis=0), np.array([100, 60, 40]) * unit_m)
    np.testing.assert_allclose(np.ptp(given.box_world, axis=0), [0.1, 0.06, 0.04])


@pytest.mark.parametrize(
    ("axes", "expected"),
    [
        ("2 1 1 -1 0 1", [[0, 0, 0], [100, 60, 40]]),  # z up, as drawn
        ("1 1 2 1 0 1", [[0, -40, 0], [100, 0, 60]]),  # y up: turned
        ("0 1 2 1 1 1", [[0, -40, 0], [60, 0, 100]]),  # x up, y right, z front
    ],
)
def test_what_is_up_in_an_fbx_is_up_in_the_world(
    tmp_path: Path, axes: str, expected: list[list[int]]
) -> None:
    names = ("UpAxis", "UpAxisSign", "FrontAxis", "FrontAxisSign", "CoordAxis", "CoordAxisSign")
    settings = "\n".join(
        f'P: "{name}", "int", "Integer", "",{value}'
        for name, value in zip(names, axes.split(), strict=True)
    )
    write(tmp_path / "a.fbx", fbx_text(BOX, QUADS, settings=settings))
    head = 'format = "hybridve-scene"\nversion = 1\n[[object]]\nname = "a"\nmesh = "a.fbx"\n'

    (thing,) = load_scene(write(tmp_path / "s.toml", head)).objects

    np.testing.assert_allclose(thing.box_world, expected, atol=1e-9)
    assert thing.about["inside_out"] is False  # even where the axes are a mirror image


def deformed(kind: str, percent: int = 0) -> str:
    channel = (
        f'Deformer: 45, "SubDeformer::c", "BlendShapeChannel" {{\nDeformPercent: {percent}\n}}\n'
    )
    return f'Deformer: 44, "Deformer::", "{kind}" {{\n}}\n{channel}'


DEFORMS = 'C: "OO",44,11\n\tC: "OO",45,44'


@pytest.mark.parametrize(
    ("properties", "objects", "connections", "line"),
    [
        ("", deformed("Skin"), DEFORMS, "geometry '' has a Skin, so no fixed shape"),
        ("", deformed("BlendShape", 50), DEFORMS, "is blended with other shapes"),
        ("", 'Geometry: 12, "Geometry::n", "NurbsSurface" {\n}', 'C: "OO",12,22', "NurbsSurface"),
        (
            'P: "PreRotation", "Vector3D", "Vector", "",90,0,0',
            "",
            "",
            "model 'part' has a rotation order or pre-rotation that is switched off",
        ),
        ('P: "RotationOrder", "enum", "", "",6\nP: "RotationActive", "bool", "", "",1', "", "",
         "has the rotation order 6"),
        ('P: "Lcl Scaling", "Lcl Scaling", "", "A",1,2', "", "", "a Lcl Scaling of .*3 numbers"),
    ],
)  # fmt: skip
def test_an_fbx_that_programs_read_differently_is_refused(
    tmp_path: Path, properties: str, objects: str, connections: str, line: str
) -> None:
    content = fbx_text(BOX, QUADS, properties, objects=objects, connections=connections)

    with pytest.raises(SceneError, match=line) as caught:
        read_cad(write(tmp_path / "a.fbx", content))

    assert "\n" not in str(caught.value)


def test_a_shape_that_is_not_blended_in_counts_for_nothing(tmp_path: Path) -> None:
    content = fbx_text(BOX, QUADS, objects=deformed("BlendShape"), connections=DEFORMS)

    assert is_the_box(write(tmp_path / "a.fbx", content))


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            lambda text: text.replace("FBXVersion: 7400", "FBXVersion: 6100"),
            "of version 6100; save",
        ),
        (lambda text: text.replace("*24 {", "*27 {"), "its Vertices holds 24 of 27 numbers"),
        (lambda text: text.replace("7,-4", "7,3"), "its last polygon does not end"),
        (lambda text: text.replace("FBXVersion", "Version"), "does not say its FBXVersion"),
        (lambda text: text.replace('C: "OO",22,0', 'C: "OO",22,22'), "the mesh is empty"),
        (lambda text: text[: text.rindex("}")], "cut off: it ends inside 'Connections'"),
    ],
)
def test_a_damaged_fbx_is_refused(tmp_path: Path, change: Callable[[str], str], line: str) -> None:
    content = fbx_text(BOX, QUADS).decode()
    assert change(content) != content

    with pytest.raises(SceneError, match=line):
        read_cad(write(tmp_path / "a.fbx", change(content)))


# --- STEP -------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("major", "minor", "tolerance_m"), [(50.0, 10.0, 1e-3), (50.0, 10.0, 2e-4), (5.0, 1.0, 1e-3)]
)
def test_a_torus_is_as_close_as_it_says_and_as_was_asked(
    tmp_path: Path, major: float, minor: float, tolerance_m: float
) -> None:
    """In closed form: of points on its triangles, and of their vertices' surface between them."""
    import igl

    path = write(tmp_path / "torus.step", step_file(step_torus, "mm", major, minor))

    (part,) = read_cad(path, tessellation_m=tolerance_m).parts

    grid = [np.array([i, j, 6 - i - j]) / 6 for i in range(7) for j in range(7 - i)]
    points = np.concatenate([np.einsum("tij,i->tj", part.vertices[part.faces], w) for w in grid])
    x, y, z = points.T * 1000.0
    mesh_off_by_m = np.abs(np.hypot(np.hypot(x, y) - major, z) - minor).max() / 1000.0
    u, v = (angle.ravel() for angle in np.mgrid[0:6.283:200j, 0:6.283:100j])
    ring = major + minor * np.cos(v)
    surface = np.stack([ring * np.cos(u), ring * np.sin(u), minor * np.sin(v)], axis=1) / 1000.0
    squared = igl.point_mesh_squared_distance(surface, part.vertices, part.faces.astype(np.int64))[
        0
    ]
    true_m = max(mesh_off_by_m, float(np.sqrt(squared.max())))
    assert true_m <= part.off_by_m <= tolerance_m
    assert part.off_by_m < 2 * true_m  # and no more than need be


def test_a_flat_part_is_off_by_rounding_alone(tmp_path: Path) -> None:
    path = write(tmp_path / "box.step", step_file(step_box, "mm", (100.0, 60.0, 40.0)))

    (part,) = read_cad(path).parts

    assert 0 < part.off_by_m < 1e-7


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (
            "CLOSED_SHELL",
            "CLOSED_SHALL",
            "its part 'bolt' came out of OpenCASCADE without geometry",
        ),
        ("ADVANCED_FACE", "ADVANCED_FICE", "1 of its 12 faces did not become triangles"),
        ("PLANE(", "PLONE(", "1 of its 12 faces did not become triangles"),
        (
            "VERTEX_POINT",
            "VERTEX_PAINT",
            "its part 'bolt' came out of OpenCASCADE without geometry",
        ),
    ],
)
def test_a_step_file_that_lost_something_is_refused(
    tmp_path: Path, old: str, new: str, line: str
) -> None:
    """OpenCASCADE itself says nothing, and returns the rest."""
    places = [
        ("bolt", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
        ("plate", (0.0, 0.0, -10.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
    ]
    text = step_assembly("mm", {"bolt": (1.0, 2.0, 3.0), "plate": (9.0, 9.0, 1.0)}, places)

    with pytest.raises(SceneError, match=line):
        read_cad(write(tmp_path / "a.step", text.replace(old, new, 1)))


def test_a_step_file_that_names_what_is_not_there_is_refused(tmp_path: Path) -> None:
    lines = step_file(step_box, "mm", (1.0, 2.0, 3.0)).splitlines()
    face = next(k for k, line in enumerate(lines) if "ADVANCED_FACE" in line)
    name = lines[face].partition("=")[0]

    with pytest.raises(SceneError, match=f"it names {name}, and there is no such entity"):
        read_cad(write(tmp_path / "a.step", "\n".join(lines[:face] + lines[face + 1 :])))


def strip_of(width: float) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return the box with a slot across its top, from one side to the other."""
    vertices = np.array(
        [[x, y, 0.0] for x in (0.0, 10.0) for y in (0.0, 5.0 - width / 2, 5.0 + width / 2, 10.0)]
    )
    faces = np.array([[0, 4, 5], [0, 5, 1], [2, 6, 7], [2, 7, 3]], np.int32)
    return vertices, faces


def test_a_gap_is_as_wide_as_it_is() -> None:
    closed = np.array(TRIANGLES, np.int32)
    assert widest_gap(BOX, closed, 0.1) == 0.0
    assert widest_gap(BOX, closed[:-2], 0.1) == 100.0  # a face of 100 x 60 is missing
    assert 30.0 <= widest_gap(BOX, closed[:-1], 0.1) <= 60.0  # half of it
    vertices, faces = strip_of(0.01)
    assert widest_gap(vertices, faces, 0.1) == np.inf  # beyond the slot is nothing at all
    assert examine_topology(vertices, faces).n_open_edges == 8


def test_a_gap_narrower_than_the_tolerance_is_found_so() -> None:
    """A lid of which a sliver across is missing: its ends are short, its sides face each other."""
    width = 0.004
    rows = (0.0, 30.0 - width / 2, 30.0 + width / 2, 60.0)
    lid = np.array([[x, y, 40.0] for x in (0.0, 100.0) for y in rows])
    vertices = np.concatenate([BOX, lid])
    walls = [face for face in QUADS if face != [1, 5, 7, 3]]
    sides = [[8, 12, 13, 9], [10, 14, 15, 11]]
    corners = {8: 1, 12: 5, 15: 7, 11: 3}
    sides = [[corners.get(corner, corner) for corner in side] for side in sides]
    walls = [*[face for face in walls if face not in ([0, 1, 3, 2], [4, 6, 7, 5])],
             [0, 1, 9, 10, 3, 2], [4, 6, 7, 14, 13, 5]]  # fmt: skip
    faces = np.array(fan(walls + sides), np.int32)

    gap = widest_gap(vertices, faces, 0.1)

    assert examine_topology(vertices, faces).n_open_edges == 4
    assert gap == pytest.approx(width, rel=1e-6)


# --- 3MF --------------------------------------------------------------------------------------


def test_a_3mf_brings_its_unit_names_colours_and_places(tmp_path: Path) -> None:
    resources = (
        '<basematerials id="5"><base name="PLA" displaycolor="#FF000080"/></basematerials>'
        + OBJECT_3MF.replace("<object", '<object pid="5" pindex="0"')
        + '<object id="2" name="pair"><components><component objectid="1"/>'
        '<component objectid="1" transform="2 0 0 0 2 0 0 0 2 10 0 0"/></components></object>'
        + f'<object id="3" name="spare">{mesh_3mf(BOX, TRIANGLES)}</object>'
        + f'<object id="4" type="support">{mesh_3mf(BOX, TRIANGLES)}</object>'
    )
    # (x, y, z) goes to (-y, x, z) + (0, 0, 1): rows follow the point.
    build = '<item objectid="2" transform="0 1 0 -1 0 0 0 0 1 0 0 1"/><item objectid="4"/>'
    path = write(tmp_path / "a.3mf", package_3mf(model_3mf(resources, build, "inch")))

    cad = read_cad(path)

    assert (cad.unit, cad.unit_m, cad.up) == ("inch", 0.0254, "z")
    first, second = cad.parts
    x, y, z = BOX.T
    np.testing.assert_array_equal(first.vertices, np.column_stack([-y, x, z + 1]))
    np.testing.assert_array_equal(second.vertices, np.column_stack([-2 * y, 2 * x + 10, 2 * z + 1]))
    for part in cad.parts:
        assert (part.name, part.material) == ("box", "PLA")
        assert part.rgba == (1.0, 0.0, 0.0, 128 / 255)
    assert "1 of its objects are not in its build, first 'spare'" in cad.notes
    assert any("hold others up and are not read, first '4'" in note for note in cad.notes)


def test_a_3mf_that_unfolds_without_end_is_refused(tmp_path: Path) -> None:
    levels = "".join(
        f'<object id="{n}"><components><component objectid="{n - 1}"/>'
        f'<component objectid="{n - 1}"/></components></object>'
        for n in range(1, 40)
    )
    empty = '<object id="0"><components/></object>'
    path = write(
        tmp_path / "a.3mf", package_3mf(model_3mf(empty + levels, '<item objectid="39"/>'))
    )

    with pytest.raises(SceneError, match="it places more than 200,000 objects"):
        read_cad(path)


def test_iges_is_refused_with_what_to_export(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"a \.igs cannot be read \(IGES holds loose.*export STEP"):
        read_cad(write(tmp_path / "a.igs", "S      1"))


# --- Single precision -------------------------------------------------------------------------


def float_ply(vertices: NDArray[np.float64]) -> bytes:
    head = (
        f"ply\nformat binary_big_endian 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(TRIANGLES)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = b"".join(b"\3" + np.array(face, ">i4").tobytes() for face in TRIANGLES)
    return head.encode() + vertices.astype(">f4").tobytes() + rows


def float_glb(vertices: NDArray[np.float64]) -> bytes:
    numbers = vertices.astype("<f4").tobytes() + np.array(TRIANGLES, "<u4").tobytes()
    views = [
        {"buffer": 0, "byteOffset": 0, "byteLength": 12 * len(vertices)},
        {"buffer": 0, "byteOffset": 12 * len(vertices), "byteLength": 12 * len(TRIANGLES)},
    ]
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": len(vertices), "type": "VEC3"},
        {"bufferView": 1, "componentType": 5125, "count": 3 * len(TRIANGLES), "type": "SCALAR"},
    ]
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(numbers)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "nodes": [{"mesh": 0, "scale": [3.0, 3.0, 3.0]}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    length = 28 + len(text) + len(numbers)
    head = struct.pack("<4sII", b"glTF", 2, length) + struct.pack("<I4s", len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(numbers), b"BIN\0") + numbers


SINGLE: dict[str, tuple[Callable[[NDArray[np.float64]], bytes], float]] = {
    "part.stl": (lambda vertices: binary_stl(vertices, TRIANGLES), 1.0),
    "part.ply": (float_ply, 1.0),
    "part.glb": (float_glb, 3.0),
}


@pytest.mark.parametrize("name", SINGLE)
@pytest.mark.parametrize("away", [(0.0, 0.0, 0.0), (5e6, -3e6, 4e6), (9e3, 1.0, 0.0)])
def test_corners_are_no_further_off_than_the_rounding_that_is_told(
    tmp_path: Path, name: str, away: tuple[float, float, float]
) -> None:
    writer, scale = SINGLE[name]
    worst = 0.0
    for k in range(1, 20):
        vertices = BOX * (0.9 + k / 97.0) + np.array(away) + k / 31.0

        (part,) = read_cad(write(tmp_path / f"{k}{name}", writer(vertices))).parts

        expected = scale * vertices[np.array(TRIANGLES)]
        off = np.linalg.norm(part.vertices[part.faces] - expected, axis=-1).max()
        assert off <= part.rounding * (1 + 1e-12)
        assert part.off_by_m == 0.0
        worst = max(worst, off / part.rounding)
    assert worst > 0.5


def test_digits_of_a_text_are_taken_at_their_word(tmp_path: Path) -> None:
    for name in ("text.stl", "plain.obj", "text.ply", "little.ply", "packed.3mf"):
        vertices = BOX + 5e6
        (part,) = read_cad(write(tmp_path / name, WRITERS[name][0](vertices, TRIANGLES))).parts

        np.testing.assert_array_equal(part.vertices[part.faces], vertices[np.array(TRIANGLES)])
        assert part.rounding == 0.0


@pytest.mark.parametrize(("away_mm", "is_coarse"), [(0.0, False), (60_000.0, False), (5e6, True)])
def test_the_rounding_of_a_file_is_part_of_its_error_where_it_matters(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, away_mm: float, is_coarse: bool
) -> None:
    write(tmp_path / "part.stl", binary_stl(BOX + np.array([away_mm, 0.0, 0.0]), TRIANGLES))
    text = (
        'format = "hybridve-scene"\nversion = 1\n[[object]]\nname = "box"\nmesh = "part.stl"\n'
        f'unit = "mm"\ntranslate_mm = [{-away_mm}, 0, 0]\n'
    )
    path = write(tmp_path / "scene.toml", text)

    (box,) = load_scene(path).objects

    told = [record.getMessage() for record in caplog.records if "precision" in record.message]
    assert len(told) == is_coarse
    if is_coarse:
        assert "object 'box'" in told[0]
        assert (
            "coordinates of up to 5,000 m in single precision are off by up to 0.25 mm" in told[0]
        )
    # Half of what lies between two numbers of 24 bits there, in metres.
    step_m = float(np.spacing(np.float32(away_mm + 100.0))) / 2 / 1000.0
    assert box.about["rounding_m"] == pytest.approx(step_m, rel=2e-2 if away_mm else 1.0)
    assert box.tessellation_error_m == (box.about["rounding_m"] if away_mm else 0.0)


# --- real files -------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.recording
def test_real_files_hold_what_independent_readers_find(recordings: Path) -> None:
    """Every STL, OBJ and PLY: vertices by VTK, area and count of triangles by trimesh or VTK."""
    import trimesh
    import vtk

    paths = sorted(
        path
        for path in (recordings / "meshes").rglob("*")
        if path.suffix.lower() in (".stl", ".obj", ".ply")
    )
    readers = {".stl": vtk.vtkSTLReader, ".obj": vtk.vtkOBJReader, ".ply": vtk.vtkPLYReader}
    assert len(paths) >= 30
    for path in paths:
        reader = readers[path.suffix.lower()]()
        reader.SetFileName(str(path))
        triangles = vtk.vtkTriangleFilter()
        triangles.SetInputConnection(reader.GetOutputPort())
        triangles.Update()
        measure = vtk.vtkMassProperties()
        measure.SetInputConnection(triangles.GetOutputPort())
        measure.Update()

        (part,) = read_cad(path, merge=True).parts

        a, b, c = (part.vertices[part.faces[:, corner]] for corner in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0
        assert area == pytest.approx(measure.GetSurfaceArea(), rel=1e-4), path  # single precision
        if path.suffix.lower() == ".stl":
            peer = trimesh.load_mesh(path, process=False)
            assert len(part.faces) == len(peer.faces), path
            assert area == pytest.approx(peer.area, rel=1e-9), path
        else:
            assert len(part.faces) == triangles.GetOutput().GetNumberOfPolys(), path
