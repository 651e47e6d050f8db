"""From frames to silhouettes, beside what one would otherwise take: time and accuracy together.

Frame 0 of the four cameras of `horseman` (644 x 486) in turn, one thread. `extra_info` holds each
camera's IoU with the masks painted by hand; one pixel of boundary is worth about 0.1 of it. The aim
is 3 ms for a frame of one camera. Then the four cameras side by side, as the chain runs them, and
silhouettes to a file and back: there `frame_ms` is for one frame of all four.

Run: pytest tests/benchmarks/bench_segment.py --full
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import cycle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from hybridve.calib.image_io import Image, open_source, read_image
from hybridve.hull.capture.background import learn_background
from hybridve.hull.capture.segment import Segmenter, SegmentSettings
from hybridve.hull.capture.silhouette_io import SilhouetteReader, SilhouetteWriter

pytestmark = pytest.mark.recording

CAMERAS = (1, 2, 3, 4)

#: Rows and columns of camera 3 where a board on a chair stands that the empty scene lacks and
#: nobody painted: an object, but not one to be judged by.
BOARD = np.s_[200:300, 540:]

#: The others are given the thresholds that are best for the mean IoU on these very frames:
#: grey levels of 15, 20, .., 60, and squared standard deviations of 16, 32, .., 1024.
PLAIN_THRESHOLD = 50
MOG2_THRESHOLD = 256

Cut = Callable[[Image], NDArray[np.uint8]]


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """The chain gives each camera a thread, so that OpenCV is not to start more."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(before)


@pytest.fixture(scope="module")
def empty(recordings: Path, is_full: bool) -> list[list[Image]]:
    root, stop = recordings / "horseman", 130 if is_full else 13
    return [
        list(open_source(root, f"cam{camera}/background.avi").frames(stop=stop))
        for camera in CAMERAS
    ]


@pytest.fixture(scope="module")
def frames(recordings: Path) -> list[Image]:
    root = recordings / "horseman"
    return [open_source(root, f"cam{camera}/video.avi").first() for camera in CAMERAS]


@pytest.fixture(scope="module")
def painted(recordings: Path) -> list[NDArray[np.bool_]]:
    folder = recordings / "horseman" / "manual_masks"
    return [read_image(folder / f"manual_mask_{camera}.jpg")[..., 0] > 127 for camera in CAMERAS]


def ours(empty: list[Image]) -> Cut:
    return Segmenter(learn_background(empty), SegmentSettings()).segment


def plain_difference(empty: list[Image]) -> Cut:
    """Mean of the empty scene, one threshold, opening and closing by 3 x 3."""
    mean = np.mean(empty, axis=0).round().astype(np.uint8)
    window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))

    def cut(image: Image) -> NDArray[np.uint8]:
        blue, green, red = cv2.split(cv2.absdiff(image, mean))
        differs = cv2.max(cv2.max(blue, green), red)
        _, mask = cv2.threshold(differs, PLAIN_THRESHOLD, 1, cv2.THRESH_BINARY)
        cv2.morphologyEx(mask, cv2.MORPH_OPEN, window, dst=mask)
        return np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, window), np.uint8)

    return cut


def mog2(empty: list[Image], threshold: float = 16) -> Cut:
    """A mixture of normals per pixel, learnt from the empty scene and then frozen, shadows told.

    OpenCV's default threshold, opening and closing by 3 x 3.
    """
    model = cv2.createBackgroundSubtractorMOG2(len(empty), threshold, detectShadows=True)
    for image in empty:
        model.apply(image)
    window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))

    def cut(image: Image) -> NDArray[np.uint8]:
        answer = model.apply(image, learningRate=0)  # 255 object, 127 shadow
        _, mask = cv2.threshold(answer, 127, 1, cv2.THRESH_BINARY)
        cv2.morphologyEx(mask, cv2.MORPH_OPEN, window, dst=mask)
        return np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, window), np.uint8)

    return cut


def mog2_tuned(empty: list[Image]) -> Cut:
    """The same with the threshold that suits these frames."""
    return mog2(empty, MOG2_THRESHOLD)


@pytest.mark.parametrize(
    "method", [ours, plain_difference, mog2, mog2_tuned], ids=lambda method: method.__name__
)
def bench_segment(
    benchmark: Any,
    method: Callable[[list[Image]], Cut],
    empty: list[list[Image]],
    frames: list[Image],
    painted: list[NDArray[np.bool_]],
) -> None:
    """One frame of one camera."""
    cuts = [method(images) for images in empty]
    for camera, cut, frame, truth in zip(CAMERAS, cuts, frames, painted, strict=True):
        found = cut(frame) > 0
        if camera == 3:
            found[BOARD] = False
        iou = (found & truth).sum() / (found | truth).sum()
        benchmark.extra_info[f"iou_cam{camera}"] = round(float(iou), 4)
    benchmark.extra_info["iou_mean"] = round(
        float(np.mean([benchmark.extra_info[f"iou_cam{camera}"] for camera in CAMERAS])), 4
    )
    turn = cycle(zip(cuts, frames, strict=True))

    def cut_next() -> None:
        cut, frame = next(turn)
        cut(frame)

    benchmark(cut_next)


def bench_learn_background(benchmark: Any, empty: list[list[Image]]) -> None:
    """130 frames of the empty scene, decoding left out."""
    turn = cycle(empty)
    benchmark.extra_info["frames"] = len(empty[0])
    benchmark(lambda: learn_background(next(turn)))


@pytest.fixture(scope="module")
def clips(recordings: Path, is_full: bool) -> list[list[Image]]:
    """Frames in a row, in memory."""
    root, stop = recordings / "horseman", 40 if is_full else 2
    return [
        list(open_source(root, f"cam{camera}/video.avi").frames(stop=stop)) for camera in CAMERAS
    ]


@pytest.mark.parametrize("n_threads", [1, 2])
@pytest.mark.smallest(n_threads=2)
def bench_four_cameras(
    benchmark: Any, empty: list[list[Image]], clips: list[list[Image]], n_threads: int
) -> None:
    """Forty frames of four cameras; compiled loops and OpenCV leave Python's lock alone."""
    cuts = [ours(images) for images in empty]

    def run(which: int) -> int:
        return sum(int(cuts[which](frame).sum()) for frame in clips[which])

    with ThreadPoolExecutor(n_threads) as pool:
        benchmark.pedantic(lambda: list(pool.map(run, range(4))), rounds=10, warmup_rounds=1)
    benchmark.extra_info["frames"] = len(clips[0])


def bench_store(
    benchmark: Any, empty: list[list[Image]], clips: list[list[Image]], tmp_path: Path
) -> None:
    """Forty frames of four cameras to a file, and back."""
    masks = [
        [cut(frame) for frame in clip]
        for cut, clip in zip([ours(images) for images in empty], clips, strict=True)
    ]
    path = tmp_path / "silhouettes.h5"
    names = [f"cam{camera}" for camera in CAMERAS]

    def run() -> int:
        with SilhouetteWriter(path, names, [(644, 486)] * len(CAMERAS), "") as writer:
            for frame in zip(*masks, strict=True):
                writer.append(list(frame))
        with SilhouetteReader(path) as reader:
            return sum(reader.frame(index)[0] is not None for index in range(len(clips[0])))

    n_frames = benchmark.pedantic(run, rounds=5, warmup_rounds=1)
    assert n_frames == len(clips[0])
    benchmark.extra_info.update(frames=n_frames, bytes_per_frame=path.stat().st_size // n_frames)
