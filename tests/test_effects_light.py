"""Light and shadow: solid angles and projected areas in closed form, and what must always hold."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.effects import CUBE, cube, empty_hull, entry_of, floor, held, setting_of
from helpers.hulls import ball_hull, look_at, projection, ring_views
from helpers.response import box_vertices, polyhedron_masks
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError
from hybridve.hull.cad.scene import Scene, SceneObject
from hybridve.hull.effects.kinds import read_entries
from hybridve.hull.effects.lamp import points_on_ball, small_triangles
from hybridve.hull.effects.light import Light
from hybridve.hull.effects.shadow import Shadow
from hybridve.hull.query.silhouettes import Hull, Views, make_hull, make_views
from hybridve.hull.query.threads import Threads
from hybridve.hull.query.viewport import n_samples, sample_positions
from hybridve.hull.query.walk import spans_of_rays

VIEWS = ring_views(4)
EMPTY = empty_hull(VIEWS)
COARSE = ring_views(4, width=240, height=162, focal_px=233.0)


def square_views() -> Views:
    """Return cameras a kilometre away that look along the axes: their hull of a box is the box.

    A pixel covers a millimetre; edges at whole millimetres lie on edges of pixels.
    """
    matrices = []
    for center in np.eye(3) * 1000.0:
        matrices.append(projection(look_at(center, np.zeros(3)), 1e6, 800, 800))
    return make_views(tuple("xyz"), np.array([[800, 800]] * 3), np.array(matrices))


def box_hull(views: Views, half_m: tuple[float, ...], center: tuple[float, ...]) -> Hull:
    return make_hull(
        views,
        polyhedron_masks(views, box_vertices(np.array(half_m), np.eye(3), np.array(center))),
    )


def told(effect: Light | Shadow, hull: Hull) -> dict[str, NDArray[Any]]:
    effect.advance(held(hull), 0.02)
    return dict(effect.values(hull)["it"])


def light(
    *objects: SceneObject, views: Views = VIEWS, viewport: int = 10, threads: int = 1, **keys: Any
) -> Light:
    entry = entry_of("light", **{"lamp_mm": [0, 0, 1000], "intensity_cd": 100.0, **keys})
    return Light([entry], setting_of(views, *objects, viewport=viewport), Threads(threads))


def shadow(*objects: SceneObject, views: Views = VIEWS, viewport: int = 10, **keys: Any) -> Shadow:
    entry = entry_of("shadow", **{"lamp_mm": [0, 0, 1000], **keys})
    return Shadow([entry], setting_of(views, *objects, viewport=viewport), Threads(1))


def solid_angles(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the solid angles of triangles (T, 3, 3) from the origin (Van Oosterom, Strackee)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    triple = np.abs((a * np.cross(b, c)).sum(axis=1))
    below = la * lb * lc + (a * b).sum(1) * lc + (a * c).sum(1) * lb + (b * c).sum(1) * la
    return np.asarray(2.0 * np.arctan2(triple, below))


def cast(
    corners_world: NDArray[np.float64], lamp: NDArray[np.float64], z_m: float
) -> NDArray[np.float64]:
    """Return where lines from a lamp through points meet a level, (N, 2)."""
    share = (z_m - lamp[2]) / (corners_world[:, 2] - lamp[2])
    return np.asarray(lamp[:2] + share[:, None] * (corners_world[:, :2] - lamp[:2]))


def area_of_outline(points: NDArray[np.float64]) -> float:
    corners = points[cv2.convexHull(points.astype(np.float32), returnPoints=False)[:, 0]]
    x, y = corners.T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2.0)


@pytest.mark.parametrize("lamp_mm", [(0, 0, 1000), (300, -700, 600)])
def test_illuminance_is_intensity_times_solid_angle_over_area(
    lamp_mm: tuple[float, float, float],
) -> None:
    # cos / r^2 dA is an element of the solid angle, so its mean over a triangle is that over area.
    ground = floor("floor", 0.5, 0.0, n_quads=2)
    corners = ground.vertices_world[ground.faces]
    angles = solid_angles(corners - np.array(lamp_mm) / 1000.0)
    errors = []
    for viewport in (10, 28):
        values = told(light(ground, lamp_mm=lamp_mm, viewport=viewport), EMPTY)
        expected_lx = 100.0 * angles / 0.125
        errors.append(np.abs(values["illuminance_lx"] / expected_lx - 1.0).max())
        assert values["flux_lm"][0] == pytest.approx(100.0 * angles.sum(), rel=5e-3)
        assert (values["share_lit"] == 1.0).all()
        assert (values["share_unsure"] == 0.0).all()
    # Off by the square of the spacing: half a percent at a ninth of an edge, a ninth of that at 28.
    assert errors[0] < 5e-3
    assert errors[1] < errors[0] / 8.0


def test_power_is_intensity_over_all_directions_or_the_cone() -> None:
    ground = floor("floor", 0.5, 0.0)
    by_power = told(light(ground, intensity_cd=None, power_lm=400.0 * np.pi), EMPTY)
    cone: dict[str, Any] = {
        "direction": [0, 0, -2.0],
        "cone_deg": 60.0,
    }  # half of a half of all directions
    by_cone = told(light(ground, intensity_cd=None, power_lm=100.0 * np.pi, **cone), EMPTY)
    expected = told(light(ground), EMPTY)

    for values in (by_power, by_cone):
        np.testing.assert_allclose(values["illuminance_lx"], expected["illuminance_lx"], rtol=1e-6)


def test_a_cone_lights_a_disc() -> None:
    ground = floor("floor", 1.0, 0.0, n_quads=16)
    values = told(shadow(ground, direction=[0, 0, -1.0], cone_deg=30.0), EMPTY)

    expected_m2 = np.pi * np.tan(np.radians(30.0)) ** 2
    unsure_m2 = float(values["share_unsure"].sum()) * 4.0 / len(ground.faces)
    assert values["lit_m2"][0] == pytest.approx(expected_m2, abs=unsure_m2)
    assert unsure_m2 < 0.06  # its rim, 3.6 m long, in triangles of 14 mm
    assert values["shaded_m2"][0] == 0.0  # not by real things


def test_what_faces_away_is_dark_and_flux_is_the_solid_angle_of_a_solid() -> None:
    block = cube("block", (0.2, 0.1, 0.0), 0.4)
    values = told(light(block, viewport=20), EMPTY)

    corners = block.vertices_world[block.faces] - np.array([0.0, 0.0, 1.0])
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    faces_lamp = (outward * corners[:, 0]).sum(axis=1) < 0
    np.testing.assert_array_equal(values["share_lit"] == 1.0, faces_lamp)
    np.testing.assert_array_equal(values["illuminance_lx"] > 0, faces_lamp)
    expected_lm = 100.0 * solid_angles(corners[faces_lamp]).sum()
    assert values["flux_lm"][0] == pytest.approx(expected_lm, rel=2e-3)


@pytest.mark.parametrize("lamp_mm", [(0, 0, 900), (250, -100, 700)])
def test_the_shadow_of_a_box_is_its_projected_outline(
    lamp_mm: tuple[float, float, float],
) -> None:
    views = square_views()
    half_m, center = (0.05, 0.08, 0.03), (0.02, 0.01, 0.2)
    ground = floor("floor", 0.4, -0.1, n_quads=20)
    effect = shadow(ground, views=views, lamp_mm=lamp_mm)

    values = told(effect, box_hull(views, half_m, center))

    corners = box_vertices(np.array(half_m), np.eye(3), np.array(center))
    expected_m2 = area_of_outline(cast(corners, np.array(lamp_mm) / 1000.0, -0.1))
    unsure_m2 = float(values["share_unsure"].sum()) * 0.64 / len(ground.faces)
    assert values["shaded_m2"][0] == pytest.approx(expected_m2, abs=unsure_m2)
    assert values["lit_m2"][0] == pytest.approx(0.64 - expected_m2, abs=unsure_m2)
    # An outline of half a metre in triangles of 4.4 mm.
    assert unsure_m2 < 0.1 * expected_m2 + 0.004
    assert values["shaded_m2"][0] == pytest.approx(expected_m2, rel=0.02)


def test_cad_shades_as_a_hull_does_and_is_told_apart() -> None:
    views = square_views()
    ground = floor("floor", 0.4, -0.1, n_quads=20)
    block = cube("block", (0.1, 0.1, 0.2), 0.1)
    lamp_mm = (50.0, 30.0, 800.0)
    by_cad = told(
        shadow(ground, block, views=views, lamp_mm=lamp_mm, objects=["floor"]), empty_hull(views)
    )
    by_hull = told(
        shadow(ground, views=views, lamp_mm=lamp_mm),
        box_hull(views, (0.05, 0.05, 0.05), (0.1, 0.1, 0.2)),
    )
    both = told(
        shadow(ground, block, views=views, lamp_mm=lamp_mm, objects=["floor"]),
        box_hull(views, (0.05, 0.05, 0.05), (0.1, 0.1, 0.2)),
    )

    expected_m2 = area_of_outline(
        cast(CUBE * 0.1 + np.array([0.1, 0.1, 0.2]), np.array(lamp_mm) / 1000.0, -0.1)
    )
    assert 0.64 - by_cad["lit_m2"][0] == pytest.approx(expected_m2, rel=0.02)
    # The box of the hull is off by the rounding of pixels' edges: samples on the outline differ.
    assert by_hull["lit_m2"][0] == pytest.approx(by_cad["lit_m2"][0], rel=0.01)
    assert by_cad["shaded_m2"][0] == 0.0
    assert both["shaded_m2"][0] < 0.02 * expected_m2


def test_each_sample_is_shaded_where_its_ray_meets_the_hull() -> None:
    hull = ball_hull(VIEWS, np.array([0.1, 0.0, 0.3]), 0.2)
    ground = floor("floor", 0.6, -0.2, n_quads=3)
    lamp = np.array([0.3, -0.2, 1.1])
    values = told(shadow(ground, lamp_mm=tuple(lamp * 1000.0)), hull)

    count = n_samples(10)
    samples = sample_positions(
        np.repeat(ground.vertices_world[ground.faces], count, axis=0),
        np.full(18 * count, 10, np.int32),
        np.tile(np.arange(count, dtype=np.uint32), 18),
    )
    ways = samples - lamp
    lit = np.array(
        [
            len(spans_of_rays(hull, lamp[None], way[None], float(np.linalg.norm(way)))[0]) == 0
            for way in ways
        ]
    ).reshape(18, count)
    expected = lit[:, small_triangles(10)].mean(axis=(1, 2))
    np.testing.assert_allclose(values["share_lit"], expected, atol=1e-6)
    assert 0.2 < expected.mean() < 0.95


def test_a_lamp_in_the_hull_lights_nothing() -> None:
    ground = floor("floor", 0.5, 0.0)
    hull = ball_hull(VIEWS, np.array([0.0, 0.0, 0.3]), 0.1)

    values = told(light(ground, lamp_mm=[0, 0, 300]), hull)

    assert (values["share_lit"] == 0.0).all()
    assert (values["illuminance_lx"] == 0.0).all()
    assert values["shaded_m2"][0] == pytest.approx(1.0, rel=1e-9)


def test_a_ball_of_a_lamp_is_as_bright_as_a_point_and_its_shadow_is_soft() -> None:
    ground = floor("floor", 0.4, -0.1, n_quads=20)
    views = square_views()
    hull = box_hull(views, (0.05, 0.05, 0.02), (0.0, 0.0, 0.2))
    hard, soft = (
        light(ground, views=views, radius_mm=radius_mm, lamp_points=32) for radius_mm in (0.0, 80.0)
    )

    # Newton: a shell pulls as a point. Points on it do to some thousandths.
    np.testing.assert_allclose(
        told(soft, empty_hull(views))["illuminance_lx"],
        told(hard, empty_hull(views))["illuminance_lx"],
        rtol=5e-3,
    )
    half = [
        int(((values["share_lit"] > 0.02) & (values["share_lit"] < 0.98)).sum())
        for values in (told(hard, hull), told(soft, hull))
    ]
    assert half[1] > 2 * half[0]


@given(
    center=st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    radius_m=st.floats(0.02, 0.2),
    more_m=st.floats(0.0, 0.2),
    lamp_mm=st.tuples(*[st.floats(-800.0, 800.0)] * 2, st.floats(-100.0, 1500.0)),
)
@settings(max_examples=asked(8))
def test_a_larger_hull_never_lights_more(
    center: tuple[float, ...],
    radius_m: float,
    more_m: float,
    lamp_mm: tuple[float, ...],
) -> None:
    effect = light(floor("floor", 0.6, -0.4, n_quads=3), views=COARSE, lamp_mm=lamp_mm)
    smaller, larger = (
        told(effect, ball_hull(COARSE, np.array(center), radius))
        for radius in (radius_m, radius_m + more_m)
    )
    assert (larger["share_lit"] <= smaller["share_lit"]).all()
    assert (larger["illuminance_lx"] <= smaller["illuminance_lx"]).all()
    assert (smaller["share_lit"] <= 1.0).all()
    assert larger["shaded_m2"][0] >= smaller["shaded_m2"][0] - 1e-12


def test_threads_change_nothing_and_columns_are_as_told() -> None:
    hull = ball_hull(VIEWS, np.array([0.1, 0.0, 0.3]), 0.2)
    ground = floor("floor", 0.6, -0.2, n_quads=12)
    one, three = (light(ground, threads=number) for number in (1, 3))
    expected, other = told(one, hull), told(three, hull)

    for name, array in expected.items():
        np.testing.assert_array_equal(array, other[name], err_msg=name)
    for quantity in one.told["it"].columns:
        assert expected[quantity.name].shape == quantity.shape, quantity.name
        assert expected[quantity.name].dtype == quantity.dtype, quantity.name
    drawn = one.told["it"].drawn
    assert drawn is not None
    assert drawn.faces is not None
    assert drawn.faces.shape == (288, 3)
    assert drawn.cell_columns == ("illuminance_lx", "share_lit")


def test_objects_of_a_scene_are_told_in_their_order() -> None:
    first, second = floor("low", 0.5, -0.2, n_quads=16), floor("high", 0.3, 0.1)
    effect = shadow(first, second, objects=["high", "low"])
    values = told(effect, EMPTY)

    assert effect.told["it"].about["objects"] == ["high", "low"]
    assert effect.told["it"].about["object_first_triangle"] == [0, 2]
    # The upper square, 0.6 m wide at 0.9 m, keeps 0.8 m of the lower one at 1.2 m dark.
    np.testing.assert_allclose(values["lit_m2"], [0.36, 1.0 - 0.64], rtol=0.02)


def test_points_on_a_ball_balance() -> None:
    for count in (2, 16, 100):
        points = points_on_ball(count)
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, rtol=1e-12)
        assert np.linalg.norm(points.mean(axis=0)) < 1.0 / count


@pytest.mark.parametrize("viewport", [2, 5, 10])
def test_small_triangles_tile_a_triangle(viewport: int) -> None:
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], np.float64)
    count = n_samples(viewport)
    samples = sample_positions(
        np.repeat(corners, count, axis=0),
        np.full(count, viewport, np.int32),
        np.arange(count, dtype=np.uint32),
    )
    small = samples[small_triangles(viewport)]
    twice = np.cross(small[:, 1] - small[:, 0], small[:, 2] - small[:, 0])[:, 2]
    assert len(small) == (viewport - 1) ** 2
    np.testing.assert_allclose(np.abs(twice), 1.0 / (viewport - 1) ** 2)
    assert len(np.unique(np.round(small.mean(axis=1), 9), axis=0)) == len(small)


@pytest.mark.parametrize(
    ("kind", "keys", "line"),
    [
        ("light", {}, "effect.1: found neither of power_lm and intensity_cd; give one"),
        ("light", {"power_lm": 1.0, "intensity_cd": 1.0}, "effect.1: found both of power_lm and"),
        ("shadow", {"lamp_mm": [0, 0, 0]}, "effect.1.lamp_mm: the lamp is inside of 'block'"),
        ("shadow", {"objects": ["bloc"]}, "effect.1.objects: there is no object 'bloc'; the scene"),
        ("shadow", {"objects": ["block", "block"]}, "effect.1.objects: 'block' is named twice"),
    ],
)
def test_a_lamp_that_cannot_be_is_refused(kind: str, keys: dict[str, Any], line: str) -> None:
    setting = setting_of(
        VIEWS, cube("block", (0, 0, 0), 0.2), cube("door", (0, 0, 0.5), 0.1), claimed=("door",)
    )
    make = {"light": Light, "shadow": Shadow}[kind]

    with pytest.raises(SceneError, match=line) as caught:
        make([entry_of(kind, **{"lamp_mm": [0, 0, 1000], **keys})], setting)

    assert "\n" not in str(caught.value)


def test_a_lamp_for_nothing_that_stands_is_refused() -> None:
    setting = setting_of(VIEWS, cube("door", (0, 0, 0), 0.1), claimed=("door",))

    with pytest.raises(SceneError, match="effects move all objects; name in `objects`"):
        Shadow([entry_of("shadow", lamp_mm=[0, 0, 1000])], setting)


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        ({}, "effect.1.lamp_mm: this key is missing"),
        ({"lamp_mm": [0, 0, 1], "direction": [0, 0, 0]}, "effect.1.direction: .* points nowhere"),
        ({"lamp_mm": [0, 0, 1], "radius_mm": -1}, "effect.1.radius_mm: .*, found -1"),
        ({"lamp_mm": [0, 0, 1], "power_lm": 3}, "effect.1.power_lm: there is no such key"),
        ({"lamp_mm": [0, 0, 1], "objects": []}, "effect.1.objects: .*at least 1 item"),
    ],
)
def test_keys_that_are_wrong_are_refused(keys: dict[str, Any], line: str) -> None:
    scene = Scene(Path("scene.toml"), (), ({"kind": "shadow", **keys},), "")

    with pytest.raises(SceneError, match=line) as caught:
        read_entries(scene)

    assert "\n" not in str(caught.value)
