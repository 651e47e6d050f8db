"""Particles: flight in closed form, what a hull does to them, and that nothing gets into one."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.effects import cube, empty_hull, entry_of, floor, held, scene_object, setting_of
from helpers.hulls import ball_hull, look_at, projection, ring_views
from helpers.response import ball_exits, box_vertices, polyhedron_masks
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError

from hybridve.calib.errors import SceneError
from hybridve.hull.cad.scene import Scene, SceneObject
from hybridve.hull.effects.effect import GRAVITY_M_S2
from hybridve.hull.effects.kinds import read_entries
from hybridve.hull.effects.particles import Particles
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.segments import segments_enter
from hybridve.hull.query.silhouettes import (
    Hull,
    Unseen,
    Views,
    make_hull,
    make_views,
)
from hybridve.hull.query.threads import Threads
from hybridve.hull.query.walk import least_stretches, spans_of_rays

VIEWS = ring_views(4)
EMPTY = empty_hull(VIEWS)

#: The same cameras, three times as coarse.
COARSE = ring_views(4, width=240, height=162, focal_px=233.0)

#: A float32 metre in a room.
SINGLE_M = 1e-7

STEP_S = 0.005


def particles(
    *objects: SceneObject, threads: int = 1, views: Views = VIEWS, **keys: Any
) -> Particles:
    keys = {"source_mm": [0, 0, 500], "count": 1, "lifetime_s": 100.0, **keys}
    return Particles([entry_of("particles", **keys)], setting_of(views, *objects), Threads(threads))


def run(swarm: Particles, hull: Hull, n_steps: int, before: Hull | None = None) -> None:
    for _ in range(n_steps):
        swarm.advance(held(hull, before, STEP_S), STEP_S)


def plate(views: Views, half_m: tuple[float, float, float], z_m: float = 0.0) -> Hull:
    """Return the hull of a box along the axes."""
    corners = box_vertices(np.array(half_m), np.eye(3), np.array([0.0, 0.0, z_m]))
    return make_hull(views, polyhedron_masks(views, corners))


def level_views() -> Views:
    """Return cameras that look along a plate's faces, as fine as a quarter of a millimetre."""
    centers = [[3.0, 0, 0], [0, 3.0, 0], [-3.0, 0, 0], [0, -3.0, 0]]
    matrices = [
        projection(look_at(np.array(center), np.zeros(3)), 4000.0, 1000, 1000) for center in centers
    ]
    names = tuple("abcd")
    return make_views(names, np.array([[1000, 1000]] * 4), np.array(matrices))


@pytest.mark.slow
@pytest.mark.parametrize("unseen", ["carve", "keep"])
def test_a_segment_enters_where_the_walk_of_its_ray_begins_to_be_inside(unseen: Unseen) -> None:
    views = ring_views(4, unseen=unseen, min_cameras=2 if unseen == "keep" else 1)
    hull = ball_hull(views, np.array([0.1, 0.0, 0.1]), 0.3)
    rng = np.random.default_rng(0)
    starts, ends = rng.uniform(-2, 2, (500, 3)), rng.uniform(-1, 1, (500, 3))
    least_m = float(least_stretches(views, starts).max())

    at = segments_enter(starts - views.origin_world, ends - starts, least_m, hull.frame)

    lengths_m = np.linalg.norm(ends - starts, axis=1)
    expected_m = np.full(500, np.inf)
    for i in range(500):
        spans_m = spans_of_rays(hull, starts[i : i + 1], (ends - starts)[i : i + 1], lengths_m[i])
        expected_m[i] = spans_m[0][0, 0] if len(spans_m[0]) else np.inf
    # Both are exact but for the shortest stretch that either tells.
    np.testing.assert_allclose(at * lengths_m, expected_m, rtol=0, atol=4 * least_m)
    assert 30 < np.isfinite(at).sum() < 470


