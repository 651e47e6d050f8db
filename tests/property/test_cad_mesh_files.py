"""Every kind of CAD file: what was written comes back whole, and what is cut off does not pass."""

import os
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from helpers.mesh_files import WRITERS, dae, fbx_text, polylist_dae, text_fbx
from helpers.step_files import step_box, step_file
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError
from hybridve.hull.cad.mesh import CadFile, read_cad

Solid = tuple[NDArray[np.float64], list[list[int]], float, float]


@pytest.fixture(scope="module", autouse=True)
def _no_cache() -> Iterator[None]:
    """Read anew each time."""
    before = os.environ["HYBRIDVE_CACHE"]
    os.environ["HYBRIDVE_CACHE"] = "off"
    yield
    os.environ["HYBRIDVE_CACHE"] = before


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("files")


@st.composite
def prisms(draw: st.DrawFn) -> Solid:
    """Vertices, faces, area and volume of a prism on a polygon: a skyline, or a star.

    Its two ends are polygons of up to 26 corners, concave ones and with corners on their edges, its
    sides quadrilaterals.
    """
    if draw(st.booleans()):
        heights = draw(st.lists(st.integers(1, 5), min_size=1, max_size=6))
        outline = [(0.0, 0.0), (float(len(heights)), 0.0)]
        for k in range(len(heights) - 1, -1, -1):
            outline += [(k + 1.0, float(heights[k])), (float(k), float(heights[k]))]
        outline = [p for k, p in enumerate(outline) if p != outline[k - 1]]
    else:
        radii = draw(st.lists(st.floats(0.3, 2.0), min_size=5, max_size=12))
        angles = 2 * np.pi * np.arange(len(radii)) / len(radii)
        outline = [(r * np.cos(a), r * np.sin(a)) for r, a in zip(radii, angles, strict=True)]
    height = draw(st.floats(0.2, 3.0))
    flat = np.array(outline)
    n = len(flat)
    x, y = flat.T
    base = float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) / 2.0
    rim = float(np.linalg.norm(flat - np.roll(flat, -1, axis=0), axis=1).sum())
    vertices = np.concatenate(
        [np.column_stack([flat, np.full(n, level)]) for level in (0.0, height)]
    )
    quaternion = np.array(draw(st.tuples(*[st.integers(-3, 3)] * 4).filter(any)), np.float64)
    vertices = vertices @ _rotation(quaternion).T + np.array(
        draw(st.tuples(*[st.integers(-5, 5)] * 3))
    )
    faces = [list(range(n))[::-1], list(range(n, 2 * n))]
    faces += [[k, (k + 1) % n, n + (k + 1) % n, n + k] for k in range(n)]
    return vertices, faces, 2 * base + rim * height, base * height


def _rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    w, v = quaternion[0], quaternion[1:]
    across = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    square = float(quaternion @ quaternion)
    return np.asarray(np.eye(3) + 2.0 * (w * across + across @ across) / square)


def ears(vertices: NDArray[np.float64], faces: list[list[int]]) -> list[list[int]]:
    """Return triangles of polygons, by clipping any ear: slow, plain, and not the project's."""
    triangles = []
    for face in faces:
        ring = list(face)
        points = vertices[ring] - vertices[ring[0]]
        normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
        normal /= np.linalg.norm(normal)
        while len(ring) > 3:
            best = max(range(len(ring)), key=lambda k: _ear_quality(vertices, ring, normal, k))
            triangles.append([ring[best - 1], ring[best], ring[(best + 1) % len(ring)]])
            del ring[best]
        triangles.append(ring)
    return triangles


def _ear_quality(
    vertices: NDArray[np.float64], ring: list[int], normal: NDArray[np.float64], k: int
) -> float:
    """Return the area of an ear, or how deep another corner is in it, negative."""
    a, b, c = (vertices[ring[(k + step) % len(ring)]] for step in (-1, 0, 1))
    area = float(np.cross(b - a, c - a) @ normal)
    if area <= 0:
        return -10.0
    for other in ring:
        p = vertices[other]
        if min(np.linalg.norm(p - q) for q in (a, b, c)) > 1e-9:
            sides = [float(np.cross(v - u, p - u) @ normal) for u, v in ((a, b), (b, c), (c, a))]
            if min(sides) > -1e-9:
                return -1.0 - min(sides)
    return area


def measured(cad: CadFile) -> tuple[int, float, float | None]:
    """Return the triangles of a file, their area and the volume they enclose, in metres if any."""
    unit = cad.unit_m or 1.0
    n, area, volume = 0, 0.0, 0.0
    for part, topology in zip(cad.parts, cad.topologies, strict=True):
        a, b, c = (part.vertices[part.faces[:, corner]] for corner in range(3))
        n += len(part.faces)
        area += float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2.0 * unit**2
        volume = np.nan if topology.volume is None else volume + topology.volume * unit**3
    return n, area, None if np.isnan(volume) else volume


