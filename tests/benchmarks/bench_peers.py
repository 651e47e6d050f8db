"""Calibration beside its peers: the same corners, with known truth; time and error.

A board is moved about before rings of cameras; its corners have normal noise of 0.3 px. From these
corners alone calibrate

* `hybridve`: `solve_rig`;
* `colmap`: COLMAP's bundle adjustment, through pycolmap, from our lenses and linked cameras; its
  time contains theirs;
* `opencv`: ``cv2.calibrateMultiview``;
* `aniposelib`, where it is installed; it may have an interpreter of its own:
  ``HYBRIDVE_ANIPOSELIB=/path/to/python``.

Rigs are laid onto the truth by the cameras' places (rotation and shift, no scale). Errors are root
mean squares over cameras, and their median over seeds; so is the reprojection error, of boards
fitted to each rig. Processor time is told beside the time, for machines that are busy. ``least`` is
what no unbiased calibration can undercut: the Cramer-Rao bound.
aniposelib adjusts one focal length and one coefficient of distortion a camera. The second lens has
no tangential distortion, and its axis in the middle of the image.

Run: python tests/benchmarks/bench_peers.py [-o peers.json] [--seeds 5]
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).parents[1]))

from helpers.theory import (
    BOARD,
    Scene,
    least_covariance,
    moving_scene,
    observed,
    parameter_errors,
)

from hybridve.calib.boards.board import Observations
from hybridve.calib.calibrate import solve_rig
from hybridve.calib.camera import Camera
from hybridve.calib.lens import img_from_cam
from hybridve.calib.placing.fixed_cameras import make_bundle
from hybridve.calib.placing.link import link_cameras
from hybridve.calib.pose import compose, invert, moved_pose, transform
from hybridve.calib.rig import Rig
from hybridve.calib.solving.colmap_adjust import colmap_adjust
from hybridve.calib.solving.lens_fit import LensSettings, fit_shared_lens
from hybridve.calib.solving.locate import locate_board

NOISE_PX = 0.3

#: A lens without tangential distortion, its axis in the middle of the image: by name, parameters.
LENSES = {"OPENCV": None, "RADIAL, centred": (510.0, 510.0, 320.0, 240.0, -0.2, 0.05, 0.0, 0.0)}

#: Cameras, and the seconds and seconds of processor time (all threads) that they took.
Result = tuple[tuple[Camera, ...], float, float]


class MissingError(Exception):
    """A peer that is not installed."""


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    """Write a table, and the same as JSON; return its numbers."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--cameras", type=int, nargs="+", default=[4, 8])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--smallest", action="store_true", help="once, 3 cameras, one lens")
    asked = parser.parse_args(arguments)
    lenses = list(LENSES)
    if asked.smallest:
        asked.seeds, asked.cameras, asked.frames, lenses = 1, [3], 12, lenses[:1]
    rows = []
    for n_cameras in asked.cameras:
        for lens in lenses:
            rows += compare(n_cameras, lens, asked.frames, asked.seeds)
    if asked.output:
        asked.output.write_text(json.dumps(rows, indent=1) + "\n")
    return {
        f"{row['cameras']} cameras, {row['lens']}.{row['peer']}.{name}": value
        for row in rows
        for name, value in row.items()
        if name.endswith(("_mm", "_mrad", "_px", "_s")) or name == "s"
    }


