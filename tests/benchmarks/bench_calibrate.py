"""Calibration: searching pictures, and solving; and how near the rig comes to the truth.

Run: pytest tests/benchmarks/bench_calibrate.py --full
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.boards import floor_of_noise, observe_exactly, render_board, ring

from hybridve.calib.boards.board import Observations
from hybridve.calib.boards.target import Chessboard, detect_corners
from hybridve.calib.calibrate import solve_rig
from hybridve.calib.image_io import open_source
from hybridve.calib.pose import compose
from hybridve.calib.seeing.inputs import CameraInput
from hybridve.calib.seeing.observe import observe_boards

HORSEMAN = Chessboard(8, 6, 0.115)


@pytest.fixture(scope="session")
def horseman_inputs(recordings: Path, is_full: bool) -> list[CameraInput]:
    root = recordings / "horseman"
    stills, n_cameras = ("*", 4) if is_full else ("*0", 2)
    return [
        CameraInput(
            name,
            "OPENCV",
            open_source(root, f"{name}/intrinsics_frames/{stills}.jpg"),
            open_source(root, f"{name}/checkerboard.avi"),
            None,
        )
        for name in ("cam1", "cam2", "cam3", "cam4")[:n_cameras]
    ]


@pytest.fixture(scope="session")
def horseman_seen(horseman_inputs: list[CameraInput]) -> list[Observations]:
    return observe_boards([HORSEMAN], horseman_inputs)


@pytest.mark.recording
def bench_horseman_search(benchmark: Any, horseman_inputs: list[CameraInput]) -> None:
    """Four clips of 126 frames and 200 stills of 644x486, decoding included."""
    seen = benchmark.pedantic(observe_boards, ([HORSEMAN], horseman_inputs), rounds=3)
    benchmark.extra_info["stills_with_board"] = sum(
        sighting.instant is None for view in seen for sighting in view.sightings
    )


@pytest.mark.recording
def bench_horseman_solve(benchmark: Any, horseman_seen: list[Observations]) -> None:
    """From corners to the rig, the scene around the symmetric board included."""
    rig = benchmark.pedantic(solve_rig, ([HORSEMAN], horseman_seen), rounds=3).rig
    benchmark.extra_info["rms_px"] = rig.provenance.rms_px


@pytest.mark.parametrize(("n_cameras", "n_stills"), [(4, 50), (16, 50), (2, 10)])
@pytest.mark.smallest(n_cameras=2)
def bench_solve(benchmark: Any, n_cameras: int, n_stills: int) -> None:
    """Generated corners with 0.2 px of noise; the error of the poses is told beside the time."""
    board = Chessboard(9, 6, 0.05)
    cameras = ring(board, ["OPENCV"] * n_cameras)
    observations = observe_exactly(board, cameras, n_stills=n_stills, noise_px=0.2)

    rig = benchmark.pedantic(solve_rig, ([board], observations), rounds=3).rig

    errors_m = [
        np.linalg.norm(rig[camera.name].center_world - camera.center_world) for camera in cameras
    ]
    benchmark.extra_info["center_rms_mm"] = 1000 * float(np.sqrt(np.mean(np.square(errors_m))))


@pytest.mark.parametrize("effort", ["quick", "thorough"])
@pytest.mark.parametrize("shows_board", [True, False])
@pytest.mark.smallest(shows_board=True, effort="quick")
def bench_detect(benchmark: Any, effort: str, shows_board: bool) -> None:
    """One picture of 640x480, with the board or a textured floor only."""
    board = Chessboard(9, 6, 0.1)
    (camera,) = ring(board, ["PINHOLE"])
    pose = camera.cam_from_world
    if not shows_board:  # it lies ten metres aside
        pose = compose(pose, np.column_stack([np.eye(3), [10.0, 0.0, 0.0]]))
    image = render_board(camera, board, pose, floor=floor_of_noise(1), noise_grey=2.0)
    benchmark(detect_corners, image, board, effort)
