"""Pictures one after another, as a film."""

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError

#: What a film may be written as.
FILMS = (".mp4",)


def write_film(path: Path, images: Iterable[NDArray[np.uint8]], fps: float) -> int:
    """Write pictures (H, W, 3) BGR of one size as a film, and return how many they were.

    The file appears only when it is complete.

    Raises
    ------
    ReportError
        If there is no picture, or the place cannot be written to.
    """
    # OpenCV goes by the end of the name.
    partial = path.with_name(f"{path.name}.partial{path.suffix}")
    writer = None
    count = 0
    try:
        for image in images:
            if writer is None:
                size_px = (image.shape[1], image.shape[0])
                code = cv2.VideoWriter.fourcc(*"mp4v")
                writer = cv2.VideoWriter(str(partial), code, fps, size_px)
                if not writer.isOpened():
                    raise ReportError(f"{path}: cannot be written; name a place that can")
            writer.write(image)
            count += 1
        if writer is None:
            raise ReportError(f"{path}: there is no picture to make a film of")
        writer.release()
        partial.replace(path)
    finally:
        if writer is not None:
            writer.release()
        partial.unlink(missing_ok=True)
    return count
