"""Proximity: how long a box that comes nearer is in zones, and what triangles take in of it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.effects import CUBE as UNIT_CUBE
from helpers.effects import (
    CUBE_FACES,
    cube,
    empty_hull,
    entry_of,
    floor,
    held,
    scene_object,
    setting_of,
)
from helpers.hulls import ball_hull, look_at, projection, ring_views
from helpers.response import box_vertices, polyhedron_masks
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError
from hybridve.hull.cad.scene import Scene, SceneObject
from hybridve.hull.effects.kinds import read_entries
from hybridve.hull.effects.proximity import Proximity
from hybridve.hull.query.silhouettes import Hull, make_hull, make_views

FRAME_S = 0.02
SPEED_M_S = 0.1

#: Of the real box.
HALF_M = np.array([0.03, 0.05, 0.04])

#: A virtual cube, its edge 10 cm, stands on a corner that is turned to the right, at x = 5 cm. The
#: box is to the right of it.
_TO_RIGHT = np.array([[1, 1, 1], [1, -1, 0], [1, 1, -2]]) / np.sqrt([[3.0], [2.0], [6.0]])
CUBE = scene_object(
    "cube",
    UNIT_CUBE * 0.1 @ _TO_RIGHT.T + np.array([0.05 - 0.05 * np.sqrt(3.0), 0.0, 0.0]),
    CUBE_FACES,
)

# Cameras a kilometre away along the axes: their hull of a box is the box. A pixel covers a
# millimetre, and edges at whole millimetres lie on edges of pixels.
VIEWS = make_views(
    tuple("xyz"),
    np.array([[800, 800]] * 3),
    np.array([projection(look_at(c, np.zeros(3)), 1e6, 800, 800) for c in np.eye(3) * 1000.0]),
)

#: What a kilometre's perspective does to a box 0.3 m off.
BOX_M = 1e-4


def box_at(gap_m: float) -> Hull:
    """Return the hull of a box so far to the right of the cube."""
    center = np.array([0.05 + gap_m + HALF_M[0], 0.0, 0.0])
    return make_hull(VIEWS, polyhedron_masks(VIEWS, box_vertices(HALF_M, np.eye(3), center)))


def distances(points_world: NDArray[np.float64], gap_m: float) -> NDArray[np.float64]:
    """Return how far points are from that box."""
    center = np.array([0.05 + gap_m + HALF_M[0], 0.0, 0.0])
    beside = np.maximum(np.abs(points_world - center) - HALF_M, 0.0)
    return np.asarray(np.linalg.norm(beside, axis=-1))


def proximity(*objects: SceneObject, **keys: Any) -> Proximity:
    entry = entry_of("proximity", **{"object": "cube", "zones_mm": [50.5, 20.5, 5.5], **keys})
    return Proximity([entry], setting_of(VIEWS, *(objects or (CUBE,))))


def look(effect: Proximity, hull: Hull, before: Hull | None) -> dict[str, NDArray[Any]]:
    effect.advance(held(hull, before, FRAME_S), FRAME_S)
    return dict(effect.values(hull)["it"])


def approach(effect: Proximity, gaps_m: NDArray[Any]) -> list[dict[str, NDArray[Any]]]:
    """Return what is told of a box that takes these gaps, frame after frame."""
    told, before = [], None
    for gap_m in gaps_m:
        hull = box_at(float(gap_m))
        told.append(look(effect, hull, before))
        before = hull
    return told


def test_time_in_zones_is_that_of_a_box_that_comes_nearer() -> None:
    gaps_m = np.arange(80, 2, -2) * 1e-3  # 0.1 m/s
    told = approach(proximity(), gaps_m)[-1]

    zones_m = np.array([0.0505, 0.0205, 0.0055])
    expected_s = (zones_m - gaps_m[-1]) / SPEED_M_S
    lower_s, upper_s = told["time_in_zone_s"].T
    assert (lower_s <= expected_s).all()
    assert (expected_s <= upper_s).all()
    assert (upper_s - lower_s <= FRAME_S + 1e-9).all()
    np.testing.assert_allclose(told["stay_s"], told["time_in_zone_s"])
    assert told["is_in_zone"].tolist() == [[1, 1]] * 3
    assert told["clearance_m"][0] - BOX_M <= gaps_m[-1] <= told["clearance_m"][1] + BOX_M
    assert np.diff(told["clearance_m"]) <= 1e-4


def test_who_leaves_a_zone_has_stayed_no_longer() -> None:
    gaps_m = np.concatenate([np.arange(30, 10, -4), np.arange(10, 40, 4)]) * 1e-3
    told = approach(proximity(), gaps_m)

    entered = int((gaps_m < 0.0205).argmax())
    left = len(gaps_m) - int((gaps_m[::-1] < 0.0205).argmax())
    surely_s = (left - 1 - entered) * FRAME_S
    np.testing.assert_allclose(
        told[-1]["time_in_zone_s"][1], [surely_s, surely_s + 2 * FRAME_S], rtol=1e-12
    )
    assert (told[-1]["stay_s"][1] == 0.0).all()
    assert told[left - 1]["stay_s"][1, 0] == pytest.approx(surely_s)
    assert told[-1]["is_in_zone"].tolist() == [[1, 1], [0, 0], [0, 0]]


def test_where_bounds_of_the_clearance_are_apart_a_zone_is_entered_possibly() -> None:
    told = approach(proximity(tolerance_mm=8.0, zones_mm=[40.0]), np.array([0.04, 0.04]))[-1]

    lower_m, upper_m = told["clearance_m"]
    assert lower_m < 0.04 - BOX_M < 0.04 + BOX_M < upper_m
    assert told["is_in_zone"].tolist() == [[0, 1]]
    assert told["time_in_zone_s"].tolist() == [[0.0, FRAME_S]]


def test_a_gap_in_the_recording_counts_for_neither() -> None:
    effect = proximity()
    hull = box_at(0.01)
    look(effect, hull, None)
    look(effect, hull, hull)
    told = look(effect, hull, None)

    np.testing.assert_allclose(told["time_in_zone_s"][1], [FRAME_S, FRAME_S])
    assert (told["stay_s"] == 0.0).all()


@pytest.mark.parametrize("kind", ["inverse_square", "exponential", "linear"])
def test_exposure_lies_between_its_bounds(kind: str) -> None:
    range_m = {"inverse_square": 0.02, "exponential": 0.03, "linear": 0.15}[kind]
    gaps_m = np.arange(60, 20, -4) * 1e-3
    effect = proximity(falloff={"kind": kind, "range_mm": 1000.0 * range_m}, resolution_mm=4.0)
    told = approach(effect, gaps_m)[-1]

    # Numerically, in a hundred parts of each frame.
    middles = CUBE.vertices_world[CUBE.faces].mean(axis=1)
    fine_m = np.interp(
        (np.arange(100 * (len(gaps_m) - 1)) + 0.5) / 100.0, np.arange(len(gaps_m)), gaps_m
    )
    distance_m = np.array([distances(middles, gap_m) for gap_m in fine_m])
    if kind == "inverse_square":
        strength = np.minimum((range_m / np.maximum(distance_m, 1e-9)) ** 2, 1.0)
    elif kind == "exponential":
        strength = np.exp(-distance_m / range_m)
    else:
        strength = np.maximum(1.0 - distance_m / range_m, 0.0)
    expected_s = strength.sum(axis=0) * FRAME_S / 100.0
    lower_s, upper_s = told["exposure_lower_s"], told["exposure_upper_s"]
    # A box off by a tenth of a millimetre, at no range below 2 cm: half a percent, twice.
    assert (lower_s <= expected_s * 1.01 + 1e-12).all()
    assert (expected_s * 0.99 <= upper_s + 1e-12).all()
    facing = middles[:, 0] > CUBE.vertices_world[:, 0].mean()
    # Cubes of 4 mm: middles are 3.5 mm off at most, and 4 mm of way are one frame.
    assert (upper_s[facing] - lower_s[facing] < 0.6 * expected_s[facing]).all()
    np.testing.assert_allclose(told["exposure_s"], (lower_s + upper_s) / 2.0)
    assert expected_s[facing].min() > expected_s[~facing].max()


def test_nothing_real_exposes_nothing() -> None:
    effect = proximity(falloff={"kind": "inverse_square", "range_mm": 20.0})
    none = empty_hull(VIEWS)
    look(effect, none, None)
    told = look(effect, none, none)

    assert told["clearance_m"][1] == np.inf
    assert (told["exposure_lower_s"] == 0.0).all()
    # Within the metres that are looked at there is nothing: (0.02 / 2)^2 of the time at most.
    assert told["exposure_upper_s"].max() <= FRAME_S * 1e-4
    assert (told["time_in_zone_s"] == 0.0).all()


@pytest.mark.slow
def test_what_is_touched_is_exposed_at_full_strength() -> None:
    views = ring_views(4)
    hull = ball_hull(views, np.zeros(3), 0.3)
    effect = Proximity(
        [
            entry_of(
                "proximity",
                object="floor",
                zones_mm=[5],
                falloff={"kind": "exponential", "range_mm": 100},
                resolution_mm=10,
            )
        ],
        setting_of(views, floor("floor", 0.1, 0.0)),
    )
    look(effect, hull, None)
    told = look(effect, hull, hull)

    assert told["clearance_m"].tolist() == [0.0, 0.0]
    assert told["time_in_zone_s"].tolist() == [[FRAME_S, FRAME_S]]
    np.testing.assert_allclose(told["exposure_upper_s"], FRAME_S, rtol=1e-9)
    # Some middle of a cube of 10 mm in the hull is within 8.7 mm.
    assert (told["exposure_lower_s"] > FRAME_S * np.exp(-0.0087 / 0.1)).all()


def test_it_goes_on_from_its_state_to_the_bit() -> None:
    keys = {"falloff": {"kind": "linear", "range_mm": 80.0}}
    gaps_m = np.arange(40, 10, -5) * 1e-3
    whole, first, second = (proximity(**keys) for _ in range(3))
    expected = approach(whole, gaps_m)[-1]
    approach(first, gaps_m[:3])

    second.restore(first.state())
    before = box_at(float(gaps_m[2]))
    for gap_m in gaps_m[3:]:
        hull = box_at(float(gap_m))
        told = look(second, hull, before)
        before = hull

    for name, array in expected.items():
        np.testing.assert_array_equal(told[name], array, err_msg=name)
    for quantity in whole.told["it"].columns:
        assert expected[quantity.name].shape == quantity.shape, quantity.name
        assert expected[quantity.name].dtype == quantity.dtype, quantity.name


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        ({"object": "cub"}, "effect.1.object: there is no object 'cub'; the scene has cube, door"),
    ],
)
def test_an_object_that_cannot_be_watched_is_refused(keys: dict[str, Any], line: str) -> None:
    setting = setting_of(VIEWS, CUBE, cube("door", (0, 0, 0.3), 0.1), claimed=("door",))

    with pytest.raises(SceneError, match=line) as caught:
        Proximity([entry_of("proximity", zones_mm=[5], **keys)], setting)

    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        ({"zones_mm": []}, "effect.1.zones_mm: .*at least 1 item"),
        ({"zones_mm": [5, 20]}, r"effect.1.zones_mm: \[5.0, 20.0\] does not descend; give the"),
        ({"zones_mm": [5, 5]}, r"effect.1.zones_mm: \[5.0, 5.0\] does not descend"),
        ({"zones_mm": [5, 0]}, "effect.1.zones_mm.2: .*greater than 0, found 0"),
        ({}, "effect.1.zones_mm: this key is missing"),
        (
            {"zones_mm": [5], "falloff": {"kind": "cubic", "range_mm": 1}},
            "effect.1.falloff.kind: .*'inverse_square', 'exponential' or 'linear', found 'cubic'",
        ),
        (
            {"zones_mm": [5], "falloff": {"kind": "linear", "range_mm": 0}},
            "effect.1.falloff.range_mm: .*greater than 0, found 0",
        ),
    ],
)
def test_keys_that_are_wrong_are_refused(keys: dict[str, Any], line: str) -> None:
    scene = Scene(
        Path("scene.toml"), (CUBE,), ({"kind": "proximity", "object": "cube", **keys},), ""
    )

    with pytest.raises(SceneError, match=line) as caught:
        read_entries(scene)

    assert "\n" not in str(caught.value)
