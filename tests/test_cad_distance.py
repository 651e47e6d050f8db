"""What is inside a surface: shells in closed form, real CAD beside solid angles, and a room."""

from pathlib import Path

import numpy as np
import pytest
from helpers.hulls import ball_masks, ring_views
from numpy.typing import NDArray

from hybridve.calib.pose import rotation_about_axes
from hybridve.hull.cad.distance import SurfaceDistance
from hybridve.hull.cad.mesh import read_cad
from hybridve.hull.cad.part import join_meshes
from hybridve.hull.cad.scene import load_scene
from hybridve.hull.cad.topology import meeting_faces
from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import make_hull
from hybridve.hull.synth.meshes import box_mesh

Mesh = tuple[NDArray[np.float64], NDArray[np.int32]]


def box(half: float, x: float = 0.0) -> Mesh:
    mesh = box_mesh((2000 * half,) * 3, 1000.0 * half)
    return mesh.vertices_mm / 1000 + np.array([x, 0.0, 0.0]), mesh.faces.astype(np.int32)


def inverted(mesh: Mesh) -> Mesh:
    return mesh[0], np.ascontiguousarray(mesh[1][:, ::-1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shells", "winding", "signed_m"),
    [
        # at x = 0, 0.75, 1.25 and 3
        pytest.param([box(1.0)], [1, 1, 0, 0], [-1.0, -0.25, 0.25, 2.0], id="solid"),
        pytest.param([inverted(box(1.0))], [-1, -1, 0, 0], [-1.0, -0.25, 0.25, 2.0], id="inverted"),
        pytest.param(
            [box(1.0), inverted(box(0.5))], [0, 1, 0, 0], [0.5, -0.25, 0.25, 2.0], id="cavity"
        ),
        pytest.param(
            [box(1.0), box(0.5)], [2, 1, 0, 0], [-0.5, -0.25, 0.25, 2.0], id="nested shells"
        ),
        pytest.param(
            [box(1.0), box(1.0, 0.5)], [2, 2, 1, 0], [-0.5, -0.25, -0.25, 1.5], id="overlapping"
        ),
        pytest.param(
            [box(2.0), inverted(box(1.0)), box(0.5)],
            [1, 0, 1, 0],
            [-0.5, 0.25, -0.25, 1.0],
            id="solid in a cavity",
        ),
    ],
)
def test_inside_is_where_the_surface_goes_round(
    shells: list[Mesh], winding: list[int], signed_m: list[float]
) -> None:
    surface = SurfaceDistance(*join_meshes(shells), is_closed=True)
    points = np.array([[0.0, 0, 0], [0.75, 0, 0], [1.25, 0, 0], [3.0, 0, 0]])

    assert surface.winding(points).tolist() == winding
    np.testing.assert_allclose(surface.signed(points)[0], signed_m, rtol=1e-15)


def test_a_surface_that_is_not_closed_has_no_inside() -> None:
    vertices, faces = box(1.0)
    flipped = faces.copy()
    flipped[0] = flipped[0, ::-1]

    opened = SurfaceDistance(vertices, faces[1:], is_closed=False)

    assert opened.signed(np.zeros((1, 3)))[0] == 1.0
    with pytest.raises(ValueError, match="not closed"):
        opened.winding(np.zeros((1, 3)))
    for wrong in (faces[1:], flipped):
        with pytest.raises(ValueError, match="said to be closed"):
            SurfaceDistance(vertices, wrong, is_closed=True)


def test_a_hair_beneath_the_surface_is_inside() -> None:
    """The next number on either side of a face, far below what a distance may be off by."""
    surface = SurfaceDistance(*box(1.0), is_closed=True)
    for axis in range(3):
        for face in (-1.0, 1.0):
            points = np.array([[0.1, 0.2, 0.3]] * 2)
            points[:, axis] = np.nextafter(face, [0.0, 2.0 * face])

            assert surface.winding(points).tolist() == [1, 0]
            signed_m = surface.signed(points)[0]
            assert signed_m[0] < 0 < signed_m[1]


@pytest.mark.parametrize("turn", [False, True])
def test_what_meets_in_the_file_meets_wherever_the_part_stands(turn: bool) -> None:
    """Noise of the last bit, and a needle in a face: neither is a hole to look through."""
    vertices, faces = box(0.5)
    corners = vertices[faces].reshape(-1, 3)
    rng = np.random.default_rng(0)
    corners += rng.choice([0.0, 2.0**-24], corners.shape)
    needle = np.array([[-0.5, -0.5, -0.5], [0.0, 0.0, 0.0], [0.25, 0.25, 0.25]])
    corners = np.concatenate([corners, needle])
    faces = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    solid_faces = meeting_faces(corners, faces)
    assert solid_faces is not None
    assert len(set(solid_faces[-1].tolist())) == 1
    rotation = rotation_about_axes((10.0, 20.0, 30.0)) if turn else np.eye(3)

    surface = SurfaceDistance(corners @ rotation.T, faces, is_closed=True, solid_faces=solid_faces)

    assert 0 < surface.apart_m <= 3.0 * 2.0**-24
    points = rng.uniform(-0.75, 0.75, (20_000, 3))
    is_clear = np.abs(np.abs(points).max(axis=1) - 0.5) > 2.0**-20
    inside = np.abs(points).max(axis=1) < 0.5
    found = surface.signed(points @ rotation.T)[0] < 0
    np.testing.assert_array_equal(found[is_clear], inside[is_clear])
    with pytest.raises(ValueError, match="said to be closed"):
        SurfaceDistance(corners[:-3] + 1e-6 * corners[:-3] ** 2, faces[:-2], is_closed=True)


def test_bounds_hold_for_the_solid_whose_corners_meet() -> None:
    """A box 300 m from its file's origin, in single precision: its corners are 50 um apart."""
    rng = np.random.default_rng(3)
    offset = np.array([300.0, -300.0, 300.0])
    vertices, faces = box(0.15)
    corners = vertices[faces].reshape(-1, 3) + offset
    corners += rng.choice([0.0, 0.9 * 2.0**-15], corners.shape)
    faces = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    solid_faces = meeting_faces(corners, faces)
    assert solid_faces is not None
    corners -= offset
    views = ring_views(6)
    meter = ClearanceMeter(
        corners, faces, is_closed=True, solid_faces=solid_faces, tolerance_m=1e-6
    )
    solid = SurfaceDistance(corners, solid_faces, is_closed=True)
    assert 1e-5 < meter.error_m < 1e-4
    n_asked = 0
    for x in (0.2, 0.22, 0.3):
        center = np.array([x, 0.03, 0.02])
        hull = make_hull(views, ball_masks(views, center, 0.06))

        found = meter.measure(hull)

        near, far = found.signed_m
        assert near <= solid.signed(found.on_hull_world[None])[0][0] <= far
        points = found.on_hull_world + 10.0 ** rng.uniform(-6, -2, (4000, 1)) * rng.normal(
            size=(4000, 3)
        )
        points = points[contains_points(hull, points)]
        assert solid.signed(points)[0].min() >= near
        n_asked += len(points)
    assert n_asked > 2000


def test_two_solids_in_one_file_are_solid_where_they_overlap(tmp_path: Path) -> None:
    """A bar along x and one along y, 20 mm higher; a ball of 30 mm in both: 90 mm deep, not free.

    The ball reaches the height halfway between the lower face of the one and the upper of the
    other, 180 mm apart.
    """
    along_x = box_mesh((600.0, 200.0, 200.0), 1000.0)
    along_y = box_mesh((200.0, 600.0, 200.0), 1000.0)
    rows = []
    for mesh, height in ((along_x, 0.0), (along_y, 20.0)):
        for triangle in mesh.vertices_mm[mesh.faces] + [0.0, 0.0, height]:
            corners = "\n".join(f"vertex {x} {y} {z}" for x, y, z in triangle.tolist())
            rows.append(f"facet normal 0 0 0\nouter loop\n{corners}\nendloop\nendfacet")
    (tmp_path / "bars.stl").write_text("\n".join(["solid bars", *rows, "endsolid bars"]))
    (tmp_path / "scene.toml").write_text(
        'format = "hybridve-scene"\nversion = 1\n'
        '[[object]]\nname = "bars"\nmesh = "bars.stl"\nunit = "mm"\n'
    )
    (bars,) = load_scene(tmp_path / "scene.toml").objects
    assert bars.is_closed
    meter = ClearanceMeter(
        bars.vertices_world, bars.faces, is_closed=True, solid_faces=bars.solid_faces
    )
    views = ring_views(6)

    found = meter.measure(make_hull(views, ball_masks(views, np.zeros(3), 0.03)))

    assert (found.lower_m, found.upper_m) == (0, 0)
    assert found.depth_lower_m <= 0.09 <= found.depth_upper_m
    assert found.depth_upper_m - found.depth_lower_m < 2e-3


def closed_parts(folder: Path) -> list[tuple[str, Mesh, NDArray[np.int32]]]:
    """Return names, meshes sized to a metre, and what meets, of the closed parts in a folder."""
    found = []
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() not in (".stl", ".ply", ".obj"):
            continue
        cad = read_cad(path)
        for part, topology in zip(cad.parts, cad.topologies, strict=True):
            if topology.closed:
                vertices = part.vertices - part.vertices.mean(axis=0)
                vertices /= np.ptp(vertices, axis=0).max()
                meets = meeting_faces(part.vertices, part.faces)
                assert meets is not None
                found.append((f"{path.name} {part.name}", (vertices, part.faces), meets))
    return found


@pytest.mark.slow
@pytest.mark.recording
def test_real_parts_have_the_sides_that_solid_angles_have(recordings: Path) -> None:
    """Thousands of points in, about and a hair from all closed parts, none on the wrong side."""
    import igl

    rng = np.random.default_rng(1)
    n_parts = n_points = n_inside = 0
    for name, (vertices, faces), meets in closed_parts(recordings / "meshes"):
        surface = SurfaceDistance(vertices, faces, is_closed=True, solid_faces=meets)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        anywhere = rng.uniform(low - 0.05, high + 0.05, (100, 3))
        corners = vertices[faces[rng.integers(len(faces), size=100)]]
        on_it = (rng.dirichlet(np.ones(3), 100)[:, None] @ corners)[:, 0]
        points = np.concatenate(
            [anywhere, on_it + 10.0 ** rng.uniform(-9, -1, (100, 1)) * rng.normal(size=(100, 3))]
        )
        distance_m, _, _ = surface.closest(points)
        points = points[distance_m > 1e-11 + surface.apart_m]  # nearer, angles are not to be had

        turns = igl.winding_number(vertices, meets.astype(np.int64), points)
        found = surface.winding(points)

        assert np.abs(turns - np.round(turns)).max() < 1e-3
        np.testing.assert_array_equal(found, np.round(turns), name)
        np.testing.assert_array_equal(surface.signed(points)[0] < 0, found != 0)
        n_parts, n_points = n_parts + 1, n_points + len(points)
        n_inside += int((found != 0).sum())
    assert n_parts > 25
    assert n_points > 5000
    assert n_inside > 1000


@pytest.mark.recording
@pytest.mark.parametrize("name", ["ur5/ur5_wrist3.stl", "parts/box.STL", "prusa/x-carriage.stl"])
def test_a_hull_wholly_inside_a_part_is_in_it(recordings: Path, name: str) -> None:
    """A ball in the middle of the material, where its sides have most room."""
    (part,) = read_cad(recordings / "meshes" / name).parts
    rng = np.random.default_rng(4)
    views = ring_views(6)
    vertices = part.vertices - part.vertices.mean(axis=0)
    vertices *= 2.0 / np.ptp(vertices, axis=0).max()
    surface = SurfaceDistance(vertices, part.faces, is_closed=True)
    points = rng.uniform(vertices.min(axis=0), vertices.max(axis=0), (5000, 3))
    signed_m, _ = surface.signed(points)
    n_measured = 0
    for deepest in np.argsort(signed_m)[:4]:
        depth_m = -signed_m[deepest]
        assert surface.winding(points[deepest][None]) == 1
        meter = ClearanceMeter(vertices - points[deepest], part.faces, is_closed=True)
        hull = make_hull(views, ball_masks(views, np.zeros(3), 0.3 * depth_m))
        if not contains_points(hull, np.zeros((1, 3)))[0]:
            continue  # the ball is smaller than a pixel

        found = meter.measure(hull)

        assert (found.lower_m, found.upper_m) == (0, 0)
        assert found.depth_upper_m >= depth_m
        assert found.depth_lower_m > 0.9 * depth_m
        n_measured += 1
    assert n_measured > 0


@pytest.mark.recording
def test_what_is_in_a_room_of_a_box_is_outside_of_it(recordings: Path) -> None:
    """An empty tin box, in inches: its room is no solid, its walls are."""
    (part,) = read_cad(recordings / "meshes" / "parts" / "box.STL").parts
    vertices = 0.0254 * part.vertices
    surface = SurfaceDistance(vertices, part.faces, is_closed=True)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    points = np.random.default_rng(2).uniform(low, high, (50_000, 3))
    signed_m, _ = surface.signed(points)
    in_room = points[np.argmax(signed_m)]
    assert signed_m.max() > 0.03
    assert -0.01 < signed_m.min() < 0
    views = ring_views(6)
    meter = ClearanceMeter(vertices - in_room, part.faces, is_closed=True)

    found = meter.measure(make_hull(views, ball_masks(views, np.zeros(3), 0.01)))

    assert found.lower_m > 0.01
    assert found.depth_upper_m == 0
