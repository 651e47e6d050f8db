"""The second opinion is silent where a rig is sound, and speaks where it was spoilt.

Rigs of known truth are adjusted with their kinds of views weighed, and by COLMAP with all points
alike.
"""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers.theory import (
    BOARD,
    bundle_of,
    moving_scene,
    observed,
    parameter_errors,
    squared_in_units,
    still_scene,
)
from numpy.typing import NDArray

from hybridve.calib.boards.board import Observations
from hybridve.calib.calibrate import solve_rig
from hybridve.calib.judging.certificate import working_volume
from hybridve.calib.placing import fixed_cameras
from hybridve.calib.placing.settings import LensRequest
from hybridve.calib.pose import compose, moved_pose
from hybridve.calib.record import CalibrationRecord, Noise, NoOpinion, SecondOpinion
from hybridve.calib.rig import Rig
from hybridve.calib.solving.bundle import POSE, Adjusted, Bundle, adjust
from hybridve.calib.solving.colmap_adjust import colmap_adjust
from hybridve.calib.solving.covariance import even_covariance, rig_covariance
from hybridve.calib.solving.errors_in_space import parameter_slices, point_errors, point_gains
from hybridve.calib.solving.noise import measure_group_noise
from hybridve.calib.solving.second_opinion import second_opinion

SCENE = still_scene(n_cameras=3, n_stills=7)
N_SEEDS = 8

#: Noise of clip and stills, pixels.
KINDS = ((0.3, 0.3), (0.02, 1.0), (1.0, 0.02))


@cache
def volume() -> NDArray[np.float64]:
    return working_volume(SCENE.rig).points_world


def rigs_of(adjusted: Adjusted) -> tuple[Rig, Rig]:
    """Return the rig as it was adjusted, and as COLMAP has it; both know their errors."""
    theirs = colmap_adjust(adjusted.bundle)
    assert isinstance(theirs, Bundle)
    return (
        Rig(adjusted.bundle.cameras, covariance=rig_covariance(adjusted, 1.0)),
        Rig(theirs.cameras, covariance=even_covariance(adjusted.bundle)),
    )


@cache
def adjusted_both_ways(clip_px: float, stills_px: float) -> list[tuple[Rig, Rig]]:
    return [rigs_of(adjust(bundle_of(SCENE, clip_px, stills_px, seed))) for seed in range(N_SEEDS)]


def matrix_of(rig: Rig) -> NDArray[np.float64]:
    assert rig.covariance is not None
    return rig.covariance.matrix


def opinion_of(rig: Rig, other: Rig) -> SecondOpinion:
    told = second_opinion(rig, other, volume())
    assert isinstance(told, SecondOpinion)
    return told


@pytest.mark.slow
@pytest.mark.parametrize(("clip_px", "stills_px"), KINDS)
def test_sound_rigs_are_not_doubted(clip_px: float, stills_px: float) -> None:
    """Not even where kinds of views differ fifty times in noise, of which COLMAP knows nothing."""
    for rig, other in adjusted_both_ways(clip_px, stills_px):
        told = opinion_of(rig, other)

        assert not told.disagrees
        assert told.difference95_m <= 2.0 * told.expected95_m


def test_where_all_views_are_alike_both_are_one_estimate_with_one_error() -> None:
    for rig, other in adjusted_both_ways(0.3, 0.3):
        told = opinion_of(rig, other)

        assert told.difference95_px < 1e-4
        assert told.sigmas < 1e-3
        stated_m = point_errors(rig, volume()).radius95_m
        stated95_m = np.quantile(stated_m[np.isfinite(stated_m)], 0.95)
        assert told.expected95_m == pytest.approx(stated95_m, rel=1e-3)


@pytest.mark.parametrize(("clip_px", "stills_px"), [(0.3, 0.3), (0.1, 0.3), (1.0, 0.02)])
def test_colmaps_errors_are_as_large_as_is_said_of_them(clip_px: float, stills_px: float) -> None:
    """A covariance that took its points for alike would give a mean far from 1."""
    found = [
        squared_in_units(parameter_errors(other, SCENE.rig), matrix_of(other))
        for _, other in adjusted_both_ways(clip_px, stills_px)
    ]
    count = sum(n for _, n in found)

    assert sum(squares for squares, _ in found) / count == pytest.approx(
        1.0, abs=4.0 * np.sqrt(2.0 / count)
    )


