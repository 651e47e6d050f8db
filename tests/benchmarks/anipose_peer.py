"""Calibrate with aniposelib; run by bench_peers.py with the interpreter that has it.

Reads corners (.npz) from its first argument, writes cameras as JSON to standard output.
"""

import contextlib
import json
import sys
import time

import cv2
import numpy as np
from aniposelib.boards import Checkerboard
from aniposelib.cameras import Camera, CameraGroup


def main() -> None:
    """Calibrate, and write where the cameras stand and how long it took."""
    given = np.load(sys.argv[1])
    pixels = given["pixels"]  # (C, F, N, 2), NaN where a camera did not see the board
    columns, rows, square_m = int(given["columns"]), int(given["rows"]), float(given["square_m"])
    # In millimetres, as its users have it: it weighs the board's shape by the unit.
    board = Checkerboard(columns, rows, square_length=1000.0 * square_m)
    size_px = tuple(map(int, given["size_px"]))
    group = CameraGroup([Camera(name=f"{index}", size=size_px) for index in range(len(pixels))])
    detections = [
        [
            {"framenum": (0, frame), "corners": seen[:, None], "ids": board.ids.copy()}
            for frame, seen in enumerate(own)
            if np.isfinite(seen).all()
        ]
        for own in pixels
    ]
    for own in detections:
        for row in own:
            row["filled"] = board.fill_points(row["corners"], row["ids"])
    start, cpu_start = time.perf_counter(), time.process_time()
    with contextlib.redirect_stdout(sys.stderr):
        group.calibrate_rows(detections, board, verbose=False)
    seconds, cpu_s = time.perf_counter() - start, time.process_time() - cpu_start
    told = [
        {
            "rotation": cv2.Rodrigues(camera.get_rotation())[0].tolist(),
            "translation": (np.ravel(camera.get_translation()) / 1000.0).tolist(),
            "matrix": np.asarray(camera.get_camera_matrix()).tolist(),
            "distortion": np.ravel(camera.get_distortions()).tolist(),
        }
        for camera in group.cameras
    ]
    json.dump({"seconds": seconds, "cpu_s": cpu_s, "cameras": told}, sys.stdout)


if __name__ == "__main__":
    main()