def test_flight_without_air_is_a_parabola() -> None:
    swarm = particles(drag_s=0.0, velocity_m_s=[1.0, 0.5, 2.0])

    run(swarm, EMPTY, 100)

    told, t = swarm.values(None)["it"], 100 * STEP_S
    expected = [t, 0.5 * t, 0.5 + 2.0 * t - 0.5 * GRAVITY_M_S2 * t**2]
    np.testing.assert_allclose(told["position_m"][0], expected, atol=SINGLE_M)
    np.testing.assert_allclose(
        swarm.state()["it/velocity"][0], [1.0, 0.5, 2.0 - GRAVITY_M_S2 * t], rtol=1e-12
    )
    # Kinetic and potential energy together, weighed by 4.2 mg.
    energy_j = told["kinetic_j"] + told["potential_j"]
    assert energy_j == pytest.approx(0.5 * 4.2e-6 * (1.0 + 0.25 + 4.0), rel=1e-9)


@pytest.mark.parametrize("drag_s", [0.05, 0.66, 1e6])
def test_flight_through_air_follows_its_exponential_however_long_the_steps(drag_s: float) -> None:
    fine, coarse = (
        particles(drag_s=drag_s, velocity_m_s=[3.0, 0, 1.0], buoyancy=0.25) for _ in range(2)
    )

    run(fine, EMPTY, 80)
    coarse.advance(held(EMPTY), 80 * STEP_S)

    t, terminal = 80 * STEP_S, -0.75 * GRAVITY_M_S2 * drag_s
    lost = -np.expm1(-t / drag_s)
    with_drag = [
        3.0 * drag_s * lost,
        0.0,
        0.5 + terminal * t + (1.0 - terminal) * drag_s * lost,
    ]
    for swarm in (fine, coarse):
        # At 1e6 s the closed form loses six digits, the step does not.
        np.testing.assert_allclose(
            swarm.state()["it/position"][0] + VIEWS.origin_world, with_drag, atol=1e-9
        )


#: A plate 40 cm wide and 10 cm thick, as `level_views` see it from 3 m: their lines of sight over
#: its near edge meet above it, a roof of four sides that this plane has for one.
TOP_NORMAL = np.array([0.05, 0.0, 2.8]) / np.hypot(0.05, 2.8)
PLATE_M = (0.2, 0.2, 0.05)

#: What a pixel of these cameras covers there.
LEVEL_PIXEL_M = 0.75e-3


def dropped(
    restitution: float, friction: float, source_mm: list[float], velocity_m_s: list[float]
) -> Particles:
    entry = entry_of(
        "particles",
        source_mm=source_mm,
        velocity_m_s=velocity_m_s,
        count=1,
        drag_s=0.0,
        friction=friction,
        restitution=restitution,
        lifetime_s=10.0,
    )
    return Particles([entry], setting_of(level_views()), Threads(1))