def test_the_difference_varies_as_hausman_says() -> None:
    """Its covariance is the one's less the other's; where points are placed, and so in three."""
    squares = []
    for rig, other in adjusted_both_ways(0.02, 1.0):
        gains = point_gains(rig, volume())[0]
        middle = gains[np.isfinite(gains).all(axis=(1, 2))].mean(axis=0)
        difference = middle @ parameter_errors(rig, other)
        covariance = middle @ (matrix_of(other) - matrix_of(rig)) @ middle.T
        squares.append(float(difference @ np.linalg.solve(covariance, difference)))

    assert np.mean(squares) == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / N_SEEDS))


@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_weight_is_told(seed: int) -> None:
    """The clip is taken for ten times less noisy than it is."""
    bundle = bundle_of(SCENE, 0.3, 0.3, seed)
    trusted = replace(
        bundle,
        views=tuple(
            replace(view, sigma_px=0.03) if view.pose == bundle.held_pose else view
            for view in bundle.views
        ),
    )

    told = opinion_of(*rigs_of(adjust(trusted)))

    assert told.disagrees


@pytest.mark.slow
@pytest.mark.parametrize(("clip_px", "stills_px"), KINDS)
def test_a_camera_that_was_nudged_by_more_than_its_error_is_told(
    clip_px: float, stills_px: float
) -> None:
    """In any direction; a tenth of the stated error is not told."""
    rng = np.random.default_rng(1)
    for rig, other in adjusted_both_ways(clip_px, stills_px):
        index = int(rng.integers(len(rig.cameras)))
        direction = rng.normal(0.0, (0.3, 0.3, 0.3, 1.0, 1.0, 1.0))
        columns = parameter_slices(rig.cameras)[index]
        gains = point_gains(rig, volume())[0][:, :, columns][:, :, :POSE]
        moves_m = np.linalg.norm(gains @ direction, axis=1)
        stated = opinion_of(rig, other).expected95_m
        direction *= stated / np.quantile(moves_m[np.isfinite(moves_m)], 0.95)

        by_much = opinion_of(nudged(rig, index, 4.0 * direction), other)
        by_little = opinion_of(nudged(rig, index, direction / 10.0), other)

        assert by_much.disagrees
        assert not by_little.disagrees


def nudged(rig: Rig, index: int, change: NDArray[np.float64]) -> Rig:
    camera = rig.cameras[index]
    moved = replace(camera, cam_from_world=moved_pose(camera.cam_from_world, change))
    return Rig((*rig.cameras[:index], moved, *rig.cameras[index + 1 :]), covariance=rig.covariance)


def test_points_without_noise_leave_no_doubt() -> None:
    """Rounding exceeds deviations of a millionth of a pixel."""
    exact = bundle_of(SCENE, 0.0, 0.0, 0)
    weighed = replace(exact, views=tuple(replace(view, sigma_px=1e-6) for view in exact.views))
    rig, other = rigs_of(adjust(weighed))

    assert not opinion_of(rig, other).disagrees
    turned = nudged(rig, 0, np.array([0.0, 1e-3, 0.0, 0.0, 0.0, 0.0]))
    assert opinion_of(turned, other).disagrees


def test_a_camera_that_looks_away_is_told() -> None:
    rig, other = adjusted_both_ways(0.3, 0.3)[0]
    about = np.column_stack([np.diag([1.0, -1.0, -1.0]), np.zeros(3)])
    first = other.cameras[0]
    away = replace(first, cam_from_world=compose(about, first.cam_from_world))

    told = opinion_of(rig, replace(other, cameras=(away, *other.cameras[1:])))

    assert told.disagrees
    assert told.difference95_px > 100.0


