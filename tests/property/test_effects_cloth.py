"""Whatever real thing comes, however it moves: a sheet is out of it after each step, and sound."""

import numpy as np
import pytest
from helpers.effect_cloth import deepest_m, drive, make_cloth, sheet, views_around
from helpers.response import ball_silhouettes
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridve.hull.query.silhouettes import Hull, make_hull

VIEWS = views_around()


@pytest.mark.slow
@settings(max_examples=asked(10), deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    recovery=st.sampled_from(["direction", "nearest"]),
    per_hull=st.sampled_from([1, 3, 10]),
    step_s=st.sampled_from([0.001, 0.002, 0.004]),
)
def test_a_sheet_is_out_of_any_hull_after_each_step(
    seed: int, recovery: str, per_hull: int, step_s: float
) -> None:
    rng = np.random.default_rng(seed)
    n_balls = int(rng.integers(1, 4))
    radii_m = rng.uniform(0.01, 0.1, n_balls)
    begins, ends = rng.uniform(-0.3, 0.3, (2, n_balls, 3))
    n_steps = 40

    def hull_at(time_s: float) -> Hull:
        share = time_s / (n_steps * step_s)
        masks = [
            ball_silhouettes(VIEWS, begin + share * (end - begin), radius_m)
            for begin, end, radius_m in zip(begins, ends, radii_m, strict=True)
        ]
        return make_hull(VIEWS, [np.maximum.reduce(each) for each in zip(*masks, strict=True)])

    hung = sheet((6, 7), fold_m=0.01, direction=(0.0, 1.0, 0.0))
    cloth = make_cloth(
        VIEWS,
        [hung],
        recovery=recovery,
        step_s=step_s,
        pin=["top", "none"][int(rng.integers(2))],
        areal_density_kg_m2=float(10 ** rng.uniform(-2, 1)),
        stretch_n_m=float(10 ** rng.uniform(1, 3)),
    )

    rows = list(drive(cloth, hull_at, n_steps, step_s=step_s, per_hull=per_hull))

    for row in rows:
        assert np.isfinite(row.vertices_m).all()
        assert row.values["penetration_m"] <= 1e-3
    # What is told is so: asked of the hull itself, where nothing hangs on pins in it.
    for row in rows[::8]:
        if row.values["n_held"] == 0:
            assert deepest_m(row.hull, hung, row.vertices_m) <= 1e-3
    energy = np.array([row.energy_j for row in rows])
    work = np.array([float(row.values["hull_work_j"]) for row in rows])
    given_j = np.abs(np.diff(work, prepend=0.0)).cumsum()
    weight_j = 9.81 * cloth.told["sheet"].about["mass_kg"]  # of a metre: what rounds
    assert (energy <= work + 5e-3 * given_j + 1e-7 * (1.0 + weight_j)).all()
