"""Pictures one after another, as a film that browsers play: H.264 in an MP4."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.calib.files import appearing
from hybridve.hull.places import MARK

#: What a film may be written as.
FILMS = (".mp4",)

#: Quality, as x264 counts it: lower is better, 18 is hardly told from the pictures.
_QUALITY = "21"


def refuse_no_film(path: Path) -> None:
    """Refuse a name that no film is written under.

    Raises
    ------
    ReportError
        Saying what is written.
    """
    if path.suffix.lower() not in FILMS:
        raise ReportError(f"{path}: films are written as {', '.join(FILMS)}")


def write_film(path: Path, images: Iterable[NDArray[np.uint8]], fps: float) -> int:
    """Write pictures (H, W, 3) BGR of one size as a film, and return how many they were.

    The colours are halved in each direction (yuv420p), as players expect; a row or a column too
    many for that is left out. The file appears only when it is complete.

    Raises
    ------
    ReportError
        If there is no picture, or the place cannot be written to.
    """
    import av  # late: it brings FFmpeg

    count = 0
    try:
        with appearing(path) as partial:
            # What is told first stands first, so that a film plays while it is still loaded.
            options = {"movflags": "faststart"}
            with av.open(str(partial), "w", format="mp4", options=options) as container:
                container.metadata["comment"] = MARK
                stream = None
                for image in images:
                    if stream is None:
                        rate = Fraction(fps).limit_denominator(1001)
                        stream = container.add_stream(
                            "libx264", rate=rate, options={"crf": _QUALITY, "preset": "veryfast"}
                        )
                        stream.height, stream.width = (side // 2 * 2 for side in image.shape[:2])
                        stream.pix_fmt = "yuv420p"
                    even = np.ascontiguousarray(image[: stream.height, : stream.width])
                    frame = av.VideoFrame.from_ndarray(even, format="bgr24")
                    container.mux(stream.encode(frame))
                    count += 1
                if stream is None:
                    raise ReportError(f"{path}: there is no picture to make a film of")
                container.mux(stream.encode(None))
    except OSError as error:  # PyAV's errors are such
        reason = error.strerror or str(error)
        raise ReportError(f"{path}: cannot be written ({reason}); name a place that can") from error
    return count