def test_cameras_that_were_not_asked_do_not_count() -> None:
    rig, other = adjusted_both_ways(0.02, 1.0)[0]
    names = [camera.name for camera in rig.cameras]

    told = second_opinion(rig, other.only(names[:2]), volume())

    assert told == second_opinion(rig.only(names[:2]), other.only(names[:2]), volume())
    assert told != second_opinion(rig, other, volume())


def test_without_an_answer_or_a_common_volume_there_is_no_opinion() -> None:
    rig, other = adjusted_both_ways(0.3, 0.3)[0]
    alone = [rig.cameras[0].name]

    assert second_opinion(rig, "COLMAP rests", volume()) == NoOpinion("COLMAP rests")
    assert second_opinion(rig.only(alone), other.only(alone), volume()) == NoOpinion(
        "no two cameras see a common volume in which to compare"
    )


# --- Whole calibrations -----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("moves", [False, True])
def test_a_calibration_has_an_opinion_that_agrees(moves: bool, seed: int) -> None:
    scene = moving_scene(n_cameras=3, n_frames=25) if moves else SCENE

    record = calibrated(observed(scene, 0.3, seed))

    assert record.doubts == ()
    assert record.adjustment is not None
    assert record.adjustment.start == "COLMAP's adjustment"
    assert isinstance(record.second_opinion, SecondOpinion)
    assert record.second_opinion.difference95_m < record.second_opinion.expected95_m / 3.0


@pytest.mark.slow
def test_a_camera_nudged_after_colmaps_adjustment_is_a_doubt(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    weighed = fixed_cameras.adjust_weighed

    def nudging(*given: Any) -> Any:
        adjusted, *told = weighed(*given)
        first, *others = adjusted.bundle.cameras
        change = np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0])
        moved = replace(first, cam_from_world=moved_pose(first.cam_from_world, change))
        return replace(adjusted, bundle=replace(adjusted.bundle, cameras=(moved, *others))), *told

    monkeypatch.setattr(fixed_cameras, "adjust_weighed", nudging)

    (doubt,) = calibrated(observed(SCENE, 0.3, 0)).doubts

    assert doubt.startswith("COLMAP's own adjustment")


@pytest.mark.slow
def test_a_clip_that_is_given_a_wrong_weight_is_a_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = measure_group_noise

    def too_sure(*given: Any) -> dict[str, Noise]:
        told = measured(*given)
        clip = told["board clip"]
        return {**told, "board clip": replace(clip, smooth_px=clip.smooth_px / 30.0)}

    monkeypatch.setattr(fixed_cameras, "measure_group_noise", too_sure)

    (doubt,) = calibrated(observed(SCENE, 0.3, 0)).doubts

    assert doubt.startswith("COLMAP's own adjustment")


@pytest.mark.slow
def test_without_colmaps_answer_the_rig_is_the_same_and_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = observed(SCENE, 0.3, 0)
    usual = solve_rig([BOARD], seen).rig

    monkeypatch.setattr(fixed_cameras, "colmap_adjust", lambda *given: "COLMAP rests")
    alone = solve_rig([BOARD], seen).rig

    for one, other in zip(usual.cameras, alone.cameras, strict=True):
        assert np.abs(one.center_world - other.center_world).max() < 1e-8
        np.testing.assert_allclose(one.params, other.params, rtol=0, atol=1e-5)
    assert isinstance(alone.provenance, CalibrationRecord)
    assert alone.provenance.adjustment is not None
    assert alone.provenance.adjustment.start == "linked cameras: COLMAP rests"
    assert alone.provenance.second_opinion == NoOpinion("COLMAP rests")
    assert alone.provenance.doubts == ()


def test_cameras_that_share_a_lens_have_no_second_opinion() -> None:
    requests = {"cam1": LensRequest(group="one"), "cam2": LensRequest(group="one")}

    record = calibrated(observed(SCENE, 0.3, 0), requests)

    assert record.second_opinion == NoOpinion(
        "COLMAP has no lens that several cameras of one rig share"
    )
    assert record.doubts == ()


def calibrated(
    seen: list[Observations], requests: dict[str, LensRequest] | None = None
) -> CalibrationRecord:
    return solve_rig([BOARD], seen, requests=requests).record