@pytest.mark.parametrize("name", WRITERS)
@given(solid=prisms())
@settings(max_examples=asked(25))
def test_a_solid_comes_back_whole_from_every_kind_of_file(
    folder: Path, name: str, solid: Solid
) -> None:
    vertices, faces, area, volume = solid
    write, takes_polygons = WRITERS[name]
    faces = faces if takes_polygons else ears(vertices, faces)
    path = folder / name
    path.write_bytes(write(vertices, faces))

    n_found, area_found, volume_found = measured(read_cad(path))

    assert n_found == sum(len(face) - 2 for face in faces)
    assert area_found == pytest.approx(area, rel=1e-5)  # single precision in binary STL
    assert volume_found == pytest.approx(volume, rel=1e-4)


#: A tetrahedron and a pyramid beside it: three kinds of polygons, one concave.
VERTICES = np.array(
    [
        *[(0.0, 0, 0), (2, 0, 0), (0, 2, 0), (0, 0, 2)],
        *[(10.25, 0, 0), (14, 0, 0), (14, 4, 0), (12, 1, 0), (10, 4, 0), (12, 0.5, 3)],
    ]
)
FACES = [
    *[[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]],
    *[[8, 7, 6, 5, 4], [4, 5, 9], [5, 6, 9], [6, 7, 9], [7, 8, 9], [8, 4, 9]],
]


@pytest.mark.parametrize("name", [name for name in WRITERS if not name.endswith(".obj")])
@given(data=st.data())
@settings(max_examples=asked(100))
def test_a_file_cut_off_reads_the_same_or_is_refused(
    folder: Path, name: str, data: st.DataObject
) -> None:
    write, takes_polygons = WRITERS[name]
    content = write(VERTICES, FACES if takes_polygons else ears(VERTICES, FACES))
    path = folder / name
    path.write_bytes(content)
    whole = measured(read_cad(path))
    path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])

    try:
        cad = read_cad(path)
    except SceneError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert measured(cad) == whole


@pytest.mark.parametrize("name", ["plain.obj", "relative.obj"])
@given(data=st.data())
@settings(max_examples=asked(150))
def test_an_obj_cut_off_is_refused_or_said_to_be_open(
    folder: Path, name: str, data: st.DataObject
) -> None:
    """It has no count and no end: cut at the end of a line it is an OBJ of fewer faces.

    Only where a closed part ends, and nothing of the next has begun, nobody can know.
    """
    content = WRITERS[name][0](VERTICES, FACES)
    path = folder / name
    path.write_bytes(content)
    whole = measured(read_cad(path))
    path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])

    try:
        cad = read_cad(path)
    except SceneError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        found = measured(cad)
        assert found == whole or found[0] == 4 or any("open edges" in note for note in cad.notes)


@pytest.mark.slow
@given(data=st.data())
@settings(max_examples=asked(8))
def test_a_step_file_cut_off_reads_the_same_or_is_refused(
    folder: Path, data: st.DataObject
) -> None:
    content = step_file(step_box, "mm", (1.0, 2.0, 3.0)).encode()
    path = folder / "box.step"
    path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])

    try:
        cad = read_cad(path)
    except SceneError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert measured(cad)[0] == 12
        assert measured(cad)[1] == pytest.approx(22e-6, rel=1e-6)


@given(data=st.data(), name=st.sampled_from(sorted(WRITERS)))
@settings(max_examples=asked(300))
def test_bytes_that_change_never_crash_a_reader(
    folder: Path, data: st.DataObject, name: str
) -> None:
    write, takes_polygons = WRITERS[name]
    content = bytearray(write(VERTICES, FACES if takes_polygons else ears(VERTICES, FACES)))
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = folder / name
    path.write_bytes(bytes(content))

    try:
        with np.errstate(over="ignore"):  # areas of coordinates such as 1e200
            cad = read_cad(path)
    except SceneError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert all(np.isfinite(part.vertices).all() for part in cad.parts)


