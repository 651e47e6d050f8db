"""Silhouettes of a whole session in one file, packed to bits.

Each frame of each camera is one chunk: eight pixels a byte, rows padded to whole bytes, compressed
and with a checksum. Reading takes what is asked for and no more. A file stands under its final
name only when it is complete.
"""

import json
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.calib.files import sink
from hybridve.hull.stored import DAMAGED, DamagedError, damage_in, open_stored, remember

FORMAT = "hybridve-silhouettes"
VERSION = 1

_STORED = {"compression": "gzip", "shuffle": True, "fletcher32": True, "track_times": False}


class SilhouetteWriter:
    """Takes in silhouettes frame by frame; the file appears when it is left without an error.

    Parameters
    ----------
    path : Path
        The file.
    names : sequence of str
        The cameras, C of them.
    sizes_px : sequence of (width, height)
        The size of each camera's images.
    stamp : str
        What the silhouettes were made from; see `hull.capture.recording.silhouette_stamp`.

    Raises
    ------
    ReportError
        If the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        names: Sequence[str],
        sizes_px: Sequence[tuple[int, int]],
        stamp: str,
    ) -> None:
        self._path = path
        self._sizes_px = sizes_px
        self._reasons: list[str] = []
        self._masks: list[h5py.Dataset] = []
        try:
            with ExitStack() as files:
                self._sink = files.enter_context(sink(path, holds_errors=True))
                self._file = h5py.File(self._sink, "w")
                files.push(self._finish)
                self._begin(names, stamp)
                self._files = files.pop_all()
        except OSError as error:
            raise self._unwritable(error) from error

    def _begin(self, names: Sequence[str], stamp: str) -> None:
        """Write what stands before the first frame."""
        self._file.attrs["format"] = FORMAT
        self._file.attrs["version"] = VERSION
        for key, text, description in (
            ("cameras", json.dumps(list(names)), "names of the cameras, as JSON"),
            ("stamp", stamp, "what the silhouettes were made from, as JSON"),
        ):
            _describe(self._file.create_dataset(key, data=text, track_times=False), description)
        for number, (width, height) in enumerate(self._sizes_px):
            row_bytes = -(-width // 8)
            dataset = self._file.create_dataset(
                f"masks/{number}",
                (0, height, row_bytes),
                np.uint8,
                chunks=(1, height, row_bytes),
                maxshape=(None, height, row_bytes),
                **_STORED,
            )
            _describe(dataset, "object pixels, eight a byte, the leftmost highest")
            dataset.attrs["camera"] = names[number]
            dataset.attrs["width_px"] = width
            self._masks.append(dataset)

    def append(self, masks: list[NDArray[np.uint8]] | None, reason: str = "") -> None:
        """Take in one frame: per camera a (H, W) mask, above 0 on object pixels.

        `masks` is None where a camera lacks the frame; `reason` says why.
        """
        if masks is not None:
            for number, (mask, (width, height)) in enumerate(
                zip(masks, self._sizes_px, strict=True)
            ):
                if mask.shape != (height, width):
                    raise ValueError(f"mask {number} is {mask.shape}, not {(height, width)}")
        for number, dataset in enumerate(self._masks):
            dataset.resize(len(self._reasons) + 1, axis=0)
            if masks is not None:
                dataset[-1] = np.packbits(masks[number], axis=1)
        if self._sink.error is not None:  # the disk is full
            raise self._unwritable(self._sink.error) from self._sink.error
        self._reasons.append("" if masks is not None else reason or "a camera lacks this frame")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Complete the file, or remove what there is of it if something went wrong."""
        try:
            self._files.__exit__(kind, error, trace)
        except OSError as failure:
            raise self._unwritable(failure) from failure
        if kind is None:
            remember(self._path)

    def _finish(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self._file.close()
            return
        texts = [reason.encode() for reason in self._reasons]
        kind_of_text = h5py.string_dtype("utf-8", max([1, *map(len, texts)]))
        reasons = self._file.create_dataset(
            "reason", data=np.array(texts, kind_of_text), track_times=False
        )
        _describe(reasons, "why a frame has no silhouettes; empty if it has")
        self._file.close()

    def _unwritable(self, error: OSError) -> ReportError:
        return ReportError(f"{self._path}: cannot be written: {_first_line(error)}")


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _describe(dataset: h5py.Dataset, description: str) -> None:
    dataset.attrs["unit"] = "1"
    dataset.attrs["description"] = description


class SilhouetteReader:
    """Reads the silhouettes of single frames.

    Attributes
    ----------
    names : list of str
        The cameras.
    stamp : str
        What the silhouettes were made from.
    n_frames : int
        How many frames there are.

    Raises
    ------
    ReportError
        If there is no such file, it is of another format or version, or it is damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        if not path.is_file():
            raise ReportError(f"{path}: there are no silhouettes; run `hybridve segment` first")
        try:
            self._file = open_stored(path)
        except (DamagedError, *DAMAGED) as error:
            raise self._damaged(error) from error
        try:
            found = self._file.attrs.get("format", "an unknown format")
            if found != FORMAT:
                raise ReportError(f"{path}: holds {found}, expected {FORMAT}")
            version = int(self._file.attrs["version"])
            if version != VERSION:
                raise ReportError(
                    f"{path}: silhouettes of version {version}, this hybridve reads {VERSION}; "
                    "run `hybridve segment --overwrite`"
                )
            self.names: list[str] = json.loads(self._file["cameras"].asstr()[()])
            self.stamp: str = self._file["stamp"].asstr()[()]
            self._reasons: list[str] = self._file["reason"].asstr()[:].tolist()
            self._masks = [self._file[f"masks/{number}"] for number in range(len(self.names))]
            self._widths_px = [int(dataset.attrs["width_px"]) for dataset in self._masks]
            for dataset, width in zip(self._masks, self._widths_px, strict=True):
                n_frames, _, row_bytes = dataset.shape
                if (n_frames, row_bytes) != (len(self._reasons), -(-width // 8)):
                    raise ValueError("sizes contradict each other")
        except DAMAGED as error:
            self._file.close()
            raise self._damaged(error) from error
        except ReportError:
            self._file.close()
            raise
        self.n_frames = len(self._reasons)

    def frame(self, index: int) -> tuple[list[NDArray[np.uint8]] | None, str]:
        """Return per camera the (H, W) mask of one frame, 1 on object pixels.

        The masks are None where a camera lacked the frame; the text says why.
        """
        if self._reasons[index]:
            return None, self._reasons[index]
        try:
            masks = [
                np.unpackbits(dataset[index], axis=1, count=width)
                for dataset, width in zip(self._masks, self._widths_px, strict=True)
            ]
        except DAMAGED as error:
            raise self._damaged(error) from error
        return masks, ""

    def _damaged(self, error: Exception) -> ReportError:
        return ReportError(
            f"{self._path}: not readable silhouettes, or damaged ({damage_in(error)}); "
            "run `hybridve segment --overwrite`"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self._file.close()
