"""Meshes of polygons written as every kind of CAD file, by another hand than the readers'."""

import io
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Polygons = Sequence[Sequence[int]]


def fan(polygons: Polygons) -> list[tuple[int, int, int]]:
    """Return triangles of convex polygons."""
    return [(p[0], p[k], p[k + 1]) for p in polygons for k in range(1, len(p) - 1)]


def _words(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def text_stl(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    facets = "".join(
        "facet normal 0 0 0\n outer loop\n"
        + "".join(f"  vertex {_words(vertices[corner])}\n" for corner in polygon)
        + " endloop\nendfacet\n"
        for polygon in polygons
    )
    return f"solid part\n{facets}endsolid part\n".encode()


def binary_stl(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    """Polygons must be triangles."""
    records = np.zeros(len(polygons), [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    records["v"] = vertices[np.array(polygons)]
    return b"solid, says the head".ljust(80) + struct.pack("<I", len(polygons)) + records.tobytes()


def obj(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    lines = [f"v {_words(vertex)}" for vertex in vertices]
    lines += ["f " + " ".join(str(corner + 1) for corner in polygon) for polygon in polygons]
    return ("# a mesh\n" + "\n".join(lines) + "\n").encode()


def relative_obj(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    """Vertices stand before the face that uses them; corners count backwards and lines go on."""
    text, last = "\ufeff", 0
    for polygon in polygons:
        text += "".join(f"v {_words(vertices[corner])} 0.1 0.2 0.3\n" for corner in polygon)
        text += "f " + " \\\n".join(f"{-k}//" for k in range(len(polygon), 0, -1)) + "\n"
        last += len(polygon)
    return text.encode()


def off(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    lines = ["OFF # by hand", "", f"{len(vertices)} {len(polygons)} 0"]
    lines += [_words(vertex) for vertex in vertices]
    lines += [f"{len(polygon)} " + " ".join(map(str, polygon)) for polygon in polygons]
    return ("\n".join(lines) + "\n").encode()


def coloured_off(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    lines = [f"CNOFF {len(vertices)} {len(polygons)}"]
    lines += [_words(vertex) + " 0 0 1 255 0 0 255" for vertex in vertices]
    lines += [f"{len(polygon)} " + " ".join(map(str, polygon)) + " 0.5 1 1" for polygon in polygons]
    return ("\r\n".join(lines) + "\r\n").encode()


def _ply_head(kind: str, n_vertices: int, n_faces: int, real: str) -> bytes:
    return (
        f"ply\nformat {kind} 1.0\ncomment by hand\nelement vertex {n_vertices}\n"
        f"property {real} x\nproperty {real} y\nproperty uchar red\nproperty {real} z\n"
        f"element face {n_faces}\nproperty int flags\nproperty list uchar float texcoord\n"
        "property list ushort int vertex_indices\nend_header\n"
    ).encode()


def text_ply(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    lines = [f"{_words((x, y))} 7 {_words((z,))}" for x, y, z in vertices]
    lines += [
        f"1 {k % 3} " + "0.5 " * (k % 3) + f"{len(p)} " + " ".join(map(str, p))
        for k, p in enumerate(polygons)
    ]
    return (
        _ply_head("ascii", len(vertices), len(polygons), "double")
        + ("\n".join(lines) + "\n").encode()
    )


def _binary_ply(vertices: NDArray[np.float64], polygons: Polygons, order: str, kind: str) -> bytes:
    rows = [struct.pack(order + "2dBd", x, y, 7, z) for x, y, z in vertices]
    rows += [
        struct.pack(f"{order}iB{k % 3}fH{len(p)}i", 1, k % 3, *[0.5] * (k % 3), len(p), *p)
        for k, p in enumerate(polygons)
    ]
    return _ply_head(kind, len(vertices), len(polygons), "float64") + b"".join(rows)


def little_ply(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    return _binary_ply(vertices, polygons, "<", "binary_little_endian")


def big_ply(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    return _binary_ply(vertices, polygons, ">", "binary_big_endian")


def strip_ply(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    """Polygons must be triangles; each is a strip."""
    strip = [corner for triangle in polygons for corner in (*triangle, -1)]
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property double x\nproperty double y\nproperty double z\nelement tristrips 1\n"
        "property list int int vertex_indices\nend_header\n"
    )
    rows = vertices.astype("<f8").tobytes() + struct.pack(f"<i{len(strip)}i", len(strip), *strip)
    return head.encode() + rows


_DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="meter" meter="1"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="{count}">{numbers}</float_array><technique_common>
<accessor source="#pa" count="{n_vertices}" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
{primitive}
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="n"><instance_geometry url="#g"/></node>
</visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>
"""
_INPUTS = '<input semantic="VERTEX" source="#v" offset="0"/>'


def dae(vertices: NDArray[np.float64], primitive: str) -> bytes:
    """Return a COLLADA file of one primitive element."""
    return _DAE.format(
        count=vertices.size,
        numbers=_words(vertices.ravel().tolist()),
        n_vertices=len(vertices),
        primitive=primitive,
    ).encode()


def polylist_dae(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    counts = " ".join(str(len(polygon)) for polygon in polygons)
    corners = " ".join(f"{corner} 0" for polygon in polygons for corner in polygon)
    inputs = _INPUTS + '<input semantic="NORMAL" source="#p" offset="1"/>'
    return dae(
        vertices,
        f'<polylist count="{len(polygons)}">{inputs}<vcount>{counts}</vcount><p>{corners}</p>'
        "</polylist>",
    )


def polygons_dae(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    rings = "".join(f"<p>{' '.join(map(str, polygon))}</p>" for polygon in polygons)
    return dae(vertices, f'<polygons count="{len(polygons)}">{_INPUTS}{rings}</polygons>')


def fbx_text(
    vertices: NDArray[np.float64],
    polygons: Polygons,
    properties: str = "",
    settings: str = "",
    objects: str = "",
    connections: str = "",
) -> bytes:
    """Return a text FBX of one model; more of its properties, objects and connections at wish."""
    corners = [
        corner if k < len(p) - 1 else -1 - corner for p in polygons for k, corner in enumerate(p)
    ]
    numbers = ",".join(repr(float(value)) for value in vertices.ravel())
    return f"""; FBX 7.4.0 project file
FBXHeaderExtension:  {{
	FBXVersion: 7400
	Creator: "tests; \u2713"
}}
GlobalSettings:  {{
	Properties70:  {{
		P: "UpAxis", "int", "Integer", "",2
		P: "UpAxisSign", "int", "Integer", "",1
		P: "FrontAxis", "int", "Integer", "",1
		P: "FrontAxisSign", "int", "Integer", "",-1
		P: "CoordAxis", "int", "Integer", "",0
		P: "CoordAxisSign", "int", "Integer", "",1
		P: "UnitScaleFactor", "double", "Number", "",100
		{settings}
	}}
}}
Objects:  {{
	Geometry: 11, "Geometry::", "Mesh" {{
		Vertices: *{vertices.size} {{
			a: {numbers}
		}}
		PolygonVertexIndex: *{len(corners)} {{
			a: {",".join(map(str, corners))}
		}}
	}}
	Model: 22, "Model::part", "Mesh" {{
		Properties70:  {{
			{properties}
		}}
		Shading: Y
		Culling: "CullingOff"
	}}
	{objects}
}}
Connections:  {{
	;Model::part, Model::RootNode
	C: "OO",22,0
	C: "OO",11,22
	{connections}
}}
""".encode()


def text_fbx(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    return fbx_text(vertices, polygons)


def _fbx_value(value: Any, packed: bool) -> bytes:
    if isinstance(value, str):
        raw = value.encode()
        return b"S" + struct.pack("<I", len(raw)) + raw
    if isinstance(value, np.ndarray):
        kind = {"<f8": b"d", "<i4": b"i"}[value.dtype.str]
        raw = zlib.compress(value.tobytes()) if packed else value.tobytes()
        return kind + struct.pack("<III", value.size, int(packed), len(raw)) + raw
    if isinstance(value, float):
        return b"D" + struct.pack("<d", value)
    return b"I" + struct.pack("<i", value) if abs(value) < 10 else b"L" + struct.pack("<q", value)


def _fbx_node(node: tuple[Any, ...], place: int, lengths: str, packed: bool) -> bytes:
    name, values, children = node
    label: bytes = name.encode()
    data = b"".join(_fbx_value(value, packed) for value in values)
    head = struct.calcsize(lengths) + len(name)
    body = b""
    for child in children:
        body += _fbx_node(child, place + head + len(data) + len(body), lengths, packed)
    if children:
        body += b"\0" * struct.calcsize(lengths)
    end = place + head + len(data) + len(body)
    header = struct.pack(lengths, end, len(values), len(data), len(name))
    return header + label + data + body


def _binary_fbx(
    vertices: NDArray[np.float64], polygons: Polygons, version: int, packed: bool
) -> bytes:
    corners = [
        corner if k < len(p) - 1 else -1 - corner for p in polygons for k, corner in enumerate(p)
    ]
    axes = (("UpAxis", 2), ("FrontAxis", 1), ("FrontAxisSign", -1), ("CoordAxis", 0))
    settings = [("P", (name, "int", "Integer", "", value), ()) for name, value in axes]
    nodes = [
        ("FBXHeaderExtension", (), [("FBXVersion", (version,), ())]),
        ("GlobalSettings", (), [("Properties70", (), settings)]),
        (
            "Objects",
            (),
            [
                (
                    "Geometry",
                    (11, "\0\x01Geometry", "Mesh"),
                    [
                        ("Vertices", (vertices.astype("<f8").ravel(),), ()),
                        ("PolygonVertexIndex", (np.array(corners, "<i4"),), ()),
                    ],
                ),
                ("Model", (22, "part\0\x01Model", "Mesh"), ()),
            ],
        ),
        ("Connections", (), [("C", ("OO", 11, 22), ()), ("C", ("OO", 22, 0), ())]),
    ]
    lengths = "<QQQB" if version >= 7500 else "<IIIB"
    content = b"Kaydara FBX Binary  \0\x1a\0" + struct.pack("<I", version)
    for node in nodes:
        content += _fbx_node(node, len(content), lengths, packed)
    return content + b"\0" * struct.calcsize(lengths) + b"\xfa\xbc\xab\x09" + b"\0" * 40


def fbx_7400(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    return _binary_fbx(vertices, polygons, 7400, packed=True)


def fbx_7500(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    return _binary_fbx(vertices, polygons, 7500, packed=False)


_CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_RELATIONS = """<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">
<Relationship Target="/3D/3dmodel.model" Id="rel0"
 Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>
"""


def mesh_3mf(vertices: NDArray[np.float64], triangles: Polygons) -> str:
    """Return the element of a mesh."""
    points = "".join(f'<vertex x="{x!r}" y="{y!r}" z="{z!r}"/>\n' for x, y, z in vertices.tolist())
    corners = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>\n' for a, b, c in triangles)
    return f"<mesh><vertices>\n{points}</vertices>\n<triangles>\n{corners}</triangles></mesh>"


def model_3mf(resources: str, build: str, unit: str = "meter", head: str = "") -> str:
    """Return a model file."""
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<model unit="{unit}" xml:lang="en-US" '
        f'xmlns="{_CORE}" {head}>\n<metadata name="Application">tests</metadata>\n'
        f"<resources>\n{resources}\n</resources>\n<build>\n{build}\n</build></model>\n"
    )


def package_3mf(model: str, others: dict[str, str] | None = None, *, packed: bool = True) -> bytes:
    """Return a 3MF file of its model and other files."""
    content = io.BytesIO()
    kind = zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED
    with zipfile.ZipFile(content, "w", kind) as package:
        package.writestr("[Content_Types].xml", "<Types/>")
        package.writestr("_rels/.rels", _RELATIONS)
        package.writestr("3D/3dmodel.model", model)
        for name, text in (others or {}).items():
            package.writestr(name, text)
    return content.getvalue()


def packed_3mf(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    """Polygons must be triangles."""
    mesh = f'<object id="1" type="model">{mesh_3mf(vertices, polygons)}</object>'
    return package_3mf(model_3mf(mesh, '<item objectid="1"/>'))


def stored_3mf(vertices: NDArray[np.float64], polygons: Polygons) -> bytes:
    """Polygons must be triangles; they stand in another file, as a component that is turned."""
    production = "http://schemas.microsoft.com/3dmanufacturing/production/2015/06"
    component = (
        '<object id="8"><components><component objectid="1" p:path="/3D/Objects/o.model" '
        'transform="0 1 0 0 0 1 1 0 0 -1 2 -3"/></components></object>'
    )
    # A point goes round its axes in one, and back in the other.
    build = '<item objectid="8" transform="0 0 1 1 0 0 0 1 0 -2 3 1"/>'
    head = f'xmlns:p="{production}" requiredextensions="p"'
    mesh = f'<object id="1">{mesh_3mf(vertices, polygons)}</object>'
    other = model_3mf(mesh, "", head=head)
    model = model_3mf(component, build, head=head)
    return package_3mf(model, {"3D/Objects/o.model": other}, packed=False)


#: By a name that ends like the file's: how it writes, and whether it takes all polygons.
WRITERS: dict[str, tuple[Callable[[NDArray[np.float64], Polygons], bytes], bool]] = {
    "text.stl": (text_stl, True),
    "binary.stl": (binary_stl, False),
    "plain.obj": (obj, True),
    "relative.obj": (relative_obj, True),
    "plain.off": (off, True),
    "coloured.off": (coloured_off, True),
    "text.ply": (text_ply, True),
    "little.ply": (little_ply, True),
    "big.ply": (big_ply, True),
    "strips.ply": (strip_ply, False),
    "polylist.dae": (polylist_dae, True),
    "polygons.dae": (polygons_dae, True),
    "text.fbx": (text_fbx, True),
    "7400.fbx": (fbx_7400, True),
    "7500.fbx": (fbx_7500, True),
    "packed.3mf": (packed_3mf, False),
    "stored.3mf": (stored_3mf, False),
}