@given(
    size=st.integers(2, 5),
    has_hole=st.lists(st.booleans(), min_size=25, max_size=25),
    corners=st.lists(st.integers(3, 7), min_size=25, max_size=25),
    turn=st.floats(0, 6),
)
def test_holes_of_collada_polygons_are_left_out(
    folder: Path, size: int, has_hole: list[bool], corners: list[int], turn: float
) -> None:
    """A plate with round holes in a grid, of either sense of rotation; areas in closed form."""
    square = np.array([(0.0, 0, 0), (4, 0, 0), (4, 4, 0), (0, 4, 0)]) * size
    rings, area = [square], 16.0 * size * size
    for place in np.flatnonzero(has_hole[: size * size]).tolist():
        n = corners[place]
        angles = turn + np.arange(n) * 2 * np.pi / n
        ring = np.column_stack([np.cos(angles), np.sin(angles), angles * 0]) * 1.5
        ring += np.array([2 + 4 * (place % size), 2 + 4 * (place // size), 0])
        rings.append(ring if place % 2 else ring[::-1])
        area -= n / 2 * 1.5**2 * np.sin(2 * np.pi / n)
    starts = np.cumsum([0, *(len(ring) for ring in rings)])
    texts = [" ".join(map(str, range(a, b))) for a, b in pairwise(starts.tolist())]
    holes = "".join(f"<h>{text}</h>" for text in texts[1:])
    primitive = (
        '<polygons count="1"><input semantic="VERTEX" source="#v" offset="0"/>'
        f"<ph><p>{texts[0]}</p>{holes}</ph></polygons>"
    )
    path = folder / "plate.dae"
    path.write_bytes(dae(np.concatenate(rings), primitive))

    cad = read_cad(path)

    (part,) = cad.parts
    a, b, c = (part.vertices[part.faces[:, corner]] for corner in range(3))
    areas = np.cross(b - a, c - a)[:, 2] / 2.0
    assert (areas >= -1e-12).all()
    assert areas.sum() == pytest.approx(area, rel=1e-12)
    (topology,) = cad.topologies
    assert topology.n_open_edges >= sum(len(ring) for ring in rings) - 2 * topology.n_zero_area


VECTOR = st.tuples(*[st.floats(-3, 3, width=32)] * 3)
TURN = st.tuples(*[st.floats(-180, 180, width=32)] * 3)


@st.composite
def fbx_properties(draw: st.DrawFn, *, even: bool) -> str:
    """Text of the properties that place a model, in any of the six orders of rotation."""
    factors = [draw(st.floats(0.5, 2.0))] * 3
    if not even:
        factors = draw(st.lists(st.sampled_from([-2.0, -0.5, 0.5, 1.5]), min_size=3, max_size=3))
    vectors = {"Lcl Translation": draw(VECTOR), "Lcl Rotation": draw(TURN), "Lcl Scaling": factors}
    for name in ("RotationOffset", "RotationPivot", "ScalingOffset", "ScalingPivot"):
        vectors[name] = draw(VECTOR)
    for name in ("PreRotation", "PostRotation"):
        vectors[name] = draw(TURN)
    return (
        'P: "RotationActive", "bool", "", "",1\nP: "InheritType", "enum", "", "",1\n'
        f'P: "RotationOrder", "enum", "", "",{draw(st.integers(0, 5))}\n'
    ) + "\n".join(
        f'P: "{name}", "{name if name.startswith("Lcl") else "Vector3D"}", "", "A",'
        + ",".join(repr(float(value)) for value in values)
        for name, values in vectors.items()
    )


@given(inner=fbx_properties(even=False), outer=fbx_properties(even=True))
@settings(max_examples=asked(30))
def test_assimp_places_fbx_models_where_we_do(folder: Path, inner: str, outer: str) -> None:
    """Open3D reads triangles through assimp, in single precision, and y up."""
    import open3d

    content = fbx_text(
        VERTICES,
        ears(VERTICES, FACES),
        inner,
        objects=f'Model: 33, "Model::up", "Null" {{\nProperties70: {{\n{outer}\n}}\n}}',
        connections='C: "OO",33,0',
    ).replace(b'"OO",22,0', b'"OO",22,33')
    path = folder / "placed.fbx"
    path.write_bytes(content)

    (part,) = read_cad(path).parts
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        theirs = open3d.io.read_triangle_mesh(path)

    corners = part.vertices[part.faces]
    peer = (np.asarray(theirs.vertices)[np.asarray(theirs.triangles)])[:, :, [0, 2, 1]]
    peer = peer * np.array([1.0, -1.0, 1.0])
    # It turns mirrored triangles over elsewhere than we do, so corners are compared as sets.
    reach = float(np.abs(corners).max())
    for corner in corners.reshape(-1, 3):
        assert np.abs(peer.reshape(-1, 3) - corner).max(axis=1).min() < 2e-5 * reach
    assert len(peer) == len(corners)


@pytest.mark.slow
def test_pycollada_and_open3d_count_what_we_count_of_what_they_read(folder: Path) -> None:
    """Triangles alone: what they make of other polygons is what they are not asked for."""
    import collada
    import open3d

    triangles = ears(VERTICES, FACES)
    (folder / "t.dae").write_bytes(polylist_dae(VERTICES, triangles))
    (folder / "t.fbx").write_bytes(text_fbx(VERTICES, triangles))

    (primitive,) = collada.Collada(str(folder / "t.dae")).geometries[0].primitives
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        mesh = open3d.io.read_triangle_mesh(folder / "t.fbx")

    assert len(primitive.triangleset()) == measured(read_cad(folder / "t.dae"))[0]
    assert len(mesh.triangles) == measured(read_cad(folder / "t.fbx"))[0]
    assert mesh.get_surface_area() == pytest.approx(measured(read_cad(folder / "t.fbx"))[1])
