"""COLMAP's adjustment of a rig and its boards: the same minimum as ours, wherever it can say it."""

import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.bundles import back_to_back, make_bundle, perturbed

from hybridve.calib.pose import angle_between, compose
from hybridve.calib.solving.bundle import Bundle, BundleView, adjust, total_cost, view_residuals
from hybridve.calib.solving.colmap_adjust import colmap_adjust

NOISE_PX = 0.3


def stills_and_clip() -> Bundle:
    return make_bundle(["OPENCV", "RADIAL"], 8, NOISE_PX, seed=3)


def parts_of_boards() -> Bundle:
    """Views miss a third of their points; one point was seen in a single view."""
    whole = make_bundle(["OPENCV", "SIMPLE_RADIAL", "OPENCV_FISHEYE"], 8, NOISE_PX, seed=5)
    rng = np.random.default_rng(6)
    views = []
    for number, view in enumerate(whole.views):
        pixels = view.pixels.copy()
        pixels[rng.permutation(len(pixels))[: len(pixels) // 3]] = np.nan
        if number:
            pixels[0] = np.nan
        else:
            pixels[0] = view.pixels[0]
        views.append(replace(view, pixels=pixels))
    return replace(whole, views=tuple(views))


def boards_that_move_alone() -> Bundle:
    """Two boards, each a body: the second was seen by both cameras at poses of its own."""
    one = make_bundle(["OPENCV", "PINHOLE"], 8, NOISE_PX, seed=7)
    rng = np.random.default_rng(8)
    other_points = one.points_board[0][:30] * (1.0, 1.2, 1.0)
    views, poses = list(one.views), list(one.rig_from_body)
    for _ in range(5):
        poses.append(np.column_stack([np.eye(3), rng.uniform((-0.1, -0.1, 0.0), (0.1, 0.1, 0.2))]))
        for camera in (0, 1):
            unseen = np.zeros((len(other_points), 2))
            views.append(BundleView(camera, len(poses) - 1, 1, unseen, f"{len(poses)}"))
    bundle = replace(
        one,
        points_board=(one.points_board[0], other_points),
        body_from_board=(np.eye(3, 4), np.eye(3, 4)),
        held_boards=frozenset({0, 1}),
        rig_from_body=tuple(poses),
        views=tuple(views),
    )
    return seen_anew(bundle, first=len(one.views), rng=rng)


def boards_mounted_at_known_places() -> Bundle:
    """Two boards on one body, their places known: both are in one picture of each camera."""
    one = make_bundle(["OPENCV", "OPENCV"], 8, NOISE_PX, seed=9)
    beside = np.column_stack([np.eye(3), [0.1, -0.5, 0.05]])
    views = [
        *one.views,
        *(replace(view, board=1) for view in one.views if view.pose == one.held_pose),
    ]
    bundle = replace(
        one,
        points_board=(one.points_board[0], one.points_board[0]),
        body_from_board=(np.eye(3, 4), beside),
        held_boards=frozenset({0, 1}),
        views=tuple(views),
    )
    return seen_anew(bundle, first=len(one.views), rng=np.random.default_rng(10))


def seen_anew(bundle: Bundle, first: int, rng: np.random.Generator) -> Bundle:
    """Return a bundle whose views from `first` on are what its cameras see, with noise."""
    views = [
        replace(view, pixels=view.pixels - missed + rng.normal(0.0, NOISE_PX, missed.shape))
        for view, missed in zip(bundle.views, view_residuals(bundle), strict=True)
    ]
    return replace(bundle, views=(*bundle.views[:first], *views[first:]))


def lenses_that_are_given() -> Bundle:
    """Two of three cameras share one lens, which is known: so COLMAP need not know that they do."""
    bundle = make_bundle(["OPENCV"] * 3, 6, NOISE_PX, seed=11)
    return replace(bundle, lens_of=(0, 0, 1), fixed_lenses=frozenset({0}))


BUNDLES = {
    "stills and a clip": stills_and_clip,
    "parts of boards": parts_of_boards,
    "boards that move alone": boards_that_move_alone,
    "boards mounted at known places": boards_mounted_at_known_places,
    "given lenses": lenses_that_are_given,
}


def start_of(bundle: Bundle) -> Bundle:
    """Move all that may be adjusted, and the rig's frame: the held pose is not the identity."""
    start = perturbed(bundle, seed=4, by=0.002)
    start = replace(
        start,
        cameras=tuple(
            camera if lens not in bundle.fixed_lenses else replace(camera, params=true.params)
            for camera, true, lens in zip(
                start.cameras, bundle.cameras, bundle.lens_of, strict=True
            )
        ),
    )
    turn = np.array([[0.0, -1.0, 0.0, 0.3], [1.0, 0.0, 0.0, -0.2], [0.0, 0.0, 1.0, 0.1]])
    back = np.column_stack([turn[:, :3].T, -turn[:, :3].T @ turn[:, 3]])
    return replace(
        start,
        cameras=tuple(
            replace(camera, cam_from_world=compose(camera.cam_from_world, back))
            for camera in start.cameras
        ),
        rig_from_body=tuple(compose(turn, pose) for pose in start.rig_from_body),
    )


@pytest.mark.parametrize("loss_px", [np.inf, 0.5])
@pytest.mark.parametrize("name", BUNDLES)
def test_colmap_finds_the_same_minimum(name: str, loss_px: float) -> None:
    start = start_of(BUNDLES[name]())

    ours, theirs = adjust(start, loss_px).bundle, colmap_adjust(start, loss_px)

    assert isinstance(theirs, Bundle)
    assert total_cost(theirs, loss_px) == pytest.approx(total_cost(ours, loss_px), rel=1e-9)
    assert total_cost(ours, loss_px) < 0.9 * total_cost(start, loss_px)
    np.testing.assert_array_equal(
        theirs.rig_from_body[start.held_pose], start.rig_from_body[start.held_pose]
    )
    for one, other in zip(ours.cameras, theirs.cameras, strict=True):
        assert angle_between(one.cam_from_world, other.cam_from_world) < 1e-6
        assert np.abs(one.center_world - other.center_world).max() < 1e-6
        np.testing.assert_allclose(one.params, other.params, atol=2e-3)
    for pose, other_pose in zip(ours.rig_from_body, theirs.rig_from_body, strict=True):
        assert angle_between(pose, other_pose) < 1e-6
        assert np.abs(pose[:, 3] - other_pose[:, 3]).max() < 1e-6


def test_the_loss_is_that_of_our_adjustment() -> None:
    """A point that misses by far draws the plain least squares off, the robust one hardly."""
    truth = stills_and_clip()
    pixels = truth.views[0].pixels.copy()
    pixels[5] += 40.0
    spoilt = replace(truth, views=(replace(truth.views[0], pixels=pixels), *truth.views[1:]))

    plain, robust = colmap_adjust(spoilt), colmap_adjust(spoilt, 0.5)

    assert isinstance(plain, Bundle)
    assert isinstance(robust, Bundle)
    plain_m, robust_m = (
        np.linalg.norm(one.cameras[0].center_world - truth.cameras[0].center_world)
        for one in (plain, robust)
    )
    assert robust_m < 0.2 * plain_m


def test_lenses_that_are_given_stay() -> None:
    start = start_of(lenses_that_are_given())

    theirs = colmap_adjust(start)

    assert isinstance(theirs, Bundle)
    for index in (0, 1):
        np.testing.assert_array_equal(theirs.cameras[index].params, start.cameras[index].params)
    assert (theirs.cameras[2].params != start.cameras[2].params).all()


def test_what_colmap_cannot_express_is_said() -> None:
    shared = replace(make_bundle(["OPENCV"] * 2, 4, NOISE_PX), lens_of=(0, 0))

    assert colmap_adjust(shared) == "COLMAP has no lens that several cameras of one rig share"
    assert (
        colmap_adjust(back_to_back())
        == "COLMAP has no boards that are mounted together at places to be found"
    )


def test_a_start_that_sees_no_board_has_no_answer() -> None:
    """COLMAP counts a point that is behind its camera as one that fits."""
    truth = make_bundle(["OPENCV"] * 2, 4, NOISE_PX)
    about = np.column_stack([np.diag([1.0, -1.0, -1.0]), np.zeros(3)])
    first = truth.cameras[0]
    away = replace(first, cam_from_world=compose(about, first.cam_from_world))

    told = colmap_adjust(replace(truth, cameras=(away, truth.cameras[1])))

    assert isinstance(told, str)


def test_the_truth_without_noise_stays() -> None:
    truth = make_bundle(["OPENCV"] * 2, 6)

    theirs = colmap_adjust(truth)

    assert isinstance(theirs, Bundle)
    for one, other in zip(truth.cameras, theirs.cameras, strict=True):
        assert np.abs(one.center_world - other.center_world).max() < 1e-7


def test_it_says_nothing_on_its_own(capfd: pytest.CaptureFixture[str]) -> None:
    colmap_adjust(start_of(parts_of_boards()))
    test_a_start_that_sees_no_board_has_no_answer()

    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_the_answer_is_the_same_bits_for_any_number_of_threads() -> None:
    """In processes of their own: libraries look at their variables but once."""
    digests = set()
    for threads in ("1", "4"):
        run = subprocess.run(
            [sys.executable, __file__],
            env={
                **os.environ,
                "OMP_NUM_THREADS": threads,
                "OPENBLAS_NUM_THREADS": threads,
                "PYTHONPATH": str(Path(__file__).parent),
            },
            capture_output=True,
            text=True,
            check=True,
        )
        digests.add(run.stdout)

    assert len(digests) == 1
    assert digests == {digest_of_an_answer()}


def digest_of_an_answer() -> str:
    """Return a digest of what becomes of a rig that is large enough for blocks and threads."""
    answer = colmap_adjust(perturbed(make_bundle(["OPENCV"] * 12, 6, NOISE_PX), seed=1, by=0.002))
    assert isinstance(answer, Bundle)
    digest = hashlib.sha256(np.array(answer.rig_from_body).tobytes())
    for camera in answer.cameras:
        digest.update(camera.params.tobytes() + camera.cam_from_world.tobytes())
    return digest.hexdigest() + "\n"


if __name__ == "__main__":
    sys.stdout.write(digest_of_an_answer())
