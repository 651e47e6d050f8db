"""Milliseconds of one core for each step from frames to stored silhouettes, on horseman.

The aim is 3 ms for a frame of 644 x 486, decoding not included: four cameras on two cores then
leave most of a thirtieth of a second to the rest of the chain.

Run: pytest tests/benchmarks/bench_segment.py -o python_files='bench_*.py'
-o python_functions='bench_*' --benchmark-columns=median,iqr,rounds
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from hybridve.calib.image_io import open_source
from hybridve.hull.capture.background import learn_background
from hybridve.hull.capture.segment import Segmenter, SegmentSettings
from hybridve.hull.capture.silhouette_io import SilhouetteReader, SilhouetteWriter

pytestmark = pytest.mark.recording

N_FRAMES = 40

Bytes = NDArray[np.uint8]


@pytest.fixture(scope="module", autouse=True)
def _one_opencv_thread() -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(before)


@pytest.fixture(scope="module")
def cameras(recordings: Path) -> list[tuple[Segmenter, list[Bytes]]]:
    """Per camera what cuts objects out, and frames from all over the recording."""
    found = []
    for camera in (1, 2, 3, 4):
        root = recordings / "horseman" / f"cam{camera}"
        background = learn_background(open_source(root, "background.avi").frames())
        frames = list(open_source(root, "video.avi").frames(step=426 // N_FRAMES))[:N_FRAMES]
        segmenter = Segmenter(background, SegmentSettings())
        segmenter.segment(frames[0])  # compiles, or loads what was compiled
        found.append((segmenter, frames))
    return found


@pytest.mark.parametrize("camera", [1, 2, 3, 4])
def bench_one_frame(
    benchmark: Any, cameras: list[tuple[Segmenter, list[Bytes]]], camera: int
) -> None:
    segmenter, frames = cameras[camera - 1]
    numbers = iter(range(1 << 30))

    benchmark(lambda: segmenter.segment(frames[next(numbers) % N_FRAMES]))


@pytest.mark.parametrize("n_threads", [1, 2])
def bench_four_cameras(
    benchmark: Any, cameras: list[tuple[Segmenter, list[Bytes]]], n_threads: int
) -> None:
    """All frames of four cameras; `frame_ms` is for one frame of all of them."""

    def run(which: int) -> int:
        segmenter, frames = cameras[which]
        return sum(int(segmenter.segment(frame).sum()) for frame in frames)

    with ThreadPoolExecutor(n_threads) as pool:
        benchmark.pedantic(lambda: list(pool.map(run, range(4))), rounds=10, warmup_rounds=1)
    benchmark.extra_info["frame_ms"] = round(1000 * benchmark.stats["median"] / N_FRAMES, 2)


def bench_background(benchmark: Any, recordings: Path) -> None:
    """132 frames in memory to mean and noise."""
    frames = list(open_source(recordings / "horseman" / "cam1", "background.avi").frames())

    benchmark.pedantic(learn_background, args=(frames,), rounds=5, warmup_rounds=1)


def bench_write_and_read(
    benchmark: Any, cameras: list[tuple[Segmenter, list[Bytes]]], tmp_path: Path
) -> None:
    """Silhouettes of four cameras to a file and back; `frame_ms` for a frame of all of them."""
    masks = [
        [segmenter.segment(frames[index]) for segmenter, frames in cameras]
        for index in range(N_FRAMES)
    ]
    names = ["cam1", "cam2", "cam3", "cam4"]
    path = tmp_path / "silhouettes.h5"

    def run() -> int:
        with SilhouetteWriter(path, names, [(644, 486)] * 4, "") as writer:
            for frame in masks:
                writer.append(frame)
        with SilhouetteReader(path) as reader:
            return sum(reader.frame(index)[0] is not None for index in range(N_FRAMES))

    assert benchmark.pedantic(run, rounds=5, warmup_rounds=1) == N_FRAMES
    benchmark.extra_info["frame_ms"] = round(1000 * benchmark.stats["median"] / N_FRAMES, 2)
    benchmark.extra_info["bytes_per_frame"] = path.stat().st_size // N_FRAMES