def fall(height_m: float, velocity: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Return when something at x = 0 meets the top of the plate, and how fast it is."""
    # z - t vz - g t^2 / 2 = 0.05 (3 - x - vx t) / 2.8
    roots = np.roots(
        [-GRAVITY_M_S2 / 2, velocity[2] + velocity[0] * 0.05 / 2.8, height_m - 0.05 * 3 / 2.8]
    )
    fall_s = float(roots.real.max())
    return fall_s, velocity - np.array([0.0, 0.0, GRAVITY_M_S2 * fall_s])


@pytest.mark.parametrize("restitution", [0.5, 1.0])
def test_a_particle_bounces_off_a_plane_as_newton_says(restitution: float) -> None:
    hull = plate(level_views(), PLATE_M)
    swarm = dropped(restitution, 0.0, [0, 0, 250], [0.2, 0.0, 0.0])
    fall_s, impact = fall(0.25, np.array([0.2, 0.0, 0.0]))

    run(swarm, hull, 60)

    told, after_s = swarm.values(None)["it"], 60 * STEP_S - fall_s
    away = impact - (1 + restitution) * (impact @ TOP_NORMAL) * TOP_NORMAL
    place = np.array([0.2 * fall_s, 0.0, 0.05 * (3.0 - 0.2 * fall_s) / 2.8]) + away * after_s
    place[2] -= 0.5 * GRAVITY_M_S2 * after_s**2
    # A pixel is a pixel / impact of time, in which the way back differs by up to 1 + e pixels.
    np.testing.assert_allclose(told["position_m"][0], place, atol=3 * LEVEL_PIXEL_M)
    speed = swarm.state()["it/velocity"][0]
    away[2] -= GRAVITY_M_S2 * after_s
    slack_m_s = 2 * (1 + restitution) * GRAVITY_M_S2 * LEVEL_PIXEL_M / -impact[2]
    np.testing.assert_allclose(speed, away, atol=slack_m_s)
    assert told["n_deflected"][0] == 1
    lost_j = 0.5 * 4.2e-6 * (1 - restitution**2) * impact[2] ** 2
    assert told["hull_work_j"] == pytest.approx(-lost_j, rel=0.02, abs=1e-9)


def test_a_particle_without_a_bounce_stays_on_the_plane() -> None:
    hull = plate(level_views(), PLATE_M)
    swarm = dropped(0.0, 0.5, [0, 0, 250], [0.0, 0.0, 0.0])

    run(swarm, hull, 200)

    # The roof's top is a point; half a pixel of it is cut off, and a skin of 0.2 mm lies upon it.
    height_m = swarm.values(None)["it"]["position_m"][0, 2]
    assert height_m == pytest.approx(0.05 * 3.0 / 2.8, abs=LEVEL_PIXEL_M)
    # Within a step gravity gives it 5 cm/s; friction takes what the roof's slope would.
    assert np.linalg.norm(swarm.state()["it/velocity"][0]) < 2 * GRAVITY_M_S2 * STEP_S


def test_a_plane_brakes_with_its_friction() -> None:
    hull = plate(level_views(), PLATE_M)
    swarm = dropped(0.5, 0.25, [0, 0, 150], [1.0, 0.0, -1.0])
    fall_s, impact = fall(0.15, np.array([1.0, 0.0, -1.0]))

    run(swarm, hull, 24)

    pushed = -1.5 * (impact @ TOP_NORMAL)
    away = impact + pushed * TOP_NORMAL
    along = away - (away @ TOP_NORMAL) * TOP_NORMAL
    away -= along * 0.25 * pushed / np.linalg.norm(along)  # Coulomb
    away[2] -= GRAVITY_M_S2 * (24 * STEP_S - fall_s)
    assert swarm.values(None)["it"]["n_deflected"][0] == 1
    slack_m_s = 3 * GRAVITY_M_S2 * LEVEL_PIXEL_M / -impact[2]
    np.testing.assert_allclose(swarm.state()["it/velocity"][0], away, atol=slack_m_s)


@pytest.mark.parametrize("step_s", [0.002, 0.01])
def test_without_loss_energy_stays_and_none_comes_from_nowhere(step_s: float) -> None:
    hull = plate(level_views(), PLATE_M)
    swarm = dropped(1.0, 0.0, [0, 0, 250], [0.1, 0.0, 0.0])
    falls_j = 4.2e-6 * GRAVITY_M_S2 * (0.25 - 0.05 * 3 / 2.8)
    energies_j = []
    for _ in range(round(1.2 / step_s)):
        swarm.advance(held(hull, hull, 0.02), step_s)
        told = swarm.values(None)["it"]
        energies_j.append(told["kinetic_j"] + told["potential_j"])

    assert swarm.values(None)["it"]["n_deflected"][0] >= 3
    changed = (np.array(energies_j) - energies_j[0]) / falls_j
    # The chord of 10 ms is 0.12 mm below its parabola: 0.6 per mille of the fall each time, lost.
    assert changed.max() < 1e-4
    assert changed.min() > -3 * 1e-3


@pytest.mark.slow
def test_none_is_in_the_hull_after_any_step() -> None:
    hull = ball_hull(VIEWS, np.array([0.0, 0.0, 0.1]), 0.3)
    swarm = particles(
        count=10_000,
        style="sparks",
        source_mm=[-300, -300, 500, 300, 300, 900],
        velocity_m_s=[0.0, 0.0, -3.0],
        spread_deg=60.0,
    )
    for _ in range(40):
        run(swarm, hull, 1)
        state = swarm.state()
        alive = state["it/is_alive"]
        assert not contains_points(hull, state["it/position"][alive] + VIEWS.origin_world).any()
    told = swarm.values(None)["it"]
    assert told["penetration_m"] == 0.0
    assert told["n_alive"] == 10_000
    assert told["n_lost"] == 0
    assert (told["n_deflected"] > 0).sum() > 3000


def test_what_is_fast_does_not_pass_through_a_thin_hull() -> None:
    views = level_views()
    hull = plate(views, (0.2, 0.2, 0.0005))
    swarm = Particles(
        [
            entry_of(
                "particles",
                source_mm=[-50, -50, 300, 50, 50, 300],
                velocity_m_s=[0.0, 0.0, -90.0],
                count=500,
                drag_s=0.0,
                restitution=1.0,
                lifetime_s=10.0,
            )
        ],
        setting_of(views),
    )

    run(swarm, hull, 1)  # 45 cm in one step, through 1 mm

    assert (swarm.state()["it/position"][:, 2] + views.origin_world[2] > 0.0).all()
    assert (swarm.values(None)["it"]["n_deflected"] == 1).all()
    np.testing.assert_allclose(
        np.linalg.norm(swarm.state()["it/velocity"], axis=1), 90.0, rtol=1e-3
    )


@pytest.mark.slow
def test_a_particle_is_thrown_off_a_ball_about_its_normal() -> None:
    center, radius_m = np.zeros(3), 0.3
    views = ring_views(5, width=1440, height=972, focal_px=1400.0)
    hull = ball_hull(views, center, radius_m)
    swarm = Particles(
        [
            entry_of(
                "particles",
                source_mm=[1000, 40, 60],
                velocity_m_s=[-40.0, 0.0, 0.0],
                gravity=0.0,
                drag_s=0.0,
                restitution=1.0,
                friction=0.0,
                count=1,
            )
        ],
        setting_of(views),
    )

    run(swarm, hull, 6)

    # Where the particle enters is where a ray from within leaves.
    inside = np.array([0.0, 0.04, 0.06])
    found = ball_exits(views, center, radius_m, inside, np.array([1.0, 0.0, 0.0]))[0]
    normal = found.normal
    expected = np.array([-40.0, 0, 0]) + 2 * 40.0 * normal[0] * normal
    speed = swarm.state()["it/velocity"][0]
    # `walk.WINDOW_PX`: a silhouette's direction is right to 5 degrees on discs, thrown back twice.
    cosine = speed @ expected / 1600.0
    assert np.degrees(np.arccos(min(cosine, 1.0))) < 10.0
    assert np.linalg.norm(speed) == pytest.approx(40.0, rel=1e-12)


def test_a_hull_that_comes_on_drives_particles_before_it_and_no_faster() -> None:
    views = level_views()
    hulls = [plate(views, (0.1, 0.1, 0.03), z_m) for z_m in np.linspace(-0.1, 0.1, 11)]
    swarm = Particles(
        [
            entry_of(
                "particles",
                source_mm=[-40, -40, -60, 40, 40, 0],
                gravity=0.0,
                drag_s=0.0,
                count=200,
                lifetime_s=10.0,
                restitution=0.0,
            )
        ],
        setting_of(views),
    )
    for before, hull in itertools.pairwise(hulls):  # 4 m/s
        run(swarm, hull, 1, before)

    state = swarm.state()
    height_m = state["it/position"][:, 2] + views.origin_world[2]
    assert (height_m >= 0.13 - 1.5e-3).all()  # before it, none behind: pixels as above
    speed = np.linalg.norm(state["it/velocity"], axis=1)
    assert (speed < 4.0 * 1.2).all()
    assert np.median(speed) == pytest.approx(4.0, rel=0.1)
    assert swarm.values(None)["it"]["penetration_m"] == 0.0
    assert swarm.values(None)["it"]["n_lost"] == 0


def test_a_hull_that_appears_puts_particles_out_and_gives_them_no_speed() -> None:
    swarm = particles(
        count=1000, source_mm=[-300, -300, -100, 300, 300, 300], gravity=0.0, drag_s=0.0
    )
    run(swarm, EMPTY, 1)
    hull = ball_hull(VIEWS, np.array([0.0, 0.0, 0.1]), 0.25)
    swarm.advance(held(hull), STEP_S)  # nothing is known of before

    state = swarm.state()
    assert not contains_points(hull, state["it/position"] + VIEWS.origin_world).any()
    assert (state["it/velocity"] == 0.0).all()
    assert (state["it/n_contacts"] > 0).sum() > 50


def test_smoke_finds_its_way_around_a_hull() -> None:
    hull = ball_hull(VIEWS, np.array([0.0, 0.0, 0.1]), 0.15)
    swarm = particles(
        style="smoke", count=200, source_mm=[-50, -50, -350, 50, 50, -300], lifetime_s=60.0
    )

    run(swarm, hull, 800)  # 4 s at 0.3 m/s

    height_m = swarm.values(None)["it"]["position_m"][:, 2]
    # Free, it were at 0.85; the way around is 0.1 m longer, and is gone along more slowly.
    assert np.median(height_m) > 0.3


def test_particles_lie_on_cad_and_do_not_fall_through() -> None:
    swarm = particles(
        floor("table", 1.0, 0.0, n_quads=4),
        count=300,
        source_mm=[-300, -300, 200, 300, 300, 400],
        velocity_m_s=[0.5, 0.2, -2.0],
        restitution=0.4,
    )

    run(swarm, EMPTY, 400)

    told = swarm.values(None)["it"]
    assert (told["position_m"][:, 2] > 0.0).all()
    assert (told["position_m"][:, 2] < 1e-3).all()
    assert told["n_contacts"] == 0  # those are with real things
    assert told["kinetic_j"] < 1e-9


def test_between_a_hull_and_cad_a_particle_gives_way_or_is_lost_and_counted() -> None:
    views = level_views()
    entry = entry_of("particles", count=300, source_mm=[-80, -80, 1, 80, 80, 30], lifetime_s=10.0)
    swarm = Particles([entry], setting_of(views, floor("table", 0.3, 0.0)), Threads(1))
    hulls = [plate(views, (0.1, 0.1, 0.03), z_m) for z_m in np.linspace(0.08, 0.01, 15)]
    for before, hull in itertools.pairwise(hulls):  # 1 m/s, 2 cm into the table
        run(swarm, hull, 1, before)

    told, state = swarm.values(None)["it"], swarm.state()
    place = state["it/position"][state["it/is_alive"]] + views.origin_world
    assert told["penetration_m"] == 0.0
    assert not contains_points(hulls[-1], place).any()
    assert (place[:, 2] > 0.0).all()
    assert told["n_alive"] + told["n_lost"] == 300
    assert told["n_alive"] > 0


def test_a_hull_of_splinters_that_cameras_abstain_from_lets_none_in() -> None:
    rng = np.random.default_rng(0)
    views = ring_views(4, width=240, height=162, focal_px=233.0, unseen="keep", min_cameras=2)
    ball = ball_hull(views, np.zeros(3), 0.25)
    masks = [ball.mask(camera) & (rng.random((162, 240)) < 0.9) for camera in range(4)]
    hull = make_hull(views, masks)
    swarm = particles(
        views=views,
        count=500,
        source_mm=[-400, -400, -400, 400, 400, 400],
        velocity_m_s=[5.0, 0.0, 0.0],
        spread_deg=180.0,
    )
    for _ in range(10):
        run(swarm, hull, 1)
        state = swarm.state()
        place = state["it/position"][state["it/is_alive"]] + views.origin_world
        assert not contains_points(hull, place).any()
    assert swarm.values(None)["it"]["n_contacts"] > 500


def test_particles_come_out_of_an_object_on_its_outside() -> None:
    swarm = particles(cube("box", (0.0, 0.0, 0.0), 0.2), source_mm=None, object="box", count=600)

    swarm.advance(held(EMPTY), 1e-9)

    place = swarm.values(None)["it"]["position_m"]
    far_m = np.abs(place).max(axis=1)
    np.testing.assert_allclose(far_m, 0.1, atol=2e-6)
    sides = 2 * np.abs(place).argmax(axis=1) + (place[range(600), np.abs(place).argmax(axis=1)] > 0)
    # Six sides of one area: 100 each, give or take five standard deviations.
    assert (np.abs(np.bincount(sides, minlength=6) - 100) < 5 * np.sqrt(600 * 5 / 36)).all()


def test_which_particles_come_out_depends_on_no_steps() -> None:
    keys: dict[str, Any] = {
        "rate_per_s": 777.0,
        "count": 5000,
        "velocity_m_s": [0.1, 0.2, 0.9],
        "spread_deg": 40.0,
    }
    fine, coarse = (particles(gravity=0.0, drag_s=0.0, **keys) for _ in range(2))

    run(fine, EMPTY, 60)
    for _ in range(12):
        coarse.advance(held(EMPTY), 5 * STEP_S)

    assert fine.values(None)["it"]["n_alive"] == np.ceil(60 * STEP_S * 777.0 - 1e-9)
    for key in ("it/position", "it/velocity", "it/age_s"):
        np.testing.assert_allclose(fine.state()[key], coarse.state()[key], atol=1e-12)


def test_the_oldest_make_room_and_the_old_are_gone() -> None:
    swarm = particles(rate_per_s=1000.0, count=100, lifetime_s=100.0)
    run(swarm, EMPTY, 40)
    told = swarm.values(None)["it"]
    assert told["n_alive"] == 100
    assert told["age_s"].max() <= 0.1 + 1e-6

    swarm = particles(rate_per_s=1000.0, count=1000, lifetime_s=0.05)
    run(swarm, EMPTY, 40)
    assert swarm.values(None)["it"]["n_alive"] == pytest.approx(50, abs=STEP_S * 1000)


@pytest.mark.slow
def test_the_same_to_the_bit_with_any_number_of_threads_and_after_a_restart() -> None:
    hull = ball_hull(VIEWS, np.array([0.0, 0.0, 0.1]), 0.3)
    keys: dict[str, Any] = {
        "count": 6000,
        "rate_per_s": 40_000.0,
        "source_mm": [-200, -200, 500, 200, 200, 600],
        "velocity_m_s": [0.0, 0.0, -3.0],
        "spread_deg": 30.0,
    }
    one, three, broken = (particles(threads=number, **keys) for number in (1, 3, 1))
    run(one, hull, 30, EMPTY)
    run(three, hull, 30, EMPTY)
    run(broken, hull, 13, EMPTY)
    resumed = particles(threads=2, **keys)
    resumed.restore(broken.state())
    run(resumed, hull, 17, EMPTY)

    expected, columns = one.state(), one.values(None)["it"]
    assert columns["n_contacts"] > 1000
    for other in (three, resumed):
        for name, array in other.state().items():
            np.testing.assert_array_equal(array, expected[name], err_msg=name)
        for name, array in other.values(None)["it"].items():
            np.testing.assert_array_equal(array, columns[name], err_msg=name)


def test_columns_are_as_told() -> None:
    swarm = particles(count=7)
    run(swarm, EMPTY, 1)
    told, values = swarm.told["it"], swarm.values(None)["it"]
    for quantity in told.columns:
        assert values[quantity.name].shape == quantity.shape, quantity.name
        assert values[quantity.name].dtype == quantity.dtype, quantity.name


@given(
    center=st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    moved=st.tuples(*[st.floats(-0.2, 0.2)] * 3),
    radius_m=st.floats(0.02, 0.3),
    speed=st.floats(0.0, 30.0),
    restitution=st.floats(0.0, 1.0),
    step_s=st.floats(1e-4, 0.1),
)
@settings(max_examples=asked(12))
def test_whatever_the_hull_does_none_is_in_it_and_all_are_numbers(
    center: tuple[float, ...],
    moved: tuple[float, ...],
    radius_m: float,
    speed: float,
    restitution: float,
    step_s: float,
) -> None:
    first = ball_hull(COARSE, np.array(center), radius_m)
    second = ball_hull(COARSE, np.add(center, moved), radius_m)
    none = empty_hull(COARSE)
    swarm = particles(
        count=200,
        views=COARSE,
        source_mm=[-400, -400, -400, 400, 400, 400],
        velocity_m_s=[speed, 0.0, 0.0],
        spread_deg=180.0,
        restitution=restitution,
    )
    for before, hull in [(none, first), (first, second), (second, first), (first, first)]:
        swarm.advance(held(hull, before, step_s), step_s)
        state = swarm.state()
        place: NDArray[np.float64] = state["it/position"] + COARSE.origin_world
        assert np.isfinite(place).all()
        assert np.isfinite(state["it/velocity"]).all()
        assert not contains_points(hull, place[state["it/is_alive"]]).any()
        assert swarm.values(None)["it"]["penetration_m"] == 0.0


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        ({}, "effect.1: found neither of source_mm and object"),
        ({"source_mm": [0, 0, 0], "object": "box"}, "effect.1: found both of"),
        ({"source_mm": [0, 0, 9000]}, "effect.1.source_mm: the source at .* is outside of the"),
        ({"object": "bix"}, "effect.1.object: there is no object 'bix'; the scene has box, far"),
        ({"object": "far"}, "effect.1.object: no part of 'far' is in the working volume"),
        ({"object": "door"}, "effect.1.object: 'door' is moved by another effect"),
    ],
)
def test_a_source_that_is_none_is_refused(keys: dict[str, Any], line: str) -> None:
    objects = (
        cube("box", (0, 0, 0), 0.2),
        cube("far", (0, 0, 20.0), 0.2),
        cube("door", (0, 0, 0), 0.1),
    )
    setting = setting_of(VIEWS, *objects, claimed=("door",))

    with pytest.raises(SceneError, match=line) as caught:
        Particles([entry_of("particles", **keys)], setting)

    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        ({"count": 0}, "effect.1.count: .*greater than or equal to 1, found 0"),
        ({"source_mm": [1, 2]}, "effect.1.source_mm: 2 numbers, expected 3 of a point or 6"),
        ({"source_mm": [0, 0, 1, 0, 0, 0]}, "effect.1.source_mm: the box's first corner"),
        ({"restitution": 1.5}, "effect.1.restitution: .*less than or equal to 1, found 1.5"),
        ({"colour": "red"}, "effect.1.colour: there is no such key"),
        ({"style": "snow"}, "effect.1.style: .*'drops', 'smoke' or 'sparks', found 'snow'"),
    ],
)
def test_keys_that_are_wrong_are_refused(keys: dict[str, Any], line: str) -> None:
    scene = Scene(Path("scene.toml"), (), ({"kind": "particles", **keys},), "")

    with pytest.raises(SceneError, match=line) as caught:
        read_entries(scene)

    assert "\n" not in str(caught.value)
    with pytest.raises(ValidationError):
        entry_of("particles", **keys)


def test_a_surface_without_area_is_refused() -> None:
    line = scene_object("line", np.eye(3) * 0.0, np.array([[0, 1, 2]], np.int32))

    with pytest.raises(SceneError, match="'line' has no area to come out of"):
        Particles([entry_of("particles", object="line")], setting_of(VIEWS, line))