def compare(n_cameras: int, lens: str, n_frames: int, n_seeds: int) -> list[dict[str, Any]]:
    """Calibrate one rig with all peers, in turn, and write a line a peer."""
    scene = moving_scene(n_cameras, n_frames)
    if LENSES[lens] is not None:
        params = np.array(LENSES[lens])
        scene = replace(
            scene, cameras=tuple(replace(camera, params=params) for camera in scene.cameras)
        )
    found: dict[str, list[dict[str, float]]] = {}
    failed: dict[str, str] = {}
    for seed in range(n_seeds):
        observations = observed(scene, NOISE_PX, seed)
        for name, calibrate in PEERS.items():
            try:
                cameras, seconds, cpu_s = calibrate(scene, observations)
                rms_px = reprojection_px(cameras, observations)
            except MissingError as error:
                failed[name] = str(error)
                continue
            except (RuntimeError, cv2.error) as error:
                failed[name] = f"failed: {str(error).splitlines()[0][:70]}"
                continue
            place_mm, turn_mrad = errors_of(cameras, scene)
            found.setdefault(name, []).append(
                {
                    "s": seconds,
                    "cpu_s": cpu_s,
                    "place_mm": place_mm,
                    "turn_mrad": turn_mrad,
                    "rms_px": rms_px,
                }
            )
    place_mm, turn_mrad = least_errors(scene)
    head = f"{n_cameras} cameras, {lens}, {n_frames} frames, {n_seeds} sets of corners"
    what = {"rig": head, "cameras": n_cameras, "lens": lens}
    sys.stdout.write(
        f"{head}; load {os.getloadavg()[0]:.1f}\n"
        f"  {'least':12s}{'':32s} place {place_mm:8.3f} mm  turn {turn_mrad:8.3f} mrad\n"
    )
    rows: list[dict[str, Any]] = [
        what | {"peer": "least", "place_mm": place_mm, "turn_mrad": turn_mrad}
    ]
    for name in PEERS:
        if name in found:
            rows.append(what | {"peer": name} | summary(found[name]))
            sys.stdout.write(
                "  {peer:12s}{s:7.2f} s ± {spread_s:5.2f}, cpu {cpu_s:6.2f} s".format(**rows[-1])
            )
            sys.stdout.write(
                "  place {place_mm:8.3f} mm  turn {turn_mrad:8.3f} mrad  "
                "reprojection {rms_px:.3f} px\n".format(**rows[-1])
            )
        if name in failed:
            n_failed = n_seeds - len(found.get(name, ()))
            rows.append(what | {"peer": name, "failed": n_failed, "why": failed[name]})
            sys.stdout.write(f"  {name:12s}{failed[name]} ({n_failed} of {n_seeds})\n")
    sys.stdout.flush()
    return rows


def summary(trials: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return medians over seeds; the spread of times is half the range of the middle half."""
    told = {key: float(np.median([trial[key] for trial in trials])) for key in trials[0]}
    low, high = np.percentile([trial["s"] for trial in trials], [25, 75])
    return {key: round(value, 4) for key, value in told.items()} | {
        "spread_s": round(float(high - low) / 2.0, 3),
        "worst_place_mm": round(max(trial["place_mm"] for trial in trials), 4),
    }


# --- The peers --------------------------------------------------------------------------------


def by_hybridve(scene: Scene, observations: list[Observations]) -> Result:
    """Calibrate with this toolkit."""
    del scene
    start, cpu_start = time.perf_counter(), time.process_time()
    rig = solve_rig([BOARD], observations).rig
    return rig.cameras, time.perf_counter() - start, time.process_time() - cpu_start


def by_colmap(scene: Scene, observations: list[Observations]) -> Result:
    """Adjust the linked cameras with COLMAP."""
    del scene
    start, cpu_start = time.perf_counter(), time.process_time()
    settings = LensSettings()
    lenses = [fit_shared_lens([BOARD], [seen], settings)[0] for seen in observations]
    linked = link_cameras([BOARD], lenses, observations, is_labelled=False)
    adjusted = colmap_adjust(make_bundle([BOARD], lenses, linked, {}))
    if isinstance(adjusted, str):
        raise RuntimeError(adjusted)
    cameras = adjusted.cameras
    return cameras, time.perf_counter() - start, time.process_time() - cpu_start


def by_opencv(scene: Scene, observations: list[Observations]) -> Result:
    """Calibrate with OpenCV, four coefficients of distortion."""
    pixels = _table(scene, observations)
    seen = np.isfinite(pixels).all(axis=(2, 3))
    corners = np.where(np.isfinite(pixels), pixels, 0.0).astype(np.float32)
    start, cpu_start = time.perf_counter(), time.process_time()
    calibrate: Any = cv2.calibrateMultiview  # whose types leave optional arguments out
    _, matrices, distortions, rotations, translations = calibrate(
        [BOARD.points_board.astype(np.float32)] * pixels.shape[1],
        [list(own) for own in corners],
        [observed.size_px for observed in observations],
        seen.astype(np.uint8),
        np.full(len(observations), cv2.CALIB_MODEL_PINHOLE, np.uint8),
        None,
        None,
        None,
        None,
        np.full(len(observations), cv2.CALIB_FIX_K3, np.int32),
    )[:5]
    seconds, cpu_s = time.perf_counter() - start, time.process_time() - cpu_start
    cameras = []
    for observed_by, matrix, distortion, rotation, translation in zip(
        observations, matrices, distortions, rotations, translations, strict=True
    ):
        turn = rotation if rotation.shape == (3, 3) else cv2.Rodrigues(rotation)[0]
        pose = np.column_stack([turn, np.ravel(translation)])
        cameras.append(_camera(observed_by, matrix, np.ravel(distortion)[:4], pose))
    return tuple(cameras), seconds, cpu_s


def by_aniposelib(scene: Scene, observations: list[Observations]) -> Result:
    """Calibrate with aniposelib, in an interpreter of its own."""
    python = os.environ.get("HYBRIDVE_ANIPOSELIB", sys.executable)
    script = Path(__file__).with_name("anipose_peer.py")
    check = [python, "-c", "import aniposelib"]
    if shutil.which(python) is None or subprocess.run(check, capture_output=True).returncode:
        raise MissingError("not installed")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "corners.npz"
        np.savez(
            path,
            pixels=_table(scene, observations),
            columns=BOARD.columns,
            rows=BOARD.rows,
            square_m=BOARD.square_m,
            size_px=observations[0].size_px,
        )
        run = subprocess.run([python, script, path], capture_output=True, text=True)
    if run.returncode:
        raise RuntimeError((run.stderr.strip().splitlines() or ["no message"])[-1])
    told = json.loads(run.stdout)
    cameras = []
    for seen, camera in zip(observations, told["cameras"], strict=True):
        pose = np.column_stack([camera["rotation"], camera["translation"]])
        distortion = np.array(camera["distortion"])[:4]
        cameras.append(_camera(seen, np.array(camera["matrix"]), distortion, pose))
    return tuple(cameras), float(told["seconds"]), float(told["cpu_s"])


PEERS: dict[str, Callable[[Scene, list[Observations]], Result]] = {
    "hybridve": by_hybridve,
    "colmap": by_colmap,
    "opencv": by_opencv,
    "aniposelib": by_aniposelib,
}


def _table(scene: Scene, observations: list[Observations]) -> NDArray[np.float64]:
    """Return the corners (C, F, N, 2) in OpenCV's pixels, NaN where a camera saw no board."""
    shape = (len(observations), len(scene.world_from_board), *BOARD.points_board[:, :2].shape)
    pixels = np.full(shape, np.nan)
    for index, seen in enumerate(observations):
        for sighting in seen.sightings:
            pixels[index, sighting.instant] = sighting.pixels - 0.5
    return pixels


def _camera(
    seen: Observations,
    matrix: NDArray[np.float64],
    distortion: NDArray[np.float64],
    cam_from_world: NDArray[np.float64],
) -> Camera:
    pinhole = [matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5]
    params = np.concatenate([pinhole, distortion])
    return Camera(seen.name, "OPENCV", *seen.size_px, params, cam_from_world)


# --- Errors -----------------------------------------------------------------------------------


def errors_of(cameras: Sequence[Camera], scene: Scene) -> tuple[float, float]:
    """Return the rms errors of places (mm) and turns (mrad), the rig laid onto the truth."""
    laid = Rig(tuple(_laid_onto(cameras, scene.cameras)))
    errors = parameter_errors(laid, scene.rig)
    starts = np.cumsum([0, *(6 + len(camera.params) for camera in laid.cameras)])[:-1]
    places = np.array(
        [
            found.center_world - true.center_world
            for found, true in zip(laid.cameras, scene.cameras, strict=True)
        ]
    )
    turns = np.array([errors[start : start + 3] for start in starts])
    return (
        1000.0 * float(np.sqrt((places**2).sum(axis=1).mean())),
        1000.0 * float(np.sqrt((turns**2).sum(axis=1).mean())),
    )


def _laid_onto(cameras: Sequence[Camera], truth: Sequence[Camera]) -> list[Camera]:
    found = np.array([camera.center_world for camera in cameras])
    true = np.array([camera.center_world for camera in truth])
    u, _, vt = np.linalg.svd((true - true.mean(axis=0)).T @ (found - found.mean(axis=0)))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    truth_from_found = np.column_stack([turn, true.mean(axis=0) - turn @ found.mean(axis=0)])
    back = invert(truth_from_found)
    return [
        replace(camera, cam_from_world=compose(camera.cam_from_world, back)) for camera in cameras
    ]


def least_errors(scene: Scene) -> tuple[float, float]:
    """Return the rms errors (mm, mrad) that an efficient calibration has, laid onto the truth."""
    covariance = least_covariance(scene, NOISE_PX)
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    factor = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    rng = np.random.default_rng(0)
    squares = []
    for _ in range(400):
        change = factor @ rng.normal(size=len(factor))
        cameras, at = [], 0
        for camera in scene.cameras:
            pose = moved_pose(camera.cam_from_world, change[at : at + 6])
            cameras.append(replace(camera, cam_from_world=pose))
            at += 6 + len(camera.params)
        squares.append(np.square(errors_of(cameras, scene)))
    place_mm, turn_mrad = np.sqrt(np.median(squares, axis=0))
    return round(float(place_mm), 4), round(float(turn_mrad), 4)


def reprojection_px(cameras: Sequence[Camera], observations: list[Observations]) -> float:
    """Return the rms length of residuals with boards fitted to a rig that stays.

    Raises
    ------
    RuntimeError
        If the rig is so wrong that its lenses see no board.
    """
    views: dict[int, list[tuple[Camera, NDArray[np.float64]]]] = {}
    for camera, seen in zip(cameras, observations, strict=True):
        for sighting in seen.sightings:
            views.setdefault(int(sighting.instant or 0), []).append((camera, sighting.pixels))
    squares, count = 0.0, 0
    for own in views.values():
        starts = []
        for camera, pixels in own:
            located = locate_board(camera, BOARD.points_board, pixels)
            if located is not None:
                starts.append(compose(invert(camera.cam_from_world), located[0]))
        if not starts:
            focal_px = max(camera.params[0] for camera in cameras)
            raise RuntimeError(f"diverged, focal lengths up to {focal_px:.0f} px")

        def missed(
            change: NDArray[np.float64],
            start: NDArray[np.float64],
            own: list[tuple[Camera, NDArray[np.float64]]] = own,
        ) -> NDArray[np.float64]:
            points = transform(moved_pose(start, change), BOARD.points_board)
            return np.concatenate(
                [
                    (pixels - img_from_cam(one, transform(one.cam_from_world, points))).ravel()
                    for one, pixels in own
                ]
            )

        best = min(starts, key=lambda start: float((missed(np.zeros(6), start) ** 2).sum()))
        fitted = least_squares(missed, np.zeros(6), args=(best,), x_scale=1e-3)
        squares += 2.0 * fitted.cost
        count += len(fitted.fun) // 2
    return float(np.sqrt(squares / count))


if __name__ == "__main__":
    main()
